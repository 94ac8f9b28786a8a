//! `demc models`: the methods there are, and what they cost.

use super::lines::ExitCode;
use crate::{
    Result,
    models::{
        self,
        catalogue::{IN_REPOSITORY, Kind, METHODS, Method, WEIGHTS_FOLDER, Weights},
        network::Network,
    },
};

/// List the built-in models and the networks that can be trained
#[derive(clap::Args)]
pub struct Args {
    /// Print one JSON array
    #[arg(long)]
    json: bool,
}

/// What the list says of weights that lie in a file which was not found.
const NOT_FOUND: &str = "not found";

/// One line of the list.
#[derive(serde::Serialize)]
struct Listed {
    model: String,
    /// "built in"; of the paper's networks and the rivals "file" where a file holds them, otherwise "not found";
    /// "untrained" of those that no file is known for.
    weights: &'static str,
    parameters: usize,
    kmac_per_pixel: f64,
    receptive_field: usize,
    passes: Vec<String>,
    trained: Option<String>,
}

fn row(method: &Method, network: &mut dyn Network, macs: f64, trained: Option<String>) -> Listed {
    Listed {
        model: method.name.into(),
        weights: match trained {
            None if matches!(method.kind, Kind::Learned { weights: Weights::File, .. }) => NOT_FOUND,
            None => "untrained",
            Some(_) if method.built_in().is_some() => "built in",
            Some(_) => "file",
        },
        parameters: network.params().iter().filter(|p| p.trainable).map(|p| p.values().len()).sum(),
        kmac_per_pixel: (macs / 100.0).round() / 10.0,
        // The side of the square of input pixels on which an output pixel depends.
        receptive_field: 2 * network.reach() + 1,
        passes: network.passes().iter().map(ToString::to_string).collect(),
        trained,
    }
}

fn trained(method: &Method) -> Result<Listed> {
    let mut model = method.learned()?;
    let t = &model.metadata.training;
    let last = if t.init.is_some() { ", the last of several runs (docs/training.md)" } else { "" };
    let hours = t.seconds / 3600.0;
    let trained =
        format!("{} steps of {} crops from {} frames in {hours:.1} h{last}", t.steps, t.batch, t.frames);
    let macs = model.macs_per_pixel();
    Ok(row(method, model.network(), macs, Some(trained)))
}

/// The list as a JSON array.
pub fn json() -> Result<String> {
    Ok(serde_json::to_string_pretty(&list()?).expect("rows serialise"))
}

fn list() -> Result<Vec<Listed>> {
    let with_weights = |method: &&Method| method.built_in().is_some() || method.weights_file().is_some();
    let untrained = METHODS.iter().filter(|method| !with_weights(method)).filter_map(|method| {
        let Kind::Learned { config, .. } = method.kind else { return None };
        let mut network = models::build(&config(), 0);
        let macs = network.macs_per_pixel();
        Some(Ok(row(method, &mut *network, macs, None)))
    });
    METHODS.iter().filter(with_weights).map(trained).chain(untrained).collect()
}

/// Runs the subcommand.
pub fn run(args: &Args) -> Result<ExitCode> {
    if args.json {
        super::lines::print_line(&json()?);
        return Ok(ExitCode::SUCCESS);
    }
    let rows = list()?;
    super::lines::print_line(&format!(
        "{:<14} {:<10} {:>12} {:>15} {:>16}  {}",
        "model", "weights", "parameters", "kMAC per pixel", "receptive field", "passes"
    ));
    for r in &rows {
        super::lines::print_line(&format!(
            "{:<14} {:<10} {:>12} {:>15.1} {:>16}  {}",
            r.model,
            r.weights,
            r.parameters,
            r.kmac_per_pixel,
            r.receptive_field,
            r.passes.join(", ")
        ));
    }
    for r in &rows {
        if let Some(trained) = &r.trained {
            super::lines::print_line(&format!("{}: trained for {trained}", r.model));
        }
    }
    if rows.iter().any(|r| r.weights == NOT_FOUND) {
        super::lines::print_line(&format!(
            "{NOT_FOUND}: run demc where {IN_REPOSITORY} lies, or name that folder by {WEIGHTS_FOLDER}=FOLDER"
        ));
    }
    Ok(ExitCode::SUCCESS)
}
