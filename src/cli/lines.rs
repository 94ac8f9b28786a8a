//! What all subcommands print and end with.

use std::{
    io::{self, ErrorKind, Write},
    sync::atomic::{AtomicBool, Ordering},
};

/// Exit status when some input failed, each named on stderr.
pub const SOME_FAILED: u8 = 1;
/// Exit status of a wrong command line.
pub const USAGE: u8 = 2;

/// The exit status as a number. Unlike the standard library's type, it can be handed to another language.
#[derive(Clone, Copy)]
pub struct ExitCode(pub u8);

impl ExitCode {
    /// All is done.
    pub const SUCCESS: Self = Self(0);
}

impl From<u8> for ExitCode {
    fn from(status: u8) -> Self {
        Self(status)
    }
}

/// Whether a line could not be written to stdout, as on a full disk.
static LOST: AtomicBool = AtomicBool::new(false);

/// One line on stdout. A reader that has gone away (`demc ... | head`) is no reason to stop, nor is a full disk,
/// which shows in the exit status: see [`end`].
pub fn print_line(line: &str) {
    note_loss(writeln!(io::stdout(), "{line}"));
}

fn note_loss(written: io::Result<()>) {
    match written {
        Err(error) if error.kind() != ErrorKind::BrokenPipe && !LOST.swap(true, Ordering::Relaxed) => {
            warn_line(&format!("demc: cannot write to standard output: {error}"));
        }
        _ => {}
    }
}

/// The exit status, given that of the work: lines that were lost are a failure too.
pub fn end(status: ExitCode) -> ExitCode {
    note_loss(io::stdout().flush());
    if status.0 == 0 && LOST.load(Ordering::Relaxed) { SOME_FAILED.into() } else { status }
}

/// One line on stderr. That nobody reads it is no reason to stop either.
pub fn warn_line(line: &str) {
    let _ = writeln!(io::stderr(), "{line}");
}
