//! What single values tell: NaN, overflow, blank guides, albedo above one, pixels encoded for a display.

use super::{About, Finding, GUIDES, light::median, render};
use crate::{
    frame::HALF_MAX,
    passes::{Pass, PassSet},
    planes::Planes,
};

/// Passes that are never zero everywhere in a frame that shows anything. Other passes rightly are where a
/// scene has no glass, no volume or no lamp in view.
const NEVER_ZERO: [Pass; 6] = [
    Pass::Combined,
    Pass::Normal,
    Pass::Position,
    Pass::DenoisingNormal,
    Pass::DenoisingAlbedo,
    Pass::NoisyImage,
];

/// How far the albedo may be from the light, as a share of itself, where it is that of the sky or of lamps.
const SAME: f32 = 0.05;

/// Where fewer values than this share are below zero, and none by more than [`TRACE`] of the median light, they are a
/// trace that rounding left.
const NEGATIVE_SHARE: f64 = 1e-5;

/// See [`NEGATIVE_SHARE`].
const TRACE: f32 = 1e-3;

/// A guide whose values differ by no more than this counts as constant; half floats near 1 are 0.0005 apart.
const CONSTANT: f32 = 0.001;

/// Albedo above this is more than rounding. Cycles adds the light that lamps and screens send to their
/// albedo, and the render holds at least as much of it, so that only what the albedo has more than the render
/// is the surface's own.
const ABOVE_ONE: f32 = 1.02;

/// Albedo from this on is taken for a lamp's, whose light fog may hide in the render.
const LAMP: f32 = 4.0;

/// Neighbours on a plain surface differ by less than this share of their value. Only such pixels are judged,
/// since albedo may have any value at the rims of lamps.
const PLAIN: f32 = 0.05;

/// The share of all pixels whose albedo must be above one.
const ABOVE_SHARE: f64 = 0.002;

/// How far a value may be from a multiple of 1/255, in 255ths. All 8-bit values are as near as this to one,
/// and of other values 1 in 7 by chance.
const NEAR_STEP: f32 = 0.07;

/// The fewest values other than 0 and 1 to judge by.
const STEPS: usize = 1000;

/// The fewest different steps among them: a few plain colours may lie near steps by chance.
const LEVELS: usize = 16;

pub fn check(set: &PassSet, about: &About, findings: &mut Vec<Finding>) {
    for (pass, planes) in set.iter() {
        single_values(set, pass, planes, about, findings);
        if GUIDES.contains(&pass) && !shows_light_alone(set) {
            constant(pass, planes, findings);
        }
    }
    albedo_above_one(set, findings);
    wrong_passes(set, findings);
    if !display_space(about, findings) {
        eight_bits(set, findings);
    }
}

/// Whether the albedo equals the light in every pixel, as that of the sky and of lamps does in Cycles: no surface is seen.
fn shows_light_alone(set: &PassSet) -> bool {
    let (Some(albedo), Some(render)) = (set.get(Pass::DenoisingAlbedo), render(set)) else { return false };
    albedo.data.iter().zip(&render.data).all(|(shown, light)| (shown - light).abs() <= SAME * shown.abs())
}

/// Whether a pass may be zero everywhere because there is nothing to be seen: on a transparent film, in the dark, and
/// where the sky alone is in view, which has neither normal nor position.
fn may_be_empty(set: &PassSet, pass: Pass) -> bool {
    let is_zero = |pass: Pass| set.get(pass).is_some_and(|planes| planes.data.iter().all(|v| *v == 0.0));
    if is_zero(Pass::Alpha) {
        return true;
    }
    match pass {
        // Guides that show something tell of a beauty that is lost.
        Pass::Combined => NEVER_ZERO.iter().all(|pass| set.get(*pass).is_none() || is_zero(*pass)),
        _ if is_zero(Pass::Combined) => true,
        Pass::Normal | Pass::DenoisingNormal | Pass::Position => shows_light_alone(set),
        _ => false,
    }
}

fn single_values(set: &PassSet, pass: Pass, planes: &Planes, about: &About, findings: &mut Vec<Finding>) {
    let count = |is: &dyn Fn(f32) -> bool| planes.data.iter().filter(|v| is(**v)).count();
    // Where nothing is hit there is no depth, which is infinite as a half float.
    let may_be_infinite = matches!(pass, Pass::Depth | Pass::DenoisingDepth);
    let is_well = |v: f32| v.is_finite() || (may_be_infinite && v == f32::INFINITY);
    let is_over = |v: f32| v.is_infinite() || v.abs() == HALF_MAX;
    let can_overflow = about.half.contains(&pass) && pass.carries_radiance();
    let bad = count(&|v| !(is_well(v) || can_overflow && is_over(v)));
    let of = planes.data.len();
    if bad > 0 {
        findings.push(Finding::new(
            "not-finite",
            format!("{pass}: {bad} of {of} values are NaN or infinite"),
            "`demc denoise` works with values filled in from around them; a material or lamp that divides by zero makes NaN",
        ));
    }
    let over = if can_overflow { count(&is_over) } else { 0 };
    if over > 0 {
        findings.push(Finding::new(
            "half-overflow",
            format!("{pass}: {over} of {of} values are beyond what a half float holds ({HALF_MAX})"),
            "set Output Properties > Output > Color Depth to Float (Full)",
        ));
    }
    if NEVER_ZERO.contains(&pass) && count(&|v| v != 0.0) == 0 && !may_be_empty(set, pass) {
        findings.push(Finding::new(
            "empty-pass",
            format!("{pass} is zero everywhere: an empty render, or a pass that was not written"),
            set.renderer.setting(pass),
        ));
    }
    let negative = count(&|v| v < 0.0);
    let is_trace = || {
        let mut lit: Vec<f32> = planes.data.iter().copied().filter(|v| *v > 0.0).collect();
        let least = -TRACE * median(&mut lit).unwrap_or(0.0);
        (negative as f64) < NEGATIVE_SHARE * of as f64 && count(&|v| v < least) == 0
    };
    if negative > 0 && matches!(pass, Pass::Combined | Pass::NoisyImage) && !is_trace() {
        let message =
            format!("{pass}: {negative} negative values, which no light makes; models read them as 0");
        findings.push(match about.lossy {
            Some(lossy) => Finding::new(
                "negative-light",
                format!("{message} (the lossy compression {} makes such values)", lossy.to_uppercase()),
                "set Output Properties > Output > Codec to ZIP",
            ),
            None => Finding::new(
                "negative-light",
                message,
                "render without filters of negative lobes, and check materials and lamps for negative colours",
            ),
        });
    }
}

fn constant(pass: Pass, planes: &Planes, findings: &mut Vec<Finding>) {
    let is_constant = |c: usize| {
        let (low, high) = planes
            .channel(c)
            .iter()
            .fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)));
        // Where all are NaN, there is neither.
        low <= high && high - low <= CONSTANT
    };
    let is_blank = planes.data.iter().all(|v| *v == 0.0);
    if planes.pixels() > 1 && !is_blank && (0..planes.channels).all(is_constant) {
        let length = (0..planes.channels).map(|c| planes.channel(c)[0].powi(2)).sum::<f32>().sqrt();
        findings.push(if pass == Pass::DenoisingNormal && UNIT.contains(&length) {
            Finding::harmless(
                "constant-guide",
                format!("{pass} is the same everywhere, as of one flat surface: it guides nothing"),
                "",
            )
        } else {
            Finding::new(
                "constant-guide",
                format!(
                    "{pass} is the same everywhere: it guides nothing, and edges that it hides are blurred"
                ),
                "render without a material override, and store the pass as the renderer wrote it",
            )
        });
    }
}

fn albedo_above_one(set: &PassSet, findings: &mut Vec<Finding>) {
    let (Some(albedo), Some(render)) = (set.get(Pass::DenoisingAlbedo), render(set)) else { return };
    let width = albedo.width;
    let is_above = |at: usize| {
        (0..3).any(|c| {
            let (plane, light) = (albedo.channel(c), render.channel(c)[at]);
            let own = plane[at];
            let is_alike = |other: usize| (plane[other] - own).abs() < PLAIN * own;
            (ABOVE_ONE..LAMP).contains(&own)
                && own - light.max(0.0) > ABOVE_ONE
                && [at - width, at - 1, at + 1, at + width].into_iter().all(is_alike)
        })
    };
    let pixels = albedo.pixels();
    let above = (width..pixels.saturating_sub(width)).filter(|at| is_above(*at)).count();
    if above as f64 > ABOVE_SHARE * pixels as f64 {
        findings.push(Finding::new(
            "albedo-above-one",
            format!(
                "Denoising Albedo is above one on surfaces that do not shine ({above} of {pixels} pixels): no surface \
                 reflects more light than it gets"
            ),
            "keep colours of materials at or below 1, and their sum where shaders are added",
        ));
    }
}

/// The values that an albedo has none below, nor a colour, while normals to the left or down have.
const BELOW_ZERO: f32 = -0.05;

/// The share of an albedo's pixels that must be below that.
const BELOW_SHARE: f64 = 0.01;

/// Lengths of normals as they are stored; means over edges are shorter.
const UNIT: std::ops::RangeInclusive<f32> = 0.9..=1.1;

/// Pixels that a normal must have to judge by.
const NORMALS: usize = 1000;

/// Passes that hold what another one should: a typing error in a mapping, or layers that were swapped.
fn wrong_passes(set: &PassSet, findings: &mut Vec<Finding>) {
    let remedy = "check which layers --map, or the program that wrote the file, takes for albedo and normal";
    let values = |planes: &Planes, at: usize| [0, 1, 2].map(|c| planes.channel(c)[at]);
    if let Some(albedo) = set.get(Pass::DenoisingAlbedo) {
        let is_below = |at: &usize| values(albedo, *at).iter().any(|v| *v < BELOW_ZERO);
        let below = (0..albedo.pixels()).filter(is_below).count();
        if below as f64 > BELOW_SHARE * albedo.pixels() as f64 {
            let message = format!(
                "Denoising Albedo is below zero in {below} of {} pixels, as normals are and no colour is",
                albedo.pixels()
            );
            findings.push(Finding::new("wrong-pass", message, remedy));
        }
    }
    if let Some(normal) = set.get(Pass::DenoisingNormal) {
        let held = || (0..normal.pixels()).map(|at| values(normal, at)).filter(|n| *n != [0.0; 3]);
        let length = |n: [f32; 3]| n.iter().map(|v| v * v).sum::<f32>().sqrt();
        // Some renderers store them in 0 to 1.
        let is_unit =
            |n: [f32; 3]| UNIT.contains(&length(n)) || UNIT.contains(&length(n.map(|v| 2.0 * v - 1.0)));
        let count = held().count();
        let is_colour = count >= NORMALS
            && held().all(|n| n.iter().all(|v| *v >= BELOW_ZERO))
            && held().filter(|n| !is_unit(*n)).count() > count / 2;
        if is_colour {
            let message = "Denoising Normal has no direction: no value is below zero and lengths are not 1, as of a colour";
            findings.push(Finding::new("wrong-pass", message, remedy));
        }
    }
}

/// Whether the file itself says that it is not linear.
fn display_space(about: &About, findings: &mut Vec<Finding>) -> bool {
    let Some(space) = &about.colour_space else { return false };
    let name = space.to_ascii_lowercase();
    let is_encoded = ["srgb", "g18_", "g22_", "g24_", "g26_", "gamma", "pq_", "hlg_"]
        .iter()
        .any(|beginning| name.starts_with(beginning));
    if is_encoded {
        findings.push(Finding::new(
            "display-pixels",
            format!("the file says that its pixels are encoded for a display ('{space}'); light adds up in linear ones alone"),
            LINEAR,
        ));
    }
    is_encoded
}

/// How a file comes to hold linear pixels.
pub(super) const LINEAR: &str = "save the render as OpenEXR MultiLayer with Output Properties > Output > Color Management > Follow \
                                 Scene, without a Convert Colorspace node or a conversion from PNG or JPEG";

/// Pixels that were stored in 8 bits before.
fn eight_bits(set: &PassSet, findings: &mut Vec<Finding>) {
    let Some(render) = render(set) else { return };
    let (mut steps, mut seen) = (0, [false; 256]);
    for v in render.data.iter().filter(|v| **v != 0.0 && **v != 1.0) {
        let scaled = v * 255.0;
        if !(0.0..255.5).contains(&scaled) || (scaled - scaled.round()).abs() > NEAR_STEP.max(scaled * 3e-4) {
            return;
        }
        // In a dark frame all values may lie near the step 0.
        if scaled >= 0.5 {
            steps += 1;
            seen[scaled.round() as usize] = true;
        }
    }
    if steps >= STEPS && seen.iter().filter(|seen| **seen).count() >= LEVELS {
        findings.push(Finding::new(
            "eight-bit-pixels",
            "all values of the beauty are multiples of 1/255: they went through an 8-bit file, which is not linear",
            LINEAR,
        ));
    }
}
