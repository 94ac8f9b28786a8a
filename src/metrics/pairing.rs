//! Whether a render and its reference show the same scene. If Blender gave textures to other materials, or an
//! object moved between the two, the difference counts as an error of every method, and teaches a network to
//! blur.
//!
//! If they show the same scene, the mean luminances of their squares of 16x16 pixels differ by noise alone.
//! Noise with few bright samples leaves some squares too dark and hardly one too bright. Another texture or
//! place makes some squares brighter and others darker, and another exposure changes nearly all of them in
//! one direction. So two shares of the squares are tested: the smaller one of those too bright and those too
//! dark, and the larger one, which has to be most of the picture. Where a few pixels hold most of the light,
//! nearly all squares are too dark as well, but the picture's mean, which has those pixels, is not: so it must
//! differ too. This is the project's own test; on 300 pairs that belong together the two shares are at most
//! 0.5% and 17%.

use std::{cmp::Ordering, fmt::Display};

use super::display::luminance;
use crate::planes::Planes;

/// Rows and columns of a square.
const SQUARE: usize = 16;

/// A square differs when its mean is off by more than [`STANDARD_ERRORS`] standard errors, and by more than
/// the share [`LEAST_CHANGE`] of the reference's mean plus [`OFFSET`], which keeps black squares out.
const STANDARD_ERRORS: f64 = 6.0;
const LEAST_CHANGE: f64 = 0.04;
const OFFSET: f64 = 1e-4;

/// A render and its reference are said to differ if more than the share [`BOTH_WAYS`] of the squares are too
/// bright and more than that share too dark, or if more than the share [`ONE_WAY`] and the picture's mean differ
/// in the same direction.
const BOTH_WAYS: f64 = 0.02;
const ONE_WAY: f64 = 0.5;

/// Sums over pixels of two images.
#[derive(Default)]
struct Difference {
    pixels: f64,
    sum: f64,
    squares: f64,
    expected: f64,
}

impl Difference {
    fn add(&mut self, value: f64, expected: f64) {
        let difference = value - expected;
        self.pixels += 1.0;
        self.sum += difference;
        self.squares += difference * difference;
        self.expected += expected;
    }

    /// Whether the image is brighter or darker than its reference by more than noise explains.
    fn direction(&self) -> Ordering {
        let [mean, square, light] = [self.sum, self.squares, self.expected].map(|sum| sum / self.pixels);
        let error = ((square - mean * mean).max(0.0) / self.pixels).sqrt();
        let differs = mean.abs() > STANDARD_ERRORS * error && mean.abs() > LEAST_CHANGE * (light + OFFSET);
        if differs { mean.total_cmp(&0.0) } else { Ordering::Equal }
    }
}

/// The share of the squares of an image that differ from those of `reference` by more than noise explains;
/// none if the two show the same scene. Both are radiance, (3, H, W).
///
/// # Panics
/// If the sizes differ, or the images have not three channels.
fn mismatch(image: &Planes, reference: &Planes) -> Option<f64> {
    assert!(image.channels == 3 && image.extent() == reference.extent(), "both are RGB of one size");
    let (columns, rows) = (image.width / SQUARE, image.height / SQUARE);
    let luminances = [image, reference].map(luminance);
    let (mut brighter, mut darker) = (0usize, 0usize);
    let mut picture = Difference::default();
    for square in 0..columns * rows {
        let (x0, y0) = (square % columns * SQUARE, square / columns * SQUARE);
        let mut inside = Difference::default();
        for y in y0..y0 + SQUARE {
            for at in y * image.width + x0..y * image.width + x0 + SQUARE {
                let [value, expected] = luminances.each_ref().map(|l| l[at]);
                inside.add(value, expected);
                picture.add(value, expected);
            }
        }
        match inside.direction() {
            Ordering::Greater => brighter += 1,
            Ordering::Less => darker += 1,
            Ordering::Equal => {}
        }
    }
    let share = |count: usize| count as f64 / (columns * rows).max(1) as f64;
    let most = brighter.max(darker);
    let one_way = share(most) > ONE_WAY && picture.direction() == brighter.cmp(&darker);
    let differs = share(brighter.min(darker)) > BOTH_WAYS || one_way;
    differs.then(|| share(brighter + darker))
}

/// The warning for the user if the two renders of the pair `name` do not show the same scene. Both are
/// radiance, (3, H, W).
///
/// # Panics
/// If the sizes differ, or the images have not three channels.
pub fn warning(name: impl Display, image: &Planes, reference: &Planes) -> Option<String> {
    let percent = 100.0 * mismatch(image, reference)?;
    Some(format!(
        "{name}: the frame and its reference do not show the same scene in the same light: {percent:.0}% of the picture \
         differs by more than noise explains; render both again, or leave the pair out"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    /// A checkerboard of squares of `side` pixels, 96x96, whose pixels are `noise(value)`.
    fn checkers(side: usize, mut noise: impl FnMut(f32) -> f32) -> Planes {
        let mut planes = Planes::new(3, 96, 96);
        for y in 0..96 {
            for x in 0..96 {
                let value = noise(if (x / side + y / side).is_multiple_of(2) { 0.6 } else { 0.4 });
                (0..3).for_each(|c| planes.channel_mut(c)[y * 96 + x] = value);
            }
        }
        planes
    }

    #[test]
    fn noise_is_no_mismatch_however_skewed_and_another_pattern_is_one() {
        let reference = checkers(32, |v| v);
        let mut rng = Rng::new(5, 0);
        // One sample in ten finds a lamp: nine tenths of the pixels are black.
        let starved = checkers(32, |v| if rng.below(10) == 0 { 10.0 * v } else { 0.0 });
        assert_eq!(mismatch(&starved, &reference), None);
        assert_eq!(mismatch(&reference, &reference), None);
        // One in a thousand finds the sun, and most squares have no such pixel.
        let lone = checkers(32, |v| if rng.below(1000) == 0 { 300.0 * v } else { 0.7 * v });
        assert_eq!(mismatch(&lone, &reference), None);
        assert_eq!(mismatch(&checkers(32, |v| 0.7 * v), &reference), Some(1.0), "no sun anywhere");
        let mut noisy = |v: f32| v * (0.5 + rng.below(1000) as f32 / 1000.0);
        assert_eq!(mismatch(&checkers(32, &mut noisy), &reference), None);
        let other =
            mismatch(&checkers(48, &mut noisy), &reference).expect("other checkers are another scene");
        assert!((0.3..0.7).contains(&other), "{other}");
        assert_eq!(mismatch(&checkers(32, |v| 1.5 * v), &reference), Some(1.0), "another exposure");
        let said = warning("room_0004spp", &checkers(48, &mut noisy), &reference).expect("so is this one");
        assert!(said.starts_with("room_0004spp: ") && said.contains("do not show the same scene"), "{said}");
    }

    #[test]
    fn pictures_smaller_than_a_square_say_nothing() {
        let small = Planes::new(3, 15, 40);
        assert_eq!(mismatch(&small, &small), None);
    }
}
