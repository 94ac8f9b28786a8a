//! How light changes as a surface turns: what normals alone show of it, such as a moulding on a wall of one colour.
//!
//! Around every pixel the logarithm of radiance over albedo is fitted by a plane over the three axes of the normal, as a
//! guided filter does (He et al. 2013), its moments gathered in squares of pixels (He and Sun 2015). The hundreds of noisy
//! pixels that decide on a slope so tell of detail that is one pixel wide, where kernels find but a handful of the
//! same normal to average.

use std::ops::Range;

use rayon::prelude::*;

use super::{ALBEDO_FLOOR, STEEPNESS, texture};
use crate::{
    Result,
    kernels::logarithm::log_transfer,
    passes::{Pass, PassSet},
    planes::Planes,
};

/// Rows and columns of the squares in which moments are gathered.
const SQUARE: usize = 4;

/// Weights of the squares on either side of one, binomial: a deviation of 1.4 squares.
const WINDOW: [f32; 9] = {
    let mut weights = [1.0, 8.0, 28.0, 56.0, 70.0, 56.0, 28.0, 8.0, 1.0];
    let mut i = 0;
    while i < weights.len() {
        weights[i] /= 256.0;
        i += 1;
    }
    weights
};

/// Added to the variance of each axis of the normal, in variances of the light: 8 times the variance with which
/// the 400 pixels of a window decide on a slope, by which slopes that noise alone may explain shrink.
const RIDGE: f32 = 0.02;

/// A variance of the light below which there is no noise to speak of.
const LEAST_VARIANCE: f32 = 1e-4;

/// The shading that [`Shading::rows`] gives is at most this, either way.
const LARGEST: f32 = 1.0;

/// Sums over pixels: their number, normal, light, its square, its products with the normal, and those of the normal with
/// itself.
const MOMENTS: usize = 1 + 3 + 1 + 1 + 3 + 6;

/// What is kept of each square: the mean normal around, and the slope of light over it.
const KEPT: usize = 6;

/// The slopes of light over normals, all over a frame.
pub struct Shading {
    /// Squares in a row.
    squares: usize,
    /// Of each row of squares, [`KEPT`] lines of `squares` values.
    lines: Vec<f32>,
}

impl Shading {
    /// Fits the light of a whole frame at its `exposure`.
    ///
    /// # Errors
    /// A pass is missing.
    pub fn of(passes: &PassSet, exposure: f32, needed_by: &str) -> Result<Self> {
        let radiance = passes.require(Pass::Combined, needed_by)?;
        let normal = passes.require(Pass::DenoisingNormal, needed_by)?;
        let albedo = passes.require(Pass::DenoisingAlbedo, needed_by)?;
        let squares = passes.width.div_ceil(SQUARE);
        let mut moments = vec![0.0; passes.height.div_ceil(SQUARE) * MOMENTS * squares];
        moments.par_chunks_mut(MOMENTS * squares).enumerate().for_each(|(row, moments)| {
            let (mut irradiance, mut light) = (vec![0.0; passes.width], vec![0.0; passes.width]);
            for y in SQUARE * row..(SQUARE * (row + 1)).min(passes.height) {
                irradiance.fill(0.0);
                for c in 0..3 {
                    let of = |planes: &'_ Planes| y * planes.width..(y + 1) * planes.width;
                    let (radiance, albedo) =
                        (&radiance.channel(c)[of(radiance)], &albedo.channel(c)[of(albedo)]);
                    for (sum, (v, a)) in irradiance.iter_mut().zip(radiance.iter().zip(albedo)) {
                        *sum += v.max(0.0) * exposure / (3.0 * (texture(*a) + ALBEDO_FLOOR));
                    }
                }
                log_transfer(&irradiance, STEEPNESS, &mut light);
                let normal = [0, 1, 2].map(|c| &normal.channel(c)[y * passes.width..][..passes.width]);
                gather(&light, normal, moments, squares);
            }
        });
        let around = columns(&rows(&moments, MOMENTS * squares), squares);
        let mut lines = vec![0.0; around.len() / MOMENTS * KEPT];
        lines.par_chunks_mut(KEPT * squares).zip(around.par_chunks(MOMENTS * squares)).for_each(
            |(lines, moments)| {
                for x in 0..squares {
                    let kept = fit(std::array::from_fn(|k| moments[k * squares + x]));
                    kept.into_iter().enumerate().for_each(|(k, v)| lines[k * squares + x] = v);
                }
            },
        );
        Ok(Self { squares, lines })
    }

    /// By how much, as a logarithm, the light of each pixel of some rows of the frame should differ from that around by its
    /// normal, (1, R, W).
    ///
    /// # Errors
    /// A pass is missing.
    pub fn rows(&self, passes: &PassSet, rows: Range<usize>, needed_by: &str) -> Result<Planes> {
        let normal = passes.require(Pass::DenoisingNormal, needed_by)?;
        let height = self.lines.len() / (KEPT * self.squares);
        let columns: Vec<_> = (0..passes.width).map(|x| between(x, self.squares)).collect();
        let mut shading = Planes::new(1, passes.width, rows.len());
        shading.data.par_chunks_mut(passes.width).zip(rows).for_each(|(output, y)| {
            let (above, share) = between(y, height);
            let line =
                |row: usize| &self.lines[row.min(height - 1) * KEPT * self.squares..][..KEPT * self.squares];
            let near = line(above).iter().zip(line(above + 1));
            let line: Vec<f32> = near.map(|(a, b)| a + (b - a) * share).collect();
            let normal = [0, 1, 2].map(|c| &normal.channel(c)[y * passes.width..][..passes.width]);
            for (x, (output, (left, share))) in output.iter_mut().zip(&columns).enumerate() {
                let at = |k: usize| {
                    let line = &line[k * self.squares..][..self.squares];
                    let (a, b) = (line[*left], line[(left + 1).min(self.squares - 1)]);
                    a + (b - a) * share
                };
                let light: f32 = (0..3).map(|k| at(3 + k) * (unit(normal[k][x]) - at(k))).sum();
                *output = light.clamp(-LARGEST, LARGEST);
            }
        });
        Ok(shading)
    }
}

/// An axis of a normal; what filters and depth of field make of one is not longer.
fn unit(axis: f32) -> f32 {
    axis.clamp(-1.0, 1.0)
}

/// The square before a pixel, counted from middle to middle, and how far on towards the next it is.
fn between(at: usize, squares: usize) -> (usize, f32) {
    let place = ((at as f32 + 0.5) / SQUARE as f32 - 0.5).clamp(0.0, (squares - 1) as f32);
    (place as usize, place.fract())
}

/// Adds a row of pixels to the moments of their squares.
fn gather(light: &[f32], normal: [&[f32]; 3], moments: &mut [f32], squares: usize) {
    for (square, light) in light.chunks(SQUARE).enumerate() {
        for (i, light) in light.iter().enumerate() {
            let [a, b, c] = normal.map(|axis| unit(axis[SQUARE * square + i]));
            let p = *light;
            let of_pixel =
                [1.0, a, b, c, p, p * p, p * a, p * b, p * c, a * a, a * b, b * b, a * c, b * c, c * c];
            of_pixel.into_iter().enumerate().for_each(|(k, v)| moments[k * squares + square] += v);
        }
    }
}

/// Every value of lines of `len` values, weighted with those above and below.
fn rows(values: &[f32], len: usize) -> Vec<f32> {
    let mut output = vec![0.0; values.len()];
    output.par_chunks_mut(len).enumerate().for_each(|(row, output)| {
        for (weight, from) in WINDOW.iter().zip(row as isize - 4..) {
            let Some(line) = usize::try_from(from).ok().and_then(|from| values.chunks(len).nth(from)) else {
                continue;
            };
            output.iter_mut().zip(line).for_each(|(sum, v)| *sum += weight * v);
        }
    });
    output
}

/// Every value of lines of `len` values, weighted with those to the left and right.
fn columns(values: &[f32], len: usize) -> Vec<f32> {
    let mut output = vec![0.0; values.len()];
    output.par_chunks_mut(len).zip(values.par_chunks(len)).for_each(|(output, line)| {
        for (weight, shift) in WINDOW.iter().zip(-4isize..) {
            let (to, from) = (shift.min(0).unsigned_abs().min(len), shift.max(0).unsigned_abs().min(len));
            output[to..].iter_mut().zip(&line[from..]).for_each(|(sum, v)| *sum += weight * v);
        }
    });
    output
}

/// The mean normal and the slope of light over it, as a natural logarithm, from sums of moments.
fn fit(sums: [f32; MOMENTS]) -> [f32; KEPT] {
    let count = sums[0];
    let [_, a, b, c, p, pp, pa, pb, pc, aa, ab, bb, ac, bc, cc] = sums.map(|sum| sum / count);
    let ridge = RIDGE * (pp - p * p).max(LEAST_VARIANCE);
    let covariance = [pa - p * a, pb - p * b, pc - p * c];
    // Cholesky's factors, row by row.
    let root = |v: f32| v.max(ridge).sqrt();
    let l00 = root(aa - a * a + ridge);
    let (l10, l20) = ((ab - a * b) / l00, (ac - a * c) / l00);
    let l11 = root(bb - b * b + ridge - l10 * l10);
    let l21 = (bc - b * c - l20 * l10) / l11;
    let l22 = root(cc - c * c + ridge - l20 * l20 - l21 * l21);
    let x = covariance[0] / l00;
    let y = (covariance[1] - l10 * x) / l11;
    let z = (covariance[2] - l20 * x - l21 * y) / l22 / l22;
    let y = (y - l21 * z) / l11;
    let x = (x - l10 * y - l20 * z) / l00;
    let unit = STEEPNESS.ln_1p();
    [a, b, c, x * unit, y * unit, z * unit]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::Rng;

    const SIZE: (usize, usize) = (70, 53);

    /// A frame of albedo 1 with random normals near +Z, whose light is e to the power of `slope` times the normal's X, times
    /// `brightness` and noise.
    fn frame(slope: f32, brightness: f32, noise: f32) -> PassSet {
        let (w, h) = SIZE;
        let rng = &mut Rng::new(3, 0);
        let mut passes = PassSet::new(std::path::Path::new("frame.exr"), "ViewLayer", w, h);
        let mut normal = Planes::new(3, w, h);
        let mut radiance = Planes::new(3, w, h);
        for at in 0..w * h {
            let x = rng.uniform() - 0.5;
            normal.channel_mut(0)[at] = x;
            normal.channel_mut(2)[at] = (1.0 - x * x).sqrt();
            let light = brightness * (slope * x).exp() * (1.0 + noise * (2.0 * rng.uniform() - 1.0));
            (0..3).for_each(|c| radiance.channel_mut(c)[at] = light);
        }
        passes.insert(Pass::Combined, radiance);
        passes.insert(Pass::DenoisingNormal, normal);
        passes.insert(Pass::DenoisingAlbedo, Planes::from_vec(3, w, h, vec![1.0; 3 * w * h]));
        passes
    }

    fn shading(passes: &PassSet, exposure: f32) -> Planes {
        Shading::of(passes, exposure, "test").unwrap().rows(passes, 0..SIZE.1, "test").unwrap()
    }

    /// The slope of shading over the normal's X.
    fn slope(passes: &PassSet, exposure: f32) -> f32 {
        let shading = shading(passes, exposure);
        let x = passes.require(Pass::DenoisingNormal, "test").unwrap().channel(0);
        let products: f32 = shading.data.iter().zip(x).map(|(s, x)| s * x).sum();
        products / x.iter().map(|x| x * x).sum::<f32>()
    }

    #[test]
    fn finds_the_slope_of_light_over_normals_and_through_noise() {
        // Brighter than the bend of the logarithm, where slopes are those of the light.
        for (want, noise) in [(0.5, 0.0), (-0.5, 0.0), (0.5, 0.9), (0.0, 0.0)] {
            let found = slope(&frame(want, 4.0, noise), 1.0);
            assert!(
                (found - want).abs() < 0.15 * want.abs().max(0.1),
                "{found} for {want} with noise {noise}"
            );
        }
    }

    #[test]
    fn noise_alone_has_next_to_no_shading() {
        let passes = frame(0.0, 4.0, 0.9);
        let size = shading(&passes, 1.0).data.iter().map(|v| v * v).sum::<f32>() / (SIZE.0 * SIZE.1) as f32;
        assert!(size.sqrt() < 0.05, "{}", size.sqrt());
    }

    #[test]
    fn radiance_and_exposure_cancel() {
        let (bright, dark) = (frame(0.7, 4.0, 0.5), frame(0.7, 0.25, 0.5));
        let (bright, dark) = (shading(&bright, 0.25), shading(&dark, 4.0));
        assert!(bright.data.iter().zip(&dark.data).all(|(a, b)| (a - b).abs() < 1e-4));
    }

    #[test]
    fn parts_of_a_frame_are_those_of_the_whole() {
        let passes = frame(0.7, 1.0, 0.5);
        let whole = shading(&passes, 1.0);
        let parts = Shading::of(&passes, 1.0, "test").unwrap();
        for rows in [0..1, 3..17, 17..53] {
            let part = parts.rows(&passes, rows.clone(), "test").unwrap();
            assert_eq!(part.data, whole.data[rows.start * SIZE.0..rows.end * SIZE.0]);
        }
    }

    #[test]
    fn black_flat_and_tiny_frames_have_none() {
        let mut passes = frame(0.7, 0.0, 0.0);
        assert!(shading(&passes, 1.0).data.iter().all(|v| *v == 0.0));
        let flat = Planes::from_vec(3, SIZE.0, SIZE.1, vec![0.577; 3 * SIZE.0 * SIZE.1]);
        passes = frame(0.7, 1.0, 0.5);
        passes.insert(Pass::DenoisingNormal, flat);
        assert!(shading(&passes, 1.0).data.iter().all(|v| v.abs() < 1e-3));
        let one = passes.rows(&[Pass::Combined, Pass::DenoisingNormal, Pass::DenoisingAlbedo], 0..1);
        let narrow = Shading::of(&one, 1.0, "test").unwrap().rows(&one, 0..1, "test").unwrap();
        assert!(narrow.data.iter().all(|v| v.is_finite()));
    }
}
