//! The refit: local regression that corrects a denoised frame by its guides and its noisy samples.
//!
//! A network blurs some of the texture that the albedo does not explain, and leaves blotches on even walls.
//! Around every pixel and for each colour, two linear functions of the clean guides (the three components of
//! the normal and the logarithms of the three albedo channels) are fitted, in windows of some two hundred
//! pixels:
//!
//! - The *missed slopes*, fitted to noisy radiance over denoised radiance: if that ratio follows a guide, the
//!   network blurred something, and its slope is added. This is regression over features (Bitterli et al.
//!   2016).
//! - The *smooth part*, fitted to the logarithm of the denoised radiance over albedo. Where the result varies
//!   little beside that fit, the rest is taken for blotches and the result moves to the fit: a guided filter
//!   (He et al. 2013).
//!
//! Moments are gathered over squares of 4x4 pixels, and fits interpolated between their centres. In: exposed
//! denoised radiance, (3, H, W), guides and samples. Out: a factor for each value of it.

use std::{collections::VecDeque, ops::Range};

use rayon::prelude::*;

use super::{
    solve::{LANES, Lanes, Symmetric},
    squares::{self, SQUARE, between},
};
use crate::{
    kernels::{
        exponential::exp,
        logarithm::ln,
        thirds,
        vectorised::{self, Vectorised},
    },
    planes::Planes,
};

/// Window of a fit: binomial weights of the squares on either side of one, a standard deviation of one
/// square.
const WINDOW: [f32; 5] = [1.0, 4.0, 6.0, 4.0, 1.0];

/// Effective number of pixels of a window per unit of summed weight: `(sum w)^2 / sum w^2` over `sum w`.
const PIXELS: f32 = 256.0 / (70.0 * 70.0);

/// Guides: the three components of the normal, and the logarithms of the three albedo channels.
const GUIDES: usize = 6;

/// Regressors of a fit: a constant 1 and the guides.
const KNOWN: usize = GUIDES + 1;

const COLOURS: usize = 3;

/// Targets of the fits: for each colour the logarithm of denoised light, then for each colour samples over
/// denoised light.
const TARGETS: usize = 2 * COLOURS;

/// Moments of a window, as weighted sums over its pixels: all products of two regressors, as a lower triangle
/// row by row; then for each target its products with the regressors, and its square.
const MOMENTS: usize = KNOWN * (KNOWN + 1) / 2 + TARGETS * (KNOWN + 1);

/// Values kept for each square, [`KNOWN`] + 1 for each colour: constant and slopes of the logarithm of its
/// factor over the guides, and the (negative) slope over the logarithm of the denoised light itself, which
/// removes blotches.
const KEPT: usize = COLOURS * (KNOWN + 1);

/// Added to the variance of each guide: its remaining noise, and variation too small to explain anything.
const GUIDE_NOISE: [f32; GUIDES] = [1e-5, 1e-5, 1e-5, 2e-4, 2e-4, 2e-4];

/// Expected standard deviation of missed slopes, a prior: slopes that noise alone could explain are shrunk
/// towards zero.
const SLOPE: f32 = 0.5;

/// Standard deviation of a network's blotches, as a logarithm: variation beside the fit that is smaller is
/// smoothed away.
const BLOTCHES: f32 = 0.09;

/// Variance of samples over denoised light at which blotches are that large; with less noise they are taken
/// to be smaller.
const NOISY: f32 = 0.1;

/// Added to samples and to denoised light (exposed radiance over albedo) before one is divided by the other,
/// and to denoised light before its logarithm: below these, relative errors count less and less.
const SAMPLE_FLOOR: f32 = 0.3;
const FLOOR: f32 = 0.007;

/// A sample counts as at most this many times the denoised light: fireflies would dominate every fit around
/// them.
const MOST: f32 = 2.0;

/// Light (exposed radiance over albedo, mean of the colours; this is 8 times middle grey) above which a
/// pixel's weight falls: lamps tell nothing about the walls around them.
const BRIGHT: f32 = 1.5;

/// Bound on the logarithm of a factor, either way.
const LARGEST: f32 = 0.7;

/// A window whose summed weight is no more than this lies beyond the frame or holds only lamps: nothing is
/// fitted.
const LEAST_COUNT: f32 = 1e-2;

/// Lower bounds of the variance of samples over denoised light, and of their mean.
const LEAST_NOISE: f32 = 1e-3;
const LEAST_LEVEL: f32 = 0.3;

/// The clean guides of a frame.
#[derive(Clone, Copy)]
pub struct Guides<'a> {
    /// Columns and rows.
    pub size: (usize, usize),
    /// The denoised normal, for the same R rows as the albedo, (3, R, W).
    pub normal: &'a [f32],
    /// The divisor of radiance that the denoised albedo gives, for R rows from `first` on, (3, R, W).
    pub albedo: &'a [f32],
    /// The row of the frame at which these rows begin.
    pub first: usize,
}

/// Noisy radiance.
#[derive(Clone, Copy)]
pub enum Samples<'a> {
    /// Exposed and divided by the albedo, for the rows of the guides, (3, R, W).
    Divided(&'a [f32]),
    /// As rendered, (3, H, W) or wider; the column of it at which the guides begin; and the exposure to
    /// apply.
    Rendered(&'a Planes, usize, f32),
}

impl Guides<'_> {
    /// Row `y` of the frame in planes that hold rows from `first` on, (3, R, W).
    #[inline(always)]
    fn row<'p>(&self, planes: &'p [f32], y: usize) -> [&'p [f32]; 3] {
        let (width, plane) = (self.size.0, planes.len() / 3);
        [0, 1, 2].map(|c| &planes[c * plane + (y - self.first) * width..][..width])
    }
}

impl Samples<'_> {
    /// Row `y` of the frame.
    #[inline(always)]
    fn row(&self, guides: &Guides, y: usize) -> [&[f32]; 3] {
        match self {
            Self::Divided(values) => guides.row(values, y),
            Self::Rendered(planes, column, _) => {
                [0, 1, 2].map(|c| &planes.channel(c)[y * planes.width + column..][..guides.size.0])
            }
        }
    }
}

/// A refit that follows the denoising down a frame, and keeps only the moments and fits that windows still
/// need.
pub struct Refit {
    squares: usize,
    square_rows: usize,
    /// Number of the first row of squares whose moments are kept, and [`MOMENTS`] lines of `squares` values
    /// for each row.
    moments: (usize, VecDeque<Vec<f32>>),
    /// The same for fits, [`KEPT`] lines for each row of squares.
    fits: (usize, VecDeque<Vec<f32>>),
    /// Rows of pixels whose factors have been applied.
    done: usize,
}

impl Refit {
    /// How far, in pixels, a factor depends on what is to either side: it is interpolated between two
    /// squares, whose windows reach further.
    pub const REACH: usize = (WINDOW.len() / 2 + 1) * SQUARE;

    /// A refit of a frame of `width` columns and `height` rows.
    pub fn new((width, height): (usize, usize)) -> Self {
        let [squares, square_rows] = [width, height].map(|n| n.div_ceil(SQUARE));
        Self { squares, square_rows, moments: Default::default(), fits: Default::default(), done: 0 }
    }

    /// Rows of pixels that are finished: neither they nor their guides are needed again.
    pub fn done(&self) -> usize {
        self.done
    }

    /// Calls `change` with each value of the exposed denoised `image`, which holds the rows of the guides,
    /// (3, R, W), and the factor to multiply it by. The first `rows` rows of the frame have been denoised so
    /// far; rows whose windows they complete are changed, and each row once. `samples` is the noisy frame.
    pub fn advance(
        &mut self,
        guides: Guides,
        image: &mut [f32],
        samples: Samples,
        rows: usize,
        change: impl Fn(&mut f32, f32) + Sync,
    ) {
        let (squares, reach) = (self.squares, WINDOW.len() / 2);
        let (first, moments) = &mut self.moments;
        let gathered = *first + moments.len();
        let end = if rows == guides.size.1 { self.square_rows } else { rows / SQUARE };
        let read = &*image;
        let new = (gathered..end.max(gathered)).into_par_iter().map_init(
            || Pixels::new(squares),
            |pixels, row| {
                let mut sums = vec![0.0; MOMENTS * squares];
                for y in SQUARE * row..(SQUARE * (row + 1)).min(guides.size.1) {
                    let (pixels, sums) = (&mut *pixels, &mut sums[..]);
                    vectorised::run(Gather { guides, image: read, samples, y, pixels, sums });
                }
                sums
            },
        );
        moments.extend(new.collect::<Vec<_>>());

        let end = *first + moments.len();
        let end = if end == self.square_rows { end } else { end.saturating_sub(reach) };
        let (first_fit, fits) = &mut self.fits;
        let fitted = *first_fit + fits.len();
        let new = (fitted..end.max(fitted)).into_par_iter().map_init(
            || [(); 2].map(|()| vec![0.0; MOMENTS * squares]),
            |[of_rows, around], row| {
                let near = |tap: usize| moments.get((row + tap).checked_sub(reach + *first)?);
                let lines =
                    WINDOW.iter().enumerate().filter_map(|(tap, weight)| Some((*weight, &near(tap)?[..])));
                let mut fits = vec![0.0; KEPT * squares];
                squares::around(lines, squares, &WINDOW, of_rows, around);
                vectorised::run(FitRow { moments: around, fits: &mut fits, squares });
                fits
            },
        );
        fits.extend(new.collect::<Vec<_>>());

        // Fits are interpolated between the centres of two squares, so the last half square has to wait.
        let end = match *first_fit + fits.len() {
            end if end == self.square_rows => guides.size.1,
            end if end > 1 => SQUARE * end - SQUARE / 2,
            _ => 0,
        };
        let rows = self.done..end.max(self.done);
        self.each_row(guides, image, rows.clone(), |row, factor| change(row, factor));
        self.done = rows.end;
        let (first, moments) = &mut self.moments;
        let (first_fit, fits) = &mut self.fits;
        let unused = (*first_fit + fits.len()).saturating_sub(reach).saturating_sub(*first);
        moments.drain(..unused.min(moments.len()));
        *first += unused;
        let unused = between(self.done, self.square_rows).0.saturating_sub(*first_fit);
        fits.drain(..unused);
        *first_fit += unused;
    }

    /// Calls `change` with each value of some rows and its factor.
    fn each_row(
        &self,
        guides: Guides,
        image: &mut [f32],
        rows: Range<usize>,
        change: impl Fn(&mut f32, f32) + Sync,
    ) {
        let width = guides.size.0;
        let held = (rows.start - guides.first) * width..(rows.end - guides.first) * width;
        let [red, green, blue] = thirds(image).map(|plane| plane[held.clone()].par_chunks_mut(width));
        let memory = || Memory {
            pixels: Pixels::new(self.squares),
            fit: vec![0.0; KEPT * (self.squares + 2)],
            factors: [(); COLOURS].map(|()| vec![0.0; SQUARE * self.squares]),
        };
        let colours = red.zip(green).zip(blue).zip(rows);
        colours.for_each_init(memory, |memory, (((red, green), blue), y)| {
            self.find(guides, [red, green, blue], y, memory);
            for (row, factors) in [red, green, blue].into_iter().zip(&memory.factors) {
                interleave(factors, self.squares, row, &change);
            }
        });
    }

    /// Computes the factors of row `y`, whose three colours are `image`, into `memory`.
    fn find(&self, guides: Guides, image: [&[f32]; 3], y: usize, memory: &mut Memory) {
        let (above, share) = between(y, self.square_rows);
        let (first, fits) = &self.fits;
        let near = [above, (above + 1).min(self.square_rows - 1)].map(|row| &fits[row - first][..]);
        vectorised::run(Factors { guides, image, y, near, share, memory });
    }
}

/// Scratch memory of a thread for the factors of a row.
struct Memory {
    pixels: Pixels,
    /// The fits interpolated vertically to that row, with one square more on either side.
    fit: Vec<f32>,
    /// The factors, for each colour.
    factors: [Vec<f32>; COLOURS],
}

/// Regressors, targets and weights of a row of pixels. A line holds the first pixel of every square, then the
/// second of every square, and so on, so that loops over squares read neighbouring values.
struct Pixels {
    squares: usize,
    /// The regressors: [`KNOWN`] lines.
    known: Vec<f32>,
    targets: Vec<f32>,
    /// The weight of each pixel in the fits.
    weight: Vec<f32>,
    /// Denoised light (exposed radiance over albedo) of each colour.
    light: Vec<f32>,
    /// The divisor of each colour, and a spare line.
    albedo: Vec<f32>,
    spare: Vec<f32>,
}

impl Pixels {
    fn new(squares: usize) -> Self {
        let len = SQUARE * squares;
        let line = |count: usize, value: f32| vec![value; count * len];
        Self {
            squares,
            known: line(KNOWN, 1.0),
            targets: line(TARGETS, 0.0),
            weight: line(1, 0.0),
            light: line(COLOURS, 0.0),
            albedo: line(COLOURS, 1.0),
            spare: line(1, 0.0),
        }
    }

    /// Reads row `y`: weights, guides, and the logarithms of the denoised light, which are the first
    /// [`COLOURS`] targets.
    #[inline(always)]
    fn read(&mut self, guides: Guides, image: [&[f32]; 3], y: usize) {
        let len = SQUARE * self.squares;
        let width = guides.size.0;
        for (c, row) in guides.row(guides.normal, y).into_iter().enumerate() {
            part(row, self.squares, &mut self.known[(1 + c) * len..][..len]);
        }
        for (c, row) in guides.row(guides.albedo, y).into_iter().enumerate() {
            let albedo = &mut self.albedo[c * len..][..len];
            part(row, self.squares, albedo);
            let logarithms = &mut self.known[(4 + c) * len..][..len];
            logarithms.iter_mut().zip(albedo).for_each(|(logarithm, a)| *logarithm = ln(*a));
        }
        let line = &mut self.spare[..len];
        let of_colours = self.light.chunks_exact_mut(len).zip(self.albedo.chunks_exact(len));
        for (row, (light, albedo)) in image.into_iter().zip(of_colours) {
            part(row, self.squares, line);
            for (light, (v, a)) in light.iter_mut().zip(line.iter().zip(albedo)) {
                *light = v.max(0.0) / a;
            }
        }
        let [red, green, blue] = [0, 1, 2].map(|c| &self.light[c * len..][..len]);
        for (i, weight) in self.weight.iter_mut().enumerate() {
            let light = (red[i] + green[i] + blue[i]) * (1.0 / 3.0);
            let square = (light * (1.0 / BRIGHT)) * (light * (1.0 / BRIGHT));
            *weight = 1.0 / (1.0 + square * square);
        }
        for (target, light) in self.targets.iter_mut().zip(&self.light) {
            *target = ln(light + FLOOR);
        }
        // Pixels of the last square that lie beyond the frame have no weight.
        for beyond in width..len {
            self.weight[beyond % SQUARE * self.squares + beyond / SQUARE] = 0.0;
        }
    }

    /// Reads samples over denoised light, the other targets. `read` has to come before.
    #[inline(always)]
    fn read_samples(&mut self, guides: Guides, samples: Samples, y: usize) {
        let len = SQUARE * self.squares;
        let line = &mut self.spare[..len];
        for c in 0..COLOURS {
            let [albedo, light] = [&self.albedo, &self.light].map(|planes| &planes[c * len..][..len]);
            let target = &mut self.targets[(COLOURS + c) * len..][..len];
            part(samples.row(&guides, y)[c], self.squares, line);
            if let Samples::Rendered(_, _, exposure) = samples {
                line.iter_mut().zip(albedo).for_each(|(v, a)| *v = v.max(0.0) * exposure / a);
            }
            for (target, (sample, light)) in target.iter_mut().zip(line.iter().zip(light)) {
                *target = ((sample + SAMPLE_FLOOR) / (light + SAMPLE_FLOOR)).min(MOST);
            }
        }
    }
}

/// Writes a row of pixels in the order of a line of [`Pixels`]. Places beyond the row keep their value.
#[inline(always)]
fn part(row: &[f32], squares: usize, line: &mut [f32]) {
    let (whole, rest) = row.as_chunks::<SQUARE>();
    let [first, second, third, fourth] = [0, 1, 2, 3].map(|n| n * squares);
    for (s, square) in whole.iter().enumerate() {
        line[first + s] = square[0];
        line[second + s] = square[1];
        line[third + s] = square[2];
        line[fourth + s] = square[3];
    }
    for (n, v) in rest.iter().enumerate() {
        line[n * squares + whole.len()] = *v;
    }
}

/// Calls `work` with each pixel of a row and its value in a line of [`Pixels`]: the inverse order of
/// [`part`].
#[inline(always)]
fn interleave(line: &[f32], squares: usize, row: &mut [f32], work: impl Fn(&mut f32, f32)) {
    for (s, square) in row.chunks_mut(SQUARE).enumerate() {
        square.iter_mut().enumerate().for_each(|(n, pixel)| work(pixel, line[n * squares + s]));
    }
}

/// Adds a row of pixels to the moments of its squares.
struct Gather<'a> {
    guides: Guides<'a>,
    image: &'a [f32],
    samples: Samples<'a>,
    y: usize,
    pixels: &'a mut Pixels,
    /// [`MOMENTS`] lines of squares.
    sums: &'a mut [f32],
}

impl Vectorised for Gather<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { guides, image, samples, y, pixels, sums } = self;
        pixels.read(guides, guides.row(image, y), y);
        pixels.read_samples(guides, samples, y);
        let Pixels { squares, known, targets, weight, spare, .. } = pixels;
        let len = SQUARE * *squares;
        let weighted = &mut spare[..len];
        let mut sums = sums.chunks_exact_mut(*squares);
        for i in 0..KNOWN {
            scale(weight, &known[i * len..][..len], weighted);
            for line in known.chunks_exact(len).take(i + 1) {
                add_products(weighted, line, sums.next().expect("a line for each pair"));
            }
        }
        for target in targets.chunks_exact(len) {
            scale(weight, target, weighted);
            for line in known.chunks_exact(len) {
                add_products(weighted, line, sums.next().expect("a line for each pair"));
            }
            add_products(weighted, target, sums.next().expect("a line for each square"));
        }
    }
}

/// Writes `weight` times each value.
#[inline(always)]
fn scale(weight: &[f32], values: &[f32], output: &mut [f32]) {
    output.iter_mut().zip(weight.iter().zip(values)).for_each(|(output, (w, v))| *output = w * v);
}

/// Adds to each square's sum the products `a * b` of its four pixels in this row.
#[inline(always)]
fn add_products(a: &[f32], b: &[f32], sums: &mut [f32]) {
    let n = sums.len();
    let [a0, a1, a2, a3] = [0, 1, 2, 3].map(|i| &a[i * n..][..n]);
    let [b0, b1, b2, b3] = [0, 1, 2, 3].map(|i| &b[i * n..][..n]);
    for s in 0..n {
        sums[s] += (a0[s] * b0[s] + a1[s] * b1[s]) + (a2[s] * b2[s] + a3[s] * b3[s]);
    }
}

/// Solves the fits of every square of a row.
struct FitRow<'a> {
    /// [`MOMENTS`] lines of `squares` values.
    moments: &'a [f32],
    /// [`KEPT`] such lines, to be written.
    fits: &'a mut [f32],
    squares: usize,
}

impl Vectorised for FitRow<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { moments, fits, squares } = self;
        for first in (0..squares).step_by(LANES) {
            let part = first..(first + LANES).min(squares);
            let mut lanes = [[0.0; LANES]; MOMENTS];
            for (lanes, line) in lanes.iter_mut().zip(moments.chunks_exact(squares)) {
                lanes[..part.len()].copy_from_slice(&line[part.clone()]);
            }
            for (line, kept) in fits.chunks_exact_mut(squares).zip(fit(&lanes)) {
                line[part.clone()].copy_from_slice(&kept[..part.len()]);
            }
        }
    }
}

/// `f(lane)` for each lane.
#[inline(always)]
fn each(f: impl Fn(usize) -> f32) -> Lanes {
    let mut lanes = [0.0; LANES];
    for (l, lane) in lanes.iter_mut().enumerate() {
        *lane = f(l);
    }
    lanes
}

/// Solves the fits of [`LANES`] squares, one in each lane, from their windows' moments; the result is what
/// [`KEPT`] says.
#[inline(always)]
fn fit(moments: &[Lanes; MOMENTS]) -> [Lanes; KEPT] {
    let (of_guides, of_targets) = moments.split_at(KNOWN * (KNOWN + 1) / 2);
    let count = of_guides[0];
    let inverse = each(|l| if count[l] > LEAST_COUNT { 1.0 / count[l] } else { 0.0 });
    let covariance = |sum: &Lanes, a: &Lanes, b: &Lanes| each(|l| sum[l] * inverse[l] - a[l] * b[l]);
    let mut means = [[0.0; LANES]; GUIDES];
    let mut covariances = Vec::with_capacity(GUIDES * (GUIDES + 1) / 2);
    let mut row = 1;
    for i in 0..GUIDES {
        means[i] = each(|l| of_guides[row][l] * inverse[l]);
        for j in 0..=i {
            let noise = if i == j { GUIDE_NOISE[i] } else { 0.0 };
            let found = covariance(&of_guides[row + 1 + j], &means[i], &means[j]);
            covariances.push(each(|l| found[l].max(if i == j { 0.0 } else { f32::MIN }) + noise));
        }
        row += i + 2;
    }
    let mut targets = [([0.0; LANES], [[0.0; LANES]; GUIDES], [0.0; LANES]); TARGETS];
    for ((mean, with, variance), sums) in targets.iter_mut().zip(of_targets.chunks_exact(KNOWN + 1)) {
        *mean = each(|l| sums[0][l] * inverse[l]);
        for i in 0..GUIDES {
            with[i] = covariance(&sums[1 + i], &means[i], mean);
        }
        let found = covariance(&sums[KNOWN], mean, mean);
        *variance = each(|l| found[l].max(0.0));
    }
    let (denoised, samples) = targets.split_at(COLOURS);

    // Missed slopes are found by ridge regression: the ridge is the variance of a slope that this many noisy
    // samples estimate, relative to the prior variance of slopes.
    let noise = each(|l| samples.iter().map(|(_, _, noise)| noise[l]).sum::<f32>() * (1.0 / COLOURS as f32));
    let doubt = each(|l| noise[l].max(LEAST_NOISE) / ((PIXELS * SLOPE * SLOPE) * count[l].max(LEAST_COUNT)));
    let mut doubted = covariances.clone();
    let mut diagonal = 0;
    for i in 0..GUIDES {
        doubted[diagonal] = each(|l| doubted[diagonal][l] + doubt[l]);
        diagonal += i + 2;
    }
    let mut doubted = Symmetric::of(GUIDES, doubted);
    doubted.factor();
    let mut plain = Symmetric::of(GUIDES, covariances);
    plain.factor();
    let blotches = each(|l| BLOTCHES * BLOTCHES * (noise[l].max(LEAST_NOISE) * (1.0 / NOISY)).min(1.0));
    let mut kept = [[0.0; LANES]; KEPT];
    for ((kept, (mean, with, variance)), (level, missed, _)) in
        kept.chunks_exact_mut(KNOWN + 1).zip(denoised).zip(samples)
    {
        let (mut missed, mut smooth) = (*missed, *with);
        doubted.solve(&mut missed);
        plain.solve(&mut smooth);
        let mut rest = *variance;
        for i in 0..GUIDES {
            rest = each(|l| rest[l] - smooth[i][l] * with[i][l]);
        }
        let given = each(|l| {
            let share = blotches[l] / (rest[l].max(0.0) + blotches[l]);
            if inverse[l] > 0.0 { share } else { 0.0 }
        });
        let mut constant = each(|l| given[l] * mean[l]);
        for i in 0..GUIDES {
            // The missed slopes are a fit themselves, so smoothing takes nothing of them away.
            kept[1 + i] = each(|l| given[l] * smooth[i][l] + missed[i][l] / level[l].max(LEAST_LEVEL));
            constant = each(|l| constant[l] - kept[1 + i][l] * means[i][l]);
        }
        kept[0] = constant;
        kept[KNOWN] = given.map(|share| -share);
    }
    kept
}

/// Computes the factors of a row of pixels.
struct Factors<'a> {
    guides: Guides<'a>,
    image: [&'a [f32]; 3],
    y: usize,
    /// The fits of the rows of squares above and below, and how far (0..1) the row lies from the former to
    /// the latter.
    near: [&'a [f32]; 2],
    share: f32,
    memory: &'a mut Memory,
}

impl Vectorised for Factors<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { guides, image, y, near: [above, below], share, memory } = self;
        let Memory { pixels, fit, factors } = memory;
        pixels.read(guides, image, y);
        let Pixels { squares, known, targets, weight, .. } = pixels;
        let (squares, len) = (*squares, SQUARE * *squares);
        let lines = above.chunks_exact(squares).zip(below.chunks_exact(squares));
        for (fit, (above, below)) in fit.chunks_exact_mut(squares + 2).zip(lines) {
            for (fit, (a, b)) in fit[1..].iter_mut().zip(above.iter().zip(below)) {
                *fit = a + (b - a) * share;
            }
            fit[0] = fit[1];
            fit[squares + 1] = fit[squares];
        }
        let of_colours = fit.chunks_exact((KNOWN + 1) * (squares + 2)).zip(targets.chunks_exact(len));
        for (factors, (fit, denoised)) in factors.iter_mut().zip(of_colours) {
            factors.fill(0.0);
            for (fit, pixels) in fit.chunks_exact(squares + 2).zip(known.chunks_exact(len).chain([denoised]))
            {
                add_interpolated(fit, pixels, factors);
            }
            for (factor, weight) in factors.iter_mut().zip(&*weight) {
                *factor = exp((*factor * weight).clamp(-LARGEST, LARGEST));
            }
        }
    }
}

/// Adds the values of squares, interpolated to each pixel between their centres, times the values of the
/// pixels.
#[inline(always)]
fn add_interpolated(squares: &[f32], pixels: &[f32], sums: &mut [f32]) {
    let n = squares.len() - 2;
    for (phase, (sums, pixels)) in sums.chunks_exact_mut(n).zip(pixels.chunks_exact(n)).enumerate() {
        // The first half of a square's pixels lies between its centre and the centre of the square before.
        let (first, share) = between_of(phase);
        let (left, right) = (&squares[first..][..n], &squares[first + 1..][..n]);
        for ((sum, pixel), (left, right)) in sums.iter_mut().zip(pixels).zip(left.iter().zip(right)) {
            *sum += (left + (right - left) * share) * pixel;
        }
    }
}

/// For pixel number `phase` of a square: the square on its left, counted from the one before its own, and how
/// far (0..1) it lies from that square's centre to the next.
#[inline(always)]
fn between_of(phase: usize) -> (usize, f32) {
    let place = (phase as f32 + 0.5) / SQUARE as f32 + 0.5;
    (place as usize, place.fract())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filters::variance::tests::noise;

    const SIZE: (usize, usize) = (71, 54);
    const PIXELS: usize = SIZE.0 * SIZE.1;

    /// A frame whose denoised radiance over albedo is `light(pixel)`, and whose noisy one is
    /// `samples(pixel)`.
    struct Scene {
        normal: Vec<f32>,
        albedo: Vec<f32>,
        image: Vec<f32>,
        samples: Vec<f32>,
    }

    impl Scene {
        fn new(albedo: &[f32], light: impl Fn(usize) -> f32, samples: impl Fn(usize) -> f32) -> Self {
            let lit =
                |of: &dyn Fn(usize) -> f32| (0..3 * PIXELS).map(|i| albedo[i] * of(i % PIXELS)).collect();
            let (image, samples) = (lit(&light), lit(&samples));
            Self { normal: vec![0.5; 3 * PIXELS], albedo: albedo.to_vec(), image, samples }
        }

        fn guides(&self) -> Guides<'_> {
            Guides { size: SIZE, normal: &self.normal, albedo: &self.albedo, first: 0 }
        }

        fn noisy(&self) -> Planes {
            Planes::from_vec(3, SIZE.0, SIZE.1, self.samples.clone())
        }

        /// Radiance over albedo of the first colour after a refit.
        fn refitted(&self) -> Vec<f32> {
            let mut image = self.image.clone();
            let samples = self.noisy();
            let samples = Samples::Rendered(&samples, 0, 1.0);
            Refit::new(SIZE).advance(self.guides(), &mut image, samples, SIZE.1, |v, factor| *v *= factor);
            image[..PIXELS].iter().zip(&self.albedo).map(|(v, a)| v / a).collect()
        }
    }

    fn grey(value: f32) -> Vec<f32> {
        vec![value; 3 * PIXELS]
    }

    /// An albedo of random greys.
    fn textured() -> Vec<f32> {
        noise(5, PIXELS, 1.0)
            .into_iter()
            .map(|v| 0.65 + 0.3 * v.clamp(-1.0, 1.0))
            .collect::<Vec<_>>()
            .repeat(3)
    }

    /// Mean and deviation.
    fn spread_of(values: &[f32]) -> (f32, f32) {
        let n = values.len() as f32;
        let mean = values.iter().sum::<f32>() / n;
        (mean, (values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / n).sqrt())
    }

    #[test]
    fn texture_that_was_missed_is_found_in_noisy_samples() {
        let albedo = textured();
        let random = noise(6, PIXELS, 1.0);
        // The light that comes back falls with the albedo, which the network has not seen.
        let lost = |i: usize| (albedo[i] / 0.65).powf(-0.4);
        let frame =
            Scene::new(&albedo, |_| 0.8, |i| 0.8 * lost(i) * (1.0 + 0.5 * random[i].clamp(-1.0, 1.0)));
        let found = frame.refitted();
        let products = |a: &dyn Fn(usize) -> f32| (0..PIXELS).map(|i| a(i) * lost(i).ln()).sum::<f32>();
        let share = products(&|i| (found[i] / 0.8).ln()) / products(&|i| lost(i).ln());
        assert!((0.6..1.1).contains(&share), "{share}");
    }

    #[test]
    fn blotches_go_and_edges_stay() {
        let random = noise(7, PIXELS, 0.02);
        let is_lit = |i: usize| i % SIZE.0 >= 35;
        let light = |i: usize| if is_lit(i) { 0.4 } else { 0.2 } * (1.0 + random[i]);
        let noisy = noise(12, PIXELS, 1.0);
        let frame = Scene::new(&grey(0.5), light, |i| light(i) * (1.0 + noisy[i]).max(0.0));
        let found = frame.refitted();
        let of = |columns: std::ops::Range<usize>| -> Vec<f32> {
            (0..PIXELS).filter(|i| columns.contains(&(i % SIZE.0))).map(|i| found[i]).collect()
        };
        let ((dark, uneven), (bright, _)) = (spread_of(&of(4..16)), spread_of(&of(55..67)));
        assert!(uneven / dark < 0.4 * 0.02, "{uneven} of {dark}");
        assert!((dark - 0.2).abs() < 2e-3 && (bright - 0.4).abs() < 4e-3, "{dark} {bright}");
        let (last, first) = (spread_of(&of(34..35)).0, spread_of(&of(35..36)).0);
        assert!((last - 0.2).abs() < 0.01 && (first - 0.4).abs() < 0.02, "{last} {first}");
    }

    #[test]
    fn noise_of_samples_alone_changes_little() {
        let (albedo, random) = (textured(), noise(8, PIXELS, 1.0));
        let frame = Scene::new(&albedo, |_| 0.2, |i| 0.2 * (1.0 + 2.0 * random[i]).max(0.0));
        let (_, change) = spread_of(&frame.refitted());
        assert!(change / 0.2 < 0.06, "{change}");
    }

    #[test]
    fn lamps_and_fireflies_say_nothing_of_what_is_around() {
        let (albedo, random) = (textured(), noise(9, PIXELS, 0.1));
        let light = |i: usize| 0.2 * (1.0 + random[i]);
        let lamp = |i: usize| (20..26).contains(&(i % SIZE.0)) && (20..26).contains(&(i / SIZE.0));
        let firefly = |i: usize| i == 40 * SIZE.0 + 50;
        let without = Scene::new(&albedo, light, light).refitted();
        let with = Scene::new(
            &albedo,
            |i| if lamp(i) { 500.0 } else { light(i) },
            |i| {
                if lamp(i) {
                    500.0
                } else if firefly(i) {
                    1e4
                } else {
                    light(i)
                }
            },
        );
        let found = with.refitted();
        for i in (0..PIXELS).filter(|i| !lamp(*i)) {
            assert!((found[i] / without[i]).ln().abs() < 0.1, "{i}: {} for {}", found[i], without[i]);
        }
        assert!((0..PIXELS).filter(|i| lamp(*i)).all(|i| (found[i] - 500.0).abs() < 1.0));
    }

    #[test]
    fn neither_how_samples_are_given_nor_how_rows_arrive_matters() {
        let (albedo, random) = (textured(), noise(10, PIXELS, 0.3));
        let frame =
            Scene::new(&albedo, |i| 0.2 + 0.1 * random[i].abs(), |i| 0.2 * (1.0 + random[i]).max(0.0));
        let divided: Vec<f32> =
            frame.samples.iter().zip(&frame.albedo).map(|(v, a)| v.max(0.0) * 1.5 / a).collect();
        let mut whole = frame.image.clone();
        let samples = Samples::Divided(&divided);
        Refit::new(SIZE).advance(frame.guides(), &mut whole, samples, SIZE.1, |v, factor| *v *= factor);
        assert!(whole.iter().zip(&frame.image).any(|(a, b)| (a / b - 1.0).abs() > 0.01));
        let noisy = frame.noisy().placed_in((SIZE.0 + 9, SIZE.1), (4, 0));
        for step in [1, 7, 16] {
            let (mut image, mut refit) = (Vec::new(), Refit::new(SIZE));
            let of = |planes: &[f32]| Planes::from_vec(3, SIZE.0, SIZE.1, planes.to_vec());
            let [denoised, normal, albedo] = [&frame.image, &frame.normal, &frame.albedo].map(|p| of(p));
            for rows in (0..SIZE.1).step_by(step).map(|y| (y + step).min(SIZE.1)) {
                // Only rows that are not finished are held.
                let first = refit.done();
                let held = |planes: &Planes| planes.window((0, first), (SIZE.0, rows - first));
                let [mut held, normal, albedo] = [&denoised, &normal, &albedo].map(held);
                let guides = Guides { size: SIZE, normal: &normal.data, albedo: &albedo.data, first };
                let samples = Samples::Rendered(&noisy, 4, 1.5);
                refit.advance(guides, &mut held.data, samples, rows, |v, factor| *v *= factor);
                image.push(held.window((0, 0), (SIZE.0, refit.done() - first)));
                assert!(refit.moments.1.len() <= 4 + step.div_ceil(SQUARE), "{}", refit.moments.1.len());
            }
            let image = image.into_iter().reduce(|above, below| above.above(&below)).expect("there are rows");
            assert!(image.data == whole && refit.done() == SIZE.1, "{step} rows at a time");
        }
    }

    #[test]
    fn black_and_tiny_frames_stay_finite() {
        let black = Scene::new(&grey(0.05), |_| 0.0, |_| 0.0);
        assert!(black.refitted().iter().all(|v| *v == 0.0));
        for size in [(1, 1), (3, 2), (5, 1), (2, 9)] {
            let n = 3 * size.0 * size.1;
            let (normal, albedo, mut image) = (vec![0.3; n], vec![0.6; n], noise(11, n, 1.0));
            image.iter_mut().for_each(|v| *v = v.abs());
            let guides = Guides { size, normal: &normal, albedo: &albedo, first: 0 };
            let samples = Planes::from_vec(3, size.0, size.1, image.clone());
            let samples = Samples::Rendered(&samples, 0, 1.0);
            Refit::new(size).advance(guides, &mut image, samples, size.1, |v, factor| *v *= factor);
            assert!(image.iter().all(|v| v.is_finite()), "{size:?}: {image:?}");
        }
    }
}
