//! `demc eval` from the command line: tables, charts, sheets, failures and resumption.

mod common;

use std::{fs, path::Path};

use assert_cmd::assert::Assert;
use common::{
    demc,
    files::{data, write_render},
    python,
    tables::{Row, table},
};
use predicates::prelude::*;

const CONTRACT: &str = "scene,model,spp,width,height,relmse,ssim,rmse,max_error,seconds,ms_per_mpx,exposure";

/// Runs `demc eval` with one timed run unless told otherwise, plus `more` arguments.
fn eval(set: &Path, out: &Path, more: &[&str]) -> Assert {
    let once = if more.contains(&"--repeats") { &[][..] } else { &["--repeats", "1"] };
    demc().arg("eval").args(once).arg("--test-set").arg(set).arg("--out").arg(out).args(more).assert()
}

fn row<'a>(rows: &'a [Row], scene: &str, model: &str) -> &'a Row {
    rows.iter().find(|r| r["scene"] == scene && r["model"] == model).expect("the row is there")
}

/// Options that name Open Image Denoise's program, which the tests' environment carries.
fn oidn() -> String {
    python::environment().oidn_program("oidnDenoise").to_str().unwrap().to_string()
}

#[test]
fn a_folder_in_which_another_run_works_is_left_alone() {
    let out = tempfile::tempdir().unwrap();
    fs::write(out.path().join("scores.csv"), "what the other run wrote").unwrap();
    let other = demc::frame::alone_in(out.path()).unwrap();
    eval(&data("*room*"), out.path(), &["--models", "demc-s"])
        .failure()
        .stderr(predicate::str::contains("another run of demc works in this folder"));
    assert_eq!(fs::read_to_string(out.path().join("scores.csv")).unwrap(), "what the other run wrote");
    drop(other);
    fs::remove_file(out.path().join("scores.csv")).unwrap();
    eval(&data("*room_0004spp.exr"), out.path(), &["--models", "demc-s", "--no-sheets"]).success();
}

#[test]
fn a_scene_with_a_very_long_name_gets_its_sheet() {
    let (set, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    write_render(&set.path().join("n.exr"), 16, 16, |_, i| i as f32 / 256.0);
    write_render(&set.path().join("r.exr"), 16, 16, |_, i| i as f32 / 300.0);
    let name = "é".repeat(150);
    let rows = format!("{name}a,n.exr,r.exr,4\n{name}b,r.exr,n.exr,4\n");
    let manifest = set.path().join("set.csv");
    fs::write(&manifest, format!("scene,noisy,reference,spp\n{rows}")).unwrap();
    eval(&manifest, out.path(), &["--models", "demc-s"]).success();
    assert_eq!(fs::read_dir(out.path().join("sheets")).unwrap().count(), 2);
}

#[test]
fn writes_tables_charts_and_sheets_for_methods_and_the_noisy_input() {
    let out = tempfile::tempdir().unwrap();
    eval(&data(""), out.path(), &["--models", "oidn-fast,oidn-high-prefilter", "--oidn", &oidn()])
        .success()
        .stdout(predicate::str::contains("summary.csv"));

    let header = fs::read_to_string(out.path().join("scores.csv")).unwrap();
    assert!(header.starts_with(&format!("{CONTRACT},")), "{header}");
    let rows = table(&out.path().join("scores.csv"));
    let order: Vec<_> = rows.iter().map(|r| (r["scene"].as_str(), r["model"].as_str())).collect();
    let models = ["noisy", "oidn-fast", "oidn-high-prefilter"];
    let scenes = ["s0000_room", "s0010_outdoor"];
    assert_eq!(order, scenes.iter().flat_map(|s| models.map(|m| (*s, m))).collect::<Vec<_>>());
    for scene in scenes {
        let noisy = row(&rows, scene, "noisy");
        assert_eq!(
            (noisy["seconds"].as_str(), noisy["reason"].as_str()),
            ("", ""),
            "the input takes no time"
        );
        // What `demc compare` says of the same two files, digit by digit.
        let [image, reference] = ["0004spp", "ref"].map(|kind| data(&format!("{scene}_{kind}.exr")));
        let compared = demc().arg("compare").args([image, reference]).assert().success();
        for line in String::from_utf8(compared.get_output().stdout.clone()).unwrap().lines() {
            let (name, value) = line.split_once(' ').unwrap();
            assert_eq!(noisy[name], value, "{scene} {name}");
        }
        let relmse = |model: &str| row(&rows, scene, model)["relmse"].parse::<f64>().unwrap();
        assert!(relmse("oidn-fast") < 0.5 * relmse("noisy"));
        let best = row(&rows, scene, "oidn-high-prefilter");
        let number = |name: &str| best[name].parse::<f64>().unwrap();
        assert!(
            (number("ms_per_mpx") / (number("seconds") * 1e3 / (128.0 * 128.0 / 1e6)) - 1.0).abs() < 1e-5
        );
        assert_eq!(
            (best["width"].as_str(), best["height"].as_str(), best["spp"].as_str()),
            ("128", "128", "4")
        );
    }

    let summary = table(&out.path().join("summary.csv"));
    assert_eq!(summary.len(), 3);
    assert!(summary.iter().all(|s| s["scenes"] == "2" && s["baseline"] == "oidn-fast"));
    let fast: Vec<f64> =
        rows.iter().filter(|r| r["model"] == "oidn-fast").map(|r| r["relmse"].parse().unwrap()).collect();
    let geomean = (fast[0] * fast[1]).sqrt();
    assert!((summary[1]["relmse_geomean"].parse::<f64>().unwrap() / geomean - 1.0).abs() < 1e-5);
    assert_eq!(summary[1]["relmse_ratio"], "1");

    for metric in ["relmse", "ssim", "relmse_trimmed", "smape", "flip", "ms_per_mpx"] {
        for statistic in ["mean", "median", "geomean", "ratio"] {
            let value: f64 = summary[1][&format!("{metric}_{statistic}")].parse().unwrap();
            assert!(value > 0.0, "{metric}_{statistic}");
        }
    }
    assert!(summary[1]["peak_mib_max"].parse::<f64>().unwrap() > 1.0);

    for (name, texts) in [
        ("bars_relmse", ["s0000_room", "s0010_outdoor", "geometric mean", "oidn-fast"]),
        ("bars_ssim", ["s0000_room", "s0010_outdoor", "mean", "oidn-high-prefilter"]),
    ] {
        let bars = image::open(out.path().join(format!("{name}.png"))).unwrap();
        assert_eq!(bars.width(), 1600);
        let svg = fs::read_to_string(out.path().join(format!("{name}.svg"))).unwrap();
        texts.iter().for_each(|text| assert!(svg.contains(text), "{name} names {text}"));
    }
    let chart = image::open(out.path().join("speed_vs_accuracy.png")).unwrap();
    assert_eq!((chart.width(), chart.height()), (1600, 760));
    let svg = fs::read_to_string(out.path().join("speed_vs_accuracy.svg")).unwrap();
    for text in ["oidn-fast", "oidn-high-prefilter", "noisy input", "Pareto front"] {
        assert!(svg.contains(text), "the chart names {text}");
    }
    for scene in scenes {
        // Three methods and the reference, each 300 wide with 6 between.
        let sheet = image::open(out.path().join(format!("sheets/{scene}_0004spp.png"))).unwrap().to_rgb8();
        assert_eq!(sheet.width(), 4 * 306 + 6);
        assert!(sheet.pixels().collect::<std::collections::HashSet<_>>().len() > 1000, "it shows images");
    }
}

/// A folder with one good pair and pairs that cannot be scored.
fn broken_set() -> tempfile::TempDir {
    let set = tempfile::tempdir().unwrap();
    let copy = |from: &str, to: &str| fs::copy(data(from), set.path().join(to)).unwrap();
    copy("s0000_room_0004spp.exr", "good_0004spp.exr");
    copy("s0000_room_ref.exr", "good_ref.exr");
    copy("s0000_room_0004spp.exr", "cut_0004spp.exr");
    copy("s0000_room_ref.exr", "cut_ref.exr");
    let whole = fs::read(set.path().join("cut_0004spp.exr")).unwrap();
    fs::write(set.path().join("cut_0004spp.exr"), &whole[..whole.len() / 2]).unwrap();
    copy("s0000_room_0004spp.exr", "small_0004spp.exr");
    python::run(
        std::process::Command::new(python::program("oiiotool"))
            .args(["--pattern", "constant:color=0.5,0.5,0.5", "64x64", "3", "-d", "half", "-o"])
            .arg(set.path().join("small_ref.exr")),
    );
    copy("s0000_room_0004spp.exr", "lonely_0004spp.exr");
    set
}

#[test]
fn failing_scenes_leave_empty_cells_a_reason_and_exit_code_1() {
    let (set, out) = (broken_set(), tempfile::tempdir().unwrap());
    eval(set.path(), out.path(), &["--models", "noisy"]).code(1).stderr(
        predicate::str::contains("lonely_ref.exr is missing")
            .and(predicate::str::contains("cut_0004spp.exr")),
    );
    let rows = table(&out.path().join("scores.csv"));
    assert_eq!(rows.len(), 4);
    for (scene, reason) in [
        ("cut", "cut_0004spp.exr"),
        ("small", "holds 128x128 pixels at 0,0, its reference"),
        ("lonely", "lonely_ref.exr is missing; render it"),
    ] {
        let row = row(&rows, scene, "noisy");
        assert!(row["reason"].contains(reason), "{}", row["reason"]);
        for metric in ["relmse", "ssim", "rmse", "max_error", "seconds", "exposure"] {
            assert_eq!(row[metric], "", "{scene} {metric}");
        }
    }
    assert_ne!(row(&rows, "good", "noisy")["relmse"], "");
    let summary = table(&out.path().join("summary.csv"));
    assert_eq!((summary[0]["scenes"].as_str(), summary[0]["failed"].as_str()), ("1", "3"));
    assert!(!out.path().join("sheets/cut_0004spp.png").exists());
}

#[test]
fn a_score_that_is_not_defined_is_an_empty_cell_with_a_note_and_no_failure() {
    let (set, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    for (scene, size, light) in [("black", 16, 0.0), ("small", 8, 0.5)] {
        let noisy =
            |name: &str, at: usize| if name.starts_with("Combined") { 0.4 + (at % 7) as f32 } else { 1.0 };
        write_render(&set.path().join(format!("{scene}_0004spp.exr")), size, size, noisy);
        write_render(&set.path().join(format!("{scene}_ref.exr")), size, size, |_, _| light);
    }
    let run = || eval(set.path(), out.path(), &["--models", "noisy"]).success();
    run().stderr(predicate::str::contains("note: small_0004spp: no ssim"));
    let rows = table(&out.path().join("scores.csv"));
    for (scene, empty, note) in [
        ("black", &["ssim", "exposure", "flip"][..], "no ssim, exposure, flip: the reference is black"),
        ("small", &["ssim"], "no ssim: the images are smaller than its window of 11x11"),
    ] {
        let row = row(&rows, scene, "noisy");
        for metric in ["relmse", "ssim", "rmse", "max_error", "exposure", "smape", "flip"] {
            assert_eq!(row[metric].is_empty(), empty.contains(&metric), "{scene} {metric}");
        }
        assert_eq!(row["reason"], "");
        assert!(row["note"].starts_with(&format!("{scene}_0004spp: {note}")), "{}", row["note"]);
    }
    let page = fs::read_to_string(out.path().join("report.html")).unwrap();
    assert!(page.contains("the reference is black") && !page.contains("rows failed"));
    run().stderr(predicate::str::contains("2 of 2 rows are there already"));
}

#[test]
fn an_absent_peer_says_so_and_the_others_are_scored() {
    let out = tempfile::tempdir().unwrap();
    eval(&data(""), out.path(), &["--models", "oidn-high", "--oidn", "/no/such/oidnDenoise"]).code(1);
    let rows = table(&out.path().join("scores.csv"));
    for scene in ["s0000_room", "s0010_outdoor"] {
        let peer = row(&rows, scene, "oidn-high");
        assert!(peer["reason"].contains("/no/such/oidnDenoise"), "{}", peer["reason"]);
        assert_eq!((peer["relmse"].as_str(), peer["seconds"].as_str()), ("", ""));
        assert_ne!(row(&rows, scene, "noisy")["relmse"], "");
    }
    let summary = table(&out.path().join("summary.csv"));
    assert_eq!(summary[0]["scenes"], "2", "a method that scored nowhere does not limit the others");
}

#[test]
fn rows_go_with_the_weights_that_made_them() {
    let (weights, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let file = weights.path().join("lbf.safetensors");
    let rivals = Path::new(env!("CARGO_MANIFEST_DIR")).join("eval/rivals/weights");
    fs::copy(rivals.join("lbf.safetensors"), &file).unwrap();
    let mine = weights.path().join("mine.safetensors");
    fs::copy(&file, &mine).unwrap();
    let by_file = format!("lbf,{0},{0}:unrestrained", mine.display());
    let run = || {
        let mut command = demc();
        command.env("DEMC_WEIGHTS", weights.path()).args([
            "eval",
            "--repeats",
            "1",
            "--no-sheets",
            "--models",
            &by_file,
        ]);
        command.arg("--test-set").arg(data("")).arg("--out").arg(out.path()).assert().success()
    };
    run();
    let before = table(&out.path().join("scores.csv"));
    // Another number in the last weight.
    for path in [&file, &mine] {
        let mut bytes = fs::read(path).unwrap();
        let last = bytes.len() - 2;
        bytes[last] ^= 0x40;
        fs::write(path, bytes).unwrap();
    }
    run().stderr(predicate::str::contains("2 of 8 rows are there already"));
    let after = table(&out.path().join("scores.csv"));
    for model in ["lbf", "mine", "mine:unrestrained"] {
        let of = |rows: &[Row]| row(rows, "s0000_room", model)["relmse"].clone();
        assert_ne!(of(&before), of(&after), "{model}");
    }
}

#[test]
fn files_are_the_same_by_another_path_and_go_by_their_new_names() {
    let (set, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    for kind in ["0004spp", "ref"] {
        fs::copy(data(&format!("s0000_room_{kind}.exr")), set.path().join(format!("room_{kind}.exr")))
            .unwrap();
    }
    let run =
        |test_set: &Path| eval(test_set, out.path(), &["--models", "noisy,nfor", "--no-sheets"]).success();
    eval(set.path(), out.path(), &["--models", "noisy", "--no-sheets"]).success();
    run(&set.path().join("."));
    assert_eq!(table(&out.path().join("scores.csv")).len(), 2);
    let summary = table(&out.path().join("summary.csv"));
    assert!(
        summary.iter().all(|line| line["scenes"] == "1" && !line["relmse_mean"].is_empty()),
        "{summary:?}"
    );
    run(&set.path().join(".")).stderr(predicate::str::contains("2 of 2 rows are there already"));
    let manifest = set.path().join("manifest.csv");
    for (scene, spp) in [("room", 4), ("kitchen", 16)] {
        fs::write(
            &manifest,
            format!("scene,noisy,reference,spp\n{scene},room_0004spp.exr,room_ref.exr,{spp}\n"),
        )
        .unwrap();
        run(&manifest);
        let rows = table(&out.path().join("scores.csv"));
        assert_eq!((rows.len(), &*rows[0]["scene"], &*rows[0]["spp"]), (2, scene, &*spp.to_string()));
    }
}

#[test]
#[cfg(unix)]
fn a_frame_that_is_held_is_a_frame_of_its_own() {
    let (set, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    for kind in ["0004spp", "ref"] {
        let of = |frame: u32| set.path().join(format!("shot_{kind}.{frame:04}.exr"));
        fs::copy(data(&format!("s0000_room_{kind}.exr")), of(1)).unwrap();
        std::os::unix::fs::symlink(of(1), of(2)).unwrap();
    }
    eval(set.path(), out.path(), &["--models", "noisy", "--no-sheets"]).success();
    let scenes: Vec<String> =
        table(&out.path().join("scores.csv")).iter().map(|row| row["scene"].clone()).collect();
    assert_eq!(scenes, ["shot.0001", "shot.0002"]);
}

#[test]
#[cfg(unix)]
fn a_folder_whose_name_is_no_text() {
    use std::os::unix::ffi::OsStrExt;
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join(std::ffi::OsStr::from_bytes(b"out\xff"));
    eval(&data(""), &out, &["--models", "noisy"]).success();
    assert!(out.join("report.html").is_file());
}

#[test]
fn finished_rows_are_kept_and_missing_ones_run() {
    let out = tempfile::tempdir().unwrap();
    let (scores, program) = (out.path().join("scores.csv"), oidn());
    let more = ["--models", "oidn-fast", "--oidn", &program];
    let run = || eval(&data(""), out.path(), &more).success();
    run();
    let first = fs::read_to_string(&scores).unwrap();
    run().stderr(predicate::str::contains("4 of 4 rows are there already"));
    assert_eq!(fs::read_to_string(&scores).unwrap(), first, "times included: nothing ran");

    // A run killed in the middle of a line: the whole rows stay, the rest runs.
    let kept: Vec<&str> = first.lines().take(3).collect();
    fs::write(&scores, format!("{}\ns0010_outdoor,noi", kept.join("\n"))).unwrap();
    run().stderr(predicate::str::contains("2 of 4 rows are there already"));
    let again = fs::read_to_string(&scores).unwrap();
    assert_eq!(again.lines().take(3).collect::<Vec<_>>(), kept);
    assert_eq!(again.lines().count(), 5);

    // Other settings make other rows.
    eval(&data(""), out.path(), &["--models", "oidn-fast", "--oidn", &program, "--threads", "1"])
        .success()
        .stderr(predicate::str::contains("already").not());
    let rows = table(&scores);
    assert!(rows.iter().all(|r| r["threads"] == "1"));
    eval(&data(""), out.path(), &["--models", "noisy", "--threads", "1", "--overwrite"])
        .success()
        .stderr(predicate::str::contains("already").not());
    let after = table(&scores);
    assert_eq!(
        after.iter().map(|r| &r["model"][..]).collect::<Vec<_>>(),
        ["noisy", "noisy", "oidn-fast", "oidn-fast"]
    );
    let fast = |rows: &[Row]| rows.iter().filter(|r| r["model"] == "oidn-fast").cloned().collect::<Vec<_>>();
    assert_eq!(fast(&after), fast(&rows), "rows that were not asked for are as they were");
}

#[test]
fn rows_of_other_methods_and_renders_stay_as_long_as_they_hold() {
    let out = tempfile::tempdir().unwrap();
    let run = |set: &str, models: &str, threads: &str| {
        eval(&data(set), out.path(), &["--models", models, "--no-sheets", "--threads", threads]).success()
    };
    let [meadow, room] = ["s0010_outdoor_0004spp.exr", "s0000_room_0004spp.exr"];
    let read = |file: &str| fs::read_to_string(out.path().join(file)).unwrap();
    run(meadow, "demc-s", "2");
    let first = read("scores.csv");
    run(room, "noisy", "2").stderr(predicate::str::contains("dropped").not());
    let second = read("scores.csv");
    assert_eq!(second.lines().count(), 4);
    assert!(first.lines().all(|line| second.lines().any(|other| other == line)), "{first}{second}");
    assert_eq!(table(&out.path().join("summary.csv")).len(), 1, "this run's methods");
    let page = read("report.html");
    assert!(page.contains("s0000_room") && !page.contains("demc-s") && !page.contains("s0010_outdoor"));
    // What the rows are known by stays too.
    run(meadow, "demc-s", "2").stderr(predicate::str::contains("2 of 2 rows are there already"));
    run(room, "noisy", "2").stderr(predicate::str::contains("1 of 1 rows are there already"));
    // Weights that changed have changed in any arithmetic.
    let weights = out.path().join("mine.safetensors");
    for built_in in ["demc-s", "demc-m"] {
        let from = format!("{}/src/models/weights/{built_in}.safetensors", env!("CARGO_MANIFEST_DIR"));
        fs::copy(from, &weights).unwrap();
        for kept in [1, 2] {
            let kept = format!("{kept} of 2 rows are there already");
            run(meadow, &format!("{}:f32", weights.display()), "2").stderr(predicate::str::contains(kept));
        }
    }
    // Rows made with other settings do not belong into one table.
    run(room, "noisy", "1")
        .stderr(predicate::str::contains("3 rows of other methods or renders are dropped"));
    assert_eq!(table(&out.path().join("scores.csv")).len(), 1);
}

#[test]
fn a_sheet_shows_the_methods_of_the_last_run() {
    let out = tempfile::tempdir().unwrap();
    let sheet = out.path().join("sheets/s0010_outdoor_0004spp.png");
    let columns = |models: &str| {
        eval(&data("s0010_outdoor_0004spp.exr"), out.path(), &["--models", models]).success();
        (image::open(&sheet).unwrap().width() - 6) / 306
    };
    assert_eq!((columns("demc-s"), columns("noisy")), (3, 2), "methods and the reference");
    assert_eq!(columns("demc-s"), 3, "though all rows were there already");
    let changed = || fs::metadata(&sheet).unwrap().modified().unwrap();
    let before = changed();
    columns("demc-s");
    assert_eq!(changed(), before, "it shows them already");
}

#[test]
fn what_methods_say_is_on_the_page_and_stays_there() {
    let out = tempfile::tempdir().unwrap();
    let set = data("s0010_outdoor_0004spp.exr");
    let page = || fs::read_to_string(out.path().join("report.html")).unwrap();
    let run = || eval(&set, out.path(), &["--models", "kpcn", "--no-sheets"]).success();
    const NOTE: &str = "kpcn: these weights filter Combined as one stream";
    run().stderr(predicate::str::contains(NOTE));
    assert_eq!(page().matches(NOTE).count(), 1);
    // Nothing runs, so nothing is said anew.
    run().stderr(
        predicate::str::contains("2 of 2 rows are there already").and(predicate::str::contains(NOTE).not()),
    );
    assert_eq!(page().matches(NOTE).count(), 1);
    // A run without the method has nothing of it, whatever rows it keeps.
    eval(&set, out.path(), &["--models", "noisy", "--no-sheets"])
        .success()
        .stderr(predicate::str::contains("1 of 1 rows are there already"));
    assert_eq!(page().matches(NOTE).count(), 0);
}

#[test]
fn a_killed_run_keeps_its_finished_rows_and_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    let manifest = dir.path().join("set.csv");
    let (noisy, reference) = (data("s0010_outdoor_0004spp.exr"), data("s0010_outdoor_ref.exr"));
    let mut text = "scene,noisy,reference,spp\n".to_string();
    for spp in 1..=40 {
        // One file under many names would be one row: links make it many.
        let link = dir.path().join(format!("meadow_{spp:04}spp.exr"));
        fs::hard_link(&noisy, &link).or_else(|_| fs::copy(&noisy, &link).map(|_| ())).unwrap();
        text += &format!("meadow,{},{},{spp}\n", link.display(), reference.display());
    }
    fs::write(&manifest, text).unwrap();
    let out = dir.path().join("out");
    let scores = out.join("scores.csv");
    let lines = || fs::read_to_string(&scores).map_or(0, |text| text.lines().count());
    let mut child = std::process::Command::new(assert_cmd::cargo::cargo_bin("demc"))
        .args(["eval", "--models", "noisy", "--test-set"])
        .args([&manifest, Path::new("--out"), &out])
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    while lines() < 4 {
        assert!(child.try_wait().unwrap().is_none(), "it ended before it could be killed");
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    child.kill().unwrap();
    assert!(!child.wait().unwrap().success());
    let text = fs::read_to_string(&scores).unwrap();
    let whole = text.rfind('\n').unwrap() + 1;
    let kept = text[..whole].lines().count() - 1;
    assert!((3..40).contains(&kept), "{kept} rows");
    assert!(!out.join("summary.csv").exists());

    eval(&manifest, &out, &["--models", "noisy", "--repeats", "3"])
        .success()
        .stderr(predicate::str::contains(format!("{kept} of 40 rows are there already")));
    let again = fs::read_to_string(&scores).unwrap();
    assert!(again.starts_with(&text[..whole]), "the rows of the killed run are untouched");
    assert_eq!(table(&scores).len(), 40);
    assert!(out.join("report.html").is_file());
}

#[test]
fn test_set_may_be_a_manifest_or_a_glob() {
    let dir = tempfile::tempdir().unwrap();
    let manifest = dir.path().join("set.csv");
    let (noisy, reference) = (data("s0010_outdoor_0004spp.exr"), data("s0010_outdoor_ref.exr"));
    let text = format!("scene,noisy,reference,spp\nmeadow,{},{},4\n", noisy.display(), reference.display());
    fs::write(&manifest, text).unwrap();
    let out = dir.path().join("a/b");
    eval(&manifest, &out, &["--models", "noisy", "--no-sheets"]).success();
    let rows = table(&out.join("scores.csv"));
    assert_eq!((rows.len(), rows[0]["scene"].as_str()), (1, "meadow"));
    assert!(!out.join("sheets").exists());

    let out = dir.path().join("c");
    eval(&data("*room_0004spp.exr"), &out, &["--models", "noisy", "--no-sheets"]).success();
    assert_eq!(table(&out.join("scores.csv"))[0]["relmse"].get(..5), Some("0.920"));
}

#[test]
fn wrong_command_lines_exit_with_2_and_write_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    for (set, more, expected) in [
        (data("nothing-here"), vec!["--models", "noisy"], "nothing there by that name"),
        (data("*.tif"), vec!["--models", "noisy"], "no file matches"),
        (data(""), vec!["--models", "no-such-model"], "no-such-model"),
        (data(""), vec!["--models", "noisy", "--baseline", "kpcn"], "--baseline kpcn"),
        (data(""), vec!["--models", "noisy", "--repeats", "0"], "--repeats"),
    ] {
        eval(&set, &out, &more).code(predicate::in_iter([2])).stderr(predicate::str::contains(expected));
        assert!(!out.exists(), "{expected}");
    }
}

#[test]
fn an_unwritable_output_is_one_line() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("file");
    fs::write(&file, "").unwrap();
    eval(&data(""), &file.join("out"), &["--models", "noisy"]).code(1).stderr(
        predicate::str::contains("cannot create").and(predicate::function(|t: &str| t.lines().count() == 1)),
    );
}

#[test]
fn a_reference_of_another_scene_is_scored_and_said_to_be_one() {
    let out = tempfile::tempdir().unwrap();
    let manifest = out.path().join("set.csv");
    let row = |scene: &str, reference: &str| {
        let [noisy, reference] =
            ["s0010_outdoor_0004spp.exr", reference].map(|name| data(name).display().to_string());
        format!("{scene},{noisy},{reference},4\n")
    };
    let rows = row("good", "s0010_outdoor_ref.exr") + &row("swapped", "s0000_room_ref.exr");
    fs::write(&manifest, format!("scene,noisy,reference,spp\n{rows}")).unwrap();
    let said = "do not show the same scene";
    eval(&manifest, out.path(), &["--models", "noisy", "--no-sheets"])
        .success()
        .stderr(predicate::str::contains("note: swapped_0004spp: ").and(predicate::str::contains(said)))
        .stderr(predicate::str::contains("good_0004spp: ").not());
    assert!(table(&out.path().join("scores.csv")).iter().all(|row| !row["relmse"].is_empty()));
    for file in ["scores.csv", "report.html"] {
        assert_eq!(fs::read_to_string(out.path().join(file)).unwrap().matches(said).count(), 1, "{file}");
    }
}
