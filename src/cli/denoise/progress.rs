//! What the user sees of a batch: a bar on a terminal, plain lines otherwise, or JSON lines.
//! Results go to stdout; notes and failures to stderr, each naming its file.

use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;

use crate::{
    cli::lines::{print_line, warn_line},
    denoise::{Finished, Job, Outcome, Report},
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
    /// Files there are; not known while they are coming in.
    total: Option<usize>,
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
    quality: Option<Quality>,
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    report: Option<Details<'a>>,
    /// None of what failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    notes: Option<Vec<String>>,
}

/// What is known of how good a result is, made now or before.
#[derive(Serialize)]
struct Quality {
    /// Samples of a pixel; null where the file does not tell.
    samples: Option<u32>,
    /// The result's expected RelMSE; null where the model does not tell.
    expected_error: Option<f64>,
}

#[derive(Serialize)]
struct Details<'a> {
    view_layer: &'a str,
    width: usize,
    height: usize,
    /// What the file holds of that view layer.
    passes: &'a [String],
    light_groups: &'a [String],
    /// Whether Blender had denoised Combined, so that its pass Noisy Image was denoised instead.
    was_denoised: bool,
    seconds: f64,
    non_finite: &'a std::collections::BTreeMap<String, usize>,
}

impl Progress {
    /// For a batch of `total` files, or of those that come in. The bar shows on a terminal alone.
    pub fn new(total: Option<usize>, style: Style) -> Self {
        let target = match style {
            Style::Quiet => ProgressDrawTarget::hidden(),
            _ => ProgressDrawTarget::stderr(),
        };
        let bar = ProgressBar::with_draw_target(total.map(|total| total as u64), target);
        let template = match total {
            Some(_) => "{bar:30} {pos}/{len}  {elapsed} elapsed{prefix}  {msg}",
            None => "{spinner} {pos} ended  {elapsed} elapsed  {msg}",
        };
        bar.set_style(ProgressStyle::with_template(template).expect("the template is valid"));
        if total.is_none() {
            bar.set_message("waiting for renders");
            bar.enable_steady_tick(Duration::from_millis(250));
        }
        Self { bar, style, start: Instant::now(), total, done: 0, skipped: 0, failed: 0 }
    }

    /// Says that files are waited for, and what ends that.
    pub fn say_watching(&self, idle: Option<u32>) {
        if self.style != Style::Plain {
            return;
        }
        let end = idle.map_or("Ctrl-C ends it".into(), |seconds| {
            format!("it ends when nothing new has come for {seconds} s, or on Ctrl-C")
        });
        self.bar.suspend(|| print_line(&format!("watching for renders; {end}")));
    }

    /// Prints what became of a file.
    pub fn report(&mut self, job: &Job, outcome: &Outcome) {
        match outcome {
            Outcome::Done(_) => self.done += 1,
            Outcome::Skipped(_) => self.skipped += 1,
            Outcome::Failed(_) => self.failed += 1,
        }
        let count = self.done + self.skipped + self.failed;
        self.bar.set_message(job.input.file_name().unwrap_or_default().to_string_lossy().into_owned());
        self.bar.set_position(count as u64);
        let pace = self.pace(count);
        self.bar.set_prefix(pace.clone());
        // On a terminal the bar shows the pace.
        let pace = if self.bar.is_hidden() { pace } else { String::new() };
        let place = match self.total {
            Some(1) => String::new(),
            Some(total) => format!("[{count}/{total}] "),
            None => format!("[{count}] "),
        };
        let style = self.style;
        // Above the bar, where there is one.
        self.bar.suspend(|| match style {
            Style::Json => print_line(&json_line(job, outcome)),
            Style::Plain => print_plain(job, outcome, &place, &pace),
            Style::Quiet => {}
        });
        if let Outcome::Failed(error) = outcome {
            // Most errors name their file; those of a guide or of a program name that.
            let (error, input) = (error.to_string(), job.input.display().to_string());
            let of = if error.contains(&input) { String::new() } else { format!("{input}: ") };
            self.bar.suspend(|| warn_line(&format!("demc: {of}{error}")));
        }
    }

    /// How fast frames are denoised and when the last will be, as the end of a sentence; empty before there
    /// is a pace, and after the last.
    fn pace(&self, count: usize) -> String {
        let left = self.total.map_or(0, |total| total - count);
        match self.speed() {
            Some(speed) if left > 0 => {
                let time = HumanDuration(Duration::from_secs_f64(left as f64 / speed));
                format!(", {speed:.2} frames/s, {time} left")
            }
            _ => String::new(),
        }
    }

    /// Frames a second so far. Results that existed already take no time and do not count.
    fn speed(&self) -> Option<f64> {
        (self.done > 0).then(|| self.done as f64 / self.start.elapsed().as_secs_f64().max(1e-3))
    }

    /// Prints the totals; returns how many files failed.
    pub fn finish(self, stopped: bool) -> usize {
        self.bar.finish_and_clear();
        let left = self.total.map_or(0, |total| total - self.done - self.skipped - self.failed);
        if self.style == Style::Plain && (self.total != Some(1) || stopped) {
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
            // For a watch the speed would tell how fast frames come in.
            if let (Some(speed), Some(_)) = (self.speed(), self.total) {
                summary += &format!(" ({speed:.2} frames/s)");
            }
            print_line(&summary);
        }
        self.failed
    }
}

fn print_plain(job: &Job, outcome: &Outcome, place: &str, pace: &str) {
    match outcome {
        Outcome::Done(report) => {
            print_line(&format!(
                "{place}{}  {}x{}  {:.2} s{pace}",
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
        Outcome::Skipped(there) => {
            print_line(&format!("{place}{}  is there already", job.output.display()));
            for note in &there.notes {
                warn_line(&format!("demc: note: {}: {note}", job.output.display()));
            }
        }
        Outcome::Failed(_) => {}
    }
}

fn json_line(job: &Job, outcome: &Outcome) -> String {
    let (status, error, report) = match outcome {
        Outcome::Done(report) => ("done", None, Some(report)),
        Outcome::Skipped(_) => ("skipped", None, None),
        Outcome::Failed(error) => ("failed", Some(error.to_string()), None),
    };
    let (notes, quality) = match outcome {
        Outcome::Done(Report { notes, samples, expected_error, .. })
        | Outcome::Skipped(Finished { notes, samples, expected_error }) => {
            (Some(notes.clone()), Some(Quality { samples: *samples, expected_error: *expected_error }))
        }
        Outcome::Failed(_) => (None, None),
    };
    let line = Line {
        input: job.input.display().to_string(),
        output: job.output.display().to_string(),
        status,
        error,
        notes,
        quality,
        report: report.map(|r| Details {
            view_layer: &r.view_layer,
            width: r.width,
            height: r.height,
            passes: &r.passes,
            light_groups: &r.light_groups,
            was_denoised: r.was_denoised,
            seconds: r.seconds,
            non_finite: &r.repaired,
        }),
    };
    serde_json::to_string(&line).expect("strings and numbers serialise")
}
