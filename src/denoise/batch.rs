//! The batch: reading the next frame, denoising this one and writing the last overlap, so that a batch
//! takes about as long as the model does. At most three frames are in memory, and for a sequence its window
//! besides; where several frames are denoised at once, each of them takes that much. See [`Lane`].
//!
//! All threads report to the caller's thread, which alone talks to the user.

use std::{
    collections::{BTreeSet, HashMap, VecDeque},
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError, RwLock,
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, Sender, channel},
    },
};

use super::{
    Job, Options, Report,
    job::{self, Existing},
    lane::Lane,
    sequence::{self, Stretch},
    watch::{Next, Watch},
};
use crate::{Error, Result, error::attempt, frame::Frame, frame_number::frame_number, models::Denoiser};

/// What became of one file.
pub enum Outcome {
    /// Written.
    Done(Report),
    /// The result was there already.
    Skipped(Finished),
    /// Nothing was written.
    Failed(Error),
}

/// A result that was there already.
#[derive(Clone, Debug, Default)]
pub struct Finished {
    /// Why it may not be what is wanted, if there are reasons.
    pub notes: Vec<String>,
    /// Its expected RelMSE, as the mean over its views, where that is noted.
    pub expected_error: Option<f64>,
    /// Samples of a pixel of its render, where the file tells.
    pub samples: Option<u32>,
}

/// How the batch ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// Every file was tried.
    Complete,
    /// The user stopped it.
    Stopped,
}

/// What the batch's thread is told.
pub(super) enum Message {
    /// A file has ended.
    Ended(Job, Box<Outcome>),
    /// A lane has done all that it was given.
    LaneEnded,
    Stop,
}

/// Frames that one model is to denoise.
pub struct Batch {
    shared: Arc<Shared>,
    /// Frames that are denoised at once.
    lanes: usize,
    messages: Receiver<Message>,
    to_batch: Sender<Message>,
}

/// What the lanes share.
pub(super) struct Shared {
    source: Source,
    pub model: Arc<dyn Denoiser>,
    pub options: Options,
    /// Locked for reading while a file is being written, and for writing once the user has asked to stop, to wait
    /// for such files.
    writing: RwLock<()>,
    is_stopped: AtomicBool,
    /// How many times each job is still to end. A stage that panics takes its lane's jobs with it, and those must
    /// not pass for done.
    unended: Mutex<HashMap<Job, usize>>,
}

/// Where the work comes from.
enum Source {
    List(Mutex<List>),
    Watch(Watch),
}

/// Work that is known from the beginning.
struct List {
    frames: VecDeque<Job>,
    sequences: VecDeque<Stretch>,
    /// What is left of the sequence that was begun last.
    stretches: VecDeque<Stretch>,
}

/// What a lane is given at a time.
pub(super) enum Work {
    Frame(Job),
    /// Frames of a sequence that are denoised with those around them.
    Stretch(Stretch),
}

/// Ends a batch before all is done, from any thread.
#[derive(Clone)]
pub struct Stopper(Sender<Message>);

impl Stopper {
    /// Stops the batch: files that are being written are finished, and no other is begun. Does nothing once
    /// the batch has ended.
    pub fn stop(&self) {
        let _ = self.0.send(Message::Stop);
    }
}

impl Batch {
    /// A batch that waits to be [run](Batch::run).
    pub fn new(jobs: Vec<Job>, model: Arc<dyn Denoiser>, options: Options) -> Self {
        let mut unended = HashMap::new();
        jobs.iter().for_each(|job| *unended.entry(job.clone()).or_default() += 1);
        let (mut frames, mut sequences) = (VecDeque::new(), VecDeque::new());
        match options.temporal {
            Some(_) => sequences = sequence::group(jobs).into(),
            None => frames = jobs.into(),
        }
        let list = List { frames, sequences, stretches: VecDeque::new() };
        Self::of(Source::List(Mutex::new(list)), unended, model, options)
    }

    /// A batch of files that are still coming in.
    ///
    /// # Errors
    /// [`Options::temporal`] is set, for which each frame needs those after it, which are not there yet.
    pub fn watching(watch: Watch, model: Arc<dyn Denoiser>, options: Options) -> Result<Self> {
        if options.temporal.is_some() {
            let why = "a watch denoises each frame as it comes in, and --temporal needs those after it too: leave out one of \
                       them, or run --temporal when the rendering has ended";
            return Err(Error::Usage(why.into()));
        }
        Ok(Self::of(Source::Watch(watch), HashMap::new(), model, options))
    }

    fn of(source: Source, unended: HashMap<Job, usize>, model: Arc<dyn Denoiser>, options: Options) -> Self {
        let (to_batch, messages) = channel();
        let (writing, is_stopped) = (RwLock::new(()), AtomicBool::new(false));
        let unended = Mutex::new(unended);
        let shared = Arc::new(Shared { source, model, options, writing, is_stopped, unended });
        Self { shared, lanes: 1, messages, to_batch }
    }

    /// Denoises up to `frames` frames at once, to the same bits: the threads are split between them, and each
    /// frame has its own memory. More frames than threads are never denoised at once.
    #[must_use]
    pub fn at_once(self, frames: usize) -> Self {
        Self { lanes: frames.clamp(1, rayon::current_num_threads()), ..self }
    }

    /// What stops it.
    pub fn stopper(&self) -> Stopper {
        Stopper(self.to_batch.clone())
    }

    /// Runs all jobs; `report` is called once for each as it ends, on this thread.
    ///
    /// # Panics
    /// If the system cannot start three threads for each of the frames that are denoised at once, and the
    /// threads that these compute with.
    pub fn run(self, mut report: impl FnMut(&Job, &Outcome)) -> End {
        let Self { shared, lanes, messages, to_batch } = self;
        let mut report = |job: &Job, outcome: &Outcome| {
            shared.ends(job);
            report(job, outcome);
        };
        for lane in 0..lanes {
            Lane::start(&shared, (lane, lanes), &to_batch);
        }
        let mut running = lanes;
        while running > 0 {
            match messages.recv().expect("its own sender lives") {
                Message::Ended(job, outcome) => report(&job, &outcome),
                Message::LaneEnded => running -= 1,
                Message::Stop => {
                    shared.is_stopped.store(true, Ordering::Relaxed);
                    // This waits for files that are being written. No other begins after it, so the process may
                    // end without waiting for the model. In one that goes on, each lane ends after its frame.
                    drop(shared.writing.write().unwrap_or_else(PoisonError::into_inner));
                    while let Ok(message) = messages.try_recv() {
                        if let Message::Ended(job, outcome) = message {
                            report(&job, &outcome);
                        }
                    }
                    shared.tell_leftovers(End::Stopped, report);
                    return End::Stopped;
                }
            }
        }
        shared.tell_leftovers(End::Complete, &mut report);
        shared.tell_lost(report);
        End::Complete
    }
}

impl Shared {
    /// What is to be done next by one of `lanes` lanes; none at the end.
    pub fn next(&self, lanes: usize, ended: &Sender<Message>) -> Option<Work> {
        match &self.source {
            Source::List(list) => {
                let mut list = list.lock().unwrap_or_else(PoisonError::into_inner);
                if self.is_stopped() {
                    return None;
                }
                while list.stretches.is_empty()
                    && let Some(mut sequence) = list.sequences.pop_front()
                {
                    // Finished jobs are taken out first, so that those that are left are split evenly.
                    let Stretch { files, jobs, .. } = &mut sequence;
                    let reach = i64::try_from(self.options.temporal.unwrap_or(0)).unwrap_or(i64::MAX);
                    jobs.retain(|(job, number)| {
                        let near = number.saturating_sub(reach)..=number.saturating_add(reach);
                        let beside = files.range(near).map(|(_, file)| file.as_path());
                        !self.take_up_existing(job, beside, ended)
                    });
                    list.stretches = sequence.split(lanes).into();
                }
                let frame = list.frames.pop_front().map(Work::Frame);
                frame.or_else(|| list.stretches.pop_front().map(Work::Stretch))
            }
            Source::Watch(watch) => loop {
                match watch.next(|| self.is_stopped()) {
                    Next::Job(job) => {
                        *self.unended().entry(job.clone()).or_default() += 1;
                        return Some(Work::Frame(job));
                    }
                    Next::Failure(input, error) => {
                        let job = Job { input, output: PathBuf::new() };
                        let _ = ended.send(Message::Ended(job, Box::new(Outcome::Failed(error))));
                    }
                    Next::End => return None,
                }
            },
        }
    }

    /// Reports the watched files that never became whole.
    fn tell_leftovers(&self, end: End, mut report: impl FnMut(&Job, &Outcome)) {
        if let Source::Watch(watch) = &self.source {
            for (job, error) in watch.leftovers(end) {
                report(&job, &Outcome::Failed(error));
            }
        }
    }

    fn unended(&self) -> MutexGuard<'_, HashMap<Job, usize>> {
        self.unended.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes that a job has ended.
    fn ends(&self, job: &Job) {
        let mut unended = self.unended();
        if let Some(times) = unended.get_mut(job) {
            *times -= 1;
            if *times == 0 {
                unended.remove(job);
            }
        }
    }

    /// Reports the jobs that no lane ended, though all lanes have.
    fn tell_lost(&self, mut report: impl FnMut(&Job, &Outcome)) {
        let lost: Vec<(Job, usize)> = self.unended().drain().collect();
        for (job, times) in lost {
            for _ in 0..times {
                let why = "an internal error stopped the batch before this frame ended; please report it with the file";
                report(&job, &Outcome::Failed(Error::invalid(&job.input, why)));
            }
        }
    }

    /// Whether nothing is to be begun any more.
    pub fn is_stopped(&self) -> bool {
        self.is_stopped.load(Ordering::Relaxed)
    }

    /// Writes a file and tells how its job ended; none if the batch has been stopped, or has ended.
    ///
    /// Whoever stops the batch waits until both is done.
    pub fn write(
        &self,
        job: Job,
        write: impl FnOnce(&Job) -> Outcome,
        ended: &Sender<Message>,
    ) -> Option<()> {
        let _writing = self.writing.read().unwrap_or_else(PoisonError::into_inner);
        if self.is_stopped() {
            return None;
        }
        let outcome = write(&job);
        ended.send(Message::Ended(job, Box::new(outcome))).ok()
    }

    /// Reads a file; none if it is watched and not whole yet, in which case it is waited for.
    pub fn read(&self, job: &Job) -> Option<Result<Frame>> {
        let frame = attempt(&job.input, || Frame::read(&job.input));
        match (&self.source, frame) {
            (Source::Watch(watch), Err(error)) => {
                watch.put_back(&job.input, error);
                self.ends(job);
                None
            }
            (_, frame) => Some(frame),
        }
    }

    /// Whether a frame that a result was made without can be used now.
    fn can_be_completed(&self, job: &Job, lacked: &BTreeSet<i64>) -> bool {
        let Some(reach) = self.options.temporal else { return false };
        let Some(number) = frame_number(&job.input).filter(|_| !lacked.is_empty()) else { return false };
        let near = sequence::neighbours(&job.input, reach).into_iter();
        let mut found = near.filter(|(offset, _)| lacked.contains(&(number + i64::from(*offset))));
        found.any(|(_, path)| {
            let frame = attempt(&path, || Frame::read(&path));
            frame
                .and_then(|frame| attempt(&path, || job::take_apart(frame, &*self.model, &self.options)))
                .is_ok()
        })
    }

    /// Whether the result of a job exists already; if so, the job's end is reported. It is made of the frames `beside`
    /// its own as well.
    pub fn take_up_existing<'a>(
        &self,
        job: &Job,
        beside: impl IntoIterator<Item = &'a Path>,
        ended: &Sender<Message>,
    ) -> bool {
        if self.options.overwrite {
            return false;
        }
        let look = || {
            let headers = job::existing(&job.output)?;
            headers.map(|headers| Existing::of(&headers, &*self.model, &self.options)).transpose()
        };
        let existing = match attempt(&job.output, look) {
            Ok(None) => return false,
            Ok(Some(Existing { made_otherwise: None, lacked, .. }))
                if self.can_be_completed(job, &lacked) =>
            {
                return false;
            }
            Ok(Some(existing)) => Ok(existing),
            Err(error) => Err(error),
        };
        let take_up = |job: &Job| {
            let take_up = || {
                let existing = existing?;
                existing.write_missing_previews(&job.output, &self.options)?;
                let outdated = job::outdated(job, beside).map(Into::into);
                let Existing { made_otherwise, expected_error, samples, .. } = existing;
                let notes = outdated.into_iter().chain(made_otherwise).collect();
                Ok(Outcome::Skipped(Finished { notes, expected_error, samples }))
            };
            attempt(&job.output, take_up).unwrap_or_else(Outcome::Failed)
        };
        let _ = self.write(job.clone(), take_up, ended);
        true
    }
}
