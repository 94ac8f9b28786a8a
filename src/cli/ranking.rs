//! Frames by how far off they are expected to be: which want more samples, and how many.

use std::collections::BTreeSet;

use super::lines::print_line;
use crate::{
    Error, Result,
    report::{number, plural},
};

/// The RelMSE of a result falls as this power of the number of samples of its render. It is the median of
/// what the built-in models reach on 41 generated views of 1 to 256 samples.
const POWER: f64 = 0.5;

/// How many times its samples a frame is told to want at most: views of 1 to 256 samples tell nothing of more.
const MOST_TIMES: f64 = 1000.0;

/// Expected errors of frames.
pub struct Ranking {
    /// The RelMSE that frames should have.
    wish: Option<f64>,
    frames: Vec<Ranked>,
    /// Frames whose results tell nothing.
    silent: BTreeSet<String>,
}

struct Ranked {
    error: f64,
    input: String,
    samples: Option<u32>,
}

/// A RelMSE that is wished for, from the command line.
///
/// # Errors
/// It is no positive number.
pub fn parse_wish(text: &str) -> Result<f64> {
    let wish: Option<f64> = text.parse().ok().filter(|wish: &f64| wish.is_finite() && *wish > 0.0);
    wish.ok_or_else(|| Error::Usage("wants a RelMSE, such as 0.005; files come before it".into()))
}

impl Ranking {
    /// A ranking without frames.
    pub fn new(wish: Option<f64>) -> Self {
        Self { wish, frames: Vec::new(), silent: BTreeSet::new() }
    }

    /// Adds a frame by its file, the expected RelMSE of its result, where that is known, and the samples of its render.
    /// What was known of the same file is forgotten: it was rendered again.
    pub fn add(&mut self, input: String, error: Option<f64>, samples: Option<u32>) {
        self.frames.retain(|frame| frame.input != input);
        self.silent.remove(&input);
        match error {
            Some(error) => self.frames.push(Ranked { error, input, samples }),
            None => drop(self.silent.insert(input)),
        }
    }

    /// Prints the frames, the worst first.
    pub fn print(mut self) {
        if self.frames.is_empty() {
            print_line("no result tells how far off it is expected to be");
            return;
        }
        print_line("expected RelMSE, the worst first:");
        self.frames.sort_by(|a, b| b.error.total_cmp(&a.error).then_with(|| a.input.cmp(&b.input)));
        for frame in &self.frames {
            print_line(&format!("{:.2e}  {}{}", frame.error, frame.input, self.wanted(frame)));
        }
        if !self.silent.is_empty() {
            let count = self.silent.len();
            print_line(&format!(
                "{count} frame{} more, whose results do not tell (of --temporal, or another method)",
                plural(count)
            ));
        }
    }

    /// How many samples a frame wants.
    fn wanted(&self, frame: &Ranked) -> String {
        let Some(wish) = self.wish.filter(|wish| frame.error > *wish) else { return String::new() };
        let times = (frame.error / wish).powf(1.0 / POWER);
        let is_known = times <= MOST_TIMES;
        match frame.samples.filter(|samples| *samples > 0) {
            None if is_known => format!("  wants about {} times its samples", factor(times)),
            None => format!("  wants more than {MOST_TIMES} times its samples"),
            Some(samples) => {
                let has = format!("  {samples} sample{}, wants", plural(samples as usize));
                match is_known {
                    true => format!("{has} about {}", digits(times * f64::from(samples))),
                    false => format!("{has} more than {MOST_TIMES} times as many"),
                }
            }
        }
    }
}

/// A whole number, rounded up to two digits, since more of it is not known.
fn digits(number: f64) -> String {
    let unit = 10f64.powf((number.log10().floor() - 1.0).max(0.0));
    format!("{:.0}", (number / unit).ceil() * unit)
}

/// A factor, rounded up as [`digits`] are: 1.04 is 1.1 and not 2.
fn factor(times: f64) -> String {
    if times < 10.0 { number((10.0 * times).ceil() / 10.0) } else { digits(times) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_of_the_error_takes_four_times_the_samples() {
        let ranking = Ranking::new(Some(0.01));
        let wanted = |error, samples| ranking.wanted(&Ranked { error, input: String::new(), samples });
        assert_eq!(wanted(0.02, Some(16)), "  16 samples, wants about 64");
        assert_eq!(wanted(0.02, None), "  wants about 4 times its samples");
        assert_eq!(wanted(0.0102, None), "  wants about 1.1 times its samples", "1.0404 times");
        assert_eq!(wanted(0.0353, None), "  wants about 13 times its samples");
        assert_eq!(wanted(0.0102, Some(16)), "  16 samples, wants about 17", "samples are whole");
        assert_eq!(wanted(0.01, Some(16)), "");
        assert_eq!(wanted(0.0353, Some(100)), "  100 samples, wants about 1300");
        assert_eq!(wanted(0.02, Some(1)), "  1 sample, wants about 4");
        assert_eq!(wanted(0.02, Some(0)), "  wants about 4 times its samples", "no render has none");
        for error in [0.4, 1e300, f64::INFINITY] {
            assert_eq!(wanted(error, Some(4)), "  4 samples, wants more than 1000 times as many");
            assert_eq!(wanted(error, None), "  wants more than 1000 times its samples");
        }
        assert_eq!(
            Ranking::new(None).wanted(&Ranked { error: 9.0, input: String::new(), samples: None }),
            ""
        );
    }

    #[test]
    fn a_wish_is_a_positive_number() {
        assert_eq!(parse_wish("5e-3").ok(), Some(0.005));
        for wrong in ["0", "-1", "inf", "nan", "low"] {
            assert!(parse_wish(wrong).is_err(), "{wrong}");
        }
    }
}
