//! `run.json`: what the rows in a folder were made with, so that a later run keeps those that hold.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};

use super::{
    Contender, EvalOptions, NOISY,
    provenance::Provenance,
    rows::{Row, write_json},
};
use crate::{Result, denoise, shot, testset::Pair};

/// The settings of a run, and stamps of what it read. Fields that only other versions write are ignored.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    provenance: Provenance,
    threads: usize,
    repeats: usize,
    view_layer: Option<String>,
    /// Stamp of each method that has rows, by name.
    methods: BTreeMap<String, String>,
    /// Stamp of each pair that has rows, by its noisy and reference files.
    pairs: BTreeMap<String, String>,
    /// What each comparison sheet shows, by its file's name.
    #[serde(default)]
    pub sheets: BTreeMap<String, String>,
}

impl Settings {
    /// The settings of a run that is about to start.
    pub fn of(pairs: &[Pair], methods: &[Contender], options: &EvalOptions, provenance: &Provenance) -> Self {
        Self {
            provenance: provenance.clone(),
            threads: options.threads,
            repeats: options.repeats,
            view_layer: options.view_layer.clone(),
            methods: methods.iter().map(|m| (m.name.clone(), m.stamp.clone())).collect(),
            pairs: pairs
                .iter()
                .map(|p| (name(&p.noisy, &p.reference), pair_stamp(&p.noisy, &p.reference)))
                .collect(),
            sheets: BTreeMap::new(),
        }
    }

    /// The settings stored in `path`; where there are none, the default, under which no row holds.
    pub fn read(path: &Path) -> Self {
        fs::read(path).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default()
    }

    /// Stores them.
    pub fn write(&self, path: &Path) -> Result<()> {
        write_json(path, self)
    }

    /// Whether `row`, which was made with the settings `self`, would come out the same with `now`. Where
    /// `now` does not ask for the row's method, its stamp of today is not known and it counts as unchanged.
    /// But if its old stamp was the program's, which is that of `noisy`, the program's stamp of today is
    /// compared.
    pub fn still_holds(&self, row: &Row, now: &Self) -> bool {
        let pair = self.pairs.get(&name(&row.noisy, &row.reference));
        let (before, after) = (&self.provenance, &now.provenance);
        let stamp = self.methods.get(&row.model);
        let program = self.methods.get(NOISY);
        let expected = match now.methods.get(&row.model) {
            None if stamp == program => now.methods.get(NOISY),
            None => stamp,
            asked => asked,
        };
        (&before.version, &before.cpu, &before.instructions)
            == (&after.version, &after.cpu, &after.instructions)
            && (self.threads, self.repeats, &self.view_layer) == (now.threads, now.repeats, &now.view_layer)
            && stamp.is_some()
            && stamp == expected
            && pair == Some(&pair_stamp(&row.noisy, &row.reference))
    }

    /// Takes over from `before` the stamps of a row that this run does not ask for.
    pub fn keep(&mut self, row: &Row, before: &Self) {
        let pair = name(&row.noisy, &row.reference);
        for (own, other, key) in
            [(&mut self.methods, &before.methods, &row.model), (&mut self.pairs, &before.pairs, &pair)]
        {
            if let Some(stamp) = other.get(key) {
                own.entry(key.clone()).or_insert_with(|| stamp.clone());
            }
        }
    }
}

/// The most frames before a frame, and after it, that any method makes use of.
pub const REACH: usize = 8;

/// The name of a pair in `run.json`.
pub fn name(noisy: &Path, reference: &Path) -> String {
    format!("{} {}", noisy.display(), reference.display())
}

/// The stamp of all files that a row of a pair may depend on.
fn pair_stamp(noisy: &Path, reference: &Path) -> String {
    let halves = shot::half_paths(noisy).into_iter().flatten();
    // For a frame of a sequence, the frames around it.
    let around = [noisy, reference].map(|file| denoise::neighbours(file, REACH)).into_iter().flatten();
    let files =
        [noisy.into(), reference.into()].into_iter().chain(halves).chain(around.map(|(_, file)| file));
    files.map(|file: PathBuf| file_stamp(&file)).collect::<Vec<_>>().join(" ")
}

/// Size and time of change of a file: differs when the file was written again.
pub fn file_stamp(path: &Path) -> String {
    let Ok(metadata) = fs::metadata(path) else { return "missing".into() };
    let changed = metadata.modified().ok().and_then(|t| t.duration_since(std::time::UNIX_EPOCH).ok());
    format!("{} {}", metadata.len(), changed.map_or(0, |t| t.as_nanos()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_holds_while_its_stamps_do_asked_for_or_not() {
        let dir = tempfile::tempdir().unwrap();
        let [noisy, reference] = ["a_0004spp.exr", "a_ref.exr"].map(|name| dir.path().join(name));
        fs::write(&noisy, "x").unwrap();
        fs::write(&reference, "x").unwrap();
        let settings = |methods: &[(&str, &str)]| Settings {
            methods: methods.iter().map(|(name, stamp)| (name.to_string(), stamp.to_string())).collect(),
            pairs: [(name(&noisy, &reference), pair_stamp(&noisy, &reference))].into(),
            ..Settings::default()
        };
        let before = settings(&[("noisy", "1"), ("demc-s", "1"), ("weights", "5")]);
        let holds = |now: &Settings| {
            ["noisy", "demc-s", "weights", "unknown"].map(|model| {
                let (noisy, reference) = (noisy.clone(), reference.clone());
                before.still_holds(&Row { model: model.into(), noisy, reference, ..Row::default() }, now)
            })
        };
        let asked = [("noisy", "1"), ("demc-s", "1"), ("weights", "5")];
        assert_eq!(holds(&settings(&asked)), [true, true, true, false]);
        assert_eq!(holds(&settings(&asked[..1])), [true, true, true, false], "not asked for");
        assert_eq!(
            holds(&settings(&[("noisy", "1"), ("weights", "6")])),
            [true, true, false, false],
            "other weights"
        );
        assert_eq!(holds(&settings(&[("noisy", "2")])), [false, false, true, false], "another program");
        assert_eq!(
            holds(&Settings { threads: 1, ..settings(&asked) }),
            [false; 4],
            "another number of threads"
        );
        let halves = ["a_0004spp_a.exr", "a_0004spp_b.exr"].map(|name| dir.path().join(name));
        halves.iter().for_each(|half| fs::write(half, "x").unwrap());
        assert_eq!(holds(&settings(&asked)), [false; 4], "half buffers");
        halves.iter().for_each(|half| fs::remove_file(half).unwrap());
        assert_eq!(holds(&settings(&asked)), [true, true, true, false]);
        fs::write(&reference, "longer").unwrap();
        assert_eq!(holds(&settings(&asked)), [false; 4], "another reference");
    }

    #[test]
    fn a_run_of_another_version_is_read() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("run.json");
        let settings = Settings { methods: [("weights".into(), "5".into())].into(), ..Settings::default() };
        settings.write(&path).unwrap();
        let mut stored: serde_json::Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        stored["notes"] = serde_json::json!({ "noisy": ["does not show the same scene"] });
        stored.as_object_mut().unwrap().remove("sheets");
        fs::write(&path, stored.to_string()).unwrap();
        assert_eq!(Settings::read(&path), settings);
    }
}
