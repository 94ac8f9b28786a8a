//! Takes back what a denoiser changed beyond the noise.
//!
//! A denoiser that was trained on noisy frames blurs clean ones. How far it should be followed is an old
//! question of statistics: an unbiased but noisy value `c` (the render) and a biased one `d` (what was
//! denoised) are best mixed as `d + w (c - d)`, with a share `w` that grows with the bias and falls with the
//! noise (James and Stein 1961). Neither is known of one frame alone, but what was changed tells of both:
//! - Cycles draws every pixel by itself, so noise has no direction, while edges and texture have. Of the
//!   second differences along four directions, the smallest holds next to nothing but noise. They are taken
//!   of the light, and of the light over the albedo as rendered, which divides texture away.
//! - The residual `c - d` is uncorrelated from pixel to pixel if it is noise. If it is blurred detail, it is
//!   correlated with its neighbours, with the detail that is left, and with that of the albedo.
//!
//! These are summed up over squares of pixels (`sums`). From the sums a small perceptron finds the share
//! (`restraint`); in a noisy frame it is zero, and all of `d` is taken. From the same sums another perceptron
//! finds how far off the result is (`expected`).
//!
//! Light that the camera sees directly (`seen`: sky, screens, lamps) has no noise but that of antialiasing,
//! and is kept. Of few samples, though, antialiasing is noise like any other: at 4 samples, a pixel in the
//! gap of a blind before a bright sky may show a quarter of the sky, or nothing. What is `empty` is kept as well, and
//! `lamps` do not glow into what lies beside them.

mod empty;
mod expected;
mod features;
mod lamps;
mod restraint;
mod seen;
mod sums;

use rayon::prelude::*;

pub use self::empty::{Alpha, Empty};
use self::{
    lamps::Lamps,
    restraint::OUTPUTS,
    seen::{Seen, SeenRow, is_firefly},
    sums::LARGEST_RESIDUAL,
};
use super::squares::{SQUARE, between, spread};
use crate::{
    kernels::{
        exponential::exp,
        logarithm::ln,
        thirds,
        vectorised::{self, Vectorised},
    },
    planes::Planes,
};

/// Exposed radiance that is added to denoised light before residuals are divided by it, so that relative
/// errors of darker light count less and less.
const FLOOR: f32 = 0.02;

/// [`OWN_FLOOR`] is added to a pixel's own squared residual before its logarithm is compared with that of the
/// mean near by. The two logarithms count as at most [`OWN_RANGE`] apart.
const OWN_FLOOR: f32 = 1e-6;
const OWN_RANGE: f32 = 3.0;

/// Shares nearer than this to none or to all of the render are none or all.
const SNAP: f32 = 1.0 / 64.0;

/// Where a file tells the number of samples `n`, shares below the second value over `n` count as none, but
/// never those above the first value. What looks like a picture in a frame of few samples is noise more often
/// than not.
const DOUBT: (f32, f32) = (0.5, 2.0);

/// Beyond [`FINAL_SAMPLES`] samples, what is taken of the denoised frame falls with the number of samples to
/// the power of [`FINAL_POWER`], because few frames that were learned from had more.
const FINAL_SAMPLES: f32 = 192.0;
const FINAL_POWER: f32 = 0.75;

/// A frame that tells of thousands of samples may be one that was allowed so many, of which adaptive sampling
/// took far fewer. [`ADAPTIVE_LEAST`] of what was denoised is taken in any case, if the [noise of the
/// frame](features::noise_of_frame) is that of [`ADAPTIVE_NOISE`]'s second value or more, and none for that
/// reason up to its first. Frames at Blender's default threshold had 2e-4 and more, two scenes that are nearly
/// clean of 1024 samples 1e-4. Where light changes by more than [`LARGEST_CHANGE`] it counts less: that is no such
/// noise.
const ADAPTIVE_LEAST: f32 = 0.3;
const ADAPTIVE_NOISE: (f32, f32) = (1e-4, 3e-4);

/// By how much the render's light may differ from the denoised light, relative to the latter, before a
/// pixel's share is reduced. This holds for shares near zero; the larger the share, the more it may differ. A
/// pixel that was rendered far brighter than that is noise as long as most pixels around it are.
const LARGEST_CHANGE: f32 = 1.5;

/// The number of samples that a frame is taken to have if it does not tell. It decides how much is kept of
/// light that is seen directly.
const UNKNOWN_SAMPLES: u32 = 16;

/// Up to the first number of samples, no light is kept for being in the albedo as well: its antialiasing is
/// noise, and through glass all of it is. From the second number on, all such light is kept.
const KEPT_SAMPLES: (f32, f32) = (16.0, 64.0);

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
}

impl Render<'_> {
    /// Samples of a pixel, 16 where the file does not tell.
    pub fn samples_or_guess(&self) -> f32 {
        self.samples.unwrap_or(UNKNOWN_SAMPLES).max(1) as f32
    }
}

/// A frame that is about to be shrunk, where its light is seen directly, and where nothing was met.
pub struct Shrinkage<'a> {
    render: &'a Render<'a>,
    seen: Seen<'a>,
    empty: Option<Empty>,
}

impl<'a> Shrinkage<'a> {
    /// Prepares to shrink a frame.
    pub fn of(render: &'a Render<'a>) -> Self {
        Self { render, seen: Seen::of(render), empty: None }
    }

    /// The same with pixels, if there are any, that stay as rendered because nothing was met in them.
    pub fn keeping(self, empty: Option<Empty>) -> Self {
        Self { empty, ..self }
    }

    /// Whether the frame is nothing but light that the camera sees directly, or black: all of it is kept,
    /// whatever was denoised.
    pub fn keeps_whole(&self) -> bool {
        // Light of denormal numbers has no reciprocal.
        self.render.radiance.data.iter().all(|v| *v < f32::MIN_POSITIVE) || self.seen.is_all()
    }

    /// Mixes a denoised `image`, (3, H, W), with the render that it was made of, as far as it differs by more
    /// than noise. The share of the render in each pixel goes into `shares`, (1, H, W), for [`take_back`].
    ///
    /// # Panics
    /// If sizes differ.
    pub fn shrink(&self, image: &mut Planes, shares: Option<&mut Planes>) {
        drop(self.shrink_by_sums(image, shares));
    }

    /// As [`Shrinkage::shrink`]; returns the squared error to be expected in every 4x4 square of pixels of the
    /// result, relative to the squared light there (what RelMSE is the mean of), (1, H / 4, W / 4) rounded up.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn shrink_expecting(&self, image: &mut Planes, shares: Option<&mut Planes>) -> Planes {
        let sums = self.shrink_by_sums(image, shares);
        expected::errors(image, self.render, self.empty.as_ref(), &sums)
    }

    /// Shrinks, and returns the sums from which the shares were found.
    fn shrink_by_sums(&self, image: &mut Planes, shares: Option<&mut Planes>) -> Vec<f32> {
        let Self { render, seen, .. } = self;
        check(image, render);
        if image.pixels() == 0 {
            return Vec::new();
        }
        let sums = sums::gather(image, render, seen);
        let squares = image.width.div_ceil(SQUARE);
        let judged = restraint::judge(&sums, squares, render);
        mix(image, self, &judged, Belief::of(render, &sums, squares), shares);
        sums
    }
}

/// [`Shrinkage::shrink`] of a frame, for callers that need nothing else of it.
///
/// # Panics
/// If sizes differ.
pub fn shrink(image: &mut Planes, render: &Render, shares: Option<&mut Planes>) {
    Shrinkage::of(render).shrink(image, shares);
}

/// The features from which the share of the render is found, for training: a plane for each, with a value for
/// each 4x4 square of pixels, (36, H / 4, W / 4) rounded up.
///
/// # Panics
/// If sizes differ.
pub fn features(image: &Planes, render: &Render) -> Planes {
    check(image, render);
    let (squares, rows) = (image.width.div_ceil(SQUARE), image.height.div_ceil(SQUARE));
    let sums = sums::gather(image, render, &Seen::of(render));
    let lines = features::FEATURES;
    let of_rows =
        features::each_row(&sums, squares, lines, render, |_, features, made| made.copy_from_slice(features));
    let mut planes = Planes::new(lines, squares, rows);
    for (row, features) in of_rows.chunks(lines * squares).enumerate() {
        for (plane, line) in planes.data.chunks_mut(squares * rows).zip(features.chunks(squares)) {
            plane[row * squares..][..squares].copy_from_slice(line);
        }
    }
    planes
}

fn check(image: &Planes, render: &Render) {
    for planes in [render.radiance, render.albedo, image] {
        assert_eq!(planes.extent(), (3, image.width, image.height), "planes of one frame");
    }
}

/// Mixes another denoised layer, (C, H, W), with what was rendered of it, by the `shares` of [`shrink`].
pub fn take_back(denoised: &mut Planes, rendered: &Planes, shares: &Planes) {
    let pixels = shares.pixels();
    let channels = denoised.data.par_chunks_mut(pixels).zip(rendered.data.par_chunks(pixels));
    channels.for_each(|(denoised, rendered)| {
        let values = denoised.iter_mut().zip(rendered).zip(&shares.data);
        values.for_each(|((denoised, rendered), share)| {
            let mixed = *denoised + (rendered - *denoised) * share;
            // As [`Blend`] has it: where all of the render is taken, rounding leaves none of the denoised value.
            *denoised = if *share == 1.0 { *rendered } else { mixed };
        });
    });
}

/// What is set in a mask, or lies at most `reach` rows and columns away from that.
pub(super) fn grown(mask: &[bool], (width, height): (usize, usize), reach: usize) -> Vec<bool> {
    let mut grown = vec![false; mask.len()];
    grown.par_chunks_mut(width).enumerate().for_each_init(
        || vec![false; width + 2 * reach],
        |of_columns, (y, grown)| {
            of_columns.fill(false);
            let rows = y.saturating_sub(reach)..(y + reach + 1).min(height);
            for row in mask[rows.start * width..rows.end * width].chunks(width) {
                of_columns[reach..].iter_mut().zip(row).for_each(|(any, is)| *any |= is);
            }
            for shifted in (0..=2 * reach).map(|first| &of_columns[first..]) {
                grown.iter_mut().zip(shifted).for_each(|(grown, any)| *grown |= any);
            }
        },
    );
    grown
}

/// How much is taken of what shrinkage leaves of the denoised frame.
#[derive(Clone, Copy)]
struct Belief {
    by_samples: f32,
    by_noise: f32,
}

impl Belief {
    fn of(render: &Render, sums: &[f32], squares: usize) -> Self {
        let samples = render.samples_or_guess();
        let by_samples = (FINAL_SAMPLES / samples).min(1.0).powf(FINAL_POWER);
        if by_samples >= ADAPTIVE_LEAST {
            return Self { by_samples, by_noise: 0.0 };
        }
        let [none, all] = [ADAPTIVE_NOISE.0, ADAPTIVE_NOISE.1].map(f32::ln);
        let noise = (features::noise_of_frame(sums, squares) + features::TINY).ln();
        Self { by_samples, by_noise: ADAPTIVE_LEAST * ((noise - none) / (all - none)).clamp(0.0, 1.0) }
    }

    /// In a pixel whose light changes by `change`, relative to the denoised light, if all of the render is taken.
    #[inline(always)]
    fn at(self, change: f32) -> f32 {
        self.by_samples.max(self.by_noise * (LARGEST_CHANGE / change.abs()).min(1.0))
    }
}

/// Mixes every pixel, and writes the shares of the render, where they are asked for. `judged` is what was
/// [judged](restraint::judge) of the squares.
fn mix(
    image: &mut Planes,
    Shrinkage { render, seen, empty }: &Shrinkage,
    judged: &[f32],
    belief: Belief,
    shares: Option<&mut Planes>,
) {
    let (width, height) = (image.width, image.height);
    let (squares, square_rows) = (width.div_ceil(SQUARE), height.div_ceil(SQUARE));
    let floor = FLOOR / render.exposure;
    let samples = render.samples_or_guess();
    let (few, many) = KEPT_SAMPLES;
    let doubt = render.samples.map_or(0.0, |_| (DOUBT.1 / samples).min(DOUBT.0)).max(SNAP);
    let is_all_seen = seen.is_all();
    let by_samples = ((samples / few).log2() / (many / few).log2()).clamp(0.0, 1.0);
    let keeps = if is_all_seen { 1.0 } else { by_samples };
    let lamps = (keeps > 0.0).then(|| Lamps::of(render)).flatten();
    let [red, green, blue] = thirds(&mut image.data).map(|plane| plane.par_chunks_mut(width));
    let shares: Vec<Option<&mut [f32]>> = match shares {
        Some(shares) => shares.data.chunks_mut(width).map(Some).collect(),
        None => (0..height).map(|_| None).collect(),
    };
    red.zip(green).zip(blue).zip(shares).enumerate().for_each_init(
        || Memory::of(width, squares),
        |Memory { line, judged: of_pixels, changes, backs, seen_row },
         (y, (((red, green), blue), shares))| {
            let is_empty = empty.as_ref().map(|empty| empty.row(y));
            let (above, share) = between(y, square_rows);
            let of =
                |row: usize| &judged[row.min(square_rows - 1) * OUTPUTS * squares..][..OUTPUTS * squares];
            for (line, (a, b)) in line.iter_mut().zip(of(above).iter().zip(of(above + 1))) {
                *line = a + (b - a) * share;
            }
            let noisy = render.radiance.rows(y);
            let image = [&*red, &*green, &*blue];
            vectorised::run(Judge {
                line,
                noisy,
                image,
                belief,
                doubt,
                floor,
                judged: of_pixels,
                changes,
                backs,
            });
            if is_all_seen {
                seen_row.is_seen.fill(1.0);
            } else if keeps > 0.0 {
                seen.read_row(y, seen_row);
            }
            for (x, back) in backs.iter_mut().enumerate() {
                let is_seen = seen_row.is_seen[x] > 0.0;
                if (is_seen && keeps == 1.0) || is_empty.is_some_and(|row| row[x]) {
                    *back = 1.0;
                    continue;
                }
                let direct = match keeps {
                    0.0 => 0.0,
                    _ if is_seen => keeps,
                    _ => keeps * seen.beyond_white(x, y),
                };
                *back = *back + direct - *back * direct;
                if !is_seen && changes[x] >= LARGEST_RESIDUAL && is_firefly(render, x, y) {
                    *back = 0.0;
                }
                if let Some(most) = lamps.as_ref().and_then(|lamps| lamps.most_beside(x, y)) {
                    let light = |planes: [&[f32]; 3]| planes.map(|row| row[x].max(0.0)).iter().sum::<f32>();
                    let (denoised, rendered) = (light([red, green, blue]), light(noisy));
                    if denoised > most {
                        *back = back.max(keeps * (denoised - most) / (denoised - rendered));
                    }
                }
            }
            vectorised::run(Blend { image: [red, green, blue], noisy, backs });
            if let Some(shares) = shares {
                shares.copy_from_slice(backs);
            }
        },
    );
}

/// Memory for a row of pixels.
struct Memory {
    /// What was judged of the squares, interpolated vertically to the row, [`OUTPUTS`] lines.
    line: Vec<f32>,
    /// The same of every pixel.
    judged: Vec<f32>,
    changes: Vec<f32>,
    backs: Vec<f32>,
    seen_row: SeenRow,
}

impl Memory {
    fn of(width: usize, squares: usize) -> Self {
        Self {
            line: vec![0.0; OUTPUTS * squares],
            judged: vec![0.0; OUTPUTS * width],
            changes: vec![0.0; width],
            backs: vec![0.0; width],
            seen_row: SeenRow::none(width),
        }
    }
}

/// Finds the share of the render in each pixel of a row.
struct Judge<'a> {
    /// What was judged of the squares, [`OUTPUTS`] lines.
    line: &'a [f32],
    noisy: [&'a [f32]; 3],
    image: [&'a [f32]; 3],
    belief: Belief,
    doubt: f32,
    floor: f32,
    /// Memory for [`OUTPUTS`] rows.
    judged: &'a mut [f32],
    /// By how much each pixel's light would change, relative to the denoised light, if all of the render were taken.
    changes: &'a mut [f32],
    /// The shares.
    backs: &'a mut [f32],
}

impl Vectorised for Judge<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { line, noisy, image, belief, doubt, floor, judged, changes, backs } = self;
        let width = backs.len();
        let squares = line.len() / OUTPUTS;
        for (line, row) in line.chunks_exact(squares).zip(judged.chunks_exact_mut(width)) {
            spread(line, row);
        }
        let [logits, slopes, usual] = [0, 1, 2].map(|k| &judged[k * width..][..width]);
        let [[red, green, blue], of_image] = [noisy, image].map(|planes| planes.map(|row| &row[..width]));
        let changes = &mut changes[..width];
        // Without closures over arrays, which are not inlined and keep the loop from being vectorised.
        for x in 0..width {
            let light = red[x].max(0.0) + green[x].max(0.0) + blue[x].max(0.0);
            let denoised = of_image[0][x].max(0.0) + of_image[1][x].max(0.0) + of_image[2][x].max(0.0);
            let change = (light - denoised) / (denoised + 3.0 * floor);
            let share = share_of_render([logits[x], slopes[x], usual[x]], change, doubt);
            changes[x] = change;
            backs[x] = 1.0 - belief.at(change) * (1.0 - share);
        }
    }
}

/// Mixes a row of the denoised image with the render, of which each pixel takes its share.
struct Blend<'a> {
    image: [&'a mut [f32]; 3],
    noisy: [&'a [f32]; 3],
    backs: &'a [f32],
}

impl Vectorised for Blend<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { image, noisy, backs } = self;
        for (image, noisy) in image.into_iter().zip(noisy) {
            for ((value, noisy), back) in image.iter_mut().zip(noisy).zip(backs) {
                let (own, noisy) = (*value, noisy.max(0.0));
                let mixed = own + (noisy - own) * back;
                let mixed = if *back > 0.0 { mixed } else { own };
                *value = if *back == 1.0 { noisy } else { mixed };
            }
        }
    }
}

/// The share of the render in a pixel, by what was [judged](restraint::judge) of the place. `change` is the
/// relative change of the pixel's light if all of the render were taken. Shares below `doubt` are none.
#[inline(always)]
fn share_of_render([logit, slope, usual]: [f32; OUTPUTS], change: f32, doubt: f32) -> f32 {
    let own = change.clamp(-LARGEST_RESIDUAL, LARGEST_RESIDUAL);
    let unusual = (ln(own * own + OWN_FLOOR) - usual).clamp(-OWN_RANGE, OWN_RANGE) / OWN_RANGE;
    let share = 1.0 / (1.0 + exp(-(logit + slope * unusual)));
    let share = ((share - doubt) / (1.0 - SNAP - doubt)).clamp(0.0, 1.0);
    let less = share * (LARGEST_CHANGE / ((1.0 - share) * change.abs()).max(f32::MIN_POSITIVE)).min(1.0);
    if share == 1.0 { share } else { less }
}

#[cfg(test)]
mod tests {
    use super::{seen::film_exposure, *};
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
        let render = Render { radiance, albedo, exposure: 0.6, samples };
        shrink(&mut image, &render, None);
        image
    }

    #[test]
    fn noise_is_told_in_a_frame_of_one_row_or_one_column() {
        let mut rng = Rng::new(3, 0);
        let noise: Vec<f32> = (0..300).map(|_| 2.0 * rng.uniform()).collect();
        let noise = [&noise[..], &noise, &noise].concat();
        for (width, height) in [(300, 1), (1, 300)] {
            let plane = |values: Vec<f32>| Planes::from_vec(3, width, height, values);
            let (flat, albedo) = (plane(vec![1.0; 900]), plane(vec![0.5; 900]));
            let image = shrunk(&flat, &plane(noise.clone()), &albedo, Some(4));
            let change: f32 = image.data.iter().map(|v| (v - 1.0).abs()).sum::<f32>() / 900.0;
            assert!(change < 0.05, "{width}x{height}: {change} of the noise of 0.5 is back");
        }
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
    fn frames_that_tell_thousands_of_samples_are_denoised_where_they_are_noisy() {
        let (truth, albedo) = (planes(picture), planes(|_, _, _| 0.5));
        let mut radiance = noisy(0.3);
        // An edge or a highlight that the denoiser lost, three pixels long: no firefly.
        let place = 35 * SIZE.0 + 40;
        (0..3).for_each(|c| radiance.channel_mut(c)[place..place + 3].fill(30.0));
        let kept = shrunk(&truth, &radiance, &albedo, Some(4096));
        let highlight = kept.channel(0)[place..place + 3].iter().sum::<f32>() / 90.0;
        assert!(highlight > 0.85, "{highlight}");
        let (mut without, mut before) = (kept, radiance);
        for image in [&mut without, &mut before] {
            (0..3).for_each(|c| {
                image.channel_mut(c)[place..place + 3].copy_from_slice(&truth.channel(c)[place..place + 3]);
            });
        }
        assert!(error(&without) < 0.6 * error(&before), "{}", error(&without) / error(&before));
    }

    #[test]
    fn light_seen_directly_is_kept_and_chance_is_not() {
        // A screen of 20x10 whose light is in the albedo, a pixel that has its albedo's brightness, and a
        // star.
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
        // A screen over a third of the frame; the rest is a noisy wall. The film's exposure multiplies light
        // alone.
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
            };
            assert!((film_exposure(&render) / film - 1.0).abs() < 0.003, "{film}");
            let mut exposed = times(&planes(picture));
            shrink(&mut exposed, &render, None);
            let near = |(a, b): (&f32, &f32)| (a / film - b).abs() <= 1e-4 * b.abs();
            let same = exposed.data.iter().zip(&image.data).filter(|pair| near(*pair)).count();
            assert!(same == image.data.len(), "{film}: {same} of {}", image.data.len());
        }
        // Of a large frame some pixels are counted, of all columns: a sign of three is found wherever it stands.
        let (width, height) = (1024, 512);
        for first in 509..515 {
            let mut rng = Rng::new(4, 0);
            let mut light = |film: f32| {
                let sign = |i: usize| film * (1 + i / width % 7) as f32;
                let is_sign = |i: usize| (first..first + 3).contains(&(i % width));
                let pixels = (0..3 * width * height)
                    .map(|i| if is_sign(i) { sign(i) } else { 0.01 + rng.uniform() })
                    .collect();
                Planes::from_vec(3, width, height, pixels)
            };
            let (albedo, radiance) = (light(1.0), light(1.5));
            let render = Render { radiance: &radiance, albedo: &albedo, exposure: 1.0, samples: Some(64) };
            assert!((film_exposure(&render) / 1.5 - 1.0).abs() < 0.003, "columns from {first} on");
        }
        // A wall alone has no such light, whatever its noise.
        let albedo = &planes(|_, _, _| 0.5);
        let render = Render { radiance: &wall, albedo, exposure: 1.0, samples: None };
        assert_eq!(film_exposure(&render), 1.0);
    }

    #[test]
    fn lamps_do_not_glow_into_pixels_that_no_sample_of_them_met() {
        // A lamp on a noisy wall, and what a network left of it in the pixels beside it.
        let is_lamp = |x: usize, y: usize| (30..40).contains(&x) && (30..40).contains(&y);
        let is_beside = |x: usize, y: usize| (28..42).contains(&x) && (28..42).contains(&y) && !is_lamp(x, y);
        let wall = noisy(0.3);
        let lit = |light: f32, x, y, other: f32| if is_lamp(x, y) { light } else { other };
        let radiance = planes(|c, x, y| lit(2000.0, x, y, wall.channel(c)[y * SIZE.0 + x]));
        let albedo = planes(|_, x, y| lit(2000.0, x, y, 0.5));
        let denoised =
            planes(|c, x, y| lit(2000.0, x, y, picture(c, x, y) + if is_beside(x, y) { 40.0 } else { 0.0 }));
        for samples in [64, 256] {
            let image = shrunk(&denoised, &radiance, &albedo, Some(samples));
            for (x, y) in
                (0..SIZE.1).flat_map(|y| (0..SIZE.0).map(move |x| (x, y))).filter(|(x, y)| is_beside(*x, *y))
            {
                let light = (0..3).map(|c| image.channel(c)[y * SIZE.0 + x]).sum::<f32>();
                assert!(light < 3.0, "{samples} samples: {light} at {x}, {y}");
            }
        }
    }

    #[test]
    fn where_all_of_the_render_is_taken_nothing_of_the_denoised_light_is_left() {
        let one = |v: f32| Planes::from_vec(1, 2, 1, vec![v; 2]);
        let mut light = one(1e4);
        take_back(&mut light, &one(1e-4), &Planes::from_vec(1, 2, 1, vec![1.0, 0.5]));
        assert_eq!(light.data[..], [1e-4, 5000.0]);
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
        // So is what a sky of fine clouds looks like: its noise is in the albedo as well, which it is divided
        // by.
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
    fn a_lamp_in_a_mirror_is_kept_and_two_sparks_side_by_side_are_not() {
        // The mirror is a little grey, so no light equals its albedo. The lamp covers four pixels.
        let lamp = [(40, 30), (41, 30), (40, 31), (41, 31)];
        let sparks = [(20, 20), (21, 21), (70, 50), (71, 50)];
        let is_bright = |x, y| lamp.contains(&(x, y)) || sparks.contains(&(x, y));
        let albedo = planes(|_, x, y| if is_bright(x, y) { 30.0 } else { 0.5 });
        let (truth, wall) = (planes(picture), noisy(0.02));
        let (w, _) = SIZE;
        let radiance = planes(|c, x, y| if is_bright(x, y) { 32.0 } else { wall.channel(c)[y * w + x] });
        let kept = shrunk(&truth, &radiance, &albedo, Some(64));
        let at = |(x, y): (usize, usize)| kept.channel(1)[y * w + x];
        assert!(lamp.iter().all(|pixel| at(*pixel) > 0.9 * 32.0), "{:?}", lamp.map(at));
        assert!(sparks.iter().all(|pixel| at(*pixel) < 0.1 * 32.0), "{:?}", sparks.map(at));
    }

    #[test]
    fn where_nothing_was_met_all_stays_as_rendered() {
        // A noisy wall to the left, nothing to the right, and a trace of light all over. The sky is no part of a
        // transparent film, but of the albedo.
        let (w, _) = SIZE;
        let wall = noisy(0.3);
        let radiance = planes(|c, x, y| if x < 40 { wall.channel(c)[y * w + x] } else { 0.0 });
        let alpha = Planes::from_rows(1, SIZE, |_, _, row| {
            row.iter_mut().enumerate().for_each(|(x, alpha)| *alpha = if x < 40 { 1.0 } else { 0.0 });
        });
        let mut image = planes(|c, x, y| picture(c, x, y) * if x < 40 { 1.0 } else { 1e-3 });
        let before = image.clone();
        let render = Render {
            radiance: &radiance,
            albedo: &planes(|_, x, _| if x < 40 { 0.5 } else { 2.0 }),
            exposure: 0.6,
            samples: Some(4),
        };
        let empty = Empty::of(&radiance, Alpha { rendered: &alpha, denoised: None }, render.samples);
        let mut shares = Planes::new(1, SIZE.0, SIZE.1);
        let shrinkage = Shrinkage::of(&render).keeping(empty);
        let errors = shrinkage.shrink_expecting(&mut image, Some(&mut shares));
        for (at, error) in errors.data.iter().enumerate() {
            let first = at % errors.width * SQUARE;
            assert_eq!(*error > 0.0, first < 43, "{first}: {error}");
        }
        for (at, share) in shares.data.iter().enumerate() {
            let values = |planes: &Planes| [0, 1, 2].map(|c| planes.channel(c)[at]);
            match at % w {
                ..38 => assert_eq!(values(&image), values(&before), "the wall is noise alone"),
                38..43 => assert!(
                    values(&image).iter().all(|v| *v > 0.0),
                    "{}: what samples may have missed",
                    at % w
                ),
                _ => assert!(values(&image) == [0.0; 3] && *share == 1.0, "{}", at % w),
            }
        }
    }

    #[test]
    fn of_more_samples_than_were_learned_from_as_much_is_expected_as_of_unknown_ones() {
        let (radiance, albedo, image) = (noisy(0.3), planes(|_, _, _| 0.5), planes(picture));
        let errors = |samples| {
            let render = Render { radiance: &radiance, albedo: &albedo, exposure: 0.6, samples };
            expected::errors(&image, &render, None, &sums::gather(&image, &render, &Seen::of(&render))).data
        };
        assert_eq!(errors(Some(257)), errors(None));
        assert_eq!(errors(Some(4096)), errors(None));
        assert_ne!(errors(Some(256)), errors(None));
    }

    #[test]
    fn tiny_frames_of_any_brightness_stay_finite() {
        for (w, h) in [(1, 1), (1, 9), (9, 1), (2, 3), (4, 4), (5, 17)] {
            for v in [0.0, 1e-30, 1.0, 65504.0] {
                let of = |v: f32| Planes::from_vec(3, w, h, vec![v; 3 * w * h]);
                let mut image = of(v);
                let (radiance, albedo) = (&of(0.5 * v), &of(0.7));
                let render = Render { radiance, albedo, exposure: 1.0, samples: None };
                shrink(&mut image, &render, None);
                assert!(image.data.iter().all(|x| x.is_finite() && *x <= v && *x >= 0.5 * v), "{w}x{h}, {v}");
            }
        }
    }
}
