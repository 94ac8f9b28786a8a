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

use std::ops::Deref;

use half::bf16;
use rayon::prelude::*;

use super::{
    Block, LANES, Shape, View, ViewMut,
    conv::Geometry,
    memory::{Pool, Pooled},
    plane::Plane,
};

/// Channels in a [`Wide`].
pub const WIDE: usize = 2 * LANES;

/// Input channels that a product leaves out where a plane does not use them.
const EIGHTH: usize = 8;

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

/// One contribution to a sum: the input at position 0, and where its weights lie, in bytes from the output
/// plane's.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
struct Term {
    input: *const Wide,
    weights: usize,
}

// SAFETY: a term only reads, from an operand that outlives the convolution that made it.
unsafe impl Sync for Term {}
// SAFETY: as above.
unsafe impl Send for Term {}

/// The sums of a chunk for two output planes.
#[repr(C, align(64))]
struct Sums([[Block; CHUNK]; 2]);

/// Free memory of operands.
static FREE: Pool<Wide> = Pool::new();

/// Memory for `len` values, which are whatever the last user left.
fn allocate(len: usize) -> Pooled<Wide> {
    FREE.take(len, Wide::ZERO)
}

/// Gives all free memory back to the system.
pub fn clear() {
    FREE.clear();
}

/// A plane of positions, and how the four pixels of a square are dealt to four planes where a convolution
/// takes steps of two.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Grid {
    plane: Plane,
    split: bool,
}

impl Grid {
    fn new(shape: Shape, split: bool) -> Self {
        let factor = if split { 2 } else { 1 };
        Self { plane: shape.with_size(shape.h / factor, shape.w / factor).plane(), split }
    }

    /// Planes that one plane of the source becomes.
    fn phases(self) -> usize {
        if self.split { 4 } else { 1 }
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

impl Deref for Grid {
    type Target = Plane;
    fn deref(&self) -> &Plane {
        &self.plane
    }
}

/// An activation in bfloat16: the left factor of [`conv::convolve`], and what it can write.
#[derive(Debug)]
pub struct Operand {
    /// `[image][plane of 32 channels][phase][position]`, then slack.
    data: Pooled<Wide>,
    grid: Grid,
    shape: Shape,
}

impl Operand {
    /// An activation with zero borders and arbitrary pixels.
    pub fn new(shape: Shape) -> Self {
        let grid = Grid::new(shape, false);
        let mut operand = Self::allocate(shape, grid);
        let body = operand.body_mut();
        body.par_chunks_mut(grid.positions()).for_each(|plane| grid.fill_border(plane, Wide::ZERO));
        operand
    }

    fn allocate(shape: Shape, grid: Grid) -> Self {
        let planes = shape.c.div_ceil(WIDE) * grid.phases();
        Self { data: allocate(shape.n * planes * grid.positions() + grid.slack()), grid, shape }
    }

    /// An activation rounded to bfloat16. `geometry` is that of the convolution that reads it.
    pub fn narrow(engine: Engine, source: View, geometry: Geometry) -> Self {
        let shape = source.shape;
        let grid = Grid::new(shape, geometry == Geometry::Strided);
        let mut operand = Self::allocate(shape, grid);
        let planes = operand.planes();
        let body = operand.body_mut();
        // Parts of planes, so that few planes still keep every thread busy.
        let part = if grid.split { grid.positions() } else { PART.min(grid.positions()) };
        body.par_chunks_mut(grid.positions()).enumerate().for_each(|(i, out)| {
            let (phase, plane) = (i % grid.phases(), i / grid.phases());
            let (low, high) =
                halves(source, plane * grid.phases() / planes, plane % (planes / grid.phases()));
            if grid.split {
                out.fill(Wide::ZERO);
                grid.pixels(shape, phase, |to, from| {
                    engine.narrow(&low[from..=from], high.map(|h| &h[from..=from]), &mut out[to..=to]);
                });
            } else {
                out.par_chunks_mut(part).enumerate().for_each(|(i, out)| {
                    let range = i * part..i * part + out.len();
                    engine.narrow(&low[range.clone()], high.map(|h| &h[range.clone()]), out);
                });
            }
        });
        operand
    }

    /// The values as f32, into an activation of the same shape. Borders are written too.
    ///
    /// # Panics
    /// If shapes differ.
    pub fn widen(&self, output: ViewMut) {
        assert_eq!(output.shape, self.shape);
        let (s, stride) = (self.shape, self.shape.plane_stride());
        output.data.par_chunks_mut(stride).enumerate().for_each(|(i, out)| {
            let (n, plane) = (i / s.planes(), i % s.planes());
            let from = &self.data[(n * self.planes() + plane / 2) * stride..][..stride];
            for (out, wide) in out.iter_mut().zip(from) {
                let half = &wide.0[plane % 2 * LANES..][..LANES];
                out.0.iter_mut().zip(half).for_each(|(o, h)| *o = h.to_f32());
            }
        });
    }

    /// Copies `count` rows of another activation of the same width and channels, from its row `from` on, to
    /// row `to` on. Rows -1 and H are those of the border, which then belong to a taller activation.
    ///
    /// # Panics
    /// If the two do not fit together, or hold several images.
    pub fn copy_rows(&mut self, to: isize, source: &Operand, from: isize, count: usize) {
        let (grid, other) = (self.grid, source.grid);
        assert_eq!((self.shape.with_size(0, 0), self.shape.n), (source.shape.with_size(0, 0), 1));
        assert!(!grid.split && !other.split);
        grid.copy_rows((self.body_mut(), to), *other, (source.body(), from), count);
    }

    /// Every plane, without the slack.
    fn body(&self) -> &[Wide] {
        &self.data[..self.shape.n * self.planes() * self.grid.positions()]
    }

    /// [`Operand::body`], to write.
    fn body_mut(&mut self) -> &mut [Wide] {
        let len = self.body().len();
        &mut self.data[..len]
    }

    /// Its extent.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// Planes of an image, phases included.
    fn planes(&self) -> usize {
        self.shape.c.div_ceil(WIDE) * self.grid.phases()
    }
}

/// Positions that one task narrows.
const PART: usize = 16384;

/// 2x2 maximum, stride 2, of an activation without negative values, such as a ReLU's output.
///
/// # Panics
/// If rows or columns are odd.
pub fn max_pool(input: &Operand) -> Operand {
    let s = input.shape;
    assert!(s.h.is_multiple_of(2) && s.w.is_multiple_of(2), "only even sizes halve");
    let mut output = Operand::new(s.with_size(s.h / 2, s.w / 2));
    let (from, to) = (input.grid, output.grid);
    output.body_mut().par_chunks_mut(to.positions()).enumerate().for_each(|(i, out)| {
        let plane = &input.data[i * from.positions()..][..from.positions()];
        for y in 0..to.h {
            let top = &plane[from.row(2 * y)..][..from.w];
            let bottom = &plane[from.row(2 * y + 1)..][..from.w];
            let squares = top.as_chunks::<2>().0.iter().zip(bottom.as_chunks::<2>().0);
            for (out, (top, bottom)) in out[to.row(y)..].iter_mut().zip(squares) {
                // The bits of non-negative values are ordered as the values are.
                let bits = |w: &Wide| w.0.map(bf16::to_bits);
                let [a, b, c, d] = [&top[0], &top[1], &bottom[0], &bottom[1]].map(bits);
                out.0 = std::array::from_fn(|l| bf16::from_bits(a[l].max(b[l]).max(c[l].max(d[l]))));
            }
        }
    });
    output
}

/// The two planes of 16 channels that make up plane `plane` of 32; the second may be absent.
fn halves<'a>(source: View<'a>, n: usize, plane: usize) -> (&'a [Block], Option<&'a [Block]>) {
    let s = source.shape;
    let blocks = |p: usize| &source.data[(n * s.planes() + p) * s.plane_stride()..][..s.plane_stride()];
    (blocks(2 * plane), (2 * plane + 1 < s.planes()).then(|| blocks(2 * plane + 1)))
}
