//! The FMA peak of a core, measured: the denominator of every efficiency figure.

use super::{
    Block, LANES,
    simd::{Kernel, Simd, Tier},
};

/// Independent accumulators: enough to hide the latency of an FMA, few enough for the registers.
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
        // SAFETY: only registers and `out` are touched.
        unsafe {
            let (a, b) = (S::splat(0.999_999), S::splat(1e-6));
            let mut acc = [S::splat(1.0); CHAINS];
            for _ in 0..self.steps {
                for v in &mut acc {
                    *v = S::fma(*v, a, b);
                }
            }
            let mut sum = acc[0];
            for v in &acc[1..] {
                sum = S::max(sum, *v);
            }
            S::store(self.out, sum);
        }
    }
}
