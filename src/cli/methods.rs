//! What `eval` and `stability` have in common: the methods they are asked for, and the threads they run on.

use std::{
    collections::HashSet,
    path::{Path, PathBuf},
};

use super::peak_memory;
use crate::{
    Error, Result,
    models::{self, Denoiser, oidn::Oidn},
    report::{self, Method, NOISY},
    testset::{TestSet, Unmatched},
};

/// The methods of these names, the noisy input first, each under a name of its own.
///
/// # Errors
/// A name is no method's.
pub fn open(
    models: &[String],
    oidn: Option<&Path>,
    view_layer: Option<&str>,
    threads: usize,
) -> Result<Vec<Method>> {
    // Built-in methods change with the program.
    let program = std::env::current_exe().map_or("unknown".into(), |path| report::file_stamp(&path));
    let asked = models.iter().map(|m| m.trim()).filter(|m| !m.is_empty() && *m != NOISY);
    let mut seen = HashSet::new();
    let asked: Vec<&str> = std::iter::once(NOISY).chain(asked).filter(|m| seen.insert(*m)).collect();
    let mut methods = Vec::new();
    for name in &asked {
        let denoiser: Box<dyn Denoiser> = match Oidn::new(name, oidn.map(PathBuf::from)) {
            Some(oidn) => Box::new(oidn),
            None => models::open(name)?,
        };
        let stamp = if is_file(name) { report::file_stamp(Path::new(name)) } else { program.clone() };
        let (spec, view_layer) = (name.to_string(), view_layer.map(String::from));
        let peak_mib =
            move |noisy: &Path| peak_memory::in_own_process(&spec, noisy, view_layer.as_deref(), threads);
        methods.push(Method {
            name: short_name(name, &asked),
            denoiser,
            peak_mib: Box::new(peak_mib),
            stamp,
        });
    }
    Ok(methods)
}

/// A weights file goes by its stem, and by its folder too where the stem alone is another's.
pub fn short_name(name: &str, all: &[&str]) -> String {
    if !is_file(name) {
        return name.into();
    }
    let stem = |name: &str| Path::new(name).file_stem().map(|s| s.to_string_lossy().into_owned());
    let own = stem(name).unwrap_or_else(|| name.into());
    let is_unique = all.iter().filter(|other| stem(other).as_ref() == Some(&own)).count() == 1;
    if is_unique && own != "best" {
        return own;
    }
    match Path::new(name).parent().and_then(Path::file_name) {
        Some(folder) => format!("{}/{own}", folder.to_string_lossy()),
        None => own,
    }
}

fn is_file(name: &str) -> bool {
    Path::new(name).is_file()
}

/// Says which files of a test set have no counterpart. Returns how many frames so go unscored.
pub fn tell_unmatched(set: &TestSet) -> usize {
    for unmatched in &set.unmatched {
        match unmatched {
            Unmatched::Noisy { .. } => eprintln!("demc: {unmatched}"),
            Unmatched::Reference(_) => eprintln!("warning: {unmatched}"),
        }
    }
    set.unmatched.iter().filter(|unmatched| matches!(unmatched, Unmatched::Noisy { .. })).count()
}

/// How many threads: as asked, or one for each core.
pub fn count(asked: Option<u16>) -> usize {
    asked.map(usize::from).unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from))
}

/// That many threads.
///
/// # Errors
/// The system refuses.
pub fn threads(count: usize) -> Result<rayon::ThreadPool> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(count)
        .build()
        .map_err(|e| Error::Usage(format!("cannot start {count} threads: {e}; use fewer")))
}
