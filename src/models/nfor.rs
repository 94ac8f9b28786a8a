//! NFOR: Bitterli, Rousselle, Moon, Iglesias-Guitian, Adler, Mitchell, Jarosz, Novak 2016, "Nonlinearly
//! Weighted First-order Regression for Denoising Monte Carlo Renderings" (Computer Graphics Forum 35:4).
//!
//! In: Combined, Denoising Albedo, Denoising Normal, and a depth where there is one. Where the shot has half
//! buffers, only they are used, as published. Else noise is estimated from neighbouring pixels, and the
//! method says so in a note.
//!
//! Departures: (1) with half buffers variance comes from their difference, averaged over 7x7 pixels, not
//! from the renderer's sample variance; (2) without them nothing is cross-buffered: variance is the
//! residual of a first-order fit, and Section 5.3's error estimate is Stein's (SURE) instead; (3) a
//! small ridge on slopes replaces a rank-revealing solver; (4) one bandwidth serves all three channels, and
//! the channels of a feature are prefiltered with common weights; (5) depth is mapped to 0..1, radiance is
//! scaled to a mean of 1; (6) there is no visibility feature, because Cycles writes none.

use super::Denoiser;
use crate::{
    Error, Result,
    features::relative_depth,
    filters::{
        nl_means::{Comparison, Weights, filter},
        regression::{Fit, first_order},
        variance,
    },
    passes::{Pass, PassSet},
    planes::Planes,
    shot::Shot,
};

/// Its name.
pub const NAME: &str = "nfor";
/// Section 5.1: windows of 11x11, patches of 7x7.
const FEATURES: Comparison = Comparison { window: 5, patch: 3, k: 0.5, variance_scale: 1.0 };
/// Section 5.2: windows of 19x19, patches of 7x7.
const COLOUR: Comparison = Comparison { window: 9, patch: 3, k: 1.0, variance_scale: 1.0 };
/// Section 5.3: what error estimates and the selection are smoothed with.
const SELECTION: Comparison = Comparison { window: 9, patch: 1, k: 1.0, variance_scale: 1.0 };
/// Section 5.4: a last, narrow filter of the features.
const LAST_FEATURES: Comparison = Comparison { window: 2, patch: 3, k: 0.5, variance_scale: 1.0 };
/// Section 5.3: the bandwidths to select from.
const BANDWIDTHS: [f32; 2] = [0.5, 1.0];
/// The variance of a half buffer, in units of the variance of the whole.
const HALF: f32 = 2.0;

/// The method.
pub struct Nfor;

impl Denoiser for Nfor {
    fn name(&self) -> &str {
        NAME
    }

    fn passes(&self) -> &[Pass] {
        &[Pass::Combined, Pass::DenoisingAlbedo, Pass::DenoisingNormal]
    }

    fn optional_passes(&self) -> &[Pass] {
        &[Pass::DenoisingDepth, Pass::Depth]
    }

    fn reads_halves(&self) -> bool {
        true
    }

    fn notes(&self, shot: &Shot) -> Option<String> {
        shot.halves.is_none().then(|| {
            format!(
                "{NAME}: no half buffers (<scene>_<spp>spp_a.exr and _b.exr) beside the frame: noise is \
                 estimated from neighbouring pixels, and weights are not cross-buffered"
            )
        })
    }

    fn denoise(&self, shot: &Shot) -> Result<Planes> {
        let whole = Buffer::new(&shot.passes)?;
        let Some([a, b]) = &shot.halves else { return Ok(from_one(whole)) };
        let halves = [Buffer::new(a)?, Buffer::new(b)?];
        if halves[0].features.len() != halves[1].features.len() {
            return Err(Error::invalid(&b.path, "has other passes than the other half; render both alike"));
        }
        Ok(from_halves(halves))
    }

    fn is_warm(&self) -> bool {
        true
    }
}

/// What the method sees of a render.
struct Buffer {
    colour: Planes,
    /// Albedo, normal and perhaps depth: each is filtered on its own.
    features: Vec<Planes>,
}

impl Buffer {
    fn new(passes: &PassSet) -> Result<Self> {
        let colour = passes.require(Pass::Combined, NAME)?.clone();
        let mut features = Vec::new();
        for pass in [Pass::DenoisingAlbedo, Pass::DenoisingNormal] {
            features.push(passes.require(pass, NAME)?.clone());
        }
        // Emitters write their radiance into albedo.
        features[0].data.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
        features[1].data.iter_mut().for_each(|v| *v = v.clamp(-1.0, 1.0));
        features.extend(passes.get(Pass::DenoisingDepth).or(passes.get(Pass::Depth)).map(relative_depth));
        Ok(Self { colour, features })
    }
}

/// The method as published.
fn from_halves([mut a, mut b]: [Buffer; 2]) -> Planes {
    let scale = brightness([&a.colour, &b.colour]);
    for half in [&mut a, &mut b] {
        half.colour.data.iter_mut().for_each(|v| *v /= scale);
    }
    // Section 5.1: each half of a feature is filtered by the weights of the other.
    let half = Comparison { variance_scale: HALF, ..FEATURES };
    let (mut features_a, mut features_b) = (Vec::new(), Vec::new());
    for (a, b) in a.features.iter().zip(&b.features) {
        let noise = variance::dual_buffer(a, b);
        features_a.push(filter(a, &Weights::new(b, &noise, half)));
        features_b.push(filter(b, &Weights::new(a, &noise, half)));
    }
    let noise = variance::dual_buffer(&a.colour, &b.colour);
    let (mean_features, feature_noise): (Vec<_>, Vec<_>) =
        features_a.iter().zip(&features_b).map(|(a, b)| (mean(a, b), half_difference(a, b))).unzip();
    let (features_a, features_b) = (join(&features_a), join(&features_b));

    // Section 5.2: weights and features of one half fit the colour of the other.
    let candidates = BANDWIDTHS.map(|k| {
        let comparison = Comparison { k, variance_scale: HALF, ..COLOUR };
        let fit = |colour, features, guide| {
            first_order(colour, features, &Weights::new(guide, &noise, comparison), false).image
        };
        let fitted_a = fit(&a.colour, &features_b, &b.colour);
        let fitted_b = fit(&b.colour, &features_a, &a.colour);
        // Section 5.3: squared error against the other half, less that half's noise and the variance
        // that the mean of both results loses.
        let error = |i: usize| {
            let (fa, fb) = (fitted_a.data[i], fitted_b.data[i]);
            let squares = (b.colour.data[i] - fa).powi(2) + (a.colour.data[i] - fb).powi(2);
            0.5 * squares - HALF * noise.data[i] - 0.25 * (fa - fb).powi(2)
        };
        let error = channel_mean(&a.colour, error);
        (fitted_a, fitted_b, error)
    });
    let [(narrow_a, narrow_b, narrow_error), (wide_a, wide_b, wide_error)] = candidates;
    let guide = mean(&a.colour, &b.colour);
    let wide = selection(&narrow_error, &wide_error, &guide, &noise);
    let (result_a, result_b) = (blend(&narrow_a, &wide_a, &wide), blend(&narrow_b, &wide_b, &wide));

    // Section 5.4: the second pass over the mean of both, with the noise that their difference still shows.
    let features: Vec<Planes> = mean_features
        .iter()
        .zip(&feature_noise)
        .map(|(feature, noise)| filter(feature, &Weights::new(feature, noise, LAST_FEATURES)))
        .collect();
    let (result, noise) = (mean(&result_a, &result_b), half_difference(&result_a, &result_b));
    second_pass(&result, &join(&features), &noise, scale)
}

/// The method where there is one buffer alone: departure (2).
fn from_one(mut buffer: Buffer) -> Planes {
    let scale = brightness([&buffer.colour, &buffer.colour]);
    buffer.colour.data.iter_mut().for_each(|v| *v /= scale);
    let colour = &buffer.colour;
    let features: Vec<Planes> = buffer
        .features
        .iter()
        .map(|feature| filter(feature, &Weights::new(feature, &variance::directional(feature), FEATURES)))
        .collect();
    let features = join(&features);
    let noise = variance::residual(colour, &features);
    let candidates = BANDWIDTHS.map(|k| {
        let weights = Weights::new(colour, &noise, Comparison { k, ..COLOUR });
        let Fit { image, influence } = first_order(colour, &features, &weights, true);
        let influence = influence.expect("it was asked for");
        let n = colour.pixels();
        // Stein's estimate of the squared error, less the variance that all candidates share.
        let error = channel_mean(colour, |i| {
            (image.data[i] - colour.data[i]).powi(2) + 2.0 * noise.data[i] * influence.data[i % n]
        });
        (image, influence, error)
    });
    let [(narrow, narrow_influence, narrow_error), (wide, wide_influence, wide_error)] = candidates;
    let selected = selection(&narrow_error, &wide_error, colour, &noise);
    let result = blend(&narrow, &wide, &selected);
    // A mean of n pixels has 1/n of their variance, and follows its own pixel by as much.
    let influence = blend(&narrow_influence, &wide_influence, &selected);
    let mut left = noise;
    let n = result.pixels();
    left.data.iter_mut().enumerate().for_each(|(i, v)| *v *= influence.data[i % n]);
    second_pass(&result, &features, &left, scale)
}

/// Section 5.4: regression once more, at the wide bandwidth, on the first pass's result.
fn second_pass(result: &Planes, features: &Planes, noise: &Planes, scale: f32) -> Planes {
    let mut out = first_order(result, features, &Weights::new(result, noise, COLOUR), false).image;
    // A linear fit may overshoot into negative light.
    out.data.iter_mut().for_each(|v| *v = (*v * scale).max(0.0));
    out
}

/// Section 5.3: how far each pixel takes the wide bandwidth, 0 to 1, (1, H, W). First the bandwidth with the
/// smaller smoothed error is chosen, then this choice is smoothed itself.
fn selection(narrow_error: &Planes, wide_error: &Planes, guide: &Planes, noise: &Planes) -> Planes {
    let weights = Weights::new(guide, noise, SELECTION);
    // Smoothing is linear: the sign of the smoothed difference says which smoothed error is smaller.
    let mut gain = narrow_error.clone();
    gain.data.iter_mut().zip(&wide_error.data).for_each(|(narrow, wide)| *narrow -= wide);
    let mut wide = filter(&gain, &weights);
    wide.data.iter_mut().for_each(|gain| *gain = f32::from(*gain >= 0.0));
    filter(&wide, &weights)
}

/// `narrow` where `wide_part` (1, H, W) is 0, `wide` where it is 1.
fn blend(narrow: &Planes, wide: &Planes, wide_part: &Planes) -> Planes {
    let mut out = narrow.clone();
    let n = wide_part.pixels();
    for (i, (v, wide)) in out.data.iter_mut().zip(&wide.data).enumerate() {
        *v += (wide - *v) * wide_part.data[i % n];
    }
    out
}

/// The factor that scales radiance to a mean near 1; bright outliers count little.
fn brightness(colours: [&Planes; 2]) -> f32 {
    let count = colours.iter().map(|c| c.data.len()).sum::<usize>().max(1) as f64;
    let roots: f64 = colours.iter().flat_map(|c| &c.data).map(|v| f64::from(v.max(0.0)).sqrt()).sum();
    let mean = (roots / count).powi(2) as f32;
    if mean > f32::MIN_POSITIVE { mean } else { 1.0 }
}

/// The mean over channels of a value of each index, (1, H, W).
fn channel_mean(like: &Planes, value: impl Fn(usize) -> f32) -> Planes {
    let n = like.pixels();
    let mean = |i| (0..like.channels).map(|c| value(c * n + i)).sum::<f32>() / like.channels as f32;
    Planes::from_vec(1, like.width, like.height, (0..n).map(mean).collect())
}

fn mean(a: &Planes, b: &Planes) -> Planes {
    let data = a.data.iter().zip(&b.data).map(|(a, b)| 0.5 * (a + b)).collect();
    Planes::from_vec(a.channels, a.width, a.height, data)
}

/// The variance of the mean of two half results, pixel by pixel.
fn half_difference(a: &Planes, b: &Planes) -> Planes {
    let data = a.data.iter().zip(&b.data).map(|(a, b)| 0.25 * (a - b) * (a - b)).collect();
    Planes::from_vec(a.channels, a.width, a.height, data)
}

/// All channels of several planes of one size.
fn join(parts: &[Planes]) -> Planes {
    let (width, height) = (parts[0].width, parts[0].height);
    let data = parts.iter().flat_map(|p| p.data.iter().copied()).collect();
    Planes::from_vec(parts.iter().map(|p| p.channels).sum(), width, height, data)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filters::variance::tests::noise;

    /// A frame in two halves of different albedo and brightness, without noise.
    fn clean(width: usize, height: usize) -> PassSet {
        let mut set = PassSet::new("x_0004spp.exr", "ViewLayer", width, height);
        let n = width * height;
        let left = |i: usize| i % n % width < width / 2;
        let albedo = (0..3 * n).map(|i| if left(i) { 0.2 } else { 0.8 }).collect();
        let colour = (0..3 * n).map(|i| (1 + i / n) as f32 * if left(i) { 0.5 } else { 2.0 }).collect();
        set.insert(Pass::DenoisingAlbedo, Planes::from_vec(3, width, height, albedo));
        set.insert(Pass::Combined, Planes::from_vec(3, width, height, colour));
        set.insert(Pass::DenoisingNormal, Planes::from_vec(3, width, height, vec![0.5; 3 * n]));
        set
    }

    /// With noise as large as the signal.
    fn noisy(clean: &PassSet, seed: u64) -> PassSet {
        let mut set = clean.clone();
        let mut colour = clean.get(Pass::Combined).unwrap().clone();
        let noise = noise(seed, colour.data.len(), 0.5);
        colour.data.iter_mut().zip(&noise).for_each(|(v, n)| *v *= 1.0 + n);
        set.insert(Pass::Combined, colour);
        set
    }

    fn relative_error(image: &Planes, clean: &PassSet) -> f32 {
        let truth = clean.get(Pass::Combined).unwrap();
        let sum: f32 = image.data.iter().zip(&truth.data).map(|(a, b)| ((a - b) / b).powi(2)).sum();
        sum / truth.data.len() as f32
    }

    #[test]
    fn one_buffer_loses_most_of_its_noise_and_keeps_the_edge() {
        let clean = clean(75, 41);
        let noisy = noisy(&clean, 1);
        let out = Nfor.denoise(&Shot::new(noisy.clone())).unwrap();
        let (before, after) =
            (relative_error(noisy.get(Pass::Combined).unwrap(), &clean), relative_error(&out, &clean));
        assert!((0.2..0.3).contains(&before) && after < 0.02 * before, "{before} {after}");
        let note = Nfor.notes(&Shot::new(noisy)).unwrap();
        assert!(note.contains("not cross-buffered"), "{note}");
    }

    #[test]
    fn half_buffers_replace_the_frame() {
        let clean = clean(40, 30);
        let mut shot = Shot::new(noisy(&clean, 9));
        shot.halves = Some([1, 2].map(|seed| noisy(&clean, seed)));
        assert!(Nfor.notes(&shot).is_none());
        let out = Nfor.denoise(&shot).unwrap();
        let after = relative_error(&out, &clean);
        assert!(after < 0.02 * 0.125, "{after}: less than a fiftieth of the halves' mean");
        // The frame itself does not count.
        shot.passes.insert(Pass::Combined, Planes::new(3, 40, 30));
        assert_eq!(Nfor.denoise(&shot).unwrap(), out);
        // Halves must have the same passes.
        shot.halves.as_mut().unwrap()[1].insert(Pass::Depth, Planes::new(1, 40, 30));
        let message = Nfor.denoise(&shot).unwrap_err().to_string();
        assert!(message.contains("other passes"), "{message}");
    }

    #[test]
    fn channels_and_brightness_do_not_change_the_result() {
        let set = noisy(&clean(33, 20), 4);
        let out = Nfor.denoise(&Shot::new(set.clone())).unwrap();
        let mut other = set.clone();
        let colour = set.get(Pass::Combined).unwrap();
        let order = [1, 2, 0];
        let swapped = order.iter().flat_map(|&c| colour.channel(c)).map(|v| v * 64.0).collect();
        other.insert(Pass::Combined, Planes::from_vec(3, 33, 20, swapped));
        let result = Nfor.denoise(&Shot::new(other)).unwrap();
        for (c, from) in order.into_iter().enumerate() {
            for (a, b) in result.channel(c).iter().zip(out.channel(from)) {
                assert!((a / 64.0 - b).abs() < 1e-3 * (1.0 + b.abs()), "{a} {b}");
            }
        }
    }

    #[test]
    fn every_size_and_any_finite_input_gives_finite_light() {
        for (width, height) in [(1, 1), (2, 1), (1, 7), (19, 3), (65, 33)] {
            let mut set = noisy(&clean(width, height), 3);
            set.insert(Pass::DenoisingDepth, Planes::new(1, width, height));
            let mut colour = set.remove(Pass::Combined).unwrap();
            colour.data[0] = 1e12;
            *colour.data.last_mut().unwrap() = -1e6;
            set.insert(Pass::Combined, colour);
            let out = Nfor.denoise(&Shot::new(set.clone())).unwrap();
            assert!(out.data.iter().all(|v| v.is_finite() && *v >= 0.0), "{width} x {height}");
            set.insert(Pass::Combined, Planes::new(3, width, height));
            assert_eq!(
                Nfor.denoise(&Shot::new(set.clone())).unwrap(),
                Planes::new(3, width, height),
                "black stays black"
            );
        }
    }

    #[test]
    fn a_missing_guide_is_named() {
        let mut set = clean(4, 4);
        set.remove(Pass::DenoisingNormal);
        let message = Nfor.denoise(&Shot::new(set.clone())).unwrap_err().to_string();
        assert!(message.contains("Denoising Normal") && message.contains(NAME), "{message}");
    }
}
