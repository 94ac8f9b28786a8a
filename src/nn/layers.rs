//! The layers: convolution (k x k, 1x1 fusion, transposed 4x4), 2x2 max-pool, batch norm.
//!
//! Each splits the tape off its input, computes, and pushes one backward operation, as dfdx's own
//! operations do.

use std::sync::{
    Arc,
    atomic::{AtomicU32, Ordering},
};

use dfdx::tensor::{Cpu, Merge, NoneTape, Tape};

use super::{
    Activation, Field, Init, Param, Precision,
    activation::{Data, Saved},
    arithmetic::{Arithmetic, Packed},
    param::values_of,
    pool::Buffer,
};
use crate::kernels::{
    Block, LANES, Shape,
    conv::{Geometry, weight_index},
    narrow::{self, Format, Steps},
    pool::{channel_moments, max_pool, max_pool_gradient, relu_mask, scale_shift},
    weight_grad::bias_gradient,
};
use crate::rng::Rng;

/// A convolution of one or several sources, with bias and optional ReLU.
#[derive(Clone, Debug)]
pub struct Conv {
    /// `(O, I, k, k)`; transposed: `(I, O, 4, 4)`.
    pub weight: Param,
    /// `(O)`.
    pub bias: Param,
    /// The largest output of its ReLU that was observed. In 8 bits, values reach from zero to some way beyond
    /// this.
    pub range: Option<f32>,
    arithmetic: Arithmetic,
    relu: bool,
    /// See [`Conv::set_leak`].
    leak: f32,
    /// The packed weights of a frozen layer.
    frozen: Option<Arc<Packed>>,
    /// The bits of the largest output so far, while outputs are observed.
    observed: Option<Arc<AtomicU32>>,
}

/// In 8 bits, values reach to this many times the range that was observed: a brighter frame must not be cut
/// off, and coarser steps were found to cost nothing.
const RANGE_MARGIN: f32 = 2.0;

impl Conv {
    /// A k x k convolution with ReLU from sources of `inputs` channels to `outputs`.
    ///
    /// # Panics
    /// If `k` is not 1, 3 or 5.
    pub fn new(rng: &mut Rng, name: &str, inputs: &[usize], outputs: usize, k: usize, init: Init) -> Self {
        Self::with_geometry(rng, name, inputs, outputs, Geometry::same(k), init)
    }

    /// A transposed 4x4 convolution of stride 2 with ReLU, beginning as bilinear upsampling.
    pub fn transposed(rng: &mut Rng, name: &str, inputs: usize, outputs: usize) -> Self {
        Self::with_geometry(rng, name, &[inputs], outputs, Geometry::Transposed, Init::Bilinear)
    }

    fn with_geometry(
        rng: &mut Rng,
        name: &str,
        inputs: &[usize],
        outputs: usize,
        geometry: Geometry,
        init: Init,
    ) -> Self {
        let device = Cpu::default();
        let total: usize = inputs.iter().sum();
        let (k, shape) = match geometry {
            Geometry::Same(k) => (k, [outputs, total, k, k]),
            _ => (4, [total, outputs, 4, 4]),
        };
        let weights = init.weights(rng, inputs, outputs, k);
        Self {
            weight: Param { hidden: true, ..Param::new(&device, format!("{name}.weight"), &shape, weights) },
            bias: Param::new(&device, format!("{name}.bias"), &[outputs], vec![0.0; outputs]),
            arithmetic: Arithmetic { inputs: inputs.into(), outputs, geometry, precision: Precision::F32 },
            range: None,
            relu: true,
            leak: 0.0,
            frozen: None,
            observed: None,
        }
    }

    /// The same layer without its ReLU.
    pub fn linear(self) -> Self {
        Self { relu: false, ..self }
    }

    /// The same layer without its ReLU, as a network's last, whose outputs are read one by one.
    pub fn head(mut self) -> Self {
        self.weight.hidden = false;
        self.linear()
    }

    /// The same layer with every bias at `value`.
    pub fn with_bias(mut self, value: f32) -> Self {
        self.bias.set(&vec![value; self.arithmetic.outputs]);
        self
    }

    /// [`Activation::input_halved`], for this layer alone. If the layer is frozen and would round its input
    /// first, the input comes already rounded.
    ///
    /// # Panics
    /// As for that function.
    pub fn input_halved(&self, planes: Shape, values: &[f32]) -> Activation<NoneTape> {
        match self.frozen.as_deref() {
            Some(Packed::Narrow(weights)) => {
                let format = weights.formats().next().expect("a layer has a source");
                let operand = narrow::Operand::halved(narrow::Engine::detect(), format, planes, values);
                Activation::constant(Data::Narrow(operand))
            }
            _ => Activation::input_halved(planes, values),
        }
    }

    /// Takes over the weights of a narrower layer of the same kind, so that it computes the same and every
    /// channel has an effect: channels that begin without one hardly learn one. Additional channels copy the
    /// old ones in turn. The weight with which a channel was read is divided at random among the channel and
    /// its copies (after Chen et al. 2016, Net2Net, where shares are equal), so that their gradients differ
    /// from the first step on. Additional outputs of a layer without ReLU, which are no features, begin at
    /// zero. Returns whether the layers fit.
    pub fn widen_from(&mut self, narrow: &Arithmetic, weight: &[f32], bias: &[f32], rng: &mut Rng) -> bool {
        let wide = &self.arithmetic;
        let fits = wide.geometry == narrow.geometry
            && wide.outputs >= narrow.outputs
            && wide.inputs.len() == narrow.inputs.len()
            && wide.inputs.iter().zip(&narrow.inputs).all(|(w, n)| w >= n);
        let (taps, total) = (wide.geometry.taps(), [wide, narrow].map(|a| a.inputs.iter().sum::<usize>()));
        if !fits || (weight.len(), bias.len()) != (total[1] * narrow.outputs * taps, narrow.outputs) {
            return false;
        }
        let outputs = if self.relu { wide.outputs } else { narrow.outputs };
        let (mut weights, mut biases) = (vec![0.0; total[0] * wide.outputs * taps], vec![0.0; wide.outputs]);
        let place = |a: &Arithmetic, total, o, i, t| weight_index(a.geometry, a.outputs, total, o, i, t);
        for o in 0..outputs {
            let copied = o % narrow.outputs;
            biases[o] = bias[copied];
            let mut first = [0; 2];
            for (&w, &n) in wide.inputs.iter().zip(&narrow.inputs) {
                for (i, t) in (0..n).flat_map(|i| (0..taps).map(move |t| (i, t))) {
                    let old = weight[place(narrow, total[1], copied, first[1] + i, t)];
                    let copies = (w - i).div_ceil(n);
                    let mut rest = 1.0;
                    for copy in (0..copies).rev() {
                        let drawn = 1.0 / copies as f32 + 2.0 * rng.uniform() - 1.0;
                        let share = if copy > 0 { drawn } else { rest };
                        rest -= share;
                        weights[place(wide, total[0], o, first[0] + i + copy * n, t)] = share * old;
                    }
                }
                first = [first[0] + w, first[1] + n];
            }
        }
        self.weight.set(&weights);
        self.bias.set(&biases);
        self.frozen = None;
        true
    }

    /// Its path in the network, `decoder.0.up`.
    pub fn name(&self) -> &str {
        self.weight.name.strip_suffix(".weight").expect("`Conv::new` named it so")
    }

    /// What the layer computes, apart from its weights.
    pub fn arithmetic(&self) -> &Arithmetic {
        &self.arithmetic
    }

    /// Lets a share of the gradient pass where the ReLU gives nothing, as a leaky one would, in training. What the layer
    /// computes stays the same. A ReLU that gives nothing anywhere has no gradient of its own and would never give
    /// anything again.
    pub fn set_leak(&mut self, leak: f32) {
        self.leak = leak;
    }

    /// Chooses the arithmetic of the layer and of its gradients.
    pub fn set_precision(&mut self, precision: Precision) {
        self.arithmetic.precision = precision;
        self.frozen = None;
    }

    /// Folds the batch norm that follows, with its running statistics and its ReLU, into this layer, which
    /// then computes what the two did.
    ///
    /// # Panics
    /// If the layer has a ReLU of its own, or is transposed.
    pub fn fold(&mut self, norm: &BatchNorm) {
        assert!(
            !self.relu && matches!(self.arithmetic.geometry, Geometry::Same(_)),
            "only a linear layer folds"
        );
        let (scale, shift) = norm.scale_and_shift(&norm.running());
        let (mut weights, mut bias) = (self.weight.values(), self.bias.values());
        let each = weights.len() / self.arithmetic.outputs;
        for (channel, (scale, shift)) in scale.into_iter().zip(shift).enumerate() {
            weights[channel * each..][..each].iter_mut().for_each(|w| *w *= scale);
            bias[channel] = bias[channel] * scale + shift;
        }
        self.weight.set(&weights);
        self.bias.set(&bias);
        self.relu = true;
        self.frozen = None;
    }

    /// Packs the weights once for all forward passes to come, until the layer is changed again. For 8 bits,
    /// `steps` are those of its sources.
    pub fn freeze(&mut self, steps: &[Steps]) {
        self.frozen = Some(Arc::new(self.arithmetic.pack(&self.weight.values(), steps)));
    }

    /// The values of its output in 8 bits.
    ///
    /// # Panics
    /// If its range is unknown.
    pub fn steps(&self) -> Steps {
        let range = self.range.expect("only layers of known range are quantized");
        Steps::to((RANGE_MARGIN * range).max(f32::MIN_POSITIVE.sqrt()))
    }

    /// Whether it can compute in 8 bits if its sources can. If it has a ReLU, its range has to be known for
    /// that.
    pub fn is_quantizable(&self) -> bool {
        !self.relu || self.range.is_some()
    }

    /// Observes from now on how large its outputs are.
    pub fn observe(&mut self) {
        self.observed = Some(Arc::default());
    }

    /// The largest value that its ReLU left since [`Conv::observe`].
    pub fn observed(&self) -> Option<f32> {
        let bits = self.observed.as_ref()?.load(Ordering::Relaxed);
        self.relu.then(|| f32::from_bits(bits))
    }

    /// Multiply-accumulates for one pixel of the layer's output.
    pub fn macs_per_output_pixel(&self) -> usize {
        // An output pixel of the transposed convolution sees 4 of its 16 taps.
        let Arithmetic { inputs, outputs, geometry, .. } = &self.arithmetic;
        let taps = if *geometry == Geometry::Transposed { 4 } else { geometry.taps() };
        inputs.iter().sum::<usize>() * outputs * taps
    }

    /// Its parameters, in a fixed order. They may change, so the layer is no longer frozen.
    pub fn params(&mut self) -> [&mut Param; 2] {
        self.frozen = None;
        [&mut self.weight, &mut self.bias]
    }

    /// Applies the layer to sources that are taken as concatenated, without concatenating them.
    /// (N, I, H, W) -> (N, O, H', W')
    ///
    /// # Panics
    /// If the sources do not have the layer's channels, or differ in size.
    pub fn forward<T: Tape<f32, Cpu> + Merge<T>>(&self, sources: Vec<Activation<T>>) -> Activation<T> {
        let shape_out = self.output(&sources);
        let (weights, bias) = (self.packed(), to_blocks(&self.bias.values()));
        let data: Vec<&Data> = sources.iter().map(|s| &*s.saved.data).collect();
        // Without a tape, what the next convolution would round anyway is rounded here.
        let format = match self.arithmetic.precision {
            _ if T::OWNS_TAPE || !self.relu => None,
            Precision::F32 => None,
            Precision::Bf16 => Some(Format::Bf16),
            Precision::Int8 => Some(Format::Int8(self.steps())),
        };
        let made = (shape_out, format);
        let output = self.arithmetic.forward(&data, &weights, &bias, self.relu, made, T::OWNS_TAPE);

        let [weight_learns, bias_learns] = [&self.weight, &self.bias].map(|param| param.trainable);
        let learns =
            weight_learns || bias_learns || sources.iter().any(|source| source.saved.gradient.is_some());
        let mut saved: Vec<Saved> = Vec::with_capacity(sources.len());
        let mut tape = T::default();
        for source in sources {
            saved.push(source.saved);
            tape = tape.merge(source.tape);
        }
        let (mut activation, out) = Activation::output(output, tape, learns);
        if let Some(observed) = &self.observed {
            // The bits of non-negative values are ordered as the values are.
            observed.fetch_max(activation.peak().max(0.0).to_bits(), Ordering::Relaxed);
        }
        if T::OWNS_TAPE && learns {
            let (weight, bias) = (self.weight.tensor.clone(), self.bias.tensor.clone());
            let (arithmetic, relu, leak) = (self.arithmetic.clone(), self.relu, self.leak);
            activation.tape.add_backward_op(move |gradients| {
                let Some(mut gradient) = out.take_gradient() else { return Ok(()) };
                if relu {
                    relu_mask(out.data.view(), leak, gradient.view_mut());
                }
                if bias_learns {
                    bias_gradient(gradient.view(), gradients.get_or_alloc_mut(&bias)?);
                }
                if weight_learns {
                    let views: Vec<_> = saved.iter().map(|s| s.data.view()).collect();
                    arithmetic.weight_gradient(&views, gradient.view(), gradients.get_or_alloc_mut(&weight)?);
                }
                if saved.iter().all(|source| source.gradient.is_none()) {
                    return Ok(());
                }
                let weights = values_of(&weight);
                let input_gradient = arithmetic.input_gradient(gradient.view(), &weights);
                for (index, source) in saved.iter().enumerate() {
                    source.accumulate(|into, fresh| input_gradient(index, into.view_mut(), !fresh));
                }
                Ok(())
            });
        }
        activation
    }

    /// [`Conv::forward`] of a layer without ReLU and without a tape, as planes at once: see
    /// [`Field::from_activation`], whose `factor` this is. (N, I, H, W) -> (N, O / factor^2, factor * H,
    /// factor * W)
    ///
    /// # Panics
    /// As [`Conv::forward`], if the layer has a ReLU, or if its channels are no whole planes.
    pub fn forward_planes(&self, sources: &[Activation<NoneTape>], factor: usize) -> Field<NoneTape> {
        assert!(!self.relu, "what is read as planes may be negative");
        let shape = self.output(sources);
        let (weights, bias) = (self.packed(), to_blocks(&self.bias.values()));
        let data: Vec<&Data> = sources.iter().map(|s| &*s.saved.data).collect();
        let values = self.arithmetic.forward_planes(&data, &weights, &bias, (shape, factor));
        let Shape { n, c, h, w, .. } = shape;
        Field::from_buffer((n, c / (factor * factor), factor * h, factor * w), values)
    }

    /// The shape of what it makes of these sources.
    fn output<T: Tape<f32, Cpu>>(&self, sources: &[Activation<T>]) -> Shape {
        let channels: Vec<usize> = sources.iter().map(|s| s.shape().c).collect();
        let Arithmetic { inputs, outputs, geometry, .. } = &self.arithmetic;
        assert_eq!(&channels, inputs, "{} reads {inputs:?} channels", self.weight.name);
        let shape = sources[0].shape();
        let (h, w) = geometry.output(shape.h, shape.w);
        shape.with_channels(*outputs).with_size(h, w)
    }

    /// Its weights, packed.
    fn packed(&self) -> Arc<Packed> {
        match &self.frozen {
            Some(packed) => packed.clone(),
            None => Arc::new(self.arithmetic.pack(&self.weight.values(), &[])),
        }
    }
}

/// Channel values as blocks of 16 lanes.
fn to_blocks(values: &[f32]) -> Vec<Block> {
    values
        .chunks(LANES)
        .map(|chunk| {
            let mut block = Block::default();
            block.0[..chunk.len()].copy_from_slice(chunk);
            block
        })
        .collect()
}

/// The 2x2 max-pool of stride 2. (N, C, H, W) -> (N, C, H/2, W/2)
#[derive(Clone, Copy, Debug)]
pub struct MaxPool;

impl MaxPool {
    /// Applies the pool.
    ///
    /// # Panics
    /// If rows or columns are odd in number.
    pub fn forward<T: Tape<f32, Cpu>>(self, input: Activation<T>) -> Activation<T> {
        let shape = input.shape();
        let output = match &*input.saved.data {
            // Only ReLUs leave narrow values, so nothing in them is negative.
            Data::Narrow(operand) => Data::Narrow(narrow::max_pool(operand)),
            Data::F32(buffer) => {
                let mut output = Buffer::new(shape.with_size(shape.h / 2, shape.w / 2));
                max_pool(buffer.view(), output.view_mut());
                Data::F32(output)
            }
        };
        let learns = input.saved.gradient.is_some();
        let (mut activation, out) = Activation::output(output, input.tape, learns);
        if T::OWNS_TAPE && learns {
            let source = input.saved;
            activation.tape.add_backward_op(move |_| {
                let Some(gradient) = out.take_gradient() else { return Ok(()) };
                source.accumulate(|into, fresh| {
                    if fresh {
                        into.fill(Block::default());
                    }
                    max_pool_gradient(source.data.view(), gradient.view(), into.view_mut());
                });
                Ok(())
            });
        }
        activation
    }
}

/// What one training step saw in one batch-norm layer: mean and variance of each channel.
#[derive(Clone, Debug)]
pub struct BatchStats {
    /// Mean of each channel.
    pub mean: Vec<f32>,
    /// Unbiased variance of each channel.
    pub variance: Vec<f32>,
}

/// Whether batch norm uses the batch's statistics (and records them) or the running ones.
#[derive(Debug)]
pub enum Stats {
    /// Inference: the running statistics.
    Running,
    /// Training: the batch's own, recorded layer by layer.
    Batch(Vec<BatchStats>),
}

/// Batch normalisation (Ioffe and Szegedy 2015) with ReLU.
#[derive(Clone, Debug)]
pub struct BatchNorm {
    /// Scale of each channel.
    pub scale: Param,
    /// Shift of each channel.
    pub shift: Param,
    /// Running mean.
    pub mean: Param,
    /// Running variance.
    pub variance: Param,
}

impl BatchNorm {
    /// Added to the variance before the root.
    pub const EPSILON: f32 = 1e-5;
    /// Weight of the newest batch in the running statistics.
    pub const MOMENTUM: f32 = 0.1;

    /// The identity on normalised channels.
    pub fn new(name: &str, channels: usize) -> Self {
        let device = Cpu::default();
        let param = |part: &str, value: f32, trainable| {
            let values = vec![value; channels];
            Param { trainable, ..Param::new(&device, format!("{name}.{part}"), &[channels], values) }
        };
        Self {
            scale: param("scale", 1.0, true),
            shift: param("shift", 0.0, true),
            mean: param("mean", 0.0, false),
            variance: param("variance", 1.0, false),
        }
    }

    /// Its parameters, in a fixed order.
    pub fn params(&mut self) -> [&mut Param; 4] {
        [&mut self.scale, &mut self.shift, &mut self.mean, &mut self.variance]
    }

    /// Moves the running statistics towards a batch's.
    pub fn update(&mut self, batch: &BatchStats) {
        for (param, new) in [(&mut self.mean, &batch.mean), (&mut self.variance, &batch.variance)] {
            let blend = |(old, new): (f32, &f32)| old + Self::MOMENTUM * (new - old);
            let values: Vec<f32> = param.values().into_iter().zip(new).map(blend).collect();
            param.set(&values);
        }
    }

    /// What each channel is multiplied by, and what is added then, where its mean and variance are these.
    fn scale_and_shift(&self, moments: &[(f32, f32)]) -> (Vec<f32>, Vec<f32>) {
        let scale: Vec<f32> =
            self.scale.values().iter().zip(moments).map(|(g, m)| g * inverse(m.1)).collect();
        let moved = moments.iter().zip(&scale).map(|((mean, _), s)| s * mean);
        let shift = self.shift.values().iter().zip(moved).map(|(b, m)| b - m).collect();
        (scale, shift)
    }

    /// The running mean and variance of each channel.
    fn running(&self) -> Vec<(f32, f32)> {
        self.mean.values().into_iter().zip(self.variance.values()).collect()
    }

    /// Normalises, scales, shifts, rectifies. (N, C, H, W) -> (N, C, H, W)
    pub fn forward<T: Tape<f32, Cpu>>(&self, input: Activation<T>, stats: &mut Stats) -> Activation<T> {
        let input = input.into_f32();
        let shape = input.shape();
        let count = (shape.n * shape.h * shape.w) as f64;
        let moments: Vec<(f32, f32)> = match stats {
            Stats::Running => self.running(),
            Stats::Batch(seen) => {
                let moments = channel_moments(input.saved.data.view());
                let unbias = count / (count - 1.0).max(1.0);
                seen.push(BatchStats {
                    mean: moments.iter().map(|m| m.0 as f32).collect(),
                    variance: moments.iter().map(|m| (m.1 * unbias) as f32).collect(),
                });
                moments.into_iter().map(|(m, v)| (m as f32, v as f32)).collect()
            }
        };
        let (scale, shift) = self.scale_and_shift(&moments);
        let mut output = Buffer::new(shape);
        scale_shift(input.saved.data.view(), &scale, &shift, output.view_mut());

        let batch = matches!(stats, Stats::Batch(_));
        let (mut activation, out) = Activation::output(Data::F32(output), input.tape, true);
        if T::OWNS_TAPE {
            let source = input.saved;
            let (scale_tensor, shift_tensor) = (self.scale.tensor.clone(), self.shift.tensor.clone());
            activation.tape.add_backward_op(move |gradients| {
                let Some(mut gradient) = out.take_gradient() else { return Ok(()) };
                relu_mask(out.data.view(), 0.0, gradient.view_mut());
                let inverse: Vec<f32> = moments.iter().map(|(_, variance)| inverse(*variance)).collect();
                // Sums of g and of g * normalised input, each channel.
                let mut sums = vec![(0.0f64, 0.0f64); shape.c];
                each_row(shape, |c0, row| {
                    for (x, g) in source.data.view().data()[row.clone()].iter().zip(&gradient[row]) {
                        for (l, sum) in sums[c0..].iter_mut().take(LANES).enumerate() {
                            let normal = (x.0[l] - moments[c0 + l].0) * inverse[c0 + l];
                            sum.0 += f64::from(g.0[l]);
                            sum.1 += f64::from(g.0[l] * normal);
                        }
                    }
                });
                let into = gradients.get_or_alloc_mut(&scale_tensor)?;
                into.iter_mut().zip(&sums).for_each(|(a, s)| *a += s.1 as f32);
                let into = gradients.get_or_alloc_mut(&shift_tensor)?;
                into.iter_mut().zip(&sums).for_each(|(a, s)| *a += s.0 as f32);
                source.accumulate(|into, fresh| {
                    each_row(shape, |c0, row| {
                        let lanes = (shape.c - c0).min(LANES);
                        for at in row {
                            let (x, g) = (source.data.view().data()[at].0, gradient[at].0);
                            for l in 0..lanes {
                                let c = c0 + l;
                                let normal = (x[l] - moments[c].0) * inverse[c];
                                // The batch's own statistics depend on the input as well.
                                let through = if batch {
                                    (sums[c].0 / count) as f32 + normal * (sums[c].1 / count) as f32
                                } else {
                                    0.0
                                };
                                let value = scale[c] * (g[l] - through);
                                let old = if fresh { 0.0 } else { into[at].0[l] };
                                into[at].0[l] = old + value;
                            }
                            into[at].0[lanes..].fill(0.0);
                        }
                    });
                });
                Ok(())
            });
        }
        activation
    }
}

/// The inverse of the standard deviation of a channel of this variance.
fn inverse(variance: f32) -> f32 {
    (variance + BatchNorm::EPSILON).sqrt().recip()
}

/// Calls `visit(first channel, blocks of the row)` for every row of every plane.
fn each_row(shape: crate::kernels::Shape, mut visit: impl FnMut(usize, std::ops::Range<usize>)) {
    for n in 0..shape.n {
        for plane in 0..shape.planes() {
            for y in 0..shape.h {
                let start = shape.row(n, plane, y);
                visit(plane * LANES, start..start + shape.w);
            }
        }
    }
}
