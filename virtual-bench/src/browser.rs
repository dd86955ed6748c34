//! A headless Chromium driven over two pipes by its own protocol: just enough to press a button on a page.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::processes::DoorError;

/// Time limit for a page to load; far more than a busy computer needs.
const SOON: Duration = Duration::from_secs(60);
/// The browser uses its descriptors 3 and 4, so a shell duplicates them from standard input and output.
const ON_PIPES: &str = r#"exec "$0" "$@" 3<&0 4>&1 </dev/null >/dev/null 2>&1"#;

/// A browser with one page.
pub(crate) struct Browser {
    child: Child,
    says: BufReader<ChildStdout>,
    hears: ChildStdin,
    commands: u64,
    page: Option<String>,
}

fn wrong(why: impl std::fmt::Display) -> DoorError {
    DoorError::Wrong(format!("the browser: {why}"))
}

impl Browser {
    /// Starts `program` with its data in `folder`, and opens `url`.
    pub(crate) fn open(program: &Path, folder: &Path, url: &str) -> Result<Self, DoorError> {
        let mut child = Command::new("sh")
            .args(["-c", ON_PIPES])
            .arg(program)
            .args([
                "--headless=new",
                "--remote-debugging-pipe",
                // The sandbox does not work inside a container.
                "--no-sandbox",
                "--disable-dev-shm-usage",
                "--disable-gpu",
                "--no-first-run",
                "--window-size=1200,900",
            ])
            .arg(format!("--user-data-dir={}", folder.display()))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        let (Some(hears), Some(says)) = (child.stdin.take(), child.stdout.take()) else {
            return Err(wrong("it has no pipes"));
        };
        let mut browser = Self {
            child,
            says: BufReader::new(says),
            hears,
            commands: 0,
            page: None,
        };
        let target = browser.call("Target.createTarget", json!({ "url": url }))?;
        let attach = json!({ "targetId": target["targetId"], "flatten": true });
        let attached = browser.call("Target.attachToTarget", attach)?;
        browser.page = attached["sessionId"].as_str().map(str::to_owned);
        Ok(browser)
    }

    /// Sends a command and waits for its result. Events are ignored.
    fn call(&mut self, method: &str, params: Value) -> Result<Value, DoorError> {
        self.commands += 1;
        let id = self.commands;
        let mut command = json!({ "id": id, "method": method, "params": params });
        if let Some(page) = &self.page {
            command["sessionId"] = json!(page);
        }
        self.hears.write_all(command.to_string().as_bytes())?;
        self.hears.write_all(&[0])?;
        self.hears.flush()?;
        let mut message = Vec::new();
        loop {
            message.clear();
            self.says.read_until(0, &mut message)?;
            let Some(text) = message.strip_suffix(&[0]) else {
                return Err(wrong("it has ended"));
            };
            let answer: Value = serde_json::from_slice(text).map_err(wrong)?;
            if answer["id"] != id {
                continue;
            }
            return match &answer["error"] {
                Value::Null => Ok(answer["result"].clone()),
                error => Err(wrong(format!("{method}: {error}"))),
            };
        }
    }

    /// The value of an expression in the page.
    fn value(&mut self, expression: &str) -> Result<Value, DoorError> {
        let params = json!({ "expression": expression, "returnByValue": true });
        let result = self.call("Runtime.evaluate", params)?;
        Ok(result["result"]["value"].clone())
    }

    /// Waits until an expression in the page is true.
    pub(crate) fn wait(&mut self, expression: &str) -> Result<(), DoorError> {
        let begin = Instant::now();
        loop {
            // A page that has just begun to load cannot evaluate anything yet.
            let found = self.value(expression);
            if matches!(found, Ok(Value::Bool(true))) {
                return Ok(());
            }
            if begin.elapsed() > SOON {
                return Err(wrong(format!("never: {expression}: {found:?}")));
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Sets the width of the page, pixels.
    pub(crate) fn resize(&mut self, width: u32) -> Result<(), DoorError> {
        let params =
            json!({ "width": width, "height": 900, "deviceScaleFactor": 1, "mobile": false });
        self.call("Emulation.setDeviceMetricsOverride", params)?;
        Ok(())
    }

    /// Position of an element's middle.
    pub(crate) fn middle_of(&mut self, id: &str) -> Result<(f64, f64), DoorError> {
        let expression = format!(
            "(() => {{ const r = document.getElementById('{id}').getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; }})()"
        );
        let middle = self.value(&expression)?;
        match (middle[0].as_f64(), middle[1].as_f64()) {
            (Some(x), Some(y)) => Ok((x, y)),
            _ => Err(wrong(format!("there is no {id}"))),
        }
    }

    /// Presses and releases the left mouse button at this position. Returns when it was pressed.
    pub(crate) fn click(&mut self, (x, y): (f64, f64)) -> Result<Instant, DoorError> {
        let begin = Instant::now();
        for kind in ["mousePressed", "mouseReleased"] {
            let params = json!({ "type": kind, "x": x, "y": y, "button": "left", "clickCount": 1 });
            self.call("Input.dispatchMouseEvent", params)?;
        }
        Ok(begin)
    }

    /// Presses and releases a letter's key. Returns when it was pressed.
    pub(crate) fn press(&mut self, letter: char) -> Result<Instant, DoorError> {
        let begin = Instant::now();
        for kind in ["keyDown", "keyUp"] {
            let mut params = json!({
                "type": kind, "key": letter.to_string(),
                "code": format!("Key{}", letter.to_ascii_uppercase()),
                "windowsVirtualKeyCode": letter.to_ascii_uppercase() as u32,
            });
            if kind == "keyDown" {
                params["text"] = json!(letter.to_string());
            }
            self.call("Input.dispatchKeyEvent", params)?;
        }
        Ok(begin)
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // The child was started as a shell, but `exec` has replaced it by the browser.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
