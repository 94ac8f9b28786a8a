//! `speed_vs_accuracy`: time against RelMSE and against SSIM, each with its Pareto front.
//!
//! A point is a method over the common scenes: geometric means of time and RelMSE, the mean of SSIM.
//! The noisy input takes no time and stands as a dashed line.

use std::path::Path;

use image::RgbImage;
use plotters::prelude::*;

use super::{
    NOISY,
    axis::{Area, Scale, tick_label},
    canvas::{Anchor, Canvas, Style, draw_on, draw_svg, write_png},
    rows::write_file,
    summary::Method,
};
use crate::Result;

/// Pixels of the chart.
pub const SIZE: (u32, u32) = (1600, 760);
const INK: RGBColor = RGBColor(35, 35, 40);
const GRID: RGBColor = RGBColor(228, 228, 232);
const FRONT: RGBColor = RGBColor(150, 150, 160);
const NOISY_LINE: RGBColor = RGBColor(185, 60, 50);
/// Told apart with normal and with red-green deficient sight (Okabe and Ito, "Color Universal
/// Design", 2008).
const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
    RGBColor(90, 90, 90),
];

/// A method's place in one panel.
#[derive(Clone, Debug, PartialEq)]
struct Point {
    name: String,
    time: f64,
    score: f64,
    colour: RGBColor,
}

/// One of the two diagrams.
struct Panel {
    title: &'static str,
    axis: &'static str,
    /// Vertical axis logarithmic, and lower is better; otherwise linear, and higher is better.
    is_error: bool,
    points: Vec<Point>,
    noisy: Option<f64>,
}

/// Writes `speed_vs_accuracy.png` and `.svg` into `out`.
///
/// # Errors
/// A file cannot be written.
pub fn write(out: &Path, summaries: &[Method], threads: usize) -> Result<()> {
    let summaries: Vec<&Method> = summaries.iter().filter(|s| s.spp.is_none()).collect();
    let panels = [
        Panel::new(&summaries, "RelMSE over time", "RelMSE (geometric mean; lower is better)", true, |s| {
            s.of("relmse").geomean
        }),
        Panel::new(&summaries, "SSIM over time", "SSIM (mean; higher is better)", false, |s| {
            s.of("ssim").mean
        }),
    ];
    let scenes = summaries.iter().map(|s| s.scenes).max().unwrap_or(0);
    let title = format!(
        "Speed and accuracy over {scenes} render{}, {threads} thread{}",
        if scenes == 1 { "" } else { "s" },
        if threads == 1 { "" } else { "s" }
    );
    let mut image = RgbImage::from_pixel(SIZE.0, SIZE.1, image::Rgb([255; 3]));
    draw_on(&mut image, |canvas| draw(canvas, &title, &panels))?;
    write_png(&out.join("speed_vs_accuracy.png"), &image)?;
    let svg = draw_svg(SIZE, |canvas| {
        canvas.fill([(0, 0), (SIZE.0 as i32, SIZE.1 as i32)], WHITE)?;
        draw(canvas, &title, &panels)
    })?;
    write_file(&out.join("speed_vs_accuracy.svg"), svg.as_bytes())
}

fn draw<B: DrawingBackend>(canvas: &Canvas<B>, title: &str, panels: &[Panel; 2]) -> Result<()> {
    let (width, height) = (SIZE.0 as i32, SIZE.1 as i32);
    canvas.text(title, (width / 2, 28), Anchor::Centre, Style { bold: true, ..Style::new(22) })?;
    let half = width / 2;
    for (i, panel) in panels.iter().enumerate() {
        let left = i as i32 * half;
        panel
            .draw(canvas, Area { left: left + 92, right: left + half - 24, top: 96, bottom: height - 76 })?;
    }
    Ok(())
}

/// A score to three significant digits.
fn number_label(value: f64) -> String {
    let decimals = (2 - value.abs().max(1e-9).log10().floor() as i32).clamp(0, 8) as usize;
    format!("{value:.decimals$}")
}

impl Panel {
    fn new(
        summaries: &[&Method],
        title: &'static str,
        axis: &'static str,
        is_error: bool,
        score: impl Fn(&Method) -> Option<f64>,
    ) -> Self {
        // A logarithmic axis has no zero.
        let score = |s: &Method| score(s).filter(|v| !is_error || *v > 0.0);
        let points = summaries.iter().enumerate().filter_map(|(i, s)| {
            let time = s.of("ms_per_mpx").geomean.filter(|t| *t > 0.0)?;
            Some(Point { name: s.model.clone(), time, score: score(s)?, colour: COLOURS[i % COLOURS.len()] })
        });
        let noisy = summaries.iter().find(|s| s.model == NOISY).and_then(|s| score(s));
        Self { title, axis, is_error, points: points.collect(), noisy }
    }

    /// Points that no other one beats in time and score, fastest first.
    fn front(&self) -> Vec<&Point> {
        let mut sorted: Vec<&Point> = self.points.iter().collect();
        let cost = |p: &Point| if self.is_error { p.score } else { -p.score };
        sorted.sort_by(|a, b| a.time.total_cmp(&b.time).then(cost(a).total_cmp(&cost(b))));
        let mut best = f64::INFINITY;
        sorted.retain(|p| {
            let better = cost(p) < best;
            best = best.min(cost(p));
            better
        });
        sorted
    }

    fn draw<B: DrawingBackend>(&self, canvas: &Canvas<B>, area: Area) -> Result<()> {
        let Area { left, right, top, bottom } = area;
        let heading = Style { bold: true, ..Style::new(17) };
        canvas.text(self.title, (left, top - 24), Anchor::Left, heading)?;
        if self.points.is_empty() {
            let middle = ((left + right) / 2, (top + bottom) / 2);
            canvas.frame([(left, top), (right, bottom)], GRID, 1)?;
            return canvas.text(
                "no method has both a time and a score",
                middle,
                Anchor::Centre,
                Style::new(15),
            );
        }
        let x = Scale::new(self.points.iter().map(|p| p.time), true, (left, right));
        let scores = self.points.iter().map(|p| p.score);
        let y = Scale::new(scores.clone(), self.is_error, (bottom, top));
        // The noisy input sets the scale only where that leaves the methods their room.
        let with_noisy = Scale::new(scores.chain(self.noisy), self.is_error, (bottom, top));
        let y = if with_noisy.span() < 2.0 * y.span() { with_noisy } else { y };
        let small = Style::new(14);
        for tick in x.ticks() {
            canvas.line(&[(x.at(tick), top), (x.at(tick), bottom)], GRID, 1)?;
            canvas.text(&tick_label(tick), (x.at(tick), bottom + 16), Anchor::Centre, small)?;
        }
        for tick in y.ticks() {
            canvas.line(&[(left, y.at(tick)), (right, y.at(tick))], GRID, 1)?;
            canvas.text(&tick_label(tick), (left - 8, y.at(tick)), Anchor::Right, small)?;
        }
        canvas.line(&[(left, top), (left, bottom), (right, bottom)], INK, 1)?;
        let middle = (left + right) / 2;
        canvas.text(
            "milliseconds per megapixel (geometric mean, logarithmic)",
            (middle, bottom + 46),
            Anchor::Centre,
            Style::new(15),
        )?;
        canvas.vertical_text(self.axis, (left - 74, (top + bottom) / 2), Style::new(15))?;

        let mut taken = Vec::new();
        if let Some(noisy) = self.noisy {
            let inside = top + 3 < y.at(noisy) && y.at(noisy) < bottom - 3;
            // Off the scale, the line stands at the edge beyond which it lies.
            let at = y.at(noisy).clamp(top + 3, bottom - 3);
            canvas.dashes((left, right), at, NOISY_LINE, 2)?;
            let text =
                format!("noisy input {}{}", number_label(noisy), if inside { "" } else { ", off the scale" });
            let style = Style { colour: NOISY_LINE, ..Style::new(14) };
            let (w, h) = style.measure(&text);
            let text_at = (right - 6, if at < (top + bottom) / 2 { at + 14 } else { at - 14 });
            canvas.text(&text, text_at, Anchor::Right, style)?;
            taken.push(Rect::around((text_at.0 - w / 2, text_at.1), w + 8, h + 6));
            taken.push(Rect { left, right, top: at - 2, bottom: at + 2 });
        }
        // Between two points of the front, the faster one is the best to be had for the time.
        let front: Vec<(i32, i32)> = self.front().iter().map(|p| (x.at(p.time), y.at(p.score))).collect();
        let steps: Vec<(i32, i32)> = front
            .windows(2)
            .flat_map(|w| [w[0], (w[1].0, w[0].1)])
            .chain(front.last().copied())
            .chain(front.last().map(|p| (right, p.1)))
            .collect();
        canvas.line(&steps, FRONT, 2)?;
        for line in steps.windows(2) {
            taken.push(Rect::between(line[0], line[1]));
        }
        let places: Vec<(i32, i32)> = self.points.iter().map(|p| (x.at(p.time), y.at(p.score))).collect();
        taken.extend(places.iter().map(|&at| Rect::around(at, 16, 16)));
        let labels = place_labels(&places, &self.points, area, taken);
        for ((point, &at), label) in self.points.iter().zip(&places).zip(&labels) {
            // A label that had to move away keeps a line to its point.
            if label.distance(at) > 14 {
                canvas.line(&[at, label.nearest(at)], point.colour, 1)?;
            }
        }
        for ((point, &at), label) in self.points.iter().zip(&places).zip(labels) {
            canvas.dot(at, 6, point.colour)?;
            let style = Style { colour: point.colour, bold: true, ..LABEL };
            canvas.text(&point.name, label.centre(), Anchor::Centre, style)?;
        }
        let note = "grey line: Pareto front";
        canvas.text(note, (right, top - 24), Anchor::Right, Style { colour: FRONT, ..Style::new(14) })
    }
}

const LABEL: Style = Style { bold: true, ..Style::new(14) };

/// A box in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Rect {
    left: i32,
    right: i32,
    top: i32,
    bottom: i32,
}

impl Rect {
    fn around((x, y): (i32, i32), width: i32, height: i32) -> Self {
        Self { left: x - width / 2, right: x + width / 2, top: y - height / 2, bottom: y + height / 2 }
    }

    fn between(a: (i32, i32), b: (i32, i32)) -> Self {
        Self {
            left: a.0.min(b.0) - 1,
            right: a.0.max(b.0) + 1,
            top: a.1.min(b.1) - 1,
            bottom: a.1.max(b.1) + 1,
        }
    }

    fn overlap(&self, other: &Self) -> i32 {
        let width = self.right.min(other.right) - self.left.max(other.left);
        let height = self.bottom.min(other.bottom) - self.top.max(other.top);
        width.max(0) * height.max(0)
    }

    fn centre(&self) -> (i32, i32) {
        ((self.left + self.right) / 2, (self.top + self.bottom) / 2)
    }

    fn nearest(&self, (x, y): (i32, i32)) -> (i32, i32) {
        (x.clamp(self.left, self.right), y.clamp(self.top, self.bottom))
    }

    fn distance(&self, at: (i32, i32)) -> i32 {
        let (x, y) = self.nearest(at);
        f64::from(x - at.0).hypot(f64::from(y - at.1)) as i32
    }
}

/// A box for each point's name: the nearest of some rings of places around the point that overlaps
/// nothing, or the one that overlaps least.
fn place_labels(places: &[(i32, i32)], points: &[Point], area: Area, mut taken: Vec<Rect>) -> Vec<Rect> {
    let mut labels = Vec::new();
    for (&(x, y), point) in places.iter().zip(points) {
        let (width, height) = LABEL.measure(&point.name);
        let (width, height) = (width + 6, height + 4);
        let candidates = [10, 24, 40, 58, 80, 110].into_iter().flat_map(|gap| {
            let (dx, dy) = (gap + width / 2, gap + height / 2);
            [(1, 0), (-1, 0), (0, -1), (0, 1), (1, -1), (-1, -1), (1, 1), (-1, 1)].map(|(sx, sy)| {
                // Diagonals start beside the point, not at the corner of the square around it.
                let diagonal = if sx != 0 && sy != 0 { 0.75 } else { 1.0 };
                let at = |s: i32, d: i32| (f64::from(s * d) * diagonal) as i32;
                Rect::around((x + at(sx, dx), y + at(sy, dy)), width, height)
            })
        });
        let inside = |r: &Rect| {
            r.left >= area.left + 2
                && r.right <= area.right
                && r.top >= area.top
                && r.bottom <= area.bottom - 2
        };
        let cost = |r: &Rect| -> i32 { taken.iter().map(|t| t.overlap(r)).sum() };
        // `min_by_key` keeps the first of equals, the nearest.
        let best = candidates
            .filter(inside)
            .min_by_key(cost)
            .unwrap_or_else(|| Rect::around((x, y - height), width, height));
        taken.push(best);
        labels.push(best);
    }
    labels
}

#[cfg(test)]
mod tests {
    use super::*;

    fn panel(is_error: bool, points: &[(&str, f64, f64)]) -> Panel {
        let point = |(name, time, score): &(&str, f64, f64)| Point {
            name: name.to_string(),
            time: *time,
            score: *score,
            colour: INK,
        };
        Panel { title: "", axis: "", is_error, points: points.iter().map(point).collect(), noisy: None }
    }

    fn names(points: Vec<&Point>) -> Vec<&str> {
        points.into_iter().map(|p| p.name.as_str()).collect()
    }

    #[test]
    fn front_holds_exactly_what_nothing_beats() {
        let points = [("slow", 9.0, 0.1), ("beaten", 9.5, 0.2), ("fast", 1.0, 0.5), ("twin", 1.0, 0.6)];
        assert_eq!(names(panel(true, &points).front()), ["fast", "slow"]);
        assert_eq!(names(panel(false, &points).front()), ["twin"], "higher is better: one beats all");
    }

    #[test]
    fn ticks_are_round_and_enough() {
        for (values, logarithmic) in [
            (vec![80.0, 5000.0], true),
            (vec![300.0, 330.0], true),
            (vec![1e-4, 30.0], true),
            (vec![0.81, 0.83], false),
            (vec![0.1, 0.95], false),
            (vec![7.0], true),
        ] {
            let ticks = Scale::new(values.iter().copied(), logarithmic, (0, 100)).ticks();
            assert!((2..=12).contains(&ticks.len()), "{values:?}: {ticks:?}");
            assert!(ticks.iter().all(|t| tick_label(*t).len() <= 6), "{ticks:?}");
        }
        assert_eq!(tick_label(0.30000000000000004), "0.3");
        assert_eq!(tick_label(1000.0), "1000");
    }

    #[test]
    fn labels_of_crowded_points_do_not_overlap() {
        let names: Vec<String> = (0..12).map(|i| format!("oidn-high-prefilter-{i}")).collect();
        let points: Vec<(&str, f64, f64)> = names.iter().map(|n| (n.as_str(), 1.0, 1.0)).collect();
        let panel = panel(true, &points);
        let places: Vec<(i32, i32)> = (0..12).map(|i| (380 + i % 4 * 25, 300 + i / 4 * 20)).collect();
        let area = Area { left: 90, right: 780, top: 90, bottom: 680 };
        let labels = place_labels(&places, &panel.points, area, Vec::new());
        for (i, a) in labels.iter().enumerate() {
            for b in &labels[i + 1..] {
                assert_eq!(a.overlap(b), 0, "{a:?} {b:?}");
            }
        }
    }
}
