//! Small EXR files in the layouts that renderers write, made by the `exr` crate itself.

use std::{
    fs,
    path::{Path, PathBuf},
    time::{Duration, SystemTime},
};

use exr::prelude::*;
use half::f16;

/// A file of `tests/data`.
pub fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

/// The names of what lies in a folder, in order.
pub fn names_in(folder: impl AsRef<Path>) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// Every channel of every part, by part name and channel name.
pub type Flat = Image<Layers<AnyChannels<FlatSamples>>>;

/// Reads a file with the `exr` crate.
pub fn read_exr(path: impl AsRef<Path>) -> Flat {
    read_all_flat_layers_from_file(path).unwrap()
}

/// The values of a channel of a single-part file or of the first part that has it.
pub fn values(image: &Flat, channel: &str) -> Vec<f32> {
    samples(image, channel).unwrap_or_else(|| panic!("no channel {channel}")).values_as_f32().collect()
}

/// The samples of a channel, if the file has it.
pub fn samples<'a>(image: &'a Flat, channel: &str) -> Option<&'a FlatSamples> {
    let mut all = image.layer_data.iter().flat_map(|l| &l.channel_data.list);
    all.find(|c| c.name.eq(channel)).map(|c| &c.sample_data)
}

/// Bit patterns, so that NaN equals itself.
pub fn bits(samples: &FlatSamples) -> Vec<u32> {
    match samples {
        FlatSamples::F16(v) => v.iter().map(|v| u32::from(v.to_bits())).collect(),
        FlatSamples::F32(v) => v.iter().map(|v| v.to_bits()).collect(),
        FlatSamples::U32(v) => v.clone(),
    }
}

/// A render in one part: half Combined RGBA and float Normal XYZ of the view layer `ViewLayer`;
/// `value` gives each channel its pixels by name (`Combined.R`) and index.
pub fn write_render(path: &Path, width: usize, height: usize, value: impl Fn(&str, usize) -> f32) {
    let plane = |name: &str| (0..width * height).map(|i| value(name, i)).collect::<Vec<f32>>();
    let half = ["R", "G", "B", "A"].map(|c| {
        let name = format!("Combined.{c}");
        (name.clone(), FlatSamples::F16(plane(&name).into_iter().map(f16::from_f32).collect()))
    });
    let float = ["X", "Y", "Z"].map(|c| {
        let name = format!("Normal.{c}");
        (name.clone(), FlatSamples::F32(plane(&name)))
    });
    let list = half.into_iter().chain(float);
    let list = list.map(|(name, samples)| AnyChannel::new(format!("ViewLayer.{name}").as_str(), samples));
    let encoding = Encoding {
        compression: Compression::ZIP16,
        blocks: Blocks::ScanLines,
        line_order: LineOrder::Increasing,
    };
    let channels = AnyChannels::sort(list.collect());
    let layer = Layer::new((width, height), LayerAttributes::default(), encoding, channels);
    Image::from_layer(layer).write().to_file(path).unwrap();
}

/// Writes parts of 4x3 pixels with these names, whose channels are called just R, G and B.
pub fn write_bare_parts(path: &Path, names: &[&str]) {
    let part = |name: &&str| {
        let list = ["R", "G", "B"].map(|c| AnyChannel::new(c, FlatSamples::F32(vec![0.5; 12])));
        let channels = AnyChannels::sort(list.into_iter().collect());
        Layer::new((4, 3), LayerAttributes::named(*name), Encoding::SMALL_LOSSLESS, channels)
    };
    let shared = ImageAttributes::new(IntegerBounds::from_dimensions((4, 3)));
    let parts: Vec<_> = names.iter().map(part).collect();
    Image::from_layers(shared, parts).write().to_file(path).unwrap();
}

/// The header of a 2x1 deep scan-line image (OpenEXR file layout, `type` `deepscanline`).
pub fn deep_file() -> Vec<u8> {
    const DEEP: u32 = 1 << 11;
    let mut bytes = vec![0x76, 0x2f, 0x31, 0x01];
    bytes.extend((2u32 | DEEP).to_le_bytes());
    let mut attribute = |name: &str, kind: &str, value: &[u8]| {
        bytes.extend(name.bytes().chain([0]).chain(kind.bytes()).chain([0]));
        bytes.extend((value.len() as i32).to_le_bytes());
        bytes.extend(value);
    };
    let ints = |values: &[i32]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let float = |v: f32| v.to_le_bytes();
    let channel = [b"Z\0".as_slice(), &ints(&[2, 0, 1, 1]), &[0]].concat();
    attribute("channels", "chlist", &channel);
    attribute("chunkCount", "int", &ints(&[1]));
    attribute("compression", "compression", &[2]);
    attribute("dataWindow", "box2i", &ints(&[0, 0, 1, 0]));
    attribute("displayWindow", "box2i", &ints(&[0, 0, 1, 0]));
    attribute("lineOrder", "lineOrder", &[0]);
    attribute("maxSamplesPerPixel", "int", &ints(&[1]));
    attribute("name", "string", b"deep");
    attribute("pixelAspectRatio", "float", &float(1.0));
    attribute("screenWindowCenter", "v2f", &[0; 8]);
    attribute("screenWindowWidth", "float", &float(1.0));
    attribute("type", "string", b"deepscanline");
    attribute("version", "int", &ints(&[1]));
    bytes.push(0);
    bytes.extend([0u8; 64]);
    bytes
}

/// The name, type and value of an attribute.
pub type Stored = (String, String, Vec<u8>);

/// The attributes of a file's first part in their order, and where the header ends.
pub fn header(bytes: &[u8]) -> (Vec<Stored>, usize) {
    let mut at = 8;
    let name = |at: &mut usize| {
        let end = *at + bytes[*at..].iter().position(|b| *b == 0).unwrap();
        let name = String::from_utf8(bytes[*at..end].to_vec()).unwrap();
        *at = end + 1;
        name
    };
    let mut attributes = Vec::new();
    loop {
        let called = name(&mut at);
        if called.is_empty() {
            return (attributes, at);
        }
        let kind = name(&mut at);
        let size = u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        attributes.push((called, kind, bytes[at + 4..at + 4 + size].to_vec()));
        at += 4 + size;
    }
}

/// Adds attributes to a file of one part, before those that it has.
pub fn with_attributes(path: &Path, added: &[(&str, &str, &[u8])]) {
    let mut bytes = fs::read(path).unwrap();
    let mut written = Vec::new();
    for (name, kind, value) in added {
        written.extend([name.as_bytes(), &[0], kind.as_bytes(), &[0]].concat());
        written.extend((value.len() as u32).to_le_bytes());
        written.extend_from_slice(value);
    }
    let end = header(&bytes).1;
    let first = u64::from_le_bytes(bytes[end..end + 8].try_into().unwrap()) as usize;
    for offset in bytes[end..first].as_chunks_mut::<8>().0 {
        *offset = (u64::from_le_bytes(*offset) + written.len() as u64).to_le_bytes();
    }
    bytes.splice(8..8, written);
    fs::write(path, bytes).unwrap();
}

/// Has a file look as if written again after everything else.
pub fn touch_later(path: &Path) {
    let file = fs::File::options().append(true).open(path).unwrap();
    file.set_modified(SystemTime::now() + Duration::from_secs(60)).unwrap();
}
