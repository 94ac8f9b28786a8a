//! The denoise engine as a library: what it writes, tells and refuses, without a command line.

mod common;

use std::{
    fs,
    sync::{Arc, Barrier},
    time::{Duration, Instant},
};

use common::files::{data, read_exr, samples};
use demc::{
    Error, Result,
    denoise::{self, Alpha, Batch, End, Job, Options, Outcome},
    models::{self, Denoiser},
    passes::{Pass, PassSet},
    planes::Planes,
    shot::{self, Shot},
    sources::Sources,
};

const FRAME: &str = "s0000_room_0004spp.exr";

#[test]
fn a_file_is_written_as_the_command_writes_it() {
    let out = tempfile::tempdir().unwrap();
    common::demc()
        .args(["denoise", "--model", "demc-s", "--out"])
        .arg(out.path())
        .arg(data(FRAME))
        .assert()
        .success();
    let model = models::open("demc-s").unwrap();
    let own = out.path().join("own.exr");
    let report = denoise::file(&data(FRAME), &own, &*model, &Options::default()).unwrap();
    assert_eq!((report.width, report.height, report.view_layer.as_str()), (128, 128, "ViewLayer"));
    assert!(fs::read(own).unwrap() == fs::read(out.path().join(FRAME)).unwrap());
}

#[test]
fn a_layer_name_that_would_not_read_back_is_refused() {
    let out = tempfile::tempdir().unwrap();
    let model = models::open("noisy").unwrap();
    for name in ["", "a.b", "Combined", "Denoising Albedo"] {
        let options = Options { layer: Some(name.into()), ..Options::default() };
        let error = denoise::file(&data(FRAME), &out.path().join("x.exr"), &*model, &options).err().unwrap();
        assert!(matches!(&error, Error::Usage(why) if why.contains(&format!("'{name}'"))), "{error}");
    }
    assert_eq!(fs::read_dir(out.path()).unwrap().count(), 0);
}

/// Passes its input on, and waits twice for somebody else on the way.
struct Waits(Barrier);

impl Denoiser for Waits {
    fn name(&self) -> &str {
        "waits"
    }

    fn passes(&self) -> &[Pass] {
        &[Pass::Combined]
    }

    fn denoise(&self, shot: &Shot) -> Result<Planes> {
        self.0.wait();
        self.0.wait();
        Ok(shot.passes.require(Pass::Combined, self.name())?.clone())
    }
}

#[test]
fn a_batch_that_is_stopped_begins_no_other_file() {
    let out = tempfile::tempdir().unwrap();
    let job = |name: &str| Job { input: data(FRAME), output: out.path().join(name) };
    let waits = Arc::new(Waits(Barrier::new(2)));
    let batch = Batch::new(["a.exr", "b.exr", "c.exr"].map(job).into(), waits.clone(), Options::default());
    let stopper = batch.stopper();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            // The first frame is being denoised.
            waits.0.wait();
            stopper.stop();
        });
        assert!(batch.run(|job, _| panic!("{} came to an end", job.input.display())) == End::Stopped);
    });
    waits.0.wait();
    stopper.stop();
    assert_eq!(fs::read_dir(out.path()).unwrap().count(), 0);
    // What was read already is not denoised either: the batch's threads end, and let go of the model.
    let patience = Instant::now() + Duration::from_secs(20);
    while Arc::strong_count(&waits) > 1 {
        assert!(Instant::now() < patience, "the batch goes on");
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[test]
fn each_file_of_a_batch_ends_once() {
    let out = tempfile::tempdir().unwrap();
    let broken = out.path().join("broken.exr");
    fs::write(&broken, "no EXR").unwrap();
    let jobs = denoise::plan(vec![data(FRAME), broken], &out.path().join("done")).unwrap();
    let Err(Error::Usage(why)) = denoise::plan(vec![data(FRAME), data(FRAME)], out.path()) else { panic!() };
    assert!(why.contains("both be written"), "{why}");
    fs::create_dir(out.path().join("done")).unwrap();
    let options = Options { layer: Some("Clean".into()), ..Options::default() };
    let run = |jobs: &[Job]| {
        let mut told = Vec::new();
        let batch = Batch::new(jobs.to_vec(), models::open("noisy").unwrap().into(), options.clone());
        let end = batch.run(|job, outcome| {
            let outcome = match outcome {
                Outcome::Done(_) => "done",
                Outcome::Skipped(_) => "skipped",
                Outcome::Failed(_) => "failed",
            };
            told.push((job.clone(), outcome));
        });
        assert!(end == End::Complete);
        told.sort_by_key(|(_, outcome)| *outcome);
        told
    };
    let [frame, broken] = [jobs[0].clone(), jobs[1].clone()];
    assert_eq!(run(&jobs), [(frame.clone(), "done"), (broken.clone(), "failed")]);
    assert_eq!(run(&jobs), [(broken, "failed"), (frame.clone(), "skipped")]);
    assert!(samples(&read_exr(frame.output), "ViewLayer.Clean.G").is_some());
}

/// Panics as soon as it is asked what it can make use of.
struct Breaks;

impl Denoiser for Breaks {
    fn name(&self) -> &str {
        "breaks"
    }

    fn passes(&self) -> &[Pass] {
        &[Pass::Combined]
    }

    fn optional_passes(&self) -> &[Pass] {
        panic!("on purpose")
    }

    fn denoise(&self, _: &Shot) -> Result<Planes> {
        unreachable!()
    }
}

#[test]
fn frames_that_a_defect_took_with_it_are_told_as_failed() {
    let out = tempfile::tempdir().unwrap();
    let job = |name: &str| {
        let input = out.path().join("in").join(name);
        fs::create_dir_all(input.parent().unwrap()).unwrap();
        fs::copy(data(FRAME), &input).unwrap();
        Job { input, output: out.path().join(name) }
    };
    let jobs = ["a.0001.exr", "a.0002.exr", "a.0003.exr"].map(job);
    let (breaks, noisy): (Arc<dyn Denoiser>, _) = (Arc::new(Breaks), models::open("noisy").unwrap().into());
    for (model, reach, why) in [
        (breaks.clone(), None, "internal error"),
        (breaks, Some(1), "internal error"),
        (noisy, Some(usize::MAX), "at most 255"),
    ] {
        let options = Options { temporal: reach, ..Options::default() };
        let mut ended = Vec::new();
        let end = Batch::new(jobs.to_vec(), model, options).run(|job, outcome| {
            assert!(matches!(outcome, Outcome::Failed(error) if error.to_string().contains(why)));
            ended.push(job.input.clone());
        });
        assert_eq!(end, End::Complete);
        ended.sort();
        assert_eq!(ended, jobs.clone().map(|job| job.input));
    }
}

#[test]
fn storing_takes_no_layer_that_loading_would_refuse_and_overwrites_no_guide() {
    let out = tempfile::tempdir().unwrap();
    let model = models::open("noisy").unwrap();
    let guide = out.path().join("albedo.exr");
    fs::copy(data(FRAME), &guide).unwrap();
    let of_guide = Sources { albedo: Some(guide.clone()), ..Sources::default() };
    let layer = |name: &str| Options { layer: Some(name.into()), ..Options::default() };
    for (options, why) in [
        (layer("Combined"), "is a pass of the renderer"),
        (layer("a.b"), "without a dot"),
        (Options { sources: of_guide, ..Options::default() }, "is a guide of this frame"),
    ] {
        let loaded = denoise::load(&data(FRAME), &*model, &Options::default()).unwrap();
        let denoised = denoise::denoise(loaded, &*model, &Options::default()).unwrap();
        let error = denoise::store(denoised, &guide, &options).err().unwrap();
        assert!(error.to_string().contains(why), "{error}");
    }
    assert_eq!(fs::read(guide).unwrap(), fs::read(data(FRAME)).unwrap());
}

#[test]
fn what_has_no_pixels_and_tiles_of_none_are_errors() {
    let shot = |w, h| {
        let mut passes = PassSet::new("x.exr", "ViewLayer", w, h);
        passes.insert(Pass::Combined, Planes::new(3, w, h));
        Shot::new(passes)
    };
    let model = models::open("demc-s").unwrap();
    for (w, h) in [(0, 0), (0, 5), (5, 0)] {
        let error = denoise::shot(shot(w, h), &*model, &Options::default()).unwrap_err();
        assert!(error.to_string().contains("has no pixels"), "{error}");
    }
    let options = Options { tile: Some(0), ..Options::default() };
    assert!(matches!(denoise::shot(shot(8, 8), &*model, &options), Err(Error::Usage(_))));
    for spec in ["nfor:int8", "noisy:f32", "noisy:bf16:unrestrained"] {
        assert!(
            matches!(models::open(spec), Err(Error::Usage(why)) if why.contains("is no network")),
            "{spec}"
        );
    }
}

#[test]
fn a_shot_in_memory_is_denoised_as_a_file_is() {
    let model = models::open("demc-s").unwrap();
    let of = |passes: &PassSet, options: Options| denoise::shot(Shot::new(passes.clone()), &*model, &options);
    // Most of it is not finite.
    let mut passes = shot::prepare(data(FRAME), None).unwrap().passes;
    let mut broken = passes.clone();
    let (width, height) = (passes.width, passes.height);
    broken.insert(Pass::Combined, Planes::from_vec(3, width, height, vec![f32::NAN; 3 * width * height]));
    let error = of(&broken, Options::default()).unwrap_err().to_string();
    assert!(error.contains("are NaN or infinite; render the frame again"), "{error}");
    // What is for files is refused, and alpha goes along.
    for options in [
        Options { passes: true, ..Options::default() },
        Options { confidence: true, ..Options::default() },
        Options { temporal: Some(2), ..Options::default() },
    ] {
        assert!(matches!(of(&passes, options), Err(Error::Usage(_))));
    }
    let noisy = |row: &mut [f32], y: usize| {
        row.iter_mut().enumerate().for_each(|(x, v)| *v = ((x * 31 + y * 17) % 5) as f32 / 4.0);
    };
    passes.insert(Pass::Alpha, Planes::from_rows(1, (width, height), |_, y, row| noisy(row, y)));
    let (_, alpha) = of(&passes, Options::default()).unwrap();
    assert!(alpha.is_some_and(|alpha| Some(&alpha) != passes.get(Pass::Alpha)));
    let (_, kept) = of(&passes, Options { alpha: Alpha::Keep, ..Options::default() }).unwrap();
    assert_eq!(kept.as_ref(), passes.get(Pass::Alpha));
}

#[test]
fn a_file_is_neither_made_with_neighbours_nor_over_its_render() {
    let folder = tempfile::tempdir().unwrap();
    let (render, result) = (folder.path().join("a.exr"), folder.path().join("b.exr"));
    fs::copy(data(FRAME), &render).unwrap();
    let model = models::open("noisy").unwrap();
    let options = Options { temporal: Some(2), ..Options::default() };
    assert!(matches!(denoise::file(&render, &result, &*model, &options), Err(Error::Usage(_))));
    assert!(!result.exists());
    for layer in [None, Some("Denoised".into())] {
        let options = Options { layer, ..Options::default() };
        let error = denoise::file(&render, &render, &*model, &options).err().unwrap().to_string();
        assert!(error.contains("is the render, which the result would overwrite"), "{error}");
    }
    assert!(fs::read(&render).unwrap() == fs::read(data(FRAME)).unwrap());
}

/// Turned about half, a panorama gives the same picture turned about half: its seam is nowhere.
#[test]
fn a_panorama_has_no_seam() {
    const HALF: usize = 64;
    let shot = shot::prepare(data("s0000_room_0004spp.exr"), None).unwrap();
    let (width, height) = (shot.passes.width, shot.passes.height);
    let turned = |planes: &Planes| {
        Planes::from_rows(planes.channels, (width, height), |c, y, row| {
            row.copy_from_slice(&planes.channel(c)[y * width..][..width]);
            row.rotate_left(HALF);
        })
    };
    let about = Shot::new(shot.passes.map((width, height), |_, planes| turned(planes)));
    let model = models::open("demc-m").unwrap();
    let far = |wraps: bool| {
        let [one, other] = [&shot, &about].map(|shot| {
            let mut shot = shot.clone();
            shot.wraps = wraps;
            denoise::shot(shot, &*model, &Options::default()).unwrap().0
        });
        let one = turned(&one);
        let pairs = one.data.iter().zip(&other.data);
        pairs.map(|(a, b)| (a - b).abs() / (a + b + 1e-3)).fold(0.0, f32::max)
    };
    let (joined, apart) = (far(true), far(false));
    assert!(joined < 1e-3 && apart > 0.05, "{joined} where edges meet, {apart} where they do not");
}

#[test]
fn a_frame_without_noise_stays_as_it_is_and_no_error_is_expected_of_it() {
    let model = models::open("demc-s").unwrap();
    let light = |i: usize| if i.is_multiple_of(7) { 3.0 + i as f32 / 100.0 } else { 0.25 };
    let sky = Planes::from_vec(3, 37, 21, (0..3 * 37 * 21).map(light).collect());
    for frame in [sky, Planes::new(3, 37, 21)] {
        let mut passes = PassSet::new("frame.exr", "ViewLayer", frame.width, frame.height);
        for pass in [Pass::Combined, Pass::DenoisingAlbedo, Pass::DenoisingNormal] {
            passes.insert(pass, frame.clone());
        }
        let (result, error) = model.denoise_along(&Shot::new(passes), &mut [], None, true).unwrap();
        assert!(result == frame, "it has changed");
        assert_eq!(error.unwrap().mean(), 0.0);
    }
}
