//! Max-pooling, ReLU masks, batch-norm passes and layout changes: the memory-bound operations.
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
                for l in 0..LANES {
                    let v =
                        [top[2 * x].0[l], top[2 * x + 1].0[l], bottom[2 * x].0[l], bottom[2 * x + 1].0[l]];
                    let m = v[0].max(v[1]).max(v[2].max(v[3]));
                    let g = out.0[l];
                    let (i0, i1, i2) = (v[0] == m, v[1] == m, v[2] == m);
                    g_top[2 * x].0[l] += if i0 { g } else { 0.0 };
                    g_top[2 * x + 1].0[l] += if !i0 && i1 { g } else { 0.0 };
                    g_bottom[2 * x].0[l] += if !i0 && !i1 && i2 { g } else { 0.0 };
                    g_bottom[2 * x + 1].0[l] += if !i0 && !i1 && !i2 { g } else { 0.0 };
                }
            }
        }
    });
}

/// Zeroes the gradient where the ReLU's output was zero. Works on borders too, which are zero anyway.
pub fn relu_mask(output: View, gradient: ViewMut) {
    assert_eq!(output.shape, gradient.shape);
    gradient.data.par_chunks_mut(4096).zip(output.data.par_chunks(4096)).for_each(|(g, o)| {
        for (g, o) in g.iter_mut().zip(o) {
            for l in 0..LANES {
                g.0[l] = if o.0[l] > 0.0 { g.0[l] } else { 0.0 };
            }
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

/// From `(N, C, H, W)` to blocks. The lanes beyond `C` become zero.
///
/// # Panics
/// If `input` does not hold the output's shape.
pub fn to_blocked(input: &[f32], output: ViewMut) {
    let o = output.shape;
    assert_eq!(input.len(), o.n * o.c * o.h * o.w);
    planes(o, output.data, |n, plane, out| {
        let lanes = o.lanes(plane);
        for y in 0..o.h {
            let out = &mut out[row_in_plane(o, y)..][..o.w];
            out.fill(Block::default());
            for l in 0..lanes {
                let row = &input[((n * o.c + plane * LANES + l) * o.h + y) * o.w..][..o.w];
                for (out, &v) in out.iter_mut().zip(row) {
                    out.0[l] = v;
                }
            }
        }
    });
}

/// From blocks to `(N, C, H, W)`.
///
/// # Panics
/// If `output` does not hold the input's shape.
pub fn from_blocked(input: View, output: &mut [f32]) {
    let s = input.shape;
    assert_eq!(output.len(), s.n * s.c * s.h * s.w);
    output.par_chunks_mut(s.h * s.w).enumerate().for_each(|(i, out)| {
        let (n, c) = (i / s.c, i % s.c);
        for (y, out) in out.chunks_mut(s.w).enumerate() {
            let row = &input.data[s.row(n, c / LANES, y)..][..s.w];
            for (out, block) in out.iter_mut().zip(row) {
                *out = block.0[c % LANES];
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

/// `output = max(0, scale[c] * input + shift[c])`, the maximum only with `relu`.
pub fn scale_shift(input: View, scale: &[f32], shift: &[f32], relu: bool, output: ViewMut) {
    let s = input.shape;
    assert_eq!(output.shape, s);
    assert_eq!((scale.len(), shift.len()), (s.c, s.c));
    planes(s, output.data, |n, plane, out| {
        let (mut a, mut b) = ([0.0; LANES], [0.0; LANES]);
        let lanes = s.lanes(plane);
        a[..lanes].copy_from_slice(&scale[plane * LANES..][..lanes]);
        b[..lanes].copy_from_slice(&shift[plane * LANES..][..lanes]);
        let floor = if relu { 0.0 } else { f32::NEG_INFINITY };
        for y in 0..s.h {
            let row = &input.data[s.row(n, plane, y)..][..s.w];
            for (out, v) in out[row_in_plane(s, y)..][..s.w].iter_mut().zip(row) {
                for l in 0..LANES {
                    out.0[l] = (a[l] * v.0[l] + b[l]).max(floor);
                }
            }
        }
    });
}

/// Splits channel `i`, sub-pixel `s` of a 2x2 square (or one pixel, for factor 1) into the layer channel
/// that holds it and the offsets inside the square.
fn shuffled(channel: usize, factor: usize) -> (usize, usize, usize) {
    let area = factor * factor;
    (channel / area, channel % area / factor, channel % factor)
}

/// Channels `first..` of `input` as planes: `factor`^2 consecutive channels are the pixels of a square
/// (space to depth, inverted). `output` is (N, C / factor^2, factor H, factor W).
///
/// # Panics
/// If `output` does not hold whole channels of the input.
pub fn from_blocked_shuffled(input: View, first: usize, factor: usize, output: &mut [f32]) {
    let s = input.shape;
    let area = factor * factor;
    let channels = output.len() / (s.n * s.h * s.w);
    assert_eq!(output.len(), s.n * (channels / area) * area * s.h * s.w);
    assert!(first + channels <= s.c);
    let (h, w) = (factor * s.h, factor * s.w);
    // One task for the planes whose channels begin in the same block: a row of blocks is read once and
    // serves them all.
    let mut tasks = Vec::new();
    let mut rest = output;
    for n in 0..s.n {
        let block = |p: usize| (first + p * area) / LANES;
        let mut p = 0;
        while p < channels / area {
            let end = (p..channels / area).find(|&q| block(q) != block(p)).unwrap_or(channels / area);
            let (mine, others) = rest.split_at_mut((end - p) * h * w);
            tasks.push((n, p * area..end * area, mine));
            rest = others;
            p = end;
        }
    }
    tasks.into_par_iter().for_each(|(n, channels, out)| {
        for y in 0..s.h {
            for c in channels.clone() {
                let (p, sy, sx) = shuffled(c - channels.start, factor);
                let (plane, lane) = ((first + c) / LANES, (first + c) % LANES);
                let row = &input.data[s.row(n, plane, y)..][..s.w];
                let out = &mut out[p * h * w + (factor * y + sy) * w..][..w];
                for (out, block) in out[sx..].iter_mut().step_by(factor).zip(row) {
                    *out = block.0[lane];
                }
            }
        }
    });
}

/// The inverse of [`from_blocked_shuffled`], which leaves every other channel as it is: also how a
/// half-resolution network reads a full-resolution image.
///
/// # Panics
/// As [`from_blocked_shuffled`].
pub fn to_blocked_shuffled(input: &[f32], first: usize, factor: usize, output: ViewMut) {
    let s = output.shape;
    let channels = input.len() / (s.n * s.h * s.w);
    let area = factor * factor;
    assert_eq!(input.len(), s.n * (channels / area) * area * s.h * s.w);
    assert!(first + channels <= s.c);
    let (h, w) = (factor * s.h, factor * s.w);
    planes(s, output.data, |n, plane, out| {
        let lanes = (plane * LANES).max(first)..((plane + 1) * LANES).min(first + channels);
        for y in 0..s.h {
            let out = &mut out[row_in_plane(s, y)..][..s.w];
            for layer_channel in lanes.clone() {
                let (p, sy, sx) = shuffled(layer_channel - first, factor);
                let source = &input[(n * (channels / area) + p) * h * w..][..h * w];
                let row = &source[(factor * y + sy) * w..][..w];
                for (out, v) in out.iter_mut().zip(row[sx..].iter().step_by(factor)) {
                    out.0[layer_channel % LANES] = *v;
                }
            }
        }
    });
}
