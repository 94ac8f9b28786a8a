//! Inference from top to bottom, band by band, to the same bits as [`Network::forward`] on the whole frame.
//!
//! Every layer goes as far down as the rows above it allow and no row is computed twice; rows are kept only
//! while something below needs them. Memory so grows with the width of a frame, not with its height, and
//! a pixel costs the same in a frame of any size.

use std::{collections::VecDeque, ops::Range};

use dfdx::tensor::NoneTape;

use super::{Encoder, Finish, KERNEL, LEVELS, NEEDED_BY, Prediction, Pyramid, kernel_of};
use crate::{
    Result,
    features::{
        Inputs, Refined, Shading, albedo_as_radiance, albedo_exposure, exposure, guides, keep_black,
        radiance_as_albedo,
    },
    filters::refit::{Guides, Refit, Samples},
    kernels::{Shape, blend::Place},
    models::network::Network,
    nn::{Activation, Conv, Line, MaxPool},
    passes::{Pass, PassSet},
    planes::Planes,
};

type Maps = Activation<NoneTape>;
type Field = crate::nn::Field<NoneTape>;

/// Pixels of a band: enough to keep threads busy, few enough for an 8K frame to fit in 3 GiB.
const BAND_PIXELS: usize = 9 << 14;

/// Denoised radiance of a frame, (3, H, W). `rows` are those of a band, if the user has an opinion.
///
/// # Errors
/// A pass is missing.
pub fn infer(network: &Pyramid, passes: &PassSet, rows: Option<usize>) -> Result<Planes> {
    let radiance = passes.require(Pass::Combined, NEEDED_BY)?;
    let albedo = passes.require(Pass::DenoisingAlbedo, NEEDED_BY)?;
    let exposure = exposure(radiance);
    let multiple = network.multiple();
    let (width, height) = (passes.width.next_multiple_of(multiple), passes.height.next_multiple_of(multiple));
    let rows = (rows.unwrap_or(BAND_PIXELS / width) / multiple * multiple).max(multiple);
    // The last rows are mirrored below themselves, so as many come at once as that may take.
    let is_last = |end: usize| passes.height < end + multiple;
    let padded =
        |rows: &Range<usize>| (width, if rows.end == passes.height { height } else { rows.end } - rows.start);
    let starts = (0..passes.height).step_by(rows).filter(|&y| y == 0 || !is_last(y));
    let bands = starts.map(|y| y..if is_last(y + rows) { passes.height } else { y + rows });
    let normal = passes.require(Pass::DenoisingNormal, NEEDED_BY)?;
    let size = (passes.width, passes.height);
    let mut refit = Refit::new(size);
    // The albedo of what the refit has under way.
    let mut divisors = Planes::default();
    let mut image = Planes::default();
    let mut write = |first: usize, part: Planes, albedo: Option<Planes>| {
        let end = first + part.height;
        if part.height == passes.height {
            image = part;
        } else {
            if image.height == 0 {
                image = Planes::unwritten(3, size.0, size.1);
            }
            image.write_rows(first, &part);
        }
        if let Some(albedo) = albedo {
            let first = refit.done();
            divisors = match divisors.height {
                0 => albedo,
                _ => divisors.above(&albedo),
            };
            let guides = Guides { size, normal: &normal.data, albedo: &divisors.data, first };
            let samples = Samples::Rendered(&radiance.data, exposure);
            refit.advance(guides, &mut image.data, samples, end, |v, factor| {
                *v = *v * factor * exposure.recip()
            });
            let done = refit.done() - first;
            divisors = divisors.window((0, done), (size.0, divisors.height - done));
        }
        Ok(())
    };
    let mut beauty = Feed::new(network, passes, exposure, rows);
    if let Some(prefilter) = &network.prefilter {
        let shading = Shading::of(passes, exposure, NEEDED_BY)?;
        let mut prefiltered = Feed::new(prefilter, passes, albedo_exposure(albedo), rows);
        let mut held: Option<Planes> = None;
        for band in bands {
            let size = padded(&band);
            let band = albedo_as_radiance(passes, band, size, NEEDED_BY)?;
            // What of the albedo is done goes on its way at once, so that nobody keeps a whole frame of it.
            prefiltered.push(band, None, &mut |first, clean, _| {
                let end = first + clean.height;
                let clean = match held.take() {
                    Some(held) => held.above(&clean),
                    None => clean,
                };
                if end < passes.height && is_last(end) {
                    held = Some(clean);
                    return Ok(());
                }
                let rows = end - clean.height..end;
                let shading = shading.rows(passes, rows.clone(), NEEDED_BY)?;
                let size = padded(&rows);
                let refined = Refined { albedo: radiance_as_albedo(clean), shading }.padded_to(size);
                beauty.push(network.rows(passes, rows, size, exposure)?, Some(refined), &mut write)
            })?;
        }
    } else {
        for band in bands {
            let size = padded(&band);
            beauty.push(network.rows(passes, band, size, exposure)?, None, &mut write)?;
        }
    }
    keep_black(&mut image, radiance, albedo);
    Ok(image)
}

/// A frame that comes in band by band and leaves denoised.
struct Feed<'a> {
    frame: Frame<'a>,
    exposure: f32,
    /// Columns and rows of the frame.
    size: (usize, usize),
}

impl<'a> Feed<'a> {
    fn new(network: &'a Pyramid, passes: &PassSet, exposure: f32, band: usize) -> Self {
        let size = (passes.width, passes.height);
        let frame = Frame::new(network, size.1.next_multiple_of(network.multiple()), band);
        Self { frame, exposure, size }
    }

    /// Takes in the next rows, grown to what the network can halve, and what is refined of them where it has a
    /// prefilter, and hands out what is denoised with it: its first row, and radiance.
    fn push(
        &mut self,
        band: PassSet,
        refined: Option<Refined>,
        done: &mut dyn FnMut(usize, Planes, Option<Planes>) -> Result<()>,
    ) -> Result<()> {
        let refits = refined.is_some();
        let Inputs { planes, scale } = guides(&band, refined, self.exposure, NEEDED_BY)?;
        // A refit takes exposed radiance, and scales it last.
        let scale = if refits { 1.0 } else { scale };
        let (width, height) = self.size;
        let mut result = Ok(());
        let mut hand_out = |first: usize, field: &Field, albedo: &Field| {
            let (_, _, h, w) = field.extent();
            let rows = h.min(height.saturating_sub(first));
            if rows == 0 || result.is_err() {
                return;
            }
            let part = |field: &Field, scale: f32| {
                let values = field.values();
                Planes::from_rows(3, (width, rows), |c, y, into| {
                    let from = &values[(c * h + y) * w..];
                    into.iter_mut().zip(from).for_each(|(into, v)| *into = v * scale);
                })
            };
            result = done(first, part(field, scale), refits.then(|| part(albedo, 1.0)));
        };
        self.frame.push(planes);
        self.frame.advance(&mut hand_out);
        while self.frame.is_whole() && !self.frame.is_done() {
            self.frame.advance(&mut hand_out);
        }
        result
    }
}

/// All that is under way in a frame.
struct Frame<'a> {
    network: &'a Pyramid,
    /// Rows that one step may take: without it, the last step would take all that is behind.
    band: usize,
    encoders: [Vec<Encoded>; 2],
    /// Finest level first.
    decoder: Vec<Decoded>,
    /// Full resolution first.
    scales: Vec<Scale>,
    albedo: Line<Field>,
    /// What was divided by the clean albedo, and the logarithm of that over the noisy one, until the network says which is
    /// to divide; rows go to the finest scale's image at once where it does not say.
    quotient: Line<Field>,
    ratio: Line<Field>,
    /// What normals tell of the light, until the network says how far to follow it.
    shading: Line<Field>,
    /// Logits of the gains, a field for each kernel of full resolution.
    gains: VecDeque<Field>,
}

/// A level of an encoder.
struct Encoded {
    input: Line<Maps>,
    middle: Line<Maps>,
    output: Line<Maps>,
}

/// A level of the decoder.
struct Decoded {
    up: Line<Maps>,
    fused: Line<Maps>,
    refined: Line<Maps>,
}

/// A level of the radiance pyramid.
struct Scale {
    image: Line<Field>,
    confidence: Line<Field>,
    /// What the head predicted for bands not yet blended, and for those not yet filtered.
    masks: VecDeque<(Range<usize>, Field, Field)>,
    kernels: VecDeque<(Range<usize>, Field)>,
    /// The image, blended with the level below.
    blended: Line<Field>,
    /// What the level above takes in.
    smooth: Line<Field>,
    /// Rows filtered.
    filtered: usize,
}

impl<'a> Frame<'a> {
    fn new(network: &'a Pyramid, height: usize, band: usize) -> Self {
        let rows = |level: usize| height >> (level + 1);
        let encoder = || {
            let level = |l| Encoded {
                input: Line::new(rows(l)),
                middle: Line::new(rows(l)),
                output: Line::new(rows(l)),
            };
            (0..LEVELS).map(level).collect()
        };
        let decoded =
            |l| Decoded { up: Line::new(rows(l)), fused: Line::new(rows(l)), refined: Line::new(rows(l)) };
        let scale = |s: usize| Scale {
            image: Line::new(height >> s),
            confidence: Line::new(height >> s),
            masks: VecDeque::new(),
            kernels: VecDeque::new(),
            blended: Line::new(height >> s),
            smooth: Line::new(height >> s),
            filtered: 0,
        };
        Self {
            network,
            band,
            encoders: [encoder(), encoder()],
            decoder: (0..LEVELS).map(decoded).collect(),
            scales: (0..=LEVELS).map(scale).collect(),
            albedo: Line::new(height),
            quotient: Line::new(height),
            ratio: Line::new(height),
            shading: Line::new(height),
            gains: VecDeque::new(),
        }
    }

    /// Adds the inputs of the next rows.
    fn push(&mut self, inputs: Vec<Planes>) {
        let mut inputs = inputs.into_iter();
        let mut next = || inputs.next().expect("`guides` makes four planes and, with a prefilter, two more");
        let field = |p: Planes| Field::from_buffer((1, p.channels, p.height, p.width), p.data);
        let [irradiance, albedo, radiance, guide] = std::array::from_fn(|_| next());
        if self.network.prefilter.is_some() {
            self.quotient.push(field(irradiance));
            self.ratio.push(field(next()));
            self.shading.push(field(next()));
        } else {
            self.scales[0].image.push(field(irradiance));
        }
        self.albedo.push(field(albedo));
        let layers = self.network.encoders.iter().map(|encoder| &encoder.levels[0][0]);
        for ((encoder, layer), planes) in self.encoders.iter_mut().zip(layers).zip([radiance, guide]) {
            let shape = Shape::new(1, planes.channels, planes.height, planes.width);
            encoder[0].input.push(layer.input_halved(shape, &planes.data));
        }
    }

    /// Whether all inputs are there.
    fn is_whole(&self) -> bool {
        self.albedo.end() == self.albedo.total()
    }

    /// Whether everything is computed.
    fn is_done(&self) -> bool {
        self.scales[0].filtered == self.albedo.total()
    }

    /// Computes the next rows of everything, as far as they can be, and hands out those that are done: the
    /// first row, radiance, and the albedo.
    fn advance(&mut self, done: &mut impl FnMut(usize, &Field, &Field)) {
        self.encode();
        self.decode();
        self.reduce();
        for scale in (0..=LEVELS).rev() {
            self.blend(scale);
            self.filter(scale, done);
        }
        self.forget();
    }

    /// Both encoders side by side: their layers need not wait for each other.
    fn encode(&mut self) {
        let ([radiance, guide], band) = (&mut self.encoders, self.band);
        let [of_radiance, of_guide] = &self.network.encoders;
        rayon::join(|| encode(of_radiance, radiance, band), || encode(of_guide, guide, band));
    }

    fn decode(&mut self) {
        // The decoder's layers, coarsest level first; its lines, finest first.
        for (level, layers) in (0..LEVELS).rev().zip(&self.network.decoder) {
            let (finer, coarser) = self.decoder.split_at_mut(level + 1);
            let Decoded { up, fused, refined } = &mut finer[level];
            if let (Some(layer), Some(below)) = (&layers.up, coarser.first()) {
                let from = up.end() / 2;
                let to = below.refined.settled(1).min(from + (self.band >> (level + 2)));
                if from < to {
                    up.push(layer.forward(vec![below.refined.rows_and_border(from..to)]));
                }
            }
            // A band of the skips at a time, which so need no copy.
            let skips = self.encoders.each_ref().map(|encoder| &encoder[level].output);
            while let Some(to) = skips[0].band_end(fused.end()) {
                let rows = fused.end()..to;
                if layers.up.is_some() && up.end() < to {
                    break;
                }
                let mut sources: Vec<Maps> = skips.iter().map(|skip| skip.rows(rows.clone())).collect();
                sources.extend(layers.up.iter().map(|_| up.rows(rows.clone())));
                fused.push(layers.fuse.forward(sources));
            }
            let from = refined.end();
            convolve(&layers.refine, fused, refined, self.band >> (level + 1));
            let rows = from..refined.end();
            if rows.is_empty() {
                continue;
            }
            let fine = [refined.rows(rows.clone())];
            let head = self.network.heads[level].forward_planes(&fine, 1);
            let prediction = Prediction::split(KERNEL, |first, count| head.channels(first, count));
            self.scales[level + 1].predicted(rows.clone(), prediction);
            if level == 0 {
                let head = self.network.full.forward_planes(&fine, 2);
                let planes = |first, count| head.channels(first, count);
                let (prediction, Finish { mut gain, refined }) =
                    Prediction::split_full(head.extent().1, planes);
                let rows = 2 * rows.start..2 * rows.end;
                if let Some((divisor, shade)) = refined {
                    let (quotient, ratio) = (self.quotient.rows(rows.clone()), self.ratio.rows(rows.clone()));
                    self.scales[0].image.push(quotient.redivide(ratio, divisor));
                    gain = gain.plus_product(self.shading.rows(rows.clone()), shade);
                }
                self.gains.push_back(gain);
                self.scales[0].predicted(rows, prediction);
            }
        }
    }

    /// Builds the radiance pyramid.
    fn reduce(&mut self) {
        for scale in 0..LEVELS {
            let [fine, coarse] = &mut self.scales[scale..scale + 2] else { unreachable!("two scales") };
            let (from, to) = (coarse.image.end(), fine.image.end().min(fine.confidence.end()) / 2);
            if from < to {
                let rows = 2 * from..2 * to;
                coarse.image.push(fine.image.rows(rows.clone()).reduce(fine.confidence.rows(rows)));
            }
        }
    }

    /// Blends the image with what the scale below became.
    fn blend(&mut self, scale: usize) {
        let (finer, coarser) = self.scales.split_at_mut(scale + 1);
        let Scale { image, masks, blended, .. } = &mut finer[scale];
        let Some(below) = coarser.first().map(|c| &c.smooth) else { return };
        while let Some((rows, _, _)) = masks.front() {
            if image.end() < rows.end || 2 * below.settled(1) < rows.end {
                break;
            }
            let (rows, mask, corners) = masks.pop_front().expect("there is one");
            let near = (rows.start / 2).saturating_sub(1)..(rows.end / 2 + 1).min(below.total());
            let place = Place { first: rows.start, total: image.total(), coarse: near.start };
            blended.push(image.rows(rows).blend_rows(place, &below.rows(near), &mask, &corners));
        }
    }

    /// Filters the image; at full resolution, hands out what becomes of it.
    fn filter(&mut self, scale: usize, done: &mut impl FnMut(usize, &Field, &Field)) {
        let (k, reach) = (kernel_of(scale), kernel_of(scale) / 2);
        let Scale { image, confidence, kernels, blended, smooth, filtered, .. } = &mut self.scales[scale];
        let source = if scale == LEVELS { &*image } else { &*blended };
        while let Some((rows, _)) = kernels.front() {
            if source.settled(reach).min(confidence.settled(reach)) < rows.end {
                break;
            }
            let (rows, kernel) = kernels.pop_front().expect("there is one");
            let (near, inside) = around(&rows, reach, source.total());
            let (source, trust) = (source.rows(near.clone()), confidence.rows(near));
            let output = source.filter_rows(inside, k, &kernel, &trust);
            *filtered = rows.end;
            if scale > 0 {
                smooth.push(output);
                continue;
            }
            let gain = self.gains.pop_front().expect("there is one for each kernel");
            let albedo = self.albedo.rows(rows.clone());
            done(rows.start, &output.product(albedo.fork()).amplify(gain), &albedo);
        }
    }

    /// Lets go of every row that nothing needs any more.
    fn forget(&mut self) {
        for level in 0..LEVELS {
            let pooled = (level + 1 < LEVELS).then(|| level + 1);
            for encoder in &mut self.encoders {
                let below = pooled.map_or(usize::MAX, |below| 2 * encoder[below].input.end());
                let Encoded { input, middle, output } = &mut encoder[level];
                input.forget(middle.end().saturating_sub(1));
                middle.forget(output.end().saturating_sub(1));
                output.forget(below.min(self.decoder[level].fused.end()));
            }
            let above = level.checked_sub(1).map_or(usize::MAX, |above| self.decoder[above].up.end() / 2);
            let Decoded { up, fused, refined } = &mut self.decoder[level];
            up.forget(fused.end());
            fused.forget(refined.end().saturating_sub(1));
            refined.forget(above.min(refined.end()).saturating_sub(1));
        }
        for scale in 0..=LEVELS {
            let reduced = self.scales.get(scale + 1).map_or(usize::MAX, |below| 2 * below.image.end());
            let above = scale.checked_sub(1).map_or(0, |above| self.scales[above].blended.end() / 2);
            let Scale { image, confidence, blended, smooth, filtered, .. } = &mut self.scales[scale];
            let reach = filtered.saturating_sub(kernel_of(scale) / 2);
            image.forget(reach.min(reduced));
            confidence.forget(reach.min(reduced));
            blended.forget(reach);
            smooth.forget(above.saturating_sub(1));
        }
        self.quotient.forget(self.scales[0].image.end());
        self.ratio.forget(self.scales[0].image.end());
        self.shading.forget(self.scales[0].image.end());
        self.albedo.forget(self.scales[0].filtered);
    }
}

impl Scale {
    /// Takes in what a head predicted for `rows`.
    fn predicted(&mut self, rows: Range<usize>, prediction: Prediction<NoneTape>) {
        let Prediction { kernel, confidence, mask, corners } = prediction;
        // A copy, since it is kept for longer than all the head's planes, whose memory it would keep.
        self.confidence.push(Field::input(confidence.extent(), confidence.values()));
        self.masks.push_back((rows.clone(), mask, corners));
        self.kernels.push_back((rows, kernel));
    }
}

/// Takes the levels of an encoder as far as they can go, by at most `band` rows of the frame.
fn encode(encoder: &Encoder, levels: &mut [Encoded], band: usize) {
    for (level, [first, second]) in encoder.levels.iter().enumerate() {
        let (above, rest) = levels.split_at_mut(level);
        let Encoded { input, middle, output } = &mut rest[0];
        if let Some(above) = above.last() {
            let (from, to) = (input.end(), above.output.end() / 2);
            if from < to {
                input.push(MaxPool.forward(above.output.rows(2 * from..2 * to)));
            }
        }
        let most = band >> (level + 1);
        convolve(first, input, middle, most);
        convolve(second, middle, output, most);
    }
}

/// A 3x3 convolution of at most `most` rows whose neighbours are there.
fn convolve(layer: &Conv, from: &Line<Maps>, to: &mut Line<Maps>, most: usize) {
    let rows = to.end()..from.settled(1).min(to.end() + most);
    if !rows.is_empty() {
        to.push(layer.forward(vec![from.rows_and_border(rows)]));
    }
}

/// Rows `rows` of `total` with `reach` rows more on either side, and where `rows` lie among those.
fn around(rows: &Range<usize>, reach: usize, total: usize) -> (Range<usize>, (usize, usize)) {
    let near = rows.start.saturating_sub(reach)..(rows.end + reach).min(total);
    let inside = (rows.start - near.start, rows.end - near.start);
    (near, inside)
}
