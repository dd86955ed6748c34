//! Connects the host tool to the machines on the bench: `--rig virtual` and `--capsule virtual`.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use client::address::Address;
use client::link::{Link, OpenError, Reason};
use jiff::Timestamp;
use lab::commissioning::operator::Operator;
use lab::operations::connector::{Candidate, Connector, LinkPurpose, Ports};
use protocol::system::DeviceKind;

use crate::boards::{capsule, rig};
use crate::fixture::{Fixture, Machine, Plug};
use crate::link::VirtualLink;
use crate::plants::capsule::Parameters;
use crate::plants::rig::RigOptions;

/// Powers a machine up when its link is opened, unless a fixture holds one already; passes all other addresses to [`Ports`].
#[derive(Default)]
pub struct BenchPorts {
    /// The last link opened leads to something other than the bench.
    elsewhere: AtomicBool,
    /// A machine in a fixture: it stays powered, and every link leads to it.
    handled: Mutex<Option<(Machine, Plug)>>,
}

impl BenchPorts {
    fn handled(&self) -> std::sync::MutexGuard<'_, Option<(Machine, Plug)>> {
        self.handled.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A nonce for a session with a machine that keeps running; each session needs its own.
fn session_nonce(now_ns: u64) -> u32 {
    (now_ns / 1_000) as u32 + 2
}

impl Connector for BenchPorts {
    fn open(
        &self,
        kind: DeviceKind,
        address: &Address,
        baud: u32,
        purpose: LinkPurpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        let elsewhere = *address != Address::Virtual;
        self.elsewhere.store(elsewhere, Ordering::Relaxed);
        if elsewhere {
            return Ports.open(kind, address, baud, purpose);
        }
        if let Some((machine, plug)) = &*self.handled() {
            return Ok(match machine {
                Machine::Rig(bench) => {
                    Box::new(VirtualLink::new(bench, "virtual rig").with_plug(plug.clone()))
                }
                Machine::Capsule(bench) => {
                    Box::new(VirtualLink::new(bench, "virtual capsule").with_plug(plug.clone()))
                }
            });
        }
        let opened: Result<Box<dyn Link>, _> = match kind {
            DeviceKind::Rig => rig::start(RigOptions::WITH_BOTH_JUMPERS)
                .map(|bench| Box::new(VirtualLink::new(&bench, "virtual rig")) as _),
            DeviceKind::Capsule => capsule::start(Parameters::nominal())
                .map(|bench| Box::new(VirtualLink::new(&bench, "virtual capsule")) as _),
        };
        opened.map_err(|why| OpenError {
            place: address.to_string(),
            reason: Reason::Other,
            why: why.to_string(),
            remedy: "build the images with `cargo xtask images`".to_owned(),
        })
    }

    fn is_created_on_open(&self, address: &Address) -> bool {
        *address == Address::Virtual
    }

    fn candidates(&self) -> Vec<Candidate> {
        Ports.candidates()
    }

    /// The nonce is fixed for a machine on the bench, so that its behaviour is reproducible.
    fn nonce(&self) -> u32 {
        if self.elsewhere.load(Ordering::Relaxed) {
            return Ports.nonce();
        }
        match &*self.handled() {
            None => 1,
            Some((Machine::Rig(bench), _)) => session_nonce(bench.now_ns()),
            Some((Machine::Capsule(bench), _)) => session_nonce(bench.now_ns()),
        }
    }

    /// Powers a machine up and keeps it.
    fn fixture(&self, kind: DeviceKind, address: Option<&Address>) -> Option<Box<dyn Operator>> {
        if address != Some(&Address::Virtual) {
            return None;
        }
        // Without an image there is no fixture; opening the link reports the reason.
        let machine = match kind {
            DeviceKind::Rig => Machine::Rig(rig::start(RigOptions::WITH_BOTH_JUMPERS).ok()?),
            DeviceKind::Capsule => Machine::Capsule(capsule::start(Parameters::nominal()).ok()?),
        };
        let plug = Plug::default();
        *self.handled() = Some((machine.clone(), plug.clone()));
        Some(Box::new(Fixture::new(machine, plug)))
    }

    fn now(&self) -> Timestamp {
        Timestamp::now()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A machine that keeps running between two commands would take an equal nonce for a repetition of the first.
    #[test]
    fn only_a_fresh_machine_gets_the_fixed_nonce() {
        let ports = BenchPorts::default();
        assert_eq!((ports.nonce(), ports.nonce()), (1, 1));
        let nobody = "tcp:127.0.0.1:1".parse().expect("an address");
        assert!(
            ports
                .open(DeviceKind::Rig, &nobody, 115_200, LinkPurpose::Own("run"))
                .is_err()
        );
        assert_ne!(ports.nonce(), ports.nonce());
    }
}
