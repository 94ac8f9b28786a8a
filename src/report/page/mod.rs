//! `report.html`: everything of a run on one page, which refers to no other file.
//!
//! In: rows, summaries, charts and sheets. Out: an HTML document with its style, script, charts (SVG)
//! and sheets (JPEG) inside; its policy forbids the browser to fetch anything. `maud` escapes all text, so
//! scenes and files may have any name.

mod table;

use std::{
    collections::{BTreeMap, BTreeSet},
    path::{Path, PathBuf},
};

use maud::{DOCTYPE, Markup, PreEscaped, html};
use rayon::prelude::*;
use table::{Better, Column, Line, ratio, score, share, table, whole};

use super::{
    EvalOptions,
    palette::colours,
    picture::{self, Picture},
    plural,
    provenance::Provenance,
    rows::Row,
    summary::{MethodSummary, Statistics},
};
use crate::{Result, frame::write_file, testset::Pair};

/// What the page shows.
pub struct Page<'a> {
    /// All rows.
    pub rows: &'a [Row],
    /// Their summaries.
    pub summaries: &'a [MethodSummary],
    /// Title and SVG of each chart.
    pub charts: &'a [(&'a str, String)],
    /// The pairs, each with its sheet where there is one.
    pub scenes: &'a [(&'a Pair, Option<PathBuf>)],
    /// What sequences look like over time, where there are any.
    pub sequences: Option<&'a Markup>,
    /// How many of the rows earlier runs measured.
    pub kept: usize,
    /// How it was run.
    pub options: &'a EvalOptions,
    /// What it was run with and on.
    pub provenance: &'a Provenance,
}

/// The content security policy: the browser fetches nothing, whatever the page holds.
const POLICY: &str =
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'";

/// A page whose title is also its first heading, with the style, script and policy that all pages share.
pub fn document(title: &str, body: &Markup) -> Markup {
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta http-equiv="Content-Security-Policy" content=(POLICY);
                link rel="icon" href="data:,";
                title { (title) }
                style { (PreEscaped(include_str!("page.css"))) }
            }
            body {
                h1 { (title) }
                (body)
                script { (PreEscaped(include_str!("page.js"))) }
            }
        }
    }
}

/// A picture, one of `count` of its kind, as part of a page; `what` it shows.
///
/// # Errors
/// The file cannot be read.
pub fn picture_of(sheet: &Path, count: usize, what: &str) -> Result<Markup> {
    let Picture { address, size: (width, height) } = picture::embed(sheet, count)?;
    Ok(html! {
        img src=(address) width=(width) height=(height)
            alt=(what);
    })
}

/// What a comparison sheet shows, in words.
pub fn sheet_text(pair: &Pair) -> String {
    format!("{}: every method, its error map and details", pair.label())
}

impl Page<'_> {
    /// Writes `report.html` into the output folder.
    ///
    /// # Errors
    /// A sheet cannot be read or the file not be written.
    pub fn write(&self) -> Result<()> {
        let count = self.scenes.iter().filter(|(_, sheet)| sheet.is_some()).count();
        let scenes = self.scenes.par_iter().enumerate().map(|(index, (pair, sheet))| {
            let picture =
                sheet.as_ref().map(|path| picture_of(path, count, &sheet_text(pair))).transpose()?;
            Ok(self.scene(index, pair, sheet.as_deref(), picture))
        });
        let scenes: Vec<Markup> = scenes.collect::<Result<_>>()?;
        let path = self.options.out.join("report.html");
        write_file(&path, self.document(&scenes).into_string().as_bytes())
    }

    fn document(&self, scenes: &[Markup]) -> Markup {
        let title = format!("demc eval: {}", self.counted());
        let p = self.provenance;
        let spp: BTreeSet<u32> = self.scenes.iter().map(|(pair, _)| pair.spp).collect();
        let body = html! {
                    p.faint {
                        (p.started) ", " (self.options.threads) " thread" (plural(self.options.threads)) ", " (p.cpu) ", demc "
                        (p.version)
                    }
                    (self.best())
                    (self.failures())
                    h2 #summary { "Summary" }
                    p.faint {
                        "Over the renders that every method scored, the input itself aside unless it is the baseline. A ratio is the \
                         geometric mean, scene by scene, of the ratio to " b { (self.options.baseline) } ". Click a heading to sort."
                    }
                    (self.summary())
                    (self.notes())
                    @for (title, svg) in self.charts {
                        h2 { (title) }
                        figure { (PreEscaped(svg)) }
                    }
                    @if let Some(sequences) = self.sequences { (sequences) }
                    h2 #scenes { "Scenes" }
                    nav {
                        @for (index, (pair, _)) in self.scenes.iter().enumerate() {
                            a href=(format!("#{}", anchor(index))) {
                                (pair.label())
                                @if spp.len() > 1 { " " (pair.spp) " spp" }
                            }
                        }
                    }
                    @for scene in scenes { (scene) }
                    (self.how())
        };
        document(&title, &body)
    }

    /// "10 renders, 6 methods".
    fn counted(&self) -> String {
        let methods = self.overall().count();
        let renders = self.scenes.len();
        format!("{renders} render{}, {methods} method{}", plural(renders), plural(methods))
    }

    /// Summaries over all sample counts.
    fn overall(&self) -> impl Iterator<Item = &MethodSummary> {
        self.summaries.iter().filter(|s| s.spp.is_none())
    }

    /// The best methods by RelMSE, SSIM and time, which the page names before any table.
    fn best(&self) -> Markup {
        let overall: Vec<&MethodSummary> = self.overall().collect();
        let relmse = winner(&overall, |s| s.of("relmse").geomean, 1.0);
        let ssim = winner(&overall, |s| s.of("ssim").mean, -1.0);
        let fastest = winner(&overall, |s| s.of("ms_per_mpx").geomean, 1.0);
        html! {
            ul.best {
                @if let Some((name, value)) = relmse {
                    li { span { "lowest RelMSE" } b { (name) } (score(value)) " (geometric mean)" }
                }
                @if let Some((name, value)) = ssim {
                    li { span { "highest SSIM" } b { (name) } (share(value)) " (mean)" }
                }
                @if let Some((name, value)) = fastest {
                    li { span { "fastest" } b { (name) } (whole(value)) " ms per megapixel" }
                }
            }
        }
    }

    /// What the rows note, each with the methods and the scenes that it is of.
    fn notes(&self) -> Markup {
        let mut notes: BTreeMap<&str, [BTreeSet<&str>; 2]> = BTreeMap::new();
        for row in self.rows.iter().filter(|row| !row.note.is_empty()) {
            let [methods, scenes] = notes.entry(&row.note).or_default();
            methods.insert(&row.model);
            scenes.insert(&row.scene);
        }
        html! {
            @if !notes.is_empty() {
                ul.faint #notes { @for (note, [methods, scenes]) in notes {
                    li { b { (listed(&methods)) ", " (listed(&scenes)) } ": " (note) }
                } }
            }
        }
    }

    fn failures(&self) -> Markup {
        let mut scenes: BTreeMap<(&str, &str), Vec<&str>> = BTreeMap::new();
        let failed = self.rows.iter().filter(|r| !r.reason.is_empty());
        let count = failed.clone().count();
        for row in failed {
            scenes.entry((&row.model, &row.reason)).or_default().push(&row.scene);
        }
        if count == 0 {
            return html! {};
        }
        html! {
            div.failed #failures {
                h3 { (count) " of " (self.rows.len()) " rows failed" }
                div.scroll { table {
                    thead { tr { @for name in ["method", "reason", "scenes"] { th.text { (name) } } } }
                    tbody { @for ((method, reason), scenes) in scenes {
                        tr { td { (method) } td.text { (reason) } td.text { (scenes.join(", ")) } }
                    } }
                } }
            }
        }
    }

    fn summary(&self) -> Markup {
        let mut counts: Vec<Option<u32>> = self.summaries.iter().map(|s| s.spp).collect();
        counts.dedup();
        html! {
            @for spp in counts {
                @let methods: Vec<&MethodSummary> = self.summaries.iter().filter(|s| s.spp == spp).collect();
                @let names: Vec<&str> = methods.iter().map(|s| s.model.as_str()).collect();
                @let lines: Vec<Line<MethodSummary>> = methods
                    .iter()
                    .zip(colours(&names))
                    .map(|(&item, colour)| Line { method: &item.model, colour, item })
                    .collect();
                @let caption = spp.map(|n| format!("{n} samples per pixel")).unwrap_or_default();
                (table(&SUMMARY, &lines, &caption))
            }
        }
    }

    fn scene(&self, index: usize, pair: &Pair, sheet: Option<&Path>, picture: Option<Markup>) -> Markup {
        let of_pair = |r: &&Row| r.noisy == pair.noisy && r.reference == pair.reference;
        let rows: Vec<&Row> = self.rows.iter().filter(of_pair).collect();
        let names: Vec<&str> = rows.iter().map(|r| r.model.as_str()).collect();
        let lines: Vec<Line<Row>> = rows
            .iter()
            .zip(colours(&names))
            .map(|(&item, colour)| Line { method: &item.model, colour, item })
            .collect();
        let size = rows.iter().find_map(|r| Some(format!("{}×{}", r.width?, r.height?)));
        let file = sheet.and_then(Path::file_name).map(|name| format!("sheets/{}", name.to_string_lossy()));
        html! {
            section id=(anchor(index)) {
                h3 {
                    (pair.label()) ", " (pair.spp) " samples per pixel"
                    @if let Some(size) = size { ", " (size) }
                }
                @if let Some(picture) = picture {
                    figure {
                        (picture)
                        @if let Some(file) = file {
                            figcaption.faint { "In full size beside this page: " code { (file) } }
                        }
                    }
                }
                (table(&SCENE, &lines, ""))
            }
        }
    }

    fn how(&self) -> Markup {
        let p = self.provenance;
        let facts = [
            ("threads", self.options.threads.to_string()),
            (
                "times",
                format!(
                    "denoising alone, without file traffic; all methods took turns{}, each run after one that warms up, but \
                     of methods that take seconds{}",
                    match self.options.repeats {
                        1 => String::new(),
                        repeats => format!(" {repeats} times, whose median counts"),
                    },
                    match self.kept {
                        0 => String::new(),
                        kept => format!(
                            "; {kept} of {} rows are of earlier runs, and times of different runs are not comparable",
                            self.rows.len()
                        ),
                    }
                ),
            ),
            (
                "memory",
                "what denoising adds at its peak, in a process of its own; measured once for each size of frame".into(),
            ),
            ("RelMSE", "mean of (x - r)² / (r² + 0.001) over pixels and channels of linear radiance".into()),
            ("trimmed RelMSE", "the same without the worst 0.1 % of pixels".into()),
            ("SMAPE", "mean of |x - r| / (|x| + |r| + 0.01)".into()),
            ("SSIM", "on the image exposed for display, Gaussian window of sigma 1.5".into()),
            (
                "flicker",
                "mean of (e(t) - W e(t-1))² / (r² + 0.001), e the error of a frame, W the way along its vectors, over \
                 pixels whose reference changes little"
                    .into(),
            ),
            ("FLIP", "HDR-FLIP (Andersson et al. 2021): 0 is no visible difference".into()),
        ];
        html! {
            h2 #how { "How it was made" }
            dl {
                dt { "command" } dd { code { (p.command) } }
                @for (name, text) in p.facts().iter().chain(&facts) { dt { (name) } dd { (text) } }
            }
        }
    }
}

/// The name and value of the method whose `sign * value` is lowest. The input takes part: where every method makes
/// frames worse, none of them is the best. Of equals there is no best, nor of one alone. A method that was scored on
/// fewer renders than others, as an input with NaN in it is, does not take part.
fn winner<'a>(
    methods: &[&'a MethodSummary],
    value: fn(&MethodSummary) -> Option<f64>,
    sign: f64,
) -> Option<(&'a str, f64)> {
    let most = methods.iter().map(|method| method.scenes).max()?;
    let all = methods.iter().filter(|method| method.scenes == most);
    let scored: Vec<(&str, f64)> =
        all.filter_map(|method| Some((method.model.as_str(), value(method)?))).collect();
    let best = *scored.iter().min_by(|a, b| (sign * a.1).total_cmp(&(sign * b.1)))?;
    let has_equal = scored.iter().filter(|other| other.1 == best.1).count() > 1;
    (scored.len() > 1 && !has_equal).then_some(best)
}

/// Names in a list, the first few of many.
fn listed(names: &BTreeSet<&str>) -> String {
    const MOST: usize = 8;
    let shown: Vec<&str> = names.iter().copied().take(MOST).collect();
    match names.len().saturating_sub(MOST) {
        0 => shown.join(", "),
        more => format!("{} and {more} more", shown.join(", ")),
    }
}

/// The anchor of a pair in the page, which is a number because pairs may share a name.
fn anchor(index: usize) -> String {
    format!("scene-{}", index + 1)
}

/// A column of the summary that shows one statistic of one metric.
macro_rules! statistic {
    ($heading:literal, $hint:literal, $better:ident, $show:ident, $metric:literal, $field:ident) => {
        Column {
            heading: $heading,
            hint: $hint,
            better: Better::$better,
            show: $show,
            value: |m: &MethodSummary| -> Option<f64> {
                let Statistics { $field: value, .. } = m.of($metric);
                value
            },
        }
    };
}

const SUMMARY: [Column<MethodSummary>; 14] = [
    statistic!("RelMSE", "geometric mean over scenes", Low, score, "relmse", geomean),
    statistic!("× baseline", "RelMSE against the baseline, scene by scene", Low, ratio, "relmse", ratio),
    statistic!("mean RelMSE", "arithmetic mean: the worst scene rules it", Low, score, "relmse", mean),
    statistic!(
        "trimmed",
        "RelMSE without the worst 0.1 % of pixels, geometric mean",
        Low,
        score,
        "relmse_trimmed",
        geomean
    ),
    statistic!("SMAPE", "mean", Low, share, "smape", mean),
    statistic!("SSIM", "mean", High, share, "ssim", mean),
    statistic!("FLIP", "mean", Low, share, "flip", mean),
    statistic!(
        "flicker",
        "change of the error from frame to frame, geometric mean",
        Low,
        score,
        "flicker",
        geomean
    ),
    statistic!("× flicker", "flicker against the baseline, frame by frame", Low, ratio, "flicker", ratio),
    statistic!("ms/Mpx", "milliseconds per megapixel, geometric mean", Low, whole, "ms_per_mpx", geomean),
    statistic!("× time", "time against the baseline, scene by scene", Low, ratio, "ms_per_mpx", ratio),
    Column {
        heading: "MiB",
        hint: "memory at the peak",
        better: Better::Low,
        show: whole,
        value: |m| m.peak_mib,
    },
    Column {
        heading: "renders",
        hint: "scored, of those that methods are compared on",
        better: Better::Neither,
        show: whole,
        value: |m| Some(m.scenes as f64),
    },
    Column {
        heading: "failed",
        hint: "renders without a score of this method",
        better: Better::Neither,
        show: whole,
        value: |m| Some(m.failed as f64),
    },
];

/// A column of a scene's table that shows one field of the row.
macro_rules! cell {
    ($heading:literal, $better:ident, $show:ident, $field:ident) => {
        Column {
            heading: $heading,
            hint: "",
            better: Better::$better,
            show: $show,
            value: |r: &Row| r.$field,
        }
    };
}

const SCENE: [Column<Row>; 11] = [
    cell!("RelMSE", Low, score, relmse),
    cell!("trimmed", Low, score, relmse_trimmed),
    cell!("SMAPE", Low, share, smape),
    cell!("SSIM", High, share, ssim),
    cell!("FLIP", Low, share, flip),
    cell!("flicker", Low, score, flicker),
    cell!("RMSE", Low, score, rmse),
    cell!("max error", Low, score, max_error),
    Column {
        heading: "ms",
        hint: "median",
        better: Better::Low,
        show: whole,
        value: |r| r.seconds.map(|s| s * 1e3),
    },
    cell!("ms/Mpx", Low, whole, ms_per_mpx),
    cell!("MiB", Low, whole, peak_mib),
];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::{NOISY, summary::summarise};

    #[test]
    fn no_method_is_the_best_that_is_worse_than_the_input_or_alone() {
        let best = |scores: &[(&str, f64)]| {
            let row = |&(model, relmse): &(&str, f64)| Row {
                model: model.into(),
                relmse: Some(relmse),
                ..Row::default()
            };
            let rows: Vec<Row> = scores.iter().map(row).collect();
            let names: Vec<String> = scores.iter().map(|(name, _)| (*name).into()).collect();
            let summaries = summarise(&rows, &names, NOISY);
            let all: Vec<&MethodSummary> = summaries.iter().collect();
            winner(&all, |s| s.of("relmse").geomean, 1.0).map(|(name, _)| name.to_owned())
        };
        assert_eq!(best(&[(NOISY, 0.1), ("m", 0.01), ("n", 0.02)]).as_deref(), Some("m"));
        assert_eq!(best(&[(NOISY, 1e-6), ("m", 0.01)]).as_deref(), Some(NOISY));
        assert_eq!(best(&[("m", 0.01)]), None);
        assert_eq!(best(&[(NOISY, 0.1), ("m", 0.01), ("n", 0.01)]), None);
    }

    #[test]
    fn what_was_scored_on_the_easy_renders_alone_is_not_the_best() {
        let row = |(model, scene, relmse): (&str, &str, Option<f64>)| Row {
            model: model.into(),
            noisy: scene.into(),
            relmse,
            ..Row::default()
        };
        let rows = [
            (NOISY, "easy", Some(1e-3)),
            (NOISY, "hard", None),
            ("m", "easy", Some(1e-3)),
            ("m", "hard", Some(0.1)),
            ("n", "easy", Some(2e-3)),
            ("n", "hard", Some(0.1)),
        ]
        .map(row);
        let summaries = summarise(&rows, &[NOISY, "m", "n"].map(String::from), "m");
        let all: Vec<&MethodSummary> = summaries.iter().collect();
        let best = winner(&all, |s| s.of("relmse").geomean, 1.0);
        assert_eq!(best.map(|(name, _)| name), Some("m"));
    }

    #[test]
    fn long_lists_are_cut() {
        let names: Vec<String> = (0..10).map(|n| n.to_string()).collect();
        let of = |count: usize| listed(&names[..count].iter().map(String::as_str).collect());
        assert_eq!((of(2), of(10)), ("0, 1".into(), "0, 1, 2, 3, 4, 5, 6, 7 and 2 more".into()));
    }
}
