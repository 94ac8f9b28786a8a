//! Takes back what a denoiser changed beyond the noise.
//!
//! A denoiser that was trained on noisy frames blurs clean ones. How far it should be followed is an old question of
//! statistics: an unbiased but noisy value `c` (the render) and a biased one `d` (what was denoised) are best mixed as
//! `c + w (d - c)` with `w = noise / (c - d)^2`, both averaged over a neighbourhood (James and Stein 1961). The noise
//! has to be told from one frame alone:
//! - Cycles draws every pixel by itself, so noise has no direction, while edges and texture have. Of the second
//!   differences along four directions, the smallest holds next to nothing but noise. They are taken of the light, and
//!   of the light over the albedo as rendered, which divides texture away.
//! - The residual `c - d` is uncorrelated from pixel to pixel if it is noise, and correlated if it is blurred detail.
//!
//! Where a frame is noisy, all of `d` is taken. How clean is clean enough depends on the number of samples, if the file
//! tells it.
//!
//! Light that the camera sees directly (sky, screens, lamps) has no noise but that of antialiasing. Cycles writes it
//! into the albedo as well, which tells where it is: such light is kept. Of few samples, though, antialiasing is noise
//! like any other: a gap of a blind before a bright sky is a quarter of the sky, or nothing.

use rayon::prelude::*;

use super::squares::{self, SQUARE, between};
use crate::{
    kernels::{
        logarithm::ln,
        vectorised::{self, Vectorised},
    },
    planes::{Planes, mirrored},
};

/// Sums over the pixels of a square, a line of squares each: their number; the square of the residual; two measures of
/// noise, of the light and of the light over the albedo; the square of what the residual was cut by; and the products
/// of residuals with those to the right and below.
const SUMS: usize = 7;
const COUNT: usize = 0;
const RESIDUAL: usize = 1;
const NOISE: [usize; 2] = [2, 3];
const CUT: usize = 4;
const PRODUCTS: [usize; 2] = [5, 6];

/// Binomial weights of squares: those over which residual and noise are compared, those over which a place is judged
/// noisy or clean, and those over which the residual is judged noise or detail, which takes some hundreds of pixels.
const NEAR: [f32; 3] = [1.0, 2.0, 1.0];
const AROUND: [f32; 5] = [1.0, 4.0, 6.0, 4.0, 1.0];
const WIDE: [f32; 9] = [1.0, 8.0, 28.0, 56.0, 70.0, 56.0, 28.0, 8.0, 1.0];

/// What is kept of a square: noise, squared residual, and how far the mixture is to be trusted.
const KEPT: usize = 3;

/// Exposed radiance that is added to what is denoised before residuals are divided by it: relative errors of what is
/// darker count less and less.
const FLOOR: f32 = 0.02;

/// Added to the albedo before light is divided by it.
const ALBEDO_FLOOR: f32 = 0.02;

/// Relative residuals are cut at this: a firefly would decide on all around it. What is cut off counts as noise, by
/// this share of its square, which is itself at most the last.
const LARGEST_RESIDUAL: f32 = 1.0;
const CUT_SHARE: f32 = 0.3;
const LARGEST_CUT: f32 = 100.0;

/// Relative second differences are cut at this.
const LARGEST_DIFFERENCE: f32 = 6.0;

/// The variance of noise over the mean of the smallest squared second difference of four directions: a sixth for one
/// direction, the rest for taking the smallest (of independent normal values, by drawing 360,000 of them).
const VARIANCE_OF_SMALLEST: f32 = 3.5706 / 6.0;

/// The correlation of neighbouring residuals up to which they are noise, and how much more makes them detail.
const CORRELATED: f32 = 0.05;
const DETAIL: f32 = 0.3;

/// A pixel whose residual alone is more than this many times the variance of the noise is mixed by its own residual.
const OUTLIER: f32 = 4.0;

/// The relative variance from which on a frame of `n` samples is noisy: `NOISY * n^NOISY_POWER`, at most the last. A
/// place that has as much noise as is usual for so few samples is denoised as the network learned to.
const NOISY: f32 = 0.001;
const NOISY_POWER: f32 = 0.75;
const MOST_NOISY: f32 = 0.1;

/// A place with this share of that variance is clean: the mixture is trusted entirely.
const CLEAN: f32 = 0.1;

/// From this many samples on, what looks like noise is less and less likely to be noise: by this power of the number of
/// samples. Adaptive sampling ends before the most that a file tells of.
const FINAL_SAMPLES: f32 = 64.0;
const FINAL_POWER: f32 = 0.75;

/// What a frame is taken for that does not tell its number of samples.
const UNKNOWN_SAMPLES: u32 = 16;

/// Of no more than the first number of samples, no light is kept because the albedo shows it: its antialiasing is noise,
/// as all of it is through glass. From the second on, all is.
const KEPT_SAMPLES: (f32, f32) = (16.0, 64.0);

/// A frame whose pixels are all their albedo but for this share is no picture of light on surfaces: all of it is kept.
const UNLIKE: f64 = 1e-3;

/// Such light may be this many times as bright as in the brightest of the 8 pixels around; what is brighter counts less.
const ALONE: f32 = 4.0;

/// By how much radiance may differ from the albedo and still be light that is seen directly: a few steps of a half
/// float, and next to nothing besides.
const SAME: (f32, f32) = (0.004, 1e-6);

/// Light that is seen directly is its albedo times the film's exposure, which Cycles applies to light alone. It is told
/// from the quotients of light and albedo, counted by these steps of an octave over so many octaves up and down.
const STEPS: usize = 128;
const OCTAVES: usize = 20;

/// An exposure needs at least this many pixels, and this many times more of them than its second and third neighbours
/// have on the average: quotients of what is only lit are spread by noise and by shape.
const LEAST_EXPOSED: u32 = 16;
const PEAK: f32 = 8.0;

/// About as many pixels as are counted.
const COUNTED: usize = 1 << 17;

/// Pixels of the 3x3 around one, itself included, that must be seen directly for it to be: any pixel may be as bright as
/// its albedo by chance.
const SEEN_TOGETHER: usize = 6;

/// What is known of a frame besides what was denoised.
pub struct Render<'a> {
    /// Noisy radiance, (3, H, W), finite.
    pub radiance: &'a Planes,
    /// Albedo as rendered, (3, H, W), finite.
    pub albedo: &'a Planes,
    /// What radiance is multiplied by so that its log-average is middle grey.
    pub exposure: f32,
    /// Samples of a pixel, where the file tells.
    pub samples: Option<u32>,
    /// How many times brighter than all others of the 5x5 around it a pixel is a firefly, which is not taken back.
    pub firefly: f32,
}

/// Mixes a denoised `image`, (3, H, W), with the render that it was made of, as far as it differs by more than noise. The share
/// of the render in each pixel goes into `shares`, (1, H, W), for [`take_back`].
///
/// # Panics
/// If sizes differ.
pub fn shrink(image: &mut Planes, render: &Render, shares: Option<&mut Planes>) {
    let size = (image.width, image.height);
    for planes in [render.radiance, render.albedo, &*image] {
        assert_eq!(
            (planes.channels, planes.width, planes.height),
            (3, size.0, size.1),
            "planes of one frame"
        );
    }
    if image.pixels() == 0 {
        return;
    }
    let samples = render.samples.unwrap_or(UNKNOWN_SAMPLES).max(1) as f32;
    let seen = Seen { radiance: render.radiance, albedo: render.albedo, film: film_exposure(render) };
    let kept = judge(&gather(image, render, &seen), size, samples);
    mix(image, render, &seen, &kept, samples, shares);
}

/// Mixes another denoised layer, (C, H, W), with what was rendered of it, by the `shares` of [`shrink`].
pub fn take_back(denoised: &mut Planes, rendered: &Planes, shares: &Planes) {
    let pixels = shares.pixels();
    let channels = denoised.data.par_chunks_mut(pixels).zip(rendered.data.par_chunks(pixels));
    channels.for_each(|(denoised, rendered)| {
        let values = denoised.iter_mut().zip(rendered).zip(&shares.data);
        values.for_each(|((denoised, rendered), share)| *denoised += (rendered - *denoised) * share);
    });
}

/// What light that is seen directly was multiplied by, as most such light of the frame has it; 1 if there is any such.
fn film_exposure(render: &Render) -> f32 {
    let Render { radiance, albedo, .. } = render;
    let pixels = radiance.pixels();
    let per_octave = STEPS as f32 / std::f32::consts::LN_2;
    let middle = STEPS * OCTAVES;
    let mut counts = vec![0u32; 2 * middle + 1];
    for at in (0..pixels).step_by(pixels.div_ceil(COUNTED)) {
        let [light, white] = [radiance, albedo].map(|planes| [0, 1, 2].map(|c| planes.channel(c)[at]));
        let sums = [light, white].map(|colours| colours.iter().sum::<f32>());
        if sums.into_iter().all(|sum| sum > f32::MIN_POSITIVE) && equals(light, white, sums[0] / sums[1]) {
            let step = (ln(sums[0] / sums[1]) * per_octave).round() + middle as f32;
            if let Some(count) = counts.get_mut(step as usize) {
                *count += 1;
            }
        }
    }
    let is_peak = |step: usize| {
        let around = [step - 3, step - 2, step + 2, step + 3].map(|step| counts[step]);
        let usual = around.iter().sum::<u32>() as f32 / around.len() as f32;
        counts[step] >= LEAST_EXPOSED && counts[step] as f32 > PEAK * usual
    };
    if is_peak(middle) {
        return 1.0;
    }
    let peaks = (3..counts.len() - 3).filter(|step| is_peak(*step));
    let highest = peaks.max_by_key(|step| counts[*step]).unwrap_or(middle);
    // Whole octaves apart from the rest, so that they are exact.
    let steps = highest as i32 - middle as i32;
    let (octave, rest) = (steps.div_euclid(STEPS as i32), steps.rem_euclid(STEPS as i32));
    (rest as f32 / STEPS as f32).exp2() * 2f32.powi(octave)
}

/// Whether light is white times `film` but for rounding.
#[inline(always)]
fn equals(light: [f32; 3], white: [f32; 3], film: f32) -> bool {
    let (relative, absolute) = SAME;
    (0..3).all(|c| (light[c] - film * white[c]).abs() <= film * (relative * white[c].abs() + absolute))
}

/// Rows of squares that a thread gathers at once: the rows of pixels just above and below are computed twice.
const STRIP: usize = 4;

/// The sums of every row of squares, [`SUMS`] lines each.
fn gather(image: &Planes, render: &Render, seen: &Seen) -> Vec<f32> {
    let (width, height) = (image.width, image.height);
    let squares = width.div_ceil(SQUARE);
    let mut sums = vec![0.0; height.div_ceil(SQUARE) * SUMS * squares];
    sums.par_chunks_mut(STRIP * SUMS * squares).enumerate().for_each(|(strip, sums)| {
        let first = strip * STRIP * SQUARE;
        let end = (first + STRIP * SQUARE).min(height);
        // One row more on either side; beyond the frame lies its mirror image.
        let rows: Vec<PixelRow> = (first as isize - 1..end as isize + 1)
            .map(|y| PixelRow::read(image, render, seen.film, mirrored(y.unsigned_abs(), height)))
            .collect();
        let mut columns = vec![0.0; SUMS * width];
        for (sums, first_row) in sums.chunks_exact_mut(SUMS * squares).zip((0..end - first).step_by(SQUARE)) {
            columns.fill(0.0);
            for y in first_row..(first_row + SQUARE).min(end - first) {
                let [above, row, below] = [0, 1, 2].map(|next| &rows[y + next]);
                vectorised::run(Add { above, row, below, columns: &mut columns });
            }
            for (line, columns) in sums.chunks_exact_mut(squares).zip(columns.chunks_exact(width)) {
                let of_squares = columns.chunks(SQUARE).map(|part| part.iter().sum::<f32>());
                line.iter_mut().zip(of_squares).for_each(|(sum, of_square)| *sum = of_square);
            }
        }
    });
    sums
}

/// What is read of a row of pixels. Each line has one value more on either side, where the row's mirror image lies.
struct PixelRow {
    /// The mean of the colours of the render.
    light: Vec<f32>,
    /// The same over the albedo.
    ratio: Vec<f32>,
    /// What differences of each are multiplied by to be relative.
    scales: [Vec<f32>; 2],
    /// The relative residual, cut, and the square of what it was cut by.
    residual: Vec<f32>,
    cut: Vec<f32>,
}

impl PixelRow {
    fn read(image: &Planes, render: &Render, film: f32, y: usize) -> Self {
        let width = image.width;
        let line = || vec![0.0; width + 2];
        let mut row =
            Self { light: line(), ratio: line(), scales: [line(), line()], residual: line(), cut: line() };
        let [image, radiance, albedo] = [image, render.radiance, render.albedo]
            .map(|planes| [0, 1, 2].map(|c| &planes.channel(c)[y * width..][..width]));
        let floor = FLOOR / render.exposure;
        vectorised::run(Read { image, radiance, albedo, film, floor, row: &mut row });
        for line in [&mut row.light, &mut row.ratio, &mut row.residual] {
            line[0] = line[1 + mirrored(1, width)];
            line[width + 1] = line[1 + mirrored(width, width)];
        }
        row
    }
}

/// Reads a row's pixels.
struct Read<'a> {
    image: [&'a [f32]; 3],
    radiance: [&'a [f32]; 3],
    albedo: [&'a [f32]; 3],
    film: f32,
    floor: f32,
    row: &'a mut PixelRow,
}

impl Vectorised for Read<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { image, radiance, albedo, film, floor, row } = self;
        let width = image[0].len();
        let PixelRow { light, ratio, scales: [of_light, of_ratio], residual, cut } = row;
        let [light, ratio, of_light, of_ratio, residual, cut] =
            [light, ratio, of_light, of_ratio, residual, cut].map(|line| &mut line[1..][..width]);
        // Until it is needed, `cut` holds by how much more than a rounding error the light differs from the albedo: 0
        // where it is seen directly.
        for c in 0..3 {
            for x in 0..width {
                // No surface reflects more light than it gets: what is beyond white is light that is seen.
                let over = 1.0 / (3.0 * (albedo[c][x].clamp(0.0, 1.0) + ALBEDO_FLOOR));
                let (noisy, denoised) = (radiance[c][x].max(0.0), image[c][x].max(0.0));
                let rounding = film * (SAME.0 * albedo[c][x].abs() + SAME.1);
                cut[x] = cut[x].max((noisy - film * albedo[c][x]).abs() - rounding);
                light[x] += noisy * (1.0 / 3.0);
                ratio[x] += noisy * over;
                of_light[x] += denoised * (1.0 / 3.0);
                of_ratio[x] += denoised * over;
            }
        }
        for x in 0..width {
            // The noise of light that is seen directly is in the albedo as well, and their quotient tells nothing of it.
            let is_seen = cut[x] <= 0.0;
            ratio[x] = if is_seen { light[x] } else { ratio[x] };
            of_ratio[x] = if is_seen { of_light[x] } else { of_ratio[x] };
            let relative = 1.0 / (of_light[x] + floor);
            let whole = (light[x] - of_light[x]) * relative;
            residual[x] = whole.clamp(-LARGEST_RESIDUAL, LARGEST_RESIDUAL);
            cut[x] = (whole * whole).min(LARGEST_CUT) - residual[x] * residual[x];
            of_light[x] = relative;
            of_ratio[x] = 1.0 / (of_ratio[x] + floor);
        }
    }
}

/// Adds what a row of pixels has to the sums over columns.
struct Add<'a> {
    above: &'a PixelRow,
    row: &'a PixelRow,
    below: &'a PixelRow,
    /// [`SUMS`] lines of a value a column.
    columns: &'a mut [f32],
}

impl Vectorised for Add<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { above, row, below, columns } = self;
        let width = row.light.len() - 2;
        let lines = [&above.light, &row.light, &below.light].map(|line| &line[..]);
        add_differences(lines, &row.scales[0][1..][..width], &mut columns[NOISE[0] * width..][..width]);
        let lines = [&above.ratio, &row.ratio, &below.ratio].map(|line| &line[..]);
        add_differences(lines, &row.scales[1][1..][..width], &mut columns[NOISE[1] * width..][..width]);
        columns[COUNT * width..][..width].iter_mut().for_each(|count| *count += 1.0);
        let cut = columns[CUT * width..][..width].iter_mut().zip(&row.cut[1..]);
        cut.for_each(|(sum, cut)| *sum += cut);
        let own = &row.residual[1..][..width];
        let others = [own, &row.residual[2..][..width], &below.residual[1..][..width]];
        for (sum, other) in [RESIDUAL, PRODUCTS[0], PRODUCTS[1]].into_iter().zip(others) {
            let sums = columns[sum * width..][..width].iter_mut();
            sums.zip(own.iter().zip(other)).for_each(|(sum, (own, other))| *sum += own * other);
        }
    }
}

/// Adds the variance that the smallest of four second differences tells of, relative by `scale`.
#[inline(always)]
fn add_differences([above, row, below]: [&[f32]; 3], scale: &[f32], sums: &mut [f32]) {
    let width = sums.len();
    for x in 0..width {
        let twice = 2.0 * row[x + 1];
        let across = (twice - row[x] - row[x + 2]).abs();
        let down = (twice - above[x + 1] - below[x + 1]).abs();
        let falling = (twice - above[x] - below[x + 2]).abs();
        let rising = (twice - above[x + 2] - below[x]).abs();
        let least = (across.min(down).min(falling.min(rising)) * scale[x]).min(LARGEST_DIFFERENCE);
        sums[x] += VARIANCE_OF_SMALLEST * least * least;
    }
}

/// Of every row of squares [`KEPT`] lines: the variance of the noise, the mean square of the residual, both relative,
/// and from 0 to 1 how far the mixture is to be trusted.
fn judge(sums: &[f32], (width, height): (usize, usize), samples: f32) -> Vec<f32> {
    let (squares, rows) = (width.div_ceil(SQUARE), height.div_ceil(SQUARE));
    let noisy = (NOISY * samples.powf(NOISY_POWER)).min(MOST_NOISY);
    let belief = (FINAL_SAMPLES / samples).min(1.0).powf(FINAL_POWER);
    let sums: Vec<&[f32]> = sums.chunks(SUMS * squares).collect();
    let mut kept = vec![0.0; rows * KEPT * squares];
    let memory = || [(); 4].map(|()| vec![0.0; SUMS * squares]);
    kept.par_chunks_mut(KEPT * squares).enumerate().for_each_init(
        memory,
        |[of_rows, near, around, wide], (row, kept)| {
            let mut sum = |window: &[f32], output: &mut [f32]| {
                let lines = window.iter().enumerate().filter_map(|(tap, weight)| {
                    Some((*weight, *sums.get((row + tap).checked_sub(window.len() / 2)?)?))
                });
                squares::around(lines, squares, window, of_rows, output);
            };
            sum(&NEAR, near);
            sum(&AROUND, around);
            sum(&WIDE, wide);
            let (noise, rest) = kept.split_at_mut(squares);
            let (residual, trust) = rest.split_at_mut(squares);
            for s in 0..squares {
                let of = |lines: &[f32], line: usize| lines[line * squares + s];
                let mean = |lines: &[f32], line: usize| of(lines, line) / of(lines, COUNT);
                let least_noise = |lines: &[f32]| {
                    mean(lines, NOISE[0]).min(mean(lines, NOISE[1])).min(mean(lines, RESIDUAL))
                };
                let products = of(wide, PRODUCTS[0]).max(of(wide, PRODUCTS[1]));
                let correlation = products / of(wide, RESIDUAL).max(f32::MIN_POSITIVE);
                let is_noise = 1.0 - ((correlation - CORRELATED) / DETAIL).clamp(0.0, 1.0);
                noise[s] = least_noise(near) * is_noise * belief;
                residual[s] = mean(near, RESIDUAL);
                let level = (least_noise(around) * is_noise + CUT_SHARE * mean(around, CUT)) * belief;
                let decades = ln(noisy / level.max(f32::MIN_POSITIVE)) / -ln(CLEAN);
                trust[s] = decades.clamp(0.0, 1.0);
            }
        },
    );
    kept
}

/// Mixes every pixel, and writes the shares of the render, where they are asked for.
fn mix(
    image: &mut Planes,
    render: &Render,
    seen: &Seen,
    kept: &[f32],
    samples: f32,
    shares: Option<&mut Planes>,
) {
    let (width, height) = (image.width, image.height);
    let (squares, square_rows) = (width.div_ceil(SQUARE), height.div_ceil(SQUARE));
    let floor = FLOOR / render.exposure;
    let (few, many) = KEPT_SAMPLES;
    let is_all_seen = seen.is_all();
    let by_samples = ((samples / few).log2() / (many / few).log2()).clamp(0.0, 1.0);
    let keeps = if is_all_seen { 1.0 } else { by_samples };
    let (red, rest) = image.data.split_at_mut(width * height);
    let (green, blue) = rest.split_at_mut(width * height);
    let [red, green, blue] = [red, green, blue].map(|plane| plane.par_chunks_mut(width));
    let shares: Vec<Option<&mut [f32]>> = match shares {
        Some(shares) => shares.data.chunks_mut(width).map(Some).collect(),
        None => (0..height).map(|_| None).collect(),
    };
    red.zip(green).zip(blue).zip(shares).enumerate().for_each_init(
        || vec![0.0; KEPT * squares],
        |line, (y, (((red, green), blue), mut shares))| {
            let mut note = |x: usize, share: f32| shares.iter_mut().for_each(|row| row[x] = share);
            let (above, share) = between(y, square_rows);
            let of = |row: usize| &kept[row.min(square_rows - 1) * KEPT * squares..][..KEPT * squares];
            for (line, (a, b)) in line.iter_mut().zip(of(above).iter().zip(of(above + 1))) {
                *line = a + (b - a) * share;
            }
            let radiance = [0, 1, 2].map(|c| &render.radiance.channel(c)[y * width..][..width]);
            for x in 0..width {
                let (left, share) = between(x, squares);
                let right = (left + 1).min(squares - 1);
                let [noise, residual, trust] = [0, 1, 2].map(|k| {
                    let line = &line[k * squares..][..squares];
                    line[left] + (line[right] - line[left]) * share
                });
                let noisy = radiance.map(|row| row[x].max(0.0));
                let colours = [&mut red[x], &mut green[x], &mut blue[x]];
                let is_seen = is_all_seen || (keeps > 0.0 && seen.is_at(x, y));
                if is_seen && keeps == 1.0 {
                    colours.into_iter().zip(noisy).for_each(|(colour, noisy)| *colour = noisy);
                    note(x, 1.0);
                    continue;
                }
                let denoised: f32 = colours.iter().map(|v| v.max(0.0)).sum();
                let difference = (noisy.iter().sum::<f32>() - denoised) / (denoised + 3.0 * floor);
                let own = difference.clamp(-LARGEST_RESIDUAL, LARGEST_RESIDUAL);
                let weight = noise / residual.max(own * own / OUTLIER).max(f32::MIN_POSITIVE);
                let shrunk = trust * (1.0 - weight.min(1.0));
                let direct = match keeps {
                    0.0 => 0.0,
                    _ if is_seen => keeps,
                    _ => keeps * seen.beyond_white(x, y),
                };
                let back = shrunk + direct - shrunk * direct;
                let is_noise = !is_seen && own == LARGEST_RESIDUAL && is_firefly(render, x, y);
                let back = if is_noise { 0.0 } else { back };
                if back > 0.0 {
                    colours.into_iter().zip(noisy).for_each(|(v, noisy)| *v += (noisy - *v) * back);
                }
                note(x, back);
            }
        },
    );
}

/// Pixels (x, y) of the square of `2 reach + 1` rows and columns around one that lie in the frame, itself included.
fn near(planes: &Planes, x: usize, y: usize, reach: usize) -> impl Iterator<Item = (usize, usize)> {
    let around = |at: usize, end: usize| at.saturating_sub(reach)..(at + reach + 1).min(end);
    let columns = around(x, planes.width);
    around(y, planes.height).flat_map(move |y| columns.clone().map(move |x| (x, y)))
}

/// Tells light that comes straight to the camera.
struct Seen<'a> {
    radiance: &'a Planes,
    albedo: &'a Planes,
    /// What the film's exposure multiplied light by, and not the albedo.
    film: f32,
}

impl Seen<'_> {
    /// Whether a pixel has the brightness of its albedo.
    fn equals_albedo(&self, at: usize) -> bool {
        let [light, white] =
            [self.radiance, self.albedo].map(|planes| [0, 1, 2].map(|c| planes.channel(c)[at]));
        equals(light, white, self.film)
    }

    /// Whether a frame is nothing but such light.
    fn is_all(&self) -> bool {
        let pixels = self.radiance.pixels();
        let most = (UNLIKE * pixels as f64) as usize;
        (0..pixels).filter(|at| !self.equals_albedo(*at)).take(most + 1).count() <= most
    }

    /// Whether the light of a pixel is such, as that of its neighbours is.
    fn is_at(&self, x: usize, y: usize) -> bool {
        let width = self.radiance.width;
        let equals_albedo = |x: usize, y: usize| self.equals_albedo(y * width + x);
        // Black is no light, but where a lamp or a star ends it is as good company as any.
        let is_lit = (0..3).any(|c| self.albedo.channel(c)[y * width + x] > 0.0);
        is_lit && equals_albedo(x, y) && {
            let beyond = 9 - near(self.radiance, x, y, 1).count();
            let seen = near(self.radiance, x, y, 1).filter(|&(x, y)| equals_albedo(x, y)).count();
            seen + beyond >= SEEN_TOGETHER
        }
    }

    /// The share of a pixel's light that is such, or comes by way of mirrors, as far as the albedo shows it beyond
    /// white. One pixel alone, as a rough mirror throws it, is as likely to be noise.
    fn beyond_white(&self, x: usize, y: usize) -> f32 {
        let Self { radiance, albedo, film } = self;
        let beyond = |x: usize, y: usize| {
            let at = y * radiance.width + x;
            let colours =
                (0..3).map(|c| (albedo.channel(c)[at].min(radiance.channel(c)[at] / film) - 1.0, c));
            colours.fold((0.0, 0), |most, colour| if colour.0 > most.0 { colour } else { most })
        };
        let (light, c) = beyond(x, y);
        if light <= 0.0 {
            return 0.0;
        }
        let others = near(radiance, x, y, 1).filter(|&other| other != (x, y));
        let company = others.map(|(x, y)| beyond(x, y).0).fold(0.0, f32::max);
        let share = film * light / radiance.channel(c)[y * radiance.width + x];
        share * (ALONE * company / light).min(1.0)
    }
}

/// Whether a pixel is far brighter than all around it.
fn is_firefly(render: &Render, x: usize, y: usize) -> bool {
    let radiance = render.radiance;
    let brightest = |(x, y): (usize, usize)| {
        (0..3).map(|c| radiance.channel(c)[y * radiance.width + x]).fold(0.0, f32::max)
    };
    let others = near(radiance, x, y, 2).filter(|&other| other != (x, y)).map(brightest);
    brightest((x, y)) > render.firefly * others.fold(0.0, f32::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    const SIZE: (usize, usize) = (93, 70);

    fn planes(value: impl Fn(usize, usize, usize) -> f32) -> Planes {
        let (w, h) = SIZE;
        Planes::from_vec(
            3,
            w,
            h,
            (0..3 * w * h).map(|i| value(i / (w * h), i % w, i % (w * h) / w)).collect(),
        )
    }

    /// A picture of fine texture of the light: stripes in both directions, a few pixels wide.
    fn picture(c: usize, x: usize, y: usize) -> f32 {
        0.3 + 0.1 * (0.9 * x as f32 + c as f32).sin() * (0.7 * y as f32).cos()
    }

    /// The picture, each pixel brighter or darker by as much as `noise` at most.
    fn noisy(noise: f32) -> Planes {
        let mut rng = Rng::new(7, 0);
        let (w, h) = SIZE;
        let grey: Vec<f32> = (0..w * h).map(|_| 1.0 + noise * (2.0 * rng.uniform() - 1.0)).collect();
        planes(|c, x, y| picture(c, x, y) * grey[y * w + x])
    }

    fn error(image: &Planes) -> f32 {
        let truth = planes(picture);
        let squares: f32 = image.data.iter().zip(&truth.data).map(|(a, b)| (a - b) * (a - b)).sum();
        squares / truth.data.len() as f32
    }

    /// What becomes of `denoised` beside `radiance`.
    fn shrunk(denoised: &Planes, radiance: &Planes, albedo: &Planes, samples: Option<u32>) -> Planes {
        let mut image = denoised.clone();
        let render = Render { radiance, albedo, exposure: 0.6, samples, firefly: 32.0 };
        shrink(&mut image, &render, None);
        image
    }

    #[test]
    fn a_blurred_frame_without_noise_is_taken_back_and_a_noisy_one_is_not() {
        let (blurred, albedo) = (planes(|_, _, _| 0.3), planes(|_, _, _| 0.5));
        for samples in [None, Some(64), Some(4096)] {
            let clean = shrunk(&blurred, &noisy(0.0), &albedo, samples);
            assert!(
                error(&clean) < 0.02 * error(&blurred),
                "{samples:?}: {}",
                error(&clean) / error(&blurred)
            );
        }
        // 30% noise at 4 samples: the blurred frame is the better one.
        let radiance = noisy(0.5);
        assert!(error(&radiance) > error(&blurred));
        let kept = shrunk(&blurred, &radiance, &albedo, Some(4));
        assert!(error(&kept) < 1.02 * error(&blurred), "{}", error(&kept) / error(&blurred));
    }

    #[test]
    fn of_a_little_noise_the_mixture_is_better_than_both() {
        let (blurred, albedo) = (planes(|c, x, y| 0.7 * picture(c, x, y) + 0.09), planes(|_, _, _| 0.5));
        let radiance = noisy(0.12);
        let mixed = error(&shrunk(&blurred, &radiance, &albedo, Some(64)));
        assert!(mixed < 0.9 * error(&blurred).min(error(&radiance)), "{mixed}");
    }

    #[test]
    fn a_perfect_result_stays() {
        let (truth, albedo) = (planes(picture), planes(|_, _, _| 0.5));
        let radiance = noisy(0.3);
        for samples in [None, Some(4), Some(64)] {
            let kept = shrunk(&truth, &radiance, &albedo, samples);
            assert!(
                error(&kept) < 0.08 * error(&radiance),
                "{samples:?}: {}",
                error(&kept) / error(&radiance)
            );
        }
    }

    #[test]
    fn light_seen_directly_is_kept_and_chance_is_not() {
        // A screen of 20x10 whose light is in the albedo, a pixel that has its albedo's brightness, and a star.
        let is_screen = |x: usize, y: usize| (30..50).contains(&x) && (20..30).contains(&y);
        let light = |c: usize, x: usize, y: usize| match (x, y) {
            _ if is_screen(x, y) => 3.0 + ((x * 7 + y * 5 + c) % 11) as f32,
            (70, 50) => 40.0,
            (60..80, 40..60) => 0.0,
            _ => 0.25,
        };
        let albedo =
            planes(|c, x, y| if light(c, x, y) == 0.25 && (x, y) != (10, 10) { 0.5 } else { light(c, x, y) });
        let radiance = planes(light);
        let image = shrunk(&planes(|_, _, _| 0.3), &radiance, &albedo, Some(64));
        let at = |c: usize, x: usize, y: usize| image.channel(c)[y * SIZE.0 + x];
        for (x, y) in [(35, 25), (49, 24), (40, 20), (70, 50)] {
            assert_eq!([0, 1, 2].map(|c| at(c, x, y)), [0, 1, 2].map(|c| light(c, x, y)), "at {x}, {y}");
        }
        let other = [0, 1, 2].map(|c| at(c, 10, 10));
        assert_eq!(
            other,
            [0, 1, 2].map(|c| at(c, 12, 12)),
            "one pixel of its albedo's brightness is nothing special"
        );
    }

    #[test]
    fn the_exposure_of_the_film_hides_no_light_that_is_seen() {
        // A screen over a third of the frame; the rest is a noisy wall. The film's exposure multiplies light alone.
        let albedo = planes(|c, x, y| if x < 30 { 0.2 + ((x * 7 + y * 5 + c) % 11) as f32 } else { 0.5 });
        let wall = noisy(0.3);
        let radiance = planes(|c, x, y| (if x < 30 { &albedo } else { &wall }).channel(c)[y * SIZE.0 + x]);
        let image = shrunk(&planes(picture), &radiance, &albedo, Some(64));
        assert!((0..3).all(|c| image.channel(c)[..30] == radiance.channel(c)[..30]), "the screen is kept");
        for film in [0.5, 1.0, 1.3, 4.0, 2f32.powi(-12), 2f32.powi(12)] {
            let times = |image: &Planes| planes(|c, x, y| film * image.channel(c)[y * SIZE.0 + x]);
            let render = Render {
                radiance: &times(&radiance),
                albedo: &albedo,
                exposure: 0.6 / film,
                samples: Some(64),
                firefly: 32.0,
            };
            assert!((film_exposure(&render) / film - 1.0).abs() < 0.003, "{film}");
            let mut exposed = times(&planes(picture));
            shrink(&mut exposed, &render, None);
            let near = |(a, b): (&f32, &f32)| (a / film - b).abs() <= 1e-4 * b.abs();
            let same = exposed.data.iter().zip(&image.data).filter(|pair| near(*pair)).count();
            assert!(same == image.data.len(), "{film}: {same} of {}", image.data.len());
        }
        // A wall alone has no such light, whatever its noise.
        let render = Render {
            radiance: &wall,
            albedo: &planes(|_, _, _| 0.5),
            exposure: 1.0,
            samples: None,
            firefly: 32.0,
        };
        assert_eq!(film_exposure(&render), 1.0);
    }

    #[test]
    fn of_few_samples_what_antialiasing_makes_of_a_bright_sky_is_noise() {
        // Gaps of a blind, of which a quarter of the samples see the sky: 0 to 4 of 4, by chance.
        let mut rng = Rng::new(3, 0);
        let (w, h) = SIZE;
        let hit = |_| (0..4).filter(|_| rng.uniform() < 0.25).count() as f32;
        let seen: Vec<f32> = (0..w * h).map(hit).collect();
        let is_wall = |x: usize| x > 70;
        let sky = planes(|_, x, y| if is_wall(x) { 0.25 } else { 1.25 * seen[y * w + x] });
        let albedo = planes(|c, x, y| if is_wall(x) { 0.5 } else { sky.channel(c)[y * w + x] });
        let truth = planes(|_, x, _| if is_wall(x) { 0.25 } else { 1.25 });
        let off = |image: &Planes| -> f32 {
            image.data.iter().zip(&truth.data).map(|(a, b)| (a - b) * (a - b)).sum()
        };
        let image = shrunk(&truth, &sky, &albedo, Some(4));
        assert!(off(&image) < 0.05 * off(&sky), "{} of {}", off(&image), off(&sky));
        // So is what a sky of fine clouds looks like: its noise is in the albedo as well, which it is divided by.
        let clouds = planes(|_, x, y| if is_wall(x) { 0.25 } else { 0.8 + 0.2 * seen[y * w + x] });
        let albedo = planes(|c, x, y| if is_wall(x) { 0.5 } else { clouds.channel(c)[y * w + x] });
        let truth = planes(|_, x, _| if is_wall(x) { 0.25 } else { 1.0 });
        let image = shrunk(&truth, &clouds, &albedo, Some(4));
        let off = |image: &Planes| -> f32 {
            image.data.iter().zip(&truth.data).map(|(a, b)| (a - b) * (a - b)).sum()
        };
        assert!(off(&image) < 0.1 * off(&clouds), "{} of {}", off(&image), off(&clouds));
        // The same light in a frame of nothing else is a picture, and stays.
        assert!(shrunk(&truth, &sky, &sky, Some(4)) == sky, "a picture has changed");
    }

    #[test]
    fn lone_fireflies_do_not_come_back() {
        let (truth, albedo) = (planes(picture), planes(|_, _, _| 0.5));
        let mut radiance = noisy(0.02);
        for (x, y) in [(20, 20), (50, 33), (0, 0), (92, 69)] {
            (0..3).for_each(|c| radiance.channel_mut(c)[y * SIZE.0 + x] = 5000.0);
        }
        let kept = shrunk(&truth, &radiance, &albedo, Some(64));
        assert!(kept.data.iter().all(|v| *v < 1.0));
    }

    #[test]
    fn tiny_frames_of_any_brightness_stay_finite() {
        for (w, h) in [(1, 1), (1, 9), (9, 1), (2, 3), (4, 4), (5, 17)] {
            for v in [0.0, 1e-30, 1.0, 65504.0] {
                let of = |v: f32| Planes::from_vec(3, w, h, vec![v; 3 * w * h]);
                let mut image = of(v);
                let render = Render {
                    radiance: &of(0.5 * v),
                    albedo: &of(0.7),
                    exposure: 1.0,
                    samples: None,
                    firefly: 32.0,
                };
                shrink(&mut image, &render, None);
                assert!(image.data.iter().all(|x| x.is_finite() && *x <= v && *x >= 0.5 * v), "{w}x{h}, {v}");
            }
        }
    }
}
