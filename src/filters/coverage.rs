//! Takes back what denoising changed of a share, such as alpha, beyond its noise.
//!
//! Shares are averaged by the beauty's kernels, which know nothing of them where the beauty is black, as along the
//! edge of a dark thing. But a share is the mean of a pixel's samples, each
//! between 0 and 1, so its noise is known: of `n` independent samples of a mean of `d` the variance is at most
//! `d (1 - d) / n`, and of samples spread evenly over a pixel that an edge crosses it falls with `n^1.5`. What a
//! share was changed by is compared with that, over the pixels around. The denoised share `d` and the rendered one
//! `r` are mixed as `d + w (r - d)`, where `w` is what the noise does not explain of the mean of `(r - d)^2`.

use rayon::prelude::*;

use super::box_mean;
use crate::planes::Planes;

/// Rows and columns to each side over which noise and change are averaged.
const REACH: usize = 3;

/// Squared change below which none is seen.
const LEAST_CHANGE: f32 = 1e-12;

/// What `d (1 - d)` is multiplied by to be the variance of a share.
fn scale(samples: f32) -> f32 {
    samples.powf(-1.5)
}

/// Mixes a denoised share, (C, H, W), with what was rendered of it in `samples` samples a pixel.
///
/// # Panics
/// If sizes differ.
pub fn take_back(denoised: &mut Planes, rendered: &Planes, samples: f32) {
    let size = (denoised.width, denoised.height);
    let pixels = size.0 * size.1;
    assert_eq!(denoised.data.len(), rendered.data.len(), "planes of one frame");
    let scale = scale(samples);
    for (clean, noisy) in denoised.data.chunks_mut(pixels).zip(rendered.data.chunks(pixels)) {
        let noise: Vec<f32> = clean.par_iter().map(|d| d.clamp(0.0, 1.0)).map(|d| d * (1.0 - d)).collect();
        let change: Vec<f32> = clean.par_iter().zip(noisy).map(|(d, r)| (r - d) * (r - d)).collect();
        clean.par_chunks_mut(size.0).zip(noisy.par_chunks(size.0)).enumerate().for_each(
            |(y, (clean, noisy))| {
                let [mut of_noise, mut of_change] = [(); 2].map(|()| vec![0.0; size.0]);
                box_mean::row(&noise, size, y, REACH, &mut of_noise);
                box_mean::row(&change, size, y, REACH, &mut of_change);
                for (x, (d, r)) in clean.iter_mut().zip(noisy).enumerate() {
                    let explained = scale * of_noise[x] / of_change[x].max(LEAST_CHANGE);
                    *d += (1.0 - explained).max(0.0) * (r - *d);
                }
            },
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    const SIZE: (usize, usize) = (64, 48);

    /// A ramp, sampled `n` times a pixel as evenly as Cycles does.
    fn sampled(n: f32) -> [Planes; 2] {
        let mut rng = Rng::new(5, 0);
        let truth = Planes::from_rows(1, SIZE, |_, _, row| {
            row.iter_mut().enumerate().for_each(|(x, v)| *v = x as f32 / 64.0);
        });
        let mut noisy = truth.clone();
        for v in noisy.data.iter_mut() {
            let deviation = (scale(n) * *v * (1.0 - *v)).sqrt();
            *v = (*v + 12f32.sqrt() * deviation * (rng.uniform() - 0.5)).clamp(0.0, 1.0);
        }
        [truth, noisy]
    }

    fn error(a: &Planes, b: &Planes) -> f32 {
        a.data.iter().zip(&b.data).map(|(a, b)| (a - b) * (a - b)).sum::<f32>() / a.data.len() as f32
    }

    #[test]
    fn noise_goes_and_blurred_edges_come_back() {
        for n in [1.0, 4.0, 64.0] {
            let [truth, noisy] = sampled(n);
            let mut denoised = truth.clone();
            take_back(&mut denoised, &noisy, n);
            assert!(error(&denoised, &truth) < 0.1 * error(&noisy, &truth), "{n}: noise is back");
            // What was made of it has nothing to do with it.
            let mut washed = Planes::from_vec(1, SIZE.0, SIZE.1, vec![0.5; SIZE.0 * SIZE.1]);
            take_back(&mut washed, &noisy, n);
            let at = |planes: &Planes| error(planes, &truth);
            assert!(at(&washed) < 1.2 * at(&noisy), "{n}: {} of {}", at(&washed), at(&noisy));
        }
        // What is covered all around, or not at all, stays.
        let whole = Planes::from_vec(1, 4, 4, vec![1.0; 16]);
        let mut denoised = whole.clone();
        take_back(&mut denoised, &whole, 16.0);
        assert_eq!(denoised, whole);
    }
}
