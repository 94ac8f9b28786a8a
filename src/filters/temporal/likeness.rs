//! How far a neighbour's result may be averaged with a frame's own, learned from short sequences and the
//! reference of their middle frame.
//!
//! In: two denoised images and the [`Link`] between their frames. Out: a weight for every pixel, beside 1 for
//! the frame's own image. What vectors do not know (mirrors, glass, shadows, things that change) shows as a
//! difference between the two images that is larger than what denoising leaves of the noise. How large that
//! is, a perceptron tells from the differences of single pixels and of their surroundings, from the noise
//! that was removed, and from how the image varies by itself. It was trained by `eval/training/neighbours.py`
//! to make the RelMSE of the average least.

use std::sync::LazyLock;

use super::Link;
use crate::{
    filters::{
        motion::{aside, sharp},
        perceptron::Perceptron,
    },
    kernels::{
        exponential::exp,
        logarithm::ln,
        vectorised::{self, Vectorised},
    },
    planes::Planes,
};

/// Lines of features of a row of pixels.
pub const FEATURES: usize = 8;

/// Exposed radiance that is added to what is denoised before differences are divided by it.
const FLOOR: f32 = 0.02;

/// Squared relative differences of render and result count no more than this: one firefly is not the noise
/// around it.
const LARGEST: f32 = 4.0;

/// Added to squared relative differences, and to noise, before their logarithm is taken.
const TINY: f32 = 1e-5;
const TINY_NOISE: f32 = 1e-4;

/// The least agreement whose logarithm is told from none.
const LEAST_AGREEMENT: f32 = 1e-3;

/// Logarithms of the least and the largest weight.
const LEAST: f32 = -10.0;
const MOST: f32 = 0.0;

static PERCEPTRON: LazyLock<Perceptron> =
    LazyLock::new(|| Perceptron::read(include_bytes!("likeness.safetensors"), FEATURES, 1));

/// What is known of a denoised frame, whatever neighbour it is held against.
pub struct Own<'a> {
    image: &'a Planes,
    floor: f32,
    /// The mean squared relative difference of render and result over 7x7 pixels, (1, H, W).
    noise: Planes,
    /// The mean squared relative difference of the image and its mean over 3x3 pixels, over 3x3, (1, H, W).
    activity: Planes,
}

impl<'a> Own<'a> {
    /// Of a denoised `image`, (3, H, W), the frame's `radiance` as rendered, and the `exposure` that brings it
    /// to middle grey.
    pub fn of(image: &'a Planes, radiance: &Planes, exposure: f32) -> Self {
        let floor = FLOOR / exposure;
        let noise = mean_of_channels(image, radiance, |image, rendered| {
            let relative = (rendered.max(0.0) - image) / (image.max(0.0) + floor);
            (relative * relative).min(LARGEST)
        });
        let activity = mean_of_channels(image, &box_mean(image, 1), |image, mean| {
            let relative = (image - mean) / (image.max(0.0) + floor);
            relative * relative
        });
        Self { image, floor, noise: box_mean(&noise, 3), activity: box_mean(&activity, 1) }
    }

    /// The neighbour's image where the content of this frame lies in it, and the [`FEATURES`] of every row of
    /// pixels, (H, FEATURES, W) as one plane.
    pub fn features(&self, other: &Planes, link: &Link) -> (Planes, Planes) {
        let (there, differences) = self.compare(other, link);
        let (width, height) = (self.image.width, self.image.height);
        let features = Planes::from_rows(1, (FEATURES * width, height), |_, y, out| {
            self.features_of_row(y, &differences, link, out);
        });
        (there, features)
    }

    /// The neighbour's image where the content of this frame lies in it, and its weight, (1, H, W); 0 where
    /// that is outside.
    pub fn weigh(&self, other: &Planes, link: &Link) -> (Planes, Planes) {
        let (there, differences) = self.compare(other, link);
        let (width, height) = (self.image.width, self.image.height);
        // A row at a time: features of a whole frame would take many times its memory.
        let weights = Planes::from_rows(1, (width, height), |_, y, out| {
            let mut features = vec![0.0; FEATURES * width];
            self.features_of_row(y, &differences, link, &mut features);
            PERCEPTRON.apply(&features, width, out);
            vectorised::run(Weights { columns: link.flow.row(y).0, out });
        });
        (there, weights)
    }

    /// The neighbour's image where the content of this frame lies in it, and how the two differ: squared at
    /// single pixels, their mean over 3x3 and 7x7 pixels, and squared over 5x5.
    fn compare(&self, other: &Planes, link: &Link) -> (Planes, [Planes; 4]) {
        let there = fetch(self.image, other, link);
        let floor = self.floor;
        let squared = mean_of_channels(self.image, &there, |image, there| {
            let relative = (there - image) / (image.max(0.0) + floor);
            relative * relative
        });
        let signed =
            mean_of_channels(self.image, &there, |image, there| (there - image) / (image.max(0.0) + floor));
        let near = box_mean(&squared, 2);
        let [shift, wide_shift] = [1, 3].map(|reach| box_mean(&signed, reach));
        (there, [squared, shift, wide_shift, near])
    }

    /// The [`FEATURES`] lines of a row of pixels.
    fn features_of_row(&self, y: usize, differences: &[Planes; 4], link: &Link, out: &mut [f32]) {
        let width = self.image.width;
        let (logarithms, beside) = out.split_at_mut(LOGARITHMS.len() * width);
        let planes = differences.iter().chain([&self.noise, &self.activity, &link.weights]);
        for ((out, planes), of) in logarithms.chunks_exact_mut(width).zip(planes).zip(LOGARITHMS) {
            let values = &planes.data[y * width..][..width];
            vectorised::run(Logarithm { values, of, out });
        }
        let (columns, rows) = link.flow.row(y);
        beside.iter_mut().zip(columns.iter().zip(rows)).for_each(|(out, (x, y))| *out = aside(*x, *y));
    }
}

/// Weights from their logarithms, 0 where the content lies outside of the other frame.
struct Weights<'a> {
    columns: &'a [f32],
    out: &'a mut [f32],
}

impl Vectorised for Weights<'_> {
    #[inline(always)]
    fn run(self) {
        self.out.iter_mut().zip(self.columns).for_each(|(out, column)| {
            let weight = exp(out.clamp(LEAST, MOST));
            *out = if column.is_nan() { 0.0 } else { weight };
        });
    }
}

/// What becomes of the values of a feature before their logarithm is taken.
#[derive(Clone, Copy)]
enum Of {
    /// So much is added.
    Sum(f32),
    /// Their square, to which so much is added.
    Square(f32),
    /// At least so much.
    Least(f32),
}

/// All features but the last, which is how far the content lies from a pixel's centre.
const LOGARITHMS: [Of; FEATURES - 1] = [
    Of::Sum(TINY),
    Of::Square(TINY),
    Of::Square(TINY),
    Of::Sum(TINY),
    Of::Sum(TINY_NOISE),
    Of::Sum(TINY),
    Of::Least(LEAST_AGREEMENT),
];

/// A feature of a row of pixels.
struct Logarithm<'a> {
    values: &'a [f32],
    of: Of,
    out: &'a mut [f32],
}

impl Vectorised for Logarithm<'_> {
    #[inline(always)]
    fn run(self) {
        let both = self.out.iter_mut().zip(self.values);
        match self.of {
            Of::Sum(tiny) => both.for_each(|(out, v)| *out = ln(v + tiny)),
            Of::Square(tiny) => both.for_each(|(out, v)| *out = ln(v * v + tiny)),
            Of::Least(least) => both.for_each(|(out, v)| *out = ln(v.max(least))),
        }
    }
}

/// The mean over three channels of what `of` makes of the values of two images, (1, H, W).
fn mean_of_channels(one: &Planes, other: &Planes, of: impl Fn(f32, f32) -> f32 + Sync) -> Planes {
    let (width, height) = (one.width, one.height);
    Planes::from_rows(1, (width, height), |_, y, out| {
        out.fill(0.0);
        for c in 0..3 {
            let [one, other] = [one, other].map(|planes| &planes.channel(c)[y * width..][..width]);
            out.iter_mut().zip(one.iter().zip(other)).for_each(|(sum, (a, b))| *sum += of(*a, *b));
        }
        out.iter_mut().for_each(|sum| *sum *= 1.0 / 3.0);
    })
}

/// The neighbour's image at the places where the content of the frame lies in it; the frame's own where
/// that is outside.
fn fetch(own: &Planes, other: &Planes, link: &Link) -> Planes {
    let (width, height) = link.flow.size();
    // Rows of all three channels at once, (H, C, W): their places are the same.
    let lines = Planes::from_rows(1, (3 * width, height), |_, y, out| {
        let (columns, rows) = link.flow.row(y);
        for x in 0..width {
            let at = y * width + x;
            let colours = if columns[x].is_nan() {
                [0, 1, 2].map(|c| own.channel(c)[at])
            } else {
                sharp(other, (columns[x], rows[x]))
            };
            colours.into_iter().enumerate().for_each(|(c, colour)| out[c * width + x] = colour);
        }
    });
    Planes::from_rows(3, (width, height), |c, y, out| {
        out.copy_from_slice(&lines.data[(3 * y + c) * width..][..width]);
    })
}

/// The mean over the pixels of the frame that are at most `reach` rows and columns away.
fn box_mean(planes: &Planes, reach: usize) -> Planes {
    let (width, height) = (planes.width, planes.height);
    let span = |at: usize, end: usize| at.saturating_sub(reach)..(at + reach + 1).min(end);
    let down = Planes::from_rows(planes.channels, (width, height), |c, y, out| {
        out.fill(0.0);
        let rows = span(y, height);
        let share = 1.0 / rows.len() as f32;
        for row in rows {
            let line = &planes.channel(c)[row * width..][..width];
            out.iter_mut().zip(line).for_each(|(sum, v)| *sum += share * v);
        }
    });
    Planes::from_rows(planes.channels, (width, height), |c, y, out| {
        let line = &down.channel(c)[y * width..][..width];
        // Columns that have all their neighbours are summed up a shift at a time, which is vectorised.
        let inner = reach.min(width)..width.saturating_sub(reach).max(reach.min(width));
        let share = 1.0 / (2 * reach + 1) as f32;
        out[inner.clone()].fill(0.0);
        for first in 0..(2 * reach + 1).min(width) {
            let shifted = line[first..].iter().take(inner.len());
            out[inner.clone()].iter_mut().zip(shifted).for_each(|(sum, v)| *sum += share * v);
        }
        for x in (0..inner.start).chain(inner.end..width) {
            let near = &line[span(x, width)];
            out[x] = near.iter().sum::<f32>() / near.len() as f32;
        }
    })
}
