//! Comparison sheets small enough to travel inside the page: JPEG in a `data:` address.

use std::{fs::File, io::BufReader, path::Path};

use base64::{Engine, engine::general_purpose::STANDARD};
use image::{
    DynamicImage,
    codecs::{jpeg::JpegEncoder, png::PngDecoder},
    imageops::FilterType,
};

use crate::{Error, Result};

/// Widths in pixels and JPEG qualities, best first.
const SIZES: [(u32, u8); 5] = [(1800, 80), (1600, 70), (1400, 65), (1200, 60), (900, 55)];
/// The most bytes of JPEG for all sheets of a page, and for one sheet; base64 adds a third.
const ALL: usize = 3_300_000;
const ONE: usize = 450_000;
/// Width in pixels and JPEG quality of a picture made by [`small`].
const SMALL: (u32, u8) = (600, 80);
/// Each sheet may have this many bytes, however many sheets there are: smaller, it would show nothing.
const LEAST: usize = 60_000;

/// An image inside the page.
pub struct Picture {
    /// `data:image/jpeg;base64,...`
    pub address: String,
    /// Width and height in pixels.
    pub size: (u32, u32),
}

/// The sheet in `path`, as large as a page of `count` such sheets can carry.
///
/// # Errors
/// The file is unreadable.
pub fn embed(path: &Path, count: usize) -> Result<Picture> {
    let image = open(path)?;
    let budget = (ALL / count.max(1)).clamp(LEAST, ONE);
    let (mut jpeg, mut size) = (Vec::new(), (0, 0));
    let mut last = None;
    for (at, (width, quality)) in SIZES.into_iter().enumerate() {
        // Bytes grow roughly as the number of pixels to the power 0.8, times the quality. Sizes that cannot
        // fit are skipped.
        let hopeless = last.is_some_and(|(bytes, w, q): (usize, u32, u8)| {
            let fewer = (f64::from(width) / f64::from(w)).powf(1.6) * f64::from(quality) / f64::from(q);
            bytes as f64 * fewer > 1.2 * budget as f64
        });
        if hopeless && at + 1 < SIZES.len() {
            continue;
        }
        let small = shrink(&image, width);
        jpeg.clear();
        small
            .write_with_encoder(JpegEncoder::new_with_quality(&mut jpeg, quality))
            .map_err(|e| Error::invalid(path, format!("cannot be encoded: {e}")))?;
        size = (small.width(), small.height());
        last = Some((jpeg.len(), width, quality));
        if jpeg.len() <= budget {
            break;
        }
    }
    Ok(Picture { address: address(&jpeg), size })
}

/// The picture in `path`, shrunk to at most half the width of a page.
///
/// # Errors
/// The file is unreadable.
pub fn small(path: &Path) -> Result<Picture> {
    let image = open(path)?;
    let small = shrink(&image, SMALL.0);
    let mut jpeg = Vec::new();
    small
        .write_with_encoder(JpegEncoder::new_with_quality(&mut jpeg, SMALL.1))
        .map_err(|e| Error::invalid(path, format!("cannot be encoded: {e}")))?;
    Ok(Picture { address: address(&jpeg), size: (small.width(), small.height()) })
}

/// A PNG from disk.
///
/// # Errors
/// The file is unreadable.
pub fn open(path: &Path) -> Result<DynamicImage> {
    let file = BufReader::new(File::open(path).map_err(Error::io("read", path))?);
    PngDecoder::new(file)
        .and_then(DynamicImage::from_decoder)
        .map_err(|e| Error::invalid(path, format!("{e}; remove it and run again")))
}

fn address(jpeg: &[u8]) -> String {
    format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg))
}

fn shrink(image: &DynamicImage, width: u32) -> DynamicImage {
    if image.width() <= width {
        return image.clone();
    }
    image.resize(width, u32::MAX, FilterType::Triangle)
}

#[cfg(test)]
mod tests {
    use image::RgbImage;

    use super::*;

    #[test]
    fn even_noise_fits_the_budget_of_ten_scenes() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("sheet.png");
        let mut state = 1u32;
        let noise = RgbImage::from_fn(2148, 1006, |_, _| {
            image::Rgb([0; 3].map(|_: u8| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 24) as u8
            }))
        });
        noise.save(&path).unwrap();
        let picture = embed(&path, 10).unwrap();
        assert!(picture.address.len() < 460_000, "{}", picture.address.len());
        let bytes = STANDARD.decode(picture.address.rsplit_once(',').unwrap().1).unwrap();
        let shown = image::load_from_memory(&bytes).unwrap();
        assert_eq!((shown.width(), shown.height()), picture.size);
        assert_eq!(picture.size.1, (picture.size.0 as f32 * 1006.0 / 2148.0).round() as u32);
    }
}
