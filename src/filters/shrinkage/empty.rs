//! Tells where no sample met anything, as a transparent film shows it: no light, and an alpha of zero.
//!
//! A network leaves a trace of light there, far below what can be seen, out to a hundred pixels from things. Colour
//! that alpha knows nothing of glows when the picture is exposed up, and such pixels count as content.

use rayon::prelude::*;

use super::grown;
use crate::planes::Planes;

/// A pixel is empty where this many samples in and around it met nothing, or where none in the 7x7 pixels around it
/// met anything: nearer to things, samples may have missed them. Of 32 crops at 4 samples, references had 1e-4 of
/// their light at most where 7x7 pixels were empty, 2e-3 where 3x3 were (docs/decisions.md, Shrinkage).
const SAMPLES: u32 = 144;
const FARTHEST: usize = 3;

/// Below this, denoised alpha is a trace as well, and a pixel is empty where its own samples met nothing; where they are
/// fewer than [`OWN_SAMPLES`], those of the 3x3 pixels around it. At the rim of what is blurred by focus or motion, where
/// samples are few and alpha is low but not zero, denoised alpha is above it.
const TRACE: f32 = 5e-4;
const OWN_SAMPLES: u32 = 64;

/// The alpha of a frame, (1, H, W).
#[derive(Clone, Copy)]
pub struct Alpha<'a> {
    /// As rendered.
    pub rendered: &'a Planes,
    /// Denoised with the light, where it is.
    pub denoised: Option<&'a Planes>,
}

/// The empty pixels of a frame.
pub struct Empty {
    width: usize,
    is_empty: Vec<bool>,
}

impl Empty {
    /// Of radiance, (3, H, W), alpha, and the number of samples of a pixel, if it is known; nothing where alpha is zero
    /// nowhere, or everywhere: programs fill in an alpha that they do not know with zeros.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn of(radiance: &Planes, alpha: Alpha, samples: Option<u32>) -> Option<Self> {
        let size = (radiance.width, radiance.height);
        for alpha in [alpha.rendered].into_iter().chain(alpha.denoised) {
            assert_eq!(alpha.extent(), (1, size.0, size.1), "planes of one frame");
        }
        let rendered = &alpha.rendered.data;
        if rendered.iter().all(|a| *a == 0.0) || rendered.iter().all(|a| *a != 0.0) {
            return None;
        }
        let [red, green, blue] = [0, 1, 2].map(|c| radiance.channel(c));
        let pixels = rendered.par_iter().zip(red).zip(green).zip(blue);
        let met: Vec<bool> =
            pixels.map(|(((a, r), g), b)| (*a != 0.0) | (*r != 0.0) | (*g != 0.0) | (*b != 0.0)).collect();
        let mut is_empty = grown(&met, size, reach(samples));
        is_empty.par_iter_mut().for_each(|is| *is = !*is);
        if let Some(denoised) = alpha.denoised {
            let has_enough = samples.is_some_and(|samples| samples >= OWN_SAMPLES);
            let near = if has_enough { met } else { grown(&met, size, 1) };
            let pixels = is_empty.par_iter_mut().zip(&near).zip(&denoised.data);
            pixels.for_each(|((is, near), alpha)| *is |= !near & (*alpha < TRACE));
        }
        Some(Self { width: size.0, is_empty })
    }

    /// Makes an image, (C, H, W), black where it is empty.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn clear(&self, image: &mut Planes) {
        let size = (self.width, self.is_empty.len());
        assert_eq!((image.width, image.pixels()), size, "planes of one frame");
        for plane in image.data.chunks_mut(self.is_empty.len()) {
            let pixels = plane.par_iter_mut().zip(&self.is_empty);
            pixels.filter(|(_, is_empty)| **is_empty).for_each(|(value, _)| *value = 0.0);
        }
    }

    /// Whether each pixel of a row is empty.
    pub fn row(&self, y: usize) -> &[bool] {
        &self.is_empty[y * self.width..][..self.width]
    }
}

/// Rows and columns to each side that hold [`SAMPLES`].
fn reach(samples: Option<u32>) -> usize {
    let holds = |reach: &usize| {
        let pixels = (2 * *reach as u32 + 1).pow(2);
        samples.is_some_and(|samples| samples.saturating_mul(pixels) >= SAMPLES)
    };
    (1..FARTHEST).find(holds).unwrap_or(FARTHEST)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (23, 17);
    const LIT: (usize, usize) = (20, 2);
    const COVERED: (usize, usize) = (4, 16);

    fn at((x, y): (usize, usize)) -> usize {
        y * SIZE.0 + x
    }

    /// Light in one pixel, alpha in another.
    fn film() -> [Planes; 2] {
        let [mut radiance, mut alpha] = [3, 1].map(|channels| Planes::new(channels, SIZE.0, SIZE.1));
        radiance.channel_mut(2)[at(LIT)] = 1e-6;
        alpha.data[at(COVERED)] = 1.0;
        [radiance, alpha]
    }

    /// The distance to the nearer of the two.
    fn distance(x: usize, y: usize) -> usize {
        [LIT, COVERED].map(|(a, b)| x.abs_diff(a).max(y.abs_diff(b))).into_iter().min().unwrap()
    }

    #[track_caller]
    fn assert_empty(empty: &Empty, expected: impl Fn(usize, usize) -> bool) {
        let mut cleared = Planes::from_vec(3, SIZE.0, SIZE.1, vec![1.0; 3 * SIZE.0 * SIZE.1]);
        empty.clear(&mut cleared);
        for y in 0..SIZE.1 {
            for (x, is_empty) in empty.row(y).iter().enumerate() {
                assert_eq!(*is_empty, expected(x, y), "{x}, {y}");
                let value = if *is_empty { 0.0 } else { 1.0 };
                assert!((0..3).all(|c| cleared.channel(c)[at((x, y))] == value), "{x}, {y}");
            }
        }
    }

    #[test]
    fn what_is_far_from_light_and_from_alpha_is_empty() {
        let [radiance, alpha] = &film();
        let alpha = Alpha { rendered: alpha, denoised: None };
        for (samples, reach) in [
            (None, 3),
            (Some(1), 3),
            (Some(5), 3),
            (Some(6), 2),
            (Some(15), 2),
            (Some(16), 1),
            (Some(u32::MAX), 1),
        ] {
            assert_empty(&Empty::of(radiance, alpha, samples).unwrap(), |x, y| distance(x, y) > reach);
        }
    }

    #[test]
    fn an_alpha_without_zeros_or_of_zeros_alone_tells_nothing() {
        let [radiance, alpha] = &film();
        for value in [0.0, 1e-4] {
            let rendered = &Planes::from_vec(1, SIZE.0, SIZE.1, vec![value; alpha.pixels()]);
            assert!(Empty::of(radiance, Alpha { rendered, denoised: None }, Some(4)).is_none(), "{value}");
        }
    }

    #[test]
    fn where_denoised_alpha_is_a_trace_pixels_nearer_to_things_are_empty() {
        let [radiance, rendered] = &film();
        // Things are blurred to the left: there alpha is low, but no trace.
        let denoised = Planes::from_rows(1, SIZE, |_, _, row| {
            row.iter_mut().enumerate().for_each(|(x, alpha)| *alpha = if x < 4 { 1e-3 } else { 1e-4 });
        });
        let alpha = Alpha { rendered, denoised: Some(&denoised) };
        for (samples, reach, of_trace) in
            [(None, 3, 1), (Some(4), 3, 1), (Some(15), 2, 1), (Some(63), 1, 1), (Some(64), 1, 0)]
        {
            let empty = Empty::of(radiance, alpha, samples).unwrap();
            assert_empty(&empty, |x, y| distance(x, y) > if x < 4 { reach } else { of_trace });
        }
    }
}
