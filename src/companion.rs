//! Companions: layers of a frame that are denoised along with its beauty, by what the beauty's network
//! decides.
//!
//! A network that predicts kernels decides from the beauty and its guides which neighbours each pixel is
//! averaged with. Those averages, and all that follows them, are linear in the radiance. So any layer can go
//! the same way: light passes that add up to the beauty add up to the denoised beauty, and alpha keeps
//! fitting the colours it goes with.

use crate::planes::Planes;

/// How far a companion goes the beauty's way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A part of the beauty's light: all that happens to the beauty happens to it, so that parts keep adding
    /// up.
    Light,
    /// A surface's colour. It is divided by the albedo, averaged by the beauty's kernels and multiplied
    /// again, so that texture stays sharp, but gets none of the gains by which light is corrected.
    Colour,
    /// A share, such as alpha: an average by the beauty's kernels alone, so that it stays between the least
    /// and the most of what was rendered. What of it is kept is judged by itself (`filters::coverage`).
    Share,
}

/// A layer that is denoised along with the beauty.
#[derive(Clone, Debug)]
pub struct Companion {
    /// What becomes of it.
    pub kind: Kind,
    /// Noisy before, denoised after: (3, H, W), or (1, H, W).
    pub planes: Planes,
    /// What it was before, while a network denoises it.
    pub rendered: Planes,
}

impl Companion {
    /// A layer as rendered.
    ///
    /// # Panics
    /// If it has neither one nor three channels.
    pub fn new(kind: Kind, planes: Planes) -> Self {
        assert!([1, 3].contains(&planes.channels), "layers have one channel or three");
        Self { kind, planes, rendered: Planes::default() }
    }

    /// Whether it is alpha.
    pub fn is_alpha(&self) -> bool {
        self.kind == Kind::Share && self.planes.channels == 1
    }

    /// Takes it out of its place, where nothing is left.
    pub fn take(&mut self) -> Self {
        let [planes, rendered] = [&mut self.planes, &mut self.rendered].map(std::mem::take);
        Self { kind: self.kind, planes, rendered }
    }

    /// Puts what was made of it in its place.
    pub fn becomes(&mut self, denoised: Planes) {
        self.rendered = std::mem::replace(&mut self.planes, denoised);
    }
}
