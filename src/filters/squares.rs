//! Sums over 4x4 squares of pixels and over windows of squares, in which the fits to a frame are gathered (He and Sun 2015:
//! what a guided filter does changes slowly, so it need not be found anew for every pixel).

use rayon::prelude::*;

use crate::kernels::vectorised::{self, Vectorised};

/// Rows and columns of a square.
pub const SQUARE: usize = 4;

/// The square before a pixel, counted from middle to middle, and how far on towards the next it is.
pub fn between(at: usize, squares: usize) -> (usize, f32) {
    let place = ((at as f32 + 0.5) / SQUARE as f32 - 0.5).clamp(0.0, (squares - 1) as f32);
    (place as usize, place.fract())
}

/// Writes every value of rows of `lines` lines of `squares` values, weighted with those around it: `window` holds an odd number of
/// weights, of rows and of columns alike. Beyond the frame there is nothing.
///
/// # Panics
/// If lengths do not fit.
pub fn around(values: &[f32], lines: usize, squares: usize, window: &[f32], output: &mut [f32]) {
    let row_len = lines * squares;
    assert_eq!((values.len(), values.len() % row_len), (output.len(), 0));
    output.par_chunks_mut(row_len).enumerate().for_each_init(
        || vec![0.0; row_len],
        |of_rows, (row, output)| {
            vectorised::run(Around { values, row, squares, window, of_rows, output });
        },
    );
}

/// A row of [`around`].
struct Around<'a> {
    values: &'a [f32],
    row: usize,
    squares: usize,
    window: &'a [f32],
    /// Memory for the weighted sum of rows.
    of_rows: &'a mut [f32],
    output: &'a mut [f32],
}

impl Vectorised for Around<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { values, row, squares, window, of_rows, output } = self;
        let reach = window.len() / 2;
        // The window begins above the first row where that is nearer than it reaches.
        let (first, skipped) = (row.saturating_sub(reach), reach.saturating_sub(row));
        let rows = values.chunks_exact(of_rows.len()).skip(first);
        add_weighted(window[skipped..].iter().copied().zip(rows), of_rows);
        for (output, line) in output.chunks_exact_mut(squares).zip(of_rows.chunks_exact(squares)) {
            output.fill(0.0);
            for (tap, weight) in window.iter().enumerate() {
                let to = reach.saturating_sub(tap).min(squares);
                let from = tap.saturating_sub(reach).min(squares);
                output[to..].iter_mut().zip(&line[from..]).for_each(|(sum, v)| *sum += weight * v);
            }
        }
    }
}

/// Writes the weighted sum of lines, two of them at a time.
#[inline(always)]
fn add_weighted<'a>(mut lines: impl Iterator<Item = (f32, &'a [f32])>, output: &mut [f32]) {
    let (weight, line) = lines.next().expect("there is a line");
    output.iter_mut().zip(line).for_each(|(sum, v)| *sum = weight * v);
    while let Some((weight, line)) = lines.next() {
        match lines.next() {
            Some((next_weight, next)) => {
                for (sum, (a, b)) in output.iter_mut().zip(line.iter().zip(next)) {
                    *sum += weight * a + next_weight * b;
                }
            }
            None => output.iter_mut().zip(line).for_each(|(sum, v)| *sum += weight * v),
        }
    }
}
