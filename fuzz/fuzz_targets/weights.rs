//! A weights file of any bytes.
#![no_main]

use std::path::Path;

use demc::models::weights_file;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let _ = weights_file::parse(bytes, Path::new("fuzzed.safetensors"));
});
