//! What a report was made with and on: enough to make it again, and to know when its times can be
//! compared with another's.

use std::{
    process::Command,
    time::{SystemTime, UNIX_EPOCH},
};

use serde::{Deserialize, Serialize};

use crate::{
    kernels::{narrow::Engine, simd::Tier},
    nn::Precision,
};

/// The program, the machine, and the command.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// The command line, as a shell would take it.
    pub command: String,
    /// Version of demc.
    pub version: String,
    /// Commit it was built from, where the build said so (`DEMC_COMMIT`).
    pub commit: Option<String>,
    /// Processor.
    pub cpu: String,
    /// Logical processors that the process may use.
    pub cores: usize,
    /// Instructions that the kernels use (such as AVX-512, AVX2 or portable code), and the precision to which
    /// networks round the factors of their convolutions.
    pub instructions: String,
    /// Operating system and architecture.
    pub system: String,
    /// When the run began, UTC.
    pub started: String,
}

impl Provenance {
    /// The provenance of what this process makes from now on.
    pub fn now() -> Self {
        let seconds = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |t| t.as_secs());
        Self {
            command: std::env::args_os()
                .map(|word| quote(&word.to_string_lossy()))
                .collect::<Vec<_>>()
                .join(" "),
            version: env!("CARGO_PKG_VERSION").into(),
            commit: option_env!("DEMC_COMMIT").map(Into::into),
            cpu: cpu(),
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            instructions: instructions(),
            system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
            started: utc(seconds),
        }
    }
}

impl Provenance {
    /// What of it a page lists beside the command, by name.
    pub fn facts(&self) -> [(&'static str, String); 4] {
        let commit = self.commit.as_ref().map(|commit| format!(", commit {commit}")).unwrap_or_default();
        [
            ("started", self.started.clone()),
            ("program", format!("demc {}{commit}", self.version)),
            ("processor", format!("{}, {} logical cores, {}", self.cpu, self.cores, self.system)),
            ("kernels", self.instructions.clone()),
        ]
    }
}

/// See [`Provenance::instructions`].
fn instructions() -> String {
    let (tier, engine) = (Tier::detect(), Engine::detect());
    match [Precision::fastest(true), Precision::fastest(false)] {
        [built_in, others] if built_in != others => {
            format!("{tier:?}, {engine:?}, {built_in:?} (built-in), {others:?} (others)")
        }
        [all, _] => format!("{tier:?}, {engine:?}, {all:?}"),
    }
    .to_lowercase()
}

/// The processor's name, where the system tells.
fn cpu() -> String {
    let linux = || {
        let text = std::fs::read_to_string("/proc/cpuinfo").ok()?;
        let line = text.lines().find(|line| line.starts_with("model name"))?;
        Some(line.split_once(':')?.1.trim().to_owned())
    };
    let mac = || {
        let output = Command::new("sysctl").args(["-n", "machdep.cpu.brand_string"]).output().ok()?;
        let name = String::from_utf8(output.stdout).ok()?.trim().to_owned();
        (output.status.success() && !name.is_empty()).then_some(name)
    };
    let windows = || std::env::var("PROCESSOR_IDENTIFIER").ok();
    linux().or_else(mac).or_else(windows).unwrap_or_else(|| "unknown processor".into())
}

/// A word of a command line, quoted where a POSIX shell needs it.
fn quote(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./,:=+@%".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        return word.into();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

/// `2026-11-21 19:04 UTC`, from seconds since 1970. Days to dates: Howard Hinnant, "chrono-Compatible
/// Low-Level Date Algorithms", `civil_from_days`.
fn utc(seconds: u64) -> String {
    let days = seconds / 86_400 + 719_468;
    let (era, day_of_era) = (days / 146_097, days % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let from_march = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * from_march + 2) / 5 + 1;
    let month = if from_march < 10 { from_march + 3 } else { from_march - 9 };
    let year = era * 400 + year_of_era + u64::from(month <= 2);
    format!("{year}-{month:02}-{day:02} {:02}:{:02} UTC", seconds / 3600 % 24, seconds / 60 % 60)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_of_known_moments() {
        // From `date -u -d @N`.
        for (seconds, expected) in [
            (0, "1970-01-01 00:00 UTC"),
            (951_782_399, "2000-02-28 23:59 UTC"),
            (951_782_400, "2000-02-29 00:00 UTC"),
            (1_795_287_840, "2026-11-21 19:04 UTC"),
            (4_107_542_400, "2100-03-01 00:00 UTC"),
        ] {
            assert_eq!(utc(seconds), expected);
        }
    }

    #[test]
    fn commands_are_quoted_for_a_shell() {
        assert_eq!(quote("../data/val-1_a.exr"), "../data/val-1_a.exr");
        assert_eq!(quote("val/*_0004spp.exr"), "'val/*_0004spp.exr'");
        assert_eq!(quote("it's"), r"'it'\''s'");
        assert_eq!(quote(""), "''");
    }

    #[test]
    fn this_machine_has_a_name() {
        let now = Provenance::now();
        assert!(!now.cpu.is_empty() && now.cores > 0 && now.started.ends_with("UTC"), "{now:?}");
    }
}
