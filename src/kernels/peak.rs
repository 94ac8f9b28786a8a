//! The FMA peak of a core, measured: the denominator of every efficiency figure.

use super::{
    Block, LANES,
    simd::{Kernel, Simd, Tier},
};

/// Independent accumulators: half of them are enough to hide the latency of an FMA where a block takes two
/// registers.
const CHAINS: usize = 12;

/// Floating-point operations of [`run`].
pub fn flops(steps: usize) -> usize {
    2 * CHAINS * LANES * steps
}

/// Runs `steps` rounds of independent FMAs on the calling thread; returns their sum, so that nothing
/// is optimised away.
pub fn run(tier: Tier, steps: usize) -> f32 {
    let mut out = Block::default();
    tier.run(Chains { steps, out: &mut out });
    out.0.iter().sum()
}

struct Chains<'a> {
    steps: usize,
    out: &'a mut Block,
}

impl Kernel for Chains<'_> {
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        // As many at once as a convolution's tile keeps in registers.
        let fit = S::TILE.0 * S::TILE.1 >= CHAINS;
        // SAFETY: only registers and `out` are touched.
        unsafe {
            let sum = if fit {
                chains::<S, CHAINS>(self.steps)
            } else {
                S::add(chains::<S, { CHAINS / 2 }>(self.steps), chains::<S, { CHAINS / 2 }>(self.steps))
            };
            S::store(self.out, sum);
        }
    }
}

/// Runs `steps` rounds of `N` chains and adds them up.
///
/// # Safety
/// As [`Simd::splat`].
#[inline(always)]
unsafe fn chains<S: Simd, const N: usize>(steps: usize) -> S::V {
    // SAFETY: the caller's promise.
    unsafe {
        // Values that the compiler cannot know, or it would find the chains alike, or their limit.
        let value = |v: f32| S::splat(std::hint::black_box(v));
        let (a, b) = (value(0.999_999), value(1e-6));
        let mut acc: [S::V; N] = std::array::from_fn(|i| value(i as f32));
        for _ in 0..steps {
            for v in &mut acc {
                *v = S::fma(*v, a, b);
            }
        }
        acc.into_iter().reduce(|a, b| S::add(a, b)).expect("there are chains")
    }
}
