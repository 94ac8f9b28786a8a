//! Between planar images and blocked activations, sixteen pixels at a time.
//!
//! For a factor of 1 a channel is a plane. For a factor of 2 four consecutive channels are the pixels of
//! a 2x2 square of one plane (space to depth), which is how a half-resolution network reads and writes a
//! full-resolution image.

use rayon::prelude::*;

use super::{
    Block, LANES, Shape, Shared, View, ViewMut,
    simd::{Kernel, Simd, Tier},
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
        assert!(factor == 1 || factor == 2, "squares have 1 or 2 pixels a side");
        let channels = len / (shape.n * shape.h * shape.w).max(1);
        let area = factor * factor;
        assert_eq!(len, shape.n * (channels / area) * area * shape.h * shape.w, "planes must be whole");
        assert!(first + channels <= shape.c, "more planes than channels");
        Self { shape, first, channels, factor }
    }

    /// The blocked planes that hold the channels.
    fn blocks(self) -> std::ops::Range<usize> {
        self.first / LANES..(self.first + self.channels).div_ceil(LANES)
    }

    /// The lanes of a blocked plane that hold them.
    fn lanes(self, plane: usize) -> std::ops::Range<usize> {
        let start = plane * LANES;
        self.first.max(start) - start..(self.first + self.channels).min(start + LANES) - start
    }

    /// Index of column `x` of the activation's row `y`, in the planes of all images.
    fn value(self, n: usize, plane: usize, lane: usize, y: usize, x: usize) -> usize {
        let Self { shape, factor, .. } = self;
        let channel = plane * LANES + lane - self.first;
        let area = factor * factor;
        let (sy, sx) = (channel % area / factor, channel % factor);
        let image = n * (self.channels / area) + channel / area;
        (image * factor * shape.h + factor * y + sy) * factor * shape.w + factor * x + sx
    }

    /// Whether `lane` and the next are neighbours in a row of their plane.
    fn paired(self, plane: usize, lane: usize, lanes: &std::ops::Range<usize>) -> bool {
        self.factor == 2 && (plane * LANES + lane - self.first).is_multiple_of(2) && lane + 1 < lanes.end
    }
}

/// From planes of `factor` times its size to all channels of an activation. The lanes beyond them become zero.
///
/// # Panics
/// If `input` does not hold the output's shape.
pub fn to_blocked(input: &[f32], factor: usize, output: ViewMut) {
    let s = output.shape;
    assert_eq!(input.len(), s.n * s.c * s.h * s.w);
    pack(input, 0, factor, output, false);
}

/// From blocks to `(N, C, H, W)`.
///
/// # Panics
/// If `output` does not hold the input's shape.
pub fn from_blocked(input: View, output: &mut [f32]) {
    let s = input.shape;
    assert_eq!(output.len(), s.n * s.c * s.h * s.w);
    from_blocked_shuffled(input, 0, 1, output);
}

/// Channels `first..` of `input` as planes, (N, C / factor^2, factor H, factor W); `output` says how many.
///
/// # Panics
/// If `output` does not hold whole channels of the input.
pub fn from_blocked_shuffled(input: View, first: usize, factor: usize, output: &mut [f32]) {
    let to = Unpacked::new(input.shape, first, factor, output);
    each_band(to.map, |n, plane, rows| Tier::detect().run(Unpack { to, input, n, plane, rows }));
}

/// The inverse of [`from_blocked_shuffled`], which leaves every other channel as it is.
///
/// # Panics
/// As [`from_blocked_shuffled`].
pub fn to_blocked_shuffled(input: &[f32], first: usize, factor: usize, output: ViewMut) {
    pack(input, first, factor, output, true);
}

/// What both of them do; `keep` the other lanes of a block as they are, or else they become zero.
fn pack(input: &[f32], first: usize, factor: usize, output: ViewMut, keep: bool) {
    let map = Map::new(output.shape, first, factor, input.len());
    let blocks = Shared(output.data.as_mut_ptr());
    each_band(map, |n, plane, rows| Tier::detect().run(Pack { map, input, blocks, n, plane, rows, keep }));
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

/// Planes that tasks share, to write what channels of an activation hold.
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

    /// Writes up to 16 pixels of image `n`, those from column `x` of the activation's row `y` on, whose channels of blocked
    /// plane `plane` are `blocks`. What `lanes` holds is lost.
    ///
    /// # Safety
    /// The processor has the instructions of `S`; the pixels lie inside the row and nobody else writes them; the planes
    /// are still there.
    #[inline(always)]
    pub unsafe fn put<S: Simd>(
        self,
        (n, plane): (usize, usize),
        (y, x): (usize, usize),
        blocks: &[Block],
        lanes: &mut [Block; LANES],
    ) {
        let Self { map, values } = self;
        let used = map.lanes(plane);
        // SAFETY: the caller's promise.
        unsafe {
            transpose::<S>(blocks, lanes);
            let mut lane = used.start;
            while lane < used.end {
                let out = values.add(map.value(n, plane, lane, y, x));
                if map.paired(plane, lane, &used) {
                    let out = std::slice::from_raw_parts_mut(out, 2 * blocks.len());
                    let (a, b) = (&lanes[lane].0, &lanes[lane + 1].0);
                    let pairs: [f32; 2 * LANES] =
                        std::array::from_fn(|i| if i % 2 == 0 { a[i / 2] } else { b[i / 2] });
                    match <&mut [f32; 2 * LANES]>::try_from(&mut *out) {
                        Ok(out) => *out = pairs,
                        Err(_) => out.copy_from_slice(&pairs[..2 * blocks.len()]),
                    }
                    lane += 2;
                } else {
                    let channel = &lanes[lane].0;
                    if map.factor == 1 && blocks.len() == LANES {
                        out.cast::<[f32; LANES]>().write(*channel);
                    } else {
                        for i in 0..blocks.len() {
                            *out.add(i * map.factor) = channel[i];
                        }
                    }
                    lane += 1;
                }
            }
        }
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
    unsafe fn run<S: Simd>(self) {
        let Self { to, input, n, plane, rows } = self;
        let s = input.shape;
        let mut lanes = [Block::default(); LANES];
        for y in rows {
            let row = &input.data[s.row(n, plane, y)..][..s.w];
            for (x, blocks) in (0..s.w).step_by(LANES).zip(row.chunks(LANES)) {
                // SAFETY: vectors are the tier's; every value belongs to this task.
                unsafe { to.put::<S>((n, plane), (y, x), blocks, &mut lanes) }
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
    /// Whether the lanes of other channels stay as they are.
    keep: bool,
}

impl Kernel for Pack<'_> {
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Self { map, input, blocks, n, plane, rows, keep } = self;
        let s = map.shape;
        let lanes = map.lanes(plane);
        let mut pixels = [Block::default(); LANES];
        for y in rows {
            for x in (0..s.w).step_by(LANES) {
                let count = LANES.min(s.w - x);
                // SAFETY: vectors are the tier's; the row's blocks belong to this task.
                unsafe {
                    let row = std::slice::from_raw_parts_mut(blocks.at(s.row(n, plane, y) + x), count);
                    if keep && lanes.len() < LANES {
                        transpose::<S>(row, &mut pixels);
                    }
                    let mut lane = lanes.start;
                    while lane < lanes.end {
                        let from = &input[map.value(n, plane, lane, y, x)..];
                        if map.paired(plane, lane, &lanes) {
                            if let (Some(from), LANES) = (from.first_chunk::<{ 2 * LANES }>(), count) {
                                pixels[lane].0 = std::array::from_fn(|i| from[2 * i]);
                                pixels[lane + 1].0 = std::array::from_fn(|i| from[2 * i + 1]);
                            } else {
                                for (i, pair) in from.as_chunks::<2>().0[..count].iter().enumerate() {
                                    pixels[lane].0[i] = pair[0];
                                    pixels[lane + 1].0[i] = pair[1];
                                }
                            }
                            lane += 2;
                        } else {
                            for i in 0..count {
                                pixels[lane].0[i] = from[i * map.factor];
                            }
                            lane += 1;
                        }
                    }
                    let rows = S::transpose(std::array::from_fn(|i| S::load(&pixels[i])));
                    row.iter_mut().zip(rows).for_each(|(block, values)| S::store(block, values));
                }
            }
        }
    }
}

/// The lanes of up to 16 pixels as blocks of pixels; beyond the last pixel values are arbitrary.
///
/// # Safety
/// The processor has the instructions of `S`.
#[inline(always)]
unsafe fn transpose<S: Simd>(pixels: &[Block], lanes: &mut [Block; LANES]) {
    // SAFETY: the caller's promise.
    unsafe {
        let last = pixels.len() - 1;
        let rows = S::transpose(std::array::from_fn(|i| S::load(&pixels[i.min(last)])));
        lanes.iter_mut().zip(rows).for_each(|(block, values)| S::store(block, values));
    }
}
