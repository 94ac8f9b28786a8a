//! The command line: one file a subcommand, raw arguments resolved here and nowhere else.

// They panic where nobody reads any more: see `print_line`.
#![deny(clippy::print_stdout, clippy::print_stderr)]

mod compare;
mod denoise;
mod environment;
mod eval;
mod inputs;
mod inspect;
mod manual;
mod methods;
mod models;
mod peak_memory;
mod report;
mod stability;
mod stop;
mod train;

use std::{
    io::Write,
    panic::{catch_unwind, set_hook},
    process::ExitCode,
};

use clap::{CommandFactory, Parser, Subcommand};

use crate::{Error, Result, error::panic_message};

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

/// Exit status when some input failed, each named on stderr.
pub const SOME_FAILED: u8 = 1;
/// Exit status of a wrong command line.
pub const USAGE: u8 = 2;

/// Parses the process arguments and runs the subcommand.
pub fn main() -> ExitCode {
    crate::kernels::heap::keep_freed();
    let command = Cli::parse().command;
    // A defect is told in one line like any other failure, not by a trace of the program.
    if std::env::var_os("RUST_BACKTRACE").is_none() {
        set_hook(Box::new(|_| {}));
    }
    let done = catch_unwind(|| environment::check().and_then(|()| run(command)))
        .unwrap_or_else(|panic| Err(Error::Internal(panic_message(&*panic))));
    done.unwrap_or_else(|error| {
        warn_line(&format!("demc: {error}"));
        ExitCode::from(if matches!(error, Error::Usage(_)) { USAGE } else { SOME_FAILED })
    })
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

/// One line on stdout. A reader that has gone away (`demc ... | head`) is no reason to stop.
fn print_line(line: &str) {
    let _ = writeln!(std::io::stdout(), "{line}");
}

/// One line on stderr. Nobody who reads it is no reason to stop either.
fn warn_line(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}
