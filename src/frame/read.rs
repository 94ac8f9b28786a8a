//! Reads a file into a [`Frame`]: headers, then the place of every chunk. Each chunk must be present exactly
//! once, so that a truncated render is refused here and not half denoised.

use std::{
    collections::HashMap,
    fs::{self, File},
    io::{self, BufReader, ErrorKind, Read},
    path::Path,
};

use exr::{
    block::chunk::TileCoordinates,
    math::Vec2,
    meta::{BlockDescription, header::Header},
};

use super::{
    Frame, MAGIC, Stored, StoredChunk,
    bytes::{Bytes, Opened},
    flags,
    header::{Attribute, Attributes, string},
};
use crate::{Error, Result};

/// Bytes of a chunk's entry in the offset table.
const OFFSET_BYTES: u64 = 8;
/// Longest name of an attribute, a type or a channel.
pub const LONGEST_NAME: usize = 255;
/// The only version of the format since 2.0.
const VERSION: u32 = 2;

impl Frame {
    /// Opens a file: reads its headers, and looks where its chunks are; nothing is decoded yet.
    ///
    /// # Errors
    /// The file cannot be read, is no EXR, is truncated or damaged, or holds deep data alone.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let (mut source, mut frame) = open(path)?;
        if frame.stored.iter().all(|stored| stored.layout.deep) {
            let why = "holds deep data, which has no single colour per pixel; render without deep output or flatten it first";
            return Err(Error::invalid(path, why));
        }
        frame.chunks = source.chunks(&frame.stored, frame.multi_part).map_err(|e| e.of(path))?;
        frame.describe();
        Ok(frame)
    }

    /// As [`Frame::read_headers`], of a file that was not cut off: the places of all its blocks are told, and the last
    /// one ends within it. Blocks are not looked at one by one, which takes long where many files are.
    ///
    /// # Errors
    /// As [`Frame::read_headers`], or the file was cut off.
    pub fn read_headers_of_whole(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let (mut source, mut frame) = open(path)?;
        source.find_end(&frame.stored, frame.multi_part).map_err(|e| e.of(path))?;
        frame.describe();
        Ok(frame)
    }

    /// Reads a file's headers alone: what it holds, none of its pixels, which it then neither decodes nor writes.
    ///
    /// # Errors
    /// As [`Frame::read`], except that damaged pixels are not noticed, and deep data is taken.
    pub fn read_headers(path: impl AsRef<Path>) -> Result<Self> {
        let (_, mut frame) = open(path.as_ref())?;
        frame.describe();
        Ok(frame)
    }
}

/// Reads a file's headers; what comes next in the source are the offset tables.
fn open(path: &Path) -> Result<(Source, Frame)> {
    // Before it is opened: a pipe without a writer would wait for ever.
    let info = fs::metadata(path).map_err(Error::io("read", path))?;
    if info.is_dir() {
        return Err(Error::invalid(path, "is a directory; name the EXR files in it"));
    }
    if !info.is_file() {
        return Err(Error::invalid(path, "is no file on a disk, in which demc can go back; save it as one"));
    }
    let file = File::open(path).map_err(Error::io("read", path))?;
    let info = file.metadata().map_err(Error::io("read", path))?;
    if info.len() == 0 {
        return Err(Error::invalid(path, "is empty; render it or copy it again"));
    }
    let again = file.try_clone().map_err(Error::io("read", path))?;
    let opened = Opened::new(again, path, &info);
    let mut source = Source { reader: BufReader::new(file), at: 0, len: info.len() };
    if source.bytes(4).map_err(|e| e.of(path))? != MAGIC {
        return Err(Error::invalid(path, "is not an EXR file; render to OpenEXR MultiLayer"));
    }
    let mut frame = Frame {
        path: path.into(),
        opened,
        byte_len: info.len(),
        multi_part: false,
        long_names: false,
        stored: Vec::new(),
        parts: Vec::new(),
        chunks: Vec::new(),
    };
    source.headers(&mut frame).map_err(|e| e.of(path))?;
    Ok((source, frame))
}

/// Why reading stops.
enum Failure {
    Io(io::Error),
    /// Pixel blocks are missing.
    Truncated,
    /// A header makes no sense.
    Damaged(String),
}

impl Failure {
    fn of(self, path: &Path) -> Error {
        match self {
            Self::Io(source) => Error::Io { path: path.into(), action: "read", source },
            Self::Truncated => Error::invalid(
                path,
                "is truncated or damaged: pixel blocks are missing; render it or copy it again",
            ),
            Self::Damaged(what) => Error::invalid(
                path,
                format!("damaged or incomplete EXR ({what}); render it or copy it again"),
            ),
        }
    }
}

impl From<io::Error> for Failure {
    fn from(error: io::Error) -> Self {
        match error.kind() {
            ErrorKind::UnexpectedEof => Self::Truncated,
            _ => Self::Io(error),
        }
    }
}

impl From<String> for Failure {
    fn from(what: String) -> Self {
        Self::Damaged(what)
    }
}

/// A file that is read once from beginning to end, without taking more memory than it has bytes left.
struct Source {
    reader: BufReader<File>,
    at: u64,
    len: u64,
}

impl Source {
    fn bytes(&mut self, count: u64) -> Result<Vec<u8>, Failure> {
        if count > self.len.saturating_sub(self.at) {
            return Err(Failure::Truncated);
        }
        let mut bytes = vec![0; usize::try_from(count).map_err(|_| Failure::Truncated)?];
        self.reader.read_exact(&mut bytes)?;
        self.at += count;
        Ok(bytes)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], Failure> {
        let mut bytes = [0; N];
        self.reader.read_exact(&mut bytes)?;
        self.at += N as u64;
        Ok(bytes)
    }

    fn int(&mut self) -> Result<i32, Failure> {
        Ok(i32::from_le_bytes(self.array()?))
    }

    /// The bytes before the next zero.
    fn name(&mut self) -> Result<Vec<u8>, Failure> {
        let mut name = Vec::new();
        loop {
            match self.array()? {
                [0] => return Ok(name),
                [byte] if name.len() < LONGEST_NAME => name.push(byte),
                _ => return Err(Failure::Damaged("a name of an attribute has no end".into())),
            }
        }
    }

    fn seek(&mut self, to: u64) -> Result<(), Failure> {
        if to >= self.len {
            return Err(Failure::Truncated);
        }
        // This keeps what is buffered, where the new place lies within that.
        self.reader.seek_relative(to.cast_signed() - self.at.cast_signed())?;
        self.at = to;
        Ok(())
    }

    /// Version, flags and all headers.
    fn headers(&mut self, frame: &mut Frame) -> Result<(), Failure> {
        let version = u32::from_le_bytes(self.array()?);
        let has = |flag: u32| version & flag != 0;
        if version & 0xff != VERSION || version & !(0xff | flags::ALL) != 0 {
            return Err(Failure::Damaged(format!("version and flags {version:#x} are unknown")));
        }
        (frame.multi_part, frame.long_names) = (has(flags::MULTI_PART), has(flags::LONG_NAMES));
        let mut chunks = 0u64;
        while let Some(attributes) = self.attributes()? {
            let kind = attributes.text("type").unwrap_or_default();
            // In a file of one part the flags decide, and `type` decides only whether deep data is tiled.
            let (is_tiled, is_deep) = if frame.multi_part {
                (kind.contains("tile"), kind.starts_with("deep"))
            } else if has(flags::DEEP) {
                (kind == "deeptile", true)
            } else {
                (has(flags::TILED), false)
            };
            let layout = attributes.layout(is_tiled, is_deep)?;
            // This comes before memory is set aside for each chunk.
            chunks += layout.chunk_count as u64;
            if chunks.saturating_mul(OFFSET_BYTES) > self.len {
                return Err(Failure::Truncated);
            }
            frame.stored.push(Stored { attributes, layout });
            if !frame.multi_part {
                break;
            }
        }
        if frame.stored.is_empty() { Err(Failure::Damaged("it has no parts".into())) } else { Ok(()) }
    }

    /// The attributes of the next part, or nothing after the last.
    fn attributes(&mut self) -> Result<Option<Attributes>, Failure> {
        let mut attributes = Attributes::default();
        loop {
            let name = self.name()?;
            if name.is_empty() {
                return Ok((!attributes.0.is_empty()).then_some(attributes));
            }
            let kind = self.name()?;
            let size = self.int()?;
            let size =
                u64::try_from(size).map_err(|_| format!("attribute '{}' has no size", string(&name)))?;
            attributes.0.push(Attribute { name, kind, value: self.bytes(size)? });
        }
    }

    /// The offset of each chunk, with its part, in the order of the file. None lies before the end of the tables.
    fn offsets(&mut self, parts: &[Stored]) -> Result<Vec<(u64, usize)>, Failure> {
        let mut offsets = Vec::new();
        for (part, stored) in parts.iter().enumerate() {
            for _ in 0..stored.layout.chunk_count {
                offsets.push((u64::from_le_bytes(self.array()?), part));
            }
        }
        offsets.sort_unstable();
        match offsets.first() {
            Some((first, _)) if *first < self.at => Err(Failure::Truncated),
            _ => Ok(offsets),
        }
    }

    /// Finds that the chunk that lies last ends within the file.
    fn find_end(&mut self, parts: &[Stored], multi_part: bool) -> Result<(), Failure> {
        let Some((offset, part)) = self.offsets(parts)?.pop() else { return Ok(()) };
        self.seek(offset)?;
        self.chunk(part, parts, multi_part).map(|_| ())
    }

    /// The chunk of a part that lies here: which block it says it is, and its bytes.
    fn chunk(
        &mut self,
        part: usize,
        parts: &[Stored],
        multi_part: bool,
    ) -> Result<(Option<TileCoordinates>, Bytes), Failure> {
        if multi_part && usize::try_from(self.int()?) != Ok(part) {
            return Err(Failure::Truncated);
        }
        let place = self.place(&parts[part].layout)?;
        let bytes = if parts[part].layout.deep { self.deep_bytes()? } else { self.sized_bytes()? };
        Ok((place, bytes))
    }

    /// All chunks in the order of the file.
    fn chunks(&mut self, parts: &[Stored], multi_part: bool) -> Result<Vec<StoredChunk>, Failure> {
        // Where each block of each part belongs, in increasing y.
        let places: Vec<HashMap<TileCoordinates, usize>> = parts
            .iter()
            .map(|stored| {
                stored.layout.blocks_increasing_y_order().enumerate().map(|(i, t)| (t.location, i)).collect()
            })
            .collect();
        // Chunks are found through the sorted offset tables, since files may have gaps and chunks in any
        // order.
        let offsets = self.offsets(parts)?;
        let mut seen: Vec<Vec<bool>> = places.iter().map(|p| vec![false; p.len()]).collect();
        let mut chunks = Vec::with_capacity(offsets.len());
        let mut held = 0;
        for (offset, part) in offsets {
            self.seek(offset)?;
            let (place, bytes) = self.chunk(part, parts, multi_part)?;
            // Chunks that overlap would make a result that is larger than the file.
            held += bytes.len() as u64;
            let index = place.and_then(|place| Some((place, *places[part].get(&place)?)));
            let Some((place, index)) = index.filter(|_| held <= self.len) else {
                return Err(Failure::Truncated);
            };
            if std::mem::replace(&mut seen[part][index], true) {
                return Err(Failure::Truncated);
            }
            chunks.push(StoredChunk { part, index, place, bytes });
        }
        Ok(chunks)
    }

    /// Which block of its part a chunk says it is.
    fn place(&mut self, layout: &Header) -> Result<Option<TileCoordinates>, Failure> {
        let number = |n: i64| usize::try_from(n).ok();
        Ok(match layout.blocks {
            BlockDescription::ScanLines => {
                let first = i64::from(layout.own_attributes.layer_position.y());
                let rows = layout.compression.scan_lines_per_block();
                let y = number(i64::from(self.int()?) - first);
                y.map(|y| TileCoordinates { tile_index: Vec2(0, y / rows), level_index: Vec2(0, 0) })
            }
            BlockDescription::Tiles(_) => {
                let mut numbers = [None; 4];
                for slot in &mut numbers {
                    *slot = number(self.int()?.into());
                }
                let [Some(x), Some(y), Some(level_x), Some(level_y)] = numbers else { return Ok(None) };
                Some(TileCoordinates { tile_index: Vec2(x, y), level_index: Vec2(level_x, level_y) })
            }
        })
    }

    fn sized_bytes(&mut self) -> Result<Bytes, Failure> {
        let size = u64::try_from(self.int()?).map_err(|_| Failure::Truncated)?;
        self.bytes_from(self.at, size)
    }

    /// `count` bytes from offset `at` on, which stay in the file; they must be there.
    fn bytes_from(&self, at: u64, count: u64) -> Result<Bytes, Failure> {
        if count > self.len.saturating_sub(at) {
            return Err(Failure::Truncated);
        }
        Ok(Bytes::InFile { at, len: usize::try_from(count).map_err(|_| Failure::Truncated)? })
    }

    /// A deep block, from its sizes on: those of its two packed halves, and of the second one unpacked.
    fn deep_bytes(&mut self) -> Result<Bytes, Failure> {
        let start = self.at;
        let sizes: [u8; 24] = self.array()?;
        let [counts, samples, _] =
            [0, 8, 16].map(|at| u64::from_le_bytes(std::array::from_fn(|i| sizes[at + i])));
        self.bytes_from(start, counts.saturating_add(samples).saturating_add(sizes.len() as u64))
    }
}
