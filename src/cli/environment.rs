//! Checks environment variables before anything is done, so that a typing error is reported and does not pass
//! for a variable that is not set.

use clap::builder::TypedValueParser;

use crate::{
    Error, Result,
    kernels::{
        narrow::Engine,
        simd::{Tier, unknown_choice},
    },
};

/// The most threads that may be asked for; more than this cannot be started, and nobody means it.
pub const MOST_THREADS: u16 = 4096;

/// Threads for each core, at most: with hundreds, they wait for one another more than they compute.
const MOST_FOR_A_CORE: usize = 8;

/// Takes the value of `--threads`.
pub fn threads() -> impl TypedValueParser<Value = u16> {
    clap::value_parser!(u16).range(1..=MOST_THREADS.into()).map(useful_threads)
}

/// As many threads as are asked for, but no more than there is use for.
pub fn useful_threads(threads: u16) -> u16 {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    threads.min(u16::try_from(MOST_FOR_A_CORE * cores).unwrap_or(MOST_THREADS))
}

/// Computes with as many threads as asked for, or with all. Comes before anything runs in parallel.
///
/// # Errors
/// The system does not start them.
pub fn use_threads(threads: Option<u16>) -> Result<()> {
    let Some(threads) = threads else { return Ok(()) };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.into());
    pool.build_global().map_err(|e| Error::Usage(format!("--threads {threads}: {e}")))
}

/// Refuses settings that mean nothing.
///
/// # Errors
/// Names the variable, what it says and what it may say.
pub fn check() -> Result<()> {
    for variable in ["RAYON_NUM_THREADS", "RAYON_RS_NUM_CPUS"] {
        let Some(value) = std::env::var_os(variable) else { continue };
        let threads = value.to_str().and_then(|text| text.parse::<usize>().ok());
        if threads.is_none_or(|threads| threads > MOST_THREADS.into()) {
            return Err(refused(
                variable,
                &value.to_string_lossy(),
                &format!("a number of threads up to {MOST_THREADS}, or 0 for all cores"),
            ));
        }
    }
    choice("DEMC_TIER", &Tier::available())?;
    choice("DEMC_ENGINE", &Engine::available())
}

/// Checks that a variable is empty or names one of the choices.
fn choice<T: std::fmt::Debug>(variable: &str, choices: &[T]) -> Result<()> {
    let value = std::env::var_os(variable).unwrap_or_default();
    let value = value.to_string_lossy();
    match unknown_choice(&value, choices) {
        Some(names) => Err(refused(variable, &value, &format!("one of {names} on this processor"))),
        None => Ok(()),
    }
}

fn refused(variable: &str, value: &str, wanted: &str) -> Error {
    Error::Usage(format!("{variable}={value}: the environment must say {wanted}; unset it, or mend it"))
}
