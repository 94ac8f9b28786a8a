//! Which view layers a frame holds, which passes each has and in which channels, and their decoding.

use std::collections::BTreeMap;

use super::{
    Pass, PassSet,
    names::{ChannelName, POSITION_AOV, TABLE, is_pass, light_group},
};
use crate::{
    Error, Result,
    frame::{Frame, Part, Window},
    planes::Planes,
};

/// One view layer of a frame, in one stereo view.
#[derive(Clone, Debug)]
pub struct Layer {
    /// Name of the view layer; empty in files without layers.
    pub name: String,
    /// Stereo view, where the file has views.
    pub view: Option<String>,
    /// The passes recognised.
    pub passes: BTreeMap<Pass, PassChannels>,
    /// The light groups, which add up to Combined, by name.
    pub light_groups: BTreeMap<String, PassChannels>,
    /// Whether the position is averaged over samples (a shader AOV) and not Cycles' aliased pass.
    pub position_averaged: bool,
    /// Names of channels that mean nothing to demc.
    pub unrecognised: Vec<String>,
}

/// Where a pass is stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PassChannels {
    /// Index of the part.
    pub part: usize,
    /// Channel indices within the part, in the order of the pass's components.
    pub channels: Vec<usize>,
    /// The renderer's name of the pass.
    pub name: String,
}

/// A channel still without meaning: where it is and its component name.
struct Unassigned {
    part: usize,
    channel: usize,
    component: String,
    full_name: String,
}

/// What Blender calls the layer that its compositor made.
const COMPOSITE: &str = "Composite";

/// A view layer's name and stereo view.
type LayerKey = (String, Option<String>);

/// The channels of each view layer and stereo view, in file order, by the names of their passes.
fn channels_by_pass(frame: &Frame) -> Vec<(LayerKey, BTreeMap<String, Vec<Unassigned>>)> {
    let views = frame.views();
    let mut found: Vec<(LayerKey, BTreeMap<String, Vec<Unassigned>>)> = Vec::new();
    for (p, part) in frame.parts().iter().enumerate() {
        // A single part's name is the name of the file's only image, unless it ends in that of a pass.
        let part_name = part.name.as_deref().filter(|name| frame.is_multi_part() || ends_in_pass(name));
        // Deep samples are no image.
        let flat = if part.deep { &[] } else { part.channels.as_slice() };
        for (c, channel) in flat.iter().enumerate() {
            let name = ChannelName::parse(&channel.name, part_name, part.view.as_deref(), &views);
            let key = (name.view_layer, name.view);
            let at = found.iter().position(|(k, _)| *k == key).unwrap_or_else(|| {
                found.push((key, BTreeMap::new()));
                found.len() - 1
            });
            let full_name = match part_name.filter(|_| !channel.name.contains('.')) {
                Some(part) => format!("{part}.{}", channel.name),
                None => channel.name.clone(),
            };
            found[at].1.entry(name.pass).or_default().push(Unassigned {
                part: p,
                channel: c,
                component: name.component,
                full_name,
            });
        }
    }
    found
}

/// Whether a part is called `<view layer>.<pass>`.
fn ends_in_pass(part: &str) -> bool {
    part.rsplit_once('.').is_some_and(|(_, tail)| is_pass(tail))
}

/// The view layers of a frame, in file order, once for each stereo view.
pub fn layers(frame: &Frame) -> Vec<Layer> {
    let found = channels_by_pass(frame).into_iter();
    found.map(|((name, view), channels)| assign(name, view, channels)).collect()
}

/// The view layers, of that name or of any, that hold R, G and B of a layer of any name, such as `Denoised` or
/// `ViewLayer.Denoised`: each with those as its Combined and nothing else, in file order, once for each stereo view.
pub fn rgb_layers(frame: &Frame, view_layer: Option<&str>, name: &str) -> Vec<Layer> {
    let found = channels_by_pass(frame).into_iter();
    let found = found.filter(|((layer, _), _)| view_layer.is_none_or(|wanted| wanted == layer));
    let as_combined = |((layer, view), channels): (LayerKey, BTreeMap<String, Vec<Unassigned>>)| {
        let name = name.strip_prefix(&format!("{layer}.")).unwrap_or(name);
        let at = match_components(channels.get(name)?, &["R", "G", "B"])?;
        let passes = [(Pass::Combined, PassChannels { name: name.into(), ..at })].into();
        let (position_averaged, light_groups, unrecognised) = Default::default();
        Some(Layer { name: layer, view, passes, light_groups, position_averaged, unrecognised })
    };
    found.filter_map(as_combined).collect()
}

fn assign(name: String, view: Option<String>, channels: BTreeMap<String, Vec<Unassigned>>) -> Layer {
    let mut passes = BTreeMap::new();
    let mut known = std::collections::HashSet::new();
    for row in TABLE {
        for pass_name in row.names {
            let Some(candidates) = channels.get(*pass_name) else { continue };
            let Some(found) = row.components.iter().find_map(|names| match_components(candidates, names))
            else {
                continue;
            };
            known.extend(found.channels.iter().map(|&c| (found.part, c)));
            // Every name of the row is recognised; the first one present is the one used.
            passes.entry(row.pass).or_insert(PassChannels { name: (*pass_name).into(), ..found });
        }
    }
    let mut light_groups = BTreeMap::new();
    for (pass_name, candidates) in &channels {
        let Some(group) = light_group(pass_name) else { continue };
        if let Some(found) = match_components(candidates, &["R", "G", "B"]) {
            known.extend(found.channels.iter().map(|&c| (found.part, c)));
            light_groups.insert(group.to_owned(), PassChannels { name: pass_name.clone(), ..found });
        }
    }
    // The fourth channel of an AOV or a noisy image is part of what was recognised.
    for (pass_name, list) in &channels {
        if passes.values().any(|p: &PassChannels| p.name == *pass_name) {
            known.extend(list.iter().filter(|c| c.component == "A").map(|c| (c.part, c.channel)));
        }
    }
    let mut unrecognised: Vec<(usize, usize, String)> = channels
        .into_values()
        .flatten()
        .filter(|c| !known.contains(&(c.part, c.channel)))
        .map(|c| (c.part, c.channel, c.full_name))
        .collect();
    unrecognised.sort();
    Layer {
        name,
        view,
        position_averaged: passes.get(&Pass::Position).is_some_and(|p| p.name == POSITION_AOV),
        passes,
        light_groups,
        unrecognised: unrecognised.into_iter().map(|(.., n)| n).collect(),
    }
}

/// The channels with these component names, all in the part of the first.
fn match_components(candidates: &[Unassigned], names: &[&str]) -> Option<PassChannels> {
    let part = candidates.iter().find(|c| c.component == names[0])?.part;
    let channels = names
        .iter()
        .map(|n| candidates.iter().find(|c| c.part == part && c.component == *n).map(|c| c.channel))
        .collect::<Option<Vec<_>>>()?;
    Some(PassChannels { part, channels, name: String::new() })
}

/// The view layer named, or without a name the one with the most recognised passes among those with
/// Combined (Blender's compositor adds a layer that holds nothing else), and the first among equals.
///
/// # Errors
/// There is no such view layer, or none with a Combined pass; the message lists those there are.
pub fn choose<'a>(frame: &Frame, layers: &'a [Layer], view_layer: Option<&str>) -> Result<&'a Layer> {
    match view_layer {
        Some(wanted) => layers.iter().find(|l| l.name == wanted).ok_or_else(|| {
            Error::invalid(frame.path(), format!("has no view layer '{wanted}'; {}", listed(layers)))
        }),
        None => layers
            .iter()
            .rev() // `max_by_key` keeps the last of equals
            .filter(|l| l.passes.contains_key(&Pass::Combined))
            .max_by_key(|l| (l.passes.len(), l.name != COMPOSITE))
            .ok_or_else(|| {
                // Luminance and chroma, which are no colour before they are put together.
                let mut subsampled =
                    frame.parts().iter().filter(|part| part.channels.iter().any(|c| c.subsampled));
                let why = subsampled.find_map(Part::undecodable).unwrap_or_else(|| {
                    let setting = Pass::Combined.blender_setting();
                    format!("no layer has a Combined pass; {}; {setting}", listed(layers))
                });
                Error::invalid(frame.path(), why)
            }),
    }
}

/// The view layer to hold against one of that name in another file: its namesake, or the only one with Combined besides the
/// compositor's. A file without view layers, whose name is empty, has nothing to choose by: see [`choose`].
///
/// # Errors
/// There is none; the message lists what there is.
pub fn choose_like<'a>(frame: &Frame, layers: &'a [Layer], name: &str) -> Result<&'a Layer> {
    if let Some(namesake) = layers.iter().find(|l| l.name == name) {
        return Ok(namesake);
    }
    let first = choose(frame, layers, None)?;
    let mut rendered =
        layers.iter().filter(|l| l.name != COMPOSITE && l.passes.contains_key(&Pass::Combined));
    if !name.is_empty() && rendered.any(|l| l.name != first.name) {
        let why = format!("has no view layer '{name}', which it is to be held against; {}", listed(layers));
        return Err(Error::invalid(frame.path(), format!("{why}; render or save that one alone")));
    }
    Ok(first)
}

/// The view layers of a file, as a sentence part.
fn listed(layers: &[Layer]) -> String {
    let mut names: Vec<String> = layers.iter().map(|l| format!("'{}'", l.name)).collect();
    names.dedup();
    match &names[..] {
        [name] if name == "''" => "it has no view layers: save as OpenEXR MultiLayer".into(),
        _ => format!("its view layers: {}", names.join(", ")),
    }
}

/// The passes of one view layer of a frame: see [`choose`].
///
/// # Errors
/// No such view layer, or its pixels cannot be decoded.
pub fn read(frame: &Frame, view_layer: Option<&str>) -> Result<PassSet> {
    let layers = layers(frame);
    read_layer(frame, choose(frame, &layers, view_layer)?, &Pass::ALL)
}

/// Those of the wanted passes that the layer has. Everything is cut to the data window of Combined;
/// what another part does not store there is 0.
///
/// # Errors
/// Pixels cannot be decoded.
pub fn read_layer(frame: &Frame, layer: &Layer, wanted: &[Pass]) -> Result<PassSet> {
    let held = || layer.passes.iter().filter(|(p, _)| wanted.contains(p));
    let anchor = layer.passes.get(&Pass::Combined).or_else(|| layer.passes.values().next());
    let Some(anchor) = anchor else {
        return Err(Error::invalid(
            frame.path(),
            format!("layer '{}' has no pass that demc knows; see `demc inspect`", layer.name),
        ));
    };
    let window = frame.parts()[anchor.part].data_window;
    let mut set = PassSet::new(frame.path(), &layer.name, window.width, window.height);
    set.origin = (window.x, window.y);
    // Blender's metadata; with adaptive sampling, the most samples that a pixel may have had.
    let samples = frame.text_attribute(&format!("cycles.{}.samples", layer.name));
    set.samples = samples.and_then(|count| count.trim().parse().ok());

    decode(frame, window, held().map(|(pass, at)| (*pass, at)), |pass, planes| set.insert(pass, planes))?;
    Ok(set)
}

/// The light groups of a view layer, cut as [`read_layer`] cuts its passes, each (3, H, W).
///
/// # Errors
/// Pixels cannot be decoded.
pub fn read_light_groups(frame: &Frame, layer: &Layer) -> Result<BTreeMap<String, Planes>> {
    let mut groups = BTreeMap::new();
    if let Some(anchor) = layer.passes.get(&Pass::Combined) {
        let window = frame.parts()[anchor.part].data_window;
        let held = layer.light_groups.iter().map(|(name, at)| (name.clone(), at));
        decode(frame, window, held, |name, planes| drop(groups.insert(name, planes)))?;
    }
    Ok(groups)
}

/// Decodes channels, cut to a window, and hands them out under their keys. One decoding run for each part: in single-part files
/// all passes share their blocks.
fn decode<'a, K>(
    frame: &Frame,
    window: Window,
    wanted: impl Iterator<Item = (K, &'a PassChannels)>,
    mut put: impl FnMut(K, Planes),
) -> Result<()> {
    let mut by_part: BTreeMap<usize, (Vec<K>, Vec<&[usize]>)> = BTreeMap::new();
    for (key, at) in wanted {
        let (keys, channels) = by_part.entry(at.part).or_default();
        keys.push(key);
        channels.push(&at.channels);
    }
    for (part, (keys, channels)) in by_part {
        let stored = frame.parts()[part].data_window;
        let images = frame.decode(part, &channels)?;
        for ((key, channels), image) in keys.into_iter().zip(channels).zip(images) {
            let image = crop(image, stored, window);
            put(key, Planes::from_vec(channels.len(), window.width, window.height, image));
        }
    }
    Ok(())
}

/// The values of `image`, (C, H, W) and stored in `from`, at the pixels of `to`.
fn crop(image: Vec<f32>, from: Window, to: Window) -> Vec<f32> {
    if from == to {
        return image;
    }
    let (stored, wanted) = (from.width * from.height, to.width * to.height);
    let mut out = vec![0.0; image.len() / stored * wanted];
    // Overlap in absolute coordinates, as i64: windows may lie anywhere in i32.
    let span = |a: i32, n: usize, b: i32, m: usize| {
        let start = i64::from(a).max(i64::from(b));
        let end = (i64::from(a) + n as i64).min(i64::from(b) + m as i64);
        (start, (end - start).max(0) as usize)
    };
    let (x, columns) = span(from.x, from.width, to.x, to.width);
    let (y, rows) = span(from.y, from.height, to.y, to.height);
    if columns == 0 {
        return out;
    }
    for (plane, out) in image.chunks(stored).zip(out.chunks_mut(wanted)) {
        for row in 0..rows as i64 {
            let source =
                (y + row - i64::from(from.y)) as usize * from.width + (x - i64::from(from.x)) as usize;
            let target = (y + row - i64::from(to.y)) as usize * to.width + (x - i64::from(to.x)) as usize;
            out[target..][..columns].copy_from_slice(&plane[source..][..columns]);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crop_moves_pixels_between_windows() {
        let from = Window { x: -1, y: 0, width: 3, height: 2 };
        let to = Window { x: 0, y: -1, width: 3, height: 2 };
        // Stored: y 0: [10 11 12] at x -1..2; wanted: y -1..1, x 0..3.
        let plane = vec![10.0, 11.0, 12.0, 20.0, 21.0, 22.0];
        assert_eq!(crop(plane.clone(), from, to), [0.0, 0.0, 0.0, 11.0, 12.0, 0.0]);
        let two = [plane.clone(), plane.iter().map(|v| v + 0.5).collect()].concat();
        let moved = [0.0, 0.0, 0.0, 11.0, 12.0, 0.0, 0.0, 0.0, 0.0, 11.5, 12.5, 0.0];
        assert_eq!(crop(two, from, to), moved);
        let away = Window { x: 100, y: 100, ..to };
        assert_eq!(crop(plane, from, away), [0.0; 6]);
    }
}
