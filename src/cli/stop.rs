//! Ctrl-C and termination: the first asks the running command to stop at a safe point, the second
//! ends the process at once.

use std::sync::atomic::{AtomicBool, Ordering};

use crate::{Error, Result};

/// Exit status after Ctrl-C, as shells know it.
pub const INTERRUPTED: u8 = 130;

/// Calls `ask` on the first Ctrl-C, SIGTERM or SIGHUP. Those that the process was told to ignore when it was started,
/// as `nohup` and a shell's background jobs are, stay ignored.
///
/// # Errors
/// The system refuses a handler.
pub fn on_request(ask: impl Fn() + Send + 'static) -> Result<()> {
    let asked = AtomicBool::new(false);
    listen(move || {
        if asked.swap(true, Ordering::SeqCst) {
            std::process::exit(i32::from(INTERRUPTED));
        }
        ask();
    })
    .map_err(|e| Error::Usage(format!("cannot listen for Ctrl-C: {e}")))
}

#[cfg(unix)]
fn listen(hear: impl Fn() + Send + 'static) -> std::io::Result<()> {
    use signal_hook::{
        consts::{SIGHUP, SIGINT, SIGTERM},
        iterator::Signals,
    };
    let ignored = ignored();
    let heard = [SIGINT, SIGTERM, SIGHUP].into_iter().filter(|signal| ignored >> (signal - 1) & 1 == 0);
    let mut signals = Signals::new(heard)?;
    std::thread::Builder::new()
        .name("signals".into())
        .spawn(move || signals.forever().for_each(|_| hear()))?;
    Ok(())
}

/// The signals that this process ignores, a bit for each from number 1 on, where the system tells.
#[cfg(unix)]
fn ignored() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or_default()
}

#[cfg(not(unix))]
fn listen(hear: impl Fn() + Send + 'static) -> std::result::Result<(), ctrlc::Error> {
    ctrlc::set_handler(hear)
}

/// Lets a file that grows beyond the process's limit (`ulimit -f`) fail as one on a full disk does: the signal that
/// comes with it would end the process without a word.
pub fn outlive_file_limits() {
    #[cfg(unix)]
    {
        // Any handler keeps the signal from ending the process. Where none can be set, nothing has changed.
        static REACHED: AtomicBool = AtomicBool::new(false);
        let _ = signal_hook::flag::register(signal_hook::consts::SIGXFSZ, &REACHED);
    }
}
