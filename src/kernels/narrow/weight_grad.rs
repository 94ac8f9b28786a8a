//! Weight gradients in bfloat16: a matrix product whose inner dimension runs over pixels.
//!
//! The input is laid out channel by channel ([`Channels`]), so that a tap is a shift along the row. The
//! output gradient is laid out in interleaved pairs of positions ([`Pairs`]), and is zero on every border, so
//! that rows need not be told apart.

use half::bf16;
use rayon::prelude::*;

use super::{
    Block, CHUNK, Engine, Geometry, Grid, LANES, Pooled, Shape, Sums, View, WIDE, Wide, allocate,
    engine::Correlation, halves,
};
use crate::kernels::weight_grad::add_sums;

/// How many products of 32 positions are made for one tap before the next tap: so few that both factors stay
/// in the first-level cache over all taps.
const STEPS: usize = 8;

/// An activation, channel by channel.
#[derive(Debug)]
pub struct Channels {
    /// `[image][plane of 32][channel]`, each a row of `stride` values.
    data: Pooled<Wide>,
    stride: usize,
    shape: Shape,
}

impl Channels {
    /// Rounds and transposes an activation.
    pub fn new(engine: Engine, source: View) -> Self {
        let s = source.shape;
        let planes = s.c.div_ceil(WIDE);
        let grid = Grid::new(s, false);
        // An odd number of cache lines: rows of a tile then lie in different cache sets.
        let lines = (grid.positions() + grid.slack()).div_ceil(WIDE) | 1;
        let mut data = allocate(s.n * planes * WIDE * lines);
        data.par_chunks_mut(WIDE * lines).enumerate().for_each(|(i, out)| {
            let (low, high) = halves(source, i / planes, i % planes);
            let stride = lines * WIDE;
            let (lower, upper) = out.split_at_mut(LANES * lines);
            for (blocks, rows) in [(Some(low), lower), (high, upper)] {
                let Some(blocks) = blocks else {
                    rows.fill(Wide::ZERO);
                    continue;
                };
                let rows = rows.as_mut_ptr().cast::<bf16>();
                let covered = blocks.len().next_multiple_of(LANES);
                for (i, blocks) in blocks.chunks(LANES).enumerate() {
                    // SAFETY: a row holds all positions, rounded up to 16.
                    unsafe { engine.transpose(blocks, rows.add(i * LANES), stride) };
                }
                for channel in 0..LANES {
                    // SAFETY: the rest of the row; another user may have left NaN there.
                    unsafe { rows.add(channel * stride + covered).write_bytes(0, stride - covered) };
                }
            }
        });
        Self { data, stride: lines * WIDE, shape: s }
    }
}

/// An output gradient whose positions are interleaved two by two.
#[derive(Debug)]
pub struct Pairs {
    /// `[image][plane of 16][phase]`, each of `rows` pairs of positions. They begin at the first pixel of row
    /// 0, so that no tap reaches before the first position of the input.
    data: Pooled<Wide>,
    rows: usize,
    grid: Grid,
    shape: Shape,
    geometry: Geometry,
}

impl Pairs {
    /// Rounds and interleaves the output gradient of a convolution of `geometry`.
    ///
    /// # Panics
    /// If that is [`Geometry::Strided`].
    pub fn new(engine: Engine, gradient: View, geometry: Geometry) -> Self {
        assert!(geometry != Geometry::Strided, "the strided convolution has no weights of its own");
        let g = gradient.shape;
        let grid = Grid::new(g, geometry == Geometry::Transposed);
        let rows = (grid.h * grid.stride()).next_multiple_of(CHUNK) / 2;
        let mut data = allocate(g.n * g.planes() * grid.phases() * rows);
        let origin = grid.row(0);
        data.par_chunks_mut(rows).enumerate().for_each(|(i, out)| {
            let (phase, plane) = (i % grid.phases(), i / grid.phases());
            let blocks = &gradient.data[plane * g.plane_stride()..][..g.plane_stride()];
            if grid.split {
                out.fill(Wide::ZERO);
                grid.pixels(g, phase, |to, from| {
                    let to = to - origin;
                    for l in 0..LANES {
                        out[to / 2].set_bf16(2 * l + to % 2, bf16::from_f32(blocks[from].0[l]));
                    }
                });
            } else {
                let positions = grid.h * grid.stride();
                let (pairs, rest) = blocks[origin..][..positions].as_chunks::<2>();
                let (whole, tail) = out.split_at_mut(pairs.len());
                engine.interleave(pairs, whole);
                tail.fill(Wide::ZERO);
                if let Some(last) = rest.first() {
                    engine.interleave(&[[*last, Block::default()]], tail);
                }
            }
        });
        Self { data, rows, grid, shape: g, geometry }
    }
}

/// Adds the weight gradient of one source to `gradient`; see
/// [`crate::kernels::weight_grad::weight_gradient`].
///
/// # Panics
/// If sizes, borders or lengths do not fit together.
pub fn weight_gradient(
    engine: Engine,
    source: &Channels,
    output_gradient: &Pairs,
    (first, inputs): (usize, usize),
    gradient: &mut [f32],
) {
    let (s, g, grid) = (source.shape, output_gradient.shape, output_gradient.grid);
    let geometry = output_gradient.geometry;
    assert_eq!((g.n, (g.h, g.w)), (s.n, geometry.output(s.h, s.w)));
    assert_eq!(grid.pad, s.pad, "both factors need one border");
    assert!(grid.pad >= geometry.reach(), "border too small for {geometry:?}");
    let taps = geometry.taps();
    assert_eq!(gradient.len(), inputs * g.c * taps);

    // Where each tap finds the input, and the phase of the gradient it goes with.
    let signed = |v: usize| isize::try_from(v).expect("buffers fit in memory");
    let shifts: Vec<(isize, usize)> = (0..taps)
        .map(|t| match geometry {
            Geometry::Same(k) => {
                let (dy, dx) = (signed(t / k) - signed(k / 2), signed(t % k) - signed(k / 2));
                (dy * signed(grid.stride()) + dx, 0)
            }
            // out[2m + k - 1] += in[m] w[k]: the gradient at quad m + (k - 1) div 2, pixel (k - 1) mod 2.
            _ => {
                let (ky, kx) = (signed(t / 4) - 1, signed(t % 4) - 1);
                let shift = ky.div_euclid(2) * signed(grid.stride()) + kx.div_euclid(2);
                (-shift, (2 * ky.rem_euclid(2) + kx.rem_euclid(2)).unsigned_abs())
            }
        })
        .collect();
    let is_inside = |(shift, _): &(isize, usize)| {
        let first = signed(grid.row(0)) + shift;
        first >= 0 && first + signed(2 * output_gradient.rows) <= signed(source.stride)
    };
    assert!(shifts.iter().all(is_inside), "rows are too short for {geometry:?}");

    let (wide, groups) = (s.c.div_ceil(WIDE), g.planes().div_ceil(2));
    // Few planes leave too few tasks, so images become tasks as well, each with its own sum.
    let parts = if wide * groups >= 8 { 1 } else { s.n.min(8) };
    let task_sums = |task: usize| {
        let (part, pair) = (task / (wide * groups), task % (wide * groups));
        let (group, input) = (pair / wide, pair % wide);
        let outputs = (g.planes() - 2 * group).min(2);
        let mut sums: Vec<Sums> = shifts.iter().map(|_| Sums([[Block::default(); CHUNK]; 2])).collect();
        let phases = grid.phases() * output_gradient.rows;
        engine.ready(|| {
            for n in part * s.n / parts..(part + 1) * s.n / parts {
                let channels = (n * wide + input) * WIDE * source.stride;
                let pairs = (n * g.planes() + 2 * group) * phases;
                let steps = output_gradient.rows * 2 / CHUNK;
                for step in (0..steps).step_by(STEPS) {
                    let count = STEPS.min(steps - step);
                    for (&(shift, phase), sums) in shifts.iter().zip(&mut sums) {
                        let position = signed(grid.row(0) + step * CHUNK) + shift;
                        // SAFETY: borders and slack cover the shift, as was checked; `ready` was called.
                        unsafe {
                            let channels = source.data.as_ptr().cast::<bf16>().add(channels).offset(position);
                            let at = pairs + phase * output_gradient.rows + step * CHUNK / 2;
                            let pairs = output_gradient.data.as_ptr().add(at);
                            let stride = source.stride * size_of::<bf16>();
                            let correlation =
                                Correlation { steps: count, channels, stride, pairs, outputs, plane: phases };
                            engine.correlate(correlation, sums);
                        }
                    }
                }
            }
        });
        sums
    };
    let sums: Vec<Vec<Sums>> = (0..parts * wide * groups).into_par_iter().map(task_sums).collect();

    add_sums(gradient, geometry, g.c, (first, s.c, inputs), parts, |part, output, i, t| {
        let sums = &sums[(part * groups + output / 2) * wide + i / WIDE][t];
        &sums.0[output % 2][i % WIDE]
    });
}
