//! Training losses, on dfdx tensors of radiance, (N, 3, H, W).

use dfdx::{
    shapes::{HasShape, Rank0},
    tensor::{Cpu, Tensor, TensorFromVec, WithEmptyTape},
    tensor_ops::{MeanTo, abs, square},
};
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
}

impl std::fmt::Display for Loss {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Loss::Relmse => "relmse",
            Loss::Smape => "smape",
            Loss::Both => "both",
        })
    }
}

impl Loss {
    /// Every loss, for the command line.
    pub const ALL: [Loss; 3] = [Loss::Relmse, Loss::Smape, Loss::Both];

    /// The loss of `image` against `reference`, same shape and scale.
    ///
    /// `scale` is each image's scene radiance over network radiance: the epsilon of the relative error
    /// is meant in scene radiance.
    pub fn of(
        self,
        image: Images<Taped>,
        reference: Vec<f32>,
        scale: &[f32],
    ) -> Tensor<Rank0, f32, Cpu, Taped> {
        match self {
            Loss::Relmse => relmse(image, reference, scale),
            Loss::Smape => smape(image, reference),
            Loss::Both => {
                let relative = relmse(image.with_empty_tape(), reference.clone(), scale);
                smape(image, reference) + relative
            }
        }
    }
}

fn relmse(image: Images<Taped>, reference: Vec<f32>, scale: &[f32]) -> Tensor<Rank0, f32, Cpu, Taped> {
    let (device, shape) = (Cpu::default(), *image.shape());
    let values = shape.1 * shape.2 * shape.3;
    let weight: Vec<f32> = reference
        .iter()
        .enumerate()
        .map(|(i, r)| (r * r + RELMSE_EPSILON as f32 / scale[i / values].powi(2)).recip())
        .collect();
    let weight: Images = device.tensor_from_vec(weight, shape);
    let reference: Images = device.tensor_from_vec(reference, shape);
    (square(image - reference) * weight).mean()
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
