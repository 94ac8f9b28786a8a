//! Whole networks: a training step, 1280x720 inference, the built-in models, cost by size of frame.
//!
//! ```text
//! cargo bench --bench network                     a table; rounds interleaved, medians
//! cargo bench --bench network -- train            only the jobs whose name holds a word
//! cargo bench --bench network -- --sizes a.csv demc-m    cost per pixel from 256x256 to 7680x4320
//! cargo bench --bench network -- --worker         answers eval/rivals_bench/run.py
//! ```
//! `--rounds N` (default 5) sets the rounds, `--small` shrinks everything to test the bench itself.
//! `base16` is the paper's dual encoder with the widths 16,32,64,128,128.

mod peak;

use std::{
    io::{BufRead, Write},
    path::PathBuf,
    time::Instant,
};

use demc::{
    kernels::{Shape, simd::Tier},
    models::{
        self, catalogue,
        demc::PAPER_WIDTHS,
        network::{Architecture, Batch, Config, Network},
    },
    nn::{Precision, Stats, clear_buffers},
    passes::{Pass, PassSet},
    planes::Planes,
    rng::Rng,
    shot::Shot,
    train::{Loss, Optimizer, Rule},
};
use dfdx::tensor_ops::Backward;

const BASE16: [usize; 5] = [16, 32, 64, 128, 128];
/// Crops of a training step, and their rows and columns.
const CROPS: (usize, usize) = (8, 128);
const SIZES: [(usize, usize); 6] =
    [(256, 256), (512, 512), (1280, 720), (1920, 1080), (3840, 2160), (7680, 4320)];
/// The models that are timed: those that read what [`frame`] makes.
const LADDER: [&str; 3] = ["demc-s", "demc-m", "demc-l"];
/// The size with which the cost at other sizes is compared.
const USUAL: (usize, usize) = (1280, 720);

/// Something to time.
struct Job {
    name: String,
    /// Floating-point operations of one run, where they are counted.
    flops: Option<f64>,
    /// Makes what is timed. It is called on first use, as a worker may be asked for one job only.
    make: Box<dyn Fn() -> Box<dyn FnMut()>>,
}

/// What the command line says.
struct Arguments {
    rounds: usize,
    small: bool,
    words: Vec<String>,
}

fn main() {
    // As in `demc`, this thread becomes one of rayon's. From any other thread, each of a network's steps
    // would have to wake rayon's threads up first.
    rayon::ThreadPoolBuilder::new().use_current_thread().build_global().expect("nothing ran before");
    let mut args = std::env::args().skip(1).filter(|a| a != "--bench");
    let mut arguments = Arguments { rounds: 5, small: false, words: Vec::new() };
    let (mut worker, mut sizes) = (false, None);
    while let Some(arg) = args.next() {
        let mut value = || args.next().unwrap_or_else(|| panic!("{arg} wants a value"));
        match arg.as_str() {
            "--rounds" => arguments.rounds = value().parse().expect("--rounds wants a number"),
            "--sizes" => sizes = Some(PathBuf::from(value())),
            "--small" => arguments.small = true,
            "--worker" => worker = true,
            word if !word.starts_with('-') => arguments.words.push(word.into()),
            other => panic!("{other}: unknown; see the top of benches/network.rs"),
        }
    }
    match sizes {
        Some(csv) => cost_by_size(&csv, &arguments),
        None if worker => serve(&jobs(arguments.small)),
        None => compare(&arguments),
    }
}

/// Every job, cheap to list.
fn jobs(small: bool) -> Vec<Job> {
    let (width, height) = if small { (160, 96) } else { USUAL };
    let crops = if small { (2, 32) } else { CROPS };
    let mut jobs = Vec::new();
    for precision in [Precision::F32, Precision::Bf16] {
        let label = format!("{precision:?}").to_lowercase();
        let macs = base16(precision).macs_per_pixel();
        jobs.push(Job {
            name: format!("train base16 {label}"),
            // Forward, input gradient, weight gradient.
            flops: Some(3.0 * 2.0 * macs * (crops.0 * crops.1 * crops.1) as f64),
            make: Box::new(move || train_step(precision, crops)),
        });
        jobs.push(Job {
            name: format!("infer base16 {label}"),
            flops: Some(2.0 * macs * (width * height.next_multiple_of(32)) as f64),
            make: Box::new(move || infer(base16(precision), (width, height))),
        });
    }
    let paper = || paper_network(PAPER_WIDTHS.to_vec(), Precision::F32);
    if !small {
        jobs.push(Job {
            name: "infer paper widths f32".into(),
            flops: Some(2.0 * paper().macs_per_pixel() * (width * height.next_multiple_of(32)) as f64),
            make: Box::new(move || infer(paper(), (width, height))),
        });
    }
    for name in LADDER {
        for (width, height) in if small { vec![(160, 96)] } else { vec![USUAL, (1920, 1080)] } {
            let model = catalogue::find(name).expect("it is in the list").learned();
            let macs = model.expect("its weights are built in").macs_per_pixel();
            jobs.push(Job {
                name: format!("{name} {width}x{height}"),
                flops: Some(2.0 * macs * (width * height) as f64),
                make: Box::new(move || {
                    let model = models::open(name).expect("it is built in");
                    let shot = Shot::new(frame(width, height));
                    Box::new(move || drop(model.denoise(&shot).expect("every pass is there")))
                }),
            });
        }
    }
    let steps = if small { 10_000 } else { 20_000_000 };
    let threads = rayon::current_num_threads();
    jobs.push(Job {
        name: "f32 FMA peak".into(),
        flops: Some((threads * peak::flops(steps)) as f64),
        make: Box::new(move || {
            Box::new(move || {
                let tier = Tier::detect();
                divan::black_box(rayon::broadcast(|_| peak::run(tier, divan::black_box(steps))));
            })
        }),
    });
    jobs
}

fn base16(precision: Precision) -> Box<dyn Network> {
    paper_network(BASE16.to_vec(), precision)
}

fn paper_network(widths: Vec<usize>, precision: Precision) -> Box<dyn Network> {
    let mut network = models::build(&Config::new(Architecture::Demc, &widths), 1);
    network.convolutions().into_iter().for_each(|conv| conv.set_precision(precision));
    network
}

/// Network inputs of `n` images: colour, then features.
fn batch(n: usize, width: usize, height: usize) -> Batch {
    let mut rng = Rng::new(1, 1);
    [3, 12]
        .map(|channels| {
            let shape = Shape::new(n, channels, height, width);
            let values = (0..n * channels * height * width).map(|_| rng.uniform()).collect();
            (shape, values)
        })
        .into()
}

/// Forward, loss, backward and update, as `demc train` does, without drawing crops.
fn train_step(precision: Precision, (n, size): (usize, usize)) -> Box<dyn FnMut()> {
    let mut network = base16(precision);
    let batch = batch(n, size, size);
    let reference = vec![0.5; n * 3 * size * size];
    let scales = vec![1.0; n];
    let mut optimizer = Optimizer::new(Rule::Adam, 0.0);
    let mut step = 0;
    Box::new(move || {
        step += 1;
        let mut stats = Stats::Batch(Vec::new());
        let image = network.forward_taped(&batch, &mut stats);
        let loss = Loss::Relmse.of(image, reference.clone(), None, &scales);
        let mut gradients = loss.backward();
        let norm = optimizer.update(step, 1e-5, network.params(), &mut gradients);
        assert!(norm.is_finite(), "the step learns");
    })
}

/// The network alone, planned, from prepared inputs.
fn infer(mut network: Box<dyn Network>, (width, height): (usize, usize)) -> Box<dyn FnMut()> {
    network.freeze();
    let multiple = network.multiple();
    let batch = batch(1, width.next_multiple_of(multiple), height.next_multiple_of(multiple));
    Box::new(move || {
        divan::black_box(network.forward(&batch, &mut Stats::Running).as_vec());
    })
}

/// A frame of noise with the passes of the built-in models.
fn frame(width: usize, height: usize) -> PassSet {
    let mut rng = Rng::new(2, 2);
    let mut set = PassSet::new("noise.exr", "ViewLayer", width, height);
    for pass in [Pass::Combined, Pass::DenoisingAlbedo, Pass::DenoisingNormal] {
        let values = (0..3 * width * height).map(|_| rng.uniform()).collect();
        set.insert(pass, Planes::from_vec(3, width, height, values));
    }
    set
}

fn seconds(mut run: impl FnMut()) -> f64 {
    let start = Instant::now();
    run();
    start.elapsed().as_secs_f64()
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    f64::midpoint(values[(values.len() - 1) / 2], values[values.len() / 2])
}

/// Times all jobs in turns: one turn to warm up, then `rounds` turns.
fn compare(arguments: &Arguments) {
    let mut jobs = jobs(arguments.small);
    let wanted = |name: &str| arguments.words.is_empty() || arguments.words.iter().any(|w| name.contains(w));
    jobs.retain(|job| wanted(&job.name) || job.name.ends_with("peak"));
    let mut running: Vec<_> = jobs.iter().map(|job| (job.make)()).collect();
    let mut times = vec![Vec::new(); jobs.len()];
    for round in 0..=arguments.rounds {
        eprintln!("round {round} of {}", arguments.rounds);
        for (run, times) in running.iter_mut().zip(&mut times) {
            let time = seconds(run);
            if round > 0 {
                times.push(time);
            }
        }
    }
    let medians: Vec<f64> = times.into_iter().map(median).collect();
    let rates: Vec<f64> =
        jobs.iter().zip(&medians).map(|(job, s)| job.flops.unwrap_or(0.0) / s / 1e9).collect();
    let peak = rates.last().copied().unwrap_or(f64::NAN);
    println!("{} threads, {:?}", rayon::current_num_threads(), Tier::detect());
    println!("{:<28} {:>10} {:>10} {:>8}", "", "ms", "GFLOP/s", "of peak");
    for ((job, seconds), rate) in jobs.iter().zip(&medians).zip(&rates) {
        let share = 100.0 * rate / peak;
        println!("{:<28} {:>10.1} {rate:>10.0} {share:>7.0}%", job.name, seconds * 1e3);
    }
}

/// Prints which jobs there are. Then each line with a job's name is answered by the seconds of one run of it.
fn serve(jobs: &[Job]) {
    let names: Vec<&str> = jobs.iter().map(|job| job.name.as_str()).collect();
    let mut out = std::io::stdout();
    let parameters: usize =
        base16(Precision::F32).params().iter().filter(|p| p.trainable).map(|p| p.values().len()).sum();
    let mut answer =
        |line: String| writeln!(out, "{line}").and_then(|()| out.flush()).expect("the caller listens");
    answer(serde_json::json!({ "jobs": names, "parameters": parameters }).to_string());
    let mut running: Vec<Option<Box<dyn FnMut()>>> = jobs.iter().map(|_| None).collect();
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        let Some(at) = names.iter().position(|name| *name == line.trim()) else {
            answer(format!("no job '{line}'"));
            continue;
        };
        let run = running[at].get_or_insert_with(|| (jobs[at].make)());
        answer(seconds(run).to_string());
    }
}

/// Times every size in turns, each after a run to warm up: what a pixel costs in a small and in a huge frame.
fn cost_by_size(csv: &PathBuf, arguments: &Arguments) {
    let sizes: Vec<(usize, usize)> = if arguments.small { vec![(96, 64), (160, 96)] } else { SIZES.into() };
    let usual = if arguments.small { sizes[1] } else { USUAL };
    let mut rows = Vec::new();
    let wanted = |name: &str| arguments.words.is_empty() || arguments.words.iter().any(|word| word == name);
    for name in LADDER.into_iter().filter(|name| wanted(name)) {
        let model = models::open(name).expect("it is built in");
        let mut times = vec![Vec::new(); sizes.len()];
        for round in 1..=arguments.rounds {
            for (&(width, height), times) in sizes.iter().zip(&mut times) {
                let shot = Shot::new(frame(width, height));
                clear_buffers();
                let run = || drop(model.denoise(&shot).expect("every pass is there"));
                run();
                times.push(seconds(run));
                eprintln!("{name} {width}x{height} round {round}: {:.3} s", times[times.len() - 1]);
            }
        }
        let per_mpx = |(w, h): (usize, usize), s: f64| s * 1e3 / ((w * h) as f64 / 1e6);
        let medians: Vec<f64> = times.into_iter().map(median).collect();
        let costs: Vec<f64> = sizes.iter().zip(&medians).map(|(size, s)| per_mpx(*size, *s)).collect();
        let base = costs[sizes.iter().position(|s| *s == usual).expect("the usual size is in the list")];
        for (((width, height), seconds), cost) in sizes.iter().zip(&medians).zip(&costs) {
            let relative = cost / base;
            println!("{name:<10} {width:>5}x{height:<5} {seconds:>9.3} s {cost:>9.1} ms/Mpx {relative:>6.3}");
            rows.push([
                name.to_string(),
                width.to_string(),
                height.to_string(),
                format!("{seconds:.6}"),
                format!("{cost:.3}"),
                format!("{relative:.4}"),
            ]);
        }
    }
    let mut writer = csv::Writer::from_path(csv).unwrap_or_else(|e| panic!("{}: {e}", csv.display()));
    writer.write_record(["model", "width", "height", "seconds", "ms_per_mpx", "relative"]).expect("writable");
    rows.iter().for_each(|row| writer.write_record(row).expect("writable"));
    writer.flush().expect("writable");
}
