//! The built-in network: a dual encoder at half resolution that predicts kernels instead of colours.
//!
//! As in DEMC, guides and radiance are encoded apart and fused at every level of the decoder. The rest
//! follows what measurement favoured: the trunk works on quads, 2x2 pixels (space to depth), and each level
//! predicts softmax kernels that filter that level of a radiance pyramid (Bako et al. 2017; Vogels et al.
//! 2018). Before it is filtered, a level is blended with the filtered level below, so that its own kernels
//! smooth what upsampling left uneven. Radiance is divided by albedo first and multiplied by it last, so
//! texture is never blurred with the noise. A confidence for every pixel and level takes a firefly out of all
//! kernels at once.
//!
//! Kernels cannot invent a colour, and their output scales with their input exactly. But neither can they
//! draw an edge finer than the noise that they average. So each colour of each pixel is multiplied by a
//! bounded gain last, which keeps this scaling.
//!
//! Noise in the albedo (depth of field, 4 spp edges) is removed before the network reads it, by a prefilter:
//! a small network of the same kind, which was trained by itself and is not trained any further. Its kernels
//! filter the normal as well, for the [refit](crate::filters::refit) that comes last. But the samples that
//! made an albedo noisy made the radiance noisy in the same way, and their quotient is free of that noise. So
//! each pixel says how far it is to be divided by the noisy albedo instead of the clean one. For the same
//! reason the network reads normals as noisy as they are.
//!
//! What normals alone show, such as a moulding, is often thinner than any kernel that is wide enough to
//! average its noise. A fit of light over normals ([`Shading`]) finds it; each pixel says how far its gain is
//! to follow that.

mod bands;
mod light;
mod prefilter;
mod strips;
mod trunk;

use dfdx::tensor::{Cpu, Merge, NoneTape, Tape};

use super::network::{
    Architecture, Batch, Config, Design, Network, Stacked, Taped, convolution_weights, duplicate, field,
};
use crate::{
    Result,
    companion::Companion,
    features::{
        GUIDE_PASSES, Inputs, LightInputs, NEEDED_BY, Refined, Shading, albedo_of_target, exposure,
        guide_rows, light_inputs, normal_of_target,
    },
    filters::refit::{Guides, Refit, Samples},
    kernels::memory::PlaneBuffer,
    nn::{Conv, Images, Stats},
    passes::{Pass, PassSet},
    planes::Planes,
    rng::Rng,
};
use prefilter::Prefilter;
use trunk::{MULTIPLE, Trunk, Variant, filter_levels};

pub use trunk::LEVELS;

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

/// Rows and columns of the radiance kernels at full resolution. They can be small, since division by the
/// albedo removes texture and edges as thin as a pixel. The prefilter's own kernels must average along these
/// and need more than nine pixels.
const FULL_KERNEL: usize = 3;

/// What the names of a prefilter's layers begin with.
pub const PREFILTER: &str = "prefilter.";

/// The trunk of the network, whose guides are albedo, normal, and how noisy the albedo was.
const TRUNK: Variant = Variant { prefix: "", guides: 7, full_kernel: FULL_KERNEL, refines: true };

/// The kernel-predicting dual encoder with its prefilter.
pub static DESIGN: Design = Design {
    // A prefilter has the same inputs, since its weights may go into a pyramid or be taken from one.
    inputs: "guides/logarithm/1",
    levels: LEVELS,
    prefilter_levels: LEVELS,
    least_parameters: |config| {
        convolution_weights(2, &config.widths) + convolution_weights(2, &config.prefilter)
    },
    build: |config, seed| Box::new(Pyramid::new(config, seed)),
};

/// A prefilter by itself.
pub static ALONE: Design =
    Design { prefilter_levels: 0, build: |config, seed| Box::new(Prefilter::new(config, seed)), ..DESIGN };

/// The kernel-predicting dual encoder.
#[derive(Clone)]
pub struct Pyramid {
    widths: Vec<usize>,
    trunk: Trunk,
    /// Denoises albedo and normal.
    prefilter: Prefilter,
}

impl Pyramid {
    /// A network with fresh weights drawn from `seed`; `widths` are the encoders', finest first.
    ///
    /// # Panics
    /// If `widths` does not hold one width a level.
    pub fn new(config: &Config, seed: u64) -> Self {
        let rng = &mut Rng::new(seed, 0);
        let trunk = Trunk::new(&config.widths, &TRUNK, rng);
        let mut prefilter = Prefilter::named(PREFILTER, &config.prefilter, rng);
        prefilter.params().into_iter().for_each(|param| param.trainable = false);
        Self { widths: config.widths.clone(), trunk, prefilter }
    }

    fn run<T: Tape<f32, Cpu> + Merge<T>>(&self, batch: &Batch) -> Images<T> {
        let LightInputs { light, divisor, encoded, guide, ratio, shading, normal } = named(batch);
        let (levels, finish) = self.trunk.predict([encoded, guide]);
        let (by_noisy, shade) = finish.refined.expect("its head has planes for both");
        let image = field::<T>(light).redivide(field(ratio), by_noisy);
        let gain = finish.gain.plus_product(field(shading), shade);
        let image = filter_levels(image, levels).product(field(divisor)).amplify(gain);
        let factors = factors(image.values(), light, normal, divisor);
        image.product(field(&factors)).into_images()
    }
}

/// The inputs of a batch.
fn named(batch: &Batch) -> LightInputs<&Stacked> {
    LightInputs::from_list(batch.first_chunk().expect("`inputs` makes as many").each_ref())
}

/// The factors by which a refit multiplies denoised images, (N, 3, H, W).
fn factors(image: &[f32], light: &Stacked, normal: &Stacked, albedo: &Stacked) -> Stacked {
    let (shape, pixels) = (light.0, light.0.h * light.0.w);
    let size = (shape.w, shape.h);
    let mut factors = PlaneBuffer::from(image.to_vec());
    for (n, image) in factors.chunks_exact_mut(3 * pixels).enumerate() {
        let of_image = 3 * n * pixels..3 * (n + 1) * pixels;
        let [normal, albedo] = [normal, albedo].map(|guide| &guide.1[of_image.clone()]);
        let guides = Guides { size, normal, albedo, first: 0 };
        let samples = Samples::Divided(&light.1[of_image]);
        Refit::new(size).advance(guides, image, samples, shape.h, |value, factor| *value = factor);
    }
    (shape, factors)
}

impl Network for Pyramid {
    fn config(&self) -> Config {
        let prefilter = self.prefilter.widths().to_vec();
        Config { prefilter, ..Config::new(Architecture::Pyramid, &self.widths) }
    }

    fn passes(&self) -> &'static [Pass] {
        &GUIDE_PASSES
    }

    fn multiple(&self) -> usize {
        MULTIPLE
    }

    fn inputs(&self, passes: &PassSet) -> Result<Inputs> {
        let [albedo, normal] = strips::infer_guides(&self.prefilter, passes, None)?;
        let (albedo, normal) = (albedo_of_target(albedo), normal_of_target(normal));
        let exposure = exposure(passes.require(Pass::Combined, NEEDED_BY)?);
        let (rows, size) = (0..passes.height, (passes.width, passes.height));
        let shading = Shading::of(passes, exposure)?.rows(passes, rows.clone())?;
        let passes = guide_rows(passes, rows, size, exposure)?;
        let inputs = light_inputs(&passes, Refined { albedo, normal, shading }, exposure)?;
        Ok(Inputs { planes: inputs.into_list().into(), scale: exposure.recip() })
    }

    fn convolutions(&mut self) -> Vec<&mut Conv> {
        self.trunk.convolutions().chain(self.prefilter.convolutions()).collect()
    }

    fn freeze(&mut self) {
        self.trunk.freeze();
        self.prefilter.freeze();
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
        self.trunk.macs_per_pixel(1) + self.prefilter.macs_per_pixel()
    }

    fn reach(&self) -> usize {
        self.trunk.reach() + self.prefilter.reach()
    }

    fn clean_guides(&self, passes: &PassSet) -> Result<Option<PassSet>> {
        let [albedo, normal] = strips::infer_guides(&self.prefilter, passes, None)?;
        let mut guides = passes.empty((passes.width, passes.height));
        guides.insert(Pass::DenoisingAlbedo, albedo_of_target(albedo));
        guides.insert(Pass::DenoisingNormal, normal_of_target(normal));
        Ok(Some(guides))
    }

    fn takes_companions(&self) -> bool {
        true
    }

    fn infer_along(
        &self,
        passes: &PassSet,
        guides: Option<&PassSet>,
        companions: &mut [Companion],
        tile: Option<usize>,
    ) -> Result<Planes> {
        strips::infer(self, passes, guides, companions, tile)
    }

    fn duplicate(&self) -> Box<dyn Network> {
        duplicate(self)
    }
}
