//! Channels of one part as f32, decompressed in parallel; only the channels asked for are kept.

use exr::{
    block::{BlockIndex, UncompressedBlock, chunk::CompressedBlock},
    math::Vec2,
    meta::{attribute::SampleType, header::Header},
};
use half::{f16, slice::HalfFloatSliceExt};
use rayon::prelude::*;

use super::{Frame, StoredChunk, bounds};
use crate::{Error, Result};

/// Blocks that each thread decompresses before they are copied out: bounds the memory that decoding adds.
const BLOCKS_PER_THREAD: usize = 8;

impl Frame {
    /// Images of a part, each of the full-resolution values of some of its channels in the order asked, (C, H, W) of its data
    /// window. Unsigned integers are rounded to the nearest f32.
    ///
    /// # Errors
    /// A block cannot be decompressed, or a channel is subsampled or does not exist.
    pub fn decode(&self, part: usize, images: &[&[usize]]) -> Result<Vec<Vec<f32>>> {
        let header = self.header(part)?;
        self.refuse_subsampling(part)?;
        let channels = images.concat();
        if let Some(bad) = channels.iter().find(|&&c| c >= header.channels.list.len()) {
            return Err(Error::invalid(&self.path, format!("part {part} has no channel {bad}")));
        }
        let area = header.layer_size.area();
        let mut decoded: Vec<Vec<f32>> = Vec::new();
        let of_part: Vec<&StoredChunk> = self.chunks.iter().filter(|c| c.part == part).collect();
        for batch in of_part.chunks(BLOCKS_PER_THREAD * rayon::current_num_threads()) {
            let blocks: Vec<UncompressedBlock> =
                batch.par_iter().map(|stored| self.decompress(stored)).collect::<Result<_>>()?;
            // Only now: a damaged size fails before memory is taken for it.
            if decoded.is_empty() {
                decoded = images.iter().map(|channels| vec![0.0; channels.len() * area]).collect();
            }
            let planes: Vec<&mut [f32]> =
                decoded.iter_mut().flat_map(|image| image.chunks_mut(area)).collect();
            planes.into_par_iter().zip(&channels).for_each(|(plane, &channel)| {
                let finest = blocks.iter().filter(|block| block.index.level == Vec2(0, 0));
                finest.for_each(|block| copy_block(header, block, channel, plane));
            });
        }
        Ok(decoded)
    }

    /// The uncompressed bytes of one stored chunk.
    pub(super) fn decompress(&self, stored: &StoredChunk) -> Result<UncompressedBlock> {
        let header = &self.meta.headers[stored.part];
        let (bytes, place) = match &stored.chunk.compressed_block {
            CompressedBlock::ScanLine(block) => (&block.compressed_pixels_le, None),
            CompressedBlock::Tile(block) => (&block.compressed_pixels_le, Some(block.coordinates)),
            _ => return Err(Self::error(&self.path, exr::error::Error::NotSupported("deep data".into()))),
        };
        let place = place.map_or_else(|| header.get_block_data_indices(&stored.chunk.compressed_block), Ok);
        let at = place.and_then(|place| header.get_absolute_block_pixel_coordinates(place));
        let size = at.map_err(|e| Self::error(&self.path, e))?.size;
        bounds::check(header, bytes, size).map_err(|why| {
            Error::invalid(&self.path, format!("damaged EXR ({why}); render it or copy it again"))
        })?;
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

/// Writes a block's values of a channel into the plane of the whole part.
fn copy_block(header: &Header, block: &UncompressedBlock, channel: usize, plane: &mut [f32]) {
    let BlockIndex { pixel_position: at, pixel_size: size, .. } = block.index;
    let rows = plane.chunks_mut(header.layer_size.width()).skip(at.y());
    for (y, row) in rows.take(size.height()).enumerate() {
        let bytes = &block.data[row_bytes(header, block.index, channel, y)];
        let kind = header.channels.list[channel].sample_type;
        read_values(bytes, kind, &mut row[at.x()..][..size.width()]);
    }
}

/// Reads values in native byte order, as `exr` leaves them in uncompressed blocks.
fn read_values(bytes: &[u8], kind: SampleType, values: &mut [f32]) {
    let wide = values.iter_mut().zip(bytes.as_chunks::<4>().0);
    match kind {
        SampleType::F16 => {
            let halves = bytes.as_chunks::<2>().0.iter().map(|b| f16::from_ne_bytes(*b));
            // All of a row at once: one by one, half the time goes into calls.
            halves.collect::<Vec<f16>>().convert_to_f32_slice(values);
        }
        SampleType::F32 => wide.for_each(|(value, b)| *value = f32::from_ne_bytes(*b)),
        SampleType::U32 => wide.for_each(|(value, b)| *value = u32::from_ne_bytes(*b) as f32),
    }
}
