//! The ways in which a frame is changed, each known and always the same.

use crate::{
    augment::Augment,
    passes::{Pass, PassSet, Quantity, to_camera_space},
    planes::Planes,
};

/// One way to change a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trial {
    /// Nothing changes; the other trials are compared with this one.
    AsRendered,
    /// Radiance is a 256th, as in scenes in physical units or by moonlight.
    Darker,
    /// Radiance is 256 times as high.
    Brighter,
    /// Radiance is a 4096th.
    MuchDarker,
    /// Radiance is 4096 times as high.
    MuchBrighter,
    /// Left and right change places.
    Mirrored,
    /// The frame begins 5 pixels further right and 3 further down, so that a network's pooling grid lies
    /// elsewhere.
    Cropped,
    /// One pixel in 1024 is a firefly of 1000 times the mean radiance.
    Fireflies,
    /// One pixel in 1024 of every pass is NaN or infinite.
    NonFinite,
    /// Guides are 2 pixels further right than radiance, as when a compositor moved one layer.
    ShiftedGuides,
    /// Guides hold nothing: all zero.
    BlankGuides,
    /// Albedo holds nothing.
    BlankAlbedo,
    /// Normals hold nothing.
    BlankNormals,
    /// The frame has no guides at all.
    WithoutGuides,
    /// The frame has no albedo.
    WithoutAlbedo,
    /// The frame has no normals.
    WithoutNormals,
    /// Albedo is a pseudorandom value in 0..1 in each pixel, as if another layer had its name.
    RandomAlbedo,
    /// Albedo is twice as high, so that it may exceed one, as from renderers that add coats to it.
    BrightAlbedo,
    /// Albedo is encoded for display by the curve of sRGB.
    SrgbAlbedo,
    /// Normals are stored in 0..1.
    UnitNormals,
    /// Normals are in world space, and the file does not hold the camera's orientation.
    WorldNormals,
}

/// Factor of [`Trial::Darker`]; its inverse is that of [`Trial::Brighter`].
const DARK: f32 = 1.0 / 256.0;

/// Factor of [`Trial::MuchDarker`]; its inverse is that of [`Trial::MuchBrighter`].
const VERY_DARK: f32 = 1.0 / 4096.0;

/// World axes in camera space of [`Trial::WorldNormals`]: a camera that looks 30 degrees to the side and 25
/// down on a world whose z points up.
const WORLD_AXES: [[f32; 3]; 3] =
    [[0.866_025, -0.211_309, 0.453_154], [0.5, 0.365_998, -0.784_886], [0.0, 0.906_308, 0.422_618]];

/// First column and row of [`Trial::Cropped`]; odd, so that pixels pair up differently where networks halve.
pub const CORNER: (usize, usize) = (5, 3);

/// Radiance of a firefly over the frame's mean.
const FIREFLY: f64 = 1000.0;

/// Columns by which [`Trial::ShiftedGuides`] moves guides.
const SHIFT: usize = 2;

impl Trial {
    /// Every trial, the unchanged frame first.
    pub const ALL: [Self; 21] = [
        Self::AsRendered,
        Self::Darker,
        Self::Brighter,
        Self::MuchDarker,
        Self::MuchBrighter,
        Self::Mirrored,
        Self::Cropped,
        Self::Fireflies,
        Self::NonFinite,
        Self::ShiftedGuides,
        Self::BlankGuides,
        Self::BlankAlbedo,
        Self::BlankNormals,
        Self::WithoutGuides,
        Self::WithoutAlbedo,
        Self::WithoutNormals,
        Self::RandomAlbedo,
        Self::BrightAlbedo,
        Self::SrgbAlbedo,
        Self::UnitNormals,
        Self::WorldNormals,
    ];

    /// Its name in tables.
    pub fn name(self) -> &'static str {
        self.said().0
    }

    /// What it does, for a reader of its name.
    pub fn meaning(self) -> &'static str {
        self.said().1
    }

    /// Name and meaning.
    fn said(self) -> (&'static str, &'static str) {
        match self {
            Self::AsRendered => ("as-rendered", "nothing changes: what the others are measured by"),
            Self::Darker => ("darker", "radiance is a 256th"),
            Self::Brighter => ("brighter", "radiance is 256 times as high"),
            Self::MuchDarker => ("much-darker", "radiance is a 4096th"),
            Self::MuchBrighter => ("much-brighter", "radiance is 4096 times as high"),
            Self::Mirrored => ("mirrored", "left and right change places"),
            Self::Cropped => ("cropped", "the frame begins 5 pixels further right and 3 further down"),
            Self::Fireflies => ("fireflies", "one pixel in 1024 has 1000 times the mean radiance"),
            Self::NonFinite => ("non-finite", "one pixel in 1024 of every pass is NaN or infinite"),
            Self::ShiftedGuides => ("shifted-guides", "guides are 2 pixels further right than radiance"),
            Self::BlankGuides => ("blank-guides", "guides hold nothing"),
            Self::BlankAlbedo => ("blank-albedo", "albedo holds nothing"),
            Self::BlankNormals => ("blank-normals", "normals hold nothing"),
            Self::WithoutGuides => ("without-guides", "there are no guides"),
            Self::WithoutAlbedo => ("without-albedo", "there is no albedo"),
            Self::WithoutNormals => ("without-normals", "there are no normals"),
            Self::RandomAlbedo => ("random-albedo", "albedo is any value in 0..1 in each pixel"),
            Self::BrightAlbedo => ("bright-albedo", "albedo is twice as high"),
            Self::SrgbAlbedo => ("srgb-albedo", "albedo is encoded by the curve of sRGB"),
            Self::UnitNormals => ("unit-normals", "normals are stored in 0..1"),
            Self::WorldNormals => ("world-normals", "normals are of world space, the camera unknown"),
        }
    }

    /// What radiance is multiplied by.
    fn exposure(self) -> f32 {
        match self {
            Self::Darker => DARK,
            Self::Brighter => DARK.recip(),
            Self::MuchDarker => VERY_DARK,
            Self::MuchBrighter => VERY_DARK.recip(),
            _ => 1.0,
        }
    }

    /// The change as an augmentation, where it is one.
    fn augment(self) -> Option<Augment> {
        let exposure = self.exposure();
        match self {
            Self::Mirrored => Some(Augment { flip: true, ..Augment::IDENTITY }),
            _ if exposure != 1.0 => Some(Augment { exposure, ..Augment::IDENTITY }),
            _ => None,
        }
    }

    /// Whether a frame holds anything that this changes, by what [`Trial::change`] made of it.
    pub fn touches(self, before: &PassSet, after: &PassSet) -> bool {
        match self {
            Self::AsRendered => true,
            // As they are read, normals of other renderers may be put right to the last bit.
            Self::UnitNormals | Self::WorldNormals => before.get(Pass::DenoisingNormal).is_some(),
            _ => !after.holds_the_same(before),
        }
    }

    /// The changed frame; values may be NaN.
    pub fn change(self, passes: &PassSet) -> PassSet {
        if let Some(augment) = self.augment() {
            return augment.passes(passes);
        }
        let (width, height) = (passes.width, passes.height);
        match self {
            Self::Cropped => {
                let size = (width.saturating_sub(CORNER.0), height.saturating_sub(CORNER.1));
                passes.map(size, |_, planes| self.seen(planes))
            }
            Self::Fireflies => passes.map((width, height), |pass, planes| {
                let mut planes = planes.clone();
                if pass == Pass::Combined {
                    let sum: f64 = planes.data.iter().map(|v| f64::from(*v)).sum();
                    let firefly = (FIREFLY * sum / planes.data.len().max(1) as f64) as f32;
                    let pixels = planes.pixels();
                    (0..pixels).filter(|&at| is_chosen(at)).for_each(|at| {
                        (0..3).for_each(|c| planes.data[c * pixels + at] = firefly);
                    });
                }
                planes
            }),
            Self::NonFinite => passes.map((width, height), |_, planes| {
                const BAD: [f32; 3] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
                let mut planes = planes.clone();
                let pixels = planes.pixels();
                for (c, plane) in planes.data.chunks_mut(pixels.max(1)).enumerate() {
                    (0..pixels)
                        .filter(|&at| is_chosen(at))
                        .for_each(|at| plane[at] = BAD[(at + c) % BAD.len()]);
                }
                planes
            }),
            Self::ShiftedGuides => passes.map((width, height), |pass, planes| {
                let mut shifted = planes.clone();
                if !pass.carries_radiance() {
                    for (row, from) in shifted.data.chunks_mut(width).zip(planes.data.chunks(width)) {
                        row.iter_mut().enumerate().for_each(|(x, v)| *v = from[x.saturating_sub(SHIFT)]);
                    }
                }
                shifted
            }),
            Self::BlankGuides => guides(passes, |_| true, blank),
            Self::BlankAlbedo => guides(passes, is_albedo, blank),
            Self::BlankNormals => guides(passes, is_normal, blank),
            Self::WithoutGuides => without(passes, |_| true),
            Self::WithoutAlbedo => without(passes, is_albedo),
            Self::WithoutNormals => without(passes, is_normal),
            Self::RandomAlbedo => guides(passes, is_albedo, |planes| {
                let noise = planes.data.iter_mut().enumerate();
                noise.for_each(|(at, v)| *v = hash(at) as f32 / u32::MAX as f32);
            }),
            Self::BrightAlbedo => {
                guides(passes, is_albedo, |planes| planes.data.iter_mut().for_each(|v| *v *= 2.0))
            }
            Self::SrgbAlbedo => {
                guides(passes, is_albedo, |planes| planes.data.iter_mut().for_each(|v| *v = srgb(*v)))
            }
            // Normals of other renderers pass through `to_camera_space` when they are read, so these do too.
            Self::UnitNormals => guides(passes, is_of_camera, |planes| {
                planes.data.iter_mut().for_each(|v| *v = *v / 2.0 + 0.5);
                to_camera_space(planes, None);
            }),
            Self::WorldNormals => guides(passes, is_of_camera, |planes| {
                to_world(planes);
                to_camera_space(planes, None);
            }),
            _ => passes.clone(),
        }
    }

    /// Turns a result for the changed frame back into one for the frame as it was rendered, by undoing the
    /// mirroring or exposure.
    pub fn undo(self, mut image: Planes) -> Planes {
        if self == Self::Mirrored {
            image.data.chunks_mut(image.width).for_each(<[f32]>::reverse);
        }
        let exposure = self.exposure();
        image.data.iter_mut().for_each(|v| *v /= exposure);
        image
    }

    /// The part of an image that the changed frame shows.
    pub fn seen(self, image: &Planes) -> Planes {
        match self {
            Self::Cropped => {
                let (x, y) = (CORNER.0.min(image.width), CORNER.1.min(image.height));
                image.window((x, y), (image.width - x, image.height - y))
            }
            _ => image.clone(),
        }
    }
}

/// Knuth's multiplicative hash.
fn hash(at: usize) -> u32 {
    (at as u32).wrapping_mul(2_654_435_761)
}

/// One pixel in 1024, spread by the hash of its index.
fn is_chosen(pixel: usize) -> bool {
    hash(pixel) >> 22 == 0
}

/// The frame with `change` applied to the passes without radiance that `is_it` chooses.
fn guides(passes: &PassSet, is_it: impl Fn(Pass) -> bool, change: impl Fn(&mut Planes)) -> PassSet {
    passes.map((passes.width, passes.height), |pass, planes| {
        let mut planes = planes.clone();
        if !pass.carries_radiance() && is_it(pass) {
            change(&mut planes);
        }
        planes
    })
}

/// The frame without those passes that carry no radiance and that `is_it` chooses.
fn without(passes: &PassSet, is_it: impl Fn(Pass) -> bool) -> PassSet {
    let mut kept = passes.clone();
    for (pass, _) in passes.iter().filter(|(pass, _)| !pass.carries_radiance() && is_it(*pass)) {
        kept.remove(pass);
    }
    kept
}

fn is_albedo(pass: Pass) -> bool {
    pass.quantity() == Quantity::Colour
}

fn is_normal(pass: Pass) -> bool {
    pass.quantity() == Quantity::Direction
}

/// Whether a pass holds normals in camera space, which other renderers write in other encodings.
fn is_of_camera(pass: Pass) -> bool {
    pass == Pass::DenoisingNormal
}

fn blank(planes: &mut Planes) {
    planes.data.fill(0.0);
}

/// The curve of sRGB (IEC 61966-2-1).
fn srgb(v: f32) -> f32 {
    if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 }
}

/// Turns normals from camera space to that of [`WORLD_AXES`].
fn to_world(normals: &mut Planes) {
    let pixels = normals.pixels();
    for at in 0..pixels {
        let n = [0, 1, 2].map(|c| normals.data[c * pixels + at]);
        for (c, axis) in WORLD_AXES.iter().enumerate() {
            normals.data[c * pixels + at] = axis.iter().zip(n).map(|(axis, n)| axis * n).sum();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame() -> PassSet {
        let mut passes = PassSet::new("test.exr", "ViewLayer", 64, 64);
        for (i, pass) in
            [Pass::Combined, Pass::DenoisingAlbedo, Pass::DenoisingNormal].into_iter().enumerate()
        {
            let values = (0..3 * 64 * 64).map(|v| (v % 61) as f32 / 60.0 + i as f32 / 8.0).collect();
            passes.insert(pass, Planes::from_vec(3, 64, 64, values));
        }
        passes
    }

    /// What a change does to radiance is undone, but for what it adds on purpose.
    #[test]
    fn changes_are_undone() {
        let before = frame();
        let radiance = before.get(Pass::Combined).unwrap();
        for trial in Trial::ALL {
            let after = trial.change(&before);
            let image = trial.undo(after.get(Pass::Combined).unwrap().clone());
            let same = image == trial.seen(radiance);
            assert_eq!(same, !matches!(trial, Trial::Fireflies | Trial::NonFinite), "{}", trial.name());
            let albedo = after.get(Pass::DenoisingAlbedo);
            let kept = albedo == Some(&trial.seen(before.get(Pass::DenoisingAlbedo).unwrap()));
            let changed = matches!(
                trial,
                Trial::Mirrored
                    | Trial::NonFinite
                    | Trial::ShiftedGuides
                    | Trial::BlankGuides
                    | Trial::BlankAlbedo
                    | Trial::WithoutGuides
                    | Trial::WithoutAlbedo
                    | Trial::RandomAlbedo
                    | Trial::BrightAlbedo
                    | Trial::SrgbAlbedo
            );
            assert_eq!(kept, !changed, "{}", trial.name());
        }
    }

    /// Normals as others store them are put right where the values tell how: nearly so where a camera has to
    /// be guessed.
    #[test]
    fn normals_of_other_renderers_are_put_right() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/s0000_room_0004spp.exr");
        let passes = crate::passes::load(path, None).unwrap();
        let normals = |passes: &PassSet| passes.get(Pass::DenoisingNormal).unwrap().clone();
        let before = normals(&passes);
        let off = |trial: Trial| {
            let after = normals(&trial.change(&passes));
            let sum: f32 = after.data.iter().zip(&before.data).map(|(a, b)| (a - b).abs()).sum();
            sum / before.data.len() as f32
        };
        let (unit, world) = (off(Trial::UnitNormals), off(Trial::WorldNormals));
        assert!(unit < 1e-3 && world < 0.3, "{unit}, {world}");
        assert_eq!(off(Trial::BlankAlbedo), 0.0);
        assert!(off(Trial::BlankNormals) > 0.3);
    }

    #[test]
    fn one_pixel_in_1024_is_chosen() {
        let chosen = (0..1 << 20).filter(|&at| is_chosen(at)).count();
        assert!((900..1150).contains(&chosen), "{chosen}");
        assert!((0..64 * 64).any(is_chosen), "small frames have some too");
    }
}
