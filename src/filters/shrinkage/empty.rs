//! Tells where no sample met anything, as a transparent film shows it: no light, and an alpha of zero.
//!
//! A network leaves a trace of light there, far below what can be seen, out to a hundred pixels from things. Colour
//! that alpha knows nothing of glows when the picture is exposed up, and such pixels count as content.

use rayon::prelude::*;

use crate::planes::Planes;

/// Pixels in each direction that have to be empty as well. Nearer to things, samples may have missed them: of 32 crops at
/// 4 samples, references had 1e-4 of their light at most where 7x7 pixels were empty, 2e-3 where 3x3 were.
const REACH: usize = 3;

/// The pixels of a frame that are not empty, or are near one.
pub struct Empty {
    width: usize,
    height: usize,
    /// Whether something was met in a pixel or at most [`REACH`] columns away.
    met: Vec<bool>,
}

impl Empty {
    /// Of radiance, (3, H, W), and alpha, (1, H, W); nothing where alpha is zero nowhere, or everywhere: programs fill in
    /// an alpha that they do not know with zeros.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn of(radiance: &Planes, alpha: &Planes) -> Option<Self> {
        let (width, height) = (radiance.width, radiance.height);
        assert_eq!(alpha.extent(), (1, width, height), "planes of one frame");
        let (mut has_clear, mut has_covered) = (false, false);
        for alpha in &alpha.data {
            has_clear |= *alpha == 0.0;
            has_covered |= *alpha != 0.0;
        }
        if !(has_clear && has_covered) {
            return None;
        }
        let mut met = vec![false; width * height];
        met.par_chunks_mut(width).enumerate().for_each_init(
            || vec![false; width + 2 * REACH],
            |own, (y, met)| {
                let row = |plane: &'_ [f32], own: &mut [bool]| {
                    let plane = &plane[y * width..][..width];
                    own.iter_mut().zip(plane).for_each(|(own, value)| *own |= *value != 0.0);
                };
                own.fill(false);
                let inner = &mut own[REACH..][..width];
                row(&alpha.data, inner);
                (0..3).for_each(|c| row(radiance.channel(c), inner));
                for shifted in (0..=2 * REACH).map(|first| &own[first..]) {
                    met.iter_mut().zip(shifted).for_each(|(met, near)| *met |= near);
                }
            },
        );
        Some(Self { width, height, met })
    }

    /// Makes an image, (3, H, W), black where it is empty.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn clear(&self, image: &mut Planes) {
        assert_eq!((image.width, image.height), (self.width, self.height), "planes of one frame");
        let mut is_near = vec![true; self.width];
        for y in 0..self.height {
            self.row(y, &mut is_near);
            for c in 0..image.channels {
                let row = &mut image.channel_mut(c)[y * self.width..][..self.width];
                row.iter_mut().zip(&is_near).filter(|(_, near)| !**near).for_each(|(value, _)| *value = 0.0);
            }
        }
    }

    /// Sets for each pixel of a row whether something was met in it or near it.
    pub fn row(&self, y: usize, is_near: &mut [bool]) {
        is_near.fill(false);
        let rows = y.saturating_sub(REACH)..(y + REACH + 1).min(self.height);
        for met in self.met[rows.start * self.width..rows.end * self.width].chunks(self.width) {
            is_near.iter_mut().zip(met).for_each(|(near, met)| *near |= met);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_far_from_light_and_from_alpha_is_empty() {
        let size = (23, 17);
        let at = |x: usize, y: usize| y * size.0 + x;
        let opaque = Planes::from_vec(1, size.0, size.1, vec![1e-4; size.0 * size.1]);
        assert!(Empty::of(&Planes::new(3, size.0, size.1), &opaque).is_none());
        let unknown = Planes::new(1, size.0, size.1);
        assert!(
            Empty::of(&Planes::new(3, size.0, size.1), &unknown).is_none(),
            "an alpha that tells nothing"
        );
        let lit = (21, 2);
        let covered = (4, 16);
        let mut radiance = Planes::new(3, size.0, size.1);
        radiance.channel_mut(2)[at(lit.0, lit.1)] = 1e-6;
        let mut alpha = Planes::new(1, size.0, size.1);
        alpha.data[at(covered.0, covered.1)] = 1.0;
        let empty = Empty::of(&radiance, &alpha).unwrap();
        let mut cleared = Planes::from_vec(3, size.0, size.1, vec![1.0; 3 * size.0 * size.1]);
        empty.clear(&mut cleared);
        for y in 0..size.1 {
            let mut is_near = vec![true; size.0];
            empty.row(y, &mut is_near);
            for (x, near) in is_near.into_iter().enumerate() {
                let distance = |other: (usize, usize)| x.abs_diff(other.0).max(y.abs_diff(other.1));
                assert_eq!(near, distance(lit).min(distance(covered)) <= 3, "{x}, {y}");
                assert!(
                    (0..3).all(|c| cleared.channel(c)[at(x, y)] == f32::from(u8::from(near))),
                    "{x}, {y}"
                );
            }
        }
    }
}
