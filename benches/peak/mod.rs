//! The FMA peak of a core, measured: the denominator of every efficiency figure.

use demc::kernels::{
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
    fn run<S: Simd>(self, simd: S) {
        // Only as many chains run at once as a convolution's tile keeps in registers.
        let fit = S::TILE.0 * S::TILE.1 >= CHAINS;
        let sum = if fit {
            chains::<S, CHAINS>(simd, self.steps)
        } else {
            simd.add(
                chains::<S, { CHAINS / 2 }>(simd, self.steps),
                chains::<S, { CHAINS / 2 }>(simd, self.steps),
            )
        };
        simd.set(self.out, sum);
    }
}

/// Runs `steps` rounds of `N` chains and adds them up.
#[inline(always)]
fn chains<S: Simd, const N: usize>(simd: S, steps: usize) -> S::V {
    // The compiler must not know these values, or it could compute the chains' limit, or find that they are
    // alike.
    let value = |v: f32| simd.splat(std::hint::black_box(v));
    let (a, b) = (value(0.999_999), value(1e-6));
    let mut acc: [S::V; N] = std::array::from_fn(|i| value(i as f32));
    for _ in 0..steps {
        for v in &mut acc {
            *v = simd.fma(*v, a, b);
        }
    }
    acc.into_iter().reduce(|a, b| simd.add(a, b)).expect("there are chains")
}
