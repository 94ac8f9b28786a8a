//! `demc completions` and `demc man`: what a shell and `man` know of this program, made from the command line
//! itself.

use std::path::PathBuf;

use clap::{Args as ClapArgs, Command};
use clap_complete::Shell;

use super::lines::{ExitCode, print_line};
use crate::{Error, Result};

/// Arguments of `demc completions`.
#[derive(Debug, ClapArgs)]
#[command(after_help = "\
Examples:
  demc completions bash > demc.bash
  demc completions zsh > _demc
  demc completions fish > demc.fish

In ~/.local/share/bash-completion/completions/demc, a folder of zsh's $fpath, or
~/.config/fish/completions they are found by themselves.")]
pub struct CompletionsArgs {
    /// The shell
    shell: Shell,
}

/// Prints a completion script.
///
/// # Errors
/// None.
pub fn completions(args: &CompletionsArgs, command: &Command) -> Result<ExitCode> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut for_users(command), "demc", &mut script);
    print_line(String::from_utf8_lossy(&script).trim_end());
    Ok(ExitCode::SUCCESS)
}

/// Arguments of `demc man`.
#[derive(Debug, ClapArgs)]
#[command(after_help = "\
Examples:
  demc man --out man1")]
pub struct ManArgs {
    /// Folder for demc.1, demc-denoise.1 ...: `man1` below a folder of `manpath`, as ~/.local/share/man
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// Writes the manual pages.
///
/// # Errors
/// The folder cannot be made or written.
pub fn man(args: &ManArgs, command: &Command) -> Result<ExitCode> {
    let out = &args.out;
    std::fs::create_dir_all(out).map_err(Error::io("create", out))?;
    clap_mangen::generate_to(for_users(command), out).map_err(Error::io("write", out))?;
    print_line(&out.join("demc.1").display().to_string());
    Ok(ExitCode::SUCCESS)
}

/// The command line without the hidden subcommands.
fn for_users(command: &Command) -> Command {
    let bare = Command::new("demc").version(env!("CARGO_PKG_VERSION"));
    let bare = command.get_about().cloned().into_iter().fold(bare, Command::about);
    bare.subcommands(command.get_subcommands().filter(|sub| !sub.is_hide_set()).cloned())
}
