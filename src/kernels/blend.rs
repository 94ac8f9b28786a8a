//! Blending the levels of a filtered pyramid, planar f32, one image at a time.
//!
//! `(1 - alpha) * fine + alpha * up(coarse)`, where `alpha` is the logistic of what the network predicts for
//! each pixel. Where the coarse level, which is already filtered, says all there is, it replaces the fine
//! level and its noise. (Vogels et al. 2018, Section 4.3, keep the fine level's detail, and its noise with
//! it.) `up` is a weighted mean of the four nearest coarse pixels. Each weight is the bilinear one times the
//! exponential of what the network predicts for it, so that light does not leak over an edge (Balint et al.
//! 2023 predict the whole upsampling kernel).

use rayon::prelude::*;

use super::{
    LANES,
    exponential::{exp, limited, logistic},
    filter::Size,
    simd::{Kernel, Simd, Tier},
    thirds,
};

/// Coarse pixels around a fine one.
pub const CORNERS: usize = 4;

/// Bilinear weights of these corners: the nearest, its neighbour in the row, its neighbour in the column, and
/// the one across.
const BILINEAR: [f32; CORNERS] = [0.5625, 0.1875, 0.1875, 0.0625];

/// The coarse row (or column), of `n`, that the fine one `i` lies in, and the next nearest. The edge is
/// repeated.
#[inline(always)]
fn near(i: usize, n: usize) -> (usize, usize) {
    let own = i / 2;
    (own, if i.is_multiple_of(2) { own.saturating_sub(1) } else { (own + 1).min(n - 1) })
}

/// Indices of the four coarse pixels around a fine one, the edge repeated.
#[inline(always)]
fn corners(size: Size, y: usize, x: usize) -> [usize; CORNERS] {
    let (h, w) = (size.h / 2, size.w / 2);
    let ((y0, y1), (x0, x1)) = (near(y, h), near(x, w));
    [y0 * w + x0, y0 * w + x1, y1 * w + x0, y1 * w + x1]
}

/// Weights of the corners of pixel `at` from their logits, (4, H, W).
#[inline(always)]
fn weights(logits: &[f32], pixels: usize, at: usize) -> [f32; CORNERS] {
    let raw: [f32; CORNERS] = std::array::from_fn(|i| BILINEAR[i] * exp(logits[i * pixels + at]));
    let inverse = 1.0 / (raw[0] + raw[1] + raw[2] + raw[3]);
    raw.map(|w| w * inverse)
}

/// What the network predicts for a blend. Logits beyond +-40 count as +-40 and have no gradient.
#[derive(Clone, Copy)]
pub struct Masks<'a> {
    /// The share of the coarse level before its logistic, (1, L, W).
    pub alpha: &'a [f32],
    /// Logits of the four corners, (4, L, W).
    pub corners: &'a [f32],
    /// The row of these that is that of the first row to blend. H rows from there on are read.
    pub first: usize,
}

/// Which rows of a taller frame are blended.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    /// The row of the frame at which the fine level begins.
    pub first: usize,
    /// Rows of the frame.
    pub total: usize,
    /// The row of the coarse frame at which the coarse level begins. It must hold every coarse row next to a
    /// fine one.
    pub coarse: usize,
}

/// Blends a fine level (3, H, W) with a coarse one (3, h, W/2), where h is H/2 if the levels are the whole
/// frame.
///
/// # Panics
/// If lengths do not fit.
pub fn blend(size: Size, place: Place, (fine, coarse): (&[f32], &[f32]), masks: Masks, output: &mut [f32]) {
    let n = size.pixels();
    assert_eq!((fine.len(), output.len(), coarse.len() % (3 * size.w / 2).max(1)), (3 * n, 3 * n, 0));
    assert_eq!((masks.alpha.len() % size.w.max(1), masks.corners.len()), (0, CORNERS * masks.alpha.len()));
    assert!(masks.first * size.w + n <= masks.alpha.len(), "masks of all rows to blend");
    assert!(size.w.is_multiple_of(2), "only even rows have halves");
    let [red, green, blue] = thirds(output).map(|plane| plane.par_chunks_mut(size.w));
    red.zip(green).zip(blue).enumerate().for_each(|(y, ((red, green), blue))| {
        Tier::detect().run(BlendRow { size, place, y, fine, coarse, masks, output: [red, green, blue] });
    });
}

/// One row of a blend.
struct BlendRow<'a> {
    size: Size,
    place: Place,
    y: usize,
    fine: &'a [f32],
    coarse: &'a [f32],
    masks: Masks<'a>,
    output: [&'a mut [f32]; 3],
}

impl Kernel for BlendRow<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { size: Size { w, .. }, place, y, fine, coarse, masks, mut output } = self;
        let (n, narrow) = (self.size.pixels(), w / 2);
        let h = coarse.len() / (3 * narrow).max(1);
        let (own, other) = near(place.first + y, place.total / 2);
        let of = |values: &'_ [f32], plane: usize| values[plane * n + y * w..][..w].as_ptr();
        let predicted = masks.alpha.len();
        let of_masks = |values: &'_ [f32], plane: usize| {
            values[plane * predicted + (masks.first + y) * w..][..w].as_ptr()
        };
        // The coarse lines of each colour with the edge repeated, and room for what a group of pixels may
        // read beyond.
        let stride = narrow + 2 + LANES;
        let mut lines = vec![0.0; 6 * stride];
        for (i, line) in lines.chunks_exact_mut(stride).enumerate() {
            let row = [own, other][i % 2] - place.coarse;
            let row = &coarse[(i / 2 * h + row) * narrow..][..narrow];
            line[1..=narrow].copy_from_slice(row);
            (line[0], line[narrow + 1]) = (row[0], row[narrow - 1]);
        }
        let alpha = of_masks(masks.alpha, 0);
        let corners: [_; CORNERS] = std::array::from_fn(|i| of_masks(masks.corners, i));
        for x in (0..w).step_by(LANES) {
            let count = LANES.min(w - x);
            // SAFETY: of rows no more is read and written than they have, and a group of a
            // line's pixels begins inside it.
            unsafe {
                let one = simd.splat(1.0);
                let read = |row: *const f32| simd.read_some(row.add(x), 0..count, 0.0);
                let mut weights = [one; CORNERS];
                let mut total = simd.splat(0.0);
                for i in 0..CORNERS {
                    weights[i] = simd.mul(simd.splat(BILINEAR[i]), simd.exp(read(corners[i])));
                    total = simd.add(total, weights[i]);
                }
                // The share of the level below, a logistic, over the sum of its weights.
                let negative = simd.mul(read(alpha), simd.splat(-1.0));
                let part = simd.div(one, simd.mul(total, simd.add(one, simd.exp(negative))));
                let share = simd.mul(part, total);
                for weight in &mut weights {
                    *weight = simd.mul(*weight, part);
                }
                let rest = simd.fma(share, simd.splat(-1.0), one);
                for (c, output) in output.iter_mut().enumerate() {
                    let mut sum = simd.mul(read(of(fine, c)), rest);
                    for pair in 0..2 {
                        let line = lines[(2 * c + pair) * stride..].as_ptr().add(x / 2);
                        let [nearest, beside] = simd.double(line);
                        sum = simd.fma(nearest, weights[2 * pair], sum);
                        sum = simd.fma(beside, weights[2 * pair + 1], sum);
                    }
                    simd.write_first(output[x..].as_mut_ptr(), count, sum);
                }
            }
        }
    }
}

/// Where the gradients of a blend are added.
pub struct BlendGradient<'a> {
    /// To the fine level, (3, H, W).
    pub fine: &'a mut [f32],
    /// To the coarse level, (3, H/2, W/2).
    pub coarse: &'a mut [f32],
    /// To the share's logit, (1, H, W).
    pub alpha: &'a mut [f32],
    /// To the corners' logits, (4, H, W).
    pub corners: &'a mut [f32],
}

/// Backpropagates the gradient of [`blend`]'s output and adds the results to what `into` holds.
///
/// # Panics
/// As [`blend`].
pub fn blend_gradient(
    size: Size,
    masks: Masks,
    (fine, coarse): (&[f32], &[f32]),
    output_gradient: &[f32],
    into: BlendGradient,
) {
    let (quarter, n) = (size.pixels() / 4, size.pixels());
    assert_eq!((masks.alpha.len(), coarse.len(), output_gradient.len()), (n, 3 * quarter, 3 * n));
    for y in 0..size.h {
        for x in 0..size.w {
            let at = y * size.w + x;
            let share = logistic(masks.alpha[at]);
            let (corners, weights) = (corners(size, y, x), weights(masks.corners, n, at));
            // Derivatives by each corner's weight, and by the coarse level's share.
            let (mut by_weight, mut by_share) = ([0.0; CORNERS], 0.0);
            for c in 0..3 {
                let g = output_gradient[c * n + at];
                into.fine[c * n + at] += g * (1.0 - share);
                by_share -= g * fine[c * n + at];
                for i in 0..CORNERS {
                    let from = c * quarter + corners[i];
                    by_weight[i] += g * share * coarse[from];
                    by_share += g * weights[i] * coarse[from];
                    into.coarse[from] += weights[i] * g * share;
                }
            }
            into.alpha[at] += by_share * limited(masks.alpha[at], share * (1.0 - share));
            let mean: f32 = (0..CORNERS).map(|i| weights[i] * by_weight[i]).sum();
            for i in 0..CORNERS {
                let slope = limited(masks.corners[i * n + at], weights[i]);
                into.corners[i * n + at] += slope * (by_weight[i] - mean);
            }
        }
    }
}
