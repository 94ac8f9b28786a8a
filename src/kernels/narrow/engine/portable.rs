//! What an engine does, written as plain loops. They are the oracle of the other engines, which use them
//! wherever they have no instructions.

use std::num::Wrapping;

use half::bf16;

use super::{CELLS, Correlation, NINTH, Product};
use crate::kernels::{
    Block, LANES,
    conv::Geometry,
    narrow::{CHUNK, Sums, WIDE, WORD, Wide},
    winograd::{self, PATCH, POWERS, SIDE},
};

/// A way to multiply narrow matrices; the plain loops given here do what a backend has no instructions for. A
/// value proves that the processor has the backend's instructions, since only [`Backend::detect`] makes one.
pub trait Backend: Copy {
    /// Its name in the environment variable `DEMC_ENGINE`, in which capitals do not matter.
    const NAME: &str;

    /// The backend, if this processor has it.
    fn detect() -> Option<Self>;

    /// See [`super::Engine::prefers_bf16`].
    fn prefers_bf16(self) -> bool {
        false
    }

    /// See [`super::Engine::prefers_int8`].
    fn prefers_int8(self) -> bool {
        false
    }

    /// See [`super::Engine::prefers_winograd`].
    fn prefers_winograd(self, _: Geometry) -> bool {
        false
    }

    /// See [`super::Engine::adds_in_16_bits`].
    fn adds_in_16_bits(self, _: Geometry) -> bool {
        false
    }

    /// See [`super::Engine::ready`].
    fn ready<R>(self, work: impl FnOnce() -> R) -> R {
        work()
    }

    /// [`super::Engine::multiply`] in 8 bits.
    ///
    /// # Safety
    /// As for that function.
    unsafe fn multiply_int8(self, product: Product, sums: &mut Sums) {
        // SAFETY: the caller's promise.
        unsafe { multiply::<true>(product, sums) }
    }

    /// [`super::Engine::multiply`] in bfloat16.
    ///
    /// # Safety
    /// As for that function.
    unsafe fn multiply_bf16(self, product: Product, sums: &mut Sums) {
        // SAFETY: the caller's promise.
        unsafe { multiply::<false>(product, sums) }
    }

    /// See [`super::Engine::evaluate`].
    ///
    /// # Safety
    /// As for that function.
    unsafe fn evaluate(self, patch: [*const u8; PATCH], cells: usize, points: *mut u8, stride: usize) {
        for (cell, lane) in (0..cells).flat_map(|cell| (0..LANES).map(move |lane| (cell, lane))) {
            // SAFETY: the caller's promise.
            unsafe {
                let columns: [[Wrapping<i16>; PATCH]; PATCH] = std::array::from_fn(|x| {
                    let at = (SIDE * cell + x) * size_of::<Wide>() + lane;
                    winograd::evaluate(patch.map(|row| Wrapping(i16::from(*row.add(at)))))
                });
                for y in 0..PATCH {
                    let row = winograd::evaluate(columns.map(|column| column[y]));
                    for (x, value) in row.into_iter().enumerate() {
                        let at = ((PATCH * y + x) * stride + cell) * size_of::<Wide>() + 2 * lane;
                        points.add(at).cast::<i16>().write(value.0);
                    }
                }
            }
        }
    }

    /// [`super::Engine::multiply_points`] for one output plane.
    ///
    /// # Safety
    /// As for that function.
    unsafe fn multiply_points(
        self,
        groups: &[u8],
        points: *const Wide,
        weights: *const Wide,
        cells: usize,
        products: *mut Wide,
    ) {
        for cell in 0..cells {
            let mut sums = [0i32; LANES];
            for part in 0..groups.len() {
                // SAFETY: the caller's promise.
                let (x, w) = unsafe {
                    let w = std::slice::from_raw_parts(weights.add(part * LANES), LANES);
                    (&*points.add(part * CELLS + cell), w)
                };
                for (channel, l) in (0..WIDE).flat_map(|channel| (0..LANES).map(move |l| (channel, l))) {
                    let number = |wide: &Wide, i: usize| i32::from(wide.i16(i));
                    let product = number(x, channel) * number(&w[channel / 2], 2 * l + channel % 2);
                    sums[l] = sums[l].wrapping_add(product);
                }
            }
            // SAFETY: the caller's promise.
            unsafe { products.add(cell).cast::<[i32; LANES]>().write(sums) };
        }
    }

    /// See [`super::Engine::interpolate`].
    ///
    /// # Safety
    /// As for that function.
    unsafe fn interpolate(
        self,
        products: *const Wide,
        stride: usize,
        sums: &mut [Sums; SIDE],
        (output, column): (usize, usize),
    ) {
        for lane in 0..LANES {
            // SAFETY: the caller's promise.
            unsafe {
                let lines: [[Wrapping<i32>; SIDE]; PATCH] = std::array::from_fn(|x| {
                    winograd::interpolate(std::array::from_fn(|y| {
                        Wrapping(*products.add((PATCH * y + x) * stride).cast::<i32>().add(lane))
                    }))
                });
                for (y, sums) in sums.iter_mut().enumerate() {
                    let row = winograd::interpolate(lines.map(|line| line[y]));
                    for (x, value) in row.into_iter().enumerate() {
                        let value = value.0.wrapping_mul(NINTH.cast_signed()) >> (POWERS[y] + POWERS[x]);
                        sums.0[output][column + x].0[lane] = value as f32;
                    }
                }
            }
        }
    }

    /// See [`super::Engine::correlate`].
    ///
    /// # Safety
    /// As for that function.
    unsafe fn correlate(self, correlation: Correlation, sums: &mut Sums) {
        let Correlation { steps, channels, stride, pairs, outputs, plane } = correlation;
        for (o, sums) in sums.0[..outputs].iter_mut().enumerate() {
            for (channel, sum) in sums.iter_mut().enumerate() {
                for pair in 0..steps * CHUNK / 2 {
                    // SAFETY: the caller's promise.
                    let (x, g) = unsafe {
                        let row = channels.byte_add(channel * stride).add(2 * pair);
                        ([row.read_unaligned(), row.add(1).read_unaligned()], &*pairs.add(o * plane + pair))
                    };
                    for l in 0..LANES {
                        let g = [2 * l, 2 * l + 1].map(|i| g.bf16(i).to_f32());
                        sum.0[l] += x[0].to_f32() * g[0] + x[1].to_f32() * g[1];
                    }
                }
            }
        }
    }

    /// See [`super::Engine::narrow_spread`].
    ///
    /// # Safety
    /// As for that function; both halves are of one length.
    unsafe fn narrow_spread(self, low: &[Block], high: Option<&[Block]>, out: *mut Wide, step: usize) {
        for (i, low) in low.iter().enumerate() {
            let mut both = Wide::ZERO;
            for l in 0..LANES {
                both.set_bf16(l, bf16::from_f32(low.0[l]));
                both.set_bf16(LANES + l, high.map_or(bf16::ZERO, |h| bf16::from_f32(h[i].0[l])));
            }
            // SAFETY: the caller's promise.
            unsafe { out.add(i * step).write(both) };
        }
    }

    /// See [`super::Engine::interleave`].
    fn interleave(self, pairs: &[[Block; 2]], out: &mut [Wide]) {
        for (pair, out) in pairs.iter().zip(out) {
            for l in 0..LANES {
                out.set_bf16(2 * l, bf16::from_f32(pair[0].0[l]));
                out.set_bf16(2 * l + 1, bf16::from_f32(pair[1].0[l]));
            }
        }
    }

    /// See [`super::Engine::transpose`].
    ///
    /// # Safety
    /// As for that function.
    unsafe fn transpose(self, blocks: &[Block], rows: *mut bf16, stride: usize) {
        for c in 0..LANES {
            for i in 0..LANES {
                let value = blocks.get(i).map_or(bf16::ZERO, |b| bf16::from_f32(b.0[c]));
                // SAFETY: the caller's promise.
                unsafe { rows.add(c * stride + i).write(value) };
            }
        }
    }
}

/// Any processor.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Portable;

impl Backend for Portable {
    const NAME: &str = "Portable";

    fn detect() -> Option<Self> {
        Some(Self)
    }
}

/// # Safety
/// As [`super::Engine::multiply`].
unsafe fn multiply<const INT8: bool>(product: Product, sums: &mut Sums) {
    let Product { terms, position, weights, outputs, plane, .. } = product;
    for (o, sums) in sums.0[..outputs].iter_mut().enumerate() {
        for (p, sum) in sums.iter_mut().enumerate() {
            let (mut real, mut whole) = ([0.0f32; LANES], [0i32; LANES]);
            for term in terms {
                // SAFETY: the caller's promise.
                let (x, w) = unsafe {
                    let w = weights.byte_add(term.weights).add(o * plane);
                    (&*term.input.add(position + p), std::slice::from_raw_parts(w, LANES))
                };
                for (i, w) in w.iter().enumerate() {
                    for l in 0..LANES {
                        if INT8 {
                            let product = |c| {
                                let w = i8::from_ne_bytes([w.0[WORD * l + c]]);
                                i32::from(x.0[WORD * i + c]) * i32::from(w)
                            };
                            whole[l] += (0..WORD).map(product).sum::<i32>();
                        } else {
                            let product = |i, j| x.bf16(i).to_f32() * w.bf16(j).to_f32();
                            real[l] += product(2 * i, 2 * l) + product(2 * i + 1, 2 * l + 1);
                        }
                    }
                }
            }
            sum.0 = if INT8 { whole.map(|v| v as f32) } else { real };
        }
    }
}
