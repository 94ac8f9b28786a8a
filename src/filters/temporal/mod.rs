//! Averages over frames of a sequence, along motion and weighted by [agreement](super::agreement): before a
//! denoiser, of what was rendered, and after it, of what was denoised.
//!
//! In: planes of a frame and of its neighbours. Out: the frame's, less noisy and steadier. Sums run in the
//! order of the neighbours: the same window gives the same bits.

pub mod likeness;

use self::likeness::Own;
use super::motion::Flow;
use crate::planes::{Planes, Values};

/// What is known of a neighbour of a frame: where its content lies there, and how far to believe it.
#[derive(Clone, Debug)]
pub struct Link {
    /// From each pixel of the frame.
    pub flow: Flow,
    /// From 0 to 1, (1, H, W).
    pub weights: Planes,
    /// How many times as bright the frame is as the neighbour: its light is multiplied by that.
    pub brightness: f32,
    /// From 0 to 1: how far the neighbour counts beside its weights, since its samples are fewer.
    pub share: f32,
}

impl Link {
    /// 1 where the frame's content lies inside of the neighbour, elsewhere 0, (1, H, W).
    pub fn inside(&self) -> Planes {
        Planes::from_rows(1, self.flow.size(), |_, y, out| {
            let columns = self.flow.row(y).0;
            out.iter_mut().zip(columns).for_each(|(out, x)| *out = if x.is_nan() { 0.0 } else { 1.0 });
        })
    }

    /// Planes of the neighbour at the pixel that is nearest to where the frame's content lies; 0 where that is
    /// outside.
    pub fn nearest(&self, planes: &Planes) -> Planes {
        Planes::from_rows_of_all(planes.channels, self.flow.size(), |y, rows| {
            let stretches = self.flow.nearest_of_row(y);
            for (c, out) in rows.iter_mut().enumerate() {
                out.fill(0.0);
                for stretch in &stretches {
                    stretch.of_mut(out).copy_from_slice(stretch.of_other(planes.channel(c)));
                }
            }
        })
    }
}

/// The weighted mean of `own`, a pass of (C, H, W), and of its neighbours'. Of a neighbour, each pixel
/// takes the nearest one: noise stays the noise of single pixels, as denoisers know it, and is not smeared.
/// Where that is outside of the neighbour, its weight is 0. `is_light` if the pass is as bright as the frame.
///
/// # Panics
/// If sizes differ.
pub fn merge(own: &dyn Values, is_light: bool, neighbours: &[(&dyn Values, &Link)]) -> Planes {
    let (channels, width, height) = own.extent();
    let size = (width, height);
    for (values, link) in neighbours {
        assert_eq!(values.extent(), own.extent(), "planes of one pass");
        assert!(link.flow.size() == size, "frames of one size");
    }
    Planes::from_rows_of_all(channels, size, |y, rows| {
        let stretches: Vec<_> = neighbours.iter().map(|(_, link)| link.flow.nearest_of_row(y)).collect();
        let weights = neighbours.iter().map(|(_, link)| {
            let weights = link.weights.row(0, y).iter().map(|weight| weight * link.share);
            weights.collect::<Vec<f32>>()
        });
        let weights: Vec<Vec<f32>> = weights.collect();
        let mut sums = vec![1.0; size.0];
        for weights in &weights {
            sums.iter_mut().zip(weights).for_each(|(sum, weight)| *sum += weight);
        }
        let mut there = vec![0.0; size.0];
        for (c, out) in rows.iter_mut().enumerate() {
            own.read(c, y * size.0, out);
            for (((values, link), stretches), weights) in neighbours.iter().zip(&stretches).zip(&weights) {
                let factor = if is_light { link.brightness } else { 1.0 };
                for stretch in stretches {
                    let there = &mut there[..stretch.pixels];
                    values.read(c, stretch.there, there);
                    let both = there.iter().zip(stretch.of(weights));
                    let out = stretch.of_mut(out).iter_mut();
                    out.zip(both).for_each(|(out, (value, weight))| *out += weight * (factor * value));
                }
            }
            out.iter_mut().zip(&sums).for_each(|(out, sum)| *out /= sum);
        }
    })
}

/// The weighted mean of a denoised `image`, (3, H, W), and its neighbours' denoised images, as far as each is
/// [alike](Own). Alpha may be a fourth plane of all of them: it goes where the light does. `radiance` is the frame as
/// rendered, `exposure` what brings it to middle grey.
///
/// # Panics
/// If sizes differ.
pub fn blend(image: &Planes, radiance: &Planes, exposure: f32, neighbours: &[(&Planes, &Link)]) -> Planes {
    let size = (image.width, image.height);
    assert!((radiance.width, radiance.height) == size, "a frame and its denoised image");
    if neighbours.is_empty() {
        return image.clone();
    }
    let own = Own::of(image, radiance, exposure);
    let others: Vec<(Planes, Planes)> = neighbours
        .iter()
        .map(|(other, link)| {
            assert!((other.width, other.height) == size && link.flow.size() == size, "frames of one size");
            own.weigh(other, link)
        })
        .collect();
    Planes::from_rows_of_all(image.channels, size, |y, rows| {
        let mut sums = vec![1.0; size.0];
        for (_, weights) in &others {
            sums.iter_mut().zip(weights.row(0, y)).for_each(|(sum, weight)| *sum += weight);
        }
        for (c, out) in rows.iter_mut().enumerate() {
            out.copy_from_slice(image.row(c, y));
            for (there, weights) in &others {
                let both = there.row(c, y).iter().zip(weights.row(0, y));
                out.iter_mut().zip(both).for_each(|(out, (there, weight))| *out += weight * there);
            }
            out.iter_mut().zip(&sums).for_each(|(out, sum)| *out /= sum);
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{filters::motion::Direction, rng::Rng};

    const SIZE: (usize, usize) = (40, 30);

    fn grey(value: impl Fn(usize, usize) -> f32 + Sync) -> Planes {
        Planes::from_rows(3, SIZE, |_, y, out| {
            out.iter_mut().enumerate().for_each(|(x, out)| *out = value(x, y));
        })
    }

    /// A link along a motion of whole pixels to the right, trusted everywhere inside.
    fn link(right: f32, weight: f32) -> Link {
        let mut flow = Flow::still(SIZE.0, SIZE.1);
        flow.step(
            &Planes::from_rows(4, SIZE, |c, _, out| out.fill(if c == 2 { -right } else { 0.0 })),
            Direction::Forth,
        );
        let weights = Planes::from_rows(1, SIZE, |_, y, out| {
            let columns = flow.row(y).0;
            out.iter_mut().zip(columns).for_each(|(out, x)| *out = if x.is_nan() { 0.0 } else { weight });
        });
        Link { flow, weights, brightness: 1.0, share: 1.0 }
    }

    #[test]
    fn merging_follows_the_motion_and_the_weights() {
        let own = grey(|x, y| (x + 2 * y) as f32);
        let moved = grey(|x, y| x as f32 - 3.0 + 2.0 * y as f32 + 1.0);
        let merged = merge(&own, true, &[(&moved, &link(3.0, 0.5))]);
        for x in 0..SIZE.0 {
            // One brighter, at half the weight; what leaves the frame is left as it was.
            let weight = if x + 3 < SIZE.0 { 0.5 } else { 0.0 };
            let more = weight / (1.0 + weight);
            assert!((merged.channel(1)[x] - x as f32 - more).abs() < 1e-4, "{x}");
        }
        assert_eq!(merge(&own, true, &[]), own);
    }

    #[test]
    fn a_neighbour_of_fewer_samples_counts_by_as_much_less() {
        let full = link(0.0, 0.8);
        let quarter = Link { share: 0.25, ..full.clone() };
        let own = grey(|_, _| 1.0);
        let merged = merge(&own, true, &[(&grey(|_, _| 2.0), &quarter)]);
        assert!((merged.data[0] - (1.0 + 0.2 / 1.2)).abs() < 1e-6, "{}", merged.data[0]);
        // Of results too: it is no less alike for that.
        let radiance = grey(|x, y| 0.5 + 0.1 * ((x + y) % 2) as f32);
        let own = Own::of(&own, &radiance, 0.6);
        let other = grey(|_, _| 1.01);
        let [whole, part] = [&full, &quarter].map(|link| own.weigh(&other, link).1.data[0]);
        assert!((part / whole - 0.25).abs() < 1e-6, "{part} {whole}");
    }

    #[test]
    fn results_that_agree_are_averaged_and_others_left_out() {
        let mut rng = Rng::new(3, 0);
        let noise: Vec<f32> = (0..SIZE.0 * SIZE.1).map(|_| rng.uniform()).collect();
        let radiance = grey(|x, y| 0.6 * noise[y * SIZE.0 + x]);
        let image = grey(|_, _| 0.3);
        let link = link(0.0, 1.0);
        let near = blend(&image, &radiance, 0.6, &[(&grey(|_, _| 0.31), &link)]);
        assert!(near.data.iter().all(|v| (0.303..0.3051).contains(v)), "{}", near.data[0]);
        let far = blend(&image, &radiance, 0.6, &[(&grey(|_, _| 0.9), &link)]);
        assert!(far.data.iter().all(|v| (0.3..0.32).contains(v)), "{}", far.data[0]);
        assert_eq!(blend(&image, &radiance, 0.6, &[]), image);
        // Alpha goes where the light does, and is no brighter in a brighter frame.
        let with_alpha = |image: &Planes, alpha: f32| {
            image.followed_by(&Planes::from_vec(1, SIZE.0, SIZE.1, vec![alpha; SIZE.0 * SIZE.1]))
        };
        let link = Link { brightness: 2.0, ..link };
        let (own, other) = (with_alpha(&image, 0.4), with_alpha(&grey(|_, _| 0.155), 0.8));
        let [light, alpha] = blend(&own, &radiance, 0.6, &[(&other, &link)]).split_after(3);
        assert_eq!(light, near);
        let moved = light.channel(0).iter().map(|light| (light - 0.3) / 0.01);
        for (moved, alpha) in moved.zip(&alpha.data) {
            assert!((alpha - (0.4 + 0.4 * moved)).abs() < 1e-3, "{alpha} {moved}");
        }
    }
}
