//! `demc denoise` as its users run it: what is kept, what is added, what a batch survives.
//!
//! The method is `noisy`, which returns its input: what is tested is everything around the model.

mod common;

use std::{
    fs,
    path::{Path, PathBuf},
};

use assert_cmd::Command;
use common::files::{bits, data, names_in, read_exr, samples, values, write_bare_parts, write_render};
use demc::frame::{Frame, NewChannel, SampleKind};
use predicates::{prelude::*, str::contains};
use tempfile::TempDir;

fn demc(out: &Path) -> Command {
    let mut command = Command::cargo_bin("demc").unwrap();
    command.args(["denoise", "--model", "noisy", "--out"]).arg(out);
    command
}

fn out() -> (TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("out");
    (dir, path)
}

/// All that `before` holds, `after` holds, bit for bit.
#[track_caller]
fn assert_kept(before: &Path, after: &Path) {
    let (before, after) = (read_exr(before), read_exr(after));
    assert_eq!(before.attributes, after.attributes);
    assert!(!before.layer_data.is_empty());
    for (old, new) in before.layer_data.iter().zip(&after.layer_data) {
        let kept = |layer: &exr::prelude::Layer<_>| {
            let mut attributes = layer.attributes.clone();
            // What was added, and how it was made.
            attributes.other.retain(|name, _| !name.to_string().starts_with("demc"));
            attributes
        };
        assert_eq!((old.size, kept(old), &old.encoding), (new.size, kept(new), &new.encoding));
        for channel in &old.channel_data.list {
            let now = new.channel_data.list.iter().find(|c| c.name == channel.name).expect("channel kept");
            assert_eq!(bits(&channel.sample_data), bits(&now.sample_data), "{}", channel.name);
        }
    }
}

#[track_caller]
fn assert_same_values(path: &Path, a: &str, b: &str) {
    let image = read_exr(path);
    let (a, b) = (samples(&image, a).expect(a), samples(&image, b).expect(b));
    assert_eq!(bits(a), bits(b));
    assert_eq!(std::mem::discriminant(a), std::mem::discriminant(b), "number type");
}

#[test]
fn adds_the_layer_to_renders_of_both_blender_layouts() {
    for (file, parts_added) in [("blender5.exr", 1), ("blender4.exr", 0)] {
        let (_dir, out) = out();
        demc(&out).arg(data(file)).assert().success().stdout(contains("40x24")).stderr("");
        let result = out.join(file);
        assert_kept(&data(file), &result);
        for c in ["R", "G", "B", "A"] {
            assert_same_values(
                &result,
                &format!("ViewLayer.Combined.{c}"),
                &format!("ViewLayer.Denoised.{c}"),
            );
        }
        let (before, after) = (read_exr(data(file)), read_exr(&result));
        assert_eq!(after.layer_data.len(), before.layer_data.len() + parts_added);
        if parts_added > 0 {
            let name = &after.layer_data.last().unwrap().attributes.layer_name;
            assert_eq!(name.as_ref().unwrap().to_string(), "ViewLayer.Denoised");
        }
    }
}

#[test]
fn denoises_both_eyes_of_stereo_renders() {
    for file in ["blender5_stereo.exr", "blender4_stereo.exr"] {
        let (_dir, out) = out();
        demc(&out).arg(data(file)).arg("--preview").assert().success();
        assert_kept(&data(file), &out.join(file));
        let stem = file.strip_suffix(".exr").unwrap();
        assert!(
            out.join(format!("{stem}.left.png")).exists() && out.join(format!("{stem}.right.png")).exists()
        );
    }
    // Blender 4 names the view in the channel, Blender 5 in the part.
    let (_dir, out) = out();
    demc(&out).args([data("blender4_stereo.exr"), data("blender5_stereo.exr")]).assert().success();
    let four = out.join("blender4_stereo.exr");
    for view in ["left", "right"] {
        let name = |pass| format!("ViewLayer.{pass}.{view}.G");
        assert_same_values(&four, &name("Combined"), &name("Denoised"));
    }
    let five = read_exr(out.join("blender5_stereo.exr"));
    let part = |name: &str| {
        let named =
            |l: &&exr::prelude::Layer<_>| l.attributes.layer_name.as_ref().is_some_and(|n| n.eq(name));
        five.layer_data.iter().find(named).unwrap_or_else(|| panic!("no part {name}"))
    };
    for view in ["left", "right"] {
        let beauty = part(&format!("ViewLayer.Combined-{view}"));
        let denoised = part(&format!("ViewLayer.Denoised-{view}"));
        assert_eq!(denoised.attributes.view_name.as_ref().unwrap().to_string(), view);
        let green = |l: &exr::prelude::Layer<exr::prelude::AnyChannels<exr::prelude::FlatSamples>>| {
            bits(&l.channel_data.list[2].sample_data)
        };
        assert_eq!(green(beauty), green(denoised));
    }
}

#[test]
fn light_stored_as_whole_numbers_gets_a_result_that_is_none() {
    use exr::prelude::{AnyChannel, AnyChannels, FlatSamples, Image, WritableImage};

    let (dir, out) = out();
    let path = dir.path().join("whole.exr");
    let list = ["R", "G", "B"].map(|component| {
        AnyChannel::new(format!("ViewLayer.Combined.{component}").as_str(), FlatSamples::U32(vec![2; 64]))
    });
    let channels = AnyChannels::sort(list.into_iter().collect());
    Image::from_channels((8, 8), channels).write().to_file(&path).unwrap();
    demc(&out).arg(&path).assert().success();
    let result = read_exr(out.join("whole.exr"));
    let added = samples(&result, "ViewLayer.Denoised.R").unwrap();
    assert!(matches!(added, FlatSamples::F32(values) if *values == [2.0; 64]), "{added:?}");
}

#[test]
fn chooses_among_view_layers() {
    let file = "blender4_two_layers.exr";
    let (_dir, out) = out();
    demc(&out)
        .arg(data(file))
        .assert()
        .success()
        .stderr(contains("denoised view layer 'Second.Layer'; --view-layer chooses another: 'ViewLayer'"));
    assert!(samples(&read_exr(out.join(file)), "Second.Layer.Denoised.R").is_some());

    // What the compositor made is no view layer.
    let dir = tempfile::tempdir().unwrap();
    let composed = dir.path().join("composed.exr");
    let mut frame = Frame::read(data("blender5.exr")).unwrap();
    let window = frame.parts()[0].data_window;
    let values = vec![0.5; window.width * window.height];
    let kind = SampleKind::Half;
    let channels = ["R", "G", "B"].map(|component| NewChannel { component, kind, values: &values });
    frame.set_layer(0, "Composite.Combined", None, &channels).unwrap();
    frame.write(&composed).unwrap();
    demc(&out).arg(&composed).assert().success().stderr("");

    let overwrite = ["--overwrite", "--view-layer", "ViewLayer"];
    demc(&out).arg(data(file)).args(overwrite).assert().success().stderr("");
    let image = read_exr(out.join(file));
    assert!(samples(&image, "Second.Layer.Denoised.R").is_none());
    assert!(samples(&image, "ViewLayer.Denoised.R").is_some());
}

#[test]
fn repairs_reports_and_never_writes_non_finite_values() {
    let (dir, out) = out();
    let input = dir.path().join("in.exr");
    write_render(&input, 9, 5, |name, i| match (name, i) {
        ("Combined.R", 3) => f32::NAN,
        ("Combined.G", 44) => f32::INFINITY,
        ("Combined.B", _) => f32::NEG_INFINITY,
        ("Combined.A", 7) => f32::NAN,
        ("Combined.A", _) => 1.0,
        (_, i) => i as f32,
    });
    demc(&out).arg(&input).assert().success().stderr(contains("repaired: 1 in Alpha, 47 in Combined"));
    assert_kept(&input, &out.join("in.exr"));
    let image = read_exr(out.join("in.exr"));
    for c in ["R", "G", "B", "A"] {
        assert!(values(&image, &format!("ViewLayer.Denoised.{c}")).iter().all(|v| v.is_finite()), "{c}");
    }
    // The mean of pixels 2, 4, 11, 12 and 13.
    assert_eq!(values(&image, "ViewLayer.Denoised.R")[3], 8.4f32.round_to_half());
    assert_eq!(values(&image, "ViewLayer.Denoised.B"), [0.0; 45]);
}

trait RoundToHalf {
    fn round_to_half(self) -> f32;
}

impl RoundToHalf for f32 {
    fn round_to_half(self) -> f32 {
        half::f16::from_f32(self).to_f32()
    }
}

#[test]
fn replace_overwrites_the_beauty_and_nothing_else() {
    let (dir, out) = out();
    let input = dir.path().join("in.exr");
    write_render(&input, 4, 4, |name, i| if name == "Combined.R" && i == 5 { f32::NAN } else { 2.0 });
    demc(&out).arg(&input).arg("--replace").assert().success();
    let image = read_exr(out.join("in.exr"));
    assert_eq!(values(&image, "ViewLayer.Combined.R"), [2.0; 16]);
    let mut names: Vec<String> =
        image.layer_data[0].channel_data.list.iter().map(|c| c.name.to_string()).collect();
    names.sort();
    let expected: Vec<String> =
        read_exr(&input).layer_data[0].channel_data.list.iter().map(|c| c.name.to_string()).collect();
    assert_eq!(names, expected);
}

#[test]
fn every_size_from_one_pixel_up() {
    let (dir, out) = out();
    for (width, height) in [(1, 1), (1, 17), (33, 1), (2, 3), (17, 31)] {
        let input = dir.path().join(format!("{width}x{height}.exr"));
        write_render(&input, width, height, |_, i| i as f32);
        demc(&out).arg(&input).arg("--preview").assert().success();
        let result = out.join(input.file_name().unwrap());
        assert_same_values(&result, "ViewLayer.Combined.G", "ViewLayer.Denoised.G");
        let png = image::open(result.with_extension("png")).unwrap();
        assert_eq!((png.width() as usize, png.height() as usize), (width, height));
    }
}

#[test]
fn plain_rgb_images_gain_a_layer_too() {
    use exr::prelude::*;
    let (dir, out) = out();
    let input = dir.path().join("plain.exr");
    write_rgb_file(&input, 5, 4, |x, y| (x as f32, y as f32, 0.5f32)).unwrap();
    demc(&out).arg(&input).assert().success();
    assert_kept(&input, &out.join("plain.exr"));
    assert_same_values(&out.join("plain.exr"), "G", "Denoised.G");
}

#[test]
fn skips_finished_results_unless_told_otherwise() {
    let (_dir, out) = out();
    let result = out.join("blender4.exr");
    demc(&out).arg(data("blender5.exr")).assert().success();
    fs::rename(out.join("blender5.exr"), &result).unwrap();
    let finished = fs::read(&result).unwrap();
    demc(&out).arg(data("blender4.exr")).assert().success().stdout(contains("is there already"));
    // Another result than the one there is wanted: neither is it done without a word, nor that one lost.
    for other in [
        &["--replace"][..],
        &["--layer", "Clean"],
        &["--view-layer", "Nope"],
        &["--layer", "Clean", "--preview"],
    ] {
        let run = demc(&out).arg(data("blender4.exr")).args(other).assert().code(1);
        run.stderr(
            contains("out/blender4.exr: exists without 'ViewLayer.").or(contains("no view layer 'Nope'")),
        );
    }
    assert_eq!(fs::read(&result).unwrap(), finished);
    fs::copy(data("blender5.exr"), &result).unwrap();
    demc(&out)
        .arg(data("blender4.exr"))
        .assert()
        .code(1)
        .stderr(contains("--overwrite denoises the frame again"));
    assert_eq!(fs::read(&result).unwrap(), fs::read(data("blender5.exr")).unwrap());
    demc(&out).arg(data("blender4.exr")).arg("--overwrite").assert().success();
    assert_kept(&data("blender4.exr"), &result);

    // What a full disk or a failed copy left is no result.
    for remains in [&b""[..], b"finished earlier", &fs::read(&result).unwrap()[..200]] {
        fs::write(&result, remains).unwrap();
        demc(&out).arg(data("blender4.exr")).assert().success().stdout(contains("already").not());
        assert_kept(&data("blender4.exr"), &result);
    }
}

#[test]
fn previews_are_made_up_for_and_kept() {
    let (_dir, out) = out();
    let files = ["blender4.exr", "blender5_stereo.exr"];
    let pngs = ["blender4.png", "blender5_stereo.left.png", "blender5_stereo.right.png"];
    for args in [&[][..], &["--replace"]] {
        let run = |more: &[&str]| demc(&out).args(files.map(data)).args(args).args(more).assert().success();
        run(&["--overwrite", "--preview"]);
        let whole = pngs.map(|png| fs::read(out.join(png)).unwrap());
        pngs.iter().for_each(|png| fs::remove_file(out.join(png)).unwrap());
        run(&["--preview"]).stdout(contains("2 already there"));
        assert!(pngs.map(|png| fs::read(out.join(png)).unwrap()) == whole, "as written with the result");

        fs::write(out.join(pngs[0]), "another program's").unwrap();
        run(&["--preview"]);
        fs::remove_file(out.join(files[0])).unwrap();
        run(&["--preview"]).stderr(contains("blender4.png: kept; --overwrite"));
        run(&["--overwrite"]).stderr(contains("blender4.png: may show the earlier result; --preview"));
        assert_eq!(fs::read(out.join(pngs[0])).unwrap(), b"another program's");
    }

    // A beauty that was not replaced is no preview of one that was.
    let (_dir, out) = self::out();
    demc(&out).arg(data(files[0])).assert().success();
    let again = demc(&out).arg(data(files[0])).args(["--replace", "--preview"]).assert().code(1);
    again.stderr(contains("blender4.exr: exists without 'ViewLayer.Combined' made by demc; --overwrite"));
    assert!(!out.join(pngs[0]).exists());
}

#[test]
fn takes_files_directories_and_globs_and_does_each_file_once() {
    let (dir, out) = out();
    for name in ["a.0001.exr", "a.0002.exr", "b.EXR", ".hidden.exr", "note.txt"] {
        fs::copy(data("blender4.exr"), dir.path().join(name)).unwrap();
    }
    let glob = dir.path().join("*a.*.exr");
    fs::write(dir.path().join("._a.0001.exr"), "not an image").unwrap();
    demc(&out)
        .args([&glob, dir.path(), &dir.path().join("b.EXR")])
        .assert()
        .success()
        .stdout(contains("3 denoised"));
    assert_eq!(names_in(&out), ["a.0001.exr", "a.0002.exr", "b.EXR"]);
}

#[test]
fn one_bad_file_does_not_stop_the_batch() {
    let (dir, out) = out();
    let bad = dir.path().join("bad.exr");
    fs::write(&bad, "not an image").unwrap();
    let missing = dir.path().join("missing.exr");
    demc(&out)
        .args([&bad, &data("blender4.exr"), &missing, &data("blender5.exr")])
        .assert()
        .code(1)
        .stdout(contains("2 denoised, 2 failed"))
        .stderr(contains("bad.exr: is not an EXR").and(contains("missing.exr: cannot read")));
    assert_eq!(fs::read_dir(&out).unwrap().count(), 2);
}

#[test]
fn refuses_two_inputs_of_one_name_and_its_own_input_before_any_work() {
    let (dir, out) = out();
    let copy = dir.path().join("blender4.exr");
    fs::copy(data("blender4.exr"), &copy).unwrap();
    let both = [data("blender4.exr"), copy.clone()];
    demc(&out).args(both).assert().code(2).stderr(contains("would both be written to"));
    assert!(!out.exists());
    demc(dir.path()).arg(&copy).assert().code(2).stderr(contains("would overwrite its input"));
    assert_eq!(fs::read(&copy).unwrap(), fs::read(data("blender4.exr")).unwrap());
}

#[test]
fn layer_names() {
    let (_dir, out) = out();
    demc(&out).arg(data("blender5.exr")).args(["--layer", "Clean beauty"]).assert().success();
    let image = read_exr(out.join("blender5.exr"));
    assert!(samples(&image, "ViewLayer.Clean beauty.R").is_some());
    assert!(samples(&image, "ViewLayer.Denoised.R").is_none());
    for bad in ["", "a.b", "a\nb", "Normal", "DiffCol", "Combined", "Beauty", "rgb"] {
        demc(&out)
            .arg(data("blender5.exr"))
            .args(["--layer", bad])
            .assert()
            .code(2)
            .stderr(contains("--layer"));
    }
}

#[test]
fn replaces_the_layers_it_added_and_no_others() {
    // Each file has a layer that demc does not read, in its own letter case or with bare channels.
    for (file, layer) in [("blender4.exr", "CryptoObject00"), ("blender5_stereo.exr", "cryptoobject00")] {
        let (_dir, out) = out();
        let run = demc(&out).arg(data(file)).args(["--layer", layer]).assert().code(1);
        run.stderr(contains(format!("'ViewLayer.{layer}' without demc's mark; give --layer another name")));
        assert_eq!(fs::read_dir(&out).unwrap().count(), 0);
    }
    for file in ["blender4.exr", "blender5.exr", "blender4_stereo.exr", "blender5_stereo.exr"] {
        let (dir, first) = out();
        let second = dir.path().join("second");
        demc(&first).arg(data(file)).assert().success();
        demc(&first).arg(data(file)).args(["--layer", "Clean", "--overwrite"]).assert().success();
        demc(&second).arg(first.join(file)).args(["--layer", "Clean"]).assert().success();
        assert_kept(&first.join(file), &second.join(file));
        let parts = |path: &Path| read_exr(path).layer_data.len();
        assert_eq!(parts(&first.join(file)), parts(&second.join(file)));
    }
}

#[test]
fn a_part_with_bare_channels_is_not_added_twice() {
    let (dir, out) = out();
    let input = dir.path().join("in.exr");
    write_bare_parts(&input, &["rgba", "Denoised"]);
    demc(&out).arg(&input).assert().code(1).stderr(contains("'Denoised' without demc's mark"));
    demc(&out).arg(&input).args(["--layer", "Clean"]).assert().success();
    assert_kept(&input, &out.join("in.exr"));
}

#[test]
fn a_part_name_with_a_dot_is_no_layer() {
    let (dir, out) = out();
    let input = dir.path().join("in.exr");
    write_bare_parts(&input, &["shot.v001"]);
    demc(&out).arg(&input).assert().success();
    assert_same_values(&out.join("in.exr"), "R", "Denoised.R");
}

/// `demc ... 2>&1 | head`, or a log file on a full disk.
#[cfg(target_os = "linux")]
#[test]
fn a_batch_outlives_those_who_read_what_it_says() {
    let (dir, out) = out();
    let bad = dir.path().join("bad.exr");
    fs::write(&bad, "not an image").unwrap();
    let full = || fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let status = std::process::Command::new(assert_cmd::cargo::cargo_bin("demc"))
        .args(["denoise", "--model", "noisy", "--out"])
        .arg(&out)
        .args([&bad, &data("blender4_two_layers.exr"), &data("blender5.exr")])
        .stderr(full())
        .stdout(full())
        .status()
        .unwrap();
    assert_eq!(status.code(), Some(1));
    assert_eq!(fs::read_dir(&out).unwrap().count(), 2);
}

/// A sequence in which a frame is held by linking to it, and one whose storage is not there.
#[cfg(unix)]
#[test]
fn links_are_frames_of_their_own() {
    let (dir, out) = out();
    let link = |to: &str, name: &str| std::os::unix::fs::symlink(to, dir.path().join(name)).unwrap();
    fs::copy(data("blender4.exr"), dir.path().join("f.0001.exr")).unwrap();
    link("f.0001.exr", "f.0002.exr");
    link("gone.exr", "f.0003.exr");
    for input in [dir.path().to_path_buf(), dir.path().join("f.*.exr")] {
        let run = demc(&out).arg(input).arg("--overwrite").assert().code(1);
        run.stdout(contains("2 denoised, 1 failed")).stderr(contains("f.0003.exr: cannot read"));
        assert_kept(&data("blender4.exr"), &out.join("f.0002.exr"));
    }
}

#[test]
fn an_input_that_names_nothing_does_not_stop_the_others() {
    let (dir, out) = out();
    let empty = dir.path().join("empty");
    fs::create_dir(&empty).unwrap();
    let none = demc(&out).args([&empty, &dir.path().join("*.exr")]).assert().code(2);
    none.stderr(contains("no EXR files").and(contains("matches no file")));
    demc(&out)
        .args([&empty, &dir.path().join("*.exr"), &data("blender4.exr")])
        .assert()
        .code(1)
        .stdout(contains("1 denoised, 2 failed"))
        .stderr(contains("no EXR files").and(contains("matches no file")));
    assert!(out.join("blender4.exr").exists());
}

#[test]
fn json_is_one_object_a_file() {
    let (dir, out) = out();
    let bad = dir.path().join("bad.exr");
    fs::write(&bad, "").unwrap();
    let run =
        demc(&out).args([data("blender5.exr"), bad]).args(["--json", "--threads", "1"]).assert().code(1);
    let lines: Vec<serde_json::Value> = String::from_utf8(run.get_output().stdout.clone())
        .unwrap()
        .lines()
        .map(|l| serde_json::from_str(l).unwrap())
        .collect();
    assert_eq!(lines.len(), 2);
    let of = |status: &str| lines.iter().find(|l| l["status"] == status).unwrap();
    assert_eq!(of("done")["view_layer"], "ViewLayer");
    assert_eq!((of("done")["width"].as_u64(), of("done")["height"].as_u64()), (Some(40), Some(24)));
    assert!(of("failed")["error"].as_str().unwrap().contains("is empty"));
}

#[test]
fn uses_the_render_and_not_what_blender_denoised() {
    use exr::prelude::*;
    let (dir, out) = out();
    let input = dir.path().join("in.exr");
    let channel = |pass: &str, c: &str, v: f32| {
        AnyChannel::new(format!("V.{pass}.{c}").as_str(), FlatSamples::F32(vec![v; 6]))
    };
    let both = ["R", "G", "B"]
        .into_iter()
        .flat_map(|c| [channel("Combined", c, 1.0), channel("Noisy Image", c, 3.0)]);
    let layer = Layer::new(
        (3, 2),
        LayerAttributes::default(),
        Encoding::SMALL_LOSSLESS,
        AnyChannels::sort(both.collect()),
    );
    Image::from_layer(layer).write().to_file(&input).unwrap();
    demc(&out).arg(&input).assert().success().stderr(contains("Noisy Image"));
    assert_eq!(values(&read_exr(out.join("in.exr")), "V.Denoised.G"), [3.0; 6]);
}

#[test]
fn says_when_lossy_channels_are_stored_as_zip() {
    use exr::prelude::*;
    let (dir, out) = out();
    let input = dir.path().join("dwaa.exr");
    let mut image = read_exr(data("blender4.exr"));
    image.layer_data[0].encoding.compression = Compression::DWAA(None);
    image.write().to_file(&input).unwrap();
    demc(&out).arg(&input).assert().success().stderr(contains("stored as ZIP instead of DWAA"));
    let (before, after) = (read_exr(&input), read_exr(out.join("dwaa.exr")));
    for channel in &before.layer_data[0].channel_data.list {
        let now = samples(&after, &channel.name.to_string()).unwrap();
        assert_eq!(bits(&channel.sample_data), bits(now), "{}", channel.name);
    }
}

/// A single part of 3x2 pixels with these channels.
fn write_channels(path: &Path, attributes: exr::prelude::LayerAttributes, channels: &[(&str, f32)]) {
    use exr::prelude::*;
    let list = channels.iter().map(|(name, value)| AnyChannel::new(*name, FlatSamples::F32(vec![*value; 6])));
    let layer = Layer::new((3, 2), attributes, Encoding::SMALL_LOSSLESS, AnyChannels::sort(list.collect()));
    Image::from_layer(layer).write().to_file(path).unwrap();
}

#[test]
fn an_aov_of_that_name_is_not_the_beauty() {
    let (dir, out) = out();
    let input = dir.path().join("in.exr");
    let channels =
        ["R", "G", "B"].map(|c| [(format!("V.Beauty.{c}"), 9.0), (format!("V.Combined.{c}"), 0.5)]).concat();
    let channels: Vec<(&str, f32)> = channels.iter().map(|(name, value)| (name.as_str(), *value)).collect();
    write_channels(&input, Default::default(), &channels);
    demc(&out).arg(&input).assert().success();
    assert_same_values(&out.join("in.exr"), "V.Combined.G", "V.Denoised.G");
}

#[test]
fn keeps_a_key_code_whole() {
    use exr::prelude::attribute::AttributeValue;
    let (dir, out) = out();
    let (input, output) = (dir.path().join("in.exr"), out.join("in.exr"));
    let bytes: Vec<u8> = (1..8i32).flat_map(i32::to_le_bytes).collect();
    let mut attributes = exr::prelude::LayerAttributes::default();
    let value = AttributeValue::Custom { kind: "keycode".into(), bytes: bytes.as_slice().into() };
    attributes.other.insert("keyC0de".into(), value); // the writer refuses the name itself
    write_channels(&input, attributes, &[("R", 0.1), ("G", 0.2), ("B", 0.3)]);
    let mut file = fs::read(&input).unwrap();
    let name = file.windows(7).position(|part| part == b"keyC0de").unwrap();
    file[name..][..7].copy_from_slice(b"keyCode");
    fs::write(&input, file).unwrap();
    demc(&out).arg(&input).assert().success();
    assert_kept(&input, &output);
    let stored = [&b"keyCode\0keycode\0\x1c\0\0\0"[..], &bytes].concat();
    assert!(fs::read(&output).unwrap().windows(stored.len()).any(|part| part == stored));
}

#[test]
fn alpha_in_another_part_stays_there() {
    use exr::prelude::*;
    let (dir, out) = out();
    let input = dir.path().join("in.exr");
    let part = |name: &str, channels: &[&str]| {
        let list = channels.iter().map(|c| AnyChannel::new(*c, FlatSamples::F32(vec![0.5; 12])));
        let channels = AnyChannels::sort(list.collect());
        Layer::new((4, 3), LayerAttributes::named(name), Encoding::SMALL_LOSSLESS, channels)
    };
    let parts = vec![part("beauty", &["R", "G", "B"]), part("rgba", &["R", "G", "B", "A"])];
    Image::from_layers(ImageAttributes::new(IntegerBounds::from_dimensions((4, 3))), parts)
        .write()
        .to_file(&input)
        .unwrap();
    demc(&out).arg(&input).arg("--replace").assert().success();
    let names = |path: &Path| -> Vec<Vec<String>> {
        let parts = read_exr(path).layer_data;
        parts.iter().map(|part| part.channel_data.list.iter().map(|c| c.name.to_string()).collect()).collect()
    };
    assert_eq!(names(&out.join("in.exr")), names(&input));
}

#[test]
fn channels_of_no_view_do_not_hide_the_eyes() {
    use exr::prelude::*;
    let (dir, out) = out();
    let input = dir.path().join("in.exr");
    let mut image = read_exr(data("blender4_stereo.exr"));
    let list = &mut image.layer_data[0].channel_data.list;
    let mut depth = list.iter().find(|c| c.name.to_string().ends_with(".left.R")).unwrap().clone();
    depth.name = "ViewLayer.Depth.Z".into();
    list.push(depth);
    image.layer_data[0].channel_data = AnyChannels::sort(list.clone());
    image.write().to_file(&input).unwrap();
    demc(&out).arg(&input).assert().success();
    assert_same_values(&out.join("in.exr"), "ViewLayer.Combined.left.R", "ViewLayer.Denoised.left.R");
}

/// Ctrl-C in the middle of a batch: the shell's exit status, whole files only, nothing temporary.
#[cfg(unix)]
#[test]
fn ctrl_c_stops_cleanly_and_the_next_run_goes_on() {
    use std::{
        io::{BufRead, BufReader},
        process::{Command, Stdio},
    };
    const FILES: usize = 400;
    let (dir, out) = out();
    for i in 0..FILES {
        fs::copy(data("blender5_stereo.exr"), dir.path().join(format!("f{i:04}.exr"))).unwrap();
    }
    let mut child = Command::new(assert_cmd::cargo::cargo_bin("demc"))
        .args(["denoise", "--model", "noisy", "--out"])
        .args([&out, dir.path()])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    lines.next().expect("a first result").unwrap();
    Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    let rest: Vec<String> = lines.map(std::result::Result::unwrap).collect();
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert!(rest.last().unwrap().contains("left: run the same command to go on"), "{rest:?}");

    let files: Vec<PathBuf> = fs::read_dir(&out).unwrap().map(|e| e.unwrap().path()).collect();
    assert!(!files.is_empty() && files.len() < FILES, "{} files", files.len());
    for file in &files {
        assert!(file.file_name().unwrap().to_str().unwrap().starts_with('f'), "{file:?}");
        assert_kept(&data("blender5_stereo.exr"), file);
    }
    demc(&out).arg(dir.path()).assert().success();
    assert_eq!(fs::read_dir(&out).unwrap().count(), FILES);
}
