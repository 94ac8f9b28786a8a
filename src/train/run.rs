//! The training loop.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, Ordering},
    time::Instant,
};

use dfdx::tensor_ops::Backward;
use rayon::prelude::*;

use super::{
    Dataset, Optimizer, Sample, Shares, TrainOptions,
    checkpoint::{self, CHECKPOINT, Progress},
    log,
    options::train_only,
};
use crate::{
    Error, Result,
    features::Inputs,
    frame::{alone_in, prepare_folder, write_file},
    metrics,
    models::{
        self,
        catalogue::METHODS,
        network::{Network, stack},
        weights_file::{self, Facts},
    },
    nn::{Conv, Stats, weights},
    planes::Planes,
    rng::Rng,
};

/// What a run tells its caller.
#[derive(Clone, Debug)]
pub enum TrainEvent {
    /// Something the user should know of the data, or of how training goes.
    Warning(String),
    /// A step was done.
    Step {
        /// Steps done.
        step: usize,
        /// Its loss.
        loss: f64,
    },
    /// A row was added to the log; all rows are given.
    Logged(Vec<log::LogRow>),
}

/// A run is given up where a row of the log is due and at least this many steps in a row were skipped.
const MOST_SKIPPED: usize = 10;

/// What to do where a run fell apart.
const SLOWER: &str = "lower \"lr\" in its config.json and pass --resume to go on from the checkpoint before, or train \
                      anew with a lower --lr";

/// Seconds between checkpoints, which is about the most that is lost when a run is killed.
const CHECKPOINT_SECONDS: f64 = 60.0;

/// The file of a run folder that holds the log.
const LOG: &str = "log.csv";

/// Validation errors below this count as this.
const LEAST_RELMSE: f64 = 1e-6;

/// Trains into `out` until the last step, or until `stop` is set; then the state is saved and
/// [`Error::Interrupted`] returned. With `resume`, goes on from the last checkpoint. No checkpoint is written
/// after a skipped step unless it is the last: where all steps are skipped, the weights of the checkpoint
/// before are still good.
///
/// # Errors
/// A pair is unusable, the run folder cannot be read or written or another run works in it, or step after step had
/// no finite gradient.
pub fn run(
    options: &TrainOptions,
    out: &Path,
    resume: bool,
    stop: &AtomicBool,
    on: &mut dyn FnMut(TrainEvent),
) -> Result<()> {
    prepare_folder(out)?;
    let _alone = alone_in(out)?;
    let mut run = Run::begin(options, out, resume)?;
    if run.progress.step >= options.steps && !run.is_to_be_logged() {
        on(TrainEvent::Warning(format!(
            "{}: all {} steps are done; to go on, give \"steps\" in config.json a larger number",
            out.display(),
            options.steps
        )));
        return Ok(());
    }
    let (training, validation) = run.load(stop)?;
    if !resume {
        run.store_config()?;
    }
    let warnings = training.warnings().chain(validation.warnings());
    warnings.for_each(|warning| on(TrainEvent::Warning(warning.clone())));
    if options.raw_references && !training.has_raw_references() {
        let why = "no reference holds a Noisy Image, so --raw-references changes nothing";
        on(TrainEvent::Warning(why.into()));
    }
    run.train(&training, &validation, stop, on)
}

/// A run under way.
struct Run<'a> {
    options: &'a TrainOptions,
    out: &'a Path,
    network: Box<dyn Network>,
    /// Its weights averaged over steps: what is validated and kept.
    average: Box<dyn Network>,
    optimizer: Optimizer,
    progress: Progress,
    /// Rows of the log.
    rows: Vec<log::LogRow>,
    /// Layers that were found to give nothing.
    silent: BTreeSet<String>,
    /// When `progress.seconds` was last brought up to date.
    since: Instant,
    /// When the state was last saved.
    saved: Instant,
}

impl<'a> Run<'a> {
    /// Sets up the network and what trains it, anew or from the checkpoint.
    fn begin(options: &'a TrainOptions, out: &'a Path, resume: bool) -> Result<Self> {
        let checkpoint = out.join(CHECKPOINT);
        if resume {
            if !checkpoint.exists() {
                let why = "is missing, and without it a run cannot go on; begin another one in another --out, with the \
                           weights of this one for --init";
                return Err(Error::invalid(&checkpoint, why));
            }
            checkpoint::check_size(&checkpoint, &options.network)?;
        }
        let mut network = match &options.init {
            Some(path) if !resume => weights_file::read_as(path, &options.network, options.seed)?,
            _ => models::build(&options.network, options.seed),
        };
        // A checkpoint holds every parameter, those of the prefilter too: the files that gave them may be gone.
        if !resume {
            set_prefilter(&mut *network, options)?;
        }
        for conv in network.convolutions() {
            conv.set_precision(options.precision);
            conv.set_leak(options.leak as f32);
        }
        train_only(&mut *network, &options.only)?;
        let mut average = network.duplicate();
        let mut optimizer = Optimizer::new(options.optimizer, options.weight_decay);
        let mut progress = Progress::default();
        if resume {
            progress = checkpoint::load(&checkpoint, &mut *network, &mut *average, &mut optimizer)?;
        }
        let rows = log::read(&out.join(LOG), progress.step.min(progress.logged))?;
        let now = Instant::now();
        let silent = BTreeSet::new();
        Ok(Self { options, out, network, average, optimizer, progress, rows, silent, since: now, saved: now })
    }

    /// Reads the pairs: those to train on, and those to validate on.
    fn load(&self, stop: &AtomicBool) -> Result<(Dataset, Dataset)> {
        let Self { options, network, .. } = self;
        let wanted = (network.passes(), network.optional_passes());
        let least = network.multiple().max(options.loss.least_side());
        let targets = network.targets();
        let training = Dataset::load(&options.train, wanted, targets, options.raw_references, least, stop)?;
        Ok((training, Dataset::load(&options.validation, wanted, targets, false, 1, stop)?))
    }

    /// Stores the state and the settings. The checkpoint comes first: config.json promises that --resume needs none
    /// of the files that this run began with.
    fn store_config(&mut self) -> Result<()> {
        self.save()?;
        let text = serde_json::to_string_pretty(self.options).expect("options serialise");
        write_file(&self.out.join("config.json"), text.as_bytes())
    }

    fn save(&mut self) -> Result<()> {
        let path = self.out.join(CHECKPOINT);
        checkpoint::save(&path, &self.progress, &mut *self.network, &mut *self.average, &mut self.optimizer)?;
        self.saved = Instant::now();
        Ok(())
    }

    /// Takes the steps that are left.
    fn train(
        &mut self,
        training: &Dataset,
        validation: &Dataset,
        stop: &AtomicBool,
        on: &mut dyn FnMut(TrainEvent),
    ) -> Result<()> {
        (self.since, self.saved) = (Instant::now(), Instant::now());
        loop {
            // A run that was stopped amid a validation takes no step before that is done.
            let finite = self.is_to_be_logged() || self.step(training, on)?;
            let last = self.progress.step >= self.options.steps;
            if self.is_to_be_logged() {
                match self.log(validation, stop, on) {
                    // What the validation took does not count as training.
                    Err(Error::Interrupted) => self.since = Instant::now(),
                    logged => logged?,
                }
            }
            let stopping = stop.load(Ordering::Relaxed);
            let due = stopping || self.saved.elapsed().as_secs_f64() > CHECKPOINT_SECONDS;
            if last || (due && finite) {
                self.count_seconds();
                self.save()?;
            }
            if last && !self.is_to_be_logged() {
                return Ok(());
            }
            if stopping {
                return Err(Error::Interrupted);
            }
        }
    }

    /// Whether a row of the log is due that is not there yet.
    fn is_to_be_logged(&self) -> bool {
        let Progress { step, logged, .. } = self.progress;
        let is_due = step > 0 && (step.is_multiple_of(self.options.every) || step >= self.options.steps);
        is_due && logged < step
    }

    /// Takes a step. Returns whether it had a finite gradient; if not, nothing changed.
    fn step(&mut self, training: &Dataset, on: &mut dyn FnMut(TrainEvent)) -> Result<bool> {
        let Self { options, network, progress, .. } = self;
        let samples = draw(training, options, network.multiple(), progress.step);
        let lr = learning_rate(options.lr, options.steps, progress.step);
        progress.step += 1;
        let (loss, finite) = step(&mut **network, &mut self.optimizer, options, lr, progress.step, &samples)?;
        if finite {
            progress.losses.0 += loss;
            progress.losses.1 += 1;
            follow(&mut *self.average, &mut **network, options.average, progress.step);
        } else {
            progress.skipped += 1;
        }
        on(TrainEvent::Step { step: progress.step, loss });
        Ok(finite)
    }

    /// Validates, adds a row to the log and writes the weights. Where `stop` is set, it may do none of that and return
    /// [`Error::Interrupted`].
    fn log(&mut self, validation: &Dataset, stop: &AtomicBool, on: &mut dyn FnMut(TrainEvent)) -> Result<()> {
        self.count_seconds();
        let (sum, count) = self.progress.losses;
        report_skipped(self.progress.skipped, count, self.out, on)?;
        let score = validate(&mut *self.average, validation, self.out, stop)?;
        let progress = &mut self.progress;
        (progress.logged, progress.losses) = (progress.step, Default::default());
        if count > 0 {
            progress.skipped = 0;
        }
        let row = log::LogRow {
            step: progress.step,
            seconds: (progress.seconds * 10.0).round() / 10.0,
            lr: learning_rate(self.options.lr, self.options.steps, progress.step - 1),
            train_loss: (count > 0).then(|| sum / count as f64),
            val_relmse: score.map(|s| s.0),
            val_ssim: score.and_then(|s| s.1),
        };
        self.rows.push(row.clone());
        log::write(&self.out.join(LOG), &self.rows)?;
        // Without validation frames the latest weights are the best known.
        let facts = facts(self.options, &row);
        weights_file::write(&self.out.join("last.safetensors"), &mut *self.average, &facts)?;
        if row.val_relmse.is_none_or(|v| progress.best.is_none_or(|best| v < best)) {
            progress.best = row.val_relmse;
            weights_file::write(&self.out.join("best.safetensors"), &mut *self.average, &facts)?;
        }
        on(TrainEvent::Logged(self.rows.clone()));
        self.report_silent(on);
        self.since = Instant::now();
        Ok(())
    }

    /// Warns of layers whose ReLUs let nothing through on any frame of the validation: no gradient passes them either,
    /// so that what leads to them learns no more.
    fn report_silent(&mut self, on: &mut dyn FnMut(TrainEvent)) {
        let convolutions = self.average.convolutions().into_iter();
        let found = convolutions.filter(|conv| conv.range == Some(0.0));
        let found: Vec<String> = found.map(|conv| conv.name().to_owned()).collect();
        let new: Vec<String> = found.into_iter().filter(|name| self.silent.insert(name.clone())).collect();
        if !new.is_empty() {
            on(TrainEvent::Warning(format!(
                "nothing passes the ReLUs of {} any more, and what leads there is no longer trained; train anew with a \
                 lower --lr or more --weight-decay",
                new.join(", ")
            )));
        }
    }

    fn count_seconds(&mut self) {
        let passed = std::mem::replace(&mut self.since, Instant::now()).elapsed();
        self.progress.seconds += passed.as_secs_f64();
    }
}

/// Warns of skipped steps. `skipped` and `taken` count the steps since the last row of the log before which
/// some step was taken.
///
/// # Errors
/// No step was taken, and at least [`MOST_SKIPPED`] were skipped.
fn report_skipped(skipped: usize, taken: usize, out: &Path, on: &mut dyn FnMut(TrainEvent)) -> Result<()> {
    if taken == 0 && skipped >= MOST_SKIPPED {
        return Err(Error::invalid(
            out,
            format!("none of the last {skipped} steps had a finite gradient; {SLOWER}"),
        ));
    }
    if skipped > 0 {
        let steps = skipped + taken;
        on(TrainEvent::Warning(format!(
            "{skipped} of the last {steps} steps had no finite gradient and were skipped; should most be, lower --lr"
        )));
    }
    Ok(())
}

/// Gives a network its prefilter: the one asked for, else the one of the weights it began with, else the
/// built-in one of the same widths.
fn set_prefilter(network: &mut dyn Network, options: &TrainOptions) -> Result<()> {
    let wanted = &options.network.prefilter;
    if wanted.is_empty() {
        return Ok(());
    }
    if let Some(path) = &options.prefilter {
        let bytes = weights::bytes(path)?;
        return weights_file::set_prefilter(network, &bytes, path);
    }
    if let Some(path) = &options.init
        && weights_file::config(path)?.prefilter == *wanted
    {
        return Ok(());
    }
    for (name, bytes) in METHODS.iter().filter_map(|method| Some((method.name, method.built_in()?))) {
        if weights_file::parse_config(bytes, Path::new(name))?.prefilter == *wanted {
            return weights_file::set_prefilter(network, bytes, Path::new(name));
        }
    }
    Err(Error::Usage(format!("no built-in prefilter has widths {wanted:?}; name one by --prefilter")))
}

/// The crops of a step, all of one size and each from its own stream of a seed.
fn draw(dataset: &Dataset, options: &TrainOptions, multiple: usize, step: usize) -> Vec<Sample> {
    // Stream 0 made the initial weights.
    let rng = &mut Rng::new(options.seed, 1 + step as u64);
    let side = dataset.draw_side(options.patch, multiple, rng);
    let (count, seed) = (options.batch * options.patch.pow(2) / side.pow(2), rng.next_u64());
    let shares = Shares { guide_dropout: options.guide_dropout, tint: options.tint };
    let crop = |crop| dataset.draw(side, shares, &mut Rng::new(seed, crop));
    (0..count as u64).into_par_iter().map(crop).collect()
}

/// Steps in which the learning rate grows to its largest, at most a tenth of all: the optimiser's moments are
/// averages over few steps then.
const WARM_UP: usize = 100;

/// The learning rate of a step. It falls linearly from the first step to the last (Defazio et al. 2023), but
/// grows over the first few.
fn learning_rate((largest, last): (f64, f64), steps: usize, step: usize) -> f64 {
    let done = step as f64 / (steps.max(2) - 1) as f64;
    let warmed = (step + 1) as f64 / WARM_UP.min(steps / 10).max(1) as f64;
    warmed.min(1.0) * (largest + (last - largest) * done)
}

/// One optimiser step. Returns the loss, and whether it and its gradient were finite; if not, nothing
/// changed.
fn step(
    network: &mut dyn Network,
    optimizer: &mut Optimizer,
    options: &TrainOptions,
    lr: f64,
    step: usize,
    samples: &[Sample],
) -> Result<(f64, bool)> {
    let inputs: Vec<Inputs> = samples.par_iter().map(|s| network.inputs(&s.passes)).collect::<Result<_>>()?;
    let scales: Vec<f32> = inputs.iter().map(|i| i.scale).collect();
    let scaled = |planes: &[&Planes]| -> Vec<f32> {
        let values = planes.iter().zip(&scales);
        values.flat_map(|(planes, scale)| planes.data.iter().map(move |v| v / scale)).collect()
    };
    let targets: Vec<Planes> =
        samples.par_iter().map(|s| network.target(&s.reference)).collect::<Result<_>>()?;
    let raw = || {
        let raw = samples.iter().zip(&targets).map(|(s, target)| s.raw_reference.as_ref().unwrap_or(target));
        scaled(&raw.collect::<Vec<_>>())
    };
    let raw = options.raw_references.then(raw);
    let reference = scaled(&targets.iter().collect::<Vec<_>>());
    let mut stats = Stats::Batch(Vec::new());
    let image = network.forward_taped(&stack(&inputs), &mut stats);
    let loss = options.loss.of(image, reference, raw, &scales);
    let value = f64::from(loss.as_vec()[0]);
    if !value.is_finite() {
        return Ok((value, false));
    }
    let mut gradients = loss.backward();
    let norm = optimizer.update(step, lr, network.params(), &mut gradients);
    if norm.is_finite()
        && let Stats::Batch(seen) = stats
    {
        network.batch_norms().into_iter().zip(&seen).for_each(|(layer, batch)| layer.update(batch));
    }
    Ok((value, norm.is_finite()))
}

/// Moves the averaged weights towards the current ones, faster in the first steps.
fn follow(average: &mut dyn Network, network: &mut dyn Network, decay: f64, step: usize) {
    let decay = decay.min((1 + step) as f64 / (10 + step) as f64) as f32;
    for (average, current) in average.params().into_iter().zip(network.params()) {
        let keep = if current.trainable { decay } else { 0.0 };
        let blend = |(a, c): (f32, f32)| c + keep * (a - c);
        let values: Vec<f32> = average.values().into_iter().zip(current.values()).map(blend).collect();
        average.set(&values);
    }
}

/// Geometric mean of RelMSE and mean of SSIM over whole frames; none without frames. The layers of `trained`
/// learn what range their outputs have there.
///
/// # Errors
/// An output is not finite, or `stop` is set.
fn validate(
    trained: &mut dyn Network,
    frames: &Dataset,
    out: &Path,
    stop: &AtomicBool,
) -> Result<Option<(f64, Option<f64>)>> {
    let (mut logs, mut ssims) = (Vec::new(), Vec::new());
    let mut network = trained.duplicate();
    network.freeze();
    network.convolutions().into_iter().for_each(Conv::observe);
    for index in 0..frames.len() {
        if stop.load(Ordering::Relaxed) {
            return Err(Error::Interrupted);
        }
        let (name, sample) = frames.frame(index);
        let image = network.infer(&sample.passes, None)?;
        let (image, reference) = (&image, &network.target(&sample.reference)?);
        if image.non_finite() > 0 {
            return Err(Error::invalid(
                out,
                format!("the network's output on {name} is not finite; {SLOWER}"),
            ));
        }
        // A black frame that is exact would outweigh all others.
        logs.push(metrics::error::relmse(image, reference).max(LEAST_RELMSE).ln());
        if network.makes_radiance()
            && let Some(exposure) = metrics::display::exposure(reference)
        {
            let display = |p| metrics::display::display(p, exposure);
            ssims.extend(metrics::ssim::ssim(&display(image), &display(reference)));
        }
    }
    if !frames.is_empty() {
        for (layer, observed) in trained.convolutions().into_iter().zip(network.convolutions()) {
            layer.range = observed.observed();
        }
    }
    let mean = |v: &[f64]| (!v.is_empty()).then(|| v.iter().sum::<f64>() / v.len() as f64);
    Ok(mean(&logs).map(|log| (log.exp(), mean(&ssims))))
}

/// What a weights file says of its training.
fn facts(options: &TrainOptions, row: &log::LogRow) -> Facts {
    let path = |path: &Option<PathBuf>| path.as_ref().map(|p| p.display().to_string());
    Facts {
        frames: options.train.len(),
        steps: row.step,
        batch: options.batch,
        patch: options.patch,
        lr: options.lr,
        loss: options.loss.to_string(),
        raw_references: options.raw_references,
        guide_dropout: options.guide_dropout,
        tint: options.tint,
        leak: options.leak,
        optimizer: options.optimizer.to_string(),
        weight_decay: options.weight_decay,
        precision: Some(options.precision),
        average: Some(options.average),
        seed: options.seed,
        init: path(&options.init),
        prefilter: path(&options.prefilter),
        only: options.only.clone(),
        seconds: row.seconds,
        validation_frames: options.validation.len(),
        validation_relmse: row.val_relmse,
        validation_ssim: row.val_ssim,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{passes::Pass, testset::Pair};

    #[test]
    fn the_rate_rises_briefly_and_falls_along_a_line() {
        let rate = |step| learning_rate((2e-3, 1e-5), 1001, step);
        assert!((rate(0) - 2e-5).abs() < 1e-12);
        assert!((rate(500) - 1.005e-3).abs() < 1e-12);
        assert!((rate(1000) - 1e-5).abs() < 1e-12);
        assert!((0..99).all(|step| rate(step) < rate(step + 1)));
        assert!((99..1000).all(|step| rate(step) > rate(step + 1)));
    }

    #[test]
    fn crops_differ_from_step_to_step_and_within_one() {
        let file = |name: &str| Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name);
        let (noisy, reference) = (file("s0000_room_0004spp.exr"), file("s0000_room_ref.exr"));
        let pair = Pair { scene: "room".into(), noisy, reference, spp: 4, frame: None };
        let network = models::trainable().find(|(name, _)| *name == "demc-s").unwrap().1.clone();
        let options: TrainOptions = serde_json::from_value(serde_json::json!({
            "network": network, "train": [pair], "validation": [], "steps": 2, "batch": 2, "patch": 32,
            "lr": [1e-3, 1e-3], "loss": "relmse", "precision": "f32", "average": 0.5, "every": 2, "seed": 1,
        }))
        .unwrap();
        let passes = (&[Pass::Combined][..], &[][..]);
        let data =
            Dataset::load(&options.train, passes, &[Pass::Combined], false, 1, &AtomicBool::new(false));
        let data = data.unwrap();
        let drawn = |step, seed| -> Vec<Vec<f32>> {
            let samples = draw(&data, &TrainOptions { seed, ..options.clone() }, 16, step);
            samples.iter().map(|sample| sample.passes.get(Pass::Combined).unwrap().data.to_vec()).collect()
        };
        let first = drawn(0, 1);
        assert_eq!(first, drawn(0, 1));
        assert_ne!(first[0], first[1], "crops of a step");
        assert_ne!(first, drawn(1, 1), "the next step");
        assert_ne!(first, drawn(0, 2), "another seed");
    }

    #[test]
    fn the_average_follows_faster_at_first_and_takes_statistics_as_they_are() {
        let network = |value: f32| {
            let config = models::network::Config::new(models::network::Architecture::Demc, &[4; 5]);
            let mut network = models::build(&config, 1);
            for param in network.params() {
                param.set(&vec![value; param.values().len()]);
            }
            network
        };
        for (step, kept) in [(1, 2.0 / 11.0), (1000, 0.5)] {
            let (mut average, mut current) = (network(0.0), network(1.0));
            follow(&mut *average, &mut *current, 0.5, step);
            let (mut learned, mut fixed) = (0, 0);
            for param in average.params() {
                let want = if param.trainable { 1.0 - kept } else { 1.0 };
                *(if param.trainable { &mut learned } else { &mut fixed }) += 1;
                assert!(param.values().iter().all(|v| (v - want).abs() < 1e-6), "{}, {step}", param.name);
            }
            assert!(learned > 0 && fixed > 0);
        }
    }

    #[test]
    fn runs_of_few_steps_have_rates_too() {
        for (steps, step, expected) in [(1, 0, 2e-3), (2, 0, 2e-3), (2, 1, 1e-5)] {
            assert!((learning_rate((2e-3, 1e-5), steps, step) - expected).abs() < 1e-12, "{step} of {steps}");
        }
    }
}
