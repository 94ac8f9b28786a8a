//! Training losses, on dfdx tensors of radiance, (N, 3, H, W).

use dfdx::{
    shapes::{HasShape, Rank0},
    tensor::{Cpu, PutTape, SplitTape, Tape, Tensor, TensorFrom, TensorFromVec, WithEmptyTape},
    tensor_ops::{MeanTo, abs, square},
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{
    metrics::error::{RELMSE_EPSILON, SMAPE_EPSILON},
    models::network::Taped,
    nn::Images,
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
    /// [`Loss::Both`] and the error of the differences between neighbouring pixels, relative to their
    /// brightness: steps in a smooth gradient and soft edges weigh little as errors of pixels, but are what
    /// people see first (and what SSIM measures).
    Edges,
}

impl std::fmt::Display for Loss {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Loss::Relmse => "relmse",
            Loss::Smape => "smape",
            Loss::Both => "both",
            Loss::Edges => "edges",
        })
    }
}

impl Loss {
    /// Every loss, for the command line.
    pub const ALL: [Loss; 4] = [Loss::Relmse, Loss::Smape, Loss::Both, Loss::Edges];

    /// The loss of `image` against `reference`, same shape and scale.
    ///
    /// Squared errors are against `raw` where it is given, with the denominators of `reference`: noise in the
    /// target of a squared error changes no gradient on average (Lehtinen et al. 2018, "Noise2Noise"), which
    /// noise in a denominator would, and what a denoiser got wrong in `reference` is not learned. `scale` is
    /// each image's scene radiance over network radiance: the epsilon of the relative error is meant in scene
    /// radiance.
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
        }
    }
}

/// A firefly in a raw reference counts as this many times the clean one at most (and one more, in network
/// radiance, where that is dark).
const RAW_LIMIT: f32 = 8.0;

fn relmse(
    image: Images<Taped>,
    reference: &[f32],
    raw: Option<Vec<f32>>,
    scale: &[f32],
) -> Tensor<Rank0, f32, Cpu, Taped> {
    let (device, shape) = (Cpu::default(), *image.shape());
    let values = shape.1 * shape.2 * shape.3;
    let weight: Vec<f32> = reference
        .iter()
        .enumerate()
        .map(|(i, r)| (r * r + RELMSE_EPSILON as f32 / scale[i / values].powi(2)).recip())
        .collect();
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
/// 0.01)`: one operation on the tape, since dfdx's slices do not add up their gradients.
fn edges(image: Images<Taped>, reference: &[f32]) -> Tensor<Rank0, f32, Cpu, Taped> {
    let (image, mut tape) = image.split_tape();
    let &(n, c, h, w) = image.shape();
    let values = image.as_vec();
    let pairs = n * c * (h * (w - 1) + (h - 1) * w);
    let mut slope = vec![0.0f32; values.len()];
    // Each plane by itself: the sum of its terms, and the gradient of that sum.
    let sums = slope.par_chunks_mut(h * w).enumerate().map(|(plane, slope)| {
        let (x, r) = (&values[plane * h * w..][..h * w], &reference[plane * h * w..][..h * w]);
        let mut sum = 0.0f64;
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
        sum
    });
    let sums: Vec<f64> = sums.collect(); // in the order of planes, whatever the threads do
    let mean = (sums.iter().sum::<f64>() / pairs as f64) as f32;
    let loss: Tensor<Rank0, f32, Cpu> = Cpu::default().tensor(mean);
    let (of_image, of_loss) = (image, loss.clone());
    tape.add_backward_op(move |gradients| {
        let scale = gradients.get_or_alloc_mut(&of_loss)?[0] / pairs as f32;
        let into = gradients.get_or_alloc_mut(&of_image)?;
        into.iter_mut().zip(&slope).for_each(|(into, slope)| *into += scale * slope);
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
    use crate::nn::Rng;

    /// The loss of a flat image of `value` and its mean gradient by a pixel, against a flat clean reference of
    /// 0.5 and, if there is one, a raw one.
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
