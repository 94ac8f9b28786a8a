//! `demc inspect FILE...`: what a file holds, which passes are recognised, what each model misses and
//! how Blender turns it on, and what ruins a denoise, with what mends it.

pub(super) mod examine;
mod print;

use std::path::{Path, PathBuf};

use clap::Args as ClapArgs;

use super::lines::{ExitCode, SOME_FAILED, print_line, warn_line};
use super::{
    inputs::{self, Search},
    sources::Names,
};
use crate::{Error, Result, denoise, error::attempt, lint::Trace};

/// Arguments of `demc inspect`.
#[derive(Debug, ClapArgs)]
#[command(after_help = "\
Examples:
  demc inspect renders/shot_0004spp.0001.exr
  demc inspect renders --json")]
pub struct Args {
    /// EXR files, directories of them, or quoted globs
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    #[command(flatten)]
    names: Names,
    /// Search directories with all that are in them
    #[arg(long)]
    recursive: bool,
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
    let mapping = args.names.mapping()?;
    let inputs = inputs::expand(&args.files, &Search { recursive: args.recursive, except: None })?;
    let mut failed = !inputs.unusable.is_empty();
    // Also for a program that reads standard output alone.
    let fail = |path: &Path, error: &Error| {
        warn_line(&format!("demc: {error}"));
        if args.json {
            print_line(&serde_json::json!({ "path": path, "error": error.to_string() }).to_string());
        }
    };
    inputs.unusable.iter().for_each(|(path, error)| fail(path, error));
    // The frame before, while files are frames of one sequence in order.
    let mut before: Option<(PathBuf, Trace)> = None;
    let is_compared = inputs.files.len() > 1;
    for path in inputs.files.into_iter().map(|input| input.file) {
        let mut examined = attempt(&path, || examine::examine(&path, &methods, &mapping, is_compared));
        let of_before = before.take().filter(|(earlier, _)| denoise::follows(&path, earlier));
        if let Ok(report) = &mut examined {
            let trace = report.trace.take();
            if let (Some(trace), Some((earlier, of_earlier))) = (&trace, &of_before) {
                report.findings.extend(trace.after(of_earlier, &earlier.display().to_string()));
            }
            before = trace.map(|trace| (path.clone(), trace));
        }
        match examined {
            Ok(report) if args.json => {
                print_line(&serde_json::to_string(&report).expect("strings and numbers serialise"));
            }
            Ok(report) => print_line(&print::text(&report)),
            Err(error) => {
                fail(&path, &error);
                failed = true;
            }
        }
    }
    Ok(if failed { ExitCode::from(SOME_FAILED) } else { ExitCode::SUCCESS })
}
