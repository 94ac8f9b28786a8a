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
    EvalOptions, NOISY,
    palette::colours,
    picture::{self, Picture},
    plural,
    provenance::Provenance,
    rows::{Row, write_file},
    summary::{MethodSummary, Statistics},
};
use crate::{Result, testset::Pair};

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
        let notes: BTreeSet<&str> =
            self.rows.iter().map(|row| row.note.as_str()).filter(|note| !note.is_empty()).collect();
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
                        "Over the renders that every method scored, the input itself aside. A ratio is the geometric mean, scene by \
                         scene, of the ratio to " b { (self.options.baseline) } ". Click a heading to sort."
                    }
                    (self.summary())
                    @if !notes.is_empty() {
                        ul.faint #notes { @for note in notes { li { (note) } } }
                    }
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
        let winner = |value: fn(&MethodSummary) -> Option<f64>, sign: f64| {
            let scored = self.overall().filter(|s| s.model != NOISY);
            let scored = scored.filter_map(|s| Some((s.model.as_str(), value(s)?)));
            let scored: Vec<(&str, f64)> = scored.collect();
            let best = *scored.iter().min_by(|a, b| (sign * a.1).total_cmp(&(sign * b.1)))?;
            // Of equals, none is the best.
            (scored.iter().filter(|other| other.1 == best.1).count() == 1).then_some(best)
        };
        let relmse = winner(|s| s.of("relmse").geomean, 1.0);
        let ssim = winner(|s| s.of("ssim").mean, -1.0);
        let fastest = winner(|s| s.of("ms_per_mpx").geomean, 1.0);
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
                    "denoising alone, without file traffic; all methods took turns{}, each run after one that warms up{}",
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
                "what denoising adds at its peak, in a process of its own; largest of all renders".into(),
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
        hint: "scored, of those that every method but the input scored",
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
