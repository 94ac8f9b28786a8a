//! A frame of any bytes: read, decoded, given a layer, written and read again.
#![no_main]

use demc::frame::{Frame, NewChannel, SampleKind};
use libfuzzer_sys::fuzz_target;

/// Larger frames take time and find nothing.
const MOST_PIXELS: usize = 1 << 16;

fuzz_target!(|bytes: &[u8]| {
    let folder = tempfile::tempdir().expect("a folder for temporary files");
    let (path, written) = (folder.path().join("in.exr"), folder.path().join("out.exr"));
    std::fs::write(&path, bytes).expect("a file");
    let Ok(mut frame) = Frame::read(&path) else { return };
    if frame.parts().iter().any(|part| part.data_window.width * part.data_window.height > MOST_PIXELS) {
        return;
    }
    for part in 0..frame.parts().len() {
        let channels: Vec<usize> = (0..frame.parts()[part].channels.len()).collect();
        let _ = frame.decode(part, &[&channels]);
    }
    let window = frame.parts()[0].data_window;
    let values = vec![0.5; window.width * window.height];
    let layer = ["R", "G", "B"].map(|component| NewChannel { component, kind: SampleKind::Half, values: &values });
    if frame.set_layer(0, "V.Denoised", None, &layer).is_ok() {
        frame.write(&written).expect("a frame with a layer more is written");
        Frame::read(&written).expect("what was written is read again");
    }
});
