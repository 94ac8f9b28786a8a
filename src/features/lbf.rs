//! Inputs of LBF (Kalantari et al. 2015): what its cross-bilateral filter compares, and the secondary
//! features from which its network chooses the filter's parameters.

use rayon::prelude::*;

use super::{Inputs, PAPER_PASSES, exposure, first_texture};
use crate::{
    Result,
    filters::{
        blocks::{median_deviation, moments},
        variance::directional,
    },
    passes::{Pass, PassSet},
    planes::Planes,
};

/// The passes of [`lbf`]: those of the DEMC paper's networks.
pub const LBF_PASSES: [Pass; 7] = PAPER_PASSES;

/// Channels of the filter's feature groups: world position, shading normal, texture at the first hit,
/// texture at the second.
pub const LBF_GROUPS: [usize; 4] = [3; 4];

/// Secondary features of colour and of each group.
const SECONDARY: usize = 7;

/// Channels that the network reads.
pub const LBF_CHANNELS: usize = SECONDARY * (1 + LBF_GROUPS.len());

/// Smallest variance of a feature (whose range is about 1) that a squared distance is divided by.
const FEATURE_NOISE: f32 = 1e-3;

/// Radii of the blocks over which statistics are taken: 3x3 and 7x7 pixels.
const NEAR: usize = 1;
const FAR: usize = 3;

/// World positions are clipped at this many standard deviations from their mean: a sky far away would
/// otherwise leave a room with next to no range.
const MAX_DEVIATIONS: f32 = 3.0;

/// The method's inputs, in this order:
///
/// 0. exposed radiance, (3, H, W);
/// 1. its variance, summed over channels, (1, H, W);
/// 2. the features that the filter compares, (12, H, W);
/// 3. factors of the filter's six precisions, (6, H, W): 1 for pixel position and for colour, the inverse
///    noise variance for each of the four feature groups;
/// 4. the secondary features, (35, H, W).
///
/// # Errors
/// A pass is missing.
pub fn lbf(passes: &PassSet) -> Result<Inputs> {
    let get = |pass| passes.require(pass, "lbf");
    let radiance = get(Pass::Combined)?;
    let exposure = exposure(radiance);
    let mut colour = radiance.clone();
    colour.data.iter_mut().for_each(|v| *v = v.max(0.0) * exposure);
    let mut normal = get(Pass::Normal)?.clone();
    normal.data.iter_mut().for_each(|v| *v = 0.5 * v.clamp(-1.0, 1.0));
    let mut first_hit = first_texture(passes, "lbf")?;
    let mut second_hit = get(Pass::DenoisingAlbedo)?.clone();
    for texture in [&mut first_hit, &mut second_hit] {
        texture.data.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    }
    let groups = [relative_position(get(Pass::Position)?), normal, first_hit, second_hit];

    let n = colour.pixels();
    let planes = |channels, data| Planes::from_vec(channels, passes.width, passes.height, data);
    let of_colour = directional(&colour);
    let noise = (0..n).map(|i| (0..3).map(|c| of_colour.data[c * n + i]).sum()).collect();
    let mut encoded = colour.clone();
    encoded.data.par_iter_mut().for_each(|v| *v = v.ln_1p());
    let mut secondary = Vec::with_capacity(LBF_CHANNELS * n);
    describe(&encoded, &directional(&encoded), &mut secondary);
    let mut scales = vec![1.0; 2 * n];
    for group in &groups {
        let variance = directional(group);
        let sum = |i: usize| (0..group.channels).map(|c| variance.data[c * n + i]).sum::<f32>();
        scales.extend((0..n).map(|i| sum(i).max(FEATURE_NOISE).recip()));
        describe(group, &variance, &mut secondary);
    }
    let features = groups.iter().flat_map(|g| g.data.iter().copied()).collect();
    let planes = vec![
        planes(1, noise),
        planes(LBF_GROUPS.iter().sum(), features),
        planes(2 + LBF_GROUPS.len(), scales),
        planes(LBF_CHANNELS, secondary),
    ];
    Ok(Inputs { planes: [vec![colour], planes].concat(), scale: exposure.recip() })
}

/// World position as a feature: its distance from the frame's mean in standard deviations, one factor for all
/// axes.
fn relative_position(position: &Planes) -> Planes {
    let n = position.pixels().max(1) as f64;
    let mut out = position.clone();
    let mut squares = 0.0;
    for c in 0..position.channels {
        let channel = out.channel_mut(c);
        let mean = channel.iter().map(|v| f64::from(*v)).sum::<f64>() / n;
        channel.iter_mut().for_each(|v| *v = (f64::from(*v) - mean) as f32);
        squares += channel.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>();
    }
    let deviation = (squares / (n * position.channels as f64)).sqrt() as f32;
    let scale = if deviation > f32::MIN_POSITIVE { deviation.recip() } else { 0.0 };
    out.data.iter_mut().for_each(|v| *v = (*v * scale).clamp(-MAX_DEVIATIONS, MAX_DEVIATIONS));
    out
}

/// Appends the secondary features of one primary feature, each the mean over its channels: deviation of
/// the pixel; mean and deviation over 7x7 pixels; length of the gradient; distance from the mean of 3x3
/// and of 7x7 pixels; median absolute deviation over 3x3.
fn describe(feature: &Planes, variance: &Planes, out: &mut Vec<f32>) {
    let (n, w) = (feature.pixels(), feature.width);
    let h = feature.height;
    let (near, far) = (moments(feature, NEAR), moments(feature, FAR));
    let median = median_deviation(feature, NEAR);
    let mut append = |value: &(dyn Fn(usize, usize) -> f32 + Sync)| {
        let mean = |i| (0..feature.channels).map(|c| value(c * n, i)).sum::<f32>() / feature.channels as f32;
        out.par_extend((0..n).into_par_iter().map(mean));
    };
    append(&|c, i| variance.data[c + i].sqrt());
    append(&|c, i| far.0.data[c + i]);
    append(&|c, i| far.1.data[c + i].sqrt());
    append(&|c, i| {
        let (x, y) = (i % w, i / w);
        let at = |x: usize, y: usize| feature.data[c + y * w + x];
        let dx = at((x + 1).min(w - 1), y) - at(x.saturating_sub(1), y);
        let dy = at(x, (y + 1).min(h - 1)) - at(x, y.saturating_sub(1));
        0.5 * (dx * dx + dy * dy).sqrt()
    });
    append(&|c, i| (feature.data[c + i] - near.0.data[c + i]).abs());
    append(&|c, i| (feature.data[c + i] - far.0.data[c + i]).abs());
    append(&|c, i| median.data[c + i]);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(value: f32) -> PassSet {
        let mut set = PassSet::new("flat.exr", "ViewLayer", 9, 8);
        for pass in LBF_PASSES {
            set.insert(pass, Planes::from_vec(3, 9, 8, vec![value; 216]));
        }
        set
    }

    #[test]
    fn a_flat_frame_has_means_and_nothing_else() {
        let inputs = lbf(&flat(0.25)).unwrap();
        let channels: Vec<usize> = inputs.planes.iter().map(|p| p.channels).collect();
        assert_eq!(channels, [3, 1, 12, 6, LBF_CHANNELS]);
        let secondary = &inputs.planes[4];
        for c in 0..LBF_CHANNELS {
            // Colour exposed to middle grey, its logarithm; position at its mean; normal halved; the sum
            // of three colours; the second texture.
            let mean = [0.18f32.ln_1p(), 0.0, 0.125, 0.75, 0.25][c / SECONDARY];
            let want = if c % SECONDARY == 1 { mean } else { 0.0 };
            let close = |v: &f32| (v - want).abs() < 1e-5;
            assert!(secondary.channel(c).iter().all(close), "{c}: {want}, {:?}", &secondary.channel(c)[..3]);
        }
        assert!(inputs.planes[3].data[2 * 72..].iter().all(|v| (v * FEATURE_NOISE - 1.0).abs() < 1e-5));
    }

    #[test]
    fn a_ramp_has_its_slope_and_an_outlier_its_distance() {
        let ramp = Planes::from_vec(1, 9, 8, (0..72).map(|i| (i % 9) as f32 * 0.5).collect());
        let mut out = Vec::new();
        describe(&ramp, &Planes::new(1, 9, 8), &mut out);
        let centre = 4 * 9 + 4;
        assert!((out[3 * 72 + centre] - 0.5).abs() < 1e-6);
        assert!(out[4 * 72 + centre].abs() < 1e-6, "a ramp is its own mean");
        let mut spike = Planes::new(1, 9, 8);
        spike.data[centre] = 9.0;
        out.clear();
        describe(&spike, &Planes::new(1, 9, 8), &mut out);
        assert!((out[4 * 72 + centre] - 8.0).abs() < 1e-5);
        assert_eq!(out[6 * 72 + centre], 0.0, "the median does not see one outlier");
    }
}
