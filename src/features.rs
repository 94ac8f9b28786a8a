//! From passes to network inputs: the sole authority on channel order, on transfer functions (each
//! beside its inverse) and on how a frame is padded to what a network can halve.

use crate::{
    Result,
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
pub fn paper_colour(passes: &PassSet, needed_by: &str) -> Result<Planes> {
    let mut colour = passes.require(Pass::Combined, needed_by)?.clone();
    colour.data.iter_mut().for_each(|v| *v = compress(*v));
    Ok(colour)
}

/// The paper's features (Section 3.1), each channel z-scored over the frame, (12, H, W): shading normal,
/// world position, texture at the first hit, texture at the second hit.
///
/// # Errors
/// A pass is missing.
pub fn paper_features(passes: &PassSet, needed_by: &str) -> Result<Planes> {
    let get = |pass| passes.require(pass, needed_by);
    let mut features = Planes::new(PAPER_FEATURES, passes.width, passes.height);
    let n = 3 * features.pixels();
    let (normal, rest) = features.data.split_at_mut(n);
    let (position, rest) = rest.split_at_mut(n);
    let (first_hit, second_hit) = rest.split_at_mut(n);
    normal.copy_from_slice(&get(Pass::Normal)?.data);
    position.copy_from_slice(&get(Pass::Position)?.data);
    // What the first surface reflects and transmits, whatever the lobe.
    for pass in [Pass::DiffuseColor, Pass::GlossyColor, Pass::TransmissionColor] {
        first_hit.iter_mut().zip(&get(pass)?.data).for_each(|(a, b)| *a += b);
    }
    second_hit.copy_from_slice(&get(Pass::DenoisingAlbedo)?.data);
    (0..PAPER_FEATURES).for_each(|c| z_score(features.channel_mut(c)));
    Ok(features)
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

/// Grows planes to a multiple of `multiple` in both directions by repeating the last row and column:
/// what a network that halves its input `log2(multiple)` times needs.
pub fn pad_to_multiple(planes: &Planes, multiple: usize) -> Planes {
    let (width, height) = (planes.width.next_multiple_of(multiple), planes.height.next_multiple_of(multiple));
    if (width, height) == (planes.width, planes.height) {
        return planes.clone();
    }
    let mut out = Planes::new(planes.channels, width, height);
    for c in 0..planes.channels {
        let from = planes.channel(c);
        for (y, row) in out.channel_mut(c).chunks_mut(width).enumerate() {
            let source = &from[y.min(planes.height - 1) * planes.width..][..planes.width];
            row[..planes.width].copy_from_slice(source);
            row[planes.width..].fill(source[planes.width - 1]);
        }
    }
    out
}

/// The top-left `width` x `height` pixels: undoes [`pad_to_multiple`].
pub fn crop(planes: &Planes, width: usize, height: usize) -> Planes {
    let mut out = Planes::new(planes.channels, width, height);
    for c in 0..planes.channels {
        let from = planes.channel(c);
        for (y, row) in out.channel_mut(c).chunks_mut(width).enumerate() {
            row.copy_from_slice(&from[y * planes.width..][..width]);
        }
    }
    out
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
        assert_eq!(channel, [-1.5, -0.5, 0.5, 1.5].map(|v: f32| v / deviation));
        let mut flat = [7.0; 9];
        z_score(&mut flat);
        assert_eq!(flat, [0.0; 9]);
    }

    #[test]
    fn padding_repeats_the_edge_and_crop_undoes_it() {
        let planes = Planes::from_vec(2, 3, 1, vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        let padded = pad_to_multiple(&planes, 4);
        assert_eq!((padded.width, padded.height), (4, 4));
        assert_eq!(padded.channel(1), [4.0, 5.0, 6.0, 6.0].repeat(4));
        assert_eq!(crop(&padded, 3, 1), planes);
    }
}
