//! Whether two frames differ by noise alone, or by content that moved otherwise than its vectors say.
//!
//! The noise of a pixel has nothing in common with that of the pixels beside it. A shadow, a reflection or a bar of light
//! that moved leaves a difference that is alike over several pixels. [`agreement`](super::agreement) compares means over
//! 6x6 pixels, of which those of narrow things stay the same when these move by their own width: averaged then, they leave
//! ghosts, however many samples the frames have. So here the squared difference of single pixels is held against that of means of
//! three pixels beside each other, three below each other, and three by three. Of noise, means have a third and a
//! ninth; where they have more, neighbours count less. (Cycles keeps the noise of pixels apart: whatever the pixel filter, each
//! sample counts in one.)
//!
//! In: light and albedo of two frames and the [`Flow`] between them. Out: lower weights, where that is so.

use rayon::prelude::*;

use super::{
    agreement::{ALBEDO_FLOOR, Add, SQUARE},
    box_mean,
    motion::Flow,
};
use crate::{
    kernels::{
        exponential::exp,
        vectorised::{self, Vectorised},
    },
    planes::{Planes, Values},
};

/// What is compared of a frame.
#[derive(Clone, Copy)]
pub struct Sight<'a> {
    /// (3, H, W), finite.
    pub light: &'a dyn Values,
    /// (3, H, W), if there is one: light is divided by it.
    pub albedo: Option<&'a dyn Values>,
}

/// Squared differences are summed up in squares of 2x2 pixels, and compared over so many of them in each direction: 10x10 pixels.
const REACH: usize = 2;

/// Lines of sums: squared differences of pixels, and of means over 3x1, 1x3 and 3x3 of them.
const LINES: usize = 4;

/// By how much the squares of these means are less, of noise.
const OF_NOISE: [f32; LINES - 1] = [3.0, 3.0, 9.0];

/// So many times what noise leaves of them, in the mean of the three or along one direction, is still noise: one place in a
/// hundred has more than the second by chance. Moving leaves' shade of a few pixels has 1.5 to 1.7, bars 2.4 and more. Of fewer than
/// [`MANY`] samples, or if they are not known, the first holds: there neighbours bring more than the edge of a soft shadow costs.
const STARTS: (f32, f32) = (2.0, 1.45);
const MANY: u32 = 16;

/// How much more makes weights smaller by e.
const FALLS: f32 = 0.06;

/// Only those squares lose their weight whose own means have more than the first times what noise leaves on average around
/// them, and all of it from the second on: beside a thing that moved, what stood still is averaged.
const HERE: (f32, f32) = (1.0, 2.0);

/// Squared relative difference of fourth roots of light that nobody sees.
const UNSEEN: f32 = 3e-6;

/// Lowers the weights of pixels of another frame, (1, H, W), where it differs from this one by more than noise.
/// `brightness` is how many times as bright this frame is, `samples` those of its pixels.
///
/// # Panics
/// If sizes differ.
pub fn lower(
    weights: &mut Planes,
    flow: &Flow,
    [own, there]: [Sight; 2],
    brightness: f32,
    samples: Option<u32>,
) {
    let size = (weights.width, weights.height);
    assert!(flow.size() == size && weights.channels == 1, "weights of the frame");
    for sight in [own, there] {
        assert_eq!(sight.light.extent(), (3, size.0, size.1), "light of the frame");
    }
    let factor = brightness.sqrt().sqrt();
    let starts = if samples.is_some_and(|samples| samples >= MANY) { STARTS.1 } else { STARTS.0 };
    let differences =
        Planes::from_rows(1, size, |_, y, out| difference_of_row(y, flow, own, there, factor, out));
    let squares = (size.0.div_ceil(SQUARE), size.1.div_ceil(SQUARE));
    let sums = Planes::from_rows_of_all(LINES, squares, |row, lines| {
        lines.iter_mut().for_each(|line| line.fill(0.0));
        let none = vec![0.0; size.0];
        let mut means = [(); LINES - 1].map(|()| vec![0.0; size.0]);
        let line = |y: Option<usize>| y.filter(|y| *y < size.1).map_or(&none[..], |y| differences.row(0, y));
        for y in row * SQUARE..((row + 1) * SQUARE).min(size.1) {
            let [above, here, below] = [y.checked_sub(1), Some(y), Some(y + 1)].map(line);
            vectorised::run(Means { above, here, below, means: &mut means });
            let of_means = means.iter().map(|mean| &mean[..]);
            for (sums, values) in lines.iter_mut().zip([here].into_iter().chain(of_means)) {
                vectorised::run(Add { values, is_squared: true, sums });
            }
        }
    });
    let fall = Planes::from_rows(1, squares, |_, row, out| {
        let mut of_lines = [(); LINES].map(|()| vec![0.0; squares.0]);
        for (line, around) in of_lines.iter_mut().enumerate() {
            box_mean::row(sums.channel(line), squares, row, REACH, around);
        }
        let [pixels, means @ ..] = &of_lines;
        for (column, out) in out.iter_mut().enumerate() {
            let noise = pixels[column] + (SQUARE * SQUARE) as f32 * UNSEEN;
            let times = |of: &dyn Fn(usize) -> f32| -> [f32; LINES - 1] {
                std::array::from_fn(|i| OF_NOISE[i] * of(i) / noise)
            };
            let [upright, level, both] = times(&|i| means[i][column]);
            let around = ((upright + level + both) / 3.0).max(upright).max(level);
            let here = times(&|i| sums.row(i + 1, row)[column]).into_iter().fold(0.0, f32::max);
            let share = ((here - HERE.0) / (HERE.1 - HERE.0)).clamp(0.0, 1.0);
            *out = (around - starts).max(0.0) / FALLS * share;
        }
    });
    weights.data.par_chunks_mut(size.0.max(1)).enumerate().for_each(|(y, weights)| {
        for (weights, fall) in weights.chunks_mut(SQUARE).zip(fall.row(0, y / SQUARE)) {
            let share = exp(-fall);
            weights.iter_mut().for_each(|weight| *weight *= share);
        }
    });
}

/// The relative difference of the fourth roots of a row's light from those to which the flow leads, over the albedo; 0
/// outside. Roots keep single sparks from deciding.
fn difference_of_row(y: usize, flow: &Flow, own: Sight, there: Sight, factor: f32, out: &mut [f32]) {
    let width = out.len();
    out.fill(0.0);
    let mut value = vec![0.0; width];
    let mut quotients = [(); 2].map(|()| vec![0.0; width]);
    let mut albedos = [(); 2].map(|()| vec![1.0; width]);
    let stretches = flow.nearest_of_row(y);
    for (i, sight) in [own, there].into_iter().enumerate() {
        let mut add = |of: &dyn Values, c: usize, sums: &mut [f32]| {
            if i == 0 {
                of.read(c, y * width, &mut value);
            } else {
                stretches.iter().for_each(|stretch| of.read(c, stretch.there, stretch.of_mut(&mut value)));
            }
            sums.iter_mut().zip(&value).for_each(|(sum, v)| *sum += v.max(0.0));
        };
        (0..3).for_each(|c| add(sight.light, c, &mut quotients[i]));
        if let Some(albedo) = sight.albedo {
            albedos[i].fill(3.0 * ALBEDO_FLOOR);
            (0..3).for_each(|c| add(albedo, c, &mut albedos[i]));
        }
    }
    for stretch in &stretches {
        let [own, there] = [0, 1].map(|i| [stretch.of(&quotients[i]), stretch.of(&albedos[i])]);
        vectorised::run(Differ { own, there, factor, out: stretch.of_mut(out) });
    }
}

/// Relative differences of fourth roots of light, each given as light and albedo.
struct Differ<'a> {
    own: [&'a [f32]; 2],
    there: [&'a [f32]; 2],
    factor: f32,
    out: &'a mut [f32],
}

impl Vectorised for Differ<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { own, there, factor, out } = self;
        let own = own[0].iter().zip(own[1]);
        let there = there[0].iter().zip(there[1]);
        for (out, ((light, albedo), (other, of_other))) in out.iter_mut().zip(own.zip(there)) {
            let (a, b) = ((light / albedo).sqrt().sqrt(), factor * (other / of_other).sqrt().sqrt());
            *out = 2.0 * (a - b) / (a + b).max(f32::MIN_POSITIVE);
        }
    }
}

/// Means over three pixels below each other, beside each other, and three by three, of a row. Beyond the frame are zeros.
struct Means<'a> {
    above: &'a [f32],
    here: &'a [f32],
    below: &'a [f32],
    means: &'a mut [Vec<f32>; LINES - 1],
}

impl Vectorised for Means<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { above, here, below, means: [upright, level, whole] } = self;
        for (mean, ((above, here), below)) in upright.iter_mut().zip(above.iter().zip(here).zip(below)) {
            *mean = (above + here + below) * (1.0 / 3.0);
        }
        beside(here, level);
        beside(upright, whole);
    }
}

/// The mean of each value and those beside it.
#[inline(always)]
fn beside(values: &[f32], means: &mut [f32]) {
    means.copy_from_slice(values);
    means.iter_mut().zip(values.iter().skip(1)).for_each(|(mean, next)| *mean += next);
    means.iter_mut().skip(1).zip(values).for_each(|(mean, before)| *mean += before);
    means.iter_mut().for_each(|mean| *mean *= 1.0 / 3.0);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;

    const SIZE: (usize, usize) = (61, 46);

    type Light<'a> = &'a (dyn Fn(usize, usize) -> f32 + Sync);

    /// The mean weight that is left of 1 where light and there is `light(column, row)` with noise of so much.
    fn left([own, there]: [Light; 2], noise: f32) -> f32 {
        let mut rng = Rng::new(7, 0);
        let mut frame = |light: Light| {
            let draws: Vec<f32> =
                (0..SIZE.0 * SIZE.1).map(|_| 1.0 + noise * (2.0 * rng.uniform() - 1.0)).collect();
            Planes::from_rows(3, SIZE, |_, y, out| {
                out.iter_mut().enumerate().for_each(|(x, v)| *v = light(x, y) * draws[y * SIZE.0 + x]);
            })
        };
        let (own, there) = (frame(own), frame(there));
        let sight = |light| Sight { light, albedo: None };
        let mut weights = Planes::from_vec(1, SIZE.0, SIZE.1, vec![1.0; SIZE.0 * SIZE.1]);
        let still = Flow::still(SIZE.0, SIZE.1);
        lower(&mut weights, &still, [sight(&own), sight(&there)], 1.0, Some(MANY));
        weights.data.iter().sum::<f32>() / weights.data.len() as f32
    }

    #[test]
    fn noise_stays() {
        let wall = |_, _| 0.7;
        for noise in [0.0, 0.01, 0.3, 0.99] {
            assert!(left([&wall, &wall], noise) > 0.95, "{noise}: {}", left([&wall, &wall], noise));
        }
        // A difference that nobody sees.
        let brighter = |_, _| 0.7005;
        assert!(left([&wall, &brighter], 0.0) > 0.95);
    }

    #[test]
    fn what_moved_by_its_own_width_goes() {
        // In a third of the frame, half of the pixels show a bar in one of the frames, or one line in six.
        let bars =
            |from: usize| move |x: usize, _| if x < 24 && (x + 30 - from) % 12 < 3 { 2.3 } else { 0.3 };
        let lines =
            |from: usize| move |x: usize, _| if x < 24 && (x + 30 - from) % 12 < 1 { 2.3 } else { 0.3 };
        for noise in [0.05, 0.3] {
            let bars = left([&bars(0), &bars(3)], noise);
            let lines = left([&lines(0), &lines(1)], noise);
            assert!((0.6..0.82).contains(&bars) && (0.7..0.95).contains(&lines), "{noise}: {bars}, {lines}");
        }
    }

    #[test]
    fn shade_of_leaves_that_moves_goes() {
        let leaves = |from: f32| {
            move |x: usize, y: usize| {
                let (x, y) = (x as f32, y as f32);
                let shade = (0.9 * (x - from) + 0.5 * (0.4 * y).sin()).sin() * (0.8 * y + 0.3 * x).sin();
                if shade > 0.1 { 1.0 } else { 0.15 }
            }
        };
        for noise in [0.05, 0.4] {
            let left = left([&leaves(0.0), &leaves(1.5)], noise);
            assert!(left < 0.75, "{noise}: {left}");
        }
    }
}
