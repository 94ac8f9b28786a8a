//! Ctrl-C and termination: the first asks the running command to stop at a safe point, the second
//! ends the process at once.

use std::sync::atomic::{AtomicBool, Ordering};

use crate::{Error, Result};

/// Exit status after Ctrl-C, as shells know it.
pub const INTERRUPTED: u8 = 130;

/// Calls `ask` on the first Ctrl-C, SIGTERM or SIGHUP.
///
/// # Errors
/// A handler is installed already, or the system refuses one.
pub fn on_request(ask: impl Fn() + Send + 'static) -> Result<()> {
    let asked = AtomicBool::new(false);
    ctrlc::set_handler(move || {
        if asked.swap(true, Ordering::SeqCst) {
            std::process::exit(i32::from(INTERRUPTED));
        }
        ask();
    })
    .map_err(|e| Error::Usage(format!("cannot listen for Ctrl-C: {e}")))
}
