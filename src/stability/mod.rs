//! How much a method's result changes when its input is not what it should be, and on which scenes it fails
//! without any change.
//!
//! Every [`Trial`] changes the noisy frames of a test set in one known way that is always the same. Frame by
//! frame, the result is compared with the reference, cropped as the trial crops the frame, and with the
//! result for the frame as it was rendered: `ratio` is the RelMSE of the first result over that of the
//! second, and `deviation` the RelMSE between the two. A method that is indifferent to the change has a ratio
//! of 1 and a deviation of 0. Methods see only what is in the frame. Half buffers that lie beside it do not
//! have the change, so they are never used, not even for the frame as it was rendered. Results for frames as
//! they were rendered are judged in [`content`].

pub mod content;
mod page;
mod trial;

use std::path::PathBuf;

use crate::{
    Error, Result,
    error::attempt,
    frame::{alone_in, prepare_folder, write_file},
    metrics::{self, display, error, ssim},
    planes::Planes,
    report::{
        self, Column, Contender, EvalEvent, Figure, HeatCell, HeatMap, Loaded, NOISY, Provenance, append_row,
        cell, geometric_mean, to_csv, write_json,
    },
    shot::Shot,
    testset::Pair,
};

use content::Case;
use trial::CORNER;
pub use trial::Trial;

/// The result of one method on one changed frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrialRow {
    /// Scene, and the frame where it belongs to a sequence.
    pub scene: String,
    /// Method.
    pub model: String,
    /// Samples per pixel of the noisy render.
    pub spp: u32,
    /// The noisy file: renders of one scene and sample count differ in their noise.
    pub noisy: PathBuf,
    /// The reference; renders of one scene with several of them are different frames.
    pub reference: PathBuf,
    /// Name of the trial.
    pub trial: &'static str,
    /// RelMSE against the part of the reference that the changed frame shows.
    pub relmse: Option<f64>,
    /// SSIM against the same part; see [`crate::metrics`].
    pub ssim: Option<f64>,
    /// The ratio of the sum of all values to the reference's; none where the reference's is not positive.
    pub energy: Option<f64>,
    /// RelMSE over that of the frame as rendered.
    pub ratio: Option<f64>,
    /// RelMSE between this result and that for the frame as rendered.
    pub deviation: Option<f64>,
    /// Why the trial failed; empty where all is well.
    pub reason: String,
    /// Why a number is missing where nothing failed.
    pub note: String,
}

/// Columns of `stability.csv`.
const COLUMNS: [Column<TrialRow>; 12] = [
    ("scene", |row| row.scene.clone()),
    ("model", |row| row.model.clone()),
    ("spp", |row| row.spp.to_string()),
    ("trial", |row| row.trial.into()),
    ("relmse", |row| cell(row.relmse)),
    ("ratio", |row| cell(row.ratio)),
    ("deviation", |row| cell(row.deviation)),
    ("reason", |row| row.reason.clone()),
    ("note", |row| row.note.clone()),
    ("ssim", |row| cell(row.ssim)),
    ("energy", |row| cell(row.energy)),
    ("noisy", |row| row.noisy.display().to_string()),
];

/// Columns of `stability_summary.csv`; `scenes` are those that have a ratio.
const SUMMARY_COLUMNS: [Column<Summary>; 8] = [
    ("model", |row| row.model.clone()),
    ("trial", |row| row.trial.name().into()),
    ("scenes", |row| row.scenes.to_string()),
    ("failed", |row| row.failed.to_string()),
    ("ratio", |row| cell(row.ratio)),
    ("worst_ratio", |row| cell(row.worst.as_ref().map(|(ratio, _)| *ratio))),
    ("worst_scene", |row| row.worst.as_ref().map_or(String::new(), |(_, scene)| scene.clone())),
    ("worst_deviation", |row| cell(row.worst_deviation)),
];

/// What to run, and where to write.
#[derive(Clone, Debug)]
pub struct StabilityOptions {
    /// Folder for everything that is written.
    pub out: PathBuf,
    /// View layer to read; by default the one with the most passes.
    pub view_layer: Option<String>,
    /// The changes to try. Without [`Trial::AsRendered`] there are no ratios and no results on scenes as they
    /// were rendered.
    pub trials: Vec<Trial>,
    /// Method whose RelMSE is the denominator of `to_baseline`.
    pub baseline: String,
    /// How many of the worst scenes are shown with pictures.
    pub worst: usize,
    /// Threads that all methods use.
    pub threads: usize,
}

/// Runs every trial of every method on every pair. Each row is appended to `stability.csv` and then given to
/// `on`; at the end `stability_summary.csv` (trials), `stability_scenes.csv` (scenes as rendered), their maps
/// and `stability.html` are written. Rows of a pair or method that fails say why.
///
/// # Errors
/// A file cannot be written, or another run writes to the folder.
pub fn run(
    pairs: &[Pair],
    methods: &[Contender],
    options: &StabilityOptions,
    on: &mut dyn FnMut(&TrialRow),
) -> Result<(Vec<TrialRow>, Vec<Case>)> {
    let out = &options.out;
    prepare_folder(out)?;
    let _alone = alone_in(out)?;
    let provenance = Provenance::now();
    let made = serde_json::json!({ "provenance": &provenance, "threads": options.threads });
    write_json(&out.join("run.json"), &made)?;
    let table = out.join("stability.csv");
    write_file(&table, to_csv(&COLUMNS, []).as_bytes())?;
    let mut rows = Vec::new();
    for pair in pairs {
        let loaded = report::load_listed(pair, options.view_layer.as_deref());
        for method in methods {
            let mut before = None;
            for &trial in &options.trials {
                let mut row = TrialRow {
                    scene: pair.label(),
                    model: method.name.clone(),
                    spp: pair.spp,
                    noisy: pair.noisy.clone(),
                    reference: pair.reference.clone(),
                    trial: trial.name(),
                    ..TrialRow::default()
                };
                match &loaded {
                    Ok(loaded) => {
                        let measured =
                            attempt(&pair.noisy, || measure(trial, method, loaded, &mut before, &mut row));
                        row.reason = measured.err().map(|error| error.to_string()).unwrap_or_default();
                    }
                    Err(error) => row.reason = error.to_string(),
                }
                append_row(&table, &COLUMNS, &row)?;
                on(&row);
                rows.push(row);
            }
        }
    }
    let summary = summarise(&rows, methods, &options.trials);
    write_file(&out.join("stability_summary.csv"), to_csv(&SUMMARY_COLUMNS, &summary).as_bytes())?;
    let cases = content::cases(&rows, &options.baseline);
    write_file(&out.join("stability_scenes.csv"), to_csv(&content::COLUMNS, &cases).as_bytes())?;
    show(pairs, methods, options, &provenance, (&summary, &cases))?;
    Ok((rows, cases))
}

/// Draws the maps, and the worst scenes with pictures.
fn show(
    pairs: &[Pair],
    methods: &[Contender],
    options: &StabilityOptions,
    provenance: &Provenance,
    (summary, cases): (&[Summary], &[Case]),
) -> Result<()> {
    let names: Vec<String> = methods.iter().map(|method| method.name.clone()).collect();
    // What this run has nothing for is not left over from another.
    for name in ["map_input", "map_baseline", "map_trials"] {
        report::remove_chart(&options.out, name)?;
    }
    let folder = options.out.join("worst");
    if folder.join("report.html").is_file() {
        std::fs::remove_dir_all(&folder).map_err(Error::io("remove", &folder))?;
    }
    let mut maps = Vec::new();
    if !cases.is_empty() {
        let title = "RelMSE over the input's (below 1 is better; framed: out of bounds)".into();
        let map = content::map(title, &names, cases, |case| case.to_input);
        maps.push(("Scenes, beside the input", map, "map_input"));
    }
    if !cases.is_empty() && options.baseline != NOISY {
        let title =
            format!("RelMSE over that of {} (below 1 is better; framed: out of bounds)", options.baseline);
        let map = content::map(title, &names, cases, |case| case.to_baseline);
        maps.push(("Scenes, beside the baseline", map, "map_baseline"));
    }
    if options.trials.iter().any(|trial| *trial != Trial::AsRendered) {
        let map = map_of_trials(names.clone(), &options.trials, summary);
        maps.push(("Inputs gone wrong", map, "map_trials"));
    }
    let maps = maps.into_iter().map(|(title, map, name)| Ok((title, map.write(&options.out, name)?)));
    let maps: Vec<(&str, String)> = maps.collect::<Result<_>>()?;
    let worst = worst(pairs, cases, options);
    if !worst.is_empty() {
        let shown = report::EvalOptions {
            out: folder.clone(),
            repeats: 1,
            threads: options.threads,
            baseline: options.baseline.clone(),
            view_layer: options.view_layer.clone(),
            overwrite: true,
            sheets: true,
        };
        report::evaluate(&worst, methods, &shown, &mut |_: EvalEvent<'_>| {})?;
    }
    page::write(options, &maps, cases, &worst, provenance)
}

/// A map whose rows are trials and whose values are ratios: RelMSE over that of the frame as rendered.
fn map_of_trials(methods: Vec<String>, trials: &[Trial], summaries: &[Summary]) -> HeatMap {
    let cells = |trial: Trial| {
        let of_trial = summaries.iter().filter(move |line| line.trial == trial);
        of_trial.map(|line| HeatCell { value: line.ratio, is_marked: line.failed > 0 }).collect()
    };
    let rows = trials.iter().filter(|trial| **trial != Trial::AsRendered);
    HeatMap {
        title: "RelMSE over that of the frame as rendered (1 is best; framed: some have no result)".into(),
        methods,
        groups: vec![String::new()],
        rows: rows.map(|trial| (trial.name().to_owned(), cells(*trial))).collect(),
    }
}

/// The renders with the highest RelMSE over the baseline's, one of each scene. Only demc's own methods count,
/// or all others where there is none of them.
fn worst(pairs: &[Pair], cases: &[Case], options: &StabilityOptions) -> Vec<Pair> {
    let others = [NOISY, options.baseline.as_str()];
    let is_judged = |case: &&Case| !others.contains(&case.model.as_str());
    let is_own = |case: &&Case| report::is_own(&case.model);
    let judged: Vec<&Case> = cases.iter().filter(is_judged).collect();
    let own: Vec<&Case> = judged.iter().copied().filter(is_own).collect();
    let mut ranked: Vec<(f64, &Case)> = if own.is_empty() { judged } else { own }
        .into_iter()
        .filter_map(|case| Some((case.to_baseline?, case)))
        .collect();
    ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut chosen: Vec<Pair> = Vec::new();
    for (_, case) in ranked {
        let pair = pairs.iter().find(|pair| case.seeds.first() == Some(&pair.noisy));
        let frame = |pair: &Pair| (pair.label(), pair.reference.clone());
        let is_new = |pair: &&Pair| chosen.iter().all(|other| frame(other) != frame(pair));
        if chosen.len() < options.worst {
            chosen.extend(pair.filter(is_new).cloned());
        }
    }
    chosen
}

/// Fills in the numbers of one trial. `before` is the result for the frame as rendered, which
/// [`Trial::AsRendered`] stores there and which therefore comes first.
fn measure(
    trial: Trial,
    method: &Contender,
    loaded: &Loaded,
    before: &mut Option<Planes>,
    row: &mut TrialRow,
) -> Result<()> {
    let (width, height) = (loaded.shot.passes.width, loaded.shot.passes.height);
    if trial == Trial::Cropped && (width <= CORNER.0 || height <= CORNER.1) {
        row.note =
            format!("skipped: {}x{} pixels less leave nothing of {width}x{height}", CORNER.0, CORNER.1);
        return Ok(());
    }
    // Half buffers beside the frame do not have the change, so the shot is made without them.
    let shot = Shot::new(trial.change(&loaded.shot.passes));
    if !trial.touches(&loaded.shot.passes, &shot.passes) {
        row.note = "skipped: the frame holds nothing that this changes".into();
        return Ok(());
    }
    let image = trial.undo(method.denoiser.denoise(&shot)?);
    let reference = trial.seen(&loaded.reference);
    metrics::check(&image, &reference).map_err(|why| Error::invalid(&shot.passes.path, why))?;
    let error = error::relmse(&image, &reference);
    row.relmse = Some(error);
    let exposure = display::exposure(&reference);
    row.ssim =
        exposure.and_then(|e| ssim::ssim(&display::display(&image, e), &display::display(&reference, e)));
    row.energy = error::energy(&image, &reference);
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
    row.deviation = Some(error::relmse(&image, &before));
    match error::relmse(&before, &reference) {
        0.0 => row.note = "no ratio: the result for the frame as rendered is exact".into(),
        before => row.ratio = Some(error / before),
    }
    Ok(())
}

/// The results of one method on all frames, changed in one way.
struct Summary {
    model: String,
    trial: Trial,
    scenes: usize,
    failed: usize,
    /// Geometric mean over scenes.
    ratio: Option<f64>,
    worst: Option<(f64, String)>,
    worst_deviation: Option<f64>,
}

/// A line for each method and trial, method by method.
fn summarise(rows: &[TrialRow], methods: &[Contender], trials: &[Trial]) -> Vec<Summary> {
    let lines = methods.iter().flat_map(|method| trials.iter().map(move |trial| (method, *trial)));
    let line = |(method, trial): (&Contender, Trial)| {
        let own = || rows.iter().filter(|row| row.model == method.name && row.trial == trial.name());
        let ratios: Vec<(f64, &str)> =
            own().filter_map(|row| Some((row.ratio?, row.scene.as_str()))).collect();
        let worst = ratios.iter().max_by(|a, b| a.0.total_cmp(&b.0));
        Summary {
            model: method.name.clone(),
            trial,
            scenes: ratios.len(),
            failed: own().filter(|row| !row.reason.is_empty()).count(),
            ratio: geometric_mean(&ratios.iter().map(|(ratio, _)| *ratio).collect::<Vec<_>>()),
            worst: worst.map(|(ratio, scene)| (*ratio, (*scene).to_owned())),
            worst_deviation: own().filter_map(|row| row.deviation).max_by(f64::total_cmp),
        }
    };
    lines.map(line).collect()
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::{models::Denoiser, passes::Pass};

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

    fn options(out: &Path, worst: usize) -> StabilityOptions {
        StabilityOptions {
            out: out.into(),
            view_layer: None,
            trials: Trial::ALL.to_vec(),
            baseline: NOISY.into(),
            worst,
            threads: 1,
        }
    }

    #[test]
    fn the_worst_scenes_of_our_own_methods_are_shown_once_each() {
        let noisy = |scene: &str| format!("{scene}.exr");
        let pair = |scene: &str| Pair {
            scene: scene.into(),
            noisy: noisy(scene).into(),
            reference: "ref.exr".into(),
            spp: 4,
            frame: None,
        };
        let case = |(scene, model, ratio): (&str, &str, f64)| Case {
            model: model.into(),
            seeds: vec![noisy(scene).into()],
            to_baseline: Some(ratio),
            ..Case::default()
        };
        let cases = [
            ("a", "demc-s", 1.2),
            ("b", "demc-s", 3.0),
            ("c", "demc-s", 2.0),
            ("b", "demc-m", 2.5),
            ("a", "oidn-high", 9.0),
        ];
        let (pairs, cases) = (["a", "b", "c"].map(pair), cases.map(case));
        for (count, scenes) in [(0, ""), (1, "b"), (2, "bc"), (9, "bca")] {
            let shown = worst(&pairs, &cases, &options(Path::new(""), count));
            assert_eq!(shown.iter().map(|pair| &*pair.scene).collect::<String>(), scenes);
        }
    }

    #[test]
    fn rows_are_stored_as_they_finish_and_a_panic_costs_one() {
        let out = tempfile::tempdir().unwrap();
        let frame = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/s0000_room_0004spp.exr");
        let pairs = crate::testset::read(frame).unwrap().pairs;
        let method = Contender {
            name: "delicate".into(),
            denoiser: Box::new(Delicate),
            peak_mib: Box::new(|_| None),
            stamp: String::new(),
        };
        let mut told = 0;
        let options = options(out.path(), 0);
        let (rows, _) = run(&pairs, &[method], &options, &mut |row| {
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
}
