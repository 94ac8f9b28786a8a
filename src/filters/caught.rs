//! Shadows that are caught: alpha where the beauty is black.
//!
//! What catches shadows gives a transparent film no light, only alpha. The beauty knows nothing of it, so that kernels
//! made for the beauty smear such a shadow, or leave it as noisy as it was rendered. What the background keeps of its
//! light there, `1 - alpha`, is a picture, which a network denoises by itself.

use rayon::prelude::*;

use super::{box_mean, shrinkage::grown};
use crate::planes::Planes;

/// One pixel in so many holds a shadow, or none is looked for: dark edges do as well.
const ONE_IN: usize = 1000;

/// Rows and columns to each side in which light, and other alpha, is looked for.
const REACH: usize = 3;

/// A caught shadow.
pub struct Caught {
    /// Alpha as rendered, (1, H, W).
    alpha: Planes,
    /// How many of the pixels around one are lit, from 0 to 1, (1, H, W).
    lit: Planes,
    /// Where some pixel around is covered, and where one is not wholly.
    is_covered: Vec<bool>,
    is_open: Vec<bool>,
}

impl Caught {
    /// Of radiance, (3, H, W), and alpha, (1, H, W), as rendered; nothing where no shadow is caught.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn of(radiance: &Planes, alpha: &Planes) -> Option<Self> {
        let size = (alpha.width, alpha.height);
        assert_eq!(radiance.extent(), (3, size.0, size.1), "planes of one frame");
        let [red, green, blue] = [0, 1, 2].map(|c| radiance.channel(c));
        let pixels = red.par_iter().zip(green).zip(blue);
        let lit: Vec<f32> = pixels.map(|((r, g), b)| f32::from(u8::from(r.max(*g).max(*b) > 0.0))).collect();
        let shadows = lit
            .par_iter()
            .zip(&alpha.data[..])
            .filter(|(lit, alpha)| **lit == 0.0 && **alpha > 0.0 && **alpha < 1.0);
        if shadows.count() * ONE_IN < lit.len().max(1) {
            return None;
        }
        let grown_where = |is: fn(f32) -> bool| {
            grown(&alpha.data.par_iter().map(|alpha| is(*alpha)).collect::<Vec<bool>>(), size, REACH)
        };
        Some(Self {
            alpha: alpha.clone(),
            lit: Planes::from_rows(1, size, |_, y, row| box_mean::row(&lit, size, y, REACH, row)),
            is_covered: grown_where(|alpha| alpha > 0.0),
            is_open: grown_where(|alpha| alpha < 1.0),
        })
    }

    /// The picture that a network is to denoise, (3, H, W). Where a region was rendered, given by its first pixel and its size,
    /// it is black beyond, as all that a network reads, unless something is covered there.
    pub fn picture(&self, (place, size): ((usize, usize), (usize, usize))) -> Planes {
        let whole = (self.alpha.width, self.alpha.height);
        let kept = Planes::from_rows(3, whole, |_, y, row| {
            row.iter_mut().zip(self.alpha.row(0, y)).for_each(|(kept, alpha)| *kept = (1.0 - alpha).max(0.0));
        });
        if self.alpha.lies_within(place, size) {
            kept.window(place, size).placed_in(whole, place)
        } else {
            kept
        }
    }

    /// Puts what was made of the picture in place of alpha that was denoised with the beauty, the more of it the fewer pixels
    /// around are lit. Where everything around is wholly covered, or nothing is, alpha stays that.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn put(&self, picture: &Planes, alpha: &mut Planes) {
        let (width, height) = (self.alpha.width, self.alpha.height);
        assert_eq!(
            (picture.extent(), alpha.extent()),
            ((3, width, height), (1, width, height)),
            "planes of one frame"
        );
        alpha.data.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            let (kept, lit) = (picture.rows(y), self.lit.row(0, y));
            for (x, alpha) in row.iter_mut().enumerate() {
                let at = y * width + x;
                let by_itself = match (self.is_covered[at], self.is_open[at]) {
                    (false, _) => 0.0,
                    (_, false) => 1.0,
                    _ => 1.0 - kept.map(|kept| kept[x]).iter().sum::<f32>() / 3.0,
                };
                *alpha = lit[x] * *alpha + (1.0 - lit[x]) * by_itself.clamp(0.0, 1.0);
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (40, 24);

    fn of_columns(channels: usize, value: impl Fn(usize) -> f32 + Sync) -> Planes {
        Planes::from_rows(channels, SIZE, |_, _, row| {
            row.iter_mut().enumerate().for_each(|(x, v)| *v = value(x));
        })
    }

    #[test]
    fn alpha_comes_from_the_picture_where_the_beauty_is_black() {
        // A thing, its shadow, and nothing.
        let radiance = of_columns(3, |x| if x < 10 { 0.5 } else { 0.0 });
        let alpha = of_columns(1, |x| [1.0, 0.6, 0.0][usize::from(x >= 10) + usize::from(x >= 25)]);
        let caught = Caught::of(&radiance, &alpha).unwrap();
        assert!(
            caught
                .picture(((0, 0), SIZE))
                .row(2, 7)
                .iter()
                .zip(alpha.row(0, 7))
                .all(|(kept, alpha)| *kept == 1.0 - alpha)
        );
        let mut denoised = of_columns(1, |_| 0.9);
        caught.put(&of_columns(3, |_| 0.3), &mut denoised);
        let row = denoised.row(0, 12);
        assert!(row[..7].iter().all(|alpha| *alpha == 0.9), "the thing stays: {row:?}");
        assert!(row[13..28].iter().all(|alpha| (alpha - 0.7).abs() < 1e-6), "{row:?}");
        assert!(row[28..].iter().all(|alpha| *alpha == 0.0), "nothing is added: {row:?}");
        assert!(row[7..14].is_sorted_by(|a, b| a >= b), "no step: {row:?}");
        // What is black and wholly covered stays so.
        let black = of_columns(1, |x| if x < 30 { 1.0 } else { 0.5 });
        let caught = Caught::of(&of_columns(3, |_| 0.0), &black).unwrap();
        caught.put(&of_columns(3, |_| 0.01), &mut denoised);
        assert!(denoised.row(0, 3)[..27].iter().all(|alpha| *alpha == 1.0));
    }

    #[test]
    fn the_picture_of_a_region_ends_where_that_does() {
        let alpha = of_columns(1, |x| if (5..30).contains(&x) { 0.5 } else { 0.0 });
        let caught = Caught::of(&of_columns(3, |_| 0.0), &alpha).unwrap();
        let picture = |region| caught.picture(region).row(1, 9).to_vec();
        let within = picture(((4, 0), (28, SIZE.1)));
        assert_eq!((within[3], within[4], within[5], within[31], within[32]), (0.0, 1.0, 0.5, 1.0, 0.0));
        assert_eq!(picture(((6, 0), (28, SIZE.1))), picture(((0, 0), SIZE)), "more is covered");
    }

    #[test]
    fn other_films_hold_no_shadow() {
        let lit = of_columns(3, |x| if x < 20 { 0.5 } else { 0.0 });
        assert!(Caught::of(&lit, &of_columns(1, |x| if x < 20 { 0.5 } else { 0.0 })).is_none());
        assert!(Caught::of(&of_columns(3, |_| 0.0), &of_columns(1, |_| 1.0)).is_none());
    }
}
