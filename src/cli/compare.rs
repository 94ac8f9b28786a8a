//! `demc compare A B`: the metrics of one image against another, one `name value` a line.

use std::path::{Path, PathBuf};

use clap::Args as ClapArgs;

use super::lines::{ExitCode, print_line, warn_line};
use crate::{
    Error, Result,
    frame::Frame,
    metrics::{self, Scores},
    passes::{self, COMBINED, Layer, Pass, PassSet},
    planes::Planes,
    report::number,
};

/// Layer that `demc denoise` adds: where A holds one, it is what the user wants judged.
const DENOISED: &str = "Denoised";

/// Arguments of `demc compare`.
#[derive(Debug, ClapArgs)]
#[command(after_help = "\
Examples:
  demc compare clean/shot_0004spp.exr pairs/shot_ref.exr
  demc compare --layer Combined pairs/shot_0004spp.exr pairs/shot_ref.exr --json")]
pub struct Args {
    /// The image to judge
    #[arg(value_name = "A")]
    image: PathBuf,
    /// The reference
    #[arg(value_name = "B")]
    reference: PathBuf,
    /// View layer to compare [default: of A the one with the most passes, of B its namesake or only one]
    #[arg(long, value_name = "NAME")]
    view_layer: Option<String>,
    /// Layer of A to judge [default: Denoised where A has it, else Combined]
    #[arg(long, value_name = "NAME")]
    layer: Option<String>,
    /// Layer of B to judge it by
    #[arg(long, value_name = "NAME", default_value = COMBINED)]
    reference_layer: String,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

impl Args {
    /// Two files, and what is compared of them: view layer, layer and reference's layer.
    pub fn of(image: &Path, reference: &Path, layers: [Option<String>; 3]) -> Self {
        let [view_layer, layer, reference_layer] = layers;
        let reference_layer = reference_layer.unwrap_or_else(|| COMBINED.into());
        Self {
            image: image.into(),
            reference: reference.into(),
            view_layer,
            layer,
            reference_layer,
            json: false,
        }
    }
}

/// Prints the scores.
///
/// # Errors
/// A file is unusable, or the images cannot be compared.
pub fn run(args: &Args) -> Result<ExitCode> {
    let (scores, reference) = scores(args, &|note| warn_line(note))?;
    if args.json {
        let object: serde_json::Map<String, serde_json::Value> =
            scores.named().into_iter().map(|(name, value)| (name.into(), value.into())).collect();
        print_line(&serde_json::Value::from(object).to_string());
        return Ok(ExitCode::SUCCESS);
    }
    for (name, value) in scores.named() {
        match value {
            Some(value) => print_line(&format!("{name} {}", number(value))),
            None => warn_line(&format!("{name}: none, {}", metrics::why_undefined(&reference))),
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Coordinates of primaries that differ by no more than this are the same ones, rounded.
const SAME_PRIMARIES: f32 = 1e-3;

/// The scores, and the image that is the reference. `say` is told what was compared where that might surprise.
///
/// # Errors
/// As [`run`].
pub fn scores(args: &Args, say: &dyn Fn(&str)) -> Result<(Scores, Planes)> {
    let image = judged(args, say)?;
    let reference = reference(args, &image, say)?;
    if image.view_layer != reference.view_layer {
        let [a, b] = [&image.view_layer, &reference.view_layer];
        say(&format!("note: compares view layer '{a}' of A with '{b}' of B"));
    }
    let views = [&image, &reference]
        .map(|set| set.view.as_deref().map_or("the only view".into(), |view| format!("view '{view}'")));
    if image.view.is_some() || reference.view.is_some() {
        let [a, b] = views;
        say(&format!("note: compares {a} of A with {b} of B; other views are not looked at"));
    }
    let primaries = [&args.image, &args.reference].map(|path| Frame::read_headers(path).ok()?.primaries());
    if let [Some(a), Some(b)] = primaries
        && a.iter().zip(b).any(|(a, b)| (a - b).abs() > SAME_PRIMARIES)
    {
        say(
            "note: A and B tell of different primaries (chromaticities): their numbers mean different colours",
        );
    }
    image.check_same_pixels(&reference, "its reference")?;
    let [image, reference] =
        [image, reference].map(|mut set| set.remove(Pass::Combined).expect("it is there"));
    let scores = metrics::score(&image, &reference).map_err(|why| {
        let reference = args.reference.display();
        let remedy = "no metric is defined on them; render anew or denoise first";
        Error::invalid(&args.image, format!("cannot be compared with {reference}: {why}; {remedy}"))
    })?;
    Ok((scores, reference))
}

/// The image to judge, as the Combined of its view layer: the layer named, or by default `Denoised`, or else
/// Combined.
fn judged(args: &Args, say: &dyn Fn(&str)) -> Result<PassSet> {
    let (frame, view_layer) = (Frame::read(&args.image)?, args.view_layer.as_deref());
    let layer = match args.layer.as_deref() {
        None => {
            let denoised = held(&frame, view_layer, DENOISED, say);
            if denoised.is_some() {
                let path = args.image.display();
                say(&format!("{path}: its layer '{DENOISED}' is judged (or say --layer {COMBINED})"));
            }
            denoised
        }
        Some(COMBINED) => None,
        Some(name) => Some(named(&frame, view_layer, name, say)?),
    };
    let layer = match layer {
        Some(layer) => layer,
        None => passes::choose(&frame, &passes::layers(&frame), view_layer)?.clone(),
    };
    combined(&frame, &layer)
}

/// The reference, of the view layer and view that the image is of if there is one.
fn reference(args: &Args, image: &PassSet, say: &dyn Fn(&str)) -> Result<PassSet> {
    let frame = Frame::read(&args.reference)?;
    let layers = passes::layers(&frame);
    let layer = match args.reference_layer.as_str() {
        COMBINED => passes::choose_like(&frame, &layers, &image.view_layer, image.view.as_deref())?.clone(),
        name => {
            let namesake = layers.iter().any(|l| l.name == image.view_layer).then_some(&*image.view_layer);
            let found = named(&frame, namesake, name, say)?;
            let mut views = passes::rgb_layers(&frame, Some(found.name.as_str()), name).into_iter();
            views.find(|l| l.view == image.view).unwrap_or(found)
        }
    };
    combined(&frame, &layer)
}

/// Of the view layers that hold a layer of that name the one with the most passes, or else the first, with this layer
/// as its Combined. `say` is told which it is where there are several.
fn held(frame: &Frame, view_layer: Option<&str>, name: &str, say: &dyn Fn(&str)) -> Option<Layer> {
    let (found, layers) = (passes::rgb_layers(frame, view_layer, name), passes::layers(frame));
    let chosen = passes::choose(frame, &layers, view_layer).ok();
    let is_chosen = |layer: &&Layer| chosen.is_some_and(|chosen| chosen.name == layer.name);
    let layer = found.iter().find(is_chosen).or_else(|| found.first())?;
    if found.iter().any(|other| other.name != layer.name) {
        let (path, own) = (frame.path().display(), &layer.name);
        say(&format!("note: {path}: compares '{name}' of view layer '{own}'; others hold one too"));
    }
    Some(layer.clone())
}

/// As [`held`].
///
/// # Errors
/// None holds one.
fn named(frame: &Frame, view_layer: Option<&str>, name: &str, say: &dyn Fn(&str)) -> Result<Layer> {
    held(frame, view_layer, name, say).ok_or_else(|| {
        let why = format!("has no layer '{name}' with R, G and B; `demc inspect` lists those there are");
        Error::invalid(frame.path(), why)
    })
}

fn combined(frame: &Frame, layer: &Layer) -> Result<PassSet> {
    let set = passes::read_layer(frame, layer, &[Pass::Combined])?;
    set.require_all([Pass::Combined], "`demc compare`")?;
    Ok(set)
}
