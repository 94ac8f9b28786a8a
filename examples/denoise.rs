//! Reads a render, denoises it, and writes it with the layer `Denoised`:
//!
//! ```text
//! cargo run --release --no-default-features --example denoise -- in.exr out.exr
//! ```

use std::path::Path;

use demc::{Error, Result, denoise, models};

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [input, output] = &arguments[..] else { return Err(Error::Usage("denoise IN.exr OUT.exr".into())) };
    let model = models::open("demc-m")?;
    let options = denoise::Options::default();
    let report = denoise::file(Path::new(input), Path::new(output), &*model, &options)?;
    println!("{output}: {}x{} pixels in {:.2} s", report.width, report.height, report.seconds);
    report.notes.iter().for_each(|note| println!("note: {note}"));
    Ok(())
}
