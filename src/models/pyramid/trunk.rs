//! What the built-in network and its prefilter have in common: two encoders, a decoder, and the kernels that
//! their heads predict. Two inputs at full resolution come in; logits for every level of a pyramid of images
//! go out.
//!
//! [`Trunk::new`] declares its layers, and what each reads. All else follows from that list: the run on a
//! tape here, that [band by band](super::bands), parameters, arithmetic, reach, and how layers are frozen.

use dfdx::tensor::{Cpu, Merge, Tape};

use crate::{
    kernels::{blend::CORNERS, conv::Geometry, narrow::Steps},
    models::network::Stacked,
    nn::{Activation, Conv, Field, Init, MaxPool, Precision},
    rng::Rng,
};

/// Levels of the trunk: 1/2, 1/4, 1/8 and 1/16 of the frame.
pub const LEVELS: usize = 4;

/// Rows and columns must be multiples of this.
pub const MULTIPLE: usize = 1 << LEVELS;

/// Rows and columns of kernels, but for some of full resolution.
pub const KERNEL: usize = 5;

/// Further channels of the full-resolution head for each pixel: a gain for each colour and, where radiance is
/// filtered, which albedo to divide by, and how far to follow the shading.
const GAINS: usize = 3;
const DIVISOR: usize = 1;
const SHADE: usize = 1;

/// A decoder level is this much wider than the encoders beside it.
const DECODER_EXTRA: usize = 16;

/// Factor on the heads' Xavier weights at the start, so that kernels start nearly flat.
const HEAD_GAIN: f32 = 0.3;

/// The values that inputs may have in 8 bits: logarithms up to 300 times white, beyond which brightness makes
/// no difference to kernels; and for guides the whole range of albedo and normals.
const LOGARITHMS: Steps = Steps::to(3.0);
const GUIDES: Steps = Steps::within(1.0);

/// What sets the trunk of the network apart from that of its prefilter.
pub struct Variant<'a> {
    /// What the names of its layers begin with.
    pub prefix: &'a str,
    /// Channels of the guide encoder's input, before space to depth.
    pub guides: usize,
    /// Rows and columns of the kernels of full resolution.
    pub full_kernel: usize,
    /// Whether each pixel chooses what it is divided by and how far its gain follows the shading.
    pub refines: bool,
}

/// The layers of a network or of its prefilter.
#[derive(Clone)]
pub struct Trunk {
    /// The layers of the radiance encoder, of the guide encoder, and of the decoder. Each layer comes after
    /// those that it reads.
    pub layers: Vec<Layer>,
    /// One head for each level of the pyramid of images, full resolution first. That of full resolution also
    /// predicts what a [`Finish`] holds.
    pub heads: Vec<Head>,
    /// Rows and columns of the kernels of full resolution.
    full_kernel: usize,
}

/// Layers of an encoder: its input, two convolutions a level, and a pool between levels.
pub const ENCODER: usize = 3 * LEVELS;

/// One layer of the encoders or the decoder.
#[derive(Clone)]
pub struct Layer {
    pub step: Step,
    /// The layers that it reads.
    pub sources: Vec<usize>,
    /// The layer writes at `1/2^level` of the frame's resolution.
    pub level: usize,
    /// Channels that it writes.
    channels: usize,
}

/// What a layer does.
#[derive(Clone)]
pub enum Step {
    /// Makes the pixels of each quad of an input channels of one pixel. In 8 bits, the input's values are
    /// these steps.
    Input(Steps),
    /// Halves rows and columns.
    Pool,
    Conv(Box<Conv>),
}

/// A layer that predicts the kernels of a level of the pyramid of images.
#[derive(Clone)]
pub struct Head {
    pub conv: Conv,
    /// The layer that it reads.
    pub source: usize,
    /// Rows and columns of pixels that share a pixel of that layer.
    pub factor: usize,
}

impl Layer {
    /// Its convolution, if it is one.
    pub fn conv(&self) -> Option<&Conv> {
        if let Step::Conv(conv) = &self.step { Some(conv) } else { None }
    }

    /// How far it sees in what it reads, in pixels of the frame.
    fn reach(&self) -> usize {
        match self.conv().map(|conv| conv.arithmetic().geometry) {
            Some(Geometry::Same(k)) => (k / 2) << self.level,
            // A transposed convolution reaches half a pixel of the coarser level, as a pool does.
            Some(_) => 1 << self.level,
            None => 1 << (self.level - 1),
        }
    }
}

/// A trunk while its layers are declared.
struct Builder<'a> {
    prefix: &'a str,
    rng: &'a mut Rng,
    layers: Vec<Layer>,
}

impl Builder<'_> {
    fn add(&mut self, step: Step, sources: &[usize], level: usize, channels: usize) -> usize {
        self.layers.push(Layer { step, sources: sources.into(), level, channels });
        self.layers.len() - 1
    }

    fn pool(&mut self, source: usize) -> usize {
        let Layer { level, channels, .. } = self.layers[source];
        self.add(Step::Pool, &[source], level + 1, channels)
    }

    /// A k x k convolution to `width` channels.
    fn conv(&mut self, name: &str, sources: &[usize], width: usize, k: usize) -> usize {
        let inputs: Vec<usize> = sources.iter().map(|source| self.layers[*source].channels).collect();
        let name = format!("{}{name}", self.prefix);
        let conv = Conv::new(self.rng, &name, &inputs, width, k, Init::Xavier);
        self.add(Step::Conv(conv.into()), sources, self.layers[sources[0]].level, width)
    }

    /// A transposed convolution, which doubles rows and columns.
    fn up(&mut self, name: &str, source: usize, width: usize) -> usize {
        let Layer { level, channels, .. } = self.layers[source];
        let conv = Conv::transposed(self.rng, &format!("{}{name}", self.prefix), channels, width);
        self.add(Step::Conv(conv.into()), &[source], level - 1, width)
    }

    /// A head with `channels` channels for each pixel.
    fn head(&mut self, name: &str, source: usize, channels: usize, factor: usize) -> Head {
        let (name, inputs) = (format!("{}head.{name}", self.prefix), [self.layers[source].channels]);
        let outputs = factor * factor * channels;
        let conv = Conv::new(self.rng, &name, &inputs, outputs, 1, Init::Scaled(HEAD_GAIN)).head();
        Head { conv, source, factor }
    }
}

impl Trunk {
    /// Layers with fresh weights; `widths` are the encoders', finest first.
    ///
    /// # Panics
    /// If `widths` does not hold one width a level.
    pub fn new(widths: &[usize], variant: &Variant, rng: &mut Rng) -> Self {
        assert_eq!(widths.len(), LEVELS, "one width a level");
        let &Variant { prefix, guides, full_kernel, refines } = variant;
        let mut build = Builder { prefix, rng, layers: Vec::new() };
        let mut skips = [const { Vec::new() }; LEVELS];
        for (encoder, channels, steps) in [("radiance", 3, LOGARITHMS), ("guide", guides, GUIDES)] {
            // (N, C, H, W) -> (N, 4C, H/2, W/2)
            let mut x = build.add(Step::Input(steps), &[], 1, 4 * channels);
            for (level, &width) in widths.iter().enumerate() {
                if level > 0 {
                    x = build.pool(x); // (N, K, H, W) -> (N, K, H/2, W/2)
                }
                for i in 0..2 {
                    x = build.conv(&format!("encoder.{encoder}.{level}.{i}"), &[x], width, 3);
                }
                skips[level].push(x);
            }
        }
        let (mut below, mut refined) = (None, [0; LEVELS]);
        for level in (0..LEVELS).rev() {
            let (width, name) = (widths[level] + DECODER_EXTRA, format!("decoder.{level}"));
            let mut sources = skips[level].clone();
            if let Some(below) = below {
                // (N, K', H, W) -> (N, K, 2H, 2W)
                sources.push(build.up(&format!("{name}.up"), below, width));
            }
            let fused = build.conv(&format!("{name}.fuse"), &sources, width, 1);
            refined[level] = build.conv(&format!("{name}.refine"), &[fused], width, 3);
            below = Some(refined[level]);
        }
        let finish = GAINS + if refines { DIVISOR + SHADE } else { 0 };
        let mut heads = vec![build.head("full", refined[0], head_of(full_kernel) + finish, 2)];
        for (level, &source) in refined.iter().enumerate() {
            heads.push(build.head(&level.to_string(), source, head_of(KERNEL), 1));
        }
        Self { layers: build.layers, heads, full_kernel }
    }

    /// Rows and columns of the kernels of a level of the filtered pyramid; level 0 is the finest.
    pub fn kernel(&self, level: usize) -> usize {
        if level == 0 { self.full_kernel } else { KERNEL }
    }

    /// What is predicted for every pyramid level, full resolution first, from the encoders' inputs.
    pub fn predict<T: Tape<f32, Cpu> + Merge<T>>(
        &self,
        inputs: [&Stacked; 2],
    ) -> (Vec<Prediction<T>>, Finish<T>) {
        // How many layers and heads have yet to read each layer. The last of them takes over its tape.
        let mut readers = vec![0; self.layers.len()];
        let reads = self.layers.iter().flat_map(|layer| &layer.sources);
        reads.chain(self.heads.iter().map(|head| &head.source)).for_each(|source| readers[*source] += 1);
        let mut outputs: Vec<Option<Activation<T>>> = Vec::with_capacity(self.layers.len());
        let mut read = |outputs: &mut Vec<Option<Activation<T>>>, source: usize| {
            readers[source] -= 1;
            let output = if readers[source] > 0 {
                outputs[source].as_ref().map(Activation::fork)
            } else {
                outputs[source].take()
            };
            output.expect("layers come after those that they read")
        };
        let mut inputs = inputs.into_iter();
        let mut heads = Vec::with_capacity(self.heads.len());
        for (i, layer) in self.layers.iter().enumerate() {
            let mut sources = layer.sources.iter().map(|source| read(&mut outputs, *source));
            let output = match &layer.step {
                Step::Input(_) => {
                    let (shape, values) = inputs.next().expect("one for each encoder");
                    Activation::input_halved(*shape, values)
                }
                Step::Pool => MaxPool.forward(sources.next().expect("a pool has a source")),
                Step::Conv(conv) => conv.forward(sources.collect()),
            };
            outputs.push(Some(output));
            for head in self.heads.iter().rev().filter(|head| head.source == i) {
                heads.push((head.factor, head.conv.forward(vec![read(&mut outputs, i)])));
            }
        }
        let (_, full) = heads.pop().expect("full resolution has a head");
        let count = full.shape().c / 4;
        let (finest, finish) = Prediction::split_full(self.kernel(0), count, planes_of(full, 2));
        let coarser = heads.into_iter().rev().zip(1..);
        let coarser = coarser.map(|((f, head), level)| Prediction::split(KERNEL, level, planes_of(head, f)));
        (std::iter::once(finest).chain(coarser).collect(), finish)
    }

    /// How far it sees in its inputs, and in the images that are filtered.
    pub fn reach(&self) -> usize {
        let mut reaches: Vec<usize> = Vec::with_capacity(self.layers.len());
        for layer in &self.layers {
            let before = layer.sources.iter().map(|source| reaches[*source]).max();
            reaches.push(before.unwrap_or(0) + layer.reach());
        }
        // The head of full resolution leaves half a pixel of the finest level behind. Then come the kernels,
        // and below full resolution a pixel for the corners of an upsampling and half a one for the quads
        // of an image.
        let layers = reaches.into_iter().max().unwrap_or(0) + 1;
        let kernels: usize = (0..=LEVELS).map(|level| (self.kernel(level) / 2) << level).sum();
        let pyramid: usize = (1..=LEVELS).map(|level| 3 << (level - 1)).sum();
        layers + kernels + pyramid
    }

    /// Multiply-accumulates for one pixel of the frame, where `images` images are filtered.
    pub fn macs_per_pixel(&self, images: usize) -> f64 {
        let each = |macs: usize, level: usize| macs as f64 / 4f64.powi(level as i32);
        let layers = self.layers.iter().filter_map(|layer| Some((layer.conv()?, layer.level)));
        let heads = self.heads.iter().map(|head| (&head.conv, self.layers[head.source].level));
        let convolutions = layers.chain(heads).map(|(conv, level)| each(conv.macs_per_output_pixel(), level));
        // Three channels of each image and the sum of weights, at every pyramid level.
        let filters = (0..=LEVELS).map(|level| each(4 * images * self.kernel(level).pow(2), level));
        convolutions.sum::<f64>() + filters.sum::<f64>()
    }

    /// Its convolutions, in a fixed order.
    pub fn convolutions(&mut self) -> impl Iterator<Item = &mut Conv> {
        let layers = self.layers.iter_mut().filter_map(|layer| match &mut layer.step {
            Step::Conv(conv) => Some(&mut **conv),
            _ => None,
        });
        layers.chain(self.heads.iter_mut().map(|head| &mut head.conv))
    }

    /// Plans for inference: packs weights once.
    pub fn freeze(&mut self) {
        if self.heads[0].conv.arithmetic().precision != Precision::Int8 {
            return self.convolutions().for_each(|conv| conv.freeze(&[]));
        }
        // Every layer is frozen with the steps of what it reads.
        let mut steps: Vec<Steps> = Vec::with_capacity(self.layers.len());
        for layer in &mut self.layers {
            let sources: Vec<Steps> = layer.sources.iter().map(|source| steps[*source]).collect();
            steps.push(match &mut layer.step {
                Step::Input(steps) => *steps,
                Step::Pool => sources[0],
                Step::Conv(conv) => {
                    conv.freeze(&sources);
                    conv.steps()
                }
            });
        }
        self.heads.iter_mut().for_each(|head| head.conv.freeze(&[steps[head.source]]));
    }
}

/// Channels of a level's head for one pixel: the k x k kernel, the confidence, the mask by which the level
/// below is blended in, and the corners from which that level is upsampled.
const fn head_of(k: usize) -> usize {
    k * k + 2 + CORNERS
}

/// What a head says of one level of the radiance pyramid.
pub struct Prediction<T> {
    /// Logits of the kernels, (N, 25, H, W); (N, 9, H, W) of radiance at full resolution.
    pub kernel: Field<T>,
    /// How far each pixel is to be trusted, (N, 1, H, W).
    pub confidence: Field<T>,
    /// Of levels that have one below: the share of that before its logistic, (N, 1, H, W), and logits of the corners
    /// from which it is upsampled, (N, 4, H, W).
    pub below: Option<(Field<T>, Field<T>)>,
}

/// What the head of full resolution predicts besides the [`Prediction`] of its level.
pub struct Finish<T> {
    /// Logits of the gains, (N, 3, H, W).
    pub gain: Field<T>,
    /// How far to divide by the noisy albedo, before its logistic, and what the shading is multiplied by
    /// before it is added to all gains' logits, both (N, 1, H, W). A prefilter has neither.
    pub refined: Option<(Field<T>, Field<T>)>,
}

impl<T: Tape<f32, Cpu> + Merge<T>> Prediction<T> {
    /// A second handle on the same prediction, with empty tapes.
    pub fn fork(&self) -> Self {
        let Self { kernel, confidence, below } = self;
        let below = below.as_ref().map(|(mask, corners)| (mask.fork(), corners.fork()));
        Self { kernel: kernel.fork(), confidence: confidence.fork(), below }
    }

    /// Splits the planes of the head of `level`, whose k x k kernels come first. `planes(first, count)` gives some
    /// of these planes. (The head of the coarsest level has planes for a level below as well; nothing reads them.)
    pub fn split(k: usize, level: usize, mut planes: impl FnMut(usize, usize) -> Field<T>) -> Self {
        let taps = k * k;
        let (kernel, confidence) = (planes(0, taps), planes(taps, 1));
        let below = (level < LEVELS).then(|| (planes(taps + 1, 1), planes(taps + 2, CORNERS)));
        Self { kernel, confidence, below }
    }

    /// Splits the `count` planes of the head of full resolution, whose k x k kernels come first.
    pub fn split_full(
        k: usize,
        count: usize,
        mut planes: impl FnMut(usize, usize) -> Field<T>,
    ) -> (Self, Finish<T>) {
        let prediction = Self::split(k, 0, &mut planes);
        let (divisor, shade) = (head_of(k) + GAINS, head_of(k) + GAINS + DIVISOR);
        let refined = (shade < count).then(|| (planes(divisor, DIVISOR), planes(shade, SHADE)));
        (prediction, Finish { gain: planes(head_of(k), GAINS), refined })
    }
}

/// Some planes of a head's output; `factor` 2 where each quad of pixels shares one pixel of the trunk. The
/// first planes that are asked for take the tape.
fn planes_of<T: Tape<f32, Cpu> + Merge<T>>(
    mut head: Activation<T>,
    factor: usize,
) -> impl FnMut(usize, usize) -> Field<T> {
    let area = factor * factor;
    move |first, count| {
        let rest = head.fork();
        let head = std::mem::replace(&mut head, rest);
        Field::from_activation(head, area * first, area * count, factor)
    }
}

/// Filters an image, (N, 3, H, W), by what is predicted for every level of its pyramid, full resolution
/// first. From the coarsest level up, each level is blended with the filtered level below, and then filtered.
pub fn filter_levels<T: Tape<f32, Cpu> + Merge<T>>(
    mut image: Field<T>,
    levels: Vec<Prediction<T>>,
) -> Field<T> {
    let mut pyramid = Vec::with_capacity(levels.len());
    let last = levels.len() - 1;
    for (level, predicted) in levels.into_iter().enumerate() {
        let below = (level < last).then(|| image.fork().reduce(predicted.confidence.fork()));
        pyramid.push((image, predicted));
        match below {
            Some(below) => image = below,
            None => break,
        }
    }
    let mut below: Option<Field<T>> = None;
    loop {
        let (noisy, predicted) = pyramid.pop().expect("there are levels");
        let Prediction { kernel, confidence, below: how } = predicted;
        let blended = match below.take().zip(how) {
            None => noisy,
            // (N, 3, H, W) and (N, 3, H/2, W/2) -> (N, 3, H, W)
            Some((below, (mask, corners))) => noisy.blend(below, mask, corners),
        };
        let filtered = blended.filter(kernel, Some(confidence));
        if pyramid.is_empty() {
            return filtered;
        }
        below = Some(filtered);
    }
}
