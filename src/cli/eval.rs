//! `demc eval`: methods against references, with times, tables, charts and comparison sheets.

use std::{collections::HashSet, io::IsTerminal, path::PathBuf};

use clap::Args as ClapArgs;
use indicatif::{ProgressBar, ProgressStyle};

use super::lines::{ExitCode, print_line, warn_line};
use super::methods;
use crate::{
    Result,
    report::{self, EvalEvent, EvalOptions, Row},
};

/// Arguments of `demc eval`.
#[derive(Debug, ClapArgs)]
#[command(after_help = "\
Examples:
  demc eval --test-set pairs --models demc-s,demc-m --out scores
  demc eval --test-set pairs --models demc-m --temporal --out scores")]
pub struct Args {
    #[command(flatten)]
    asked: methods::Args,
    /// Folder for report.html, scores.csv, summary.csv, the charts and the comparison sheets. Rows of earlier
    /// runs into it stay in scores.csv as long as they hold, and are not run again
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Score demc-s, demc-m, demc-l and weights files with the frames of their sequence around each one too,
    /// N before and N after: as methods of their own, such as demc-m:temporal. Their time is that of a frame
    /// whose neighbours are all denoised for it alone [default: frame by frame; 2 without a number]
    #[arg(long, value_name = "N", num_args = 0..=1, default_missing_value = "2",
          value_parser = methods::parse_reach)]
    temporal: Option<u8>,
    /// Method that the summary's ratios refer to [default: the first of --models that is not noisy]
    #[arg(long, value_name = "NAME")]
    baseline: Option<String>,
    /// Timed runs of each method and scene, each after one that warms up; their median counts
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u16).range(1..))]
    repeats: u16,
    /// Write no comparison sheets
    #[arg(long)]
    no_sheets: bool,
    /// Run all that is asked for anew, finished rows too; rows of other methods and renders stay as without
    /// it
    #[arg(long)]
    overwrite: bool,
}

/// Runs the evaluation.
///
/// # Errors
/// The test set or a method does not exist, or the output folder cannot be written.
pub fn run(args: Args) -> Result<ExitCode> {
    let pairs = methods::noisy_renders(&args.asked.test_set)?;
    let threads = args.asked.threads();
    let mut methods = args.asked.methods()?;
    if let Some(reach) = args.temporal {
        methods.extend(args.asked.temporal(&methods, reach.into())?);
    }
    let baseline = match &args.baseline {
        Some(wanted) => args.asked.baseline(wanted, &methods)?,
        None => methods.get(1).unwrap_or(&methods[0]).name.clone(),
    };
    let options = EvalOptions {
        out: args.out,
        repeats: args.repeats.into(),
        threads,
        baseline,
        view_layer: args.asked.view_layer,
        overwrite: args.overwrite,
        sheets: !args.no_sheets,
    };
    let pool = methods::pool(threads)?;
    let mut progress = Progress::new();
    let rows =
        pool.install(|| report::evaluate(&pairs, &methods, &options, &mut |event| progress.tell(&event)))?;
    progress.finish();
    let failed = rows.iter().filter(|row| !row.reason.is_empty()).count();
    for file in ["summary.csv", "report.html"] {
        print_line(&options.out.join(file).display().to_string());
    }
    Ok(methods::finish(failed, &options.out.join("scores.csv")))
}

/// A bar on a terminal, a line for each row otherwise.
struct Progress {
    bar: Option<ProgressBar>,
    rows: usize,
    done: usize,
    /// Notes told: each is told once.
    told: HashSet<String>,
}

impl Progress {
    fn new() -> Self {
        Self { bar: None, rows: 0, done: 0, told: HashSet::new() }
    }

    fn tell(&mut self, event: &EvalEvent) {
        match event {
            EvalEvent::Start { rows, kept } => {
                (self.rows, self.done) = (*rows, *kept);
                if *kept > 0 {
                    warn_line(&format!(
                        "{kept} of {rows} rows are there already (--overwrite runs them anew)"
                    ));
                }
                if std::io::stderr().is_terminal() {
                    let style =
                        ProgressStyle::with_template("{bar:30} {pos}/{len} {elapsed} (left {eta}) {msg}")
                            .expect("the template is valid");
                    let bar = ProgressBar::new(*rows as u64).with_style(style);
                    bar.set_position(*kept as u64);
                    self.bar = Some(bar);
                }
            }
            EvalEvent::Pair(pair) => {
                if let Some(bar) = &self.bar {
                    bar.set_message(pair.id());
                }
            }
            EvalEvent::Note(note) => {
                if self.told.insert((*note).to_owned()) {
                    match &self.bar {
                        Some(bar) => bar.println(format!("note: {note}")),
                        None => warn_line(&format!("note: {note}")),
                    }
                }
            }
            EvalEvent::Row(row) => {
                self.done += 1;
                let line = self.line(row);
                match &self.bar {
                    Some(bar) if row.reason.is_empty() => bar.inc(1),
                    Some(bar) => {
                        bar.println(line);
                        bar.inc(1);
                    }
                    None => warn_line(&line),
                }
            }
        }
    }

    fn line(&self, row: &Row) -> String {
        let counted = format!("[{}/{}] {} {} spp {}", self.done, self.rows, row.scene, row.spp, row.model);
        if !row.reason.is_empty() {
            return format!("{counted}: {}", row.reason);
        }
        // Four decimals of a share, three digits of an error, which may be tiny.
        let value = |name: &str, v: Option<f64>| match v {
            Some(v) if name == "ssim" => format!("  {name} {v:.4}"),
            Some(v) => format!("  {name} {}", report::number_label(v)),
            None => String::new(),
        };
        let time = row.seconds.map(|s| format!("  {:.0} ms", s * 1e3)).unwrap_or_default();
        let scores = [("relmse", row.relmse), ("ssim", row.ssim), ("flicker", row.flicker)];
        let scores: String = scores.map(|(name, score)| value(name, score)).concat();
        format!("{counted}{scores}{time}")
    }

    fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
