//! Between planar images and blocked activations, sixteen pixels at a time.
//!
//! For a factor of 1 a channel is a plane. For a factor of 2 four consecutive channels are the pixels of
//! a quad (2x2 pixels) of one plane (space to depth), which is how a half-resolution network reads and writes
//! a full-resolution image.

use rayon::prelude::*;

use super::{
    Block, LANES, Shape, Shared, View, ViewMut,
    simd::{Kernel, PAIRS, Simd, Tier},
};

/// Where channels `first..first + channels` of an activation lie in planes of `factor` times its size.
#[derive(Clone, Copy)]
struct Map {
    shape: Shape,
    first: usize,
    channels: usize,
    factor: usize,
}

impl Map {
    /// # Panics
    /// If `len` values are not whole planes, or more than the activation's channels.
    fn new(shape: Shape, first: usize, factor: usize, len: usize) -> Self {
        assert!(factor == 1 || factor == 2, "quads have 1 or 2 pixels a side");
        let channels = len / (shape.n * shape.h * shape.w).max(1);
        let area = factor * factor;
        assert_eq!(len, shape.n * (channels / area) * area * shape.h * shape.w, "planes must be whole");
        assert!(first + channels <= shape.c, "more planes than channels");
        assert!(first.is_multiple_of(area), "quads must be whole");
        Self { shape, first, channels, factor }
    }

    /// The blocked planes that hold the channels.
    fn blocks(self) -> std::ops::Range<usize> {
        self.first / LANES..(self.first + self.channels).div_ceil(LANES)
    }

    /// The lanes of a blocked plane that hold the channels.
    fn lanes(self, plane: usize) -> std::ops::Range<usize> {
        let start = plane * LANES;
        self.first.max(start) - start..(self.first + self.channels).min(start + LANES) - start
    }

    /// Index of column `x` of the activation's row `y`, in the planes of all images.
    #[inline(always)]
    fn value(self, n: usize, plane: usize, lane: usize, y: usize, x: usize) -> usize {
        let Self { shape, factor, .. } = self;
        let channel = plane * LANES + lane - self.first;
        // Shifts in place of divisions, which would take longer than what is moved.
        let (side, area) = (factor / 2, factor * factor);
        let (sy, sx) = ((channel & (area - 1)) >> side, channel & (factor - 1));
        let image = n * (self.channels >> (2 * side)) + (channel >> (2 * side));
        (image * factor * shape.h + factor * y + sy) * factor * shape.w + factor * x + sx
    }
}

/// Packs planes of `factor` times an activation's size into all channels of that activation. The lanes beyond
/// its channels become zero.
///
/// # Panics
/// If `input` does not hold the output's shape.
pub fn to_blocked(input: &[f32], factor: usize, output: ViewMut) {
    let s = output.shape;
    assert_eq!(input.len(), s.n * s.c * s.h * s.w);
    pack(input, 0, factor, output, false);
}

/// Unpacks blocks to planes, `(N, C, H, W)`.
///
/// # Panics
/// If `output` does not hold the input's shape.
pub fn from_blocked(input: View, output: &mut [f32]) {
    let s = input.shape;
    assert_eq!(output.len(), s.n * s.c * s.h * s.w);
    from_blocked_shuffled(input, 0, 1, output);
}

/// Unpacks C channels of `input`, from `first` on, to planes, (N, C / factor^2, factor H, factor W). The
/// length of `output` says how many they are.
///
/// # Panics
/// If `output` does not hold whole channels of the input.
pub fn from_blocked_shuffled(input: View, first: usize, factor: usize, output: &mut [f32]) {
    let to = Unpacked::new(input.shape, first, factor, output);
    each_band(to.map, |n, plane, rows| Tier::detect().run(Unpack { to, input, n, plane, rows }));
}

/// Adds planes to the channels from which [`from_blocked_shuffled`] unpacks them. Every other channel stays
/// as it is.
///
/// # Panics
/// As [`from_blocked_shuffled`].
pub fn add_blocked_shuffled(input: &[f32], first: usize, factor: usize, output: ViewMut) {
    pack(input, first, factor, output, true);
}

/// What [`to_blocked`] and [`add_blocked_shuffled`] do. With `add`, values are added to what blocks hold.
/// Without, they replace it, and lanes without a value become zero.
fn pack(input: &[f32], first: usize, factor: usize, output: ViewMut, add: bool) {
    let map = Map::new(output.shape, first, factor, input.len());
    let blocks = Shared(output.data.as_mut_ptr());
    each_band(map, |n, plane, rows| Tier::detect().run(Pack { map, input, blocks, n, plane, rows, add }));
}

/// Runs `work(image, blocked plane, rows)` over everything that `map` covers.
fn each_band(map: Map, work: impl Fn(usize, usize, std::ops::Range<usize>) + Sync) {
    /// Blocks that make a task worth its start.
    const TASK: usize = 8192;
    let Shape { n, h, w, .. } = map.shape;
    let (planes, rows) = (map.blocks().len(), (TASK / w.max(1)).clamp(1, h.max(1)));
    let bands = h.div_ceil(rows);
    (0..n * planes * bands).into_par_iter().for_each(|task| {
        let (band, rest) = (task % bands, task / bands);
        let plane = map.blocks().start + rest % planes;
        work(rest / planes, plane, band * rows..h.min((band + 1) * rows));
    });
}

/// Planes that tasks share, to which they write the values of an activation's channels.
#[derive(Clone, Copy)]
pub(super) struct Unpacked {
    map: Map,
    values: *mut f32,
}

// SAFETY: every task writes the values of its own channels and pixels, so no two ever touch the same.
unsafe impl Send for Unpacked {}
// SAFETY: as above.
unsafe impl Sync for Unpacked {}

impl Unpacked {
    /// Planes of `factor` times the size of an activation of `shape`, for its channels from `first` on.
    ///
    /// # Panics
    /// If `output` does not hold whole channels of it.
    pub fn new(shape: Shape, first: usize, factor: usize, output: &mut [f32]) -> Self {
        Self { map: Map::new(shape, first, factor, output.len()), values: output.as_mut_ptr() }
    }

    /// Writes up to 16 pixels of image `n`, from column `x` of the activation's row `y` on. The channels of
    /// blocked plane `plane` of these pixels are what `finish` makes of `blocks`.
    ///
    /// # Safety
    /// The pixels lie inside the row and nobody else writes them; the planes
    /// are still there.
    #[inline(always)]
    pub unsafe fn put<S: Simd>(
        self,
        simd: S,
        (n, plane): (usize, usize),
        (y, x): (usize, usize),
        blocks: &[Block],
        finish: &impl Finish<S>,
    ) {
        // SAFETY: the caller's promise.
        unsafe {
            match self.map.factor {
                1 => self.put_groups::<S, LANES>(simd, (n, plane), (y, x), blocks, finish),
                _ => self.put_groups::<S, PAIRS>(simd, (n, plane), (y, x), blocks, finish),
            }
        }
    }

    /// [`Unpacked::put`], where each of the `N` groups of channels of a blocked plane is a run of values in
    /// its row.
    ///
    /// # Safety
    /// As that.
    #[inline(always)]
    unsafe fn put_groups<S: Simd, const N: usize>(
        self,
        simd: S,
        (n, plane): (usize, usize),
        (y, x): (usize, usize),
        blocks: &[Block],
        finish: &impl Finish<S>,
    ) where
        Channels: Groups<S, N>,
    {
        let Self { map, values } = self;
        let lanes = map.lanes(plane);
        for (blocks, x) in blocks.chunks(N).zip((x..).step_by(N)) {
            // SAFETY: the caller's promise.
            unsafe {
                let groups = Channels::transpose(simd, load::<S, N>(simd, blocks, finish));
                for group in lanes.start / map.factor..lanes.end / map.factor {
                    let out = values.add(map.value(n, plane, group * map.factor, y, x));
                    simd.write_first(out, blocks.len() * map.factor, groups[group]);
                }
            }
        }
    }
}

/// How vectors of pixels become vectors of `N` groups of neighbouring channels, and back.
trait Groups<S: Simd, const N: usize> {
    /// Group `j` of vector `i` becomes group `i` of vector `j`.
    fn transpose(simd: S, vectors: [S::V; N]) -> [S::V; N];
}

/// The channels of a blocked plane: one by one where each is a plane, and two by two where two channels are
/// neighbours in a row of a plane.
struct Channels;

impl<S: Simd> Groups<S, LANES> for Channels {
    #[inline(always)]
    fn transpose(simd: S, vectors: [S::V; LANES]) -> [S::V; LANES] {
        simd.transpose(vectors)
    }
}

impl<S: Simd> Groups<S, PAIRS> for Channels {
    #[inline(always)]
    fn transpose(simd: S, vectors: [S::V; PAIRS]) -> [S::V; PAIRS] {
        simd.transpose_pairs(vectors)
    }
}

/// What becomes of a block's lanes before they are planes.
pub(super) trait Finish<S: Simd> {
    /// The lanes, changed.
    fn of(&self, simd: S, lanes: S::V) -> S::V;
}

/// Lanes as they are.
struct Unchanged;

impl<S: Simd> Finish<S> for Unchanged {
    #[inline(always)]
    fn of(&self, _: S, lanes: S::V) -> S::V {
        lanes
    }
}

struct Unpack<'a> {
    to: Unpacked,
    input: View<'a>,
    n: usize,
    plane: usize,
    rows: std::ops::Range<usize>,
}

impl Kernel for Unpack<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { to, input, n, plane, rows } = self;
        let s = input.shape;
        for y in rows {
            let row = &input.data[s.row(n, plane, y)..][..s.w];
            for (x, blocks) in (0..s.w).step_by(LANES).zip(row.chunks(LANES)) {
                // SAFETY: every value belongs to this task.
                unsafe { to.put(simd, (n, plane), (y, x), blocks, &Unchanged) }
            }
        }
    }
}

struct Pack<'a> {
    map: Map,
    input: &'a [f32],
    blocks: Shared,
    n: usize,
    plane: usize,
    rows: std::ops::Range<usize>,
    /// Whether to add to what is there.
    add: bool,
}

impl Kernel for Pack<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { map, input, blocks, n, plane, rows, add } = self;
        let s = map.shape;
        for y in rows {
            // SAFETY: the row's blocks belong to this task.
            unsafe {
                let row = std::slice::from_raw_parts_mut(blocks.at(s.row(n, plane, y)), s.w);
                match map.factor {
                    1 => map.gather::<S, LANES>(simd, input, (n, plane), (y, 0), add, row),
                    _ => map.gather::<S, PAIRS>(simd, input, (n, plane), (y, 0), add, row),
                }
            }
        }
    }
}

impl Map {
    /// Fills the blocks of an activation's pixels, from column `x` of its row `y` on, with what the planes
    /// hold of its channels, and other lanes with zeros. With `add`, the values are added to what the blocks
    /// hold instead. Each of the `N` groups of channels of a blocked plane is a run of values in its row.
    #[inline(always)]
    fn gather<S: Simd, const N: usize>(
        self,
        simd: S,
        input: &[f32],
        (n, plane): (usize, usize),
        (y, x): (usize, usize),
        add: bool,
        blocks: &mut [Block],
    ) where
        Channels: Groups<S, N>,
    {
        let lanes = self.lanes(plane);
        for (blocks, x) in blocks.chunks_mut(N).zip((x..).step_by(N)) {
            let count = blocks.len() * self.factor;
            let mut groups = [simd.splat(0.0); N];
            if add {
                groups = Channels::transpose(simd, load::<S, N>(simd, blocks, &Unchanged));
            }
            for group in lanes.start / self.factor..lanes.end / self.factor {
                let from = &input[self.value(n, plane, group * self.factor, y, x)..][..count];
                // SAFETY: as many values are read as there are.
                let values = unsafe { simd.read_some(from.as_ptr(), 0..count, 0.0) };
                groups[group] = if add { simd.add(groups[group], values) } else { values };
            }
            for (block, vector) in blocks.iter_mut().zip(Channels::transpose(simd, groups)) {
                simd.set(block, vector);
            }
        }
    }
}

/// Row `y` of image `n` of an activation whose channels are the pixels of quads of planes, as [`to_blocked`]
/// makes it. It is made 16 pixels at a time, for up to two blocked planes from `plane` on. `put` takes the
/// first column of these pixels and their blocks; those of the second plane are absent where it has no
/// channels.
pub(super) struct HalvedRow<'a, F> {
    pub shape: Shape,
    pub values: &'a [f32],
    pub at: (usize, usize, usize),
    pub put: F,
}

impl<F: FnMut(usize, &[Block], Option<&[Block]>)> Kernel for HalvedRow<'_, F> {
    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S) {
        let (n, plane, y) = self.at;
        let map = Map::new(self.shape, 0, 2, self.values.len());
        let planes = map.blocks().len();
        let mut blocks = [[Block::default(); LANES]; 2];
        for x in (0..self.shape.w).step_by(LANES) {
            let count = LANES.min(self.shape.w - x);
            for (plane, blocks) in (plane..planes).zip(&mut blocks) {
                map.gather::<S, PAIRS>(simd, self.values, (n, plane), (y, x), false, &mut blocks[..count]);
            }
            let [low, high] = blocks.each_ref().map(|blocks| &blocks[..count]);
            (self.put)(x, low, (plane + 1 < planes).then_some(high));
        }
    }
}

/// `N` blocks after `finish`. Where there are fewer, the last one is repeated.
#[inline(always)]
fn load<S: Simd, const N: usize>(simd: S, blocks: &[Block], finish: &impl Finish<S>) -> [S::V; N] {
    let last = blocks.len() - 1;
    let mut vectors = [simd.splat(0.0); N];
    for i in 0..N {
        // SAFETY: no block beyond the last is read.
        vectors[i] = finish.of(simd, unsafe { simd.load(blocks.as_ptr().add(i.min(last))) });
    }
    vectors
}
