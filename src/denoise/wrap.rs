//! Frames whose left and right edges meet, as those of a 360-degree panorama do: each edge is denoised
//! together with columns from the other side of the frame, so that no seam shows where a viewer joins them.

use crate::{
    Result, companion::Companion, frame::Frame, models::ExpectedError, passes::PassSet, planes::Planes,
    shot::Shot,
};

/// Whether the left and the right edge of a frame meet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Wrap {
    /// Where the file says so: OpenEXR's attribute `envmap` names a map by latitude and longitude, and the part is as
    /// wide as the whole.
    #[default]
    Auto,
    /// They meet, in parts that are as wide as the whole.
    X,
    /// They do not, whatever the file says.
    None,
}

impl Wrap {
    /// All, by their names on the command line.
    pub const ALL: [(&str, Self); 3] = [("auto", Self::Auto), ("x", Self::X), ("none", Self::None)];

    /// Whether the edges of this part of a frame meet.
    pub(super) fn of(self, frame: &Frame, part: usize) -> bool {
        // A region of the whole, or one with more around it, ends where it ends.
        let is_whole = frame.parts()[part].data_window.width == frame.display_window().width;
        match self {
            Self::Auto => frame.is_latitude_longitude() && is_whole,
            Self::X => is_whole,
            Self::None => false,
        }
    }
}

/// How many columns of the other side an edge is denoised with: what lies further away hardly counts, though the
/// built-in networks see up to 453 pixels to either side. It is a multiple of what they halve a frame by, so that their
/// quads lie where they did.
const MARGIN: usize = 256;

/// Adds columns to the shot and its companions at both edges, gives them to `run`, and takes the columns off
/// the results again.
///
/// # Errors
/// As `run`.
pub(super) fn joined(
    shot: &Shot,
    companions: &mut [Companion],
    run: impl FnOnce(&Shot, &mut [Companion]) -> Result<(Planes, Option<ExpectedError>)>,
) -> Result<(Planes, Option<ExpectedError>)> {
    // What was rendered of a part of the width ends where it ends.
    if shot.passes.rendered().1.0 < shot.passes.width {
        return run(shot, companions);
    }
    let widened = |set: &PassSet| set.map((set.width + 2 * MARGIN, set.height), |_, planes| widen(planes));
    let mut wide = Shot::new(widened(&shot.passes));
    wide.halves = shot.halves.as_ref().map(|halves| halves.each_ref().map(widened));
    wide.neighbours = shot.neighbours.iter().map(|(later, set)| (*later, widened(set))).collect();
    for companion in &mut *companions {
        companion.planes = widen(&companion.planes);
    }
    let (radiance, error) = run(&wide, companions)?;
    for companion in companions {
        companion.planes = narrow(&companion.planes);
        // It was of use to the model alone, which may have dropped it.
        companion.rendered = Planes::default();
    }
    Ok((narrow(&radiance), error.map(|error| error.without_margins(MARGIN))))
}

/// Adds [`MARGIN`] columns at each edge, which are those at the other edge.
fn widen(planes: &Planes) -> Planes {
    let (width, before) = (planes.width, planes.width - MARGIN % planes.width);
    Planes::from_rows(planes.channels, (width + 2 * MARGIN, planes.height), |c, y, row| {
        let from = planes.row(c, y);
        row.iter_mut().enumerate().for_each(|(x, value)| *value = from[(x + before) % width]);
    })
}

/// Takes off what [`widen`] added.
fn narrow(planes: &Planes) -> Planes {
    planes.window((MARGIN, 0), (planes.width - 2 * MARGIN, planes.height))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_go_on_with_one_another_and_come_off_again() {
        for width in [1, 3, 255, 256, 300] {
            let planes = Planes::from_vec(1, width, 2, (0..2 * width).map(|i| i as f32).collect());
            let wide = widen(&planes);
            let row = &wide.channel(0)[..wide.width];
            let last = (width - 1) as f32;
            assert_eq!([row[MARGIN - 1], row[MARGIN], row[MARGIN + width - 1]], [last, 0.0, last], "{width}");
            assert_eq!(row[MARGIN + width], 0.0);
            assert_eq!(narrow(&wide), planes);
        }
    }
}
