//! The batch: reading the next frame, denoising this one and writing the last overlap, so that a batch
//! takes about as long as the model does. At most three frames are in memory, and of a sequence its window besides.
//!
//! The threads report to the caller's thread, which alone talks to the user.

use std::{
    collections::HashMap,
    ffi::OsString,
    fs,
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, PoisonError,
        mpsc::{Receiver, Sender, SyncSender, channel, sync_channel},
    },
    thread,
};

use super::{
    Job, Options, Report, Views,
    job::{self, Denoised},
    sequence::{self, Sequence},
    window::Window,
};
use crate::{Error, Result, error::attempt, models::Denoiser, shot::Shot};

/// What became of one file.
pub enum Outcome {
    /// Written.
    Done(Report),
    /// The result was there already.
    Skipped,
    /// Nothing was written.
    Failed(Error),
}

/// How the batch ended.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum End {
    /// Every file was tried.
    Complete,
    /// The user stopped it.
    Stopped,
}

/// What the batch's thread is told.
enum Message {
    /// A file, by its number, has ended.
    Ended(usize, Outcome),
    Stop,
}

/// Frames that one model is to denoise.
pub struct Batch {
    shared: Arc<Shared>,
    messages: Receiver<Message>,
    to_batch: Sender<Message>,
}

/// What the stages share.
struct Shared {
    jobs: Vec<Job>,
    model: Arc<dyn Denoiser>,
    options: Options,
    /// Held while a file is being written, and for good once the user has asked to stop.
    writing: Mutex<()>,
}

/// Ends a batch before all is done, from any thread.
#[derive(Clone)]
pub struct Stopper(Sender<Message>);

impl Stopper {
    /// A file that is being written is finished, no other is begun. Does nothing once the batch has ended.
    pub fn stop(&self) {
        let _ = self.0.send(Message::Stop);
    }
}

impl Batch {
    /// A batch that waits to be [run](Batch::run).
    pub fn new(jobs: Vec<Job>, model: Arc<dyn Denoiser>, options: Options) -> Self {
        let (to_batch, messages) = channel();
        let shared = Arc::new(Shared { jobs, model, options, writing: Mutex::new(()) });
        Self { shared, messages, to_batch }
    }

    /// What stops it.
    pub fn stopper(&self) -> Stopper {
        Stopper(self.to_batch.clone())
    }

    /// Runs all jobs; `report` is called once for each as it ends, on this thread.
    ///
    /// # Panics
    /// If the system has no room for three threads.
    pub fn run(self, mut report: impl FnMut(&Job, &Outcome)) -> End {
        let Self { shared, messages, to_batch } = self;
        // Rendezvous channels: a stage holds its frame until the next one is free to take it.
        let (to_denoise, loaded) = sync_channel(0);
        let (to_store, denoised) = sync_channel(0);
        spawn("read", &shared, &to_batch, move |shared, ended| load_all(shared, &to_denoise, ended));
        spawn("denoise", &shared, &to_batch, move |shared, ended| {
            denoise_all(shared, &loaded, &to_store, ended)
        });
        spawn("write", &shared, &to_batch, move |shared, ended| store_all(shared, &denoised, ended));

        for _ in 0..shared.jobs.len() {
            match messages.recv().expect("its own sender lives") {
                Message::Ended(index, outcome) => report(&shared.jobs[index], &outcome),
                Message::Stop => {
                    // Let a file being written come to its end and no other begin; the process may then end
                    // without waiting for the model.
                    let gate = shared.writing.lock().unwrap_or_else(PoisonError::into_inner);
                    std::mem::forget(gate);
                    while let Ok(Message::Ended(index, outcome)) = messages.try_recv() {
                        report(&shared.jobs[index], &outcome);
                    }
                    return End::Stopped;
                }
            }
        }
        End::Complete
    }
}

/// The jobs that write each file's result into a folder, under the file's own name.
///
/// # Errors
/// Two results would have one path, or one that of its input.
pub fn plan(files: Vec<PathBuf>, out: &Path) -> Result<Vec<Job>> {
    let mut by_name: HashMap<OsString, PathBuf> = HashMap::new();
    let mut jobs = Vec::with_capacity(files.len());
    for input in files {
        let Some(name) = input.file_name() else {
            return Err(Error::Usage(format!("{}: names no file", input.display())));
        };
        if let Some(other) = by_name.insert(name.to_owned(), input.clone()) {
            return Err(Error::Usage(format!(
                "{} and {} would both be written to {}; give each its own --out",
                other.display(),
                input.display(),
                out.join(name).display()
            )));
        }
        let output = out.join(name);
        if is_same_file(&input, &output) {
            return Err(Error::Usage(format!(
                "{}: the result would overwrite its input; choose another --out",
                input.display()
            )));
        }
        jobs.push(Job { input, output });
    }
    Ok(jobs)
}

/// Whether two paths lead to one file: folders may be mounted twice, so that where they are on the disk decides.
fn is_same_file(a: &Path, b: &Path) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        let place = |path| fs::metadata(path).map(|file| (file.dev(), file.ino()));
        matches!((place(a), place(b)), (Ok(a), Ok(b)) if a == b)
    }
    #[cfg(not(unix))]
    {
        matches!((fs::canonicalize(a), fs::canonicalize(b)), (Ok(a), Ok(b)) if a == b)
    }
}

fn spawn(
    name: &str,
    shared: &Arc<Shared>,
    ended: &Sender<Message>,
    stage: impl FnOnce(&Shared, &Sender<Message>) + Send + 'static,
) {
    let (shared, ended) = (Arc::clone(shared), ended.clone());
    thread::Builder::new()
        .name(name.into())
        .spawn(move || stage(&shared, &ended))
        .expect("the system has room for three threads");
}

/// What the reading stage has for the one that denoises.
enum Loaded {
    /// What was read of a frame that is denoised by itself.
    Frame(usize, Result<Views<Shot>>),
    /// A sequence begins: forget the one before.
    Begin,
    /// What was read of a frame of the sequence, by its number, and whether it is to be denoised.
    Neighbour { number: i64, loaded: Result<Views<Shot>>, is_written: bool },
    /// All that lies around a frame has been read.
    Complete { index: usize, number: i64 },
}

fn load_all(shared: &Shared, next: &SyncSender<Loaded>, ended: &Sender<Message>) {
    if let Some(reach) = shared.options.temporal {
        for sequence in sequence::group(&shared.jobs) {
            if load_sequence(shared, &sequence, reach, next, ended).is_none() {
                return;
            }
        }
        return;
    }
    for (index, job) in shared.jobs.iter().enumerate() {
        if take_up_existing(shared, index, ended) {
            continue;
        }
        if next.send(Loaded::Frame(index, read(shared, &job.input))).is_err() {
            return;
        }
    }
}

/// Reads the frames of a sequence that are to be denoised, and those around them, each once; none when there is no next
/// stage.
fn load_sequence(
    shared: &Shared,
    sequence: &Sequence,
    reach: usize,
    next: &SyncSender<Loaded>,
    ended: &Sender<Message>,
) -> Option<()> {
    let open: Vec<(usize, i64)> =
        sequence.jobs.iter().copied().filter(|(index, _)| !take_up_existing(shared, *index, ended)).collect();
    if !sequence.is_numbered {
        for (index, _) in open {
            let mut frame = read(shared, &shared.jobs[index].input);
            if let Ok(frame) = &mut frame {
                frame.say("its name ends in no frame number; denoised alone");
            }
            next.send(Loaded::Frame(index, frame)).ok()?;
        }
        return Some(());
    }
    next.send(Loaded::Begin).ok()?;
    let mut unread = i64::MIN;
    for &(index, number) in &open {
        let (first, last) = (number.saturating_sub(reach as i64), number.saturating_add(reach as i64));
        for (&number, file) in sequence.files.range(first.max(unread)..=last) {
            let is_written = open.iter().any(|(_, written)| *written == number);
            next.send(Loaded::Neighbour { number, loaded: read(shared, file), is_written }).ok()?;
        }
        unread = last.saturating_add(1);
        next.send(Loaded::Complete { index, number }).ok()?;
    }
    Some(())
}

fn read(shared: &Shared, input: &Path) -> Result<Views<Shot>> {
    attempt(input, || job::load(input, &*shared.model, &shared.options))
}

/// Whether the result of a job was there already; what became of that is reported.
fn take_up_existing(shared: &Shared, index: usize, ended: &Sender<Message>) -> bool {
    let output = &shared.jobs[index].output;
    let existing = if shared.options.overwrite { None } else { job::existing(output) };
    let Some(headers) = existing else { return false };
    let _writing = shared.writing.lock().unwrap_or_else(PoisonError::into_inner);
    let taken_up = attempt(output, || job::take_up(&headers, &shared.options));
    let outcome = taken_up.map_or_else(Outcome::Failed, |()| Outcome::Skipped);
    let _ = ended.send(Message::Ended(index, outcome));
    true
}

fn denoise_all(
    shared: &Shared,
    frames: &Receiver<Loaded>,
    next: &SyncSender<(usize, Views<Denoised>)>,
    ended: &Sender<Message>,
) {
    let (model, options) = (&*shared.model, &shared.options);
    let reach = options.temporal.unwrap_or_default();
    let mut window = Window::new(reach);
    for loaded in frames {
        let (index, denoised) = match loaded {
            Loaded::Frame(index, frame) => {
                let input = &shared.jobs[index].input;
                (index, frame.and_then(|frame| attempt(input, || job::denoise(frame, model, options))))
            }
            Loaded::Begin => {
                window = Window::new(reach);
                continue;
            }
            Loaded::Neighbour { number, loaded, is_written } => {
                window.leave(number.saturating_sub(2 * reach as i64));
                window.enter(number, loaded, is_written, model);
                continue;
            }
            Loaded::Complete { index, number } => {
                let input = &shared.jobs[index].input;
                (index, attempt(input, || window.denoise(number, model, options)))
            }
        };
        let is_last = match denoised {
            Ok(frame) => next.send((index, frame)).is_err(),
            Err(error) => ended.send(Message::Ended(index, Outcome::Failed(error))).is_err(),
        };
        if is_last {
            return;
        }
    }
}

fn store_all(shared: &Shared, frames: &Receiver<(usize, Views<Denoised>)>, ended: &Sender<Message>) {
    for (index, denoised) in frames {
        let job = &shared.jobs[index];
        let stored = {
            let _writing = shared.writing.lock().unwrap_or_else(PoisonError::into_inner);
            attempt(&job.input, || job::store(denoised, &job.output, &shared.options))
        };
        let outcome = stored.map_or_else(Outcome::Failed, Outcome::Done);
        let _ = ended.send(Message::Ended(index, outcome));
    }
}
