//! `demc stability`: how much methods' results change when their inputs go wrong.

use std::{path::PathBuf, process::ExitCode};

use clap::Args as ClapArgs;

use super::{SOME_FAILED, methods};
use crate::{
    Result,
    report::number,
    stability::{self, Row, Trial},
    testset,
};

/// Arguments of `demc stability`.
#[derive(Debug, ClapArgs)]
pub struct Args {
    /// Directory of <scene>_<spp>spp.exr and <scene>_ref.exr, CSV manifest, or quoted glob
    #[arg(long, value_name = "DIR|MANIFEST|GLOB")]
    test_set: String,
    /// Methods, as `demc eval` takes them
    #[arg(long, value_name = "A,B,...", value_delimiter = ',', default_value = "demc-m")]
    models: Vec<String>,
    /// Folder for stability.csv and stability_summary.csv
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Threads for every method [default: all cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    /// View layer to read [default: the one with the most passes]
    #[arg(long, value_name = "NAME")]
    view_layer: Option<String>,
    /// The program oidnDenoise [default: $OIDN_DENOISE, else the one on PATH]
    #[arg(long, value_name = "PATH")]
    oidn: Option<PathBuf>,
}

/// Runs the trials.
///
/// # Errors
/// The test set or a method does not exist, or the output folder cannot be written.
pub fn run(args: &Args) -> Result<ExitCode> {
    let set = testset::read(&args.test_set)?;
    let threads = methods::count(args.threads);
    let view_layer = args.view_layer.as_deref();
    let methods = methods::open(&args.models, args.oidn.as_deref(), view_layer, threads)?;
    let mut failed = methods::tell_unmatched(&set);
    let (mut done, all) = (0, set.pairs.len() * methods.len() * Trial::ALL.len());
    let mut tell = |row: &Row| {
        done += 1;
        let value =
            |name: &str, v: Option<f64>| v.map(|v| format!("  {name} {}", number(v))).unwrap_or_default();
        let said = match &row.reason[..] {
            "" => {
                value("relmse", row.relmse) + &value("ratio", row.ratio) + &value("deviation", row.deviation)
            }
            reason => format!(": {reason}"),
        };
        eprintln!("[{done}/{all}] {} {} spp {} {}{said}", row.scene, row.spp, row.model, row.trial);
    };
    let rows = methods::threads(threads)?
        .install(|| stability::run(&set.pairs, &methods, view_layer, &args.out, &mut tell))?;
    failed += rows.iter().filter(|row| !row.reason.is_empty()).count();
    println!("{}", args.out.join("stability_summary.csv").display());
    if failed > 0 {
        eprintln!("demc: {failed} failed; {} says why", args.out.join("stability.csv").display());
        return Ok(ExitCode::from(SOME_FAILED));
    }
    Ok(ExitCode::SUCCESS)
}
