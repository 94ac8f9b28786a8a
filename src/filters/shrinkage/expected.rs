//! How far off a result is expected to be, learned from results and their references.
//!
//! In: the sums over squares of pixels from which the share of the render was found, and what is left of the
//! difference to the render. Out: the squared error to be expected in each square, relative to the squared
//! light there. The perceptron was trained by `eval/training/expected_error.py` on results of the built-in
//! models for frames of 1 to 256 samples.

use std::sync::LazyLock;

use rayon::prelude::*;

use super::{
    Empty, FLOOR, Render,
    features::{FEATURES, SAMPLES, TINY, WINDOWS, each_row},
};
use crate::{
    filters::{
        perceptron::Perceptron,
        squares::{self, SQUARE},
    },
    kernels::{
        exponential::exp,
        logarithm::ln,
        vectorised::{self, Vectorised},
    },
    metrics::error::RELMSE_EPSILON,
    planes::Planes,
};

/// Besides the features, the perceptron reads the logarithm of the mean squared change that is left, in the
/// square itself and around it.
const INPUTS: usize = FEATURES + 2;

/// The samples of the cleanest frames that were learned from. A file that tells more counts as one that tells nothing:
/// beyond, the perceptron would guess, and with adaptive sampling such a number is what a pixel may have had at most.
const MOST_SAMPLES: u32 = 256;

/// Relative squared changes are cut at this.
const LARGEST_CHANGE: f32 = 100.0;

/// Logarithms of the least and the largest error that is expected.
const LEAST: f32 = -14.0;
const MOST: f32 = 4.0;

static PERCEPTRON: LazyLock<Perceptron> =
    LazyLock::new(|| Perceptron::read(include_bytes!("expected.safetensors"), INPUTS, 1));

/// The squared error to be expected in each square of pixels, (1, H / 4, W / 4) rounded up. RelMSE is the
/// mean of such errors.
pub fn errors(result: &Planes, render: &Render, empty: Option<&Empty>, sums: &[f32]) -> Planes {
    let squares = result.width.div_ceil(SQUARE);
    if result.pixels() == 0 {
        return Planes::new(1, squares, result.height.div_ceil(SQUARE));
    }
    let of_squares = changes(result, render, empty);
    let window = WINDOWS[1];
    let rows: Vec<&[f32]> = of_squares.chunks(3 * squares).map(|row| &row[..2 * squares]).collect();
    let errors = each_row(sums, squares, 1, render, |row, features, error| {
        let near_rows = squares::rows_around(&rows, row, window);
        let (mut of_rows, mut around) = (vec![0.0; 2 * squares], vec![0.0; 2 * squares]);
        squares::around(near_rows, squares, window, &mut of_rows, &mut around);
        let mut inputs = vec![0.0; INPUTS * squares];
        inputs[..FEATURES * squares].copy_from_slice(features);
        if render.samples.is_some_and(|samples| samples > MOST_SAMPLES) {
            inputs[SAMPLES * squares..FEATURES * squares].fill(0.0);
        }
        let (own, near) = inputs[FEATURES * squares..].split_at_mut(squares);
        own.iter_mut().zip(rows[row]).for_each(|(log, change)| *log = ln(change + TINY));
        let (changes, weights) = around.split_at(squares);
        let means = changes.iter().zip(weights).map(|(sum, weight)| sum / weight);
        near.iter_mut().zip(means).for_each(|(log, change)| *log = ln(change + TINY));
        PERCEPTRON.apply(&inputs, squares, error);
        let units = &of_squares[(3 * row + 2) * squares..][..squares];
        error.iter_mut().zip(units).for_each(|(v, unit)| *v = exp(v.clamp(LEAST, MOST)) * unit);
    });
    Planes::from_vec(1, squares, rows.len(), errors)
}

/// Finds for each pixel of a row its squared relative change, and the factor of its error.
struct Compare<'a> {
    noisy: [&'a [f32]; 3],
    clean: [&'a [f32]; 3],
    floor: f32,
    least: f32,
    changes: &'a mut [f32],
    units: &'a mut [f32],
}

impl Vectorised for Compare<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { noisy, clean, floor, least, changes, units } = self;
        changes.fill(0.0);
        units.fill(0.0);
        for (noisy, clean) in noisy.into_iter().zip(clean) {
            for (change, (noisy, clean)) in changes.iter_mut().zip(noisy.iter().zip(clean)) {
                *change += (noisy.max(0.0) - clean) / (clean + floor);
            }
            for (unit, clean) in units.iter_mut().zip(clean) {
                let square = (clean * clean).min(f32::MAX);
                *unit += (square + least) / (square + RELMSE_EPSILON as f32);
            }
        }
        for (change, unit) in changes.iter_mut().zip(units) {
            let mean = *change / 3.0;
            *change = (mean * mean).min(LARGEST_CHANGE);
            *unit /= 3.0;
        }
    }
}

/// Three lines of each row of squares: the mean squared relative change that is left between render and
/// result; ones; and the factor that turns the perceptron's error into one that RelMSE is the mean of. The
/// perceptron sees a frame as exposed and does not know its brightness, so in dark frames its errors are
/// relative to less light than those of RelMSE.
fn changes(result: &Planes, render: &Render, empty: Option<&Empty>) -> Vec<f32> {
    let (width, height) = (result.width, result.height);
    let squares = width.div_ceil(SQUARE);
    let floor = FLOOR / render.exposure;
    let least = (floor * floor).min(RELMSE_EPSILON as f32);
    let mut lines = vec![0.0; height.div_ceil(SQUARE) * 3 * squares];
    lines.par_chunks_mut(3 * squares).enumerate().for_each(|(row, lines)| {
        let (changes, rest) = lines.split_at_mut(squares);
        let (ones, units) = rest.split_at_mut(squares);
        ones.fill(1.0);
        let [mut changes_of_row, mut units_of_row] = [(); 2].map(|()| vec![0.0; width]);
        let rows = row * SQUARE..((row + 1) * SQUARE).min(height);
        for y in rows.clone() {
            let is_empty = empty.map(|empty| empty.row(y));
            let [noisy, clean] = [render.radiance, result].map(|planes| planes.rows(y));
            let (changes_of_row, units_of_row) = (&mut changes_of_row, &mut units_of_row);
            let compare =
                Compare { noisy, clean, floor, least, changes: changes_of_row, units: units_of_row };
            vectorised::run(compare);
            for x in 0..width {
                changes[x / SQUARE] += changes_of_row[x];
                // What stays as rendered because nothing was met has no error.
                units[x / SQUARE] += if is_empty.is_some_and(|row| row[x]) { 0.0 } else { units_of_row[x] };
            }
        }
        for (square, (change, unit)) in changes.iter_mut().zip(units).enumerate() {
            let pixels = rows.len() * (width - square * SQUARE).min(SQUARE);
            *change /= pixels as f32;
            *unit /= pixels as f32;
        }
    });
    lines
}
