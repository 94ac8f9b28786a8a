//! The memory of activations and planar images, recycled.

use std::ops::{Deref, DerefMut};

pub use crate::kernels::memory::{PlaneBuffer, plane_buffer};
use crate::kernels::{
    Block, Shape, View, ViewMut,
    memory::{self, Pool, Pooled},
};

static BLOCKS: Pool<Block> = Pool::new();

/// The values of a blocked activation.
#[derive(Debug)]
pub struct Buffer {
    shape: Shape,
    data: Pooled<Block>,
}

impl Buffer {
    /// A buffer whose border is zero and whose interior is arbitrary.
    pub fn new(shape: Shape) -> Self {
        let mut data = BLOCKS.take(shape.blocks(), Block::default());
        shape.plane().fill_border(&mut data, Block::default());
        Self { shape, data }
    }

    /// Its extent.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// Copies `count` rows of another activation of the same width and channels, from its row `from` on, to
    /// row `to` on. Rows -1 and H lie in the border. They may be copied where the activation is a part of a
    /// taller one, whose rows the border then holds.
    ///
    /// # Panics
    /// If the two do not fit together, or hold several images.
    pub fn copy_rows(&mut self, to: isize, source: &Buffer, from: isize, count: usize) {
        let (shape, other) = (self.shape, source.shape);
        assert_eq!((shape.with_size(0, shape.w), shape.n), (other.with_size(0, other.w), 1));
        shape.plane().copy_rows((self, to), other.plane(), (source, from), count);
    }

    /// The values, to read.
    pub fn view(&self) -> View<'_> {
        View::new(self.shape, self)
    }

    /// The values, to write.
    pub fn view_mut(&mut self) -> ViewMut<'_> {
        ViewMut::new(self.shape, self)
    }
}

impl Deref for Buffer {
    type Target = [Block];
    fn deref(&self) -> &[Block] {
        &self.data
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut [Block] {
        &mut self.data
    }
}

/// [`plane_buffer`] of zeros.
pub fn zeros(len: usize) -> PlaneBuffer {
    let mut buffer = plane_buffer(len);
    buffer.fill(0.0);
    buffer
}

/// Gives all free memory back to the system: for when frames of another size follow.
pub fn clear() {
    BLOCKS.clear();
    memory::clear();
    crate::kernels::narrow::clear();
    crate::kernels::weight_grad::clear();
    crate::kernels::winograd::clear();
}
