//! A multilayer EXR exactly as stored: headers, attributes and *compressed* chunks.
//!
//! In: a file. Out: decoded channels on demand, and a file in which every part that was not edited
//! is the same chunks again, bit for bit, whatever its compression.
//! The only module that knows the `exr` crate. What a channel means is `passes`' business.

mod atomic;
mod bounds;
mod bytes;
mod chroma;
mod decode;
mod edit;
mod header;
mod read;
mod write;
mod zip;

use std::{
    fmt,
    path::{Path, PathBuf},
};

use exr::{
    block::chunk::TileCoordinates,
    compression::Compression,
    math::Vec2,
    meta::{BlockDescription, attribute::SampleType, header::Header},
};

pub use atomic::{alone_in, atomically, folder_of, ignores_case, place_of, prepare_folder, write_file};
pub use chroma::to_rgb;
pub use edit::{HALF_MAX, NewChannel, Recoded, UNSTORABLE};

use crate::{Error, Result, metrics::display::LUMINANCE};
use bytes::{Bytes, Opened};
use header::{Attributes, string};

/// Leading bytes of every EXR file.
const MAGIC: [u8; 4] = [0x76, 0x2f, 0x31, 0x01];

/// Flags beside the version of the format.
mod flags {
    /// A single part of flat tiles.
    pub const TILED: u32 = 1 << 9;
    /// Some name has more than [`super::header::SHORT_NAME`] letters.
    pub const LONG_NAMES: u32 = 1 << 10;
    /// Some part is deep.
    pub const DEEP: u32 = 1 << 11;
    /// The multi-part layout.
    pub const MULTI_PART: u32 = 1 << 12;
    /// All flags.
    pub const ALL: u32 = TILED | LONG_NAMES | DEEP | MULTI_PART;
}

/// An EXR file as it was stored. Compressed blocks stay in the file, which is kept open, until they are
/// wanted.
pub struct Frame {
    path: PathBuf,
    opened: Opened,
    byte_len: u64,
    /// Whether chunks say which part they belong to.
    multi_part: bool,
    /// Whether the file said that it has long names.
    long_names: bool,
    stored: Vec<Stored>,
    parts: Vec<Part>,
    chunks: Vec<StoredChunk>,
}

/// A part as it is stored, and how its blocks lie in it.
struct Stored {
    attributes: Attributes,
    layout: Header,
}

/// A compressed block of one part; `index` counts the part's blocks in increasing y.
struct StoredChunk {
    part: usize,
    index: usize,
    place: TileCoordinates,
    /// The compressed bytes; those of a deep block begin with its sizes.
    bytes: Bytes,
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
    /// Whether each pixel holds any number of samples: such a part is kept, but cannot be decoded.
    pub deep: bool,
    /// The pixels that are stored.
    pub data_window: Window,
    /// Compressed size in bytes.
    pub stored_bytes: usize,
    /// Whether channels stored at less than full resolution can be decoded.
    has_readable_chroma: bool,
}

/// One channel of a part.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Channel {
    /// Its full name, such as `ViewLayer.Combined.R`.
    pub name: String,
    /// Its number type.
    pub kind: SampleKind,
    /// Stored at less than full resolution, as chroma beside luminance is.
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
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
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
        self.multi_part
    }

    /// The text of an attribute that OpenEXR does not define, of the first part that has it.
    pub fn text_attribute(&self, name: &str) -> Option<String> {
        self.stored.iter().find_map(|stored| stored.attributes.text(name))
    }

    /// The 16 numbers of a matrix attribute, by rows, of the first part that has it.
    pub fn matrix_attribute(&self, name: &str) -> Option<[f32; 16]> {
        self.stored.iter().find_map(|stored| stored.attributes.matrix(name))
    }

    /// Whether the file says that it is an environment by latitude and longitude, whose left and right edges
    /// meet.
    pub fn is_latitude_longitude(&self) -> bool {
        self.stored.iter().any(|stored| stored.attributes.value("envmap", "envmap") == Some(&[0]))
    }

    /// x and y of red, green, blue and white in the CIE 1931 diagram, of the first part that tells them.
    pub fn primaries(&self) -> Option<[f32; 8]> {
        self.stored.iter().find_map(|stored| stored.attributes.chromaticities())
    }

    /// The weights of red, green and blue in the luminance of a part, by its primaries, or those of Rec. 709
    /// where it names none.
    ///
    /// # Panics
    /// If there is no such part.
    pub fn luminance_weights(&self, part: usize) -> [f32; 3] {
        let primaries = self.stored[part].attributes.chromaticities();
        primaries.and_then(chroma::weights).unwrap_or(LUMINANCE.map(|weight| weight as f32))
    }

    /// The rectangle that viewers show, in the coordinates of the data windows.
    pub fn display_window(&self) -> Window {
        let first = &self.stored[0].attributes;
        first.window("displayWindow").unwrap_or(self.parts[0].data_window)
    }

    /// Names of the stereo views that the file declares.
    pub fn views(&self) -> Vec<String> {
        let declared = self.stored.iter().flat_map(|stored| stored.attributes.texts("multiView"));
        let own = self.parts.iter().filter_map(|p| p.view.clone());
        let mut views: Vec<String> = declared.chain(own).collect();
        let mut seen = std::collections::HashSet::new();
        views.retain(|v| seen.insert(v.clone()));
        views
    }

    /// Rebuilds the public description after headers or chunks changed.
    fn describe(&mut self) {
        let mut bytes = vec![0; self.stored.len()];
        for chunk in &self.chunks {
            bytes[chunk.part] += chunk.bytes.len();
        }
        self.parts = self.stored.iter().zip(bytes).map(|(stored, bytes)| Part::new(stored, bytes)).collect();
    }

    /// A decoding or encoding failure of the `exr` crate as this crate's error.
    fn error(path: &Path, error: exr::error::Error) -> Error {
        use exr::error::Error as Exr;
        match error {
            Exr::Io(source) => Error::Io { path: path.into(), action: "read", source },
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

    /// Refuses what needs pixels where only headers were read: every part has a block at least.
    fn refuse_headers_alone(&self) -> Result<()> {
        match self.chunks.is_empty() {
            true => {
                Err(Error::invalid(&self.path, "is known by its headers alone; its pixels were not read"))
            }
            false => Ok(()),
        }
    }

    /// The part at `index`, or an error naming the file.
    fn layout(&self, part: usize) -> Result<&Header> {
        self.refuse_headers_alone()?;
        let stored = self.stored.get(part);
        stored
            .map(|stored| &stored.layout)
            .ok_or_else(|| Error::invalid(&self.path, format!("has no part {part}; parts count from 0")))
    }
}

impl Part {
    fn new(Stored { attributes, layout }: &Stored, stored_bytes: usize) -> Self {
        let channels = layout.channels.list.iter().map(|c| Channel {
            name: string(c.name.as_slice()),
            kind: c.sample_type.into(),
            subsampled: c.sampling != Vec2(1, 1),
        });
        let position = layout.own_attributes.layer_position;
        Self {
            name: attributes.text("name"),
            view: attributes.text("view"),
            channels: channels.collect(),
            compression: compression_name(layout.compression),
            tiles: match layout.blocks {
                BlockDescription::ScanLines => None,
                BlockDescription::Tiles(t) => Some((t.tile_size.width(), t.tile_size.height())),
            },
            deep: layout.deep,
            data_window: Window {
                x: position.x(),
                y: position.y(),
                width: layout.layer_size.width(),
                height: layout.layer_size.height(),
            },
            stored_bytes,
            has_readable_chroma: chroma::is_readable(layout),
        }
    }

    /// Why the part's pixels cannot be decoded, with the remedy; nothing if they can be.
    pub fn undecodable(&self) -> Option<String> {
        let subsampled = self.channels.iter().find(|c| c.subsampled);
        if self.deep {
            Some("holds deep data, which has no single colour per pixel; flatten it first".into())
        } else if self.compression.starts_with("htj2k") {
            Some(format!(
                "is compressed as {}, which demc does not read; convert it with OpenImageIO on \
                 OpenEXR 3.4 or newer (whole numbers of 32 bits are rounded in that): oiiotool IN.exr --compression \
                 zip -o OUT.exr",
                self.compression.to_uppercase()
            ))
        } else {
            let channel = subsampled.filter(|_| !self.has_readable_chroma)?;
            Some(format!(
                "has channel '{}' at less than full resolution in a way that demc does not read ({}); convert it to RGB with \
                 OpenImageIO: oiiotool IN.exr -o OUT.exr",
                channel.name,
                self.compression.to_uppercase()
            ))
        }
    }
}

impl Channel {
    /// Whether it holds chroma beside luminance (`RY`, `BY`).
    pub fn is_chroma(&self) -> bool {
        chroma::is_chroma(self.name.as_bytes())
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

fn compression_name(compression: Compression) -> &'static str {
    header::COMPRESSIONS[usize::from(header::compression_id(compression))]
}
