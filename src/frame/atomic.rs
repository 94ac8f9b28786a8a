//! Files that are whole or not there: written under a temporary name in the target's folder, then renamed.
//!
//! A process that is killed leaves its temporary file behind. It holds a lock on it as long as it lives, so
//! that the next one in that folder tells leftovers, which it removes, from what others are writing there at
//! the same time. Other machines do not see the lock on every network drive: on Linux, their files count as
//! leftovers after a day.

use std::{
    fs::{self, File, TryLockError},
    io::Write,
    path::{Path, PathBuf},
    sync::LazyLock,
    time::Duration,
};

use tempfile::NamedTempFile;

use crate::{Error, Result};

const PREFIX: &str = ".demc-";
const SUFFIX: &str = ".tmp";

/// [`PREFIX`] and a name of this machine since it was started, where the system tells one: Linux does. Elsewhere
/// every unlocked file counts as this machine's.
static OWN_PREFIX: LazyLock<String> = LazyLock::new(|| {
    let id = fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    format!("{PREFIX}{}", id.chars().filter(char::is_ascii_alphanumeric).take(12).collect::<String>())
});

/// No frame takes this long to write.
const LONG: Duration = Duration::from_secs(24 * 3600);

/// Lets `write` fill a new file that takes the name `path` only when it is complete. A file of that name, or a link, is
/// replaced.
///
/// # Errors
/// Those of `write`, the file cannot be created or renamed, or something else has its name, such as a device.
pub fn atomically(path: &Path, write: impl FnOnce(&File) -> Result<()>) -> Result<()> {
    if fs::symlink_metadata(path).is_ok_and(|there| !(there.is_file() || there.is_symlink())) {
        return Err(Error::invalid(
            path,
            "cannot write: what has this name is no file; move it away, or choose another",
        ));
    }
    let file = temporary(folder_of(path)).map_err(Error::io("write", path))?;
    write(file.as_file())?;
    // After a crash of the machine, there must be no file of that name without its pixels.
    file.as_file().sync_all().map_err(Error::io("write", path))?;
    file.persist(path).map_err(|e| Error::io("write", path)(e.error))?;
    Ok(())
}

/// As [`atomically`], of a file all of whose bytes are there.
///
/// # Errors
/// The file cannot be written, or something else has its name.
pub fn write_file(path: &Path, bytes: &[u8]) -> Result<()> {
    atomically(path, |mut file| file.write_all(bytes).map_err(Error::io("write", path)))
}

/// The folder that a file is in; that of a bare name is the present one.
pub fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// A file's path by the place of its folder on the disk, the same by whatever path that is reached. The file itself may
/// be a link to another, and stays a file of its own.
pub fn place_of(path: &Path) -> PathBuf {
    match (fs::canonicalize(folder_of(path)), path.file_name()) {
        (Ok(folder), Some(name)) => folder.join(name),
        _ => path.to_owned(),
    }
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
        let age =
            entry.metadata().and_then(|file| file.modified()).map(|time| time.elapsed().unwrap_or_default());
        if !name.starts_with(&*OWN_PREFIX) && age.is_ok_and(|age| age < LONG) {
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

/// Keeps other runs of demc out of a folder until it is dropped.
pub struct Alone(File);

impl Drop for Alone {
    fn drop(&mut self) {
        // Closing the file alone would leave the lock to processes that other threads are just starting: each holds a
        // copy of every open file until its program begins.
        let _ = self.0.unlock();
    }
}

/// Keeps other runs of demc that ask for this out of a folder for results, until what is returned is dropped. Where the
/// disk knows no locks nothing is kept out.
///
/// # Errors
/// Another run works there, or no file can be made.
pub fn alone_in(folder: &Path) -> Result<Alone> {
    let path = folder.join(".lock");
    let file = File::create(&path).map_err(Error::io("write", &path))?;
    match file.try_lock() {
        Err(TryLockError::WouldBlock) => Err(Error::invalid(
            folder,
            "another run of demc works in this folder; wait for it, or choose another --out",
        )),
        _ => Ok(Alone(file)),
    }
}

/// Whether a folder, or if it is not there yet the one that it will lie in, takes capital letters for small ones,
/// as on Windows, on macOS and on shares from there.
pub fn ignores_case(folder: &Path) -> bool {
    let existing = folder.ancestors().find(|path| path.is_dir());
    let existing = existing.unwrap_or(Path::new("."));
    // Where no file can be made, none is lost either.
    temporary(existing).is_ok_and(|file| {
        let name = file.path().file_name().expect("it has a name").to_string_lossy().to_uppercase();
        existing.join(name).exists()
    })
}

/// A new file with a unique name, locked.
fn temporary(folder: &Path) -> std::io::Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(&*OWN_PREFIX).suffix(SUFFIX);
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
    use std::{
        process::Command,
        sync::atomic::{AtomicBool, Ordering},
        time::SystemTime,
    };

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
    #[cfg(unix)]
    fn a_folder_is_free_at_once_whatever_processes_start_meanwhile() {
        let folder = tempfile::tempdir().unwrap();
        let done = AtomicBool::new(false);
        std::thread::scope(|threads| {
            threads.spawn(|| {
                while !done.load(Ordering::Relaxed) {
                    Command::new("true").status().unwrap();
                }
            });
            let refused = (0..2000).filter(|_| alone_in(folder.path()).is_err()).count();
            done.store(true, Ordering::Relaxed);
            assert_eq!(refused, 0);
        });
    }

    #[test]
    fn leftovers_go_and_what_is_being_written_stays() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("frame.exr");
        let own = format!("{}1234.tmp", *OWN_PREFIX);
        for name in [&own, ".demc-old.tmp", ".demc-elsewhere.tmp", "other.tmp", ".demc-notes"] {
            fs::write(folder.path().join(name), "x").unwrap();
        }
        let old = File::options().write(true).open(folder.path().join(".demc-old.tmp")).unwrap();
        old.set_modified(SystemTime::now() - 2 * LONG).unwrap();
        atomically(&path, |mut file| {
            prepare_folder(folder.path())?;
            assert_eq!(names(folder.path()).len(), 4, "{:?}", names(folder.path()));
            file.write_all(b"whole").map_err(Error::io("write", &path))
        })
        .unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"whole");
        assert_eq!(names(folder.path()), [".demc-elsewhere.tmp", ".demc-notes", "frame.exr", "other.tmp"]);
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
