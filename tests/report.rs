//! `report.html` in a real browser: it shows everything, sorts, and fetches nothing.

mod common;

use std::{
    fs,
    path::{Path, PathBuf},
};

use assert_cmd::Command as Demc;
use common::{browser::Browser, files::data};
use serde_json::Value;

/// A name that would break a page that does not escape it.
const ODD: &str = "room <b>&amp; \"it's\"";

/// Evaluates two scenes with a method that works and one that cannot, and returns the page.
fn report(out: &Path) -> PathBuf {
    let manifest = out.join("set.csv");
    let mut writer = csv::Writer::from_path(&manifest).unwrap();
    writer.write_record(["scene", "noisy", "reference", "spp"]).unwrap();
    for (scene, file) in [(ODD, "s0000_room"), ("meadow", "s0010_outdoor")] {
        let [noisy, reference] = ["0004spp", "ref"].map(|kind| data(&format!("{file}_{kind}.exr")));
        let cells = [scene, noisy.to_str().unwrap(), reference.to_str().unwrap(), "4"];
        writer.write_record(cells).unwrap();
    }
    writer.flush().unwrap();
    // Weights under another name: a second method with scores.
    let twin = out.join("twin.safetensors");
    fs::copy(Path::new(env!("CARGO_MANIFEST_DIR")).join("src/models/weights/demc-m.safetensors"), &twin)
        .unwrap();
    Demc::cargo_bin("demc")
        .unwrap()
        .args(["eval", "--repeats", "1", "--oidn", "/no/such/program"])
        .args(["--models", &format!("demc-m,{},oidn-high", twin.display()), "--test-set"])
        .arg(&manifest)
        .arg("--out")
        .arg(out)
        .assert()
        .code(1);
    out.join("report.html")
}

/// Methods and values of a column of the first table, as the reader sees them.
fn column(browser: &mut Browser, column: usize) -> (Vec<String>, Vec<Option<f64>>) {
    let script = |cell: usize| {
        format!(
            "[...document.querySelector('table.sortable').tBodies[0].rows].map(r => r.cells[{cell}].dataset.value ?? null)"
        )
    };
    let texts = |v: Value| -> Vec<Option<String>> { serde_json::from_value(v).unwrap() };
    let methods = texts(browser.eval(&script(0))).into_iter().flatten().collect();
    let values = texts(browser.eval(&script(column)));
    (methods, values.into_iter().map(|v| v.map(|v| v.parse().unwrap())).collect())
}

#[test]
fn the_page_shows_everything_sorts_and_fetches_nothing() {
    let out = tempfile::tempdir().unwrap();
    let page = report(out.path());
    assert!(fs::metadata(&page).unwrap().len() < 2 << 20);
    let mut browser = Browser::start(1280, 900);
    browser.open(&page);

    assert_eq!(browser.eval("document.querySelectorAll('section img').length"), 2, "a sheet for each scene");
    let broken = "[...document.images].filter(i => !i.complete || i.naturalWidth < 300).length";
    assert_eq!(browser.eval(broken), 0, "every image was decoded");
    let charts = "[...document.querySelectorAll('figure svg')].map(s => s.getBoundingClientRect().width)";
    let widths: Vec<f64> = serde_json::from_value(browser.eval(charts)).unwrap();
    assert!(widths.len() == 3 && widths.iter().all(|w| (600.0..=1280.0).contains(w)), "{widths:?}");
    for text in ["Pareto front", "RelMSE by scene", "SSIM by scene", "geometric mean"] {
        let within = format!("document.body.textContent.includes('{text}')");
        assert_eq!(browser.eval(&within), true, "{text}");
    }
    // What was given as a name is text, in headings, charts and attributes alike.
    let heading = "document.querySelector('section h3').textContent";
    let headings = browser.eval(heading).as_str().unwrap().to_owned();
    assert!(headings.starts_with("meadow") || headings.starts_with(ODD), "{headings}");
    let quoted = Value::from(ODD);
    let found =
        format!("[...document.querySelectorAll('section h3')].some(h => h.textContent.startsWith({quoted}))");
    assert_eq!(browser.eval(&found), true);
    let links = "[...document.querySelectorAll('nav a')].every(a => document.getElementById(decodeURIComponent(a.hash.slice(1))))";
    assert_eq!(browser.eval(links), true, "every link has its scene");
    assert_eq!(browser.eval("document.querySelectorAll('#failures tbody tr').length"), 1, "one reason");
    let reasons = browser.eval("document.querySelector('#failures').textContent").to_string();
    for text in ["2 of 8 rows failed", "/no/such/program", "meadow, room"] {
        assert!(reasons.contains(text), "{reasons}");
    }
    let how = browser.eval("document.querySelector('dl').textContent").to_string();
    assert!(how.contains("--repeats 1") && how.contains(env!("CARGO_PKG_VERSION")), "{how}");

    sorts_by_click(&mut browser);

    for width in [1280, 700] {
        browser.resize(width, 900);
        let overflow = browser.eval("document.documentElement.scrollWidth - innerWidth").as_i64().unwrap();
        assert!(overflow <= 0, "the page is {overflow} pixels wider than a window of {width}");
    }
    browser.resize(1280, 900);
    browser.screenshot(&Path::new(env!("CARGO_TARGET_TMPDIR")).join("report.png"));

    let record = browser.record();
    assert!(record.errors.is_empty(), "{:#?}", record.errors);
    let own = |url: &&String| url.starts_with("data:") || url.ends_with("/report.html");
    let foreign: Vec<_> = record.requests.iter().filter(|url| !own(url)).collect();
    assert!(foreign.is_empty() && !record.requests.is_empty(), "{foreign:?}");
}

/// Clicks on the second and seventh column (RelMSE, where low is better; SSIM, where high is).
fn sorts_by_click(browser: &mut Browser) {
    let (before, _) = column(browser, 1);
    assert_eq!(before, ["noisy", "demc-m", "twin", "oidn-high"], "in the order given");
    for (at, first_is_low) in [(1, true), (6, false)] {
        for turn in 0..2 {
            browser.click(&format!("table.sortable th:nth-child({}) button", at + 1));
            let (methods, values) = column(browser, at);
            let numbers: Vec<f64> = values.iter().flatten().copied().collect();
            assert_eq!((numbers.len(), methods[3].as_str()), (3, "oidn-high"), "no score, last both ways");
            let is_low_first = first_is_low == (turn == 0);
            let sorted = |w: &[f64]| if is_low_first { w[0] <= w[1] } else { w[0] >= w[1] };
            assert!(numbers.windows(2).all(sorted), "column {at}, click {turn}: {numbers:?}");
            // The input is the worst in both.
            let noisy = methods.iter().position(|m| m == "noisy");
            assert_eq!(noisy, Some(if turn == 0 { 2 } else { 0 }), "column {at}, click {turn}: {methods:?}");
        }
    }
    browser.click("table.sortable th:first-child button");
    assert_eq!(column(browser, 1).0, ["demc-m", "noisy", "oidn-high", "twin"]);
    let others = "document.querySelectorAll('section table.sortable th[aria-sort]').length";
    assert_eq!(browser.eval(others), 0, "other tables stay as they are");
}

#[test]
fn the_browser_notices_faults() {
    let dir = tempfile::tempdir().unwrap();
    let page = dir.path().join("report.html");
    fs::write(
        &page,
        "<!DOCTYPE html><title>x</title><img src='data:image/png;base64,AAAA'><img src='http://127.0.0.1:9/x.png'>\
         <button>b</button><script>document.querySelector('button').onclick = () => nothing.here();</script>",
    )
    .unwrap();
    let mut browser = Browser::start(800, 600);
    browser.open(&page);
    assert_eq!(browser.eval("[...document.images].filter(i => i.naturalWidth > 0).length"), 0);
    browser.click("button");
    let record = browser.record();
    assert!(record.errors.iter().any(|e| e.contains("nothing is not defined")), "{:?}", record.errors);
    assert!(record.requests.iter().any(|r| r.starts_with("http://127.0.0.1:9/")), "{:?}", record.requests);
}
