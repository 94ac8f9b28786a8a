//! The scripts that make training sets and train by them (`eval/training`, `eval/rivals`): what they hold out, what
//! they keep, and what becomes of what they started when they are stopped. Nothing is rendered or trained.

#![cfg(unix)]

mod common;

use std::{
    fs,
    os::unix::fs::PermissionsExt,
    path::{Path, PathBuf},
    process::{Command, Output, Stdio},
    time::{Duration, Instant},
};

use common::{
    files::{data, names_in},
    python,
};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A script of `eval`, ready to run in a folder.
fn script(name: &str, folder: &Path) -> Command {
    let mut command = python::interpreter();
    command.arg(root().join("eval").join(name)).current_dir(folder);
    command
}

/// Python that may import the modules of a folder of this repository.
fn snippet(modules: &str, text: &str) -> Command {
    let mut command = python::interpreter();
    command.env("PYTHONPATH", root().join(modules)).args(["-c", text]);
    command
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// A shell script in place of a program.
fn stub(folder: &Path, name: &str, text: &str) -> PathBuf {
    let path = folder.join(name);
    fs::write(&path, format!("#!/bin/sh\n{text}\n")).unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
    path
}

#[test]
fn split_scores_renders_of_scenes_that_nothing_was_trained_on() {
    let folder = tempfile::tempdir().unwrap();
    let set = folder.path().join("set");
    fs::create_dir(&set).unwrap();
    let mut manifest = String::from("scene,noisy,reference,spp\n");
    for seed in 0..40 {
        let kind = if seed % 2 == 0 { "tall_hall" } else { "room" };
        for (end, spp) in [("", 2), ("_n1", 2), ("_mean", 4)] {
            let view = format!("s{seed}_{kind}_c1");
            let name = view.clone() + &format!("_{spp:04}spp{end}.exr");
            manifest += &format!("{view}{end},{name},{view}_ref.exr,{spp}\n");
        }
    }
    fs::write(set.join("manifest.csv"), manifest).unwrap();
    let split = |options: &str| {
        let mut command = script("training/split.py", folder.path());
        command.args(["train.csv", "held_out.csv", "set", "--one-in", "4"]).args(options.split_whitespace());
        command.output().unwrap()
    };
    let scenes = |name: &str| -> Vec<String> {
        let text = fs::read_to_string(folder.path().join(name)).unwrap();
        text.lines().skip(1).map(|line| line.split(',').next().unwrap().to_owned()).collect()
    };

    let output = split("--score 2,8");
    assert!(output.status.success(), "{}", stderr(&output));
    let (train, held_out) = (scenes("train.csv"), scenes("held_out.csv"));
    assert!(!held_out.is_empty() && held_out.iter().all(|scene| scene.ends_with("_c1")), "{held_out:?}");
    assert!(held_out.iter().any(|scene| scene.contains("tall_hall")), "{held_out:?}");
    assert_eq!(train.len() + 3 * held_out.len(), 120, "a scene is on one side with all its frames");
    let clash = |scene: &&String| train.iter().any(|other| other.starts_with(scene.as_str()));
    assert_eq!(held_out.iter().find(clash), None);

    assert!(split("--score 2 --train-only tall_hall").status.success());
    let rooms = scenes("held_out.csv");
    assert!(!rooms.is_empty() && rooms.iter().all(|scene| scene.contains("room")), "{rooms:?}");

    // Means have 4 samples, and no render has.
    let output = split("");
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("of 4 samples: name others by --score"), "{}", stderr(&output));
}

#[test]
fn a_prefilter_that_is_taken_out_and_put_back_keeps_its_ranges() {
    let folder = tempfile::tempdir().unwrap();
    let network = root().join("src/models/weights/demc-s.safetensors");
    python::run(script("training/prefilter.py", folder.path()).arg(&network).arg("prefilter.safetensors"));
    let mut put_back = script("training/with_prefilter.py", folder.path());
    python::run(put_back.arg(&network).args(["prefilter.safetensors", "again.safetensors"]));
    let compare = "import sys, weights\n\
                   (a, x), (b, y) = map(weights.read, sys.argv[1:])\n\
                   assert a == b, (a, b)\n\
                   assert x.keys() == y.keys() and all((x[n] == y[n]).all() for n in x)\n\
                   assert any(n.startswith(weights.PREFILTER) for n in a['ranges'])";
    let mut command = snippet("eval/training", compare);
    python::run(command.arg(&network).arg("again.safetensors").current_dir(folder.path()));
}

#[test]
fn a_row_that_was_cut_off_is_made_again_and_spoils_no_other() {
    let folder = tempfile::tempdir().unwrap();
    let text = "import os\n\
                from demc_blender.ledger import Ledger\n\
                for name in ('a.exr', 'b.exr'): open(name, 'w').write(name)\n\
                ledger = Ledger('.')\n\
                ledger.add(view='v', file='a.exr', seconds='1.5')\n\
                ledger.add(view='v', file='b.exr', seconds='2.5')\n\
                os.truncate('views.csv', os.path.getsize('views.csv') - 9)\n\
                assert not ledger.missing('a.exr') and ledger.missing('b.exr')\n\
                ledger.add(view='v', file='b.exr', seconds='3.5')\n\
                assert [row['seconds'] for row in ledger.rows().values()] == ['1.5', '3.5'], ledger.rows()\n\
                assert ledger.check() == 0\n\
                os.truncate('views.csv', 7)  # in its header\n\
                ledger.add(view='v', file='a.exr', seconds='4.5')\n\
                assert list(ledger.rows()) == ['a.exr']";
    python::run(snippet("blender_scripts", text).current_dir(folder.path()));
}

/// Python in which `recipe.py` renders by a stub.
fn recipe(folder: &Path, stub: &str, then: &str) -> Command {
    fs::write(folder.join("stub.py"), stub).unwrap();
    let text = "import recipe, types\n\
                recipe.GENERATE = 'stub.py'\n\
                options = types.SimpleNamespace(out='.')\n";
    let mut command = snippet("eval/training", &format!("{text}{then}"));
    command.current_dir(folder);
    command
}

#[test]
fn a_recipe_that_is_stopped_leaves_nothing_running() {
    let folder = tempfile::tempdir().unwrap();
    let stub = "import os, sys, time\n\
                name = os.path.basename(sys.argv[2])\n\
                open(name + '.tmp', 'w').write(str(os.getpid()))\n\
                os.replace(name + '.tmp', name + '.pid')\n\
                time.sleep(120)";
    let then = "import signal, sys\n\
                signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))\n\
                recipe.render(options, [('a', 0, 5, []), ('b', 5, 10, [])])";
    let mut running = recipe(folder.path(), stub, then).stdout(Stdio::null()).spawn().unwrap();
    let pids = [folder.path().join("a.pid"), folder.path().join("b.pid")];
    let start = Instant::now();
    while !pids.iter().all(|path| path.exists()) {
        assert!(start.elapsed() < Duration::from_secs(60), "the stubs do not start");
        std::thread::sleep(Duration::from_millis(20));
    }
    let mut kill = Command::new("kill");
    assert!(kill.args(["-TERM", &running.id().to_string()]).status().unwrap().success());
    assert_eq!(running.wait().unwrap().code(), Some(143));
    for path in pids {
        let pid = fs::read_to_string(path).unwrap();
        let alive = Command::new("kill").args(["-0", &pid]).stderr(Stdio::null()).status().unwrap();
        assert!(!alive.success(), "process {pid} goes on");
    }
}

#[test]
fn a_recipe_goes_on_without_a_scene_that_fails_but_not_without_many() {
    let folder = tempfile::tempdir().unwrap();
    let stub = "import os, sys\n\
                folder = sys.argv[2]\n\
                os.makedirs(folder, exist_ok=True)\n\
                rows = ''.join(f's{seed}_room_c0,a.exr,b.exr,4\\n' for seed in range(8))\n\
                open(folder + '/manifest.csv', 'w').write('scene,noisy,reference,spp\\n' + rows)\n\
                open(folder + '/rejected.csv', 'w').write('scene,reason\\ns8_glass,black\\n')\n\
                sys.exit(1)";
    let render = |end: u32| {
        let then = format!("recipe.render(options, [('a', 0, {end}, [])])");
        recipe(folder.path(), stub, &then).output().unwrap()
    };
    let output = render(10);
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(stderr(&output).contains("goes on without 1 of 10 scenes of a"), "{}", stderr(&output));
    let output = render(20);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("9 of 20 scenes of a are there"), "{}", stderr(&output));
}

#[test]
fn trainings_tell_their_last_error_and_the_steps_they_have() {
    let folder = tempfile::tempdir().unwrap();
    // Fails twice, each time by another error; then ends on a signal of somebody else's.
    let program = "count=$(cat count 2>/dev/null || echo 0); echo $((count + 1)) >count\n\
                   mkdir -p out/demc\n\
                   case $count in\n\
                   0) echo 'demc: no such folder' >&2; exit 1 ;;\n\
                   1) echo 'demc: the disk is full' >&2; exit 1 ;;\n\
                   2) exit 130 ;;\n\
                   *) sleep 30 & trap 'kill $!; exit 130' TERM; while :; do :; done ;;\n\
                   esac";
    let program = stub(folder.path(), "demc", program);
    let train = |seconds: &str| {
        let mut command = Command::new("sh");
        command.arg(root().join("eval/rivals/train.sh")).args(["data", "held_out", "out", seconds, "demc"]);
        command.env("DEMC", &program).current_dir(folder.path());
        let output = command.output().unwrap();
        (output.status.code(), stderr(&output))
    };
    for (expected, last) in
        [("exit status 1): demc: no such folder", "first"), ("the disk is full", "second")]
    {
        let (code, said) = train("60");
        assert!(code == Some(1) && said.contains(expected), "{last}: {said}");
    }
    let (code, said) = train("60");
    assert!(code == Some(1) && said.contains("exit status 130"), "{said}");
    // A run that goes on has the steps it began with, however much time it is given.
    fs::write(folder.path().join("out/demc/config.json"), "{\n  \"steps\": 77,\n  \"seed\": 1\n}\n").unwrap();
    fs::write(folder.path().join("out/demc/log.csv"), "step\n1\n").unwrap();
    fs::write(folder.path().join("out/demc/checkpoint.safetensors"), "").unwrap();
    fs::write(folder.path().join("out/demc.seconds"), "0\n").unwrap();
    let (code, said) = train("2");
    assert!(code == Some(0) && said.contains("cut before its 77 steps"), "{said}");
}

#[test]
fn cleaned_sequences_keep_the_neighbours_of_their_references() {
    let folder = tempfile::tempdir().unwrap();
    let shot = folder.path().join("shot");
    fs::create_dir(&shot).unwrap();
    for frame in 1..=3 {
        let noisy = shot.join(format!("pan_0004spp.{frame:04}.exr"));
        fs::copy(data("s0000_room_0004spp.exr"), noisy).unwrap();
    }
    fs::copy(data("s0000_room_ref.exr"), shot.join("pan_ref.0002.exr")).unwrap();
    let clean = |options: &[&str]| {
        let mut command = script("training/clean_references.py", folder.path());
        command.args(["shot", "clean", "--oidn"]).arg(python::environment().oidn_program("oidnDenoise"));
        command.args(options).output().unwrap()
    };
    let output = clean(&[]);
    assert!(output.status.success(), "{}", stderr(&output));
    let expected =
        ["pan_0004spp.0001.exr", "pan_0004spp.0002.exr", "pan_0004spp.0003.exr", "pan_ref.0002.exr"];
    assert_eq!(names_in(folder.path().join("clean")), expected);
    // A mean holds the render that --join would put into the reference.
    fs::write(shot.join("pan_0008spp_mean.exr"), "").unwrap();
    let output = clean(&["--join", "4"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("share noise"), "{}", stderr(&output));
}
