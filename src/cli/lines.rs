//! What all subcommands print and end with.

use std::io::{self, Write};

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

/// One line on stdout. A reader that has gone away (`demc ... | head`) is no reason to stop.
pub fn print_line(line: &str) {
    let _ = writeln!(io::stdout(), "{line}");
}

/// One line on stderr. That nobody reads it is no reason to stop either.
pub fn warn_line(line: &str) {
    let _ = writeln!(io::stderr(), "{line}");
}
