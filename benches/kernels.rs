//! GFLOP/s of the kernels beside the FMA peak of this machine: `cargo bench --bench kernels`. One FLOP is one
//! item, so divan's "item/s" column is FLOP/s. For convolutions by Winograd, the FLOPs of the same
//! convolution tap by tap are counted. `DEMC_TIER=avx2` benches that tier.

mod peak;

use demc::kernels::{
    Block, LANES, Shape, View, ViewMut,
    conv::{Direction, Epilogue, Geometry, convolve, packed_len},
    narrow::{
        Engine, Format, Operand, Steps,
        conv::{self, Output, Weights},
    },
    simd::Tier,
    weight_grad::weight_gradient,
    winograd,
};
use divan::{Bencher, counter::ItemsCount};

fn main() {
    // As in `demc`, this thread becomes one of rayon's. From any other thread, each kernel would have to wake
    // rayon's threads up first.
    rayon::ThreadPoolBuilder::new().use_current_thread().build_global().expect("nothing ran before");
    divan::main();
}

/// Images, input channels, output channels, rows, columns.
type Layer = (usize, usize, usize, usize, usize);

/// Layers of the base-16 dual encoder on 8 patches of 128x128, and full-resolution inference.
const LAYERS: [Layer; 6] = [
    (8, 16, 16, 128, 128),
    (8, 32, 32, 64, 64),
    (8, 64, 64, 32, 32),
    (8, 128, 128, 8, 8),
    (1, 16, 16, 736, 1280),
    (1, 64, 64, 184, 320),
];

/// Layers of `demc-s` and `demc-m` on a frame of 1280x720.
const SHIPPED: [Layer; 4] =
    [(1, 32, 32, 360, 640), (1, 96, 96, 360, 640), (1, 96, 96, 180, 320), (1, 112, 112, 45, 80)];

fn blocks(len: usize) -> Vec<Block> {
    (0..len).map(|i| Block([(i % 7) as f32 * 0.1; LANES])).collect()
}

/// FLOPs of a convolution that reads `h` x `w` pixels. A strided one makes a quarter as many pixels, each
/// with every tap.
fn flops((n, i, o, h, w): Layer, geometry: Geometry) -> ItemsCount {
    let pixels = if geometry == Geometry::Strided { h * w / 4 } else { h * w };
    ItemsCount::new(2 * n * i * o * pixels * geometry.taps())
}

fn convolution(bencher: Bencher, layer: Layer, geometry: Geometry, epilogue: Epilogue) {
    let (n, i, o, h, w) = layer;
    let tier = Tier::detect();
    let pad = if geometry == Geometry::Same(5) { 2 } else { 1 };
    let shape = Shape { pad, ..Shape::new(n, i, h, w) };
    let (oh, ow) = geometry.output(h, w);
    let out_shape = shape.with_channels(o).with_size(oh, ow);
    let x = blocks(shape.blocks());
    let weights = blocks(packed_len(&[i], o, geometry));
    let bias = blocks(o.div_ceil(LANES));
    let mut out = blocks(out_shape.blocks());
    bencher.counter(flops(layer, geometry)).bench_local(|| {
        let out = ViewMut::new(out_shape, &mut out);
        convolve(tier, &[View::new(shape, &x)], &weights, &bias, geometry, epilogue, out);
    });
}

fn forward(bencher: Bencher, layer: Layer, geometry: Geometry) {
    convolution(bencher, layer, geometry, Epilogue { relu: true, accumulate: false });
}

/// As `forward`, but between activations that stay in a narrow format.
fn forward_narrow(bencher: Bencher, layer: Layer, geometry: Geometry, format: Format) {
    let (n, i, o, h, w) = layer;
    let engine = Engine::detect();
    let shape = Shape::new(n, i, h, w);
    let (oh, ow) = geometry.output(h, w);
    let x = blocks(shape.blocks());
    let weights = vec![0.01; i * o * geometry.taps()];
    let (x, weights) = match format {
        Format::Bf16 => (
            Operand::narrow(engine, View::new(shape, &x), geometry),
            Weights::pack(&weights, &[i], o, geometry, Direction::Forward, 0),
        ),
        Format::Int8(steps) => (
            Operand::quantize(View::new(shape, &x), steps),
            Weights::quantize(engine, &weights, &[(i, steps)], o, geometry),
        ),
    };
    let bias = blocks(o.div_ceil(LANES));
    let mut out = Operand::new(shape.with_channels(o).with_size(oh, ow), format);
    let relu = Epilogue { relu: true, accumulate: false };
    bencher.counter(flops(layer, geometry)).bench_local(|| {
        conv::convolve(engine, &[&x], &weights, &bias, relu, Output::Narrow(&mut out));
    });
}

/// Eight bits of some step.
const INT8: Format = Format::Int8(Steps { step: 0.01, zero: 0 });

fn input_gradient_of(bencher: Bencher, (n, i, o, h, w): Layer, geometry: Geometry) {
    let (oh, ow) = geometry.output(h, w);
    let add = Epilogue { relu: false, accumulate: true };
    convolution(bencher, (n, o, i, oh, ow), geometry.backward(), add);
}

fn weight_gradient_of(bencher: Bencher, layer: Layer, geometry: Geometry) {
    let (n, i, o, h, w) = layer;
    let (oh, ow) = geometry.output(h, w);
    let (shape, g_shape) = (Shape::new(n, i, h, w), Shape::new(n, o, oh, ow));
    let (x, g) = (blocks(shape.blocks()), blocks(g_shape.blocks()));
    let mut gradient = vec![0.0; i * o * geometry.taps()];
    bencher.counter(flops(layer, geometry)).bench_local(|| {
        let (x, g) = (View::new(shape, &x), View::new(g_shape, &g));
        weight_gradient(Tier::detect(), x, g, geometry, (0, i), &mut gradient);
    });
}

#[divan::bench(args = LAYERS)]
fn conv3x3(bencher: Bencher, layer: Layer) {
    forward(bencher, layer, Geometry::Same(3));
}

/// As in training, weights are transformed in every run, because there they are new in every step.
#[divan::bench(args = LAYERS.into_iter().filter(|layer| winograd::serves(layer.4)))]
fn conv3x3_winograd(bencher: Bencher, layer: Layer) {
    let (n, i, o, h, w) = layer;
    let tier = Tier::detect();
    let (shape, out_shape) = (Shape::new(n, i, h, w), Shape::new(n, o, h, w));
    let (x, mut out) = (blocks(shape.blocks()), blocks(out_shape.blocks()));
    let weights = blocks(packed_len(&[i], o, Geometry::Same(3)));
    let bias = blocks(o.div_ceil(LANES));
    let relu = Epilogue { relu: true, accumulate: false };
    bencher.counter(flops(layer, Geometry::Same(3))).bench_local(|| {
        let weights = winograd::transform(tier, &weights, shape.planes());
        let out = ViewMut::new(out_shape, &mut out);
        winograd::convolve(tier, &[View::new(shape, &x)], &weights, &bias, relu, out);
    });
}

#[divan::bench(args = LAYERS)]
fn conv3x3_input_gradient(bencher: Bencher, layer: Layer) {
    input_gradient_of(bencher, layer, Geometry::Same(3));
}

#[divan::bench(args = LAYERS)]
fn conv3x3_weight_gradient(bencher: Bencher, layer: Layer) {
    weight_gradient_of(bencher, layer, Geometry::Same(3));
}

#[divan::bench(args = &LAYERS[..4])]
fn conv5x5(bencher: Bencher, layer: Layer) {
    forward(bencher, layer, Geometry::Same(5));
}

#[divan::bench(args = LAYERS)]
fn fusion1x1(bencher: Bencher, layer: Layer) {
    forward(bencher, layer, Geometry::Same(1));
}

#[divan::bench(args = &LAYERS[..4])]
fn transposed4x4(bencher: Bencher, layer: Layer) {
    forward(bencher, layer, Geometry::Transposed);
}

#[divan::bench(args = &LAYERS[..4])]
fn transposed4x4_input_gradient(bencher: Bencher, layer: Layer) {
    input_gradient_of(bencher, layer, Geometry::Transposed);
}

#[divan::bench(args = &LAYERS[..4])]
fn transposed4x4_weight_gradient(bencher: Bencher, layer: Layer) {
    weight_gradient_of(bencher, layer, Geometry::Transposed);
}

#[divan::bench(args = SHIPPED)]
fn bf16_conv3x3(bencher: Bencher, layer: Layer) {
    forward_narrow(bencher, layer, Geometry::Same(3), Format::Bf16);
}

#[divan::bench(args = SHIPPED)]
fn bf16_fusion1x1(bencher: Bencher, layer: Layer) {
    forward_narrow(bencher, layer, Geometry::Same(1), Format::Bf16);
}

#[divan::bench(args = SHIPPED)]
fn bf16_transposed4x4(bencher: Bencher, layer: Layer) {
    forward_narrow(bencher, layer, Geometry::Transposed, Format::Bf16);
}

#[divan::bench(args = SHIPPED)]
fn int8_conv3x3(bencher: Bencher, layer: Layer) {
    forward_narrow(bencher, layer, Geometry::Same(3), INT8);
}

#[divan::bench(args = SHIPPED)]
fn int8_fusion1x1(bencher: Bencher, layer: Layer) {
    forward_narrow(bencher, layer, Geometry::Same(1), INT8);
}

#[divan::bench(args = SHIPPED)]
fn int8_transposed4x4(bencher: Bencher, layer: Layer) {
    forward_narrow(bencher, layer, Geometry::Transposed, INT8);
}

/// Register-to-register FMAs on every thread: what the machine can do at best.
#[divan::bench]
fn fma_peak(bencher: Bencher) {
    const STEPS: usize = 1_000_000;
    let threads = rayon::current_num_threads();
    bencher.counter(ItemsCount::new(threads * peak::flops(STEPS))).bench_local(|| {
        // The compiler would drop a loop whose result is not used or whose length it knows.
        rayon::broadcast(|_| divan::black_box(peak::run(Tier::detect(), divan::black_box(STEPS))))
    });
}
