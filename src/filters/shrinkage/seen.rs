//! Tells light that comes straight to the camera, and fireflies.
//!
//! Cycles writes light that is seen directly (sky, screens, lamps) into the albedo as well as into the
//! beauty. The film's exposure, which multiplies light alone, is found first, from the quotient that most
//! such pixels agree on.

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::Render;
use crate::{
    filters::FIREFLY,
    kernels::{
        logarithm::ln,
        vectorised::{self, Vectorised},
    },
    planes::Planes,
};

/// A frame in which no more than this share of the pixels differ from their albedo is no picture of light on
/// surfaces, and all of it is kept.
const UNLIKE: f64 = 1e-3;

/// Beyond white, such light may be this many times as bright as in the second brightest of the 8 pixels around.
/// What is brighter counts less.
const ALONE: f32 = 4.0;

/// By how much radiance may differ from the albedo and still be light that is seen directly: a share of the
/// albedo, which is a few steps of a half float, and next to nothing in absolute terms.
pub const SAME: (f32, f32) = (0.004, 1e-6);

/// Light that is seen directly is its albedo times the film's exposure, which Cycles applies to light alone.
/// The exposure is found from the quotients of light and albedo, which are counted in [`STEPS`] steps an
/// octave over [`OCTAVES`] octaves up and down.
const STEPS: usize = 128;
const OCTAVES: usize = 20;

/// The step of a quotient of 1.
const MIDDLE: usize = STEPS * OCTAVES;

/// An exposure needs at least [`LEAST_EXPOSED`] pixels, and [`PEAK`] times as many as its second and third
/// neighbours have on average. Quotients of surfaces that are only lit are spread by noise and by shape.
const LEAST_EXPOSED: u32 = 16;
const PEAK: f32 = 8.0;

/// About how many pixels of a frame are counted, and how many of them a thread counts at once.
const COUNTED: usize = 1 << 17;
const COUNTED_AT_ONCE: usize = 1 << 12;

/// For a pixel to be seen directly, this many of the 3x3 around it, itself included, must be as bright as
/// their albedo, because any pixel may be so by chance.
const SEEN_TOGETHER: f32 = 6.0;

/// The film's exposure, by which light that is seen directly was multiplied. It is 1 if enough pixels equal
/// their albedo, else what most such light of the frame agrees on, and 1 if there is none.
pub fn film_exposure(render: &Render) -> f32 {
    let Render { radiance, albedo, .. } = render;
    let pixels = radiance.pixels();
    let [light, white] = [radiance, albedo].map(|planes| [0, 1, 2].map(|c| planes.channel(c)));
    let apart = distance(pixels, radiance.width);
    let looked_at = pixels.div_ceil(apart);
    let none = || vec![0u32; 2 * MIDDLE + 1];
    let count = |mut counts: Vec<u32>, part: usize| {
        let part = part * COUNTED_AT_ONCE..looked_at.min((part + 1) * COUNTED_AT_ONCE);
        let gathered = |plane: &[f32]| part.clone().map(|at| plane[at * apart]).collect::<Vec<f32>>();
        let [light, white] = [light, white].map(|planes| planes.map(gathered));
        let mut steps = vec![0.0; part.len()];
        vectorised::run(StepsOf { light, white, steps: &mut steps });
        for step in steps {
            if let Some(count) = counts.get_mut(step as usize) {
                *count += 1;
            }
        }
        counts
    };
    let plus = |mut counts: Vec<u32>, others: Vec<u32>| {
        counts.iter_mut().zip(others).for_each(|(count, other)| *count += other);
        counts
    };
    let parts = (0..looked_at.div_ceil(COUNTED_AT_ONCE)).into_par_iter();
    let counts = parts.fold(none, count).reduce(none, plus);
    let is_peak = |step: usize| {
        let around = [step - 3, step - 2, step + 2, step + 3].map(|step| counts[step]);
        let usual = around.iter().sum::<u32>() as f32 / around.len() as f32;
        counts[step] >= LEAST_EXPOSED && counts[step] as f32 > PEAK * usual
    };
    if is_peak(MIDDLE) {
        return 1.0;
    }
    let peaks = (3..counts.len() - 3).filter(|step| is_peak(*step));
    let highest = peaks.max_by_key(|step| counts[*step]).unwrap_or(MIDDLE);
    // Whole octaves apart from the rest, so that they are exact.
    let steps = highest as i32 - MIDDLE as i32;
    let (octave, rest) = (steps.div_euclid(STEPS as i32), steps.rem_euclid(STEPS as i32));
    (rest as f32 / STEPS as f32).exp2() * 2f32.powi(octave)
}

/// Writes to `steps` the step of each pixel's quotient of light and albedo: infinity where its colours have different
/// quotients, or next to no light.
struct StepsOf<'a> {
    light: [Vec<f32>; 3],
    white: [Vec<f32>; 3],
    steps: &'a mut [f32],
}

impl Vectorised for StepsOf<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { light, white, steps } = self;
        let per_octave = STEPS as f32 / std::f32::consts::LN_2;
        let pixels = steps.len();
        let [[r, g, b], white] =
            [&light, &white].map(|planes| planes.each_ref().map(|values| &values[..pixels]));
        for (i, step) in steps.iter_mut().enumerate() {
            let (light, white) = ([r[i], g[i], b[i]], [white[0][i], white[1][i], white[2][i]]);
            let [lit, whole] = [light, white].map(|[r, g, b]| r + g + b);
            let quotient = lit / whole;
            let is_light = (lit > f32::MIN_POSITIVE) & (whole > f32::MIN_POSITIVE);
            let is_seen = is_light & equals(light, white, quotient);
            let rounded = (ln(quotient) * per_octave).round() + MIDDLE as f32;
            *step = if is_seen { rounded } else { f32::INFINITY };
        }
    }
}

/// The distance of the pixels that are counted of a frame. It has no factor in common with the frame's width: otherwise only
/// some columns would ever be looked at, and what stands between them would not count.
fn distance(pixels: usize, width: usize) -> usize {
    let divisor = |a: usize, b: usize| {
        let (mut a, mut b) = (a, b);
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    let least = pixels.div_ceil(COUNTED);
    (least..).find(|step| divisor(*step, width) == 1).expect("some prime is no factor of the width")
}

/// Whether `light` equals `white` times `film`, up to rounding.
#[inline(always)]
fn equals(light: [f32; 3], white: [f32; 3], film: f32) -> bool {
    let (relative, absolute) = SAME;
    let alike = [0, 1, 2]
        .map(|c| (light[c] - film * white[c]).abs() <= film * (relative * white[c].abs() + absolute));
    // All three are compared in any case, so that no branch keeps the compiler from vectorising.
    alike[0] & alike[1] & alike[2]
}

/// Tells light that comes straight to the camera.
pub struct Seen<'a> {
    pub radiance: &'a Planes,
    pub albedo: &'a Planes,
    /// The film's exposure, by which light was multiplied and the albedo was not.
    pub film: f32,
}

impl<'a> Seen<'a> {
    /// Finds the film's exposure of a frame.
    pub fn of(render: &Render<'a>) -> Self {
        Self { radiance: render.radiance, albedo: render.albedo, film: film_exposure(render) }
    }
}

impl Seen<'_> {
    /// Whether a frame is nothing but light that is seen directly.
    pub fn is_all(&self) -> bool {
        let most = (UNLIKE * self.radiance.pixels() as f64) as usize;
        let unlike = AtomicUsize::new(0);
        // No more rows are looked at once too many pixels differ: in most frames after a few.
        (0..self.radiance.height).into_par_iter().all(|y| {
            let [light, white] = [self.radiance, self.albedo].map(|planes| planes.rows(y));
            let colours = |planes: [&[f32]; 3], x: usize| planes.map(|row| row[x]);
            let differs = |x: &usize| !equals(colours(light, *x), colours(white, *x), self.film);
            let found = (0..self.radiance.width).filter(differs).count();
            unlike.fetch_add(found, Ordering::Relaxed) + found <= most
        })
    }

    /// Finds in which pixels of a row light is seen directly, as that of their neighbours is. Pixels beyond the frame
    /// count as such.
    pub fn read_row(&self, y: usize, row: &mut SeenRow) {
        let SeenRow { equal, around, is_seen } = row;
        around.fill(0.0);
        // The row itself is the last, and stays in `equal`.
        for there in [y.checked_sub(1), Some(y + 1).filter(|below| *below < self.radiance.height), Some(y)] {
            match there {
                Some(there) => {
                    let [light, white] = [self.radiance, self.albedo].map(|planes| planes.rows(there));
                    vectorised::run(Equal { light, white, film: self.film, equal, around });
                }
                None => around.iter_mut().for_each(|sum| *sum += 1.0),
            }
        }
        vectorised::run(Together { albedo: self.albedo.rows(y), equal, around, is_seen });
    }

    /// The share of a pixel's light that is seen directly or by way of mirrors, as far as the albedo shows it
    /// beyond white. One such pixel alone, or two side by side, as in a rough mirror, are as likely to be noise,
    /// and their share is less.
    pub fn beyond_white(&self, x: usize, y: usize) -> f32 {
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
        let others = radiance.near(x, y, 1).filter(|&other| other != (x, y));
        let (_, second) = others.map(|(x, y)| beyond(x, y).0).fold((0.0, 0.0), |(first, second), other| {
            (f32::max(first, other), f32::max(second, first.min(other)))
        });
        let share = film * light / radiance.channel(c)[y * radiance.width + x];
        share * (ALONE * second / light).min(1.0)
    }
}

/// Where light is seen directly in a row of pixels, with the memory that finding it takes.
pub struct SeenRow {
    equal: Vec<f32>,
    around: Vec<f32>,
    /// 1 where it is, else 0.
    pub is_seen: Vec<f32>,
}

impl SeenRow {
    /// Of a row in which none is.
    pub fn none(width: usize) -> Self {
        let [equal, around, is_seen] = [(); 3].map(|()| vec![0.0; width]);
        Self { equal, around, is_seen }
    }
}

/// Writes to `equal` 1 for every pixel of a row that has the brightness of its albedo, else 0, and adds that to `around`.
struct Equal<'a> {
    light: [&'a [f32]; 3],
    white: [&'a [f32]; 3],
    film: f32,
    equal: &'a mut [f32],
    around: &'a mut [f32],
}

impl Vectorised for Equal<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { light, white, film, equal, around } = self;
        let width = equal.len();
        let [[r, g, b], white] = [light, white].map(|planes| planes.map(|row| &row[..width]));
        for (x, equal) in equal.iter_mut().enumerate() {
            let white = [white[0][x], white[1][x], white[2][x]];
            *equal = if equals([r[x], g[x], b[x]], white, film) { 1.0 } else { 0.0 };
        }
        around.iter_mut().zip(equal).for_each(|(sum, equal)| *sum += *equal);
    }
}

/// Writes to `is_seen` 1 for every pixel of a row whose light is seen directly, else 0.
struct Together<'a> {
    albedo: [&'a [f32]; 3],
    equal: &'a [f32],
    /// How many of a pixel, the one above and the one below have the brightness of their albedo.
    around: &'a [f32],
    is_seen: &'a mut [f32],
}

impl Vectorised for Together<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { albedo: [red, green, blue], equal, around, is_seen } = self;
        // Three beyond each end of the row count.
        is_seen.copy_from_slice(around);
        is_seen[0] += 3.0;
        is_seen[around.len() - 1] += 3.0;
        is_seen[1..].iter_mut().zip(around).for_each(|(sum, left)| *sum += left);
        is_seen.iter_mut().zip(&around[1..]).for_each(|(sum, right)| *sum += right);
        for (seen, equal) in is_seen.iter_mut().zip(equal) {
            *seen = if *seen >= SEEN_TOGETHER { *equal } else { 0.0 };
        }
        // A black pixel is no light itself. As a neighbour it counts, because lamps and stars end in black.
        for (((seen, red), green), blue) in is_seen.iter_mut().zip(red).zip(green).zip(blue) {
            *seen = if red.max(*green).max(*blue) > 0.0 { *seen } else { 0.0 };
        }
    }
}

/// Whether a pixel is far brighter than all around it.
pub fn is_firefly(render: &Render, x: usize, y: usize) -> bool {
    let radiance = render.radiance;
    let brightest = |(x, y): (usize, usize)| {
        (0..3).map(|c| radiance.channel(c)[y * radiance.width + x]).fold(0.0, f32::max)
    };
    let others = radiance.near(x, y, 2).filter(|&other| other != (x, y)).map(brightest);
    brightest((x, y)) > FIREFLY * others.fold(0.0, f32::max)
}
