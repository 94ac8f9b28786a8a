//! A chart that is written twice: as a bitmap for the README, as SVG for print and the page.

use std::path::Path;

use image::RgbImage;
use plotters::prelude::*;

use super::canvas::{Canvas, draw_on, draw_svg, write_png};
use crate::{Result, frame::write_file};

/// Something that can be drawn on a bitmap and as SVG alike.
pub trait Figure {
    /// Its width and height in pixels.
    fn size(&self) -> (u32, u32);

    /// Draws it on white.
    ///
    /// # Errors
    /// The surface refuses.
    fn draw<B: DrawingBackend>(&self, canvas: &Canvas<B>) -> Result<()>;

    /// Writes `<name>.png` and `<name>.svg` into `out`; returns the SVG document.
    ///
    /// # Errors
    /// A file cannot be written.
    fn write(&self, out: &Path, name: &str) -> Result<String> {
        let (width, height) = self.size();
        let mut image = RgbImage::from_pixel(width, height, image::Rgb([255; 3]));
        draw_on(&mut image, |canvas| self.draw(canvas))?;
        write_png(&out.join(format!("{name}.png")), &image)?;
        let svg = draw_svg((width, height), |canvas| {
            canvas.fill([(0, 0), (width as i32, height as i32)], WHITE)?;
            self.draw(canvas)
        })?;
        write_file(&out.join(format!("{name}.svg")), svg.as_bytes())?;
        Ok(svg)
    }
}
