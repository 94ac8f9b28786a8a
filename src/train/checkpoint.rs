//! The state of a run between two steps: parameters, their average, the optimiser's moments, counters.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::Optimizer;
use crate::{
    Error, Result,
    models::{
        self,
        network::{Config, Network},
    },
    nn::weights::{self, Storage, Tensor},
};

/// The file of a run folder that holds the state.
pub const CHECKPOINT: &str = "checkpoint.safetensors";

/// The counters of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Steps done.
    pub step: usize,
    /// Seconds spent in all, before and after resuming.
    pub seconds: f64,
    /// The step of the last row of the log, or 0. A row that was written after the checkpoint is not counted, and
    /// made again. In checkpoints that do not tell, all rows are.
    #[serde(default = "all")]
    pub logged: usize,
    /// Sum and number of training losses since the last line of the log.
    pub losses: (f64, usize),
    /// Steps skipped because their gradient was not finite, since the last line of the log before which some
    /// step was not skipped.
    pub skipped: usize,
    /// The best validation RelMSE so far.
    pub best: Option<f64>,
}

const fn all() -> usize {
    usize::MAX
}

/// Writes the state, whole or not at all.
pub fn save(
    path: &Path,
    progress: &Progress,
    network: &mut dyn Network,
    average: &mut dyn Network,
    optimizer: &mut Optimizer,
) -> Result<()> {
    let mut tensors = Vec::new();
    let mut push = |prefix: &str, name: &str, shape: &[usize], values: Vec<f32>| {
        tensors.push(Tensor { name: format!("{prefix}{name}"), shape: shape.into(), values });
    };
    for param in network.params() {
        push("", &param.name, &param.shape, param.values());
        if param.trainable {
            let [first, second] = optimizer.moments(param);
            push("first.", &param.name, &param.shape, first);
            push("second.", &param.name, &param.shape, second);
        }
    }
    for param in average.params() {
        push("average.", &param.name, &param.shape, param.values());
    }
    let metadata = serde_json::to_string(progress).expect("counters serialise");
    weights::write(path, &metadata, &tensors, Storage::Full)
}

/// Refuses a checkpoint that is too small for a network, before memory is set aside for the network.
///
/// # Errors
/// The checkpoint is too small or cannot be read, or there can be no such network.
pub fn check_size(path: &Path, config: &Config) -> Result<()> {
    models::check(config).map_err(|reason| Error::Usage(format!("network: {reason}")))?;
    let bytes = std::fs::metadata(path).map_err(Error::io("read", path))?.len();
    if bytes / (size_of::<f32>() as u64) < models::least_parameters(config) as u64 {
        let why = format!(
            "is too small to hold {config}; give \"network\" in config.json its widths again, or train anew if the file is \
             damaged"
        );
        return Err(Error::invalid(path, why));
    }
    Ok(())
}

/// Restores what [`save`] wrote.
pub fn load(
    path: &Path,
    network: &mut dyn Network,
    average: &mut dyn Network,
    optimizer: &mut Optimizer,
) -> Result<Progress> {
    let (metadata, tensors) = weights::read(path)?;
    let progress = serde_json::from_str(&metadata)
        .map_err(|e| Error::invalid(path, format!("not a checkpoint ({e}); train again without --resume")))?;
    let find = |name: String, len: usize| {
        let found = tensors.binary_search_by(|t| t.name.cmp(&name)).ok().map(|i| &tensors[i].values[..]);
        found.filter(|v| v.len() == len).ok_or_else(|| {
            Error::invalid(path, format!("tensor {name} is missing or has another shape; train again"))
        })
    };
    for param in network.params() {
        let len = param.values().len();
        param.set(find(param.name.clone(), len)?);
        if param.trainable {
            let first = find(format!("first.{}", param.name), len)?;
            let second = find(format!("second.{}", param.name), len)?;
            optimizer.set_moments(param, [first, second]);
        }
    }
    for param in average.params() {
        let len = param.values().len();
        param.set(find(format!("average.{}", param.name), len)?);
    }
    Ok(progress)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::Rule;

    #[test]
    fn counters_come_back_to_the_bit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.safetensors");
        let config = models::network::Config::new(models::network::Architecture::Lbf, &[4]);
        let mut network = models::build(&config, 1);
        let mut average = network.duplicate();
        let mut optimizer = Optimizer::new(Rule::Adam, 0.0);
        // A sum that a parser of decimal digits misses by a bit if it does not round correctly.
        let saved = Progress { losses: (240.41605154424906, 499), ..Progress::default() };
        save(&path, &saved, &mut *network, &mut *average, &mut optimizer).unwrap();
        let held = load(&path, &mut *network, &mut *average, &mut optimizer).unwrap();
        assert_eq!(held, saved);
    }
}
