//! Writes what `eval/training/neighbours.py` learns from: how far renders of neighbouring frames may be
//! averaged with a frame's own, and then the results.
//!
//! ```text
//! cargo run --release --example neighbour_features -- demc-m SEQUENCES.csv OUT
//! ```
//!
//! For each pair of the manifest, a frame of a sequence, it writes a safetensors file of 32-bit floats.
//! Images are (3, H, W): `truth` is the reference, `render` the frame as rendered, and `result` what the
//! model makes of it and its neighbours' renders. `render_there_n` and `result_there_n` are those of the
//! n-th neighbour, where the frame's content lies in it, and `render_features_n` and `result_features_n`,
//! (H, features, W), are what was compared. `inside_n`, (1, H, W), is 0 where the neighbour does not show
//! the content, and 1 elsewhere.

use std::path::Path;

use demc::{
    Error, Result, denoise,
    denoise::Candidates,
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
        let candidates = model.candidates(&shot)?;
        let reference = passes::load(&pair.reference, None)?;
        let truth = reference.require(Pass::Combined, "training")?;
        write(&folder.join(format!("{}.safetensors", pair.id())), &candidates, truth)?;
    }
    Ok(())
}

fn write(path: &Path, candidates: &Candidates, truth: &Planes) -> Result<()> {
    let (width, height) = (truth.width, truth.height);
    let mut named = vec![
        ("truth".to_string(), truth),
        ("render".into(), &candidates.render),
        ("result".into(), &candidates.result),
    ];
    for (n, of) in candidates.neighbours.iter().enumerate() {
        let [render, result] = [&of.render, &of.result];
        named.push((format!("inside_{n}"), &of.inside));
        for (name, [there, features]) in [("render", render), ("result", result)] {
            named.push((format!("{name}_there_{n}"), there));
            named.push((format!("{name}_features_{n}"), features));
        }
    }
    let bytes: Vec<(String, Vec<usize>, Vec<u8>)> = named
        .into_iter()
        .map(|(name, planes)| {
            // Features are lines of a row, (H, FEATURES, W), all others planes.
            let shape = if planes.width == width {
                vec![planes.channels, height, width]
            } else {
                vec![height, planes.width / width, width]
            };
            (name, shape, planes.data.iter().flat_map(|v| v.to_le_bytes()).collect())
        })
        .collect();
    let tensors = bytes.iter().map(|(name, shape, bytes)| {
        (name, TensorView::new(Dtype::F32, shape.clone(), bytes).expect("as many bytes as values"))
    });
    let file = safetensors::serialize(tensors, &None).map_err(|why| Error::invalid(path, why))?;
    std::fs::write(path, file).map_err(Error::io("write", path))
}
