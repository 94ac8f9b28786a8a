//! Drawing text and shapes into bitmaps and SVG alike, with a font that comes with the program.

use std::{path::Path, sync::Once};

use image::{ImageEncoder, RgbImage, codecs::png::PngEncoder};
use plotters::{
    coord::Shift,
    prelude::*,
    style::text_anchor::{HPos, Pos, VPos},
    style::{FontStyle, register_font},
};

use super::rows::write_file;
use crate::{Error, Result};

/// Family under which the font is registered; SVG viewers use their own of this kind.
const FAMILY: &str = "sans-serif";

/// Horizontal anchor of a text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Anchor {
    /// Starts at the point.
    Left,
    /// Centred on the point.
    Centre,
    /// Ends at the point.
    Right,
}

/// Makes the font known to plotters, once.
fn font() {
    static REGISTERED: Once = Once::new();
    REGISTERED.call_once(|| {
        let known = register_font(FAMILY, FontStyle::Normal, dejavu::sans::regular()).is_ok()
            && register_font(FAMILY, FontStyle::Bold, dejavu::sans::bold()).is_ok();
        assert!(known, "the embedded fonts are valid");
    });
}

/// How text looks.
#[derive(Clone, Copy, Debug)]
pub struct Style {
    /// Height in pixels.
    pub size: u32,
    /// Bold face.
    pub bold: bool,
    /// Colour.
    pub colour: RGBColor,
}

impl Style {
    /// Regular dark text.
    pub const fn new(size: u32) -> Self {
        Self { size, bold: false, colour: RGBColor(35, 35, 40) }
    }

    fn plotters(self) -> TextStyle<'static> {
        font();
        let face = if self.bold { FontStyle::Bold } else { FontStyle::Normal };
        let mut style = TextStyle::from((FAMILY, self.size, face).into_font());
        style.color = self.colour.to_backend_color();
        style
    }

    /// Width and height of `text` in pixels.
    pub fn measure(self, text: &str) -> (i32, i32) {
        let (width, height) = self.plotters().font.box_size(text).expect("the font is registered");
        (width as i32, height as i32)
    }
}

/// A surface to draw on, in pixels from the top left.
pub struct Canvas<'a, B: DrawingBackend> {
    area: &'a DrawingArea<B, Shift>,
}

impl<'a, B: DrawingBackend> Canvas<'a, B> {
    /// Draws on `area`.
    pub fn new(area: &'a DrawingArea<B, Shift>) -> Self {
        Self { area }
    }

    /// Text whose vertical centre is at `y`.
    pub fn text(&self, text: &str, (x, y): (i32, i32), anchor: Anchor, style: Style) -> Result<()> {
        let horizontal = match anchor {
            Anchor::Left => HPos::Left,
            Anchor::Centre => HPos::Center,
            Anchor::Right => HPos::Right,
        };
        let style = style.plotters().pos(Pos::new(horizontal, VPos::Center));
        self.area.draw_text(text, &style, (x, y)).map_err(failed)
    }

    /// Text that reads from bottom to top, centred on the point.
    pub fn vertical_text(&self, text: &str, at: (i32, i32), style: Style) -> Result<()> {
        let mut style = style.plotters().pos(Pos::new(HPos::Center, VPos::Center));
        style.font = style.font.transform(FontTransform::Rotate270);
        self.area.draw_text(text, &style, at).map_err(failed)
    }

    /// A line through `points`.
    pub fn line(&self, points: &[(i32, i32)], colour: RGBColor, width: u32) -> Result<()> {
        let style = ShapeStyle::from(&colour).stroke_width(width);
        self.area.draw(&PathElement::new(points.to_vec(), style)).map_err(failed)
    }

    /// A horizontal line in dashes.
    pub fn dashes(&self, (from, to): (i32, i32), y: i32, colour: RGBColor, width: u32) -> Result<()> {
        let mut x = from;
        while x < to {
            self.line(&[(x, y), ((x + 9).min(to), y)], colour, width)?;
            x += 15;
        }
        Ok(())
    }

    /// A filled disc with a white rim.
    pub fn dot(&self, at: (i32, i32), radius: i32, colour: RGBColor) -> Result<()> {
        self.area.draw(&Circle::new(at, radius + 2, WHITE.filled())).map_err(failed)?;
        self.area.draw(&Circle::new(at, radius, colour.filled())).map_err(failed)
    }

    /// A filled rectangle.
    pub fn fill(&self, corners: [(i32, i32); 2], colour: RGBColor) -> Result<()> {
        self.area.draw(&Rectangle::new(corners, colour.filled())).map_err(failed)
    }

    /// The outline of a rectangle.
    pub fn frame(&self, corners: [(i32, i32); 2], colour: RGBColor, width: u32) -> Result<()> {
        let style = ShapeStyle::from(&colour).stroke_width(width);
        self.area.draw(&Rectangle::new(corners, style)).map_err(failed)
    }
}

fn failed(error: impl std::fmt::Display) -> Error {
    Error::Usage(format!("cannot draw the report: {error}"))
}

/// Draws on an RGB image.
pub fn draw_on(image: &mut RgbImage, draw: impl FnOnce(&Canvas<BitMapBackend>) -> Result<()>) -> Result<()> {
    let size = image.dimensions();
    let area = BitMapBackend::with_buffer(image.as_mut(), size).into_drawing_area();
    draw(&Canvas::new(&area))?;
    area.present().map_err(failed)
}

/// An SVG document.
pub fn draw_svg(size: (u32, u32), draw: impl FnOnce(&Canvas<SVGBackend>) -> Result<()>) -> Result<String> {
    let mut text = String::new();
    {
        let area = SVGBackend::with_string(&mut text, size).into_drawing_area();
        draw(&Canvas::new(&area))?;
        area.present().map_err(failed)?;
    }
    Ok(text)
}

/// Writes a PNG in one step.
pub fn write_png(path: &Path, image: &RgbImage) -> Result<()> {
    let mut bytes = Vec::new();
    let (width, height) = image.dimensions();
    PngEncoder::new(&mut bytes)
        .write_image(image, width, height, image::ExtendedColorType::Rgb8)
        .map_err(|e| Error::invalid(path, format!("cannot be encoded: {e}")))?;
    write_file(path, &bytes)
}
