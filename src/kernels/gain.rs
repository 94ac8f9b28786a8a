//! A gain for every value, planar f32.
//!
//! `value * exp(LARGEST * tanh(logit / LARGEST))`: with it a network draws what no average of noisy
//! neighbours holds, such as the edge of a shadow. The gain is bounded, so no value grows without limit. A
//! logit of 0 leaves a value as it is.

use rayon::prelude::*;

use super::{
    exponential::{exp, logistic},
    vectorised::{self, CHUNK, Vectorised},
};

/// The logarithm of the largest gain.
const LARGEST: f32 = 2.0;

/// The gain of a logit, and its slope.
#[inline(always)]
fn gain(logit: f32) -> (f32, f32) {
    // tanh(x) = 2 logistic(2x) - 1
    let share = logistic(logit * (2.0 / LARGEST));
    let gain = exp(LARGEST * (2.0 * share - 1.0));
    (gain, 4.0 * share * (1.0 - share) * gain)
}

/// Writes each value times its gain.
///
/// # Panics
/// If lengths differ.
pub fn amplify(values: &[f32], logits: &[f32], output: &mut [f32]) {
    assert_eq!((values.len(), logits.len()), (output.len(), output.len()));
    output
        .par_chunks_mut(CHUNK)
        .zip(values.par_chunks(CHUNK).zip(logits.par_chunks(CHUNK)))
        .for_each(|(output, (values, logits))| vectorised::run(Amplify { values, logits, output }));
}

struct Amplify<'a> {
    values: &'a [f32],
    logits: &'a [f32],
    output: &'a mut [f32],
}

impl Vectorised for Amplify<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { values, logits, output } = self;
        for (out, (value, logit)) in output.iter_mut().zip(values.iter().zip(logits)) {
            *out = value * gain(*logit).0;
        }
    }
}

/// Backpropagates the gradient of [`amplify`]'s output to its values and logits, and adds the results to
/// theirs.
///
/// # Panics
/// If lengths differ.
pub fn amplify_gradient(
    (values, logits): (&[f32], &[f32]),
    output_gradient: &[f32],
    (into_values, into_logits): (&mut [f32], &mut [f32]),
) {
    let n = output_gradient.len();
    assert_eq!([values.len(), logits.len(), into_values.len(), into_logits.len()], [n; 4]);
    let read = values.par_chunks(CHUNK).zip(logits.par_chunks(CHUNK)).zip(output_gradient.par_chunks(CHUNK));
    let written = into_values.par_chunks_mut(CHUNK).zip(into_logits.par_chunks_mut(CHUNK));
    written.zip(read).for_each(|((into_values, into_logits), ((values, logits), gradient))| {
        vectorised::run(Gradient { values, logits, gradient, into_values, into_logits });
    });
}

struct Gradient<'a> {
    values: &'a [f32],
    logits: &'a [f32],
    gradient: &'a [f32],
    into_values: &'a mut [f32],
    into_logits: &'a mut [f32],
}

impl Vectorised for Gradient<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { values, logits, gradient, into_values, into_logits } = self;
        let into = into_values.iter_mut().zip(into_logits);
        for ((into_value, into_logit), ((value, logit), g)) in
            into.zip(values.iter().zip(logits).zip(gradient))
        {
            let (gain, slope) = gain(*logit);
            *into_value += g * gain;
            *into_logit += g * value * slope;
        }
    }
}
