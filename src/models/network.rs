//! What every learned method has in common: a configuration, inputs, parameters, a forward pass.

use dfdx::tensor::{Cpu, Merge, OwnedTape, Tape};
use serde::{Deserialize, Serialize};

use super::{demc, kpcn, lbf, pyramid};

use crate::{
    Result,
    companion::Companion,
    features::Inputs,
    kernels::{Shape, memory::PlaneBuffer},
    nn::{BatchNorm, Conv, Field, Images, Param, Stats, clear_buffers, values_of},
    passes::{Pass, PassSet},
    planes::Planes,
};

/// The tape of a training step.
pub type Taped = OwnedTape<f32, Cpu>;

/// Which network it is, and how wide. Together with its parameters, this describes a network fully.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Config {
    /// The design.
    pub architecture: Architecture,
    /// Channels at each level, finest first.
    pub widths: Vec<usize>,
    /// Channels at each level of a built-in network's prefilter, which denoises albedo and normal first.
    /// Other networks have no prefilter.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub prefilter: Vec<usize>,
}

impl Config {
    /// A network without prefilter.
    pub fn new(architecture: Architecture, widths: &[usize]) -> Self {
        Self { architecture, widths: widths.into(), prefilter: Vec::new() }
    }
}

impl std::fmt::Display for Config {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let list = |widths: &[usize]| widths.iter().map(usize::to_string).collect::<Vec<_>>().join(",");
        write!(f, "{:?} of widths {}", self.architecture, list(&self.widths))?;
        if !self.prefilter.is_empty() {
            write!(f, " with a prefilter of widths {}", list(&self.prefilter))?;
        }
        Ok(())
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
    /// The prefilter: the same design, which denoises albedo and normal for [`Architecture::Pyramid`].
    Prefilter,
    /// KPCN with its two streams, diffuse and specular.
    Kpcn,
    /// KPCN with a single stream over Combined.
    KpcnCombined,
    /// A perceptron that chooses the parameters of a cross-bilateral filter.
    Lbf,
}

/// What sets a design apart, as its own file says it.
pub struct Design {
    /// Feature set and transfer of radiance, as weights files record them. The number goes up whenever a
    /// value that the network reads or writes comes to mean something else, as by another constant in
    /// `features`: weights from before are then refused, instead of run on inputs that they were not trained
    /// on.
    pub inputs: &'static str,
    /// How many widths it takes.
    pub levels: usize,
    /// How many widths its prefilter takes, 0 without one.
    pub prefilter_levels: usize,
    /// See [`super::least_parameters`].
    pub least_parameters: fn(&Config) -> usize,
    /// A network of these widths with weights drawn from a seed.
    pub build: fn(&Config, u64) -> Box<dyn Network>,
}

impl Architecture {
    /// What sets it apart.
    pub fn design(self) -> &'static Design {
        match self {
            Self::Demc | Self::DemcNofusion => &demc::DESIGN,
            Self::Semc => &demc::SINGLE,
            Self::Pyramid => &pyramid::DESIGN,
            Self::Prefilter => &pyramid::ALONE,
            Self::Kpcn => &kpcn::DESIGN,
            Self::KpcnCombined => &kpcn::COMBINED,
            Self::Lbf => &lbf::DESIGN,
        }
    }

    /// See [`Design::inputs`].
    pub fn inputs(self) -> &'static str {
        self.design().inputs
    }
}

/// Number of weights of `convolutions` 3x3 convolutions at each level, each from as many channels as the
/// level has to as many.
pub fn convolution_weights(convolutions: usize, widths: &[usize]) -> usize {
    convolutions * 9 * widths.iter().map(|width| width * width).sum::<usize>()
}

/// A network input of several samples, (N, C, H, W).
pub type Stacked = (Shape, PlaneBuffer);

/// A network input, as planes.
pub(super) fn field<T: Tape<f32, Cpu> + Merge<T>>((shape, values): &Stacked) -> Field<T> {
    Field::input((shape.n, shape.c, shape.h, shape.w), values)
}

/// Inputs of several samples of one size.
pub type Batch = Vec<Stacked>;

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
            (shape, values.into())
        })
        .collect()
}

/// A network that maps a frame's passes to denoised radiance.
pub trait Network: Send + Sync {
    /// Its design and widths.
    fn config(&self) -> Config;

    /// The passes it needs.
    fn passes(&self) -> &'static [Pass];

    /// Passes it makes use of where a file holds them.
    fn optional_passes(&self) -> &'static [Pass] {
        &[]
    }

    /// What the user should know about how it treats a frame.
    fn notes(&self) -> Option<String> {
        None
    }

    /// Frames of more pixels than this are worked on in tiles unless the user says otherwise.
    fn whole_frame_pixels(&self) -> usize {
        WHOLE_FRAME_PIXELS
    }

    /// Rows and columns must be multiples of this.
    fn multiple(&self) -> usize;

    /// The passes of a reference that [`Network::target`] takes.
    fn targets(&self) -> &'static [Pass] {
        &[Pass::Combined]
    }

    /// Whether it makes radiance of a frame, not guides for other networks.
    fn makes_radiance(&self) -> bool {
        self.targets() == [Pass::Combined]
    }

    /// What it should make of a frame, taken from the frame's reference: radiance, (3, H, W), if
    /// [`Network::makes_radiance`].
    ///
    /// # Errors
    /// A pass is missing.
    fn target(&self, reference: &PassSet) -> Result<Planes> {
        Ok(reference.require(Pass::Combined, "training")?.clone())
    }

    /// Its inputs from a frame's passes.
    ///
    /// # Errors
    /// A pass is missing.
    fn inputs(&self, passes: &PassSet) -> Result<Inputs>;

    /// Its parameters, in a fixed order: those of its convolutions, where it has no others.
    fn params(&mut self) -> Vec<&mut Param> {
        self.convolutions().into_iter().flat_map(Conv::params).collect()
    }

    /// Its convolutions, whose arithmetic can be chosen; none if it is fixed.
    fn convolutions(&mut self) -> Vec<&mut Conv> {
        Vec::new()
    }

    /// Plans for inference: folds batch norms into convolutions and packs weights once. Its parameters are
    /// then no longer those that were trained.
    fn freeze(&mut self) {
        self.convolutions().into_iter().for_each(|conv| conv.freeze(&[]));
    }

    /// Whether it can compute in 8 bits: its design has a way to, and the ranges of its activations are
    /// known.
    fn is_quantizable(&mut self) -> bool {
        false
    }

    /// Its batch-norm layers, in the order in which a forward pass records their statistics.
    fn batch_norms(&mut self) -> Vec<&mut BatchNorm> {
        Vec::new()
    }

    /// Radiance (N, 3, H, W), in the network's own scale.
    fn forward(&self, batch: &Batch, stats: &mut Stats) -> Images;

    /// [`Network::forward`] on a tape.
    fn forward_taped(&self, batch: &Batch, stats: &mut Stats) -> Images<Taped>;

    /// Multiply-accumulates for one pixel of the frame.
    fn macs_per_pixel(&self) -> f64;

    /// How far, in pixels, the inputs that an output pixel depends on reach to either side.
    fn reach(&self) -> usize;

    /// Denoised radiance of a frame, (3, H, W). The frame is worked on in parts of `tile` rows (and columns,
    /// where the network is cut both ways), and the result is the same to the bit for parts of any size.
    ///
    /// # Errors
    /// A pass is missing.
    fn infer(&self, passes: &PassSet, tile: Option<usize>) -> Result<Planes> {
        self.infer_along(passes, None, &mut [], tile)
    }

    /// The denoised versions of those passes of a frame that it denoises before radiance, if there are any.
    ///
    /// # Errors
    /// A pass is missing.
    fn clean_guides(&self, _: &PassSet) -> Result<Option<PassSet>> {
        Ok(None)
    }

    /// Whether it can denoise layers along with the beauty.
    fn takes_companions(&self) -> bool {
        false
    }

    /// [`Network::infer`], by [`Network::clean_guides`] where they are known, and each of the companions denoised along
    /// with it where [`Network::takes_companions`].
    ///
    /// # Errors
    /// As [`Network::infer`].
    fn infer_along(
        &self,
        passes: &PassSet,
        _: Option<&PassSet>,
        _: &mut [Companion],
        tile: Option<usize>,
    ) -> Result<Planes> {
        run_tiled(self, passes, tile)
    }

    /// A copy with its own parameters.
    fn duplicate(&self) -> Box<dyn Network>;
}

/// [`Network::duplicate`] of a network that can be cloned.
pub(super) fn duplicate(network: &(impl Network + Clone + 'static)) -> Box<dyn Network> {
    let mut copy = network.clone();
    for param in copy.params() {
        *param = param.duplicate();
    }
    Box::new(copy)
}

/// [`Network::whole_frame_pixels`] of most networks: activations of an 8K frame would take more memory than a
/// workstation has.
const WHOLE_FRAME_PIXELS: usize = 8 << 20;

/// [`Network::infer`] for any network: radiance, (3, H, W), at once or in tiles of `tile` rows and columns.
/// Every tile sees as far beyond its edge as the network reaches, so the result is the same, bit for bit.
///
/// # Errors
/// A pass is missing.
fn run_tiled<N: Network + ?Sized>(network: &N, passes: &PassSet, tile: Option<usize>) -> Result<Planes> {
    let multiple = network.multiple();
    let mut inputs = network.inputs(passes)?.padded(multiple);
    let (width, height) = (inputs.planes[0].width, inputs.planes[0].height);
    let most = network.whole_frame_pixels();
    // A tile is a square of half as many pixels as may be worked on at once, because it reads pixels beyond
    // its edge as well.
    let default = if width * height > most { (most / 2).isqrt() } else { width.max(height) };
    let tile = tile.unwrap_or(default).next_multiple_of(multiple);
    let reach = network.reach().next_multiple_of(multiple);
    let mut image = Planes::new(3, width, height);
    let mut last_seen = None;
    for y in (0..height).step_by(tile) {
        for x in (0..width).step_by(tile) {
            // The tile, and the pixels that it reads; both are clipped to the frame.
            let size = (tile.min(width - x), tile.min(height - y));
            let (x0, y0) = (x.saturating_sub(reach), y.saturating_sub(reach));
            let seen = ((x + size.0 + reach).min(width) - x0, (y + size.1 + reach).min(height) - y0);
            // Buffers of another size would only pile up.
            if last_seen.replace(seen).is_some_and(|last| last != seen) {
                clear_buffers();
            }
            let batch: Batch = inputs
                .planes
                .iter_mut()
                .map(|planes| {
                    // A frame in one piece is not needed again. (Of several tiles, one may see all of it.)
                    let whole = size == (width, height);
                    let seen = if whole { std::mem::take(planes) } else { planes.window((x0, y0), seen) };
                    (Shape::new(1, seen.channels, seen.height, seen.width), seen.data)
                })
                .collect();
            let output = values_of(&network.forward(&batch, &mut Stats::Running));
            let output = Planes::from_vec(3, seen.0, seen.1, output);
            for c in 0..3 {
                for row in 0..size.1 {
                    let from = &output.channel(c)[(y - y0 + row) * seen.0 + x - x0..][..size.0];
                    let into = &mut image.channel_mut(c)[(y + row) * width + x..][..size.0];
                    into.iter_mut().zip(from).for_each(|(into, v)| *into = v * inputs.scale);
                }
            }
        }
    }
    Ok(image.window((0, 0), (passes.width, passes.height)))
}
