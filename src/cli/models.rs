//! `demc models`: the methods there are, and what they cost.

use std::process::ExitCode;

use crate::{
    Result,
    models::{self, Denoiser, learned::Learned, network::Network},
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

fn row(model: &str, network: &mut dyn Network, trained: Option<String>) -> Row {
    Row {
        model: model.into(),
        weights: if trained.is_some() { "built in" } else { "untrained" },
        parameters: network.params().iter().filter(|p| p.trainable).map(|p| p.values().len()).sum(),
        kmac_per_pixel: (network.macs_per_pixel() / 100.0).round() / 10.0,
        // Rows and columns of the square that an output pixel can see.
        receptive_field: 2 * network.reach() + 1,
        passes: network.passes().iter().map(ToString::to_string).collect(),
        trained,
    }
}

/// Runs the subcommand.
pub fn run(args: &Args) -> Result<ExitCode> {
    let rows: Vec<Row> = models::trainable()
        .into_iter()
        .map(|(name, config)| match Learned::built_in(name) {
            Some(mut model) => {
                let t = &model.metadata.training;
                let trained = format!(
                    "{} steps of {} crops from {} frames in {:.1} h{}",
                    t.steps,
                    t.batch,
                    t.frames,
                    t.seconds / 3600.0,
                    if t.init.is_some() {
                        ", the last of several runs (eval/training/README.md)"
                    } else {
                        ""
                    }
                );
                debug_assert_eq!(model.name(), name);
                row(name, model.network(), Some(trained))
            }
            None => row(name, &mut *models::build(&config, 0), None),
        })
        .collect();
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
