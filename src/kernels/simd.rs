//! Sixteen f32 lanes on every processor: the vector type of the kernels and the choice of tier.
//!
//! A kernel implements [`Kernel`] once; [`Tier::run`] compiles it for the portable, AVX2+FMA and
//! AVX-512 lanes and calls the one asked for. A tier can only be had from [`Tier::detect`] or
//! [`Tier::available`], so holding one proves that the processor has its instructions.

use std::{fmt, ops::Range, sync::OnceLock};

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
    /// Reads 16 values that need not be aligned.
    ///
    /// # Safety
    /// `p` is valid for reads of 16 values.
    unsafe fn read(p: *const f32) -> Self::V;
    /// Writes 16 values that need not be aligned.
    ///
    /// # Safety
    /// `p` is valid for writes of 16 values.
    unsafe fn write(p: *mut f32, v: Self::V);
    /// As [`Simd::read`], but only some of the 16 values; the other lanes become `other`.
    ///
    /// # Safety
    /// `p` is valid for reads of the values `lanes`.
    #[inline(always)]
    unsafe fn read_some(p: *const f32, lanes: Range<usize>, other: f32) -> Self::V {
        let mut values = Block([other; LANES]);
        // SAFETY: the caller's promise; the block is the function's own.
        unsafe {
            if lanes == (0..LANES) {
                return Self::read(p);
            }
            for lane in lanes {
                values.0[lane] = *p.wrapping_add(lane);
            }
            Self::load(&values)
        }
    }
    /// Writes the first `count` values.
    ///
    /// # Safety
    /// `p` is valid for writes of as many values.
    #[inline(always)]
    unsafe fn write_first(p: *mut f32, count: usize, v: Self::V) {
        let mut values = Block::default();
        // SAFETY: the caller's promise; the block is the function's own.
        unsafe {
            if count == LANES {
                return Self::write(p, v);
            }
            Self::store(&mut values, v);
            values.0[..count].iter().enumerate().for_each(|(lane, value)| *p.add(lane) = *value);
        }
    }
    /// `a * b + c`, rounded once where the processor can.
    ///
    /// # Safety
    /// See [`Simd::splat`].
    unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// `a * b`.
    ///
    /// # Safety
    /// See [`Simd::splat`].
    unsafe fn mul(a: Self::V, b: Self::V) -> Self::V;
    /// `a / b`.
    ///
    /// # Safety
    /// See [`Simd::splat`].
    unsafe fn div(a: Self::V, b: Self::V) -> Self::V;
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
        // SAFETY: the caller's promise.
        unsafe { exchange::<Self, LANES>(rows) }
    }
    /// Pair `j` of neighbouring lanes of vector `i` becomes pair `i` of vector `j`.
    ///
    /// # Safety
    /// See [`Simd::splat`].
    #[inline(always)]
    unsafe fn transpose_pairs(rows: [Self::V; PAIRS]) -> [Self::V; PAIRS] {
        // SAFETY: the caller's promise.
        unsafe { exchange::<Self, PAIRS>(rows) }
    }
    /// Doubles a line of which `p` is one value before the first: each value twice, and the value on the other side of
    /// each of the two halves of it. From `a b c d ..`: `b b c c ..` and `a c b d ..`.
    ///
    /// # Safety
    /// `p` is valid for reads of 16 values; ten count.
    #[inline(always)]
    unsafe fn double(p: *const f32) -> [Self::V; 2] {
        let (mut own, mut near) = (Block::default(), Block::default());
        // SAFETY: the caller's promise; the blocks are the function's own.
        unsafe {
            for i in 0..PAIRS {
                own.0[2 * i..2 * i + 2].fill(*p.add(i + 1));
                (near.0[2 * i], near.0[2 * i + 1]) = (*p.add(i), *p.add(i + 2));
            }
            [Self::load(&own), Self::load(&near)]
        }
    }
    /// `e^x` to 2e-7 relative within +-40, and as at that limit beyond; NaN of NaN. See [`exp`](super::exponential::exp).
    ///
    /// # Safety
    /// See [`Simd::splat`].
    #[inline(always)]
    unsafe fn exp(x: Self::V) -> Self::V {
        let mut values = Block::default();
        // SAFETY: the block is the function's own.
        unsafe {
            Self::store(&mut values, x);
            values.0 = values.0.map(super::exponential::exp);
            Self::load(&values)
        }
    }
    /// Lane-wise maximum; 0 where `a` is NaN and `b` is 0.
    ///
    /// # Safety
    /// See [`Simd::splat`].
    unsafe fn max(a: Self::V, b: Self::V) -> Self::V;
    /// Rounds values, none negative, to the nearest whole number that a byte holds.
    ///
    /// # Safety
    /// See [`Simd::splat`].
    #[inline(always)]
    unsafe fn bytes(v: Self::V) -> [u8; LANES] {
        let mut values = Block::default();
        // SAFETY: the block is the function's own.
        unsafe { Self::store(&mut values, v) }
        values.0.map(|v| v.round_ties_even() as u8)
    }
}

/// Pairs of lanes.
pub const PAIRS: usize = LANES / 2;

/// Of `N` groups of neighbouring lanes, group `j` of vector `i` becomes group `i` of vector `j`.
///
/// # Safety
/// The processor has the instructions of `S`.
#[inline(always)]
unsafe fn exchange<S: Simd, const N: usize>(rows: [S::V; N]) -> [S::V; N] {
    let group = LANES / N;
    let (mut from, mut to) = ([Block::default(); N], [Block::default(); N]);
    // SAFETY: the blocks are the function's own.
    unsafe {
        for (row, block) in rows.iter().zip(&mut from) {
            S::store(block, *row);
        }
        for i in 0..N {
            for j in 0..N {
                for lane in 0..group {
                    to[j].0[group * i + lane] = from[i].0[group * j + lane];
                }
            }
        }
        std::array::from_fn(|j| S::load(&to[j]))
    }
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
    ///
    /// # Panics
    /// If the variable names none that this processor has.
    pub fn detect() -> Tier {
        static CHOICE: OnceLock<Tier> = OnceLock::new();
        *CHOICE.get_or_init(|| {
            let wanted = std::env::var("DEMC_TIER").unwrap_or_default();
            choose("DEMC_TIER", &wanted, &Tier::available())
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

/// The one of `choices` that an environment variable names, or the last where it names nothing.
///
/// # Panics
/// If it names another.
pub(super) fn choose<T: Copy + fmt::Debug>(variable: &str, wanted: &str, choices: &[T]) -> T {
    if let Some(names) = unknown_choice(wanted, choices) {
        panic!("{variable} is \"{wanted}\"; this processor has {names}");
    }
    let named = choices.iter().find(|choice| name_of(choice) == wanted.to_lowercase());
    *named.unwrap_or(&choices[choices.len() - 1])
}

/// The names of `choices`, where an environment variable names another.
pub fn unknown_choice<T: fmt::Debug>(wanted: &str, choices: &[T]) -> Option<String> {
    let names: Vec<String> = choices.iter().map(name_of).collect();
    let is_known = wanted.is_empty() || names.contains(&wanted.to_lowercase());
    (!is_known).then(|| names.join(", "))
}

fn name_of(choice: &impl fmt::Debug) -> String {
    format!("{choice:?}").to_lowercase()
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
    unsafe fn read(p: *const f32) -> Self::V {
        // SAFETY: the caller's promise; an array is aligned as its values are.
        unsafe { *p.cast() }
    }
    #[inline(always)]
    unsafe fn write(p: *mut f32, v: Self::V) {
        // SAFETY: as above.
        unsafe { *p.cast() = v }
    }
    #[inline(always)]
    unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        std::array::from_fn(|i| a[i] * b[i] + c[i])
    }
    #[inline(always)]
    unsafe fn mul(a: Self::V, b: Self::V) -> Self::V {
        std::array::from_fn(|i| a[i] * b[i])
    }
    #[inline(always)]
    unsafe fn div(a: Self::V, b: Self::V) -> Self::V {
        std::array::from_fn(|i| a[i] / b[i])
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
    use std::{arch::x86_64::*, ops::Range};

    use super::{Block, Kernel, LANES, PAIRS, Simd};
    use crate::kernels::exponential::{EXP, LIMIT, LN_2};

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
        unsafe fn read(p: *const f32) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { (_mm256_loadu_ps(p), _mm256_loadu_ps(p.add(8))) }
        }
        #[inline(always)]
        unsafe fn write(p: *mut f32, v: Self::V) {
            // SAFETY: the caller's promise.
            unsafe {
                _mm256_storeu_ps(p, v.0);
                _mm256_storeu_ps(p.add(8), v.1);
            }
        }
        #[inline(always)]
        unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { (_mm256_fmadd_ps(a.0, b.0, c.0), _mm256_fmadd_ps(a.1, b.1, c.1)) }
        }
        #[inline(always)]
        unsafe fn mul(a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { (_mm256_mul_ps(a.0, b.0), _mm256_mul_ps(a.1, b.1)) }
        }
        #[inline(always)]
        unsafe fn div(a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { (_mm256_div_ps(a.0, b.0), _mm256_div_ps(a.1, b.1)) }
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
        #[inline(always)]
        unsafe fn read_some(p: *const f32, lanes: Range<usize>, other: f32) -> Self::V {
            // SAFETY: the caller's promise; lanes that a mask leaves out are not read.
            unsafe {
                if lanes == (0..LANES) {
                    return Self::read(p);
                }
                (read_some_eight(p, lanes.clone(), 0, other), read_some_eight(p, lanes, HALF, other))
            }
        }
        #[inline(always)]
        unsafe fn write_first(p: *mut f32, count: usize, v: Self::V) {
            // Masked stores are microcode on AMD's processors. What is left of the lanes moves to the front.
            // SAFETY: the caller's promise; `count` values are written, in parts.
            unsafe {
                if count == LANES {
                    return Self::write(p, v);
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
        unsafe fn transpose(mut rows: [Self::V; LANES]) -> [Self::V; LANES] {
            let mut quarters = [[[rows[0].0; HALF]; 2]; 2];
            for i in 0..LANES {
                quarters[i / HALF][0][i % HALF] = rows[i].0;
                quarters[i / HALF][1][i % HALF] = rows[i].1;
            }
            // SAFETY: the caller's promise.
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
        unsafe fn transpose_pairs(mut rows: [Self::V; PAIRS]) -> [Self::V; PAIRS] {
            let mut quarters = [[[rows[0].0; PAIRS / 2]; 2]; 2];
            for i in 0..PAIRS {
                quarters[2 * i / PAIRS][0][i % (PAIRS / 2)] = rows[i].0;
                quarters[2 * i / PAIRS][1][i % (PAIRS / 2)] = rows[i].1;
            }
            // SAFETY: the caller's promise.
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
        unsafe fn double(p: *const f32) -> [Self::V; 2] {
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
        unsafe fn exp(x: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { (exp_eight(x.0), exp_eight(x.1)) }
        }
        #[inline(always)]
        unsafe fn bytes(v: Self::V) -> [u8; LANES] {
            // SAFETY: the caller's promise; both are 16 bytes. What no whole number of 32 bits holds would come out negative.
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

    /// All bits of those of eight lanes, the first of them lane `first`, that come before lane `end`.
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

    /// The first pairs of 128-bit lanes of two vectors, and the second.
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
            // Of a NaN and a number, both return the second.
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
        unsafe fn read(p: *const f32) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { _mm512_loadu_ps(p) }
        }
        #[inline(always)]
        unsafe fn write(p: *mut f32, v: Self::V) {
            // SAFETY: the caller's promise.
            unsafe { _mm512_storeu_ps(p, v) }
        }
        #[inline(always)]
        unsafe fn read_some(p: *const f32, lanes: Range<usize>, other: f32) -> Self::V {
            let mask = first(lanes.end) & !first(lanes.start);
            // SAFETY: the caller's promise; lanes that the mask leaves out are not read.
            unsafe { _mm512_mask_loadu_ps(_mm512_set1_ps(other), mask, p) }
        }
        #[inline(always)]
        unsafe fn write_first(p: *mut f32, count: usize, v: Self::V) {
            // SAFETY: the caller's promise; lanes that the mask leaves out are not written.
            unsafe {
                if count == LANES {
                    return Self::write(p, v);
                }
                _mm512_mask_storeu_ps(p, first(count), v);
            }
        }
        #[inline(always)]
        unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { _mm512_fmadd_ps(a, b, c) }
        }
        #[inline(always)]
        unsafe fn mul(a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { _mm512_mul_ps(a, b) }
        }
        #[inline(always)]
        unsafe fn div(a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { _mm512_div_ps(a, b) }
        }
        #[inline(always)]
        unsafe fn add(a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { _mm512_add_ps(a, b) }
        }
        #[inline(always)]
        unsafe fn transpose(mut r: [Self::V; LANES]) -> [Self::V; LANES] {
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
        unsafe fn transpose_pairs(mut r: [Self::V; PAIRS]) -> [Self::V; PAIRS] {
            // SAFETY: the caller's promise. 2x2 inside 128-bit lanes, then the lanes themselves.
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
        unsafe fn double(p: *const f32) -> [Self::V; 2] {
            // SAFETY: the caller's promise.
            unsafe {
                let line = _mm512_loadu_ps(p);
                let own = _mm512_setr_epi32(1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7, 8, 8);
                let near = _mm512_setr_epi32(0, 2, 1, 3, 2, 4, 3, 5, 4, 6, 5, 7, 6, 8, 7, 9);
                [_mm512_permutexvar_ps(own, line), _mm512_permutexvar_ps(near, line)]
            }
        }
        #[inline(always)]
        unsafe fn exp(x: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe {
                let limit = _mm512_set1_ps(LIMIT);
                // Of a NaN and a number, both return the second.
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
        unsafe fn max(a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: the caller's promise.
            unsafe { _mm512_max_ps(a, b) }
        }
        #[inline(always)]
        unsafe fn bytes(v: Self::V) -> [u8; LANES] {
            // SAFETY: the caller's promise; both are 16 bytes.
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
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What [`Simd`]'s functions make of 24 values.
    struct Everything<'a> {
        values: &'a [f32; LANES + PAIRS],
        results: &'a mut Vec<Vec<f32>>,
    }

    impl Kernel for Everything<'_> {
        #[inline(always)]
        unsafe fn run<S: Simd>(self) {
            let p = self.values.as_ptr();
            let mut put = |v: S::V| {
                let mut out = vec![0.0; LANES];
                // SAFETY: there are as many values; vectors are the tier's.
                unsafe { S::write(out.as_mut_ptr(), v) };
                self.results.push(out);
            };
            // SAFETY: vectors are the tier's; values 0 to 23 are read.
            unsafe {
                let (a, b) = (S::read(p), S::read(p.add(PAIRS)));
                put(S::fma(a, b, S::splat(0.5)));
                put(S::mul(a, b));
                put(S::div(a, b));
                put(S::add(a, b));
                put(S::max(a, b));
                put(S::exp(a));
                for (first, end) in (0..=LANES).map(|end| (end / 3, end)) {
                    put(S::read_some(p, first..end, -7.0));
                    let mut out = vec![9.0; LANES];
                    S::write_first(out.as_mut_ptr(), end, a);
                    put(S::read(out.as_ptr()));
                }
                put(S::read_some(p.wrapping_sub(5), 5..7, -7.0));
                S::double(p).into_iter().for_each(&mut put);
                let rows: [S::V; LANES] = std::array::from_fn(|i| S::add(a, S::splat(i as f32)));
                S::transpose(rows).into_iter().for_each(&mut put);
                let rows: [S::V; PAIRS] = std::array::from_fn(|i| rows[i]);
                S::transpose_pairs(rows).into_iter().for_each(&mut put);
                let bytes = S::bytes(S::mul(S::max(a, S::splat(0.0)), S::splat(100.0)));
                self.results.push(bytes.map(f32::from).to_vec());
            }
        }
    }

    #[test]
    fn every_tier_does_what_plain_arrays_do() {
        let values: [f32; LANES + PAIRS] = std::array::from_fn(|i| ((i * 7919) as f32).sin() * 3.0);
        let of = |tier: Tier| {
            let mut results = Vec::new();
            tier.run(Everything { values: &values, results: &mut results });
            results
        };
        let want = of(Tier::PORTABLE);
        for tier in Tier::available() {
            for (i, (got, want)) in of(tier).iter().zip(&want).enumerate() {
                let near = |(a, b): (&f32, &f32)| (a - b).abs() <= 4e-7 * b.abs();
                assert!(got.iter().zip(want).all(near), "{tier:?}, result {i}: {got:?} for {want:?}");
            }
        }
    }

    #[test]
    fn a_variable_chooses_the_tier() {
        let tiers = [Tier::PORTABLE, Tier::detect()];
        assert_eq!(choose("DEMC_TIER", "Portable", &tiers), tiers[0]);
        assert_eq!(choose("DEMC_TIER", "", &tiers), tiers[1]);
    }

    #[test]
    #[should_panic = "DEMC_TIER is \"avx1024\"; this processor has portable"]
    fn an_unknown_tier_is_an_error() {
        choose("DEMC_TIER", "avx1024", &Tier::available());
    }

    /// Beyond the limit it stays as it is there; what is no number stays none, so that it is seen.
    #[test]
    fn exponentials_end_at_the_limit() {
        struct Exponentials<'a>(&'a mut [f32; LANES]);
        impl Kernel for Exponentials<'_> {
            #[inline(always)]
            unsafe fn run<S: Simd>(self) {
                // SAFETY: vectors are the tier's, sixteen values are read and written.
                unsafe { S::write(self.0.as_mut_ptr(), S::exp(S::read(self.0.as_ptr()))) }
            }
        }
        let mut values = [0.0; LANES];
        values[..9].copy_from_slice(&[39.0, -39.0, 41.0, -41.0, f32::MAX, f32::INFINITY, 40.0, -40.0, 1.0]);
        (values[9], values[10]) = (f32::NEG_INFINITY, f32::NAN);
        for tier in Tier::available() {
            let mut found = values;
            tier.run(Exponentials(&mut found));
            for (found, value) in found.into_iter().zip(values) {
                let want = f64::from(value).clamp(-40.0, 40.0).exp();
                let near = (f64::from(found) - want).abs() <= 4e-7 * want;
                assert!(near || value.is_nan() && found.is_nan(), "{tier:?}: {found} for {value}");
            }
        }
    }

    #[test]
    fn pairs_change_places_and_lines_double() {
        struct Moves<'a>(&'a mut [Vec<f32>; 4]);
        impl Kernel for Moves<'_> {
            #[inline(always)]
            unsafe fn run<S: Simd>(self) {
                let line: [f32; LANES] = std::array::from_fn(|i| i as f32);
                // SAFETY: vectors are the tier's, sixteen values are read and written.
                unsafe {
                    let row = S::read(line.as_ptr());
                    let rows = std::array::from_fn(|i| S::add(row, S::splat(100.0 * i as f32)));
                    let [own, near] = S::double(line.as_ptr());
                    let pairs = S::transpose_pairs(rows);
                    for (out, v) in self.0.iter_mut().zip([own, near, pairs[0], pairs[5]]) {
                        out.resize(LANES, 0.0);
                        S::write(out.as_mut_ptr(), v);
                    }
                }
            }
        }
        for tier in Tier::available() {
            let mut moved: [Vec<f32>; 4] = Default::default();
            tier.run(Moves(&mut moved));
            let want: [fn(usize) -> usize; 4] = [
                |i| i / 2 + 1,
                |i| i / 2 + 2 * (i % 2),
                |i| 100 * (i / 2) + i % 2,
                |i| 100 * (i / 2) + 10 + i % 2,
            ];
            for (moved, want) in moved.iter().zip(want) {
                assert_eq!(*moved, (0..LANES).map(|i| want(i) as f32).collect::<Vec<_>>(), "{tier:?}");
            }
        }
    }
}
