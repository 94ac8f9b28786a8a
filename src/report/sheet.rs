//! A comparison sheet: one pair, every method side by side, with error maps and enlarged details.
//!
//! A column is an image: the noisy input, each method, the reference. Its rows: the frame, its error
//! map, three details where the methods differ most, and the scores. All columns share one exposure,
//! one error scale and the same details, so that what differs in the sheet differs in the images.

use std::{collections::HashMap, path::Path};

use image::{Rgb, RgbImage, imageops};
use plotters::prelude::{DrawingBackend, RGBColor};

use super::{
    NOISY,
    canvas::{Anchor, Canvas, Style, draw_on, write_png},
    chart::number_label,
    rows::Row,
};
use crate::{
    Result,
    metrics::{display, error},
    planes::Planes,
    testset::Pair,
};

/// Columns side by side; further ones go into another band below.
const BAND: usize = 7;
/// Width of a cell in pixels.
const CELL: u32 = 300;
/// Space between cells.
const GAP: u32 = 6;
/// Height of the title, of a column's name and of its scores.
const TITLE: u32 = 44;
const NAME: u32 = 26;
const SCORES: u32 = 66;
/// The number of details, each a sixth as wide and as high as the frame.
const DETAILS: usize = 3;
const DETAIL_SHARE: usize = 6;
/// Colours of the outlines around the details, in the whole image too.
const DETAIL_COLOURS: [RGBColor; DETAILS] =
    [RGBColor(255, 190, 0), RGBColor(0, 200, 230), RGBColor(255, 90, 180)];
/// Relative squared error of a pixel at the dark and the bright end of the error maps.
const ERROR_RANGE: (f64, f64) = (1e-4, 10.0);
/// Dark to bright, evenly spaced: the "inferno" map of matplotlib (Smith and van der Walt, CC0), sampled.
const ERROR_COLOURS: [[u8; 3]; 9] = [
    [0, 0, 4],
    [31, 12, 72],
    [85, 15, 109],
    [136, 34, 106],
    [186, 54, 85],
    [227, 89, 51],
    [249, 140, 10],
    [249, 201, 50],
    [252, 255, 164],
];
/// Colours of what lies between pictures, and of text on it.
pub const BACKGROUND: Rgb<u8> = Rgb([24, 24, 27]);
pub const TEXT: RGBColor = RGBColor(235, 235, 235);
const FAINT: RGBColor = RGBColor(165, 165, 170);

/// An image as a sheet needs it.
pub struct Shown {
    name: String,
    /// At the reference's exposure.
    frame: RgbImage,
    /// RelMSE of each pixel.
    errors: Vec<f64>,
}

impl Shown {
    /// Keeps what the sheet shows of a method's output.
    pub fn new(name: &str, image: &Planes, reference: &Planes) -> Self {
        Self {
            name: name.into(),
            frame: display_image(image, reference),
            errors: error::relmse_map(image, reference),
        }
    }

    /// The method's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The frame as it is displayed.
    pub fn frame(&self) -> &RgbImage {
        &self.frame
    }
}

/// `image` at the display exposure of the reference, or without any where the reference is black.
fn display_image(image: &Planes, reference: &Planes) -> RgbImage {
    let exposure = display::exposure(reference).unwrap_or(1.0);
    let n = image.pixels();
    RgbImage::from_fn(image.width as u32, image.height as u32, |x, y| {
        let at = y as usize * image.width + x as usize;
        Rgb([0, 1, 2].map(|c| (display::encode(image.data[c * n + at], exposure) * 255.0).round() as u8))
    })
}

/// A rectangle of pixels of the frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Detail {
    x: usize,
    y: usize,
    width: usize,
    height: usize,
}

impl Detail {
    fn overlaps(&self, other: &Self) -> bool {
        self.x < other.x + other.width
            && other.x < self.x + self.width
            && self.y < other.y + other.height
            && other.y < self.y + self.height
    }
}

/// Up to three details, apart from each other, where the methods' errors differ most. The noisy input counts
/// as a method only where there are fewer than two others, or where these agree everywhere.
fn details(images: &[Shown], width: usize, height: usize) -> Vec<Detail> {
    let methods: Vec<&Shown> = images.iter().filter(|i| i.name != NOISY).collect();
    let compared: Vec<&Shown> = if methods.len() < 2 { images.iter().collect() } else { methods };
    // Where the methods agree everywhere, they are compared with the input.
    let differ = compared.windows(2).any(|pair| pair[0].errors != pair[1].errors);
    let compared: Vec<&Shown> = if differ { compared } else { images.iter().collect() };
    let (w, h) = ((width / DETAIL_SHARE).max(16).min(width), (height / DETAIL_SHARE).max(9).min(height));
    let steps = |size: usize, part: usize| {
        let stride = (part / 2).max(1);
        (0..=(size - part) / stride).map(move |i| i * stride)
    };
    let mut candidates: Vec<(f64, Detail)> = steps(height, h)
        .flat_map(|y| steps(width, w).map(move |x| Detail { x, y, width: w, height: h }))
        .map(|detail| {
            let means = compared.iter().map(|image| {
                // Errors are capped, so that a firefly does not draw the details of every sheet to itself.
                let rows = (detail.y..detail.y + h).map(|y| &image.errors[y * width + detail.x..][..w]);
                rows.flatten().map(|e| e.min(1.0)).sum::<f64>() / (w * h) as f64
            });
            let (low, high) = means.fold((f64::MAX, f64::MIN), |(l, h), m| (l.min(m), h.max(m)));
            (high - low, detail)
        })
        .collect();
    candidates.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut chosen: Vec<Detail> = Vec::new();
    for (_, detail) in candidates {
        if chosen.len() < DETAILS && chosen.iter().all(|c| !c.overlaps(&detail)) {
            chosen.push(detail);
        }
    }
    chosen
}

/// Colour of a pixel's error on the one logarithmic scale.
fn error_colour(error: f64) -> Rgb<u8> {
    let (low, high) = (ERROR_RANGE.0.log10(), ERROR_RANGE.1.log10());
    let share = ((error.max(1e-30).log10() - low) / (high - low)).clamp(0.0, 1.0);
    let place = share * (ERROR_COLOURS.len() - 1) as f64;
    let (at, fraction) = ((place as usize).min(ERROR_COLOURS.len() - 2), place - place.floor());
    let fraction = if place as usize > at { 1.0 } else { fraction };
    let (a, b) = (ERROR_COLOURS[at], ERROR_COLOURS[at + 1]);
    Rgb([0, 1, 2].map(|c| (f64::from(a[c]) + (f64::from(b[c]) - f64::from(a[c])) * fraction).round() as u8))
}

/// Scales an image to a cell: a small one by repeating pixels, a large one by averaging.
fn to_cell(image: &RgbImage, width: u32, height: u32) -> RgbImage {
    let filter =
        if image.width() < width { imageops::FilterType::Nearest } else { imageops::FilterType::Triangle };
    imageops::resize(image, width, height, filter)
}

/// Writes the sheet of `pair`; `rows` are the finished rows by method.
///
/// # Errors
/// The file cannot be written.
pub fn write(
    path: &Path,
    pair: &Pair,
    reference: &Planes,
    images: &[Shown],
    rows: &HashMap<&str, &Row>,
) -> Result<()> {
    let layout = Layout::new(images, reference);
    let mut sheet = RgbImage::from_pixel(layout.size().0, layout.size().1, BACKGROUND);
    layout.paste(&mut sheet, images, &display_image(reference, reference));
    layout.paste_scale(&mut sheet);
    draw_on(&mut sheet, |canvas| {
        let frame = pair.frame.as_ref().map(|f| format!(", frame {f}")).unwrap_or_default();
        let title = format!("{}{frame}, {} samples per pixel", pair.scene, pair.spp);
        canvas.text(&title, (GAP as i32 + 2, TITLE as i32 / 2), Anchor::Left, style(20, TEXT, true))?;
        layout.label_scale(canvas)?;
        for (column, image) in images.iter().enumerate() {
            layout.label(canvas, column, &image.name, rows.get(image.name.as_str()).copied())?;
        }
        layout.label(canvas, images.len(), "reference", None)
    })?;
    write_png(path, &sheet)
}

fn style(size: u32, colour: RGBColor, bold: bool) -> Style {
    Style { colour, bold, ..Style::new(size) }
}

/// Where things are on a sheet.
struct Layout {
    /// Images, and the reference in the last column.
    columns: usize,
    details: Vec<Detail>,
    /// Width and height of the frame.
    frame: (usize, usize),
    cell_height: u32,
}

impl Layout {
    fn new(images: &[Shown], reference: &Planes) -> Self {
        let (width, height) = (reference.width, reference.height);
        Self {
            columns: images.len() + 1,
            details: details(images, width, height),
            frame: (width, height),
            cell_height: (CELL as usize * height / width).clamp(24, 3 * CELL as usize) as u32,
        }
    }

    /// Lines of cells in a band: frames, error maps and details.
    fn lines(&self) -> u32 {
        2 + self.details.len() as u32
    }

    fn band_height(&self) -> u32 {
        NAME + self.lines() * (self.cell_height + GAP) + SCORES
    }

    /// Width and height of the sheet.
    fn size(&self) -> (u32, u32) {
        let width = self.columns.min(BAND) as u32 * (CELL + GAP) + GAP;
        (width, TITLE + self.columns.div_ceil(BAND) as u32 * self.band_height())
    }

    /// The left upper corner of a cell.
    fn corner(&self, column: usize, line: u32) -> (u32, u32) {
        let x = GAP + (column % BAND) as u32 * (CELL + GAP);
        let band = TITLE + (column / BAND) as u32 * self.band_height();
        (x, band + NAME + line * (self.cell_height + GAP))
    }

    /// Left, top, width and height of the scale of errors. The reference has no error map: the scale stands in its
    /// place.
    fn scale(&self) -> (u32, u32, u32, u32) {
        let (x, y) = self.corner(self.columns - 1, 1);
        (x + 20, y + self.cell_height / 2 - 14, CELL - 40, 18)
    }

    /// Fills the cells: every frame with its error map and details.
    fn paste(&self, sheet: &mut RgbImage, images: &[Shown], reference: &RgbImage) {
        let frames = images.iter().map(|image| &image.frame).chain([reference]);
        for (column, frame) in frames.enumerate() {
            let mut paste = |line: u32, image: &RgbImage| {
                let (x, y) = self.corner(column, line);
                imageops::replace(sheet, &to_cell(image, CELL, self.cell_height), x.into(), y.into());
            };
            paste(0, frame);
            for (line, d) in (2..).zip(&self.details) {
                let [x, y, w, h] = [d.x, d.y, d.width, d.height].map(|v| v as u32);
                paste(line, &imageops::crop_imm(frame, x, y, w, h).to_image());
            }
            if let Some(image) = images.get(column) {
                let (w, h) = (self.frame.0 as u32, self.frame.1 as u32);
                let colour = |x, y| error_colour(image.errors[(y * w + x) as usize]);
                paste(1, &RgbImage::from_fn(w, h, colour));
            }
        }
    }

    fn paste_scale(&self, sheet: &mut RgbImage) {
        let (left, top, width, height) = self.scale();
        let (low, high) = (ERROR_RANGE.0.log10(), ERROR_RANGE.1.log10());
        let last = self.size().1 - 1;
        for x in 0..width {
            let share = f64::from(x) / f64::from(width - 1);
            let colour = error_colour(10f64.powf(low + share * (high - low)));
            (0..height).for_each(|y| sheet.put_pixel(left + x, (top + y).min(last), colour));
        }
    }

    fn label_scale<B: DrawingBackend>(&self, canvas: &Canvas<B>) -> Result<()> {
        let (x, y, w, h) = self.scale();
        let (x, y, w, h) = (x as i32, y as i32, w as i32, h as i32);
        let said = "squared relative error of a pixel";
        canvas.text(said, (x + w / 2, y - 14), Anchor::Centre, style(13, TEXT, false))?;
        let decades = (ERROR_RANGE.1 / ERROR_RANGE.0).log10().round() as i32;
        for i in 0..=decades {
            let label = format!("{}", ERROR_RANGE.0 * 10f64.powi(i));
            let label = label.chars().take(6).collect::<String>();
            canvas.text(
                &label,
                (x + i * w / decades, y + h + 12),
                Anchor::Centre,
                style(11, FAINT, false),
            )?;
        }
        Ok(())
    }

    /// Writes a column's name and scores, and outlines its details.
    fn label<B: DrawingBackend>(
        &self,
        canvas: &Canvas<B>,
        column: usize,
        name: &str,
        row: Option<&Row>,
    ) -> Result<()> {
        let (left, top) = self.corner(column, 0);
        let (left, top) = (left as i32, top as i32);
        let place = (left + 2, top - NAME as i32 / 2);
        canvas.text(&fit(name, 16), place, Anchor::Left, style(16, TEXT, true))?;
        for (line, (d, colour)) in (2..).zip(self.details.iter().zip(DETAIL_COLOURS)) {
            let across = |v: usize| (v * CELL as usize / self.frame.0) as i32;
            let down = |v: usize| (v * self.cell_height as usize / self.frame.1) as i32;
            let (x, y) = (left + across(d.x), top + down(d.y));
            canvas.frame([(x, y), (x + across(d.width) - 1, y + down(d.height) - 1)], colour, 2)?;
            let (x, y) = self.corner(column, line);
            let (x, y) = (x as i32, y as i32);
            canvas.frame([(x, y), (x + CELL as i32 - 1, y + self.cell_height as i32 - 1)], colour, 2)?;
        }
        let Some(row) = row else { return Ok(()) };
        let below = top + (self.lines() * (self.cell_height + GAP)) as i32;
        let value = |v: Option<f64>, digits: usize| v.map_or("-".into(), |v| format!("{v:.digits$}"));
        let relmse = row.relmse.map_or("-".into(), number_label);
        let first = format!("RelMSE {relmse}   SSIM {}", value(row.ssim, 4));
        let second = match row.seconds {
            Some(seconds) => format!("FLIP {}   {}", value(row.flip, 3), duration(seconds)),
            None => format!("FLIP {}", value(row.flip, 3)),
        };
        canvas.text(&first, (left + 2, below + 12), Anchor::Left, style(15, TEXT, false))?;
        canvas.text(&second, (left + 2, below + 34), Anchor::Left, style(15, FAINT, false))
    }
}

/// A time in milliseconds, or in seconds from ten on.
fn duration(seconds: f64) -> String {
    if seconds < 10.0 { format!("{:.0} ms", seconds * 1e3) } else { format!("{seconds:.1} s") }
}

/// `name`, cut where it is wider than a cell.
fn fit(name: &str, size: u32) -> String {
    let style = Style { bold: true, ..Style::new(size) };
    let mut text = name.to_string();
    while style.measure(&text).0 > CELL as i32 - 4 && text.chars().count() > 4 {
        // The end of a path tells models apart; its start does not.
        text = format!("…{}", text.chars().skip(2).collect::<String>());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(name: &str, errors: Vec<f64>) -> Shown {
        Shown { name: name.into(), frame: RgbImage::new(96, 54), errors }
    }

    #[test]
    fn details_are_where_methods_differ_and_apart() {
        let (width, height) = (96, 54);
        let mut a = vec![0.1; width * height];
        for y in 30..36 {
            for x in 70..80 {
                a[y * width + x] = 0.9;
            }
        }
        let noisy = |rows: usize| {
            let mut errors = vec![0.1; width * height];
            errors[..rows * width].fill(1.0);
            errors
        };
        let images = [shown(NOISY, noisy(20)), shown("a", a), shown("b", vec![0.1; width * height])];
        let found = details(&images, width, height);
        assert_eq!(found.len(), DETAILS);
        let first = found[0];
        assert!((58..=80).contains(&first.x) && (25..=36).contains(&first.y), "{first:?}");
        for (i, a) in found.iter().enumerate() {
            assert!(found[i + 1..].iter().all(|b| !a.overlaps(b)));
        }
        let one = details(&images[..2], width, height);
        assert!(one[0].y < 20, "with one method, where it differs from the input: {:?}", one[0]);
        let alike = [shown(NOISY, noisy(20)), shown("a", vec![0.1; 96 * 54]), shown("b", vec![0.1; 96 * 54])];
        assert!(details(&alike, width, height)[0].y < 20, "methods that agree");
        assert_eq!(details(&[], 1, 1).len(), 1, "the smallest frame");
    }

    #[test]
    fn error_colours_run_from_dark_to_bright() {
        let brightness = |e: f64| error_colour(e).0.iter().map(|v| u32::from(*v)).sum::<u32>();
        assert_eq!(error_colour(0.0).0, ERROR_COLOURS[0]);
        assert_eq!(error_colour(1e9).0, ERROR_COLOURS[8]);
        let ramp: Vec<u32> = (-8..=2).map(|i| brightness(10f64.powf(f64::from(i) / 2.0))).collect();
        assert!(ramp.windows(2).all(|w| w[0] < w[1]), "{ramp:?}");
    }
}
