//! `demc denoise --temporal` on small sequences of a textured wall that moves by known vectors: what
//! neighbours contribute, what a result depends on, and what is said where a neighbour is of no use. The
//! metric of flicker is tested against numpy too.
//!
//! The method is `noisy`, which returns its input, so that only the combination of frames is tested.

mod common;

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command as Process,
};

use assert_cmd::Command;
use common::{
    BY,
    files::{bits, read_exr, samples, touch_later, values},
    python,
    shot::{SHOT, SIZE, Shot, random, write_channels},
    tables::table,
};
use demc::{
    metrics::flicker::{Pair, flicker},
    planes::Planes,
};
use exr::prelude::*;
use predicates::{prelude::*, str::contains};
use tempfile::TempDir;

/// A folder with `shot_0004spp.NNNN.exr` of these numbers.
fn sequence(shot: Shot, numbers: std::ops::RangeInclusive<i64>) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    numbers.for_each(|number| shot.write(&named(&dir, number), number));
    dir
}

fn named(dir: &TempDir, number: i64) -> PathBuf {
    dir.path().join(format!("shot_0004spp.{number:04}.exr"))
}

fn demc(out: &Path) -> Command {
    let mut command = Command::cargo_bin("demc").unwrap();
    command.args(["denoise", "--model", "noisy", "--out"]).arg(out);
    command
}

/// Where a frame's result lies.
fn result(out: &Path, number: i64) -> PathBuf {
    out.join(format!("shot_0004spp.{number:04}.exr"))
}

/// The planes of a layer, (3, H, W).
fn planes(file: &Path, layer: &str, components: &[&str]) -> Planes {
    let image = read_exr(file);
    let all = components.iter().flat_map(|c| values(&image, &format!("ViewLayer.{layer}.{c}")));
    Planes::from_vec(components.len(), SIZE.0, SIZE.1, all.collect())
}

/// The bits of a result.
fn denoised(out: &Path, number: i64) -> Vec<Vec<u32>> {
    let image = read_exr(result(out, number));
    ["R", "G", "B"].map(|c| bits(samples(&image, &format!("ViewLayer.Denoised.{c}")).unwrap())).into()
}

#[test]
fn neighbours_take_noise_away_along_the_motion() {
    // The last goes to the right by -8, -4, 0 and 4 pixels, and falls by -4, 0, 4 and 8.
    let bent = Shot { speed: -16.0, fall: -12.0, acceleration: 4.0, ..SHOT };
    for shot in [SHOT, Shot { speed: -1.0, ..SHOT }, Shot { speed: 0.0, ..SHOT }, bent] {
        let dir = sequence(shot, 1..=5);
        let (alone, with) = (dir.path().join("alone"), dir.path().join("with"));
        demc(&alone).arg(dir.path()).assert().success();
        let mut before = shot.error(&result(&alone, 3), "ViewLayer.Denoised", 3);
        // Further away, frames add their results alone, not their renders.
        for (reach, share) in [("1", 0.9), ("2", 0.9), ("3", 0.95)] {
            demc(&with).arg(dir.path()).args(["--overwrite", "--temporal", reach]).assert().success();
            let error = shot.error(&result(&with, 3), "ViewLayer.Denoised", 3);
            assert!(error < share * before, "{reach} each side: {error} after {before}");
            before = error;
        }
        // Two on each side without a number.
        let two = dir.path().join("two");
        demc(&two).arg(dir.path()).arg("--temporal").assert().success();
        demc(&with).arg(dir.path()).args(["--overwrite", "--temporal", "2"]).assert().success();
        (1..=5).for_each(|frame| assert_eq!(denoised(&two, frame), denoised(&with, frame)));
    }
}

#[test]
fn networks_gain_from_neighbours_whose_light_differs() {
    let shot = Shot { flicker: 0.15, ..SHOT };
    let dir = sequence(shot, 1..=5);
    let error = |name: &str, more: &[&str]| {
        let out = dir.path().join(name);
        let mut command = common::demc();
        command.args(["denoise", "--model", "demc-s", "--out"]).arg(&out).arg(dir.path());
        command.args(more).assert().success();
        shot.error(&result(&out, 3), "ViewLayer.Denoised", 3)
    };
    let (alone, with) = (error("alone", &[]), error("with", &["--temporal"]));
    assert!(with < 0.9 * alone, "{with} after {alone}");
}

#[test]
fn a_result_is_the_same_bits_in_any_order_alone_and_resumed() {
    let dir = sequence(SHOT, 8..=13);
    let [whole, other] = ["whole", "other"].map(|name| dir.path().join(name));
    demc(&whole).arg(dir.path()).arg("--temporal").assert().success();
    let same = |what: &str| {
        (8..=13).for_each(|n| assert_eq!(denoised(&whole, n), denoised(&other, n), "{what}, frame {n}"));
    };
    // Each by itself, as a farm would, on other threads; its neighbours are found beside it.
    for n in [12, 8, 13, 10, 9, 11] {
        demc(&other).arg(named(&dir, n)).args(["--temporal", "--threads", "1"]).assert().success();
    }
    same("one by one");
    fs::remove_dir_all(&other).unwrap();
    demc(&other).args([13, 9, 11, 8, 12, 10].map(|n| named(&dir, n))).arg("--temporal").assert().success();
    same("in another order");
    for gone in [9, 10, 13] {
        fs::remove_file(result(&other, gone)).unwrap();
    }
    let resumed = demc(&other).arg(dir.path()).arg("--temporal").assert().success();
    resumed.stdout(contains("3 denoised, 3 already there"));
    same("resumed");
}

#[test]
fn results_older_than_a_frame_beside_theirs_are_told() {
    let dir = sequence(SHOT, 1..=4);
    let out = dir.path().join("out");
    demc(&out).arg(dir.path()).arg("--temporal=1").assert().success();
    touch_later(&named(&dir, 1));
    let again = demc(&out).arg(dir.path()).arg("--temporal=1").assert().success();
    let told = String::from_utf8_lossy(&again.get_output().stderr).into_owned();
    let notes: Vec<&str> = told.lines().filter(|line| line.contains("is older than")).collect();
    assert_eq!(notes.len(), 2, "{told}");
    assert!(notes[0].contains("0001.exr: is older than its render"), "{told}");
    assert!(notes[1].contains("0002.exr: is older than a frame beside its render"), "{told}");
}

#[test]
fn a_frame_that_was_made_without_another_is_made_again_when_that_is_there() {
    let dir = sequence(SHOT, 1..=8);
    let [whole, mended] = ["whole", "mended"].map(|name| dir.path().join(name));
    demc(&whole).arg(dir.path()).arg("--temporal").assert().success();
    let render = fs::read(named(&dir, 4)).unwrap();
    // Half written at first, and a frame at the end that nobody has rendered yet.
    fs::write(named(&dir, 4), &render[..render.len() / 2]).unwrap();
    let last = fs::read(named(&dir, 8)).unwrap();
    fs::remove_file(named(&dir, 8)).unwrap();
    demc(&mended).arg(dir.path()).arg("--temporal").assert().code(1);
    (2..=6)
        .filter(|n| *n != 4)
        .for_each(|n| assert!(denoised(&whole, n) != denoised(&mended, n), "frame {n}"));
    let again = || demc(&mended).arg(dir.path()).arg("--temporal").assert();
    again().code(1).stdout(contains("0 denoised, 6 already there"));
    fs::write(named(&dir, 4), &render).unwrap();
    fs::write(named(&dir, 8), &last).unwrap();
    // All but the first, whose window holds neither.
    again().success().stdout(contains("7 denoised, 1 already there"));
    (1..=8).for_each(|n| {
        assert!(fs::read(result(&whole, n)).unwrap() == fs::read(result(&mended, n)).unwrap(), "{n}")
    });
    again().success().stdout(contains("0 denoised, 8 already there"));
}

#[test]
fn a_result_that_wants_a_frame_beside_it_is_no_other_that_is_wanted() {
    let dir = sequence(SHOT, 1..=4);
    let last = fs::read(named(&dir, 4)).unwrap();
    fs::remove_file(named(&dir, 4)).unwrap();
    let out = dir.path().join("out");
    let run = |arguments: &str| {
        let frames = "--frames 1-3 --temporal 1".split_whitespace();
        demc(&out).arg(dir.path()).args(frames).args(arguments.split_whitespace()).assert()
    };
    run("--layer A").success();
    fs::write(named(&dir, 4), last).unwrap();
    let all = || [1, 2, 3].map(|n| fs::read(result(&out, n)).unwrap());
    let before = all();
    // Frame 3 was made without frame 4, but as another layer and by another method.
    run("--layer B").code(1).stderr(contains("exists without 'ViewLayer.B'")).stdout(contains("3 failed"));
    run("--replace").code(1).stdout(contains("3 failed"));
    let told = run("--layer A --wrap x").success().stdout(contains("0 denoised, 3 already there"));
    let why = format!("shot_0004spp.0003.exr: was made with {BY} --model noisy --temporal 1, and was kept");
    told.stderr(contains(why));
    assert!(before == all());
    run("--layer A").success().stdout(contains("1 denoised, 2 already there"));
}

#[test]
fn what_a_result_was_made_with_is_noted_of_each_layer() {
    let dir = sequence(SHOT, 1..=3);
    let [first, second] = ["first", "second"].map(|name| dir.path().join(name));
    let run = |out: &Path, input: &Path, arguments: &str| {
        demc(out).arg(input).args(arguments.split_whitespace()).assert()
    };
    run(&first, dir.path(), "--layer A").success();
    run(&second, &first, "--layer B --temporal 1").success();
    let lacking = contains("exists without its neighbours (--temporal 1)");
    run(&second, dir.path(), "--layer A --temporal 1").code(1).stderr(lacking.clone());
    run(&second, dir.path(), "--layer B --temporal 1").success().stdout(contains("3 already there"));
    // A frame by frame result takes nothing from what is known of the other.
    let third = dir.path().join("third");
    run(&third, &second, "--layer C").success();
    run(&third, dir.path(), "--layer B --temporal 1").success().stdout(contains("3 already there"));
    run(&third, dir.path(), "--layer C --temporal 1").code(1).stderr(lacking);
    // Whoever leaves neighbours out wants them out.
    let told = run(&third, dir.path(), "--layer B").success();
    told.stderr(contains(format!("was made with {BY} --model noisy --temporal 1, and was kept")));
}

#[test]
fn a_result_depends_on_its_window_alone() {
    let dir = sequence(SHOT, 1..=7);
    let [first, second] = ["first", "second"].map(|name| dir.path().join(name));
    demc(&first).arg(dir.path()).arg("--temporal").assert().success();
    Shot { seed: 9, ..SHOT }.write(&named(&dir, 6), 6);
    demc(&second).arg(dir.path()).arg("--temporal").assert().success();
    for n in 1..=7 {
        assert_eq!(denoised(&first, n) == denoised(&second, n), n < 4, "frame {n}");
    }
}

#[test]
fn ends_gaps_and_frames_that_do_not_fit_are_told() {
    let dir = sequence(SHOT, 9..=11);
    let out = dir.path().join("out");
    // 12 is of another size; 14 and 15 are of another shot; 16 is missing, 17 no EXR, 19 has nobody.
    Shot { size: (40, 36), ..SHOT }.write(&named(&dir, 12), 12);
    SHOT.write(&named(&dir, 13), 13);
    let cut = Shot { scene: 1, ..SHOT };
    [14, 15].into_iter().for_each(|n| cut.write(&named(&dir, n), n));
    fs::write(named(&dir, 17), "no EXR").unwrap();
    cut.write(&named(&dir, 19), 19);
    let assert = demc(&out).arg(dir.path()).arg("--temporal").assert().code(1);
    let text = String::from_utf8(assert.get_output().stderr.clone()).unwrap();
    let of = |n: i64| -> String {
        let name = format!("note: {}", named(&dir, n).display());
        text.lines().filter(|line| line.contains(&name)).collect()
    };
    for (n, parts) in [
        (9, vec!["frame 8 is not there", "with those that are left"]),
        (11, vec!["frame 12 is of another size", "with those that are left"]),
        (12, vec!["frame 11 is of another size", "frame 13 is of another size", "alone"]),
        (13, vec!["frame 12 is of another size", "frame 14 shows another picture: a cut", "alone"]),
        (14, vec!["frame 13 shows another picture: a cut", "with those that are left"]),
        (15, vec!["frame 16 is not there"]),
        (19, vec!["frame 18 is not there", "frame 20 is not there", "alone"]),
    ] {
        parts.iter().for_each(|part| assert!(of(n).contains(part), "frame {n}, '{part}': {text}"));
    }
    assert_eq!(of(10), "", "its window is full: {text}");
    assert!(text.contains("0017.exr"), "{text}");
    // What is alone is as without the option.
    let alone = dir.path().join("alone");
    demc(&alone).arg(dir.path()).assert().code(1);
    [12, 13, 19].into_iter().for_each(|n| assert_eq!(denoised(&out, n), denoised(&alone, n), "frame {n}"));
    // A neighbour that cannot be read.
    cut.write(&named(&dir, 18), 18);
    let assert = demc(&out).arg(named(&dir, 18)).arg("--temporal").assert().success();
    assert.stderr(contains("frame 17 cannot be used"));
}

#[test]
fn frames_without_vectors_are_done_alone_and_blender_is_told_how() {
    for (shot, said) in [
        (
            Shot { vectors: false, ..SHOT },
            "no pass Vector; turn on View Layer Properties > Passes > Data > Vector",
        ),
        (Shot { vector_scale: 0.0, speed: 9.0, ..SHOT }, "turn off Render Properties > Motion Blur"),
    ] {
        let dir = sequence(shot, 1..=3);
        let [out, alone] = ["out", "alone"].map(|name| dir.path().join(name));
        demc(&alone).arg(dir.path()).assert().success();
        let assert = demc(&out).arg(dir.path()).arg("--temporal").assert().success();
        assert.stderr(contains(said).and(contains("denoised alone")));
        (1..=3).for_each(|n| assert_eq!(denoised(&out, n), denoised(&alone, n), "{said}"));
    }
}

#[test]
fn a_shadow_that_vectors_do_not_know_is_not_dragged() {
    let shot = Shot { speed: 0.0, shadow: Some(10.0), ..SHOT };
    let dir = sequence(shot, 1..=5);
    let [out, alone] = ["out", "alone"].map(|name| dir.path().join(name));
    demc(&alone).arg(dir.path()).assert().success();
    // An input after it would be its number.
    let said = demc(&out).arg("--temporal").arg(dir.path()).assert().code(2).get_output().stderr.clone();
    assert!(String::from_utf8(said).unwrap().contains("name inputs before it"));
    demc(&out).arg(dir.path()).arg("--temporal").assert().success();
    for n in 1..=5 {
        let [with, without] = [&out, &alone].map(|dir| shot.error(&result(dir, n), "ViewLayer.Denoised", n));
        assert!(with < 0.7 * without, "frame {n}: {with} beside {without}");
    }
}

#[test]
fn light_that_flickers_stays_as_it_is() {
    for flicker in [0.08, 0.15, 0.4] {
        let shot = Shot { flicker, ..SHOT };
        let dir = sequence(shot, 1..=5);
        let [out, alone] = ["out", "alone"].map(|name| dir.path().join(name));
        demc(&alone).arg(dir.path()).assert().success();
        let said =
            demc(&out).arg(dir.path()).arg("--temporal").assert().success().get_output().stderr.clone();
        // Frames next to one whose light is all but another's are left out.
        let is_left_out = flicker > 0.3;
        assert_eq!(String::from_utf8(said).unwrap().contains("times as bright"), is_left_out, "{flicker}");
        for n in 2..=4 {
            let [with, without] =
                [&out, &alone].map(|dir| shot.error(&result(dir, n), "ViewLayer.Denoised", n));
            assert!(
                with < if is_left_out { 1.01 } else { 0.7 } * without,
                "{flicker}, {n}: {with} beside {without}"
            );
            let mean = |of: &dyn Fn(usize) -> f32| (0..SIZE.0 * SIZE.1).map(of).sum::<f32>();
            let image = read_exr(result(&out, n));
            let got = values(&image, "ViewLayer.Denoised.G");
            let level = mean(&|i| got[i]) / mean(&|i| shot.truth(1, i, n));
            assert!((level - 1.0).abs() < 0.02, "{flicker}, frame {n}: {level}");
        }
    }
}

#[test]
fn narrow_light_that_moves_by_its_width_leaves_no_ghost() {
    for spread in [0.4, 0.1, 0.02] {
        let shot = Shot { speed: 0.0, bars: true, spread, ..SHOT };
        let dir = sequence(shot, 1..=5);
        let [out, alone] = ["out", "alone"].map(|name| dir.path().join(name));
        demc(&alone).arg(dir.path()).assert().success();
        demc(&out).arg(dir.path()).arg("--temporal").assert().success();
        let [with, without] = [&out, &alone].map(|dir| shot.error(&result(dir, 3), "ViewLayer.Denoised", 3));
        assert!(with < 1.2 * without, "{spread}: {with} beside {without}");
    }
}

#[test]
fn a_copy_of_a_frame_that_vectors_say_moved_is_told_and_left_out() {
    let dir = sequence(SHOT, 1..=3);
    fs::copy(named(&dir, 2), named(&dir, 3)).unwrap();
    let [out, alone] = ["out", "alone"].map(|name| dir.path().join(name));
    demc(&alone).arg(named(&dir, 3)).assert().success();
    let run = demc(&out).arg(named(&dir, 3)).args(["--temporal", "1"]).assert().success();
    run.stderr(contains("frame 2 holds the same picture to the bit, though Vector tells of motion"));
    assert_eq!(denoised(&out, 3), denoised(&alone, 3));
    // Of a still camera, copies do no harm.
    let dir = sequence(Shot { speed: 0.0, ..SHOT }, 1..=2);
    fs::copy(named(&dir, 1), named(&dir, 2)).unwrap();
    let run = demc(&out).arg(named(&dir, 2)).args(["--temporal", "1", "--overwrite"]).assert().success();
    run.stderr(contains("to the bit").not());
}

#[test]
fn a_lamp_leaves_nothing_where_it_was_nor_where_it_will_be() {
    let shot = Shot { speed: 0.0, lamp: 1e5, ..SHOT };
    let dir = sequence(shot, 0..=3);
    let out = dir.path().join("out");
    demc(&out).arg(dir.path()).arg("--temporal").assert().success();
    for n in 0..=3 {
        let image = read_exr(result(&out, n));
        let got = values(&image, "ViewLayer.Denoised.R");
        let elsewhere = (0..got.len()).filter(|i| !shot.is_lamp(*i, n));
        let most = elsewhere.map(|i| got[i]).fold(0.0, f32::max);
        assert!(most < 2.0, "frame {n}: {most}");
    }
}

#[test]
fn nothing_comes_into_what_was_not_rendered() {
    let dir = tempfile::tempdir().unwrap();
    let is_inside = |i: usize, n: i64| (8 + 4 * n as usize..28 + 4 * n as usize).contains(&(i % SIZE.0));
    for n in 0..=3 {
        let channels = SHOT.channels("ViewLayer", "", n).into_iter().map(|mut channel| {
            if let FlatSamples::F32(values) = &mut channel.sample_data {
                let outside = values.iter_mut().enumerate().filter(|(i, _)| !is_inside(*i, n));
                outside.for_each(|(_, v)| *v = 0.0);
            }
            channel
        });
        write_channels(&named(&dir, n), SIZE, channels.collect(), &[]);
    }
    let out = dir.path().join("out");
    demc(&out).arg(dir.path()).arg("--temporal").assert().success();
    for n in 0..=3 {
        let image = read_exr(result(&out, n));
        let got = values(&image, "ViewLayer.Denoised.G");
        assert!((0..got.len()).all(|i| (got[i] != 0.0) == is_inside(i, n)), "frame {n}");
    }
}

#[test]
fn where_a_transparent_film_is_empty_nothing_comes_from_neighbours_either() {
    let dir = tempfile::tempdir().unwrap();
    let is_covered = |i: usize| (16..30).contains(&(i % SIZE.0));
    for n in 1..=3 {
        let mut channels = SHOT.channels("ViewLayer", "", n);
        for channel in &mut channels {
            if let FlatSamples::F32(values) = &mut channel.sample_data {
                values.iter_mut().enumerate().filter(|(i, _)| !is_covered(*i)).for_each(|(_, v)| *v = 0.0);
            }
        }
        let alpha = (0..SIZE.0 * SIZE.1).map(|i| f32::from(u8::from(is_covered(i)))).collect();
        channels.push(AnyChannel::new("ViewLayer.Combined.A", FlatSamples::F32(alpha)));
        write_channels(&named(&dir, n), SIZE, channels, &[]);
    }
    let [with, alone] = ["with", "alone"].map(|name| dir.path().join(name));
    let network = |out: &Path, input: &Path, arguments: &[&str]| {
        let mut command = Command::cargo_bin("demc").unwrap();
        command.args(["denoise", "--model", "demc-s", "--out"]).args([out, input]).args(arguments);
        command.assert().success();
    };
    network(&with, dir.path(), &["--temporal"]);
    network(&alone, dir.path(), &[]);
    for out in [&with, &alone] {
        let image = read_exr(result(out, 2));
        let green = values(&image, "ViewLayer.Denoised.G");
        let is_far = |i: usize| !(13..33).contains(&(i % SIZE.0));
        assert!((0..green.len()).all(|i| if is_covered(i) {
            green[i] > 0.0
        } else {
            !is_far(i) || green[i] == 0.0
        }));
    }
    assert!(denoised(&with, 2) != denoised(&alone, 2), "neighbours count");
}

#[test]
fn alpha_is_averaged_with_that_of_neighbours() {
    let dir = tempfile::tempdir().unwrap();
    let shot = Shot { speed: 0.0, ..SHOT };
    let truth = |i: usize| if (14..34).contains(&(i % SIZE.0)) { 0.5 } else { 0.0 };
    for n in 1..=5 {
        let covers = |i: usize, sample: u32| random([n as u32, i as u32, sample]) < truth(i);
        let share = |i: usize| (0..4).filter(|sample| covers(i, *sample)).count() as f32 / 4.0;
        let alpha: Vec<f32> = (0..SIZE.0 * SIZE.1).map(share).collect();
        let mut channels = shot.channels("ViewLayer", "", n);
        for channel in &mut channels {
            if let FlatSamples::F32(values) = &mut channel.sample_data
                && channel.name.to_string().contains("Combined")
            {
                values.iter_mut().zip(&alpha).for_each(|(value, alpha)| *value *= alpha);
            }
        }
        channels.push(AnyChannel::new("ViewLayer.Combined.A", FlatSamples::F32(alpha)));
        write_channels(&named(&dir, n), SIZE, channels, &[]);
    }
    let alpha = |file: &Path, layer: &str| planes(file, layer, &["A"]).data.to_vec();
    let error = |alpha: &[f32]| alpha.iter().enumerate().map(|(i, a)| (a - truth(i)).powi(2)).sum::<f32>();
    let out = dir.path().join("out");
    let of = |arguments: &[&str]| {
        let mut command = Command::cargo_bin("demc").unwrap();
        command.args(["denoise", "--model", "demc-s", "--overwrite", "--out"]).args([&out, dir.path()]);
        command.args(arguments).assert().success();
        alpha(&result(&out, 3), "Denoised")
    };
    let rendered = alpha(&named(&dir, 3), "Combined");
    let errors = [&rendered, &of(&[]), &of(&["--temporal", "1"]), &of(&["--temporal"])].map(|a| error(a));
    assert!(errors.is_sorted_by(|before, after| *after < 0.9 * before), "{errors:?}");
    assert!(of(&["--temporal", "--alpha", "denoise"]) == of(&["--temporal"]));
    assert!(of(&["--temporal", "--alpha", "keep"]) == rendered);
    // A still among them is denoised alone.
    fs::copy(named(&dir, 3), dir.path().join("still.exr")).unwrap();
    let still = |arguments: &[&str]| {
        of(arguments);
        alpha(&out.join("still.exr"), "Denoised")
    };
    assert!(still(&["--temporal"]) == still(&[]));
}

/// Writes a frame that tells how many samples it had, with other noise.
fn write_sampled(shot: Shot, path: &Path, frame: i64, samples: u32, noise: impl Fn(usize) -> f32) {
    let mut attributes = LayerAttributes::default();
    let samples = exr::meta::attribute::AttributeValue::Text(samples.to_string().as_str().into());
    attributes.other.insert("cycles.ViewLayer.samples".into(), samples);
    let channels = shot.channels("ViewLayer", "", frame).into_iter().map(|mut channel| {
        if let Some(c) =
            ["R", "G", "B"].iter().position(|c| channel.name.eq(&format!("ViewLayer.Combined.{c}")))
        {
            let light = (0..shot.size.0 * shot.size.1).map(|i| shot.truth(c, i, frame) * noise(i));
            channel.sample_data = FlatSamples::F32(light.collect());
        }
        channel
    });
    let channels = AnyChannels::sort(channels.collect());
    let layer = Layer::new(shot.size, attributes, Encoding::SMALL_LOSSLESS, channels);
    Image::from_layer(layer).write().to_file(path).unwrap();
}

#[test]
fn frames_of_other_numbers_of_samples_are_no_other_light() {
    let shot = Shot { speed: 0.0, size: (96, 72), ..SHOT };
    let dir = tempfile::tempdir().unwrap();
    for frame in 1..=5 {
        // The noise of so many samples: few are bright, and most are dark.
        let samples = if frame == 3 { 16 } else { 4 };
        let of_one = |n: u32, i: usize| -(1.0 - random([n, frame as u32, i as u32])).ln();
        let noise = |i: usize| (0..samples / 4).map(|n| of_one(n, i)).sum::<f32>() / (samples / 4) as f32;
        write_sampled(shot, &named(&dir, frame), frame, samples, noise);
    }
    let [out, alone] = ["out", "alone"].map(|name| dir.path().join(name));
    demc(&alone).arg(dir.path()).assert().success();
    demc(&out).arg(dir.path()).arg("--temporal").assert().success();
    for n in 2..=4 {
        let [with, without] = [&out, &alone].map(|dir| {
            let light = values(&read_exr(result(dir, n)), "ViewLayer.Denoised.G");
            light.iter().sum::<f32>() / (0..light.len()).map(|i| shot.truth(1, i, n)).sum::<f32>()
        });
        assert!((with / without - 1.0).abs() < 0.04, "frame {n}: {with} beside {without}");
    }
    // One that has no noise at all is no cut, nor is motion blur to be turned off.
    write_sampled(shot, &named(&dir, 3), 3, 4096, |_| 1.0);
    let said = demc(&out).arg(dir.path()).args(["--temporal", "--overwrite"]).assert().success();
    said.stderr(contains("Motion Blur").not());
}

#[test]
fn frames_that_lack_a_pass_are_told_and_so_is_what_a_model_does_without() {
    let dir = tempfile::tempdir().unwrap();
    let write = |frame: i64, has_albedo: bool| {
        let mut channels = SHOT.channels("ViewLayer", "", frame);
        channels.retain(|channel| has_albedo || !channel.name.to_string().contains("Albedo"));
        common::shot::write_channels(&named(&dir, frame), SIZE, channels, &[]);
    };
    let told = |reach: &str| {
        let out = dir.path().join("out");
        let mut command = common::demc();
        command.args(["denoise", "--model", "demc-s", "--overwrite", "--temporal", reach]);
        let run = command.arg(dir.path()).arg("--out").arg(out).assert().success();
        String::from_utf8(run.get_output().stderr.clone()).unwrap()
    };
    (1..=3).for_each(|frame| write(frame, false));
    let text = told("1");
    assert_eq!(text.matches("without Denoising Albedo").count(), 3, "{text}");
    write(1, true);
    write(3, true);
    let text = told("1");
    assert_eq!(text.matches("holds other passes").count(), 4, "{text}"); // of both frames beside the second
    assert!(!text.contains("a cut"), "{text}");
}

#[test]
fn a_frame_of_more_samples_takes_little_of_those_of_fewer() {
    let dir = sequence(SHOT, 1..=5);
    // A noisier render of fewer samples would take from the noiseless one what it can.
    write_sampled(SHOT, &named(&dir, 3), 3, 4096, |_| 1.0);
    let out = dir.path().join("out");
    demc(&out).arg(dir.path()).arg("--temporal").assert().success();
    let error = SHOT.error(&result(&out, 3), "ViewLayer.Denoised", 3);
    assert!(error < 1e-5, "{error}");
    let alone = dir.path().join("alone");
    demc(&alone).arg(named(&dir, 2)).assert().success();
    let [with, without] = [&out, &alone].map(|dir| SHOT.error(&result(dir, 2), "ViewLayer.Denoised", 2));
    assert!(with < 0.7 * without, "{with} beside {without}");
}

#[test]
fn results_of_single_frames_are_not_taken_for_those_with_neighbours() {
    let dir = sequence(SHOT, 1..=3);
    let out = dir.path().join("out");
    demc(&out).arg(dir.path()).assert().success();
    let refused = demc(&out).arg(dir.path()).arg("--temporal").assert().code(1);
    refused.stderr(contains("exists without its neighbours (--temporal 2)").and(contains("--overwrite")));
    demc(&out).arg(dir.path()).args(["--temporal", "1", "--overwrite"]).assert().success();
    demc(&out).arg(dir.path()).args(["--temporal", "2"]).assert().code(1);
    demc(&out).arg(dir.path()).args(["--temporal", "1"]).assert().success();
    demc(&out).arg(dir.path()).assert().success().stdout(contains("3 already there"));
}

#[test]
fn frames_beside_one_that_cannot_be_used_are_done_once() {
    let dir = sequence(SHOT, 1..=4);
    // It reads well, but has not this view layer.
    write_channels(&named(&dir, 3), SIZE, SHOT.channels("Other", "", 3), &[]);
    let out = dir.path().join("out");
    let arguments = ["--temporal", "--view-layer", "ViewLayer"];
    demc(&out).arg(dir.path()).args(arguments).assert().code(1).stderr(contains("frame 3 cannot be used"));
    let again = demc(&out).arg(dir.path()).args(arguments).assert().code(1);
    again.stdout(contains("0 denoised, 3 already there"));
}

#[test]
fn view_layers_and_stereo_views_follow_their_own_vectors() {
    let [left, right] = [SHOT, Shot { speed: -3.0, seed: 5, ..SHOT }];
    let dir = tempfile::tempdir().unwrap();
    for n in 1..=5 {
        let stereo =
            [left.channels("ViewLayer", "left.", n), right.channels("ViewLayer", "right.", n)].concat();
        write_channels(&dir.path().join(format!("stereo.{n:04}.exr")), SIZE, stereo, &["left", "right"]);
        let layers = [left.channels("Front", "", n), right.channels("Back", "", n)].concat();
        write_channels(&dir.path().join(format!("layers.{n:04}.exr")), SIZE, layers, &[]);
    }
    let [out, alone] = ["out", "alone"].map(|name| dir.path().join(name));
    let run = |input: &str, more: &[&str]| {
        let input = dir.path().join(input);
        demc(&alone).arg(&input).args(["--overwrite"]).args(more).assert().success();
        demc(&out).arg(&input).args(["--overwrite", "--temporal"]).args(more).assert().success();
    };
    let check = |shot: Shot, file: &str, layer: &str| {
        let [with, without] = [&out, &alone].map(|dir| shot.error(&dir.join(file), layer, 3));
        assert!(with < 0.5 * without, "{layer}: {with} beside {without}");
    };
    run("stereo.0003.exr", &[]);
    check(left, "stereo.0003.exr", "ViewLayer.Denoised.left");
    check(right, "stereo.0003.exr", "ViewLayer.Denoised.right");
    for (shot, layer) in [(left, "Front"), (right, "Back")] {
        run("layers.0003.exr", &["--view-layer", layer]);
        check(shot, "layers.0003.exr", &format!("{layer}.Denoised"));
    }
}

#[test]
fn stills_and_single_frames_are_denoised_as_ever() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    SHOT.write(&dir.path().join("still.exr"), 1);
    SHOT.write(&dir.path().join("other7.exr"), 1);
    let assert = demc(&out).arg(dir.path()).args(["--temporal", "1"]).assert().success();
    assert.stderr(contains("its name ends in no frame number").and(contains("frame 6 is not there")));
    for name in ["still.exr", "other7.exr"] {
        let image = read_exr(out.join(name));
        assert_eq!(values(&image, "ViewLayer.Denoised.R"), values(&image, "ViewLayer.Combined.R"));
    }
}

/// What `demc eval` says of a sequence is what `demc denoise` makes of it, frame by frame and with
/// neighbours; a frame that is scored later, when the one before it is there already, gets the same score.
#[test]
fn a_sequence_is_scored_as_it_is_denoised() {
    let dir = sequence(SHOT, 1..=4);
    let reference = |n: i64| dir.path().join(format!("shot_ref.{n:04}.exr"));
    (1..=4).for_each(|n| write_truth(&reference(n), n));
    let out = dir.path().join("report");
    let eval = || {
        let mut command = Command::cargo_bin("demc").unwrap();
        command.args(["eval", "--models", "demc-s", "--temporal", "--repeats", "1", "--test-set"]);
        command.arg(dir.path()).arg("--out").arg(&out).assert().success();
        table(&out.join("scores.csv"))
    };
    let rows = eval();
    assert_eq!(rows.len(), 4 * 3, "frames, and the methods noisy, demc-s and demc-s:temporal");
    for (model, arguments) in [("demc-s", &[][..]), ("demc-s:temporal", &["--temporal"])] {
        let folder = dir.path().join(model.replace(':', "_"));
        let mut command = Command::cargo_bin("demc").unwrap();
        command.args(["denoise", "--model", "demc-s"]).args(arguments).arg("--out").arg(&folder);
        command.arg(dir.path().join("shot_0004spp.*.exr")).assert().success();
        let colours = ["R", "G", "B"];
        let image = |n: i64| planes(&result(&folder, n), "Denoised", &colours);
        let truth = |n: i64| planes(&reference(n), "Combined", &colours);
        for n in 1..=4 {
            let row = rows.iter().find(|row| row["model"] == model && row["scene"].ends_with(&n.to_string()));
            let told = row.unwrap()["flicker"].parse::<f64>().ok();
            if n == 1 {
                assert_eq!(told, None, "nothing comes before the first frame");
                continue;
            }
            let vectors = planes(&named(&dir, n), "Vector", &["X", "Y", "Z", "W"]);
            let (images, references) = ([image(n), image(n - 1)], [truth(n), truth(n - 1)]);
            let pair =
                Pair { images: images.each_ref(), references: references.each_ref(), vectors: &vectors };
            let expected = flicker(&pair).unwrap();
            assert!((told.unwrap() / expected - 1.0).abs() < 1e-4, "{model}, {n}: {told:?}, {expected}");
        }
    }
    let path = out.join("scores.csv");
    let text = fs::read_to_string(&path).unwrap();
    let kept: Vec<&str> = text.lines().filter(|line| !line.starts_with("shot.0003,demc-s")).collect();
    fs::write(&path, kept.join("\n") + "\n").unwrap();
    let again = eval();
    for (before, after) in rows.iter().zip(&again) {
        assert_eq!(before["flicker"], after["flicker"], "{before:?}");
    }
    let page = fs::read_to_string(out.join("report.html")).unwrap();
    assert!(page.contains("class=\"stepper\"") && page.contains("demc-s:temporal"));
    assert!(out.join("slices/shot_0004spp.png").is_file() && out.join("bars_flicker.svg").is_file());
}

/// Writes a frame of the shot without noise.
fn write_truth(path: &Path, frame: i64) {
    let channel = |(c, name): (usize, &str)| {
        let truth = (0..SIZE.0 * SIZE.1).map(|i| SHOT.truth(c, i, frame)).collect();
        AnyChannel::new(format!("ViewLayer.Combined.{name}").as_str(), FlatSamples::F32(truth))
    };
    let list = ["R", "G", "B"].into_iter().enumerate().map(channel).collect();
    write_channels(path, SIZE, list, &[]);
}

#[test]
fn noise_seeds_of_a_frame_are_no_frames_beside_it() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    write_truth(&at("truth.exr"), 1);
    for seed in 1..=3u32 {
        Shot { seed, ..SHOT }.write(&at(&format!("shot_0004spp_n{seed}.exr")), 1);
    }
    let lines: String = (1..=3).map(|n| format!("shot,shot_0004spp_n{n}.exr,truth.exr,4\n")).collect();
    fs::write(at("set.csv"), format!("scene,noisy,reference,spp\n{lines}")).unwrap();
    let mut command = Command::cargo_bin("demc").unwrap();
    command.args(["eval", "--models", "demc-s", "--temporal", "--repeats", "1", "--no-sheets", "--test-set"]);
    command.arg(at("set.csv")).arg("--out").arg(at("out")).assert().success();
    let rows = table(&at("out").join("scores.csv"));
    let of = |model: &str| {
        let own = rows.iter().filter(|row| row["model"] == model);
        own.map(|row| (row["relmse"].clone(), row["flicker"].clone())).collect::<Vec<_>>()
    };
    assert_eq!((of("demc-s").len(), of("demc-s")), (3, of("demc-s:temporal")));
    assert!(rows.iter().all(|row| row["flicker"].is_empty()));
}

#[test]
fn flicker_after_a_frame_that_is_not_finite_is_not_told() {
    let dir = sequence(SHOT, 1..=3);
    (1..=3).for_each(|n| write_truth(&dir.path().join(format!("shot_ref.{n:04}.exr")), n));
    let mut channels = SHOT.channels("ViewLayer", "", 2);
    let FlatSamples::F32(red) = &mut channels[0].sample_data else { unreachable!("all are floats") };
    red[SIZE.0 * 18 + 24] = f32::NAN;
    write_channels(&named(&dir, 2), SIZE, channels, &[]);
    let mut command = Command::cargo_bin("demc").unwrap();
    command.args(["eval", "--models", "noisy", "--repeats", "1", "--no-sheets", "--test-set"]);
    command.arg(dir.path()).arg("--out").arg(dir.path().join("out")).assert().code(1);
    let rows = table(&dir.path().join("out/scores.csv"));
    let last = rows.iter().find(|row| row["scene"].ends_with('3')).unwrap();
    assert!(
        last["flicker"].is_empty() && last["note"].contains("no flicker: of the frame before"),
        "{last:?}"
    );
}

#[test]
fn flicker_is_what_numpy_says() {
    let dir = tempfile::tempdir().unwrap();
    let (w, h) = SIZE;
    let plane = |seed: u32, channels: usize, value: &dyn Fn(usize, usize, f32) -> f32| {
        let value = |i: usize| value(i / (w * h), i % (w * h), random([seed, 0, i as u32]));
        Planes::from_vec(channels, w, h, (0..channels * w * h).map(value).collect())
    };
    let references = [3, 2].map(|frame| plane(1, 3, &|c, i, _| SHOT.truth(c, i, frame)));
    let images = [3, 2]
        .map(|frame| plane(frame as u32, 3, &|c, i, noise| SHOT.truth(c, i, frame) * (0.7 + 0.6 * noise)));
    // Not quite the motion, and between pixels: some of the picture changes along it.
    let vectors = plane(7, 4, &|c, _, noise| if c == 0 { -2.6 + noise } else { 0.8 * noise });
    let pair = Pair {
        images: [&images[0], &images[1]],
        references: [&references[0], &references[1]],
        vectors: &vectors,
    };
    let got = flicker(&pair).unwrap();
    let all = [&images[0], &images[1], &references[0], &references[1], &vectors];
    let bytes: Vec<u8> = all.iter().flat_map(|p| p.data.iter().flat_map(|v| v.to_le_bytes())).collect();
    let file = dir.path().join("planes.f32");
    fs::write(&file, bytes).unwrap();
    let script = format!(
        "import sys, numpy as np
from scipy.ndimage import map_coordinates, uniform_filter
p = np.fromfile(sys.argv[1], '<f4').reshape(16, {h}, {w}).astype('f8')
a, b, r, s, v = p[:3], p[3:6], p[6:9], p[9:12], p[12:]
y, x = np.mgrid[:{h}, :{w}]
x, y = x + v[0], y - v[1]
warp = lambda q: np.stack([map_coordinates(c, [y, x], order=1, mode='nearest') for c in q])
mean = lambda q: uniform_filter(q, (0, 3, 3), mode='nearest')
same = (np.abs(mean(r) - warp(mean(s))) < 0.1 * np.abs(mean(r)) + 0.003).all(0)
same &= (x >= -0.5) & (x < {w} - 0.5) & (y >= -0.5) & (y < {h} - 0.5)
print(same.mean(), (((a - r) - warp(b - s)) ** 2 / (r * r + 0.001))[:, same].mean())"
    );
    let output = python::run(Process::new(python::python()).args(["-c", &script]).arg(&file));
    let numbers: Vec<f64> = output.split_whitespace().map(|v| v.parse().unwrap()).collect();
    assert!((0.05..0.95).contains(&numbers[0]), "the test wants pixels of both kinds: {}", numbers[0]);
    assert!((got / numbers[1] - 1.0).abs() < 1e-4, "{got} beside {}", numbers[1]);
}
