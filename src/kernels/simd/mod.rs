//! Sixteen f32 lanes on every processor: the vector type of the kernels and the choice of tier.
//!
//! A kernel implements [`Kernel`] once; [`Tier::run`] compiles it for the portable, AVX2+FMA and
//! AVX-512 lanes and calls the one asked for. Each has a file here. Lanes can only be had from what was
//! detected, so holding them proves that the processor has their instructions, and arithmetic on them is
//! safe; reading and writing memory is not.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod portable;

use std::{fmt, ops::Range, sync::OnceLock};

use super::{Block, LANES};

#[cfg(target_arch = "x86_64")]
use avx2::Avx2;
#[cfg(target_arch = "x86_64")]
pub(super) use avx512::Avx512;
use portable::Portable;

/// Sixteen f32 lanes. A value proves that the processor has the instructions: only [`Simd::detect`] makes
/// one.
pub trait Simd: Copy {
    /// Its name in the environment variable `DEMC_TIER`, in which capitals do not matter.
    const NAME: &str;
    /// The lanes.
    type V: Copy;
    /// How many output planes and pixels a convolution tile keeps in registers.
    const TILE: (usize, usize);

    /// The lanes, if this processor has their instructions.
    fn detect() -> Option<Self>;
    /// Runs `kernel`, compiled for these instructions.
    fn run<K: Kernel>(self, kernel: K);

    /// All lanes `x`.
    fn splat(self, x: f32) -> Self::V;
    /// Reads one block.
    ///
    /// # Safety
    /// `p` is valid for reads of a block.
    unsafe fn load(self, p: *const Block) -> Self::V;
    /// Writes one block.
    ///
    /// # Safety
    /// `p` is valid for writes of a block.
    unsafe fn store(self, p: *mut Block, v: Self::V);
    /// A block's lanes.
    #[inline(always)]
    fn get(self, block: &Block) -> Self::V {
        // SAFETY: a reference is valid.
        unsafe { self.load(block) }
    }
    /// Sets a block's lanes.
    #[inline(always)]
    fn set(self, block: &mut Block, v: Self::V) {
        // SAFETY: as above.
        unsafe { self.store(block, v) }
    }
    /// Reads 16 values that need not be aligned.
    ///
    /// # Safety
    /// `p` is valid for reads of 16 values.
    unsafe fn read(self, p: *const f32) -> Self::V;
    /// Writes 16 values that need not be aligned.
    ///
    /// # Safety
    /// `p` is valid for writes of 16 values.
    unsafe fn write(self, p: *mut f32, v: Self::V);
    /// As [`Simd::read`], but only some of the 16 values; the other lanes become `other`.
    ///
    /// # Safety
    /// `p` is valid for reads of the values `lanes`.
    #[inline(always)]
    unsafe fn read_some(self, p: *const f32, lanes: Range<usize>, other: f32) -> Self::V {
        let mut values = Block([other; LANES]);
        // SAFETY: the caller's promise; the block is the function's own.
        unsafe {
            if lanes == (0..LANES) {
                return self.read(p);
            }
            for lane in lanes {
                values.0[lane] = *p.wrapping_add(lane);
            }
            self.load(&values)
        }
    }
    /// Writes the first `count` values.
    ///
    /// # Safety
    /// `p` is valid for writes of as many values.
    #[inline(always)]
    unsafe fn write_first(self, p: *mut f32, count: usize, v: Self::V) {
        let mut values = Block::default();
        // SAFETY: the caller's promise; the block is the function's own.
        unsafe {
            if count == LANES {
                return self.write(p, v);
            }
            self.store(&mut values, v);
            values.0[..count].iter().enumerate().for_each(|(lane, value)| *p.add(lane) = *value);
        }
    }
    /// `a * b + c`, rounded once where the processor can.
    fn fma(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// `a * b`.
    fn mul(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a / b`.
    fn div(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a + b`.
    fn add(self, a: Self::V, b: Self::V) -> Self::V;
    /// Lane `j` of vector `i` becomes lane `i` of vector `j`.
    #[inline(always)]
    fn transpose(self, rows: [Self::V; LANES]) -> [Self::V; LANES] {
        exchange(self, rows)
    }
    /// Pair `j` of neighbouring lanes of vector `i` becomes pair `i` of vector `j`.
    #[inline(always)]
    fn transpose_pairs(self, rows: [Self::V; PAIRS]) -> [Self::V; PAIRS] {
        exchange(self, rows)
    }
    /// Doubles the line of values that begins one value after `p`. The first vector holds each value twice,
    /// and the second the neighbour on the left, then the one on the right, of each. From `a b c d ..` come
    /// `b b c c ..` and `a c b d ..`.
    ///
    /// # Safety
    /// `p` is valid for reads of 16 values, of which ten are used.
    #[inline(always)]
    unsafe fn double(self, p: *const f32) -> [Self::V; 2] {
        let (mut own, mut near) = (Block::default(), Block::default());
        // SAFETY: the caller's promise; the blocks are the function's own.
        unsafe {
            for i in 0..PAIRS {
                own.0[2 * i..2 * i + 2].fill(*p.add(i + 1));
                (near.0[2 * i], near.0[2 * i + 1]) = (*p.add(i), *p.add(i + 2));
            }
            [self.load(&own), self.load(&near)]
        }
    }
    /// `e^x` to 2e-7 relative within +-40, and beyond these limits the value at the limit. NaN gives NaN. See
    /// [`exp`](super::exponential::exp).
    #[inline(always)]
    fn exp(self, x: Self::V) -> Self::V {
        let mut values = Block::default();
        // SAFETY: the block is the function's own.
        unsafe {
            self.store(&mut values, x);
            values.0 = values.0.map(super::exponential::exp);
            self.load(&values)
        }
    }
    /// Lane-wise maximum; 0 where `a` is NaN and `b` is 0.
    fn max(self, a: Self::V, b: Self::V) -> Self::V;
    /// Rounds values, none of which is negative, to the nearest whole number that a byte holds.
    #[inline(always)]
    fn bytes(self, v: Self::V) -> [u8; LANES] {
        let mut values = Block::default();
        // SAFETY: the block is the function's own.
        unsafe { self.store(&mut values, v) }
        values.0.map(|v| v.round_ties_even() as u8)
    }
}

/// Pairs of lanes.
pub const PAIRS: usize = LANES / 2;

/// Divides each of `N` vectors into `N` groups of neighbouring lanes; group `j` of vector `i` becomes group
/// `i` of vector `j`.
#[inline(always)]
fn exchange<S: Simd, const N: usize>(simd: S, rows: [S::V; N]) -> [S::V; N] {
    let group = LANES / N;
    let (mut from, mut to) = ([Block::default(); N], [Block::default(); N]);
    // SAFETY: the blocks are the function's own.
    unsafe {
        for (row, block) in rows.iter().zip(&mut from) {
            simd.store(block, *row);
        }
        for i in 0..N {
            for j in 0..N {
                for lane in 0..group {
                    to[j].0[group * i + lane] = from[i].0[group * j + lane];
                }
            }
        }
        std::array::from_fn(|j| simd.load(&to[j]))
    }
}

/// A computation to be compiled for every tier.
pub trait Kernel {
    /// Runs it on the lanes `S`; implementations are `#[inline(always)]`.
    fn run<S: Simd>(self, simd: S);
}

/// A set of instructions that this processor has.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Tier(Isa);

#[derive(Clone, Copy, PartialEq, Eq)]
enum Isa {
    Portable(Portable),
    #[cfg(target_arch = "x86_64")]
    Avx2(Avx2),
    #[cfg(target_arch = "x86_64")]
    Avx512(Avx512),
}

/// Evaluates `work` with the lanes of a tier. Only this macro tells the tiers apart.
macro_rules! with_lanes {
    ($tier:expr, $lanes:ident => $work:expr) => {
        match $tier.0 {
            Isa::Portable($lanes) => $work,
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2($lanes) => $work,
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512($lanes) => $work,
        }
    };
}

impl fmt::Debug for Tier {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(with_lanes!(self, lanes => name(lanes)))
    }
}

fn name<S: Simd>(_: S) -> &'static str {
    S::NAME
}

impl Tier {
    /// The reference implementation, on any processor.
    pub const PORTABLE: Tier = Tier(Isa::Portable(Portable));

    /// Every tier this processor can run, slowest first.
    pub fn available() -> Vec<Tier> {
        let tiers = [
            Some(Isa::Portable(Portable)),
            #[cfg(target_arch = "x86_64")]
            Avx2::detect().map(Isa::Avx2),
            #[cfg(target_arch = "x86_64")]
            Avx512::detect().map(Isa::Avx512),
        ];
        tiers.into_iter().flatten().map(Tier).collect()
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
        with_lanes!(self, lanes => lanes.run(kernel));
    }
}

/// The one of `choices` that the environment variable names, or the last one where it is empty.
///
/// # Panics
/// If it names none of them.
pub(super) fn choose<T: Copy + fmt::Debug>(variable: &str, wanted: &str, choices: &[T]) -> T {
    if let Some(names) = unknown_choice(wanted, choices) {
        panic!("{variable} is \"{wanted}\"; this processor has {names}");
    }
    let named = choices.iter().find(|choice| name_of(choice) == wanted.to_lowercase());
    *named.unwrap_or(&choices[choices.len() - 1])
}

/// The names of all `choices`, if what an environment variable names is none of them.
pub fn unknown_choice<T: fmt::Debug>(wanted: &str, choices: &[T]) -> Option<String> {
    let names: Vec<String> = choices.iter().map(name_of).collect();
    let is_known = wanted.is_empty() || names.contains(&wanted.to_lowercase());
    (!is_known).then(|| names.join(", "))
}

fn name_of(choice: &impl fmt::Debug) -> String {
    format!("{choice:?}").to_lowercase()
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
        fn run<S: Simd>(self, simd: S) {
            let p = self.values.as_ptr();
            let mut put = |v: S::V| {
                let mut out = vec![0.0; LANES];
                // SAFETY: there are as many values; vectors are the tier's.
                unsafe { simd.write(out.as_mut_ptr(), v) };
                self.results.push(out);
            };
            // SAFETY: vectors are the tier's; values 0 to 23 are read.
            unsafe {
                let (a, b) = (simd.read(p), simd.read(p.add(PAIRS)));
                put(simd.fma(a, b, simd.splat(0.5)));
                put(simd.mul(a, b));
                put(simd.div(a, b));
                put(simd.add(a, b));
                put(simd.max(a, b));
                put(simd.exp(a));
                for (first, end) in (0..=LANES).map(|end| (end / 3, end)) {
                    put(simd.read_some(p, first..end, -7.0));
                    let mut out = vec![9.0; LANES];
                    simd.write_first(out.as_mut_ptr(), end, a);
                    put(simd.read(out.as_ptr()));
                }
                put(simd.read_some(p.wrapping_sub(5), 5..7, -7.0));
                simd.double(p).into_iter().for_each(&mut put);
                let rows: [S::V; LANES] = std::array::from_fn(|i| simd.add(a, simd.splat(i as f32)));
                simd.transpose(rows).into_iter().for_each(&mut put);
                let rows: [S::V; PAIRS] = std::array::from_fn(|i| rows[i]);
                simd.transpose_pairs(rows).into_iter().for_each(&mut put);
                let bytes = simd.bytes(simd.mul(simd.max(a, simd.splat(0.0)), simd.splat(100.0)));
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

    /// Beyond the limit the result stays as it is there. NaN stays NaN, so that it is noticed.
    #[test]
    fn exponentials_end_at_the_limit() {
        struct Exponentials<'a>(&'a mut [f32; LANES]);
        impl Kernel for Exponentials<'_> {
            #[inline(always)]
            fn run<S: Simd>(self, simd: S) {
                // SAFETY: vectors are the tier's, sixteen values are read and written.
                unsafe { simd.write(self.0.as_mut_ptr(), simd.exp(simd.read(self.0.as_ptr()))) }
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
            fn run<S: Simd>(self, simd: S) {
                let line: [f32; LANES] = std::array::from_fn(|i| i as f32);
                // SAFETY: vectors are the tier's, sixteen values are read and written.
                unsafe {
                    let row = simd.read(line.as_ptr());
                    let rows = std::array::from_fn(|i| simd.add(row, simd.splat(100.0 * i as f32)));
                    let [own, near] = simd.double(line.as_ptr());
                    let pairs = simd.transpose_pairs(rows);
                    for (out, v) in self.0.iter_mut().zip([own, near, pairs[0], pairs[5]]) {
                        out.resize(LANES, 0.0);
                        simd.write(out.as_mut_ptr(), v);
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
