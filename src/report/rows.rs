//! `scores.csv`: one row for each pair and method, appended as it finishes.

use std::{
    collections::HashMap,
    fs::{self, OpenOptions},
    io::Write,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};

use super::{cell, summary::median};
use crate::{
    Error, Result,
    frame::{place_of, write_file},
    metrics::Scores,
    testset::Pair,
};

/// Columns of `scores.csv` in order; the first twelve are the contract with other tools.
pub const COLUMNS: [Column<Row>; 24] = [
    ("scene", |row| row.scene.clone()),
    ("model", |row| row.model.clone()),
    ("spp", |row| row.spp.to_string()),
    ("width", |row| count(row.width)),
    ("height", |row| count(row.height)),
    ("relmse", |row| cell(row.relmse)),
    ("ssim", |row| cell(row.ssim)),
    ("rmse", |row| cell(row.rmse)),
    ("max_error", |row| cell(row.max_error)),
    ("seconds", |row| cell(row.seconds)),
    ("ms_per_mpx", |row| cell(row.ms_per_mpx)),
    ("exposure", |row| cell(row.exposure)),
    ("relmse_trimmed", |row| cell(row.relmse_trimmed)),
    ("smape", |row| cell(row.smape)),
    ("flip", |row| cell(row.flip)),
    ("flicker", |row| cell(row.flicker)),
    ("peak_mib", |row| cell(row.peak_mib)),
    ("threads", |row| row.threads.to_string()),
    ("repeats", |row| row.repeats.to_string()),
    ("non_finite", |row| count(row.non_finite)),
    ("noisy", |row| row.noisy.display().to_string()),
    ("reference", |row| row.reference.display().to_string()),
    ("reason", |row| row.reason.clone()),
    ("note", |row| row.note.clone()),
];

fn count(count: Option<usize>) -> String {
    count.map(|count| count.to_string()).unwrap_or_default()
}

/// What one method scored on one pair. A number that could not be measured is none; `reason` says why.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
pub struct Row {
    /// Scene, and the frame where it belongs to a sequence.
    pub scene: String,
    /// Method.
    pub model: String,
    /// Samples per pixel of the noisy render.
    pub spp: u32,
    /// Pixels in a row.
    pub width: Option<usize>,
    /// Rows.
    pub height: Option<usize>,
    /// See [`crate::metrics`].
    pub relmse: Option<f64>,
    /// See [`crate::metrics`].
    pub ssim: Option<f64>,
    /// See [`crate::metrics`].
    pub rmse: Option<f64>,
    /// See [`crate::metrics`].
    pub max_error: Option<f64>,
    /// Median time to denoise the frame, without file traffic.
    pub seconds: Option<f64>,
    /// The same in milliseconds for a million pixels.
    pub ms_per_mpx: Option<f64>,
    /// Display exposure of the reference.
    pub exposure: Option<f64>,
    /// See [`crate::metrics`].
    pub relmse_trimmed: Option<f64>,
    /// See [`crate::metrics`].
    pub smape: Option<f64>,
    /// See [`crate::metrics`].
    pub flip: Option<f64>,
    /// See [`crate::metrics::flicker`]; none where the test set does not hold the frame before this one.
    #[serde(default)]
    pub flicker: Option<f64>,
    /// Memory in MiB that denoising added at its peak.
    pub peak_mib: Option<f64>,
    /// Threads used.
    pub threads: usize,
    /// Timed runs.
    pub repeats: usize,
    /// NaN or infinite values in the method's output; any makes the row invalid.
    pub non_finite: Option<usize>,
    /// The noisy file.
    pub noisy: PathBuf,
    /// The reference file.
    pub reference: PathBuf,
    /// Why the method failed here, so that it is tried again; empty where all is well.
    pub reason: String,
    /// What else a reader should know, such as why a score is not defined, or what the method said of the
    /// frame. Notes on the pair itself are in the row of `noisy`.
    #[serde(default)]
    pub note: String,
}

/// What identifies a row, in other runs too: the noisy file and the reference file, by whatever path they are
/// reached, and the method.
pub type Key = (PathBuf, PathBuf, String);

impl Row {
    /// A row without numbers.
    pub fn new(pair: &Pair, model: &str) -> Self {
        Self {
            scene: pair.label(),
            model: model.into(),
            spp: pair.spp,
            noisy: pair.noisy.clone(),
            reference: pair.reference.clone(),
            ..Self::default()
        }
    }

    /// Calls the scene and the files as a pair does that has the same files: a manifest may have changed since the
    /// row was made, and the files may be reached by another path.
    pub fn rename(&mut self, pair: &Pair) {
        let Self { scene, spp, noisy, reference, .. } = Self::new(pair, &self.model);
        (self.scene, self.spp, self.noisy, self.reference) = (scene, spp, noisy, reference);
    }

    /// The row as it was read, without numbers that are not finite. If there was one, `reason` tells so, and
    /// the row is measured again.
    fn checked(mut self) -> Self {
        let numbers = [
            &mut self.relmse,
            &mut self.ssim,
            &mut self.rmse,
            &mut self.max_error,
            &mut self.seconds,
            &mut self.ms_per_mpx,
            &mut self.exposure,
            &mut self.relmse_trimmed,
            &mut self.smape,
            &mut self.flip,
            &mut self.flicker,
            &mut self.peak_mib,
        ];
        for number in numbers {
            if number.take_if(|value| !value.is_finite()).is_some() && self.reason.is_empty() {
                self.reason = "the table held a number that is not finite".into();
            }
        }
        self
    }

    /// What identifies it.
    pub fn key(&self) -> Key {
        let (noisy, reference) = self.files();
        (noisy, reference, self.model.clone())
    }

    /// The noisy and the reference file, by whatever path their folders are reached.
    pub fn files(&self) -> (PathBuf, PathBuf) {
        (place_of(&self.noisy), place_of(&self.reference))
    }

    /// Adds to the note.
    pub fn say(&mut self, note: &str) {
        if !self.note.is_empty() {
            self.note += "; ";
        }
        self.note += note;
    }

    /// Whether the method gave scores here.
    pub fn is_valid(&self) -> bool {
        self.relmse.is_some()
    }

    /// Fills in the scores.
    pub fn set_scores(&mut self, scores: &Scores) {
        self.relmse = Some(scores.relmse);
        self.ssim = scores.ssim;
        self.rmse = Some(scores.rmse);
        self.max_error = Some(scores.max_error);
        self.exposure = scores.exposure;
        self.relmse_trimmed = Some(scores.relmse_trimmed);
        self.smape = Some(scores.smape);
        self.flip = scores.flip;
    }

    /// Fills in the median of the measured times.
    pub fn set_time(&mut self, times: &[f64], pixels: usize) {
        let Some(seconds) = median(times) else { return };
        self.seconds = Some(seconds);
        self.ms_per_mpx = Some(seconds * 1e3 / (pixels as f64 / 1e6));
    }
}

/// A column of a table: its name, and the cell of a row.
pub type Column<R> = (&'static str, fn(&R) -> String);

/// A table as CSV, with a header.
pub fn to_csv<'a, R: 'a>(columns: &[Column<R>], rows: impl IntoIterator<Item = &'a R>) -> String {
    let header = columns.iter().map(|(name, _)| (*name).to_owned()).collect();
    csv_lines(std::iter::once(header).chain(rows.into_iter().map(|row| cells(columns, row))))
}

fn cells<R>(columns: &[Column<R>], row: &R) -> Vec<String> {
    columns.iter().map(|(_, cell)| cell(row)).collect()
}

/// Lines of CSV from their cells.
pub fn csv_lines(lines: impl IntoIterator<Item = Vec<String>>) -> String {
    let mut writer = csv::Writer::from_writer(Vec::new());
    let invariant = "writing to memory does not fail";
    lines.into_iter().for_each(|cells| writer.write_record(cells).expect(invariant));
    String::from_utf8(writer.into_inner().expect(invariant)).expect("cells are UTF-8")
}

/// Replaces a file by a value as JSON, in one step.
///
/// # Errors
/// It cannot be written.
///
/// # Panics
/// If JSON has no form for the value.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<()> {
    let text = serde_json::to_string_pretty(value).expect("the value has a form in JSON");
    write_file(path, (text + "\n").as_bytes())
}

/// Appends a row to a CSV file at once.
///
/// # Errors
/// It cannot be written.
pub fn append_row<R>(path: &Path, columns: &[Column<R>], row: &R) -> Result<()> {
    let line = csv_lines([cells(columns, row)]);
    let mut file = OpenOptions::new().append(true).open(path).map_err(Error::io("write", path))?;
    file.write_all(line.as_bytes()).map_err(Error::io("write", path))
}

/// The rows of a `scores.csv`; none where there is no such file. A last line that a killed run cut
/// short is left out.
///
/// # Errors
/// The file is unreadable or not such a table.
pub fn read_rows(path: &Path) -> Result<Vec<Row>> {
    let mut text = match fs::read_to_string(path) {
        Ok(text) => text,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(e) => return Err(Error::io("read", path)(e)),
    };
    text.truncate(text.rfind('\n').map_or(0, |end| end + 1));
    let rows = csv::Reader::from_reader(text.as_bytes()).into_deserialize().collect::<Result<Vec<Row>, _>>();
    let rows = rows.map_err(|e| {
        Error::invalid(path, format!("is no table of scores: {e}; move it away, or say --overwrite"))
    })?;
    Ok(rows.into_iter().map(Row::checked).collect())
}

/// The table on disk while a run fills it.
pub struct Table {
    path: PathBuf,
    rows: HashMap<Key, Row>,
    /// Rows that this run does not ask for; they stay.
    others: Vec<Row>,
}

impl Table {
    /// Starts with the rows kept from an earlier run, and others that are not asked for now.
    pub fn create(path: PathBuf, kept: Vec<Row>, others: Vec<Row>) -> Result<Self> {
        let text = to_csv(&COLUMNS, kept.iter().chain(&others));
        write_file(&path, text.as_bytes())?;
        Ok(Self { path, rows: kept.into_iter().map(|row| (row.key(), row)).collect(), others })
    }

    /// The row, where it is asked for and finished.
    pub fn get(&self, key: &Key) -> Option<&Row> {
        self.rows.get(key)
    }

    /// Stores a row at once.
    pub fn push(&mut self, row: Row) -> Result<()> {
        append_row(&self.path, &COLUMNS, &row)?;
        self.rows.insert(row.key(), row);
        Ok(())
    }

    /// Rewrites the table in the order of `keys`, the other rows last, and returns the rows that were asked
    /// for.
    pub fn finish(mut self, keys: impl IntoIterator<Item = Key>) -> Result<Vec<Row>> {
        let rows: Vec<Row> = keys.into_iter().filter_map(|key| self.rows.remove(&key)).collect();
        let text = to_csv(&COLUMNS, rows.iter().chain(&self.others));
        write_file(&self.path, text.as_bytes())?;
        Ok(rows)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(scene: &str, model: &str) -> Row {
        let pair = Pair {
            scene: scene.into(),
            noisy: format!("{scene}_0004spp.exr").into(),
            reference: format!("{scene}_ref.exr").into(),
            spp: 4,
            frame: None,
        };
        Row::new(&pair, model)
    }

    #[test]
    fn table_survives_a_cut_line_and_ends_in_order_with_the_other_rows_last() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scores.csv");
        let mut table = Table::create(path.clone(), vec![row("b", "noisy")], vec![row("a", "m")]).unwrap();
        let mut full = row("a", "oidn, \"high\"");
        full.relmse = Some(0.0123);
        full.non_finite = Some(0);
        full.reason = "line one".into();
        full.say("one");
        full.say("two, three");
        assert_eq!(full.note, "one; two, three");
        table.push(full.clone()).unwrap();
        assert_eq!(read_rows(&path).unwrap(), [row("b", "noisy"), row("a", "m"), full.clone()]);

        let mut file = OpenOptions::new().append(true).open(&path).unwrap();
        file.write_all(b"c,noisy,4,12").unwrap();
        assert_eq!(read_rows(&path).unwrap().len(), 3, "a cut line is no row");

        let rows = table.finish([full.key(), row("b", "noisy").key(), row("z", "noisy").key()]).unwrap();
        assert_eq!(rows, [full.clone(), row("b", "noisy")]);
        assert_eq!(read_rows(&path).unwrap(), [full, row("b", "noisy"), row("a", "m")]);
    }

    #[test]
    fn what_is_no_number_is_an_empty_cell_that_is_measured_again() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scores.csv");
        for (text, expected) in [("inf", None), ("1e999", None), ("NaN", None), ("5e-324", Some(5e-324))] {
            let whole = Row { relmse: Some(0.25), ..row("a", "noisy") };
            Table::create(path.clone(), vec![whole], Vec::new()).unwrap();
            let table = fs::read_to_string(&path).unwrap().replace("0.25", text);
            fs::write(&path, table).unwrap();
            let rows = read_rows(&path).unwrap();
            assert_eq!((rows[0].relmse, rows[0].reason.is_empty()), (expected, expected.is_some()), "{text}");
        }
    }

    #[test]
    fn header_begins_with_the_contract() {
        let contract = "scene,model,spp,width,height,relmse,ssim,rmse,max_error,seconds,ms_per_mpx,exposure";
        assert_eq!(COLUMNS.map(|(name, _)| name)[..12].join(","), contract);
    }

    #[test]
    fn time_is_the_median() {
        for (times, expected) in [(vec![3.0, 1.0, 2.0], 2.0), (vec![4.0, 1.0], 2.5), (vec![7.0], 7.0)] {
            let mut row = row("a", "m");
            row.set_time(&times, 500_000);
            assert_eq!(row.seconds, Some(expected));
            assert_eq!(row.ms_per_mpx, Some(expected * 2000.0));
        }
        let mut untimed = row("a", "noisy");
        untimed.set_time(&[], 1);
        assert_eq!(untimed.seconds, None);
    }

    #[test]
    fn a_foreign_file_is_an_error_with_a_remedy() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scores.csv");
        fs::write(&path, "a,b\n1,2\n").unwrap();
        assert!(read_rows(&path).unwrap_err().to_string().contains("--overwrite"));
        assert_eq!(read_rows(&dir.path().join("none.csv")).unwrap(), []);
    }
}
