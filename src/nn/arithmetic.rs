//! A convolution and its gradients in either precision: what the layers' passes call.

use serde::{Deserialize, Serialize};

use super::{activation::Data, pool::Buffer};
use crate::kernels::{
    Block, Shape, View, ViewMut,
    bf16::{self, Engine, Operand},
    conv::{self, Direction, Epilogue, Geometry},
    simd::Tier,
    weight_grad,
};

/// What the factors of a convolution are rounded to; sums are always f32.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// Not at all.
    F32,
    /// To bfloat16 (8 bits of mantissa), as matrix units want them.
    Bf16,
}

impl Precision {
    /// The faster one on this processor.
    pub fn fastest() -> Self {
        if Engine::detect().is_native() { Self::Bf16 } else { Self::F32 }
    }
}

/// Forward weights in one precision.
#[derive(Debug)]
pub(super) enum Packed {
    F32(Vec<Block>),
    Bf16(bf16::conv::Weights),
}

/// What a convolution is, apart from its weights.
#[derive(Clone, Debug)]
pub struct Arithmetic {
    /// Channels of every source.
    pub inputs: Vec<usize>,
    /// Channels of the output.
    pub outputs: usize,
    /// Kernel size and stride.
    pub geometry: Geometry,
    /// What factors are rounded to.
    pub precision: Precision,
}

impl Arithmetic {
    /// Weights as [`Arithmetic::forward`] wants them.
    pub(super) fn pack(&self, weights: &[f32]) -> Packed {
        let Self { inputs, outputs, geometry, .. } = self;
        match self.precision {
            Precision::F32 => {
                let mut packed = vec![Block::default(); conv::packed_len(inputs, *outputs, *geometry)];
                conv::pack(weights, inputs, *outputs, *geometry, Direction::Forward, 0, &mut packed);
                Packed::F32(packed)
            }
            Precision::Bf16 => {
                let forward = Direction::Forward;
                Packed::Bf16(bf16::conv::Weights::pack(weights, inputs, *outputs, *geometry, forward, 0))
            }
        }
    }

    /// `relu(bias + conv(sources, weights))`, the ReLU only where asked for; an output that is to be rounded
    /// stays bfloat16 where the arithmetic is.
    pub(super) fn forward(
        &self,
        sources: &[&Data],
        weights: &Packed,
        bias: &[Block],
        relu: bool,
        (shape, round): (Shape, bool),
    ) -> Data {
        let epilogue = Epilogue { relu, accumulate: false };
        match weights {
            Packed::F32(weights) => {
                let mut output = Buffer::new(shape);
                let views: Vec<View> = sources.iter().map(|s| s.view()).collect();
                let (tier, geometry) = (Tier::detect(), self.geometry);
                conv::convolve(tier, &views, weights, bias, geometry, epilogue, output.view_mut());
                Data::F32(output)
            }
            Packed::Bf16(weights) => {
                let engine = Engine::detect();
                let narrowed: Vec<Option<Operand>> = sources
                    .iter()
                    .map(|source| match source {
                        Data::F32(buffer) => Some(Operand::narrow(engine, buffer.view(), self.geometry)),
                        Data::Bf16(_) => None,
                    })
                    .collect();
                let operands: Vec<&Operand> = (sources.iter().zip(&narrowed))
                    .map(|(source, narrowed)| match source {
                        Data::Bf16(operand) => operand,
                        Data::F32(_) => narrowed.as_ref().expect("f32 sources were narrowed"),
                    })
                    .collect();
                if round {
                    let mut output = Operand::new(shape);
                    let to = bf16::conv::Output::Bf16(&mut output);
                    bf16::conv::convolve(engine, &operands, weights, bias, epilogue, to);
                    Data::Bf16(output)
                } else {
                    let mut output = Buffer::new(shape);
                    let to = bf16::conv::Output::F32(output.view_mut());
                    bf16::conv::convolve(engine, &operands, weights, bias, epilogue, to);
                    Data::F32(output)
                }
            }
        }
    }

    /// Adds the gradient of the weights to `into`.
    pub(super) fn weight_gradient(&self, sources: &[View], gradient: View, into: &mut [f32]) {
        let total = self.inputs.iter().sum();
        let engine = Engine::detect();
        let pairs = (self.precision == Precision::Bf16)
            .then(|| bf16::weight_grad::Pairs::new(engine, gradient, self.geometry));
        let mut first = 0;
        for source in sources {
            match &pairs {
                None => weight_grad::weight_gradient(
                    Tier::detect(),
                    *source,
                    gradient,
                    self.geometry,
                    (first, total),
                    into,
                ),
                Some(pairs) => {
                    let channels = bf16::weight_grad::Channels::new(engine, *source);
                    bf16::weight_grad::weight_gradient(engine, &channels, pairs, (first, total), into);
                }
            }
            first += source.shape.c;
        }
    }

    /// The gradient of each source from that of the output: a function of the source's index, where to
    /// write, and whether to add to what is there.
    pub(super) fn input_gradient(&self, gradient: View, weights: &[f32]) -> impl Fn(usize, ViewMut, bool) {
        let back = self.geometry.backward();
        let engine = Engine::detect();
        let operand =
            (self.precision == Precision::Bf16).then(|| bf16::Operand::narrow(engine, gradient, back));
        move |index, into, accumulate| {
            let Self { inputs, outputs, geometry, .. } = self;
            let epilogue = Epilogue { relu: false, accumulate };
            let zero = vec![Block::default(); into.shape.planes()];
            match &operand {
                None => {
                    let mut packed =
                        vec![Block::default(); conv::packed_len(&[*outputs], inputs[index], *geometry)];
                    conv::pack(weights, inputs, *outputs, *geometry, Direction::Backward, index, &mut packed);
                    conv::convolve(Tier::detect(), &[gradient], &packed, &zero, back, epilogue, into);
                }
                Some(operand) => {
                    let packed = bf16::conv::Weights::pack(
                        weights,
                        inputs,
                        *outputs,
                        *geometry,
                        Direction::Backward,
                        index,
                    );
                    let into = bf16::conv::Output::F32(into);
                    bf16::conv::convolve(engine, &[operand], &packed, &zero, epilogue, into);
                }
            }
        }
    }
}
