//! Files that a renderer is still writing: each is taken when it is whole.
//!
//! A file is whole when its size and its time of change stayed the same from one look to the next, and it
//! then reads as a complete EXR: its offset table is filled in, which OpenEXR does last, and every block of
//! pixels in the table ends within the file. A file that does not yet read as whole waits for its next
//! change. Folders are looked through again and again, since the disk of another machine sends no message of
//! a change.

use std::{
    collections::{BTreeMap, VecDeque},
    fs,
    path::{Path, PathBuf},
    sync::{Mutex, MutexGuard, PoisonError},
    thread,
    time::{Duration, Instant, SystemTime},
};

use super::{Job, batch::End};
use crate::{Error, frame::Frame};

/// Time from one look to the next, at least.
const INTERVAL: Duration = Duration::from_secs(1);

/// The pause after a look is at least this many times as long as the look, so that a large folder on a slow
/// disk is looked through less often.
const LOOKING: u32 = 10;

/// A file that did not read as whole is tried again after this time even if it shows no change: some disks
/// count the time of change in steps of two seconds, which can hide the last write.
const RETRY: Duration = Duration::from_secs(10);

/// What one look found.
#[derive(Default)]
pub struct Look {
    /// All jobs, including those whose files are not whole yet.
    pub jobs: Vec<Job>,
    /// Inputs that cannot be denoised, each with the reason; each is told once.
    pub failures: Vec<(PathBuf, Error)>,
    /// Inputs that name no file yet, each with the reason, which is told in the end if none ever came.
    pub empty: Vec<(PathBuf, Error)>,
}

/// Looks for files until none has come for a while.
pub struct Watch {
    look: Mutex<Box<dyn FnMut() -> Look + Send>>,
    /// It ends when nothing was new for this long; if none, never.
    idle: Option<Duration>,
    /// Whether a file that was taken is taken again when it has changed.
    again: bool,
    state: Mutex<State>,
}

struct State {
    files: BTreeMap<PathBuf, File>,
    ready: VecDeque<Job>,
    /// Inputs whose failures were taken in, so that each is told once, and failures that are still to be
    /// told.
    told: Vec<PathBuf>,
    failures: Vec<(PathBuf, Error)>,
    /// Inputs that have named no file in any look; none before the first.
    empty: Option<Vec<(PathBuf, Error)>>,
    /// When a file was last new or had changed.
    changed: Instant,
}

struct File {
    job: Job,
    /// None where there is no such file yet.
    stamp: Option<Stamp>,
    status: Status,
}

/// What changes when a file is written.
#[derive(Clone, Copy, PartialEq, Eq)]
struct Stamp {
    bytes: u64,
    modified: Option<SystemTime>,
}

enum Status {
    /// It may still be written.
    Coming,
    /// It was taken.
    Taken,
    /// It was taken and did not read as a whole file.
    Broken(Error, Instant),
}

/// What a watch has next.
pub(super) enum Next {
    /// A file that stayed the same since the last look.
    Job(Job),
    /// An input that cannot be denoised, and why.
    Failure(PathBuf, Error),
    /// Nothing was new for the time given, or the watch was told to stop.
    End,
}

impl Watch {
    /// Looks for files by `look`, and ends when none was new for the time `idle`, or never without that time.
    /// If `again`, a file that was taken and has changed, as one that was rendered again, is taken again.
    pub fn new(look: impl FnMut() -> Look + Send + 'static, idle: Option<Duration>, again: bool) -> Self {
        let (files, ready, told, failures, empty) = Default::default();
        let state = Mutex::new(State { files, ready, told, failures, empty, changed: Instant::now() });
        Self { look: Mutex::new(Box::new(look)), idle, again, state }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The next file that is likely to be whole; waits for it, as long as it is not told to stop.
    pub(super) fn next(&self, is_stopped: impl Fn() -> bool) -> Next {
        let mut look = self.look.lock().unwrap_or_else(PoisonError::into_inner);
        let mut pause = Duration::ZERO;
        loop {
            {
                let mut state = self.state();
                if let Some((path, error)) = state.failures.pop() {
                    return Next::Failure(path, error);
                }
                if let Some(job) = state.ready.pop_front() {
                    return Next::Job(job);
                }
            }
            if !pause.is_zero() && !wait(pause, &is_stopped) {
                return Next::End;
            }
            let start = Instant::now();
            let found = look();
            let mut state = self.state();
            state.take_in(found, self.again);
            pause = INTERVAL.max(LOOKING * start.elapsed());
            let is_idle = self.idle.is_some_and(|idle| state.changed.elapsed() >= idle);
            if is_idle && state.ready.is_empty() && state.failures.is_empty() {
                return Next::End;
            }
        }
    }

    /// Takes back a file that did not read as whole.
    pub(super) fn put_back(&self, input: &Path, error: Error) {
        if let Some(file) = self.state().files.get_mut(input) {
            file.status = Status::Broken(error, Instant::now());
        }
    }

    /// The files that never became whole, each with the error of reading it, and inputs for which none came. Those
    /// that were changing, or still to come, when the watch was stopped do not count.
    pub(super) fn leftovers(&self, end: End) -> Vec<(Job, Error)> {
        let (files, empty) = {
            let mut state = self.state();
            (std::mem::take(&mut state.files).into_values(), state.empty.take().unwrap_or_default())
        };
        let empty = empty.into_iter().filter(|_| end == End::Complete);
        let empty = empty.map(|(input, error)| (Job { input, output: PathBuf::new() }, error));
        let unfinished = |file: File| match file.status {
            Status::Taken => None,
            Status::Broken(error, _) => Some((file.job, error)),
            Status::Coming if end == End::Stopped => None,
            Status::Coming => Frame::read(&file.job.input).err().map(|error| (file.job, error)),
        };
        files.filter_map(unfinished).chain(empty).collect()
    }
}

impl State {
    fn take_in(&mut self, found: Look, again: bool) {
        for (path, error) in found.failures {
            if !self.told.contains(&path) {
                self.told.push(path.clone());
                self.failures.push((path, error));
            }
        }
        match &mut self.empty {
            None => self.empty = Some(found.empty),
            Some(empty) => empty.retain(|(path, _)| found.empty.iter().any(|(now, _)| now == path)),
        }
        let mut before = std::mem::take(&mut self.files);
        for job in found.jobs {
            let stamp = Stamp::of(&job.input);
            let mut file = before.remove(&job.input).unwrap_or_else(|| {
                self.changed = Instant::now();
                File { job: job.clone(), stamp: None, status: Status::Coming }
            });
            let is_same = file.stamp == stamp;
            match file.status {
                Status::Taken if is_same || !again => {}
                _ if !is_same => {
                    self.changed = Instant::now();
                    (file.stamp, file.status) = (stamp, Status::Coming);
                }
                Status::Broken(_, tried) if tried.elapsed() < RETRY => {}
                // Blender makes empty files to say that a frame is being rendered.
                _ if stamp.is_some_and(|stamp| stamp.bytes > 0) => {
                    file.status = Status::Taken;
                    self.ready.push_back(job);
                }
                _ => {}
            }
            self.files.insert(file.job.input.clone(), file);
        }
        // What was taken and is away for a moment, as on a network drive, is not new when it is back.
        self.files.extend(before.into_iter().filter(|(_, file)| matches!(file.status, Status::Taken)));
    }
}

impl Stamp {
    fn of(path: &Path) -> Option<Self> {
        let file = fs::metadata(path).ok()?;
        Some(Self { bytes: file.len(), modified: file.modified().ok() })
    }
}

/// Waits for that time; returns false if it was told to stop meanwhile.
fn wait(time: Duration, is_stopped: &impl Fn() -> bool) -> bool {
    const STEP: Duration = Duration::from_millis(50);
    let start = Instant::now();
    while start.elapsed() < time {
        if is_stopped() {
            return false;
        }
        thread::sleep(STEP.min(time));
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    /// A folder for one file that is not there yet, and a watch over it.
    struct Scene {
        folder: tempfile::TempDir,
        watch: Arc<Watch>,
    }

    impl Scene {
        fn new(again: bool) -> Self {
            let folder = tempfile::tempdir().unwrap();
            let job = Job { input: folder.path().join("a.exr"), output: PathBuf::new() };
            let look = move || Look { jobs: vec![job.clone()], ..Look::default() };
            let watch = Arc::new(Watch::new(look, Some(Duration::from_millis(2500)), again));
            Self { folder, watch }
        }

        fn write(&self, bytes: &[u8]) {
            fs::write(self.folder.path().join("a.exr"), bytes).unwrap();
        }

        fn is_taken(&self) -> bool {
            matches!(self.watch.next(|| false), Next::Job(_))
        }
    }

    #[test]
    fn a_file_is_taken_when_it_stayed_the_same_and_again_when_it_changed() {
        let scene = Scene::new(true);
        scene.write(b"a");
        assert!(scene.is_taken());
        scene.write(b"ab");
        assert!(scene.is_taken());
        assert!(!scene.is_taken(), "nothing is new");
        let once = Scene::new(false);
        once.write(b"a");
        assert!(once.is_taken());
        once.write(b"ab");
        assert!(!once.is_taken(), "what was taken stays taken");
    }

    #[test]
    fn a_file_that_did_not_read_whole_waits_for_its_next_change() {
        let scene = Scene::new(false);
        scene.write(b"a");
        assert!(scene.is_taken());
        let broken = || Error::invalid("a.exr", "is truncated");
        scene.watch.put_back(&scene.folder.path().join("a.exr"), broken());
        scene.write(b"abc");
        assert!(scene.is_taken());
        scene.watch.put_back(&scene.folder.path().join("a.exr"), broken());
        assert!(!scene.is_taken());
        let [(job, error)] = &scene.watch.leftovers(End::Complete)[..] else { panic!() };
        assert!(job.input.ends_with("a.exr") && error.to_string().contains("truncated"), "{error}");
    }

    #[test]
    fn empty_and_missing_files_are_waited_for_and_told_of_in_the_end() {
        let scene = Scene::new(false);
        assert!(!scene.is_taken());
        assert!(scene.watch.leftovers(End::Complete)[0].1.to_string().contains("cannot read"));
        let scene = Scene::new(false);
        scene.write(b"");
        assert!(!scene.is_taken());
        assert!(scene.watch.leftovers(End::Complete)[0].1.to_string().contains("is empty"));
    }

    #[test]
    fn a_file_that_is_away_for_a_moment_is_not_taken_again() {
        let folder = tempfile::tempdir().unwrap();
        let job = Job { input: folder.path().join("a.exr"), output: PathBuf::new() };
        fs::write(&job.input, "a").unwrap();
        let looks = std::sync::atomic::AtomicUsize::new(0);
        let look = move || {
            let is_there = looks.fetch_add(1, std::sync::atomic::Ordering::Relaxed) != 3;
            Look { jobs: is_there.then(|| job.clone()).into_iter().collect(), ..Look::default() }
        };
        let watch = Watch::new(look, Some(Duration::from_millis(6500)), true);
        let taken = std::iter::from_fn(|| matches!(watch.next(|| false), Next::Job(_)).then_some(()));
        assert_eq!(taken.count(), 1);
    }

    #[test]
    fn a_failure_is_told_once() {
        let look = || Look { failures: vec![("a".into(), Error::Usage("no".into()))], ..Look::default() };
        let watch = Watch::new(look, Some(INTERVAL), false);
        assert!(matches!(watch.next(|| false), Next::Failure(path, _) if path.ends_with("a")));
        assert!(matches!(watch.next(|| false), Next::End));
    }
}
