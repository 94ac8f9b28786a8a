//! Parameters: named dfdx tensors with a shape, and how they begin.

use dfdx::{
    shapes::{HasShape, Shape},
    tensor::{Cpu, Tensor, TensorFromVec},
};

use crate::rng::Rng;

/// A parameter of a layer: a dfdx tensor, flat, with its logical shape beside it.
#[derive(Clone, Debug)]
pub struct Param {
    /// Its path in the network, `decoder.0.up.weight`.
    pub name: String,
    /// Its logical shape, for example (O, I, 3, 3).
    pub shape: Vec<usize>,
    /// Whether the optimiser changes it; running statistics are not trainable.
    pub trainable: bool,
    /// Whether it is the weight of a layer between others: a matrix of outputs by inputs and taps.
    pub hidden: bool,
    /// Its values, row-major.
    pub tensor: Tensor<(usize,), f32, Cpu>,
}

impl Param {
    /// A parameter from its first values.
    ///
    /// # Panics
    /// If the number of values is not what the shape demands.
    pub fn new(device: &Cpu, name: String, shape: &[usize], values: Vec<f32>) -> Self {
        assert_eq!(values.len(), shape.iter().product::<usize>(), "{name} has shape {shape:?}");
        let len = (values.len(),);
        let tensor = device.tensor_from_vec(values, len);
        Self { name, shape: shape.into(), trainable: true, hidden: false, tensor }
    }

    /// A copy that is another tensor: neither gradients nor moments are shared.
    pub fn duplicate(&self) -> Self {
        let Self { name, shape, trainable, hidden, .. } = self.clone();
        Self { trainable, hidden, ..Self::new(self.tensor.device(), name, &shape, self.values()) }
    }

    /// Its values, row-major.
    pub fn values(&self) -> Vec<f32> {
        values_of(&self.tensor)
    }

    /// Replaces its values, keeping the tensor's identity (optimiser moments stay attached).
    ///
    /// # Panics
    /// If the number of values differs.
    pub fn set(&mut self, values: &[f32]) {
        self.tensor.copy_from(values);
    }
}

/// The values of a tensor whose values lie in order, as those of all here do, in one copy: dfdx's `as_vec` finds the
/// place of each.
pub fn values_of<S: Shape, T>(tensor: &Tensor<S, f32, Cpu, T>) -> Vec<f32> {
    let mut values = vec![0.0; tensor.shape().num_elements()];
    tensor.copy_into(&mut values);
    values
}

/// How the weights of a convolution begin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Init {
    /// Glorot and Bengio 2010: uniform, variance 2 / (fan in + fan out).
    Xavier,
    /// The paper's Eq. 3: `[I I I]`, each source copied to the output and summed.
    Identities,
    /// Bilinear upsampling, channel by channel, as the paper begins its transposed convolutions.
    Bilinear,
    /// [`Init::Xavier`] times a factor: heads begin near zero.
    Scaled(f32),
}

impl Init {
    /// Weights for `inputs` (channels of each source) and `outputs`, k x k taps; `(O, I, k, k)`, or
    /// `(I, O, 4, 4)` for [`Init::Bilinear`].
    pub fn weights(self, rng: &mut Rng, inputs: &[usize], outputs: usize, k: usize) -> Vec<f32> {
        let total: usize = inputs.iter().sum();
        let taps = k * k;
        let mut w = vec![0.0; total * outputs * taps];
        match self {
            Init::Xavier | Init::Scaled(_) => {
                let gain = if let Init::Scaled(s) = self { s } else { 1.0 };
                let limit = gain * (6.0 / ((total + outputs) * taps) as f32).sqrt();
                w.iter_mut().for_each(|w| *w = limit * (2.0 * rng.uniform() - 1.0));
            }
            Init::Identities => {
                let mut first = 0;
                for &c in inputs {
                    for o in 0..outputs.min(c) {
                        w[(o * total + first + o) * taps + taps / 2] = 1.0;
                    }
                    first += c;
                }
            }
            Init::Bilinear => {
                // Where the channel count falls, an output averages the inputs that fold onto it.
                let line = [0.25, 0.75, 0.75, 0.25];
                let fold = total.div_ceil(outputs) as f32;
                for i in 0..total {
                    for t in 0..taps {
                        w[(i * outputs + i % outputs) * taps + t] = line[t / 4] * line[t % 4] / fold;
                    }
                }
            }
        }
        w
    }
}
