//! Inference on a frame, with the same bits as [`Network::forward`] on the whole frame. It goes strip by
//! strip from left to right, and in each strip [band by band](super::bands) from top to bottom. Rows are
//! refitted and written once they are denoised.
//!
//! The memory that bands need grows with their width. So frames that are wider than most are denoised in
//! vertical strips, each of which reads as many columns beside its own as these depend on. A strip begins
//! where quads of pixels do at every level. What depends on the whole frame, which is exposures and shading,
//! is computed once.

use std::ops::Range;

use rayon::prelude::*;

use super::{
    NEEDED_BY, Pyramid,
    bands::{Feed, padded},
    light::LightImages,
    prefilter::{GuideImages, Prefilter},
    trunk::MULTIPLE,
};
use crate::{
    Result,
    companion::{Companion, Kind},
    features::{
        LightInputs, PREFILTERED_PASSES, Refined, Shading, albedo_exposure, albedo_of_target, exposure,
        guide_inputs, guide_rows, keep_black, light_inputs, normal_of_target, tame_alike,
    },
    filters::refit::{Guides, Refit, Samples},
    models::network::Network,
    passes::{Pass, PassSet},
    planes::Planes,
};

/// Pixels of a band across all strips: enough to keep [`FEW`] threads busy, and few enough for an 8K frame to fit in
/// 3 GiB with them. More threads get twice as many, as they would wait for each other too often. Still larger bands
/// outgrow the memory that is recycled.
const BAND_PIXELS: usize = 9 << 14;
const FEW: usize = 8;

/// Columns of the widest strip: few enough for bands of few rows to fit in little memory, while strips, which
/// overlap, take about a tenth longer at most.
const WIDEST: usize = 6144;

/// Denoised radiance of a frame, (3, H, W), and its companions denoised along with it. `guides` are its clean
/// albedo and normal, where they are known. `rows` are those of a band, if the user chose a number.
///
/// # Errors
/// A pass is missing.
pub fn infer(
    network: &Pyramid,
    passes: &PassSet,
    guides: Option<&PassSet>,
    companions: &mut [Companion],
    rows: Option<usize>,
) -> Result<Planes> {
    infer_in((rows, WIDEST), network, passes, guides, companions)
}

/// [`infer`] in strips of at most `widest` columns.
fn infer_in(
    (rows, widest): (Option<usize>, usize),
    network: &Pyramid,
    passes: &PassSet,
    guides: Option<&PassSet>,
    companions: &mut [Companion],
) -> Result<Planes> {
    let radiance = passes.require(Pass::Combined, NEEDED_BY)?;
    let albedo = passes.require(Pass::DenoisingAlbedo, NEEDED_BY)?;
    let exposure = exposure(radiance);
    let shading = Shading::of(passes, exposure)?;
    let channels = std::iter::once(3).chain(companions.iter().map(|companion| companion.planes.channels));
    let mut written: Vec<Planes> =
        channels.map(|channels| Planes::unwritten(channels, passes.width, passes.height)).collect();
    let guides = match guides {
        Some(guides) => {
            let [albedo, normal] = PREFILTERED_PASSES.map(|pass| guides.require(pass, NEEDED_BY));
            CleanGuides::Given(albedo?, normal?)
        }
        None => CleanGuides::Prefiltered(exposure_of_guides(passes)?),
    };
    let whole = Whole { network, passes, guides, companions, rows, radiance, exposure, shading };
    for strip in network.strips(passes.width, widest) {
        whole.denoise(&strip, &mut written)?;
    }
    let mut written = written.into_iter();
    let mut image = written.next().expect("radiance comes first");
    keep_black(&mut image, radiance, albedo);
    for (companion, mut planes) in companions.iter_mut().zip(written) {
        match companion.kind {
            Kind::Light => keep_black(&mut planes, radiance, albedo),
            // What is zero all around stays zero.
            Kind::Share => keep_black(&mut planes, &companion.planes, &companion.planes),
            Kind::Colour => {}
        }
        companion.becomes(planes);
    }
    Ok(image)
}

/// What a prefilter makes of a frame's guides, as [`guide_targets`](crate::features::guide_targets) has them,
/// each (3, H, W).
///
/// # Errors
/// A pass is missing.
pub fn infer_guides(prefilter: &Prefilter, passes: &PassSet, rows: Option<usize>) -> Result<[Planes; 2]> {
    infer_guides_in((rows, WIDEST), prefilter, passes)
}

/// [`infer_guides`] in strips of at most `widest` columns.
fn infer_guides_in(
    (rows, widest): (Option<usize>, usize),
    prefilter: &Prefilter,
    passes: &PassSet,
) -> Result<[Planes; 2]> {
    let exposure = exposure_of_guides(passes)?;
    let mut guides = [(); 2].map(|()| Planes::unwritten(3, passes.width, passes.height));
    for Strip { own, seen, .. } in Strip::all(passes.width, widest, [prefilter.reach(), 0]) {
        let cut = Cut::new(passes, seen, rows);
        prefilter_bands(prefilter, passes, exposure, &cut, &mut |first, parts| {
            for (guide, part) in guides.iter_mut().zip(parts) {
                let from = (own.start - cut.columns.start, 0);
                guide.write((own.start, first), &part, from, (own.len(), part.height));
            }
            Ok(())
        })?;
    }
    Ok(guides)
}

/// The factor by which a frame's guides are exposed for a prefilter.
fn exposure_of_guides(passes: &PassSet) -> Result<f32> {
    passes.require(Pass::DenoisingNormal, NEEDED_BY)?;
    Ok(albedo_exposure(passes.require(Pass::DenoisingAlbedo, NEEDED_BY)?))
}

/// Denoises the guides in the columns of `cut`, exposed by `exposure`. Completed rows of albedo and normal
/// are passed on as [`Feed::push`] does.
fn prefilter_bands(
    prefilter: &Prefilter,
    passes: &PassSet,
    exposure: f32,
    cut: &Cut,
    done: &mut dyn FnMut(usize, Vec<Planes>) -> Result<()>,
) -> Result<()> {
    let mut feed = Feed::new(&prefilter.trunk, GuideImages, cut.size(), cut.rows);
    for band in cut.bands() {
        let padded = cut.padded(&band);
        let band = passes.padded_rows(&PREFILTERED_PASSES, band, padded).columns(cut.padded_columns());
        feed.push(guide_inputs(&band, exposure)?, exposure.recip(), done)?;
    }
    Ok(())
}

/// Some columns of a frame.
struct Strip {
    /// Columns that are written.
    own: Range<usize>,
    /// Columns that the network reads, so that `own` are right.
    seen: Range<usize>,
    /// Columns that its prefilter reads, so that the guides in `seen` are right.
    prefiltered: Range<usize>,
}

impl Strip {
    /// Cuts `width` columns into as few strips as possible, none of which writes more than `widest` columns.
    /// The network reads `reach[0]` columns beyond those that are written, and the prefilter `reach[1]` more.
    fn all(width: usize, widest: usize, reach: [usize; 2]) -> impl Iterator<Item = Self> {
        let beside = move |columns: &Range<usize>, reach: usize| {
            let reach = reach.next_multiple_of(MULTIPLE);
            columns.start.saturating_sub(reach)..(columns.end + reach).min(width)
        };
        let columns = width.div_ceil(width.div_ceil(widest)).next_multiple_of(MULTIPLE);
        (0..width).step_by(columns).map(move |first| {
            let own = first..(first + columns).min(width);
            let seen = beside(&own, reach[0]);
            Self { prefiltered: beside(&seen, reach[1]), own, seen }
        })
    }
}

impl Pyramid {
    /// The strips of a frame.
    fn strips(&self, width: usize, widest: usize) -> impl Iterator<Item = Strip> {
        Strip::all(width, widest, [self.trunk.reach() + Refit::REACH, self.prefilter.reach()])
    }
}

/// How some columns of a frame are cut into bands.
struct Cut {
    columns: Range<usize>,
    /// Columns and rows of the padded frame, and rows of the frame before it is padded.
    width: usize,
    height: usize,
    unpadded: usize,
    /// Rows of a band.
    rows: usize,
}

impl Cut {
    /// Cuts the columns of a strip. `rows` are those of a band, if the user chose a number.
    fn new(passes: &PassSet, columns: Range<usize>, rows: Option<usize>) -> Self {
        let [width, height] = [passes.width, passes.height].map(|n| n.next_multiple_of(MULTIPLE));
        let pixels = if rayon::current_num_threads() > FEW { 2 * BAND_PIXELS } else { BAND_PIXELS };
        let rows = (rows.unwrap_or(pixels / width) / MULTIPLE * MULTIPLE).max(MULTIPLE);
        Self { columns, width, height, unpadded: passes.height, rows }
    }

    /// Columns and rows before padding.
    fn size(&self) -> (usize, usize) {
        (self.columns.len(), self.unpadded)
    }

    /// The columns after padding, which adds some only at the frame's right edge.
    fn padded_columns(&self) -> Range<usize> {
        self.columns.start..self.columns.end.next_multiple_of(MULTIPLE)
    }

    /// Whether a band that ends before row `end` must reach to the last row instead. Padding mirrors the last
    /// rows below themselves, so as many as it may need must be in the last band.
    fn is_last(&self, end: usize) -> bool {
        self.unpadded < end + MULTIPLE
    }

    /// The columns and rows to which some rows of the whole frame are padded.
    fn padded(&self, rows: &Range<usize>) -> (usize, usize) {
        (self.width, if rows.end == self.unpadded { self.height } else { rows.end } - rows.start)
    }

    /// The rows of every band.
    fn bands(&self) -> impl Iterator<Item = Range<usize>> {
        let starts = (0..self.unpadded).step_by(self.rows).filter(|&y| y == 0 || !self.is_last(y));
        starts.map(|y| y..if self.is_last(y + self.rows) { self.unpadded } else { y + self.rows })
    }
}

/// Where a frame's clean albedo and normal come from.
enum CleanGuides<'a> {
    /// They are known.
    Given(&'a Planes, &'a Planes),
    /// They come from the prefilter, which reads the noisy ones at this exposure.
    Prefiltered(f32),
}

/// A frame, and what all its strips have in common.
struct Whole<'a> {
    network: &'a Pyramid,
    passes: &'a PassSet,
    guides: CleanGuides<'a>,
    companions: &'a [Companion],
    rows: Option<usize>,
    radiance: &'a Planes,
    exposure: f32,
    shading: Shading,
}

impl Whole<'_> {
    /// Denoises a strip and writes it: radiance and companions.
    fn denoise(&self, strip: &Strip, written: &mut [Planes]) -> Result<()> {
        let Self { network, passes, .. } = *self;
        let cut = Cut::new(passes, strip.seen.clone(), self.rows);
        let kinds: Vec<Kind> = self.companions.iter().map(|companion| companion.kind).collect();
        let light = LightImages::new(padded(passes.height), &kinds);
        let mut beauty = Feed::new(&network.trunk, light, cut.size(), cut.rows);
        let mut last = Last::new(self, strip, written);
        let mut feed = |rows: Range<usize>, guides: [Planes; 2]| {
            // A refit reads exposed radiance, so the result is scaled after it.
            beauty.push(self.inputs(&cut, rows, guides)?, 1.0, &mut |first, parts| {
                last.push(first, parts);
                Ok(())
            })
        };
        let exposure = match self.guides {
            CleanGuides::Prefiltered(exposure) => exposure,
            CleanGuides::Given(albedo, normal) => {
                for band in cut.bands() {
                    let size = (cut.columns.len(), band.len());
                    let part = |planes: &Planes| planes.window((cut.columns.start, band.start), size);
                    feed(band.clone(), [part(albedo), part(normal)])?;
                }
                return Ok(());
            }
        };
        let prefiltered = Cut { columns: strip.prefiltered.clone(), ..cut };
        let from = strip.seen.start - strip.prefiltered.start;
        let seen = from..from + strip.seen.len();
        let mut held: Option<[Planes; 2]> = None;
        // Completed rows of the guides are used at once, so that no whole frame of them is kept.
        prefilter_bands(&network.prefilter, passes, exposure, &prefiltered, &mut |first, parts| {
            let clean: [Planes; 2] = parts.try_into().expect("albedo and normal");
            let mut clean = clean.map(|planes| planes.columns(seen.clone()));
            let end = first + clean[0].height;
            if let Some(held) = held.take() {
                clean = [0, 1].map(|i| held[i].above(&clean[i]));
            }
            if end < passes.height && prefiltered.is_last(end) {
                held = Some(clean);
                return Ok(());
            }
            let [albedo, normal] = clean;
            let rows = end - albedo.height..end;
            feed(rows, [albedo_of_target(albedo), normal_of_target(normal)])
        })
    }

    /// The network's inputs for some rows, whose clean albedo and normal are given, and the companions,
    /// divided as radiance is.
    fn inputs(
        &self,
        cut: &Cut,
        rows: Range<usize>,
        [albedo, normal]: [Planes; 2],
    ) -> Result<(LightInputs, Vec<Planes>)> {
        let Self { passes, radiance, exposure, .. } = *self;
        let (padded, columns) = (cut.padded(&rows), cut.padded_columns());
        let shading = self.shading.rows(passes, rows.clone())?.columns(cut.columns.clone());
        let refined = Refined { albedo, normal, shading }.padded_to((columns.len(), padded.1));
        let band = guide_rows(passes, rows.clone(), padded, exposure)?.columns(columns.clone());
        let inputs = light_inputs(&band, refined, exposure)?;
        let tamed = band.require(Pass::Combined, NEEDED_BY)?;
        let part = |planes: &Planes| planes.padded_rows(rows.clone(), padded).columns(columns.clone());
        let is_lit = self.companions.iter().any(|companion| companion.kind == Kind::Light);
        let noisy = if is_lit { part(radiance) } else { Planes::default() };
        let divided = self.companions.iter().map(|companion| {
            let mut planes = part(&companion.planes);
            if planes.channels == 1 {
                planes = planes.of_first(3);
            }
            if companion.kind == Kind::Light {
                tame_alike(&mut planes, &noisy, tamed);
            }
            let scale = if companion.kind == Kind::Light { exposure } else { 1.0 };
            if companion.kind != Kind::Share {
                let values = planes.data.par_iter_mut().zip(&inputs.divisor.data);
                values.for_each(|(value, divisor)| *value = *value * scale / divisor);
            }
            planes
        });
        let divided = divided.collect();
        Ok((inputs, divided))
    }
}

/// The last step of a strip: what is denoised is refitted, and written.
struct Last<'a> {
    whole: &'a Whole<'a>,
    strip: &'a Strip,
    refit: Refit,
    /// Columns and rows.
    size: (usize, usize),
    /// Rows that the refit has not finished: radiance, normal, what radiance was divided by, and companions.
    held: Vec<Planes>,
    /// Radiance and companions of the whole frame.
    written: &'a mut [Planes],
}

impl<'a> Last<'a> {
    fn new(whole: &'a Whole<'a>, strip: &'a Strip, written: &'a mut [Planes]) -> Self {
        let size = (strip.seen.len(), whole.passes.height);
        Self { whole, strip, refit: Refit::new(size), size, held: Vec::new(), written }
    }

    /// Takes in the next rows, as [`Feed::push`] hands them out, and writes those that are done with them.
    fn push(&mut self, first: usize, mut parts: Vec<Planes>) {
        let Whole { companions, radiance, exposure, .. } = *self.whole;
        let end = first + parts[0].height;
        // Images have three channels while they are filtered. Of a layer of one channel, only one is held.
        for (part, companion) in parts[3..].iter_mut().zip(companions) {
            if companion.planes.channels == 1 {
                *part = part.of_first(1);
            }
        }
        if self.held.is_empty() {
            self.held = parts;
        } else {
            self.held.iter_mut().zip(parts).for_each(|(held, part)| *held = held.above(&part));
        }
        let [image, normal, albedo, others @ ..] = &mut self.held[..] else {
            unreachable!("radiance, normal, divisor")
        };
        let is_lit = companions.iter().any(|companion| companion.kind == Kind::Light);
        let before = if is_lit { image.clone() } else { Planes::default() };
        let first = self.refit.done();
        let guides = Guides { size: self.size, normal: &normal.data, albedo: &albedo.data, first };
        let samples = Samples::Rendered(radiance, self.strip.seen.start, exposure);
        let change = |v: &mut f32, factor: f32| *v = *v * factor * exposure.recip();
        self.refit.advance(guides, &mut image.data, samples, end, change);
        let done = self.refit.done() - first;
        for (light, _) in others.iter_mut().zip(companions).filter(|(_, c)| c.kind == Kind::Light) {
            follow(light, (&before, image), done, exposure.recip());
        }
        let Strip { own, seen, .. } = self.strip;
        let results = std::iter::once(&*image).chain(&*others);
        for (written, held) in self.written.iter_mut().zip(results) {
            written.write((own.start, first), held, (own.start - seen.start, 0), (own.len(), done));
        }
        for held in &mut self.held {
            *held = held.window((0, done), (held.width, held.height - done));
        }
    }
}

/// Changes the first `done` rows of a light as a refit changed the beauty: multiplies each value by the
/// beauty `after` the refit over the beauty `before` it. The former is in the `scale` of the result already;
/// where the latter is 0, the value is multiplied by `scale`.
fn follow(light: &mut Planes, (before, after): (&Planes, &Planes), done: usize, scale: f32) {
    let (width, pixels) = (light.width, light.pixels());
    light.data.par_chunks_mut(pixels).enumerate().for_each(|(c, plane)| {
        let beauty = before.channel(c).iter().zip(after.channel(c));
        for (value, (before, after)) in plane[..done * width].iter_mut().zip(beauty) {
            *value *= if *before == 0.0 { scale } else { after / before };
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        models::network::{Architecture, Config},
        nn::Precision,
        rng::Rng,
    };

    const SIZE: (usize, usize) = (1001, 37);

    /// A network narrow enough for tests, with weights drawn from a seed.
    fn network(precision: Precision) -> Pyramid {
        let config =
            Config { prefilter: vec![9, 16, 8, 8], ..Config::new(Architecture::Pyramid, &[24, 16, 9, 8]) };
        let mut network = Pyramid::new(&config, 3);
        for conv in network.convolutions() {
            conv.set_precision(precision);
            conv.range = Some(3.0);
        }
        network.freeze();
        network
    }

    /// Noise, a pixel in fifty a firefly, and black where a strip ends.
    fn noise(channels: usize, seed: u64) -> Planes {
        let mut rng = Rng::new(seed, 0);
        let mut planes = Planes::new(channels, SIZE.0, SIZE.1);
        for (i, v) in planes.data.iter_mut().enumerate() {
            let bright = if rng.uniform() < 0.02 { 1e4 } else { 1.0 };
            *v = if (240..290).contains(&(i % SIZE.0)) { 0.0 } else { bright * rng.uniform() };
        }
        planes
    }

    fn passes() -> PassSet {
        let mut passes = PassSet::new("frame.exr", "ViewLayer", SIZE.0, SIZE.1);
        for (pass, seed) in [(Pass::Combined, 1), (Pass::DenoisingAlbedo, 2), (Pass::DenoisingNormal, 3)] {
            passes.insert(pass, noise(3, seed));
        }
        passes
    }

    fn companions() -> Vec<Companion> {
        let kinds = [(Kind::Light, 3), (Kind::Colour, 3), (Kind::Share, 1), (Kind::Light, 1)];
        let companion = |((kind, channels), seed)| Companion::new(kind, noise(channels, seed));
        kinds.into_iter().zip(4..).map(companion).collect()
    }

    #[test]
    fn strips_give_the_same_bits_as_the_whole_frame() {
        let passes = passes();
        for precision in [Precision::F32, Precision::Bf16, Precision::Int8] {
            let network = network(precision);
            let clean = network.clean_guides(&passes).unwrap().expect("it has a prefilter");
            for guides in [None, Some(&clean)] {
                let denoised = |rows, widest| {
                    let mut companions = companions();
                    let image = infer_in((rows, widest), &network, &passes, guides, &mut companions).unwrap();
                    companions.into_iter().fold(vec![image], |all, c| [all, vec![c.planes]].concat())
                };
                let whole = denoised(None, SIZE.0);
                assert!(whole.iter().all(|planes| planes.non_finite() == 0));
                for (rows, widest) in [(None, 300), (Some(16), 512)] {
                    let given = guides.is_some();
                    assert!(
                        denoised(rows, widest) == whole,
                        "{widest}, {precision:?}, guides given: {given}"
                    );
                }
            }
        }
    }

    #[test]
    fn strips_of_guides_give_the_same_bits_as_the_whole_frame() {
        let (network, passes) = (network(Precision::Int8), passes());
        let [whole, strips] =
            [SIZE.0, 300].map(|widest| infer_guides_in((None, widest), &network.prefilter, &passes).unwrap());
        assert!(whole == strips);
    }

    #[test]
    fn strips_are_as_wide_as_one_another_and_frames_of_usual_widths_are_one() {
        let network = network(Precision::F32);
        let strips = |width| network.strips(width, WIDEST).map(|strip| strip.own).collect::<Vec<_>>();
        for width in [1, 3840, 4096, 6144] {
            assert_eq!(strips(width), std::slice::from_ref(&(0..width)));
        }
        assert_eq!(strips(7680), [0..3840, 3840..7680]);
        assert_eq!(strips(16_384), [0..5472, 5472..10_944, 10_944..16_384]);
        for strip in network.strips(7680, WIDEST) {
            assert!(strip.prefiltered.len() < 4400, "{:?}", strip.prefiltered);
        }
    }
}
