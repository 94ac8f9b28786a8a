//! `run.json`: what the rows in a folder were made with, so that a later run keeps those that hold.

use std::{collections::BTreeMap, fs, path::Path};

use serde::{Deserialize, Serialize};

use super::{
    Method, Options,
    provenance::Provenance,
    rows::{Row, write_file},
};
use crate::{Result, testset::Pair};

/// The settings of a run, and stamps of what it read.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    provenance: Provenance,
    threads: usize,
    repeats: usize,
    view_layer: Option<String>,
    /// Stamp of each method, by name.
    methods: BTreeMap<String, String>,
    /// Stamp of each pair, by its noisy and reference files.
    pairs: BTreeMap<String, String>,
}

impl Settings {
    /// Those of a run about to start.
    pub fn of(pairs: &[Pair], methods: &[Method], options: &Options, provenance: &Provenance) -> Self {
        Self {
            provenance: provenance.clone(),
            threads: options.threads,
            repeats: options.repeats,
            view_layer: options.view_layer.clone(),
            methods: methods.iter().map(|m| (m.name.clone(), m.stamp.clone())).collect(),
            pairs: pairs
                .iter()
                .map(|p| {
                    let stamps = [file_stamp(&p.noisy), file_stamp(&p.reference)].join(" ");
                    (name(&p.noisy, &p.reference), stamps)
                })
                .collect(),
        }
    }

    /// Those stored in `path`; the default, with which nothing agrees, where there are none.
    pub fn read(path: &Path) -> Self {
        fs::read(path).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default()
    }

    /// Stores them.
    pub fn write(&self, path: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self).expect("maps of strings are JSON");
        write_file(path, (text + "\n").as_bytes())
    }

    /// Whether `row`, made with the settings `self`, would come out the same with `now`.
    pub fn still_holds(&self, row: &Row, now: &Self) -> bool {
        let pair = name(&row.noisy, &row.reference);
        let (before, after) = (&self.provenance, &now.provenance);
        (&before.version, &before.cpu, &before.instructions)
            == (&after.version, &after.cpu, &after.instructions)
            && (self.threads, self.repeats, &self.view_layer) == (now.threads, now.repeats, &now.view_layer)
            && now.methods.contains_key(&row.model)
            && self.methods.get(&row.model) == now.methods.get(&row.model)
            && now.pairs.contains_key(&pair)
            && self.pairs.get(&pair) == now.pairs.get(&pair)
    }

    /// Whether both runs have the same methods, so that comparison sheets show the same.
    pub fn same_methods(&self, other: &Self) -> bool {
        self.methods == other.methods
    }
}

fn name(noisy: &Path, reference: &Path) -> String {
    format!("{} {}", noisy.display(), reference.display())
}

/// Size and time of change of a file: differs when the file was written again.
pub fn file_stamp(path: &Path) -> String {
    let Ok(metadata) = fs::metadata(path) else { return "missing".into() };
    let changed = metadata.modified().ok().and_then(|t| t.duration_since(std::time::UNIX_EPOCH).ok());
    format!("{} {}", metadata.len(), changed.map_or(0, |t| t.as_nanos()))
}
