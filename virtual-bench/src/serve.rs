//! Serves a machine on TCP in real time, like a serial port, and the fixture at it.
//!
//! The machine runs on its own thread and writes to its client from there. A second thread waits for clients, and a
//! third one for bytes from the client.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use crate::bench::{Bench, BenchError, Input, Outside};
use crate::boards::{capsule, rig};
use crate::emulator::Wiring;
use crate::fixture::{Fixture, Machine, Plug, converse};
use crate::pace::Slow;
use crate::plants::capsule::Parameters;
use crate::plants::rig::RigOptions;
use crate::warm;

/// How long a client may leave its line full before it is disconnected: the machine must not wait for it.
const CLIENT_TIMEOUT: Duration = Duration::from_millis(1);

/// Time for which the machine boots before it is paced, us: time spent on translating its code must not count as lost.
const BOOT_US: u64 = 500_000;

/// Machines to serve, each with its port. Without any, both: the rig on 7001, the capsule on 7002.
#[derive(Clone, Debug, clap::Args)]
pub struct Options {
    /// Port of the rig; 0 for a free one.
    #[arg(long, value_name = "PORT")]
    rig: Option<u16>,
    /// Port of the capsule; 0 for a free one.
    #[arg(long, value_name = "PORT")]
    capsule: Option<u16>,
    /// Also serve a fixture at each machine, for `retrograde commission --yes --fixture`: on this port at the rig, on
    /// the next one at the capsule; 0 for free ones.
    #[arg(long, value_name = "PORT", value_parser = clap::value_parser!(u16).range(..=65_534))]
    fixture: Option<u16>,
}

/// Serves machines until they end.
///
/// # Errors
/// A port is taken, an image is missing, or a machine ended.
pub fn run(options: &Options) -> Result<(), BenchError> {
    let (rig, capsule) = match (options.rig, options.capsule) {
        (None, None) => (Some(7001), Some(7002)),
        chosen => chosen,
    };
    let warming = [
        rig.map(|_| thread::spawn(warm::rig)),
        capsule.map(|_| thread::spawn(warm::capsule)),
    ];
    all_ended(warming.into_iter().flatten())?;
    let mut serving = Vec::new();
    if let Some(port) = rig {
        let bench = rig::start(RigOptions::WITH_BOTH_JUMPERS)?;
        let machine = Machine::Rig(bench.clone());
        serving.push(begin(bench, machine, "rig", port, options.fixture)?);
    }
    if let Some(port) = capsule {
        let bench = capsule::start(Parameters::nominal())?;
        let machine = Machine::Capsule(bench.clone());
        let fixture = options.fixture.map(|port| port + u16::from(port > 0));
        serving.push(begin(bench, machine, "capsule", port, fixture)?);
    }
    all_ended(serving.into_iter())
}

type Running = thread::JoinHandle<Result<(), BenchError>>;

fn all_ended(mut threads: impl Iterator<Item = Running>) -> Result<(), BenchError> {
    threads.try_for_each(|thread| {
        let panicked = |_| BenchError::Ended("a machine's thread failed".into());
        thread.join().map_err(panicked)?
    })
}

/// Serves one machine, and the fixture at it if it has a port.
fn begin<W: Wiring>(
    bench: Bench<W>,
    machine: Machine,
    name: &'static str,
    port: u16,
    fixture: Option<u16>,
) -> Result<Running, BenchError> {
    let plug = Plug::default();
    if let Some(port) = fixture {
        let server = Server::listen(port)?;
        let port = server.port();
        eprintln!("fixture at the {name}: --yes --fixture 127.0.0.1:{port}");
        let fixture = Fixture::new(machine, plug.clone()).served();
        thread::spawn(move || server.serve_fixture(&fixture));
    }
    let server = Server::listen(port)?;
    eprintln!("{name}: --{name} tcp:127.0.0.1:{}", server.port());
    Ok(thread::spawn(move || server.serve(&bench, name, &plug)))
}

/// A machine, or the fixture at one, behind a port of the loopback interface.
pub struct Server {
    listener: TcpListener,
}

/// The client, if there is one.
type Client = Arc<Mutex<Option<TcpStream>>>;

impl Server {
    /// Listens on `port`, or on a free one if it is 0.
    ///
    /// # Errors
    /// [`BenchError::Listen`] when the port is taken.
    pub fn listen(port: u16) -> Result<Self, BenchError> {
        let listener =
            TcpListener::bind(("127.0.0.1", port)).map_err(|why| BenchError::Listen {
                address: format!("127.0.0.1:{port}"),
                why,
            })?;
        Ok(Self { listener })
    }

    /// The port it listens on.
    #[must_use]
    pub fn port(&self) -> u16 {
        self.listener
            .local_addr()
            .map_or(0, |address| address.port())
    }

    /// Runs the machine called `name` in real time forever, for one client at a time: the latest to connect. Connecting
    /// and disconnecting have no effect on the machine. While `plug` is out there is no client, and the machine's bytes
    /// are lost.
    ///
    /// # Errors
    /// [`BenchError::Ended`] when the machine is gone.
    pub fn serve<W: Wiring>(
        self,
        bench: &Bench<W>,
        name: &'static str,
        plug: &Plug,
    ) -> Result<(), BenchError> {
        let client = Client::default();
        let (alive, end) = channel();
        bench.advance_us(BOOT_US)?;
        let input = bench.attach(Box::new(Port {
            name,
            client: Arc::clone(&client),
            plug: plug.clone(),
            _alive: alive,
        }))?;
        let plug = plug.clone();
        thread::spawn(move || accept(&self.listener, &client, &Arc::new(input), &plug));
        // Nothing is ever sent: this returns when the machine drops its end.
        let _ = end.recv();
        bench.visit(|_| ())
    }

    /// Answers one client of this fixture after the other, forever.
    pub fn serve_fixture(&self, fixture: &Fixture) {
        for stream in self.listener.incoming().flatten() {
            // An error of one client ends its conversation, not the server.
            let _ = converse(&stream, fixture);
        }
    }
}

fn held(client: &Client) -> MutexGuard<'_, Option<TcpStream>> {
    client.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Ends the connection, which also wakes the thread that waits for its bytes.
fn hang_up(client: &mut Option<TcpStream>) {
    if let Some(stream) = client.take() {
        let _ = stream.shutdown(Shutdown::Both);
    }
}

fn accept<W: Wiring>(listener: &TcpListener, client: &Client, input: &Arc<Input<W>>, plug: &Plug) {
    for stream in listener.incoming() {
        let Ok(stream) = stream else {
            // Accepting failed, for example because no descriptors are left. Pause, so that this loop does not spin.
            thread::sleep(CLIENT_TIMEOUT);
            continue;
        };
        let ready = stream
            .set_nodelay(true)
            .and_then(|()| stream.set_write_timeout(Some(CLIENT_TIMEOUT)))
            .and_then(|()| stream.try_clone());
        let Ok(reading) = ready else { continue };
        {
            let mut client = held(client);
            hang_up(&mut client);
            *client = Some(stream);
        }
        let (input, plug) = (Arc::clone(input), plug.clone());
        thread::spawn(move || receive(reading, &input, &plug));
    }
}

/// Passes bytes from a client to the machine until the client is gone. A newer client does not wait for that.
fn receive<W: Wiring>(mut client: TcpStream, input: &Input<W>, plug: &Plug) {
    let mut buffer = [0; 4_096];
    while let Ok(count @ 1..) = client.read(&mut buffer) {
        if plug.is_in() && !input.send(buffer[..count].to_vec()) {
            return;
        }
    }
    // The machine's end notices at its next write.
    let _ = client.shutdown(Shutdown::Both);
}

/// The machine's end of the line.
struct Port {
    name: &'static str,
    client: Client,
    plug: Plug,
    /// Dropped with the machine.
    _alive: Sender<()>,
}

impl<W> Outside<W> for Port {
    fn turn(&mut self, _: &W, bytes: &[u8], _: u64) {
        let pulled = !self.plug.is_in();
        if bytes.is_empty() && !pulled {
            return;
        }
        let mut client = held(&self.client);
        let written = client.as_mut().map_or(Ok(()), |client| {
            // A client that does not read loses its connection, so the machine is not delayed.
            client.write_all(bytes)
        });
        if pulled || written.is_err() {
            hang_up(&mut client);
        }
    }

    fn fell_behind(&mut self, slow: Slow) {
        eprintln!("{}: {slow}", self.name);
    }
}
