//! A lane of a batch denoises one frame at a time, while it reads the next and writes the last. A batch has
//! as many lanes as frames that it denoises at once, each with threads of its own to compute with.

use std::{
    path::{Path, PathBuf},
    sync::{
        Arc,
        mpsc::{Receiver, Sender, SyncSender, sync_channel},
    },
    thread,
};

use rayon::{ThreadPool, ThreadPoolBuilder};

use super::{
    Job, Views,
    batch::{Message, Outcome, Shared, Work},
    job::{self, Denoised},
    sequence::Stretch,
    window::Window,
};
use crate::{Error, Result, error::attempt, frame::Frame, shot::Shot};

/// What the stages of a lane share.
#[derive(Clone)]
pub struct Lane {
    shared: Arc<Shared>,
    /// How many lanes there are.
    lanes: usize,
    /// The threads that it computes with; without a pool, all that there are.
    pool: Option<Arc<ThreadPool>>,
    ended: Sender<Message>,
}

/// What the reading stage sends to the denoising stage.
enum Loaded {
    /// What was read of a frame that is denoised by itself.
    Frame(Job, Box<Result<Views<Shot>>>),
    /// A stretch of a sequence begins, so the one before is forgotten.
    Begin,
    /// A frame of the sequence, by its number, and whether it is to be denoised. Its passes are decoded when
    /// the window takes it in, since they are large.
    Neighbour { number: i64, file: PathBuf, read: Result<Frame>, is_written: bool },
    /// All frames around this one have been read.
    Complete { job: Job, number: i64 },
}

/// Tells when it is dropped that a lane has ended, whether its stages finished or panicked.
struct SaysEnd(Sender<Message>);

impl Drop for SaysEnd {
    fn drop(&mut self) {
        let _ = self.0.send(Message::LaneEnded);
    }
}

impl Lane {
    /// Starts lane number `lane` of `lanes`.
    pub fn start(shared: &Arc<Shared>, (lane, lanes): (usize, usize), ended: &Sender<Message>) {
        let threads = rayon::current_num_threads();
        let own = threads / lanes + usize::from(lane < threads % lanes);
        // Of several lanes each has a share, and one keeps to the pool that the batch was begun in.
        let pool = (lanes > 1 || rayon::current_thread_index().is_some())
            .then(|| ThreadPoolBuilder::new().num_threads(own).build());
        let pool = pool.map(|pool| Arc::new(pool.expect("the system has room for the threads of a lane")));
        let lane = Self { shared: Arc::clone(shared), lanes, pool, ended: ended.clone() };
        // Rendezvous channels: a stage holds its frame until the next one is free to take it.
        let (to_denoise, loaded) = sync_channel(0);
        let (to_store, denoised) = sync_channel(0);
        lane.spawn("read", move |lane| {
            let _ = lane.load_all(&to_denoise);
        });
        lane.spawn("denoise", move |lane| lane.denoise_all(&loaded, &to_store));
        let says_end = SaysEnd(ended.clone());
        lane.spawn("write", move |lane| {
            lane.store_all(&denoised);
            // This stage ends last, since the channels that lead to it are closed by then.
            drop(says_end);
        });
    }

    fn spawn(&self, name: &str, stage: impl FnOnce(&Self) + Send + 'static) {
        let lane = self.clone();
        thread::Builder::new()
            .name(name.into())
            .spawn(move || stage(&lane))
            .expect("the system has room for three threads a lane");
    }

    /// Computes on the lane's threads.
    fn on_own_threads<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        match &self.pool {
            Some(pool) => pool.install(work),
            None => work(),
        }
    }

    fn end(&self, job: Job, outcome: Outcome) -> Option<()> {
        self.ended.send(Message::Ended(job, Box::new(outcome))).ok()
    }

    /// Reads what the lane is given; none when the next stage has ended.
    fn load_all(&self, next: &SyncSender<Loaded>) -> Option<()> {
        while let Some(work) = self.shared.next(self.lanes, &self.ended) {
            match work {
                Work::Frame(job) => {
                    let Some(read) = self.read_new(&job) else { continue };
                    let loaded = self.take_apart(&job.input, read);
                    next.send(Loaded::Frame(job, Box::new(loaded))).ok()?;
                }
                Work::Stretch(stretch) => self.load_stretch(stretch, next)?,
            }
        }
        Some(())
    }

    /// Reads a job's file; none where its result exists already, or the file is not whole yet.
    fn read_new(&self, job: &Job) -> Option<Result<Frame>> {
        if self.shared.take_up_existing(job, [], &self.ended) { None } else { self.shared.read(job) }
    }

    /// Decodes the passes that are needed from a file that was read.
    fn take_apart(&self, input: &Path, read: Result<Frame>) -> Result<Views<Shot>> {
        let Shared { model, options, .. } = &*self.shared;
        let frame = read?;
        attempt(input, || self.on_own_threads(|| job::take_apart(frame, &**model, options)))
    }

    /// Reads the frames of a stretch that are to be denoised, and those around them, each once; none when the
    /// next stage has ended.
    fn load_stretch(&self, stretch: Stretch, next: &SyncSender<Loaded>) -> Option<()> {
        let read = |file: &Path| attempt(file, || Frame::read(file));
        let Stretch { files, jobs, is_numbered } = stretch;
        if !is_numbered {
            for (job, _) in jobs {
                let mut frame = self.take_apart(&job.input, read(&job.input));
                if let Ok(frame) = &mut frame {
                    frame.say("its name ends in no frame number; denoised alone");
                }
                next.send(Loaded::Frame(job, Box::new(frame))).ok()?;
            }
            return Some(());
        }
        next.send(Loaded::Begin).ok()?;
        let reach = i64::try_from(self.reach()).unwrap_or(i64::MAX);
        let written: Vec<i64> = jobs.iter().map(|(_, number)| *number).collect();
        let mut unread = i64::MIN;
        for (job, number) in jobs {
            let (first, last) = (number.saturating_sub(reach), number.saturating_add(reach));
            for (&number, file) in files.range(first.max(unread)..=last) {
                let is_written = written.contains(&number);
                let (file, read) = (file.clone(), read(file));
                next.send(Loaded::Neighbour { number, file, read, is_written }).ok()?;
            }
            unread = last.saturating_add(1);
            next.send(Loaded::Complete { job, number }).ok()?;
        }
        Some(())
    }

    /// How many frames before one, and after it, it is denoised with.
    fn reach(&self) -> usize {
        self.shared.options.temporal.unwrap_or_default()
    }

    fn denoise_all(&self, frames: &Receiver<Loaded>, next: &SyncSender<(Job, Views<Denoised>)>) {
        let Shared { model, options, .. } = &*self.shared;
        let model = &**model;
        let new_window = || Window::new(self.reach(), model, (options.tile, options.alpha));
        let mut window = new_window();
        for loaded in frames {
            if self.shared.is_stopped() {
                return;
            }
            let (job, denoised) = match loaded {
                Loaded::Frame(job, frame) => {
                    let denoise = |frame| {
                        attempt(&job.input, || self.on_own_threads(|| job::denoise(frame, model, options)))
                    };
                    let denoised = frame.and_then(denoise);
                    (job, denoised)
                }
                Loaded::Begin => {
                    window = new_window();
                    continue;
                }
                Loaded::Neighbour { number, file, read, is_written } => {
                    let loaded = self.take_apart(&file, read);
                    let entered = attempt(&file, || {
                        self.on_own_threads(|| window.enter(number, loaded, is_written));
                        Ok(())
                    });
                    if let Err(error) = entered {
                        window.enter(number, Err(error), is_written);
                    }
                    continue;
                }
                Loaded::Complete { job, number } => {
                    let window = &mut window;
                    let denoised = attempt(&job.input, || {
                        self.on_own_threads(|| {
                            let denoised = window.denoise(number);
                            window.leave(number);
                            denoised
                        })
                    });
                    (job, denoised)
                }
            };
            let sent = match denoised {
                Ok(frame) => next.send((job, frame)).ok(),
                Err(error) => self.end(job, Outcome::Failed(error)),
            };
            if sent.is_none() {
                return;
            }
        }
    }

    fn store_all(&self, frames: &Receiver<(Job, Views<Denoised>)>) {
        let options = &self.shared.options;
        for (job, denoised) in frames {
            let store = |job: &Job| {
                let stored = attempt(&job.input, || {
                    let (frame, report) =
                        self.on_own_threads(|| job::insert(denoised, &job.output, options))?;
                    frame.write(&job.output)?;
                    Ok::<_, Error>(report)
                });
                stored.map_or_else(Outcome::Failed, Outcome::Done)
            };
            if self.shared.write(job, store, &self.ended).is_none() {
                return;
            }
        }
    }
}
