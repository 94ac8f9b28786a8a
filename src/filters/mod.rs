//! Classical building blocks of image denoising: pure functions on [`Planes`](crate::planes::Planes).
//!
//! [`nl_means`] holds the patch weights and the filter that averages by them. [`regression`] holds weighted
//! first-order fits over whole windows, and [`refit`] fits that correct a denoised frame, whose sums are
//! gathered in [`squares`]; [`solve`] solves the small symmetric systems of both. [`variance`] estimates the
//! noise, and [`shrinkage`] takes back what was changed beyond the noise, [`coverage`] the same of alpha, of which [`caught`] finds
//! shadows that the beauty does not show. Work is cut into tiles of the frame, one a thread; inner loops run over consecutive pixels so that the compiler can vectorise them.
//! Results do not depend on the number of threads.
//!
//! For sequences, [`motion`] follows what moves from frame to frame, [`agreement`] tells where two frames
//! show the same, [`structure`] where they differ by more than noise, and [`temporal`] averages them there.

pub mod agreement;
pub mod blocks;
mod box_mean;
pub mod caught;
pub mod coverage;
pub mod motion;
pub mod nl_means;
mod padded;
mod perceptron;
pub mod refit;
pub mod regression;
pub mod shrinkage;
pub mod solve;
pub mod squares;
pub mod structure;
pub mod temporal;
pub mod variance;

/// A pixel more than this many times as bright as the brightest other pixel in the 5x5 around it is a firefly.
pub const FIREFLY: f32 = 32.0;
