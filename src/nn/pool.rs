//! Recycled activation buffers: after the first pass no layer allocates, and no page is faulted in.

use std::{
    collections::HashMap,
    ops::{Deref, DerefMut},
    sync::{LazyLock, Mutex, PoisonError},
};

use crate::kernels::{Block, Shape, View, ViewMut};

/// Free buffers by shape. A buffer keeps its zero border for life, because kernels write interiors
/// only; sharing buffers between shapes would break that.
static FREE: LazyLock<Mutex<HashMap<Shape, Vec<Vec<Block>>>>> = LazyLock::new(Mutex::default);

/// A blocked activation's memory, returned to the pool when dropped. Its interior holds whatever the
/// last user left.
#[derive(Debug)]
pub struct Buffer {
    shape: Shape,
    data: Vec<Block>,
}

impl Buffer {
    /// A buffer whose border is zero and whose interior is arbitrary.
    pub fn new(shape: Shape) -> Self {
        let reused = FREE.lock().unwrap_or_else(PoisonError::into_inner).get_mut(&shape).and_then(Vec::pop);
        Self { shape, data: reused.unwrap_or_else(|| vec![Block::default(); shape.blocks()]) }
    }

    /// Its extent.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// To read.
    pub fn view(&self) -> View<'_> {
        View::new(self.shape, &self.data)
    }

    /// To write.
    pub fn view_mut(&mut self) -> ViewMut<'_> {
        ViewMut::new(self.shape, &mut self.data)
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

impl Drop for Buffer {
    fn drop(&mut self) {
        let data = std::mem::take(&mut self.data);
        FREE.lock().unwrap_or_else(PoisonError::into_inner).entry(self.shape).or_default().push(data);
    }
}

/// Free planar buffers by length.
static FREE_PLANES: LazyLock<Mutex<HashMap<usize, Vec<Vec<f32>>>>> = LazyLock::new(Mutex::default);

/// The memory of planar images, returned to the pool when dropped. Its values are whatever the last
/// user left.
#[derive(Debug)]
pub struct PlaneBuffer(Vec<f32>);

impl PlaneBuffer {
    /// A buffer of arbitrary values.
    pub fn new(len: usize) -> Self {
        let reused =
            FREE_PLANES.lock().unwrap_or_else(PoisonError::into_inner).get_mut(&len).and_then(Vec::pop);
        Self(reused.unwrap_or_else(|| vec![0.0; len]))
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
        &self.0
    }
}

impl DerefMut for PlaneBuffer {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.0
    }
}

impl Drop for PlaneBuffer {
    fn drop(&mut self) {
        let data = std::mem::take(&mut self.0);
        FREE_PLANES.lock().unwrap_or_else(PoisonError::into_inner).entry(data.len()).or_default().push(data);
    }
}

/// Gives every free buffer back to the system: for when frames of another size follow.
pub fn clear() {
    FREE.lock().unwrap_or_else(PoisonError::into_inner).clear();
    FREE_PLANES.lock().unwrap_or_else(PoisonError::into_inner).clear();
    crate::kernels::bf16::clear();
}
