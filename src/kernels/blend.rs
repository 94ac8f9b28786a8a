//! Blending the levels of a filtered pyramid, planar f32, one image at a time.
//!
//! `fine + sigmoid(alpha) * up(coarse - down(fine))`, with `down` the mean of 2x2: the coarse level
//! replaces the low frequencies of the fine one and leaves its detail (Vogels et al. 2018, Section 4.3,
//! with a mask for each pixel). `up` weighs the four nearest coarse pixels: bilinearly, times the
//! exponential of what the network predicts for each, so that light does not leak over an edge (Balint et
//! al. 2023 predict the whole upsampling kernel).

use rayon::prelude::*;

use super::filter::{Size, exp};

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
        let mut out = [red, green, blue];
        for x in 0..size.w {
            let at = y * size.w + x;
            let share = sigmoid(masks.alpha[at]);
            let (corners, weights) = (corners(size, y, x), weights(masks.corners, n, at));
            for (c, out) in out.iter_mut().enumerate() {
                let difference = &difference[c * h * w..][..h * w];
                let up: f32 = (0..CORNERS).map(|i| weights[i] * difference[corners[i]]).sum();
                out[x] = fine[c * n + at] + share * up;
            }
        }
    });
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
