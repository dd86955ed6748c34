//! The command line over machines in memory, in this process.

use std::sync::{Arc, Mutex};

use client::Device;
use client::address::Address;
use client::link::{Link, OpenError};
use host_tool::cli::run_on;
use host_tool::cli::screen::Keyboard;
use jiff::Timestamp;
use lab::operations::connector::{Candidate, Connector, LinkPurpose};
use protocol::system::DeviceKind;

use simulated_machines::machine::{Log, Script, link};

/// Machines in memory instead of ports.
pub struct Memory {
    scripts: Vec<Script>,
    pub logs: Mutex<Vec<Arc<Mutex<Log>>>>,
}

impl Memory {
    pub fn with(scripts: Vec<Script>) -> Self {
        Self {
            scripts,
            logs: Mutex::new(vec![]),
        }
    }

    /// Runs a command line without a keyboard. Returns exit code, output and errors.
    pub fn run(&self, args: &[&str]) -> (u8, String, String) {
        run_with(self, args, None)
    }

    /// Runs a command line with this typed at its keyboard.
    pub fn run_typed(&self, args: &[&str], typed: &'static str) -> (u8, String, String) {
        run_with(self, args, Some(Box::new(typed.as_bytes())))
    }

    pub fn heard(&self) -> Vec<&'static str> {
        let logs = self.logs.lock().expect("logs");
        logs.iter()
            .flat_map(|log| log.lock().expect("log").heard.clone())
            .collect()
    }
}

/// Runs a command line over these machines, without a keyboard. Returns exit code, output and errors.
pub fn run(machines: &dyn Connector, args: &[&str]) -> (u8, String, String) {
    run_with(machines, args, None)
}

fn run_with(
    machines: &dyn Connector,
    args: &[&str],
    keyboard: Option<Keyboard>,
) -> (u8, String, String) {
    let args = std::iter::once("retrograde").chain(args.iter().copied());
    let args = args.map(Into::into);
    let (mut out, mut err) = (vec![], vec![]);
    let code = run_on(args, machines, &mut out, &mut err, keyboard);
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("UTF-8");
    (code, text(out), text(err))
}

impl Connector for Memory {
    fn open(
        &self,
        _: DeviceKind,
        address: &Address,
        _: u32,
        _: LinkPurpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        let Address::Serial(index) = address else {
            panic!("only the test's own places");
        };
        let script = &self.scripts[index.parse::<usize>().expect("a number")];
        let (link, log) = link(script.clone());
        self.logs.lock().expect("logs").push(log);
        Ok(link)
    }

    fn candidates(&self) -> Vec<Candidate> {
        (0..self.scripts.len())
            .map(|index| Candidate {
                address: Address::Serial(index.to_string()),
                kind: None,
                description: "memory".to_owned(),
                may_ask: true,
            })
            .collect()
    }

    fn nonce(&self) -> u32 {
        1
    }

    fn now(&self) -> Timestamp {
        Timestamp::UNIX_EPOCH
    }
}

/// A machine that is already homed or referenced.
pub fn ready(kind: DeviceKind) -> Script {
    Script {
        ready: true,
        ..Script::new(kind)
    }
}

/// The client of such a machine.
pub fn device(kind: DeviceKind) -> Device {
    Device::connect(link(ready(kind)).0, kind, 5).expect("there")
}
