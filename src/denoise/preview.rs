//! A PNG of the denoised frame, encoded like the display image on which SSIM is measured, and exposed like it by all
//! that is not black.

use std::path::Path;

use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};

use crate::{
    Error, Result,
    frame::write_file,
    metrics::display::{display, exposure_of_lit},
    planes::Planes,
};

/// Writes radiance (3, H, W) as an 8-bit PNG.
///
/// # Errors
/// The file cannot be written.
pub fn write(path: &Path, radiance: &Planes) -> Result<()> {
    // A black frame has no exposure, and any exposure shows it black.
    let image = display(radiance, exposure_of_lit(radiance).unwrap_or(1.0));
    let (r, g, b) = (image.channel(0), image.channel(1), image.channel(2));
    let to_byte = |v: f32| (v * 255.0).round() as u8;
    let pixels: Vec<u8> = (0..image.pixels()).flat_map(|i| [r[i], g[i], b[i]].map(to_byte)).collect();
    let mut png = Vec::new();
    PngEncoder::new(&mut png)
        .write_image(&pixels, radiance.width as u32, radiance.height as u32, ExtendedColorType::Rgb8)
        .map_err(|e| Error::invalid(path, e))?;
    write_file(path, &png)
}
