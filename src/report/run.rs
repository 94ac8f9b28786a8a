//! The run itself: every method on every pair, interleaved, scored, timed and stored as it finishes.
//!
//! On a pair, each method first runs once to be scored. Then the methods take turns for the timed runs, so
//! that a machine that slows down slows them all, and each timed run follows an untimed one of the same
//! method. Memory is measured apart, once for each method and size of frame.

use std::{
    collections::{HashMap, HashSet},
    path::{Path, PathBuf},
};

use super::{
    Contender, EvalOptions, NOISY,
    bars::Bars,
    chart::Chart,
    figure::Figure,
    followed::{Followed, NO_FLICKER, is_next},
    page::Page,
    provenance::Provenance,
    rows::{Key, Row, Table, read_rows, write_file},
    samples::Samples,
    sequences,
    settings::{self, Settings},
    sheet::{self, Shown},
    summary,
};
use crate::{
    Error, Result, denoise,
    error::attempt,
    frame::prepare_folder,
    metrics::{self, pairing},
    models::{Denoiser, Run},
    passes::{self, Pass},
    planes::Planes,
    shot::{self, Shot},
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
/// The folder cannot be written. A pair or method that fails is no error: its row says why.
pub fn evaluate(
    pairs: &[Pair],
    methods: &[Contender],
    options: &EvalOptions,
    on: &mut dyn FnMut(EvalEvent),
) -> Result<Vec<Row>> {
    let out = &options.out;
    let sheets = out.join("sheets");
    prepare_folder(out)?;
    if options.sheets {
        prepare_folder(&sheets)?;
    }
    let (scores, stored) = (out.join("scores.csv"), out.join("run.json"));
    let provenance = Provenance::now();
    let (before, mut now) = (Settings::read(&stored), Settings::of(pairs, methods, options, &provenance));
    let keys: Vec<Key> =
        pairs.iter().flat_map(|p| methods.iter().map(|m| Row::new(p, &m.name).key())).collect();
    let asked: HashSet<&Key> = keys.iter().collect();
    let rows = match read_rows(&scores) {
        Err(_) if options.overwrite => Vec::new(),
        rows => rows?,
    };
    let by_key: HashMap<(PathBuf, PathBuf), &Pair> =
        pairs.iter().map(|pair| (Row::new(pair, NOISY).files(), pair)).collect();
    let (mut kept, mut others): (Vec<Row>, Vec<Row>) =
        rows.into_iter().partition(|row| asked.contains(&row.key()));
    // A row that failed is tried again, and one without flicker, if the test set now holds the frame before.
    let wants_flicker = |row: &Row, pair: &Pair| {
        row.flicker.is_none()
            && !row.note.contains(NO_FLICKER)
            && pairs.iter().any(|other| is_next(pair, other))
    };
    kept.retain_mut(|row| {
        let pair = by_key[&row.files()];
        let is_whole = row.reason.is_empty() && !wants_flicker(row, pair);
        let holds = !options.overwrite && is_whole && before.still_holds(row, &now);
        row.rename(pair);
        holds
    });
    let count = others.len();
    others.retain(|row| before.still_holds(row, &now));
    others.iter().for_each(|row| now.keep(row, &before));
    others.iter_mut().for_each(|row| {
        if let Some(pair) = by_key.get(&row.files()) {
            row.rename(pair);
        }
    });
    if others.len() < count {
        on(EvalEvent::Note(&format!(
            "{}: {} rows of other methods or renders are dropped: since they were made, options, program, processor or files \
             have changed",
            scores.display(),
            count - others.len()
        )));
    }

    on(EvalEvent::Start { rows: pairs.len() * methods.len(), kept: kept.len() });
    let mut table = Table::create(scores, kept, others)?;
    let names: Vec<String> = methods.iter().map(|m| m.name.clone()).collect();
    let shows =
        |pair: &Pair| format!("{} of {}", names.join(", "), settings::name(&pair.noisy, &pair.reference));
    let sheet_names: Vec<String> = pairs.iter().map(|pair| sheet_name(pairs, pair)).collect();
    now.sheets = before.sheets;
    for (pair, sheet) in pairs.iter().zip(&sheet_names) {
        let is_finished = methods.iter().all(|m| table.get(&Row::new(pair, &m.name).key()).is_some());
        // It is noted again when it is drawn. If this run is killed before that, the old sheet is not taken
        // for one of the new rows.
        if !is_finished || now.sheets.get(sheet) != Some(&shows(pair)) {
            now.sheets.remove(sheet);
        }
    }
    now.write(&stored)?;
    let mut peaks = Peaks::new();
    let mut followed = Followed::new(pairs, options.view_layer.as_deref());
    for (pair, name) in pairs.iter().zip(&sheet_names) {
        let finished: Vec<bool> =
            methods.iter().map(|m| table.get(&Row::new(pair, &m.name).key()).is_some()).collect();
        let sheet = options.sheets.then(|| sheets.join(name));
        let sheet = sheet.filter(|path| !(now.sheets.contains_key(name) && path.is_file()));
        if finished.iter().all(|f| *f) && sheet.is_none() {
            continue;
        }
        on(EvalEvent::Pair(pair));
        let done = run_pair(pair, methods, &finished, sheet.is_some(), options, (&mut peaks, &mut followed));
        for row in done.rows {
            if !row.note.is_empty() {
                on(EvalEvent::Note(&row.note));
            }
            on(EvalEvent::Row(&row));
            table.push(row)?;
        }
        if let (Some(path), Some(scene)) = (sheet, done.scene) {
            let rows: HashMap<&str, &Row> = methods
                .iter()
                .filter_map(|m| Some((m.name.as_str(), table.get(&Row::new(pair, &m.name).key())?)))
                .collect();
            sheet::write(&path, pair, &scene.reference, &scene.images, &rows)?;
            if pair.frame.is_some() {
                sequences::store(out, name, &scene.images, &scene.reference)?;
            }
            now.sheets.insert(name.clone(), shows(pair));
            now.write(&stored)?;
        }
    }

    let rows = table.finish(keys)?;
    let summaries = summary::summarise(&rows, &names, &options.baseline);
    write_file(&out.join("summary.csv"), summary::to_text(&summaries, &options.baseline).as_bytes())?;
    let mut charts = vec![
        ("Speed and accuracy", Chart::new(&summaries, options.threads).write(out, "speed_vs_accuracy")?),
        ("RelMSE of every scene", Bars::relmse(&rows, &summaries).write(out, "bars_relmse")?),
        ("SSIM of every scene", Bars::ssim(&rows, &summaries).write(out, "bars_ssim")?),
    ];
    // What this run has nothing for is not left over from another.
    for name in ["bars_flicker", "error_over_samples"] {
        remove_chart(out, name)?;
    }
    if rows.iter().any(|row| row.flicker.is_some()) {
        charts.push(("Flicker of every frame", Bars::flicker(&rows, &summaries).write(out, "bars_flicker")?));
    }
    if let Some(samples) = Samples::new(&rows, &names) {
        charts.push(("Error over samples", samples.write(out, "error_over_samples")?));
    }
    let scenes: Vec<(&Pair, Option<PathBuf>)> = pairs
        .iter()
        .zip(&sheet_names)
        .map(|(pair, name)| {
            let is_known = options.sheets && now.sheets.contains_key(name);
            (pair, is_known.then(|| sheets.join(name)).filter(|path| path.is_file()))
        })
        .collect();
    for slice in std::fs::read_dir(out.join("slices")).into_iter().flatten().flatten() {
        if slice.path().extension().is_some_and(|extension| extension == "png") {
            std::fs::remove_file(slice.path()).map_err(Error::io("remove", slice.path()))?;
        }
    }
    let sequences = if options.sheets { sequences::section(out, pairs, &names)? } else { None };
    Page {
        sequences: sequences.as_ref(),
        rows: &rows,
        summaries: &summaries,
        charts: &charts,
        scenes: &scenes,
        options,
        provenance: &provenance,
    }
    .write()?;
    Ok(rows)
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

/// The file name of the pair's sheet: unique in the test set even where a manifest repeats a scene.
pub fn sheet_name(pairs: &[Pair], pair: &Pair) -> String {
    let file_name = |pair: &Pair| pair.id().replace(['/', '\\'], "_");
    let id = file_name(pair);
    // Some disks take capital letters for small ones.
    let is_twin = |other: &&Pair| file_name(other).to_lowercase() == id.to_lowercase();
    let twins: Vec<&Pair> = pairs.iter().filter(is_twin).collect();
    match twins.iter().position(|p| *p == pair) {
        Some(at) if at > 0 => format!("{id}_{}.png", at + 1),
        _ => format!("{id}.png"),
    }
}

/// What running a pair gave.
struct Done {
    /// Rows of the methods that were not finished.
    rows: Vec<Row>,
    /// Images for the sheet, where the pair could be read.
    scene: Option<Scene>,
}

struct Scene {
    reference: Planes,
    images: Vec<Shown>,
}

/// The decoded pair.
pub struct Loaded {
    /// What methods are given; its half buffers are not read yet.
    pub shot: Shot,
    /// The reference's radiance, of the same size.
    pub reference: Planes,
}

impl Loaded {
    /// The render as it is stored in the file, which is scored as the method `noisy`.
    pub fn noisy(&self) -> &Planes {
        self.shot.as_stored().expect("a pair without Combined is not loaded")
    }

    /// Reads the frames around the noisy one that lie beside it, for methods that make use of them; those
    /// that cannot be read are left out.
    pub fn read_neighbours(&mut self, reach: usize, view_layer: Option<&str>) {
        for (offset, path) in denoise::neighbours(&self.shot.passes.path, reach) {
            if let Ok(shot) = shot::prepare(&path, view_layer) {
                self.shot.neighbours.insert(offset, shot.passes);
            }
        }
    }
}

/// Reads a pair of frames. Of the noisy one it reads the named view layer, or by default the one with the
/// most passes, and of the reference the view layer that corresponds to it, see [`passes::load_like`].
///
/// # Errors
/// A file is unusable or lacks Combined, or they do not hold the same pixels.
pub fn load(pair: &Pair, view_layer: Option<&str>) -> Result<Loaded> {
    let shot = shot::prepare(&pair.noisy, view_layer)?;
    shot.passes.require(Pass::Combined, NOISY)?;
    let mut reference = passes::load_like(&pair.reference, &shot.passes.view_layer)?;
    shot.passes.check_same_pixels(&reference, "its reference")?;
    reference.require(Pass::Combined, "a reference")?;
    let reference = reference.remove(Pass::Combined).expect("it is there");
    Ok(Loaded { shot, reference })
}

/// As [`load`], of a pair whose reference may be missing.
///
/// # Errors
/// As [`load`], or there is no reference.
pub fn load_listed(pair: &Pair, view_layer: Option<&str>) -> Result<Loaded> {
    if !pair.reference.is_file() {
        return Err(pair.no_reference());
    }
    attempt(&pair.noisy, || load(pair, view_layer))
}

/// Memory peaks known so far, by method, width and height.
type Peaks = HashMap<(String, usize, usize), Option<f64>>;

fn run_pair(
    pair: &Pair,
    methods: &[Contender],
    finished: &[bool],
    shown: bool,
    options: &EvalOptions,
    (peaks, followed): (&mut Peaks, &mut Followed),
) -> Done {
    let open = || methods.iter().zip(finished).filter(|(_, finished)| !**finished).map(|(m, _)| m);
    let new_row = |method: &Contender| {
        let mut row = Row::new(pair, &method.name);
        row.threads = options.threads;
        row
    };
    let mut loaded = match load_listed(pair, options.view_layer.as_deref()) {
        Ok(loaded) => loaded,
        Err(error) => {
            let fail = |method| Row { reason: error.to_string(), ..new_row(method) };
            return Done { rows: open().map(fail).collect(), scene: None };
        }
    };
    let (width, height) = (loaded.noisy().width, loaded.noisy().height);
    // If half buffers are unusable, only the methods that read them fail.
    let halves = if methods.iter().any(|method| method.denoiser.reads_halves()) {
        attempt(&pair.noisy, || loaded.shot.read_halves()).map_err(|error| error.to_string())
    } else {
        Ok(())
    };
    let reach = methods.iter().map(|method| method.denoiser.reach()).max().unwrap_or(0);
    loaded.read_neighbours(reach, options.view_layer.as_deref());
    let mut before = followed.before(pair);
    let mut rows: Vec<Option<Row>> = Vec::new();
    let mut images = Vec::new();
    for (method, &finished) in methods.iter().zip(finished) {
        if finished && !shown {
            rows.push(None);
            continue;
        }
        let mut row = new_row(method);
        (row.width, row.height) = (Some(width), Some(height));
        let image = match &halves {
            Err(why) if method.denoiser.reads_halves() => {
                row.reason.clone_from(why);
                None
            }
            _ => first_run(method, pair, &loaded, &mut row),
        };
        if !finished {
            method.denoiser.notes(&loaded.shot).iter().for_each(|note| row.say(note));
        }
        if !finished && method.name == NOISY {
            let warning = pairing::warning(pair.id(), loaded.noisy(), &loaded.reference);
            warning.iter().for_each(|warning| row.say(warning));
        }
        if !finished && row.is_valid() && row.peak_mib.is_none() && method.name != NOISY {
            let measure = || (method.peak_mib)(&pair.noisy);
            row.peak_mib = *peaks.entry((method.name.clone(), width, height)).or_insert_with(measure);
        }
        if !finished && let (Some(image), Some(before)) = (&image, before.as_mut()) {
            match before.flicker(method, image, &loaded) {
                Ok(Some(flicker)) => row.flicker = Some(flicker),
                Ok(None) => row.say(&format!("{NO_FLICKER}: no pixel can be followed from the frame before")),
                Err(why) => row.say(&why),
            }
        }
        if let Some(image) = &image {
            followed.keep(pair, &loaded.reference, &method.name, image);
        }
        if shown && let Some(image) = &image {
            images.push(Shown::new(&method.name, image, &loaded.reference));
        }
        rows.push((!finished).then_some(row));
    }
    let mut times: Vec<Vec<f64>> = vec![Vec::new(); methods.len()];
    for _ in 0..options.repeats {
        for (i, method) in methods.iter().enumerate() {
            let Some(row) = rows[i].as_mut().filter(|row| row.is_valid() && method.name != NOISY) else {
                continue;
            };
            match attempt(&pair.noisy, || timed_run(&*method.denoiser, &loaded.shot)) {
                Ok(run) => times[i].push(run.seconds),
                Err(error) => {
                    let (width, height) = (row.width, row.height);
                    *row = Row { reason: error.to_string(), width, height, ..new_row(method) };
                    times[i].clear();
                }
            }
        }
    }
    for (row, times) in rows.iter_mut().zip(&mut times) {
        if let Some(row) = row {
            row.repeats = times.len();
            row.set_time(times, width * height);
        }
    }
    Done {
        rows: rows.into_iter().flatten().collect(),
        scene: shown.then_some(Scene { reference: loaded.reference, images }),
    }
}

/// A timed run, right after an untimed one unless the method needs none. Cores that have waited for another
/// process are slow for some 20 ms (twice as slow in a virtual machine), and that must not count against the
/// method that comes next.
fn timed_run(denoiser: &dyn Denoiser, shot: &Shot) -> Result<Run> {
    if !denoiser.is_warm() {
        denoiser.denoise(shot)?;
    }
    denoiser.denoise_timed(shot)
}

/// The run that is scored. None, with a reason in the row, where it fails.
fn first_run(method: &Contender, pair: &Pair, loaded: &Loaded, row: &mut Row) -> Option<Planes> {
    let image = if method.name == NOISY {
        loaded.noisy().clone()
    } else {
        match attempt(&pair.noisy, || method.denoiser.denoise_timed(&loaded.shot)) {
            Ok(run) => {
                row.peak_mib = run.peak_mib;
                run.image
            }
            Err(error) => {
                row.reason = error.to_string();
                return None;
            }
        }
    };
    row.non_finite = Some(image.non_finite());
    match metrics::score(&image, &loaded.reference) {
        Ok(scores) => {
            row.set_scores(&scores);
            let undefined = scores.named().into_iter().filter(|(_, score)| score.is_none());
            let undefined = undefined.map(|(name, _)| name).collect::<Vec<_>>().join(", ");
            if !undefined.is_empty() {
                let why = metrics::why_undefined(&loaded.reference);
                row.say(&format!("{}: no {undefined}: {why}", pair.id()));
            }
            Some(image)
        }
        Err(why) => {
            row.reason = why.to_string();
            None
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;
    use crate::{Error, models::Noisy, report::Contender};

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
