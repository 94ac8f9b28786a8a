//! Fitting weights: pairs of noisy and reference frames in, a run folder out.
//!
//! A run folder holds `config.json`, `log.csv`, `loss.png`, `checkpoint.safetensors` and
//! `best.safetensors`. Every random choice follows from the seed and the step's number, so a run that
//! was stopped at any moment and resumed ends with the same bits as one that was not.

mod checkpoint;
mod dataset;
mod log;
mod loss;
mod optimizer;
mod options;
mod run;

pub use checkpoint::{CHECKPOINT, check_size};
pub use dataset::{Dataset, Sample, Shares};
pub use log::LogRow;
pub use loss::Loss;
pub use optimizer::{Optimizer, Rule};
pub use options::{Refusal, TrainOptions, train_only};
pub use run::{TrainEvent, run};
