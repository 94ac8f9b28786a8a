//! What is summed up over squares of pixels: the noise, what the denoiser changed, and how that correlates
//! with detail.

use rayon::prelude::*;

use super::{
    FLOOR, Render,
    seen::{SAME, Seen},
};
use crate::{
    filters::squares::SQUARE,
    kernels::vectorised::{self, Vectorised},
    planes::{Planes, mirrored},
};

/// Number of sums of a square; the constants below are their indices. A row of squares has a line of each.
pub const SUMS: usize = 13;
/// The number of pixels.
pub const COUNT: usize = 0;
/// The squared residual. A residual is the difference from the denoised light to the render, relative to the
/// former.
pub const RESIDUAL: usize = 1;
/// Two measures of noise, of the light and of the light over the albedo.
pub const NOISE: [usize; 2] = [2, 3];
/// What cutting the residual took from its square.
pub const CUT: usize = 4;
/// The products of each residual with those to the right and below, whose mean is zero for noise.
pub const NEXT: [usize; 2] = [5, 6];
/// The squares of the detail of the denoised light and of the albedo. Detail is the difference of a pixel to
/// the mean of the four around it.
pub const DETAIL: [usize; 2] = [7, 8];
/// The products of the residual with the detail of the denoised light, of the albedo, and of the render.
pub const BY_DETAIL: [usize; 3] = [9, 10, 11];
/// The denoised light.
pub const LIGHT: usize = 12;

/// Added to the albedo before light is divided by it.
const ALBEDO_FLOOR: f32 = 0.02;

/// Relative residuals are cut at [`LARGEST_RESIDUAL`], since a firefly would decide on all around it. Their
/// squares before that count as at most [`LARGEST_CUT`].
pub const LARGEST_RESIDUAL: f32 = 1.0;
const LARGEST_CUT: f32 = 100.0;

/// Relative differences between pixels are cut at this.
const LARGEST_DIFFERENCE: f32 = 6.0;
const LARGEST_DETAIL: f32 = 1.0;

/// The variance of noise divided by the mean of its smallest squared second difference along four directions.
/// For a single direction this is a sixth; the rest makes up for taking the smallest, and was found by
/// drawing 360,000 independent normal values.
const VARIANCE_OF_SMALLEST: f32 = 3.5706 / 6.0;

/// Rows of squares that a thread gathers at once: the rows of pixels just above and below are computed twice.
const STRIP: usize = 4;

/// The sums of every row of squares, [`SUMS`] lines each.
pub fn gather(image: &Planes, render: &Render, seen: &Seen) -> Vec<f32> {
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
                vectorised::run(Add { above, row, below, has_one_row: height == 1, columns: &mut columns });
            }
            for (line, columns) in sums.chunks_exact_mut(squares).zip(columns.chunks_exact(width)) {
                let of_squares = columns.chunks(SQUARE).map(|part| part.iter().sum::<f32>());
                line.iter_mut().zip(of_squares).for_each(|(sum, of_square)| *sum = of_square);
            }
        }
    });
    sums
}

/// What is read of a row of pixels. Each line has one value more on either side, where the row's mirror image
/// lies.
struct PixelRow {
    /// The mean of the colours of the render.
    light: Vec<f32>,
    /// The mean of the colours of the render over the albedo.
    ratio: Vec<f32>,
    /// The mean of the colours of the denoised frame.
    denoised: Vec<f32>,
    /// The mean of the colours of the albedo.
    albedo: Vec<f32>,
    /// What differences of light and of ratios are multiplied by to be relative.
    scales: [Vec<f32>; 2],
    /// The relative residual after cutting, and what cutting took from its square.
    residual: Vec<f32>,
    cut: Vec<f32>,
}

impl PixelRow {
    fn read(image: &Planes, render: &Render, film: f32, y: usize) -> Self {
        let width = image.width;
        let line = || vec![0.0; width + 2];
        let [light, ratio, denoised, albedo, residual, cut] = [(); 6].map(|()| line());
        let mut row = Self { light, ratio, denoised, albedo, scales: [line(), line()], residual, cut };
        let [image, radiance, albedo] = [image, render.radiance, render.albedo].map(|planes| planes.rows(y));
        let floor = FLOOR / render.exposure;
        vectorised::run(Read { image, radiance, albedo, film, floor, row: &mut row });
        let Self { light, ratio, denoised, albedo, residual, .. } = &mut row;
        for line in [light, ratio, denoised, albedo, residual] {
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
        let PixelRow { light, ratio, denoised, albedo: white, scales: [of_light, of_ratio], residual, cut } =
            row;
        let [light, ratio, denoised, white, of_light, of_ratio, residual, cut] =
            [light, ratio, denoised, white, of_light, of_ratio, residual, cut]
                .map(|line| &mut line[1..][..width]);
        // At first `cut` holds by how much more than a rounding error the light differs from the albedo,
        // which is 0 where the light is seen directly.
        for c in 0..3 {
            for x in 0..width {
                // No surface reflects more light than it gets, so what the albedo holds beyond white is light
                // that is seen.
                let surface = albedo[c][x].clamp(0.0, 1.0);
                let over = 1.0 / (3.0 * (surface + ALBEDO_FLOOR));
                let (noisy, clean) = (radiance[c][x].max(0.0), image[c][x].max(0.0));
                let rounding = film * (SAME.0 * albedo[c][x].abs() + SAME.1);
                cut[x] = cut[x].max((noisy - film * albedo[c][x]).abs() - rounding);
                light[x] += noisy * (1.0 / 3.0);
                ratio[x] += noisy * over;
                denoised[x] += clean * (1.0 / 3.0);
                of_ratio[x] += clean * over;
                white[x] += surface * (1.0 / 3.0);
            }
        }
        for x in 0..width {
            // The noise of light that is seen directly is in the albedo as well, and their quotient tells
            // nothing of it.
            let is_seen = cut[x] <= 0.0;
            ratio[x] = if is_seen { light[x] } else { ratio[x] };
            of_ratio[x] = if is_seen { denoised[x] } else { of_ratio[x] };
            let relative = 1.0 / (denoised[x] + floor);
            let whole = (light[x] - denoised[x]) * relative;
            residual[x] = whole.clamp(-LARGEST_RESIDUAL, LARGEST_RESIDUAL);
            cut[x] = (whole * whole).min(LARGEST_CUT) - residual[x] * residual[x];
            of_light[x] = relative;
            of_ratio[x] = 1.0 / (of_ratio[x] + floor);
        }
    }
}

/// Adds a row of pixels to the sums over columns.
struct Add<'a> {
    above: &'a PixelRow,
    row: &'a PixelRow,
    below: &'a PixelRow,
    has_one_row: bool,
    /// [`SUMS`] lines with a value for each column.
    columns: &'a mut [f32],
}

impl Vectorised for Add<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { above, row, below, has_one_row, columns } = self;
        let width = row.light.len() - 2;
        let of_rows = |line: fn(&PixelRow) -> &Vec<f32>| [above, row, below].map(|row| &line(row)[..]);
        let scales = [0, 1].map(|of| &row.scales[of][1..][..width]);
        let (light, ratio) = (of_rows(|row| &row.light), of_rows(|row| &row.ratio));
        let sides = [width == 1, has_one_row];
        add_differences(light, scales[0], sides, &mut columns[NOISE[0] * width..][..width]);
        add_differences(ratio, scales[1], sides, &mut columns[NOISE[1] * width..][..width]);
        let own = &row.residual[1..][..width];
        let lines: Vec<&mut [f32]> = columns.chunks_exact_mut(width).collect();
        let Ok(lines) = <[&mut [f32]; SUMS]>::try_from(lines) else {
            unreachable!("there are so many lines")
        };
        let [count, residual, _, _, cut, right, under, smooth, texture, by_smooth, by_texture, by_noisy, sum] =
            lines;
        let next = [own, &row.residual[2..][..width], &below.residual[1..][..width]];
        // A neighbour that is the pixel itself would tell of detail where there is noise.
        let is_another = [true, width > 1, !has_one_row];
        for ((sums, next), _) in
            [residual, right, under].into_iter().zip(next).zip(is_another).filter(|(_, is)| *is)
        {
            sums.iter_mut().zip(own.iter().zip(next)).for_each(|(sum, (own, next))| *sum += own * next);
        }
        let (denoised, albedo) = (of_rows(|row| &row.denoised), of_rows(|row| &row.albedo));
        for x in 0..width {
            let relative = |detail: f32| (detail * scales[0][x]).clamp(-LARGEST_DETAIL, LARGEST_DETAIL);
            let details = [relative(detail(denoised, x)), detail(albedo, x), relative(detail(light, x))];
            count[x] += 1.0;
            cut[x] += row.cut[1 + x];
            smooth[x] += details[0] * details[0];
            texture[x] += details[1] * details[1];
            by_smooth[x] += details[0] * own[x];
            by_texture[x] += details[1] * own[x];
            by_noisy[x] += details[2] * own[x];
            sum[x] += row.denoised[1 + x];
        }
    }
}

/// By how much a pixel differs from the mean of the four around it. Lines have one value more on the left.
#[inline(always)]
fn detail([above, row, below]: [&[f32]; 3], x: usize) -> f32 {
    row[x + 1] - 0.25 * (row[x] + row[x + 2] + above[x + 1] + below[x + 1])
}

/// Adds the variance of noise that follows from the smallest of four second differences, each times `scale`.
/// In a frame of one column or one row, the mirror images of a pixel are the pixel itself, and tell nothing of
/// noise.
#[inline(always)]
fn add_differences(
    [above, row, below]: [&[f32]; 3],
    scale: &[f32],
    [has_one_column, has_one_row]: [bool; 2],
    sums: &mut [f32],
) {
    let [no_across, no_down] =
        [has_one_column, has_one_row].map(|is_one| if is_one { f32::MAX } else { 0.0 });
    let width = sums.len();
    for x in 0..width {
        let twice = 2.0 * row[x + 1];
        let across = (twice - row[x] - row[x + 2]).abs().max(no_across);
        let down = (twice - above[x + 1] - below[x + 1]).abs().max(no_down);
        let falling = (twice - above[x] - below[x + 2]).abs();
        let rising = (twice - above[x + 2] - below[x]).abs();
        let least = (across.min(down).min(falling.min(rising)) * scale[x]).min(LARGEST_DIFFERENCE);
        sums[x] += VARIANCE_OF_SMALLEST * least * least;
    }
}
