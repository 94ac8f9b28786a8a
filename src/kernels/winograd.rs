//! 3x3 convolutions by cells of 4x4 outputs, with a quarter of the multiplications.
//!
//! A cell `y` of outputs depends on a patch `d` of 6x6 inputs, and `y = A [(G g G') * (B d B')] A'` for a
//! kernel `g`, where `*` multiplies number by number: 36 products in the place of 144 (Winograd 1980; Lavin
//! and Gray 2016, F(4x4, 3x3); the points are 0, 1, -1, 2, -2 and infinity). Here the rows of `G` are
//! multiplied by 24, 6, 6, 24, 24 and 6, which makes them whole numbers; then `A` gives 9 x 2^k times the
//! output.
//!
//! [`convolve`] does so in f32. Rounding then depends on where a cell begins, so it serves training, not
//! inference, whose results are the same to the bit however a frame is cut. In 8 bits nothing is rounded
//! ([`super::narrow`]).

use std::num::Wrapping;

use rayon::prelude::*;

use super::{
    Block, LANES, Shape, Shared, View, ViewMut,
    conv::Epilogue,
    memory::Pool,
    simd::{Kernel, Simd, Tier},
};

/// Outputs along a side of a cell.
pub const SIDE: usize = 4;

/// Inputs along a side of a cell's patch.
pub const PATCH: usize = SIDE + 2;

/// Numbers that represent a patch, and then a cell, between the two transforms.
pub const POINTS: usize = PATCH * PATCH;

/// Along either axis, output `i` of a cell comes out multiplied by 3 and by 2 to the power of `POWERS[i]`.
pub const POWERS: [u32; SIDE] = [3, 2, 1, 1];

/// Numbers that the transforms can be computed with.
pub trait Ring: Copy {
    /// `self + other`.
    fn plus(self, other: Self) -> Self;
    /// `self - other`.
    fn minus(self, other: Self) -> Self;
    /// `2 self`.
    fn twice(self) -> Self;
}

macro_rules! wrapping_ring {
    ($number:ty) => {
        impl Ring for Wrapping<$number> {
            fn plus(self, other: Self) -> Self {
                self + other
            }
            fn minus(self, other: Self) -> Self {
                self - other
            }
            fn twice(self) -> Self {
                self << 1
            }
        }
    };
}
wrapping_ring!(i16);
wrapping_ring!(i32);

/// Sixteen f32.
#[derive(Clone, Copy)]
struct Real<S: Simd>(S, S::V);

impl<S: Simd> Ring for Real<S> {
    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        Self(self.0, self.0.add(self.1, other.1))
    }
    #[inline(always)]
    fn minus(self, other: Self) -> Self {
        Self(self.0, self.0.fma(other.1, self.0.splat(-1.0), self.1))
    }
    #[inline(always)]
    fn twice(self) -> Self {
        self.plus(self)
    }
}

/// `B d`: a line of a patch at the six points.
#[inline(always)]
pub fn evaluate<R: Ring>(d: [R; PATCH]) -> [R; PATCH] {
    let even = d[4].minus(d[2]);
    let odd = d[3].minus(d[1]).twice();
    [
        d[0].minus(d[2]).twice().twice().plus(even),
        d[3].plus(d[4]).minus(d[1].plus(d[2]).twice().twice()),
        d[4].minus(d[3]).plus(d[1].minus(d[2]).twice().twice()),
        even.plus(odd),
        even.minus(odd),
        d[5].minus(d[3]).minus(odd.twice()),
    ]
}

/// `A m`: a line of a cell, times 3 x 2^[`POWERS`].
#[inline(always)]
pub fn interpolate<R: Ring>(m: [R; PATCH]) -> [R; SIDE] {
    let [near_even, near_odd] = [m[1].plus(m[2]), m[1].minus(m[2])];
    let [far_even, far_odd] = [m[3].plus(m[4]), m[3].minus(m[4])];
    [
        m[0].plus(near_even.twice().twice()).plus(far_even),
        near_odd.twice().plus(far_odd),
        near_even.plus(far_even),
        near_odd.plus(far_odd.twice()).plus(m[5]),
    ]
}

/// `G g`: a line of a kernel at the six points, times 24, 6, 6, 24, 24 and 6.
#[inline(always)]
fn evaluate_line<R: Ring>(g: [R; 3]) -> [R; PATCH] {
    let (even, odd) = (g[0].plus(g[2]), g[1].twice());
    let far = g[0].plus(g[2].twice().twice());
    let near = g[1].minus(even);
    let [first, last] = [g[0].twice().plus(g[0]), g[2].twice().plus(g[2])];
    [first.twice(), near.minus(odd), near, far.plus(odd), far.minus(odd), last.twice()]
}

/// `G g G'`: a kernel at all points, row by row, times those factors.
#[inline(always)]
pub fn evaluate_kernel<R: Ring>(kernel: [R; 9]) -> [R; POINTS] {
    let mut columns = [[kernel[0]; PATCH]; 3];
    let mut points = [kernel[0]; POINTS];
    for x in 0..3 {
        columns[x] = evaluate_line([kernel[x], kernel[3 + x], kernel[6 + x]]);
    }
    for y in 0..PATCH {
        let row = evaluate_line([columns[0][y], columns[1][y], columns[2][y]]);
        points[PATCH * y..][..PATCH].copy_from_slice(&row);
    }
    points
}

/// Cells side by side that are transformed, multiplied and transformed back together.
const CELLS: usize = 12;

/// The most cells, and the most output planes, whose products stay in registers together.
const STRIP: usize = 6;
const OUTPUTS: usize = 2;

/// Memory for points and products.
static POINTS_FREE: Pool<Block> = Pool::new();

/// Gives all free memory back to the system.
pub fn clear() {
    POINTS_FREE.clear();
}

/// Whether a convolution of frames of `width` columns is faster by cells. Where there are few columns,
/// weights are read for too few cells.
pub fn serves(width: usize) -> bool {
    width >= 32
}

/// Evaluates the weights of a 3x3 convolution, packed by [`super::conv::pack`], at all points:
/// `[output plane][point][input plane][16 input lanes]`.
pub fn transform(tier: Tier, packed: &[Block], planes: usize) -> Vec<Block> {
    let mut weights = vec![Block::default(); packed.len() / 9 * POINTS];
    let of_planes = packed.par_chunks(planes * 9 * LANES);
    weights.par_chunks_mut(planes * POINTS * LANES).zip(of_planes).for_each(|(weights, packed)| {
        tier.run(Transform { packed, weights, planes });
    });
    weights
}

/// See [`transform`]: the weights of one output plane.
struct Transform<'a> {
    packed: &'a [Block],
    weights: &'a mut [Block],
    planes: usize,
}

impl Kernel for Transform<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { packed, weights, planes } = self;
        for (i, taps) in packed.chunks_exact(9 * LANES).enumerate() {
            for lane in 0..LANES {
                let mut kernel = [Real(simd, simd.splat(0.0)); 9];
                for t in 0..9 {
                    kernel[t] = Real(simd, simd.get(&taps[t * LANES + lane]));
                }
                for (point, value) in evaluate_kernel(kernel).into_iter().enumerate() {
                    simd.set(&mut weights[(point * planes + i) * LANES + lane], value.1);
                }
            }
        }
    }
}

/// [`super::conv::convolve`] for a 3x3 convolution whose weights come from [`transform`].
///
/// # Panics
/// As for that function.
pub fn convolve(
    tier: Tier,
    sources: &[View],
    weights: &[Block],
    bias: &[Block],
    epilogue: Epilogue,
    output: ViewMut,
) {
    let (input, out) = (sources[0].shape, output.shape);
    for source in sources {
        assert_eq!((source.shape.n, source.shape.h, source.shape.w), (input.n, input.h, input.w));
        assert!(source.shape.pad >= 1, "border too small");
    }
    let planes: usize = sources.iter().map(|s| s.shape.planes()).sum();
    assert_eq!((out.n, out.h, out.w), (input.n, input.h, input.w));
    assert_eq!(weights.len(), out.planes() * planes * POINTS * LANES);
    assert!(epilogue.accumulate || bias.len() == out.planes());
    let strips = out.h.div_ceil(SIDE);
    let pointer = Shared(output.data.as_mut_ptr());
    (0..out.n * strips).into_par_iter().for_each(|task| {
        let (n, y) = (task / strips, task % strips * SIDE);
        tier.run(Rows { sources, weights, bias, epilogue, out, pointer, n, y });
    });
}

/// The work of one task: a row of cells of all output planes of one image.
struct Rows<'a> {
    sources: &'a [View<'a>],
    weights: &'a [Block],
    bias: &'a [Block],
    epilogue: Epilogue,
    out: Shape,
    pointer: Shared,
    n: usize,
    /// The first row.
    y: usize,
}

/// An input plane: where the rows of the patches begin (`None` for rows beyond the border), and how many of
/// its lanes are in use.
struct Plane {
    rows: [Option<*const Block>; PATCH],
    lanes: usize,
}

impl Kernel for Rows<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let mut planes = Vec::with_capacity(64);
        for source in self.sources {
            let s = source.shape;
            for plane in 0..s.planes() {
                let above = s.row(self.n, plane, self.y) - s.row_stride() - 1;
                let row = |i: usize| {
                    let row = source.data.as_ptr().wrapping_add(above + i * s.row_stride());
                    (self.y + i <= s.h + 1).then_some(row)
                };
                planes.push(Plane { rows: std::array::from_fn(row), lanes: s.lanes(plane) });
            }
        }
        // Points lie one value further apart than they need to, so that not all are in the same few sets of a
        // cache.
        let (point, product) = (planes.len() * CELLS + 1, OUTPUTS * CELLS + 1);
        let mut points = POINTS_FREE.take(POINTS * point, Block::default());
        let mut products = POINTS_FREE.take(POINTS * product, Block::default());
        for x in (0..self.out.w).step_by(SIDE * CELLS) {
            let cells = (self.out.w - x).div_ceil(SIDE).min(CELLS);
            for (i, plane) in planes.iter().enumerate() {
                // SAFETY: `convolve` checked lengths and borders; patches end at the border.
                unsafe { self.evaluate(simd, plane, x, cells, &mut points[i * CELLS..], point) }
            }
            for plane in (0..self.out.planes()).step_by(S::TILE.0) {
                // SAFETY: `convolve` checked lengths; tasks own disjoint rows.
                unsafe {
                    if S::TILE.0 == OUTPUTS && plane + 1 < self.out.planes() {
                        self.outputs::<S, OUTPUTS>(simd, &planes, plane, (x, cells), &points, &mut products);
                    } else {
                        self.outputs::<S, 1>(simd, &planes, plane, (x, cells), &points, &mut products);
                    }
                }
            }
        }
    }
}

impl Rows<'_> {
    /// The patches of `cells` cells from column `x` on, at all points, which lie `stride` blocks apart.
    #[inline(always)]
    unsafe fn evaluate<S: Simd>(
        &self,
        simd: S,
        plane: &Plane,
        x: usize,
        cells: usize,
        points: &mut [Block],
        stride: usize,
    ) {
        // SAFETY: the caller's promise.
        unsafe {
            let nothing = Real(simd, simd.splat(0.0));
            // Columns of a patch at the points. The last two are the first two of the next patch.
            let mut columns = [[nothing; PATCH]; PATCH];
            for cell in 0..cells {
                for i in if cell == 0 { 0 } else { PATCH - SIDE }..PATCH {
                    let at = x + SIDE * cell + i;
                    let mut column = [nothing; PATCH];
                    for y in 0..PATCH {
                        if let Some(row) = plane.rows[y].filter(|_| at <= self.out.w + 1) {
                            column[y] = Real(simd, simd.load(row.add(at)));
                        }
                    }
                    columns[i] = evaluate(column);
                }
                for y in 0..PATCH {
                    let mut row = [nothing; PATCH];
                    for i in 0..PATCH {
                        row[i] = columns[i][y];
                    }
                    for (i, value) in evaluate(row).into_iter().enumerate() {
                        simd.set(&mut points[(PATCH * y + i) * stride + cell], value.1);
                    }
                }
                columns.copy_within(SIDE.., 0);
            }
        }
    }

    /// `OUT` output planes from `first` on, of some cells.
    #[inline(always)]
    unsafe fn outputs<S: Simd, const OUT: usize>(
        &self,
        simd: S,
        planes: &[Plane],
        first: usize,
        (x, cells): (usize, usize),
        points: &[Block],
        products: &mut [Block],
    ) {
        let (point, product) = (planes.len() * CELLS + 1, OUTPUTS * CELLS + 1);
        let weights = &self.weights[first * planes.len() * POINTS * LANES..];
        let strips = cells.div_ceil(STRIP);
        // SAFETY: the caller's promise.
        unsafe {
            for i in 0..POINTS {
                let points = points[i * point..].as_ptr();
                let weights = weights[i * planes.len() * LANES..].as_ptr();
                let products = products[i * product..].as_mut_ptr();
                let mut at = 0;
                for strip in 0..strips {
                    let count = (cells - at).div_ceil(strips - strip);
                    let place = (points.add(at), weights, products.add(at));
                    match count {
                        1 => multiply::<S, OUT, 1>(simd, planes, place),
                        2 => multiply::<S, OUT, 2>(simd, planes, place),
                        3 => multiply::<S, OUT, 3>(simd, planes, place),
                        4 => multiply::<S, OUT, 4>(simd, planes, place),
                        5 => multiply::<S, OUT, 5>(simd, planes, place),
                        _ => multiply::<S, OUT, STRIP>(simd, planes, place),
                    }
                    at += count;
                }
            }
            for (o, cell) in (0..OUT).flat_map(|o| (0..cells).map(move |cell| (o, cell))) {
                let products = products[o * CELLS + cell..].as_ptr();
                self.interpolate(simd, products, product, first + o, x + SIDE * cell);
            }
        }
    }

    /// Makes outputs of a cell's products, which lie `stride` blocks apart, and stores those that are
    /// pixels.
    #[inline(always)]
    unsafe fn interpolate<S: Simd>(
        &self,
        simd: S,
        products: *const Block,
        stride: usize,
        plane: usize,
        x: usize,
    ) {
        // SAFETY: the caller's promise.
        unsafe {
            let nothing = Real(simd, simd.splat(0.0));
            let mut lines = [[nothing; SIDE]; PATCH];
            for i in 0..PATCH {
                let mut line = [nothing; PATCH];
                for y in 0..PATCH {
                    line[y] = Real(simd, simd.load(products.add((PATCH * y + i) * stride)));
                }
                lines[i] = interpolate(line);
            }
            for y in 0..SIDE.min(self.out.h - self.y) {
                let mut row = [nothing; PATCH];
                for i in 0..PATCH {
                    row[i] = lines[i][y];
                }
                let row = interpolate(row);
                let to = self.out.row(self.n, plane, self.y + y) + x;
                for i in 0..SIDE.min(self.out.w - x) {
                    let to = self.pointer.at(to + i);
                    let factor = simd.splat(1.0 / (9.0 * (1u32 << (POWERS[y] + POWERS[i])) as f32));
                    let add =
                        if self.epilogue.accumulate { simd.load(to) } else { simd.get(&self.bias[plane]) };
                    let sum = simd.fma(row[i].1, factor, add);
                    simd.store(to, if self.epilogue.relu { simd.max(sum, simd.splat(0.0)) } else { sum });
                }
            }
        }
    }
}

/// Multiplies `COUNT` cells by the weights of `OUT` output planes at one point, and sums over the input
/// `planes`. The pointers say where the point's values of the cells, its weights and its products begin.
///
/// # Safety
/// All of them can be read and written.
#[inline(always)]
unsafe fn multiply<S: Simd, const OUT: usize, const COUNT: usize>(
    simd: S,
    planes: &[Plane],
    (points, weights, products): (*const Block, *const Block, *mut Block),
) {
    let next = planes.len() * POINTS * LANES;
    // SAFETY: the caller's promise.
    unsafe {
        let mut sums = [[simd.splat(0.0); COUNT]; OUT];
        for (i, plane) in planes.iter().enumerate() {
            let points = points.add(i * CELLS).cast::<f32>();
            for lane in 0..plane.lanes {
                let mut w = [simd.splat(0.0); OUT];
                for o in 0..OUT {
                    w[o] = simd.load(weights.add(o * next + i * LANES + lane));
                }
                for s in 0..COUNT {
                    let x = simd.splat(*points.add(s * LANES + lane));
                    for o in 0..OUT {
                        sums[o][s] = simd.fma(w[o], x, sums[o][s]);
                    }
                }
            }
        }
        for o in 0..OUT {
            for s in 0..COUNT {
                simd.store(products.add(o * CELLS + s), sums[o][s]);
            }
        }
    }
}
