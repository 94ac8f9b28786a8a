//! Planar f32 images: what passes, features, models and metrics hand to one another.

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
        let mut out = Self::new(self.channels, width, height);
        for c in 0..self.channels {
            let from = self.channel(c);
            for (row, out) in out.channel_mut(c).chunks_mut(width.max(1)).enumerate() {
                out.copy_from_slice(&from[(y + row) * self.width + x..][..width]);
            }
        }
        out
    }

    /// How many values are NaN or infinite.
    pub fn non_finite(&self) -> usize {
        self.data.iter().filter(|v| !v.is_finite()).count()
    }
}
