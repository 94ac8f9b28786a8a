//! Sums over 4x4 squares of pixels and over windows of squares, in which the fits to a frame are gathered (He
//! and Sun 2015: what a guided filter does changes slowly, so it need not be found anew for every pixel).

use crate::kernels::vectorised::{self, Vectorised};

/// Rows and columns of a square.
pub const SQUARE: usize = 4;

/// The square whose centre comes before a pixel, and how far (0..1) the pixel lies from there towards the
/// centre of the next.
pub fn between(at: usize, squares: usize) -> (usize, f32) {
    let place = ((at as f32 + 0.5) / SQUARE as f32 - 0.5).clamp(0.0, (squares - 1) as f32);
    (place as usize, place.fract())
}

/// The rows above, at and below `row` that `window` reaches, each with its weight, as [`around`] reads them.
pub fn rows_around<'a>(
    rows: &'a [&'a [f32]],
    row: usize,
    window: &'a [f32],
) -> impl Iterator<Item = (f32, &'a [f32])> {
    window.iter().enumerate().filter_map(move |(tap, weight)| {
        Some((*weight, *rows.get((row + tap).checked_sub(window.len() / 2)?)?))
    })
}

/// Writes to `output`, for every value of lines of `squares` values, the weighted sum of the values around
/// it. `rows` are those above, at and below it, each with its weight, and `window` holds an odd number of
/// weights for the values to the left and right. Values beyond the frame count as zero.
pub fn around<'a>(
    rows: impl Iterator<Item = (f32, &'a [f32])>,
    squares: usize,
    window: &[f32],
    of_rows: &mut [f32],
    output: &mut [f32],
) {
    vectorised::run(Around { rows, squares, window, of_rows, output });
}

/// See [`around`].
struct Around<'a, R> {
    rows: R,
    squares: usize,
    window: &'a [f32],
    /// Memory for the weighted sum of rows.
    of_rows: &'a mut [f32],
    output: &'a mut [f32],
}

impl<'a, R: Iterator<Item = (f32, &'a [f32])>> Vectorised for Around<'_, R> {
    #[inline(always)]
    fn run(self) {
        let Self { rows, squares, window, of_rows, output } = self;
        let reach = window.len() / 2;
        add_weighted(rows, of_rows);
        output.fill(0.0);
        for (output, line) in output.chunks_exact_mut(squares).zip(of_rows.chunks_exact(squares)) {
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
