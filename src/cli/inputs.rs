//! What the user named (files, directories, quoted globs) as a list of EXR files.

use std::{
    collections::HashSet,
    fs,
    path::{Path, PathBuf},
};

use crate::{Error, Result};

/// Expands the inputs in the order given, each file once; directories and globs sorted by name.
/// A plain path that does not exist is kept: reading it reports it, and the others go on.
///
/// # Errors
/// A glob matches nothing or is malformed, or a directory holds no EXR.
pub fn expand(inputs: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for input in inputs {
        if input.is_dir() {
            files.extend(directory(input)?);
        } else if !input.exists() && has_wildcard(input) {
            files.extend(pattern(input)?);
        } else {
            files.push(input.clone());
        }
    }
    let mut seen = HashSet::new();
    files.retain(|f| seen.insert(fs::canonicalize(f).unwrap_or_else(|_| f.clone())));
    Ok(files)
}

fn directory(path: &Path) -> Result<Vec<PathBuf>> {
    let entries = fs::read_dir(path).map_err(Error::io("read", path))?;
    let mut files = Vec::new();
    for entry in entries {
        let file = entry.map_err(Error::io("read", path))?.path();
        // Hidden files are other programs' unfinished work.
        let hidden = file.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
        if !hidden && is_exr(&file) && file.is_file() {
            files.push(file);
        }
    }
    files.sort();
    if files.is_empty() {
        return Err(Error::Usage(format!(
            "{}: no EXR files in this directory; name the files or a glob such as '{}/*/*.exr'",
            path.display(),
            path.display()
        )));
    }
    Ok(files)
}

fn pattern(path: &Path) -> Result<Vec<PathBuf>> {
    let text = path.to_string_lossy();
    let matches = glob::glob(&text)
        .map_err(|e| Error::Usage(format!("{text}: not a valid glob ({}); quote or escape it", e.msg)))?;
    let files: Vec<PathBuf> = matches.filter_map(std::result::Result::ok).filter(|p| p.is_file()).collect();
    if files.is_empty() {
        return Err(Error::Usage(format!("{text}: matches no file; check the path and the pattern")));
    }
    Ok(files)
}

fn has_wildcard(path: &Path) -> bool {
    path.to_string_lossy().contains(['*', '?', '['])
}

fn is_exr(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("exr"))
}
