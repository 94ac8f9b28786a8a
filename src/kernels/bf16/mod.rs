//! Convolutions whose factors are bfloat16 and whose sums are f32: half the memory traffic, and up to
//! sixteen times the arithmetic rate where the processor multiplies matrix tiles (AMX).
//!
//! A [`Wide`] is 32 consecutive channels of one pixel. A plane of them is one long row of positions,
//! borders included, so that a tap is a fixed offset and a chunk of 32 positions may run over the end of a
//! row: what it computes for border positions is dropped. That keeps narrow levels as fast as wide ones.
//!
//! [`Engine`] holds all that depends on the processor: two matrix products and two conversions. Its
//! portable form is the oracle of the others.

pub mod conv;
mod engine;
pub mod weight_grad;

pub use engine::Engine;

use std::sync::{Mutex, PoisonError};

use half::bf16;
use rayon::prelude::*;

use super::{Block, LANES, Shape, View, conv::Geometry};

/// Channels in a [`Wide`].
pub const WIDE: usize = 2 * LANES;

/// Positions that one product serves.
const CHUNK: usize = 32;

/// Thirty-two bfloat16 values, a row of a matrix tile: the channels of one pixel, or two rows of weights
/// interleaved.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C, align(64))]
pub struct Wide(pub [bf16; WIDE]);

impl Wide {
    const ZERO: Wide = Wide([bf16::ZERO; WIDE]);
}

/// One contribution to a sum: where its factors lie, in bytes from the chunk's position and from the
/// output plane's weights.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
struct Term {
    input: isize,
    weights: usize,
}

/// The sums of a chunk for two output planes.
#[repr(C, align(64))]
struct Sums([[Block; CHUNK]; 2]);

/// Free buffers by length. What they hold is whatever the last user left.
static FREE: Mutex<Vec<Vec<Wide>>> = Mutex::new(Vec::new());

/// Pooled memory: after the first step nothing is allocated and no page is faulted in.
#[derive(Debug)]
struct Buffer(Vec<Wide>);

impl Buffer {
    fn new(len: usize) -> Self {
        let mut free = FREE.lock().unwrap_or_else(PoisonError::into_inner);
        match free.iter().position(|b| b.len() == len) {
            Some(i) => Self(free.swap_remove(i)),
            None => Self(vec![Wide::ZERO; len]),
        }
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        FREE.lock().unwrap_or_else(PoisonError::into_inner).push(std::mem::take(&mut self.0));
    }
}

/// Gives every free buffer back to the system.
pub fn clear() {
    FREE.lock().unwrap_or_else(PoisonError::into_inner).clear();
}

/// A plane of positions: its extent, and how the four pixels of a square are dealt to four planes where a
/// convolution takes steps of two.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Grid {
    h: usize,
    w: usize,
    pad: usize,
    split: bool,
}

impl Grid {
    fn new(shape: Shape, split: bool) -> Self {
        let factor = if split { 2 } else { 1 };
        Self { h: shape.h / factor, w: shape.w / factor, pad: shape.pad, split }
    }

    /// Planes that one plane of the source becomes.
    fn phases(self) -> usize {
        if self.split { 4 } else { 1 }
    }

    fn stride(self) -> usize {
        self.w + 2 * self.pad
    }

    /// Positions of a plane, borders included.
    fn positions(self) -> usize {
        (self.h + 2 * self.pad) * self.stride()
    }

    /// The position of row `y`, column 0.
    fn row(self, y: usize) -> usize {
        (y + self.pad) * self.stride() + self.pad
    }

    /// How far a chunk may read beyond the last position: to its own end, and as far as a tap reaches.
    fn slack(self) -> usize {
        CHUNK + self.pad * (self.stride() + 1)
    }

    /// Calls `put(position, block index in the source's plane)` for every pixel of phase `phase`.
    fn pixels(self, source: Shape, phase: usize, mut put: impl FnMut(usize, usize)) {
        for y in 0..self.h {
            let row = source.row(0, 0, 2 * y + phase / 2) + phase % 2;
            (0..self.w).for_each(|x| put(self.row(y) + x, row + 2 * x));
        }
    }
}

/// One or several activations as the left factor of [`conv::convolve`].
#[derive(Debug)]
pub struct Operand {
    /// `[image][source plane, 32 channels][phase][position]`, then slack.
    data: Buffer,
    grid: Grid,
    images: usize,
    channels: Vec<usize>,
}

impl Operand {
    /// Rounds the activations `sources`, taken as concatenated, to bfloat16. `geometry` is that of the
    /// convolution to follow.
    ///
    /// # Panics
    /// If the sources differ in size.
    pub fn new(engine: Engine, sources: &[View], geometry: Geometry) -> Self {
        let first = sources[0].shape;
        let same = |s: Shape| (s.n, s.h, s.w, s.pad) == (first.n, first.h, first.w, first.pad);
        assert!(sources.iter().all(|s| same(s.shape)), "sources differ in size");
        let grid = Grid::new(first, geometry == Geometry::Strided);
        let channels: Vec<usize> = sources.iter().map(|s| s.shape.c).collect();
        let planes: Vec<(usize, usize)> = channels
            .iter()
            .enumerate()
            .flat_map(|(source, c)| (0..c.div_ceil(WIDE)).map(move |plane| (source, plane)))
            .collect();
        let count = first.n * planes.len() * grid.phases();
        let mut data = Buffer::new(count * grid.positions() + grid.slack());
        let body = &mut data.0[..count * grid.positions()];
        body.par_chunks_mut(grid.positions()).enumerate().for_each(|(i, out)| {
            let (phase, i) = (i % grid.phases(), i / grid.phases());
            let (n, (source, plane)) = (i / planes.len(), planes[i % planes.len()]);
            let (low, high) = halves(sources[source], n, plane);
            if grid.split {
                out.fill(Wide::ZERO);
                grid.pixels(first, phase, |to, from| {
                    engine.narrow(&low[from..=from], high.map(|h| &h[from..=from]), &mut out[to..=to]);
                });
            } else {
                engine.narrow(low, high, out);
            }
        });
        Self { data, grid, images: first.n, channels }
    }

    /// Planes of 32 channels over all sources, times phases.
    fn planes(&self) -> usize {
        self.channels.iter().map(|c| c.div_ceil(WIDE)).sum::<usize>() * self.grid.phases()
    }
}

/// The two planes of 16 channels that make up plane `plane` of 32; the second may be absent.
fn halves<'a>(source: View<'a>, n: usize, plane: usize) -> (&'a [Block], Option<&'a [Block]>) {
    let s = source.shape;
    let blocks = |p: usize| &source.data[(n * s.planes() + p) * s.plane_stride()..][..s.plane_stride()];
    (blocks(2 * plane), (2 * plane + 1 < s.planes()).then(|| blocks(2 * plane + 1)))
}
