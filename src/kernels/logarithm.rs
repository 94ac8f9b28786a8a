//! The logarithms in which networks read radiance and the ratio of albedos, planar f32.

use rayon::prelude::*;

use super::vectorised::{self, CHUNK, Vectorised};

/// Writes `ln(1 + steepness * v) / ln(1 + steepness)` of each value `v`: 0 of 0, 1 of 1, nearly linear below
/// `1 / steepness`. Values are finite and not negative.
///
/// # Panics
/// If lengths differ.
pub fn log_transfer(values: &[f32], steepness: f32, output: &mut [f32]) {
    assert_eq!(values.len(), output.len());
    let scale = steepness.ln_1p().recip();
    output.par_chunks_mut(CHUNK).zip(values.par_chunks(CHUNK)).for_each(|(output, values)| {
        vectorised::run(LogTransfer { values, steepness, scale, output });
    });
}

/// Writes the logarithm of each value of `above` over that of `below`, all of them normal and positive.
///
/// # Panics
/// If lengths differ.
pub fn log_ratio(above: &[f32], below: &[f32], output: &mut [f32]) {
    assert_eq!((above.len(), below.len()), (output.len(), output.len()));
    let read = above.par_chunks(CHUNK).zip(below.par_chunks(CHUNK));
    output.par_chunks_mut(CHUNK).zip(read).for_each(|(output, (above, below))| {
        vectorised::run(LogRatio { above, below, output });
    });
}

struct LogRatio<'a> {
    above: &'a [f32],
    below: &'a [f32],
    output: &'a mut [f32],
}

impl Vectorised for LogRatio<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { above, below, output } = self;
        for (out, (above, below)) in output.iter_mut().zip(above.iter().zip(below)) {
            *out = ln(above / below);
        }
    }
}

struct LogTransfer<'a> {
    values: &'a [f32],
    steepness: f32,
    scale: f32,
    output: &'a mut [f32],
}

impl Vectorised for LogTransfer<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { values, steepness, scale, output } = self;
        for (out, value) in output.iter_mut().zip(values) {
            *out = ln(1.0 + steepness * value) * scale;
        }
    }
}

/// Natural logarithm of a normal positive number, to 2e-7 absolute and relative: `x = 2^n m` with m between the roots of
/// 1/2 and 2, and `ln m = 2 atanh s` with `s = (m - 1) / (m + 1)`, whose series is cut where it is below 2^-28.
#[inline(always)]
fn ln(x: f32) -> f32 {
    const ROOT_OF_HALF: u32 = 0x3f35_04f3;
    let above = x.to_bits().wrapping_sub(ROOT_OF_HALF);
    let n = (above as i32 >> 23) as f32;
    let m = f32::from_bits((above & 0x007f_ffff) + ROOT_OF_HALF);
    let s = (m - 1.0) / (m + 1.0);
    let z = s * s;
    let series = z * (1.0 / 3.0 + z * (1.0 / 5.0 + z * (1.0 / 7.0 + z * (1.0 / 9.0))));
    n * std::f32::consts::LN_2 + 2.0 * (s + s * series)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_the_logarithm() {
        let values: Vec<f32> = (0..4000).map(|i| 1e-6 * 1.01f32.powi(i)).take_while(|v| *v < 6e5).collect();
        let mut output = vec![0.0; values.len()];
        log_transfer(&values, 16.0, &mut output);
        for (v, found) in values.iter().zip(&output) {
            let want = (16.0 * f64::from(*v)).ln_1p() / 17f64.ln();
            // Near 1, the sum under the logarithm is rounded.
            assert!((f64::from(*found) - want).abs() < 2e-7 * want.max(0.5), "{v}: {found} for {want}");
        }
        let mut ratio = vec![0.0; values.len()];
        log_ratio(&values, &vec![0.7; values.len()], &mut ratio);
        for (v, found) in values.iter().zip(&ratio) {
            let want = (f64::from(*v) / f64::from(0.7f32)).ln();
            assert!((f64::from(*found) - want).abs() < 3e-7 * want.abs().max(1.0), "{v}: {found} for {want}");
        }
        let mut ends = [2.0; 2];
        log_transfer(&[0.0, 1.0], 16.0, &mut ends);
        assert!(ends[0] == 0.0 && (ends[1] - 1.0).abs() < 1e-6, "{ends:?}");
    }
}
