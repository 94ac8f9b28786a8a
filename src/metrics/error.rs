//! Pixel-wise errors on linear radiance.
//!
//! RelMSE: Rousselle, Knaus, Zwicker, "Adaptive Sampling and Reconstruction using Greedy Error Minimization"
//! (2011), with the epsilon of the DEMC paper's Eq. 5, averaged over channels. Its trimmed form, this
//! project's own, leaves out the worst 0.1% of pixels, so that a handful of fireflies in image or reference
//! does not decide it. RMSE and maximum error: as OpenImageIO's `idiff` prints them. SMAPE: Vogels et al.,
//! "Denoising with Kernel Prediction and Asymmetric Loss Functions" (2018), section 4.
//!
//! All of them panic if the images differ in size or channels, or have no pixel.

use rayon::prelude::*;

use super::{assert_alike, mean};
use crate::planes::Planes;

/// Added to the squared reference in RelMSE's denominator, so that the error of black pixels is finite.
pub const RELMSE_EPSILON: f64 = 1e-3;

/// Share of pixels, the worst ones, that [`relmse_trimmed`] leaves out.
pub const TRIMMED_SHARE: f64 = 1e-3;

/// Added to SMAPE's denominator.
pub const SMAPE_EPSILON: f64 = 1e-2;

/// Squared error of one value relative to the reference: `(x - r)^2 / (r^2 + 0.001)`.
pub fn relative_squared_error(x: f64, r: f64) -> f64 {
    (x - r).powi(2) / (r * r + RELMSE_EPSILON)
}

/// The mean over pixels and channels of [`relative_squared_error`].
pub fn relmse(image: &Planes, reference: &Planes) -> f64 {
    mean(image, reference, relative_squared_error)
}

/// The root of the mean over pixels and channels of `(x - r)^2`.
pub fn rmse(image: &Planes, reference: &Planes) -> f64 {
    mean(image, reference, |x, r| (x - r).powi(2)).sqrt()
}

/// The largest `|x - r|` of any pixel and channel.
pub fn max_error(image: &Planes, reference: &Planes) -> f64 {
    assert_alike(image, reference);
    image
        .data
        .par_iter()
        .zip(&reference.data)
        .map(|(&x, &r)| (f64::from(x) - f64::from(r)).abs())
        .reduce(|| 0.0, f64::max)
}

/// The mean over pixels and channels of `|x - r| / (|x| + |r| + 0.01)`: 0 at best, below 1 at worst.
pub fn smape(image: &Planes, reference: &Planes) -> f64 {
    mean(image, reference, |x, r| (x - r).abs() / (x.abs() + r.abs() + SMAPE_EPSILON))
}

/// The sum of all values divided by that of the reference: how much of the light is kept. None where the
/// reference's sum is not positive.
pub fn energy(image: &Planes, reference: &Planes) -> Option<f64> {
    assert_alike(image, reference);
    let sum = |planes: &Planes| planes.data.iter().map(|v| f64::from(*v)).sum::<f64>();
    let whole = sum(reference);
    (whole > 0.0).then(|| sum(image) / whole)
}

/// RelMSE of each pixel (the mean of its channels), row-major: the error map of a report.
pub fn relmse_map(image: &Planes, reference: &Planes) -> Vec<f64> {
    assert_alike(image, reference);
    (0..image.pixels())
        .into_par_iter()
        .map(|i| {
            let channels = (0..image.channels).map(|c| {
                let at = c * image.pixels() + i;
                relative_squared_error(image.data[at].into(), reference.data[at].into())
            });
            channels.sum::<f64>() / image.channels as f64
        })
        .collect()
}

/// RelMSE without the worst 0.1 % of pixels (rounded down): one firefly no longer decides it.
pub fn relmse_trimmed(image: &Planes, reference: &Planes) -> f64 {
    let mut errors = relmse_map(image, reference);
    let kept = errors.len() - (errors.len() as f64 * TRIMMED_SHARE) as usize;
    // Sorted, so that the order of summation is fixed.
    errors.par_sort_unstable_by(f64::total_cmp);
    errors[..kept].iter().sum::<f64>() / kept as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rgb(width: usize, values: &[f32]) -> Planes {
        Planes::from_vec(3, width, values.len() / 3 / width, values.to_vec())
    }

    #[test]
    fn known_values() {
        // One pixel: (2 - 1)^2 / 1.001, 0, (0.5 - 0)^2 / 0.001; mean of three.
        let (x, r) = (rgb(1, &[2.0, 3.0, 0.5]), rgb(1, &[1.0, 3.0, 0.0]));
        let expected = (1.0 / 1.001 + 0.0 + 0.25 / 0.001) / 3.0;
        assert!((relmse(&x, &r) - expected).abs() < 1e-12);
        assert!((rmse(&x, &r) - (1.25f64 / 3.0).sqrt()).abs() < 1e-12);
        assert_eq!(max_error(&x, &r), 1.0);
        let expected = (1.0 / 3.01 + 0.0 + 0.5 / 0.51) / 3.0;
        assert!((smape(&x, &r) - expected).abs() < 1e-12);
    }

    #[test]
    fn images_of_other_sizes_and_of_none_are_refused() {
        let (one, none) = (rgb(1, &[1.0; 3]), Planes::new(3, 0, 0));
        let two = rgb(2, &[1.0; 6]);
        let metrics: [fn(&Planes, &Planes) -> f64; 5] = [relmse, rmse, max_error, smape, relmse_trimmed];
        for (image, reference) in [(&one, &two), (&two, &one), (&none, &none)] {
            for metric in metrics {
                assert!(std::panic::catch_unwind(|| metric(image, reference)).is_err());
            }
            assert!(std::panic::catch_unwind(|| energy(image, reference)).is_err());
        }
    }

    #[test]
    fn epsilon_is_added_once_and_channels_are_averaged() {
        // A uniform error of 0.1 on black: 0.01 / 0.001 = 10 whatever the size.
        for pixels in [1, 7, 100] {
            let (x, r) = (rgb(pixels, &vec![0.1; 3 * pixels]), rgb(pixels, &vec![0.0; 3 * pixels]));
            assert!((relmse(&x, &r) - 10.0).abs() < 1e-5);
        }
    }

    #[test]
    fn trimmed_drops_exactly_the_worst_tenth_of_a_percent() {
        // 2000 pixels with error e^2 / 1.001: two fireflies go, the third worst stays.
        let r = rgb(2000, &vec![1.0; 6000]);
        let mut x = r.clone();
        for (pixel, offset) in [(0, 2.0), (700, 1000.0), (1999, 500.0)] {
            for c in 0..3 {
                x.channel_mut(c)[pixel] += offset;
            }
        }
        let expected = 4.0 / 1.001 / 1998.0;
        assert!((relmse_trimmed(&x, &r) - expected).abs() < 1e-9);
        let small = rgb(999, &vec![1.0; 2997]);
        let noisy = rgb(999, &vec![3.0; 2997]);
        assert!((relmse_trimmed(&noisy, &small) - relmse(&noisy, &small)).abs() < 1e-12, "none to drop");
    }
}
