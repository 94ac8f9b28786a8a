//! NL-means weights with known noise: Rousselle, Knaus, Zwicker 2012, "Adaptive Rendering with Non-Local
//! Means Filtering".
//!
//! In: a guide image with the variance of each pixel. Out: for every pixel p and every q in the window
//! around it a weight `exp(-max(0, d))`, where d is the mean over the pixels and channels of two patches
//! of `((p - q)^2 - (var p + min(var p, var q))) / (epsilon + k^2 (var p + var q))`.

use rayon::prelude::*;

use super::padded::{Padded, TILE_H, TILE_W, inside, pad, tiles};
use crate::{
    kernels::vectorised::{self, Vectorised},
    planes::Planes,
};

/// Keeps the distance of noise-free pixels finite. Guides are to be of the order of 1.
const EPSILON: f32 = 1e-7;
/// Largest distance of a single pixel pair: one outlier must not decide over all patches it is in.
const MAX_DISTANCE: f32 = 1e4;

/// How patches are compared.
#[derive(Clone, Copy, Debug)]
pub struct Comparison {
    /// Radius of the square window.
    pub window: usize,
    /// Radius of the square patches.
    pub patch: usize,
    /// Bandwidth: the tolerance for differences, in standard deviations.
    pub k: f32,
    /// What the given variance is multiplied by to be that of the guide.
    pub variance_scale: f32,
}

/// The weights of a frame, computed tile by tile when asked for.
pub struct Weights {
    width: usize,
    height: usize,
    window: usize,
    patches: Option<Patches>,
    inside: Padded,
}

struct Patches {
    comparison: Comparison,
    guide: Vec<Padded>,
    variance: Vec<Padded>,
}

/// Working memory of one thread.
#[derive(Default)]
pub struct Scratch {
    distance: Vec<f32>,
    columns: Vec<f32>,
}

impl Weights {
    /// Weights from patches of `guide`, whose noise has `variance` (of the same shape).
    pub fn new(guide: &Planes, variance: &Planes, comparison: Comparison) -> Self {
        assert_eq!(guide.extent(), variance.extent(), "every value of the guide has a variance");
        let margin = comparison.window + comparison.patch;
        Self {
            width: guide.width,
            height: guide.height,
            window: comparison.window,
            patches: Some(Patches { comparison, guide: pad(guide, margin), variance: pad(variance, margin) }),
            inside: inside(guide.width, guide.height, margin),
        }
    }

    /// Weight 1 for every pixel of the window.
    pub fn uniform(width: usize, height: usize, window: usize) -> Self {
        Self { width, height, window, patches: None, inside: inside(width, height, window) }
    }

    /// Radius of the window.
    pub fn window(&self) -> usize {
        self.window
    }

    /// Pixels in a row and rows of the frame.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// The steps (dx, dy) from a pixel to those of its window, row by row.
    pub fn steps(&self) -> impl Iterator<Item = (isize, isize)> + use<> {
        let r = self.window as isize;
        (-r..=r).flat_map(move |dy| (-r..=r).map(move |dx| (dx, dy)))
    }

    /// The weight that each pixel p of the tile at (x, y) gives to `p + (dx, dy)`, into
    /// `TILE_H` rows of `TILE_W`; 0 where one of them is outside the frame.
    #[inline(always)]
    pub fn of_tile(
        &self,
        (x, y): (usize, usize),
        (dx, dy): (isize, isize),
        scratch: &mut Scratch,
        out: &mut [f32],
    ) {
        let (x, y) = (x as isize, y as isize);
        match &self.patches {
            Some(patches) => patches.of_tile((x, y), (dx, dy), scratch, out),
            None => out.fill(1.0),
        }
        for (i, row) in out.chunks_exact_mut(TILE_W).enumerate() {
            let y = y + i as isize;
            let (p, q) = (self.inside.row(x, y, TILE_W), self.inside.row(x + dx, y + dy, TILE_W));
            for ((w, p), q) in row.iter_mut().zip(p).zip(q) {
                *w *= p * q;
            }
        }
    }
}

impl Patches {
    #[inline(always)]
    fn of_tile(
        &self,
        (x, y): (isize, isize),
        (dx, dy): (isize, isize),
        scratch: &mut Scratch,
        out: &mut [f32],
    ) {
        let Comparison { patch, k, variance_scale: scale, .. } = self.comparison;
        let (r, side) = (patch as isize, 2 * patch + 1);
        // The distance of single pixels, over the tile and the patches that reach out of it.
        let (w, h) = (TILE_W + 2 * patch, TILE_H + 2 * patch);
        scratch.distance.clear();
        scratch.distance.resize(w * h, 0.0);
        let tolerance = k * k * scale;
        for (guide, variance) in self.guide.iter().zip(&self.variance) {
            for (i, sums) in scratch.distance.chunks_exact_mut(w).enumerate() {
                let (x, y) = (x - r, y - r + i as isize);
                let (a, b) = (guide.row(x, y, w), guide.row(x + dx, y + dy, w));
                let (va, vb) = (variance.row(x, y, w), variance.row(x + dx, y + dy, w));
                for j in 0..w {
                    let difference = a[j] - b[j];
                    let noise = scale * (va[j] + if va[j] < vb[j] { va[j] } else { vb[j] });
                    let d = (difference * difference - noise) / (EPSILON + tolerance * (va[j] + vb[j]));
                    sums[j] += if d < MAX_DISTANCE { d } else { MAX_DISTANCE };
                }
            }
        }
        // Sums over patches: columns first, then rows.
        scratch.columns.resize(w, 0.0);
        let normalise = -1.0 / (side * side * self.guide.len()) as f32;
        for (i, row) in out.chunks_exact_mut(TILE_W).enumerate() {
            scratch.columns.copy_from_slice(&scratch.distance[i * w..][..w]);
            for j in 1..side {
                let line = &scratch.distance[(i + j) * w..][..w];
                scratch.columns.iter_mut().zip(line).for_each(|(sum, d)| *sum += d);
            }
            row.copy_from_slice(&scratch.columns[..TILE_W]);
            for j in 1..side {
                row.iter_mut().zip(&scratch.columns[j..][..TILE_W]).for_each(|(sum, d)| *sum += d);
            }
            row.iter_mut().for_each(|d| *d = exp_of_negative(*d * normalise));
        }
    }
}

/// `exp(min(x, 0))` to 1e-6 relative, without a branch or call so that loops over it vectorise.
#[inline(always)]
fn exp_of_negative(x: f32) -> f32 {
    /// Adding it leaves a number rounded to an integer in the low bits.
    const ROUND: f32 = 12_582_912.0;
    // 2^t with t = x log2(e), as 2^integer * 2^fraction; below 2^-100 it is as good as 0.
    let t = x * std::f32::consts::LOG2_E;
    let t = if t < 0.0 { t } else { 0.0 };
    let t = if t > -100.0 { t } else { -100.0 };
    let rounded = t + ROUND;
    let f = (t - (rounded - ROUND)) * std::f32::consts::LN_2;
    let fraction = 1.0 + f * (1.0 + f * (0.5 + f * (1.0 / 6.0 + f * (1.0 / 24.0 + f * (1.0 / 120.0)))));
    f32::from_bits(fraction.to_bits().wrapping_add(rounded.to_bits() << 23))
}

/// Pixels of a tile.
const TILE: usize = TILE_W * TILE_H;

/// The means of one tile, compiled for the processor at hand.
struct FilterTile<'a> {
    sources: &'a [Padded],
    weights: &'a Weights,
    tile: (usize, usize),
    scratch: &'a mut Scratch,
    sums: &'a mut [f32],
}

impl Vectorised for FilterTile<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { sources, weights, tile: (x, y), scratch, sums } = self;
        let mut total = vec![0.0; TILE];
        let mut w = vec![0.0; TILE];
        for (dx, dy) in weights.steps() {
            weights.of_tile((x, y), (dx, dy), scratch, &mut w);
            total.iter_mut().zip(&w).for_each(|(t, w)| *t += w);
            for (sums, source) in sums.chunks_exact_mut(TILE).zip(sources) {
                for (i, (sums, w)) in sums.chunks_exact_mut(TILE_W).zip(w.chunks_exact(TILE_W)).enumerate() {
                    let q = source.row(x as isize + dx, y as isize + dy + i as isize, TILE_W);
                    for ((sum, w), q) in sums.iter_mut().zip(w).zip(q) {
                        *sum += w * q;
                    }
                }
            }
        }
        // A pixel of the frame has weight 1 for itself; those outside are cut off by the caller.
        for sums in sums.chunks_exact_mut(TILE) {
            sums.iter_mut().zip(&total).for_each(|(sum, t)| *sum /= t.max(f32::MIN_POSITIVE));
        }
    }
}

/// The mean of `image` over each pixel's window by `weights`: cross NL-means where their guide is
/// another image.
///
/// # Panics
/// If the weights are of another size.
pub fn filter(image: &Planes, weights: &Weights) -> Planes {
    let (width, height) = (image.width, image.height);
    assert_eq!((width, height), weights.size(), "weights are those of a frame of this size");
    let sources = pad(image, weights.window());
    let tiles = tiles(width, height);
    let filtered: Vec<Vec<f32>> = tiles
        .par_iter()
        .map_init(Scratch::default, |scratch, &tile| {
            let mut sums = vec![0.0; sources.len() * TILE];
            let sources = &sources;
            vectorised::run(FilterTile { sources, weights, tile, scratch, sums: &mut sums });
            sums
        })
        .collect();
    let mut out = Planes::new(image.channels, width, height);
    for (&(x, y), tile) in tiles.iter().zip(&filtered) {
        let (w, h) = (TILE_W.min(width - x), TILE_H.min(height - y));
        for (c, sums) in tile.chunks_exact(TILE_W * TILE_H).enumerate() {
            for (i, row) in sums.chunks_exact(TILE_W).take(h).enumerate() {
                out.channel_mut(c)[(y + i) * width + x..][..w].copy_from_slice(&row[..w]);
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filters::variance::tests::noise;

    #[test]
    fn fast_exponential_is_exact_to_a_millionth() {
        for i in 0..=6000 {
            let x = -i as f32 * 0.01;
            let (fast, exact) = (f64::from(exp_of_negative(x)), f64::from(x).exp());
            assert!((fast / exact - 1.0).abs() < 5e-6, "{x}: {fast} {exact}");
        }
        assert_eq!(exp_of_negative(3.0), 1.0);
        assert!(exp_of_negative(-1e30) < 1e-29);
    }

    /// The formula of the module's header, computed word for word.
    fn slow_weight(
        guide: &Planes,
        variance: &Planes,
        c: Comparison,
        p: (isize, isize),
        q: (isize, isize),
    ) -> f64 {
        let (w, h) = (guide.width as isize, guide.height as isize);
        let (r, s) = (c.patch as isize, f64::from(c.variance_scale));
        let (mut sum, mut n) = (0.0, 0);
        for channel in 0..guide.channels {
            for oy in -r..=r {
                for ox in -r..=r {
                    let at = |(x, y): (isize, isize)| {
                        ((y + oy).clamp(0, h - 1) * w + (x + ox).clamp(0, w - 1)) as usize
                    };
                    let value = |p| f64::from(guide.channel(channel)[at(p)]);
                    let var = |p| f64::from(variance.channel(channel)[at(p)]) * s;
                    let k2 = f64::from(c.k).powi(2);
                    sum += ((value(p) - value(q)).powi(2) - (var(p) + var(p).min(var(q))))
                        / (f64::from(EPSILON) + k2 * (var(p) + var(q)));
                    n += 1;
                }
            }
        }
        (-(sum / f64::from(n)).max(0.0)).exp()
    }

    #[test]
    fn weights_are_those_of_the_formula_up_to_the_border() {
        // Larger than a tile in both directions, and no multiple of one.
        let (width, height) = (TILE_W + 9, TILE_H + 5);
        let guide = Planes::from_vec(2, width, height, noise(1, 2 * width * height, 1.0));
        let variance = Planes::from_vec(
            2,
            width,
            height,
            noise(2, 2 * width * height, 1.0).iter().map(|v| 0.1 + v * v).collect(),
        );
        let comparison = Comparison { window: 4, patch: 2, k: 0.7, variance_scale: 2.0 };
        let weights = Weights::new(&guide, &variance, comparison);
        let mut tile = vec![0.0; TILE_W * TILE_H];
        for step in [(0, 0), (-4, 3), (2, -1)] {
            for (tx, ty) in tiles(width, height) {
                weights.of_tile((tx, ty), step, &mut Scratch::default(), &mut tile);
                for (i, &got) in tile.iter().enumerate() {
                    let p = ((tx + i % TILE_W) as isize, (ty + i / TILE_W) as isize);
                    let q = (p.0 + step.0, p.1 + step.1);
                    let within = |(x, y): (isize, isize)| {
                        (0..width as isize).contains(&x) && (0..height as isize).contains(&y)
                    };
                    let expected = if within(p) && within(q) {
                        slow_weight(&guide, &variance, comparison, p, q)
                    } else {
                        0.0
                    };
                    assert!((f64::from(got) - expected).abs() < 1e-4, "{p:?} {q:?}: {got} {expected}");
                }
            }
        }
    }

    #[test]
    fn an_edge_without_noise_is_kept_and_uniform_weights_average() {
        let (width, height) = (20, 3);
        let edge: Vec<f32> = (0..width * height).map(|i| f32::from(i % width >= 10)).collect();
        let image = Planes::from_vec(1, width, height, edge);
        let comparison = Comparison { window: 3, patch: 1, k: 0.5, variance_scale: 1.0 };
        let kept = filter(&image, &Weights::new(&image, &Planes::new(1, width, height), comparison));
        let moved = kept.data.iter().zip(&image.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(moved < 1e-20, "{moved}");
        let mean = filter(&image, &Weights::uniform(width, height, 1));
        let row = &mean.channel(0)[..width];
        assert!((row[9] - 1.0 / 3.0).abs() < 1e-6 && row[0] == 0.0 && row[19] == 1.0, "{row:?}");
    }
}
