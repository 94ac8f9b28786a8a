//! Which files are frames of one sequence, by name and number, and the frames around one.
//!
//! In: paths. A frame's number is the digits at the end of its name, of any width, as Blender writes it
//! before the extension: `shot_0004spp.0017.exr`, `shot0017.exr`, `shot.-0003.exr`. Neighbours are looked for
//! in the frame's folder, whether the user named them or not: a result depends on the files that lie there,
//! not on what else the same command denoises.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    sync::Arc,
};

use super::Job;
use crate::frame_number::split;

/// What the names of a sequence's frames have in common.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Key {
    folder: PathBuf,
    // Bytes, since a name need not be UTF-8.
    before: Vec<u8>,
    after: Vec<u8>,
}

/// A frame's place in its sequence.
struct Place {
    key: Key,
    number: i64,
}

impl Place {
    /// The place of a file; none where its name does not end in a number.
    fn of(file: &Path) -> Option<Self> {
        let (name, stem) = (file.file_name()?, file.file_stem()?);
        let readable = stem.to_string_lossy();
        let (head, number, eye) = split(&readable)?;
        // What comes after the head has as many bytes in the name itself.
        let (stem, name) = (stem.as_encoded_bytes(), name.as_encoded_bytes());
        let before = stem[..stem.len() - (readable.len() - head.len())].to_vec();
        let after = name[stem.len() - eye.len()..].to_vec();
        Some(Self { key: Key { folder: file.parent()?.to_owned(), before, after }, number })
    }

    /// All frames of the sequence that lie on disk, by number; of those that share a number, the first by
    /// name.
    fn siblings(&self) -> BTreeMap<i64, PathBuf> {
        let own = &self.key.folder;
        let folder = if own.as_os_str().is_empty() { Path::new(".") } else { own };
        let mut found: BTreeMap<i64, PathBuf> = BTreeMap::new();
        // A folder that cannot be listed shows no neighbours, and reading the frame itself says why.
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            let path = own.join(entry.file_name());
            let Some(place) = Self::of(&path).filter(|place| place.key == self.key) else { continue };
            let at = found.entry(place.number).or_insert_with(|| path.clone());
            if path < *at {
                *at = path;
            }
        }
        found
    }
}

/// Whether a file is the frame right after another, by their names.
pub fn follows(file: &Path, before: &Path) -> bool {
    let [Some(place), Some(before)] = [file, before].map(Place::of) else { return false };
    place.key == before.key && place.number - before.number == 1
}

/// The other files of a frame's sequence in its folder, from `reach` frames before it to `reach` frames after
/// it. Keys tell how many frames later each is; negative ones are earlier.
pub fn neighbours(file: &Path, reach: usize) -> BTreeMap<i32, PathBuf> {
    let Some(place) = Place::of(file).filter(|_| reach > 0) else { return BTreeMap::new() };
    let offset = |number: i64| i32::try_from(number - place.number).ok();
    let near = |offset: i32| offset != 0 && offset.unsigned_abs() as usize <= reach;
    let files = place.siblings().into_iter();
    files.filter_map(|(number, path)| Some((offset(number).filter(|at| near(*at))?, path))).collect()
}

/// Jobs of one sequence, sorted by number, or a single job without a number.
pub struct Stretch {
    /// All files of the sequence on disk, by number. The jobs' own files stand at their numbers.
    pub files: Arc<BTreeMap<i64, PathBuf>>,
    /// Each job, and its number.
    pub jobs: Vec<(Job, i64)>,
    /// Whether the names of its files end in a number.
    pub is_numbered: bool,
}

impl Stretch {
    /// Splits the jobs into at most `count` stretches of about the same length.
    pub fn split(self, count: usize) -> Vec<Self> {
        let Self { files, jobs, is_numbered } = self;
        let length = jobs.len().div_ceil(count).max(1);
        let stretch =
            |jobs: &[(Job, i64)]| Self { files: Arc::clone(&files), jobs: jobs.to_vec(), is_numbered };
        jobs.chunks(length).map(stretch).collect()
    }
}

/// The sequences that jobs belong to, in the order of their first jobs.
pub fn group(jobs: Vec<Job>) -> Vec<Stretch> {
    let mut sequences: Vec<Stretch> = Vec::new();
    let mut known: BTreeMap<Key, usize> = BTreeMap::new();
    for job in jobs {
        let place = Place::of(&job.input);
        let number = place.as_ref().map_or(0, |place| place.number);
        // Two files with the same number, such as 7 and 0007, are put into two sequences, so that neither
        // hides the other. One of them is what other frames have for a neighbour, whatever is denoised.
        let is_sibling = |at: &usize| sequences[*at].files.get(&number).is_none_or(|file| *file == job.input);
        let is_new = |at: &usize| sequences[*at].jobs.iter().all(|(_, other)| *other != number);
        let at = place.as_ref().and_then(|place| known.get(&place.key)).copied();
        let at = at.filter(|at| is_sibling(at) && is_new(at)).unwrap_or_else(|| {
            let files = Arc::new(place.as_ref().map(Place::siblings).unwrap_or_default());
            sequences.push(Stretch { files, jobs: Vec::new(), is_numbered: place.is_some() });
            let at = sequences.len() - 1;
            let is_sibling = sequences[at].files.get(&number).is_none_or(|file| *file == job.input);
            if let Some(place) = place.filter(|_| is_sibling) {
                known.entry(place.key).or_insert(at);
            }
            at
        });
        Arc::make_mut(&mut sequences[at].files).insert(number, job.input.clone());
        sequences[at].jobs.push((job, number));
    }
    sequences.iter_mut().for_each(|sequence| sequence.jobs.sort_by_key(|(_, number)| *number));
    sequences
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jobs_are_sequences_with_all_that_lies_beside_them() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["a.0009.exr", "a.0010.exr", "a.0012.exr", "a.11.exr", "a.012.exr", "b.0010.exr", "c.exr"]
        {
            fs::write(dir.path().join(name), "").unwrap();
        }
        let job = |name: &str| Job { input: dir.path().join(name), output: PathBuf::new() };
        let jobs = ["a.0012.exr", "b.0010.exr", "c.exr", "a.0009.exr", "a.012.exr"].map(job);
        let index = |job: &Job| jobs.iter().position(|other| other == job).unwrap();
        let sequences = group(jobs.to_vec());
        let listed: Vec<_> = sequences
            .iter()
            .map(|s| {
                let of_jobs: Vec<_> = s.jobs.iter().map(|(job, number)| (index(job), *number)).collect();
                (of_jobs, s.files.keys().copied().collect::<Vec<_>>(), s.is_numbered)
            })
            .collect();
        assert_eq!(
            listed,
            [
                (vec![(3, 9), (0, 12)], vec![9, 10, 11, 12], true),
                (vec![(1, 10)], vec![10], true),
                (vec![(2, 0)], vec![0], false),
                (vec![(4, 12)], vec![9, 10, 11, 12], true),
            ]
        );
        assert!(sequences[0].files[&12].ends_with("a.0012.exr"));
        assert!(sequences[3].files[&12].ends_with("a.012.exr"));
    }

    #[test]
    fn each_eye_has_neighbours_of_its_own() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["e_0001_L.exr", "e_0001_R.exr", "e_0002_L.exr", "e_0002_R.exr", "e_0003_left.exr"] {
            fs::write(dir.path().join(name), "").unwrap();
        }
        let found = neighbours(&dir.path().join("e_0002_L.exr"), 1);
        assert_eq!(found, BTreeMap::from([(-1, dir.path().join("e_0001_L.exr"))]));
    }

    #[test]
    fn stretches_of_a_sequence_are_alike_long_and_hold_each_job_once() {
        let jobs = |count: i64| {
            let job = |n| (Job { input: format!("a.{n}.exr").into(), output: PathBuf::new() }, n);
            Stretch { files: Arc::default(), jobs: (0..count).map(job).collect(), is_numbered: true }
        };
        let lengths = |count: i64, lanes: usize| {
            let stretches = jobs(count).split(lanes);
            let numbers: Vec<i64> = stretches.iter().flat_map(|s| s.jobs.iter().map(|(_, n)| *n)).collect();
            assert_eq!(numbers, (0..count).collect::<Vec<_>>());
            stretches.iter().map(|s| s.jobs.len()).collect::<Vec<_>>()
        };
        assert_eq!(lengths(7, 3), [3, 3, 1]);
        assert_eq!(lengths(2, 3), [1, 1]);
        assert_eq!(lengths(5, 1), [5]);
        assert_eq!(lengths(0, 2), [0usize; 0]);
    }
}
