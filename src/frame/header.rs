//! A part's header as it is stored: attributes in the file's order, each the bytes that were read. What this
//! program does not know is written again as it was, and the same input gives the same bytes.
//!
//! From it comes the layout of the part's blocks, as the `exr` crate's codecs want it.

use std::{collections::HashSet, io::Write};

use exr::{
    compression::Compression,
    math::{RoundingMode, Vec2},
    meta::{
        BlockDescription,
        attribute::{
            ChannelDescription, ChannelList, LevelMode, LineOrder, SampleType, Text, TileDescription,
        },
        header::Header,
    },
};

use super::Window;

/// Longest edge believed (Blender renders at most 65536); a damaged header may promise billions.
const MAX_EDGE: usize = 1 << 18;
/// Most pixels believed in one part.
const MAX_PIXELS: usize = 1 << 31;
/// Longest name of an attribute, a type or a channel in files without the flag for long names.
pub const SHORT_NAME: usize = 31;

/// One attribute: `kind` is its type, such as `string`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Attribute {
    pub name: Vec<u8>,
    pub kind: Vec<u8>,
    pub value: Vec<u8>,
}

/// The attributes of a part.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Attributes(pub Vec<Attribute>);

impl Attributes {
    /// The value of an attribute of that name and type.
    pub fn value(&self, name: &str, kind: &str) -> Option<&[u8]> {
        let is_it = |a: &&Attribute| a.name == name.as_bytes() && a.kind == kind.as_bytes();
        self.0.iter().find(is_it).map(|a| a.value.as_slice())
    }

    /// The value of a text, which has no declared encoding.
    pub fn text(&self, name: &str) -> Option<String> {
        self.value(name, "string").map(string)
    }

    /// Several texts, each with its length before it.
    pub fn texts(&self, name: &str) -> Vec<String> {
        let mut rest = self.value(name, "stringvector").unwrap_or_default();
        let mut texts = Vec::new();
        while let Some((length, after)) = rest.split_first_chunk() {
            let Ok(length) = usize::try_from(i32::from_le_bytes(*length)) else { break };
            let Some((text, after)) = after.split_at_checked(length) else { break };
            texts.push(string(text));
            rest = after;
        }
        texts
    }

    /// A matrix of four rows and columns, by rows.
    pub fn matrix(&self, name: &str) -> Option<[f32; 16]> {
        self.floats(name, "m44f")
    }

    /// x and y of red, green, blue and white.
    pub fn chromaticities(&self) -> Option<[f32; 8]> {
        self.floats("chromaticities", "chromaticities")
    }

    /// The numbers of an attribute; none where it does not have `N` of them.
    fn floats<const N: usize>(&self, name: &str, kind: &str) -> Option<[f32; N]> {
        self.numbers(name, kind).map(|numbers| numbers.map(f32::from_le_bytes))
    }

    /// The bytes of each of an attribute's numbers; none where it does not have `N` of them.
    fn numbers<const N: usize>(&self, name: &str, kind: &str) -> Option<[[u8; 4]; N]> {
        self.value(name, kind)?.as_chunks::<4>().0.try_into().ok()
    }

    /// A rectangle of pixels; where it is empty or turned inside out, its size is zero.
    pub fn window(&self, name: &str) -> Option<Window> {
        // By its first and last column and row.
        let [x0, y0, x1, y1] = self.numbers(name, "box2i")?.map(i32::from_le_bytes);
        let span = |from: i32, to: i32| usize::try_from(i64::from(to) - i64::from(from) + 1).unwrap_or(0);
        Some(Window { x: x0, y: y0, width: span(x0, x1), height: span(y0, y1) })
    }

    /// Gives an attribute another value, or adds it after the others.
    pub fn set(&mut self, name: &str, kind: &str, value: Vec<u8>) {
        let (name, kind) = (name.as_bytes().to_vec(), kind.as_bytes().to_vec());
        match self.0.iter_mut().find(|a| a.name == name) {
            Some(attribute) => *attribute = Attribute { name, kind, value },
            None => self.0.push(Attribute { name, kind, value }),
        }
    }

    /// As [`Attributes::set`], of a text.
    pub fn set_text(&mut self, name: &str, text: &str) {
        self.set(name, "string", text.as_bytes().to_vec());
    }

    /// Makes channels, compression and number of blocks those of a layout.
    pub fn set_layout(&mut self, layout: &Header) {
        self.set("channels", "chlist", write_channels(&layout.channels));
        self.set("compression", "compression", vec![compression_id(layout.compression)]);
        if self.value("chunkCount", "int").is_some() {
            self.set_chunk_count(layout);
        }
    }

    /// Sets the number of blocks, which files of several parts must state.
    pub fn set_chunk_count(&mut self, layout: &Header) {
        let count = i32::try_from(layout.chunk_count).expect("sizes of parts were checked");
        self.set("chunkCount", "int", count.to_le_bytes().to_vec());
    }

    /// Whether some name is longer than [`SHORT_NAME`], which the file's flags must say.
    pub fn has_long_names(&self, layout: &Header) -> bool {
        let names = self.0.iter().flat_map(|a| [a.name.len(), a.kind.len()]);
        names.chain(layout.channels.list.iter().map(|c| c.name.as_slice().len())).any(|len| len > SHORT_NAME)
    }

    /// Writes the header with its end.
    pub fn write(&self, out: &mut impl Write) -> std::io::Result<()> {
        for Attribute { name, kind, value } in &self.0 {
            let size = i32::try_from(value.len()).map_err(std::io::Error::other)?;
            for bytes in [name.as_slice(), &[0], kind, &[0], &size.to_le_bytes(), value] {
                out.write_all(bytes)?;
            }
        }
        out.write_all(&[0])
    }

    /// How blocks lie in the part. Whether they are tiles or deep is passed in, since the attribute `type`
    /// decides that in some files only.
    ///
    /// # Errors
    /// Which attribute is missing or makes no sense.
    pub fn layout(&self, is_tiled: bool, is_deep: bool) -> Result<Header, String> {
        let required = |name: &str, kind: &str| {
            self.value(name, kind).ok_or_else(|| format!("missing or invalid {name} attribute"))
        };
        let window = self.window("dataWindow").ok_or("missing or invalid dataWindow attribute")?;
        let Window { x, y, width, height } = window;
        if width == 0 || height == 0 {
            return Err("its data window is empty".into());
        }
        let channels = read_channels(required("channels", "chlist")?)?;
        let compression = self.compression(required("compression", "compression")?)?;
        let line_order = match required("lineOrder", "lineOrder")? {
            [0] => LineOrder::Increasing,
            [1] => LineOrder::Decreasing,
            [2] => LineOrder::Unspecified,
            _ => return Err("missing or invalid lineOrder attribute".into()),
        };
        let blocks = match is_tiled {
            true => BlockDescription::Tiles(read_tiles(required("tiles", "tiledesc")?)?),
            false => BlockDescription::ScanLines,
        };
        let longest = match blocks {
            BlockDescription::Tiles(tiles) => tiles.tile_size.width().max(tiles.tile_size.height()),
            BlockDescription::ScanLines => 1,
        };
        // OpenEXR has the same limit, so that sums of such numbers fit into 32 bits.
        if [x, y].iter().any(|edge| edge.unsigned_abs() > 1 << 29) {
            return Err("its data window lies too far out".into());
        }
        let claims = || format!("claims {width}x{height} pixels: damaged, or too large");
        if width.max(height).max(longest) > MAX_EDGE || width * height > MAX_PIXELS {
            return Err(claims());
        }
        let mut header = Header::new(Text::from_slice_unchecked(b""), (width, height), channels.into());
        header = header.with_encoding(compression, blocks, line_order);
        header.own_attributes.layer_position = Vec2(x, y);
        header.deep = is_deep;
        // Block sizes and numbers of blocks are 32-bit in the format.
        let fits = |n: usize| i32::try_from(n).is_ok();
        if !fits(header.max_block_byte_size()) || !fits(header.chunk_count) {
            return Err(claims());
        }
        if let Some(count) = self.value("chunkCount", "int")
            && count != i32::try_from(header.chunk_count).unwrap_or(-1).to_le_bytes()
        {
            return Err(format!("its chunkCount is not the {} that its size needs", header.chunk_count));
        }
        Ok(header)
    }

    fn compression(&self, id: &[u8]) -> Result<Compression, String> {
        use Compression as C;
        let level = self.value("dwaCompressionLevel", "float");
        let level = level.and_then(|bytes| Some(f32::from_le_bytes(bytes.try_into().ok()?)));
        Ok(match id {
            [0] => C::Uncompressed,
            [1] => C::RLE,
            [2] => C::ZIP1,
            [3] => C::ZIP16,
            [4] => C::PIZ,
            [5] => C::PXR24,
            [6] => C::B44,
            [7] => C::B44A,
            [8] => C::DWAA(level),
            [9] => C::DWAB(level),
            [10] => C::HTJ2K256,
            [11] => C::HTJ2K32,
            _ => return Err(format!("compression {id:?} is unknown; store it again as ZIP")),
        })
    }
}

/// What OpenEXR calls each kind of compression, by its number in headers.
pub const COMPRESSIONS: [&str; 12] =
    ["none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab", "htj2k256", "htj2k32"];

/// The number of a kind of compression in headers.
pub fn compression_id(compression: Compression) -> u8 {
    use Compression as C;
    match compression {
        C::Uncompressed => 0,
        C::RLE => 1,
        C::ZIP1 => 2,
        C::ZIP16 => 3,
        C::PIZ => 4,
        C::PXR24 => 5,
        C::B44 => 6,
        C::B44A => 7,
        C::DWAA(_) => 8,
        C::DWAB(_) => 9,
        C::HTJ2K256 => 10,
        C::HTJ2K32 => 11,
    }
}

/// The text of an EXR, which is bytes without a declared encoding: UTF-8, as Blender writes it, or else
/// Latin-1.
pub fn string(bytes: &[u8]) -> String {
    std::str::from_utf8(bytes).map_or_else(|_| bytes.iter().map(|b| char::from(*b)).collect(), str::to_owned)
}

/// Reads a list of channels. Each has a name, a type, whether it is perceptually linear, three unused bytes,
/// and the distance of its samples.
fn read_channels(mut bytes: &[u8]) -> Result<Vec<ChannelDescription>, String> {
    let mut channels = Vec::new();
    let mut names = HashSet::new();
    loop {
        let end = bytes.iter().position(|b| *b == 0).ok_or("its list of channels has no end")?;
        let (name, rest) = (&bytes[..end], &bytes[end + 1..]);
        if name.is_empty() {
            break;
        }
        let (numbers, rest) = rest.split_first_chunk::<16>().ok_or("its list of channels is cut short")?;
        let number =
            |at: usize| i32::from_le_bytes([numbers[at], numbers[at + 1], numbers[at + 2], numbers[at + 3]]);
        let sample_type = match number(0) {
            0 => SampleType::U32,
            1 => SampleType::F16,
            2 => SampleType::F32,
            other => return Err(format!("channel '{}' has the unknown type {other}", string(name))),
        };
        let distance = |n: i32| usize::try_from(n).ok().filter(|n| (1..=MAX_EDGE).contains(n));
        let (Some(x), Some(y)) = (distance(number(8)), distance(number(12))) else {
            return Err(format!("channel '{}' has an impossible sampling", string(name)));
        };
        if !names.insert(name) {
            return Err(format!("channel '{}' is there twice", string(name)));
        }
        channels.push(ChannelDescription {
            name: Text::from_slice_unchecked(name),
            sample_type,
            quantize_linearly: numbers[4] != 0,
            sampling: Vec2(x, y),
        });
        bytes = rest;
    }
    // Pixels lie in the order of the channels' names, whatever the order of the list; OpenEXR reads them so.
    channels.sort_by(|a, b| a.name.as_slice().cmp(b.name.as_slice()));
    if channels.is_empty() { Err("it has no channels".into()) } else { Ok(channels) }
}

fn write_channels(channels: &ChannelList) -> Vec<u8> {
    let mut bytes = Vec::new();
    for channel in &channels.list {
        let kind: i32 = match channel.sample_type {
            SampleType::U32 => 0,
            SampleType::F16 => 1,
            SampleType::F32 => 2,
        };
        bytes.extend_from_slice(channel.name.as_slice());
        bytes.push(0);
        bytes.extend_from_slice(&kind.to_le_bytes());
        bytes.extend_from_slice(&[channel.quantize_linearly.into(), 0, 0, 0]);
        for distance in [channel.sampling.x(), channel.sampling.y()] {
            let distance = i32::try_from(distance).expect("it was read as one");
            bytes.extend_from_slice(&distance.to_le_bytes());
        }
    }
    bytes.push(0);
    bytes
}

/// Reads the width and height of tiles, and a byte for resolution levels: their kind, and from the fifth bit
/// on how halved sizes are rounded.
fn read_tiles(bytes: &[u8]) -> Result<TileDescription, String> {
    let invalid = "missing or invalid tiles attribute";
    let [w0, w1, w2, w3, h0, h1, h2, h3, mode] = *bytes else { return Err(invalid.into()) };
    let size = |bytes: [u8; 4]| u32::from_le_bytes(bytes) as usize;
    let tile_size = Vec2(size([w0, w1, w2, w3]), size([h0, h1, h2, h3]));
    if tile_size.width() == 0 || tile_size.height() == 0 {
        return Err(invalid.into());
    }
    let level_mode = match mode & 0xf {
        0 => LevelMode::Singular,
        1 => LevelMode::MipMap,
        2 => LevelMode::RipMap,
        _ => return Err(invalid.into()),
    };
    let rounding_mode = match mode >> 4 {
        0 => RoundingMode::Down,
        1 => RoundingMode::Up,
        _ => return Err(invalid.into()),
    };
    Ok(TileDescription { tile_size, level_mode, rounding_mode })
}

/// The value of a `tiles` attribute.
pub fn write_tiles(tiles: TileDescription) -> Vec<u8> {
    let mode = match tiles.level_mode {
        LevelMode::Singular => 0,
        LevelMode::MipMap => 1,
        LevelMode::RipMap => 2,
    };
    let rounding = if tiles.rounding_mode == RoundingMode::Up { 16 } else { 0 };
    let size = |edge: usize| u32::try_from(edge).expect("sizes of tiles were checked").to_le_bytes();
    [&size(tiles.tile_size.width())[..], &size(tiles.tile_size.height()), &[mode | rounding]].concat()
}
