//! GFLOP/s of the kernels beside the FMA peak of this machine: `cargo bench --bench kernels`.
//! One FLOP is one item, so divan's "item/s" column is FLOP/s. `DEMC_TIER=avx2` benches that tier.

use demc::kernels::{
    Block, LANES, Shape, View, ViewMut,
    conv::{Epilogue, Geometry, convolve, packed_len},
    peak,
    simd::Tier,
    weight_grad::weight_gradient,
};
use divan::{Bencher, counter::ItemsCount};

fn main() {
    divan::main();
}

/// Layers of the base-16 dual encoder on 8 patches of 128x128, and full-resolution inference.
const LAYERS: [(usize, usize, usize, usize, usize); 6] = [
    // images, input channels, output channels, rows, columns
    (8, 16, 16, 128, 128),
    (8, 32, 32, 64, 64),
    (8, 64, 64, 32, 32),
    (8, 128, 128, 8, 8),
    (1, 16, 16, 736, 1280),
    (1, 64, 64, 184, 320),
];

fn blocks(len: usize) -> Vec<Block> {
    (0..len).map(|i| Block([(i % 7) as f32 * 0.1; LANES])).collect()
}

fn flops(n: usize, i: usize, o: usize, h: usize, w: usize, taps: usize) -> ItemsCount {
    ItemsCount::new(2 * n * i * o * h * w * taps)
}

fn forward(bencher: Bencher, (n, i, o, h, w): (usize, usize, usize, usize, usize), geometry: Geometry) {
    let tier = Tier::detect();
    let shape = Shape::new(n, i, h, w);
    let (oh, ow) = geometry.output(h, w);
    let out_shape = shape.with_channels(o).with_size(oh, ow);
    let x = blocks(shape.blocks());
    let weights = blocks(packed_len(&[i], o, geometry));
    let bias = blocks(o.div_ceil(LANES));
    let mut out = blocks(out_shape.blocks());
    let relu = Epilogue { relu: true, accumulate: false };
    bencher.counter(flops(n, i, o, h, w, geometry.taps())).bench_local(|| {
        let out = ViewMut::new(out_shape, &mut out);
        convolve(tier, &[View::new(shape, &x)], &weights, &bias, geometry, relu, out);
    });
}

#[divan::bench(args = LAYERS)]
fn conv3x3(bencher: Bencher, layer: (usize, usize, usize, usize, usize)) {
    forward(bencher, layer, Geometry::Same(3));
}

#[divan::bench(args = LAYERS)]
fn fusion1x1(bencher: Bencher, layer: (usize, usize, usize, usize, usize)) {
    forward(bencher, layer, Geometry::Same(1));
}

#[divan::bench(args = &LAYERS[..4])]
fn transposed4x4(bencher: Bencher, layer: (usize, usize, usize, usize, usize)) {
    forward(bencher, layer, Geometry::Transposed);
}

#[divan::bench(args = &LAYERS[..4])]
fn conv3x3_weight_gradient(bencher: Bencher, (n, i, o, h, w): (usize, usize, usize, usize, usize)) {
    let (shape, g_shape) = (Shape::new(n, i, h, w), Shape::new(n, o, h, w));
    let (x, g) = (blocks(shape.blocks()), blocks(g_shape.blocks()));
    let mut gradient = vec![0.0; i * o * 9];
    bencher.counter(flops(n, i, o, h, w, 9)).bench_local(|| {
        let (x, g) = (View::new(shape, &x), View::new(g_shape, &g));
        weight_gradient(Tier::detect(), x, g, Geometry::Same(3), (0, i), &mut gradient);
    });
}

/// Register-to-register FMAs on every thread: what the machine can do at best.
#[divan::bench]
fn fma_peak(bencher: Bencher) {
    const STEPS: usize = 1_000_000;
    let threads = rayon::current_num_threads();
    bencher.counter(ItemsCount::new(threads * peak::flops(STEPS))).bench_local(|| {
        // Unless its result is used and its length unknown, the compiler drops it.
        rayon::broadcast(|_| peak::run(Tier::detect(), divan::black_box(STEPS)))
    });
}
