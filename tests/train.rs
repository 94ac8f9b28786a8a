//! `demc train` through the binary: run folder, exact resumption, weights files, errors.

mod common;

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    sync::atomic::{AtomicBool, Ordering},
    time::{Duration, Instant},
};

use assert_cmd::cargo::cargo_bin;
use demc::{
    Error,
    models::{self, weights_file},
    nn::weights::{self, Tensor},
    shot,
    train::{self, TrainEvent, TrainOptions},
};
use predicates::prelude::*;

/// Two real pairs: one to train on, one to validate on.
fn data(scene: &str) -> String {
    format!("{}/tests/data/{scene}_*.exr", env!("CARGO_MANIFEST_DIR"))
}

fn train(out: &Path, steps: usize) -> Command {
    train_with("demc-s", "64", out, steps)
}

fn train_with(model: &str, patch: &str, out: &Path, steps: usize) -> Command {
    train_every(4, model, patch, out, steps)
}

fn train_every(every: usize, model: &str, patch: &str, out: &Path, steps: usize) -> Command {
    let mut command = Command::new(cargo_bin("demc"));
    command.args(["train", "--data", &data("s0000_room"), "--val", &data("s0010_outdoor"), "--batch", "2"]);
    command.args(["--patch", patch, "--every", &every.to_string(), "--model", model, "--seed", "5"]);
    command.args(["--steps", &steps.to_string()]).arg("--out").arg(out);
    command
}

fn run(command: &mut Command) -> assert_cmd::assert::Assert {
    assert_cmd::Command::from_std(std::mem::replace(command, Command::new("true"))).assert()
}

fn resume(out: &Path) -> Command {
    let mut command = Command::new(cargo_bin("demc"));
    command.arg("train").arg("--resume").arg("--out").arg(out);
    command
}

fn tensors(out: &Path) -> Vec<Tensor> {
    weights::read(&out.join("checkpoint.safetensors")).expect("a checkpoint").1
}

/// Steps, rates, losses and scores of the log: everything but the clock.
fn log(out: &Path) -> Vec<String> {
    let text = fs::read_to_string(out.join("log.csv")).expect("a log");
    text.lines()
        .map(|line| {
            let cells: Vec<&str> = line.split(',').collect();
            [&cells[..1], &cells[2..]].concat().join(",")
        })
        .collect()
}

#[test]
fn a_run_leaves_its_folder_and_its_weights_denoise() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = dir.path().join("run");
    run(&mut train(&out, 8)).success();
    for name in ["config.json", "log.csv", "loss.png", "checkpoint.safetensors", "best.safetensors"] {
        assert!(out.join(name).is_file(), "{name} is missing");
    }
    let rows = log(&out);
    assert_eq!(rows[0], "step,lr,train_loss,val_relmse,val_ssim");
    assert_eq!(rows.len(), 3, "a row every 4 of 8 steps");
    let chart = image::open(out.join("loss.png")).expect("a chart");
    assert_eq!((chart.width(), chart.height()), (1200, 560));
    let input = format!("{}/tests/data/s0010_outdoor_0004spp.exr", env!("CARGO_MANIFEST_DIR"));
    let images = dir.path().join("images");
    let mut denoise = Command::new(cargo_bin("demc"));
    denoise.args(["denoise", &input, "--out"]).arg(&images).arg("--model").arg(out.join("best.safetensors"));
    run(&mut denoise).success();
    assert!(images.join("s0010_outdoor_0004spp.exr").is_file());
}

#[test]
fn weights_know_the_ranges_that_eight_bits_need() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = dir.path().join("run");
    run(&mut train(&out, 4)).success();
    let weights = out.join("best.safetensors");
    let ranges = weights_file::read(&weights).expect("weights").1.ranges;
    assert_eq!(ranges.len(), 2 * 27, "every layer that ends in a ReLU, the prefilter's too: {ranges:?}");
    assert!(ranges.values().all(|range| *range > 0.0 && range.is_finite()), "{ranges:?}");
    let frame = format!("{}/tests/data/s0010_outdoor_0004spp.exr", env!("CARGO_MANIFEST_DIR"));
    let shot = shot::prepare(&frame, None).expect("a frame");
    let image = |arithmetic: &str| {
        let model = models::open(&format!("{}:{arithmetic}", weights.display())).expect("it has ranges");
        model.denoise(&shot).expect("all passes are there").data
    };
    let (exact, rounded) = (image("f32"), image("int8"));
    let energy: f32 = exact.iter().map(|v| v * v).sum();
    let difference: f32 = exact.iter().zip(&rounded).map(|(a, b)| (a - b).powi(2)).sum();
    assert!(difference > 0.0 && difference < 1e-3 * energy, "{}", (difference / energy).sqrt());
}

#[cfg(unix)]
#[test]
fn a_run_stopped_by_interrupt_and_by_kill_ends_with_the_same_bits() {
    let dir = tempfile::tempdir().expect("a folder");
    let (whole, cut) = (dir.path().join("whole"), dir.path().join("cut"));
    // Muon keeps all the state there is: biases and heads go by Adam.
    let train = |out: &Path, steps| {
        let mut command = train(out, steps);
        command.args(["--optimizer", "muon"]);
        command
    };
    run(&mut train(&whole, 24)).success();

    // Interrupted as soon as the first row of the log is there: a checkpoint is written.
    let mut child = train(&cut, 24).stderr(Stdio::null()).spawn().expect("demc starts");
    wait_for(&cut.join("log.csv"));
    let interrupt = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(interrupt.expect("kill runs").success());
    let status = child.wait().expect("demc ends");
    let at = log(&cut).len();
    assert!(status.code() == Some(130) || at == log(&whole).len(), "interrupted: {status}");

    // Killed without warning: what came after the last checkpoint is done again.
    let mut child = resume(&cut).stderr(Stdio::null()).spawn().expect("demc starts");
    std::thread::sleep(Duration::from_millis(300));
    child.kill().expect("demc is killed");
    child.wait().expect("demc ends");

    run(&mut resume(&cut)).success();
    assert_eq!(log(&cut), log(&whole));
    assert_eq!(tensors(&cut), tensors(&whole));
    let best = |out: &PathBuf| weights::read(&out.join("best.safetensors")).expect("weights").1;
    assert_eq!(best(&cut), best(&whole));
    // A finished run has nothing left to do.
    run(&mut resume(&cut)).success();
    assert_eq!(tensors(&cut), tensors(&whole));
}

fn wait_for(path: &Path) {
    let start = Instant::now();
    while !path.exists() {
        assert!(start.elapsed() < Duration::from_secs(120), "{} never came", path.display());
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn skipped_steps_are_told_and_a_run_that_takes_none_stops_with_the_checkpoint_before() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = dir.path().join("run");
    // The first step leaves weights that make no finite image; without --val, none is asked for.
    let mut command = Command::new(cargo_bin("demc"));
    command.args(["train", "--data", &data("s0010_outdoor"), "--batch", "1", "--patch", "32"]);
    command.args(["--model", "demc-s", "--every", "4", "--steps", "24", "--lr", "1e30:1e30"]);
    let says = predicate::str::contains;
    run(command.arg("--out").arg(&out))
        .code(1)
        .stderr(says("warning: 3 of the last 4 steps").and(says("none of the last 12 steps")));
    let rows = log(&out);
    assert_eq!(rows.len(), 4, "{rows:?}");
    assert!(rows[1].starts_with("4,") && !rows[1].contains("NaN"), "{rows:?}");
    assert!(rows[2].starts_with("8,") && rows[2].ends_with(",,,"), "no loss without a step: {rows:?}");

    // Step 1 goes well, step 2 leaves such weights, step 3 is skipped.
    let options = options(&out);
    let well = TrainOptions { lr: (1e-4, 1e-4), ..options.clone() };
    let cut = dir.path().join("cut");
    assert!(matches!(run_until(&well, &cut, false, 1), Err(Error::Interrupted)));
    let good = tensors(&cut);
    assert!(matches!(run_until(&options, &cut, true, 3), Err(Error::Interrupted)));
    assert_eq!(tensors(&cut), good);
}

/// What a run's config.json holds.
fn options(out: &Path) -> TrainOptions {
    let text = fs::read_to_string(out.join("config.json")).expect("a configuration");
    serde_json::from_str(&text).expect("options")
}

/// Has a run go on by other settings.
fn configure(out: &Path, options: &TrainOptions) {
    let text = serde_json::to_string(options).expect("text");
    fs::write(out.join("config.json"), text).expect("a file");
}

/// Trains in this process until the step `stop_at`, as if interrupted there.
fn run_until(options: &TrainOptions, out: &Path, resume: bool, stop_at: usize) -> demc::Result<()> {
    let stop = AtomicBool::new(false);
    train::run(options, out, resume, &stop, &mut |event| {
        if matches!(event, TrainEvent::Step { step, .. } if step == stop_at) {
            stop.store(true, Ordering::Relaxed);
        }
    })
}

#[test]
fn a_resumed_run_needs_none_of_the_weights_it_began_with() {
    let dir = tempfile::tempdir().expect("a folder");
    let (first, other) = (dir.path().join("first"), dir.path().join("other"));
    run(&mut train(&first, 2)).success();
    let begin = first.join("best.safetensors");
    let (whole, cut) = (dir.path().join("whole"), dir.path().join("cut"));
    run(train(&other, 2).arg("--init").arg(&begin).arg("--prefilter").arg(&begin)).success();
    let options = TrainOptions { steps: 6, every: 2, ..options(&other) };
    run_until(&options, &whole, false, 0).expect("it ends");
    assert!(matches!(run_until(&options, &cut, false, 3), Err(Error::Interrupted)));
    fs::remove_file(&begin).expect("it was there");
    // Steps 4 and 6 are followed by a validation, which is given up and done on the way on.
    for (stop_at, rows) in [(4, ["step", "2"].as_slice()), (6, &["step", "2", "4"])] {
        assert!(matches!(run_until(&options, &cut, true, stop_at), Err(Error::Interrupted)));
        let first = |row: &String| row.split(',').next().expect("a cell").to_owned();
        assert_eq!(log(&cut).iter().map(first).collect::<Vec<_>>(), rows);
        // Killed when the row has just been written: the checkpoint does not know of it.
        let killed = || {
            let mut on = |event| assert!(!matches!(event, TrainEvent::Logged(_)), "killed");
            train::run(&options, &cut, true, &AtomicBool::new(false), &mut on)
        };
        assert!(std::panic::catch_unwind(killed).is_err());
    }
    run_until(&options, &cut, true, 0).expect("it ends");
    assert_eq!(log(&cut), log(&whole));
    assert_eq!(tensors(&cut), tensors(&whole));
    let best =
        |out: &Path| weights_file::read(&out.join("best.safetensors")).expect("weights").1.training.steps;
    assert_eq!(best(&cut), best(&whole));
    let held = |out: &Path| {
        let (_, metadata) = weights_file::read(&out.join("last.safetensors")).expect("weights");
        (metadata.network, metadata.ranges)
    };
    assert_eq!(held(&cut), held(&whole));
}

#[test]
fn the_best_weights_are_those_of_the_best_row() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = dir.path().join("run");
    run(train_with("demc-s", "32", &out, 4).args(["--precision", "f32", "--average", "0"])).success();
    // At such a rate it can only get worse.
    let ruined = TrainOptions { steps: 8, lr: (0.03, 0.03), ..options(&out) };
    configure(&out, &ruined);
    run(&mut resume(&out)).success();
    let error = |row: &String| row.split(',').nth(3).expect("a cell").parse::<f64>().expect("an error");
    let errors: Vec<f64> = log(&out)[1..].iter().map(error).collect();
    assert!(errors[1] > 1.2 * errors[0], "{errors:?}");
    let of = |name: &str| weights_file::read(&out.join(name)).expect("weights").1.training;
    assert_eq!(
        (of("best.safetensors").steps, of("best.safetensors").validation_relmse),
        (4, Some(errors[0]))
    );
    assert_eq!(
        (of("last.safetensors").steps, of("last.safetensors").validation_relmse),
        (8, Some(errors[1]))
    );
}

#[test]
fn what_batch_norms_saw_is_kept() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = dir.path().join("run");
    let mut command = train_with("demc", "32", &out, 3);
    run(command.args(["--widths", "8,8,16,16,16"])).success();
    let (mut network, _) = weights_file::read(&out.join("best.safetensors")).expect("weights");
    let norms = network.batch_norms();
    assert!(!norms.is_empty());
    for norm in norms {
        assert!(norm.mean.values().iter().any(|v| *v != 0.0), "{}", norm.mean.name);
        assert!(norm.variance.values().iter().any(|v| *v != 1.0), "{}", norm.variance.name);
    }
}

#[test]
fn settings_change_what_is_learned() {
    let dir = tempfile::tempdir().expect("a folder");
    let learned = |name: &str, settings: &[&str]| {
        let out = dir.path().join(name);
        run(train_with("demc-s", "32", &out, 3).args(["--precision", "f32"]).args(settings)).success();
        tensors(&out).into_iter().map(|tensor| (tensor.name, tensor.values)).collect::<Vec<_>>()
    };
    let plain = learned("plain", &[]);
    assert!(plain == learned("again", &[]), "the same settings");
    for settings in [
        ["--tint", "1"],
        ["--guide-dropout", "1"],
        ["--leak", "0.5"],
        ["--average", "0.2"],
        ["--weight-decay", "0.5"],
        ["--optimizer", "muon"],
        ["--loss", "ssim"],
    ] {
        assert!(plain != learned(settings[0], &settings), "{settings:?}");
    }
    let rounded = dir.path().join("rounded");
    run(train_with("demc-s", "32", &rounded, 3).args(["--precision", "bf16"])).success();
    assert!(plain.iter().zip(tensors(&rounded)).any(|(plain, rounded)| plain.1 != rounded.values));
}

/// What is read of a row of eval's scores.
#[derive(Debug, serde::Deserialize)]
struct Score {
    model: String,
    relmse: f64,
    ssim: f64,
}

#[test]
fn the_log_tells_what_eval_does() {
    let dir = tempfile::tempdir().expect("a folder");
    let (out, report) = (dir.path().join("run"), dir.path().join("report"));
    let both = dir.path().join("both");
    fs::create_dir(&both).expect("a folder");
    // A pair of which nothing can be learned, so that errors differ and no other mean of them is the same.
    for (from, to) in [
        ("s0010_outdoor_0004spp", "outdoor_0004spp"),
        ("s0010_outdoor_ref", "outdoor_ref"),
        ("s0000_room_0004spp", "room_0004spp"),
        ("s0000_room_0004spp", "room_ref"),
    ] {
        let from = format!("{}/tests/data/{from}.exr", env!("CARGO_MANIFEST_DIR"));
        fs::copy(from, both.join(format!("{to}.exr"))).expect("a copy");
    }
    let mut command = Command::new(cargo_bin("demc"));
    command.args([
        "train", "--model", "demc-s", "--batch", "1", "--patch", "32", "--every", "3", "--steps", "3",
    ]);
    command
        .args(["--precision", "f32", "--data", &data("s0000_room"), "--val"])
        .arg(&both)
        .arg("--out")
        .arg(&out);
    run(&mut command).success();
    let last = log(&out).pop().expect("a row");
    let logged: Vec<f64> = last.split(',').skip(3).map(|cell| cell.parse().expect("a number")).collect();

    let weights = format!("{}:f32:unrestrained", out.join("last.safetensors").display());
    let mut command = Command::new(cargo_bin("demc"));
    command.args(["eval", "--models", &weights, "--repeats", "1", "--no-sheets", "--test-set"]).arg(&both);
    run(command.arg("--out").arg(&report)).success();
    let mut scores = csv::Reader::from_path(report.join("scores.csv")).expect("scores");
    let rows = scores.deserialize().map(|row| row.expect("a row")).filter(|row: &Score| row.model != "noisy");
    let rows: Vec<Score> = rows.collect();
    let [one, other] = &rows[..] else { panic!("two frames") };
    let geomean = (one.relmse * other.relmse).sqrt();
    let mean = (one.ssim + other.ssim) / 2.0;
    // The two frames differ so much that another mean would be told.
    assert!((one.relmse + other.relmse) / 2.0 > 1.05 * geomean, "{rows:?}");
    assert!((logged[0] / geomean - 1.0).abs() < 2e-3, "{logged:?}, {geomean}");
    assert!((logged[1] - mean).abs() < 1e-3, "{logged:?}, {mean}");
}

#[test]
fn parameters_alone_are_trained_that_were_asked_for() {
    let dir = tempfile::tempdir().expect("a folder");
    let [first, second, third] = ["first", "second", "third"].map(|name| dir.path().join(name));
    run(&mut train(&first, 2)).success();
    let begin = first.join("last.safetensors");
    run(train(&second, 2).args(["--only", "head.*,decoder.0.*.bias", "--init"]).arg(&begin)).success();
    let (_, began) = weights::read(&begin).expect("weights");
    let trained = tensors(&second);
    let asked_for =
        |name: &str| name.starts_with("head.") || name.starts_with("decoder.0.") && name.ends_with(".bias");
    for before in &began {
        let after = trained.iter().find(|tensor| tensor.name == before.name).expect("the same tensors");
        assert_eq!(before.values != after.values, asked_for(&before.name), "{}", before.name);
    }
    let mut moments = trained.iter().filter_map(|tensor| tensor.name.strip_prefix("first.")).peekable();
    assert!(moments.peek().is_some() && moments.all(asked_for));
    let mut refused = train_with("demc", "64", &third, 1);
    let refused = run(refused.args(["--only", "*.bias", "--init"]).arg(&begin)).code(2);
    refused.stderr(predicate::str::contains("--only: demc normalises"));
    for (names, reason) in [("heads.*", "no parameter that is trained"), ("head.***", "wildcards")] {
        let refused = run(train(&third, 1).args(["--only", names, "--init"]).arg(&begin)).code(2);
        refused.stderr(
            predicate::str::contains(format!("--only: '{names}'")).and(predicate::str::contains(reason)),
        );
    }
}

#[test]
fn a_run_goes_on_from_any_folder_to_as_many_steps_as_its_configuration_says() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = dir.path().join("run");
    let mut command = Command::new(cargo_bin("demc"));
    command.args(["train", "--data", "tests/data/s0010_outdoor_*.exr", "--batch", "1", "--patch", "32"]);
    command.args(["--model", "demc-s", "--every", "2", "--steps", "2"]).arg("--out").arg(&out);
    run(command.current_dir(env!("CARGO_MANIFEST_DIR"))).success();
    let longer = TrainOptions { steps: 4, ..options(&out) };
    configure(&out, &longer);
    let mut command = resume(Path::new("run"));
    run(command.current_dir(dir.path())).success();
    assert_eq!(log(&out).len(), 3, "rows after 2 and 4 steps");
    run(resume(&out).args(["--steps", "6"])).code(2).stderr(predicate::str::contains("--steps"));
}

#[test]
fn training_lowers_the_loss() {
    let dir = tempfile::tempdir().expect("a folder");
    for optimizer in ["adam", "muon"] {
        let out = dir.path().join(optimizer);
        let mut command = train(&out, 200);
        command.args(["--loss", "smape", "--lr", "1e-3:1e-4", "--optimizer", optimizer]);
        run(&mut command).success();
        let loss = |row: &String| row.split(',').nth(2).expect("a loss").parse::<f64>().expect("a number");
        let rows = log(&out);
        let (first, last) = (loss(&rows[1]), loss(rows.last().expect("rows")));
        assert!(last < 0.8 * first, "{optimizer}: the loss went from {first} to {last}");
    }
}

#[test]
fn a_run_begins_with_given_weights_of_the_same_network_only() {
    let dir = tempfile::tempdir().expect("a folder");
    let first = dir.path().join("first");
    run(&mut train(&first, 4)).success();
    let best = first.join("best.safetensors");
    run(train(&dir.path().join("second"), 4).arg("--init").arg(&best)).success();
    let refused = dir.path().join("third");
    run(train(&refused, 4).args(["--widths", "16,16,16,16"]).arg("--init").arg(&best))
        .code(1)
        .stderr(predicate::str::contains("best.safetensors").and(predicate::str::contains("--widths")));
}

#[test]
fn crops_are_no_larger_than_their_frames() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = dir.path().join("run");
    run(&mut train_with("demc-s", "256", &out, 4))
        .success()
        .stderr(predicate::str::contains("up to 256x256"));
}

#[test]
fn refuses_what_cannot_be_trained() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = dir.path().join("run");
    let says = |text: &'static str| predicate::str::contains(text);
    run(&mut train_with("noisy", "64", &out, 4)).code(2).stderr(says("trainable: demc-s"));
    run(&mut train_with("demc-s", "50", &out, 4)).code(2).stderr(says("multiple of 16"));
    run(train_with("kpcn", "8", &out, 4).args(["--loss", "ssim"])).code(2).stderr(says("11 at least"));
    let prefilter = || train_with("prefilter", "64", &out, 4);
    run(prefilter().args(["--loss", "ssim"])).code(2).stderr(says("take geomean"));
    run(prefilter().arg("--raw-references")).code(2).stderr(says("--raw-references: prefilter"));
    run(train(&out, 4).args(["--val", &data("s0000_room")]))
        .code(1)
        .stderr(says("trained on and validated on"));
    // The same frames, by another path.
    let roundabout = data("s0000_room").replace("tests/data", "tests/data/../data");
    run(train(&out, 4).args(["--val", &roundabout])).code(1).stderr(says("trained on and validated on"));
    run(train(&out, 4).args(["--lr", "fast"])).code(2).stderr(says("FIRST:LAST"));
    run(train(&out, 4).args(["--optimizer", "sgd"])).code(2).stderr(says("adam or muon"));
    run(&mut resume(&out)).code(1).stderr(says("config.json"));
    run(train(&out, 4).args(["--leak", "2"])).code(2).stderr(says("a share from 0 to 1"));
    run(train_with("demc", "64", &out, 4).args(["--prefilter", "x"]))
        .code(2)
        .stderr(says("demc has no prefilter"));
    run(&mut train(&out, 4)).success();
    run(&mut train(&out, 4)).code(1).stderr(says("--resume"));
    // Without its configuration it is no run, but its weights may be somebody's.
    fs::remove_file(out.join("config.json")).expect("it was written");
    run(&mut train(&out, 4)).code(1).stderr(says("best.safetensors").and(says("would be replaced")));
}

#[test]
fn a_folder_takes_one_run_at_a_time() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = dir.path().join("run");
    run(&mut train(&out, 2)).success();
    let mut longer = options(&out);
    longer.steps = 4;
    let mut second = None;
    let stop = AtomicBool::new(false);
    train::run(&longer, &out, true, &stop, &mut |event| {
        if matches!(event, TrainEvent::Step { step: 3, .. }) {
            second = train::run(&longer, &out, true, &stop, &mut |_| {}).err();
        }
    })
    .expect("the first run goes on");
    assert!(second.expect("it is refused").to_string().contains("another run of demc works in this folder"));
}

#[test]
fn pairs_count_once_however_they_are_named() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = dir.path().join("run");
    let twice = data("s0000_room").replace("tests/data", "tests/data/../data");
    let told = run(train(&out, 2).args(["--data", &twice])).success();
    told.stderr(
        predicate::str::contains("1 pairs to train on").or(predicate::str::contains("1 pair to train on")),
    );
}

#[test]
fn settings_that_do_not_exist_are_refused() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = dir.path().join("run");
    run(&mut train(&out, 2)).success();
    let config = out.join("config.json");
    let text = fs::read_to_string(&config).expect("a configuration");
    fs::write(&config, text.replace("weight_decay", "weight-decay")).expect("a folder");
    run(&mut resume(&out)).code(1).stderr(predicate::str::contains("weight-decay"));
}

#[test]
fn settings_edited_to_nonsense_are_refused_by_name() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = dir.path().join("run");
    run(&mut train(&out, 4)).success();
    let config = out.join("config.json");
    let text = fs::read_to_string(&config).expect("a configuration");
    for (path, value) in [
        ("every", "0"),
        ("batch", "0"),
        ("batch", "1000000000000"),
        ("patch", "0"),
        ("patch", "33"),
        ("patch", "1600000000"),
        ("steps", "-1"),
        ("lr", "[0, 0]"),
        ("average", "2"),
        ("weight_decay", "-1"),
        ("loss", "\"best\""),
        ("train", "[]"),
        ("only", "[\"no.such\"]"),
        ("network/widths", "[]"),
        ("network/widths", "[0, 0, 0, 0]"),
        ("network/widths", "[4096, 4096, 4096, 4096]"),
        ("network/prefilter", "[]"),
    ] {
        let mut edited: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        edited["steps"] = 8.into();
        let (place, value) = (format!("/{path}"), serde_json::from_str(value).expect("JSON"));
        *edited.pointer_mut(&place).expect("a setting") = value;
        fs::write(&config, serde_json::to_string_pretty(&edited).expect("text")).expect("a file");
        let refused = run(&mut resume(&out)).code(1);
        let message = String::from_utf8(refused.get_output().stderr.clone()).expect("text");
        assert_eq!(message.lines().count(), 1, "{path}: {message}");
        let key = path.split('/').next().expect("a key");
        assert!(
            message.contains("config.json") && message.contains(&format!("\"{key}\"")),
            "{path}: {message}"
        );
    }
}

#[test]
fn denoise_refuses_a_file_that_holds_no_network() {
    let dir = tempfile::tempdir().expect("a folder");
    let input = format!("{}/tests/data/s0010_outdoor_0004spp.exr", env!("CARGO_MANIFEST_DIR"));
    let wrong = dir.path().join("wrong.safetensors");
    for bytes in [&b""[..], b"random bytes, no header at all", &[0xff; 64]] {
        fs::write(&wrong, bytes).expect("a file");
        let mut denoise = Command::new(cargo_bin("demc"));
        denoise.args(["denoise", &input, "--model"]).arg(&wrong).arg("--out").arg(dir.path().join("out"));
        run(&mut denoise).failure().stderr(predicate::str::contains("not a demc weights file"));
    }
}

#[test]
fn the_rivals_train_and_their_weights_denoise_and_are_scored() {
    for (model, patch, steps, rates, note) in
        [("kpcn", "32", 80, "1e-3:3e-4", "trained on Combined"), ("lbf", "48", 40, "3e-2:1e-2", "")]
    {
        let dir = tempfile::tempdir().expect("a folder");
        let out = dir.path().join(model);
        let mut command = train_every(steps / 2, model, patch, &out, steps);
        command.args(["--loss", "smape", "--lr", rates]);
        run(&mut command).success().stderr(predicate::str::contains(note));
        let rows = log(&out);
        let value = |row: usize, column: usize| -> f64 {
            rows[row].split(',').nth(column).expect("a cell").parse().expect("a number")
        };
        assert!(value(2, 2) < value(1, 2), "{model}: the loss went from {} to {}", value(1, 2), value(2, 2));

        let weights = out.join("best.safetensors");
        let input = format!("{}/tests/data/s0010_outdoor_0004spp.exr", env!("CARGO_MANIFEST_DIR"));
        let mut denoise = Command::new(cargo_bin("demc"));
        denoise.args(["denoise", &input, "--out"]).arg(dir.path().join("images"));
        run(denoise.arg("--model").arg(&weights)).success();

        let scores = dir.path().join("scores");
        let mut eval = Command::new(cargo_bin("demc"));
        eval.args(["eval", "--repeats", "1", "--no-sheets", "--test-set", &data("s0010_outdoor")]);
        eval.arg("--models").arg(&weights).arg("--out").arg(&scores);
        run(&mut eval).success();
        let text = fs::read_to_string(scores.join("scores.csv")).expect("scores");
        let ssim: Vec<f64> = text
            .lines()
            .skip(1)
            .map(|line| line.split(',').nth(6).expect("a cell").parse().expect("a number"))
            .collect();
        // The noisy input comes first. RelMSE hangs on a few dark pixels after so few steps.
        assert!(ssim.len() == 2 && ssim[1] > ssim[0], "{model}: {text}");
    }
}

#[test]
fn kpcn_filters_diffuse_and_specular_apart_where_blender_wrote_light_passes() {
    let dir = tempfile::tempdir().expect("a folder");
    let blender = format!("{}/tests/data/blender5.exr", env!("CARGO_MANIFEST_DIR"));
    for scene in ["train/a", "val/b"] {
        for end in ["0004spp", "ref"] {
            let to = dir.path().join(format!("{scene}_{end}.exr"));
            fs::create_dir_all(to.parent().expect("a folder")).expect("a folder");
            fs::copy(&blender, to).expect("a copy");
        }
    }
    let out = dir.path().join("run");
    let mut command = Command::new(cargo_bin("demc"));
    command
        .args(["train", "--model", "kpcn", "--widths", "8", "--steps", "2", "--batch", "1", "--patch", "24"]);
    command.arg("--data").arg(dir.path().join("train")).arg("--val").arg(dir.path().join("val"));
    run(command.arg("--out").arg(&out)).success();
    let mut denoise = Command::new(cargo_bin("demc"));
    denoise.args(["denoise", &blender, "--out"]).arg(dir.path().join("images"));
    run(denoise.arg("--model").arg(out.join("best.safetensors")))
        .success()
        .stderr(predicate::str::contains("diffuse and specular light are filtered apart"));
}

#[test]
fn a_run_without_its_checkpoint_does_not_begin_anew() {
    let out = tempfile::tempdir().unwrap();
    let run = out.path().join("run");
    assert!(train_with("lbf", "64", &run, 2).status().unwrap().success());
    let last = fs::read(run.join("last.safetensors")).unwrap();
    fs::remove_file(run.join("checkpoint.safetensors")).unwrap();
    let refused =
        Command::new(cargo_bin("demc")).args(["train", "--resume", "--out"]).arg(&run).output().unwrap();
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(
        refused.status.code() == Some(1) && said.contains("checkpoint.safetensors: is missing"),
        "{said}"
    );
    assert_eq!(fs::read(run.join("last.safetensors")).unwrap(), last);
}

#[test]
fn a_method_without_weights_says_how_to_get_them() {
    let input = format!("{}/tests/data/s0010_outdoor_0004spp.exr", env!("CARGO_MANIFEST_DIR"));
    let mut denoise = Command::new(cargo_bin("demc"));
    denoise.args(["denoise", &input, "--out", "/nonexistent", "--model", "kpcn-combined"]);
    run(&mut denoise).code(2).stderr(predicate::str::contains("demc train --model kpcn-combined"));
}

#[test]
fn a_prefilter_learns_from_references_that_keep_their_guides_and_serves_other_networks() {
    let dir = tempfile::tempdir().expect("a folder");
    let out = dir.path().join("prefilter");
    let says = predicate::str::contains;
    // What began nothing is in nothing's way.
    for _ in 0..2 {
        run(&mut train_with("prefilter", "64", &dir.path().join("refused"), 4))
            .code(1)
            .stderr(says("s0000_room_ref.exr").and(says("Denoising Albedo")));
    }

    // The frames themselves hold both guides: what is learned from them is to change nothing.
    let pairs = ["s0000_room", "s0010_outdoor"].map(|scene| {
        let folder = dir.path().join(scene);
        fs::create_dir(&folder).expect("a folder");
        let frame = format!("{}/tests/data/{scene}_0004spp.exr", env!("CARGO_MANIFEST_DIR"));
        for name in ["0004spp", "ref"] {
            fs::copy(&frame, folder.join(format!("{scene}_{name}.exr"))).expect("a copy");
        }
        folder
    });
    let mut command = Command::new(cargo_bin("demc"));
    command.args([
        "train",
        "--model",
        "prefilter",
        "--widths",
        "8,8,8,8",
        "--loss",
        "geomean",
        "--optimizer",
        "muon",
    ]);
    command.args(["--batch", "2", "--patch", "64", "--steps", "60", "--every", "30", "--lr", "1e-2:1e-3"]);
    command.arg("--data").arg(&pairs[0]).arg("--val").arg(&pairs[1]).arg("--out").arg(&out);
    run(&mut command).success();
    let rows = log(&out);
    let error =
        |row: usize| rows[row].split(',').nth(3).and_then(|cell| cell.parse::<f64>().ok()).expect("RelMSE");
    assert!(error(2) < 0.8 * error(1), "{rows:?}");

    let weights = out.join("best.safetensors");
    let network = dir.path().join("network");
    run(train(&network, 4).arg("--prefilter").arg(&weights)).success();
    let (_, held) = weights_file::read(&network.join("best.safetensors")).expect("weights");
    assert_eq!(held.network.prefilter, [8; 4]);
    assert_eq!(held.training.prefilter, Some(weights.display().to_string()));
    assert_eq!(held.training.average, Some(0.999));
    assert!(held.training.precision.is_some());
    let input = format!("{}/tests/data/s0010_outdoor_0004spp.exr", env!("CARGO_MANIFEST_DIR"));
    let mut denoise = Command::new(cargo_bin("demc"));
    denoise.args(["denoise", &input, "--model"]).arg(&weights).arg("--out").arg(dir.path().join("images"));
    run(&mut denoise).failure().stderr(says("best.safetensors").and(says("--prefilter")));
}
