//! Whether frames of a sequence share one pattern of noise. Blender draws every frame with the same random
//! numbers unless the seed is animated: the noise then sticks to the screen while things move beneath it, and
//! no frame can clean another.
//!
//! In: passes of consecutive frames. Out: a warning that names the setting.

use super::{Finding, GUIDES, render};
use crate::{passes::PassSet, planes::Planes};

/// The noise of a frame, as far as it shows: the relative difference of each pixel's light from the mean of
/// the pixels around it, or NaN where that may be texture or an edge.
pub struct Grain {
    width: usize,
    values: Vec<f32>,
}

/// Where the 3x3 pixels of a guide differ by more than this, there is texture or an edge.
const FLAT: f32 = 0.05;

/// Differences are clamped to this, so that a firefly does not decide alone.
const LARGEST: f32 = 1.0;

/// Where the root mean square of the differences is smaller, they are as likely to be detail of the light.
const LEAST: f64 = 0.03;

/// The fewest pixels to judge by.
const PIXELS: usize = 500;

/// The correlation of two frames' noise above which they share one pattern. Frames with seeds of their own
/// have a correlation of some thousandths.
const SHARED: f64 = 0.2;

/// The same where nothing moves: what noise does not hide of the light is then the same in both, and with one seed all is.
const SHARED_AT_REST: f64 = 0.9;

impl Grain {
    /// The grain of a view layer's passes; none without Combined or without any guide to tell texture by.
    pub fn of(set: &PassSet) -> Option<Self> {
        let radiance = render(set)?;
        let guides: Vec<&Planes> = GUIDES.iter().filter_map(|pass| set.get(*pass)).collect();
        let (width, height) = (set.width, set.height);
        if guides.is_empty() || width < 3 || height < 3 {
            return None;
        }
        let around = |at: usize| [at - width, at - 1, at + 1, at + width];
        let light = |at: usize| (0..3).map(|c| radiance.channel(c)[at].max(0.0)).sum::<f32>();
        let is_flat = |at: usize| {
            guides.iter().all(|guide| {
                (0..3).all(|c| {
                    let plane = guide.channel(c);
                    around(at).iter().all(|other| (plane[*other] - plane[at]).abs() < FLAT)
                })
            })
        };
        let is_inside =
            |at: usize| (1..width - 1).contains(&(at % width)) && (1..height - 1).contains(&(at / width));
        let value = |at: usize| {
            if !is_inside(at) || !is_flat(at) {
                return f32::NAN;
            }
            let mean = around(at).map(light).iter().sum::<f32>() / 4.0;
            // Where all pixels around are black, there is no relative difference.
            if mean > 0.0 { (light(at) / mean - 1.0).clamp(-LARGEST, LARGEST) } else { f32::NAN }
        };
        let values = (0..width * height).map(value).collect();
        Some(Self { width, values })
    }

    /// The correlation with the noise of `other` at the same pixels: 1 where both are the same. None where
    /// too few pixels or too little noise show.
    fn shared(&self, other: &Self) -> Option<f64> {
        if (self.width, self.values.len()) != (other.width, other.values.len()) {
            return None;
        }
        let both = self.values.iter().zip(&other.values).map(|(a, b)| (f64::from(*a), f64::from(*b)));
        let both: Vec<(f64, f64)> = both.filter(|(a, b)| a.is_finite() && b.is_finite()).collect();
        let mean = |of: &dyn Fn(&(f64, f64)) -> f64| both.iter().map(of).sum::<f64>() / both.len() as f64;
        if both.len() < PIXELS {
            return None;
        }
        // Means are subtracted: relative differences of positive values are more often small and negative
        // than large and positive, so their mean need not be zero.
        let (a, b) = (mean(&|v| v.0), mean(&|v| v.1));
        let [of_a, of_b] = [mean(&|v| (v.0 - a).powi(2)), mean(&|v| (v.1 - b).powi(2))];
        let product = mean(&|v| (v.0 - a) * (v.1 - b));
        (of_a.min(of_b).sqrt() > LEAST).then(|| product / (of_a * of_b).sqrt())
    }

    /// The warning for a frame that shares its noise with `other`, the grain of the frame before it, whose
    /// name is `before`; `is_still` if nothing moves between them.
    pub fn warning(&self, other: &Self, before: &str, is_still: bool) -> Option<Finding> {
        let most = if is_still { SHARED_AT_REST } else { SHARED };
        let shared = self.shared(other).filter(|shared| *shared > most)?;
        Some(Finding::new(
            "shared-noise",
            format!(
                "its noise is that of {before} ({:.0}% the same, at the same places of the screen): frames cannot clean each \
                 other",
                100.0 * shared
            ),
            "press the clock beside Render Properties > Sampling > Advanced > Seed (Use Animated Seed)",
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{passes::Pass, rng::Rng};

    /// Passes of a flat wall with noise of a seed.
    fn grain(seed: u64, amount: f32) -> Grain {
        let mut rng = Rng::new(seed, 0);
        let mut set = PassSet::new("x.exr", "", 64, 48);
        let noise: Vec<f32> = (0..64 * 48).map(|_| 1.0 + amount * (rng.uniform() - 0.5)).collect();
        set.insert(Pass::Combined, Planes::from_vec(3, 64, 48, [&noise[..], &noise, &noise].concat()));
        set.insert(Pass::DenoisingAlbedo, Planes::from_vec(3, 64, 48, vec![0.5; 3 * 64 * 48]));
        Grain::of(&set).unwrap()
    }

    #[test]
    fn noise_that_sticks_to_the_screen_is_found() {
        let warning = grain(1, 1.0).warning(&grain(1, 0.8), "shot.0001.exr", false).unwrap();
        assert!(warning.message.contains("shot.0001.exr") && warning.remedy.contains("Seed"), "{warning:?}");
        assert_eq!(grain(1, 1.0).warning(&grain(2, 1.0), "shot.0001.exr", false), None);
        assert_eq!(
            grain(1, 0.01).warning(&grain(1, 0.01), "shot.0001.exr", false),
            None,
            "too little to tell"
        );
        // What is half the same is light, where nothing moves.
        let mixed = |seed: u64| {
            let (mut own, light) = (grain(seed, 1.0), grain(9, 1.0));
            own.values.iter_mut().zip(light.values).for_each(|(v, light)| *v = 0.5 * (*v + light));
            own
        };
        for (is_still, is_warned) in [(true, false), (false, true)] {
            assert_eq!(mixed(1).warning(&mixed(2), "shot.0001.exr", is_still).is_some(), is_warned);
        }
        assert!(mixed(1).warning(&mixed(1), "shot.0001.exr", true).is_some());
    }
}
