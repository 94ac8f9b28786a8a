//! Weight and bias gradients of the convolutions in [`super::conv`].

use rayon::prelude::*;

use super::{
    Block, LANES, Shape, Shared, View,
    conv::Geometry,
    memory::Pool,
    simd::{Kernel, Simd, Tier},
};

/// Tasks that keep a workstation's threads busy.
const TASKS: usize = 8;

/// Fewest rows for which a task of their own is worth the sum that it needs.
const PART_ROWS: usize = 32;

/// Pixels of a band, whose input and output gradient stay in the first-level cache over all taps.
const BAND_PIXELS: usize = 256;

/// Memory for sums.
static SLABS: Pool<Block> = Pool::new();

/// Gives all free memory back to the system.
pub fn clear() {
    SLABS.clear();
}

/// Adds the weight gradient of one source to `gradient`, laid out like the layer's weights (`(O, I, k, k)`,
/// transposed: `(I, O, 4, 4)`); `first` is the source's first channel among the layer's `inputs` input
/// channels.
///
/// Sums run in an order that depends on the shapes alone, so results do not change with the number
/// of threads.
///
/// # Panics
/// If sizes, borders or lengths do not fit together.
pub fn weight_gradient(
    tier: Tier,
    source: View,
    output_gradient: View,
    geometry: Geometry,
    (first, inputs): (usize, usize),
    gradient: &mut [f32],
) {
    let (s, g) = (source.shape, output_gradient.shape);
    assert!(geometry != Geometry::Strided, "the strided convolution has no weights of its own");
    assert_eq!((g.n, (g.h, g.w)), (s.n, geometry.output(s.h, s.w)));
    // Taps move over the input, or over the gradient where that has more pixels.
    let moved = if geometry == Geometry::Transposed { g } else { s };
    assert!(moved.pad >= geometry.reach(), "border too small for {geometry:?}");
    let taps = geometry.taps();
    assert_eq!(gradient.len(), inputs * g.c * taps);

    // Few planes leave too few tasks, so rows become tasks as well, each with its own sum.
    let pairs = g.planes().div_ceil(2) * s.planes();
    let rows = s.n * s.h;
    let parts = if pairs >= TASKS { 1 } else { (rows / PART_ROWS).clamp(1, TASKS) };
    let slabs = g.planes().checked_mul(s.planes()).and_then(|pairs| pairs.checked_mul(taps * LANES));
    let (slabs, all) = slabs
        .and_then(|slabs| Some((slabs, slabs.checked_mul(parts)?)))
        .expect("sums of gradients fit into memory");
    let mut partial = SLABS.take(all, Block::default());
    partial.fill(Block::default());
    let pointer = Shared(partial.as_mut_ptr());
    (0..parts * pairs).into_par_iter().for_each(|task| {
        let (part, pair) = (task / pairs, task % pairs);
        let (group, input) = (pair / s.planes(), pair % s.planes());
        tier.run(Pair {
            source,
            gradient: output_gradient,
            geometry,
            rows: (part * rows / parts, (part + 1) * rows / parts),
            input,
            outputs: (2 * group, g.planes().min(2 * group + 2)),
            pointer,
            offset: part * slabs,
        });
    });

    add_sums(gradient, geometry, g.c, (first, s.c, inputs), parts, |part, output, i, t| {
        &partial[part * slabs + ((output * s.planes() + i / LANES) * taps + t) * LANES + i % LANES]
    });
}

/// Adds `sum(part, output plane, input of the source, tap)`, over all parts, to the weights they belong to.
/// Such a sum is a block, whose lanes belong to the kernels of 16 outputs. The source's `channels` are those
/// from `first` on among the layer's `inputs` input channels.
pub(super) fn add_sums<'a>(
    weights: &mut [f32],
    geometry: Geometry,
    outputs: usize,
    (first, channels, inputs): (usize, usize, usize),
    parts: usize,
    sum: impl Fn(usize, usize, usize, usize) -> &'a Block + Sync,
) {
    let taps = geometry.taps();
    let total = |output: usize, input: usize, t: usize| {
        let mut total = *sum(0, output, input, t);
        for part in 1..parts {
            total.0.iter_mut().zip(sum(part, output, input, t).0).for_each(|(total, v)| *total += v);
        }
        total
    };
    match geometry {
        Geometry::Same(_) => {
            weights.par_chunks_mut(LANES * inputs * taps).enumerate().for_each(|(output, weights)| {
                for i in 0..channels {
                    for t in 0..taps {
                        let kernels = weights[(first + i) * taps + t..].iter_mut().step_by(inputs * taps);
                        kernels.zip(total(output, i, t).0).for_each(|(kernel, v)| *kernel += v);
                    }
                }
            });
        }
        _ => {
            let rows = weights[first * outputs * taps..].par_chunks_mut(outputs * taps).take(channels);
            rows.enumerate().for_each(|(i, weights)| {
                for (output, weights) in weights.chunks_mut(LANES * taps).enumerate() {
                    for t in 0..taps {
                        let kernels = weights[t..].iter_mut().step_by(taps);
                        kernels.zip(total(output, i, t).0).for_each(|(kernel, v)| *kernel += v);
                    }
                }
            });
        }
    }
}

/// One input plane against one or two output planes.
struct Pair<'a> {
    source: View<'a>,
    gradient: View<'a>,
    geometry: Geometry,
    /// Rows of all images, as if these lay one below another.
    rows: (usize, usize),
    input: usize,
    outputs: (usize, usize),
    pointer: Shared,
    offset: usize,
}

impl Kernel for Pair<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        // SAFETY: `weight_gradient` checked sizes and borders; every task owns its slabs.
        unsafe {
            let (first, end) = self.outputs;
            // Accumulators stay in registers: of 2 output planes x 8 lanes of the input or of 1 x 8, or of
            // 1 x 4 where a block takes two registers.
            if S::TILE.0 == 1 {
                for output in first..end {
                    self.taps::<S, 1, 4>(simd, output);
                }
            } else if end - first == 2 {
                self.taps::<S, 2, 8>(simd, first);
            } else {
                self.taps::<S, 1, 8>(simd, first);
            }
        }
    }
}

impl Pair<'_> {
    #[inline(always)]
    unsafe fn taps<S: Simd, const OUT: usize, const CHUNK: usize>(&self, simd: S, output: usize) {
        let taps = self.geometry.taps();
        let s = self.source.shape;
        let band = match self.geometry {
            Geometry::Same(_) => BAND_PIXELS,
            // Four pixels of the gradient go with one of the input.
            _ => BAND_PIXELS / 4,
        };
        let band = (band / s.w.max(1)).max(1);
        let lanes = s.lanes(self.input);
        let mut row = self.rows.0;
        while row < self.rows.1 {
            let (n, y0) = (row / s.h, row % s.h);
            let rows = (y0, s.h.min(y0 + band).min(y0 + self.rows.1 - row));
            row += rows.1 - rows.0;
            for t in 0..taps {
                // SAFETY: see `run`.
                unsafe {
                    let slabs: [*mut Block; OUT] = std::array::from_fn(|o| {
                        let slab = ((output + o) * s.planes() + self.input) * taps + t;
                        self.pointer.at(self.offset + slab * LANES)
                    });
                    for lane in (0..lanes).step_by(CHUNK) {
                        let slabs = slabs.map(|p| p.add(lane));
                        match self.geometry {
                            Geometry::Same(k) => {
                                self.accumulate::<S, OUT, CHUNK, 1>(simd, n, rows, output, lane, k, t, slabs)
                            }
                            _ => {
                                self.accumulate::<S, OUT, CHUNK, 2>(simd, n, rows, output, lane, 4, t, slabs)
                            }
                        }
                    }
                }
            }
        }
    }

    /// `slab[lane] += sum over pixels of input[lane] * gradient`, for `CHUNK` lanes and one tap;
    /// `STEP` gradient pixels an input pixel.
    #[inline(always)]
    #[expect(clippy::too_many_arguments, reason = "the inner loop, whose values stay in registers")]
    unsafe fn accumulate<S: Simd, const OUT: usize, const CHUNK: usize, const STEP: usize>(
        &self,
        simd: S,
        n: usize,
        rows: (usize, usize),
        output: usize,
        lane: usize,
        k: usize,
        tap: usize,
        slabs: [*mut Block; OUT],
    ) {
        let (s, g) = (self.source.shape, self.gradient.shape);
        let (ky, kx) = ((tap / k) as isize, (tap % k) as isize);
        // Stride 1: the input moves with the tap. Transposed: out[2 m + k - 1] += in[m] w[k].
        let centre = (k / 2) as isize;
        let (input_shift, gradient_shift) = if STEP == 1 {
            ((ky - centre) * s.row_stride() as isize + kx - centre, 0)
        } else {
            (0, (ky - 1) * g.row_stride() as isize + kx - 1)
        };
        // SAFETY: borders cover the taps' reach, as `weight_gradient` checked; views are as long as their
        // shapes say.
        unsafe {
            let mut acc: [[S::V; CHUNK]; OUT] =
                std::array::from_fn(|o| std::array::from_fn(|c| simd.load(slabs[o].add(c))));
            for y in rows.0..rows.1 {
                let input = self.source.data.as_ptr().add(s.row(n, self.input, y)).offset(input_shift);
                let input = input.cast::<f32>().add(lane);
                let gradient: [*const Block; OUT] = std::array::from_fn(|o| {
                    self.gradient.data.as_ptr().add(g.row(n, output + o, y * STEP)).offset(gradient_shift)
                });
                for x in 0..s.w {
                    let g: [S::V; OUT] = std::array::from_fn(|o| simd.load(gradient[o].add(x * STEP)));
                    for c in 0..CHUNK {
                        let v = simd.splat(*input.add(x * LANES + c));
                        for o in 0..OUT {
                            acc[o][c] = simd.fma(g[o], v, acc[o][c]);
                        }
                    }
                }
            }
            for o in 0..OUT {
                for c in 0..CHUNK {
                    simd.store(slabs[o].add(c), acc[o][c]);
                }
            }
        }
    }
}

/// Adds the bias gradient, the sum of the output gradient over images and pixels, to `gradient`.
///
/// # Panics
/// If `gradient` is not one value a channel.
pub fn bias_gradient(output_gradient: View, gradient: &mut [f32]) {
    let g: Shape = output_gradient.shape;
    assert_eq!(gradient.len(), g.c);
    gradient.par_chunks_mut(LANES).enumerate().for_each(|(plane, chunk)| {
        let mut total = [0.0f64; LANES];
        for n in 0..g.n {
            for y in 0..g.h {
                // Row sums in f32, rows in f64: exact enough, and vectorised.
                let mut sum = [0.0f32; LANES];
                for block in &output_gradient.data[g.row(n, plane, y)..][..g.w] {
                    for (s, v) in sum.iter_mut().zip(block.0) {
                        *s += v;
                    }
                }
                for (t, s) in total.iter_mut().zip(sum) {
                    *t += f64::from(s);
                }
            }
        }
        for (value, total) in chunk.iter_mut().zip(total) {
            *value += total as f32;
        }
    });
}
