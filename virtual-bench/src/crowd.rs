//! Load on the server while a stop is timed: idle connections, clients that have runs planned, and guests at the door
//! of the process that owns the line.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

use client::door::server::GUESTS;
use client::door::window::Window;

use crate::processes::{DoorError, Rig};

/// Connections that send nothing: four times as many as the server keeps.
const IDLE: usize = 1_000;

/// Clients that each request the next plan as soon as they have their answer.
const PLANNING: usize = 64;

/// Time limit for an answer or a welcome, so that a hang becomes an error.
const ANSWER: Duration = Duration::from_secs(30);

/// The crowd at one server. Clients plan until it is dropped; the others are there after [`Crowd::press`].
pub(crate) struct Crowd {
    at: String,
    idle: Vec<TcpStream>,
    guests: Vec<Window>,
    over: Arc<AtomicBool>,
    plans: Arc<AtomicU64>,
}

impl Drop for Crowd {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
    }
}

impl Crowd {
    /// Gathers a crowd at the server at address `at` with this `token`.
    pub(crate) fn gather(at: &str, token: &str) -> Self {
        let (over, plans) = (Arc::<AtomicBool>::default(), Arc::<AtomicU64>::default());
        for client in 1..=PLANNING {
            let (at, over, plans) = (at.to_owned(), Arc::clone(&over), Arc::clone(&plans));
            let body = format!("{{\"cycles\": {client}}}");
            let request = format!(
                "POST /api/v1/plan HTTP/1.1\r\nHost: {at}\r\nConnection: close\r\nAuthorization: Bearer {token}\r\n\
                 Content-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
                body.len()
            );
            thread::spawn(move || {
                while !over.load(Ordering::Relaxed) {
                    match asked(&at, &request) {
                        Ok(answer) if answer.starts_with("HTTP/1.1 200") => {
                            plans.fetch_add(1, Ordering::Relaxed);
                        }
                        // No plan, because there were too many connections: try again.
                        _ => thread::sleep(Duration::from_millis(1)),
                    }
                }
            });
        }
        Self {
            at: at.to_owned(),
            idle: vec![],
            guests: vec![],
            over,
            plans,
        }
    }

    /// Fills the server with new connections and the door with guests, until there is no room for one more.
    pub(crate) fn press(&mut self, rig: &Rig) -> Result<(), DoorError> {
        self.idle.clear();
        for _ in 0..IDLE {
            self.idle.push(TcpStream::connect(&self.at)?);
        }
        // The server accepts connections in order, so after this answer all of them are in.
        let state = "GET /api/v1/state HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n";
        asked(&self.at, state)?;
        let doorway = rig.doorway()?;
        for _ in 0..=GUESTS {
            let guest = Window::open(&doorway, ANSWER)?;
            if guest.is_full() {
                return Ok(());
            }
            self.guests.push(guest);
        }
        Err(DoorError::Wrong(format!(
            "the door lets more than {GUESTS} guests look"
        )))
    }

    /// Drops the guests, because their door has closed.
    pub(crate) fn guests_left(&mut self) {
        self.guests.clear();
    }

    /// The size of the crowd, as text.
    pub(crate) fn described(&self) -> String {
        let plans = self.plans.load(Ordering::Relaxed);
        format!(
            "while {IDLE} connections idle, {GUESTS} guests stay and {PLANNING} clients plan ({plans} plans)"
        )
    }
}

fn asked(at: &str, request: &str) -> std::io::Result<String> {
    let mut stream = TcpStream::connect(at)?;
    stream.set_read_timeout(Some(ANSWER))?;
    stream.write_all(request.as_bytes())?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer)?;
    Ok(answer)
}
