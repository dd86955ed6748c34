//! Connects the host tool to the machines on the bench: `--rig virtual` and `--capsule virtual`.

use std::sync::atomic::{AtomicBool, Ordering};

use host_tool::connector::{Candidate, Connector, Ports};
use host_tool::link::address::Address;
use host_tool::link::{Link, OpenError};
use jiff::Timestamp;
use protocol::system::DeviceKind;

use crate::boards::{capsule, rig};
use crate::link::VirtualLink;
use crate::plants::capsule::CapsuleOptions;
use crate::plants::rig::RigOptions;

/// Powers a machine up when its link is opened; passes all other addresses to [`Ports`].
#[derive(Debug, Default)]
pub struct BenchPorts {
    /// The last link opened does not lead to the bench.
    elsewhere: AtomicBool,
}

impl Connector for BenchPorts {
    fn open(
        &self,
        kind: DeviceKind,
        address: &Address,
        baud: u32,
    ) -> Result<Box<dyn Link>, OpenError> {
        let elsewhere = *address != Address::Virtual;
        self.elsewhere.store(elsewhere, Ordering::Relaxed);
        if elsewhere {
            return Ports.open(kind, address, baud);
        }
        let opened: Result<Box<dyn Link>, _> = match kind {
            DeviceKind::Rig => rig::start(RigOptions::default())
                .map(|bench| Box::new(VirtualLink::new(&bench, "virtual rig")) as _),
            DeviceKind::Capsule => capsule::start(CapsuleOptions::default())
                .map(|bench| Box::new(VirtualLink::new(&bench, "virtual capsule")) as _),
        };
        opened.map_err(|why| OpenError {
            place: address.to_string(),
            why: why.to_string(),
            remedy: "build the images with `cargo xtask images`".to_owned(),
        })
    }

    fn candidates(&self) -> Vec<Candidate> {
        Ports.candidates()
    }

    /// Always the same for a machine on the bench, so that its behaviour does not depend on chance.
    fn nonce(&self) -> u32 {
        if self.elsewhere.load(Ordering::Relaxed) {
            Ports.nonce()
        } else {
            1
        }
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
        assert!(ports.open(DeviceKind::Rig, &nobody, 115_200).is_err());
        assert_ne!(ports.nonce(), ports.nonce());
    }
}
