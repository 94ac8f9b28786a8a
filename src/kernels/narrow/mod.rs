//! Convolutions whose factors are narrower than f32 ([`Format`]) and whose sums are not. Memory traffic is a
//! half or a quarter of that in f32, and the arithmetic rate twice or four times that in f32, or 16 or 32
//! times where the processor multiplies matrix tiles (AMX).
//!
//! A [`Wide`] is 32 or 64 consecutive channels of one pixel. A plane of them is one long row of positions,
//! borders included, so that a tap is a fixed offset and a chunk of 32 positions may run over the end of a
//! row. What a chunk computes for border positions is dropped. So levels with few columns are as fast as
//! those with many, but where rows are cut into pieces, so that more threads have some. Where products are slow,
//! 3x3 convolutions are computed by cells of outputs, which need fewer products (`winograd.rs`).
//!
//! [`Engine`] holds all that depends on the processor: matrix products and conversions. Its portable form is
//! the oracle of the others.

mod band;
pub mod conv;
mod engine;
pub mod weight_grad;
mod winograd;

pub use engine::Engine;

use std::ops::Deref;

use half::bf16;
use rayon::prelude::*;

use super::{
    Block, LANES, Shape, View, ViewMut,
    conv::Geometry,
    layout::HalvedRow,
    memory::{Pool, Pooled},
    plane::Plane,
    simd::{Kernel, Simd, Tier},
    vectorised::{self, Vectorised},
};

/// What activations and weights are rounded to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Format {
    /// bfloat16: f32 with 8 bits of mantissa.
    Bf16,
    /// Eight bits. Activations count the given steps; weights have a sign and count steps whose size differs
    /// from output to output. Sums are exact.
    Int8(Steps),
}

/// The 256 values that an activation may have in 8 bits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Steps {
    /// The difference between neighbouring values.
    pub step: f32,
    /// Which of the 256 values is zero. It is the first where no activation is negative.
    pub zero: u8,
}

impl Steps {
    /// From zero to `largest`.
    pub const fn to(largest: f32) -> Self {
        Self { step: largest / ACTIVATION_STEPS, zero: 0 }
    }

    /// From `-largest` to `largest`.
    pub const fn within(largest: f32) -> Self {
        Self { step: 2.0 * largest / (ACTIVATION_STEPS - 1.0), zero: 128 }
    }
}

impl Format {
    /// Channels in a [`Wide`].
    pub const fn channels(self) -> usize {
        match self {
            Format::Bf16 => WIDE,
            Format::Int8(_) => 2 * WIDE,
        }
    }

    /// What borders hold: zero in this format.
    fn nothing(self) -> Wide {
        match self {
            Format::Bf16 => Wide::ZERO,
            Format::Int8(steps) => Wide([steps.zero; BYTES]),
        }
    }
}

/// Channels of a [`Wide`] in bfloat16. As many are computed at once in either format.
const WIDE: usize = 2 * LANES;

/// Bytes of a [`Wide`].
const BYTES: usize = 64;

/// Bytes of input channels that go with one row of weights (`WORD`). Where a plane does not use all its
/// channels, a product leaves out rows of weights in groups of `GROUP`.
const WORD: usize = 4;
const GROUP: usize = 4;

/// Largest weight in steps.
const WEIGHT_STEPS: f32 = 127.0;

/// The most that the weights of one sign of four channels may add up to, in steps, before they are rounded.
/// Rounding adds at most one step to each weight, and 128 times the largest activation is the most that 16
/// bits hold.
const FITTING_STEPS: f32 = 124.0 - 1e-4;

/// Largest activation in steps.
pub const ACTIVATION_STEPS: f32 = 255.0;

/// Positions for which one product computes the sums.
const CHUNK: usize = 32;

/// Sixty-four bytes, a row of a matrix tile: the channels of one pixel, or the weights of 16 outputs for the
/// channels of one `WORD`, output by output.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C, align(64))]
pub struct Wide([u8; BYTES]);

impl Wide {
    const ZERO: Wide = Wide([0; BYTES]);

    /// Value `i` in bfloat16.
    fn bf16(&self, i: usize) -> bf16 {
        bf16::from_ne_bytes([self.0[2 * i], self.0[2 * i + 1]])
    }

    /// Value `i` of 16 bits with a sign.
    fn i16(&self, i: usize) -> i16 {
        i16::from_ne_bytes([self.0[2 * i], self.0[2 * i + 1]])
    }

    /// Sets value `i` in bfloat16.
    fn set_bf16(&mut self, i: usize, value: bf16) {
        self.0[2 * i..][..2].copy_from_slice(&value.to_ne_bytes());
    }
}

/// One contribution to a sum: the input at position 0, and where its weights lie, in bytes from the first
/// weights of the output plane.
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

impl Default for Sums {
    fn default() -> Self {
        Self([[Block::default(); CHUNK]; 2])
    }
}

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

/// A plane of positions. It is `split` where a convolution takes steps of two: then the four pixels of each
/// quad lie in four planes (phases), each half as wide and half as high.
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

/// A narrow activation, which [`conv::convolve`] reads as its left factor, and can write.
#[derive(Debug)]
pub struct Operand {
    /// `[image][plane of 32 or 64 channels][phase][position]`, then slack.
    data: Pooled<Wide>,
    grid: Grid,
    shape: Shape,
    format: Format,
}

impl Operand {
    /// An activation with zero borders and arbitrary pixels.
    pub fn new(shape: Shape, format: Format) -> Self {
        let mut operand = Self::allocate(shape, Grid::new(shape, false), format);
        let grid = operand.grid;
        let body = operand.body_mut();
        body.par_chunks_mut(grid.positions()).for_each(|plane| grid.fill_border(plane, format.nothing()));
        operand
    }

    fn allocate(shape: Shape, grid: Grid, format: Format) -> Self {
        let planes = shape.c.div_ceil(format.channels()) * grid.phases();
        let body = shape.n.checked_mul(planes).and_then(|planes| planes.checked_mul(grid.positions()));
        let values = body.and_then(|body| body.checked_add(grid.slack()));
        let data = allocate(values.expect("an activation fits into memory"));
        Self { data, grid, shape, format }
    }

    /// An activation rounded to bfloat16. `geometry` is that of the convolution that reads it.
    pub fn narrow(engine: Engine, source: View, geometry: Geometry) -> Self {
        let shape = source.shape;
        let grid = Grid::new(shape, geometry == Geometry::Strided);
        let mut operand = Self::allocate(shape, grid, Format::Bf16);
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

    /// Planes rounded to a format. The four pixels of each 2x2 quad become channels of one pixel (space to
    /// depth): (N, C, H, W) -> (N, 4C, H/2, W/2)
    ///
    /// # Panics
    /// If rows or columns are odd, or there are not as many values as `planes` demands.
    pub fn halved(engine: Engine, format: Format, planes: Shape, values: &[f32]) -> Self {
        let shape = planes.quads();
        assert_eq!(values.len(), shape.n * shape.c * shape.h * shape.w, "values of all planes");
        let mut operand = Self::new(shape, format);
        let (planes, blocks) = (operand.planes(), format.channels() / LANES);
        operand.each_row(|plane, y, row| {
            let (image, first) = (plane / planes, plane % planes * blocks);
            for plane in (first..shape.planes().min(first + blocks)).step_by(WIDE / LANES) {
                let put = |x: usize, low: &[Block], high: Option<&[Block]>| {
                    let row = &mut row[x..][..low.len()];
                    match format {
                        Format::Bf16 => engine.narrow(low, high, row),
                        Format::Int8(steps) => {
                            let lane = (plane - first) * LANES;
                            quantize(steps, low, row, lane);
                            high.into_iter().for_each(|high| quantize(steps, high, row, lane + LANES));
                        }
                    }
                };
                Tier::detect().run(HalvedRow { shape, values, at: (image, plane, y), put });
            }
        });
        operand
    }

    /// An activation in 8 bits.
    pub fn quantize(source: View, steps: Steps) -> Self {
        let shape = source.shape;
        let mut operand = Self::new(shape, Format::Int8(steps));
        let planes = operand.planes();
        let blocks = operand.format.channels() / LANES;
        operand.each_row(|plane, y, row| {
            let (image, first) = (plane / planes, plane % planes * blocks);
            for plane in first..shape.planes().min(first + blocks) {
                let blocks = &source.data[shape.row(image, plane, y)..][..shape.w];
                quantize(steps, blocks, row, (plane - first) * LANES);
            }
        });
        operand
    }

    /// Writes the values as f32 into an activation of the same shape. Borders are written too.
    ///
    /// # Panics
    /// If shapes differ.
    pub fn widen(&self, output: ViewMut) {
        assert_eq!(output.shape, self.shape);
        let (s, stride) = (self.shape, self.shape.plane_stride());
        let blocks = self.format.channels() / LANES;
        output.data.par_chunks_mut(stride).enumerate().for_each(|(i, out)| {
            let (n, plane) = (i / s.planes(), i % s.planes());
            let from = &self.data[(n * self.planes() + plane / blocks) * stride..][..stride];
            let first = plane % blocks * LANES;
            for (out, wide) in out.iter_mut().zip(from) {
                out.0 = std::array::from_fn(|l| match self.format {
                    Format::Bf16 => wide.bf16(first + l).to_f32(),
                    Format::Int8(Steps { step, zero }) => {
                        f32::from(i16::from(wide.0[first + l]) - i16::from(zero)) * step
                    }
                });
            }
        });
    }

    /// Copies `count` rows of another activation of the same width and channels, from its row `from` on, to
    /// row `to` on. Rows -1 and H lie in the border. They may be copied where the activation is a part of a
    /// taller one, whose rows the border then holds.
    ///
    /// # Panics
    /// If the two do not fit together, or hold several images.
    pub fn copy_rows(&mut self, to: isize, source: &Operand, from: isize, count: usize) {
        let (grid, other) = (self.grid, source.grid);
        assert_eq!((self.shape.with_size(0, 0), self.shape.n), (source.shape.with_size(0, 0), 1));
        assert!(!grid.split && !other.split && self.format == source.format);
        grid.copy_rows((self.body_mut(), to), *other, (source.body(), from), count);
    }

    /// Every plane, without the slack.
    fn body(&self) -> &[Wide] {
        &self.data[..self.shape.n * self.planes() * self.grid.positions()]
    }

    /// [`Operand::body`], writable.
    fn body_mut(&mut self) -> &mut [Wide] {
        let len = self.body().len();
        &mut self.data[..len]
    }

    /// Runs `fill(plane, row's number, pixels of the row)` on the rows of all planes of all images.
    fn each_row(&mut self, fill: impl Fn(usize, usize, &mut [Wide]) + Sync) {
        let Plane { h, w, pad } = self.grid.plane;
        let stride = self.grid.stride();
        let rows = self.body_mut().par_chunks_mut(stride).enumerate();
        rows.for_each(|(i, row)| {
            let (plane, y) = (i / (h + 2 * pad), i % (h + 2 * pad));
            if (pad..pad + h).contains(&y) {
                fill(plane, y - pad, &mut row[pad..pad + w]);
            }
        });
    }

    /// Its extent.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// What its values are rounded to.
    pub fn format(&self) -> Format {
        self.format
    }

    /// Planes of an image, phases included.
    fn planes(&self) -> usize {
        self.shape.c.div_ceil(self.format.channels()) * self.grid.phases()
    }
}

impl Format {
    /// The larger of each two values, none of which is negative.
    #[inline(always)]
    fn max(self, a: &Wide, b: &Wide) -> Wide {
        match self {
            // The bits of non-negative values are ordered as the values are.
            Format::Bf16 => {
                let [a, b] = [a, b].map(|w| w.0.as_chunks::<2>().0);
                let mut max = Wide::ZERO;
                for (max, (a, b)) in max.0.as_chunks_mut::<2>().0.iter_mut().zip(a.iter().zip(b)) {
                    *max = u16::from_ne_bytes(*a).max(u16::from_ne_bytes(*b)).to_ne_bytes();
                }
                max
            }
            Format::Int8(_) => Wide(std::array::from_fn(|i| a.0[i].max(b.0[i]))),
        }
    }
}

/// Writes each block, counted in steps, to the 16 bytes from `lane` on of one value of `out`.
fn quantize(steps: Steps, blocks: &[Block], out: &mut [Wide], lane: usize) {
    Tier::detect().run(Quantize { blocks, steps, out, lane });
}

/// See [`quantize`].
struct Quantize<'a> {
    blocks: &'a [Block],
    steps: Steps,
    out: &'a mut [Wide],
    lane: usize,
}

impl Kernel for Quantize<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Steps { step, zero } = self.steps;
        for (out, block) in self.out.iter_mut().zip(self.blocks) {
            let steps = simd.fma(simd.get(block), simd.splat(step.recip()), simd.splat(zero.into()));
            let bytes = simd.bytes(simd.max(steps, simd.splat(0.0)));
            out.0[self.lane..][..LANES].copy_from_slice(&bytes);
        }
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
    let mut output = Operand::new(s.with_size(s.h / 2, s.w / 2), input.format);
    let (from, format) = (input.grid, input.format);
    output.each_row(|plane, y, row| {
        let plane = &input.data[plane * from.positions()..][..from.positions()];
        let top = &plane[from.row(2 * y)..][..from.w];
        let bottom = &plane[from.row(2 * y + 1)..][..from.w];
        vectorised::run(PoolRow { format, top, bottom, row });
    });
    output
}

/// The maxima of the 2x2 quads of two rows.
struct PoolRow<'a> {
    format: Format,
    top: &'a [Wide],
    bottom: &'a [Wide],
    row: &'a mut [Wide],
}

impl Vectorised for PoolRow<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { format, top, bottom, row } = self;
        let quads = top.as_chunks::<2>().0.iter().zip(bottom.as_chunks::<2>().0);
        for (out, (top, bottom)) in row.iter_mut().zip(quads) {
            *out = format.max(&format.max(&top[0], &top[1]), &format.max(&bottom[0], &bottom[1]));
        }
    }
}

/// The two planes of 16 channels that make up 32 channels of a source; the second may be absent.
fn halves<'a>(source: View<'a>, n: usize, plane: usize) -> (&'a [Block], Option<&'a [Block]>) {
    let s = source.shape;
    let blocks = |p: usize| &source.data[(n * s.planes() + p) * s.plane_stride()..][..s.plane_stride()];
    (blocks(2 * plane), (2 * plane + 1 < s.planes()).then(|| blocks(2 * plane + 1)))
}
