//! Removes Monte Carlo noise from Blender Cycles renders stored as multilayer EXR.
//!
//! Modules point downwards only:
//! [`cli`] dispatches; [`stability`] changes inputs and [`report`] scores methods over a test set; [`train`] fits weights;
//! [`models`] holds every denoising method behind one trait; [`augment`] changes a frame to another that is as good;
//! [`features`] turns passes into network inputs; [`filters`] are classical building blocks; [`nn`] is differentiable image
//! operations on dfdx's tape; [`passes`] says what a channel means; [`frame`] is an EXR exactly as stored; [`metrics`] are pure functions;
//! [`kernels`] holds the arithmetic, and the only `unsafe`.
#![deny(unsafe_code)]
#![warn(missing_docs)]

pub mod augment;
pub mod cli;
pub mod error;
pub mod features;
pub mod filters;
pub mod frame;
pub mod kernels;
pub mod metrics;
pub mod models;
pub mod nn;
pub mod passes;
pub mod planes;
pub mod report;
pub mod stability;
pub mod testset;
pub mod train;

pub use error::{Error, Result};
