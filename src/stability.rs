//! How much a method's result changes when its input is not what it should be.
//!
//! Every [`Trial`] changes the noisy frames of a test set in one known way, always the same. Scene by scene the result is
//! scored against what the reference then is, and beside the result for the frame as it was rendered: `ratio` is its
//! RelMSE over that one's, `deviation` the RelMSE between the two. A method that is indifferent to the change has a
//! ratio of 1 and a deviation of 0. Methods see what is in the frame alone: half buffers that lie beside it, which do not have the
//! change, are not used, not for the frame as it was rendered either.

use std::path::Path;

use crate::{
    Error, Result,
    augment::Augment,
    error::attempt,
    frame::prepare_folder,
    metrics::{self, error::relmse},
    passes::{Pass, PassSet},
    planes::Planes,
    report::{self, Loaded, Method, append_row, cell, geometric_mean, to_csv, write_file},
    shot::Shot,
    testset::Pair,
};

/// One way to change a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trial {
    /// Nothing changes: what the others are measured by.
    AsRendered,
    /// Radiance is a 256th: physical units, moonlight.
    Darker,
    /// Radiance is 256 times as high.
    Brighter,
    /// Left and right change places.
    Mirrored,
    /// The frame begins 5 pixels further right and 3 further down: a network's grid falls elsewhere.
    Cropped,
    /// One pixel in 1024 is a firefly of 1000 times the mean radiance.
    Fireflies,
    /// One pixel in 1024 of every pass is NaN or infinite.
    NonFinite,
    /// Guides are 2 pixels further right than radiance, as those of a compositor that moved one layer.
    ShiftedGuides,
    /// Guides hold nothing: all zero.
    BlankGuides,
}

/// Factor of [`Trial::Darker`] and its inverse's of [`Trial::Brighter`].
const DARK: f32 = 1.0 / 256.0;

/// First column and row of [`Trial::Cropped`]; no multiple of what networks halve by.
const CORNER: (usize, usize) = (5, 3);

/// Radiance of a firefly over the frame's mean.
const FIREFLY: f64 = 1000.0;

/// Columns by which [`Trial::ShiftedGuides`] moves guides.
const SHIFT: usize = 2;

impl Trial {
    /// Every trial, the unchanged frame first.
    pub const ALL: [Self; 9] = [
        Self::AsRendered,
        Self::Darker,
        Self::Brighter,
        Self::Mirrored,
        Self::Cropped,
        Self::Fireflies,
        Self::NonFinite,
        Self::ShiftedGuides,
        Self::BlankGuides,
    ];

    /// Its name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::AsRendered => "as-rendered",
            Self::Darker => "darker",
            Self::Brighter => "brighter",
            Self::Mirrored => "mirrored",
            Self::Cropped => "cropped",
            Self::Fireflies => "fireflies",
            Self::NonFinite => "non-finite",
            Self::ShiftedGuides => "shifted-guides",
            Self::BlankGuides => "blank-guides",
        }
    }

    /// What it does, for a reader of its name.
    pub fn meaning(self) -> &'static str {
        match self {
            Self::AsRendered => "nothing changes: what the others are measured by",
            Self::Darker => "radiance is a 256th",
            Self::Brighter => "radiance is 256 times as high",
            Self::Mirrored => "left and right change places",
            Self::Cropped => "the frame begins 5 pixels further right and 3 further down",
            Self::Fireflies => "one pixel in 1024 has 1000 times the mean radiance",
            Self::NonFinite => "one pixel in 1024 of every pass is NaN or infinite",
            Self::ShiftedGuides => "guides are 2 pixels further right than radiance",
            Self::BlankGuides => "guides hold nothing",
        }
    }

    /// The change as an augmentation, where it is one.
    fn augment(self) -> Option<Augment> {
        match self {
            Self::Darker => Some(Augment { exposure: DARK, ..Augment::IDENTITY }),
            Self::Brighter => Some(Augment { exposure: DARK.recip(), ..Augment::IDENTITY }),
            Self::Mirrored => Some(Augment { flip: true, ..Augment::IDENTITY }),
            _ => None,
        }
    }

    /// The changed frame; values may be NaN.
    fn change(self, passes: &PassSet) -> PassSet {
        if let Some(augment) = self.augment() {
            return augment.passes(passes);
        }
        let (width, height) = (passes.width, passes.height);
        match self {
            Self::Cropped => {
                let size = (width.saturating_sub(CORNER.0), height.saturating_sub(CORNER.1));
                passes.map(size, |_, planes| self.seen(planes))
            }
            Self::Fireflies => passes.map((width, height), |pass, planes| {
                let mut planes = planes.clone();
                if pass == Pass::Combined {
                    let sum: f64 = planes.data.iter().map(|v| f64::from(*v)).sum();
                    let firefly = (FIREFLY * sum / planes.data.len().max(1) as f64) as f32;
                    let pixels = planes.pixels();
                    (0..pixels).filter(|&at| is_chosen(at)).for_each(|at| {
                        (0..3).for_each(|c| planes.data[c * pixels + at] = firefly);
                    });
                }
                planes
            }),
            Self::NonFinite => passes.map((width, height), |_, planes| {
                const BAD: [f32; 3] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
                let mut planes = planes.clone();
                let pixels = planes.pixels();
                for (c, plane) in planes.data.chunks_mut(pixels.max(1)).enumerate() {
                    (0..pixels)
                        .filter(|&at| is_chosen(at))
                        .for_each(|at| plane[at] = BAD[(at + c) % BAD.len()]);
                }
                planes
            }),
            Self::ShiftedGuides => passes.map((width, height), |pass, planes| {
                let mut shifted = planes.clone();
                if !pass.carries_radiance() {
                    for (row, from) in shifted.data.chunks_mut(width).zip(planes.data.chunks(width)) {
                        row.iter_mut().enumerate().for_each(|(x, v)| *v = from[x.saturating_sub(SHIFT)]);
                    }
                }
                shifted
            }),
            Self::BlankGuides => passes.map((width, height), |pass, planes| {
                let blank = || Planes::new(planes.channels, width, height);
                if pass.carries_radiance() { planes.clone() } else { blank() }
            }),
            _ => passes.clone(),
        }
    }

    /// The result for the changed frame as one for the frame as it was rendered.
    fn undo(self, mut image: Planes) -> Planes {
        match self {
            Self::Mirrored => image.data.chunks_mut(image.width).for_each(<[f32]>::reverse),
            Self::Darker => image.data.iter_mut().for_each(|v| *v /= DARK),
            Self::Brighter => image.data.iter_mut().for_each(|v| *v *= DARK),
            _ => {}
        }
        image
    }

    /// What of an image is in the changed frame.
    fn seen(self, image: &Planes) -> Planes {
        match self {
            Self::Cropped => {
                let (x, y) = (CORNER.0.min(image.width), CORNER.1.min(image.height));
                image.window((x, y), (image.width - x, image.height - y))
            }
            _ => image.clone(),
        }
    }
}

/// One pixel in 1024, spread by the hash of its index (Knuth's multiplicative one).
fn is_chosen(pixel: usize) -> bool {
    (pixel as u32).wrapping_mul(2_654_435_761) >> 22 == 0
}

/// What one method made of one changed frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Row {
    /// Scene, with the frame of a sequence.
    pub scene: String,
    /// Method.
    pub model: String,
    /// Samples per pixel of the noisy render.
    pub spp: u32,
    /// Name of the trial.
    pub trial: &'static str,
    /// RelMSE against what of the reference is in the frame.
    pub relmse: Option<f64>,
    /// The same over that of the frame as rendered.
    pub ratio: Option<f64>,
    /// RelMSE between this result and that for the frame as rendered.
    pub deviation: Option<f64>,
    /// Why the trial failed; empty where all is well.
    pub reason: String,
    /// Why a number is missing where nothing failed.
    pub note: String,
}

/// Columns of `stability.csv`.
const COLUMNS: [&str; 9] =
    ["scene", "model", "spp", "trial", "relmse", "ratio", "deviation", "reason", "note"];

/// Columns of `stability_summary.csv`; `scenes` are those that have a ratio.
const SUMMARY_COLUMNS: [&str; 8] =
    ["model", "trial", "scenes", "failed", "ratio", "worst_ratio", "worst_scene", "worst_deviation"];

impl Row {
    fn cells(&self) -> [String; COLUMNS.len()] {
        [
            self.scene.clone(),
            self.model.clone(),
            self.spp.to_string(),
            self.trial.into(),
            cell(self.relmse),
            cell(self.ratio),
            cell(self.deviation),
            self.reason.clone(),
            self.note.clone(),
        ]
    }
}

/// Runs every trial of every method on every pair. Each row is appended to `stability.csv` in `out`, then told;
/// `stability_summary.csv` is written at the end. A pair or method that fails has rows that say why.
///
/// # Errors
/// The tables cannot be written.
pub fn run(
    pairs: &[Pair],
    methods: &[Method],
    view_layer: Option<&str>,
    out: &Path,
    on: &mut dyn FnMut(&Row),
) -> Result<Vec<Row>> {
    prepare_folder(out)?;
    let table = out.join("stability.csv");
    write_file(&table, to_csv::<Vec<String>>(&COLUMNS, []).as_bytes())?;
    let mut rows = Vec::new();
    for pair in pairs {
        let loaded = report::load_listed(pair, view_layer);
        for method in methods {
            let mut before = None;
            for trial in Trial::ALL {
                let mut row = Row {
                    scene: pair.label(),
                    model: method.name.clone(),
                    spp: pair.spp,
                    trial: trial.name(),
                    ..Row::default()
                };
                match &loaded {
                    Ok(loaded) => {
                        let measured =
                            attempt(&pair.noisy, || measure(trial, method, loaded, &mut before, &mut row));
                        row.reason = measured.err().map(|error| error.to_string()).unwrap_or_default();
                    }
                    Err(error) => row.reason = error.to_string(),
                }
                append_row(&table, &row.cells())?;
                on(&row);
                rows.push(row);
            }
        }
    }
    let summary = summarise(&rows, methods);
    write_file(&out.join("stability_summary.csv"), to_csv(&SUMMARY_COLUMNS, &summary).as_bytes())?;
    Ok(rows)
}

/// Fills in the numbers of one trial; `before` is the result for the frame as rendered, which the first trial leaves there.
fn measure(
    trial: Trial,
    method: &Method,
    loaded: &Loaded,
    before: &mut Option<Planes>,
    row: &mut Row,
) -> Result<()> {
    let (width, height) = (loaded.shot.passes.width, loaded.shot.passes.height);
    if trial == Trial::Cropped && (width <= CORNER.0 || height <= CORNER.1) {
        row.note =
            format!("skipped: {}x{} pixels less leave nothing of {width}x{height}", CORNER.0, CORNER.1);
        return Ok(());
    }
    // Half buffers beside the frame do not have the change: the shot has none.
    let shot = Shot::new(trial.change(&loaded.shot.passes));
    let image = trial.undo(method.denoiser.denoise(&shot)?);
    let reference = trial.seen(&loaded.reference);
    metrics::check(&image, &reference).map_err(|why| Error::invalid(&shot.passes.path, why))?;
    let error = relmse(&image, &reference);
    row.relmse = Some(error);
    if trial == Trial::AsRendered {
        (row.ratio, row.deviation) = (Some(1.0), Some(0.0));
        *before = Some(image);
        return Ok(());
    }
    let Some(before) = before else {
        row.note = "no ratio, no deviation: there is no result for the frame as rendered".into();
        return Ok(());
    };
    let before = trial.seen(before);
    row.deviation = Some(relmse(&image, &before));
    match relmse(&before, &reference) {
        0.0 => row.note = "no ratio: the result for the frame as rendered is exact".into(),
        before => row.ratio = Some(error / before),
    }
    Ok(())
}

/// A line for each method and trial.
fn summarise(rows: &[Row], methods: &[Method]) -> Vec<[String; SUMMARY_COLUMNS.len()]> {
    let lines = methods.iter().flat_map(|method| Trial::ALL.map(|trial| (method, trial)));
    lines
        .map(|(method, trial)| {
            let own = || rows.iter().filter(|row| row.model == method.name && row.trial == trial.name());
            let ratios: Vec<(f64, &str)> =
                own().filter_map(|row| Some((row.ratio?, row.scene.as_str()))).collect();
            let mean = geometric_mean(&ratios.iter().map(|(ratio, _)| *ratio).collect::<Vec<_>>());
            let worst = ratios.iter().max_by(|a, b| a.0.total_cmp(&b.0));
            let deviation = own().filter_map(|row| row.deviation).max_by(f64::total_cmp);
            let failed = own().filter(|row| !row.reason.is_empty()).count();
            [
                method.name.clone(),
                trial.name().into(),
                ratios.len().to_string(),
                failed.to_string(),
                cell(mean),
                cell(worst.map(|(ratio, _)| *ratio)),
                worst.map(|(_, scene)| (*scene).into()).unwrap_or_default(),
                cell(deviation),
            ]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::models::Denoiser;

    fn frame() -> PassSet {
        let mut passes = PassSet::new("test.exr", "ViewLayer", 64, 64);
        for (i, pass) in
            [Pass::Combined, Pass::DenoisingAlbedo, Pass::DenoisingNormal].into_iter().enumerate()
        {
            let values = (0..3 * 64 * 64).map(|v| (v % 61) as f32 / 60.0 + i as f32 / 8.0).collect();
            passes.insert(pass, Planes::from_vec(3, 64, 64, values));
        }
        passes
    }

    /// What a change does to radiance is undone, but for what it adds on purpose.
    #[test]
    fn changes_are_undone() {
        let before = frame();
        let radiance = before.get(Pass::Combined).unwrap();
        for trial in Trial::ALL {
            let after = trial.change(&before);
            let image = trial.undo(after.get(Pass::Combined).unwrap().clone());
            let same = image == trial.seen(radiance);
            assert_eq!(same, !matches!(trial, Trial::Fireflies | Trial::NonFinite), "{}", trial.name());
            let albedo = after.get(Pass::DenoisingAlbedo).unwrap();
            let kept = *albedo == trial.seen(before.get(Pass::DenoisingAlbedo).unwrap());
            let moved = [Trial::Mirrored, Trial::NonFinite, Trial::ShiftedGuides, Trial::BlankGuides];
            assert_eq!(kept, !moved.contains(&trial), "{}", trial.name());
        }
    }

    /// Fails on fireflies as no method should.
    struct Delicate;

    impl Denoiser for Delicate {
        fn name(&self) -> &str {
            "delicate"
        }

        fn passes(&self) -> &[Pass] {
            &[Pass::Combined]
        }

        fn denoise(&self, shot: &Shot) -> Result<Planes> {
            let radiance = shot.passes.require(Pass::Combined, "delicate")?;
            let (mean, most) = radiance
                .data
                .iter()
                .fold((0.0, 0.0), |(mean, most), v| (mean + v / radiance.data.len() as f32, v.max(most)));
            assert!(most < 100.0 * mean, "on purpose");
            Ok(radiance.clone())
        }
    }

    #[test]
    fn rows_are_stored_as_they_finish_and_a_panic_costs_one() {
        let out = tempfile::tempdir().unwrap();
        let frame = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/s0000_room_0004spp.exr");
        let pairs = crate::testset::read(frame).unwrap().pairs;
        let method = Method {
            name: "delicate".into(),
            denoiser: Box::new(Delicate),
            peak_mib: Box::new(|_| None),
            stamp: String::new(),
        };
        let mut told = 0;
        let rows = run(&pairs, &[method], None, out.path(), &mut |row| {
            told += 1;
            let text = std::fs::read_to_string(out.path().join("stability.csv")).unwrap();
            assert_eq!(text.lines().count(), 1 + told);
            assert!(text.lines().last().unwrap().contains(row.trial), "{text}");
        })
        .unwrap();
        assert_eq!((rows.len(), told), (Trial::ALL.len(), Trial::ALL.len()));
        for row in rows {
            let failed = row.trial == Trial::Fireflies.name();
            assert_eq!(
                (row.relmse.is_none(), row.reason.contains("internal error")),
                (failed, failed),
                "{row:?}"
            );
        }
    }

    #[test]
    fn one_pixel_in_1024_is_chosen() {
        let chosen = (0..1 << 20).filter(|&at| is_chosen(at)).count();
        assert!((900..1150).contains(&chosen), "{chosen}");
        assert!((0..64 * 64).any(is_chosen), "small frames have some too");
    }
}
