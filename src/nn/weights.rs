//! Tensors on disk: safetensors with one JSON text of metadata.
//!
//! A weights file alone is enough to run: the metadata says which network it is and how it was
//! trained. Checkpoints use the same format with f32 values; shipped weights are stored as f16.

use std::{collections::HashMap, path::Path};

use half::{f16, slice::HalfFloatSliceExt};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};

use crate::{Error, Result, frame::write_file};

/// The metadata key that holds demc's JSON.
const KEY: &str = "demc";

/// One named tensor.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Its name.
    pub name: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// Its values, row-major.
    pub values: Vec<f32>,
}

/// How values are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Storage {
    /// 32-bit: nothing is lost.
    Full,
    /// 16-bit: half the size, 3 decimal digits.
    Half,
}

/// Writes tensors and metadata, whole or not at all.
///
/// # Errors
/// The file cannot be written.
pub fn write(path: &Path, metadata: &str, tensors: &[Tensor], storage: Storage) -> Result<()> {
    let dtype = if storage == Storage::Half { Dtype::F16 } else { Dtype::F32 };
    let bytes: Vec<Vec<u8>> = tensors
        .iter()
        .map(|t| match storage {
            Storage::Full => t.values.iter().flat_map(|v| v.to_le_bytes()).collect(),
            Storage::Half => t.values.iter().flat_map(|v| f16::from_f32(*v).to_le_bytes()).collect(),
        })
        .collect();
    let views = tensors.iter().zip(&bytes).map(|(t, bytes)| {
        let view = TensorView::new(dtype, t.shape.clone(), bytes);
        (&t.name, view.expect("a tensor's values fill its shape"))
    });
    let metadata = HashMap::from([(KEY.to_string(), metadata.to_string())]);
    let data = safetensors::serialize(views, &Some(metadata)).map_err(|e| Error::invalid(path, e))?;
    write_file(path, &data)
}

/// No network that could be trained has so many bytes of weights.
const MOST_BYTES: u64 = 4 << 30;

/// The bytes of a weights file.
///
/// # Errors
/// It cannot be read, or is no file of a size that weights may have: a pipe would wait for ever, and a device would
/// be read until memory is gone.
pub fn bytes(path: &Path) -> Result<Vec<u8>> {
    let failed = |error| Error::io("read", path)(error);
    let info = std::fs::metadata(path).map_err(failed)?;
    if !info.is_file() || info.len() > MOST_BYTES {
        let what = if info.is_file() { "is larger than any weights" } else { "is no file on a disk" };
        return Err(Error::invalid(path, format!("{what}; take a file that `demc train` wrote")));
    }
    std::fs::read(path).map_err(failed)
}

/// Reads a weights file.
///
/// # Errors
/// The file cannot be read or is not one of demc's.
pub fn read(path: &Path) -> Result<(String, Vec<Tensor>)> {
    parse(&bytes(path)?, path)
}

/// Parses the bytes of a weights file; `path` is for messages.
///
/// # Errors
/// The bytes are not a weights file of demc's.
pub fn parse(bytes: &[u8], path: &Path) -> Result<(String, Vec<Tensor>)> {
    let foreign = |e: &dyn std::fmt::Display| {
        Error::invalid(path, format!("not a demc weights file ({e}); take one that `demc train` wrote"))
    };
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| foreign(&e))?;
    let metadata = header.metadata().as_ref().and_then(|m| m.get(KEY)).cloned();
    let metadata = metadata.ok_or_else(|| foreign(&"it has no demc metadata"))?;
    let file = SafeTensors::deserialize(bytes).map_err(|e| foreign(&e))?;
    let mut tensors = file
        .tensors()
        .into_iter()
        .map(|(name, view)| {
            let bytes = view.data();
            let values = match view.dtype() {
                Dtype::F32 => {
                    bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
                }
                Dtype::F16 => {
                    let halves = bytes.chunks_exact(2).map(|b| f16::from_le_bytes([b[0], b[1]]));
                    let halves: Vec<f16> = halves.collect();
                    let mut values = vec![0.0; halves.len()];
                    halves.convert_to_f32_slice(&mut values);
                    values
                }
                other => return Err(foreign(&format!("tensor {name} is {other:?}, not F32 or F16"))),
            };
            Ok(Tensor { name, shape: view.shape().into(), values })
        })
        .collect::<Result<Vec<_>>>()?;
    tensors.sort_by(|a, b| a.name.cmp(&b.name));
    Ok((metadata, tensors))
}
