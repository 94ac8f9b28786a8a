//! The built-in network: a dual encoder at half resolution that predicts kernels instead of colours.
//!
//! As in DEMC, guides and radiance are encoded apart and fused at every level of the decoder. The rest
//! follows what measurement favoured: the trunk works on 2x2 squares (space to depth), and each level
//! predicts softmax kernels that filter that level of a radiance pyramid (Bako et al. 2017; Vogels et
//! al. 2018), after it was blended with what filtering made of the level below: a level's own kernels
//! come last, and smooth what upsampling left uneven. Radiance is divided by albedo first and multiplied
//! by it last, so texture is never blurred with the noise. A confidence for every pixel and level lets a firefly
//! take itself out of all kernels at once.
//!
//! Kernels cannot invent a colour, and scale with their input exactly; nor can they draw an edge finer than the noise
//! that they average. So each colour of each pixel gets a bounded gain last, which scales with the input as well.
//!
//! Noise in the albedo (depth of field, 4 spp edges) is removed before: the built-in networks read it from a
//! prefilter, a small network of the same kind, which was trained by itself and is not trained any further. Its kernels filter
//! the normal alike, for the [refit](crate::filters::refit) that comes last. The samples that made an albedo noisy made the
//! radiance noisy alike, though, and their quotient is free of that noise: so each pixel says how far it is to be divided by the
//! noisy albedo, not by the clean one. Normals are read as noisy as they are for the same reason.
//!
//! What normals alone show, such as a moulding, is often thinner than any kernel that is wide enough to average its noise. A fit
//! of light over normals ([`Shading`]) finds it; each pixel says how far its gain is to follow that.

mod bands;
mod strips;

use dfdx::tensor::{Cpu, Merge, NoneTape, Tape};

use super::network::{Architecture, Batch, Config, Design, Network, Stacked, Taped, duplicate, squares};
use crate::{
    Result,
    companion::Companion,
    features::{
        GUIDE_PASSES, Inputs, PREFILTERED_PASSES, Refined, Shading, albedo_exposure, albedo_of_target,
        exposure, guide_rows, guide_targets, guides, noisy_guides, normal_of_target,
    },
    filters::refit::{Guides, Refit, Samples},
    kernels::{blend::CORNERS, memory::PlaneBuffer, narrow::Steps},
    nn::{Activation, Conv, Field, Images, Init, MaxPool, Param, Precision, Stats},
    passes::{Pass, PassSet},
    planes::Planes,
    rng::Rng,
};

/// Levels of the trunk: 1/2, 1/4, 1/8 and 1/16 of the frame.
pub const LEVELS: usize = 4;

/// Widths of the prefilters of `demc-s` and `demc-m`.
const PREFILTER_OF_S: [usize; LEVELS] = [16, 24, 32, 40];
const PREFILTER_OF_M: [usize; LEVELS] = [32, 48, 48, 48];

/// The configuration of `demc-s`.
pub fn small() -> Config {
    Config { prefilter: PREFILTER_OF_S.into(), ..Config::new(Architecture::Pyramid, &[16, 48, 64, 64]) }
}

/// The configuration of `demc-m`.
pub fn medium() -> Config {
    Config { prefilter: PREFILTER_OF_M.into(), ..Config::new(Architecture::Pyramid, &[80, 96, 96, 112]) }
}

/// The prefilter of `demc-m`, to be trained alone.
pub fn prefilter() -> Config {
    Config::new(Architecture::Prefilter, &PREFILTER_OF_M)
}

/// Rows and columns of kernels, and of the radiance kernels at full resolution: what is as thin as a pixel there, texture and
/// edges, was divided away with the guides, whose own kernels need more than nine pixels to average along it.
const KERNEL: usize = 5;
const FULL_KERNEL: usize = 3;

/// Channels that the head of full resolution has besides for one pixel: a gain for each colour and, but for a prefilter, which
/// albedo to divide by, and how far to follow the shading.
const GAINS: usize = 3;
const DIVISOR: usize = 1;
const SHADE: usize = 1;

/// A decoder level is this much wider than the encoders beside it.
const DECODER_EXTRA: usize = 16;

/// Heads begin this much smaller than Xavier: kernels start nearly flat.
const HEAD_GAIN: f32 = 0.3;

/// What the names of a prefilter's layers begin with.
pub const PREFILTER: &str = "prefilter.";

/// Who asks for passes, in messages.
const NEEDED_BY: &str = "this model";

/// The values that the radiance encoder's and the guide encoder's inputs may have in 8 bits: logarithms up to 300 times white,
/// beyond which brightness decides on no kernel; and all that albedo and normals are.
const INPUT_STEPS: [Steps; 2] = [Steps::to(3.0), Steps::within(1.0)];

/// Channels of the radiance encoder's and of the guide encoder's input, before space to depth: albedo, normal, and how noisy the
/// albedo was; and of a prefilter's, the normal alone.
const RADIANCE_CHANNELS: usize = 3;
const GUIDE_CHANNELS: usize = 7;
const NORMAL_CHANNELS: usize = 3;

/// The kernel-predicting dual encoder with its prefilter.
pub static DESIGN: Design = Design {
    // Those of a prefilter as well, since it may be part of a pyramid, and come out of one.
    inputs: "guides/logarithm/1",
    levels: LEVELS,
    prefilter_levels: LEVELS,
    least_parameters: |config| squares(2, &config.widths) + squares(2, &config.prefilter),
    build: |config, seed| Box::new(Pyramid::new(config, seed)),
};

/// A prefilter by itself.
pub static ALONE: Design = Design { prefilter_levels: 0, ..DESIGN };

/// The kernel-predicting dual encoder.
#[derive(Clone)]
pub struct Pyramid {
    config: Config,
    /// Denoises albedo and normal; itself it has none.
    prefilter: Option<Box<Pyramid>>,
    encoders: [Encoder; 2],
    /// Coarsest level first.
    decoder: Vec<Level>,
    /// Full resolution: radiance kernels, confidence, mask, corners, gains, divisors and shades of four pixels.
    full: Conv,
    /// One head a trunk level, finest first.
    heads: Vec<Conv>,
}

/// Two convolutions a level, with a pool between levels.
#[derive(Clone)]
struct Encoder {
    levels: Vec<[Conv; 2]>,
}

/// One level of the decoder.
#[derive(Clone)]
struct Level {
    /// From the level below; the coarsest has none.
    up: Option<Conv>,
    fuse: Conv,
    refine: Conv,
}

/// Rows and columns of the kernels of a level of the pyramid that is filtered, 0 the finest.
const fn kernel_of(architecture: Architecture, level: usize) -> usize {
    if level == 0 && !matches!(architecture, Architecture::Prefilter) { FULL_KERNEL } else { KERNEL }
}

/// Channels of a level's head for one pixel: k x k kernel, confidence, the mask that blends the level below, and the
/// corners from which that is upsampled.
const fn head_of(k: usize) -> usize {
    k * k + 2 + CORNERS
}

/// What a head says of one level of the radiance pyramid.
struct Prediction<T> {
    /// Logits of the kernels, (N, 25, H, W); (N, 9, H, W) of radiance at full resolution.
    kernel: Field<T>,
    /// How far each pixel is to be trusted, (N, 1, H, W).
    confidence: Field<T>,
    /// The share of the level below before its logistic, (N, 1, H, W).
    mask: Field<T>,
    /// Logits of the corners from which that level is upsampled, (N, 4, H, W).
    corners: Field<T>,
}

/// What the head of full resolution says of the rest of a frame, once its light is filtered.
struct Finish<T> {
    /// Logits of the gains, (N, 3, H, W).
    gain: Field<T>,
    /// But for a prefilter, how far to divide by the noisy albedo, before its logistic, and what the shading is
    /// multiplied by before it is added to all gains' logits, both (N, 1, H, W).
    refined: Option<(Field<T>, Field<T>)>,
}

impl<T: Tape<f32, Cpu> + Merge<T>> Prediction<T> {
    /// The same once more, with empty tapes.
    fn fork(&self) -> Self {
        let Self { kernel, confidence, mask, corners } = self;
        let [kernel, confidence, mask, corners] = [kernel, confidence, mask, corners].map(Field::fork);
        Self { kernel, confidence, mask, corners }
    }

    /// Parts what a level's head says, k x k kernels first: `planes(first, count)` are some of its planes.
    fn split(k: usize, mut planes: impl FnMut(usize, usize) -> Field<T>) -> Self {
        let taps = k * k;
        Self {
            kernel: planes(0, taps),
            confidence: planes(taps, 1),
            mask: planes(taps + 1, 1),
            corners: planes(taps + 2, CORNERS),
        }
    }

    /// Parts what the head of full resolution says, k x k kernels first, which has `count` planes.
    fn split_full(
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

impl Pyramid {
    /// A network with fresh weights drawn from `seed`; `widths` are the encoders', finest first.
    ///
    /// # Panics
    /// If `widths` does not hold one width a level.
    pub fn new(config: &Config, seed: u64) -> Self {
        let rng = &mut Rng::new(seed, 0);
        let mut network = Self::named("", config.clone(), rng);
        if !network.denoises_guides() {
            let own = Config::new(Architecture::Prefilter, &config.prefilter);
            let mut prefilter = Self::named(PREFILTER, own, rng);
            prefilter.params().into_iter().for_each(|param| param.trainable = false);
            network.prefilter = Some(Box::new(prefilter));
        }
        network
    }

    /// A network, but for its prefilter, whose layers' names begin with `prefix`.
    fn named(prefix: &str, config: Config, rng: &mut Rng) -> Self {
        let widths = &config.widths;
        assert_eq!(widths.len(), LEVELS, "one width a level");
        let (guides, finish) = match config.architecture {
            Architecture::Prefilter => (NORMAL_CHANNELS, GAINS),
            _ => (GUIDE_CHANNELS, GAINS + DIVISOR + SHADE),
        };
        let encoders = [
            Encoder::new(rng, &format!("{prefix}encoder.radiance"), RADIANCE_CHANNELS, widths),
            Encoder::new(rng, &format!("{prefix}encoder.guide"), guides, widths),
        ];
        let decoder_width = |level: usize| widths[level] + DECODER_EXTRA;
        let head_width = |level: usize| head_of(kernel_of(config.architecture, level));
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
        Self {
            full: head("head.full".into(), decoder_width(0), 4 * (head_width(0) + finish)),
            heads: (0..LEVELS)
                .map(|l| head(format!("head.{l}"), decoder_width(l), head_width(l + 1)))
                .collect(),
            config,
            prefilter: None,
            encoders,
            decoder,
        }
    }

    /// Whether it is a prefilter, which denoises albedo and normal, not radiance.
    fn denoises_guides(&self) -> bool {
        self.config.architecture == Architecture::Prefilter
    }

    /// Rows and columns of the kernels of a level, 0 the finest.
    fn kernel(&self, level: usize) -> usize {
        kernel_of(self.config.architecture, level)
    }

    fn run<T: Tape<f32, Cpu> + Merge<T>>(&self, batch: &Batch) -> Images<T> {
        let [image_input, second, radiance_input, guide_input, refined @ ..] = &batch[..] else {
            unreachable!("`inputs` makes four planes, and but for a prefilter three more")
        };
        let field =
            |(shape, values): &Stacked| Field::<T>::input((shape.n, shape.c, shape.h, shape.w), values);
        let mut skips = [(radiance_input, 0), (guide_input, 1)]
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
            heads.push(head.forward(vec![fused.fork()])); // (N, K, H, W) -> (N, 27, H, W)
            x = Some(fused);
        }
        let full = self.full.forward(vec![x.expect("there are levels")]);
        let count = full.shape().c / 4;

        // What is predicted for every pyramid level, full resolution first.
        let (finest, Finish { gain, refined: predicted }) =
            Prediction::split_full(self.kernel(0), count, planes_of(full, 2));
        let mut levels = vec![finest];
        levels.extend(heads.into_iter().rev().map(|head| Prediction::split(KERNEL, planes_of(head, 1))));

        let image = field(image_input);
        let ([ratio, shading, normal], Some((divisor, shade))) = (refined, predicted) else {
            let normal = filter_levels(field(second), levels.iter().map(Prediction::fork).collect());
            return filter_levels(image, levels).amplify(gain).beside(normal).into_images();
        };
        let image = image.redivide(field(ratio), divisor);
        let gain = gain.plus_product(field(shading), shade);
        let image = filter_levels(image, levels).product(field(second)).amplify(gain);
        let factors = factors(image.values(), image_input, normal, second);
        image.product(field(&factors)).into_images()
    }

    /// How far it sees in its inputs, the denoised guides among them.
    fn reach_in_inputs(&self) -> usize {
        // At each trunk level two 3x3 convolutions and one more, and half a pixel each of a pool and an upsampling; then the
        // kernels, and below full resolution a pixel for the corners of an upsampling and half a one for the squares of an image.
        let trunk: usize = (1..=LEVELS).map(|level| (2 + 1 + 1) << level).sum();
        let kernels: usize = (0..=LEVELS).map(|level| (self.kernel(level) / 2) << level).sum();
        let pyramid: usize = (1..=LEVELS).map(|level| 3 << (level - 1)).sum();
        trunk + kernels + pyramid
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
fn filter_levels<T: Tape<f32, Cpu> + Merge<T>>(mut image: Field<T>, levels: Vec<Prediction<T>>) -> Field<T> {
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

/// What a refit multiplies denoised images by, (N, 3, H, W).
fn factors(image: &[f32], irradiance: &Stacked, normal: &Stacked, albedo: &Stacked) -> Stacked {
    let (shape, pixels) = (irradiance.0, irradiance.0.h * irradiance.0.w);
    let size = (shape.w, shape.h);
    let mut factors = PlaneBuffer::from(image.to_vec());
    for (n, image) in factors.chunks_exact_mut(3 * pixels).enumerate() {
        let of_image = 3 * n * pixels..3 * (n + 1) * pixels;
        let [normal, albedo] = [normal, albedo].map(|guide| &guide.1[of_image.clone()]);
        let guides = Guides { size, normal, albedo, first: 0 };
        let samples = Samples::Divided(&irradiance.1[of_image]);
        Refit::new(size).advance(guides, image, samples, shape.h, |value, factor| *value = factor);
    }
    (shape, factors)
}

impl Network for Pyramid {
    fn config(&self) -> Config {
        self.config.clone()
    }

    fn passes(&self) -> &'static [Pass] {
        if self.denoises_guides() { &PREFILTERED_PASSES } else { &GUIDE_PASSES }
    }

    fn targets(&self) -> &'static [Pass] {
        if self.denoises_guides() { &PREFILTERED_PASSES } else { &[Pass::Combined] }
    }

    fn target(&self, reference: &PassSet) -> Result<Planes> {
        if self.denoises_guides() {
            return guide_targets(reference, NEEDED_BY);
        }
        Ok(reference.require(Pass::Combined, NEEDED_BY)?.clone())
    }

    fn multiple(&self) -> usize {
        1 << LEVELS
    }

    fn inputs(&self, passes: &PassSet) -> Result<Inputs> {
        let Some(mut clean) = self.clean_guides(passes)? else {
            let exposure = albedo_exposure(passes.require(Pass::DenoisingAlbedo, NEEDED_BY)?);
            return noisy_guides(passes, exposure, NEEDED_BY);
        };
        let exposure = exposure(passes.require(Pass::Combined, NEEDED_BY)?);
        let (rows, size) = (0..passes.height, (passes.width, passes.height));
        let mut take = |pass| clean.remove(pass).expect("a clean guide");
        let (albedo, normal) = (take(Pass::DenoisingAlbedo), take(Pass::DenoisingNormal));
        let shading = Shading::of(passes, exposure, NEEDED_BY)?.rows(passes, rows.clone(), NEEDED_BY)?;
        let refined = Refined { albedo, normal, shading };
        guides(&guide_rows(passes, rows, size, exposure, NEEDED_BY)?, refined, exposure, NEEDED_BY)
    }

    fn params(&mut self) -> Vec<&mut Param> {
        self.convolutions().into_iter().flat_map(Conv::params).collect()
    }

    fn convolutions(&mut self) -> Vec<&mut Conv> {
        let encoders = self.encoders.iter_mut().flat_map(|e| e.levels.iter_mut().flatten());
        let decoder =
            self.decoder.iter_mut().flat_map(|l| l.up.iter_mut().chain([&mut l.fuse, &mut l.refine]));
        let heads = [&mut self.full].into_iter().chain(&mut self.heads);
        let prefilter = self.prefilter.iter_mut().flat_map(|prefilter| prefilter.convolutions());
        encoders.chain(decoder).chain(heads).chain(prefilter).collect()
    }

    fn freeze(&mut self) {
        if self.full.arithmetic().precision != Precision::Int8 {
            return self.convolutions().into_iter().for_each(|conv| conv.freeze(&[]));
        }
        if let Some(prefilter) = &mut self.prefilter {
            prefilter.freeze();
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

    fn is_quantizable(&mut self) -> bool {
        self.convolutions().into_iter().all(|conv| conv.is_quantizable())
    }

    fn forward(&self, batch: &Batch, _: &mut Stats) -> Images {
        self.run::<NoneTape>(batch)
    }

    fn forward_taped(&self, batch: &Batch, _: &mut Stats) -> Images<Taped> {
        self.run::<Taped>(batch)
    }

    fn macs_per_pixel(&self) -> f64 {
        let convolutions: f64 = self
            .convolution_levels()
            .map(|(c, level)| c.macs_per_output_pixel() as f64 / 4f64.powi(level as i32))
            .sum();
        // Three channels of each image and the sum of weights, at every pyramid level.
        let images = if self.denoises_guides() { 2 } else { 1 };
        let taps = |level: usize| (4 * images * self.kernel(level).pow(2)) as f64 / 4f64.powi(level as i32);
        let filters: f64 = (0..=LEVELS).map(taps).sum();
        let prefilter = self.prefilter.as_ref().map_or(0.0, |prefilter| prefilter.macs_per_pixel());
        convolutions + filters + prefilter
    }

    fn reach(&self) -> usize {
        self.reach_in_inputs() + self.prefilter.as_ref().map_or(0, |prefilter| prefilter.reach())
    }

    fn infer(&self, passes: &PassSet, tile: Option<usize>) -> Result<Planes> {
        if self.denoises_guides() {
            let guides = strips::infer_guides(self, passes, tile)?;
            let rows = |c: usize, y: usize, row: &mut [f32]| {
                row.copy_from_slice(&guides[c / 3].channel(c % 3)[y * passes.width..][..passes.width]);
            };
            return Ok(Planes::from_rows(6, (passes.width, passes.height), rows));
        }
        strips::infer(self, passes, None, &mut [], tile)
    }

    fn clean_guides(&self, passes: &PassSet) -> Result<Option<PassSet>> {
        let Some(prefilter) = &self.prefilter else { return Ok(None) };
        let [albedo, normal] = strips::infer_guides(prefilter, passes, None)?;
        let mut guides = passes.rows(&[], 0..passes.height);
        guides.insert(Pass::DenoisingAlbedo, albedo_of_target(albedo));
        guides.insert(Pass::DenoisingNormal, normal_of_target(normal));
        Ok(Some(guides))
    }

    fn infer_with(
        &self,
        passes: &PassSet,
        guides: &PassSet,
        companions: &mut [Companion],
        tile: Option<usize>,
    ) -> Result<Planes> {
        strips::infer(self, passes, Some(guides), companions, tile)
    }

    fn takes_companions(&self) -> bool {
        !self.denoises_guides()
    }

    fn infer_along(
        &self,
        passes: &PassSet,
        companions: &mut [Companion],
        tile: Option<usize>,
    ) -> Result<Planes> {
        strips::infer(self, passes, None, companions, tile)
    }

    fn duplicate(&self) -> Box<dyn Network> {
        duplicate(self)
    }
}
