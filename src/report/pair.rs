//! One pair: every method on it, scored, timed and kept for its sheet.
//!
//! Each method first runs once to be scored. Then the methods take turns for the timed runs, so that a machine
//! that slows down slows them all, and each timed run follows an untimed one of the same method. Memory is
//! measured apart, once for each method and size of frame.

use std::collections::HashMap;

use super::{
    Contender, EvalOptions, NOISY,
    followed::{Before, Followed, NO_FLICKER, are_seeds},
    rows::Row,
    sheet::Shown,
};
use crate::{
    Result, denoise,
    error::attempt,
    metrics::{self, pairing},
    models::{Denoiser, Run},
    passes::{self, Pass},
    planes::Planes,
    shot::{self, Shot},
    testset::Pair,
};

/// The methods that run on a pair, and how.
pub struct PairRun<'a> {
    /// The pair.
    pub pair: &'a Pair,
    /// All methods.
    pub methods: &'a [Contender],
    /// Which of them have their row already. They run again only to be shown.
    pub finished: &'a [bool],
    /// Whether every method's image is wanted.
    pub shown: bool,
    /// How to run.
    pub options: &'a EvalOptions,
}

/// What a run carries from one pair to the next.
pub struct Carried<'a> {
    /// Memory peaks known so far, by method, width and height.
    peaks: HashMap<(String, usize, usize), Option<f64>>,
    followed: Followed<'a>,
}

impl<'a> Carried<'a> {
    /// What is carried before the first of these pairs: nothing.
    pub fn new(pairs: &'a [Pair], options: &'a EvalOptions) -> Self {
        Self { peaks: HashMap::new(), followed: Followed::new(pairs, options.view_layer.as_deref()) }
    }
}

/// What running a pair gave.
pub struct Done {
    /// Rows of the methods that were not finished.
    pub rows: Vec<Row>,
    /// Images for the sheet, where the pair could be read and they are wanted.
    pub scene: Option<Scene>,
}

/// A pair as its sheet shows it.
pub struct Scene {
    /// The reference's radiance.
    pub reference: Planes,
    /// Every method's image.
    pub images: Vec<Shown>,
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
    /// that cannot be read are left out, as are those that the test set says are the same frame. What is read stays.
    pub fn read_neighbours(
        &mut self,
        reach: usize,
        view_layer: Option<&str>,
        (pair, pairs): (&Pair, &[Pair]),
    ) {
        for (offset, path) in denoise::neighbours(&self.shot.passes.path, reach) {
            let is_seed = pairs.iter().any(|other| other.noisy == path && are_seeds(pair, other));
            if is_seed || self.shot.neighbours.contains_key(&offset) {
                continue;
            }
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
    let mut reference = passes::load_like(&pair.reference, &shot.passes)?;
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

impl PairRun<'_> {
    /// Runs the methods. What fails, of the pair or of a method, is said in the rows.
    pub fn run(&self, carried: &mut Carried<'_>) -> Done {
        let view_layer = self.options.view_layer.as_deref();
        let mut loaded = match load_listed(self.pair, view_layer) {
            Ok(loaded) => loaded,
            Err(error) => {
                let open = self.methods.iter().zip(self.finished).filter(|(_, finished)| !**finished);
                let fail = |method| Row { reason: error.to_string(), ..self.row(method) };
                return Done { rows: open.map(|(method, _)| fail(method)).collect(), scene: None };
            }
        };
        // If half buffers are unusable, only the methods that read them fail.
        let halves = if self.methods.iter().any(|method| method.denoiser.reads_halves()) {
            attempt(&self.pair.noisy, || loaded.shot.read_halves()).map_err(|error| error.to_string())
        } else {
            Ok(())
        };
        let reach = self.methods.iter().map(|method| method.denoiser.reach()).max().unwrap_or(0);
        loaded.read_neighbours(reach, view_layer, (self.pair, carried.followed.pairs()));
        let mut before = carried.followed.before(self.pair);
        let mut rows: Vec<Option<Row>> = Vec::new();
        let mut images = Vec::new();
        for (method, &finished) in self.methods.iter().zip(self.finished) {
            if finished && !self.shown {
                rows.push(None);
                continue;
            }
            let mut row = self.row(method);
            (row.width, row.height) = (Some(loaded.noisy().width), Some(loaded.noisy().height));
            let image = match &halves {
                Err(why) if method.denoiser.reads_halves() => {
                    row.reason.clone_from(why);
                    None
                }
                _ => first_run(method, self.pair, &loaded, &mut row),
            };
            if !finished {
                self.complete(&mut row, method, &loaded, image.as_ref(), before.as_mut(), carried);
            }
            if let Some(image) = &image {
                carried.followed.keep(self.pair, &loaded.reference, &method.name, image);
                if self.shown {
                    images.push(Shown::new(&method.name, image, &loaded.reference));
                }
            }
            rows.push((!finished).then_some(row));
        }
        self.time(&loaded, &mut rows);
        Done {
            rows: rows.into_iter().flatten().collect(),
            scene: self.shown.then_some(Scene { reference: loaded.reference, images }),
        }
    }

    /// A row of a method without scores.
    fn row(&self, method: &Contender) -> Row {
        Row { threads: self.options.threads, ..Row::new(self.pair, &method.name) }
    }

    /// Fills in what a row says beside its scores: notes, memory, flicker.
    fn complete(
        &self,
        row: &mut Row,
        method: &Contender,
        loaded: &Loaded,
        image: Option<&Planes>,
        before: Option<&mut Before<'_>>,
        carried: &mut Carried<'_>,
    ) {
        method.denoiser.notes(&loaded.shot).iter().for_each(|note| row.say(note));
        let noisy = loaded.noisy();
        if method.name == NOISY {
            let warning = pairing::warning(self.pair.id(), noisy, &loaded.reference);
            warning.iter().for_each(|warning| row.say(warning));
        } else if row.is_valid() && row.peak_mib.is_none() {
            let measure = || (method.peak_mib)(&self.pair.noisy);
            let frames = (method.name.clone(), noisy.width, noisy.height);
            row.peak_mib = *carried.peaks.entry(frames).or_insert_with(measure);
        }
        if let (Some(image), Some(before)) = (image, before) {
            match before.flicker(method, image, loaded) {
                Ok(Some(flicker)) => row.flicker = Some(flicker),
                Ok(None) => row.say(&format!("{NO_FLICKER}: no pixel can be followed from the frame before")),
                Err(why) => row.say(&why),
            }
        }
    }

    /// Times the methods whose rows are given and valid, in turns. A row whose method fails in this loses its
    /// scores.
    fn time(&self, loaded: &Loaded, rows: &mut [Option<Row>]) {
        let mut times: Vec<Vec<f64>> = vec![Vec::new(); rows.len()];
        for _ in 0..self.options.repeats {
            for ((method, row), times) in self.methods.iter().zip(&mut *rows).zip(&mut times) {
                let Some(row) = row.as_mut().filter(|row| row.is_valid() && method.name != NOISY) else {
                    continue;
                };
                match attempt(&self.pair.noisy, || timed_run(&*method.denoiser, &loaded.shot)) {
                    Ok(run) => times.push(run.seconds),
                    Err(error) => {
                        let (width, height) = (row.width, row.height);
                        *row = Row { reason: error.to_string(), width, height, ..self.row(method) };
                        times.clear();
                    }
                }
            }
        }
        for (row, times) in rows.iter_mut().zip(&times) {
            if let Some(row) = row {
                row.repeats = times.len();
                row.set_time(times, loaded.noisy().pixels());
            }
        }
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
