//! Frames against OpenEXR itself: files that OpenImageIO (and so the OpenEXR library) wrote gain a layer,
//! and OpenImageIO finds everything else as it was.

mod common;

use std::path::{Path, PathBuf};

use common::{files::data, python};
use demc::frame::{Frame, NewChannel, SampleKind};

/// Every compression that OpenImageIO writes, and whether writing again loses more.
const KINDS: [(&str, bool); 10] = [
    ("none", false),
    ("rle", false),
    ("zips", false),
    ("zip", false),
    ("piz", false),
    ("pxr24", false),
    ("b44", true),
    ("b44a", true),
    ("dwaa", true),
    ("dwab", true),
];

/// Compares each pair of files: parts, attributes, windows, types and pixels of all that the first has;
/// the layer added must hold 0.5.
const COMPARE: &str = r#"
import sys
import numpy as np
import OpenImageIO as oiio

# What follows from the channels and their compression, and the list of layers that were added.
DERIVED = {"openexr:chunkCount", "oiio:subimages", "compression", "openexr:dwaCompressionLevel", "demc"}

def attributes(spec):
    return {a.name: str(a.value) for a in spec.extra_attribs if a.name not in DERIVED}

def pixels(image, spec, channel):
    return image.get_pixels(oiio.FLOAT)[:, :, channel]

def compare(before, after):
    i = 0
    while True:
        a, b = oiio.ImageBuf(before, i, 0), oiio.ImageBuf(after, i, 0)
        if not a.initialized or i >= a.nsubimages:
            return
        s, t = a.spec(), b.spec()
        assert attributes(s) == attributes(t), (attributes(s), attributes(t))
        for field in "x y width height full_x full_y full_width full_height tile_width tile_height".split():
            assert getattr(s, field) == getattr(t, field), field
        for c, name in enumerate(s.channelnames):
            d = t.channelindex(name)
            assert d >= 0 and s.channelformat(c) == t.channelformat(d), name
            assert np.array_equal(pixels(a, s, c), pixels(b, t, d), equal_nan=True), name
        i += 1

def added(after):
    i = 0
    while True:
        b = oiio.ImageBuf(after, i, 0)
        c = b.spec().channelindex("ViewLayer.Denoised.R")
        if c >= 0:
            assert np.allclose(pixels(b, b.spec(), c), 0.5, atol=0.002)
            return
        i += 1
        assert i < b.nsubimages, "no layer added"

for before, after in zip(sys.argv[1::2], sys.argv[2::2]):
    try:
        compare(before, after)
        added(after)
    except AssertionError as e:
        sys.exit(f"{before}: {e}")
"#;

/// Converts a committed render.
fn convert(source: &Path, target: &Path, compression: &str, tiled: bool) {
    let mut command = std::process::Command::new(python::program("oiiotool"));
    command.arg(source).args(["-a", "--compression", compression]);
    if tiled {
        command.args(["--tile", "16", "16"]);
    }
    python::run(command.arg("-o").arg(target));
}

/// Adds the layer and writes; says whether the part had to be recoded.
fn add_layer(input: &Path, output: &Path) -> bool {
    let mut frame = Frame::read(input).unwrap_or_else(|e| panic!("{e}"));
    let window = frame.parts()[0].data_window;
    let values = vec![0.5; window.width * window.height];
    let new =
        ["R", "G", "B"].map(|component| NewChannel { component, kind: SampleKind::Half, values: &values });
    let recoded = frame.set_layer(0, "ViewLayer.Denoised", None, &new).unwrap_or_else(|e| panic!("{e}"));
    frame.write(output).unwrap();
    recoded.is_some()
}

#[test]
fn openimageio_finds_everything_kept_in_files_of_every_compression() {
    let dir = tempfile::tempdir().unwrap();
    let mut pairs: Vec<PathBuf> = Vec::new();
    for source in ["blender4.exr", "blender5.exr"] {
        for (kind, lossy) in KINDS {
            for tiled in [false, true] {
                let input = dir.path().join(format!("{kind}_{tiled}_{source}"));
                let output = dir.path().join(format!("out_{kind}_{tiled}_{source}"));
                convert(&data(source), &input, kind, tiled);
                let recoded = add_layer(&input, &output);
                assert_eq!(recoded, lossy && source == "blender4.exr", "{kind} {source}");
                pairs.extend([input, output]);
            }
        }
    }
    python::run(std::process::Command::new(python::python()).args(["-c", COMPARE]).args(&pairs));
}
