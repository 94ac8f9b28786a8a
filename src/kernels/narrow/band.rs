//! The work of one task of a narrow convolution: the sums of some rows, or of a piece of each, finished and stored.

use super::{CHUNK, Engine, Format, Grid, LANES, Sums, Term, Wide, engine::Product};
use crate::kernels::{
    Block, Shape, Shared,
    conv::Epilogue,
    layout::{Finish, Unpacked},
    simd::{Kernel, Simd},
};

/// A pointer that tasks share to write disjoint pixels of one operand.
#[derive(Clone, Copy)]
pub struct SharedWide(pub *mut Wide);

// SAFETY: every task writes its own pixels, so no two ever touch the same value.
unsafe impl Send for SharedWide {}
// SAFETY: as above.
unsafe impl Sync for SharedWide {}

/// Where sums go once they are finished.
#[derive(Clone, Copy)]
pub enum Target {
    F32(Shared),
    Narrow(SharedWide, Grid, Format),
    Planes(Unpacked),
}

/// The work of one task: some rows, or a piece of each, of all output planes of one image.
pub struct Band<'a> {
    pub engine: Engine,
    pub grid: Grid,
    /// Packed, `[output plane][phase][term][16 rows]`, or as `winograd::pack` lays them out.
    pub weights: &'a [Wide],
    /// How many groups of rows of its weights each term needs.
    pub groups: &'a [u8],
    /// Format of the sources.
    pub format: Format,
    /// Output phases along each axis.
    pub spread: usize,
    /// What sums are multiplied by, and what is added then: a block an output plane each.
    pub scale: &'a [Block],
    pub bias: &'a [Block],
    pub epilogue: Epilogue,
    /// The terms of each phase. Where cells are computed, there is one list, with a term for each plane of
    /// the sources.
    pub phases: &'a [Vec<Term>],
    pub out: Shape,
    pub target: Target,
    pub n: usize,
    pub rows: (usize, usize),
    pub columns: (usize, usize),
}

impl Kernel for Band<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let phase_rows = self.phases[0].len() * LANES;
        let plane_rows = self.phases.len() * phase_rows;
        let mut sums = Sums::default();
        for plane in (0..self.out.planes()).step_by(2) {
            let outputs = (self.out.planes() - plane).min(2);
            for (phase, terms) in self.phases.iter().enumerate() {
                let weights = self.weights[plane * plane_rows + phase * phase_rows..].as_ptr();
                for (position, end) in self.chunks() {
                    // SAFETY: `convolve` made the terms from operands whose borders and slack cover their
                    // reach, and runs this inside `ready`; tasks own disjoint pixels.
                    unsafe {
                        let product = Product {
                            terms,
                            groups: self.groups,
                            position,
                            weights,
                            outputs,
                            plane: plane_rows,
                        };
                        self.engine.multiply(self.format, product, &mut sums);
                        self.store(simd, &sums, (plane, outputs), phase, (position, end));
                    }
                }
            }
        }
    }
}

impl Band<'_> {
    /// The positions of the pixels, at most [`CHUNK`] at a time: those of whole rows are one run, with the borders
    /// between them, others go row by row.
    fn chunks(&self) -> impl Iterator<Item = (usize, usize)> {
        let (grid, (top, bottom), (left, right)) = (self.grid, self.rows, self.columns);
        let rows = if right - left == grid.w { bottom - top } else { 1 };
        (top..bottom).step_by(rows).flat_map(move |y| {
            let (first, end) = (grid.row(y) + left, grid.row(y + rows - 1) + right);
            (first..end).step_by(CHUNK).map(move |at| (at, end.min(at + CHUNK)))
        })
    }

    /// Finishes the sums of positions `from..end` and stores those that are pixels.
    ///
    /// # Safety
    /// No other task writes these pixels.
    #[inline(always)]
    pub unsafe fn store<S: Simd>(
        &self,
        simd: S,
        sums: &Sums,
        (plane, outputs): (usize, usize),
        phase: usize,
        (from, end): (usize, usize),
    ) {
        let (grid, spread) = (self.grid, self.spread);
        let accumulate = self.epilogue.accumulate;
        let mut position = from;
        while position < end {
            // Positions run from the left border, over the pixels, to the right border, and may begin or end
            // in either.
            let line = position / grid.stride();
            let left = line * grid.stride() + grid.pad;
            let pixels = position.max(left)..end.min(left + grid.w);
            position = (line + 1) * grid.stride();
            if pixels.is_empty() {
                continue;
            }
            let (run, first, column) = (pixels.len(), pixels.start - from, pixels.start - left);
            let row = (line - grid.pad) * spread + phase / spread;
            let finish = [self.finish(simd, plane), self.finish(simd, plane + outputs - 1)];
            let sums: [&[Block]; 2] = std::array::from_fn(|o| &sums.0[o][first..first + run]);
            match self.target {
                Target::F32(blocks) => {
                    for o in 0..outputs {
                        let row = self.out.row(self.n, plane + o, row) + phase % spread;
                        for (i, sum) in sums[o].iter().enumerate() {
                            // SAFETY: the pixels lie inside the row, and are this task's.
                            unsafe {
                                let block = blocks.at(row + (column + i) * spread);
                                let add = if accumulate { simd.load(block) } else { finish[o].bias };
                                simd.store(block, Scaled { bias: add, ..finish[o] }.of(simd, simd.get(sum)));
                            }
                        }
                    }
                }
                Target::Planes(planes) => {
                    for o in 0..outputs {
                        for (i, pixels) in sums[o].chunks(LANES).enumerate() {
                            let at = (row, column + i * LANES);
                            // SAFETY: as above.
                            unsafe { planes.put(simd, (self.n, plane + o), at, pixels, &finish[o]) }
                        }
                    }
                }
                Target::Narrow(wides, grid, format) => {
                    // 32 channels fill a [`Wide`] in bfloat16, and one half of it in 8 bits.
                    let blocks = format.channels() / LANES;
                    let wide = self.n * self.out.c.div_ceil(format.channels()) + plane / blocks;
                    let start = wide * grid.positions() + grid.row(row) + phase % spread;
                    // SAFETY: as above.
                    unsafe {
                        let at = wides.0.add(start + column * spread);
                        match format {
                            Format::Bf16 => self.narrow(simd, &finish[..outputs], sums, at),
                            Format::Int8(_) => {
                                let at = at.cast::<u8>().add(plane % blocks * LANES);
                                for i in 0..run {
                                    let at = at.add(i * spread * size_of::<Wide>()).cast::<[u8; LANES]>();
                                    at.write(simd.bytes(finish[0].of(simd, simd.get(&sums[0][i]))));
                                    // Where there is no second plane of the pair, its 16 channels become
                                    // zero.
                                    let upper = if outputs == 2 {
                                        simd.bytes(finish[1].of(simd, simd.get(&sums[1][i])))
                                    } else {
                                        [0; LANES]
                                    };
                                    at.add(1).write(upper);
                                }
                            }
                        }
                    }
                }
            }
        }
    }

    /// How the sums of an output plane become values.
    #[inline(always)]
    fn finish<S: Simd>(&self, simd: S, plane: usize) -> Scaled<S> {
        let Epilogue { relu, accumulate } = self.epilogue;
        let bias = if accumulate { simd.splat(0.0) } else { simd.get(&self.bias[plane]) };
        Scaled { scale: simd.get(&self.scale[plane]), bias, relu }
    }

    /// Finishes sums and rounds them to bfloat16.
    ///
    /// # Safety
    /// As for [`Engine::narrow_spread`].
    #[inline(always)]
    unsafe fn narrow<S: Simd>(&self, simd: S, finish: &[Scaled<S>], sums: [&[Block]; 2], at: *mut Wide) {
        let mut values = [[Block::default(); CHUNK]; 2];
        for ((values, sums), finish) in values.iter_mut().zip(sums).zip(finish) {
            for (value, sum) in values.iter_mut().zip(sums) {
                simd.set(value, finish.of(simd, simd.get(sum)));
            }
        }
        let [low, high] = values.each_ref().map(|values| &values[..sums[0].len()]);
        let (high, spread) = ((finish.len() == 2).then_some(high), self.spread);
        // SAFETY: the caller's promise.
        unsafe { self.engine.narrow_spread(low, high, at, spread) }
    }
}

/// What makes values of a plane's sums: `relu(sum * scale + bias)`, or without the ReLU where none is asked
/// for.
#[derive(Clone, Copy)]
struct Scaled<S: Simd> {
    scale: S::V,
    bias: S::V,
    relu: bool,
}

impl<S: Simd> Finish<S> for Scaled<S> {
    #[inline(always)]
    fn of(&self, simd: S, sum: S::V) -> S::V {
        let value = simd.fma(sum, self.scale, self.bias);
        if self.relu { simd.max(value, simd.splat(0.0)) } else { value }
    }
}
