//! `demc denoise`: a batch of frames through one model, each output the input plus a layer.
//!
//! In: the command line. Out: files in `--out`, a line (or JSON object) for each, the exit status.
//! The work itself is in [`frame_job`], its overlap in [`pipeline`].

mod frame_job;
mod pipeline;
mod preview;
mod progress;

use std::{
    collections::HashMap,
    fs,
    path::{Path, PathBuf},
    process::ExitCode,
};

use clap::Args as ClapArgs;
use frame_job::Options;

use super::{
    SOME_FAILED,
    inputs::{self, Inputs},
    stop,
};
use crate::{
    Error, Result, models,
    passes::{NOISY_IMAGE, Pass, is_bare},
};

/// Arguments of `demc denoise`.
#[derive(Debug, ClapArgs)]
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

    /// Write a PNG beside each result, exposed for display
    #[arg(long)]
    preview: bool,

    /// Print one JSON object per file, one a line
    #[arg(long)]
    json: bool,
}

/// One file to do.
pub struct Job {
    /// The render.
    pub input: PathBuf,
    /// The result.
    pub output: PathBuf,
}

/// Runs the batch.
///
/// # Errors
/// The command line cannot be carried out; failures of single files are reported as they happen and
/// only show in the exit status.
pub fn run(args: Args) -> Result<ExitCode> {
    check_layer_name(&args.layer)?;
    let Inputs { files, unusable } = inputs::expand(&args.inputs)?;
    let jobs = plan(files, &args.out)?;
    // Before anything runs in parallel, as opening a model does.
    if let Some(threads) = args.threads {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads.into())
            .build_global()
            .map_err(|e| Error::Usage(format!("--threads {threads}: {e}")))?;
    }
    let model = models::open(&args.model)?;
    prepare(&args.out)?;

    let options = Options {
        view_layer: args.view_layer,
        layer: (!args.replace).then_some(args.layer),
        tile: args.tile.map(|t| t as usize),
        preview: args.preview,
        overwrite: args.overwrite,
    };
    let mut progress = progress::Progress::new(jobs.len() + unusable.len(), args.json);
    for (input, error) in unusable {
        progress.report(&Job { input, output: PathBuf::new() }, &pipeline::Outcome::Failed(error));
    }
    let end = pipeline::run(jobs, model.into(), options, |job, outcome| progress.report(job, outcome))?;
    let failed = progress.finish(end == pipeline::End::Stopped);
    Ok(match end {
        pipeline::End::Stopped => ExitCode::from(stop::INTERRUPTED),
        pipeline::End::Complete if failed > 0 => ExitCode::from(SOME_FAILED),
        pipeline::End::Complete => ExitCode::SUCCESS,
    })
}

/// A layer name must make channel names that read back as this layer and no other.
fn check_layer_name(name: &str) -> Result<()> {
    let reserved = |p: &Pass| p.to_string() == name || p.blender_names().contains(&name);
    if name.is_empty() || name.len() > 100 || name.contains(|c: char| c == '.' || c.is_control()) {
        Err(Error::Usage(format!("--layer '{name}': wants 1 to 100 characters in one line, without a dot")))
    } else if name == NOISY_IMAGE || is_bare(name) || Pass::ALL.iter().any(reserved) {
        Err(Error::Usage(format!(
            "--layer '{name}': is a pass of the renderer; choose another name, or --replace for Combined"
        )))
    } else {
        Ok(())
    }
}

/// Output paths; no two alike, none its own input.
fn plan(files: Vec<PathBuf>, out: &Path) -> Result<Vec<Job>> {
    let mut by_name: HashMap<std::ffi::OsString, PathBuf> = HashMap::new();
    let mut jobs = Vec::with_capacity(files.len());
    for input in files {
        let Some(name) = input.file_name() else {
            return Err(Error::Usage(format!("{}: names no file", input.display())));
        };
        if let Some(other) = by_name.insert(name.to_owned(), input.clone()) {
            return Err(Error::Usage(format!(
                "{} and {} would both be written to {}; give each its own --out",
                other.display(),
                input.display(),
                out.join(name).display()
            )));
        }
        let output = out.join(name);
        let same = |a: &Path, b: &Path| matches!((fs::canonicalize(a), fs::canonicalize(b)), (Ok(a), Ok(b)) if a == b);
        if same(&input, &output) {
            return Err(Error::Usage(format!(
                "{}: the result would overwrite its input; choose another --out",
                input.display()
            )));
        }
        jobs.push(Job { input, output });
    }
    Ok(jobs)
}

/// Makes the output directory and finds out now, not after an hour, whether files can be made in it.
fn prepare(out: &Path) -> Result<()> {
    fs::create_dir_all(out).map_err(Error::io("create", out))?;
    tempfile::Builder::new().prefix(".demc-").tempfile_in(out).map_err(Error::io("write", out))?;
    Ok(())
}
