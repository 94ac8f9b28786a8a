//! The cross-bilateral filter on dfdx's tape: gradients reach its parameters, never its images.

use dfdx::{
    shapes::HasShape,
    tensor::{Cpu, PutTape, SplitTape, Tape, TensorFromVec},
};

use super::{Images, values_of};
use crate::kernels::{cross_bilateral::CrossBilateral, filter::Size, simd::Tier};

/// The images of a batch, to be filtered.
#[derive(Clone, Debug)]
pub struct GuidedImages {
    /// Pixels from the centre of the filter's square to its edge.
    pub radius: usize,
    /// Radiance, (N, 3, H, W).
    pub image: Vec<f32>,
    /// Its variance, summed over channels, (N, 1, H, W).
    pub noise: Vec<f32>,
    /// Features, group after group, (N, C, H, W).
    pub features: Vec<f32>,
    /// Channels of each group.
    pub groups: Vec<usize>,
}

impl GuidedImages {
    /// The filter of image `n`.
    fn filter<'a>(&'a self, size: Size, n: usize, precision: &'a [f32]) -> CrossBilateral<'a> {
        let pixels = size.pixels();
        let of = |values: &'a [f32], channels: usize| &values[n * channels * pixels..][..channels * pixels];
        CrossBilateral {
            size,
            radius: self.radius,
            image: of(&self.image, 3),
            noise: of(&self.noise, 1),
            features: of(&self.features, self.groups.iter().sum()),
            groups: &self.groups,
            precision: of(precision, 2 + self.groups.len()),
        }
    }
}

/// Filters the guides' images by precisions of position, colour and each group of features:
/// (N, 2 + groups, H, W) -> (N, 3, H, W). See [`CrossBilateral`].
///
/// # Panics
/// If sizes do not fit together.
pub fn cross_bilateral<T: Tape<f32, Cpu>>(guides: GuidedImages, precision: Images<T>) -> Images<T> {
    let (precision, mut tape) = precision.split_tape();
    let &(images, _, h, w) = precision.shape();
    let (size, tier) = (Size { h, w }, Tier::detect());
    let (mut output, mut total) = (vec![0.0; images * 3 * h * w], vec![0.0; images * h * w]);
    let values = values_of(&precision);
    for (n, (output, total)) in output.chunks_mut(3 * h * w).zip(total.chunks_mut(h * w)).enumerate() {
        guides.filter(size, n, &values).apply(tier, output, total);
    }
    let filtered: Images = Cpu::default().tensor_from_vec(output, (images, 3, h, w));
    if T::OWNS_TAPE {
        let out = filtered.clone();
        tape.add_backward_op(move |gradients| {
            let gradient = std::mem::take(&mut **gradients.get_or_alloc_mut(&out)?);
            let (output, values) = (values_of(&out), values_of(&precision));
            let into = gradients.get_or_alloc_mut(&precision)?;
            for (n, into) in into.chunks_mut(values.len() / images).enumerate() {
                let of = |values: &[f32], channels: usize| {
                    values[n * channels * h * w..][..channels * h * w].to_vec()
                };
                let forward = (&of(&output, 3)[..], &of(&total, 1)[..]);
                guides.filter(size, n, &values).gradient(tier, forward, &of(&gradient, 3), into);
            }
            Ok(())
        });
    }
    filtered.put_tape(tape)
}
