//! The report of `demc inspect` as text for a terminal.

use std::fmt::Write;

use super::examine::{ExpectedError, FileReport, LayerReport, Made, ModelReport};
use crate::lint::Finding;

/// The whole report; the caller ends the last line.
pub fn text(report: &FileReport) -> String {
    let mut out = String::new();
    write_file(&mut out, report).expect("writing to a string cannot fail");
    out.truncate(out.trim_end().len());
    out
}

fn write_file(out: &mut String, report: &FileReport) -> std::fmt::Result {
    let (width, height) = report.parts.first().map_or((0, 0), |p| (p.width, p.height));
    let mut kinds: Vec<String> = report
        .parts
        .iter()
        .map(|p| match p.tiles {
            Some((w, h)) => format!("{} tiles {w}x{h}", p.compression),
            None => p.compression.into(),
        })
        .collect();
    kinds.sort();
    kinds.dedup();
    let parts = match report.parts.len() {
        1 => String::new(),
        n => format!(", {n} parts"),
    };
    writeln!(
        out,
        "{}\n  {width}x{height}, {}, {}{parts}, compression {}",
        report.path,
        size(report.bytes),
        report.layout,
        kinds.join(" and ")
    )?;
    for Made { layer, method } in &report.results {
        writeln!(out, "  '{layer}' was made with {method}")?;
    }
    for ExpectedError { layer, relmse } in &report.expected_errors {
        writeln!(out, "  '{layer}' has an expected RelMSE of {relmse:.2e}")?;
    }
    write_findings(out, "  ", &report.findings)?;
    report.layers.iter().try_for_each(|layer| write_layer(out, layer))
}

fn write_layer(out: &mut String, layer: &LayerReport) -> std::fmt::Result {
    let view = layer.view.as_ref().map(|v| format!(", view '{v}'")).unwrap_or_default();
    match layer.name.is_empty() {
        true => write!(out, "  without a view layer{view}")?,
        false => write!(out, "  view layer '{}'{view}", layer.name)?,
    }
    match layer.renderer {
        "Blender" => writeln!(out)?,
        other => writeln!(out, ", as {other} names passes")?,
    }
    for pass in &layer.passes {
        let alias = match pass.stored_as == pass.pass || pass.pass == "Alpha" {
            true => String::new(),
            false => format!("  stored as '{}'", pass.stored_as),
        };
        let zero = if pass.all_zero == Some(true) { "  all zero" } else { "" };
        writeln!(out, "    {:<22}{:<7}{}{alias}{zero}", pass.pass, pass.kind, pass.compression)?;
    }
    if !layer.light_groups.is_empty() {
        writeln!(out, "    light groups: {}", layer.light_groups.join(", "))?;
    }
    // Layers are listed, not channels: `ViewLayer.Mist`, not `ViewLayer.Mist.Z`.
    let mut others: Vec<&str> = layer
        .unrecognised
        .iter()
        .map(|c| c.rsplit_once('.').map_or(c.as_str(), |(layer, _)| layer))
        .collect();
    others.dedup();
    if !others.is_empty() {
        writeln!(out, "    kept, not read: {}", others.join(", "))?;
    }
    write_models(out, layer)?;
    if let Some(why) = &layer.unjudged {
        writeln!(out, "    {why}")?;
    }
    write_findings(out, "    ", &layer.findings)
}

/// Writes the models that are ready in one line, then what the others lack; models that lack the same share a
/// line.
fn write_models(out: &mut String, layer: &LayerReport) -> std::fmt::Result {
    let mut groups: Vec<(Vec<&str>, &ModelReport)> = Vec::new();
    for model in &layer.models {
        let alike = |(_, other): &&mut (Vec<&str>, &ModelReport)| {
            (other.works, &other.missing) == (model.works, &model.missing)
        };
        match groups.iter_mut().find(alike) {
            Some((names, _)) => names.push(&model.model),
            None => groups.push((vec![&model.model], model)),
        }
    }
    groups.sort_by_key(|(_, model)| (!model.works, model.missing.len()));
    for (names, model) in groups {
        let names = names.join(", ");
        match (model.works, model.missing.is_empty()) {
            (_, true) => writeln!(out, "    ready for {names}")?,
            (true, _) => writeln!(out, "    enough for {names}, which would do better with more:")?,
            (false, _) => writeln!(out, "    not ready for {names}:")?,
        }
        for m in &model.missing {
            writeln!(out, "      no {}: {}", m.pass, m.remedy)?;
        }
    }
    Ok(())
}

fn write_findings(out: &mut String, indent: &str, findings: &[Finding]) -> std::fmt::Result {
    findings.iter().try_for_each(|Finding { code, message, remedy, harms }| {
        let kind = if *harms { "warning" } else { "note" };
        let remedy = if remedy.is_empty() { String::new() } else { format!("; {remedy}") };
        writeln!(out, "{indent}{kind} ({code}): {message}{remedy}")
    })
}

fn size(bytes: u64) -> String {
    match bytes {
        0..1_000 => format!("{bytes} bytes"),
        1_000..1_000_000 => format!("{:.0} kB", bytes as f64 / 1e3),
        _ => format!("{:.1} MB", bytes as f64 / 1e6),
    }
}
