//! Means over the squares around pixels, as far as these lie inside of the frame.

use crate::kernels::vectorised::{self, Vectorised};

/// For each pixel of a row of a plane of (width, height), the mean over those that are at most `reach` rows and
/// columns away.
pub fn row(plane: &[f32], (width, height): (usize, usize), y: usize, reach: usize, out: &mut [f32]) {
    let rows = span(y, height, reach);
    let near = &plane[rows.start * width..rows.end * width];
    vectorised::run(Row { near, reach, columns: vec![0.0; width], out });
}

/// What of `0..end` is at most `reach` away.
fn span(at: usize, end: usize, reach: usize) -> std::ops::Range<usize> {
    at.saturating_sub(reach)..(at + reach + 1).min(end)
}

/// A row of means.
struct Row<'a> {
    /// The rows that they are of.
    near: &'a [f32],
    reach: usize,
    /// Zeros, to sum up the columns in.
    columns: Vec<f32>,
    out: &'a mut [f32],
}

impl Vectorised for Row<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { near, reach, mut columns, out } = self;
        let width = out.len();
        for line in near.chunks_exact(width) {
            columns.iter_mut().zip(line).for_each(|(sum, v)| *sum += v);
        }
        let rows = (near.len() / width) as f32;
        // Columns that have all their neighbours are summed up a shift at a time, which is vectorised.
        let whole = 2 * reach + 1;
        let inner = reach.min(width)..width.saturating_sub(reach).max(reach.min(width));
        let sums = &mut out[inner.clone()];
        sums.fill(0.0);
        for shifted in (0..whole).filter_map(|first| columns.get(first..)) {
            sums.iter_mut().zip(shifted).for_each(|(sum, v)| *sum += v);
        }
        let share = 1.0 / (rows * whole as f32);
        sums.iter_mut().for_each(|sum| *sum *= share);
        for x in (0..inner.start).chain(inner.end..width) {
            let near = &columns[span(x, width, reach)];
            out[x] = near.iter().sum::<f32>() / (rows * near.len() as f32);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    #[test]
    fn means_are_those_of_the_pixels_that_are_there() {
        let mut rng = Rng::new(5, 0);
        for (w, h) in [(1, 1), (2, 5), (5, 2), (7, 7), (40, 9)] {
            let plane: Vec<f32> = (0..w * h).map(|_| rng.uniform()).collect();
            for (reach, y) in [0, 1, 3].into_iter().flat_map(|reach| (0..h).map(move |y| (reach, y))) {
                let mut means = vec![f32::NAN; w];
                row(&plane, (w, h), y, reach, &mut means);
                for (x, mean) in means.iter().enumerate() {
                    let inside: Vec<f32> = span(y, h, reach)
                        .flat_map(|y| span(x, w, reach).map(move |x| (x, y)))
                        .map(|(x, y)| plane[y * w + x])
                        .collect();
                    let want = inside.iter().sum::<f32>() / inside.len() as f32;
                    assert!((mean - want).abs() < 1e-6, "{w}x{h}, {reach}, {x}, {y}: {mean} and {want}");
                }
            }
        }
    }
}
