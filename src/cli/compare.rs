//! `demc compare A B`: the metrics of one image against another, one `name value` a line.

use std::{path::PathBuf, process::ExitCode};

use clap::Args as ClapArgs;

use crate::{
    Error, Result,
    frame::Frame,
    metrics::{self, Incomparable},
    passes::{self, Pass},
    planes::Planes,
    report::number,
};

/// Layer that `demc denoise` adds: where a file holds one, it is what the user wants judged.
const DENOISED: &str = "Denoised";

/// Arguments of `demc compare`.
#[derive(Debug, ClapArgs)]
pub struct Args {
    /// The image to judge
    #[arg(value_name = "A")]
    image: PathBuf,
    /// The reference
    #[arg(value_name = "B")]
    reference: PathBuf,
    /// View layer to compare [default: the one with the most passes]
    #[arg(long, value_name = "NAME")]
    view_layer: Option<String>,
    /// Layer of A to judge [default: Denoised where A has it, else Combined]
    #[arg(long, value_name = "NAME")]
    layer: Option<String>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Prints the scores.
///
/// # Errors
/// A file is unusable, or the images cannot be compared.
pub fn run(args: &Args) -> Result<ExitCode> {
    let image = radiance(&args.image, args.view_layer.as_deref(), args.layer.as_deref())?;
    let reference = radiance(&args.reference, args.view_layer.as_deref(), None)?;
    let scores = metrics::score(&image, &reference).map_err(|why| {
        let remedy = match why {
            Incomparable::Size { .. } => "render both at one size",
            Incomparable::NonFinite { .. } => "no metric is defined on them; render anew or denoise first",
        };
        let reference = args.reference.display();
        Error::invalid(&args.image, format!("cannot be compared with {reference}: {why}; {remedy}"))
    })?;
    if args.json {
        let object: serde_json::Map<String, serde_json::Value> =
            scores.named().into_iter().map(|(name, value)| (name.into(), value.into())).collect();
        println!("{}", serde_json::Value::from(object));
        return Ok(ExitCode::SUCCESS);
    }
    for (name, value) in scores.named() {
        match value {
            Some(value) => println!("{name} {}", number(value)),
            None => eprintln!("{name}: none, {}", metrics::why_undefined(&reference)),
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// RGB of the layer named, or by default of `Denoised`, or else of Combined.
fn radiance(path: &PathBuf, view_layer: Option<&str>, layer: Option<&str>) -> Result<Planes> {
    let frame = Frame::read(path)?;
    match layer {
        Some("Combined") => {}
        Some(name) => {
            return layer_rgb(&frame, view_layer, name)?.ok_or_else(|| {
                Error::invalid(
                    path,
                    format!("has no layer '{name}' with R, G and B; `demc inspect` lists those there are"),
                )
            });
        }
        None => {
            if let Some(planes) = layer_rgb(&frame, view_layer, DENOISED)? {
                eprintln!("{}: comparing its layer '{DENOISED}' (or say --layer Combined)", path.display());
                return Ok(planes);
            }
        }
    }
    let mut passes = passes::read(&frame, view_layer)?;
    passes.remove(Pass::Combined).ok_or_else(|| {
        Error::invalid(path, "has no Combined pass; `demc inspect` lists the passes there are")
    })
}

/// The first part whose channels `<...>.<layer>.R`, `.G` and `.B` are complete.
fn layer_rgb(frame: &Frame, view_layer: Option<&str>, layer: &str) -> Result<Option<Planes>> {
    let wanted = view_layer.map(|v| format!("{v}.{layer}"));
    for (p, part) in frame.parts().iter().enumerate() {
        // Blender 5 names the part and leaves the channels bare in some files.
        let find = |component: &str| {
            part.channels.iter().position(|c| {
                let prefix = match c.name.rsplit_once('.') {
                    Some((prefix, last)) if last == component => prefix,
                    None if c.name == component => part.name.as_deref().unwrap_or(""),
                    _ => return false,
                };
                match &wanted {
                    Some(wanted) => prefix == wanted,
                    None => prefix == layer || prefix.ends_with(&format!(".{layer}")),
                }
            })
        };
        let (Some(r), Some(g), Some(b)) = (find("R"), find("G"), find("B")) else { continue };
        let window = part.data_window;
        let data = frame.decode(p, &[&[r, g, b]])?.remove(0);
        return Ok(Some(Planes::from_vec(3, window.width, window.height, data)));
    }
    Ok(None)
}
