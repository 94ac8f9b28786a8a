//! Drawing text and shapes into bitmaps and SVG alike, with a font that comes with the program.

use std::{cell::RefCell, path::Path, sync::Once};

use image::{ImageEncoder, RgbImage, codecs::png::PngEncoder, imageops::FilterType};
use plotters::{
    coord::Shift,
    prelude::*,
    style::text_anchor::{HPos, Pos, VPos},
    style::{FontStyle, register_font},
};

use crate::{Error, Result, frame::write_file};

/// Family under which the font is registered; SVG viewers use their own font of this family.
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
    /// The texts of a bitmap, which are drawn last, and finer than plotters would draw them. None for SVG,
    /// where plotters' backend gets each text at once.
    deferred: Option<RefCell<Vec<Text>>>,
}

/// A text to be drawn.
struct Text {
    text: String,
    at: (i32, i32),
    anchor: Anchor,
    is_vertical: bool,
    style: Style,
}

impl<B: DrawingBackend> Canvas<'_, B> {
    /// Text whose vertical centre is at `y`.
    pub fn text(&self, text: &str, at: (i32, i32), anchor: Anchor, style: Style) -> Result<()> {
        self.draw_text(Text { text: text.into(), at, anchor, is_vertical: false, style })
    }

    /// Text that reads from bottom to top, centred on the point.
    pub fn vertical_text(&self, text: &str, at: (i32, i32), style: Style) -> Result<()> {
        self.draw_text(Text { text: text.into(), at, anchor: Anchor::Centre, is_vertical: true, style })
    }

    fn draw_text(&self, text: Text) -> Result<()> {
        if let Some(deferred) = &self.deferred {
            deferred.borrow_mut().push(text);
            return Ok(());
        }
        let horizontal = match text.anchor {
            Anchor::Left => HPos::Left,
            Anchor::Centre => HPos::Center,
            Anchor::Right => HPos::Right,
        };
        let mut style = text.style.plotters().pos(Pos::new(horizontal, VPos::Center));
        if text.is_vertical {
            style.font = style.font.transform(FontTransform::Rotate270);
        }
        self.area.draw_text(&text.text, &style, text.at).map_err(failed)
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

/// Draws on an RGB image, texts above everything else.
pub fn draw_on(image: &mut RgbImage, draw: impl FnOnce(&Canvas<BitMapBackend>) -> Result<()>) -> Result<()> {
    let size = image.dimensions();
    let texts = {
        let area = BitMapBackend::with_buffer(image.as_mut(), size).into_drawing_area();
        let canvas = Canvas { area: &area, deferred: Some(RefCell::default()) };
        draw(&canvas)?;
        area.present().map_err(failed)?;
        canvas.deferred.map(RefCell::into_inner).unwrap_or_default()
    };
    texts.iter().try_for_each(|text| blend_text(image, text))
}

/// Draws a text at several times its size and averages it down: plotters puts glyphs on whole pixels, which
/// spaces the letters of small words unevenly.
fn blend_text(image: &mut RgbImage, text: &Text) -> Result<()> {
    const FINE: u32 = 4;
    let fine = Style { size: text.style.size * FINE, colour: WHITE, ..text.style };
    let (width, height) = fine.measure(&text.text);
    // Room for glyphs that reach beyond the measured box, as capitals do.
    let (width, height) = (width as u32 / FINE + 3, (height as u32 / FINE).max(text.style.size) * 3 / 2);
    let mut scratch = RgbImage::new(width * FINE, height * FINE);
    let size = scratch.dimensions();
    {
        let area = BitMapBackend::with_buffer(scratch.as_mut(), size).into_drawing_area();
        let style = fine.plotters().pos(Pos::new(HPos::Center, VPos::Center));
        area.draw_text(&text.text, &style, ((size.0 / 2) as i32, (size.1 / 2) as i32)).map_err(failed)?;
        area.present().map_err(failed)?;
    }
    let mut coverage = image::imageops::resize(&scratch, width, height, FilterType::Triangle);
    if text.is_vertical {
        coverage = image::imageops::rotate270(&coverage);
    }
    let (width, height) = (coverage.width() as i32, coverage.height() as i32);
    let left = match text.anchor {
        Anchor::Left => text.at.0 - 1,
        Anchor::Centre => text.at.0 - width / 2,
        Anchor::Right => text.at.0 - width + 1,
    };
    let top = text.at.1 - height / 2;
    let colour = [text.style.colour.0, text.style.colour.1, text.style.colour.2];
    for (x, y, covered) in coverage.enumerate_pixels() {
        let (Ok(x), Ok(y)) = (u32::try_from(left + x as i32), u32::try_from(top + y as i32)) else {
            continue;
        };
        let Some(pixel) = image.get_pixel_mut_checked(x, y) else { continue };
        let share = f32::from(covered[0]) / 255.0;
        for (below, above) in pixel.0.iter_mut().zip(colour) {
            *below = (f32::from(*below) * (1.0 - share) + f32::from(above) * share).round() as u8;
        }
    }
    Ok(())
}

/// An SVG document.
pub fn draw_svg(size: (u32, u32), draw: impl FnOnce(&Canvas<SVGBackend>) -> Result<()>) -> Result<String> {
    let mut text = String::new();
    {
        let area = SVGBackend::with_string(&mut text, size).into_drawing_area();
        draw(&Canvas { area: &area, deferred: None })?;
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
