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

/// Writes, for every pixel of a row, the value of a line of squares between the centres of the two that are nearest.
#[inline(always)]
pub fn spread(line: &[f32], row: &mut [f32]) {
    const HALF: usize = SQUARE / 2;
    let (width, squares) = (row.len(), line.len());
    // All pixels from the centre of one square to the centre of the next are interpolated between these two.
    let runs = row.get_mut(HALF..).unwrap_or_default().as_chunks_mut::<SQUARE>().0;
    let end = HALF + SQUARE * runs.len().min(squares - 1);
    for (run, (left, right)) in runs.iter_mut().zip(line.iter().zip(&line[1..])) {
        for (i, value) in run.iter_mut().enumerate() {
            *value = left + (right - left) * ((i as f32 + 0.5) / SQUARE as f32);
        }
    }
    for x in (0..HALF.min(width)).chain(end..width) {
        let (left, share) = between(x, squares);
        row[x] = line[left] + (line[(left + 1).min(squares - 1)] - line[left]) * share;
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_spread_between_the_centres_of_squares() {
        for width in [1usize, 2, 3, 4, 5, 7, 8, 93, 1917] {
            let squares = width.div_ceil(SQUARE);
            let line: Vec<f32> = (0..squares).map(|s| ((s * 37) % 11) as f32 - 4.3).collect();
            let mut row = vec![f32::NAN; width];
            spread(&line, &mut row);
            for (x, value) in row.into_iter().enumerate() {
                let (left, share) = between(x, squares);
                let right = line[(left + 1).min(squares - 1)];
                assert_eq!(
                    value.to_bits(),
                    (line[left] + (right - line[left]) * share).to_bits(),
                    "{x} of {width}"
                );
            }
        }
    }
}
