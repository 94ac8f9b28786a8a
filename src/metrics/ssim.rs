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
    assert_eq!(image.extent(), reference.extent(), "SSIM compares images of one size");
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

/// The sum of SSIM over all windows of one plane, and its derivative by each pixel of `image`, for training.
///
/// # Panics
/// If the plane is smaller than the window.
pub fn slope(image: &[f32], reference: &[f32], width: usize) -> (f64, Vec<f32>) {
    let gaussian = weights().map(|w| w as f32);
    let moment = |of: fn(f32, f32) -> f32| {
        let values: Vec<f32> = image.iter().zip(reference).map(|(x, r)| of(*x, *r)).collect();
        windows(&values, width, &gaussian)
    };
    let (mut ux, ur) = (moment(|x, _| x), moment(|_, r| r));
    let (mut uxx, urr, mut uxr) = (moment(|x, _| x * x), moment(|_, r| r * r), moment(|x, r| x * r));
    let (c1, c2) = (C1 as f32, C2 as f32);
    let mut sum = 0.0;
    // Each moment that depends on x is replaced by the derivative of SSIM by that moment.
    for ((((ux, uxx), uxr), ur), urr) in ux.iter_mut().zip(&mut uxx).zip(&mut uxr).zip(&ur).zip(&urr) {
        let (vx, vr, vxr) = (*uxx - *ux * *ux, urr - ur * ur, *uxr - *ux * ur);
        let (a1, a2) = (2.0 * *ux * ur + c1, 2.0 * vxr + c2);
        let (b1, b2) = (*ux * *ux + ur * ur + c1, vx + vr + c2);
        let value = a1 * a2 / (b1 * b2);
        sum += f64::from(value);
        let mean = *ux;
        *ux = 2.0 * (ur * (a2 - a1) / (b1 * b2) + mean * value * (b2.recip() - b1.recip()));
        *uxx = -value / b2;
        *uxr = 2.0 * a1 / (b1 * b2);
    }
    let [ux, uxx, uxr] = [ux, uxx, uxr].map(|slope| spread(&slope, width, &gaussian));
    let pixels = image.iter().zip(reference).zip(ux).zip(uxx).zip(uxr);
    (sum, pixels.map(|((((x, r), ux), uxx), uxr)| ux + 2.0 * x * uxx + r * uxr).collect())
}

/// The weighted sum of each window of a plane. There are 10 fewer rows and columns of windows than of pixels.
fn windows(plane: &[f32], width: usize, weights: &[f32; WINDOW]) -> Vec<f32> {
    let (height, inner) = (plane.len() / width, width - 2 * RADIUS);
    let mut sums = vec![0.0; inner * (height - 2 * RADIUS)];
    let mut column = vec![0.0; width];
    for (y, sums) in sums.chunks_mut(inner).enumerate() {
        column.fill(0.0);
        for (row, weight) in plane[y * width..].chunks(width).zip(weights) {
            column.iter_mut().zip(row).for_each(|(sum, value)| *sum += weight * value);
        }
        for (dx, weight) in weights.iter().enumerate() {
            sums.iter_mut().zip(&column[dx..]).for_each(|(sum, value)| *sum += weight * value);
        }
    }
    sums
}

/// The transpose of [`windows`]: gives each pixel its share of the windows that it lies in.
fn spread(sums: &[f32], width: usize, weights: &[f32; WINDOW]) -> Vec<f32> {
    let inner = width - 2 * RADIUS;
    let mut plane = vec![0.0; width * (sums.len() / inner + 2 * RADIUS)];
    let mut column = vec![0.0; width];
    for (y, sums) in sums.chunks(inner).enumerate() {
        column.fill(0.0);
        for (dx, weight) in weights.iter().enumerate() {
            column[dx..].iter_mut().zip(sums).for_each(|(value, sum)| *value += weight * sum);
        }
        for (row, weight) in plane[y * width..].chunks_mut(width).zip(weights) {
            row.iter_mut().zip(&column).for_each(|(value, sum)| *value += weight * sum);
        }
    }
    plane
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

    #[test]
    fn slope_is_the_derivative() {
        let image = |seed: u32| -> Planes {
            let value = |i: u32| (i.wrapping_mul(2654435761).wrapping_add(seed) >> 8) % 1000;
            Planes::from_vec(1, 17, 14, (0..17 * 14).map(|i| value(i) as f32 / 999.0).collect())
        };
        let (x, r) = (image(5), image(77));
        let windows = 7.0 * 4.0;
        let (sum, slope) = slope(&x.data, &r.data, 17);
        assert!((sum / windows - ssim(&x, &r).unwrap()).abs() < 1e-5);
        // Corners, where few windows see a pixel, an edge and the middle.
        for at in [0, 16, 17 * 13, 17 * 14 - 1, 8, 17 * 7 + 8, 17 * 6 + 3] {
            let moved = |by: f32| {
                let mut x = x.clone();
                x.data[at] += by;
                windows * ssim(&x, &r).unwrap()
            };
            let want = (moved(1e-3) - moved(-1e-3)) / 2e-3;
            assert!(
                (f64::from(slope[at]) - want).abs() < 1e-3 * (1.0 + want.abs()),
                "{at}: {} {want}",
                slope[at]
            );
        }
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
