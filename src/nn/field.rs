//! Planar images on the tape, among them the radiance that predicted kernels filter.

use std::sync::Arc;

use dfdx::tensor::{Cpu, Merge, NoneTape, PutTape, Tape, TensorFromVec};
use rayon::prelude::*;

use super::{
    Activation, Images,
    activation::Gradient,
    pool::{PlaneBuffer, plane_buffer, zeros},
};
use crate::kernels::{
    blend::{BlendGradient, CORNERS, Masks, Place, blend, blend_gradient},
    filter::{Filter, FilterGradient, Size, reduce, reduce_gradient},
    gain::{amplify, amplify_gradient},
    layout::{add_blocked_shuffled, from_blocked_shuffled},
    memory,
    redivide::{redivide, redivide_gradient},
    simd::Tier,
    vectorised::CHUNK,
};

/// Images, channels, rows, columns.
pub type Extent = (usize, usize, usize, usize);

/// Values that threads may share.
#[derive(Clone, Debug)]
struct Values {
    extent: Extent,
    data: Arc<PlaneBuffer>,
    /// Index in `data` at which the values begin.
    first: usize,
}

impl Values {
    fn all(extent: Extent, data: PlaneBuffer) -> Self {
        Self { extent, data: Arc::new(data), first: 0 }
    }

    fn as_slice(&self) -> &[f32] {
        let (n, c, h, w) = self.extent;
        &self.data[self.first..][..n * c * h * w]
    }

    fn size(&self) -> Size {
        Size { h: self.extent.2, w: self.extent.3 }
    }

    /// The values of image `n`, (C, H, W).
    fn image(&self, n: usize) -> &[f32] {
        let len = self.extent.1 * self.size().pixels();
        &self.as_slice()[n * len..][..len]
    }
}

/// What an operation remembers of a field: its values, and where its gradient goes.
#[derive(Clone, Debug)]
struct Saved {
    values: Values,
    /// `None` for inputs, whose gradient is not needed.
    gradient: Option<Gradient<PlaneBuffer>>,
}

impl Saved {
    /// The gradient that has flowed in, if any.
    fn take(&self) -> Option<PlaneBuffer> {
        self.gradient.as_ref().and_then(Gradient::take)
    }

    /// Lets `add` add to the gradient, which is zero at first. For an input, `add` receives `None`.
    fn accumulate(&self, add: impl FnOnce(Option<&mut [f32]>)) {
        match &self.gradient {
            Some(gradient) => {
                gradient.accumulate(|| zeros(self.values.as_slice().len()), |sum, _| add(Some(sum)));
            }
            None => add(None),
        }
    }
}

/// An optional batch buffer as one optional slice an image.
fn by_image(buffer: Option<&mut [f32]>, images: usize) -> Vec<Option<&mut [f32]>> {
    match buffer {
        Some(buffer) => buffer.chunks_mut(buffer.len() / images).map(Some).collect(),
        None => (0..images).map(|_| None).collect(),
    }
}

/// Planar images (N, C, H, W) with a dfdx tape.
#[derive(Debug)]
pub struct Field<T> {
    saved: Saved,
    tape: T,
}

impl<T: Tape<f32, Cpu> + Merge<T>> Field<T> {
    /// A network input, with an empty tape. No gradient flows into it.
    ///
    /// # Panics
    /// If the length of `values` is not what `extent` demands.
    pub fn input(extent: Extent, values: &[f32]) -> Self {
        let mut data = plane_buffer(values.len());
        memory::copy(&mut data, values);
        Self::from_buffer(extent, data)
    }

    /// A network input of these values, with an empty tape. No gradient flows into it.
    ///
    /// # Panics
    /// As [`Field::input`].
    pub fn from_buffer(extent: Extent, data: PlaneBuffer) -> Self {
        assert_eq!(data.len(), extent.0 * extent.1 * extent.2 * extent.3);
        let values = Values::all(extent, data);
        Self { saved: Saved { values, gradient: None }, tape: T::default() }
    }

    /// Channel `c` of the first image.
    pub(super) fn plane(&self, c: usize) -> &[f32] {
        let pixels = self.saved.values.size().pixels();
        &self.saved.values.as_slice()[c * pixels..][..pixels]
    }

    /// All values, (N, C, H, W).
    pub fn values(&self) -> &[f32] {
        self.saved.values.as_slice()
    }

    fn output(extent: Extent, data: PlaneBuffer, tape: T) -> (Self, Saved) {
        let saved = Saved { values: Values::all(extent, data), gradient: Some(Gradient::default()) };
        (Self { saved: saved.clone(), tape }, saved)
    }

    /// A second handle on the same field, with an empty tape.
    pub fn fork(&self) -> Self {
        Self { saved: self.saved.clone(), tape: T::default() }
    }

    /// Images, channels, rows, columns.
    pub fn extent(&self) -> Extent {
        self.saved.values.extent
    }

    /// Channels `first..first + channels` of a layer's output as planes, each value at its own pixel for
    /// `factor` 1; for `factor` 2, four consecutive channels become the pixels of a quad.
    /// (N, K, H, W) -> (N, channels / factor^2, factor * H, factor * W)
    ///
    /// # Panics
    /// If there are not as many channels, or they are not whole quads from `first` on.
    pub fn from_activation(activation: Activation<T>, first: usize, channels: usize, factor: usize) -> Self {
        let activation = activation.into_f32();
        let shape = activation.shape();
        let planes = channels / (factor * factor);
        let extent = (shape.n, planes, factor * shape.h, factor * shape.w);
        let mut data = plane_buffer(shape.n * channels * shape.h * shape.w);
        from_blocked_shuffled(activation.saved.data.view(), first, factor, &mut data);
        let (mut field, out) = Self::output(extent, data, activation.tape);
        if T::OWNS_TAPE {
            let source = activation.saved;
            field.tape.add_backward_op(move |_| {
                let Some(gradient) = out.take() else { return Ok(()) };
                source.accumulate(|into, fresh| {
                    if fresh {
                        into.fill(Default::default());
                    }
                    add_blocked_shuffled(&gradient, first, factor, into.view_mut());
                });
                Ok(())
            });
        }
        field
    }

    /// Filters the field, (N, 3, H, W), by k x k kernels: `logits` (N, k*k, H, W) and, where neighbours
    /// are not all to be trusted alike, `confidence` (N, 1, H, W). See [`Filter`].
    ///
    /// # Panics
    /// If extents do not fit together, or k is even.
    pub fn filter(self, logits: Self, confidence: Option<Self>) -> Self {
        let (images, _, h, w) = self.extent();
        let k = logits.extent().1.isqrt();
        let tier = Tier::detect();
        let mut tape = self.tape.merge(logits.tape);
        let (image, logits) = (self.saved, logits.saved);
        let mut trust = None;
        if let Some(confidence) = confidence {
            tape = tape.merge(confidence.tape);
            trust = Some(confidence.saved);
        }
        let values = (image.values.clone(), logits.values.clone(), trust.as_ref().map(|t| t.values.clone()));
        let mut output = plane_buffer(images * 3 * h * w);
        let mut total = plane_buffer(images * h * w);
        for (n, (output, total)) in output.chunks_mut(3 * h * w).zip(total.chunks_mut(h * w)).enumerate() {
            filter_of(&values, n, k, (0, h)).apply(tier, output, total);
        }
        let (mut field, out) = Self::output((images, 3, h, w), output, tape);
        if T::OWNS_TAPE {
            field.tape.add_backward_op(move |_| {
                let Some(gradient) = out.take() else { return Ok(()) };
                let output = &out.values;
                let run = |image: Option<&mut [f32]>, logits: &mut [f32], trust: Option<&mut [f32]>| {
                    by_image(image, images)
                        .into_par_iter()
                        .zip(logits.par_chunks_mut(k * k * h * w))
                        .zip(by_image(trust, images))
                        .enumerate()
                        .for_each(|(n, ((image, logits), confidence))| {
                            let forward = (output.image(n), &total[n * h * w..][..h * w]);
                            let gradient = &gradient[n * 3 * h * w..][..3 * h * w];
                            let into = FilterGradient { image, logits, confidence };
                            filter_of(&values, n, k, (0, h)).gradient(tier, forward, gradient, into);
                        });
                };
                image.accumulate(|into_image| {
                    logits.accumulate(|into_logits| {
                        let into_logits = into_logits.expect("logits come from a layer");
                        match &trust {
                            Some(trust) => trust.accumulate(|into| run(into_image, into_logits, into)),
                            None => run(into_image, into_logits, None),
                        }
                    });
                });
                Ok(())
            });
        }
        field
    }

    /// Halves the field, (N, 3, H, W) -> (N, 3, H/2, W/2), each quad weighted by
    /// `exp(confidence)`, (N, 1, H, W). See [`reduce`].
    ///
    /// # Panics
    /// If extents do not fit together, or rows or columns are odd.
    pub fn reduce(self, confidence: Self) -> Self {
        let (images, _, h, w) = self.extent();
        let quarter = h * w / 4;
        let (mut output, mut total) = (plane_buffer(images * 3 * quarter), plane_buffer(images * quarter));
        let (image, trust) = (self.saved, confidence.saved);
        let (values, weights) = (image.values.clone(), trust.values.clone());
        output.par_chunks_mut(3 * quarter).zip(total.par_chunks_mut(quarter)).enumerate().for_each(
            |(n, (output, total))| reduce(values.size(), values.image(n), weights.image(n), output, total),
        );
        let extent = (images, 3, h / 2, w / 2);
        let (mut field, out) = Self::output(extent, output, self.tape.merge(confidence.tape));
        if T::OWNS_TAPE {
            field.tape.add_backward_op(move |_| {
                let Some(gradient) = out.take() else { return Ok(()) };
                let output = &out.values;
                image.accumulate(|into_image| {
                    trust.accumulate(|into_trust| {
                        let into_trust = into_trust.expect("confidence comes from a layer");
                        by_image(into_image, images)
                            .into_par_iter()
                            .zip(into_trust.par_chunks_mut(h * w))
                            .enumerate()
                            .for_each(|(n, (into_image, into_trust))| {
                                let forward = (output.image(n), &total[n * quarter..][..quarter]);
                                let gradient = &gradient[n * 3 * quarter..][..3 * quarter];
                                let (image, trust) = (values.image(n), weights.image(n));
                                let size = values.size();
                                reduce_gradient(
                                    size, image, trust, forward, gradient, into_image, into_trust,
                                );
                            });
                    });
                });
                Ok(())
            });
        }
        field
    }

    /// The product with a field of the same extent.
    ///
    /// # Panics
    /// If extents differ.
    pub fn product(self, other: Self) -> Self {
        assert_eq!(self.extent(), other.extent());
        let (a, b) = (self.saved, other.saved);
        let mut output = plane_buffer(a.values.as_slice().len());
        combine(&mut output, a.values.as_slice(), b.values.as_slice(), |out, a, b| *out = a * b);
        let (mut field, out) = Self::output(a.values.extent, output, self.tape.merge(other.tape));
        if T::OWNS_TAPE {
            field.tape.add_backward_op(move |_| {
                let Some(gradient) = out.take() else { return Ok(()) };
                for (into, other) in [(&a, &b), (&b, &a)] {
                    into.accumulate(|into| {
                        if let Some(into) = into {
                            combine(into, &gradient, other.values.as_slice(), |sum, g, b| *sum += g * b);
                        }
                    });
                }
                Ok(())
            });
        }
        field
    }

    /// Its channels and then those of another field of the same size:
    /// (N, C, H, W) and (N, D, H, W) -> (N, C + D, H, W)
    ///
    /// # Panics
    /// If sizes differ.
    pub fn beside(self, other: Self) -> Self {
        let ((images, c, h, w), (_, d, ..)) = (self.extent(), other.extent());
        assert_eq!(other.extent(), (images, d, h, w));
        let (a, b) = (self.saved, other.saved);
        let parts = (0..images).flat_map(|n| [a.values.image(n), b.values.image(n)]);
        let output = parts.collect::<Vec<_>>().concat().into();
        let (mut field, out) = Self::output((images, c + d, h, w), output, self.tape.merge(other.tape));
        if T::OWNS_TAPE {
            field.tape.add_backward_op(move |_| {
                let Some(gradient) = out.take() else { return Ok(()) };
                for (into, from) in [(&a, 0..c * h * w), (&b, c * h * w..(c + d) * h * w)] {
                    into.accumulate(|into| {
                        let images = gradient.chunks((c + d) * h * w).map(|image| &image[from.clone()]);
                        let into = into.into_iter().flatten();
                        into.zip(images.flatten()).for_each(|(sum, g)| *sum += g);
                    });
                }
                Ok(())
            });
        }
        field
    }

    /// Every channel, (N, C, H, W), plus the product of two fields (N, 1, H, W).
    ///
    /// # Panics
    /// If extents differ.
    pub fn plus_product(self, a: Self, b: Self) -> Self {
        let (images, channels, h, w) = self.extent();
        assert_eq!([a.extent(), b.extent()], [(images, 1, h, w); 2]);
        let tape = self.tape.merge(a.tape).merge(b.tape);
        let (sum, a, b) = (self.saved, a.saved, b.saved);
        let mut output = plane_buffer(sum.values.as_slice().len());
        let planes = output.chunks_mut(h * w).zip(sum.values.as_slice().chunks(h * w)).enumerate();
        planes.for_each(|(plane, (output, sum))| {
            let (a, b) = (a.values.image(plane / channels), b.values.image(plane / channels));
            combine(output, a, b, |out, a, b| *out = a * b);
            output.par_iter_mut().zip(sum).for_each(|(out, sum)| *out += sum);
        });
        let (mut field, out) = Self::output(sum.values.extent, output, tape);
        if T::OWNS_TAPE {
            field.tape.add_backward_op(move |_| {
                let Some(gradient) = out.take() else { return Ok(()) };
                sum.accumulate(|into| {
                    if let Some(into) = into {
                        into.par_iter_mut().zip(&gradient[..]).for_each(|(sum, g)| *sum += g);
                    }
                });
                for (into, other) in [(&a, &b), (&b, &a)] {
                    into.accumulate(|into| {
                        let Some(into) = into else { return };
                        for (plane, gradient) in gradient.chunks(h * w).enumerate() {
                            let image = plane / channels;
                            let into = &mut into[image * h * w..][..h * w];
                            combine(into, gradient, other.values.image(image), |sum, g, v| *sum += g * v);
                        }
                    });
                }
                Ok(())
            });
        }
        field
    }

    /// Every value times the gain of a logit in a field of the same extent. See [`crate::kernels::gain`].
    ///
    /// # Panics
    /// If extents differ.
    pub fn amplify(self, logits: Self) -> Self {
        assert_eq!(self.extent(), logits.extent());
        let tape = self.tape.merge(logits.tape);
        let (image, logits) = (self.saved, logits.saved);
        let mut output = plane_buffer(image.values.as_slice().len());
        amplify(image.values.as_slice(), logits.values.as_slice(), &mut output);
        let (mut field, out) = Self::output(image.values.extent, output, tape);
        if T::OWNS_TAPE {
            field.tape.add_backward_op(move |_| {
                let Some(gradient) = out.take() else { return Ok(()) };
                image.accumulate(|into_image| {
                    logits.accumulate(|into_logits| {
                        const LEARNED: &str = "what is amplified was filtered, its gain predicted";
                        let into = (into_image.expect(LEARNED), into_logits.expect(LEARNED));
                        amplify_gradient(
                            (image.values.as_slice(), logits.values.as_slice()),
                            &gradient,
                            into,
                        );
                    });
                });
                Ok(())
            });
        }
        field
    }

    /// Turns this field, an input of radiance over one albedo, (N, 3, H, W), into radiance over another, as
    /// far as `logits`, (N, 1, H, W), say. `ratio` is the logarithm of the first albedo over the second. See
    /// [`crate::kernels::redivide`].
    ///
    /// # Panics
    /// If extents differ.
    pub fn redivide(self, ratio: Self, logits: Self) -> Self {
        let (images, _, h, w) = self.extent();
        let tape = self.tape.merge(ratio.tape).merge(logits.tape);
        let (values, ratio, logits) = (self.saved.values, ratio.saved.values, logits.saved);
        let mut output = plane_buffer(images * 3 * h * w);
        for (n, output) in output.chunks_mut(3 * h * w).enumerate() {
            redivide(Size { h, w }, values.image(n), ratio.image(n), logits.values.image(n), output);
        }
        let (mut field, out) = Self::output((images, 3, h, w), output, tape);
        if T::OWNS_TAPE {
            field.tape.add_backward_op(move |_| {
                let Some(gradient) = out.take() else { return Ok(()) };
                logits.accumulate(|into| {
                    let into = into.expect("logits come from a layer");
                    into.par_chunks_mut(h * w).zip(gradient.par_chunks(3 * h * w)).enumerate().for_each(
                        |(n, (into, gradient))| {
                            let forward = (out.values.image(n), ratio.image(n), logits.values.image(n));
                            redivide_gradient(forward, gradient, into);
                        },
                    );
                });
                Ok(())
            });
        }
        field
    }

    /// Blends this level, (N, 3, H, W), with the coarse one below, (N, 3, H/2, W/2). `alpha`, (N, 1, H, W),
    /// is the share of the coarse level before the logistic, and `corners`, (N, 4, H, W), are the logits of
    /// its upsampling. See [`crate::kernels::blend`].
    ///
    /// # Panics
    /// If extents do not fit together.
    pub fn blend(self, coarse: Self, alpha: Self, corners: Self) -> Self {
        let (images, _, h, w) = self.extent();
        let (pixels, quarter) = (h * w, h * w / 4);
        let size = Size { h, w };
        let mut output = plane_buffer(images * 3 * pixels);
        let tape = self.tape.merge(coarse.tape).merge(alpha.tape).merge(corners.tape);
        let (fine, below, mask, corners) = (self.saved, coarse.saved, alpha.saved, corners.saved);
        let predicted = (mask.values.clone(), corners.values.clone());
        let place = Place { first: 0, total: h, coarse: 0 };
        for (n, output) in output.chunks_mut(3 * pixels).enumerate() {
            let levels = (fine.values.image(n), below.values.image(n));
            blend(size, place, levels, masks_of(&predicted, n), output);
        }
        let (mut field, out) = Self::output((images, 3, h, w), output, tape);
        if T::OWNS_TAPE {
            field.tape.add_backward_op(move |_| {
                let Some(gradient) = out.take() else { return Ok(()) };
                let levels = (&fine.values, &below.values);
                // A fine level that is the network's input has no gradient; what the kernel adds to it is
                // dropped.
                let mut nowhere = plane_buffer(0);
                let run = |fine: &mut [f32], coarse: &mut [f32], alpha: &mut [f32], corners: &mut [f32]| {
                    fine.par_chunks_mut(3 * pixels)
                        .zip(coarse.par_chunks_mut(3 * quarter))
                        .zip(alpha.par_chunks_mut(pixels))
                        .zip(corners.par_chunks_mut(CORNERS * pixels))
                        .enumerate()
                        .for_each(|(n, (((fine, coarse), alpha), corners))| {
                            let gradient = &gradient[n * 3 * pixels..][..3 * pixels];
                            let into = BlendGradient { fine, coarse, alpha, corners };
                            let masks = masks_of(&predicted, n);
                            let levels = (levels.0.image(n), levels.1.image(n));
                            blend_gradient(size, masks, levels, gradient, into);
                        });
                };
                const LEARNED: &str = "what is blended was filtered or predicted";
                fine.accumulate(|fine| {
                    let fine = fine.unwrap_or_else(|| {
                        nowhere = zeros(images * 3 * pixels);
                        &mut nowhere
                    });
                    below.accumulate(|below| {
                        mask.accumulate(|mask| {
                            corners.accumulate(|corners| {
                                run(
                                    fine,
                                    below.expect(LEARNED),
                                    mask.expect(LEARNED),
                                    corners.expect(LEARNED),
                                );
                            });
                        });
                    });
                });
                Ok(())
            });
        }
        field
    }

    /// The values as a dfdx tensor, (N, C, H, W), with the tape.
    pub fn into_images(self) -> Images<T> {
        let images: Images = Cpu::default().tensor_from_vec(self.values().to_vec(), self.saved.values.extent);
        let mut tape = self.tape;
        if T::OWNS_TAPE {
            let (of_tensor, saved) = (images.clone(), self.saved);
            tape.add_backward_op(move |gradients| {
                let values = std::mem::take(&mut **gradients.get_or_alloc_mut(&of_tensor)?);
                saved.accumulate(|into| {
                    let into = into.into_iter().flatten();
                    into.zip(&values).for_each(|(a, b)| *a += b);
                });
                Ok(())
            });
        }
        images.put_tape(tape)
    }
}

impl Field<NoneTape> {
    /// `count` channels of the one image that the field holds, from `first` on, which share its memory.
    /// (1, C, H, W) -> (1, count, H, W)
    ///
    /// # Panics
    /// If the field holds several images, or not as many channels.
    pub fn channels(&self, first: usize, count: usize) -> Self {
        let Values { extent: (n, c, h, w), ref data, first: begin } = self.saved.values;
        assert!(n == 1 && first + count <= c, "channels {first}..{} of {c}", first + count);
        let values = Values { extent: (1, count, h, w), data: data.clone(), first: begin + first * h * w };
        Self { saved: Saved { values, gradient: None }, tape: NoneTape }
    }

    /// [`Field::filter`] of some rows of several fields by the same kernels. Each field holds one image, and
    /// may hold more rows of it. `logits` are of the filtered rows from row `first` of theirs on, `confidence` of all rows
    /// that the fields hold. (1, 3, H, W) -> (1, 3, R, W)
    ///
    /// # Panics
    /// As [`Field::filter`], or if there are not as many rows.
    pub fn filter_rows<const N: usize>(
        fields: [&Self; N],
        rows: (usize, usize),
        (logits, first): (&Self, usize),
        confidence: &Self,
    ) -> [Self; N] {
        let (_, _, _, w) = confidence.extent();
        let (h, k) = (rows.1 - rows.0, logits.extent().1.isqrt());
        let values = |field: &Self| field.saved.values.clone();
        let problem = (values(fields[0]), values(logits), Some(values(confidence)));
        let (mut outputs, mut total) = (fields.map(|_| plane_buffer(3 * h * w)), plane_buffer(h * w));
        let filter = Filter { first, ..filter_of(&problem, 0, k, rows) };
        let into = outputs.each_mut().map(|output| &mut output[..]);
        filter.apply_to_all(Tier::detect(), fields.map(Self::values), into, &mut total);
        outputs.map(|output| Self::from_buffer((1, 3, h, w), output))
    }

    /// [`Field::blend`] of some rows of a taller image, whose masks begin at row `first` of `alpha` and `corners`.
    /// (1, 3, R, W) -> (1, 3, R, W)
    ///
    /// # Panics
    /// As [`Field::blend`], or if a coarse row next to a fine one is not there.
    pub fn blend_rows(
        &self,
        place: Place,
        coarse: &Self,
        (alpha, corners): (&Self, &Self),
        first: usize,
    ) -> Self {
        let (_, _, h, w) = self.extent();
        let mut output = plane_buffer(3 * h * w);
        let masks = Masks { alpha: alpha.values(), corners: corners.values(), first };
        blend(Size { h, w }, place, (self.values(), coarse.values()), masks, &mut output);
        Self::from_buffer((1, 3, h, w), output)
    }
}

/// Calls `put(out, a, b)` value by value.
fn combine(out: &mut [f32], a: &[f32], b: &[f32], put: impl Fn(&mut f32, f32, f32) + Sync) {
    out.par_chunks_mut(CHUNK).zip(a.par_chunks(CHUNK)).zip(b.par_chunks(CHUNK)).for_each(|((out, a), b)| {
        out.iter_mut().zip(a.iter().zip(b)).for_each(|(out, (a, b))| put(out, *a, *b));
    });
}

/// What was predicted for the blend of image `n`.
fn masks_of((alpha, corners): &(Values, Values), n: usize) -> Masks<'_> {
    Masks { alpha: alpha.image(n), corners: corners.image(n), first: 0 }
}

/// The filter of image `n`.
fn filter_of(
    (image, logits, confidence): &(Values, Values, Option<Values>),
    n: usize,
    k: usize,
    rows: (usize, usize),
) -> Filter<'_> {
    Filter {
        size: image.size(),
        rows,
        k,
        image: image.image(n),
        logits: logits.image(n),
        first: 0,
        confidence: confidence.as_ref().map(|c| c.image(n)),
    }
}
