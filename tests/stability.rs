//! `demc stability` from the command line.

mod common;

use std::{fs, path::Path};

use assert_cmd::Command;
use common::{
    demc,
    files::{data, write_render},
    tables::{Row, table},
};
use demc::stability::Trial;
use predicates::prelude::*;

fn stability(models: &str, set: &Path, out: &Path) -> Command {
    let mut command = demc();
    command.args(["stability", "--models", models, "--test-set"]).arg(set).arg("--out").arg(out);
    command
}

fn value(row: &Row, column: &str) -> f64 {
    row[column].parse().unwrap_or_else(|_| panic!("{column} of {row:?}"))
}

/// What is known without running anything: the noisy input is not moved by any change of the guides, of the
/// exposure or of the frame, and by fireflies it is; a network that works on squares of pixels whose exposure
/// it normalises first may feel where they begin and little else. Fireflies it takes out.
#[test]
fn tells_what_changes_results_and_what_does_not() {
    let out = tempfile::tempdir().unwrap();
    stability("demc-s:f32", &data(""), out.path())
        .assert()
        .success()
        .stdout(predicate::str::contains("stability_summary.csv"));
    let rows = table(&out.path().join("stability.csv"));
    assert_eq!(rows.len(), 2 * 2 * Trial::ALL.len(), "pairs, methods, trials");
    for row in &rows {
        let (trial, ratio, deviation) = (&row["trial"][..], value(row, "ratio"), value(row, "deviation"));
        let is_noisy = row["model"] == "noisy";
        match trial {
            "as-rendered" => assert_eq!((ratio, deviation), (1.0, 0.0)),
            "fireflies" if is_noisy => assert!(ratio > 10.0, "{row:?}"),
            "non-finite" if is_noisy => assert!(deviation > 0.0, "{row:?}"),
            _ if is_noisy => assert_eq!(deviation, 0.0, "{row:?}"),
            "darker" | "brighter" | "much-darker" | "much-brighter" => assert!(deviation < 1e-6, "{row:?}"),
            // One of the frames is a crop, whose rays are not those that normals are told apart by.
            "unit-normals" => assert!(ratio < 1.2, "{row:?}"),
            "fireflies" => assert!(deviation > 0.0 && ratio < 1.2, "{row:?}"),
            "mirrored" | "cropped" => assert!(deviation > 0.0 && ratio < 1.3, "{row:?}"),
            _ => assert!(deviation > 0.0, "{row:?}"),
        }
    }
    let summary = table(&out.path().join("stability_summary.csv"));
    assert_eq!(summary.len(), 2 * Trial::ALL.len());
    for line in &summary {
        let own = || rows.iter().filter(|r| r["model"] == line["model"] && r["trial"] == line["trial"]);
        let ratios: Vec<f64> = own().map(|r| value(r, "ratio")).collect();
        let mean = (ratios.iter().map(|r| r.ln()).sum::<f64>() / 2.0).exp();
        assert!((value(line, "ratio") / mean - 1.0).abs() < 1e-5, "{line:?}");
        assert_eq!(value(line, "worst_ratio"), ratios[0].max(ratios[1]));
        assert!(own().any(|r| r["scene"] == line["worst_scene"]), "{line:?}");
        assert_eq!((&line["scenes"][..], &line["failed"][..]), ("2", "0"));
    }
}

/// A frame that cannot be read, or whose reference is missing, has rows without numbers and with a reason;
/// the others go on.
#[test]
fn one_bad_frame_does_not_stop_the_others() {
    let folder = tempfile::tempdir().unwrap();
    let set = folder.path().join("set");
    fs::create_dir(&set).unwrap();
    for name in ["s0000_room_0004spp.exr", "s0000_room_ref.exr"] {
        fs::copy(data(name), set.join(name)).unwrap();
    }
    fs::copy(data("s0000_room_ref.exr"), set.join("cut_ref.exr")).unwrap();
    fs::write(set.join("cut_0004spp.exr"), b"no frame").unwrap();
    fs::copy(data("s0000_room_0004spp.exr"), set.join("lonely_0004spp.exr")).unwrap();
    let out = folder.path().join("out");
    stability("noisy", &set, &out).assert().code(1).stderr(predicate::str::contains("stability.csv"));
    let rows = table(&out.join("stability.csv"));
    let failed: Vec<&Row> = rows.iter().filter(|row| !row["reason"].is_empty()).collect();
    assert_eq!((rows.len(), failed.len()), (3 * Trial::ALL.len(), 2 * Trial::ALL.len()));
    for row in failed {
        assert!(row["relmse"].is_empty() && row["ratio"].is_empty(), "{row:?}");
        let why = if row["scene"] == "cut" { "cut_0004spp.exr" } else { "lonely_ref.exr is missing" };
        assert!(row["reason"].contains(why), "{row:?}");
    }
}

/// A frame that a trial leaves nothing of, and one whose result is exact: no failures, and no made-up
/// numbers.
#[test]
fn what_cannot_be_told_is_an_empty_cell_with_a_note() {
    let (set, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    for (scene, (width, height), light) in [("small", (5, 3), 0.25), ("exact", (40, 40), 0.5)] {
        let path = |kind: &str| set.path().join(format!("{scene}_{kind}.exr"));
        write_render(&path("0004spp"), width, height, |_, _| 0.5);
        write_render(&path("ref"), width, height, |_, _| light);
    }
    stability("noisy", set.path(), out.path())
        .assert()
        .success()
        .stderr(predicate::str::contains("cropped: skipped"));
    let rows = table(&out.path().join("stability.csv"));
    assert_eq!(rows.len(), 2 * Trial::ALL.len());
    for row in &rows {
        // Without an albedo, and of one value, they hold little that can be changed.
        if row["note"].contains("holds nothing that this changes") {
            assert!(["relmse", "ratio", "deviation"].iter().all(|column| row[*column].is_empty()), "{row:?}");
            continue;
        }
        let empty = match (&row["scene"][..], &row["trial"][..]) {
            ("small", "cropped") => &["relmse", "ratio", "deviation"][..],
            ("exact", trial) if trial != "as-rendered" => &["ratio"],
            _ => &[],
        };
        for column in ["relmse", "ratio", "deviation"] {
            assert_eq!(row[column].is_empty(), empty.contains(&column), "{column} of {row:?}");
            assert!(row[column].is_empty() || value(row, column).is_finite(), "{column} of {row:?}");
        }
        assert_eq!((row["reason"].is_empty(), row["note"].is_empty()), (true, empty.is_empty()), "{row:?}");
    }
    let summary = table(&out.path().join("stability_summary.csv"));
    let skips = |trial: &str| {
        let of_trial = rows.iter().filter(|row| row["trial"] == trial);
        of_trial.filter(|row| row["note"].contains("holds nothing that this changes")).count()
    };
    assert_eq!(
        [skips("without-albedo"), skips("shifted-guides"), skips("darker"), skips("fireflies")],
        [2, 2, 0, 0]
    );
    let scenes = |trial: &str| &summary.iter().find(|line| line["trial"] == trial).unwrap()["scenes"][..];
    assert_eq!([scenes("as-rendered"), scenes("darker"), scenes("cropped")], ["2", "1", "0"]);
}

/// Frames of a manifest that have one scene's name and references of their own are different frames, not noise seeds.
#[test]
fn frames_of_one_name_are_judged_by_themselves() {
    let (set, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let write = |name: &str, light: f32| {
        write_render(&set.path().join(name), 24, 24, |_, i| light + 0.1 * (i % 7) as f32);
    };
    // The last frame is as it should be: whatever changes it does harm.
    for (n, light) in [(1, 0.9), (2, 0.9), (3, 0.5)] {
        write(&format!("beauty.000{n}.exr"), light);
        write(&format!("clean.000{n}.exr"), 0.5);
    }
    let lines: String = (1..=3).map(|n| format!("shot,beauty.000{n}.exr,clean.000{n}.exr,4\n")).collect();
    let manifest = set.path().join("set.csv");
    fs::write(&manifest, format!("scene,noisy,reference,spp\n{lines}")).unwrap();
    stability("demc-s:unrestrained", &manifest, out.path())
        .args(["--trials", "as-rendered"])
        .assert()
        .success();
    let cases = table(&out.path().join("stability_scenes.csv"));
    let own: Vec<&Row> = cases.iter().filter(|row| row["model"] != "noisy").collect();
    let scenes: Vec<&str> = own.iter().map(|row| &row["scene"][..]).collect();
    assert_eq!(scenes, ["shot.0001", "shot.0002", "shot.0003"]);
    assert!(own.iter().all(|row| row["seeds"] == "1"), "{own:?}");

    // Also where nothing but the reference tells them apart, and then each has its row of the map.
    fs::write(
        &manifest,
        "scene,noisy,reference,spp\nshot,beauty.0001.exr,clean.0001.exr,4\nshot,beauty.0003.exr,beauty.0003.exr,4\n",
    )
    .unwrap();
    stability("demc-s:unrestrained", &manifest, out.path())
        .args(["--trials", "as-rendered"])
        .assert()
        .success();
    let map = fs::read_to_string(out.path().join("map_input.svg")).unwrap();
    assert_eq!(map.matches("shot").count(), 2);
}

/// Half buffers on disk do not have the change: NFOR must not denoise them in place of the changed frame.
#[test]
fn half_buffers_beside_a_frame_do_not_stand_in_for_it() {
    let (set, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    for (from, to) in
        [("0004spp", "0004spp"), ("0004spp", "0004spp_a"), ("0004spp", "0004spp_b"), ("ref", "ref")]
    {
        let name = |kind: &str| format!("s0010_outdoor_{kind}.exr");
        fs::copy(data(&name(from)), set.path().join(name(to))).unwrap();
    }
    // It fails where there are no guides, and says so.
    stability("nfor", set.path(), out.path()).assert().code(1);
    let rows = table(&out.path().join("stability.csv"));
    for row in rows.iter().filter(|row| row["model"] == "nfor") {
        match &row["trial"][..] {
            "without-guides" | "without-albedo" | "without-normals" => {
                assert_eq!(row["relmse"], "", "{row:?}")
            }
            "as-rendered" => {}
            "darker" | "brighter" | "much-darker" | "much-brighter" => {
                assert!((value(row, "ratio") - 1.0).abs() < 0.01, "{row:?}");
            }
            _ => assert!(value(row, "deviation") > 0.0, "{row:?}"),
        }
    }
}

/// Renders of one scene and sample count are its seeds: they are judged together, and what is out of bounds
/// is said in the table, on the map and on the page.
#[test]
fn scenes_are_judged_over_their_seeds_and_mapped() {
    let (set, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let path = |name: &str| set.path().join(name);
    // Noise that differs from seed to seed, over a picture that is flat; and one that is all wrong.
    let noise = |seed: usize, x: usize, y: usize| ((x * 7 + y * 13 + seed * 29) % 11) as f32 / 20.0;
    let write = |name: &str, at: &dyn Fn(usize, usize) -> f32| {
        write_render(&path(name), 48, 32, |_, i| at(i % 48, i / 48));
    };
    for seed in 0..2 {
        write(&format!("flat_{seed}.exr"), &|x, y| noise(seed, x, y));
    }
    write("flat_ref.exr", &|_, _| 0.25);
    let manifest = path("manifest.csv");
    let lines =
        ["scene,noisy,reference,spp", "flat,flat_0.exr,flat_ref.exr,4", "flat,flat_1.exr,flat_ref.exr,4"];
    fs::write(&manifest, lines.join("\n")).unwrap();
    let mut command = stability("noisy", &manifest, out.path());
    command
        .args(["--trials", "as-rendered"])
        .assert()
        .success()
        .stdout(predicate::str::contains("stability.html"));
    let scenes = table(&out.path().join("stability_scenes.csv"));
    assert_eq!(scenes.len(), 1, "{scenes:?}");
    let rows = table(&out.path().join("stability.csv"));
    let errors: Vec<f64> = rows.iter().map(|row| value(row, "relmse")).collect();
    assert_eq!((&scenes[0]["seeds"][..], errors.len()), ("2", 2));
    assert!((value(&scenes[0], "relmse") / (errors[0] + errors[1]) * 2.0 - 1.0).abs() < 1e-5, "{scenes:?}");
    assert!(
        (value(&scenes[0], "energy") - 1.0).abs() < 0.05 && scenes[0]["verdict"].is_empty(),
        "{scenes:?}"
    );
    for name in ["map_input.svg", "map_input.png", "stability.html"] {
        assert!(out.path().join(name).is_file(), "{name}");
    }
    let page = fs::read_to_string(out.path().join("stability.html")).unwrap();
    assert!(page.contains("0 of 0 cases") && page.contains("flat") && page.contains("4 spp"), "{page}");
    let mut command = stability("noisy", &manifest, out.path());
    command.args(["--baseline", "oidn-high"]).assert().code(2).stderr(predicate::str::contains("--baseline"));
}

#[test]
fn help_says_what_each_trial_does() {
    let help = demc().args(["stability", "--help"]).assert().success();
    let text = String::from_utf8(help.get_output().stdout.clone()).unwrap();
    for trial in Trial::ALL {
        assert!(text.contains(trial.name()) && text.contains(trial.meaning()), "{text}");
    }
}
