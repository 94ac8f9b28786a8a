//! One plane of an activation: rows with a border of zeros.
#![deny(unsafe_code)]

use std::ops::Range;

use rayon::prelude::*;

use super::memory;

/// The extent of a plane; its values are blocks of any type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plane {
    /// Rows.
    pub h: usize,
    /// Pixels in a row.
    pub w: usize,
    /// Width of the border.
    pub pad: usize,
}

impl Plane {
    /// Positions from one row to the next.
    pub fn stride(self) -> usize {
        self.w + 2 * self.pad
    }

    /// Positions, borders included.
    ///
    /// # Panics
    /// If there are more than memory could hold: buffers are checked against this number.
    pub fn positions(self) -> usize {
        let side = |n: usize| n.checked_add(self.pad.checked_mul(2)?);
        let positions = side(self.h).zip(side(self.w)).and_then(|(h, w)| h.checked_mul(w));
        positions.expect("a plane fits into memory")
    }

    /// The position of row `y`, column 0.
    pub fn row(self, y: usize) -> usize {
        (y + self.pad) * self.stride() + self.pad
    }

    /// Fills the border of each plane of `planes`.
    pub fn fill_border<V: Copy>(self, planes: &mut [V], value: V) {
        let (stride, pad) = (self.stride(), self.pad);
        for plane in planes.chunks_mut(self.positions()) {
            let (above, below) = (pad * stride, (pad + self.h) * stride);
            plane[..above].fill(value);
            plane[below..].fill(value);
            for row in plane[above..below].chunks_mut(stride) {
                row[..pad].fill(value);
                row[pad + self.w..].fill(value);
            }
        }
    }

    /// Copies `count` rows of each plane of `source`, from its row `from` on, to row `to` on of `into`'s
    /// planes. Rows -1 and H lie in the border. They may be copied where the plane is a part of a taller one,
    /// whose rows the border then holds.
    ///
    /// # Panics
    /// If widths or borders differ, or some row does not exist.
    pub fn copy_rows<V: Copy + Send + Sync>(
        self,
        (into, to): (&mut [V], isize),
        other: Plane,
        (source, from): (&[V], isize),
        count: usize,
    ) {
        assert_eq!((self.w, self.pad), (other.w, other.pad), "rows must fit");
        let (to, from) = (self.rows(to, count), other.rows(from, count));
        let planes = into.par_chunks_mut(self.positions()).zip(source.par_chunks(other.positions()));
        planes.for_each(|(into, source)| memory::copy(&mut into[to.clone()], &source[from.clone()]));
    }

    /// Where `count` rows from row `first` on lie, borders included.
    fn rows(self, first: isize, count: usize) -> Range<usize> {
        let row = first.checked_add_unsigned(self.pad).and_then(|row| usize::try_from(row).ok());
        let row = row.filter(|row| row + count <= self.h + 2 * self.pad);
        let row = row.expect("rows lie inside the plane");
        row * self.stride()..(row + count) * self.stride()
    }
}
