//! `demc peak-memory` (not listed): how much memory a method takes for a frame, measured in a process
//! of its own, because memory that was freed and kept would hide it. `demc eval` runs it for each
//! method and size of frame; by hand it answers "will my 8K frame fit?".

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use clap::Args as ClapArgs;

use super::environment;
use super::lines::{ExitCode, print_line};
use crate::{Error, Result, models, shot};

/// Name of the subcommand.
pub const COMMAND: &str = "peak-memory";
/// The line that tells what denoising added.
const DENOISING: &str = "denoising_mib";

/// Arguments of `demc peak-memory`.
#[derive(Debug, ClapArgs)]
pub struct Args {
    /// The frame
    #[arg(value_name = "FILE")]
    input: PathBuf,
    /// Built-in model or weights file
    #[arg(long, value_name = "NAME|FILE", default_value = "demc-m")]
    model: String,
    /// View layer to denoise
    #[arg(long, value_name = "NAME")]
    view_layer: Option<String>,
    /// Threads to use [default: all cores]
    #[arg(long, value_name = "N", value_parser = environment::threads())]
    threads: Option<u16>,
}

/// Denoises once and prints the memory that this added, and what the process held in all, including the
/// passes that the method reads.
///
/// # Errors
/// The frame cannot be read or denoised, or the system does not tell (only Linux does).
pub fn run(args: &Args) -> Result<ExitCode> {
    environment::use_threads(args.threads)?;
    let model = models::open(&args.model)?;
    let mut shot = shot::prepare(&args.input, args.view_layer.as_deref())?;
    if model.reads_halves() {
        shot.read_halves()?;
    }
    let before = status_mib("VmHWM:");
    let (image, grown) = peak_mib(|| model.denoise(&shot));
    image?;
    let (Some(grown), Some(before), Some(after)) = (grown, before, status_mib("VmHWM:")) else {
        return Err(Error::Usage(format!("{COMMAND}: this system does not tell; run it on Linux")));
    };
    print_line(&format!("{DENOISING} {grown:.1}"));
    print_line(&format!("process_mib {:.1}", before.max(after)));
    Ok(ExitCode::SUCCESS)
}

/// What `demc peak-memory` says about a model and a frame; none where it cannot tell.
pub fn in_own_process(model: &str, input: &Path, view_layer: Option<&str>, threads: usize) -> Option<f64> {
    let mut command = Command::new(super::program().ok()?);
    command.arg(COMMAND).args(["--model", model, "--threads", &threads.to_string()]);
    if let Some(view_layer) = view_layer {
        command.args(["--view-layer", view_layer]);
    }
    let output = command.arg("--").arg(input).output().ok().filter(|o| o.status.success())?;
    let text = String::from_utf8(output.stdout).ok()?;
    text.lines().find_map(|line| line.strip_prefix(DENOISING)?.trim().parse().ok())
}

/// Runs `work`; also gives the growth of resident memory at its peak, in MiB.
fn peak_mib<T>(work: impl FnOnce() -> T) -> (T, Option<f64>) {
    // Writing 5 resets the peak to the present size (proc(5), clear_refs).
    let reset = fs::write("/proc/self/clear_refs", "5").is_ok();
    let before = status_mib("VmRSS:");
    let result = work();
    let peak = match (reset, before, status_mib("VmHWM:")) {
        (true, Some(before), Some(peak)) => Some((peak - before).max(0.0)),
        _ => None,
    };
    (result, peak)
}

/// A line of `/proc/self/status` that counts KiB.
fn status_mib(field: &str) -> Option<f64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let rest = status.lines().find_map(|line| line.strip_prefix(field))?;
    Some(rest.split_whitespace().next()?.parse::<f64>().ok()? / 1024.0)
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[test]
    fn peak_sees_memory_that_was_freed_again() {
        let (sum, peak) = peak_mib(|| {
            let block = std::hint::black_box(vec![1u8; 96 << 20]);
            block.iter().map(|&b| u64::from(b)).sum::<u64>()
        });
        assert_eq!(sum, 96 << 20);
        let peak = peak.expect("Linux tells");
        assert!((90.0..400.0).contains(&peak), "{peak} MiB");
    }
}
