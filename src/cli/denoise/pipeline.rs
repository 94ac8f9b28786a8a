//! The batch: reading the next frame, denoising this one and writing the last overlap, so that a batch
//! takes about as long as the model does. At most three frames are in memory.
//!
//! The threads report to the caller's thread, which alone talks to the user.

use std::{
    sync::{
        Arc, Mutex, PoisonError,
        mpsc::{Receiver, Sender, SyncSender, channel, sync_channel},
    },
    thread,
};

use super::{
    Job,
    frame_job::{self, Denoised, Frames, Options, Report},
};
use crate::{Error, Result, cli::stop, error::attempt, models::Denoiser, passes::PassSet};

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

enum Event {
    Finished(usize, Outcome),
    Stop,
}

/// What the stages share.
struct Batch {
    jobs: Vec<Job>,
    model: Arc<dyn Denoiser>,
    options: Options,
    /// Held while a file is being written, and for good once the user has asked to stop.
    writing: Mutex<()>,
}

/// Runs all jobs; `report` is called once for each as it ends, on this thread.
///
/// # Errors
/// Ctrl-C cannot be listened for.
pub fn run(
    jobs: Vec<Job>,
    model: Arc<dyn Denoiser>,
    options: Options,
    mut report: impl FnMut(&Job, &Outcome),
) -> Result<End> {
    let total = jobs.len();
    let batch = Arc::new(Batch { jobs, model, options, writing: Mutex::new(()) });
    let (events, reports) = channel();
    let stop_events = events.clone();
    stop::on_request(move || {
        // Nobody listens any more when the batch is over.
        let _ = stop_events.send(Event::Stop);
    })?;

    // Rendezvous channels: a stage holds its frame until the next one is free to take it.
    let (to_denoise, loaded) = sync_channel(0);
    let (to_store, denoised) = sync_channel(0);
    spawn("read", &batch, &events, move |batch, events| load_all(batch, &to_denoise, events));
    spawn("denoise", &batch, &events, move |batch, events| denoise_all(batch, &loaded, &to_store, events));
    spawn("write", &batch, &events, move |batch, events| store_all(batch, &denoised, events));

    for _ in 0..total {
        match reports.recv().expect("the sender kept for Ctrl-C lives as long as the process") {
            Event::Finished(index, outcome) => report(&batch.jobs[index], &outcome),
            Event::Stop => {
                // Let a file being written come to its end and no other begin; the process then ends
                // without waiting for the model.
                let gate = batch.writing.lock().unwrap_or_else(PoisonError::into_inner);
                std::mem::forget(gate);
                while let Ok(Event::Finished(index, outcome)) = reports.try_recv() {
                    report(&batch.jobs[index], &outcome);
                }
                return Ok(End::Stopped);
            }
        }
    }
    Ok(End::Complete)
}

fn spawn(
    name: &str,
    batch: &Arc<Batch>,
    events: &Sender<Event>,
    stage: impl FnOnce(&Batch, &Sender<Event>) + Send + 'static,
) {
    let (batch, events) = (Arc::clone(batch), events.clone());
    thread::Builder::new()
        .name(name.into())
        .spawn(move || stage(&batch, &events))
        .expect("the system has room for three threads");
}

fn load_all(batch: &Batch, next: &SyncSender<(usize, Frames<PassSet>)>, events: &Sender<Event>) {
    for (index, job) in batch.jobs.iter().enumerate() {
        let existing = if batch.options.overwrite { None } else { frame_job::existing(&job.output) };
        if let Some(headers) = existing {
            let _writing = batch.writing.lock().unwrap_or_else(PoisonError::into_inner);
            let taken_up = attempt(&job.output, || frame_job::take_up(&headers, &batch.options));
            let outcome = taken_up.map_or_else(Outcome::Failed, |()| Outcome::Skipped);
            let _ = events.send(Event::Finished(index, outcome));
            continue;
        }
        let loaded = attempt(&job.input, || frame_job::load(&job.input, &*batch.model, &batch.options));
        if !pass_on(index, loaded, next, events) {
            return;
        }
    }
}

fn denoise_all(
    batch: &Batch,
    frames: &Receiver<(usize, Frames<PassSet>)>,
    next: &SyncSender<(usize, Frames<Denoised>)>,
    events: &Sender<Event>,
) {
    for (index, loaded) in frames {
        let input = &batch.jobs[index].input;
        // On one of rayon's threads: from here, each of a network's hundreds of steps would have to wake them up first.
        let denoise = || rayon::scope(|_| frame_job::denoise(loaded, &*batch.model, &batch.options));
        let denoised = attempt(input, denoise);
        if !pass_on(index, denoised, next, events) {
            return;
        }
    }
}

fn store_all(batch: &Batch, frames: &Receiver<(usize, Frames<Denoised>)>, events: &Sender<Event>) {
    for (index, denoised) in frames {
        let job = &batch.jobs[index];
        let stored = {
            let _writing = batch.writing.lock().unwrap_or_else(PoisonError::into_inner);
            attempt(&job.input, || frame_job::store(denoised, &job.output, &batch.options))
        };
        let outcome = stored.map_or_else(Outcome::Failed, Outcome::Done);
        let _ = events.send(Event::Finished(index, outcome));
    }
}

/// Hands a frame to the next stage, or its failure to the user; false when there is no next stage.
fn pass_on<T>(
    index: usize,
    result: Result<T>,
    next: &SyncSender<(usize, T)>,
    events: &Sender<Event>,
) -> bool {
    match result {
        Ok(frame) => next.send((index, frame)).is_ok(),
        Err(error) => {
            let _ = events.send(Event::Finished(index, Outcome::Failed(error)));
            true
        }
    }
}
