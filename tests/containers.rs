//! What a file holds beside pixels comes out as it went in, byte for byte and in its order, and what cannot
//! be denoised is said to be so.

mod common;

use std::{
    fs,
    path::{Path, PathBuf},
};

use common::{
    BY, demc,
    files::{Stored, data, header, read_exr, samples, with_attributes, write_render},
};
use exr::{meta::attribute::EnvironmentMap, prelude::*};
use predicates::{prelude::*, str::contains};

/// The flag for names of more than 31 letters.
const LONG_NAMES: u32 = 0x400;

fn version(bytes: &[u8]) -> u32 {
    u32::from_le_bytes(bytes[4..8].try_into().unwrap())
}

fn denoise(input: &Path, out: &Path) -> PathBuf {
    let mut command = demc();
    command.args(["denoise", "--model", "noisy", "--overwrite"]).arg(input).arg("--out").arg(out);
    command.assert().success();
    out.join(input.file_name().unwrap())
}

/// A render whose attributes are followed by those given.
fn render(folder: &Path, added: &[(&str, &str, &[u8])]) -> PathBuf {
    let path = folder.join("render.exr");
    write_render(&path, 20, 40, |_, i| i as f32);
    with_attributes(&path, added);
    path
}

#[test]
fn attributes_keep_their_bytes_and_their_order() {
    let dir = tempfile::tempdir().unwrap();
    let numbers = |numbers: [i32; 4]| numbers.iter().flat_map(|n| n.to_le_bytes()).collect::<Vec<u8>>();
    let (inverted, empty) = (numbers([5, 5, 2, 2]), numbers([0, 0, -1, -1]));
    let mut added: Vec<(&str, &str, &[u8])> = vec![
        ("zebra", "string", b"first"),
        ("inverted", "box2i", &inverted),
        ("empty", "box2i", &empty),
        ("dwaCompressionLevel", "float", &[0, 0, 52, 66]),
        ("of a type to come", "hypercube", &[1, 2, 3]),
        ("keyCode", "keycode", &[7; 28]),
        ("latin", "string", &[0xe4, 0xf6]),
    ];
    let names: Vec<String> = (0..8).map(|i| format!("custom {}", (i * 5) % 8)).collect();
    added.extend(names.iter().map(|name| (name.as_str(), "int", [1, 0, 0, 0].as_slice())));
    let input = render(dir.path(), &added);
    let [first, second] = ["a", "b"].map(|out| fs::read(denoise(&input, &dir.path().join(out))).unwrap());
    assert!(first == second, "the same input gives the same bytes");
    let derived = |(name, _, _): &&Stored| name != "channels" && !name.starts_with("demc");
    let (before, after) = (header(&fs::read(&input).unwrap()).0, header(&first).0);
    let [before, after] = [&before, &after].map(|list| list.iter().filter(derived).collect::<Vec<_>>());
    assert_eq!(before, after);
}

#[test]
fn long_names_are_said_to_be_there() {
    let dir = tempfile::tempdir().unwrap();
    let input = render(dir.path(), &[]);
    assert_eq!(version(&fs::read(&input).unwrap()) & LONG_NAMES, 0);
    let result = denoise(&input, &dir.path().join("short"));
    assert_eq!(version(&fs::read(result).unwrap()) & LONG_NAMES, 0);
    // A layer that is added, and what the file held.
    let out = dir.path().join("long");
    let name = "a layer of a name of more letters than that";
    let mut command = demc();
    command.args(["denoise", "--model", "noisy", "--layer", name]).arg(&input).arg("--out").arg(&out);
    command.assert().success();
    let result = out.join("render.exr");
    assert_ne!(version(&fs::read(&result).unwrap()) & LONG_NAMES, 0);
    let again = denoise(&result, &dir.path().join("again"));
    assert_ne!(version(&fs::read(again).unwrap()) & LONG_NAMES, 0);
}

#[test]
fn the_type_of_a_single_part_does_not_matter() {
    let dir = tempfile::tempdir().unwrap();
    for kind in ["tiledimage", "scanlineimage", "deepscanline", "no such thing"] {
        let input = render(dir.path(), &[("type", "string", kind.as_bytes())]);
        let result = fs::read(denoise(&input, &dir.path().join("out"))).unwrap();
        assert!(header(&result).0.iter().any(|(name, _, value)| name == "type" && value == kind.as_bytes()));
    }
}

#[test]
fn a_part_that_is_added_says_of_its_colours_what_the_beauty_does() {
    let dir = tempfile::tempdir().unwrap();
    let input = dir.path().join("in.exr");
    let part = |name: &str, other: &[(&str, &str)]| {
        let list = ["R", "G", "B"]
            .map(|c| AnyChannel::new(format!("{name}.{c}").as_str(), FlatSamples::F32(vec![0.5; 12])));
        let mut own = LayerAttributes::named(name);
        own.white_luminance = Some(80.0);
        for (key, value) in other {
            own.other.insert((*key).into(), AttributeValue::Text((*value).into()));
        }
        Layer::new((4, 3), own, Encoding::SMALL_LOSSLESS, AnyChannels::sort(list.into_iter().collect()))
    };
    let shared = ImageAttributes::new(IntegerBounds::from_dimensions((4, 3)));
    let beauty = [("colorInteropID", "lin_ap1_scene"), ("cryptomatte/1/name", "x"), ("demc", "V.Other")];
    let parts = vec![part("V.Depth", &[("colorInteropID", "data")]), part("V.Combined", &beauty)];
    Image::from_layers(shared, parts).write().to_file(&input).unwrap();
    let result = denoise(&input, &dir.path().join("out"));
    let headers = MetaData::read_from_file(result, false).unwrap().headers;
    let added = headers.last().unwrap().own_attributes.clone();
    assert!(added.layer_name.unwrap().eq("V.Denoised"));
    assert_eq!(added.white_luminance, Some(80.0));
    let mut other: Vec<(String, AttributeValue)> =
        added.other.into_iter().map(|(k, v)| (k.to_string(), v)).collect();
    other.sort_by(|a, b| a.0.cmp(&b.0));
    let text = |text: &str| AttributeValue::Text(text.into());
    assert_eq!(
        other,
        [
            ("colorInteropID".to_string(), text("lin_ap1_scene")),
            ("demc".to_string(), text("V.Denoised")),
            ("demcMethod".to_string(), text(&format!("V.Denoised\n{BY} --model noisy")))
        ]
    );
}

#[test]
fn a_deep_part_is_copied_and_the_flat_one_denoised() {
    let dir = tempfile::tempdir().unwrap();
    let input = data("containers/flat_plus_deep.exr");
    let mut command = demc();
    command.arg("inspect").arg(&input).assert().success().stdout(
        contains("part 'deep' is deep: it is kept as it is")
            .and(contains("view layer 'ViewLayer'"))
            .and(contains("Denoising Albedo")),
    );
    let mut command = demc();
    command
        .args(["denoise", "--model", "demc-s"])
        .arg(&input)
        .arg("--out")
        .arg(dir.path())
        .assert()
        .success();
    let (before, after) =
        (fs::read(&input).unwrap(), fs::read(dir.path().join("flat_plus_deep.exr")).unwrap());
    // Its blocks are the last in the file, in one piece.
    let deep = &before[before.len() - 4000..];
    assert!(after.windows(deep.len()).any(|window| window == deep));
    let frame = demc::frame::Frame::read(dir.path().join("flat_plus_deep.exr")).unwrap();
    let parts: Vec<(&str, bool)> =
        frame.parts().iter().map(|part| (part.name.as_deref().unwrap(), part.deep)).collect();
    assert_eq!(parts, [("ViewLayer", false), ("deep", true), ("ViewLayer.Denoised", false)]);
}

#[test]
fn what_cannot_be_decoded_is_listed_and_told_with_its_remedy() {
    let dir = tempfile::tempdir().unwrap();
    for (name, told) in
        [("htj2k32.exr", "HTJ2K32"), ("luminance_chroma_b44.exr", "less than full resolution")]
    {
        let input = data("containers").join(name);
        demc().arg("inspect").arg(&input).assert().success().stdout(contains("Combined").and(contains(told)));
        demc().args(["inspect", "--json"]).arg(&input).assert().success().stdout(contains(told));
        let mut command = demc();
        command.args(["denoise", "--model", "demc-s"]).arg(&input).arg("--out").arg(dir.path());
        command.assert().code(1).stderr(contains(name).and(contains(told)).and(contains("oiiotool IN.exr")));
    }
}

#[test]
fn luminance_and_chroma_are_read_as_the_colours_they_make_and_kept_beside() {
    let dir = tempfile::tempdir().unwrap();
    let input = data("containers").join("luminance_chroma.exr");
    let frame = demc::frame::Frame::read(&input).unwrap();
    let colours = demc::passes::read(&frame, None).unwrap();
    let colours = colours.get(demc::passes::Pass::Combined).unwrap();
    // What OpenImageIO 3.1 reads there.
    for (x, rgb) in [(10, [1.716_797, 1.59668, 1.458_984]), (12, [5.042_969, 4.6875, 4.285_156])] {
        for (c, wanted) in rgb.into_iter().enumerate() {
            let got = colours.channel(c)[10 * colours.width + x];
            assert!((got / wanted - 1.0f32).abs() < 2e-3, "{x}, {c}: {got} beside {wanted}");
        }
    }
    let mut command = demc();
    command.args(["denoise", "--model", "noisy"]).arg(&input).arg("--out").arg(dir.path());
    command.assert().success();
    let result = demc::frame::Frame::read(dir.path().join("luminance_chroma.exr")).unwrap();
    let [kept, added] = result.parts() else { panic!("{:?}", result.parts()) };
    assert_eq!(
        (&kept.channels, kept.stored_bytes),
        (&frame.parts()[0].channels, frame.parts()[0].stored_bytes)
    );
    assert_eq!(result.decode(0, &[&[0, 1, 2]]).unwrap(), frame.decode(0, &[&[0, 1, 2]]).unwrap());
    assert_eq!(
        added.channels.iter().map(|c| c.name.as_str()).collect::<Vec<_>>(),
        ["Denoised.B", "Denoised.G", "Denoised.R"]
    );

    let mut command = demc();
    command
        .args(["denoise", "--model", "noisy", "--replace"])
        .arg(&input)
        .arg("--out")
        .arg(dir.path().join("r"));
    command.assert().code(1).stderr(contains("luminance and chroma").and(contains("--replace")));
}

#[test]
fn a_file_that_says_it_is_an_environment_is_denoised_without_a_seam() {
    let dir = tempfile::tempdir().unwrap();
    let cut = std::cell::Cell::new(None);
    let result = |name: &str, kind: EnvironmentMap, wrap: &[&str]| {
        let input = dir.path().join("render.exr");
        let mut image = read_exr(data("s0000_room_0004spp.exr"));
        image.layer_data[0].attributes.environment_map = Some(kind);
        if let Some(whole) = cut.get() {
            image.attributes.display_window = whole;
        }
        image.write().to_file(&input).unwrap();
        let mut command = demc();
        command.args(["denoise", "--model", "demc-s", "--overwrite"]).args(wrap).arg(input);
        command.arg("--out").arg(dir.path().join(name)).assert().success();
        let image = read_exr(dir.path().join(name).join("render.exr"));
        samples(&image, "ViewLayer.Denoised.R").unwrap().values_as_f32().collect::<Vec<_>>()
    };
    let (all_round, cube) = (EnvironmentMap::LatitudeLongitude, EnvironmentMap::Cube);
    let (joined, apart) = (result("a", all_round, &[]), result("b", all_round, &["--wrap", "none"]));
    assert!(
        joined != apart && joined == result("c", cube, &["--wrap", "x"]) && apart == result("d", cube, &[])
    );
    // A region of it, and what was rendered beyond its edges, do not meet.
    for (x, width) in [(-40, 400), (3, 20)] {
        cut.set(Some(IntegerBounds::new((x, 0), (width, 50))));
        assert!(
            apart == result("e", all_round, &[]) && apart == result("f", all_round, &["--wrap", "x"]),
            "{x}"
        );
    }
}

#[test]
fn a_result_that_was_cropped_since_is_not_filled() {
    let dir = tempfile::tempdir().unwrap();
    let part = |name: &str, size: (usize, usize), mark: bool| {
        let list = ["R", "G", "B"].map(|c| {
            AnyChannel::new(format!("{name}.{c}").as_str(), FlatSamples::F32(vec![0.5; size.0 * size.1]))
        });
        let mut attributes = LayerAttributes::named(name);
        if mark {
            let mark = exr::meta::attribute::AttributeValue::Text(name.into());
            attributes.other.insert("demc".into(), mark);
        }
        Layer::new(size, attributes, Encoding::SMALL_LOSSLESS, AnyChannels::sort(list.into_iter().collect()))
    };
    let parts = vec![part("V.Combined", (48, 40), false), part("V.Denoised", (32, 24), true)];
    let input = dir.path().join("cropped.exr");
    let shared = ImageAttributes::new(IntegerBounds::from_dimensions((48, 40)));
    Image::from_layers(shared, parts).write().to_file(&input).unwrap();
    let mut command = demc();
    command.args(["denoise", "--model", "noisy", "--out"]).arg(dir.path().join("out")).arg(&input);
    command.assert().code(1).stderr(contains("'V.Denoised', cropped since").and(contains("--layer NAME")));
}

/// A part of 48x40 pixels at a column, with a picture in three channels.
fn picture(name: &str, channels: &str, column: i32) -> Layer<AnyChannels<FlatSamples>> {
    let values: Vec<f32> =
        (0..48 * 40).map(|i| 0.2 + (i * 2_654_435_761usize % 1000) as f32 / 1000.0).collect();
    let list = ["R", "G", "B"]
        .map(|c| AnyChannel::new(format!("{channels}.{c}").as_str(), FlatSamples::F32(values.clone())));
    let attributes = LayerAttributes::named(name).with_position(Vec2(column, 0));
    Layer::new((48, 40), attributes, Encoding::SMALL_LOSSLESS, AnyChannels::sort(list.into_iter().collect()))
}

fn write(path: &Path, parts: Vec<Layer<AnyChannels<FlatSamples>>>) {
    let shared = ImageAttributes::new(IntegerBounds::from_dimensions((48, 40)));
    Image::from_layers(shared, parts).write().to_file(path).unwrap();
}

#[test]
fn a_light_pass_of_other_pixels_gets_its_result_where_the_beauty_is() {
    let dir = tempfile::tempdir().unwrap();
    let input = dir.path().join("in.exr");
    let part = |pass: &str, column| picture(&format!("V.{pass}"), &format!("V.{pass}"), column);
    write(&input, vec![part("Combined", 0), part("DiffCol", 0), part("DiffDir", 4)]);
    let denoise = |out: &str, more: &[&str]| {
        let mut command = demc();
        command.args(["denoise", "--model", "demc-s", "--passes"]).args(more).arg(&input);
        command.arg("--out").arg(dir.path().join(out)).assert()
    };
    denoise("added", &[]).success();
    let result = MetaData::read_from_file(dir.path().join("added/in.exr"), false).unwrap();
    let place = |name: &str| {
        let part =
            result.headers.iter().find(|part| part.own_attributes.layer_name.as_ref().unwrap().eq(name));
        part.unwrap_or_else(|| panic!("{name}")).own_attributes.layer_position.x()
    };
    assert_eq!((place("V.DiffDir"), place("V.DiffDir.Denoised"), place("V.Denoised")), (4, 0, 0));
    denoise("replaced", &["--replace"]).code(1).stderr(contains("'V.DiffDir' is stored for other pixels"));
}

#[test]
fn what_is_repaired_in_light_groups_is_told() {
    let dir = tempfile::tempdir().unwrap();
    let input = dir.path().join("in.exr");
    let part = |pass: &str| picture(&format!("V.{pass}"), &format!("V.{pass}"), 0);
    let mut key = part("Combined_Key");
    let FlatSamples::F32(values) = &mut key.channel_data.list[1].sample_data else { panic!("floats") };
    values[300] = f32::NAN;
    values[301] = f32::INFINITY;
    write(&input, vec![part("Combined"), key, part("Combined_Fill")]);
    let mut command = demc();
    command.args(["denoise", "--model", "demc-s", "--passes", "--json", "--out"]).arg(dir.path().join("out"));
    command.arg(&input).assert().success().stdout(
        contains(r#""non_finite":{"Combined_Key":2}"#)
            .and(contains("light passes and light groups 2 are NaN or infinite")),
    );
}

#[test]
fn a_file_of_one_view_has_no_view_in_its_channels_names() {
    let dir = tempfile::tempdir().unwrap();
    let input = dir.path().join("in.exr");
    let mut part = picture("rgba", "V.Combined", 0);
    part.attributes.layer_name = None;
    part.attributes.view_name = Some("main".into());
    Image::from_layer(part).write().to_file(&input).unwrap();
    let first = denoise(&input, &dir.path().join("first"));
    assert!(samples(&read_exr(&first), "V.Denoised.R").is_some());
    let second = denoise(&first, &dir.path().join("second"));
    assert_eq!(fs::read(first).unwrap(), fs::read(second).unwrap());
}

#[test]
fn alpha_of_an_earlier_result_does_not_stay_in_a_layer() {
    let dir = tempfile::tempdir().unwrap();
    let input = dir.path().join("in.exr");
    write_render(&input, 20, 10, |channel, i| if channel.ends_with('A') { (i % 2) as f32 } else { 0.5 });
    let mut image = read_exr(&input);
    let list = &mut image.layer_data[0].channel_data.list;
    let extra: Vec<_> = list
        .iter()
        .map(|channel| (channel.name.to_string(), channel.sample_data.clone()))
        .filter(|(name, _)| name.starts_with("ViewLayer.Combined.") && !name.ends_with('A'))
        .map(|(name, samples)| AnyChannel::new(name.replace("Combined", "Extra").as_str(), samples))
        .collect();
    list.extend(extra);
    image.layer_data[0].channel_data = AnyChannels::sort(std::mem::take(list));
    image.write().to_file(&input).unwrap();
    let first = denoise(&input, &dir.path().join("first"));
    assert!(samples(&read_exr(&first), "ViewLayer.Denoised.A").is_some());
    let out = dir.path().join("second");
    let mut command = demc();
    command.args(["denoise", "--model", "noisy", "--map", "beauty=Extra", "--out"]).arg(&out).arg(&first);
    command.assert().success();
    let second = read_exr(out.join("in.exr"));
    assert!(samples(&second, "ViewLayer.Denoised.R").is_some());
    assert!(samples(&second, "ViewLayer.Denoised.A").is_none());
    assert!(samples(&second, "ViewLayer.Combined.A").is_some());
}

#[test]
fn no_channel_gets_a_name_that_openexr_cannot_read() {
    let dir = tempfile::tempdir().unwrap();
    let input = dir.path().join("in.exr");
    let name = "v".repeat(200);
    write(&input, vec![picture(&name, &format!("{name}.Combined"), 0)]);
    let run = |layer: &str| {
        let mut command = demc();
        command.args(["denoise", "--model", "noisy", "--layer", layer, "--out"]).arg(dir.path().join("out"));
        command.arg(&input).assert()
    };
    run(&"l".repeat(53)).code(1).stderr(contains("longer than 255 bytes").and(contains("in.exr")));
    run(&"l".repeat(52)).success();
}

#[test]
fn alpha_is_refused_before_any_work_where_a_model_takes_none_along() {
    let dir = tempfile::tempdir().unwrap();
    for option in [&["--alpha", "denoise"][..], &["--passes"]] {
        let mut command = demc();
        command.args(["denoise", "--model", "nfor"]).args(option).arg("--out").arg(dir.path().join("out"));
        let told = command.arg(data("blender5.exr")).assert().code(2);
        told.stderr(contains(option.join(" ")).and(contains("nfor denoises the beauty alone")));
    }
}
