//! `demc denoise`: a batch of frames through one model, each output the input plus a layer.
//!
//! In: the command line. Out: files in `--out`, a line (or JSON object) for each, the exit status.
//! The work itself is [`crate::denoise`]'s.

mod frames;
mod progress;

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
    time::Duration,
};

use clap::{
    Args as ClapArgs,
    builder::{PossibleValuesParser, TypedValueParser},
};
pub(super) use frames::Frames;
use progress::{Progress, Style};

use super::environment;
use super::lines::{ExitCode, SOME_FAILED, warn_line};
use super::{
    inputs::{self, Inputs, Search},
    ranking::{Ranking, parse_wish},
    sources::{GuideFiles, Names},
    stop,
};
use crate::{
    Error, Result,
    denoise::{self, Alpha, Batch, End, Job, Look, Options, Outcome, Plan, Watch, Wrap, preview},
    frame::prepare_folder,
    models,
};

/// Arguments of `demc denoise`.
#[derive(Debug, ClapArgs)]
#[command(after_help = "\
Examples:
  demc denoise renders --out clean
  demc denoise 'renders/shot_0004spp.*.exr' --out clean --frames 1-9:4,12 --model demc-s --preview
  demc denoise renders --recursive --out clean --jobs 2
  demc denoise renders --out clean --watch 3  # while Blender renders")]
pub struct Args {
    /// EXR files, directories of them, or quoted globs
    #[arg(required = true, value_name = "INPUT")]
    inputs: Vec<PathBuf>,

    /// Directory for the results, which keep their input's name
    #[arg(long, value_name = "DIR")]
    out: PathBuf,

    /// Built-in model or weights file (`demc models` lists the built-in ones)
    #[arg(long, value_name = "NAME|FILE", default_value = "demc-m")]
    model: String,

    /// View layer to denoise, where the file has several
    #[arg(long, value_name = "NAME")]
    view_layer: Option<String>,

    /// Name of the layer added
    #[arg(long, value_name = "NAME", default_value = "Denoised", conflicts_with = "replace")]
    layer: String,

    /// Overwrite the beauty (Combined) instead of adding a layer
    #[arg(long)]
    replace: bool,

    /// Denoise again where the result exists already
    #[arg(long)]
    overwrite: bool,

    /// Threads to use [default: all cores]
    #[arg(long, value_name = "N", value_parser = environment::threads())]
    threads: Option<u16>,

    /// Denoise N frames at once, each with its share of the threads: the same results, sooner where frames
    /// are small or threads many. Each frame takes its own memory, up to three times that of a frame of its
    /// kind
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    jobs: u16,

    /// Work on bands of N rows, or squares of N by N pixels where a model wants those, to bound memory; the
    /// result is the same to the bit [default: the model's choice]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(16..))]
    tile: Option<u32>,

    /// Only the inputs whose names end in one of these numbers: 7, 1-9, 1-9:4 (every fourth), 1,3,7-9
    #[arg(long, value_name = "A-B[:S],...", allow_hyphen_values = true)]
    frames: Option<Frames>,

    /// Search directories with all that are in them; results lie below --out as their inputs do below the
    /// directory named
    #[arg(long)]
    recursive: bool,

    /// Go on with renders that are still coming in, each when its file is whole, until Ctrl-C, or until
    /// nothing new has come for SECONDS; with --overwrite, a frame that is rendered again is denoised again
    #[arg(long, value_name = "SECONDS", num_args = 0..=1, conflicts_with = "temporal",
          value_parser = parse_idle)]
    #[allow(clippy::option_option, reason = "not at all, for ever, for some time")]
    watch: Option<Option<u32>>,

    /// Take frames of a sequence (names that end in a number) together with N before and N after each, found
    /// beside them and followed by the Vector pass: steadier and cleaner [default: frame by frame; 2 without
    /// a number; 8 at most]
    #[arg(long, value_name = "N", num_args = 0..=1, default_missing_value = "2",
          value_parser = super::methods::parse_reach)]
    temporal: Option<u8>,

    /// Write a PNG beside each result, exposed for display
    #[arg(long)]
    preview: bool,

    /// What becomes of alpha: denoised with the beauty's kernels, or kept; auto denoises it where it varies
    #[arg(long, value_name = "HOW", default_value = "auto", value_parser = one_of(Alpha::ALL))]
    alpha: Alpha,

    /// Whether the left and the right edge meet, as those of an all-round panorama: auto believes the file's
    /// attribute envmap
    #[arg(long, value_name = "HOW", default_value = "auto", value_parser = one_of(Wrap::ALL))]
    wrap: Wrap,

    /// Denoise the light passes and light groups as well: they add up to the denoised beauty
    #[arg(long)]
    passes: bool,

    /// Add a layer that tells how far off each pixel is expected to be: `<layer> Error`, the squared error
    /// relative to the squared light, which RelMSE is the mean of
    #[arg(long)]
    confidence: bool,

    /// List the frames by their expected RelMSE at the end, the worst first; with a number, also how many
    /// samples those above it want
    #[arg(long, value_name = "RELMSE", num_args = 0..=1, value_parser = parse_wish, conflicts_with_all = ["json", "temporal"])]
    #[allow(clippy::option_option, reason = "not at all, the list, what is wanted besides")]
    report: Option<Option<f64>>,

    #[command(flatten)]
    names: Names,

    #[command(flatten)]
    guides: GuideFiles,

    /// Print one JSON object per file, one a line
    #[arg(long)]
    json: bool,

    /// Print failures alone
    #[arg(long, short)]
    quiet: bool,
}

/// After how many seconds without a new file a watch ends.
///
/// # Errors
/// It is no whole number of them.
fn parse_idle(text: &str) -> Result<u32> {
    let seconds = text.parse().ok().filter(|seconds| *seconds > 0);
    seconds.ok_or_else(|| {
        Error::Usage("wants whole seconds; name inputs before it, or after that number".into())
    })
}

/// Reads one of these by its name.
fn one_of<T: Copy + Send + Sync + 'static>(all: [(&'static str, T); 3]) -> impl TypedValueParser<Value = T> {
    let of = move |said: String| all.into_iter().find(|(name, _)| *name == said).expect("one of them").1;
    PossibleValuesParser::new(all.map(|(name, _)| name)).map(of)
}

/// Runs the batch.
///
/// # Errors
/// The command line cannot be carried out; failures of single files are reported as they happen and
/// only show in the exit status.
pub fn run(args: Args) -> Result<ExitCode> {
    denoise::check_layer_name(&args.layer)
        .map_err(|why| Error::Usage(format!("--layer '{}': {why}", args.layer)))?;
    let search = Search { recursive: args.recursive, except: Some(args.out.clone()) };
    let work = match args.watch {
        None => Work::of(&args, &search)?,
        Some(idle) => Work::Watch(watch(&args, search, idle)?, idle),
    };
    // This comes before anything runs in parallel, as opening a model does.
    environment::use_threads(args.threads)?;
    // Beside a single frame, those around it are read where they make it steadier.
    let stands_alone = |job: &Job| {
        args.temporal.is_none_or(|reach| denoise::neighbours(&job.input, reach.into()).is_empty())
    };
    let is_one = matches!(&work, Work::List { jobs, .. } if jobs.len() == 1 && stands_alone(&jobs[0]));
    let sources = args.guides.sources(&args.names, is_one)?;
    let model = models::open(&args.model)?;
    if args.report.is_some() {
        models::check_expects(&*model, "--report")?;
    }
    let mut ranking = args.report.map(Ranking::new);
    prepare_folder(&args.out)?;
    if let Work::List { jobs, .. } = &work {
        let folders: BTreeSet<&Path> = jobs.iter().filter_map(|job| job.output.parent()).collect();
        folders.into_iter().try_for_each(prepare_folder)?;
    }

    let options = Options {
        view_layer: args.view_layer.clone(),
        layer: (!args.replace).then_some(args.layer),
        tile: args.tile.map(|t| t as usize),
        preview: args.preview.then_some(preview::write),
        overwrite: args.overwrite,
        temporal: args.temporal.map(usize::from),
        alpha: args.alpha,
        sources,
        passes: args.passes,
        confidence: args.confidence,
        wrap: args.wrap,
    };
    denoise::check_options(&*model, &options)?;
    let style = match (args.json, args.quiet) {
        (true, _) => Style::Json,
        (_, true) => Style::Quiet,
        _ => Style::Plain,
    };
    let (mut progress, batch) = match work {
        Work::List { jobs, unusable } => {
            let mut progress = Progress::new(Some(jobs.len() + unusable.len()), style);
            for (input, error) in unusable {
                progress.report(&Job { input, output: PathBuf::new() }, &Outcome::Failed(error));
            }
            (progress, Batch::new(jobs, model.into(), options))
        }
        Work::Watch(watch, idle) => {
            let progress = Progress::new(None, style);
            progress.say_watching(idle);
            (progress, Batch::watching(watch, model.into(), options)?)
        }
    };
    if usize::from(args.jobs) > rayon::current_num_threads() && !args.quiet {
        let threads = rayon::current_num_threads();
        warn_line(&format!(
            "demc: note: --jobs {}: one for each of the {threads} threads is used",
            args.jobs
        ));
    }
    let batch = batch.at_once(args.jobs.into());
    let stopper = batch.stopper();
    stop::on_request(move || stopper.stop())?;
    // Files that a watch has met, where it is to be asked which frames have not come.
    let watched = args.frames.as_ref().filter(|_| args.watch.is_some());
    let mut came = Vec::new();
    let end = batch.run(|job, outcome| {
        progress.report(job, outcome);
        if watched.is_some() {
            came.push(denoise::Input { file: job.input.clone(), below: PathBuf::new() });
        }
        if let Some(ranking) = &mut ranking {
            rank(ranking, job, outcome);
        }
    });
    let failed = progress.finish(end == End::Stopped);
    if let Some(ranking) = ranking {
        ranking.print();
    }
    if let (Some(frames), End::Complete) = (watched, end) {
        if let Some((_, note)) = frames.lacking(&came).filter(|_| !args.quiet) {
            warn_line(&format!("demc: note: {note}"));
        }
        if came.is_empty() {
            warn_line(
                "demc: no file of --frames has come; the number of a frame ends its file's name, as in shot.0017.exr",
            );
            return Ok(ExitCode::from(SOME_FAILED));
        }
    }
    Ok(match end {
        End::Stopped => ExitCode::from(stop::INTERRUPTED),
        End::Complete if failed > 0 => ExitCode::from(SOME_FAILED),
        End::Complete => ExitCode::SUCCESS,
    })
}

/// Adds a frame to the list of expected errors. A result that existed already has noted its own.
fn rank(ranking: &mut Ranking, job: &Job, outcome: &Outcome) {
    let (error, samples) = match outcome {
        Outcome::Done(report) => (report.expected_error, report.samples),
        Outcome::Skipped(there) => (there.expected_error, there.samples),
        Outcome::Failed(_) => return,
    };
    ranking.add(job.input.display().to_string(), error, samples);
}

/// The work of a batch.
enum Work {
    /// Files that are there, and inputs that name none.
    List { jobs: Vec<Job>, unusable: Vec<(PathBuf, Error)> },
    /// Files that are coming in, and after how many seconds without a new one it ends.
    Watch(Watch, Option<u32>),
}

impl Work {
    fn of(args: &Args, search: &Search) -> Result<Self> {
        let Inputs { files, mut unusable, .. } = inputs::expand(&args.inputs, search)?;
        // They have no place among results.
        let (missing, files): (Vec<_>, Vec<_>) =
            files.into_iter().partition(|input| inputs::is_missing_folder(&input.file));
        unusable.extend(missing.into_iter().filter_map(|input| {
            let error = std::fs::metadata(&input.file).err()?;
            Some((input.file.clone(), Error::io("read", &input.file)(error)))
        }));
        let files = match &args.frames {
            Some(frames) => {
                let picked = frames.pick(files, &args.inputs, unusable.is_empty())?;
                if let Some((_, note)) = frames.lacking(&picked).filter(|_| !args.quiet) {
                    warn_line(&format!("demc: note: {note}"));
                }
                picked
            }
            None => files,
        };
        Ok(Self::List { jobs: denoise::plan_tree(files, &args.out)?, unusable })
    }
}

/// A watch over the inputs, for files that exist and others that are to come.
///
/// # Errors
/// Among the files that exist, two results would have the same path, or a result that of its input; or a glob
/// is malformed.
fn watch(args: &Args, search: Search, idle: Option<u32>) -> Result<Watch> {
    let (inputs, frames, out) = (args.inputs.clone(), args.frames.clone(), args.out.clone());
    let is_wanted = move |input: &denoise::Input| frames.as_ref().is_none_or(|frames| frames.has(input));
    let there = inputs::find(&inputs, &search)?.files;
    denoise::plan_tree(there.into_iter().filter(&is_wanted), &out)?;
    let mut prepared = BTreeSet::from([out.clone()]);
    let look = move || {
        let mut look = Look::default();
        let found = match inputs::find(&inputs, &search) {
            Ok(found) => found,
            Err(error) => {
                look.failures.push((PathBuf::new(), error));
                return look;
            }
        };
        (look.failures, look.empty) = (found.unusable, found.empty);
        let files: Vec<denoise::Input> = found.files.into_iter().filter(&is_wanted).collect();
        let mut plan = Plan::new(&out, &files);
        for input in files {
            let file = input.file.clone();
            let placed = plan.place(input).and_then(|job| {
                let folder = job.output.parent().unwrap_or(&out).to_owned();
                if !prepared.contains(&folder) {
                    prepare_folder(&folder)?;
                    prepared.insert(folder);
                }
                Ok(job)
            });
            match placed {
                Ok(job) => look.jobs.push(job),
                Err(error) => look.failures.push((file, error)),
            }
        }
        look
    };
    Ok(Watch::new(look, idle.map(|seconds| Duration::from_secs(seconds.into())), args.overwrite))
}
