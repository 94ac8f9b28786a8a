//! Turns radiance divided by one albedo into radiance divided by another, as far as a network says; planar
//! f32.
//!
//! `value * exp(ratio * logistic(logit))`, where `ratio` is the logarithm of the first albedo over the
//! second. A logit far below 0 leaves a value as it is; one far above 0 gives what division by the second
//! albedo would give.

use rayon::prelude::*;

use super::{
    exponential::{exp, logistic},
    filter::Size,
    vectorised::{self, Vectorised},
};

/// Writes `value * exp(ratio * logistic(logit))` for each value. `values`, `ratio` and `output` are
/// (3, H, W), and `logits` (1, H, W).
///
/// # Panics
/// If lengths differ.
pub fn redivide(size: Size, values: &[f32], ratio: &[f32], logits: &[f32], output: &mut [f32]) {
    assert_eq!([values.len(), ratio.len(), output.len()], [3 * size.pixels(); 3]);
    assert_eq!(logits.len(), size.pixels());
    let Size { h, w } = size;
    output.par_chunks_mut(w).enumerate().for_each(|(i, output)| {
        let (row, y) = (i * w..(i + 1) * w, i % h);
        let logits = &logits[y * w..][..w];
        vectorised::run(Redivide { values: &values[row.clone()], ratio: &ratio[row], logits, output });
    });
}

struct Redivide<'a> {
    values: &'a [f32],
    ratio: &'a [f32],
    logits: &'a [f32],
    output: &'a mut [f32],
}

impl Vectorised for Redivide<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { values, ratio, logits, output } = self;
        for ((out, value), (ratio, logit)) in output.iter_mut().zip(values).zip(ratio.iter().zip(logits)) {
            *out = value * exp(ratio * logistic(*logit));
        }
    }
}

/// Backpropagates the gradient of [`redivide`]'s `output` to its logits and adds the result to theirs. The
/// values and the albedos are a network's inputs and need no gradient.
///
/// # Panics
/// If lengths differ.
pub fn redivide_gradient(
    (output, ratio, logits): (&[f32], &[f32], &[f32]),
    output_gradient: &[f32],
    into_logits: &mut [f32],
) {
    let n = into_logits.len();
    assert_eq!([output.len(), ratio.len(), output_gradient.len()], [3 * n; 3]);
    assert_eq!(logits.len(), n);
    for c in 0..3 {
        let channel = c * n..(c + 1) * n;
        let (output, ratio) = (&output[channel.clone()], &ratio[channel.clone()]);
        vectorised::run(Gradient { output, ratio, logits, gradient: &output_gradient[channel], into_logits });
    }
}

struct Gradient<'a> {
    output: &'a [f32],
    ratio: &'a [f32],
    logits: &'a [f32],
    gradient: &'a [f32],
    into_logits: &'a mut [f32],
}

impl Vectorised for Gradient<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { output, ratio, logits, gradient, into_logits } = self;
        let read = output.iter().zip(ratio).zip(logits.iter().zip(gradient));
        for (into, ((out, ratio), (logit, g))) in into_logits.iter_mut().zip(read) {
            let share = logistic(*logit);
            *into += g * out * ratio * share * (1.0 - share);
        }
    }
}
