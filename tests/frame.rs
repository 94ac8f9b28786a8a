//! Frames lose nothing: for every compression, both layouts, scan lines and tiles, adding or replacing
//! a layer leaves names, types, windows, attributes and pixels of everything else as they were.
//!
//! The files are made, and the results read back, by the `exr` crate's high-level interface, which
//! shares with `frame` only the codecs.

use std::path::Path;

use demc::frame::{Frame, NewChannel, SampleKind};
use exr::prelude::*;
use half::f16;

const WIDTH: usize = 37;
const HEIGHT: usize = 70;
/// Every kind the `exr` crate writes, and whether it loses something each time.
const KINDS: [(Compression, bool); 10] = [
    (Compression::Uncompressed, false),
    (Compression::RLE, false),
    (Compression::ZIP1, false),
    (Compression::ZIP16, false),
    (Compression::PIZ, false),
    (Compression::PXR24, false),
    (Compression::B44, true),
    (Compression::B44A, true),
    (Compression::DWAA(None), true),
    (Compression::DWAB(Some(90.0)), true),
];
const TILES: Blocks = Blocks::Tiles(Vec2(16, 24));

type Flat = Image<Layers<AnyChannels<FlatSamples>>>;

/// Values that no lossy codec reproduces, with the odd infinity, and NaN where the codec is lossless.
fn noise(seed: u64, exact: bool) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    let next = |i| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let v = (state >> 40) as f32 / 1e6;
        match i {
            40 if exact => f32::NAN,
            41 if exact => f32::INFINITY,
            _ => v,
        }
    };
    (0..WIDTH * HEIGHT).map(next).collect()
}

fn half(seed: u64, exact: bool) -> FlatSamples {
    FlatSamples::F16(noise(seed, exact).into_iter().map(f16::from_f32).collect())
}

fn float(seed: u64, exact: bool) -> FlatSamples {
    FlatSamples::F32(noise(seed, exact))
}

fn attributes(name: Option<&str>) -> LayerAttributes {
    let mut own = LayerAttributes { layer_name: name.map(Text::from), ..LayerAttributes::default() };
    own.layer_position = Vec2(-3, 5);
    own.software_name = Some("Blender 5.0.1".into());
    own.comments = Some("kept".into());
    own.other.insert("cycles.ViewLayer.samples".into(), AttributeValue::Text("4".into()));
    own.other.insert("depth of field".into(), AttributeValue::F32(2.5));
    own
}

fn shared() -> ImageAttributes {
    let mut shared = ImageAttributes::new(IntegerBounds::new((-10, 0), (100, 90)));
    shared.pixel_aspect = 1.5;
    shared.other.insert("BlenderMultiChannel".into(), AttributeValue::Text("Blender V2.55.1".into()));
    shared
}

fn channels(prefix: &str, exact: bool) -> Vec<AnyChannel<FlatSamples>> {
    let named = |pass: &str, c: &str| format!("{prefix}{pass}.{c}");
    let mut list = Vec::new();
    for (i, c) in ["R", "G", "B", "A"].into_iter().enumerate() {
        list.push(AnyChannel::new(named("Combined", c).as_str(), half(i as u64, exact)));
    }
    for (i, c) in ["X", "Y", "Z"].into_iter().enumerate() {
        list.push(AnyChannel::new(named("Position", c).as_str(), float(10 + i as u64, exact)));
    }
    let ids = (0..(WIDTH * HEIGHT) as u32).map(|i| i.wrapping_mul(2_654_435_761)).collect();
    list.push(AnyChannel::new(named("Object Index", "X").as_str(), FlatSamples::U32(ids)));
    list
}

fn layer(
    own: LayerAttributes,
    encoding: Encoding,
    channels: Vec<AnyChannel<FlatSamples>>,
) -> Layer<AnyChannels<FlatSamples>> {
    Layer::new((WIDTH, HEIGHT), own, encoding, AnyChannels::sort(channels.into_iter().collect()))
}

fn encoding(compression: Compression, blocks: Blocks, line_order: LineOrder) -> Encoding {
    Encoding { compression, blocks, line_order }
}

/// One part with all channels, as Blender 4 and older write.
fn single_part(path: &Path, encoding: Encoding, exact: bool) {
    let layers = vec![layer(attributes(None), encoding, channels("ViewLayer.", exact))];
    Image::from_layers(shared(), layers).write().to_file(path).unwrap();
}

/// One part per pass, as Blender 5 writes.
fn part_per_pass(path: &Path, encoding: Encoding, exact: bool) {
    let mut all = channels("ViewLayer.", exact);
    let mut layers = Vec::new();
    for pass in ["ViewLayer.Combined", "ViewLayer.Position", "ViewLayer.Object Index"] {
        let own = all.extract_if(.., |c| c.name.to_string().starts_with(pass)).collect();
        layers.push(layer(attributes(Some(pass)), encoding, own));
    }
    Image::from_layers(shared(), layers).write().to_file(path).unwrap();
}

fn read(path: &Path) -> Flat {
    read_all_flat_layers_from_file(path).unwrap()
}

/// Bit patterns, so that NaN equals itself.
fn bits(samples: &FlatSamples) -> Vec<u32> {
    match samples {
        FlatSamples::F16(v) => v.iter().map(|v| u32::from(v.to_bits())).collect(),
        FlatSamples::F32(v) => v.iter().map(|v| v.to_bits()).collect(),
        FlatSamples::U32(v) => v.clone(),
    }
}

fn channel<'a>(image: &'a Flat, name: &str) -> Option<&'a FlatSamples> {
    let mut all = image.layer_data.iter().flat_map(|l| &l.channel_data.list);
    all.find(|c| c.name.eq(name)).map(|c| &c.sample_data)
}

fn stored_chunks(path: &Path, part: usize) -> Vec<String> {
    let file = std::io::BufReader::new(std::fs::File::open(path).unwrap());
    let reader = exr::block::read(file, true).unwrap().all_chunks(true).unwrap();
    reader
        .map(std::result::Result::unwrap)
        .filter(|c| c.layer_index == part)
        .map(|c| format!("{:?}", c.compressed_block))
        .collect()
}

/// Everything of `before` is in `after`; channels in `changed` may differ.
#[track_caller]
fn assert_kept(before: &Flat, after: &Flat, changed: &[&str]) {
    assert_eq!(before.attributes, after.attributes);
    for (old, new) in before.layer_data.iter().zip(&after.layer_data) {
        let mut attributes = new.attributes.clone();
        attributes.other.remove(b"demc".as_slice()); // lists what was added
        assert_eq!(old.attributes, attributes);
        assert_eq!(old.size, new.size);
        for c in old.channel_data.list.iter().filter(|c| !changed.iter().any(|n| c.name.eq(n))) {
            let now = new.channel_data.list.iter().find(|d| d.name == c.name).expect("channel kept");
            assert_eq!(bits(&c.sample_data), bits(&now.sample_data), "{}", c.name);
            assert_eq!((c.quantize_linearly, c.sampling), (now.quantize_linearly, now.sampling));
        }
    }
}

fn rgba<'a>(planes: &'a [Vec<f32>], kind: SampleKind) -> Vec<NewChannel<'a>> {
    let named = ["R", "G", "B", "A"].into_iter().zip(planes);
    named.map(|(component, values)| NewChannel { component, kind, values }).collect()
}

/// Smooth values: near the originals even after a lossy codec.
fn ramp() -> Vec<Vec<f32>> {
    let plane = |c: usize| (0..WIDTH * HEIGHT).map(|i| (c * 5000 + i) as f32 / 8192.0).collect();
    (0..4).map(plane).collect()
}

#[track_caller]
fn assert_close(samples: &FlatSamples, expected: &[f32], tolerance: f32) {
    let worst = samples.values_as_f32().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst <= tolerance, "off by {worst}");
}

/// Adds a layer to a file of each kind and checks all that was there before.
fn add_to_every_kind(make: fn(&Path, Encoding, bool), multi: bool, blocks: Blocks, order: LineOrder) {
    let dir = tempfile::tempdir().unwrap();
    for (kind, lossy) in KINDS {
        let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
        make(&input, encoding(kind, blocks, order), !lossy);
        let mut frame = Frame::read(&input).unwrap();
        assert_eq!(frame.is_multi_part(), multi);
        let planes = ramp();
        let recoded = frame
            .set_layer(0, "ViewLayer.Denoised", None, &rgba(&planes, SampleKind::Half))
            .unwrap_or_else(|e| panic!("{kind}: {e}"));
        frame.write(&output).unwrap();

        let (before, after) = (read(&input), read(&output));
        assert_kept(&before, &after, &[]);
        let added = channel(&after, "ViewLayer.Denoised.G").expect("layer added");
        assert!(matches!(added, FlatSamples::F16(_)));
        assert_close(added, &planes[1], if lossy { 0.05 } else { 0.001 });
        assert_eq!(after.layer_data.len(), before.layer_data.len() + usize::from(multi), "{kind}");
        for (part, (old, new)) in before.layer_data.iter().zip(&after.layer_data).enumerate() {
            let expected = if lossy && !multi { Compression::ZIP16 } else { old.encoding.compression };
            assert_eq!(new.encoding, Encoding { compression: expected, ..old.encoding });
            if multi {
                assert_eq!(stored_chunks(&input, part), stored_chunks(&output, part), "{kind}: recompressed");
            }
        }
        // Where kept channels had to change their compression, the caller is told.
        assert_eq!(recoded.is_some(), lossy && !multi, "{kind}");
    }
}

#[test]
fn a_single_part_file_gains_channels_and_keeps_the_rest() {
    add_to_every_kind(single_part, false, Blocks::ScanLines, LineOrder::Increasing);
}

#[test]
fn a_part_per_pass_file_gains_a_part_and_keeps_every_chunk() {
    add_to_every_kind(part_per_pass, true, Blocks::ScanLines, LineOrder::Increasing);
}

#[test]
fn tiles_stay_tiles() {
    add_to_every_kind(single_part, false, TILES, LineOrder::Increasing);
    add_to_every_kind(part_per_pass, true, TILES, LineOrder::Increasing);
}

#[test]
fn decreasing_line_order_is_kept() {
    add_to_every_kind(single_part, false, Blocks::ScanLines, LineOrder::Decreasing);
    add_to_every_kind(part_per_pass, true, Blocks::ScanLines, LineOrder::Decreasing);
}

#[test]
fn replacing_channels_changes_no_others() {
    let dir = tempfile::tempdir().unwrap();
    let changed = ["ViewLayer.Combined.R", "ViewLayer.Combined.G", "ViewLayer.Combined.B"];
    for make in [single_part, part_per_pass] {
        for (kind, lossy) in KINDS {
            let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
            make(&input, encoding(kind, Blocks::ScanLines, LineOrder::Increasing), !lossy);
            let mut frame = Frame::read(&input).unwrap();
            let index = |n: &str| frame.parts()[0].channels.iter().position(|c| c.name == n).unwrap();
            let planes = ramp();
            let channels: Vec<(usize, &[f32])> =
                changed.iter().zip(&planes).map(|(n, v)| (index(n), v.as_slice())).collect();
            let recoded = frame.replace(0, "ViewLayer.Combined", &channels).unwrap();
            frame.write(&output).unwrap();
            let (before, after) = (read(&input), read(&output));
            assert_kept(&before, &after, &changed);
            assert_eq!(before.layer_data.len(), after.layer_data.len());
            for (name, plane) in changed.iter().zip(&planes) {
                assert_close(channel(&after, name).unwrap(), plane, 0.002);
            }
            assert_eq!(recoded.is_some(), lossy, "{kind}");
        }
    }
}

#[test]
fn writing_a_frame_unchanged_keeps_every_chunk() {
    let dir = tempfile::tempdir().unwrap();
    for (kind, lossy) in KINDS {
        let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
        part_per_pass(&input, encoding(kind, TILES, LineOrder::Increasing), !lossy);
        Frame::read(&input).unwrap().write(&output).unwrap();
        assert_kept(&read(&input), &read(&output), &[]);
        for part in 0..3 {
            assert_eq!(stored_chunks(&input, part), stored_chunks(&output, part), "{kind}");
        }
    }
}

#[test]
fn adding_a_layer_twice_replaces_it() {
    let dir = tempfile::tempdir().unwrap();
    for (make, parts) in [(single_part as fn(&Path, Encoding, bool), 1), (part_per_pass, 4)] {
        let path = dir.path().join("in.exr");
        make(&path, encoding(Compression::ZIP16, Blocks::ScanLines, LineOrder::Increasing), true);
        for scale in [1.0, 2.0] {
            let mut frame = Frame::read(&path).unwrap();
            let planes: Vec<Vec<f32>> =
                ramp().into_iter().map(|p| p.into_iter().map(|v| v * scale).collect()).collect();
            frame.set_layer(0, "ViewLayer.Denoised", None, &rgba(&planes, SampleKind::Float)).unwrap();
            frame.write(&path).unwrap();
            let after = read(&path);
            assert_eq!(after.layer_data.len(), parts);
            assert_close(channel(&after, "ViewLayer.Denoised.B").unwrap(), &planes[2], 0.0);
        }
    }
}

#[test]
fn resolution_levels_are_kept_and_given_to_new_channels() {
    let dir = tempfile::tempdir().unwrap();
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    // 8x8 of ones with levels 8, 4, 2, 1.
    let level = |n: usize| FlatSamples::F32((0..n * n).map(|i| i as f32).collect());
    let levels = Levels::Mip {
        rounding_mode: exr::math::RoundingMode::Down,
        level_data: vec![level(8), level(4), level(2), level(1)],
    };
    let list = [AnyChannel::new("V.Combined.R", levels)].into_iter().collect();
    let tiled = encoding(Compression::ZIP16, Blocks::Tiles(Vec2(4, 4)), LineOrder::Increasing);
    let layer = Layer::new((8, 8), LayerAttributes::default(), tiled, AnyChannels::sort(list));
    Image::from_layer(layer).write().to_file(&input).unwrap();

    let mut frame = Frame::read(&input).unwrap();
    let values: Vec<f32> = (0..64).map(|i| i as f32).collect();
    let new = NewChannel { component: "R", kind: SampleKind::Float, values: &values };
    frame.set_layer(0, "V.Denoised", None, &[new]).unwrap();
    frame.write(&output).unwrap();

    let image = exr::prelude::read()
        .no_deep_data()
        .all_resolution_levels()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .from_file(&output)
        .unwrap();
    let list = &image.layer_data.channel_data.list;
    let level_of = |name: &str, n: usize| {
        let channel = list.iter().find(|c| c.name.eq(name)).unwrap();
        let Levels::Mip { level_data, .. } = &channel.sample_data else { panic!("levels lost") };
        level_data[n].values_as_f32().collect::<Vec<f32>>()
    };
    assert_eq!(level_of("V.Combined.R", 2), [0.0, 1.0, 2.0, 3.0]);
    assert_eq!(level_of("V.Denoised.R", 0), values);
    // Means of the quadrants of 0..64 in rows of 8: (0 + 27) / 2 and so on.
    assert_eq!(level_of("V.Denoised.R", 2), [13.5, 17.5, 45.5, 49.5]);
    assert_eq!(level_of("V.Denoised.R", 3), [31.5]);
}

#[test]
fn half_channels_never_overflow() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("in.exr");
    single_part(&path, encoding(Compression::ZIP16, Blocks::ScanLines, LineOrder::Increasing), true);
    let mut frame = Frame::read(&path).unwrap();
    let planes = vec![vec![1e6; WIDTH * HEIGHT], vec![-1e6; WIDTH * HEIGHT]];
    frame.set_layer(0, "ViewLayer.Denoised", None, &rgba(&planes, SampleKind::Half)).unwrap();
    frame.write(&path).unwrap();
    let after = read(&path);
    assert_close(channel(&after, "ViewLayer.Denoised.R").unwrap(), &vec![65504.0; WIDTH * HEIGHT], 0.0);
    assert_close(channel(&after, "ViewLayer.Denoised.G").unwrap(), &vec![-65504.0; WIDTH * HEIGHT], 0.0);
}

#[test]
fn decoding_returns_stored_values() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("in.exr");
    for blocks in [Blocks::ScanLines, TILES] {
        single_part(&path, encoding(Compression::PIZ, blocks, LineOrder::Increasing), true);
        let frame = Frame::read(&path).unwrap();
        let part = &frame.parts()[0];
        assert_eq!((part.data_window.x, part.data_window.y), (-3, 5));
        assert_eq!(frame.display_window().width, 100);
        let wanted: Vec<usize> = (0..part.channels.len()).rev().collect();
        let images = frame.decode(0, &[&wanted[..1], &wanted[1..]]).unwrap();
        let planes: Vec<&[f32]> = images.iter().flat_map(|image| image.chunks(WIDTH * HEIGHT)).collect();
        assert_eq!(planes.len(), wanted.len());
        let stored = read(&path);
        for (&c, plane) in wanted.iter().zip(planes) {
            let expected = channel(&stored, &part.channels[c].name).unwrap();
            let expected: Vec<u32> = expected.values_as_f32().map(f32::to_bits).collect();
            assert_eq!(plane.iter().map(|v| v.to_bits()).collect::<Vec<_>>(), expected);
        }
    }
}

#[test]
fn nothing_is_left_behind_where_the_target_cannot_be_written() {
    let dir = tempfile::tempdir().unwrap();
    let input = dir.path().join("in.exr");
    single_part(&input, encoding(Compression::RLE, Blocks::ScanLines, LineOrder::Increasing), true);
    let frame = Frame::read(&input).unwrap();
    let error = frame.write(dir.path().join("missing/out.exr")).unwrap_err().to_string();
    assert!(error.contains("out.exr: cannot write"), "{error}");
    // A directory in the way of the final name: the rename fails, the temporary file goes.
    std::fs::create_dir(dir.path().join("out.exr")).unwrap();
    frame.write(dir.path().join("out.exr")).unwrap_err();
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 2);
}

#[test]
fn headers_alone_are_neither_written_nor_decoded_nor_added_to() {
    let dir = tempfile::tempdir().unwrap();
    let [path, copy] = ["in.exr", "copy.exr"].map(|name| dir.path().join(name));
    single_part(&path, Encoding::SMALL_LOSSLESS, true);
    let mut headers = Frame::read_headers(&path).unwrap();
    let planes = ramp();
    let added = rgba(&planes, SampleKind::Half);
    let errors = [
        headers.write(&copy).unwrap_err(),
        headers.decode(0, &[&[0]]).unwrap_err(),
        headers.set_layer(0, "ViewLayer.Denoised", None, &added).unwrap_err(),
    ];
    assert!(errors.iter().all(|error| error.to_string().contains("its pixels were not read")), "{errors:?}");
    let mut frame = Frame::read(&path).unwrap();
    let error = frame.set_layer(0, "ViewLayer.a\nb", None, &added).unwrap_err().to_string();
    assert!(error.contains("in.exr") && error.contains("cannot be called"), "{error}");
    assert!(!copy.exists());
}
