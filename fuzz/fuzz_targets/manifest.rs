//! A manifest of any bytes.
#![no_main]

use demc::testset;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let folder = tempfile::tempdir().expect("a folder for temporary files");
    let path = folder.path().join("manifest.csv");
    std::fs::write(&path, bytes).expect("a file");
    let _ = testset::read(&path.display().to_string());
});
