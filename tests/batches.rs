//! Batches: folders with all that is in them, several frames at once, and renders that are still coming in.
//!
//! The method is `noisy`, which returns its input, or `demc-s` where it matters how frames are computed.

mod common;

use std::{
    fs,
    io::{BufRead, BufReader},
    path::{Path, PathBuf},
    process::{Child, Command as Process, Stdio},
    time::{Duration, Instant},
};

use assert_cmd::cargo::cargo_bin;
use common::{
    BY, demc,
    files::{data, read_exr, samples, touch_later, write_render},
    shot::SHOT,
};
use predicates::{prelude::*, str::contains};
use tempfile::TempDir;

/// Every file below a folder, as a path from there, sorted.
fn tree(folder: &Path) -> Vec<String> {
    let mut found = Vec::new();
    let mut left = vec![folder.to_path_buf()];
    while let Some(at) = left.pop() {
        for entry in fs::read_dir(&at).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                left.push(path);
            } else {
                found.push(path.strip_prefix(folder).unwrap().to_str().unwrap().replace('\\', "/"));
            }
        }
    }
    found.sort();
    found
}

/// A folder with renders in folders of it.
fn renders() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    for name in ["a.exr", "one/shot.0001.exr", "one/shot.0002.exr", "two/deep/shot.0001.exr", ".trash/b.exr"]
    {
        let path = folder.path().join("renders").join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        let seed = name.len();
        write_render(&path, 40, 30, |_, pixel| ((pixel * 31 + seed) % 97) as f32 / 97.0);
    }
    folder
}

fn denoise(folder: &Path, arguments: &str) -> assert_cmd::assert::Assert {
    let mut command = demc();
    command.current_dir(folder).args(["denoise", "--model", "noisy"]).args(arguments.split_whitespace());
    command.assert()
}

#[test]
fn recursive_keeps_the_tree_below_out_and_hidden_folders_out() {
    let folder = renders();
    denoise(folder.path(), "renders --out clean --recursive").success().stdout(contains("4 denoised"));
    let expected = ["a.exr", "one/shot.0001.exr", "one/shot.0002.exr", "two/deep/shot.0001.exr"];
    assert_eq!(tree(&folder.path().join("clean")), expected);
    // Without it, the folder's own files alone.
    denoise(folder.path(), "renders --out flat").success();
    assert_eq!(tree(&folder.path().join("flat")), ["a.exr"]);
    denoise(folder.path(), "renders/two --out none").code(2).stderr(contains("add --recursive"));
}

#[test]
fn results_inside_the_folder_that_is_searched_are_no_inputs() {
    let folder = renders();
    let run = "renders --out renders/clean --recursive";
    denoise(folder.path(), run).success().stdout(contains("4 denoised"));
    denoise(folder.path(), run).success().stdout(contains("0 denoised, 4 already there"));
    assert_eq!(tree(&folder.path().join("renders/clean")).len(), 4);
}

#[test]
fn two_inputs_of_one_place_are_refused_and_sources_are_never_overwritten() {
    let folder = renders();
    denoise(folder.path(), "renders/one renders/two/deep --out clean --recursive")
        .code(2)
        .stderr(contains("would both be written to clean/shot.0001.exr").and(contains("--recursive")));
    denoise(folder.path(), "renders --out renders --recursive")
        .code(2)
        .stderr(contains("would overwrite its input"));
    denoise(folder.path(), "renders --out renders --recursive --watch 1")
        .code(2)
        .stderr(contains("would overwrite its input"));
    assert!(!folder.path().join("clean").exists());
}

#[test]
#[cfg(unix)]
fn links_to_folders_are_not_followed() {
    let folder = renders();
    std::os::unix::fs::symlink("..", folder.path().join("renders/one/back")).unwrap();
    denoise(folder.path(), "renders --out clean --recursive").success().stdout(contains("4 denoised"));
}

#[test]
fn a_report_and_inspect_search_folders_too() {
    let folder = renders();
    let run = denoise(folder.path(), "renders --out clean --recursive --json --frames 1").success();
    fs::write(folder.path().join("log.jsonl"), &run.get_output().stdout).unwrap();
    let report = |more: &str| {
        let mut command = demc();
        command.current_dir(folder.path()).args(["report", "log.jsonl", "--of", "renders"]);
        command.args(more.split_whitespace()).assert()
    };
    report("--recursive")
        .code(1)
        .stdout(contains("missing: renders/one/shot.0002.exr").and(contains("2 missing")));
    report("").code(1).stdout(contains("1 missing"));
    // What cannot be looked at is told beside what can, and does not stay failed once its files are done.
    fs::create_dir(folder.path().join("empty")).unwrap();
    let report = |of: &[&str]| {
        let mut command = demc();
        command.current_dir(folder.path()).args(["report", "log.jsonl", "--of"]).args(of).assert()
    };
    report(&["renders/two/deep"]).success();
    report(&["renders/two/deep", "empty"]).code(1).stdout(contains("missing: empty: no EXR files"));
    let mut log = fs::read(folder.path().join("log.jsonl")).unwrap();
    log.extend(br#"{"input":"renders/two/deep","status":"failed","error":"renders/two/deep: cannot read"}"#);
    fs::write(folder.path().join("log.jsonl"), log).unwrap();
    report(&["renders/two/deep"]).success();
    demc()
        .current_dir(folder.path())
        .args(["inspect", "renders", "--recursive"])
        .assert()
        .success()
        .stdout(contains("renders/two/deep/shot.0001.exr"));
}

#[test]
fn a_report_goes_by_the_last_try_of_a_log_and_finds_what_was_never_rendered() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    fs::create_dir(path("shot")).unwrap();
    for name in ["a.0001.exr", "a.0002.exr"] {
        write_render(&path("shot").join(name), 24, 18, |_, pixel| (pixel % 7) as f32 / 7.0);
    }
    let log = |name: &str, arguments: &str| {
        let mut command = demc();
        command.current_dir(folder.path()).args(["denoise", "shot", "--json", "--model", "noisy", "--out"]);
        let run = command.args(arguments.split_whitespace()).output().unwrap();
        let mut lines = fs::read(path(name)).unwrap_or_default();
        lines.extend(run.stdout);
        fs::write(path(name), lines).unwrap();
    };
    let report = |arguments: &str| {
        let mut command = demc();
        command.current_dir(folder.path()).arg("report").args(arguments.split_whitespace()).assert()
    };
    // Results among the renders are no renders.
    log("one.jsonl", "shot/clean");
    report("one.jsonl --of shot --recursive").success().stdout(contains("2 denoised"));
    report("one.jsonl --of shot --frames 1-2").success();
    report("one.jsonl --of shot --frames 1-4")
        .code(1)
        .stdout(contains("frames 3-4").and(contains("2 missing")));
    report("one.jsonl --of shot --frames 2,4-8:2")
        .code(1)
        .stdout(contains("frames 4,6,8").and(contains("3 missing")));
    // What a farm's engine puts before each line, an editor before the first, and a killed task before the next.
    let lines = fs::read_to_string(path("one.jsonl")).unwrap();
    let prefixed =
        format!("\u{feff}{}", lines.replace("{\"input\":", "pid=12 > {\"input\":\"a.exr\",\"out{\"input\":"));
    fs::write(path("prefixed.jsonl"), prefixed).unwrap();
    report("prefixed.jsonl --of shot").success().stderr("");
    // A frame that is rendered again and cannot be denoised is not what it was before; in another log it may be.
    let whole = fs::read(path("shot/a.0002.exr")).unwrap();
    fs::write(path("shot/a.0002.exr"), &whole[..whole.len() / 2]).unwrap();
    log("two.jsonl", "shot/clean --overwrite");
    report("one.jsonl two.jsonl").success();
    report("two.jsonl one.jsonl").success();
    log("one.jsonl", "shot/clean --overwrite");
    report("one.jsonl").code(1).stdout(contains("failed: ").and(contains("a.0002.exr")));
    fs::write(path("shot/a.0002.exr"), &whole).unwrap();
    log("one.jsonl", "shot/clean --overwrite");
    report("one.jsonl").success();
}

#[test]
fn no_more_threads_are_started_than_there_is_use_for() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = demc();
    command.args(["denoise", "--model", "demc-s", "--threads", "4096", "--out"]).arg(folder.path());
    command.arg(data("s0000_room_0004spp.exr")).timeout(Duration::from_secs(120)).assert().success();
}

#[test]
#[cfg(unix)]
fn a_folder_that_may_not_be_read_is_a_failure_and_no_wrong_usage() {
    use std::os::unix::fs::PermissionsExt;
    let folder = renders();
    let closed = folder.path().join("renders/one");
    fs::set_permissions(&closed, fs::Permissions::from_mode(0o000)).unwrap();
    // Who may read everything, as in a container, has nothing to see here.
    if fs::read_dir(&closed).is_err() {
        denoise(folder.path(), "renders/one --out clean --json")
            .code(1)
            .stdout(contains(r#""status":"failed""#))
            .stderr(contains("renders/one"));
    }
    fs::set_permissions(&closed, fs::Permissions::from_mode(0o755)).unwrap();
}

#[test]
fn frames_at_once_come_to_the_same_bits() {
    let folder = tempfile::tempdir().unwrap();
    let renders = folder.path().join("renders");
    fs::create_dir(&renders).unwrap();
    for frame in 1..=5 {
        let name = if frame % 2 == 0 { "s0010_outdoor" } else { "s0000_room" };
        fs::copy(data(&format!("{name}_0004spp.exr")), renders.join(format!("shot.{frame:04}.exr"))).unwrap();
    }
    let run = |out: &str, more: &str| {
        let mut command = demc();
        command.current_dir(folder.path()).args(["denoise", "renders", "--model", "demc-s", "--out", out]);
        command.args(more.split_whitespace()).assert().success();
        tree(&folder.path().join(out))
            .iter()
            .map(|name| fs::read(folder.path().join(out).join(name)).unwrap())
            .collect::<Vec<_>>()
    };
    let alone = run("alone", "--threads 3");
    assert_eq!(alone.len(), 5);
    assert!(alone == run("two", "--threads 3 --jobs 2"));
    assert!(alone == run("four", "--threads 4 --jobs 4"));
    // A sequence is cut into stretches, each of which reads the frames around it.
    (1..=5).for_each(|frame| SHOT.write(&renders.join(format!("shot.{frame:04}.exr")), frame));
    let sequence = run("sequence", "--temporal 2");
    assert!(sequence.iter().zip(run("each", "")).all(|(with, alone)| *with != alone));
    assert!(sequence == run("stretches", "--temporal 2 --threads 3 --jobs 3"));
    fs::remove_file(folder.path().join("stretches/shot.0002.exr")).unwrap();
    assert!(sequence == run("stretches", "--temporal 2 --threads 2 --jobs 2"), "a batch that goes on");
}

#[test]
fn results_older_than_their_renders_are_told_and_kept() {
    let folder = renders();
    denoise(folder.path(), "renders --out clean").success();
    let again = denoise(folder.path(), "renders --out clean").success();
    again.stdout(contains("is there already")).stderr(contains("older").not());
    touch_later(&folder.path().join("renders/a.exr"));
    let told = denoise(folder.path(), "renders --out clean").success();
    told.stderr(contains("a.exr: is older than its render, and was kept; --overwrite denoises that again"));
    let run = denoise(folder.path(), "renders --out clean --json").success();
    let line: serde_json::Value = serde_json::from_slice(&run.get_output().stdout).unwrap();
    assert_eq!(line["status"], "skipped");
    assert!(line["notes"][0].as_str().unwrap().contains("older than its render"), "{line}");
    denoise(folder.path(), "renders --out clean --overwrite").success().stderr(contains("older").not());
}

#[test]
fn results_that_were_made_otherwise_are_told_and_kept() {
    let folder = tempfile::tempdir().unwrap();
    SHOT.write(&folder.path().join("a.exr"), 1);
    fs::create_dir(folder.path().join("weights")).unwrap();
    let weights = concat!(env!("CARGO_MANIFEST_DIR"), "/src/models/weights/demc-s.safetensors");
    fs::copy(weights, folder.path().join("weights/mine.safetensors")).unwrap();
    let run = |arguments: &str| {
        let mut command = demc();
        command.current_dir(folder.path()).arg("denoise").args(arguments.split_whitespace());
        command.assert().success()
    };
    let is_made = || contains("was made with");
    let first = "a.exr --out out --model weights/mine.safetensors:f32 --alpha keep";
    run(first).stderr(is_made().not());
    run(first).stdout(contains("is there already")).stderr(is_made().not());
    let told = |made: &str, now: &str| {
        let why = format!("was made with {BY} {made}, and was kept; --overwrite makes it with {BY} {now}");
        contains(format!("demc: note: out{}a.exr: {why}", std::path::MAIN_SEPARATOR))
    };
    let made = "--model weights/mine.safetensors:f32 --alpha keep";
    run("a.exr --out out --model demc-s").stderr(told(made, "--model demc-s"));
    run("a.exr --out out --model weights/mine.safetensors:f32 --wrap x")
        .stderr(told(made, "--model weights/mine.safetensors:f32 --wrap x"));
    run("a.exr --out out --model weights/mine.safetensors:f32 --alpha keep --map albedo=Colour")
        .stderr(told(made, &format!("{made} --map 'Denoising Albedo=Colour'")));
    // Weights of every run are called alike.
    fs::create_dir(folder.path().join("other")).unwrap();
    fs::copy(weights, folder.path().join("other/mine.safetensors")).unwrap();
    run("a.exr --out out --model other/mine.safetensors:f32 --alpha keep")
        .stderr(told(made, "--model other/mine.safetensors:f32 --alpha keep"));
    // Each layer was made in its own way.
    run("out --out more --layer Second --model demc-s");
    run("out --out more --layer Second --model demc-s").stderr(is_made().not());
    run(&first.replace("a.exr --out out", "out --out more")).stderr(is_made().not());
    run("out --out more --layer Second")
        .stderr(contains(format!("made with {BY} --model demc-s, and was kept")));
    demc()
        .current_dir(folder.path())
        .args(["inspect", "more/a.exr"])
        .assert()
        .success()
        .stdout(contains(format!("'ViewLayer.Denoised' was made with {BY} {made}\n")))
        .stdout(contains(format!("'ViewLayer.Second' was made with {BY} --model demc-s\n")));
    // Names of layers may hold what stands between other things.
    run("a.exr --out odd --layer Final:_v2 --model demc-s");
    run("a.exr --out odd --layer Final:_v2")
        .stderr(contains(format!("made with {BY} --model demc-s, and was kept")));
    // What is made anew is made as it was asked for.
    run("a.exr --out out --model demc-s --overwrite");
    run("a.exr --out out --model demc-s").stderr(is_made().not());
    run(first).stderr(told("--model demc-s", made));
}

#[test]
fn more_frames_at_once_than_threads_are_told_of() {
    let folder = renders();
    denoise(folder.path(), "renders --recursive --out clean --jobs 8 --threads 2")
        .success()
        .stderr(contains("--jobs 8: one for each of the 2 threads"))
        .stdout(contains("4 denoised"));
    denoise(folder.path(), "renders --out clean --jobs 0").code(2);
}

#[test]
fn json_tells_what_was_found_in_each_frame() {
    let folder = tempfile::tempdir().unwrap();
    let run = demc()
        .args(["denoise", "--model", "noisy", "--json", "--out"])
        .arg(folder.path())
        .arg(data("blender5.exr"))
        .assert()
        .success();
    let line: serde_json::Value = serde_json::from_slice(&run.get_output().stdout).unwrap();
    let passes: Vec<&str> =
        line["passes"].as_array().unwrap().iter().map(|pass| pass.as_str().unwrap()).collect();
    assert!(passes.contains(&"Denoising Albedo") && passes.contains(&"Vector"), "{line}");
    assert!(line["samples"].is_u64() && line["was_denoised"] == false, "{line}");
}

#[test]
fn without_a_terminal_each_line_tells_frames_per_second_and_the_time_left() {
    let folder = renders();
    let run = denoise(folder.path(), "renders --recursive --out clean").success();
    let said = String::from_utf8(run.get_output().stdout.clone()).unwrap();
    let lines: Vec<&str> = said.lines().collect();
    assert!(
        lines[0].starts_with("[1/4] ") && lines[0].contains(" frames/s, ") && lines[0].ends_with(" left")
    );
    assert!(lines[3].starts_with("[4/4] ") && !lines[3].contains("left"), "{said}");
}

/// A watch over the folder `renders`, as an artist starts one.
struct Watch {
    folder: TempDir,
    child: Child,
    lines: std::io::Lines<BufReader<std::process::ChildStdout>>,
}

impl Watch {
    fn start(arguments: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mut child = Process::new(cargo_bin("demc"))
            .current_dir(folder.path())
            .args(["denoise", "renders", "--out", "clean", "--model", "noisy"])
            .args(arguments.split_whitespace())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let first = lines.next().unwrap().unwrap();
        assert!(first.starts_with("watching for renders; "), "{first}");
        Self { folder, child, lines }
    }

    fn path(&self, name: &str) -> PathBuf {
        let path = self.folder.path().join("renders").join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        path
    }

    fn next(&mut self) -> String {
        self.lines.next().expect("it says more").unwrap()
    }

    /// The exit code, what else it said, and its errors.
    fn end(mut self) -> (Option<i32>, String, String, TempDir) {
        let rest: Vec<String> = self.lines.by_ref().map(Result::unwrap).collect();
        let done = self.child.wait_with_output().unwrap();
        (done.status.code(), rest.join("\n"), String::from_utf8(done.stderr).unwrap(), self.folder)
    }
}

#[test]
fn a_watch_takes_each_render_when_it_is_whole_and_ends_when_none_comes() {
    let bytes = fs::read(data("blender5.exr")).unwrap();
    // The folder is not there yet, as before the first frame of a render.
    let mut watch = Watch::start("--watch 5 --recursive");
    fs::write(watch.path("shot.0001.exr"), &bytes).unwrap();
    assert!(watch.next().starts_with("[1] clean/shot.0001.exr"));
    // A renderer that writes for a while: a placeholder, half a file, all of it. What came before is not done
    // again.
    let slow = watch.path("deep/shot.0002.exr");
    fs::write(&slow, "").unwrap();
    std::thread::sleep(Duration::from_millis(1500));
    fs::write(&slow, &bytes[..bytes.len() / 2]).unwrap();
    std::thread::sleep(Duration::from_millis(3000));
    assert!(!watch.folder.path().join("clean/deep/shot.0002.exr").exists(), "it is half written");
    fs::write(&slow, &bytes).unwrap();
    assert!(watch.next().starts_with("[2] clean/deep/shot.0002.exr"));
    let (code, rest, errors, folder) = watch.end();
    assert_eq!((code, rest.as_str(), errors.as_str()), (Some(0), "2 denoised", ""));
    let result = read_exr(folder.path().join("clean/deep/shot.0002.exr"));
    assert!(samples(&result, "ViewLayer.Denoised.R").is_some());
}

#[test]
fn a_watch_names_what_never_became_whole_and_goes_on_after_a_bad_frame() {
    let bytes = fs::read(data("blender5.exr")).unwrap();
    let mut watch = Watch::start("--watch 3 --view-layer ViewLayer");
    fs::write(watch.path("half.exr"), &bytes[..bytes.len() / 2]).unwrap();
    fs::write(watch.path("placeholder.exr"), "").unwrap();
    // Whole, but it has no such view layer.
    fs::copy(data("s0000_room_0004spp.exr"), watch.path("other.exr")).unwrap();
    common::files::write_bare_parts(&watch.path("bare.exr"), &["V.Combined"]);
    assert!(watch.next().contains("clean/other.exr"));
    let (code, rest, errors, _) = watch.end();
    assert_eq!(code, Some(1), "{errors}");
    assert!(rest.contains("1 denoised, 3 failed"), "{rest}");
    for part in
        ["half.exr: is truncated", "placeholder.exr: is empty", "bare.exr: has no view layer 'ViewLayer'"]
    {
        assert!(errors.contains(part), "{part}: {errors}");
    }
}

#[test]
fn a_render_that_is_made_again_is_denoised_again_with_overwrite() {
    let mut watch = Watch::start("--watch 4 --overwrite");
    let path = watch.path("shot.0001.exr");
    write_render(&path, 8, 6, |_, _| 0.25);
    assert!(watch.next().starts_with("[1] "));
    write_render(&path, 12, 6, |_, _| 0.5);
    assert!(watch.next().starts_with("[2] clean/shot.0001.exr  12x6"));
    assert_eq!(watch.end().0, Some(0));
}

#[test]
#[cfg(unix)]
fn ctrl_c_ends_a_watch_soon() {
    let mut watch = Watch::start("--watch --jobs 2");
    // One that is broken is tried first, and is told in the end.
    fs::write(watch.path("cut.exr"), &fs::read(data("blender5.exr")).unwrap()[..5000]).unwrap();
    std::thread::sleep(Duration::from_millis(2500));
    write_render(&watch.path("shot.0001.exr"), 8, 6, |_, _| 0.25);
    assert!(watch.next().starts_with("[1] "));
    let start = Instant::now();
    Process::new("kill").args(["-INT", &watch.child.id().to_string()]).status().unwrap();
    let (code, rest, errors, _) = watch.end();
    assert_eq!((code, rest.as_str()), (Some(130), "1 denoised, 1 failed"));
    assert!(errors.contains("cut.exr: is truncated"), "{errors}");
    assert!(start.elapsed() < Duration::from_secs(5));
}

#[test]
fn a_watch_takes_no_sequence_windows_and_picks_frames() {
    let folder = renders();
    denoise(folder.path(), "renders --out clean --watch 1 --temporal").code(2).stderr(contains("--temporal"));
    denoise(folder.path(), "renders --recursive --out clean --watch 1 --frames 2")
        .success()
        .stdout(contains("[1] clean/one/shot.0002.exr").and(contains("1 denoised")));
    // Frames that have not come are told, as without a watch.
    denoise(folder.path(), "renders --recursive --out clean --watch 1 --frames 2,77")
        .success()
        .stderr(contains("no input is of frame 77"));
    denoise(folder.path(), "renders --recursive --out clean --watch 1 --frames 77")
        .code(1)
        .stderr(contains("no file of --frames has come"));
    denoise(folder.path(), "--out clean --watch renders").code(2).stderr(contains("name inputs before it"));
}
