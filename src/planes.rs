//! Planar f32 images: what passes, features, models and metrics hand to one another.

use rayon::prelude::*;

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
    pub data: Vec<f32>,
}

impl Planes {
    /// All zero.
    pub fn new(channels: usize, width: usize, height: usize) -> Self {
        Self { channels, width, height, data: vec![0.0; channels * width * height] }
    }

    /// Wraps (C, H, W) data.
    ///
    /// # Panics
    /// If `data.len() != channels * width * height`.
    pub fn from_vec(channels: usize, width: usize, height: usize, data: Vec<f32>) -> Self {
        assert_eq!(data.len(), channels * width * height, "planes are channels x height x width");
        Self { channels, width, height, data }
    }

    /// What `fill(channel, row's number, row)` writes into each row; rows are filled on all threads.
    pub fn from_rows(
        channels: usize,
        (width, height): (usize, usize),
        fill: impl Fn(usize, usize, &mut [f32]) + Sync,
    ) -> Self {
        let mut planes = Self::new(channels, width, height);
        let rows = planes.data.par_chunks_mut(width.max(1)).enumerate();
        rows.for_each(|(i, row)| fill(i / height, i % height, row));
        planes
    }

    /// Pixels in one plane.
    pub fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// One plane, row-major.
    pub fn channel(&self, c: usize) -> &[f32] {
        &self.data[c * self.pixels()..][..self.pixels()]
    }

    /// One plane, row-major, writable.
    pub fn channel_mut(&mut self, c: usize) -> &mut [f32] {
        let n = self.pixels();
        &mut self.data[c * n..][..n]
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

    /// The planes after half a turn: the last pixel becomes the first.
    pub fn turned(&self) -> Self {
        let (w, h) = (self.width, self.height);
        Self::from_rows(self.channels, (w, h), |c, y, out| {
            let from = &self.channel(c)[(h - 1 - y) * w..][..w];
            out.iter_mut().zip(from.iter().rev()).for_each(|(out, from)| *out = *from);
        })
    }

    /// Grows the planes, to the right and below, by repeating the last column and row.
    ///
    /// # Panics
    /// If they are empty, or larger.
    pub fn padded_to(self, (width, height): (usize, usize)) -> Self {
        if (width, height) == (self.width, self.height) {
            return self;
        }
        assert!(self.width <= width && self.height <= height, "padding only adds");
        Self::from_rows(self.channels, (width, height), |c, y, out| {
            let from = &self.channel(c)[y.min(self.height - 1) * self.width..][..self.width];
            out[..self.width].copy_from_slice(from);
            out[self.width..].fill(from[self.width - 1]);
        })
    }

    /// How many values are NaN or infinite.
    pub fn non_finite(&self) -> usize {
        self.data.iter().filter(|v| !v.is_finite()).count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn padding_repeats_the_edge_and_a_window_undoes_it() {
        let planes = Planes::from_vec(2, 3, 1, vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        let padded = planes.clone().padded_to((4, 4));
        assert_eq!((padded.width, padded.height), (4, 4));
        assert_eq!(padded.channel(1), [4.0, 5.0, 6.0, 6.0].repeat(4));
        assert_eq!(padded.window((0, 0), (3, 1)), planes);
    }

    #[test]
    fn half_a_turn_reverses_every_channel_and_two_change_nothing() {
        let planes = Planes::from_vec(2, 3, 2, (0..12).map(|v| v as f32).collect());
        let turned = planes.turned();
        assert_eq!(turned.channel(1), [11.0, 10.0, 9.0, 8.0, 7.0, 6.0]);
        assert_eq!(turned.turned(), planes);
    }
}
