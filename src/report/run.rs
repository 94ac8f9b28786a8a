//! The run itself: every method on every pair, each row stored as it finishes, and then the report.

use std::{
    collections::{HashMap, HashSet},
    path::{Path, PathBuf},
};

use super::{
    Contender, EvalOptions, NOISY,
    bars::Bars,
    chart::Chart,
    figure::Figure,
    followed::{NO_FLICKER, is_next},
    page::Page,
    pair::{Carried, PairRun},
    provenance::Provenance,
    rows::{Key, Row, Table, read_rows},
    samples::Samples,
    sequences,
    settings::{self, Settings},
    sheet,
    summary::{self, MethodSummary},
};
use crate::{
    Error, Result,
    frame::{alone_in, prepare_folder, write_file},
    testset::Pair,
};

/// What a run tells while it goes on.
#[derive(Debug)]
pub enum EvalEvent<'a> {
    /// Rows asked for in all, and those of them kept from an earlier run.
    Start {
        /// Rows when all is done.
        rows: usize,
        /// Rows that are there already.
        kept: usize,
    },
    /// A pair is being read.
    Pair(&'a Pair),
    /// What a reader should know of the rows that come next.
    Note(&'a str),
    /// A row is finished.
    Row(&'a Row),
}

/// Scores every method on every pair and writes the report into `options.out`. Returns the rows of them all,
/// those kept from an earlier run included, pair by pair in the order of the methods.
///
/// # Errors
/// The folder cannot be written, or another run writes to it. A pair or method that fails is no error: its row says why.
pub fn evaluate(
    pairs: &[Pair],
    methods: &[Contender],
    options: &EvalOptions,
    on: &mut dyn FnMut(EvalEvent),
) -> Result<Vec<Row>> {
    prepare_folder(&options.out)?;
    let _alone = alone_in(&options.out)?;
    let mut evaluation = Evaluation::begin(pairs, methods, options, on)?;
    let mut carried = Carried::new(pairs, options);
    for (pair, sheet) in pairs.iter().zip(evaluation.sheets.clone()) {
        evaluation.run(pair, &sheet, &mut carried, on)?;
    }
    evaluation.report()
}

/// A run under way.
struct Evaluation<'a> {
    pairs: &'a [Pair],
    methods: &'a [Contender],
    options: &'a EvalOptions,
    /// The file names of the pairs' sheets.
    sheets: Vec<String>,
    provenance: Provenance,
    /// What the rows in the folder are made with; stored in `run.json`.
    settings: Settings,
    table: Table,
    /// How many rows earlier runs measured.
    kept: usize,
}

impl<'a> Evaluation<'a> {
    /// Takes up what earlier runs left in the folder and what of it holds.
    fn begin(
        pairs: &'a [Pair],
        methods: &'a [Contender],
        options: &'a EvalOptions,
        on: &mut dyn FnMut(EvalEvent),
    ) -> Result<Self> {
        if options.sheets {
            prepare_folder(&options.out.join("sheets"))?;
        }
        let scores = options.out.join("scores.csv");
        let provenance = Provenance::now();
        let mut settings = Settings::of(pairs, methods, options, &provenance);
        let before = Settings::read(&options.out.join(STORED));
        let rows = match read_rows(&scores) {
            Err(_) if options.overwrite => Vec::new(),
            rows => rows?,
        };
        let earlier = Earlier::sort_out(rows, pairs, methods, options, (&before, &settings));
        earlier.others.iter().for_each(|row| settings.keep(row, &before));
        settings.sheets = before.sheets;
        if earlier.dropped > 0 {
            on(EvalEvent::Note(&format!(
                "{}: {} rows of other methods or renders are dropped: since they were made, options, program, processor \
                 or files have changed",
                scores.display(),
                earlier.dropped
            )));
        }
        let kept = earlier.kept.len();
        on(EvalEvent::Start { rows: pairs.len() * methods.len(), kept });
        let table = Table::create(scores, earlier.kept, earlier.others)?;
        let sheets: Vec<String> = pairs.iter().map(|pair| sheet_name(pairs, pair)).collect();
        let mut evaluation =
            Self { pairs, methods, options, sheets: sheets.clone(), provenance, settings, table, kept };
        for (pair, sheet) in pairs.iter().zip(sheets) {
            // It is noted again when it is drawn. If this run is killed before that, the old sheet is not taken
            // for one of the new rows.
            let is_finished = evaluation.finished(pair).iter().all(|finished| *finished);
            if !is_finished || evaluation.settings.sheets.get(&sheet) != Some(&evaluation.content(pair)) {
                evaluation.settings.sheets.remove(&sheet);
            }
        }
        evaluation.store_settings()?;
        Ok(evaluation)
    }

    /// Runs the methods on a pair that lack their row or their image on the pair's sheet.
    fn run(
        &mut self,
        pair: &Pair,
        sheet: &str,
        carried: &mut Carried<'_>,
        on: &mut dyn FnMut(EvalEvent),
    ) -> Result<()> {
        let finished = self.finished(pair);
        let shown = self.options.sheets && self.drawn(sheet).is_none();
        if finished.iter().all(|finished| *finished) && !shown {
            return Ok(());
        }
        on(EvalEvent::Pair(pair));
        let run = PairRun { pair, methods: self.methods, finished: &finished, shown, options: self.options };
        let done = run.run(carried);
        for row in done.rows {
            if !row.note.is_empty() {
                on(EvalEvent::Note(&row.note));
            }
            on(EvalEvent::Row(&row));
            self.table.push(row)?;
        }
        let Some(scene) = done.scene else { return Ok(()) };
        let rows =
            self.methods.iter().filter_map(|method| Some((method.name.as_str(), self.row(pair, method)?)));
        sheet::write(&self.sheet_path(sheet), pair, &scene.reference, &scene.images, &rows.collect())?;
        if pair.frame.is_some() {
            sequences::store(&self.options.out, sheet, &scene.images, &scene.reference)?;
        }
        self.settings.sheets.insert(sheet.into(), self.content(pair));
        self.store_settings()
    }

    /// Writes summary, charts and page.
    fn report(self) -> Result<Vec<Row>> {
        let out = &self.options.out;
        let names = self.names();
        let sheets: Vec<Option<PathBuf>> =
            self.sheets.iter().map(|sheet| self.drawn(sheet).filter(|_| self.options.sheets)).collect();
        let scenes: Vec<(&Pair, Option<PathBuf>)> = self.pairs.iter().zip(sheets).collect();
        let rows = self.table.finish(keys(self.pairs, self.methods))?;
        let summaries = summary::summarise(&rows, &names, &self.options.baseline);
        let summary = summary::to_text(&summaries, &self.options.baseline);
        write_file(&out.join("summary.csv"), summary.as_bytes())?;
        let charts = write_charts(&rows, &summaries, &names, self.options)?;
        for slice in std::fs::read_dir(out.join("slices")).into_iter().flatten().flatten() {
            if slice.path().extension().is_some_and(|extension| extension == "png") {
                std::fs::remove_file(slice.path()).map_err(Error::io("remove", slice.path()))?;
            }
        }
        let sequences = if self.options.sheets { sequences::section(out, self.pairs, &names)? } else { None };
        Page {
            sequences: sequences.as_ref(),
            rows: &rows,
            summaries: &summaries,
            charts: &charts,
            scenes: &scenes,
            kept: self.kept,
            options: self.options,
            provenance: &self.provenance,
        }
        .write()?;
        Ok(rows)
    }

    /// The names of the methods.
    fn names(&self) -> Vec<String> {
        self.methods.iter().map(|method| method.name.clone()).collect()
    }

    /// The row of a method on a pair, where it is finished.
    fn row(&self, pair: &Pair, method: &Contender) -> Option<&Row> {
        self.table.get(&Row::new(pair, &method.name).key())
    }

    /// Which methods have their row on a pair.
    fn finished(&self, pair: &Pair) -> Vec<bool> {
        self.methods.iter().map(|method| self.row(pair, method).is_some()).collect()
    }

    fn sheet_path(&self, sheet: &str) -> PathBuf {
        self.options.out.join("sheets").join(sheet)
    }

    /// The sheet's file, if it shows what this run asks for.
    fn drawn(&self, sheet: &str) -> Option<PathBuf> {
        let is_known = self.settings.sheets.contains_key(sheet);
        is_known.then(|| self.sheet_path(sheet)).filter(|path| path.is_file())
    }

    /// What the sheet of a pair shows, as `run.json` notes it.
    fn content(&self, pair: &Pair) -> String {
        format!("{} of {}", self.names().join(", "), settings::name(&pair.noisy, &pair.reference))
    }

    fn store_settings(&self) -> Result<()> {
        self.settings.write(&self.options.out.join(STORED))
    }
}

/// Name of the file with the settings of what is in the folder.
const STORED: &str = "run.json";

/// What identifies the rows that are asked for, in order.
fn keys(pairs: &[Pair], methods: &[Contender]) -> Vec<Key> {
    pairs.iter().flat_map(|pair| methods.iter().map(|method| Row::new(pair, &method.name).key())).collect()
}

/// The rows of earlier runs.
struct Earlier {
    /// Those that are asked for and hold.
    kept: Vec<Row>,
    /// Those that are not asked for and hold.
    others: Vec<Row>,
    /// How many are not asked for and do not hold.
    dropped: usize,
}

impl Earlier {
    /// Tells which rows hold. They get the names that their pairs have now.
    fn sort_out(
        rows: Vec<Row>,
        pairs: &[Pair],
        methods: &[Contender],
        options: &EvalOptions,
        (before, now): (&Settings, &Settings),
    ) -> Self {
        let asked: HashSet<Key> = keys(pairs, methods).into_iter().collect();
        let by_files: HashMap<(PathBuf, PathBuf), &Pair> =
            pairs.iter().map(|pair| (Row::new(pair, NOISY).files(), pair)).collect();
        // A row that failed is tried again, and one without flicker, if the test set now holds the frame before.
        let wants_flicker = |row: &Row, pair: &Pair| {
            row.flicker.is_none()
                && !row.note.contains(NO_FLICKER)
                && pairs.iter().any(|other| is_next(pair, other))
        };
        let (mut kept, mut others): (Vec<Row>, Vec<Row>) =
            rows.into_iter().partition(|row| asked.contains(&row.key()));
        kept.retain(|row| {
            let is_whole = row.reason.is_empty() && !wants_flicker(row, by_files[&row.files()]);
            !options.overwrite && is_whole && before.still_holds(row, now)
        });
        let count = others.len();
        others.retain(|row| before.still_holds(row, now));
        let dropped = count - others.len();
        for row in kept.iter_mut().chain(&mut others) {
            if let Some(pair) = by_files.get(&row.files()) {
                row.rename(pair);
            }
        }
        Self { kept, others, dropped }
    }
}

/// Writes the charts that the rows give, and removes those of an earlier run that they do not give. Returns them as
/// SVG with their titles.
fn write_charts(
    rows: &[Row],
    summaries: &[MethodSummary],
    methods: &[String],
    options: &EvalOptions,
) -> Result<Vec<(&'static str, String)>> {
    let out = &options.out;
    let mut charts = vec![
        ("Speed and accuracy", Chart::new(summaries, options.threads).write(out, "speed_vs_accuracy")?),
        ("RelMSE of every scene", Bars::relmse(rows, summaries).write(out, "bars_relmse")?),
        ("SSIM of every scene", Bars::ssim(rows, summaries).write(out, "bars_ssim")?),
    ];
    for name in ["bars_flicker", "error_over_samples"] {
        remove_chart(out, name)?;
    }
    if rows.iter().any(|row| row.flicker.is_some()) {
        charts.push(("Flicker of every frame", Bars::flicker(rows, summaries).write(out, "bars_flicker")?));
    }
    if let Some(samples) = Samples::new(rows, methods) {
        charts.push(("Error over samples", samples.write(out, "error_over_samples")?));
    }
    Ok(charts)
}

/// Removes a chart of an earlier run, where there is one.
///
/// # Errors
/// The system does not let it be removed.
pub fn remove_chart(out: &Path, name: &str) -> Result<()> {
    for path in ["png", "svg"].map(|extension| out.join(name).with_extension(extension)) {
        match std::fs::remove_file(&path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(Error::io("remove", path)(error));
            }
            _ => {}
        }
    }
    Ok(())
}

/// The most bytes of a scene's name in the name of its sheet: file systems take 255 of them, number and ending included.
const LONGEST_NAME: usize = 200;

/// The file name of the pair's sheet: unique in the test set even where a manifest repeats a scene.
pub fn sheet_name(pairs: &[Pair], pair: &Pair) -> String {
    let file_name = |pair: &Pair| {
        let mut name = pair.id().replace(['/', '\\'], "_");
        name.truncate((0..=LONGEST_NAME).rev().find(|at| name.is_char_boundary(*at)).unwrap_or(0));
        name
    };
    let id = file_name(pair);
    // Some disks take capital letters for small ones.
    let is_twin = |other: &&Pair| file_name(other).to_lowercase() == id.to_lowercase();
    let twins: Vec<&Pair> = pairs.iter().filter(is_twin).collect();
    match twins.iter().position(|p| *p == pair) {
        Some(at) if at > 0 => format!("{id}_{}.png", at + 1),
        _ => format!("{id}.png"),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;
    use crate::{
        models::{Denoiser, Noisy},
        passes::Pass,
        planes::Planes,
        shot::Shot,
    };

    /// Fails as no method should.
    struct Panics;

    impl Denoiser for Panics {
        fn name(&self) -> &str {
            "panics"
        }

        fn passes(&self) -> &[Pass] {
            &[Pass::Combined]
        }

        fn denoise(&self, _: &Shot) -> Result<Planes> {
            panic!("on purpose")
        }
    }

    /// Its first run goes well, and it cannot be timed.
    struct FailsLater(AtomicUsize);

    impl Denoiser for FailsLater {
        fn name(&self) -> &str {
            "fails later"
        }

        fn passes(&self) -> &[Pass] {
            &[Pass::Combined]
        }

        fn denoise(&self, shot: &Shot) -> Result<Planes> {
            match self.0.fetch_add(1, Ordering::Relaxed) {
                0 => Noisy.denoise(shot),
                _ => Err(Error::Usage("out of memory".into())),
            }
        }
    }

    #[test]
    fn a_method_that_fails_fails_alone_and_whole() {
        let out = tempfile::tempdir().unwrap();
        let data = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/*_0004spp.exr");
        let pairs = crate::testset::read(data).unwrap().pairs;
        let method = |denoiser: Box<dyn Denoiser>| Contender {
            name: denoiser.name().into(),
            denoiser,
            peak_mib: Box::new(|_| None),
            stamp: "1".into(),
        };
        let options = EvalOptions {
            out: out.path().into(),
            repeats: 1,
            threads: 1,
            baseline: NOISY.into(),
            view_layer: None,
            overwrite: false,
            sheets: false,
        };
        let methods = [
            method(Box::new(Noisy)),
            method(Box::new(Panics)),
            method(Box::new(FailsLater(AtomicUsize::new(0)))),
        ];
        let rows = evaluate(&pairs, &methods, &options, &mut |_| {}).unwrap();
        assert_eq!(rows.len(), 3 * pairs.len());
        for row in rows {
            assert_eq!(row.is_valid(), row.model == NOISY, "{row:?}");
            assert_eq!(row.reason.contains("internal error"), row.model == "panics", "{row:?}");
            assert_eq!(row.reason.contains("out of memory"), row.model == "fails later", "{row:?}");
            assert!(row.is_valid() || row.seconds.is_none() && row.ssim.is_none(), "{row:?}");
        }
    }
}
