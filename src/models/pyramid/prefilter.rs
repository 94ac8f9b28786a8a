//! The prefilter: a small network of the same kind as the built-in one, which denoises albedo and normal for
//! it. Its heads predict kernels that filter both.

use std::ops::Range;

use dfdx::tensor::{Cpu, Merge, NoneTape, Tape};

use super::{
    NEEDED_BY,
    bands::{self, Filtered, Subject, of_planes},
    field, strips,
    trunk::{Finish, KERNEL, MULTIPLE, Trunk, Variant, filter_levels},
};
use crate::{
    Result,
    companion::Companion,
    features::{GuideInputs, Inputs, PREFILTERED_PASSES, albedo_exposure, guide_inputs, guide_targets},
    models::network::{Architecture, Batch, Config, Network, Taped, duplicate},
    nn::{Conv, Images, Stats},
    passes::{Pass, PassSet},
    planes::Planes,
    rng::Rng,
};

/// Denoises albedo and normal, each (3, H, W).
#[derive(Clone)]
pub struct Prefilter {
    widths: Vec<usize>,
    pub(super) trunk: Trunk,
}

impl Prefilter {
    /// A network with fresh weights drawn from `seed`; see [`Trunk::new`].
    ///
    /// # Panics
    /// As for that function.
    pub fn new(config: &Config, seed: u64) -> Self {
        Self::named("", &config.widths, &mut Rng::new(seed, 0))
    }

    /// A prefilter whose layers' names begin with `prefix`.
    pub(super) fn named(prefix: &str, widths: &[usize], rng: &mut Rng) -> Self {
        let variant = Variant { prefix, guides: 3, full_kernel: KERNEL, refines: false };
        Self { widths: widths.into(), trunk: Trunk::new(widths, &variant, rng) }
    }

    pub(super) fn widths(&self) -> &[usize] {
        &self.widths
    }

    fn run<T: Tape<f32, Cpu> + Merge<T>>(&self, batch: &Batch) -> Images<T> {
        let inputs = batch.first_chunk().expect("`inputs` makes as many").each_ref();
        let GuideInputs { albedo, normal, encoded, guide } = GuideInputs::from_list(inputs);
        let (levels, Finish { gain, .. }) = self.trunk.predict([encoded, guide]);
        let normal = filter_levels(field(normal), levels.iter().map(|level| level.fork()).collect());
        filter_levels(field(albedo), levels).amplify(gain).beside(normal).into_images()
    }
}

impl Network for Prefilter {
    fn config(&self) -> Config {
        Config::new(Architecture::Prefilter, &self.widths)
    }

    fn passes(&self) -> &'static [Pass] {
        &PREFILTERED_PASSES
    }

    fn targets(&self) -> &'static [Pass] {
        &PREFILTERED_PASSES
    }

    fn target(&self, reference: &PassSet) -> Result<Planes> {
        guide_targets(reference)
    }

    fn multiple(&self) -> usize {
        MULTIPLE
    }

    fn inputs(&self, passes: &PassSet) -> Result<Inputs> {
        let exposure = albedo_exposure(passes.require(Pass::DenoisingAlbedo, NEEDED_BY)?);
        let inputs = guide_inputs(passes, exposure)?;
        Ok(Inputs { planes: inputs.into_list().into(), scale: exposure.recip() })
    }

    fn convolutions(&mut self) -> Vec<&mut Conv> {
        self.trunk.convolutions().collect()
    }

    fn freeze(&mut self) {
        self.trunk.freeze();
    }

    fn forward(&self, batch: &Batch, _: &mut Stats) -> Images {
        self.run::<NoneTape>(batch)
    }

    fn forward_taped(&self, batch: &Batch, _: &mut Stats) -> Images<Taped> {
        self.run::<Taped>(batch)
    }

    fn macs_per_pixel(&self) -> f64 {
        self.trunk.macs_per_pixel(2)
    }

    fn reach(&self) -> usize {
        self.trunk.reach()
    }

    /// Albedo and normal as [`Network::target`] has them, (6, H, W).
    fn infer_along(
        &self,
        passes: &PassSet,
        _: Option<&PassSet>,
        _: &mut [Companion],
        tile: Option<usize>,
    ) -> Result<Planes> {
        let guides = strips::infer_guides(self, passes, tile)?;
        let rows = |c: usize, y: usize, row: &mut [f32]| {
            row.copy_from_slice(guides[c / 3].row(c % 3, y));
        };
        Ok(Planes::from_rows(6, (passes.width, passes.height), rows))
    }

    fn duplicate(&self) -> Box<dyn Network> {
        duplicate(self)
    }
}

/// Albedo and normal on their way through a prefilter, which returns them in this order and in its own scale.
pub(super) struct GuideImages;

impl Subject for GuideImages {
    type Inputs = GuideInputs;

    fn images(&self) -> usize {
        2
    }

    fn push(&mut self, inputs: GuideInputs, images: &mut [Filtered]) -> [Planes; 2] {
        let GuideInputs { albedo, normal, encoded, guide } = inputs;
        images
            .iter_mut()
            .zip([albedo, normal])
            .for_each(|(filtered, planes)| filtered.image.push(of_planes(planes)));
        [encoded, guide]
    }

    fn predicted(&mut self, _: Range<usize>, finish: Finish<NoneTape>, _: &mut [Filtered]) -> bands::Field {
        finish.gain
    }

    fn finish(&self, _: Range<usize>, filtered: Vec<bands::Field>, gain: bands::Field) -> Vec<bands::Field> {
        let [albedo, normal] = filtered.try_into().expect("guides are two");
        vec![albedo.amplify(gain), normal]
    }

    fn forget(&mut self, _: usize, _: usize) {}
}
