//! `export_passes.py` as a new user tries it: scenes with something unusual, reruns, mistyped arguments.
//!
//! It runs on bpy 5.0, and on the Python with bpy 4.5 that `DEMC_BPY45` names, where it is set.

mod common;

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
    time::Duration,
};

use common::{files::names_in, python};
use demc::{
    frame::Frame,
    passes::{self, Pass, PassSet},
};
use tempfile::TempDir;

/// Far more than any run here takes, far less than for ever.
const PATIENCE: Duration = Duration::from_secs(120);

fn scripts() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("blender_scripts")
}

fn snippet(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/blender_data").join(name)
}

/// A scene of `make_hard_scene.py` and the folder that it is exported to.
struct Shot {
    python: PathBuf,
    folder: TempDir,
}

impl Shot {
    fn new(python: &Path, features: &str) -> Self {
        let shot = Self { python: python.into(), folder: tempfile::tempdir().unwrap() };
        let mut make = shot.script(&snippet("make_hard_scene.py"));
        let output = make.arg(shot.blend()).args(features.split_whitespace()).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        shot
    }

    fn blend(&self) -> PathBuf {
        self.folder.path().join("shot.blend")
    }

    fn out(&self) -> PathBuf {
        // From 4.5 on, Blender takes words in braces for variables.
        self.folder.path().join("out of {version}")
    }

    fn script(&self, script: &Path) -> Command {
        let mut command = Command::new(&self.python);
        command.env("PYTHONDONTWRITEBYTECODE", "1").arg(script);
        command
    }

    /// Runs the export of single samples; arguments given here count.
    fn run(&self, arguments: &str) -> Output {
        let mut command = self.script(&scripts().join("export_passes.py"));
        command.arg(self.blend()).arg("--out").arg(self.out()).args(["--spp", "1", "--ref-spp", "2"]);
        command.args(arguments.split_whitespace());
        assert_cmd::Command::from_std(command).timeout(PATIENCE).output().unwrap()
    }

    /// What it says where all goes well.
    #[track_caller]
    fn export(&self, arguments: &str) -> String {
        let output = self.run(arguments);
        let said = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
        said
    }

    /// What it says where something fails, and its status.
    #[track_caller]
    fn refuse(&self, arguments: &str, status: i32) -> String {
        let output = self.run(arguments);
        let said = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap()).concat();
        assert_eq!(output.status.code(), Some(status), "{said}");
        assert!(!said.contains("Traceback"), "{said}");
        said
    }

    fn files(&self) -> Vec<String> {
        names_in(self.out())
    }

    fn passes(&self, name: &str) -> PassSet {
        passes::load(self.out().join(name), None).unwrap()
    }

    fn views(&self, name: &str) -> Vec<String> {
        let frame = Frame::read(self.out().join(name)).unwrap();
        passes::layers(&frame).into_iter().filter_map(|layer| layer.view).collect()
    }
}

fn size(set: &PassSet) -> (usize, usize) {
    (set.width, set.height)
}

#[test]
fn it_runs_in_the_text_editor() {
    for python in python::blenders() {
        let folder = tempfile::tempdir().unwrap();
        let mut command = Command::new(&python);
        command.env("PYTHONDONTWRITEBYTECODE", "1").arg(snippet("in_text_editor.py"));
        let output = command.arg(scripts().join("export_passes.py")).arg(folder.path()).output().unwrap();
        let said = String::from_utf8_lossy(&output.stdout);
        let trouble = String::from_utf8_lossy(&output.stderr);
        assert!(said.contains("usage: export_passes.py"), "{said}{trouble}");
    }
}

#[test]
fn pixels_need_not_be_square() {
    for python in python::blenders() {
        let shot = Shot::new(&python, "aspect");
        shot.export("");
        let set = shot.passes("shot_0001spp.exr");
        assert_eq!(size(&set), (64, 36));
        assert!(set.get(Pass::DenoisingAlbedo).is_some() && set.get(Pass::Position).is_some());
    }
}

#[test]
fn what_blender_says_of_a_failure_is_passed_on() {
    let shot = Shot::new(&python::python(), "aspect");
    let mut command = shot.script(&snippet("fails_to_write.py"));
    command.arg(scripts()).arg(shot.blend()).arg("--out").arg(shot.out()).args(["--ref-spp", "0"]);
    let output = command.output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("Conflicting attributes found"), "{said}");
    assert!(shot.files().is_empty(), "{:?}", shot.files());
}

#[test]
fn stereo_scenes_give_both_views_in_one_file() {
    for python in python::blenders() {
        let shot = Shot::new(&python, "stereo");
        shot.export("");
        assert_eq!(shot.files(), ["shot_0001spp.exr", "shot_ref.exr"]);
        assert_eq!(shot.views("shot_0001spp.exr"), ["left", "right"]);
        assert_eq!(shot.views("shot_ref.exr"), ["left", "right"]);
        shot.export("--views right --name one");
        assert_eq!(shot.views("one_0001spp.exr"), ["right"]);
        let said = shot.refuse("--views middle", 1);
        assert!(said.contains("no view middle in Main; it has left, right"), "{said}");
    }
}

#[test]
fn a_file_of_two_scenes_says_which_is_rendered() {
    for python in python::blenders() {
        let shot = Shot::new(&python, "two");
        let said = shot.export("");
        assert!(said.contains("shot.blend has 2 scenes: Main, Other; rendering Main"), "{said}");
        assert_eq!(size(&shot.passes("shot_ref.exr")), (64, 36));
        assert!(!shot.export("--scene Other --name other").contains("note: "));
        assert_eq!(size(&shot.passes("other_ref.exr")), (32, 36));
        // The frames are those of the scene that is rendered, not of the one that was active.
        shot.export("--scene Other --frames 1,9 --ref-spp 0 --name moves");
        let [first, last] = ["0001", "0009"].map(|frame| {
            let passes = shot.passes(&format!("moves_0001spp.{frame}.exr"));
            passes.get(Pass::Combined).unwrap().clone()
        });
        assert!(first != last, "the card moves");
        let said = shot.refuse("--scene Third", 1);
        assert!(said.contains("no scene 'Third' in shot.blend; it has Main, Other"), "{said}");
    }
}

#[test]
fn a_render_border_is_kept_and_told() {
    for python in python::blenders() {
        let shot = Shot::new(&python, "border");
        let said = shot.export("");
        assert!(said.contains("render border") && said.contains("--region 0,0,64,36 for all"), "{said}");
        assert_eq!(size(&shot.passes("shot_0001spp.exr")), (32, 18));
        shot.export("--region 0,0,64,36 --name whole");
        assert_eq!(size(&shot.passes("whole_0001spp.exr")), (64, 36));
    }
}

#[test]
fn frames_come_in_lists_and_steps_and_keep_to_the_scenes_step() {
    for python in python::blenders() {
        let shot = Shot::new(&python, "step");
        let frames = |arguments: &str| {
            let name = format!("n{}", arguments.len());
            let said = shot.export(&format!("{arguments} --ref-spp 0 --name {name}"));
            let prefix = format!("{name}_0001spp.00");
            let numbers = shot.files().into_iter().filter_map(|file| {
                file.strip_prefix(&prefix)?.strip_suffix(".exr").map(|number| number.parse::<u32>().unwrap())
            });
            (numbers.collect::<Vec<_>>(), said)
        };
        let (numbers, said) = frames("--frames 1-5");
        assert_eq!(numbers, [1, 3, 5]);
        assert!(said.contains("note: Main renders every 2. frame; --frames A-B:1 renders all"), "{said}");
        assert_eq!(frames("--frames scene").0, [1, 3, 5]);
        let (numbers, said) = frames("--frames 1-9x4,2,3-4:1");
        assert_eq!(numbers, [1, 2, 3, 4, 5, 9]);
        assert!(!said.contains("note:"), "{said}");
        for (frames, expected) in [
            ("1-9:0", "the step is not a number of at least 1"),
            ("9-1", "the last frame comes before the first"),
            ("1-x", "'1-x' is no list of frames; write 7, 1-9, 1-9:4 or 1,3,7-9"),
        ] {
            let said = shot.refuse(&format!("--frames {frames}"), 2);
            assert!(said.contains(expected), "{said}");
        }
    }
}

#[test]
fn a_rerun_knows_what_files_were_made_with() {
    for python in python::blenders() {
        let shot = Shot::new(&python, "");
        shot.export("");
        let said = shot.export("");
        assert!(said.contains("1 spp is there, reference is there"), "{said}");
        let (noisy, reference) = (shot.out().join("shot_0001spp.exr"), shot.out().join("shot_ref.exr"));
        let before = [&noisy, &reference].map(|path| fs::read(path).unwrap());

        let said = shot.refuse("--ref-spp 3", 1);
        assert!(said.contains("1 spp is there"), "{said}");
        assert!(said.contains("shot_ref.exr was made with samples 2 instead of 3"), "{said}");
        let said = shot.refuse("--resolution 32x18 --seed 2", 1);
        assert!(said.contains("resolution 64x36 instead of 32x18, seed 1 instead of 2"), "{said}");
        assert!(said.contains("--overwrite renders it again"), "{said}");
        assert_eq!([&noisy, &reference].map(|path| fs::read(path).unwrap()), before, "nothing unasked");

        // As a full disk or a killed copy leave it: cut anywhere.
        for share in [2, 3, 100] {
            fs::write(&noisy, &before[0][..before[0].len() / share]).unwrap();
            let said = shot.export("");
            assert!(said.contains("(was damaged), reference is there"), "1/{share}: {said}");
            shot.passes("shot_0001spp.exr");
        }
        shot.export("--resolution 32x18 --overwrite");
        assert_eq!(size(&shot.passes("shot_0001spp.exr")), (32, 18));
    }
}

#[test]
fn missing_files_are_named() {
    for python in python::blenders() {
        let shot = Shot::new(&python, "texture library");
        let said = shot.export("");
        for lost in ["lost_paint.png", "lost_library.blend"] {
            let named = |line: &str| line.starts_with("warning: missing file ") && line.contains(lost);
            assert_eq!(said.lines().filter(|line| named(line)).count(), 1, "{lost}: {said}");
        }
        assert!(said.contains("1 linked data-blocks are missing from their libraries: prop"), "{said}");
    }
}

#[test]
fn motion_vectors_come_with_sequences_and_are_usable_or_absent() {
    for python in python::blenders() {
        let shot = Shot::new(&python, "");
        shot.export("--frames 4 --ref-spp 0");
        let set = shot.passes("shot_0001spp.0004.exr");
        let vector = set.get(Pass::Vector).expect("sequences have vectors");
        // The card moves by a quarter unit a frame, at the middle of the frame.
        let middle = 18 * 64 + 32;
        let (back, on) = (vector.channel(0)[middle], vector.channel(2)[middle]);
        // From where it was, and to where it goes: one sign in both.
        assert!(back.abs() > 0.5 && (back - on).abs() < 0.3 * back.abs(), "{back} and {on} pixels");
        shot.export("--frames 4 --ref-spp 0 --no-vector --name still");
        assert!(shot.passes("still_0001spp.0004.exr").get(Pass::Vector).is_none());

        let shot = Shot::new(&python, "blur");
        let said = shot.export("--frames 4 --ref-spp 0 --vector");
        assert!(said.contains("Vector is left out; --no-motion-blur renders it"), "{said}");
        assert!(shot.passes("shot_0001spp.0004.exr").get(Pass::Vector).is_none(), "zeros are no vectors");
        shot.export("--frames 4 --ref-spp 0 --no-motion-blur --name sharp");
        assert!(shot.passes("sharp_0001spp.0004.exr").get(Pass::Vector).is_some());
    }
}

#[test]
fn references_keep_their_guides_on_request() {
    for python in python::blenders() {
        let shot = Shot::new(&python, "");
        shot.export("--ref-guides");
        let reference = shot.passes("shot_ref.exr");
        for pass in [Pass::DenoisingAlbedo, Pass::DenoisingNormal] {
            assert!(reference.get(pass).is_some(), "{pass}");
        }
        assert!(reference.get(Pass::Position).is_none());
    }
}

#[test]
fn mistyped_places_are_told_in_a_line() {
    for python in python::blenders() {
        let shot = Shot::new(&python, "");
        let said = shot.refuse("--name a/b", 2);
        assert!(said.contains("'a/b' is no file name: leave out folders"), "{said}");
        fs::write(shot.out(), "a file").unwrap();
        let said = shot.refuse("", 1);
        assert!(said.contains("out of {version} is a file, not a folder (--out)"), "{said}");
    }
}

#[test]
fn what_the_export_sets_is_not_animated() {
    for python in python::blenders() {
        let shot = Shot::new(&python, "animated");
        shot.export("--spp 2 --ref-spp 64 --half-buffers --float");
        let combined = |name: &str| shot.passes(name).get(Pass::Combined).unwrap().clone();
        let [a, b] = ["a", "b"].map(|half| combined(&format!("shot_0002spp_{half}.exr")));
        assert!(a != b, "halves have noise of their own");
        let reference = shot.passes("shot_ref.exr");
        assert_eq!(reference.samples, Some(64));
        // Nor did the time limit end it.
        let rough = |planes: &demc::planes::Planes| {
            let row = &planes.channel(0)[18 * 64 + 20..18 * 64 + 44];
            row.windows(2).map(|pair| (pair[0] - pair[1]).abs()).sum::<f32>()
        };
        assert!(rough(reference.get(Pass::Combined).unwrap()) <= rough(&a));
    }
}

#[test]
fn noisy_and_reference_show_the_same_picture() {
    for python in python::blenders() {
        let shot = Shot::new(&python, "catcher");
        shot.export("--spp 64 --ref-spp 64");
        let alpha = |name: &str| {
            let alpha = shot.passes(name).get(Pass::Alpha).unwrap().clone();
            alpha.data.iter().sum::<f32>() / alpha.data.len() as f32
        };
        let (noisy, reference) = (alpha("shot_0064spp.exr"), alpha("shot_ref.exr"));
        assert!(
            (noisy - reference).abs() < 0.02 * noisy,
            "{noisy} {reference}: shadows are in the alpha of both or none"
        );
    }
}

#[test]
fn cameras_of_markers_count_and_scripts_that_do_not_run_are_told() {
    for python in python::blenders() {
        let shot = Shot::new(&python, "marked");
        shot.export("--frames 1 --ref-spp 0");
        assert_eq!(shot.files(), ["shot_0001spp.0001.exr"]);
        let shot = Shot::new(&python, "driven");
        let said = shot.export("--ref-spp 0");
        assert!(
            said.contains("warning: scripts of the file do not run") && said.contains("--scripts"),
            "{said}"
        );
        assert!(!shot.export("--ref-spp 0 --scripts --overwrite").contains("do not run"));
    }
}

#[test]
fn files_of_another_state_of_the_scene_are_told() {
    let shot = Shot::new(&python::python(), "");
    shot.export("");
    let mut bytes = fs::read(shot.blend()).unwrap();
    bytes.push(0);
    fs::write(shot.blend(), bytes).unwrap();
    let said = shot.export("");
    assert!(said.contains("2 files that are there were made of another state of shot.blend"), "{said}");
    assert!(!shot.export("--overwrite").contains("another state"));
    assert!(!shot.export("").contains("another state"));
    let said = shot.refuse("--ref-noise nan", 2);
    assert!(said.contains("nan is not a number from 0 to 1"), "{said}");
    // What is linked belongs to the scene.
    let shot = Shot::new(&python::python(), "linked");
    shot.export("--ref-spp 0");
    assert!(!shot.export("--ref-spp 0").contains("another state"));
    let library = shot.folder.path().join("props.blend");
    let bytes = [fs::read(&library).unwrap(), vec![0]].concat();
    fs::write(&library, bytes).unwrap();
    let said = shot.export("--ref-spp 0");
    assert!(said.contains("1 files that are there were made of another state of shot.blend"), "{said}");
}

#[test]
fn a_frame_shows_the_same_wherever_the_file_was_saved_and_simulations_are_told() {
    for python in python::blenders() {
        let shot = Shot::new(&python, "between");
        shot.export("--frames 2 --ref-spp 0 --name alone");
        let said = shot.export("--frames 1-2 --ref-spp 0 --name both");
        assert!(!said.contains("simulated"), "{said}");
        let [alone, both] = ["alone", "both"].map(|name| {
            let set = shot.passes(&format!("{name}_0001spp.0002.exr"));
            set.get(Pass::Position).unwrap().data.to_vec()
        });
        assert!(alone == both, "frame 2 is not that between 2 and 3");
        let said = Shot::new(&python, "simulated").export("--frames 1 --ref-spp 0");
        assert!(said.contains("warning: rigid bodies: simulated and not baked"), "{said}");
    }
}

#[test]
fn an_open_scene_keeps_how_its_files_are_written() {
    for python in python::blenders() {
        let shot = Shot::new(&python, "");
        let mut command = shot.script(&snippet("leaves_no_trace.py"));
        command.arg(scripts()).arg(shot.blend()).arg("--out").arg(shot.out());
        let output = assert_cmd::Command::from_std(command).timeout(PATIENCE).output().unwrap();
        let said = String::from_utf8(output.stdout).unwrap();
        let is_whole = said.lines().any(|line| line.trim() == "changed: []");
        assert!(is_whole && output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    }
}
