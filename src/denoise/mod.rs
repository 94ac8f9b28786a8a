//! The denoise engine: files in, each of them out again with a layer more.
//!
//! [`file()`] denoises one frame, and [`Batch`] many, with reading, denoising and writing overlapped. Both
//! are made of the steps [`load`], [`denoise`] and [`store`]. With [`Options::temporal`], a batch denoises
//! the frames of a sequence together with their neighbours. Nothing is printed: what the user should know is
//! in each frame's [`Report`].

mod batch;
mod half_floats;
mod job;
mod lane;
mod lights;
mod plan;
#[cfg(feature = "preview")]
pub mod preview;
mod sequence;
mod temporal;
mod watch;
mod window;
mod wrap;

use std::path::Path;

pub use batch::{Batch, End, Finished, Outcome, Stopper};
pub use job::{
    Denoised, Job, Options, Report, Views, WritePicture, check_layer_name, check_options, denoise, load,
    shot, store,
};
pub use lights::Alpha;
pub use plan::{Input, Plan, plan, plan_tree};
pub use sequence::{follows, neighbours};
pub use temporal::{SUFFIX as TEMPORAL, Temporal};
pub use watch::{Look, Watch};
pub use window::{Candidate, Candidates};
pub use wrap::Wrap;

pub use crate::frame_number::frame_number;
use crate::{Error, Result, models::Denoiser};

/// Reads a frame, denoises it and writes all of it, with the result as a new layer. A file that exists at
/// `output` is replaced.
///
/// # Errors
/// The input is unusable or lacks a pass that the model needs, it is the output, the output cannot be written, or
/// [`Options::temporal`] asks for neighbours, which a [`Batch`] reads.
pub fn file(input: &Path, output: &Path, model: &dyn Denoiser, options: &Options) -> Result<Report> {
    if options.temporal.is_some() {
        return Err(Error::Usage("a file has no neighbours by itself: a batch takes frames together".into()));
    }
    let loaded = load(input, model, options)?;
    store(denoise(loaded, model, options)?, output, options)
}
