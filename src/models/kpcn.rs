//! KPCN: Bako, Vogels, McWilliams, Meyer, Novak, Harvill, Sen, DeRose, Rousselle 2017,
//! "Kernel-Predicting Convolutional Networks for Denoising Monte Carlo Renderings" (ACM TOG 36:4).
//!
//! In: `features::kpcn_streams` where a file holds Cycles' diffuse light passes, else
//! `features::kpcn_combined`. Out: radiance. A stream is nine 5x5 convolutions that predict, for each
//! pixel, a softmax kernel over 21x21 pixels; diffuse light is filtered without its albedo, specular light
//! as a logarithm.
//!
//! Departures: (1) variance comes from neighbouring pixels, since Cycles writes none of its samples; (2)
//! exposure is normalised, and diffuse light too is read (not filtered) as a logarithm: the published
//! networks knew one studio's exposure; (3) both streams are trained at once, end to end, with any of
//! `demc train`'s losses; (4) without light passes one stream filters Combined over the texture of the first
//! surface, with a larger floor; (5) emission and environment are added back unfiltered, and volumes count as
//! specular; (6) the default width is 32; `--widths 100` is the published one.

use dfdx::{
    tensor::{Cpu, Merge, NoneTape, Tape},
    tensor_ops::exp,
};

use super::network::{Architecture, Batch, Config, Design, Network, Stacked, Taped, duplicate, field};
use crate::{
    Result,
    features::{
        Inputs, KPCN_CHANNELS, KPCN_COMBINED_OPTIONAL, KPCN_COMBINED_PASSES, KPCN_PASSES, KPCN_UNFILTERED,
        kpcn_combined, kpcn_streams,
    },
    kernels::Shape,
    nn::{Activation, Conv, Field, Images, Init, Stats},
    passes::{Pass, PassSet},
    rng::Rng,
};

/// Channels of the hidden layers as published.
pub const PUBLISHED_WIDTH: usize = 100;

/// A network of the default width, of two streams or one.
pub fn config(architecture: Architecture) -> Config {
    Config::new(architecture, &[32])
}

/// Convolutions of a stream, and their taps in a row.
const LAYERS: usize = 9;
const TAPS: usize = 5;

/// Rows and columns of the kernels.
const KERNEL: usize = 21;

/// Factor on the last layer's Xavier weights at the start, so that kernels start nearly flat.
const HEAD_GAIN: f32 = 0.3;

/// A frame of more pixels than this is worked on in tiles, since each pixel has 441 kernel weights, which are
/// held twice.
const WHOLE_FRAME_PIXELS: usize = 1 << 18;

/// KPCN with its two streams.
pub static DESIGN: Design = Design {
    inputs: "kpcn-streams/logarithm/1",
    levels: 1,
    prefilter_levels: 0,
    least_parameters: |config| stream_parameters(2, config),
    build: |config, seed| Box::new(Kpcn::new(config, seed)),
};

/// KPCN with a single stream over Combined.
pub static COMBINED: Design = Design {
    inputs: "kpcn-combined/logarithm/2",
    least_parameters: |config| stream_parameters(1, config),
    ..DESIGN
};

/// Parameters of the layers between a stream's first and last.
fn stream_parameters(streams: usize, config: &Config) -> usize {
    streams * (LAYERS - 2) * TAPS * TAPS * config.widths[0] * config.widths[0]
}

/// Both streams, or the single one over Combined.
#[derive(Clone)]
pub struct Kpcn {
    config: Config,
    streams: Vec<Stream>,
}

/// One kernel-predicting network.
#[derive(Clone)]
struct Stream {
    layers: Vec<Conv>,
}

impl Stream {
    fn new(rng: &mut Rng, name: &str, width: usize) -> Self {
        let mut from = KPCN_CHANNELS;
        let mut hidden = |i: usize| {
            let from = std::mem::replace(&mut from, width);
            Conv::new(rng, &format!("{name}.{i}"), &[from], width, TAPS, Init::Xavier)
        };
        let mut layers: Vec<Conv> = (0..LAYERS - 1).map(&mut hidden).collect();
        let last = format!("{name}.{}", LAYERS - 1);
        layers.push(Conv::new(rng, &last, &[width], KERNEL * KERNEL, TAPS, Init::Scaled(HEAD_GAIN)).head());
        Self { layers }
    }

    /// The image (N, 3, H, W), filtered by the kernels that the network reads from `input`.
    fn filter<T: Tape<f32, Cpu> + Merge<T>>(&self, image: &Stacked, input: &Stacked) -> Field<T> {
        let shape = Shape { pad: TAPS / 2, ..input.0 };
        let mut x = Activation::<T>::input(shape, &input.1);
        for layer in &self.layers {
            x = layer.forward(vec![x]); // (N, 34, H, W) -> (N, K, H, W) -> ... -> (N, 441, H, W)
        }
        let logits = Field::from_activation(x, 0, KERNEL * KERNEL, 1);
        field(image).filter(logits, None)
    }
}

impl Kpcn {
    /// A network with fresh weights drawn from `seed`.
    ///
    /// # Panics
    /// If `config` does not hold one width.
    pub fn new(config: &Config, seed: u64) -> Self {
        let [width] = config.widths[..] else { panic!("one width serves all layers") };
        let rng = &mut Rng::new(seed, 0);
        let names: &[&str] = match config.architecture {
            Architecture::Kpcn => &["diffuse", "specular"],
            _ => &["combined"],
        };
        let streams = names.iter().map(|name| Stream::new(rng, name, width)).collect();
        Self { config: config.clone(), streams }
    }

    fn run<T: Tape<f32, Cpu> + Merge<T>>(&self, batch: &Batch) -> Images<T> {
        match (&self.streams[..], &batch[..]) {
            ([stream], [irradiance, albedo, input]) => {
                let filtered = stream.filter::<T>(irradiance, input);
                filtered.into_images() * field::<NoneTape>(albedo).into_images()
            }
            ([of_diffuse, of_specular], [diffuse, colour, specular, unfiltered, input_d, input_s]) => {
                let constant = |planes| field::<NoneTape>(planes).into_images();
                let diffuse = of_diffuse.filter::<T>(diffuse, input_d).into_images() * constant(colour);
                let specular = of_specular.filter::<T>(specular, input_s).into_images();
                // The decomposition and both transfers are undone.
                diffuse + (exp(specular) - 1.0) + constant(unfiltered)
            }
            _ => unreachable!("`inputs` makes the planes of these streams"),
        }
    }
}

impl Network for Kpcn {
    fn config(&self) -> Config {
        self.config.clone()
    }

    fn passes(&self) -> &'static [Pass] {
        match self.config.architecture {
            Architecture::Kpcn => &KPCN_PASSES,
            _ => &KPCN_COMBINED_PASSES,
        }
    }

    fn optional_passes(&self) -> &'static [Pass] {
        match self.config.architecture {
            Architecture::Kpcn => &KPCN_UNFILTERED,
            _ => &KPCN_COMBINED_OPTIONAL,
        }
    }

    fn notes(&self) -> Option<String> {
        let source = match self.config.architecture {
            Architecture::Kpcn => "diffuse and specular light are filtered apart",
            _ => "these weights filter Combined as one stream, without the light passes",
        };
        Some(format!("{source}; variance is estimated from neighbouring pixels"))
    }

    fn whole_frame_pixels(&self) -> usize {
        WHOLE_FRAME_PIXELS
    }

    fn multiple(&self) -> usize {
        1
    }

    fn inputs(&self, passes: &PassSet) -> Result<Inputs> {
        match self.config.architecture {
            Architecture::Kpcn => kpcn_streams(passes),
            _ => kpcn_combined(passes),
        }
    }

    fn convolutions(&mut self) -> Vec<&mut Conv> {
        self.streams.iter_mut().flat_map(|s| &mut s.layers).collect()
    }

    fn forward(&self, batch: &Batch, _: &mut Stats) -> Images {
        self.run::<NoneTape>(batch)
    }

    fn forward_taped(&self, batch: &Batch, _: &mut Stats) -> Images<Taped> {
        self.run::<Taped>(batch)
    }

    fn macs_per_pixel(&self) -> f64 {
        // Three channels and the sum of weights.
        let filter = 4 * KERNEL * KERNEL;
        let stream = |s: &Stream| s.layers.iter().map(Conv::macs_per_output_pixel).sum::<usize>() + filter;
        self.streams.iter().map(stream).sum::<usize>() as f64
    }

    fn reach(&self) -> usize {
        LAYERS * (TAPS / 2) + KERNEL / 2
    }

    fn duplicate(&self) -> Box<dyn Network> {
        duplicate(self)
    }
}
