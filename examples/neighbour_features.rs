//! Writes what `eval/training/neighbours.py` learns from: how far results of neighbouring frames may be
//! averaged with a frame's own.
//!
//! ```text
//! cargo run --release --example neighbour_features -- demc-m SEQUENCES.csv OUT
//! ```
//!
//! For each pair of the manifest, a frame of a sequence, a safetensors file of 32-bit floats: `image` (3, H, W),
//! what the model makes of the frame and its neighbours' renders; for the n-th neighbour `there_n` (3, H, W),
//! its image where the frame's content lies in it, and `features_n` (H, FEATURES, W); and `truth` (3, H, W), the
//! reference.

use std::path::Path;

use demc::{
    Error, Result, denoise,
    filters::temporal::likeness::FEATURES,
    models::catalogue,
    passes::{self, Pass},
    planes::Planes,
    shot, testset,
};
use safetensors::{Dtype, tensor::TensorView};

/// How many frames on each side are read: as many as `--temporal` takes by itself.
const REACH: usize = 2;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [model, pairs, out] = &arguments[..] else {
        return Err(Error::Usage("neighbour_features MODEL SEQUENCES OUT".into()));
    };
    let Some(method) = catalogue::find(model) else {
        return Err(Error::Usage(format!("no model '{model}'")));
    };
    let model = denoise::Temporal::new(Box::new(method.learned()?.with_precision(model, None)?), REACH);
    let folder = Path::new(out);
    std::fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
    for pair in testset::read(pairs)?.pairs {
        let mut shot = shot::prepare(&pair.noisy, None)?;
        for (offset, path) in denoise::neighbours(&pair.noisy, REACH) {
            shot.neighbours.insert(offset, shot::prepare(&path, None)?.passes);
        }
        let (image, candidates) = model.candidates(&shot)?;
        let reference = passes::load(&pair.reference, None)?;
        let truth = reference.require(Pass::Combined, "training")?;
        write(&folder.join(format!("{}.safetensors", pair.id())), &image, &candidates, truth)?;
    }
    Ok(())
}

fn write(path: &Path, image: &Planes, candidates: &[[Planes; 2]], truth: &Planes) -> Result<()> {
    let (width, height) = (image.width, image.height);
    let shape = vec![3, height, width];
    let mut planes =
        vec![("image".to_string(), shape.clone(), image), ("truth".into(), shape.clone(), truth)];
    for (n, [there, features]) in candidates.iter().enumerate() {
        planes.push((format!("there_{n}"), shape.clone(), there));
        planes.push((format!("features_{n}"), vec![height, FEATURES, width], features));
    }
    let bytes: Vec<(String, Vec<usize>, Vec<u8>)> = planes
        .into_iter()
        .map(|(name, shape, planes)| {
            (name, shape, planes.data.iter().flat_map(|v| v.to_le_bytes()).collect())
        })
        .collect();
    let tensors = bytes.iter().map(|(name, shape, bytes)| {
        (name, TensorView::new(Dtype::F32, shape.clone(), bytes).expect("as many bytes as values"))
    });
    let file = safetensors::serialize(tensors, &None).map_err(|why| Error::invalid(path, why))?;
    std::fs::write(path, file).map_err(Error::io("write", path))
}
