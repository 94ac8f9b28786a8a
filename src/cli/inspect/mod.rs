//! `demc inspect FILE...`: what a file holds, which passes are recognised, what each model misses and
//! how Blender turns it on, and what looks suspicious.

mod examine;
mod print;

use std::{path::PathBuf, process::ExitCode};

use clap::Args as ClapArgs;

use super::{SOME_FAILED, inputs, print_line, warn_line};
use crate::{Result, error::attempt};

/// Arguments of `demc inspect`.
#[derive(Debug, ClapArgs)]
#[command(after_help = "\
Examples:
  demc inspect renders/shot_0004spp.0001.exr")]
pub struct Args {
    /// EXR files, directories of them, or quoted globs
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Print one JSON object per file, one a line
    #[arg(long)]
    json: bool,
}

/// Prints what each file holds; files that cannot be read are named on stderr.
///
/// # Errors
/// The inputs name nothing.
pub fn run(args: &Args) -> Result<ExitCode> {
    let methods = examine::methods();
    let inputs = inputs::expand(&args.files)?;
    let mut failed = !inputs.unusable.is_empty();
    inputs.unusable.iter().for_each(|(_, error)| warn_line(&format!("demc: {error}")));
    for path in inputs.files {
        match attempt(&path, || examine::examine(&path, &methods)) {
            Ok(report) if args.json => {
                print_line(&serde_json::to_string(&report).expect("strings and numbers serialise"));
            }
            Ok(report) => print_line(&print::text(&report)),
            Err(error) => {
                warn_line(&format!("demc: {error}"));
                failed = true;
            }
        }
    }
    Ok(if failed { ExitCode::from(SOME_FAILED) } else { ExitCode::SUCCESS })
}
