//! Applying predicted kernels to an image, and building its pyramid: planar f32, one image at a time.
//!
//! A pixel's filtered value is `sum_k w_k x_k / sum_k w_k` over its k x k neighbourhood with
//! `w_k = exp(logit_k + confidence_k)`. The logit is the pixel's and says how much it wants each neighbour;
//! the confidence is the neighbour's and says how far it can be trusted, so that a firefly is marked once
//! instead of in 25 kernels. Neighbours outside the image have no weight. The largest exponent of a pixel is
//! subtracted from all exponents of that pixel. This does not change the result, but keeps the sum from
//! overflowing, however large a network's logits have grown.

use rayon::prelude::*;

use super::{
    LANES,
    exponential::{exp, limited},
    simd::{Kernel, Simd, Tier},
    thirds,
    vectorised::{self, Vectorised},
};

/// Rows and columns of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Size {
    /// Rows.
    pub h: usize,
    /// Pixels in a row.
    pub w: usize,
}

impl Size {
    /// Pixels of one plane.
    pub fn pixels(self) -> usize {
        self.h * self.w
    }
}

/// One image to be filtered: everything the forward pass reads.
#[derive(Clone, Copy)]
pub struct Filter<'a> {
    /// Rows and columns of the image.
    pub size: Size,
    /// The first row to filter and the row after the last, R rows in all. They are the whole image, or a band
    /// whose neighbouring rows the image holds too.
    pub rows: (usize, usize),
    /// Kernel size, odd.
    pub k: usize,
    /// The image, (3, H, W).
    pub image: &'a [f32],
    /// Kernel logits, (k*k, L, W).
    pub logits: &'a [f32],
    /// The row of the logits that is that of the first row to filter. R rows from there on are read.
    pub first: usize,
    /// Confidence of each pixel, (1, H, W), or nothing for equal trust.
    pub confidence: Option<&'a [f32]>,
}

/// Where the gradients of a filter are added.
pub struct FilterGradient<'a> {
    /// To the image, (3, H, W), where it is wanted.
    pub image: Option<&'a mut [f32]>,
    /// To the logits, (k*k, H, W).
    pub logits: &'a mut [f32],
    /// To the confidence, (1, H, W), where there is one.
    pub confidence: Option<&'a mut [f32]>,
}

/// The columns of a row whose neighbour `dx` away lies inside the row; `|dx| < w`.
#[inline(always)]
fn columns(w: usize, dx: isize) -> (usize, usize) {
    ((-dx).max(0) as usize, (w as isize - dx.max(0)) as usize)
}

/// Runs `work(row, its red, green and blue in each output, its sums)` on every row of `w` pixels of
/// `outputs`, each (3, H, W), and `total` (1, H, W).
pub(super) fn each_row<const N: usize>(
    w: usize,
    outputs: [&mut [f32]; N],
    total: &mut [f32],
    work: impl Fn(usize, [[&mut [f32]; 3]; N], &mut [f32]) + Sync,
) {
    let mut planes = outputs.map(|output| thirds(output).map(|plane| plane.chunks_mut(w)));
    let mut next_row = || {
        planes
            .each_mut()
            .map(|planes| planes.each_mut().map(|rows| rows.next().expect("as many as of the total")))
    };
    let rows: Vec<_> = total.chunks_mut(w).map(|total| (next_row(), total)).collect();
    rows.into_par_iter().enumerate().for_each(|(y, (outputs, total))| work(y, outputs, total));
}

impl<'a> Filter<'a> {
    fn check(&self) {
        let n = self.size.pixels();
        assert!(self.k % 2 == 1, "kernels have a centre");
        assert!(self.rows.0 <= self.rows.1 && self.rows.1 <= self.size.h, "only rows of the image");
        assert_eq!(
            (self.image.len(), self.logits.len() % (self.k * self.k * self.size.w).max(1)),
            (3 * n, 0)
        );
        assert!(
            self.first * self.size.w + self.filtered() <= self.predicted(),
            "logits of all rows to filter"
        );
        assert!(self.confidence.is_none_or(|c| c.len() == n));
    }

    /// Number of pixels that are filtered.
    fn filtered(&self) -> usize {
        (self.rows.1 - self.rows.0) * self.size.w
    }

    /// Number of pixels that there are logits of.
    fn predicted(&self) -> usize {
        self.logits.len() / (self.k * self.k)
    }

    /// The taps of row `y` of the filtered rows that read a row inside the image. Each is its place in the
    /// kernel, the row it reads, and how far to the right it reads. They are a list, since closures may be
    /// compiled without the tier's instructions.
    fn taps(&self, y: usize) -> Vec<(usize, usize, isize)> {
        let (k, r) = (self.k, (self.k / 2) as isize);
        // A kernel wider than the image has taps that meet no pixel at all.
        let columns = (0..k).filter(|kx| (*kx as isize - r).unsigned_abs() < self.size.w);
        let rows = (0..k).filter_map(|ky| {
            let row = (self.rows.0 + y + ky).checked_add_signed(-r)?;
            (row < self.size.h).then_some((ky, row))
        });
        rows.flat_map(|(ky, row)| columns.clone().map(move |kx| (ky * k + kx, row, kx as isize - r)))
            .collect()
    }

    /// Calls `put(pixel, exponent)` on those pixels of row `y` of the filtered rows that have a neighbour at
    /// this tap.
    #[inline(always)]
    fn exponents(
        &self,
        y: usize,
        (tap, row, dx): (usize, usize, isize),
        out: &mut [f32],
        put: impl Fn(&mut f32, f32),
    ) {
        let Size { w, .. } = self.size;
        let (x0, x1) = columns(w, dx);
        let logits = &self.logits[tap * self.predicted() + (self.first + y) * w..][x0..x1];
        let out = &mut out[x0..x1];
        match self.confidence {
            Some(confidence) => {
                let confidence = &confidence[row * w..][(x0 as isize + dx) as usize..][..x1 - x0];
                out.iter_mut().zip(logits).zip(confidence).for_each(|((out, l), c)| put(out, l + c));
            }
            None => out.iter_mut().zip(logits).for_each(|(out, l)| put(out, *l)),
        }
    }

    /// Writes the largest exponent over `taps` of each pixel of row `y` of the filtered rows.
    #[inline(always)]
    fn largest(&self, y: usize, taps: &[(usize, usize, isize)], out: &mut [f32]) {
        out.fill(f32::NEG_INFINITY);
        let larger = |out: &mut f32, exponent: f32| *out = if exponent > *out { exponent } else { *out };
        for &tap in taps {
            self.exponents(y, tap, out, larger);
        }
    }

    /// Writes the weights of one tap along row `y` of the filtered rows, relative to the weight of the
    /// `largest` exponent. Returns the columns `x0..x1` that have such a weight.
    #[inline(always)]
    fn weights(
        &self,
        y: usize,
        tap: (usize, usize, isize),
        largest: &[f32],
        out: &mut [f32],
    ) -> (usize, usize) {
        let (x0, x1) = columns(self.size.w, tap.2);
        self.exponents(y, tap, out, |out, exponent| *out = exponent);
        out[x0..x1].iter_mut().zip(&largest[x0..x1]).for_each(|(out, most)| *out = exp(*out - most));
        (x0, x1)
    }

    /// Filters the image into `output`, (3, R, W). `total`, (1, R, W), receives the sum of each pixel's
    /// weights, the largest of which is 1.
    ///
    /// # Panics
    /// If lengths do not fit the size.
    pub fn apply(self, tier: Tier, output: &mut [f32], total: &mut [f32]) {
        self.apply_to_all(tier, [self.image], [output], total);
    }

    /// [`Filter::apply`] to several `images` of the same size as [`Filter::image`], with the same kernels.
    ///
    /// # Panics
    /// As [`Filter::apply`].
    pub fn apply_to_all<const N: usize>(
        self,
        tier: Tier,
        images: [&'a [f32]; N],
        outputs: [&mut [f32]; N],
        total: &mut [f32],
    ) {
        self.check();
        let (n, w) = (self.filtered(), self.size.w);
        assert_eq!(total.len(), n);
        assert!(images.iter().all(|image| image.len() == self.image.len()));
        assert!(outputs.iter().all(|output| output.len() == 3 * n));
        // Equal trust adds nothing to any exponent.
        let equal = vec![0.0; if self.confidence.is_none() { w } else { 0 }];
        each_row(w, outputs, total, |y, output, total| {
            let line = |values: &'a [f32], row: usize| &values[row * w..][..w];
            let taps = self.taps(y).into_iter().map(|(tap, row, dx)| Tap {
                logits: line(self.logits, tap * (self.predicted() / w) + self.first + y),
                confidence: self.confidence.map_or(&equal[..], |trust| line(trust, row)),
                images: images.map(|image| std::array::from_fn(|c| line(image, c * self.size.h + row))),
                dx,
            });
            tier.run(Forward { taps: taps.collect(), reach: self.k / 2, output, total });
        });
    }

    /// Backpropagates the output's gradient, (3, H, W), and adds the results to what `into` holds. `output`
    /// and `total` are those that [`Filter::apply`] made of all rows.
    ///
    /// # Panics
    /// If lengths do not fit the size, or not all rows are filtered.
    pub fn gradient(
        self,
        tier: Tier,
        (output, total): (&[f32], &[f32]),
        output_gradient: &[f32],
        into: FilterGradient,
    ) {
        self.check();
        let n = self.size.pixels();
        assert_eq!(self.filtered(), n, "gradients are those of whole images");
        assert_eq!((output.len(), total.len(), output_gradient.len()), (3 * n, n, 3 * n));
        assert_eq!(into.logits.len(), self.logits.len());
        assert!(into.image.as_ref().is_none_or(|i| i.len() == 3 * n));
        assert_eq!(into.confidence.as_ref().map(|c| c.len()), self.confidence.map(|_| n));
        tier.run(Backward { filter: &self, output, total, output_gradient, into });
    }
}

/// One tap of a row: the rows that it reads, and how far to the right.
struct Tap<'a, const N: usize> {
    logits: &'a [f32],
    confidence: &'a [f32],
    images: [[&'a [f32]; 3]; N],
    dx: isize,
}

struct Forward<'a, const N: usize> {
    taps: Vec<Tap<'a, N>>,
    /// Columns to either side that a tap reaches.
    reach: usize,
    output: [[&'a mut [f32]; 3]; N],
    total: &'a mut [f32],
}

impl<const N: usize> Kernel for Forward<'_, N> {
    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S) {
        let w = self.total.len();
        for x in (0..w).step_by(LANES) {
            // SAFETY: all columns that are read lie inside the row in the first case.
            unsafe {
                if x >= self.reach && x + LANES + self.reach <= w {
                    self.pixels::<S, true>(simd, x);
                } else {
                    self.pixels::<S, false>(simd, x);
                }
            }
        }
    }
}

impl<const N: usize> Forward<'_, N> {
    /// Filters 16 pixels of the row from column `x` on, or as many as are left.
    ///
    /// # Safety
    /// As for [`some_columns`].
    #[inline(always)]
    unsafe fn pixels<S: Simd, const INNER: bool>(&mut self, simd: S, x: usize) {
        let count = LANES.min(self.total.len() - x);
        // SAFETY: the caller's promise; no more is written than there is.
        unsafe {
            let mut largest = simd.splat(f32::NEG_INFINITY);
            for tap in &self.taps {
                largest = simd.max(tap.exponents::<S, INNER>(simd, x), largest);
            }
            let (mut sums, mut total) = ([[simd.splat(0.0); 3]; N], simd.splat(0.0));
            for tap in &self.taps {
                let exponents = tap.exponents::<S, INNER>(simd, x);
                let weights = simd.exp(simd.fma(largest, simd.splat(-1.0), exponents));
                total = simd.add(total, weights);
                for (sum, row) in sums.as_flattened_mut().iter_mut().zip(tap.images.as_flattened()) {
                    let values = some_columns::<S, INNER>(simd, row, x as isize + tap.dx, 0.0);
                    *sum = simd.fma(values, weights, *sum);
                }
            }
            let inverse = simd.div(simd.splat(1.0), total);
            for (out, sum) in self.output.as_flattened_mut().iter_mut().zip(sums.as_flattened()) {
                simd.write_first(out[x..].as_mut_ptr(), count, simd.mul(*sum, inverse));
            }
            simd.write_first(self.total[x..].as_mut_ptr(), count, total);
        }
    }
}

impl<const N: usize> Tap<'_, N> {
    /// The exponents of 16 pixels from column `x` on. Where there is no neighbour, the exponent is minus
    /// infinity.
    ///
    /// # Safety
    /// As for [`some_columns`].
    #[inline(always)]
    unsafe fn exponents<S: Simd, const INNER: bool>(&self, simd: S, x: usize) -> S::V {
        // SAFETY: the caller's promise.
        unsafe {
            let logits = some_columns::<S, INNER>(simd, self.logits, x as isize, 0.0);
            let trust =
                some_columns::<S, INNER>(simd, self.confidence, x as isize + self.dx, f32::NEG_INFINITY);
            simd.add(logits, trust)
        }
    }
}

/// Columns `x..x + 16` of a row, with `other` in place of those that the row does not have.
///
/// # Safety
/// If `INNER`, the row has all of them.
#[inline(always)]
unsafe fn some_columns<S: Simd, const INNER: bool>(simd: S, row: &[f32], x: isize, other: f32) -> S::V {
    let p = row.as_ptr().wrapping_offset(x);
    // SAFETY: the caller's promise, or else only columns that the row has are read.
    unsafe {
        if INNER {
            simd.read(p)
        } else {
            let inside = |x: isize| x.clamp(0, LANES as isize) as usize;
            simd.read_some(p, inside(-x)..inside(row.len() as isize - x), other)
        }
    }
}

struct Backward<'a, 'f> {
    filter: &'a Filter<'f>,
    output: &'a [f32],
    total: &'a [f32],
    output_gradient: &'a [f32],
    into: FilterGradient<'a>,
}

impl Kernel for Backward<'_, '_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Size { h, w } = self.filter.size;
        let n = h * w;
        let FilterGradient { mut image, logits, mut confidence } = self.into;
        let (mut weights, mut slope, mut largest) = (vec![0.0; w], vec![0.0; w], vec![0.0; w]);
        for y in 0..h {
            let total = &self.total[y * w..][..w];
            let taps = self.filter.taps(y);
            self.filter.largest(y, &taps, &mut largest);
            for (tap, row, dx) in taps {
                let (x0, x1) = self.filter.weights(y, (tap, row, dx), &largest, &mut weights);
                let len = x1 - x0;
                let weights = &mut weights[x0..x1];
                weights.iter_mut().zip(&total[x0..x1]).for_each(|(w, t)| *w /= t);
                let slope = &mut slope[x0..x1];
                slope.fill(0.0);
                let (at, from) = (y * w + x0, row * w + (x0 as isize + dx) as usize);
                for c in 0..3 {
                    let x = &self.filter.image[c * n + from..][..len];
                    let out = &self.output[c * n + at..][..len];
                    let g = &self.output_gradient[c * n + at..][..len];
                    for (((s, x), out), g) in slope.iter_mut().zip(x).zip(out).zip(g) {
                        *s += g * (x - out);
                    }
                    if let Some(image) = &mut image {
                        let image = &mut image[c * n + from..][..len];
                        for ((i, w), g) in image.iter_mut().zip(&*weights).zip(g) {
                            *i += w * g;
                        }
                    }
                }
                slope.iter_mut().zip(&*weights).for_each(|(s, w)| *s *= w);
                let logits = &mut logits[tap * n + at..][..len];
                logits.iter_mut().zip(&*slope).for_each(|(l, s)| *l += s);
                if let Some(confidence) = &mut confidence {
                    let confidence = &mut confidence[from..][..len];
                    confidence.iter_mut().zip(&*slope).for_each(|(c, s)| *c += s);
                }
            }
        }
    }
}

/// Halves an image, (3, H, W): each output pixel is the mean of a quad (2x2 pixels), weighted by
/// `exp(confidence)`. Confidence beyond +-40 counts as +-40 and has no gradient. `total`, (1, H/2, W/2),
/// receives the sum of each quad's weights.
///
/// # Panics
/// If lengths do not fit, or rows or columns are odd.
pub fn reduce(size: Size, image: &[f32], confidence: &[f32], output: &mut [f32], total: &mut [f32]) {
    let (h, w) = (size.h / 2, size.w / 2);
    assert_eq!(
        (2 * h, 2 * w, image.len(), confidence.len()),
        (size.h, size.w, 3 * size.pixels(), size.pixels())
    );
    assert_eq!((output.len(), total.len()), (3 * h * w, h * w));
    let rows = [image, confidence];
    each_row(w, [output], total, |y, [output], total| {
        vectorised::run(Quads { size, y, rows, output, total })
    });
}

/// One row of the output of [`reduce`].
struct Quads<'a> {
    size: Size,
    y: usize,
    /// The image and the confidence.
    rows: [&'a [f32]; 2],
    output: [&'a mut [f32]; 3],
    total: &'a mut [f32],
}

impl Vectorised for Quads<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { size: Size { w, .. }, y, rows: [image, confidence], output, total } = self;
        let (n, at) = (self.size.pixels(), 2 * y * w);
        let mut weights = confidence[at..][..2 * w].to_vec();
        weights.iter_mut().for_each(|v| *v = exp(*v));
        let (top, bottom) = weights.split_at(w);
        let (top, bottom) = (top.as_chunks::<2>().0, bottom.as_chunks::<2>().0);
        for ((total, a), b) in total.iter_mut().zip(top).zip(bottom) {
            *total = a[0] + a[1] + b[0] + b[1];
        }
        for (c, out) in output.into_iter().enumerate() {
            let (first, second) = image[c * n + at..][..2 * w].split_at(w);
            let values = first.as_chunks::<2>().0.iter().zip(second.as_chunks::<2>().0);
            let weights = top.iter().zip(bottom).zip(&*total);
            for ((out, (v, u)), ((a, b), total)) in out.iter_mut().zip(values).zip(weights) {
                *out = (v[0] * a[0] + v[1] * a[1] + u[0] * b[0] + u[1] * b[1]) / total;
            }
        }
    }
}

/// Backpropagates the gradient of [`reduce`]'s output to image and confidence, and adds the results to
/// theirs.
///
/// # Panics
/// As [`reduce`].
pub fn reduce_gradient(
    size: Size,
    image: &[f32],
    confidence: &[f32],
    (output, total): (&[f32], &[f32]),
    output_gradient: &[f32],
    mut into_image: Option<&mut [f32]>,
    into_confidence: &mut [f32],
) {
    let (h, w, n) = (size.h / 2, size.w / 2, size.pixels());
    assert_eq!((output.len(), total.len(), output_gradient.len()), (3 * h * w, h * w, 3 * h * w));
    for y in 0..size.h {
        for x in 0..size.w {
            let (at, to) = (y * size.w + x, (y / 2) * w + x / 2);
            let weight = exp(confidence[at]) / total[to];
            let slope = limited(confidence[at], weight);
            for c in 0..3 {
                let g = output_gradient[c * h * w + to];
                into_confidence[at] += g * slope * (image[c * n + at] - output[c * h * w + to]);
                if let Some(into) = &mut into_image {
                    into[c * n + at] += g * weight;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Logits of a network that is sure of itself reach hundreds, and the sum of their exponentials
    /// overflows.
    #[test]
    fn large_logits_are_filtered_as_a_softmax_says() {
        let (size, k) = (Size { h: 3, w: 21 }, 5);
        let n = size.pixels();
        let wave = |i: usize, scale: f32| ((i * 7919) as f32).sin() * scale;
        let image: Vec<f32> = (0..3 * n).map(|i| 1.0 + wave(i, 0.9)).collect();
        let confidence: Vec<f32> = (0..n).map(|i| wave(i + 5, 30.0)).collect();
        for (offset, confidence) in [(0.0, None), (500.0, Some(&confidence[..])), (-500.0, None)] {
            let logits: Vec<f32> = (0..k * k * n).map(|i| offset + wave(i, 150.0)).collect();
            let filter =
                Filter { size, rows: (0, size.h), k, image: &image, logits: &logits, first: 0, confidence };
            let (mut output, mut total) = (vec![0.0; 3 * n], vec![0.0; n]);
            for tier in Tier::available() {
                filter.apply(tier, &mut output, &mut total);
                for y in 0..size.h {
                    for x in 0..size.w {
                        let mut taps = Vec::new();
                        for (tap, row, dx) in filter.taps(y) {
                            if let Some(column) = x.checked_add_signed(dx).filter(|column| *column < size.w) {
                                let at = row * size.w + column;
                                let trust = confidence.map_or(0.0, |c| f64::from(c[at]));
                                taps.push((at, trust + f64::from(logits[tap * n + y * size.w + x])));
                            }
                        }
                        let most = taps.iter().map(|tap| tap.1).fold(f64::MIN, f64::max);
                        let sum: f64 = taps.iter().map(|tap| (tap.1 - most).exp()).sum();
                        for c in 0..3 {
                            let weighted =
                                |(at, e): &(usize, f64)| (e - most).exp() * f64::from(image[c * n + at]);
                            let want = taps.iter().map(weighted).sum::<f64>() / sum;
                            let got = f64::from(output[c * n + y * size.w + x]);
                            assert!(
                                (got - want).abs() < 1e-4 * want,
                                "{tier:?} ({x}, {y}): {got} for {want}"
                            );
                        }
                    }
                }
            }
        }
    }
}
