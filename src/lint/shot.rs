//! What frames of a shot tell together: noise that is the same in all, guides that stand still while things
//! move, and motion that is missing.

use super::{Finding, GUIDES, grain::Grain, shift, unjudged};
use crate::{
    passes::{BLENDER, Pass, PassSet},
    planes::Planes,
};

/// What is kept of a frame to compare the next one with it.
pub struct Trace {
    grain: Option<Grain>,
    /// A hash of each guide's bits, by which guides that are the same bit for bit are told.
    guides: Vec<(Pass, u64)>,
    /// Share of the pixels that move; none without vectors.
    moving: Option<f64>,
    /// The edges of the albedo, where vectors say that nothing moves.
    still: Option<Planes>,
    is_blender: bool,
}

/// A pixel moves where its motion is above this many pixels a frame.
const MOTION: f32 = 1.0;

/// Guides that stand still are of another frame where more than this share of the pixels moves.
const MOVING: f64 = 0.01;

impl Trace {
    /// What is kept of a view layer's passes.
    pub fn of(set: &PassSet) -> Self {
        let hash = |data: &[f32]| {
            data.iter().fold(0xcbf2_9ce4_8422_2325, |hash: u64, v| {
                (hash ^ u64::from(v.to_bits())).wrapping_mul(0x0100_0000_01b3)
            })
        };
        let guides = GUIDES.iter().filter_map(|pass| Some((*pass, hash(&set.get(*pass)?.data))));
        let moving = set.get(Pass::Vector).map(|vectors| {
            let moves = |at: usize| vectors.channel(0)[at].hypot(vectors.channel(1)[at]) > MOTION;
            (0..vectors.pixels()).filter(|at| moves(*at)).count() as f64 / vectors.pixels().max(1) as f64
        });
        let is_still = set.get(Pass::Vector).is_some_and(|vectors| vectors.data.iter().all(|v| *v == 0.0));
        let albedo = set.get(Pass::DenoisingAlbedo).filter(|_| is_still && unjudged(set).is_none());
        Self {
            grain: Grain::of(set),
            guides: guides.collect(),
            moving,
            still: albedo.map(shift::edges_of_guide),
            is_blender: set.renderer.is_blender(),
        }
    }

    /// The findings in a frame that follows `before`, whose file is called `name`.
    pub fn after(&self, before: &Self, name: &str) -> Vec<Finding> {
        let mut findings = Vec::new();
        let is_still = self.moving.is_some_and(|moving| moving <= MOVING);
        findings.extend(
            self.grain
                .as_ref()
                .zip(before.grain.as_ref())
                .and_then(|(own, other)| own.warning(other, name, is_still)),
        );
        for (pass, hash) in &self.guides {
            if self.moving.is_some_and(|moving| moving > MOVING) && before.guides.contains(&(*pass, *hash)) {
                findings.push(Finding::new(
                    "frozen-guide",
                    format!(
                        "{pass} is that of {name}, to the bit, though things move: it is of another frame"
                    ),
                    "render beauty and guides in one go, or check the frame numbers of what was put together",
                ));
            }
        }
        if let [Some(own), Some(other)] = [self, before].map(|trace| trace.still.as_ref())
            && (own.width, own.height) == (other.width, other.height)
            && shift::shift(own, other).0.is_some()
        {
            findings.push(Finding::new(
                "zero-vectors",
                format!("Vector is zero everywhere, though the picture has moved since {name}: with motion blur Blender writes none"),
                "turn off Render Properties > Motion Blur and blur in the compositor, or denoise frame by frame",
            ));
        }
        if self.is_blender && self.moving.is_none() && !self.guides.is_empty() {
            findings.push(Finding::harmless(
                "missing-vectors",
                "Vector is missing, which `demc denoise --temporal` follows from frame to frame",
                format!("{}, and turn off Render Properties > Motion Blur", BLENDER.setting(Pass::Vector)),
            ));
        }
        findings
    }
}
