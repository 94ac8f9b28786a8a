//! Axes of the charts: they turn values into pixels, and find round values for ticks.

/// Positions are clamped to this many pixels either way, however far off the scale a value is.
const FAR: f64 = 1e5;
/// The most ticks of a scale, over hundreds of decades too.
const MOST_TICKS: usize = 12;

/// Pixels of a panel's plotting area.
#[derive(Clone, Copy)]
pub struct Area {
    /// Left edge.
    pub left: i32,
    /// Right edge.
    pub right: i32,
    /// Top edge.
    pub top: i32,
    /// Bottom edge.
    pub bottom: i32,
}

/// One axis, which turns values into pixels.
pub struct Scale {
    low: f64,
    high: f64,
    logarithmic: bool,
    pixels: (i32, i32),
}

impl Scale {
    /// Covers `values` with a margin; `pixels` are where its ends lie.
    pub fn new(values: impl Iterator<Item = f64>, logarithmic: bool, pixels: (i32, i32)) -> Self {
        let finite = values.filter(|v| v.is_finite());
        let (low, high) = finite
            .map(|v| place(v, logarithmic))
            .fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
        let (low, high) = if low > high { (0.0, 1.0) } else { (low, high) };
        let margin = (0.12 * (high - low)).max(if logarithmic { 0.15 } else { 0.01 });
        Self { low: low - margin, high: high + margin, logarithmic, pixels }
    }

    /// Covers exactly what lies between two values.
    pub fn exactly((low, high): (f64, f64), logarithmic: bool, pixels: (i32, i32)) -> Self {
        Self { low: place(low, logarithmic), high: place(high, logarithmic), logarithmic, pixels }
    }

    /// How much it covers: in decades where it is logarithmic.
    pub fn span(&self) -> f64 {
        self.high - self.low
    }

    /// Where `value` lies.
    pub fn at(&self, value: f64) -> i32 {
        let share = (place(value, self.logarithmic) - self.low) / (self.high - self.low);
        let (from, to) = (f64::from(self.pixels.0), f64::from(self.pixels.1));
        (from + share * (to - from)).round().clamp(-FAR, FAR) as i32
    }

    /// Round values within the scale, 2 to 12 of them.
    pub fn ticks(&self) -> Vec<f64> {
        let even = |low: f64, high: f64| -> Vec<f64> {
            let step = round_step((high - low) / 6.0);
            // The ends are so near each other, or to zero, that no round value lies between them.
            if !step.is_normal() {
                return vec![low, high];
            }
            ((low / step).ceil() as i64..=(high / step).floor() as i64).map(|i| i as f64 * step).collect()
        };
        if !self.logarithmic {
            return even(self.low, self.high);
        }
        let within = |factors: &[f64]| -> Vec<f64> {
            (self.low.floor() as i32..=self.high.ceil() as i32)
                .flat_map(|decade| factors.iter().map(move |f| f * 10f64.powi(decade)))
                .filter(|v| (self.low..=self.high).contains(&v.log10()))
                .collect()
        };
        let choices: [&[f64]; 3] = [&[1.0], &[1.0, 3.0], &[1.0, 2.0, 5.0]];
        let enough = choices.into_iter().map(within).find(|ticks| ticks.len() >= 4);
        let ticks = enough.unwrap_or_else(|| even(10f64.powf(self.low), 10f64.powf(self.high)));
        let every = ticks.len().div_ceil(MOST_TICKS).max(1);
        ticks.into_iter().step_by(every).collect()
    }
}

/// Where a value lies on a scale, in decades if it is logarithmic. Zero has no logarithm, so all values below
/// the smallest normal number lie where that does.
fn place(value: f64, logarithmic: bool) -> f64 {
    if logarithmic { value.max(f64::MIN_POSITIVE).log10() } else { value }
}

/// 1, 2 or 5 times a power of ten, near `step`.
fn round_step(step: f64) -> f64 {
    let decade = 10f64.powf(step.log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|f| f * decade).find(|s| *s >= step).unwrap_or(10.0 * decade)
}

/// A tick's value without a tail of zeros or rounding noise.
pub fn tick_label(value: f64) -> String {
    if value != 0.0 && !(1e-4..1e6).contains(&value.abs()) {
        return format!("{value:.1e}").replace(".0e", "e");
    }
    let text = format!("{value:.6}");
    text.trim_end_matches('0').trim_end_matches('.').into()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn ticks_are_round_and_enough() {
        for (values, logarithmic) in [
            (vec![80.0, 5000.0], true),
            (vec![300.0, 330.0], true),
            (vec![1e-4, 30.0], true),
            (vec![0.81, 0.83], false),
            (vec![0.1, 0.95], false),
            (vec![7.0], true),
            (vec![2e-6], true),
            (vec![5e-324], true),
            (vec![5e-324, 1.0], true),
            (vec![5e-324, f64::MAX], true),
            (vec![0.0, f64::INFINITY, f64::NAN], true),
            (vec![f64::INFINITY], false),
            (vec![-1e300, 1e300], false),
        ] {
            let ticks = Scale::new(values.iter().copied(), logarithmic, (0, 100)).ticks();
            assert!((2..=12).contains(&ticks.len()), "{values:?}: {ticks:?}");
            let labels: BTreeSet<String> = ticks.iter().map(|tick| tick_label(*tick)).collect();
            // Of numbers near the smallest there are, the exponent alone takes five letters.
            let most = |label: &str| if label.contains("e-3") { 8 } else { 6 };
            assert!(labels.iter().all(|label| label.len() <= most(label)), "{labels:?}");
            assert_eq!(labels.len(), ticks.len(), "{labels:?}");
        }
        assert_eq!(tick_label(0.30000000000000004), "0.3");
        assert_eq!(tick_label(1000.0), "1000");
        assert_eq!((tick_label(1e-7), tick_label(0.0)), ("1e-7".into(), "0".into()));
    }

    #[test]
    fn values_that_are_no_numbers_stand_somewhere() {
        let scale = Scale::exactly((5e-324 / 2.0, 1e300), true, (100, 0));
        for value in [0.0, 5e-324, 1.0, f64::INFINITY, f64::NAN, -1.0] {
            assert!(scale.at(value).abs() <= FAR as i32, "{value}: {}", scale.at(value));
        }
    }
}
