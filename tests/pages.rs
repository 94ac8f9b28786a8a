//! The commands of the documentation's pages by user are run from top to bottom, as readers run them, and
//! every link of the documentation must lead somewhere.

mod common;

use std::{
    collections::BTreeSet,
    env, fs,
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use assert_cmd::cargo::cargo_bin;
use common::{python, tables::table};

/// For one block; far more than any takes.
const PATIENCE: Duration = Duration::from_secs(300);

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A block whose info string ends in `run`.
struct Block {
    /// Line of its fence, from 1.
    line: usize,
    language: String,
    text: String,
}

fn blocks(page: &str) -> Vec<Block> {
    let mut blocks = Vec::new();
    let mut lines = page.lines().enumerate();
    while let Some((index, line)) = lines.next() {
        let Some(language) = line.strip_prefix("```").and_then(|info| info.strip_suffix(" run")) else {
            continue;
        };
        let text: Vec<_> = lines.by_ref().map(|(_, line)| line).take_while(|line| *line != "```").collect();
        blocks.push(Block { line: index + 1, language: language.into(), text: text.join("\n") });
    }
    blocks
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let target = to.join(path.file_name().unwrap());
        if path.is_dir() {
            copy(&path, &target);
        } else {
            fs::copy(&path, &target).unwrap();
        }
    }
}

/// Runs all blocks in a folder that holds what the pages name of the repository.
#[track_caller]
fn run_page(name: &str) {
    let blocks = blocks(&fs::read_to_string(root().join(name)).unwrap());
    assert!(blocks.len() > 3, "{name} has blocks to run");
    let folder = tempfile::tempdir().unwrap();
    for part in ["blender_scripts", "eval/example", "tests/data"] {
        copy(&root().join(part), &folder.path().join(part));
    }
    let python = python::python();
    let mut path: Vec<PathBuf> =
        [&python, &cargo_bin("demc")].map(|program| program.parent().unwrap().to_path_buf()).into();
    path.extend(env::split_paths(&env::var_os("PATH").unwrap_or_default()));
    let path = env::join_paths(path).unwrap();
    for block in blocks {
        let mut command = match block.language.as_str() {
            "sh" => {
                let mut bash = Command::new("bash");
                bash.args(["-euo", "pipefail", "-c"]);
                bash
            }
            "python" => {
                let mut python = Command::new(&python);
                python.arg("-c");
                python
            }
            other => panic!("{name}:{}: nothing runs '{other}'", block.line),
        };
        command.arg(&block.text).current_dir(folder.path()).env("PATH", &path);
        command.env("PYTHONDONTWRITEBYTECODE", "1");
        let output = assert_cmd::Command::from_std(command).timeout(PATIENCE).output().unwrap();
        assert!(
            output.status.success(),
            "{name}:{}: {}\n{}{}",
            block.line,
            output.status,
            String::from_utf8_lossy(&output.stdout),
            String::from_utf8_lossy(&output.stderr)
        );
    }
}

#[test]
fn the_artists_page_runs_from_top_to_bottom() {
    run_page("docs/artists.md");
}

#[test]
fn the_pipelines_page_runs_from_top_to_bottom() {
    run_page("docs/pipelines.md");
}

#[test]
fn the_researchers_page_runs_from_top_to_bottom() {
    run_page("docs/researchers.md");
}

#[test]
fn blocks_are_those_that_say_so() {
    let page = "a\n```\nno\n```\n```sh run\none\n\ntwo\n```\n```python\nno\n```\n```python run\nthree\n```\n";
    let found = blocks(page);
    let found: Vec<_> = found.iter().map(|b| (b.line, b.language.as_str(), b.text.as_str())).collect();
    assert_eq!(found, [(5, "sh", "one\n\ntwo"), (13, "python", "three")]);
}

/// The lines of a page that are no code, with their numbers from 1.
fn prose(page: &str) -> impl Iterator<Item = (usize, &str)> {
    let mut fenced = false;
    page.lines().enumerate().filter_map(move |(index, line)| {
        let fence = line.trim_start().starts_with("```");
        fenced ^= fence;
        (!fenced && !fence).then_some((index + 1, line))
    })
}

/// The targets of a line's links and pictures.
fn links(line: &str) -> impl Iterator<Item = &str> {
    line.split("](").skip(1).filter_map(|rest| rest.split_once(')').map(|(target, _)| target))
}

/// What GitHub makes of a page's headings.
fn anchors(page: &str) -> BTreeSet<String> {
    let headings = prose(page).filter(|(_, line)| line.starts_with('#'));
    let anchor = |(_, line): (usize, &str)| {
        let title = line.trim_start_matches('#').trim().to_lowercase();
        let kept = title.chars().filter(|c| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_'));
        kept.map(|c| if c == ' ' { '-' } else { c }).collect::<String>()
    };
    headings.map(anchor).collect()
}

#[test]
fn every_link_leads_somewhere() {
    let mut pages: Vec<PathBuf> =
        ["README.md", "CONTRIBUTING.md", "eval/README.md", "tests/README.md"].map(|n| root().join(n)).into();
    let docs = fs::read_dir(root().join("docs")).unwrap().map(|entry| entry.unwrap().path());
    pages.extend(docs.filter(|path| path.extension().is_some_and(|e| e == "md")));
    assert!(pages.len() > 10, "pages are found");
    let mut broken = Vec::new();
    for page in &pages {
        let text = fs::read_to_string(page).unwrap();
        for (number, line) in prose(&text) {
            for target in links(line).filter(|target| !target.contains("://")) {
                let (file, anchor) = target.split_once('#').unwrap_or((target, ""));
                let path = if file.is_empty() { page.clone() } else { page.parent().unwrap().join(file) };
                let there = path.exists()
                    && (anchor.is_empty() || anchors(&fs::read_to_string(&path).unwrap()).contains(anchor));
                if !there {
                    broken.push(format!("{}:{number}: {target}", page.display()));
                }
            }
        }
    }
    assert!(broken.is_empty(), "lead nowhere:\n{}", broken.join("\n"));
}

#[test]
fn the_readme_s_table_is_that_of_eval() {
    let readme = fs::read_to_string(root().join("README.md")).unwrap();
    let rows = table(&root().join("eval/val/summary.csv"));
    let mut compared = 0;
    for line in readme.lines().filter_map(|line| line.strip_prefix("| ")) {
        let [method, cells @ ..] = &line.split('|').map(str::trim).collect::<Vec<_>>()[..] else { continue };
        let Some(row) = rows.iter().find(|row| row["model"] == *method && row["spp"] == "all") else {
            continue;
        };
        for (cell, column) in cells.iter().zip(["relmse_ratio", "ssim_mean", "ms_per_mpx_geomean"]) {
            let decimals = cell.split_once('.').map_or(0, |(_, decimals)| decimals.len());
            let value =
                row[column].parse::<f64>().map_or(String::new(), |value| format!("{value:.decimals$}"));
            assert_eq!(*cell, value, "{method}, {column}");
            compared += 1;
        }
    }
    assert_eq!(compared, 7 * 3);
}
