//! What the user sees of a batch: a bar on a terminal, plain lines otherwise, or JSON lines.
//! Results go to stdout; notes and failures to stderr, each naming its file.

use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;

use crate::{
    cli::{print_line, warn_line},
    denoise::{Job, Outcome},
};

/// What is printed of files that did not fail.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Style {
    /// A line each, and the totals.
    Plain,
    /// An object each, of those that failed too.
    Json,
    /// Nothing.
    Quiet,
}

/// Counts and prints outcomes.
pub struct Progress {
    bar: ProgressBar,
    style: Style,
    start: Instant,
    total: usize,
    done: usize,
    skipped: usize,
    failed: usize,
}

/// One line of `--json`.
#[derive(Serialize)]
struct Line<'a> {
    input: String,
    #[serde(skip_serializing_if = "String::is_empty")]
    output: String,
    /// `done`, `skipped` or `failed`.
    status: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    report: Option<Details<'a>>,
}

#[derive(Serialize)]
struct Details<'a> {
    view_layer: &'a str,
    width: usize,
    height: usize,
    seconds: f64,
    non_finite: &'a std::collections::BTreeMap<String, usize>,
    notes: &'a [String],
}

impl Progress {
    /// For a batch of `total` files. The bar shows on a terminal alone.
    pub fn new(total: usize, style: Style) -> Self {
        let target = match style {
            Style::Quiet => ProgressDrawTarget::hidden(),
            _ => ProgressDrawTarget::stderr(),
        };
        let bar = ProgressBar::with_draw_target(Some(total as u64), target);
        bar.set_style(
            ProgressStyle::with_template("{bar:30} {pos}/{len}  {elapsed} elapsed{prefix}  {msg}")
                .expect("the template is valid"),
        );
        Self { bar, style, start: Instant::now(), total, done: 0, skipped: 0, failed: 0 }
    }

    /// Prints what became of a file.
    pub fn report(&mut self, job: &Job, outcome: &Outcome) {
        match outcome {
            Outcome::Done(_) => self.done += 1,
            Outcome::Skipped => self.skipped += 1,
            Outcome::Failed(_) => self.failed += 1,
        }
        let count = self.done + self.skipped + self.failed;
        self.bar.set_message(job.input.file_name().unwrap_or_default().to_string_lossy().into_owned());
        self.bar.set_position(count as u64);
        if let Some(speed) = self.speed() {
            let left = Duration::from_secs_f64((self.total - count) as f64 / speed);
            self.bar.set_prefix(format!(", {speed:.2} frames/s, {} left", HumanDuration(left)));
        }
        let (style, total) = (self.style, self.total);
        // Above the bar, where there is one.
        self.bar.suspend(|| match style {
            Style::Json => print_line(&json_line(job, outcome)),
            Style::Plain => print_plain(job, outcome, count, total),
            Style::Quiet => {}
        });
        if let Outcome::Failed(error) = outcome {
            self.bar.suspend(|| warn_line(&format!("demc: {error}")));
        }
    }

    /// Frames a second so far, of those that were denoised: those there already take no time.
    fn speed(&self) -> Option<f64> {
        (self.done > 0).then(|| self.done as f64 / self.start.elapsed().as_secs_f64().max(1e-3))
    }

    /// Prints the totals; returns how many files failed.
    pub fn finish(self, stopped: bool) -> usize {
        self.bar.finish_and_clear();
        let left = self.total - self.done - self.skipped - self.failed;
        if self.style == Style::Plain && (self.total > 1 || stopped) {
            let mut summary = format!("{} denoised", self.done);
            for (count, what) in [
                (self.skipped, "already there (--overwrite does them again)"),
                (self.failed, "failed"),
                (left, "left: run the same command to go on"),
            ] {
                if count > 0 {
                    summary += &format!(", {count} {what}");
                }
            }
            if let Some(speed) = self.speed() {
                summary += &format!(" ({speed:.2} frames/s)");
            }
            print_line(&summary);
        }
        self.failed
    }
}

fn print_plain(job: &Job, outcome: &Outcome, count: usize, total: usize) {
    let prefix = if total > 1 { format!("[{count}/{total}] ") } else { String::new() };
    match outcome {
        Outcome::Done(report) => {
            print_line(&format!(
                "{prefix}{}  {}x{}  {:.2} s",
                job.output.display(),
                report.width,
                report.height,
                report.seconds
            ));
            let repaired: Vec<String> = report.repaired.iter().map(|(p, n)| format!("{n} in {p}")).collect();
            if !repaired.is_empty() {
                warn_line(&format!(
                    "demc: note: {}: non-finite values (NaN or infinity) repaired: {}",
                    job.input.display(),
                    repaired.join(", ")
                ));
            }
            for note in &report.notes {
                warn_line(&format!("demc: note: {}: {note}", job.input.display()));
            }
        }
        Outcome::Skipped => print_line(&format!("{prefix}{}  is there already", job.output.display())),
        Outcome::Failed(_) => {}
    }
}

fn json_line(job: &Job, outcome: &Outcome) -> String {
    let (status, error, report) = match outcome {
        Outcome::Done(report) => ("done", None, Some(report)),
        Outcome::Skipped => ("skipped", None, None),
        Outcome::Failed(error) => ("failed", Some(error.to_string()), None),
    };
    let line = Line {
        input: job.input.display().to_string(),
        output: job.output.display().to_string(),
        status,
        error,
        report: report.map(|r| Details {
            view_layer: &r.view_layer,
            width: r.width,
            height: r.height,
            seconds: r.seconds,
            non_finite: &r.repaired,
            notes: &r.notes,
        }),
    };
    serde_json::to_string(&line).expect("strings and numbers serialise")
}
