//! What the user calls passes, for files whose names no table can know: `albedo=NAME`.

use std::{collections::BTreeMap, fs, path::Path};

use super::{Layer, Pass, layers::within, names::is_alike};
use crate::{Error, Result};

/// Short words for what is named most; any pass of Blender's is known by its own name as well.
const WORDS: [(&str, &[Pass]); 5] = [
    ("beauty", &[Pass::Combined, Pass::Alpha]),
    ("albedo", &[Pass::DenoisingAlbedo]),
    ("normal", &[Pass::DenoisingNormal]),
    ("depth", &[Pass::Depth, Pass::DenoisingDepth]),
    ("position", &[Pass::Position]),
];

/// Names of layers by the passes that they are.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Mapping(BTreeMap<Pass, String>);

impl Mapping {
    /// Adds what one line says, such as `albedo=My Albedo`: the pass and the name of its layer in the file,
    /// with the view layer before it or without.
    ///
    /// # Errors
    /// The line is not of that form, or gives a pass another name; the text says what is wanted.
    pub fn add(&mut self, line: &str) -> Result<(), String> {
        let (word, name) = line.split_once('=').ok_or("wants PASS=NAME, such as albedo=NAME")?;
        let (word, name) = (word.trim(), name.trim());
        if name.is_empty() {
            return Err(format!("wants the name of a layer after {word}="));
        }
        let short =
            WORDS.iter().find(|(short, _)| short.eq_ignore_ascii_case(word)).map(|(_, passes)| *passes);
        let own = Pass::ALL.iter().position(|pass| is_alike(&pass.to_string(), word));
        let own = own.map(|at| &Pass::ALL[at..=at]);
        let passes = short.or(own).ok_or_else(|| {
            let words: Vec<&str> = WORDS.iter().map(|(word, _)| *word).collect();
            format!("'{word}' is no pass; one of {}, or a pass of Blender's", words.join(", "))
        })?;
        for pass in passes {
            if self.0.insert(*pass, name.into()).is_some_and(|before| before != name) {
                return Err(format!("{word} is named twice"));
            }
        }
        Ok(())
    }

    /// Adds the lines of a file, one for each pass; empty lines and those that begin with `#` are left out.
    ///
    /// # Errors
    /// The file cannot be read, or a line makes no sense.
    pub fn add_file(&mut self, path: &Path) -> Result<()> {
        let text = fs::read_to_string(path).map_err(Error::io("read", path))?;
        for (number, line) in text.lines().enumerate() {
            let line = line.trim();
            if !line.is_empty() && !line.starts_with('#') {
                self.add(line)
                    .map_err(|why| Error::invalid(path, format!("line {}: '{line}': {why}", number + 1)))?;
            }
        }
        Ok(())
    }

    /// The passes that are named, with their names.
    pub fn iter(&self) -> impl Iterator<Item = (Pass, &str)> {
        self.0.iter().map(|(pass, name)| (*pass, name.as_str()))
    }

    /// Whether a layer holds all that is named.
    ///
    /// # Errors
    /// The layer lacks one; the message says what it holds.
    pub fn check(&self, path: &Path, layer: &Layer) -> Result<()> {
        // An alpha that goes with the beauty need not be there.
        let mut wanted = self.iter().filter(|(pass, _)| *pass != Pass::Alpha);
        let is_found = |(pass, name): &(Pass, &str)| {
            let own = within(&layer.name, name);
            layer.passes.get(pass).is_some_and(|at| is_alike(&at.name, own))
        };
        let Some((pass, name)) = wanted.find(|named| !is_found(named)) else { return Ok(()) };
        let mut held: Vec<&str> = layer.passes.values().map(|at| at.name.as_str()).collect();
        held.extend(layer.unrecognised.iter().filter_map(|channel| Some(channel.rsplit_once('.')?.0)));
        held.sort_unstable();
        held.dedup();
        Err(Error::invalid(
            path,
            format!(
                "has no layer '{name}' with the components of {pass}, as the mapping (--map) says; there are: {}",
                held.join(", ")
            ),
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_name_passes() {
        let mut mapping = Mapping::default();
        mapping.add("albedo = My Albedo").unwrap();
        mapping.add("Denoising Normal=nn").unwrap();
        mapping.add("depth=dd").unwrap();
        let named: Vec<(Pass, &str)> = mapping.iter().collect();
        let depths = [(Pass::DenoisingDepth, "dd"), (Pass::Depth, "dd")];
        assert!(named.contains(&(Pass::DenoisingAlbedo, "My Albedo")));
        assert!(named.contains(&(Pass::DenoisingNormal, "nn")));
        assert!(depths.iter().all(|depth| named.contains(depth)));
    }

    #[test]
    fn lines_without_sense_are_refused_with_what_would_make_some() {
        let refused = |line: &str| Mapping::default().add(line).unwrap_err();
        assert!(refused("albedo").contains("albedo=NAME"));
        assert!(refused("albedo=").contains("after albedo="));
        assert!(refused("colour=x").contains("beauty, albedo"));
        let mut mapping = Mapping::default();
        mapping.add("albedo=a").unwrap();
        mapping.add("albedo=a").unwrap();
        assert!(mapping.add("albedo=b").unwrap_err().contains("twice"));
    }
}
