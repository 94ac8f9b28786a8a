//! The built-in model as its users get it: through the binary, on a render it never saw.
//!
//! What is demanded are properties of a denoiser (nearer the reference, the scale of its input, no
//! value that is not finite), never numbers of one set of weights.

mod common;

use std::{
    fs,
    path::{Path, PathBuf},
};

use assert_cmd::Command;
use common::files::{bits, data, read_exr, values};
use demc::{
    features::{self, GUIDE_PASSES},
    filters::shrinkage::{Render, shrink},
    metrics,
    models::{
        self,
        catalogue::{METHODS, find},
        learned,
        network::Architecture,
    },
    passes::{self, Pass, PassSet},
    planes::Planes,
    shot::Shot,
};
use predicates::{prelude::*, str::contains};
use tempfile::TempDir;

fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("eval/example").join(name)
}

/// The README's command.
fn demc(input: &Path, out: &Path) -> Command {
    let mut command = Command::cargo_bin("demc").unwrap();
    command.arg("denoise").arg(input).arg("--out").arg(out);
    command
}

/// A folder with one input, and the output folder in it.
struct Job {
    _dir: TempDir,
    input: PathBuf,
    out: PathBuf,
}

impl Job {
    fn new(passes: &PassSet) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let input = dir.path().join("in.exr");
        write(&input, passes);
        Self { input, out: dir.path().join("out"), _dir: dir }
    }

    fn command(&self) -> Command {
        demc(&self.input, &self.out)
    }

    fn denoised(&self) -> Planes {
        denoised(&self.out.join("in.exr"))
    }
}

/// Denoises passes.
fn denoise(passes: &PassSet) -> Planes {
    let job = Job::new(passes);
    job.command().assert().success().stderr("");
    job.denoised()
}

/// The layer that a denoised file gained.
fn denoised(path: &Path) -> Planes {
    let image = read_exr(path);
    let data = ["R", "G", "B"].map(|c| values(&image, &format!("ViewLayer.Denoised.{c}"))).concat();
    let size = image.layer_data.last().unwrap().size;
    Planes::from_vec(3, size.width(), size.height(), data)
}

/// What the model reads, and no more, in 32-bit floats and one part.
fn write(path: &Path, passes: &PassSet) {
    use exr::prelude::*;
    let mut list = Vec::new();
    for (pass, components) in [
        (Pass::Combined, ["R", "G", "B"]),
        (Pass::DenoisingNormal, ["X", "Y", "Z"]),
        (Pass::DenoisingAlbedo, ["R", "G", "B"]),
    ] {
        let Some(planes) = passes.get(pass) else { continue };
        for (c, component) in components.iter().enumerate() {
            let samples = FlatSamples::F32(planes.channel(c).to_vec());
            list.push(AnyChannel::new(format!("ViewLayer.{pass}.{component}").as_str(), samples));
        }
    }
    let layer = Layer::new(
        (passes.width, passes.height),
        LayerAttributes::default(),
        Encoding::SMALL_LOSSLESS,
        AnyChannels::sort(list.into_iter().collect()),
    );
    Image::from_layer(layer).write().to_file(path).unwrap();
}

fn crop(planes: &Planes, x: usize, y: usize, width: usize, height: usize) -> Planes {
    let mut data = Vec::with_capacity(planes.channels * width * height);
    for c in 0..planes.channels {
        for row in y..y + height {
            data.extend_from_slice(&planes.channel(c)[row * planes.width + x..][..width]);
        }
    }
    Planes::from_vec(planes.channels, width, height, data)
}

/// The passes of a window of the example, from column 150 and row 60.
fn window(width: usize, height: usize) -> PassSet {
    let whole = passes::load(example("house_0004spp.exr"), None).unwrap();
    let mut set = PassSet::new("window", "ViewLayer", width, height);
    for (pass, planes) in whole.iter() {
        set.insert(pass, crop(planes, 150, 60, width, height));
    }
    set
}

fn edit(set: &mut PassSet, pass: Pass, change: impl FnOnce(&mut [f32])) {
    let mut planes = set.remove(pass).unwrap();
    change(&mut planes.data);
    set.insert(pass, planes);
}

/// What is missing is said with its remedy; what is blank holds no more; either guide makes the result
/// better.
#[test]
fn guides_may_be_missing() {
    let all = passes::load(example("house_0004spp.exr"), None).unwrap();
    let reference = passes::load(example("house_ref.exr"), None).unwrap();
    let reference = reference.get(Pass::Combined).unwrap();
    let without = |missing: &[Pass]| {
        let mut fewer = all.clone();
        missing.iter().for_each(|pass| drop(fewer.remove(*pass)));
        let job = Job::new(&fewer);
        let said = job.command().assert().success().get_output().stderr.clone();
        (job.denoised(), String::from_utf8(said).unwrap())
    };
    let off = |image: &Planes| metrics::error::relmse(image, reference);
    let noisy = off(all.get(Pass::Combined).unwrap());
    let (image, said) = without(&features::PREFILTERED_PASSES);
    assert!(said.contains("done without Denoising Albedo and Denoising Normal"), "{said}");
    assert!(said.contains("Passes > Data > Denoising Data"), "{said}");
    let neither = off(&image);
    let both = off(&denoise(&all));
    let mut blank = all.clone();
    for pass in features::PREFILTERED_PASSES {
        blank.insert(pass, Planes::new(3, all.width, all.height));
    }
    let job = Job::new(&blank);
    job.command().assert().success().stderr(contains("Denoising Normal, which hold nothing, at a loss"));
    assert_eq!(job.denoised(), image, "blank guides are as good as none");
    let mut blank = all.clone();
    blank.insert(Pass::DenoisingAlbedo, Planes::new(3, all.width, all.height));
    Job::new(&blank)
        .command()
        .assert()
        .success()
        .stderr(contains("done without Denoising Albedo, which holds nothing"));
    for (pass, kept) in [(Pass::DenoisingAlbedo, "Normal"), (Pass::DenoisingNormal, "Albedo")] {
        let (image, said) = without(&[pass]);
        assert!(said.contains(&format!("done without {pass},")), "{said}");
        let one = off(&image);
        assert!(
            both < one && one < neither && neither < 0.2 * noisy,
            "{kept}: {both} {one} {neither} {noisy}"
        );
    }
}

#[test]
fn the_readme_s_command_denoises_and_keeps_every_layer() {
    let dir = tempfile::tempdir().unwrap();
    let input = example("house_0004spp.exr");
    demc(&input, dir.path()).assert().success().stderr("");
    let output = dir.path().join("house_0004spp.exr");

    let (before, after) = (read_exr(&input), read_exr(&output));
    assert_eq!(before.attributes, after.attributes);
    assert_eq!(before.layer_data.len() + 1, after.layer_data.len());
    for (old, new) in before.layer_data.iter().zip(&after.layer_data) {
        assert_eq!((old.size, &old.attributes, &old.encoding), (new.size, &new.attributes, &new.encoding));
        for (was, is) in old.channel_data.list.iter().zip(&new.channel_data.list) {
            assert_eq!((&was.name, bits(&was.sample_data)), (&is.name, bits(&is.sample_data)));
        }
    }
    let alpha = |layer: &str| values(&after, &format!("ViewLayer.{layer}.A"));
    assert_eq!(alpha("Denoised"), alpha("Combined"));

    let radiance = |path: &Path| passes::load(path, None).unwrap().remove(Pass::Combined).unwrap();
    let reference = radiance(&example("house_ref.exr"));
    let noisy = metrics::score(&radiance(&input), &reference).unwrap();
    let clean = metrics::score(&denoised(&output), &reference).unwrap();
    assert!(clean.relmse < 0.5 * noisy.relmse, "RelMSE {} of {} noisy", clean.relmse, noisy.relmse);
    assert!(clean.ssim.unwrap() > noisy.ssim.unwrap(), "SSIM {:?} of {:?} noisy", clean.ssim, noisy.ssim);
    assert!(clean.flip.unwrap() < noisy.flip.unwrap(), "FLIP {:?} of {:?} noisy", clean.flip, noisy.flip);
}

#[test]
fn a_frame_of_many_samples_is_never_made_worse() {
    let pair = ["no_harm/principled_0064spp.exr", "no_harm/principled_ref.exr"]
        .map(|name| passes::load(data(name), None).unwrap());
    let [noisy, reference] = pair.each_ref().map(|set| set.require(Pass::Combined, "this test").unwrap());
    let before = metrics::error::relmse(noisy, reference);
    for model in ["demc-s", "demc-m", "demc-l"] {
        let after = metrics::error::relmse(
            &models::open(model).unwrap().denoise(&Shot::new(pair[0].clone())).unwrap(),
            reference,
        );
        assert!(after < before, "{model}: RelMSE {before} became {after}");
    }
}

#[test]
fn nan_and_infinity_in_any_pass_are_reported_and_never_spread() {
    const SIZE: (usize, usize) = (96, 64);
    let clean = window(SIZE.0, SIZE.1);
    let mut broken = clean.clone();
    let pixels = SIZE.0 * SIZE.1;
    edit(&mut broken, Pass::Combined, |v| {
        v[700] = f32::NAN;
        v[pixels + 700] = f32::INFINITY;
        v[2 * pixels + 3100] = f32::NEG_INFINITY;
    });
    edit(&mut broken, Pass::DenoisingAlbedo, |v| {
        v[0] = f32::NAN;
        v[pixels + 4000] = f32::INFINITY;
    });
    edit(&mut broken, Pass::DenoisingNormal, |v| {
        v[pixels - 1] = f32::NAN;
        v[2 * pixels + 2000] = f32::INFINITY;
        v[2 * pixels + 2001] = f32::INFINITY;
        v[2 * pixels + 2002] = f32::NEG_INFINITY;
    });
    let job = Job::new(&broken);
    job.command()
        .assert()
        .success()
        .stderr(contains("3 in Combined").and(contains("2 in Denoising Albedo")))
        .stderr(contains("4 in Denoising Normal"));
    let result = job.denoised();
    assert_eq!(result.non_finite(), 0);
    // Nine values of 55296 were guessed: the rest of the image must look as it would have.
    let expected = denoise(&clean);
    let near = |(a, b): &(&f32, &f32)| (*a - *b).abs() <= 0.02 * b.abs();
    let same = result.data.iter().zip(&expected.data).filter(near).count();
    assert!(same * 100 > 95 * result.data.len(), "{same} of {} values as before", result.data.len());

    let json = job.command().args(["--json", "--overwrite"]).assert().success();
    let line: serde_json::Value = serde_json::from_slice(&json.get_output().stdout).unwrap();
    let counts = serde_json::json!({"Combined": 3, "Denoising Albedo": 2, "Denoising Normal": 4});
    assert_eq!(line["non_finite"], counts);
}

#[test]
fn guides_without_a_single_number_still_make_a_finite_image_and_such_a_beauty_fails() {
    let mut broken = window(40, 24);
    edit(&mut broken, Pass::Combined, |v| v.fill(f32::NAN));
    Job::new(&broken)
        .command()
        .assert()
        .code(1)
        .stderr(contains("2880 of the 2880 values of Combined are NaN"));
    for pass in [Pass::DenoisingAlbedo, Pass::DenoisingNormal] {
        let mut broken = window(40, 24);
        edit(&mut broken, pass, |v| v.fill(f32::NAN));
        let job = Job::new(&broken);
        job.command().assert().success().stderr(contains(format!("2880 in {pass}")));
        assert_eq!(job.denoised().non_finite(), 0, "{pass}");
    }
}

#[test]
fn radiance_256_times_darker_or_brighter_is_denoised_alike() {
    let plain = window(160, 96);
    for name in ["demc-s", "demc-m", "demc-l"] {
        let model = models::open(name).unwrap();
        let expected = model.denoise(&Shot::new(plain.clone())).unwrap();
        for stops in [-8, 8] {
            let factor = 2f32.powi(stops);
            let mut scaled = plain.clone();
            edit(&mut scaled, Pass::Combined, |v| v.iter_mut().for_each(|v| *v *= factor));
            for (got, want) in
                model.denoise(&Shot::new(scaled.clone())).unwrap().data.iter().zip(&expected.data)
            {
                assert!(
                    (got / factor - want).abs() <= 0.01 * want.abs(),
                    "{name}, 2^{stops}: {got} for {want}"
                );
            }
        }
    }
}

#[test]
fn a_black_background_stays_black_to_the_bit() {
    const WIDTH: usize = 96;
    let mut frame = window(WIDTH, 64);
    for pass in [Pass::Combined, Pass::DenoisingAlbedo] {
        edit(&mut frame, pass, |v| v.chunks_mut(WIDTH).for_each(|row| row[WIDTH / 2..].fill(0.0)));
    }
    for name in ["demc-s", "demc-m", "demc-l"] {
        let image = models::open(name).unwrap().denoise(&Shot::new(frame.clone())).unwrap();
        for row in image.data.chunks(WIDTH) {
            // Two columns see the light beside them.
            let (lit, black) = row.split_at(WIDTH / 2 + 2);
            assert!(lit[..WIDTH / 2].iter().all(|v| *v > 0.0), "{name}");
            assert!(black.iter().all(|v| *v == 0.0), "{name}: {black:?}");
        }
    }
}

/// A frame after half a turn.
fn upside_down(frame: &PassSet) -> PassSet {
    let (width, height) = (frame.width, frame.height);
    frame.map((width, height), |pass, planes| {
        let mut planes = planes.turned();
        if pass == Pass::DenoisingNormal {
            planes.data[..2 * width * height].iter_mut().for_each(|v| *v = -*v);
        }
        planes
    })
}

#[test]
fn demc_l_is_the_mean_of_two_looks_whose_squares_lie_apart() {
    let twice = models::open("demc-l").unwrap();
    let mut once = find("demc-m").unwrap().learned().unwrap().with_precision("demc-m", None).unwrap();
    let (network, frame) = (once.network(), window(50, 37));
    // In 51 columns, the first of the turned frame is the one that was added, and what shared a quad is
    // apart.
    let grown = |passes: &PassSet, of: &[Pass]| upside_down(&passes.padded_rows(of, 0..37, (51, 37)));
    // Both looks have the clean guides of the first.
    let guides = network.clean_guides(&frame).unwrap().expect("it has a prefilter");
    let turned = grown(&guides, &[Pass::DenoisingAlbedo, Pass::DenoisingNormal]);
    let second =
        network.infer_along(&grown(&frame, &GUIDE_PASSES), Some(&turned), &mut [], None).unwrap().turned();
    let looks = [network.infer(&frame, None).unwrap(), second.window((0, 0), (50, 37))];
    assert!(looks[0] != looks[1], "a network sees which way up a picture is");
    let mut mean = looks[0].clone();
    mean.data.iter_mut().zip(&looks[1].data).for_each(|(a, b)| *a = 0.5 * (*a + b));
    let [radiance, albedo] =
        [Pass::Combined, Pass::DenoisingAlbedo].map(|p| frame.require(p, "test").unwrap());
    let (exposure, samples) = (features::exposure(radiance), frame.samples);
    shrink(&mut mean, &Render { radiance, albedo, exposure, samples }, None);
    assert_eq!(twice.denoise(&Shot::new(frame.clone())).unwrap(), mean);
}

#[test]
fn a_firefly_near_the_border_is_no_company_for_its_mirror_image() {
    const WIDTH: usize = 50;
    let clean = window(WIDTH, 37);
    let mut lit = clean.clone();
    // The second look adds a column beyond the last, in which this pixel, the last but one, comes again.
    edit(&mut lit, Pass::Combined, |v| {
        v.chunks_mut(WIDTH * 37).for_each(|c| c[18 * WIDTH + WIDTH - 2] = 1e5)
    });
    // What the second look lets through of it, beside what the first does.
    let deviation = |model: &str| {
        let model = models::open(model).unwrap();
        let [lit, clean] = [&lit, &clean].map(|frame| model.denoise(&Shot::new(frame.clone())).unwrap());
        let relative =
            lit.data.iter().zip(&clean.data).map(|(lit, clean)| ((lit - clean) / (clean + 0.01)).abs());
        relative.fold(0.0, f32::max)
    };
    let [once, twice] = ["demc-m", "demc-l"].map(deviation);
    assert!(twice < 1.5 * once, "{twice}, {once} with one look");
}

#[test]
fn frames_of_a_few_pixels() {
    for (width, height) in [(1, 1), (2, 3), (17, 5)] {
        let small = window(width, height);
        let image = denoise(&small);
        assert_eq!((image.width, image.height, image.non_finite()), (width, height, 0));
        let noisy = small.get(Pass::Combined).unwrap();
        let mean = |p: &Planes| p.data.iter().sum::<f32>() / p.data.len() as f32;
        let (before, after) = (mean(noisy), mean(&image));
        assert!(
            before > 0.0 && (0.5..2.0).contains(&(after / before)),
            "{width}x{height}: {before}, {after}"
        );
        if width * height == 1 {
            // A pixel has no neighbour but itself; the gain finds nothing to draw.
            for (got, want) in image.data.iter().zip(&noisy.data) {
                assert!((got - want).abs() <= 0.02 * want, "{got} for {want}");
            }
        }
    }
}

#[test]
fn what_a_frame_is_padded_with_does_no_harm_at_its_end() {
    const END: usize = 15;
    const HEIGHTS: [usize; 6] = [113, 114, 117, 120, 122, 126];
    let [noisy, reference] =
        ["s0000_room_0004spp.exr", "s0000_room_ref.exr"].map(|name| passes::load(data(name), None).unwrap());
    let reference = reference.require(Pass::Combined, "this test").unwrap();
    for name in ["demc-s", "demc-m"] {
        let model = models::open(name).unwrap();
        let ratios = HEIGHTS.map(|height| {
            // RelMSE of the last rows of a frame that ends at `height`; one of 112 rows needs no padding.
            let error = |rows: usize| {
                let image = model
                    .denoise(&Shot::new(noisy.window((0, height - rows), (noisy.width, rows))))
                    .expect("all is there");
                let end = |planes: &Planes, height| planes.window((0, height - END), (noisy.width, END));
                metrics::error::relmse(&end(&image, rows), &end(reference, height))
            };
            error(height) / error(112)
        });
        let mean = (ratios.iter().map(|r| r.ln()).sum::<f64>() / ratios.len() as f64).exp();
        assert!(mean < 1.5, "{name}: padded frames err {ratios:?} times as much at their end");
    }
}

#[test]
fn the_number_of_threads_does_not_change_a_bit() {
    let job = Job::new(&window(130, 70));
    let bytes = |threads: &str| {
        job.command().args(["--overwrite", "--threads", threads]).assert().success();
        fs::read(job.out.join("in.exr")).unwrap()
    };
    let one = bytes("1");
    for threads in ["2", "5", "40"] {
        assert!(one == bytes(threads), "{threads} threads give other bytes than one");
    }
}

#[test]
fn arithmetic_can_be_chosen_and_changes_little() {
    let passes = window(130, 70);
    for name in ["demc-s", "demc-m", "demc-l"] {
        let image =
            |name: &str| models::open(name).unwrap().denoise(&Shot::new(passes.clone())).unwrap().data;
        let exact = image(&format!("{name}:f32"));
        let energy: f32 = exact.iter().map(|v| v * v).sum();
        let mut all = vec![exact.clone()];
        for (arithmetic, limit) in [("bf16", 1e-4), ("int8", 4e-4)] {
            let rounded = image(&format!("{name}:{arithmetic}"));
            let difference: f32 = exact.iter().zip(&rounded).map(|(a, b)| (a - b).powi(2)).sum();
            assert!(difference > 0.0, "{name}:{arithmetic} rounds nothing?");
            let change = difference / energy;
            assert!(change < limit, "{name}:{arithmetic} changed the image by {}", change.sqrt());
            all.push(rounded);
        }
        assert!(all.contains(&image(name)), "without a choice, one of the three");
    }
}

#[test]
fn eight_bits_need_known_ranges() {
    let error = models::open("semc:int8").err().expect("the paper's networks have no ranges").to_string();
    assert!(error.contains("semc:int8") && error.contains(":bf16"), "{error}");
}

#[test]
fn every_built_in_weights_file_is_sound_and_small() {
    let with_weights: Vec<_> = METHODS
        .iter()
        .filter_map(|method| match (method.built_in(), method.weights_file()) {
            (Some(bytes), _) => Some((method, bytes.len())),
            (_, Some(path)) => Some((method, fs::metadata(path).unwrap().len() as usize)),
            _ => None,
        })
        .collect();
    let names: Vec<&str> = with_weights.iter().map(|(method, _)| method.name).collect();
    assert_eq!(names, ["demc-s", "demc-m", "demc-l", "demc", "demc-nofusion", "semc", "kpcn", "lbf"]);
    for (method, bytes) in with_weights {
        let name = method.name;
        // The README beside the weights says why one may be larger.
        let trained = if name == learned::TURNED { "demc-m" } else { name };
        let limit = if trained == "demc-m" { 6 << 20 } else { 5 << 20 };
        assert!(bytes < limit, "{name}: {bytes} bytes");
        let mut model = method.learned().unwrap();
        let config = |name| models::trainable().find(|(n, _)| *n == name);
        let mut expected = config(trained).expect("it is trainable").1;
        // Trained on frames without light passes, kpcn is its single stream over Combined.
        if name == "kpcn" && model.metadata.network.architecture == Architecture::KpcnCombined {
            expected = config("kpcn-combined").expect("it is trainable").1;
        }
        assert_eq!(model.metadata.network, expected, "{name}");
        for param in model.network().params() {
            assert!(param.values().iter().all(|v| v.is_finite()), "{name}: {}", param.name);
        }
        models::open(name).unwrap();
    }
}
