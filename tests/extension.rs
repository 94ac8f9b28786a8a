//! The Blender extension: built, installed from its archive, and used by buttons and handlers without a window.
//!
//! On bpy 5.0, and on the Python with bpy 4.5 that `DEMC_BPY45` names, where it is set.

mod common;

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use common::python;

fn extension() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("blender_extension")
}

#[test]
fn it_installs_denoises_and_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let script = |python: &Path, name: &str| {
        let mut command = Command::new(python);
        command.arg(extension().join(name));
        command
    };
    let own = python::python();
    // The wheel that is bundled for users is tried by python/build_wheel.sh; this one leads to the program under test.
    let mut thin = script(&own, "tests/thin_wheel.py");
    let wheel = python::run(thin.arg(env!("CARGO_BIN_EXE_demc")).arg(folder.path()));
    let archive = folder.path().join("demc.zip");
    python::run(script(&own, "build.py").arg(wheel.trim()).arg("--out").arg(&archive));
    for blender in python::blenders() {
        let output = script(&blender, "tests/test_extension.py").arg(&archive).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{}: {said}", blender.display());
        assert!(said.contains("Ran 8 tests"), "{said}");
    }
}
