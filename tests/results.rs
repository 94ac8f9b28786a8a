//! What `demc denoise` makes of files that lie where results go: its own are taken up, brought up to date, or
//! are no inputs; those of others, and inputs, are never lost.

mod common;

use std::{fs, path::Path, time::Duration};

use common::{
    demc,
    files::{data, deep_file, read_exr, samples, values, write_render},
};
use demc::frame::Frame;
use predicates::{prelude::*, str::contains};
use tempfile::TempDir;

/// A folder with a small render at each of these paths.
fn folder_with(paths: &[&str]) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (seed, path) in paths.iter().enumerate() {
        let path = folder.path().join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        write_render(&path, 24, 18, |_, pixel| ((pixel * 31 + seed) % 97) as f32 / 97.0);
    }
    folder
}

/// Denoises in a folder, by `noisy` where no model is named.
fn denoise(folder: &Path, arguments: &str) -> assert_cmd::assert::Assert {
    let mut command = demc();
    let model = if arguments.contains("--model") { "" } else { "--model noisy" };
    let arguments = arguments.split_whitespace().chain(model.split_whitespace());
    command.current_dir(folder).arg("denoise").args(arguments).timeout(Duration::from_secs(60)).assert()
}

#[test]
fn what_is_no_result_of_demc_is_not_overwritten_unasked() {
    let folder = folder_with(&["in/deep.exr", "in/flat.exr", "out/flat.exr"]);
    let [deep, flat] = ["deep", "flat"].map(|name| folder.path().join(format!("out/{name}.exr")));
    fs::write(&deep, deep_file()).unwrap();
    let before = [&deep, &flat].map(|path| fs::read(path).unwrap());
    let words =
        |name: &str| contains(format!("{name}.exr: exists without 'ViewLayer.Denoised' made by demc"));
    denoise(folder.path(), "in --out out").code(1).stderr(words("flat").and(contains("deep.exr: ")));
    assert_eq!([&deep, &flat].map(|path| fs::read(path).unwrap()), before);
    denoise(folder.path(), "in --out out --overwrite").success();
    assert!([deep, flat].iter().all(|path| Frame::read(path).unwrap().is_result()));
}

#[test]
fn a_result_does_not_take_the_place_of_another_input() {
    let folder = folder_with(&["a/b/x.exr", "b/x.exr"]);
    let before = fs::read(folder.path().join("b/x.exr")).unwrap();
    denoise(folder.path(), "a b --recursive --out . --overwrite")
        .code(2)
        .stderr(contains("would overwrite the input b/x.exr"));
    assert_eq!(fs::read(folder.path().join("b/x.exr")).unwrap(), before);
}

#[test]
fn nor_does_one_that_comes_in_later() {
    let folder = folder_with(&["b/x.exr"]);
    fs::create_dir(folder.path().join("a")).unwrap();
    let before = fs::read(folder.path().join("b/x.exr")).unwrap();
    let mut watch = std::process::Command::new(assert_cmd::cargo::cargo_bin("demc"));
    watch
        .current_dir(folder.path())
        .args("denoise a b --recursive --out . --overwrite --watch 4 --model noisy".split(' '));
    let watch = watch.stderr(std::process::Stdio::piped()).spawn().unwrap();
    std::thread::sleep(Duration::from_millis(2500));
    fs::create_dir(folder.path().join("a/b")).unwrap();
    fs::copy(folder.path().join("b/x.exr"), folder.path().join("a/b/x.exr")).unwrap();
    let ended = watch.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&ended.stderr);
    assert!(ended.status.code() == Some(1) && said.contains("would overwrite the input b/x.exr"), "{said}");
    assert_eq!(fs::read(folder.path().join("b/x.exr")).unwrap(), before);
}

#[test]
fn a_result_beside_other_inputs_can_be_denoised_again() {
    let folder = folder_with(&["in/a.exr", "in/b.exr"]);
    denoise(folder.path(), "in/a.exr --out first").success();
    fs::rename(folder.path().join("first/a.exr"), folder.path().join("in/a.exr")).unwrap();
    denoise(folder.path(), "in --out .").success().stdout(contains("2 denoised"));
}

#[test]
fn results_are_no_inputs_the_second_time() {
    let folder = folder_with(&["renders/one/a.exr", "renders/two/b.exr", "flat/c.exr"]);
    let pattern = "renders/*/*.exr --out renders/clean";
    denoise(folder.path(), pattern).success().stdout(contains("2 denoised"));
    denoise(folder.path(), pattern).success().stdout(contains("0 denoised, 2 already there"));
    denoise(folder.path(), &format!("{pattern} --watch 1")).success();
    // As a shell writes out `flat/*`.
    denoise(folder.path(), "flat/c.exr --out flat/clean").success();
    denoise(folder.path(), "flat/c.exr flat/clean --out flat/clean").success();
    // A result that is the only input is one, and a render of another program there as well.
    denoise(folder.path(), "flat/clean/c.exr --out again").success();
    denoise(folder.path(), "flat/clean --out flat/clean")
        .code(2)
        .stderr(contains("would overwrite its input"));
    fs::copy(folder.path().join("flat/c.exr"), folder.path().join("flat/clean/d.exr")).unwrap();
    denoise(folder.path(), "flat/*.exr flat/clean/*.exr --out flat/clean")
        .code(2)
        .stderr(contains("d.exr: the result would overwrite"));
}

#[test]
fn a_frame_without_light_passes_is_taken_up_like_any_other() {
    let folder = tempfile::tempdir().unwrap();
    let render = data("s0000_room_0004spp.exr");
    let arguments = format!("{} --out out --model demc-s --passes", render.display());
    denoise(folder.path(), &arguments)
        .success()
        .stderr(contains("holds no light passes").or(predicate::always()));
    denoise(folder.path(), &arguments).success();
}

#[test]
fn what_an_earlier_result_was_expected_to_be_is_forgotten() {
    let folder = tempfile::tempdir().unwrap();
    let render = data("s0000_room_0004spp.exr");
    denoise(folder.path(), &format!("{} --out first --model demc-s --confidence", render.display()))
        .success();
    let name = render.file_name().unwrap();
    let first = folder.path().join("first").join(name);
    assert_eq!(Frame::read_headers(&first).unwrap().expected_errors().len(), 1);
    denoise(folder.path(), &format!("{} --out second", first.display())).success();
    let second = folder.path().join("second").join(name);
    assert!(Frame::read_headers(&second).unwrap().expected_errors().is_empty());
    assert!(values(&read_exr(second), "ViewLayer.Denoised Error.X").iter().all(|v| v.is_nan()));
}

#[test]
fn the_beauty_is_replaced_where_a_name_is_not_utf8() {
    let folder = folder_with(&["in.exr"]);
    let path = folder.path().join("in.exr");
    // K\xfcche, as a program wrote it that knew Latin-1 alone; as long as the name it had.
    let mut bytes = fs::read(&path).unwrap();
    let name = b"ViewLayer.";
    let places: Vec<usize> =
        (0..bytes.len() - name.len()).filter(|at| bytes[*at..].starts_with(name)).collect();
    places.iter().for_each(|at| bytes[*at..at + name.len()].copy_from_slice(b"K\xfcche1234."));
    fs::write(&path, bytes).unwrap();
    denoise(folder.path(), "in.exr --out out --replace").success();
    let result = Frame::read(folder.path().join("out/in.exr")).unwrap();
    let channels: usize = result.parts().iter().map(|part| part.channels.len()).sum();
    assert_eq!(
        channels,
        Frame::read(&path).unwrap().parts().iter().map(|part| part.channels.len()).sum::<usize>()
    );
}

#[test]
fn a_frame_is_read_from_files_alone() {
    let folder = folder_with(&["in/a.exr"]);
    let made = std::process::Command::new("mkfifo").arg(folder.path().join("in/pipe.exr")).status();
    if made.is_ok_and(|status| status.success()) {
        // Nobody writes into it: opening it would wait for ever.
        denoise(folder.path(), "in/a.exr in/pipe.exr --out out")
            .code(1)
            .stderr(contains("pipe.exr: is no file on a disk"));
        assert!(samples(&read_exr(folder.path().join("out/a.exr")), "ViewLayer.Denoised.R").is_some());
    }
}

#[test]
#[cfg(target_os = "linux")]
fn a_full_disk_under_standard_output_is_a_failure() {
    let folder = folder_with(&["a.exr"]);
    let full = || fs::File::options().write(true).open("/dev/full").unwrap();
    for arguments in [
        vec!["inspect", "a.exr", "--json"],
        vec!["denoise", "a.exr", "--out", "out", "--model", "noisy", "--json"],
    ] {
        let mut command = std::process::Command::new(assert_cmd::cargo::cargo_bin("demc"));
        let ended = command.current_dir(folder.path()).args(&arguments).stdout(full()).output().unwrap();
        let said = String::from_utf8(ended.stderr).unwrap();
        assert_eq!(ended.status.code(), Some(1), "{arguments:?}: {said}");
        assert!(said.contains("cannot write to standard output"), "{said}");
    }
    assert!(folder.path().join("out/a.exr").is_file());
}

#[test]
fn no_more_threads_than_anybody_means() {
    for arguments in [
        "denoise a.exr --out o --threads 5000",
        "train --out o --data d --threads 5000",
        "eval --test-set d --out o --threads 5000",
    ] {
        demc().args(arguments.split_whitespace()).assert().code(2).stderr(contains("4096"));
    }
}

#[test]
fn a_result_that_was_cut_off_is_made_again() {
    let folder = folder_with(&["in/shot.0001.exr"]);
    denoise(folder.path(), "in --out out").success();
    let path = folder.path().join("out/shot.0001.exr");
    let whole = fs::read(&path).unwrap();
    for length in [whole.len() - 1, whole.len() / 2, 0] {
        fs::write(&path, &whole[..length]).unwrap();
        denoise(folder.path(), "in --out out").success().stdout(contains("is there already").not());
        assert!(fs::read(&path).unwrap() == whole, "cut at {length}");
    }
    // What somebody else's file was is not known.
    let render = fs::read(folder.path().join("in/shot.0001.exr")).unwrap();
    fs::write(&path, &render[..render.len() - 1]).unwrap();
    denoise(folder.path(), "in --out out").code(1).stderr(contains("exists without"));
}

#[test]
fn what_frames_leaves_out_is_told_where_it_is_no_file() {
    let folder = folder_with(&["in/shot.0001.exr", "in/shot.0002.exr"]);
    let missing = contains("sc010: cannot read");
    denoise(folder.path(), "in sc010 --out out --frames 1")
        .code(1)
        .stderr(missing.clone())
        .stdout(contains("1 denoised"));
    denoise(folder.path(), "sc010 --out out --frames 1").code(1).stderr(missing.clone());
    // Two of one name would have one place, if they were frames.
    let two = denoise(folder.path(), "a/frames b/frames in --out out2 --frames 1").code(1);
    two.stderr(contains("a/frames: cannot read").and(contains("b/frames: cannot read")))
        .stdout(contains("1 denoised"));
    denoise(folder.path(), "sc010 --out out --frames 1 --watch 1").code(1).stderr(missing);
    denoise(folder.path(), "none/*.exr --out out --watch 1")
        .code(1)
        .stderr(contains("none/*.exr: matches no file"));
}

#[test]
fn options_that_exclude_each_other_are_wrong_usage_once() {
    let folder = folder_with(&["in/shot.0001.exr", "in/shot.0002.exr"]);
    for (options, why) in [
        ("--model demc-s --temporal --passes", "work frame by frame"),
        ("--model nfor --passes", "--passes takes"),
        ("--model nfor --confidence", "--confidence"),
    ] {
        denoise(folder.path(), &format!("in --out out {options}")).code(2).stderr(contains(why).count(1));
    }
    assert!(!folder.path().join("out/shot.0001.exr").exists());
}

#[test]
fn a_guide_is_not_overwritten() {
    let folder = folder_with(&["in/shot.0001.exr", "guides/shot.0001.exr"]);
    let before = fs::read(folder.path().join("guides/shot.0001.exr")).unwrap();
    let command =
        "in/shot.0001.exr --albedo guides/shot.####.exr --map albedo=Combined --out guides --overwrite";
    denoise(folder.path(), command)
        .code(1)
        .stderr(contains("guides/shot.0001.exr: is a guide of this frame"));
    assert!(fs::read(folder.path().join("guides/shot.0001.exr")).unwrap() == before);
}

#[test]
#[cfg(target_os = "linux")]
fn names_that_are_not_utf8_are_names_like_any() {
    use std::{ffi::OsStr, os::unix::ffi::OsStrExt};
    let folder = folder_with(&["in/a.0001.exr"]);
    let name = |number: u8| OsStr::from_bytes(&[b"k\xfcche.000", &[number][..], b".exr"].concat()).to_owned();
    for number in [b'2', b'3'] {
        fs::copy(folder.path().join("in/a.0001.exr"), folder.path().join("in").join(name(number))).unwrap();
    }
    let has = |number| folder.path().join("out").join(name(number)).exists();
    denoise(folder.path(), "in --out out --frames 2").success();
    assert!(has(b'2') && !has(b'3'));
    denoise(folder.path(), "in/*.exr --out out").success().stdout(contains("2 denoised, 1 already there"));
    assert!(has(b'3'));
    // Without vectors the frames stay alone, but they know of each other.
    denoise(folder.path(), "in --out out --overwrite --temporal 1")
        .success()
        .stderr(contains("frame 3 has no pass Vector"));
}

/// What the shell tells the program to ignore stays ignored, and a file that may not grow further fails alone.
#[test]
#[cfg(target_os = "linux")]
fn nohup_outlives_its_terminal_and_a_file_limit_costs_its_frame() {
    let folder = folder_with(&["in/b.0001.exr"]);
    write_render(&folder.path().join("in/a.0001.exr"), 400, 300, |_, pixel| {
        (pixel * 7919 % 65521) as f32 / 65521.0
    });
    let shell = |script: &str| {
        let mut command = std::process::Command::new("bash");
        let demc = assert_cmd::cargo::cargo_bin("demc");
        command.args(["-c", script]).env("DEMC", demc).current_dir(folder.path());
        command.output().unwrap()
    };
    let limited = shell("ulimit -f 60; \"$DEMC\" denoise in --model noisy --out out");
    let said = String::from_utf8_lossy(&limited.stderr);
    assert_eq!(limited.status.code(), Some(1), "{said}");
    assert!(said.contains("a.0001.exr: cannot write: File too large"), "{said}");
    assert!(folder.path().join("out/b.0001.exr").exists());
    // A watch, so that the signal comes while it runs.
    let script = "trap '' HUP; \"$DEMC\" denoise in --model noisy --out out2 --watch 3 & sleep 1.5; kill -HUP $!; wait $!";
    let hung_up = shell(script);
    assert_eq!(hung_up.status.code(), Some(0), "{}", String::from_utf8_lossy(&hung_up.stderr));
    let script = "\"$DEMC\" denoise in --model noisy --out out3 --watch & sleep 1.5; kill -HUP $!; wait $!";
    assert_eq!(shell(script).status.code(), Some(130));
}
