//! Runs methods over a test set, times them, and writes what a reader needs to judge them.

/// A measured number as printed and stored: seven significant digits, an exponent
/// only below a millionth.
pub fn number(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    let magnitude = value.abs().log10().floor() as i32;
    if magnitude < -6 {
        return format!("{value:.6e}");
    }
    let decimals = (6 - magnitude).max(0) as usize;
    let text = format!("{value:.decimals$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').into() } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_keep_seven_digits() {
        for (value, expected) in [
            (0.0, "0"),
            (1.0, "1"),
            (0.123456789, "0.1234568"),
            (-0.000123456789, "-0.0001234568"),
            (65504.0, "65504"),
            (123456789.4, "123456789"),
            (4.5381, "4.5381"),
            (1.25e-13, "1.250000e-13"),
        ] {
            assert_eq!(number(value), expected);
        }
    }
}
