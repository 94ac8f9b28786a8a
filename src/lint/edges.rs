//! What edges of the guides tell: how wide the pixel filter is, whether the beauty is blurred where they are
//! sharp, and whether its steps are as large as those of the albedo.

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::{
    Finding,
    light::{logarithms, median, quantile},
    values::LINEAR,
};
use crate::{
    passes::{Pass, PassSet},
    planes::Planes,
};

/// Edges that are needed to judge by.
const EDGES: usize = 100;

/// Side in pixels of the squares in which edges are judged. One long edge must not decide alone, since it
/// lies on the pixel grid in one way and has one light.
const SQUARE: usize = 16;

/// Edges that a square needs.
const EDGES_OF_SQUARE: usize = 8;

/// Groups what was found at pixels by square, without the squares that have too few edges.
fn by_square<T>(width: usize, found: impl IntoIterator<Item = (usize, T)>) -> Vec<Vec<T>> {
    let mut squares: BTreeMap<(usize, usize), Vec<T>> = BTreeMap::new();
    for (place, value) in found {
        squares.entry((place / width / SQUARE, place % width / SQUARE)).or_default().push(value);
    }
    squares.into_values().filter(|square| square.len() >= EDGES_OF_SQUARE).collect()
}

/// Judges the edges of the guides. The sums of the render's channels, and how well its edges fit those of the guides, are
/// given only where the guides are not shifted against the render; the render's edges are then judged too.
pub fn check(set: &PassSet, render: &Planes, light: Option<(&Vec<f32>, f64)>, findings: &mut Vec<Finding>) {
    let (Some(albedo), Some(normal)) = (set.get(Pass::DenoisingAlbedo), set.get(Pass::DenoisingNormal))
    else {
        return;
    };
    soft(&[albedo, normal], findings);
    let Some((light, fit)) = light else { return };
    let logs = logarithms(light, 0.02);
    blurred(set, (albedo, normal), (&logs, fit), findings);
    encoded(render, (albedo, normal), light, findings);
}

/// The direction along rows or down columns: the distance between neighbouring pixels of a line and their
/// number, and the distance between neighbouring lines and their number. Distances are in the plane's index.
#[derive(Clone, Copy)]
struct Way {
    step: usize,
    length: usize,
    line: usize,
    lines: usize,
}

impl Way {
    fn both(width: usize, height: usize) -> [Self; 2] {
        [
            Self { step: 1, length: width, line: width, lines: height },
            Self { step: width, length: height, line: 1, lines: width },
        ]
    }

    /// What `find` returns for the indices of all pixels that are at least `margin` away from the ends of
    /// their lines.
    fn find<T: Send>(self, margin: usize, find: impl Fn(usize) -> Option<T> + Sync) -> Vec<T> {
        let find = &find;
        let line = |line: usize| {
            let places = margin..self.length.saturating_sub(margin);
            places.filter_map(move |at| find(line * self.line + at * self.step))
        };
        (0..self.lines).into_par_iter().flat_map_iter(line).collect()
    }

    /// The index of the pixel that is `steps` pixels further along the line.
    fn at(self, place: usize, steps: isize) -> usize {
        place.wrapping_add_signed(steps * self.step.cast_signed())
    }
}

/// The smallest step of a guide that is looked at.
const STEP: f32 = 0.15;

/// Squares that are needed to judge softness by.
const SOFT_SQUARES: usize = 12;

/// How much of a step between plain sides lies between two neighbouring pixels, as a share of the whole step.
/// With a narrow filter that is most of it: in sound renders the sharpest quarter of the steps has shares
/// above 0.62 to 1, with a filter of 3 pixels above 0.73, and with one of 6 pixels above 0.50 to 0.53. Guides
/// are soft where that quarter begins at this share or below, and where three quarters of the squares have a
/// median at or below it too (0.5 with a filter of 6 pixels).
const SHARP: f32 = 0.56;

/// Finds soft guides, which tell of a wide pixel filter, or of a camera that is out of focus everywhere. The noise does
/// not tell of it where a renderer keeps it independent from pixel to pixel, as Cycles does.
fn soft(guides: &[&Planes], findings: &mut Vec<Finding>) {
    // So many differences between neighbours on each side of the largest belong to the step; beyond them the
    // sides are plain.
    const REACH: isize = 3;
    let mut shares = Vec::new();
    for planes in guides {
        for way in Way::both(planes.width, planes.height) {
            for c in 0..planes.channels {
                let plane = planes.channel(c);
                shares.extend(way.find(REACH as usize + 2, |place| {
                    let difference = |n: isize| plane[way.at(place, n + 1)] - plane[way.at(place, n)];
                    let own = difference(0).abs();
                    if own < STEP / 4.0 {
                        return None;
                    }
                    let whole: f32 = (-REACH..=REACH).map(difference).sum::<f32>().abs();
                    let ways: f32 = (-REACH..=REACH).map(|n| difference(n).abs()).sum();
                    let beyond =
                        [-REACH - 1, REACH + 1].map(|n| difference(n).abs()).into_iter().fold(0.0, f32::max);
                    let is_largest = (-REACH..=REACH).all(|n| difference(n).abs() <= own);
                    let is_step = whole > STEP && ways < 1.1 * whole && beyond < 0.02 * whole && is_largest;
                    is_step.then(|| (place, own / whole))
                }));
            }
        }
    }
    let width = guides.first().map_or(1, |planes| planes.width);
    let mut all: Vec<f32> = shares.iter().map(|(_, share)| *share).collect();
    if quantile(&mut all, 0.75).is_none_or(|share| share > SHARP) {
        return;
    }
    let mut squares: Vec<f32> =
        by_square(width, shares).into_iter().filter_map(|mut square| median(&mut square)).collect();
    if squares.len() < SOFT_SQUARES || quantile(&mut squares, 0.75).is_none_or(|share| share > SHARP) {
        return;
    }
    findings.push(Finding::new(
        "wide-filter",
        "no edge of the guides is sharp: the pixel filter is several pixels wide, and what it blurred stays blurred, or all is \
         out of focus",
        "set Render Properties > Film > Pixel Filter > Width to 1.5 px (the default), if the camera's focus is as it should be",
    ));
}

/// Whether a pixel is the middle of a step of the guides whose sides are plain up to nine pixels away.
fn is_edge((albedo, normal): (&Planes, &Planes), way: Way, place: usize) -> bool {
    let planes = || (0..3).flat_map(|c| [(albedo.channel(c), 4.0), (normal.channel(c), 1.0)]);
    let value = |plane: &[f32], most: f32, n: isize| plane[way.at(place, n)].min(most);
    let is_step = planes().any(|(plane, most)| (value(plane, most, 2) - value(plane, most, -2)).abs() > 0.3);
    is_step
        && planes().all(|(plane, most)| {
            [1, -1].into_iter().all(|side| {
                let near = value(plane, most, 2 * side);
                [3, 5, 7, 9].into_iter().all(|n| (value(plane, most, n * side) - near).abs() < 0.05)
            })
        })
}

/// A beauty is blurred where less than this share of the light's step across edges lies within 3 pixels on
/// both sides. Over all edges together the share is 0.67 to 1.1 in sound renders of 320x180 pixels and more,
/// 0.34 to 0.58 after a blur of 9 pixels across the edges, and below 0.42 after one of 13.
const NEAR: f64 = 0.6;

/// Squares that are needed to judge a blur by.
const BLURRED_SQUARES: usize = 8;

/// The share below which three of four squares must lie as well. They lie below 0.86 or more in sound
/// renders, below 0.5 to 0.77 after the blur of 9 pixels, and below 0.35 to 0.58 after that of 13.
const NEAR_IN_SQUARES: f32 = 0.65;

/// Where the root mean square of the light's steps, as logarithms, is below this, light hides the edges.
const LIGHT_STEP: f64 = 0.3;

/// Where the edges of neither guide fit those of the beauty by this much, as a correlation, they are of another picture. Those
/// of three other scenes fitted by 0.03 at most; in renders blurred over 13 pixels they fit by 0.33 and more, in the plain walls
/// of the tests, blurred over 16, by 0.12.
const FOREIGN: f64 = 0.08;

/// Edges that move by at least this many pixels a frame are also judged apart from the others.
const MOTION: f32 = 4.0;

/// Steps of the light across an edge of the guides, as logarithms: one near the edge and two further away;
/// and whether the edge moves.
type Step = (f64, f64, f64, bool);

/// Finds a beauty that is blurred where the guides are sharp, or that shows something else.
fn blurred(
    set: &PassSet,
    guides: (&Planes, &Planes),
    (logs, fit): (&[f32], f64),
    findings: &mut Vec<Finding>,
) {
    let vectors = set.get(Pass::Vector);
    for (direction, way) in Way::both(set.width, set.height).into_iter().enumerate() {
        let steps = way.find(9, |place| {
            is_edge(guides, way, place).then(|| {
                let mean = |places: [isize; 2]| {
                    places.iter().map(|n| f64::from(logs[way.at(place, *n)])).sum::<f64>() / 2.0
                };
                let step = |a: isize, b: isize| mean([a, b]) - mean([-a, -b]);
                let motion = vectors.map_or(0.0, |v| v.channel(direction)[place].abs());
                // Each step is of other pixels, so that noise adds nothing to their products on average.
                (place, (step(2, 3), step(6, 8), step(7, 9), motion >= MOTION))
            })
        });
        for moving in [false, true] {
            let chosen: Vec<_> = steps.iter().filter(|(_, step)| !moving || step.3).copied().collect();
            let far = |(_, a, b, _): &Step| a * b;
            let near = |(near, a, b, _): &Step| near * (a + b) / 2.0;
            let judge = |steps: &[Step]| {
                let [near, far] = [steps.iter().map(near).sum::<f64>(), steps.iter().map(far).sum::<f64>()];
                let is_seen = far > LIGHT_STEP * LIGHT_STEP * steps.len() as f64;
                is_seen.then(|| near / far)
            };
            let all: Vec<Step> = chosen.iter().map(|(_, step)| *step).collect();
            let mut squares: Vec<f32> = by_square(set.width, chosen)
                .into_iter()
                .filter_map(|square| judge(&square).map(|share| share as f32))
                .collect();
            let is_blurred = all.len() >= EDGES
                && judge(&all).is_some_and(|share| share < NEAR)
                && squares.len() >= BLURRED_SQUARES
                && quantile(&mut squares, 0.75).is_some_and(|share| share < NEAR_IN_SQUARES);
            if !is_blurred {
                continue;
            }
            if fit < FOREIGN {
                findings.push(Finding::new(
                    "foreign-guide",
                    "edges of the guides lie nowhere in the beauty: they are of another picture, or turned upside down",
                    "render beauty and guides in one go, or check which files and layers were put together",
                ));
                return;
            }
            let across = ["along rows", "down columns"][direction];
            let (what, where_) =
                if moving { ("motion blur", " that move") } else { ("motion blur or depth of field", "") };
            findings.push(Finding::new(
                "blur-in-beauty-alone",
                format!(
                    "the beauty is blurred {across} at edges{where_} where the guides are sharp: {what} is in the beauty, but \
                     not in the guides"
                ),
                "render beauty and guides with the same camera and shutter, as Cycles does with Denoising Data; or turn off \
                 Render Properties > Motion Blur, and blur in the compositor",
            ));
            return;
        }
    }
}

/// The smallest step of the albedo, as a logarithm, that is looked at.
const ALBEDO_STEP: f32 = 0.5;

/// Ratios of the light's steps to those of the albedo, as logarithms, that tell of encoded pixels. They are
/// 0.76 to 1.3 in linear renders, and 0.38 to 0.61 in the same renders with the curve of sRGB.
const ENCODED: std::ops::Range<f32> = 0.3..0.66;

/// The share of the values of encoded pixels that may lie outside 0 to 1, as a lamp's or what a filter left do.
const OUTSIDE: f64 = 0.001;

/// Finds pixels that were encoded for a display: hardly any is above one, and light is not proportional to the
/// albedo.
fn encoded(render: &Planes, guides: (&Planes, &Planes), light: &[f32], findings: &mut Vec<Finding>) {
    let (albedo, normal) = guides;
    let outside = render.data.iter().filter(|v| !(0.0..=1.0).contains(*v)).count();
    if outside as f64 > OUTSIDE * render.data.len() as f64 {
        return;
    }
    let shown = |at: usize| (0..3).map(|c| albedo.channel(c)[at].max(0.0)).sum::<f32>();
    let mut slopes: Vec<f32> = Way::both(render.width, render.height)
        .into_iter()
        .flat_map(|way| {
            way.find(9, |place| {
                let is_flat = |c: usize| {
                    (normal.channel(c)[way.at(place, 3)] - normal.channel(c)[way.at(place, -3)]).abs() < 0.2
                };
                if !is_edge(guides, way, place) || !(0..3).all(is_flat) {
                    return None;
                }
                let mean = |side: isize| (2..=8).map(|n| light[way.at(place, n * side)]).sum::<f32>() / 7.0;
                let albedo = (shown(way.at(place, 4)) + 0.02).ln() - (shown(way.at(place, -4)) + 0.02).ln();
                let step = (mean(1) + 1e-4).ln() - (mean(-1) + 1e-4).ln();
                (albedo.abs() > ALBEDO_STEP).then(|| step / albedo)
            })
        })
        .collect();
    if slopes.len() < EDGES || !median(&mut slopes).is_some_and(|slope| ENCODED.contains(&slope)) {
        return;
    }
    findings.push(Finding::new(
        "display-pixels",
        "hardly any light is above 1, and steps of the albedo show in the beauty at half their size, as the curve of sRGB makes \
         them: the pixels seem to be encoded for a display",
        LINEAR,
    ));
}
