//! Where the result of each input is written: under the input's own name, in the same folders below `--out`
//! as the input is below the folder that was named.
//!
//! In: inputs. Out: jobs of which no two write the same file, and none overwrites its own input.

use std::{
    collections::HashMap,
    fs,
    path::{Path, PathBuf},
};

use super::Job;
use crate::{Error, Result};

/// A file to denoise.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Input {
    /// The file.
    pub file: PathBuf,
    /// The path from the folder that was named to the file's folder; empty where they are the same.
    pub below: PathBuf,
}

/// The jobs that write each file's result into a folder, under the file's own name.
///
/// # Errors
/// Two results would have the same path, or a result would have that of its input.
pub fn plan(files: Vec<PathBuf>, out: &Path) -> Result<Vec<Job>> {
    plan_tree(files.into_iter().map(|file| Input { file, below: PathBuf::new() }), out)
}

/// As [`plan`], but with the folders below the one that was named.
///
/// # Errors
/// As [`plan`]; or a result would have the path of another input.
pub fn plan_tree(inputs: impl IntoIterator<Item = Input>, out: &Path) -> Result<Vec<Job>> {
    let inputs: Vec<Input> = inputs.into_iter().collect();
    let mut plan = Plan::new(out, &inputs);
    inputs.into_iter().map(|input| plan.place(input)).collect()
}

/// The results that have been given a path so far.
pub struct Plan {
    out: PathBuf,
    /// The input of each result.
    placed: HashMap<PathBuf, PathBuf>,
    /// The inputs that exist, by their places.
    sources: HashMap<Place, PathBuf>,
}

impl Plan {
    /// A plan without results, for the folder `out` and these inputs.
    pub fn new(out: &Path, inputs: &[Input]) -> Self {
        let sources =
            inputs.iter().filter_map(|input| Some((place(&input.file)?, input.file.clone()))).collect();
        Self { out: out.into(), placed: HashMap::new(), sources }
    }

    /// The job that writes a file's result.
    ///
    /// # Errors
    /// The result of another file, or an input, has the same path.
    pub fn place(&mut self, Input { file: input, below }: Input) -> Result<Job> {
        let Some(name) = input.file_name() else {
            return Err(Error::Usage(format!("{}: names no file", input.display())));
        };
        let output = self.out.join(below).join(name);
        if let Some(other) = self.placed.insert(output.clone(), input.clone()) {
            return Err(Error::Usage(format!(
                "{} and {} would both be written to {}; give each its own --out, or name the folder that holds both and \
                 add --recursive",
                other.display(),
                input.display(),
                output.display()
            )));
        }
        let existing = place(&output);
        let overwritten = existing.as_ref().and_then(|place| self.sources.get(place));
        if existing.is_some() && existing == place(&input) {
            return Err(Error::Usage(format!(
                "{}: the result would overwrite its input; choose another --out",
                input.display()
            )));
        }
        if let Some(other) = overwritten {
            return Err(Error::Usage(format!(
                "{}: the result would overwrite the input {}; choose another --out",
                input.display(),
                other.display()
            )));
        }
        Ok(Job { input, output })
    }
}

/// What tells files apart. Folders may be mounted twice, so on Unix that is a file's place on the disk.
#[cfg(unix)]
type Place = (u64, u64);
#[cfg(not(unix))]
type Place = PathBuf;

/// The place of a file, if it exists.
#[cfg(unix)]
fn place(path: &Path) -> Option<Place> {
    use std::os::unix::fs::MetadataExt;
    fs::metadata(path).ok().map(|file| (file.dev(), file.ino()))
}

#[cfg(not(unix))]
fn place(path: &Path) -> Option<Place> {
    fs::canonicalize(path).ok()
}
