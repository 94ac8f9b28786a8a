//! `demc denoise`: a batch of frames through one model, each output the input plus a layer.
//!
//! In: the command line. Out: files in `--out`, a line (or JSON object) for each, the exit status.
//! The work itself is [`crate::denoise`]'s.

mod frames;
mod progress;

use std::path::PathBuf;

use crate::cli::ExitCode;

use clap::{Args as ClapArgs, ValueEnum};
use frames::Frames;
use progress::{Progress, Style};

use super::{
    SOME_FAILED,
    inputs::{self, Inputs},
    sources::{Guides, Names},
    stop,
};
use crate::{
    Error, Result,
    denoise::{self, Alpha, Batch, End, Job, Options, Outcome, preview},
    frame::prepare_folder,
    models,
};

/// Arguments of `demc denoise`.
#[derive(Debug, ClapArgs)]
#[command(after_help = "\
Examples:
  demc denoise renders --out clean
  demc denoise 'renders/shot_0004spp.*.exr' --out clean --frames 1-9:4,12 --model demc-s --preview")]
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
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,

    /// Work on bands of N rows, or squares of N by N pixels where a model wants those, to bound memory; the
    /// result is the same to the bit [default: the model's choice]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(16..))]
    tile: Option<u32>,

    /// Only the inputs whose names end in one of these numbers: 7, 1-9, 1-9:4 (every fourth), 1,3,7-9
    #[arg(long, value_name = "A-B[:S],...", allow_hyphen_values = true)]
    frames: Option<Frames>,

    /// Take frames of a sequence (names that end in a number) together with N before and N after each, found beside them
    /// and followed by the Vector pass: steadier and cleaner [default: frame by frame; 2 without a number]
    #[arg(long, value_name = "N", num_args = 0..=1, default_missing_value = "2",
          value_parser = clap::value_parser!(u8).range(1..=8))]
    temporal: Option<u8>,

    /// Write a PNG beside each result, exposed for display
    #[arg(long)]
    preview: bool,

    /// What becomes of alpha: denoised with the beauty's kernels, or kept; auto denoises it where it varies
    #[arg(long, value_enum, value_name = "HOW", default_value_t = AlphaChoice::Auto)]
    alpha: AlphaChoice,

    /// Denoise the light passes and light groups as well: they add up to the denoised beauty
    #[arg(long)]
    passes: bool,

    #[command(flatten)]
    names: Names,

    #[command(flatten)]
    guides: Guides,

    /// Print one JSON object per file, one a line
    #[arg(long)]
    json: bool,

    /// Print failures alone
    #[arg(long, short)]
    quiet: bool,
}

/// The values of `--alpha`.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum AlphaChoice {
    Auto,
    Denoise,
    Keep,
}

/// Runs the batch.
///
/// # Errors
/// The command line cannot be carried out; failures of single files are reported as they happen and
/// only show in the exit status.
pub fn run(args: Args) -> Result<ExitCode> {
    denoise::check_layer_name(&args.layer)
        .map_err(|why| Error::Usage(format!("--layer '{}': {why}", args.layer)))?;
    let Inputs { files, unusable } = inputs::expand(&args.inputs)?;
    let files = match &args.frames {
        Some(frames) => frames.pick(files)?,
        None => files,
    };
    let jobs = denoise::plan(files, &args.out)?;
    // Before anything runs in parallel, as opening a model does.
    if let Some(threads) = args.threads {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads.into())
            .build_global()
            .map_err(|e| Error::Usage(format!("--threads {threads}: {e}")))?;
    }
    let sources = args.guides.sources(&args.names, jobs.len())?;
    let model = models::open(&args.model)?;
    prepare_folder(&args.out)?;

    let options = Options {
        view_layer: args.view_layer,
        layer: (!args.replace).then_some(args.layer),
        tile: args.tile.map(|t| t as usize),
        preview: args.preview.then_some(preview::write),
        overwrite: args.overwrite,
        temporal: args.temporal.map(usize::from),
        alpha: match args.alpha {
            AlphaChoice::Auto => Alpha::Auto,
            AlphaChoice::Denoise => Alpha::Denoise,
            AlphaChoice::Keep => Alpha::Keep,
        },
        sources,
        passes: args.passes,
    };
    let style = match (args.json, args.quiet) {
        (true, _) => Style::Json,
        (_, true) => Style::Quiet,
        _ => Style::Plain,
    };
    let mut progress = Progress::new(jobs.len() + unusable.len(), style);
    for (input, error) in unusable {
        progress.report(&Job { input, output: PathBuf::new() }, &Outcome::Failed(error));
    }
    let batch = Batch::new(jobs, model.into(), options);
    let stopper = batch.stopper();
    stop::on_request(move || stopper.stop())?;
    let end = batch.run(|job, outcome| progress.report(job, outcome));
    let failed = progress.finish(end == End::Stopped);
    Ok(match end {
        End::Stopped => ExitCode::from(stop::INTERRUPTED),
        End::Complete if failed > 0 => ExitCode::from(SOME_FAILED),
        End::Complete => ExitCode::SUCCESS,
    })
}
