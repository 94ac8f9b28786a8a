//! Writes what `eval/training/restraint.py` learns from: how much of the render a denoised frame should keep.
//!
//! ```text
//! cargo run --release --example restraint_features -- demc-m PAIRS.csv OUT
//! ```
//!
//! Each pair gives a safetensors file of 32-bit floats. Where its reference has an albedo, cleaned by
//! `eval/training/clean_references.py`, so does the pair with only a part of its noise. A file holds
//! `features`, (36, H/4, W/4); `render`, `denoised`, `result` (`denoised` after shrinkage with the shipped
//! weights), `truth` and `clean` (the reference as rendered, and as it was denoised, if it was), (3, H, W)
//! each; `shares` of the render in the result, (1, H, W); and `facts`: exposure, samples, and the share of
//! the noise.

use std::path::Path;

use demc::{
    Error, Result, features,
    filters::{
        nl_means::{self, Weights},
        shrinkage::{self, Render},
    },
    models::catalogue,
    passes::{self, Pass, PassSet},
    planes::Planes,
    shot, testset,
};
use safetensors::{Dtype, tensor::TensorView};

/// In which states each frame is seen: the share of its noise that is left, and by how many pixels to each
/// side the denoised image is blurred. Without noise, a result must go back to its input. The blur stands for
/// worse denoisers.
const SEEN: [(f32, usize); 8] =
    [(1.0, 0), (0.6, 0), (0.3, 0), (0.1, 0), (0.0, 0), (0.3, 2), (0.1, 4), (0.0, 2)];

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [model, pairs, out] = &arguments[..] else {
        return Err(Error::Usage("restraint_features MODEL PAIRS OUT".into()));
    };
    let Some(method) = catalogue::find(model) else {
        return Err(Error::Usage(format!("no model '{model}'")));
    };
    let model = method.learned()?.with_precision(model, None)?;
    let folder = Path::new(out);
    std::fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
    for (at, pair) in testset::read(pairs)?.pairs.iter().enumerate() {
        let noisy = shot::prepare(&pair.noisy, None)?.passes;
        let reference = passes::load(&pair.reference, None)?;
        let denoised = model.unrestrained(&noisy)?;
        for (step, (share, radius)) in SEEN.into_iter().enumerate() {
            let Some((frame, truth)) = with_noise(&noisy, &reference, share) else { continue };
            let uniform = Weights::uniform(noisy.width, noisy.height, radius);
            let denoised = nl_means::filter(&denoised, &uniform);
            let path = folder.join(format!("{at:05}_{}_{step}.safetensors", pair.id()));
            let clean = reference.require(Pass::Combined, "training")?;
            write(&path, &frame, &denoised, (&truth, clean), (pair.spp, share))?;
        }
    }
    Ok(())
}

/// The frame with a share of its noise, and the truth for it. With all of its noise, the truth is the
/// reference as rendered, which need not be clean but must be unbiased. With less, it is the cleaned
/// reference, against which the noise is measured.
fn with_noise(noisy: &PassSet, reference: &PassSet, share: f32) -> Option<(PassSet, Planes)> {
    let clean = reference.get(Pass::Combined)?;
    if share == 1.0 {
        return Some((noisy.clone(), reference.get(Pass::NoisyImage).unwrap_or(clean).clone()));
    }
    let mut frame = noisy.clone();
    for pass in [Pass::Combined, Pass::DenoisingAlbedo] {
        let (noisy, clean) = (noisy.get(pass)?, reference.get(pass)?);
        let values = noisy.data.iter().zip(&clean.data).map(|(n, c)| c + share * (n - c)).collect();
        frame.insert(pass, Planes::from_vec(3, noisy.width, noisy.height, values));
    }
    Some((frame, clean.clone()))
}

fn write(
    path: &Path,
    frame: &PassSet,
    denoised: &Planes,
    (truth, clean): (&Planes, &Planes),
    (spp, share): (u32, f32),
) -> Result<()> {
    let radiance = frame.require(Pass::Combined, "training")?;
    let albedo = frame.require(Pass::DenoisingAlbedo, "training")?;
    let exposure = features::exposure(radiance);
    let render = Render { radiance, albedo, exposure, samples: Some(spp) };
    let features = shrinkage::features(denoised, &render);
    let (mut result, mut shares) = (denoised.clone(), Planes::new(1, denoised.width, denoised.height));
    shrinkage::shrink(&mut result, &render, Some(&mut shares));
    let facts = Planes::from_vec(3, 1, 1, vec![exposure, spp as f32, share]);
    let planes = [
        ("features", &features),
        ("render", radiance),
        ("denoised", denoised),
        ("result", &result),
        ("shares", &shares),
        ("truth", truth),
        ("clean", clean),
        ("facts", &facts),
    ];
    let bytes = planes.map(|(name, planes)| {
        let bytes: Vec<u8> = planes.data.iter().flat_map(|v| v.to_le_bytes()).collect();
        (name, vec![planes.channels, planes.height, planes.width], bytes)
    });
    let tensors = bytes.iter().map(|(name, shape, bytes)| {
        (*name, TensorView::new(Dtype::F32, shape.clone(), bytes).expect("as many bytes as values"))
    });
    let file = safetensors::serialize(tensors, &None).map_err(|why| Error::invalid(path, why))?;
    std::fs::write(path, file).map_err(Error::io("write", path))
}
