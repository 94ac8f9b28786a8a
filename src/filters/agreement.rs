//! Where the content of a frame is the same as that of another of its sequence: weights by which the two may
//! be averaged, learned from short sequences and the reference of their middle frame.
//!
//! Vectors lead to where a surface was, and know nothing of what covers it, of shadows, mirrors, glass and
//! lamps. So what is found there is held against what is here: albedo, normal and depth, and the light
//! itself, whose means around a place may differ by what its noise explains. Means are of 2x2 squares of
//! pixels, and of the 3x3 squares around one, because single pixels of few samples say little. But albedo,
//! normal and depth are compared pixel by pixel as well: at an edge that has moved by one pixel, means over
//! squares see no difference. From all that a perceptron finds the weight, and the differences of squares
//! alone bound it. It was trained by `eval/training/neighbours.py` to make the error of the averaged render
//! least. That error is of means over 3x3 to 13x13 pixels, since single pixels are what a denoiser averages.
//!
//! In: passes of two frames and the [`Flow`] between them. Out: a weight for every pixel, 0 where there is
//! nothing to compare.

use std::sync::LazyLock;

use rayon::prelude::*;

use super::{
    motion::{self, Flow, aside, nearest},
    perceptron::Perceptron,
};
use crate::{
    kernels::{
        exponential::exp,
        logarithm::ln,
        vectorised::{self, Vectorised},
    },
    planes::Planes,
};

/// Lines of [`Look::features`] of a row of pixels. First come those of squares: logarithms of how different
/// they are, and the logarithm of the largest weight. Then come those of single pixels: logarithms
/// of how different their guides are, and how far the content lies from a pixel's centre.
pub const FEATURES: usize = OF_SQUARES + OF_GUIDES + 1;
const OF_SQUARES: usize = LOGARITHMS + 1;
const LOGARITHMS: usize = 8;
const OF_GUIDES: usize = 3;
const GATE: usize = LOGARITHMS;

/// Added to the values of squares before their logarithm is taken: the squared difference of the light's
/// means in units of its variance, that difference and its variance relative to the light, relative squared
/// differences of normal, albedo and depth, and the variances of normal and albedo in the frame itself.
const TINY_OF_SQUARES: [f32; LOGARITHMS] = [1e-2, 1e-5, 1e-6, 1e-4, 1e-4, 1e-5, 1e-4, 1e-4];

/// Likewise, to relative squared differences of normal, albedo and depth of single pixels.
const TINY_OF_PIXELS: f32 = 1e-4;

/// What the largest weight follows from, as fitted by hand on rendered sequences (docs/decisions.md): up to
/// which squared difference of the light's means, in units of its variance, two places agree, and how much
/// more makes the weight smaller by e; and which relative squared differences of normal, albedo and depth do
/// so. Training alone sees too few mirrors to learn how easily a weight at the edge of a reflection harms.
const AGREES: f32 = 1.5;
const LIGHT_DIFFERS: f32 = 3.0;
const NORMAL_DIFFERS: f32 = 0.015;
const ALBEDO_DIFFERS: f32 = 0.009;
const DEPTH_DIFFERS: f32 = 0.009;

/// How far the variance of a mean of the light falls below that of one pixel.
const PIXELS: f32 = 20.0;

/// Squared relative difference of the light, beyond noise, that nobody sees.
const UNSEEN: f32 = 5e-5;

/// Rows and columns of a square.
const SQUARE: usize = 2;

/// Added to the albedo before light is divided by it.
const ALBEDO_FLOOR: f32 = 0.02;

/// Added to the squared light, to squared albedos, and to depths, before differences are divided by them.
const DIM: f32 = 1e-4;
const DARK: f32 = 0.01;
const NEAR: f32 = 1e-3;

/// Logarithms of the least and the largest weight that the perceptron gives, and the least of [`GATE`].
const LEAST: f32 = -8.0;
const MOST: f32 = 0.0;
const FARTHEST: f32 = 16.0;

/// Planes of what is compared.
const LIGHT: usize = 0;
const VARIANCE: usize = 3;
const ALBEDO: usize = 6;
const NORMAL: usize = 9;
const DEPTH: usize = 12;
const SPREAD_OF_NORMAL: usize = 13;
const SPREAD_OF_ALBEDO: usize = 14;
const LINES: usize = 15;

static PERCEPTRON: LazyLock<Perceptron> =
    LazyLock::new(|| Perceptron::read(include_bytes!("agreement.safetensors"), FEATURES, 1));

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

/// What a frame looks like from a little way off: means over squares of light (its fourth root, over the
/// albedo), the variance of that, albedo, normal and depth.
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
                        let guides = [
                            (frame.albedo, ALBEDO, SPREAD_OF_ALBEDO),
                            (frame.normal, NORMAL, SPREAD_OF_NORMAL),
                        ];
                        for (planes, line, spread) in guides {
                            let Some(planes) = planes else { continue };
                            let values = &planes.data[row_of(planes, c)..][..width];
                            add(line + c, values);
                            squares.iter_mut().zip(values).for_each(|(square, v)| *square = v * v);
                            add(spread, squares);
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
        let (means, spreads) = squares.data.split_at_mut(SPREAD_OF_NORMAL * pixels);
        for (first, spread) in [NORMAL, ALBEDO].into_iter().zip(spreads.chunks_exact_mut(pixels)) {
            let mean = |at: usize| -> f32 {
                (first..first + 3).map(|line| means[line * pixels + at]).map(|mean| mean * mean).sum()
            };
            spread
                .par_iter_mut()
                .enumerate()
                .for_each(|(at, spread)| *spread = (*spread - mean(at)).max(0.0));
        }
        let (means, rest) = squares.data.split_at_mut(VARIANCE * pixels);
        rest.par_iter_mut()
            .zip(means)
            .for_each(|(square, mean)| *square = (*square - *mean * *mean).max(0.0));
        Self { size: (width, height), squares }
    }

    /// What the perceptron reads of every pixel and of the one to which the flow leads: [`FEATURES`] lines for
    /// each row, (H, FEATURES, W) as one plane. `own` and `there` are what both looks were made of.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn features(&self, other: &Self, flow: &Flow, own: &Evidence, there: &Evidence) -> Planes {
        let (width, height) = self.size;
        let of_squares = self.features_of_squares(other, flow);
        Planes::from_rows(1, (FEATURES * width, height), |_, y, out| {
            self.features_of_row(y, &of_squares, flow, [own, there], out);
        })
    }

    /// The [`FEATURES`] lines of a row of pixels.
    fn features_of_row(
        &self,
        y: usize,
        of_squares: &Planes,
        flow: &Flow,
        [own, there]: [&Evidence; 2],
        out: &mut [f32],
    ) {
        let width = self.size.0;
        let (columns, rows) = (self.squares.width, self.squares.height);
        let (squares, pixels) = out.split_at_mut(OF_SQUARES * width);
        // The middle of a square lies half a pixel before its second row.
        let place = ((y as f32 - 0.5) / SQUARE as f32).clamp(0.0, (rows - 1) as f32);
        let (above, down) = (place as usize, place.fract());
        let below = (above + 1).min(rows - 1);
        let [above, below] =
            [above, below].map(|row| &of_squares.data[row * OF_SQUARES * columns..][..OF_SQUARES * columns]);
        vectorised::run(Between { above, below, down, columns, out: squares, width });
        self.compare_pixels(y, flow, own, there, pixels);
    }

    /// Lines of a row of squares, (rows, OF_SQUARES, columns) as one plane.
    fn features_of_squares(&self, other: &Self, flow: &Flow) -> Planes {
        assert!(self.size == other.size && self.size == flow.size(), "frames of one size");
        let (columns, rows) = (self.squares.width, self.squares.height);
        Planes::from_rows(1, (OF_SQUARES * columns, rows), |_, row, out| {
            let from = flow.row((row * SQUARE + 1).min(self.size.1 - 1));
            for x in 0..columns {
                // The lower right pixel is half a pixel beside the middle of the square.
                let at = (x * SQUARE + 1).min(self.size.0 - 1);
                let place = [from.0[at], from.1[at]].map(|v| (v - 1.0) / SQUARE as f32);
                let values = if place[0].is_nan() {
                    [1.0; LOGARITHMS]
                } else {
                    self.compare_squares(row * columns + x, other, (place[0], place[1]))
                };
                values.iter().zip(TINY_OF_SQUARES).enumerate().for_each(|(line, (value, tiny))| {
                    out[line * columns + x] = ln(value + tiny);
                });
                let [noise, _, _, normal, albedo, depth, ..] = values;
                let unlike = (noise - AGREES).max(0.0) / LIGHT_DIFFERS
                    + normal / NORMAL_DIFFERS
                    + albedo / ALBEDO_DIFFERS
                    + depth / DEPTH_DIFFERS;
                out[GATE * columns + x] = -unlike.min(FARTHEST);
            }
        })
    }

    /// How different a square is from a place among those of another frame; see [`TINY_OF_SQUARES`].
    fn compare_squares(&self, square: usize, other: &Self, place: (f32, f32)) -> [f32; LOGARITHMS] {
        let size = (self.squares.width, self.squares.height);
        let here = |line: usize| self.squares.channel(line)[square];
        let between = motion::Between::new(place, size);
        let there = |line: usize| between.of(other.squares.channel(line));
        let three = |first: usize| [0, 1, 2].map(|c| (here(first + c), there(first + c)));
        let mut light = [0.0; 3];
        for ((a, b), (of_a, of_b)) in three(LIGHT).into_iter().zip(three(VARIANCE)) {
            let (squared, variance) = ((a - b) * (a - b), (of_a + of_b) / PIXELS);
            light[0] += squared / (variance + UNSEEN * a * a).max(f32::MIN_POSITIVE);
            light[1] += squared / (a * a + b * b + DIM);
            light[2] += variance / (a * a + DIM);
        }
        let [noise, relative, variance] = light.map(|sum| sum * (1.0 / 3.0));
        let [normal, albedo] = [NORMAL, ALBEDO].map(three);
        let depth = (here(DEPTH), there(DEPTH));
        let bright: f32 = albedo.iter().map(|(own, _)| own * own).sum();
        [
            noise,
            relative,
            variance,
            of_normals(normal),
            of_albedos(albedo),
            of_depths(depth),
            here(SPREAD_OF_NORMAL),
            here(SPREAD_OF_ALBEDO) / (bright + DARK),
        ]
    }

    /// Lines of a row of pixels: how different albedo, normal and depth of each are from those of the nearest
    /// pixel of the other frame, and how far from that pixel the content lies.
    fn compare_pixels(&self, y: usize, flow: &Flow, own: &Evidence, there: &Evidence, out: &mut [f32]) {
        let width = self.size.0;
        let (columns, rows) = flow.row(y);
        let (out, beside) = out.split_at_mut(OF_GUIDES * width);
        let [normal, albedo] =
            [(own.normal, there.normal), (own.albedo, there.albedo)].map(|(own, there)| own.zip(there));
        let depth = own.depth.zip(there.depth);
        let channels =
            |planes: &'_ Planes, at: usize| [0, 1, 2].map(|c| planes.data[c * planes.pixels() + at]);
        for x in 0..width {
            let values = match nearest((columns[x], rows[x]), self.size) {
                None => [1.0; OF_GUIDES],
                Some(other) => {
                    let pair = |(own, there): (&Planes, &Planes)| {
                        let (a, b) = (channels(own, y * width + x), channels(there, other));
                        [0, 1, 2].map(|c| (a[c], b[c]))
                    };
                    [
                        normal.map_or(0.0, |both| of_normals(pair(both))),
                        albedo.map_or(0.0, |both| of_albedos(pair(both))),
                        depth.map_or(0.0, |(a, b)| of_depths((a.data[y * width + x], b.data[other]))),
                    ]
                }
            };
            values.into_iter().enumerate().for_each(|(line, value)| out[line * width + x] = value);
            beside[x] = aside(columns[x], rows[x]);
        }
        vectorised::run(Logarithms(out));
    }

    /// How far each pixel may be averaged with that of `other` to which the flow leads, beside 1 for its own:
    /// from 0 to 1, (1, H, W). `own` and `there` are what both looks were made of.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn agreement(&self, other: &Self, flow: &Flow, own: &Evidence, there: &Evidence) -> Planes {
        let of_squares = self.features_of_squares(other, flow);
        let width = self.size.0;
        // A row at a time: features of a whole frame would take many times its memory.
        Planes::from_rows(1, self.size, |_, y, out| {
            let mut features = vec![0.0; FEATURES * width];
            self.features_of_row(y, &of_squares, flow, [own, there], &mut features);
            PERCEPTRON.apply(&features, width, out);
            vectorised::run(Weights { columns: flow.row(y).0, gate: &features[GATE * width..], out });
        })
    }
}

/// The squared difference of two normals.
fn of_normals(normals: [(f32, f32); 3]) -> f32 {
    normals.iter().map(|(a, b)| (a - b) * (a - b)).sum()
}

/// The relative squared difference of two albedos.
fn of_albedos(albedos: [(f32, f32); 3]) -> f32 {
    let relative = |(a, b): &(f32, f32)| (a - b) * (a - b) / (a.max(*b) * a.max(*b) + DARK);
    albedos.iter().map(relative).sum::<f32>() * (1.0 / 3.0)
}

/// The relative squared difference of two depths.
fn of_depths((a, b): (f32, f32)) -> f32 {
    let depth = (a - b) / (a.abs().max(b.abs()) + NEAR);
    depth * depth
}

/// Lines of a row of pixels between two rows of squares, `down` of the way from the one `above` to the one
/// `below`.
struct Between<'a> {
    above: &'a [f32],
    below: &'a [f32],
    down: f32,
    columns: usize,
    out: &'a mut [f32],
    width: usize,
}

impl Vectorised for Between<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { above, below, down, columns, out, width } = self;
        let lines = above.chunks_exact(columns).zip(below.chunks_exact(columns));
        for (out, (above, below)) in out.chunks_exact_mut(width).zip(lines) {
            let of = |x: usize| above[x] + (below[x] - above[x]) * down;
            // Pixels lie a quarter of a square before and behind its middle.
            for (x, pair) in out.chunks_mut(SQUARE).enumerate() {
                let [before, here, behind] = [x.saturating_sub(1), x, (x + 1).min(columns - 1)].map(of);
                let values = [0.25 * before + 0.75 * here, 0.75 * here + 0.25 * behind];
                pair.iter_mut().zip(values).for_each(|(out, value)| *out = value);
            }
        }
    }
}

/// Takes the logarithm of what single pixels differ by.
struct Logarithms<'a>(&'a mut [f32]);

impl Vectorised for Logarithms<'_> {
    #[inline(always)]
    fn run(self) {
        self.0.iter_mut().for_each(|v| *v = ln(*v + TINY_OF_PIXELS));
    }
}

/// Weights from their logarithms, 0 where the content lies outside of the other frame.
struct Weights<'a> {
    columns: &'a [f32],
    gate: &'a [f32],
    out: &'a mut [f32],
}

impl Vectorised for Weights<'_> {
    #[inline(always)]
    fn run(self) {
        self.out.iter_mut().zip(self.columns).zip(self.gate).for_each(|((out, column), gate)| {
            let weight = exp(out.clamp(LEAST, MOST) + gate);
            *out = if column.is_nan() { 0.0 } else { weight };
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{filters::motion::Direction, rng::Rng};

    const SIZE: (usize, usize) = (61, 46);

    /// At least what a pixel that shows the same counts beside 1 for the own one.
    const AGREED: f32 = 0.4;

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

    fn evidence([radiance, albedo, normal, depth]: &[Planes; 4]) -> Evidence<'_> {
        Evidence { radiance, albedo: Some(albedo), normal: Some(normal), depth: Some(depth) }
    }

    fn agreement(one: &[Planes; 4], other: &[Planes; 4], flow: &Flow) -> Planes {
        let [one, other] = [one, other].map(evidence);
        Look::of(&one).agreement(&Look::of(&other), flow, &one, &other)
    }

    fn mean(weights: &Planes, columns: std::ops::Range<usize>) -> f32 {
        let (w, n) = (weights.width, columns.len() * weights.height);
        let values = (0..weights.height).flat_map(|y| columns.clone().map(move |x| y * w + x));
        values.map(|i| weights.data[i]).sum::<f32>() / n as f32
    }

    #[test]
    fn noise_agrees_and_light_that_moved_does_not() {
        let still = Flow::still(SIZE.0, SIZE.1);
        let lit = frame(1, |_| 1.0);
        let same = agreement(&lit, &frame(2, |_| 1.0), &still);
        assert!(mean(&same, 0..SIZE.0) > AGREED, "{}", mean(&same, 0..SIZE.0));
        // A shadow has fallen on the right half.
        let shadow = frame(3, |x| if x < 30 { 1.0 } else { 0.4 });
        let weights = agreement(&lit, &shadow, &still);
        assert!(mean(&weights, 0..26) > AGREED && mean(&weights, 36..SIZE.0) < 0.05);
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
            let weights = agreement(&here, &other, &still);
            assert!(mean(&weights, 0..SIZE.0) < 0.1, "guide {guide}: {}", mean(&weights, 0..SIZE.0));
        }
    }

    #[test]
    fn nothing_agrees_with_what_is_outside() {
        let mut flow = Flow::still(SIZE.0, SIZE.1);
        let vectors = Planes::from_rows(4, SIZE, |c, _, out| out.fill(if c == 0 { 20.0 } else { 0.0 }));
        flow.step(&vectors, Direction::Back);
        let weights = agreement(&frame(1, |_| 1.0), &frame(2, |_| 1.0), &flow);
        assert!(mean(&weights, 0..38) > AGREED && mean(&weights, 41..SIZE.0) == 0.0);
    }

    #[test]
    fn tiny_and_black_frames_have_weights() {
        for (w, h) in [(1, 1), (1, 5), (2, 2), (3, 1)] {
            let black = Planes::new(3, w, h);
            let evidence = Evidence { radiance: &black, albedo: None, normal: None, depth: None };
            let look = Look::of(&evidence);
            let weights = look.agreement(&look, &Flow::still(w, h), &evidence, &evidence);
            assert!(weights.data.iter().all(|v| *v > 0.5), "{w}x{h}: {:?}", weights.data.to_vec());
        }
    }
}
