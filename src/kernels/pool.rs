//! Max-pooling, ReLU masks and batch-norm passes: the memory-bound operations.
//! Plain loops over 16 lanes, which the compiler vectorises; no `unsafe`.
#![deny(unsafe_code)]

use rayon::prelude::*;

use super::{Block, LANES, Shape, View, ViewMut};

/// Runs `work(image, plane, plane blocks)` over every plane of `data`.
fn planes(shape: Shape, data: &mut [Block], work: impl Fn(usize, usize, &mut [Block]) + Sync) {
    data.par_chunks_mut(shape.plane_stride())
        .enumerate()
        .for_each(|(i, plane)| work(i / shape.planes(), i % shape.planes(), plane));
}

/// Index of row `y`, column 0, inside its plane.
fn row_in_plane(shape: Shape, y: usize) -> usize {
    shape.row(0, 0, y)
}

/// All bits set if the condition holds, or none.
#[inline(always)]
fn mask(condition: bool) -> u32 {
    u32::from(condition).wrapping_neg()
}

/// 2x2 maximum, stride 2.
///
/// # Panics
/// If the output is not half the input.
pub fn max_pool(input: View, output: ViewMut) {
    let (s, o) = (input.shape, output.shape);
    assert_eq!((o.n, o.c, 2 * o.h, 2 * o.w), (s.n, s.c, s.h, s.w));
    planes(o, output.data, |n, plane, out| {
        for y in 0..o.h {
            let top = &input.data[s.row(n, plane, 2 * y)..][..s.w];
            let bottom = &input.data[s.row(n, plane, 2 * y + 1)..][..s.w];
            let out = &mut out[row_in_plane(o, y)..][..o.w];
            for (x, out) in out.iter_mut().enumerate() {
                for l in 0..LANES {
                    let a = top[2 * x].0[l].max(top[2 * x + 1].0[l]);
                    let b = bottom[2 * x].0[l].max(bottom[2 * x + 1].0[l]);
                    out.0[l] = a.max(b);
                }
            }
        }
    });
}

/// Adds the gradient of [`max_pool`]: all of it to the first maximum in reading order, so that ties
/// neither lose nor double it.
///
/// # Panics
/// If shapes do not fit together.
pub fn max_pool_gradient(input: View, output_gradient: View, input_gradient: ViewMut) {
    let (s, o) = (input.shape, output_gradient.shape);
    assert_eq!((o.n, o.c, 2 * o.h, 2 * o.w), (s.n, s.c, s.h, s.w));
    assert_eq!(input_gradient.shape, s);
    planes(s, input_gradient.data, |n, plane, gradient| {
        for y in 0..o.h {
            let top = &input.data[s.row(n, plane, 2 * y)..][..s.w];
            let bottom = &input.data[s.row(n, plane, 2 * y + 1)..][..s.w];
            let out = &output_gradient.data[o.row(n, plane, y)..][..o.w];
            let (g_top, g_bottom) = gradient[row_in_plane(s, 2 * y)..].split_at_mut(s.row_stride());
            for (x, out) in out.iter().enumerate() {
                let v = [top[2 * x].0, top[2 * x + 1].0, bottom[2 * x].0, bottom[2 * x + 1].0];
                let mut into = [g_top[2 * x].0, g_top[2 * x + 1].0, g_bottom[2 * x].0, g_bottom[2 * x + 1].0];
                let g = out.0;
                for l in 0..LANES {
                    let m = v[0][l].max(v[1][l]).max(v[2][l].max(v[3][l]));
                    let mut left = !0;
                    for i in 0..4 {
                        let here = mask(v[i][l] == m) & left;
                        into[i][l] += f32::from_bits(g[l].to_bits() & here);
                        left &= !here;
                    }
                }
                (g_top[2 * x].0, g_top[2 * x + 1].0) = (into[0], into[1]);
                (g_bottom[2 * x].0, g_bottom[2 * x + 1].0) = (into[2], into[3]);
            }
        }
    });
}

/// Multiplies the gradient by `leak` where the ReLU's output was zero; 0 is the derivative. Works on borders too, which
/// are zero anyway.
pub fn relu_mask(output: View, leak: f32, gradient: ViewMut) {
    assert_eq!(output.shape, gradient.shape);
    gradient.data.par_chunks_mut(4096).zip(output.data.par_chunks(4096)).for_each(|(g, o)| {
        for (g, o) in g.iter_mut().zip(o) {
            // Without copies and bit masks the compiler would work lane by lane.
            let (old, output) = (g.0, o.0);
            *g = Block(std::array::from_fn(|l| {
                let passes = mask(output[l] > 0.0);
                f32::from_bits((old[l].to_bits() & passes) | ((leak * old[l]).to_bits() & !passes))
            }));
        }
    });
}

/// `a += b`.
pub fn add(a: ViewMut, b: View) {
    assert_eq!(a.shape, b.shape);
    a.data.par_chunks_mut(4096).zip(b.data.par_chunks(4096)).for_each(|(a, b)| {
        for (a, b) in a.iter_mut().zip(b) {
            for l in 0..LANES {
                a.0[l] += b.0[l];
            }
        }
    });
}

/// Mean and biased variance of every channel over images and pixels.
pub fn channel_moments(input: View) -> Vec<(f64, f64)> {
    let s = input.shape;
    let count = (s.n * s.h * s.w) as f64;
    (0..s.planes())
        .into_par_iter()
        .flat_map_iter(|plane| {
            // Two passes: the variance around the mean loses nothing to cancellation.
            let reduce = |f: &dyn Fn(usize, f64) -> f64| {
                let mut total = [0.0f64; LANES];
                for n in 0..s.n {
                    for y in 0..s.h {
                        for block in &input.data[s.row(n, plane, y)..][..s.w] {
                            for l in 0..LANES {
                                total[l] += f(l, f64::from(block.0[l]));
                            }
                        }
                    }
                }
                total.map(|t| t / count)
            };
            let mean = reduce(&|_, v| v);
            let variance = reduce(&|l, v| (v - mean[l]).powi(2));
            (0..s.lanes(plane)).map(move |l| (mean[l], variance[l]))
        })
        .collect()
}

/// `output = max(0, scale[c] * input + shift[c])`.
pub fn scale_shift(input: View, scale: &[f32], shift: &[f32], output: ViewMut) {
    let s = input.shape;
    assert_eq!(output.shape, s);
    assert_eq!((scale.len(), shift.len()), (s.c, s.c));
    planes(s, output.data, |n, plane, out| {
        let (mut a, mut b) = ([0.0; LANES], [0.0; LANES]);
        let lanes = s.lanes(plane);
        a[..lanes].copy_from_slice(&scale[plane * LANES..][..lanes]);
        b[..lanes].copy_from_slice(&shift[plane * LANES..][..lanes]);
        for y in 0..s.h {
            let row = &input.data[s.row(n, plane, y)..][..s.w];
            for (out, v) in out[row_in_plane(s, y)..][..s.w].iter_mut().zip(row) {
                for l in 0..LANES {
                    out.0[l] = (a[l] * v.0[l] + b[l]).max(0.0);
                }
            }
        }
    });
}
