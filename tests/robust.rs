//! What must not bring a batch down: damaged files, odd names, settings that mean nothing, leftovers of
//! killed runs.

mod common;

use std::{
    fs,
    path::Path,
    time::{Duration, SystemTime},
};

use common::{demc, files::data};
use exr::prelude::*;
use predicates::prelude::*;

/// A render of one part in DWAA, whose blocks begin with counters.
fn write_dwaa(path: &Path) {
    let names = ["R", "G", "B", "A"].map(|c| format!("ViewLayer.Combined.{c}"));
    let value = |i: usize| ((i * i) % 251) as f32 / 97.0;
    let list = names.iter().enumerate().map(|(c, name)| {
        let values = (0..48 * 40).map(|i| f16::from_f32(value(i + 7 * c))).collect();
        AnyChannel::new(name.as_str(), FlatSamples::F16(values))
    });
    let encoding = Encoding {
        compression: Compression::DWAA(None),
        blocks: Blocks::ScanLines,
        line_order: LineOrder::Increasing,
    };
    let channels = AnyChannels::sort(list.collect());
    let layer = Layer::new((48, 40), LayerAttributes::default(), encoding, channels);
    Image::from_layer(layer).write().to_file(path).unwrap();
}

/// Where the first block's counters begin: what the first entry of the offset table points to, behind row and
/// size.
fn first_counter(bytes: &[u8]) -> usize {
    let chunks = 2;
    let reader = exr::block::read(std::io::Cursor::new(bytes), false).unwrap();
    assert_eq!(reader.headers()[0].chunk_count, chunks);
    let table = bytes.windows(16).position(|window| {
        let [first, second] = [0, 8].map(|at| u64::from_le_bytes(window[at..at + 8].try_into().unwrap()));
        let is_chunk = |at: u64, y: u32| {
            bytes.get(at as usize..at as usize + 4).is_some_and(|found| found == y.to_le_bytes())
        };
        first > 100 && second > first && is_chunk(first, 0) && is_chunk(second, 32)
    });
    let table = table.expect("an offset table");
    u64::from_le_bytes(bytes[table..table + 8].try_into().unwrap()) as usize + 8
}

#[test]
fn a_block_that_claims_more_memory_than_there_is_fails_its_frame_alone() {
    let dir = tempfile::tempdir().unwrap();
    let (input, out) = (dir.path().join("in"), dir.path().join("out"));
    fs::create_dir(&input).unwrap();
    for good in ["a.exr", "z.exr"] {
        write_dwaa(&input.join(good));
    }
    let whole = fs::read(input.join("a.exr")).unwrap();
    let at = first_counter(&whole);
    let mut bad = Vec::new();
    for counter in 1..=9 {
        for claim in [1u64 << 31, 1 << 40, (1 << 63) - 1, u64::MAX] {
            let mut bytes = whole.clone();
            bytes[at + 8 * counter..][..8].copy_from_slice(&claim.to_le_bytes());
            let name = format!("m{counter}_{claim}.exr");
            fs::write(input.join(&name), bytes).unwrap();
            bad.push(name);
        }
    }
    let run =
        demc().args(["denoise", "--model", "noisy"]).arg(&input).arg("--out").arg(&out).assert().code(1);
    let message = String::from_utf8(run.get_output().stderr.clone()).unwrap();
    let failed: Vec<&str> = message.lines().filter(|line| !line.starts_with("demc: note:")).collect();
    assert_eq!(failed.len(), bad.len(), "{message}");
    for name in &bad {
        assert!(
            failed.iter().any(|line| line.contains(name) && line.contains("copy it again")),
            "{name}: {message}"
        );
    }
    assert!(["a.exr", "z.exr"].iter().all(|good| out.join(good).is_file()));
    demc().arg("inspect").arg(input.join(&bad[0])).assert().code(1).stderr(predicate::str::contains(&bad[0]));
}

#[test]
fn previews_of_views_of_any_name_are_written() {
    let dir = tempfile::tempdir().unwrap();
    let input = dir.path().join("in.exr");
    let part = |view: &str| {
        let list = ["R", "G", "B"].map(|c| AnyChannel::new(c, FlatSamples::F32(vec![0.5; 12])));
        let mut own = LayerAttributes::named(format!("ViewLayer.Combined-{view}").as_str());
        own.view_name = Some(view.into());
        let channels = AnyChannels::sort(list.into_iter().collect());
        Layer::new((4, 3), own, Encoding::SMALL_LOSSLESS, channels)
    };
    let shared = ImageAttributes::new(IntegerBounds::from_dimensions((4, 3)));
    Image::from_layers(shared, vec![part("le/t"), part("le_t")]).write().to_file(&input).unwrap();
    let out = dir.path().join("out");
    let mut command = demc();
    command.args(["denoise", "--model", "noisy", "--preview"]).arg(&input).arg("--out").arg(&out);
    command.assert().success();
    for name in ["in.exr", "in.le%2Ft.png", "in.le_t.png"] {
        assert!(out.join(name).is_file(), "{name}");
    }
}

#[test]
fn a_source_is_not_overwritten_by_whatever_path_it_is_reached() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("in/a.exr");
    fs::create_dir(dir.path().join("in")).unwrap();
    fs::copy(data("blender4.exr"), &source).unwrap();
    let before = fs::read(&source).unwrap();
    let mut outs = vec![dir.path().join("in"), dir.path().join("in/../in")];
    #[cfg(unix)]
    {
        // As a folder that is mounted twice: other path, same place on the disk.
        let (linked, hard) = (dir.path().join("linked"), dir.path().join("hard"));
        std::os::unix::fs::symlink(dir.path().join("in"), &linked).unwrap();
        fs::create_dir(&hard).unwrap();
        fs::hard_link(&source, hard.join("a.exr")).unwrap();
        outs.extend([linked, hard]);
    }
    for out in outs {
        for how in ["--overwrite", "--replace"] {
            let mut command = demc();
            command.args(["denoise", "--model", "noisy", how]).arg(&source).arg("--out").arg(&out);
            command.assert().code(2).stderr(predicate::str::contains("would overwrite its input"));
        }
    }
    assert_eq!(fs::read(&source).unwrap(), before);
}

#[test]
fn leftovers_of_killed_runs_are_removed_and_what_is_being_written_is_not() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    fs::create_dir(&out).unwrap();
    fs::write(out.join(".demc-dead00.tmp"), "half a frame").unwrap();
    let dead = fs::File::options().write(true).open(out.join(".demc-dead00.tmp")).unwrap();
    dead.set_modified(SystemTime::now() - Duration::from_secs(48 * 3600)).unwrap();
    drop(dead);
    let living = fs::File::create(out.join(".demc-living.tmp")).unwrap();
    living.lock().unwrap();
    let mut command = demc();
    command.args(["denoise", "--model", "noisy"]).arg(data("blender4.exr")).arg("--out").arg(&out);
    command.assert().success();
    let mut left: Vec<_> = fs::read_dir(&out).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, [".demc-living.tmp", "blender4.exr"]);
}

#[test]
fn a_killed_run_leaves_nothing_behind_its_successor() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let temporary = |out: &Path| {
        let entries = fs::read_dir(out).into_iter().flatten().flatten();
        entries.filter(|e| e.file_name().to_string_lossy().starts_with(".demc-")).count()
    };
    // Written for long enough to be seen: a large frame of noise.
    let input = dir.path().join("in.exr");
    let noise = |i: usize, c: usize| ((i.wrapping_mul(2_654_435_761) >> (8 + c)) & 0xffff) as f32;
    write_rgb_file(&input, 1500, 1200, |x, y| {
        let i = y * 1500 + x;
        (noise(i, 0), noise(i, 1), noise(i, 2))
    })
    .unwrap();
    let command = || {
        let mut command = std::process::Command::new(assert_cmd::cargo::cargo_bin("demc"));
        command.args(["denoise", "--model", "noisy"]).arg(&input).arg("--out").arg(&out);
        command
    };
    let mut child = command().stdout(std::process::Stdio::null()).spawn().unwrap();
    while child.try_wait().unwrap().is_none() {
        if temporary(&out) > 0 && !out.join("in.exr").exists() {
            child.kill().unwrap();
            child.wait().unwrap();
        }
        std::thread::yield_now();
    }
    assert!(command().stdout(std::process::Stdio::null()).status().unwrap().success());
    assert_eq!(temporary(&out), 0);
    assert!(out.join("in.exr").is_file());
}

#[test]
fn settings_from_the_environment_that_mean_nothing_are_refused_in_a_sentence() {
    for (variable, value, wanted) in [
        ("RAYON_NUM_THREADS", "many", "number of threads"),
        ("RAYON_NUM_THREADS", "-3", "number of threads"),
        ("RAYON_NUM_THREADS", "100000000", "number of threads"),
        ("DEMC_TIER", "avx1024", "portable"),
        ("DEMC_ENGINE", "gpu", "portable"),
    ] {
        let run = demc().env(variable, value).arg("models").assert().code(2);
        let message = String::from_utf8(run.get_output().stderr.clone()).unwrap();
        assert_eq!(message.lines().count(), 1, "{message}");
        assert!(message.contains(&format!("{variable}={value}")) && message.contains(wanted), "{message}");
    }
    for (variable, value) in
        [("RAYON_NUM_THREADS", "0"), ("RAYON_NUM_THREADS", "2"), ("DEMC_TIER", "Portable")]
    {
        demc().env(variable, value).arg("models").assert().success();
    }
}
