//! What a denoiser is given: the repaired passes of a frame, and what was rendered besides it.
//!
//! In: an EXR file, or passes that are in memory already. Out: a [`Shot`]. Only here does the render replace
//! a Combined that Blender had denoised, are values that are not finite repaired, and are files that belong
//! to a frame looked for. Methods see what they are given and read no files.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use crate::{
    Error, Result,
    frame::Frame,
    passes::{self, Layer, Pass, PassSet},
    planes::Planes,
    sources::Sources,
};

/// A frame of one view layer, ready for any method.
#[derive(Clone, Debug)]
pub struct Shot {
    /// Its passes. Combined is the render before any denoising by Blender, and every value is finite.
    pub passes: PassSet,
    /// Two renders of the same frame with different seeds and half the samples each. See
    /// [`Shot::read_halves`].
    pub halves: Option<[PassSet; 2]>,
    /// Other frames of its sequence. The key is how many frames later they are, and negative for earlier
    /// ones.
    pub neighbours: BTreeMap<i32, PassSet>,
    /// Light groups, which add up to Combined, by name; see [`Shot::read_light_groups`].
    pub light_groups: BTreeMap<String, Planes>,
    /// Whether its left and right edges meet, as in an all-round panorama.
    pub wraps: bool,
    /// Whether Blender had denoised Combined, and the render was taken from the pass `Noisy Image`.
    pub was_denoised: bool,
    /// What was done to normals that Blender did not write, for the user.
    pub normals: Option<String>,
    /// How many values of each pass were not finite and are repaired; passes that were clean are not listed.
    pub repaired: BTreeMap<Pass, usize>,
    /// The same of light groups, by the names of their layers.
    pub repaired_groups: BTreeMap<String, usize>,
    /// The render as it was stored, if some of its values were not finite.
    unrepaired: Option<Planes>,
}

/// Reads a frame: the view layer named, or else the one with the most recognised passes. Stereo files give
/// their first view.
///
/// # Errors
/// The file is unusable, or has no such view layer.
pub fn prepare(path: impl AsRef<Path>, view_layer: Option<&str>) -> Result<Shot> {
    let mut set = passes::load(path, view_layer)?;
    stand_in(&mut set);
    Ok(Shot::new(set))
}

/// Where a file has no Normal, which is in world space, methods that read it are given Denoising Normal, which
/// is in camera space.
fn stand_in(set: &mut PassSet) {
    if set.get(Pass::Normal).is_none()
        && let Some(normals) = set.get(Pass::DenoisingNormal).cloned()
    {
        set.insert(Pass::Normal, normals);
    }
}

/// As [`prepare`], but reads only the `wanted` passes of one view layer in one stereo view. Passes that lie
/// elsewhere are taken from where `sources` says.
///
/// # Errors
/// Pixels cannot be decoded, or a pass is not where it is said to be.
pub fn prepare_layer(frame: &Frame, layer: &Layer, wanted: &[Pass], sources: &Sources) -> Result<Shot> {
    let mut read = [wanted, &[Pass::NoisyImage]].concat();
    let has_stand_in = wanted.contains(&Pass::Normal) && !layer.passes.contains_key(&Pass::Normal);
    if has_stand_in {
        read.push(Pass::DenoisingNormal);
    }
    let mut set = passes::read_layer(frame, layer, &read)?;
    let normals = sources.complete(frame, layer, &read, &mut set)?;
    if has_stand_in {
        stand_in(&mut set);
    }
    // Nobody asks such a shot for the render before it was repaired, so that is dropped.
    Ok(Shot { normals, unrepaired: None, ..Shot::new(set) })
}

/// The half buffers that belong to a noisy frame, `shot_0004spp_a.0017.exr` and `_b` to
/// `shot_0004spp.0017.exr`, where both exist.
pub fn half_paths(noisy: &Path) -> Option<[PathBuf; 2]> {
    let name = noisy.file_name()?.to_str()?;
    let (head, tail) = name.rsplit_once("spp.")?;
    let paths = ["a", "b"].map(|half| noisy.with_file_name(format!("{head}spp_{half}.{tail}")));
    paths.iter().all(|p| p.is_file()).then_some(paths)
}

impl Shot {
    /// A shot of these passes, which are repaired, and of nothing else.
    pub fn new(mut passes: PassSet) -> Self {
        let was_denoised = passes.use_noisy_image();
        let is_broken = |render: &&Planes| render.data.iter().any(|v| !v.is_finite());
        let unrepaired = passes.get(Pass::Combined).filter(is_broken).cloned();
        let repaired = passes.sanitize();
        let (halves, neighbours, light_groups, wraps, normals) = Default::default();
        Self {
            passes,
            halves,
            neighbours,
            light_groups,
            wraps,
            was_denoised,
            normals,
            repaired,
            repaired_groups: BTreeMap::new(),
            unrepaired,
        }
    }

    /// The render as it was stored, in which values that are not finite are not repaired.
    pub fn as_stored(&self) -> Option<&Planes> {
        self.unrepaired.as_ref().or_else(|| self.passes.get(Pass::Combined))
    }

    /// Reads the light groups of the layer that the shot was made of, repaired like its passes.
    ///
    /// # Errors
    /// Pixels cannot be decoded.
    pub fn read_light_groups(&mut self, frame: &Frame, layer: &Layer) -> Result<()> {
        for (name, planes) in passes::read_light_groups(frame, layer)? {
            let mut set = PassSet::new(&self.passes.path, &layer.name, planes.width, planes.height);
            set.insert(Pass::Combined, planes);
            let repaired: usize = set.sanitize().values().sum();
            if repaired > 0 {
                self.repaired_groups.insert(layer.light_groups[&name].name.clone(), repaired);
            }
            self.light_groups.extend(set.remove(Pass::Combined).map(|planes| (name, planes)));
        }
        Ok(())
    }

    /// Reads the half buffers that lie beside the frame's file, if there are any.
    ///
    /// # Errors
    /// A half buffer is unusable, of a stereo frame, or not of the pixels of this frame.
    pub fn read_halves(&mut self) -> Result<()> {
        let Some(paths) = half_paths(&self.passes.path) else { return Ok(()) };
        let [a, b] = paths.each_ref().map(|path| self.read_half(path));
        let halves = [a?, b?];
        for (pass, count) in halves.iter().flat_map(|half| &half.repaired) {
            *self.repaired.entry(*pass).or_default() += count;
        }
        self.halves = Some(halves.map(|half| half.passes));
        Ok(())
    }

    /// Refuses a render of which most was filled in, and is no picture.
    ///
    /// # Errors
    /// More than half of the values of Combined were not finite.
    pub fn refuse_broken(&self) -> Result<()> {
        let values = 3 * self.passes.width * self.passes.height;
        match self.repaired.get(&Pass::Combined) {
            Some(count) if *count > values / 2 => {
                let why = format!(
                    "{count} of the {values} values of Combined are NaN or infinite; render the frame again"
                );
                Err(Error::invalid(&self.passes.path, why))
            }
            _ => Ok(()),
        }
    }

    fn read_half(&self, path: &Path) -> Result<Self> {
        let whole = &self.passes;
        let frame = Frame::read(path)?;
        if frame.views().len() > 1 {
            return Err(Error::invalid(path, "half buffers of stereo frames are not read; move them away"));
        }
        let half = Self::new(passes::read(&frame, Some(&whole.view_layer))?);
        half.refuse_broken()?;
        half.passes.check_same_pixels(whole, "its frame")?;
        Ok(half)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::{NewChannel, SampleKind};

    fn room() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/s0000_room_0004spp.exr")
    }

    #[test]
    fn the_render_takes_the_place_of_what_was_denoised_and_is_repaired() {
        let planes = |value: f32| Planes::from_vec(3, 3, 1, vec![value; 9]);
        let mut passes = PassSet::new("x.exr", "ViewLayer", 3, 1);
        passes.insert(Pass::Combined, planes(1.0));
        assert_eq!(Shot::new(passes.clone()).as_stored(), Some(&planes(1.0)));
        let mut render = planes(2.0);
        render.data[1] = f32::NAN;
        passes.insert(Pass::NoisyImage, render);
        let shot = Shot::new(passes);
        assert!(shot.was_denoised && shot.passes.get(Pass::NoisyImage).is_none());
        assert_eq!(shot.passes.get(Pass::Combined), Some(&planes(2.0)));
        assert_eq!(shot.repaired, BTreeMap::from([(Pass::Combined, 1)]));
        assert!(shot.as_stored().unwrap().data[1].is_nan());
    }

    #[test]
    fn half_buffers_lie_beside_their_frame_and_are_of_its_size() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        std::fs::copy(room(), path("shot_0004spp.0017.exr")).unwrap();
        let mut shot = prepare(path("shot_0004spp.0017.exr"), None).unwrap();
        shot.read_halves().unwrap();
        assert!(shot.halves.is_none());
        // The halves of a render are told apart by their Combined.
        let write = |name: &str, values: &[f32]| {
            let mut frame = Frame::read(room()).unwrap();
            let channel = |component| NewChannel { component, kind: SampleKind::Float, values };
            let channels = ["R", "G", "B"].map(channel);
            frame.set_layer(0, "ViewLayer.Noisy Image", None, &channels).unwrap();
            frame.write(path(name)).unwrap();
        };
        let mut light = vec![1.0; 128 * 128];
        write("shot_0004spp_a.0017.exr", &light);
        light[0] = f32::NAN;
        write("shot_0004spp_b.0017.exr", &light);
        shot.read_halves().unwrap();
        assert_eq!(shot.repaired, BTreeMap::from([(Pass::Combined, 3)]));
        let halves = shot.halves.as_ref().expect("both are there");
        let values = halves.each_ref().map(|half| half.get(Pass::Combined).unwrap().data[0]);
        assert_eq!(values, [1.0, 1.0]);
        // What is no picture, or one of other pixels, is an error.
        write("shot_0004spp_b.0017.exr", &[f32::NAN; 128 * 128]);
        let message = shot.read_halves().unwrap_err().to_string();
        assert!(message.contains("shot_0004spp_b.0017.exr") && message.contains("NaN"), "{message}");
        let other = room().with_file_name("no_harm/principled_0064spp.exr");
        std::fs::copy(other, path("shot_0004spp_b.0017.exr")).unwrap();
        let message = shot.read_halves().unwrap_err().to_string();
        assert!(
            message.contains("shot_0004spp_b.0017.exr") && message.contains("one size and region"),
            "{message}"
        );
    }
}
