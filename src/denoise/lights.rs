//! The layers of a frame that are denoised along with its beauty: alpha, and the light passes that Cycles
//! adds up to the beauty.
//!
//! Cycles adds up Combined as `(direct + indirect) * colour` of diffuse, glossy and transmissive surfaces,
//! plus volumes, emission and environment; or as the sum of the light groups. A light pass that is stored
//! without its colour is denoised with it and divided by the denoised colour afterwards, so that the same sum
//! over the results is the denoised Combined.

use std::collections::HashSet;

use half::f16;

use super::{Options, job::run};
use crate::{
    Error, Result,
    companion::{Companion, Kind},
    filters::caught::Caught,
    frame::{Frame, SampleKind},
    models::Denoiser,
    passes::{BLENDER, Layer, Pass, PassChannels},
    planes::Planes,
    shot::Shot,
};

/// What becomes of alpha.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Alpha {
    /// It is denoised where it differs from pixel to pixel and the model can denoise it; otherwise it is
    /// kept.
    #[default]
    Auto,
    /// It is denoised.
    Denoise,
    /// It stays as rendered.
    Keep,
}

impl Alpha {
    /// All, by their names on the command line.
    pub const ALL: [(&str, Self); 3] =
        [("auto", Self::Auto), ("denoise", Self::Denoise), ("keep", Self::Keep)];

    /// Whether a model is to denoise an alpha, (1, H, W).
    pub(super) fn is_denoised(self, alpha: &Planes, model: &dyn Denoiser) -> bool {
        match self {
            Self::Keep => false,
            Self::Denoise => true,
            Self::Auto => model.takes_companions() && alpha.varies(),
        }
    }
}

/// Light passes that are stored divided by a colour, and that colour.
const LIT: [([Pass; 2], Pass); 3] = [
    ([Pass::DiffuseDirect, Pass::DiffuseIndirect], Pass::DiffuseColor),
    ([Pass::GlossyDirect, Pass::GlossyIndirect], Pass::GlossyColor),
    ([Pass::TransmissionDirect, Pass::TransmissionIndirect], Pass::TransmissionColor),
];

/// Light passes that are stored as they are added.
const ADDED: [Pass; 4] = [Pass::VolumeDirect, Pass::VolumeIndirect, Pass::Emission, Pass::Environment];

/// Pictures of their own, of which the beauty knows nothing: where shadows are caught it is black, and what occludes a
/// surface lights it in its own way.
const APART: [Pass; 2] = [Pass::ShadowCatcher, Pass::AmbientOcclusion];

/// The least value of a denoised colour by which light is divided: large enough for half floats to hold it
/// with sufficient precision, and too small to be seen.
const LEAST_COLOUR: f32 = 1e-3;

/// Every pass that may go along, except alpha.
pub fn light_passes() -> Vec<Pass> {
    let lit = LIT.iter().flat_map(|(lights, colour)| [lights[0], lights[1], *colour]);
    lit.chain(ADDED).chain(APART).collect()
}

/// Where the light passes and light groups of a layer are that can be denoised: light is stored with its colour
/// or, elsewhere, needs none.
pub fn denoised_lights(layer: &Layer) -> Vec<&PassChannels> {
    let lit =
        LIT.iter().filter(|(_, colour)| layer.passes.contains_key(colour)).flat_map(|(lights, _)| lights);
    let passes = lit.chain(&ADDED).chain(&APART).filter_map(|pass| layer.passes.get(pass));
    passes.chain(layer.light_groups.values()).collect()
}

/// Where all passes and light groups of a layer are that may go along with its beauty.
pub fn passes_along(layer: &Layer) -> Vec<&PassChannels> {
    let colours = LIT.iter().filter_map(|(_, colour)| layer.passes.get(colour));
    denoised_lights(layer).into_iter().chain(colours).collect()
}

/// Where a companion comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// A pass.
    Pass(Pass),
    /// The light group of that name.
    LightGroup(String),
}

impl Source {
    /// Where it is stored in a frame.
    pub fn channels<'a>(&self, layer: &'a Layer) -> &'a PassChannels {
        match self {
            Self::Pass(pass) => &layer.passes[pass],
            Self::LightGroup(name) => &layer.light_groups[name],
        }
    }
}

/// The layers that go along with a beauty.
#[derive(Default)]
pub struct Along {
    sources: Vec<Source>,
    /// One for each source, for the model.
    pub companions: Vec<Companion>,
    /// The environment, where a transparent film does not show it: it is no part of the beauty, so that what is found
    /// of that says nothing of it, and it stays as rendered.
    unseen: Option<Planes>,
    /// A shadow in alpha, where the beauty is black, and those [`APART`]: they are denoised by themselves.
    caught: Option<Caught>,
    apart: Vec<(Pass, Planes)>,
}

impl Along {
    /// Takes out of a shot the passes that are to go along, and notes those that cannot.
    pub fn take(shot: &mut Shot, model: &dyn Denoiser, options: &Options, notes: &mut Vec<String>) -> Self {
        let mut along = Self::of_alpha(shot, model, options.alpha);
        if options.passes {
            along.take_lights(shot, notes);
        }
        along
    }

    /// Takes alpha out of a shot, if it is to be denoised.
    pub fn of_alpha(shot: &mut Shot, model: &dyn Denoiser, how: Alpha) -> Self {
        let mut along = Self::default();
        if shot.passes.get(Pass::Alpha).is_some_and(|alpha| how.is_denoised(alpha, model))
            && let Some(alpha) = shot.passes.remove(Pass::Alpha)
        {
            along.caught = shot.passes.get(Pass::Combined).and_then(|beauty| Caught::of(beauty, &alpha));
            along.push(Source::Pass(Pass::Alpha), Kind::Share, alpha);
        }
        along
    }

    fn push(&mut self, source: Source, kind: Kind, planes: Planes) {
        self.sources.push(source);
        self.companions.push(Companion::new(kind, planes));
    }

    fn take_lights(&mut self, shot: &mut Shot, notes: &mut Vec<String>) {
        let beauty = shot.passes.get(Pass::Combined);
        // The beauty counts as black where it is below zero, and so does the light that makes it.
        let below: Vec<usize> = beauty.map_or_else(Vec::new, |beauty| {
            let values = beauty.data.iter().enumerate();
            values.filter(|(_, v)| **v < 0.0).map(|(at, _)| at).collect()
        });
        if !below.is_empty() {
            let pixels = beauty.map_or(1, Planes::pixels);
            let count = below.iter().map(|at| at % pixels).collect::<HashSet<_>>().len();
            notes.push(format!(
                "Combined is below zero in {count} of the pixels: there it and its light are denoised as black"
            ));
        }
        let adds_up =
            |pass: &Pass| *pass == Pass::Combined || light_passes().contains(pass) && !APART.contains(pass);
        let of_passes = shot.repaired.iter().filter(|(pass, _)| adds_up(pass)).map(|(_, count)| count);
        let broken: usize = of_passes.chain(shot.repaired_groups.values()).sum();
        if broken > 0 {
            notes.push(format!(
                "of the values of Combined, light passes and light groups {broken} are NaN or infinite: around them the \
                 denoised ones do not add up to the result"
            ));
        }
        for (lights, colour) in LIT {
            let held = lights.map(|light| shot.passes.get(light).is_some());
            let Some(colours) = shot.passes.remove(colour) else {
                if let Some(light) = lights.iter().zip(held).find_map(|(light, held)| held.then_some(light)) {
                    let setting = BLENDER.setting(colour);
                    notes.push(format!(
                        "{light} is not denoised: it takes {colour}, which is missing; {setting}"
                    ));
                }
                continue;
            };
            for light in lights {
                if let Some(mut planes) = shot.passes.remove(light) {
                    planes.data.iter_mut().zip(&colours.data).for_each(|(light, colour)| *light *= colour);
                    self.push(Source::Pass(light), Kind::Light, planes);
                }
            }
            if held.contains(&true) {
                self.push(Source::Pass(colour), Kind::Colour, colours);
            }
        }
        if self.is_unseen(shot, Pass::Environment) {
            self.unseen = shot.passes.remove(Pass::Environment);
            notes.push("a transparent film does not show Environment, which is no part of Combined: it stays as rendered".into());
        }
        for pass in ADDED {
            if let Some(planes) = shot.passes.remove(pass) {
                self.push(Source::Pass(pass), Kind::Light, planes);
            }
        }
        let held = APART.into_iter().filter_map(|pass| Some((pass, shot.passes.remove(pass)?)));
        self.apart = held.collect();
        for (name, planes) in std::mem::take(&mut shot.light_groups) {
            self.push(Source::LightGroup(name), Kind::Light, planes);
        }
        for companion in self.companions.iter_mut().filter(|companion| companion.kind == Kind::Light) {
            below.iter().for_each(|at| companion.planes.data[*at] = 0.0);
        }
        let has_others = self.unseen.is_some() || !self.apart.is_empty();
        if !has_others && self.sources.iter().all(|source| *source == Source::Pass(Pass::Alpha)) {
            let remedy = match shot.passes.renderer.is_blender() {
                true => "turn on View Layer Properties > Passes > Light, or light groups",
                false => "--map 'PASS=NAME' tells where they are, if there are any",
            };
            notes.push(format!("holds no light passes to denoise; {remedy}"));
        }
    }

    /// Whether a light pass has light in a pixel that nothing covers.
    fn is_unseen(&self, shot: &Shot, pass: Pass) -> bool {
        let along = self.sources.iter().position(|source| *source == Source::Pass(Pass::Alpha));
        let alpha = along.map_or(shot.passes.get(Pass::Alpha), |at| Some(&self.companions[at].planes));
        let (Some(alpha), Some(light)) = (alpha, shot.passes.get(pass)) else { return false };
        let channels = || light.data.chunks_exact(light.pixels());
        (0..light.pixels()).any(|at| alpha.data[at] == 0.0 && channels().any(|values| values[at] > 0.0))
    }

    /// Denoises what the beauty knows nothing of, with the guides of a shot whose beauty has been denoised and which is of
    /// no use after that. The albedo is none of these guides: it would draw the outlines of things.
    ///
    /// # Errors
    /// The model cannot denoise it.
    pub fn denoise_apart(&mut self, mut shot: Shot, with: (&dyn Denoiser, Option<usize>)) -> Result<()> {
        let region = shot.passes.rendered();
        for pass in [Pass::Alpha, Pass::DenoisingAlbedo] {
            drop(shot.passes.remove(pass));
        }
        let mut denoise = |picture: Planes| {
            shot.passes.insert(Pass::Combined, picture);
            Ok::<_, Error>(run(&shot, &mut [], false, with)?.0)
        };
        if let Some(caught) = self.caught.take() {
            let is_alpha = |companion: &&mut Companion| companion.is_alpha();
            let alpha = self.companions.iter_mut().find(is_alpha).expect("the shadow was found in it");
            caught.put(&denoise(caught.picture(region))?, &mut alpha.planes);
        }
        for (_, picture) in &mut self.apart {
            *picture = denoise(std::mem::take(picture))?;
        }
        Ok(())
    }

    /// Each source with what became of it.
    fn done(self) -> Vec<(Source, Planes)> {
        let denoised = self.companions.into_iter().map(|companion| companion.planes);
        let unseen = self.unseen.map(|planes| (Source::Pass(Pass::Environment), planes));
        let apart = self.apart.into_iter().map(|(pass, planes)| (Source::Pass(pass), planes));
        self.sources.into_iter().zip(denoised).chain(unseen).chain(apart).collect()
    }

    /// Alpha, (1, H, W), once the model has denoised it, if it goes along.
    pub fn alpha(self) -> Option<Planes> {
        take_alpha(&mut self.done())
    }

    /// The layers as they are to be stored, once the model has denoised them: alpha, (1, H, W), and all
    /// others, (3, H, W).
    pub fn finish(self, frame: &Frame, layer: &Layer) -> (Option<Planes>, Vec<(Source, Planes)>) {
        let mut done = self.done();
        let alpha = take_alpha(&mut done);
        for (lights, colour) in LIT {
            divide(&mut done, lights, colour, frame, layer);
        }
        (alpha, done)
    }
}

/// Takes denoised alpha out of what was denoised.
fn take_alpha(done: &mut Vec<(Source, Planes)>) -> Option<Planes> {
    let at = done.iter().position(|(source, _)| *source == Source::Pass(Pass::Alpha))?;
    let (_, mut alpha) = done.remove(at);
    alpha.data.iter_mut().for_each(|share| *share = share.clamp(0.0, 1.0));
    Some(alpha)
}

/// Divides denoised light by its denoised colour, which is first rounded to what the file can store.
fn divide(done: &mut [(Source, Planes)], lights: [Pass; 2], colour: Pass, frame: &Frame, layer: &Layer) {
    let find = |done: &[(Source, Planes)], pass| done.iter().position(|(s, _)| *s == Source::Pass(pass));
    let Some(at) = find(done, colour) else { return };
    let lights: Vec<usize> = lights.into_iter().filter_map(|light| find(done, light)).collect();
    let stored = layer.passes.get(&colour).map(|at| frame.parts()[at.part].channels[at.channels[0]].kind);
    let mut colours = std::mem::take(&mut done[at].1);
    for (i, colour) in colours.data.iter_mut().enumerate() {
        if lights.iter().any(|&light| done[light].1.data[i] > 0.0) {
            *colour = colour.max(LEAST_COLOUR);
        }
        if stored == Some(SampleKind::Half) {
            *colour = f16::from_f32(*colour).to_f32();
        }
    }
    for light in lights {
        let values = done[light].1.data.iter_mut().zip(&colours.data);
        values.for_each(|(light, colour)| *light = if *colour > 0.0 { *light / colour } else { 0.0 });
    }
    done[at].1 = colours;
}
