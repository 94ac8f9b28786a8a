//! `stability.html`: the maps, what is out of bounds, and the worst scenes with pictures, on one page that
//! refers to no other file.

use maud::{PreEscaped, html};

use super::{StabilityOptions, content::Case};
use crate::{
    Result,
    frame::write_file,
    report::{Provenance, document, picture_of, sheet_name, sheet_text},
    testset::Pair,
};

/// Writes the page. The folder `worst` beside it holds a report of the worst scenes.
///
/// # Errors
/// A sheet cannot be read or the file not be written.
pub fn write(
    options: &StabilityOptions,
    maps: &[(&str, String)],
    cases: &[Case],
    worst: &[Pair],
    made: &Provenance,
) -> Result<()> {
    let out = &options.out;
    let judged = cases.iter().filter(|case| case.passes().is_some()).count();
    let failed: Vec<&Case> = cases.iter().filter(|case| case.passes() == Some(false)).collect();
    let mut pictures = Vec::new();
    for pair in worst {
        let sheet = out.join("worst/sheets").join(sheet_name(worst, pair));
        if sheet.is_file() {
            pictures.push((pair, picture_of(&sheet, worst.len(), &sheet_text(pair))?));
        }
    }
    let body = html! {
        p {
            (failed.len()) " of " (judged) " cases are out of bounds: worse than their input in RelMSE, or with light that is "
            "off by 2 % more than the input's."
        }
        @for (title, svg) in maps {
            h2 { (title) }
            figure { (PreEscaped(svg)) }
        }
        @if !failed.is_empty() {
            h2 { "Out of bounds" }
            div.scroll { table {
                thead { tr { @for name in ["scene", "samples", "method", "what"] { th.text { (name) } } } }
                tbody { @for case in failed {
                    tr {
                        td.text { (case.scene) } td { (case.spp) } td.text { (case.model) }
                        td.text { (case.faults.join("; ")) }
                    }
                } }
            } }
        }
        @if !pictures.is_empty() {
            h2 { "The worst" }
            p.faint { "Where our methods do worst beside the baseline; all scores in " code { "worst/report.html" } "." }
            @for (pair, picture) in &pictures {
                h3 { (pair.label()) ", " (pair.spp) " samples per pixel" }
                figure { (picture) }
            }
        }
        h2 { "How it was made" }
        dl {
            dt { "command" } dd { code { (made.command) } }
            @for (name, text) in made.facts() { dt { (name) } dd { (text) } }
            dt { "threads" } dd { (options.threads) }
        }
    };
    write_file(&out.join("stability.html"), document("demc stability", &body).into_string().as_bytes())
}
