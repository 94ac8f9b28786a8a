//! A multilayer EXR exactly as stored: headers, attributes and *compressed* chunks.
//!
//! In: a file. Out: decoded channels on demand, and a file in which every part that was not edited
//! is the same chunks again, bit for bit, whatever its compression.
//! The only module that knows the `exr` crate. What a channel means is `passes`' business.

mod atomic;
mod bounds;
mod decode;
mod edit;
mod read;
mod write;
mod zip;

use std::{
    fmt,
    path::{Path, PathBuf},
};

use exr::{
    block::chunk::Chunk,
    meta::{
        BlockDescription, MetaData,
        attribute::{AttributeValue, SampleType, Text},
        header::Header,
    },
};

pub use atomic::{atomically, remove_leftovers};
pub use edit::{HALF_MAX, NewChannel, Recoded};

use crate::{Error, Result};

/// An EXR file held in memory as it was stored.
pub struct Frame {
    path: PathBuf,
    byte_len: u64,
    meta: MetaData,
    parts: Vec<Part>,
    chunks: Vec<StoredChunk>,
}

/// A compressed block of one part; `index` counts the part's blocks in increasing y.
struct StoredChunk {
    part: usize,
    index: usize,
    chunk: Chunk,
}

/// What a part says about itself.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// The part's name, where it has one.
    pub name: Option<String>,
    /// The stereo view it belongs to, where it says so.
    pub view: Option<String>,
    /// Channels in stored (alphabetical) order.
    pub channels: Vec<Channel>,
    /// Compression as OpenEXR names it: `zip`, `piz`, `dwaa` ...
    pub compression: &'static str,
    /// Tile width and height; scan lines otherwise.
    pub tiles: Option<(usize, usize)>,
    /// The pixels that are stored.
    pub data_window: Window,
    /// Compressed size in bytes.
    pub stored_bytes: usize,
}

/// One channel of a part.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Channel {
    /// Its full name, such as `ViewLayer.Combined.R`.
    pub name: String,
    /// Its number type.
    pub kind: SampleKind,
    /// Stored at less than full resolution: cannot be decoded.
    pub subsampled: bool,
}

/// The number types of EXR.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SampleKind {
    /// 16-bit float.
    Half,
    /// 32-bit float.
    Float,
    /// 32-bit unsigned integer.
    Uint,
}

/// A pixel rectangle; the origin may be negative.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// Left edge.
    pub x: i32,
    /// Top edge.
    pub y: i32,
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl Frame {
    /// Where the frame was read from.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Size of the file it was read from.
    pub fn byte_len(&self) -> u64 {
        self.byte_len
    }

    /// The parts in file order.
    pub fn parts(&self) -> &[Part] {
        &self.parts
    }

    /// Whether the file has the multi-part layout (Blender 5: one part per pass).
    pub fn is_multi_part(&self) -> bool {
        self.parts.len() > 1 || self.meta.requirements.is_multilayer()
    }

    /// The text of an attribute that OpenEXR does not define, of the first part that has it.
    pub fn text_attribute(&self, name: &str) -> Option<String> {
        let name = text(name);
        self.meta.headers.iter().find_map(|header| {
            let own = header.own_attributes.other.get(&name);
            match own.or_else(|| header.shared_attributes.other.get(&name))? {
                AttributeValue::Text(value) => Some(string(value)),
                _ => None,
            }
        })
    }

    /// What viewers show, in the coordinates of the data windows.
    pub fn display_window(&self) -> Window {
        let window = self.meta.headers[0].shared_attributes.display_window;
        Window {
            x: window.position.x(),
            y: window.position.y(),
            width: window.size.width(),
            height: window.size.height(),
        }
    }

    /// Names of the stereo views that the file declares.
    pub fn views(&self) -> Vec<String> {
        let declared = self.meta.headers.iter().filter_map(|h| h.own_attributes.multi_view_names.as_ref());
        let own = self.parts.iter().filter_map(|p| p.view.clone());
        let mut views: Vec<String> = declared.flatten().map(string).chain(own).collect();
        let mut seen = std::collections::HashSet::new();
        views.retain(|v| seen.insert(v.clone()));
        views
    }

    /// Rebuilds the public description after headers or chunks changed.
    fn describe(&mut self) {
        let mut bytes = vec![0; self.meta.headers.len()];
        for stored in &self.chunks {
            bytes[stored.part] += chunk_bytes(&stored.chunk);
        }
        self.parts = self.meta.headers.iter().zip(bytes).map(|(h, b)| Part::new(h, b)).collect();
    }

    /// A decoding or encoding failure of the `exr` crate as this crate's error.
    fn error(path: &Path, error: exr::error::Error) -> Error {
        use exr::error::Error as Exr;
        match error {
            Exr::Io(source) => Error::Io { path: path.into(), action: "read", source },
            Exr::NotSupported(what) if what.contains("deep") => Error::invalid(
                path,
                "holds deep data, which has no single colour per pixel; render without deep output or \
                 flatten it first",
            ),
            Exr::NotSupported(what) => Error::invalid(
                path,
                format!("EXR feature not supported ({what}); store it again as a plain ZIP-compressed EXR"),
            ),
            Exr::Invalid(what) => Error::invalid(
                path,
                format!("damaged or incomplete EXR ({what}); render it or copy it again"),
            ),
            Exr::Aborted => Error::Interrupted,
        }
    }

    /// The part at `index`, or an error naming the file.
    fn header(&self, part: usize) -> Result<&Header> {
        self.meta
            .headers
            .get(part)
            .ok_or_else(|| Error::invalid(&self.path, format!("has no part {part}; parts count from 0")))
    }
}

impl Part {
    fn new(header: &Header, stored_bytes: usize) -> Self {
        let channels = header.channels.list.iter().map(|c| Channel {
            name: string(&c.name),
            kind: c.sample_type.into(),
            subsampled: c.sampling != exr::math::Vec2(1, 1),
        });
        let position = header.own_attributes.layer_position;
        Self {
            name: header.own_attributes.layer_name.as_ref().map(string),
            view: header.own_attributes.view_name.as_ref().map(string),
            channels: channels.collect(),
            compression: compression_name(header.compression),
            tiles: match header.blocks {
                BlockDescription::ScanLines => None,
                BlockDescription::Tiles(t) => Some((t.tile_size.width(), t.tile_size.height())),
            },
            data_window: Window {
                x: position.x(),
                y: position.y(),
                width: header.layer_size.width(),
                height: header.layer_size.height(),
            },
            stored_bytes,
        }
    }
}

impl From<SampleType> for SampleKind {
    fn from(kind: SampleType) -> Self {
        match kind {
            SampleType::F16 => Self::Half,
            SampleType::F32 => Self::Float,
            SampleType::U32 => Self::Uint,
        }
    }
}

impl fmt::Display for SampleKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Half => "half",
            Self::Float => "float",
            Self::Uint => "uint",
        })
    }
}

fn compression_name(compression: exr::compression::Compression) -> &'static str {
    use exr::compression::Compression as C;
    match compression {
        C::Uncompressed => "none",
        C::RLE => "rle",
        C::ZIP1 => "zips",
        C::ZIP16 => "zip",
        C::PIZ => "piz",
        C::PXR24 => "pxr24",
        C::B44 => "b44",
        C::B44A => "b44a",
        C::DWAA(_) => "dwaa",
        C::DWAB(_) => "dwab",
        C::HTJ2K32 => "htj2k32",
        C::HTJ2K256 => "htj2k256",
    }
}

/// EXR text is bytes without a declared encoding: Blender writes UTF-8; Latin-1 reads anything else.
fn string(text: &Text) -> String {
    std::str::from_utf8(text.as_slice()).map_or_else(|_| text.to_string(), str::to_owned)
}

fn text(string: &str) -> Text {
    Text::from_slice_unchecked(string.as_bytes())
}

fn chunk_bytes(chunk: &Chunk) -> usize {
    use exr::block::chunk::CompressedBlock as B;
    match &chunk.compressed_block {
        B::ScanLine(b) => b.compressed_pixels_le.len(),
        B::Tile(b) => b.compressed_pixels_le.len(),
        B::DeepScanLine(b) => b.compressed_sample_data_le.len(),
        B::DeepTile(b) => b.compressed_sample_data_le.len(),
    }
}
