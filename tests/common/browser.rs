//! A real browser without a window, driven by its DevTools protocol
//! (<https://chromedevtools.github.io/devtools-protocol/>): opens a page, clicks, evaluates, and
//! remembers every error and every request.
//!
//! The browser is `$DEMC_BROWSER`, else a Chromium or Chrome on the PATH, else Debian's, installed by
//! `apt-get` where the test may. Without one the test fails with one line; nothing is skipped.

use std::{
    fs::{self, File},
    io::{BufRead, BufReader, Read},
    net::TcpStream,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use serde_json::{Value, json};
use tungstenite::{Message, WebSocket, stream::MaybeTlsStream};

use super::debian;

const NAMES: [&str; 7] = [
    "chromium",
    "chromium-headless-shell",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "microsoft-edge",
];
/// Where installers put the browser outside the PATH.
const PLACES: [&str; 3] = [
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
    r"C:\Program Files\Google\Chrome\Application\chrome.exe",
];
/// Debian packages that hold a browser, smallest first.
const PACKAGES: [&[&str]; 2] = [&["chromium-headless-shell"], &["chromium"]];
const PATIENCE: Duration = Duration::from_secs(120);

/// The browser's program, which is installed first if need be.
fn program() -> PathBuf {
    if let Some(named) = std::env::var_os("DEMC_BROWSER") {
        let named = PathBuf::from(named);
        assert!(named.is_file(), "DEMC_BROWSER={}: no such file", named.display());
        return named;
    }
    // One test binary installs, the others wait; the lock dies with its holder.
    let lock = File::create(Path::new(env!("CARGO_TARGET_TMPDIR")).join("browser.lock")).unwrap();
    lock.lock().expect("the file system supports locks");
    find().or_else(install).unwrap_or_else(|| {
        panic!(
            "no browser to open report.html with: install Chromium or Chrome (Debian: apt-get install {}), \
             or name one in DEMC_BROWSER",
            PACKAGES[0].join(" ")
        )
    })
}

fn find() -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    let folders = std::env::split_paths(&path).chain([PathBuf::from("/usr/bin")]);
    let on_path = folders.flat_map(|folder| NAMES.map(|name| folder.join(name)));
    on_path.chain(PLACES.map(PathBuf::from)).find(|program| program.is_file())
}

fn install() -> Option<PathBuf> {
    eprintln!("installing a browser for the tests (once; about 90 MB)");
    debian::install(&PACKAGES).then(find)?
}

/// What the page said and asked for since it was opened.
#[derive(Debug, Default)]
pub struct Record {
    /// Script errors, errors in the log (a blocked request is one), `console.error`.
    pub errors: Vec<String>,
    /// Addresses requested, cut after 200 letters.
    pub requests: Vec<String>,
}

/// A browser with one open page. It ends when this value is dropped.
pub struct Browser {
    child: Child,
    /// Dropped after the browser was asked to end.
    _group: Group,
    socket: WebSocket<MaybeTlsStream<TcpStream>>,
    session: String,
    last_id: u64,
    record: Record,
    has_loaded: bool,
    _profile: tempfile::TempDir,
}

impl Browser {
    /// Starts the browser with a window of this size.
    pub fn start(width: u32, height: u32) -> Self {
        let program = program();
        let profile = tempfile::tempdir().unwrap();
        let mut command = Command::new(&program);
        command
            .args(["--headless", "--remote-debugging-port=0", "--disable-gpu", "--hide-scrollbars"])
            // Chromium's sandbox refuses to run as root, as in a container; the page is our own.
            .args(["--no-sandbox", "--disable-dev-shm-usage", "--no-first-run", "--disable-sync"])
            .args(["--disable-quic", "--disable-background-networking", "--disable-component-update"])
            .arg(format!("--window-size={width},{height}"))
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .arg("about:blank");
        // A group of its own can be ended as a whole.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut child = command
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap_or_else(|e| panic!("{}: does not start: {e}", program.display()));
        let group = Group(child.id());
        let mut said = BufReader::new(child.stderr.take().expect("stderr is piped"));
        let address = listen_address(&mut said)
            .unwrap_or_else(|said| panic!("{}: no DevTools address:\n{said}", program.display()));
        // Its output is read to the end, since a full pipe would stop it.
        std::thread::spawn(move || std::io::copy(&mut said, &mut std::io::sink()));
        let (socket, _) = tungstenite::connect(address.as_str()).expect("DevTools listens");
        if let MaybeTlsStream::Plain(stream) = socket.get_ref() {
            stream.set_read_timeout(Some(PATIENCE)).unwrap();
        }
        let (session, record) = (String::new(), Record::default());
        let mut browser = Self {
            child,
            _group: group,
            socket,
            session,
            last_id: 0,
            record,
            has_loaded: false,
            _profile: profile,
        };
        let target = browser.call("Target.createTarget", json!({ "url": "about:blank" }));
        let attach = json!({ "targetId": target["targetId"], "flatten": true });
        let session = browser.call("Target.attachToTarget", attach);
        browser.session = session["sessionId"].as_str().expect("a session has a name").into();
        for domain in ["Page", "Runtime", "Network", "Log"] {
            browser.call(&format!("{domain}.enable"), json!({}));
        }
        browser.resize(width, height);
        browser
    }

    /// Opens a file and waits until the page and all that it holds are loaded.
    pub fn open(&mut self, path: &Path) {
        let path = fs::canonicalize(path).unwrap();
        self.record = Record::default();
        self.has_loaded = false;
        let letters = path.to_str().unwrap().bytes().map(|b| match b {
            b if b.is_ascii_alphanumeric() || b"/-_.~".contains(&b) => char::from(b).to_string(),
            b => format!("%{b:02X}"),
        });
        let url = format!("file://{}", letters.collect::<String>());
        let answer = self.call("Page.navigate", json!({ "url": url }));
        assert!(answer.get("errorText").is_none(), "{url}: {answer}");
        let start = Instant::now();
        while !self.has_loaded {
            assert!(start.elapsed() < PATIENCE, "{url}: still loading");
            self.receive();
        }
    }

    /// Errors and requests since the page was opened.
    pub fn record(&mut self) -> &Record {
        // Events arrive in order, so the answer to this comes after all that happened before.
        self.eval("0");
        &self.record
    }

    /// The value of a JavaScript expression.
    pub fn eval(&mut self, expression: &str) -> Value {
        let parameters = json!({ "expression": expression, "returnByValue": true, "awaitPromise": true });
        let answer = self.call("Runtime.evaluate", parameters);
        assert!(answer.get("exceptionDetails").is_none(), "{expression}: {}", answer["exceptionDetails"]);
        answer["result"]["value"].clone()
    }

    /// Clicks with the mouse on the middle of what a CSS selector finds.
    pub fn click(&mut self, selector: &str) {
        let quoted = Value::from(selector).to_string();
        let place = self.eval(&format!(
            "(() => {{ const e = document.querySelector({quoted}); if (!e) return null;
               e.scrollIntoView({{ block: 'center', inline: 'center', behavior: 'instant' }});
               const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; }})()"
        ));
        assert!(place.is_array(), "nothing is {selector}");
        for kind in ["mousePressed", "mouseReleased"] {
            let event =
                json!({ "type": kind, "x": place[0], "y": place[1], "button": "left", "clickCount": 1 });
            self.call("Input.dispatchMouseEvent", event);
        }
    }

    /// Gives the page a window of another size.
    pub fn resize(&mut self, width: u32, height: u32) {
        let size = json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": false });
        self.call("Emulation.setDeviceMetricsOverride", size);
    }

    /// Saves what the whole page looks like, for a person to look at.
    pub fn screenshot(&mut self, path: &Path) {
        let answer =
            self.call("Page.captureScreenshot", json!({ "format": "png", "captureBeyondViewport": true }));
        let text = answer["data"].as_str().expect("a screenshot has data");
        let bytes = base64::Engine::decode(&base64::engine::general_purpose::STANDARD, text).unwrap();
        fs::write(path, bytes).unwrap();
    }

    fn call(&mut self, method: &str, parameters: Value) -> Value {
        self.last_id += 1;
        let id = self.last_id;
        let mut message = json!({ "id": id, "method": method, "params": parameters });
        if !self.session.is_empty() {
            message["sessionId"] = self.session.as_str().into();
        }
        self.socket.send(Message::text(message.to_string())).expect("the browser listens");
        loop {
            let answer = self.receive();
            if answer["id"] == id {
                assert!(answer.get("error").is_none(), "{method}: {}", answer["error"]);
                return answer["result"].clone();
            }
        }
    }

    /// The next message; events go to the record.
    fn receive(&mut self) -> Value {
        let message = loop {
            match self.socket.read().expect("the browser answers") {
                Message::Text(text) => break text,
                _ => continue,
            }
        };
        let message: Value = serde_json::from_str(&message).expect("DevTools speaks JSON");
        let event = &message["params"];
        match message["method"].as_str() {
            Some("Page.loadEventFired") => self.has_loaded = true,
            Some("Runtime.exceptionThrown") => self.record.errors.push(event.to_string()),
            Some("Runtime.consoleAPICalled") if event["type"] == "error" => {
                self.record.errors.push(event.to_string());
            }
            Some("Log.entryAdded") if event["entry"]["level"] == "error" => {
                self.record.errors.push(event["entry"].to_string());
            }
            Some("Network.requestWillBeSent") => {
                let url = event["request"]["url"].as_str().unwrap_or_default();
                self.record.requests.push(url.chars().take(200).collect());
            }
            _ => {}
        }
        message
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // A browser that is asked to close ends all its processes; a killed wrapper script would leave them.
        let close = json!({ "id": u32::MAX, "method": "Browser.close" });
        let _ = self.socket.send(Message::text(close.to_string()));
        for _ in 0..200 {
            if !matches!(self.child.try_wait(), Ok(None)) {
                return;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Ends every process of a group when it is dropped, those that a wrapper script left behind too.
struct Group(u32);

impl Drop for Group {
    fn drop(&mut self) {
        let _ = Command::new("kill")
            .args(["-KILL", "--", &format!("-{}", self.0)])
            .stderr(Stdio::null())
            .status();
    }
}

/// The address in "DevTools listening on ws://...", or all that was said instead.
fn listen_address(said: &mut BufReader<impl Read>) -> Result<String, String> {
    let mut all = String::new();
    for line in said.lines().map_while(Result::ok) {
        if let Some(address) = line.strip_prefix("DevTools listening on ") {
            return Ok(address.trim().into());
        }
        all += &line;
        all.push('\n');
    }
    Err(all)
}
