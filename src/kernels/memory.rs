//! Recycled memory: after the first pass over a frame no layer allocates, and no page is faulted in.
#![deny(unsafe_code)]

use std::sync::{Mutex, PoisonError};

/// Free buffers of one type. What they hold is whatever the last user left.
#[derive(Debug)]
pub struct Pool<T>(Mutex<Vec<Vec<T>>>);

impl<T: Clone> Pool<T> {
    /// An empty pool.
    pub const fn new() -> Self {
        Self(Mutex::new(Vec::new()))
    }

    /// The smallest free buffer of `len` values or more, unless more than half of it would lie idle; else a
    /// new one, filled with `value`.
    pub fn take(&self, len: usize, value: T) -> Vec<T> {
        let mut free = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let fits = |(_, buffer): &(usize, &Vec<T>)| (len..=2 * len).contains(&buffer.len());
        match free.iter().enumerate().filter(fits).min_by_key(|(_, buffer)| buffer.len()).map(|(i, _)| i) {
            Some(i) => free.swap_remove(i),
            None => {
                drop(free);
                vec![value; len]
            }
        }
    }

    /// Takes a buffer back.
    pub fn give(&self, buffer: Vec<T>) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(buffer);
    }

    /// Gives every free buffer back to the system.
    pub fn clear(&self) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clear();
    }
}

impl<T: Clone> Default for Pool<T> {
    fn default() -> Self {
        Self::new()
    }
}
