//! Options that say where passes are that cannot be found by their names.

use std::path::PathBuf;

use clap::Args as ClapArgs;

use crate::{
    Error, Result,
    passes::Mapping,
    sources::{Sources, has_number},
};

/// What passes are called.
#[derive(Clone, Debug, Default, ClapArgs)]
pub struct Names {
    /// The layer that is a pass, where its name does not tell: albedo=NAME, normal=NAME, beauty=NAME,
    /// depth=NAME ...
    #[arg(long, value_name = "PASS=NAME")]
    map: Vec<String>,

    /// A file of such lines, for a show or a renderer
    #[arg(long, value_name = "FILE")]
    map_file: Option<PathBuf>,
}

/// Files of their own that hold guides.
#[derive(Clone, Debug, Default, ClapArgs)]
pub struct GuideFiles {
    /// The file that holds the albedo; #### in its name is the frame's number
    #[arg(long, value_name = "FILE")]
    albedo: Option<PathBuf>,

    /// The file that holds the normal, likewise
    #[arg(long, value_name = "FILE")]
    normal: Option<PathBuf>,
}

impl Names {
    /// The mapping that both options make together.
    ///
    /// # Errors
    /// One makes no sense, or the file cannot be read.
    pub fn mapping(&self) -> Result<Mapping> {
        let mut mapping = Mapping::default();
        if let Some(path) = &self.map_file {
            mapping.add_file(path)?;
        }
        for line in &self.map {
            mapping.add(line).map_err(|why| Error::Usage(format!("--map {line}: {why}")))?;
        }
        Ok(mapping)
    }
}

impl GuideFiles {
    /// Where the passes of one frame (`is_one`) or of several are, by these files and by `names`.
    ///
    /// # Errors
    /// One file is named for several frames.
    pub fn sources(self, names: &Names, is_one: bool) -> Result<Sources> {
        for (option, pattern) in [("--albedo", &self.albedo), ("--normal", &self.normal)] {
            if let Some(pattern) = pattern.as_deref().filter(|pattern| !is_one && !has_number(pattern)) {
                let pattern = pattern.display();
                let why = format!(
                    "{option} {pattern}: is one file for several frames; put #### in the place of the number"
                );
                return Err(Error::Usage(why));
            }
        }
        Ok(Sources { mapping: names.mapping()?, albedo: self.albedo, normal: self.normal })
    }
}
