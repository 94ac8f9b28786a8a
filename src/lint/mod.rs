//! What ruins a denoise, found in a frame's passes before any work is done.
//!
//! In: the passes of a frame as they are stored, and what the file says of them; or, for a shot, frames one
//! after another. Out: [`Finding`]s, each with a code, a sentence, and the setting that mends it. All
//! functions are pure: nothing is read, repaired or printed here. A rule finds something only where its
//! measure lies well beyond that of sound renders. The docs of the thresholds say what was measured, on 27
//! noisy and 24 clean frames of 13 scenes.

mod edges;
mod grain;
mod light;
mod noise;
mod shift;
mod shot;
mod values;

use std::collections::BTreeSet;

use serde::Serialize;

pub use shot::Trace;

use crate::{
    passes::{POSITION_AOV, Pass, PassSet, Renderer},
    planes::Planes,
};

/// Something that ruins a denoise, or is likely to.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// The kind of finding, for scripts; codes are not renamed.
    pub code: &'static str,
    /// What was found, as a sentence without its end.
    pub message: String,
    /// What mends it; empty where nothing needs to be done.
    pub remedy: String,
    /// Whether it makes results of the built-in models worse; if not, it is good to know.
    pub harms: bool,
}

impl Finding {
    /// A finding of that kind that harms.
    pub fn new(code: &'static str, message: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { code, message: message.into(), remedy: remedy.into(), harms: true }
    }

    /// One that does not.
    pub fn harmless(code: &'static str, message: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { harms: false, ..Self::new(code, message, remedy) }
    }
}

/// What a file says of a frame's passes, apart from their values.
#[derive(Clone, Debug, Default)]
pub struct About {
    /// Passes stored as half floats.
    pub half: BTreeSet<Pass>,
    /// Whether Position is a mean over samples, and not Cycles' own pass, which holds the first sample.
    pub position_averaged: bool,
    /// Whether the file says that demc denoised this view layer.
    pub denoised_by_demc: bool,
    /// The compression of Combined, where that loses something.
    pub lossy: Option<&'static str>,
    /// The colour space that the file names, as OpenEXR, Blender or OpenImageIO write it.
    pub colour_space: Option<String>,
    /// The passes that are missing for the model that is used by default.
    pub missing: Vec<Pass>,
    /// The name of that model.
    pub model: String,
}

/// The findings in a single frame.
pub fn frame(set: &PassSet, about: &About) -> Vec<Finding> {
    let mut findings = Vec::new();
    missing(set.renderer, about, &mut findings);
    denoised_by_blender(set, &mut findings);
    position(set, about, &mut findings);
    values::check(set, about, &mut findings);
    if unjudged(set).is_some() {
        return findings;
    }
    let Some(render) = render(set) else { return findings };
    let light = light::sums(render);
    noise::check(set, about, render, &light, &mut findings);
    // Shifted guides tell nothing of the beauty's edges.
    let fit = shift::check(set, &light, &mut findings);
    edges::check(set, render, fit.map(|fit| (&light, fit)), &mut findings);
    noise::clamped(set, render, &light, &mut findings);
    if !set.renderer.is_blender() {
        let blender_s = findings.iter_mut().filter(|finding| finding.remedy.contains(" Properties > "));
        blender_s.for_each(|finding| finding.remedy.insert_str(0, "as Blender calls it: "));
    }
    findings
}

/// Why a frame is not judged as a picture: single values are looked at alone.
pub fn unjudged(set: &PassSet) -> Option<String> {
    (set.width < LEAST_SIZE || set.height < LEAST_SIZE)
        .then(|| format!("not judged as a picture: less than {LEAST_SIZE} pixels wide or high"))
}

/// The least width and height of a frame that is judged as a picture: smaller ones show too few edges and too
/// little noise. Of 252 sound crops of 128x128 pixels, some 30 would be warned of.
const LEAST_SIZE: usize = 160;

/// The noisy render: Noisy Image, which Blender keeps where it denoised Combined itself, or else Combined.
fn render(set: &PassSet) -> Option<&Planes> {
    set.get(Pass::NoisyImage).or_else(|| set.get(Pass::Combined))
}

/// The passes that tell a model what surfaces look like. Both are averaged over samples.
const GUIDES: [Pass; 2] = [Pass::DenoisingAlbedo, Pass::DenoisingNormal];

fn missing(renderer: &Renderer, about: &About, findings: &mut Vec<Finding>) {
    for pass in &about.missing {
        let message = format!("{pass} is missing, without which {} loses detail", about.model);
        findings.push(Finding::new("missing-pass", message, renderer.setting(*pass)));
    }
}

fn denoised_by_blender(set: &PassSet, findings: &mut Vec<Finding>) {
    if set.get(Pass::NoisyImage).is_some() {
        findings.push(Finding::harmless(
            "already-denoised",
            "Combined was already denoised by Blender; demc uses the Noisy Image pass instead",
            "turn off Render Properties > Sampling > Render > Denoise to save the time",
        ));
    }
}

fn position(set: &PassSet, about: &About, findings: &mut Vec<Finding>) {
    if set.renderer.is_blender() && set.get(Pass::Position).is_some() && !about.position_averaged {
        findings.push(Finding::harmless(
            "aliased-position",
            "Position is Cycles' own pass, one sample a pixel: aliased, and wrong under depth of field and motion blur \
             (models that read no Position, as the built-in ones, are as good)",
            format!(
                "a shader AOV named '{POSITION_AOV}' (blender_scripts/export_passes.py sets it up) is averaged over samples"
            ),
        ));
    }
}
