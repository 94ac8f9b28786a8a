//! One register of sixteen lanes: AVX-512.

use std::{arch::x86_64::*, ops::Range};

use super::{Block, Kernel, LANES, PAIRS, Simd};
use crate::kernels::exponential::{EXP, LIMIT, LN_2};

/// One register of sixteen lanes. Holding one proves that the processor has the instructions.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Avx512(());

/// Compiles a kernel for these instructions.
#[target_feature(enable = "avx512f,avx2,fma")]
fn compiled<K: Kernel>(lanes: Avx512, kernel: K) {
    kernel.run(lanes);
}

impl Simd for Avx512 {
    const NAME: &str = "Avx512";
    type V = __m512;
    // 2 planes x 14 pixels = 28 accumulators of 32 registers.
    const TILE: (usize, usize) = (2, 14);

    fn detect() -> Option<Self> {
        (is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx2")
            && is_x86_feature_detected!("fma"))
        .then_some(Self(()))
    }
    fn run<K: Kernel>(self, kernel: K) {
        // SAFETY: the token's promise.
        unsafe { compiled(self, kernel) }
    }

    #[inline(always)]
    fn splat(self, x: f32) -> Self::V {
        // SAFETY: the token's promise.
        unsafe { _mm512_set1_ps(x) }
    }
    #[inline(always)]
    unsafe fn load(self, p: *const Block) -> Self::V {
        // SAFETY: the caller's promise; a block is aligned to 64 bytes.
        unsafe { _mm512_load_ps(p.cast()) }
    }
    #[inline(always)]
    unsafe fn store(self, p: *mut Block, v: Self::V) {
        // SAFETY: the caller's promise; a block is aligned to 64 bytes.
        unsafe { _mm512_store_ps(p.cast(), v) }
    }
    #[inline(always)]
    unsafe fn read(self, p: *const f32) -> Self::V {
        // SAFETY: the caller's promise.
        unsafe { _mm512_loadu_ps(p) }
    }
    #[inline(always)]
    unsafe fn write(self, p: *mut f32, v: Self::V) {
        // SAFETY: the caller's promise.
        unsafe { _mm512_storeu_ps(p, v) }
    }
    #[inline(always)]
    unsafe fn read_some(self, p: *const f32, lanes: Range<usize>, other: f32) -> Self::V {
        let mask = first(lanes.end) & !first(lanes.start);
        // SAFETY: the caller's promise; lanes that the mask leaves out are not read.
        unsafe { _mm512_mask_loadu_ps(_mm512_set1_ps(other), mask, p) }
    }
    #[inline(always)]
    unsafe fn write_first(self, p: *mut f32, count: usize, v: Self::V) {
        // SAFETY: the caller's promise; lanes that the mask leaves out are not written.
        unsafe {
            if count == LANES {
                return self.write(p, v);
            }
            _mm512_mask_storeu_ps(p, first(count), v);
        }
    }
    #[inline(always)]
    fn fma(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        // SAFETY: the token's promise.
        unsafe { _mm512_fmadd_ps(a, b, c) }
    }
    #[inline(always)]
    fn mul(self, a: Self::V, b: Self::V) -> Self::V {
        // SAFETY: the token's promise.
        unsafe { _mm512_mul_ps(a, b) }
    }
    #[inline(always)]
    fn div(self, a: Self::V, b: Self::V) -> Self::V {
        // SAFETY: the token's promise.
        unsafe { _mm512_div_ps(a, b) }
    }
    #[inline(always)]
    fn add(self, a: Self::V, b: Self::V) -> Self::V {
        // SAFETY: the token's promise.
        unsafe { _mm512_add_ps(a, b) }
    }
    #[inline(always)]
    fn transpose(self, mut r: [Self::V; LANES]) -> [Self::V; LANES] {
        // SAFETY: the token's promise. 2x2, then 4x4 inside 128-bit lanes, then the lanes themselves.
        unsafe {
            let pd = |v| _mm512_castps_pd(v);
            let ps = |v| _mm512_castpd_ps(v);
            let mut t = r;
            for i in 0..8 {
                t[2 * i] = _mm512_unpacklo_ps(r[2 * i], r[2 * i + 1]);
                t[2 * i + 1] = _mm512_unpackhi_ps(r[2 * i], r[2 * i + 1]);
            }
            for i in (0..16).step_by(4) {
                r[i] = ps(_mm512_unpacklo_pd(pd(t[i]), pd(t[i + 2])));
                r[i + 1] = ps(_mm512_unpackhi_pd(pd(t[i]), pd(t[i + 2])));
                r[i + 2] = ps(_mm512_unpacklo_pd(pd(t[i + 1]), pd(t[i + 3])));
                r[i + 3] = ps(_mm512_unpackhi_pd(pd(t[i + 1]), pd(t[i + 3])));
            }
            for j in 0..4 {
                t[j] = _mm512_shuffle_f32x4::<EVEN>(r[j], r[4 + j]);
                t[4 + j] = _mm512_shuffle_f32x4::<ODD>(r[j], r[4 + j]);
                t[8 + j] = _mm512_shuffle_f32x4::<EVEN>(r[8 + j], r[12 + j]);
                t[12 + j] = _mm512_shuffle_f32x4::<ODD>(r[8 + j], r[12 + j]);
            }
            for j in 0..4 {
                r[j] = _mm512_shuffle_f32x4::<EVEN>(t[j], t[8 + j]);
                r[8 + j] = _mm512_shuffle_f32x4::<ODD>(t[j], t[8 + j]);
                r[4 + j] = _mm512_shuffle_f32x4::<EVEN>(t[4 + j], t[12 + j]);
                r[12 + j] = _mm512_shuffle_f32x4::<ODD>(t[4 + j], t[12 + j]);
            }
        }
        r
    }
    #[inline(always)]
    fn transpose_pairs(self, mut r: [Self::V; PAIRS]) -> [Self::V; PAIRS] {
        // SAFETY: the token's promise. 2x2 inside 128-bit lanes, then the lanes themselves.
        unsafe {
            let mut t = r;
            for i in 0..4 {
                let (a, b) = (_mm512_castps_pd(r[2 * i]), _mm512_castps_pd(r[2 * i + 1]));
                t[i] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, b));
                t[4 + i] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, b));
            }
            for i in 0..4 {
                r[i] = _mm512_shuffle_f32x4::<EVEN>(t[2 * i], t[2 * i + 1]);
                r[4 + i] = _mm512_shuffle_f32x4::<ODD>(t[2 * i], t[2 * i + 1]);
            }
            for odd in 0..2 {
                let [a, b, c, d] = [r[2 * odd], r[2 * odd + 1], r[2 * odd + 4], r[2 * odd + 5]];
                t[odd] = _mm512_shuffle_f32x4::<EVEN>(a, b);
                t[odd + 2] = _mm512_shuffle_f32x4::<EVEN>(c, d);
                t[odd + 4] = _mm512_shuffle_f32x4::<ODD>(a, b);
                t[odd + 6] = _mm512_shuffle_f32x4::<ODD>(c, d);
            }
            t
        }
    }
    #[inline(always)]
    unsafe fn double(self, p: *const f32) -> [Self::V; 2] {
        // SAFETY: the caller's promise.
        unsafe {
            let line = _mm512_loadu_ps(p);
            let own = _mm512_setr_epi32(1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7, 8, 8);
            let near = _mm512_setr_epi32(0, 2, 1, 3, 2, 4, 3, 5, 4, 6, 5, 7, 6, 8, 7, 9);
            [_mm512_permutexvar_ps(own, line), _mm512_permutexvar_ps(near, line)]
        }
    }
    #[inline(always)]
    fn exp(self, x: Self::V) -> Self::V {
        // SAFETY: the token's promise.
        unsafe {
            let limit = _mm512_set1_ps(LIMIT);
            // Where one operand is NaN, `max` and `min` return the second operand.
            let x = _mm512_max_ps(_mm512_sub_ps(_mm512_setzero_ps(), limit), x);
            let x = _mm512_min_ps(limit, x);
            let log2_e = _mm512_set1_ps(std::f32::consts::LOG2_E);
            let n = _mm512_roundscale_ps::<0>(_mm512_mul_ps(x, log2_e));
            let r = _mm512_fnmadd_ps(n, _mm512_set1_ps(LN_2[0]), x);
            let r = _mm512_fnmadd_ps(n, _mm512_set1_ps(LN_2[1]), r);
            let mut p = _mm512_set1_ps(EXP[0]);
            for c in &EXP[1..] {
                p = _mm512_fmadd_ps(p, r, _mm512_set1_ps(*c));
            }
            let p = _mm512_fmadd_ps(_mm512_mul_ps(p, r), r, r);
            _mm512_scalef_ps(_mm512_add_ps(p, _mm512_set1_ps(1.0)), n)
        }
    }
    #[inline(always)]
    fn max(self, a: Self::V, b: Self::V) -> Self::V {
        // SAFETY: the token's promise.
        unsafe { _mm512_max_ps(a, b) }
    }
    #[inline(always)]
    fn bytes(self, v: Self::V) -> [u8; LANES] {
        // SAFETY: the token's promise; both are 16 bytes.
        unsafe { std::mem::transmute(_mm512_cvtusepi32_epi8(_mm512_cvtps_epi32(v))) }
    }
}

/// A mask of the first `count` lanes.
#[inline(always)]
const fn first(count: usize) -> __mmask16 {
    ((1u32 << count) - 1) as __mmask16
}

/// What [`_mm512_shuffle_f32x4`] takes of each of two vectors: its first and third 128 bits, or the others.
const EVEN: i32 = 0x88;
const ODD: i32 = 0xdd;
