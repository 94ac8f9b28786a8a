//! `summary.csv`: each method over the same scenes, so that no method profits from scenes it missed.
//!
//! Means of RelMSE are ruled by the noisiest scene; the geometric mean of the ratio to a baseline,
//! scene by scene, weighs every scene alike (Fleming and Wallace, "How Not to Lie with Statistics",
//! 1986).

use std::{
    collections::{BTreeSet, HashMap},
    path::Path,
};

use super::{
    NOISY, cell,
    rows::{Row, csv_lines},
};

/// How a row gives a metric.
type Metric = fn(&Row) -> Option<f64>;

/// Metrics that are summarised.
const METRICS: [(&str, Metric); 10] = [
    ("relmse", |r| r.relmse),
    ("ssim", |r| r.ssim),
    ("rmse", |r| r.rmse),
    ("max_error", |r| r.max_error),
    ("seconds", |r| r.seconds),
    ("ms_per_mpx", |r| r.ms_per_mpx),
    ("relmse_trimmed", |r| r.relmse_trimmed),
    ("smape", |r| r.smape),
    ("flip", |r| r.flip),
    ("flicker", |r| r.flicker),
];

/// One metric of one method over the common scenes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Statistics {
    /// Arithmetic mean.
    pub mean: Option<f64>,
    /// Median.
    pub median: Option<f64>,
    /// Geometric mean; none where a value is negative.
    pub geomean: Option<f64>,
    /// Geometric mean of the ratio to the baseline method on the same scene.
    pub ratio: Option<f64>,
}

/// One method over the common scenes.
#[derive(Clone, Debug, PartialEq)]
pub struct MethodSummary {
    /// Its name.
    pub model: String,
    /// Samples per pixel of the rows summarised; none for all of them.
    pub spp: Option<u32>,
    /// Pairs that the statistics are taken over: those that this method and every other scored, but for a noisy
    /// input that is not the baseline.
    pub scenes: usize,
    /// Pairs on which this method failed.
    pub failed: usize,
    /// Largest memory peak of any row.
    pub peak_mib: Option<f64>,
    statistics: [Statistics; METRICS.len()],
}

impl MethodSummary {
    /// The statistics of a metric, named as its column.
    ///
    /// # Panics
    /// If no summarised metric has that name.
    pub fn of(&self, metric: &str) -> Statistics {
        self.statistics[place(metric)]
    }
}

/// How a row gives the metric of that name.
///
/// # Panics
/// If no summarised metric has that name.
pub fn metric(name: &str) -> fn(&Row) -> Option<f64> {
    METRICS[place(name)].1
}

fn place(metric: &str) -> usize {
    METRICS.iter().position(|(name, _)| *name == metric).expect("a summarised metric")
}

/// Every method in `models` over the pairs that all of them scored, but for the noisy input unless that is the
/// baseline: first over all sample counts, then, where there are several, for each. A method that scored nowhere
/// does not limit the others.
pub fn summarise(rows: &[Row], models: &[String], baseline: &str) -> Vec<MethodSummary> {
    let counts: BTreeSet<u32> = rows.iter().map(|r| r.spp).collect();
    let mut summaries = over(rows.iter().collect(), models, baseline, None);
    if counts.len() > 1 {
        for spp in counts {
            let rows = rows.iter().filter(|r| r.spp == spp).collect();
            summaries.extend(over(rows, models, baseline, Some(spp)));
        }
    }
    summaries
}

/// The noisy and the reference file.
type Files<'a> = (&'a Path, &'a Path);
type RowsOfMethod<'a> = HashMap<Files<'a>, &'a Row>;

fn valid<'a>(of: &RowsOfMethod<'a>, pair: Files<'a>) -> bool {
    of.get(&pair).is_some_and(|r| r.is_valid())
}

fn over(rows: Vec<&Row>, models: &[String], baseline: &str, spp: Option<u32>) -> Vec<MethodSummary> {
    let mut by_model: HashMap<&str, RowsOfMethod> = HashMap::new();
    for &row in &rows {
        by_model.entry(&row.model).or_default().insert((&row.noisy, &row.reference), row);
    }
    let mut scoring = by_model.clone();
    scoring.retain(|_, of| of.values().any(|r| r.is_valid()));
    // A scene whose input has no score, because of a NaN say, still counts for methods that repair it; but not where
    // there would be no ratio to that input.
    if scoring.len() > 1 && baseline != NOISY {
        scoring.remove(NOISY);
    }
    let mut common: Vec<Files> =
        scoring.values().next().map(|of| of.keys().copied().collect()).unwrap_or_default();
    common.retain(|&pair| scoring.values().all(|of| valid(of, pair)));
    common.sort_unstable();
    let nothing = RowsOfMethod::new();
    let base = by_model.get(baseline).unwrap_or(&nothing);
    models
        .iter()
        .map(|model| {
            let of = by_model.get(model.as_str()).unwrap_or(&nothing);
            let common: Vec<_> = common.iter().filter(|&&pair| valid(of, pair)).collect();
            let statistics = METRICS.map(|(_, metric)| {
                // Every method that has a metric at all is compared over the same pairs.
                let has =
                    |of: &RowsOfMethod, pair: &Files| of.get(pair).is_some_and(|row| metric(row).is_some());
                let limits = scoring.values().filter(|of| common.iter().any(|pair| has(of, pair)));
                let limits: Vec<_> = limits.collect();
                let common: Vec<_> =
                    common.iter().filter(|pair| limits.iter().all(|of| has(of, pair))).copied().collect();
                let values: Vec<f64> = common.iter().filter_map(|pair| metric(of[*pair])).collect();
                // One black frame, which methods leave as it is, or one input that equals its reference would decide
                // a product: where any score is 0, no method's counts.
                let is_exact = |pair: &Files| {
                    by_model.values().any(|of| of.get(pair).and_then(|row| metric(row)) == Some(0.0))
                };
                let inexact: Vec<_> = common.iter().filter(|pair| !is_exact(pair)).collect();
                let factors: Vec<f64> = inexact.iter().filter_map(|pair| metric(of[**pair])).collect();
                let ratio = |pair: &Files| Some(metric(of[pair])? / metric(base.get(pair)?)?);
                let ratios: Vec<f64> = inexact.iter().filter_map(|pair| ratio(pair)).collect();
                Statistics {
                    mean: mean(&values),
                    median: median(&values),
                    geomean: geometric_mean(&factors),
                    ratio: geometric_mean(&ratios),
                }
            });
            MethodSummary {
                model: model.clone(),
                spp,
                scenes: common.len(),
                failed: of.values().filter(|r| !r.is_valid()).count(),
                peak_mib: of.values().filter_map(|r| r.peak_mib).reduce(f64::max),
                statistics,
            }
        })
        .collect()
}

/// The arithmetic mean; none for no values.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The value in the middle, or halfway between the two there; none for no values.
pub fn median(values: &[f64]) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let last = sorted.len().checked_sub(1)?;
    Some(f64::midpoint(sorted[last / 2], sorted[sorted.len() / 2]))
}

/// The geometric mean; none for no values, a negative one, or a ratio to zero.
pub fn geometric_mean(values: &[f64]) -> Option<f64> {
    if values.iter().any(|v| *v < 0.0 || !v.is_finite()) {
        return None;
    }
    mean(&values.iter().map(|v| v.ln()).collect::<Vec<_>>()).map(f64::exp)
}

/// The table as CSV.
pub fn to_text(summaries: &[MethodSummary], baseline: &str) -> String {
    let mut columns: Vec<String> = ["model", "spp", "scenes", "failed", "baseline"].map(String::from).into();
    for (metric, _) in METRICS {
        columns.extend(["mean", "median", "geomean", "ratio"].map(|s| format!("{metric}_{s}")));
    }
    columns.push("peak_mib_max".into());
    let rows = summaries.iter().map(|s| {
        let mut cells = vec![
            s.model.clone(),
            s.spp.map_or("all".into(), |n| n.to_string()),
            s.scenes.to_string(),
            s.failed.to_string(),
            baseline.into(),
        ];
        for s in s.statistics {
            cells.extend([s.mean, s.median, s.geomean, s.ratio].map(cell));
        }
        cells.push(cell(s.peak_mib));
        cells
    });
    csv_lines(std::iter::once(columns).chain(rows))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(scene: &str, model: &str, spp: u32, relmse: Option<f64>) -> Row {
        Row {
            scene: scene.into(),
            model: model.into(),
            spp,
            relmse,
            noisy: format!("{scene}_{spp}").into(),
            reference: scene.into(),
            ..Row::default()
        }
    }

    fn models(names: &[&str]) -> Vec<String> {
        names.iter().map(ToString::to_string).collect()
    }

    fn close(found: Option<f64>, expected: f64) {
        assert!((found.unwrap() - expected).abs() < 1e-12, "{found:?} for {expected}");
    }

    #[test]
    fn a_frame_that_some_method_gets_exactly_decides_no_product() {
        let scores = [("a", "x", 0.2), ("a", "y", 0.1), ("black", "x", 0.0), ("black", "y", 1e-5)];
        let rows: Vec<Row> = scores.map(|(scene, model, relmse)| row(scene, model, 4, Some(relmse))).into();
        let all = summarise(&rows, &models(&["x", "y"]), "y");
        let of = |model: &str| all.iter().find(|s| s.model == model && s.spp.is_none()).unwrap().of("relmse");
        for (model, geomean, ratio, mean) in [("x", 0.2, 2.0, 0.1), ("y", 0.1, 1.0, 0.050005)] {
            let close = |value: Option<f64>, wanted: f64| (value.unwrap() - wanted).abs() < 1e-9;
            let own = of(model);
            assert!(
                close(own.geomean, geomean) && close(own.ratio, ratio) && close(own.mean, mean),
                "{model}"
            );
        }
    }

    #[test]
    fn a_baseline_that_is_exact_has_no_ratio_and_hides_no_other() {
        let rows = [
            row("a", "x", 4, Some(1.0)),
            row("b", "x", 4, Some(4.0)),
            row("a", "base", 4, Some(2.0)),
            row("b", "base", 4, Some(0.0)),
        ];
        let summary = summarise(&rows, &models(&["x", "base"]), "base");
        close(summary[0].of("relmse").ratio, 0.5);
    }

    #[test]
    fn a_metric_that_some_rows_lack_is_compared_over_the_others() {
        let mut rows: Vec<Row> = ["a", "b"]
            .iter()
            .flat_map(|scene| ["x", "y"].map(|model| row(scene, model, 4, Some(1.0))))
            .collect();
        for (row, flicker) in rows.iter_mut().zip([None, Some(9.0), Some(2.0), Some(4.0)]) {
            row.flicker = flicker;
        }
        let found = summarise(&rows, &models(&["x", "y"]), "x");
        close(found[1].of("flicker").mean, 4.0);
        close(found[1].of("flicker").ratio, 2.0);
        close(found[1].of("relmse").mean, 1.0);
        assert_eq!(found[1].scenes, 2);
    }

    #[test]
    fn statistics_by_hand() {
        let rows = [
            row("a", "x", 4, Some(1.0)),
            row("b", "x", 4, Some(4.0)),
            row("c", "x", 4, Some(16.0)),
            row("a", "base", 4, Some(2.0)),
            row("b", "base", 4, Some(2.0)),
            row("c", "base", 4, Some(2.0)),
        ];
        let found = summarise(&rows, &models(&["x", "base"]), "base");
        assert_eq!(found.len(), 2);
        let x = found[0].of("relmse");
        close(x.mean, 7.0);
        close(x.median, 4.0);
        close(x.geomean, 4.0);
        close(x.ratio, 2.0);
        close(found[1].of("relmse").ratio, 1.0);
        assert_eq!(found[0].of("ssim"), Statistics::default(), "never measured");
    }

    #[test]
    fn only_scenes_that_every_method_scored_count() {
        let rows = [
            row("a", "x", 4, Some(1.0)),
            row("b", "x", 4, Some(100.0)),
            row("a", "y", 4, Some(3.0)),
            row("b", "y", 4, None),
            row("a", "absent", 4, None),
            row("b", "absent", 4, None),
            // The input, which a NaN may spoil, is none of them.
            row("a", NOISY, 4, None),
            row("b", NOISY, 4, Some(9.0)),
        ];
        let found = summarise(&rows, &models(&["x", "y", "absent"]), "x");
        close(found[0].of("relmse").mean, 1.0);
        close(found[1].of("relmse").ratio, 3.0);
        let counts: Vec<_> = found.iter().map(|m| (m.scenes, m.failed)).collect();
        assert_eq!(counts, [(1, 0), (1, 1), (0, 2)]);
        assert_eq!(found[2].of("relmse").mean, None);
    }

    #[test]
    fn ratios_to_the_input_are_over_as_many_scenes_as_are_told() {
        let rows = [
            row("a", "x", 4, Some(1.0)),
            row("b", "x", 4, Some(100.0)),
            row("a", NOISY, 4, None),
            row("b", NOISY, 4, Some(400.0)),
        ];
        let found = summarise(&rows, &models(&["x", NOISY]), NOISY);
        assert_eq!(found.iter().map(|m| m.scenes).collect::<Vec<_>>(), [1, 1]);
        close(found[0].of("relmse").mean, 100.0);
        close(found[0].of("relmse").ratio, 0.25);
    }

    #[test]
    fn several_sample_counts_are_also_summarised_apart() {
        let rows = [row("a", "x", 4, Some(8.0)), row("a", "x", 16, Some(2.0))];
        let found = summarise(&rows, &models(&["x"]), "x");
        let means: Vec<_> = found.iter().map(|m| (m.spp, m.of("relmse").mean)).collect();
        assert_eq!(means, [(None, Some(5.0)), (Some(4), Some(8.0)), (Some(16), Some(2.0))]);
    }

    #[test]
    fn zero_and_negative_values_make_no_false_numbers() {
        close(geometric_mean(&[0.0, 4.0]), 0.0);
        assert_eq!(geometric_mean(&[-1.0, 4.0]), None);
        assert_eq!(geometric_mean(&[f64::INFINITY]), None, "a ratio to zero");
        assert_eq!(geometric_mean(&[]), None);
    }

    #[test]
    fn text_has_a_cell_for_every_column() {
        let text = to_text(&summarise(&[row("a", "x", 4, Some(8.0))], &models(&["x"]), "x"), "x");
        let lines: Vec<usize> = text.lines().map(|l| l.split(',').count()).collect();
        assert_eq!(lines, [5 + 4 * METRICS.len() + 1; 2]);
        assert!(text.lines().nth(1).unwrap().starts_with("x,all,1,0,x,8,8,8,1,"));
    }
}
