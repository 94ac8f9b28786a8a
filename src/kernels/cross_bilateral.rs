//! The cross-bilateral filter whose parameters differ from pixel to pixel, and its gradient with respect to
//! them: planar f32, one image at a time.
//!
//! A pixel i becomes `sum_j w_ij c_j / sum_j w_ij` over the square around it that lies inside the image, with
//! `w_ij = exp(-sum_m a_m(i) D_m(i, j))`. The distances D are, in this order: the squared distance between
//! the pixels in units of the radius, the squared distance between their colours divided by the noise of
//! both, and the squared distance of each group of features. The factors `a_m(i)` are the precisions of pixel
//! i.

use rayon::prelude::*;

use super::{
    exponential::exp,
    filter::{Size, each_row},
    simd::{Kernel, Simd, Tier},
};

/// Added to the noise of two colours before their distance is divided by it.
const NOISE_FLOOR: f32 = 1e-4;

/// No exponent goes below minus this: the weight of such a neighbour does not count.
const MAX_EXPONENT: f32 = 38.0;

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

/// Distances of a row to a shifted one, one line of `w` values for each precision, and the weights that they
/// give.
struct Lines {
    distance: Vec<f32>,
    weight: Vec<f32>,
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
        each_row(w, [output], total, |y, [output], total| {
            tier.run(Forward { filter: &self, y, output, total })
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
        // A row of gradients for every precision, row by row.
        let mut rows: Vec<Vec<&mut [f32]>> = (0..self.size.h).map(|_| Vec::new()).collect();
        for plane in into.chunks_mut(n) {
            rows.iter_mut().zip(plane.chunks_mut(w)).for_each(|(row, chunk)| row.push(chunk));
        }
        rows.into_par_iter().enumerate().for_each(|(y, into)| {
            tier.run(Backward { filter: &self, y, output, total, output_gradient, into });
        });
    }

    /// Calls `visit(x0..x1, neighbour of x0, lines)` for every neighbour of row `y` that lies inside the
    /// image, with the distances and weights of the columns `x0..x1`.
    #[inline(always)]
    fn neighbours(&self, y: usize, mut visit: impl FnMut((usize, usize), usize, &Lines)) {
        let (Size { h, w }, n) = (self.size, self.size.pixels());
        let r = self.radius as isize;
        let unit = 1.0 / (self.radius.max(1) * self.radius.max(1)) as f32;
        let mut lines = Lines { distance: vec![0.0; self.precisions() * w], weight: vec![0.0; w] };
        for dy in -r..=r {
            let row = y as isize + dy;
            if row < 0 || row >= h as isize {
                continue;
            }
            for dx in (-r..=r).filter(|dx| dx.unsigned_abs() < w) {
                let (x0, x1) = ((-dx).max(0) as usize, (w as isize - dx.max(0)) as usize);
                let (at, from) = (y * w + x0, row as usize * w + (x0 as isize + dx) as usize);
                let len = x1 - x0;
                let weight = &mut lines.weight[x0..x1];
                let mut distances = lines.distance.chunks_exact_mut(w).map(|line| &mut line[x0..x1]);
                let mut next = || distances.next().expect("there is a line for every precision");
                let mut precision = self.precision.chunks_exact(n).map(|plane| &plane[at..][..len]);
                let mut own = || precision.next().expect("there is a plane for every line");

                let position = (dx * dx + dy * dy) as f32 * unit;
                next().fill(position);
                weight.iter_mut().zip(own()).for_each(|(e, a)| *e = a * position);

                let line = next();
                squared_distance(&self.image[..3 * n], n, at, from, line);
                let noise = self.noise[at..][..len].iter().zip(&self.noise[from..][..len]);
                for (((d, (a, b)), e), own) in line.iter_mut().zip(noise).zip(&mut *weight).zip(own()) {
                    *d /= a + b + NOISE_FLOOR;
                    *e += own * *d;
                }

                let mut first = 0;
                for channels in self.groups {
                    let line = next();
                    squared_distance(&self.features[first * n..][..channels * n], n, at, from, line);
                    weight.iter_mut().zip(&*line).zip(own()).for_each(|((e, d), a)| *e += a * d);
                    first += channels;
                }
                weight.iter_mut().for_each(|e| *e = exp(-e.min(MAX_EXPONENT)));
                visit((x0, x1), from, &lines);
            }
        }
    }
}

/// Writes to `line` the squared distances of the pixels from `at` on to those from `from` on, summed over
/// planes of `n` values.
#[inline(always)]
fn squared_distance(planes: &[f32], n: usize, at: usize, from: usize, line: &mut [f32]) {
    line.fill(0.0);
    for plane in planes.chunks_exact(n) {
        let (a, b) = (&plane[at..][..line.len()], &plane[from..][..line.len()]);
        for ((d, a), b) in line.iter_mut().zip(a).zip(b) {
            *d += (a - b) * (a - b);
        }
    }
}

struct Forward<'a, 'f> {
    filter: &'a CrossBilateral<'f>,
    y: usize,
    output: [&'a mut [f32]; 3],
    total: &'a mut [f32],
}

impl Kernel for Forward<'_, '_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { filter, y, output: [r, g, b], total } = self;
        let n = filter.size.pixels();
        for out in [&mut *r, &mut *g, &mut *b, &mut *total] {
            out.fill(0.0);
        }
        filter.neighbours(y, |(x0, x1), from, lines| {
            let weight = &lines.weight[x0..x1];
            for (out, c) in [(&mut *r, 0), (&mut *g, 1), (&mut *b, 2)] {
                let image = &filter.image[c * n + from..][..x1 - x0];
                for ((out, v), w) in out[x0..x1].iter_mut().zip(image).zip(weight) {
                    *out += v * w;
                }
            }
            total[x0..x1].iter_mut().zip(weight).for_each(|(t, w)| *t += w);
        });
        for out in [r, g, b] {
            out.iter_mut().zip(&*total).for_each(|(v, t)| *v /= t);
        }
    }
}

struct Backward<'a, 'f> {
    filter: &'a CrossBilateral<'f>,
    y: usize,
    output: &'a [f32],
    total: &'a [f32],
    output_gradient: &'a [f32],
    into: Vec<&'a mut [f32]>,
}

impl Kernel for Backward<'_, '_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { filter, y, output, total, output_gradient, mut into } = self;
        let (n, w) = (filter.size.pixels(), filter.size.w);
        let mut slope = vec![0.0; w];
        filter.neighbours(y, |(x0, x1), from, lines| {
            let (at, len) = (y * w + x0, x1 - x0);
            let slope = &mut slope[..len];
            slope.fill(0.0);
            for c in 0..3 {
                let x = &filter.image[c * n + from..][..len];
                let out = &output[c * n + at..][..len];
                let g = &output_gradient[c * n + at..][..len];
                for (((s, x), out), g) in slope.iter_mut().zip(x).zip(out).zip(g) {
                    *s += g * (x - out);
                }
            }
            // d w / d a = -D w, and the sum of weights divides.
            for ((s, w), t) in slope.iter_mut().zip(&lines.weight[x0..x1]).zip(&total[at..][..len]) {
                *s *= -w / t;
            }
            for (into, line) in into.iter_mut().zip(lines.distance.chunks_exact(w)) {
                for ((g, d), s) in into[x0..x1].iter_mut().zip(&line[x0..x1]).zip(&*slope) {
                    *g += d * s;
                }
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
            let weight = (-exponent.min(f64::from(MAX_EXPONENT))).exp();
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
