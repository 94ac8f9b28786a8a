//! Blending the levels of a filtered pyramid, planar f32, one image at a time.
//!
//! `fine + sigmoid(alpha) * up(coarse - down(fine))`, with `down` the mean of 2x2: the coarse level
//! replaces the low frequencies of the fine one and leaves its detail (Vogels et al. 2018, Section 4.3,
//! with a mask for each pixel). `up` weighs the four nearest coarse pixels: bilinearly, times the
//! exponential of what the network predicts for each, so that light does not leak over an edge (Balint et
//! al. 2023 predict the whole upsampling kernel).

use rayon::prelude::*;

use super::{
    filter::{Size, exp},
    simd::{Kernel, Simd, Tier},
};

/// Coarse pixels around a fine one.
pub const CORNERS: usize = 4;

/// Their bilinear weights: nearest, beside it in the row, beside it in the column, across.
const BILINEAR: [f32; CORNERS] = [0.5625, 0.1875, 0.1875, 0.0625];

/// The logistic function, which keeps a blend between its two images.
#[inline(always)]
fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// The coarse row (or column) of `n` that fine one `i` lies in, and the next nearest, the edge repeated.
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

/// What the network predicts for a blend.
#[derive(Clone, Copy)]
pub struct Masks<'a> {
    /// The share of the coarse level before its logistic, (1, H, W).
    pub alpha: &'a [f32],
    /// Logits of the four corners, (4, H, W).
    pub corners: &'a [f32],
}

/// Blends a coarse level (3, H/2, W/2) into a fine one (3, H, W).
///
/// `difference` (3, H/2, W/2) gets `coarse - down(fine)`.
///
/// # Panics
/// If lengths do not fit.
pub fn blend(
    size: Size,
    (fine, coarse): (&[f32], &[f32]),
    masks: Masks,
    difference: &mut [f32],
    output: &mut [f32],
) {
    let (h, w, n) = (size.h / 2, size.w / 2, size.pixels());
    assert_eq!((fine.len(), coarse.len()), (3 * n, 3 * h * w));
    assert_eq!((masks.alpha.len(), masks.corners.len()), (n, CORNERS * n));
    assert_eq!((difference.len(), output.len()), (coarse.len(), fine.len()));
    difference.par_chunks_mut(w).enumerate().for_each(|(i, row)| {
        let (c, y) = (i / h, i % h);
        let fine = &fine[c * n + 2 * y * size.w..][..2 * size.w];
        for (x, (out, coarse)) in row.iter_mut().zip(&coarse[i * w..][..w]).enumerate() {
            let sum = fine[2 * x] + fine[2 * x + 1] + fine[size.w + 2 * x] + fine[size.w + 2 * x + 1];
            *out = coarse - 0.25 * sum;
        }
    });
    let difference = &*difference;
    let (red, rest) = output.split_at_mut(n);
    let (green, blue) = rest.split_at_mut(n);
    let rows = red.par_chunks_mut(size.w).zip(green.par_chunks_mut(size.w)).zip(blue.par_chunks_mut(size.w));
    rows.enumerate().for_each(|(y, ((red, green), blue))| {
        Tier::detect().run(Row { size, y, fine, difference, masks, output: [red, green, blue] });
    });
}

/// One row of a blend.
struct Row<'a> {
    size: Size,
    y: usize,
    fine: &'a [f32],
    difference: &'a [f32],
    masks: Masks<'a>,
    output: [&'a mut [f32]; 3],
}

impl Kernel for Row<'_> {
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Self { size, y, fine, difference, masks, output } = self;
        let (h, w, n) = (size.h / 2, size.w / 2, size.pixels());
        let (own, other) = near(y, h);
        let row = |values: &'_ [f32], plane: usize| -> std::ops::Range<usize> {
            debug_assert!(values.len() >= (plane + 1) * n);
            plane * n + y * size.w..plane * n + (y + 1) * size.w
        };
        // Plain loops over whole rows, which the compiler vectorises with the tier's instructions.
        let alpha = &masks.alpha[row(masks.alpha, 0)];
        let corners: [&[f32]; CORNERS] = std::array::from_fn(|i| &masks.corners[row(masks.corners, i)]);
        let mut weights: [Vec<f32>; CORNERS] = std::array::from_fn(|_| vec![0.0; size.w]);
        for i in 0..CORNERS {
            for (weight, logit) in weights[i].iter_mut().zip(corners[i]) {
                *weight = BILINEAR[i] * exp(*logit);
            }
        }
        let [w0, w1, w2, w3] = weights.each_ref().map(|w| &w[..size.w]);
        let mut share = vec![0.0; size.w];
        for (x, share) in share[..size.w].iter_mut().enumerate() {
            *share = sigmoid(alpha[x]) / (w0[x] + w1[x] + w2[x] + w3[x]);
        }
        // Each corner's difference, drawn out to the fine row.
        let mut drawn: [Vec<f32>; CORNERS] = std::array::from_fn(|_| vec![0.0; size.w]);
        for (c, output) in output.into_iter().enumerate() {
            for (pair, coarse) in [own, other].into_iter().enumerate() {
                let coarse = &difference[(c * h + coarse) * w..][..w];
                for x in 0..w {
                    let (left, right) = (coarse[x.saturating_sub(1)], coarse[(x + 1).min(w - 1)]);
                    drawn[2 * pair][2 * x..2 * x + 2].fill(coarse[x]);
                    drawn[2 * pair + 1][2 * x] = left;
                    drawn[2 * pair + 1][2 * x + 1] = right;
                }
            }
            let [d0, d1, d2, d3] = drawn.each_ref().map(|d| &d[..size.w]);
            let (fine, share) = (&fine[row(fine, c)][..size.w], &share[..size.w]);
            for (x, out) in output[..size.w].iter_mut().enumerate() {
                let up = w0[x] * d0[x] + w1[x] * d1[x] + w2[x] * d2[x] + w3[x] * d3[x];
                *out = fine[x] + share[x] * up;
            }
        }
    }
}

/// Where the gradients of a blend go, each added to.
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

/// Adds what [`blend`]'s output gradient sends back.
///
/// # Panics
/// As [`blend`].
pub fn blend_gradient(
    size: Size,
    masks: Masks,
    difference: &[f32],
    output_gradient: &[f32],
    into: BlendGradient,
) {
    let (h, w, n) = (size.h / 2, size.w / 2, size.pixels());
    assert_eq!((masks.alpha.len(), difference.len(), output_gradient.len()), (n, 3 * h * w, 3 * n));
    let mut sent = vec![0.0; 3 * h * w];
    for y in 0..size.h {
        for x in 0..size.w {
            let at = y * size.w + x;
            let share = sigmoid(masks.alpha[at]);
            let (corners, weights) = (corners(size, y, x), weights(masks.corners, n, at));
            // What a unit of each corner's weight, and the upsampled difference, would change.
            let (mut by_weight, mut by_share) = ([0.0; CORNERS], 0.0);
            for c in 0..3 {
                let g = output_gradient[c * n + at];
                into.fine[c * n + at] += g;
                for i in 0..CORNERS {
                    let d = difference[c * h * w + corners[i]];
                    by_weight[i] += g * share * d;
                    by_share += g * weights[i] * d;
                    sent[c * h * w + corners[i]] += weights[i] * g * share;
                }
            }
            into.alpha[at] += by_share * share * (1.0 - share);
            let mean: f32 = (0..CORNERS).map(|i| weights[i] * by_weight[i]).sum();
            for i in 0..CORNERS {
                into.corners[i * n + at] += weights[i] * (by_weight[i] - mean);
            }
        }
    }
    for c in 0..3 {
        for y in 0..h {
            for x in 0..w {
                let g = sent[c * h * w + y * w + x];
                into.coarse[c * h * w + y * w + x] += g;
                let at = c * n + 2 * y * size.w + 2 * x;
                for i in [at, at + 1, at + size.w, at + size.w + 1] {
                    into.fine[i] -= 0.25 * g;
                }
            }
        }
    }
}
