//! A frame to a file: written under a temporary name in the target directory and renamed, so that a
//! file of the final name is always whole.

use std::{fs, io::BufWriter, path::Path};

use exr::block::writer::ChunksWriter;

use super::Frame;
use crate::{Error, Result};

impl Frame {
    /// Writes the frame. Parts that were not edited are the very chunks that were read.
    ///
    /// # Errors
    /// The directory or the file cannot be written; nothing is left behind.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        let path = path.as_ref();
        atomically(path, |file| {
            let buffered = BufWriter::with_capacity(1 << 20, file);
            exr::block::write(buffered, self.meta.headers.clone(), false, |_, writer| {
                self.chunks.iter().try_for_each(|s| writer.write_chunk(s.index, s.chunk.clone()))
            })
            .map_err(|e| match e {
                exr::error::Error::Io(source) => Error::Io { path: path.into(), action: "write", source },
                other => Self::error(path, other),
            })
        })
    }
}

/// Lets `write` fill a new file that takes the name `path` only when it is complete.
///
/// # Errors
/// Whatever `write` reports, or that the file cannot be created or renamed.
pub fn atomically(path: &Path, write: impl FnOnce(&fs::File) -> Result<()>) -> Result<()> {
    let directory = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let mut builder = tempfile::Builder::new();
    builder.prefix(".demc-").suffix(".tmp");
    // Temporary files are private by default; this one becomes a file for the whole farm to read.
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(fs::Permissions::from_mode(0o666)); // less the umask
    }
    let file = builder.tempfile_in(directory).map_err(Error::io("write", path))?;
    write(file.as_file())?;
    // The name must not outlive a crash of the machine that its pixels did not.
    file.as_file().sync_all().map_err(Error::io("write", path))?;
    file.persist(path).map_err(|e| Error::io("write", path)(e.error))?;
    Ok(())
}
