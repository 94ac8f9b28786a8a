//! Inputs of KPCN (Bako et al. 2017): the radiance that each stream filters, and the 34 channels its
//! network reads. Cycles writes no variance of samples: it is estimated from neighbouring pixels.

use rayon::prelude::*;

use super::{ALBEDO_FLOOR, FIRST_TEXTURE, Inputs, exposure, first_texture, relative_depth};
use crate::{
    Result,
    filters::variance::directional,
    passes::{Pass, PassSet},
    planes::Planes,
};

/// The guides of both streams: what Blender's "Denoising Data" switch stores.
const GUIDES: [Pass; 3] = [Pass::DenoisingNormal, Pass::DenoisingAlbedo, Pass::DenoisingDepth];

/// The passes of [`kpcn_combined`] that a file must hold.
pub const KPCN_COMBINED_PASSES: [Pass; 4] = [Pass::Combined, GUIDES[0], GUIDES[1], GUIDES[2]];

/// Those that it reads where they are.
pub const KPCN_COMBINED_OPTIONAL: [Pass; 3] = FIRST_TEXTURE;

/// The passes of [`kpcn_streams`].
pub const KPCN_PASSES: [Pass; 7] = [
    Pass::Combined,
    Pass::DiffuseDirect,
    Pass::DiffuseIndirect,
    Pass::DiffuseColor,
    GUIDES[0],
    GUIDES[1],
    GUIDES[2],
];

/// Light that no surface reflects. Its only Monte Carlo noise is that of the pixel filter, so it is added
/// back unfiltered.
pub const KPCN_UNFILTERED: [Pass; 2] = [Pass::Emission, Pass::Environment];

/// Channels that a stream's network reads: colour, normal and albedo of three channels, each with one
/// variance and six differences, and depth of one channel, with one variance and two differences.
pub const KPCN_CHANNELS: usize = 34;

/// Added to albedo before diffuse light is divided by it, and before it is multiplied back.
pub const DIFFUSE_FLOOR: f32 = 0.00316;

/// The single stream over Combined, in this order: radiance, exposed and divided by albedo (3, H, W);
/// that albedo (3, H, W); the network's input (34, H, W).
///
/// The albedo is the texture of the first surface, where the file holds that, and Denoising Albedo where no
/// surface is or the file has none: Cycles carries Denoising Albedo on through glass, by one random path a
/// sample, and light that is divided and multiplied by noise stays noisy. An albedo of zero says that diffuse
/// light is zero, but not that Combined is: the floor of the built-in models replaces [`DIFFUSE_FLOOR`] here.
///
/// # Errors
/// A pass is missing.
pub fn kpcn_combined(passes: &PassSet) -> Result<Inputs> {
    let radiance = passes.require(Pass::Combined, "kpcn")?;
    let guides = SharedInputs::new(passes)?;
    let exposure = exposure(radiance);
    let mut albedo = guides.albedo.clone();
    if KPCN_COMBINED_OPTIONAL.iter().all(|pass| passes.get(*pass).is_some()) {
        let (texture, n) = (first_texture(passes, "kpcn")?, albedo.pixels());
        for i in (0..n).filter(|i| (0..3).any(|c| texture.data[c * n + i] > 0.0)) {
            (0..3).for_each(|c| albedo.data[c * n + i] = texture.data[c * n + i].clamp(0.0, 1.0));
        }
    }
    albedo.data.iter_mut().for_each(|a| *a += ALBEDO_FLOOR);
    let mut irradiance = radiance.clone();
    irradiance.data.iter_mut().zip(&albedo.data).for_each(|(v, a)| *v = v.max(0.0) * exposure / a);
    let input = guides.input(&logarithm(&irradiance));
    Ok(Inputs { planes: vec![irradiance, albedo, input], scale: exposure.recip() })
}

/// The two streams, in this order: diffuse light, exposed and divided by the diffuse
/// colour (3, H, W); that colour (3, H, W); `log(1 + specular light)` (3, H, W); light that is not
/// filtered (3, H, W); the diffuse and the specular network's input (34, H, W each).
///
/// What is neither diffuse nor in [`KPCN_UNFILTERED`] is specular, so the parts add up to Combined.
///
/// # Errors
/// A pass is missing.
pub fn kpcn_streams(passes: &PassSet) -> Result<Inputs> {
    let get = |pass| passes.require(pass, "kpcn");
    let radiance = get(Pass::Combined)?;
    let guides = SharedInputs::new(passes)?;
    let exposure = exposure(radiance);
    let mut colour = get(Pass::DiffuseColor)?.clone();
    colour.data.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    // Cycles stores light before it is multiplied by the colour.
    let mut diffuse = get(Pass::DiffuseDirect)?.clone();
    diffuse
        .data
        .iter_mut()
        .zip(&get(Pass::DiffuseIndirect)?.data)
        .zip(&colour.data)
        .for_each(|((light, indirect), colour)| *light = (*light + indirect).max(0.0) * colour * exposure);
    let mut unfiltered = Planes::new(3, passes.width, passes.height);
    for pass in KPCN_UNFILTERED {
        if let Some(light) = passes.get(pass) {
            unfiltered.data.iter_mut().zip(&light.data).for_each(|(v, light)| *v += light * exposure);
        }
    }
    let mut specular = radiance.clone();
    let others = diffuse.data.iter().zip(&unfiltered.data);
    specular.data.iter_mut().zip(others).for_each(|(v, (diffuse, unfiltered))| {
        *v = (*v * exposure - diffuse - unfiltered).max(0.0);
    });
    let specular = logarithm(&specular);
    colour.data.iter_mut().for_each(|v| *v += DIFFUSE_FLOOR);
    diffuse.data.iter_mut().zip(&colour.data).for_each(|(v, colour)| *v /= colour);
    let inputs = [guides.input(&logarithm(&diffuse)), guides.input(&specular)];
    let [of_diffuse, of_specular] = inputs;
    let planes = vec![diffuse, colour, specular, unfiltered, of_diffuse, of_specular];
    Ok(Inputs { planes, scale: exposure.recip() })
}

/// `log(1 + v)`, the transfer of specular light.
fn logarithm(planes: &Planes) -> Planes {
    let mut out = planes.clone();
    out.data.par_iter_mut().for_each(|v| *v = v.ln_1p());
    out
}

/// The inputs that both streams share, besides their colour.
struct SharedInputs {
    albedo: Planes,
    /// Normal, albedo and depth with variances and differences, (24, H, W).
    channels: Vec<f32>,
}

impl SharedInputs {
    fn new(passes: &PassSet) -> Result<Self> {
        let [normal, albedo, depth] = GUIDES;
        let clamped = |pass, least| -> Result<Planes> {
            let mut planes = passes.require(pass, "kpcn")?.clone();
            planes.data.iter_mut().for_each(|v| *v = v.clamp(least, 1.0));
            Ok(planes)
        };
        let normal = clamped(normal, -1.0)?;
        // Emitters write their radiance into albedo.
        let albedo = clamped(albedo, 0.0)?;
        let depth = relative_depth(passes.require(depth, "kpcn")?);
        let mut channels = Vec::new();
        for guide in [&normal, &albedo, &depth] {
            describe(guide, &mut channels);
        }
        Ok(Self { albedo, channels })
    }

    /// The 34 channels for a stream of this colour.
    fn input(&self, colour: &Planes) -> Planes {
        let mut data = Vec::with_capacity(KPCN_CHANNELS * colour.pixels());
        describe(colour, &mut data);
        data.extend_from_slice(&self.channels);
        Planes::from_vec(KPCN_CHANNELS, colour.width, colour.height, data)
    }
}

/// Appends the planes, the mean over channels of their variance, and each channel's differences to the
/// next column and to the next row.
fn describe(planes: &Planes, out: &mut Vec<f32>) {
    let (n, w) = (planes.pixels(), planes.width);
    out.extend_from_slice(&planes.data);
    let variance = directional(planes);
    let mean = |i| (0..planes.channels).map(|c| variance.data[c * n + i]).sum::<f32>();
    out.extend((0..n).map(|i| mean(i) / planes.channels as f32));
    for c in 0..planes.channels {
        let v = planes.channel(c);
        out.extend((0..n).map(|i| if (i + 1) % w == 0 { 0.0 } else { v[i + 1] - v[i] }));
        out.extend((0..n).map(|i| if i + w >= n { 0.0 } else { v[i + w] - v[i] }));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A frame of ramps; light passes as Cycles writes them.
    fn ramps() -> PassSet {
        let mut set = PassSet::new("ramps.exr", "ViewLayer", 7, 5);
        for (i, pass) in KPCN_PASSES.into_iter().chain(KPCN_UNFILTERED).enumerate() {
            let n = pass.channels() * 35;
            let values = (0..n).map(|p| 0.05 * (1 + i) as f32 + 0.001 * p as f32).collect();
            set.insert(pass, Planes::from_vec(pass.channels(), 7, 5, values));
        }
        let combined = Planes::from_vec(3, 7, 5, (0..105).map(|p| 2.0 + 0.01 * p as f32).collect());
        set.insert(Pass::Combined, combined);
        set
    }

    #[test]
    fn the_streams_add_up_to_combined() {
        let set = ramps();
        for unfiltered in [true, false] {
            let mut set = set.clone();
            if !unfiltered {
                KPCN_UNFILTERED.into_iter().for_each(|pass| drop(set.remove(pass)));
            }
            let Inputs { planes, scale } = kpcn_streams(&set).unwrap();
            let [diffuse, colour, specular, rest, ..] = &planes[..] else { panic!("six planes") };
            let combined = &set.get(Pass::Combined).unwrap().data;
            for (i, want) in combined.iter().enumerate() {
                let sum = diffuse.data[i] * colour.data[i] + specular.data[i].exp_m1() + rest.data[i];
                assert!((sum * scale - want).abs() < 1e-4 * want, "{i}: {} for {want}", sum * scale);
            }
            assert_eq!(rest.data.iter().any(|v| *v > 0.0), unfiltered);
        }
    }

    #[test]
    fn the_single_stream_divides_by_the_first_texture_where_there_is_one() {
        let mut set = ramps();
        let albedo = |set: &PassSet| kpcn_combined(set).unwrap().planes[1].data.clone();
        let denoising: Vec<f32> =
            set.get(Pass::DenoisingAlbedo).unwrap().data.iter().map(|a| a + 0.05).collect();
        // One of the three is there by itself, which is not enough.
        assert_eq!(albedo(&set), denoising);
        for (pass, value) in FIRST_TEXTURE.into_iter().zip([0.25, 0.125, 0.5]) {
            let mut colour = Planes::from_vec(3, 7, 5, vec![value; 105]);
            // The first pixel shows the sky.
            (0..3).for_each(|c| colour.data[c * 35] = 0.0);
            set.insert(pass, colour);
        }
        let with = albedo(&set);
        assert_eq!((with[0], with[1], with[104]), (denoising[0], 0.925, 0.925));
    }

    #[test]
    fn the_single_stream_times_albedo_is_combined() {
        let set = ramps();
        let Inputs { planes, scale } = kpcn_combined(&set).unwrap();
        for (i, want) in set.get(Pass::Combined).unwrap().data.iter().enumerate() {
            let got = planes[0].data[i] * planes[1].data[i] * scale;
            assert!((got - want).abs() < 1e-5 * want);
        }
        assert_eq!(planes[2].channels, KPCN_CHANNELS);
    }

    #[test]
    fn differences_end_at_the_border_and_a_ramp_has_no_variance() {
        let ramp = Planes::from_vec(1, 3, 2, vec![0.0, 1.0, 2.0, 10.0, 11.0, 12.0]);
        let mut out = Vec::new();
        describe(&ramp, &mut out);
        assert_eq!(out[12..18], [1.0, 1.0, 0.0, 1.0, 1.0, 0.0]);
        assert_eq!(out[18..], [10.0, 10.0, 10.0, 0.0, 0.0, 0.0]);
        let plane = Planes::from_vec(1, 7, 7, (0..49).map(|i| (i % 7 + i / 7) as f32).collect());
        out.clear();
        describe(&plane, &mut out);
        assert_eq!(out[49 + 24], 0.0);
    }
}
