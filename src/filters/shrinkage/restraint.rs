//! How much of the render a place should keep, learned from renders and their references.
//!
//! In: the sums over squares of pixels. Out: for each square numbers from which every pixel's share follows.
//! The perceptron was trained by `eval/training/restraint.py` to make the squared error of the mixture least,
//! on frames of 1 to 256 samples; references need not be clean for that, only unbiased.

use std::sync::LazyLock;

use super::{
    Render,
    features::{FEATURES, each_row},
};
use crate::filters::perceptron::Perceptron;

/// Values of a square: the logit of the share; the slope of that logit over the logarithm of a pixel's own
/// squared residual; and the logarithm of the mean squared residual near by, with which the pixel's own is
/// compared.
pub const OUTPUTS: usize = 3;

static PERCEPTRON: LazyLock<Perceptron> =
    LazyLock::new(|| Perceptron::read(include_bytes!("restraint.safetensors"), FEATURES, OUTPUTS - 1));

/// Judges every square: [`OUTPUTS`] lines for each row of squares.
pub fn judge(sums: &[f32], squares: usize, render: &Render) -> Vec<f32> {
    each_row(sums, squares, OUTPUTS, render, |_, features, output| {
        let (mixture, residual) = output.split_at_mut((OUTPUTS - 1) * squares);
        PERCEPTRON.apply(features, squares, mixture);
        residual.copy_from_slice(&features[..squares]);
    })
}
