//! How methods do on each scene of a test set as it was rendered: a row for each scene, sample count and
//! method, with the spread over noise seeds, and whether it is within the bounds.
//!
//! In: the rows of [`super::run`]. Renders of one scene at one sample count count as its noise seeds. Two
//! bounds apply. The result has at most the input's RelMSE, since a denoiser that makes a frame worse had
//! better be off; where the input is exact, at most a RelMSE of 0.0001. And the sum of
//! its light is within 2% of the reference's, about the least difference in brightness that an eye sees
//! (Weber's fraction). This tolerance grows by as much as the input's own sum is off, since the input may have fireflies or lack light that only few paths find.
//! Where the input itself has no score, as without a reference, no method is judged.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

use super::{Trial, TrialRow};
use crate::report::{Column, HeatCell, HeatMap, NOISY, cell, geometric_mean, mean, number, plural};

/// RelMSE that a method may bring to an input that is exact: nothing that an eye sees.
const HARMLESS: f64 = 1e-4;

/// How far the energy of a result may be from one, in addition to how far its input's is.
const ENERGY: f64 = 0.02;

/// Columns of `stability_scenes.csv`.
pub const COLUMNS: [Column<Case>; 12] = [
    ("scene", |case| case.scene.clone()),
    ("spp", |case| case.spp.to_string()),
    ("model", |case| case.model.clone()),
    ("seeds", |case| case.seeds.len().to_string()),
    ("failed", |case| case.failed.to_string()),
    ("relmse", |case| cell(case.relmse)),
    ("spread", |case| cell(case.spread)),
    ("to_input", |case| cell(case.to_input)),
    ("to_baseline", |case| cell(case.to_baseline)),
    ("ssim", |case| cell(case.ssim)),
    ("energy", |case| cell(case.energy)),
    ("verdict", Case::verdict),
];

/// The results of one method on one scene at one sample count.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Case {
    /// Scene, and the frame where it belongs to a sequence.
    pub scene: String,
    /// The reference, which tells frames of one name apart.
    pub reference: PathBuf,
    /// Samples per pixel of the noisy renders.
    pub spp: u32,
    /// Method.
    pub model: String,
    /// The renders, one for each noise seed.
    pub seeds: Vec<PathBuf>,
    /// The number of renders on which the method failed.
    pub failed: usize,
    /// Mean RelMSE over seeds.
    pub relmse: Option<f64>,
    /// Standard deviation of RelMSE over seeds, as a share of the mean; none for a single seed.
    pub spread: Option<f64>,
    /// RelMSE over that of the input: geometric mean over seeds.
    pub to_input: Option<f64>,
    /// RelMSE over that of the baseline: geometric mean over seeds.
    pub to_baseline: Option<f64>,
    /// Mean SSIM over seeds.
    pub ssim: Option<f64>,
    /// Mean over seeds of the ratio of the sum of all values to the reference's.
    pub energy: Option<f64>,
    /// Whether it is held against the bounds: the input itself is not, nor any method where the input has no score
    /// either, since that is a fault of the pair.
    pub is_judged: bool,
    /// What is out of bounds; empty where all is well, and where it is not judged.
    pub faults: Vec<String>,
}

impl Case {
    /// What tells a frame from others: its scene and its reference.
    fn frame(&self) -> (&str, &Path) {
        (&self.scene, &self.reference)
    }

    /// Whether it is within the bounds; none where it is not judged.
    pub fn passes(&self) -> Option<bool> {
        self.is_judged.then_some(self.faults.is_empty())
    }

    /// In words: whether it is within the bounds, and else why not; empty where it is not judged.
    fn verdict(&self) -> String {
        match self.passes() {
            None => String::new(),
            Some(true) => "pass".into(),
            Some(false) => format!("fail: {}", self.faults.join("; ")),
        }
    }

    /// Finds the faults, given the number of renders that the method alone failed on, the energy of the input, and the
    /// largest RelMSE where the input had none.
    fn judge(&mut self, lost: usize, input_energy: Option<f64>, harm: f64) {
        if lost > 0 {
            self.faults.push(format!("no result for {lost} render{}", plural(lost)));
        }
        if let Some(ratio) = self.to_input.filter(|ratio| *ratio > 1.0) {
            self.faults.push(format!("{} x the input's RelMSE", number(ratio)));
        }
        if harm > HARMLESS {
            self.faults.push(format!("RelMSE {harm:.1e} where the input is exact"));
        }
        if let (Some(energy), Some(input)) = (self.energy, input_energy)
            && (energy - 1.0).abs() > ENERGY + (input - 1.0).abs()
        {
            self.faults.push(format!("{:.1}% of the reference's light", 100.0 * energy));
        }
    }
}

/// The cases of all frames as they were rendered, in the order of the rows.
pub fn cases(rows: &[TrialRow], baseline: &str) -> Vec<Case> {
    type Frame<'a> = (&'a str, &'a Path, u32);
    let mut groups: Vec<((Frame, &str), Vec<&TrialRow>)> = Vec::new();
    for row in rows.iter().filter(|row| row.trial == Trial::AsRendered.name()) {
        let key = ((row.scene.as_str(), row.reference.as_path(), row.spp), row.model.as_str());
        match groups.iter_mut().find(|(known, _)| *known == key) {
            Some((_, own)) => own.push(row),
            None => groups.push((key, vec![row])),
        }
    }
    let of = |frame: Frame, model: &str| {
        let found = groups.iter().find(|(known, _)| *known == (frame, model));
        found.map(|(_, own)| own.as_slice()).unwrap_or_default()
    };
    let has_input = groups.iter().any(|((_, model), _)| *model == NOISY);
    let case = |&((frame, model), ref own): &((Frame, &str), Vec<&TrialRow>)| {
        let (scene, reference, spp) = frame;
        let values = |value: fn(&TrialRow) -> Option<f64>| -> Vec<f64> {
            own.iter().filter_map(|row| value(row)).collect()
        };
        let relmse = values(|row| row.relmse);
        let against = |other: &str| {
            let other = of(frame, other);
            let ratios = own.iter().filter_map(|row| {
                let twin = other.iter().find(|twin| twin.noisy == row.noisy)?;
                Some(row.relmse? / twin.relmse.filter(|error| *error > 0.0)?)
            });
            geometric_mean(&ratios.collect::<Vec<f64>>())
        };
        let is_exact = |row: &&&TrialRow| {
            of(frame, NOISY).iter().any(|twin| twin.noisy == row.noisy && twin.relmse == Some(0.0))
        };
        let harm = own.iter().filter(is_exact).filter_map(|row| row.relmse).fold(0.0, f64::max);
        let is_lost = |row: &&&TrialRow| {
            let mut twins = of(frame, NOISY).iter().filter(|twin| twin.noisy == row.noisy);
            !row.reason.is_empty() && twins.all(|twin| twin.reason.is_empty())
        };
        let lost = own.iter().filter(is_lost).count();
        let is_input_scored = of(frame, NOISY).iter().any(|twin| twin.reason.is_empty());
        let input: Vec<f64> = of(frame, NOISY).iter().filter_map(|row| row.energy).collect();
        let mut case = Case {
            scene: scene.into(),
            reference: reference.into(),
            spp,
            model: model.into(),
            seeds: own.iter().map(|row| row.noisy.clone()).collect(),
            failed: own.iter().filter(|row| !row.reason.is_empty()).count(),
            relmse: mean(&relmse),
            spread: spread(&relmse),
            to_input: against(NOISY),
            to_baseline: against(baseline),
            ssim: mean(&values(|row| row.ssim)),
            energy: mean(&values(|row| row.energy)),
            is_judged: model != NOISY && (is_input_scored || !has_input),
            faults: Vec::new(),
        };
        if case.is_judged {
            case.judge(lost, mean(&input), harm);
        }
        case
    };
    groups.iter().map(case).collect()
}

/// A map of scenes by methods, with a group of columns for each sample count.
pub fn map(title: String, methods: &[String], cases: &[Case], value: fn(&Case) -> Option<f64>) -> HeatMap {
    let counts: Vec<u32> = cases.iter().map(|case| case.spp).collect::<BTreeSet<_>>().into_iter().collect();
    let mut scenes: Vec<(&str, &Path)> = Vec::new();
    for case in cases {
        if !scenes.contains(&case.frame()) {
            scenes.push(case.frame());
        }
    }
    let cell = |frame: (&str, &Path), spp: u32, model: &String| {
        let of_cell = |case: &&Case| case.frame() == frame && case.spp == spp && case.model == *model;
        let case = cases.iter().find(of_cell);
        let is_marked = case.is_some_and(|case| !case.faults.is_empty());
        HeatCell { value: case.and_then(value), is_marked }
    };
    let row = |frame: &(&str, &Path)| {
        let cells = counts.iter().flat_map(|spp| methods.iter().map(move |model| (*spp, model)));
        (frame.0.to_owned(), cells.map(|(spp, model)| cell(*frame, spp, model)).collect())
    };
    HeatMap {
        title,
        methods: methods.to_vec(),
        groups: counts.iter().map(|spp| format!("{spp} spp")).collect(),
        rows: scenes.iter().map(row).collect(),
    }
}

fn spread(values: &[f64]) -> Option<f64> {
    let mean = mean(values).filter(|mean| values.len() > 1 && *mean > 0.0)?;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    Some((squares / (values.len() - 1) as f64).sqrt() / mean)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(model: &str, seed: usize, relmse: f64, energy: f64) -> TrialRow {
        TrialRow {
            scene: "fog".into(),
            model: model.into(),
            spp: 4,
            noisy: format!("fog_{seed}.exr").into(),
            trial: Trial::AsRendered.name(),
            relmse: Some(relmse),
            ssim: Some(0.5),
            energy: Some(energy),
            ..TrialRow::default()
        }
    }

    #[test]
    fn what_harms_an_exact_input_fails() {
        let rows = [
            row(NOISY, 0, 0.0, 1.0),
            row("gentle", 0, 1e-5, 1.0),
            row("harmful", 0, 0.05, 1.0),
            row(NOISY, 1, 0.2, 1.0),
            row("gentle", 1, 0.1, 1.0),
            row("harmful", 1, 0.1, 1.0),
        ];
        let cases = cases(&rows, NOISY);
        assert_eq!(cases.iter().map(Case::passes).collect::<Vec<_>>(), [None, Some(true), Some(false)]);
        assert!(
            cases[2].faults[0].contains("RelMSE 5.0e-2 where the input is exact"),
            "{:?}",
            cases[2].faults
        );
    }

    #[test]
    fn seeds_are_put_together_and_judged() {
        let rows = [
            row(NOISY, 0, 0.2, 1.05),
            row("good", 0, 0.1, 1.06),
            row("dark", 0, 0.1, 0.9),
            row("bad", 0, 0.4, 1.0),
            row(NOISY, 1, 0.4, 1.01),
            row("good", 1, 0.3, 1.0),
            row("dark", 1, 0.1, 0.92),
            row("bad", 1, 0.9, 1.0),
            TrialRow { trial: Trial::Mirrored.name(), ..row("good", 0, 9.0, 9.0) },
        ];
        let cases = cases(&rows, "good");
        let names: Vec<&str> = cases.iter().map(|case| case.model.as_str()).collect();
        assert_eq!(names, [NOISY, "good", "dark", "bad"]);
        assert_eq!(
            cases.iter().map(Case::passes).collect::<Vec<_>>(),
            [None, Some(true), Some(false), Some(false)]
        );
        let good = &cases[1];
        assert_eq!((good.seeds.len(), good.relmse), (2, Some(0.2)));
        // (0.1 / 0.2 * 0.3 / 0.4)^(1/2), and the deviation of 0.1 and 0.3 by n - 1 over their mean.
        assert!((good.to_input.unwrap() - 0.375f64.sqrt()).abs() < 1e-12);
        assert!((good.spread.unwrap() - 0.02f64.sqrt() / 0.2).abs() < 1e-12);
        assert!((cases[3].to_baseline.unwrap() - 12.0f64.sqrt()).abs() < 1e-12);
        assert!(cases[2].verdict().contains("91.0% of the reference's light"), "{:?}", cases[2].verdict());
        assert!(cases[3].verdict().contains("x the input's RelMSE"));
    }

    #[test]
    fn what_gave_no_result_fails() {
        let failed =
            TrialRow { relmse: None, ssim: None, energy: None, reason: "no".into(), ..row("m", 0, 0.0, 0.0) };
        let cases = cases(&[row(NOISY, 0, 0.1, 1.0), failed], NOISY);
        assert_eq!((cases[1].passes(), cases[1].relmse, cases[1].to_input), (Some(false), None, None));
    }

    #[test]
    fn faults_of_the_pair_are_not_the_method_s() {
        let failed = |model: &str, seed: usize| TrialRow {
            relmse: None,
            ssim: None,
            energy: None,
            reason: "no reference".into(),
            ..row(model, seed, 0.0, 0.0)
        };
        let judged = |rows: &[TrialRow]| cases(rows, NOISY).iter().map(Case::passes).collect::<Vec<_>>();
        assert_eq!(judged(&[failed(NOISY, 0), failed("m", 0)]), [None, None]);
        // Nor where another noise seed has a reference.
        let rows = [failed(NOISY, 0), failed("m", 0), row(NOISY, 1, 0.2, 1.0), row("m", 1, 0.1, 1.0)];
        assert_eq!(judged(&rows), [None, Some(true)]);
        assert_eq!(judged(&[failed("m", 0)]), [Some(false)], "nothing tells of the pair without the input");
    }

    #[test]
    fn a_ratio_barely_above_one_is_told_as_such() {
        let cases = cases(&[row(NOISY, 0, 1.0, 1.0), row("m", 0, 1.001105, 1.0)], NOISY);
        assert_eq!(cases[1].verdict(), "fail: 1.001105 x the input's RelMSE");
    }
}
