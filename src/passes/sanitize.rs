//! One NaN in one pass would spread over a network's whole receptive field: make every value finite.

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::{Pass, PassSet};

impl PassSet {
    /// Makes every value finite, so that one bad sample cannot spread: a NaN or infinite value takes
    /// the mean of the finite values among its 8 neighbours (0 without one). Returns how many values
    /// each pass had replaced; passes that were clean are not listed. Negative radiance is left as it
    /// is: filters with negative lobes make it, and models clamp their own inputs.
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
    let repaired: Vec<f32> = bad.iter().map(|&i| finite_mean(plane, width, height, i)).collect();
    for (&i, value) in bad.iter().zip(repaired) {
        plane[i] = value;
    }
    bad.len()
}

fn finite_mean(plane: &[f32], width: usize, height: usize, i: usize) -> f32 {
    let (x, y) = (i % width, i / width);
    let (mut sum, mut n) = (0.0f64, 0u32);
    for ny in y.saturating_sub(1)..=(y + 1).min(height - 1) {
        for nx in x.saturating_sub(1)..=(x + 1).min(width - 1) {
            let v = plane[ny * width + nx];
            if v.is_finite() {
                sum += f64::from(v);
                n += 1;
            }
        }
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
    fn the_mean_of_huge_values_stays_finite() {
        let mut set = PassSet::new("x.exr", "V", 3, 1);
        set.insert(Pass::Depth, Planes::from_vec(1, 3, 1, vec![f32::MAX, f32::NAN, f32::MAX]));
        set.sanitize();
        assert_eq!(set.get(Pass::Depth).unwrap().data, [f32::MAX; 3]);
    }
}
