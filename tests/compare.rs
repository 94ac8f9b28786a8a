//! `demc compare`: which pixels of two files are compared with each other.

mod common;

use std::path::Path;

use assert_cmd::Command;
use common::files::data;
use exr::prelude::*;
use predicates::{prelude::*, str::contains};

fn compare(a: &Path, b: &Path) -> Command {
    let mut command = Command::cargo_bin("demc").unwrap();
    command.arg("compare").args([a, b]);
    command
}

/// A single-part file of layers, each of one value, whose data window begins at `first` of a display window
/// of 100x100.
fn write(path: &Path, first: (i32, i32), layers: &[(&str, f32)]) {
    let named = layers.iter().flat_map(|(layer, value)| {
        ["R", "G", "B"].map(|c| {
            AnyChannel::new(format!("{layer}.{c}").as_str(), FlatSamples::F32(vec![*value; 16 * 16]))
        })
    });
    let own = LayerAttributes::default().with_position(Vec2(first.0, first.1));
    let layer = Layer::new((16, 16), own, Encoding::SMALL_LOSSLESS, AnyChannels::sort(named.collect()));
    let shared = ImageAttributes::new(IntegerBounds::from_dimensions((100, 100)));
    Image::from_layers(shared, vec![layer]).write().to_file(path).unwrap();
}

#[test]
fn a_view_layer_is_held_against_its_namesake() {
    let dir = tempfile::tempdir().unwrap();
    let [a, b, other, plain] = ["a.exr", "b.exr", "other.exr", "plain.exr"].map(|f| dir.path().join(f));
    // A's Foreground has more passes than its Background; in B both have as many.
    let colour = "Foreground.Denoising Albedo";
    write(&a, (0, 0), &[("Background.Combined", 4.0), ("Foreground.Combined", 2.0), (colour, 1.0)]);
    write(&b, (0, 0), &[("Background.Combined", 4.0), ("Foreground.Combined", 2.0)]);
    compare(&a, &b).assert().success().stdout(contains("rmse 0\n")).stderr("");
    compare(&a, &b).args(["--view-layer", "Background"]).assert().success().stdout(contains("rmse 0\n"));

    write(&other, (0, 0), &[("Background.Combined", 4.0), ("Sky.Combined", 2.0)]);
    let told = contains("no view layer 'Foreground'").and(contains("'Background', 'Sky'"));
    compare(&a, &other).assert().code(1).stdout("").stderr(told);

    // What the compositor made is nobody's namesake, and a file without view layers takes what there is.
    let composed = dir.path().join("composed.exr");
    write(&composed, (0, 0), &[("Composite.Combined", 9.0), ("View.Combined", 2.0)]);
    write(&plain, (0, 0), &[("Combined", 2.0)]);
    for image in [&a, &plain] {
        compare(image, &composed)
            .assert()
            .success()
            .stdout(contains("rmse 0\n"))
            .stderr(contains("'View' of B"));
    }

    // The only one there is will do, and is named.
    let told = contains("view layer 'Foreground' of A with '' of B");
    compare(&a, &plain).assert().success().stdout(contains("rmse 0\n")).stderr(told);
}

#[test]
fn of_several_results_that_of_the_most_passes_is_judged() {
    let dir = tempfile::tempdir().unwrap();
    let [a, b] = ["a.exr", "b.exr"].map(|f| dir.path().join(f));
    let results = [("Background.Denoised", 5.0), ("Foreground.Denoised", 2.0), ("Foreground.Other", 2.0)];
    let renders = [("Background.Combined", 4.0), ("Foreground.Combined", 2.0)];
    let guide = ("Foreground.Denoising Albedo", 1.0);
    write(&a, (0, 0), &[&results[..], &renders, &[guide]].concat());
    write(&b, (0, 0), &renders);
    let told = contains("'Denoised' of view layer 'Foreground'; others hold one too");
    compare(&a, &b).assert().success().stdout(contains("rmse 0\n")).stderr(told);
    // By the name of the layer, and as the reference, as well.
    let named = compare(&a, &b).args(["--layer", "Denoised"]).assert().success();
    named.stdout(contains("rmse 0\n")).stderr(contains("view layer 'Foreground'"));
    let [plain, reference] = ["plain.exr", "reference.exr"].map(|f| dir.path().join(f));
    write(&plain, (0, 0), &[("Combined", 2.0)]);
    write(&reference, (0, 0), &[&results[..2], &renders, &[guide]].concat());
    let against = compare(&plain, &reference).args(["--reference-layer", "Denoised"]).assert().success();
    against.stdout(contains("rmse 0\n")).stderr(contains("'Denoised' of view layer 'Foreground'"));
    // One that is named, or holds such a layer alone, needs no note.
    let background = compare(&a, &b).args(["--view-layer", "Background"]).assert().success();
    background.stdout(contains("rmse 1\n")).stderr(contains("others hold").not());
    let other = compare(&a, &b).args(["--layer", "Other"]).assert().success();
    other.stdout(contains("rmse 0\n")).stderr(contains("others hold").not());
}

#[test]
fn other_pixels_are_not_compared() {
    let dir = tempfile::tempdir().unwrap();
    let [a, b] = ["a.exr", "b.exr"].map(|f| dir.path().join(f));
    write(&a, (10, 10), &[("V.Combined", 1.0)]);
    write(&b, (40, 40), &[("V.Combined", 1.0)]);
    let told = contains("a.exr: holds 16x16 pixels at 10,10, its reference")
        .and(contains("b.exr 16x16 pixels at 40,40"));
    compare(&a, &b).assert().code(1).stdout("").stderr(told);
    compare(&a, &a).assert().success().stdout(contains("rmse 0\n"));
}

#[test]
fn both_layers_can_be_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.exr");
    write(&path, (0, 0), &[("V.Combined", 1.0), ("V.Denoised", 3.0), ("V.Other", 6.0)]);
    for (args, rmse) in [
        (&[][..], "rmse 2\n"), // its Denoised against its Combined
        (&["--layer", "Combined"], "rmse 0\n"),
        (&["--layer", "Other"], "rmse 5\n"),
        (&["--layer", "V.Other"], "rmse 5\n"),
        (&["--reference-layer", "Denoised"], "rmse 0\n"),
        (&["--layer", "Combined", "--reference-layer", "Other"], "rmse 5\n"),
    ] {
        compare(&path, &path).args(args).assert().success().stdout(contains(rmse));
    }
    let lacks = compare(&path, &path).args(["--reference-layer", "Clean"]).assert().code(1);
    lacks.stderr(contains("a.exr: has no layer 'Clean' with R, G and B"));
    compare(&path, &data("blender4.exr")).assert().code(1).stderr(contains("40x24 pixels at 0,0"));
}
