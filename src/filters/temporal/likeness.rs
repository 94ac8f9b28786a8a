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
        box_mean,
        motion::{Aside, sharp},
        perceptron::Perceptron,
    },
    kernels::{
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

/// How many times as bright as the frame's own result a neighbour's may be before it counts for less: what perceptrons
/// leave of a lamp's light where it was a frame ago would show.
const OUTSHINES: f32 = 8.0;

/// The least agreement whose logarithm is told from none.
const LEAST_AGREEMENT: f32 = 1e-3;

/// The logarithm of the least weight.
const LEAST: f32 = -10.0;

static PERCEPTRON: LazyLock<Perceptron> =
    LazyLock::new(|| Perceptron::read(include_bytes!("likeness.safetensors"), FEATURES, 1));

/// What is known of a denoised frame, whatever neighbour it is held against.
pub struct Own<'a> {
    image: &'a Planes,
    floor: f32,
    /// The squared relative difference of render and result, (1, H, W).
    noise: Planes,
    /// The squared relative difference of the image and its mean over 3x3 pixels, (1, H, W).
    activity: Planes,
}

/// Planes of relative differences of a neighbour's image, and of their squares: means over three channels.
const SIGNED: usize = 0;
const SQUARED: usize = 1;

impl<'a> Own<'a> {
    /// Of a denoised `image`, (3, H, W), or (4, H, W) with alpha, the frame's `radiance` as rendered, and the `exposure`
    /// that brings it to middle grey.
    pub fn of(image: &'a Planes, radiance: &Planes, exposure: f32) -> Self {
        let (size, floor) = ((image.width, image.height), FLOOR / exposure);
        let noise = Planes::from_rows(1, size, |_, y, squared| {
            let both = [image, radiance].map(|planes| planes.rows(y));
            let signed = &mut vec![0.0; size.0];
            vectorised::run(Difference { both, floor, largest: LARGEST, signed, squared });
        });
        let activity = Planes::from_rows(1, size, |_, y, squared| {
            let means = [0, 1, 2].map(|c| {
                let mut mean = vec![0.0; size.0];
                box_mean::row(image.channel(c), size, y, 1, &mut mean);
                mean
            });
            let both = [image.rows(y), means.each_ref().map(Vec::as_slice)];
            let signed = &mut vec![0.0; size.0];
            vectorised::run(Difference { both, floor, largest: f32::INFINITY, signed, squared });
        });
        Self { image, floor, noise, activity }
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
            PERCEPTRON.weigh(&features, LEAST, None, link.flow.row(y).0, out);
            for (x, weight) in out.iter_mut().enumerate() {
                let [own, there] = [self.image, &there]
                    .map(|of| (0..3).map(|c| of.channel(c)[y * width + x]).fold(self.floor, f32::max));
                *weight *= link.share * (OUTSHINES * own / there).min(1.0);
            }
        });
        (there, weights)
    }

    /// The neighbour's image where the content of this frame lies in it, and how the two differ.
    fn compare(&self, other: &Planes, link: &Link) -> (Planes, Planes) {
        let there = fetch(self.image, other, link);
        let size = (self.image.width, self.image.height);
        let differences = Planes::from_rows_of_all(2, size, |y, out| {
            let both = [self.image, &there].map(|planes| planes.rows(y));
            let [signed, squared] = out else { unreachable!("there are two planes") };
            let (floor, largest) = (self.floor, f32::INFINITY);
            vectorised::run(Difference { both, floor, largest, signed, squared });
        });
        (there, differences)
    }

    /// The [`FEATURES`] lines of a row of pixels.
    fn features_of_row(&self, y: usize, differences: &Planes, link: &Link, out: &mut [f32]) {
        let size = (self.image.width, self.image.height);
        let [signed, squared] = [SIGNED, SQUARED].map(|c| differences.channel(c));
        // Each plane, the mean over how many rows and columns around a pixel it is taken of, and what becomes
        // of that before its logarithm is taken.
        let logarithms = [
            (squared, 0, Of::Sum(TINY)),
            (signed, 1, Of::Square(TINY)),
            (signed, 3, Of::Square(TINY)),
            (squared, 2, Of::Sum(TINY)),
            (&self.noise.data, 3, Of::Sum(TINY_NOISE)),
            (&self.activity.data, 1, Of::Sum(TINY)),
            (&link.weights.data, 0, Of::Least(LEAST_AGREEMENT)),
        ];
        let (of_logarithms, beside) = out.split_at_mut(logarithms.len() * size.0);
        for (line, (plane, reach, of)) in of_logarithms.chunks_exact_mut(size.0).zip(logarithms) {
            box_mean::row(plane, size, y, reach, line);
            vectorised::run(Logarithm { of, line });
        }
        let (columns, rows) = link.flow.row(y);
        vectorised::run(Aside { columns, rows, out: beside });
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

/// Takes the logarithm of a line of features.
struct Logarithm<'a> {
    of: Of,
    line: &'a mut [f32],
}

impl Vectorised for Logarithm<'_> {
    #[inline(always)]
    fn run(self) {
        let values = self.line.iter_mut();
        match self.of {
            Of::Sum(tiny) => values.for_each(|v| *v = ln(*v + tiny)),
            Of::Square(tiny) => values.for_each(|v| *v = ln(*v * *v + tiny)),
            Of::Least(least) => values.for_each(|v| *v = ln(v.max(least))),
        }
    }
}

/// The means, over three channels of a row of two images, of their differences relative to the first, and of
/// the squares of these, each of which counts no more than `largest`.
struct Difference<'a> {
    both: [[&'a [f32]; 3]; 2],
    floor: f32,
    largest: f32,
    signed: &'a mut [f32],
    squared: &'a mut [f32],
}

impl Vectorised for Difference<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { both: [image, other], floor, largest, signed, squared } = self;
        signed.fill(0.0);
        squared.fill(0.0);
        for (image, other) in image.into_iter().zip(other) {
            let sums = signed.iter_mut().zip(&mut *squared);
            for ((signed, squared), (image, other)) in sums.zip(image.iter().zip(other)) {
                let relative = (other.max(0.0) - image) / (image.max(0.0) + floor);
                *signed += relative * (1.0 / 3.0);
                *squared += (relative * relative).min(largest) * (1.0 / 3.0);
            }
        }
    }
}

/// The neighbour's image at the places where the content of the frame lies in it; the frame's own where
/// that is outside.
fn fetch(own: &Planes, other: &Planes, link: &Link) -> Planes {
    assert_eq!(own.channels, other.channels, "both with alpha, or without");
    match own.channels {
        3 => fetch_channels::<3>(own, other, link),
        4 => fetch_channels::<4>(own, other, link),
        n => unreachable!("{n} planes are no image"),
    }
}

fn fetch_channels<const N: usize>(own: &Planes, other: &Planes, link: &Link) -> Planes {
    let (width, height) = link.flow.size();
    // Alpha, behind the light, is as high in dark frames as in bright ones.
    let factors: [f32; N] = std::array::from_fn(|c| if c < 3 { link.brightness } else { 1.0 });
    Planes::from_rows_of_all(N, (width, height), |y, out| {
        let (columns, rows) = link.flow.row(y);
        for x in 0..width {
            let values: [f32; N] = if columns[x].is_nan() {
                std::array::from_fn(|c| own.channel(c)[y * width + x])
            } else {
                let there: [f32; N] = sharp(other, (columns[x], rows[x]));
                std::array::from_fn(|c| factors[c] * there[c])
            };
            out.iter_mut().zip(values).for_each(|(out, value)| out[x] = value);
        }
    })
}
