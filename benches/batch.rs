//! What a user waits for, and the memory that it takes: a sequence of frames from disk to disk compared with
//! the time of denoising alone, and an 8K frame with all its passes.
//!
//! ```text
//! cargo bench --bench batch                      both
//! cargo bench --bench batch -- --only overlap    32 frames of 1920x1080
//! cargo bench --bench batch -- --only memory     one frame of 7680x4320
//! cargo bench --bench batch -- --only temporal   12 frames of 1920x1080 with their neighbours, and without
//! cargo bench --bench batch -- --only temporal --size 7680x4320 --frames 3
//! ```
//! `--frames N`, `--size WxH` and `--model NAME` change what is measured. `--source FILE` is the render whose
//! passes are repeated, each time at another brightness, until the frame is full, so that noise and
//! compression are those of a render. By default it is the example of this repository. `--noise 1` multiplies
//! every value by a random number, so that nothing compresses.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::{Duration, Instant},
};

use demc::{
    frame::{Frame, NewChannel},
    models,
    passes::{self, Pass},
    shot,
    sources::Sources,
};
use exr::prelude::*;
use half::f16;
use rayon::prelude::*;

/// What the command line says.
struct Arguments {
    only: Option<String>,
    /// 0 where the command line does not say.
    frames: usize,
    size: Option<(usize, usize)>,
    noise: f32,
    model: String,
    source: PathBuf,
}

fn main() {
    // As in `demc`, this thread becomes one of rayon's. From any other thread, each of a network's steps
    // would have to wake rayon's threads up first.
    rayon::ThreadPoolBuilder::new().use_current_thread().build_global().expect("nothing ran before");
    let mut arguments = Arguments {
        only: None,
        frames: 0,
        size: None,
        noise: 0.0,
        model: "demc-m".into(),
        source: Path::new(env!("CARGO_MANIFEST_DIR")).join("eval/example/house_0004spp.exr"),
    };
    let mut args = std::env::args().skip(1).filter(|a| a != "--bench");
    while let Some(arg) = args.next() {
        let value = args.next().unwrap_or_else(|| panic!("{arg} wants a value"));
        match arg.as_str() {
            "--only" => arguments.only = Some(value),
            "--frames" => arguments.frames = value.parse().expect("--frames wants a number"),
            "--size" => {
                let (width, height) = value.split_once('x').expect("--size wants WxH");
                let number = |text: &str| text.parse().expect("--size wants numbers");
                arguments.size = Some((number(width), number(height)));
            }
            "--noise" => arguments.noise = value.parse().expect("--noise wants a number"),
            "--model" => arguments.model = value,
            "--source" => arguments.source = value.into(),
            _ => panic!("{arg}: unknown; see the top of benches/batch.rs"),
        }
    }
    let wants = |what: &str| arguments.only.as_deref().is_none_or(|only| only == what);
    if wants("overlap") {
        overlap(&arguments);
    }
    if wants("memory") {
        memory(&arguments);
    }
    // This runs only if it is asked for, since it takes minutes.
    if arguments.only.as_deref() == Some("temporal") {
        temporal(&arguments);
    }
}

/// Writes a render of any size, which is `source` repeated. Every copy is scaled, so that no two compress as
/// one. Every value is also reduced by a random share of at most `noise`, because pixels that do not compress
/// are the worst for memory. `moved` is by how many columns the whole picture has moved to the right,
/// [`STEP`] a frame; a Vector pass then says so.
fn enlarge(source: &Path, (width, height): (usize, usize), noise: f32, moved: Option<usize>, to: &Path) {
    let mut image = read_all_flat_layers_from_file(source).expect("the source is a flat EXR");
    for layer in &mut image.layer_data {
        let (w, h) = (layer.size.width(), layer.size.height());
        layer.size = Vec2(width, height);
        for channel in &mut layer.channel_data.list {
            // Copies look alike only to a person: the factor changes every mantissa.
            let factor = |x: usize, y: usize| 0.7 + 0.6 * (((y / h) * 131 + (x / w) * 71) % 97) as f32 / 97.0;
            let column = |i: usize| (i % width + width - moved.unwrap_or(0)) % width;
            let at = |i: usize| (i / width % h) * w + column(i) % w;
            let chance = |i: usize| {
                (i as u32).wrapping_mul(0x9E37_79B9).rotate_left(13).wrapping_mul(0x85EB_CA6B) >> 8
            };
            let uniform = |i: usize| chance(i) as f32 / (1 << 24) as f32;
            let scale = |i: usize| factor(column(i), i / width) * (1.0 - noise * uniform(i));
            channel.sample_data = match &channel.sample_data {
                FlatSamples::F16(old) => FlatSamples::F16(
                    (0..width * height)
                        .into_par_iter()
                        .map(|i| f16::from_f32(old[at(i)].to_f32() * scale(i)))
                        .collect(),
                ),
                FlatSamples::F32(old) => FlatSamples::F32(
                    (0..width * height).into_par_iter().map(|i| old[at(i)] * scale(i)).collect(),
                ),
                FlatSamples::U32(old) => {
                    FlatSamples::U32((0..width * height).into_par_iter().map(|i| old[at(i)]).collect())
                }
            };
        }
    }
    if moved.is_some() {
        let mut vector = image.layer_data[0].clone();
        vector.attributes.layer_name = Some("ViewLayer.Vector".into());
        let channel = |component: &str, value: f32| AnyChannel {
            name: format!("ViewLayer.Vector.{component}").as_str().into(),
            sample_data: FlatSamples::F32(vec![value; width * height]),
            quantize_linearly: false,
            sampling: Vec2(1, 1),
        };
        // The picture was so many columns further left a frame before, and will be as many further right a
        // frame later.
        let step = -(STEP as f32);
        let channels = [("W", 0.0), ("X", step), ("Y", 0.0), ("Z", step)].map(|(c, v)| channel(c, v));
        vector.channel_data.list = channels.into_iter().collect();
        image.layer_data.push(vector);
    }
    image.attributes.display_window.size = Vec2(width, height);
    image.write().to_file(to).expect("the temporary folder has room");
}

/// Columns by which everything moves from frame to frame of a sequence.
const STEP: usize = 4;

/// Runs `demc denoise` on a folder. Returns the seconds that it took, and the process's peak memory in MiB
/// where the system tells it.
fn denoise(folder: &Path, out: &Path, model: &str, more: &[&str]) -> (f64, Option<f64>) {
    let start = Instant::now();
    let mut child = Command::new(env!("CARGO_BIN_EXE_demc"))
        .args(["denoise", "--overwrite", "--quiet", "--model", model])
        .args(more)
        .arg(folder)
        .arg("--out")
        .arg(out)
        .stdout(Stdio::null())
        .stderr(Stdio::inherit())
        .spawn()
        .expect("demc starts");
    let status_file = format!("/proc/{}/status", child.id());
    let mut peak = None;
    let status = loop {
        if let Some(status) = child.try_wait().expect("a child can be waited for") {
            break status;
        }
        let text = fs::read_to_string(&status_file).unwrap_or_default();
        let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let kib = line.and_then(|rest| rest.split_whitespace().next()?.parse::<f64>().ok());
        peak = kib.map(|kib| kib / 1024.0).or(peak);
        std::thread::sleep(Duration::from_millis(5));
    };
    assert!(status.success(), "demc denoise: {status}");
    (start.elapsed().as_secs_f64(), peak)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Seconds on the clock, and seconds of processor time of all threads together.
#[derive(Clone, Copy)]
struct Cost {
    wall: f64,
    cpu: f64,
}

fn timed<T>(work: impl FnOnce() -> T) -> (T, Cost) {
    let (start, before) = (Instant::now(), cpu_seconds());
    let result = work();
    (result, Cost { wall: start.elapsed().as_secs_f64(), cpu: cpu_seconds() - before })
}

/// Processor time of this process (Linux; elsewhere 0): hundredths of a second, fields 14 and 15 of
/// proc(5)'s stat.
fn cpu_seconds() -> f64 {
    let text = fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let after_name = text.rsplit_once(')').map_or("", |(_, rest)| rest);
    let ticks = after_name.split_whitespace().skip(11).take(2).filter_map(|t| t.parse::<f64>().ok());
    ticks.sum::<f64>() / 100.0
}

/// What a stage takes, as a person reads it.
fn describe(costs: &[Cost]) -> String {
    let wall = median(costs.iter().map(|c| c.wall).collect());
    let cpu = costs.iter().map(|c| c.cpu).sum::<f64>() / costs.len() as f64;
    format!("{wall:.3} s ({cpu:.2} s of processor time)")
}

fn overlap(arguments: &Arguments) {
    let frames = if arguments.frames == 0 { 32 } else { arguments.frames };
    let size = arguments.size.unwrap_or((1920, 1080));
    let folder = tempfile::tempdir().expect("a temporary folder can be made");
    let (input, out) = (folder.path().join("in"), folder.path().join("out"));
    fs::create_dir(&input).expect("the temporary folder is writable");
    let first = input.join("shot.0001.exr");
    enlarge(&arguments.source, size, arguments.noise, None, &first);
    for i in 2..=frames {
        fs::copy(&first, input.join(format!("shot.{i:04}.exr"))).expect("the temporary folder has room");
    }

    // Each stage alone, with all threads.
    let model = models::open(&arguments.model).expect("a model by that name");
    let wanted: Vec<Pass> = [Pass::Combined, Pass::Alpha].iter().chain(model.passes()).copied().collect();
    let (mut reads, mut denoises, mut writes) = (Vec::new(), Vec::new(), Vec::new());
    for round in 0..=5 {
        let ((frame, shot), read) = timed(|| {
            let frame = Frame::read(&first).expect("just written");
            let layers = passes::layers(&frame);
            let layer = passes::choose(&frame, &layers, None).expect("a render has a view layer");
            let shot = shot::prepare_layer(&frame, layer, &wanted, &Sources::default())
                .expect("its passes are known");
            (frame, shot)
        });
        let (image, denoise) = timed(|| model.denoise(&shot).expect("the passes are there"));
        let ((), write) = timed(|| store(frame, &image, &folder.path().join("alone.exr")));
        if round > 0 {
            reads.push(read);
            denoises.push(denoise);
            writes.push(write);
        }
    }
    let pure = median(denoises.iter().map(|c| c.wall).collect()) * frames as f64;
    let (wall, peak) = denoise(&input, &out, &arguments.model, &[]);
    let threads = rayon::current_num_threads();
    println!("{frames} frames of {}x{}, {threads} threads, {}", size.0, size.1, arguments.model);
    for (stage, costs) in [("read", &reads), ("denoise", &denoises), ("write", &writes)] {
        println!("{stage:<8} one frame alone: {}", describe(costs));
    }
    println!("batch {wall:.2} s, pure denoising {pure:.2} s: {:.3} times (target 1.2)", wall / pure);
    if let Some(peak) = peak {
        println!("memory at the peak of the batch: {peak:.0} MiB");
    }
}

/// Adds the layer as `demc denoise` does.
fn store(mut frame: Frame, image: &demc::planes::Planes, to: &Path) {
    let combined = frame
        .parts()
        .iter()
        .position(|part| part.channels.iter().any(|c| c.name.ends_with("Combined.R")))
        .expect("a render has Combined");
    let kind = frame.parts()[combined].channels[0].kind;
    let channels: Vec<NewChannel<'_>> = ["R", "G", "B"]
        .iter()
        .enumerate()
        .map(|(c, component)| NewChannel { component, kind, values: image.channel(c) })
        .collect();
    frame.set_layer(combined, "ViewLayer.Denoised", None, &channels).expect("the part can be encoded");
    frame.write(to).expect("the temporary folder has room");
}

fn memory(arguments: &Arguments) {
    let size = arguments.size.unwrap_or((7680, 4320));
    let folder = tempfile::tempdir().expect("a temporary folder can be made");
    let (input, out) = (folder.path().join("huge.exr"), folder.path().join("out"));
    enlarge(&arguments.source, size, arguments.noise, None, &input);
    let bytes = fs::metadata(&input).expect("just written").len();
    let (seconds, peak) = denoise(&input, &out, &arguments.model, &[]);
    let file = bytes as f64 / f64::from(1 << 20);
    println!(
        "{}x{} with the passes of {}: a file of {file:.0} MiB, {seconds:.1} s",
        size.0,
        size.1,
        arguments.source.display()
    );
    match peak {
        Some(peak) => println!("memory at the peak: {peak:.0} MiB (target 3072)"),
        None => println!("memory at the peak: this system does not tell"),
    }
}

/// Denoises the frames of a sequence one by one, then with two neighbours on each side, in turns, and
/// compares the two.
fn temporal(arguments: &Arguments) {
    let size = arguments.size.unwrap_or((1920, 1080));
    let frames = if arguments.frames == 0 { 12 } else { arguments.frames };
    let folder = tempfile::tempdir().expect("a temporary folder can be made");
    let (input, out) = (folder.path().join("in"), folder.path().join("out"));
    fs::create_dir(&input).expect("the temporary folder is writable");
    for i in 0..frames {
        let to = input.join(format!("shot.{i:04}.exr"));
        enlarge(&arguments.source, size, arguments.noise, Some(i * STEP), &to);
    }
    let rounds = if size.0 * size.1 > 1 << 22 { 1 } else { 3 };
    let (mut ratios, mut peaks) = (Vec::new(), [0.0, 0.0]);
    for _ in 0..rounds {
        let [alone, together] = [&[][..], &["--temporal", "2"][..]].map(|more| {
            let (seconds, peak) = denoise(&input, &out, &arguments.model, more);
            (seconds / frames as f64, peak.unwrap_or(f64::NAN))
        });
        peaks = [alone.1.max(peaks[0]), together.1.max(peaks[1])];
        println!("a frame alone {:.3} s, with its neighbours {:.3} s", alone.0, together.0);
        ratios.push(together.0 / alone.0);
    }
    let (width, height) = size;
    println!(
        "{frames} frames of {width}x{height}, {}: {:.2} times (target 1.6)",
        arguments.model,
        median(ratios)
    );
    let [alone, together] = peaks;
    println!(
        "memory at the peak: {alone:.0} and {together:.0} MiB, {:.2} times (target 1.5)",
        together / alone
    );
}
