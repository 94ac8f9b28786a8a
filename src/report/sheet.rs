//! A comparison sheet: one pair, every method side by side, with error maps and enlarged details.
//!
//! A column is an image: the noisy input, each method, the reference. Its rows: the frame, its error
//! map, three details where the methods differ most, and the scores. All columns share one exposure,
//! one error scale and the same details, so that what differs in the sheet differs in the images.

use std::{collections::HashMap, path::Path};

use image::{Rgb, RgbImage, imageops};
use plotters::prelude::RGBColor;

use super::{
    NOISY,
    canvas::{Anchor, Style, draw_on, write_png},
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
    let details = details(images, reference.width, reference.height);
    let cell_height =
        (CELL as usize * reference.height / reference.width).clamp(24, 3 * CELL as usize) as u32;
    let columns = images.len() + 1;
    let lines = 2 + details.len() as u32;
    let band_height = NAME + lines * (cell_height + GAP) + SCORES;
    let per_band = columns.min(BAND);
    let width = per_band as u32 * (CELL + GAP) + GAP;
    let height = TITLE + columns.div_ceil(BAND) as u32 * band_height;
    let mut sheet = RgbImage::from_pixel(width, height, BACKGROUND);
    let corner = |column: usize, line: u32| {
        let x = GAP + (column % BAND) as u32 * (CELL + GAP);
        let y = TITLE + (column / BAND) as u32 * band_height + NAME + line * (cell_height + GAP);
        (x, y)
    };

    let reference_frame = display_image(reference, reference);
    let frames = images.iter().map(|i| &i.frame).chain([&reference_frame]);
    for (column, frame) in frames.enumerate() {
        let mut paste = |line: u32, image: &RgbImage| {
            let (x, y) = corner(column, line);
            imageops::replace(&mut sheet, &to_cell(image, CELL, cell_height), x.into(), y.into());
        };
        paste(0, frame);
        for (i, d) in details.iter().enumerate() {
            let [x, y, w, h] = [d.x, d.y, d.width, d.height].map(|v| v as u32);
            paste(2 + i as u32, &imageops::crop_imm(frame, x, y, w, h).to_image());
        }
        if let Some(image) = images.get(column) {
            let (w, h) = (reference.width as u32, reference.height as u32);
            paste(1, &RgbImage::from_fn(w, h, |x, y| error_colour(image.errors[(y * w + x) as usize])));
        }
    }
    // The reference has no error: the scale stands in its place.
    let (legend_x, legend_y) = corner(columns - 1, 1);
    let bar = (legend_x + 20, legend_y + cell_height / 2 - 14, CELL - 40, 18);
    for x in 0..bar.2 {
        let share = f64::from(x) / f64::from(bar.2 - 1);
        let error =
            10f64.powf(ERROR_RANGE.0.log10() + share * (ERROR_RANGE.1.log10() - ERROR_RANGE.0.log10()));
        for y in 0..bar.3 {
            sheet.put_pixel(bar.0 + x, (bar.1 + y).min(height - 1), error_colour(error));
        }
    }

    draw_on(&mut sheet, |canvas| {
        let text = |size: u32, colour: RGBColor, bold: bool| Style { colour, bold, ..Style::new(size) };
        let frame = pair.frame.as_ref().map(|f| format!(", frame {f}")).unwrap_or_default();
        let title = format!("{}{frame}, {} samples per pixel", pair.scene, pair.spp);
        canvas.text(&title, (GAP as i32 + 2, TITLE as i32 / 2), Anchor::Left, text(20, TEXT, true))?;

        let (x, y, w, h) = (bar.0 as i32, bar.1 as i32, bar.2 as i32, bar.3 as i32);
        canvas.text(
            "squared relative error of a pixel",
            (x + w / 2, y - 14),
            Anchor::Centre,
            text(13, TEXT, false),
        )?;
        let decades = (ERROR_RANGE.1 / ERROR_RANGE.0).log10().round() as i32;
        for i in 0..=decades {
            let label = format!("{}", ERROR_RANGE.0 * 10f64.powi(i));
            let label = label.chars().take(6).collect::<String>();
            canvas.text(&label, (x + i * w / decades, y + h + 12), Anchor::Centre, text(11, FAINT, false))?;
        }

        let names = images.iter().map(|i| i.name.as_str()).chain(["reference"]);
        for (column, name) in names.enumerate() {
            let (left, top) = corner(column, 0);
            let (left, top) = (left as i32, top as i32);
            canvas.text(
                &fit(name, 16),
                (left + 2, top - NAME as i32 / 2),
                Anchor::Left,
                text(16, TEXT, true),
            )?;
            for (i, (d, colour)) in details.iter().zip(DETAIL_COLOURS).enumerate() {
                let at = |v: usize, size: usize, cell: u32| (v * cell as usize / size) as i32;
                let (x, y) = (at(d.x, reference.width, CELL), at(d.y, reference.height, cell_height));
                let (w, h) =
                    (at(d.width, reference.width, CELL), at(d.height, reference.height, cell_height));
                canvas.frame([(left + x, top + y), (left + x + w - 1, top + y + h - 1)], colour, 2)?;
                let (x, y) = corner(column, 2 + i as u32);
                let (x, y) = (x as i32, y as i32);
                canvas.frame([(x, y), (x + CELL as i32 - 1, y + cell_height as i32 - 1)], colour, 2)?;
            }
            // The last column is the reference's, which has no scores.
            let Some(row) = images.get(column).and_then(|_| rows.get(name)) else { continue };
            let below = top + (lines * (cell_height + GAP)) as i32;
            let value = |v: Option<f64>, digits: usize| v.map_or("-".into(), |v| format!("{v:.digits$}"));
            let first = format!("RelMSE {}   SSIM {}", value(row.relmse, 4), value(row.ssim, 4));
            let second = match row.seconds {
                Some(seconds) => format!("FLIP {}   {}", value(row.flip, 3), duration(seconds)),
                None => format!("FLIP {}", value(row.flip, 3)),
            };
            canvas.text(&first, (left + 2, below + 12), Anchor::Left, text(15, TEXT, false))?;
            canvas.text(&second, (left + 2, below + 34), Anchor::Left, text(15, FAINT, false))?;
        }
        Ok(())
    })?;
    write_png(path, &sheet)
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
