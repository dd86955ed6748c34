//! A long-lived owner of both machines, for browsers and for programs in any language. docs/serve.md is its manual.
//!
//! ```text
//! browser, program --HTTP--> http: access, orders --bounded channel--> worker (one thread a machine) --> line
//! |                                                                      ^
//! +-- a stop --> direct (a thread of its own) --> broker of the line's owner
//! browser <--server-sent events-- stream <-- shared state <-- worker
//! ```
//!
//! * [`access`]: decides which requests are allowed.
//! * `http`: the routes, with `bodies`, `answers`, and `records` for downloads.
//! * `orders`: turns the body of a request into an order, using the command line's arguments.
//! * `actions`: commands and their results; each is executed once.
//! * `worker`: connection, orders and telemetry of one machine; `worker::busy` during an action.
//! * `direct`: stops and questions, which bypass the worker.
//! * `shared_state`: the state shared by all of them, and its JSON form.
//! * `open_files`: how many connections are allowed.
//! * `stream`: sends events to all readers.
//!
//! Shared state, worker and direct requests are public because fuzzing drives them without sockets.

pub mod access;
#[doc(hidden)]
pub mod actions;
mod answers;
mod bodies;
#[doc(hidden)]
pub mod direct;
pub mod http;
mod open_files;
#[doc(hidden)]
pub mod orders;
mod records;
#[doc(hidden)]
pub mod shared_state;
pub mod stream;
#[doc(hidden)]
pub mod worker;

use std::fs::{self, OpenOptions, TryLockError};
use std::io::{self, Write};
use std::net::SocketAddr;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::panic::resume_unwind;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{channel, sync_channel};
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::{Duration, SystemTime};

use client::Interrupt;
use client::address::Address;
use client::broker::lock;
use client::identity::kind_name;
use client::limited;
use client::plain::{self, Locked};
use protocol::system::DeviceKind;
use serde_json::{Value, json};
use tokio::net::{TcpListener, TcpSocket};
use tokio::runtime::{Builder, Runtime};
use tokio::time::{interval, sleep, timeout};

use crate::access::{Access, LEAST_TOKEN, new_token};
use crate::direct::DirectRequest;
use crate::http::App;
use crate::open_files::{Connections, LEAST};
use crate::shared_state::{Machine, SharedState};
use crate::worker::Worker;
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;

/// Orders that can wait for a worker; further ones are refused.
pub const ORDERS: usize = 8;
/// The system's send buffer for a slow reader, bytes.
const SEND_BUFFER: u32 = 64 * 1024;
/// Connections that can wait to be accepted. In a longer burst the system drops a connection's first packet, and the
/// client repeats it after a second. A stop cannot wait that long.
const BACKLOG: u32 = 1_024;
/// Interval between states sent to readers.
const STATE: Duration = Duration::from_millis(250);
/// Interval at which the shown campaign is read, and the newest one determined.
const CAMPAIGN: Duration = Duration::from_secs(5);
/// Interval at which the file with the server's address is renewed.
const RENEWED: Duration = Duration::from_secs(3_600);
/// Interval between checks whether the server should shut down.
const POLL: Duration = Duration::from_millis(20);

/// Reads the state of the campaign that runs in a terminal, as the page shows it; none if there is no campaign.
pub type ReadCampaign = dyn Fn() -> Option<Value> + Send + Sync;

pub struct Options {
    pub listen: SocketAddr,
    /// File with the token; without it, each start creates a new token.
    pub token_file: Option<PathBuf>,
    /// Further names by which browsers call this computer.
    pub hosts: Vec<String>,
    pub out: PathBuf,
    /// The shown campaign, which is read every few seconds.
    pub campaign: Arc<ReadCampaign>,
    pub machines: Vec<(DeviceKind, Address)>,
}

/// Serves until the operator ends it; returns the listening address.
///
/// # Errors
/// The address or the token's file cannot be used, or a motion that the server began may continue after its end.
pub fn serve(
    options: Options,
    finder: &Finder<'_>,
    pressed: &Interrupt,
    say: &mut dyn FnMut(&str),
) -> Result<String, Failure> {
    let token = match &options.token_file {
        None => new_token(),
        Some(file) => token_of(file)?,
    };
    let open_files = open_files::raised();
    if open_files < LEAST {
        return Err(Failure::input(
            format!(
                "this system gives {open_files} open files, and the server needs {LEAST}: with fewer a stop may find none"
            ),
            format!("`ulimit -n {LEAST}` or more, then try again"),
        ));
    }
    let connections = Connections::with(open_files);
    let runtime = Builder::new_multi_thread()
        .worker_threads(2)
        .max_blocking_threads(8)
        .enable_io()
        .enable_time()
        .build()
        .map_err(|why| no_place(options.listen, &why))?;
    let listener = bind(&runtime, options.listen).map_err(|why| no_place(options.listen, &why))?;
    let at = listener.local_addr().unwrap_or(options.listen);
    let url = url(at);

    let instance = new_token()[..12].to_owned();
    let (mut machines, mut orders) = (vec![], vec![]);
    for (kind, address) in &options.machines {
        let (sender, receiver) = sync_channel(ORDERS);
        machines.push(Machine::new(*kind, address.clone(), sender));
        orders.push(receiver);
    }
    let shared = Arc::new(SharedState::new(instance.clone(), machines, options.out));
    let (direct, to_do) = channel();
    let access = Access::new(token.clone(), options.hosts);
    let app = Arc::new(App::new(Arc::clone(&shared), access, direct.clone()));

    let server_file = ServerFile::publish(&json!({
        "url": url, "token": token, "instance": instance, "pid": std::process::id(),
    }))
    .map(Arc::new);
    let introduction = introduction(&options.machines, at, &url, &token);
    for text in introduction.into_iter().chain(connections.remark()) {
        say(&text);
    }
    if let Err(why) = &server_file {
        say(&format!(
            "programs will not find this server by themselves: {why}"
        ));
    }

    let leaving = AtomicBool::new(false);
    let reports = thread::scope(|scope| {
        // Dropped on panic as well, so that the threads always end.
        let leave = Leave(&leaving, direct);
        let mut workers = vec![];
        for (machine, orders) in shared.machines.iter().zip(orders) {
            let worker = Worker {
                finder,
                shared: &shared,
                machine,
                orders,
                leaving: &leaving,
                pressed: Arc::clone(pressed),
            };
            let thread = thread::Builder::new().spawn_scoped(scope, move || worker.work());
            workers.push(thread.map_err(Failure::no_thread)?);
        }
        let shared = &*shared;
        thread::Builder::new()
            .spawn_scoped(scope, move || direct::run(scope, finder, shared, &to_do))
            .map_err(Failure::no_thread)?;
        let router = http::router(Arc::clone(&app));
        runtime.spawn(http::listen(listener, router, connections));
        runtime.spawn(tell_states(Arc::clone(&app)));
        runtime.spawn(look_at_campaign(Arc::clone(&app), options.campaign));
        if let Ok(server_file) = &server_file {
            runtime.spawn(keep(Arc::clone(server_file)));
        }
        runtime.block_on(until_rest(shared, pressed, &leaving));
        shared.stream.close();
        drop(leave);
        let reports = workers.into_iter().filter_map(|worker| {
            let report = worker.join();
            report.unwrap_or_else(|why| resume_unwind(why))
        });
        Ok::<_, Failure>(reports.collect::<Vec<_>>())
    })?;
    runtime.shutdown_timeout(Duration::from_millis(500));
    drop(server_file);
    match reports.is_empty() {
        true => Ok(url),
        false => Err(Failure::Stops { reports }),
    }
}

/// Waits for Ctrl-C, and then until the machines moved by this server are at rest or their stops have failed. Stops are
/// accepted until then.
async fn until_rest(shared: &SharedState, pressed: &Interrupt, leaving: &AtomicBool) {
    while pressed().is_none() {
        sleep(POLL).await;
    }
    leaving.store(true, Ordering::Relaxed);
    let moves = |machine: &Machine| machine.acting.load(Ordering::SeqCst);
    while shared.machines.iter().any(moves) {
        sleep(POLL).await;
    }
}

/// Ends the workers and the thread of direct requests when dropped.
struct Leave<'a>(&'a AtomicBool, mpsc::Sender<DirectRequest>);

impl Drop for Leave<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
        let _ = self.1.send(DirectRequest::End);
    }
}

fn bind(runtime: &Runtime, at: SocketAddr) -> io::Result<TcpListener> {
    let _within = runtime.enter();
    let socket = match at {
        SocketAddr::V4(_) => TcpSocket::new_v4()?,
        SocketAddr::V6(_) => TcpSocket::new_v6()?,
    };
    socket.set_reuseaddr(true)?;
    socket.set_send_buffer_size(SEND_BUFFER)?;
    socket.bind(at)?;
    socket.listen(BACKLOG)
}

fn no_place(at: SocketAddr, why: &io::Error) -> Failure {
    Failure::input(
        format!("cannot listen at {at}: {why}"),
        "another program has it, or this computer has no such address: choose with `--listen 127.0.0.1:PORT`; port 0 takes a free one",
    )
}

/// The URL for a browser on this computer.
fn url(at: SocketAddr) -> String {
    let host = match at {
        SocketAddr::V4(v4) if v4.ip().is_unspecified() => "127.0.0.1".to_owned(),
        SocketAddr::V6(v6) if v6.ip().is_unspecified() => "[::1]".to_owned(),
        SocketAddr::V4(v4) => v4.ip().to_string(),
        SocketAddr::V6(v6) => format!("[{}]", v6.ip()),
    };
    format!("http://{host}:{}/", at.port())
}

fn introduction(
    machines: &[(DeviceKind, Address)],
    at: SocketAddr,
    url: &str,
    token: &str,
) -> Vec<String> {
    let finder: Vec<_> = machines
        .iter()
        .map(|(kind, address)| format!("{} at {address}", kind_name(*kind)))
        .collect();
    let mut lines = vec![
        finder.join(", "),
        "Open this address; it carries the token, so keep it to yourself:".to_owned(),
        format!("  {url}#token={token}"),
    ];
    if !at.ip().is_loopback() {
        lines.push(format!(
            "WARNING: everybody in the network of {} can reach this server. Without the token they can do nothing; but nothing is encrypted, and who reads along reads the token and can move the machines. `ssh -L {port}:127.0.0.1:{port} COMPUTER` needs no `--listen`.",
            at.ip(),
            port = at.port(),
        ));
    }
    lines.push("Ctrl-C ends it; what it moves is stopped first.".to_owned());
    lines
}

/// Reads the token from a file; creates file and token if there is none.
fn token_of(file: &Path) -> Result<String, Failure> {
    match limited::read_text(file, limited::BY_HAND) {
        Ok(text) => {
            let (token, shown) = (text.trim(), file.display());
            if is_open_to_others(file).map_err(Failure::file(file))? {
                return Err(Failure::input(
                    format!("{shown}: other users can read or change this file"),
                    format!(
                        "`chmod 600 {shown}`; if somebody may have read it, remove {shown}: a new one is created"
                    ),
                ));
            }
            if token.len() < LEAST_TOKEN || !token.chars().all(|c| c.is_ascii_alphanumeric()) {
                return Err(Failure::input(
                    format!(
                        "{shown}: a token has at least {LEAST_TOKEN} letters and digits, and nothing else"
                    ),
                    "remove the file: a new one is made",
                ));
            }
            Ok(token.to_owned())
        }
        Err(why) if why.kind() == io::ErrorKind::NotFound => {
            let token = new_token();
            private(file, &format!("{token}\n")).map_err(Failure::file(file))?;
            Ok(token)
        }
        Err(why) => Err(Failure::file(file)(why)),
    }
}

/// Whether other users can read or change a file.
fn is_open_to_others(file: &Path) -> io::Result<bool> {
    Ok(fs::metadata(file)?.mode() & 0o077 != 0)
}

/// Creates a file that only this user can read.
fn private(file: &Path, text: &str) -> io::Result<()> {
    let mut options = OpenOptions::new();
    options.write(true).create_new(true).mode(0o600);
    options.open(file)?.write_all(text.as_bytes())
}

/// A file from which programs of the same user read the address of the server.
struct ServerFile {
    file: PathBuf,
    text: String,
    /// Held for its lock: the server file belongs to the first server.
    lock: Locked,
}

impl ServerFile {
    fn publish(content: &Value) -> Result<Self, String> {
        Self::within(&lock::folder()?, content)
    }

    fn within(folder: &Path, content: &Value) -> Result<Self, String> {
        let lock = plain::open_or_create(&folder.join("serve.lock"));
        let lock = lock.map_err(|why| why.to_string())?;
        let lock = Locked::new(lock).map_err(|error| match error {
            TryLockError::WouldBlock => "they find the server that was started before".to_owned(),
            TryLockError::Error(why) => why.to_string(),
        })?;
        let server_file = Self {
            file: folder.join("serve.json"),
            text: content.to_string(),
            lock,
        };
        server_file.write()?;
        Ok(server_file)
    }

    fn write(&self) -> Result<(), String> {
        let new = self.file.with_extension("new");
        let _ = fs::remove_file(&new);
        private(&new, &self.text)
            .and_then(|()| fs::rename(&new, &self.file))
            .map_err(|why| format!("{}: {why}", self.file.display()))
    }

    fn read(&self) -> io::Result<String> {
        plain::read_text(&self.file, limited::BY_HAND)
    }

    /// Renews the modification times of file and lock: systems delete old files from folders of temporary files.
    fn renew(&self) {
        // Another server may have replaced the file.
        if self.read().is_ok_and(|text| text != self.text) {
            return;
        }
        let _ = self.lock.set_modified(SystemTime::now());
        let _ = self.write();
    }
}

impl Drop for ServerFile {
    fn drop(&mut self) {
        // Another server may have replaced the file.
        if self.read().is_ok_and(|text| text == self.text) {
            let _ = fs::remove_file(&self.file);
        }
    }
}

async fn keep(server_file: Arc<ServerFile>) {
    let mut renewals = interval(RENEWED);
    loop {
        renewals.tick().await;
        let server_file = Arc::clone(&server_file);
        let _ = tokio::task::spawn_blocking(move || server_file.renew()).await;
    }
}

/// Sends the state periodically, and soon after a change.
async fn tell_states(app: Arc<App>) {
    loop {
        let _ = timeout(STATE, app.shared.changed.notified()).await;
        app.shared.tell_state();
        sleep(POLL).await;
    }
}

async fn look_at_campaign(app: Arc<App>, read: Arc<ReadCampaign>) {
    let mut looks = interval(CAMPAIGN);
    loop {
        looks.tick().await;
        let read = Arc::clone(&read);
        if let Ok(found) = tokio::task::spawn_blocking(move || read()).await {
            app.shared.show_campaign(found.unwrap_or_default());
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::UNIX_EPOCH;

    use super::*;

    #[test]
    fn a_token_is_kept_in_a_file_of_its_own() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("token");
        let token = token_of(&file).expect("made");
        assert_eq!(token_of(&file).expect("read"), token);
        assert!(!is_open_to_others(&file).expect("there"));
        for mode in [0o640, 0o604, 0o620, 0o602] {
            use std::os::unix::fs::PermissionsExt;
            fs::set_permissions(&file, fs::Permissions::from_mode(mode)).expect("mine");
            let why = token_of(&file).expect_err("open to others").to_string();
            assert!(why.contains("other users"), "{why}");
            fs::set_permissions(&file, fs::Permissions::from_mode(0o600)).expect("mine");
        }
        for bad in ["", "short", "with spaces in it, and long enough"] {
            fs::write(&file, bad).expect("written");
            let why = token_of(&file).expect_err("bad").to_string();
            assert!(why.contains("at least 16 letters"), "{why}");
        }
        let shortest = "a".repeat(LEAST_TOKEN);
        fs::write(&file, &shortest).expect("written");
        assert_eq!(token_of(&file).expect("long enough"), shortest);
        // A path that cannot be read is no invitation to write a token there.
        let why = token_of(folder.path()).expect_err("a folder").to_string();
        assert!(!why.contains("exists"), "it was tried: {why}");
    }

    #[test]
    fn the_file_of_the_first_server_stays() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("serve.json");
        let first = ServerFile::within(folder.path(), &json!({"url": "first"})).expect("free");
        let second = ServerFile::within(folder.path(), &json!({"url": "second"}));
        assert!(second.is_err());
        let text = || fs::read_to_string(&file).expect("it is there");
        assert_eq!(text(), first.text);
        // A cleaner of temporary files was there.
        fs::remove_file(&file).expect("removed");
        first.lock.set_modified(UNIX_EPOCH).expect("set");
        first.renew();
        assert_eq!(text(), first.text);
        let lock = fs::metadata(folder.path().join("serve.lock")).expect("it is there");
        assert!(lock.modified().expect("a time") > UNIX_EPOCH);
        // Another server has replaced the file, and renews it itself.
        fs::write(&file, "another").expect("written");
        first.renew();
        assert_eq!(text(), "another");
        fs::write(&file, &first.text).expect("written");
        drop(first);
        assert!(!file.exists());
    }

    #[test]
    fn what_listening_elsewhere_means_is_said() {
        for (at, here, warns) in [
            ("127.0.0.1:7080", "http://127.0.0.1:7080/", false),
            ("0.0.0.0:7080", "http://127.0.0.1:7080/", true),
            ("[::]:7080", "http://[::1]:7080/", true),
            ("192.0.2.7:7080", "http://192.0.2.7:7080/", true),
        ] {
            let at = at.parse().expect("an address");
            let lines = introduction(&[], at, &url(at), "t").join("\n");
            assert!(lines.contains(&format!("{here}#token=t")), "{lines}");
            assert_eq!(lines.contains("nothing is encrypted"), warns, "{lines}");
        }
    }
}
