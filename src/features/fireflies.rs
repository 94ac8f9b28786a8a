//! Fireflies: single pixels far brighter than all their neighbours, left by improbable light paths. Here they
//! are dimmed.

use std::ops::Range;

use rayon::prelude::*;

pub use crate::filters::FIREFLY;
use crate::{
    kernels::thirds,
    planes::{Planes, mirror_beyond, mirrored},
};

/// Pixels of a row that are tested together.
const RUN: usize = 32;

/// Rows `rows` of `radiance` (3, H, W) without fireflies, padded to `size` (width, height) as
/// [`Planes::padded_to`] does.
///
/// The brightness of a pixel is its largest channel. Its limit is [`FIREFLY`] times the brightest other pixel
/// in the 5x5 around it (of the whole frame, not only of `rows`), or `floor` if that is more. A brighter
/// pixel is scaled down to the limit; its hue stays.
///
/// A network trusts such a pixel little, but a small share of 1000 times the mean is still visible.
pub fn tame_fireflies(radiance: &Planes, rows: Range<usize>, size: (usize, usize), floor: f32) -> Planes {
    let w = radiance.width;
    if radiance.pixels() == 1 {
        return radiance.padded_rows(rows, size); // nothing to compare with
    }
    let brightest = |x: usize, y: usize| (0..3).map(|c| radiance.channel(c)[y * w + x]).fold(0.0, f32::max);
    let mut tamed = Planes::unwritten(3, size.0, size.1);
    let [red, green, blue] = thirds(&mut tamed.data).map(|plane| plane.par_chunks_mut(size.0));
    red.zip(green).zip(blue).enumerate().for_each_init(Vec::new, |row, (y, ((red, green), blue))| {
        let y = rows.start + mirrored(y, rows.len());
        let mut colours = [red, green, blue];
        for (c, colour) in colours.iter_mut().enumerate() {
            colour[..w].copy_from_slice(radiance.row(c, y));
        }
        row.clear();
        row.extend((0..w).map(|x| brightest(x, y)));
        for first in (0..w).step_by(RUN) {
            let run = first..(first + RUN).min(w);
            // Nearly every pixel has a neighbour in its row that is bright enough; no branch per pixel is
            // needed to see that.
            let near = &row[first.saturating_sub(1)..(run.end + 1).min(w)];
            let alone = |near: &[f32]| (near[1] > floor) & (near[1] > FIREFLY * near[0].max(near[2]));
            let at_border = first == 0 || run.end == w;
            if !at_border && !near.windows(3).fold(false, |any, near| any | alone(near)) {
                continue;
            }
            for x in run {
                let own = row[x];
                let others = || {
                    let near = radiance.near(x, y, 2);
                    near.filter(|&other| other != (x, y)).map(|(x, y)| brightest(x, y))
                };
                if own <= floor || others().any(|other| own <= FIREFLY * other) {
                    continue;
                }
                let limit = (FIREFLY * others().fold(0.0, f32::max)).max(floor);
                colours.iter_mut().for_each(|colour| colour[x] *= limit / own);
            }
        }
        colours.into_iter().for_each(|colour| mirror_beyond(colour, w));
    });
    tamed
}

/// Scales each pixel of a layer, (3, H, W), as [`tame_fireflies`] scaled the beauty from `noisy` to `tamed`.
pub fn tame_alike(layer: &mut Planes, noisy: &Planes, tamed: &Planes) {
    let [noisy, tamed] = [noisy, tamed].map(|planes| [0, 1, 2].map(|c| planes.channel(c)));
    let n = layer.pixels();
    let changed: Vec<(usize, f32)> = (0..n)
        .into_par_iter()
        .filter_map(|at| {
            // A firefly's colours are all scaled alike, the brightest most exactly.
            let c = (0..3).max_by(|a, b| noisy[*a][at].total_cmp(&noisy[*b][at]))?;
            (noisy[c][at] != tamed[c][at]).then(|| (at, tamed[c][at] / noisy[c][at]))
        })
        .collect();
    for plane in layer.data.chunks_exact_mut(n) {
        changed.iter().for_each(|&(at, factor)| plane[at] *= factor);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs of pixels with others on both sides, and those at the borders.
    const W: usize = 3 * RUN + 7;
    const H: usize = 17;

    /// Grey noise between 0.5 and 1.5 with some pixels brighter.
    fn frame(bright: &[(usize, usize, f32)]) -> Planes {
        let mut rng = crate::rng::Rng::new(5, 0);
        let mut planes = Planes::new(3, W, H);
        for at in 0..W * H {
            let v = 0.5 + rng.uniform();
            (0..3).for_each(|c| planes.channel_mut(c)[at] = v);
        }
        for &(x, y, v) in bright {
            planes.channel_mut(0)[y * W + x] = v;
        }
        planes
    }

    #[test]
    fn a_lone_bright_pixel_is_taken_down_and_keeps_its_hue() {
        // At a corner, within a run, and at the ends of two.
        const LONE: [(usize, usize); 5] = [(0, 0), (7, 9), (RUN + 9, 3), (2 * RUN - 1, 8), (2 * RUN, 13)];
        let bright = frame(&LONE.map(|(x, y)| (x, y, 1000.0)));
        let tamed = tame_fireflies(&bright, 0..H, (W, H), 0.0);
        for (x, y) in LONE {
            let at = y * W + x;
            let around = (0..H * W)
                .filter(|i: &usize| (i % W).abs_diff(x) <= 2 && (i / W).abs_diff(y) <= 2 && *i != at)
                .map(|i| bright.channel(0)[i])
                .fold(0.0, f32::max);
            let red = tamed.channel(0)[at];
            assert!((red - FIREFLY * around).abs() < 1e-3 * red, "{red}, around it {around}");
            let hue = |p: &Planes| p.channel(1)[at] / p.channel(0)[at];
            assert!((hue(&tamed) / hue(&bright) - 1.0).abs() < 1e-5);
        }
        let changed = tamed.data.iter().zip(&bright.data).filter(|(a, b)| a != b).count();
        assert_eq!(changed, 3 * LONE.len(), "and nothing else is");
    }

    #[test]
    fn what_has_bright_company_or_is_below_the_floor_stays() {
        let company = frame(&[(7, 9, 1000.0), (8, 11, 400.0), (18, 4, 700.0), (20, 4, 600.0)]);
        assert_eq!(tame_fireflies(&company, 0..H, (W, H), 0.0).data, company.data);
        let lone = frame(&[(7, 9, 1000.0)]);
        assert_eq!(tame_fireflies(&lone, 0..H, (W, H), 1000.0).data, lone.data);
    }

    #[test]
    fn rows_are_those_of_the_whole_frame() {
        let bright = frame(&[(7, 9, 1000.0), (3, 10, 500.0), (20, 16, 800.0)]);
        let whole = tame_fireflies(&bright, 0..H, (W, H), 0.1);
        for (from, to) in [(0, 9), (9, 10), (10, 17), (1, 17)] {
            let rows = tame_fireflies(&bright, from..to, (W + 9, to - from + 3), 0.1);
            assert_eq!(rows, whole.padded_rows(from..to, (W + 9, to - from + 3)));
        }
    }
}
