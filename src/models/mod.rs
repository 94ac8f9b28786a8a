//! Every denoising method behind one trait. A new method is one file here and one row in the [`catalogue`].

pub mod catalogue;
pub mod demc;
pub mod kpcn;
pub mod lbf;
pub mod learned;
pub mod network;
pub mod nfor;
pub mod oidn;
pub mod pyramid;
pub mod weights_file;

use std::{path::Path, time::Instant};

use network::{Architecture, Config, Network};

use crate::{Error, Result, companion::Companion, nn::Precision, passes::Pass, planes::Planes, shot::Shot};

/// One way to remove noise from a frame.
pub trait Denoiser: Send + Sync {
    /// The name by which `--model` and the report know it.
    fn name(&self) -> &str;

    /// The passes it needs.
    fn passes(&self) -> &[Pass];

    /// Passes it makes use of where a file holds them.
    fn optional_passes(&self) -> &[Pass] {
        &[]
    }

    /// Whether it makes use of half buffers, see [`Shot::read_halves`].
    fn reads_halves(&self) -> bool {
        false
    }

    /// What the user should know about how it treats this frame.
    fn notes(&self, shot: &Shot) -> Option<String> {
        let _ = shot;
        None
    }

    /// Denoised radiance, (3, H, W).
    ///
    /// # Errors
    /// A pass is missing, or the method cannot run here; the message says why.
    fn denoise(&self, shot: &Shot) -> Result<Planes>;

    /// As [`Denoiser::denoise`], working on squares of at most `tile` pixels at a time where the method
    /// can, to bound its memory; a method that cannot ignores the hint.
    ///
    /// # Errors
    /// As [`Denoiser::denoise`].
    fn denoise_tiled(&self, shot: &Shot, tile: Option<usize>) -> Result<Planes> {
        let _ = tile;
        self.denoise(shot)
    }

    /// Whether it denoises layers along with the beauty.
    fn takes_companions(&self) -> bool {
        false
    }

    /// As [`Denoiser::denoise_tiled`], and each of the companions, layers of the same frame, denoised along with the beauty,
    /// in its place.
    ///
    /// # Errors
    /// As [`Denoiser::denoise`], or there are companions and the method takes none.
    fn denoise_along(
        &self,
        shot: &Shot,
        companions: &mut [Companion],
        tile: Option<usize>,
    ) -> Result<Planes> {
        refuse_companions(self.name(), companions)?;
        self.denoise_tiled(shot, tile)
    }

    /// As [`Denoiser::denoise`], with what it cost. A method that works in a process of its own
    /// reports its filter's time, without start and file traffic.
    ///
    /// # Errors
    /// As [`Denoiser::denoise`].
    fn denoise_timed(&self, shot: &Shot) -> Result<Run> {
        let start = Instant::now();
        let image = self.denoise(shot)?;
        Ok(Run { image, seconds: start.elapsed().as_secs_f64(), peak_mib: None })
    }

    /// Whether [`Denoiser::denoise_timed`] times the same however long cores were idle before: it warms up by itself, or takes
    /// seconds.
    fn is_warm(&self) -> bool {
        false
    }
}

/// Stops a method that takes no companions where there are some.
fn refuse_companions(name: &str, companions: &[Companion]) -> Result<()> {
    if companions.is_empty() {
        return Ok(());
    }
    Err(Error::Usage(format!(
        "{name} denoises the beauty alone; demc-s, demc-m and demc-l take other layers along"
    )))
}

/// A denoised frame and what it cost.
pub struct Run {
    /// Denoised radiance, (3, H, W).
    pub image: Planes,
    /// Time that denoising took, without file input and output.
    pub seconds: f64,
    /// Memory taken outside this process, where the method runs in one of its own.
    pub peak_mib: Option<f64>,
}

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

/// A method by its built-in name, or from a weights file. A trained network's name may end in `:f32`,
/// `:bf16` or `:int8`, which chooses its arithmetic; without it, the fastest one that network and processor
/// have.
///
/// # Errors
/// No built-in method or readable weights file goes by that name, or it has no such arithmetic.
pub fn open(name_or_file: &str) -> Result<Box<dyn Denoiser>> {
    let (plain, precision) = split_precision(name_or_file);
    let model = match catalogue::find(plain) {
        Some(catalogue::Method { kind: catalogue::Kind::Fixed(make), .. }) => return Ok(make()),
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
    Ok(Box::new(model.with_precision(name_or_file, precision)?))
}

/// A method's name or weights file, and the arithmetic asked for: `demc-m:f32`.
pub fn split_precision(name_or_file: &str) -> (&str, Option<Precision>) {
    match name_or_file.rsplit_once(':') {
        Some((plain, "f32")) => (plain, Some(Precision::F32)),
        Some((plain, "bf16")) => (plain, Some(Precision::Bf16)),
        Some((plain, "int8")) => (plain, Some(Precision::Int8)),
        _ => (name_or_file, None),
    }
}

/// The widths of a network for those asked for: `semc` gets what makes it as large as `demc` of them,
/// every other network gets them as they are.
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
    let levels = match config.architecture {
        Architecture::Pyramid | Architecture::Prefilter => pyramid::LEVELS,
        Architecture::Kpcn | Architecture::KpcnCombined | Architecture::Lbf => 1,
        Architecture::Demc | Architecture::DemcNofusion | Architecture::Semc => demc::PAPER_WIDTHS.len(),
    };
    if config.widths.len() != levels {
        return Err(format!("{} widths, but the network takes {levels}", config.widths.len()));
    }
    let of_prefilter = if config.architecture == Architecture::Pyramid { levels } else { 0 };
    if config.prefilter.len() != of_prefilter {
        return Err(format!(
            "a prefilter of {} widths, but the network takes {of_prefilter}",
            config.prefilter.len()
        ));
    }
    if let Some(width) = config.widths.iter().chain(&config.prefilter).find(|w| !(1..=4096).contains(*w)) {
        return Err(format!("width {width} is out of range; use 1 to 4096"));
    }
    Ok(())
}

/// Fewer parameters than the network of a configuration has, but not by far: a file that holds fewer is not asked for memory to
/// build it in.
///
/// # Panics
/// If [`check`] finds the configuration wrong.
pub fn least_parameters(config: &Config) -> usize {
    let squares = |widths: &[usize]| widths.iter().map(|width| width * width).sum::<usize>();
    // Weights of convolutions from as many channels to as many: taps times layers of a width.
    let counted = match config.architecture {
        Architecture::Demc | Architecture::DemcNofusion => 9 * 4 * squares(&config.widths),
        Architecture::Semc => 9 * 2 * squares(&config.widths),
        Architecture::Pyramid | Architecture::Prefilter => 9 * 2 * squares(&config.widths),
        Architecture::Kpcn => 25 * 14 * squares(&config.widths),
        Architecture::KpcnCombined => 25 * 7 * squares(&config.widths),
        Architecture::Lbf => config.widths[0],
    };
    counted + 9 * 2 * squares(&config.prefilter)
}

/// A network with fresh weights drawn from `seed`.
///
/// # Panics
/// If [`check`] finds the configuration wrong.
pub fn build(config: &Config, seed: u64) -> Box<dyn Network> {
    match config.architecture {
        Architecture::Demc | Architecture::DemcNofusion | Architecture::Semc => {
            Box::new(demc::Demc::new(config.architecture, &config.widths, seed))
        }
        Architecture::Pyramid | Architecture::Prefilter => Box::new(pyramid::Pyramid::new(config, seed)),
        Architecture::Kpcn | Architecture::KpcnCombined => Box::new(kpcn::Kpcn::new(config, seed)),
        Architecture::Lbf => Box::new(lbf::Lbf::new(config, seed)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_are_told_before_they_are_built() {
        let mut configs: Vec<Config> = trainable().map(|(_, config)| config).collect();
        // The least and the most that levels of other widths need between them.
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
