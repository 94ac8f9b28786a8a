//! A frame's rows on their way through a network: made band by band from top to bottom, kept while a later
//! operation needs them.

use std::{collections::VecDeque, ops::Range};

use dfdx::tensor::NoneTape;
use rayon::prelude::*;

use super::{
    Activation, Field,
    activation::Data,
    pool::{Buffer, plane_buffer},
};
use crate::kernels::{memory, narrow::Operand};

/// Consecutive rows of one image: an activation or a field, without a tape.
pub trait Rows: Sized {
    /// Number of rows.
    fn height(&self) -> usize;

    /// A second handle on the same rows.
    fn fork(&self) -> Self;

    /// Some rows of each of `parts`, one below another. With `above` the first row goes into the border, and
    /// with `below` the last. A convolution reads rows in the border, but computes no output for them.
    fn stack(parts: &[(&Self, Range<usize>)], above: bool, below: bool) -> Self;
}

fn signed(row: usize) -> isize {
    isize::try_from(row).expect("frames fit in memory")
}

impl Rows for Activation<NoneTape> {
    fn height(&self) -> usize {
        self.shape().h
    }

    fn fork(&self) -> Self {
        Activation::fork(self)
    }

    fn stack(parts: &[(&Self, Range<usize>)], above: bool, below: bool) -> Self {
        let rows = parts.iter().map(|(_, rows)| rows.len()).sum::<usize>();
        let shape = parts[0].0.shape();
        let shape = shape.with_size(rows - usize::from(above) - usize::from(below), shape.w);
        let mut data = match &*parts[0].0.saved.data {
            Data::F32(_) => Data::F32(Buffer::new(shape)),
            Data::Narrow(part) => Data::Narrow(Operand::new(shape, part.format())),
        };
        let mut to = -isize::from(above);
        for (part, rows) in parts {
            match (&mut data, &*part.saved.data) {
                (Data::F32(into), Data::F32(from)) => {
                    into.copy_rows(to, from, signed(rows.start), rows.len())
                }
                (Data::Narrow(into), Data::Narrow(from)) => {
                    into.copy_rows(to, from, signed(rows.start), rows.len());
                }
                _ => unreachable!("a layer always writes the same type"),
            }
            to += signed(rows.len());
        }
        Self::constant(data)
    }
}

impl Rows for Field<NoneTape> {
    fn height(&self) -> usize {
        self.extent().2
    }

    fn fork(&self) -> Self {
        Field::fork(self)
    }

    fn stack(parts: &[(&Self, Range<usize>)], above: bool, below: bool) -> Self {
        assert!(!above && !below, "fields have no border");
        let (_, channels, _, w) = parts[0].0.extent();
        let h = parts.iter().map(|(_, rows)| rows.len()).sum::<usize>();
        let mut data = plane_buffer(channels * h * w);
        data.par_chunks_mut((h * w).max(1)).enumerate().for_each(|(c, mut plane)| {
            for (part, rows) in parts {
                let (into, rest) = plane.split_at_mut(rows.len() * w);
                memory::copy(into, &part.plane(c)[rows.start * w..rows.end * w]);
                plane = rest;
            }
        });
        Self::from_buffer((1, channels, h, w), data)
    }
}

/// The rows made so far of something that is `total` rows tall.
#[derive(Debug)]
pub struct Line<V> {
    total: usize,
    end: usize,
    /// The bands that are kept, each with the number of its first row.
    bands: VecDeque<(usize, V)>,
}

impl<V: Rows> Line<V> {
    /// No rows yet.
    pub fn new(total: usize) -> Self {
        Self { total, end: 0, bands: VecDeque::new() }
    }

    /// Adds the next rows.
    ///
    /// # Panics
    /// If there are then more rows than the total.
    pub fn push(&mut self, band: V) {
        let first = self.end;
        self.end += band.height();
        assert!(self.end <= self.total, "{} rows of {}", self.end, self.total);
        self.bands.push_back((first, band));
    }

    /// Number of rows made so far.
    pub fn end(&self) -> usize {
        self.end
    }

    /// Rows there are in all.
    pub fn total(&self) -> usize {
        self.total
    }

    /// How many rows from the top have been made together with their neighbours up to `reach` rows below.
    pub fn settled(&self, reach: usize) -> usize {
        if self.end == self.total { self.total } else { self.end.saturating_sub(reach) }
    }

    /// Where the band that holds row `row` ends, if it is made.
    pub fn band_end(&self, row: usize) -> Option<usize> {
        let holds = |(first, band): &&(usize, V)| (*first..first + band.height()).contains(&row);
        self.bands.iter().find(holds).map(|(first, band)| first + band.height())
    }

    /// Rows `rows`, shared where they are a whole band and copied together where not.
    ///
    /// # Panics
    /// If some are not made yet or no longer kept.
    pub fn rows(&self, rows: Range<usize>) -> V {
        self.stack(rows, false, false)
    }

    /// Rows `rows` as a convolution that reaches one row further wants them: with the rows beside them in
    /// the border, where the frame has any.
    ///
    /// # Panics
    /// As [`Line::rows`].
    pub fn rows_and_border(&self, rows: Range<usize>) -> V {
        let (above, below) = (rows.start > 0, rows.end < self.total);
        self.stack(rows.start - usize::from(above)..rows.end + usize::from(below), above, below)
    }

    fn stack(&self, rows: Range<usize>, above: bool, below: bool) -> V {
        let mut parts = Vec::new();
        let mut row = rows.start;
        for (first, band) in &self.bands {
            let end = (first + band.height()).min(rows.end);
            if *first <= row && row < end {
                parts.push((band, row - first..end - first));
                row = end;
            }
        }
        assert_eq!(row, rows.end, "rows {rows:?} are not all here");
        match &parts[..] {
            [(band, part)] if *part == (0..band.height()) && !above && !below => band.fork(),
            parts => V::stack(parts, above, below),
        }
    }

    /// Drops the bands that lie wholly above row `row`.
    pub fn forget(&mut self, row: usize) {
        while self.bands.front().is_some_and(|(first, band)| first + band.height() <= row) {
            self.bands.pop_front();
        }
    }
}
