//! What `eval` and `stability` have in common: the methods they are asked for, and the threads they run on.

use std::{
    collections::HashSet,
    path::{Path, PathBuf},
};

use clap::Args as ClapArgs;

use super::environment;
use super::lines::{ExitCode, SOME_FAILED, warn_line};
use super::peak_memory;
use crate::{
    Error, Result,
    denoise::{TEMPORAL, Temporal},
    models::{self, Denoiser, oidn::Oidn},
    report::{self, Contender, NOISY},
    testset::{self, Pair, Unmatched},
};

/// Arguments that both have.
#[derive(Debug, ClapArgs)]
pub struct Args {
    /// Directory of <scene>_<spp>spp.exr and <scene>_ref.exr, CSV manifest, or quoted glob
    #[arg(long, value_name = "DIR|MANIFEST|GLOB")]
    pub test_set: String,
    /// Methods: built-in names, oidn-fast, oidn-balanced, oidn-high, oidn-high-prefilter, weights files
    #[arg(long, value_name = "A,B,...", value_delimiter = ',', default_value = "demc-m")]
    pub models: Vec<String>,
    /// Threads for every method [default: all cores]
    #[arg(long, value_name = "N", value_parser = environment::threads())]
    threads: Option<u16>,
    /// View layer to read [default: the one with the most passes]
    #[arg(long, value_name = "NAME")]
    pub view_layer: Option<String>,
    /// The program oidnDenoise [default: $OIDN_DENOISE, else the one on PATH]
    #[arg(long, value_name = "PATH")]
    oidn: Option<PathBuf>,
}

impl Args {
    /// How many threads: as asked, or one for each core.
    pub fn threads(&self) -> usize {
        self.threads
            .map(usize::from)
            .unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from))
    }

    /// What was asked for, each once, and the noisy input first.
    fn asked(&self) -> Vec<&str> {
        let asked = self.models.iter().map(|m| m.trim()).filter(|m| !m.is_empty() && *m != NOISY);
        let mut seen = HashSet::new();
        std::iter::once(NOISY).chain(asked).filter(|m| seen.insert(*m)).collect()
    }

    /// The methods asked for, the noisy input first, each under a name of its own.
    ///
    /// # Errors
    /// A name is no method's.
    pub fn methods(&self) -> Result<Vec<Contender>> {
        let threads = self.threads();
        // Built-in methods change with the program.
        let program = super::program().map_or("unknown".into(), |path| report::file_stamp(&path));
        let asked = self.asked();
        if self.models.iter().all(|model| model.trim().is_empty()) {
            return Err(Error::Usage("--models names no method; `demc models` lists those there are".into()));
        }
        let mut methods = Vec::new();
        for name in &asked {
            let (denoiser, file): (Box<dyn Denoiser>, Option<PathBuf>) =
                match Oidn::new(name, self.oidn.clone()) {
                    Some(oidn) => {
                        let file = oidn.program();
                        (Box::new(oidn), Some(file))
                    }
                    None => (models::open(name)?, weights_of(name)),
                };
            let stamp = match file {
                Some(file) => format!("{program} {}", report::file_stamp(&file)),
                None => program.clone(),
            };
            let (spec, view_layer) = (name.to_string(), self.view_layer.clone());
            let peak_mib =
                move |noisy: &Path| peak_memory::in_own_process(&spec, noisy, view_layer.as_deref(), threads);
            methods.push(Contender {
                name: short_name(name, &asked),
                denoiser,
                peak_mib: Box::new(peak_mib),
                stamp,
            });
        }
        Ok(methods)
    }

    /// The name in tables of the method that others are held against.
    ///
    /// # Errors
    /// It is none of `methods`, those asked for.
    pub fn baseline(&self, wanted: &str, methods: &[Contender]) -> Result<String> {
        let wanted = short_name(wanted, &self.asked());
        if methods.iter().any(|method| method.name == wanted) {
            return Ok(wanted);
        }
        let names: Vec<&str> = methods.iter().map(|method| method.name.as_str()).collect();
        Err(Error::Usage(format!(
            "--baseline {wanted} is not among the methods: {}; add it to --models",
            names.join(", ")
        )))
    }

    /// Those of the methods asked for that are this project's own, each with `reach` frames before a frame
    /// and after it.
    ///
    /// # Errors
    /// As [`Args::methods`].
    pub fn temporal(&self, methods: &[Contender], reach: usize) -> Result<Vec<Contender>> {
        let asked = self.asked();
        let mut added = Vec::new();
        for name in &asked {
            let short = short_name(name, &asked);
            let Some(method) = methods.iter().find(|method| method.name == short && report::is_own(&short))
            else {
                continue;
            };
            added.push(Contender {
                name: short + TEMPORAL,
                denoiser: Box::new(Temporal::new(models::open(name)?, reach)),
                // It would be measured with all neighbours of a frame in memory, which a stream does not
                // take.
                peak_mib: Box::new(|_| None),
                stamp: format!("{} {reach}", method.stamp),
            });
        }
        Ok(added)
    }
}

/// How many frames before and after one `--temporal` takes.
///
/// # Errors
/// It is none that it takes.
pub fn parse_reach(text: &str) -> Result<u8> {
    let reach = text.parse().ok().filter(|reach| (1..=8).contains(reach));
    reach.ok_or_else(|| {
        Error::Usage("wants 1 to 8 frames; name inputs before it, or after that number".into())
    })
}

/// The name of a method in tables. A weights file has its stem and what was asked for behind it as its name.
/// Where another file, a method that demc knows, or what is compared with has the same name its folder is added,
/// and where that does
/// not help either the name is all that was asked for.
pub fn short_name(name: &str, all: &[&str]) -> String {
    let Some(file) = weights_file(name) else { return name.into() };
    let stem = |name: &str| {
        let plain = models::without_variant(name);
        let stem = Path::new(plain).file_stem()?.to_string_lossy().into_owned();
        Some(stem + &name[plain.len()..])
    };
    let with_folder = |name: &str| {
        let folder =
            Path::new(models::without_variant(name)).parent()?.file_name()?.to_string_lossy().into_owned();
        Some(format!("{folder}/{}", stem(name)?))
    };
    let tells_nothing = file.file_stem().is_none_or(|stem| {
        stem == "best"
            || stem == "reference"
            || stem.to_str().is_some_and(|stem| models::catalogue::find(stem).is_some())
    });
    let short = (!tells_nothing).then(|| stem(name)).flatten().filter(|own| is_unique(own, name, all, stem));
    let long = || with_folder(name).filter(|own| is_unique(own, name, all, with_folder));
    short.or_else(long).unwrap_or_else(|| name.into())
}

/// Whether no other method has that name.
fn is_unique(own: &str, name: &str, all: &[&str], named: impl Fn(&str) -> Option<String>) -> bool {
    !all.iter().any(|other| *other != name && named(other).as_deref() == Some(own))
}

/// The weights file that a method's name names.
fn weights_file(name: &str) -> Option<&Path> {
    Some(Path::new(models::without_variant(name))).filter(|path| path.is_file())
}

/// The weights file of a method, by its name or by that of the file; none where the program holds them.
fn weights_of(name: &str) -> Option<PathBuf> {
    let known = || {
        models::catalogue::find(models::without_variant(name))
            .and_then(models::catalogue::Method::weights_file)
    };
    weights_file(name).map(Into::into).or_else(known)
}

/// The noisy renders of a test set. References without a noisy render are named on stderr; renders without a
/// reference will have rows that say so.
///
/// # Errors
/// As [`testset::read`].
pub fn noisy_renders(spec: &str) -> Result<Vec<Pair>> {
    let set = testset::read(spec)?;
    for unmatched in set.unmatched.iter().filter(|unmatched| matches!(unmatched, Unmatched::Reference(_))) {
        warn_line(&format!("warning: {unmatched}"));
    }
    Ok(set.all_noisy())
}

/// A pool of that many threads.
///
/// # Errors
/// The system refuses.
pub fn pool(count: usize) -> Result<rayon::ThreadPool> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(count)
        .build()
        .map_err(|e| Error::Usage(format!("cannot start {count} threads: {e}; use fewer")))
}

/// Says how many rows failed, and which table says why; returns the exit status.
pub fn finish(failed: usize, table: &Path) -> ExitCode {
    if failed == 0 {
        return ExitCode::SUCCESS;
    }
    warn_line(&format!("demc: {failed} failed; {} says why", table.display()));
    ExitCode::from(SOME_FAILED)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_weights_file_goes_by_a_name_of_its_own() {
        let dir = tempfile::tempdir().unwrap();
        let file = |name: &str| {
            let path = dir.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(&path, "").unwrap();
            path.display().to_string()
        };
        let names =
            ["a/run/best.safetensors", "b/run/best.safetensors", "run3/best.safetensors", "a/m.safetensors"];
        let [one, two, third, m] = names.map(file);
        let rounded = format!("{m}:f32");
        let all = ["demc-m", &one, &two, &third, &m, &rounded];
        let short = all.map(|name| short_name(name, &all));
        assert_eq!(short, ["demc-m", &one, &two, "run3/best", "m", "m:f32"]);
        assert_eq!(short_name(&one, &["demc-m", &one]), "run/best");
        // No file takes the place of a method that demc knows.
        let kpcn = file("mine/kpcn.safetensors");
        assert_eq!(short_name(&kpcn, &[&kpcn]), "mine/kpcn");
        assert_eq!(short_name(&format!("{m}:unrestrained"), &[&m]), "m:unrestrained");
        assert_eq!(weights_of(&format!("{m}:unrestrained")).as_deref(), Some(Path::new(&m)));
        assert!(weights_of("kpcn").is_some() && weights_of("demc-s").is_none());
    }
}
