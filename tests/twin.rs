//! The PyTorch twin of the built-in networks (eval/twin) against this crate: inputs, outputs, losses and
//! gradients on a frame of tests/data, and weights both ways; then a few steps of its training. Needs a
//! Python with torch: the one that `DEMC_TORCH_PYTHON` names, or `python3`. Where neither has torch the test
//! says so and checks nothing.

mod common;

use std::{
    ffi::OsString,
    path::{Path, PathBuf},
    process::Command,
};

use demc::{
    models::{
        self, catalogue,
        network::{Batch, Network, stack},
        pyramid, weights_file,
    },
    nn::{
        Stats,
        weights::{self, Storage, Tensor},
    },
    passes::PassSet,
    planes::Planes,
    shot,
    train::Loss,
};
use dfdx::{tensor::AsArray, tensor_ops::Backward};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn passes(name: &str) -> PassSet {
    shot::prepare(root().join("tests/data").join(name), None).unwrap().passes
}

/// A Python that can import torch; says so where there is none.
fn python() -> Option<OsString> {
    let named = std::env::var_os("DEMC_TORCH_PYTHON").unwrap_or_else(|| "python3".into());
    let found = Command::new(&named).args(["-c", "import torch, numpy"]).output();
    let is_able = found.is_ok_and(|output| output.status.success());
    if !is_able {
        eprintln!("no Python with torch (DEMC_TORCH_PYTHON, python3): the twin is not checked");
    }
    is_able.then_some(named)
}

/// The twin's script `name`, ready to run.
fn script(python: &OsString, name: &str) -> Command {
    let mut command = Command::new(python);
    command.arg(root().join("eval/twin").join(name));
    command
}

/// Its output; fails where it does.
fn run(command: &mut Command) -> String {
    let output = command.output().expect("Python runs");
    let [stdout, stderr] = [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text));
    assert!(output.status.success(), "{stdout}\n{stderr}");
    stdout.into_owned()
}

fn tensor(name: impl Into<String>, shape: &[usize], values: Vec<f32>) -> Tensor {
    Tensor { name: name.into(), shape: shape.into(), values }
}

/// What the crate makes of a frame: inputs, image, loss and gradients, for the twin to compare.
fn facts(network: &mut dyn Network, noisy: &PassSet, reference: &PassSet, loss: Loss) -> Vec<Tensor> {
    let image_of = |planes: &Planes| vec![1, planes.channels, planes.height, planes.width];
    let mut facts = Vec::new();
    for (kind, set) in [("noisy", noisy), ("reference", reference)] {
        let kept = set.iter().filter(|(pass, _)| network.passes().contains(pass));
        facts.extend(kept.map(|(pass, p)| tensor(format!("{kind}.{pass}"), &image_of(p), p.data.to_vec())));
    }
    let inputs = network.inputs(noisy).unwrap();
    for (i, planes) in inputs.planes.iter().enumerate() {
        facts.push(tensor(format!("input.{i}"), &image_of(planes), planes.data.to_vec()));
    }
    let (scale, batch): (f32, Batch) = (inputs.scale, stack(&[inputs]));
    facts.push(tensor("scale", &[1], vec![scale]));
    let target: Vec<f32> = network.target(reference).unwrap().data.iter().map(|v| v / scale).collect();
    let image = network.forward_taped(&batch, &mut Stats::Batch(Vec::new()));
    let &(n, c, h, w) = dfdx::shapes::HasShape::shape(&image);
    facts.push(tensor("image", &[n, c, h, w], image.as_vec()));
    let loss = loss.of(image, target, None, &[scale]);
    facts.push(tensor("loss", &[1], vec![loss.array()]));
    let gradients = loss.backward();
    for param in network.params().into_iter().filter(|param| param.trainable) {
        let gradient = gradients.get(&param.tensor).as_vec();
        facts.push(tensor(format!("gradient.{}", param.name), &param.shape, gradient));
    }
    facts
}

/// Lets the twin compare a network of some weights with what this crate makes of them.
fn compare(
    python: &OsString,
    folder: &Path,
    weights: &Path,
    noisy: &PassSet,
    reference: &PassSet,
    loss: Loss,
    leak: f32,
) {
    let (mut network, _) = weights_file::read(weights).unwrap();
    network.convolutions().into_iter().for_each(|conv| conv.set_leak(leak));
    let facts = facts(&mut *network, noisy, reference, loss);
    let file = folder.join("facts.safetensors");
    weights::write(&file, "{}", &facts, Storage::Full).unwrap();
    println!(
        "{}",
        run(script(python, "check.py").arg(weights).arg(&file).args([loss.to_string(), leak.to_string()]))
    );
}

fn built_in(folder: &Path, name: &str) -> PathBuf {
    let bytes = catalogue::METHODS.iter().find(|m| m.name == name).and_then(|m| m.built_in()).unwrap();
    let path = folder.join(format!("{name}.safetensors"));
    std::fs::write(&path, bytes).unwrap();
    path
}

#[test]
fn the_twin_computes_the_same_outputs_losses_and_gradients() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let (noisy, reference) = (passes("s0000_room_0004spp.exr"), passes("s0000_room_ref.exr"));
    for (loss, leak) in [(Loss::Ssim, 0.0), (Loss::Geomean, 0.1)] {
        compare(&python, folder.path(), &built_in(folder.path(), "demc-s"), &noisy, &reference, loss, leak);
    }
    // The prefilter of demc-m by itself; references here keep no guides, and another frame's serve as well.
    let mut prefilter = models::build(&pyramid::prefilter(), 1);
    let weights = built_in(folder.path(), "demc-m");
    weights_file::set_prefilter(&mut *prefilter, &std::fs::read(&weights).unwrap(), &weights).unwrap();
    let (_, metadata) = weights_file::read(&weights).unwrap();
    let path = folder.path().join("prefilter.safetensors");
    weights_file::write(&path, &mut *prefilter, &metadata.training).unwrap();
    compare(&python, folder.path(), &path, &noisy, &passes("s0010_outdoor_0004spp.exr"), Loss::Geomean, 0.0);
}

/// The script for a lent machine, with a Python that tells how it was called.
#[test]
#[cfg(unix)]
fn the_script_for_a_lent_machine_trains_both_and_wants_packs_to_validate_on() {
    use std::os::unix::fs::PermissionsExt;

    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("python3"), "#!/bin/sh\necho \"$@\"\n").unwrap();
    std::fs::set_permissions(at("python3"), std::fs::Permissions::from_mode(0o755)).unwrap();
    let path = format!("{}:{}", folder.path().display(), std::env::var("PATH").unwrap());
    let lent = || {
        let mut command = Command::new("bash");
        command.arg(root().join("eval/twin/lent_gpu.sh")).env("PATH", &path);
        command.env("PACKS", folder.path()).env("OUT", at("out")).output().unwrap()
    };
    std::fs::write(at("a.pack"), "").unwrap();
    let refused = lent();
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(refused.status.code() == Some(2) && said.contains("no val*.pack in"), "{said}");
    std::fs::write(at("val.pack"), "").unwrap();
    let done = lent();
    let said = String::from_utf8_lossy(&done.stdout);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let calls: Vec<&str> = said.lines().collect();
    assert_eq!(calls.len(), 2, "{said}");
    assert!(
        calls[0].contains("--model prefilter") && calls[1].contains("--model demc-m --prefilter"),
        "{said}"
    );
    let packs = format!("--data {} --val {}", at("a.pack").display(), at("val.pack").display());
    assert!(calls.iter().all(|call| call.contains(&packs) && call.contains("--leak 0.01")), "{said}");
}

/// Packing needs numpy alone.
#[test]
fn a_pack_that_cannot_be_made_is_told_and_leaves_nothing() {
    let python = common::python::python().into_os_string();
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let room = |kind: &str| root().join(format!("tests/data/s0000_room_{kind}.exr"));
    let manifest = |noisy: &Path, columns: &str| {
        let row = format!("room,{},{},4", noisy.display(), room("ref").display());
        std::fs::write(at("set.csv"), format!("{columns}\n{row}\n")).unwrap();
    };
    let pack = |more: &[&str]| {
        let mut command = script(&python, "pack.py");
        command.arg(at("set.csv")).arg("--out").arg(at("new/one.pack")).args(more).output().unwrap()
    };
    let refused = |more: &[&str], why: &str| {
        let output = pack(more);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success() && said.starts_with("pack.py: ") && said.contains(why), "{said}");
        assert_eq!(std::fs::read_dir(at("new")).map_or(0, Iterator::count), 0);
    };
    let columns = "scene,noisy,reference,spp";
    manifest(&room("0004spp"), columns);
    refused(&["--megabytes", "0.01"], "nothing was packed");
    manifest(&room("0004spp"), "scene,noisy,clean,spp");
    refused(&[], "no column 'reference'");
    let bytes = std::fs::read(room("0004spp")).unwrap();
    std::fs::write(at("cut.exr"), &bytes[..bytes.len() / 2]).unwrap();
    manifest(&at("cut.exr"), columns);
    refused(&[], "cut.exr: cut off");
    manifest(&room("0004spp"), columns);
    assert!(pack(&[]).status.success());
    assert!(at("new/one.pack").is_file());
}

#[test]
fn the_twin_trains_on_packed_pairs_and_this_crate_reads_its_weights() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let pair = |scene: &str| {
        let of = |kind: &str| root().join(format!("tests/data/{scene}_{kind}.exr")).display().to_string();
        format!("{scene},{},{},4", of("0004spp"), of("ref"))
    };
    let pack = |scenes: &[&str], name: &str| {
        let rows: Vec<String> = scenes.iter().map(|scene| pair(scene)).collect();
        std::fs::write(at("manifest.csv"), format!("scene,noisy,reference,spp\n{}", rows.join("\n")))
            .unwrap();
        run(script(&python, "pack.py").arg(at("manifest.csv")).arg("--out").arg(at(name)))
    };
    let packed = pack(&["s0000_room", "s0010_outdoor"], "two.pack");
    assert!(packed.contains("views 0:2 of 2, 2 pairs"), "{packed}");
    pack(&["s0010_outdoor"], "val.pack");
    pack(&["s0000_room"], "room.pack");
    let command = |steps: &str, data: &str, more: &[&str]| {
        let mut command = script(&python, "train.py");
        command.args(["--model", "demc-s", "--patch", "64", "--batch", "2", "--steps", steps, "--f32"]);
        command.arg("--data").arg(at(data)).arg("--val").arg(at("val.pack")).args(more);
        command.arg("--prefilter").arg(built_in(folder.path(), "demc-s")).arg("--out").arg(at("run"));
        command
    };
    // What is validated on is never trained on.
    let refused = command("3", "two.pack", &[]).output().unwrap();
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(
        !refused.status.success() && said.contains("1 views of --val are among those of --data"),
        "{said}"
    );
    run(&mut command("3", "room.pack", &[]));
    let more = ["--resume", "--guide-dropout", "0.5", "--leak", "0.01"];
    run(&mut command("6", "room.pack", &more));
    // A run that is finished says nothing more of itself.
    run(&mut command("6", "room.pack", &more));
    let log = std::fs::read_to_string(at("run/log.csv")).unwrap();
    let steps: Vec<&str> = log.lines().skip(1).map(|row| row.split(',').next().unwrap()).collect();
    assert_eq!(steps, ["3", "6"]);
    let validation = log.lines().last().unwrap().split(',').nth(5).unwrap().parse::<f64>().unwrap();

    // The crate reads the weights, says the same of their training, and scores them alike.
    let (network, metadata) = weights_file::read(&at("run/last.safetensors")).unwrap();
    assert_eq!((metadata.training.steps, metadata.training.frames), (6, 1));
    assert_eq!((metadata.training.guide_dropout, metadata.training.leak), (0.5, 0.01));
    let reference = passes("s0010_outdoor_ref.exr");
    let image = network.infer(&passes("s0010_outdoor_0004spp.exr"), None).unwrap();
    let score = demc::metrics::error::relmse(&image, reference.get(demc::passes::Pass::Combined).unwrap());
    assert!((score - validation).abs() < 0.01 * score, "{score} here, {validation} there");
    // Crops lack albedo, normal, or both, as the crate has them: grey albedo, and the normal of nothing.
    let draws = "import random, sys; from data import Frames\n\
                 frames = Frames(sys.argv[1:], 'cpu', 32, False)\n\
                 crops = frames.draw(random.Random(1), 40, 32, 1.0)[0]\n\
                 print(sorted({(bool((c[3:6] == 0.5).all()), bool((c[6:] == 0).all())) for c in crops}))";
    let mut command = Command::new(&python);
    command.current_dir(root().join("eval/twin")).args(["-c", draws]).arg(at("two.pack"));
    assert_eq!(run(&mut command).trim(), "[(False, True), (True, False), (True, True)]");
    // A pack that was damaged on its way is refused.
    let mut bytes = std::fs::read(at("two.pack")).unwrap();
    let middle = bytes.len() / 3;
    bytes[middle] ^= 0x55;
    std::fs::write(at("two.pack"), bytes).unwrap();
    let mut command = script(&python, "train.py");
    command
        .args(["--steps", "1", "--model", "demc-s", "--data"])
        .arg(at("two.pack"))
        .arg("--out")
        .arg(at("no"));
    assert!(!command.output().unwrap().status.success());
}
