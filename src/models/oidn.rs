//! Open Image Denoise as a peer to be compared with, through its own program `oidnDenoise`.
//!
//! In: Combined, Denoising Albedo and Denoising Normal, handed over as PFM files. Out: its HDR result,
//! with the time that its filter took (not the program's start, nor the files). Nothing of it is
//! linked or shipped: where the program is absent the method says so. <https://www.openimagedenoise.org>

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use super::{Denoiser, Run};
use crate::{Error, Result, features::PREFILTERED_PASSES, passes::Pass, planes::Planes, shot::Shot};

/// Names of the methods, fastest first.
pub const NAMES: [&str; 4] = ["oidn-fast", "oidn-balanced", "oidn-high", "oidn-high-prefilter"];
/// Environment variable that names the program.
pub const VARIABLE: &str = "OIDN_DENOISE";
/// The program's name on the search path.
const PROGRAM: &str = "oidnDenoise";
/// The guides: option, pass, file as rendered, file once denoised.
const GUIDES: [(&str, Pass, &str, &str); 2] = [
    ("--alb", Pass::DenoisingAlbedo, "albedo.pfm", "clean_albedo.pfm"),
    ("--nrm", Pass::DenoisingNormal, "normal.pfm", "clean_normal.pfm"),
];
/// Runs of the filter in one start of the program: the first warms it up, the last is timed.
const RUNS: usize = 2;

/// One quality of Open Image Denoise.
pub struct Oidn {
    name: &'static str,
    program: PathBuf,
}

impl Oidn {
    /// The method by its name. `program` is the path of `oidnDenoise`; by default that of the environment
    /// variable `OIDN_DENOISE`, else the one on the search path. For a name that is not in [`NAMES`] there is
    /// no method.
    pub fn new(name: &str, program: Option<PathBuf>) -> Option<Self> {
        let name = NAMES.into_iter().find(|n| *n == name)?;
        let program: PathBuf =
            program.or_else(|| std::env::var_os(VARIABLE).map(Into::into)).unwrap_or_else(|| PROGRAM.into());
        // The program runs in another folder, so a relative path is made absolute. A bare name is looked for
        // on the search path.
        let is_bare = program.components().count() == 1;
        let absolute = (!is_bare).then(|| std::path::absolute(&program).ok()).flatten();
        Some(Self { name, program: absolute.unwrap_or(program) })
    }

    /// The method of a row of the catalogue.
    ///
    /// # Panics
    /// If it is not in [`NAMES`].
    pub fn boxed(name: &str) -> Box<dyn Denoiser> {
        Box::new(Self::new(name, None).expect("the catalogue's names are those of the qualities"))
    }

    /// Where the program lies. For a bare name it is the first on the search path.
    pub fn program(&self) -> PathBuf {
        let path = std::env::var_os("PATH").unwrap_or_default();
        // As systems find programs: Windows adds what their names end in.
        let mut named = self.program.clone().into_os_string();
        if self.program.extension().is_none() {
            named.push(std::env::consts::EXE_SUFFIX);
        }
        let mut found = std::env::split_paths(&path).map(|folder| folder.join(&named));
        found.find(|program| program.is_file()).unwrap_or_else(|| self.program.clone())
    }

    /// `oidn-high-prefilter` is high quality on guides that were denoised first.
    fn prefilters(&self) -> bool {
        self.name.ends_with("-prefilter")
    }

    fn quality(&self) -> &str {
        self.name.split('-').nth(1).expect("every name has a quality")
    }

    /// One start of the program with `arguments` (inputs as flag and file name) in `folder`.
    fn filter(&self, folder: &Path, arguments: &[&str], output: &str) -> Result<Filtered> {
        let result = Command::new(&self.program)
            .current_dir(folder)
            .args(arguments)
            .args(["-d", "cpu", "-o", output, "-q", self.quality(), "-v", "2"])
            .args(["-n", &RUNS.to_string(), "--threads", &rayon::current_num_threads().to_string()])
            .output();
        let run = result.map_err(|e| {
            Error::Usage(format!(
                "{}: cannot run {}: {e}; install Open Image Denoise and name its program {PROGRAM} by the environment variable {VARIABLE}, or by --oidn \
                 of eval and stability",
                self.name,
                self.program.display()
            ))
        })?;
        let text = String::from_utf8_lossy(&run.stdout);
        if !run.status.success() {
            let said = String::from_utf8_lossy(&run.stderr);
            let said = said.lines().chain(text.lines()).find(|l| l.to_lowercase().contains("error"));
            return Err(Error::invalid(
                &self.program,
                format!("{} failed ({}): {}", self.name, run.status, said.unwrap_or("no message")),
            ));
        }
        read_log(&text).ok_or_else(|| {
            Error::invalid(&self.program, "its log has no time after 'Denoising'; use Open Image Denoise 2.x")
        })
    }
}

/// What the program says about its last run.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Filtered {
    seconds: f64,
    mib: f64,
}

/// Finds the last `msec=` that follows `Denoising`, and the filter's memory.
fn read_log(text: &str) -> Option<Filtered> {
    let (_, runs) = text.split_once("\nDenoising")?;
    let number = |rest: &str| {
        let end = rest.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(rest.len());
        rest[..end].parse::<f64>().ok()
    };
    let msec = number(runs.rsplit_once("msec=")?.1)?;
    let bytes = text.split_once("Memory usage: ").and_then(|(_, rest)| number(rest)).unwrap_or(0.0);
    Some(Filtered { seconds: msec / 1e3, mib: bytes / f64::from(1 << 20) })
}

impl Denoiser for Oidn {
    fn name(&self) -> &str {
        self.name
    }

    fn passes(&self) -> &[Pass] {
        &[Pass::Combined, Pass::DenoisingAlbedo, Pass::DenoisingNormal]
    }

    fn dispensable(&self) -> &[Pass] {
        &PREFILTERED_PASSES
    }

    fn denoise(&self, shot: &Shot) -> Result<Planes> {
        Ok(self.denoise_timed(shot)?.image)
    }

    fn denoise_timed(&self, shot: &Shot) -> Result<Run> {
        let passes = &shot.passes;
        let temporary = tempfile::tempdir().map_err(Error::io("create", std::env::temp_dir()))?;
        let folder = temporary.path();
        write_pfm(&folder.join("color.pfm"), passes.require(Pass::Combined, self.name)?)?;
        // A guide that the frame lacks is not given, nor a normal without an albedo, which the program does
        // not take.
        let mut runs = Vec::new();
        let mut inputs = vec!["--hdr", "color.pfm"];
        for (option, pass, noisy, clean) in GUIDES {
            let Some(planes) = passes.get(pass) else { break };
            write_pfm(&folder.join(noisy), planes)?;
            if self.prefilters() {
                runs.push(self.filter(folder, &[option, noisy], clean)?);
            }
            inputs.extend([option, if self.prefilters() { clean } else { noisy }]);
        }
        if !runs.is_empty() {
            inputs.push("--clean_aux");
        }
        runs.push(self.filter(folder, &inputs, "output.pfm")?);
        let image = read_pfm(&folder.join("output.pfm"))?;
        if (image.width, image.height) != (passes.width, passes.height) {
            return Err(Error::invalid(&self.program, "returned an image of another size"));
        }
        Ok(Run {
            image,
            seconds: runs.iter().map(|r| r.seconds).sum(),
            peak_mib: Some(runs.iter().map(|r| r.mib).fold(0.0, f64::max)),
        })
    }

    fn is_warm(&self) -> bool {
        true
    }
}

/// Writes (3, H, W) as a little-endian colour PFM: interleaved, rows from the bottom up.
fn write_pfm(path: &Path, image: &Planes) -> Result<()> {
    let mut bytes = format!("PF\n{} {}\n-1.0\n", image.width, image.height).into_bytes();
    bytes.reserve(image.data.len() * 4);
    let [r, g, b] = [0, 1, 2].map(|c| image.channel(c));
    for y in (0..image.height).rev() {
        for i in y * image.width..(y + 1) * image.width {
            for value in [r[i], g[i], b[i]] {
                bytes.extend_from_slice(&value.to_le_bytes());
            }
        }
    }
    fs::write(path, bytes).map_err(Error::io("write", path))
}

/// Reads what [`write_pfm`] writes.
fn read_pfm(path: &Path) -> Result<Planes> {
    let bytes = fs::read(path).map_err(Error::io("read", path))?;
    parse_pfm(&bytes).ok_or_else(|| Error::invalid(path, "is no little-endian colour PFM"))
}

fn parse_pfm(bytes: &[u8]) -> Option<Planes> {
    // Three header lines: "PF", "width height", scale (negative: little-endian).
    let mut lines = bytes.splitn(4, |b| *b == b'\n');
    let mut header = || std::str::from_utf8(lines.next()?).ok().map(str::trim);
    if header()? != "PF" {
        return None;
    }
    let (width, height) = header()?.split_once(' ')?;
    let (width, height): (usize, usize) = (width.parse().ok()?, height.trim().parse().ok()?);
    if header()?.parse::<f32>().ok()? >= 0.0 {
        return None;
    }
    let data = lines.next()?;
    if data.len() != width.checked_mul(height)?.checked_mul(12)? {
        return None;
    }
    let mut image = Planes::new(3, width, height);
    for (i, value) in data.chunks_exact(4).enumerate() {
        let (pixel, c) = (i / 3, i % 3);
        let (x, y) = (pixel % width, height - 1 - pixel / width);
        image.channel_mut(c)[y * width + x] = f32::from_le_bytes(value.try_into().expect("chunks of four"));
    }
    Some(image)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::passes::PassSet;

    #[test]
    fn pfm_round_trip_keeps_every_value_in_its_place() {
        let image = Planes::from_vec(3, 5, 3, (0..45).map(|i| i as f32 - 7.5).collect());
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x.pfm");
        write_pfm(&path, &image).unwrap();
        assert_eq!(read_pfm(&path).unwrap(), image);
        let bytes = fs::read(&path).unwrap();
        // The format starts with the bottom left pixel.
        let first = f32::from_le_bytes(bytes[bytes.len() - 180..][..4].try_into().unwrap());
        assert_eq!(first, image.channel(0)[10]);
        assert!(parse_pfm(&bytes[..bytes.len() - 1]).is_none(), "truncated");
        assert!(parse_pfm(b"PF\n1 1\n").is_none());
    }

    #[test]
    fn log_gives_the_last_time_and_the_memory() {
        let log = "Initializing device\n  device=CPU, msec=3.2\nMemory usage: 78643200\n  filter=RT, msec=7.1\n\
                   Denoising\n  msec=214.0, hash=6b\nDenoising 0% Denoising 100%\n  msec=185.5\nSaving output\n";
        assert_eq!(read_log(log), Some(Filtered { seconds: 0.1855, mib: 75.0 }));
        assert_eq!(read_log("Initializing\n msec=3\n"), None, "only what follows Denoising counts");
    }

    #[test]
    fn an_absent_program_says_what_to_do() {
        let method = Oidn::new("oidn-fast", Some("/no/such/program".into())).unwrap();
        let mut passes = PassSet::new("x.exr", "ViewLayer", 1, 1);
        for pass in method.passes() {
            passes.insert(*pass, Planes::new(3, 1, 1));
        }
        let message = method.denoise(&Shot::new(passes)).unwrap_err().to_string();
        assert!(message.contains("/no/such/program") && message.contains("--oidn"), "{message}");
        assert!(Oidn::new("oidn-best", None).is_none());
        let program = |path: &str| Oidn::new("oidn-high", Some(path.into())).unwrap().program;
        assert_eq!(program("bin/oidnDenoise"), std::env::current_dir().unwrap().join("bin/oidnDenoise"));
        assert_eq!(program("oidnDenoise"), Path::new("oidnDenoise"));
    }
}
