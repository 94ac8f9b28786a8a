//! `demc train`: fits a network to pairs of noisy and reference frames.

use std::{
    collections::{HashMap, HashSet},
    fs,
    io::IsTerminal,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use indicatif::{ProgressBar, ProgressStyle};

use super::environment;
use super::lines::{ExitCode, warn_line};
use crate::{
    Error, Result,
    frame::Frame,
    models::{self, learned::TURNED, network::Architecture, weights_file},
    nn::Precision,
    passes::{self, Pass},
    report,
    testset::{self, Pair},
    train::{self, Loss, Rule, TrainEvent, TrainOptions},
};

/// Train a network on pairs of noisy and reference frames
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  demc train --data pairs --out run --model demc-s --steps 20000
  demc train --resume --out run")]
pub struct Args {
    /// Directory, CSV manifest or quoted glob of <scene>_<spp>spp.exr and <scene>_ref.exr; may be given several times
    #[arg(long, required_unless_present = "resume")]
    data: Vec<String>,
    /// Run folder to write: config.json, log.csv, loss.png, checkpoint, best.safetensors
    #[arg(long)]
    out: PathBuf,
    /// Network to train
    #[arg(long, default_value = "demc")]
    model: String,
    /// Channels at each level, finest first, instead of the model's own; for semc those of the demc whose
    /// parameter count it is to have; one number for kpcn and lbf
    #[arg(long, value_delimiter = ',')]
    widths: Option<Vec<usize>>,
    /// Optimiser steps
    #[arg(long, default_value_t = 20_000)]
    steps: usize,
    /// Crops a step; more where they are smaller than --patch says, so that they have as many pixels
    #[arg(long, default_value_t = 8)]
    batch: usize,
    /// Rows and columns of a crop: a multiple of 16, for the paper's networks of 32, any number for kpcn and lbf; of a
    /// step's crops fewer, if the frame drawn first has
    /// not as many
    #[arg(long, default_value_t = 128)]
    patch: usize,
    /// Largest learning rate, and that of the last step, to which it falls along a line
    #[arg(long, default_value = "1e-4:5e-6", value_parser = parse_rates)]
    lr: (f64, f64),
    /// What is minimised: relmse, smape, both summed, edges, which adds the error of differences, geomean,
    /// the logarithm of each crop's relmse, or ssim, which adds ten times 1 - SSIM to that
    #[arg(long, default_value = "relmse", value_parser = |text: &str| one_of(&Loss::ALL, text))]
    loss: Loss,
    /// Take squared errors, not their denominators, against what references were before Blender denoised
    /// them, where they hold that (generate_scenes.py --denoise-references)
    #[arg(long)]
    raw_references: bool,
    /// Share of the crops that lack guides: the albedo, the normal, or both, so that a network learns to do
    /// without
    #[arg(long, default_value_t = 0.0, value_parser = parse_share)]
    guide_dropout: f64,
    /// Share of the crops that are put into coloured light, so that a network which answers with colours knows
    /// saturated ones
    #[arg(long, default_value_t = 0.0, value_parser = parse_share)]
    tint: f64,
    /// Share of the gradient that passes a ReLU where it gives nothing, so that layers through which nothing passes may
    /// come back: 0.01 for deep networks at high rates
    #[arg(long, default_value_t = 0.0, value_parser = parse_share)]
    leak: f64,
    /// How gradients become updates: adam, or muon, which needs fewer steps
    #[arg(long, default_value = "adam", value_parser = |text: &str| one_of(&Rule::ALL, text))]
    optimizer: Rule,
    /// Share of the hidden convolutions' weights that a step takes away, times the learning rate
    #[arg(long, default_value_t = 0.0)]
    weight_decay: f64,
    /// What convolutions round their factors to: f32 (nothing) or bf16; without it, the faster one here
    #[arg(long, value_parser = parse_precision)]
    precision: Option<Precision>,
    /// Weight of the past in the average of the weights that is kept
    #[arg(long, default_value_t = 0.999)]
    average: f64,
    /// Pairs to validate on, never trained on; without it one view in ten is held out
    #[arg(long)]
    val: Vec<String>,
    /// Steps between validations
    #[arg(long, default_value_t = 500)]
    every: usize,
    /// Seed of initial weights, crops and augmentation
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Weights file to begin with, of the same design and at most the same widths
    #[arg(long)]
    init: Option<PathBuf>,
    /// Train parameters of these names alone and keep the others as --init has them, which then forget
    /// nothing; * is any part of a name: 'head.*' are the last layers before what is predicted, which takes
    /// the least time, '*.bias' all biases
    #[arg(long, requires = "init", value_delimiter = ',', value_name = "NAME,...")]
    only: Vec<String>,
    /// Weights that denoise albedo and normal first: a file of `demc train --model prefilter`, or of a
    /// network that has a prefilter; without it those of --init, or the built-in ones
    #[arg(long)]
    prefilter: Option<PathBuf>,
    /// Go on from the run folder's checkpoint, with its config.json, which decides all but --threads; for
    /// more steps, edit them there
    #[arg(long, conflicts_with_all = [
        "data", "model", "widths", "steps", "batch", "patch", "lr", "loss", "raw_references", "guide_dropout", "tint", "leak", "optimizer",
        "weight_decay", "precision", "average", "val", "every", "seed", "init", "only", "prefilter",
    ])]
    resume: bool,
    /// Threads to use; all processors without it
    #[arg(long, value_name = "N", value_parser = environment::threads())]
    threads: Option<u16>,
}

/// One view in this many is held out for validation.
const HOLD_OUT: u64 = 10;

fn parse_rates(text: &str) -> Result<(f64, f64), String> {
    let rates = text.split_once(':').and_then(|(a, b)| Some((a.parse().ok()?, b.parse().ok()?)));
    match rates {
        Some((first, last)) if first > 0.0 && last > 0.0 => Ok((first, last)),
        _ => Err("expected FIRST:LAST, two positive numbers such as 1e-4:5e-6".into()),
    }
}

fn parse_share(text: &str) -> Result<f64, String> {
    let share = text.parse().ok().filter(|share| (0.0..=1.0).contains(share));
    share.ok_or_else(|| "expected a share from 0 to 1".into())
}

/// The one of `all` that is called `text`.
fn one_of<T: Copy + ToString>(all: &[T], text: &str) -> Result<T, String> {
    let names: Vec<String> = all.iter().map(T::to_string).collect();
    let found = names.iter().position(|name| name == text);
    found.map(|at| all[at]).ok_or_else(|| format!("expected {}", names.join(" or ")))
}

fn parse_precision(text: &str) -> Result<Precision, String> {
    match text {
        "f32" => Ok(Precision::F32),
        "bf16" => Ok(Precision::Bf16),
        _ => Err("expected f32 or bf16".into()),
    }
}

fn usage(message: impl Into<String>) -> Error {
    Error::Usage(message.into())
}

/// All pairs of several test sets, each once however often it is named; a file without its counterpart is named.
fn all_pairs(specs: &[String]) -> Result<Vec<Pair>> {
    let (mut pairs, mut seen) = (Vec::new(), HashSet::new());
    for spec in specs {
        let set = testset::read(spec)?;
        set.unmatched.iter().for_each(|unmatched| warn_line(&format!("warning: {unmatched}")));
        pairs.extend(
            set.pairs.into_iter().filter(|pair| seen.insert([&pair.noisy, &pair.reference].map(same))),
        );
    }
    Ok(pairs)
}

/// A file by one path, in however many ways it may have been typed.
fn same(file: &PathBuf) -> PathBuf {
    fs::canonicalize(file).unwrap_or_else(|_| file.clone())
}

/// Whether a pair is held out: decided by its view, so that every sample count, seed, frame and crop of a view
/// goes the same way. (FNV-1a, Fowler, Noll, Vo.)
fn held_out(pair: &Pair) -> bool {
    let hash = format!("{}_ref.exr", view(pair))
        .bytes()
        .fold(0xcbf2_9ce4_8422_2325u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0000_0100_0000_01b3));
    // The low bits of this hash depend on few bits of the name.
    (hash >> 32) % HOLD_OUT == 0
}

/// The view that a pair shows, as its reference's file is called before `_ref`, or else the scene, without the
/// numbers of frame, seed and crop.
fn view(pair: &Pair) -> String {
    let mut name = pair.reference.file_name().unwrap_or_default().to_string_lossy().into_owned();
    if let Some(frame) = &pair.frame
        && let Some(at) = name.rfind(&format!(".{frame}."))
    {
        name.replace_range(at..=at + frame.len(), "");
    }
    if let Some(stem) = name.strip_suffix("_ref.exr") {
        return without_number(stem, "_c").into();
    }
    let scene = without_number(&pair.scene, ".");
    let scene = scene.strip_suffix("_mean").unwrap_or(without_number(scene, "_n"));
    without_number(scene, "_c").into()
}

/// A name without a number at its end, with what stands before the number.
fn without_number<'a>(name: &'a str, mark: &str) -> &'a str {
    match name.rsplit_once(mark) {
        Some((stem, number)) if !number.is_empty() && number.bytes().all(|c| c.is_ascii_digit()) => stem,
        _ => name,
    }
}

/// Pairs with absolute paths, since a run may be resumed from another folder.
fn from_anywhere(mut pairs: Vec<Pair>) -> Result<Vec<Pair>> {
    for path in pairs.iter_mut().flat_map(|pair| [&mut pair.noisy, &mut pair.reference]) {
        *path = std::path::absolute(&path).map_err(Error::io("read", &*path))?;
    }
    Ok(pairs)
}

/// Whether the noisy frame of a pair holds what KPCN's two streams read. A file that cannot be read is told of where it is
/// needed.
fn has_light_passes(pair: &Pair) -> bool {
    let Ok(frame) = Frame::read_headers(&pair.noisy) else { return true };
    let layers = passes::layers(&frame);
    let light = [Pass::DiffuseDirect, Pass::DiffuseIndirect, Pass::DiffuseColor];
    passes::choose(&frame, &layers, None)
        .map_or(true, |layer| light.iter().all(|pass| layer.passes.contains_key(pass)))
}

impl Args {
    fn options(&self) -> Result<TrainOptions> {
        let known: Vec<_> = models::trainable().collect();
        let mut network =
            known.iter().find(|(name, _)| *name == self.model).map(|(_, c)| c.clone()).ok_or_else(|| {
                let names: Vec<&str> = known.iter().map(|(name, _)| *name).collect();
                usage(format!(
                    "cannot train '{}'; trainable: {}; {TURNED} has the weights of demc-m",
                    self.model,
                    names.join(", ")
                ))
            })?;
        if let Some(widths) = &self.widths {
            network.widths = models::widths(network.architecture, widths);
        }
        if let Some(path) = &self.prefilter {
            if network.prefilter.is_empty() {
                return Err(usage(format!("--prefilter: {} has no prefilter; leave it out", self.model)));
            }
            network.prefilter = weights_file::prefilter_widths(path)?;
        } else if let Some(path) = &self.init
            && !network.prefilter.is_empty()
        {
            let own = weights_file::config(path)?.prefilter;
            if !own.is_empty() {
                network.prefilter = own;
            }
        }
        let pairs = all_pairs(&self.data)?;
        let (validation, training) = if self.val.is_empty() {
            // Pairs that share a reference go the same way, whatever their scenes are called.
            let mut by_reference = HashMap::new();
            pairs.into_iter().partition(|pair| {
                *by_reference.entry(pair.reference.clone()).or_insert_with(|| held_out(pair))
            })
        } else {
            (all_pairs(&self.val)?, pairs)
        };
        let files = |p: &'_ Pair| [p.noisy.clone(), p.reference.clone()];
        let validated: HashSet<PathBuf> = validation.iter().flat_map(files).map(|file| same(&file)).collect();
        if let Some(file) = training.iter().flat_map(files).find(|file| validated.contains(&same(file))) {
            return Err(Error::invalid(
                file,
                "is both trained on and validated on; give --val other scenes than --data",
            ));
        }
        if training.is_empty() {
            return Err(usage(
                "nothing left to train on once one view in ten is held out; add pairs or --val",
            ));
        }
        if validation.is_empty() && training.len() > 1 {
            warn_line(
                "note: no view is held out, so nothing tells the best weights from the last: name some with --val",
            );
        }
        if network.architecture == Architecture::Kpcn {
            let pairs = || training.iter().chain(&validation);
            let lacking: Vec<&Pair> = pairs().filter(|pair| !has_light_passes(pair)).collect();
            if let [first, ..] = lacking[..] {
                if lacking.len() < pairs().count() {
                    return Err(Error::invalid(
                        &first.noisy,
                        "holds no diffuse light passes, which other pairs do; leave it out, or train --model kpcn-combined",
                    ));
                }
                warn_line(
                    "note: no pair holds diffuse light passes: kpcn is trained on Combined, as kpcn-combined",
                );
                network.architecture = Architecture::KpcnCombined;
            }
        }
        let options = TrainOptions {
            network,
            train: from_anywhere(training)?,
            validation: from_anywhere(validation)?,
            steps: self.steps,
            batch: self.batch,
            patch: self.patch,
            lr: self.lr,
            loss: self.loss,
            raw_references: self.raw_references,
            guide_dropout: self.guide_dropout,
            tint: self.tint,
            leak: self.leak,
            optimizer: self.optimizer,
            precision: self.precision.unwrap_or_else(Precision::fastest_trained),
            weight_decay: self.weight_decay,
            average: self.average,
            every: self.every,
            seed: self.seed,
            init: self.init.clone(),
            only: self.only.clone(),
            prefilter: self.prefilter.clone(),
        };
        options.check().map_err(|refusal| {
            let argument = match refusal.setting {
                "network" => "widths".into(),
                setting => setting.replace('_', "-"),
            };
            usage(format!("--{argument}: {}", refusal.reason))
        })?;
        Ok(options)
    }
}

/// The settings of a run that is resumed, from its folder, where people may have edited them.
fn stored_options(config: &Path) -> Result<TrainOptions> {
    let text = fs::read_to_string(config).map_err(Error::io("read", config))?;
    let options: TrainOptions = serde_json::from_str(&text).map_err(|e| {
        let line = text.lines().nth(e.line().saturating_sub(1)).unwrap_or_default().trim();
        Error::invalid(config, format!("not a run's configuration: {e}: {line}"))
    })?;
    options.check().map_err(|refusal| {
        Error::invalid(config, format!("\"{}\": {}; mend it there", refusal.setting, refusal.reason))
    })?;
    let checkpoint = config.with_file_name(train::CHECKPOINT);
    if checkpoint.exists() {
        train::check_size(&checkpoint, &options.network)?;
    }
    Ok(options)
}

/// Runs the subcommand.
pub fn run(args: &Args) -> Result<ExitCode> {
    // This thread works too. A step is hundreds of short parallel loops, and handing one over to other
    // threads takes longer than many of them last.
    let pool =
        rayon::ThreadPoolBuilder::new().num_threads(args.threads.map_or(0, usize::from)).use_current_thread();
    pool.build_global().map_err(|e| usage(format!("--threads: {e}")))?;
    let config = args.out.join("config.json");
    let options = if args.resume {
        stored_options(&config)?
    } else {
        if config.exists() {
            return Err(Error::invalid(
                &args.out,
                "holds a run already; pass --resume to go on with it, or another --out",
            ));
        }
        // Without its configuration a run cannot be resumed, but its weights may be somebody's only ones.
        if let Some(name) =
            ["best.safetensors", "last.safetensors"].iter().find(|name| args.out.join(name).exists())
        {
            return Err(Error::invalid(
                args.out.join(name),
                "would be replaced; choose another --out, or move these weights away",
            ));
        }
        args.options()?
    };
    warn_line(&format!(
        "{} pairs to train on, {} to validate on; {} steps of {} crops of up to {p}x{p}",
        options.train.len(),
        options.validation.len(),
        options.steps,
        options.batch,
        p = options.patch
    ));

    let stop = Arc::new(AtomicBool::new(false));
    let flag = stop.clone();
    super::stop::on_request(move || flag.store(true, Ordering::Relaxed))?;
    let bar = ProgressBar::new(options.steps as u64);
    if !std::io::stderr().is_terminal() {
        bar.set_draw_target(indicatif::ProgressDrawTarget::hidden());
    }
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} {per_sec} eta {eta} loss {msg}");
    bar.set_style(style.expect("the template is well formed"));
    let mut on = |event| match event {
        TrainEvent::Warning(warning) => bar.suspend(|| warn_line(&format!("warning: {warning}"))),
        TrainEvent::Step { step, loss } => {
            bar.set_position(step as u64);
            bar.set_message(format!("{loss:.4}"));
        }
        TrainEvent::Logged(rows) => {
            let Some(row) = rows.last() else { return };
            // A chart that cannot be drawn is no reason to lose a run.
            if let Err(e) = report::loss_chart(&args.out.join("loss.png"), &rows) {
                bar.suspend(|| warn_line(&format!("demc: {e}")));
            }
            let optional = |v: Option<f64>| v.map_or("-".into(), |v| format!("{v:.4}"));
            let [loss, relmse, ssim] = [row.train_loss, row.val_relmse, row.val_ssim].map(optional);
            let line = format!(
                "step {} after {:.0} s: loss {loss}, validation RelMSE {relmse}, SSIM {ssim}",
                row.step, row.seconds
            );
            bar.suspend(|| warn_line(&line));
        }
    };
    match train::run(&options, &args.out, args.resume, &stop, &mut on) {
        Err(Error::Interrupted) => {
            let out = args.out.display();
            warn_line(&match config.exists() {
                true => format!("stopped; go on with: demc train --out '{out}' --resume"),
                false => "stopped before the first step".into(),
            });
            Ok(ExitCode::from(super::stop::INTERRUPTED))
        }
        other => other.map(|()| ExitCode::SUCCESS),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pair(reference: String, frame: Option<String>) -> Pair {
        Pair { scene: "shot".into(), noisy: "noisy.exr".into(), reference: reference.into(), spp: 4, frame }
    }

    #[test]
    fn resuming_takes_no_option_that_would_be_ignored() {
        let command = <Args as clap::Args>::augment_args(clap::Command::new("train"));
        let resume = command.get_arguments().find(|a| a.get_id() == "resume").expect("an option");
        let refused = command.get_arg_conflicts_with(resume);
        for argument in command.get_arguments().filter(|a| *a != resume) {
            let counts = ["out", "threads"].iter().any(|name| argument.get_id() == name);
            assert_eq!(refused.contains(&argument), !counts, "{argument}");
        }
    }

    #[test]
    fn scenes_of_other_layouts_are_held_out_as_a_whole() {
        let of = |scene: &str, reference: &str| Pair { scene: scene.into(), ..pair(reference.into(), None) };
        for name in ["shot/gt.exr", "gt/shot.0001.exr", "gt/shot.0002.exr"] {
            for scene in ["shot", "shot_n3", "shot_mean", "shot_c1", "shot_c1_n2", "shot.0007"] {
                assert_eq!(view(&of(scene, name)), "shot", "{scene}");
            }
        }
        let held = (0..200).filter(|i| held_out(&of(&format!("scene{i}"), "x/ref.exr"))).count();
        assert!((8..40).contains(&held), "{held} of 200");
    }

    #[test]
    fn frames_and_crops_are_held_out_with_their_still_or_trained_on_together() {
        let name = |scene: usize, frame: &str| format!("train/s{scene:04}_room_ref{frame}.exr");
        let still = |scene| held_out(&pair(name(scene, ""), None));
        for scene in 0..40 {
            for frame in ["0001", "0017", "-0003"] {
                let of_sequence = pair(name(scene, &format!(".{frame}")), Some(frame.into()));
                assert_eq!(held_out(&of_sequence), still(scene), "{scene}, frame {frame}");
            }
        }
        // Crops of a view may overlap, so all of them go the same way.
        for (crop, scene) in [("c0", 0), ("c1", 0), ("c12", 0), ("c0", 1), ("c1", 1)] {
            let of_crop = pair(format!("train/s{scene:04}_room_{crop}_ref.exr"), None);
            assert_eq!(held_out(&of_crop), still(scene), "{scene}, crop {crop}");
        }
        // The stills that are held out must stay the same from version to version.
        let held: Vec<usize> = (0..40).filter(|scene| still(*scene)).collect();
        assert_eq!(held, [0, 3, 4, 7, 15, 20, 33, 39]);
    }
}
