//! What a render pass means: the one table from renderer channel names to passes.

use std::{collections::BTreeMap, fmt, path::PathBuf};

use crate::{Error, Result, planes::Planes};

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
}

impl Pass {
    /// Channels of the pass.
    pub fn channels(self) -> usize {
        if self == Pass::Alpha { 1 } else { 3 }
    }

    /// Where Blender turns the pass on, as a sentence part.
    pub fn blender_setting(self) -> &'static str {
        todo!("owned by the frame and passes work")
    }
}

impl fmt::Display for Pass {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self:?}")
    }
}

/// The decoded passes of one view layer of one frame, all of one size.
#[derive(Clone, Debug)]
pub struct PassSet {
    /// The file the passes came from, for messages.
    pub path: PathBuf,
    /// The view layer they belong to.
    pub view_layer: String,
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    planes: BTreeMap<Pass, Planes>,
}

impl PassSet {
    /// An empty set.
    pub fn new(path: impl Into<PathBuf>, view_layer: &str, width: usize, height: usize) -> Self {
        Self { path: path.into(), view_layer: view_layer.into(), width, height, planes: BTreeMap::new() }
    }

    /// Adds or replaces a pass.
    ///
    /// # Panics
    /// If the size or the channel count differs from what the set and the pass demand.
    pub fn insert(&mut self, pass: Pass, planes: Planes) {
        assert_eq!(
            (planes.channels, planes.width, planes.height),
            (pass.channels(), self.width, self.height)
        );
        self.planes.insert(pass, planes);
    }

    /// The pass, if the view layer holds it.
    pub fn get(&self, pass: Pass) -> Option<&Planes> {
        self.planes.get(&pass)
    }

    /// The pass, or an error that names file, pass and remedy.
    pub fn require(&self, pass: Pass, needed_by: &str) -> Result<&Planes> {
        self.get(pass).ok_or_else(|| Error::MissingPass {
            path: self.path.clone(),
            view_layer: self.view_layer.clone(),
            pass,
            needed_by: needed_by.into(),
        })
    }

    /// Every pass held.
    pub fn iter(&self) -> impl Iterator<Item = (Pass, &Planes)> {
        self.planes.iter().map(|(p, v)| (*p, v))
    }

    /// Makes every value finite, so that one bad sample cannot spread: a NaN or infinite value takes
    /// the mean of the finite values among its 8 neighbours (0 without one). Returns how many values
    /// each pass had replaced.
    pub fn sanitize(&mut self) -> BTreeMap<Pass, usize> {
        todo!("owned by the frame and passes work")
    }
}
