//! From a file to a [`Frame`]: headers, then every chunk still compressed, each checked to be present
//! exactly once, so that a truncated render is refused here and not half denoised.

use std::{collections::HashMap, fs::File, io::BufReader, path::Path};

use exr::{
    block::{
        chunk::TileCoordinates,
        reader::{ChunksReader, Reader},
    },
    meta::{MetaData, attribute::AttributeValue, header::Header},
};

use super::{Frame, StoredChunk, text};
use crate::{Error, Result};

/// Leading bytes of every EXR file.
const MAGIC: [u8; 4] = [0x76, 0x2f, 0x31, 0x01];
/// Offset-table entry of one chunk.
const OFFSET_BYTES: u64 = 8;
/// Longest edge believed (Blender renders at most 65536); a damaged header may promise billions.
const MAX_EDGE: usize = 1 << 18;
/// Most pixels believed in one part.
const MAX_PIXELS: usize = 1 << 31;

impl Frame {
    /// Reads a file: headers and compressed chunks; nothing is decoded yet.
    ///
    /// # Errors
    /// The file cannot be read, is no EXR, is truncated or damaged, or holds deep data.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let (reader, byte_len) = open(path)?;

        // Where each block of each part belongs, in increasing y.
        let places: Vec<HashMap<TileCoordinates, usize>> = reader
            .headers()
            .iter()
            .map(|h| h.blocks_increasing_y_order().enumerate().map(|(i, t)| (t.location, i)).collect())
            .collect();
        // Through the offset tables (sorted): files may hold gaps and any order of chunks.
        let mut chunks_reader =
            reader.filter_chunks(false, |_, _, _| true).map_err(|e| Self::error(path, e))?;
        let mut chunks = Vec::with_capacity(chunks_reader.len());
        let mut seen: Vec<Vec<bool>> = places.iter().map(|p| vec![false; p.len()]).collect();
        while let Some(chunk) = chunks_reader.read_next_chunk() {
            let chunk = chunk.map_err(|e| match e {
                exr::error::Error::Invalid(_) => truncated(path),
                other => Self::error(path, other),
            })?;
            let part = chunk.layer_index;
            let place = chunks_reader.headers()[part]
                .get_block_data_indices(&chunk.compressed_block)
                .map_err(|e| Self::error(path, e))?;
            let Some(&index) = places[part].get(&place) else { return Err(truncated(path)) };
            if std::mem::replace(&mut seen[part][index], true) {
                return Err(truncated(path));
            }
            chunks.push(StoredChunk { part, index, chunk });
        }
        if seen.iter().flatten().any(|s| !s) {
            return Err(truncated(path));
        }

        Ok(Self::assemble(path, byte_len, chunks_reader.meta_data().clone(), chunks))
    }

    /// Reads a file's headers alone: what it holds, none of its pixels.
    ///
    /// # Errors
    /// As [`Frame::read`], but for damaged pixels.
    pub fn read_headers(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let (reader, byte_len) = open(path)?;
        Ok(Self::assemble(path, byte_len, reader.meta_data().clone(), Vec::new()))
    }

    fn assemble(path: &Path, byte_len: u64, mut meta: MetaData, chunks: Vec<StoredChunk>) -> Self {
        for header in &mut meta.headers {
            let attributes = &mut header.own_attributes;
            // exr 1.74 writes six of a key code's seven numbers, and a file that nothing reads: so they go as plain bytes.
            if let Some(code) = attributes.film_key_code.take() {
                let numbers = [
                    code.film_manufacturer_code,
                    code.film_type,
                    code.film_roll_prefix,
                    code.count,
                    code.perforation_offset,
                    code.perforations_per_frame,
                    code.perforations_per_count,
                ];
                let bytes = numbers.iter().flat_map(|n| n.to_le_bytes()).collect();
                let value = AttributeValue::Custom { kind: text("keycode"), bytes };
                attributes.other.insert(text("keyCode"), value);
            }
        }
        let mut frame = Self { path: path.into(), byte_len, meta, parts: Vec::new(), chunks };
        frame.describe();
        frame
    }
}

/// Reads a file's headers; its length besides.
fn open(path: &Path) -> Result<(Reader<BufReader<File>>, u64)> {
    let file = File::open(path).map_err(Error::io("read", path))?;
    let info = file.metadata().map_err(Error::io("read", path))?;
    if info.is_dir() {
        return Err(Error::invalid(path, "is a directory; name the EXR files in it"));
    }
    let mut buffered = BufReader::with_capacity(1 << 18, file);
    check_magic(&mut buffered, path, info.len())?;
    let reader = exr::block::read(buffered, false).map_err(|e| Frame::error(path, e))?;
    check_sizes(reader.headers(), path, info.len())?;
    Ok((reader, info.len()))
}

/// Memory is set aside as headers say: believe only what is plausible and what the file has room for.
fn check_sizes(headers: &[Header], path: &Path, byte_len: u64) -> Result<()> {
    for header in headers {
        let (width, height) = (header.layer_size.width(), header.layer_size.height());
        // Block sizes are 32-bit in the format.
        let fits = i32::try_from(header.max_block_byte_size()).is_ok();
        if width.max(height) > MAX_EDGE || width * height > MAX_PIXELS || !fits {
            return Err(Error::invalid(
                path,
                format!(
                    "claims {width}x{height} pixels: damaged, or too large; copy it again or render it in regions"
                ),
            ));
        }
    }
    let chunks: u64 = headers.iter().map(|h| h.chunk_count as u64).sum();
    if chunks.saturating_mul(OFFSET_BYTES) > byte_len { Err(truncated(path)) } else { Ok(()) }
}

fn check_magic(file: &mut BufReader<File>, path: &Path, byte_len: u64) -> Result<()> {
    use std::io::{Read, Seek};
    if byte_len == 0 {
        return Err(Error::invalid(path, "is empty; render it or copy it again"));
    }
    let mut magic = Vec::with_capacity(MAGIC.len());
    file.take(MAGIC.len() as u64).read_to_end(&mut magic).map_err(Error::io("read", path))?;
    if magic != MAGIC {
        return Err(Error::invalid(path, "is not an EXR file; render to OpenEXR MultiLayer"));
    }
    file.rewind().map_err(Error::io("read", path))
}

fn truncated(path: &Path) -> Error {
    Error::invalid(path, "is truncated or damaged: pixel blocks are missing; render it or copy it again")
}
