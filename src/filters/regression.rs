//! Weighted first-order regression over windows: Bitterli et al. 2016, "Nonlinearly Weighted
//! First-order Regression for Denoising Monte Carlo Renderings", Section 5.2.
//!
//! In: colour, features and the weights of windows. Around each pixel p colour is fitted by a constant,
//! the two screen coordinates and the features, all relative to p; each fit then predicts its whole
//! window, and a pixel is the weighted mean of the predictions of all windows it lies in (collaborative
//! filtering). Out: that mean and, where asked for, its derivative by the pixel's own colour.

use rayon::prelude::*;

use super::{
    nl_means::{Scratch, Weights},
    padded::{Padded, TILE_H, TILE_W, pad, tiles},
    solve::{LANES, Lanes, Symmetric, difference, plus_product, product},
};
use crate::{
    kernels::vectorised::{self, Vectorised},
    planes::Planes,
};

/// A constant and two screen coordinates come before the features.
const BEFORE_FEATURES: usize = 3;
/// Ridge on slopes, as a share of the sum of their own feature's squares.
const RIDGE: f32 = 1e-4;
/// Further ridge on slopes: the variance below which a feature of range 1 counts as flat.
const FLAT: f32 = 1e-5;
/// Weights below it do not count.
const NO_WEIGHT: f32 = 1e-6;

/// What a regression gives.
pub struct Fit {
    /// The prediction, of the colour's shape.
    pub image: Planes,
    /// By how much a pixel's prediction follows its own noisy value, for fixed weights, (1, H, W): 1 for
    /// a copy, 1/n for a mean of n. Only where asked for.
    pub influence: Option<Planes>,
}

/// Fits `colour` (3, H, W) on `features` (any number, each of a range near 1).
///
/// # Panics
/// If the sizes differ.
pub fn first_order(colour: &Planes, features: &Planes, weights: &Weights, influence: bool) -> Fit {
    let (width, height) = weights.size();
    for planes in [colour, features] {
        assert_eq!((planes.width, planes.height), (width, height), "one size for all");
    }
    let window = weights.window();
    let input = Input { colour: pad(colour, window), features: pad(features, window), weights, influence };
    let tiles = tiles(width, height);
    // A few tiles at a time, which bounds the memory of their overlapping results.
    let mut sums = Planes::new(colour.channels + 1 + usize::from(influence), width, height);
    for group in tiles.chunks(8 * rayon::current_num_threads()) {
        let results: Vec<Vec<f32>> =
            group.par_iter().map_init(Work::default, |work, &tile| input.fit(tile, work)).collect();
        for (&tile, result) in group.iter().zip(&results) {
            add_tile(&mut sums, result, tile, window);
        }
    }
    let (values, total) = sums.data.split_at_mut(colour.channels * width * height);
    let (total, own) = total.split_at_mut(width * height);
    for channel in values.chunks_exact_mut(width * height).chain(own.chunks_exact_mut(width * height)) {
        // Every pixel has weight 1 in its own window.
        channel.par_iter_mut().zip(&*total).for_each(|(sum, total)| *sum /= total);
    }
    let influence = influence.then(|| Planes::from_vec(1, width, height, own.to_vec()));
    let image = Planes::from_vec(colour.channels, width, height, values.to_vec());
    Fit { image, influence }
}

/// Adds a tile's sums, which reach `window` pixels out of it, to those of the frame.
fn add_tile(sums: &mut Planes, tile: &[f32], (x, y): (usize, usize), window: usize) {
    let (w, h) = (TILE_W + 2 * window, TILE_H + 2 * window);
    let (width, height) = (sums.width, sums.height);
    let columns = x.saturating_sub(window)..(x + TILE_W + window).min(width);
    let rows = y.saturating_sub(window)..(y + TILE_H + window).min(height);
    for (c, plane) in tile.chunks_exact(w * h).enumerate() {
        for row in rows.clone() {
            let from = (row + window - y) * w + columns.start + window - x;
            let to = &mut sums.channel_mut(c)[row * width..][columns.clone()];
            to.iter_mut().zip(&plane[from..]).for_each(|(sum, v)| *sum += v);
        }
    }
}

struct Input<'a> {
    colour: Vec<Padded>,
    features: Vec<Padded>,
    weights: &'a Weights,
    influence: bool,
}

/// Working memory of one thread.
#[derive(Default)]
struct Work {
    scratch: Scratch,
    /// The weights of a tile, step after step.
    weights: Vec<f32>,
}

/// The fits of one tile, compiled for the processor at hand.
struct FitTile<'a> {
    input: &'a Input<'a>,
    tile: (usize, usize),
    work: &'a mut Work,
    out: &'a mut Vec<f32>,
}

impl Vectorised for FitTile<'_> {
    #[inline(always)]
    fn run(self) {
        *self.out = self.input.fit_tile(self.tile, self.work);
    }
}

/// Sixteen consecutive values from `start` on.
#[inline(always)]
fn lanes(row: &[f32], start: usize) -> &Lanes {
    row[start..start + LANES].try_into().expect("the slice has that length")
}

impl Input<'_> {
    fn fit(&self, tile: (usize, usize), work: &mut Work) -> Vec<f32> {
        let mut out = Vec::new();
        vectorised::run(FitTile { input: self, tile, work, out: &mut out });
        out
    }

    /// Sums of what the fits of the tile's pixels predict, for the tile and the window around it: prediction
    /// times weight for each colour channel, the weight and, where asked for, influence times weight.
    #[inline(always)]
    fn fit_tile(&self, tile: (usize, usize), work: &mut Work) -> Vec<f32> {
        const TILE: usize = TILE_W * TILE_H;
        let window = self.weights.window();
        let steps: Vec<(isize, isize)> = self.weights.steps().collect();
        work.weights.resize(steps.len() * TILE, 0.0);
        for (&step, out) in steps.iter().zip(work.weights.chunks_exact_mut(TILE)) {
            self.weights.of_tile(tile, step, &mut work.scratch, out);
        }
        let unknowns = BEFORE_FEATURES + self.features.len();
        let channels = self.colour.len();
        let (w, h) = (TILE_W + 2 * window, TILE_H + 2 * window);
        let mut out = vec![0.0; (channels + 1 + usize::from(self.influence)) * w * h];
        let mut matrix = Symmetric::new(unknowns);
        let mut right = vec![[0.0; LANES]; channels * unknowns];
        let mut basis = vec![[1.0; LANES]; unknowns];
        let mut weighted = basis.clone();
        for start in (0..TILE).step_by(LANES) {
            let (i, j) = (start / TILE_W, start % TILE_W);
            let p = ((tile.0 + j) as isize, (tile.1 + i) as isize);
            let used = || {
                steps.iter().enumerate().filter_map(|(s, &step)| {
                    let weight = lanes(&work.weights, s * TILE + start);
                    weight.iter().any(|w| *w > NO_WEIGHT).then_some((step, weight))
                })
            };
            // The normal equations.
            matrix.clear();
            right.fill([0.0; LANES]);
            for (step, weight) in used() {
                self.basis(p, step, &mut basis);
                for (to, from) in weighted.iter_mut().zip(&basis) {
                    *to = product(*from, *weight);
                }
                matrix.add_outer(&weighted, &basis);
                for (colour, right) in self.colour.iter().zip(right.chunks_exact_mut(unknowns)) {
                    let colour = *lanes(colour.row(p.0 + step.0, p.1 + step.1, LANES), 0);
                    for (sum, b) in right.iter_mut().zip(&weighted) {
                        *sum = plus_product(*sum, *b, colour);
                    }
                }
            }
            matrix.ridge(RIDGE, [FLAT; LANES]);
            matrix.factor();
            right.chunks_exact_mut(unknowns).for_each(|right| matrix.solve(right));
            // What each fit says about its window.
            for (step, weight) in used() {
                self.basis(p, step, &mut basis);
                let to = (i as isize + window as isize + step.1) as usize * w
                    + (j as isize + window as isize + step.0) as usize;
                let mut add = |plane: usize, values: &Lanes| {
                    let sums = &mut out[plane * w * h + to..][..LANES];
                    sums.copy_from_slice(&plus_product(*lanes(sums, 0), *weight, *values));
                };
                for (c, slopes) in right.chunks_exact(unknowns).enumerate() {
                    let mut value = [0.0; LANES];
                    for (slope, b) in slopes.iter().zip(&basis) {
                        value = plus_product(value, *slope, *b);
                    }
                    add(c, &value);
                }
                add(channels, &[1.0; LANES]);
                if self.influence {
                    // The prediction at q is b^T A^-1 (... + w b colour_q), so it follows colour_q by
                    // w |L^-1 b|^2.
                    matrix.forward(&mut basis);
                    let mut value = [0.0; LANES];
                    for b in &basis {
                        value = plus_product(value, product(*weight, *b), *b);
                    }
                    add(channels + 1, &value);
                    basis[0] = [1.0; LANES];
                }
            }
        }
        out
    }

    /// The unknowns' factors at `p + step`, relative to p, for p and the pixels right of it.
    #[inline(always)]
    fn basis(&self, p: (isize, isize), (dx, dy): (isize, isize), basis: &mut [Lanes]) {
        let window = self.weights.window().max(1) as f32;
        basis[1] = [dx as f32 / window; LANES];
        basis[2] = [dy as f32 / window; LANES];
        for (feature, b) in self.features.iter().zip(&mut basis[BEFORE_FEATURES..]) {
            let here = lanes(feature.row(p.0, p.1, LANES), 0);
            let there = lanes(feature.row(p.0 + dx, p.1 + dy, LANES), 0);
            *b = difference(*there, *here);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filters::variance::tests::noise;

    fn mean_square(values: impl Iterator<Item = f32> + Clone) -> f32 {
        values.clone().map(|v| v * v).sum::<f32>() / values.count() as f32
    }

    #[test]
    fn what_is_linear_in_features_and_position_comes_back() {
        let (width, height) = (TILE_W + 13, TILE_H + 7);
        let n = width * height;
        let features = Planes::from_vec(2, width, height, noise(5, 2 * n, 0.5));
        let (f, g) = (features.channel(0), features.channel(1));
        let mut colour = Planes::new(3, width, height);
        for i in 0..n {
            let (x, y) = ((i % width) as f32, (i / width) as f32);
            colour.channel_mut(0)[i] = 2.0 + 3.0 * f[i];
            colour.channel_mut(1)[i] = 1.0 - g[i] + 0.01 * x;
            colour.channel_mut(2)[i] = 0.5 * f[i] + 0.25 * g[i] - 0.02 * y;
        }
        let fit = first_order(&colour, &features, &Weights::uniform(width, height, 4), false);
        let error = fit.image.data.iter().zip(&colour.data).map(|(a, b)| (a - b).abs());
        assert!(error.clone().fold(0.0, f32::max) < 5e-3, "{}", error.fold(0.0, f32::max));
    }

    #[test]
    fn influence_is_the_derivative_by_the_own_pixel() {
        let (width, height) = (12, 9);
        let n = width * height;
        let features = Planes::from_vec(1, width, height, noise(7, n, 0.5));
        let colour = Planes::from_vec(1, width, height, noise(8, n, 1.0));
        let weights = Weights::uniform(width, height, 2);
        let fit = first_order(&colour, &features, &weights, true);
        let influence = fit.influence.unwrap();
        // Pixels in the middle, on an edge and in a corner. The map is linear: any step will do.
        for i in [4 * width + 5, 3, n - 1] {
            let mut moved = colour.clone();
            moved.data[i] += 1.0;
            let after = first_order(&moved, &features, &weights, false);
            let derivative = after.image.data[i] - fit.image.data[i];
            assert!((derivative - influence.data[i]).abs() < 1e-3, "{derivative} {}", influence.data[i]);
        }
    }

    #[test]
    fn noise_is_averaged_away_and_channels_do_not_mix() {
        let (width, height) = (40, 30);
        let n = width * height;
        let colour = Planes::from_vec(3, width, height, noise(9, 3 * n, 1.0));
        let features = Planes::new(2, width, height);
        let weights = Weights::uniform(width, height, 6);
        let fit = first_order(&colour, &features, &weights, false).image;
        assert!(mean_square(fit.data.iter().copied()) < 0.06 * mean_square(colour.data.iter().copied()));
        let order = [2, 0, 1];
        let swapped = order.iter().flat_map(|&c| colour.channel(c).to_vec()).collect();
        let other =
            first_order(&Planes::from_vec(3, width, height, swapped), &features, &weights, false).image;
        for (c, from) in order.into_iter().enumerate() {
            assert_eq!(other.channel(c), fit.channel(from), "channel {c}");
        }
    }
}
