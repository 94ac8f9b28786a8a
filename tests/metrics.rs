//! Metrics against independent implementations: OpenImageIO's idiff and scikit-image, on real frames.

mod common;

use common::python;

#[test]
fn python_environment_has_the_pinned_tools() {
    let out = python::run(std::process::Command::new(python::python()).args([
        "-c",
        "import bpy, skimage, numpy; print(bpy.app.version_string, skimage.__version__, numpy.__version__)",
    ]));
    assert!(out.contains("5.0.1") && out.contains("0.26.0"), "{out}");
    assert!(python::program("idiff").is_file());
    assert!(python::environment().oidn_program("oidnDenoise").is_file());
}
