//! `--frames`: which of the inputs are worked on, by the number that ends their names.
//!
//! In: `7`, `1-9`, `1-9:4` or as others write it `1-9x4` (every fourth), `-5--1`, or a list of them. Out: the
//! files whose names end in one of these numbers, as Blender writes them: `shot_0004spp.0017.exr`,
//! `shot0017.exr`, `shot.-0003.exr`.

use std::{collections::BTreeSet, path::PathBuf, str::FromStr};

use crate::{
    Error, Result,
    cli::inputs::is_missing_folder,
    denoise::{Input, frame_number},
    report::plural,
};

/// Frames as the user lists them.
#[derive(Clone, Debug)]
pub struct Frames(Vec<Span>);

/// Every `step`th frame from the first to the last.
#[derive(Clone, Copy, Debug)]
struct Span {
    first: i64,
    last: i64,
    step: i64,
}

impl Span {
    fn contains(self, frame: i64) -> bool {
        let is_between = (self.first..=self.last).contains(&frame);
        is_between && frame.abs_diff(self.first).is_multiple_of(self.step.unsigned_abs())
    }

    fn frames(self) -> impl Iterator<Item = i64> {
        (self.first..=self.last).step_by(usize::try_from(self.step).unwrap_or(usize::MAX))
    }
}

impl FromStr for Frames {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        text.split(',').map(span).collect::<Result<_, _>>().map(Self)
    }
}

fn span(text: &str) -> Result<Span, String> {
    let wrong = || format!("'{text}' is no list of frames; write 7, 1-9, 1-9:4 or 1,3,7-9");
    let number = |text: &str| text.parse::<i64>().map_err(|_| wrong());
    let (frames, step) = match text.split_once([':', 'x']) {
        Some((frames, step)) => (frames, number(step)?),
        None => (text, 1),
    };
    // A minus in front belongs to the number.
    let (first, last) = match frames.get(1..).and_then(|rest| rest.find('-')) {
        Some(at) => (number(&frames[..=at])?, number(&frames[at + 2..])?),
        None => (number(frames)?, number(frames)?),
    };
    if last < first {
        return Err(format!("'{text}': the last frame comes before the first"));
    }
    if step < 1 {
        return Err(format!("'{text}': the step is not a number of at least 1"));
    }
    Ok(Span { first, last, step })
}

impl Frames {
    fn contains(&self, frame: i64) -> bool {
        self.0.iter().any(|span| span.contains(frame))
    }

    /// Whether a file is of one of these frames, or a folder that is not mounted: reading it tells that.
    pub fn has(&self, input: &Input) -> bool {
        let is_of_these = frame_number(&input.file).is_some_and(|frame| self.contains(frame));
        is_of_these || is_missing_folder(&input.file)
    }

    /// The files of these frames.
    ///
    /// # Errors
    /// There is no such file, where `are_all` that were named, as by `inputs`.
    pub fn pick(&self, files: Vec<Input>, inputs: &[PathBuf], are_all: bool) -> Result<Vec<Input>> {
        let picked: Vec<Input> = files.into_iter().filter(|file| self.has(file)).collect();
        if let ([], true, [first, others @ ..]) = (&picked[..], are_all, inputs) {
            let more = if others.is_empty() { String::new() } else { format!(" and {} more", others.len()) };
            let named = format!("{}{more}", first.display());
            return Err(Error::invalid(
                named,
                "no file of --frames; the number of a frame ends its file's name, as in shot.0017.exr",
            ));
        }
        Ok(picked)
    }

    /// Counts the frames that are asked for and not among `files`, if there are any, and says which. So many that they
    /// stand for all that there are do not count.
    pub fn lacking(&self, files: &[Input]) -> Option<(usize, String)> {
        let there: BTreeSet<i64> = files.iter().filter_map(|input| frame_number(&input.file)).collect();
        let wanted: BTreeSet<i64> = self.0.iter().flat_map(|span| span.frames()).take(MOST + 1).collect();
        let lacking: Vec<i64> = wanted.difference(&there).copied().collect();
        let mut spans = lacking.chunk_by(|frame, next| *next == frame + 1).map(|span| match span {
            [one] => one.to_string(),
            [first, .., last] => format!("{first}-{last}"),
            [] => String::new(),
        });
        let mut named = spans.by_ref().take(NAMED).collect::<Vec<_>>().join(",");
        if spans.next().is_some() {
            named += ",...";
        }
        let count = lacking.len();
        let said = format!("--frames: no input is of frame{} {named}", plural(count));
        (count > 0 && wanted.len() <= MOST).then_some((count, said))
    }
}

/// More frames than this are asked for by nobody who means each of them.
const MOST: usize = 100_000;

/// Stretches of frames that are named.
const NAMED: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;

    fn picked(frames: &str) -> Vec<i64> {
        let frames: Frames = frames.parse().unwrap();
        (-6..=12).filter(|n| frames.contains(*n)).collect()
    }

    #[test]
    fn frames_that_are_not_there_are_named() {
        let there =
            [3, 4, 5, 9].map(|n| Input { file: format!("shot.{n:04}.exr").into(), below: PathBuf::new() });
        let lacking = |frames: &str| frames.parse::<Frames>().unwrap().lacking(&there);
        let says =
            |count: usize, frames: &str| Some((count, format!("--frames: no input is of frame{frames}")));
        assert_eq!(lacking("3-5,9"), None);
        assert_eq!(lacking("7,7"), says(1, " 7"));
        assert_eq!(lacking("3-7,6-9:2,1-9:4"), says(4, "s 1,6-8"));
        assert_eq!(lacking("11-40:2"), says(15, "s 11,13,15,17,19,21,23,25,..."));
        let all = "-9223372036854775808-9223372036854775807";
        assert_eq!(lacking(all), None, "they stand for all");
        assert_eq!(
            lacking(&format!("{all}:9223372036854775807")),
            says(3, "s -9223372036854775808,-1,9223372036854775806")
        );
        let third: Frames = format!("{all}:3").parse().unwrap();
        assert!(third.contains(i64::MIN + 3) && third.contains(4) && !third.contains(5));
    }

    #[test]
    fn lists_steps_and_negative_frames() {
        assert_eq!(picked("7"), [7]);
        assert_eq!(picked("1-3"), [1, 2, 3]);
        assert_eq!(picked("1-9:4,2"), [1, 2, 5, 9]);
        assert_eq!(picked("1-9x4"), [1, 5, 9]);
        assert_eq!(picked("-5--3,-1-1"), [-5, -4, -3, -1, 0, 1]);
        for (wrong, why) in [
            ("", "is no list of frames"),
            ("1-", "is no list of frames"),
            ("a", "is no list of frames"),
            ("1,,2", "is no list of frames"),
            ("ä-3", "is no list of frames"),
            ("9-1", "comes before the first"),
            ("1-9:0", "at least 1"),
        ] {
            let error = wrong.parse::<Frames>().unwrap_err();
            assert!(error.contains(why), "{wrong}: {error}");
        }
    }
}
