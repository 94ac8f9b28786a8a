//! What the noise of a render tells: whether it was removed already, spread over pixels, or clamped.
//!
//! In a path tracer that draws samples according to its pixel filter, as Cycles does, each sample belongs to
//! one pixel, so noise is independent from pixel to pixel. On a plain surface, a pixel then differs from the
//! mean of the four next to it as much as from that of the four two pixels away. After a denoiser, a filter
//! that spreads samples over pixels, or a resize, it differs less from the nearer four.

use rayon::prelude::*;

use super::{
    About, Finding,
    light::{lit_surfaces, logarithms, median, quantile},
    values::LINEAR,
};
use crate::{passes::PassSet, planes::Planes};

/// Side in pixels of the squares that are judged one by one, since much of a frame may rightly show no noise.
const SQUARE: usize = 32;

/// Pixels of plain surfaces that a square needs.
const PIXELS: usize = 100;

/// Squares that a frame needs.
const SQUARES: usize = 12;

/// A frame is judged by the ratio below which this share of its squares lies, so that independent noise in a
/// quarter of them clears it.
const MOST: f32 = 0.75;

/// The ratio below which a frame's noise is not independent. With independent noise the ratio is 1 in theory,
/// and [`MOST`] of the squares lie below 0.96 to 1.14 (24 frames, 4 to 4096 samples). In frames that Blender
/// denoised they lie below 0.70, and after spreading over pixels by a Gaussian of half a pixel below 0.66 to
/// 0.88.
const ALIKE: f32 = 0.88;

/// Relative difference of neighbours below which noise was removed, and not merely spread. It is 0.001 after
/// denoising, and 0.01 to 0.5 in noise of 4 to 64 samples that is spread by half a pixel.
const REMOVED: f32 = 0.015;

/// Finds noise that was removed or spread. `light` is [`sums`](super::light::sums) of the render.
pub fn check(set: &PassSet, about: &About, render: &Planes, light: &[f32], findings: &mut Vec<Finding>) {
    if let Some((ratio, amplitude)) = likeness(set, render, light).filter(|(ratio, _)| *ratio < ALIKE) {
        // Where Blender kept the noisy render beside Combined, that render is judged here.
        findings.push(if amplitude < REMOVED {
            Finding::new(
                "looks-denoised",
                "the beauty has no noise of single pixels anywhere on lit surfaces: it looks denoised or filtered already, and \
                 is only blurred by another pass",
                match about.denoised_by_demc {
                    true => "demc denoised it, in place of the render (--replace): take the render itself",
                    false => {
                        "turn off Render Properties > Sampling > Render > Denoise, or keep the pass Noisy Image, in which \
                         Blender stores the render beside it"
                    }
                },
            )
        } else {
            Finding::new(
                "spread-noise",
                format!(
                    "the noise of neighbouring pixels is alike ({:.0}% of independent noise): samples were spread over \
                     pixels by a wide pixel filter, or the frame was resized; blotches will stay",
                    100.0 * ratio
                ),
                "render at the final size with a box filter of one pixel, or one that samples are picked by (Cycles: Render \
                 Properties > Film > Pixel Filter at 1.5 px)",
            )
        });
    }
}

/// The ratio of the differences of neighbours to those of pixels two apart, below which [`MOST`] of the
/// squares lie, and the median difference of neighbours; none where too few squares can be judged.
fn likeness(set: &PassSet, render: &Planes, light: &[f32]) -> Option<(f32, f32)> {
    let surfaces = lit_surfaces(set, render)?;
    let (w, h) = (set.width, set.height);
    let logs = logarithms(light, 0.01);
    let around = |at: usize, n: usize| [at - n * w, at - n, at + n, at + n * w];
    let is_of_use = |at: usize| {
        let others = || around(at, 1).into_iter().chain(around(at, 2));
        surfaces[at] && others().all(|other| surfaces[other]) && others().any(|other| light[other] > 0.0)
    };
    let difference = |at: usize, n: usize| {
        (logs[at] - around(at, n).into_iter().map(|other| logs[other]).sum::<f32>() / 4.0).abs()
    };
    let judge = |x0: usize, y0: usize| {
        let rows = y0.max(2)..(y0 + SQUARE).min(h - 2);
        let columns = || x0.max(2)..(x0 + SQUARE).min(w - 2);
        let places = rows.flat_map(|y| columns().map(move |x| y * w + x));
        let (mut near, mut far): (Vec<f32>, Vec<f32>) =
            places.filter(|at| is_of_use(*at)).map(|at| (difference(at, 1), difference(at, 2))).unzip();
        if near.len() < PIXELS {
            return None;
        }
        let (near, far) = (median(&mut near)?, median(&mut far)?);
        (far > 0.0).then(|| (near / far, near))
    };
    let squares: Vec<(usize, usize)> = (0..h.div_ceil(SQUARE))
        .flat_map(|y| (0..w.div_ceil(SQUARE)).map(move |x| (x * SQUARE, y * SQUARE)))
        .collect();
    let judged: Vec<(f32, f32)> = squares.into_par_iter().filter_map(|(x, y)| judge(x, y)).collect();
    if judged.len() < SQUARES {
        return None;
    }
    let (mut ratios, mut amplitudes): (Vec<f32>, Vec<f32>) = judged.into_iter().unzip();
    Some((quantile(&mut ratios, MOST)?, median(&mut amplitudes)?))
}

/// Values of Render Properties > Light Paths > Clamping that are tried.
const CLAMPS: [f32; 13] = [0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 15.0, 20.0, 50.0, 100.0];

/// Width of a class of pixels by how far they stand out from those around them, as a logarithm.
const CLASS: f32 = 0.02;

/// The standard deviations of chance by which a class must have more pixels than the classes beside it.
const STANDS_OUT: f32 = 6.0;

/// How many times as far as any other class it must stand out, since lamps and hard light make classes of
/// their own at any value.
const ALONE: f32 = 2.0;

/// Pixels that a class needs.
const CLAMPED_PIXELS: f32 = 30.0;

/// More pixels than this that are just 1 were clipped.
const CLIPPED: usize = 20;

/// Finds samples that were clamped. Cycles scales a sample whose channels add up to more than three times the
/// clamp down to that sum. In a pixel of N samples one such sample adds three times the clamp, divided by N,
/// so that many pixels stand out from those around them by just that.
///
/// This comes last: values that are cut off at 1 were encoded for a display, which is another fault.
pub fn clamped(set: &PassSet, render: &Planes, light: &[f32], findings: &mut Vec<Finding>) {
    if findings.iter().any(|finding| ["display-pixels", "eight-bit-pixels"].contains(&finding.code)) {
        return;
    }
    // What was clipped at white stands out by as much everywhere, too. A white backdrop is no surface.
    if render.data.iter().all(|v| *v <= 1.0) {
        let surfaces = lit_surfaces(set, render);
        let is_lit = |at: usize| surfaces.as_ref().is_some_and(|surfaces| surfaces[at]);
        let is_clipped = |at: usize| (0..3).any(|c| render.channel(c)[at] == 1.0);
        let (clipped, others) =
            (0..light.len()).filter(|at| is_clipped(*at)).partition::<Vec<_>, _>(|at| is_lit(*at));
        if clipped.len() > CLIPPED {
            findings.push(Finding::new(
                "display-pixels",
                format!(
                    "no light is above 1, and {} pixels of lit surfaces are just that: the pixels were cut off for a display",
                    clipped.len()
                ),
                LINEAR,
            ));
        }
        if clipped.len() + others.len() > CLIPPED {
            return;
        }
    }
    let Some(samples) = set.samples.filter(|samples| *samples > 0) else { return };
    let (w, h) = (set.width, set.height);
    let logs: Vec<f32> = (w..w * (h - 1))
        .filter(|at| (1..w - 1).contains(&(at % w)))
        .filter_map(|at| {
            let rows = [at - w, at, at + w];
            let least =
                rows.iter().flat_map(|at| &light[at - 1..=at + 1]).fold(f32::INFINITY, |a, b| a.min(*b));
            (light[at] > 2.0 * least && light[at] - least > LEAST_EXCESS).then(|| (light[at] - least).ln())
        })
        .collect();
    let counts = Counts::of(logs);
    // Classes begin a little below the value, since half floats round it.
    let first = |clamp: f32| (3.0 * clamp / samples as f32).ln() - 0.003;
    let tried = CLAMPS.map(|clamp| (counts.stands_out(first(clamp)), clamp));
    let best = tried.iter().map(|(much, _)| *much).fold(0.0, f32::max);
    // Two samples of one clamp add as much as one of twice the clamp, so the lowest that fits is taken.
    let lowest = tried.into_iter().find(|(much, _)| *much >= 0.5 * best);
    let (most, clamp) = lowest.expect("the best is one of them");
    if most < STANDS_OUT {
        return;
    }
    // All other classes, except those of several clamped samples in a pixel and those that overlap with them.
    let own = first(clamp);
    let is_own = |at: f32| (1..=6).any(|n| (at - own - (n as f32).ln()).abs() < 6.0 * CLASS);
    let classes = (-500..600).map(|class| class as f32 * CLASS).filter(|at| !is_own(*at));
    let others = classes.map(|at| counts.stands_out(at)).fold(0.0, f32::max);
    if most < ALONE * others {
        return;
    }
    findings.push(Finding::new(
        "clamped-samples",
        format!(
            "many pixels stand out by just what a sample leaves that was clamped to {clamp}: light is lost, more of it the \
             more samples there are"
        ),
        "set Render Properties > Light Paths > Clamping > Indirect Light (and Direct Light) to 0, or higher; demc removes \
         fireflies",
    ));
}

/// Pixels that stand out by less light than this are not looked at, since half floats are too coarse there.
const LEAST_EXCESS: f32 = 1e-4;

/// How many pixels stand out by how much: for each step, the number of logarithms up to it.
struct Counts(Vec<f32>);

impl Counts {
    /// Steps in a class.
    const STEPS: i32 = 20;
    /// The logarithm of the first step, in steps.
    const FIRST: i32 = -14_000;
    /// The logarithm of the last step, in steps.
    const LAST: i32 = 16_000;

    fn step(logarithm: f32) -> i32 {
        (logarithm / CLASS * Self::STEPS as f32).round() as i32
    }

    fn of(logarithms: Vec<f32>) -> Self {
        let mut counts = vec![0.0f32; (Self::LAST - Self::FIRST + 1) as usize];
        for logarithm in logarithms {
            counts[(Self::step(logarithm).clamp(Self::FIRST, Self::LAST) - Self::FIRST) as usize] += 1.0;
        }
        let mut sum = 0.0;
        counts.iter_mut().for_each(|count| {
            sum += f64::from(*count);
            *count = sum as f32;
        });
        Self(counts)
    }

    /// The pixels in the classes from `from` up to, but without, `to`. Class 0 begins at `logarithm`, and
    /// negative classes lie before it.
    fn classes(&self, logarithm: f32, from: i32, to: i32) -> f32 {
        let at = |class: i32| {
            let step = Self::step(logarithm) + class * Self::STEPS - Self::FIRST - 1;
            self.0[step.clamp(0, self.0.len() as i32 - 1) as usize]
        };
        at(to) - at(from)
    }

    /// By how many standard deviations of chance the class that begins at `logarithm` has more pixels than
    /// the classes on both sides let expect; 0 where it has too few pixels.
    fn stands_out(&self, logarithm: f32) -> f32 {
        let (left, right) = (self.classes(logarithm, -5, -1) / 4.0, self.classes(logarithm, 5, 9) / 4.0);
        let expected = (2.0 * left + right) / 3.0;
        let own = self.classes(logarithm, 0, 1);
        if own >= CLAMPED_PIXELS { (own - expected) / (expected + 1.0).sqrt() } else { 0.0 }
    }
}
