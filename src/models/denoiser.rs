//! The interface of every denoising method.

use std::time::Instant;

use super::ExpectedError;
use crate::{
    Error, Result,
    companion::Companion,
    passes::{Pass, PassSet},
    planes::Planes,
    shot::Shot,
};

/// One way to remove noise from a frame.
pub trait Denoiser: Send + Sync {
    /// The name by which `--model` and the report know it.
    fn name(&self) -> &str;

    /// The passes it needs.
    fn passes(&self) -> &[Pass];

    /// Those of [`Denoiser::passes`] that it can do without, at a price that [`Denoiser::notes`] tells.
    fn dispensable(&self) -> &[Pass] {
        &[]
    }

    /// Whether a frame has the passes that it cannot do without.
    ///
    /// # Errors
    /// Some are missing: all of those are named, each with its remedy.
    fn check(&self, passes: &PassSet) -> Result<()> {
        let needed = self.passes().iter().copied().filter(|pass| !self.dispensable().contains(pass));
        passes.require_all(needed, self.name())
    }

    /// Passes it makes use of where a file holds them.
    fn optional_passes(&self) -> &[Pass] {
        &[]
    }

    /// Whether it makes use of half buffers, see [`Shot::read_halves`].
    fn reads_halves(&self) -> bool {
        false
    }

    /// How many frames of the sequence before a frame, and as many after it, it makes use of. See
    /// [`Shot::neighbours`].
    fn reach(&self) -> usize {
        0
    }

    /// What the user should know about how it treats this frame.
    fn notes(&self, shot: &Shot) -> Option<String> {
        let _ = shot;
        None
    }

    /// Denoised radiance, (3, H, W).
    ///
    /// # Errors
    /// A pass is missing, or the method cannot run here; the message says why.
    fn denoise(&self, shot: &Shot) -> Result<Planes>;

    /// Whether it denoises layers along with the beauty.
    fn takes_companions(&self) -> bool {
        false
    }

    /// Whether it can tell how far off a result is expected to be.
    fn expects_errors(&self) -> bool {
        false
    }

    /// As [`Denoiser::denoise`], working on tiles of at most `tile` pixels a side where the method can, to bound its
    /// memory. Each of the companions, which are layers of the same frame, is denoised along with the beauty, in place.
    /// How far off the result is expected to be is returned if the caller `expects` it and the method can tell.
    ///
    /// # Errors
    /// As [`Denoiser::denoise`], or there are companions and the method takes none.
    ///
    /// # Panics
    /// If a companion is not of the frame's size.
    fn denoise_along(
        &self,
        shot: &Shot,
        companions: &mut [Companion],
        tile: Option<usize>,
        expects: bool,
    ) -> Result<(Planes, Option<ExpectedError>)> {
        let _ = (tile, expects);
        refuse_companions(self.name(), companions)?;
        Ok((self.denoise(shot)?, None))
    }

    /// As [`Denoiser::denoise`], with what it cost. A method that works in a process of its own
    /// reports its filter's time, without start and file traffic.
    ///
    /// # Errors
    /// As [`Denoiser::denoise`].
    fn denoise_timed(&self, shot: &Shot) -> Result<Run> {
        let start = Instant::now();
        let image = self.denoise(shot)?;
        Ok(Run { image, seconds: start.elapsed().as_secs_f64(), peak_mib: None })
    }

    /// Whether the time that [`Denoiser::denoise_timed`] tells does not depend on how long cores were idle
    /// before, as the method warms up by itself or takes seconds.
    fn is_warm(&self) -> bool {
        false
    }
}

/// Fails if there are companions; called by methods that take none.
pub(super) fn refuse_companions(name: &str, companions: &[Companion]) -> Result<()> {
    if companions.is_empty() {
        return Ok(());
    }
    Err(Error::Usage(format!(
        "{name} denoises the beauty alone; demc-s, demc-m and demc-l take other layers along"
    )))
}

/// Fails if a method does not tell how far off its results are, which `option` asks for.
///
/// # Errors
/// The method does not tell.
pub fn check_expects(model: &dyn Denoiser, option: &str) -> Result<()> {
    if model.expects_errors() {
        return Ok(());
    }
    let name = model.name();
    Err(Error::Usage(format!(
        "{name} does not tell how far off it is; {option} takes demc-s, demc-m or demc-l"
    )))
}

/// A denoised frame and what it cost.
pub struct Run {
    /// Denoised radiance, (3, H, W).
    pub image: Planes,
    /// Time that denoising took, without file input and output.
    pub seconds: f64,
    /// Memory taken outside this process, where the method runs in one of its own.
    pub peak_mib: Option<f64>,
}
