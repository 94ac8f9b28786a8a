//! Programs of Debian's packages, installed where a test may: as root, where there is `apt-get`.

use std::process::{Command, Stdio};

/// Whether one of the choices could be installed; each is the packages that go together.
pub fn install(choices: &[&[&str]]) -> bool {
    // An old list of packages names files that are gone; a failed update may still leave a good one.
    let _ = apt(&["update"]);
    choices.iter().any(|packages| {
        let mut arguments = vec!["install", "--no-install-recommends"];
        arguments.extend(*packages);
        apt(&arguments)
    })
}

fn apt(arguments: &[&str]) -> bool {
    let mut command = Command::new("apt-get");
    command.args(["-o", "DPkg::Lock::Timeout=600", "-q", "-y"]).args(arguments);
    command.env("DEBIAN_FRONTEND", "noninteractive").stdin(Stdio::null());
    command.output().is_ok_and(|output| output.status.success())
}
