//! A model with the frames before and after one, as a method among others: what a sequence is scored by.
//!
//! In: a [`Shot`] with its neighbours. Out: what [`super::Batch`] makes of the frame with
//! [`super::Options::temporal`].

use super::{
    Alpha,
    window::{Candidates, PASSES, Window},
};
use crate::{Result, models::Denoiser, passes::Pass, planes::Planes, shot::Shot};

/// What its name ends in.
pub const SUFFIX: &str = ":temporal";

/// A model that takes neighbours together with a frame.
pub struct Temporal {
    name: String,
    model: Box<dyn Denoiser>,
    reach: usize,
    optional: Vec<Pass>,
}

impl Temporal {
    /// With so many frames before and after.
    pub fn new(model: Box<dyn Denoiser>, reach: usize) -> Self {
        let known = [model.passes(), model.optional_passes()].concat();
        let wanted = PASSES.into_iter().filter(|pass| !known.contains(pass));
        let optional = model.optional_passes().iter().copied().chain(wanted).collect();
        Self { name: format!("{}{SUFFIX}", model.name()), model, reach, optional }
    }

    /// A window around a frame with the neighbours that the shot has.
    fn window(&self, shot: &Shot) -> Window<'_> {
        let mut window = Window::new(self.reach, &*self.model, (None, Alpha::Auto));
        let reach = i32::try_from(self.reach).unwrap_or(i32::MAX);
        for (&offset, passes) in shot.neighbours.range(-reach..=reach) {
            window.enter_shot(offset.into(), Shot::new(passes.clone()));
        }
        let mut own = Shot::new(shot.passes.clone());
        (own.halves, own.wraps) = (shot.halves.clone(), shot.wraps);
        window.enter_shot(0, own);
        window
    }

    /// What training of the weights of neighbours learns from.
    ///
    /// # Errors
    /// The model cannot denoise a frame.
    pub fn candidates(&self, shot: &Shot) -> Result<Candidates> {
        self.window(shot).candidates(0)
    }
}

impl Denoiser for Temporal {
    fn name(&self) -> &str {
        &self.name
    }

    fn passes(&self) -> &[Pass] {
        self.model.passes()
    }

    fn optional_passes(&self) -> &[Pass] {
        &self.optional
    }

    fn reads_halves(&self) -> bool {
        self.model.reads_halves()
    }

    fn reach(&self) -> usize {
        self.reach
    }

    fn notes(&self, shot: &Shot) -> Option<String> {
        self.model.notes(shot)
    }

    fn denoise(&self, shot: &Shot) -> Result<Planes> {
        self.window(shot).denoise_shot(0)
    }

    fn is_warm(&self) -> bool {
        self.model.is_warm()
    }
}
