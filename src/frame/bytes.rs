//! The bytes of compressed blocks: in memory where they are new, or else still in the file that was opened,
//! since a frame of many passes whose pixels do not compress takes more memory than denoising it does.

use std::{
    borrow::Cow,
    fs::{File, Metadata},
    io,
    path::{Path, PathBuf},
    time::SystemTime,
};

use crate::{Error, Result};

/// Compressed bytes, or where they are.
pub enum Bytes {
    /// In memory.
    Held(Vec<u8>),
    /// `len` bytes of the file, from offset `at` on.
    InFile { at: u64, len: usize },
}

impl Bytes {
    /// The number of bytes.
    pub fn len(&self) -> usize {
        match self {
            Self::Held(bytes) => bytes.len(),
            Self::InFile { len, .. } => *len,
        }
    }
}

/// An open file, and what it was like when it was opened.
pub struct Opened {
    file: File,
    path: PathBuf,
    state: (u64, Option<SystemTime>),
}

impl Opened {
    /// Keeps a file open.
    pub fn new(file: File, path: &Path, info: &Metadata) -> Self {
        Self { file, path: path.into(), state: state(info) }
    }

    /// The bytes of a block.
    ///
    /// # Errors
    /// The file cannot be read, or has become shorter.
    pub fn bytes<'a>(&self, of: &'a Bytes) -> Result<Cow<'a, [u8]>> {
        match of {
            Bytes::Held(bytes) => Ok(bytes.as_slice().into()),
            Bytes::InFile { at, len } => {
                let mut bytes = vec![0; *len];
                read_exact_at(&self.file, &mut bytes, *at).map_err(|error| match error.kind() {
                    io::ErrorKind::UnexpectedEof => self.changed(),
                    _ => Error::io("read", &self.path)(error),
                })?;
                Ok(bytes.into())
            }
        }
    }

    /// Whether the file is the one that was opened: blocks that were written since would not belong together.
    ///
    /// # Errors
    /// Somebody wrote into it.
    pub fn check_unchanged(&self) -> Result<()> {
        let info = self.file.metadata().map_err(Error::io("read", &self.path))?;
        if state(&info) == self.state { Ok(()) } else { Err(self.changed()) }
    }

    fn changed(&self) -> Error {
        Error::invalid(&self.path, "was written anew while it was read; do it again when it is whole")
    }
}

fn state(info: &Metadata) -> (u64, Option<SystemTime>) {
    (info.len(), info.modified().ok())
}

#[cfg(unix)]
fn read_exact_at(file: &File, bytes: &mut [u8], at: u64) -> io::Result<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, bytes, at)
}

#[cfg(windows)]
fn read_exact_at(file: &File, mut bytes: &mut [u8], mut at: u64) -> io::Result<()> {
    while !bytes.is_empty() {
        match std::os::windows::fs::FileExt::seek_read(file, bytes, at) {
            Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(count) => {
                bytes = &mut bytes[count..];
                at += count as u64;
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}
