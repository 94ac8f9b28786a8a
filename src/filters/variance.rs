//! How noisy a pixel is: from two independent renders, or from its surroundings where there is only one
//! render.

use rayon::prelude::*;

use super::{
    nl_means::{self, Weights},
    regression,
};
use crate::planes::Planes;

/// Radius of the squares over which estimates are averaged.
const RADIUS: usize = 3;

/// The variance of the mean of two independent images of equal quality, `(a - b)^2 / 4` averaged over
/// 7x7 pixels: one pixel's difference alone has a single degree of freedom.
pub fn dual_buffer(a: &Planes, b: &Planes) -> Planes {
    assert_eq!(a.extent(), b.extent());
    let squares = a.data.par_iter().zip(&b.data).map(|(a, b)| (a - b) * (a - b) * 0.25).collect();
    let squares = Planes::from_vec(a.channels, a.width, a.height, squares);
    nl_means::filter(&squares, &Weights::uniform(a.width, a.height, RADIUS))
}

/// The variance of one image about what a first-order fit on position and `features` explains within
/// 7x7 pixels, averaged over as many. What the features leave unexplained, such as the
/// edges of shadows, counts as noise.
pub fn residual(image: &Planes, features: &Planes) -> Planes {
    let weights = Weights::uniform(image.width, image.height, RADIUS);
    let fit = regression::first_order(image, features, &weights, true);
    let influence = fit.influence.expect("it was asked for");
    let mut squares = fit.image;
    for c in 0..image.channels {
        let (values, influence) = (image.channel(c), influence.channel(0));
        for ((fit, v), own) in squares.channel_mut(c).iter_mut().zip(values).zip(influence) {
            // A residual is smaller than the noise, because the fit follows a part of the noise.
            *fit = (*fit - v) * (*fit - v) / (1.0 - own).max(MIN_FREEDOM);
        }
    }
    nl_means::filter(&squares, &weights)
}

/// Least part of a degree of freedom that a residual is taken to have.
const MIN_FREEDOM: f32 = 0.25;

/// The variance of one image without knowledge of its content: the squared second difference along the
/// smoothest of four directions, over 3x3 pixels. Edges do not count as noise; texture does in part.
pub fn directional(image: &Planes) -> Planes {
    /// Independent noise of variance v has second differences `a - 2 b + c` of variance 6 v.
    const SECOND_DIFFERENCE: f32 = 6.0;
    let (width, height) = (image.width, image.height);
    let mut least = Planes::from_vec(image.channels, width, height, vec![f32::INFINITY; image.data.len()]);
    // In a frame of one column or one row, a direction that leaves it would find no noise.
    let stays = |(dx, dy): &(isize, isize)| (*dy != 0 || width > 1) && (*dx != 0 || height > 1);
    for (dx, dy) in [(1, 0), (0, 1), (1, 1), (1, -1)].into_iter().filter(stays) {
        let mut squares = Planes::new(image.channels, width, height);
        for c in 0..image.channels {
            let from = image.channel(c);
            squares.channel_mut(c).par_chunks_mut(width).enumerate().for_each(|(y, row)| {
                for (x, square) in row.iter_mut().enumerate() {
                    let at = |sign: isize| {
                        let x = (x as isize + sign * dx).clamp(0, width as isize - 1) as usize;
                        let y = (y as isize + sign * dy).clamp(0, height as isize - 1) as usize;
                        from[y * width + x]
                    };
                    let difference = at(-1) - 2.0 * at(0) + at(1);
                    *square = difference * difference / SECOND_DIFFERENCE;
                }
            });
        }
        let mean = nl_means::filter(&squares, &Weights::uniform(width, height, 1));
        least.data.iter_mut().zip(&mean.data).for_each(|(least, v)| *least = least.min(*v));
    }
    least
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// `n` values of zero mean and the given deviation, uniformly distributed.
    pub(crate) fn noise(seed: u64, n: usize, deviation: f32) -> Vec<f32> {
        let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        (0..n)
            .map(|_| {
                // xorshift64*
                state ^= state >> 12;
                state ^= state << 25;
                state ^= state >> 27;
                let bits = state.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 40;
                (bits as f32 / (1u64 << 24) as f32 - 0.5) * 12.0f32.sqrt() * deviation
            })
            .collect()
    }

    fn mean(planes: &Planes) -> f32 {
        planes.data.iter().sum::<f32>() / planes.data.len() as f32
    }

    #[test]
    fn estimates_find_the_variance_that_was_put_in() {
        let (width, height) = (90, 50);
        let n = width * height;
        let ramp = |i: usize| (i % width) as f32 * 0.1;
        let features = Planes::from_vec(1, width, height, noise(2, n, 1.0));
        let with = |seed| {
            let noise = noise(seed, n, 0.5);
            let data = (0..n).map(|i| ramp(i) + 3.0 * features.data[i] + noise[i]).collect();
            Planes::from_vec(1, width, height, data)
        };
        let (a, b) = (with(3), with(4));
        // The mean of two images with variance 1/4.
        let dual = mean(&dual_buffer(&a, &b));
        assert!((dual - 0.125).abs() < 0.01, "{dual}");
        let residual = mean(&residual(&a, &features));
        assert!((residual - 0.25).abs() < 0.02, "{residual}");
        // The least of four noisy directions is below the truth, but of its order.
        let noisy = Planes::from_vec(
            1,
            width,
            height,
            (0..n).map(ramp).zip(noise(5, n, 0.5)).map(|(r, v)| r + v).collect(),
        );
        let directional = mean(&directional(&noisy));
        assert!((0.08..0.25).contains(&directional), "{directional}");
    }

    #[test]
    fn an_edge_is_no_noise() {
        let (width, height) = (16, 16);
        let edge = Planes::from_vec(1, width, height, (0..256).map(|i| f32::from(i % 16 > 7)).collect());
        assert_eq!(mean(&directional(&edge)), 0.0);
    }
}
