//! Every denoising method behind one trait. A new method is one file here and one row in the [`catalogue`].

pub mod catalogue;
pub mod demc;
mod denoiser;
mod expected_error;
pub mod kpcn;
pub mod lbf;
pub mod learned;
pub mod network;
pub mod nfor;
pub mod oidn;
pub mod pyramid;
pub mod weights_file;

use std::path::Path;

pub use denoiser::{Denoiser, Run, check_expects};
pub use expected_error::ExpectedError;

use network::{Architecture, Config, Design, Network};

use crate::{Error, Result, nn::Precision, passes::Pass, planes::Planes, shot::Shot};

/// The input itself: the row every report begins with.
pub struct Noisy;

impl Denoiser for Noisy {
    fn name(&self) -> &str {
        "noisy"
    }

    fn passes(&self) -> &[Pass] {
        &[Pass::Combined]
    }

    fn denoise(&self, shot: &Shot) -> Result<Planes> {
        Ok(shot.passes.require(Pass::Combined, self.name())?.clone())
    }
}

/// A method by its built-in name, or from a weights file. A trained network's name may end in `:f32`, `:bf16`
/// or `:int8`, which chooses its arithmetic; without that, it is the fastest that both the network and the
/// processor have. After that it may end in [`UNRESTRAINED`].
///
/// # Errors
/// No built-in method or readable weights file goes by that name, or it has no such arithmetic.
pub fn open(name_or_file: &str) -> Result<Box<dyn Denoiser>> {
    let restrained = name_or_file.strip_suffix(UNRESTRAINED);
    let (plain, precision) = split_precision(restrained.unwrap_or(name_or_file));
    let mut model = match catalogue::find(plain) {
        Some(catalogue::Method { kind: catalogue::Kind::Fixed(make), .. }) if plain == name_or_file => {
            return Ok(make());
        }
        Some(catalogue::Method { kind: catalogue::Kind::Fixed(_), .. }) => {
            return Err(Error::Usage(format!(
                "{name_or_file}: {plain} is no network; leave out what follows its name"
            )));
        }
        Some(method) => method.learned()?,
        None if Path::new(plain).extension().is_some_and(|e| e == "safetensors") => {
            learned::Learned::from_file(Path::new(plain))?
        }
        None => {
            return Err(Error::Usage(format!(
                "no model '{plain}': `demc models` lists the built-in ones; weights files end in .safetensors"
            )));
        }
    };
    model.is_restrained = restrained.is_none();
    Ok(Box::new(model.with_precision(name_or_file, precision)?))
}

/// What a trained network's name ends in where nothing of what it changed beyond the noise is taken back: to
/// see what [shrinkage](crate::filters::shrinkage) does.
pub const UNRESTRAINED: &str = ":unrestrained";

/// A method's name or weights file, and the arithmetic asked for: `demc-m:f32`.
fn split_precision(name_or_file: &str) -> (&str, Option<Precision>) {
    match name_or_file.rsplit_once(':') {
        Some((plain, "f32")) => (plain, Some(Precision::F32)),
        Some((plain, "bf16")) => (plain, Some(Precision::Bf16)),
        Some((plain, "int8")) => (plain, Some(Precision::Int8)),
        _ => (name_or_file, None),
    }
}

/// What names a method or a weights file, without the variant asked for behind it.
pub fn without_variant(name_or_file: &str) -> &str {
    split_precision(name_or_file.strip_suffix(UNRESTRAINED).unwrap_or(name_or_file)).0
}

/// The widths of a network when the widths `asked` are wanted. `semc` gets those at which it is as large as a
/// `demc` of the widths asked for, and every other network gets the latter as they are.
pub fn widths(architecture: Architecture, asked: &[usize]) -> Vec<usize> {
    match architecture {
        Architecture::Semc if asked.len() == demc::PAPER_WIDTHS.len() => demc::semc_widths(asked),
        _ => asked.to_vec(),
    }
}

/// Names of the networks that can be trained, and the configuration each begins with.
pub fn trainable() -> impl Iterator<Item = (&'static str, Config)> {
    catalogue::METHODS.iter().filter_map(|method| Some((method.name, method.config()?)))
}

/// Whether a configuration describes a network that [`build`] can make.
///
/// # Errors
/// Says what is wrong with it.
pub fn check(config: &Config) -> Result<(), String> {
    let Design { levels, prefilter_levels, .. } = *config.architecture.design();
    if config.widths.len() != levels {
        return Err(format!("{} widths, but the network takes {levels}", config.widths.len()));
    }
    if config.prefilter.len() != prefilter_levels {
        return Err(format!(
            "a prefilter of {} widths, but the network takes {prefilter_levels}",
            config.prefilter.len()
        ));
    }
    if let Some(width) = config.widths.iter().chain(&config.prefilter).find(|w| !(1..=4096).contains(*w)) {
        return Err(format!("width {width} is out of range; use 1 to 4096"));
    }
    Ok(())
}

/// A lower bound of the number of parameters of a configuration's network, and at least a 48th of it. For a
/// file that holds fewer, no network is built, so that it cannot make demc take much memory.
///
/// # Panics
/// If [`check`] finds the configuration wrong.
pub fn least_parameters(config: &Config) -> usize {
    (config.architecture.design().least_parameters)(config)
}

/// A network with fresh weights drawn from `seed`.
///
/// # Panics
/// If [`check`] finds the configuration wrong.
pub fn build(config: &Config, seed: u64) -> Box<dyn Network> {
    (config.architecture.design().build)(config, seed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_are_told_before_they_are_built() {
        let mut configs: Vec<Config> = trainable().map(|(_, config)| config).collect();
        // The extremes of what the connections between levels of different widths need.
        configs.push(Config::new(Architecture::Prefilter, &[64, 8, 8, 8]));
        configs.push(Config::new(Architecture::Prefilter, &[8, 8, 8, 96]));
        configs.push(Config::new(Architecture::Demc, &[8, 8, 8, 8, 96]));
        for config in configs {
            let mut network = build(&config, 1);
            let held: usize = network.params().iter().map(|param| param.values().len()).sum();
            let least = least_parameters(&config);
            assert!((least..=48 * least).contains(&held), "{config}: {least}, {held}");
        }
    }
}
