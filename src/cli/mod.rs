//! The command line: one file a subcommand, raw arguments resolved here and nowhere else.

use std::process::ExitCode;

use clap::{Parser, Subcommand};

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
    /// List the built-in models
    Models,
}

/// Exit status when some input failed, each named on stderr.
pub const SOME_FAILED: u8 = 1;
/// Exit status of a wrong command line.
pub const USAGE: u8 = 2;

/// Parses the process arguments and runs the subcommand.
pub fn main() -> ExitCode {
    match Cli::parse().command {
        Command::Models => ExitCode::SUCCESS,
    }
}
