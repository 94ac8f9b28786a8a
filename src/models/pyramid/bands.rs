//! Runs a network's layers from top to bottom of a frame, band by band. Results are the same to the bit as
//! those of [`Network::forward`](super::super::network::Network::forward) on the whole frame.
//!
//! Every layer goes as far down the frame as the rows that it reads allow, and no row is computed twice. Rows
//! are kept only while something needs them. So memory grows with the width of a frame, not with its height,
//! and a pixel costs the same in a frame of any size.

use std::{collections::VecDeque, ops::Range};

use dfdx::tensor::NoneTape;

use super::trunk::{ENCODER, Finish, KERNEL, LEVELS, Layer, MULTIPLE, Prediction, Trunk};
use crate::{
    Result,
    kernels::{Shape, blend::Place, conv::Geometry},
    nn::{Activation, Line, MaxPool},
    planes::Planes,
};

type Maps = Activation<NoneTape>;
pub type Field = crate::nn::Field<NoneTape>;

/// Images that a trunk's kernels filter: light, or guides.
pub trait Subject {
    /// The inputs for some rows.
    type Inputs;

    /// How many images there are.
    fn images(&self) -> usize;

    /// Takes in the next rows, and returns the encoders' inputs. What is to be filtered goes into `images`,
    /// which are those of full resolution, here or in [`Subject::predicted`].
    fn push(&mut self, inputs: Self::Inputs, images: &mut [Filtered]) -> [Planes; 2];

    /// Takes in what the head of full resolution predicted for `rows`, and returns the logits of the gains.
    fn predicted(&mut self, rows: Range<usize>, finish: Finish<NoneTape>, images: &mut [Filtered]) -> Field;

    /// The results for `rows` whose images are `filtered`, each (3, R, W).
    fn finish(&self, rows: Range<usize>, filtered: Vec<Field>, gain: Field) -> Vec<Field>;

    /// Drops rows that are no longer needed: everything is predicted for the first `predicted` rows, and the
    /// first `finished` rows are done.
    fn forget(&mut self, predicted: usize, finished: usize);
}

/// Planes as a field.
pub fn of_planes(planes: Planes) -> Field {
    Field::from_buffer((1, planes.channels, planes.height, planes.width), planes.data)
}

/// A frame that comes in band by band and leaves denoised.
pub struct Feed<'a, S> {
    frame: Progress<'a, S>,
    /// Columns and rows of the frame.
    size: (usize, usize),
}

impl<'a, S: Subject> Feed<'a, S> {
    /// A frame of `size` columns and rows, of which no step takes more than `band` rows. `subject` must be
    /// made for as many rows as [`padded`] gives.
    pub fn new(trunk: &'a Trunk, subject: S, size: (usize, usize), band: usize) -> Self {
        Self { frame: Progress::new(trunk, subject, padded(size.1), band), size }
    }

    /// Takes in the next rows, grown to what the network can halve. Calls `done` with the rows that this
    /// completes: the number of the first, and the denoised images times `scale`.
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

/// The state of a frame that is under way.
struct Progress<'a, S> {
    trunk: &'a Trunk,
    subject: S,
    /// The most rows that one step may take. Without this limit, the last step would take all rows that are
    /// left.
    band: usize,
    /// What each layer makes.
    lines: Vec<Line<Maps>>,
    /// Full resolution first.
    scales: Vec<Scale>,
    /// Logits of the gains, a field for each kernel of full resolution.
    gains: VecDeque<Field>,
}

/// A level of the pyramid.
struct Scale {
    /// What is filtered.
    images: Vec<Filtered>,
    confidence: Line<Field>,
    /// What the head predicted for bands not yet blended, and for those not yet filtered.
    masks: VecDeque<Predicted<(Field, Field)>>,
    kernels: VecDeque<Predicted<Field>>,
    /// Rows filtered.
    filtered: usize,
}

/// What was predicted for a band.
struct Predicted<T> {
    /// The rows of it that are still to be done.
    rows: Range<usize>,
    /// The first row of `planes`.
    first: usize,
    planes: T,
}

impl<T> Predicted<T> {
    fn new(rows: Range<usize>, planes: T) -> Self {
        Self { first: rows.start, rows, planes }
    }

    /// The next rows to be done, of which the first is that row of the planes: as far as row `ready`, or none. Where
    /// a band is not `divisible`, all of it or none.
    fn next(&mut self, ready: usize, divisible: bool) -> Option<(Range<usize>, usize)> {
        // An even number of rows, so that each row of the level below belongs to one part.
        let to = if ready >= self.rows.end { self.rows.end } else { ready & !1 };
        if to <= self.rows.start || (to < self.rows.end && !divisible) {
            return None;
        }
        let rows = self.rows.start..to;
        self.rows.start = to;
        Some((rows.clone(), rows.start - self.first))
    }
}

/// A level of an image.
pub struct Filtered {
    pub image: Line<Field>,
    /// The image blended with the level below.
    blended: Line<Field>,
    /// The filtered image, which is blended into the level above.
    smooth: Line<Field>,
}

impl<'a, S: Subject> Progress<'a, S> {
    fn new(trunk: &'a Trunk, subject: S, height: usize, band: usize) -> Self {
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
            lines: trunk.layers.iter().map(|layer| Line::new(height >> layer.level)).collect(),
            scales: (0..=LEVELS).map(scale).collect(),
            subject,
            gains: VecDeque::new(),
        }
    }

    /// Adds the inputs of the next rows.
    fn push(&mut self, inputs: S::Inputs) {
        let inputs = self.subject.push(inputs, &mut self.scales[0].images);
        for (first, planes) in [0, ENCODER].into_iter().zip(inputs) {
            let reader = self.trunk.layers[first + 1].conv().expect("a convolution reads an input");
            let shape = Shape::new(1, planes.channels, planes.height, planes.width);
            self.lines[first].push(reader.input_halved(shape, &planes.data));
        }
    }

    /// Whether all inputs are there.
    fn is_whole(&self) -> bool {
        self.lines[0].end() == self.lines[0].total()
    }

    /// Whether everything is computed.
    fn is_done(&self) -> bool {
        self.scales[0].filtered == self.scales[0].confidence.total()
    }

    /// Computes the next rows of everything as far as possible, and calls `done` with the rows that are
    /// completed: the number of the first, and their images.
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
        let layers = &self.trunk.layers;
        let (radiance, rest) = self.lines.split_at_mut(ENCODER);
        let encode = |first: usize, lines: &mut [Line<Maps>]| {
            for i in 0..ENCODER {
                let (before, line) = lines.split_at_mut(i);
                layers[first + i].advance(|source| &before[source - first], &mut line[0], self.band);
            }
        };
        rayon::join(|| encode(0, radiance), || encode(ENCODER, &mut rest[..ENCODER]));
    }

    fn decode(&mut self) {
        for (i, layer) in self.trunk.layers.iter().enumerate().skip(2 * ENCODER) {
            let (before, line) = self.lines.split_at_mut(i);
            let from = line[0].end();
            layer.advance(|source| &before[source], &mut line[0], self.band);
            let rows = from..line[0].end();
            for (level, head) in self.trunk.heads.iter().enumerate().rev() {
                if head.source == i && !rows.is_empty() {
                    let planes = head.conv.forward_planes(&[self.lines[i].rows(rows.clone())], head.factor);
                    self.predicted(level, head.factor * rows.start..head.factor * rows.end, &planes);
                }
            }
        }
    }

    /// Takes in what the head of a level predicted for `rows`.
    fn predicted(&mut self, level: usize, rows: Range<usize>, head: &Field) {
        let planes = |first, count| head.channels(first, count);
        if level > 0 {
            return self.scales[level].predicted(rows, Prediction::split(KERNEL, level, planes));
        }
        let (prediction, finish) = Prediction::split_full(self.trunk.kernel(0), head.extent().1, planes);
        let images = &mut self.scales[0].images;
        self.gains.push_back(self.subject.predicted(rows.clone(), finish, images));
        self.scales[0].predicted(rows, prediction);
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
        while let Some(predicted) = masks.front_mut() {
            let ready =
                |(fine, below): (&Filtered, &Filtered)| fine.image.end().min(2 * below.smooth.settled(1));
            let ready = images.iter().zip(below).map(ready).min().expect("something is filtered");
            let Some((rows, first)) = predicted.next(ready, scale > 0) else { break };
            let (mask, corners) = &predicted.planes;
            for (Filtered { image, blended, .. }, below) in images.iter_mut().zip(below) {
                let below = &below.smooth;
                let near = (rows.start / 2).saturating_sub(1)..(rows.end / 2 + 1).min(below.total());
                let place = Place { first: rows.start, total: image.total(), coarse: near.start };
                let image = image.rows(rows.clone());
                blended.push(image.blend_rows(place, &below.rows(near), (mask, corners), first));
            }
            if predicted.rows.is_empty() {
                masks.pop_front();
            }
        }
    }

    /// Filters the images. At full resolution, the results go to `done`.
    fn filter(&mut self, scale: usize, done: &mut impl FnMut(usize, &[Field])) {
        let reach = self.trunk.kernel(scale) / 2;
        let Scale { images, confidence, kernels, filtered, .. } = &mut self.scales[scale];
        while let Some(predicted) = kernels.front_mut() {
            let settled = images.iter().map(|image| image.source(scale).settled(reach)).min();
            let ready = settled.expect("something is filtered").min(confidence.settled(reach));
            // What is done at full resolution goes on as whole bands: what comes next would take as long for two rows.
            let Some((rows, first)) = predicted.next(ready, scale > 0) else { break };
            let kernel = (&predicted.planes, first);
            let (near, inside) = around(&rows, reach, confidence.total());
            let trust = confidence.rows(near.clone());
            let sources: Vec<Field> =
                images.iter().map(|image| image.source(scale).rows(near.clone())).collect();
            // For images that are filtered together, each weight is computed only once.
            let filtered_together = |images: &[Field]| match images {
                [a, b, c] => Field::filter_rows([a, b, c], inside, kernel, &trust).into(),
                [a, b] => Field::filter_rows([a, b], inside, kernel, &trust).into(),
                images => Vec::from(Field::filter_rows([&images[0]], inside, kernel, &trust)),
            };
            let outputs: Vec<Field> = sources.chunks(3).flat_map(filtered_together).collect();
            *filtered = rows.end;
            if predicted.rows.is_empty() {
                kernels.pop_front();
            }
            if scale > 0 {
                images.iter_mut().zip(outputs).for_each(|(image, output)| image.smooth.push(output));
                continue;
            }
            let gain = self.gains.pop_front().expect("there is one for each kernel");
            done(rows.start, &self.subject.finish(rows, outputs, gain));
        }
    }

    /// Drops every row that nothing needs any more.
    fn forget(&mut self) {
        let mut needed = vec![usize::MAX; self.lines.len()];
        for (layer, line) in self.trunk.layers.iter().zip(&self.lines) {
            for source in &layer.sources {
                needed[*source] = needed[*source].min(layer.first_read(line.end()));
            }
        }
        self.lines.iter_mut().zip(needed).for_each(|(line, row)| line.forget(row));
        for scale in 0..=LEVELS {
            // All images have progressed to the same row.
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
    /// What the kernels of a scale filter. It is the blended image, but for the coarsest scale, which has no
    /// level below to be blended with.
    fn source(&self, scale: usize) -> &Line<Field> {
        if scale == LEVELS { &self.image } else { &self.blended }
    }
}

impl Scale {
    /// Takes in what a head predicted for `rows`.
    fn predicted(&mut self, rows: Range<usize>, prediction: Prediction<NoneTape>) {
        let Prediction { kernel, confidence, below } = prediction;
        // The confidence is copied, since it is kept for longer than the head's other planes, and would keep
        // the memory of them all.
        self.confidence.push(Field::input(confidence.extent(), confidence.values()));
        self.masks.extend(below.map(|masks| Predicted::new(rows.clone(), masks)));
        self.kernels.push_back(Predicted::new(rows, kernel));
    }
}

impl Layer {
    /// Makes the next rows of `line`, by at most `band` rows of the frame, as far as the sources are there.
    fn advance<'a>(&self, source: impl Fn(usize) -> &'a Line<Maps>, line: &mut Line<Maps>, band: usize) {
        let Some(&first) = self.sources.first() else { return };
        let (first, end, most) = (source(first), line.end(), band >> self.level);
        let Some(conv) = self.conv() else {
            let to = first.end() / 2;
            if end < to {
                line.push(MaxPool.forward(first.rows(2 * end..2 * to)));
            }
            return;
        };
        match conv.arithmetic().geometry {
            // One band of the first source at a time, so that its rows need no copy.
            Geometry::Same(1) => {
                while let Some(to) = first.band_end(line.end()) {
                    let sources = || self.sources.iter().map(|i| source(*i));
                    if sources().any(|source| source.end() < to) {
                        break;
                    }
                    let rows = line.end()..to;
                    line.push(conv.forward(sources().map(|source| source.rows(rows.clone())).collect()));
                }
            }
            geometry => {
                let spread = if geometry == Geometry::Transposed { 2 } else { 1 };
                let from = end / spread;
                let to = first.settled(1).min(from + most / spread);
                if from < to {
                    line.push(conv.forward(vec![first.rows_and_border(from..to)]));
                }
            }
        }
    }

    /// The first row of its sources that it needs to go on from row `end` of its own.
    fn first_read(&self, end: usize) -> usize {
        match self.conv().map(|conv| conv.arithmetic().geometry) {
            None => 2 * end,
            Some(Geometry::Same(k)) => end.saturating_sub(k / 2),
            Some(_) => (end / 2).saturating_sub(1),
        }
    }
}

/// `rows` with `reach` more rows on either side, as far as there are any in `total`, and where `rows` lie
/// among those.
fn around(rows: &Range<usize>, reach: usize, total: usize) -> (Range<usize>, (usize, usize)) {
    let near = rows.start.saturating_sub(reach)..(rows.end + reach).min(total);
    let inside = (rows.start - near.start, rows.end - near.start);
    (near, inside)
}
