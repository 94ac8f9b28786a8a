//! Render pairs on disk: which noisy file belongs to which reference.
//!
//! In: a directory, a CSV manifest or a glob, as the user typed it. Out: [`Pair`]s in a fixed order,
//! and the files that have no counterpart. Files are `<scene>_<NNNN>spp[.FRAME].exr` and
//! `<scene>_ref[.FRAME].exr`; a manifest has the header `scene,noisy,reference,spp`, with paths
//! relative to itself. Only names are looked at; no image is opened.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    fmt,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};

use crate::{Error, Result, frame::folder_of};

/// A noisy render and the converged render of the same view.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Pair {
    /// Scene name, with its folder where scenes of other folders are called alike; frames of one sequence share
    /// it.
    pub scene: String,
    /// The noisy multilayer EXR.
    pub noisy: PathBuf,
    /// The reference EXR.
    pub reference: PathBuf,
    /// Samples per pixel of the noisy render.
    pub spp: u32,
    /// Frame number of a sequence, digits as in the file name.
    pub frame: Option<String>,
}

impl Pair {
    /// Scene and frame, as reports name the row: `bathroom`, `shot.0017`.
    pub fn label(&self) -> String {
        match &self.frame {
            Some(frame) => format!("{}.{frame}", self.scene),
            None => self.scene.clone(),
        }
    }

    /// The error for a pair whose reference is missing.
    pub fn no_reference(&self) -> Error {
        let wanted = self.reference.display();
        let remedy = "render it, or take the noisy file out of the set";
        Error::invalid(&self.noisy, format!("no reference: {wanted} is missing; {remedy}"))
    }

    /// A name that is unique in its test set: `bathroom_0004spp`, `shot_0004spp.0017`.
    pub fn id(&self) -> String {
        let frame = self.frame.as_ref().map(|f| format!(".{f}")).unwrap_or_default();
        format!("{}_{:04}spp{frame}", self.scene, self.spp)
    }
}

/// A file of a test set that cannot be scored, and what it lacks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Unmatched {
    /// A noisy render, with the reference that was looked for.
    Noisy(Pair),
    /// A reference without a noisy render.
    Reference(PathBuf),
}

impl fmt::Display for Unmatched {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Noisy(pair) => pair.no_reference().fmt(f),
            Self::Reference(path) => write!(
                f,
                "{}: reference without a noisy render named <scene>_<spp>spp.exr beside it",
                path.display()
            ),
        }
    }
}

/// What a specification names: the pairs, and the files that are left over.
#[derive(Clone, Debug, Default)]
pub struct TestSet {
    /// Complete pairs, sorted by scene, frame, spp and path.
    pub pairs: Vec<Pair>,
    /// Files without their counterpart, sorted by path.
    pub unmatched: Vec<Unmatched>,
}

/// The test set that `spec` (directory, manifest, glob or one EXR file) names.
///
/// A glob or a file picks noisy renders, references or both; a reference that it leaves out is looked for
/// beside its noisy render. Directories and globs pass over hidden files.
///
/// # Errors
/// Nothing is there, the manifest is malformed, or no pair is complete.
pub fn read(spec: &str) -> Result<TestSet> {
    let path = Path::new(spec);
    let set = if path.is_dir() {
        let entries = std::fs::read_dir(path).map_err(Error::io("read", path))?;
        let files = entries
            .map(|entry| entry.map(|e| e.path()))
            .collect::<Result<Vec<_>, _>>()
            .map_err(Error::io("read", path))?;
        match_files(files.into_iter().filter(|f| f.is_file() && !is_hidden(f)), true)
    } else if path.is_file() && path.extension().is_some_and(|e| e.eq_ignore_ascii_case("exr")) {
        match_files([path.to_path_buf()], false)
    } else if path.is_file() {
        manifest(path)?
    } else if spec.contains(['*', '?', '[']) {
        let found = glob::glob(spec)
            .map_err(|e| Error::Usage(format!("'{spec}' is not a valid glob pattern: {e}")))?;
        let mut files = Vec::new();
        for file in found {
            let file = file.map_err(|e| {
                let path = e.path().to_path_buf();
                Error::io("read", path)(e.into())
            })?;
            if !is_hidden(&file) {
                files.push(file);
            }
        }
        if files.is_empty() {
            return Err(Error::Usage(format!(
                "no file matches '{spec}'; quote the pattern and check its path"
            )));
        }
        match_files(files, false)
    } else {
        return Err(Error::Usage(format!(
            "'{spec}' is no directory, CSV manifest or glob: nothing there by that name"
        )));
    };
    if set.pairs.is_empty() {
        let hint = match set.unmatched.first() {
            Some(unmatched) => unmatched.to_string(),
            None => "a pair is <scene>_<spp>spp.exr and <scene>_ref.exr".into(),
        };
        return Err(Error::Usage(format!("no render pair in '{spec}': {hint}")));
    }
    Ok(set)
}

/// Whether a file's name begins with a dot. Other programs name unfinished files so, and macOS leaves files
/// such as `._room_0004spp.exr` beside a file that it copied.
pub fn is_hidden(file: &Path) -> bool {
    file.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.'))
}

/// What a file name says about a render.
#[derive(Debug, PartialEq, Eq)]
struct Name<'a> {
    scene: &'a str,
    /// `None` for a reference.
    spp: Option<u32>,
    frame: Option<&'a str>,
}

/// Reads `<scene>_<NNNN>spp[.FRAME].exr` or `<scene>_ref[.FRAME].exr`; `None` for any other name.
fn parse_name(file_name: &str) -> Option<Name<'_>> {
    let (stem, extension) = file_name.rsplit_once('.')?;
    if !extension.eq_ignore_ascii_case("exr") {
        return None;
    }
    let (stem, frame) = split_frame(stem);
    let (scene, kind) = stem.rsplit_once('_')?;
    if scene.is_empty() {
        return None;
    }
    if kind == "ref" {
        return Some(Name { scene, spp: None, frame });
    }
    let digits = kind.strip_suffix("spp").filter(|d| all_digits(d))?;
    Some(Name { scene, spp: Some(digits.parse().ok()?), frame })
}

/// Whether a text is a number.
fn all_digits(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit())
}

/// A name without its extension, and the frame behind its last dot. A negative one is written `-0003` by Blender.
fn split_frame(stem: &str) -> (&str, Option<&str>) {
    match stem.rsplit_once('.') {
        Some((rest, frame)) if all_digits(frame.strip_prefix('-').unwrap_or(frame)) => (rest, Some(frame)),
        _ => (stem, None),
    }
}

/// Pairs files by name within their directory. If `report_references`, references without a noisy render are
/// left over: a directory should be complete, while a glob may well pick only some of the noisy renders.
fn match_files(files: impl IntoIterator<Item = PathBuf>, report_references: bool) -> TestSet {
    // Keyed by directory, scene and frame: one reference serves every spp of its view.
    let mut references: BTreeMap<(PathBuf, String, Option<String>), PathBuf> = BTreeMap::new();
    let mut noisy = Vec::new();
    for file in files {
        let Some(name) = file.file_name().and_then(|n| n.to_str()).and_then(parse_name) else { continue };
        let directory = file.parent().unwrap_or(Path::new("")).to_path_buf();
        let (scene, frame) = (name.scene.to_string(), name.frame.map(str::to_string));
        match name.spp {
            None => {
                references.insert((directory, scene, frame), file.clone());
            }
            Some(spp) => noisy.push((directory, scene, frame, spp, file.clone())),
        }
    }
    let mut set = TestSet::default();
    let mut used = BTreeSet::new();
    for (directory, scene, frame, spp, path) in noisy {
        let suffix = frame.as_ref().map(|f| format!(".{f}")).unwrap_or_default();
        let wanted = directory.join(format!("{scene}_ref{suffix}.exr"));
        let key = (directory, scene.clone(), frame.clone());
        let reference = references.get(&key).cloned().or_else(|| wanted.is_file().then(|| wanted.clone()));
        used.extend(reference.clone());
        let is_complete = reference.is_some();
        let pair = Pair { scene, noisy: path, reference: reference.unwrap_or(wanted), spp, frame };
        set.add(pair, is_complete);
    }
    if report_references {
        let unused = references.into_values().filter(|r| !used.contains(r));
        set.unmatched.extend(unused.map(Unmatched::Reference));
    }
    set.finish();
    set
}

impl TestSet {
    /// Every noisy render, sorted as the pairs are. Those without a reference are among them, since a table
    /// must not hide them.
    pub fn all_noisy(&self) -> Vec<Pair> {
        let lacking = self.unmatched.iter().filter_map(|unmatched| match unmatched {
            Unmatched::Noisy(pair) => Some(pair),
            Unmatched::Reference(_) => None,
        });
        let mut pairs: Vec<Pair> = self.pairs.iter().chain(lacking).cloned().collect();
        sort(&mut pairs);
        pairs
    }

    fn add(&mut self, pair: Pair, is_complete: bool) {
        if is_complete {
            self.pairs.push(pair);
        } else {
            self.unmatched.push(Unmatched::Noisy(pair));
        }
    }

    /// Names scenes apart and sorts, once all files are in.
    fn finish(&mut self) {
        self.name_apart();
        self.number_frames();
        sort(&mut self.pairs);
        self.unmatched.sort_by_cached_key(|u| match u {
            Unmatched::Noisy(Pair { noisy: path, .. }) | Unmatched::Reference(path) => path.clone(),
        });
    }

    /// Where a scene has several files, each with a reference of its own, takes the number at the end of a noisy file's
    /// name for the frame's. Noise seeds share a reference.
    fn number_frames(&mut self) {
        let mut references: HashMap<(String, u32), Vec<PathBuf>> = HashMap::new();
        for pair in &self.pairs {
            let of_scene = references.entry((pair.scene.clone(), pair.spp)).or_default();
            of_scene.push(pair.reference.clone());
        }
        let are_frames =
            |all: &Vec<PathBuf>| all.len() > 1 && all.iter().collect::<BTreeSet<_>>().len() == all.len();
        for pair in self.pairs.iter_mut().filter(|pair| pair.frame.is_none()) {
            let stem = pair.noisy.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
            if are_frames(&references[&(pair.scene.clone(), pair.spp)]) {
                pair.frame = split_frame(stem).1.map(str::to_owned);
            }
        }
    }

    /// Adds to the names of scenes that are alike in different folders as much of the folder as tells them apart,
    /// such as `room (day)` and `room (night)`. Noise seeds of one scene share its reference, and so the name.
    fn name_apart(&mut self) {
        let lacking = self.unmatched.iter_mut().filter_map(|unmatched| match unmatched {
            Unmatched::Noisy(pair) => Some(pair),
            Unmatched::Reference(_) => None,
        });
        let mut pairs: Vec<&mut Pair> = self.pairs.iter_mut().chain(lacking).collect();
        let mut folders: HashMap<String, BTreeSet<PathBuf>> = HashMap::new();
        for pair in &pairs {
            folders.entry(pair.scene.clone()).or_default().insert(folder_of(&pair.reference).to_owned());
        }
        for pair in &mut pairs {
            let alike = &folders[&pair.scene];
            if alike.len() > 1 {
                pair.scene =
                    format!("{} ({})", pair.scene, end_of(folder_of(&pair.reference), alike).display());
            }
        }
    }
}

/// The shortest end of a path that none of the others has, or the whole of it.
fn end_of(path: &Path, all: &BTreeSet<PathBuf>) -> PathBuf {
    let end = |path: &Path, length: usize| -> PathBuf {
        let parts = path.components();
        parts.clone().skip(parts.count().saturating_sub(length)).collect()
    };
    let is_unique =
        |length: &usize| all.iter().filter(|other| end(other, *length) == end(path, *length)).count() == 1;
    let length = (1..path.components().count()).find(is_unique);
    length.map_or_else(|| path.to_owned(), |length| end(path, length))
}

/// Sorts by scene, frame number, spp and path. Frames go by number, so that 0099 comes before 0100 and -0001
/// before 0000.
fn sort(pairs: &mut [Pair]) {
    pairs.sort_by_cached_key(|p| {
        let number = p.frame.as_ref().and_then(|f| f.parse::<i64>().ok());
        (p.scene.clone(), number, p.spp, p.noisy.clone())
    });
}

/// A row of a manifest.
#[derive(Deserialize)]
struct ManifestRow {
    scene: String,
    noisy: PathBuf,
    reference: PathBuf,
    spp: u32,
}

/// Reads a CSV manifest. A line whose reference does not exist is unmatched. A line whose noisy file does not
/// exist is kept, so that it fails where the file is read. Lines that say the same count once. Lines that
/// give the same two files another scene or spp are an error, since reports identify a pair by its files.
fn manifest(path: &Path) -> Result<TestSet> {
    let remedy = "a manifest is CSV with the header scene,noisy,reference,spp";
    let mut reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .comment(Some(b'#'))
        .from_path(path)
        .map_err(|e| Error::invalid(path, format!("cannot read the manifest: {e}; {remedy}")))?;
    let directory = path.parent().unwrap_or(Path::new(""));
    let mut set = TestSet::default();
    let mut seen = HashMap::new();
    for row in reader.deserialize::<ManifestRow>() {
        let row = row.map_err(|e| Error::invalid(path, format!("{e}; {remedy}")))?;
        let frame = row
            .noisy
            .file_name()
            .and_then(|n| n.to_str())
            .and_then(parse_name)
            .and_then(|n| n.frame.map(str::to_string));
        let (noisy, reference) = (directory.join(&row.noisy), directory.join(&row.reference));
        let said = (row.scene.clone(), row.spp);
        let place = |file: &Path| std::fs::canonicalize(file).unwrap_or_else(|_| file.to_owned());
        if let Some((before, spp)) = seen.insert((place(&noisy), place(&reference)), said) {
            if (before.as_str(), spp) == (row.scene.as_str(), row.spp) {
                continue;
            }
            return Err(Error::Usage(format!(
                "{}: '{}' lists the same two files as '{before}' before it: {} and {}; take one of the lines out",
                path.display(),
                row.scene,
                noisy.display(),
                reference.display()
            )));
        }
        let is_complete = reference.is_file();
        set.add(Pair { scene: row.scene, noisy, reference, spp: row.spp, frame }, is_complete);
    }
    set.finish();
    Ok(set)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(names: &[&str]) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        for name in names {
            std::fs::write(dir.path().join(name), b"").unwrap();
        }
        dir
    }

    fn ids(set: &TestSet) -> Vec<String> {
        set.pairs.iter().map(Pair::id).collect()
    }

    #[test]
    fn names_follow_the_contract() {
        let name = |scene, spp, frame| Some(Name { scene, spp, frame });
        for (file, expected) in [
            ("bathroom_0004spp.exr", name("bathroom", Some(4), None)),
            ("bathroom_4spp.EXR", name("bathroom", Some(4), None)),
            ("bathroom_ref.exr", name("bathroom", None, None)),
            ("shot_0016spp.0017.exr", name("shot", Some(16), Some("0017"))),
            ("shot_ref.-0003.exr", name("shot", None, Some("-0003"))),
            ("a_b.c_12_ref.exr", name("a_b.c_12", None, None)),
            ("bathroom.exr", None),
            ("_ref.exr", None),
            ("bathroom_spp.exr", None),
            ("bathroom_+4spp.exr", None),
            ("bathroom_99999999999spp.exr", None),
            ("bathroom_ref.png", None),
        ] {
            assert_eq!(parse_name(file), expected, "{file}");
        }
    }

    #[test]
    fn directory_gives_each_spp_and_frame_in_order() {
        let dir = folder(&[
            "b_0016spp.exr",
            "b_0004spp.exr",
            "b_ref.exr",
            "a_0004spp.0100.exr",
            "a_0004spp.0099.exr",
            "a_ref.0099.exr",
            "a_ref.0100.exr",
            "notes.txt",
        ]);
        let set = read(dir.path().to_str().unwrap()).unwrap();
        assert_eq!(ids(&set), ["a_0004spp.0099", "a_0004spp.0100", "b_0004spp", "b_0016spp"]);
        assert_eq!(set.pairs[0].reference, dir.path().join("a_ref.0099.exr"));
        assert_eq!(set.pairs[3].reference, dir.path().join("b_ref.exr"));
        assert!(set.unmatched.is_empty());
    }

    #[test]
    fn a_file_without_counterpart_is_named() {
        let dir = folder(&[
            "a_0004spp.exr",
            "a_ref.exr",
            "b_0004spp.exr",
            "c_ref.exr",
            "d_0004spp.0001.exr",
            "d_ref.exr",
        ]);
        let set = read(dir.path().to_str().unwrap()).unwrap();
        assert_eq!(ids(&set), ["a_0004spp"]);
        let lines: Vec<_> = set.unmatched.iter().map(|u| u.to_string()).collect();
        assert_eq!(lines.len(), 4);
        assert!(lines[0].contains("b_0004spp.exr") && lines[0].contains("b_ref.exr"), "{}", lines[0]);
        assert!(lines[1].contains("c_ref.exr"), "{}", lines[1]);
        assert!(lines[2].contains("d_ref.0001.exr"), "a still reference is not a frame's: {}", lines[2]);
        assert!(lines[3].contains("d_ref.exr"), "{}", lines[3]);
        let all: Vec<_> = set.all_noisy().iter().map(Pair::id).collect();
        assert_eq!(all, ["a_0004spp", "b_0004spp", "d_0004spp.0001"]);
    }

    #[test]
    fn glob_finds_references_beside_the_noisy_files_it_picks() {
        let dir = folder(&[
            "a_0004spp.exr",
            "a_0016spp.exr",
            "a_ref.exr",
            "b_0004spp.exr",
            "b_ref.exr",
            "c_ref.exr",
        ]);
        let set = read(&format!("{}/*_0004spp.exr", dir.path().display())).unwrap();
        assert_eq!(ids(&set), ["a_0004spp", "b_0004spp"]);
        let set = read(&format!("{}/*.exr", dir.path().display())).unwrap();
        assert_eq!(ids(&set), ["a_0004spp", "a_0016spp", "b_0004spp"]);
        assert!(set.unmatched.is_empty());
        let set = read(dir.path().join("b_0004spp.exr").to_str().unwrap()).unwrap();
        assert_eq!(ids(&set), ["b_0004spp"]);
    }

    #[test]
    fn scenes_of_one_name_are_told_apart_by_their_folders() {
        let dir = tempfile::tempdir().unwrap();
        let files = ["a_0004spp.exr", "a_0016spp.exr", "a_ref.exr", "b_0004spp.exr", "b_ref.exr"];
        for (folder, count) in [("day/main", 5), ("night/main", 3), ("night/wide", 2)] {
            let folder = dir.path().join(folder);
            std::fs::create_dir_all(&folder).unwrap();
            files[..count].iter().for_each(|file| std::fs::write(folder.join(file), b"").unwrap());
        }
        let set = read(&format!("{}/*/*/*.exr", dir.path().display())).unwrap();
        let expected = [
            "a (day/main)_0004spp",
            "a (day/main)_0016spp",
            "a (night/main)_0004spp",
            "a (night/main)_0016spp",
        ];
        assert_eq!(ids(&set), [&expected[..], &["b_0004spp"]].concat());
        let lacking =
            set.all_noisy().iter().map(|pair| pair.scene.clone()).filter(|s| s == "a (wide)").count();
        assert_eq!(lacking, 2, "those without a reference too: {:?}", set.unmatched);
        // Noise seeds that share a reference are one scene.
        let manifest = dir.path().join("set.csv");
        let text = "scene,noisy,reference,spp\nx,day/main/a_0004spp.exr,day/main/a_ref.exr,4\n\
                    x,night/main/a_0004spp.exr,day/main/a_ref.exr,4\n";
        std::fs::write(&manifest, text).unwrap();
        assert_eq!(ids(&read(manifest.to_str().unwrap()).unwrap()), ["x_0004spp", "x_0004spp"]);
    }

    #[test]
    fn hidden_files_are_passed_over() {
        let dir = folder(&["a_0004spp.exr", "a_ref.exr", "._a_0004spp.exr", "._a_ref.exr", ".b_0004spp.exr"]);
        for pattern in ["", "*_0004spp.exr", "*.exr"] {
            let set = read(dir.path().join(pattern).to_str().unwrap()).unwrap();
            assert_eq!(ids(&set), ["a_0004spp"], "'{pattern}'");
            assert!(set.unmatched.is_empty(), "'{pattern}': {:?}", set.unmatched);
        }
    }

    #[test]
    fn manifest_paths_are_relative_to_it() {
        let dir = folder(&["x.exr", "y.exr", "s_0008spp.0002.exr"]);
        let file = dir.path().join("set.csv");
        let text = "scene,noisy,reference,spp\n# comment\nz,x.exr,y.exr,4\ns, s_0008spp.0002.exr ,y.exr,8\nq,x.exr,gone.exr,4\n";
        std::fs::write(&file, text).unwrap();
        let set = read(file.to_str().unwrap()).unwrap();
        assert_eq!(ids(&set), ["s_0008spp.0002", "z_0004spp"]);
        assert_eq!(set.pairs[1].noisy, dir.path().join("x.exr"));
        assert!(set.unmatched[0].to_string().contains("gone.exr"));
    }

    #[test]
    fn frames_of_a_manifest_have_references_of_their_own_and_noise_seeds_share_one() {
        let names = ["beauty.1.exr", "beauty.2.exr", "clean.1.exr", "clean.2.exr"];
        let dir = folder(&names);
        for inner in ["day", "night"] {
            std::fs::create_dir(dir.path().join(inner)).unwrap();
            names.iter().for_each(|name| std::fs::write(dir.path().join(inner).join(name), b"").unwrap());
        }
        let frames = |lines: &str| {
            let file = dir.path().join("set.csv");
            std::fs::write(&file, format!("scene,noisy,reference,spp\n{lines}")).unwrap();
            let set = read(file.to_str().unwrap()).unwrap();
            set.pairs.into_iter().map(|pair| pair.frame).collect::<Vec<_>>()
        };
        let numbers = [Some("1".to_owned()), Some("2".to_owned())];
        assert_eq!(frames("s,beauty.1.exr,clean.1.exr,4\ns,beauty.2.exr,clean.2.exr,4\n"), numbers);
        let seeds = "s,day/beauty.1.exr,day/clean.1.exr,4\ns,day/beauty.2.exr,day/clean.1.exr,4\n";
        assert_eq!(frames(seeds), [None, None]);
        let more = format!("{seeds}s,night/beauty.1.exr,night/clean.1.exr,4\n");
        assert_eq!(frames(&more), [None, None, None], "another folder changes nothing");
    }

    #[test]
    fn files_listed_twice_are_an_error_that_names_both_scenes() {
        let dir = folder(&["x.exr", "y.exr", "z.exr"]);
        let file = dir.path().join("set.csv");
        let list = |lines: &str| {
            std::fs::write(&file, format!("scene,noisy,reference,spp\n{lines}")).unwrap();
            read(file.to_str().unwrap())
        };
        for twice in
            ["a,x.exr,y.exr,4\n# comment\nb,./x.exr,y.exr,8\n", "a,x.exr,gone.exr,4\n\nb,x.exr,gone.exr,4\n"]
        {
            let Err(Error::Usage(message)) = list(twice) else { panic!("{twice}") };
            for part in ["set.csv: 'b'", "as 'a'", "x.exr", "take one"] {
                assert!(message.contains(part), "{message}");
            }
        }
        assert_eq!(
            list("a,x.exr,y.exr,4\na,z.exr,y.exr,4\n").unwrap().pairs.len(),
            2,
            "one reference for two"
        );
        assert_eq!(list("a,x.exr,y.exr,4\na,./x.exr,y.exr,4\n").unwrap().pairs.len(), 1, "said twice");
    }

    #[test]
    fn errors_name_the_file_and_the_remedy() {
        let dir = folder(&["a_0004spp.exr"]);
        let at = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
        std::fs::write(at("bad.csv"), "scene,noisy\na,b\n").unwrap();
        std::fs::write(at("spp.csv"), "scene,noisy,reference,spp\na,b,c,many\n").unwrap();
        for (spec, expected) in [
            (at(""), "a_ref.exr is missing"),
            (at("nothing"), "nothing there by that name"),
            (at("*.tif"), "no file matches"),
            (at("***"), "not a valid glob"),
            (at("bad.csv"), "scene,noisy,reference,spp"),
            (at("spp.csv"), "scene,noisy,reference,spp"),
        ] {
            let message = read(&spec).unwrap_err().to_string();
            assert!(message.contains(expected), "{spec}: {message}");
            assert!(!message.contains('\n'), "{message}");
        }
    }
}
