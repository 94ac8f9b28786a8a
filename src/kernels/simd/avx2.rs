//! Two registers of eight lanes: AVX2 with FMA.

use std::{arch::x86_64::*, ops::Range};

use super::{Block, Kernel, LANES, PAIRS, Simd};
use crate::kernels::exponential::{EXP, LIMIT, LN_2};

/// Two registers of eight lanes. Holding one proves that the processor has the instructions.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Avx2(());

/// Compiles a kernel for these instructions.
#[target_feature(enable = "avx2,fma")]
fn compiled<K: Kernel>(lanes: Avx2, kernel: K) {
    kernel.run(lanes);
}

impl Simd for Avx2 {
    const NAME: &str = "Avx2";
    type V = (__m256, __m256);
    // 2 registers a block x 6 pixels = 12 accumulators of 16 registers.
    const TILE: (usize, usize) = (1, 6);

    fn detect() -> Option<Self> {
        (is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")).then_some(Self(()))
    }
    fn run<K: Kernel>(self, kernel: K) {
        // SAFETY: the token's promise.
        unsafe { compiled(self, kernel) }
    }

    #[inline(always)]
    fn splat(self, x: f32) -> Self::V {
        // SAFETY: the token's promise.
        unsafe { (_mm256_set1_ps(x), _mm256_set1_ps(x)) }
    }
    #[inline(always)]
    unsafe fn load(self, p: *const Block) -> Self::V {
        let p = p.cast::<f32>();
        // SAFETY: the caller's promise; a block is aligned to 64 bytes.
        unsafe { (_mm256_load_ps(p), _mm256_load_ps(p.add(8))) }
    }
    #[inline(always)]
    unsafe fn store(self, p: *mut Block, v: Self::V) {
        let p = p.cast::<f32>();
        // SAFETY: the caller's promise; a block is aligned to 64 bytes.
        unsafe {
            _mm256_store_ps(p, v.0);
            _mm256_store_ps(p.add(8), v.1);
        }
    }
    #[inline(always)]
    unsafe fn read(self, p: *const f32) -> Self::V {
        // SAFETY: the caller's promise.
        unsafe { (_mm256_loadu_ps(p), _mm256_loadu_ps(p.add(8))) }
    }
    #[inline(always)]
    unsafe fn write(self, p: *mut f32, v: Self::V) {
        // SAFETY: the caller's promise.
        unsafe {
            _mm256_storeu_ps(p, v.0);
            _mm256_storeu_ps(p.add(8), v.1);
        }
    }
    #[inline(always)]
    fn fma(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        // SAFETY: the token's promise.
        unsafe { (_mm256_fmadd_ps(a.0, b.0, c.0), _mm256_fmadd_ps(a.1, b.1, c.1)) }
    }
    #[inline(always)]
    fn mul(self, a: Self::V, b: Self::V) -> Self::V {
        // SAFETY: the token's promise.
        unsafe { (_mm256_mul_ps(a.0, b.0), _mm256_mul_ps(a.1, b.1)) }
    }
    #[inline(always)]
    fn div(self, a: Self::V, b: Self::V) -> Self::V {
        // SAFETY: the token's promise.
        unsafe { (_mm256_div_ps(a.0, b.0), _mm256_div_ps(a.1, b.1)) }
    }
    #[inline(always)]
    fn add(self, a: Self::V, b: Self::V) -> Self::V {
        // SAFETY: the token's promise.
        unsafe { (_mm256_add_ps(a.0, b.0), _mm256_add_ps(a.1, b.1)) }
    }
    #[inline(always)]
    fn max(self, a: Self::V, b: Self::V) -> Self::V {
        // SAFETY: the token's promise.
        unsafe { (_mm256_max_ps(a.0, b.0), _mm256_max_ps(a.1, b.1)) }
    }
    #[inline(always)]
    unsafe fn read_some(self, p: *const f32, lanes: Range<usize>, other: f32) -> Self::V {
        // SAFETY: the caller's promise; lanes that a mask leaves out are not read.
        unsafe {
            if lanes == (0..LANES) {
                return self.read(p);
            }
            (read_some_eight(p, lanes.clone(), 0, other), read_some_eight(p, lanes, HALF, other))
        }
    }
    #[inline(always)]
    unsafe fn write_first(self, p: *mut f32, count: usize, v: Self::V) {
        // Masked stores are microcode on AMD's processors. What is left of the lanes moves to the front.
        // SAFETY: the caller's promise; `count` values are written, in parts.
        unsafe {
            if count == LANES {
                return self.write(p, v);
            }
            let (mut p, mut eight) = (p, v.0);
            if count & 8 != 0 {
                _mm256_storeu_ps(p, eight);
                (p, eight) = (p.add(8), v.1);
            }
            let mut four = _mm256_castps256_ps128(eight);
            if count & 4 != 0 {
                _mm_storeu_ps(p, four);
                (p, four) = (p.add(4), _mm256_extractf128_ps::<1>(eight));
            }
            if count & 2 != 0 {
                _mm_storel_pd(p.cast(), _mm_castps_pd(four));
                (p, four) = (p.add(2), _mm_movehl_ps(four, four));
            }
            if count & 1 != 0 {
                _mm_store_ss(p, four);
            }
        }
    }
    #[inline(always)]
    fn transpose(self, mut rows: [Self::V; LANES]) -> [Self::V; LANES] {
        let mut quarters = [[[rows[0].0; HALF]; 2]; 2];
        for i in 0..LANES {
            quarters[i / HALF][0][i % HALF] = rows[i].0;
            quarters[i / HALF][1][i % HALF] = rows[i].1;
        }
        // SAFETY: the token's promise.
        let [[a, b], [c, d]] = unsafe {
            let [[a, b], [c, d]] = quarters;
            [[transpose_eight(a), transpose_eight(b)], [transpose_eight(c), transpose_eight(d)]]
        };
        for i in 0..HALF {
            rows[i] = (a[i], c[i]);
            rows[HALF + i] = (b[i], d[i]);
        }
        rows
    }
    #[inline(always)]
    fn transpose_pairs(self, mut rows: [Self::V; PAIRS]) -> [Self::V; PAIRS] {
        let mut quarters = [[[rows[0].0; PAIRS / 2]; 2]; 2];
        for i in 0..PAIRS {
            quarters[2 * i / PAIRS][0][i % (PAIRS / 2)] = rows[i].0;
            quarters[2 * i / PAIRS][1][i % (PAIRS / 2)] = rows[i].1;
        }
        // SAFETY: the token's promise.
        let [[a, b], [c, d]] = unsafe {
            let [[a, b], [c, d]] = quarters;
            [
                [transpose_four_pairs(a), transpose_four_pairs(b)],
                [transpose_four_pairs(c), transpose_four_pairs(d)],
            ]
        };
        for i in 0..PAIRS / 2 {
            rows[i] = (a[i], c[i]);
            rows[PAIRS / 2 + i] = (b[i], d[i]);
        }
        rows
    }
    #[inline(always)]
    unsafe fn double(self, p: *const f32) -> [Self::V; 2] {
        // SAFETY: the caller's promise.
        unsafe {
            let own = _mm256_setr_epi32(1, 1, 2, 2, 3, 3, 4, 4);
            let near = _mm256_setr_epi32(0, 2, 1, 3, 2, 4, 3, 5);
            let (low, high) = (_mm256_loadu_ps(p), _mm256_loadu_ps(p.add(HALF / 2)));
            [
                (_mm256_permutevar8x32_ps(low, own), _mm256_permutevar8x32_ps(high, own)),
                (_mm256_permutevar8x32_ps(low, near), _mm256_permutevar8x32_ps(high, near)),
            ]
        }
    }
    #[inline(always)]
    fn exp(self, x: Self::V) -> Self::V {
        // SAFETY: the token's promise.
        unsafe { (exp_eight(x.0), exp_eight(x.1)) }
    }
    #[inline(always)]
    fn bytes(self, v: Self::V) -> [u8; LANES] {
        // SAFETY: the token's promise; both are 16 bytes. Values too large for whole numbers of 32 bits would
        // come out negative.
        unsafe {
            let most = _mm256_set1_ps(255.0);
            let low = _mm256_cvtps_epi32(_mm256_min_ps(v.0, most));
            let high = _mm256_cvtps_epi32(_mm256_min_ps(v.1, most));
            let words = _mm256_permute4x64_epi64::<IN_ORDER>(_mm256_packus_epi32(low, high));
            let (low, high) = (_mm256_castsi256_si128(words), _mm256_extracti128_si256::<1>(words));
            std::mem::transmute(_mm_packus_epi16(low, high))
        }
    }
}

/// Lanes of an AVX2 register.
const HALF: usize = LANES / 2;

/// What [`_mm256_permute4x64_epi64`] takes to bring the quarters of two packed vectors back in order.
const IN_ORDER: i32 = 0xd8;

/// What [`_mm256_permute2f128_ps`] takes of two vectors: the lower 128 bits of both, or the upper.
const LOW: i32 = 0x20;
const HIGH: i32 = 0x31;

/// A mask for eight lanes, of which the first is lane `first`: all bits of those that come before lane `end`.
///
/// # Safety
/// The processor has AVX2.
#[inline(always)]
unsafe fn below(end: usize, first: usize) -> __m256i {
    // SAFETY: the caller's promise.
    unsafe {
        let lanes = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
        _mm256_cmpgt_epi32(_mm256_set1_epi32(end as i32 - first as i32), lanes)
    }
}

/// Eight lanes of [`Simd::read_some`] from lane `first` on.
///
/// # Safety
/// As that; the processor has AVX2.
#[inline(always)]
unsafe fn read_some_eight(p: *const f32, lanes: Range<usize>, first: usize, other: f32) -> __m256 {
    // SAFETY: the caller's promise; lanes that the mask leaves out are not read.
    unsafe {
        let mask = _mm256_andnot_si256(below(lanes.start, first), below(lanes.end, first));
        let read = _mm256_maskload_ps(p.wrapping_add(first), mask);
        _mm256_blendv_ps(_mm256_set1_ps(other), read, _mm256_castsi256_ps(mask))
    }
}

/// Lane `j` of vector `i` becomes lane `i` of vector `j`.
///
/// # Safety
/// The processor has AVX2.
#[inline(always)]
unsafe fn transpose_eight(mut r: [__m256; HALF]) -> [__m256; HALF] {
    // SAFETY: the caller's promise. 2x2, then 4x4 inside 128-bit lanes, then the lanes themselves.
    unsafe {
        let mut t = r;
        for i in 0..4 {
            t[2 * i] = _mm256_unpacklo_ps(r[2 * i], r[2 * i + 1]);
            t[2 * i + 1] = _mm256_unpackhi_ps(r[2 * i], r[2 * i + 1]);
        }
        for i in [0, 4] {
            [r[i], r[i + 1]] = unpack_pairs(t[i], t[i + 2]);
            [r[i + 2], r[i + 3]] = unpack_pairs(t[i + 1], t[i + 3]);
        }
        for i in 0..4 {
            t[i] = _mm256_permute2f128_ps::<LOW>(r[i], r[i + 4]);
            t[i + 4] = _mm256_permute2f128_ps::<HIGH>(r[i], r[i + 4]);
        }
        t
    }
}

/// Pair `j` of vector `i` becomes pair `i` of vector `j`.
///
/// # Safety
/// The processor has AVX2.
#[inline(always)]
unsafe fn transpose_four_pairs(r: [__m256; 4]) -> [__m256; 4] {
    // SAFETY: the caller's promise. 2x2 inside 128-bit lanes, then the lanes themselves.
    unsafe {
        let [a, b] = unpack_pairs(r[0], r[1]);
        let [c, d] = unpack_pairs(r[2], r[3]);
        [
            _mm256_permute2f128_ps::<LOW>(a, c),
            _mm256_permute2f128_ps::<LOW>(b, d),
            _mm256_permute2f128_ps::<HIGH>(a, c),
            _mm256_permute2f128_ps::<HIGH>(b, d),
        ]
    }
}

/// The first pairs of lanes of the 128-bit parts of two vectors, and the second pairs.
///
/// # Safety
/// The processor has AVX2.
#[inline(always)]
unsafe fn unpack_pairs(a: __m256, b: __m256) -> [__m256; 2] {
    // SAFETY: the caller's promise.
    unsafe {
        let (a, b) = (_mm256_castps_pd(a), _mm256_castps_pd(b));
        [_mm256_castpd_ps(_mm256_unpacklo_pd(a, b)), _mm256_castpd_ps(_mm256_unpackhi_pd(a, b))]
    }
}

/// [`Simd::exp`] of eight lanes.
///
/// # Safety
/// The processor has AVX2 and FMA.
#[inline(always)]
unsafe fn exp_eight(x: __m256) -> __m256 {
    // SAFETY: the caller's promise.
    unsafe {
        let limit = _mm256_set1_ps(LIMIT);
        // Where one operand is NaN, `max` and `min` return the second operand.
        let x = _mm256_max_ps(_mm256_sub_ps(_mm256_setzero_ps(), limit), x);
        let x = _mm256_min_ps(limit, x);
        let n = _mm256_mul_ps(x, _mm256_set1_ps(std::f32::consts::LOG2_E));
        let n = _mm256_round_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>(n);
        let r = _mm256_fnmadd_ps(n, _mm256_set1_ps(LN_2[0]), x);
        let r = _mm256_fnmadd_ps(n, _mm256_set1_ps(LN_2[1]), r);
        let mut p = _mm256_set1_ps(EXP[0]);
        for c in &EXP[1..] {
            p = _mm256_fmadd_ps(p, r, _mm256_set1_ps(*c));
        }
        let p = _mm256_fmadd_ps(_mm256_mul_ps(p, r), r, r);
        let power = _mm256_add_epi32(_mm256_cvtps_epi32(n), _mm256_set1_epi32(127));
        let power = _mm256_castsi256_ps(_mm256_slli_epi32::<23>(power));
        _mm256_mul_ps(_mm256_add_ps(p, _mm256_set1_ps(1.0)), power)
    }
}
