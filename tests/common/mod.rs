//! What several test binaries share. Each uses its own part of it.
#![allow(dead_code)]

pub mod browser;
pub mod debian;
pub mod files;
pub mod python;
pub mod shot;
pub mod tables;

/// How results tell which version made them.
pub const BY: &str = concat!("demc ", env!("CARGO_PKG_VERSION"));

/// The program under test.
pub fn demc() -> assert_cmd::Command {
    assert_cmd::Command::cargo_bin("demc").unwrap()
}
