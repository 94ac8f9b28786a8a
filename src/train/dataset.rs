//! Training frames in memory, and the crops drawn from them.

use std::collections::HashMap;

use half::{f16, slice::HalfFloatSliceExt, vec::HalfFloatVecExt};
use rayon::prelude::*;

use super::Augment;
use crate::{
    Error, Result,
    frame::Frame,
    nn::Rng,
    passes::{self, Pass, PassSet},
    planes::Planes,
    testset::Pair,
};

/// Frames and references, decoded once and held as half floats (the precision they mostly come in).
pub struct Dataset {
    frames: Vec<Stored>,
    /// Pixels of all frames up to and with each.
    pixels: Vec<usize>,
    /// Of each frame the others that differ from it by their noise alone.
    seeds: Vec<Vec<usize>>,
}

#[cfg_attr(test, derive(Clone))]
struct Stored {
    pair: Pair,
    view_layer: String,
    width: usize,
    height: usize,
    passes: Vec<(Pass, Vec<f16>)>,
    reference: Vec<f16>,
    /// The reference before it was denoised, where that is wanted and its file holds it.
    raw_reference: Option<Vec<f16>>,
}

/// A crop: noisy passes and the reference radiance.
#[derive(Clone, Debug)]
pub struct Sample {
    /// The noisy passes.
    pub passes: PassSet,
    /// The reference, (3, H, W).
    pub reference: Planes,
    /// The reference before it was denoised, (3, H, W), where that was asked for and is known: noisy,
    /// but right on average.
    pub raw_reference: Option<Planes>,
}

/// Largest finite half: brighter values are clipped in the training copy.
const HALF_MAX: f32 = 65504.0;

fn to_half(values: &[f32]) -> Vec<f16> {
    let clipped: Vec<f32> = values.iter().map(|v| v.clamp(-HALF_MAX, HALF_MAX)).collect();
    Vec::from_f32_slice(&clipped)
}

impl Dataset {
    /// Decodes of every pair the passes that must be there and those that may, and, if `raw_references`, what
    /// the references were before they were denoised. Frames smaller than `patch` in either direction are an
    /// error, since no crop fits them.
    ///
    /// # Errors
    /// A file is unreadable, lacks a pass, or the two of a pair differ in size.
    pub fn load(
        pairs: &[Pair],
        passes: (&[Pass], &[Pass]),
        raw_references: bool,
        patch: usize,
    ) -> Result<Self> {
        let frames: Vec<Stored> = pairs
            .par_iter()
            .map(|pair| Stored::load(pair, passes, raw_references, patch))
            .collect::<Result<_>>()?;
        let mut total = 0;
        let pixels = frames.iter().map(|f| {
            total += f.width * f.height;
            total
        });
        Ok(Self { pixels: pixels.collect(), seeds: seeds(&frames), frames })
    }

    /// Frames held.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether it holds no frame.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// The whole of frame `index`, and its name.
    pub fn frame(&self, index: usize) -> (String, Sample) {
        let stored = &self.frames[index];
        (stored.pair.id(), stored.crop(0, 0, stored.width, stored.height))
    }

    /// A random square crop of `patch` pixels, augmented; all of it decided by `rng`. A frame is drawn as
    /// often as it is large. Where there are more renders of it with as many samples, each pixel comes from
    /// one of two: Cycles draws the samples of each pixel apart, so that is a render with a seed of its own,
    /// and no network gets to learn the noise of those that there are by heart.
    pub fn draw(&self, patch: usize, rng: &mut Rng) -> Sample {
        let pixel = rng.below(*self.pixels.last().expect("nothing is drawn from an empty dataset"));
        let index = self.pixels.partition_point(|&end| end <= pixel);
        let stored = &self.frames[index];
        let x = rng.below(stored.width - patch + 1);
        let y = rng.below(stored.height - patch + 1);
        let mut sample = stored.crop(x, y, patch, patch);
        if let seeds @ [_, ..] = self.seeds[index].as_slice() {
            let other = &self.frames[seeds[rng.below(seeds.len())]];
            sample.passes = mixed(&sample.passes, &other.passes((x, y), (patch, patch)), rng);
        }
        Augment::draw(rng).apply(&mut sample);
        sample
    }
}

/// Of each frame the others that have its reference, its number of samples and its passes.
fn seeds(frames: &[Stored]) -> Vec<Vec<usize>> {
    let key = |frame: &Stored| {
        let passes: Vec<Pass> = frame.passes.iter().map(|(pass, _)| *pass).collect();
        (frame.pair.reference.clone(), frame.pair.spp, passes)
    };
    let mut groups: HashMap<_, Vec<usize>> = HashMap::new();
    for (index, frame) in frames.iter().enumerate() {
        groups.entry(key(frame)).or_default().push(index);
    }
    let others =
        |(index, frame)| groups[&key(frame)].iter().copied().filter(|other| *other != index).collect();
    frames.iter().enumerate().map(others).collect()
}

/// Takes each pixel, all passes of it, from either of two crops.
fn mixed(one: &PassSet, other: &PassSet, rng: &mut Rng) -> PassSet {
    let pick: Vec<bool> = (0..one.width * one.height).map(|_| rng.below(2) == 1).collect();
    one.map((one.width, one.height), |pass, planes| {
        let mut planes = planes.clone();
        let from = other.get(pass).expect("renders of one view have the same passes");
        for c in 0..planes.channels {
            let pixels = planes.channel_mut(c).iter_mut().zip(from.channel(c)).zip(&pick);
            pixels.filter(|(_, pick)| **pick).for_each(|((pixel, other), _)| *pixel = *other);
        }
        planes
    })
}

impl Stored {
    fn load(
        pair: &Pair,
        (needed, optional): (&[Pass], &[Pass]),
        raw_references: bool,
        patch: usize,
    ) -> Result<Self> {
        let frame = Frame::read(&pair.noisy)?;
        let mut noisy = passes::read(&frame, None)?;
        for &pass in needed {
            noisy.require(pass, "training")?;
        }
        noisy.sanitize();
        let mut reference = passes::load(&pair.reference, None)?;
        reference.sanitize();
        let target = reference.require(Pass::Combined, "training")?;
        if (reference.width, reference.height) != (noisy.width, noisy.height) {
            return Err(Error::invalid(
                &pair.noisy,
                format!(
                    "{}x{} pixels, but its reference {} has {}x{}; render both at one size",
                    noisy.width,
                    noisy.height,
                    pair.reference.display(),
                    reference.width,
                    reference.height
                ),
            ));
        }
        if noisy.width < patch || noisy.height < patch {
            return Err(Error::invalid(
                &pair.noisy,
                format!(
                    "{}x{} pixels hold no patch of {patch}x{patch}; pass --patch N with a smaller size",
                    noisy.width, noisy.height
                ),
            ));
        }
        let raw_reference =
            reference.get(Pass::NoisyImage).filter(|_| raw_references).map(|raw| to_half(&raw.data));
        let kept = noisy.iter().filter(|(p, _)| needed.contains(p) || optional.contains(p));
        Ok(Self {
            pair: pair.clone(),
            view_layer: noisy.view_layer.clone(),
            width: noisy.width,
            height: noisy.height,
            passes: kept.map(|(pass, planes)| (pass, to_half(&planes.data))).collect(),
            reference: to_half(&target.data),
            raw_reference,
        })
    }

    fn crop(&self, x: usize, y: usize, width: usize, height: usize) -> Sample {
        let cut = |data: &[f16]| self.cut(data, 3, (x, y), (width, height));
        Sample {
            passes: self.passes((x, y), (width, height)),
            reference: cut(&self.reference),
            raw_reference: self.raw_reference.as_deref().map(cut),
        }
    }

    /// The noisy passes of a crop.
    fn passes(&self, at: (usize, usize), (width, height): (usize, usize)) -> PassSet {
        let mut passes = PassSet::new(&self.pair.noisy, &self.view_layer, width, height);
        for (pass, data) in &self.passes {
            passes.insert(*pass, self.cut(data, pass.channels(), at, (width, height)));
        }
        passes
    }

    fn cut(
        &self,
        data: &[f16],
        channels: usize,
        (x, y): (usize, usize),
        (width, height): (usize, usize),
    ) -> Planes {
        Planes::from_rows(channels, (width, height), |c, row, out| {
            data[(c * self.height + y + row) * self.width + x..][..width].convert_to_f32_slice(out);
        })
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    /// A frame all of whose passes are `value` everywhere.
    fn stored(reference: &str, spp: u32, value: f32) -> Stored {
        let plane = |channels: usize| vec![f16::from_f32(value); channels * 64];
        let pair = Pair {
            scene: "scene".into(),
            noisy: "noisy.exr".into(),
            reference: reference.into(),
            spp,
            frame: None,
        };
        Stored {
            pair,
            view_layer: "ViewLayer".into(),
            width: 8,
            height: 8,
            passes: vec![(Pass::Combined, plane(3)), (Pass::Depth, plane(1))],
            reference: plane(3),
            raw_reference: None,
        }
    }

    fn dataset(frames: Vec<Stored>) -> Dataset {
        Dataset { pixels: (1..=frames.len()).map(|n| 64 * n).collect(), seeds: seeds(&frames), frames }
    }

    #[test]
    fn renders_of_one_view_with_as_many_samples_are_mixed_pixel_by_pixel() {
        let frames = [("a", 4, 1.0), ("a", 4, 2.0), ("a", 8, 4.0), ("b", 4, 8.0)];
        let data = dataset(frames.map(|(reference, spp, value)| stored(reference, spp, value)).to_vec());
        let mut rng = Rng::new(1, 0);
        let mut met = BTreeSet::new();
        for _ in 0..64 {
            let sample = data.draw(8, &mut rng);
            let depth = &sample.passes.get(Pass::Depth).unwrap().data;
            let values: BTreeSet<u32> = depth.iter().map(|v| *v as u32).collect();
            // All passes of a pixel come from one render; exposure alone may scale radiance.
            let combined = sample.passes.get(Pass::Combined).unwrap();
            let scale = combined.data[0] / depth[0];
            for (pixel, depth) in combined.channel(2).iter().zip(depth) {
                assert!((pixel - depth * scale).abs() < 1e-5 * pixel);
            }
            met.insert(values);
        }
        assert_eq!(met, [[1, 2].into(), [4].into(), [8].into()].into());
    }
}
