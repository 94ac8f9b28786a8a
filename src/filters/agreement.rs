//! Where the content of a frame is the same as that of another of its sequence: weights by which the two may
//! be averaged.
//!
//! Vectors lead to where a surface was, and know nothing of what covers it, of shadows, mirrors, glass and
//! lamps. So what is found there is held against what is here: albedo, normal and depth, and the light
//! itself, whose means around a place must not differ by more than its noise explains. All are taken of 2x2
//! squares of pixels, and of the 3x3 squares around one: single pixels of few samples say little.
//!
//! In: passes of two frames and the [`Flow`] between them. Out: a weight for every pixel, 0 where nothing
//! agrees.

use rayon::prelude::*;

use super::motion::{Flow, bilinear};
use crate::planes::Planes;

/// How different two places may be, as hand-fitted on rendered sequences (docs/decisions.md): what a learned
/// comparison would replace.
#[derive(Clone, Copy, Debug)]
pub struct Tolerances {
    /// How far the variance of a mean of the light falls below that of one pixel.
    pub pixels: f32,
    /// Squared relative difference of the light, beyond noise, that nobody sees.
    pub light: f32,
    /// The squared difference of means, in units of the variance of that difference, up to which two places
    /// agree, and how much more makes the weight smaller by e.
    pub noise: (f32, f32),
    /// The squared difference of normals that makes the weight smaller by e.
    pub normal: f32,
    /// The same of albedos, relative.
    pub albedo: f32,
    /// The same of depths, relative.
    pub depth: f32,
}

/// Those of the built-in way.
pub const TOLERANCES: Tolerances =
    Tolerances { pixels: 20.0, light: 5e-5, noise: (1.5, 3.0), normal: 0.015, albedo: 0.009, depth: 0.009 };

/// Rows and columns of a square.
const SQUARE: usize = 2;

/// Added to the albedo before light is divided by it.
const ALBEDO_FLOOR: f32 = 0.02;

/// Added to squared albedos, and to depths, before differences are divided by them.
const DARK: f32 = 0.01;
const NEAR: f32 = 1e-3;

/// Below this, no weight counts.
const LEAST: f32 = 0.02;

/// Planes of what is compared.
const LIGHT: usize = 0;
const VARIANCE: usize = 3;
const ALBEDO: usize = 6;
const NORMAL: usize = 9;
const DEPTH: usize = 12;
const LINES: usize = 13;

/// The passes of a frame that tell where another agrees with it; guides that are not there agree everywhere.
#[derive(Clone, Copy)]
pub struct Evidence<'a> {
    /// Noisy radiance, (3, H, W), finite.
    pub radiance: &'a Planes,
    /// Albedo, (3, H, W).
    pub albedo: Option<&'a Planes>,
    /// Normal, (3, H, W).
    pub normal: Option<&'a Planes>,
    /// Depth, (1, H, W).
    pub depth: Option<&'a Planes>,
}

/// What a frame looks like to the comparison: means over squares of light (its fourth root, over the albedo),
/// the variance of that, albedo, normal and depth.
#[derive(Clone, Debug)]
pub struct Look {
    size: (usize, usize),
    squares: Planes,
}

impl Look {
    /// Of a frame.
    ///
    /// # Panics
    /// If the planes are empty, or their sizes or channels differ from what is told of them.
    pub fn of(frame: &Evidence) -> Self {
        let (width, height) = (frame.radiance.width, frame.radiance.height);
        let (columns, rows) = (width.div_ceil(SQUARE), height.div_ceil(SQUARE));
        // A row of squares at a time, all planes of it together: the light is computed once for two of them.
        let mut lines = vec![0.0; rows * LINES * columns];
        lines.par_chunks_mut(LINES * columns).enumerate().for_each_init(
            || vec![0.0; 2 * width],
            |pixels, (row, lines)| {
                for y in row * SQUARE..((row + 1) * SQUARE).min(height) {
                    let mut add = |line: usize, values: &[f32]| {
                        let line = &mut lines[line * columns..][..columns];
                        line.iter_mut()
                            .zip(values.chunks(SQUARE))
                            .for_each(|(sum, v)| *sum += v.iter().sum::<f32>());
                    };
                    let row_of = |planes: &'_ Planes, c: usize| y * width + c * planes.pixels();
                    for c in 0..3 {
                        let light = &frame.radiance.data[row_of(frame.radiance, c)..][..width];
                        let (roots, squares) = pixels.split_at_mut(width);
                        match frame.albedo {
                            Some(albedo) => {
                                let albedo = &albedo.data[row_of(albedo, c)..][..width];
                                add(ALBEDO + c, albedo);
                                let both = light.iter().zip(albedo);
                                roots.iter_mut().zip(both).for_each(|(root, (light, albedo))| {
                                    *root = (light.max(0.0) / (albedo.max(0.0) + ALBEDO_FLOOR)).sqrt().sqrt();
                                });
                            }
                            None => {
                                roots
                                    .iter_mut()
                                    .zip(light)
                                    .for_each(|(root, v)| *root = v.max(0.0).sqrt().sqrt());
                            }
                        }
                        squares.iter_mut().zip(&*roots).for_each(|(square, root)| *square = root * root);
                        add(LIGHT + c, roots);
                        add(VARIANCE + c, squares);
                        if let Some(normal) = frame.normal {
                            add(NORMAL + c, &normal.data[row_of(normal, c)..][..width]);
                        }
                    }
                    if let Some(depth) = frame.depth {
                        add(DEPTH, &depth.data[y * width..][..width]);
                    }
                }
                // Squares at the right and lower edge may be cut.
                let tall = ((row + 1) * SQUARE).min(height) - row * SQUARE;
                for (x, column) in (0..columns).map(|x| (x, ((x + 1) * SQUARE).min(width) - x * SQUARE)) {
                    let share = 1.0 / (tall * column) as f32;
                    (0..LINES).for_each(|line| lines[line * columns + x] *= share);
                }
            },
        );
        let of = |row: usize, line: usize| &lines[(row * LINES + line) * columns..][..columns];
        let mut squares = Planes::from_rows(LINES, (columns, rows), |line, row, out| {
            let (above, below) = (row.saturating_sub(1), (row + 1).min(rows - 1));
            let [above, here, below] = [above, row, below].map(|row| of(row, line));
            for (x, out) in out.iter_mut().enumerate() {
                let (left, right) = (x.saturating_sub(1), (x + 1).min(columns - 1));
                let sum = |line: &[f32]| line[left] + line[x] + line[right];
                *out = (sum(above) + sum(here) + sum(below)) / 9.0;
            }
        });
        let pixels = squares.pixels();
        let (means, rest) = squares.data.split_at_mut(VARIANCE * pixels);
        rest.par_iter_mut()
            .zip(means)
            .for_each(|(square, mean)| *square = (*square - *mean * *mean).max(0.0));
        Self { size: (width, height), squares }
    }

    /// How far each pixel may be averaged with that of `other` to which the flow leads: from 0 to 1, (1, H,
    /// W).
    ///
    /// # Panics
    /// If sizes differ.
    pub fn agreement(&self, other: &Self, flow: &Flow, tolerances: &Tolerances) -> Planes {
        assert!(self.size == other.size && self.size == flow.size(), "frames of one size");
        let (columns, rows) = (self.squares.width, self.squares.height);
        let of_squares = Planes::from_rows(1, (columns, rows), |_, row, out| {
            let from = flow.row((row * SQUARE + 1).min(self.size.1 - 1));
            for (x, out) in out.iter_mut().enumerate() {
                // The lower right pixel is half a pixel beside the middle of the square.
                let at = (x * SQUARE + 1).min(self.size.0 - 1);
                let place = [from.0[at], from.1[at]].map(|v| (v - 1.0) / SQUARE as f32);
                *out = if place[0].is_nan() {
                    0.0
                } else {
                    self.agreement_of(row * columns + x, other, (place[0], place[1]), tolerances)
                };
            }
        });
        Planes::from_rows(1, self.size, |_, y, out| {
            let (to_x, to_y) = flow.row(y);
            let y = (y as f32 - 0.5) / SQUARE as f32;
            for (x, out) in out.iter_mut().enumerate() {
                let place = ((x as f32 - 0.5) / SQUARE as f32, y);
                let weight = bilinear(of_squares.channel(0), (columns, rows), place);
                let counts = weight >= LEAST && !to_x[x].is_nan() && !to_y[x].is_nan();
                *out = if counts { weight } else { 0.0 };
            }
        })
    }

    /// How far a square agrees with a place among those of another frame.
    fn agreement_of(&self, square: usize, other: &Self, place: (f32, f32), tolerances: &Tolerances) -> f32 {
        let size = (self.squares.width, self.squares.height);
        let here = |line: usize| self.squares.channel(line)[square];
        let there = |line: usize| bilinear(other.squares.channel(line), size, place);
        let three = |first: usize| [0, 1, 2].map(|c| (here(first + c), there(first + c)));
        let means = three(LIGHT);
        let variances = three(VARIANCE);
        let light = means.iter().zip(variances).map(|((a, b), (of_a, of_b))| {
            let expected = (of_a + of_b) / tolerances.pixels + tolerances.light * a * a;
            (a - b) * (a - b) / expected.max(f32::MIN_POSITIVE)
        });
        let light = (light.sum::<f32>() / 3.0 - tolerances.noise.0).max(0.0) / tolerances.noise.1;
        let normal: f32 = three(NORMAL).map(|(a, b)| (a - b) * (a - b)).iter().sum();
        let albedo = three(ALBEDO).map(|(a, b)| (a - b) * (a - b) / (a.max(b) * a.max(b) + DARK));
        let (a, b) = (here(DEPTH), there(DEPTH));
        let depth = (a - b) / (a.abs().max(b.abs()) + NEAR);
        let unlike = light
            + normal / tolerances.normal
            + albedo.iter().sum::<f32>() / (3.0 * tolerances.albedo)
            + depth * depth / tolerances.depth;
        (-unlike).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{filters::motion::Direction, rng::Rng};

    const SIZE: (usize, usize) = (61, 46);

    /// A frame of noisy light of some brightness by column, before a wall of one colour.
    fn frame(seed: u64, brightness: impl Fn(usize) -> f32) -> [Planes; 4] {
        let mut rng = Rng::new(seed, 0);
        let (w, h) = SIZE;
        let noise: Vec<f32> = (0..w * h).map(|_| 0.25 + 1.5 * rng.uniform()).collect();
        let radiance =
            (0..3 * w * h).map(|i| 0.4 * brightness(i % w) * noise[i % (w * h)]).collect::<Vec<f32>>();
        let normal = (0..3 * w * h).map(|i| if i < 2 * w * h { 0.0 } else { 1.0 }).collect();
        [
            Planes::from_vec(3, w, h, radiance),
            Planes::from_vec(3, w, h, vec![0.5; 3 * w * h]),
            Planes::from_vec(3, w, h, normal),
            Planes::from_vec(1, w, h, vec![4.0; w * h]),
        ]
    }

    fn look([radiance, albedo, normal, depth]: &[Planes; 4]) -> Look {
        let evidence = Evidence { radiance, albedo: Some(albedo), normal: Some(normal), depth: Some(depth) };
        Look::of(&evidence)
    }

    fn mean(weights: &Planes, columns: std::ops::Range<usize>) -> f32 {
        let (w, n) = (weights.width, columns.len() * weights.height);
        let values = (0..weights.height).flat_map(|y| columns.clone().map(move |x| y * w + x));
        values.map(|i| weights.data[i]).sum::<f32>() / n as f32
    }

    #[test]
    fn noise_agrees_and_light_that_moved_does_not() {
        let still = Flow::still(SIZE.0, SIZE.1);
        let lit = look(&frame(1, |_| 1.0));
        let same = lit.agreement(&look(&frame(2, |_| 1.0)), &still, &TOLERANCES);
        assert!(mean(&same, 0..SIZE.0) > 0.85, "{}", mean(&same, 0..SIZE.0));
        // A shadow has fallen on the right half.
        let shadow = look(&frame(3, |x| if x < 30 { 1.0 } else { 0.4 }));
        let weights = lit.agreement(&shadow, &still, &TOLERANCES);
        assert!(mean(&weights, 0..26) > 0.85 && mean(&weights, 36..SIZE.0) < 0.05);
        assert!(weights.data.iter().all(|w| (0.0..=1.0).contains(w)));
    }

    #[test]
    fn any_guide_alone_tells_surfaces_apart() {
        let still = Flow::still(SIZE.0, SIZE.1);
        let here = frame(1, |_| 1.0);
        for (guide, value) in [(1, 0.8), (2, 0.5), (3, 6.0)] {
            let mut other = frame(2, |_| 1.0);
            other[guide].data.fill(value);
            // Light over albedo stays what it was.
            if guide == 1 {
                let (old, new) = (0.5 + ALBEDO_FLOOR, value + ALBEDO_FLOOR);
                other[0].data.iter_mut().for_each(|v| *v *= new / old);
            }
            let weights = look(&here).agreement(&look(&other), &still, &TOLERANCES);
            assert!(mean(&weights, 0..SIZE.0) < 0.1, "guide {guide}: {}", mean(&weights, 0..SIZE.0));
        }
    }

    #[test]
    fn nothing_agrees_with_what_is_outside() {
        let mut flow = Flow::still(SIZE.0, SIZE.1);
        let vectors = Planes::from_rows(4, SIZE, |c, _, out| out.fill(if c == 0 { 20.0 } else { 0.0 }));
        flow.step(&vectors, Direction::Back);
        let weights = look(&frame(1, |_| 1.0)).agreement(&look(&frame(2, |_| 1.0)), &flow, &TOLERANCES);
        assert!(mean(&weights, 0..38) > 0.85 && mean(&weights, 41..SIZE.0) == 0.0);
    }

    #[test]
    fn tiny_and_black_frames_have_weights() {
        for (w, h) in [(1, 1), (1, 5), (2, 2), (3, 1)] {
            let black = Planes::new(3, w, h);
            let look = Look::of(&Evidence { radiance: &black, albedo: None, normal: None, depth: None });
            let weights = look.agreement(&look, &Flow::still(w, h), &TOLERANCES);
            assert!(weights.data.iter().all(|v| *v == 1.0), "{w}x{h}: {:?}", weights.data.to_vec());
        }
    }
}
