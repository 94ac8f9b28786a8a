//! A file's layers, passes, missing passes and oddities, as data that prints and serialises.

use std::{collections::HashSet, path::Path};

use serde::Serialize;

use super::grain::Grain;
use crate::{
    Result,
    frame::{Frame, Window},
    models::{
        Denoiser,
        catalogue::{self, Family, Kind, METHODS},
    },
    passes::{self, BLENDER, Layer, Mapping, POSITION_AOV, Pass},
    planes::Planes,
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
    pub warnings: Vec<String>,
    /// The noise of the first view layer that shows any.
    #[serde(skip)]
    pub grain: Option<Grain>,
}

#[derive(Serialize)]
pub struct PartReport {
    pub name: Option<String>,
    pub width: usize,
    pub height: usize,
    pub compression: &'static str,
    pub tiles: Option<(usize, usize)>,
    /// Kept as it is, and not decoded.
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
    /// Channels that demc has no use for.
    pub unrecognised: Vec<String>,
    pub models: Vec<ModelReport>,
    pub warnings: Vec<String>,
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
    pub missing: Vec<Missing>,
}

#[derive(Serialize, Clone)]
pub struct Missing {
    pub pass: String,
    pub remedy: String,
}

/// A method and the passes it needs.
pub struct Method {
    name: String,
    passes: Vec<Pass>,
}

/// The methods there are, with the passes they need: networks with weights, classical methods, peers.
pub fn methods() -> Vec<Method> {
    let listed = METHODS.iter().filter(|method| method.family != Family::Noisy);
    let passes = |method: &catalogue::Method| match method.kind {
        Kind::Fixed(make) => Some(make().passes().to_vec()),
        // Its weights are not packed, since nothing is denoised here.
        _ => Some(method.learned().ok()?.passes().to_vec()),
    };
    let method =
        |method: &catalogue::Method| Some(Method { name: method.name.into(), passes: passes(method)? });
    listed.filter_map(method).collect()
}

/// Reads and decodes a whole file. Its noise is described if it `is_compared` with that of another.
pub fn examine(path: &Path, methods: &[Method], mapping: &Mapping, is_compared: bool) -> Result<FileReport> {
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
    let layers = passes::layers(&frame, mapping);
    let mut report = FileReport {
        path: path.display().to_string(),
        bytes: frame.byte_len(),
        layout: if frame.is_multi_part() { "multi-part" } else { "single-part" },
        parts: parts.collect(),
        layers: Vec::new(),
        warnings: window_warnings(&frame),
        grain: None,
    };
    report.warnings.extend(undecodable_warnings(&frame));
    let is_hidden = frame.parts().iter().any(|part| !part.deep && part.undecodable().is_some());
    if !is_hidden && !layers.iter().any(|l| l.passes.contains_key(&Pass::Combined)) {
        report
            .warnings
            .push(format!("nothing to denoise: no Combined pass; {}", BLENDER.setting(Pass::Combined)));
    }
    for layer in &layers {
        let (layer, grain) = examine_layer(&frame, layer, methods, is_compared)?;
        report.layers.push(layer);
        report.grain = report.grain.or(grain);
    }
    Ok(report)
}

fn window_warnings(frame: &Frame) -> Vec<String> {
    let display = frame.display_window();
    let mut differing: Vec<Window> =
        frame.parts().iter().map(|p| p.data_window).filter(|w| *w != display).collect();
    differing.dedup();
    let at = |w: Window| format!("{}x{} at {},{}", w.width, w.height, w.x, w.y);
    let warn = |w: Window| {
        format!(
            "data window {} is not the display window {}: a cropped or overscanned render; what is stored \
             is what is denoised",
            at(w),
            at(display)
        )
    };
    differing.into_iter().map(warn).collect()
}

/// What is listed but cannot be denoised, each kind once.
fn undecodable_warnings(frame: &Frame) -> Vec<String> {
    let mut told = HashSet::new();
    let mut warnings = Vec::new();
    for part in frame.parts() {
        let Some(why) = part.undecodable().filter(|why| part.deep || told.insert(why.clone())) else {
            continue;
        };
        let what = part.name.as_ref().map_or("the file".into(), |name| format!("part '{name}'"));
        let why = if part.deep { "is deep: it is kept as it is, and not denoised".into() } else { why };
        warnings.push(format!("{what} {why}"));
    }
    warnings
}

fn examine_layer(
    frame: &Frame,
    layer: &Layer,
    methods: &[Method],
    is_compared: bool,
) -> Result<(LayerReport, Option<Grain>)> {
    let mut grain = None;
    let mut passes = Vec::new();
    let mut warnings = Vec::new();
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
        grain = is_compared.then(|| Grain::of(&set)).flatten();
        for (pass, planes) in set.iter() {
            let report = PassReport {
                non_finite: Some(planes.non_finite()),
                all_zero: Some(planes.data.iter().all(|v| *v == 0.0)),
                ..describe(pass)
            };
            warnings.extend(pass_warnings(pass, &report, planes));
            passes.push(report);
        }
    }
    passes.extend(others.into_iter().map(describe));
    if layer.renderer.is_blender() && layer.passes.contains_key(&Pass::Position) && !layer.position_averaged {
        warnings.push(format!(
            "Position is Cycles' own pass, one sample a pixel: aliased, and wrong under depth of field and \
             motion blur; a shader AOV named '{POSITION_AOV}' (blender_scripts/export_passes.py sets it up) \
             is averaged over samples"
        ));
    }
    if layer.passes.contains_key(&Pass::NoisyImage) {
        warnings.push(
            "Combined was already denoised by Blender; demc uses the Noisy Image pass instead (turn off \
             Render Properties > Sampling > Render > Denoise to save the time)"
                .into(),
        );
    }
    let has_beauty = decodable.contains(&Pass::Combined);
    let models = methods.iter().filter(|_| has_beauty).map(|m| ModelReport {
        model: m.name.clone(),
        missing: m
            .passes
            .iter()
            .filter(|p| !layer.passes.contains_key(p))
            .map(|p| Missing { pass: p.to_string(), remedy: layer.renderer.setting(*p) })
            .collect(),
    });
    let report = LayerReport {
        name: layer.name.clone(),
        view: layer.view.clone(),
        renderer: layer.renderer.name,
        motion: layer.motion.clone(),
        models: models.collect(),
        passes,
        unrecognised: layer.unrecognised.clone(),
        warnings,
    };
    Ok((report, grain))
}

fn pass_warnings(pass: Pass, report: &PassReport, planes: &Planes) -> Vec<String> {
    let mut warnings = Vec::new();
    if let Some(bad) = report.non_finite.filter(|bad| *bad > 0) {
        warnings.push(format!(
            "{pass}: {bad} of {} values are NaN or infinite; `demc denoise` works with values filled in from around them",
            planes.data.len()
        ));
    }
    // Other passes are rightly zero where a scene has no glass, no volume, no lamp in view.
    let never_zero = [
        Pass::Combined,
        Pass::Normal,
        Pass::Position,
        Pass::DenoisingNormal,
        Pass::DenoisingAlbedo,
        Pass::NoisyImage,
    ];
    if report.all_zero == Some(true) && never_zero.contains(&pass) {
        warnings.push(format!("{pass} is zero everywhere: an empty render, or a pass that was not written"));
    }
    let negative = planes.data.iter().filter(|v| **v < 0.0).count();
    if negative > 0 && matches!(pass, Pass::Combined | Pass::NoisyImage) {
        warnings
            .push(format!("{pass}: {negative} negative values, which no light makes; models read them as 0"));
    }
    warnings
}
