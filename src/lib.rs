//! Removes Monte Carlo noise from Blender Cycles renders stored as multilayer EXR.
//!
//! A frame is read, denoised, and written with everything that it held and one layer more:
//!
//! ```
//! # fn main() -> demc::Result<()> {
//! # let folder = tempfile::tempdir().expect("a folder for temporary files");
//! # let input = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/s0000_room_0004spp.exr");
//! # let output = folder.path().join("room.exr");
//! use demc::{denoise, models};
//!
//! let model = models::open("demc-m")?;
//! let options = denoise::Options { layer: Some("Clean".into()), ..Default::default() };
//! let report = denoise::file(&input, &output, &*model, &options)?;
//! println!("{}x{} pixels in {:.2} s", report.width, report.height, report.seconds);
//! # assert!(output.is_file() && report.seconds > 0.0);
//! # Ok(())
//! # }
//! ```
//!
//! The features `cli`, `report` and `train` (all on by default) add the program `demc`, reports over test
//! sets, and training.
//!
//! Modules point downwards only, but that flicker is measured along motion as [`filters`] follow it:
//! `cli` dispatches; `stability` changes inputs and `report` scores methods over a test set; `train` fits
//! weights; [`denoise`] takes files through a method; [`models`] holds every denoising method behind one
//! trait; [`augment`] turns a frame into another that serves training as well; [`features`] turns passes into
//! network inputs; [`filters`] holds classical building blocks, and [`nn`] differentiable image operations on
//! dfdx's tape; [`shot`] is what methods are given, [`sources`] tells where its parts are found, and a
//! [`companion`] is a layer that is denoised along with the beauty; [`lint`] finds in a frame what ruins a
//! denoise; [`passes`] says what a channel means; [`frame`] is an EXR exactly as stored; [`metrics`] are pure
//! functions; [`kernels`] holds the arithmetic, and the only `unsafe`.
#![deny(unsafe_code)]
#![warn(missing_docs)]

pub mod augment;
#[cfg(feature = "cli")]
pub mod cli;
pub mod companion;
pub mod denoise;
pub mod error;
pub mod features;
pub mod filters;
pub mod frame;
mod frame_number;
pub mod kernels;
pub mod lint;
pub mod metrics;
pub mod models;
pub mod nn;
pub mod passes;
pub mod planes;
#[cfg(feature = "report")]
pub mod report;
pub mod rng;
pub mod shot;
pub mod sources;
#[cfg(feature = "report")]
pub mod stability;
#[cfg(feature = "test-sets")]
pub mod testset;
#[cfg(feature = "train")]
pub mod train;

pub use error::{Error, Result};
