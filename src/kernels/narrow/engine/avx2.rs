//! AVX2 and AVX-VNNI: products of 8 bits, in vectors of 32 bytes. Those of bfloat16 are the portable
//! engine's.

use std::arch::x86_64::*;

use super::{Backend, CELLS, NINTH, Product};
use crate::kernels::{
    LANES,
    conv::Geometry,
    narrow::{CHUNK, GROUP, Sums, WORD, Wide},
    winograd::{self, PATCH, POWERS, Ring, SIDE},
};

/// Positions whose sums stay in registers. Each takes two.
const TILE: usize = 4;

/// Cells whose products stay in registers. Each takes two.
const STRIP: usize = 4;

/// Lanes of a register.
const HALF: usize = LANES / 2;

/// AVX2: four multiply-accumulates of 8 bits a lane, in three instructions.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Avx2(());

impl Backend for Avx2 {
    const NAME: &str = "Avx2";

    fn detect() -> Option<Self> {
        is_x86_feature_detected!("avx2").then_some(Self(()))
    }

    fn prefers_int8(self) -> bool {
        true
    }

    fn prefers_winograd(self, geometry: Geometry) -> bool {
        geometry == Geometry::Same(3)
    }

    fn adds_in_16_bits(self, geometry: Geometry) -> bool {
        !self.prefers_winograd(geometry)
    }

    #[target_feature(enable = "avx2")]
    unsafe fn multiply_int8(self, product: Product, sums: &mut Sums) {
        // SAFETY: the caller's promise.
        unsafe { tiles(self, product, sums) }
    }

    #[target_feature(enable = "avx2")]
    unsafe fn evaluate(self, patch: [*const u8; PATCH], cells: usize, points: *mut u8, stride: usize) {
        let nothing = Halves(self, _mm256_setzero_si256());
        // Columns of a patch at the points. The last two are the first two of the next patch.
        let mut columns = [[nothing; PATCH]; PATCH];
        for cell in 0..cells {
            // SAFETY: the caller's promise; sixteen channels of 8 bits are aligned to 16 bytes, and to 32 at
            // the points, where they have 16 bits.
            unsafe {
                for x in if cell == 0 { 0 } else { PATCH - SIDE }..PATCH {
                    let mut column = [nothing; PATCH];
                    for y in 0..PATCH {
                        let bytes = patch[y].add((SIDE * cell + x) * size_of::<Wide>());
                        column[y] = Halves(self, _mm256_cvtepu8_epi16(_mm_load_si128(bytes.cast())));
                    }
                    columns[x] = winograd::evaluate(column);
                }
                for y in 0..PATCH {
                    let mut row = [nothing; PATCH];
                    for x in 0..PATCH {
                        row[x] = columns[x][y];
                    }
                    let row = winograd::evaluate(row);
                    for x in 0..PATCH {
                        let at = ((PATCH * y + x) * stride + cell) * size_of::<Wide>();
                        _mm256_store_si256(points.add(at).cast(), row[x].1);
                    }
                }
            }
            columns.copy_within(SIDE.., 0);
        }
    }

    #[target_feature(enable = "avx2")]
    unsafe fn multiply_points(
        self,
        groups: &[u8],
        points: *const Wide,
        weights: *const Wide,
        cells: usize,
        products: *mut Wide,
    ) {
        for first in (0..cells).step_by(STRIP) {
            // SAFETY: the caller's promise; a value is two registers.
            unsafe {
                let mut acc = [[_mm256_setzero_si256(); 2]; STRIP];
                for (part, &groups) in groups.iter().enumerate() {
                    let mut x = points.add(part * CELLS + first).cast::<u8>();
                    let mut w = weights.add(part * LANES).cast::<__m256i>();
                    for _ in 0..groups {
                        for row in 0..GROUP {
                            let [low, high] = [0, 1].map(|half| _mm256_load_si256(w.add(2 * row + half)));
                            for (p, acc) in acc.iter_mut().enumerate() {
                                let x = x.add(p * size_of::<Wide>() + WORD * row);
                                let x = _mm256_set1_epi32(x.cast::<i32>().read_unaligned());
                                acc[0] = _mm256_add_epi32(acc[0], _mm256_madd_epi16(x, low));
                                acc[1] = _mm256_add_epi32(acc[1], _mm256_madd_epi16(x, high));
                            }
                        }
                        (x, w) = (x.add(WORD * GROUP), w.add(2 * GROUP));
                    }
                }
                for (p, acc) in acc.iter().enumerate() {
                    let to = products.add(first + p).cast::<__m256i>();
                    _mm256_store_si256(to, acc[0]);
                    _mm256_store_si256(to.add(1), acc[1]);
                }
            }
        }
        const { assert!(CELLS.is_multiple_of(STRIP)) };
    }

    #[target_feature(enable = "avx2")]
    unsafe fn interpolate(
        self,
        products: *const Wide,
        stride: usize,
        sums: &mut [Sums; SIDE],
        (output, column): (usize, usize),
    ) {
        let nothing = Wholes(self, _mm256_setzero_si256());
        let ninth = _mm256_set1_epi32(NINTH.cast_signed());
        for half in 0..2 {
            let mut lines = [[nothing; SIDE]; PATCH];
            for x in 0..PATCH {
                let mut line = [nothing; PATCH];
                // SAFETY: the caller's promise; half a value is a register.
                unsafe {
                    for y in 0..PATCH {
                        let product = products.add((PATCH * y + x) * stride).cast::<__m256i>();
                        line[y] = Wholes(self, _mm256_load_si256(product.add(half)));
                    }
                    lines[x] = winograd::interpolate(line);
                }
            }
            for (y, sums) in sums.iter_mut().enumerate() {
                let mut row = [nothing; PATCH];
                for x in 0..PATCH {
                    row[x] = lines[x][y];
                }
                // SAFETY: the instructions are this function's; half a block is a register.
                unsafe {
                    let row = winograd::interpolate(row);
                    for x in 0..SIDE {
                        let power = _mm_cvtsi32_si128((POWERS[y] + POWERS[x]).cast_signed());
                        let sum = _mm256_sra_epi32(_mm256_mullo_epi32(row[x].1, ninth), power);
                        let to = &mut sums.0[output][column + x].0[half * HALF..];
                        _mm256_store_ps(to.as_mut_ptr(), _mm256_cvtepi32_ps(sum));
                    }
                }
            }
        }
    }
}

/// AVX-VNNI: as many multiply-accumulates a lane as AVX2, in one instruction.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct AvxVnni(());

impl Backend for AvxVnni {
    const NAME: &str = "AvxVnni";

    fn detect() -> Option<Self> {
        (is_x86_feature_detected!("avx2") && is_x86_feature_detected!("avxvnni")).then_some(Self(()))
    }

    fn prefers_int8(self) -> bool {
        true
    }

    #[target_feature(enable = "avx2,avxvnni")]
    unsafe fn multiply_int8(self, product: Product, sums: &mut Sums) {
        // SAFETY: the caller's promise.
        unsafe { tiles(self, product, sums) }
    }
}

/// How the products of two rows of words are added to a sum.
trait Words: Copy {
    /// `acc[i] + sum over rows r and j of x[r][i][j] w[r][i][j]`.
    fn add(self, acc: __m256i, x: [__m256i; 2], w: [__m256i; 2]) -> __m256i;
}

/// Two products of each of the two rows are added up in 16 bits first, then in 32. Weights are rounded so
/// that such sums fit into 16 bits ([`FITTING_STEPS`](crate::kernels::narrow::FITTING_STEPS)).
impl Words for Avx2 {
    #[inline(always)]
    fn add(self, acc: __m256i, x: [__m256i; 2], w: [__m256i; 2]) -> __m256i {
        // SAFETY: the token proves that the processor has the instructions.
        unsafe {
            let [a, b] = [0, 1].map(|r| _mm256_maddubs_epi16(x[r], w[r]));
            _mm256_add_epi32(acc, _mm256_madd_epi16(_mm256_add_epi16(a, b), _mm256_set1_epi16(1)))
        }
    }
}

impl Words for AvxVnni {
    #[inline(always)]
    fn add(self, acc: __m256i, x: [__m256i; 2], w: [__m256i; 2]) -> __m256i {
        // SAFETY: as above.
        unsafe { _mm256_dpbusd_avx_epi32(_mm256_dpbusd_avx_epi32(acc, x[0], w[0]), x[1], w[1]) }
    }
}

/// # Safety
/// As [`Backend::multiply_int8`].
#[inline(always)]
unsafe fn tiles<W: Words>(words: W, product: Product, sums: &mut Sums) {
    let Product { terms, groups, position, weights, outputs, plane } = product;
    for (o, sums) in sums.0[..outputs].iter_mut().enumerate() {
        for (tile, sums) in sums.as_chunks_mut::<TILE>().0.iter_mut().enumerate() {
            // SAFETY: the caller's promise; a block is two registers.
            unsafe {
                let mut acc = [[_mm256_setzero_si256(); 2]; TILE];
                for (term, &groups) in terms.iter().zip(groups) {
                    let mut x = term.input.add(position + tile * TILE).cast::<u8>();
                    let mut w = weights.byte_add(term.weights).add(o * plane).cast::<__m256i>();
                    for _ in 0..GROUP / 2 * usize::from(groups) {
                        let row = |at: usize| [0, 1].map(|row| _mm256_load_si256(w.add(2 * row + at)));
                        let w_of = [row(0), row(1)];
                        for (p, acc) in acc.iter_mut().enumerate() {
                            let x = [0, 1].map(|row| {
                                let x = x.add(p * size_of::<Wide>() + WORD * row);
                                _mm256_set1_epi32(x.cast::<i32>().read_unaligned())
                            });
                            *acc = [words.add(acc[0], x, w_of[0]), words.add(acc[1], x, w_of[1])];
                        }
                        (x, w) = (x.add(2 * WORD), w.add(4));
                    }
                }
                for (sum, acc) in sums.iter_mut().zip(acc) {
                    for (half, acc) in acc.into_iter().enumerate() {
                        _mm256_store_ps(sum.0[half * HALF..].as_mut_ptr(), _mm256_cvtepi32_ps(acc));
                    }
                }
            }
        }
    }
    const { assert!(CHUNK.is_multiple_of(TILE)) };
}

/// 16 numbers of 16 bits.
#[derive(Clone, Copy)]
struct Halves(Avx2, __m256i);

/// 8 numbers of 32 bits.
#[derive(Clone, Copy)]
struct Wholes(Avx2, __m256i);

macro_rules! ring {
    ($numbers:ident, $add:ident, $subtract:ident) => {
        impl Ring for $numbers {
            #[inline(always)]
            fn plus(self, other: Self) -> Self {
                // SAFETY: the token proves that the processor has the instructions, here and below.
                unsafe { Self(self.0, $add(self.1, other.1)) }
            }
            #[inline(always)]
            fn minus(self, other: Self) -> Self {
                // SAFETY: as above.
                unsafe { Self(self.0, $subtract(self.1, other.1)) }
            }
            #[inline(always)]
            fn twice(self) -> Self {
                self.plus(self)
            }
        }
    };
}
ring!(Halves, _mm256_add_epi16, _mm256_sub_epi16);
ring!(Wholes, _mm256_add_epi32, _mm256_sub_epi32);
