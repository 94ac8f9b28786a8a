//! `demc inspect`: what a user reads about a file, and what a script does.

mod common;

use assert_cmd::Command;
use common::files::{data, write_bare_parts, write_render};
use predicates::{prelude::*, str::contains};

fn inspect() -> Command {
    let mut command = Command::cargo_bin("demc").unwrap();
    command.arg("inspect");
    command
}

fn json(command: &mut Command) -> Vec<serde_json::Value> {
    let output = command.arg("--json").assert().success().get_output().stdout.clone();
    String::from_utf8(output).unwrap().lines().map(|l| serde_json::from_str(l).unwrap()).collect()
}

#[test]
fn recognises_the_passes_of_both_blender_layouts() {
    let reports = json(inspect().args([data("blender5.exr"), data("blender4.exr")]));
    assert_eq!([&reports[0]["layout"], &reports[1]["layout"]], ["multi-part", "single-part"]);
    let passes = |report: &serde_json::Value| {
        let list = report["layers"][0]["passes"].as_array().unwrap().clone();
        list.iter().map(|p| p["pass"].as_str().unwrap().to_owned()).collect::<Vec<_>>()
    };
    // The same scene rendered by 5.0 and by 4.5, whose names differ.
    assert_eq!(passes(&reports[0]), passes(&reports[1]));
    for wanted in [
        "Combined",
        "Normal",
        "Position",
        "Diffuse Color",
        "Glossy Color",
        "Transmission Color",
        "Denoising Albedo",
        "Denoising Normal",
        "Diffuse Direct",
        "Emission",
        "Environment",
        "Depth",
        "Vector",
    ] {
        assert!(passes(&reports[0]).iter().any(|p| p == wanted), "{wanted}");
    }
    let diffuse = |report: &serde_json::Value| {
        let list = report["layers"][0]["passes"].as_array().unwrap().clone();
        list.iter().find(|p| p["pass"] == "Diffuse Color").unwrap()["stored_as"].clone()
    };
    assert_eq!([diffuse(&reports[0]), diffuse(&reports[1])], ["Diffuse Color", "DiffCol"]);
    for report in &reports {
        assert_eq!(report["layers"][0]["models"][0]["missing"].as_array().unwrap().len(), 0);
        // The averaged position is there: nothing to warn of.
        assert!(report["layers"][0]["findings"].as_array().unwrap().is_empty(), "{report}");
    }
}

#[test]
fn names_what_is_missing_and_where_blender_turns_it_on() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("in.exr");
    write_render(&path, 4, 3, |_, i| i as f32);
    inspect()
        .arg(&path)
        .assert()
        .success()
        .stdout(contains(
            "no Denoising Albedo: turn on View Layer Properties > Passes > Data > Denoising Data",
        ))
        .stdout(contains(
            "no Diffuse Color: turn on View Layer Properties > Passes > Light > Diffuse > Color",
        ))
        .stdout(contains("no Normal").not());
}

#[test]
fn counts_non_finite_and_negative_values_and_empty_passes() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("in.exr");
    write_render(&path, 4, 3, |name, i| match (name, i) {
        ("Combined.R", 0..=2) => f32::NAN,
        ("Combined.B", 5) => -1.0,
        ("Normal.X" | "Normal.Y" | "Normal.Z", _) => 0.0,
        _ => 1.0,
    });
    inspect()
        .arg(&path)
        .assert()
        .success()
        .stdout(contains("Combined: 3 of 36 values are NaN or infinite"))
        .stdout(contains("Combined: 1 negative values"))
        .stdout(contains("Normal is zero everywhere"));
}

#[test]
fn warns_of_the_aliased_position_and_of_windows_that_differ() {
    use exr::prelude::*;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("in.exr");
    let names = ["Combined.R", "Combined.G", "Combined.B", "Position.X", "Position.Y", "Position.Z"];
    let list = names.map(|n| AnyChannel::new(format!("V.{n}").as_str(), FlatSamples::F32(vec![1.0; 12])));
    let own = LayerAttributes::default().with_position(Vec2(2, 1));
    let layer =
        Layer::new((4, 3), own, Encoding::SMALL_LOSSLESS, AnyChannels::sort(list.into_iter().collect()));
    Image::from_layers(ImageAttributes::new(IntegerBounds::new((0, 0), (10, 8))), vec![layer])
        .write()
        .to_file(&path)
        .unwrap();
    inspect()
        .arg(&path)
        .assert()
        .success()
        .stdout(contains("a shader AOV named 'DEMC Position'"))
        .stdout(contains("data window 4x3 at 2,1 is not the display window 10x8 at 0,0"));
}

#[test]
fn copies_of_the_picture_beside_a_view_layer_miss_no_pass() {
    use exr::prelude::*;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("in.exr");
    let missing = |layers: &[&str]| -> Vec<String> {
        let named = layers.iter().flat_map(|layer| {
            let components = if layer.ends_with("Normal") { ["X", "Y", "Z"] } else { ["R", "G", "B"] };
            components.map(|c| if layer.is_empty() { c.to_owned() } else { format!("{layer}.{c}") })
        });
        let list = named.map(|name| AnyChannel::new(name.as_str(), FlatSamples::F32(vec![0.5; 12])));
        let channels = AnyChannels::sort(list.collect());
        let layer = Layer::new((4, 3), LayerAttributes::default(), Encoding::SMALL_LOSSLESS, channels);
        Image::from_layer(layer).write().to_file(&path).unwrap();
        let report = json(inspect().arg(&path)).remove(0);
        let is_warned = |layer: &&serde_json::Value| {
            let findings = layer["findings"].as_array().unwrap();
            findings.iter().any(|finding| finding["code"] == "missing-pass")
        };
        let warned = report["layers"].as_array().unwrap().iter().filter(is_warned);
        warned.map(|layer| layer["name"].as_str().unwrap().to_owned()).collect()
    };
    let whole = ["V.Combined", "V.Denoising Albedo", "V.Denoising Normal"];
    assert_eq!(missing(&[&whole[..], &["Composite.Combined", ""]].concat()), [""; 0]);
    // What is denoised, and another view layer, are no copies.
    assert_eq!(missing(&["Composite.Combined"]), ["Composite"]);
    assert_eq!(missing(&[""]), [""]);
    assert_eq!(missing(&[&whole[..], &["Other.Combined"]].concat()), ["Other"]);
}

#[test]
fn lists_every_view_layer_and_eye() {
    inspect()
        .args([data("blender4_two_layers.exr"), data("blender5_stereo.exr")])
        .assert()
        .success()
        .stdout(contains("view layer 'Second.Layer'\n").and(contains("view layer 'ViewLayer'\n")))
        .stdout(contains("view 'left'").and(contains("view 'right'")))
        .stdout(contains("kept, not read: ViewLayer.CryptoObject00"));
}

#[test]
fn bare_channels_go_by_their_part() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("in.exr");
    write_bare_parts(&path, &["V.Combined", "V.Mist"]);
    inspect().arg(&path).assert().success().stdout(contains("kept, not read: V.Mist\n"));
}

#[test]
fn a_bad_file_is_named_and_the_others_are_shown() {
    let dir = tempfile::tempdir().unwrap();
    let bad = dir.path().join("bad.exr");
    std::fs::write(&bad, [0u8; 100]).unwrap();
    inspect()
        .args([&bad, &data("blender4.exr")])
        .assert()
        .code(1)
        .stderr(contains("bad.exr: is not an EXR file"))
        .stdout(contains("blender4.exr"));
    let run = inspect().arg("--json").args([&bad, &data("blender4.exr")]).assert().code(1);
    let lines: Vec<serde_json::Value> = String::from_utf8_lossy(&run.get_output().stdout)
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    assert_eq!((lines.len(), &lines[0]["path"]), (2, &bad.to_str().unwrap().into()));
    assert!(lines[0]["error"].as_str().unwrap().contains("is not an EXR file"), "{}", lines[0]);
    assert!(lines[1].get("error").is_none());
}
