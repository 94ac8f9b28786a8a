//! 3x3 convolutions in 8 bits by cells of 4x4 outputs ([`crate::kernels::winograd`]). Results are the same to
//! the bit as those of convolutions tap by tap.
//!
//! Fractions would be rounded, and results would depend on where a cell begins. Whole numbers modulo 2^32
//! need no rounding: weights at the points take 16 bits, and sums of their products give 9 x 2^k times the
//! output. Multiplying by the inverse of 9 modulo 2^32 removes the 9, and a shift removes the 2^k. So nothing
//! but an output times 2^k has to fit into 32 bits ([`FITTING_SUM`]). Pixels beyond a plane's last row or
//! column may hold anything.

use std::num::Wrapping;

use rayon::prelude::*;

use super::{CHUNK, LANES, Sums, WIDE, WORD, Wide, allocate, band::Band, engine::CELLS};
use crate::kernels::{
    simd::{Kernel, Simd},
    winograd::{PATCH, POINTS, SIDE, evaluate_kernel},
};

/// The most that an output's weights of one sign may add up to, in steps, before they are rounded. Rounding
/// adds at most one step to each weight. Then 2^6 times the sum times the largest activation fits into 32
/// bits.
pub const FITTING_SUM: f32 = 130_000.0;

/// Up to 32 channels of a source. They are half a [`Wide`] of the source, and a whole one between the
/// transforms.
#[derive(Clone, Copy, Debug)]
pub struct Part {
    /// Index of the plane among those of all sources, and which half of its channels.
    plane: usize,
    half: usize,
    /// First channel among those of all sources, and number of channels.
    first: usize,
    count: usize,
}

/// The parts of `sources`, of each of which the number of channels is given.
pub fn parts(sources: impl Iterator<Item = usize>) -> Vec<Part> {
    let (mut plane, mut first) = (0, 0);
    let mut parts = Vec::new();
    for channels in sources {
        for (i, at) in (0..channels).step_by(WIDE).enumerate() {
            let count = (channels - at).min(WIDE);
            parts.push(Part { plane: plane + i / 2, half: i % 2, first: first + at, count });
        }
        plane += channels.div_ceil(2 * WIDE);
        first += channels;
    }
    parts
}

/// Groups of rows of weights that each part needs.
pub fn groups(parts: &[Part]) -> Vec<u8> {
    parts.iter().map(|part| part.count.div_ceil(WIDE / super::GROUP) as u8).collect()
}

/// Packs the weights `kernel(output, input)` of a layer, in steps: `[output plane][point][part][16 rows]`,
/// each row holding the weights of 16 outputs for a pair of input channels side by side.
pub fn pack(parts: &[Part], outputs: usize, kernel: impl Fn(usize, usize) -> [i16; 9] + Sync) -> Vec<Wide> {
    let rows_of_plane = POINTS * parts.len() * LANES;
    let mut rows = vec![Wide::ZERO; outputs.div_ceil(LANES) * rows_of_plane];
    rows.par_chunks_mut(rows_of_plane).enumerate().for_each(|(plane, rows)| {
        for (p, part) in parts.iter().enumerate() {
            for l in 0..(outputs - plane * LANES).min(LANES) {
                for i in 0..part.count {
                    let kernel = kernel(plane * LANES + l, part.first + i).map(Wrapping);
                    let points = evaluate_kernel(kernel);
                    for (point, Wrapping(value)) in points.into_iter().enumerate() {
                        let row = &mut rows[(point * parts.len() + p) * LANES + i / 2];
                        row.0[WORD * l + 2 * (i % 2)..][..2].copy_from_slice(&value.to_ne_bytes());
                    }
                }
            }
        }
    });
    rows
}

/// The work of one task by cells: some rows, or a piece of each, of all output planes of one image.
pub struct Cells<'a> {
    pub band: Band<'a>,
    pub parts: &'a [Part],
}

impl Kernel for Cells<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Cells { band, parts } = self;
        let (grid, engine, planes) = (band.grid, band.engine, &band.phases[0]);
        // Points lie one value further apart than they need to, so that not all are in the same few sets of a
        // cache.
        let (point, product) = (parts.len() * CELLS + 1, 2 * CELLS + 1);
        let rows_of_plane = POINTS * parts.len() * LANES;
        let mut points = allocate(POINTS * point);
        let mut products = allocate(POINTS * product);
        let mut sums: [Sums; SIDE] = std::array::from_fn(|_| Sums::default());
        for y in (band.rows.0..band.rows.1).step_by(SIDE) {
            // A patch begins one row above and one column left of its cell. Rows below the border may hold
            // anything, so the border's row is read in their place.
            let starts: [usize; PATCH] =
                std::array::from_fn(|i| grid.row((y + i).min(grid.h + 1)) - grid.stride() - 1);
            for x in (band.columns.0..band.columns.1).step_by(SIDE * CELLS) {
                let cells = (band.columns.1 - x).div_ceil(SIDE).min(CELLS);
                for (p, part) in parts.iter().enumerate() {
                    for half in 0..part.count.div_ceil(LANES) {
                        let lane = part.half * WIDE + half * LANES;
                        // SAFETY: `convolve` made sure of the border; slack covers what a last cell reads
                        // beyond it. Points hold two bytes a channel.
                        unsafe {
                            let patch = starts
                                .map(|start| planes[part.plane].input.add(start + x).cast::<u8>().add(lane));
                            let points = points.as_mut_ptr().add(p * CELLS).cast::<u8>();
                            engine.evaluate(patch, cells, points.add(2 * half * LANES), point);
                        }
                    }
                }
                for plane in (0..band.out.planes()).step_by(2) {
                    let outputs = (band.out.planes() - plane).min(2);
                    for i in 0..POINTS {
                        // SAFETY: both hold as many values a point.
                        unsafe {
                            let rows =
                                band.weights[plane * rows_of_plane + i * parts.len() * LANES..].as_ptr();
                            engine.multiply_points(
                                band.groups,
                                points.as_ptr().add(i * point),
                                rows,
                                (outputs, rows_of_plane),
                                cells,
                                products.as_mut_ptr().add(i * product),
                            );
                        }
                    }
                    for first in (0..cells).step_by(CHUNK / SIDE) {
                        let count = (cells - first).min(CHUNK / SIDE);
                        for (o, cell) in (0..outputs).flat_map(|o| (0..count).map(move |i| (o, i))) {
                            // SAFETY: as above; a chunk of sums has room for as many cells.
                            unsafe {
                                let products = products.as_ptr().add(o * CELLS + first + cell);
                                engine.interpolate(products, product, &mut sums, (o, SIDE * cell));
                            }
                        }
                        let column = x + SIDE * first;
                        for (row, sums) in (y..band.rows.1).zip(&sums) {
                            let from = grid.row(row) + column;
                            let end = from + (band.columns.1 - column).min(CHUNK);
                            // SAFETY: `convolve` ran this as it does a band; tasks own disjoint pixels.
                            unsafe { band.store(simd, sums, (plane, outputs), 0, (from, end)) }
                        }
                    }
                }
            }
        }
    }
}
