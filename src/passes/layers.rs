//! Which view layers a frame holds, which passes each has and in which channels, and their decoding.

use std::collections::{BTreeMap, HashMap, HashSet};

use super::{
    Mapping, Pass, PassSet,
    channels::{ByPass, LayerKey, Place, by_pass, is_component},
    names::{
        BARE_DEPTH, BLENDER, COMBINED, POSITION_AOV, RENDERERS, Renderer, components, is_alike, is_bare,
        is_common, light_group, plain,
    },
};
use crate::{
    Error, Result,
    frame::{Frame, Part, Window, to_rgb},
    frame_number::samples,
    kernels::memory::PlaneBuffer,
    planes::Planes,
};

/// One view layer of a frame, in one stereo view.
#[derive(Clone, Debug)]
pub struct Layer {
    /// Name of the view layer; empty in files without layers.
    pub name: String,
    /// Stereo view, where the file has views.
    pub view: Option<String>,
    /// The renderer whose names it has: Blender, where nothing tells.
    pub renderer: &'static Renderer,
    /// The passes recognised.
    pub passes: BTreeMap<Pass, PassChannels>,
    /// The light groups, which add up to Combined, by name.
    pub light_groups: BTreeMap<String, PassChannels>,
    /// The name of a motion pass of another renderer than Blender, which demc does not follow.
    pub motion: Option<String>,
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

/// What Blender calls the layer that its compositor made.
pub const COMPOSITE: &str = "Composite";

/// The view layers of a frame, in file order, once for each stereo view.
pub fn layers(frame: &Frame) -> Vec<Layer> {
    layers_by(frame, &Mapping::default())
}

/// As [`layers`], with a mapping that names the passes whose names are the user's own.
pub fn layers_by(frame: &Frame, mapping: &Mapping) -> Vec<Layer> {
    let found = by_pass(frame).into_iter();
    found.map(|(key, channels)| assign_by_part(key, &channels, mapping)).collect()
}

/// As [`assign`]. Where several parts hold layers of the same names, those in the beauty's part belong to it.
fn assign_by_part(key: LayerKey, channels: &ByPass, mapping: &Mapping) -> Layer {
    let layer = assign(key.clone(), channels, mapping, None);
    let is_twice = |places: &Vec<Place>| {
        places.iter().any(|place| place.full_name == places[0].full_name && place.part != places[0].part)
    };
    match layer.passes.get(&Pass::Combined) {
        Some(beauty) if channels.values().any(is_twice) => assign(key, channels, mapping, Some(beauty.part)),
        _ => layer,
    }
}

/// The view layers that hold R, G and B of a layer `name`, which may be any, such as `Denoised` or
/// `ViewLayer.Denoised`. Each has these as its Combined and nothing else. They come in file order, once for
/// each stereo view; with `view_layer`, only those of that view layer.
pub fn rgb_layers(frame: &Frame, view_layer: Option<&str>, name: &str) -> Vec<Layer> {
    let found = by_pass(frame).into_iter();
    let found = found.filter(|((layer, _), _)| view_layer.is_none_or(|wanted| wanted == layer));
    let as_combined = |((layer, view), channels): (LayerKey, ByPass)| {
        let name = within(&layer, name);
        let at = find_components(name, channels.get(name)?, Pass::Combined, None)?;
        Some(Layer { passes: [(Pass::Combined, at)].into(), ..Layer::empty(layer, view) })
    };
    found.filter_map(as_combined).collect()
}

/// The layers that are the pass `pass` in a file of its own: those with a name of that pass, or else the
/// pictures that the file holds without a name.
pub fn layers_of(frame: &Frame, pass: Pass) -> Vec<Layer> {
    let named: Vec<Layer> =
        layers(frame).into_iter().filter(|layer| layer.passes.contains_key(&pass)).collect();
    if !named.is_empty() {
        return named;
    }
    let picture = |((name, view), channels): (LayerKey, ByPass)| {
        let index = Index::of(&channels, None);
        let at = BLENDER.names(Pass::Combined).find_map(|name| index.find(name, pass))?;
        Some(Layer { passes: [(pass, at)].into(), ..Layer::empty(name, view) })
    };
    by_pass(frame).into_iter().filter_map(picture).collect()
}

/// Finds out which channels are which passes, in `part` rather than in others.
fn assign((name, view): LayerKey, channels: &ByPass, mapping: &Mapping, part: Option<usize>) -> Layer {
    let mut layer = Layer::empty(name, view);
    let index = Index::of(channels, part);
    let known_by = |renderer: &'static Renderer| {
        let found = Pass::ALL.iter().filter_map(|&pass| {
            let mut names = renderer.names(pass);
            Some((pass, names.find_map(|name| index.find(name, pass))?))
        });
        found.collect::<BTreeMap<Pass, PassChannels>>()
    };
    // Bare channels have the same names in all renderers, so they tell nothing.
    let is_telling = |name: &str| !(layer.name.is_empty() && name == COMBINED) && name != BARE_DEPTH;
    // The names that a renderer knows, all those of a pass among them. Without a view layer's name, a renderer that
    // knows the albedo comes before others: light passes are called alike in many.
    let told = |renderer: &'static Renderer, passes: &BTreeMap<Pass, PassChannels>| {
        let names = Pass::ALL.iter().flat_map(|&pass| renderer.names(pass).map(move |name| (name, pass)));
        let found = names.filter_map(|(name, pass)| Some(index.find(name, pass)?.name));
        let count = found.filter(|name| is_telling(name)).collect::<HashSet<_>>().len();
        let albedo = passes.get(&Pass::DenoisingAlbedo);
        let knows_albedo = albedo.is_some_and(|at| is_telling(&at.name) && is_common(&at.name));
        (layer.name.is_empty() && knows_albedo, count)
    };
    let by_all = RENDERERS.map(|renderer| (renderer, known_by(renderer)));
    let best = by_all.iter().rev().max_by_key(|(renderer, passes)| told(renderer, passes)); // keeps the last of equals
    let (renderer, passes) = best.expect("there are renderers");
    (layer.renderer, layer.passes) = (renderer, passes.clone());
    // A file that a compositor wrote may have names of several renderers. Passes that Blender leaves out stay
    // out, since its passes differ from those of the same name in other renderers. Light, which Blender alone divides by
    // the surface's colour, stays out for the same reason.
    let is_light = |pass: &Pass| pass.carries_radiance() && *pass != Pass::Combined;
    if !renderer.is_blender() {
        for (pass, at) in by_all.iter().flat_map(|(_, passes)| passes) {
            if is_common(&at.name) && *pass != Pass::Normal && !is_light(pass) {
                layer.passes.entry(*pass).or_insert_with(|| at.clone());
            }
        }
    }
    for (pass, name) in mapping.iter() {
        if let Some(at) = index.find(within(&layer.name, name), pass) {
            layer.passes.insert(pass, at);
        }
    }
    belong_alpha(&mut layer.passes, channels, mapping);
    for (pass_name, candidates) in channels {
        let Some(group) = light_group(pass_name) else { continue };
        let found = find_components(pass_name, candidates, Pass::Combined, part);
        layer.light_groups.extend(found.map(|at| (group.to_owned(), at)));
    }
    let motion = |name: &&String| renderer.motion.iter().any(|known| is_alike(known, name));
    layer.motion = channels.keys().find(motion).cloned();
    let position = layer.passes.get(&Pass::Position);
    layer.position_averaged = position.is_some_and(|at| is_alike(&at.name, POSITION_AOV));
    layer.unrecognised = unrecognised(&layer, &index);
    layer
}

/// Leaves as alpha that of the picture which is the beauty, or one that is of no other picture, unless the user names
/// another.
fn belong_alpha(passes: &mut BTreeMap<Pass, PassChannels>, channels: &ByPass, mapping: &Mapping) {
    let named = |pass| mapping.iter().find(|(named, _)| *named == pass).map(|(_, name)| name);
    if named(Pass::Alpha) != named(Pass::Combined) {
        return;
    }
    let Some(beauty) = passes.get(&Pass::Combined) else { return };
    let all = || channels.values().flatten();
    let is_red = |place: &&Place| (place.part, place.channel) == (beauty.part, beauty.channels[0]);
    let Some(red) = all().find(is_red) else { return };
    let beside = |of: &Place, component: &str| {
        let is_it = |place: &&Place| {
            (place.part, place.prefix()) == (of.part, of.prefix())
                && is_component(&place.component, component)
        };
        all().find(is_it)
    };
    if let Some(own) = beside(red, "A") {
        let (part, channels, name) = (own.part, vec![own.channel], beauty.name.clone());
        passes.insert(Pass::Alpha, PassChannels { part, channels, name });
    } else if let Some(found) = passes.get(&Pass::Alpha) {
        let is_found = |place: &&Place| (place.part, place.channel) == (found.part, found.channels[0]);
        if all().find(is_found).is_some_and(|place| beside(place, "R").is_some()) {
            passes.remove(&Pass::Alpha);
        }
    }
}

/// The names of the channels that are of no pass.
fn unrecognised(layer: &Layer, index: &Index<'_>) -> Vec<String> {
    let of_pass = |pass: Pass| layer.renderer.names(pass).map(move |name| (name, pass));
    // Every name of a pass is recognised; the first one present is the one used.
    let named = Pass::ALL.into_iter().flat_map(of_pass);
    let named: Vec<PassChannels> = named.filter_map(|(name, pass)| index.find(name, pass)).collect();
    let used = layer.passes.values().chain(layer.light_groups.values()).chain(&named);
    let known: HashSet<(usize, usize)> =
        used.flat_map(|at| at.channels.iter().map(|&channel| (at.part, channel))).collect();
    let is_used = |pass: &str| layer.passes.values().chain(&named).any(|at| at.name == pass);
    let mut rest: Vec<&Place> = Vec::new();
    for (pass, places) in index.channels {
        let is_motion = layer.motion.as_ref() == Some(pass);
        // The fourth channel of an AOV or a noisy image is part of what was recognised.
        let is_known = |place: &Place| {
            known.contains(&(place.part, place.channel))
                || is_motion
                || (is_used(pass) && is_component(&place.component, "A"))
        };
        rest.extend(places.iter().filter(|place| !is_known(place)));
    }
    rest.sort_by_key(|place| (place.part, place.channel));
    rest.into_iter().map(|place| place.full_name.clone()).collect()
}

/// The name of a layer without that of the view layer before it, which users may leave out.
pub fn within<'a>(view_layer: &str, name: &'a str) -> &'a str {
    name.strip_prefix(view_layer).and_then(|rest| rest.strip_prefix('.')).unwrap_or(name)
}

/// The channels of a layer by the names of their passes, and these names by their [`plain`] forms.
struct Index<'a> {
    channels: &'a ByPass,
    alike: HashMap<String, &'a str>,
    /// The part whose channels are preferred.
    part: Option<usize>,
}

impl<'a> Index<'a> {
    fn of(channels: &'a ByPass, part: Option<usize>) -> Self {
        let mut alike = HashMap::new();
        for name in channels.keys() {
            alike.entry(plain(name)).or_insert(name.as_str());
        }
        alike.remove("");
        Self { channels, alike, part }
    }

    /// The channels of a pass of exactly that name, or else of one with the same [`plain`] form.
    fn find(&self, name: &str, pass: Pass) -> Option<PassChannels> {
        let known =
            if self.channels.contains_key(name) { Some(name) } else { self.alike.get(&plain(name)).copied() };
        if let Some(known) = known {
            return find_components(known, &self.channels[known], pass, self.part);
        }
        // `beauty`, `rgba` and their like are Combined here.
        let places = self.channels.get(COMBINED).filter(|_| is_bare(name))?;
        in_one_layer(name, places, pass, self.part, |prefix| prefix.eq_ignore_ascii_case(name))
    }
}

/// The channels that make up a pass, all of one layer and in one part, the `preferred` one if it has them.
fn find_components(
    name: &str,
    places: &[Place],
    pass: Pass,
    preferred: Option<usize>,
) -> Option<PassChannels> {
    // A file may hold the picture in bare channels and once more in a layer. The bare ones are what programs
    // show.
    let mut prefixes: Vec<&str> = Vec::new();
    for place in places {
        if !prefixes.contains(&place.prefix()) {
            prefixes.push(place.prefix());
        }
    }
    prefixes.sort_by_key(|prefix| !prefix.is_empty()); // keeps the order of the others
    prefixes.into_iter().find_map(|of| in_one_layer(name, places, pass, preferred, |prefix| prefix == of))
}

/// The channels that make up a pass, all in the `preferred` part or else in that of the first, of those whose layer
/// `is_it`.
fn in_one_layer(
    name: &str,
    places: &[Place],
    pass: Pass,
    preferred: Option<usize>,
    is_it: impl Fn(&str) -> bool,
) -> Option<PassChannels> {
    components(pass).iter().find_map(|wanted| {
        // The exact spelling comes first, since files may hold `R` of the picture beside `r` of something
        // else.
        let of = |wanted: &str, part: Option<usize>| {
            let is_in = |place: &&Place| is_it(place.prefix()) && part.is_none_or(|part| place.part == part);
            let mut in_part = places.iter().filter(is_in);
            let exact = in_part.clone().find(|place| place.component == wanted);
            exact.or_else(|| in_part.find(|place| is_component(&place.component, wanted)))
        };
        let part = of(wanted[0], preferred).or_else(|| of(wanted[0], None))?.part;
        let channels = wanted.iter().map(|wanted| Some(of(wanted, Some(part))?.channel));
        Some(PassChannels { part, channels: channels.collect::<Option<_>>()?, name: name.into() })
    })
}

impl Layer {
    /// Whether a method finds what it reads in this pass: the pass itself, or of Normal, which is in world
    /// space, Denoising Normal, which is in camera space.
    pub fn tells(&self, pass: Pass) -> bool {
        let has = |pass| self.passes.contains_key(&pass);
        has(pass) || (pass == Pass::Normal && has(Pass::DenoisingNormal))
    }

    fn empty(name: String, view: Option<String>) -> Self {
        let (passes, light_groups, unrecognised) = Default::default();
        let (position_averaged, motion, renderer) = (false, None, &BLENDER);
        Self { name, view, renderer, passes, light_groups, motion, position_averaged, unrecognised }
    }
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
                    let setting = BLENDER.setting(Pass::Combined);
                    let is_grey = |part: &Part| part.channels.iter().all(|c| is_component(&c.name, "Y") || is_component(&c.name, "A"));
                    if frame.parts().iter().all(is_grey) {
                        return "holds one channel of luminance and no colours, which no model reads; save it with R, G and B".into();
                    }
                    format!(
                        "no layer has a Combined pass; {}; {setting}; in other renderers' files say which layer it is: \
                         --map beauty=NAME",
                        listed(layers)
                    )
                });
                Error::invalid(frame.path(), why)
            }),
    }
}

/// The view layer to compare with one called `name` in another file: the one of the same name, or else the
/// only one with Combined besides the compositor's. An empty `name`, as in files without view layers, tells
/// nothing to choose by, and the view layer is that of [`choose`]. Of stereo views it is that of the same name, where
/// there is one, or else the first.
///
/// # Errors
/// There is no such view layer; the message lists what there is.
pub fn choose_like<'a>(
    frame: &Frame,
    layers: &'a [Layer],
    name: &str,
    view: Option<&str>,
) -> Result<&'a Layer> {
    let of_view = |like: &'a Layer| {
        layers.iter().find(|l| l.name == like.name && l.view.as_deref() == view).unwrap_or(like)
    };
    if let Some(namesake) = layers.iter().find(|l| l.name == name) {
        return Ok(of_view(namesake));
    }
    let first = of_view(choose(frame, layers, None)?);
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
    let mut told = HashSet::new(); // stereo views repeat them
    let names = layers.iter().filter(|l| told.insert(&l.name));
    let names: Vec<String> = names.map(|l| format!("'{}'", l.name)).collect();
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
    set.renderer = layer.renderer;
    set.view.clone_from(&layer.view);
    set.samples = told_samples(frame, &layer.name);

    decode(frame, window, held().map(|(pass, at)| (*pass, at)), |pass, planes| set.insert(pass, planes))?;
    Ok(set)
}

/// The samples of a pixel in a view layer: Blender's metadata tell them, with adaptive sampling the most that a pixel may
/// have had. Programs that write a render anew leave them out; then the file's name may tell, as that of render pairs.
pub fn told_samples(frame: &Frame, view_layer: &str) -> Option<u32> {
    let told = frame.text_attribute(&format!("cycles.{view_layer}.samples"));
    told.and_then(|count| count.trim().parse().ok()).or_else(|| samples(frame.path()))
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

/// Decodes channels, cut to a window, and hands them out under their keys. One decoding run for each part: in
/// single-part files all passes share their blocks.
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
        let is_chroma = |channel: usize| frame.parts()[part].channels[channel].is_chroma();
        for ((key, channels), mut image) in keys.into_iter().zip(channels).zip(images) {
            if let [_, red, blue] = *channels
                && is_chroma(red)
                && is_chroma(blue)
            {
                to_rgb(&mut image, frame.luminance_weights(part));
            }
            let Window { width, height, .. } = window;
            let data = crop(image, stored, window);
            put(key, Planes { channels: channels.len(), width, height, data });
        }
    }
    Ok(())
}

/// The values of `image`, (C, H, W) and stored in `from`, at the pixels of `to`.
fn crop(image: PlaneBuffer, from: Window, to: Window) -> PlaneBuffer {
    if from == to {
        return image;
    }
    let (stored, wanted) = (from.width * from.height, to.width * to.height);
    let mut out = PlaneBuffer::from(vec![0.0; image.len() / stored * wanted]);
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
        assert_eq!(crop(plane.clone().into(), from, to), [0.0, 0.0, 0.0, 11.0, 12.0, 0.0]);
        let two = [plane.clone(), plane.iter().map(|v| v + 0.5).collect()].concat();
        let moved = [0.0, 0.0, 0.0, 11.0, 12.0, 0.0, 0.0, 0.0, 0.0, 11.5, 12.5, 0.0];
        assert_eq!(crop(two.into(), from, to), moved);
        let away = Window { x: 100, y: 100, ..to };
        assert_eq!(crop(plane.into(), from, away), [0.0; 6]);
    }
}
