//! The network of the paper and its two variants, with the width as a parameter.
//!
//! "DEMC: A Deep Dual-Encoder Network for Denoising Monte Carlo Rendering" (Yang et al.), Section
//! 3.2. In: colour `c^(1/2.2)` (3 channels) and 12 z-scored feature channels; out: radiance.
//! `semc` encodes detail map and colour together (Section 4.4); `demc-nofusion` feeds the features
//! straight into the feature encoder (Section 4.3).

use dfdx::{
    tensor::{Cpu, Merge, NoneTape, Tape, WithEmptyTape},
    tensor_ops::{abs, exp, ln, powf, relu},
};

use super::network::{Architecture, Batch, Config, Design, Network, Taped, convolution_weights, duplicate};
use crate::{
    Result,
    features::{GAMMA, Inputs, PAPER_FEATURES, PAPER_PASSES, paper_colour, paper_features},
    nn::{Activation, BatchNorm, Conv, Images, Init, MaxPool, Param, Stats},
    passes::{Pass, PassSet},
    rng::Rng,
};

/// Channels at each level in the paper.
pub const PAPER_WIDTHS: [usize; 5] = [64, 128, 256, 512, 512];

/// Channels of the detail map.
const DETAIL: usize = 3;

/// The bias of the last layer at the start, and the factor on its Xavier weights. They make the first outputs
/// dark grey; unscaled weights make them so bright that RelMSE's first steps overshoot to black.
const OUTPUT_BIAS: f32 = 0.2;
const OUTPUT_GAIN: f32 = 0.1;

/// How sharply the last activation bends: it differs from a ReLU by at most `ln 2` divided by this.
const SHARPNESS: f32 = 16.0;

/// The trained parameters of a network of these widths.
pub fn parameters(architecture: Architecture, widths: &[usize]) -> usize {
    let conv = |taps: usize, inputs: usize, outputs: usize| (taps * inputs + 1) * outputs;
    let encoder = |inputs: usize| {
        let mut from = inputs;
        let unit = |&width: &usize| {
            let first = conv(9, std::mem::replace(&mut from, width), width);
            first + 2 * conv(9, width, width)
        };
        widths.iter().map(unit).sum::<usize>()
    };
    let first = widths[0];
    let fusion =
        conv(9, PAPER_FEATURES, first) + 2 * (conv(9, first, first) + 2 * first) + conv(9, first, DETAIL);
    let (encoders, sources) = match architecture {
        Architecture::Semc => (fusion + encoder(DETAIL + 3), 2),
        Architecture::DemcNofusion => (encoder(PAPER_FEATURES) + encoder(3), 3),
        _ => (fusion + encoder(DETAIL) + encoder(3), 3),
    };
    let level = |(level, &width): (usize, &usize)| {
        let below = *widths.get(level + 1).unwrap_or(&width);
        conv(16, below, width) + conv(1, sources * width, width)
    };
    encoders + widths.iter().enumerate().map(level).sum::<usize>() + conv(1, first, 3)
}

/// The widths at which `semc` has as many parameters as `demc` of `widths`, within 1% (Section 4.4): all of
/// them are multiplied by one factor and rounded, then changed by single channels where rounding left too
/// many or too few parameters.
pub fn semc_widths(widths: &[usize]) -> Vec<usize> {
    let wanted = parameters(Architecture::Demc, widths) as f64;
    let scaled = |factor: f64| -> Vec<usize> {
        widths.iter().map(|w| ((*w as f64 * factor).round() as usize).max(1)).collect()
    };
    let count = |widths: &[usize]| parameters(Architecture::Semc, widths) as f64;
    // One encoder stands in place of two, so the factor lies between 1 and 2.
    let (mut low, mut high) = (1.0, 2.0);
    for _ in 0..30 {
        let factor = 0.5 * (low + high);
        if count(&scaled(factor)) < wanted { low = factor } else { high = factor }
    }
    let mut best = scaled(high);
    let off = |widths: &[usize]| (count(widths) / wanted - 1.0).abs();
    loop {
        // One or two levels become wider or narrower by a channel.
        let steps = || (0..best.len()).flat_map(|level| [(level, 1), (level, -1)]);
        let changed = steps().flat_map(|one| steps().map(move |two| [one, two])).map(|steps| {
            let mut changed = best.clone();
            for (level, by) in steps {
                changed[level] = changed[level].saturating_add_signed(by).max(1);
            }
            changed
        });
        let nearest = changed.min_by(|a, b| off(a).total_cmp(&off(b))).expect("there are levels");
        if off(&best) < 0.005 || off(&nearest) >= off(&best) {
            return best;
        }
        best = nearest;
    }
}

/// DEMC, with fusion or without.
pub static DESIGN: Design = Design {
    inputs: "paper/gamma/1",
    levels: PAPER_WIDTHS.len(),
    prefilter_levels: 0,
    least_parameters: |config| convolution_weights(4, &config.widths),
    build: |config, seed| Box::new(Demc::new(config.architecture, &config.widths, seed)),
};

/// SEMC.
pub static SINGLE: Design =
    Design { least_parameters: |config| convolution_weights(2, &config.widths), ..DESIGN };

/// DEMC, DEMC without fusion, or SEMC.
#[derive(Clone)]
pub struct Demc {
    config: Config,
    fusion: Option<Fusion>,
    /// Feature encoder and colour encoder, or SEMC's single one.
    encoders: Vec<Encoder>,
    decoder: Vec<Level>,
    output: Conv,
}

/// The feature fusion sub-network: 12 channels to the 3 of the detail map.
#[derive(Clone)]
struct Fusion {
    first: Conv,
    /// A folded convolution has no batch norm.
    middle: Vec<(Conv, Option<BatchNorm>)>,
    last: Conv,
}

/// Five units of three convolutions and a pool.
#[derive(Clone)]
struct Encoder {
    units: Vec<[Conv; 3]>,
}

/// One level of the decoder: upsampling and skip fusion.
#[derive(Clone)]
struct Level {
    up: Conv,
    fuse: Conv,
}

impl Fusion {
    /// `width` is the number of channels between the blocks. The paper leaves it open; it is that of the
    /// first level.
    fn new(rng: &mut Rng, width: usize) -> Self {
        let mut conv = |name: &str, i: usize, o: usize| Conv::new(rng, name, &[i], o, 3, Init::Xavier);
        Self {
            first: conv("fusion.0", PAPER_FEATURES, width),
            middle: (1..3)
                .map(|i| {
                    let name = format!("fusion.{i}");
                    let norm = BatchNorm::new(&format!("{name}.norm"), width);
                    (conv(&name, width, width).linear(), Some(norm))
                })
                .collect(),
            last: conv("fusion.3", width, DETAIL),
        }
    }

    /// (N, 12, H, W) -> (N, 3, H, W)
    fn forward<T: Tape<f32, Cpu> + Merge<T>>(&self, x: Activation<T>, stats: &mut Stats) -> Activation<T> {
        let mut x = self.first.forward(vec![x]);
        for (conv, norm) in &self.middle {
            x = conv.forward(vec![x]);
            if let Some(norm) = norm {
                x = norm.forward(x, stats);
            }
        }
        self.last.forward(vec![x])
    }
}

impl Encoder {
    fn new(rng: &mut Rng, name: &str, inputs: &[usize], widths: &[usize]) -> Self {
        let mut inputs = inputs.to_vec();
        let units = widths.iter().enumerate().map(|(level, &width)| {
            std::array::from_fn(|i| {
                let from = std::mem::replace(&mut inputs, vec![width]);
                Conv::new(rng, &format!("{name}.{level}.{i}"), &from, width, 3, Init::Xavier)
            })
        });
        Self { units: units.collect() }
    }

    /// The activation before each pool, finest first. The tape goes with the last: what reads it must read that
    /// one too, or nothing here is trained.
    fn forward<T: Tape<f32, Cpu> + Merge<T>>(&self, input: Vec<Activation<T>>) -> Vec<Activation<T>> {
        let mut x = input;
        let mut skips: Vec<Activation<T>> = Vec::with_capacity(self.units.len());
        for unit in &self.units {
            if let Some(before) = skips.pop() {
                skips.push(before.fork());
                x = vec![MaxPool.forward(before)]; // (N, K, H, W) -> (N, K, H/2, W/2)
            }
            for conv in unit {
                x = vec![conv.forward(x)];
            }
            skips.push(x.pop().expect("a unit has one output"));
        }
        skips
    }
}

impl Demc {
    /// A network with fresh weights drawn from `seed`.
    ///
    /// # Panics
    /// If `widths` does not hold five levels.
    pub fn new(architecture: Architecture, widths: &[usize], seed: u64) -> Self {
        assert_eq!(widths.len(), PAPER_WIDTHS.len(), "the paper's network has five levels");
        let rng = &mut Rng::new(seed, 0);
        let fusion = (architecture != Architecture::DemcNofusion).then(|| Fusion::new(rng, widths[0]));
        let features = if fusion.is_some() { DETAIL } else { PAPER_FEATURES };
        let encoders = if architecture == Architecture::Semc {
            vec![Encoder::new(rng, "encoder", &[DETAIL, 3], widths)]
        } else {
            vec![
                Encoder::new(rng, "encoder.feature", &[features], widths),
                Encoder::new(rng, "encoder.colour", &[3], widths),
            ]
        };
        // Decoder levels run from the coarsest skip to the finest.
        let decoder = (0..widths.len()).rev().map(|level| {
            let (width, below) = (widths[level], widths[(level + 1).min(widths.len() - 1)]);
            Level {
                up: Conv::transposed(rng, &format!("decoder.{level}.up"), below, width),
                fuse: Conv::new(
                    rng,
                    &format!("decoder.{level}.fuse"),
                    &vec![width; encoders.len() + 1],
                    width,
                    1,
                    Init::Identities,
                ),
            }
        });
        let decoder = decoder.collect();
        let output = Conv::new(rng, "output", &[widths[0]], 3, 1, Init::Scaled(OUTPUT_GAIN));
        let output = output.head().with_bias(OUTPUT_BIAS);
        Self { config: Config::new(architecture, widths), fusion, encoders, decoder, output }
    }

    /// What each encoder hands to the decoder, see [`Encoder::forward`]; the colours' is last.
    fn encode<T: Tape<f32, Cpu> + Merge<T>>(
        &self,
        batch: &Batch,
        stats: &mut Stats,
    ) -> Vec<Vec<Activation<T>>> {
        let [colour, features] = [0, 1].map(|i| Activation::<T>::input(batch[i].0, &batch[i].1));
        let detail = match &self.fusion {
            Some(fusion) => fusion.forward(features, stats),
            None => features,
        };
        match &self.encoders[..] {
            [single] => vec![single.forward(vec![detail, colour])],
            [of_features, of_colour] => {
                vec![of_features.forward(vec![detail]), of_colour.forward(vec![colour])]
            }
            _ => unreachable!("there are one or two encoders"),
        }
    }

    fn run<T: Tape<f32, Cpu> + Merge<T>>(&self, batch: &Batch, stats: &mut Stats) -> Images<T> {
        let mut skips = self.encode::<T>(batch, stats);
        let mut x = latent(&skips);
        for level in &self.decoder {
            let up = level.up.forward(vec![x]); // (N, K', H, W) -> (N, K, 2H, 2W)
            let skip = skips.iter_mut().map(|encoder| encoder.pop().expect("one skip a level"));
            x = level.fuse.forward([up].into_iter().chain(skip).collect()); // Eq. 2: (N, 3K, H, W) -> (N, K, H, W)
        }
        let compressed = self.output.forward(vec![x]); // (N, K, H, W) -> (N, 3, H, W)
        powf(softplus(compressed.into_images()), GAMMA)
    }

    /// The extent of the latent, (channels, rows, columns), for a frame of `width` x `height`.
    pub fn latent(&self, width: usize, height: usize) -> (usize, usize, usize) {
        let batch: Batch = [3, PAPER_FEATURES]
            .map(|c| {
                let shape = crate::kernels::Shape::new(1, c, height, width);
                (shape, vec![0.0; c * width * height].into())
            })
            .into();
        let shape = latent(&self.encode::<NoneTape>(&batch, &mut Stats::Running)).shape();
        (shape.c, shape.h, shape.w)
    }

    /// The convolutions, each with the level at which it works.
    fn by_level(&self) -> impl Iterator<Item = (&Conv, usize)> {
        let fusion = self.fusion.iter().flat_map(|f| {
            [&f.first].into_iter().chain(f.middle.iter().map(|m| &m.0)).chain([&f.last]).map(|c| (c, 0))
        });
        let encoders = self.encoders.iter().flat_map(|e| {
            e.units.iter().enumerate().flat_map(|(level, unit)| unit.iter().map(move |c| (c, level)))
        });
        let decoder = self.decoder.iter().rev().enumerate();
        let decoder = decoder.flat_map(|(level, l)| [(&l.up, level), (&l.fuse, level)]);
        fusion.chain(encoders).chain(decoder).chain([(&self.output, 0)])
    }
}

/// Where the decoder starts (Section 3.2): the coarsest level of the colours, pooled once more. (N, K, H, W) ->
/// (N, K, H/2, W/2). The features have no use for theirs.
fn latent<T: Tape<f32, Cpu> + Merge<T>>(encoded: &[Vec<Activation<T>>]) -> Activation<T> {
    let coarsest = encoded.last().and_then(|colour| colour.last());
    MaxPool.forward(coarsest.expect("an encoder has levels").fork())
}

/// `ln(1 + e^(S x)) / S`: like a ReLU, but with a gradient on either side, so that a step too far can be
/// undone.
fn softplus<T: Tape<f32, Cpu> + Merge<T>>(x: Images<T>) -> Images<T> {
    let bend = ln(exp(abs(x.with_empty_tape()) * -SHARPNESS) + 1.0) / SHARPNESS;
    relu(x) + bend
}

impl Network for Demc {
    fn config(&self) -> Config {
        self.config.clone()
    }

    fn passes(&self) -> &'static [Pass] {
        &PAPER_PASSES
    }

    fn multiple(&self) -> usize {
        1 << self.config.widths.len()
    }

    fn inputs(&self, passes: &PassSet) -> Result<Inputs> {
        Ok(Inputs { planes: vec![paper_colour(passes)?, paper_features(passes)?], scale: 1.0 })
    }

    fn convolutions(&mut self) -> Vec<&mut Conv> {
        let fusion = self.fusion.iter_mut().flat_map(|f| {
            let middle = f.middle.iter_mut().map(|(conv, _)| conv);
            [&mut f.first].into_iter().chain(middle).chain([&mut f.last])
        });
        fusion
            .chain(self.encoders.iter_mut().flat_map(|e| e.units.iter_mut().flatten()))
            .chain(self.decoder.iter_mut().flat_map(|level| [&mut level.up, &mut level.fuse]))
            .chain([&mut self.output])
            .collect()
    }

    fn params(&mut self) -> Vec<&mut Param> {
        let mut params = Vec::new();
        if let Some(fusion) = &mut self.fusion {
            params.extend(fusion.first.params());
            for (conv, norm) in &mut fusion.middle {
                params.extend(conv.params());
                params.extend(norm.iter_mut().flat_map(BatchNorm::params));
            }
            params.extend(fusion.last.params());
        }
        for conv in self.encoders.iter_mut().flat_map(|e| e.units.iter_mut().flatten()) {
            params.extend(conv.params());
        }
        for level in &mut self.decoder {
            params.extend(level.up.params());
            params.extend(level.fuse.params());
        }
        params.extend(self.output.params());
        params
    }

    fn freeze(&mut self) {
        for (conv, norm) in self.fusion.iter_mut().flat_map(|f| &mut f.middle) {
            if let Some(norm) = norm.take() {
                conv.fold(&norm);
            }
        }
        self.convolutions().into_iter().for_each(|conv| conv.freeze(&[]));
    }

    fn batch_norms(&mut self) -> Vec<&mut BatchNorm> {
        self.fusion.iter_mut().flat_map(|f| f.middle.iter_mut().filter_map(|m| m.1.as_mut())).collect()
    }

    fn forward(&self, batch: &Batch, stats: &mut Stats) -> Images {
        self.run::<NoneTape>(batch, stats)
    }

    fn forward_taped(&self, batch: &Batch, stats: &mut Stats) -> Images<Taped> {
        self.run::<Taped>(batch, stats)
    }

    fn macs_per_pixel(&self) -> f64 {
        self.by_level().map(|(c, level)| c.macs_per_output_pixel() as f64 / 4f64.powi(level as i32)).sum()
    }

    fn reach(&self) -> usize {
        // Three 3x3 convolutions and a pool a level on the way down, a 4x4 upsampling on the way up.
        let fusion = if self.fusion.is_some() { 4 } else { 0 };
        fusion + (0..self.config.widths.len()).map(|level| (3 + 1 + 2) << level).sum::<usize>()
    }

    fn duplicate(&self) -> Box<dyn Network> {
        duplicate(self)
    }
}
