//! Planar f32 images: what passes, features, models and metrics hand to one another.

use std::ops::Range;

use rayon::prelude::*;

use crate::kernels::memory::{PlaneBuffer, plane_buffer};

/// Planes whose values are read as f32, however they are stored.
pub trait Values: Sync {
    /// Channels, pixels in a row, and rows.
    fn extent(&self) -> (usize, usize, usize);

    /// Reads values of a channel, from pixel number `first` on, until `out` is full.
    ///
    /// # Panics
    /// If there are not so many.
    fn read(&self, channel: usize, first: usize, out: &mut [f32]);
}

impl Values for Planes {
    fn extent(&self) -> (usize, usize, usize) {
        self.extent()
    }

    fn read(&self, channel: usize, first: usize, out: &mut [f32]) {
        out.copy_from_slice(&self.channel(channel)[first..][..out.len()]);
    }
}

/// `channels` planes of `height` x `width` f32, channel after channel, rows top to bottom.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Planes {
    /// Number of channels.
    pub channels: usize,
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `channels * height * width` values, (C, H, W).
    pub data: PlaneBuffer,
}

impl Planes {
    /// All zero.
    pub fn new(channels: usize, width: usize, height: usize) -> Self {
        Self { channels, width, height, data: vec![0.0; channels * width * height].into() }
    }

    /// Wraps (C, H, W) data.
    ///
    /// # Panics
    /// If `data.len() != channels * width * height`.
    pub fn from_vec(channels: usize, width: usize, height: usize, data: Vec<f32>) -> Self {
        assert_eq!(data.len(), channels * width * height, "planes are channels x height x width");
        Self { channels, width, height, data: data.into() }
    }

    /// Planes whose values are whatever was last in their memory, to be written over.
    pub fn unwritten(channels: usize, width: usize, height: usize) -> Self {
        Self { channels, width, height, data: plane_buffer(channels * width * height) }
    }

    /// Planes each of whose rows `fill(channel, row's number, row)` writes as a whole. Rows are filled on all
    /// threads.
    pub fn from_rows(
        channels: usize,
        (width, height): (usize, usize),
        fill: impl Fn(usize, usize, &mut [f32]) + Sync,
    ) -> Self {
        let mut planes = Self::unwritten(channels, width, height);
        let rows = planes.data.par_chunks_mut(width.max(1)).enumerate();
        rows.for_each(|(i, row)| fill(i / height, i % height, row));
        planes
    }

    /// As [`Planes::from_rows`], but `fill(row's number, rows)` writes that row of every channel.
    pub fn from_rows_of_all(
        channels: usize,
        (width, height): (usize, usize),
        fill: impl Fn(usize, &mut [&mut [f32]]) + Sync,
    ) -> Self {
        let mut planes = Self::unwritten(channels, width, height);
        let mut rows: Vec<Vec<&mut [f32]>> = (0..height).map(|_| Vec::with_capacity(channels)).collect();
        for plane in planes.data.chunks_exact_mut((width * height).max(1)) {
            rows.iter_mut().zip(plane.chunks_exact_mut(width)).for_each(|(rows, row)| rows.push(row));
        }
        rows.par_iter_mut().enumerate().for_each(|(y, rows)| fill(y, rows));
        drop(rows);
        planes
    }

    /// Channels, pixels in a row, and rows.
    pub fn extent(&self) -> (usize, usize, usize) {
        (self.channels, self.width, self.height)
    }

    /// Pixels in one plane.
    pub fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// Planes of as many `channels`, each a copy of the first channel of these planes.
    pub fn of_first(&self, channels: usize) -> Self {
        Self::from_rows(channels, (self.width, self.height), |_, y, row| {
            row.copy_from_slice(self.row(0, y));
        })
    }

    /// One plane, row-major.
    pub fn channel(&self, c: usize) -> &[f32] {
        &self.data[c * self.pixels()..][..self.pixels()]
    }

    /// A row of a channel.
    pub fn row(&self, c: usize, y: usize) -> &[f32] {
        &self.channel(c)[y * self.width..][..self.width]
    }

    /// A row of each of the first three channels.
    pub fn rows(&self, y: usize) -> [&[f32]; 3] {
        [0, 1, 2].map(|c| self.row(c, y))
    }

    /// The pixels (x, y) at most `reach` rows and columns away from one, itself included.
    #[inline]
    pub fn near(&self, x: usize, y: usize, reach: usize) -> impl Iterator<Item = (usize, usize)> + use<> {
        let around = |at: usize, end: usize| at.saturating_sub(reach)..(at + reach + 1).min(end);
        let columns = around(x, self.width);
        around(y, self.height).flat_map(move |y| columns.clone().map(move |x| (x, y)))
    }

    /// One plane, row-major, writable.
    pub fn channel_mut(&mut self, c: usize) -> &mut [f32] {
        let n = self.pixels();
        &mut self.data[c * n..][..n]
    }

    /// Copies a rectangle of (width, height) pixels from the planes `other`, where its first column and row
    /// are `from`, into these planes, where they are `to`.
    ///
    /// # Panics
    /// If the numbers of channels differ, or the rectangle does not lie inside both.
    pub fn write(
        &mut self,
        to: (usize, usize),
        other: &Self,
        from: (usize, usize),
        (width, height): (usize, usize),
    ) {
        assert_eq!(self.channels, other.channels, "as many channels");
        let lies_inside = |planes: &Self, (x, y)| x + width <= planes.width && y + height <= planes.height;
        assert!(lies_inside(self, to) && lies_inside(other, from), "the rectangle lies inside");
        let own_width = self.width;
        for c in 0..self.channels {
            let (into, values) = (self.channel_mut(c), other.channel(c));
            for y in 0..height {
                let values = &values[(from.1 + y) * other.width + from.0..][..width];
                into[(to.1 + y) * own_width + to.0..][..width].copy_from_slice(values);
            }
        }
    }

    /// These planes, cut to some of their columns.
    ///
    /// # Panics
    /// If there are no such columns.
    pub fn columns(self, columns: Range<usize>) -> Self {
        if columns == (0..self.width) {
            return self;
        }
        self.window((columns.start, 0), (columns.len(), self.height))
    }

    /// A rectangle of pixels, from column `x` and row `y`: cuts tiles and undoes padding.
    ///
    /// # Panics
    /// If the rectangle leaves the planes.
    pub fn window(&self, (x, y): (usize, usize), (width, height): (usize, usize)) -> Self {
        assert!(x + width <= self.width && y + height <= self.height, "the rectangle lies inside");
        Self::from_rows(self.channels, (width, height), |c, row, out| {
            out.copy_from_slice(&self.channel(c)[(y + row) * self.width + x..][..width]);
        })
    }

    /// Planes of (width, height) that hold these planes from column `x` and row `y` on, and zeros elsewhere.
    ///
    /// # Panics
    /// If these planes reach beyond (width, height).
    pub fn placed_in(&self, (width, height): (usize, usize), (x, y): (usize, usize)) -> Self {
        let mut whole = Self::new(self.channels, width, height);
        whole.write((x, y), self, (0, 0), (self.width, self.height));
        whole
    }

    /// The planes after half a turn: the last pixel becomes the first.
    pub fn turned(&self) -> Self {
        let (w, h) = (self.width, self.height);
        Self::from_rows(self.channels, (w, h), |c, y, out| {
            out.iter_mut().zip(self.row(c, h - 1 - y).iter().rev()).for_each(|(out, from)| *out = *from);
        })
    }

    /// Grows the planes to (width, height), to the right and below, by their mirror image about the last
    /// column and row. If these were repeated instead, they would draw their noise out to streaks, which a
    /// network takes for something that is there.
    ///
    /// # Panics
    /// If the planes are empty, or larger than (width, height).
    pub fn padded_to(self, (width, height): (usize, usize)) -> Self {
        if (width, height) == (self.width, self.height) {
            return self;
        }
        self.padded_rows(0..self.height, (width, height))
    }

    /// Some rows of the planes, grown to (width, height) as [`Planes::padded_to`] does.
    ///
    /// # Panics
    /// If the rows are empty, larger than (width, height), or beyond the planes.
    pub fn padded_rows(&self, rows: Range<usize>, (width, height): (usize, usize)) -> Self {
        assert!(self.width <= width && rows.len() <= height, "padding only adds");
        Self::from_rows(self.channels, (width, height), |c, y, out| {
            let y = rows.start + mirrored(y, rows.len());
            out[..self.width].copy_from_slice(self.row(c, y));
            mirror_beyond(out, self.width);
        })
    }

    /// These planes with the planes `below`, of the same width and number of channels, attached under them.
    ///
    /// # Panics
    /// If widths or channels differ.
    pub fn above(&self, below: &Self) -> Self {
        assert_eq!((self.channels, self.width), (below.channels, below.width), "planes that fit");
        Self::from_rows(self.channels, (self.width, self.height + below.height), |c, y, out| {
            let (from, y) = if y < self.height { (self, y) } else { (below, y - self.height) };
            out.copy_from_slice(from.row(c, y));
        })
    }

    /// All planes of these, then all of `more`.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn followed_by(&self, more: &Self) -> Self {
        let size = (self.width, self.height);
        assert_eq!(size, (more.width, more.height), "planes of one size");
        Self::from_rows(self.channels + more.channels, size, |c, y, out| {
            let (from, c) = if c < self.channels { (self, c) } else { (more, c - self.channels) };
            out.copy_from_slice(from.row(c, y));
        })
    }

    /// The first so many planes, and the rest.
    ///
    /// # Panics
    /// If there are fewer.
    pub fn split_after(&self, channels: usize) -> [Self; 2] {
        assert!(channels <= self.channels, "so many planes at least");
        [0..channels, channels..self.channels].map(|of| {
            Self::from_rows(of.len(), (self.width, self.height), |c, y, out| {
                out.copy_from_slice(self.row(of.start + c, y));
            })
        })
    }

    /// Whether all that is not zero lies in the window of (width, height) pixels from (x, y) on.
    ///
    /// # Panics
    /// If that window is not inside of the planes.
    pub fn lies_within(&self, place: (usize, usize), size: (usize, usize)) -> bool {
        let whole = (self.width, self.height);
        size == whole || self.window(place, size).placed_in(whole, place) == *self
    }

    /// Whether there are two different values.
    pub fn varies(&self) -> bool {
        self.data.iter().any(|value| *value != self.data[0])
    }

    /// How many values are NaN or infinite.
    pub fn non_finite(&self) -> usize {
        self.data.iter().filter(|v| !v.is_finite()).count()
    }
}

/// Fills the rest of a row, whose first `width` values are given, with their mirror image.
pub fn mirror_beyond(row: &mut [f32], width: usize) {
    let (inside, beyond) = row.split_at_mut(width);
    beyond.iter_mut().zip(width..).for_each(|(out, x)| *out = inside[mirrored(x, width)]);
}

/// The index below `n` that index `i` falls on when indices run to and fro between the first and the last.
pub fn mirrored(i: usize, n: usize) -> usize {
    let period = (2 * n).saturating_sub(2).max(1);
    (i % period).min(period - i % period)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn padding_mirrors_and_a_window_undoes_it() {
        let planes = Planes::from_vec(2, 3, 2, (0..12).map(|v| v as f32).collect());
        let padded = planes.clone().padded_to((8, 4));
        assert_eq!((padded.width, padded.height), (8, 4));
        let (above, below) =
            ([6.0, 7.0, 8.0, 7.0, 6.0, 7.0, 8.0, 7.0], [9.0, 10.0, 11.0, 10.0, 9.0, 10.0, 11.0, 10.0]);
        assert_eq!(padded.channel(1), [above, below, above, below].concat());
        assert_eq!(padded.window((0, 0), (3, 2)), planes);
        assert_eq!(planes.placed_in((7, 5), (3, 2)).window((3, 2), (3, 2)), planes);
        assert_eq!(
            planes.placed_in((7, 5), (3, 2)).data.iter().sum::<f32>(),
            planes.data.iter().sum::<f32>()
        );
        assert_eq!(Planes::from_vec(1, 1, 1, vec![5.0]).padded_to((3, 2)).data, [5.0; 6]);
    }

    #[test]
    fn planes_above_others_are_those_that_were_cut_apart() {
        let planes = Planes::from_vec(2, 3, 4, (0..24).map(|v| v as f32).collect());
        let [above, below] = [(0, 1), (1, 3)].map(|(y, rows)| planes.window((0, y), (3, rows)));
        assert_eq!(above.above(&below), planes);
    }

    #[test]
    fn half_a_turn_reverses_every_channel_and_two_change_nothing() {
        let planes = Planes::from_vec(2, 3, 2, (0..12).map(|v| v as f32).collect());
        let turned = planes.turned();
        assert_eq!(turned.channel(1), [11.0, 10.0, 9.0, 8.0, 7.0, 6.0]);
        assert_eq!(turned.turned(), planes);
    }
}
