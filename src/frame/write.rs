//! A frame to a file, whole or not at all.

use std::{io::BufWriter, path::Path};

use exr::block::writer::ChunksWriter;

use super::{Frame, atomically};
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
