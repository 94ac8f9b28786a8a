//! What every learned method has in common: a configuration, inputs, parameters, a forward pass.

use dfdx::tensor::{Cpu, OwnedTape};
use serde::{Deserialize, Serialize};

use crate::{
    Result,
    features::{Inputs, crop, pad_to_multiple},
    kernels::Shape,
    nn::{BatchNorm, Images, Param, Stats},
    passes::{Pass, PassSet},
    planes::Planes,
};

/// The tape of a training step.
pub type Taped = OwnedTape<f32, Cpu>;

/// Which network, and how wide: with the parameters, all there is to know of one.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Config {
    /// The design.
    pub architecture: Architecture,
    /// Channels at each level, finest first.
    pub widths: Vec<usize>,
}

impl std::fmt::Display for Config {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let widths: Vec<String> = self.widths.iter().map(usize::to_string).collect();
        write!(f, "{:?} of widths {}", self.architecture, widths.join(","))
    }
}

/// The designs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Architecture {
    /// The paper's dual encoder.
    Demc,
    /// The paper's, with features straight into the feature encoder.
    DemcNofusion,
    /// The paper's single encoder over detail map and colour.
    Semc,
    /// The built-in kernel-predicting dual encoder.
    Pyramid,
}

/// Inputs of several samples of one size: each network input as one (N, C, H, W) array.
pub type Batch = Vec<(Shape, Vec<f32>)>;

/// Stacks samples of one size.
///
/// # Panics
/// If sizes differ, or there is no sample.
pub fn stack(samples: &[Inputs]) -> Batch {
    (0..samples[0].planes.len())
        .map(|i| {
            let first = &samples[0].planes[i];
            let shape = Shape::new(samples.len(), first.channels, first.height, first.width);
            let mut values = Vec::with_capacity(samples.len() * first.data.len());
            for sample in samples {
                let planes = &sample.planes[i];
                assert_eq!((planes.width, planes.height), (first.width, first.height));
                values.extend_from_slice(&planes.data);
            }
            (shape, values)
        })
        .collect()
}

/// A network that maps a frame's passes to denoised radiance.
pub trait Network: Send + Sync {
    /// Its design and widths.
    fn config(&self) -> Config;

    /// The passes it needs.
    fn passes(&self) -> &'static [Pass];

    /// Rows and columns must be multiples of this.
    fn multiple(&self) -> usize;

    /// Its inputs from a frame's passes.
    ///
    /// # Errors
    /// A pass is missing.
    fn inputs(&self, passes: &PassSet) -> Result<Inputs>;

    /// Its parameters, in a fixed order.
    fn params(&mut self) -> Vec<&mut Param>;

    /// Its batch-norm layers, in the order in which a forward pass records their statistics.
    fn batch_norms(&mut self) -> Vec<&mut BatchNorm>;

    /// Radiance (N, 3, H, W), in the network's own scale.
    fn forward(&self, batch: &Batch, stats: &mut Stats) -> Images;

    /// [`Network::forward`] on a tape.
    fn forward_taped(&self, batch: &Batch, stats: &mut Stats) -> Images<Taped>;

    /// Multiply-accumulates for one pixel of the frame.
    fn macs_per_pixel(&self) -> f64;

    /// How far, in pixels, an output pixel can see to either side.
    fn reach(&self) -> usize;

    /// A copy with its own parameters.
    fn duplicate(&self) -> Box<dyn Network>;
}

/// Denoised radiance of a whole frame, (3, H, W).
///
/// # Errors
/// A pass is missing.
pub fn run(network: &dyn Network, passes: &PassSet) -> Result<Planes> {
    let mut inputs = network.inputs(passes)?;
    for planes in &mut inputs.planes {
        *planes = pad_to_multiple(planes, network.multiple());
    }
    let images = network.forward(&stack(std::slice::from_ref(&inputs)), &mut Stats::Running);
    let (width, height) = (inputs.planes[0].width, inputs.planes[0].height);
    let mut values = images.as_vec();
    values.iter_mut().for_each(|v| *v *= inputs.scale);
    Ok(crop(&Planes::from_vec(3, width, height, values), passes.width, passes.height))
}
