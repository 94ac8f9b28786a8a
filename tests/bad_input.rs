//! Whatever is thrown at `demc`: one line that names the file and the remedy, the right exit status,
//! nothing half written, never a panic.

mod common;

use std::{fs, path::Path, sync::OnceLock};

use assert_cmd::Command;
use common::files::{data, deep_file, write_render};
use demc::{frame::Frame, passes};
use proptest::prelude::*;
use tempfile::TempDir;

/// Runs `denoise` on a file and checks how it fails; returns the message.
#[track_caller]
fn fails(input: &Path, args: &[&str], code: i32) -> String {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let mut command = Command::cargo_bin("demc").unwrap();
    command.arg("denoise").arg(input).arg("--out").arg(&out);
    if !args.contains(&"--model") {
        command.args(["--model", "noisy"]);
    }
    let run = command.args(args).assert().code(code);
    let message = String::from_utf8(run.get_output().stderr.clone()).unwrap();
    assert_eq!(message.lines().count(), 1, "one line: {message}");
    let file = input.file_name().unwrap().to_str().unwrap();
    assert!(message.contains(file), "names {file}: {message}");
    let left = fs::read_dir(&out).map_or(0, Iterator::count);
    assert_eq!(left, 0, "nothing is written");
    message
}

#[track_caller]
fn fails_with(input: &Path, args: &[&str], code: i32, expected: &[&str]) {
    let message = fails(input, args, code);
    for part in expected {
        assert!(message.contains(part), "'{part}' in: {message}");
    }
}

#[test]
fn a_view_layer_without_a_beauty_is_told_by_name() {
    use exr::prelude::{AnyChannel, AnyChannels, FlatSamples, Image, WritableImage};

    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("nobeauty.exr");
    let list = ["V.Depth.Z", "V.Diffuse Direct.R", "W.Combined.R", "W.Combined.G", "W.Combined.B"]
        .map(|name| AnyChannel::new(name, FlatSamples::F32(vec![0.5; 64])));
    let channels = AnyChannels::sort(list.into_iter().collect());
    Image::from_channels((8, 8), channels).write().to_file(&path).unwrap();
    for more in [&[][..], &["--passes", "--replace", "--model", "demc-s"]] {
        let args = [&["--view-layer", "V"], more].concat();
        fails_with(&path, &args, 1, &["view layer 'V' has no Combined pass", "Passes > Data > Combined"]);
    }
}

fn file(bytes: &[u8]) -> (TempDir, std::path::PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("broken.exr");
    fs::write(&path, bytes).unwrap();
    (dir, path)
}

#[test]
fn an_empty_file() {
    let (_dir, path) = file(b"");
    fails_with(&path, &[], 1, &["is empty", "copy it again"]);
}

#[test]
fn random_bytes() {
    let bytes: Vec<u8> = (0..5000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let (_dir, path) = file(&bytes);
    fails_with(&path, &[], 1, &["is not an EXR file", "OpenEXR MultiLayer"]);
    let magic = [&[0x76, 0x2f, 0x31, 0x01], bytes.as_slice()].concat();
    let (_dir, path) = file(&magic);
    fails_with(&path, &[], 1, &["EXR"]);
}

#[test]
fn truncated_files() {
    for name in ["blender5.exr", "blender4.exr"] {
        let whole = fs::read(data(name)).unwrap();
        for keep in [5, 500, whole.len() / 2, whole.len() - 1] {
            let (_dir, path) = file(&whole[..keep]);
            fails_with(&path, &[], 1, &["copy it again"]);
        }
    }
}

#[test]
fn a_file_that_does_not_exist() {
    fails_with(Path::new("no/such/frame.exr"), &[], 1, &["frame.exr: cannot read"]);
}

#[test]
fn a_missing_pass() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("in.exr");
    write_render(&path, 8, 8, |_, _| 1.0);
    fails_with(&path, &["--model", "nfor"], 1, &["'ViewLayer' has no Denoising Albedo", "nfor"]);
    let settings = ["Data > Position", "Light > Diffuse > Color", "Light > Glossy > Color"];
    fails_with(&path, &["--model", "demc"], 1, &settings);

    let plain = dir.path().join("plain.exr");
    exr::prelude::write_rgb_file(&plain, 8, 8, |_, _| (0.5f32, 0.5f32, 0.5f32)).unwrap();
    fails_with(&plain, &["--model", "nfor"], 1, &["has no view layers", "save as OpenEXR MultiLayer"]);
    fails_with(&plain, &["--view-layer", "Foreground"], 1, &["no view layer 'Foreground'", "MultiLayer"]);
}

#[test]
fn no_beauty_at_all() {
    use exr::prelude::*;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("in.exr");
    let list = [AnyChannel::new("ViewLayer.Depth.Z", FlatSamples::F32(vec![1.0; 4]))];
    let channels = AnyChannels::sort(list.into_iter().collect());
    let layer = Layer::new((2, 2), LayerAttributes::default(), Encoding::SMALL_LOSSLESS, channels);
    Image::from_layer(layer).write().to_file(&path).unwrap();
    fails_with(&path, &[], 1, &["no layer has a Combined pass", "'ViewLayer'", "turn on"]);
}

#[test]
fn a_view_layer_that_is_not_there() {
    let path = data("blender4_two_layers.exr");
    fails_with(
        &path,
        &["--view-layer", "Foreground"],
        1,
        &["no view layer 'Foreground'", "'Second.Layer'", "'ViewLayer'"],
    );
}

#[test]
fn deep_data() {
    let (_dir, path) = file(&deep_file());
    fails_with(&path, &[], 1, &["deep data", "without deep output"]);
}

#[test]
fn an_output_that_cannot_be_written() {
    let dir = tempfile::tempdir().unwrap();
    let in_the_way = dir.path().join("file");
    fs::write(&in_the_way, "x").unwrap();
    for out in [in_the_way.clone(), in_the_way.join("below")] {
        let mut command = Command::cargo_bin("demc").unwrap();
        command.args(["denoise", "--model", "noisy"]).arg(data("blender4.exr")).arg("--out").arg(&out);
        let run = command.assert().code(1);
        let message = String::from_utf8(run.get_output().stderr.clone()).unwrap();
        assert!(message.contains("file") && message.contains("cannot create"), "{message}");
        assert_eq!(message.lines().count(), 1);
    }
    // A directory where the result should go.
    let out = dir.path().join("out");
    fs::create_dir_all(out.join("blender4.exr")).unwrap();
    let mut command = Command::cargo_bin("demc").unwrap();
    command.args(["denoise", "--model", "noisy", "--overwrite"]).arg(data("blender4.exr"));
    let run = command.arg("--out").arg(&out).assert().code(1);
    let message = String::from_utf8(run.get_output().stderr.clone()).unwrap();
    assert!(message.contains("blender4.exr: cannot write"), "{message}");
    assert_eq!(fs::read_dir(&out).unwrap().count(), 1, "no temporary file");
}

#[test]
fn a_glob_that_matches_nothing() {
    let dir = tempfile::tempdir().unwrap();
    fails_with(&dir.path().join("*.exr"), &[], 2, &["matches no file"]);
    fails_with(&dir.path().join("[.exr"), &[], 2, &["not a valid glob"]);
}

#[test]
fn a_directory_without_exr_files() {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("a.png"), "x").unwrap();
    fails_with(dir.path(), &[], 2, &["no EXR files"]);
}

#[test]
fn a_model_that_is_not_there() {
    let message = {
        let run = Command::cargo_bin("demc")
            .unwrap()
            .args(["denoise", "--model", "no-such-model", "--out", "unused"])
            .arg(data("blender4.exr"))
            .assert()
            .code(2);
        String::from_utf8(run.get_output().stderr.clone()).unwrap()
    };
    assert!(message.contains("no model 'no-such-model'") && message.contains("demc models"), "{message}");
    assert!(!Path::new("unused").exists());
}

/// A small real render in each layout.
fn originals() -> &'static [Vec<u8>] {
    static ORIGINALS: OnceLock<Vec<Vec<u8>>> = OnceLock::new();
    ORIGINALS
        .get_or_init(|| ["blender4.exr", "blender5.exr"].iter().map(|n| fs::read(data(n)).unwrap()).collect())
}

/// Reads bytes as a frame and decodes all that can be decoded.
fn consume(bytes: &[u8]) -> demc::Result<()> {
    let (_dir, path) = file(bytes);
    let frame = Frame::read(&path)?;
    for layer in passes::layers(&frame) {
        if !layer.passes.is_empty() {
            passes::read_layer(&frame, &layer, &passes::Pass::ALL)?.sanitize();
        }
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_truncation_is_mistaken_for_a_file(original in 0usize..2, keep in 0.0f64..1.0) {
        let bytes = &originals()[original];
        let keep = (keep * bytes.len() as f64) as usize;
        prop_assert!(consume(&bytes[..keep]).is_err());
    }

    #[test]
    fn changed_bytes_never_panic(
        original in 0usize..2,
        // Half of the changes hit the headers, where the structure is.
        changes in prop::collection::vec((0.0f64..1.0, any::<bool>(), any::<u8>()), 1..8),
    ) {
        let mut bytes = originals()[original].clone();
        for (at, header, value) in changes {
            let range = if header { 4000 } else { bytes.len() };
            bytes[(at * range as f64) as usize] = value;
        }
        let _ = consume(&bytes);
    }

    #[test]
    fn random_bytes_never_panic(tail in prop::collection::vec(any::<u8>(), 0..2000)) {
        let mut bytes = vec![0x76, 0x2f, 0x31, 0x01, 2, 0, 0, 0];
        bytes.extend(tail);
        prop_assert!(consume(&bytes).is_err());
    }
}

/// Weights are read from files alone, and of no more bytes than weights have.
#[test]
#[cfg(unix)]
fn weights_that_would_never_end_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let [pipe, device, hole] =
        ["pipe", "device", "hole"].map(|name| dir.path().join(format!("{name}.safetensors")));
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    std::os::unix::fs::symlink("/dev/zero", &device).unwrap();
    fs::File::create(&hole).unwrap().set_len(20 << 30).unwrap();
    for (path, why) in
        [(&pipe, "no file on a disk"), (&device, "no file on a disk"), (&hole, "larger than any weights")]
    {
        let name = path.file_name().unwrap().to_str().unwrap();
        let mut command = Command::cargo_bin("demc").unwrap();
        command.args(["denoise", "--model"]).arg(path).arg(data("s0000_room_0004spp.exr"));
        command.arg("--out").arg(dir.path().join("out")).timeout(std::time::Duration::from_secs(20));
        let run = command.assert().failure();
        let message = String::from_utf8(run.get_output().stderr.clone()).unwrap();
        assert!(
            message.contains(name) && message.contains(why) && message.contains("demc train"),
            "{message}"
        );
    }
}

/// Light too faint for the reciprocal of its exposure to be a number.
#[test]
fn frames_of_denormal_numbers_are_denoised() {
    let dir = tempfile::tempdir().unwrap();
    for (name, factor) in [("dim", 1e-38), ("dark", 1e-42), ("faint", 1e-44)] {
        let path = dir.path().join(format!("{name}.exr"));
        write_float(&path, |i| ((i * 31 % 97) as f32 * factor as f32) / 97.0);
        let mut command = Command::cargo_bin("demc").unwrap();
        command.args(["denoise", "--model", "demc-s"]).arg(&path).arg("--out").arg(dir.path().join("out"));
        command.assert().success();
    }
}

/// A float beauty of 40x30 pixels.
fn write_float(path: &Path, value: impl Fn(usize) -> f32) {
    use exr::prelude::*;
    let list = ["R", "G", "B"].map(|c| {
        let values = (0..40 * 30).map(&value).collect();
        AnyChannel::new(format!("ViewLayer.Combined.{c}").as_str(), FlatSamples::F32(values))
    });
    let channels = AnyChannels::sort(list.into_iter().collect());
    let layer = Layer::new((40, 30), LayerAttributes::default(), Encoding::SMALL_LOSSLESS, channels);
    Image::from_layer(layer).write().to_file(path).unwrap();
}
