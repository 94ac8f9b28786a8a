//! The bits of every method's result on a frame, pinned: changes that are not about pixels must leave them as
//! they are.
//!
//! `tests/data/pins.txt` has a line for each method, and one more for each other result that some
//! instructions give it: its name, the tier and engine (`DEMC_TIER`, `DEMC_ENGINE`) that were run, and a hash
//! of the result. A commit that changes pixels on purpose also writes the file anew:
//!
//! ```text
//! DEMC_PINS=write cargo test --release --test pins
//! ```
//!
//! Instructions that the processor lacks are not compared; writing keeps their pins of methods whose portable result is
//! as it was. Every processor has `portable`.

mod common;

use std::{
    collections::{BTreeMap, BTreeSet},
    env, fs,
    path::PathBuf,
    process::Command,
};

use common::{
    files::{bits, data, read_exr, samples},
    shot::SHOT,
};
use demc::{
    kernels::{narrow::Engine, simd::Tier},
    models,
    planes::Planes,
    shot::{self, Shot},
};

/// Trained networks with their arithmetic chosen, so that all of it is compared wherever it is not the
/// fastest.
const METHODS: [&str; 16] = [
    "demc-s:f32",
    "demc-s:bf16",
    "demc-s:int8",
    "demc-m:f32",
    "demc-m:bf16",
    "demc-m:int8",
    "demc-l:f32",
    "demc-l:int8",
    "demc:f32",
    "demc:bf16",
    "demc-nofusion:f32",
    "semc:f32",
    "kpcn:f32",
    "kpcn:bf16",
    "lbf",
    "nfor",
];

/// What `demc denoise` stores: the denoised layer, the expected error beside it, and a frame among neighbours.
const STORED: [&str; 3] = ["demc-m:int8/stored", "demc-m:int8/error", "demc-s:int8/temporal"];

/// Column, row, and size of what is denoised: no multiple of what networks halve by.
const PLACE: (usize, usize) = (21, 30);
const SIZE: (usize, usize) = (90, 70);

/// Tells a process of this test to print its hashes and end.
const CHILD: &str = "DEMC_PINS_CHILD";

fn frame() -> PathBuf {
    data("s0000_room_0004spp.exr")
}

fn pins() -> PathBuf {
    data("pins.txt")
}

/// FNV-1a (Fowler, Noll, Vo) of some words.
fn hash(words: impl IntoIterator<Item = u32>) -> String {
    let bytes = words.into_iter().flat_map(u32::to_le_bytes);
    let hash = bytes.fold(0xcbf2_9ce4_8422_2325u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    });
    format!("{hash:016x}")
}

fn hash_of(image: &Planes) -> String {
    hash(image.data.iter().map(|v| v.to_bits()))
}

/// What the methods are given.
fn window() -> Shot {
    let whole = shot::prepare(frame(), None).unwrap().passes;
    Shot::new(whole.map(SIZE, |_, planes| planes.window(PLACE, SIZE)))
}

/// Hashes of [`STORED`].
fn stored() -> [String; 3] {
    let out = tempfile::tempdir().unwrap();
    let denoise = |inputs: &[PathBuf], [model, more]: [&str; 2]| {
        let mut command = common::demc();
        command.args(["denoise", "--model", model, more, "--out"]).arg(out.path());
        command.args(inputs).assert().success();
    };
    let hash_of = |file: &str, channels: &[&str]| {
        let image = read_exr(out.path().join(file));
        let channel = |c| bits(samples(&image, &format!("ViewLayer.Denoised{c}")).expect("a layer added"));
        hash(channels.iter().flat_map(channel))
    };
    let colours = [".R", ".G", ".B"];
    denoise(&[frame()], ["demc-m:int8", "--confidence"]);
    let name = frame().file_name().unwrap().to_string_lossy().into_owned();
    let shot: Vec<PathBuf> = (1..=3).map(|n| out.path().join(format!("renders/shot.{n}.exr"))).collect();
    fs::create_dir(out.path().join("renders")).unwrap();
    let flickering = common::shot::Shot { flicker: 0.15, ..SHOT };
    shot.iter().zip(1..).for_each(|(file, n)| flickering.write(file, n));
    denoise(&shot, ["demc-s:int8", "--temporal=1"]);
    [hash_of(&name, &colours), hash_of(&name, &[" Error.X"]), hash_of("shot.2.exr", &colours)]
}

/// The hash of every method's result with the instructions that this process was told to use.
fn hashes() -> Vec<(&'static str, String)> {
    let shot = window();
    let hash = |name| (name, hash_of(&models::open(name).unwrap().denoise(&shot).unwrap()));
    METHODS.into_iter().map(hash).chain(STORED.into_iter().zip(stored())).collect()
}

/// Every tier with the plainest engine, and every engine with the fastest tier.
fn instructions() -> Vec<(String, String)> {
    let name = |value: &dyn std::fmt::Debug| format!("{value:?}").to_lowercase();
    let [tiers, engines]: [Vec<String>; 2] = [
        Tier::available().iter().map(|tier| name(tier)).collect(),
        Engine::available().iter().map(|engine| name(engine)).collect(),
    ];
    let fastest = tiers.last().expect("there is a portable one").clone();
    let by_tier = tiers.into_iter().map(|tier| (tier, engines[0].clone()));
    let by_engine = engines[1..].iter().map(|engine| (fastest.clone(), engine.clone()));
    by_tier.chain(by_engine).collect()
}

/// The lines that a process with these instructions prints.
fn run(tier: &str, engine: &str) -> Vec<(String, String)> {
    let mut child = Command::new(env::current_exe().unwrap());
    child.args(["--exact", "results_are_the_bits_that_were_pinned", "--nocapture"]);
    child.envs([("DEMC_TIER", tier), ("DEMC_ENGINE", engine), (CHILD, "1")]);
    let output = child.output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{tier}/{engine}: {text}{}", String::from_utf8_lossy(&output.stderr));
    let pin = |line: &str| {
        let (name, hash) = line.strip_prefix("pin ")?.split_once(' ')?;
        Some((name.to_owned(), hash.to_owned()))
    };
    text.lines().filter_map(pin).collect()
}

/// What the file pins: hashes by method and instructions.
fn read() -> BTreeMap<(String, String), String> {
    let text = fs::read_to_string(pins()).unwrap();
    let mut pins = BTreeMap::new();
    for line in text.lines().filter(|line| !line.starts_with('#')) {
        let [method, hash, instructions]: [&str; 3] =
            line.split_whitespace().collect::<Vec<_>>().try_into().expect("a line has three words");
        for one in instructions.split(',') {
            pins.insert((method.to_owned(), one.to_owned()), hash.to_owned());
        }
    }
    pins
}

/// Writes the file: methods in their order, instructions that give one result on one line.
fn write(mut found: Vec<(String, String, String)>) {
    let pinned = read();
    let portable = |method: &str| (method.to_owned(), "portable/portable".to_owned());
    let same: BTreeMap<_, _> = found.iter().map(|(of, hash, one)| ((of, one), hash)).collect();
    let kept = pinned.iter().filter(|((method, one), _)| {
        let (of, portably) = portable(method);
        !same.contains_key(&(method, one))
            && same.get(&(&of, &portably)).copied() == pinned.get(&portable(method))
    });
    let kept: Vec<_> = kept.map(|((of, one), hash)| (of.clone(), hash.clone(), one.clone())).collect();
    found.extend(kept);
    let mut text = "# method  hash of its result  tier/engine,...   (DEMC_PINS=write cargo test --release --test pins)\n"
        .to_owned();
    for method in METHODS.into_iter().chain(STORED) {
        let own: Vec<_> = found.iter().filter(|(of, ..)| of == method).collect();
        let mut hashes: Vec<&str> = own.iter().map(|(_, hash, _)| hash.as_str()).collect();
        hashes.dedup();
        for (at, hash) in hashes.iter().enumerate() {
            if hashes[..at].contains(hash) {
                continue;
            }
            let same = own.iter().filter(|(_, of, _)| of == hash).map(|(.., one)| one.as_str());
            text += &format!("{method:<20} {hash} {}\n", same.collect::<Vec<_>>().join(","));
        }
    }
    fs::write(pins(), text).unwrap();
}

#[test]
fn results_are_the_bits_that_were_pinned() {
    if env::var_os(CHILD).is_some() {
        // The harness has written the test's name without an end of line.
        println!();
        hashes().iter().for_each(|(name, hash)| println!("pin {name} {hash}"));
        return;
    }
    let mut found = Vec::new();
    for (tier, engine) in instructions() {
        let pins = run(&tier, &engine);
        assert_eq!(pins.len(), METHODS.len() + STORED.len(), "{tier}/{engine}");
        found.extend(pins.into_iter().map(|(method, hash)| (method, hash, format!("{tier}/{engine}"))));
    }
    if env::var("DEMC_PINS").is_ok_and(|wanted| wanted == "write") {
        return write(found);
    }
    let pinned = read();
    let known: BTreeSet<&String> = pinned.keys().map(|(_, instructions)| instructions).collect();
    assert!(known.contains(&"portable/portable".to_owned()), "every processor has these");
    let (mut changed, mut missing) = (Vec::new(), Vec::new());
    for (method, hash, instructions) in found {
        match pinned.get(&(method.clone(), instructions.clone())) {
            Some(pin) if *pin != hash => changed.push(format!("{method} on {instructions}")),
            Some(_) => {}
            None if known.contains(&instructions) => missing.push(format!("{method} on {instructions}")),
            // Instructions that no processor had on which pins were written.
            None => eprintln!("{method} on {instructions} is not pinned"),
        }
    }
    assert!(missing.is_empty(), "not pinned, write the pins anew: {missing:?}");
    assert!(
        changed.is_empty(),
        "other bits than pinned, which only a change of pixels on purpose makes: {changed:?}"
    );
}
