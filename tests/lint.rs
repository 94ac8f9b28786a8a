//! What ruins a denoise, on frames that have one fault each. A small path tracer renders a tiled wall sample
//! by sample as Cycles does (each sample picks its place within the pixel filter, and belongs to one pixel),
//! and the frame is spoilt in one way. A sound frame must bring no warning, a spoilt one that of its fault
//! and no other.

mod common;

use std::{collections::BTreeSet, path::Path};

use common::demc;
use demc::{
    frame::HALF_MAX,
    lint::{self, About, Trace},
    passes::{Pass, PassSet, RENDERERS},
    planes::Planes,
    rng::Rng,
};
use exr::prelude::*;
use half::f16;
use predicates::{prelude::*, str::contains};

const SIZE: (usize, usize) = (336, 240);
const SAMPLES: u32 = 8;

/// How a frame is rendered.
#[derive(Clone, Copy)]
struct Render {
    /// Of the wall.
    scene: u32,
    /// Of the noise.
    seed: u64,
    /// Pixels that the wall has moved by, to the right and down.
    moved: (f32, f32),
    /// Width of the pixel filter, in pixels.
    filter: f32,
    /// Pixels that the wall moves by while the beauty is exposed.
    blur: f32,
    /// What the channels of a sample add up to at most, divided by 3.
    clamp: f32,
    /// What albedo is multiplied by.
    albedo: f32,
}

const SOUND: Render = Render {
    scene: 1,
    seed: 1,
    moved: (0.0, 0.0),
    filter: 1.5,
    blur: 0.0,
    clamp: f32::INFINITY,
    albedo: 1.0,
};

/// A number from 0 to 1 that depends on all of `parts`.
fn random(parts: [i32; 4]) -> f32 {
    let mix = |hash: u32, part: &i32| {
        (hash ^ part.cast_unsigned()).wrapping_mul(0x85eb_ca6b).rotate_left(13).wrapping_mul(0xc2b2_ae35)
    };
    let hash = parts.iter().fold(0x9e37_79b9, mix);
    ((hash ^ (hash >> 15)).wrapping_mul(0x2c1b_3c6d) >> 8) as f32 / (1 << 24) as f32
}

impl Render {
    /// The tile at a place, which lies askew on the grid of pixels.
    fn tile(&self, (x, y): (f32, f32)) -> [i32; 2] {
        let (x, y) = (x - self.moved.0, y - self.moved.1);
        let (sin, cos) = 0.21f32.sin_cos();
        [((x * cos + y * sin) / 43.0).floor() as i32, ((y * cos - x * sin) / 37.0).floor() as i32]
    }

    fn property(&self, tile: [i32; 2], which: i32) -> f32 {
        random([tile[0], tile[1], which, self.scene as i32])
    }

    fn albedo_of(&self, tile: [i32; 2]) -> [f32; 3] {
        [0, 1, 2].map(|c| {
            self.albedo * (0.08 + 0.8 * self.property(tile, 9) * (0.6 + 0.4 * self.property(tile, c)))
        })
    }

    fn normal_of(&self, tile: [i32; 2]) -> [f32; 3] {
        let [x, y] = [3, 4].map(|which| 0.8 * self.property(tile, which) - 0.4);
        [x, y, (1.0 - x * x - y * y).sqrt()]
    }

    /// The passes, all in half floats as Blender writes them.
    fn passes(&self) -> PassSet {
        let (w, h) = SIZE;
        let mut rng = Rng::new(self.seed, 0);
        let mut planes = [Planes::new(3, w, h), Planes::new(3, w, h), Planes::new(3, w, h)];
        for at in 0..w * h {
            let centre = ((at % w) as f32 + 0.5, (at / w) as f32 + 0.5);
            let mut sums = [[0.0f32; 3]; 3];
            for _ in 0..SAMPLES {
                // A bell: its standard deviation is a fifth of its width, as that of Blackman and Harris'
                // window.
                let mut bell = || 0.4 * self.filter * (rng.uniform() + rng.uniform() + rng.uniform() - 1.5);
                let place = (centre.0 + bell(), centre.1 + bell());
                let tile = self.tile(place);
                let time = self.blur * (rng.uniform() - 0.5);
                let seen = self.albedo_of(self.tile((place.0 - time, place.1)));
                // Soft light from above, and a path in eight that finds a lamp.
                let direct = 0.25 + 0.15 * (centre.1 / h as f32);
                let found = if rng.uniform() < 0.125 { 3.0 * -(1.0 - rng.uniform()).ln() } else { 0.0 };
                let indirect = seen.map(|albedo| albedo * found);
                let sum: f32 = indirect.iter().sum();
                let scale = if sum > 3.0 * self.clamp { 3.0 * self.clamp / sum } else { 1.0 };
                let light: [f32; 3] = std::array::from_fn(|c| seen[c] * direct + scale * indirect[c]);
                for (sum, value) in sums.iter_mut().zip([light, self.albedo_of(tile), self.normal_of(tile)]) {
                    sum.iter_mut().zip(value).for_each(|(sum, v)| *sum += v / SAMPLES as f32);
                }
            }
            for (planes, sum) in planes.iter_mut().zip(sums) {
                sum.iter().enumerate().for_each(|(c, v)| planes.channel_mut(c)[at] = *v);
            }
        }
        let mut set = PassSet::new("x.exr", "ViewLayer", w, h);
        set.samples = Some(SAMPLES);
        for (pass, planes) in
            [Pass::Combined, Pass::DenoisingAlbedo, Pass::DenoisingNormal].into_iter().zip(planes)
        {
            set.insert(pass, to_half(planes));
        }
        set
    }
}

fn to_half(mut planes: Planes) -> Planes {
    planes.data.iter_mut().for_each(|v| *v = f16::from_f32(*v).to_f32());
    planes
}

fn change(set: &mut PassSet, pass: Pass, change: impl FnOnce(&mut Planes)) {
    let mut planes = set.remove(pass).unwrap();
    change(&mut planes);
    set.insert(pass, planes);
}

fn each(set: &mut PassSet, pass: Pass, of: impl Fn(f32) -> f32) {
    change(set, pass, |planes| planes.data.iter_mut().for_each(|v| *v = of(*v)));
}

/// The planes averaged with their neighbours, along rows and down columns, with these weights.
fn spread(planes: &mut Planes, weights: &[f32]) {
    let (w, h, reach) = (planes.width as isize, planes.height as isize, weights.len() as isize / 2);
    for (dx, dy) in [(1, 0), (0, 1)] {
        let before = planes.clone();
        for c in 0..planes.channels {
            for at in 0..w * h {
                let (x, y) = (at % w, at / w);
                let value = |n: isize| {
                    let (x, y) = ((x + n * dx).clamp(0, w - 1), (y + n * dy).clamp(0, h - 1));
                    before.channel(c)[(y * w + x) as usize]
                };
                let sum = (-reach..=reach).map(|n| weights[(n + reach) as usize] * value(n)).sum();
                planes.channel_mut(c)[at as usize] = sum;
            }
        }
    }
}

fn curve(v: f32) -> f32 {
    let v = v.clamp(0.0, 1.0);
    if v < 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 }
}

fn codes(set: &PassSet, about: &About) -> Vec<&'static str> {
    let mut codes: Vec<&str> = lint::frame(set, about).iter().map(|finding| finding.code).collect();
    codes.sort_unstable();
    codes.dedup();
    codes
}

/// What is found in a frame of each of three walls after it was spoilt.
#[track_caller]
fn assert_found(render: Render, spoil: impl Fn(&mut PassSet), expected: &[&str]) {
    for scene in 1..=3 {
        let mut set = Render { scene, seed: scene.into(), ..render }.passes();
        spoil(&mut set);
        assert_eq!(codes(&set, &About::default()), expected, "wall {scene}");
    }
}

#[test]
fn a_sound_frame_brings_no_warning() {
    assert_found(SOUND, |_| {}, &[]);
    assert_found(Render { filter: 1.0, ..SOUND }, |_| {}, &[]);
    // Cropped, moved or dark frames are as sound.
    assert_found(Render { moved: (3.5, -2.25), ..SOUND }, |set| each(set, Pass::Combined, |v| 0.01 * v), &[]);
}

#[test]
fn guides_that_are_blank_or_one_value() {
    assert_found(SOUND, |set| each(set, Pass::DenoisingAlbedo, |_| 0.0), &["empty-pass"]);
    assert_found(SOUND, |set| each(set, Pass::DenoisingAlbedo, |_| 0.8), &["constant-guide"]);
    assert_found(SOUND, |set| each(set, Pass::DenoisingNormal, |_| 0.57), &["constant-guide"]);
}

#[test]
fn a_plain_wall_is_noted_and_nan_is_no_value() {
    let found = |pass: Pass, values: [f32; 3]| {
        let mut set = SOUND.passes();
        change(&mut set, pass, |planes| (0..3).for_each(|c| planes.channel_mut(c).fill(values[c])));
        let found = lint::frame(&set, &About::default()).into_iter();
        found.filter(|finding| finding.code == "constant-guide").map(|f| f.harms).collect::<Vec<_>>()
    };
    assert_eq!(found(Pass::DenoisingNormal, [0.0, 0.6, 0.8]), [false]);
    assert_eq!(found(Pass::DenoisingNormal, [0.2; 3]), [true], "no direction");
    assert_eq!(found(Pass::DenoisingAlbedo, [0.0, 0.6, 0.8]), [true]);
    assert_eq!(found(Pass::DenoisingAlbedo, [f32::NAN; 3]), [false; 0]);
}

/// Passes of a frame in which no surface is seen, whose albedo is the light.
fn of_sky(light: impl Fn(f32, f32) -> f32 + Sync) -> PassSet {
    let mut set = SOUND.passes();
    let (w, h) = SIZE;
    let sky = Planes::from_rows(3, SIZE, |c, y, row| {
        let colour = [0.6, 0.8, 1.0][c];
        for (x, v) in row.iter_mut().enumerate() {
            *v = colour * light(x as f32 / w as f32, y as f32 / h as f32);
        }
    });
    set.insert(Pass::Combined, to_half(sky.clone()));
    set.insert(Pass::DenoisingAlbedo, to_half(sky));
    for pass in [Pass::DenoisingNormal, Pass::Normal] {
        set.insert(pass, Planes::new(3, w, h));
    }
    set
}

#[test]
fn a_frame_in_which_nothing_is_met_lacks_no_pass() {
    // Clouds, a sky of one colour, and nothing at all before a transparent film.
    let clouds = of_sky(|x, y| 0.4 + 0.1 * (20.0 * x).sin() * (15.0 * y).cos());
    assert_eq!(codes(&clouds, &About::default()), [""; 0]);
    let mut plain = of_sky(|_, _| 0.0);
    for pass in [Pass::Combined, Pass::DenoisingAlbedo] {
        // Blender's default world, which is nearly 13/255.
        each(&mut plain, pass, |_| 0.050_876_09);
    }
    assert_eq!(codes(&plain, &About::default()), [""; 0]);
    let mut empty = of_sky(|_, _| 0.0);
    empty.insert(Pass::Alpha, Planes::new(1, SIZE.0, SIZE.1));
    assert_eq!(codes(&empty, &About::default()), [""; 0]);
    let dark = of_sky(|_, _| 0.0);
    assert_eq!(codes(&dark, &About::default()), [""; 0], "a fade from black");
    // A beauty that is lost, and normals that are.
    assert_found(SOUND, |set| each(set, Pass::Combined, |_| 0.0), &["empty-pass"]);
    let mut blank = SOUND.passes();
    each(&mut blank, Pass::DenoisingNormal, |_| 0.0);
    assert!(codes(&blank, &About::default()).contains(&"empty-pass"));
}

#[test]
fn guides_of_another_frame() {
    for moved in [(7.0, -4.0), (0.0, 5.0), (-9.0, 0.0)] {
        for passes in [&[Pass::DenoisingAlbedo][..], &[Pass::DenoisingAlbedo, Pass::DenoisingNormal]] {
            let spoil = |set: &mut PassSet| {
                let scene = (1..=3).find(|n| {
                    Render { scene: *n, seed: u64::from(*n), ..SOUND }.passes().get(Pass::Combined)
                        == set.get(Pass::Combined)
                });
                let other = Render { scene: scene.unwrap(), moved, ..SOUND }.passes();
                passes.iter().for_each(|pass| set.insert(*pass, other.get(*pass).unwrap().clone()));
            };
            assert_found(SOUND, spoil, &["shifted-guide"]);
        }
    }
    let mut set = SOUND.passes();
    let other = Render { moved: (7.0, -4.0), ..SOUND }.passes();
    set.insert(Pass::DenoisingAlbedo, other.get(Pass::DenoisingAlbedo).unwrap().clone());
    let found = lint::frame(&set, &About::default());
    // Moved back, it fits.
    assert!(found[0].message.contains("7 px to the left and 4 px down"), "{found:?}");
}

#[test]
fn guides_that_are_upside_down() {
    // Tiles of another wall would lie where these do.
    let guides = [Pass::DenoisingAlbedo, Pass::DenoisingNormal];
    let flip = |set: &mut PassSet| {
        let rows = |planes: &mut Planes| {
            let before = planes.clone();
            *planes =
                Planes::from_rows(3, SIZE, |c, y, row| row.copy_from_slice(before.row(c, SIZE.1 - 1 - y)));
        };
        guides.iter().for_each(|pass| change(set, *pass, rows));
    };
    assert_found(SOUND, flip, &["foreign-guide"]);
}

#[test]
fn albedo_and_normal_that_are_swapped() {
    let mut set = SOUND.passes();
    let [albedo, normal] =
        [Pass::DenoisingAlbedo, Pass::DenoisingNormal].map(|pass| set.remove(pass).unwrap());
    set.insert(Pass::DenoisingAlbedo, normal.clone());
    set.insert(Pass::DenoisingNormal, albedo);
    let found = lint::frame(&set, &About::default());
    let told = |pass: &str| found.iter().any(|f| f.code == "wrong-pass" && f.message.starts_with(pass));
    assert!(told("Denoising Albedo is below zero") && told("Denoising Normal has no direction"), "{found:?}");
    // Stored in 0 to 1 they are normals still.
    let mut encoded = SOUND.passes();
    each(&mut encoded, Pass::DenoisingNormal, |v| 0.5 + 0.5 * v);
    assert!(!codes(&encoded, &About::default()).contains(&"wrong-pass"));
}

#[test]
fn albedo_above_one_on_surfaces_and_not_on_lamps() {
    assert_found(Render { albedo: 2.2, ..SOUND }, |_| {}, &["albedo-above-one"]);
    // Lamps send what their albedo says, and more.
    let shine = |set: &mut PassSet| {
        let albedo = set.get(Pass::DenoisingAlbedo).unwrap().clone();
        change(set, Pass::Combined, |light| {
            light.data.iter_mut().zip(&albedo.data).for_each(|(l, a)| *l += 2.0 * a)
        });
        each(set, Pass::DenoisingAlbedo, |v| v + 2.0 * v);
    };
    assert_found(SOUND, shine, &[]);
}

#[test]
fn a_position_of_the_first_sample_alone() {
    let mut set = SOUND.passes();
    set.insert(Pass::Position, Planes::from_vec(3, SIZE.0, SIZE.1, vec![1.0; 3 * SIZE.0 * SIZE.1]));
    assert_eq!(codes(&set, &About::default()), ["aliased-position"]);
    assert_eq!(codes(&set, &About { position_averaged: true, ..About::default() }), [""; 0]);
}

#[test]
fn samples_that_were_clamped() {
    assert_found(Render { clamp: 1.0, ..SOUND }, |_| {}, &["clamped-samples"]);
    assert_found(Render { clamp: 0.5, ..SOUND }, |_| {}, &["clamped-samples"]);
    let found = lint::frame(&Render { clamp: 1.0, ..SOUND }.passes(), &About::default());
    assert!(found[0].message.contains("clamped to 1:") && found[0].remedy.contains("Clamping"), "{found:?}");
    // A clamp that nothing reaches takes nothing away.
    assert_found(Render { clamp: 50.0, ..SOUND }, |_| {}, &[]);
}

#[test]
fn values_that_are_no_light() {
    let put =
        |value: f32| move |set: &mut PassSet| change(set, Pass::Combined, |planes| planes.data[777] = value);
    assert_found(SOUND, put(f32::NAN), &["not-finite"]);
    assert_found(SOUND, put(-0.5), &["negative-light"]);
    // One value that rounding left is none to warn of, many are.
    assert_found(SOUND, put(-1e-7), &[]);
    let many = |set: &mut PassSet| change(set, Pass::Combined, |planes| planes.data[700..710].fill(-1e-7));
    assert_found(SOUND, many, &["negative-light"]);
    let about = About { half: BTreeSet::from([Pass::Combined]), ..About::default() };
    let mut set = SOUND.passes();
    put(HALF_MAX)(&mut set);
    assert_eq!(codes(&set, &about), ["half-overflow"]);
    assert_eq!(codes(&set, &About::default()), [""; 0], "floats hold more");
    put(f32::INFINITY)(&mut set);
    assert_eq!(codes(&set, &about), ["half-overflow"], "one fault, one finding");
    put(-0.5)(&mut set);
    let found = lint::frame(&set, &About { lossy: Some("dwaa"), ..About::default() });
    assert!(
        found[0].message.contains("lossy compression DWAA") && found[0].remedy.contains("ZIP"),
        "{found:?}"
    );
    // Beyond everything there is no depth.
    set = SOUND.passes();
    set.insert(Pass::Depth, Planes::from_vec(1, SIZE.0, SIZE.1, vec![f32::INFINITY; SIZE.0 * SIZE.1]));
    assert_eq!(codes(&set, &about), [""; 0]);
}

#[test]
fn a_beauty_that_was_denoised_before() {
    // What a denoiser leaves: no noise of single pixels, some blotches, sharp edges.
    let denoise = |set: &mut PassSet| {
        let albedo = set.get(Pass::DenoisingAlbedo).unwrap().clone();
        change(set, Pass::Combined, |light| {
            let mut ratio = light.clone();
            ratio.data.iter_mut().zip(&albedo.data).for_each(|(light, albedo)| *light /= albedo);
            (0..3).for_each(|_| spread(&mut ratio, &[0.1, 0.2, 0.4, 0.2, 0.1]));
            ratio.data.iter_mut().for_each(|v| *v = 0.6 + 0.02 * *v);
            light.data.iter_mut().zip(&ratio.data).zip(&albedo.data).for_each(|((l, r), a)| *l = r * a);
        });
        change(set, Pass::Combined, |planes| *planes = to_half(planes.clone()));
    };
    assert_found(SOUND, denoise, &["looks-denoised"]);
    // Blender keeps the render beside it.
    let keep = |set: &mut PassSet| {
        let render = set.get(Pass::Combined).unwrap().clone();
        denoise(set);
        set.insert(Pass::NoisyImage, render);
    };
    assert_found(SOUND, keep, &["already-denoised"]);
}

#[test]
fn noise_that_was_spread_over_pixels() {
    assert_found(
        SOUND,
        |set| change(set, Pass::Combined, |p| spread(p, &[0.15, 0.7, 0.15])),
        &["spread-noise"],
    );
    assert_found(
        SOUND,
        |set| change(set, Pass::Combined, |p| spread(p, &[0.25, 0.5, 0.25])),
        &["spread-noise"],
    );
}

#[test]
fn a_pixel_filter_that_is_too_wide() {
    assert_found(Render { filter: 6.0, ..SOUND }, |_| {}, &["wide-filter"]);
    assert_found(Render { filter: 8.0, ..SOUND }, |_| {}, &["wide-filter"]);
    // A camera out of focus blurs as much.
    let found = lint::frame(&Render { filter: 8.0, ..SOUND }.passes(), &About::default());
    assert!(
        found[0].message.contains("pixel filter") && found[0].message.contains("out of focus"),
        "{found:?}"
    );
}

#[test]
fn motion_blur_in_the_beauty_alone() {
    assert_found(Render { blur: 16.0, ..SOUND }, |_| {}, &["blur-in-beauty-alone"]);
}

#[test]
fn pixels_encoded_for_a_display() {
    let srgb = |set: &mut PassSet| each(set, Pass::Combined, curve);
    assert_found(SOUND, srgb, &["display-pixels"]);
    let with_a_lamp = |set: &mut PassSet| {
        srgb(set);
        change(set, Pass::Combined, |planes| planes.data[777..780].fill(2.0));
    };
    assert_found(SOUND, with_a_lamp, &["display-pixels"]);
    // Brighter, so that lamps' light is cut off: that is no clamp of samples.
    let clipped = |set: &mut PassSet| each(set, Pass::Combined, |v| (4.0 * v).min(1.0));
    assert_found(SOUND, clipped, &["display-pixels"]);
    let bright = |v: f32| f16::from_f32(curve(4.0 * v)).to_f32();
    assert_found(SOUND, |set| each(set, Pass::Combined, bright), &["display-pixels"]);
    let eight_bits = |set: &mut PassSet| {
        each(set, Pass::Combined, |v| f16::from_f32((255.0 * curve(v)).round() / 255.0).to_f32());
    };
    assert_found(SOUND, eight_bits, &["display-pixels", "eight-bit-pixels"]);
    for (space, expected) in [
        ("srgb_rec709_display", &["display-pixels"][..]),
        ("sRGB", &["display-pixels"]),
        ("lin_rec709_scene", &[]),
        ("ACEScg", &[]),
        ("scene_linear", &[]),
    ] {
        let about = About { colour_space: Some(space.into()), ..About::default() };
        assert_eq!(codes(&SOUND.passes(), &about), expected, "{space}");
    }
}

#[test]
fn missing_passes() {
    let about = About { missing: vec![Pass::DenoisingAlbedo], model: "demc-m".into(), ..About::default() };
    let mut set = SOUND.passes();
    set.remove(Pass::DenoisingAlbedo);
    let found = lint::frame(&set, &about);
    assert_eq!(found.len(), 1, "{found:?}");
    assert!(
        found[0].message.contains("without which demc-m loses detail")
            && found[0].remedy.contains("Denoising Data"),
        "{found:?}"
    );
}

#[test]
fn every_finding_has_a_remedy_and_small_frames_are_not_judged_as_pictures() {
    let frames = [
        Render { filter: 6.0, ..SOUND },
        Render { blur: 16.0, ..SOUND },
        Render { clamp: 1.0, ..SOUND },
        Render { albedo: 2.2, ..SOUND },
    ];
    for set in frames.map(|render| render.passes()) {
        let found = lint::frame(&set, &About::default());
        assert!(!found.is_empty() && found.iter().all(|finding| !finding.remedy.is_empty()), "{found:?}");
    }
    let small = Render { blur: 16.0, ..SOUND }.passes().window((0, 0), (128, 128));
    assert_eq!(codes(&small, &About::default()), [""; 0]);
}

/// Passes of a frame whose wall has moved, with vectors.
fn of_shot(render: Render) -> PassSet {
    let mut set = render.passes();
    let mut vectors = Planes::new(4, SIZE.0, SIZE.1);
    vectors.channel_mut(0).fill(-3.0);
    set.insert(Pass::Vector, vectors);
    set
}

fn codes_after(now: &PassSet, before: &PassSet) -> Vec<&'static str> {
    let found = Trace::of(now).after(&Trace::of(before), "shot.0001.exr");
    found.iter().map(|finding| finding.code).collect()
}

#[test]
fn frames_of_a_shot() {
    let [first, second] =
        [(1, 0.0), (2, 3.0)].map(|(seed, x)| of_shot(Render { seed, moved: (x, 0.0), ..SOUND }));
    assert_eq!(codes_after(&second, &first), [""; 0]);
    // One pattern of noise over the shot.
    let sticky = of_shot(Render { seed: 1, moved: (3.0, 0.0), ..SOUND });
    assert_eq!(codes_after(&sticky, &first), ["shared-noise"]);
    // Guides that stand still while things move.
    let mut frozen = second.clone();
    frozen.insert(Pass::DenoisingAlbedo, first.get(Pass::DenoisingAlbedo).unwrap().clone());
    assert_eq!(codes_after(&frozen, &first), ["frozen-guide"]);
    // Nothing moves: they may be the same.
    let still = |mut set: PassSet| {
        each(&mut set, Pass::Vector, |_| 0.0);
        set
    };
    assert_eq!(codes_after(&still(frozen), &still(first.clone())), [""; 0]);
    // It has moved, though vectors say that nothing does.
    let moved = of_shot(Render { seed: 2, moved: (6.0, 0.0), ..SOUND });
    assert_eq!(codes_after(&still(moved), &still(first.clone())), ["zero-vectors"]);
    let mut without = second;
    without.remove(Pass::Vector);
    assert_eq!(codes_after(&without, &first), ["missing-vectors"]);
    // No other renderer's motion is followed.
    without.renderer = RENDERERS.iter().find(|renderer| !renderer.is_blender()).unwrap();
    assert_eq!(codes_after(&without, &first), [""; 0]);
}

fn write(set: &PassSet, path: &Path) {
    let mut channels = Vec::new();
    for (pass, planes) in set.iter() {
        let components = if pass == Pass::DenoisingNormal { ["X", "Y", "Z"] } else { ["R", "G", "B"] };
        for (c, component) in components.iter().enumerate() {
            let name = format!("ViewLayer.{pass}.{component}");
            let samples = planes.channel(c).iter().map(|v| f16::from_f32(*v)).collect();
            channels.push(AnyChannel::new(name.as_str(), FlatSamples::F16(samples)));
        }
    }
    let layer = Layer::new(
        SIZE,
        LayerAttributes::default(),
        Encoding::SMALL_LOSSLESS,
        AnyChannels::sort(channels.into_iter().collect()),
    );
    Image::from_layer(layer).write().to_file(path).unwrap();
}

#[test]
fn inspect_prints_findings_with_their_remedies_and_as_json() {
    let folder = tempfile::tempdir().unwrap();
    write(&Render { blur: 16.0, ..SOUND }.passes(), &folder.path().join("shot.0001.exr"));
    write(&Render { blur: 16.0, moved: (3.0, 0.0), ..SOUND }.passes(), &folder.path().join("shot.0002.exr"));
    let inspect = || {
        let mut command = demc();
        command.arg("inspect").arg(folder.path());
        command
    };
    inspect()
        .assert()
        .success()
        .stdout(contains("warning (blur-in-beauty-alone): the beauty is blurred along rows"))
        .stdout(contains("turn off Render Properties > Motion Blur"))
        .stdout(contains("warning (shared-noise): ").and(contains("note (missing-vectors): ")));
    let output = inspect().arg("--json").assert().success().get_output().stdout.clone();
    let reports: Vec<serde_json::Value> =
        String::from_utf8(output).unwrap().lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let finding = &reports[0]["layers"][0]["findings"][0];
    assert_eq!(finding["code"], "blur-in-beauty-alone");
    assert!(finding["message"].is_string() && finding["remedy"].is_string(), "{finding}");
    assert_eq!(finding["harms"], true);
    let of_shot = &reports[1]["findings"];
    assert_eq!((&of_shot[0]["harms"], &of_shot[1]["harms"]), (&true.into(), &false.into()));
    let of_shot: Vec<&str> =
        reports[1]["findings"].as_array().unwrap().iter().map(|f| f["code"].as_str().unwrap()).collect();
    assert_eq!(of_shot, ["shared-noise", "missing-vectors"]);
}
