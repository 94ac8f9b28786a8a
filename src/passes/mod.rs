//! What a render pass means: the one table from renderer channel names to passes, and the decoded
//! passes of one view layer.
//!
//! In: a [`Frame`]. Out: a [`PassSet`] of f32 planes. Nothing is scaled or
//! clamped here; `features` decides what a network sees.

mod channels;
mod layers;
mod mapping;
mod names;
mod normals;
mod sanitize;

use std::{
    collections::BTreeMap,
    fmt,
    ops::Range,
    path::{Path, PathBuf},
};

pub use layers::{
    COMPOSITE, Layer, PassChannels, choose, choose_like, layers, layers_by, layers_of, read, read_layer,
    read_light_groups, rgb_layers, told_samples,
};
pub use mapping::Mapping;
pub use names::{BLENDER, COMBINED, NOISY_IMAGE, POSITION_AOV, RENDERERS, Renderer, is_bare};
pub(crate) use names::{is_alike, light_group};
pub use normals::{Change, Turn, to_camera_space};

use crate::{Error, Result, frame::Frame, planes::Planes};

/// A render pass that demc knows by meaning.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Pass {
    /// Noisy radiance, RGB.
    Combined,
    /// Coverage of Combined, one channel.
    Alpha,
    /// World-space shading normal, XYZ.
    Normal,
    /// World position, XYZ: averaged over samples where a shader AOV holds it, else Cycles' own pass.
    Position,
    /// Colour of diffuse reflection at the first hit, RGB.
    DiffuseColor,
    /// Colour of glossy reflection at the first hit, RGB.
    GlossyColor,
    /// Colour of transmission at the first hit, RGB.
    TransmissionColor,
    /// Camera-space normal carried through mirrors and glass, XYZ.
    DenoisingNormal,
    /// Albedo carried through mirrors and glass, RGB.
    DenoisingAlbedo,
    /// Distance along the ray carried through mirrors and glass, one channel.
    DenoisingDepth,
    /// The radiance before Blender denoised Combined itself, RGB.
    NoisyImage,
    /// Light off diffuse surfaces straight from lights, divided by the diffuse colour, RGB.
    DiffuseDirect,
    /// Light off diffuse surfaces after further bounces, divided by the diffuse colour, RGB.
    DiffuseIndirect,
    /// As [`Pass::DiffuseDirect`], off glossy surfaces, RGB.
    GlossyDirect,
    /// As [`Pass::DiffuseIndirect`], off glossy surfaces, RGB.
    GlossyIndirect,
    /// As [`Pass::DiffuseDirect`], through transmissive surfaces, RGB.
    TransmissionDirect,
    /// As [`Pass::DiffuseIndirect`], through transmissive surfaces, RGB.
    TransmissionIndirect,
    /// Light scattered once in volumes, RGB.
    VolumeDirect,
    /// Light scattered several times in volumes, RGB.
    VolumeIndirect,
    /// Light emitted by surfaces seen directly, RGB.
    Emission,
    /// Background seen directly, RGB.
    Environment,
    /// What shadow catchers leave of the light behind them: 1 without shadow, RGB.
    ShadowCatcher,
    /// How open the surroundings of a surface are, from 0 to 1, RGB.
    AmbientOcclusion,
    /// Distance from the camera of the first sample, one channel; 1e10 where nothing is hit.
    Depth,
    /// Motion to the previous (XY) and next (ZW) frame in pixels, four channels.
    Vector,
}

/// What a pass is a quantity of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// Light, RGB: it scales with the light in the scene.
    Radiance,
    /// What a surface leaves of light, RGB, most of it in 0..1.
    Colour,
    /// A direction, XYZ.
    Direction,
    /// A place, XYZ.
    Place,
    /// A length.
    Distance,
    /// A share of a pixel, 0 to 1.
    Share,
    /// Motion in the picture: XY and ZW.
    Motion,
}

impl Pass {
    /// Every pass.
    pub const ALL: [Pass; 25] = [
        Pass::Combined,
        Pass::Alpha,
        Pass::Normal,
        Pass::Position,
        Pass::DiffuseColor,
        Pass::GlossyColor,
        Pass::TransmissionColor,
        Pass::DenoisingNormal,
        Pass::DenoisingAlbedo,
        Pass::DenoisingDepth,
        Pass::NoisyImage,
        Pass::DiffuseDirect,
        Pass::DiffuseIndirect,
        Pass::GlossyDirect,
        Pass::GlossyIndirect,
        Pass::TransmissionDirect,
        Pass::TransmissionIndirect,
        Pass::VolumeDirect,
        Pass::VolumeIndirect,
        Pass::Emission,
        Pass::Environment,
        Pass::ShadowCatcher,
        Pass::AmbientOcclusion,
        Pass::Depth,
        Pass::Vector,
    ];

    /// What the pass is a quantity of, which decides its other properties.
    pub fn quantity(self) -> Quantity {
        use Pass::*;
        match self {
            Combined | NoisyImage | DiffuseDirect | DiffuseIndirect | GlossyDirect | GlossyIndirect
            | TransmissionDirect | TransmissionIndirect | VolumeDirect | VolumeIndirect | Emission
            | Environment => Quantity::Radiance,
            DiffuseColor | GlossyColor | TransmissionColor | DenoisingAlbedo | ShadowCatcher
            | AmbientOcclusion => Quantity::Colour,
            Normal | DenoisingNormal => Quantity::Direction,
            Position => Quantity::Place,
            Depth | DenoisingDepth => Quantity::Distance,
            Alpha => Quantity::Share,
            Vector => Quantity::Motion,
        }
    }

    /// Channels of the pass.
    pub fn channels(self) -> usize {
        match self.quantity() {
            Quantity::Share | Quantity::Distance => 1,
            Quantity::Motion => 4,
            _ => 3,
        }
    }

    /// Whether the pass scales with the light in the scene.
    pub fn carries_radiance(self) -> bool {
        self.quantity() == Quantity::Radiance
    }

    /// Names under which Blender has written the pass, the current one first.
    pub fn blender_names(self) -> &'static [&'static str] {
        BLENDER.row(self).expect("Blender has every pass").names
    }
}

impl fmt::Display for Pass {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Pass::Alpha => "Alpha",
            Pass::Position => "Position",
            other => other.blender_names()[0],
        })
    }
}

/// The decoded passes of one view layer of one frame, all of one size.
#[derive(Clone, Debug)]
pub struct PassSet {
    /// The file the passes came from, for messages.
    pub path: PathBuf,
    /// The view layer they belong to.
    pub view_layer: String,
    /// Its stereo view, where the file has views.
    pub view: Option<String>,
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Where the first pixel lies in the coordinates of the display window: other than 0, 0 in cropped
    /// renders.
    pub origin: (i32, i32),
    /// Samples of a pixel, or the most that it may have had, where the file tells.
    pub samples: Option<u32>,
    /// The renderer that wrote it, as far as its names tell; messages name that renderer's settings.
    pub renderer: &'static Renderer,
    planes: BTreeMap<Pass, Planes>,
}

/// Least share of the pixels along the edge of a part of a frame that must hold something for the part to be
/// a rendered region.
const FILLED: f64 = 0.9;

impl PassSet {
    /// Whether another set has the same passes with the same values.
    pub fn holds_the_same(&self, other: &Self) -> bool {
        self.planes == other.planes
    }

    /// An empty set.
    pub fn new(path: impl Into<PathBuf>, view_layer: &str, width: usize, height: usize) -> Self {
        let (path, view_layer) = (path.into(), view_layer.into());
        let (view, origin, samples, renderer) = (None, (0, 0), None, &BLENDER);
        Self { path, view_layer, view, width, height, origin, samples, renderer, planes: BTreeMap::new() }
    }

    /// A set without passes, of another size, that tells the same facts of the render.
    pub fn empty(&self, (width, height): (usize, usize)) -> Self {
        Self {
            view: self.view.clone(),
            samples: self.samples,
            renderer: self.renderer,
            ..Self::new(&self.path, &self.view_layer, width, height)
        }
    }

    /// A rectangle of pixels of every pass, from column `x` and row `y`.
    ///
    /// # Panics
    /// If it leaves the frame.
    pub fn window(&self, (x, y): (usize, usize), size: (usize, usize)) -> Self {
        self.map(size, |_, planes| planes.window((x, y), size))
    }

    /// Some columns of every pass.
    ///
    /// # Panics
    /// If there are no such columns.
    pub fn columns(self, columns: Range<usize>) -> Self {
        if columns == (0..self.width) {
            return self;
        }
        self.window((columns.start, 0), (columns.len(), self.height))
    }

    /// Some rows of those of `passes` that it holds, grown to a width and height as [`Planes::padded_to`]
    /// does.
    ///
    /// # Panics
    /// As [`Planes::padded_rows`].
    pub fn padded_rows(&self, passes: &[Pass], rows: Range<usize>, (width, height): (usize, usize)) -> Self {
        let mut part = self.empty((width, height));
        for (&pass, planes) in self.planes.iter().filter(|(pass, _)| passes.contains(pass)) {
            part.insert(pass, planes.padded_rows(rows.clone(), (width, height)));
        }
        part
    }

    /// A set of a new size, in which each pass is what `change` makes of it.
    ///
    /// # Panics
    /// If a result has another size or channel count.
    pub fn map(&self, (width, height): (usize, usize), change: impl Fn(Pass, &Planes) -> Planes) -> Self {
        let mut changed = self.empty((width, height));
        self.iter().for_each(|(pass, planes)| changed.insert(pass, change(pass, planes)));
        changed
    }

    /// Adds or replaces a pass.
    ///
    /// # Panics
    /// If the size or the channel count differs from what the set and the pass demand.
    pub fn insert(&mut self, pass: Pass, planes: Planes) {
        assert_eq!(planes.extent(), (pass.channels(), self.width, self.height));
        self.planes.insert(pass, planes);
    }

    /// Takes a pass out of the set.
    pub fn remove(&mut self, pass: Pass) -> Option<Planes> {
        self.planes.remove(&pass)
    }

    /// The pass, if the view layer holds it.
    pub fn get(&self, pass: Pass) -> Option<&Planes> {
        self.planes.get(&pass)
    }

    /// The pass, or an error that names file, pass and remedy.
    pub fn require(&self, pass: Pass, needed_by: &str) -> Result<&Planes> {
        self.get(pass).ok_or_else(|| self.missing(vec![pass], needed_by))
    }

    /// Whether all of these passes are there.
    ///
    /// # Errors
    /// Some are missing; all of them are named, each with its remedy.
    pub fn require_all(&self, passes: impl IntoIterator<Item = Pass>, needed_by: &str) -> Result<()> {
        let missing: Vec<Pass> = passes.into_iter().filter(|pass| self.get(*pass).is_none()).collect();
        if missing.is_empty() { Ok(()) } else { Err(self.missing(missing, needed_by)) }
    }

    fn missing(&self, passes: Vec<Pass>, needed_by: &str) -> Error {
        Error::MissingPass {
            path: self.path.clone(),
            view_layer: self.view_layer.clone(),
            renderer: self.renderer,
            passes,
            needed_by: needed_by.into(),
        }
    }

    /// Whether the pixels of `other` are those of this frame: as many, at the same place of the display window.
    /// `what` it is to this frame, such as "its reference".
    ///
    /// # Errors
    /// They are not.
    pub fn check_same_pixels(&self, other: &PassSet, what: &str) -> Result<()> {
        let place = |set: &PassSet| (set.width, set.height, set.origin);
        if place(self) == place(other) {
            return Ok(());
        }
        let said = |set: &PassSet| {
            let PassSet { width, height, origin: (x, y), .. } = set;
            format!("{width}x{height} pixels at {x},{y}")
        };
        let (own, path, of_other) = (said(self), other.path.display(), said(other));
        let why = format!("holds {own}, {what} {path} {of_other}; render both at one size and region");
        Err(Error::invalid(&self.path, why))
    }

    /// Every pass held.
    pub fn iter(&self) -> impl Iterator<Item = (Pass, &Planes)> {
        self.planes.iter().map(|(p, v)| (*p, v))
    }

    /// Column and row, width and height of the part of a frame that was rendered. Where only a region was
    /// rendered, all else is zero in every pass. That is no black wall, since what lies beyond a region is
    /// unknown. Things before a transparent background also fill a part of the frame, but not all along the edges
    /// of that part; such a frame is taken whole.
    pub fn rendered(&self) -> ((usize, usize), (usize, usize)) {
        let (width, height) = (self.width, self.height);
        let whole = ((0, 0), (width, height));
        let is_filled = |x: usize, y: usize| {
            self.iter()
                .any(|(_, planes)| (0..planes.channels).any(|c| planes.channel(c)[y * width + x] != 0.0))
        };
        let row_is_filled = |y: &usize| (0..width).any(|x| is_filled(x, *y));
        let Some(top) = (0..height).find(row_is_filled) else { return whole };
        let bottom = (top..height).rfind(row_is_filled).expect("the first such row is one");
        let column_is_filled = |x: &usize| (top..=bottom).any(|y| is_filled(*x, y));
        let left = (0..width).find(column_is_filled).expect("some row holds something");
        let right = (left..width).rfind(column_is_filled).expect("the first such column is one");
        let (columns, rows) = (right + 1 - left, bottom + 1 - top);
        if (columns, rows) == (width, height) {
            return whole;
        }
        let level = (left..=right).flat_map(|x| [(x, top), (x, bottom)]);
        let upright = (top..=bottom).flat_map(|y| [(left, y), (right, y)]);
        let filled = level.chain(upright).filter(|&(x, y)| is_filled(x, y)).count();
        if filled as f64 >= FILLED * (2 * (columns + rows)) as f64 {
            ((left, top), (columns, rows))
        } else {
            whole
        }
    }

    /// Puts `Noisy Image` in the place of Combined: where Blender denoised the render itself, Combined is the
    /// result and `Noisy Image` the render. Returns whether there was one.
    pub fn use_noisy_image(&mut self) -> bool {
        match self.planes.remove(&Pass::NoisyImage) {
            Some(noisy) => {
                self.planes.insert(Pass::Combined, noisy);
                true
            }
            None => false,
        }
    }
}

/// Reads a file and the passes of one view layer: the one named, the only one, or else the one with
/// the most recognised passes. Stereo files give their first view.
///
/// # Errors
/// The file is unusable, or has no such view layer.
pub fn load(path: impl AsRef<Path>, view_layer: Option<&str>) -> Result<PassSet> {
    read(&Frame::read(path)?, view_layer)
}

/// Reads a file and the passes of the view layer that is to be compared with another file's, see [`choose_like`].
///
/// # Errors
/// The file is unusable, or has no such view layer.
pub fn load_like(path: impl AsRef<Path>, other: &PassSet) -> Result<PassSet> {
    let frame = Frame::read(path)?;
    let layers = layers(&frame);
    let layer = choose_like(&frame, &layers, &other.view_layer, other.view.as_deref())?;
    read_layer(&frame, layer, &Pass::ALL)
}
