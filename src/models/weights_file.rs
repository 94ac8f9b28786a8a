//! Networks on disk: parameters with the configuration and the training facts in the metadata.

use std::{collections::BTreeMap, path::Path};

use serde::{Deserialize, Serialize};

use super::{
    network::{Architecture, Config, Network},
    pyramid::PREFILTER,
};
use crate::{
    Error, Result,
    nn::{
        Arithmetic, Precision,
        weights::{self, Tensor},
    },
    rng::Rng,
};

/// How a network was trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Facts {
    /// Pairs trained on.
    pub frames: usize,
    /// Optimiser steps.
    pub steps: usize,
    /// Crops a step.
    pub batch: usize,
    /// Rows and columns of a crop.
    pub patch: usize,
    /// Largest and last learning rate.
    pub lr: (f64, f64),
    /// What was minimised.
    pub loss: String,
    /// Whether squared errors were against references as they were before they were denoised.
    #[serde(default)]
    pub raw_references: bool,
    /// Share of the crops that lacked guides.
    #[serde(default)]
    pub guide_dropout: f64,
    /// Share of the crops that were in coloured light.
    #[serde(default)]
    pub tint: f64,
    /// Share of the gradient that passed ReLUs where they gave nothing.
    #[serde(default)]
    pub leak: f64,
    /// How gradients became updates; files from before there was a choice do not say.
    #[serde(default = "adam")]
    pub optimizer: String,
    /// Share of the hidden convolutions' weights that a step took away at a learning rate of 1.
    #[serde(default)]
    pub weight_decay: f64,
    /// What convolutions rounded their factors to; older files do not say.
    #[serde(default)]
    pub precision: Option<Precision>,
    /// Weight of the past in the average of the weights, which is what is kept; older files do not say.
    #[serde(default)]
    pub average: Option<f64>,
    /// The seed of weights, crops and augmentation.
    pub seed: u64,
    /// The weights file it began with, if any.
    #[serde(default)]
    pub init: Option<String>,
    /// The weights file whose prefilter it got, if not the built-in one or that of `init`.
    #[serde(default)]
    pub prefilter: Option<String>,
    /// If not all parameters were trained, the names of those that were, with `*` for any part of a name;
    /// else empty.
    #[serde(default)]
    pub only: Vec<String>,
    /// Seconds of training.
    pub seconds: f64,
    /// Pairs validated on.
    pub validation_frames: usize,
    /// Geometric mean RelMSE on them.
    pub validation_relmse: Option<f64>,
    /// Mean SSIM on them.
    pub validation_ssim: Option<f64>,
}

fn adam() -> String {
    "adam".into()
}

/// The metadata of a weights file.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Metadata {
    /// The network.
    pub network: Config,
    /// What it was trained to read, see [`Architecture::inputs`]. Files that do not say were trained on
    /// version 1.
    #[serde(default)]
    pub inputs: Option<String>,
    /// How it was trained.
    pub training: Facts,
    /// The largest value that each layer's ReLU left on the frames it was validated on, which arithmetic in 8
    /// bits needs.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub ranges: BTreeMap<String, f32>,
}

/// Writes a network's parameters, in half precision, and ranges.
///
/// # Errors
/// The file cannot be written.
pub fn write(path: &Path, network: &mut dyn Network, facts: &Facts) -> Result<()> {
    let ranges = network.convolutions().into_iter().filter_map(|c| Some((c.name().to_string(), c.range?)));
    let ranges = ranges.collect();
    let config = network.config();
    let inputs = Some(config.architecture.inputs().into());
    let metadata = Metadata { network: config, inputs, training: facts.clone(), ranges };
    let metadata = serde_json::to_string(&metadata).expect("metadata serialises");
    let tensors: Vec<Tensor> = network
        .params()
        .into_iter()
        .map(|p| Tensor { name: p.name.clone(), shape: p.shape.clone(), values: p.values() })
        .collect();
    weights::write(path, &metadata, &tensors, weights::Storage::Half)
}

/// Reads a network from a weights file.
///
/// # Errors
/// The file is unreadable, or not the weights of a network that this version knows.
pub fn read(path: &Path) -> Result<(Box<dyn Network>, Metadata)> {
    parse(&weights::bytes(path)?, path)
}

/// Reads the network `config` from a weights file that holds it, or a narrower one of the same design. In the
/// latter case the wider network begins as the same function; `seed` draws how weights are divided (see
/// `Conv::widen_from`).
///
/// # Errors
/// As [`read`], or the file holds another network.
pub fn read_as(path: &Path, config: &Config, seed: u64) -> Result<Box<dyn Network>> {
    let bytes = weights::bytes(path)?;
    let (metadata, tensors) = metadata(&bytes, path)?;
    let held = &metadata.network;
    let mut network = super::build(config, seed);
    // A file of the same widths may be of another version, with smaller kernels.
    let mut misfit = None;
    if held == config {
        match fill(&mut *network, &tensors, path) {
            Ok(()) => return Ok(network),
            Err(e) => misfit = Some(e),
        }
    }
    // Only convolutions can be widened: a network's every parameter must belong to one.
    let all = 2 * network.convolutions().len() == network.params().len();
    let fits = held.architecture == config.architecture && all && {
        let (mut narrow, rng) = (super::build(held, 0), &mut Rng::new(seed, 1));
        let find = |name: &str| tensors.iter().find(|t| t.name == name);
        network.convolutions().into_iter().zip(narrow.convolutions()).all(|(wide, narrow)| {
            let (weight, bias) = (find(&wide.weight.name), find(&wide.bias.name));
            weight.zip(bias).is_some_and(|(weight, bias)| {
                let held = Arithmetic { outputs: bias.values.len(), ..narrow.arithmetic().clone() };
                wide.widen_from(&held, &weight.values, &bias.values, rng)
            })
        })
    };
    if fits {
        return Ok(network);
    }
    Err(misfit.unwrap_or_else(|| {
        let why = match all || held.architecture != config.architecture {
            true => format!("which is neither {config} nor narrower"),
            false => format!("and is not {config}, for a network with batch norms is not widened"),
        };
        Error::invalid(path, format!("holds {held}, {why}; choose --model and --widths alike"))
    }))
}

/// The widths of the prefilter that a weights file can give: its network's prefilter, or its network if that
/// is a prefilter itself.
///
/// # Errors
/// As [`read`], or it is no network that can prefilter.
pub fn prefilter_widths(path: &Path) -> Result<Vec<usize>> {
    let Config { architecture, widths, prefilter } = config(path)?;
    match architecture {
        Architecture::Prefilter => Ok(widths),
        Architecture::Pyramid => Ok(prefilter),
        _ => Err(Error::invalid(
            path,
            "cannot prefilter; take weights of `demc train --model prefilter`, or of a network that has one",
        )),
    }
}

/// Gives a network the prefilter that the bytes of a weights file hold; `path` is for messages.
///
/// # Errors
/// As [`read`], or it is not what [`prefilter_widths`] says.
pub fn set_prefilter(network: &mut dyn Network, bytes: &[u8], path: &Path) -> Result<()> {
    let (_, tensors) = metadata(bytes, path)?;
    // In a file of a prefilter alone, names have no prefix.
    let within = tensors.iter().any(|t| t.name.starts_with(PREFILTER));
    for param in network.params() {
        let Some(name) = param.name.strip_prefix(PREFILTER) else { continue };
        let name = if within { &param.name } else { name };
        match tensors.iter().find(|t| t.name == *name && t.shape == param.shape) {
            Some(tensor) => param.set(&tensor.values),
            None => return Err(Error::invalid(path, format!("holds no {name} of shape {:?}", param.shape))),
        }
    }
    Ok(())
}

/// The configuration of the network in a weights file.
///
/// # Errors
/// As [`read`].
pub fn config(path: &Path) -> Result<Config> {
    parse_config(&weights::bytes(path)?, path)
}

/// The configuration of the network that the bytes of a weights file hold; `path` is for messages.
///
/// # Errors
/// As [`read`].
pub fn parse_config(bytes: &[u8], path: &Path) -> Result<Config> {
    Ok(metadata(bytes, path)?.0.network)
}

/// The metadata and the tensors of a weights file.
fn metadata(bytes: &[u8], path: &Path) -> Result<(Metadata, Vec<Tensor>)> {
    let (metadata, tensors) = weights::parse(bytes, path)?;
    let metadata: Metadata = serde_json::from_str(&metadata).map_err(|e| {
        Error::invalid(path, format!("no network in its metadata ({e}); use a run's best.safetensors"))
    })?;
    super::check(&metadata.network).map_err(|reason| Error::invalid(path, reason))?;
    check_inputs(metadata.inputs.as_deref(), metadata.network.architecture.inputs())
        .map_err(|reason| Error::invalid(path, reason))?;
    // Checked before a network is built, which takes memory.
    let held: usize = tensors.iter().map(|tensor| tensor.values.len()).sum();
    if held < super::least_parameters(&metadata.network) {
        let why = format!("holds {held} values, too few for {}; the file is damaged", metadata.network);
        return Err(Error::invalid(path, why));
    }
    if let Some(tensor) = tensors.iter().find(|tensor| !tensor.values.iter().all(|v| v.is_finite())) {
        let why = "holds NaN or infinity: training went wrong; take the weights of an earlier step";
        return Err(Error::invalid(path, format!("tensor {} {why}", tensor.name)));
    }
    Ok((metadata, tensors))
}

/// Checks whether a network that was trained on the inputs `held` can read those that are made `now`; the
/// error says why not. Files that do not say count as version 1 of their kind.
fn check_inputs(held: Option<&str>, now: &str) -> Result<(), String> {
    let (kind, _) = now.rsplit_once('/').expect("inputs end in a number");
    let first = format!("{kind}/1");
    let held = held.unwrap_or(&first);
    if held == now {
        return Ok(());
    }
    Err(format!(
        "was trained on inputs {held}, but this version of demc makes {now}; run the version that wrote it, or train it anew"
    ))
}

/// The least range that can be divided into steps of 8 bits; those of trained networks are some 2 to 650.
const LEAST_RANGE: f32 = 1e-6;

/// Parses the bytes of a weights file; `path` is for messages.
///
/// # Errors
/// As [`read`].
pub fn parse(bytes: &[u8], path: &Path) -> Result<(Box<dyn Network>, Metadata)> {
    let (metadata, tensors) = metadata(bytes, path)?;
    let mut network = super::build(&metadata.network, 0);
    fill(&mut *network, &tensors, path)?;
    for conv in network.convolutions() {
        // Without a range, a layer that gave nothing while it was validated is computed in f32.
        let is_range = |range: &f32| range.is_finite() && *range >= LEAST_RANGE;
        conv.range = metadata.ranges.get(conv.name()).copied().filter(is_range);
    }
    Ok((network, metadata))
}

/// Sets every parameter from the tensor of its name.
fn fill(network: &mut dyn Network, tensors: &[Tensor], path: &Path) -> Result<()> {
    for param in network.params() {
        let found = tensors.binary_search_by(|t| t.name.cmp(&param.name)).ok().map(|i| &tensors[i]);
        match found {
            Some(tensor) if tensor.shape == param.shape => param.set(&tensor.values),
            Some(tensor) => {
                return Err(Error::invalid(
                    path,
                    format!(
                        "tensor {} has shape {:?}, expected {:?}; the file is damaged or of another version",
                        param.name, tensor.shape, param.shape
                    ),
                ));
            }
            None => {
                let reason = format!("tensor {} is missing; the file is damaged or incomplete", param.name);
                return Err(Error::invalid(path, reason));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Writes fresh weights of the smallest prefilter, changed by `change`, into `folder`.
    fn changed(
        folder: &Path,
        change: impl FnOnce(&mut serde_json::Value, &mut Vec<Tensor>),
    ) -> (Config, std::path::PathBuf) {
        let config = Config::new(Architecture::Prefilter, &[1; 4]);
        let facts = serde_json::json!({
            "frames": 1, "steps": 1, "batch": 1, "patch": 16, "lr": [1.0, 1.0], "loss": "smape", "seed": 1,
            "seconds": 0.0, "validation_frames": 0, "validation_relmse": null, "validation_ssim": null,
        });
        let facts: Facts = serde_json::from_value(facts).expect("what the first files said");
        let path = folder.join("weights.safetensors");
        write(&path, &mut *super::super::build(&config, 1), &facts).unwrap();
        let (metadata, mut tensors) = weights::read(&path).unwrap();
        let mut metadata = serde_json::from_str(&metadata).unwrap();
        change(&mut metadata, &mut tensors);
        weights::write(&path, &metadata.to_string(), &tensors, weights::Storage::Half).unwrap();
        (config, path)
    }

    #[test]
    fn weights_trained_on_other_inputs_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let (_, path) = changed(folder.path(), |metadata, _| {
            assert_eq!(metadata["inputs"], "guides/logarithm/1");
            metadata["inputs"] = "guides/logarithm/0".into();
        });
        let error = read(&path).err().unwrap().to_string();
        let named = ["weights.safetensors", "guides/logarithm/0", "guides/logarithm/1", "train it anew"];
        assert!(named.iter().all(|part| error.contains(part)), "{error}");
        // Files from before inputs were recorded can still be read.
        let (_, path) = changed(folder.path(), |metadata, _| {
            metadata.as_object_mut().unwrap().remove("inputs");
        });
        assert_eq!(read(&path).unwrap().1.inputs, None);
        assert!(check_inputs(None, "guides/logarithm/2").is_err(), "of the first kind, which is past");
    }

    #[test]
    fn ranges_that_cannot_be_divided_are_none() {
        let folder = tempfile::tempdir().unwrap();
        for (range, is_kept) in [(2.5, true), (0.0, false), (-1.0, false), (1e-30, false)] {
            let (_, path) = changed(folder.path(), |metadata, tensors| {
                let name = tensors.iter().find_map(|tensor| tensor.name.strip_suffix(".weight")).unwrap();
                metadata["ranges"] = serde_json::json!({ name: range });
            });
            let kept = read(&path).unwrap().0.convolutions().into_iter().any(|conv| conv.range.is_some());
            assert_eq!(kept, is_kept, "{range}");
        }
    }

    #[test]
    fn weights_that_claim_much_or_are_no_numbers_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let refused = |change: &dyn Fn(&mut serde_json::Value, &mut Vec<Tensor>)| {
            let (_, path) = changed(folder.path(), change);
            read(&path).err().unwrap().to_string()
        };
        let error = refused(&|metadata, _| {
            metadata["network"]["widths"] = serde_json::json!([4096, 4096, 4096, 4096])
        });
        assert!(error.contains("too few for Prefilter of widths 4096"), "{error}");
        for value in [f32::NAN, f32::INFINITY] {
            let error = refused(&|_, tensors| tensors[3].values[0] = value);
            assert!(error.contains("holds NaN or infinity"), "{error}");
        }
    }

    #[test]
    fn what_is_damaged_is_told_where_nothing_was_to_be_widened() {
        let folder = tempfile::tempdir().unwrap();
        let (config, path) = changed(folder.path(), |_, tensors| {
            tensors.retain(|tensor| tensor.name != "decoder.0.up.bias");
        });
        let error = read_as(&path, &config, 1).err().unwrap().to_string();
        assert!(error.contains("decoder.0.up.bias is missing"), "{error}");
    }
}
