//! `e^x` and the logistic function in the arithmetic that every tier repeats: the same operations in the same
//! order.

/// Exponents are kept within this distance of zero: a weight of `e^-40` does not count beside 1.
pub(super) const LIMIT: f32 = 40.0;

/// ln 2 in two parts, and the polynomial for `e^r` on +-0.5 ln 2, highest power first, without `r + 1`: the
/// minimax coefficients of Cephes' expf (Moshier).
pub(super) const LN_2: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];
pub(super) const EXP: [f32; 6] =
    [1.987_569_1e-4, 1.398_199_9e-3, 8.333_452e-3, 4.166_579_6e-2, 1.666_666_5e-1, 0.5];

/// `e^x` to 2e-7 relative within +-`LIMIT`, and beyond these limits the value at the limit. It is 2^n times a
/// polynomial on +-0.5 ln 2.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    let x = x.clamp(-LIMIT, LIMIT);
    // Adding 1.5 * 2^23 rounds to an integer, whose low bits then stand in the mantissa.
    const ROUND: f32 = 12_582_912.0;
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = x - n * LN_2[0] - n * LN_2[1];
    let p = EXP.iter().fold(0.0, |p, c| p * r + c);
    let e = (p * r * r + r) + 1.0;
    let bits = (shifted.to_bits() << 23).wrapping_add(127 << 23);
    e * f32::from_bits(bits)
}

/// `slope` where [`exp`] changes with `x`, and 0 beyond its limit, where it does not.
#[inline(always)]
pub(super) fn limited(x: f32, slope: f32) -> f32 {
    if x.abs() <= LIMIT { slope } else { 0.0 }
}

/// The logistic function.
#[inline(always)]
pub(super) fn logistic(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}
