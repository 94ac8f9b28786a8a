//! A file's layers, passes, missing passes and oddities, as data that prints and serialises.

use std::{collections::HashSet, path::Path};

use serde::Serialize;

use crate::{
    Result,
    frame::{Frame, SampleKind, Window},
    lint::{self, About, Finding, Trace},
    models::{
        Denoiser,
        catalogue::{self, Family, Kind, METHODS},
    },
    passes::{self, BLENDER, COMPOSITE, Layer, Mapping, Pass},
};

/// What `inspect` says about one file.
#[derive(Serialize)]
pub struct FileReport {
    pub path: String,
    pub bytes: u64,
    /// `multi-part` (Blender 5: one part per pass) or `single-part`.
    pub layout: &'static str,
    pub parts: Vec<PartReport>,
    pub layers: Vec<LayerReport>,
    /// The expected RelMSE of the results that it holds, where demc noted it, by layer (and stereo view).
    pub expected_errors: Vec<ExpectedError>,
    /// The layers that demc made, each with how it did so.
    pub results: Vec<Made>,
    /// What is wrong with the file, or with the shot that it belongs to.
    pub findings: Vec<Finding>,
    /// The trace of the first view layer with a beauty, for comparison with the frame that follows.
    #[serde(skip)]
    pub trace: Option<Trace>,
}

/// A layer that demc made, and how, in words of the command line.
#[derive(Serialize)]
pub struct Made {
    pub layer: String,
    pub method: String,
}

#[derive(Serialize)]
pub struct ExpectedError {
    pub layer: String,
    pub relmse: f64,
}

#[derive(Serialize)]
pub struct PartReport {
    pub name: Option<String>,
    pub width: usize,
    pub height: usize,
    pub compression: &'static str,
    pub tiles: Option<(usize, usize)>,
    /// Whether the part is deep, so that it is kept as it is and not decoded.
    pub deep: bool,
    pub bytes: usize,
    pub channels: usize,
}

#[derive(Serialize)]
pub struct LayerReport {
    pub name: String,
    pub view: Option<String>,
    /// The renderer whose names it has: Blender, where nothing tells.
    pub renderer: &'static str,
    /// The name of a motion pass that demc does not follow.
    pub motion: Option<String>,
    pub passes: Vec<PassReport>,
    /// Its light groups, which `--passes` denoises.
    pub light_groups: Vec<String>,
    /// Why the picture is not judged, and findings are of single values alone.
    pub unjudged: Option<String>,
    /// Channels that demc has no use for.
    pub unrecognised: Vec<String>,
    pub models: Vec<ModelReport>,
    /// What ruins a denoise of this view layer, see [`crate::lint`].
    pub findings: Vec<Finding>,
}

#[derive(Serialize)]
pub struct PassReport {
    pub pass: String,
    /// As the file names it.
    pub stored_as: String,
    /// `half`, `float` or `uint`.
    pub kind: String,
    pub compression: &'static str,
    /// Values that are NaN or infinite; not known where pixels cannot be decoded.
    pub non_finite: Option<usize>,
    pub all_zero: Option<bool>,
}

#[derive(Serialize)]
pub struct ModelReport {
    pub model: String,
    /// Whether it can denoise the layer, since it can do without the passes that are missing.
    pub works: bool,
    pub missing: Vec<Missing>,
}

#[derive(Serialize, Clone, PartialEq)]
pub struct Missing {
    pub pass: String,
    pub remedy: String,
}

/// A method, the passes it reads, and those of them that it can do without.
pub struct Needs {
    name: String,
    passes: Vec<Pass>,
    dispensable: Vec<Pass>,
}

/// The methods there are, with the passes they need: networks with weights, classical methods, peers.
pub fn methods() -> Vec<Needs> {
    let listed = METHODS.iter().filter(|method| method.family != Family::Noisy);
    let method = |method: &catalogue::Method| {
        let denoiser: Box<dyn Denoiser> = match method.kind {
            Kind::Fixed(make) => make(),
            // Its weights are not packed, since nothing is denoised here.
            _ => Box::new(method.learned().ok()?),
        };
        let (passes, dispensable) = (denoiser.passes().to_vec(), denoiser.dispensable().to_vec());
        Some(Needs { name: method.name.into(), passes, dispensable })
    };
    listed.filter_map(method).collect()
}

/// The model whose missing passes are a finding: the one that `demc denoise` uses unless told otherwise.
const DEFAULT_MODEL: &str = "demc-m";

/// Reads and decodes a whole file. It leaves a trace if it `is_compared` with another.
pub fn examine(path: &Path, methods: &[Needs], mapping: &Mapping, is_compared: bool) -> Result<FileReport> {
    let frame = Frame::read(path)?;
    let parts = frame.parts().iter().map(|p| PartReport {
        name: p.name.clone(),
        width: p.data_window.width,
        height: p.data_window.height,
        compression: p.compression,
        tiles: p.tiles,
        deep: p.deep,
        bytes: p.stored_bytes,
        channels: p.channels.len(),
    });
    let layers = passes::layers_by(&frame, mapping);
    let mut report = FileReport {
        path: path.display().to_string(),
        bytes: frame.byte_len(),
        layout: if frame.is_multi_part() { "multi-part" } else { "single-part" },
        parts: parts.collect(),
        layers: Vec::new(),
        expected_errors: frame
            .expected_errors()
            .into_iter()
            .map(|(layer, relmse)| ExpectedError { layer, relmse })
            .collect(),
        results: frame.methods().into_iter().map(|(layer, method)| Made { layer, method }).collect(),
        findings: windows(&frame),
        trace: None,
    };
    report.findings.extend(undecodable(&frame));
    let is_hidden = frame.parts().iter().any(|part| !part.deep && part.undecodable().is_some());
    if !is_hidden && !layers.iter().any(|l| l.passes.contains_key(&Pass::Combined)) {
        let message = "nothing to denoise: no Combined pass";
        report.findings.push(Finding::new("no-beauty", message, BLENDER.setting(Pass::Combined)));
    }
    for layer in &layers {
        let (layer, trace) = examine_layer(&frame, (layer, &layers), methods, is_compared)?;
        report.layers.push(layer);
        report.trace = report.trace.or(trace);
    }
    Ok(report)
}

fn windows(frame: &Frame) -> Vec<Finding> {
    let display = frame.display_window();
    let mut told = HashSet::new();
    let windows = frame.parts().iter().map(|p| p.data_window);
    let differing = windows.filter(|w| *w != display && told.insert(*w));
    let at = |w: Window| format!("{}x{} at {},{}", w.width, w.height, w.x, w.y);
    let warn = |w: Window| {
        let message = format!(
            "data window {} is not the display window {}: a cropped or overscanned render; what is stored is what is denoised",
            at(w),
            at(display)
        );
        Finding::harmless("data-window", message, "")
    };
    differing.map(warn).collect()
}

/// Findings on parts that are listed but cannot be denoised, each kind once.
fn undecodable(frame: &Frame) -> Vec<Finding> {
    let mut told = HashSet::new();
    let mut findings = Vec::new();
    for part in frame.parts() {
        let Some(why) = part.undecodable().filter(|why| part.deep || told.insert(why.clone())) else {
            continue;
        };
        let what = part.name.as_ref().map_or("the file".into(), |name| format!("part '{name}'"));
        let why = if part.deep { "is deep: it is kept as it is, and not denoised".into() } else { why };
        let message = format!("{what} {why}");
        let told = if part.deep { Finding::harmless } else { Finding::new };
        findings.push(told("undecodable", message, ""));
    }
    findings
}

fn examine_layer(
    frame: &Frame,
    (layer, all): (&Layer, &[Layer]),
    methods: &[Needs],
    is_compared: bool,
) -> Result<(LayerReport, Option<Trace>)> {
    let mut trace = None;
    let mut passes = Vec::new();
    let (mut findings, mut unjudged) = (Vec::new(), None);
    let part_of = |pass: &Pass| &frame.parts()[layer.passes[pass].part];
    let (decodable, others): (Vec<Pass>, Vec<Pass>) =
        layer.passes.keys().partition(|pass| part_of(pass).undecodable().is_none());
    let describe = |pass: Pass| {
        let (at, part) = (&layer.passes[&pass], part_of(&pass));
        PassReport {
            pass: pass.to_string(),
            stored_as: at.name.clone(),
            kind: part.channels[at.channels[0]].kind.to_string(),
            compression: part.compression,
            non_finite: None,
            all_zero: None,
        }
    };
    if !decodable.is_empty() {
        let set = passes::read_layer(frame, layer, &decodable)?;
        trace = (is_compared && set.get(Pass::Combined).is_some()).then(|| Trace::of(&set));
        for (pass, planes) in set.iter() {
            passes.push(PassReport {
                non_finite: Some(planes.non_finite()),
                all_zero: Some(planes.data.iter().all(|v| *v == 0.0)),
                ..describe(pass)
            });
        }
        findings = lint::frame(&set, &about(frame, (layer, all), methods));
        unjudged = lint::unjudged(&set).filter(|_| set.get(Pass::Combined).is_some());
    }
    passes.extend(others.into_iter().map(describe));
    let has_beauty = decodable.contains(&Pass::Combined);
    let models = methods.iter().filter(|_| has_beauty).map(|method| {
        let missing = method.passes.iter().filter(|pass| !layer.tells(**pass));
        let described = |p: &Pass| Missing { pass: p.to_string(), remedy: layer.renderer.setting(*p) };
        ModelReport {
            model: method.name.clone(),
            works: missing.clone().all(|pass| method.dispensable.contains(pass)),
            missing: missing.map(described).collect(),
        }
    });
    let report = LayerReport {
        name: layer.name.clone(),
        view: layer.view.clone(),
        renderer: layer.renderer.name,
        motion: layer.motion.clone(),
        models: models.collect(),
        passes,
        light_groups: layer.light_groups.keys().cloned().collect(),
        unjudged,
        unrecognised: layer.unrecognised.clone(),
        findings,
    };
    Ok((report, trace))
}

/// Compressions that lose something of half floats.
const LOSSY: [&str; 4] = ["b44", "b44a", "dwaa", "dwab"];

/// Whether a layer is the picture once more, beside the view layer that is denoised: what the compositor made of it, or
/// bare channels for programs that know no layers.
fn is_copy(frame: &Frame, layer: &Layer, all: &[Layer]) -> bool {
    let is_no_view_layer = layer.name.is_empty() || layer.name == COMPOSITE;
    is_no_view_layer && passes::choose(frame, all, None).is_ok_and(|chosen| chosen.name != layer.name)
}

/// What the file says of a view layer's passes.
fn about(frame: &Frame, (layer, all): (&Layer, &[Layer]), methods: &[Needs]) -> About {
    let is_half = |pass: &Pass| {
        let at = &layer.passes[pass];
        frame.parts()[at.part].channels[at.channels[0]].kind == SampleKind::Half
    };
    let model = methods.iter().find(|method| method.name == DEFAULT_MODEL);
    let is_denoised = layer.passes.contains_key(&Pass::Combined) && !is_copy(frame, layer, all);
    let needs = model.filter(|_| is_denoised);
    let needs = needs.map_or(&[][..], |model| &model.passes);
    About {
        half: layer.passes.keys().copied().filter(is_half).collect(),
        position_averaged: layer.position_averaged,
        denoised_by_demc: layer.passes.get(&Pass::Combined).is_some_and(|at| {
            let own = [at.name.clone(), format!("{}.{}", layer.name, at.name)];
            own.iter().any(|name| frame.is_own_layer(name))
        }),
        lossy: layer
            .passes
            .get(&Pass::Combined)
            .map(|at| frame.parts()[at.part].compression)
            .filter(|kind| LOSSY.contains(kind)),
        colour_space: ["colorInteropID", "oiio:ColorSpace"]
            .iter()
            .find_map(|name| frame.text_attribute(name)),
        missing: needs.iter().copied().filter(|pass| !layer.passes.contains_key(pass)).collect(),
        model: DEFAULT_MODEL.into(),
    }
}
