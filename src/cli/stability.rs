//! `demc stability`: how much methods' results change when their inputs go wrong.

use std::path::PathBuf;

use clap::Args as ClapArgs;

use super::lines::{ExitCode, print_line, warn_line};
use super::methods;
use crate::{
    Result,
    report::{NOISY, number},
    stability::{self, StabilityOptions, Trial, TrialRow, content::Case},
};

/// Arguments of `demc stability`.
#[derive(Debug, ClapArgs)]
#[command(after_help = trials())]
pub struct Args {
    #[command(flatten)]
    asked: methods::Args,
    /// Folder for stability.html, its maps and tables, of which stability.csv grows row by row; those of an
    /// earlier run are replaced
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Changes to try, as listed below [default: all]
    #[arg(long, value_name = "A,B,...", value_delimiter = ',', value_parser = trial)]
    trials: Vec<Trial>,
    /// Method that scenes are held against, beside their input
    #[arg(long, value_name = "NAME", default_value = NOISY)]
    baseline: String,
    /// How many of the worst scenes to show with pictures
    #[arg(long, value_name = "N", default_value_t = 6)]
    worst: usize,
}

fn trial(name: &str) -> Result<Trial, String> {
    let found = Trial::ALL.into_iter().find(|trial| trial.name() == name);
    found.ok_or_else(|| format!("there are {}", Trial::ALL.map(Trial::name).join(", ")))
}

/// What the trials do, and what the tables tell of them.
fn trials() -> String {
    let lines = Trial::ALL.map(|trial| format!("  {:<16}{}\n", trial.name(), trial.meaning()));
    format!(
        "Trials:\n{}\nratio: RelMSE over that of the frame as rendered. deviation: RelMSE between the two results.\n\
         stability_scenes.csv tells of frames as rendered, renders of one scene and sample count taken together: \
         a method fails where its RelMSE is above the input's (1e-4, if the input is exact), or its light off by 2% more \
         than the input's.\n\
         Half buffers beside a frame are not used: nfor works on the frame alone.\n\n\
         Examples:\n  demc stability --test-set pairs --models demc-s --out stability\n  \
         demc stability --test-set pairs --models demc-m --trials as-rendered --out scenes",
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
    let baseline = args.asked.baseline(&args.baseline, &methods)?;
    let options = StabilityOptions {
        out: args.out.clone(),
        view_layer: args.asked.view_layer.clone(),
        trials: if args.trials.is_empty() { Trial::ALL.to_vec() } else { in_order(&args.trials) },
        baseline,
        worst: args.worst,
        threads: args.asked.threads(),
    };
    let (mut done, all) = (0, pairs.len() * methods.len() * options.trials.len());
    let mut tell = |row: &TrialRow| {
        done += 1;
        let value =
            |name: &str, v: Option<f64>| v.map(|v| format!("  {name} {}", number(v))).unwrap_or_default();
        let numbers = [("relmse", row.relmse), ("ratio", row.ratio), ("deviation", row.deviation)];
        let numbers: String = numbers.map(|(name, number)| value(name, number)).concat();
        let why = [&row.reason, &row.note].into_iter().filter(|why| !why.is_empty());
        let said = numbers + &why.map(|why| format!(": {why}")).collect::<String>();
        warn_line(&format!("[{done}/{all}] {} {} spp {} {}{said}", row.scene, row.spp, row.model, row.trial));
    };
    let (rows, cases) =
        methods::pool(options.threads)?.install(|| stability::run(&pairs, &methods, &options, &mut tell))?;
    let failed = rows.iter().filter(|row| !row.reason.is_empty()).count();
    let judged = cases.iter().filter_map(Case::passes);
    let (all, bad) = (judged.clone().count(), judged.filter(|passes| !passes).count());
    if all > 0 {
        print_line(&format!("{bad} of {all} results on scenes as rendered are out of bounds"));
    }
    print_line(&args.out.join("stability_summary.csv").display().to_string());
    print_line(&args.out.join("stability.html").display().to_string());
    Ok(methods::finish(failed, &args.out.join("stability.csv")))
}

/// The trials asked for, in the order of all. The unchanged frame comes first, since the others are compared
/// with it.
fn in_order(asked: &[Trial]) -> Vec<Trial> {
    let is_asked = |trial: &Trial| *trial == Trial::AsRendered || asked.contains(trial);
    Trial::ALL.into_iter().filter(is_asked).collect()
}
