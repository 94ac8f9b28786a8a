//! The compiled half of the Python package `demc`: arrays and paths in, arrays and text out.
//!
//! `python/demc/__init__.py` is what users see: it checks arrays and documents every function. All work is
//! done on a thread of its own without Python's lock, and the calling thread looks for Ctrl-C meanwhile.

use std::{
    collections::HashMap,
    ffi::OsString,
    mem,
    panic::{AssertUnwindSafe, catch_unwind},
    path::PathBuf,
    process,
    sync::{
        Arc, LazyLock, Mutex, OnceLock, PoisonError,
        atomic::{AtomicBool, AtomicUsize, Ordering},
        mpsc::{RecvTimeoutError, channel},
    },
    thread::{self, ThreadId},
    time::Duration,
};

use demc::{
    Error as Failure,
    denoise::{self, Alpha, Options},
    models::{self, Denoiser},
    passes::{Mapping, Pass, PassSet},
    planes::Planes,
    shot::Shot,
    sources::Sources,
};
use numpy::{PyArray1, PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods};
use pyo3::{create_exception, exceptions, prelude::*};
use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};

create_exception!(
    demc,
    Error,
    exceptions::PyRuntimeError,
    "A file or a frame cannot be worked on; says why, and what to do."
);

/// How often the calling thread looks for Ctrl-C.
const LOOK: Duration = Duration::from_millis(50);

fn to_python(failure: Failure) -> PyErr {
    match failure {
        Failure::Usage(why) => exceptions::PyValueError::new_err(why),
        Failure::Interrupted => exceptions::PyKeyboardInterrupt::new_err(()),
        other => Error::new_err(other.to_string()),
    }
}

/// The threads of calls that name no number in a process that was forked from another, as Python's
/// `multiprocessing` does on Linux: it has none of rayon's threads, and would wait for them for ever. None in the
/// process that loaded this module.
fn forked_pool() -> Result<Option<Arc<ThreadPool>>, ThreadPoolBuildError> {
    if process::id() == *LOADED_IN {
        return Ok(None);
    }
    static POOL: Mutex<Option<(u32, Arc<ThreadPool>)>> = Mutex::new(None);
    let mut pool = POOL.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some((of, pool)) = &*pool
        && *of == process::id()
    {
        return Ok(Some(Arc::clone(pool)));
    }
    let own = Arc::new(ThreadPoolBuilder::new().build()?);
    // Dropped here, the other process's pool would wait for its threads.
    mem::forget(pool.replace((process::id(), Arc::clone(&own))));
    Ok(Some(own))
}

/// The process that loaded this module.
static LOADED_IN: LazyLock<u32> = LazyLock::new(process::id);

/// Runs `work` on a thread of its own, with so many threads if that is said; Ctrl-C ends the wait, and tells
/// `work`.
fn detached<T: Send + 'static>(
    py: Python<'_>,
    threads: Option<u16>,
    work: impl FnOnce(&AtomicBool) -> demc::Result<T> + Send + 'static,
) -> PyResult<T> {
    let stopped = Arc::new(AtomicBool::new(false));
    let (done, result) = channel();
    let asked = Arc::clone(&stopped);
    let run = move || {
        // Starting many threads takes long too, so that is done here.
        let guarded = AssertUnwindSafe(|| {
            let pool = match threads {
                Some(count) => {
                    let count = demc::cli::useful_threads(count).into();
                    ThreadPoolBuilder::new().num_threads(count).build().map(|pool| Some(Arc::new(pool)))
                }
                None => forked_pool(),
            };
            match pool.map_err(|error| Failure::Usage(format!("threads: {error}")))? {
                Some(pool) => pool.install(|| work(&asked)),
                None => work(&asked),
            }
        });
        let outcome = catch_unwind(guarded)
            .unwrap_or_else(|_| Err(Failure::Internal("its message is on standard error".into())));
        let _ = done.send(outcome);
    };
    let started = thread::Builder::new().spawn(run);
    started.map_err(|error| Error::new_err(format!("no thread can be started: {error}")))?;
    let result = Mutex::new(result);
    let _call = Call::begin();
    loop {
        let received = py.detach(|| {
            let received = result.lock().unwrap_or_else(PoisonError::into_inner).recv_timeout(LOOK);
            // Python's lock is the ending thread's alone. Whoever else asks for it is ended in a way that Rust does not
            // survive.
            while ENDS_IN.get().is_some_and(|ending| *ending != thread::current().id()) {
                thread::park();
            }
            received
        });
        match received {
            Ok(outcome) => return outcome.map_err(to_python),
            Err(RecvTimeoutError::Timeout) => py.check_signals().inspect_err(|_| {
                stopped.store(true, Ordering::SeqCst);
            })?,
            Err(RecvTimeoutError::Disconnected) => {
                return Err(Error::new_err("the thread that denoises has gone; please report it"));
            }
        }
    }
}

/// The thread in which Python ends, once it does, and how many calls are under way.
static ENDS_IN: OnceLock<ThreadId> = OnceLock::new();
static CALLS: AtomicUsize = AtomicUsize::new(0);

/// A call that is under way.
struct Call;

impl Call {
    fn begin() -> Self {
        CALLS.fetch_add(1, Ordering::SeqCst);
        Self
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        CALLS.fetch_sub(1, Ordering::SeqCst);
    }
}

/// Called when Python ends: calls in daemon threads, which nobody waits for, do not come back to it.
#[pyfunction]
fn leave(py: Python<'_>) {
    let _ = ENDS_IN.set(thread::current().id());
    if CALLS.load(Ordering::SeqCst) > 0 {
        // Those that have seen the result, or look for Ctrl-C just now, still need the lock.
        py.detach(|| thread::sleep(3 * LOOK));
    }
}

/// A model by name or file. Built-in ones are kept: unpacking their weights takes longer than a small frame. Files may
/// change, so others are opened anew.
fn open(name: &str) -> demc::Result<Arc<dyn Denoiser>> {
    static OPENED: LazyLock<Mutex<HashMap<String, Arc<dyn Denoiser>>>> = LazyLock::new(Mutex::default);
    if models::catalogue::find(models::without_variant(name)).is_none_or(|method| method.built_in().is_none())
    {
        return Ok(models::open(name)?.into());
    }
    if let Some(model) = OPENED.lock().unwrap_or_else(PoisonError::into_inner).get(name) {
        return Ok(Arc::clone(model));
    }
    let model: Arc<dyn Denoiser> = models::open(name)?.into();
    OPENED.lock().unwrap_or_else(PoisonError::into_inner).insert(name.into(), Arc::clone(&model));
    Ok(model)
}

/// An array (H, W, C) whose values lie in that order, as planes.
fn planes(py: Python<'_>, values: &[f32], (height, width, channels): (usize, usize, usize)) -> Planes {
    py.detach(|| {
        let plane = |c: usize| values.iter().skip(c).step_by(channels).copied();
        Planes::from_vec(channels, width, height, (0..channels).flat_map(plane).collect())
    })
}

/// Planes as an array (H, W, C), flat.
fn interleaved(planes: &Planes) -> Vec<f32> {
    let pixels = planes.pixels();
    (0..pixels).flat_map(|pixel| (0..planes.channels).map(move |c| planes.data[c * pixels + pixel])).collect()
}

/// What an array is called, of the passes that arrays are taken for.
fn argument(pass: Pass) -> Option<&'static str> {
    match pass {
        Pass::Combined => Some("color"),
        Pass::DenoisingAlbedo => Some("albedo"),
        Pass::DenoisingNormal => Some("normal"),
        _ => None,
    }
}

/// Whether the arrays that are there do for the model.
fn check_passes(model: &dyn Denoiser, set: &PassSet) -> demc::Result<()> {
    let needed = model.passes().iter().filter(|pass| !model.dispensable().contains(pass));
    let missing: Vec<Pass> = needed.copied().filter(|pass| set.get(*pass).is_none()).collect();
    let name = model.name();
    if let Some(pass) = missing.iter().find(|pass| argument(**pass).is_none()) {
        return Err(Failure::Usage(format!(
            "{name} needs the pass {pass}, for which there is no array; use denoise_file"
        )));
    }
    let missing: Vec<&str> = missing.into_iter().filter_map(argument).collect();
    if missing.is_empty() {
        return Ok(());
    }
    Err(Failure::Usage(format!(
        "{name} needs {}: pass Cycles' denoising data, or take another model",
        missing.join(" and ")
    )))
}

/// Flat arrays of radiance (H, W, 3) and of alpha (H, W), which is there if it was given.
type Picture<'py> = (Bound<'py, PyArray1<f32>>, Option<Bound<'py, PyArray1<f32>>>);

/// Of float32 arrays (H, W, 3), alpha (H, W), of one size, whose values lie in that order: the caller has checked.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "Python's function, which names each of them")]
fn denoise_arrays<'py>(
    py: Python<'py>,
    color: PyReadonlyArray3<'py, f32>,
    albedo: Option<PyReadonlyArray3<'py, f32>>,
    normal: Option<PyReadonlyArray3<'py, f32>>,
    alpha: Option<PyReadonlyArray2<'py, f32>>,
    model: String,
    samples: Option<u32>,
    threads: Option<u16>,
) -> PyResult<Picture<'py>> {
    let (height, width) = (color.shape()[0], color.shape()[1]);
    let mut set = PassSet::new("arrays", "", width, height);
    set.samples = samples;
    let images =
        [(Pass::Combined, Some(color)), (Pass::DenoisingAlbedo, albedo), (Pass::DenoisingNormal, normal)];
    for (pass, image) in images {
        if let Some(image) = image {
            set.insert(pass, planes(py, image.as_slice()?, (height, width, 3)));
        }
    }
    if let Some(alpha) = alpha {
        set.insert(Pass::Alpha, planes(py, alpha.as_slice()?, (height, width, 1)));
    }
    let (radiance, alpha) = detached(py, threads, move |_| {
        let model = open(&model)?;
        check_passes(&*model, &set)?;
        let (radiance, alpha) = denoise::shot(Shot::new(set), &*model, &Options::default())?;
        Ok((interleaved(&radiance), alpha.map(|alpha| interleaved(&alpha))))
    })?;
    Ok((PyArray1::from_vec(py, radiance), alpha.map(|alpha| PyArray1::from_vec(py, alpha))))
}

/// What is told of a file that was denoised, see `Report` in `__init__.py`.
#[derive(IntoPyObject)]
struct Told {
    view_layer: String,
    width: usize,
    height: usize,
    samples: Option<u32>,
    was_denoised: bool,
    expected_error: Option<f64>,
    seconds: f64,
    repaired: HashMap<String, usize>,
    notes: Vec<String>,
}

/// Denoises a file.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "Python's function, which names each of them")]
fn denoise_path(
    py: Python<'_>,
    source: PathBuf,
    out: PathBuf,
    model: String,
    view_layer: Option<String>,
    guides: (Option<PathBuf>, Option<PathBuf>),
    names: Vec<String>,
    added: (Option<String>, bool, String, bool),
    threads: Option<u16>,
) -> PyResult<Told> {
    let report = detached(py, threads, move |stopped| {
        let mut mapping = Mapping::default();
        for line in names {
            mapping.add(&line).map_err(|why| Failure::Usage(format!("names: {why}")))?;
        }
        let (albedo, normal) = guides;
        let sources = Sources { mapping, albedo, normal };
        let (layer, passes, alpha, confidence) = added;
        let known = Alpha::ALL.into_iter().find(|(name, _)| *name == alpha);
        let (_, alpha) = known.ok_or_else(|| {
            let names = Alpha::ALL.map(|(name, _)| name).join(", ");
            Failure::Usage(format!("alpha is '{alpha}'; give one of {names}"))
        })?;
        let options = Options { view_layer, sources, layer, passes, alpha, confidence, ..Options::default() };
        let model = open(&model)?;
        let denoised = denoise::denoise(denoise::load(&source, &*model, &options)?, &*model, &options)?;
        // Whoever pressed Ctrl-C meanwhile expects no file.
        if stopped.load(Ordering::SeqCst) {
            return Err(Failure::Interrupted);
        }
        denoise::store(denoised, &out, &options)
    })?;
    let denoise::Report { view_layer, width, height, samples, was_denoised, expected_error, .. } = report;
    let (seconds, repaired, notes) = (report.seconds, report.repaired.into_iter().collect(), report.notes);
    Ok(Told { view_layer, width, height, samples, was_denoised, expected_error, seconds, repaired, notes })
}

/// What `demc models --json` prints.
#[pyfunction]
fn models_json(py: Python<'_>) -> PyResult<String> {
    detached(py, None, |_| demc::cli::models_json())
}

/// What `demc inspect --json` prints.
#[pyfunction]
fn inspect_json(py: Python<'_>, path: PathBuf) -> PyResult<String> {
    detached(py, None, move |_| demc::cli::inspect_json(&path))
}

/// Names and values of the metrics of one file against another.
#[pyfunction]
fn compare_files(
    py: Python<'_>,
    image: PathBuf,
    reference: PathBuf,
    layers: [Option<String>; 3],
) -> PyResult<Vec<(&'static str, Option<f64>)>> {
    let scores = detached(py, None, move |_| demc::cli::compare_files(&image, &reference, layers))?;
    Ok(scores.named().into())
}

/// The command, with its arguments, the program's path first; its exit status.
#[pyfunction]
fn command(py: Python<'_>, arguments: Vec<OsString>) -> u8 {
    py.detach(|| demc::cli::main_as(arguments))
}

#[pymodule]
fn _demc(module: &Bound<'_, PyModule>) -> PyResult<()> {
    LazyLock::force(&LOADED_IN);
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_function(wrap_pyfunction!(leave, module)?)?;
    module.add("MOST_THREADS", demc::cli::MOST_THREADS)?;
    module.add("Error", module.py().get_type::<Error>())?;
    module.add_function(wrap_pyfunction!(denoise_arrays, module)?)?;
    module.add_function(wrap_pyfunction!(denoise_path, module)?)?;
    module.add_function(wrap_pyfunction!(inspect_json, module)?)?;
    module.add_function(wrap_pyfunction!(models_json, module)?)?;
    module.add_function(wrap_pyfunction!(compare_files, module)?)?;
    module.add_function(wrap_pyfunction!(command, module)?)
}
