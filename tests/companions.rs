//! Layers that are denoised along with the beauty, on a render that Cycles makes here: what light passes add
//! up to, and alpha.

mod common;

use std::{
    path::{Path, PathBuf},
    process::Command,
    sync::LazyLock,
};

use common::{
    files::{read_exr, values, write_render},
    python::{self, run},
    shot::{SHOT, Shot, random, write_channels},
};
use demc::passes::{self, Pass, PassSet};
use exr::prelude::{AnyChannel, FlatSamples};
use predicates::{prelude::*, str::contains};
use tempfile::TempDir;

/// A folder with renders of one scene with all light passes: before a sky, and before nothing of 4, 64 and 256
/// samples.
static RENDERS: LazyLock<TempDir> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/blender_data/light_passes.py");
    let all = [
        ("sky", &["4"][..]),
        ("film", &["4", "film"]),
        ("many", &["64", "film"]),
        ("clean", &["256", "film"]),
    ];
    for (name, options) in all {
        let path = folder.path().join(format!("{name}.exr"));
        run(Command::new(python::python()).arg(&script).arg(path).args(options));
    }
    folder
});

fn render(name: &str) -> PathBuf {
    RENDERS.path().join(name)
}

fn denoise(name: &str, out: &Path, arguments: &str) -> PathBuf {
    let mut command = common::demc();
    command.arg("denoise").arg(render(name)).arg("--out").arg(out);
    command.args(arguments.split_whitespace()).assert().success();
    out.join(name)
}

/// Three channels of a layer of the result, one after the other.
fn layer(path: &Path, name: &str) -> Vec<f32> {
    let frame = demc::frame::Frame::read(path).unwrap();
    let parts = frame.parts();
    let find = |c: &str| {
        let full = format!("ViewLayer.{name}.{c}");
        let at = |part: &demc::frame::Part| part.channels.iter().position(|channel| channel.name == full);
        parts
            .iter()
            .enumerate()
            .find_map(|(p, part)| Some((p, at(part)?)))
            .unwrap_or_else(|| panic!("{full}"))
    };
    let read = |c: &str| {
        let (part, channel) = find(c);
        frame.decode(part, &[&[channel]]).unwrap().remove(0).to_vec()
    };
    ["R", "G", "B"].map(read).concat()
}

/// What Cycles makes Combined of, of layers by these names: an environment that a transparent film does not
/// show is no part.
fn sum_of_passes(name: &str, read: impl Fn(&str) -> Vec<f32>) -> Vec<f32> {
    let mut sum = vec![0.0; read("Emission").len()];
    for kind in ["Diffuse", "Glossy", "Transmission"] {
        let [direct, indirect, colour] =
            ["Direct", "Indirect", "Color"].map(|part| read(&format!("{kind} {part}")));
        for (i, sum) in sum.iter_mut().enumerate() {
            *sum += (direct[i] + indirect[i]) * colour[i];
        }
    }
    let environment = (name == "sky.exr").then_some("Environment");
    for pass in ["Volume Direct", "Volume Indirect", "Emission"].into_iter().chain(environment) {
        sum.iter_mut().zip(read(pass)).for_each(|(sum, light)| *sum += light);
    }
    sum
}

#[track_caller]
fn assert_adds_up(sum: &[f32], whole: &[f32], what: &str) {
    for (i, (sum, whole)) in sum.iter().zip(whole).enumerate() {
        assert!((sum - whole).abs() <= 1e-3 * whole.abs() + 1e-6, "{what}, value {i}: {sum} for {whole}");
    }
}

#[test]
fn light_passes_and_light_groups_add_up_to_the_denoised_beauty() {
    let out = tempfile::tempdir().unwrap();
    for name in ["sky.exr", "film.exr"] {
        let rendered = layer(&render(name), "Combined");
        assert_adds_up(&sum_of_passes(name, |pass| layer(&render(name), pass)), &rendered, "Cycles' own sum");
        for model in ["demc-s", "demc-m:f32", "demc-l"] {
            let what = format!("{model} on {name}");
            let done = denoise(name, out.path(), &format!("--model {model} --passes --overwrite"));
            let beauty = layer(&done, "Denoised");
            assert!(beauty != rendered, "{what} did something");
            assert_adds_up(
                &sum_of_passes(name, |pass| layer(&done, &format!("{pass}.Denoised"))),
                &beauty,
                &what,
            );
            // The beauty is what it is without them.
            let alone = tempfile::tempdir().unwrap();
            let alone = denoise(name, alone.path(), &format!("--model {model}"));
            assert_eq!(beauty, layer(&alone, "Denoised"), "{what}");
            if name == "film.exr" {
                let [kept, sky] = ["Environment.Denoised", "Environment"].map(|name| layer(&done, name));
                assert_eq!(kept, sky, "the film does not show the sky: nothing is known of it, {what}");
                continue; // the world's group holds the sky, which the film does not show
            }
            let [mut groups, rest] = ["Key", "Rest"].map(|g| layer(&done, &format!("Combined_{g}.Denoised")));
            groups.iter_mut().zip(rest).for_each(|(sum, light)| *sum += light);
            assert_adds_up(&groups, &beauty, &format!("light groups, {what}"));
        }
    }
}

#[test]
fn light_passes_add_up_around_pixels_below_zero() {
    let folder = tempfile::tempdir().unwrap();
    let mut frame = demc::frame::Frame::read(render("sky.exr")).unwrap();
    let part =
        frame.parts().iter().position(|part| part.channels.iter().any(|c| c.name.contains(".Combined.R")));
    let part = part.unwrap();
    let channel = |c: &str| {
        let full = format!("ViewLayer.Combined.{c}");
        frame.parts()[part].channels.iter().position(|channel| channel.name == full).unwrap()
    };
    let channels = ["R", "G", "B"].map(channel);
    let below = channels.map(|channel| {
        let mut values = frame.decode(part, &[&[channel]]).unwrap().remove(0).to_vec();
        [700, 701, 1500].into_iter().for_each(|at| values[at] = -values[at].abs() - 0.1);
        values
    });
    let changed: Vec<(usize, &[f32])> = channels.into_iter().zip(below.iter().map(Vec::as_slice)).collect();
    frame.replace(part, "ViewLayer.Combined", &changed).unwrap();
    let input = folder.path().join("sky.exr");
    frame.write(&input).unwrap();
    let mut command = common::demc();
    command.arg("denoise").arg(&input).arg("--out").arg(folder.path().join("out"));
    let said = command.args(["--model", "demc-m", "--passes"]).assert().success();
    said.stderr(
        contains("Combined is below zero in 3 of the pixels").and(contains("already denoised by demc")),
    );
    let done = folder.path().join("out/sky.exr");
    assert_adds_up(
        &sum_of_passes("sky.exr", |pass| layer(&done, &format!("{pass}.Denoised"))),
        &layer(&done, "Denoised"),
        "around pixels below zero",
    );
}

#[test]
fn light_passes_do_not_outlive_the_result_that_they_add_up_to() {
    let out = tempfile::tempdir().unwrap();
    let done = denoise("sky.exr", out.path(), "--model demc-s --passes");
    let again = |arguments: &str| {
        let mut command = common::demc();
        command.arg("denoise").arg(&done).arg("--out").arg(out.path().join("again"));
        command.args(arguments.split_whitespace()).assert()
    };
    again("--model demc-m").code(1).stderr(contains("belongs to the result that would be replaced"));
    again("--model demc-m --layer Other").success();
    again("--model demc-m --passes --overwrite").success();
}

#[test]
fn replaced_light_passes_do_not_outlive_their_beauty_either() {
    let out = tempfile::tempdir().unwrap();
    let both = denoise("sky.exr", &out.path().join("both"), "--model demc-s --passes --replace");
    let beauty = denoise("sky.exr", &out.path().join("beauty"), "--model demc-s --replace");
    let again = |input: &Path, arguments: &str| {
        let mut command = common::demc();
        command.args(["denoise", "--overwrite"]).arg(input).arg("--out").arg(out.path().join("again"));
        command.args(arguments.split_whitespace()).assert()
    };
    again(&both, "--model demc-s --replace")
        .code(1)
        .stderr(contains("belongs to the result that would be replaced"));
    again(&both, "--model demc-s --replace --passes").success().stderr(contains("as rendered").not());
    again(&beauty, "--model demc-s --replace").success().stderr(contains("as rendered").not());
    for how in ["--model demc-s --passes", "--model demc-s --passes --replace"] {
        again(&beauty, how).success().stderr(contains("its light passes are as rendered"));
    }
}

#[test]
fn light_passes_are_replaced_where_the_beauty_is() {
    let out = tempfile::tempdir().unwrap();
    let added = layer(&denoise("sky.exr", out.path(), "--model demc-s --passes"), "Glossy Direct.Denoised");
    let done = denoise("sky.exr", out.path(), "--model demc-s --passes --replace --overwrite");
    assert_adds_up(
        &sum_of_passes("sky.exr", |pass| layer(&done, pass)),
        &layer(&done, "Combined"),
        "replaced",
    );
    assert_eq!(layer(&done, "Glossy Direct"), added);
    assert_eq!(layer(&done, "Denoising Albedo"), layer(&render("sky.exr"), "Denoising Albedo"));
}

#[test]
fn layers_go_along_around_the_seam_of_a_panorama() {
    let out = tempfile::tempdir().unwrap();
    for (name, how) in [
        ("sky.exr", "--model demc-s --passes"),
        ("film.exr", "--model demc-s"),
        ("film.exr", "--model demc-l --passes"),
    ] {
        let done = denoise(name, out.path(), &format!("{how} --wrap x --overwrite"));
        let beauty = layer(&done, "Denoised");
        assert!(beauty.iter().all(|v| v.is_finite()));
        if name == "sky.exr" {
            assert_adds_up(
                &sum_of_passes(name, |pass| layer(&done, &format!("{pass}.Denoised"))),
                &beauty,
                "around the seam",
            );
        }
    }
}

#[test]
fn a_result_without_light_passes_is_not_taken_for_one_with_them() {
    let out = tempfile::tempdir().unwrap();
    denoise("sky.exr", out.path(), "--model demc-s");
    let again = |arguments: &str| {
        let mut command = common::demc();
        command.arg("denoise").arg(render("sky.exr")).arg("--out").arg(out.path());
        command.args(arguments.split_whitespace()).assert()
    };
    again("--model demc-s --passes").code(1).stderr(contains("without denoised light passes"));
    again("--model demc-s --passes --overwrite").success();
    again("--model demc-s --passes").success();
    again("--model noisy --passes --overwrite").code(2).stderr(contains("takes demc-s, demc-m or demc-l"));
}

fn over_white(set: &PassSet, pass: (&[f32], &[f32])) -> Vec<f32> {
    let (light, alpha) = pass;
    let pixels = set.width * set.height;
    light.iter().enumerate().map(|(i, light)| light + 1.0 - alpha[i % pixels]).collect()
}

#[test]
fn alpha_is_denoised_with_the_beauty_and_fits_it_over_any_background() {
    let out = tempfile::tempdir().unwrap();
    let noisy = passes::load(render("film.exr"), None).unwrap();
    let clean = passes::load(render("clean.exr"), None).unwrap();
    let of = |set: &PassSet, pass| set.get(pass).unwrap().data.to_vec();
    let truth = of(&clean, Pass::Alpha);
    let reference = over_white(&clean, (&of(&clean, Pass::Combined), &truth));
    let error = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f32>();
    for model in ["demc-s", "demc-m", "demc-l"] {
        let read = |how: &str| {
            let arguments = format!("--model {model} --alpha {how} --overwrite --replace");
            passes::load(denoise("film.exr", out.path(), &arguments), None).unwrap()
        };
        let (kept, denoised) = (read("keep"), read("auto"));
        assert_eq!(of(&kept, Pass::Alpha), of(&noisy, Pass::Alpha), "{model}");
        let alpha = of(&denoised, Pass::Alpha);
        let colours = of(&denoised, Pass::Combined);
        assert_eq!(of(&kept, Pass::Combined), colours, "{model}: colours are the same");
        assert!(alpha.iter().all(|v| (0.0..=1.0).contains(v)));
        let [before, after] = [of(&noisy, Pass::Alpha), alpha.clone()].map(|alpha| error(&alpha, &truth));
        assert!(after < 0.8 * before, "{model}: alpha is off by {after}, as rendered by {before}");
        let composed = |set: &PassSet, alpha: &[f32]| {
            error(&over_white(set, (&of(set, Pass::Combined), alpha)), &reference)
        };
        let [with, without] = [composed(&denoised, &alpha), composed(&kept, &of(&kept, Pass::Alpha))];
        assert!(with < without, "{model}: over white {with}, with the noisy alpha {without}");
        // Some pixels away from all that is there, nothing comes.
        let above = |values: &[f32], rows: usize| values[..rows * clean.width].iter().all(|v| *v == 0.0);
        let mut planes = colours.chunks(alpha.len()).chain([&*alpha]);
        assert!(above(&truth, 10) && planes.all(|plane| above(plane, 6)), "{model}");
    }
}

#[test]
fn beside_the_edges_of_things_a_film_stays_empty() {
    let out = tempfile::tempdir().unwrap();
    let clean = passes::load(render("clean.exr"), None).unwrap();
    let truth = clean.get(Pass::Alpha).unwrap();
    let is_empty = |at: &usize| {
        let (x, y) = (at % clean.width, at / clean.width);
        truth.near(x, y, 1).all(|(x, y)| truth.data[y * clean.width + x] == 0.0)
    };
    let empty: Vec<usize> = (0..truth.pixels()).filter(is_empty).collect();
    // Of few samples some may have missed what is there: one pixel in eighty may show something.
    for (name, most) in [("film.exr", empty.len() / 80), ("many.exr", 0)] {
        for model in ["demc-s", "demc-m", "demc-l"] {
            let done = denoise(name, out.path(), &format!("--model {model} --overwrite --replace"));
            let done = passes::load(done, None).unwrap();
            for pass in [Pass::Combined, Pass::Alpha] {
                let values = &done.get(pass).unwrap().data;
                let is_lit =
                    |at: &&usize| values.iter().skip(**at).step_by(truth.pixels()).any(|v| *v != 0.0);
                let lit = empty.iter().filter(is_lit).count();
                assert!(lit <= most, "{name}, {model}, {pass:?}: {lit} of {} empty pixels", empty.len());
            }
        }
    }
}

#[test]
fn alpha_of_many_samples_is_not_blurred() {
    let out = tempfile::tempdir().unwrap();
    let alpha = |path: &Path| passes::load(path, None).unwrap().get(Pass::Alpha).unwrap().data.to_vec();
    let [noisy, truth] = ["many.exr", "clean.exr"].map(|name| alpha(&render(name)));
    let error = |of: &[f32]| of.iter().zip(&truth).map(|(a, b)| (a - b) * (a - b)).sum::<f32>();
    for model in ["demc-s", "demc-m", "demc-l"] {
        let done = alpha(&denoise("many.exr", out.path(), &format!("--model {model} --overwrite --replace")));
        let [before, after] = [&noisy, &done].map(|alpha| error(alpha));
        assert!(after < before, "{model}: alpha is off by {after}, as rendered by {before}");
    }
}

#[test]
fn pictures_that_the_beauty_does_not_show_are_denoised_by_themselves() {
    let dir = tempfile::tempdir().unwrap();
    let (width, height) = (96, 64);
    let shot = Shot { size: (width, height), speed: 0.0, ..SHOT };
    // A thing, its shadow, of which samples see more or less, and nothing.
    let truth = |i: usize| [1.0, 0.6, 0.0][usize::from(i % width >= 12) + usize::from(i % width >= 80)];
    for frame in 1..=3 {
        let hits = |i: usize| (0..4).filter(|sample| random([frame, i as u32, *sample]) < truth(i)).count();
        let alpha: Vec<f32> = (0..width * height).map(|i| hits(i) as f32 / 4.0).collect();
        let mut channels = shot.channels("ViewLayer", "", frame.into());
        for channel in &mut channels {
            if let FlatSamples::F32(values) = &mut channel.sample_data
                && channel.name.to_string().contains("Combined")
            {
                values.iter_mut().enumerate().filter(|(i, _)| i % width >= 12).for_each(|(_, v)| *v = 0.0);
            }
        }
        let kept: Vec<f32> = alpha.iter().map(|alpha| 1.0 - alpha).collect();
        for name in ["Shadow Catcher", "AO"]
            .iter()
            .flat_map(|of| ["R", "G", "B"].map(|c| format!("ViewLayer.{of}.{c}")))
        {
            channels.push(AnyChannel::new(name.as_str(), FlatSamples::F32(kept.clone())));
        }
        channels.push(AnyChannel::new("ViewLayer.Combined.A", FlatSamples::F32(alpha)));
        write_channels(&dir.path().join(format!("s_0004spp.{frame:04}.exr")), shot.size, channels, &[]);
    }
    let out = dir.path().join("out");
    for model in ["demc-s", "demc-m"] {
        let denoise = |arguments: &str| {
            let mut command = common::demc();
            command.args(["denoise", "--overwrite", "--model", model, "--out"]).args([&*out, dir.path()]);
            command.args(arguments.split_whitespace()).assert().success();
            let result = read_exr(out.join("s_0004spp.0002.exr"));
            let error = |channel: &str, kept: bool| {
                let got = values(&result, &format!("ViewLayer.{channel}"));
                let of = |(i, v): (usize, f32)| (if kept { 1.0 - v } else { v } - truth(i)).powi(2);
                got.into_iter().enumerate().map(of).sum::<f32>()
            };
            if arguments == "--passes" {
                let rendered = error("Combined.A", false);
                for pass in ["Shadow Catcher", "AO"] {
                    let off = error(&format!("{pass}.Denoised.G"), true);
                    assert!(
                        off < 0.1 * rendered,
                        "{model}: {pass} is off by {off}, as rendered by {rendered}"
                    );
                }
            }
            [error("Combined.A", false), error("Denoised.A", false)]
        };
        let [rendered, alone] = denoise("--passes");
        assert!(alone < 0.1 * rendered, "{model}: alpha is off by {alone}, as rendered by {rendered}");
        let [_, with] = denoise("--temporal");
        assert!(with < alone, "{model}: alpha is off by {with} with neighbours, {alone} alone");
    }
}

#[test]
fn layers_of_others_are_not_taken_for_denoised_light() {
    let folder = tempfile::tempdir().unwrap();
    let path = denoise("sky.exr", folder.path(), "--model demc-s --passes");
    // Without demc's mark they are anybody's. The beauty's is called otherwise.
    let mut bytes = std::fs::read(&path).unwrap();
    for (from, to) in [("demc\0string", "memo\0string"), ("ViewLayer.Denoised", "ViewLayer.Somebody")] {
        let is_at = |at: &usize| bytes[*at..].starts_with(from.as_bytes());
        let places: Vec<usize> = (0..bytes.len()).filter(is_at).collect();
        assert!(!places.is_empty());
        places.iter().for_each(|at| bytes[*at..at + to.len()].copy_from_slice(to.as_bytes()));
    }
    let input = folder.path().join("theirs.exr");
    std::fs::write(&input, bytes).unwrap();
    let run = |arguments: &str| {
        let mut command = common::demc();
        command.arg("denoise").arg(&input).arg("--out").arg(folder.path().join("out"));
        command.args(["--model", "demc-s"]).args(arguments.split_whitespace()).assert()
    };
    run("--passes").code(1).stderr(contains(".Denoised' without demc's mark"));
    run("").success();
}

#[test]
fn opaque_frames_keep_their_alpha_to_the_bit() {
    let out = tempfile::tempdir().unwrap();
    let done = passes::load(denoise("sky.exr", out.path(), "--model demc-s --replace"), None).unwrap();
    assert!(done.get(Pass::Alpha).unwrap().data.iter().all(|v| *v == 1.0));
}

#[test]
fn a_thing_that_fills_a_rectangle_leaves_the_alpha_beside_it() {
    let folder = tempfile::tempdir().unwrap();
    let (width, height, path) = (96, 64, folder.path().join("card.exr"));
    let is_card = |i: usize| (20..60).contains(&(i % width)) && (10..50).contains(&(i / width));
    write_render(&path, width, height, |name, i| match name {
        // Half a shadow lies on the right of the card, black as what it is caught by.
        "Combined.A" if !is_card(i) => 0.6 * f32::from(u8::from(i % width >= 60)),
        "Combined.A" => 1.0,
        name if name.starts_with("Combined") && is_card(i) => 0.3 + 0.1 * (i * 7 % 5) as f32,
        _ => 0.0,
    });
    for model in ["demc-s", "demc-l"] {
        let mut command = common::demc();
        let out = folder.path().join(model);
        command.arg("denoise").arg(&path).arg("--out").arg(&out).args(["--model", model]).assert().success();
        let alpha = values(&read_exr(out.join("card.exr")), "ViewLayer.Denoised.A");
        let shadow = (0..width * height).filter(|i| i % width >= 66).map(|i| alpha[i]);
        assert!(shadow.clone().all(|v| (v - 0.6).abs() < 0.1), "{model}: {:?}", shadow.reduce(f32::min));
    }
}
