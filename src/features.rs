//! From passes to network inputs: the sole authority on channel order, on transfer functions (each
//! beside its inverse) and on how a frame is padded to what a network can halve.
//!
//! Whoever changes what a network reads changes
//! [`Architecture::inputs`](crate::models::network::Architecture::inputs) with it, so that weights trained on
//! something else are refused.

mod black;
mod fireflies;
mod kpcn;
mod lbf;
mod shading;
mod stand_in;

pub use black::keep_black;
pub use fireflies::{FIREFLY, tame_alike, tame_fireflies};
pub use kpcn::{
    DIFFUSE_FLOOR, KPCN_CHANNELS, KPCN_COMBINED_OPTIONAL, KPCN_COMBINED_PASSES, KPCN_PASSES, KPCN_UNFILTERED,
    kpcn_combined, kpcn_streams,
};
pub use lbf::{LBF_CHANNELS, LBF_GROUPS, LBF_PASSES, lbf};
pub use shading::Shading;
pub use stand_in::{stand_in, with_stand_ins};

use std::ops::Range;

use rayon::prelude::*;

use crate::{
    Result,
    kernels::{
        logarithm::{LogTransfer, ln},
        vectorised::{self, CHUNK, Vectorised},
    },
    metrics::display::LUMINANCE,
    passes::{Pass, PassSet},
    planes::Planes,
};

/// The exponent of the paper's Eq. 4.
pub const GAMMA: f32 = 2.2;

/// The paper's transfer of radiance, Eq. 4: `c^(1/2.2)`. Negative radiance, which only filters make,
/// counts as black.
pub fn compress(radiance: f32) -> f32 {
    radiance.max(0.0).powf(GAMMA.recip())
}

/// The inverse of [`compress`].
pub fn expand(compressed: f32) -> f32 {
    compressed.max(0.0).powf(GAMMA)
}

/// The passes of the paper's inputs, in channel order: colour, then 12 feature channels.
pub const PAPER_PASSES: [Pass; 7] = [
    Pass::Combined,
    Pass::Normal,
    Pass::Position,
    Pass::DiffuseColor,
    Pass::GlossyColor,
    Pass::TransmissionColor,
    Pass::DenoisingAlbedo,
];

/// Feature channels of [`paper_features`].
pub const PAPER_FEATURES: usize = 12;

/// The paper's colour input: [`compress`]ed radiance, (3, H, W).
///
/// # Errors
/// The Combined pass is missing.
pub fn paper_colour(passes: &PassSet) -> Result<Planes> {
    let mut colour = passes.require(Pass::Combined, "demc")?.clone();
    colour.data.iter_mut().for_each(|v| *v = compress(*v));
    Ok(colour)
}

/// The paper's features (Section 3.1), each channel z-scored over the frame, (12, H, W): shading normal,
/// world position, texture at the first hit, texture at the second hit.
///
/// # Errors
/// A pass is missing.
pub fn paper_features(passes: &PassSet) -> Result<Planes> {
    let get = |pass| passes.require(pass, "demc");
    let mut features = Planes::new(PAPER_FEATURES, passes.width, passes.height);
    let n = 3 * features.pixels();
    let (normal, rest) = features.data.split_at_mut(n);
    let (position, rest) = rest.split_at_mut(n);
    let (first_hit, second_hit) = rest.split_at_mut(n);
    normal.copy_from_slice(&get(Pass::Normal)?.data);
    position.copy_from_slice(&get(Pass::Position)?.data);
    first_hit.copy_from_slice(&first_texture(passes, "demc")?.data);
    second_hit.copy_from_slice(&get(Pass::DenoisingAlbedo)?.data);
    (0..PAPER_FEATURES).for_each(|c| z_score(features.channel_mut(c)));
    Ok(features)
}

/// The passes of [`first_texture`].
const FIRST_TEXTURE: [Pass; 3] = [Pass::DiffuseColor, Pass::GlossyColor, Pass::TransmissionColor];

/// What the first surface reflects and transmits, whatever the lobe, (3, H, W).
///
/// # Errors
/// A pass is missing.
fn first_texture(passes: &PassSet, needed_by: &str) -> Result<Planes> {
    let mut sum = Planes::new(3, passes.width, passes.height);
    for pass in FIRST_TEXTURE {
        let colour = passes.require(pass, needed_by)?;
        sum.data.iter_mut().zip(&colour.data).for_each(|(a, b)| *a += b);
    }
    Ok(sum)
}

/// Smallest standard deviation that counts: a flatter channel carries nothing and becomes zero.
const MIN_DEVIATION: f64 = 1e-6;

/// Shifts to mean 0 and scales to deviation 1, in place.
fn z_score(channel: &mut [f32]) {
    let n = channel.len().max(1) as f64;
    let mean = channel.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
    let variance = channel.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>() / n;
    let deviation = variance.sqrt();
    let scale = if deviation > MIN_DEVIATION * mean.abs().max(1.0) { deviation.recip() } else { 0.0 };
    channel.iter_mut().for_each(|v| *v = ((f64::from(*v) - mean) * scale) as f32);
}

/// The passes of the built-in models' inputs: what Blender's "Denoising Data" switch stores.
pub const GUIDE_PASSES: [Pass; 3] = [Pass::Combined, Pass::DenoisingNormal, Pass::DenoisingAlbedo];

/// The guides among them that a prefilter denoises.
pub const PREFILTERED_PASSES: [Pass; 2] = [Pass::DenoisingAlbedo, Pass::DenoisingNormal];

/// Added to albedo before radiance is divided by it: below this, texture is left in the radiance.
const ALBEDO_FLOOR: f32 = 0.05;

/// Steepness of the built-in models' [`LogTransfer`]: exposed radiance below 1/16 is encoded nearly linearly,
/// white as 1. No inverse is needed, because the predicted kernels act on radiance itself.
const STEEPNESS: f32 = 16.0;

/// What needs the passes of a built-in model, in error messages.
pub const NEEDED_BY: &str = "this model";

/// Log-average luminance of radiance after exposure: photography's middle grey.
const MIDDLE_GREY: f64 = 0.18;

/// Luminance is averaged over squares of this many rows and columns before the logarithm is taken: the
/// logarithm of single noisy pixels would bias the exposure.
const EXPOSURE_SQUARE: usize = 16;

/// The passes of a built-in model for some rows of a frame, padded to `size` (width, height) as
/// [`Planes::padded_to`] does, without [fireflies](tame_fireflies). `exposure` is that of the whole frame; a
/// pixel darker than middle grey after exposure is never a firefly.
///
/// # Errors
/// The Combined pass is missing.
pub fn guide_rows(
    passes: &PassSet,
    rows: Range<usize>,
    size: (usize, usize),
    exposure: f32,
) -> Result<PassSet> {
    let radiance = passes.require(Pass::Combined, NEEDED_BY)?;
    let tamed = tame_fireflies(radiance, rows.clone(), size, MIDDLE_GREY as f32 / exposure);
    let mut part = passes.padded_rows(&PREFILTERED_PASSES, rows, size);
    part.insert(Pass::Combined, tamed);
    Ok(part)
}

/// What is computed from a frame's passes before a network with a prefilter reads it.
#[derive(Clone, Debug)]
pub struct Refined {
    /// The denoised albedo, (3, H, W).
    pub albedo: Planes,
    /// The denoised normal, (3, H, W): the refit reads it, the network does not.
    pub normal: Planes,
    /// See [`LightInputs::shading`].
    pub shading: Planes,
}

impl Refined {
    /// Padded to `size` (width, height), as [`Planes::padded_to`] does.
    pub fn padded_to(self, size: (usize, usize)) -> Self {
        let Self { albedo, normal, shading } = self;
        let [albedo, normal, shading] = [albedo, normal, shading].map(|planes| planes.padded_to(size));
        Self { albedo, normal, shading }
    }
}

/// What a built-in network reads of a frame, as [`light_inputs`] makes it, each of the frame's size. `T` is
/// an image, or the images of several frames.
#[derive(Clone, Debug)]
pub struct LightInputs<T = Planes> {
    /// Exposed radiance over the divisor, (3, H, W): what the network filters.
    pub light: T,
    /// The denoised albedo, clamped to 0..1, plus a floor of 0.05, (3, H, W).
    pub divisor: T,
    /// Input of the radiance encoder: the log-encoded light, (3, H, W).
    pub encoded: T,
    /// Input of the guide encoder, (7, H, W): the denoised albedo (3), the camera-space normal as rendered
    /// (3), whose noise is correlated with that of the radiance, and the mean of `ratio` over the colours
    /// (1).
    pub guide: T,
    /// Logarithm of the divisor over the divisor that the noisy albedo would give, (3, H, W).
    pub ratio: T,
    /// How the normal changes the light, a logarithm, (1, H, W). See [`Shading`].
    pub shading: T,
    /// The denoised normal, for the refit, (3, H, W).
    pub normal: T,
}

impl<T> LightInputs<T> {
    /// The inputs in the order in which [`Inputs`] and batches hold them.
    pub fn into_list(self) -> [T; 7] {
        let Self { light, divisor, encoded, guide, ratio, shading, normal } = self;
        [light, divisor, encoded, guide, ratio, shading, normal]
    }

    /// The inverse of [`LightInputs::into_list`].
    pub fn from_list([light, divisor, encoded, guide, ratio, shading, normal]: [T; 7]) -> Self {
        Self { light, divisor, encoded, guide, ratio, shading, normal }
    }
}

/// The built-in networks' inputs. `exposure` is that of the whole frame; `passes` may be some rows of it.
/// What the network makes of them is to be multiplied by the inverse of the exposure.
///
/// # Errors
/// A pass is missing.
pub fn light_inputs(passes: &PassSet, refined: Refined, exposure: f32) -> Result<LightInputs> {
    let radiance = passes.require(Pass::Combined, NEEDED_BY)?;
    let noisy = passes.require(Pass::DenoisingAlbedo, NEEDED_BY)?;
    let noisy_normal = passes.require(Pass::DenoisingNormal, NEEDED_BY)?;
    let Refined { albedo: clean, normal, shading } = refined;
    let unwritten = |channels: usize| Planes::unwritten(channels, passes.width, passes.height);
    let mut guide = unwritten(7);
    let (colours, rest) = guide.data.split_at_mut(noisy.data.len());
    let (directions, mean) = rest.split_at_mut(noisy.data.len());
    let [mut divisor, mut light, mut encoded] = [(); 3].map(|()| unwritten(3));
    let read = clean.data.par_chunks(CHUNK).zip(radiance.data.par_chunks(CHUNK));
    let written = colours.par_chunks_mut(CHUNK).zip(divisor.data.par_chunks_mut(CHUNK));
    let lit = light.data.par_chunks_mut(CHUNK).zip(encoded.data.par_chunks_mut(CHUNK));
    read.zip(written).zip(lit).for_each(|(((clean, radiance), (colours, albedo)), (irradiance, encoded))| {
        vectorised::run(Divide { clean, radiance, exposure, colours, albedo, irradiance, encoded });
    });
    map(&noisy_normal.data, directions, unit);
    let mut ratio = clean;
    let divisors = divisor.data.par_chunks(CHUNK).zip(noisy.data.par_chunks(CHUNK));
    ratio.data.par_chunks_mut(CHUNK).zip(divisors).for_each(|(ratio, (clean, noisy))| {
        vectorised::run(Compare { clean, noisy, ratio });
    });
    let colours = ratio.channel(0).par_iter().zip(ratio.channel(1)).zip(ratio.channel(2));
    mean.par_iter_mut().zip(colours).for_each(|(mean, ((r, g), b))| *mean = (r + g + b) / 3.0);
    Ok(LightInputs { light, divisor, encoded, guide, ratio, shading, normal })
}

/// Divides radiance by albedo, for a run of values.
struct Divide<'a> {
    clean: &'a [f32],
    radiance: &'a [f32],
    exposure: f32,
    /// Written: the albedo as a guide (clamped to 0..1), and the divisor (with the floor added).
    colours: &'a mut [f32],
    albedo: &'a mut [f32],
    /// Written: exposed radiance over the divisor, and its log encoding.
    irradiance: &'a mut [f32],
    encoded: &'a mut [f32],
}

impl Vectorised for Divide<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { clean, radiance, exposure, colours, albedo, irradiance, encoded } = self;
        let transfer = LogTransfer::new(STEEPNESS);
        for ((colour, albedo), clean) in colours.iter_mut().zip(&mut *albedo).zip(clean) {
            *colour = texture(*clean);
            *albedo = *colour + ALBEDO_FLOOR;
        }
        let read = radiance.iter().zip(albedo);
        for ((light, encoded), (v, albedo)) in irradiance.iter_mut().zip(encoded).zip(read) {
            *light = v.max(0.0) * exposure / *albedo;
            *encoded = transfer.of(*light);
        }
    }
}

/// The logarithm of the divisor over the divisor that the noisy albedo would give, for a run of values.
struct Compare<'a> {
    clean: &'a [f32],
    noisy: &'a [f32],
    ratio: &'a mut [f32],
}

impl Vectorised for Compare<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { clean, noisy, ratio } = self;
        for (ratio, (clean, noisy)) in ratio.iter_mut().zip(clean.iter().zip(noisy)) {
            *ratio = ln(clean / divisor(*noisy));
        }
    }
}

/// Writes `of(value)` for each value.
fn map(values: &[f32], output: &mut [f32], of: impl Fn(f32) -> f32 + Sync) {
    output.par_iter_mut().zip(values).for_each(|(output, value)| *output = of(*value));
}

/// A component of a normal, clamped to -1..1.
#[inline(always)]
fn unit(axis: f32) -> f32 {
    axis.clamp(-1.0, 1.0)
}

/// An albedo clamped to 0..1: Cycles writes the radiance of emitters into this pass, and values above white
/// hold no texture.
#[inline(always)]
fn texture(albedo: f32) -> f32 {
    albedo.clamp(0.0, 1.0)
}

/// What radiance is divided by: the clamped albedo plus the floor.
#[inline(always)]
fn divisor(albedo: f32) -> f32 {
    texture(albedo) + ALBEDO_FLOOR
}

/// Normals are scaled by this among a prefilter's targets. With a relative loss, an error of a normal then
/// counts about as much as the same error of an albedo of a few tenths, and less where the component is
/// large.
const NORMAL_SCALE: f32 = 0.1;

/// What a prefilter reads of a frame, as [`guide_inputs`] makes it, each (3, H, W). `T` is an image, or the
/// images of several frames.
#[derive(Clone, Debug)]
pub struct GuideInputs<T = Planes> {
    /// The exposed divisor that the noisy albedo gives.
    pub albedo: T,
    /// The normal, scaled as in [`guide_targets`], and exposed.
    pub normal: T,
    /// Input of the radiance encoder: the log encoding of `albedo`.
    pub encoded: T,
    /// Input of the guide encoder: the normal.
    pub guide: T,
}

impl<T> GuideInputs<T> {
    /// The inputs in the order in which [`Inputs`] and batches hold them.
    pub fn into_list(self) -> [T; 4] {
        let Self { albedo, normal, encoded, guide } = self;
        [albedo, normal, encoded, guide]
    }

    /// The inverse of [`GuideInputs::into_list`].
    pub fn from_list([albedo, normal, encoded, guide]: [T; 4]) -> Self {
        Self { albedo, normal, encoded, guide }
    }
}

/// A prefilter's inputs. Its output is to be multiplied by the inverse of the exposure.
///
/// # Errors
/// A pass is missing.
pub fn guide_inputs(passes: &PassSet, exposure: f32) -> Result<GuideInputs> {
    let noisy = passes.require(Pass::DenoisingAlbedo, NEEDED_BY)?;
    let rendered = passes.require(Pass::DenoisingNormal, NEEDED_BY)?;
    let unwritten = || Planes::unwritten(3, passes.width, passes.height);
    let [mut albedo, mut normal, mut encoded, mut guide] = [(); 4].map(|()| unwritten());
    map(&noisy.data, &mut albedo.data, |a| divisor(a) * exposure);
    map(&rendered.data, &mut normal.data, |axis| unit(axis) * (NORMAL_SCALE * exposure));
    map(&rendered.data, &mut guide.data, unit);
    let rows = encoded.data.par_chunks_mut(CHUNK).zip(albedo.data.par_chunks(CHUNK));
    rows.for_each(|(encoded, light)| vectorised::run(Encode { light, encoded }));
    Ok(GuideInputs { albedo, normal, encoded, guide })
}

/// Log-encodes light, for a run of values.
struct Encode<'a> {
    light: &'a [f32],
    encoded: &'a mut [f32],
}

impl Vectorised for Encode<'_> {
    #[inline(always)]
    fn run(self) {
        let transfer = LogTransfer::new(STEEPNESS);
        self.encoded.iter_mut().zip(self.light).for_each(|(encoded, light)| *encoded = transfer.of(*light));
    }
}

/// A prefilter's training target, from a reference whose guides have little noise, (6, H, W): the divisor
/// that its albedo gives (3), and its normal times 0.1 (3).
///
/// # Errors
/// A pass is missing.
pub fn guide_targets(passes: &PassSet) -> Result<Planes> {
    let albedo = passes.require(Pass::DenoisingAlbedo, NEEDED_BY)?;
    let normal = passes.require(Pass::DenoisingNormal, NEEDED_BY)?;
    let mut targets = Planes::unwritten(6, passes.width, passes.height);
    let (light, direction) = targets.data.split_at_mut(albedo.data.len());
    map(&albedo.data, light, divisor);
    map(&normal.data, direction, |axis| unit(axis) * NORMAL_SCALE);
    Ok(targets)
}

/// The normal of a prefilter's output: undoes the scaling of [`guide_targets`].
pub fn normal_of_target(mut normal: Planes) -> Planes {
    normal.data.par_iter_mut().for_each(|v| *v = unit(*v / NORMAL_SCALE));
    normal
}

/// The albedo of a prefilter's output: undoes [`guide_targets`].
pub fn albedo_of_target(mut albedo: Planes) -> Planes {
    albedo.data.par_iter_mut().for_each(|v| *v = texture(*v - ALBEDO_FLOOR));
    albedo
}

/// The exposure of a frame: the factor that brings its log-average luminance (Rec. 709, averaged over 16x16
/// squares first) to middle grey; 1 for a black frame. Radiance twice as bright gives half the factor.
pub fn exposure(radiance: &Planes) -> f32 {
    log_average_exposure(radiance, |v| v.max(0.0))
}

/// The [`exposure`] of an albedo as the divisor that [`guide_targets`] makes of it.
pub fn albedo_exposure(albedo: &Planes) -> f32 {
    log_average_exposure(albedo, divisor)
}

/// The largest exposure. In the light of denormal numbers the one that is wanted would be infinite.
const MOST_EXPOSURE: f64 = 1e37;

/// The [`exposure`] of planes whose values are `of(value)`.
fn log_average_exposure(planes: &Planes, of: impl Fn(f32) -> f32 + Sync) -> f32 {
    let (w, h) = (planes.width, planes.height);
    // For each row of squares: the sum of the logarithms, and how many there are.
    let row = |y0: usize| {
        let rows = y0..(y0 + EXPOSURE_SQUARE).min(h);
        let mut columns = vec![0.0; w];
        vectorised::run(Luminance { planes, rows: rows.clone(), of: &of, columns: &mut columns });
        let (mut sum, mut count) = (0.0, 0usize);
        for square in columns.chunks(EXPOSURE_SQUARE) {
            let luminance: f64 = square.iter().sum();
            // The logarithm of a black square is infinite; such squares are left out.
            if luminance > 0.0 {
                sum += (luminance / (rows.len() * square.len()) as f64).ln();
                count += 1;
            }
        }
        (sum, count)
    };
    // Added in a fixed order, so that the number of threads does not change the result.
    let rows: Vec<(f64, usize)> =
        (0..h.div_ceil(EXPOSURE_SQUARE)).into_par_iter().map(|y| row(y * EXPOSURE_SQUARE)).collect();
    let (sum, count) = rows.into_iter().fold((0.0, 0), |(s, n), (sum, count)| (s + sum, n + count));
    if count == 0 { 1.0 } else { (MIDDLE_GREY / (sum / count as f64).exp()).min(MOST_EXPOSURE) as f32 }
}

/// Sums the luminance of `of(value)` over some rows, for each column.
struct Luminance<'a, F> {
    planes: &'a Planes,
    rows: Range<usize>,
    of: &'a F,
    columns: &'a mut [f64],
}

impl<F: Fn(f32) -> f32> Vectorised for Luminance<'_, F> {
    #[inline(always)]
    fn run(self) {
        let Self { planes, rows, of, columns } = self;
        for (c, weight) in LUMINANCE.into_iter().enumerate() {
            for y in rows.clone() {
                for (sum, v) in columns.iter_mut().zip(planes.row(c, y)) {
                    *sum += weight * f64::from(of(*v));
                }
            }
        }
    }
}

/// Distance as a feature `d / (d + median)` in 0..1: one half at the median distance, 0 where the ray hits
/// nothing.
pub fn relative_depth(distance: &Planes) -> Planes {
    /// Cycles writes 1e10 where a ray hits nothing.
    const FAR: f32 = 1e9;
    let valid = |v: f32| v > 0.0 && v < FAR;
    let mut sorted: Vec<f32> = distance.data.iter().copied().filter(|v| valid(*v)).collect();
    sorted.sort_unstable_by(f32::total_cmp);
    let median = sorted.get(sorted.len() / 2).copied().unwrap_or(1.0);
    let mut out = distance.clone();
    out.data.iter_mut().for_each(|v| *v = if valid(*v) { *v / (*v + median) } else { 0.0 });
    out
}

/// A frame's inputs for a network.
#[derive(Clone, Debug)]
pub struct Inputs {
    /// The network's inputs, all of the frame's size.
    pub planes: Vec<Planes>,
    /// Factor that the network's output is multiplied by to get scene radiance.
    pub scale: f32,
}

impl Inputs {
    /// Grows every input to a multiple of `multiple` in both directions, as [`Planes::padded_to`] does: what
    /// a network that halves its input `log2(multiple)` times needs.
    pub fn padded(mut self, multiple: usize) -> Self {
        let grow = |planes: Planes| {
            let size = [planes.width, planes.height].map(|size| size.next_multiple_of(multiple));
            planes.padded_to(size.into())
        };
        self.planes = self.planes.into_iter().map(grow).collect();
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn expand_inverts_compress() {
        for v in [0.0, 1e-4, 0.18, 1.0, 50.0, 6e4] {
            assert!((expand(compress(v)) - v).abs() <= 1e-5 * v);
        }
        assert_eq!(compress(-1.0), 0.0);
    }

    #[test]
    fn z_score_centres_scales_and_flattens_constants() {
        let mut channel = [1.0, 2.0, 3.0, 4.0];
        z_score(&mut channel);
        let deviation = 1.25f32.sqrt();
        let want = [-1.5, -0.5, 0.5, 1.5].map(|v: f32| v / deviation);
        assert!(channel.iter().zip(want).all(|(c, w)| (c - w).abs() < 1e-6), "{channel:?} for {want:?}");
        let mut flat = [7.0; 9];
        z_score(&mut flat);
        assert_eq!(flat, [0.0; 9]);
    }

    #[test]
    fn depth_ends_at_one_and_misses_are_zero() {
        let out = relative_depth(&Planes::from_vec(1, 5, 1, vec![0.0, 1.0, 2.0, 8.0, 1e10]));
        assert_eq!(out.data, [0.0, 1.0 / 3.0, 0.5, 0.8, 0.0]);
    }
}
