//! Division of radiance by albedo, planar f32, one image at a time.
//!
//! A pixel's noisy albedo and its noisy radiance come from the same samples. Where those differ by what the
//! pixel saw, as on edges, the quotient of the two has less noise than either. Where albedo and light vary
//! together, as in depth of field or behind rough glass, a mean of quotients times a mean of albedos is not the
//! mean of products, and only one divisor for all of a pixel's samples and neighbours keeps the light: the
//! filtered albedo, by which the result is multiplied in the end. So each pixel has a share between the two.

use rayon::prelude::*;

use super::{
    filter::sigmoid,
    simd::{Kernel, Simd, Tier},
};

/// What is divided again, and by what.
#[derive(Clone, Copy)]
pub struct Division<'a> {
    /// Radiance over the noisy albedo, (3, H, W).
    pub quotient: &'a [f32],
    /// The noisy albedo, (3, H, W), positive.
    pub albedo: &'a [f32],
    /// The filtered albedo, (3, H, W), positive.
    pub filtered: &'a [f32],
    /// The filtered albedo's share before its logistic, (1, H, W).
    pub share: &'a [f32],
}

/// Pixels that a thread takes at once.
const CHUNK: usize = 4096;

/// `quotient * albedo / (albedo + sigmoid(share) * (filtered - albedo))`, (3, H, W).
///
/// # Panics
/// If lengths do not fit.
pub fn redivide(division: Division, output: &mut [f32]) {
    let Division { quotient, albedo, filtered, share } = division;
    let n = share.len();
    assert!([quotient.len(), albedo.len(), filtered.len(), output.len()] == [3 * n; 4]);
    for (plane, output) in output.chunks_mut(n.max(1)).enumerate() {
        output.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, output)| {
            let at = chunk * CHUNK..chunk * CHUNK + output.len();
            let of_plane = plane * n + at.start..plane * n + at.end;
            let division = Division {
                quotient: &quotient[of_plane.clone()],
                albedo: &albedo[of_plane.clone()],
                filtered: &filtered[of_plane],
                share: &share[at],
            };
            Tier::detect().run(Part { division, output });
        });
    }
}

/// Consecutive values of one channel.
struct Part<'a> {
    division: Division<'a>,
    output: &'a mut [f32],
}

impl Kernel for Part<'_> {
    // A plain loop, which the compiler vectorises with the tier's instructions.
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Division { quotient, albedo, filtered, share } = self.division;
        let values = quotient.iter().zip(albedo).zip(filtered.iter().zip(share));
        for (out, ((q, a), (f, share))) in self.output.iter_mut().zip(values) {
            *out = q * a / (a + sigmoid(*share) * (f - a));
        }
    }
}

/// Adds what [`redivide`]'s output gradient, (3, H, W), sends back to `filtered`, (3, H, W), and to `share`,
/// (1, H, W).
///
/// # Panics
/// If lengths do not fit.
pub fn redivide_gradient(
    division: Division,
    output_gradient: &[f32],
    into_filtered: &mut [f32],
    into_share: &mut [f32],
) {
    let n = division.share.len();
    assert_eq!((output_gradient.len(), into_filtered.len(), into_share.len()), (3 * n, 3 * n, n));
    for (at, gradient) in output_gradient.iter().enumerate() {
        let (a, f) = (division.albedo[at], division.filtered[at]);
        let share = sigmoid(division.share[at % n]);
        let divisor = a + share * (f - a);
        let by_divisor = -gradient * division.quotient[at] * a / (divisor * divisor);
        into_filtered[at] += by_divisor * share;
        into_share[at % n] += by_divisor * (f - a) * share * (1.0 - share);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const QUOTIENT: [f32; 6] = [0.5, 2.0, 1.5, 0.0, 3.0, 0.25];
    const ALBEDO: [f32; 6] = [0.1, 0.9, 0.4, 0.5, 1.05, 0.05];
    const FILTERED: [f32; 6] = [0.2, 0.8, 0.4, 0.6, 0.7, 0.3];
    const SHARE: [f32; 2] = [-1.0, 0.7];

    fn divided(filtered: &[f32], share: &[f32]) -> Vec<f32> {
        let mut output = vec![0.0; 6];
        redivide(Division { quotient: &QUOTIENT, albedo: &ALBEDO, filtered, share }, &mut output);
        output
    }

    #[test]
    fn the_divisor_goes_from_noisy_to_filtered_albedo() {
        let close = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() <= 1e-5 * b.abs());
        assert!(close(&divided(&FILTERED, &[-60.0; 2]), &QUOTIENT));
        let filtered: Vec<f32> = (0..6).map(|i| QUOTIENT[i] * ALBEDO[i] / FILTERED[i]).collect();
        assert!(close(&divided(&FILTERED, &[60.0; 2]), &filtered));
    }

    #[test]
    fn gradients_are_those_of_finite_differences() {
        const GRADIENT: [f32; 6] = [1.0, -0.5, 0.3, 2.0, 0.7, -1.0];
        const STEP: f32 = 1e-2;
        let projected = |filtered: &[f32], share: &[f32]| -> f32 {
            divided(filtered, share).iter().zip(GRADIENT).map(|(v, g)| v * g).sum()
        };
        let (mut by_filtered, mut by_share) = ([0.0; 6], [0.0; 2]);
        let division = Division { quotient: &QUOTIENT, albedo: &ALBEDO, filtered: &FILTERED, share: &SHARE };
        redivide_gradient(division, &GRADIENT, &mut by_filtered, &mut by_share);
        let check = |got: f32, up: f32, down: f32| {
            let want = (up - down) / (2.0 * STEP);
            assert!((got - want).abs() <= 2e-2 * want.abs() + 1e-3, "{got} for {want}");
        };
        for i in 0..6 {
            let moved = |by: f32| {
                let mut filtered = FILTERED;
                filtered[i] += by;
                projected(&filtered, &SHARE)
            };
            check(by_filtered[i], moved(STEP), moved(-STEP));
        }
        for i in 0..2 {
            let moved = |by: f32| {
                let mut share = SHARE;
                share[i] += by;
                projected(&FILTERED, &share)
            };
            check(by_share[i], moved(STEP), moved(-STEP));
        }
    }
}
