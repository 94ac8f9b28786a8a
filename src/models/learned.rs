//! A trained network as a denoising method, built in or from a weights file.

use std::path::Path;

use super::{
    Denoiser, ExpectedError,
    denoiser::refuse_companions,
    network::{Architecture, Network},
    weights_file::{self, Metadata},
};
use crate::{
    Error, Result,
    augment::Augment,
    companion::{Companion, Kind},
    error::remedy,
    features::{PREFILTERED_PASSES, exposure, guide_rows, tame_alike, with_stand_ins},
    filters::{
        coverage,
        shrinkage::{Alpha, Empty, Render, Shrinkage, take_back},
    },
    nn::Precision,
    passes::{Pass, PassSet},
    planes::Planes,
    shot::Shot,
};

/// The built-in model that looks at a frame twice, the second time upside down and with its quads of 2x2
/// pixels one pixel further on, and answers with the mean. A network's errors depend on how its quads and
/// levels happen to lie on the picture, and half of them average out (Lim et al. 2017 call this a geometric
/// self-ensemble). It has the weights of `demc-m`.
pub const TURNED: &str = "demc-l";

/// What [`TURNED`] does to a frame of odd width and height.
const HALF_TURN: Augment = Augment { turns: 2, ..Augment::IDENTITY };

/// A network with its weights.
pub struct Learned {
    name: String,
    network: Box<dyn Network>,
    /// Whether it looks twice, see [`TURNED`].
    turned: bool,
    /// Whether what it changes beyond the noise is taken back.
    pub(super) is_restrained: bool,
    /// The network's configuration and how it was trained.
    pub metadata: Metadata,
}

impl Learned {
    /// The model of the catalogue whose weights file is given, built in or read from `path`.
    pub(super) fn parse(name: &str, bytes: &[u8], path: &Path) -> Result<Self> {
        let (network, metadata) = weights_file::parse(bytes, path)?;
        Ok(Self { name: name.to_string(), network, turned: name == TURNED, is_restrained: true, metadata })
    }

    /// The model in a weights file, named like the file.
    ///
    /// # Errors
    /// See [`weights_file::read`].
    pub fn from_file(path: &Path) -> Result<Self> {
        let (network, metadata) = weights_file::read(path)?;
        if metadata.network.architecture == Architecture::Prefilter {
            return Err(Error::invalid(
                path,
                "denoises albedo and normal for other networks, not radiance; give it to `demc train --prefilter`",
            ));
        }
        Ok(Self { name: path.display().to_string(), network, turned: false, is_restrained: true, metadata })
    }

    /// The model under another name, with its weights packed for an arithmetic: that asked for, or the
    /// fastest.
    ///
    /// # Errors
    /// 8 bits are asked for, and the model cannot compute in them.
    pub fn with_precision(mut self, name: &str, precision: Option<Precision>) -> Result<Self> {
        let quantizable = self.network.is_quantizable();
        if precision == Some(Precision::Int8) && !quantizable {
            return Err(Error::Usage(format!(
                "{name}: no ranges of activations are known for 8 bits; use :bf16 or :f32 (`demc train` measures \
                 the ranges of demc-s and demc-m wherever it validates)"
            )));
        }
        let precision = precision.unwrap_or_else(|| Precision::fastest(quantizable));
        self.name = name.to_string();
        for conv in self.network.convolutions() {
            conv.set_precision(precision);
        }
        self.network.freeze();
        Ok(self)
    }

    /// The network. Whatever changes its layers or their parameters, or may change them, unfreezes them.
    /// Layers of 8 bits compute only while they are frozen, so [`Network::freeze`] has to be called
    /// afterwards.
    pub fn network(&mut self) -> &mut dyn Network {
        &mut *self.network
    }

    /// Denoises the frame upside down. If its width or height is even, the same pixels would share a quad as
    /// before, so a column or row is added, which becomes the first. It mirrors pixels, so fireflies are
    /// tamed before: two side by side would not count as such. The clean guides are those of the first look.
    fn second_look(
        &self,
        passes: &PassSet,
        guides: &PassSet,
        companions: &mut [Companion],
        tile: Option<usize>,
    ) -> Result<Planes> {
        let size = (passes.width, passes.height);
        let odd = (size.0 | 1, size.1 | 1);
        let radiance = passes.require(Pass::Combined, TURNED)?;
        let grown = guide_rows(passes, 0..size.1, odd, exposure(radiance))?;
        if !companions.is_empty() {
            let (noisy, tamed) =
                (radiance.padded_rows(0..size.1, odd), grown.require(Pass::Combined, TURNED)?);
            for Companion { kind, planes, .. } in &mut *companions {
                *planes = planes.padded_rows(0..size.1, odd);
                if *kind == Kind::Light {
                    tame_alike(planes, &noisy, tamed);
                }
                *planes = planes.turned();
            }
        }
        let guides = HALF_TURN.passes(&guides.padded_rows(&PREFILTERED_PASSES, 0..size.1, odd));
        let image = self.network.infer_along(&HALF_TURN.passes(&grown), Some(&guides), companions, tile)?;
        let back = |image: &Planes| image.turned().window((0, 0), size);
        companions.iter_mut().for_each(|companion| companion.planes = back(&companion.planes));
        Ok(back(&image))
    }

    /// Multiply-accumulates for one pixel of the frame.
    pub fn macs_per_pixel(&self) -> f64 {
        self.network.macs_per_pixel() * if self.turned { 2.0 } else { 1.0 }
    }
}

impl Denoiser for Learned {
    fn name(&self) -> &str {
        &self.name
    }

    fn passes(&self) -> &[Pass] {
        self.network.passes()
    }

    fn optional_passes(&self) -> &[Pass] {
        self.network.optional_passes()
    }

    fn dispensable(&self) -> &[Pass] {
        match self.metadata.network.architecture {
            Architecture::Pyramid => &PREFILTERED_PASSES,
            _ => &[],
        }
    }

    fn notes(&self, shot: &Shot) -> Option<String> {
        if let Some(note) = self.network.notes() {
            return Some(format!("{}: {note}", self.name));
        }
        let PassSet { view_layer, renderer, .. } = &shot.passes;
        let is_missing = |pass: &Pass| shot.passes.get(*pass).is_none();
        let is_zero =
            |pass: &Pass| shot.passes.get(*pass).is_some_and(|planes| planes.data.iter().all(|v| *v == 0.0));
        // A sky has no normal, but light without albedo has one that was never written, and then its normal was not either.
        let is_unwritten =
            |pass: &Pass| is_zero(pass) && is_zero(&Pass::DenoisingAlbedo) && !is_zero(&Pass::Combined);
        let wanted = self.dispensable().iter().copied();
        let missed: Vec<Pass> = wanted.filter(|pass| is_missing(pass) || is_unwritten(pass)).collect();
        let nothing = match missed.len() {
            _ if !missed.iter().all(is_zero) => "",
            1 => ", which holds nothing",
            _ => ", which hold nothing",
        };
        let names: Vec<String> = missed.iter().map(Pass::to_string).collect();
        (!missed.is_empty()).then(|| {
            format!(
                "done without {}{nothing}, at a loss of detail; {}",
                names.join(" and "),
                remedy(view_layer, renderer, &missed)
            )
        })
    }

    fn denoise(&self, shot: &Shot) -> Result<Planes> {
        Ok(self.denoise_along(shot, &mut [], None, false)?.0)
    }

    fn takes_companions(&self) -> bool {
        self.network.takes_companions()
    }

    fn expects_errors(&self) -> bool {
        self.metadata.network.architecture == Architecture::Pyramid && self.is_restrained
    }

    /// Denoises the part of the frame that was rendered, in its place.
    fn denoise_along(
        &self,
        shot: &Shot,
        companions: &mut [Companion],
        tile: Option<usize>,
        expects: bool,
    ) -> Result<(Planes, Option<ExpectedError>)> {
        let passes = &shot.passes;
        if self.metadata.network.architecture != Architecture::Pyramid {
            refuse_companions(&self.name, companions)?;
            return Ok((self.network.infer(passes, tile)?, None));
        }
        // What of a film is empty is told by alpha once that is denoised, whether the caller wants it or not.
        if let Some(alpha) = passes.get(Pass::Alpha)
            && self.is_restrained
            && alpha.varies()
            && !companions.iter().any(Companion::is_alpha)
        {
            let mut along: Vec<Companion> = companions.iter_mut().map(Companion::take).collect();
            along.push(Companion::new(Kind::Share, alpha.clone()));
            let done = self.denoise_along(shot, &mut along, tile, expects);
            companions.iter_mut().zip(along).for_each(|(companion, along)| *companion = along);
            return done;
        }
        let (place, size) = passes.rendered();
        let whole = (passes.width, passes.height);
        // Alpha may go on where nothing that the network reads does: then a thing on a transparent film fills that part,
        // and no region was rendered.
        let ends_there = |along: &Companion| along.planes.lies_within(place, size);
        if size == whole || !companions.iter().all(ends_there) {
            return self.restrained(passes, companions, tile, expects);
        }
        companions.iter_mut().for_each(|companion| companion.planes = companion.planes.window(place, size));
        let (part, error) = self.restrained(&passes.window(place, size), companions, tile, expects)?;
        companions
            .iter_mut()
            .for_each(|companion| companion.planes = companion.planes.placed_in(whole, place));
        Ok((part.placed_in(whole, place), error.map(|error| error.placed_in(whole, place))))
    }
}

impl Learned {
    /// What the network makes of a frame, after [`Shrinkage`] took back what it changed beyond the noise, unless
    /// nothing is to be taken back.
    fn restrained(
        &self,
        passes: &PassSet,
        companions: &mut [Companion],
        tile: Option<usize>,
        expects: bool,
    ) -> Result<(Planes, Option<ExpectedError>)> {
        let passes = &*with_stand_ins(passes);
        if !self.is_restrained {
            return Ok((self.looks(passes, companions, tile)?, None));
        }
        let radiance = passes.require(Pass::Combined, &self.name)?;
        let albedo = passes.require(Pass::DenoisingAlbedo, &self.name)?;
        let (exposure, samples) = (exposure(radiance), passes.samples);
        let render = Render { radiance, albedo, exposure, samples };
        let size = (passes.width, passes.height);
        // Of such a frame, as a clear sky or a black frame, all that a network made would be taken back.
        let shrinkage = Shrinkage::of(&render);
        if shrinkage.keeps_whole() {
            let mut image = radiance.clone();
            image.data.iter_mut().for_each(|v| *v = v.max(0.0));
            return Ok((image, expects.then(|| ExpectedError::none(size))));
        }
        let mut image = self.looks(passes, companions, tile)?;
        for Companion { planes, rendered, .. } in
            companions.iter_mut().filter(|along| along.kind == Kind::Share)
        {
            coverage::take_back(planes, rendered, render.samples_or_guess());
        }
        let shrinkage = shrinkage.keeping(find_empty(radiance, passes, companions));
        let mut shares = (!companions.is_empty()).then(|| Planes::unwritten(1, size.0, size.1));
        let error = if expects {
            let squares = shrinkage.shrink_expecting(&mut image, shares.as_mut());
            Some(ExpectedError::new(squares, size))
        } else {
            shrinkage.shrink(&mut image, shares.as_mut());
            None
        };
        for (companion, shares) in companions.iter_mut().zip(shares.iter().cycle()) {
            let rendered = std::mem::take(&mut companion.rendered);
            if companion.kind != Kind::Share {
                take_back(&mut companion.planes, &rendered, shares);
            }
        }
        Ok((image, error))
    }

    /// What the network makes of a frame, of which [`Shrinkage`] has taken nothing back.
    ///
    /// # Errors
    /// A pass is missing.
    pub fn unrestrained(&self, passes: &PassSet) -> Result<Planes> {
        self.looks(&with_stand_ins(passes), &mut [], None)
    }

    /// What the network makes of a frame.
    fn looks(&self, passes: &PassSet, companions: &mut [Companion], tile: Option<usize>) -> Result<Planes> {
        if !self.turned {
            return self.network.infer_along(passes, None, companions, tile);
        }
        let guides = self.network.clean_guides(passes)?.expect("what looks twice has a prefilter");
        let mut seen_turned = companions.to_vec();
        let mut image = self.network.infer_along(passes, Some(&guides), companions, tile)?;
        let second = self.second_look(passes, &guides, &mut seen_turned, tile)?;
        average(&mut image, &second);
        for (first, second) in companions.iter_mut().zip(&seen_turned) {
            average(&mut first.planes, &second.planes);
        }
        Ok(image)
    }
}

/// Where nothing was met, as alpha tells, which was denoised along with the frame and is cleared there.
fn find_empty(radiance: &Planes, passes: &PassSet, companions: &mut [Companion]) -> Option<Empty> {
    let Companion { planes, rendered, .. } = companions.iter_mut().find(|along| along.is_alpha())?;
    let empty = Empty::of(radiance, Alpha { rendered, denoised: Some(planes) }, passes.samples)?;
    empty.clear(planes);
    Some(empty)
}

/// Replaces planes by the mean of two.
fn average(first: &mut Planes, second: &Planes) {
    first.data.iter_mut().zip(&second.data).for_each(|(first, second)| *first = 0.5 * (*first + second));
}
