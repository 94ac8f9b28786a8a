//! What the user named (files, directories, quoted globs) as a list of EXR files.

use std::{
    collections::HashSet,
    fs,
    path::{Path, PathBuf},
};

use crate::{Error, Result, testset::is_hidden};

/// What the user's inputs name.
#[derive(Default)]
pub struct Inputs {
    /// Files in the order given, each once; those of a directory or glob sorted by name.
    pub files: Vec<PathBuf>,
    /// Inputs, or paths that a glob came by, that name no file; each with the reason.
    pub unusable: Vec<(PathBuf, Error)>,
}

/// Expands the inputs. A plain path that does not exist is kept: reading it reports it, and the others go on.
///
/// # Errors
/// A glob is malformed, or all inputs together name no file.
pub fn expand(inputs: &[PathBuf]) -> Result<Inputs> {
    let mut all = Inputs::default();
    for input in inputs {
        let before = (all.files.len(), all.unusable.len());
        let nothing = if input.is_dir() {
            directory(input, &mut all);
            "no EXR files in this directory; name the files or a glob such as '*/*.exr' in it"
        } else if !input.exists() && has_wildcard(input) {
            pattern(input, &mut all)?;
            "matches no file; check the path and the pattern"
        } else {
            all.files.push(input.clone());
            continue;
        };
        if before == (all.files.len(), all.unusable.len()) {
            all.unusable.push((input.clone(), Error::Usage(format!("{}: {nothing}", input.display()))));
        }
    }
    if all.files.is_empty() {
        let why: Vec<String> = all.unusable.iter().map(|(_, error)| error.to_string()).collect();
        return Err(Error::Usage(why.join("\n")));
    }
    // By name too: frames that are held are links to another.
    let mut seen = HashSet::new();
    let identity = |f: &PathBuf| {
        (fs::canonicalize(f).unwrap_or_else(|_| f.clone()), f.file_name().map(ToOwned::to_owned))
    };
    all.files.retain(|f| seen.insert(identity(f)));
    Ok(all)
}

/// Whether a path that was found is to be read: no folder or pipe, but a link whose target is missing, which reading reports.
fn is_input(path: &Path) -> bool {
    !is_hidden(path) && (path.is_file() || (path.is_symlink() && !path.exists()))
}

fn directory(path: &Path, all: &mut Inputs) {
    let entries = match fs::read_dir(path) {
        Ok(entries) => entries,
        Err(error) => return all.unusable.push((path.into(), Error::io("read", path)(error))),
    };
    let first = all.files.len();
    for entry in entries {
        match entry {
            Ok(entry) => {
                let file = entry.path();
                if is_exr(&file) && is_input(&file) {
                    all.files.push(file);
                }
            }
            Err(error) => all.unusable.push((path.into(), Error::io("read", path)(error))),
        }
    }
    all.files[first..].sort();
}

fn pattern(path: &Path, all: &mut Inputs) -> Result<()> {
    let text = path.to_string_lossy();
    let matches = glob::glob(&text)
        .map_err(|e| Error::Usage(format!("{text}: not a valid glob ({}); quote or escape it", e.msg)))?;
    for found in matches {
        match found {
            Ok(file) if is_input(&file) => all.files.push(file),
            Ok(_) => {}
            Err(error) => {
                let path = error.path().to_path_buf();
                all.unusable.push((path.clone(), Error::io("read", path)(error.into())));
            }
        }
    }
    Ok(())
}

fn has_wildcard(path: &Path) -> bool {
    path.to_string_lossy().contains(['*', '?', '['])
}

fn is_exr(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("exr"))
}
