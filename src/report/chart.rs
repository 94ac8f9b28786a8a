//! `speed_vs_accuracy`: time against RelMSE and against SSIM, each with its Pareto front.
//!
//! Each point is a method, placed by its geometric means of time and RelMSE, or its mean SSIM, over the
//! common scenes. The noisy input takes no time and is a dashed line.

use plotters::prelude::*;

use super::{
    NOISY,
    axis::{Area, Scale, tick_label},
    canvas::{Anchor, Canvas, Style},
    figure::Figure,
    labels::{self, Rect},
    palette::{FAINT, GRID, INK, colours, legible},
    plural,
    summary::MethodSummary,
};
use crate::Result;

/// Pixels of the chart.
pub const SIZE: (u32, u32) = (1600, 760);
const FRONT: RGBColor = RGBColor(150, 150, 160);
const NOISY_LINE: RGBColor = RGBColor(185, 60, 50);
const NAME: Style = Style { bold: true, ..Style::new(14) };
/// Radius of a point.
const DOT: i32 = 6;

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
    /// Whether the vertical axis is logarithmic and lower is better; otherwise it is linear and higher is
    /// better.
    is_error: bool,
    points: Vec<Point>,
    noisy: Option<f64>,
}

/// The two diagrams side by side, of the methods over all sample counts.
pub struct Chart {
    title: String,
    panels: [Panel; 2],
}

impl Chart {
    /// From the summaries of a report; those of single sample counts are left out.
    pub fn new(summaries: &[MethodSummary], threads: usize) -> Self {
        let summaries: Vec<&MethodSummary> = summaries.iter().filter(|s| s.spp.is_none()).collect();
        let panels = [
            Panel::new(
                &summaries,
                "RelMSE over time",
                "RelMSE (geometric mean; lower is better)",
                true,
                |s| s.of("relmse").geomean,
            ),
            Panel::new(&summaries, "SSIM over time", "SSIM (mean; higher is better)", false, |s| {
                s.of("ssim").mean
            }),
        ];
        let scenes = summaries.iter().map(|s| s.scenes).max().unwrap_or(0);
        let title = format!(
            "Speed and accuracy over {scenes} render{}, {threads} thread{}",
            plural(scenes),
            plural(threads)
        );
        Self { title, panels }
    }
}

impl Figure for Chart {
    fn size(&self) -> (u32, u32) {
        SIZE
    }

    fn draw<B: DrawingBackend>(&self, canvas: &Canvas<B>) -> Result<()> {
        let (width, height) = (SIZE.0 as i32, SIZE.1 as i32);
        canvas.text(&self.title, (width / 2, 28), Anchor::Centre, Style { bold: true, ..Style::new(22) })?;
        let half = width / 2;
        for (i, panel) in self.panels.iter().enumerate() {
            let left = i as i32 * half;
            let area = Area { left: left + 92, right: left + half - 24, top: 96, bottom: height - 76 };
            panel.draw(canvas, area)?;
        }
        Ok(())
    }
}

/// A score to three significant digits.
pub fn number_label(value: f64) -> String {
    if value != 0.0 && value.abs() < 1e-6 {
        return format!("{value:.2e}");
    }
    let decimals = (2 - value.abs().max(1e-9).log10().floor() as i32).clamp(0, 8) as usize;
    format!("{value:.decimals$}")
}

impl Panel {
    fn new(
        summaries: &[&MethodSummary],
        title: &'static str,
        axis: &'static str,
        is_error: bool,
        score: impl Fn(&MethodSummary) -> Option<f64>,
    ) -> Self {
        // A logarithmic axis has no zero.
        let score = |s: &MethodSummary| score(s).filter(|v| !is_error || *v > 0.0);
        let names: Vec<&str> = summaries.iter().map(|s| s.model.as_str()).collect();
        let points = summaries.iter().zip(colours(&names)).filter_map(|(s, colour)| {
            let time = s.of("ms_per_mpx").geomean.filter(|t| *t > 0.0)?;
            Some(Point { name: s.model.clone(), time, score: score(s)?, colour })
        });
        // Of fewer renders, such as the easy ones, its score is none to hold the others against.
        let most = summaries.iter().map(|s| s.scenes).max().unwrap_or(0);
        let noisy = summaries.iter().find(|s| s.model == NOISY && s.scenes == most).and_then(|s| score(s));
        Self { title, axis, is_error, points: points.collect(), noisy }
    }

    /// The points to which no other is superior in both time and score, fastest first.
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
            let text = "no method has both a time and a score";
            return canvas.text(text, middle, Anchor::Centre, Style::new(15));
        }
        let x = Scale::new(self.points.iter().map(|p| p.time), true, (left, right));
        let scores = self.points.iter().map(|p| p.score);
        let y = Scale::new(scores.clone(), self.is_error, (bottom, top));
        // The scale takes in the noisy input only where it then covers less than 1.4 times as much, which
        // leaves room to tell the methods apart.
        let with_noisy = Scale::new(scores.chain(self.noisy), self.is_error, (bottom, top));
        let y = if with_noisy.span() < 1.4 * y.span() { with_noisy } else { y };
        self.draw_axes(canvas, area, &x, &y)?;
        let mut taken = self.draw_noisy(canvas, area, &y)?;
        taken.extend(self.draw_front(canvas, area, &x, &y)?);
        self.draw_points(canvas, area, (&x, &y), taken)?;
        let better = if self.is_error { "better: down and left" } else { "better: up and left" };
        let note = format!("{better}; grey line: Pareto front");
        canvas.text(&note, (right, top - 24), Anchor::Right, Style { colour: FAINT, ..Style::new(14) })
    }

    fn draw_axes<B: DrawingBackend>(
        &self,
        canvas: &Canvas<B>,
        Area { left, right, top, bottom }: Area,
        x: &Scale,
        y: &Scale,
    ) -> Result<()> {
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
        let middle = ((left + right) / 2, bottom + 46);
        let time = "milliseconds per megapixel (geometric mean, logarithmic)";
        canvas.text(time, middle, Anchor::Centre, Style::new(15))?;
        canvas.vertical_text(self.axis, (left - 74, (top + bottom) / 2), Style::new(15))
    }

    /// Draws the dashed line of the noisy input and its text; returns the boxes that they cover.
    fn draw_noisy<B: DrawingBackend>(
        &self,
        canvas: &Canvas<B>,
        Area { left, right, top, bottom }: Area,
        y: &Scale,
    ) -> Result<Vec<Rect>> {
        let Some(noisy) = self.noisy else { return Ok(Vec::new()) };
        let inside = top + 3 < y.at(noisy) && y.at(noisy) < bottom - 3;
        // Where the value is off the scale, the line is drawn at the edge beyond which it lies.
        let at = y.at(noisy).clamp(top + 3, bottom - 3);
        canvas.dashes((left, right), at, NOISY_LINE, 2)?;
        let text =
            format!("noisy input {}{}", number_label(noisy), if inside { "" } else { ", off the scale" });
        let style = Style { colour: NOISY_LINE, ..Style::new(14) };
        let (w, h) = style.measure(&text);
        let text_at = (right - 6, if at < (top + bottom) / 2 { at + 14 } else { at - 14 });
        canvas.text(&text, text_at, Anchor::Right, style)?;
        let line = Rect { left, right, top: at - 2, bottom: at + 2 };
        Ok(vec![Rect::around((text_at.0 - w / 2, text_at.1), w + 8, h + 6), line])
    }

    /// Draws the Pareto front as steps; returns the boxes that they cover.
    fn draw_front<B: DrawingBackend>(
        &self,
        canvas: &Canvas<B>,
        area: Area,
        x: &Scale,
        y: &Scale,
    ) -> Result<Vec<Rect>> {
        // For any time between two points of the front, the faster one has the best score.
        let front: Vec<(i32, i32)> = self.front().iter().map(|p| (x.at(p.time), y.at(p.score))).collect();
        let steps: Vec<(i32, i32)> = front
            .windows(2)
            .flat_map(|w| [w[0], (w[1].0, w[0].1)])
            .chain(front.last().copied())
            .chain(front.last().map(|p| (area.right, p.1)))
            .collect();
        canvas.line(&steps, FRONT, 2)?;
        Ok(steps.windows(2).map(|line| Rect::between(line[0], line[1])).collect())
    }

    fn draw_points<B: DrawingBackend>(
        &self,
        canvas: &Canvas<B>,
        area: Area,
        (x, y): (&Scale, &Scale),
        mut taken: Vec<Rect>,
    ) -> Result<()> {
        let places: Vec<(i32, i32)> = self.points.iter().map(|p| (x.at(p.time), y.at(p.score))).collect();
        taken.extend(places.iter().map(|&at| Rect::around(at, 2 * DOT + 4, 2 * DOT + 4)));
        let names: Vec<&str> = self.points.iter().map(|p| p.name.as_str()).collect();
        let labels = labels::place(&places, &names, NAME, area, taken);
        for ((point, &at), label) in self.points.iter().zip(&places).zip(&labels) {
            // A label that had to move away keeps a line to its point.
            if label.distance(at) > 14 {
                canvas.line(&[at, label.nearest(at)], point.colour, 1)?;
            }
        }
        for ((point, &at), label) in self.points.iter().zip(&places).zip(labels) {
            canvas.dot(at, DOT, point.colour)?;
            let style = Style { colour: legible(point.colour), ..NAME };
            canvas.text(&point.name, label.centre(), Anchor::Centre, style)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::{rows::Row, summary::summarise};

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
    fn an_input_that_was_scored_on_fewer_renders_has_no_line() {
        let line = |hard: Option<f64>| {
            let row = |(model, scene, relmse): (&str, &str, Option<f64>)| Row {
                model: model.into(),
                noisy: scene.into(),
                relmse,
                ..Row::default()
            };
            let scores = [(NOISY, "easy", Some(0.25)), (NOISY, "hard", hard)];
            let of_method = [("m", "easy", Some(0.1)), ("m", "hard", Some(0.1))];
            let rows: Vec<Row> = scores.into_iter().chain(of_method).map(row).collect();
            let summaries = summarise(&rows, &[NOISY, "m"].map(String::from), "m");
            let all: Vec<&MethodSummary> = summaries.iter().collect();
            Panel::new(&all, "", "", true, |s| s.of("relmse").geomean).noisy
        };
        assert_eq!(line(None), None);
        assert!((line(Some(1.0)).unwrap() - 0.5).abs() < 1e-9);
    }

    #[test]
    fn front_holds_exactly_what_nothing_beats() {
        let points = [("slow", 9.0, 0.1), ("beaten", 9.5, 0.2), ("fast", 1.0, 0.5), ("twin", 1.0, 0.6)];
        assert_eq!(names(panel(true, &points).front()), ["fast", "slow"]);
        assert_eq!(names(panel(false, &points).front()), ["twin"], "higher is better: one beats all");
    }
}
