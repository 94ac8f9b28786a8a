//! Every tier of every kernel against the textbook sum in f64, on random shapes, odd sizes and remainders
//! included. The engines of narrow formats get values that these formats hold exactly, so they must be as
//! exact.

use std::{env, process::Command};

use demc::kernels::{
    Block, LANES, Shape, View, ViewMut,
    conv::{Direction, Epilogue, Geometry, convolve, pack, packed_len, weight_index},
    layout::{from_blocked, from_blocked_shuffled, to_blocked},
    narrow::{self, Engine, Format, Steps},
    pool::{max_pool, max_pool_gradient},
    simd::Tier,
    weight_grad::{bias_gradient, weight_gradient},
    winograd,
};
use proptest::prelude::*;

/// A reproducible stream of values in -1..1.
fn noise(seed: u64, len: usize) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    (0..len)
        .map(|_| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
        })
        .collect()
}

fn blocked(shape: Shape, values: &[f32]) -> Vec<Block> {
    let mut data = vec![Block::default(); shape.blocks()];
    to_blocked(values, 1, ViewMut::new(shape, &mut data));
    data
}

fn plain(shape: Shape, data: &[Block]) -> Vec<f32> {
    let mut out = vec![0.0; shape.n * shape.c * shape.h * shape.w];
    from_blocked(View::new(shape, data), &mut out);
    out
}

/// `out[n, o, y, x] += in[n, i, iy, ix] * w[o, i, t]` for every pair of pixels a tap connects.
fn connections(geometry: Geometry, input: Shape, outputs: usize, mut visit: impl FnMut(usize, usize, usize)) {
    let (oh, ow) = geometry.output(input.h, input.w);
    let k = if let Geometry::Same(k) = geometry { k } else { 4 };
    for n in 0..input.n {
        for o in 0..outputs {
            for i in 0..input.c {
                for t in 0..k * k {
                    for iy in 0..input.h as isize {
                        for ix in 0..input.w as isize {
                            let (ky, kx) = ((t / k) as isize, (t % k) as isize);
                            let r = (k / 2) as isize;
                            let (y, x) = match geometry {
                                Geometry::Same(_) => (iy - ky + r, ix - kx + r),
                                _ => (2 * iy + ky - 1, 2 * ix + kx - 1),
                            };
                            if y < 0 || x < 0 || y >= oh as isize || x >= ow as isize {
                                continue;
                            }
                            let out = ((n * outputs + o) * oh + y as usize) * ow + x as usize;
                            let inp = ((n * input.c + i) * input.h + iy as usize) * input.w + ix as usize;
                            visit(out, inp, weight_index(geometry, outputs, input.c, o, i, t));
                        }
                    }
                }
            }
        }
    }
}

fn assert_close(got: &[f32], want: &[f64], what: &str) {
    assert_eq!(got.len(), want.len());
    let scale = want.iter().fold(1e-3f64, |m, v| m.max(v.abs()));
    for (i, (g, w)) in got.iter().zip(want).enumerate() {
        assert!((f64::from(*g) - w).abs() <= 2e-5 * scale, "{what}: element {i}: {g} for {w}");
    }
}

/// How a layer is computed.
#[derive(Clone, Copy, Debug)]
enum Arithmetic {
    F32(Tier),
    /// As that, but 3x3 convolutions by cells of outputs.
    Winograd(Tier),
    Bf16(Engine),
}

impl Arithmetic {
    fn available() -> Vec<Self> {
        let tiers = Tier::available().into_iter().flat_map(|tier| [Self::F32(tier), Self::Winograd(tier)]);
        tiers.chain(Engine::available().into_iter().map(Self::Bf16)).collect()
    }

    fn convolve(
        self,
        sources: &[View],
        weights: (&[f32], &[usize], usize, Direction, usize),
        geometry: Geometry,
        bias: &[Block],
        epilogue: Epilogue,
        mut output: ViewMut,
    ) {
        let (weights, inputs, outputs, direction, source) = weights;
        let used = match (direction, geometry) {
            (Direction::Backward, Geometry::Transposed) => Geometry::Strided,
            _ => geometry,
        };
        match self {
            Self::F32(tier) | Self::Winograd(tier) => {
                let len = match direction {
                    Direction::Forward => packed_len(inputs, outputs, geometry),
                    Direction::Backward => packed_len(&[outputs], inputs[source], geometry),
                };
                let mut packed = vec![Block::default(); len];
                pack(weights, inputs, outputs, geometry, direction, source, &mut packed);
                if matches!(self, Self::Winograd(_)) && used == Geometry::Same(3) {
                    let planes = sources.iter().map(|s| s.shape().planes()).sum();
                    let weights = winograd::transform(tier, &packed, planes);
                    winograd::convolve(tier, sources, &weights, bias, epilogue, output);
                } else {
                    convolve(tier, sources, &packed, bias, used, epilogue, output);
                }
            }
            Self::Bf16(engine) => {
                let packed =
                    narrow::conv::Weights::pack(weights, inputs, outputs, geometry, direction, source);
                let operands: Vec<_> =
                    sources.iter().map(|s| narrow::Operand::narrow(engine, *s, used)).collect();
                let operands: Vec<_> = operands.iter().collect();
                if !epilogue.accumulate {
                    let shape = output.shape();
                    // What it writes in bfloat16 is what it writes in f32, rounded.
                    let mut rounded = narrow::Operand::new(shape, Format::Bf16);
                    let to = narrow::conv::Output::Narrow(&mut rounded);
                    narrow::conv::convolve(engine, &operands, &packed, bias, epilogue, to);
                    let to = narrow::conv::Output::F32(ViewMut::new(shape, output.data()));
                    narrow::conv::convolve(engine, &operands, &packed, bias, epilogue, to);
                    let mut widened = vec![Block::default(); shape.blocks()];
                    rounded.widen(ViewMut::new(shape, &mut widened));
                    for (rounded, full) in widened.iter().zip(output.data().iter()) {
                        for (rounded, full) in rounded.0.iter().zip(full.0) {
                            assert_eq!(*rounded, half::bf16::from_f32(full).to_f32());
                        }
                    }
                    // What it writes as planes is that, unpacked.
                    let factors = [1, 2].into_iter().filter(|f| shape.c.is_multiple_of(f * f));
                    for factor in factors.filter(|_| used != Geometry::Transposed) {
                        let mut unpacked = vec![0.0; shape.n * shape.c * shape.h * shape.w];
                        from_blocked_shuffled(View::new(shape, output.data()), 0, factor, &mut unpacked);
                        let mut planes = vec![f32::NAN; unpacked.len()];
                        let to = narrow::conv::Output::Planes { shape, factor, values: &mut planes };
                        narrow::conv::convolve(engine, &operands, &packed, bias, epilogue, to);
                        assert!(planes == unpacked, "{geometry:?} as planes, factor {factor}");
                    }
                } else {
                    let to = narrow::conv::Output::F32(output);
                    narrow::conv::convolve(engine, &operands, &packed, bias, epilogue, to);
                }
            }
        }
    }

    fn weight_gradient(self, x: View, g: View, geometry: Geometry, place: (usize, usize), dw: &mut [f32]) {
        match self {
            Self::F32(tier) | Self::Winograd(tier) => weight_gradient(tier, x, g, geometry, place, dw),
            Self::Bf16(engine) => {
                let channels = narrow::weight_grad::Channels::new(engine, x);
                let pairs = narrow::weight_grad::Pairs::new(engine, g, geometry);
                narrow::weight_grad::weight_gradient(engine, &channels, &pairs, place, dw);
            }
        }
    }
}

/// Forward, input gradient and weight gradient of one layer, computed in every way.
fn check_layer(geometry: Geometry, shape: Shape, split: usize, outputs: usize, seed: u64) {
    let sources = if split == 0 || split >= shape.c { vec![shape.c] } else { vec![split, shape.c - split] };
    let (oh, ow) = geometry.output(shape.h, shape.w);
    let out_shape = shape.with_channels(outputs).with_size(oh, ow);
    let noise = |seed, len| {
        noise(seed, len).into_iter().map(|v| half::bf16::from_f32(v).to_f32()).collect::<Vec<f32>>()
    };
    let x = noise(seed, shape.n * shape.c * shape.h * shape.w);
    let w = noise(seed + 1, shape.c * outputs * geometry.taps());
    let bias = noise(seed + 2, outputs);
    let g = noise(seed + 3, shape.n * outputs * oh * ow);

    let mut want: Vec<f64> = (0..g.len()).map(|i| f64::from(bias[i / (oh * ow) % outputs])).collect();
    let mut want_dx = vec![0.0f64; x.len()];
    let mut want_dw = vec![0.0f64; w.len()];
    connections(geometry, shape, outputs, |o, i, k| {
        want[o] += f64::from(x[i]) * f64::from(w[k]);
        want_dx[i] += f64::from(g[o]) * f64::from(w[k]);
        want_dw[k] += f64::from(g[o]) * f64::from(x[i]);
    });

    // Split the channels of x over the sources.
    let pixels = shape.h * shape.w;
    let mut first = 0;
    let parts: Vec<(Shape, Vec<Block>, usize)> = sources
        .iter()
        .map(|&c| {
            let values: Vec<f32> = (0..shape.n)
                .flat_map(|n| x[(n * shape.c + first) * pixels..][..c * pixels].to_vec())
                .collect();
            first += c;
            let s = shape.with_channels(c);
            (s, blocked(s, &values), first - c)
        })
        .collect();
    let views: Vec<View> = parts.iter().map(|(s, d, _)| View::new(*s, d)).collect();
    let forward = (&w[..], &sources[..], outputs, Direction::Forward, 0);
    let mut bias_blocks = vec![Block::default(); outputs.div_ceil(LANES)];
    for (i, b) in bias.iter().enumerate() {
        bias_blocks[i / LANES].0[i % LANES] = *b;
    }
    let g_blocks = blocked(out_shape, &g);
    let g_view = View::new(out_shape, &g_blocks);
    for tier in Arithmetic::available() {
        let mut out = vec![Block::default(); out_shape.blocks()];
        let what = format!("{tier:?} {geometry:?} {shape:?} -> {outputs}");
        let output = ViewMut::new(out_shape, &mut out);
        tier.convolve(&views, forward, geometry, &bias_blocks, Epilogue::default(), output);
        assert_close(&plain(out_shape, &out), &want, &format!("{what} forward"));
        let relu = Epilogue { relu: true, accumulate: false };
        tier.convolve(&views, forward, geometry, &bias_blocks, relu, ViewMut::new(out_shape, &mut out));
        let rectified: Vec<f64> = want.iter().map(|v| v.max(0.0)).collect();
        assert_close(&plain(out_shape, &out), &rectified, &format!("{what} relu"));

        let mut dw = vec![0.0; w.len()];
        for (index, (s, data, first)) in parts.iter().enumerate() {
            tier.weight_gradient(View::new(*s, data), g_view, geometry, (*first, shape.c), &mut dw);
            let mut dx = blocked(*s, &vec![0.5; s.n * s.c * pixels]);
            let backward = (&w[..], &sources[..], outputs, Direction::Backward, index);
            let add = Epilogue { relu: false, accumulate: true };
            tier.convolve(&[g_view], backward, geometry, &[], add, ViewMut::new(*s, &mut dx));
            let want: Vec<f64> = (0..shape.n)
                .flat_map(|n| want_dx[(n * shape.c + first) * pixels..][..s.c * pixels].to_vec())
                .map(|v| v + 0.5)
                .collect();
            assert_close(&plain(*s, &dx), &want, &format!("{what} input gradient {index}"));
        }
        assert_close(&dw, &want_dw, &format!("{what} weight gradient"));
    }
    let mut db = vec![0.0; outputs];
    bias_gradient(g_view, &mut db);
    let want_db: Vec<f64> = (0..outputs)
        .map(|o| (0..g.len()).filter(|i| i / (oh * ow) % outputs == o).map(|i| f64::from(g[i])).sum())
        .collect();
    assert_close(&db, &want_db, &format!("{geometry:?} {shape:?} bias gradient"));
}

#[test]
#[should_panic = "convolutions are 1x1, 3x3 or 5x5, not 4x4"]
fn kernels_have_a_centre() {
    Geometry::same(4);
}

fn geometry() -> impl Strategy<Value = Geometry> {
    prop_oneof![
        Just(Geometry::Same(1)),
        Just(Geometry::Same(3)),
        Just(Geometry::Same(5)),
        Just(Geometry::Transposed)
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, ..ProptestConfig::default() })]

    #[test]
    fn layers_match_the_textbook_sum_on_every_tier(
        geometry in geometry(),
        n in 1usize..3, c in 1usize..40, outputs in 1usize..50, h in 1usize..41, w in 1usize..56,
        split in 0usize..40, seed in any::<u64>(),
    ) {
        let shape = Shape { pad: 2, ..Shape::new(n, c, h, w) };
        check_layer(geometry, shape, split, outputs, seed);
    }

    #[test]
    fn pooling_takes_the_maximum_and_returns_its_gradient_once(
        n in 1usize..3, c in 1usize..20, h in 1usize..6, w in 1usize..10, seed in any::<u64>(),
    ) {
        let shape = Shape::new(n, c, 2 * h, 2 * w);
        let half = shape.with_size(h, w);
        // Few distinct values make ties.
        let x: Vec<f32> = noise(seed, n * c * 4 * h * w).iter().map(|v| (v * 2.0).round()).collect();
        let g = noise(seed + 1, n * c * h * w);
        let xb = blocked(shape, &x);
        let mut out = vec![Block::default(); half.blocks()];
        max_pool(View::new(shape, &xb), ViewMut::new(half, &mut out));
        let out = plain(half, &out);
        let mut dx = vec![Block::default(); shape.blocks()];
        let gb = blocked(half, &g);
        max_pool_gradient(View::new(shape, &xb), View::new(half, &gb), ViewMut::new(shape, &mut dx));
        let dx = plain(shape, &dx);
        for (o, (&v, &grad)) in out.iter().zip(&g).enumerate() {
            let (image, y, x0) = (o / (h * w), o / w % h, o % w);
            let at = [(0, 0), (0, 1), (1, 0), (1, 1)]
                .map(|(dy, dx)| (image * 2 * h + 2 * y + dy) * 2 * w + 2 * x0 + dx);
            let first = at.into_iter().find(|&i| x[i] == v).expect("the maximum is one of the four");
            prop_assert!(at.iter().all(|&i| x[i] <= v));
            for i in at {
                prop_assert_eq!(dx[i], if i == first { grad } else { 0.0 });
            }
        }
    }
}

/// A band has several rows, and positions that are computed together end between two columns of a border.
#[test]
fn chunks_end_inside_borders() {
    check_layer(Geometry::Same(5), Shape { pad: 2, ..Shape::new(1, 3, 61, 61) }, 0, 2, 7);
}

/// An activation whose border is too small for taps of 5x5.
fn with_a_border_of_one() -> (Shape, Vec<Block>) {
    let shape = Shape { pad: 1, ..Shape::new(1, 3, 4, 5) };
    (shape, blocked(shape, &[1.0; 60]))
}

#[test]
#[should_panic = "sources differ"]
fn sources_have_one_border() {
    let (shape, x) = with_a_border_of_one();
    let wide = Shape { pad: 2, ..shape };
    let y = vec![Block::default(); wide.blocks()];
    let sources = [View::new(wide, &y), View::new(shape, &x)];
    let weights = vec![Block::default(); packed_len(&[3, 3], 3, Geometry::Same(3))];
    let output = &mut vec![Block::default(); shape.blocks()];
    let bias = [Block::default()];
    convolve(
        Tier::detect(),
        &sources,
        &weights,
        &bias,
        Geometry::Same(3),
        Epilogue::default(),
        ViewMut::new(shape, output),
    );
}

#[test]
#[should_panic = "fits into memory"]
fn no_view_is_of_more_than_memory_holds() {
    View::new(Shape { n: 1, c: 16, h: usize::MAX - 1, w: 16, pad: 1 }, &[]);
}

#[test]
#[should_panic = "border too small"]
fn weight_gradients_need_a_border() {
    let (shape, x) = with_a_border_of_one();
    let x = View::new(shape, &x);
    weight_gradient(Tier::detect(), x, x, Geometry::Same(5), (0, 3), &mut [0.0; 9 * 25]);
}

#[test]
#[should_panic = "border too small"]
fn narrow_weight_gradients_need_a_border() {
    let (shape, x) = with_a_border_of_one();
    let x = View::new(shape, &x);
    Arithmetic::Bf16(Engine::detect()).weight_gradient(x, x, Geometry::Same(5), (0, 3), &mut [0.0; 9 * 25]);
}

#[test]
#[should_panic = "planes of all channels"]
fn planes_hold_all_channels() {
    let shape = Shape::new(1, 40, 4, 5);
    let engine = Engine::detect();
    let x = blocked(shape, &[1.0; 40 * 20]);
    let x = narrow::Operand::narrow(engine, View::new(shape, &x), Geometry::Same(1));
    let weights = [1.0; 40 * 40];
    let weights = narrow::conv::Weights::pack(&weights, &[40], 40, Geometry::Same(1), Direction::Forward, 0);
    let to = narrow::conv::Output::Planes { shape, factor: 1, values: &mut [0.0; 20] };
    let bias = [Block::default(); 3];
    narrow::conv::convolve(engine, &[&x], &weights, &bias, Epilogue::default(), to);
}

/// A layer in 8 bits whose factors are whole steps: exact, whatever the engine.
fn check_int8(engine: Engine, geometry: Geometry, shape: Shape, split: usize, outputs: usize, seed: u64) {
    // Only phases of one sum know a zero that is not the first step.
    let zero = if geometry == Geometry::Transposed { 0 } else { 100 };
    let steps = [Steps { step: 0.5, zero }, Steps { step: 0.125, zero: 0 }];
    let channels = if split == 0 || split >= shape.c { vec![shape.c] } else { vec![split, shape.c - split] };
    let sources: Vec<(usize, Steps)> = channels.iter().copied().zip(steps).collect();
    let steps_of = |i: usize| if i < channels[0] { steps[0] } else { steps[1] };
    let step_of = |i: usize| steps_of(i).step;
    let (oh, ow) = geometry.output(shape.h, shape.w);
    let out_shape = shape.with_channels(outputs).with_size(oh, ow);
    let area = shape.h * shape.w;
    let x: Vec<f32> = (noise(seed, shape.n * shape.c * area).iter().enumerate())
        .map(|(i, v)| {
            let Steps { step, zero } = steps_of(i / area % shape.c);
            ((v.abs() * 255.0).round() - f32::from(zero)) * step
        })
        .collect();
    // Each output's largest weight, or four channels together, are as many steps as the engine wants, so that
    // no other weight is rounded.
    let adds = engine.adds_in_16_bits(geometry);
    let (largest, others) = if adds { (124.0, 31.0) } else { (127.0, 127.0) };
    let mut w = vec![0.0f32; shape.c * outputs * geometry.taps()];
    let levels = noise(seed + 1, w.len());
    for o in 0..outputs {
        let scale = 2f32.powi(o as i32 % 5 - 6);
        let has_four = adds && o % 2 == 1 && channels[0] > 5;
        for i in 0..shape.c {
            for t in 0..geometry.taps() {
                let level = match (i, t) {
                    (0 | 1 | 4 | 5, 0) if has_four => -largest / 4.0,
                    (0, 0) => -largest,
                    (1 | 4 | 5, 0) if adds => 0.0,
                    _ => (levels[(o * shape.c + i) * geometry.taps() + t] * others).round(),
                };
                w[weight_index(geometry, outputs, shape.c, o, i, t)] = level * scale / step_of(i);
            }
        }
    }
    let bias: Vec<f32> = noise(seed + 2, outputs).iter().map(|v| 40.0 * v).collect();
    let mut want: Vec<f64> =
        (0..shape.n * outputs * oh * ow).map(|i| f64::from(bias[i / (oh * ow) % outputs])).collect();
    connections(geometry, shape, outputs, |o, i, k| want[o] += f64::from(x[i]) * f64::from(w[k]));

    let mut first = 0;
    let operands: Vec<narrow::Operand> = (sources.iter())
        .map(|&(c, steps)| {
            let part = shape.with_channels(c);
            let values: Vec<f32> =
                (0..shape.n).flat_map(|n| x[(n * shape.c + first) * area..][..c * area].to_vec()).collect();
            first += c;
            let operand = narrow::Operand::quantize(View::new(part, &blocked(part, &values)), steps);
            let mut widened = vec![Block::default(); part.blocks()];
            operand.widen(ViewMut::new(part, &mut widened));
            assert_eq!(plain(part, &widened), values, "whole steps are kept");
            operand
        })
        .collect();
    let operands: Vec<_> = operands.iter().collect();
    let packed = narrow::conv::Weights::quantize(engine, &w, &sources, outputs, geometry);
    let mut padded = bias.clone();
    padded.resize(outputs.next_multiple_of(LANES), 0.0);
    let bias: Vec<Block> = padded.as_chunks::<LANES>().0.iter().map(|c| Block(*c)).collect();
    let mut out = vec![Block::default(); out_shape.blocks()];
    let linear = Epilogue { relu: false, accumulate: false };
    let to = narrow::conv::Output::F32(ViewMut::new(out_shape, &mut out));
    narrow::conv::convolve(engine, &operands, &packed, &bias, linear, to);
    let full = plain(out_shape, &out);
    assert_close(&full, &want, "8 bits");

    // What it writes in 8 bits is the nearest step, at most half a step off, or the largest.
    let step = 2.0f32;
    let mut rounded = narrow::Operand::new(out_shape, Format::Int8(Steps { step, zero: 0 }));
    let relu = Epilogue { relu: true, accumulate: false };
    narrow::conv::convolve(
        engine,
        &operands,
        &packed,
        &bias,
        relu,
        narrow::conv::Output::Narrow(&mut rounded),
    );
    let mut widened = vec![Block::default(); out_shape.blocks()];
    rounded.widen(ViewMut::new(out_shape, &mut widened));
    for (rounded, full) in plain(out_shape, &widened).iter().zip(&full) {
        let want = full.clamp(0.0, 255.0 * step);
        assert!((rounded - want).abs() <= 0.5001 * step && rounded % step == 0.0, "{rounded} for {full}");
    }
}

proptest! {
    #[test]
    fn eight_bits_equal_the_textbook_sum(
        (n, c, outputs) in (1usize..3, 1usize..150, 1usize..70),
        (h, w) in (1usize..7, 1usize..80),
        split in 0usize..150,
        geometry in prop::sample::select(vec![Geometry::Same(1), Geometry::Same(3), Geometry::Transposed]),
        seed in any::<u64>(),
    ) {
        for engine in Engine::available() {
            check_int8(engine, geometry, Shape::new(n, c, h, w), split, outputs, seed % 1000);
        }
    }
}

#[test]
fn planes_of_few_rows_are_cut_into_pieces() {
    for geometry in [Geometry::Same(1), Geometry::Same(3), Geometry::Transposed] {
        check_layer(geometry, Shape::new(1, 40, 3, 150), 24, 36, 11);
        for engine in Engine::available() {
            check_int8(engine, geometry, Shape::new(1, 40, 3, 150), 24, 36, 12);
        }
    }
    check_layer(Geometry::Same(5), Shape { pad: 2, ..Shape::new(2, 40, 3, 150) }, 24, 36, 13);
}

/// The same once more on each tier: what rounds to 8 bits chooses the fastest itself.
#[test]
fn all_tiers_round_to_eight_bits() {
    for tier in Tier::available() {
        let mut tests = Command::new(env::current_exe().unwrap());
        tests.arg("eight_bits_equal").env("DEMC_TIER", format!("{tier:?}").to_lowercase());
        tests.env("PROPTEST_CASES", "32");
        let run = tests.output().unwrap();
        assert!(run.status.success(), "{tier:?}: {}", String::from_utf8_lossy(&run.stdout));
    }
}

/// Whatever the weights, the largest activations do not overflow any sum.
fn check_largest(engine: Engine, geometry: Geometry, (channels, outputs): (usize, usize), seed: u64) {
    let shape = Shape::new(1, channels, 2, 40);
    let x = vec![255.0; channels * shape.h * shape.w];
    let steps = Steps { step: 1.0, zero: 0 };
    let x = narrow::Operand::quantize(View::new(shape, &blocked(shape, &x)), steps);
    // Many channels of one sign, and a few that decide on the steps.
    let w: Vec<f32> =
        noise(seed, channels * outputs * geometry.taps()).iter().map(|v| v.abs().powi(3)).collect();
    let w: Vec<f32> = w.iter().zip(noise(seed + 1, w.len())).map(|(w, v)| w.copysign(v + 0.7)).collect();
    let weights = narrow::conv::Weights::quantize(engine, &w, &[(channels, steps)], outputs, geometry);
    let (oh, ow) = geometry.output(shape.h, shape.w);
    let out_shape = shape.with_channels(outputs).with_size(oh, ow);
    let bias = vec![Block::default(); out_shape.planes()];
    let of = |engine: Engine| {
        let mut out = vec![Block::default(); out_shape.blocks()];
        let to = narrow::conv::Output::F32(ViewMut::new(out_shape, &mut out));
        let linear = Epilogue { relu: false, accumulate: false };
        narrow::conv::convolve(engine, &[&x], &weights, &bias, linear, to);
        plain(out_shape, &out)
    };
    assert!(of(engine) == of(Engine::PORTABLE), "{engine:?}");
}

proptest! {
    #[test]
    fn eight_bits_do_not_overflow(
        size in (1usize..150, 1usize..40),
        geometry in prop::sample::select(vec![Geometry::Same(1), Geometry::Same(3), Geometry::Transposed]),
        seed in any::<u64>(),
    ) {
        for engine in Engine::available() {
            check_largest(engine, geometry, size, seed % 1000);
        }
    }
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let shape = Shape::new(3, 24, 12, 20);
    let x = blocked(shape, &noise(1, 3 * 24 * 12 * 20));
    let g = blocked(shape, &noise(2, 3 * 24 * 12 * 20));
    let run = |threads: usize| {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a small pool").install(|| {
            let mut dw = vec![0.0; 24 * 24 * 9];
            let geometry = Geometry::Same(3);
            weight_gradient(
                Tier::detect(),
                View::new(shape, &x),
                View::new(shape, &g),
                geometry,
                (0, 24),
                &mut dw,
            );
            dw
        })
    };
    assert_eq!(run(1), run(5));
}
