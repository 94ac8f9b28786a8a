//! The Blender scripts, run for real with bpy and read back by demc.

mod common;

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use common::{
    files::names_in,
    python::{interpreter as blender, run},
};
use demc::{
    filters::motion::{Direction, Flow},
    frame::Frame,
    passes::{self, Pass, PassSet},
    testset,
};

fn script(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("blender_scripts").join(name)
}

fn snippet(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/blender_data").join(name)
}

/// What a script says that leaves something out: it goes on, and ends with 1.
fn run_with_failures(command: &mut Command) -> String {
    let output = command.output().unwrap();
    let [said, errors] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    assert_eq!(output.status.code(), Some(1), "{said}{errors}");
    said
}

fn make_scene(folder: &Path) -> PathBuf {
    let blend = folder.join("shot.blend");
    run(blender().arg(snippet("make_scene.py")).arg(&blend));
    blend
}

fn export(blend: &Path, out: &Path, arguments: &str) -> String {
    let mut command = blender();
    command.arg(script("export_passes.py")).arg(blend).arg("--out").arg(out);
    run(command.args(arguments.split_whitespace()))
}

/// The three channels of a pass at a place of the test scene's floor, in world units.
fn at(set: &PassSet, pass: Pass, (x, y): (f32, f32)) -> [f32; 3] {
    let planes = set.get(pass).unwrap();
    // The frame shows 8 units across, centred on the origin.
    let unit = planes.width as f32 / 8.0;
    let column = (x * unit + planes.width as f32 / 2.0) as usize;
    let row = (planes.height as f32 / 2.0 - y * unit) as usize;
    std::array::from_fn(|c| planes.channel(c)[row * planes.width + column])
}

fn mean_luminance(set: &PassSet) -> f32 {
    let planes = set.get(Pass::Combined).unwrap();
    planes.data.iter().sum::<f32>() / planes.data.len() as f32
}

#[test]
fn exports_every_pass_with_the_averaged_position_and_resumes() {
    let folder = tempfile::tempdir().unwrap();
    let blend = make_scene(folder.path());
    let before = fs::read(&blend).unwrap();
    let out = folder.path().join("out");
    // 50% of 200x150 in the scene.
    let said = export(&blend, &out, "--spp 4,8 --ref-spp 64 --half-buffers");
    assert_eq!(said.lines().count(), 1, "one line a frame: {said}");
    assert_eq!(
        names_in(&out),
        [
            "shot_0004spp.exr",
            "shot_0004spp_a.exr",
            "shot_0004spp_b.exr",
            "shot_0008spp.exr",
            "shot_0008spp_a.exr",
            "shot_0008spp_b.exr",
            "shot_ref.exr"
        ]
    );
    assert_eq!(fs::read(&blend).unwrap(), before, "the scene is never saved");

    let pairs = testset::read(out.to_str().unwrap()).unwrap().pairs;
    assert_eq!(pairs.iter().map(|p| p.id()).collect::<Vec<_>>(), ["shot_0004spp", "shot_0008spp"]);

    let noisy = passes::load(out.join("shot_0004spp.exr"), None).unwrap();
    assert_eq!((noisy.width, noisy.height, noisy.view_layer.as_str()), (100, 75, "Main"));
    for pass in [
        Pass::Combined,
        Pass::Alpha,
        Pass::Normal,
        Pass::Position,
        Pass::DiffuseColor,
        Pass::GlossyColor,
        Pass::TransmissionColor,
        Pass::DenoisingNormal,
        Pass::DenoisingAlbedo,
    ] {
        assert!(noisy.get(pass).is_some(), "{pass}");
    }
    let stored: Vec<_> =
        Frame::read(out.join("shot_0004spp.exr")).unwrap().parts().iter().map(|p| p.name.clone()).collect();
    assert!(stored.iter().flatten().any(|name| name.ends_with("DEMC Position")), "{stored:?}");

    // What the camera sees, and at which height: see make_scene.py.
    for (place, height, what) in [
        ((0.0, 0.0), 0.0, "floor"),
        ((-2.0, -1.5), 1.0, "cube without a material"),
        ((2.0, -1.5), 0.0, "floor behind a clear leaf"),
        ((2.0, 1.5), 1.0, "card that a node group makes 0.9 opaque"),
        ((-2.0, 1.5), 0.0, "floor behind a card that it makes 0.3 opaque"),
    ] {
        let position = at(&noisy, Pass::Position, place);
        for (got, expected) in position.iter().zip([place.0, place.1, height]) {
            assert!((got - expected).abs() < 0.1, "{what}: {position:?}");
        }
    }

    let reference = passes::load(out.join("shot_ref.exr"), None).unwrap();
    assert_eq!((reference.width, reference.height), (100, 75));
    assert!(reference.get(Pass::Normal).is_none(), "references hold Combined alone");
    same_picture(&noisy, &reference);
    // Half buffers are noisy apart, and neither repeats the noisy frame.
    let [a, b] =
        ["a", "b"].map(|half| passes::load(out.join(format!("shot_0004spp_{half}.exr")), None).unwrap());
    assert_ne!(a.get(Pass::Combined), b.get(Pass::Combined));
    assert_ne!(a.get(Pass::Combined), noisy.get(Pass::Combined));

    // A finished file is left alone, a missing one is made again.
    let path = out.join("shot_0004spp.exr");
    let finished = fs::metadata(&path).unwrap().modified().unwrap();
    fs::remove_file(out.join("shot_0008spp.exr")).unwrap();
    let said = export(&blend, &out, "--spp 4,8 --ref-spp 64 --half-buffers");
    assert!(said.contains("4 spp is there") && said.contains("reference is there"), "{said}");
    assert_eq!(fs::metadata(&path).unwrap().modified().unwrap(), finished);
    assert!(out.join("shot_0008spp.exr").exists());
}

/// Noisy and clean frames show the same textures at the same places.
fn same_picture(noisy: &PassSet, reference: &PassSet) {
    let (a, b) = (noisy.get(Pass::Combined).unwrap(), reference.get(Pass::Combined).unwrap());
    let error = demc::metrics::error::relmse(a, b);
    assert!(error < 0.1, "RelMSE {error}");
    let (a, b) = (mean_luminance(noisy), mean_luminance(reference));
    assert!(b > 0.05 && (a / b - 1.0).abs() < 0.05, "mean {a} and {b}");
}

#[test]
fn exports_a_region_of_a_frame_range_and_puts_the_scene_back() {
    let folder = tempfile::tempdir().unwrap();
    let blend = make_scene(folder.path());
    let out = folder.path().join("out");
    let said = export(
        &blend,
        &out,
        "--frames 7-8 --spp 1 --ref-spp 2 --resolution 96x72 --region 60,54,30,18 --view-layer Second --name crop",
    );
    assert_eq!(said.lines().count(), 2, "{said}");
    assert_eq!(
        names_in(&out),
        ["crop_0001spp.0007.exr", "crop_0001spp.0008.exr", "crop_ref.0007.exr", "crop_ref.0008.exr"]
    );
    let crop = passes::load(out.join("crop_0001spp.0007.exr"), None).unwrap();
    assert_eq!((crop.width, crop.height, crop.view_layer.as_str()), (30, 18, "Second"));
    // Its first pixel is column 60, row 54 of the whole frame: 12 pixels a unit from the middle.
    let position: Vec<f32> = (0..2).map(|c| crop.get(Pass::Position).unwrap().channel(c)[0]).collect();
    assert!(
        (position[0] - 12.5 / 12.0).abs() < 0.06 && (position[1] + 18.5 / 12.0).abs() < 0.06,
        "{position:?}"
    );
    let next = passes::load(out.join("crop_0001spp.0008.exr"), None).unwrap();
    assert_ne!(crop.get(Pass::Combined), next.get(Pass::Combined), "noise differs from frame to frame");

    let said = run(blender()
        .arg(snippet("leaves_no_trace.py"))
        .arg(script(""))
        .arg(&blend)
        .arg("--out")
        .arg(folder.path().join("open"))
        .args("--vector --resolution 24x16 --region 2,2,8,8 --frames 3 --view-layer Main".split(' ')));
    assert!(said.lines().any(|line| line.trim() == "changed: []"), "{said}");
}

#[test]
fn names_what_is_wrong_in_one_line_and_fails() {
    let folder = tempfile::tempdir().unwrap();
    let blend = make_scene(folder.path());
    let missing = folder.path().join("missing.blend");
    for (scene, arguments, expected) in [
        (&missing, "", "no such file"),
        (&blend, "--view-layer Third", "it has Main, Second"),
        (&blend, "--region 90,0,20,20", "leaves the frame of 100x75"),
    ] {
        let mut command = blender();
        command.arg(script("export_passes.py")).arg(scene).arg("--out").arg(folder.path());
        let output = command.args(arguments.split_whitespace()).output().unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{stderr}");
        let errors: Vec<_> = stderr.lines().filter(|line| line.starts_with("error: ")).collect();
        assert!(errors.len() == 1 && errors[0].contains(expected), "{stderr}");
    }
    assert!(!names_in(folder.path()).iter().any(|name| name.ends_with(".exr")));
}

fn generate(out: &Path, arguments: &str) -> String {
    let mut command = blender();
    command.arg(script("generate_scenes.py")).arg("--out").arg(out);
    run(command.args(arguments.split_whitespace()))
}

#[test]
fn generates_the_same_pixels_for_the_same_seed() {
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (folder.path().join("first"), folder.path().join("second"));
    let arguments = "--seeds 3:5 --kinds materials,glass --size 40 --crops 2 --spp 2 --noisy-seeds 2 --ref-spp 16 --light-passes";
    let said = generate(&first, arguments);
    assert_eq!(said.lines().count(), 2, "a line a scene: {said}");
    generate(&second, arguments);
    let names = names_in(&first);
    assert_eq!(names, names_in(&second));
    let images: Vec<_> = names.iter().filter(|name| name.ends_with(".exr")).collect();
    assert_eq!(images.len(), 2 * 2 * 3, "{names:?}");
    for name in images {
        assert_eq!(fs::read(first.join(name)).unwrap(), fs::read(second.join(name)).unwrap(), "{name}");
    }

    // The folder holds a pair a crop; the manifest knows the second noisy render of each too.
    let pairs = testset::read(first.to_str().unwrap()).unwrap().pairs;
    assert_eq!(pairs.len(), 4);
    assert_eq!(testset::read(first.join("manifest.csv").to_str().unwrap()).unwrap().pairs.len(), 8);
    let mut lit = 0;
    for pair in &pairs {
        let noisy = passes::load(&pair.noisy, None).unwrap();
        let reference = passes::load(&pair.reference, None).unwrap();
        assert_eq!((noisy.width, noisy.height), (40, 40));
        assert!(noisy.get(Pass::Position).is_some() && noisy.get(Pass::DenoisingAlbedo).is_some());
        // What was rendered shows something, and both show the same.
        let (a, b) = (mean_luminance(&noisy), mean_luminance(&reference));
        assert!(b > 1e-3 && (0.4..2.5).contains(&(a / b)), "{}: mean {a} and {b}", pair.id());
        assert_eq!(noisy.get(Pass::Combined).unwrap().non_finite(), 0);
        // Diffuse light times its colour is part of the frame; half floats round each by 2^-11.
        let [combined, direct, indirect, colour] =
            [Pass::Combined, Pass::DiffuseDirect, Pass::DiffuseIndirect, Pass::DiffuseColor]
                .map(|pass| &noisy.get(pass).unwrap().data);
        let diffuse: Vec<f32> = direct
            .iter()
            .zip(indirect)
            .zip(colour)
            .map(|((direct, indirect), c)| (direct + indirect) * c)
            .collect();
        let is_part = |(part, whole): (&f32, &f32)| *part <= 1.01 * whole + 1e-3;
        assert!(diffuse.iter().zip(combined).all(is_part), "{}", pair.id());
        lit += diffuse.iter().filter(|light| **light > 0.01).count();
        assert!(noisy.get(Pass::Emission).is_some() && noisy.get(Pass::Environment).is_some());
    }
    assert!(lit > 1000, "{lit} values have diffuse light");

    let said = generate(&first, arguments);
    assert!(said.lines().all(|line| line.ends_with("is there")), "{said}");
    let stop = folder.path().join("stop");
    fs::write(&stop, "").unwrap();
    let said = generate(&first, &format!("--seeds 9 --stop-file {}", stop.display()));
    assert!(said.starts_with("stopped"), "{said}");
}

#[test]
fn crops_may_be_drawn_evenly_and_have_blue_noise() {
    let folder = tempfile::tempdir().unwrap();
    let made = |name: &str, more: &str| {
        let out = folder.path().join(name);
        let arguments =
            "--seeds 3:6 --kinds materials --size 40 --crops 2 --spp 2 --noisy-seeds 2 --ref-spp 4";
        generate(&out, &format!("{arguments} {more}"));
        let table = fs::read_to_string(out.join("views.csv")).unwrap();
        let rows: Vec<Vec<String>> =
            table.lines().skip(1).map(|line| line.split(',').map(str::to_owned).collect()).collect();
        (out, rows)
    };
    let ((white, of_white), (blue, of_blue)) = (made("white", ""), made("blue", "--blue-share 1"));
    assert_eq!((of_white.len(), of_blue.len()), (6 * 3, 6 * 2), "one seed of blue noise is enough");
    for row in &of_blue {
        let [white, blue] = [&white, &blue].map(|folder| fs::read(folder.join(&row[6])).unwrap());
        let is_reference = row[8] == "reference";
        assert_eq!(white == blue, is_reference, "{row:?}");
        assert_eq!(row[12] == "blue", !is_reference, "{row:?}");
    }
    // Other places are looked at where crops need not show much.
    let (_, of_plain) = made("plain", "--plain-share 1");
    let places = |rows: &[Vec<String>]| -> Vec<String> { rows.iter().map(|row| row[4].clone()).collect() };
    assert_ne!(places(&of_white), places(&of_plain));
}

#[test]
fn renders_sequences_whose_vectors_lead_to_the_frames_around() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    generate(&out, "--seeds 30:33 --kinds materials --sequence 3 --size 64 --spp 16 --ref-spp 16");
    let pairs = testset::read(out.join("manifest.csv").to_str().unwrap()).unwrap().pairs;
    assert_eq!(pairs.len(), 3, "the middle frame of each has a reference");
    let (mut along, mut in_place) = (0.0, 0.0);
    for pair in pairs {
        assert_eq!(pair.frame.as_deref(), Some("0002"));
        let frames = [1, 2, 3].map(|frame| {
            passes::load(out.join(format!("{}_0016spp.{frame:04}.exr", pair.scene)), None).unwrap()
        });
        let albedos = frames.each_ref().map(|set| set.get(Pass::DenoisingAlbedo).unwrap());
        let vectors = frames[1].get(Pass::Vector).unwrap();
        for (neighbour, direction) in [(0, Direction::Back), (2, Direction::Forth)] {
            let mut flow = Flow::still(64, 64);
            flow.step(vectors, direction);
            let there = flow.bilinear(albedos[neighbour]);
            let own = &albedos[1].data;
            for ((own, there), unmoved) in own.iter().zip(&there.data).zip(&albedos[neighbour].data) {
                if !there.is_nan() {
                    along += (own - there).abs();
                    in_place += (own - unmoved).abs();
                }
            }
        }
    }
    assert!(along < 0.7 * in_place, "albedos differ by {along} along vectors, {in_place} in place");
    let all = folder.path().join("all");
    generate(
        &all,
        "--seeds 30 --kinds materials --sequence 3 --all-references --size 32 --spp 16 --ref-spp 16",
    );
    let pairs = testset::read(all.join("manifest.csv").to_str().unwrap()).unwrap().pairs;
    let frames: Vec<_> = pairs.iter().filter_map(|pair| pair.frame.as_deref()).collect();
    assert_eq!(frames, ["0001", "0002", "0003"]);
    for pair in &pairs {
        let reference = pair.reference.to_str().unwrap();
        assert!(
            reference.ends_with(&format!("{}.exr", pair.frame.as_deref().unwrap()))
                && pair.reference.exists()
        );
    }
    // Two frames have no middle one.
    let mut command = blender();
    let arguments = ["--out", "x", "--seeds", "1", "--sequence", "2"];
    let output = command.arg(script("generate_scenes.py")).args(arguments).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success() && said.contains("--sequence must be odd"), "{said}");
}

#[test]
fn draws_sample_counts_and_says_what_each_file_cost() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    generate(
        &out,
        "--seeds 13:15 --kinds embossed --size 32 --spp 1,2,4,8,16,32 --draw-spp 2 --noisy-seeds 2 --means --ref-spp 64 \
         --denoise-references --clean-share 0.5 --clean-spp 520 --filter-share 1",
    );
    let pairs = testset::read(out.join("manifest.csv").to_str().unwrap()).unwrap().pairs;
    let table = fs::read_to_string(out.join("views.csv")).unwrap();
    let rows: Vec<Vec<_>> = table.lines().skip(1).map(|line| line.split(',').collect()).collect();
    let mut kinds_of_reference = Vec::new();
    for seed in ["13", "14"] {
        let scene = format!("s00{seed}_embossed");
        let of_view: Vec<_> = rows.iter().filter(|row| row[0] == scene).collect();
        // Two counts, each by two seeds and their mean, and the reference.
        assert_eq!(of_view.len(), 2 * 3 + 1, "{table}");
        let reference = of_view.iter().find(|row| row[6].ends_with("_ref.exr")).unwrap();
        kinds_of_reference.push(reference[8]);
        let counts: Vec<u32> =
            of_view.iter().filter(|row| row[8] == "0").map(|row| row[7].parse().unwrap()).collect();
        // A mean of two has twice the samples, and must still have no more than an eighth of the reference's.
        let most = if reference[8] == "clean" { 32 } else { 64 / 8 / 2 };
        assert!(counts[0] < counts[1] && counts[1] <= most, "{} reference: {counts:?}", reference[8]);
        for row in &of_view {
            assert_eq!((row[1], row[2]), ("embossed", seed), "{row:?}");
            assert!(row[8] == "mean" || row[9].parse::<f64>().unwrap() > 0.0, "it took time: {row:?}");
            assert!(row[5] == of_view[0][5] && row[5] != "blackman-harris 1.50", "{row:?}");
        }
        let load = |file: &str| passes::load(out.join(file), None).unwrap();
        let mean_row = of_view.iter().find(|row| row[8] == "mean").unwrap();
        let single: u32 = mean_row[7].parse::<u32>().unwrap() / 2;
        let mean = load(mean_row[6]);
        let [first, second] = ["", "_n1"].map(|n| load(&format!("{scene}_{single:04}spp{n}.exr")));
        assert_ne!(first.get(Pass::Combined), second.get(Pass::Combined), "every seed has noise of its own");
        for pass in [Pass::Combined, Pass::DenoisingAlbedo] {
            let [mean, first, second] = [&mean, &first, &second].map(|set| set.get(pass).unwrap());
            for ((m, a), b) in mean.data.iter().zip(&first.data).zip(&second.data) {
                assert!((m - (a + b) / 2.0).abs() <= 1e-3 * m.abs().max(1e-3), "{pass}: {m} of {a} and {b}");
            }
        }
        let reference = load(reference[6]);
        for pass in [Pass::DenoisingAlbedo, Pass::DenoisingNormal] {
            assert!(reference.get(pass).is_some(), "references keep {pass}");
        }
        assert_eq!(pairs.iter().filter(|pair| pair.scene.starts_with(&scene)).count(), 2 * 3);
    }
    kinds_of_reference.sort_unstable();
    assert_eq!(kinds_of_reference, ["clean", "reference"], "half of the references are clean");

    let check = |folder: &Path| {
        let mut command = blender();
        command.arg(script("generate_scenes.py")).arg("--out").arg(folder).arg("--check");
        command
    };
    assert!(run(&mut check(&out)).contains("14 of 14 files are as listed"));
    fs::write(out.join(rows[0][6]), "damaged").unwrap();
    fs::remove_file(out.join(rows[1][6])).unwrap();
    let said = run_with_failures(&mut check(&out));
    assert!(said.contains("is not what views.csv lists") && said.contains("is missing"), "{said}");
    assert!(said.contains("12 of 14 files are as listed"), "{said}");
}

#[test]
fn keeps_the_seeds_of_the_development_set_out_of_training() {
    let folder = tempfile::tempdir().unwrap();
    for (seeds, expected) in [
        ("--seeds 8999999:9000001", "the seeds 9000000:10000000 are kept"),
        ("--seeds 9999999", "the seeds 9000000:10000000 are kept"),
        ("", "--seeds is missing"),
    ] {
        let mut command = blender();
        command.arg(script("generate_scenes.py")).arg("--out").arg(folder.path());
        let output = command.args(seeds.split_whitespace()).output().unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{seeds}: {stderr}");
        assert!(stderr.contains(expected), "{seeds}: {stderr}");
    }
    // On the border, outside.
    let stop = folder.path().join("stop");
    fs::write(&stop, "").unwrap();
    for seeds in ["8999999", "10000000", "9000000 --development-seeds"] {
        let said = generate(folder.path(), &format!("--seeds {seeds} --stop-file {}", stop.display()));
        assert!(said.starts_with("stopped"), "{seeds}: {said}");
    }
}

#[test]
fn renders_views_of_the_development_set_once() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("set");
    let render = |more: &str| {
        let mut command = blender();
        command.arg(script("development_set.py")).arg("--out").arg(&out);
        run(command.args(more.split_whitespace()))
    };
    let said = render("--views dev08_embossed,dev12_cutout --spp 1,2");
    assert_eq!(said.lines().count(), 2, "a line a view: {said}");
    let frame = |name: &str| passes::load(out.join(name), None).unwrap();
    let (crop, cutout) = (frame("dev08_embossed_0001spp.exr"), frame("dev12_cutout_0002spp.exr"));
    for frame in [&crop, &cutout] {
        assert_eq!((frame.width, frame.height), (240, 135));
        for pass in
            [Pass::Combined, Pass::Alpha, Pass::DenoisingAlbedo, Pass::DenoisingNormal, Pass::Position]
        {
            assert!(frame.get(pass).is_some(), "{pass}");
        }
    }
    let alpha = cutout.get(Pass::Alpha).unwrap();
    let clear = alpha.data.iter().filter(|a| **a == 0.0).count();
    assert!(clear > 1000 && clear < alpha.data.len() - 1000, "{clear} clear pixels");
    assert_ne!(
        crop.get(Pass::Combined),
        frame("dev08_embossed_0002spp.exr").get(Pass::Combined),
        "no two frames share their noise"
    );
    // A frame without its row, as a killed run leaves it, is rendered again; the others are not.
    let table = fs::read_to_string(out.join("views.csv")).unwrap();
    let (kept, last) = table.trim_end().rsplit_once('\n').unwrap();
    fs::write(out.join("views.csv"), format!("{kept}\n")).unwrap();
    let said = render("--views dev08_embossed,dev12_cutout --spp 1,2");
    assert!(said.lines().count() == 1 && said.starts_with("dev12_cutout: 1 frames, 0 parts"), "{said}");
    let again = fs::read_to_string(out.join("views.csv")).unwrap();
    let hash = |row: &str| row.split(',').nth(11).unwrap().to_owned();
    assert_eq!(hash(last).len(), 64, "{last}");
    assert_eq!(hash(again.trim_end().lines().last().unwrap()), hash(last), "the same pixels");
    assert!(render("--check").contains("4 of 4 files are as listed"));
    let assets = folder.path().join("assets");
    let texture = assets.join("textures/metal_sheet");
    fs::create_dir_all(&texture).unwrap();
    let image = Path::new(env!("CARGO_MANIFEST_DIR")).join("eval/example/sheet.png");
    fs::copy(image, texture.join("color.png")).unwrap();
    fs::write(
        assets.join("images.tsv"),
        "name\tkind\tauthor\tlicence\nmetal_sheet\tmetal\tSomebody\tCC-BY-4.0\nunused\tleaf\tNobody\tCC0\n",
    )
    .unwrap();
    render(&format!("--credits --views dev44_screens,dev27_screens --assets {}", assets.display()));
    let credits = fs::read_to_string(out.join("credits.csv")).unwrap();
    assert!(
        credits.starts_with("asset,author,licence,views\nmetal_sheet,Somebody,CC-BY-4.0,dev"),
        "{credits}"
    );
    assert_eq!(credits.lines().count(), 2, "what no view shows is not named: {credits}");
}

#[test]
fn references_of_the_development_set_share_no_sample_with_what_they_judge() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("set");
    let said = run(blender().arg(snippet("join_references.py")).arg(script("")).arg(&out));
    let rows: Vec<Vec<_>> = said
        .lines()
        .filter_map(|line| line.strip_prefix("REFERENCE "))
        .map(|line| line.split(' ').collect())
        .collect();
    // Two parts; four parts beside the defaults, which weigh as much as they; four parts alone.
    for (row, (sources, seconds, noise)) in rows.iter().zip([
        ("ab", "20.0", 0.01 / 2.0),
        ("abcd+", "50.0", (0.01 / 4.0 + 0.0025) / 4.0),
        ("abcd", "40.0", 0.01 / 4.0),
    ]) {
        assert_eq!((row[1], row[2]), (sources, seconds), "{said}");
        assert_eq!(row[5], "1000000.0", "what the defaults cut off is not averaged: {said}");
        for figure in &row[3..5] {
            let relmse: f64 = figure.parse().unwrap();
            assert!(
                (relmse / (noise / 0.251) - 1.0).abs() < 0.08,
                "{sources}: {relmse}, expected {}",
                noise / 0.251
            );
        }
    }
    assert_eq!(rows.len(), 3, "{said}");
    assert!(rows[2][0].ends_with("_adaptive_ref.exr"), "the defaults are judged by parts alone: {said}");
    let mut pairs = testset::read(out.join("manifest.csv").to_str().unwrap()).unwrap().pairs;
    pairs.sort_by_key(|pair| pair.spp);
    let names = pairs.iter().map(|pair| pair.reference.file_name().unwrap().to_str().unwrap());
    assert_eq!(names.collect::<Vec<_>>(), [rows[1][0], rows[2][0]]);
}

#[test]
fn makes_hard_cases_of_a_pair() {
    let folder = tempfile::tempdir().unwrap();
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("eval/example");
    let (noisy, reference) = (example.join("house_0004spp.exr"), example.join("house_ref.exr"));
    let make = |from: &Path| {
        let mut command = blender();
        command.arg(script("make_cases.py")).arg(from).arg(&reference).arg("--out").arg(folder.path());
        command
    };
    run(&mut make(&noisy));
    let pairs = testset::read(folder.path().to_str().unwrap()).unwrap().pairs;
    let scenes: Vec<_> = pairs.iter().map(|pair| pair.scene.as_str()).collect();
    assert_eq!(
        scenes,
        ["black", "border", "identity", "inf_disc", "nan_pixels", "other_guides", "rolled"],
        "a pair a case"
    );
    let load = |name: &str| passes::load(folder.path().join(name), None).unwrap();
    let source = passes::load(&noisy, None).unwrap();
    let clean = passes::load(&reference, None).unwrap();
    let light = |set: &PassSet| set.get(Pass::Combined).unwrap().clone();
    assert_eq!(light(&load("identity_0004spp.exr")), light(&clean));
    assert!(light(&load("black_0004spp.exr")).data.iter().all(|value| *value == 0.0));

    // A disc of 12 pixels across has some 113 pixels, in three channels.
    let infinite = light(&load("inf_disc_0004spp.exr")).data.iter().filter(|v| **v == f32::INFINITY).count();
    let brightest = light(&load("inf_disc_ref.exr")).data.iter().filter(|v| **v == 65504.0).count();
    assert!(infinite == brightest && (300..360).contains(&infinite), "{infinite} and {brightest}");
    let holes = light(&load("nan_pixels_0004spp.exr"));
    let share = holes.data.iter().filter(|v| v.is_nan()).count() as f64 / holes.data.len() as f64;
    assert!((share - 0.01).abs() < 0.002, "{share}");
    assert_eq!(light(&load("nan_pixels_ref.exr")), light(&clean));

    let (width, height) = (source.width, source.height);
    let cut = load("border_0004spp.exr");
    assert_eq!((cut.width, cut.height), (width - 2 * (width / 4), height - 2 * (height / 4)));
    let value = |set: &PassSet, pass, x, y| set.get(pass).unwrap().channel(0)[y * set.width + x];
    for pass in [Pass::Combined, Pass::DenoisingNormal] {
        assert_eq!(value(&cut, pass, 0, 0), value(&source, pass, width / 4, height / 4), "{pass}");
        let (whole, half) =
            (value(&source, pass, 3, 5), value(&load("rolled_0004spp.exr"), pass, 3 + width / 2, 5));
        assert_eq!(half, whole, "{pass}");
    }
    let other = load("other_guides_0004spp.exr");
    assert_eq!(light(&other), light(&source));
    let albedo = |set, x| value(set, Pass::DenoisingAlbedo, x, 60);
    assert_eq!(albedo(&other, 100 + width / 5), albedo(&source, 100));

    let output = make(&reference).output().unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert!(
        output.status.code() == Some(2) && stderr.contains("is not named <scene>_<spp>spp.exr"),
        "{stderr}"
    );
    let bare = folder.path().join("bare_0004spp.exr");
    fs::copy(&reference, &bare).unwrap();
    let output = make(&bare).output().unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.code() == Some(2) && stderr.contains("has no Denoising Albedo"), "{stderr}");
}

#[test]
fn renders_a_hard_scene_beside_its_control_once() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("hard");
    let render = |more: &str| {
        let mut command = blender();
        command.arg(script("hard_scenes.py")).arg("--out").arg(&out);
        run(command.args(more.split_whitespace()))
    };
    let arguments = "--cases text --spp 1 --seeds 2 --size 32x20 --ref-spp 8";
    let said = render(arguments);
    assert_eq!(said.lines().count(), 2, "a line a scene: {said}");
    assert_eq!(
        fs::read_to_string(out.join("manifest.csv")).unwrap(),
        "scene,noisy,reference,spp\n\
         text,text_0001spp.exr,text_ref.exr,1\n\
         text,text_0001spp_n1.exr,text_ref.exr,1\n\
         text_control,text_control_0001spp.exr,text_control_ref.exr,1\n\
         text_control,text_control_0001spp_n1.exr,text_control_ref.exr,1\n"
    );
    let pairs = testset::read(out.join("manifest.csv").to_str().unwrap()).unwrap().pairs;
    assert_eq!(pairs.len(), 4);
    let load = |name: &str| passes::load(out.join(name), None).unwrap();
    let [noisy, again, control] =
        ["text_0001spp.exr", "text_0001spp_n1.exr", "text_control_0001spp.exr"].map(load);
    assert_eq!((noisy.width, noisy.height), (32, 20));
    for pass in [Pass::Combined, Pass::Alpha, Pass::DenoisingAlbedo, Pass::DenoisingNormal, Pass::Position] {
        assert!(noisy.get(pass).is_some(), "{pass}");
    }
    assert_ne!(noisy.get(Pass::Combined), again.get(Pass::Combined), "every seed has noise of its own");
    assert_ne!(noisy.get(Pass::DenoisingAlbedo), control.get(Pass::DenoisingAlbedo), "an empty page");
    assert!(load("text_ref.exr").get(Pass::DenoisingAlbedo).is_some(), "references have guides");
    assert_eq!(render(arguments), "", "nothing is missing");
    assert!(render("--check").contains("10 of 10 files are as listed"));
    let cases = run(blender().arg(script("hard_scenes.py")).arg("--list"));
    assert_eq!(cases.lines().count(), 26, "{cases}");
}

#[test]
fn guides_alone_are_the_guides_of_whole_renders() {
    let folder = tempfile::tempdir().unwrap();
    let load = |kind: &str, more: &str| {
        let out = folder.path().join(format!("{kind}{more}"));
        let arguments = format!("--seeds 7:8 --kinds {kind} --size 40 --ref-spp 8 --ref-noise 0 {more}");
        generate(&out, &arguments);
        let [pair] =
            testset::read(out.to_str().unwrap()).unwrap().pairs.try_into().expect("one crop is one pair");
        [&pair.noisy, &pair.reference].map(|path| passes::load(path, None).unwrap())
    };
    for kind in ["glass", "materials"] {
        let ([noisy, _], [alone, reference]) = (load(kind, ""), load(kind, "--guides-only"));
        assert_ne!(noisy.get(Pass::Combined), alone.get(Pass::Combined), "{kind}: light ends early");
        for pass in [Pass::DenoisingAlbedo, Pass::DenoisingNormal] {
            let [whole, alone] = [&noisy, &alone].map(|frame| frame.require(pass, "the test").unwrap());
            // A sample that is split between a mirror and something rough may go on as either.
            let differing = whole.data.iter().zip(&alone.data).filter(|(a, b)| a != b).count();
            assert!(differing * 100 < whole.data.len(), "{kind}: {differing} values of {pass} differ");
            assert!(reference.get(pass).is_some(), "{kind}: the reference keeps its guides");
        }
    }
}

#[test]
fn builds_every_kind_of_scene_without_assets() {
    let said = run(blender().arg(snippet("every_kind.py")).arg(script("")));
    let kinds: Vec<_> = said.lines().filter_map(|line| line.strip_prefix("KIND ")).collect();
    assert_eq!(kinds.len(), 24, "{said}");
    for kind in kinds {
        let meshes: usize = kind.rsplit(' ').next().unwrap().parse().unwrap();
        assert!(meshes >= 3, "{kind}");
    }
}

#[test]
fn makes_assets_of_furniture_libraries_and_of_images() {
    let folder = tempfile::tempdir().unwrap();
    run(blender().arg(snippet("make_furniture.py")).arg(folder.path()));
    let [furniture, textures] = ["furniture", "textures"].map(|name| folder.path().join(name));
    let import = |name: &str, out: &Path, from: &str| {
        run_with_failures(blender().arg(script(name)).arg("--out").arg(out).arg(folder.path().join(from)))
    };
    let said = import("import_furniture.py", &furniture, "library.sh3f");
    assert!(said.contains("test_maker_nothing: left out"), "{said}");
    assert!(
        said.contains("/test/flat.obj: left out") && said.contains("library.sh3f has no depth"),
        "{said}"
    );
    assert!(said.contains("1 models in") && said.contains("2 left out"), "{said}");
    let said = import("import_textures.py", &textures, "images");
    assert!(said.contains("brick_broken.jpg: left out"), "{said}");
    assert!(said.contains("1 textures in") && said.contains("2 of fitting names left out"), "{said}");

    let said = run(blender().arg(snippet("use_assets.py")).arg(script("")).arg(&furniture).arg(&textures));
    let table = "MODEL test_maker_lowtable table 1.20 0.60 0.45 from 0.00: solid clear";
    assert!(said.contains(table) && said.contains("TEXTURE brick 1 512"), "{said}");
    let index = fs::read_to_string(furniture.join("models.tsv")).unwrap();
    assert!(index.contains("test_maker_lowtable\tfurniture\t1.2\tTest library\tSomebody\tCC0"), "{index}");
}

#[test]
fn makes_scenes_of_tracks() {
    let folder = tempfile::tempdir().unwrap();
    let (data, out) = (folder.path().join("data"), folder.path().join("tracks"));
    run(blender().arg(snippet("make_track.py")).arg(&data));
    let said = run_with_failures(blender().arg(script("import_tracks.py")).arg("--out").arg(&out).arg(&data));
    assert!(said.contains("broken: left out") && said.contains("is no mesh of version 1"), "{said}");
    assert!(said.contains("1 tracks in") && said.contains("1 left out"), "{said}");
    let said = run(blender().arg(snippet("use_track.py")).arg(out.join("yard.blend")));
    let meshes: Vec<_> = said.lines().filter(|line| line.starts_with("MESH")).collect();
    // Two of the three walls, as the third only glows; what only stops karts is not there.
    assert_eq!(meshes.len(), 2, "{said}");
    let first = "MESH 4 -20.0 -20.0 0.0 20.0 20.0 8.0 (1.0, 0.5, 0.0, 1.0) ['wall.png']";
    assert!(meshes.contains(&first), "{said}");
    // Turned a quarter, twice as high, and moved.
    assert!(meshes.iter().any(|mesh| mesh.starts_with("MESH 4 -20.0 70.0 0.0 20.0 110.0 16.0")), "{said}");
    assert!(said.contains("LIGHT POINT (3.0, 4.0, 3.0) (1.0, 0.0, 0.0)"), "{said}");
    assert!(said.contains("LIGHT SUN") && said.contains("CAMERAS 24"), "{said}");
}
