//! Parts that hold luminance beside chroma of half the resolution, as OpenEXR's luminance-chroma images do
//! (`Y`, `RY`, `BY`; "Technical Introduction to OpenEXR", Luminance/Chroma Images).
//!
//! In: uncompressed blocks. Out: chroma at full resolution, and the colours that it makes with luminance.

use exr::{
    block::UncompressedBlock,
    compression::Compression as C,
    math::Vec2,
    meta::{BlockDescription, attribute::ChannelDescription, header::Header},
};

use super::decode::read_values;
use crate::kernels::thirds;

/// The distance of chroma's samples in columns and rows.
pub const DISTANCE: usize = 2;

/// The weights of the samples at distances 1, 3, 5 ... to each side in a value between them: a windowed sinc,
/// the filter of OpenEXR's `RgbaYca`.
const WEIGHTS: [f32; 7] = [0.627_123, -0.186_077, 0.087_929, -0.043_159, 0.019_597, -0.007_540, 0.002_128];

/// Whether a channel of that name holds chroma: the differences of red and blue from luminance, over luminance.
pub fn is_chroma(name: &[u8]) -> bool {
    let component = name.rsplit(|byte| *byte == b'.').next().unwrap_or(name);
    component == b"RY" || component == b"BY"
}

/// Whether some channels are stored at less than full resolution.
pub fn is_subsampled(header: &Header) -> bool {
    header.channels.list.iter().any(|channel| channel.sampling != Vec2(1, 1))
}

/// Whether a part with subsampled channels can be decoded: these have half the resolution, the part has even
/// numbers of rows and columns, and the `exr` crate decodes its compression rightly. Version 1.74 takes
/// chroma in B44 for larger than it is, and makes other values of DWA than OpenEXR does.
pub fn is_readable(header: &Header) -> bool {
    let halves = |c: &ChannelDescription| c.sampling == Vec2(DISTANCE, DISTANCE);
    let (origin, size) = (header.own_attributes.layer_position, header.layer_size);
    let is_even = [origin.x(), origin.y()].iter().all(|edge| edge % 2 == 0)
        && [size.width(), size.height()].iter().all(|edge| edge.is_multiple_of(DISTANCE));
    let bytes_of_halved: usize =
        header.channels.list.iter().filter(|c| halves(c)).map(|c| c.sample_type.bytes_per_sample()).sum();
    // A block of several rows that holds no whole number of bytes a pixel is taken for shorter than it is.
    let is_whole = header.compression.scan_lines_per_block() == 1 || bytes_of_halved.is_multiple_of(4);
    let is_lossy = matches!(header.compression, C::B44 | C::B44A | C::DWAA(_) | C::DWAB(_));
    is_even
        && is_whole
        && !is_lossy
        && header.blocks == BlockDescription::ScanLines
        && header.channels.list.iter().all(|c| c.sampling == Vec2(1, 1) || halves(c))
}

/// The weights of red, green and blue in luminance, by which equal parts of them make white, from the
/// coordinates of the primaries and of white in the CIE 1931 diagram.
pub fn weights([xr, yr, xg, yg, xb, yb, xw, yw]: [f32; 8]) -> Option<[f32; 3]> {
    let of = |x: f32, y: f32| [x / y, 1.0, (1.0 - x - y) / y].map(f64::from);
    let (red, green, blue, white) = (of(xr, yr), of(xg, yg), of(xb, yb), of(xw, yw));
    let volume = |a: [f64; 3], b: [f64; 3], c: [f64; 3]| {
        a[0] * (b[1] * c[2] - b[2] * c[1]) - b[0] * (a[1] * c[2] - a[2] * c[1])
            + c[0] * (a[1] * b[2] - a[2] * b[1])
    };
    let whole = volume(red, green, blue);
    let parts = [volume(white, green, blue), volume(red, white, blue), volume(red, green, white)];
    let weights = parts.map(|part| (part / whole) as f32);
    weights.iter().all(|weight| weight.is_finite() && *weight > 0.0).then_some(weights)
}

/// The header with which a block is decompressed. The `exr` crate computes the size of a block from the bytes
/// of a pixel, which depend on how many of the block's rows have chroma.
pub fn of_block(header: &Header, top: usize, size: Vec2<usize>) -> Header {
    let rows = top..top + size.height();
    let bytes: usize = rows.flat_map(|y| row(header, y, size.width())).map(|(_, bytes)| bytes).sum();
    let mut header = header.clone();
    header.channels.bytes_per_pixel = bytes / size.area().max(1);
    header
}

/// The channels that row `y` of a part holds, each with how many bytes it has there.
fn row(header: &Header, y: usize, width: usize) -> impl Iterator<Item = (usize, usize)> {
    let held = header.channels.list.iter().enumerate().filter(move |(_, c)| y.is_multiple_of(c.sampling.y()));
    held.map(move |(index, c)| (index, width / c.sampling.x() * c.sample_type.bytes_per_sample()))
}

/// Writes a block's values of a channel into the plane of the whole part, each where it was sampled.
pub fn copy_block(header: &Header, block: &UncompressedBlock, channel: usize, plane: &mut [f32]) {
    let (at, size) = (block.index.pixel_position, block.index.pixel_size);
    let description = &header.channels.list[channel];
    let mut values = vec![0.0; size.width() / description.sampling.x()];
    let mut start = 0;
    for y in at.y()..at.y() + size.height() {
        for (held, bytes) in row(header, y, size.width()) {
            if held == channel {
                read_values(&block.data[start..start + bytes], description.sample_type, &mut values);
                let row = &mut plane[y * header.layer_size.width() + at.x()..];
                let places = row.iter_mut().step_by(description.sampling.x());
                places.zip(&values).for_each(|(place, value)| *place = *value);
            }
            start += bytes;
        }
    }
}

/// Fills the rows and columns between the samples of a plane. Beyond an edge, its last sample is repeated.
pub fn reconstruct(plane: &mut [f32], width: usize) {
    for row in plane.chunks_mut(width).step_by(DISTANCE) {
        let samples: Vec<f32> = row.iter().step_by(DISTANCE).copied().collect();
        let between = row.iter_mut().skip(1).step_by(DISTANCE).enumerate();
        between.for_each(|(i, value)| *value = middle(i, samples.len(), |at| samples[at]));
    }
    let rows = plane.len() / width;
    for y in (1..rows).step_by(DISTANCE) {
        let (i, samples) = (y / DISTANCE, rows / DISTANCE);
        for x in 0..width {
            plane[y * width + x] = middle(i, samples, |at| plane[at * DISTANCE * width + x]);
        }
    }
}

/// The value halfway between samples `i` and `i + 1` of `count`.
fn middle(i: usize, count: usize, sample: impl Fn(usize) -> f32) -> f32 {
    let weighted = WEIGHTS.iter().enumerate().map(|(step, weight)| {
        weight * (sample(i.saturating_sub(step)) + sample((i + 1 + step).min(count - 1)))
    });
    weighted.sum()
}

/// Turns luminance and chroma, (3, N), into red, green and blue. Chroma is `(R - Y) / Y` and `(B - Y) / Y`,
/// and luminance `Y` the sum of the colours weighted by `weights`.
pub fn to_rgb(planes: &mut [f32], weights: [f32; 3]) {
    let [luminance, red, blue] = thirds(planes);
    for ((y, ry), by) in luminance.iter_mut().zip(red).zip(blue) {
        let (r, b) = ((*ry + 1.0) * *y, (*by + 1.0) * *y);
        let g = (*y - r * weights[0] - b * weights[2]) / weights[1];
        (*y, *ry, *by) = (r, g, b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chroma_between_samples_is_smooth() {
        let (width, height) = (40, 24);
        let wave = |x: usize, y: usize| (x as f32 * 0.3).sin() + (y as f32 * 0.2).cos();
        let mut plane = vec![f32::NAN; width * height];
        for y in (0..height).step_by(2) {
            (0..width).step_by(2).for_each(|x| plane[y * width + x] = wave(x, y));
        }
        reconstruct(&mut plane, width);
        for (y, x) in (8..14).flat_map(|y| (14..26).map(move |x| (y, x))) {
            let off = (plane[y * width + x] - wave(x, y)).abs();
            assert!(off < 0.03, "{x}, {y}: {off}");
        }
        let mut flat = vec![0.25; 36];
        reconstruct(&mut flat, 6);
        assert!(flat.iter().all(|v| (v - 0.25).abs() < 1e-5), "{flat:?}");
    }

    #[test]
    fn one_half_channel_of_half_resolution_is_read_where_a_block_is_a_row() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/containers/luminance_chroma.exr");
        let frame = crate::frame::Frame::read(file).unwrap();
        let mut header = frame.layout(0).unwrap().clone();
        assert!(is_readable(&header));
        let chroma = header.channels.list.iter().position(|c| is_chroma(c.name.as_slice())).unwrap();
        header.channels.list.remove(chroma);
        for (compression, is_read) in
            [(C::ZIP16, false), (C::ZIP1, true), (C::PIZ, false), (C::Uncompressed, true)]
        {
            header.compression = compression;
            assert_eq!(is_readable(&header), is_read, "{compression:?}");
        }
    }

    #[test]
    fn weights_of_primaries() {
        // Rec. 709 and D65 (ITU-R BT.709-6), and ACEScg (S-2014-004).
        let rec709 = weights([0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290]).unwrap();
        let aces = weights([0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767]).unwrap();
        let near = |a: [f32; 3], b: [f32; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-4);
        assert!(near(rec709, [0.2126, 0.7152, 0.0722]), "{rec709:?}");
        assert!(near(aces, [0.27223, 0.67408, 0.05369]), "{aces:?}");
        assert_eq!(weights([0.0; 8]), None);
    }

    #[test]
    fn colours_come_back_from_luminance_and_chroma() {
        let weights = [0.2126, 0.7152, 0.0722];
        let colours = [[0.5f32, 0.25, 2.0], [0.0, 1.0, 0.0], [3.0, 3.0, 3.0]];
        let mut planes = vec![0.0; 9];
        for (i, rgb) in colours.iter().enumerate() {
            let y: f32 = rgb.iter().zip(weights).map(|(v, w)| v * w).sum();
            (planes[i], planes[3 + i], planes[6 + i]) = (y, (rgb[0] - y) / y, (rgb[2] - y) / y);
        }
        to_rgb(&mut planes, weights);
        for (i, rgb) in colours.iter().enumerate() {
            (0..3).for_each(|c| assert!((planes[3 * c + i] - rgb[c]).abs() < 1e-5, "{planes:?}"));
        }
    }
}
