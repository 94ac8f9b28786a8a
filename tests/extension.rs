//! The Blender extension: built, installed from its archive, and used by buttons and handlers, without a
//! window and in one.
//!
//! It runs on bpy 5.0, and on the Python with bpy 4.5 that `DEMC_BPY45` names, where it is set; and in a
//! window of the Blender that `DEMC_BLENDER` names.

mod common;

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use common::python;

fn extension() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("blender_extension")
}

fn script(python: &Path, name: &str) -> Command {
    let mut command = Command::new(python);
    command.arg(extension().join(name));
    command
}

/// The archive, made in `folder`.
fn archive(folder: &Path) -> PathBuf {
    let python = python::python();
    // The wheel that is bundled for users is tried by python/build_wheel.sh; this one leads to the program
    // under test.
    let mut thin = script(&python, "tests/thin_wheel.py");
    let wheel = python::run(thin.arg(env!("CARGO_BIN_EXE_demc")).arg(folder));
    let archive = folder.join("demc.zip");
    python::run(script(&python, "build.py").arg(wheel.trim()).arg("--out").arg(&archive));
    archive
}

#[test]
fn it_installs_denoises_and_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    for blender in python::blenders() {
        let output = script(&blender, "tests/test_extension.py").arg(&archive).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{}: {said}", blender.display());
        assert!(said.contains("Ran 37 tests"), "{said}");
    }
}

#[test]
fn it_is_used_with_mouse_and_keyboard_in_a_window() {
    let Some(blender) = std::env::var_os("DEMC_BLENDER") else {
        eprintln!("DEMC_BLENDER is not set: no window is tried (see tests/README.md)");
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let archive = archive(folder.path());
    let output =
        script(&python::python(), "tests/in_window.py").arg(&blender).arg(&archive).output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    let trouble = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{}: {said}{trouble}", blender.display());
    assert!(!said.contains("FAILED") && said.lines().count() > 20, "{said}");
}
