//! `demc report`: sums up the JSON lines of many runs of `demc denoise --json`; on a farm, each task has a
//! file of them.
//!
//! In: these files. Out: a line for each frame that failed or that no task tells of, the totals, the exit
//! status.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs::File,
    io::{BufRead, BufReader},
    path::PathBuf,
};

use clap::Args as ClapArgs;
use serde::Deserialize;

use super::denoise::Frames;
use super::inputs::{self, Inputs, Search};
use super::lines::{ExitCode, SOME_FAILED, print_line, warn_line};
use super::ranking::{Ranking, parse_wish};
use crate::{Error, Result, frame::place_of};

/// Arguments of `demc report`.
#[derive(Debug, ClapArgs)]
#[command(after_help = "\
Examples:
  demc report logs/*.jsonl
  demc report logs/*.jsonl --by-error 0.005
  demc report logs/*.jsonl --of renders --frames 1-240")]
pub struct Args {
    /// Files of what `demc denoise --json` printed, one or several tasks in each
    #[arg(required = true, value_name = "LOG")]
    logs: Vec<PathBuf>,

    /// Also name those of these inputs (files, directories, quoted globs) that no task tells of, as one that
    /// was killed does not
    #[arg(long, value_name = "INPUT", num_args = 1..)]
    of: Vec<PathBuf>,

    /// Also list the frames by their expected RelMSE, the worst first; with a number, also how many samples
    /// those above it want
    #[arg(long, value_name = "RELMSE", num_args = 0..=1, value_parser = parse_wish)]
    #[allow(clippy::option_option, reason = "not at all, the list, what is wanted besides")]
    by_error: Option<Option<f64>>,

    /// Of these inputs those whose names end in one of these numbers, as --frames of `demc denoise` takes them; numbers
    /// that none of them has are missing too
    #[arg(long, value_name = "LIST", requires = "of", allow_hyphen_values = true)]
    frames: Option<Frames>,

    /// Search the directories of --of with all that are in them
    #[arg(long, requires = "of")]
    recursive: bool,
}

/// What the report reads of a line.
#[derive(Deserialize)]
struct Line {
    input: PathBuf,
    output: Option<PathBuf>,
    status: Status,
    error: Option<String>,
    seconds: Option<f64>,
    expected_error: Option<f64>,
    samples: Option<u32>,
}

#[derive(Clone, Copy, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "lowercase")]
enum Status {
    Done,
    Skipped,
    Failed,
}

/// What became of a frame after all tries.
struct Fate {
    /// Its path, as it was told.
    input: PathBuf,
    status: Status,
    /// Which log told of it.
    log: usize,
    error: String,
    /// The result's expected RelMSE, and the samples of its render.
    expected_error: Option<f64>,
    samples: Option<u32>,
}

/// Prints the report.
///
/// # Errors
/// A log cannot be read, or the inputs of `--of` name no file.
pub fn run(args: &Args) -> Result<ExitCode> {
    let mut frames: BTreeMap<PathBuf, Fate> = BTreeMap::new();
    let mut results: BTreeSet<PathBuf> = BTreeSet::new();
    let (mut seconds, mut lines) = (0.0, 0usize);
    for (number, log) in args.logs.iter().enumerate() {
        let mut unreadable = 0;
        for text in BufReader::new(File::open(log).map_err(Error::io("read", log))?).split(b'\n') {
            let text = text.map_err(Error::io("read", log))?;
            match serde_json::from_slice::<Line>(&text[start_of_object(&text)..]) {
                Ok(line) => {
                    lines += 1;
                    seconds += line.seconds.unwrap_or_default();
                    results.extend(line.output.as_deref().map(place_of));
                    add(&mut frames, line, number);
                }
                Err(_) if text.trim_ascii().is_empty() => {}
                Err(_) => unreadable += 1,
            }
        }
        if unreadable > 0 {
            let log = log.display();
            warn_line(&format!("demc: note: {log}: {unreadable} lines are none of `demc denoise --json`"));
        }
    }
    forgive_folders(&mut frames);
    let missing = missing(args, |place| frames.contains_key(place) || results.contains(place))?;
    let lost: usize = missing.iter().map(|(inputs, _)| inputs).sum();
    let count = |status| frames.values().filter(|frame| frame.status == status).count();
    for frame in frames.values().filter(|frame| frame.status == Status::Failed) {
        // Errors name their file already.
        let Fate { input, error, .. } = frame;
        let named = error.contains(&*input.to_string_lossy());
        print_line(&if named {
            format!("failed: {error}")
        } else {
            format!("failed: {}: {error}", input.display())
        });
    }
    for (_, line) in &missing {
        print_line(&format!("missing: {line}"));
    }
    let failed = count(Status::Failed);
    let mut totals = format!("{} denoised in {seconds:.1} s of model time", count(Status::Done));
    for (count, what) in [(count(Status::Skipped), "already there"), (failed, "failed"), (lost, "missing")] {
        if count > 0 {
            totals += &format!(", {count} {what}");
        }
    }
    print_line(&totals);
    if let Some(wish) = args.by_error {
        let mut ranking = Ranking::new(wish);
        for frame in frames.values().filter(|frame| frame.status != Status::Failed) {
            ranking.add(frame.input.display().to_string(), frame.expected_error, frame.samples);
        }
        ranking.print();
    }
    let is_silent = lines == 0;
    if is_silent {
        warn_line("demc: the logs hold no line of `demc denoise --json`; see there why no task wrote one");
    }
    Ok(if is_silent || failed + lost > 0 { ExitCode::from(SOME_FAILED) } else { ExitCode::SUCCESS })
}

/// Where the object of a line begins. A farm's engine may put words of its own before it (`pid=1234 > `), as an editor
/// does with a byte-order mark, and a task that was killed the beginning of an object.
fn start_of_object(text: &[u8]) -> usize {
    const BEGINNING: &[u8] = br#"{"input":"#;
    text.windows(BEGINNING.len()).rposition(|window| window == BEGINNING).unwrap_or(0)
}

/// Adds a line of a log. A frame counts as denoised if any try denoised it, since tasks may be run again or overlap;
/// but not if it failed later in the same log, which tells in which order things happened.
fn add(frames: &mut BTreeMap<PathBuf, Fate>, line: Line, log: usize) {
    let rank = |status| match status {
        Status::Failed => 0,
        Status::Skipped => 1,
        Status::Done => 2,
    };
    // Tasks may reach a folder by different paths.
    let place = place_of(&line.input);
    let is_later = |known: &Fate| {
        rank(known.status) <= rank(line.status) || (known.log == log && line.status == Status::Failed)
    };
    if frames.get(&place).is_none_or(is_later) {
        let Line { input, status, error, expected_error, samples, .. } = line;
        let fate = Fate { input, status, log, error: error.unwrap_or_default(), expected_error, samples };
        frames.insert(place, fate);
    }
}

/// Says of which inputs no task tells, which of them cannot be looked at, and which frames asked for are not there;
/// with each sentence, of how many inputs it is. `is_told` of the [place](place_of) of an input or a result.
fn missing(args: &Args, is_told: impl Fn(&PathBuf) -> bool) -> Result<Vec<(usize, String)>> {
    if args.of.is_empty() {
        return Ok(Vec::new());
    }
    let search = Search { recursive: args.recursive, ..Search::default() };
    let Inputs { mut files, unusable, .. } = inputs::expand(&args.of, &search)?;
    files.retain(|input| args.frames.as_ref().is_none_or(|frames| frames.has(input)));
    let unseen = unusable.into_iter().map(|(_, error)| (1, error.to_string()));
    let lacking = args.frames.as_ref().and_then(|frames| frames.lacking(&files));
    let untold = files.iter().map(|input| &input.file).filter(|file| !is_told(&place_of(file)));
    let untold = untold.map(|file| (1, format!("{}: no task tells of it", file.display())));
    Ok(unseen.chain(lacking).chain(untold).collect())
}

/// Leaves out folders that could not be read at first, and of which files were done later.
fn forgive_folders(frames: &mut BTreeMap<PathBuf, Fate>) {
    let good = frames.iter().filter(|(_, frame)| frame.status != Status::Failed);
    let good: Vec<PathBuf> = good.map(|(place, _)| place.clone()).collect();
    frames.retain(|place, frame| {
        frame.status != Status::Failed || !place.is_dir() || !good.iter().any(|file| file.starts_with(place))
    });
}
