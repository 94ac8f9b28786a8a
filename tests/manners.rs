//! How the program behaves apart from its results: help whose examples run, completions, manual pages,
//! colours, `--quiet`, progress, reports over many runs.

mod common;

use std::{
    env, fs,
    path::{Path, PathBuf},
    process::Command as Process,
};

use assert_cmd::cargo::cargo_bin;
use common::{
    demc,
    files::{data, names_in, write_render},
};
use predicates::{prelude::*, str::contains};

const COMMANDS: [&str; 10] =
    ["denoise", "train", "eval", "inspect", "compare", "models", "stability", "report", "completions", "man"];

/// The folders that examples speak of: a sequence in `renders`, pairs in `pairs`.
fn workplace() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    ["renders", "pairs", "logs"].iter().for_each(|name| fs::create_dir(at(name)).unwrap());
    for frame in [1, 5, 12] {
        let name = format!("renders/shot_0004spp.{frame:04}.exr");
        fs::copy(data("s0000_room_0004spp.exr"), at(&name)).unwrap();
    }
    for (from, to) in [("s0000_room", "shot"), ("s0010_outdoor", "yard")] {
        for kind in ["0004spp", "ref"] {
            let to = at(&format!("pairs/{to}_{kind}.exr"));
            fs::copy(data(&format!("{from}_{kind}.exr")), to).unwrap();
        }
    }
    folder
}

/// A shell in that folder that knows `demc`.
fn shell(folder: &Path, script: &str) -> assert_cmd::Command {
    let program = cargo_bin("demc");
    let mut path = vec![program.parent().unwrap().to_path_buf()];
    path.extend(env::split_paths(&env::var_os("PATH").unwrap_or_default()));
    let mut command = assert_cmd::Command::new("sh");
    command.args(["-c", script]).current_dir(folder).env("PATH", env::join_paths(path).unwrap());
    command
}

/// The commands that a help text gives as examples.
fn examples(command: &str) -> Vec<String> {
    let output = demc().args([command, "--help"]).output().unwrap();
    let help = String::from_utf8(output.stdout).unwrap();
    let (_, examples) = help.split_once("Examples:").unwrap_or(("", ""));
    examples
        .lines()
        .filter_map(|line| line.strip_prefix("  demc "))
        .map(|line| format!("demc {line}"))
        .collect()
}

#[test]
fn the_examples_of_every_help_run() {
    let folder = workplace();
    for frame in ["1", "2"] {
        let line =
            format!(r#"{{"input":"renders/shot_0004spp.000{frame}.exr","status":"done","seconds":1.0}}"#);
        fs::write(folder.path().join(format!("logs/{frame}.jsonl")), line).unwrap();
    }
    let mut ran = 0;
    for command in COMMANDS.into_iter().filter(|name| *name != "models") {
        let examples = examples(command);
        assert!(!examples.is_empty(), "{command} --help has no example");
        for example in examples {
            // A night's work, cut short.
            let script = example.replace("--steps 20000", "--steps 1 --batch 1 --patch 32");
            // What the examples of `compare` judge.
            let _ = fs::create_dir(folder.path().join("clean"));
            let _ = fs::copy(data("s0000_room_0004spp.exr"), folder.path().join("clean/shot_0004spp.exr"));
            let done = shell(folder.path(), &script).output().unwrap();
            // The report on frames 1 and 2 misses the others, and says so.
            let expected = if example.contains("--of renders") { 1 } else { 0 };
            let errors = String::from_utf8_lossy(&done.stderr);
            assert_eq!(done.status.code(), Some(expected), "{example}: {errors}");
            ran += 1;
        }
    }
    assert!(ran >= 12, "{ran} examples");
    for made in ["clean/shot_0004spp.0005.png", "scores/summary.csv", "demc.bash", "man1/demc-denoise.1"] {
        assert!(folder.path().join(made).is_file(), "{made}");
    }
}

#[test]
fn shells_complete_and_manuals_tell_every_command_and_option() {
    let folder = tempfile::tempdir().unwrap();
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let mut all = demc().args(["completions", shell]).assert().success();
        for word in COMMANDS.into_iter().chain(["frames", "view-layer"]) {
            all = all.stdout(contains(word));
        }
        all.stdout(contains("peak-memory").not());
    }
    let script = "eval \"$(demc completions bash)\"; COMP_WORDS=(demc den); COMP_CWORD=1; _demc demc den demc; \
                  echo ${COMPREPLY[@]}";
    let mut bash = shell(folder.path(), "exec bash -c \"$SCRIPT\"");
    bash.env("SCRIPT", script).assert().success().stdout("denoise\n");

    demc().arg("man").arg("--out").arg(folder.path()).assert().success();
    assert!(!folder.path().join("demc-peak-memory.1").exists());
    for command in COMMANDS {
        let page = fs::read_to_string(folder.path().join(format!("demc-{command}.1"))).unwrap();
        assert!(page.contains(".TH") && page.contains(".SH OPTIONS"), "{command}");
    }
    let page = fs::read_to_string(folder.path().join("demc-denoise.1")).unwrap();
    assert!(page.contains("\\-\\-frames") && page.contains("Examples:"), "{page}");
    demc()
        .args(["man", "--out"])
        .arg(data("blender4.exr"))
        .assert()
        .code(1)
        .stderr(contains("cannot create"));
}

/// Runs a command on a terminal of its own, and returns what it shows there.
#[cfg(target_os = "linux")]
fn on_terminal(folder: &Path, script: &str, environment: &[(&str, &str)]) -> String {
    let mut command = shell(folder, "exec script -qec \"$SCRIPT\" /dev/null");
    command
        .env("SCRIPT", script)
        .env("TERM", "xterm")
        .env_remove("NO_COLOR")
        .envs(environment.iter().copied());
    String::from_utf8(command.assert().success().get_output().stdout.clone()).unwrap()
}

#[test]
#[cfg(target_os = "linux")]
fn terminals_get_a_bar_and_colours_and_no_color_turns_those_off() {
    let folder = workplace();
    let run = "demc denoise renders --out";
    let said = on_terminal(folder.path(), &format!("{run} a --model noisy"), &[]);
    assert!(said.contains("frames/s") && said.contains(" left") && said.contains("elapsed"), "{said}");
    let said = on_terminal(folder.path(), &format!("{run} b --model noisy --quiet"), &[]);
    assert_eq!(said, "");
    let colour = "\u{1b}[1m";
    assert!(on_terminal(folder.path(), "demc --help", &[]).contains(colour));
    assert!(!on_terminal(folder.path(), "demc --help", &[("NO_COLOR", "1")]).contains('\u{1b}'));
    let said = on_terminal(folder.path(), &format!("{run} c --model noisy"), &[("NO_COLOR", "1")]);
    assert!(!said.contains("\u{1b}[3") && !said.contains(colour), "a bar without colours: {said:?}");
}

#[test]
fn without_a_terminal_there_are_plain_lines_and_quiet_leaves_failures() {
    let folder = workplace();
    let run =
        |arguments: &str| shell(folder.path(), &format!("demc denoise --model noisy {arguments}")).assert();
    run("renders --out a")
        .success()
        .stderr("")
        .stdout(contains("\u{1b}").not())
        .stdout(contains("[3/3] "))
        .stdout(contains("3 denoised (").and(contains("frames/s)")));
    run("renders --out b --quiet").success().stdout("").stderr("");
    fs::write(folder.path().join("renders/shot_0004spp.0007.exr"), "broken").unwrap();
    run("renders --out b -q").code(1).stdout("").stderr(contains("0007.exr").and(contains("0001").not()));
}

#[test]
fn frames_are_picked_by_number() {
    let folder = workplace();
    let run = |arguments: &str| {
        shell(folder.path(), &format!("demc denoise --model noisy --overwrite {arguments}")).assert()
    };
    let names = |out: &str| names_in(folder.path().join(out));
    run("renders --out steps --frames 1-12:4").success();
    assert_eq!(names("steps"), ["shot_0004spp.0001.exr", "shot_0004spp.0005.exr"]);
    run("renders pairs --out listed --frames 12,7")
        .success()
        .stderr(contains("--frames: no input is of frame 7"));
    assert_eq!(names("listed"), ["shot_0004spp.0012.exr"]);
    run("renders --out steps --frames 1-20:4").success().stderr(contains("no input is of frames 9,13,17"));
    run("renders --out steps --frames 1-20:4 --quiet").success().stderr("");
    // No wrong usage: on a farm, a chunk of frames may not be rendered.
    run("renders --out none --frames 2-4").code(1).stderr(contains("renders: no file of --frames"));
    run("renders pairs --out none --frames 2-4").code(1).stderr(contains("renders and 1 more: no file of"));
    run("renders --out none --frames 4-2").code(2).stderr(contains("the last frame comes before the first"));
    run("renders --out none --frames -5--1").code(1).stderr(contains("no file of --frames"));
}

/// Two tasks that are given the same frames: each result is whole, and nothing else stays.
#[test]
fn tasks_that_meet_do_not_harm_each_other() {
    let folder = tempfile::tempdir().unwrap();
    let (renders, out) = (folder.path().join("renders"), folder.path().join("out"));
    fs::create_dir(&renders).unwrap();
    let names: Vec<String> = (1..=12).map(|frame| format!("shot.{frame:04}.exr")).collect();
    for (seed, name) in names.iter().enumerate() {
        write_render(&renders.join(name), 300, 200, |_, pixel| ((pixel * 31 + seed) % 97) as f32 / 97.0);
    }
    let start = |out: &Path| {
        let mut command = Process::new(cargo_bin("demc"));
        command
            .args(["denoise", "--model", "noisy", "--overwrite", "--quiet", "--out"])
            .arg(out)
            .arg(&renders);
        command.spawn().unwrap()
    };
    let alone = folder.path().join("alone");
    assert!(start(&alone).wait().unwrap().success());
    let mut tasks: Vec<_> = (0..3).map(|_| start(&out)).collect();
    while tasks.iter_mut().any(|task| task.try_wait().unwrap().is_none()) {
        // At no time does a file of a result's name hold less than the result.
        for name in &names {
            if let Ok(bytes) = fs::read(out.join(name)) {
                assert!(bytes == fs::read(alone.join(name)).unwrap(), "{name} is not whole");
            }
        }
    }
    tasks.iter_mut().for_each(|task| assert!(task.wait().unwrap().success()));
    assert_eq!(names_in(&out), names);
}

#[test]
fn a_report_over_many_tasks_lists_what_failed_in_the_end() {
    let folder = workplace();
    let log = |name: &str| -> PathBuf { folder.path().join("logs").join(name) };
    let run = |arguments: &str, log: &str| {
        let script =
            format!("demc denoise --model noisy --json {arguments} --out out >> logs/{log} 2>/dev/null");
        shell(folder.path(), &script).output().unwrap().status.code()
    };
    let broken = folder.path().join("renders/shot_0004spp.0005.exr");
    let whole = fs::read(&broken).unwrap();
    fs::write(&broken, "broken").unwrap();
    assert_eq!(run("renders --frames 1-3", "0.jsonl"), Some(0));
    assert_eq!(run("renders --frames 4-6", "1.jsonl"), Some(1));
    let report = |more: &str| shell(folder.path(), &format!("demc report logs/*.jsonl {more}")).assert();
    report("")
        .code(1)
        .stdout(contains("failed: renders/shot_0004spp.0005.exr: "))
        .stdout(contains("1 denoised in ").and(contains(" s of model time, 1 failed\n")));
    report("--of renders")
        .code(1)
        .stdout(contains("missing: renders/shot_0004spp.0012.exr: no task tells of it"));

    // The task is run again, by another path to its folder, and the last one is killed within a line.
    fs::write(&broken, whole).unwrap();
    assert_eq!(run("$PWD/renders --frames 4-6", "1.jsonl"), Some(0));
    assert_eq!(run("renders --frames 7-12", "2.jsonl"), Some(0));
    fs::write(log("3.jsonl"), r#"{"input":"renders/shot_00"#).unwrap();
    report("--of renders")
        .success()
        .stdout(contains("3 denoised in "))
        .stderr(contains("3.jsonl: 1 lines are none of `demc denoise --json`"));
    // Frames that are links to one render are frames each.
    #[cfg(unix)]
    {
        let lines = ["1", "2"].map(|n| {
            format!(
                r#"{{"input":"links/s.000{n}.exr","status":"{}","error":"x"}}"#,
                if n == "1" { "done" } else { "failed" }
            )
        });
        fs::create_dir(folder.path().join("links")).unwrap();
        fs::write(folder.path().join("links/s.0001.exr"), "").unwrap();
        std::os::unix::fs::symlink("s.0001.exr", folder.path().join("links/s.0002.exr")).unwrap();
        fs::write(log("3.jsonl"), lines.join("\n")).unwrap();
        shell(folder.path(), "demc report logs/3.jsonl").assert().code(1).stdout(contains("s.0002.exr"));
    }
    fs::write(log("3.jsonl"), "bash: demc: command not found\n").unwrap();
    let silent = shell(folder.path(), "demc report logs/3.jsonl").assert();
    silent.code(1).stderr(contains("the logs hold no line of `demc denoise --json`"));
    demc().args(["report", "missing.jsonl"]).assert().code(1).stderr(contains("missing.jsonl: cannot read"));
}

#[test]
fn every_failure_names_its_input() {
    let folder = tempfile::tempdir().unwrap();
    let input = data("s0000_room_0004spp.exr");
    let run = |arguments: &[&str]| {
        let mut command = demc();
        command.current_dir(folder.path()).env("OIDN_DENOISE", "nowhere/oidnDenoise");
        command.arg("denoise").arg(&input).args(["--out", "out"]).args(arguments).assert().code(1)
    };
    let named = || contains(format!("demc: {}", input.display()));
    run(&["--albedo", "albedo.exr"]).stderr(named().and(contains("albedo.exr: cannot read")));
    run(&["--model", "oidn-high"]).stderr(named().and(contains("by the environment variable OIDN_DENOISE")));
}

#[test]
fn methods_that_a_variable_leaves_out_are_no_evaluation() {
    let folder = workplace();
    for command in ["eval", "stability"] {
        let mut run = demc();
        run.current_dir(folder.path()).args([command, "--test-set", "pairs", "--out", "out", "--models", ""]);
        run.assert().code(2).stderr(contains("--models names no method"));
    }
}

#[test]
fn weights_that_are_not_where_demc_runs_are_not_called_untrained() {
    let folder = tempfile::tempdir().unwrap();
    let listed = |command: &mut assert_cmd::Command| {
        let run = command.env_remove("DEMC_WEIGHTS").arg("models").assert().success();
        String::from_utf8(run.get_output().stdout.clone()).unwrap()
    };
    let weights_of = |list: &str| -> String {
        let row = list.lines().find(|line| line.starts_with("lbf ")).unwrap();
        row.split_whitespace()
            .skip(1)
            .take_while(|word| word.parse::<u32>().is_err())
            .collect::<Vec<_>>()
            .join(" ")
    };
    let elsewhere = listed(demc().current_dir(folder.path()));
    assert_eq!(weights_of(&elsewhere), "not found");
    assert!(elsewhere.contains("DEMC_WEIGHTS=FOLDER"), "{elsewhere}");
    let here = listed(demc().current_dir(env!("CARGO_MANIFEST_DIR")));
    assert_eq!(weights_of(&here), "file");
    assert!(!here.contains("DEMC_WEIGHTS"), "{here}");
}
