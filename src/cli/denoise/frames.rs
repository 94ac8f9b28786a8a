//! `--frames`: which of the inputs are worked on, by the number that ends their names.
//!
//! In: `7`, `1-9`, `1-9:4` or as others write it `1-9x4` (every fourth), `-5--1`, or a list of them. Out: the
//! files whose names end in one of these numbers, as Blender writes them: `shot_0004spp.0017.exr`,
//! `shot0017.exr`, `shot.-0003.exr`.

use std::{collections::BTreeSet, path::PathBuf, str::FromStr};

use crate::{
    Error, Result,
    cli::{inputs::is_missing_folder, lines::warn_line},
    denoise::{Input, frame_number},
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
        (self.first..=self.last).contains(&frame) && (frame - self.first) % self.step == 0
    }

    /// How many of its frames are not among those that are `there`, and the first of them; none if all are.
    fn lacking(self, there: &BTreeSet<i64>) -> Option<(i128, i64)> {
        let found = there.iter().filter(|frame| self.contains(**frame)).count();
        let frames = (i128::from(self.last) - i128::from(self.first)) / i128::from(self.step) + 1;
        let mut all = (self.first..=self.last).step_by(usize::try_from(self.step).unwrap_or(usize::MAX));
        let first = all.find(|frame| !there.contains(frame))?;
        Some((frames - found as i128, first))
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

    /// The files of these frames. Tells how many frames that were asked for have none.
    ///
    /// # Errors
    /// There is no such file, where `are_all` that were named, as by `inputs`.
    pub fn pick(&self, files: Vec<Input>, inputs: &[PathBuf], are_all: bool) -> Result<Vec<Input>> {
        let picked: Vec<Input> = files.into_iter().filter(|file| self.has(file)).collect();
        if let ([], true, [first, ..]) = (&picked[..], are_all, inputs) {
            let why = "has no file of --frames, whose name ends in one of these numbers as in shot.0017.exr";
            return Err(Error::invalid(first, why));
        }
        let there: BTreeSet<i64> = picked.iter().filter_map(|input| frame_number(&input.file)).collect();
        for (count, first) in self.0.iter().filter_map(|span| span.lacking(&there)) {
            let which = if count == 1 {
                format!("frame {first} is")
            } else {
                format!("{count} frames from {first} on are")
            };
            warn_line(&format!("demc: note: --frames: {which} not there"));
        }
        Ok(picked)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picked(frames: &str) -> Vec<i64> {
        let frames: Frames = frames.parse().unwrap();
        (-6..=12).filter(|n| frames.contains(*n)).collect()
    }

    #[test]
    fn frames_that_are_not_there_are_counted() {
        let lacking = |frames: &str| {
            let frames: Frames = frames.parse().unwrap();
            frames.0.into_iter().map(|span| span.lacking(&[3, 4, 5, 9].into())).collect::<Vec<_>>()
        };
        assert_eq!(lacking("3-5,3-7,1-9:4,8"), [None, Some((2, 6)), Some((1, 1)), Some((1, 8))]);
        let all = "-9223372036854775808-9223372036854775807";
        assert_eq!(lacking(all), [Some((i128::from(u64::MAX) + 1 - 4, i64::MIN))]);
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
