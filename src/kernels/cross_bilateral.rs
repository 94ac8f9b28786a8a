//! The cross-bilateral filter whose parameters differ from pixel to pixel, and its gradient with respect to
//! them: planar f32, one image at a time.
//!
//! A pixel i becomes `sum_j w_ij c_j / sum_j w_ij` over the square around it that lies inside the image, with
//! `w_ij = exp(-sum_m a_m(i) D_m(i, j))`. The distances D are, in this order: the squared distance between
//! the pixels in units of the radius, the squared distance between their colours divided by the noise of
//! both, and the squared distance of each group of features. The factors `a_m(i)` are the precisions of pixel
//! i.

use std::ops::Range;

use rayon::prelude::*;

use super::{
    Block, LANES,
    filter::{Size, each_row},
    simd::{Kernel, Simd, Tier},
};

/// Added to the noise of two colours before their distance is divided by it.
const NOISE_FLOOR: f32 = 1e-4;

/// One image to be filtered.
#[derive(Clone, Copy)]
pub struct CrossBilateral<'a> {
    /// Rows and columns.
    pub size: Size,
    /// Pixels from the centre of the square to its edge.
    pub radius: usize,
    /// What is filtered, (3, H, W).
    pub image: &'a [f32],
    /// The variance of the image, the sum over its channels, (1, H, W).
    pub noise: &'a [f32],
    /// The features, group after group, (C, H, W).
    pub features: &'a [f32],
    /// Channels of each group.
    pub groups: &'a [usize],
    /// Precisions of position, colour and each group, (2 + groups, H, W), none negative.
    pub precision: &'a [f32],
}

/// The planes of [`Margins`]: three of colour, its noise, whether there is a pixel at all, then the features.
const NOISE: usize = 3;
const INSIDE: usize = 4;
const FEATURES: usize = 5;

/// All that is compared, with margins of zeros, so that a block of lanes can look as far as the filter does
/// at any column. What a row needs lies together: row by row, in it plane by plane.
struct Margins {
    planes: usize,
    /// Values of a row of one plane, margins included.
    stride: usize,
    values: Vec<f32>,
}

impl Margins {
    fn new(filter: &CrossBilateral) -> Self {
        let (Size { h, w }, n) = (filter.size, filter.size.pixels());
        let planes = FEATURES + filter.features.len() / n.max(1);
        let stride = w.next_multiple_of(LANES) + 2 * filter.radius;
        let mut values = vec![0.0; h * planes * stride];
        values.par_chunks_mut((planes * stride).max(1)).enumerate().for_each(|(y, row)| {
            let mut inner = row.chunks_mut(stride).map(|line| &mut line[filter.radius..][..w]);
            let mut next = || inner.next().expect("there is a line for every plane");
            let line_of = |plane: &[f32], line: &mut [f32]| line.copy_from_slice(&plane[y * w..][..w]);
            filter.image.chunks(n).for_each(|plane| line_of(plane, next()));
            line_of(filter.noise, next());
            next().fill(1.0);
            filter.features.chunks(n).for_each(|plane| line_of(plane, next()));
        });
        Self { planes, stride, values }
    }

    /// All planes of row `y`.
    fn row(&self, y: usize) -> &[f32] {
        &self.values[y * self.planes * self.stride..][..self.planes * self.stride]
    }

    /// The lanes of a plane of a row that begin at column `x - radius` of the image.
    #[inline(always)]
    fn lanes<S: Simd>(&self, simd: S, row: &[f32], plane: usize, x: usize) -> S::V {
        let lanes: &[f32; LANES] = row[plane * self.stride + x..].first_chunk().expect("margins suffice");
        // SAFETY: a reference to as many values is valid for reading them.
        unsafe { simd.read(lanes.as_ptr()) }
    }

    /// The squared distances of a block to the lanes of a row that begin at column `from - radius`, summed over
    /// `planes`. No closure, which may be compiled without the tier's instructions.
    #[inline(always)]
    fn squares<S: Simd>(
        &self,
        simd: S,
        own: &[Block],
        row: &[f32],
        planes: Range<usize>,
        from: usize,
    ) -> S::V {
        let mut sum = simd.splat(0.0);
        for plane in planes {
            let difference =
                simd.fma(self.lanes(simd, row, plane, from), simd.splat(-1.0), simd.get(&own[plane]));
            sum = simd.fma(difference, difference, sum);
        }
        sum
    }
}

/// A block of pixels of a row, to be filtered, and how it compares with the neighbours that are looked at.
struct Own {
    /// What is compared, in the order of [`Margins`].
    values: Vec<Block>,
    precision: Vec<Block>,
    /// Distances to the neighbours, one block for each precision.
    distance: Vec<Block>,
}

impl CrossBilateral<'_> {
    /// Number of precisions of a pixel.
    fn precisions(&self) -> usize {
        2 + self.groups.len()
    }

    fn check(&self) {
        let n = self.size.pixels();
        assert_eq!((self.image.len(), self.noise.len()), (3 * n, n));
        assert_eq!(self.features.len(), self.groups.iter().sum::<usize>() * n);
        assert_eq!(self.precision.len(), self.precisions() * n);
    }

    /// Filters the image into `output`, (3, H, W). `total`, (1, H, W), receives the sum of each pixel's
    /// weights.
    ///
    /// # Panics
    /// If lengths do not fit the size.
    pub fn apply(self, tier: Tier, output: &mut [f32], total: &mut [f32]) {
        self.check();
        let (n, w) = (self.size.pixels(), self.size.w);
        assert_eq!((output.len(), total.len()), (3 * n, n));
        let margins = Margins::new(&self);
        each_row(w, [output], total, |y, [output], total| {
            tier.run(Forward { filter: &self, margins: &margins, y, output, total })
        });
    }

    /// Backpropagates the output's gradient, (3, H, W), to the precisions. The result, (2 + groups, H, W), is
    /// added to `into`. `output` and `total` are those of [`CrossBilateral::apply`].
    ///
    /// # Panics
    /// If lengths do not fit the size.
    pub fn gradient(
        self,
        tier: Tier,
        (output, total): (&[f32], &[f32]),
        output_gradient: &[f32],
        into: &mut [f32],
    ) {
        self.check();
        let (n, w) = (self.size.pixels(), self.size.w);
        assert_eq!((output.len(), total.len(), output_gradient.len()), (3 * n, n, 3 * n));
        assert_eq!(into.len(), self.precisions() * n);
        let margins = Margins::new(&self);
        // A row of gradients for every precision, row by row.
        let mut rows: Vec<Vec<&mut [f32]>> = (0..self.size.h).map(|_| Vec::new()).collect();
        for plane in into.chunks_mut(n) {
            rows.iter_mut().zip(plane.chunks_mut(w)).for_each(|(row, chunk)| row.push(chunk));
        }
        rows.into_par_iter().enumerate().for_each(|(y, into)| {
            tier.run(Backward { filter: &self, margins: &margins, y, output, total, output_gradient, into });
        });
    }

    /// The rows that a pixel of row `y` looks at.
    fn rows(&self, y: usize) -> Range<usize> {
        y.saturating_sub(self.radius)..(y + self.radius + 1).min(self.size.h)
    }

    /// The block of pixels of row `y` that begins at column `x`.
    fn own(&self, margins: &Margins, y: usize, x: usize) -> Own {
        let Size { w, .. } = self.size;
        let inner = margins.row(y).chunks(margins.stride).map(|line| &line[self.radius..][..w]);
        Own {
            values: inner.map(|line| block(line, x)).collect(),
            precision: self
                .precision
                .chunks(self.size.pixels())
                .map(|p| block(&p[y * w..][..w], x))
                .collect(),
            distance: vec![Block::default(); self.precisions()],
        }
    }

    /// The weights of the neighbours in `row`, all planes of a row, that begin at column `from - radius`;
    /// `position` is their squared distance in units of the radius. Leaves all distances in `own`.
    #[inline(always)]
    fn weights<S: Simd>(
        &self,
        simd: S,
        own: &mut Own,
        margins: &Margins,
        row: &[f32],
        (from, position): (usize, f32),
    ) -> S::V {
        let minus = simd.splat(-1.0);
        let Own { values, precision, distance } = own;
        let noise = simd.add(simd.get(&values[NOISE]), margins.lanes(simd, row, NOISE, from));
        let colour = simd.div(
            margins.squares(simd, values, row, 0..NOISE, from),
            simd.add(noise, simd.splat(NOISE_FLOOR)),
        );
        let position = simd.splat(position);
        simd.set(&mut distance[0], position);
        simd.set(&mut distance[1], colour);
        let mut exponent = simd.mul(simd.get(&precision[0]), position);
        exponent = simd.fma(simd.get(&precision[1]), colour, exponent);
        let mut first = FEATURES;
        for (group, channels) in self.groups.iter().enumerate() {
            let apart = margins.squares(simd, values, row, first..first + channels, from);
            simd.set(&mut distance[2 + group], apart);
            exponent = simd.fma(simd.get(&precision[2 + group]), apart, exponent);
            first += channels;
        }
        let weight = simd.exp(simd.mul(exponent, minus));
        simd.mul(weight, margins.lanes(simd, row, INSIDE, from))
    }

    /// The squared distance in pixels of a neighbour, in units of the radius; `from` counts from the left end
    /// of the square.
    #[inline(always)]
    fn position(&self, y: usize, row: usize, from: usize) -> f32 {
        let (dy, dx) = (y.abs_diff(row), from.abs_diff(self.radius));
        (dx * dx + dy * dy) as f32 / (self.radius.max(1) * self.radius.max(1)) as f32
    }
}

/// The values of a row from column `x` on, and zeros beyond its last.
fn block(row: &[f32], x: usize) -> Block {
    let mut block = Block::default();
    let count = LANES.min(row.len() - x);
    block.0[..count].copy_from_slice(&row[x..][..count]);
    block
}

struct Forward<'a, 'f> {
    filter: &'a CrossBilateral<'f>,
    margins: &'a Margins,
    y: usize,
    output: [&'a mut [f32]; 3],
    total: &'a mut [f32],
}

impl Kernel for Forward<'_, '_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { filter, margins, y, mut output, total } = self;
        let w = filter.size.w;
        for x in (0..w).step_by(LANES) {
            let mut own = filter.own(margins, y, x);
            // Three colours, and the weights.
            let mut sums = [simd.splat(0.0); 4];
            for row in filter.rows(y) {
                let planes = margins.row(row);
                for dx in 0..=2 * filter.radius {
                    let at = (x + dx, filter.position(y, row, dx));
                    let weight = filter.weights(simd, &mut own, margins, planes, at);
                    for c in 0..3 {
                        sums[c] = simd.fma(margins.lanes(simd, planes, c, x + dx), weight, sums[c]);
                    }
                    sums[3] = simd.add(sums[3], weight);
                }
            }
            let count = LANES.min(w - x);
            let mut lanes = Block::default();
            simd.set(&mut lanes, sums[3]);
            total[x..][..count].copy_from_slice(&lanes.0[..count]);
            for (out, sum) in output.iter_mut().zip(sums) {
                simd.set(&mut lanes, simd.div(sum, sums[3]));
                out[x..][..count].copy_from_slice(&lanes.0[..count]);
            }
        }
    }
}

struct Backward<'a, 'f> {
    filter: &'a CrossBilateral<'f>,
    margins: &'a Margins,
    y: usize,
    output: &'a [f32],
    total: &'a [f32],
    output_gradient: &'a [f32],
    into: Vec<&'a mut [f32]>,
}

impl Kernel for Backward<'_, '_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { filter, margins, y, output, total, output_gradient, mut into } = self;
        let Size { w, .. } = filter.size;
        let n = filter.size.pixels();
        let mut sums = vec![Block::default(); into.len()];
        for x in (0..w).step_by(LANES) {
            let mut own = filter.own(margins, y, x);
            let colours = |planes: &[f32]| [0, 1, 2].map(|c| block(&planes[c * n + y * w..][..w], x));
            let (output, gradient) = (colours(output), colours(output_gradient));
            sums.fill(Block::default());
            for row in filter.rows(y) {
                let planes = margins.row(row);
                for dx in 0..=2 * filter.radius {
                    let at = (x + dx, filter.position(y, row, dx));
                    let weight = filter.weights(simd, &mut own, margins, planes, at);
                    let mut slope = simd.splat(0.0);
                    for c in 0..3 {
                        let value = margins.lanes(simd, planes, c, x + dx);
                        let off = simd.fma(simd.get(&output[c]), simd.splat(-1.0), value);
                        slope = simd.fma(simd.get(&gradient[c]), off, slope);
                    }
                    let slope = simd.mul(slope, weight);
                    for (sum, distance) in sums.iter_mut().zip(&own.distance) {
                        let added = simd.fma(slope, simd.get(distance), simd.get(sum));
                        simd.set(sum, added);
                    }
                }
            }
            // d w / d a = -D w, and the sum of weights divides.
            let total = block(&total[y * w..][..w], x).0;
            for (into, sum) in into.iter_mut().zip(&sums) {
                let pixels = into[x..].iter_mut().zip(&sum.0).zip(&total);
                pixels.for_each(|((into, sum), total)| *into -= sum / total);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::exponential::LIMIT;

    /// Reproducible values in 0..1.
    fn random(seed: u32, n: usize) -> Vec<f32> {
        let step = |state: &mut u32| {
            *state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            Some((*state >> 8) as f32 / (1 << 24) as f32)
        };
        std::iter::repeat_n((), n).scan(seed, |state, ()| step(state)).collect()
    }

    /// The definition, pixel by pixel, in f64.
    fn oracle(f: &CrossBilateral, c: usize, i: usize) -> f64 {
        let (Size { h, w }, n) = (f.size, f.size.pixels());
        let (y, x, r) = ((i / w) as isize, (i % w) as isize, f.radius as isize);
        let (mut sum, mut total) = (0.0, 0.0);
        for j in 0..n {
            let (dy, dx) = ((j / w) as isize - y, (j % w) as isize - x);
            if dy.abs() > r || dx.abs() > r || j / w >= h {
                continue;
            }
            let squares = |planes: &[f32]| -> f64 {
                planes.chunks(n).map(|p| (f64::from(p[i]) - f64::from(p[j])).powi(2)).sum()
            };
            let noise = f64::from(f.noise[i]) + f64::from(f.noise[j]) + f64::from(NOISE_FLOOR);
            let mut distances = vec![(dx * dx + dy * dy) as f64 / (r * r).max(1) as f64];
            distances.push(squares(f.image) / noise);
            let mut first = 0;
            for channels in f.groups {
                distances.push(squares(&f.features[first * n..][..channels * n]));
                first += channels;
            }
            let exponent: f64 =
                distances.iter().enumerate().map(|(m, d)| f64::from(f.precision[m * n + i]) * d).sum();
            let weight = (-exponent.min(f64::from(LIMIT))).exp();
            sum += weight * f64::from(f.image[c * n + j]);
            total += weight;
        }
        sum / total
    }

    #[test]
    fn every_tier_is_the_definition_at_every_size() {
        for (h, w, radius) in [(1, 1, 2), (3, 20, 4), (7, 5, 3), (12, 33, 2), (4, 4, 0)] {
            let n = h * w;
            let (image, noise, features) = (random(1, 3 * n), random(2, n), random(3, 4 * n));
            let mut precision = random(4, 4 * n);
            precision.iter_mut().for_each(|a| *a *= 3.0);
            precision[0] = 1e6; // a pixel that trusts nobody but itself
            let filter = CrossBilateral {
                size: Size { h, w },
                radius,
                image: &image,
                noise: &noise,
                features: &features,
                groups: &[1, 3],
                precision: &precision,
            };
            for tier in Tier::available() {
                let (mut output, mut total) = (vec![0.0; 3 * n], vec![0.0; n]);
                filter.apply(tier, &mut output, &mut total);
                for (i, got) in output.iter().enumerate() {
                    let want = oracle(&filter, i / n, i % n);
                    assert!(
                        (f64::from(*got) - want).abs() < 1e-5,
                        "{h}x{w}, {tier:?}, {i}: {got} for {want}"
                    );
                }
            }
        }
    }
}
