//! Runs methods over a test set, times them, and writes what a reader needs to judge them.
//!
//! In: pairs and methods. Out, in one folder: `scores.csv` (a row for each pair and method),
//! `summary.csv`, the charts `speed_vs_accuracy`, `bars_relmse` and `bars_ssim` as PNG and SVG,
//! `bars_flicker` and slices of sequences, `error_over_samples` where scenes were rendered at several sample
//! counts, `sheets/<pair>.png`, and `report.html`, which shows it all. Each row is stored as soon as it is
//! finished. Rows of earlier runs into the folder stay in `scores.csv` as long as they hold, and are not
//! measured again. All other files show only what this run asked for.

mod axis;
mod bars;
mod canvas;
mod chart;
mod figure;
mod followed;
mod heat;
mod labels;
#[cfg(feature = "train")]
mod loss;
mod page;
mod pair;
mod palette;
mod picture;
mod provenance;
mod rows;
mod run;
mod samples;
mod sequences;
mod settings;
mod sheet;
mod summary;

use std::path::{Path, PathBuf};

#[cfg(feature = "cli")]
pub(crate) use chart::number_label;
pub use figure::Figure;
pub use heat::{HeatCell, HeatMap};
#[cfg(feature = "train")]
pub use loss::loss_chart;
pub(crate) use page::{document, picture_of, sheet_text};
pub use pair::{Loaded, load, load_listed};
pub use palette::is_own;
pub use provenance::Provenance;
pub use rows::{COLUMNS, Column, Row, append_row, read_rows, to_csv, write_json};
pub use run::{EvalEvent, evaluate, remove_chart, sheet_name};
pub use settings::file_stamp;
pub use summary::{MethodSummary, geometric_mean, mean, summarise};

use crate::models::Denoiser;

/// The ending of a word that counts so many.
pub(crate) fn plural(count: usize) -> &'static str {
    if count == 1 { "" } else { "s" }
}

/// Name of the method that every report has: the input itself.
pub const NOISY: &str = "noisy";

/// Finds the memory in MiB that a method takes for the frame in a file.
pub type MemoryProbe = Box<dyn Fn(&Path) -> Option<f64> + Send + Sync>;

/// A method under test.
pub struct Contender {
    /// Its name in tables and charts, unique in a run.
    pub name: String,
    /// The method itself.
    pub denoiser: Box<dyn Denoiser>,
    /// Memory in MiB that it takes for the frame in a file, at its peak; none where that is not known.
    pub peak_mib: MemoryProbe,
    /// Differs whenever the method might give other results; finished rows are kept while it is the same.
    pub stamp: String,
}

/// How to run.
#[derive(Clone, Debug)]
pub struct EvalOptions {
    /// Folder for everything that is written.
    pub out: PathBuf,
    /// Timed runs of each method on each pair, each after a run that warms up; their median is reported.
    pub repeats: usize,
    /// Threads that all methods use.
    pub threads: usize,
    /// Method that ratios in the summary refer to.
    pub baseline: String,
    /// View layer to read; by default the one with the most passes.
    pub view_layer: Option<String>,
    /// Run everything that is asked for anew.
    pub overwrite: bool,
    /// Write a comparison sheet for each pair.
    pub sheets: bool,
}

/// A measured number as printed and stored: seven significant digits, an exponent
/// only below a millionth.
pub fn number(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    let magnitude = value.abs().log10().floor() as i32;
    if magnitude < -6 {
        return format!("{value:.6e}");
    }
    let decimals = (6 - magnitude).max(0) as usize;
    let text = format!("{value:.decimals$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').into() } else { text }
}

/// A number's cell in a table: empty where there is none.
pub fn cell(value: Option<f64>) -> String {
    value.map(number).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_keep_seven_digits() {
        for (value, expected) in [
            (0.0, "0"),
            (1.0, "1"),
            (0.123456789, "0.1234568"),
            (-0.000123456789, "-0.0001234568"),
            (65504.0, "65504"),
            (123456789.4, "123456789"),
            (4.5381, "4.5381"),
            (1.25e-13, "1.250000e-13"),
        ] {
            assert_eq!(number(value), expected);
        }
    }
}
