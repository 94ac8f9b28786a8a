//! Channels of one part as f32, decompressed in parallel; only the channels asked for are kept.

use exr::{
    block::{BlockIndex, UncompressedBlock},
    math::Vec2,
    meta::{attribute::SampleType, header::Header},
};
use rayon::prelude::*;

use super::{Frame, StoredChunk};
use crate::{Error, Result};

/// Blocks decoded before they are copied out: bounds the memory that decoding adds.
const BATCH: usize = 64;

impl Frame {
    /// The full-resolution values of some channels of a part, each `height * width` of its data
    /// window, row-major, in the order asked. Unsigned integers are rounded to the nearest f32.
    ///
    /// # Errors
    /// A block cannot be decompressed, or a channel is subsampled or does not exist.
    pub fn decode(&self, part: usize, channels: &[usize]) -> Result<Vec<Vec<f32>>> {
        let header = self.header(part)?;
        self.refuse_subsampling(part)?;
        if let Some(bad) = channels.iter().find(|&&c| c >= header.channels.list.len()) {
            return Err(Error::invalid(&self.path, format!("part {part} has no channel {bad}")));
        }
        let (width, height) = (header.layer_size.width(), header.layer_size.height());
        let mut planes: Vec<Vec<f32>> = Vec::new();
        let of_part: Vec<&StoredChunk> = self.chunks.iter().filter(|c| c.part == part).collect();
        for batch in of_part.chunks(BATCH) {
            let blocks: Vec<_> = batch
                .par_iter()
                .map(|stored| {
                    let block = self.decompress(stored)?;
                    let values = channels.iter().map(|&c| channel_values(header, &block, c)).collect();
                    Ok((block.index, values))
                })
                .collect::<Result<_>>()?;
            // Only now: a damaged size fails before memory is taken for it.
            planes.resize_with(channels.len(), || vec![0.0; width * height]);
            for (at, values) in blocks.iter().filter(|(at, _)| at.level == Vec2(0, 0)) {
                let values: &Vec<Vec<f32>> = values;
                for (plane, values) in planes.iter_mut().zip(values) {
                    copy_block(plane, width, *at, values);
                }
            }
        }
        Ok(planes)
    }

    /// The uncompressed bytes of one stored chunk.
    pub(super) fn decompress(&self, stored: &StoredChunk) -> Result<UncompressedBlock> {
        UncompressedBlock::decompress_chunk(stored.chunk.clone(), &self.meta, false)
            .map_err(|e| Self::error(&self.path, e))
    }

    /// Subsampled channels have no place in a render; the `exr` crate cannot decode beside them.
    pub(super) fn refuse_subsampling(&self, part: usize) -> Result<()> {
        match self.parts[part].channels.iter().find(|c| c.subsampled) {
            Some(c) => Err(Error::invalid(
                &self.path,
                format!("channel '{}' is subsampled; store it again at full resolution as RGB", c.name),
            )),
            None => Ok(()),
        }
    }
}

/// Where a channel's bytes of row `y` lie in an uncompressed block: rows hold channel after channel.
pub(super) fn row_bytes(header: &Header, at: BlockIndex, channel: usize, y: usize) -> std::ops::Range<usize> {
    let width = at.pixel_size.width();
    let offset: usize =
        header.channels.list[..channel].iter().map(|c| c.sample_type.bytes_per_sample()).sum();
    let start = width * (y * header.channels.bytes_per_pixel + offset);
    start..start + width * header.channels.list[channel].sample_type.bytes_per_sample()
}

fn channel_values(header: &Header, block: &UncompressedBlock, channel: usize) -> Vec<f32> {
    let mut values = Vec::with_capacity(block.index.pixel_size.area());
    for y in 0..block.index.pixel_size.height() {
        let bytes = &block.data[row_bytes(header, block.index, channel, y)];
        match header.channels.list[channel].sample_type {
            SampleType::F16 => {
                values.extend(bytes.as_chunks::<2>().0.iter().map(|b| half::f16::from_ne_bytes(*b).to_f32()))
            }
            SampleType::F32 => values.extend(bytes.as_chunks::<4>().0.iter().map(|b| f32::from_ne_bytes(*b))),
            SampleType::U32 => {
                values.extend(bytes.as_chunks::<4>().0.iter().map(|b| u32::from_ne_bytes(*b) as f32));
            }
        }
    }
    values
}

fn copy_block(plane: &mut [f32], width: usize, at: BlockIndex, values: &[f32]) {
    let rows = plane.chunks_mut(width).skip(at.pixel_position.y());
    for (row, line) in rows.zip(values.chunks(at.pixel_size.width())) {
        row[at.pixel_position.x()..][..line.len()].copy_from_slice(line);
    }
}
