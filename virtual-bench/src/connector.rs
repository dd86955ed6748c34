//! The host tool's way to the machines on the bench: `--rig virtual` and `--capsule virtual`.

use host_tool::connector::{Candidate, Connector, Ports};
use host_tool::link::address::Address;
use host_tool::link::{Link, OpenError};
use jiff::Timestamp;
use protocol::system::DeviceKind;

use crate::boards::{capsule, rig};
use crate::link::VirtualLink;
use crate::plants::capsule::CapsuleOptions;
use crate::plants::rig::RigOptions;

/// Powers a machine up when its link is opened; all other addresses are the real world's.
#[derive(Clone, Copy, Debug, Default)]
pub struct BenchPorts;

impl Connector for BenchPorts {
    fn open(
        &self,
        kind: DeviceKind,
        address: &Address,
        baud: u32,
    ) -> Result<Box<dyn Link>, OpenError> {
        if *address != Address::Virtual {
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

    /// Always the same: what happens on the bench does not depend on chance.
    fn nonce(&self) -> u32 {
        1
    }

    fn now(&self) -> Timestamp {
        Timestamp::now()
    }
}
