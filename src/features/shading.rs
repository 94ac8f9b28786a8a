//! How light changes with the direction of a surface. This shows detail that only the normal holds, such as a
//! moulding on a wall of one colour.
//!
//! Around every pixel the logarithm of radiance over albedo is fitted as a linear function of the three
//! components of the normal, as in a guided filter (He et al. 2013), on squares of pixels (He and Sun 2015).
//! A slope is estimated from hundreds of noisy pixels, so it is reliable enough to draw detail one pixel
//! wide. A kernel would find only a few pixels of the same normal to average there.

use std::ops::Range;

use rayon::prelude::*;

use super::{NEEDED_BY, STEEPNESS, divisor, unit};
use crate::{
    Result,
    filters::{
        solve::{LANES, Lanes, Symmetric},
        squares::{self, SQUARE, between},
    },
    kernels::{
        logarithm::LogTransfer,
        vectorised::{self, Vectorised},
    },
    passes::{Pass, PassSet},
    planes::Planes,
};

/// Window of the fit: binomial weights of the squares on either side of one, a standard deviation of 1.4
/// squares.
const WINDOW: [f32; 9] = [1.0, 8.0, 28.0, 56.0, 70.0, 56.0, 28.0, 8.0, 1.0];

/// Ridge of the regression: this times the variance of the light is added to the variance of each component
/// of the normal, so that slopes that noise alone could explain shrink. It is 8 times 1/400, the variance of
/// a slope that the 400 pixels of a window estimate.
const RIDGE: f32 = 0.02;

/// Encoded light is clipped here, at 2.5 times middle grey: lamps and fireflies would dominate every fit
/// around them.
const BRIGHTEST: f32 = 0.75;

/// Smallest variance of the light that the ridge is computed from, so that the fit stays solvable in flat
/// areas.
const LEAST_VARIANCE: f32 = 1e-4;

/// Bound on the magnitude of what [`Shading::rows`] returns, a natural logarithm.
const LARGEST: f32 = 1.0;

/// Unknowns of the fit: a constant and a slope for each component of the normal.
const UNKNOWNS: usize = 4;

/// Values of a pixel, each stored as a line over the row: 1, the three components of the normal, and the
/// light.
const LINES: usize = UNKNOWNS + 1;

/// Sums over pixels of all products of two of these values, as a lower triangle row by row: the matrix of the
/// fit, its right-hand side, and the sum of the squared light.
const MOMENTS: usize = LINES * (LINES + 1) / 2;

/// Values kept for each square: the three slopes, and what they give for the mean normal of the window.
const KEPT: usize = UNKNOWNS;

/// The slopes of light over the normal, for every square of a frame.
pub struct Shading {
    /// Squares in a row.
    squares: usize,
    /// For each row of squares, [`KEPT`] lines of `squares` values.
    lines: Vec<f32>,
}

impl Shading {
    /// Fits the light of a whole frame, whose radiance is multiplied by `exposure`.
    ///
    /// # Errors
    /// A pass is missing.
    pub fn of(passes: &PassSet, exposure: f32) -> Result<Self> {
        let radiance = passes.require(Pass::Combined, NEEDED_BY)?;
        let normal = passes.require(Pass::DenoisingNormal, NEEDED_BY)?;
        let albedo = passes.require(Pass::DenoisingAlbedo, NEEDED_BY)?;
        let (width, squares) = (passes.width, passes.width.div_ceil(SQUARE));
        let mut moments = vec![0.0; passes.height.div_ceil(SQUARE) * MOMENTS * squares];
        moments.par_chunks_mut(MOMENTS * squares).enumerate().for_each(|(row, moments)| {
            let mut of_columns = vec![0.0; MOMENTS * width];
            let mut lines = vec![1.0; LINES * width];
            for y in SQUARE * row..(SQUARE * (row + 1)).min(passes.height) {
                let [radiance, albedo, normal] = [radiance, albedo, normal].map(|planes| planes.rows(y));
                let (lines, sums) = (&mut *lines, &mut *of_columns);
                vectorised::run(Gather { radiance, albedo, normal, exposure, lines, sums });
            }
            for (moment, of_columns) in moments.chunks_mut(squares).zip(of_columns.chunks(width)) {
                let of_squares = of_columns.chunks(SQUARE).map(|part| part.iter().sum());
                moment.iter_mut().zip(of_squares).for_each(|(moment, sum)| *moment = sum);
            }
        });
        let rows: Vec<&[f32]> = moments.chunks(MOMENTS * squares).collect();
        let mut lines = vec![0.0; rows.len() * KEPT * squares];
        let memory = || [(); 2].map(|()| vec![0.0; MOMENTS * squares]);
        lines.par_chunks_mut(KEPT * squares).enumerate().for_each_init(
            memory,
            |[of_rows, moments], (row, lines)| {
                squares::around(
                    squares::rows_around(&rows, row, &WINDOW),
                    squares,
                    &WINDOW,
                    of_rows,
                    moments,
                );
                for first in (0..squares).step_by(LANES) {
                    let part = first..(first + LANES).min(squares);
                    let kept = fit(std::array::from_fn(|k| {
                        let mut lanes = [0.0; LANES];
                        lanes[..part.len()].copy_from_slice(&moments[k * squares..][part.clone()]);
                        lanes
                    }));
                    for (line, kept) in lines.chunks_mut(squares).zip(kept) {
                        line[part.clone()].copy_from_slice(&kept[..part.len()]);
                    }
                }
            },
        );
        Ok(Self { squares, lines })
    }

    /// How much brighter than the mean of its window each pixel should be according to its normal, as a
    /// natural logarithm, for R rows of the frame: (1, R, W).
    ///
    /// # Errors
    /// A pass is missing.
    pub fn rows(&self, passes: &PassSet, rows: Range<usize>) -> Result<Planes> {
        let normal = passes.require(Pass::DenoisingNormal, NEEDED_BY)?;
        let (width, squares) = (passes.width, self.squares);
        let height = self.lines.len() / (KEPT * squares);
        let mut shading = Planes::unwritten(1, width, rows.len());
        shading.data.par_chunks_mut(width).zip(rows).for_each(|(output, y)| {
            let (above, share) = between(y, height);
            let line = |row: usize| &self.lines[row.min(height - 1) * KEPT * squares..][..KEPT * squares];
            let near = line(above).iter().zip(line(above + 1));
            let line: Vec<f32> = near.map(|(a, b)| a + (b - a) * share).collect();
            let slopes = std::array::from_fn(|k| &line[k * squares..][..squares]);
            vectorised::run(Shade { slopes, normal: normal.rows(y), output });
        });
        Ok(shading)
    }
}

/// The shading of a row of pixels.
struct Shade<'a> {
    /// The values kept for each square, interpolated vertically to this row; one line each.
    slopes: [&'a [f32]; KEPT],
    normal: [&'a [f32]; 3],
    output: &'a mut [f32],
}

impl Shade<'_> {
    /// The shading of pixel `x`, which lies `share` of the way from the centre of square `left` to that of
    /// the next.
    #[inline(always)]
    fn of(slopes: &[&[f32]; KEPT], left: usize, share: f32, normal: &[&[f32]; 3], x: usize) -> f32 {
        let right = (left + 1).min(slopes[0].len() - 1);
        let mut light = [0.0; KEPT];
        for (light, line) in light.iter_mut().zip(slopes) {
            *light = line[left] + (line[right] - line[left]) * share;
        }
        let [along_x, along_y, along_z, mean] = light;
        let [nx, ny, nz] = [unit(normal[0][x]), unit(normal[1][x]), unit(normal[2][x])];
        (along_x * nx + along_y * ny + along_z * nz - mean).clamp(-LARGEST, LARGEST)
    }
}

impl Vectorised for Shade<'_> {
    #[inline(always)]
    fn run(self) {
        const HALF: usize = SQUARE / 2;
        let Self { slopes, normal, output } = self;
        let (width, squares) = (output.len(), slopes[0].len());
        // All pixels from the centre of one square to the centre of the next are interpolated between these
        // two.
        let runs = output.get_mut(HALF..).unwrap_or_default().as_chunks_mut::<SQUARE>().0;
        let inside = HALF..HALF + SQUARE * runs.len().min(squares - 1);
        for (left, run) in runs.iter_mut().enumerate().take(squares - 1) {
            for (i, output) in run.iter_mut().enumerate() {
                let share = (i as f32 + 0.5) / SQUARE as f32;
                *output = Self::of(&slopes, left, share, &normal, inside.start + SQUARE * left + i);
            }
        }
        for x in (0..inside.start.min(width)).chain(inside.end..width) {
            let (left, share) = between(x, squares);
            output[x] = Self::of(&slopes, left, share, &normal, x);
        }
    }
}

/// What a row of pixels adds to the moments.
struct Gather<'a> {
    /// The row's colours and axes.
    radiance: [&'a [f32]; 3],
    albedo: [&'a [f32]; 3],
    normal: [&'a [f32]; 3],
    exposure: f32,
    /// Memory for [`LINES`] rows, the first of ones.
    lines: &'a mut [f32],
    /// The sums over each column, [`MOMENTS`] rows.
    sums: &'a mut [f32],
}

impl Vectorised for Gather<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { radiance, albedo, normal, exposure, lines, sums } = self;
        let width = radiance[0].len();
        let (known, light) = lines.split_at_mut(UNKNOWNS * width);
        light.fill(0.0);
        for (c, axis) in known[width..].chunks_exact_mut(width).enumerate() {
            for (sum, (v, a)) in light.iter_mut().zip(radiance[c].iter().zip(albedo[c])) {
                *sum += v.max(0.0) * exposure / (3.0 * divisor(*a));
            }
            for (axis, n) in axis.iter_mut().zip(normal[c]) {
                *axis = unit(*n);
            }
        }
        let transfer = LogTransfer::new(STEEPNESS);
        for light in light {
            *light = transfer.of(*light).min(BRIGHTEST);
        }
        let mut sums = sums.chunks_exact_mut(width);
        for i in 0..LINES {
            for j in 0..=i {
                let [a, b] = [i, j].map(|line| &lines[line * width..][..width]);
                for (sum, (a, b)) in sums.next().expect("a row for each pair").iter_mut().zip(a.iter().zip(b))
                {
                    *sum += a * b;
                }
            }
        }
    }
}

/// Solves the fit from its moments: the three slopes of the natural logarithm of light, and their value at
/// the mean normal.
fn fit(moments: [Lanes; MOMENTS]) -> [Lanes; KEPT] {
    let (matrix, rest) = moments.split_at(MOMENTS - LINES);
    let [mut solution @ .., square] = <[Lanes; LINES]>::try_from(rest).expect("the last row of a triangle");
    let (count, light): (Lanes, Lanes) = (matrix[0].map(|count| count.max(1.0)), solution[0]);
    let mean: Lanes = std::array::from_fn(|l| light[l] / count[l]);
    let variance = std::array::from_fn(|l| square[l] / count[l] - mean[l] * mean[l]);
    let mut matrix = Symmetric::of(UNKNOWNS, matrix.to_vec());
    matrix.ridge(0.0, variance.map(|v: f32| RIDGE * v.max(LEAST_VARIANCE)));
    matrix.factor();
    matrix.solve(&mut solution);
    let natural = STEEPNESS.ln_1p();
    let [constant, slopes @ ..] = solution;
    let [x, y, z] = slopes.map(|slope| slope.map(|v| v * natural));
    [x, y, z, std::array::from_fn(|l| (mean[l] - constant[l]) * natural)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::ALBEDO_FLOOR;
    use crate::rng::Rng;

    const SIZE: (usize, usize) = (70, 53);

    /// A frame of albedo 1 with random normals near +Z, whose light is e to the power of `slope` times the
    /// normal's X, times `brightness` and noise.
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
        Shading::of(passes, exposure).unwrap().rows(passes, 0..SIZE.1).unwrap()
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
        for (slope, noise) in [(0.5, 0.0), (-0.5, 0.0), (0.5, 0.4), (0.0, 0.0)] {
            let found = self::slope(&frame(slope, 0.25, noise), 1.0);
            // The transfer is linear below and logarithmic above a sixteenth.
            let steepness = STEEPNESS * 0.25 / (1.0 + ALBEDO_FLOOR);
            let want = slope * steepness / (1.0 + steepness);
            assert!(
                (found - want).abs() < 0.1 * want.abs().max(0.1),
                "{found} for {want} with noise {noise}"
            );
        }
    }

    #[test]
    fn noise_alone_has_next_to_no_shading() {
        let passes = frame(0.0, 0.25, 0.9);
        let size = shading(&passes, 1.0).data.iter().map(|v| v * v).sum::<f32>() / (SIZE.0 * SIZE.1) as f32;
        assert!(size.sqrt() < 0.05, "{}", size.sqrt());
    }

    #[test]
    fn a_firefly_changes_little() {
        let clean = frame(0.5, 0.25, 0.2);
        let mut passes = clean.clone();
        let mut radiance = passes.require(Pass::Combined, "test").unwrap().clone();
        (0..3).for_each(|c| radiance.channel_mut(c)[20 * SIZE.0 + 30] = 1e4);
        passes.insert(Pass::Combined, radiance);
        let (with, without) = (shading(&passes, 1.0), shading(&clean, 1.0));
        let worst = with.data.iter().zip(&without.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst > 0.0 && worst < 0.05, "{worst}");
    }

    #[test]
    fn radiance_and_exposure_cancel() {
        let (bright, dark) = (frame(0.7, 1.0, 0.5), frame(0.7, 0.0625, 0.5));
        let (bright, dark) = (shading(&bright, 0.25), shading(&dark, 4.0));
        assert!(bright.data.iter().any(|v| v.abs() > 0.1));
        assert!(bright.data.iter().zip(&dark.data).all(|(a, b)| (a - b).abs() < 1e-4));
    }

    #[test]
    fn parts_of_a_frame_are_those_of_the_whole() {
        let passes = frame(0.7, 1.0, 0.5);
        let whole = shading(&passes, 1.0);
        let parts = Shading::of(&passes, 1.0).unwrap();
        for rows in [0..1, 3..17, 17..53] {
            let part = parts.rows(&passes, rows.clone()).unwrap();
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
        let one = passes.window((0, 0), (SIZE.0, 1));
        let narrow = Shading::of(&one, 1.0).unwrap().rows(&one, 0..1).unwrap();
        assert!(narrow.data.iter().all(|v| v.is_finite()));
    }
}
