//! Recycled memory: after the first pass over a frame no layer allocates, and no page is faulted in.
#![deny(unsafe_code)]

use std::{
    ops::{Deref, DerefMut},
    sync::{Mutex, PoisonError},
};

/// Free memory for values of one type. What it holds is whatever the last user left.
#[derive(Debug)]
pub struct Pool<T: 'static>(Mutex<Vec<Vec<T>>>);

impl<T: Clone> Pool<T> {
    /// An empty pool.
    pub const fn new() -> Self {
        Self(Mutex::new(Vec::new()))
    }

    /// The smallest free memory for `len` values, unless more than half of it would lie idle; else new
    /// memory, filled with `value`.
    pub fn take(&'static self, len: usize, value: T) -> Pooled<T> {
        let mut free = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let fits = |(_, data): &(usize, &Vec<T>)| (len..=2 * len).contains(&data.len());
        let data = match free.iter().enumerate().filter(fits).min_by_key(|(_, d)| d.len()).map(|(i, _)| i) {
            Some(i) => free.swap_remove(i),
            None => {
                drop(free);
                vec![value; len]
            }
        };
        Pooled { len, data, pool: self }
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

/// Values in memory that goes back to its pool when they are dropped.
#[derive(Debug)]
pub struct Pooled<T: 'static> {
    len: usize,
    /// At least `len`.
    data: Vec<T>,
    pool: &'static Pool<T>,
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
        self.pool.0.lock().unwrap_or_else(PoisonError::into_inner).push(data);
    }
}
