//! `blender_scripts/farm`: a real Slurm on this machine, a real runner of Open Job Description, and training
//! data from several tasks. In the end all frames must be there, with the bits that a single machine makes.

mod common;

use std::{
    collections::BTreeMap,
    env, fs,
    net::TcpListener,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    sync::OnceLock,
    thread,
    time::{Duration, Instant},
};

use assert_cmd::cargo::cargo_bin;
use common::{
    debian,
    files::write_render,
    python::{self, run},
};
use demc::testset;

/// Far more than anything here takes.
const PATIENCE: Duration = Duration::from_secs(180);
/// Debian's packages of Slurm's two daemons and its commands.
const PACKAGES: [&str; 3] = ["slurmctld", "slurmd", "slurm-client"];

fn farm(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("blender_scripts/farm").join(name)
}

/// Frames 1 to `count` of a sequence, each with noise of its own, in `renders` of a new folder.
fn sequence(count: usize) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let renders = folder.path().join("renders");
    fs::create_dir(&renders).unwrap();
    for frame in 1..=count {
        let path = renders.join(format!("shot_0004spp.{frame:04}.exr"));
        write_render(&path, 64, 36, |_, pixel| ((pixel * 31 + frame) % 97) as f32 / 97.0);
    }
    folder
}

/// The folder's EXR files by name.
fn results(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let paths = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let files = paths.filter(|path| path.is_file());
    files.map(|p| (p.file_name().unwrap().to_str().unwrap().into(), fs::read(&p).unwrap())).collect()
}

/// What one machine makes of all frames.
fn alone(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let out = folder.join("alone");
    let renders = folder.join("renders");
    run(Command::new(cargo_bin("demc"))
        .args(["denoise", "--model", "noisy", "--out"])
        .arg(&out)
        .arg(renders));
    results(&out)
}

#[track_caller]
fn wait_until(what: &str, mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < PATIENCE, "{what}: not within {PATIENCE:?}");
        thread::sleep(Duration::from_millis(100));
    }
}

/// A Slurm of one node on this machine; it ends with the value.
struct Slurm {
    folder: tempfile::TempDir,
    daemons: Vec<Child>,
}

impl Slurm {
    /// None where Slurm is not installed.
    fn start() -> Option<Self> {
        let there = |name: &str| {
            env::split_paths(&env::var_os("PATH").unwrap_or_default())
                .any(|folder| folder.join(name).is_file())
        };
        let complete = || ["slurmctld", "slurmd", "sbatch"].into_iter().all(there);
        // The tests run at the same time; one installs, the others wait.
        static THERE: OnceLock<bool> = OnceLock::new();
        if !THERE.get_or_init(|| complete() || debian::install(&[&PACKAGES]) && complete()) {
            eprintln!(
                "Slurm is not installed, so its array is not tried (Debian: apt-get install {})",
                PACKAGES.join(" ")
            );
            return None;
        }
        let folder = tempfile::tempdir().unwrap();
        let host = run(Command::new("hostname").arg("-s"));
        let host = host.trim();
        let user = run(Command::new("id").arg("-un"));
        let at = |name: &str| folder.path().join(name).display().to_string();
        ["state", "spool"].iter().for_each(|name| fs::create_dir(folder.path().join(name)).unwrap());
        let ports = [(); 2].map(|()| TcpListener::bind("127.0.0.1:0").unwrap());
        let [control, node] = ports.map(|listener| listener.local_addr().unwrap().port());
        let settings = format!(
            "ClusterName=demc\nSlurmctldHost={host}(127.0.0.1)\nSlurmUser={user}\nSlurmdUser={user}\n\
             AuthType=auth/none\nCredType=cred/none\nSlurmctldPort={control}\nSlurmdPort={node}\n\
             StateSaveLocation={}\nSlurmdSpoolDir={}\nSlurmctldPidFile={}\nSlurmdPidFile={}\n\
             SlurmctldLogFile={}\nSlurmdLogFile={}\nProctrackType=proctrack/linuxproc\nTaskPlugin=task/none\n\
             SelectType=select/cons_tres\nSelectTypeParameters=CR_CPU\nSwitchType=switch/none\nMpiDefault=none\n\
             JobAcctGatherType=jobacct_gather/none\nAccountingStorageType=accounting_storage/none\n\
             ReturnToService=2\nKillWait=1\nSlurmdParameters=config_overrides\n\
             NodeName={host} NodeAddr=127.0.0.1 CPUs=4 State=UNKNOWN\n\
             PartitionName=all Nodes={host} Default=YES State=UP\n",
            at("state"),
            at("spool"),
            at("slurmctld.pid"),
            at("slurmd.pid"),
            at("slurmctld.log"),
            at("slurmd.log"),
        );
        fs::write(folder.path().join("slurm.conf"), settings).unwrap();
        let mut slurm = Self { folder, daemons: Vec::new() };
        for arguments in [&["slurmctld", "-i", "-D"][..], &["slurmd", "-D"]] {
            let mut daemon = slurm.command(arguments[0]);
            daemon.args(&arguments[1..]).stdout(Stdio::null()).stderr(Stdio::null());
            slurm.daemons.push(daemon.spawn().unwrap());
        }
        let idle =
            || String::from_utf8_lossy(&slurm.command("sinfo").output().unwrap().stdout).contains("idle");
        wait_until("the node is ready", idle);
        Some(slurm)
    }

    fn command(&self, program: impl AsRef<std::ffi::OsStr>) -> Command {
        let mut command = Command::new(program);
        command.env("SLURM_CONF", self.folder.path().join("slurm.conf"));
        command
    }

    /// Splits frames 1 to 12 by fours over `script`, which is given the task's frames; returns the job's
    /// number.
    fn submit(&self, folder: &Path, script: &str) -> String {
        fs::write(folder.join("task.sh"), script).unwrap();
        let mut submit = self.command(farm("slurm.sh"));
        submit.current_dir(folder).args(["--frames", "1-10,11,12", "--chunk", "4", "--logs", "logs", "--"]);
        let said = run(submit.args(["bash", "task.sh", "{frames}", "{task}", "{first}:{after}"]));
        assert!(said.contains("12 frames in 3 tasks; logs in logs"), "{said}");
        said.strip_prefix("job ").unwrap().split_once(':').unwrap().0.to_owned()
    }

    /// Whether the queue holds nothing more; tasks that wait to be run again are let go at once.
    fn is_done(&self) -> bool {
        let queue = run(self.command("squeue").args(["--noheader", "--format=%i %r"]));
        for line in queue.lines().filter(|line| line.ends_with("BeginTime")) {
            // Slurm leaves a task that is put back two minutes; what waits there is this test alone.
            let task = format!("JobId={}", line.split(' ').next().unwrap());
            let _ = self.command("scontrol").args(["update", &task, "StartTime=now"]).output();
        }
        queue.is_empty()
    }
}

impl Drop for Slurm {
    fn drop(&mut self) {
        for daemon in self.daemons.iter_mut().rev() {
            // They end their own children on SIGTERM.
            let _ = Command::new("kill").arg(daemon.id().to_string()).status();
            let _ = daemon.wait();
        }
    }
}

#[test]
fn a_slurm_array_finishes_all_frames_though_a_task_is_killed_half_way() {
    let Some(slurm) = Slurm::start() else { return };
    let folder = sequence(12);
    let expected = alone(folder.path());
    // A task denoises its frames one by one, the killed one dies after its second, as demc would of a
    // `kill -9`.
    let demc = cargo_bin("demc");
    let script = format!(
        "set -e\n\
         echo \"$3\" > range_$2\n\
         n=0\n\
         for frame in ${{1//,/ }}; do\n\
         \x20   '{}' denoise renders --out clean --model noisy --frames \"$frame\" --json\n\
         \x20   n=$((n + 1))\n\
         \x20   if [ $2 = 0001 ] && [ $n = 2 ] && [ ! -e killed ]; then touch killed; kill -9 $$; fi\n\
         done\n",
        demc.display()
    );
    slurm.submit(folder.path(), &script);
    wait_until("all tasks end", || slurm.is_done());

    let log = |name: &str| fs::read_to_string(folder.path().join("logs").join(name)).unwrap();
    assert!(folder.path().join("killed").exists());
    let said = log("0001.err");
    assert!(said.contains("slurm.sh: stopped with status 137; back into the queue"), "{said}");
    assert_eq!(fs::read_to_string(folder.path().join("range_0001")).unwrap(), "5:9\n");
    assert!(
        log("0001.out").contains("\"status\":\"skipped\""),
        "the second try goes on where the first died"
    );
    assert_eq!(results(&folder.path().join("clean")), expected, "all frames, the same bits");

    let mut report = Command::new(demc);
    report.current_dir(folder.path()).arg("report");
    report.args(["logs/0000.out", "logs/0001.out", "logs/0002.out", "--of", "renders"]);
    assert!(run(&mut report).starts_with("12 denoised in "));
}

#[test]
fn a_task_near_its_time_limit_is_stopped_and_goes_on_later() {
    let Some(slurm) = Slurm::start() else { return };
    let folder = sequence(1);
    let script = "trap 'echo stopping; exit 130' TERM\n\
                  if [ ! -e begun_$2 ]; then touch begun_$2; sleep 100 & wait; fi\n\
                  echo finished\n";
    let job = slurm.submit(folder.path(), script);
    let begun = |task: &str| folder.path().join(format!("begun_{task}")).exists();
    wait_until("all tasks begin", || ["0000", "0001", "0002"].iter().all(|task| begun(task)));
    // What Slurm does a minute before the limit.
    run(slurm.command("scancel").args(["--signal=USR1", "--batch", &job]));
    wait_until("all tasks end", || slurm.is_done());
    for task in ["0000", "0001", "0002"] {
        let said = fs::read_to_string(folder.path().join(format!("logs/{task}.out"))).unwrap();
        assert_eq!(said, "stopping\nfinished\n", "{task}");
    }
}

#[test]
fn a_task_that_fails_by_itself_is_not_run_again() {
    let Some(slurm) = Slurm::start() else { return };
    let folder = sequence(1);
    slurm.submit(folder.path(), "echo ran\nexit 3\n");
    wait_until("all tasks end", || slurm.is_done());
    for task in ["0000", "0001", "0002"] {
        let said = fs::read_to_string(folder.path().join(format!("logs/{task}.out"))).unwrap();
        assert_eq!(said, "ran\n", "{task}");
    }
}

#[test]
fn the_slurm_script_names_mistakes() {
    for (arguments, expected) in [
        (&["--chunk", "2", "--", "true"][..], "--frames is missing"),
        (&["--frames", "1-x", "--", "true"], "'1-x' is no list of frames"),
        (&["--frames", "9-1", "--", "true"], "'9-1' holds no frame"),
        (&["--frames", "1-9", "--chunk", "0", "--", "true"], "--chunk 0 is not a number of at least 1"),
        (&["--frames", "1-9"], "no command: write it after --"),
        (&["--frames", "1-9", "demc"], "what is 'demc'?"),
    ] {
        let output = Command::new(farm("slurm.sh")).args(arguments).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.starts_with("slurm.sh: ") && said.contains(expected), "{said}");
    }
}

#[test]
fn the_open_job_description_runs_in_chunks_and_reports() {
    let runner = python::environment_of("requirements_farm.txt");
    let folder = sequence(9);
    let mut expected = alone(folder.path());
    let job = |frames: &str, out: &str| {
        let mut command = Command::new(runner.program("openjd"));
        command.arg("run").arg(farm("denoise.openjd.yaml")).current_dir(folder.path());
        for (name, value) in [
            ("Input", folder.path().join("renders").display().to_string()),
            ("Output", folder.path().join(out).display().to_string()),
            ("Frames", frames.into()),
            ("FramesPerTask", if frames.len() > 100 { "100" } else { "3" }.into()),
            ("Model", "noisy".into()),
            ("ExtraArguments", "--preview --threads 1".into()),
            ("Demc", cargo_bin("demc").display().to_string()),
        ] {
            command.args(["-p", &format!("{name}={value}")]);
        }
        command.output().unwrap()
    };
    let all = job("1-9", "clean");
    let said = String::from_utf8(all.stdout).unwrap();
    assert!(all.status.success(), "{said}{}", String::from_utf8_lossy(&all.stderr));
    assert!(said.contains("9 denoised in "), "{said}");
    let mut made = results(&folder.path().join("clean"));
    made.retain(|name, _| name.ends_with(".exr"));
    assert_eq!(made, expected, "all frames, the same bits");
    assert_eq!(results(&folder.path().join("clean/logs")).len(), 3, "a log a chunk");
    assert!(folder.path().join("clean/shot_0004spp.0001.png").exists(), "further arguments count");

    assert!(job("1-5:2,9", "some").status.success());
    expected.retain(|name, _| ["0001", "0003", "0005", "0009"].iter().any(|frame| name.contains(frame)));
    let mut made = results(&folder.path().join("some"));
    made.retain(|name, _| name.ends_with(".exr"));
    assert_eq!(made, expected);

    // Many single frames in one task, of which some were never rendered.
    let scattered: Vec<String> = (1..80).map(|n| (n * n).to_string()).collect();
    let many = job(&scattered.join(","), "many");
    let said = String::from_utf8_lossy(&many.stdout);
    assert!(
        !many.status.success() && said.contains("3 denoised in ") && said.contains("frames 16,25,"),
        "{said}"
    );

    // A job with a frame that cannot be denoised fails, lists it, and does all others. A quote in a path is no shell's.
    fs::write(folder.path().join("renders/shot_0004spp.0002.exr"), "broken").unwrap();
    let broken = job("1-9", "it's");
    let said = String::from_utf8_lossy(&broken.stdout);
    assert!(
        !broken.status.success() && said.contains("8 denoised in ") && said.contains("0002.exr"),
        "{said}"
    );
    assert_eq!(results(&folder.path().join("it's")).keys().filter(|name| name.ends_with(".exr")).count(), 8);

    // Where a task could not even begin, it fails itself.
    let mut command = Command::new(runner.program("openjd"));
    command.arg("run").arg(farm("denoise.openjd.yaml")).current_dir(folder.path());
    let demc = cargo_bin("demc").display().to_string();
    for value in
        ["Input=renders", "Output=lost", "Frames=1", "Model=lost.safetensors", &format!("Demc={demc}")]
    {
        command.args(["-p", value]);
    }
    let lost = command.output().unwrap();
    let said = String::from_utf8_lossy(&lost.stdout);
    assert!(!lost.status.success() && !said.contains("denoised in"), "{said}");
}

#[test]
fn training_data_of_two_tasks_is_joined_into_one_set() {
    let folder = tempfile::tempdir().unwrap();
    let set = folder.path().join("set");
    let scripts = Path::new(env!("CARGO_MANIFEST_DIR")).join("blender_scripts");
    let python = |script: PathBuf| {
        let mut command = python::interpreter();
        command.arg(script);
        command
    };
    let task = |part: &str, seeds: &str| {
        let mut command = python(scripts.join("generate_scenes.py"));
        command.arg("--out").arg(set.join(part)).args(["--seeds", seeds, "--kinds", "materials,glass"]);
        command.args(["--size", "40", "--spp", "2", "--ref-spp", "8", "--threads", "1"]);
        command
    };
    // Both at once, as on two machines.
    let mut tasks =
        [("0000", "3:5"), ("0001", "5:7")].map(|(part, seeds)| task(part, seeds).spawn().unwrap());
    assert!(tasks.iter_mut().all(|task| task.wait().unwrap().success()));
    let join = || python(farm("join_manifests.py")).arg(&set).output().unwrap();
    let joined = join();
    let said = String::from_utf8(joined.stdout).unwrap();
    assert!(joined.status.success() && said.contains("manifest.csv: 4 pairs"), "{said}");

    let manifest = set.join("manifest.csv");
    let pairs = testset::read(manifest.to_str().unwrap()).unwrap().pairs;
    assert_eq!(pairs.len(), 4);
    assert!(pairs.iter().all(|pair| pair.noisy.is_file() && pair.reference.is_file()));
    let mut check = python(scripts.join("generate_scenes.py"));
    assert!(run(check.arg("--out").arg(&set).arg("--check")).contains("8 of 8 files are as listed"));
    // What was joined is what one task makes of all seeds.
    let whole = folder.path().join("whole");
    run(python(scripts.join("generate_scenes.py")).arg("--out").arg(&whole).args(["--seeds", "3:7"]).args([
        "--kinds",
        "materials,glass",
        "--size",
        "40",
        "--spp",
        "2",
        "--ref-spp",
        "8",
        "--threads",
        "1",
    ]));
    for pair in &pairs {
        let name = pair.noisy.file_name().unwrap();
        assert_eq!(fs::read(&pair.noisy).unwrap(), fs::read(whole.join(name)).unwrap(), "{name:?}");
    }

    // A task that has not come to its first row yet, or was killed within it, is left out.
    for (part, text) in [("0003", ""), ("0004", "scene,noi")] {
        fs::create_dir(set.join(part)).unwrap();
        fs::write(set.join(part).join("manifest.csv"), text).unwrap();
        let told = join();
        let note = format!("{part}/manifest.csv holds nothing yet");
        assert!(told.status.success() && String::from_utf8_lossy(&told.stderr).contains(&note));
    }
    let foreign = set.join("0004/manifest.csv");
    fs::write(&foreign, "x,y\n1,2\n").unwrap();
    assert!(String::from_utf8_lossy(&join().stderr).contains("0004/manifest.csv has no column noisy"));
    fs::remove_file(foreign).unwrap();

    // The same again; and two tasks of one seed are refused, with the set left as it was.
    let before = fs::read(&manifest).unwrap();
    assert!(join().status.success());
    assert_eq!(fs::read(&manifest).unwrap(), before);
    let copy = set.join("0002");
    fs::create_dir(&copy).unwrap();
    fs::copy(set.join("0001/manifest.csv"), copy.join("manifest.csv")).unwrap();
    let refused = join();
    let said = String::from_utf8(refused.stderr).unwrap();
    assert_eq!(refused.status.code(), Some(1), "{said}");
    assert!(said.contains("are of one seed: give every task seeds of its own"), "{said}");
    assert_eq!(fs::read(&manifest).unwrap(), before);
}
