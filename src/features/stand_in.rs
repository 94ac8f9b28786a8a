//! What stands in the place of a guide that a frame lacks.

use std::borrow::Cow;

use super::PREFILTERED_PASSES;
use crate::{
    passes::{Pass, PassSet},
    planes::Planes,
};

/// The albedo of a surface of which nothing is known. Radiance is divided by the albedo before a network
/// reads it, so a value that most surfaces are near keeps that quotient where the network saw it in training.
const ALBEDO: f32 = 0.5;

/// Of the guides, those that a frame lacks: they are missing, or hold nothing but zeros.
fn lacking(passes: &PassSet) -> Vec<Pass> {
    let is_blank = |planes: &Planes| planes.data.iter().all(|v| *v == 0.0);
    PREFILTERED_PASSES.into_iter().filter(|pass| passes.get(*pass).is_none_or(is_blank)).collect()
}

/// The guide of a frame that has none, (3, H, W): grey albedo, or the zero that Cycles writes for a normal
/// where nothing is hit.
pub fn stand_in(pass: Pass, (width, height): (usize, usize)) -> Planes {
    let value = if pass == Pass::DenoisingAlbedo { ALBEDO } else { 0.0 };
    Planes::from_vec(3, width, height, vec![value; 3 * width * height])
}

/// A frame's passes, with something in the place of each guide that is missing or holds nothing but zeros.
pub fn with_stand_ins(passes: &PassSet) -> Cow<'_, PassSet> {
    let lacking = lacking(passes);
    if lacking.is_empty() {
        return Cow::Borrowed(passes);
    }
    let mut all = passes.clone();
    for pass in lacking {
        all.insert(pass, stand_in(pass, (passes.width, passes.height)));
    }
    Cow::Owned(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_missing_or_blank_is_stood_in_for_and_nothing_else() {
        let of = |value: f32| Planes::from_vec(3, 4, 2, vec![value; 24]);
        let mut passes = PassSet::new("x.exr", "ViewLayer", 4, 2);
        passes.insert(Pass::Combined, of(0.0));
        assert_eq!(lacking(&passes), [Pass::DenoisingAlbedo, Pass::DenoisingNormal]);
        passes.insert(Pass::DenoisingAlbedo, of(0.0));
        passes.insert(Pass::DenoisingNormal, of(0.25));
        assert_eq!(lacking(&passes), [Pass::DenoisingAlbedo]);
        let all = with_stand_ins(&passes);
        assert_eq!(all.get(Pass::DenoisingAlbedo), Some(&of(ALBEDO)));
        assert_eq!(all.get(Pass::DenoisingNormal), Some(&of(0.25)));
        assert_eq!(all.get(Pass::Combined), Some(&of(0.0)));
        passes.insert(Pass::DenoisingAlbedo, of(0.125));
        assert!(matches!(with_stand_ins(&passes), Cow::Borrowed(_)));
    }
}
