//! Dense convolutions and their input gradients, all of them one register-tiled loop.
//!
//! Whatever the operation, an output pixel is a sum over taps, each of which is the input pixel at a fixed
//! offset times a 16x16 slab of weights. A k x k convolution has k*k taps; a transposed 4x4 convolution of
//! stride 2 is four interleaved output phases of 2x2 taps; its input gradient reads every second pixel
//! through 16 taps; a 1x1 fusion of several sources is a one-tap convolution whose input planes come from
//! several activations, so that nothing is ever concatenated.
//!
//! Packed weights are `[output plane][input plane][tap][16 input lanes]` blocks of 16 output lanes.

use rayon::prelude::*;

use super::{
    Block, LANES, Shape, Shared, View, ViewMut,
    simd::{Kernel, Simd, Tier},
};

/// What happens to the sum before it is stored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Epilogue {
    /// `max(0, .)`.
    pub relu: bool,
    /// Adds to what the output holds, instead of starting from the bias.
    pub accumulate: bool,
}

/// The geometry of a convolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Geometry {
    /// k x k, stride 1, "same" zero padding, for k of 1, 3 or 5; see [`Geometry::same`].
    Same(usize),
    /// Transposed 4x4, stride 2, padding 1: doubles rows and columns.
    Transposed,
    /// 4x4, stride 2, padding 1: halves rows and columns; the input gradient of [`Geometry::Transposed`].
    Strided,
}

impl Geometry {
    /// [`Geometry::Same`] for a kernel size that is supported.
    ///
    /// # Panics
    /// If `k` is not 1, 3 or 5.
    pub fn same(k: usize) -> Self {
        assert!(matches!(k, 1 | 3 | 5), "convolutions are 1x1, 3x3 or 5x5, not {k}x{k}");
        Self::Same(k)
    }

    /// Number of taps, which is also how many 16x16 slabs of weights a pair of an input and an output plane
    /// has.
    pub fn taps(self) -> usize {
        match self {
            Geometry::Same(k) => k * k,
            Geometry::Transposed | Geometry::Strided => 16,
        }
    }

    /// Rows and columns of the output for `h` x `w` of input.
    pub fn output(self, h: usize, w: usize) -> (usize, usize) {
        match self {
            Geometry::Same(_) => (h, w),
            Geometry::Transposed => (2 * h, 2 * w),
            Geometry::Strided => (h / 2, w / 2),
        }
    }

    /// The geometry of the input gradient.
    pub fn backward(self) -> Self {
        if self == Geometry::Transposed { Geometry::Strided } else { self }
    }

    /// Output phases along each axis.
    pub(super) fn spread(self) -> usize {
        if self == Geometry::Transposed { 2 } else { 1 }
    }

    /// The taps of an output phase.
    pub(super) fn taps_of(self, phase: usize) -> Vec<Tap> {
        let tap = |side: usize, centre: usize, t: usize| {
            let (ky, kx) = (t / side, t % side);
            Tap { dy: signed(ky) - signed(centre), dx: signed(kx) - signed(centre), index: t }
        };
        match self {
            Geometry::Same(k) => (0..k * k).map(|t| tap(k, k / 2, t)).collect(),
            Geometry::Strided => (0..16).map(|t| tap(4, 1, t)).collect(),
            // out[2m + p] = sum over k in {1, 3} (p = 0) or {0, 2} (p = 1) of w[k] in[m + (p + 1 - k) / 2].
            Geometry::Transposed => (0..4)
                .map(|t| {
                    let (py, px) = (phase / 2, phase % 2);
                    let (ky, kx) = (1 - py + 2 * (t / 2), 1 - px + 2 * (t % 2));
                    let shift = |p: usize, k: usize| (signed(p) + 1 - signed(k)) / 2;
                    Tap { dy: shift(py, ky), dx: shift(px, kx), index: 4 * ky + kx }
                })
                .collect(),
        }
    }

    /// The border an input needs so that no tap leaves it.
    pub(super) fn reach(self) -> usize {
        match self {
            Geometry::Same(k) => k / 2,
            Geometry::Transposed | Geometry::Strided => 1,
        }
    }
}

/// One tap of one output phase: the input pixel's offset from the output's place, and its place in the
/// unpacked kernel.
#[derive(Clone, Copy)]
pub(super) struct Tap {
    pub dy: isize,
    pub dx: isize,
    pub index: usize,
}

fn signed(v: usize) -> isize {
    isize::try_from(v).expect("buffers fit in memory")
}

/// Blocks that packed weights take.
///
/// # Panics
/// If there are more than memory could hold.
pub fn packed_len(inputs: &[usize], outputs: usize, geometry: Geometry) -> usize {
    let planes: usize = inputs.iter().map(|c| c.div_ceil(LANES)).sum();
    let pairs = outputs.div_ceil(LANES).checked_mul(planes);
    pairs.and_then(|pairs| pairs.checked_mul(geometry.taps() * LANES)).expect("weights fit into memory")
}

/// Which way weights are used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// From inputs to outputs.
    Forward,
    /// From output gradients to input gradients: channels swapped, taps mirrored.
    Backward,
}

/// Where the weight of (output, input, tap) lies in an unpacked tensor: convolutions are `(O, I, k, k)`,
/// transposed ones `(I, O, 4, 4)`, as is usual.
pub fn weight_index(
    geometry: Geometry,
    outputs: usize,
    inputs: usize,
    o: usize,
    i: usize,
    t: usize,
) -> usize {
    match geometry {
        Geometry::Same(_) => (o * inputs + i) * geometry.taps() + t,
        Geometry::Transposed | Geometry::Strided => (i * outputs + o) * geometry.taps() + t,
    }
}

/// Packs the weights of a layer whose input channels come from `inputs` sources one after another.
///
/// For [`Direction::Backward`] the result serves the gradient of source `source` alone: its outputs
/// are that source's channels and its single input is the layer's output.
///
/// # Panics
/// If `weights` or `packed` have the wrong length.
pub fn pack(
    weights: &[f32],
    inputs: &[usize],
    outputs: usize,
    geometry: Geometry,
    direction: Direction,
    source: usize,
    packed: &mut [Block],
) {
    let taps = geometry.taps();
    let total: usize = inputs.iter().sum();
    assert_eq!(weights.len(), total * outputs * taps);
    packed.fill(Block::default());
    let first: usize = inputs[..source].iter().sum();
    match direction {
        Direction::Forward => {
            assert_eq!(packed.len(), packed_len(inputs, outputs, geometry));
            let planes: usize = inputs.iter().map(|c| c.div_ceil(LANES)).sum();
            let (mut plane0, mut channel0) = (0, 0);
            for &c in inputs {
                for o in 0..outputs {
                    for i in 0..c {
                        let base = ((o / LANES) * planes + plane0 + i / LANES) * taps * LANES + i % LANES;
                        for t in 0..taps {
                            packed[base + t * LANES].0[o % LANES] =
                                weights[weight_index(geometry, outputs, total, o, channel0 + i, t)];
                        }
                    }
                }
                plane0 += c.div_ceil(LANES);
                channel0 += c;
            }
        }
        Direction::Backward => {
            let c = inputs[source];
            assert_eq!(packed.len(), packed_len(&[outputs], c, geometry));
            let planes = outputs.div_ceil(LANES);
            for o in 0..outputs {
                for i in 0..c {
                    let base = ((i / LANES) * planes + o / LANES) * taps * LANES + o % LANES;
                    for t in 0..taps {
                        // Mirrored for a stride-1 convolution; a strided read visits the taps in order.
                        let mirrored = if matches!(geometry, Geometry::Same(_)) { taps - 1 - t } else { t };
                        packed[base + mirrored * LANES].0[i % LANES] =
                            weights[weight_index(geometry, outputs, total, o, first + i, t)];
                    }
                }
            }
        }
    }
}

/// `output = epilogue(bias + conv(sources, weights))`, or `output += ...` when accumulating.
///
/// `sources` are the input channels one after another, each with the same size; `weights` come from
/// [`pack`]; `bias` is one block an output plane (ignored when accumulating).
///
/// # Panics
/// If sizes, borders or lengths do not fit together.
pub fn convolve(
    tier: Tier,
    sources: &[View],
    weights: &[Block],
    bias: &[Block],
    geometry: Geometry,
    epilogue: Epilogue,
    output: ViewMut,
) {
    let input = sources[0].shape;
    let channels: Vec<usize> = sources.iter().map(|s| s.shape.c).collect();
    for source in sources {
        let Shape { n, h, w, pad, .. } = source.shape;
        assert_eq!((n, h, w, pad), (input.n, input.h, input.w, input.pad), "sources differ");
        assert!(pad >= geometry.reach(), "border too small for {geometry:?}");
    }
    let out = output.shape;
    assert_eq!((out.n, (out.h, out.w)), (input.n, geometry.output(input.h, input.w)));
    assert_eq!(weights.len(), packed_len(&channels, out.c, geometry));
    assert!(epilogue.accumulate || bias.len() == out.planes());

    // Two output planes share every broadcast input where the tier has registers for both. Bands of
    // rows make enough tasks to keep every thread busy without cutting the rows themselves.
    let groups = out.planes().div_ceil(2);
    let rows = out.h / geometry.spread();
    let bands = (64 / (out.n * groups).max(1)).clamp(1, rows.div_ceil(2).max(1));
    let band = rows.div_ceil(bands).max(1);
    let bands = rows.div_ceil(band);
    let pointer = Shared(output.data.as_mut_ptr());
    (0..groups * out.n * bands).into_par_iter().for_each(|task| {
        let (group, rest) = (task / (out.n * bands), task % (out.n * bands));
        let (n, y0) = (rest / bands, rest % bands * band);
        tier.run(Band {
            sources,
            weights,
            bias,
            geometry,
            epilogue,
            out,
            pointer,
            n,
            planes: (2 * group, out.planes().min(2 * group + 2)),
            rows: (y0, rows.min(y0 + band)),
        });
    });
}

/// The work of one task: some rows of one or two output planes of one image.
struct Band<'a> {
    sources: &'a [View<'a>],
    weights: &'a [Block],
    bias: &'a [Block],
    geometry: Geometry,
    epilogue: Epilogue,
    out: Shape,
    pointer: Shared,
    n: usize,
    planes: (usize, usize),
    rows: (usize, usize),
}

/// A tap of the current phase: where the input pixel lies, in blocks from the output pixel's, and its slab of
/// weights.
#[derive(Clone, Copy)]
struct Offset {
    input: isize,
    slab: usize,
}

/// An input plane of the current row and how many of its lanes are in use.
#[derive(Clone, Copy)]
struct Plane {
    pixel: *const Block,
    lanes: usize,
}

impl Kernel for Band<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        // SAFETY: views are as long as their shapes say, and `convolve` checked all else, and that the
        // inputs' borders cover the taps' reach; tasks own disjoint rows of disjoint planes.
        unsafe {
            // Every geometry goes through one of two loops: each further call site would compile all
            // tile widths again.
            if self.geometry == Geometry::Strided {
                self.rows::<S, 2>(simd, &self.offsets(0), 1, (0, 0));
                return;
            }
            let spread = self.geometry.spread();
            for phase in 0..spread * spread {
                self.rows::<S, 1>(simd, &self.offsets(phase), spread, (phase / spread, phase % spread));
            }
        }
    }
}

impl Band<'_> {
    /// The taps of an output phase.
    fn offsets(&self, phase: usize) -> Vec<Offset> {
        let stride = signed(self.sources[0].shape.row_stride());
        let offset = |tap: Tap| Offset { input: tap.dy * stride + tap.dx, slab: tap.index * LANES };
        self.geometry.taps_of(phase).into_iter().map(offset).collect()
    }

    /// Computes every row of the band for one output phase, with `STEP` input pixels for each output pixel.
    #[inline(always)]
    unsafe fn rows<S: Simd, const STEP: usize>(
        &self,
        simd: S,
        taps: &[Offset],
        spread: usize,
        phase: (usize, usize),
    ) {
        let mut inputs: Vec<Plane> = Vec::with_capacity(64);
        for y in self.rows.0..self.rows.1 {
            inputs.clear();
            for source in self.sources {
                let s = source.shape;
                for plane in 0..s.planes() {
                    // The pointer is derived from the whole activation, not from one block of it, because
                    // taps read other rows from here.
                    let pixel = source.data.as_ptr().wrapping_add(s.row(self.n, plane, y * STEP));
                    inputs.push(Plane { pixel, lanes: s.lanes(plane) });
                }
            }
            let width = self.out.w / spread;
            // SAFETY: `y` is a row of the band, see `run`.
            unsafe {
                let at = |plane| self.pointer.at(self.out.row(self.n, plane, y * spread + phase.0) + phase.1);
                let (first, end) = self.planes;
                if end - first == 2 && S::TILE.0 == 2 {
                    self.row::<S, STEP, 2>(
                        simd,
                        taps,
                        &inputs,
                        first,
                        [at(first), at(first + 1)],
                        (width, spread),
                    );
                } else {
                    for plane in first..end {
                        self.row::<S, STEP, 1>(simd, taps, &inputs, plane, [at(plane)], (width, spread));
                    }
                }
            }
        }
    }

    /// One row of `OUT` output planes, cut into tiles of nearly equal width.
    #[inline(always)]
    unsafe fn row<S: Simd, const STEP: usize, const OUT: usize>(
        &self,
        simd: S,
        taps: &[Offset],
        inputs: &[Plane],
        plane: usize,
        output: [*mut Block; OUT],
        (width, spread): (usize, usize),
    ) {
        let tiles = width.div_ceil(S::TILE.1);
        let mut x = 0;
        for tile in 0..tiles {
            let pixels = (width - x).div_ceil(tiles - tile);
            let args = Tile { band: self, taps, inputs, plane, output, x, spread };
            // SAFETY: `x + pixels <= width`.
            unsafe {
                macro_rules! tile {
                    ($($px:literal)*) => {
                        match pixels {
                            // Arms for widths beyond the tier's tile are never compiled, as the condition is
                            // a constant.
                            $($px if $px <= S::TILE.1 => args.run::<S, STEP, $px>(simd),)*
                            _ => unreachable!("tiles are at most TILE.1 pixels wide"),
                        }
                    };
                }
                tile!(1 2 3 4 5 6 7 8 9 10 11 12 13 14);
            }
            x += pixels;
        }
    }
}

/// `PX` neighbouring pixels of `OUT` output planes.
struct Tile<'a, const OUT: usize> {
    band: &'a Band<'a>,
    taps: &'a [Offset],
    inputs: &'a [Plane],
    plane: usize,
    output: [*mut Block; OUT],
    x: usize,
    spread: usize,
}

impl<const OUT: usize> Tile<'_, OUT> {
    #[inline(always)]
    unsafe fn run<S: Simd, const STEP: usize, const PX: usize>(self, simd: S) {
        let slab = self.band.geometry.taps() * LANES;
        let row = self.inputs.len() * slab;
        // SAFETY: `convolve` checked the lengths that these offsets stay within.
        unsafe {
            let mut acc = [[simd.splat(0.0); PX]; OUT];
            let output: [*mut Block; OUT] = std::array::from_fn(|o| self.output[o].add(self.x * self.spread));
            for (o, acc) in acc.iter_mut().enumerate() {
                for (p, acc) in acc.iter_mut().enumerate() {
                    *acc = if self.band.epilogue.accumulate {
                        simd.load(output[o].add(p * self.spread))
                    } else {
                        simd.get(&self.band.bias[self.plane + o])
                    };
                }
            }
            let weights = self.band.weights.as_ptr().add(self.plane * row);
            for (i, input) in self.inputs.iter().enumerate() {
                let pixel = input.pixel.add(self.x * STEP);
                for tap in self.taps {
                    let pixel = pixel.offset(tap.input).cast::<f32>();
                    let weights = weights.add(i * slab + tap.slab);
                    for lane in 0..input.lanes {
                        let w: [S::V; OUT] = std::array::from_fn(|o| simd.load(weights.add(o * row + lane)));
                        for p in 0..PX {
                            let x = simd.splat(*pixel.add(p * STEP * LANES + lane));
                            for o in 0..OUT {
                                acc[o][p] = simd.fma(w[o], x, acc[o][p]);
                            }
                        }
                    }
                }
            }
            for (o, acc) in acc.iter().enumerate() {
                for (p, &acc) in acc.iter().enumerate() {
                    let v = if self.band.epilogue.relu { simd.max(acc, simd.splat(0.0)) } else { acc };
                    simd.store(output[o].add(p * self.spread), v);
                }
            }
        }
    }
}
