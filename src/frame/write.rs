//! Writes a frame to a file, whole or not at all.

use std::{
    io::{self, BufWriter, Write},
    path::Path,
};

use exr::meta::BlockDescription;

use super::{Frame, MAGIC, StoredChunk, atomically, flags};
use crate::{Error, Result};

impl Frame {
    /// Writes the frame. Parts that were not edited are the very chunks that were read.
    ///
    /// # Errors
    /// The directory or the file cannot be written; nothing is left behind.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        let path = path.as_ref();
        self.refuse_headers_alone()?;
        atomically(path, |file| {
            let mut buffered = BufWriter::with_capacity(1 << 20, file);
            let failed = |error| Error::io("write", path)(error);
            let chunks = self.write_start(&mut buffered).map_err(failed)?;
            for chunk in chunks {
                let bytes = self.opened.bytes(&chunk.bytes)?;
                buffered.write_all(&self.prefix(chunk)).map_err(failed)?;
                buffered.write_all(&bytes).map_err(failed)?;
            }
            buffered.flush().map_err(failed)?;
            self.opened.check_unchanged()
        })
    }

    /// Writes all that comes before the chunks; these are to follow in the order returned.
    fn write_start(&self, out: &mut impl Write) -> io::Result<&[StoredChunk]> {
        let mut start = MAGIC.to_vec();
        start.extend_from_slice(&self.version().to_le_bytes());
        for stored in &self.stored {
            stored.attributes.write(&mut start)?;
        }
        if self.multi_part {
            start.push(0);
        }
        let mut tables: Vec<Vec<u64>> = self.stored.iter().map(|s| vec![0; s.layout.chunk_count]).collect();
        let mut at = (start.len() + tables.iter().map(|table| 8 * table.len()).sum::<usize>()) as u64;
        for chunk in &self.chunks {
            tables[chunk.part][chunk.index] = at;
            at += (self.prefix(chunk).len() + chunk.bytes.len()) as u64;
        }
        out.write_all(&start)?;
        for offset in tables.iter().flatten() {
            out.write_all(&offset.to_le_bytes())?;
        }
        Ok(&self.chunks)
    }

    /// The format's version with the flags of what the file holds.
    fn version(&self) -> u32 {
        let is_deep = self.stored.iter().any(|stored| stored.layout.deep);
        let is_tiled = !self.multi_part && !is_deep && self.stored[0].layout.blocks.has_tiles();
        let is_long = self.long_names || self.stored.iter().any(|s| s.attributes.has_long_names(&s.layout));
        let of = |is: bool, flag: u32| if is { flag } else { 0 };
        2 | of(is_tiled, flags::TILED)
            | of(is_long, flags::LONG_NAMES)
            | of(is_deep, flags::DEEP)
            | of(self.multi_part, flags::MULTI_PART)
    }

    /// What stands before a chunk's bytes: its part, its place, and its size where the bytes do not say it
    /// themselves.
    fn prefix(&self, chunk: &StoredChunk) -> Vec<u8> {
        let layout = &self.stored[chunk.part].layout;
        let int =
            |n: usize| i32::try_from(n).expect("what was read fits, and sizes were checked").to_le_bytes();
        let mut prefix = Vec::with_capacity(24);
        if self.multi_part {
            prefix.extend_from_slice(&int(chunk.part));
        }
        let place = chunk.place;
        match layout.blocks {
            BlockDescription::ScanLines => {
                let rows = place.tile_index.y() * layout.compression.scan_lines_per_block();
                let rows = i32::try_from(rows).expect("the height was checked");
                prefix.extend_from_slice(&(layout.own_attributes.layer_position.y() + rows).to_le_bytes());
            }
            BlockDescription::Tiles(_) => {
                for number in
                    [place.tile_index.x(), place.tile_index.y(), place.level_index.x(), place.level_index.y()]
                {
                    prefix.extend_from_slice(&int(number));
                }
            }
        }
        if !layout.deep {
            prefix.extend_from_slice(&int(chunk.bytes.len()));
        }
        prefix
    }
}
