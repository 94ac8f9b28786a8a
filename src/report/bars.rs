//! `bars_relmse`, `bars_ssim` and `bars_flicker`: every method on every scene, and the means, as in the
//! paper's figure 10.
//!
//! Each group of bars is a scene and each bar a method; methods keep their order and colour throughout.
//! RelMSE and flicker have a logarithmic axis, so the lengths of bars tell which is shorter, not by how
//! much; the number on a bar, where there is room for it, tells that. A dot marks the best method of a
//! group, and a cross a method that has no score on the scene.

use std::{collections::HashMap, ops::Range};

use plotters::prelude::*;

use super::{
    axis::{Area, Scale, tick_label},
    canvas::{Anchor, Canvas, Style},
    chart::number_label,
    figure::Figure,
    palette::{FAINT, GRID, INK, colours},
    rows::Row,
    summary::{self, MethodSummary, Statistics},
};
use crate::Result;

const WIDTH: i32 = 1600;
/// Left and right ends of the plots.
const PLOT: (i32, i32) = (74, WIDTH - 16);
/// Heights in pixels of the title, of a line of the legend and of a row of groups, and the part of such a row
/// that holds bars.
const TITLE: i32 = 52;
const LEGEND: i32 = 26;
const ROW: i32 = 330;
const BARS: Range<i32> = 18..278;
/// Share of a group's width that stays free between groups.
const GAP: f64 = 0.14;
/// Bars are never narrower than this, unless a single group would not fit.
const NARROWEST: f64 = 10.0;
/// Bars from this width on carry their value.
const ROOM_FOR_VALUE: f64 = 12.5;
/// Groups are as wide as the longest label, up to this: longer ones are cut.
const WIDEST_LABEL: i32 = 116;
/// The most scenes with bars of their own; further ones are in the means only.
const MOST_SCENES: usize = 60;
const MEAN_BACKGROUND: RGBColor = RGBColor(243, 243, 246);
const VALUE: Style = Style::new(11);

/// Bars of one scene, or of a mean.
struct Group {
    label: String,
    is_mean: bool,
    /// One value for each method.
    values: Vec<Option<f64>>,
}

/// One bar chart.
pub struct Bars {
    title: String,
    /// Whether lower is better; the axis is then logarithmic.
    is_error: bool,
    methods: Vec<(String, RGBColor)>,
    groups: Vec<Group>,
}

impl Bars {
    /// RelMSE of all `rows`, with the means of `summaries`.
    pub fn relmse(rows: &[Row], summaries: &[MethodSummary]) -> Self {
        Self::new("RelMSE by scene (logarithmic; lower is better)", "relmse", rows, summaries)
    }

    /// SSIM of all `rows`, with the mean of `summaries`.
    pub fn ssim(rows: &[Row], summaries: &[MethodSummary]) -> Self {
        Self::new("SSIM by scene (higher is better)", "ssim", rows, summaries)
    }

    /// Flicker of all `rows`, with the means of `summaries`.
    pub fn flicker(rows: &[Row], summaries: &[MethodSummary]) -> Self {
        let followed: Vec<Row> = rows.iter().filter(|row| row.flicker.is_some()).cloned().collect();
        Self::new("Flicker by frame (logarithmic; lower is better)", "flicker", &followed, summaries)
    }

    fn new(title: &str, metric: &str, rows: &[Row], summaries: &[MethodSummary]) -> Self {
        let overall: Vec<&MethodSummary> = summaries.iter().filter(|s| s.spp.is_none()).collect();
        let names: Vec<&str> = overall.iter().map(|s| s.model.as_str()).collect();
        let is_error = metric != "ssim";
        let value = summary::metric(metric);
        let several_spp = rows.iter().any(|r| r.spp != rows[0].spp);
        let mut groups: Vec<Group> = Vec::new();
        let mut by_pair = HashMap::new();
        for row in rows {
            let at = *by_pair.entry((&row.noisy, &row.reference)).or_insert_with(|| {
                let spp = if several_spp { format!(" {} spp", row.spp) } else { String::new() };
                let label = format!("{}{spp}", row.scene);
                groups.push(Group { label, is_mean: false, values: vec![None; names.len()] });
                groups.len() - 1
            });
            let value = value(row);
            if let Some(method) = names.iter().position(|n| *n == row.model) {
                groups[at].values[method] = value;
            }
        }
        let scenes = groups.len();
        groups.truncate(MOST_SCENES);
        let means: [(&str, Mean); 2] = [("mean", |s| s.mean), ("geometric mean", |s| s.geomean)];
        for (label, mean) in means.into_iter().take(if is_error { 2 } else { 1 }) {
            let values = overall.iter().map(|s| mean(s.of(metric)));
            groups.push(Group { label: label.into(), is_mean: true, values: values.collect() });
        }
        let left_out = scenes.saturating_sub(MOST_SCENES);
        let more = if left_out > 0 { format!("; {left_out} more in the means") } else { String::new() };
        let methods = names.iter().map(ToString::to_string).zip(colours(&names)).collect();
        Self { title: format!("{title}{more}"), is_error, methods, groups }
    }

    /// Names of the legend, line by line, each with where it starts.
    fn legend(&self) -> Vec<Vec<(usize, i32)>> {
        let mut lines = vec![Vec::new()];
        let mut x = PLOT.0;
        for (at, (name, _)) in self.methods.iter().enumerate() {
            let width = Style::new(15).measure(name).0 + 50;
            if x + width > PLOT.1 && x > PLOT.0 {
                lines.push(Vec::new());
                x = PLOT.0;
            }
            lines.last_mut().expect("begins with a line").push((at, x));
            x += width;
        }
        lines
    }

    /// The groups of each row: as few rows as keep the bars wide enough, evenly filled.
    fn rows(&self) -> Vec<&[Group]> {
        let widest = self.groups.iter().map(|group| VALUE.measure(&group.label).0).max().unwrap_or(0);
        let bars = NARROWEST * self.methods.len() as f64 / (1.0 - GAP);
        let narrowest = bars.max(f64::from(widest.min(WIDEST_LABEL)));
        let most = (f64::from(PLOT.1 - PLOT.0) / narrowest).floor().max(1.0) as usize;
        let rows = self.groups.len().div_ceil(most).max(1);
        self.groups.chunks(self.groups.len().div_ceil(rows).max(1)).collect()
    }

    fn scale(&self, (bottom, top): (i32, i32)) -> Scale {
        if !self.is_error {
            return Scale::exactly((0.0, 1.0), false, (bottom, top));
        }
        // A logarithmic axis has no zero: the bar of an exact result has no length.
        let values = self.groups.iter().flat_map(|g| g.values.iter().flatten().copied()).filter(|v| *v > 0.0);
        let (low, high) = values.fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
        let (low, high) = if low > high { (0.001, 1.0) } else { (low, high) };
        // Even the lowest bar has a length.
        Scale::exactly((low / 2.0, high * 1.15), true, (bottom, top))
    }

    fn draw_row<B: DrawingBackend>(&self, canvas: &Canvas<B>, groups: &[Group], top: i32) -> Result<()> {
        let area = Area { left: PLOT.0, right: PLOT.1, top: top + BARS.start, bottom: top + BARS.end };
        let scale = self.scale((area.bottom, area.top));
        // Rows of one chart have bars of one width, also where the last has fewer groups.
        let most = self.rows().iter().map(|row| row.len()).max().unwrap_or(1);
        let width = f64::from(area.right - area.left) / most as f64;
        let end = area.left + (width * groups.len() as f64).round() as i32;
        for i in (0..groups.len()).filter(|i| groups[*i].is_mean) {
            let left = area.left + (width * i as f64).round() as i32;
            let right = area.left + (width * (i + 1) as f64).round() as i32;
            canvas.fill([(left + 3, area.top - 8), (right - 3, area.bottom + 36)], MEAN_BACKGROUND)?;
        }
        for tick in scale.ticks() {
            canvas.line(&[(area.left, scale.at(tick)), (end, scale.at(tick))], GRID, 1)?;
            canvas.text(&tick_label(tick), (area.left - 8, scale.at(tick)), Anchor::Right, Style::new(13))?;
        }
        for (i, group) in groups.iter().enumerate() {
            self.draw_group(canvas, group, area.left as f64 + width * i as f64, width, &area, &scale)?;
        }
        canvas.line(&[(area.left, area.bottom), (end, area.bottom)], INK, 1)
    }

    /// The best value of a group; none where fewer than two methods have one.
    fn best(&self, group: &Group) -> Option<f64> {
        let scored = group.values.iter().flatten().copied();
        let is_comparison = scored.clone().count() > 1;
        scored.reduce(if self.is_error { f64::min } else { f64::max }).filter(|_| is_comparison)
    }

    fn draw_group<B: DrawingBackend>(
        &self,
        canvas: &Canvas<B>,
        group: &Group,
        left: f64,
        width: f64,
        area: &Area,
        scale: &Scale,
    ) -> Result<()> {
        let bar = width * (1.0 - GAP) / self.methods.len() as f64;
        let start = left + width * GAP / 2.0;
        let best = self.best(group);
        for (i, (value, (_, colour))) in group.values.iter().zip(&self.methods).enumerate() {
            let from = (start + bar * i as f64).round() as i32;
            let to = (start + bar * (i + 1) as f64).round() as i32 - 2;
            let middle = (from + to) / 2;
            let Some(value) = value else {
                let cross = Style { bold: true, ..Style::new(15) };
                canvas.text("×", (middle, area.bottom - 9), Anchor::Centre, cross)?;
                continue;
            };
            let is_drawn = !self.is_error || *value > 0.0;
            let top = if is_drawn { scale.at(*value).clamp(area.top, area.bottom) } else { area.bottom - 2 };
            canvas.fill([(from, top), (to.max(from + 1), area.bottom)], *colour)?;
            // The top of the bar, or of its number where that stands above it.
            let mut above = top;
            if bar >= ROOM_FOR_VALUE {
                let text = number_label(*value);
                let length = VALUE.measure(&text).0;
                let fits = area.bottom - top > length + 8;
                let at = if fits { top + 5 + length / 2 } else { top - 4 - length / 2 };
                above -= if fits { 0 } else { length + 6 };
                let ink = if fits && is_dark(*colour) { WHITE } else { INK };
                canvas.vertical_text(&text, (middle + 1, at), Style { colour: ink, ..VALUE })?;
            }
            if best == Some(*value) {
                canvas.dot((middle, above - 7), 3, INK)?;
            }
        }
        let style = Style { bold: group.is_mean, ..Style::new(13) };
        let label = fit(&group.label, style, width as i32 - 6);
        canvas.text(&label, ((left + width / 2.0) as i32, area.bottom + 18), Anchor::Centre, style)
    }
}

/// Takes a mean out of a method's statistics.
type Mean = fn(Statistics) -> Option<f64>;

fn is_dark(colour: RGBColor) -> bool {
    u32::from(colour.0) * 3 + u32::from(colour.1) * 6 + u32::from(colour.2) < 1450
}

/// `text`, cut in the middle where it is wider than `width`: both ends tell scenes apart.
fn fit(text: &str, style: Style, width: i32) -> String {
    let letters: Vec<char> = text.chars().collect();
    let mut kept = letters.len();
    let mut cut = text.to_string();
    while style.measure(&cut).0 > width && kept > 4 {
        kept -= 1;
        let (head, tail) = (kept.div_ceil(2), kept / 2);
        let end = &letters[letters.len() - tail..];
        cut = letters[..head].iter().chain(&['…']).chain(end).collect();
    }
    cut
}

impl Figure for Bars {
    fn size(&self) -> (u32, u32) {
        let height = TITLE + LEGEND * self.legend().len() as i32 + ROW * self.rows().len() as i32;
        (WIDTH as u32, height as u32)
    }

    fn draw<B: DrawingBackend>(&self, canvas: &Canvas<B>) -> Result<()> {
        let heading = Style { bold: true, ..Style::new(20) };
        canvas.text(&self.title, (PLOT.0, 28), Anchor::Left, heading)?;
        if self.groups.iter().all(|g| g.values.iter().all(Option::is_none)) {
            return canvas.text(
                "no method has a score",
                (WIDTH / 2, TITLE + LEGEND + ROW / 2),
                Anchor::Centre,
                Style::new(15),
            );
        }
        let incomplete = self.groups.iter().any(|g| g.values.iter().any(Option::is_none));
        let note = if incomplete { "dot: best of the scene; ×: no score" } else { "dot: best of the scene" };
        canvas.text(note, (PLOT.1, 28), Anchor::Right, Style { colour: FAINT, ..Style::new(14) })?;
        let legend = self.legend();
        for (line, entries) in legend.iter().enumerate() {
            let y = TITLE + LEGEND * line as i32 + LEGEND / 2;
            for &(at, x) in entries {
                let (name, colour) = &self.methods[at];
                canvas.fill([(x, y - 7), (x + 14, y + 7)], *colour)?;
                canvas.text(name, (x + 22, y), Anchor::Left, Style::new(15))?;
            }
        }
        let below = TITLE + LEGEND * legend.len() as i32;
        for (i, groups) in self.rows().into_iter().enumerate() {
            self.draw_row(canvas, groups, below + ROW * i as i32)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::{canvas::draw_svg, summary::summarise};

    fn rows(scenes: usize, methods: &[&str]) -> Vec<Row> {
        let score = |scene: usize, method: usize| 0.001 * (1 + scene + 3 * method) as f64;
        (0..scenes)
            .flat_map(|scene| {
                methods.iter().enumerate().map(move |(method, name)| Row {
                    scene: format!("scene_{scene}"),
                    model: name.to_string(),
                    noisy: format!("{scene}").into(),
                    relmse: Some(score(scene, method)),
                    ssim: Some(1.0 - score(scene, method)),
                    ..Row::default()
                })
            })
            .collect()
    }

    fn bars(rows: &[Row], methods: &[&str]) -> Bars {
        let names: Vec<String> = methods.iter().map(ToString::to_string).collect();
        Bars::relmse(rows, &summarise(rows, &names, methods[0]))
    }

    fn svg(bars: &Bars) -> String {
        draw_svg(bars.size(), |canvas| bars.draw(canvas)).unwrap()
    }

    #[test]
    fn every_scene_and_mean_has_a_bar_for_every_method() {
        let methods = ["noisy", "demc-m", "oidn-fast"];
        let chart = bars(&rows(3, &methods), &methods);
        let labels: Vec<&str> = chart.groups.iter().map(|g| g.label.as_str()).collect();
        assert_eq!(labels, ["scene_0", "scene_1", "scene_2", "mean", "geometric mean"]);
        assert_eq!(chart.groups[1].values, [Some(0.002), Some(0.005), Some(0.008)]);
        assert!((chart.groups[3].values[2].unwrap() - 0.008).abs() < 1e-12);
        let text = svg(&chart);
        for expected in ["scene_1", "geometric mean", "oidn-fast", "0.00500"] {
            assert!(text.contains(expected), "{expected}");
        }
        assert!(!text.contains('×'));
    }

    #[test]
    fn equals_are_all_the_best() {
        let methods = ["noisy", "demc-m", "demc-l"];
        let mut rows = rows(1, &methods);
        let dots = |rows: &[Row]| svg(&bars(rows, &methods)).matches("<circle").count();
        let of_one = dots(&rows);
        assert!(of_one > 0);
        rows.iter_mut().for_each(|row| row.relmse = Some(0.1));
        assert_eq!(dots(&rows), 3 * of_one);
    }

    #[test]
    fn a_method_without_a_score_leaves_a_cross_and_its_place() {
        let methods = ["noisy", "demc-m"];
        let mut rows = rows(2, &methods);
        (rows[1].relmse, rows[1].ssim) = (None, None);
        let chart = bars(&rows, &methods);
        assert_eq!(chart.groups[0].values, [Some(0.001), None]);
        assert_eq!(svg(&chart).matches('×').count(), 2, "the bar and the explanation");
        rows.iter_mut().for_each(|r| r.relmse = None);
        assert!(svg(&bars(&rows, &methods)).contains("no method has a score"));
    }

    #[test]
    fn many_bars_go_to_several_rows_of_one_scale() {
        let methods: Vec<String> = (0..14).map(|i| format!("method-{i}")).collect();
        let methods: Vec<&str> = methods.iter().map(String::as_str).collect();
        let chart = bars(&rows(30, &methods), &methods);
        let counts: Vec<usize> = chart.rows().iter().map(|r| r.len()).collect();
        assert_eq!(counts.iter().sum::<usize>(), 32);
        assert!(counts.len() > 2 && counts[0] * methods.len() <= 153, "{counts:?}");
        let chart = bars(&rows(100, &["noisy"]), &["noisy"]);
        assert_eq!(chart.groups.len(), MOST_SCENES + 2);
        assert!(chart.title.contains("40 more"), "{}", chart.title);
    }

    #[test]
    fn long_labels_keep_both_ends() {
        let style = Style::new(13);
        let cut = fit("a_very_long_scene_name.0017", style, 120);
        assert!(style.measure(&cut).0 <= 120 && cut.starts_with("a_v") && cut.ends_with("17"), "{cut}");
        assert_eq!(fit("short", style, 120), "short");
    }
}
