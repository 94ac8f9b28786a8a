//! Dependencies of the program and of the Python module come from crates.io, and their licences let them be
//! given away with these. The `deny.toml` of each says so; `cargo deny` checks the rest of it, such as known
//! flaws.

use std::{collections::HashSet, path::Path, process::Command};

/// The licences that the `deny.toml` of a package allows.
fn allowed(package: &Path) -> HashSet<String> {
    let text = std::fs::read_to_string(package.join("deny.toml")).unwrap();
    let list = text.split_once("allow = [").expect("a list").1.split_once(']').expect("its end").0;
    list.split(',')
        .map(|name| name.trim().trim_matches('"').to_owned())
        .filter(|name| !name.is_empty())
        .collect()
}

/// Whether one of the choices that an SPDX expression leaves is allowed throughout.
fn is_allowed(expression: &str, allowed: &HashSet<String>) -> bool {
    let spaced = expression.replace('/', " OR ").replace('(', " ( ").replace(')', " ) ");
    let words: Vec<&str> = spaced.split_whitespace().collect();
    let (holds, rest) = either(&words, allowed);
    assert!(rest.is_empty(), "{expression} is no licence");
    holds
}

fn either<'a>(words: &'a [&'a str], allowed: &HashSet<String>) -> (bool, &'a [&'a str]) {
    let (mut holds, mut rest) = both(words, allowed);
    while let ["OR", more @ ..] = rest {
        let (other, left) = both(more, allowed);
        (holds, rest) = (holds | other, left);
    }
    (holds, rest)
}

fn both<'a>(words: &'a [&'a str], allowed: &HashSet<String>) -> (bool, &'a [&'a str]) {
    let (mut holds, mut rest) = single(words, allowed);
    while let ["AND", more @ ..] = rest {
        let (other, left) = single(more, allowed);
        (holds, rest) = (holds & other, left);
    }
    (holds, rest)
}

fn single<'a>(words: &'a [&'a str], allowed: &HashSet<String>) -> (bool, &'a [&'a str]) {
    match words {
        ["(", inner @ ..] => {
            let (holds, rest) = either(inner, allowed);
            (holds, rest.strip_prefix(&[")"]).expect("parentheses in pairs"))
        }
        [name, "WITH", exception, rest @ ..] => (allowed.contains(&format!("{name} WITH {exception}")), rest),
        [name, rest @ ..] => (allowed.contains(*name), rest),
        [] => panic!("an expression ends too early"),
    }
}

#[test]
fn expressions_are_read_as_spdx_means_them() {
    let allowed: HashSet<String> = ["MIT", "Apache-2.0", "Unicode-3.0"].map(str::to_owned).into();
    for (expression, expected) in [
        ("MIT", true),
        ("GPL-3.0", false),
        ("MIT/Apache-2.0", true),
        ("GPL-3.0 OR MIT", true),
        ("GPL-3.0 AND MIT", false),
        ("(MIT OR GPL-3.0) AND Unicode-3.0", true),
        ("(MIT OR GPL-3.0) AND Zlib", false),
        ("Apache-2.0 WITH LLVM-exception OR MIT", true),
        ("Apache-2.0 WITH LLVM-exception", false),
    ] {
        assert_eq!(is_allowed(expression, &allowed), expected, "{expression}");
    }
}

/// Checks all that the lock file of the package in `folder` holds for this system.
#[track_caller]
fn check(folder: &str) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder);
    let metadata = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version", "1", "--locked", "--all-features"])
        .args(["--filter-platform", "x86_64-unknown-linux-gnu"])
        .current_dir(&root)
        .output()
        .unwrap();
    assert!(metadata.status.success(), "{}", String::from_utf8_lossy(&metadata.stderr));
    let metadata: serde_json::Value = serde_json::from_slice(&metadata.stdout).unwrap();
    let packages = metadata["packages"].as_array().unwrap();
    assert!(packages.len() > 50, "{} packages", packages.len());
    let allowed = allowed(&root);
    for package in packages {
        let licence = package["license"].as_str().unwrap_or("none");
        assert!(is_allowed(licence, &allowed), "{} is under {licence}", package["name"]);
        let source = package["source"].as_str();
        let is_ours = source.is_none() && (package["name"] == "demc" || package["name"] == "demc-python");
        assert!(
            is_ours || source.is_some_and(|s| s.contains("crates.io")),
            "{} is from {source:?}",
            package["name"]
        );
    }
}

#[test]
fn every_dependency_may_be_given_away_and_comes_from_the_registry() {
    check("");
}

#[test]
fn so_does_every_dependency_of_the_python_module() {
    check("python");
}
