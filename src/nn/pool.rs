//! The memory of activations and planar images, recycled.

use std::ops::{Deref, DerefMut};

use crate::kernels::{Block, Shape, View, ViewMut, memory::Pool};

static BLOCKS: Pool<Block> = Pool::new();
static VALUES: Pool<f32> = Pool::new();

/// A blocked activation's memory, returned to the pool when dropped.
#[derive(Debug)]
pub struct Buffer {
    shape: Shape,
    /// At least `shape.blocks()`.
    data: Vec<Block>,
}

impl Buffer {
    /// A buffer whose border is zero and whose interior is arbitrary.
    pub fn new(shape: Shape) -> Self {
        let mut buffer = Self { shape, data: BLOCKS.take(shape.blocks(), Block::default()) };
        let (stride, pad) = (shape.row_stride(), shape.pad);
        let plane_stride = shape.plane_stride();
        for plane in buffer.chunks_mut(plane_stride) {
            plane[..pad * stride].fill(Block::default());
            plane[plane_stride - pad * stride..].fill(Block::default());
            for row in plane[pad * stride..plane_stride - pad * stride].chunks_mut(stride) {
                row[..pad].fill(Block::default());
                row[stride - pad..].fill(Block::default());
            }
        }
        buffer
    }

    /// Its extent.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// Copies `count` rows of another activation of the same width and channels, from its row `from` on, to
    /// row `to` on. Rows -1 and H are those of the border, which then belong to a taller activation.
    ///
    /// # Panics
    /// If the two do not fit together, or hold several images.
    pub fn copy_rows(&mut self, to: isize, source: &Buffer, from: isize, count: usize) {
        let (shape, other) = (self.shape, source.shape);
        assert_eq!((shape.with_size(0, shape.w), shape.n), (other.with_size(0, other.w), 1));
        let (stride, len) = (shape.row_stride(), count * shape.row_stride());
        let start = |shape: Shape, row: isize| {
            let row = row.checked_add_unsigned(shape.pad).and_then(|row| usize::try_from(row).ok());
            let row = row.filter(|row| row + count <= shape.h + 2 * shape.pad);
            row.expect("rows lie inside the activation") * stride
        };
        let (to, from) = (start(shape, to), start(other, from));
        for plane in 0..shape.planes() {
            let rows = &source[plane * other.plane_stride() + from..][..len];
            self[plane * shape.plane_stride() + to..][..len].copy_from_slice(rows);
        }
    }

    /// To read.
    pub fn view(&self) -> View<'_> {
        View::new(self.shape, self)
    }

    /// To write.
    pub fn view_mut(&mut self) -> ViewMut<'_> {
        ViewMut::new(self.shape, self)
    }
}

impl Deref for Buffer {
    type Target = [Block];
    fn deref(&self) -> &[Block] {
        &self.data[..self.shape.blocks()]
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut [Block] {
        &mut self.data[..self.shape.blocks()]
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        BLOCKS.give(std::mem::take(&mut self.data));
    }
}

/// The memory of planar images, returned to the pool when dropped. Its values are whatever the last
/// user left.
#[derive(Debug)]
pub struct PlaneBuffer {
    len: usize,
    /// At least `len`.
    data: Vec<f32>,
}

impl PlaneBuffer {
    /// A buffer of arbitrary values.
    pub fn new(len: usize) -> Self {
        Self { len, data: VALUES.take(len, 0.0) }
    }

    /// A buffer of zeros.
    pub fn zeros(len: usize) -> Self {
        let mut buffer = Self::new(len);
        buffer.fill(0.0);
        buffer
    }
}

impl Deref for PlaneBuffer {
    type Target = [f32];
    fn deref(&self) -> &[f32] {
        &self.data[..self.len]
    }
}

impl DerefMut for PlaneBuffer {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.data[..self.len]
    }
}

impl Drop for PlaneBuffer {
    fn drop(&mut self) {
        VALUES.give(std::mem::take(&mut self.data));
    }
}

/// Gives every free buffer back to the system: for when frames of another size follow.
pub fn clear() {
    BLOCKS.clear();
    VALUES.clear();
    crate::kernels::bf16::clear();
}
