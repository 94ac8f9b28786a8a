//! What a denoiser must leave alone: light that has no noise, frames that are nearly clean, what lies outside
//! a rendered region, and results of its own.

mod common;

use std::path::{Path, PathBuf};

use common::files::data;
use demc::{
    frame::Frame,
    metrics::error::relmse,
    models::{self, Denoiser},
    passes::{self, Pass, PassSet},
    planes::Planes,
    shot::Shot,
};

const MODELS: [&str; 3] = ["demc-s", "demc-m", "demc-l"];

fn model(name: &str) -> Box<dyn Denoiser> {
    models::open(name).unwrap()
}

fn example() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("eval/example/house_0004spp.exr")
}

/// The passes that the models read of a part of the example, (width, height) pixels from column 150 and row
/// 60.
fn part(width: usize, height: usize) -> PassSet {
    let whole = passes::load(example(), None).unwrap();
    let mut part = PassSet::new("part", "ViewLayer", width, height);
    part.samples = whole.samples;
    for pass in [Pass::Combined, Pass::DenoisingNormal, Pass::DenoisingAlbedo] {
        part.insert(pass, whole.require(pass, "test").unwrap().window((150, 60), (width, height)));
    }
    part
}

/// A frame of 64 samples that no model was trained on.
fn nearly_clean() -> PassSet {
    passes::load(data("no_harm/principled_0064spp.exr"), None).unwrap()
}

fn combined(passes: &PassSet) -> &Planes {
    passes.require(Pass::Combined, "test").unwrap()
}

#[test]
fn a_file_tells_its_number_of_samples() {
    assert_eq!(passes::load(example(), None).unwrap().samples, Some(4));
    let frame = Frame::read(example()).unwrap();
    assert_eq!(frame.text_attribute("cycles.ViewLayer.samples").as_deref(), Some("4"));
    assert_eq!(frame.text_attribute("cycles.Other.samples"), None);
    assert_eq!(part(20, 10).window((0, 2), (20, 3)).samples, Some(4), "parts of a frame tell it too");
}

#[test]
fn light_without_noise_comes_back_as_it_was() {
    // What is seen directly has its radiance in the albedo.
    let mut frame = part(160, 90);
    frame.insert(Pass::Combined, frame.require(Pass::DenoisingAlbedo, "test").unwrap().clone());
    for name in MODELS {
        for samples in [None, Some(4), Some(64)] {
            frame.samples = samples;
            let error = relmse(&model(name).denoise(&Shot::new(frame.clone())).unwrap(), combined(&frame));
            assert!(error < 1e-4, "{name}, {samples:?}: {error}");
        }
    }
}

#[test]
fn a_model_by_itself_changes_a_nearly_clean_frame_more() {
    let frame = Shot::new(nearly_clean());
    for name in MODELS {
        let [restrained, by_itself] = ["", models::UNRESTRAINED].map(|suffix| {
            relmse(&model(&format!("{name}{suffix}")).denoise(&frame).unwrap(), combined(&frame.passes))
        });
        assert!(restrained < by_itself, "{name}: {restrained} and {by_itself}");
    }
}

#[test]
fn a_result_denoised_again_stays() {
    let first = part(160, 90);
    for name in MODELS {
        let once = model(name).denoise(&Shot::new(first.clone())).unwrap();
        let mut second = first.clone();
        second.insert(Pass::Combined, once.clone());
        let twice = model(name).denoise(&Shot::new(second.clone())).unwrap();
        let change = |from: &Planes, to: &Planes| relmse(from, to).sqrt();
        let [before, again] = [change(combined(&first), &once), change(&once, &twice)];
        assert!(again < 0.1 * before, "{name}: {before}, then {again}");
    }
}

#[test]
fn what_is_nearly_black_brings_no_noise_back_beside_it() {
    let [noisy, reference] =
        ["s0000_room_0004spp.exr", "s0000_room_ref.exr"].map(|name| passes::load(data(name), None).unwrap());
    // Beyond the reach of what is darkened.
    let lit = |image: &Planes| image.window((80, 0), (image.width - 80, image.height));
    let truth = lit(combined(&reference));
    for name in MODELS {
        let [plain, beside] = [1.0, 1e-6].map(|factor| {
            let mut frame = noisy.clone();
            let mut light = combined(&frame).clone();
            let width = light.width;
            light.data.iter_mut().enumerate().filter(|(i, _)| i % width < 64).for_each(|(_, v)| *v *= factor);
            frame.insert(Pass::Combined, light);
            relmse(&lit(&model(name).denoise(&Shot::new(frame)).unwrap()), &truth)
        });
        assert!(beside < 1.6 * plain, "{name}: {beside} beside black, {plain} as rendered");
    }
}

#[test]
fn light_too_dark_for_a_reciprocal_stays() {
    let mut frame = part(40, 30);
    let mut light = combined(&frame).clone();
    light.data.iter_mut().for_each(|v| *v *= 1e-41);
    frame.insert(Pass::Combined, light.clone());
    for name in MODELS {
        assert_eq!(model(name).denoise(&Shot::new(frame.clone())).unwrap(), light, "{name}");
    }
}

#[test]
fn a_region_is_denoised_as_a_frame_of_its_own() {
    let region = part(61, 47);
    let (size, place) = ((100, 80), (21, 9));
    let mut frame = PassSet::new("frame", "ViewLayer", size.0, size.1);
    frame.samples = region.samples;
    for (pass, planes) in region.iter() {
        frame.insert(pass, planes.placed_in(size, place));
    }
    for name in MODELS {
        let alone = model(name).denoise(&Shot::new(region.clone())).unwrap();
        let image = model(name).denoise(&Shot::new(frame.clone())).unwrap();
        assert_eq!(image, alone.placed_in(size, place), "{name}");
    }
}

/// The light of the brightest hundredth of pixels of `reference` in `image`, over what it is there.
fn brightest(image: &Planes, reference: &Planes) -> f64 {
    let light = |planes: &Planes, at: usize| (0..3).map(|c| f64::from(planes.channel(c)[at])).sum::<f64>();
    let mut order: Vec<usize> = (0..reference.pixels()).collect();
    order.sort_by(|a, b| light(reference, *b).total_cmp(&light(reference, *a)));
    let brightest = &order[..reference.pixels() / 100];
    let sum = |planes: &Planes| brightest.iter().map(|at| light(planes, *at)).sum::<f64>();
    sum(image) / sum(reference)
}

/// A render of 4 samples and its reference, and what `samples` would have made of it: noise falls with their
/// root.
fn of_more_samples(samples: u32) -> (PassSet, Planes) {
    let mut frame = passes::load(data("s0010_outdoor_0004spp.exr"), None).unwrap();
    let reference = passes::load(data("s0010_outdoor_ref.exr"), None).unwrap();
    let reference = combined(&reference).clone();
    let share = (4.0 / samples as f32).sqrt();
    let mut radiance = reference.clone();
    let values = radiance.data.iter_mut().zip(&combined(&frame).data);
    values.for_each(|(v, noisy)| *v += (noisy - *v) * share);
    frame.insert(Pass::Combined, radiance);
    frame.samples = Some(samples);
    (frame, reference)
}

#[test]
fn highlights_of_many_samples_keep_their_light() {
    for samples in [64, 256, 4096] {
        let (frame, reference) = of_more_samples(samples);
        for name in MODELS {
            let kept = brightest(&model(name).denoise(&Shot::new(frame.clone())).unwrap(), &reference);
            assert!((0.98..1.02).contains(&kept), "{name}, {samples} samples: {kept}");
        }
    }
}

#[test]
fn lone_pixels_of_many_samples_vanish() {
    let mut frame = nearly_clean();
    let mut radiance = combined(&frame).clone();
    let most = radiance.data.iter().copied().fold(0.0, f32::max);
    let (width, height, pixels) = (radiance.width, radiance.height, radiance.pixels());
    // 40 of them, well apart.
    let place = |i: usize| (6 + i / 8 * (height - 12) / 5) * width + 6 + i % 8 * (width - 12) / 8;
    let fireflies: Vec<usize> = (0..40).map(place).collect();
    for &at in &fireflies {
        (0..3).for_each(|c| radiance.data[c * pixels + at] = 5000.0);
    }
    frame.insert(Pass::Combined, radiance);
    for name in MODELS {
        let image = model(name).denoise(&Shot::new(frame.clone())).unwrap();
        for &at in &fireflies {
            let left = (0..3).map(|c| image.data[c * pixels + at]).fold(0.0, f32::max);
            assert!(left < most, "{name}: a firefly left {left} at {at}, the frame has at most {most}");
        }
    }
}

#[test]
fn a_disc_too_bright_for_half_floats_is_no_hole() {
    let mut frame = nearly_clean();
    let (width, height) = (frame.width, frame.height);
    let in_disc = |i: usize| {
        let (x, y) = (i % width, i / width);
        x.abs_diff(width / 2).pow(2) + y.abs_diff(height / 2).pow(2) <= 36
    };
    for pass in [Pass::Combined, Pass::DenoisingAlbedo] {
        let mut planes = frame.require(pass, "test").unwrap().clone();
        (0..3).for_each(|c| {
            let plane = planes.channel_mut(c).iter_mut().enumerate();
            plane.filter(|(i, _)| in_disc(*i)).for_each(|(_, v)| *v = f32::INFINITY);
        });
        frame.insert(pass, planes);
    }
    frame.sanitize();
    for name in MODELS {
        let image = model(name).denoise(&Shot::new(frame.clone())).unwrap();
        assert_eq!(image.non_finite(), 0);
        for c in 0..3 {
            let mut disc = image.channel(c).iter().enumerate().filter(|(i, _)| in_disc(*i));
            assert!(disc.all(|(_, v)| (65000.0..=65504.0).contains(v)), "{name}");
        }
    }
}

#[test]
fn more_samples_never_make_a_result_worse_nor_worse_than_its_input() {
    for name in MODELS {
        let mut last = f64::INFINITY;
        for samples in [4, 16, 64, 256, 1024, 4096] {
            let (frame, reference) = of_more_samples(samples);
            let error = relmse(&model(name).denoise(&Shot::new(frame.clone())).unwrap(), &reference);
            let input = relmse(combined(&frame), &reference);
            assert!(error < last, "{name}: {error} of {samples} samples, {last} of fewer");
            assert!(error <= input, "{name}: {error} of {samples} samples, its input {input}");
            last = error;
        }
    }
}
