//! The networks as contracts: sizes of the paper's, reach and scaling of the built-in ones.

use demc::{
    features::Inputs,
    models::{
        self,
        demc::{Demc, PAPER_WIDTHS},
        network::{Architecture, Network, run},
    },
    nn::Rng,
    passes::{Pass, PassSet},
    planes::Planes,
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
    ] {
        let values = (0..3 * width * height).map(|_| rng.uniform()).collect();
        passes.insert(pass, Planes::from_vec(3, width, height, values));
    }
    passes
}

#[test]
fn every_network_takes_every_size_from_one_pixel_up() {
    for (name, config) in models::trainable() {
        let network = models::build(&config, 1);
        for (width, height) in [(1, 1), (3, 1), (1, 7), (33, 17)] {
            let image = run(&*network, &random_passes(width, height, 4), None).expect("all passes are there");
            assert_eq!((image.channels, image.width, image.height), (3, width, height), "{name}");
            assert_eq!(image.non_finite(), 0, "{name} at {width}x{height}");
        }
    }
}

#[test]
fn tiles_give_the_same_bits_as_the_whole_frame() {
    for name in ["demc-s", "demc"] {
        let mut config =
            models::trainable().into_iter().find(|(n, _)| *n == name).expect("it is trainable").1;
        config.widths.fill(8);
        let network = models::build(&config, 1);
        let passes = random_passes(1300, 40, 11);
        let whole = run(&*network, &passes, Some(4096)).expect("all passes are there");
        for tile in [100, 333] {
            assert!(2 * network.reach() + tile < 1300, "no tile sees the whole frame");
            assert!(
                run(&*network, &passes, Some(tile)).expect("all passes are there") == whole,
                "{name}, {tile}"
            );
        }
    }
}

#[test]
fn a_missing_pass_is_named() {
    for (name, config) in models::trainable() {
        let network = models::build(&config, 1);
        for &missing in network.passes() {
            let mut passes = random_passes(16, 16, 4);
            passes.remove(missing);
            let error = run(&*network, &passes, None).expect_err("a pass is missing").to_string();
            assert!(error.contains(&missing.to_string()) && error.contains("random.exr"), "{name}: {error}");
        }
    }
}

#[test]
fn the_kernel_predicting_network_scales_with_its_input() {
    let config = models::trainable().into_iter().find(|(n, _)| *n == "demc-s").expect("it is trainable").1;
    let network = models::build(&config, 1);
    let passes = random_passes(40, 24, 9);
    let base = run(&*network, &passes, None).expect("all passes are there");
    for stops in [-8, -3, 5, 8] {
        let factor = 2f32.powi(stops);
        let mut scaled = passes.clone();
        let mut radiance = passes.get(Pass::Combined).expect("it is there").clone();
        radiance.data.iter_mut().for_each(|v| *v *= factor);
        scaled.insert(Pass::Combined, radiance);
        let image = run(&*network, &scaled, None).expect("all passes are there");
        for (a, b) in image.data.iter().zip(&base.data) {
            assert!((a / factor - b).abs() <= 0.01 * b.abs(), "2^{stops}: {a} for {b}");
        }
    }
}

#[test]
fn a_constant_image_stays_as_it_is() {
    // Kernels are convex combinations: whatever the weights, constant radiance over constant albedo
    // comes out unchanged.
    let mut passes = PassSet::new("flat.exr", "ViewLayer", 32, 32);
    let flat = |v: f32| Planes::from_vec(3, 32, 32, vec![v; 3 * 32 * 32]);
    passes.insert(Pass::Combined, flat(0.7));
    passes.insert(Pass::DenoisingAlbedo, flat(0.4));
    passes.insert(Pass::DenoisingNormal, flat(0.5));
    let config = models::trainable().into_iter().find(|(n, _)| *n == "demc-m").expect("it is trainable").1;
    let network = models::build(&config, 7);
    let Inputs { planes, .. } = network.inputs(&passes).expect("all passes are there");
    assert_eq!(planes.len(), 4);
    let image = run(&*network, &passes, None).expect("all passes are there");
    assert!(image.data.iter().all(|v| (v - 0.7).abs() < 1e-4), "{:?}", &image.data[..8]);
}
