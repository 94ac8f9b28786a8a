//! `demc stability`: how much methods' results change when their inputs go wrong.

use std::path::PathBuf;

use crate::cli::ExitCode;

use clap::Args as ClapArgs;

use super::{methods, print_line, warn_line};
use crate::{
    Result,
    report::number,
    stability::{self, Row, Trial},
};

/// Arguments of `demc stability`.
#[derive(Debug, ClapArgs)]
#[command(after_help = trials())]
pub struct Args {
    #[command(flatten)]
    asked: methods::Args,
    /// Folder for stability.csv, which grows row by row, and stability_summary.csv; those of an earlier run are replaced
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// What the trials do, and what the tables tell of them.
fn trials() -> String {
    let lines = Trial::ALL.map(|trial| format!("  {:<16}{}\n", trial.name(), trial.meaning()));
    format!(
        "Trials:\n{}\nratio: RelMSE over that of the frame as rendered. deviation: RelMSE between the two results.\n\
         Half buffers beside a frame are not used: nfor works on the frame alone.\n\n\
         Examples:\n  demc stability --test-set pairs --models demc-s --out stability",
        lines.concat()
    )
}

/// Runs the trials.
///
/// # Errors
/// The test set or a method does not exist, or the output folder cannot be written.
pub fn run(args: &Args) -> Result<ExitCode> {
    let pairs = methods::noisy_renders(&args.asked.test_set)?;
    let methods = args.asked.methods()?;
    let (mut done, all) = (0, pairs.len() * methods.len() * Trial::ALL.len());
    let mut tell = |row: &Row| {
        done += 1;
        let value =
            |name: &str, v: Option<f64>| v.map(|v| format!("  {name} {}", number(v))).unwrap_or_default();
        let numbers = [("relmse", row.relmse), ("ratio", row.ratio), ("deviation", row.deviation)];
        let numbers: String = numbers.map(|(name, number)| value(name, number)).concat();
        let why = [&row.reason, &row.note].into_iter().filter(|why| !why.is_empty());
        let said = numbers + &why.map(|why| format!(": {why}")).collect::<String>();
        warn_line(&format!("[{done}/{all}] {} {} spp {} {}{said}", row.scene, row.spp, row.model, row.trial));
    };
    let view_layer = args.asked.view_layer.as_deref();
    let rows = methods::pool(args.asked.threads())?
        .install(|| stability::run(&pairs, &methods, view_layer, &args.out, &mut tell))?;
    let failed = rows.iter().filter(|row| !row.reason.is_empty()).count();
    print_line(&args.out.join("stability_summary.csv").display().to_string());
    Ok(methods::finish(failed, &args.out.join("stability.csv")))
}
