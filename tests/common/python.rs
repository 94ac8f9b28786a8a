//! The Python environment that the tests judge demc with: made on first use under `target/python`,
//! from pinned requirements, and shared by all test binaries, also when several start at once.
//!
//! A missing Python 3.11 or a failed installation fails the test with one line; nothing is skipped.

use std::{
    ffi::OsStr,
    fs::{self, File},
    hash::{DefaultHasher, Hash, Hasher},
    io::ErrorKind,
    path::{Path, PathBuf},
    process::{Command, Output},
    sync::OnceLock,
};

/// The only Python that bpy 4.5 and 5.0 install on.
const VERSION: &str = "3.11";
/// A file that is written last; an environment without it is unfinished and made anew.
const MARKER: &str = "complete";

/// An installed environment.
#[derive(Clone, Debug)]
pub struct Environment {
    root: PathBuf,
}

impl Environment {
    /// The interpreter.
    pub fn python(&self) -> PathBuf {
        self.program("python")
    }

    /// A program that a package installed: `idiff`, `oiiotool`.
    pub fn program(&self, name: &str) -> PathBuf {
        let (folder, suffix) = if cfg!(windows) { ("Scripts", ".exe") } else { ("bin", "") };
        self.root.join(folder).join(format!("{name}{suffix}"))
    }

    /// A program of Open Image Denoise, which the package keeps in a folder of its own.
    pub fn oidn_program(&self, name: &str) -> PathBuf {
        let find = "import importlib.util as u; print(u.find_spec('pyoidn').submodule_search_locations[0])";
        let output = run(Command::new(self.python()).args(["-c", find]));
        let suffix = if cfg!(windows) { ".exe" } else { "" };
        Path::new(output.trim()).join("oidn").join("bin").join(format!("{name}{suffix}"))
    }
}

/// The environment of `tests/requirements.txt`.
pub fn environment() -> &'static Environment {
    static ENVIRONMENT: OnceLock<Environment> = OnceLock::new();
    ENVIRONMENT.get_or_init(|| environment_of("requirements.txt"))
}

/// The interpreter of [`environment`].
pub fn python() -> PathBuf {
    environment().python()
}

/// It, ready to run. Old byte code must not hide a change of the scripts, nor new byte code litter the source tree.
pub fn interpreter() -> Command {
    let mut command = Command::new(python());
    command.env("PYTHONDONTWRITEBYTECODE", "1");
    command
}

/// The Pythons with the versions of bpy on which the scripts must work.
pub fn blenders() -> Vec<PathBuf> {
    let older = std::env::var_os("DEMC_BPY45").map(PathBuf::from);
    if older.is_none() {
        eprintln!("DEMC_BPY45 is not set: tried on bpy 5.0 alone (see tests/README.md)");
    }
    [python()].into_iter().chain(older).collect()
}

/// A program of [`environment`]: `idiff`, `oiiotool`.
pub fn program(name: &str) -> PathBuf {
    environment().program(name)
}

/// The environment of another requirements file in `tests/`.
pub fn environment_of(requirements: &str) -> Environment {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests").join(requirements);
    let text = fs::read_to_string(&file).unwrap_or_else(|e| panic!("{}: cannot read: {e}", file.display()));
    let target = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().expect("target/tmp has a parent");
    ensure(&target.join("python"), &text, install)
}

/// The finished environment for `requirements` under `base`; `install` makes it where it is missing.
fn ensure(base: &Path, requirements: &str, install: impl FnOnce(&Path, &str)) -> Environment {
    let mut hasher = DefaultHasher::new();
    requirements.hash(&mut hasher);
    let name = format!("{:016x}", hasher.finish());
    let root = base.join(&name);
    fs::create_dir_all(base).unwrap_or_else(|e| panic!("{}: cannot create: {e}", base.display()));
    // One process installs, the others wait; the lock dies with its holder.
    let lock = File::create(base.join(format!("{name}.lock"))).expect("a lock file can be created");
    lock.lock().expect("the file system supports locks");
    if !root.join(MARKER).is_file() {
        match fs::remove_dir_all(&root) {
            Err(e) if e.kind() != ErrorKind::NotFound => panic!("{}: cannot remove: {e}", root.display()),
            _ => install(&root, requirements),
        }
        fs::write(root.join(MARKER), requirements).expect("the marker can be written");
    }
    Environment { root }
}

/// A virtual environment at `root` with `requirements` installed.
fn install(root: &Path, requirements: &str) {
    eprintln!("making the tests' Python environment in {} (once; about 400 MB)", root.display());
    let python = find_python();
    run(Command::new(&python).args(["-m", "venv"]).arg(root));
    let list = root.join("requirements.txt");
    fs::write(&list, requirements).expect("a new environment is writable");
    let environment = Environment { root: root.to_path_buf() };
    run(Command::new(environment.python())
        .args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-input"])
        .args(["--only-binary", ":all:", "-r"])
        .arg(&list));
}

/// A Python of the right version on the search path.
fn find_python() -> PathBuf {
    let versioned = format!("python{VERSION}");
    let candidates = [versioned.as_str(), "python3", "python"];
    let version = "import sys; print('%d.%d' % sys.version_info[:2])";
    candidates
        .into_iter()
        .find(|name| {
            let output = Command::new(name).args(["-c", version]).output();
            output.is_ok_and(|o| o.status.success() && String::from_utf8_lossy(&o.stdout).trim() == VERSION)
        })
        .map(PathBuf::from)
        .unwrap_or_else(|| {
            panic!(
                "no Python {VERSION} on PATH ({}): the tests need it for bpy; install it",
                candidates.join(", ")
            )
        })
}

/// Runs a command that must succeed and returns its stdout; panics with the program's own words otherwise.
pub fn run(command: &mut Command) -> String {
    let output = output(command);
    assert!(
        output.status.success(),
        "{command:?} failed ({}):\n{}{}",
        output.status,
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).expect("output is UTF-8")
}

/// Runs `program` of the environment with `args`, whatever its exit status.
pub fn run_program<S: AsRef<OsStr>>(name: &str, args: impl IntoIterator<Item = S>) -> Output {
    output(Command::new(program(name)).args(args))
}

fn output(command: &mut Command) -> Output {
    command.output().unwrap_or_else(|e| panic!("{command:?} did not start: {e}"))
}

#[test]
fn environment_is_made_once_and_again_after_a_killed_install() {
    let base = tempfile::tempdir().unwrap();
    let made = std::sync::atomic::AtomicUsize::new(0);
    let fake = |root: &Path, _: &str| {
        assert!(!root.exists(), "leftovers are removed first");
        fs::create_dir_all(root).unwrap();
        std::thread::sleep(std::time::Duration::from_millis(50));
        made.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
    };
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| ensure(base.path(), "a==1", fake));
        }
    });
    assert_eq!(made.load(std::sync::atomic::Ordering::Relaxed), 1);
    let killed = ensure(base.path(), "a==1", |_, _| panic!("installed already"));
    fs::remove_file(killed.root.join(MARKER)).unwrap();
    ensure(base.path(), "a==1", fake);
    assert_eq!(made.load(std::sync::atomic::Ordering::Relaxed), 2);
    ensure(base.path(), "a==2", fake);
    assert_eq!(made.load(std::sync::atomic::Ordering::Relaxed), 3);
}
