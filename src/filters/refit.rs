//! What guides and samples still tell of a frame that a network has denoised.
//!
//! A network blurs some of the texture that the albedo did not account for, and leaves blotches on even walls. Both show
//! against the guides: around every pixel, two planes a colour are fitted over the axes of the normal and the logarithms of the
//! albedo, both clean. One is fitted to the noisy radiance over the denoised, whose hundreds of samples tell what slopes were missed, as
//! regression over features does (Bitterli et al. 2016). The other is fitted to the logarithm of what was denoised, which gives way
//! to it where it varies little besides: a guided filter (He et al. 2013) that has its own image for a guide as well.

use std::{collections::VecDeque, ops::Range};

use rayon::prelude::*;

use super::{
    solve::{LANES, Lanes, Symmetric},
    squares::{self, SQUARE, between},
};
use crate::kernels::{
    filter::exp,
    logarithm::ln,
    vectorised::{self, Vectorised},
};

/// Weights of the squares on either side of one, binomial: a deviation of one square.
const WINDOW: [f32; 5] = [1.0, 4.0, 6.0, 4.0, 1.0];

/// How many pixels a window counts for, over the sum of their weights: the square of that over the sum of squares.
const PIXELS: f32 = 256.0 / (70.0 * 70.0);

/// Three axes of the normal and three logarithms of the albedo.
const GUIDES: usize = 6;

/// What is fitted: a constant and the slopes.
const KNOWN: usize = GUIDES + 1;

const COLOURS: usize = 3;

/// What is fitted to: each colour's logarithm of what is denoised, then each colour's samples over that.
const TARGETS: usize = 2 * COLOURS;

/// Sums over pixels of the products of every two of the first, a lower triangle row by row; then for each target its products with
/// those, and its square.
const MOMENTS: usize = KNOWN * (KNOWN + 1) / 2 + TARGETS * (KNOWN + 1);

/// What is kept of each square for each colour: a constant and the slopes of its change over the guides, and over its own logarithm,
/// of which a share is taken away.
const KEPT: usize = COLOURS * (KNOWN + 1);

/// Added to the variances of an axis and of a logarithm: how much of a guide is noise, or too little to tell of anything.
const GUIDE_NOISE: [f32; GUIDES] = [1e-5, 1e-5, 1e-5, 2e-4, 2e-4, 2e-4];

/// Deviation of the slopes that are there to be found in the samples: those that noise alone may explain shrink below it.
const SLOPE: f32 = 0.5;

/// Deviation of the blotches that a network leaves: what varies less beside the guides gives way to them.
const BLOTCHES: f32 = 0.09;

/// Variance of the samples over what was denoised from which on blotches are that large: with less noise there is less of them.
const NOISY: f32 = 0.1;

/// Exposed radiance over albedo that is added to samples and to what is denoised before one is
/// divided by the other, and before the latter's logarithm: relative errors of what is darker count less and less.
const SAMPLE_FLOOR: f32 = 0.3;
const FLOOR: f32 = 0.007;

/// A sample is at most this many times what was denoised, as fireflies would decide on slopes all around them.
const MOST: f32 = 2.0;

/// Exposed radiance over albedo, the mean of the colours, 8 times middle grey, from which on a pixel counts less and less: lamps say
/// nothing of the walls around.
const BRIGHT: f32 = 1.5;

/// The logarithm of the largest change.
const LARGEST: f32 = 0.7;

/// A window that counts for no more than this has none of the frame's pixels, or lamps alone.
const LEAST_COUNT: f32 = 1e-2;

/// What samples vary by, and their level over what is denoised, are taken to be at least this.
const LEAST_NOISE: f32 = 1e-3;
const LEAST_LEVEL: f32 = 0.3;

/// What is known of a frame besides its radiance.
#[derive(Clone, Copy)]
pub struct Guides<'a> {
    /// Columns and rows.
    pub size: (usize, usize),
    /// Axes of the normal without its noise, and as many rows of it as of the albedo, (3, R, W).
    pub normal: &'a [f32],
    /// What radiance is divided by, the albedo without its noise: rows from `first` on, as many as there are, (3, R, W).
    pub albedo: &'a [f32],
    /// The first of those rows.
    pub first: usize,
}

/// Noisy radiance, (3, H, W).
#[derive(Clone, Copy)]
pub enum Samples<'a> {
    /// Exposed and divided by albedo.
    Divided(&'a [f32]),
    /// As rendered, and the exposure.
    Rendered(&'a [f32], f32),
}

impl Guides<'_> {
    /// Row `y` of three planes of all rows.
    #[inline(always)]
    fn row<'p>(&self, planes: &'p [f32], y: usize) -> [&'p [f32]; 3] {
        let (width, height) = self.size;
        [0, 1, 2].map(|c| &planes[(c * height + y) * width..][..width])
    }

    /// Row `y` of a guide.
    #[inline(always)]
    fn guide_row<'p>(&self, guide: &'p [f32], y: usize) -> [&'p [f32]; 3] {
        let (width, plane) = (self.size.0, guide.len() / 3);
        [0, 1, 2].map(|c| &guide[c * plane + (y - self.first) * width..][..width])
    }
}

/// A refit that goes down a frame as the frame is denoised, and keeps of it no more than the windows take.
pub struct Refit {
    squares: usize,
    square_rows: usize,
    /// Moments of rows of squares: the number of the first, and [`MOMENTS`] lines each.
    moments: (usize, VecDeque<Vec<f32>>),
    /// Fits of rows of squares: the number of the first, and [`KEPT`] lines each.
    fits: (usize, VecDeque<Vec<f32>>),
    /// Rows of pixels that are done.
    done: usize,
}

impl Refit {
    /// A refit of a frame of so many columns and rows.
    pub fn new((width, height): (usize, usize)) -> Self {
        let [squares, square_rows] = [width, height].map(|n| n.div_ceil(SQUARE));
        Self { squares, square_rows, moments: Default::default(), fits: Default::default(), done: 0 }
    }

    /// Rows of pixels that are done: their albedo is not asked for again.
    pub fn done(&self) -> usize {
        self.done
    }

    /// Does `change` with every value of an exposed `image`, (3, H, W), and what it should be multiplied by, as far as that can be
    /// known when its first `rows` rows are there. It was made of `samples`.
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

        // A pixel lies between the middles of two squares.
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

    /// Does `change` with every value of some rows and its factor.
    fn each_row(
        &self,
        guides: Guides,
        image: &mut [f32],
        rows: Range<usize>,
        change: impl Fn(&mut f32, f32) + Sync,
    ) {
        let (width, height) = guides.size;
        let (red, rest) = image.split_at_mut(width * height);
        let (green, blue) = rest.split_at_mut(width * height);
        let [red, green, blue] =
            [red, green, blue].map(|plane| plane[rows.start * width..rows.end * width].par_chunks_mut(width));
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

    /// Finds the factors of row `y`, which holds `image`.
    fn find(&self, guides: Guides, image: [&[f32]; 3], y: usize, memory: &mut Memory) {
        let (above, share) = between(y, self.square_rows);
        let (first, fits) = &self.fits;
        let near = [above, (above + 1).min(self.square_rows - 1)].map(|row| &fits[row - first][..]);
        vectorised::run(Factors { guides, image, y, near, share, memory });
    }
}

/// What a thread needs for the factors of a row.
struct Memory {
    pixels: Pixels,
    /// The fits as they are at that row, a square more on either side.
    fit: Vec<f32>,
    /// Of each colour.
    factors: [Vec<f32>; COLOURS],
}

/// What is known of the pixels of a row, and what they are fitted to. Lines hold first the first pixels of all squares, then the
/// second, and so on: what is done to squares is so done to neighbouring values.
struct Pixels {
    squares: usize,
    /// One, and the guides.
    known: Vec<f32>,
    targets: Vec<f32>,
    /// How much each counts.
    weight: Vec<f32>,
    /// Radiance over albedo, of each colour.
    light: Vec<f32>,
    /// Memory for a row.
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

    /// Reads what is known of row `y`: how much its pixels count, their guides, and the logarithms of what is denoised, the first
    /// targets.
    #[inline(always)]
    fn read(&mut self, guides: Guides, image: [&[f32]; 3], y: usize) {
        let len = SQUARE * self.squares;
        let width = guides.size.0;
        for (c, row) in guides.guide_row(guides.normal, y).into_iter().enumerate() {
            part(row, self.squares, &mut self.known[(1 + c) * len..][..len]);
        }
        for (c, row) in guides.guide_row(guides.albedo, y).into_iter().enumerate() {
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
        // Pixels of the last squares beyond the frame.
        for beyond in width..len {
            self.weight[beyond % SQUARE * self.squares + beyond / SQUARE] = 0.0;
        }
    }

    /// Reads the samples over what is denoised, the other targets.
    #[inline(always)]
    fn read_samples(&mut self, guides: Guides, samples: Samples, y: usize) {
        let len = SQUARE * self.squares;
        let line = &mut self.spare[..len];
        for c in 0..COLOURS {
            let [albedo, light] = [&self.albedo, &self.light].map(|planes| &planes[c * len..][..len]);
            let target = &mut self.targets[(COLOURS + c) * len..][..len];
            let (Samples::Divided(values) | Samples::Rendered(values, _)) = samples;
            part(guides.row(values, y)[c], self.squares, line);
            if let Samples::Rendered(_, exposure) = samples {
                line.iter_mut().zip(albedo).for_each(|(v, a)| *v = v.max(0.0) * exposure / a);
            }
            for (target, (sample, light)) in target.iter_mut().zip(line.iter().zip(light)) {
                *target = ((sample + SAMPLE_FLOOR) / (light + SAMPLE_FLOOR)).min(MOST);
            }
        }
    }
}

/// Parts a row of pixels as [`Pixels`] has them. What lies beyond the row keeps its value.
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

/// Does `work` with each pixel of a row and its value in a line.
#[inline(always)]
fn interleave(line: &[f32], squares: usize, row: &mut [f32], work: impl Fn(&mut f32, f32)) {
    for (s, square) in row.chunks_mut(SQUARE).enumerate() {
        square.iter_mut().enumerate().for_each(|(n, pixel)| work(pixel, line[n * squares + s]));
    }
}

/// What a row of pixels adds to the moments of its squares.
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

/// Adds to each square the products of its pixels.
#[inline(always)]
fn add_products(a: &[f32], b: &[f32], sums: &mut [f32]) {
    let n = sums.len();
    let [a0, a1, a2, a3] = [0, 1, 2, 3].map(|i| &a[i * n..][..n]);
    let [b0, b1, b2, b3] = [0, 1, 2, 3].map(|i| &b[i * n..][..n]);
    for s in 0..n {
        sums[s] += (a0[s] * b0[s] + a1[s] * b1[s]) + (a2[s] * b2[s] + a3[s] * b3[s]);
    }
}

/// Fits planes around every square of a row.
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

/// `f` of each lane.
#[inline(always)]
fn each(f: impl Fn(usize) -> f32) -> Lanes {
    let mut lanes = [0.0; LANES];
    for (l, lane) in lanes.iter_mut().enumerate() {
        *lane = f(l);
    }
    lanes
}

/// The fits of one square a lane, from its moments, as [`KEPT`] tells.
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

    // Slopes of the samples: a ridge that is the variance with which as many of them decide on one.
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
            // What was missed lies on a plane itself, so of it nothing is taken away.
            kept[1 + i] = each(|l| given[l] * smooth[i][l] + missed[i][l] / level[l].max(LEAST_LEVEL));
            constant = each(|l| constant[l] - kept[1 + i][l] * means[i][l]);
        }
        kept[0] = constant;
        kept[KNOWN] = given.map(|share| -share);
    }
    kept
}

/// The factors of a row of pixels.
struct Factors<'a> {
    guides: Guides<'a>,
    image: [&'a [f32]; 3],
    y: usize,
    /// The fits of the squares above and below, and how far the row is on the way to the latter.
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

/// Adds values of squares, interpolated between their middles, times those of pixels.
#[inline(always)]
fn add_interpolated(squares: &[f32], pixels: &[f32], sums: &mut [f32]) {
    let n = squares.len() - 2;
    for (phase, (sums, pixels)) in sums.chunks_exact_mut(n).zip(pixels.chunks_exact(n)).enumerate() {
        // The first half of a square's pixels lies between its middle and that of the square before.
        let (first, share) = between_of(phase);
        let (left, right) = (&squares[first..][..n], &squares[first + 1..][..n]);
        for ((sum, pixel), (left, right)) in sums.iter_mut().zip(pixels).zip(left.iter().zip(right)) {
            *sum += (left + (right - left) * share) * pixel;
        }
    }
}

/// For the pixels `phase` of squares, how many squares on from the one before they lie, and how far on towards the next.
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

    /// A frame whose radiance over albedo is `light` of a pixel in what was denoised, `samples` in what was rendered.
    struct Frame {
        normal: Vec<f32>,
        albedo: Vec<f32>,
        image: Vec<f32>,
        samples: Vec<f32>,
    }

    impl Frame {
        fn new(albedo: &[f32], light: impl Fn(usize) -> f32, samples: impl Fn(usize) -> f32) -> Self {
            let lit =
                |of: &dyn Fn(usize) -> f32| (0..3 * PIXELS).map(|i| albedo[i] * of(i % PIXELS)).collect();
            let (image, samples) = (lit(&light), lit(&samples));
            Self { normal: vec![0.5; 3 * PIXELS], albedo: albedo.to_vec(), image, samples }
        }

        fn guides(&self) -> Guides<'_> {
            Guides { size: SIZE, normal: &self.normal, albedo: &self.albedo, first: 0 }
        }

        /// Radiance over albedo of the first colour after a refit.
        fn refitted(&self) -> Vec<f32> {
            let mut image = self.image.clone();
            let samples = Samples::Rendered(&self.samples, 1.0);
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
            Frame::new(&albedo, |_| 0.8, |i| 0.8 * lost(i) * (1.0 + 0.5 * random[i].clamp(-1.0, 1.0)));
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
        let frame = Frame::new(&grey(0.5), light, |i| light(i) * (1.0 + noisy[i]).max(0.0));
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
        let frame = Frame::new(&albedo, |_| 0.2, |i| 0.2 * (1.0 + 2.0 * random[i]).max(0.0));
        let (_, change) = spread_of(&frame.refitted());
        assert!(change / 0.2 < 0.06, "{change}");
    }

    #[test]
    fn lamps_and_fireflies_say_nothing_of_what_is_around() {
        let (albedo, random) = (textured(), noise(9, PIXELS, 0.1));
        let light = |i: usize| 0.2 * (1.0 + random[i]);
        let lamp = |i: usize| (20..26).contains(&(i % SIZE.0)) && (20..26).contains(&(i / SIZE.0));
        let firefly = |i: usize| i == 40 * SIZE.0 + 50;
        let without = Frame::new(&albedo, light, light).refitted();
        let with = Frame::new(
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
            Frame::new(&albedo, |i| 0.2 + 0.1 * random[i].abs(), |i| 0.2 * (1.0 + random[i]).max(0.0));
        let divided: Vec<f32> =
            frame.samples.iter().zip(&frame.albedo).map(|(v, a)| v.max(0.0) * 1.5 / a).collect();
        let mut whole = frame.image.clone();
        let samples = Samples::Divided(&divided);
        Refit::new(SIZE).advance(frame.guides(), &mut whole, samples, SIZE.1, |v, factor| *v *= factor);
        assert!(whole.iter().zip(&frame.image).any(|(a, b)| (a / b - 1.0).abs() > 0.01));
        for step in [1, 7, 16] {
            let (mut image, mut refit) = (frame.image.clone(), Refit::new(SIZE));
            for rows in (0..SIZE.1).step_by(step).map(|y| (y + step).min(SIZE.1)) {
                // Only guides of rows that are under way are there.
                let first = refit.done();
                let [normal, albedo] = [&frame.normal, &frame.albedo].map(|guide| -> Vec<f32> {
                    let rows = |c: usize| c * PIXELS + first * SIZE.0..c * PIXELS + rows * SIZE.0;
                    (0..3).flat_map(|c| &guide[rows(c)]).copied().collect()
                });
                let guides = Guides { size: SIZE, normal: &normal, albedo: &albedo, first };
                let samples = Samples::Rendered(&frame.samples, 1.5);
                refit.advance(guides, &mut image, samples, rows, |v, factor| *v *= factor);
                assert!(refit.moments.1.len() <= 4 + step.div_ceil(SQUARE), "{}", refit.moments.1.len());
            }
            assert!(image == whole && refit.done() == SIZE.1, "{step} rows at a time");
        }
    }

    #[test]
    fn black_and_tiny_frames_stay_finite() {
        let black = Frame::new(&grey(0.05), |_| 0.0, |_| 0.0);
        assert!(black.refitted().iter().all(|v| *v == 0.0));
        for size in [(1, 1), (3, 2), (5, 1), (2, 9)] {
            let n = 3 * size.0 * size.1;
            let (normal, albedo, mut image) = (vec![0.3; n], vec![0.6; n], noise(11, n, 1.0));
            image.iter_mut().for_each(|v| *v = v.abs());
            let guides = Guides { size, normal: &normal, albedo: &albedo, first: 0 };
            let samples = image.clone();
            let samples = Samples::Rendered(&samples, 1.0);
            Refit::new(size).advance(guides, &mut image, samples, size.1, |v, factor| *v *= factor);
            assert!(image.iter().all(|v| v.is_finite()), "{size:?}: {image:?}");
        }
    }
}
