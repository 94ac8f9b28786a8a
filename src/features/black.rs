//! Black that stays black: backgrounds, and surfaces that reflect nothing of a colour.

use rayon::prelude::*;

use crate::planes::Planes;

/// Sets a colour channel of a pixel of `image` to zero where both `radiance` and `albedo` are zero in that
/// channel over the 5x5 pixels around it. All three are (3, H, W).
///
/// Softmax weights are never exactly zero, so kernels of coarse levels carry about 1e-5 of the light far into
/// black places, which a display's gamma makes visible. Radiance alone does not tell: a dim wall may be black
/// in all samples.
pub fn keep_black(image: &mut Planes, radiance: &Planes, albedo: &Planes) {
    let (w, n) = (image.width, image.pixels());
    image.data.par_chunks_mut(n).enumerate().for_each(|(c, plane)| {
        let (radiance_of, albedo_of) = (radiance.channel(c), albedo.channel(c));
        let nothing = |radiance: f32, albedo: f32| (radiance <= 0.0) & (albedo <= 0.0);
        let is_black = |x: usize, y: usize| nothing(radiance_of[y * w + x], albedo_of[y * w + x]);
        plane.par_chunks_mut(w).enumerate().for_each(|(y, row)| {
            // Most rows hold no black pixel; this loop finds that out without a branch per pixel.
            let pixels = radiance_of[y * w..][..w].iter().zip(&albedo_of[y * w..][..w]);
            if !pixels.fold(false, |any, (v, a)| any | nothing(*v, *a)) {
                return;
            }
            for (x, value) in row.iter_mut().enumerate() {
                if is_black(x, y) && radiance.near(x, y, 2).all(|(x, y)| is_black(x, y)) {
                    *value = 0.0;
                }
            }
        });
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `value` everywhere, except 7x7 zeros in the middle of the green channel.
    fn holed(value: f32) -> Planes {
        let (w, h) = (15, 13);
        let mut planes = Planes::from_vec(3, w, h, vec![value; 3 * w * h]);
        for y in 3..10 {
            planes.channel_mut(1)[y * w + 4..][..7].fill(0.0);
        }
        planes
    }

    fn black(image: &Planes) -> Vec<(usize, usize, usize)> {
        let zeros = (0..image.data.len()).filter(|&i| image.data[i] == 0.0);
        zeros.map(|i| (i / image.pixels(), i % image.width, i % image.pixels() / image.width)).collect()
    }

    #[test]
    fn what_is_black_all_around_stays_so_channel_by_channel() {
        let mut image = Planes::from_vec(3, 15, 13, vec![1e-4; 3 * 15 * 13]);
        keep_black(&mut image, &holed(0.5), &holed(0.8));
        let middle: Vec<_> = (5..8).flat_map(|y| (6..9).map(move |x| (1, x, y))).collect();
        assert_eq!(black(&image), middle, "3x3 have the hole all around");
    }

    #[test]
    fn radiance_or_albedo_alone_may_be_black() {
        let lit = Planes::from_vec(3, 15, 13, vec![0.5; 3 * 15 * 13]);
        for (radiance, albedo) in [(holed(0.5), lit.clone()), (lit, holed(0.8))] {
            let mut image = Planes::from_vec(3, 15, 13, vec![1e-4; 3 * 15 * 13]);
            keep_black(&mut image, &radiance, &albedo);
            assert_eq!(black(&image), []);
        }
    }

    #[test]
    fn a_border_brings_no_light() {
        let dark = Planes::new(3, 15, 13);
        let mut image = Planes::from_vec(3, 15, 13, vec![1e-4; 3 * 15 * 13]);
        keep_black(&mut image, &dark, &dark);
        assert_eq!(image.data, dark.data);
    }
}
