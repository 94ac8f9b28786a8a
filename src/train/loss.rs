//! Training losses, on dfdx tensors of radiance, (N, 3, H, W).

use dfdx::{
    shapes::Rank0,
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
}

impl std::fmt::Display for Loss {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Loss::Relmse => "relmse",
            Loss::Smape => "smape",
        })
    }
}

impl Loss {
    /// Every loss, for the command line.
    pub const ALL: [Loss; 2] = [Loss::Relmse, Loss::Smape];

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
        let shape = *dfdx::shapes::HasShape::shape(&image);
        let device = Cpu::default();
        let pixels = shape.1 * shape.2 * shape.3;
        match self {
            Loss::Relmse => {
                let weight = reference
                    .iter()
                    .enumerate()
                    .map(|(i, r)| (r * r + RELMSE_EPSILON as f32 / scale[i / pixels].powi(2)).recip())
                    .collect::<Vec<_>>();
                let weight: Images = device.tensor_from_vec(weight, shape);
                let reference: Images = device.tensor_from_vec(reference, shape);
                (square(image - reference) * weight).mean()
            }
            Loss::Smape => {
                let floor = reference.iter().map(|r| r.abs() + SMAPE_EPSILON as f32).collect::<Vec<_>>();
                let floor: Images = device.tensor_from_vec(floor, shape);
                let reference: Images = device.tensor_from_vec(reference, shape);
                // Both branches need the image: the second starts an empty tape, merged by the division.
                let magnitude = abs(image.with_empty_tape()) + floor;
                (abs(image - reference) / magnitude).mean()
            }
        }
    }
}
