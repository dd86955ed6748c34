//! `retrograde serve` with the image, and a client of it.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::crowd::Crowd;
use crate::processes::{DoorError, Process, Rig, SOON, wrong};

/// A running server that was found as programs find it.
pub(crate) struct Server {
    pub(crate) process: Process,
    pub(crate) at: String,
    pub(crate) token: String,
    pub(crate) instance: String,
    pub(crate) commands: u32,
}

impl Server {
    pub(crate) fn start(rig: &Rig) -> Result<Self, DoorError> {
        let process = rig.spawn(&["retrograde", "serve", "--listen", "127.0.0.1:0"])?;
        let begin = Instant::now();
        let server_file: Value = loop {
            if let Ok(text) = std::fs::read(rig.folder.path().join("serve.json")) {
                break serde_json::from_slice(&text).map_err(wrong)?;
            }
            if begin.elapsed() > SOON {
                return Err(wrong("the server does not say where it is"));
            }
            thread::sleep(Duration::from_millis(10));
        };
        let text = |name: &str| server_file[name].as_str().unwrap_or_default().to_owned();
        let url = text("url");
        let at = url.trim_start_matches("http://").trim_end_matches('/');
        let server = Self {
            process,
            at: at.to_owned(),
            token: text("token"),
            instance: text("instance"),
            commands: 0,
        };
        while server.get("/api/v1/state")?["machines"]["rig"]["contact"] != "owned" {
            if begin.elapsed() > SOON {
                return Err(wrong("the server has no line"));
            }
            thread::sleep(Duration::from_millis(50));
        }
        Ok(server)
    }

    /// A crowd at this server.
    pub(crate) fn crowd(&self) -> Crowd {
        Crowd::gather(&self.at, &self.token)
    }

    pub(crate) fn request(&self, head: &str, body: &str) -> Result<Value, DoorError> {
        let mut stream = TcpStream::connect(&self.at)?;
        stream.set_read_timeout(Some(SOON))?;
        let text = format!(
            "{head} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\nAuthorization: Bearer {}\r\nIdempotency-Key: {}-{}\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
            self.at,
            self.token,
            self.instance,
            self.commands,
            body.len()
        );
        stream.write_all(text.as_bytes())?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer)?;
        let (_, body) = answer.split_once("\r\n\r\n").unwrap_or_default();
        serde_json::from_str(body).map_err(|why| wrong(format!("{head}: {why}: {answer}")))
    }

    pub(crate) fn get(&self, path: &str) -> Result<Value, DoorError> {
        self.request(&format!("GET {path}"), "")
    }

    /// Begins a command; returns once it is accepted.
    pub(crate) fn begin(&mut self, path: &str, body: &Value) -> Result<Value, DoorError> {
        self.commands += 1;
        let answer = self.request(&format!("POST /api/v1/rig/{path}"), &body.to_string())?;
        match answer["ok"] == true {
            true => Ok(answer["action"].clone()),
            false => Err(wrong(format!("{path}: {answer}"))),
        }
    }

    /// Waits for the end of a command, which must be `wanted`.
    pub(crate) fn end(&self, action: &Value, wanted: &str) -> Result<(), DoorError> {
        let id = action["id"].as_str().unwrap_or_default();
        let begin = Instant::now();
        loop {
            let now = &self.get(&format!("/api/v1/actions/{id}?wait_s=60"))?["action"];
            match now["state"].as_str() {
                Some(state) if state == wanted => return Ok(()),
                Some("under_way" | "starting") if begin.elapsed() < SOON => {}
                _ => return Err(wrong(format!("not {wanted}: {now}"))),
            }
        }
    }

    /// Resident memory of the server process, KiB.
    pub(crate) fn resident_kib(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.process.child.id()));
        let status = status.unwrap_or_default();
        let line = status.lines().find(|line| line.starts_with("VmRSS:"));
        let number = line.and_then(|line| line.split_whitespace().nth(1));
        number.and_then(|text| text.parse().ok()).unwrap_or(0)
    }
}
