//! Crops composed of two: edges that no scene in the training set has, at no rendering cost.
//!
//! A random shape is cut out of a crop, and another crop, or the same one in another light or paint, shows
//! through it. As in a render, a pixel on the outline mixes both sides: the reference by the area of the pixel
//! that the shape covers, the noisy passes by those of its few samples that fell inside. Every side keeps its
//! own noise, so the result is a valid pair (after CutMix, Yun et al. 2019, which pastes rectangles for
//! classification; here it is the compositing of two opaque layers, Porter and Duff 1984).

use std::f32::consts::TAU;

use super::{Sample, augment::carries_radiance};
use crate::{nn::Rng, passes::Pass, planes::Planes};

/// Rows and columns of the grid of places in a pixel where a shape is tested.
const GRID: usize = 4;

/// Most samples of a pixel that are told apart on an outline.
const MAX_SAMPLES: usize = GRID * GRID;

/// One outline: its inside is where the function is true.
#[derive(Clone, Copy, Debug)]
enum Outline {
    /// Centre and radius.
    Disc { centre: [f32; 2], radius: f32 },
    /// Normal, distance from the origin along it, and half the width: a half plane where that is infinite.
    Band { normal: [f32; 2], distance: f32, half_width: f32 },
    /// Parallel bands: normal, phase, period, and the share of the period that is inside.
    Stripes { normal: [f32; 2], phase: f32, period: f32, share: f32 },
}

impl Outline {
    /// A random outline in a square of `size` pixels.
    fn draw(size: f32, rng: &mut Rng) -> Self {
        let (sin, cos) = (TAU * rng.uniform()).sin_cos();
        let normal = [cos, sin];
        let centre = [size * rng.uniform(), size * rng.uniform()];
        let distance = dot(normal, centre);
        // From half a pixel to half the square, all scales alike.
        let mut width = || 0.5 * size.powf(rng.uniform());
        match width() {
            radius if radius > 0.2 * size => Outline::Band { normal, distance, half_width: f32::INFINITY },
            radius => match rng.below(3) {
                0 => Outline::Disc { centre, radius },
                1 => Outline::Band { normal, distance, half_width: 0.5 * radius },
                _ => Outline::Stripes {
                    normal,
                    phase: distance,
                    period: 3.0 * radius,
                    share: 0.1 + 0.5 * rng.uniform(),
                },
            },
        }
    }

    fn contains(&self, at: [f32; 2]) -> bool {
        match *self {
            Outline::Disc { centre, radius } => {
                let offset = [at[0] - centre[0], at[1] - centre[1]];
                dot(offset, offset) < radius * radius
            }
            Outline::Band { normal, distance, half_width } => {
                let across = dot(normal, at) - distance;
                if half_width.is_finite() { across.abs() < half_width } else { across < 0.0 }
            }
            Outline::Stripes { normal, phase, period, share } => {
                ((dot(normal, at) - phase) / period).rem_euclid(1.0) < share
            }
        }
    }
}

fn dot(a: [f32; 2], b: [f32; 2]) -> f32 {
    a[0] * b[0] + a[1] * b[1]
}

/// What a shape covers of every pixel.
struct Coverage {
    /// The share of the pixel's area.
    exact: Vec<f32>,
    /// The share of the noisy frame's samples.
    sampled: Vec<f32>,
}

impl Coverage {
    /// One to four outlines; where an odd number of them overlap is inside.
    fn draw((width, height): (usize, usize), samples: usize, rng: &mut Rng) -> Self {
        let size = width.max(height) as f32;
        let outlines: Vec<Outline> = (0..1 + rng.below(4)).map(|_| Outline::draw(size, rng)).collect();
        let inside = |at| outlines.iter().filter(|o| o.contains(at)).count() % 2 == 1;
        let samples = samples.clamp(1, MAX_SAMPLES);
        let mut coverage = Self { exact: Vec::new(), sampled: Vec::new() };
        for pixel in 0..width * height {
            let corner = [(pixel % width) as f32, (pixel / width) as f32];
            let mut places: [bool; MAX_SAMPLES] = std::array::from_fn(|place| {
                let offset = [place % GRID, place / GRID].map(|i| (i as f32 + 0.5) / GRID as f32);
                inside([corner[0] + offset[0], corner[1] + offset[1]])
            });
            let share = |places: &[bool]| places.iter().filter(|&&p| p).count() as f32 / places.len() as f32;
            let exact = share(&places);
            coverage.exact.push(exact);
            // Away from outlines every sample says the same.
            if exact > 0.0 && exact < 1.0 {
                // Fisher and Yates: the first `samples` places become a random choice.
                (0..samples).for_each(|i| places.swap(i, i + rng.below(MAX_SAMPLES - i)));
            }
            coverage.sampled.push(share(&places[..samples]));
        }
        coverage
    }
}

/// Mixes `other` into `base` where a random shape lies; `samples` is what a pixel of `base` had. Passes that
/// only `base` has leave it as it was, since half of such a pass would be missing.
///
/// # Panics
/// If the two differ in size.
pub(super) fn compose(base: &mut Sample, other: &Sample, samples: usize, rng: &mut Rng) {
    let size = (base.passes.width, base.passes.height);
    assert_eq!(size, (other.passes.width, other.passes.height), "two crops of one size");
    if base.passes.iter().any(|(pass, _)| other.passes.get(pass).is_none()) {
        return;
    }
    let coverage = Coverage::draw(size, samples, rng);
    let mixed: Vec<(Pass, Planes)> = (base.passes.iter())
        .filter_map(|(pass, planes)| Some((pass, mix(planes, other.passes.get(pass)?, &coverage.sampled))))
        .collect();
    mixed.into_iter().for_each(|(pass, planes)| base.passes.insert(pass, planes));
    base.reference = mix(&base.reference, &other.reference, &coverage.exact);
}

/// `to` by `share` of every pixel, `from` by the rest.
fn mix(from: &Planes, to: &Planes, share: &[f32]) -> Planes {
    let mut out = from.clone();
    for c in 0..out.channels {
        let to = to.channel(c);
        for ((value, to), share) in out.channel_mut(c).iter_mut().zip(to).zip(share) {
            *value += share * (to - *value);
        }
    }
    out
}

/// The same crop where less light falls, or light of another colour: what a shadow's edge divides.
pub(super) fn relit(sample: &Sample, rng: &mut Rng) -> Sample {
    /// Down to a sixteenth of the light.
    const STOPS: f32 = 4.0;
    let dimmer = (-STOPS * rng.uniform()).exp2();
    let factors = [0; 3].map(|_| dimmer * (0.5 * rng.uniform() - 0.25).exp2());
    scaled(sample, factors, carries_radiance)
}

/// The same crop with darker paint on everything: what an edge in a texture divides.
pub(super) fn repainted(sample: &Sample, rng: &mut Rng) -> Sample {
    let dimmer = 0.1 + 0.9 * rng.uniform();
    let factors = [0; 3].map(|_| dimmer * (1.0 - 0.5 * rng.uniform()));
    // Light passes are divided by the paint already.
    scaled(sample, factors, |pass| {
        use Pass::*;
        matches!(pass, Combined | NoisyImage | DiffuseColor | GlossyColor | TransmissionColor | DenoisingAlbedo)
    })
}

/// A copy with the reference and the chosen passes multiplied.
fn scaled(sample: &Sample, factors: [f32; 3], chosen: impl Fn(Pass) -> bool) -> Sample {
    let scale = |planes: &Planes| {
        let mut planes = planes.clone();
        for (c, factor) in factors.iter().enumerate() {
            planes.channel_mut(c).iter_mut().for_each(|v| *v *= factor);
        }
        planes
    };
    let mut out = sample.clone();
    for (pass, planes) in sample.passes.iter().filter(|(pass, _)| chosen(*pass)) {
        out.passes.insert(pass, scale(planes));
    }
    out.reference = scale(&sample.reference);
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::passes::PassSet;

    /// Radiance `radiance`, albedo `albedo` and a reference like the radiance, everywhere.
    fn flat(radiance: f32, albedo: f32) -> Sample {
        let plane = |v| Planes::from_vec(3, 64, 64, vec![v; 3 * 64 * 64]);
        let mut passes = PassSet::new("flat.exr", "", 64, 64);
        passes.insert(Pass::Combined, plane(radiance));
        passes.insert(Pass::DenoisingAlbedo, plane(albedo));
        Sample { passes, reference: plane(radiance) }
    }

    #[test]
    fn noisy_passes_mix_by_samples_and_the_reference_by_area() {
        let (mut partial, mut error) = (0, 0.0);
        for seed in 0..40 {
            let mut sample = flat(0.0, 0.0);
            compose(&mut sample, &flat(2.0, 0.5), 4, &mut Rng::new(seed, 1));
            let combined = &sample.passes.get(Pass::Combined).unwrap().data;
            let albedo = &sample.passes.get(Pass::DenoisingAlbedo).unwrap().data;
            for ((c, a), r) in combined.iter().zip(albedo).zip(&sample.reference.data) {
                // Four samples, the same for both passes; where all of the pixel agrees, so do they.
                assert!((2.0 * c).fract() == 0.0 && *a == c / 4.0);
                assert!((*r != 0.0 && *r != 2.0) || c == r);
                if c != r {
                    partial += 1;
                    error += f64::from(c - r);
                }
            }
        }
        // Samples are an unbiased estimate of the area.
        assert!(partial > 1000 && (error / f64::from(partial)).abs() < 0.03, "{error} over {partial}");
    }

    #[test]
    fn shapes_cover_neither_nothing_nor_everything_most_of_the_time() {
        let shares: Vec<f32> = (0..200)
            .map(|seed| {
                let exact = Coverage::draw((64, 64), 4, &mut Rng::new(seed, 1)).exact;
                exact.iter().sum::<f32>() / exact.len() as f32
            })
            .collect();
        let useful = shares.iter().filter(|s| (0.02..0.98).contains(*s)).count();
        assert!(useful > 150, "{useful} of 200");
    }

    #[test]
    fn light_changes_radiance_alone_and_paint_albedo_with_it() {
        let sample = flat(1.0, 0.5);
        let value = |s: &Sample, pass| s.passes.get(pass).unwrap().data[0];
        let lit = relit(&sample, &mut Rng::new(1, 1));
        assert_eq!(value(&lit, Pass::DenoisingAlbedo), 0.5);
        assert!(value(&lit, Pass::Combined) < 1.2 && value(&lit, Pass::Combined) == lit.reference.data[0]);
        let painted = repainted(&sample, &mut Rng::new(1, 1));
        assert_eq!(value(&painted, Pass::DenoisingAlbedo), 0.5 * value(&painted, Pass::Combined));
        assert!(value(&painted, Pass::Combined) < 1.0);
    }

    #[test]
    fn a_crop_with_other_passes_is_left_out() {
        let mut other = flat(2.0, 0.5);
        other.passes.remove(Pass::DenoisingAlbedo);
        let mut sample = flat(0.0, 0.0);
        compose(&mut sample, &other, 4, &mut Rng::new(3, 1));
        assert!(sample.reference.data.iter().all(|v| *v == 0.0));
    }
}
