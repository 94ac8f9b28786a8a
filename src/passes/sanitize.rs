//! One NaN in one pass would spread over a network's whole receptive field: make every value finite.

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::{Pass, PassSet};
use crate::frame::HALF_MAX;

impl PassSet {
    /// Makes every value finite, so that one bad sample cannot spread: a NaN or infinite value takes
    /// the mean of the finite values among its 8 neighbours (0 without one). Only where infinite values
    /// lie together are they light that a half float is too small for, and become the largest half
    /// float. Returns how many values each pass had replaced; passes that were clean are not listed.
    /// Negative radiance is left as it is: filters with negative lobes make it, and models clamp their
    /// own inputs.
    pub fn sanitize(&mut self) -> BTreeMap<Pass, usize> {
        let (width, height) = (self.width, self.height);
        let mut replaced = BTreeMap::new();
        for (&pass, planes) in &mut self.planes {
            let count: usize = planes
                .data
                .par_chunks_mut((width * height).max(1))
                .map(|plane| sanitize_plane(plane, width, height))
                .sum();
            if count > 0 {
                replaced.insert(pass, count);
            }
        }
        replaced
    }
}

/// Values looked at before asking whether one was not finite.
const CHUNK: usize = 4096;

fn sanitize_plane(plane: &mut [f32], width: usize, height: usize) -> usize {
    // Nearly all planes are clean, which is told without a branch for each value.
    let is_clean = |values: &[f32]| values.iter().fold(true, |clean, v| clean & v.is_finite());
    if plane.chunks(CHUNK).all(is_clean) {
        return 0;
    }
    let bad: Vec<usize> = (0..plane.len()).filter(|&i| !plane[i].is_finite()).collect();
    // All repairs read the original plane: a repaired value must not feed the next one.
    let repaired: Vec<f32> = bad.iter().map(|&i| repair(plane, width, height, i)).collect();
    for (&i, value) in bad.iter().zip(repaired) {
        plane[i] = value;
    }
    bad.len()
}

/// An infinite value is bright light where at least this many of its 8 neighbours are infinite too. Values
/// inside a spot of light or at its edge have as many, and chance does not bring as many together.
const BRIGHT_TOGETHER: usize = 3;

/// What a value that is not finite becomes.
fn repair(plane: &[f32], width: usize, height: usize, i: usize) -> f32 {
    let (x, y) = (i % width, i / width);
    let (mut sum, mut n, mut infinite) = (0.0f64, 0u32, 0);
    for ny in y.saturating_sub(1)..=(y + 1).min(height - 1) {
        for nx in x.saturating_sub(1)..=(x + 1).min(width - 1) {
            let v = plane[ny * width + nx];
            if v.is_finite() {
                sum += f64::from(v);
                n += 1;
            } else if v == f32::INFINITY && (nx, ny) != (x, y) {
                infinite += 1;
            }
        }
    }
    if plane[i] == f32::INFINITY && infinite >= BRIGHT_TOGETHER {
        return HALF_MAX;
    }
    if n == 0 { 0.0 } else { (sum / f64::from(n)) as f32 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::planes::Planes;

    #[test]
    fn bad_values_take_the_mean_of_their_finite_neighbours() {
        let mut set = PassSet::new("x.exr", "V", 3, 2);
        let n = f32::NAN;
        // 1 n 3 / 4 5 inf: the NaN sees 1,3,4,5; the infinity sees 3 and 5 (and not the repaired NaN).
        let data = vec![1.0, n, 3.0, 4.0, 5.0, f32::INFINITY];
        set.insert(Pass::Depth, Planes::from_vec(1, 3, 2, data));
        set.insert(Pass::Alpha, Planes::from_vec(1, 3, 2, vec![f32::NEG_INFINITY; 6]));
        set.insert(Pass::Combined, Planes::from_vec(3, 3, 2, vec![-1.0; 18]));
        let counts = set.sanitize();
        assert_eq!(counts, BTreeMap::from([(Pass::Depth, 2), (Pass::Alpha, 6)]));
        assert_eq!(set.get(Pass::Depth).unwrap().data, [1.0, 3.25, 3.0, 4.0, 5.0, 4.0]);
        assert_eq!(set.get(Pass::Alpha).unwrap().data, [0.0; 6]);
        assert_eq!(set.get(Pass::Combined).unwrap().data, [-1.0; 18]);
    }

    #[test]
    fn infinite_values_that_lie_together_are_bright_and_others_are_not() {
        let (w, h) = (16, 12);
        let mut plane = Planes::from_vec(1, w, h, vec![2.0; w * h]);
        let inf = f32::INFINITY;
        // A spot of 4x3, two side by side, and one alone.
        (3..6).for_each(|y| plane.data[y * w + 2..][..4].fill(inf));
        plane.data[9 * w + 9..][..2].fill(inf);
        plane.data[13] = inf;
        let mut set = PassSet::new("x.exr", "V", w, h);
        set.insert(Pass::Depth, plane);
        assert_eq!(set.sanitize(), BTreeMap::from([(Pass::Depth, 12 + 2 + 1)]));
        let found = &set.get(Pass::Depth).unwrap().data;
        let bright: Vec<usize> = (0..w * h).filter(|&i| found[i] != 2.0).collect();
        let spot: Vec<usize> = (3..6).flat_map(|y| (2..6).map(move |x| y * w + x)).collect();
        assert_eq!(bright, spot);
        assert!(spot.iter().all(|&i| found[i] == 65504.0));
    }

    #[test]
    fn the_mean_of_huge_values_stays_finite() {
        let mut set = PassSet::new("x.exr", "V", 3, 1);
        set.insert(Pass::Depth, Planes::from_vec(1, 3, 1, vec![f32::MAX, f32::NAN, f32::MAX]));
        set.sanitize();
        assert_eq!(set.get(Pass::Depth).unwrap().data, [f32::MAX; 3]);
    }
}
