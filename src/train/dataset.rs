//! Training frames in memory, and the crops drawn from them.

use std::{
    collections::HashMap,
    sync::atomic::{AtomicBool, Ordering},
};

use half::{f16, slice::HalfFloatSliceExt, vec::HalfFloatVecExt};
use rayon::prelude::*;

use crate::{
    Error, Result,
    augment::Augment,
    features::{PREFILTERED_PASSES, stand_in},
    frame::HALF_MAX,
    metrics::pairing,
    passes::{self, Pass, PassSet},
    planes::Planes,
    rng::Rng,
    shot,
    testset::Pair,
};

/// Frames and references, decoded once and mostly held as half floats, see `Values`.
pub struct Dataset {
    frames: Vec<Stored>,
    /// For each frame, the number of pixels of all frames up to and including it.
    pixels: Vec<usize>,
    /// For each frame, the indices of the others that differ from it by their noise alone.
    seeds: Vec<Vec<usize>>,
}

#[cfg_attr(test, derive(Clone))]
struct Stored {
    pair: Pair,
    view_layer: String,
    width: usize,
    height: usize,
    passes: Vec<(Pass, Values)>,
    reference: Vec<(Pass, Values)>,
    /// The reference before it was denoised, where that is wanted and its file holds it.
    raw_reference: Option<Values>,
    /// See [`pairing::warning`].
    warning: Option<String>,
}

/// A crop: noisy passes and the reference.
#[derive(Clone, Debug)]
pub struct Sample {
    /// The noisy passes.
    pub passes: PassSet,
    /// The reference's passes.
    pub reference: PassSet,
    /// The reference before it was denoised, (3, H, W), where that was asked for and is known: noisy,
    /// but right on average.
    pub raw_reference: Option<Planes>,
}

/// Single values of a reference that are not finite are filled in from their neighbours; of more than one in so many,
/// some lie together and would be learned as black.
const MOST_HOLES: usize = 1000;

/// The training copy of a pass, (C, H, W).
#[cfg_attr(test, derive(Clone))]
enum Values {
    /// Values beyond the largest half are clipped to it.
    Half(Vec<f16>),
    Full(Vec<f32>),
}

impl Values {
    /// Half floats, except for positions and depths: far from the origin, half floats lie further apart than
    /// the details of a scene, and no half float holds the 1e10 of a ray that hits nothing.
    fn of(pass: Pass, values: &[f32]) -> Self {
        match pass {
            Pass::Position | Pass::Depth | Pass::DenoisingDepth => Self::Full(values.to_vec()),
            _ => {
                let clipped: Vec<f32> = values.iter().map(|v| v.clamp(-HALF_MAX, HALF_MAX)).collect();
                Self::Half(Vec::from_f32_slice(&clipped))
            }
        }
    }

    /// Fills `out` with the values from the one at `start` on.
    fn read(&self, start: usize, out: &mut [f32]) {
        match self {
            Self::Half(values) => values[start..][..out.len()].convert_to_f32_slice(out),
            Self::Full(values) => out.copy_from_slice(&values[start..][..out.len()]),
        }
    }
}

/// How many of the crops are changed beyond what every crop may be; none by default.
#[derive(Clone, Copy, Debug, Default)]
pub struct Shares {
    /// Of crops that lack guides, 0 to 1.
    pub guide_dropout: f64,
    /// Of crops in coloured light, 0 to 1; see [`Augment::tinted`].
    pub tint: f64,
}

impl Dataset {
    /// Decodes every pair: of the noisy frame the `passes` that must be there and those that may, of the
    /// reference the `targets`, and if `raw_references` also the reference before it was denoised. Frames
    /// smaller than `least` in either direction are an error, since no crop fits them.
    ///
    /// # Errors
    /// A file is unreadable, lacks a pass, the two of a pair differ in size, or a reference has holes; or `stop` was
    /// set meanwhile.
    pub fn load(
        pairs: &[Pair],
        passes: (&[Pass], &[Pass]),
        targets: &[Pass],
        raw_references: bool,
        least: usize,
        stop: &AtomicBool,
    ) -> Result<Self> {
        let load = |pair| match stop.load(Ordering::Relaxed) {
            true => Err(Error::Interrupted),
            false => Stored::load(pair, passes, targets, raw_references, least),
        };
        let frames: Vec<Stored> = pairs.par_iter().map(load).collect::<Result<_>>()?;
        Ok(Self::of(frames))
    }

    fn of(frames: Vec<Stored>) -> Self {
        let mut total = 0;
        let pixels = frames.iter().map(|f| {
            total += f.width * f.height;
            total
        });
        Self { pixels: pixels.collect(), seeds: seeds(&frames), frames }
    }

    /// Whether some reference is held as it was before it was denoised.
    pub fn has_raw_references(&self) -> bool {
        self.frames.iter().any(|stored| stored.raw_reference.is_some())
    }

    /// Frames held.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether it holds no frame.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Warnings about pairs that do not seem to belong together; each names the file.
    pub fn warnings(&self) -> impl Iterator<Item = &String> {
        self.frames.iter().filter_map(|stored| stored.warning.as_ref())
    }

    /// The name of frame `index`, and the whole frame.
    pub fn frame(&self, index: usize) -> (String, Sample) {
        let stored = &self.frames[index];
        (stored.pair.id(), stored.crop(0, 0, stored.width, stored.height))
    }

    /// The side of a step's crops in pixels: `most`, or if less, the largest multiple of `multiple` that fits
    /// into a frame drawn by `rng`.
    pub fn draw_side(&self, most: usize, multiple: usize, rng: &mut Rng) -> usize {
        let side = self.draw_frame(rng).1.side();
        most.min(side / multiple * multiple)
    }

    /// A random square crop of `side` pixels, augmented; `rng` decides all of it. Frames are drawn in
    /// proportion to their pixels, and never where they are too small. Where other renders of the frame have
    /// as many samples, each pixel comes from one of two renders: Cycles draws the samples of each pixel
    /// independently, so the mixture is a render with a seed of its own, and no network can learn the noise
    /// of the stored renders by heart. The dataset must hold a frame of `side` pixels in both directions, as it
    /// does for a side from [`Self::draw_side`].
    pub fn draw(&self, side: usize, shares: Shares, rng: &mut Rng) -> Sample {
        let (index, stored) = loop {
            let drawn = self.draw_frame(rng);
            if drawn.1.side() >= side {
                break drawn;
            }
        };
        let x = rng.below(stored.width - side + 1);
        let y = rng.below(stored.height - side + 1);
        let mut sample = stored.crop(x, y, side, side);
        if let seeds @ [_, ..] = self.seeds[index].as_slice() {
            let other = &self.frames[seeds[rng.below(seeds.len())]];
            let other = other.passes(&other.passes, (x, y), (side, side));
            sample.passes = mixed(&sample.passes, &other, rng);
        }
        drop_guides(&mut sample.passes, shares.guide_dropout, rng);
        let augment = Augment::draw(rng).tinted(shares.tint, rng);
        Sample {
            passes: augment.passes(&sample.passes),
            reference: augment.passes(&sample.reference),
            raw_reference: sample.raw_reference.map(|raw| augment.pass(Pass::Combined, &raw)),
        }
    }

    /// A frame and its index, drawn in proportion to its pixels.
    fn draw_frame(&self, rng: &mut Rng) -> (usize, &Stored) {
        let pixel = rng.below(*self.pixels.last().expect("nothing is drawn from an empty dataset"));
        let index = self.pixels.partition_point(|&end| end <= pixel);
        (index, &self.frames[index])
    }
}

/// For each frame, the indices of the others that have the same reference, number of samples and passes.
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

/// In a share of crops, replaces the albedo, the normal, or both by what [stands in](stand_in) for them.
fn drop_guides(passes: &mut PassSet, share: f64, rng: &mut Rng) {
    if share == 0.0 || f64::from(rng.uniform()) >= share {
        return;
    }
    let dropped = [&PREFILTERED_PASSES[..1], &PREFILTERED_PASSES[1..], &PREFILTERED_PASSES][rng.below(3)];
    let size = (passes.width, passes.height);
    for pass in dropped.iter().filter(|pass| passes.get(**pass).is_some()).copied().collect::<Vec<_>>() {
        passes.insert(pass, stand_in(pass, size));
    }
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
        targets: &[Pass],
        raw_references: bool,
        least: usize,
    ) -> Result<Self> {
        let noisy = shot::prepare(&pair.noisy, None)?.passes;
        noisy.require_all(needed.iter().copied(), "training")?;
        let mut reference = passes::load_like(&pair.reference, &noisy)?;
        let filled_in = reference.sanitize();
        reference.require_all(targets.iter().copied(), "training")?;
        noisy.check_same_pixels(&reference, "its reference")?;
        if noisy.width.min(noisy.height) < least {
            return Err(Error::invalid(
                &pair.noisy,
                format!(
                    "{}x{} pixels hold no crop of {least}x{least}, the smallest that this network and loss take; render larger frames",
                    noisy.width, noisy.height
                ),
            ));
        }
        let copy = |(pass, planes): (Pass, &Planes)| (pass, Values::of(pass, &planes.data));
        let raw = reference.get(Pass::NoisyImage).filter(|_| raw_references);
        let raw_reference = raw.map(|raw| Values::of(Pass::NoisyImage, &raw.data));
        let kept = |passes: &PassSet, wanted: &[&[Pass]]| -> Vec<(Pass, Values)> {
            let wanted = |pass: &Pass| wanted.iter().any(|passes| passes.contains(pass));
            passes.iter().filter(|(pass, _)| wanted(pass)).map(copy).collect()
        };
        let radiance = [&noisy, &reference].map(|passes| passes.get(Pass::Combined));
        let warning = match radiance {
            [Some(noisy), Some(clean)] => pairing::warning(pair.noisy.display(), noisy, clean),
            _ => None,
        };
        let holes = targets.iter().chain(raw.map(|_| &Pass::NoisyImage));
        let holes: usize = holes.filter_map(|pass| filled_in.get(pass)).sum();
        let values = 3 * noisy.width * noisy.height;
        let told = format!("{holes} of the values to learn are NaN or infinite");
        if holes * MOST_HOLES > values {
            let why = format!("{told}; render the reference again, or leave the pair out");
            return Err(Error::invalid(&pair.reference, why));
        }
        let filled_in = format!("{}: {told}, and were filled in from around", pair.reference.display());
        let warning = (holes > 0).then_some(filled_in).or(warning);
        Ok(Self {
            pair: pair.clone(),
            view_layer: noisy.view_layer.clone(),
            width: noisy.width,
            height: noisy.height,
            passes: kept(&noisy, &[needed, optional]),
            reference: kept(&reference, &[targets]),
            raw_reference,
            warning,
        })
    }

    /// The side of the largest square crop.
    fn side(&self) -> usize {
        self.width.min(self.height)
    }

    fn crop(&self, x: usize, y: usize, width: usize, height: usize) -> Sample {
        let (at, size) = ((x, y), (width, height));
        Sample {
            passes: self.passes(&self.passes, at, size),
            reference: self.passes(&self.reference, at, size),
            raw_reference: self.raw_reference.as_ref().map(|values| self.cut(values, 3, at, size)),
        }
    }

    /// Some passes of a crop.
    fn passes(&self, all: &[(Pass, Values)], at: (usize, usize), (width, height): (usize, usize)) -> PassSet {
        let mut passes = PassSet::new(&self.pair.noisy, &self.view_layer, width, height);
        for (pass, values) in all {
            passes.insert(*pass, self.cut(values, pass.channels(), at, (width, height)));
        }
        passes
    }

    fn cut(
        &self,
        values: &Values,
        channels: usize,
        (x, y): (usize, usize),
        (width, height): (usize, usize),
    ) -> Planes {
        Planes::from_rows(channels, (width, height), |c, row, out| {
            values.read((c * self.height + y + row) * self.width + x, out);
        })
    }
}

#[cfg(test)]
mod tests {
    use std::{
        collections::BTreeSet,
        path::{Path, PathBuf},
    };

    use super::*;
    use crate::frame::{Frame, NewChannel, SampleKind};

    /// A frame of 8x8 pixels all of whose passes are `value` everywhere.
    fn stored(reference: &str, spp: u32, value: f32) -> Stored {
        stored_of(8, reference, spp, value)
    }

    fn stored_of(side: usize, reference: &str, spp: u32, value: f32) -> Stored {
        let values = |pass: Pass| (pass, Values::of(pass, &vec![value; pass.channels() * side * side]));
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
            width: side,
            height: side,
            passes: [Pass::Combined, Pass::Depth].map(values).into(),
            reference: vec![values(Pass::Combined)],
            raw_reference: None,
            warning: None,
        }
    }

    #[test]
    fn renders_of_one_view_with_as_many_samples_are_mixed_pixel_by_pixel() {
        let frames = [("a", 4, 1.0), ("a", 4, 2.0), ("a", 8, 4.0), ("b", 4, 8.0)];
        let data = Dataset::of(frames.map(|(reference, spp, value)| stored(reference, spp, value)).to_vec());
        let mut rng = Rng::new(1, 0);
        let mut met = BTreeSet::new();
        for _ in 0..64 {
            let sample = data.draw(8, Shares::default(), &mut rng);
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

    #[test]
    fn crops_are_as_large_as_the_frame_drawn_first_and_come_from_frames_that_hold_them() {
        let data = Dataset::of(vec![stored_of(12, "a", 4, 1.0), stored_of(20, "b", 4, 2.0)]);
        let mut rng = Rng::new(2, 0);
        let mut sides = [0; 2];
        for _ in 0..400 {
            let side = data.draw_side(16, 8, &mut rng);
            sides[[8, 16].iter().position(|s| *s == side).expect("a multiple of 8")] += 1;
            let sample = data.draw(side, Shares::default(), &mut rng);
            let depth = &sample.passes.get(Pass::Depth).unwrap().data;
            assert_eq!(depth.len(), side * side);
            assert!(side == 8 || depth[0] == 2.0, "a frame of 12x12 holds no crop of 16x16");
        }
        // The areas are 144 and 400, so the smaller frame is drawn first in 106 of 400 steps.
        assert!((80..132).contains(&sides[0]), "{sides:?}");
    }

    /// A pair of real frames of 128x128 pixels.
    fn room() -> Pair {
        let file = |name: &str| Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name);
        Pair {
            scene: "s0000_room".into(),
            noisy: file("s0000_room_0004spp.exr"),
            reference: file("s0000_room_ref.exr"),
            spp: 4,
            frame: None,
        }
    }

    /// A copy of a frame in `folder` that has another layer; each of its channels is `values`.
    fn with_layer(file: &Path, folder: &Path, layer: &str, axes: [&str; 3], values: &[f32]) -> PathBuf {
        let mut frame = Frame::read(file).unwrap();
        let channels = axes.map(|component| NewChannel { component, kind: SampleKind::Float, values });
        frame.set_layer(0, &format!("ViewLayer.{layer}"), None, &channels).unwrap();
        let copy = folder.join(file.file_name().unwrap());
        frame.write(&copy).unwrap();
        copy
    }

    /// [`room`], with such a copy of its noisy frame.
    fn room_with(folder: &Path, layer: &str, axes: [&str; 3], values: &[f32]) -> Pair {
        let pair = room();
        Pair { noisy: with_layer(&pair.noisy, folder, layer, axes, values), ..pair }
    }

    /// [`room`], with such a copy of its reference.
    fn reference_with(folder: &Path, layer: &str, values: &[f32]) -> Pair {
        let pair = room();
        Pair { reference: with_layer(&pair.reference, folder, layer, ["R", "G", "B"], values), ..pair }
    }

    /// A dataset of one pair that is trained on Combined.
    fn load(pair: Pair, raw_references: bool, least: usize) -> Result<Dataset> {
        let passes = (&[Pass::Combined][..], &[][..]);
        Dataset::load(&[pair], passes, &[Pass::Combined], raw_references, least, &AtomicBool::new(false))
    }

    /// The only frame of a dataset of one pair, with one pass and Combined as its target.
    fn only(pair: Pair, pass: Pass) -> Sample {
        let data =
            Dataset::load(&[pair], (&[pass], &[]), &[Pass::Combined], false, 1, &AtomicBool::new(false));
        data.unwrap().frame(0).1
    }

    #[test]
    fn learns_from_the_render_and_not_from_what_blender_denoised() {
        let folder = tempfile::tempdir().unwrap();
        let render = vec![3.0; 128 * 128];
        let pair = room_with(folder.path(), "Noisy Image", ["R", "G", "B"], &render);
        let sample = only(pair, Pass::Combined);
        assert_eq!(sample.passes.get(Pass::Combined).unwrap().channel(1), render);
    }

    #[test]
    fn places_far_from_the_origin_and_misses_stay_what_they_are() {
        let folder = tempfile::tempdir().unwrap();
        // They are a hundredth apart, where half floats are 1 to 2 apart.
        let places: Vec<f32> = (0..128 * 128).map(|i| 2000.0 + 0.01 * i as f32).collect();
        let pair = room_with(folder.path(), "Position", ["X", "Y", "Z"], &places);
        assert_eq!(only(pair, Pass::Position).passes.get(Pass::Position).unwrap().channel(2), places);
        for depth in [Pass::Depth, Pass::DenoisingDepth] {
            let mut miss = [0.0];
            Values::of(depth, &[1e10]).read(0, &mut miss);
            assert_eq!(miss, [1e10], "{depth}");
        }
    }

    #[test]
    fn single_bad_values_of_references_are_told_and_holes_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let load = |bad: usize| {
            let values: Vec<f32> = (0..128 * 128).map(|i| if i < bad { f32::NAN } else { 0.5 }).collect();
            load(reference_with(folder.path(), "Combined", &values), false, 1)
        };
        let told: Vec<String> = load(2).unwrap().warnings().cloned().collect();
        assert!(told[0].contains("room_ref.exr: 6 of the values to learn are NaN"), "{told:?}");
        let refused = load(300).err().expect("a hole").to_string();
        assert!(
            refused.contains("room_ref.exr: 900 of the values") && refused.contains("render"),
            "{refused}"
        );
    }

    #[test]
    fn a_share_of_crops_lacks_albedo_normals_or_both() {
        let mut rng = Rng::new(3, 0);
        let mut met = std::collections::BTreeMap::new();
        for _ in 0..1000 {
            let mut passes = PassSet::new("a.exr", "", 4, 4);
            let [albedo, normal] = PREFILTERED_PASSES;
            for pass in PREFILTERED_PASSES {
                passes.insert(pass, Planes::from_vec(3, 4, 4, vec![0.25; 48]));
            }
            drop_guides(&mut passes, 0.25, &mut rng);
            let lacks = |pass| passes.get(pass).unwrap().data == stand_in(pass, (4, 4)).data;
            *met.entry([lacks(albedo), lacks(normal)]).or_insert(0) += 1;
        }
        // Three standard deviations.
        assert!((709..791).contains(&met[&[false, false]]), "{met:?}");
        for lacking in [[true, false], [false, true], [true, true]] {
            assert!((57..110).contains(&met[&lacking]), "{met:?}");
        }
    }

    #[test]
    fn references_before_they_were_denoised_are_kept_where_asked_for() {
        let folder = tempfile::tempdir().unwrap();
        let values = vec![0.75; 128 * 128];
        let pair = reference_with(folder.path(), "Noisy Image", &values);
        for raw in [true, false] {
            let data = load(pair.clone(), raw, 1).unwrap();
            assert_eq!(data.has_raw_references(), raw);
            let kept = data.frame(0).1.raw_reference.map(|planes| planes.channel(1).to_vec());
            assert_eq!(kept, raw.then(|| values.clone()));
        }
    }

    #[test]
    fn frames_that_hold_no_crop_at_all_are_named() {
        assert_eq!(load(room(), false, 128).map(|data| data.len()).ok(), Some(1));
        let error = load(room(), false, 144).err().expect("128x128 pixels hold none").to_string();
        assert!(error.contains("s0000_room_0004spp.exr") && error.contains("144x144"), "{error}");
    }
}
