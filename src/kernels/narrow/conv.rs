//! Convolutions and input gradients of narrow factors, the geometries of [`crate::kernels::conv`].
//!
//! Packed weights are `[output plane][phase][term][16 rows]`, each row holding the weights of 16 outputs for
//! two (bfloat16) or four (8 bits) input channels side by side. Terms are ordered by plane of the operands,
//! then by tap. Where cells of outputs are computed together, weights are packed as `winograd::pack` says.

use std::ops::Range;

use half::bf16;
use rayon::prelude::*;

use super::{
    Engine, FITTING_STEPS, Format, GROUP, LANES, Operand, Steps, Term, WEIGHT_STEPS, WORD, Wide,
    band::{Band, SharedWide, Target},
    engine::CELLS,
    winograd::{self, Cells, FITTING_SUM, Part},
};
use crate::kernels::{
    Block, Shape, Shared, ViewMut,
    conv::{self, Direction, Epilogue, Geometry, weight_index},
    layout::Unpacked,
    simd::Tier,
    winograd::SIDE,
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

/// The taps of an output phase, those of the first input phase first.
fn taps_of(geometry: Geometry, phase: usize) -> Vec<Tap> {
    // With steps of two, the input at 2m + d is pixel d mod 2 of the quad at m + d div 2.
    let step = if geometry == Geometry::Strided { 2 } else { 1 };
    let of_phase = |tap: conv::Tap| Tap {
        phase: (step * tap.dy.rem_euclid(step) + tap.dx.rem_euclid(step)).unsigned_abs(),
        dy: tap.dy.div_euclid(step),
        dx: tap.dx.div_euclid(step),
        index: tap.index,
    };
    let mut taps: Vec<Tap> = geometry.taps_of(phase).into_iter().map(of_phase).collect();
    taps.sort_by_key(|tap| tap.phase);
    taps
}

/// The terms of a phase over all planes of an operand: `(plane without phase, tap)`.
fn terms(geometry: Geometry, planes: usize, phase: usize) -> Vec<(usize, Tap)> {
    let taps = taps_of(geometry, phase);
    (0..planes).flat_map(|plane| taps.iter().map(move |&tap| (plane, tap))).collect()
}

/// A layer's weights, rounded and packed for one direction.
#[derive(Debug)]
pub struct Weights {
    pub(super) rows: Vec<Wide>,
    /// Groups of rows that each term of a phase, or each part, needs; the same for every phase.
    pub(super) groups: Vec<u8>,
    /// The parts of the sources where cells of outputs are computed together; empty where outputs are
    /// computed tap by tap.
    parts: Vec<Part>,
    /// Whether sums of four products in 8 bits fit into 16.
    fit_16_bits: bool,
    geometry: Geometry,
    /// Channels and format of every source read.
    inputs: Vec<(usize, Format)>,
    outputs: usize,
    /// What sums are multiplied by, a block an output plane.
    scale: Vec<Block>,
    /// What is added to sums after that. An activation of zero counts [`Steps::zero`] steps, which make sums
    /// too large, and this makes up for it.
    shift: Vec<Block>,
}

/// A plane of an operand among the inputs of a layer.
#[derive(Clone, Copy)]
struct Channels {
    first: usize,
    count: usize,
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
        let bf16 = |channels: &usize| (*channels, Format::Bf16);
        match direction {
            Direction::Forward => {
                Self::build(geometry, inputs.iter().map(bf16).collect(), outputs, |o, i, t| {
                    weights[weight_index(geometry, outputs, total, o, i, t)]
                })
            }
            Direction::Backward => {
                Self::build(geometry.backward(), vec![bf16(&outputs)], inputs[source], |o, i, t| {
                    // Mirrored for a stride-1 convolution; a strided read visits the taps in order.
                    let t = if matches!(geometry, Geometry::Same(_)) { taps - 1 - t } else { t };
                    weights[weight_index(geometry, outputs, total, i, first + o, t)]
                })
            }
        }
    }

    /// Rounds the weights of a layer to 8 bits and packs them for an engine. Of each source the number of
    /// channels and the [`Steps`] of its values are given. The size of these steps becomes part of the
    /// weights. Each output then has a step of its own for its weights, as fine as the largest of them allow.
    ///
    /// # Panics
    /// If `weights` has the wrong length, or a source of a transposed layer has negative values: each phase
    /// would then need a shift of its own.
    pub fn quantize(
        engine: Engine,
        weights: &[f32],
        sources: &[(usize, Steps)],
        outputs: usize,
        geometry: Geometry,
    ) -> Self {
        let taps = geometry.taps();
        let channels = sources.iter().flat_map(|&(channels, steps)| (0..channels).map(move |_| steps));
        let channels: Vec<Steps> = channels.collect();
        let total = channels.len();
        assert_eq!(weights.len(), total * outputs * taps);
        let spread = geometry.spread();
        assert!(spread == 1 || channels.iter().all(|steps| steps.zero == 0), "phases have sums of their own");
        let phases: Vec<Vec<Tap>> = (0..spread * spread).map(|phase| taps_of(geometry, phase)).collect();
        let in_16_bits = engine.adds_in_16_bits(geometry);
        let pairs = row_pairs(sources);
        let mut rounded = vec![0.0; weights.len()];
        let of_outputs = rounded.par_chunks_exact_mut(total * taps).enumerate().map(|(o, of_output)| {
            for (i, (of_channel, steps)) in of_output.chunks_exact_mut(taps).zip(&channels).enumerate() {
                for (t, value) in of_channel.iter_mut().enumerate() {
                    *value = weights[weight_index(geometry, outputs, total, o, i, t)] * steps.step;
                }
            }
            let largest = of_output.iter().fold(0.0f32, |largest, weight| largest.max(weight.abs()));
            let mut step = (largest / WEIGHT_STEPS).max(f32::MIN_POSITIVE);
            if in_16_bits {
                for (pair, t) in pairs.iter().flat_map(|pair| (0..taps).map(move |t| (pair, t))) {
                    step = step.max(step_of_sums(pair.clone().map(|i| of_output[i * taps + t])));
                }
            }
            for sign in [1.0, -1.0] {
                let sum: f32 = of_output.iter().map(|value| (sign * value).max(0.0)).sum();
                step = step.max(sum / FITTING_SUM);
            }
            let mut excess = 0.0;
            for (of_channel, steps) in of_output.chunks_exact_mut(taps).zip(&channels) {
                of_channel.iter_mut().for_each(|value| *value /= step);
                phases.iter().for_each(|taps| round(taps, of_channel));
                excess += of_channel.iter().sum::<f32>() * f32::from(steps.zero);
            }
            (step, -excess * step)
        });
        let [mut scale, mut shift] = [(); 2].map(|()| vec![Block::default(); outputs.div_ceil(LANES)]);
        for (o, of_output) in of_outputs.collect::<Vec<_>>().into_iter().enumerate() {
            (scale[o / LANES].0[o % LANES], shift[o / LANES].0[o % LANES]) = of_output;
        }
        let inputs = sources.iter().map(|&(channels, steps)| (channels, Format::Int8(steps))).collect();
        if engine.prefers_winograd(geometry) {
            let parts = winograd::parts(sources.iter().map(|(channels, _)| *channels));
            let kernel = |o: usize, i: usize| {
                let of_channel = &rounded[(o * total + i) * taps..];
                std::array::from_fn(|t| of_channel[t] as i16)
            };
            let (rows, groups) = (winograd::pack(&parts, outputs, kernel), winograd::groups(&parts));
            return Self {
                rows,
                groups,
                parts,
                fit_16_bits: in_16_bits,
                geometry,
                inputs,
                outputs,
                scale,
                shift,
            };
        }
        let packed = Self::build(geometry, inputs, outputs, |o, i, t| rounded[(o * total + i) * taps + t]);
        Self { fit_16_bits: in_16_bits, scale, shift, ..packed }
    }

    /// Fills the rows from `weight(output, input, tap)`, which in 8 bits is a whole number of steps.
    fn build(
        geometry: Geometry,
        inputs: Vec<(usize, Format)>,
        outputs: usize,
        weight: impl Fn(usize, usize, usize) -> f32 + Sync,
    ) -> Self {
        let mut first = 0;
        let planes: Vec<Channels> = inputs
            .iter()
            .flat_map(|&(channels, format)| {
                let (base, wide) = (first, format.channels());
                first += channels;
                (0..channels.div_ceil(wide))
                    .map(move |p| Channels { first: base + p * wide, count: (channels - p * wide).min(wide) })
            })
            .collect();
        let format = inputs[0].1;
        // Channels of a row of weights.
        let side = WORD * format.channels() / size_of::<Wide>();
        let spread = geometry.spread();
        let terms: Vec<(usize, Tap)> =
            (0..spread * spread).flat_map(|phase| terms(geometry, planes.len(), phase)).collect();
        let mut rows = vec![Wide::ZERO; outputs.div_ceil(LANES) * terms.len() * LANES];
        rows.par_chunks_mut(terms.len() * LANES).enumerate().for_each(|(plane, rows)| {
            let lanes = (outputs - plane * LANES).min(LANES);
            for (rows, &(input, tap)) in rows.chunks_mut(LANES).zip(&terms) {
                let Channels { first, count } = planes[input];
                for i in 0..count {
                    for l in 0..lanes {
                        let value = weight(plane * LANES + l, first + i, tap.index);
                        let (row, at) = (&mut rows[i / side], side * l + i % side);
                        match format {
                            Format::Bf16 => row.set_bf16(at, bf16::from_f32(value)),
                            Format::Int8(_) => row.0[at] = (value as i8).to_ne_bytes()[0],
                        }
                    }
                }
            }
        });
        let of_phase = &terms[..terms.len() / (spread * spread)];
        let groups =
            of_phase.iter().map(|&(input, _)| planes[input].count.div_ceil(side * GROUP) as u8).collect();
        let scale = vec![Block([1.0; LANES]); outputs.div_ceil(LANES)];
        let shift = vec![Block::default(); scale.len()];
        Self { rows, groups, parts: Vec::new(), fit_16_bits: false, geometry, inputs, outputs, scale, shift }
    }

    /// What each source is to be rounded to.
    pub fn formats(&self) -> impl Iterator<Item = Format> {
        self.inputs.iter().map(|(_, format)| *format)
    }
}

/// The channels of each pair of rows of weights. No pair has channels of two sources.
fn row_pairs(sources: &[(usize, Steps)]) -> Vec<Range<usize>> {
    let mut end = 0;
    let mut pairs = Vec::new();
    for (channels, _) in sources {
        let first = end;
        end += channels;
        pairs.extend((first..end).step_by(2 * WORD).map(|at| at..end.min(at + 2 * WORD)));
    }
    pairs
}

/// The finest step that the weights of the channels of two rows, or of fewer, allow where their products are first
/// added up in 16 bits.
fn step_of_sums(channels: impl Iterator<Item = f32>) -> f32 {
    // One sum for the first two channels of each row and one for the other two, and each for either sign.
    let mut sums = [[0.0f32; 2]; WORD / 2];
    for (i, weight) in channels.enumerate() {
        sums[i % WORD / 2][usize::from(weight < 0.0)] += weight.abs();
    }
    sums.as_flattened().iter().fold(0.0, |least, sum| least.max(sum / FITTING_STEPS))
}

/// Rounds a channel's weights at some taps to whole steps. The rounding error of a tap is added to the next
/// one, since neighbouring pixels differ little.
fn round(taps: &[Tap], weights: &mut [f32]) {
    let mut lost = 0.0;
    for tap in taps {
        let wanted = weights[tap.index] + lost;
        let rounded = nearest(wanted).clamp(-WEIGHT_STEPS, WEIGHT_STEPS);
        weights[tap.index] = rounded;
        lost = wanted - rounded;
    }
}

/// The nearest whole number, of two the even one, of a value up to 2^22: the sum has no digits behind the point. The
/// standard library calls a function for each, as not every processor has an instruction for it.
#[inline(always)]
fn nearest(value: f32) -> f32 {
    const ROUND: f32 = 12_582_912.0;
    (value + ROUND) - ROUND
}

/// Where a convolution writes.
pub enum Output<'a> {
    /// To an f32 activation.
    F32(ViewMut<'a>),
    /// To a narrow one, without adding to it. Where it has only the lower 16 of 32 channels, the upper 16
    /// become zero. Only a ReLU's output goes into 8 bits.
    Narrow(&'a mut Operand),
    /// To planes, without adding to them: those of all channels of an activation of this shape, at `factor`
    /// times its size (see [`crate::kernels::layout`]).
    Planes {
        /// Shape of the activation.
        shape: Shape,
        /// 1, or 2 where four channels are the pixels of a quad.
        factor: usize,
        /// (N, C / factor^2, factor H, factor W).
        values: &'a mut [f32],
    },
}

impl Output<'_> {
    fn shape(&self) -> Shape {
        match self {
            Output::F32(view) => view.shape,
            Output::Narrow(operand) => operand.shape,
            Output::Planes { shape, .. } => *shape,
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
    let spread = geometry.spread();
    assert!(sources.iter().all(|s| s.grid == grid && s.shape.n == out.n), "sources differ in size");
    assert!(
        sources.iter().map(|s| (s.shape.c, s.format)).eq(weights.inputs.iter().copied()),
        "sources differ in channels or format"
    );
    assert_eq!(grid.split, geometry == Geometry::Strided);
    assert_eq!((out.h, out.w, out.c), (spread * grid.h, spread * grid.w, weights.outputs));
    assert!(epilogue.accumulate || bias.len() == out.planes());
    assert!(grid.pad >= geometry.reach(), "border too small for {geometry:?}");
    for (_, format) in &weights.inputs {
        if let Format::Int8(steps) = format {
            // Weights that were not made for Winograd's cells go tap by tap.
            let by_taps = weights.parts.is_empty() && engine.prefers_winograd(geometry);
            let fit = weights.fit_16_bits || !(by_taps || engine.adds_in_16_bits(geometry));
            assert!(fit, "weights are rounded for an engine with longer sums");
            assert!(steps.zero == 0 || !epilogue.accumulate, "no bias makes up for what is zero");
        }
    }

    // Every plane of every source: its position 0 in image 0, and planes from one image to the next.
    let planes: Vec<(*const Wide, usize)> = sources
        .iter()
        .flat_map(|source| {
            let first = source.data.as_ptr();
            let step = grid.phases() * grid.positions();
            (0..source.planes() / grid.phases()).map(move |p| (first.wrapping_add(p * step), source.planes()))
        })
        .collect();
    let places = |n: usize| -> Vec<Term> {
        let place = |&(first, step): &(*const Wide, usize)| first.wrapping_add(n * step * grid.positions());
        planes.iter().map(|plane| Term { input: place(plane), weights: 0 }).collect()
    };
    let terms = |n: usize, phase: usize| -> Vec<Term> {
        let signed = |v: usize| isize::try_from(v).expect("buffers fit in memory");
        let place = |(i, (plane, tap)): (usize, (usize, Tap))| {
            let (first, step): (*const Wide, usize) = planes[plane];
            let at =
                signed((n * step + tap.phase) * grid.positions()) + tap.dy * signed(grid.stride()) + tap.dx;
            Term { input: first.wrapping_offset(at), weights: i * LANES * size_of::<Wide>() }
        };
        terms(geometry, planes.len(), phase).into_iter().enumerate().map(place).collect()
    };
    let by_cells = !weights.parts.is_empty();
    let phases_of = |n: usize| -> Vec<Vec<Term>> {
        if by_cells { vec![places(n)] } else { (0..spread * spread).map(|phase| terms(n, phase)).collect() }
    };
    let phases: Vec<Vec<Vec<Term>>> = (0..out.n).map(phases_of).collect();
    // Bands of some 4096 pixels keep their input in the second-level cache. Where an image has too few rows for two tasks
    // a thread, its bands are cut into pieces from left to right, in steps of the columns that are computed at once.
    let tasks = (2 * rayon::current_num_threads()).div_ceil(out.n.max(1));
    let bands = tasks.max(16 / out.n.max(1)).max(grid.h * grid.w / 4096).clamp(1, grid.h);
    let band = grid.h.div_ceil(bands).next_multiple_of(if by_cells { SIDE } else { 1 });
    let bands = grid.h.div_ceil(band);
    let piece = grid.w.div_ceil(tasks.div_ceil(bands)).max(1).next_multiple_of(SIDE * CELLS);
    let pieces = grid.w.div_ceil(piece);
    let (target, step) = match output {
        Output::F32(view) => (Target::F32(Shared(view.data.as_mut_ptr())), 1.0),
        Output::Narrow(operand) => {
            assert!(!epilogue.accumulate && !operand.grid.split);
            let step = match operand.format {
                Format::Bf16 => 1.0,
                Format::Int8(Steps { step, zero }) => {
                    assert!(epilogue.relu && zero == 0, "layers write nothing negative in 8 bits");
                    step
                }
            };
            (Target::Narrow(SharedWide(operand.data.as_mut_ptr()), operand.grid, operand.format), step)
        }
        Output::Planes { shape, factor, values } => {
            assert!(!epilogue.accumulate && spread == 1);
            assert_eq!(values.len(), out.n * out.c * out.h * out.w, "planes of all channels");
            (Target::Planes(Unpacked::new(shape, 0, factor, values)), 1.0)
        }
    };
    // What is stored is a number of steps.
    let in_steps =
        |blocks: &[Block]| -> Vec<Block> { blocks.iter().map(|b| Block(b.0.map(|v| v / step))).collect() };
    let bias: Vec<Block> = (bias.iter().zip(&weights.shift))
        .map(|(bias, shift)| Block(std::array::from_fn(|l| bias.0[l] + shift.0[l])))
        .collect();
    let (scale, bias) = (in_steps(&weights.scale), in_steps(&bias));
    let tier = Tier::detect();
    (0..out.n * bands * pieces).into_par_iter().for_each(|task| {
        let (x0, y0, n) = (task % pieces * piece, task / pieces % bands * band, task / (pieces * bands));
        let band = Band {
            engine,
            grid,
            weights: &weights.rows,
            groups: &weights.groups,
            format: weights.inputs[0].1,
            spread,
            scale: &scale,
            bias: &bias,
            epilogue,
            phases: &phases[n],
            out,
            target,
            n,
            rows: (y0, grid.h.min(y0 + band)),
            columns: (x0, grid.w.min(x0 + piece)),
        };
        engine.ready(|| {
            if by_cells {
                tier.run(Cells { band, parts: &weights.parts });
            } else {
                tier.run(band);
            }
        });
    });
}
