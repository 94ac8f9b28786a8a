//! What the name of a channel says, and the channels of each view layer and stereo view by their passes.
//!
//! A channel is `<view layer>.<pass>[.<view>].<component>`, in files of several parts often a bare component
//! in a part of that name. Views are named as OpenEXR's "Storing Multi-View Images" has it, as Nuke does and
//! as Blender does.

use std::collections::BTreeMap;

use super::names::{
    BARE_DEPTH, BLENDER, COMBINED, RENDERERS, is_bare, is_blender, is_known, light_group, plain,
};
use crate::{
    frame::{Frame, Part},
    passes::Pass,
};

/// Names of components that are words.
const WORDS: [(&str, &str); 4] = [("red", "R"), ("green", "G"), ("blue", "B"), ("alpha", "A")];
/// What Blender calls the beauty.
const BLENDER_COMBINED: &str = "Combined";
/// Nuke's name of the view in files that have only one.
const MAIN: &str = "main";

/// A channel: where it is and its component's name.
pub struct Place {
    pub part: usize,
    pub channel: usize,
    pub component: String,
    pub full_name: String,
}

impl Place {
    /// The name of the layer that the channel is in, as it is stored; empty where it is in none.
    pub fn prefix(&self) -> &str {
        self.full_name.rsplit_once('.').map_or("", |(prefix, _)| prefix)
    }
}

/// A view layer's name and stereo view.
pub type LayerKey = (String, Option<String>);

/// The channels of a view layer in one view, by the names of their passes.
pub type ByPass = BTreeMap<String, Vec<Place>>;

/// Whether a component is the one wanted, in any letter case or as a word.
pub fn is_component(component: &str, wanted: &str) -> bool {
    let word = WORDS.iter().find(|(word, _)| word.eq_ignore_ascii_case(component));
    word.map_or(component, |(_, letter)| letter).eq_ignore_ascii_case(wanted)
}

/// What the name of a channel says.
#[derive(Clone, Debug, PartialEq, Eq)]
struct ChannelName {
    /// View layer; empty in files that have none.
    view_layer: String,
    /// Pass name as the renderer wrote it.
    pass: String,
    /// Stereo view, where there are several.
    view: Option<String>,
    /// Last token: `R`, `X`, `Z` ...; empty where the channel is all of its pass.
    component: String,
}

/// What a part says of its channels.
#[derive(Clone, Copy, Default)]
struct Holder<'a> {
    /// Its name, where that is a layer's: it completes bare names (`R`).
    name: Option<&'a str>,
    /// Its own view.
    view: Option<&'a str>,
    /// The views that the file declares.
    views: &'a [String],
    /// Whether it holds colours as CIE X, Y, Z, whose Z is no depth.
    is_xyz: bool,
    /// View layers whose names are joined to those of their passes by an underscore, as Nuke writes what Blender wrote:
    /// `ViewLayer_Denoising_Albedo.red`.
    joined: &'a [String],
}

impl ChannelName {
    fn parse(channel: &str, part: Holder<'_>) -> Self {
        let (prefix, component) = match channel.rsplit_once('.') {
            Some((prefix, component)) => (prefix, component),
            None => undotted(channel, part),
        };
        let (prefix, view) = without_view(prefix, part);
        let joined = part.joined.iter().find_map(|layer| {
            let pass = prefix.strip_prefix(layer.as_str())?.strip_prefix('_')?;
            (is_alike_blender(pass) || light_group(pass).is_some()).then_some((layer.as_str(), pass))
        });
        let (view_layer, pass) = joined.or(prefix.rsplit_once('.')).unwrap_or(("", prefix));
        // A denoised pass: `ViewLayer.Diffuse Direct.Denoised`. Two names alone are a view layer's and a
        // pass's: a view layer may be called like a pass.
        let is_rendered = |name: &str| is_blender(name) || light_group(name).is_some();
        let of_pass =
            view_layer.rsplit_once('.').filter(|(_, owner)| is_rendered(owner) && !is_rendered(pass));
        let (view_layer, pass) =
            of_pass.map_or((view_layer, pass), |(head, _)| (head, &prefix[head.len() + 1..]));
        // Single-layer images: `R G B A`, and `Z` for depth. In a view layer such a name is an AOV's.
        let bare = view_layer.is_empty() && (pass.is_empty() || is_bare(pass));
        let pass = match bare {
            true if component.eq_ignore_ascii_case("Z") && !part.is_xyz => BARE_DEPTH,
            true => COMBINED,
            false => pass,
        };
        Self { view_layer: view_layer.into(), pass: pass.into(), view, component: component.into() }
    }
}

/// The layer and the component of a name without a dot.
fn undotted<'a>(channel: &'a str, part: Holder<'a>) -> (&'a str, &'a str) {
    let is_letter = channel.len() == 1;
    let is_word = WORDS.iter().any(|(word, _)| word.eq_ignore_ascii_case(channel));
    if is_letter || is_word || part.name.is_some_and(is_known) {
        return (part.name.unwrap_or(""), channel);
    }
    // RenderMan's `zfiltered` is a pass of its own; early pbrt wrote `Nsx`, `Nsy`, `Nsz`.
    let split = channel.char_indices().last().map(|(at, _)| channel.split_at(at));
    match split {
        _ if is_known(channel) => (channel, ""),
        Some((pass, axis)) if "xyz".contains(&axis.to_ascii_lowercase()) && is_known(pass) => (pass, axis),
        _ => (part.name.unwrap_or(""), channel),
    }
}

/// A layer's name without the view in it, and the view.
fn without_view<'a>(prefix: &'a str, part: Holder<'_>) -> (&'a str, Option<String>) {
    let own = part.view.map(str::to_owned);
    // Names of parts end in the view, as Blender's `ViewLayer.Combined-left` and Nuke's `rgba_main`.
    let is_of_part = part.name == Some(prefix);
    for view in part.view.into_iter().chain(is_of_part.then_some(MAIN)) {
        let rest = prefix.strip_suffix(view);
        if let Some(rest) = rest.and_then(|rest| rest.strip_suffix(['-', '_'])) {
            return (rest, own);
        }
    }
    let is_view = |name: &str| part.views.iter().any(|v| v == name) || (is_of_part && name == MAIN);
    let named = |view: &str| (part.views.iter().any(|v| v == view)).then(|| view.to_owned());
    match (prefix.rsplit_once('.'), prefix.split_once('.')) {
        (None, _) if is_view(prefix) => ("", named(prefix).or(own)),
        (Some((rest, last)), _) if is_view(last) => (rest, named(last).or(own)),
        // The view may stand in front, as in `left.Denoising Albedo`.
        (_, Some((first, rest))) if is_view(first) => (rest, named(first).or(own)),
        _ => (prefix, own),
    }
}

/// The channels of each view layer and stereo view, in file order, by the names of their passes.
pub fn by_pass(frame: &Frame) -> Vec<(LayerKey, ByPass)> {
    let (views, joined) = (frame.views(), joined(frame));
    let mut found: Vec<(LayerKey, ByPass)> = Vec::new();
    for (p, part) in frame.parts().iter().enumerate() {
        let holder = Holder { joined: &joined, ..holder(frame, part, &views) };
        // Deep samples are no image.
        let flat = if part.deep { &[] } else { part.channels.as_slice() };
        for (c, channel) in flat.iter().enumerate() {
            let name = ChannelName::parse(&channel.name, holder);
            let full_name = match holder.name.filter(|_| !channel.name.contains('.')) {
                Some(part) => format!("{part}.{}", channel.name),
                None => channel.name.clone(),
            };
            let place = Place { part: p, channel: c, component: name.component, full_name };
            entry(&mut found, (name.view_layer, name.view)).entry(name.pass).or_default().push(place);
        }
    }
    take_unnamed_beauty(frame, &mut found);
    // Parts that say which view they are leave no channel without one.
    if frame.parts().iter().all(|part| part.view.is_none())
        && let Some(default) = views.first()
    {
        join_default_view(&mut found, default);
    }
    found
}

fn holder<'a>(frame: &Frame, part: &'a Part, views: &'a [String]) -> Holder<'a> {
    // A single part's name is the name of the file's only image, unless it ends in that of a pass.
    let name = part.name.as_deref().filter(|name| frame.is_multi_part() || ends_in_pass(name));
    let has = |wanted: &str| part.channels.iter().any(|channel| channel.name.eq_ignore_ascii_case(wanted));
    Holder { name, view: part.view.as_deref(), views, is_xyz: has("X") && has("Y"), joined: &[] }
}

/// Whether a name is one of Blender's passes' but for spaces, underscores and case.
fn is_alike_blender(name: &str) -> bool {
    let name = plain(name);
    BLENDER.rows.iter().flat_map(|row| row.names).any(|known| plain(known) == name)
}

/// The view layers whose Combined is called `<view layer>_Combined`, longest names first.
fn joined(frame: &Frame) -> Vec<String> {
    let layers = frame.parts().iter().flat_map(|part| {
        let prefixes = part.channels.iter().filter_map(|channel| Some(channel.name.rsplit_once('.')?.0));
        prefixes.chain(part.name.as_deref())
    });
    let heads = layers.filter_map(|layer| layer.strip_suffix(BLENDER_COMBINED)?.strip_suffix('_'));
    let mut heads: Vec<String> =
        heads.filter(|head| !head.is_empty() && !head.contains('.')).map(str::to_owned).collect();
    heads.sort_by_key(|head| std::cmp::Reverse(head.len()));
    heads.dedup();
    heads
}

/// Whether a part is called `<view layer>.<pass>`.
fn ends_in_pass(part: &str) -> bool {
    part.rsplit_once('.').is_some_and(|(_, tail)| is_blender(tail))
}

fn entry(found: &mut Vec<(LayerKey, ByPass)>, key: LayerKey) -> &mut ByPass {
    let at = found.iter().position(|(k, _)| *k == key).unwrap_or_else(|| {
        found.push((key, ByPass::new()));
        found.len() - 1
    });
    &mut found[at].1
}

/// Parts may have any name. Where nothing in a view has the name of a beauty, the colours of the view's first
/// part become the beauty.
fn take_unnamed_beauty(frame: &Frame, found: &mut Vec<(LayerKey, ByPass)>) {
    if !frame.is_multi_part() {
        return;
    }
    let beauty: Vec<String> =
        RENDERERS.iter().flat_map(|renderer| renderer.names(Pass::Combined)).map(plain).collect();
    let views: Vec<Option<String>> = found.iter().map(|((_, view), _)| view.clone()).collect();
    for view in views {
        let layers = || found.iter().filter(|((_, of), _)| *of == view);
        if layers().any(|(_, passes)| passes.keys().any(|pass| beauty.contains(&plain(pass)))) {
            continue;
        }
        // Cryptomattes hold numbers in R, G and B.
        let is_matte = |place: &&Place| {
            let name = frame.parts()[place.part].name.as_deref().unwrap_or_default();
            name.to_lowercase().contains("crypto")
        };
        let places = layers().flat_map(|(_, passes)| passes.values().flatten());
        let first = places.filter(|place| !is_matte(place)).map(|place| place.part).min();
        // It is R, G and B without a pass, in a part whose name means nothing.
        let is_it = |name: &str, places: &[Place]| {
            let has = |wanted: &str| {
                places.iter().any(|place| {
                    let channel = &frame.parts()[place.part].channels[place.channel].name;
                    Some(place.part) == first && is_component(channel, wanted)
                })
            };
            !is_known(name) && ["R", "G", "B"].into_iter().all(has)
        };
        let unnamed = found.iter_mut().filter(|((_, of), _)| *of == view).find_map(|(_, passes)| {
            let name = passes.iter().find_map(|(name, places)| is_it(name, places).then(|| name.clone()));
            name.and_then(|name| passes.remove(&name))
        });
        if let Some(places) = unnamed {
            entry(found, (String::new(), view)).insert(COMBINED.into(), places);
            found.retain(|(_, passes)| !passes.is_empty());
        }
    }
}

/// Where no part says of which view it is, passes without a view in their names belong to the default view, unless that has
/// a pass of the same name.
fn join_default_view(found: &mut Vec<(LayerKey, ByPass)>, default: &str) {
    let without: Vec<LayerKey> =
        found.iter().filter(|((_, view), _)| view.is_none()).map(|(key, _)| key.clone()).collect();
    for key in without {
        let own = (key.0.clone(), Some(default.to_owned()));
        let at = found.iter().position(|(k, _)| *k == key).expect("it was found above");
        let Some(target) = found.iter().position(|(k, _)| *k == own) else {
            found[at].0 = own;
            continue;
        };
        for (pass, places) in std::mem::take(&mut found[at].1) {
            let keeper = if found[target].1.contains_key(&pass) { at } else { target };
            found[keeper].1.insert(pass, places);
        }
        // The default view takes the place of the channels that it took in, so that it comes first.
        if found[at].1.is_empty() {
            found.swap(at, target);
            found.remove(target);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn check(channel: &str, part: Option<&str>, views: &[&str], expected: (&str, &str, Option<&str>, &str)) {
        let views: Vec<String> = views.iter().map(ToString::to_string).collect();
        let name = ChannelName::parse(channel, Holder { name: part, views: &views, ..Holder::default() });
        let got =
            (name.view_layer.as_str(), name.pass.as_str(), name.view.as_deref(), name.component.as_str());
        assert_eq!(got, expected, "{channel} in part {part:?}");
    }

    #[test]
    fn splits_the_names_that_blender_writes() {
        check("ViewLayer.Combined.R", None, &[], ("ViewLayer", "Combined", None, "R"));
        check("a.b.Denoising Albedo.G", None, &[], ("a.b", "Denoising Albedo", None, "G"));
        let views = ["left", "right"];
        check("ViewLayer.Combined.left.R", None, &views, ("ViewLayer", "Combined", Some("left"), "R"));
        check("R", Some("ViewLayer.Diffuse Color"), &[], ("ViewLayer", "Diffuse Color", None, "R"));
        check("ViewLayer.Beauty.R", None, &[], ("ViewLayer", "Beauty", None, "R"));
        check("ViewLayer.Combined.R", Some("any part"), &[], ("ViewLayer", "Combined", None, "R"));
        check("a.Diffuse Direct.Denoised.R", None, &[], ("a", "Diffuse Direct.Denoised", None, "R"));
        check("a.b.Combined_Key.Denoised.R", None, &[], ("a.b", "Combined_Key.Denoised", None, "R"));
        // View layers that are called like a pass.
        check("Environment.Combined.R", None, &[], ("Environment", "Combined", None, "R"));
        check("Environment.Denoised.R", None, &[], ("Environment", "Denoised", None, "R"));
        check("a.Depth.Combined.R", None, &[], ("a.Depth", "Combined", None, "R"));
    }

    #[test]
    fn splits_the_names_that_others_write() {
        let views = ["left", "right"];
        check("left.R", None, &views, ("", "Combined", Some("left"), "R"));
        check("left.Denoising Albedo.R", None, &views, ("", "Denoising Albedo", Some("left"), "R"));
        check("R", None, &[], ("", "Combined", None, "R"));
        check("g", None, &[], ("", "Combined", None, "g"));
        check("red", None, &[], ("", "Combined", None, "red"));
        check("Z", None, &[], ("", "Z", None, "Z"));
        check("R", Some("rgba"), &[], ("", "Combined", None, "R"));
        check("R", Some("rgba_main"), &[], ("", "Combined", None, "R"));
        check("R", Some("rgba.main"), &[], ("", "Combined", None, "R"));
        check("Beauty.R", None, &[], ("", "Combined", None, "R"));
        check("X", Some("Normal"), &[], ("", "Normal", None, "X"));
        check("zfiltered", None, &[], ("", "zfiltered", None, ""));
        check("Nsx", None, &[], ("", "Ns", None, "x"));
        check("dzdx", None, &[], ("", "Combined", None, "dzdx"));
        check("VRayZDepth", Some("VRayZDepth"), &[], ("", "VRayZDepth", None, "VRayZDepth"));
    }

    #[test]
    fn z_among_cie_colours_is_no_depth() {
        let name = ChannelName::parse("Z", Holder { is_xyz: true, ..Holder::default() });
        assert_eq!((name.pass.as_str(), name.component.as_str()), ("Combined", "Z"));
    }

    #[test]
    fn components_are_told_in_any_case_and_by_words() {
        assert!(is_component("r", "R") && is_component("Red", "R") && is_component("alpha", "A"));
        assert!(!is_component("g", "R") && !is_component("redder", "R"));
    }
}
