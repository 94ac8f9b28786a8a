//! What demc says of its own results: how far off each pixel is expected to be, and which frames want more
//! samples.
//!
//! The frames were never trained on: a house at 4 samples, and a corner of another scene at 64.

mod common;

use std::path::{Path, PathBuf};

use common::{
    demc,
    files::{data, read_exr, samples, values},
};
use demc::{
    frame::Frame,
    metrics::error::relative_squared_error,
    passes::{self, Pass},
};
use exr::prelude::FlatSamples;
use predicates::{prelude::*, str::contains};
use serde_json::Value;

/// Pixels to each side of the blocks over which errors are compared.
const BLOCK: usize = 8;

/// A squared relative error that is none: what a frame without noise must come back within.
const NO_ERROR: f64 = 1e-4;

#[test]
fn a_part_of_an_all_round_frame_has_errors_of_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let (width, height) = (96, 40);
    // All columns of some rows, and some columns of all rows.
    for (name, columns, rows) in [("rows", 0..width, 10..30), ("columns", 20..70, 0..height)] {
        let path = folder.path().join(format!("{name}_0004spp.exr"));
        common::files::write_render(&path, width, height, |channel, i| {
            let noise = (i * 2_654_435_761 % 1000) as f32 / 1000.0;
            let is_inside = columns.contains(&(i % width)) && rows.contains(&(i / width));
            if !is_inside || channel.starts_with("Normal") { 0.0 } else { 0.2 + noise }
        });
        let out = folder.path().join("out");
        let arguments = ["--model", "demc-s", "--wrap", "x", "--confidence", "--out"];
        demc().arg("denoise").arg(&path).args(arguments).arg(&out).assert().success();
        let done = read_exr(out.join(path.file_name().unwrap()));
        for (i, error) in values(&done, "ViewLayer.Denoised Error.X").into_iter().enumerate() {
            let is_inside = columns.contains(&(i % width)) && rows.contains(&(i / width));
            assert_eq!(error > 0.0, is_inside, "{name}, pixel {i}: {error}");
        }
    }
}

fn kept_frames() -> [(PathBuf, PathBuf); 2] {
    let example = |name: &str| Path::new(env!("CARGO_MANIFEST_DIR")).join("eval/example").join(name);
    let pair = |name: &str| data("no_harm").join(name);
    [
        (example("house_0004spp.exr"), example("house_ref.exr")),
        (pair("principled_0064spp.exr"), pair("principled_ref.exr")),
    ]
}

/// Means over blocks of a plane of `width` columns.
fn blocks(values: &[f64], width: usize) -> Vec<f64> {
    let height = values.len() / width;
    let mut means = Vec::new();
    for y in (0..height / BLOCK * BLOCK).step_by(BLOCK) {
        for x in (0..width / BLOCK * BLOCK).step_by(BLOCK) {
            let rows = (y..y + BLOCK).flat_map(|y| &values[y * width + x..][..BLOCK]);
            means.push(rows.sum::<f64>() / (BLOCK * BLOCK) as f64);
        }
    }
    means
}

/// The place of each value in their order.
fn ranks(values: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|a, b| values[*a].total_cmp(&values[*b]));
    let mut ranks = vec![0.0; values.len()];
    order.into_iter().enumerate().for_each(|(rank, at)| ranks[at] = rank as f64);
    ranks
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let n = a.len() as f64;
    let [mean_a, mean_b] = [a, b].map(|values| values.iter().sum::<f64>() / n);
    let product =
        |x: &[f64], y: &[f64], (mx, my)| -> f64 { x.iter().zip(y).map(|(x, y)| (x - mx) * (y - my)).sum() };
    product(a, b, (mean_a, mean_b))
        / (product(a, a, (mean_a, mean_a)) * product(b, b, (mean_b, mean_b))).sqrt()
}

/// Denoises with `--confidence`; returns the result and what `--json` says of it.
fn denoise(input: &Path, out: &Path, model: &str) -> (PathBuf, Value) {
    let output = demc()
        .args(["denoise", "--confidence", "--json", "--model", model])
        .arg(input)
        .arg("--out")
        .arg(out)
        .output();
    let output = output.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    (out.join(input.file_name().unwrap()), serde_json::from_slice(&output.stdout).unwrap())
}

#[test]
fn what_is_expected_goes_with_what_is_true() {
    let dir = tempfile::tempdir().unwrap();
    for model in ["demc-s", "demc-m", "demc-l"] {
        let (mut expected, mut true_errors) = (Vec::new(), Vec::new());
        for (noisy, reference) in kept_frames() {
            let (result, _) = denoise(&noisy, &dir.path().join(model), model);
            let image = read_exr(&result);
            let width = image.layer_data[0].size.width();
            let layer = values(&image, "ViewLayer.Denoised Error.X");
            assert!(matches!(samples(&image, "ViewLayer.Denoised Error.X"), Some(FlatSamples::F32(_))));
            let reference = passes::load(&reference, None).unwrap();
            let reference = reference.get(Pass::Combined).unwrap();
            let mut errors = vec![0.0; layer.len()];
            for (c, name) in ["R", "G", "B"].into_iter().enumerate() {
                let denoised = values(&image, &format!("ViewLayer.Denoised.{name}"));
                for (error, (x, r)) in errors.iter_mut().zip(denoised.iter().zip(reference.channel(c))) {
                    *error += relative_squared_error(f64::from(*x), f64::from(*r)) / 3.0;
                }
            }
            let layer: Vec<f64> = layer.into_iter().map(f64::from).collect();
            expected.extend(blocks(&layer, width));
            true_errors.extend(blocks(&errors, width));
        }
        let rank = correlation(&ranks(&expected), &ranks(&true_errors));
        let mut order: Vec<usize> = (0..expected.len()).collect();
        order.sort_by(|a, b| expected[*a].total_cmp(&expected[*b]));
        let sum = |values: &[f64], at: &[usize]| at.iter().map(|at| values[*at] + NO_ERROR).sum::<f64>();
        let tenths = order.chunks(order.len().div_ceil(10));
        let factors: Vec<f64> = tenths.map(|at| sum(&true_errors, at) / sum(&expected, at)).collect();
        eprintln!("{model}: rank {rank:.3}, true over expected {factors:.2?}");
        assert!(rank >= 0.8, "{model}: {rank}");
        // Of a scene alone the expected error is within a factor of two or so; over many scenes it is nearer.
        for factor in &factors {
            assert!((0.4..=2.5).contains(factor), "{model}: {factors:.2?}");
        }
    }
}

#[test]
fn the_frame_s_mean_is_told_by_json_inspect_and_the_layer_alike() {
    let dir = tempfile::tempdir().unwrap();
    let (result, json) = denoise(&data("s0000_room_0004spp.exr"), dir.path(), "demc-s");
    let told = json["expected_error"].as_f64().unwrap();
    let layer = values(&read_exr(&result), "ViewLayer.Denoised Error.X");
    let mean = layer.iter().map(|v| f64::from(*v)).sum::<f64>() / layer.len() as f64;
    assert!(layer.iter().all(|v| *v > 0.0) && (mean / told - 1.0).abs() < 0.1, "{mean} beside {told}");
    let inspected = demc().args(["inspect", "--json"]).arg(&result).output().unwrap();
    let inspected: Value = serde_json::from_slice(&inspected.stdout).unwrap();
    let report = inspected.as_array().map_or(&inspected, |files| &files[0]);
    let noted = &report["expected_errors"][0];
    assert_eq!(noted["layer"], "ViewLayer.Denoised");
    assert!((noted["relmse"].as_f64().unwrap() / told - 1.0).abs() < 1e-3);
    demc()
        .arg("inspect")
        .arg(&result)
        .assert()
        .success()
        .stdout(contains("'ViewLayer.Denoised' has an expected RelMSE of"));
}

#[test]
fn a_finished_result_without_the_layer_is_not_taken_for_one_with_it() {
    let dir = tempfile::tempdir().unwrap();
    let input = data("s0000_room_0004spp.exr");
    let run =
        |more: &[&str]| demc().arg("denoise").arg(&input).arg("--out").arg(dir.path()).args(more).assert();
    run(&["--model", "demc-s"]).success();
    run(&["--model", "demc-s", "--confidence"])
        .code(1)
        .stderr(contains("exists without 'ViewLayer.Denoised Error'"));
    run(&["--model", "demc-s", "--confidence", "--overwrite"]).success();
    run(&["--model", "demc-s", "--confidence"]).success().stdout(contains("is there already"));
}

#[test]
fn frames_are_listed_by_what_is_expected_with_the_samples_they_want() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let inputs = kept_frames().map(|(noisy, _)| noisy);
    let run = |more: &[&str]| {
        let mut command = demc();
        command
            .args(["denoise", "--model", "demc-s"])
            .args(&inputs)
            .arg("--out")
            .arg(&out)
            .args(more)
            .output()
            .unwrap()
    };
    let listed = |text: &[u8]| {
        let text = String::from_utf8_lossy(text).into_owned();
        let after = text.split_once("the worst first:\n").unwrap_or_else(|| panic!("{text}")).1;
        after.lines().map(str::to_owned).collect::<Vec<_>>()
    };
    let lines = listed(&run(&["--report", "1e-3"]).stdout);
    assert_eq!(lines.len(), 2);
    let error = |line: &str| line.split(' ').next().unwrap().parse::<f64>().unwrap();
    assert!(error(&lines[0]) >= error(&lines[1]), "{lines:?}");
    assert!(
        lines.iter().any(|line| line.contains("house") && line.contains("  4 samples, wants about")),
        "{lines:?}"
    );
    // The same of results that are there already.
    let again = listed(&run(&["--report"]).stdout);
    assert_eq!(again.len(), 2);
    assert!(
        again.iter().zip(&lines).all(|(again, line)| line.starts_with(again.as_str())),
        "{again:?}, {lines:?}"
    );
    // And of the lines of many tasks.
    let log = dir.path().join("task.jsonl");
    std::fs::write(&log, run(&["--json", "--overwrite"]).stdout).unwrap();
    let report = |log: &Path| {
        listed(&demc().arg("report").arg(log).args(["--by-error", "1e-3"]).output().unwrap().stdout)
    };
    assert_eq!(report(&log), lines);
    // Of tasks that found all done as well, and one by a method that tells nothing.
    let late = dir.path().join("late.jsonl");
    let mut told = run(&["--json"]).stdout;
    let silent = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/s0000_room_0004spp.exr");
    let by = ["denoise", "--model", "noisy", "--json", "--out"];
    told.extend(demc().args(by).arg(&out).arg(silent).output().unwrap().stdout);
    std::fs::write(&late, told).unwrap();
    let mut found = report(&late);
    assert!(found.pop().unwrap().starts_with("1 frame more, whose results do not tell"));
    let noted = |lines: &[String]| lines.iter().map(|line| line[8..].to_owned()).collect::<Vec<_>>();
    assert_eq!(noted(&found), noted(&lines));
}

#[test]
fn each_result_in_a_file_has_an_error_of_its_own() {
    let dir = tempfile::tempdir().unwrap();
    // Blender 4 stores one part, Blender 5 one for each pass.
    for file in ["blender4.exr", "blender5.exr"] {
        let run = |input: &Path, more: &[&str]| {
            let out = dir.path().join(more[1]);
            let output = demc()
                .args(["denoise", "--json"])
                .arg(input)
                .arg("--out")
                .arg(&out)
                .args(more)
                .output()
                .unwrap();
            assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
            let told: Value = serde_json::from_slice(&output.stdout).unwrap();
            (out.join(file), told["expected_error"].as_f64())
        };
        let (first, of_first) = run(&data(file), &["--model", "demc-s"]);
        let (second, of_second) = run(&first, &["--model", "demc-l", "--layer", "Better"]);
        let (third, of_third) = run(&second, &["--model", "nfor", "--layer", "Nfor"]);
        assert!(of_first.is_some() && of_first != of_second && of_third.is_none(), "{file}");
        let noted = Frame::read_headers(&third).unwrap();
        for (layer, error) in [("Denoised", of_first), ("Better", of_second), ("Nfor", of_third)] {
            let found = noted.expected_error(&format!("ViewLayer.{layer}"), None);
            let is_alike = |(a, b): (f64, f64)| (a / b - 1.0).abs() < 1e-3;
            assert_eq!(found.is_some(), error.is_some(), "{file}, {layer}");
            assert!(found.zip(error).is_none_or(is_alike), "{file}, {layer}: {found:?}, {error:?}");
        }
        // Asked again, each tells its own.
        let (_, again) = run(&first, &["--model", "demc-l", "--layer", "Better"]);
        let is_alike = (again.unwrap() / of_second.unwrap() - 1.0).abs() < 1e-3;
        assert!(is_alike, "{file}: {again:?}, {of_second:?}");
    }
}

#[test]
fn a_method_that_cannot_tell_says_so_before_any_work() {
    let dir = tempfile::tempdir().unwrap();
    let run = |more: &[&str]| {
        demc()
            .arg("denoise")
            .arg(data("s0000_room_0004spp.exr"))
            .arg("--out")
            .arg(dir.path())
            .args(more)
            .assert()
    };
    for option in ["--confidence", "--report"] {
        let does_not_tell = contains("noisy does not tell how far off it is");
        run(&["--model", "noisy", option]).failure().stderr(does_not_tell.and(contains(option)));
        run(&["--temporal", option]).failure().stderr(contains("--temporal"));
    }
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
}
