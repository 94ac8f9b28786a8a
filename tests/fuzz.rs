//! Damaged files of every kind that is read: a small one for each compression, tiling and layout, mutated a
//! few thousand times in a process of its own, whose memory is limited. Every case must end in a result or in
//! an error; what is written must be readable again. `eval/fuzz/run.sh` does the same for hours.
//!
//! `DEMC_FUZZ_CASES` says how many cases are run, and `DEMC_FUZZ_FIRST` which is the first, so that a case
//! can be seen again.
#![cfg(unix)]

mod common;

use std::{
    collections::BTreeMap,
    fs,
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::{Duration, Instant},
};

use common::files::data;
use demc::{
    frame::{Frame, NewChannel, SampleKind},
    models::{
        self,
        network::{Architecture, Config},
        weights_file,
    },
    rng::Rng,
    testset,
};
use exr::prelude::*;

/// What a case may take of memory, in KiB of addresses: threads' stacks and heaps are among them.
const MEMORY_KIB: usize = 3 << 20;
/// What all cases of a test may take.
const PATIENCE: Duration = Duration::from_secs(300);
/// What a case says whose result is no frame.
const BROKEN: &str = "what was written cannot be read again";
const SIZE: (usize, usize) = (21, 37);

/// A number that the environment gives.
fn setting(name: &str, default: usize) -> usize {
    std::env::var(name).map_or(default, |text| text.parse().expect("a number"))
}

/// Makes one small file for each way to store a frame.
fn make_frames(folder: &Path) {
    let kinds = [
        Compression::Uncompressed,
        Compression::RLE,
        Compression::ZIP1,
        Compression::ZIP16,
        Compression::PIZ,
        Compression::PXR24,
        Compression::B44,
        Compression::B44A,
        Compression::DWAA(None),
        Compression::DWAB(Some(90.0)),
    ];
    let value = |i: usize| ((i * i) % 251) as f32 / 97.0;
    let plane = |c: usize| (0..SIZE.0 * SIZE.1).map(move |i| value(i + 7 * c));
    for compression in kinds {
        for (tiling, blocks) in [("lines", Blocks::ScanLines), ("tiles", Blocks::Tiles(Vec2(16, 8)))] {
            let part = |prefix: &str, part_name: Option<&str>, passes: &[&str]| {
                let channels = passes.iter().enumerate().map(|(c, name)| {
                    let samples = match *name {
                        "Index.X" => FlatSamples::U32((0..SIZE.0 * SIZE.1).map(|i| i as u32 / 9).collect()),
                        "Depth.Z" => FlatSamples::F32(plane(c).collect()),
                        _ => FlatSamples::F16(plane(c).map(f16::from_f32).collect()),
                    };
                    AnyChannel::new(format!("{prefix}{name}").as_str(), samples)
                });
                let mut own =
                    LayerAttributes { layer_name: part_name.map(Text::from), ..LayerAttributes::default() };
                own.layer_position = Vec2(-3, 5);
                own.other.insert("custom".into(), AttributeValue::Text("text".into()));
                let encoding = Encoding { compression, blocks, line_order: LineOrder::Increasing };
                Layer::new(SIZE, own, encoding, AnyChannels::sort(channels.collect()))
            };
            let beauty = ["Combined.R", "Combined.G", "Combined.B", "Combined.A"];
            let all = [beauty.as_slice(), &["Depth.Z", "Index.X"]].concat();
            let shared = || ImageAttributes::new(IntegerBounds::new((-3, 5), SIZE));
            let path =
                |layout: &str| folder.join(format!("{tiling}_{layout}_{compression}.exr").replace(' ', "_"));
            let image = Image::from_layers(shared(), vec![part("V.", None, &all)]);
            image.write().to_file(path("single")).unwrap();
            let parts = vec![
                part("V.", Some("V.Combined"), &beauty),
                part("V.", Some("V.Depth"), &["Depth.Z"]),
                part("V.", Some("V.Index"), &["Index.X"]),
            ];
            Image::from_layers(shared(), parts).write().to_file(path("parts")).unwrap();
        }
    }
    for name in ["htj2k32", "flat_plus_deep", "luminance_chroma"] {
        let name = format!("{name}.exr");
        fs::copy(data("containers").join(&name), folder.join(name)).unwrap();
    }
    for name in ["blender4.exr", "blender5_stereo.exr"] {
        fs::copy(data(name), folder.join(name)).unwrap();
    }
}

fn make_weights(folder: &Path) {
    let facts = serde_json::json!({
        "frames": 1, "steps": 1, "batch": 1, "patch": 16, "lr": [1.0, 1.0], "loss": "smape", "seed": 1,
        "seconds": 0.0, "validation_frames": 0, "validation_relmse": null, "validation_ssim": null,
    });
    for architecture in [Architecture::Prefilter, Architecture::Lbf] {
        let widths: &[usize] = if architecture == Architecture::Lbf { &[3] } else { &[1; 4] };
        let mut network = models::build(&Config::new(architecture, widths), 1);
        let path = folder.join(format!("{architecture:?}.safetensors"));
        weights_file::write(&path, &mut *network, &serde_json::from_value(facts.clone()).unwrap()).unwrap();
    }
}

fn make_manifests(folder: &Path) {
    fs::write(
        folder.join("manifest.csv"),
        "scene,noisy,reference,spp\nroom,room_0004spp.exr,room_ref.exr,4\n\"a, b\",x.exr,y.exr,16\n",
    )
    .unwrap();
    fs::write(folder.join("room_0004spp.exr"), "").unwrap();
    fs::write(folder.join("room_ref.exr"), "").unwrap();
}

/// Damages a file in one to four ways.
fn mutate(bytes: &mut Vec<u8>, others: &[Vec<u8>], rng: &mut Rng) {
    const NUMBERS: [u64; 9] =
        [0, 1, 0x7f, 0xff, 0xffff, 0x7fff_ffff, 0x8000_0000, 1 << 40, 0x7fff_ffff_ffff_ffff];
    for _ in 0..=rng.below(4) {
        if bytes.is_empty() {
            return;
        }
        // Headers are where most is decided.
        let len = bytes.len();
        let at = if rng.below(2) == 0 { rng.below(len) } else { rng.below(len.min(600)) };
        match rng.below(8) {
            0 | 1 => bytes[at] ^= 1 << rng.below(8),
            2 => bytes[at] = rng.next_u64() as u8,
            3 | 4 => {
                let number = NUMBERS[rng.below(NUMBERS.len())].to_le_bytes();
                let width = [1, 2, 4, 8][rng.below(4)].min(len - at);
                bytes[at..at + width].copy_from_slice(&number[..width]);
            }
            5 => bytes.truncate(at),
            6 => {
                let count = rng.below(16).min(len - at);
                bytes.drain(at..at + count);
            }
            _ => {
                let other = &others[rng.below(others.len())];
                let (from, to) = (at.min(other.len()), (at + 1 + rng.below(64)).min(other.len()).min(len));
                if from < to {
                    bytes[from..to].copy_from_slice(&other[from..to]);
                }
            }
        }
    }
}

/// Everything that becomes of a frame: all is decoded, a layer is added, and the result is written and read
/// again.
fn try_frame(path: &Path) -> demc::Result<()> {
    let mut frame = Frame::read(path)?;
    let written = path.with_extension("out");
    frame.write(&written)?;
    Frame::read(&written).expect(BROKEN);
    for part in 0..frame.parts().len() {
        let channels: Vec<usize> = (0..frame.parts()[part].channels.len()).collect();
        // One that cannot be decoded does not make the others so.
        let _ = frame.decode(part, &[&channels]);
    }
    let window = frame.parts()[0].data_window;
    if window.width * window.height > 1 << 18 {
        return Ok(());
    }
    let values = vec![0.5; window.width * window.height];
    let layer =
        ["R", "G", "B"].map(|component| NewChannel { component, kind: SampleKind::Half, values: &values });
    frame.set_layer(0, "V.Denoised", None, &layer)?;
    frame.write(&written)?;
    let again = Frame::read(&written).expect(BROKEN);
    let part = again.parts().iter().position(|p| p.channels.iter().any(|c| c.name == "V.Denoised.G"));
    assert!(part.is_some(), "{BROKEN}");
    Ok(())
}

/// A kind of file: how its corpus is made, and how one of it is read.
struct Kind {
    make: fn(&Path),
    read: fn(&Path) -> demc::Result<()>,
}

fn kind(name: &str) -> Kind {
    match name {
        "frames" => Kind { make: make_frames, read: try_frame },
        "weights" => Kind { make: make_weights, read: |path| weights_file::read(path).map(|_| ()) },
        "manifests" => {
            Kind { make: make_manifests, read: |path| testset::read(&path.display().to_string()).map(|_| ()) }
        }
        other => panic!("no kind {other}"),
    }
}

/// Runs cases in this process; says which one before each.
#[test]
#[ignore = "what the other tests start"]
fn child() {
    let kind = kind(&std::env::var("DEMC_FUZZ_KIND").unwrap());
    let folder = PathBuf::from(std::env::var("DEMC_FUZZ_FOLDER").unwrap());
    let mut files: Vec<PathBuf> =
        fs::read_dir(folder.join("corpus")).unwrap().map(|e| e.unwrap().path()).collect();
    files.retain(|file| fs::metadata(file).unwrap().len() > 0);
    files.sort();
    let corpus: Vec<Vec<u8>> = files.iter().map(|file| fs::read(file).unwrap()).collect();
    let (first, count) = (setting("DEMC_FUZZ_FIRST", 0), setting("DEMC_FUZZ_CASES", 0));
    let (mut refused, mut panics) = (0, BTreeMap::new());
    std::panic::set_hook(Box::new(|_| {}));
    for case in first..first + count {
        fs::write(folder.join("case"), case.to_string()).unwrap();
        let rng = &mut Rng::new(1, case as u64);
        let base = rng.below(corpus.len());
        let mut bytes = corpus[base].clone();
        mutate(&mut bytes, &corpus, rng);
        let path = folder.join("corpus").join(format!("case.{}", files[base].extension().unwrap().display()));
        fs::write(&path, bytes).unwrap();
        match catch_unwind(AssertUnwindSafe(|| (kind.read)(&path))) {
            Ok(Ok(())) => {}
            Ok(Err(_)) => refused += 1,
            // One of the codecs': the program tells it in one line, but what this test says of results must
            // hold.
            Err(panic) => {
                let text = panic.downcast_ref::<String>().map(String::as_str);
                let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or_default();
                assert!(!text.contains(BROKEN), "case {case}: {text}");
                panics.entry(text.to_owned()).or_insert(case);
            }
        }
    }
    let listed: String = panics.iter().map(|(text, case)| format!("\n    case {case}: {text}")).collect();
    fs::write(folder.join("done"), format!("{count} cases, {refused} refused{listed}")).unwrap();
}

/// Mutates files of a kind in a child whose memory is limited.
fn fuzz(name: &str, cases: usize) {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    fs::create_dir(folder.join("corpus")).unwrap();
    (kind(name).make)(&folder.join("corpus"));
    let program = std::env::current_exe().unwrap();
    let mut child = Command::new("sh")
        .args(["-c", &format!("ulimit -v {MEMORY_KIB}; exec \"$0\" \"$@\"")])
        .arg(program)
        .args(["child", "--exact", "--ignored", "--nocapture"])
        .env("DEMC_FUZZ_KIND", name)
        .env("DEMC_FUZZ_FOLDER", folder)
        .env("DEMC_FUZZ_CASES", setting("DEMC_FUZZ_CASES", cases).to_string())
        .env("RAYON_NUM_THREADS", "2")
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let (start, patience) =
        (Instant::now(), PATIENCE.max(Duration::from_secs(setting("DEMC_FUZZ_SECONDS", 0) as u64)));
    let status = loop {
        match child.try_wait().unwrap() {
            Some(status) => break Some(status),
            None if start.elapsed() > patience => {
                child.kill().unwrap();
                break None;
            }
            None => std::thread::sleep(Duration::from_millis(50)),
        }
    };
    let said = |file: &str| fs::read_to_string(folder.join(file)).unwrap_or_default();
    println!("{name} in {:.0} s: {}", start.elapsed().as_secs_f64(), said("done"));
    assert!(
        status.is_some_and(|status| status.success()) && !said("done").is_empty(),
        "{name}: case {} ended with {status:?} after {:?}; DEMC_FUZZ_FIRST={} DEMC_FUZZ_CASES=1 shows it again",
        said("case"),
        start.elapsed(),
        said("case"),
    );
}

#[test]
fn no_damaged_frame_ends_the_process() {
    fuzz("frames", 4000);
}

#[test]
fn no_damaged_weights_end_the_process() {
    fuzz("weights", 2000);
}

#[test]
fn no_damaged_manifest_ends_the_process() {
    fuzz("manifests", 1000);
}
