//! Recycled memory: after the first pass over a frame no layer allocates, and no page is faulted in.
#![deny(unsafe_code)]

use std::{
    ops::{Deref, DerefMut},
    slice,
    sync::{Mutex, PoisonError},
};

use half::f16;
use rayon::prelude::*;

/// Bytes from which on memory is not kept for later: the system takes as much back as a whole, and what planes of
/// an 8K frame leave free fills the memory of a computer.
const LARGE: usize = 64 << 20;

/// Free memory for values of one type. What it holds is whatever the last user left.
#[derive(Debug)]
pub struct Pool<T: 'static>(Mutex<Vec<Vec<T>>>);

impl<T: Clone> Pool<T> {
    /// An empty pool.
    pub const fn new() -> Self {
        Self(Mutex::new(Vec::new()))
    }

    /// Memory for `len` values: the smallest that is free and holds them, unless more than half of it would
    /// lie idle, else new memory, filled with `value`.
    pub fn take(&'static self, len: usize, value: T) -> Pooled<T> {
        let data = self.take_free(len).unwrap_or_else(|| vec![value; len]);
        Pooled { len, data, pool: Some(self) }
    }

    /// Memory as [`Pool::take`] gives it, all of it `value`; none where the system has no room for new memory.
    pub fn try_filled(&'static self, len: usize, value: T) -> Option<Pooled<T>> {
        let data = match self.take_free(len) {
            Some(mut free) => {
                free[..len].fill(value);
                free
            }
            None => {
                let mut new = Vec::new();
                new.try_reserve_exact(len).ok()?;
                new.resize(len, value);
                new
            }
        };
        Some(Pooled { len, data, pool: Some(self) })
    }

    /// Free memory that fits. Where there is none, as much that is free and too small goes back to the system
    /// as new memory will take, what was not used for the longest time first: frames that grow leave nothing
    /// behind.
    fn take_free(&self, len: usize) -> Option<Vec<T>> {
        let mut free = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let fits = |(_, data): &(usize, &Vec<T>)| (len..=2 * len).contains(&data.len());
        if let Some((at, _)) = free.iter().enumerate().filter(fits).min_by_key(|(_, data)| data.len()) {
            return Some(free.remove(at));
        }
        let mut given_back = 0;
        free.retain(|data| {
            let stays = given_back >= len || data.len() >= len;
            given_back += if stays { 0 } else { data.len() };
            stays
        });
        None
    }
}

impl<T> Pool<T> {
    /// Gives all free memory back to the system.
    pub fn clear(&self) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clear();
    }
}

impl<T: Clone> Default for Pool<T> {
    fn default() -> Self {
        Self::new()
    }
}

/// Values in memory that goes back to its pool, if it is from one, when they are dropped.
#[derive(Debug)]
pub struct Pooled<T: 'static> {
    len: usize,
    /// At least `len`.
    data: Vec<T>,
    pool: Option<&'static Pool<T>>,
}

impl<T> Default for Pooled<T> {
    fn default() -> Self {
        Vec::new().into()
    }
}

/// The memory belongs to no pool, since memory allocated elsewhere would only pile up there.
impl<T> From<Vec<T>> for Pooled<T> {
    fn from(data: Vec<T>) -> Self {
        Self { len: data.len(), data, pool: None }
    }
}

/// As from a `Vec`.
impl<T> FromIterator<T> for Pooled<T> {
    fn from_iter<I: IntoIterator<Item = T>>(values: I) -> Self {
        Vec::from_iter(values).into()
    }
}

impl<T: Clone> Clone for Pooled<T> {
    fn clone(&self) -> Self {
        let Some(pool) = self.pool else { return self.to_vec().into() };
        let Some(first) = self.first() else { return Self::default() };
        let mut copy = pool.take(self.len, first.clone());
        copy.clone_from_slice(self);
        copy
    }
}

impl<T> AsRef<[T]> for Pooled<T> {
    fn as_ref(&self) -> &[T] {
        self
    }
}

impl<T: PartialEq, U: AsRef<[T]> + ?Sized> PartialEq<U> for Pooled<T> {
    fn eq(&self, other: &U) -> bool {
        **self == *other.as_ref()
    }
}

impl<'a, T> IntoIterator for &'a Pooled<T> {
    type Item = &'a T;
    type IntoIter = slice::Iter<'a, T>;
    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

impl<'a, T: Sync> IntoParallelIterator for &'a Pooled<T> {
    type Item = &'a T;
    type Iter = rayon::slice::Iter<'a, T>;
    fn into_par_iter(self) -> Self::Iter {
        (**self).par_iter()
    }
}

impl<T> Deref for Pooled<T> {
    type Target = [T];
    fn deref(&self) -> &[T] {
        &self.data[..self.len]
    }
}

impl<T> DerefMut for Pooled<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.data[..self.len]
    }
}

impl<T> Drop for Pooled<T> {
    fn drop(&mut self) {
        let data = std::mem::take(&mut self.data);
        if let Some(pool) = self.pool.filter(|_| size_of_val(&data[..]) < LARGE) {
            pool.0.lock().unwrap_or_else(PoisonError::into_inner).push(data);
        }
    }
}

/// Bytes of a copy that are worth a task of their own.
const COPIED: usize = 64 << 10;

/// Copies values by all threads.
///
/// # Panics
/// If there are not as many.
pub fn copy<T: Copy + Send + Sync>(into: &mut [T], from: &[T]) {
    assert_eq!(into.len(), from.len(), "as many values");
    let piece = COPIED / size_of::<T>();
    into.par_chunks_mut(piece)
        .zip(from.par_chunks(piece))
        .for_each(|(into, from)| into.copy_from_slice(from));
}

/// The values of planar images.
pub type PlaneBuffer = Pooled<f32>;

static PLANES: Pool<f32> = Pool::new();

/// Memory for `len` values of planar images, which are whatever the last user left.
pub fn plane_buffer(len: usize) -> PlaneBuffer {
    PLANES.take(len, 0.0)
}

/// The values of planar images that wait.
pub type HalfBuffer = Pooled<f16>;

static HALVES: Pool<f16> = Pool::new();

/// As [`plane_buffer`], of half floats.
pub fn half_buffer(len: usize) -> HalfBuffer {
    HALVES.take(len, f16::ZERO)
}

/// Zeros, as values of planar images; none where the system has no room for them.
pub fn try_zeros(len: usize) -> Option<PlaneBuffer> {
    PLANES.try_filled(len, 0.0)
}

/// Gives all free memory of planar images back to the system.
pub fn clear() {
    PLANES.clear();
    HALVES.clear();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_that_grow_leave_nothing_behind() {
        static POOL: Pool<u8> = Pool::new();
        let lens = || POOL.0.lock().unwrap().iter().map(Vec::len).collect::<Vec<_>>();
        drop([POOL.take(100, 0), POOL.take(10, 0)]);
        drop([POOL.take(90, 0), POOL.take(8, 0)]);
        assert_eq!(lens(), [100, 10], "what fits is used again");
        drop([POOL.take(120, 0), POOL.take(12, 0)]);
        assert_eq!(lens(), [120, 12]);
        drop([POOL.take(30, 0), POOL.take(120, 0)]);
        assert_eq!(lens(), [30, 120], "what is larger is kept for frames to come");
    }
}
