//! `error_over_samples`: RelMSE and SSIM over samples per pixel, a line for each method.
//!
//! Points are geometric means of RelMSE and means of SSIM over the scenes that all methods scored at every
//! sample count, so that only the samples change along a line. A method whose RelMSE is above the noisy
//! input's makes frames worse.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::Path,
};

use plotters::prelude::*;

use super::{
    NOISY,
    axis::{Area, Scale, tick_label},
    canvas::{Anchor, Canvas, Style},
    chart::SIZE,
    figure::Figure,
    palette::{GRID, INK, colours, legible},
    plural,
    rows::Row,
    summary::geometric_mean,
};
use crate::Result;

/// Room for the methods' names to the right of a panel.
const NAMES: i32 = 170;
const NAME: Style = Style { bold: true, ..Style::new(13) };
const LINE: i32 = 17;

/// Means over scenes of one method, by sample count.
struct Line {
    method: String,
    colour: RGBColor,
    relmse: Vec<f64>,
    ssim: Vec<f64>,
}

/// The two diagrams side by side.
pub struct Samples {
    scenes: usize,
    counts: Vec<u32>,
    lines: Vec<Line>,
}

impl Samples {
    /// From all rows; none where there is only one sample count, or no scene that all methods scored at every
    /// count.
    pub fn new(rows: &[Row], methods: &[String]) -> Option<Self> {
        type Scores = Vec<(f64, f64)>;
        // Scenes of one name with different references are different scenes; noise seeds share theirs.
        type Scene<'a> = (&'a str, &'a Path);
        let scores = |row: &Row| Some((row.relmse.filter(|e| *e > 0.0)?, row.ssim?));
        // Methods without any score do not limit the scenes.
        let is_drawn = |method: &&str| rows.iter().any(|row| row.model == *method && scores(row).is_some());
        let methods: Vec<&str> = methods.iter().map(String::as_str).collect();
        let drawn: Vec<&str> = methods.iter().copied().filter(is_drawn).collect();
        // A render that one of them could not do counts for none: noise seeds differ.
        let is_lacking = |row: &&Row| drawn.contains(&row.model.as_str()) && scores(row).is_none();
        let lacking: BTreeSet<&Path> =
            rows.iter().filter(is_lacking).map(|row| row.noisy.as_path()).collect();
        let mut scored: BTreeMap<(Scene, u32, &str), Scores> = BTreeMap::new();
        for row in rows.iter().filter(|row| !lacking.contains(row.noisy.as_path())) {
            if let Some(scores) = scores(row) {
                let key = ((row.scene.as_str(), row.reference.as_path()), row.spp, row.model.as_str());
                scored.entry(key).or_default().push(scores);
            }
        }
        let counts: Vec<u32> = rows.iter().map(|row| row.spp).collect::<BTreeSet<_>>().into_iter().collect();
        let is_whole = |scene: &Scene| {
            counts.iter().all(|spp| drawn.iter().all(|model| scored.contains_key(&(*scene, *spp, model))))
        };
        let all = rows.iter().map(|row| (row.scene.as_str(), row.reference.as_path()));
        let scenes: BTreeSet<Scene> = all.filter(is_whole).collect();
        if counts.len() < 2 || drawn.is_empty() || scenes.is_empty() {
            return None;
        }
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        // The seeds of a scene are averaged first, so that a scene with many seeds weighs no more.
        let over_scenes = |spp: u32, model: &str, score: fn(&(f64, f64)) -> f64| -> Vec<f64> {
            let of_scene =
                |scene: &Scene| -> Vec<f64> { scored[&(*scene, spp, model)].iter().map(score).collect() };
            scenes.iter().map(|scene| mean(&of_scene(scene))).collect()
        };
        let line = |(method, colour): (&&str, RGBColor)| Line {
            method: (*method).into(),
            colour,
            relmse: counts
                .iter()
                .map(|spp| geometric_mean(&over_scenes(*spp, method, |s| s.0)).expect("there are scenes"))
                .collect(),
            ssim: counts.iter().map(|spp| mean(&over_scenes(*spp, method, |s| s.1))).collect(),
        };
        let of_all = colours(&methods);
        let coloured = methods.iter().zip(of_all).filter(|(method, _)| drawn.contains(method));
        Some(Self { scenes: scenes.len(), lines: coloured.map(line).collect(), counts })
    }

    fn panel<B: DrawingBackend>(
        &self,
        canvas: &Canvas<B>,
        area: Area,
        (title, is_error): (&str, bool),
        of: fn(&Line) -> &[f64],
    ) -> Result<()> {
        let Area { left, right, top, bottom } = area;
        canvas.text(title, (left, top - 24), Anchor::Left, Style { bold: true, ..Style::new(17) })?;
        let x = Scale::new(self.counts.iter().map(|spp| f64::from(*spp)), true, (left, right));
        let y = Scale::new(self.lines.iter().flat_map(|line| of(line).to_vec()), is_error, (bottom, top));
        for tick in y.ticks() {
            canvas.line(&[(left, y.at(tick)), (right, y.at(tick))], GRID, 1)?;
            canvas.text(&tick_label(tick), (left - 8, y.at(tick)), Anchor::Right, Style::new(13))?;
        }
        for spp in &self.counts {
            let at = x.at(f64::from(*spp));
            canvas.line(&[(at, top), (at, bottom)], GRID, 1)?;
            canvas.text(&spp.to_string(), (at, bottom + 16), Anchor::Centre, Style::new(13))?;
        }
        canvas.line(&[(left, bottom), (right, bottom)], INK, 1)?;
        canvas.text(
            "samples per pixel",
            ((left + right) / 2, bottom + 42),
            Anchor::Centre,
            Style::new(14),
        )?;
        for line in &self.lines {
            let points: Vec<(i32, i32)> = self
                .counts
                .iter()
                .zip(of(line))
                .map(|(spp, value)| (x.at(f64::from(*spp)), y.at(*value)))
                .collect();
            canvas.line(&points, line.colour, if line.method == NOISY { 2 } else { 3 })?;
            points.iter().try_for_each(|at| canvas.dot(*at, 4, line.colour))?;
        }
        // Names at the ends of their lines, moved apart where those meet.
        let mut ends: Vec<(i32, &Line)> =
            self.lines.iter().map(|line| (y.at(*of(line).last().expect("there are counts")), line)).collect();
        ends.sort_by_key(|(at, _)| *at);
        let mut free = top;
        for (i, (at, line)) in ends.iter().enumerate() {
            let below = (ends.len() - 1 - i) as i32 * LINE;
            let place = (*at).min(bottom - below).max(free);
            free = place + LINE;
            let style = Style { colour: legible(line.colour), ..NAME };
            canvas.text(&line.method, (right + 12, place), Anchor::Left, style)?;
        }
        Ok(())
    }
}

impl Figure for Samples {
    fn size(&self) -> (u32, u32) {
        SIZE
    }

    fn draw<B: DrawingBackend>(&self, canvas: &Canvas<B>) -> Result<()> {
        let (width, height) = (SIZE.0 as i32, SIZE.1 as i32);
        let title = format!("Error over samples, {} scene{}", self.scenes, plural(self.scenes));
        canvas.text(&title, (width / 2, 28), Anchor::Centre, Style { bold: true, ..Style::new(22) })?;
        let half = width / 2;
        let area = |i: i32| Area {
            left: i * half + 80,
            right: (i + 1) * half - NAMES,
            top: 96,
            bottom: height - 76,
        };
        self.panel(canvas, area(0), ("RelMSE (geometric mean; lower is better)", true), |line| &line.relmse)?;
        self.panel(canvas, area(1), ("SSIM (mean; higher is better)", false), |line| &line.ssim)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::canvas::draw_svg;

    fn row(scene: &str, spp: u32, model: &str, relmse: Option<f64>) -> Row {
        Row {
            scene: scene.into(),
            spp,
            model: model.into(),
            noisy: format!("{scene}_{spp:04}spp.exr").into(),
            relmse,
            ssim: relmse.map(|e| 1.0 - e),
            ..Row::default()
        }
    }

    #[test]
    fn scenes_of_one_name_with_other_references_are_other_scenes() {
        let of = |folder: &str, spp: u32| Row {
            reference: Path::new(folder).join("a_ref.exr"),
            ..row("a", spp, "noisy", Some(0.1))
        };
        let samples = Samples::new(&[of("A", 4), of("A", 16), of("B", 4)], &["noisy".into()]).unwrap();
        assert_eq!(samples.scenes, 1, "B has one count alone");
        let samples =
            Samples::new(&[of("A", 4), of("A", 16), of("B", 4), of("B", 16)], &["noisy".into()]).unwrap();
        assert_eq!(samples.scenes, 2);
    }

    #[test]
    fn lines_are_over_scenes_that_all_have_at_all_counts() {
        let methods = ["noisy", "demc-m", "absent"].map(String::from);
        let mut rows = Vec::new();
        for spp in [4, 16] {
            for (model, share) in [("noisy", 1.0), ("demc-m", 0.25)] {
                for (scene, error) in [("a", 0.4), ("b", 0.1), ("half", 0.9)] {
                    let is_lacking = scene == "half" && spp == 16 && model == "demc-m";
                    let error = error * share / f64::from(spp);
                    rows.push(row(scene, spp, model, (!is_lacking).then_some(error)));
                    // A second seed, and a third that one method cannot do.
                    if scene == "a" {
                        let of_seed = |seed: u32, error: Option<f64>| Row {
                            noisy: format!("a_n{seed}_{spp:04}spp.exr").into(),
                            ..row(scene, spp, model, error)
                        };
                        rows.push(of_seed(1, Some(error)));
                        rows.push(of_seed(2, (model == "noisy").then_some(9.0)));
                    }
                }
            }
        }
        let chart = Samples::new(&rows, &methods).unwrap();
        assert_eq!((chart.scenes, &chart.counts[..]), (2, &[4, 16][..]));
        let names: Vec<&str> = chart.lines.iter().map(|line| line.method.as_str()).collect();
        assert_eq!(names, ["noisy", "demc-m"]);
        assert!((chart.lines[1].relmse[0] - 0.2 * 0.25 / 4.0).abs() < 1e-12, "{:?}", chart.lines[1].relmse);
        let svg = draw_svg(chart.size(), |canvas| chart.draw(canvas)).unwrap();
        assert!(
            svg.contains("demc-m") && svg.contains("samples per pixel") && svg.contains("2 scenes"),
            "{svg}"
        );
        rows.retain(|row| row.spp == 4);
        assert!(Samples::new(&rows, &methods).is_none(), "one count is no line");
    }
}
