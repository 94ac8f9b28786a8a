//! The error type of the crate: one line that names the file, the pass or the tensor, and the remedy.

use std::{
    any::Any,
    fmt, io,
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
};

use crate::passes::{Pass, Renderer};

/// Result with this crate's [`Error`].
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// What went wrong, where, and what to do about it.
#[derive(Debug)]
pub enum Error {
    /// The operating system refused to read, write, create or rename `path`.
    Io {
        /// The file or directory.
        path: PathBuf,
        /// What was tried: "read", "write", "create", "rename".
        action: &'static str,
        /// What the operating system said.
        source: io::Error,
    },
    /// `path` is readable but holds something unusable; `reason` ends with the remedy.
    Invalid {
        /// The file.
        path: PathBuf,
        /// What is wrong with it and what to do.
        reason: String,
    },
    /// The view layer lacks passes that the method needs.
    MissingPass {
        /// The EXR file.
        path: PathBuf,
        /// The view layer searched.
        view_layer: String,
        /// The renderer that wrote the file; the message says how to make it write the passes.
        renderer: &'static Renderer,
        /// The passes that are missing.
        passes: Vec<Pass>,
        /// The method that needs them.
        needed_by: String,
    },
    /// The command line or a parameter is wrong.
    Usage(String),
    /// The user asked to stop (Ctrl-C).
    Interrupted,
    /// The program itself is at fault; the text is what its check said.
    Internal(String),
}

impl Error {
    /// [`Error::Invalid`] from anything printable.
    pub fn invalid(path: impl Into<PathBuf>, reason: impl fmt::Display) -> Self {
        Self::Invalid { path: path.into(), reason: reason.to_string() }
    }

    /// For `map_err` on an I/O call: `.map_err(Error::io("write", path))`.
    pub fn io(action: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { path, action, source }
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Io { path, action, source } => {
                write!(f, "{}: cannot {action}: {source}", path.display())
            }
            Self::Invalid { path, reason } => write!(f, "{}: {reason}", path.display()),
            Self::MissingPass { path, view_layer, renderer, passes, needed_by } => {
                let names: Vec<String> = passes.iter().map(Pass::to_string).collect();
                let noun = if passes.len() == 1 { "pass" } else { "passes" };
                let layer = match view_layer.as_str() {
                    "" => "the file, which has no view layers,".into(),
                    name => format!("view layer '{name}'"),
                };
                write!(
                    f,
                    "{}: {layer} has no {} {noun}, which {needed_by} needs; {}",
                    path.display(),
                    names.join(", "),
                    remedy(view_layer, renderer, passes)
                )
            }
            Self::Usage(message) => f.write_str(message),
            Self::Interrupted => f.write_str("interrupted"),
            Self::Internal(what) => {
                write!(f, "an internal error stopped the program ({what}); please report it with the command")
            }
        }
    }
}

/// The remedy for `passes` that a view layer of a file lacks, where `renderer` wrote the file.
pub fn remedy(view_layer: &str, renderer: &Renderer, passes: &[Pass]) -> String {
    let mut settings: Vec<String> = passes.iter().map(|pass| renderer.setting(*pass)).collect();
    settings.dedup();
    let settings = settings.join("; ");
    if !view_layer.is_empty() {
        return settings;
    }
    // A file without view layers does not tell which program wrote it.
    let multilayer = if renderer.is_blender() { "; save as OpenEXR MultiLayer" } else { "" };
    let guides = [Pass::DenoisingAlbedo, Pass::DenoisingNormal];
    let elsewhere = match passes.iter().all(|pass| guides.contains(pass)) {
        true => "; or say where they are: --map albedo=NAME, --albedo FILE, --normal FILE",
        false => "; or say what they are called: --map PASS=NAME",
    };
    format!("{settings}{multilayer}{elsewhere}")
}

impl std::error::Error for Error {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Io { source, .. } => Some(source),
            _ => None,
        }
    }
}

/// Runs `step` on the frame in a file and turns a panic into an error of that file: a defect that one frame
/// reveals must not cost the results of all others.
///
/// # Errors
/// Those of `step`, or `step` panicked.
pub fn attempt<T>(input: &Path, step: impl FnOnce() -> Result<T>) -> Result<T> {
    catch_unwind(AssertUnwindSafe(step)).unwrap_or_else(|panic| {
        let what = panic_message(&*panic);
        Err(Error::invalid(
            input,
            format!("an internal error stopped this frame ({what}); please report it with the file"),
        ))
    })
}

/// What a panic said, in one line.
pub(crate) fn panic_message(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("without a message");
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}
