//! Files that are whole or not there: written under a temporary name in the target's folder, then renamed.
//!
//! A process that is killed leaves its temporary file behind. It holds a lock on it as long as it lives, so
//! that the next one in that folder tells leftovers, which it removes, from what others are writing there at
//! the same time.

use std::{
    fs::{self, File},
    path::Path,
};

use tempfile::NamedTempFile;

use crate::{Error, Result};

const PREFIX: &str = ".demc-";
const SUFFIX: &str = ".tmp";

/// Lets `write` fill a new file that takes the name `path` only when it is complete.
///
/// # Errors
/// Those of `write`, or the file cannot be created or renamed.
pub fn atomically(path: &Path, write: impl FnOnce(&File) -> Result<()>) -> Result<()> {
    let folder = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let file = temporary(folder).map_err(Error::io("write", path))?;
    write(file.as_file())?;
    // After a crash of the machine, there must be no file of that name without its pixels.
    file.as_file().sync_all().map_err(Error::io("write", path))?;
    file.persist(path).map_err(|e| Error::io("write", path)(e.error))?;
    Ok(())
}

/// Makes a folder for results and finds out now, not after an hour, whether files can be made in it.
/// Temporary files that killed processes left there are removed.
///
/// # Errors
/// The folder cannot be made, or no file can be made in it.
pub fn prepare_folder(folder: &Path) -> Result<()> {
    fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
    let refused = |error| Error::io("write", folder)(error);
    temporary(folder).map_err(refused)?;
    for entry in fs::read_dir(folder).map_err(refused)?.flatten() {
        let name = entry.file_name();
        let name = name.to_string_lossy();
        if !(name.starts_with(PREFIX) && name.ends_with(SUFFIX)) {
            continue;
        }
        // A file that cannot be opened or locked belongs to another process.
        let Ok(file) = File::options().write(true).open(entry.path()) else { continue };
        if file.try_lock().is_ok() {
            let _ = fs::remove_file(entry.path());
        }
    }
    Ok(())
}

/// A new file with a unique name, locked.
fn temporary(folder: &Path) -> std::io::Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(PREFIX).suffix(SUFFIX);
    // Temporary files are private by default; this one becomes a file for the whole farm to read.
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(fs::Permissions::from_mode(0o666)); // less the umask
    }
    loop {
        let file = builder.tempfile_in(folder)?;
        // Some network drives know no locks; nobody removes leftovers there.
        if file.as_file().lock().is_err() || file.path().exists() {
            return Ok(file);
        }
        // The file was taken for a leftover and removed before it was locked.
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<String> = fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn leftovers_go_and_what_is_being_written_stays() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("frame.exr");
        for name in [".demc-1234.tmp", ".demc-abcdef.tmp", "other.tmp", ".demc-notes"] {
            fs::write(folder.path().join(name), "x").unwrap();
        }
        atomically(&path, |mut file| {
            prepare_folder(folder.path())?;
            assert_eq!(names(folder.path()).len(), 3, "{:?}", names(folder.path()));
            file.write_all(b"whole").map_err(Error::io("write", &path))
        })
        .unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"whole");
        assert_eq!(names(folder.path()), [".demc-notes", "frame.exr", "other.tmp"]);
    }

    #[test]
    fn writers_and_removers_in_one_folder_do_not_harm_each_other() {
        let folder = tempfile::tempdir().unwrap();
        std::thread::scope(|scope| {
            for thread in 0..4 {
                let folder = folder.path();
                scope.spawn(move || {
                    for i in 0..50 {
                        let path = folder.join(format!("{thread}_{i}"));
                        prepare_folder(folder).unwrap();
                        atomically(&path, |mut f| f.write_all(b"1").map_err(Error::io("write", &path)))
                            .unwrap();
                    }
                });
            }
        });
        assert_eq!(names(folder.path()).len(), 200);
    }
}
