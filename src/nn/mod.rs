//! Differentiable image operations on dfdx's tape, over [`crate::kernels`].
//!
//! dfdx 0.13 has no convolution on stable Rust, so these operations are demc's own. An
//! [`Activation`] keeps its values in the kernels' blocked layout from the first layer to the last
//! and carries a dfdx tape; parameters, losses and the optimiser are ordinary dfdx tensors.

mod activation;
mod arithmetic;
mod cross_bilateral;
mod field;
mod layers;
mod line;
mod param;
mod pool;
pub mod weights;

pub use activation::Activation;
pub use arithmetic::{Arithmetic, Precision};
pub use cross_bilateral::{GuidedImages, cross_bilateral};
pub use field::Field;
pub use layers::{BatchNorm, BatchStats, Conv, MaxPool, Stats};
pub use line::{Line, Rows};
pub use param::{Init, Param, values_of};
pub use pool::clear as clear_buffers;

use dfdx::tensor::Cpu;

/// A dfdx tensor of images, (N, C, H, W).
pub type Images<T = dfdx::tensor::NoneTape> = dfdx::tensor::Tensor<(usize, usize, usize, usize), f32, Cpu, T>;
