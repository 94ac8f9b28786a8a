//! From radiance to what a display would show: exposure from the reference, then gamma.
//!
//! Renders have no common brightness, and SSIM needs one: the exposure brings the reference's mean
//! luminance, its brightest 2 % capped, to 0.35.

use rayon::prelude::*;

use crate::planes::Planes;

/// Rec. 709 luminance of linear RGB (ITU-R BT.709-6, item 3.2).
pub const LUMINANCE: [f64; 3] = [0.2126, 0.7152, 0.0722];
/// Mean capped luminance that a reference is exposed to.
const TARGET: f64 = 0.35;
/// Luminance is capped at this percentile (linear interpolation between ranks).
const CAP_PERCENTILE: f64 = 98.0;
/// Display transfer: the encoded value is the linear one to the power `1 / GAMMA`.
const GAMMA: f64 = 2.2;

/// `0.35 / mean(min(Y, P98(Y)))` of the reference's luminance Y; none where that mean is not positive.
///
/// # Panics
/// If `reference` is not (3, H, W) with at least one pixel.
pub fn exposure(reference: &Planes) -> Option<f64> {
    assert!(reference.channels == 3 && reference.pixels() > 0, "exposure is defined on RGB");
    exposure_of(luminance(reference))
}

/// [`exposure`] of the pixels that are not black alone, for pictures to look at: a small thing before nothing would be
/// white all over. None where all is black.
///
/// # Panics
/// As [`exposure`].
pub fn exposure_of_lit(image: &Planes) -> Option<f64> {
    assert!(image.channels == 3, "exposure is defined on RGB");
    exposure_of(luminance(image).into_iter().filter(|y| *y > 0.0).collect())
}

fn exposure_of(mut luminance: Vec<f64>) -> Option<f64> {
    if luminance.is_empty() {
        return None;
    }
    luminance.par_sort_unstable_by(f64::total_cmp);
    let cap = percentile(&luminance, CAP_PERCENTILE);
    let mean = luminance.iter().map(|y| y.min(cap)).sum::<f64>() / luminance.len() as f64;
    (mean > 0.0).then(|| TARGET / mean)
}

/// Rec. 709 luminance of every pixel of an image, (3, H, W).
pub fn luminance(image: &Planes) -> Vec<f64> {
    let [r, g, b] = [0, 1, 2].map(|c| image.channel(c));
    (0..image.pixels())
        .into_par_iter()
        .map(|i| {
            LUMINANCE[0] * f64::from(r[i]) + LUMINANCE[1] * f64::from(g[i]) + LUMINANCE[2] * f64::from(b[i])
        })
        .collect()
}

/// The percentile of sorted values, as `numpy.percentile` interpolates by default.
pub fn percentile(sorted: &[f64], percent: f64) -> f64 {
    let rank = percent / 100.0 * (sorted.len() - 1) as f64;
    let (low, fraction) = (rank.floor() as usize, rank.fract());
    let high = (low + 1).min(sorted.len() - 1);
    sorted[low] + (sorted[high] - sorted[low]) * fraction
}

/// `clamp(exposure * x, 0, 1)^(1/2.2)` of every value.
pub fn display(radiance: &Planes, exposure: f64) -> Planes {
    let mut image = radiance.clone();
    image.data.par_iter_mut().for_each(|v| *v = encode(*v, exposure));
    image
}

/// [`display`] of one value.
pub fn encode(radiance: f32, exposure: f64) -> f32 {
    (exposure * f64::from(radiance)).clamp(0.0, 1.0).powf(1.0 / GAMMA) as f32
}

/// The derivative of [`encode`] by radiance, and 0 from white on. Below 0.005 of white it stays what it is
/// there, since at black it would be infinite.
pub fn encode_slope(radiance: f32, exposure: f64) -> f32 {
    const DARK: f64 = 0.005;
    let exposed = exposure * f64::from(radiance);
    if exposed >= 1.0 {
        return 0.0;
    }
    (exposure / GAMMA * exposed.max(DARK).powf(1.0 / GAMMA - 1.0)) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentile_interpolates_between_ranks() {
        // numpy.percentile([1, 2, 3, 10], [0, 50, 98, 100]) = 1, 2.5, 9.58, 10
        for (percent, expected) in [(0.0, 1.0), (50.0, 2.5), (98.0, 9.58), (100.0, 10.0)] {
            let found = percentile(&[1.0, 2.0, 3.0, 10.0], percent);
            assert!((found - expected).abs() < 1e-12, "{percent}: {found}");
        }
        assert_eq!(percentile(&[7.0], 98.0), 7.0);
    }

    #[test]
    fn exposure_brings_the_mean_to_its_target_and_ignores_the_brightest() {
        let grey = Planes::from_vec(3, 10, 10, vec![0.7; 300]);
        assert!((exposure(&grey).unwrap() - 0.5).abs() < 1e-6);
        let mut sun = grey.clone();
        for c in 0..3 {
            sun.channel_mut(c)[42] = 60000.0;
        }
        assert!((exposure(&sun).unwrap() - 0.5).abs() < 1e-6, "one pixel in a hundred is above P98");
        assert_eq!(exposure(&Planes::new(3, 4, 4)), None, "black");
        let mut small = Planes::new(3, 10, 10);
        (0..3).for_each(|c| small.channel_mut(c)[..4].fill(0.7));
        assert!((exposure_of_lit(&small).unwrap() - 0.5).abs() < 1e-6);
        assert_eq!(exposure_of_lit(&grey), exposure(&grey));
        assert_eq!(exposure_of_lit(&Planes::new(3, 4, 4)), None);
    }

    #[test]
    fn display_clamps_and_encodes() {
        assert_eq!(encode(-1.0, 1.0), 0.0);
        assert_eq!(encode(9.0, 1.0), 1.0);
        assert!((encode(0.25, 2.0) - 0.5f32.powf(1.0 / 2.2)).abs() < 1e-6);
    }
}
