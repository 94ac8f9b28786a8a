//! Where the content of a frame is the same as that of another of its sequence: weights by which the two may
//! be averaged, learned from short sequences and the reference of their middle frame.
//!
//! Vectors lead to where a surface was, and know nothing of what covers it, of shadows, mirrors, glass and
//! lamps. So what is found there is held against what is here: albedo, normal and depth, and the light
//! itself, whose means around a place may differ by what its noise explains. Means are of 2x2 squares of
//! pixels, and of the 3x3 squares around one, because single pixels of few samples say little. But albedo,
//! normal and depth are compared pixel by pixel as well: at an edge that has moved by one pixel, means over
//! squares see no difference. From all that a perceptron finds the weight. It is bounded by the differences
//! of squares, and by how far light would be off that differs as the guides of single pixels do, beside how
//! noisy it is. It was trained by `eval/training/neighbours.py` to make the error of the averaged render
//! least. That error is of means over 3x3 to 13x13 pixels, since single pixels are what a denoiser averages.
//!
//! In: passes of two frames and the [`Flow`] between them. Out: a weight for every pixel, 0 where there is
//! nothing to compare.

use std::sync::LazyLock;

use rayon::prelude::*;

use super::{
    box_mean,
    motion::{self, Aside, Flow},
    perceptron::Perceptron,
};
use crate::{
    kernels::{
        exponential::exp,
        logarithm::ln,
        vectorised::{self, Vectorised},
    },
    planes::{Planes, Values},
};

/// Lines of [`Look::features`] of a row of pixels. First come those of squares: logarithms of how different
/// they are, and the logarithm of the largest weight. Then come those of single pixels: logarithms
/// of how different their guides are, and how far the content lies from a pixel's centre.
pub const FEATURES: usize = OF_SQUARES + OF_GUIDES + 1;
const OF_SQUARES: usize = LOGARITHMS + 1;
const LOGARITHMS: usize = 8;
const OF_GUIDES: usize = 3;
const NOISE: usize = 0;
const VARIANCES: usize = 2;
const NORMALS: usize = 3;
const ALBEDOS: usize = 4;
const DEPTHS: usize = 5;
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

/// How much of the squared difference of two pixels' normals counts as one of their light, relative to it.
const NORMAL_AS_LIGHT: f32 = 0.3;

/// How much the squared bias of an average counts beside its variance: of values from 0 to 2, the one at which
/// rendered sequences at 16 samples came out best (docs/decisions.md).
const BIAS: f32 = 2.0;

/// A small relative variance of light is so many times that of its fourth root.
const OF_ROOT: f32 = 16.0;

/// How far the variance of a mean of the light falls below that of one pixel.
const PIXELS: f32 = 20.0;

/// Squared relative difference of the light, beyond noise, that nobody sees.
const UNSEEN: f32 = 5e-5;

/// A difference in brightness counts that is more than so many of its standard errors, of at least so many places.
const CERTAIN: f32 = 4.0;
const FEWEST: usize = 30;

/// A frame is brighter as a whole only if no more than this share of its places lies in tiles (of at most so many rows and
/// columns of them) that say otherwise.
const MOST_OTHERWISE: f32 = 0.2;
const MOST_TILES: usize = 4;

/// Depth of what nothing is before.
const FAR: f32 = 1e6;

/// How many times as bright as all around it a pixel of a neighbour may be before it counts for less. Fireflies are
/// rarely as much brighter than noise.
const OUTSHINES: f32 = 16.0;

/// Rows and columns of a square.
pub(super) const SQUARE: usize = 2;

/// Added to the albedo before light is divided by it.
pub(super) const ALBEDO_FLOOR: f32 = 0.02;

/// Added to the squared light, to squared albedos, and to depths, before differences are divided by them.
const DIM: f32 = 1e-4;
const DARK: f32 = 0.01;
const NEAR: f32 = 1e-3;

/// The logarithm of the least weight that the perceptron gives, and the least of [`GATE`].
const LEAST: f32 = -8.0;
const FARTHEST: f32 = 16.0;

/// Planes of what is compared, and the number of those that are guides.
const LIGHT: usize = 0;
const VARIANCE: usize = 3;
const ALBEDO: usize = 6;
const NORMAL: usize = 9;
const DEPTH: usize = 12;
const SPREAD_OF_ALBEDO: usize = 13;
const SPREAD_OF_NORMAL: usize = 14;
const LINES: usize = 15;
const GUIDES: usize = SPREAD_OF_ALBEDO - ALBEDO;

static PERCEPTRON: LazyLock<Perceptron> =
    LazyLock::new(|| Perceptron::read(include_bytes!("agreement.safetensors"), FEATURES, 1));

/// The passes of a frame that tell, besides its light, where another agrees with it; those that are not there
/// agree everywhere.
#[derive(Clone, Copy, Default)]
pub struct Guides<'a> {
    /// (3, H, W).
    pub albedo: Option<&'a dyn Values>,
    /// (3, H, W).
    pub normal: Option<&'a dyn Values>,
    /// (1, H, W).
    pub depth: Option<&'a dyn Values>,
}

/// What a frame looks like from a little way off: means over squares of light (its fourth root, over the
/// albedo), the variance of that, albedo, normal and depth.
#[derive(Clone, Debug, Default)]
pub struct Look {
    size: (usize, usize),
    squares: Planes,
}

/// How many times as bright a frame is as another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Brightness {
    /// In most of what both show.
    pub times: f32,
    /// Whether the rest is so, too: an exposure is, a lamp that lights half of the frame is not.
    pub is_everywhere: bool,
}

impl Look {
    /// Of a frame's noisy radiance, (3, H, W) and finite, and its guides.
    ///
    /// # Panics
    /// If the planes are empty, or their sizes or channels differ from what is told of them.
    pub fn of(radiance: &Planes, guides: &Guides) -> Self {
        let (width, height) = (radiance.width, radiance.height);
        let size = (width.div_ceil(SQUARE), height.div_ceil(SQUARE));
        let squares = Planes::from_rows_of_all(LINES, size, |row, lines| {
            let [mut roots, mut guide, mut beside] = [(); 3].map(|()| vec![0.0; width]);
            lines.iter_mut().for_each(|line| line.fill(0.0));
            let mut add = |line: usize, values: &[f32], is_squared: bool| {
                vectorised::run(Add { values, is_squared, sums: &mut *lines[line] });
            };
            let pixels = row * SQUARE..((row + 1) * SQUARE).min(height);
            for y in pixels.clone() {
                for c in 0..3 {
                    let light = radiance.row(c, y);
                    let albedo = guides.albedo.map(|albedo| {
                        albedo.read(c, y * width, &mut guide);
                        &*guide
                    });
                    vectorised::run(Roots { light, albedo, roots: &mut roots });
                    add(LIGHT + c, &roots, false);
                    add(VARIANCE + c, &roots, true);
                    let normal = guides.normal.map(|normal| {
                        normal.read(c, y * width, &mut beside);
                        &*beside
                    });
                    let of_guides = [(albedo, ALBEDO, SPREAD_OF_ALBEDO), (normal, NORMAL, SPREAD_OF_NORMAL)];
                    for (values, line, spread) in of_guides {
                        let Some(values) = values else { continue };
                        add(line + c, values, false);
                        add(spread, values, true);
                    }
                }
                if let Some(depth) = guides.depth {
                    depth.read(0, y * width, &mut guide);
                    add(DEPTH, &guide, false);
                }
            }
            // Squares at the right and lower edge may be cut.
            let share = 1.0 / (SQUARE * pixels.len()) as f32;
            for line in lines.iter_mut() {
                line.iter_mut().for_each(|sum| *sum *= share);
                line[size.0 - 1] *= SQUARE as f32 / (width - (size.0 - 1) * SQUARE) as f32;
            }
        });
        let squares = Planes::from_rows_of_all(LINES, size, |row, lines| {
            for (line, out) in lines.iter_mut().enumerate() {
                box_mean::row(squares.channel(line), size, row, 1, out);
            }
            let (means, spreads) = lines.split_at_mut(SPREAD_OF_ALBEDO);
            for (spread, first) in spreads.iter_mut().zip([ALBEDO, NORMAL]) {
                means[first..first + 3].iter().for_each(|mean| subtract_square(mean, spread));
            }
            let (means, variances) = means.split_at_mut(VARIANCE);
            variances.iter_mut().zip(means).for_each(|(variance, mean)| subtract_square(mean, variance));
        });
        Self { size: (width, height), squares }
    }

    /// How many times as bright a frame is as another: the median over what both show, as far as guides
    /// agree; 1 where that is no more than noise may be. Lamps that flicker, a sun behind clouds and an exposure that
    /// changes leave such a difference, which single places hide in their noise.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn brightness(&self, other: &Self, flow: &Flow) -> Brightness {
        assert!(self.size == other.size && self.size == flow.size(), "frames of one size");
        let (columns, rows) = (self.squares.width, self.squares.height);
        let mut differences = Vec::new();
        // Means over 3x3 squares, each square in one.
        for row in (1..rows).step_by(3) {
            let places = flow.row((row * SQUARE).min(self.size.1 - 1));
            for column in (1..columns).step_by(3) {
                let pixel = (column * SQUARE).min(self.size.0 - 1);
                let (x, y) = (places.0[pixel], places.1[pixel]);
                if x.is_nan() {
                    continue;
                }
                let nearest = |place: f32, most: usize| (place.max(0.0) as usize / SQUARE).min(most - 1);
                let there = nearest(y, rows) * columns + nearest(x, columns);
                let (here, there) = (self.at(row * columns + column), other.at(there));
                if alike(&here, &there)
                    && let [here, there] = [here, there].map(|of| of[LIGHT..VARIANCE].iter().sum::<f32>())
                    && here.min(there) > 0.0
                {
                    differences.push((4.0 * ln(here / there), (column, row)));
                }
            }
        }
        let same = Brightness { times: 1.0, is_everywhere: true };
        let Some((middle, error)) = median_of(&differences) else { return same };
        if middle.abs() <= CERTAIN * error {
            return same;
        }
        let tiles = (differences.len() / FEWEST).isqrt().clamp(1, MOST_TILES);
        let tile = |(column, row): (usize, usize)| (column * tiles / columns, row * tiles / rows);
        let mut of_tiles = vec![Vec::new(); tiles * tiles];
        for (difference, place) in &differences {
            let (column, row) = tile(*place);
            of_tiles[row * tiles + column].push((*difference, *place));
        }
        let contradicts = |of_tile: &&Vec<(f32, (usize, usize))>| {
            median_of(of_tile).is_some_and(|(own, of_own)| {
                let apart = (own - middle).abs();
                apart > middle.abs() / 2.0 && apart > CERTAIN * of_own.hypot(error)
            })
        };
        let otherwise: usize = of_tiles.iter().filter(contradicts).map(Vec::len).sum();
        let is_everywhere = otherwise as f32 <= MOST_OTHERWISE * differences.len() as f32;
        Brightness { times: exp(middle), is_everywhere }
    }

    /// Whether the guides of another frame differ from those at the same place of this one, in most of what has edges: the
    /// camera or things moved. So it is said of frames without guides, too. Before nothing, where depth is a mean with
    /// that of the far end, guides are a matter of samples.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn has_other_guides(&self, other: &Self) -> bool {
        assert_eq!(self.size, other.size, "frames of one size");
        let (mut different, mut counted) = (0.0, 0.0);
        for square in 0..self.squares.pixels() {
            let (here, there) = (self.at(square), other.at(square));
            if here[DEPTH].max(there[DEPTH]) < FAR {
                let detail = self.detail(square);
                counted += detail;
                different += if alike(&here, &there) { 0.0 } else { detail };
            }
        }
        different >= 0.5 * counted
    }

    /// How much normals and relative albedo differ in and around a square: their standard deviation.
    fn detail(&self, square: usize) -> f64 {
        let value = |line: usize| self.squares.channel(line)[square];
        let squared: f32 = (ALBEDO..ALBEDO + 3).map(|line| value(line).powi(2)).sum();
        f64::from((value(SPREAD_OF_NORMAL) + value(SPREAD_OF_ALBEDO) / (squared + DARK)).sqrt())
    }

    /// The means of a square, all but the spreads.
    fn at(&self, square: usize) -> [f32; SPREAD_OF_ALBEDO] {
        std::array::from_fn(|line| self.squares.channel(line)[square])
    }

    /// What the perceptron reads of every pixel and of the one to which the flow leads: [`FEATURES`] lines for
    /// each row, (H, FEATURES, W) as one plane. `own` and `there` are the guides that both looks were made of,
    /// `brightness` how many times as bright this frame is.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn features(
        &self,
        other: &Self,
        flow: &Flow,
        brightness: f32,
        own: &Guides,
        there: &Guides,
    ) -> Planes {
        let (width, height) = self.size;
        let of_squares = self.features_of_squares(other, flow, brightness);
        Planes::from_rows(1, (FEATURES * width, height), |_, y, out| {
            self.features_of_row(y, &of_squares, flow, [own, there], out);
        })
    }

    /// How far each pixel may be averaged with that of `other` to which the flow leads, beside 1 for its own:
    /// from 0 to 1, (1, H, W), and 0 where the flow leads outside. `own` and `there` are the guides that both
    /// looks were made of, `brightness` how many times as bright this frame is.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn agreement(
        &self,
        other: &Self,
        flow: &Flow,
        brightness: f32,
        own: &Guides,
        there: &Guides,
    ) -> Planes {
        let of_squares = self.features_of_squares(other, flow, brightness);
        let width = self.size.0;
        // A row at a time: features of a whole frame would take many times its memory.
        Planes::from_rows(1, self.size, |_, y, out| {
            let mut features = vec![0.0; FEATURES * width];
            self.features_of_row(y, &of_squares, flow, [own, there], &mut features);
            let line = |line: usize| &features[line * width..][..width];
            let mut gate = line(GATE).to_vec();
            let [variance, normal, albedo] = [VARIANCES, OF_SQUARES, OF_SQUARES + 1].map(line);
            vectorised::run(Bound { variance, normal, albedo, gate: &mut gate });
            PERCEPTRON.weigh(&features, LEAST, Some(&gate), flow.row(y).0, out);
        })
    }

    /// The mean of weights, (1, H, W), where each square of pixels counts by its detail: how much normals and relative
    /// albedo differ in it and around it. None where nothing does.
    ///
    /// # Panics
    /// If the size of the weights differs.
    pub fn mean_at_detail(&self, weights: &Planes) -> Option<f32> {
        assert!(self.size == (weights.width, weights.height), "weights of the frame's size");
        let (mut sum, mut counted) = (0.0, 0.0);
        for row in 0..self.squares.height {
            let weights = weights.row(0, row * SQUARE);
            for column in 0..self.squares.width {
                let detail = self.detail(row * self.squares.width + column);
                sum += detail * f64::from(weights[column * SQUARE]);
                counted += detail;
            }
        }
        (counted > 0.0).then(|| (sum / counted) as f32)
    }

    /// The [`FEATURES`] lines of a row of pixels.
    fn features_of_row(
        &self,
        y: usize,
        of_squares: &Planes,
        flow: &Flow,
        [own, there]: [&Guides; 2],
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
        let (guides, beside) = pixels.split_at_mut(OF_GUIDES * width);
        compare_pixels(y, flow, own, there, guides);
        let (columns, rows) = flow.row(y);
        vectorised::run(Aside { columns, rows, out: beside });
    }

    /// Lines of a row of squares, (rows, OF_SQUARES, columns) as one plane.
    ///
    /// # Panics
    /// If sizes differ.
    fn features_of_squares(&self, other: &Self, flow: &Flow, brightness: f32) -> Planes {
        assert!(self.size == other.size && self.size == flow.size(), "frames of one size");
        let size = (self.squares.width, self.squares.height);
        Planes::from_rows(1, (OF_SQUARES * size.0, size.1), |_, row, out| {
            // The lower right pixel is half a pixel beside the middle of the square; the last square of an odd size has none.
            let pixel = |square: usize, pixels: usize| (square * SQUARE + 1).min(pixels - 1);
            let y = pixel(row, self.size.1);
            let from = flow.row(y);
            let columns: Vec<f32> = (0..size.0).map(|x| from.0[pixel(x, self.size.0)]).collect();
            let places: Vec<motion::Between> = (0..size.0)
                .map(|column| {
                    let x = pixel(column, self.size.0);
                    let square = |place: f32, beside: usize| (place - beside as f32) / SQUARE as f32;
                    let (to_x, to_y) = (from.0[x], from.1[x]);
                    (square(to_x, x - column * SQUARE), square(to_y, y - row * SQUARE))
                })
                .map(|place| motion::Between::new(place, size))
                .collect();
            let mut there = vec![0.0; SPREAD_OF_ALBEDO * size.0];
            for (line, out) in there.chunks_exact_mut(size.0).enumerate() {
                let plane = other.squares.channel(line);
                let factor = match line {
                    LIGHT..VARIANCE => brightness.sqrt().sqrt(),
                    VARIANCE..ALBEDO => brightness.sqrt(),
                    _ => 1.0,
                };
                out.iter_mut().zip(&places).for_each(|(out, place)| *out = factor * place.of(plane));
            }
            let here = std::array::from_fn(|line| self.squares.row(line, row));
            vectorised::run(CompareSquares { here, there: &there, columns: &columns, out });
        })
    }
}

/// Lowers the weights of pixels of another frame, (1, H, W), that outshine all of this one around the place where they
/// count, so that a lamp a thousand times as bright leaves nothing where it was a frame ago: squares, which weights are
/// made of, are too coarse to tell the pixels at its edge. `own` and `there` are the light of both frames, `floor` what
/// counts as dark.
///
/// # Panics
/// If sizes differ.
pub fn dim(weights: &mut Planes, flow: &Flow, own: &dyn Values, there: &dyn Values, floor: f32) {
    let (channels, width, height) = own.extent();
    assert!(there.extent() == own.extent() && flow.size() == (width, height), "frames of one size");
    assert!((weights.width, weights.height) == (width, height), "weights of the frame's size");
    let brightest = |of: &dyn Values, c: usize, first: usize, line: &mut [f32], most: &mut [f32]| {
        of.read(c, first, line);
        most.iter_mut().zip(&*line).for_each(|(most, v)| *most = most.max(*v));
    };
    let here = Planes::from_rows(1, (width, height), |_, y, most| {
        most.fill(floor);
        let line = &mut vec![0.0; width];
        (0..channels).for_each(|c| brightest(own, c, y * width, line, most));
    });
    weights.data.par_chunks_mut(width).enumerate().for_each(|(y, weights)| {
        let rows = y.saturating_sub(1)..(y + 2).min(height);
        let columns: Vec<f32> = (0..width)
            .map(|x| rows.clone().map(|row| here.data[row * width + x]).fold(floor, f32::max))
            .collect();
        for stretch in flow.nearest_of_row(y) {
            let (line, most) = (&mut vec![0.0; stretch.pixels], &mut vec![floor; stretch.pixels]);
            (0..channels).for_each(|c| brightest(there, c, stretch.there, line, most));
            let weights = stretch.of_mut(weights).iter_mut().zip(most.iter());
            for (x, (weight, there)) in (stretch.here..).zip(weights) {
                let around =
                    columns[x.saturating_sub(1)..(x + 2).min(width)].iter().copied().fold(floor, f32::max);
                *weight *= (OUTSHINES * around / there).min(1.0);
            }
        }
    });
}

/// Whether the guides of two squares agree.
fn alike(here: &[f32; SPREAD_OF_ALBEDO], there: &[f32; SPREAD_OF_ALBEDO]) -> bool {
    let mut differences = [[0.0]; OF_GUIDES];
    let guides = |of: &[f32; SPREAD_OF_ALBEDO]| -> [[f32; 1]; GUIDES] {
        std::array::from_fn(|line| [of[ALBEDO + line]])
    };
    let (here, there) = (guides(here), guides(there));
    let [normal, albedo, depth] = &mut differences;
    compare_guides(
        here.each_ref().map(|v| &v[..]),
        there.each_ref().map(|v| &v[..]),
        [normal, albedo, depth],
    );
    let most = [NORMAL_DIFFERS, ALBEDO_DIFFERS, DEPTH_DIFFERS];
    differences.iter().zip(most).all(|([difference], most)| *difference < most)
}

/// The median of differences and its standard error, by their median distance from it; none of few.
fn median_of<P>(differences: &[(f32, P)]) -> Option<(f32, f32)> {
    if differences.len() < FEWEST {
        return None;
    }
    let mut values: Vec<f32> = differences.iter().map(|(difference, _)| *difference).collect();
    let middle = values.len() / 2;
    let median = *values.select_nth_unstable_by(middle, f32::total_cmp).1;
    values.iter_mut().for_each(|v| *v = (*v - median).abs());
    let distance = *values.select_nth_unstable_by(middle, f32::total_cmp).1;
    // Of a normal distribution the deviation is 1.48 times the median distance, and the error of the median 1.25 times
    // that of the mean.
    Some((median, 1.48 * 1.25 * distance / (values.len() as f32).sqrt()))
}

/// Lines of a row of pixels: how different albedo, normal and depth of each are from those of the nearest
/// pixel of the other frame.
fn compare_pixels(y: usize, flow: &Flow, own: &Guides, there: &Guides, out: &mut [f32]) {
    let width = flow.size().0;
    let stretches = flow.nearest_of_row(y);
    let mut lines = vec![0.0; 2 * GUIDES * width];
    let (own_lines, there_lines) = lines.split_at_mut(GUIDES * width);
    let mut both = own_lines.chunks_exact_mut(width).zip(there_lines.chunks_exact_mut(width));
    let of_both = [(own.albedo, there.albedo, 3), (own.normal, there.normal, 3), (own.depth, there.depth, 1)];
    for (own, there, channels) in of_both {
        for (c, (own_line, there_line)) in both.by_ref().take(channels).enumerate() {
            // A guide that one of them lacks agrees.
            let Some((own, there)) = own.zip(there) else { continue };
            own.read(c, y * width, own_line);
            stretches.iter().for_each(|stretch| there.read(c, stretch.there, stretch.of_mut(there_line)));
        }
    }
    vectorised::run(ComparePixels { here: own_lines, there: there_lines, columns: flow.row(y).0, out });
}

/// Takes the square of a mean from the mean of squares; what is left is a variance.
fn subtract_square(mean: &[f32], of_squares: &mut [f32]) {
    of_squares.iter_mut().zip(mean).for_each(|(square, mean)| *square = (*square - mean * mean).max(0.0));
}

/// Fourth roots of a row of light, over the albedo.
struct Roots<'a> {
    light: &'a [f32],
    albedo: Option<&'a [f32]>,
    roots: &'a mut [f32],
}

impl Vectorised for Roots<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { light, albedo, roots } = self;
        roots.iter_mut().zip(light).for_each(|(root, light)| *root = light.max(0.0));
        if let Some(albedo) = albedo {
            roots.iter_mut().zip(albedo).for_each(|(root, albedo)| *root /= albedo.max(0.0) + ALBEDO_FLOOR);
        }
        roots.iter_mut().for_each(|root| *root = root.sqrt().sqrt());
    }
}

/// Adds a row of values, or their squares, to the sums of the squares of pixels that they lie in.
pub(super) struct Add<'a> {
    pub values: &'a [f32],
    pub is_squared: bool,
    pub sums: &'a mut [f32],
}

impl Vectorised for Add<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { values, is_squared, sums } = self;
        let pairs = values.chunks_exact(SQUARE);
        if let ([last], Some(sum)) = (pairs.remainder(), sums.last_mut()) {
            *sum += if is_squared { last * last } else { *last };
        }
        let both = sums.iter_mut().zip(pairs);
        if is_squared {
            both.for_each(|(sum, pair)| *sum += pair[0] * pair[0] + pair[1] * pair[1]);
        } else {
            both.for_each(|(sum, pair)| *sum += pair[0] + pair[1]);
        }
    }
}

/// Lines of features of a row of squares; see [`TINY_OF_SQUARES`] and [`GATE`].
struct CompareSquares<'a> {
    here: [&'a [f32]; LINES],
    /// All but the spreads, at the places to which the flow leads.
    there: &'a [f32],
    /// Columns of these places, NaN outside of the frame.
    columns: &'a [f32],
    out: &'a mut [f32],
}

impl Vectorised for CompareSquares<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { here, there, columns, out } = self;
        let width = columns.len();
        let there = |line: usize| &there[line * width..][..width];
        let (values, gate) = out.split_at_mut(LOGARITHMS * width);
        values.fill(0.0);
        let mut lines = values.chunks_exact_mut(width);
        let mut next = || lines.next().expect("there is a line for each");
        let [noise, relative, variance] = [next(), next(), next()];
        for c in 0..3 {
            let means = here[LIGHT + c].iter().zip(there(LIGHT + c));
            let variances = here[VARIANCE + c].iter().zip(there(VARIANCE + c));
            let sums = noise.iter_mut().zip(&mut *relative).zip(&mut *variance);
            for (((a, b), (of_a, of_b)), ((noise, relative), sum)) in means.zip(variances).zip(sums) {
                let (squared, variance) = ((a - b) * (a - b), (of_a + of_b) / PIXELS);
                *noise += squared / (variance + UNSEEN * a * a).max(f32::MIN_POSITIVE) * (1.0 / 3.0);
                *relative += squared / (a * a + b * b + DIM) * (1.0 / 3.0);
                *sum += variance / (a * a + DIM) * (1.0 / 3.0);
            }
        }
        let [normal, albedo, depth] = [next(), next(), next()];
        let guides: [usize; GUIDES] = std::array::from_fn(|line| ALBEDO + line);
        compare_guides(guides.map(|line| here[line]), guides.map(there), [normal, albedo, depth]);
        let [of_normal, of_albedo] = [next(), next()];
        of_normal.copy_from_slice(here[SPREAD_OF_NORMAL]);
        of_albedo.fill(DARK);
        for c in 0..3 {
            of_albedo.iter_mut().zip(here[ALBEDO + c]).for_each(|(sum, v)| *sum += v * v);
        }
        of_albedo.iter_mut().zip(here[SPREAD_OF_ALBEDO]).for_each(|(out, spread)| *out = spread / *out);
        for values in values.chunks_exact_mut(width) {
            replace_outside(values, columns);
        }
        let of_line = |line: usize| &values[line * width..][..width];
        gate.copy_from_slice(of_line(NOISE));
        gate.iter_mut().for_each(|v| *v = -(*v - AGREES).max(0.0) / LIGHT_DIFFERS);
        for (line, differs) in [(NORMALS, NORMAL_DIFFERS), (ALBEDOS, ALBEDO_DIFFERS), (DEPTHS, DEPTH_DIFFERS)]
        {
            gate.iter_mut().zip(of_line(line)).for_each(|(gate, v)| *gate -= v / differs);
        }
        gate.iter_mut().for_each(|v| *v = v.max(-FARTHEST));
        for (values, tiny) in values.chunks_exact_mut(width).zip(TINY_OF_SQUARES) {
            values.iter_mut().for_each(|v| *v = ln(*v + tiny));
        }
    }
}

/// Lines of features of a row of pixels.
struct ComparePixels<'a> {
    /// Guides, and those of the pixels to which the flow leads.
    here: &'a [f32],
    there: &'a [f32],
    /// Columns of these pixels, NaN outside of the frame.
    columns: &'a [f32],
    out: &'a mut [f32],
}

impl Vectorised for ComparePixels<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { here, there, columns, out } = self;
        let width = columns.len();
        out.fill(0.0);
        let mut lines = out.chunks_exact_mut(width);
        let differences: [&mut [f32]; OF_GUIDES] =
            std::array::from_fn(|_| lines.next().expect("there is a line for each"));
        let [here, there] =
            [here, there].map(|lines| std::array::from_fn(|line| &lines[line * width..][..width]));
        compare_guides(here, there, differences);
        for values in out.chunks_exact_mut(width) {
            replace_outside(values, columns);
            values.iter_mut().for_each(|v| *v = ln(*v + TINY_OF_PIXELS));
        }
    }
}

/// Bounds the weights of a row of pixels, as logarithms, by what single pixels' guides tell: light differs
/// like the albedo does, and of two values of which the second is biased, the mean errs least if the second
/// counts `s / (s + b)` beside 1 for the first, `s` the variance of each and `b` the squared bias.
struct Bound<'a> {
    /// Logarithms, which are features: the variance of a mean of the light's fourth root, relative to the
    /// light, and the squared differences of normals and albedos.
    variance: &'a [f32],
    normal: &'a [f32],
    albedo: &'a [f32],
    gate: &'a mut [f32],
}

impl Vectorised for Bound<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { variance, normal, albedo, gate } = self;
        for ((gate, variance), (normal, albedo)) in
            gate.iter_mut().zip(variance).zip(normal.iter().zip(albedo))
        {
            let [normal, albedo] = [normal, albedo].map(|v| (exp(*v) - TINY_OF_PIXELS).max(0.0));
            let (variance, bias) = (OF_ROOT * exp(*variance), BIAS * (albedo + NORMAL_AS_LIGHT * normal));
            *gate += ln(variance / (variance + bias)).max(-FARTHEST);
        }
    }
}

/// Adds the squared differences of two rows of guides: of normals, and relative ones of albedos and depths.
#[inline(always)]
fn compare_guides(
    here: [&[f32]; GUIDES],
    there: [&[f32]; GUIDES],
    [normal, albedo, depth]: [&mut [f32]; OF_GUIDES],
) {
    let both = |line: usize| here[line].iter().zip(there[line]);
    for c in 0..3 {
        normal.iter_mut().zip(both(NORMAL - ALBEDO + c)).for_each(|(sum, (a, b))| *sum += (a - b) * (a - b));
        albedo.iter_mut().zip(both(c)).for_each(|(sum, (a, b))| {
            let largest = a.max(*b);
            *sum += (a - b) * (a - b) / (largest * largest + DARK) * (1.0 / 3.0);
        });
    }
    depth.iter_mut().zip(both(DEPTH - ALBEDO)).for_each(|(sum, (a, b))| {
        let relative = (a - b) / (a.abs().max(b.abs()) + NEAR);
        *sum += relative * relative;
    });
}

/// Outside of the other frame, all differs as much as it can.
#[inline(always)]
fn replace_outside(values: &mut [f32], columns: &[f32]) {
    values.iter_mut().zip(columns).for_each(|(v, column)| *v = if column.is_nan() { 1.0 } else { *v });
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
        let mut line = vec![0.0; columns];
        for (out, (above, below)) in out.chunks_exact_mut(width).zip(lines) {
            let both = above.iter().zip(below);
            line.iter_mut().zip(both).for_each(|(v, (above, below))| *v = above + (below - above) * down);
            // Pixels lie a quarter of a square before and behind its middle.
            let of = |before: f32, here: f32, behind: f32| {
                [0.25 * before + 0.75 * here, 0.75 * here + 0.25 * behind]
            };
            for (pair, near) in out[SQUARE.min(width)..].chunks_exact_mut(SQUARE).zip(line.windows(3)) {
                pair.copy_from_slice(&of(near[0], near[1], near[2]));
            }
            for x in [0, columns - 1] {
                let pair = of(line[x.saturating_sub(1)], line[x], line[(x + 1).min(columns - 1)]);
                out[x * SQUARE..].iter_mut().zip(pair).for_each(|(out, v)| *out = v);
            }
        }
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

    fn guides(frame: &[Planes; 4]) -> Guides<'_> {
        let [_, albedo, normal, depth] = frame.each_ref().map(|planes| Some(planes as &dyn Values));
        Guides { albedo, normal, depth }
    }

    fn agreement(one: &[Planes; 4], other: &[Planes; 4], flow: &Flow) -> Planes {
        let [(look, own), (other, there)] = [one, other].map(|frame| {
            let guides = guides(frame);
            (Look::of(&frame[0], &guides), guides)
        });
        look.agreement(&other, flow, look.brightness(&other, flow).times, &own, &there)
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
        // A shadow has fallen on the right.
        let shadow = frame(3, |x| if x < 35 { 1.0 } else { 0.4 });
        let weights = agreement(&lit, &shadow, &still);
        assert!(mean(&weights, 0..31) > AGREED && mean(&weights, 41..SIZE.0) < 0.05);
        assert!(weights.data.iter().all(|w| (0.0..=1.0).contains(w)));
    }

    #[test]
    fn a_frame_agrees_with_itself_to_its_last_column_and_row() {
        // Of odd sizes the last squares are of one pixel.
        for (columns, rows) in [(61, 46), (46, 61), (61, 61)] {
            let mut rng = Rng::new(5, 0);
            let radiance =
                Planes::from_vec(3, columns, rows, (0..3 * columns * rows).map(|_| rng.uniform()).collect());
            let look = Look::of(&radiance, &Guides::default());
            let of_squares = look.features_of_squares(&look, &Flow::still(columns, rows), 1.0);
            let squares = columns.div_ceil(SQUARE);
            for row in 0..rows.div_ceil(SQUARE) {
                let noise = &of_squares.data[(row * OF_SQUARES + NOISE) * squares..][..squares];
                let none = TINY_OF_SQUARES[NOISE].ln();
                assert!(noise.iter().all(|v| (v - none).abs() < 1e-3), "{columns}x{rows}, {row}: {noise:?}");
            }
        }
    }

    #[test]
    fn light_that_changes_as_a_whole_is_told_from_noise_and_agrees() {
        let still = Flow::still(SIZE.0, SIZE.1);
        let look = |frame: &[Planes; 4]| Look::of(&frame[0], &guides(frame));
        let lit = frame(1, |_| 1.0);
        for (factor, expected) in [(1.0, 1.0), (0.98, 1.0), (0.8, 1.25), (0.5, 2.0), (4.0, 0.25)] {
            let other = frame(2, |_| factor);
            let found = look(&lit).brightness(&look(&other), &still).times;
            assert!((found / expected - 1.0).abs() < 0.05, "{factor}: {found}");
            assert_eq!(found == 1.0, expected == 1.0, "what may be noise is none: {factor}: {found}");
            let weights = agreement(&lit, &other, &still);
            assert!(mean(&weights, 0..SIZE.0) > AGREED, "{factor}: {}", mean(&weights, 0..SIZE.0));
        }
        // A shadow over less than half of a frame is none of it, nor is what other surfaces show.
        let shadow = frame(3, |x| if x < 40 { 1.0 } else { 0.4 });
        assert_eq!(look(&lit).brightness(&look(&shadow), &still).times, 1.0);
        let mut elsewhere = frame(4, |_| 0.5);
        elsewhere[3].data.fill(6.0);
        assert_eq!(look(&lit).brightness(&look(&elsewhere), &still).times, 1.0);
    }

    #[test]
    fn a_lamp_that_lights_a_part_of_a_frame_is_told_from_an_exposure() {
        let size = (400, 300);
        let mut rng = Rng::new(6, 0);
        let mut look = |light: &dyn Fn(usize) -> f32| {
            let row = |i: usize| (0.3 + 1.4 * rng.uniform()) * light(i % size.0);
            let noisy: Vec<f32> = (0..size.0 * size.1).map(row).collect();
            Look::of(&Planes::from_vec(3, size.0, size.1, noisy.repeat(3)), &Guides::default())
        };
        let lit = look(&|_| 1.0);
        let still = Flow::still(size.0, size.1);
        let mut found = |light: &dyn Fn(usize) -> f32| lit.brightness(&look(light), &still);
        let half = found(&|x| if x < 240 { 0.9 } else { 1.0 });
        assert!(!half.is_everywhere && half.times > 1.05, "{half:?}");
        for even in [found(&|_| 0.9), found(&|x| 0.95 - 0.00015 * x as f32), found(&|_| 1.0)] {
            assert!(even.is_everywhere, "{even:?}");
        }
    }

    #[test]
    fn what_outshines_all_around_it_counts_for_less() {
        let flow = Flow::still(5, 5);
        let own = Planes::from_vec(1, 5, 5, vec![1.0; 25]);
        let mut there = own.clone();
        for (value, expected) in [(2.0, 0.5), (16.0, 0.5), (1600.0, 0.005)] {
            there.data[12] = value;
            let mut weights = Planes::from_vec(1, 5, 5, vec![0.5; 25]);
            dim(&mut weights, &flow, &own, &there, 0.02);
            assert!((weights.data[12] - expected).abs() < 1e-6, "{value}: {}", weights.data[12]);
            assert!(weights.data.iter().enumerate().all(|(i, weight)| i == 12 || *weight == 0.5), "{value}");
        }
        // Beside as bright a pixel of its own.
        let mut own = own;
        own.data[8] = 5000.0;
        let mut weights = Planes::from_vec(1, 5, 5, vec![0.5; 25]);
        dim(&mut weights, &flow, &own, &there, 0.02);
        assert_eq!(weights.data[12], 0.5);
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
    fn a_camera_that_moves_shows_where_there_is_detail() {
        let still = Flow::still(SIZE.0, SIZE.1);
        // A sky, and below it a wall of narrow stripes, which the camera has moved along.
        let shot = |seed: u64, moved: usize| {
            let mut frame = frame(seed, |_| 1.0);
            for (i, v) in frame[1].data.iter_mut().enumerate() {
                let (x, y) = (i % SIZE.0, i / SIZE.0 % SIZE.1);
                *v = if y >= 36 && (x + moved) % 6 < 3 { 0.2 } else { *v };
            }
            frame
        };
        let (here, same, there) = (shot(1, 0), shot(2, 0), shot(3, 3));
        let look = Look::of(&here[0], &guides(&here));
        let detail = |weights: &Planes| look.mean_at_detail(weights).unwrap();
        let (same, moved) = (agreement(&here, &same, &still), agreement(&here, &there, &still));
        assert!(mean(&moved, 0..SIZE.0) > AGREED, "{}", mean(&moved, 0..SIZE.0));
        assert!(detail(&same) > 0.3 && detail(&moved) < 0.3, "{} {}", detail(&same), detail(&moved));
        let flat = frame(4, |_| 1.0);
        assert_eq!(Look::of(&flat[0], &guides(&flat)).mean_at_detail(&moved), None);
    }

    #[test]
    fn tiny_and_black_frames_have_weights() {
        for (w, h) in [(1, 1), (1, 5), (2, 2), (3, 1)] {
            let none = Guides::default();
            let look = Look::of(&Planes::new(3, w, h), &none);
            let still = Flow::still(w, h);
            assert_eq!(look.brightness(&look, &still).times, 1.0, "{w}x{h}");
            let weights = look.agreement(&look, &still, 1.0, &none, &none);
            assert!(weights.data.iter().all(|v| *v > 0.5), "{w}x{h}: {:?}", weights.data.to_vec());
        }
    }
}
