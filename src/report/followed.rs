//! Flicker is measured between two frames of a sequence. So where another frame of the test set follows one,
//! the methods' results on the first are kept until the second is scored.

use std::{collections::HashMap, path::Path};

use super::{
    Contender, NOISY,
    pair::{Loaded, load},
};
use crate::{
    denoise::follows,
    error::attempt,
    metrics::{
        self,
        flicker::{self, flicker},
    },
    passes::Pass,
    planes::Planes,
    testset::Pair,
};

/// How a note begins that says why there is no flicker.
pub const NO_FLICKER: &str = "no flicker";

/// A frame that another follows, and the methods' results on it.
pub struct Before<'a> {
    pair: &'a Pair,
    pairs: &'a [Pair],
    view_layer: Option<&'a str>,
    reference: Option<Planes>,
    images: HashMap<String, Planes>,
    /// The frame's files as read, where a result had to be made anew.
    loaded: Option<Loaded>,
}

/// The frames that another follows and whose results are kept, by their noisy files.
pub struct Followed<'a> {
    pairs: &'a [Pair],
    view_layer: Option<&'a str>,
    held: HashMap<&'a Path, Before<'a>>,
}

impl<'a> Followed<'a> {
    /// For the pairs of a test set; no results are kept yet.
    pub fn new(pairs: &'a [Pair], view_layer: Option<&'a str>) -> Self {
        Self { pairs, view_layer, held: HashMap::new() }
    }

    /// The test set.
    pub fn pairs(&self) -> &'a [Pair] {
        self.pairs
    }

    /// Keeps a method's result on a frame, if another frame follows it.
    pub fn keep(&mut self, pair: &Pair, reference: &Planes, method: &str, image: &Planes) {
        let Some(own) = self.pairs.iter().find(|other| *other == pair) else { return };
        if !self.pairs.iter().any(|other| is_next(other, pair)) {
            return;
        }
        let (pairs, view_layer) = (self.pairs, self.view_layer);
        let held =
            self.held.entry(own.noisy.as_path()).or_insert_with(|| Before::new(own, pairs, view_layer));
        held.reference.get_or_insert_with(|| reference.clone());
        held.images.insert(method.into(), image.clone());
    }

    /// The frame before that of `pair`, where the test set has it. Ask once for each pair: the results that
    /// were kept are given away.
    pub fn before(&mut self, pair: &Pair) -> Option<Before<'a>> {
        let before = self.pairs.iter().find(|other| is_next(pair, other))?;
        let new = || Before::new(before, self.pairs, self.view_layer);
        Some(self.held.remove(before.noisy.as_path()).unwrap_or_else(new))
    }
}

/// Whether `pair` is the frame right after `before` in the same scene, at the same sample count.
pub fn is_next(pair: &Pair, before: &Pair) -> bool {
    let is_same = (&pair.scene, pair.spp) == (&before.scene, before.spp);
    is_same && follows(&pair.noisy, &before.noisy) && !are_seeds(pair, before)
}

/// Whether two pairs show one frame with other noise, whatever the numbers in their names: without frames of their own,
/// they have one reference.
pub fn are_seeds(pair: &Pair, other: &Pair) -> bool {
    let is_frame = |pair: &Pair| pair.frame.is_some();
    pair.reference == other.reference && !(is_frame(pair) && is_frame(other))
}

impl<'a> Before<'a> {
    fn new(pair: &'a Pair, pairs: &'a [Pair], view_layer: Option<&'a str>) -> Self {
        Self { pair, pairs, view_layer, reference: None, images: HashMap::new(), loaded: None }
    }

    /// The flicker of a method from this frame to `next`, on which its result is `image`; none where no pixel
    /// can be followed.
    ///
    /// # Errors
    /// Why it cannot be measured: `next` has no vectors, this frame cannot be read or denoised, or it is of
    /// another size.
    pub fn flicker(
        &mut self,
        method: &Contender,
        image: &Planes,
        next: &Loaded,
    ) -> Result<Option<f64>, String> {
        let said = |why: &str| format!("{NO_FLICKER}: {why}");
        let Some(vectors) = next.shot.passes.get(Pass::Vector) else {
            return Err(said("the frame has no Vector"));
        };
        if !self.images.contains_key(&method.name) {
            self.make(method).map_err(|why| said(&why))?;
        }
        let before = &self.images[&method.name];
        let reference = self.reference.as_ref().expect("it comes with the images");
        if before.extent() != image.extent() {
            return Err(said("the frame before is of another size"));
        }
        let (images, references) = ([image, before], [&next.reference, reference]);
        Ok(flicker(&flicker::Pair { images, references, vectors }))
    }

    /// Runs a method on this frame, since its row was kept from an earlier run and its image was not.
    fn make(&mut self, method: &Contender) -> Result<(), String> {
        let lost = |why: &dyn std::fmt::Display| format!("of the frame before: {why}");
        if self.loaded.is_none() {
            self.loaded = Some(load(self.pair, self.view_layer).map_err(|e| lost(&e))?);
        }
        let loaded = self.loaded.as_mut().expect("it was loaded above");
        loaded.read_neighbours(method.denoiser.reach(), self.view_layer, (self.pair, self.pairs));
        if method.denoiser.reads_halves() {
            loaded.shot.read_halves().map_err(|e| lost(&e))?;
        }
        let image = match method.name.as_str() {
            NOISY => loaded.noisy().clone(),
            _ => attempt(&self.pair.noisy, || method.denoiser.denoise(&loaded.shot)).map_err(|e| lost(&e))?,
        };
        metrics::check(&image, &loaded.reference).map_err(|why| lost(&why))?;
        self.reference.get_or_insert_with(|| loaded.reference.clone());
        self.images.insert(method.name.clone(), image);
        Ok(())
    }
}
