//! LBF: Kalantari, Bako, Sen 2015, "A Machine Learning Approach for Filtering Monte Carlo Noise" (ACM
//! TOG 34:4).
//!
//! In: `features::lbf`. Out: radiance, filtered by a cross-bilateral filter whose parameters a small
//! perceptron chooses for each pixel from the secondary features (Sections 3.3 and 4.1). Both are trained end
//! to end: the loss is that of the filtered image, and its gradient passes through the filter.
//!
//! Departures: (1) deviations come from neighbouring pixels, since Cycles writes none of its samples, and
//! there is no visibility feature; (2) files do not tell the sampling rate, which is left out of the secondary
//! features; (3) those describe colour too, and their median deviation is that of 3x3 pixels, not of wavelet
//! details; (4) the weight of colour is learned like the others, not fixed; variances are summed over channels
//! before distances are divided by them; features are not prefiltered; (5) exposure is normalised and colour
//! statistics are of its logarithm; (6) Adam or Muon trains it, with any of `demc train`'s losses; (7) no
//! spikes are removed afterwards.

use dfdx::{
    tensor::{Cpu, Merge, NoneTape, Tape, TensorFromVec},
    tensor_ops::{clamp, exp, ln, sigmoid},
};

use super::network::{Architecture, Batch, Config, Design, Network, Taped, duplicate};
use crate::{
    Result,
    features::{Inputs, LBF_CHANNELS, LBF_GROUPS, LBF_PASSES, lbf},
    nn::{Activation, Conv, GuidedImages, Images, Init, Param, Stats, cross_bilateral},
    passes::{Pass, PassSet},
    rng::Rng,
};

/// Number of hidden units as published.
pub const PUBLISHED_WIDTH: usize = 10;

/// The network as published.
pub fn config() -> Config {
    Config::new(Architecture::Lbf, &[PUBLISHED_WIDTH])
}

/// Pixels from the centre of the filter's window, 55x55, to its edge.
const RADIUS: usize = 27;

/// Parameters of the filter: position, colour, each group of features.
const PRECISIONS: usize = 2 + LBF_GROUPS.len();

/// The last layer's bias at the start: it makes precisions near 0.2 and so a wide filter.
const START: f32 = -1.5;

/// Softplus is linear beyond; `exp` must not overflow.
const SOFTPLUS_LIMIT: f32 = 30.0;

/// See [`Design`].
pub static DESIGN: Design = Design {
    inputs: "lbf/logarithm/2",
    levels: 1,
    prefilter_levels: 0,
    least_parameters: |config| config.widths[0],
    build: |config, seed| Box::new(Lbf::new(config, seed)),
};

/// The perceptron.
#[derive(Clone)]
pub struct Lbf {
    config: Config,
    hidden: Conv,
    output: Conv,
}

impl Lbf {
    /// A network with fresh weights drawn from `seed`.
    ///
    /// # Panics
    /// If `config` does not hold one width.
    pub fn new(config: &Config, seed: u64) -> Self {
        let [width] = config.widths[..] else { panic!("there is one hidden layer") };
        let rng = &mut Rng::new(seed, 0);
        // A perceptron of each pixel is a 1x1 convolution.
        Self {
            config: config.clone(),
            hidden: Conv::new(rng, "hidden", &[LBF_CHANNELS], width, 1, Init::Xavier).linear(),
            output: Conv::new(rng, "output", &[width], PRECISIONS, 1, Init::Xavier).head().with_bias(START),
        }
    }

    fn run<T: Tape<f32, Cpu> + Merge<T>>(&self, batch: &Batch) -> Images<T> {
        let [image, noise, features, scales, secondary] = &batch[..] else {
            unreachable!("`inputs` makes five planes")
        };
        let hidden = self.hidden.forward(vec![Activation::<T>::input(secondary.0, &secondary.1)]);
        let hidden = sigmoid(hidden.into_images());
        let output = self.output.forward(vec![Activation::from_images(hidden)]).into_images();
        let precision = ln(exp(clamp(output, -SOFTPLUS_LIMIT, SOFTPLUS_LIMIT)) + 1.0);
        let shape = (scales.0.n, PRECISIONS, scales.0.h, scales.0.w);
        let scales: Images = Cpu::default().tensor_from_vec(scales.1.to_vec(), shape);
        let guides = GuidedImages {
            radius: RADIUS,
            image: image.1.to_vec(),
            noise: noise.1.to_vec(),
            features: features.1.to_vec(),
            groups: LBF_GROUPS.to_vec(),
        };
        cross_bilateral(guides, precision * scales) // (N, 6, H, W) -> (N, 3, H, W)
    }
}

impl Network for Lbf {
    fn config(&self) -> Config {
        self.config.clone()
    }

    fn passes(&self) -> &'static [Pass] {
        &LBF_PASSES
    }

    fn notes(&self) -> Option<String> {
        Some("deviations are estimated from neighbouring pixels".into())
    }

    fn multiple(&self) -> usize {
        1
    }

    fn inputs(&self, passes: &PassSet) -> Result<Inputs> {
        lbf(passes)
    }

    fn params(&mut self) -> Vec<&mut Param> {
        self.hidden.params().into_iter().chain(self.output.params()).collect()
    }

    fn forward(&self, batch: &Batch, _: &mut Stats) -> Images {
        self.run::<NoneTape>(batch)
    }

    fn forward_taped(&self, batch: &Batch, _: &mut Stats) -> Images<Taped> {
        self.run::<Taped>(batch)
    }

    fn macs_per_pixel(&self) -> f64 {
        let perceptron = self.hidden.macs_per_output_pixel() + self.output.macs_per_output_pixel();
        // For each neighbour the distances of all channels, the exponent, and four sums.
        let channels = 3 + LBF_GROUPS.iter().sum::<usize>();
        let window = (2 * RADIUS + 1).pow(2) * (channels + PRECISIONS + 4);
        (perceptron + window) as f64
    }

    fn reach(&self) -> usize {
        RADIUS
    }

    fn duplicate(&self) -> Box<dyn Network> {
        duplicate(self)
    }
}
