//! `demc models`: the methods there are, and what they cost.

use crate::cli::ExitCode;
use crate::{
    Result,
    models::{
        self,
        learned::{BUILT_IN, Learned},
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

/// One line of the list.
#[derive(serde::Serialize)]
struct Row {
    model: String,
    /// "built in" or "untrained".
    weights: &'static str,
    parameters: usize,
    kmac_per_pixel: f64,
    receptive_field: usize,
    passes: Vec<String>,
    trained: Option<String>,
}

fn row(model: &str, network: &mut dyn Network, macs: f64, trained: Option<String>) -> Row {
    Row {
        model: model.into(),
        weights: if trained.is_some() { "built in" } else { "untrained" },
        parameters: network.params().iter().filter(|p| p.trainable).map(|p| p.values().len()).sum(),
        kmac_per_pixel: (macs / 100.0).round() / 10.0,
        // Rows and columns of the square that an output pixel can see.
        receptive_field: 2 * network.reach() + 1,
        passes: network.passes().iter().map(ToString::to_string).collect(),
        trained,
    }
}

fn built_in(name: &str) -> Option<Row> {
    let mut model = Learned::built_in(name)?;
    let t = &model.metadata.training;
    let last = if t.init.is_some() { ", the last of several runs (docs/training.md)" } else { "" };
    let hours = t.seconds / 3600.0;
    let trained =
        format!("{} steps of {} crops from {} frames in {hours:.1} h{last}", t.steps, t.batch, t.frames);
    let macs = model.macs_per_pixel();
    Some(row(name, model.network(), macs, Some(trained)))
}

/// Runs the subcommand.
pub fn run(args: &Args) -> Result<ExitCode> {
    let untrained = models::untrained().map(|(name, config)| {
        let mut network = models::build(&config, 0);
        let macs = network.macs_per_pixel();
        row(name, &mut *network, macs, None)
    });
    let rows: Vec<Row> =
        BUILT_IN.into_iter().filter_map(|(name, _)| built_in(name)).chain(untrained).collect();
    if args.json {
        super::print_line(&serde_json::to_string_pretty(&rows).expect("rows serialise"));
        return Ok(ExitCode::SUCCESS);
    }
    super::print_line(&format!(
        "{:<14} {:<10} {:>12} {:>15} {:>16}  {}",
        "model", "weights", "parameters", "kMAC per pixel", "receptive field", "passes"
    ));
    for r in &rows {
        super::print_line(&format!(
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
            super::print_line(&format!("{}: trained for {trained}", r.model));
        }
    }
    Ok(ExitCode::SUCCESS)
}
