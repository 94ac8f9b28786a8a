//! What the user named (files, directories, quoted globs) as a list of EXR files.

use std::{
    collections::{HashMap, HashSet},
    ffi::OsStr,
    fs,
    path::{Path, PathBuf},
};

use crate::{Error, Result, denoise::Input, frame::Frame, testset::is_hidden};

/// What the user's inputs name.
#[derive(Default)]
pub struct Inputs {
    /// Files in the order given, each once; those of a directory or glob sorted by name.
    pub files: Vec<Input>,
    /// Inputs, or paths that a glob came by, that name no file; each with the reason.
    pub unusable: Vec<(PathBuf, Error)>,
    /// Inputs that hold or match no file yet, each with the reason.
    pub empty: Vec<(PathBuf, Error)>,
}

/// How directories are looked through.
#[derive(Clone, Debug, Default)]
pub struct Search {
    /// Whether the directories in them are searched too, at any depth. Links to directories are not followed,
    /// since the same files would be found twice.
    pub recursive: bool,
    /// The directory where results are written: it is no part of a search, and results that are in it already are
    /// no inputs beside those that they are of.
    pub except: Option<PathBuf>,
}

/// Expands the inputs. A plain path that does not exist is kept: reading it reports it, and the others go on.
///
/// # Errors
/// A glob is malformed, or all inputs together name no file, though each could be looked at.
pub fn expand(inputs: &[PathBuf], search: &Search) -> Result<Inputs> {
    let mut all = find(inputs, search)?;
    let empty = std::mem::take(&mut all.empty);
    all.unusable.extend(empty);
    let is_empty = |(_, error): &(PathBuf, Error)| matches!(error, Error::Usage(_));
    if all.files.is_empty() && all.unusable.iter().all(is_empty) {
        let why: Vec<String> = all.unusable.iter().map(|(_, error)| error.to_string()).collect();
        return Err(Error::Usage(why.join("\n")));
    }
    Ok(all)
}

/// As [`expand`], but inputs may name no file, as long as none has come in.
///
/// # Errors
/// A glob is malformed.
pub fn find(inputs: &[PathBuf], search: &Search) -> Result<Inputs> {
    let mut all = Inputs::default();
    for input in inputs {
        let before = (all.files.len(), all.unusable.len());
        let nothing = if input.is_dir() {
            directory(input, search, &mut all);
            match search.recursive {
                true => "no EXR files in this directory, nor in those below it",
                false => {
                    "no EXR files in this directory; add --recursive to search the directories in it, or name the files or \
                     a glob such as '*/*.exr' in it"
                }
            }
        } else if !input.exists() && has_wildcard(input) {
            pattern(input, &mut all)?;
            "matches no file; check the path and the pattern"
        } else {
            all.files.push(Input { file: input.clone(), below: PathBuf::new() });
            continue;
        };
        if before == (all.files.len(), all.unusable.len()) {
            all.empty.push((input.clone(), Error::Usage(format!("{}: {nothing}", input.display()))));
        }
    }
    // Files are told apart by name too, since held frames are links to another frame.
    let mut seen = HashSet::new();
    let identity = |Input { file, .. }: &Input| {
        (fs::canonicalize(file).unwrap_or_else(|_| file.clone()), file.file_name().map(ToOwned::to_owned))
    };
    all.files.retain(|input| seen.insert(identity(input)));
    if let Some(out) = search.except.as_ref().and_then(|out| fs::canonicalize(out).ok()) {
        leave_out_results(&mut all.files, &out);
    }
    Ok(all)
}

/// Leaves out what demc wrote for another of the inputs: `renders/*/*.exr` names the results in `renders/clean`
/// too, the second time.
fn leave_out_results(files: &mut Vec<Input>, out: &Path) {
    let mut folders: HashMap<PathBuf, Option<PathBuf>> = HashMap::new();
    let mut place = |folder: &Path, name: &OsStr| {
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let found = folders.entry(folder.to_owned()).or_insert_with(|| fs::canonicalize(folder).ok());
        found.as_ref().map(|folder| folder.join(name))
    };
    let mut results: HashSet<PathBuf> = HashSet::new();
    let places: Vec<Option<PathBuf>> = files
        .iter()
        .map(|Input { file, below }| {
            let (folder, name) = (file.parent()?, file.file_name()?);
            let own = place(folder, name)?;
            // Its result may have the place of another input, but not its own.
            if let Some(result) = place(&out.join(below), name).filter(|result| *result != own) {
                results.insert(result);
            }
            Some(own)
        })
        .collect();
    let mut places = places.into_iter();
    files.retain(|input| {
        let is_of_another = places.next().flatten().is_some_and(|place| results.contains(&place));
        !(is_of_another && Frame::read_headers(&input.file).is_ok_and(|file| file.is_result()))
    });
}

/// Whether a path that was found is to be read: a file that is not hidden, or a link whose target is missing,
/// which reading reports. Folders and pipes are not.
fn is_input(path: &Path) -> bool {
    !is_hidden(path) && (path.is_file() || (path.is_symlink() && !path.exists()))
}

fn directory(named: &Path, search: &Search, all: &mut Inputs) {
    let except = search.except.as_ref().and_then(|path| fs::canonicalize(path).ok());
    // Directories that are still to be searched, by their paths below the one named; the next one is last.
    let mut left = vec![PathBuf::new()];
    while let Some(below) = left.pop() {
        let path = if below.as_os_str().is_empty() { named.to_owned() } else { named.join(&below) };
        let (mut files, mut folders) = (Vec::new(), Vec::new());
        let unusable = |error| (path.clone(), Error::io("read", &path)(error));
        match fs::read_dir(&path) {
            Ok(entries) => {
                for entry in entries {
                    match entry {
                        Ok(entry) => {
                            let found = entry.path();
                            if is_exr(&found) && is_input(&found) {
                                files.push(Input { file: found, below: below.clone() });
                            } else if search.recursive
                                && entry.file_type().is_ok_and(|kind| kind.is_dir())
                                && !is_hidden(&found)
                                && (except.is_none() || fs::canonicalize(&found).ok() != except)
                            {
                                folders.push(below.join(entry.file_name()));
                            }
                        }
                        Err(error) => all.unusable.push(unusable(error)),
                    }
                }
            }
            Err(error) => all.unusable.push(unusable(error)),
        }
        files.sort_by(|a, b| a.file.cmp(&b.file));
        all.files.extend(files);
        folders.sort_by(|a, b| b.cmp(a));
        left.extend(folders);
    }
}

fn pattern(path: &Path, all: &mut Inputs) -> Result<()> {
    let Some(text) = path.to_str() else {
        let why = "a pattern that is not UTF-8 finds nothing; rename the files, or name their folder";
        return Err(Error::Usage(format!("{}: {why}", path.display())));
    };
    let matches = glob::glob(text)
        .map_err(|e| Error::Usage(format!("{text}: not a valid glob ({}); quote or escape it", e.msg)))?;
    for found in matches {
        match found {
            Ok(file) if is_input(&file) => all.files.push(Input { file, below: PathBuf::new() }),
            Ok(_) => {}
            Err(error) => {
                let path = error.path().to_path_buf();
                all.unusable.push((path.clone(), Error::io("read", path)(error.into())));
            }
        }
    }
    not_utf8(path, all);
    Ok(())
}

/// Adds the files whose names match the last part of a pattern but for bytes that are not UTF-8, as names from
/// old systems have: `glob` passes them over.
fn not_utf8(path: &Path, all: &mut Inputs) {
    let parts = (path.parent(), path.file_name().and_then(OsStr::to_str));
    let (Some(parent), Some(name)) = parts else { return };
    let Ok(name) = glob::Pattern::new(name) else { return };
    let folders: Vec<PathBuf> = match parent.to_str() {
        Some("") => vec![".".into()],
        Some(text) if has_wildcard(parent) => glob::glob(text).into_iter().flatten().flatten().collect(),
        _ => vec![parent.into()],
    };
    for folder in folders {
        let entries = fs::read_dir(&folder).into_iter().flatten().flatten();
        let names = entries.map(|entry| entry.file_name()).filter(|found| found.to_str().is_none());
        let matching = names.filter(|found| name.matches(&found.to_string_lossy()));
        let mut files: Vec<PathBuf> =
            matching.map(|name| folder.join(name)).filter(|file| is_input(file)).collect();
        files.sort();
        all.files.extend(files.into_iter().map(|file| Input { file, below: PathBuf::new() }));
    }
}

fn has_wildcard(path: &Path) -> bool {
    path.to_string_lossy().contains(['*', '?', '['])
}

/// Whether a path leads to nothing and is no EXR by its name: a folder that is not there, most likely.
pub fn is_missing_folder(path: &Path) -> bool {
    !(is_exr(path) || path.exists())
}

fn is_exr(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("exr"))
}
