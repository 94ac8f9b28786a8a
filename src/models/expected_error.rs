//! How far off a result is expected to be.

use crate::{
    filters::squares::{SQUARE, between},
    planes::Planes,
};

/// The squared error to be expected of each pixel of a denoised frame, relative to the squared light there.
/// RelMSE ([`crate::metrics::error::relmse`]) is the mean of such errors.
#[derive(Clone, Debug)]
pub struct ExpectedError {
    /// The error of each 4x4 square of pixels, (1, H / 4, W / 4) rounded up.
    squares: Planes,
    /// Columns and rows of pixels.
    size: (usize, usize),
    /// Width and height of the frame that they are a part of, and the column and row at which they begin in
    /// it. No error is expected elsewhere.
    whole: (usize, usize),
    place: (usize, usize),
}

impl ExpectedError {
    /// The errors `squares` of a frame of `size` columns and rows.
    pub(crate) fn new(squares: Planes, size: (usize, usize)) -> Self {
        Self { squares, size, whole: size, place: (0, 0) }
    }

    /// The errors of a frame that is kept as it is, which are zero.
    pub(crate) fn none(size: (usize, usize)) -> Self {
        Self::new(Planes::new(1, size.0.div_ceil(SQUARE), size.1.div_ceil(SQUARE)), size)
    }

    /// These errors as part of a larger frame in which nothing else was denoised.
    pub(crate) fn placed_in(self, whole: (usize, usize), place: (usize, usize)) -> Self {
        Self { whole, place, ..self }
    }

    /// These errors, of all columns of a frame or of some rows of it, without `columns` columns at either edge, which on
    /// the left must be whole squares.
    pub(crate) fn without_margins(self, columns: usize) -> Self {
        let width = self.size.0 - 2 * columns;
        let at = (columns / SQUARE, 0);
        let squares = self.squares.window(at, (width.div_ceil(SQUARE), self.squares.height));
        Self { squares, size: (width, self.size.1), whole: (width, self.whole.1), place: self.place }
    }

    /// The mean over the frame: its expected RelMSE.
    pub fn mean(&self) -> f64 {
        let ((width, height), squares) = (self.size, self.squares.width);
        let length = |at: usize, end: usize| (end - at * SQUARE).min(SQUARE);
        let values = self.squares.data.iter().enumerate();
        let sum: f64 = values
            .map(|(at, error)| {
                f64::from(*error) * (length(at % squares, width) * length(at / squares, height)) as f64
            })
            .sum();
        sum / (self.whole.0 * self.whole.1).max(1) as f64
    }

    /// The error of every pixel, (1, H, W).
    pub fn plane(&self) -> Planes {
        let Self { squares, size: (width, height), whole, place } = self;
        let part = Planes::from_rows(1, (*width, *height), |_, y, row| {
            let (above, down) = between(y, squares.height);
            let below = (above + 1).min(squares.height - 1);
            let [above, below] = [above, below].map(|at| squares.row(0, at));
            for (x, value) in row.iter_mut().enumerate() {
                let (left, across) = between(x, squares.width);
                let right = (left + 1).min(squares.width - 1);
                let [left, right] = [left, right].map(|at| above[at] + (below[at] - above[at]) * down);
                *value = left + (right - left) * across;
            }
        });
        if whole == &self.size { part } else { part.placed_in(*whole, *place) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Errors of 1, 2, 3 ... by squares.
    fn counted(size: (usize, usize)) -> ExpectedError {
        let (squares, rows) = (size.0.div_ceil(SQUARE), size.1.div_ceil(SQUARE));
        let values = (1..=squares * rows).map(|v| v as f32).collect();
        ExpectedError::new(Planes::from_vec(1, squares, rows, values), size)
    }

    #[test]
    fn a_frame_has_the_mean_of_its_pixels() {
        // Squares of 4, 4 and 1 columns and of 4 and 2 rows.
        let mean = (4.0 * (4.0 * 1.0 + 4.0 * 2.0 + 3.0) + 2.0 * (4.0 * 4.0 + 4.0 * 5.0 + 6.0)) / 54.0;
        assert!((counted((9, 6)).mean() - mean).abs() < 1e-6);
        let placed = counted((9, 6)).placed_in((12, 9), (2, 1));
        assert!((placed.mean() - mean * 54.0 / 108.0).abs() < 1e-6);
    }

    #[test]
    fn pixels_lie_between_the_middles_of_their_squares() {
        let plane = counted((9, 6)).placed_in((12, 9), (2, 1)).plane();
        assert_eq!((plane.width, plane.height, plane.channels), (12, 9, 1));
        let at = |x: usize, y: usize| plane.data[y * 12 + x];
        assert_eq!((at(0, 0), at(11, 8), at(1, 3)), (0.0, 0.0, 0.0), "outside nothing is expected");
        assert_eq!(at(2, 1), 1.0, "a corner has its square's");
        // The last pixel lies 5/8 of the way to the last column's middle, and 7/8 of the way to the last row's.
        assert_eq!(at(10, 6), 1.0 + 1.625 + 0.875 * 3.0);
        // Pixels 1 and 2 of a square are an eighth of the way before and beyond its middle.
        assert!((at(2 + 5, 1) - 1.875).abs() < 1e-6 && (at(2 + 2, 1) - 1.125).abs() < 1e-6);
    }

    #[test]
    fn margins_come_off() {
        let narrow = counted((2 * 8 + 5, 4)).without_margins(8);
        assert_eq!((&narrow.squares.data[..], narrow.size), (&[3.0, 4.0][..], (5, 4)));
        // Of rows that are a part of the frame.
        let rows = counted((2 * 8 + 5, 4)).placed_in((2 * 8 + 5, 8), (0, 4)).without_margins(8);
        assert_eq!((rows.whole, rows.place, rows.mean()), ((5, 8), (0, 4), (3.0 * 16.0 + 4.0 * 4.0) / 40.0));
    }
}
