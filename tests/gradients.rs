//! Every differentiable operation against central differences, in f64 sums of f32 forwards, and the
//! whole of each small network likewise.
//!
//! A loss `sum(r * output)` with fixed random `r` makes every output count. Its derivative along a
//! random direction of all inputs and parameters must equal `(L(+h) - L(-h)) / 2h`.

use std::collections::BTreeSet;

use demc::{
    features::LBF_CHANNELS,
    kernels::Shape,
    models::{
        self,
        network::{Batch, Config, Network, Taped},
    },
    nn::{Activation, BatchNorm, Conv, GuidedImages, Images, Init, MaxPool, Param, Stats, cross_bilateral},
    rng::Rng,
};
use dfdx::{
    shapes::HasShape,
    tensor::{Cpu, Gradients, NoneTape, TensorFromVec, Trace},
    tensor_ops::{Backward, SumTo},
};

fn random(rng: &mut Rng, len: usize) -> Vec<f32> {
    (0..len).map(|_| 2.0 * rng.uniform() - 1.0).collect()
}

fn images(values: Vec<f32>, shape: (usize, usize, usize, usize)) -> Images {
    Cpu::default().tensor_from_vec(values, shape)
}

/// The step along a unit direction: between the rounding of f32 and the curvature of the networks.
const H: f32 = 3e-3;

/// `sum(weights * output)` with weights that depend on the shape alone.
fn project(output: &[f32]) -> f64 {
    let weights = random(&mut Rng::new(99, 7), output.len());
    output.iter().zip(weights).map(|(o, w)| f64::from(*o) * f64::from(w)).sum()
}

fn projected(output: Images<Taped>) -> Gradients<f32, Cpu> {
    let shape = *output.shape();
    let weights = random(&mut Rng::new(99, 7), shape.0 * shape.1 * shape.2 * shape.3);
    (output * images(weights, shape)).sum::<dfdx::shapes::Rank0, _>().backward()
}

/// Compares derivatives along directions halfway between the gradient and a random one: a wrong
/// component shows in the first part, a missing one in the second, and the step stays short enough to
/// cross few kinks of a ReLU.
fn check(
    name: &str,
    values: &[Vec<f32>],
    gradients: &[Vec<f32>],
    h: f32,
    tolerance: f64,
    loss: impl Fn(&[Vec<f32>]) -> f64,
) {
    let norm = |v: &[Vec<f32>]| v.iter().flatten().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
    let gradient_norm = norm(gradients);
    assert!(gradient_norm > 0.0, "{name}: the gradient vanishes");
    for trial in 0..4 {
        let mut rng = Rng::new(1234, trial);
        let noise: Vec<Vec<f32>> = values.iter().map(|v| random(&mut rng, v.len())).collect();
        let noise_norm = norm(&noise);
        let mixed = |(g, n): (&Vec<f32>, &Vec<f32>)| -> Vec<f32> {
            let unit = |(g, n): (&f32, &f32)| *g / gradient_norm as f32 + *n / noise_norm as f32;
            g.iter().zip(n).map(unit).collect()
        };
        let direction: Vec<Vec<f32>> = gradients.iter().zip(&noise).map(mixed).collect();
        let moved = |sign: f32| -> Vec<Vec<f32>> {
            let step =
                |(v, d): (&Vec<f32>, &Vec<f32>)| v.iter().zip(d).map(|(v, d)| v + sign * h * d).collect();
            values.iter().zip(&direction).map(step).collect()
        };
        let numeric = (loss(&moved(1.0)) - loss(&moved(-1.0))) / (2.0 * f64::from(h));
        let dot = |(g, d): (&Vec<f32>, &Vec<f32>)| -> f64 {
            g.iter().zip(d).map(|(g, d)| f64::from(*g) * f64::from(*d)).sum()
        };
        let analytic: f64 = gradients.iter().zip(&direction).map(dot).sum();
        let error = (numeric - analytic).abs() / gradient_norm;
        assert!(error < tolerance, "{name}, direction {trial}: {analytic} by tape, {numeric} by differences");
    }
}

fn with(params: [&mut Param; 2], values: &[Vec<f32>]) {
    params.into_iter().zip(values).for_each(|(p, v)| p.set(v));
}

fn check_conv(name: &str, conv: Conv, channels: &[usize], h: usize, w: usize) {
    let mut rng = Rng::new(5, 0);
    let shapes: Vec<_> = channels.iter().map(|&c| (2, c, h, w)).collect();
    let mut values: Vec<Vec<f32>> = shapes.iter().map(|s| random(&mut rng, s.0 * s.1 * s.2 * s.3)).collect();
    let inputs: Vec<Images> = values.iter().zip(&shapes).map(|(v, s)| images(v.clone(), *s)).collect();
    let mut layer = conv.clone();
    let weights: Vec<f32> =
        layer.weight.values().iter().map(|w| w + 0.1 * (2.0 * rng.uniform() - 1.0)).collect();
    layer.weight.set(&weights);
    // Half the channels far above zero and half far below: no step reaches the kink of a ReLU.
    let bias: Vec<f32> =
        (0..layer.bias.values().len()).map(|c| if c % 2 == 0 { 6.0 } else { -6.0 }).collect();
    layer.bias.set(&bias);
    let traced = inputs.iter().map(|i| Activation::<Taped>::from_images(i.leaky_trace())).collect();
    let gradients = projected(layer.forward(traced).into_images());
    let mut expected: Vec<Vec<f32>> = inputs.iter().map(|i| gradients.get(i).as_vec()).collect();
    expected.push(gradients.get(&layer.weight.tensor).as_vec());
    expected.push(gradients.get(&layer.bias.tensor).as_vec());
    values.push(layer.weight.values());
    values.push(layer.bias.values());
    check(name, &values, &expected, H, 3e-3, |values| {
        let mut layer = layer.clone();
        with(layer.params(), &values[shapes.len()..]);
        let sources = values.iter().zip(&shapes);
        let sources = sources.map(|(v, s)| Activation::<NoneTape>::from_images(images(v.clone(), *s)));
        project(&layer.forward(sources.collect()).into_images().as_vec())
    });
}

#[test]
fn convolution_3x3() {
    let conv = Conv::new(&mut Rng::new(1, 1), "c", &[5], 18, 3, Init::Xavier);
    check_conv("3x3", conv.clone().linear(), &[5], 5, 7);
    check_conv("3x3 with ReLU", conv, &[5], 5, 7);
}

#[test]
fn fusion_1x1_of_several_sources() {
    let fuse = Conv::new(&mut Rng::new(1, 1), "f", &[17, 3, 16], 20, 1, Init::Identities);
    check_conv("1x1 fusion", fuse.linear(), &[17, 3, 16], 4, 6);
}

#[test]
fn transposed_convolution() {
    let conv = Conv::transposed(&mut Rng::new(1, 1), "t", 18, 7);
    check_conv("transposed", conv.clone().linear(), &[18], 3, 5);
    check_conv("transposed with ReLU", conv, &[18], 3, 5);
}

#[test]
fn max_pool() {
    let shape = (2, 3, 4, 6);
    // Distinct values, far enough apart that a step changes no maximum.
    let mut rng = Rng::new(3, 0);
    let mut values: Vec<f32> = (0..2 * 3 * 4 * 6).map(|i| i as f32 * 0.02).collect();
    for i in (1..values.len()).rev() {
        values.swap(i, rng.below(i + 1));
    }
    let input = images(values.clone(), shape);
    let output = MaxPool.forward(Activation::<Taped>::from_images(input.leaky_trace())).into_images();
    let gradient = projected(output).get(&input).as_vec();
    check("max-pool", &[values], &[gradient], H, 3e-3, |v| {
        let input = Activation::<NoneTape>::from_images(images(v[0].clone(), shape));
        project(&MaxPool.forward(input).into_images().as_vec())
    });
}

#[test]
fn batch_norm_in_training_and_in_inference() {
    for training in [true, false] {
        let stats = || if training { Stats::Batch(Vec::new()) } else { Stats::Running };
        let shape = (3, 18, 4, 5);
        let mut rng = Rng::new(3, 0);
        let values = random(&mut rng, 3 * 18 * 4 * 5);
        let mut norm = BatchNorm::new("n", 18);
        norm.scale.set(&random(&mut rng, 18));
        norm.shift.set(&random(&mut rng, 18));
        norm.mean.set(&random(&mut rng, 18));
        let input = images(values.clone(), shape);
        let traced = Activation::<Taped>::from_images(input.leaky_trace());
        let gradients = projected(norm.forward(traced, &mut stats()).into_images());
        let expected = [&input.clone()].map(|i| gradients.get(i).as_vec());
        let expected = [
            expected[0].clone(),
            gradients.get(&norm.scale.tensor).as_vec(),
            gradients.get(&norm.shift.tensor).as_vec(),
        ];
        let values = [values, norm.scale.values(), norm.shift.values()];
        check(&format!("batch norm, training {training}"), &values, &expected, H, 3e-3, |v| {
            let mut norm = norm.clone();
            norm.scale.set(&v[1]);
            norm.shift.set(&v[2]);
            let input = Activation::<NoneTape>::from_images(images(v[0].clone(), shape));
            project(&norm.forward(input, &mut stats()).into_images().as_vec())
        });
    }
}

#[test]
fn batch_norm_normalises_and_tracks_the_unbiased_variance() {
    let shape = (2, 1, 2, 2);
    let input = Activation::<NoneTape>::from_images(images((0..8).map(|v| v as f32).collect(), shape));
    let mut norm = BatchNorm::new("n", 1);
    let mut stats = Stats::Batch(Vec::new());
    let out = norm.forward(input, &mut stats).into_images().as_vec();
    // Mean 3.5, biased variance 5.25, unbiased 6.
    let want = |v: f32| ((v - 3.5) / (5.25f32 + 1e-5).sqrt()).max(0.0);
    out.iter().enumerate().for_each(|(i, o)| assert!((o - want(i as f32)).abs() < 1e-5));
    let Stats::Batch(seen) = stats else { panic!("training records") };
    norm.update(&seen[0]);
    assert!((norm.mean.values()[0] - 0.35).abs() < 1e-5);
    assert!((norm.variance.values()[0] - (0.9 + 0.6)).abs() < 1e-5);
}

/// A whole network: the derivative along a direction of all parameters, and along directions of each part's alone,
/// as a part that counts for little could lack its gradient and hardly change that of all.
fn check_network(name: &str, network: &mut dyn Network, batch: &Batch) {
    // Biases that begin at zero put ReLUs on their kink where inputs are black.
    let mut rng = Rng::new(8, 1);
    for param in network.params().into_iter().filter(|p| p.name.ends_with("bias")) {
        let moved: Vec<f32> = param.values().iter().map(|b| b + 0.1 * rng.uniform()).collect();
        param.set(&moved);
    }
    let mut gradients = projected(network.forward_taped(batch, &mut Stats::Batch(Vec::new())));
    let mut names = Vec::new();
    let (mut values, mut expected) = (Vec::new(), Vec::new());
    for param in network.params().into_iter().filter(|p| p.trainable) {
        names.push(param.name.clone());
        values.push(param.values());
        expected.push(gradients.get_or_alloc_mut(&param.tensor).expect("CPU").to_vec());
        assert!(
            expected[expected.len() - 1].iter().any(|g| *g != 0.0),
            "{name}: {} has no gradient",
            param.name
        );
    }
    // `encoder.feature` of `encoder.feature.0.1.weight`.
    let part =
        |name: &str| -> String { name.split(|c: char| c.is_ascii_digit()).next().unwrap_or(name).into() };
    let parts: BTreeSet<String> = names.iter().map(|name| part(name)).collect();
    let copy = std::cell::RefCell::new(network.duplicate());
    for chosen in [None].into_iter().chain(parts.iter().map(Some)) {
        let is_chosen = |at: &usize| chosen.is_none_or(|chosen| part(&names[*at]) == *chosen);
        let chosen_ones: Vec<usize> = (0..names.len()).filter(is_chosen).collect();
        let of =
            |all: &[Vec<f32>]| -> Vec<Vec<f32>> { chosen_ones.iter().map(|at| all[*at].clone()).collect() };
        let said = format!("{name}, {}", chosen.map_or("all", |part| part.trim_end_matches('.')));
        // A step of the same length in fewer parameters crosses more kinks of ReLUs and pools.
        let tolerance = if chosen.is_none() { 1e-2 } else { 0.1 };
        check(&said, &of(&values), &of(&expected), H, tolerance, |moved| {
            let mut copy = copy.borrow_mut();
            let mut all = values.clone();
            chosen_ones.iter().zip(moved).for_each(|(at, moved)| all[*at].clone_from(moved));
            copy.params().into_iter().filter(|p| p.trainable).zip(&all).for_each(|(p, v)| p.set(v));
            project(&copy.forward(batch, &mut Stats::Batch(Vec::new())).as_vec())
        });
    }
}

fn trainable(name: &str) -> Config {
    models::trainable().find(|(n, _)| *n == name).expect("it is trainable").1
}

#[test]
fn the_kernel_predicting_network() {
    // What denoises radiance ends in a refit, whose factors have no gradient: the same design as its
    // prefilter has none.
    let config = Config { widths: vec![4, 6, 8, 8], ..trainable("prefilter") };
    let mut network = models::build(&config, 3);
    let mut rng = Rng::new(17, 0);
    let mut plane = || (0..2 * 3 * 32 * 48).map(|_| 0.1 + rng.uniform()).collect();
    let batch: Batch = (0..4).map(|_| (Shape::new(2, 3, 32, 48), plane())).collect();
    check_network("pyramid", &mut *network, &batch);
}

#[test]
fn the_networks_of_the_paper() {
    for name in ["demc", "demc-nofusion", "semc"] {
        let mut config = trainable(name);
        config.widths = vec![4, 6, 8, 8, 8];
        let mut network = models::build(&config, 3);
        let mut rng = Rng::new(17, 0);
        let batch: Batch = [3, 12]
            .map(|c| (Shape::new(2, c, 64, 64), (0..2 * c * 64 * 64).map(|_| rng.uniform()).collect()))
            .into();
        check_network(name, &mut *network, &batch);
    }
}

#[test]
fn kpcn() {
    for (name, planes) in [("kpcn-combined", &[3, 3, 34][..]), ("kpcn", &[3, 3, 3, 3, 34, 34])] {
        let mut config = trainable(name);
        config.widths = vec![6];
        let mut network = models::build(&config, 3);
        let mut rng = Rng::new(17, 0);
        let mut plane = |c: usize| (0..2 * c * 12 * 15).map(|_| 0.1 + rng.uniform()).collect();
        let batch = planes.iter().map(|&c| (Shape::new(2, c, 12, 15), plane(c))).collect();
        check_network(name, &mut *network, &batch);
    }
}

#[test]
fn lbf() {
    let mut network = models::build(&trainable("lbf"), 3);
    let mut rng = Rng::new(17, 0);
    let mut plane = |c: usize| (0..2 * c * 14 * 23).map(|_| 0.1 + rng.uniform()).collect();
    let batch = [3, 1, 12, 6, LBF_CHANNELS].map(|c| (Shape::new(2, c, 14, 23), plane(c))).into();
    check_network("lbf", &mut *network, &batch);
}

#[test]
fn cross_bilateral_filter() {
    let (n, h, w) = (2, 6, 9);
    let mut rng = Rng::new(4, 0);
    let mut plane = |c: usize| -> Vec<f32> { (0..n * c * h * w).map(|_| 0.1 + rng.uniform()).collect() };
    let guides =
        GuidedImages { radius: 3, image: plane(3), noise: plane(1), features: plane(5), groups: vec![2, 3] };
    let values = plane(4);
    let precision = images(values.clone(), (n, 4, h, w));
    let filtered = cross_bilateral(guides.clone(), precision.leaky_trace());
    let gradient = projected(filtered).get(&precision).as_vec();
    check("cross-bilateral", &[values], &[gradient], H, 3e-3, |v| {
        let precision = images(v[0].clone(), (n, 4, h, w));
        project(&cross_bilateral(guides.clone(), precision).as_vec())
    });
}
