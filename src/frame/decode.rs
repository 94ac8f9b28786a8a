//! Channels of one part as f32, decompressed in parallel; only the channels asked for are kept.

use exr::{
    block::{BlockIndex, UncompressedBlock},
    math::Vec2,
    meta::{attribute::SampleType, header::Header},
};
use half::{f16, slice::HalfFloatSliceExt};
use rayon::prelude::*;

use super::{Frame, StoredChunk, bounds, chroma};
use crate::{
    Error, Result,
    kernels::memory::{self, PlaneBuffer},
};

/// Blocks that each thread decompresses before they are copied out: bounds the memory that decoding adds.
const BLOCKS_PER_THREAD: usize = 8;

impl Frame {
    /// Images of a part. Each holds the channels asked for, in that order, over the part's data window,
    /// (C, H, W). Unsigned integers are rounded to the nearest f32; chroma of half the resolution is
    /// interpolated.
    ///
    /// # Errors
    /// A block cannot be decompressed (see [`super::Part::undecodable`]), or a channel does not exist.
    pub fn decode(&self, part: usize, images: &[&[usize]]) -> Result<Vec<PlaneBuffer>> {
        let header = self.layout(part)?;
        self.refuse_undecodable(part)?;
        let channels = images.concat();
        if let Some(bad) = channels.iter().find(|&&c| c >= header.channels.list.len()) {
            return Err(Error::invalid(&self.path, format!("part {part} has no channel {bad}")));
        }
        let area = header.layer_size.area();
        let mut decoded: Vec<PlaneBuffer> = Vec::new();
        // Coarser levels are not decompressed.
        let is_finest = |chunk: &&StoredChunk| chunk.part == part && chunk.place.level_index == Vec2(0, 0);
        let of_part: Vec<&StoredChunk> = self.chunks.iter().filter(is_finest).collect();
        for batch in of_part.chunks(BLOCKS_PER_THREAD * rayon::current_num_threads()) {
            let blocks: Vec<UncompressedBlock> =
                batch.par_iter().map(|stored| self.decompress(stored)).collect::<Result<_>>()?;
            // Memory is taken only now, so that a damaged size has failed before.
            if decoded.is_empty() {
                let image = |channels: &&[usize]| self.zeros(channels.len() * area);
                decoded = images.iter().map(image).collect::<Result<_>>()?;
            }
            let planes: Vec<&mut [f32]> =
                decoded.iter_mut().flat_map(|image| image.chunks_mut(area)).collect();
            planes.into_par_iter().zip(&channels).for_each(|(plane, &channel)| {
                let copy = if chroma::is_subsampled(header) { chroma::copy_block } else { copy_block };
                blocks.iter().for_each(|block| copy(header, block, channel, plane));
            });
        }
        let planes = decoded.iter_mut().flat_map(|image| image.chunks_mut(area)).zip(&channels);
        let halved: Vec<&mut [f32]> = planes
            .filter(|(_, channel)| header.channels.list[**channel].sampling != Vec2(1, 1))
            .map(|(plane, _)| plane)
            .collect();
        halved.into_par_iter().for_each(|plane| chroma::reconstruct(plane, header.layer_size.width()));
        Ok(decoded)
    }

    /// Zeros; where there is no room for them, an error and not the end of the program.
    fn zeros(&self, len: usize) -> Result<PlaneBuffer> {
        memory::try_zeros(len).ok_or_else(|| {
            let gib = (len * size_of::<f32>()) as f64 / f64::from(1 << 30);
            let why = format!("needs {gib:.1} GiB more memory than there is; render it in regions");
            Error::invalid(&self.path, why)
        })
    }

    /// The uncompressed bytes of one stored chunk.
    pub(super) fn decompress(&self, stored: &StoredChunk) -> Result<UncompressedBlock> {
        let header = self.layout(stored.part)?;
        let at = header
            .get_absolute_block_pixel_coordinates(stored.place)
            .map_err(|e| Self::error(&self.path, e))?;
        let bytes = self.opened.bytes(&stored.bytes)?;
        let of_block = chroma::is_subsampled(header)
            .then(|| chroma::of_block(header, at.position.y().unsigned_abs() as usize, at.size));
        let header = of_block.as_ref().unwrap_or(header);
        bounds::check(header, &bytes, at.size).map_err(|why| {
            Error::invalid(&self.path, format!("damaged EXR ({why}); render it or copy it again"))
        })?;
        let data = header.compression.decompress_image_section_from_le(header, bytes.into_owned(), at, false);
        let index = BlockIndex {
            layer: stored.part,
            pixel_position: Vec2(
                at.position.x().unsigned_abs() as usize,
                at.position.y().unsigned_abs() as usize,
            ),
            pixel_size: at.size,
            level: stored.place.level_index,
        };
        data.map(|data| UncompressedBlock { index, data }).map_err(|e| Self::error(&self.path, e))
    }

    pub(super) fn refuse_undecodable(&self, part: usize) -> Result<()> {
        let part = &self.parts[part];
        let Some(why) = part.undecodable() else { return Ok(()) };
        let what = part.name.as_ref().map(|name| format!("part '{name}': ")).unwrap_or_default();
        Err(Error::invalid(&self.path, what + &why))
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
pub(super) fn read_values(bytes: &[u8], kind: SampleType, values: &mut [f32]) {
    let wide = values.iter_mut().zip(bytes.as_chunks::<4>().0);
    match kind {
        SampleType::F16 => {
            let halves = bytes.as_chunks::<2>().0.iter().map(|b| f16::from_ne_bytes(*b));
            // A whole row is converted at once; one by one, half the time would go into calls.
            halves.collect::<Vec<f16>>().convert_to_f32_slice(values);
        }
        SampleType::F32 => wide.for_each(|(value, b)| *value = f32::from_ne_bytes(*b)),
        SampleType::U32 => wide.for_each(|(value, b)| *value = u32::from_ne_bytes(*b) as f32),
    }
}
