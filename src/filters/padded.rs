//! Planes with a margin, so that windows and patches need no test for the border, and the tiles that
//! the work is cut into.
//!
//! Beyond the frame the nearest pixel is repeated. That serves patches; windows give no weight to
//! pixels outside, by the mask of [`inside`].

use rayon::prelude::*;

use crate::planes::Planes;

/// Pixels in a row of a tile: whole vectors.
pub const TILE_W: usize = 64;
/// Rows of a tile.
pub const TILE_H: usize = 32;

/// One plane with a margin. The frame's own area is rounded up to whole tiles.
pub struct Padded {
    margin: usize,
    stride: usize,
    data: Vec<f32>,
}

impl Padded {
    /// `plane` of `width` pixels a row, with `margin` pixels around.
    pub fn new(plane: &[f32], width: usize, margin: usize) -> Self {
        let height = plane.len() / width;
        Self::from_fn(width, height, margin, |x, y| {
            plane[y.clamp(0, height as isize - 1) as usize * width + x.clamp(0, width as isize - 1) as usize]
        })
    }

    /// The values of `value(x, y)`, whose coordinates begin at minus the margin.
    fn from_fn(
        width: usize,
        height: usize,
        margin: usize,
        value: impl Fn(isize, isize) -> f32 + Sync,
    ) -> Self {
        let stride = width.next_multiple_of(TILE_W) + 2 * margin;
        let rows = height.next_multiple_of(TILE_H) + 2 * margin;
        let mut data = vec![0.0; stride * rows];
        let shift = margin as isize;
        data.par_chunks_mut(stride).enumerate().for_each(|(y, row)| {
            for (x, v) in row.iter_mut().enumerate() {
                *v = value(x as isize - shift, y as isize - shift);
            }
        });
        Self { margin, stride, data }
    }

    /// `len` values from (x, y) on, in coordinates of the frame.
    #[inline(always)]
    pub fn row(&self, x: isize, y: isize, len: usize) -> &[f32] {
        let at = |v: isize| {
            usize::try_from(v + self.margin as isize).expect("windows and patches stay within the margin")
        };
        &self.data[at(y) * self.stride + at(x)..][..len]
    }
}

/// Every channel of `planes` with a margin.
pub fn pad(planes: &Planes, margin: usize) -> Vec<Padded> {
    (0..planes.channels).map(|c| Padded::new(planes.channel(c), planes.width, margin)).collect()
}

/// 1 inside a frame of this size and 0 outside.
pub fn inside(width: usize, height: usize, margin: usize) -> Padded {
    let within = |v: isize, size: usize| usize::try_from(v).is_ok_and(|v| v < size);
    Padded::from_fn(width, height, margin, |x, y| f32::from(within(x, width) && within(y, height)))
}

/// The top left corners of the tiles of a frame, row by row.
pub fn tiles(width: usize, height: usize) -> Vec<(usize, usize)> {
    (0..height).step_by(TILE_H).flat_map(|y| (0..width).step_by(TILE_W).map(move |x| (x, y))).collect()
}
