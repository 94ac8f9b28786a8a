//! Plain arrays: the oracle of the other tiers.

use super::{Block, Kernel, LANES, Simd};

/// The portable lanes.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Portable;

impl Simd for Portable {
    const NAME: &str = "Portable";
    type V = [f32; LANES];
    const TILE: (usize, usize) = (1, 4);

    fn detect() -> Option<Self> {
        Some(Self)
    }
    fn run<K: Kernel>(self, kernel: K) {
        kernel.run(self);
    }

    #[inline(always)]
    fn splat(self, x: f32) -> Self::V {
        [x; LANES]
    }
    #[inline(always)]
    unsafe fn load(self, p: *const Block) -> Self::V {
        // SAFETY: the caller's promise.
        unsafe { (*p).0 }
    }
    #[inline(always)]
    unsafe fn store(self, p: *mut Block, v: Self::V) {
        // SAFETY: the caller's promise.
        unsafe { (*p).0 = v }
    }
    #[inline(always)]
    unsafe fn read(self, p: *const f32) -> Self::V {
        // SAFETY: the caller's promise; an array is aligned as its values are.
        unsafe { *p.cast() }
    }
    #[inline(always)]
    unsafe fn write(self, p: *mut f32, v: Self::V) {
        // SAFETY: as above.
        unsafe { *p.cast() = v }
    }
    #[inline(always)]
    fn fma(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        std::array::from_fn(|i| a[i] * b[i] + c[i])
    }
    #[inline(always)]
    fn mul(self, a: Self::V, b: Self::V) -> Self::V {
        std::array::from_fn(|i| a[i] * b[i])
    }
    #[inline(always)]
    fn div(self, a: Self::V, b: Self::V) -> Self::V {
        std::array::from_fn(|i| a[i] / b[i])
    }
    #[inline(always)]
    fn add(self, a: Self::V, b: Self::V) -> Self::V {
        std::array::from_fn(|i| a[i] + b[i])
    }
    #[inline(always)]
    fn max(self, a: Self::V, b: Self::V) -> Self::V {
        std::array::from_fn(|i| if a[i] > b[i] { a[i] } else { b[i] })
    }
}
