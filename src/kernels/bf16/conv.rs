//! Convolutions and input gradients in bfloat16, the geometries of [`crate::kernels::conv`].
//!
//! Packed weights are `[output plane][phase][term][16 pairs of input channels]`, each row holding the two
//! channels' weights of 16 outputs side by side; terms follow the planes of the operands, then taps.

use half::bf16;
use rayon::prelude::*;

use super::{CHUNK, EIGHTH, Engine, Grid, LANES, Operand, Sums, Term, WIDE, Wide};
use crate::kernels::{
    Block, Shape, Shared, ViewMut,
    conv::{Direction, Epilogue, Geometry, weight_index},
    simd::{Kernel, Simd, Tier},
};

/// One tap of one output phase: the phase of the input it reads, its offset there, and its place in the
/// unpacked kernel.
#[derive(Clone, Copy)]
struct Tap {
    phase: usize,
    dy: isize,
    dx: isize,
    index: usize,
}

/// Output phases along each axis.
fn spread(geometry: Geometry) -> usize {
    if geometry == Geometry::Transposed { 2 } else { 1 }
}

/// The taps of output phase `(py, px)`, those of the first input phase first.
fn taps(geometry: Geometry, (py, px): (usize, usize)) -> Vec<Tap> {
    let signed = |v: usize| isize::try_from(v).expect("kernels are small");
    match geometry {
        Geometry::Same(k) => (0..k * k)
            .map(|t| Tap {
                phase: 0,
                dy: signed(t / k) - signed(k / 2),
                dx: signed(t % k) - signed(k / 2),
                index: t,
            })
            .collect(),
        // out[2m + p] = sum over k in {1, 3} (p = 0) or {0, 2} (p = 1) of w[k] in[m + (p + 1 - k) / 2].
        Geometry::Transposed => (0..4)
            .map(|t| {
                let (ky, kx) = (1 - py + 2 * (t / 2), 1 - px + 2 * (t % 2));
                let shift = |p: usize, k: usize| (signed(p) + 1 - signed(k)) / 2;
                Tap { phase: 0, dy: shift(py, ky), dx: shift(px, kx), index: 4 * ky + kx }
            })
            .collect(),
        // out[m] = sum over k of w[k] in[2m + k - 1]: pixel (k - 1) mod 2 of the square at m + (k - 1) div 2.
        Geometry::Strided => {
            let mut taps: Vec<Tap> = (0..16)
                .map(|t| {
                    let (ky, kx) = (signed(t / 4) - 1, signed(t % 4) - 1);
                    let phase = (2 * ky.rem_euclid(2) + kx.rem_euclid(2)).unsigned_abs();
                    Tap { phase, dy: ky.div_euclid(2), dx: kx.div_euclid(2), index: t }
                })
                .collect();
            taps.sort_by_key(|t| t.phase);
            taps
        }
    }
}

/// The terms of a phase over all planes of an operand: `(plane without phase, tap)`.
fn terms(geometry: Geometry, planes: usize, phase: (usize, usize)) -> Vec<(usize, Tap)> {
    let taps = taps(geometry, phase);
    (0..planes).flat_map(|plane| taps.iter().map(move |&tap| (plane, tap))).collect()
}

/// A layer's weights, rounded and packed for one direction.
#[derive(Debug)]
pub struct Weights {
    rows: Vec<Wide>,
    /// How much of its plane each term of a phase reads; the same for every phase.
    eighths: Vec<u8>,
    geometry: Geometry,
    /// Channels of every source read.
    inputs: Vec<usize>,
    outputs: usize,
}

impl Weights {
    /// Packs the weights of a layer whose input channels come from `inputs` sources one after another; see
    /// [`crate::kernels::conv::pack`], whose arguments these are.
    ///
    /// # Panics
    /// If `weights` has the wrong length.
    pub fn pack(
        weights: &[f32],
        inputs: &[usize],
        outputs: usize,
        geometry: Geometry,
        direction: Direction,
        source: usize,
    ) -> Self {
        let total: usize = inputs.iter().sum();
        let taps = geometry.taps();
        assert_eq!(weights.len(), total * outputs * taps);
        let first: usize = inputs[..source].iter().sum();
        match direction {
            Direction::Forward => Self::build(geometry, inputs.to_vec(), outputs, |o, i, t| {
                weights[weight_index(geometry, outputs, total, o, i, t)]
            }),
            Direction::Backward => {
                Self::build(geometry.backward(), vec![outputs], inputs[source], |o, i, t| {
                    // Mirrored for a stride-1 convolution; a strided read visits the taps in order.
                    let t = if matches!(geometry, Geometry::Same(_)) { taps - 1 - t } else { t };
                    weights[weight_index(geometry, outputs, total, i, first + o, t)]
                })
            }
        }
    }

    /// Fills the rows from `weight(output, input, tap)`.
    fn build(
        geometry: Geometry,
        inputs: Vec<usize>,
        outputs: usize,
        weight: impl Fn(usize, usize, usize) -> f32 + Sync,
    ) -> Self {
        // First channel and number of channels of every plane of 32.
        let mut first = 0;
        let planes: Vec<(usize, usize)> = inputs
            .iter()
            .flat_map(|&c| {
                let base = first;
                first += c;
                (0..c.div_ceil(WIDE)).map(move |p| (base + p * WIDE, (c - p * WIDE).min(WIDE)))
            })
            .collect();
        let spread = spread(geometry);
        let terms: Vec<(usize, Tap)> = (0..spread * spread)
            .flat_map(|phase| terms(geometry, planes.len(), (phase / spread, phase % spread)))
            .collect();
        let mut rows = vec![Wide::ZERO; outputs.div_ceil(LANES) * terms.len() * LANES];
        rows.par_chunks_mut(terms.len() * LANES).enumerate().for_each(|(plane, rows)| {
            let lanes = (outputs - plane * LANES).min(LANES);
            for (rows, &(input, tap)) in rows.chunks_mut(LANES).zip(&terms) {
                let (base, channels) = planes[input];
                for i in 0..channels {
                    for l in 0..lanes {
                        let value = weight(plane * LANES + l, base + i, tap.index);
                        rows[i / 2].0[2 * l + i % 2] = bf16::from_f32(value);
                    }
                }
            }
        });
        let of_phase = &terms[..terms.len() / (spread * spread)];
        let eighths = of_phase.iter().map(|&(input, _)| planes[input].1.div_ceil(EIGHTH) as u8).collect();
        Self { rows, eighths, geometry, inputs, outputs }
    }
}

/// Where a convolution writes.
pub enum Output<'a> {
    /// To an f32 activation.
    F32(ViewMut<'a>),
    /// To a bfloat16 one, without adding to it; its upper half-plane becomes zero where it has no channels.
    Bf16(&'a mut Operand),
}

impl Output<'_> {
    fn shape(&self) -> Shape {
        match self {
            Output::F32(view) => view.shape,
            Output::Bf16(operand) => operand.shape,
        }
    }
}

/// `output = epilogue(bias + conv(sources, weights))`, or `output += ...` when accumulating; `bias` is one
/// block an output plane (ignored when accumulating).
///
/// # Panics
/// If sizes, borders or lengths do not fit together.
pub fn convolve(
    engine: Engine,
    sources: &[&Operand],
    weights: &Weights,
    bias: &[Block],
    epilogue: Epilogue,
    output: Output,
) {
    let (grid, out) = (sources[0].grid, output.shape());
    let geometry = weights.geometry;
    let spread = spread(geometry);
    assert!(sources.iter().all(|s| s.grid == grid && s.shape.n == out.n), "sources differ in size");
    assert!(
        sources.iter().map(|s| s.shape.c).eq(weights.inputs.iter().copied()),
        "sources differ in channels"
    );
    assert_eq!(grid.split, geometry == Geometry::Strided);
    assert_eq!((out.h, out.w, out.c), (spread * grid.h, spread * grid.w, weights.outputs));
    assert!(epilogue.accumulate || bias.len() == out.planes());
    assert!(grid.pad >= geometry.reach(), "border too small for {geometry:?}");

    // Every plane of every source: its first position in image 0, and planes from one image to the next.
    let planes: Vec<(*const Wide, usize)> = sources
        .iter()
        .flat_map(|source| {
            let first = source.data.as_ptr();
            let step = grid.phases() * grid.positions();
            (0..source.planes() / grid.phases()).map(move |p| (first.wrapping_add(p * step), source.planes()))
        })
        .collect();
    let terms = |n: usize, phase: usize| -> Vec<Term> {
        let signed = |v: usize| isize::try_from(v).expect("buffers fit in memory");
        let place = |(i, (plane, tap)): (usize, (usize, Tap))| {
            let (first, step): (*const Wide, usize) = planes[plane];
            let at =
                signed((n * step + tap.phase) * grid.positions()) + tap.dy * signed(grid.stride()) + tap.dx;
            Term { input: first.wrapping_offset(at), weights: i * LANES * size_of::<Wide>() }
        };
        terms(geometry, planes.len(), (phase / spread, phase % spread))
            .into_iter()
            .enumerate()
            .map(place)
            .collect()
    };
    let phases: Vec<Vec<Vec<Term>>> =
        (0..out.n).map(|n| (0..spread * spread).map(|phase| terms(n, phase)).collect()).collect();
    // Bands of rows keep every thread busy and their input in the second-level cache.
    let bands = (16 / out.n.max(1)).max(grid.h * grid.w / 4096).clamp(1, grid.h);
    let band = grid.h.div_ceil(bands);
    let bands = grid.h.div_ceil(band);
    let target = match output {
        Output::F32(view) => {
            assert_eq!(view.data.len(), out.blocks());
            Target::F32(Shared(view.data.as_mut_ptr()))
        }
        Output::Bf16(operand) => {
            assert!(!epilogue.accumulate && !operand.grid.split);
            Target::Bf16(SharedWide(operand.data.as_mut_ptr()), operand.grid)
        }
    };
    let tier = Tier::detect();
    (0..out.n * bands).into_par_iter().for_each(|task| {
        let y0 = task % bands * band;
        let rows = (y0, grid.h.min(y0 + band));
        let n = task / bands;
        engine.ready(|| {
            tier.run(Band {
                engine,
                grid,
                weights,
                bias,
                epilogue,
                phases: &phases[n],
                out,
                target,
                n,
                rows,
            });
        });
    });
}

/// A pointer that tasks share to write disjoint rows of one operand.
#[derive(Clone, Copy)]
struct SharedWide(*mut Wide);

// SAFETY: every task writes its own rows, so no two ever touch the same value.
unsafe impl Send for SharedWide {}
// SAFETY: as above.
unsafe impl Sync for SharedWide {}

#[derive(Clone, Copy)]
enum Target {
    F32(Shared),
    Bf16(SharedWide, Grid),
}

/// The work of one task: some rows of all output planes of one image.
struct Band<'a> {
    engine: Engine,
    grid: Grid,
    weights: &'a Weights,
    bias: &'a [Block],
    epilogue: Epilogue,
    phases: &'a [Vec<Term>],
    out: Shape,
    target: Target,
    n: usize,
    rows: (usize, usize),
}

impl Kernel for Band<'_> {
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let grid = self.grid;
        let (first, end) = (grid.row(self.rows.0), grid.row(self.rows.1 - 1) + grid.w);
        let phase_rows = self.phases[0].len() * LANES;
        let plane_rows = self.phases.len() * phase_rows;
        let mut sums = Sums([[Block::default(); CHUNK]; 2]);
        for plane in (0..self.out.planes()).step_by(2) {
            let outputs = (self.out.planes() - plane).min(2);
            for (phase, terms) in self.phases.iter().enumerate() {
                let weights = self.weights.rows[plane * plane_rows + phase * phase_rows..].as_ptr();
                for position in (first..end).step_by(CHUNK) {
                    // SAFETY: `convolve` made the terms from operands whose borders and slack cover their
                    // reach, and runs this inside `ready`; tasks own disjoint rows.
                    unsafe {
                        let terms = (&terms[..], &self.weights.eighths[..]);
                        self.engine.multiply(terms, position, weights, (outputs, plane_rows), &mut sums);
                        self.store::<S>(
                            &mut sums,
                            (plane, outputs),
                            phase,
                            (position, end.min(position + CHUNK)),
                        );
                    }
                }
            }
        }
    }
}

impl Band<'_> {
    /// Finishes the sums of positions `from..end` and stores those that are pixels.
    #[inline(always)]
    unsafe fn store<S: Simd>(
        &self,
        sums: &mut Sums,
        (plane, outputs): (usize, usize),
        phase: usize,
        (from, end): (usize, usize),
    ) {
        let (grid, spread) = (self.grid, spread(self.weights.geometry));
        let Epilogue { relu, accumulate } = self.epilogue;
        let mut position = from;
        while position < end {
            let (y, x) = (position / grid.stride() - grid.pad, position % grid.stride());
            // Positions run from the left border, over the pixels, to the right border.
            let skip = grid.pad.saturating_sub(x);
            let run =
                (grid.pad + grid.w).saturating_sub(x.max(grid.pad)).min(end.saturating_sub(position + skip));
            let (first, column) = (position + skip - from, x + skip - grid.pad);
            let row = y * spread + phase / spread;
            for o in 0..outputs {
                // SAFETY: vectors are the tier's.
                let bias = unsafe { if accumulate { S::splat(0.0) } else { S::load(&self.bias[plane + o]) } };
                let finish = |sum: &Block, old: S::V| {
                    // SAFETY: vectors are the tier's.
                    unsafe {
                        let value = S::add(S::load(sum), old);
                        if relu { S::max(value, S::splat(0.0)) } else { value }
                    }
                };
                match self.target {
                    // SAFETY: the pixels lie inside the row, which is this task's.
                    Target::F32(blocks) => unsafe {
                        let row = self.out.row(self.n, plane + o, row) + phase % spread;
                        for i in 0..run {
                            let block = blocks.at(row + (column + i) * spread);
                            let old = if accumulate { S::load(block) } else { bias };
                            S::store(block, finish(&sums.0[o][first + i], old));
                        }
                    },
                    // SAFETY: a sum is a block of its own.
                    Target::Bf16(..) => unsafe {
                        for sum in &mut sums.0[o][first..first + run] {
                            let value = finish(sum, bias);
                            S::store(sum, value);
                        }
                    },
                }
            }
            if let Target::Bf16(wides, grid) = self.target {
                let [low, high] = &sums.0;
                let high = (outputs == 2).then(|| &high[first..first + run]);
                let plane = self.n * self.out.c.div_ceil(WIDE) + plane / 2;
                let start = plane * grid.positions() + grid.row(row) + phase % spread;
                // SAFETY: as above.
                unsafe {
                    let at = wides.0.add(start + column * spread);
                    self.engine.narrow_spread(&low[first..first + run], high, at, spread);
                }
            }
            position += (skip + run).max(1);
        }
    }
}
