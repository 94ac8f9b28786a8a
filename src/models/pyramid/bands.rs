//! A network's layers from top to bottom of a frame, band by band, to the same bits as [`Network::forward`] on the whole of it.
//!
//! Every layer goes as far down as the rows above it allow and no row is computed twice; rows are kept only
//! while something below needs them. Memory so grows with the width of a frame, not with its height, and
//! a pixel costs the same in a frame of any size.

use std::{collections::VecDeque, ops::Range};

use dfdx::tensor::NoneTape;

use super::trunk::{Encoder, Finish, KERNEL, LEVELS, MULTIPLE, Prediction, Trunk};
use crate::{
    Result,
    kernels::{Shape, blend::Place},
    nn::{Activation, Conv, Line, MaxPool},
    planes::Planes,
};

type Maps = Activation<NoneTape>;
pub type Field = crate::nn::Field<NoneTape>;

/// Images that a trunk's kernels filter: light, or guides.
pub trait Subject {
    /// What is read of some rows.
    type Inputs;

    /// How many images there are.
    fn images(&self) -> usize;

    /// Takes in the next rows, and returns the encoders' inputs; `images` are those of full resolution.
    fn push(&mut self, inputs: Self::Inputs, images: &mut [Filtered]) -> [Planes; 2];

    /// Takes in what the head of full resolution says of `rows`, and returns the logits of the gains.
    fn predicted(&mut self, rows: Range<usize>, finish: Finish<NoneTape>, images: &mut [Filtered]) -> Field;

    /// What becomes of `rows` once their images are filtered, each (3, R, W).
    fn finish(&self, rows: Range<usize>, filtered: Vec<Field>, gain: Field) -> Vec<Field>;

    /// Lets go of the rows of which everything is `predicted`, and of those that are `finished`.
    fn forget(&mut self, predicted: usize, finished: usize);
}

/// Planes as a field.
pub fn of_planes(planes: Planes) -> Field {
    Field::from_buffer((1, planes.channels, planes.height, planes.width), planes.data)
}

/// A frame that comes in band by band and leaves denoised.
pub struct Feed<'a, S> {
    frame: Frame<'a, S>,
    /// Columns and rows of the frame.
    size: (usize, usize),
}

impl<'a, S: Subject> Feed<'a, S> {
    /// A frame of `size` columns and rows, of which no step takes more than `band` rows. `subject` is made for as many rows
    /// as [`padded`] has.
    pub fn new(trunk: &'a Trunk, subject: S, size: (usize, usize), band: usize) -> Self {
        Self { frame: Frame::new(trunk, subject, padded(size.1), band), size }
    }

    /// Takes in the next rows, grown to what the network can halve, and hands out what is denoised with them, times `scale`,
    /// and its first row.
    pub fn push(
        &mut self,
        inputs: S::Inputs,
        scale: f32,
        done: &mut dyn FnMut(usize, Vec<Planes>) -> Result<()>,
    ) -> Result<()> {
        let (width, height) = self.size;
        let mut result = Ok(());
        let mut hand_out = |first: usize, fields: &[Field]| {
            let (_, _, h, w) = fields[0].extent();
            let rows = h.min(height.saturating_sub(first));
            if rows == 0 || result.is_err() {
                return;
            }
            let part = |field: &Field| {
                let values = field.values();
                Planes::from_rows(3, (width, rows), |c, y, into| {
                    let from = &values[(c * h + y) * w..];
                    into.iter_mut().zip(from).for_each(|(into, v)| *into = v * scale);
                })
            };
            result = done(first, fields.iter().map(part).collect());
        };
        self.frame.push(inputs);
        self.frame.advance(&mut hand_out);
        while self.frame.is_whole() && !self.frame.is_done() {
            self.frame.advance(&mut hand_out);
        }
        result
    }
}

/// The rows that a frame of so many is grown to.
pub fn padded(rows: usize) -> usize {
    rows.next_multiple_of(MULTIPLE)
}

/// All that is under way in a frame.
struct Frame<'a, S> {
    trunk: &'a Trunk,
    subject: S,
    /// Rows that one step may take: without it, the last step would take all that is behind.
    band: usize,
    encoders: [Vec<Encoded>; 2],
    /// Finest level first.
    decoder: Vec<Decoded>,
    /// Full resolution first.
    scales: Vec<Scale>,
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

/// A level of the pyramid.
struct Scale {
    /// What is filtered.
    images: Vec<Filtered>,
    confidence: Line<Field>,
    /// What the head predicted for bands not yet blended, and for those not yet filtered.
    masks: VecDeque<(Range<usize>, Field, Field)>,
    kernels: VecDeque<(Range<usize>, Field)>,
    /// Rows filtered.
    filtered: usize,
}

/// A level of an image.
pub struct Filtered {
    pub image: Line<Field>,
    /// That blended with the level below.
    blended: Line<Field>,
    /// What the level above takes in.
    smooth: Line<Field>,
}

impl<'a, S: Subject> Frame<'a, S> {
    fn new(trunk: &'a Trunk, subject: S, height: usize, band: usize) -> Self {
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
        let filtered = |s: usize| Filtered {
            image: Line::new(height >> s),
            blended: Line::new(height >> s),
            smooth: Line::new(height >> s),
        };
        let scale = |s: usize| Scale {
            images: (0..subject.images()).map(|_| filtered(s)).collect(),
            confidence: Line::new(height >> s),
            masks: VecDeque::new(),
            kernels: VecDeque::new(),
            filtered: 0,
        };
        Self {
            trunk,
            band,
            encoders: [encoder(), encoder()],
            decoder: (0..LEVELS).map(decoded).collect(),
            scales: (0..=LEVELS).map(scale).collect(),
            subject,
            gains: VecDeque::new(),
        }
    }

    /// Adds the inputs of the next rows.
    fn push(&mut self, inputs: S::Inputs) {
        let inputs = self.subject.push(inputs, &mut self.scales[0].images);
        let layers = self.trunk.encoders.iter().map(|encoder| &encoder.levels[0][0]);
        for ((encoder, layer), planes) in self.encoders.iter_mut().zip(layers).zip(inputs) {
            let shape = Shape::new(1, planes.channels, planes.height, planes.width);
            encoder[0].input.push(layer.input_halved(shape, &planes.data));
        }
    }

    /// Whether all inputs are there.
    fn is_whole(&self) -> bool {
        self.encoders[0][0].input.end() == self.encoders[0][0].input.total()
    }

    /// Whether everything is computed.
    fn is_done(&self) -> bool {
        self.scales[0].filtered == self.scales[0].confidence.total()
    }

    /// Computes the next rows of everything, as far as they can be, and hands out those that are done: the
    /// first row, and see [`Feed::push`].
    fn advance(&mut self, done: &mut impl FnMut(usize, &[Field])) {
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
        let [of_radiance, of_guide] = &self.trunk.encoders;
        rayon::join(|| encode(of_radiance, radiance, band), || encode(of_guide, guide, band));
    }

    fn decode(&mut self) {
        // The decoder's layers, coarsest level first; its lines, finest first.
        for (level, layers) in (0..LEVELS).rev().zip(&self.trunk.decoder) {
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
            let head = self.trunk.heads[level].forward_planes(&fine, 1);
            let prediction = Prediction::split(KERNEL, |first, count| head.channels(first, count));
            self.scales[level + 1].predicted(rows.clone(), prediction);
            if level == 0 {
                let head = self.trunk.full.forward_planes(&fine, 2);
                let planes = |first, count| head.channels(first, count);
                let (prediction, finish) =
                    Prediction::split_full(self.trunk.kernel(0), head.extent().1, planes);
                let rows = 2 * rows.start..2 * rows.end;
                let images = &mut self.scales[0].images;
                self.gains.push_back(self.subject.predicted(rows.clone(), finish, images));
                self.scales[0].predicted(rows, prediction);
            }
        }
    }

    /// Builds the pyramid.
    fn reduce(&mut self) {
        for scale in 0..LEVELS {
            let [fine, coarse] = &mut self.scales[scale..scale + 2] else { unreachable!("two scales") };
            let trust = &fine.confidence;
            for (fine, coarse) in fine.images.iter().zip(&mut coarse.images) {
                let (from, to) = (coarse.image.end(), fine.image.end().min(trust.end()) / 2);
                if from < to {
                    let rows = 2 * from..2 * to;
                    coarse.image.push(fine.image.rows(rows.clone()).reduce(trust.rows(rows)));
                }
            }
        }
    }

    /// Blends the images with what the scale below became.
    fn blend(&mut self, scale: usize) {
        let (finer, coarser) = self.scales.split_at_mut(scale + 1);
        let Scale { images, masks, .. } = &mut finer[scale];
        let Some(below) = coarser.first().map(|c| &c.images) else { return };
        while let Some((rows, _, _)) = masks.front() {
            let are_there = |(fine, below): (&Filtered, &Filtered)| {
                rows.end <= fine.image.end() && rows.end <= 2 * below.smooth.settled(1)
            };
            if !images.iter().zip(below).all(are_there) {
                break;
            }
            let (rows, mask, corners) = masks.pop_front().expect("there is one");
            for (Filtered { image, blended, .. }, below) in images.iter_mut().zip(below) {
                let below = &below.smooth;
                let near = (rows.start / 2).saturating_sub(1)..(rows.end / 2 + 1).min(below.total());
                let place = Place { first: rows.start, total: image.total(), coarse: near.start };
                blended.push(image.rows(rows.clone()).blend_rows(place, &below.rows(near), &mask, &corners));
            }
        }
    }

    /// Filters the images; at full resolution, hands out what becomes of them.
    fn filter(&mut self, scale: usize, done: &mut impl FnMut(usize, &[Field])) {
        let reach = self.trunk.kernel(scale) / 2;
        let Scale { images, confidence, kernels, filtered, .. } = &mut self.scales[scale];
        while let Some((rows, _)) = kernels.front() {
            let settled = images.iter().map(|image| image.source(scale).settled(reach)).min();
            if settled.expect("something is filtered").min(confidence.settled(reach)) < rows.end {
                break;
            }
            let (rows, kernel) = kernels.pop_front().expect("there is one");
            let (near, inside) = around(&rows, reach, confidence.total());
            let trust = confidence.rows(near.clone());
            let sources: Vec<Field> =
                images.iter().map(|image| image.source(scale).rows(near.clone())).collect();
            // Of images that are filtered together, each weight is computed once.
            let filtered_together = |images: &[Field]| match images {
                [a, b, c] => Field::filter_rows([a, b, c], inside, &kernel, &trust).into(),
                [a, b] => Field::filter_rows([a, b], inside, &kernel, &trust).into(),
                images => Vec::from(Field::filter_rows([&images[0]], inside, &kernel, &trust)),
            };
            let outputs = sources.chunks(3).flat_map(filtered_together);
            *filtered = rows.end;
            if scale > 0 {
                images.iter_mut().zip(outputs).for_each(|(image, output)| image.smooth.push(output));
                continue;
            }
            let gain = self.gains.pop_front().expect("there is one for each kernel");
            done(rows.start, &self.subject.finish(rows, outputs.collect(), gain));
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
            // Of several images all are as far on.
            let reduced =
                self.scales.get(scale + 1).map_or(usize::MAX, |below| 2 * below.images[0].image.end());
            let above =
                scale.checked_sub(1).map_or(0, |above| self.scales[above].images[0].blended.end() / 2);
            let Scale { images, confidence, filtered, .. } = &mut self.scales[scale];
            let reach = filtered.saturating_sub(self.trunk.kernel(scale) / 2);
            confidence.forget(reach.min(reduced));
            for Filtered { image, blended, smooth } in images {
                image.forget(reach.min(reduced));
                blended.forget(reach);
                smooth.forget(above.saturating_sub(1));
            }
        }
        let Scale { images, filtered, .. } = &self.scales[0];
        self.subject.forget(images[0].image.end(), *filtered);
    }
}

impl Filtered {
    /// What the kernels of a scale filter: the coarsest has nothing to be blended with.
    fn source(&self, scale: usize) -> &Line<Field> {
        if scale == LEVELS { &self.image } else { &self.blended }
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
