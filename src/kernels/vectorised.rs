//! Plain loops compiled for every tier: for code that the compiler vectorises well by itself and that
//! needs the wider registers, but no intrinsics.
//!
//! Sums are never reordered nor contracted, so every tier gives the same bits.

use super::simd::{Kernel, Simd, Tier};

/// Values that one thread takes at a time, where each is computed by itself.
pub const CHUNK: usize = 1 << 14;

/// A computation in plain, safe loops; its `run` and what it calls are `#[inline(always)]`, since only
/// what is inlined is compiled for the tier.
pub trait Vectorised {
    /// Does the work.
    fn run(self);
}

struct Plain<V>(V);

impl<V: Vectorised> Kernel for Plain<V> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        self.0.run();
    }
}

/// Runs `work` with the instructions of the fastest tier.
pub fn run(work: impl Vectorised) {
    Tier::detect().run(Plain(work));
}
