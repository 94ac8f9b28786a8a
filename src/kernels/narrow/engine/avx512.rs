//! AVX512-VNNI and AVX512-BF16: products of 8 bits and of bfloat16, in vectors of 64 bytes.

use std::arch::x86_64::*;

use half::bf16;

use super::{Backend, Correlation, Product, cpuid};
use crate::kernels::{
    Block, LANES,
    narrow::{CHUNK, GROUP, Sums, WORD, Wide},
    simd::{Avx512 as Lanes, Simd},
};

/// Sums that stay in registers: those of a tile's positions for one output plane or two. Half of the
/// registers are left for weights. With fewer sums, additions to the same sum would wait for each other.
const SUMS: usize = 16;

/// AVX512-VNNI: four multiply-accumulates of 8 bits a lane, and twice as many lanes as AVX2 has. Products of
/// bfloat16 are the portable engine's.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Vnni(Lanes);

impl Backend for Vnni {
    const NAME: &str = "Vnni";

    fn detect() -> Option<Self> {
        let has = is_x86_feature_detected!("avx512vnni") && is_x86_feature_detected!("avx512bw");
        has.then(Lanes::detect).flatten().map(Self)
    }

    fn prefers_int8(self) -> bool {
        true
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
    unsafe fn multiply_int8(self, product: Product, sums: &mut Sums) {
        // SAFETY: the caller's promise.
        unsafe { multiply(self, product, sums) }
    }
}

/// AVX512-VNNI and AVX512-BF16: also two multiply-accumulates of bfloat16 a lane.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Avx512(Vnni);

impl Backend for Avx512 {
    const NAME: &str = "Avx512";

    fn detect() -> Option<Self> {
        is_x86_feature_detected!("avx512bf16").then(Vnni::detect).flatten().map(Self)
    }

    /// AMD's processors are faster in bfloat16; on Intel's (Emerald Rapids) a training step in it takes 1.7 x
    /// as long.
    fn prefers_bf16(self) -> bool {
        !is_intel()
    }

    fn prefers_int8(self) -> bool {
        true
    }

    unsafe fn multiply_int8(self, product: Product, sums: &mut Sums) {
        // SAFETY: the caller's promise.
        unsafe { self.0.multiply_int8(product, sums) }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    unsafe fn multiply_bf16(self, product: Product, sums: &mut Sums) {
        // SAFETY: the caller's promise.
        unsafe { multiply(self, product, sums) }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    unsafe fn correlate(self, correlation: Correlation, sums: &mut Sums) {
        // SAFETY: the caller's promise.
        unsafe {
            if correlation.outputs == 2 {
                correlate_tiles::<2, { SUMS / 2 }>(self, correlation, sums);
            } else {
                correlate_tiles::<1, SUMS>(self, correlation, sums);
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    unsafe fn narrow_spread(self, low: &[Block], high: Option<&[Block]>, out: *mut Wide, step: usize) {
        for (i, low) in low.iter().enumerate() {
            // SAFETY: the caller's promise; blocks and wides are 64 bytes, aligned to as many.
            unsafe {
                let low = _mm512_load_ps(low.0.as_ptr());
                let high = high.map_or(_mm512_setzero_ps(), |h| _mm512_load_ps(h[i].0.as_ptr()));
                let both: __m512i = std::mem::transmute(_mm512_cvtne2ps_pbh(high, low));
                _mm512_store_si512(out.add(i * step).cast(), both);
            }
        }
    }

    fn interleave(self, pairs: &[[Block; 2]], out: &mut [Wide]) {
        // SAFETY: the token's promise.
        unsafe { interleave(pairs, out) }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    unsafe fn transpose(self, blocks: &[Block], rows: *mut bf16, stride: usize) {
        let mut r: [__m512; LANES] = [_mm512_setzero_ps(); LANES];
        for (r, block) in r.iter_mut().zip(blocks) {
            // SAFETY: a block is 64 bytes, aligned to as many.
            *r = unsafe { _mm512_load_ps(block.0.as_ptr()) };
        }
        let r = self.lanes().transpose(r);
        for (c, r) in r.iter().enumerate() {
            // SAFETY: the caller's promise.
            unsafe {
                let row: __m256i = std::mem::transmute(_mm512_cvtneps_pbh(*r));
                _mm256_storeu_si256(rows.add(c * stride).cast(), row);
            }
        }
    }
}

/// Whether Intel made the processor.
fn is_intel() -> bool {
    let vendor = cpuid(0);
    [vendor.ebx, vendor.edx, vendor.ecx].map(u32::to_le_bytes).concat() == b"GenuineIntel"
}

/// How the products of two or four neighbouring values of a vector add up in every lane.
trait Words: Copy {
    /// The lanes that come with it.
    fn lanes(self) -> Lanes;

    /// `acc[i] + sum over j of x[i][j] w[i][j]`.
    fn add(self, acc: __m512, x: __m512i, w: __m512i) -> __m512;

    /// Sums as f32.
    fn sums(self, acc: __m512) -> __m512;
}

/// Fours of 8 bits, whose sums are whole numbers.
impl Words for Vnni {
    #[inline(always)]
    fn lanes(self) -> Lanes {
        self.0
    }

    #[inline(always)]
    fn add(self, acc: __m512, x: __m512i, w: __m512i) -> __m512 {
        // SAFETY: the token proves that the processor has the instructions.
        unsafe { _mm512_castsi512_ps(_mm512_dpbusd_epi32(_mm512_castps_si512(acc), x, w)) }
    }

    #[inline(always)]
    fn sums(self, acc: __m512) -> __m512 {
        // SAFETY: as above.
        unsafe { _mm512_cvtepi32_ps(_mm512_castps_si512(acc)) }
    }
}

/// Pairs of bfloat16.
impl Words for Avx512 {
    #[inline(always)]
    fn lanes(self) -> Lanes {
        self.0.lanes()
    }

    #[inline(always)]
    fn add(self, acc: __m512, x: __m512i, w: __m512i) -> __m512 {
        // SAFETY: the token proves that the processor has the instructions.
        unsafe {
            let [x, w] = [x, w].map(|v| std::mem::transmute::<__m512i, __m512bh>(v));
            _mm512_dpbf16_ps(acc, w, x)
        }
    }

    #[inline(always)]
    fn sums(self, acc: __m512) -> __m512 {
        acc
    }
}

/// # Safety
/// As [`Backend::multiply_int8`].
#[inline(always)]
unsafe fn multiply<W: Words>(words: W, product: Product, sums: &mut Sums) {
    // SAFETY: the caller's promise.
    unsafe {
        if product.outputs == 2 {
            tiles::<W, 2, { SUMS / 2 }>(words, product, sums);
        } else {
            tiles::<W, 1, SUMS>(words, product, sums);
        }
    }
}

/// # Safety
/// As [`Backend::multiply_int8`].
#[inline(always)]
unsafe fn tiles<W: Words, const OUT: usize, const TILE: usize>(words: W, product: Product, sums: &mut Sums) {
    let Product { terms, groups, position, weights, plane, .. } = product;
    for first in (0..CHUNK).step_by(TILE) {
        // SAFETY: the caller's promise.
        unsafe {
            let mut acc = [[_mm512_setzero_ps(); TILE]; OUT];
            for (term, &groups) in terms.iter().zip(groups) {
                let mut x = term.input.add(position + first).cast::<u8>();
                let mut w = weights.byte_add(term.weights);
                for _ in 0..groups {
                    for row in 0..GROUP {
                        add_row(words, &mut acc, x.add(WORD * row), size_of::<Wide>(), w.add(row), plane);
                    }
                    (x, w) = (x.add(WORD * GROUP), w.add(GROUP));
                }
            }
            store(words, &acc, sums, first);
        }
    }
}

/// Multiplies one word of each row of a tile by the words at `w` of each output plane, and adds the products
/// to `acc`. Rows of the tile lie `stride` bytes apart from `x` on, and output planes `plane` rows apart.
///
/// # Safety
/// All of them can be read.
#[inline(always)]
unsafe fn add_row<W: Words, const OUT: usize, const TILE: usize>(
    words: W,
    acc: &mut [[__m512; TILE]; OUT],
    x: *const u8,
    stride: usize,
    w: *const Wide,
    plane: usize,
) {
    // SAFETY: the caller's promise.
    unsafe {
        let w: [__m512i; OUT] = std::array::from_fn(|o| _mm512_load_si512(w.add(o * plane).cast()));
        for row in 0..TILE {
            let x = _mm512_set1_epi32(x.add(row * stride).cast::<i32>().read_unaligned());
            for o in 0..OUT {
                acc[o][row] = words.add(acc[o][row], x, w[o]);
            }
        }
    }
}

/// Stores a tile whose first row is row `first` of the sums.
#[inline(always)]
fn store<W: Words, const OUT: usize, const TILE: usize>(
    words: W,
    acc: &[[__m512; TILE]; OUT],
    sums: &mut Sums,
    first: usize,
) {
    for (acc, sums) in acc.iter().zip(&mut sums.0) {
        for (acc, sum) in acc.iter().zip(&mut sums[first..]) {
            words.lanes().set(sum, words.sums(*acc));
        }
    }
}

#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
#[inline]
unsafe fn correlate_tiles<const OUT: usize, const TILE: usize>(
    words: Avx512,
    correlation: Correlation,
    sums: &mut Sums,
) {
    let Correlation { steps, channels, stride, pairs, plane, .. } = correlation;
    for first in (0..CHUNK).step_by(TILE) {
        // SAFETY: the caller's promise; a block is 64 bytes, aligned to as many.
        unsafe {
            let mut acc: [[__m512; TILE]; OUT] = std::array::from_fn(|o| {
                std::array::from_fn(|c| _mm512_load_ps(sums.0[o][first + c].0.as_ptr()))
            });
            let rows = channels.byte_add(first * stride).cast::<u8>();
            for pair in 0..steps * CHUNK / 2 {
                add_row(words, &mut acc, rows.add(WORD * pair), stride, pairs.add(pair), plane);
            }
            store(words, &acc, sums, first);
        }
    }
}

#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn interleave(pairs: &[[Block; 2]], out: &mut [Wide]) {
    for (pair, out) in pairs.iter().zip(out) {
        // SAFETY: blocks and wides are 64 bytes, aligned to as many.
        unsafe {
            let [a, b] = [0, 1].map(|i| {
                let half: __m256i =
                    std::mem::transmute(_mm512_cvtneps_pbh(_mm512_load_ps(pair[i].0.as_ptr())));
                _mm512_cvtepu16_epi32(half)
            });
            let both = _mm512_or_si512(a, _mm512_slli_epi32::<16>(b));
            _mm512_store_si512(out.0.as_mut_ptr().cast(), both);
        }
    }
}
