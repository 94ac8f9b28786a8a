//! Training losses, on dfdx tensors of radiance, (N, 3, H, W).

use dfdx::{
    shapes::{HasShape, Rank0},
    tensor::{Cpu, PutTape, SplitTape, Tape, Tensor, TensorFrom, TensorFromVec, WithEmptyTape},
    tensor_ops::{MeanTo, abs, square},
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{
    metrics::{
        display,
        error::{RELMSE_EPSILON, SMAPE_EPSILON},
        ssim,
    },
    models::network::Taped,
    nn::{self, Images},
    planes::Planes,
};

/// What training minimises.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Loss {
    /// The paper's Eq. 5, divided by three: mean of `(x - r)^2 / (r^2 + 0.001)`.
    Relmse,
    /// Symmetric mean absolute percentage error, `|x - r| / (|x| + |r| + 0.01)`: bounded, so that a
    /// firefly in input or reference weighs no more than another wrong pixel (Vogels et al. 2018).
    Smape,
    /// The sum of both: what RelMSE measures, with the steadier gradient of the bounded error.
    Both,
    /// The sum of [`Loss::Both`] and the error of the differences between neighbouring pixels, relative to
    /// their brightness. Steps in a smooth gradient and soft edges weigh little as errors of pixels, but are
    /// what people see first (and what SSIM measures).
    Edges,
    /// Mean over images of `ln(1 + RelMSE / 0.0002)`, as methods are compared by the geometric mean over
    /// scenes. In a plain mean the noisiest images count for nearly all, and what is left to gain on even
    /// walls for nothing.
    Geomean,
    /// The sum of [`Loss::Geomean`] and ten times `1 - SSIM` of what a display would show, at each image's
    /// exposure, against the clean reference. So 0.001 of SSIM counts as much as 1% of RelMSE.
    Ssim,
}

impl std::fmt::Display for Loss {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Loss::Relmse => "relmse",
            Loss::Smape => "smape",
            Loss::Both => "both",
            Loss::Edges => "edges",
            Loss::Geomean => "geomean",
            Loss::Ssim => "ssim",
        })
    }
}

impl Loss {
    /// Every loss, for the command line.
    pub const ALL: [Loss; 6] =
        [Loss::Relmse, Loss::Smape, Loss::Both, Loss::Edges, Loss::Geomean, Loss::Ssim];

    /// The least number of rows, and of columns, that an image must have for it.
    pub fn least_side(self) -> usize {
        if self == Loss::Ssim { ssim::WINDOW } else { 1 }
    }

    /// Whether it compares images as a display would show them; they must then be radiance, (N, 3, H, W).
    pub fn needs_radiance(self) -> bool {
        self == Loss::Ssim
    }

    /// The loss of `image` against `reference`, which has the same shape and scale.
    ///
    /// Where `raw` is given, squared errors are taken against it, with the denominators of `reference`. Noise
    /// in the target of a squared error does not change the gradient on average (Lehtinen et al. 2018,
    /// "Noise2Noise"), while noise in a denominator would; and what a denoiser got wrong in `reference` is
    /// not learned. `scale` is the ratio of scene radiance to network radiance of each image, since the
    /// epsilon of the relative error is meant in scene radiance.
    pub fn of(
        self,
        image: Images<Taped>,
        reference: Vec<f32>,
        raw: Option<Vec<f32>>,
        scale: &[f32],
    ) -> Tensor<Rank0, f32, Cpu, Taped> {
        match self {
            Loss::Relmse => relmse(image, &reference, raw, scale),
            Loss::Smape => smape(image, reference),
            Loss::Both => {
                let relative = relmse(image.with_empty_tape(), &reference, raw, scale);
                smape(image, reference) + relative
            }
            Loss::Edges => {
                let differences = edges(image.with_empty_tape(), &reference);
                Loss::Both.of(image, reference, raw, scale) + differences
            }
            Loss::Geomean => geomean(image, &reference, raw, scale),
            Loss::Ssim => {
                let dissimilarity = dissimilarity(image.with_empty_tape(), &reference);
                geomean(image, &reference, raw, scale) + dissimilarity * SSIM_WEIGHT
            }
        }
    }
}

/// A value of a raw reference, which may be a firefly, counts as at most this many times the clean value plus
/// one, in network radiance.
const RAW_LIMIT: f32 = 8.0;

/// The weight of `1 - SSIM` beside the logarithm of RelMSE.
const SSIM_WEIGHT: f32 = 10.0;

/// A RelMSE below which there is little left to gain.
const SMALL_ERROR: f32 = 2e-4;

fn relmse(
    image: Images<Taped>,
    reference: &[f32],
    raw: Option<Vec<f32>>,
    scale: &[f32],
) -> Tensor<Rank0, f32, Cpu, Taped> {
    let weight = weights(reference, scale);
    weighted_error(image, reference, raw, weight)
}

/// The gradient of the logarithm is that of a weighted error in which the weights of each image are divided
/// by the image's error. That error is taken against the clean reference, since the noise of a raw one would
/// make all images look equally bad.
fn geomean(
    image: Images<Taped>,
    reference: &[f32],
    raw: Option<Vec<f32>>,
    scale: &[f32],
) -> Tensor<Rank0, f32, Cpu, Taped> {
    let (images, values) = (scale.len(), reference.len() / scale.len());
    let mut weight = weights(reference, scale);
    let image_values = nn::values_of(&image);
    let logarithms = weight.par_chunks_mut(values).enumerate().map(|(n, weight)| {
        let of_image = n * values..(n + 1) * values;
        let pixels = image_values[of_image.clone()].iter().zip(&reference[of_image]).zip(&*weight);
        let sum: f64 = pixels.map(|((x, r), w)| f64::from((x - r) * (x - r) * w)).sum();
        let error = (sum / values as f64) as f32;
        weight.iter_mut().for_each(|w| *w /= error + SMALL_ERROR);
        (error / SMALL_ERROR).ln_1p()
    });
    let logarithms: Vec<f32> = logarithms.collect(); // in the order of images, whatever the threads do
    let loss = weighted_error(image, reference, raw, weight);
    // Adding a constant keeps the gradient and gives the loss the value of the logarithm.
    let value = logarithms.iter().sum::<f32>() / images as f32;
    let shift = value - loss.as_vec()[0];
    loss + shift
}

/// The weights of squared errors: the inverse of `r^2 + 0.001` in scene radiance.
fn weights(reference: &[f32], scale: &[f32]) -> Vec<f32> {
    let of_image = reference.chunks(reference.len() / scale.len()).zip(scale);
    of_image
        .flat_map(|(reference, scale)| {
            let epsilon = RELMSE_EPSILON as f32 / scale.powi(2);
            reference.iter().map(move |r| (r * r + epsilon).recip())
        })
        .collect()
}

/// The mean of weighted squared errors against the raw reference, if there is one.
fn weighted_error(
    image: Images<Taped>,
    reference: &[f32],
    raw: Option<Vec<f32>>,
    weight: Vec<f32>,
) -> Tensor<Rank0, f32, Cpu, Taped> {
    let (device, shape) = (Cpu::default(), *image.shape());
    let weight: Images = device.tensor_from_vec(weight, shape);
    let target = match raw {
        Some(raw) => raw.iter().zip(reference).map(|(raw, r)| raw.min(RAW_LIMIT * r + 1.0)).collect(),
        None => reference.to_vec(),
    };
    let target: Images = device.tensor_from_vec(target, shape);
    (square(image - target) * weight).mean()
}

fn smape(image: Images<Taped>, reference: Vec<f32>) -> Tensor<Rank0, f32, Cpu, Taped> {
    let (device, shape) = (Cpu::default(), *image.shape());
    let floor = reference.iter().map(|r| r.abs() + SMAPE_EPSILON as f32).collect();
    let floor: Images = device.tensor_from_vec(floor, shape);
    let reference: Images = device.tensor_from_vec(reference, shape);
    // Both branches need the image: this one starts an empty tape, merged by the division.
    let magnitude = abs(image.with_empty_tape()) + floor;
    (abs(image - reference) / magnitude).mean()
}

/// Mean over neighbours p and q, in rows and in columns, of `|(x_p - x_q) - (r_p - r_q)| / (|r_p| + |r_q| +
/// 0.01)`.
fn edges(image: Images<Taped>, reference: &[f32]) -> Tensor<Rank0, f32, Cpu, Taped> {
    let &(n, c, h, w) = image.shape();
    let pairs = n * c * (h * (w - 1) + (h - 1) * w);
    mean_of_planes(image, reference, pairs, |_, x, r| {
        let (mut sum, mut slope) = (0.0f64, vec![0.0f32; x.len()]);
        let mut add = |p: usize, q: usize| {
            let error = (x[p] - x[q]) - (r[p] - r[q]);
            let weight = (r[p].abs() + r[q].abs() + SMAPE_EPSILON as f32).recip();
            sum += f64::from(error.abs() * weight);
            let step = if error == 0.0 { 0.0 } else { weight.copysign(error) };
            slope[p] += step;
            slope[q] -= step;
        };
        for at in 0..h * w {
            if at % w + 1 < w {
                add(at, at + 1);
            }
            if at / w + 1 < h {
                add(at, at + w);
            }
        }
        (sum, slope)
    })
}

/// Mean of `1 - SSIM` of the images as a display would show them at the exposure of their references; 0 where
/// a reference is black.
fn dissimilarity(image: Images<Taped>, reference: &[f32]) -> Tensor<Rank0, f32, Cpu, Taped> {
    let &(n, c, h, w) = image.shape();
    let exposures: Vec<Option<f64>> = reference
        .chunks(c * h * w)
        .map(|reference| display::exposure(&Planes::from_vec(c, w, h, reference.to_vec())))
        .collect();
    let windows = (h + 1 - ssim::WINDOW) * (w + 1 - ssim::WINDOW);
    mean_of_planes(image, reference, n * c * windows, |plane, x, r| {
        let Some(exposure) = exposures[plane / c] else {
            return (0.0, vec![0.0; x.len()]);
        };
        let [shown, wanted] =
            [x, r].map(|v| v.iter().map(|v| display::encode(*v, exposure)).collect::<Vec<f32>>());
        let (sum, mut slope) = ssim::slope(&shown, &wanted, w);
        slope.iter_mut().zip(x).for_each(|(slope, x)| *slope *= -display::encode_slope(*x, exposure));
        (windows as f64 - sum, slope)
    })
}

/// A sum over all planes, divided by `count`, as one operation on the tape. From the index of a plane, its
/// image and its reference, `of` makes the plane's share of the sum and its gradient by the image's pixels.
fn mean_of_planes(
    image: Images<Taped>,
    reference: &[f32],
    count: usize,
    of: impl Fn(usize, &[f32], &[f32]) -> (f64, Vec<f32>) + Sync,
) -> Tensor<Rank0, f32, Cpu, Taped> {
    let (image, mut tape) = image.split_tape();
    let &(_, _, h, w) = image.shape();
    let values = nn::values_of(&image);
    let planes = values.par_chunks(h * w).zip(reference.par_chunks(h * w)).enumerate();
    let (sums, slopes): (Vec<f64>, Vec<Vec<f32>>) = planes.map(|(plane, (x, r))| of(plane, x, r)).unzip();
    // In the order of planes, whatever the threads do.
    let mean = (sums.iter().sum::<f64>() / count as f64) as f32;
    let loss: Tensor<Rank0, f32, Cpu> = Cpu::default().tensor(mean);
    let (of_image, of_loss) = (image, loss.clone());
    tape.add_backward_op(move |gradients| {
        let scale = gradients.get_or_alloc_mut(&of_loss)?[0] / count as f32;
        let into = gradients.get_or_alloc_mut(&of_image)?;
        into.iter_mut().zip(slopes.iter().flatten()).for_each(|(into, slope)| *into += scale * slope);
        Ok(())
    });
    loss.put_tape(tape)
}

#[cfg(test)]
mod tests {
    use dfdx::{
        tensor::{AsArray, Trace},
        tensor_ops::Backward,
    };

    use super::*;
    use crate::rng::Rng;

    /// The loss of a flat image of `value` and its mean gradient by a pixel, against a flat clean reference
    /// of 0.5 and, if there is one, a raw one.
    fn relmse_at(value: f32, raw: Option<Vec<f32>>) -> (f32, f32) {
        const SHAPE: (usize, usize, usize, usize) = (1, 3, 16, 16);
        let count = 3 * 16 * 16;
        let image: Images = Cpu::default().tensor_from_vec(vec![value; count], SHAPE);
        let loss = Loss::Relmse.of(image.leaky_trace(), vec![0.5; count], raw, &[1.0]);
        let value = loss.array();
        (value, loss.backward().get(&image).as_vec().iter().sum())
    }

    #[test]
    fn noise_in_a_raw_reference_changes_no_gradient_on_average() {
        let mut rng = Rng::new(3, 1);
        // Skewed as render noise is: a tenth of the pixels holds all the light.
        let mut raw: Vec<f32> =
            (0..3 * 16 * 16).map(|_| if rng.below(10) == 0 { 3.5 } else { 0.15 }).collect();
        let mean = raw.iter().sum::<f32>() / raw.len() as f32;
        raw.iter_mut().for_each(|v| *v *= 0.5 / mean);
        assert!(raw.iter().all(|v| *v < RAW_LIMIT * 0.5 + 1.0), "nothing is clipped");
        let (clean_loss, clean) = relmse_at(0.7, None);
        let (noisy_loss, noisy) = relmse_at(0.7, Some(raw));
        assert!((clean - noisy).abs() < 1e-3 * clean.abs(), "{clean} and {noisy}");
        assert!(noisy_loss > 2.0 * clean_loss, "noise adds to the loss itself");
        assert!(((0.2f32.powi(2) / (0.25 + RELMSE_EPSILON as f32)) - clean_loss).abs() < 1e-5);
    }

    #[test]
    fn the_geometric_mean_weighs_every_image_by_its_own_error() {
        const SHAPE: (usize, usize, usize, usize) = (2, 3, 8, 8);
        let count = 3 * 8 * 8;
        // Off by 0.2 and by 0.02, of 0.5.
        let values = [vec![0.7; count], vec![0.52; count]].concat();
        let image: Images = Cpu::default().tensor_from_vec(values, SHAPE);
        let loss = |raw| Loss::Geomean.of(image.leaky_trace(), vec![0.5; 2 * count], raw, &[1.0, 1.0]);
        let errors = [0.2f64, 0.02].map(|e| e * e / (0.25 + RELMSE_EPSILON) + f64::from(SMALL_ERROR));
        let want = errors.map(|e| (e / f64::from(SMALL_ERROR)).ln()).iter().sum::<f64>() / 2.0;
        let value = f64::from(loss(None).array());
        assert!((value - want).abs() < 1e-4, "{value}, not {want}");
        let gradients = loss(None).backward().get(&image).as_vec();
        let sums = [&gradients[..count], &gradients[count..]].map(|g| f64::from(g.iter().sum::<f32>()));
        for ((sum, error), off) in sums.into_iter().zip(errors).zip([0.2, 0.02]) {
            let want = 2.0 * off / (0.25 + RELMSE_EPSILON) / error / 2.0;
            assert!((sum - want).abs() < 1e-3 * want, "{sum}, not {want}");
        }
        // A raw reference that errs by chance on either side changes the value's gradient in neither image.
        let raw = (0..2 * count).map(|i| if i % 2 == 0 { 0.9 } else { 0.1 }).collect();
        let noisy = loss(Some(raw)).backward().get(&image).as_vec();
        for (clean, noisy) in gradients.chunks(count).zip(noisy.chunks(count)) {
            let [clean, noisy] = [clean, noisy].map(|g| g.iter().sum::<f32>());
            assert!((clean - noisy).abs() < 1e-3 * clean, "{clean} and {noisy}");
        }
    }

    #[test]
    fn similarity_is_that_of_the_metric_and_its_gradient_leads_uphill() {
        const SHAPE: (usize, usize, usize, usize) = (2, 3, 16, 13);
        let count = 2 * 3 * 16 * 13;
        let mut rng = Rng::new(4, 1);
        let mut noise = |size: f32| -> Vec<f32> { (0..count).map(|_| 0.2 + size * rng.uniform()).collect() };
        let (values, reference) = (noise(0.3), noise(0.2));
        let at = |values: &[f32]| {
            let image: Images = Cpu::default().tensor_from_vec(values.to_vec(), SHAPE);
            let loss = dissimilarity(image.leaky_trace(), &reference);
            let value = loss.array();
            (value, loss.backward().get(&image).as_vec())
        };
        let want = (0..2).map(|n| {
            let [x, r] = [&values, &reference]
                .map(|v| Planes::from_vec(3, 13, 16, v[n * count / 2..][..count / 2].to_vec()));
            let exposure = display::exposure(&r).unwrap();
            1.0 - ssim::ssim(&display::display(&x, exposure), &display::display(&r, exposure)).unwrap()
        });
        let (value, slope) = at(&values);
        assert!((f64::from(value) - want.sum::<f64>() / 2.0).abs() < 1e-5);
        let moved: Vec<f32> = values.iter().zip(&slope).map(|(v, s)| v - 0.05 * s).collect();
        let fall = 0.05 * slope.iter().map(|s| s * s).sum::<f32>();
        assert!((value - at(&moved).0 - fall).abs() < 0.05 * fall, "{} for {fall}", value - at(&moved).0);
        let black: Images = Cpu::default().tensor_from_vec(vec![0.0; count], SHAPE);
        assert_eq!(Loss::Ssim.of(black.leaky_trace(), vec![0.0; count], None, &[1.0; 2]).array(), 0.0);
    }

    #[test]
    fn gradients_of_all_losses_are_their_slopes() {
        const SHAPE: (usize, usize, usize, usize) = (2, 3, 12, 13);
        let count = 2 * 3 * 12 * 13;
        let mut rng = Rng::new(5, 1);
        let mut random = |from: f32, to: f32| -> Vec<f32> {
            (0..count).map(|_| from + (to - from) * rng.uniform()).collect()
        };
        let (values, reference) = (random(0.1, 0.6), random(0.1, 0.6));
        let directions = [random(-1.0, 1.0), random(-1.0, 1.0), random(-1.0, 1.0)];
        for loss in Loss::ALL {
            let at = |values: &[f32]| {
                let image: Images = Cpu::default().tensor_from_vec(values.to_vec(), SHAPE);
                let loss = loss.of(image.leaky_trace(), reference.clone(), None, &[0.5, 2.0]);
                (f64::from(loss.array()), loss.backward().get(&image).as_vec())
            };
            let slope = at(&values).1;
            for direction in &directions {
                let moved =
                    |by: f32| -> Vec<f32> { values.iter().zip(direction).map(|(v, d)| v + by * d).collect() };
                // Short, as absolute values have kinks.
                let step = 4e-4f32;
                let numeric = (at(&moved(step)).0 - at(&moved(-step)).0) / (2.0 * f64::from(step));
                let dot = |v: &[f32], w: &[f32]| -> f64 {
                    v.iter().zip(w).map(|(v, w)| f64::from(*v) * f64::from(*w)).sum()
                };
                let analytic = dot(&slope, direction);
                let size = (dot(&slope, &slope) * dot(direction, direction) / count as f64).sqrt();
                assert!((numeric - analytic).abs() < 0.05 * size, "{loss}: {numeric}, not {analytic}");
            }
        }
    }

    #[test]
    fn losses_are_the_metrics_of_images_in_any_scale() {
        const SHAPE: (usize, usize, usize, usize) = (1, 3, 8, 8);
        let mut rng = Rng::new(6, 1);
        // So dark that the metrics' constants count.
        let mut dark = || -> Vec<f32> { (0..3 * 8 * 8).map(|_| 0.03 * rng.uniform()).collect() };
        let (image, reference) = (dark(), dark());
        let planes = |values: &[f32]| Planes::from_vec(3, 8, 8, values.to_vec());
        let want = crate::metrics::error::relmse(&planes(&image), &planes(&reference));
        for scale in [0.1, 1.0, 7.0] {
            let scaled = |values: &[f32]| -> Vec<f32> { values.iter().map(|v| v / scale).collect() };
            let in_scale: Images = Cpu::default().tensor_from_vec(scaled(&image), SHAPE);
            let loss = |loss: Loss| {
                f64::from(loss.of(in_scale.leaky_trace(), scaled(&reference), None, &[scale]).array())
            };
            assert!((loss(Loss::Relmse) - want).abs() < 1e-4 * want, "{scale}");
            let logarithm = (want / f64::from(SMALL_ERROR)).ln_1p();
            assert!((loss(Loss::Geomean) - logarithm).abs() < 1e-4 * logarithm, "{scale}");
        }
    }

    #[test]
    fn a_firefly_in_a_raw_reference_is_clipped() {
        let count = 3 * 16 * 16;
        let with = |firefly: f32| {
            let mut raw = vec![0.5; count];
            raw[7] = firefly;
            relmse_at(0.5, Some(raw)).1
        };
        assert_eq!(with(1e6), with(1e3));
        assert!(with(1e3) < with(2.0), "it still pulls upwards");
    }
}
