//! The logarithms in which networks read radiance and the ratio of albedos: plain arithmetic, which the
//! compiler vectorises where it is inlined.

/// The function `ln(1 + steepness * v) / ln(1 + steepness)` of a value `v`. It maps 0 to 0 and 1 to 1, and is
/// nearly linear below `1 / steepness`.
#[derive(Clone, Copy)]
pub struct LogTransfer {
    steepness: f32,
    scale: f32,
}

impl LogTransfer {
    /// The transfer of that steepness, which must be positive.
    pub fn new(steepness: f32) -> Self {
        Self { steepness, scale: steepness.ln_1p().recip() }
    }

    /// Transfers a value, which must be finite and not negative.
    #[inline(always)]
    pub fn of(self, value: f32) -> f32 {
        ln(1.0 + self.steepness * value) * self.scale
    }
}

/// Coefficients, highest power first, of the polynomial `p` in `ln(1 + r) = r - r^2 / 2 + r^3 p(r)`, for
/// `1 + r` between the square roots of 1/2 and 2. They make the largest relative error of the logarithm as
/// small as possible: 6e-9. They were found by least squares, with weights changed until no point erred more
/// than others.
const LN: [f32; 8] = [
    -0.076_344_93,
    0.127_615_75,
    -0.131_601_83,
    0.142_017_59,
    -0.166_233_57,
    0.200_012_27,
    -0.250_008_2,
    0.333_333_3,
];

/// Natural logarithm of a normal positive number, to 2e-7 absolute and relative: `x = 2^n m` with m between
/// the square roots of 1/2 and 2. A polynomial gives `ln m`, since a division would take as long as all the
/// rest.
#[inline(always)]
pub fn ln(x: f32) -> f32 {
    const ROOT_OF_HALF: u32 = 0x3f35_04f3;
    let above = x.to_bits().wrapping_sub(ROOT_OF_HALF);
    let n = (above as i32 >> 23) as f32;
    let r = f32::from_bits((above & 0x007f_ffff) + ROOT_OF_HALF) - 1.0;
    let p = LN.iter().fold(0.0, |p, c| p * r + c);
    n * std::f32::consts::LN_2 + (r + r * r * (r * p - 0.5))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_the_logarithm() {
        let values: Vec<f32> = (0..4000).map(|i| 1e-6 * 1.01f32.powi(i)).take_while(|v| *v < 6e5).collect();
        let transfer = LogTransfer::new(16.0);
        for v in values {
            let (found, want) = (transfer.of(v), (16.0 * f64::from(v)).ln_1p() / 17f64.ln());
            // Near 1, the sum under the logarithm is rounded.
            assert!((f64::from(found) - want).abs() < 2e-7 * want.max(0.5), "{v}: {found} for {want}");
            let (found, want) = (ln(v / 0.7), (f64::from(v) / f64::from(0.7f32)).ln());
            assert!((f64::from(found) - want).abs() < 3e-7 * want.abs().max(1.0), "{v}: {found} for {want}");
        }
        let ends = [0.0, 1.0].map(|v| transfer.of(v));
        assert!(ends[0] == 0.0 && (ends[1] - 1.0).abs() < 1e-6, "{ends:?}");
    }
}
