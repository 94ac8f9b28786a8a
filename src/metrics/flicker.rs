//! Flicker: how much the error of a sequence changes from frame to frame where the picture itself does not
//! change. An eye sees this as boiling.
//!
//! With e(t) the error of frame t, r(t) its reference, and W the bilinear warp along the Vector pass from
//! frame t - 1, it is the mean over pixels and channels of `(e(t) - W e(t-1))^2 / (r(t)^2 + 0.001)`. A pixel
//! counts only if, in every channel, the 3x3 mean of the reference changes along its motion by less than a
//! tenth of that mean plus 0.003. Elsewhere light moves, or surfaces come and go.

use super::error::RELMSE_EPSILON;
use crate::{
    filters::motion::{Direction, Flow},
    planes::Planes,
};

/// How much the reference's 3x3 mean may change: by this share of it, plus this much radiance.
const CHANGE: f32 = 0.1;
const DARK_CHANGE: f32 = 0.003;

/// A frame and the one before it.
#[derive(Clone, Copy)]
pub struct Pair<'a> {
    /// Images, (3, H, W), of this frame and of the one before.
    pub images: [&'a Planes; 2],
    /// Their references.
    pub references: [&'a Planes; 2],
    /// This frame's Vector pass, (4, H, W).
    pub vectors: &'a Planes,
}

/// The flicker of a frame; none where no pixel can be followed.
///
/// # Panics
/// If sizes differ.
pub fn flicker(pair: &Pair) -> Option<f64> {
    let [image, before] = pair.images;
    let [reference, reference_before] = pair.references;
    let size = (image.width, image.height);
    let mut flow = Flow::still(size.0, size.1);
    flow.step(pair.vectors, Direction::Back);
    let error = subtract(image, reference);
    let error_before = flow.bilinear(&subtract(before, reference_before));
    let mean = mean_3x3(reference);
    let mean_before = flow.bilinear(&mean_3x3(reference_before));
    let is_same = |at: usize| {
        (0..3).all(|c| {
            let (mean, before) = (mean.channel(c)[at], mean_before.channel(c)[at]);
            (mean - before).abs() < CHANGE * mean.abs() + DARK_CHANGE
        })
    };
    let (mut sum, mut count) = (0.0, 0usize);
    // Pixels that lie outside of the frame before are NaN there, so `is_same` is false for them.
    for at in (0..image.pixels()).filter(|at| is_same(*at)) {
        for c in 0..3 {
            let [error, before, reference] =
                [&error, &error_before, reference].map(|planes| f64::from(planes.channel(c)[at]));
            sum += (error - before).powi(2) / (reference * reference + RELMSE_EPSILON);
        }
        count += 3;
    }
    (count > 0).then(|| sum / count as f64)
}

fn subtract(image: &Planes, reference: &Planes) -> Planes {
    assert_eq!(image.extent(), reference.extent(), "an image and its reference");
    Planes::from_rows(3, (image.width, image.height), |c, y, out| {
        let at = c * image.pixels() + y * image.width;
        let both = image.data[at..].iter().zip(&reference.data[at..]);
        out.iter_mut().zip(both).for_each(|(out, (image, reference))| *out = image - reference);
    })
}

/// The mean of the 3x3 pixels around each pixel. Beyond the frame, the pixels at its border are repeated.
fn mean_3x3(planes: &Planes) -> Planes {
    let (width, height) = (planes.width, planes.height);
    Planes::from_rows(planes.channels, (width, height), |c, y, out| {
        let rows = [y.saturating_sub(1), y, (y + 1).min(height - 1)];
        let lines = rows.map(|y| planes.row(c, y));
        for (x, out) in out.iter_mut().enumerate() {
            let columns = [x.saturating_sub(1), x, (x + 1).min(width - 1)];
            *out = lines.iter().flat_map(|line| columns.map(|x| line[x])).sum::<f32>() / 9.0;
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (12, 9);

    fn flat(value: f32) -> Planes {
        Planes::from_rows(3, SIZE, |_, _, out| out.fill(value))
    }

    #[test]
    fn an_error_that_stays_does_not_flicker_and_one_that_changes_does() {
        let (reference, vectors) = (flat(0.5), Planes::new(4, SIZE.0, SIZE.1));
        let of = |now: f32, before: f32| {
            let [now, before] = [now, before].map(flat);
            let references = [&reference, &reference];
            flicker(&Pair { images: [&now, &before], references, vectors: &vectors }).unwrap()
        };
        assert_eq!(of(0.7, 0.7), 0.0);
        let expected = 0.1f64.powi(2) / (0.25 + 0.001);
        assert!((of(0.6, 0.5) / expected - 1.0).abs() < 1e-5, "{}", of(0.6, 0.5));
    }

    #[test]
    fn where_light_changes_or_all_is_new_there_is_none() {
        let (dark, bright, vectors) = (flat(0.5), flat(0.6), Planes::new(4, SIZE.0, SIZE.1));
        let [images, references] = [[&bright, &dark]; 2];
        assert_eq!(flicker(&Pair { images, references, vectors: &vectors }), None);
        let away = Planes::from_rows(4, SIZE, |_, _, out| out.fill(50.0));
        let references = [&dark, &dark];
        assert_eq!(flicker(&Pair { images, references, vectors: &away }), None);
    }
}
