//! Every layer against JAX: outputs, and gradients with respect to inputs and parameters.
//!
//! `data/layers.safetensors` holds what `data/make_layers.py` computed in float64, so results may differ by
//! the rounding of f32 alone. Operations on planes are also compared with plain loops in f64, on rows that
//! are longer than a vector and with logits whose exponentials f32 cannot hold.

use std::{env, process::Command};

use demc::{
    kernels::{Shape, simd::Tier},
    models::network::Taped,
    nn::{Activation, BatchNorm, Conv, Field, Images, Init, MaxPool, Param, Stats},
    rng::Rng,
};
use dfdx::{
    shapes::{HasShape, Rank0},
    tensor::{Cpu, Gradients, NoneTape, TensorFromVec, Trace},
    tensor_ops::{Backward, SumTo},
};
use safetensors::SafeTensors;

/// How far a value may be off, relative to the largest magnitude in its array.
const TOLERANCE: f64 = 1e-5;

/// The arrays of one case.
struct Case {
    name: &'static str,
    file: SafeTensors<'static>,
}

impl Case {
    fn new(name: &'static str) -> Self {
        let file = SafeTensors::deserialize(include_bytes!("data/layers.safetensors")).unwrap();
        Self { name, file }
    }

    fn array(&self, key: &str) -> (Vec<usize>, Vec<f32>) {
        let name = format!("{}/{key}", self.name);
        let view = self.file.tensor(&name).unwrap_or_else(|e| panic!("{name}: {e}"));
        let values = view.data().chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap()));
        (view.shape().into(), values.collect())
    }

    fn values(&self, key: &str) -> Vec<f32> {
        self.array(key).1
    }

    fn has(&self, key: &str) -> bool {
        self.file.tensor(&format!("{}/{key}", self.name)).is_ok()
    }

    /// An argument as (N, C, H, W).
    fn images(&self, key: &str) -> Images {
        let (shape, values) = self.array(key);
        let [n, c, h, w] = shape[..] else { panic!("{}/{key} has shape {shape:?}", self.name) };
        Cpu::default().tensor_from_vec(values, (n, c, h, w))
    }

    #[track_caller]
    fn compare(&self, key: &str, got: &[f32]) {
        let want = self.values(key);
        assert_eq!(got.len(), want.len(), "{}/{key}", self.name);
        let largest = want.iter().fold(0.0, |m: f64, w| m.max(f64::from(w.abs())));
        assert!(largest > 0.01, "{}/{key} is as good as zero", self.name);
        for (i, (g, w)) in got.iter().zip(&want).enumerate() {
            let error = (f64::from(*g) - f64::from(*w)).abs() / largest;
            assert!(error <= TOLERANCE, "{}/{key}[{i}]: {g}, by JAX {w}: {error:.1e}", self.name);
        }
    }

    /// Compares the output with `y`; returns the gradients of `sum(r * output)`.
    #[track_caller]
    fn project(&self, output: Images<Taped>) -> Gradients<f32, Cpu> {
        let shape = self.array("y").0;
        let &(n, c, h, w) = output.shape();
        assert_eq!([n, c, h, w], shape[..], "{}", self.name);
        self.compare("y", &output.as_vec());
        (output * self.images("r")).sum::<Rank0, _>().backward()
    }

    #[track_caller]
    fn compare_image(&self, key: &str, gradients: &Gradients<f32, Cpu>, image: &Images) {
        self.compare(key, &gradients.get(image).as_vec());
    }

    #[track_caller]
    fn compare_param(&self, key: &str, gradients: &Gradients<f32, Cpu>, param: &Param) {
        self.compare(key, &gradients.get(&param.tensor).as_vec());
    }
}

fn traced(images: &Images) -> Activation<Taped> {
    Activation::from_images(images.leaky_trace())
}

/// A field whose gradient arrives at `images`.
fn traced_field(images: &Images) -> Field<Taped> {
    Field::from_activation(traced(images), 0, images.shape().1, 1)
}

/// Outputs and gradients of a convolution, on the tape and off it.
#[track_caller]
fn check_conv(name: &'static str, mut conv: Conv, sources: &[&str]) {
    let case = Case::new(name);
    conv.weight.set(&case.values("weight"));
    conv.bias.set(&case.values("bias"));
    assert_eq!(conv.weight.shape, case.array("weight").0, "{name}");
    let inputs: Vec<Images> = sources.iter().map(|s| case.images(s)).collect();
    let plain = inputs.iter().map(|i| Activation::<NoneTape>::from_images(i.clone())).collect();
    case.compare("y", &conv.forward(plain).into_images().as_vec());
    let gradients = case.project(conv.forward(inputs.iter().map(traced).collect()).into_images());
    for (source, input) in sources.iter().zip(&inputs) {
        case.compare_image(&format!("d_{source}"), &gradients, input);
    }
    case.compare_param("d_weight", &gradients, &conv.weight);
    case.compare_param("d_bias", &gradients, &conv.bias);
}

fn same(inputs: &[usize], outputs: usize, k: usize) -> Conv {
    Conv::new(&mut Rng::new(1, 1), "c", inputs, outputs, k, Init::Xavier)
}

#[test]
fn convolution_3x3() {
    check_conv("conv3x3", same(&[5], 18, 3).linear(), &["x0"]);
    check_conv("conv3x3_relu", same(&[5], 18, 3), &["x0"]);
}

#[test]
fn convolution_3x3_of_two_sources() {
    check_conv("conv3x3_of_two", same(&[17, 3], 4, 3).linear(), &["x0", "x1"]);
    check_conv("conv3x3_of_two_relu", same(&[17, 3], 4, 3), &["x0", "x1"]);
}

#[test]
fn fusion_1x1_of_three_sources() {
    check_conv("fusion", same(&[17, 3, 2], 17, 1).linear(), &["x0", "x1", "x2"]);
    check_conv("fusion_relu", same(&[17, 3, 2], 17, 1), &["x0", "x1", "x2"]);
}

#[test]
fn transposed_convolution() {
    let conv = Conv::transposed(&mut Rng::new(1, 1), "t", 18, 5);
    check_conv("transposed", conv.clone().linear(), &["x"]);
    check_conv("transposed_relu", conv, &["x"]);
}

/// One activation read twice: its gradient is the sum of what both readers send back.
#[test]
fn gradients_of_two_readers_add_up() {
    let case = Case::new("conv3x3");
    let mut conv = same(&[5], 18, 3).linear();
    conv.weight.set(&case.values("weight"));
    conv.bias.set(&case.values("bias"));
    let input = case.images("x0");
    let first = traced(&input);
    let second = first.fork();
    let output = conv.forward(vec![first]).into_images() + conv.forward(vec![second]).into_images();
    let gradients = (output * case.images("r")).sum::<Rank0, _>().backward();
    let half = |values: Vec<f32>| values.into_iter().map(|v| 0.5 * v).collect::<Vec<f32>>();
    case.compare("d_x0", &half(gradients.get(&input).as_vec()));
    case.compare("d_weight", &half(gradients.get(&conv.weight.tensor).as_vec()));
    case.compare("d_bias", &half(gradients.get(&conv.bias.tensor).as_vec()));
}

/// Layers that are not trained hand on gradients to those that are, and take none themselves.
#[test]
fn gradients_reach_trained_layers_alone() {
    let shape = Shape::new(1, 5, 6, 8);
    let values: Vec<f32> = (0..5 * 6 * 8).map(|v| (v % 13) as f32 / 13.0).collect();
    let gradients = |trained: [bool; 2]| {
        let mut layers = [same(&[5], 5, 3), same(&[5], 5, 3)];
        for (layer, trained) in layers.iter_mut().zip(trained) {
            layer.params().into_iter().for_each(|param| param.trainable = trained);
        }
        let pooled = MaxPool.forward(layers[0].forward(vec![Activation::<Taped>::input(shape, &values)]));
        let output = layers[1].forward(vec![pooled]).into_images();
        let mut gradients = output.sum::<Rank0, _>().backward();
        layers.map(|layer| gradients.get_or_alloc_mut(&layer.weight.tensor).unwrap().to_vec())
    };
    let both = gradients([true, true]);
    let none = vec![0.0; both[0].len()];
    assert!(both.iter().all(|gradient| *gradient != none));
    assert_eq!(gradients([false, true]), [none.clone(), both[1].clone()]);
    assert_eq!(gradients([true, false]), [both[0].clone(), none]);
}

/// What a layer gives is the same; where its ReLU gives nothing, a share of the gradient passes.
#[test]
fn a_leak_lets_a_share_of_the_gradient_pass() {
    let shape = Shape::new(1, 5, 6, 8);
    let values: Vec<f32> = (0..5 * 6 * 8).map(|v| (v % 13) as f32 / 13.0).collect();
    let run = |bias: f32, leak: f32| {
        let mut layer = same(&[5], 5, 3).with_bias(bias);
        layer.set_leak(leak);
        let output = layer.forward(vec![Activation::<Taped>::input(shape, &values)]).into_images();
        let given = output.as_vec();
        let mut gradients = output.sum::<Rank0, _>().backward();
        (given, gradients.get_or_alloc_mut(&layer.bias.tensor).unwrap().to_vec())
    };
    // So far below zero that nothing passes, and so far above that all does.
    let (open, closed) = (run(50.0, 0.0), run(-50.0, 0.0));
    assert!(closed.0.iter().chain(&closed.1).all(|v| *v == 0.0));
    assert_eq!(open.1, [48.0; 5]);
    assert_eq!(run(50.0, 0.25), open);
    assert_eq!(run(-50.0, 0.25), (closed.0, vec![12.0; 5]));
}

#[test]
fn max_pool() {
    let case = Case::new("max_pool");
    let input = case.images("x");
    let gradients = case.project(MaxPool.forward(traced(&input)).into_images());
    case.compare_image("d_x", &gradients, &input);
}

fn batch_norm(case: &Case) -> BatchNorm {
    let mut norm = BatchNorm::new("n", 18);
    norm.scale.set(&case.values("scale"));
    norm.shift.set(&case.values("shift"));
    norm
}

/// Of the batch's own moments, which depend on the input: its gradient says so.
#[test]
fn batch_norm_in_training() {
    let case = Case::new("batch_norm_training");
    let norm = batch_norm(&case);
    let input = case.images("x");
    let mut stats = Stats::Batch(Vec::new());
    let gradients = case.project(norm.forward(traced(&input), &mut stats).into_images());
    case.compare_image("d_x", &gradients, &input);
    case.compare_param("d_scale", &gradients, &norm.scale);
    case.compare_param("d_shift", &gradients, &norm.shift);
    let Stats::Batch(seen) = stats else { panic!("training records") };
    case.compare("mean", &seen[0].mean);
    case.compare("variance", &seen[0].variance);
}

#[test]
fn batch_norm_in_inference() {
    let case = Case::new("batch_norm_inference");
    let mut norm = batch_norm(&case);
    norm.mean.set(&case.values("mean"));
    norm.variance.set(&case.values("variance"));
    let input = case.images("x");
    let gradients = case.project(norm.forward(traced(&input), &mut Stats::Running).into_images());
    case.compare_image("d_x", &gradients, &input);
    case.compare_param("d_scale", &gradients, &norm.scale);
    case.compare_param("d_shift", &gradients, &norm.shift);
}

#[test]
fn filtering_by_predicted_kernels() {
    for name in [
        "filter3",
        "filter3_confidence",
        "filter5",
        "filter5_confidence",
        "filter5_wider_than_image",
        "filter5_wider_than_image_confidence",
    ] {
        let case = Case::new(name);
        let (image, logits) = (case.images("image"), case.images("logits"));
        let confidence = case.has("confidence").then(|| case.images("confidence"));
        let &(n, _, h, w) = logits.shape();
        // The radiance of the network's input takes no gradient; that of coarser levels does.
        for is_input in [false, true] {
            let field = match is_input {
                true => Field::input((n, 3, h, w), &image.as_vec()),
                false => traced_field(&image),
            };
            let trust = confidence.as_ref().map(traced_field);
            let output = field.filter(traced_field(&logits), trust);
            let gradients = case.project(output.into_images());
            case.compare_image("d_logits", &gradients, &logits);
            if let Some(confidence) = &confidence {
                case.compare_image("d_confidence", &gradients, confidence);
            }
            if !is_input {
                case.compare_image("d_image", &gradients, &image);
            }
        }
    }
}

#[test]
fn reducing_by_confidence() {
    let case = Case::new("reduce");
    let (image, confidence) = (case.images("image"), case.images("confidence"));
    for is_input in [false, true] {
        let field = match is_input {
            true => Field::input(*image.shape(), &image.as_vec()),
            false => traced_field(&image),
        };
        let gradients = case.project(field.reduce(traced_field(&confidence)).into_images());
        case.compare_image("d_confidence", &gradients, &confidence);
        if !is_input {
            case.compare_image("d_image", &gradients, &image);
        }
    }
}

#[test]
fn blending_a_coarse_level_into_a_fine_one() {
    for name in ["blend", "blend_smallest"] {
        let case = Case::new(name);
        let [fine, coarse, alpha] = ["fine", "coarse", "alpha"].map(|key| case.images(key));
        // Equal logits leave the fixture's bilinear weights.
        let (n, _, h, w) = *fine.shape();
        let corners: Images = Cpu::default().tensor_from_vec(vec![0.5; n * 4 * h * w], (n, 4, h, w));
        let [fine_field, coarse_field, alpha_field] = [&fine, &coarse, &alpha].map(traced_field);
        let output = fine_field.blend(coarse_field, alpha_field, traced_field(&corners));
        let gradients = case.project(output.into_images());
        case.compare_image("d_fine", &gradients, &fine);
        case.compare_image("d_coarse", &gradients, &coarse);
        case.compare_image("d_alpha", &gradients, &alpha);
    }
}

#[test]
fn amplifying_by_predicted_gains() {
    let case = Case::new("amplify");
    let [image, logits] = ["image", "logits"].map(|key| case.images(key));
    let [image_field, logits_field] = [&image, &logits].map(traced_field);
    let gradients = case.project(image_field.amplify(logits_field).into_images());
    case.compare_image("d_image", &gradients, &image);
    case.compare_image("d_logits", &gradients, &logits);
}

#[test]
fn adding_a_product_to_every_channel() {
    let case = Case::new("plus_product");
    let [sum, a, b] = ["sum", "a", "b"].map(|key| case.images(key));
    let fixed = Field::input(*a.shape(), &a.as_vec());
    let gradients = case.project(traced_field(&sum).plus_product(fixed, traced_field(&b)).into_images());
    case.compare_image("d_sum", &gradients, &sum);
    case.compare_image("d_b", &gradients, &b);
}

#[test]
fn dividing_by_another_albedo() {
    let case = Case::new("redivide");
    let logits = case.images("logits");
    let &(n, _, h, w) = logits.shape();
    let [image, ratio] = ["image", "ratio"].map(|key| Field::input((n, 3, h, w), &case.images(key).as_vec()));
    let gradients = case.project(image.redivide(ratio, traced_field(&logits)).into_images());
    case.compare_image("d_logits", &gradients, &logits);
}

/// The extent of a batch and its values, most of them in -2..2. Every `large`th of them is -150 or 150.
fn random(seed: u64, extent: (usize, usize, usize, usize), large: usize) -> Images {
    let (n, c, h, w) = extent;
    let mut rng = Rng::new(seed, 0);
    let value = |i: usize| {
        let value = 4.0 * rng.uniform() - 2.0;
        if i % large == large - 1 { value.signum() * 150.0 } else { value }
    };
    Cpu::default().tensor_from_vec((0..n * c * h * w).map(value).collect(), extent)
}

/// No value of [`random`] is large.
const NONE: usize = usize::MAX;

#[track_caller]
fn assert_near(got: &[f32], want: &[f64], what: &str) {
    assert_eq!(got.len(), want.len(), "{what}");
    let largest = want.iter().fold(0.0, |m: f64, w| m.max(w.abs()));
    assert!(largest > 0.01, "{what} is as good as zero");
    for (i, (g, w)) in got.iter().zip(want).enumerate() {
        assert!((f64::from(*g) - w).abs() <= TOLERANCE * largest, "{what}[{i}]: {g} for {w}");
    }
}

/// A layer's output against plain loops in f64, and its gradients with respect to all but the first `fixed`
/// arguments against central differences of theirs.
#[track_caller]
fn check_by_differences<const N: usize>(
    arguments: [Images; N],
    fixed: usize,
    layer: impl Fn(&[Images; N]) -> Field<Taped>,
    plain: impl Fn(&[Vec<f64>; N]) -> Vec<f64>,
) {
    const STEP: f64 = 1e-4;
    let mut values =
        arguments.each_ref().map(|a| a.as_vec().into_iter().map(f64::from).collect::<Vec<f64>>());
    let output = layer(&arguments).into_images();
    assert_near(&output.as_vec(), &plain(&values), "output");
    let r = random(99, *output.shape(), NONE);
    let weights = r.as_vec();
    let gradients = (output * r).sum::<Rank0, _>().backward();
    let loss = |values: &_| -> f64 {
        plain(values).iter().zip(&weights).map(|(output, r)| output * f64::from(*r)).sum()
    };
    for (argument, images) in arguments.iter().enumerate().skip(fixed) {
        let difference = |at: usize| {
            let value = values[argument][at];
            let [up, down] = [STEP, -STEP].map(|step| {
                values[argument][at] = value + step;
                loss(&values)
            });
            values[argument][at] = value;
            (up - down) / (2.0 * STEP)
        };
        let differences: Vec<f64> = (0..images.as_vec().len()).map(difference).collect();
        assert_near(&gradients.get(images).as_vec(), &differences, &format!("gradient {argument}"));
    }
}

/// `e^x`, flat beyond what the kernels tell apart.
fn limited_exp(x: f64) -> f64 {
    x.clamp(-40.0, 40.0).exp()
}

#[test]
fn blending_as_plain_loops_do() {
    let (n, h, w) = (2, 4, 22);
    let arguments = [
        random(1, (n, 3, h, w), NONE),
        random(2, (n, 3, h / 2, w / 2), NONE),
        random(3, (n, 1, h, w), 5),
        random(4, (n, 4, h, w), 3),
    ];
    let layer = |images: &[Images; 4]| {
        let [fine, coarse, alpha, corners] = images.each_ref().map(traced_field);
        fine.blend(coarse, alpha, corners)
    };
    check_by_differences(arguments, 0, layer, |[fine, coarse, alpha, corners]| {
        let near = |i: usize, len: usize| {
            (i / 2, if i.is_multiple_of(2) { (i / 2).saturating_sub(1) } else { (i / 2 + 1).min(len - 1) })
        };
        let mut output = Vec::new();
        for (image, c) in (0..n).flat_map(|image| (0..3).map(move |c| (image, c))) {
            for (y, x) in (0..h).flat_map(|y| (0..w).map(move |x| (y, x))) {
                let ((own_y, other_y), (own_x, other_x)) = (near(y, h / 2), near(x, w / 2));
                let places = [(own_y, own_x), (own_y, other_x), (other_y, own_x), (other_y, other_x)];
                let (mut sum, mut total) = (0.0, 0.0);
                for (i, ((cy, cx), bilinear)) in places.into_iter().zip([9.0, 3.0, 3.0, 1.0]).enumerate() {
                    let weight = bilinear * limited_exp(corners[((image * 4 + i) * h + y) * w + x]);
                    sum += weight * coarse[((image * 3 + c) * (h / 2) + cy) * (w / 2) + cx];
                    total += weight;
                }
                let share = 1.0 / (1.0 + limited_exp(-alpha[(image * h + y) * w + x]));
                let fine = fine[((image * 3 + c) * h + y) * w + x];
                output.push((1.0 - share) * fine + share * sum / total);
            }
        }
        output
    });
}

#[test]
fn reducing_as_plain_loops_do() {
    let (n, h, w) = (2, 4, 38);
    let arguments = [random(1, (n, 3, h, w), NONE), random(2, (n, 1, h, w), 3)];
    let layer = |[image, confidence]: &[Images; 2]| traced_field(image).reduce(traced_field(confidence));
    check_by_differences(arguments, 0, layer, |[image, confidence]| {
        let mut output = Vec::new();
        for plane in 0..n * 3 {
            for (y, x) in (0..h / 2).flat_map(|y| (0..w / 2).map(move |x| (y, x))) {
                let (mut sum, mut total) = (0.0, 0.0);
                for (y, x) in [(2 * y, 2 * x), (2 * y, 2 * x + 1), (2 * y + 1, 2 * x), (2 * y + 1, 2 * x + 1)]
                {
                    let weight = limited_exp(confidence[(plane / 3 * h + y) * w + x]);
                    sum += weight * image[(plane * h + y) * w + x];
                    total += weight;
                }
                output.push(sum / total);
            }
        }
        output
    });
}

#[test]
fn amplifying_as_plain_loops_do() {
    let extent = (2, 3, 3, 21);
    let arguments = [random(1, extent, NONE), random(2, extent, 7)];
    let layer = |[image, logits]: &[Images; 2]| traced_field(image).amplify(traced_field(logits));
    check_by_differences(arguments, 0, layer, |[image, logits]| {
        image.iter().zip(logits).map(|(value, logit)| value * (2.0 * (logit / 2.0).tanh()).exp()).collect()
    });
}

#[test]
fn redividing_as_plain_loops_do() {
    let (n, h, w) = (2, 3, 21);
    let arguments =
        [random(1, (n, 3, h, w), NONE), random(2, (n, 3, h, w), NONE), random(3, (n, 1, h, w), 7)];
    let layer = |[image, ratio, logits]: &[Images; 3]| {
        let [image, ratio] = [image, ratio].map(|images| Field::input(*images.shape(), &images.as_vec()));
        image.redivide(ratio, traced_field(logits))
    };
    check_by_differences(arguments, 2, layer, |[image, ratio, logits]| {
        let divided = |(i, value): (usize, &f64)| {
            let logit = logits[i / (3 * h * w) * h * w + i % (h * w)];
            value * (ratio[i] / (1.0 + limited_exp(-logit))).exp()
        };
        image.iter().enumerate().map(divided).collect()
    });
}

/// Channels of several blocks as planes, each its own and each four in a row a quad.
#[test]
fn channels_become_planes_as_plain_loops_do() {
    let (n, c, h, w) = (2, 37, 2, 19);
    for (first, channels, factor) in [(3, 30, 1), (4, 32, 2)] {
        let layer = |[x]: &[Images; 1]| Field::from_activation(traced(x), first, channels, factor);
        check_by_differences([random(1, (n, c, h, w), NONE)], 0, layer, |[x]| {
            let (planes, h2, w2) = (channels / (factor * factor), factor * h, factor * w);
            let value = |i: usize| {
                let (image, plane, y, x2) =
                    (i / (planes * h2 * w2), i / (h2 * w2) % planes, i / w2 % h2, i % w2);
                let channel = first + plane * factor * factor + y % factor * factor + x2 % factor;
                x[((image * c + channel) * h + y / factor) * w + x2 / factor]
            };
            (0..n * planes * h2 * w2).map(value).collect()
        });
    }
}

/// Channels that two fields read: their gradient is the sum of what both send back.
#[test]
fn gradients_of_two_fields_of_the_same_channels_add_up() {
    let (n, c, h, w) = (2, 20, 2, 19);
    let layer = |[x]: &[Images; 1]| {
        let (first, second) = (traced(x), traced(x));
        let again = first.fork();
        let product = Field::from_activation(first, 8, 8, 1).product(Field::from_activation(again, 12, 8, 1));
        product.product(Field::from_activation(second, 0, 8, 1))
    };
    check_by_differences([random(1, (n, c, h, w), NONE)], 0, layer, |[x]| {
        let at = |i: usize, first: usize| x[(i / (8 * h * w) * c + first) * h * w + i % (8 * h * w)];
        (0..n * 8 * h * w).map(|i| at(i, 8) * at(i, 12) * at(i, 0)).collect()
    });
}

/// The other tests once more on each tier: layers choose the fastest themselves.
#[test]
fn all_tiers_pass_these_tests() {
    for tier in Tier::available() {
        let mut tests = Command::new(env::current_exe().unwrap());
        tests.args(["--skip", "all_tiers"]).env("DEMC_TIER", format!("{tier:?}").to_lowercase());
        let run = tests.output().unwrap();
        assert!(run.status.success(), "{tier:?}: {}", String::from_utf8_lossy(&run.stdout));
    }
}

/// Channels 3..15 of 17 to planes of twice the size, and what they would be halved from.
#[test]
fn channels_to_pixels_and_back() {
    let case = Case::new("shuffle");
    let input = case.images("x");
    let gradients = case.project(Field::from_activation(traced(&input), 8, 12, 2).into_images());
    case.compare_image("d_x", &gradients, &input);

    let (shape, fine) = case.array("y");
    let shape = Shape::new(shape[0], shape[1], shape[2], shape[3]);
    let halved = Activation::<NoneTape>::input_halved(shape, &fine).into_images();
    let &(n, c, h, w) = input.shape();
    let middle = (0..n).flat_map(|n| input.as_vec()[(n * c + 8) * h * w..][..12 * h * w].to_vec());
    assert_eq!(halved.as_vec(), middle.collect::<Vec<f32>>());
}
