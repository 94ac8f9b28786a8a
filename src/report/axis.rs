//! Axes of the charts: values to pixels, and round ticks.

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

/// One axis: values to pixels.
pub struct Scale {
    low: f64,
    high: f64,
    logarithmic: bool,
    pixels: (i32, i32),
}

impl Scale {
    /// Covers `values` with a margin; `pixels` are where its ends lie.
    pub fn new(values: impl Iterator<Item = f64>, logarithmic: bool, pixels: (i32, i32)) -> Self {
        let place = |v: f64| if logarithmic { v.log10() } else { v };
        let (low, high) = values.map(place).fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
        let (low, high) = if low > high { (0.0, 1.0) } else { (low, high) };
        let margin = (0.12 * (high - low)).max(if logarithmic { 0.15 } else { 0.01 });
        Self { low: low - margin, high: high + margin, logarithmic, pixels }
    }

    /// Covers exactly what lies between two values.
    pub fn exactly((low, high): (f64, f64), logarithmic: bool, pixels: (i32, i32)) -> Self {
        let place = |v: f64| if logarithmic { v.log10() } else { v };
        Self { low: place(low), high: place(high), logarithmic, pixels }
    }

    /// How much it covers: in decades where it is logarithmic.
    pub fn span(&self) -> f64 {
        self.high - self.low
    }

    /// Where `value` lies.
    pub fn at(&self, value: f64) -> i32 {
        let value = if self.logarithmic { value.log10() } else { value };
        let share = (value - self.low) / (self.high - self.low);
        self.pixels.0 + (share * f64::from(self.pixels.1 - self.pixels.0)).round() as i32
    }

    /// Round values within the scale, some four to nine of them.
    pub fn ticks(&self) -> Vec<f64> {
        let even = |low: f64, high: f64| -> Vec<f64> {
            let step = round_step((high - low) / 6.0);
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
        enough.unwrap_or_else(|| even(10f64.powf(self.low), 10f64.powf(self.high)))
    }
}

/// 1, 2 or 5 times a power of ten, near `step`.
fn round_step(step: f64) -> f64 {
    let decade = 10f64.powf(step.log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|f| f * decade).find(|s| *s >= step).unwrap_or(10.0 * decade)
}

/// A tick's value without a tail of zeros or rounding noise.
pub fn tick_label(value: f64) -> String {
    let text = format!("{value:.6}");
    text.trim_end_matches('0').trim_end_matches('.').into()
}

#[cfg(test)]
mod tests {
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
        ] {
            let ticks = Scale::new(values.iter().copied(), logarithmic, (0, 100)).ticks();
            assert!((2..=12).contains(&ticks.len()), "{values:?}: {ticks:?}");
            assert!(ticks.iter().all(|t| tick_label(*t).len() <= 6), "{ticks:?}");
        }
        assert_eq!(tick_label(0.30000000000000004), "0.3");
        assert_eq!(tick_label(1000.0), "1000");
    }
}
