//! What the built-in network and its prefilter have in common: the dual encoder, the decoder, and the kernels that their heads
//! predict. Two inputs at full resolution come in; logits for every level of a pyramid of images go out.

use dfdx::tensor::{Cpu, Merge, Tape};

use crate::{
    kernels::{blend::CORNERS, narrow::Steps},
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

/// Channels that the head of full resolution has besides for one pixel: a gain for each colour and, where radiance is
/// filtered, which albedo to divide by, and how far to follow the shading.
const GAINS: usize = 3;
const DIVISOR: usize = 1;
const SHADE: usize = 1;

/// A decoder level is this much wider than the encoders beside it.
const DECODER_EXTRA: usize = 16;

/// Heads begin this much smaller than Xavier: kernels start nearly flat.
const HEAD_GAIN: f32 = 0.3;

/// Channels of the radiance encoder's input, before space to depth.
const RADIANCE_CHANNELS: usize = 3;

/// The values that the radiance encoder's and the guide encoder's inputs may have in 8 bits: logarithms up to 300 times white,
/// beyond which brightness decides on no kernel; and all that albedo and normals are.
const INPUT_STEPS: [Steps; 2] = [Steps::to(3.0), Steps::within(1.0)];

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
    pub encoders: [Encoder; 2],
    /// Coarsest level first.
    pub decoder: Vec<Level>,
    /// Full resolution: kernels, confidence, mask, corners, gains and, but for a prefilter, divisors and shades of four pixels.
    pub full: Conv,
    /// One head a trunk level, finest first.
    pub heads: Vec<Conv>,
    /// Rows and columns of the kernels of full resolution.
    full_kernel: usize,
}

/// Two convolutions a level, with a pool between levels.
#[derive(Clone)]
pub struct Encoder {
    pub levels: Vec<[Conv; 2]>,
}

/// One level of the decoder.
#[derive(Clone)]
pub struct Level {
    /// From the level below; the coarsest has none.
    pub up: Option<Conv>,
    pub fuse: Conv,
    pub refine: Conv,
}

/// Channels of a level's head for one pixel: k x k kernel, confidence, the mask that blends the level below, and the
/// corners from which that is upsampled.
const fn head_of(k: usize) -> usize {
    k * k + 2 + CORNERS
}

/// What a head says of one level of the radiance pyramid.
pub struct Prediction<T> {
    /// Logits of the kernels, (N, 25, H, W); (N, 9, H, W) of radiance at full resolution.
    pub kernel: Field<T>,
    /// How far each pixel is to be trusted, (N, 1, H, W).
    pub confidence: Field<T>,
    /// The share of the level below before its logistic, (N, 1, H, W).
    pub mask: Field<T>,
    /// Logits of the corners from which that level is upsampled, (N, 4, H, W).
    pub corners: Field<T>,
}

/// What the head of full resolution says of the rest of a frame, once its light is filtered.
pub struct Finish<T> {
    /// Logits of the gains, (N, 3, H, W).
    pub gain: Field<T>,
    /// But for a prefilter, how far to divide by the noisy albedo, before its logistic, and what the shading is
    /// multiplied by before it is added to all gains' logits, both (N, 1, H, W).
    pub refined: Option<(Field<T>, Field<T>)>,
}

impl<T: Tape<f32, Cpu> + Merge<T>> Prediction<T> {
    /// The same once more, with empty tapes.
    pub fn fork(&self) -> Self {
        let Self { kernel, confidence, mask, corners } = self;
        let [kernel, confidence, mask, corners] = [kernel, confidence, mask, corners].map(Field::fork);
        Self { kernel, confidence, mask, corners }
    }

    /// Parts what a level's head says, k x k kernels first: `planes(first, count)` are some of its planes.
    pub fn split(k: usize, mut planes: impl FnMut(usize, usize) -> Field<T>) -> Self {
        let taps = k * k;
        Self {
            kernel: planes(0, taps),
            confidence: planes(taps, 1),
            mask: planes(taps + 1, 1),
            corners: planes(taps + 2, CORNERS),
        }
    }

    /// Parts what the head of full resolution says, k x k kernels first, which has `count` planes.
    pub fn split_full(
        k: usize,
        count: usize,
        mut planes: impl FnMut(usize, usize) -> Field<T>,
    ) -> (Self, Finish<T>) {
        let prediction = Self::split(k, &mut planes);
        let (divisor, shade) = (head_of(k) + GAINS, head_of(k) + GAINS + DIVISOR);
        let refined = (shade < count).then(|| (planes(divisor, DIVISOR), planes(shade, SHADE)));
        (prediction, Finish { gain: planes(head_of(k), GAINS), refined })
    }
}

/// Some planes of a head's output; `factor` 2 where each 2x2 square of pixels shares one pixel of the trunk. The tape goes
/// with the first that are asked for.
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

impl Encoder {
    fn new(rng: &mut Rng, name: &str, channels: usize, widths: &[usize]) -> Self {
        let mut from = 4 * channels;
        let levels = widths.iter().enumerate().map(|(level, &width)| {
            let first = Conv::new(rng, &format!("{name}.{level}.0"), &[from], width, 3, Init::Xavier);
            from = width;
            [first, Conv::new(rng, &format!("{name}.{level}.1"), &[width], width, 3, Init::Xavier)]
        });
        Self { levels: levels.collect() }
    }

    /// The output of every level, finest first.
    fn forward<T: Tape<f32, Cpu> + Merge<T>>(&self, input: Activation<T>) -> Vec<Activation<T>> {
        let mut skips: Vec<Activation<T>> = Vec::with_capacity(self.levels.len());
        let mut x = input;
        for (level, [first, second]) in self.levels.iter().enumerate() {
            if level > 0 {
                x = MaxPool.forward(x); // (N, K, H, W) -> (N, K, H/2, W/2)
            }
            x = second.forward(vec![first.forward(vec![x])]);
            skips.push(x.fork());
        }
        // The tape so far travels with the coarsest output.
        skips.pop();
        skips.push(x);
        skips
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
        let encoders = [
            Encoder::new(rng, &format!("{prefix}encoder.radiance"), RADIANCE_CHANNELS, widths),
            Encoder::new(rng, &format!("{prefix}encoder.guide"), guides, widths),
        ];
        let decoder_width = |level: usize| widths[level] + DECODER_EXTRA;
        let decoder = (0..LEVELS).rev().map(|level| {
            let (width, skip) = (decoder_width(level), widths[level]);
            let up = (level + 1 < LEVELS).then(|| {
                let name = format!("{prefix}decoder.{level}.up");
                Conv::transposed(rng, &name, decoder_width(level + 1), width)
            });
            let mut sources = vec![skip, skip];
            sources.extend(up.iter().map(|_| width));
            let name = format!("{prefix}decoder.{level}");
            Level {
                up,
                fuse: Conv::new(rng, &format!("{name}.fuse"), &sources, width, 1, Init::Xavier),
                refine: Conv::new(rng, &format!("{name}.refine"), &[width], width, 3, Init::Xavier),
            }
        });
        let decoder = decoder.collect();
        let mut head = |name: String, width: usize, channels: usize| {
            Conv::new(rng, &format!("{prefix}{name}"), &[width], channels, 1, Init::Scaled(HEAD_GAIN)).head()
        };
        let finish = GAINS + if refines { DIVISOR + SHADE } else { 0 };
        Self {
            full: head("head.full".into(), decoder_width(0), 4 * (head_of(full_kernel) + finish)),
            heads: (0..LEVELS)
                .map(|l| head(format!("head.{l}"), decoder_width(l), head_of(KERNEL)))
                .collect(),
            encoders,
            decoder,
            full_kernel,
        }
    }

    /// Rows and columns of the kernels of a level of the pyramid that is filtered, 0 the finest.
    pub fn kernel(&self, level: usize) -> usize {
        if level == 0 { self.full_kernel } else { KERNEL }
    }

    /// What is predicted for every pyramid level, full resolution first, from the encoders' inputs.
    pub fn predict<T: Tape<f32, Cpu> + Merge<T>>(
        &self,
        inputs: [&Stacked; 2],
    ) -> (Vec<Prediction<T>>, Finish<T>) {
        let mut skips = [(inputs[0], 0), (inputs[1], 1)]
            .map(|(input, e)| self.encoders[e].forward(Activation::<T>::input_halved(input.0, &input.1)));

        // The decoder, coarsest level first; every level feeds its head.
        let mut heads: Vec<Activation<T>> = Vec::with_capacity(LEVELS + 1);
        let mut x: Option<Activation<T>> = None;
        for (level, head) in self.decoder.iter().zip(self.heads.iter().rev()) {
            let mut sources: Vec<_> = skips.iter_mut().map(|s| s.pop().expect("one skip a level")).collect();
            if let (Some(up), Some(below)) = (&level.up, x) {
                sources.push(up.forward(vec![below])); // (N, K', H, W) -> (N, K, 2H, 2W)
            }
            let fused = level.refine.forward(vec![level.fuse.forward(sources)]);
            heads.push(head.forward(vec![fused.fork()])); // (N, K, H, W) -> (N, 31, H, W)
            x = Some(fused);
        }
        let full = self.full.forward(vec![x.expect("there are levels")]);
        let count = full.shape().c / 4;

        let (finest, finish) = Prediction::split_full(self.kernel(0), count, planes_of(full, 2));
        let mut levels = vec![finest];
        levels.extend(heads.into_iter().rev().map(|head| Prediction::split(KERNEL, planes_of(head, 1))));
        (levels, finish)
    }

    /// How far it sees in its inputs, and in the images that are filtered.
    pub fn reach(&self) -> usize {
        // At each trunk level two 3x3 convolutions and one more, and half a pixel each of a pool and an upsampling; then the
        // kernels, and below full resolution a pixel for the corners of an upsampling and half a one for the squares of an image.
        let trunk: usize = (1..=LEVELS).map(|level| (2 + 1 + 1) << level).sum();
        let kernels: usize = (0..=LEVELS).map(|level| (self.kernel(level) / 2) << level).sum();
        let pyramid: usize = (1..=LEVELS).map(|level| 3 << (level - 1)).sum();
        trunk + kernels + pyramid
    }

    /// Multiply-accumulates for one pixel of the frame, of which `images` are filtered.
    pub fn macs_per_pixel(&self, images: usize) -> f64 {
        let convolutions: f64 = self
            .convolution_levels()
            .map(|(c, level)| c.macs_per_output_pixel() as f64 / 4f64.powi(level as i32))
            .sum();
        // Three channels of each image and the sum of weights, at every pyramid level.
        let taps = |level: usize| (4 * images * self.kernel(level).pow(2)) as f64 / 4f64.powi(level as i32);
        let filters: f64 = (0..=LEVELS).map(taps).sum();
        convolutions + filters
    }

    /// Its convolutions, in a fixed order.
    pub fn convolutions(&mut self) -> impl Iterator<Item = &mut Conv> {
        let encoders = self.encoders.iter_mut().flat_map(|e| e.levels.iter_mut().flatten());
        let decoder =
            self.decoder.iter_mut().flat_map(|l| l.up.iter_mut().chain([&mut l.fuse, &mut l.refine]));
        let heads = [&mut self.full].into_iter().chain(&mut self.heads);
        encoders.chain(decoder).chain(heads)
    }

    /// Plans for inference: packs weights once.
    pub fn freeze(&mut self) {
        if self.full.arithmetic().precision != Precision::Int8 {
            return self.convolutions().for_each(|conv| conv.freeze(&[]));
        }
        // Every layer takes in the steps of what it reads.
        for (encoder, mut above) in self.encoders.iter_mut().zip(INPUT_STEPS) {
            for [first, second] in &mut encoder.levels {
                first.freeze(&[above]);
                second.freeze(&[first.steps()]);
                above = second.steps();
            }
        }
        let mut below = None;
        for (level, layers) in (0..LEVELS).rev().zip(&mut self.decoder) {
            let mut sources =
                self.encoders.each_ref().map(|encoder| encoder.levels[level][1].steps()).to_vec();
            if let (Some(up), Some(below)) = (&mut layers.up, below) {
                up.freeze(&[below]);
                sources.push(up.steps());
            }
            layers.fuse.freeze(&sources);
            layers.refine.freeze(&[layers.fuse.steps()]);
            let steps = layers.refine.steps();
            self.heads[level].freeze(&[steps]);
            below = Some(steps);
        }
        self.full.freeze(&[below.expect("there are levels")]);
    }

    /// Every convolution and the level of the frame's pyramid at which it writes.
    fn convolution_levels(&self) -> impl Iterator<Item = (&Conv, usize)> {
        let encoders = self.encoders.iter().flat_map(|e| {
            e.levels.iter().enumerate().flat_map(|(level, convs)| convs.iter().map(move |c| (c, level + 1)))
        });
        let decoder = self
            .decoder
            .iter()
            .rev()
            .enumerate()
            .flat_map(|(level, l)| l.up.iter().chain([&l.fuse, &l.refine]).map(move |c| (c, level + 1)));
        let heads = self.heads.iter().enumerate().map(|(level, c)| (c, level + 1));
        encoders.chain(decoder).chain(heads).chain([(&self.full, 1)])
    }
}

/// Filters an image, (N, 3, H, W), by what is predicted for every level of its pyramid, full resolution first: from the coarsest
/// up, each level is blended with what filtering made of the one below, and filtered.
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
        let Prediction { kernel, confidence, mask, corners } = predicted;
        let blended = match below.take() {
            None => noisy,
            // (N, 3, H, W) and (N, 3, H/2, W/2) -> (N, 3, H, W)
            Some(below) => noisy.blend(below, mask, corners),
        };
        let filtered = blended.filter(kernel, Some(confidence));
        if pyramid.is_empty() {
            return filtered;
        }
        below = Some(filtered);
    }
}
