//! Guides that are shifted against the beauty, because they are of a frame with another camera or crop, or
//! were moved in compositing.
//!
//! Edges of the guides are compared with edges of the beauty at shifts of up to some pixels. A frame's own
//! guides fit best without a shift.

use rayon::prelude::*;

use super::{Finding, GUIDES, light::logarithms};
use crate::{passes::PassSet, planes::Planes};

/// Largest shift that is tried, in pixels.
const REACH: usize = 12;

/// Shifts of up to this many pixels count as none, since filters and the pixel grid make as much.
const NONE: isize = 1;

/// A correlation of edges below this counts as none. A frame's own guides have 0.2 or more in 15 of 17
/// scenes.
const FITS: f64 = 0.2;

/// How many times as well a shift must fit as no shift. None does in sound frames of 320x180 pixels and more,
/// where guides that were moved by 8 pixels fit 1.25 times as well or better.
const BETTER: f64 = 1.2;

/// The most rows that are compared; those of larger frames are picked evenly.
const ROWS: usize = 400;

/// Finds guides that are shifted against `light`, the sums of the render's channels. Where none is, returns how well the
/// better guide fits as it lies: the correlation of edges.
pub fn check(set: &PassSet, light: &[f32], findings: &mut Vec<Finding>) -> Option<f64> {
    let before = findings.len();
    let (w, h) = (set.width, set.height);
    let blurred = blur(light, w, h);
    let beauty = edges(&[&logarithms(&blurred, 0.05)], w, h, 1.0);
    let mut best_fit = 0.0f64;
    for pass in GUIDES {
        let Some(guide) = set.get(pass) else { continue };
        let (moved, unmoved) = shift(&beauty, &edges_of_guide(guide));
        best_fit = best_fit.max(unmoved);
        let Some((x, y)) = moved else { continue };
        let along = |n: isize, back: &str, forth: &str| match n {
            0 => None,
            n => Some(format!("{} px {}", n.abs(), if n < 0 { back } else { forth })),
        };
        let way: Vec<String> =
            [along(x, "to the left", "to the right"), along(y, "up", "down")].into_iter().flatten().collect();
        findings.push(Finding::new(
            "shifted-guide",
            format!(
                "{pass} fits the beauty better where it is moved by {}: it is of another frame, camera or crop",
                way.join(" and ")
            ),
            "render beauty and guides in one go, or take the guides of the same frame, size and region",
        ));
    }
    (findings.len() == before).then_some(best_fit)
}

/// The edges of a guide, for [`shift`].
pub fn edges_of_guide(guide: &Planes) -> Planes {
    let planes: Vec<Vec<f32>> =
        (0..3).map(|c| guide.channel(c).iter().map(|v| clean(*v)).collect()).collect();
    let planes: Vec<&[f32]> = planes.iter().map(Vec::as_slice).collect();
    edges(&planes, guide.width, guide.height, 0.6)
}

fn clean(v: f32) -> f32 {
    if v.is_nan() { 0.0 } else { v.clamp(-2.0, 2.0) }
}

/// The mean of the 3x3 pixels around each pixel, or at the rim, of those that exist.
fn blur(plane: &[f32], w: usize, h: usize) -> Vec<f32> {
    let mean = |at: usize| {
        let (x, y) = (at % w, at / w);
        let rows = y.saturating_sub(1)..=(y + 1).min(h - 1);
        let columns = x.saturating_sub(1)..=(x + 1).min(w - 1);
        let count = rows.clone().count() * columns.clone().count();
        rows.flat_map(|y| &plane[y * w..][columns.clone()]).sum::<f32>() / count as f32
    };
    (0..w * h).into_par_iter().map(mean).collect()
}

/// The sum of the gradients' lengths of all planes at each pixel, at most `most`.
fn edges(planes: &[&[f32]], w: usize, h: usize, most: f32) -> Planes {
    Planes::from_rows(1, (w, h), |_, y, out| {
        out.fill(0.0);
        if y == 0 || y + 1 == h {
            return;
        }
        for plane in planes {
            for (x, out) in out.iter_mut().enumerate().take(w - 1).skip(1) {
                let at = y * w + x;
                let (dx, dy) = (plane[at + 1] - plane[at - 1], plane[at + w] - plane[at - w]);
                *out += dx.hypot(dy);
            }
        }
        out.iter_mut().for_each(|v| *v = v.min(most));
    })
}

/// Where a guide would have to be moved to fit best, in pixels to the right and down; none where it fits as
/// it lies, or nowhere. Besides, how well it fits as it lies.
pub fn shift(beauty: &Planes, guide: &Planes) -> (Option<(isize, isize)>, f64) {
    let (w, h) = (beauty.width, beauty.height);
    let inner = REACH..h - REACH;
    let rows: Vec<usize> = inner.clone().step_by(inner.len().div_ceil(ROWS)).collect();
    let row = |planes: &Planes, y: usize, x: usize| planes.data[y * w + x..][..w - 2 * REACH].to_vec();
    let correlation = |(dx, dy): (isize, isize)| {
        let mut sums = [0.0f64; 5];
        for &y in &rows {
            // The guide moved by (dx, dy) has at a pixel the value from dx to its left and dy above it.
            let of_guide = row(guide, y.wrapping_add_signed(-dy), REACH.wrapping_add_signed(-dx));
            let mut of_row = [0.0f32; 5];
            for (b, g) in row(beauty, y, REACH).iter().zip(&of_guide) {
                for (sum, v) in of_row.iter_mut().zip([*b, *g, b * b, g * g, b * g]) {
                    *sum += v;
                }
            }
            sums.iter_mut().zip(of_row).for_each(|(sum, v)| *sum += f64::from(v));
        }
        let n = (rows.len() * (w - 2 * REACH)) as f64;
        let [b, g, bb, gg, bg] = sums.map(|sum| sum / n);
        let spread = ((bb - b * b) * (gg - g * g)).sqrt();
        if spread > 1e-9 { (bg - b * g) / spread } else { 0.0 }
    };
    let reach = REACH.cast_signed();
    let shifts: Vec<(isize, isize)> =
        (-reach..=reach).flat_map(|dy| (-reach..=reach).map(move |dx| (dx, dy))).collect();
    let found: Vec<((isize, isize), f64)> =
        shifts.into_par_iter().map(|shift| (shift, correlation(shift))).collect();
    let is_none = |(dx, dy): (isize, isize)| dx.abs() <= NONE && dy.abs() <= NONE;
    let unmoved = found.iter().filter(|(shift, _)| is_none(*shift)).map(|f| f.1).fold(0.0, f64::max);
    let (best, fit) = *found.iter().max_by(|a, b| a.1.total_cmp(&b.1)).expect("shifts are tried");
    ((!is_none(best) && fit > FITS && fit > BETTER * unmoved).then_some(best), unmoved)
}
