//! What the networks promise: the sizes of the paper's, the reach and the scaling of the built-in ones.

use demc::{
    features::{self, Inputs, Shading},
    models::{
        self,
        demc::{Demc, PAPER_WIDTHS, semc_widths},
        kpcn::PUBLISHED_WIDTH,
        network::{Architecture, Config, Network, stack},
        weights_file::{self, Facts},
    },
    nn::{Precision, Stats},
    passes::{Pass, PassSet},
    planes::Planes,
    rng::Rng,
};
use dfdx::{
    shapes::Rank0,
    tensor_ops::{Backward, SumTo},
};

fn parameters(network: &mut dyn Network) -> usize {
    network.params().iter().filter(|p| p.trainable).map(|p| p.values().len()).sum()
}

#[test]
fn the_paper_s_network_has_its_size_and_latent() {
    let mut network = Demc::new(Architecture::Demc, &PAPER_WIDTHS, 1);
    // W/32 x H/32 x 512, Section 3.2.
    assert_eq!(network.latent(128, 64), (512, 2, 4));
    // By hand: 3x3 convolutions have 9 i o + o parameters, transposed 16 i o + o, fusions 3 k k + k.
    let conv = |i: usize, o: usize| 9 * i * o + o;
    let fusion = conv(12, 64) + 2 * (conv(64, 64) + 2 * 64) + conv(64, 3);
    let mut encoder = 0;
    let mut from = 3;
    for width in PAPER_WIDTHS {
        encoder += conv(from, width) + 2 * conv(width, width);
        from = width;
    }
    let mut decoder = 0;
    let mut below = 512;
    for width in PAPER_WIDTHS.into_iter().rev() {
        decoder += 16 * below * width + width + 3 * width * width + width;
        below = width;
    }
    let output = 64 * 3 + 3;
    assert_eq!(parameters(&mut network), fusion + 2 * encoder + decoder + output);
}

#[test]
fn semc_has_as_many_parameters_as_demc() {
    for widths in [[16, 32, 64, 96, 96], [16, 32, 32, 48, 48], [8; 5], [5, 9, 20, 33, 40], PAPER_WIDTHS] {
        let wanted = demc::models::demc::parameters(Architecture::Demc, &widths);
        let semc = semc_widths(&widths);
        let got = demc::models::demc::parameters(Architecture::Semc, &semc);
        let off = got as f64 / wanted as f64 - 1.0;
        assert!(off.abs() < 0.01, "{widths:?}: {semc:?} has {got} parameters, not {wanted}");
        assert!(semc.iter().sum::<usize>() > widths.iter().sum(), "{semc:?} for {widths:?}");
    }
}

#[test]
fn parameters_are_those_of_the_networks() {
    for architecture in [Architecture::Demc, Architecture::DemcNofusion, Architecture::Semc] {
        let widths = [4, 7, 9, 12, 17];
        let mut network = Demc::new(architecture, &widths, 1);
        let counted = demc::models::demc::parameters(architecture, &widths);
        assert_eq!(parameters(&mut network), counted, "{architecture:?}");
    }
    let built = |name| parameters(&mut *models::build(&trainable(name), 1)) as f64;
    assert!((built("semc") / built("demc") - 1.0).abs() < 0.01);
}

fn random_passes(width: usize, height: usize, seed: u64) -> PassSet {
    let mut rng = Rng::new(seed, 0);
    let mut passes = PassSet::new("random.exr", "ViewLayer", width, height);
    for pass in [
        Pass::Combined,
        Pass::Normal,
        Pass::Position,
        Pass::DiffuseColor,
        Pass::GlossyColor,
        Pass::TransmissionColor,
        Pass::DenoisingNormal,
        Pass::DenoisingAlbedo,
        Pass::DenoisingDepth,
        Pass::DiffuseDirect,
        Pass::DiffuseIndirect,
        Pass::Emission,
    ] {
        let values = (0..pass.channels() * width * height).map(|_| rng.uniform()).collect();
        passes.insert(pass, Planes::from_vec(pass.channels(), width, height, values));
    }
    passes
}

#[test]
fn every_trained_parameter_has_a_gradient_and_ships_alive() {
    for (name, config) in models::trainable() {
        let mut network = models::build(&config, 1);
        let inputs = network.inputs(&random_passes(64, 64, 4)).expect("all passes are there");
        let output = network.forward_taped(&stack(&[inputs]), &mut Stats::Batch(Vec::new()));
        let mut gradients = output.square().sum::<Rank0, _>().backward();
        for param in network.params().into_iter().filter(|param| param.trainable) {
            let gradient = gradients.get_or_alloc_mut(&param.tensor).expect("the CPU allocates or aborts");
            assert!(gradient.iter().any(|g| *g != 0.0), "{name}: {} has no gradient", param.name);
        }
    }
    // A layer through whose ReLUs nothing passes is cut off for good, with all that leads to it.
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
    let folders =
        ["eval/rivals/weights", "src/models/weights"].map(|folder| root.join(folder).read_dir().unwrap());
    let files = folders.into_iter().flatten().map(|entry| entry.unwrap().path());
    let files: Vec<_> = files.filter(|path| path.extension().is_some_and(|e| e == "safetensors")).collect();
    assert!(files.len() >= 7, "{files:?}");
    for path in files {
        let ranges = weights_file::read(&path).unwrap().1.ranges;
        for (layer, range) in ranges {
            assert!(range > 0.0, "{}: {layer} gives nothing", path.display());
        }
    }
}

#[test]
fn every_network_takes_every_size_from_one_pixel_up() {
    for (name, config) in models::trainable() {
        let network = models::build(&config, 1);
        for (width, height) in [(1, 1), (3, 1), (1, 7), (33, 17)] {
            let image = network.infer(&random_passes(width, height, 4), None).expect("all passes are there");
            // A prefilter denoises albedo and normal.
            let channels = if name == "prefilter" { 6 } else { 3 };
            assert_eq!((image.channels, image.width, image.height), (channels, width, height), "{name}");
            assert_eq!(image.non_finite(), 0, "{name} at {width}x{height}");
        }
    }
}

#[test]
fn tiles_give_the_same_bits_as_the_whole_frame() {
    for name in ["demc", "kpcn", "kpcn-combined", "lbf"] {
        let mut config = models::trainable().find(|(n, _)| *n == name).expect("it is trainable").1;
        config.widths.fill(8);
        let network = models::build(&config, 1);
        let passes = random_passes(1300, 40, 11);
        let whole = network.infer(&passes, Some(4096)).expect("all passes are there");
        for tile in [100, 333] {
            assert!(2 * network.reach() + tile < 1300, "no tile sees the whole frame");
            assert!(
                network.infer(&passes, Some(tile)).expect("all passes are there") == whole,
                "{name}, {tile}"
            );
        }
        // Here some tiles see all of the frame, and others come after them.
        let small = random_passes(63, 65, 12);
        let whole = network.infer(&small, None).expect("all passes are there");
        for tile in [16, 40] {
            assert!(
                network.infer(&small, Some(tile)).expect("all passes are there") == whole,
                "{name}, {tile}"
            );
        }
    }
}

#[test]
fn bands_give_the_same_bits_as_the_whole_frame() {
    let widths = vec![40, 20, 33, 8];
    let prefilter = Config { widths: widths.clone(), ..trainable("prefilter") };
    let prefiltered = Config { prefilter: vec![9, 16, 8, 8], widths, ..trainable("demc-s") };
    // What a refit sees ends where the frame does, and not where a network's padding does.
    for (config, (width, height)) in [(prefilter, (70, 731)), (prefiltered, (80, 736))] {
        let passes = random_passes(width, height, 12);
        let mut network = models::build(&config, 3);
        for precision in [Precision::F32, Precision::Bf16, Precision::Int8] {
            for conv in network.convolutions() {
                conv.set_precision(precision);
                conv.range = Some(3.0);
            }
            if precision == Precision::Int8 {
                network.freeze(); // takes in ranges
            }
            // The network's own forward pass over all of the frame is what the plan must equal.
            let inputs = network.inputs(&passes).expect("all passes are there").padded(network.multiple());
            let (w, h) = (inputs.planes[0].width, inputs.planes[0].height);
            let whole = network.forward(&stack(std::slice::from_ref(&inputs)), &mut Stats::Running).as_vec();
            let channels = whole.len() / (w * h);
            let mut whole = Planes::from_vec(channels, w, h, whole).window((0, 0), (width, height));
            whole.data.iter_mut().for_each(|v| *v *= inputs.scale);
            network.freeze();
            for rows in [Some(1), Some(48), Some(300), None] {
                let image = network.infer(&passes, rows).expect("all passes are there");
                assert!(image == whole, "bands of {rows:?} rows, {precision:?}, {config}");
            }
        }
    }
}

#[test]
fn a_prefilter_does_what_its_network_does_alone() {
    let own = Config { widths: vec![9, 16, 8, 8], ..trainable("prefilter") };
    let config = Config { widths: vec![8, 20, 8, 8], prefilter: own.widths.clone(), ..trainable("demc-s") };
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let mut alone = models::build(&own, 5);
    weights_file::write(&path("guides.safetensors"), &mut *alone, &facts()).unwrap();
    assert_eq!(weights_file::prefilter_widths(&path("guides.safetensors")).unwrap(), own.widths);
    let mut network = models::build(&config, 6);
    let set = |network: &mut dyn Network, file: &str| {
        weights_file::set_prefilter(network, &std::fs::read(path(file)).unwrap(), &path(file))
    };
    set(&mut *network, "guides.safetensors").unwrap();
    assert!(network.params().iter().all(|p| p.trainable != p.name.starts_with("prefilter.")));

    let passes = random_passes(50, 90, 4);
    let guides = alone.infer(&passes, None).unwrap();
    let (light, direction) = guides.data.split_at(guides.data.len() / 2);
    let [light, direction] =
        [light, direction].map(|half| Planes::from_vec(3, passes.width, passes.height, half.to_vec()));
    let (clean, straight) = (features::albedo_of_target(light), features::normal_of_target(direction));
    assert_ne!(Some(&clean), passes.get(Pass::DenoisingAlbedo));
    assert_ne!(Some(&straight), passes.get(Pass::DenoisingNormal));
    assert!(clean.data.iter().all(|a| (0.0..=1.0).contains(a)));
    let Inputs { planes, scale } = network.inputs(&passes).unwrap();
    let [irradiance, albedo, _, _, ratio, shading, normal] = &planes[..] else {
        panic!("{} inputs", planes.len())
    };
    let fit = Shading::of(&passes, scale.recip()).unwrap();
    assert_eq!(*shading, fit.rows(&passes, 0..passes.height).unwrap());
    // The file holds halves of what the network alone holds.
    for (a, b) in albedo.data.iter().zip(&clean.data) {
        assert!((a - (b + 0.05)).abs() <= 2e-3, "{a} of {b}");
    }
    for (a, b) in normal.data.iter().zip(&straight.data) {
        assert!((a - b).abs() <= 1e-2, "{a} of {b}");
    }
    // What is divided by the clean albedo, and what that would be divided by the noisy one.
    let [radiance, noisy] =
        [Pass::Combined, Pass::DenoisingAlbedo].map(|pass| &passes.get(pass).unwrap().data);
    for (i, (ratio, albedo)) in ratio.data.iter().zip(&albedo.data).enumerate() {
        let light = radiance[i] / scale;
        assert!((irradiance.data[i] * albedo - light).abs() <= 1e-5 * light);
        let other = noisy[i].clamp(0.0, 1.0) + 0.05;
        assert!((irradiance.data[i] * ratio.exp() * other - light).abs() <= 1e-5 * light);
    }
    weights_file::write(&path("whole.safetensors"), &mut *network, &facts()).unwrap();

    // The prefilter of a whole network serves others; one of other widths does not.
    let mut other = models::build(&config, 7);
    set(&mut *other, "whole.safetensors").unwrap();
    for (a, b) in other.params().iter().zip(network.params()).filter(|(a, _)| !a.trainable) {
        assert!(a.values().iter().zip(b.values()).all(|(a, b)| (a - b).abs() < 1e-3), "{}", a.name);
    }
    let mut wider = models::build(&Config { prefilter: vec![9, 16, 8, 16], ..config }, 7);
    let error = set(&mut *wider, "guides.safetensors").unwrap_err().to_string();
    assert!(error.contains("guides.safetensors") && error.contains("of shape"), "{error}");
}

#[test]
fn folding_batch_norms_changes_nothing_but_rounding() {
    let mut network = models::build(&Config { widths: vec![12, 9, 8, 8, 8], ..trainable("demc") }, 3);
    let mut rng = Rng::new(2, 2);
    for norm in network.batch_norms() {
        for (param, (low, high)) in
            norm.params().into_iter().zip([(0.5, 2.0), (-0.5, 0.5), (-0.5, 0.5), (0.1, 2.0)])
        {
            let values: Vec<f32> =
                param.values().iter().map(|_| low + (high - low) * rng.uniform()).collect();
            param.set(&values);
        }
    }
    let passes = random_passes(64, 40, 5);
    let plain = network.infer(&passes, None).expect("all passes are there");
    network.freeze();
    assert!(network.batch_norms().is_empty());
    let folded = network.infer(&passes, None).expect("all passes are there");
    let scale = plain.data.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    for (a, b) in folded.data.iter().zip(&plain.data) {
        assert!((a - b).abs() <= 1e-4 * scale, "{a} for {b}");
    }
}

#[test]
fn a_missing_pass_is_named() {
    for (name, config) in models::trainable() {
        let network = models::build(&config, 1);
        for &missing in network.passes() {
            let mut passes = random_passes(16, 16, 4);
            passes.remove(missing);
            let error = network.infer(&passes, None).expect_err("a pass is missing").to_string();
            assert!(error.contains(&missing.to_string()) && error.contains("random.exr"), "{name}: {error}");
        }
    }
}

#[test]
fn networks_that_filter_scale_with_their_input() {
    let passes = random_passes(40, 24, 9);
    for name in ["demc-s", "kpcn", "kpcn-combined", "lbf"] {
        let network = models::build(&trainable(name), 1);
        let base = network.infer(&passes, None).expect("all passes are there");
        for stops in [-8, -3, 5, 8] {
            let factor = 2f32.powi(stops);
            let mut scaled = passes.clone();
            for pass in [Pass::Combined, Pass::DiffuseDirect, Pass::DiffuseIndirect, Pass::Emission] {
                let mut radiance = passes.get(pass).expect("it is there").clone();
                radiance.data.iter_mut().for_each(|v| *v *= factor);
                scaled.insert(pass, radiance);
            }
            let image = network.infer(&scaled, None).expect("all passes are there");
            for (a, b) in image.data.iter().zip(&base.data) {
                assert!((a / factor - b).abs() <= 0.01 * b.abs(), "{name}, 2^{stops}: {a} for {b}");
            }
        }
    }
}

fn trainable(name: &str) -> Config {
    models::trainable().find(|(n, _)| *n == name).expect("it is trainable").1
}

#[test]
fn kpcn_has_its_published_size() {
    let config = Config::new(Architecture::Kpcn, &[PUBLISHED_WIDTH]);
    let mut network = models::build(&config, 1);
    // By hand: nine 5x5 convolutions from 34 channels over 100 to 21 x 21 weights, twice.
    let conv = |i: usize, o: usize| 25 * i * o + o;
    let stream = conv(34, 100) + 7 * conv(100, 100) + conv(100, 441);
    assert_eq!(parameters(&mut *network), 2 * stream);
    assert_eq!(network.reach(), 9 * 2 + 10);
}

#[test]
fn kpcn_keeps_what_is_constant_in_each_stream() {
    // Kernels are convex combinations: whatever the weights, flat light comes out unchanged.
    let mut passes = PassSet::new("flat.exr", "ViewLayer", 24, 20);
    let mut flat = |pass: Pass, v: f32| {
        let n = pass.channels();
        passes.insert(pass, Planes::from_vec(n, 24, 20, vec![v; n * 24 * 20]));
    };
    for (pass, value) in [
        (Pass::Combined, 2.0),
        (Pass::DiffuseColor, 0.5),
        (Pass::DiffuseDirect, 1.0),
        (Pass::DiffuseIndirect, 0.6),
        (Pass::DenoisingAlbedo, 0.4),
        (Pass::DenoisingNormal, 0.5),
        (Pass::DenoisingDepth, 3.0),
    ] {
        flat(pass, value);
    }
    for name in ["kpcn", "kpcn-combined"] {
        let network = models::build(&trainable(name), 7);
        let image = network.infer(&passes, None).expect("all passes are there");
        assert!(image.data.iter().all(|v| (v - 2.0).abs() < 1e-3), "{name}: {:?}", &image.data[..8]);
    }
}

#[test]
fn light_that_kpcn_does_not_filter_is_optional() {
    let network = models::build(&trainable("kpcn"), 1);
    let mut passes = random_passes(20, 20, 2);
    let with = network.infer(&passes, None).expect("all passes are there");
    passes.remove(Pass::Emission);
    let without = network.infer(&passes, None).expect("emission may be missing");
    assert!(with != without && without.non_finite() == 0);
}

#[test]
fn a_constant_image_stays_as_it_is_but_for_a_bounded_gain() {
    // Kernels are convex combinations: whatever the weights, constant radiance over constant albedo
    // comes out of them unchanged.
    let mut passes = PassSet::new("flat.exr", "ViewLayer", 32, 32);
    let flat = |v: f32| Planes::from_vec(3, 32, 32, vec![v; 3 * 32 * 32]);
    passes.insert(Pass::Combined, flat(0.7));
    passes.insert(Pass::DenoisingAlbedo, flat(0.4));
    passes.insert(Pass::DenoisingNormal, flat(0.5));
    let config = models::trainable().find(|(n, _)| *n == "demc-m").expect("it is trainable").1;
    let mut network = models::build(&config, 7);
    let Inputs { planes, .. } = network.inputs(&passes).expect("all passes are there");
    assert_eq!(planes.len(), 7);
    // The gains of four pixels follow their kernels, of 9 pixels, a prefilter's of 25, confidences, masks and
    // corners.
    let gains = |taps: usize| 4 * (taps + 6)..4 * (taps + 9);
    for (logit, gain) in [(0.0, 1.0), (-50.0, (-2.0f32).exp()), (50.0, 2.0f32.exp())] {
        for param in network.params() {
            let each = param.shape.iter().skip(1).product::<usize>();
            let (gains, value) = match param.name.as_str() {
                "prefilter.head.full.weight" | "prefilter.head.full.bias" => (gains(25), 0.0),
                "head.full.weight" => (gains(9), 0.0),
                "head.full.bias" => (gains(9), logit),
                _ => continue,
            };
            let mut values = param.values();
            values[gains.start * each..gains.end * each].fill(value);
            param.set(&values);
        }
        let image = network.infer(&passes, None).expect("all passes are there");
        let want = 0.7 * gain;
        assert!(image.data.iter().all(|v| (v - want).abs() < 1e-4 * gain), "{want}: {:?}", &image.data[..8]);
    }
}

/// Something to write into a file.
fn facts() -> Facts {
    Facts {
        frames: 1,
        steps: 1,
        batch: 1,
        patch: 16,
        lr: (1.0, 1.0),
        loss: "both".into(),
        raw_references: false,
        guide_dropout: 0.0,
        tint: 0.0,
        leak: 0.0,
        optimizer: "adam".into(),
        weight_decay: 0.0,
        precision: None,
        average: None,
        seed: 5,
        init: None,
        prefilter: None,
        only: Vec::new(),
        seconds: 0.0,
        validation_frames: 0,
        validation_relmse: None,
        validation_ssim: None,
    }
}

#[test]
fn a_wider_network_begins_as_the_narrower_one() {
    let config = |widths: [usize; 4]| Config::new(Architecture::Prefilter, &widths);
    let (narrow, wide) = (config([3, 5, 4, 6]), config([4, 5, 9, 17]));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("narrow.safetensors");
    let mut network = models::build(&narrow, 5);
    weights_file::write(&path, &mut *network, &facts()).unwrap();
    let mut passes = PassSet::new(std::path::Path::new("x"), "ViewLayer", 40, 24);
    let mut rng = Rng::new(3, 0);
    for pass in [Pass::Combined, Pass::DenoisingNormal, Pass::DenoisingAlbedo] {
        let data = (0..3 * 40 * 24).map(|_| rng.uniform()).collect();
        passes.insert(pass, Planes::from_vec(3, 40, 24, data));
    }
    let held = weights_file::read_as(&path, &narrow, 1).unwrap();
    let mut wider = weights_file::read_as(&path, &wide, 1).unwrap();
    assert_eq!(wider.config(), wide);
    let (a, b) = (held.infer(&passes, None).unwrap(), wider.infer(&passes, None).unwrap());
    for (a, b) in a.data.iter().zip(&b.data) {
        assert!((a - b).abs() <= 1e-4 * a.abs(), "{a} became {b}");
    }
    // Further channels are read with weights as large as those of the channels that they copy, but others.
    for (layer, [channel, copy]) in
        [("encoder.guide.2.1", [0, 4]), ("encoder.guide.2.1", [0, 8]), ("decoder.2.refine", [1, 21])]
    {
        let weight =
            wider.params().into_iter().find(|param| param.name == format!("{layer}.weight")).unwrap();
        let (inputs, taps) = (weight.shape[1], weight.shape[2] * weight.shape[3]);
        let values = weight.values();
        let reading =
            |channel: usize| values.chunks(inputs * taps).flat_map(move |row| &row[channel * taps..][..taps]);
        let norm = |channel: usize| reading(channel).map(|v| v * v).sum::<f32>().sqrt();
        assert!(norm(copy) > 0.3 * norm(channel), "{layer}: {} beside {}", norm(copy), norm(channel));
        assert!(reading(copy).ne(reading(channel)), "{layer}");
    }
    let error = weights_file::read_as(&path, &config([2, 5, 9, 17]), 1).err().unwrap().to_string();
    assert!(error.contains("neither") && error.contains("--widths"), "{error}");
}
