//! The command line: one file a subcommand, raw arguments resolved here and nowhere else.

// `println!` and `eprintln!` panic where nobody reads any more: see `print_line`.
#![deny(clippy::print_stdout, clippy::print_stderr)]

mod compare;
mod denoise;
mod environment;
mod eval;
mod inputs;
mod inspect;
mod lines;
mod manual;
mod methods;
mod models;
mod peak_memory;
mod ranking;
mod report;
mod sources;
mod stability;
mod stop;
mod train;

use std::{
    ffi::OsString,
    io,
    panic::{catch_unwind, set_hook},
    path::{Path, PathBuf},
    process,
    sync::OnceLock,
};

use clap::{CommandFactory, Parser, Subcommand};

pub use environment::{MOST_THREADS, useful_threads};
use lines::{ExitCode, SOME_FAILED, USAGE, warn_line};

use crate::{
    Error, Result,
    error::{attempt, panic_message},
    metrics::Scores,
    passes::Mapping,
};

#[derive(Parser)]
#[command(
    name = "demc",
    version,
    about = "Removes Monte Carlo noise from Blender Cycles renders (multilayer EXR)"
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Remove the noise from renders: keeps every layer, adds the layer 'Denoised'
    Denoise(denoise::Args),
    Train(train::Args),
    /// Score and time methods over a test set: tables, charts, comparison sheets
    Eval(eval::Args),
    /// What a file holds, which passes are recognised, what is missing or suspicious
    Inspect(inspect::Args),
    /// RelMSE, SSIM, RMSE, maximum error ... of an image against a reference
    Compare(compare::Args),
    Models(models::Args),
    /// How much results change when inputs go wrong: fireflies, NaN, missing guides, other exposure ...
    Stability(stability::Args),
    /// What the JSON lines of many `denoise --json` come to: totals, and which frames failed
    Report(report::Args),
    /// Print a completion script for a shell
    Completions(manual::CompletionsArgs),
    /// Write manual pages
    Man(manual::ManArgs),
    #[command(name = peak_memory::COMMAND, hide = true)]
    PeakMemory(peak_memory::Args),
}

/// Parses the process arguments and runs the subcommand.
pub fn main() -> process::ExitCode {
    main_with(Cli::parse()).0.into()
}

/// As [`main`], with these arguments, of which the first is the program's own path. This is for programs that
/// are not the executable of their process, such as the command of a Python package.
pub fn main_as(arguments: Vec<OsString>) -> u8 {
    if let Some(program) = arguments.first() {
        let _ = PROGRAM.set(program.into());
    }
    main_with(Cli::parse_from(arguments)).0
}

/// The path of the program, where it is not the executable of the process.
static PROGRAM: OnceLock<PathBuf> = OnceLock::new();

/// The path of the program that runs `demc`.
fn program() -> io::Result<PathBuf> {
    PROGRAM.get().cloned().map_or_else(std::env::current_exe, Ok)
}

/// What `demc inspect --json` says about a file.
///
/// # Errors
/// The file is unusable.
pub fn inspect_json(path: &Path) -> Result<String> {
    let report = attempt(path, || {
        inspect::examine::examine(path, &inspect::examine::methods(), &Mapping::default(), false)
    })?;
    Ok(serde_json::to_string(&report).expect("strings and numbers serialise"))
}

/// What `demc models --json` prints.
///
/// # Errors
/// A weights file is unusable.
pub fn models_json() -> Result<String> {
    models::json()
}

/// The scores that `demc compare` prints for two files: of the view layer, the layer of the image and that of the
/// reference, each the command's choice where it is none.
///
/// # Errors
/// A file is unusable, holds no such layer, or the images cannot be compared.
pub fn compare_files(image: &Path, reference: &Path, layers: [Option<String>; 3]) -> Result<Scores> {
    attempt(image, || {
        compare::scores(&compare::Args::of(image, reference, layers), &|_| {}).map(|(scores, _)| scores)
    })
}

fn main_with(Cli { command }: Cli) -> ExitCode {
    crate::kernels::heap::keep_freed();
    stop::outlive_file_limits();
    // A defect is told in one line like any other failure, not by a trace of the program.
    if std::env::var_os("RUST_BACKTRACE").is_none() {
        set_hook(Box::new(|_| {}));
    }
    let done = catch_unwind(|| environment::check().and_then(|()| run(command)))
        .unwrap_or_else(|panic| Err(Error::Internal(panic_message(&*panic))));
    lines::end(done.unwrap_or_else(|error| {
        warn_line(&format!("demc: {error}"));
        ExitCode::from(if matches!(error, Error::Usage(_)) { USAGE } else { SOME_FAILED })
    }))
}

fn run(command: Command) -> Result<ExitCode> {
    match command {
        Command::Denoise(args) => denoise::run(args),
        Command::Train(args) => train::run(&args),
        Command::Eval(args) => eval::run(args),
        Command::Inspect(args) => inspect::run(&args),
        Command::Compare(args) => compare::run(&args),
        Command::Models(args) => models::run(&args),
        Command::Stability(args) => stability::run(&args),
        Command::Report(args) => report::run(&args),
        Command::Completions(args) => manual::completions(&args, &Cli::command()),
        Command::Man(args) => manual::man(&args, &Cli::command()),
        Command::PeakMemory(args) => peak_memory::run(&args),
    }
}
