//! The catalogue of methods. A new method takes a file of its own and a row in [`METHODS`].

use std::path::{Path, PathBuf};

use super::{
    Denoiser, Noisy, demc, kpcn, lbf,
    learned::{Learned, TURNED},
    network::{Architecture, Config},
    nfor, oidn, pyramid,
};
use crate::{Error, Result, nn::weights};

/// A method: a row of the catalogue.
pub struct Method {
    /// The name by which `--model` and reports know it.
    pub name: &'static str,
    /// Whose it is; charts give a family one hue.
    pub family: Family,
    /// How it is made.
    pub kind: Kind,
}

/// Whose method it is.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Family {
    /// The input itself.
    Noisy,
    /// The networks of the DEMC paper.
    Paper,
    /// The paper's rivals.
    Rival,
    /// Open Image Denoise.
    Oidn,
    /// The built-in models, and weights files.
    Own,
}

/// How a method is made.
pub enum Kind {
    /// It has nothing to learn.
    Fixed(fn() -> Box<dyn Denoiser>),
    /// A network of a design and widths.
    Learned {
        /// Configures it as `demc train` begins with it.
        config: fn() -> Config,
        /// Where its weights are.
        weights: Weights,
    },
    /// Part of another method, which can be trained alone.
    Part(fn() -> Config),
    /// A method with the weights of another, which it uses in another way.
    Variant(&'static [u8]),
}

/// Where the weights of a method are.
pub enum Weights {
    /// In the program.
    BuiltIn(&'static [u8]),
    /// In a file that is no part of the program: see [`Method::weights_file`].
    File,
    /// Nowhere: `demc train` makes them.
    None,
}

static DEMC_S: &[u8] = include_bytes!("weights/demc-s.safetensors");
static DEMC_M: &[u8] = include_bytes!("weights/demc-m.safetensors");

/// Every method: ours, fastest first, then the paper's networks, its rivals and Open Image Denoise.
pub static METHODS: &[Method] = &[
    fixed("noisy", Family::Noisy, || Box::new(Noisy)),
    learned("demc-s", Family::Own, pyramid::small, Weights::BuiltIn(DEMC_S)),
    learned("demc-m", Family::Own, pyramid::medium, Weights::BuiltIn(DEMC_M)),
    Method { name: TURNED, family: Family::Own, kind: Kind::Variant(DEMC_M) },
    Method { name: "prefilter", family: Family::Own, kind: Kind::Part(pyramid::prefilter) },
    learned("demc", Family::Paper, || paper(Architecture::Demc), Weights::File),
    learned("demc-nofusion", Family::Paper, || paper(Architecture::DemcNofusion), Weights::File),
    learned("semc", Family::Paper, || paper(Architecture::Semc), Weights::File),
    learned("kpcn", Family::Rival, || kpcn::config(Architecture::Kpcn), Weights::File),
    learned("kpcn-combined", Family::Rival, || kpcn::config(Architecture::KpcnCombined), Weights::None),
    learned("lbf", Family::Rival, lbf::config, Weights::File),
    fixed(nfor::NAME, Family::Rival, || Box::new(nfor::Nfor)),
    fixed("oidn-fast", Family::Oidn, || oidn::Oidn::boxed("oidn-fast")),
    fixed("oidn-balanced", Family::Oidn, || oidn::Oidn::boxed("oidn-balanced")),
    fixed("oidn-high", Family::Oidn, || oidn::Oidn::boxed("oidn-high")),
    fixed("oidn-high-prefilter", Family::Oidn, || oidn::Oidn::boxed("oidn-high-prefilter")),
];

const fn fixed(name: &'static str, family: Family, make: fn() -> Box<dyn Denoiser>) -> Method {
    Method { name, family, kind: Kind::Fixed(make) }
}

const fn learned(name: &'static str, family: Family, config: fn() -> Config, weights: Weights) -> Method {
    Method { name, family, kind: Kind::Learned { config, weights } }
}

/// Widths of the paper's networks unless told otherwise. At full resolution they are a quarter of the
/// published width.
const PAPER_NARROW: [usize; demc::PAPER_WIDTHS.len()] = [16, 32, 32, 48, 48];

fn paper(architecture: Architecture) -> Config {
    Config::new(architecture, &super::widths(architecture, &PAPER_NARROW))
}

/// The method of that name.
pub fn find(name: &str) -> Option<&'static Method> {
    METHODS.iter().find(|method| method.name == name)
}

/// The environment variable that names the folder of weights that are no part of the program.
pub const WEIGHTS_FOLDER: &str = "DEMC_WEIGHTS";

/// Where that folder lies in this repository.
pub const IN_REPOSITORY: &str = "eval/rivals/weights";

impl Method {
    /// The weights in the program.
    pub fn built_in(&self) -> Option<&'static [u8]> {
        match self.kind {
            Kind::Learned { weights: Weights::BuiltIn(bytes), .. } | Kind::Variant(bytes) => Some(bytes),
            _ => None,
        }
    }

    /// What `demc train` begins with; none for methods that are not trained by themselves.
    pub fn config(&self) -> Option<Config> {
        match self.kind {
            Kind::Learned { config, .. } | Kind::Part(config) => Some(config()),
            _ => None,
        }
    }

    /// Its weights file, where it has one and that can be found: in the folder that `DEMC_WEIGHTS` names, or
    /// in `eval/rivals/weights` of the current folder.
    pub fn weights_file(&self) -> Option<PathBuf> {
        if !matches!(self.kind, Kind::Learned { weights: Weights::File, .. }) {
            return None;
        }
        let folder =
            std::env::var_os(WEIGHTS_FOLDER).map_or_else(|| PathBuf::from(IN_REPOSITORY), PathBuf::from);
        let path = folder.join(self.name).with_extension("safetensors");
        path.is_file().then_some(path)
    }

    /// The network with its weights.
    ///
    /// # Errors
    /// It is no network with weights, or its weights file is missing or unsound; the message says what to do.
    pub fn learned(&self) -> Result<Learned> {
        let name = self.name;
        if let Some(bytes) = self.built_in() {
            return Learned::parse(name, bytes, Path::new(name));
        }
        if let Some(path) = self.weights_file() {
            let bytes = weights::bytes(&path)?;
            return Learned::parse(name, &bytes, &path);
        }
        Err(Error::Usage(match self.kind {
            Kind::Learned { weights: Weights::File, .. } => {
                let looked = match std::env::var_os(WEIGHTS_FOLDER) {
                    Some(folder) => {
                        format!("{WEIGHTS_FOLDER} names {}, where they are not", folder.display())
                    }
                    None => format!("{IN_REPOSITORY} is not below the current folder"),
                };
                format!(
                    "{name}: its weights are no part of the program, and {looked}; they are in {IN_REPOSITORY} of demc's \
                     repository. Name the file in place of the method, or that folder by {WEIGHTS_FOLDER}=FOLDER"
                )
            }
            Kind::Learned { .. } => format!(
                "{name} comes without weights: `demc train --model {name} --data DIR --out RUN` makes them, and \
                 RUN/best.safetensors then names the method"
            ),
            _ => format!("{name} is no method by itself: `demc models` lists those there are"),
        }))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;
    use crate::models::open;

    #[test]
    fn every_method_but_those_without_weights_opens_by_its_name() {
        let names: HashSet<&str> = METHODS.iter().map(|method| method.name).collect();
        assert_eq!(names.len(), METHODS.len(), "names are told apart");
        for method in METHODS {
            let opened = open(method.name);
            match method.kind {
                Kind::Part(_) | Kind::Learned { weights: Weights::None, .. } => {
                    assert!(opened.is_err_and(|e| e.to_string().starts_with(method.name)), "{}", method.name);
                }
                // Tests of the library run in the repository.
                _ => assert_eq!(opened.unwrap().name(), method.name),
            }
        }
    }
}
