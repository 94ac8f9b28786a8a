//! How much of the render a place should keep, learned from renders and their references.
//!
//! In: the sums over squares of pixels. Out: for each square two numbers from which every pixel's share follows. A
//! perceptron of two hidden layers reads the sums over three neighbourhoods of the square, and the number of samples
//! where it is known. It was trained by `eval/training/restraint.py` to make the squared error of the mixture least, on
//! frames of 1 to 256 samples; references need not be clean for that, only unbiased.

use std::sync::LazyLock;

use rayon::prelude::*;
use safetensors::SafeTensors;

use super::{
    Render,
    sums::{BY_DETAIL, COUNT, CUT, DETAIL, LIGHT, NEXT, NOISE, RESIDUAL, SUMS},
};
use crate::{
    filters::squares,
    kernels::{
        logarithm::ln,
        vectorised::{self, Vectorised},
    },
};

/// Binomial weights of the squares of each neighbourhood.
const WINDOWS: [&[f32]; 3] =
    [&[1.0, 2.0, 1.0], &[1.0, 4.0, 6.0, 4.0, 1.0], &[1.0, 8.0, 28.0, 56.0, 70.0, 56.0, 28.0, 8.0, 1.0]];

/// What is read of each neighbourhood, and in all: besides these the brightness of the place, the logarithm to base 2 of
/// the number of samples, and whether it is known.
const OF_WINDOW: usize = 11;
pub const FEATURES: usize = WINDOWS.len() * OF_WINDOW + 3;

/// Added before logarithms, and to what is divided by.
const TINY: f32 = 1e-8;

/// Exposed radiance that is added before the brightness's logarithm.
const BLACK: f32 = 0.02;

/// Units of both hidden layers.
const HIDDEN: usize = 24;

/// The slope of hidden units below zero.
const LEAK: f32 = 0.1;

/// What comes out of a square: the share's logit, its slope over the logarithm of a pixel's own squared residual, and the
/// logarithm of the mean squared residual near by, which that is compared with.
pub const OUTPUTS: usize = 3;

/// The parameters: weights of each layer, outputs by inputs, and biases.
struct Weights {
    first: (Vec<f32>, Vec<f32>),
    second: (Vec<f32>, Vec<f32>),
    last: (Vec<f32>, Vec<f32>),
}

static WEIGHTS: LazyLock<Weights> = LazyLock::new(|| {
    let file = SafeTensors::deserialize(include_bytes!("restraint.safetensors")).expect("a test reads it");
    let tensor = |name: String, len: usize| -> Vec<f32> {
        let bytes = file.tensor(&name).expect("a test reads it").data();
        let values: Vec<f32> =
            bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        assert_eq!(values.len(), len, "{name}");
        values
    };
    let layer = |name: &str, inputs: usize, outputs: usize| {
        (tensor(format!("{name}.weight"), inputs * outputs), tensor(format!("{name}.bias"), outputs))
    };
    Weights {
        first: layer("first", FEATURES, HIDDEN),
        second: layer("second", HIDDEN, HIDDEN),
        last: layer("last", HIDDEN, OUTPUTS - 1),
    }
});

/// [`FEATURES`] lines of every row of squares.
pub fn features(sums: &[f32], squares: usize, render: &Render) -> Vec<f32> {
    each_row(sums, squares, FEATURES, render, |features, output| output.copy_from_slice(features))
}

/// [`OUTPUTS`] lines of every row of squares.
pub fn judge(sums: &[f32], squares: usize, render: &Render) -> Vec<f32> {
    each_row(sums, squares, OUTPUTS, render, |features, output| {
        let Weights { first, second, last } = &*WEIGHTS;
        let mut hidden = [(); 2].map(|()| vec![0.0; HIDDEN * squares]);
        let [one, two] = &mut hidden;
        vectorised::run(Layer { weights: first, input: features, output: one, squares });
        leak(one);
        vectorised::run(Layer { weights: second, input: one, output: two, squares });
        leak(two);
        let (mixture, residual) = output.split_at_mut((OUTPUTS - 1) * squares);
        vectorised::run(Layer { weights: last, input: two, output: mixture, squares });
        residual.copy_from_slice(&features[..squares]);
    })
}

fn leak(values: &mut [f32]) {
    values.iter_mut().for_each(|v| *v = v.max(LEAK * *v));
}

/// A layer of the perceptron for a row of squares: a line of each input and of each output.
struct Layer<'a> {
    weights: &'a (Vec<f32>, Vec<f32>),
    input: &'a [f32],
    output: &'a mut [f32],
    squares: usize,
}

impl Vectorised for Layer<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { weights: (weights, biases), input, output, squares } = self;
        let inputs = weights.len() / biases.len();
        let units = output.chunks_exact_mut(squares).zip(weights.chunks_exact(inputs)).zip(biases);
        for ((output, weights), bias) in units {
            output.fill(*bias);
            for (line, weight) in input.chunks_exact(squares).zip(weights) {
                output.iter_mut().zip(line).for_each(|(sum, v)| *sum += weight * v);
            }
        }
    }
}

/// What `make` makes of the features of every row of squares: so many lines each.
fn each_row(
    sums: &[f32],
    squares: usize,
    lines: usize,
    render: &Render,
    make: impl Fn(&[f32], &mut [f32]) + Sync,
) -> Vec<f32> {
    let sums: Vec<&[f32]> = sums.chunks(SUMS * squares).collect();
    let mut made = vec![0.0; sums.len() * lines * squares];
    let memory = || (vec![0.0; SUMS * squares], vec![0.0; SUMS * squares], vec![0.0; FEATURES * squares]);
    made.par_chunks_mut(lines * squares).enumerate().for_each_init(
        memory,
        |(of_rows, around, features), (row, made)| {
            let (of_windows, of_frame) = features.split_at_mut(WINDOWS.len() * OF_WINDOW * squares);
            for (place, (window, features)) in
                WINDOWS.iter().zip(of_windows.chunks_exact_mut(OF_WINDOW * squares)).enumerate()
            {
                let lines = window.iter().enumerate().filter_map(|(tap, weight)| {
                    Some((*weight, *sums.get((row + tap).checked_sub(window.len() / 2)?)?))
                });
                squares::around(lines, squares, window, of_rows, around);
                vectorised::run(Describe { sums: around, features, squares });
                if place == 0 {
                    let light = around[LIGHT * squares..].iter().zip(&around[COUNT * squares..]);
                    let brightness = |(sum, count): (&f32, &f32)| ln(sum / count * render.exposure + BLACK);
                    of_frame.iter_mut().zip(light).take(squares).for_each(|(v, of)| *v = brightness(of));
                }
            }
            let samples = render.samples.map_or(0.0, |samples| (samples.max(1) as f32).log2());
            of_frame[squares..2 * squares].fill(samples);
            of_frame[2 * squares..].fill(if render.samples.is_some() { 1.0 } else { 0.0 });
            make(features, made);
        },
    );
    made
}

/// Makes features of the sums over a neighbourhood: logarithms of mean squares, and correlations.
struct Describe<'a> {
    sums: &'a [f32],
    /// [`OF_WINDOW`] lines.
    features: &'a mut [f32],
    squares: usize,
}

impl Vectorised for Describe<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { sums, features, squares } = self;
        for s in 0..squares {
            let per_pixel = 1.0 / sums[COUNT * squares + s];
            let mean = |line: usize| sums[line * squares + s] * per_pixel;
            let level = |line: usize| ln(mean(line).max(0.0) + TINY);
            let residual = mean(RESIDUAL);
            let share = |line: usize| mean(line) / (residual + TINY);
            let alike = |line: usize, with: usize| {
                mean(line) / (mean(with) * residual + TINY * TINY).max(f32::MIN_POSITIVE).sqrt()
            };
            let described: [f32; OF_WINDOW] = [
                level(RESIDUAL),
                level(NOISE[0]),
                level(NOISE[1]),
                level(CUT),
                level(DETAIL[0]),
                level(DETAIL[1]),
                share(NEXT[0]),
                share(NEXT[1]),
                share(BY_DETAIL[2]),
                alike(BY_DETAIL[0], DETAIL[0]),
                alike(BY_DETAIL[1], DETAIL[1]),
            ];
            described.into_iter().enumerate().for_each(|(line, v)| features[line * squares + s] = v);
        }
    }
}
