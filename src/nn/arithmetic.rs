//! A convolution and its gradients in any precision: what the layers' passes call.

use serde::{Deserialize, Serialize};

use super::{
    activation::Data,
    pool::{Buffer, PlaneBuffer, plane_buffer},
};
use crate::kernels::{
    Block, Shape, View, ViewMut,
    conv::{self, Direction, Epilogue, Geometry},
    layout::from_blocked_shuffled,
    narrow::{self, Engine, Format, Operand, Steps},
    simd::Tier,
    weight_grad, winograd,
};

/// What the factors of a convolution are rounded to; sums are always f32, or exact.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// Not at all.
    F32,
    /// To bfloat16 (8 bits of mantissa), as matrix units want them.
    Bf16,
    /// To 8 bits, in steps that fit the ranges a trained network's inputs and activations have; for inference
    /// only.
    Int8,
}

impl Precision {
    /// The fastest one on this processor in which networks can be trained.
    pub fn fastest_trained() -> Self {
        if Engine::detect().prefers_bf16() { Self::Bf16 } else { Self::F32 }
    }

    /// The fastest one on this processor for inference; 8 bits only where the ranges are known.
    pub fn fastest(ranges: bool) -> Self {
        if ranges && Engine::detect().prefers_int8() { Self::Int8 } else { Self::fastest_trained() }
    }
}

/// Forward weights in one precision.
#[derive(Debug)]
pub(super) enum Packed {
    F32(Vec<Block>),
    Narrow(narrow::conv::Weights),
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
    /// Weights as [`Arithmetic::forward`] wants them. For 8 bits, `steps` are those of the sources.
    pub(super) fn pack(&self, weights: &[f32], steps: &[Steps]) -> Packed {
        let Self { inputs, outputs, geometry, .. } = self;
        match self.precision {
            Precision::Int8 => {
                assert_eq!(steps.len(), inputs.len(), "one step a source");
                let sources: Vec<_> = inputs.iter().copied().zip(steps.iter().copied()).collect();
                let engine = Engine::detect();
                Packed::Narrow(narrow::conv::Weights::quantize(
                    engine, weights, &sources, *outputs, *geometry,
                ))
            }
            Precision::F32 => {
                let mut packed = vec![Block::default(); conv::packed_len(inputs, *outputs, *geometry)];
                conv::pack(weights, inputs, *outputs, *geometry, Direction::Forward, 0, &mut packed);
                Packed::F32(packed)
            }
            Precision::Bf16 => {
                let forward = Direction::Forward;
                Packed::Narrow(narrow::conv::Weights::pack(weights, inputs, *outputs, *geometry, forward, 0))
            }
        }
    }

    /// `relu(bias + conv(sources, weights))`, the ReLU only where asked for. With narrow weights, the output
    /// is rounded to the `format`, if there is one. `taped` is for training.
    pub(super) fn forward(
        &self,
        sources: &[&Data],
        weights: &Packed,
        bias: &[Block],
        relu: bool,
        (shape, format): (Shape, Option<Format>),
        taped: bool,
    ) -> Data {
        let epilogue = Epilogue { relu, accumulate: false };
        let engine = Engine::detect();
        match weights {
            Packed::F32(weights) => {
                let mut output = Buffer::new(shape);
                let views: Vec<View> = sources.iter().map(|s| s.view()).collect();
                let convolve = if taped { convolve_taped } else { conv::convolve };
                convolve(Tier::detect(), &views, weights, bias, self.geometry, epilogue, output.view_mut());
                Data::F32(output)
            }
            Packed::Narrow(weights) => {
                let narrowed = self.narrowed(sources, weights);
                let operands = operands(sources, &narrowed);
                if let Some(format) = format {
                    let mut output = Operand::new(shape, format);
                    let to = narrow::conv::Output::Narrow(&mut output);
                    narrow::conv::convolve(engine, &operands, weights, bias, epilogue, to);
                    Data::Narrow(output)
                } else {
                    let mut output = Buffer::new(shape);
                    let to = narrow::conv::Output::F32(output.view_mut());
                    narrow::conv::convolve(engine, &operands, weights, bias, epilogue, to);
                    Data::F32(output)
                }
            }
        }
    }

    /// `bias + conv(sources, weights)` as planes of `factor` times the size of `shape`; see
    /// [`crate::kernels::layout`].
    pub(super) fn forward_planes(
        &self,
        sources: &[&Data],
        weights: &Packed,
        bias: &[Block],
        (shape, factor): (Shape, usize),
    ) -> PlaneBuffer {
        let mut values = plane_buffer(shape.n * shape.c * shape.h * shape.w);
        match weights {
            Packed::F32(_) => {
                let blocked = self.forward(sources, weights, bias, false, (shape, None), false);
                from_blocked_shuffled(blocked.view(), 0, factor, &mut values);
            }
            Packed::Narrow(weights) => {
                let epilogue = Epilogue { relu: false, accumulate: false };
                let narrowed = self.narrowed(sources, weights);
                let to = narrow::conv::Output::Planes { shape, factor, values: &mut values };
                let operands = operands(sources, &narrowed);
                narrow::conv::convolve(Engine::detect(), &operands, weights, bias, epilogue, to);
            }
        }
        values
    }

    /// For each of a layer's sources that is not narrow, a copy rounded to the format that the weights are to
    /// be multiplied with.
    fn narrowed(&self, sources: &[&Data], weights: &narrow::conv::Weights) -> Vec<Option<Operand>> {
        let narrow = |(source, format): (&&Data, Format)| match (source, format) {
            (Data::Narrow(_), _) => None,
            (Data::F32(buffer), Format::Bf16) => {
                Some(Operand::narrow(Engine::detect(), buffer.view(), self.geometry))
            }
            (Data::F32(buffer), Format::Int8(steps)) => Some(Operand::quantize(buffer.view(), steps)),
        };
        sources.iter().zip(weights.formats()).map(narrow).collect()
    }

    /// Adds the gradient of the weights to `into`.
    pub(super) fn weight_gradient(&self, sources: &[View], gradient: View, into: &mut [f32]) {
        let total = self.inputs.iter().sum();
        let engine = Engine::detect();
        let pairs = (self.precision == Precision::Bf16)
            .then(|| narrow::weight_grad::Pairs::new(engine, gradient, self.geometry));
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
                    let channels = narrow::weight_grad::Channels::new(engine, *source);
                    narrow::weight_grad::weight_gradient(engine, &channels, pairs, (first, total), into);
                }
            }
            first += source.shape().c;
        }
    }

    /// The gradient of each source from that of the output: a function of the source's index, where to
    /// write, and whether to add to what is there.
    pub(super) fn input_gradient(&self, gradient: View, weights: &[f32]) -> impl Fn(usize, ViewMut, bool) {
        let back = self.geometry.backward();
        let engine = Engine::detect();
        let operand =
            (self.precision == Precision::Bf16).then(|| narrow::Operand::narrow(engine, gradient, back));
        move |index, into, accumulate| {
            let Self { inputs, outputs, geometry, .. } = self;
            let epilogue = Epilogue { relu: false, accumulate };
            let zero = vec![Block::default(); into.shape().planes()];
            match &operand {
                None => {
                    let mut packed =
                        vec![Block::default(); conv::packed_len(&[*outputs], inputs[index], *geometry)];
                    conv::pack(weights, inputs, *outputs, *geometry, Direction::Backward, index, &mut packed);
                    convolve_taped(Tier::detect(), &[gradient], &packed, &zero, back, epilogue, into);
                }
                Some(operand) => {
                    let packed = narrow::conv::Weights::pack(
                        weights,
                        inputs,
                        *outputs,
                        *geometry,
                        Direction::Backward,
                        index,
                    );
                    let into = narrow::conv::Output::F32(into);
                    narrow::conv::convolve(engine, &[operand], &packed, &zero, epilogue, into);
                }
            }
        }
    }
}

/// [`conv::convolve`] in training: by cells of outputs where that is faster. How sums are rounded then
/// depends on how a frame is cut.
fn convolve_taped(
    tier: Tier,
    sources: &[View],
    weights: &[Block],
    bias: &[Block],
    geometry: Geometry,
    epilogue: Epilogue,
    output: ViewMut,
) {
    if geometry == Geometry::Same(3) && winograd::serves(output.shape().w) {
        let planes = sources.iter().map(|source| source.shape().planes()).sum();
        let weights = winograd::transform(tier, weights, planes);
        winograd::convolve(tier, sources, &weights, bias, epilogue, output);
    } else {
        conv::convolve(tier, sources, weights, bias, geometry, epilogue, output);
    }
}

/// The sources of a layer, all narrow. `narrowed` holds copies of those that were not.
fn operands<'a>(sources: &[&'a Data], narrowed: &'a [Option<Operand>]) -> Vec<&'a Operand> {
    let operand = |(source, narrowed): (&&'a Data, &'a Option<Operand>)| match source {
        Data::Narrow(operand) => operand,
        Data::F32(_) => narrowed.as_ref().expect("f32 sources were narrowed"),
    };
    sources.iter().zip(narrowed).map(operand).collect()
}
