//! The one table from renderer channel names to passes, and where Blender turns each pass on.
//!
//! Names: Blender 5 writes `Diffuse Color`, Blender 4 and older `DiffCol` (Cycles' `engine.py`,
//! `list_render_passes`). A channel is `<view layer>.<pass>[.<view>].<component>`.

use super::Pass;

/// Shader AOV in which the export script stores the world position averaged over samples.
pub const POSITION_AOV: &str = "DEMC Position";
/// Pass that Blender adds when it denoises the render itself: the render before that.
pub const NOISY_IMAGE: &str = "Noisy Image";

/// The renderer's image.
pub const COMBINED: &str = "Combined";
/// What the names of light groups begin with (Cycles' `engine.py`); the group's own name follows.
const LIGHT_GROUP: &str = "Combined_";

/// The light group whose pass has that name.
pub fn light_group(pass: &str) -> Option<&str> {
    pass.strip_prefix(LIGHT_GROUP).filter(|group| !group.is_empty() && !group.contains('.'))
}

/// How the components of a pass are named; alternatives are tried in order.
type Components = &'static [&'static [&'static str]];

const RGB: Components = &[&["R", "G", "B"]];
const XYZ: Components = &[&["X", "Y", "Z"], &["R", "G", "B"]];
const XYZW: Components = &[&["X", "Y", "Z", "W"], &["R", "G", "B", "A"]];
const DEPTH: Components = &[&["Z"], &["X"], &["V"], &["Y"], &["R"]];
const ALPHA: Components = &[&["A"]];

/// One row: a pass, Blender's names for it (the current one first), its components and its switch.
pub struct Row {
    /// The meaning.
    pub pass: Pass,
    /// Blender's names, the current one first.
    pub names: &'static [&'static str],
    /// Component names.
    pub components: Components,
    /// Where Blender turns it on, under View Layer Properties > Passes unless it says otherwise.
    pub setting: &'static str,
}

macro_rules! row {
    ($pass:ident, $names:expr, $components:ident, $setting:literal) => {
        Row {
            pass: Pass::$pass,
            names: &$names,
            components: $components,
            setting: concat!("turn on View Layer Properties > Passes > ", $setting),
        }
    };
}

/// Every pass demc knows. Where two names of one row are in a file, the first wins.
pub const TABLE: &[Row] = &[
    row!(Combined, [COMBINED], RGB, "Data > Combined"),
    row!(Alpha, [COMBINED], ALPHA, "Data > Combined and set Output Properties > Output > Color to RGBA"),
    row!(NoisyImage, [NOISY_IMAGE], RGB, "Data > Denoising Data and keep Render Properties > Denoise on"),
    row!(Depth, ["Depth"], DEPTH, "Data > Z"),
    row!(Position, [POSITION_AOV, "Position"], XYZ, "Data > Position"),
    row!(Normal, ["Normal"], XYZ, "Data > Normal"),
    row!(Vector, ["Vector"], XYZW, "Data > Vector"),
    row!(DiffuseDirect, ["Diffuse Direct", "DiffDir"], RGB, "Light > Diffuse > Direct"),
    row!(DiffuseIndirect, ["Diffuse Indirect", "DiffInd"], RGB, "Light > Diffuse > Indirect"),
    row!(DiffuseColor, ["Diffuse Color", "DiffCol"], RGB, "Light > Diffuse > Color"),
    row!(GlossyDirect, ["Glossy Direct", "GlossDir"], RGB, "Light > Glossy > Direct"),
    row!(GlossyIndirect, ["Glossy Indirect", "GlossInd"], RGB, "Light > Glossy > Indirect"),
    row!(GlossyColor, ["Glossy Color", "GlossCol"], RGB, "Light > Glossy > Color"),
    row!(TransmissionDirect, ["Transmission Direct", "TransDir"], RGB, "Light > Transmission > Direct"),
    row!(TransmissionIndirect, ["Transmission Indirect", "TransInd"], RGB, "Light > Transmission > Indirect"),
    row!(TransmissionColor, ["Transmission Color", "TransCol"], RGB, "Light > Transmission > Color"),
    row!(VolumeDirect, ["Volume Direct", "VolumeDir"], RGB, "Light > Volume > Direct"),
    row!(VolumeIndirect, ["Volume Indirect", "VolumeInd"], RGB, "Light > Volume > Indirect"),
    row!(Emission, ["Emission", "Emit"], RGB, "Light > Emission"),
    row!(Environment, ["Environment", "Env"], RGB, "Light > Environment"),
    row!(ShadowCatcher, ["Shadow Catcher"], RGB, "Light > Shadow Catcher"),
    row!(DenoisingNormal, ["Denoising Normal"], XYZ, "Data > Denoising Data"),
    row!(DenoisingAlbedo, ["Denoising Albedo"], RGB, "Data > Denoising Data"),
    row!(DenoisingDepth, ["Denoising Depth"], DEPTH, "Data > Denoising Data"),
];

/// The row of a pass.
pub fn row(pass: Pass) -> &'static Row {
    TABLE.iter().find(|r| r.pass == pass).expect("the table has a row for every pass")
}

/// Whether a layer of that name in a file without view layers is the image itself, as some programs write it.
pub fn is_bare(name: &str) -> bool {
    ["rgb", "rgba", "beauty"].iter().any(|bare| bare.eq_ignore_ascii_case(name))
}

/// Whether the table has a pass of that name.
pub fn is_pass(name: &str) -> bool {
    TABLE.iter().any(|row| row.names.contains(&name))
}

/// What the name of a channel says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChannelName {
    /// View layer; empty in files that have none.
    pub view_layer: String,
    /// Pass name as the renderer wrote it.
    pub pass: String,
    /// Stereo view, where there are several.
    pub view: Option<String>,
    /// Last token: `R`, `X`, `Z` ...
    pub component: String,
}

impl ChannelName {
    /// Splits a channel name. `part` completes bare names (`R`) in multi-part files whose parts carry
    /// the layer's name; `views` are the stereo views that the file declares, `part_view` the part's own.
    pub fn parse(channel: &str, part: Option<&str>, part_view: Option<&str>, views: &[String]) -> Self {
        let (prefix, component) = match channel.rsplit_once('.') {
            Some((prefix, component)) => (prefix, component),
            None => (part.unwrap_or(""), channel),
        };
        // Blender names the parts of stereo files `ViewLayer.Combined-left`.
        let prefix = part_view.and_then(|v| prefix.strip_suffix(v)?.strip_suffix('-')).unwrap_or(prefix);
        let mut view = part_view.map(str::to_owned);
        let mut prefix = prefix;
        let (head, last) = prefix.rsplit_once('.').unwrap_or(("", prefix));
        if views.iter().any(|v| v == last) {
            view = Some(last.to_owned());
            prefix = head;
        }
        let (view_layer, pass) = prefix.rsplit_once('.').unwrap_or(("", prefix));
        // A denoised pass: `ViewLayer.Diffuse Direct.Denoised`. Two names alone are a view layer's and a pass's:
        // a view layer may be called like a pass.
        let is_rendered = |name: &str| is_pass(name) || light_group(name).is_some();
        let of_pass =
            view_layer.rsplit_once('.').filter(|(_, owner)| is_rendered(owner) && !is_rendered(pass));
        let (view_layer, pass) =
            of_pass.map_or((view_layer, pass), |(head, _)| (head, &prefix[head.len() + 1..]));
        // Single-layer images: `R G B A`, and `Z` for depth. In a view layer such a name is an AOV's.
        let bare = view_layer.is_empty() && (pass.is_empty() || is_bare(pass));
        let (pass, component) = match (bare, component) {
            (true, "Z") => ("Depth", component.to_owned()),
            (true, c) => ("Combined", c.to_ascii_uppercase()),
            (false, c) => (pass, c.to_owned()),
        };
        Self { view_layer: view_layer.into(), pass: pass.into(), view, component }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn check(channel: &str, part: Option<&str>, views: &[&str], expected: (&str, &str, Option<&str>, &str)) {
        let views: Vec<String> = views.iter().map(ToString::to_string).collect();
        let name = ChannelName::parse(channel, part, None, &views);
        let got =
            (name.view_layer.as_str(), name.pass.as_str(), name.view.as_deref(), name.component.as_str());
        assert_eq!(got, expected, "{channel} in part {part:?}");
    }

    #[test]
    fn splits_the_names_that_renderers_write() {
        check("ViewLayer.Combined.R", None, &[], ("ViewLayer", "Combined", None, "R"));
        check("a.b.Denoising Albedo.G", None, &[], ("a.b", "Denoising Albedo", None, "G"));
        check(
            "ViewLayer.Combined.left.R",
            None,
            &["left", "right"],
            ("ViewLayer", "Combined", Some("left"), "R"),
        );
        check("left.R", None, &["left", "right"], ("", "Combined", Some("left"), "R"));
        check("R", None, &[], ("", "Combined", None, "R"));
        check("g", None, &[], ("", "Combined", None, "G"));
        check("Z", None, &[], ("", "Depth", None, "Z"));
        check("R", Some("ViewLayer.Diffuse Color"), &[], ("ViewLayer", "Diffuse Color", None, "R"));
        check("R", Some("rgba"), &[], ("", "Combined", None, "R"));
        check("Beauty.R", None, &[], ("", "Combined", None, "R"));
        check("ViewLayer.Beauty.R", None, &[], ("ViewLayer", "Beauty", None, "R"));
        check("X", Some("Normal"), &[], ("", "Normal", None, "X"));
        check("ViewLayer.Combined.R", Some("any part"), &[], ("ViewLayer", "Combined", None, "R"));
        check("a.Diffuse Direct.Denoised.R", None, &[], ("a", "Diffuse Direct.Denoised", None, "R"));
        check("a.b.Combined_Key.Denoised.R", None, &[], ("a.b", "Combined_Key.Denoised", None, "R"));
        // View layers that are called like a pass.
        check("Environment.Combined.R", None, &[], ("Environment", "Combined", None, "R"));
        check("Environment.Denoised.R", None, &[], ("Environment", "Denoised", None, "R"));
        check("a.Depth.Combined.R", None, &[], ("a.Depth", "Combined", None, "R"));
    }

    #[test]
    fn every_pass_has_one_row() {
        for (i, a) in TABLE.iter().enumerate() {
            assert!(TABLE[i + 1..].iter().all(|b| b.pass != a.pass), "{:?} twice", a.pass);
            assert!(a.components.iter().all(|c| c.len() == a.pass.channels()), "{:?}", a.pass);
        }
        assert_eq!(TABLE.len(), Pass::ALL.len());
    }
}
