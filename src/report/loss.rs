//! `loss.png` of a training run: training loss and validation RelMSE over steps, both logarithmic.

use std::path::Path;

use image::RgbImage;
use plotters::prelude::*;

use super::{
    axis::{Area, Scale, tick_label},
    canvas::{Anchor, Canvas, Style, draw_on, write_png},
    palette::GRID,
};
use crate::{Result, train::LogRow};

const SIZE: (u32, u32) = (1200, 560);
const AREA: Area = Area { left: 90, right: 1176, top: 64, bottom: 500 };
const TRAINING: RGBColor = RGBColor(0, 114, 178);
const VALIDATION: RGBColor = RGBColor(213, 94, 0);

/// Draws the log of a run.
///
/// # Errors
/// The file cannot be written.
pub fn loss_chart(path: &Path, rows: &[LogRow]) -> Result<()> {
    let mut image = RgbImage::from_pixel(SIZE.0, SIZE.1, image::Rgb([255; 3]));
    draw_on(&mut image, |canvas| draw(canvas, rows))?;
    write_png(path, &image)
}

fn draw<B: DrawingBackend>(canvas: &Canvas<B>, rows: &[LogRow]) -> Result<()> {
    let series = |value: fn(&LogRow) -> Option<f64>| -> Vec<(f64, f64)> {
        let points = rows.iter().filter_map(|r| Some((r.step as f64, value(r)?)));
        points.filter(|p| p.1 > 0.0 && p.1.is_finite()).collect()
    };
    let lines = [
        ("training loss", TRAINING, series(|r| r.train_loss)),
        ("validation RelMSE (geometric mean)", VALIDATION, series(|r| r.val_relmse)),
    ];
    let points = || lines.iter().flat_map(|l| &l.2);
    let steps = Scale::new(points().map(|p| p.0), false, (AREA.left, AREA.right));
    let losses = Scale::new(points().map(|p| p.1), true, (AREA.bottom, AREA.top));
    for tick in losses.ticks() {
        let y = losses.at(tick);
        canvas.line(&[(AREA.left, y), (AREA.right, y)], GRID, 1)?;
        canvas.text(&tick_label(tick), (AREA.left - 10, y), Anchor::Right, Style::new(15))?;
    }
    for tick in steps.ticks().into_iter().filter(|t| *t >= 0.0) {
        let x = steps.at(tick);
        canvas.line(&[(x, AREA.top), (x, AREA.bottom)], GRID, 1)?;
        canvas.text(&tick_label(tick), (x, AREA.bottom + 18), Anchor::Centre, Style::new(15))?;
    }
    canvas.text("step", ((AREA.left + AREA.right) / 2, AREA.bottom + 44), Anchor::Centre, Style::new(16))?;
    let mut left = AREA.left;
    for (name, colour, points) in &lines {
        let pixels: Vec<(i32, i32)> = points.iter().map(|&(x, y)| (steps.at(x), losses.at(y))).collect();
        canvas.line(&pixels, *colour, 2)?;
        for &at in &pixels {
            canvas.dot(at, 3, *colour)?;
        }
        canvas.dot((left + 6, AREA.top - 28), 6, *colour)?;
        let style = Style::new(16);
        canvas.text(name, (left + 22, AREA.top - 28), Anchor::Left, style)?;
        left += 22 + style.measure(name).0 + 40;
    }
    Ok(())
}
