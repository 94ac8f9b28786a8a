//! Metrics against independent implementations on real frames: OpenImageIO's idiff and oiiotool,
//! scikit-image, NVIDIA's FLIP evaluator; and `demc compare`, which prints them.

mod common;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    process::Command,
};

use common::{demc, files::data, python};
use predicates::prelude::*;

const SCENES: [&str; 2] = ["s0000_room", "s0010_outdoor"];

fn pair(scene: &str) -> (PathBuf, PathBuf) {
    (data(&format!("{scene}_0004spp.exr")), data(&format!("{scene}_ref.exr")))
}

/// What `demc compare` prints.
fn compare(image: &Path, reference: &Path) -> BTreeMap<String, f64> {
    let output = demc().arg("compare").args([image, reference]).assert().success();
    let text = String::from_utf8(output.get_output().stdout.clone()).unwrap();
    let line = |line: &str| {
        let (name, value) = line.split_once(' ').unwrap();
        (name.to_string(), value.parse().unwrap())
    };
    text.lines().map(line).collect()
}

/// Cuts Combined's RGB out of a render, as idiff compares every channel it finds.
fn rgb_only(from: &Path, to: &Path) {
    let channels = ["R", "G", "B"].map(|c| format!("ViewLayer.Combined.{c}")).join(",");
    let python = python::program("oiiotool");
    python::run(
        Command::new(python)
            .arg(from)
            .args([
                "--subimage",
                "ViewLayer.Combined",
                "--ch",
                &channels,
                "--chnames",
                "R,G,B",
                "-d",
                "float",
            ])
            .arg("-o")
            .arg(to),
    );
}

/// RMS and maximum error as idiff prints them.
fn idiff(a: &Path, b: &Path) -> (String, String) {
    let output = python::run_program("idiff", [a, b]);
    let text = String::from_utf8(output.stdout).unwrap();
    let value = |name: &str| {
        let line =
            text.lines().find(|l| l.trim_start().starts_with(name)).unwrap_or_else(|| panic!("{text}"));
        line.split('=').nth(1).unwrap().split_whitespace().next().unwrap().to_string()
    };
    (value("RMS error"), value("Max error"))
}

/// Whether `value` is what a program printed as `printed`, to its last digit.
#[track_caller]
fn assert_printed(value: f64, printed: &str) {
    let digits = printed.trim_start_matches(['0', '.', '-']).replace('.', "").len();
    let expected: f64 = printed.parse().unwrap();
    let unit = 10f64.powi(expected.abs().log10().floor() as i32 + 1 - digits as i32);
    assert!((value - expected).abs() <= unit, "{value} against {printed}");
}

#[test]
fn rmse_and_maximum_agree_with_idiff() {
    let dir = tempfile::tempdir().unwrap();
    for scene in SCENES {
        let (noisy, reference) = pair(scene);
        let (a, b) = (dir.path().join("a.exr"), dir.path().join("b.exr"));
        rgb_only(&noisy, &a);
        rgb_only(&reference, &b);
        let (rms, max) = idiff(&a, &b);
        let scores = compare(&noisy, &reference);
        assert_printed(scores["rmse"], &rms);
        assert_printed(scores["max_error"], &max);
    }
}

#[test]
fn relmse_agrees_with_oiiotool_and_idiff() {
    let dir = tempfile::tempdir().unwrap();
    for scene in SCENES {
        let (noisy, reference) = pair(scene);
        let [a, b, weight, c, d] = ["a", "b", "w", "c", "d"].map(|n| dir.path().join(format!("{n}.exr")));
        rgb_only(&noisy, &a);
        rgb_only(&reference, &b);
        // sqrt(r^2 + 0.001), then both images divided by it.
        let oiiotool = || Command::new(python::program("oiiotool"));
        python::run(
            oiiotool().arg(&b).arg(&b).args(["--mul", "--addc", "0.001", "--powc", "0.5", "-o"]).arg(&weight),
        );
        python::run(oiiotool().arg(&a).arg(&weight).args(["--div", "-o"]).arg(&c));
        python::run(oiiotool().arg(&b).arg(&weight).args(["--div", "-o"]).arg(&d));
        let rms: f64 = idiff(&c, &d).0.parse().unwrap();
        let relmse = compare(&noisy, &reference)["relmse"];
        assert!((relmse / (rms * rms) - 1.0).abs() < 1e-4, "{scene}: {relmse} against {}", rms * rms);
    }
}

/// Exposure, SSIM, FLIP and the plain sums by scikit-image, flip-evaluator and numpy.
const ORACLE: &str = r#"
import sys
import numpy as np
import OpenImageIO as oiio
from skimage.metrics import structural_similarity
import flip_evaluator

def load(path):
    file = oiio.ImageInput.open(path)
    for part in range(100):
        file.seek_subimage(part, 0)
        names = list(file.spec().channelnames)
        if "ViewLayer.Combined.R" in names:
            pixels = file.read_image(part, 0, 0, len(names), oiio.FLOAT)
            return np.stack([pixels[..., names.index("ViewLayer.Combined." + c)] for c in "RGB"], -1)

x, r = load(sys.argv[1]), load(sys.argv[2])
x64, r64 = x.astype(np.float64), r.astype(np.float64)
luminance = r64 @ [0.2126, 0.7152, 0.0722]
exposure = 0.35 / np.minimum(luminance, np.percentile(luminance, 98)).mean()
shown = [np.clip(exposure * image, 0, 1) ** (1 / 2.2) for image in (x64, r64)]
print("exposure", exposure)
print("ssim", structural_similarity(*shown, gaussian_weights=True, sigma=1.5,
    use_sample_covariance=False, data_range=1, channel_axis=-1))
print("relmse", np.mean((x64 - r64) ** 2 / (r64 ** 2 + 0.001)))
errors = np.sort(((x64 - r64) ** 2 / (r64 ** 2 + 0.001)).mean(-1).ravel())
print("relmse_trimmed", errors[: errors.size - int(errors.size * 0.001)].mean())
print("smape", np.mean(np.abs(x64 - r64) / (np.abs(x64) + np.abs(r64) + 0.01)))
print("flip", flip_evaluator.evaluate(r.astype(np.float32), x.astype(np.float32), "HDR", applyMagma=False)[1])
"#;

#[test]
fn ssim_agrees_with_scikit_image_and_flip_with_its_authors_program() {
    for scene in SCENES {
        let (noisy, reference) = pair(scene);
        let oracle =
            python::run(Command::new(python::python()).args(["-c", ORACLE]).args([&noisy, &reference]));
        let scores = compare(&noisy, &reference);
        for line in oracle.lines() {
            let (name, expected) = line.split_once(' ').unwrap();
            let expected: f64 = expected.parse().unwrap();
            let tolerance = match name {
                "ssim" => 1e-4,
                "flip" => 5e-4,
                _ => 1e-5 * expected,
            };
            assert!(
                (scores[name] - expected).abs() <= tolerance,
                "{scene} {name}: {} against {expected}",
                scores[name]
            );
        }
        assert_eq!(oracle.lines().count(), 6, "{oracle}");
    }
}

#[test]
fn compare_of_an_image_with_itself_is_perfect() {
    let (_, reference) = pair(SCENES[1]);
    let scores = compare(&reference, &reference);
    for (name, expected) in
        [("relmse", 0.0), ("ssim", 1.0), ("rmse", 0.0), ("max_error", 0.0), ("smape", 0.0), ("flip", 0.0)]
    {
        assert_eq!(scores[name], expected, "{name}");
    }
}

#[test]
fn compare_prints_one_json_object_with_the_same_numbers() {
    let (noisy, reference) = pair(SCENES[0]);
    let output = demc().arg("compare").args([&noisy, &reference]).arg("--json").assert().success();
    let object: BTreeMap<String, f64> = serde_json::from_slice(&output.get_output().stdout).unwrap();
    let lines = compare(&noisy, &reference);
    assert_eq!(object.keys().collect::<Vec<_>>(), lines.keys().collect::<Vec<_>>());
    for (name, value) in lines {
        assert!((object[&name] / value - 1.0).abs() < 1e-6, "{name}");
    }
}

/// Writes an EXR with oiiotool.
fn make(path: &Path, args: &[&str]) {
    python::run(Command::new(python::program("oiiotool")).args(args).arg("-o").arg(path));
}

#[test]
fn compare_refuses_other_sizes_and_values_that_are_not_finite() {
    let dir = tempfile::tempdir().unwrap();
    let [small, large, bad] = ["small.exr", "large.exr", "bad.exr"].map(|n| dir.path().join(n));
    make(&small, &["--pattern", "constant:color=0.5,0.5,0.5", "16x16", "3", "-d", "float"]);
    make(&large, &["--pattern", "constant:color=0.5,0.5,0.5", "16x17", "3", "-d", "float"]);
    // oiiotool defines a division by zero as 0, so numpy writes the NaN.
    let write_nan = "import sys, numpy as np, OpenImageIO as o; a = np.full((16, 16, 3), 0.5, np.float32); \
                     a[3, 4] = [np.nan, np.inf, 1]; b = o.ImageOutput.create(sys.argv[1]); \
                     b.open(sys.argv[1], o.ImageSpec(16, 16, 3, o.FLOAT)); b.write_image(a); b.close()";
    python::run(Command::new(python::python()).args(["-c", write_nan]).arg(&bad));
    for (a, b, expected) in [
        (&small, &large, "large.exr 16x17 pixels at 0,0; render both at one size"),
        (&bad, &small, "2 in the image, 0 in the reference"),
        (&small, &bad, "0 in the image, 2 in the reference"),
    ] {
        let one_line = predicate::function(|text: &str| text.lines().count() == 1);
        demc().arg("compare").args([a, b]).assert().code(1).stdout("").stderr(
            predicate::str::contains(expected)
                .and(predicate::str::contains(a.to_str().unwrap()))
                .and(one_line),
        );
    }
}

#[test]
fn compare_leaves_out_what_is_undefined_and_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let [tiny, black, grey] = ["tiny.exr", "black.exr", "grey.exr"].map(|n| dir.path().join(n));
    make(&tiny, &["--pattern", "constant:color=0.5,0.5,0.5", "10x30", "3", "-d", "float"]);
    make(&black, &["--pattern", "constant:color=0,0,0", "16x16", "3", "-d", "float"]);
    make(&grey, &["--pattern", "constant:color=0.1,0.1,0.1", "16x16", "3", "-d", "float"]);
    demc()
        .arg("compare")
        .args([&tiny, &tiny])
        .assert()
        .success()
        .stdout(predicate::str::contains("relmse 0\n").and(predicate::str::contains("ssim").not()))
        .stderr(predicate::str::contains("11x11"));
    demc()
        .arg("compare")
        .args([&grey, &black])
        .assert()
        .success()
        .stdout(predicate::str::contains("relmse 10\n").and(predicate::str::contains("exposure").not()))
        .stderr(predicate::str::contains("the reference is black"));
}

#[test]
fn compare_fails_with_one_line_for_a_file_that_is_no_exr() {
    let (noisy, _) = pair(SCENES[0]);
    let dir = tempfile::tempdir().unwrap();
    let random = dir.path().join("random.exr");
    std::fs::write(&random, b"not an image at all").unwrap();
    for bad in [random, dir.path().join("missing.exr")] {
        demc()
            .arg("compare")
            .args([&noisy, &bad])
            .assert()
            .code(1)
            .stderr(predicate::str::contains(bad.to_str().unwrap()));
    }
    demc().args(["compare", "only-one.exr"]).assert().code(2);
}
