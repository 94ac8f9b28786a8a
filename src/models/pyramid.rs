//! The built-in network: a dual encoder at half resolution that predicts kernels instead of colours.
//!
//! As in DEMC, guides and radiance are encoded apart and fused at every level of the decoder. The rest
//! follows what measurement favoured: the trunk works on 2x2 squares (space to depth), and each level
//! predicts softmax kernels that filter that level of a radiance pyramid (Bako et al. 2017; Vogels et
//! al. 2018), after it was corrected by what filtering changed in the level below: a level's own kernels
//! come last, and smooth what upsampling left uneven. Radiance is divided by albedo first and multiplied
//! by a filtered albedo last, so texture is never blurred with the noise. The albedo has a pyramid of its own:
//! depth of field, rough glass and edges leave noise in it at 4 samples, as coarse as the radiance's. Each
//! pixel has its divisor between the noisy and the filtered albedo (see [`crate::kernels::divide`]). A
//! confidence for every pixel and level lets a firefly take itself out of all kernels at once.
//!
//! A network that outputs kernels cannot invent a colour, and scales with its input exactly.

mod bands;

use dfdx::tensor::{Cpu, Merge, NoneTape, Tape};

use super::network::{Batch, Config, Network, Taped, duplicate};
use crate::{
    Result,
    features::{GUIDE_PASSES, Inputs, guides},
    kernels::blend::CORNERS,
    nn::{Activation, Conv, Field, Images, Init, MaxPool, Param, Rng, Stats},
    passes::{Pass, PassSet},
    planes::Planes,
};

/// Levels of the trunk: 1/2, 1/4, 1/8 and 1/16 of the frame.
pub const LEVELS: usize = 4;

/// An image that the network filters: the size of its kernels, and where a head's channels for it begin.
struct Filtered {
    /// Rows and columns of the kernels.
    kernel: usize,
    /// First channels in the head of a trunk level, and in that of full resolution for one pixel.
    of_level: Channels,
    of_full: Channels,
}

/// The first channels of what is predicted for one level of an image's pyramid.
struct Channels {
    kernel: usize,
    confidence: usize,
    mask: usize,
    corners: usize,
}

/// Radiance over albedo, and albedo. The order of channels is that in which they were added: a head takes
/// over the weights of an older one that had fewer.
const FILTERED: [Filtered; 2] = [
    Filtered {
        kernel: 5,
        of_level: Channels { kernel: 0, confidence: 25, mask: 26, corners: 27 },
        of_full: Channels { kernel: 0, confidence: 25, mask: 26, corners: 36 },
    },
    Filtered {
        kernel: 3,
        of_level: Channels { kernel: 31, confidence: 40, mask: 41, corners: 42 },
        of_full: Channels { kernel: 27, confidence: 40, mask: 41, corners: 42 },
    },
];

/// Channels of a trunk level's head.
const HEAD: usize = 46;

/// The channel of the full-resolution head that says how far the filtered albedo is the divisor.
const DIVISOR: usize = 46;

/// Channels of that head for one pixel.
const FULL_HEAD: usize = 47;

/// The albedo is mostly right as it is: its masks begin with 5% of what the level below says, and 5% of the
/// divisor is filtered.
const ALBEDO_BIAS: f32 = -3.0;

/// A decoder level is this much wider than the encoders beside it.
const DECODER_EXTRA: usize = 16;

/// Heads begin this much smaller than Xavier: kernels start nearly flat.
const HEAD_GAIN: f32 = 0.3;

/// Channels of the radiance encoder's and of the guide encoder's input, before space to depth.
const RADIANCE_CHANNELS: usize = 3;
const GUIDE_CHANNELS: usize = 6;

/// The kernel-predicting dual encoder.
#[derive(Clone)]
pub struct Pyramid {
    config: Config,
    encoders: [Encoder; 2],
    /// Coarsest level first.
    decoder: Vec<Level>,
    /// Full resolution, four pixels at once.
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

/// What a head says of one level of an image's pyramid.
struct Prediction<T> {
    /// Logits of the kernels, (N, k*k, H, W).
    kernel: Field<T>,
    /// How far each pixel is to be trusted, (N, 1, H, W).
    confidence: Field<T>,
    /// The share of the level below before its logistic, (N, 1, H, W).
    mask: Field<T>,
    /// Logits of the corners from which that level is upsampled, (N, 4, H, W).
    corners: Field<T>,
}

impl<T: Tape<f32, Cpu> + Merge<T>> Prediction<T> {
    /// What the head of a trunk level says of that level of each image.
    fn of_level(head: Activation<T>) -> [Self; 2] {
        let [irradiance, albedo] = &FILTERED;
        [
            Self::split(head.fork(), irradiance.kernel, &irradiance.of_level, 1),
            Self::split(head, albedo.kernel, &albedo.of_level, 1),
        ]
    }

    /// What the head of full resolution says of each image, and the filtered albedo's share of the divisor,
    /// (N, 1, H, W).
    fn of_full(head: Activation<T>) -> ([Self; 2], Field<T>) {
        let [irradiance, albedo] = &FILTERED;
        let divisor = Field::from_activation(head.fork(), 4 * DIVISOR, 4, 2);
        let irradiance = Self::split(head.fork(), irradiance.kernel, &irradiance.of_full, 2);
        ([irradiance, Self::split(head, albedo.kernel, &albedo.of_full, 2)], divisor)
    }

    /// `factor` is 2 where each 2x2 square of pixels shares one pixel of the trunk.
    fn split(head: Activation<T>, k: usize, first: &Channels, factor: usize) -> Self {
        let area = factor * factor;
        let field = |head, first: usize, count: usize| {
            Field::from_activation(head, first * area, count * area, factor)
        };
        Self {
            kernel: field(head.fork(), first.kernel, k * k),
            confidence: field(head.fork(), first.confidence, 1),
            mask: field(head.fork(), first.mask, 1),
            corners: field(head, first.corners, CORNERS), // with the tape
        }
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
        let widths = &config.widths;
        assert_eq!(widths.len(), LEVELS, "one width a level");
        let rng = &mut Rng::new(seed, 0);
        let encoders = [
            Encoder::new(rng, "encoder.radiance", RADIANCE_CHANNELS, widths),
            Encoder::new(rng, "encoder.guide", GUIDE_CHANNELS, widths),
        ];
        let decoder_width = |level: usize| widths[level] + DECODER_EXTRA;
        let decoder = (0..LEVELS).rev().map(|level| {
            let (width, skip) = (decoder_width(level), widths[level]);
            let up = (level + 1 < LEVELS).then(|| {
                Conv::transposed(rng, &format!("decoder.{level}.up"), decoder_width(level + 1), width)
            });
            let mut sources = vec![skip, skip];
            sources.extend(up.iter().map(|_| width));
            let name = format!("decoder.{level}");
            Level {
                up,
                fuse: Conv::new(rng, &format!("{name}.fuse"), &sources, width, 1, Init::Xavier),
                refine: Conv::new(rng, &format!("{name}.refine"), &[width], width, 3, Init::Xavier),
            }
        });
        let decoder = decoder.collect();
        let mut head = |name: String, width: usize, channels: usize| {
            let conv = Conv::new(rng, &name, &[width], channels, 1, Init::Scaled(HEAD_GAIN)).linear();
            let (area, mask) = (channels / HEAD, FILTERED[1].of_level.mask);
            conv.with_bias(mask * area..(mask + 1) * area, ALBEDO_BIAS).with_bias(HEAD * area.., ALBEDO_BIAS)
        };
        Self {
            full: head("head.full".into(), decoder_width(0), 4 * FULL_HEAD),
            heads: (0..LEVELS).map(|l| head(format!("head.{l}"), decoder_width(l), HEAD)).collect(),
            config: config.clone(),
            encoders,
            decoder,
        }
    }

    /// Denoised radiance and the filtered albedo.
    fn run<T: Tape<f32, Cpu> + Merge<T>>(&self, batch: &Batch) -> (Field<T>, Field<T>) {
        let [irradiance, albedo, radiance_input, guide_input] = &batch[..] else {
            unreachable!("`inputs` makes four planes")
        };
        let field = |(shape, values): &(crate::kernels::Shape, Vec<f32>)| {
            Field::<T>::input((shape.n, shape.c, shape.h, shape.w), values)
        };
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
            heads.push(head.forward(vec![fused.fork()])); // (N, K, H, W) -> (N, 46, H, W)
            x = Some(fused);
        }
        let full = self.full.forward(vec![x.expect("there are levels")]);

        // What is predicted for every level of each image's pyramid, full resolution first.
        let (finest, divisor) = Prediction::of_full(full);
        let [mut of_irradiance, mut of_albedo] = finest.map(|finest| vec![finest]);
        for head in heads.into_iter().rev() {
            let [irradiance, albedo] = Prediction::of_level(head);
            of_irradiance.push(irradiance);
            of_albedo.push(albedo);
        }
        let noisy = field(albedo);
        let albedo = filtered(noisy.fork(), of_albedo, FILTERED[1].kernel);
        let irradiance = field(irradiance).redivide(&noisy, albedo.fork(), divisor);
        let irradiance = filtered(irradiance, of_irradiance, FILTERED[0].kernel);
        let second = albedo.fork(); // the tape goes with the radiance
        (irradiance.product(albedo), second)
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

/// Filters an image, (N, 3, H, W), by k x k kernels on all levels of its pyramid; `levels` says how, full
/// resolution first. From the coarsest level up, each is corrected by what filtering changed in the one below,
/// and filtered.
fn filtered<T: Tape<f32, Cpu> + Merge<T>>(image: Field<T>, levels: Vec<Prediction<T>>, k: usize) -> Field<T> {
    let mut image = image;
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
    let mut correction: Option<Field<T>> = None;
    loop {
        let (noisy, Prediction { kernel, confidence, mask, corners }) =
            pyramid.pop().expect("there are levels");
        let corrected = match correction.take() {
            None => noisy.fork(),
            // (N, 3, H, W) and (N, 3, H/2, W/2) -> (N, 3, H, W)
            Some(correction) => noisy.fork().blend(correction, mask, corners),
        };
        let filtered = corrected.filter(k, kernel, Some(confidence));
        if pyramid.is_empty() {
            return filtered;
        }
        correction = Some(filtered.minus(noisy));
    }
}

impl Network for Pyramid {
    fn config(&self) -> Config {
        self.config.clone()
    }

    fn passes(&self) -> &'static [Pass] {
        &GUIDE_PASSES
    }

    fn multiple(&self) -> usize {
        1 << LEVELS
    }

    fn inputs(&self, passes: &PassSet) -> Result<Inputs> {
        guides(passes, "this model")
    }

    fn params(&mut self) -> Vec<&mut Param> {
        self.convolutions().into_iter().flat_map(Conv::params).collect()
    }

    fn convolutions(&mut self) -> Vec<&mut Conv> {
        let encoders = self.encoders.iter_mut().flat_map(|e| e.levels.iter_mut().flatten());
        let decoder =
            self.decoder.iter_mut().flat_map(|l| l.up.iter_mut().chain([&mut l.fuse, &mut l.refine]));
        encoders.chain(decoder).chain([&mut self.full]).chain(&mut self.heads).collect()
    }

    fn forward(&self, batch: &Batch, _: &mut Stats) -> Images {
        self.run::<NoneTape>(batch).0.into_images()
    }

    fn forward_taped(&self, batch: &Batch, stats: &mut Stats) -> Images<Taped> {
        self.forward_with_albedo(batch, stats).0
    }

    fn forward_with_albedo(&self, batch: &Batch, _: &mut Stats) -> (Images<Taped>, Option<Images<Taped>>) {
        let (image, albedo) = self.run::<Taped>(batch);
        (image.into_images(), Some(albedo.into_images()))
    }

    fn macs_per_pixel(&self) -> f64 {
        let convolutions: f64 = self
            .convolution_levels()
            .map(|(c, level)| c.macs_per_output_pixel() as f64 / 4f64.powi(level as i32))
            .sum();
        // Three channels and the sum of weights, at every level of both pyramids.
        let taps: usize = FILTERED.iter().map(|image| image.kernel * image.kernel).sum();
        let filters: f64 = (0..=LEVELS).map(|l| (4 * taps) as f64 / 4f64.powi(l as i32)).sum();
        convolutions + filters
    }

    fn reach(&self) -> usize {
        // At each trunk level two 3x3 convolutions, a pool, one 3x3 and an upsampling; then the kernels of one
        // image's pyramid, which reads what those of the other's made.
        let trunk: usize = (1..=LEVELS).map(|level| (2 + 1 + 1 + 2) << level).sum();
        let kernels = FILTERED.iter().flat_map(|image| (0..=LEVELS).map(|l| (image.kernel / 2 + 1) << l));
        trunk + kernels.sum::<usize>()
    }

    fn infer(&self, passes: &PassSet, tile: Option<usize>) -> Result<Planes> {
        bands::infer(self, passes, tile)
    }

    fn duplicate(&self) -> Box<dyn Network> {
        duplicate(self)
    }
}
