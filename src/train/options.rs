//! What decides a run's result, and whether it makes sense.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::{Loss, Rule};
use crate::{
    Error, Result,
    models::{
        self,
        network::{Architecture, Config, Network},
    },
    nn::Precision,
    testset::Pair,
};

/// Everything that decides a run's result. It is written to the run folder as `config.json` once all pairs
/// have been read, so a folder without that file is free for a new run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainOptions {
    /// The network.
    pub network: Config,
    /// Pairs trained on.
    pub train: Vec<Pair>,
    /// Pairs validated on, never trained on.
    pub validation: Vec<Pair>,
    /// Steps in all.
    pub steps: usize,
    /// Crops in a step, if they have `patch` rows and columns; of smaller crops, as many as have no more
    /// pixels in all.
    pub batch: usize,
    /// Rows and columns of a crop, unless the frame that is drawn first for its step is smaller.
    pub patch: usize,
    /// The largest learning rate, and that of the last step, to which it falls linearly.
    pub lr: (f64, f64),
    /// What is minimised.
    pub loss: Loss,
    /// Whether squared errors are against references as they were before they were denoised.
    #[serde(default)]
    pub raw_references: bool,
    /// Share of the crops that lack albedo, normal, or both, see
    /// [`Denoiser::dispensable`](crate::models::Denoiser::dispensable).
    #[serde(default)]
    pub guide_dropout: f64,
    /// Share of the crops in coloured light, see [`Augment::tinted`](crate::augment::Augment::tinted).
    #[serde(default)]
    pub tint: f64,
    /// Share of the gradient that passes ReLUs where they give nothing, see [`Conv::set_leak`](crate::nn::Conv::set_leak).
    #[serde(default)]
    pub leak: f64,
    /// How gradients become updates.
    #[serde(default)]
    pub optimizer: Rule,
    /// Share of the convolutions' weights that a step takes away at a learning rate of 1.
    #[serde(default)]
    pub weight_decay: f64,
    /// What convolutions round their factors to.
    pub precision: Precision,
    /// Weight of the past in the running average of the weights, which is what is validated and kept.
    pub average: f64,
    /// Steps between rows of the log, each with a validation.
    pub every: usize,
    /// Decides initial weights, crops and augmentation.
    pub seed: u64,
    /// A weights file to begin with, instead of weights drawn from the seed.
    pub init: Option<PathBuf>,
    /// The names of the parameters that are trained, as [`train_only`] reads them; all are if there are none.
    #[serde(default)]
    pub only: Vec<String>,
    /// The weights file whose prefilter the network gets, if not the built-in one or that of `init`.
    #[serde(default)]
    pub prefilter: Option<PathBuf>,
}

/// A setting that no run can have.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// Its name in `config.json`.
    pub setting: &'static str,
    /// What is wrong with it, and what it may be.
    pub reason: String,
}

/// The most crops in a step, and the most rows and columns of one. More is taken for a typing error, which
/// would take all memory.
const MOST: usize = 4096;

impl TrainOptions {
    /// Whether a run can have these settings, before any file is read.
    ///
    /// # Errors
    /// Names the first setting that no run can have.
    pub fn check(&self) -> Result<(), Refusal> {
        let refuse = |setting, reason: String| Err(Refusal { setting, reason });
        if let Err(reason) = models::check(&self.network) {
            return refuse("network", reason);
        }
        // What is asked of the network below does not depend on its widths, so the narrowest is built.
        let Config { architecture, widths, prefilter } = self.network.clone();
        let narrowest =
            Config { architecture, widths: vec![1; widths.len()], prefilter: vec![1; prefilter.len()] };
        let mut network = models::build(&narrowest, 0);
        let name = format!("{architecture:?}").to_lowercase();
        if !self.only.is_empty() && !network.batch_norms().is_empty() {
            let reason = "normalises by what it sees in training, so that all of it changes; leave it out";
            return refuse("only", format!("{name} {reason}"));
        }
        if let Err(error) = train_only(&mut *network, &self.only) {
            return refuse("only", error.to_string());
        }
        if !network.makes_radiance() && self.raw_references {
            let reason = "makes no radiance, of which alone references hold what it was before; leave it out";
            return refuse("raw_references", format!("{name} {reason}"));
        }
        if self.guide_dropout > 0.0 && architecture != Architecture::Pyramid {
            let reason = "cannot do without its guides; leave it out";
            return refuse("guide_dropout", format!("{name} {reason}"));
        }
        for (setting, share) in
            [("guide_dropout", self.guide_dropout), ("tint", self.tint), ("leak", self.leak)]
        {
            if !(0.0..=1.0).contains(&share) {
                return refuse(setting, format!("{share}: must be from 0 to 1"));
            }
        }
        if !network.makes_radiance() && self.loss.needs_radiance() {
            let reason = "makes no radiance that a display would show; take geomean";
            return refuse("loss", format!("{}: {name} {reason}", self.loss));
        }
        for (setting, value) in [("steps", self.steps), ("batch", self.batch), ("every", self.every)] {
            if value == 0 {
                return refuse(setting, "must be at least 1".into());
            }
        }
        for (setting, value) in [("batch", self.batch), ("patch", self.patch)] {
            if value > MOST {
                return refuse(setting, format!("{value}: must be at most {MOST}"));
            }
        }
        let (multiple, least) = (network.multiple(), self.loss.least_side());
        if self.patch == 0 || !self.patch.is_multiple_of(multiple) {
            return refuse("patch", format!("{}: must be a multiple of {multiple}", self.patch));
        }
        if self.patch < least {
            return refuse("patch", format!("{}: loss {} takes {least} at least", self.patch, self.loss));
        }
        let is_rate = |rate: f64| rate > 0.0 && rate.is_finite();
        if !(is_rate(self.lr.0) && is_rate(self.lr.1)) {
            return refuse("lr", "must be two positive numbers, the largest and the last".into());
        }
        if !(0.0..f64::INFINITY).contains(&self.weight_decay) {
            return refuse("weight_decay", "must be a number, at least 0".into());
        }
        if !(0.0..1.0).contains(&self.average) {
            return refuse("average", "must be at least 0 and less than 1".into());
        }
        if self.train.is_empty() {
            return refuse("train", "names no pair to train on".into());
        }
        Ok(())
    }
}

/// Trains only the parameters whose names one of `names` matches, in which `*` stands for any part of a name;
/// without `names`, changes nothing.
///
/// # Errors
/// One of `names` is no pattern, or matches nothing that is trained.
pub fn train_only(network: &mut dyn Network, names: &[String]) -> Result<()> {
    if names.is_empty() {
        return Ok(());
    }
    let mut trained = network.params();
    trained.retain(|param| param.trainable);
    let refuse = |name: &str, reason: String| Error::Usage(format!("'{name}' {reason}"));
    let mut patterns = Vec::with_capacity(names.len());
    for name in names {
        let pattern = glob::Pattern::new(name).map_err(|e| refuse(name, e.to_string()))?;
        if !trained.iter().any(|param| pattern.matches(&param.name)) {
            let (first, last) = (&trained[0].name, &trained[trained.len() - 1].name);
            let reason = format!("matches no parameter that is trained; they are {first} to {last}");
            return Err(refuse(name, reason));
        }
        patterns.push(pattern);
    }
    for param in trained {
        param.trainable = patterns.iter().any(|pattern| pattern.matches(&param.name));
    }
    Ok(())
}
