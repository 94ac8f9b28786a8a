//! Files with the names of other renderers and compositors: each must give the same result as the same frame
//! with Blender's names.

mod common;

use std::path::{Path, PathBuf};

use common::{
    demc,
    files::{data, read_exr, values, with_attributes},
};
use demc::passes::Pass;
use exr::prelude::*;
use predicates::prelude::*;

const SIDE: usize = 128;

/// A part's name, its view, and its channels by name with the planes they are of.
type Part<'a> = (&'a str, Option<&'a str>, &'a [(&'a str, usize)]);

/// The channels of a render: beauty, albedo and normal, three values of each pixel, and a depth.
struct Render([Vec<f32>; 10]);

impl Render {
    /// A frame that Cycles rendered.
    fn new() -> Self {
        let image = read_exr(data("s0000_room_0004spp.exr"));
        let passes = [("Combined", "RGB"), ("Denoising Albedo", "RGB"), ("Denoising Normal", "XYZ")];
        let names = passes.iter().flat_map(|(pass, components)| {
            components.chars().map(move |component| format!("ViewLayer.{pass}.{component}"))
        });
        let mut planes: Vec<Vec<f32>> = names.map(|name| values(&image, &name)).collect();
        planes.push((0..SIDE * SIDE).map(|i| i as f32).collect());
        Self(planes.try_into().unwrap())
    }

    /// Changes every normal.
    fn with_normals(mut self, change: impl Fn([f32; 3]) -> [f32; 3]) -> Self {
        for i in 0..SIDE * SIDE {
            let changed = change([6, 7, 8].map(|c| self.0[c][i]));
            (0..3).for_each(|axis| self.0[6 + axis][i] = changed[axis]);
        }
        self
    }

    /// A layer of channels by the names given and the planes they are of.
    fn layer(
        &self,
        channels: &[(&str, usize)],
        attributes: LayerAttributes,
    ) -> Layer<AnyChannels<FlatSamples>> {
        let list = channels
            .iter()
            .map(|(name, plane)| AnyChannel::new(*name, FlatSamples::F32(self.0[*plane].clone())));
        let channels = AnyChannels::sort(list.collect());
        Layer::new((SIDE, SIDE), attributes, Encoding::SMALL_LOSSLESS, channels)
    }

    fn write(&self, path: &Path, channels: &[(&str, usize)]) {
        Image::from_layer(self.layer(channels, LayerAttributes::default())).write().to_file(path).unwrap();
    }

    /// Parts by name, view and channels.
    fn write_parts(&self, path: &Path, parts: &[Part<'_>]) {
        let part = |(name, view, channels): &Part<'_>| {
            let mut attributes = LayerAttributes::named(*name);
            attributes.view_name = view.map(Text::from);
            self.layer(channels, attributes)
        };
        let shared = ImageAttributes::new(IntegerBounds::from_dimensions((SIDE, SIDE)));
        Image::from_layers(shared, parts.iter().map(part).collect::<Vec<_>>()).write().to_file(path).unwrap();
    }
}

/// Names that many programs use.
const PLAIN: [&str; 9] = ["R", "G", "B", "albedo.R", "albedo.G", "albedo.B", "N.X", "N.Y", "N.Z"];

/// The names of colours, albedo and normal, in the order of a render's planes.
fn channels<'a>(names: &[&'a str; 9]) -> Vec<(&'a str, usize)> {
    names.iter().enumerate().map(|(plane, name)| (*name, plane)).collect()
}

/// The command that denoises a file, and the folder of its result.
fn command(input: &Path, options: &[&str]) -> (assert_cmd::Command, PathBuf) {
    let out = input.with_extension("out");
    let mut command = demc();
    command
        .args(["denoise", "--model", "demc-s", "--overwrite"])
        .args(options)
        .arg(input)
        .arg("--out")
        .arg(&out);
    (command, out)
}

/// Denoises a file; returns the result's path.
#[track_caller]
fn denoise(input: &Path, options: &[&str]) -> PathBuf {
    let (mut command, out) = command(input, options);
    command.assert().success();
    out.join(input.file_name().unwrap())
}

/// What it says when it denoises a file, or refuses to.
fn said(input: &Path, options: &[&str]) -> String {
    String::from_utf8(command(input, options).0.output().unwrap().stderr).unwrap()
}

fn layer(path: &Path, name: &str) -> [Vec<f32>; 3] {
    let image = read_exr(path);
    ["R", "G", "B"].map(|component| values(&image, &format!("{name}.{component}")))
}

/// The render by Blender's names, denoised.
fn expected(folder: &Path) -> [Vec<f32>; 3] {
    let path = folder.join("blender.exr");
    let names = [
        "V.Combined.R",
        "V.Combined.G",
        "V.Combined.B",
        "V.Denoising Albedo.R",
        "V.Denoising Albedo.G",
        "V.Denoising Albedo.B",
        "V.Denoising Normal.X",
        "V.Denoising Normal.Y",
        "V.Denoising Normal.Z",
    ];
    Render::new().write(&path, &channels(&names));
    layer(&denoise(&path, &[]), "V.Denoised")
}

#[test]
fn light_passes_beside_the_guides_leave_a_file_its_renderers() {
    let dir = tempfile::tempdir().unwrap();
    let expected = expected(dir.path());
    let rgb = |layer: &str, first: usize| -> Vec<(String, usize)> {
        (0..3)
            .map(|c| {
                (
                    format!("{layer}{}{}", if layer.is_empty() { "" } else { "." }, ["R", "G", "B"][c]),
                    first + c,
                )
            })
            .collect()
    };
    let xyz = |layer: &str, first: usize| -> Vec<(String, usize)> {
        (0..3).map(|c| (format!("{layer}.{}", ["X", "Y", "Z"][c]), first + c)).collect()
    };
    // Planes 0 to 2 are the beauty, then come albedo and normal. What is no guide holds the beauty.
    let files = [
        (
            "arnold",
            vec![
                rgb("", 0),
                rgb("albedo", 3),
                xyz("N", 6),
                rgb("diffuse_direct", 0),
                rgb("diffuse_indirect", 0),
                rgb("emission", 0),
                rgb("transmission_direct", 0),
            ],
        ),
        (
            "octane",
            vec![
                rgb("Beauty", 0),
                rgb("Denoise albedo", 3),
                rgb("Denoise normal", 6),
                rgb("Diffuse direct", 0),
                rgb("Diffuse indirect", 0),
                rgb("Environment", 0),
            ],
        ),
        (
            "redshift",
            vec![
                rgb("", 0),
                rgb("DiffuseFilter", 3),
                rgb("Normals", 6),
                rgb("Emission", 0),
                rgb("Environment", 0),
            ],
        ),
        ("pbrt", vec![rgb("", 0), rgb("Albedo", 3), xyz("Ns", 6), xyz("N", 0)]),
        (
            "blender by nuke",
            vec![
                rgb("ViewLayer_Combined", 0),
                rgb("ViewLayer_Denoising_Albedo", 3),
                xyz("ViewLayer_Denoising_Normal", 6),
                rgb("ViewLayer_Diffuse_Direct", 0),
            ],
        ),
    ];
    for (renderer, layers) in files {
        let path = dir.path().join(format!("{renderer}.exr"));
        let names: Vec<(String, usize)> = layers.concat();
        let of_planes: Vec<(&str, usize)> =
            names.iter().map(|(name, plane)| (name.as_str(), *plane)).collect();
        Render::new().write(&path, &of_planes);
        let name = if renderer == "blender by nuke" { "ViewLayer.Denoised" } else { "Denoised" };
        assert!(layer(&denoise(&path, &[]), name) == expected, "{renderer}");
    }
}

#[test]
fn every_renderers_names_are_known() {
    let dir = tempfile::tempdir().unwrap();
    let expected = expected(dir.path());
    let (rgb, xyz, words) = (["R", "G", "B"], ["X", "Y", "Z"], ["red", "green", "blue"]);
    let (low_rgb, low_xyz) = (["r", "g", "b"], ["x", "y", "z"]);
    // Beauty, albedo and normal: what stands before their components, which may be nothing, and those.
    type Renderer = (&'static str, [&'static str; 3], [[&'static str; 3]; 3]);
    let renderers: [Renderer; 16] = [
        ("blender file output", ["Image", "Denoising Albedo", "Denoising Normal"], [rgb, rgb, xyz]),
        ("arnold", ["", "denoise_albedo", "N"], [rgb, rgb, xyz]),
        ("arnold of old", ["RGBA", "diffuse_albedo", "N"], [rgb, rgb, xyz]),
        ("v-ray for max", ["", "VRayDiffuseFilter", "VRayNormals"], [rgb, rgb, xyz]),
        ("v-ray for maya", ["", "diffuse", "bumpNormals"], [rgb, words, xyz]),
        ("renderman", ["Ci", "albedo", "normal"], [low_rgb, low_rgb, low_xyz]),
        ("redshift", ["", "DiffuseFilter", "Normals"], [rgb, rgb, rgb]),
        ("karma", ["C", "albedo", "N"], [low_rgb, low_rgb, low_xyz]),
        ("octane", ["Beauty", "Denoise albedo", "Denoise normal"], [rgb, rgb, rgb]),
        ("octane otherwise", ["", "DenoiseAlbedo", "DenoiseNormal"], [rgb, rgb, rgb]),
        ("corona", ["", "CShading_Albedo", "CGeometry_NormalsShading"], [rgb, rgb, rgb]),
        ("mitsuba", ["", "albedo", "nn"], [rgb, rgb, xyz]),
        ("pbrt", ["", "Albedo", "Ns"], [rgb, rgb, xyz]),
        ("luxcore", ["RGB", "ALBEDO", "AVG_SHADING_NORMAL"], [rgb, rgb, rgb]),
        ("unreal", ["FinalImage", "FinalImageBaseColor", "FinalImageWorldNormal"], [rgb, rgb, rgb]),
        ("moonray", ["", "denoise_albedo", "denoise_normal"], [words, rgb, rgb]),
    ];
    for (renderer, layers, components) in renderers {
        let path = dir.path().join(format!("{renderer}.exr"));
        let full = |plane: usize| match layers[plane / 3] {
            "" => components[plane / 3][plane % 3].to_owned(),
            layer => format!("{layer}.{}", components[plane / 3][plane % 3]),
        };
        let names: Vec<String> = (0..9).map(full).collect();
        let of_planes: Vec<(&str, usize)> =
            names.iter().enumerate().map(|(plane, name)| (name.as_str(), plane)).collect();
        Render::new().write(&path, &of_planes);
        assert!(layer(&denoise(&path, &[]), "Denoised") == expected, "{renderer}");
    }
    // pbrt of old, without dots.
    let path = dir.path().join("pbrt of old.exr");
    let names = ["R", "G", "B", "Albedo.R", "Albedo.G", "Albedo.B", "Nsx", "Nsy", "Nsz"];
    Render::new().write(&path, &channels(&names));
    assert!(layer(&denoise(&path, &[]), "Denoised") == expected);
}

#[test]
fn light_of_one_renderer_is_not_the_albedo_of_another() {
    // Arnold's `diffuse` is light, V-Ray's is a colour.
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("arnold.exr");
    let names = ["RGBA.R", "RGBA.G", "RGBA.B", "diffuse.R", "diffuse.G", "diffuse.B", "N.X", "N.Y", "N.Z"];
    Render::new().write(&path, &channels(&names));
    let said = said(&path, &[]);
    assert!(said.contains("done without Denoising Albedo") && said.contains("denoise_albedo"), "{said}");
}

#[test]
fn depth_is_told_from_cie_colours() {
    let dir = tempfile::tempdir().unwrap();
    let inspect = |channels: &[(&str, usize)]| {
        let path = dir.path().join("z.exr");
        Render::new().write(&path, channels);
        let output = demc().arg("inspect").arg(&path).output().unwrap();
        String::from_utf8(output.stdout).unwrap()
    };
    let has_depth = |text: &str| text.lines().any(|line| line.trim_start().starts_with("Depth"));
    assert!(has_depth(&inspect(&[("R", 0), ("G", 1), ("B", 2), ("Z", 9)])));
    assert!(has_depth(&inspect(&[("R", 0), ("G", 1), ("B", 2), ("depth.T", 9)])));
    assert!(has_depth(&inspect(&[("Ci.r", 0), ("Ci.g", 1), ("Ci.b", 2), ("zfiltered", 9)])));
    assert!(!has_depth(&inspect(&[("X", 0), ("Y", 1), ("Z", 2)])));
}

#[test]
fn normals_of_any_kind_become_those_of_cycles() {
    let dir = tempfile::tempdir().unwrap();
    let expected = expected(dir.path());
    let path = dir.path().join("arnold.exr");
    let check = |change: &dyn Fn([f32; 3]) -> [f32; 3], word: &str| {
        Render::new().with_normals(change).write(&path, &channels(&PLAIN));
        let said = said(&path, &[]);
        assert!(said.contains(word), "{word}: {said}");
        let got = layer(&path.with_extension("out").join("arnold.exr"), "Denoised");
        let close = got
            .iter()
            .flatten()
            .zip(expected.iter().flatten())
            .all(|(a, b)| (a - b).abs() <= 1e-3 * b.abs() + 1e-4);
        assert!(close, "{word}");
    };
    check(&|n| n.map(|v| 0.5 * v + 0.5), "0..1");
    check(&|[x, y, z]| [x, y, -z], "towards the camera");
}

#[test]
fn a_mapping_names_what_no_table_can() {
    let dir = tempfile::tempdir().unwrap();
    let expected = expected(dir.path());
    let path = dir.path().join("own.exr");
    let names = ["pic.R", "pic.G", "pic.B", "my col.R", "my col.G", "my col.B", "dir.X", "dir.Y", "dir.Z"];
    Render::new().write(&path, &channels(&names));
    assert!(said(&path, &[]).contains("--map beauty=NAME"));
    let lines = ["--map", "beauty=pic", "--map", "albedo=my col", "--map", "normal=dir"];
    assert!(layer(&denoise(&path, &lines), "Denoised") == expected);
    // The same by a file.
    let file = dir.path().join("show.map");
    std::fs::write(&file, "# our show\nbeauty = pic\nalbedo = my col\n\nnormal = dir\n").unwrap();
    let by_file = ["--map-file", file.to_str().unwrap()];
    assert!(layer(&denoise(&path, &by_file), "Denoised") == expected);
    // A name that is not there, with those that are.
    let wrong = said(&path, &["--map", "beauty=pic", "--map", "albedo=col", "--map", "normal=dir"]);
    assert!(wrong.contains("no layer 'col'") && wrong.contains("my col"), "{wrong}");
    std::fs::write(&file, "albedo\n").unwrap();
    let wrong = said(&path, &by_file);
    assert!(wrong.contains("show.map: line 1") && wrong.contains("albedo=NAME"), "{wrong}");
}

#[test]
fn guides_come_from_files_of_their_own() {
    let dir = tempfile::tempdir().unwrap();
    let expected = expected(dir.path());
    let render = Render::new();
    let path = |name: &str| dir.path().join(name);
    let of = |first: usize| [("R", first), ("G", first + 1), ("B", first + 2)];
    render.write(&path("rgb.0007.exr"), &of(0));
    render.write(&path("albedo.0007.exr"), &of(3));
    render.write(&path("normal.7.exr"), &[("X", 6), ("Y", 7), ("Z", 8)]);
    let [albedo, normal] = ["albedo.####.exr", "normal.%d.exr"].map(|name| path(name).display().to_string());
    let frame = path("rgb.0007.exr");
    let result = denoise(&frame, &["--albedo", &albedo, "--normal", &normal]);
    assert!(layer(&result, "Denoised") == expected);
    // What is missing is named, as is the way to name it.
    assert!(said(&frame, &[]).contains("--albedo FILE"));
    let missing = path("no.####.exr").display().to_string();
    assert!(said(&frame, &["--albedo", &missing, "--normal", &normal]).contains("no.0007.exr: cannot read"));
    // One file for several frames is a mistake.
    render.write(&path("rgb.0008.exr"), &of(0));
    let several = said(&frame, &["--albedo", "a.exr", path("rgb.0008.exr").to_str().unwrap()]);
    assert!(several.contains("for several frames"), "{several}");
    // Another size.
    common::files::write_render(&path("albedo.0007.exr"), 8, 8, |_, _| 0.5);
    let alone = said(&frame, &["--temporal", "--albedo", path("rgb.0007.exr").to_str().unwrap()]);
    assert!(alone.contains("one file for several frames"), "neighbours have guides of their own: {alone}");
    let other = said(&frame, &["--albedo", &albedo, "--normal", &normal]);
    assert!(other.contains("8x8") && other.contains("128x128"), "{other}");
}

#[test]
fn guides_of_a_file_are_those_of_the_view_layer_that_is_denoised() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("two.exr");
    std::fs::copy(data("blender4_two_layers.exr"), &file).unwrap();
    for layer in ["ViewLayer", "Second.Layer"] {
        let arguments = ["--view-layer", layer];
        let red = |more: &[&str]| {
            let done = denoise(&file, &[&arguments[..], more].concat());
            values(&read_exr(done), &format!("{layer}.Denoised.R"))
        };
        assert_eq!(red(&[]), red(&["--albedo", file.to_str().unwrap()]), "{layer}");
    }
}

#[test]
fn a_picture_that_a_file_holds_twice_is_read_once() {
    let folder = tempfile::tempdir().unwrap();
    let render = Render::new();
    let expected = expected(folder.path());
    let guides = &channels(&PLAIN)[3..];
    for (name, other) in
        [("upper", ["Beauty.R", "Beauty.G", "Beauty.B"]), ("lower", ["rgb.R", "rgb.G", "rgb.B"])]
    {
        // The other picture is the albedo, which would show.
        let path = folder.path().join(format!("{name}.exr"));
        let bare = [("R", 0), ("G", 1), ("B", 2)];
        let twice: Vec<(&str, usize)> = other.iter().zip(3..).map(|(name, plane)| (*name, plane)).collect();
        render.write(&path, &[&bare[..], &twice, guides].concat());
        assert!(layer(&denoise(&path, &[]), "Denoised") == expected, "{name}");
        // The layer can be asked for.
        let (layer_name, _) = other[0].split_once('.').unwrap();
        let mapped = layer(&denoise(&path, &["--map", &format!("beauty={layer_name}")]), "Denoised");
        assert!(mapped != expected, "{name}");
    }
}

#[test]
fn names_of_parts_mean_nothing_where_channels_say_it() {
    let dir = tempfile::tempdir().unwrap();
    let expected = expected(dir.path());
    let path = dir.path().join("parts.exr");
    let (colour, albedo, normal): (&[_], &[_], &[_]) =
        (&[("R", 0), ("G", 1), ("B", 2)], &[("R", 3), ("G", 4), ("B", 5)], &[("X", 6), ("Y", 7), ("Z", 8)]);
    // Nuke's names, with its view and without.
    for view in [Some("main"), None] {
        let parts = [
            ("rgba_main", view, colour),
            ("Denoising Albedo_main", view, albedo),
            ("Denoising Normal_main", view, normal),
        ];
        Render::new().write_parts(&path, &parts);
        assert!(layer(&denoise(&path, &[]), "Denoised") == expected, "{view:?}");
    }
    // Any name for what holds colours and no more.
    Render::new()
        .write_parts(&path, &[("whatever", None, colour), ("N", None, normal), ("albedo", None, albedo)]);
    assert!(layer(&denoise(&path, &[]), "Denoised") == expected);
    // Channels with names of their own in a part of another.
    let full = channels(&PLAIN);
    Render::new().write_parts(&path, &[("rgbleft", Some("left"), &full), ("rgbright", Some("right"), &full)]);
    let result = read_exr(denoise(&path, &[]));
    let added: Vec<_> = result
        .layer_data
        .iter()
        .skip(2)
        .map(|part| {
            let view = part.attributes.view_name.as_ref().map(ToString::to_string);
            (view, part.channel_data.list.iter().any(|channel| channel.name.eq("Denoised.R")))
        })
        .collect();
    assert_eq!(added, [(Some("left".into()), true), (Some("right".into()), true)]);
}

#[test]
fn views_are_told_by_openexrs_rules() {
    let dir = tempfile::tempdir().unwrap();
    let expected = expected(dir.path());
    let path = dir.path().join("stereo.exr");
    let guides = [
        "Denoising Albedo.R",
        "Denoising Albedo.G",
        "Denoising Albedo.B",
        "Denoising Normal.X",
        "Denoising Normal.Y",
        "Denoising Normal.Z",
    ];
    let named = |name: &str, view: &str, in_front: bool| match name.rsplit_once('.') {
        _ if in_front => format!("{view}.{name}"),
        Some((layer, component)) => format!("{layer}.{view}.{component}"),
        None => format!("{view}.{name}"),
    };
    // The default view's colours have no view in their name; its guides have it, or have it not; views behind
    // or in front.
    for (guides_say, in_front) in [(true, false), (false, false), (false, true), (true, true)] {
        let mut names = vec![];
        for (plane, name) in ["R", "G", "B"].iter().chain(&guides).enumerate() {
            let is_bare = plane < 3 || !guides_say;
            names.push((if is_bare { (*name).into() } else { named(name, "left", in_front) }, plane));
            names.push((named(name, "right", in_front), plane));
        }
        let channels: Vec<(&str, usize)> =
            names.iter().map(|(name, plane)| (name.as_str(), *plane)).collect();
        Render::new().write(&path, &channels);
        with_attributes(&path, &[("multiView", "stringvector", b"\x04\0\0\0left\x05\0\0\0right")]);
        let result = denoise(&path, &[]);
        for view in ["left", "right"] {
            assert!(
                layer(&result, &format!("Denoised.{view}")) == expected,
                "{view} {guides_say} {in_front}"
            );
        }
        // Beside a part of something else. What says nothing of its view has it in its channels' names there too.
        let mut attributes = LayerAttributes::named("main");
        attributes.multi_view_names = Some(vec![Text::from("left"), Text::from("right")]);
        let parts = vec![
            Render::new().layer(&channels, attributes),
            Render::new().layer(&[("Mist.Z", 9)], LayerAttributes::named("mist")),
        ];
        let shared = ImageAttributes::new(IntegerBounds::from_dimensions((SIDE, SIDE)));
        Image::from_layers(shared, parts).write().to_file(&path).unwrap();
        let result = denoise(&path, &[]);
        for view in ["left", "right"] {
            assert!(layer(&result, &format!("Denoised.{view}")) == expected, "{view} beside another part");
        }
        denoise(&result, &[]);
    }
}

#[test]
fn alpha_is_that_of_the_picture_it_was_rendered_with() {
    let dir = tempfile::tempdir().unwrap();
    let bare = [("R", 0), ("G", 1), ("B", 2), ("A", 3)];
    // A layer of the user's, and MoonRay's, beside what programs show.
    let moonray = [
        "denoise_albedo.R",
        "denoise_albedo.G",
        "denoise_albedo.B",
        "denoise_normal.X",
        "denoise_normal.Y",
        "denoise_normal.Z",
    ];
    for (name, options, guides) in
        [("key", &["--map", "beauty=key"][..], &PLAIN[3..]), ("denoise_rgba", &[], &moonray)]
    {
        let guides: Vec<(&str, usize)> = guides.iter().copied().zip(3..).collect();
        for has_alpha in [false, true] {
            let path = dir.path().join(format!("{name}_{has_alpha}.exr"));
            let own: Vec<String> = ["R", "G", "B", "A"].map(|c| format!("{name}.{c}")).into();
            let planes = own.iter().map(String::as_str).zip([0, 1, 2, 4]);
            let own: Vec<(&str, usize)> = planes.take(if has_alpha { 4 } else { 3 }).collect();
            Render::new().write(&path, &[&bare[..], &own, &guides].concat());
            let [before, after] =
                [read_exr(&path), read_exr(denoise(&path, &[&["--replace"], options].concat()))];
            for (channel, plane) in bare {
                assert!(
                    values(&after, channel) == values(&before, channel),
                    "{name}: {channel}, plane {plane}"
                );
            }
            for (channel, _) in own {
                assert!(values(&after, channel) != values(&before, channel), "{channel}");
            }
        }
    }
}

#[test]
fn view_layers_called_like_passes_keep_their_results() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("env.exr");
    let names = ["Combined.R", "Combined.G", "Combined.B"].map(|name| format!("forest.env.{name}"));
    Render::new().write(&path, &names.iter().map(String::as_str).zip(0..).collect::<Vec<_>>());
    for said in ["128x128", "is there already"] {
        let mut command = demc();
        command.args(["denoise", "--model", "noisy"]).arg(&path).arg("--out").arg(dir.path().join("out"));
        command.assert().success().stdout(predicates::str::contains(said));
    }
}

#[test]
fn an_alpha_of_no_other_picture_is_the_beautys() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("renderman.exr");
    let guides = &channels(&PLAIN)[3..];
    Render::new().write(&path, &[&[("Ci.r", 0), ("Ci.g", 1), ("Ci.b", 2), ("a", 3)][..], guides].concat());
    let result = read_exr(denoise(&path, &["--map", "beauty=Ci", "--alpha", "keep"]));
    assert_eq!(values(&result, "Denoised.A"), values(&result, "a"));
}

#[test]
fn what_was_replaced_is_told_by_its_own_name() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("two.exr");
    let bare = channels(&PLAIN);
    Render::new().write(&path, &[&bare[..], &[("key.R", 2), ("key.G", 1), ("key.B", 0)]].concat());
    let key = ["--replace", "--map", "beauty=key"];
    let result = denoise(&path, &key);
    let again = |options: &[&str]| said(&result, options).contains("was already denoised by demc");
    assert!(again(&key) && !again(&["--replace"]));
    let (mut command, _) = command(&path, &key);
    let finished = command.output().unwrap();
    assert!(finished.status.success());
    // Without --overwrite it is found again.
    let mut without = demc();
    without
        .args(["denoise", "--model", "demc-s"])
        .args(key)
        .arg(&path)
        .arg("--out")
        .arg(result.parent().unwrap());
    without.assert().success().stdout(predicates::str::contains("is there already"));
}

#[test]
fn parts_that_hold_the_same_names_are_not_mixed() {
    let dir = tempfile::tempdir().unwrap();
    let expected = expected(dir.path());
    let path = dir.path().join("joined.exr");
    let other = [
        ("R", 3),
        ("G", 4),
        ("B", 5),
        ("albedo.R", 0),
        ("albedo.G", 1),
        ("albedo.B", 2),
        ("N.X", 8),
        ("N.Y", 6),
        ("N.Z", 7),
    ];
    let own = channels(&PLAIN);
    Render::new().write_parts(&path, &[("subimage00", None, &other), ("subimage01", None, &own)]);
    assert!(layer(&denoise(&path, &["--map", "beauty=subimage01"]), "Denoised") == expected);
}

#[test]
fn cycles_own_normals_are_known_by_the_names_that_nuke_gives_them() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("nuke.exr");
    // Normals that another renderer's would be turned for: those of this one are taken as they are.
    let render = || Render::new().with_normals(|[x, y, z]| [0.5 * x + 0.5, 0.5 * z + 0.5, 0.5 * y + 0.5]);
    let names = |separator: &str, space: &str| {
        let parts = ["Combined.R", "Combined.G", "Combined.B"].into_iter().map(str::to_owned);
        let guides = ["Albedo.R", "Albedo.G", "Albedo.B", "Normal.X", "Normal.Y", "Normal.Z"];
        let all = parts.chain(guides.map(|guide| format!("Denoising{space}{guide}")));
        all.map(|name| format!("ViewLayer{separator}{name}")).collect::<Vec<String>>()
    };
    let result = |names: Vec<String>, name: &str| {
        let channels: Vec<(&str, usize)> = names.iter().map(String::as_str).zip(0..).collect();
        render().write(&path, &channels);
        assert!(!said(&path, &[]).contains("space"), "{}", said(&path, &[]));
        layer(&denoise(&path, &[]), name)
    };
    let blender = result(names(".", " "), "ViewLayer.Denoised");
    assert!(blender == result(names("_", "_"), "ViewLayer.Denoised"));
}

#[test]
fn denoising_normal_takes_the_place_of_a_normal_that_is_missing() {
    let dir = tempfile::tempdir().unwrap();
    let [path, out] = ["in.exr", "out"].map(|name| dir.path().join(name));
    let mut render = read_exr(data("s0000_room_0004spp.exr"));
    let is_normal = |part: &Layer<AnyChannels<FlatSamples>>| {
        part.attributes.layer_name.as_ref().is_some_and(|name| name.eq("ViewLayer.Normal"))
    };
    let count = render.layer_data.len();
    render.layer_data.retain(|part| !is_normal(part));
    assert_eq!(render.layer_data.len(), count - 1);
    render.write().to_file(&path).unwrap();

    let passes = demc::shot::prepare(&path, None).unwrap().passes;
    assert!(
        passes.get(Pass::Normal).is_some() && passes.get(Pass::Normal) == passes.get(Pass::DenoisingNormal)
    );
    let weights = Path::new(env!("CARGO_MANIFEST_DIR")).join("eval/rivals/weights/demc.safetensors");
    let note = "Normal is missing; Denoising Normal, of camera space, took its place";
    for (model, is_told) in [(weights.to_str().unwrap(), true), ("demc-s", false)] {
        let mut command = demc();
        command.args(["denoise", "--overwrite", "--model", model]).arg(&path).arg("--out").arg(&out);
        command.assert().success().stderr(predicate::str::contains(note).count(usize::from(is_told)));
    }
    demc()
        .arg("inspect")
        .arg(&path)
        .assert()
        .success()
        .stdout(predicate::str::contains("ready for demc-s, demc-m, demc-l, demc, "));
}
