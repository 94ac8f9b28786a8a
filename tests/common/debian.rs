//! Installs programs of Debian's packages where a test may do so: as root, on a system with `apt-get`.

use std::process::{Command, Stdio};

/// Installs the first choice that can be installed; returns whether there was one. A choice is one or more
/// packages that go together.
pub fn install(choices: &[&[&str]]) -> bool {
    // An old list of packages names files that are gone. If the update fails, the list may still be good.
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
