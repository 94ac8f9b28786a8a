//! How far an image is from its reference: pure functions on linear radiance, (3, H, W).
//!
//! Each family of metrics is one file with its formulas, constants and sources: [`error`] (RelMSE, RMSE,
//! maximum error, SMAPE), [`ssim`] on the display image of [`display`], and [`flip`] for what an eye notices.
//! [`score`] computes all of these. [`flicker`] is measured on a sequence, from two frames and the motion
//! between them. [`pairing`] tells whether an image and its reference belong together. Sums run in f64 row by
//! row in a fixed order, so the number of threads does not change a digit.

use std::fmt;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::planes::Planes;

pub mod display;
pub mod error;
pub mod flicker;
pub mod flip;
pub mod pairing;
pub mod ssim;

/// Every metric of one image, named like the columns of the report.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// [`error::relmse`].
    pub relmse: f64,
    /// [`ssim::ssim`] at `exposure`; none for images smaller than its window or a black reference.
    pub ssim: Option<f64>,
    /// [`error::rmse`].
    pub rmse: f64,
    /// [`error::max_error`].
    pub max_error: f64,
    /// [`display::exposure`] of the reference; none for a black one.
    pub exposure: Option<f64>,
    /// [`error::relmse_trimmed`].
    pub relmse_trimmed: f64,
    /// [`error::smape`].
    pub smape: f64,
    /// [`flip::hdr_flip`]; none for a black reference.
    pub flip: Option<f64>,
}

impl Scores {
    /// Names and values in the order they are printed.
    pub fn named(&self) -> [(&'static str, Option<f64>); 8] {
        [
            ("relmse", Some(self.relmse)),
            ("ssim", self.ssim),
            ("rmse", Some(self.rmse)),
            ("max_error", Some(self.max_error)),
            ("exposure", self.exposure),
            ("relmse_trimmed", Some(self.relmse_trimmed)),
            ("smape", Some(self.smape)),
            ("flip", self.flip),
        ]
    }
}

/// Why two images have no scores.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Incomparable {
    /// The images differ in (channels, width, height).
    Size {
        /// Of the image.
        image: (usize, usize, usize),
        /// Of the reference.
        reference: (usize, usize, usize),
    },
    /// An image holds NaN or infinity. Such values are never left out in silence.
    NonFinite {
        /// Such values in the image.
        image: usize,
        /// Such values in the reference.
        reference: usize,
    },
}

impl fmt::Display for Incomparable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Size { image: (ic, iw, ih), reference: (rc, rw, rh) } if ic == rc => {
                write!(f, "sizes differ: image {iw}x{ih}, reference {rw}x{rh}")
            }
            Self::Size { image: (ic, ..), reference: (rc, ..) } => {
                write!(f, "channel counts differ: image {ic}, reference {rc}")
            }
            Self::NonFinite { image, reference } => {
                write!(f, "NaN or infinite values: {image} in the image, {reference} in the reference")
            }
        }
    }
}

impl std::error::Error for Incomparable {}

/// Whether metrics are defined on two images.
///
/// # Errors
/// The sizes differ or a value is not finite.
pub fn check(image: &Planes, reference: &Planes) -> Result<(), Incomparable> {
    if image.extent() != reference.extent() {
        return Err(Incomparable::Size { image: image.extent(), reference: reference.extent() });
    }
    match (image.non_finite(), reference.non_finite()) {
        (0, 0) => Ok(()),
        (image, reference) => Err(Incomparable::NonFinite { image, reference }),
    }
}

/// All metrics of `image` against `reference`, both linear radiance, (3, H, W).
///
/// # Errors
/// The sizes differ or a value is not finite.
///
/// # Panics
/// If the images have no pixel, or not three channels.
pub fn score(image: &Planes, reference: &Planes) -> Result<Scores, Incomparable> {
    check(image, reference)?;
    assert_eq!(image.channels, 3, "metrics are defined on RGB");
    let exposure = display::exposure(reference);
    Ok(Scores {
        relmse: error::relmse(image, reference),
        ssim: exposure.and_then(|e| ssim::ssim(&display::display(image, e), &display::display(reference, e))),
        rmse: error::rmse(image, reference),
        max_error: error::max_error(image, reference),
        exposure,
        relmse_trimmed: error::relmse_trimmed(image, reference),
        smape: error::smape(image, reference),
        flip: flip::hdr_flip(image, reference),
    })
}

/// # Panics
/// If sizes or channels differ, or there is no pixel.
fn assert_alike(image: &Planes, reference: &Planes) {
    assert_eq!(image.extent(), reference.extent(), "images of one size");
    assert!(!image.data.is_empty(), "images with pixels");
}

/// The mean of `value(x, r)` over all values of two images of one size.
fn mean(image: &Planes, reference: &Planes, value: impl Fn(f64, f64) -> f64 + Sync) -> f64 {
    assert_alike(image, reference);
    let sums: Vec<f64> = image
        .data
        .par_chunks(image.width)
        .zip(reference.data.par_chunks(image.width))
        .map(|(xs, rs)| xs.iter().zip(rs).map(|(&x, &r)| value(x.into(), r.into())).sum::<f64>())
        .collect();
    sums.iter().sum::<f64>() / image.data.len() as f64
}

/// Why a score is none against this reference, for a message.
pub fn why_undefined(reference: &Planes) -> String {
    match display::exposure(reference) {
        None if reference.data.iter().all(|&value| value == 0.0) => "the reference is black".into(),
        None if reference.data.iter().any(|&value| value < 0.0) => {
            "values of the reference below zero leave no positive mean luminance, by which its exposure is told".into()
        }
        None => "98% of the reference is black, by which its exposure is told".into(),
        Some(_) => format!("the images are smaller than its window of {0}x{0}", ssim::WINDOW),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_black_is_not_called_so() {
        let mut reference = Planes::new(3, 20, 20);
        assert_eq!(why_undefined(&reference), "the reference is black");
        reference.data[7] = 1.0;
        assert!(why_undefined(&reference).starts_with("98% of the reference is black"));
        reference
            .data
            .iter_mut()
            .enumerate()
            .for_each(|(at, v)| *v = if at.is_multiple_of(2) { -3.0 } else { 1.0 });
        assert!(why_undefined(&reference).starts_with("values of the reference below zero"));
        reference.data.fill(-1.0);
        assert!(why_undefined(&reference).starts_with("values of the reference below zero"));
        assert_eq!(
            why_undefined(&Planes::from_vec(3, 2, 2, vec![0.5; 12])),
            "the images are smaller than its window of 11x11"
        );
    }
}
