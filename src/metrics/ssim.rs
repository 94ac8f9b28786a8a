//! Structural similarity: Wang, Bovik, Sheikh, Simoncelli, "Image Quality Assessment: From Error
//! Visibility to Structural Similarity" (2004), per channel and averaged.
//!
//! As scikit-image's `structural_similarity(gaussian_weights=True, sigma=1.5,
//! use_sample_covariance=False, data_range=1, channel_axis=-1)` computes it: an 11x11 Gaussian
//! window, population covariance, and a border of the window's radius left out of the mean, so that
//! every window lies inside the image and no border rule matters.

use rayon::prelude::*;

use crate::planes::Planes;

/// Standard deviation of the window in pixels.
const SIGMA: f64 = 1.5;
/// Radius of the window: 3.5 sigma, rounded.
const RADIUS: usize = 5;
/// Side of the window; a smaller image has no SSIM.
pub const WINDOW: usize = 2 * RADIUS + 1;
/// `(K1 L)^2` with K1 = 0.01 and L = 1.
const C1: f64 = 1e-4;
/// `(K2 L)^2` with K2 = 0.03 and L = 1.
const C2: f64 = 9e-4;

/// Mean SSIM of two images in 0..1; none where they are smaller than the 11x11 window.
///
/// # Panics
/// If the sizes differ.
pub fn ssim(image: &Planes, reference: &Planes) -> Option<f64> {
    assert_eq!(
        (image.channels, image.width, image.height),
        (reference.channels, reference.width, reference.height),
        "SSIM compares images of one size"
    );
    if image.width < WINDOW || image.height < WINDOW {
        return None;
    }
    let rows = image.height - 2 * RADIUS;
    let sums: Vec<f64> = (0..image.channels * rows)
        .into_par_iter()
        .map_init(
            || Moments::new(image.width),
            |moments, i| {
                let (c, y) = (i / rows, i % rows);
                let window = |p: &Planes| y * p.width..(y + WINDOW) * p.width;
                moments.row_sum(&image.channel(c)[window(image)], &reference.channel(c)[window(reference)])
            },
        )
        .collect();
    Some(sums.iter().sum::<f64>() / (image.channels * rows * (image.width - 2 * RADIUS)) as f64)
}

/// The window's weights along one axis; they add up to one.
fn weights() -> [f64; WINDOW] {
    let raw: [f64; WINDOW] = std::array::from_fn(|i| {
        let distance = i as f64 - RADIUS as f64;
        (-0.5 * (distance / SIGMA).powi(2)).exp()
    });
    let sum: f64 = raw.iter().sum();
    raw.map(|w| w / sum)
}

/// Vertically filtered x, r, x^2, r^2, xr of one row: the window is separable.
struct Moments {
    weights: [f64; WINDOW],
    rows: [Vec<f64>; 5],
}

impl Moments {
    fn new(width: usize) -> Self {
        Self { weights: weights(), rows: std::array::from_fn(|_| vec![0.0; width]) }
    }

    /// The sum of SSIM over the pixels of the row in the middle of `x` and `r`, 11 rows of one plane.
    fn row_sum(&mut self, x: &[f32], r: &[f32]) -> f64 {
        let width = self.rows[0].len();
        let [sx, sr, sxx, srr, sxr] = &mut self.rows;
        for row in [&mut *sx, sr, sxx, srr, sxr] {
            row.fill(0.0);
        }
        for (dy, &weight) in self.weights.iter().enumerate() {
            let (x, r) = (&x[dy * width..][..width], &r[dy * width..][..width]);
            for i in 0..width {
                let (x, r) = (f64::from(x[i]), f64::from(r[i]));
                sx[i] += weight * x;
                sr[i] += weight * r;
                sxx[i] += weight * x * x;
                srr[i] += weight * r * r;
                sxr[i] += weight * x * r;
            }
        }
        let mut sum = 0.0;
        for at in 0..=width - WINDOW {
            let [ux, ur, uxx, urr, uxr] = self
                .rows
                .each_ref()
                .map(|row| row[at..][..WINDOW].iter().zip(&self.weights).map(|(v, w)| v * w).sum::<f64>());
            let (vx, vr, vxr) = (uxx - ux * ux, urr - ur * ur, uxr - ux * ur);
            sum += (2.0 * ux * ur + C1) * (2.0 * vxr + C2) / ((ux * ux + ur * ur + C1) * (vx + vr + C2));
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn known_values() {
        let flat = |v: f32| Planes::from_vec(1, 20, 13, vec![v; 260]);
        assert!((ssim(&flat(0.3), &flat(0.3)).unwrap() - 1.0).abs() < 1e-12);
        // Flat images have no variance: only the luminance term remains.
        let (a, b) = (f64::from(0.2f32), f64::from(0.8f32));
        let expected = (2.0 * a * b + C1) / (a * a + b * b + C1);
        assert!((ssim(&flat(0.2), &flat(0.8)).unwrap() - expected).abs() < 1e-9);
        assert_eq!(ssim(&Planes::new(3, 10, 50), &Planes::new(3, 10, 50)), None);
        assert!(ssim(&Planes::new(3, 11, 11), &Planes::new(3, 11, 11)).is_some());
    }

    #[test]
    fn weights_are_a_normalised_gaussian() {
        let w = weights();
        assert!((w.iter().sum::<f64>() - 1.0).abs() < 1e-15);
        // The ratio of neighbours at the centre of a Gaussian of sigma 1.5: exp(1 / 4.5).
        assert!((w[5] / w[6] - (1.0f64 / 4.5).exp()).abs() < 1e-12);
    }

    /// The definition, window by window: the oracle of the separable form.
    fn slow(x: &Planes, r: &Planes) -> f64 {
        let w = weights();
        let (mut sum, mut count) = (0.0, 0);
        for c in 0..x.channels {
            for y in RADIUS..x.height - RADIUS {
                for px in RADIUS..x.width - RADIUS {
                    let moment = |f: &dyn Fn(f64, f64) -> f64| -> f64 {
                        let window = (0..WINDOW).flat_map(|dy| (0..WINDOW).map(move |dx| (dy, dx)));
                        window
                            .map(|(dy, dx)| {
                                let at = (y + dy - RADIUS) * x.width + px + dx - RADIUS;
                                w[dy] * w[dx] * f(x.channel(c)[at].into(), r.channel(c)[at].into())
                            })
                            .sum()
                    };
                    let (ux, ur) = (moment(&|x, _| x), moment(&|_, r| r));
                    let vx = moment(&|x, _| (x - ux).powi(2));
                    let vr = moment(&|_, r| (r - ur).powi(2));
                    let vxr = moment(&|x, r| (x - ux) * (r - ur));
                    sum +=
                        (2.0 * ux * ur + C1) * (2.0 * vxr + C2) / ((ux * ux + ur * ur + C1) * (vx + vr + C2));
                    count += 1;
                }
            }
        }
        sum / f64::from(count)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn matches_the_definition(width in 11usize..20, height in 11usize..20, seed in 0u32..1000) {
            let image = |salt: u32| {
                let value = |i: u32| ((i.wrapping_mul(2654435761).wrapping_add(salt) >> 8) % 1000) as f32 / 999.0;
                Planes::from_vec(2, width, height, (0..(2 * width * height) as u32).map(value).collect())
            };
            let (x, r) = (image(seed.wrapping_mul(7919)), image(seed.wrapping_mul(104729) + 1));
            let fast = ssim(&x, &r).unwrap();
            prop_assert!((fast - slow(&x, &r)).abs() < 1e-10);
            prop_assert!((fast - ssim(&r, &x).unwrap()).abs() < 1e-12, "symmetric");
            prop_assert!(fast <= 1.0);
        }
    }
}
