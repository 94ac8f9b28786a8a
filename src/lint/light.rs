//! The light of a render as one number a pixel, and where it shows plain surfaces.

use crate::{
    frame::HALF_MAX,
    passes::{Pass, PassSet},
    planes::Planes,
};

/// Where neighbouring pixels of the guides differ by less than this, they show one plain surface.
const FLAT: f32 = 0.05;

/// The sum of a render's channels, finite and not negative.
pub fn sums(render: &Planes) -> Vec<f32> {
    let clean = |v: f32| if v.is_nan() { 0.0 } else { v.clamp(0.0, HALF_MAX) };
    let channel = |c: usize| render.channel(c);
    let pixels = channel(0).iter().zip(channel(1)).zip(channel(2));
    pixels.map(|((r, g), b)| clean(*r) + clean(*g) + clean(*b)).collect()
}

/// The logarithm of each sum plus `floor` times the median of the sums that are not black, as black has no logarithm.
pub fn logarithms(sums: &[f32], floor: f32) -> Vec<f32> {
    let mut positive: Vec<f32> = sums.iter().copied().filter(|v| *v > 0.0).collect();
    let floor = (floor * median(&mut positive).unwrap_or(1.0)).max(f32::MIN_POSITIVE);
    sums.iter().map(|v| (v + floor).ln()).collect()
}

/// The middle value, or the upper of the two middle values; none for no values.
pub fn median(values: &mut [f32]) -> Option<f32> {
    quantile(values, 0.5)
}

/// The value below which that share of the values lies; none for no values.
pub fn quantile(values: &mut [f32], share: f32) -> Option<f32> {
    let at = ((values.len() as f32 * share) as usize).min(values.len().checked_sub(1)?);
    Some(*values.select_nth_unstable_by(at, f32::total_cmp).1)
}

/// Which pixels show a plain surface that is lit: the guides have no edge or texture within a pixel, the
/// normal is not zero, so that something was hit, and the albedo does not equal the light, as that of lamps
/// does in Cycles. None without a normal.
pub fn lit_surfaces(set: &PassSet, render: &Planes) -> Option<Vec<bool>> {
    let normal = set.get(Pass::DenoisingNormal).or_else(|| set.get(Pass::Normal))?;
    let albedo = set.get(Pass::DenoisingAlbedo);
    let (w, h) = (set.width, set.height);
    let guides: Vec<&Planes> = [Some(normal), albedo].into_iter().flatten().collect();
    let is_lit_surface = |at: usize| {
        let hit = (0..3).map(|c| normal.channel(c)[at].powi(2)).sum::<f32>() > 0.25;
        let is_flat = guides.iter().all(|guide| {
            (0..3).all(|c| {
                let plane = guide.channel(c);
                let differs = |other: usize| (plane[other] - plane[at]).abs() >= FLAT;
                ![at - w, at - 1, at + 1, at + w].into_iter().any(differs)
            })
        });
        let most = |planes: &Planes| (0..3).map(|c| planes.channel(c)[at]).fold(0.0f32, f32::max);
        let shines = albedo.is_some_and(|albedo| {
            let (shown, light) = (most(albedo), most(render));
            shown > 0.0 && (0.95 * shown..=1.05 * shown).contains(&light)
        });
        hit && is_flat && !shines
    };
    let inside = |at: usize| (1..w - 1).contains(&(at % w)) && (1..h - 1).contains(&(at / w));
    Some((0..w * h).map(|at| inside(at) && is_lit_surface(at)).collect())
}
