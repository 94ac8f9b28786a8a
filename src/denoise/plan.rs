//! Where the result of each input is written: under the input's own name, in the same folders below `--out`
//! as the input is below the folder that was named.
//!
//! In: inputs. Out: jobs of which no two write the same file, and none overwrites its own input.

use std::{
    cell::OnceCell,
    collections::HashMap,
    fs,
    path::{Path, PathBuf},
};

use super::Job;
use crate::{Error, Result, frame::ignores_case};

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
    /// Results and their inputs, by the result's path in small letters.
    placed: HashMap<String, Vec<(PathBuf, PathBuf)>>,
    /// Whether names that differ in small and capital letters are one file's, once that was asked.
    ignores_case: OnceCell<bool>,
    /// The inputs that exist, by their places.
    sources: HashMap<Place, PathBuf>,
}

impl Plan {
    /// A plan without results, for the folder `out` and these inputs.
    pub fn new(out: &Path, inputs: &[Input]) -> Self {
        let sources =
            inputs.iter().filter_map(|input| Some((place(&input.file)?, input.file.clone()))).collect();
        Self { out: out.into(), placed: HashMap::new(), ignores_case: OnceCell::new(), sources }
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
        let alike = self.placed.entry(output.to_string_lossy().to_lowercase()).or_default();
        let is_same =
            |path: &Path| path == output || *self.ignores_case.get_or_init(|| ignores_case(&self.out));
        let other = alike.iter().find(|(path, _)| is_same(path)).map(|(_, input)| input.clone());
        alike.push((output.clone(), input.clone()));
        if let Some(other) = other {
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

/// Whether two paths lead to one file that exists.
pub(super) fn are_same(one: &Path, other: &Path) -> bool {
    place(one).is_some_and(|one| place(other) == Some(one))
}

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_differ_in_case_are_one_file_only_where_the_folder_takes_them_for_one() {
        let out = tempfile::tempdir().unwrap();
        let inputs = ["x/a.exr", "y/A.exr"].map(|file| Input { file: file.into(), below: PathBuf::new() });
        for (ignores_case, is_refused) in [(false, false), (true, true)] {
            let mut plan = Plan::new(out.path(), &inputs);
            plan.ignores_case = OnceCell::from(ignores_case);
            let [first, second] = inputs.clone().map(|input| plan.place(input));
            assert!(first.is_ok());
            assert_eq!(
                second.is_err_and(|error| error.to_string().contains("would both be written")),
                is_refused
            );
        }
        assert_eq!(ignores_case(&out.path().join("not/there/yet")), cfg!(any(windows, target_os = "macos")));
    }
}
