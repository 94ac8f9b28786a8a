//! Sixteen f32 lanes on every processor: the vector type of the kernels and the choice of tier.
//!
//! A kernel implements [`Kernel`] once; [`Tier::run`] compiles it for the portable, AVX2+FMA and
//! AVX-512 lanes and calls the one asked for. A tier can only be had from [`Tier::detect`] or
//! [`Tier::available`], so holding one proves that the processor has its instructions.

use std::{fmt, sync::OnceLock};

use super::{Block, LANES};

/// Sixteen f32 lanes.
pub trait Simd: Copy {
    /// The lanes.
    type V: Copy;
    /// How many output planes and pixels a convolution tile keeps in registers.
    const TILE: (usize, usize);

    /// All lanes `x`.
    ///
    /// # Safety
    /// Here and below: the processor has the instructions of the implementing type.
    unsafe fn splat(x: f32) -> Self::V;
    /// Reads one block.
    ///
    /// # Safety
    /// `p` is valid for reads of a block.
    unsafe fn load(p: *const Block) -> Self::V;
    /// Writes one block.
    ///
    /// # Safety
    /// `p` is valid for writes of a block.
    unsafe fn store(p: *mut Block, v: Self::V);
    /// `a * b + c`, rounded once where the processor can.
    ///
    /// # Safety
    /// See [`Simd::splat`].
    unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// `a + b`.
    ///
    /// # Safety
    /// See [`Simd::splat`].
    unsafe fn add(a: Self::V, b: Self::V) -> Self::V;
    /// Lane `j` of vector `i` becomes lane `i` of vector `j`.
    ///
    /// # Safety
    /// See [`Simd::splat`].
    #[inline(always)]
    unsafe fn transpose(rows: [Self::V; LANES]) -> [Self::V; LANES] {
        let mut from = [Block::default(); LANES];
        let mut to = [Block::default(); LANES];
        // SAFETY: the blocks are the function's own.
        unsafe {
            for (row, block) in rows.iter().zip(&mut from) {
                Self::store(block, *row);
            }
            for i in 0..LANES {
                for j in 0..LANES {
                    to[j].0[i] = from[i].0[j];
                }
            }
            std::array::from_fn(|j| Self::load(&to[j]))
        }
    }
    /// Lane-wise maximum; 0 where `a` is NaN and `b` is 0.
    ///
    /// # Safety
    /// See [`Simd::splat`].
    unsafe fn max(a: Self::V, b: Self::V) -> Self::V;
}

/// A computation to be compiled for every tier.
pub trait Kernel {
    /// Runs it on the lanes `S`; implementations are `#[inline(always)]`.
    ///
    /// # Safety
    /// The processor has the instructions of `S`.
    unsafe fn run<S: Simd>(self);
}

/// A set of instructions that this processor has.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Tier(Isa);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Isa {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl fmt::Debug for Tier {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl Tier {
    /// The reference implementation, on any processor.
    pub const PORTABLE: Tier = Tier(Isa::Portable);

    /// Every tier this processor can run, slowest first.
    pub fn available() -> Vec<Tier> {
        #[allow(unused_mut)]
        let mut tiers = vec![Tier::PORTABLE];
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                tiers.push(Tier(Isa::Avx2));
            }
            if is_x86_feature_detected!("avx512f") {
                tiers.push(Tier(Isa::Avx512));
            }
        }
        tiers
    }

    /// The fastest tier, found once. The environment variable `DEMC_TIER` (`portable`, `avx2`,
    /// `avx512`) chooses a slower one, to compare them.
    pub fn detect() -> Tier {
        static CHOICE: OnceLock<Tier> = OnceLock::new();
        *CHOICE.get_or_init(|| {
            let tiers = Tier::available();
            let wanted = std::env::var("DEMC_TIER").unwrap_or_default().to_lowercase();
            let named = tiers.iter().find(|t| format!("{t:?}").to_lowercase() == wanted);
            *named.or(tiers.last()).expect("the portable tier is always available")
        })
    }

    /// Runs `kernel` with this tier's instructions.
    pub fn run<K: Kernel>(self, kernel: K) {
        match self.0 {
            // SAFETY: the portable lanes need nothing of the processor.
            Isa::Portable => unsafe { kernel.run::<Portable>() },
            // SAFETY: a tier is only made after its instructions were detected.
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => unsafe { x86::run_avx2(kernel) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => unsafe { x86::run_avx512(kernel) },
        }
    }
}

/// Plain arrays: the oracle of the other tiers.
#[derive(Clone, Copy)]
pub struct Portable;

impl Simd for Portable {
    type V = [f32; LANES];
    const TILE: (usize, usize) = (1, 4);

    #[inline(always)]
    unsafe fn splat(x: f32) -> Self::V {
        [x; LANES]
    }
    #[inline(always)]
    unsafe fn load(p: *const Block) -> Self::V {
        // SAFETY: the caller's promise.
        unsafe { (*p).0 }
    }
    #[inline(always)]
    unsafe fn store(p: *mut Block, v: Self::V) {
        // SAFETY: the caller's promise.
        unsafe { (*p).0 = v }
    }
    #[inline(always)]
    unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        std::array::from_fn(|i| a[i] * b[i] + c[i])
    }
    #[inline(always)]
    unsafe fn add(a: Self::V, b: Self::V) -> Self::V {
        std::array::from_fn(|i| a[i] + b[i])
    }
    #[inline(always)]
    unsafe fn max(a: Self::V, b: Self::V) -> Self::V {
        std::array::from_fn(|i| if a[i] > b[i] { a[i] } else { b[i] })
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) use x86::Avx512;

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::{Block, Kernel, LANES, Simd};

    /// # Safety
    /// The processor has AVX2 and FMA.
    #[target_feature(enable = "avx2,fma")]
    pub unsafe fn run_avx2<K: Kernel>(kernel: K) {
        // SAFETY: the caller's promise.
        unsafe { kernel.run::<Avx2>() }
    }

    /// # Safety
    /// The processor has AVX-512F.
    #[target_feature(enable = "avx512f,avx2,fma")]
    pub unsafe fn run_avx512<K: Kernel>(kernel: K) {
        // SAFETY: the caller's promise.
        unsafe { kernel.run::<Avx512>() }
    }

    /// Two registers of eight lanes.
    #[derive(Clone, Copy)]
    pub struct Avx2;

    impl Simd for Avx2 {
        type V = (__m256, __m256);
        // 2 registers a block x 6 pixels = 12 accumulators of 16 registers.
        const TILE: (usize, usize) = (1, 6);

        #[inline(always)]
        unsafe fn splat(x: f32) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { (_mm256_set1_ps(x), _mm256_set1_ps(x)) }
        }
        #[inline(always)]
        unsafe fn load(p: *const Block) -> Self::V {
            let p = p.cast::<f32>();
            // SAFETY: the caller's promise; a block is aligned to 64 bytes.
            unsafe { (_mm256_load_ps(p), _mm256_load_ps(p.add(8))) }
        }
        #[inline(always)]
        unsafe fn store(p: *mut Block, v: Self::V) {
            let p = p.cast::<f32>();
            // SAFETY: the caller's promise; a block is aligned to 64 bytes.
            unsafe {
                _mm256_store_ps(p, v.0);
                _mm256_store_ps(p.add(8), v.1);
            }
        }
        #[inline(always)]
        unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { (_mm256_fmadd_ps(a.0, b.0, c.0), _mm256_fmadd_ps(a.1, b.1, c.1)) }
        }
        #[inline(always)]
        unsafe fn add(a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { (_mm256_add_ps(a.0, b.0), _mm256_add_ps(a.1, b.1)) }
        }
        #[inline(always)]
        unsafe fn max(a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { (_mm256_max_ps(a.0, b.0), _mm256_max_ps(a.1, b.1)) }
        }
    }

    /// One register of sixteen lanes.
    #[derive(Clone, Copy)]
    pub struct Avx512;

    impl Simd for Avx512 {
        type V = __m512;
        // 2 planes x 14 pixels = 28 accumulators of 32 registers.
        const TILE: (usize, usize) = (2, 14);

        #[inline(always)]
        unsafe fn splat(x: f32) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { _mm512_set1_ps(x) }
        }
        #[inline(always)]
        unsafe fn load(p: *const Block) -> Self::V {
            // SAFETY: the caller's promise; a block is aligned to 64 bytes.
            unsafe { _mm512_load_ps(p.cast()) }
        }
        #[inline(always)]
        unsafe fn store(p: *mut Block, v: Self::V) {
            // SAFETY: the caller's promise; a block is aligned to 64 bytes.
            unsafe { _mm512_store_ps(p.cast(), v) }
        }
        #[inline(always)]
        unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { _mm512_fmadd_ps(a, b, c) }
        }
        #[inline(always)]
        unsafe fn add(a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { _mm512_add_ps(a, b) }
        }
        #[inline(always)]
        unsafe fn transpose(mut r: [Self::V; LANES]) -> [Self::V; LANES] {
            const EVEN: i32 = 0x88;
            const ODD: i32 = 0xdd;
            // SAFETY: the caller's promise. 2x2, then 4x4 inside 128-bit lanes, then the lanes themselves.
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
        unsafe fn max(a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { _mm512_max_ps(a, b) }
        }
    }
}
