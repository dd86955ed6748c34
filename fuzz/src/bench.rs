//! The connector of a target: opens the lines that the target provides.

use client::address::Address;
use client::link::{Link, OpenError, Reason};
use jiff::Timestamp;
use lab::operations::connector::{Connector, LinkPurpose};
use protocol::system::DeviceKind;

/// A line, or why there is none.
pub(crate) type Opened = Result<Box<dyn Link>, OpenError>;

/// Opens lines by its function. Its clock never advances.
pub(crate) struct Bench<F: Fn(DeviceKind) -> Opened>(pub(crate) F);

impl<F: Fn(DeviceKind) -> Opened + Sync> Connector for Bench<F> {
    fn open(&self, kind: DeviceKind, _: &Address, _: u32, _: LinkPurpose) -> Opened {
        (self.0)(kind)
    }

    fn nonce(&self) -> u32 {
        1
    }

    fn now(&self) -> Timestamp {
        Timestamp::UNIX_EPOCH
    }
}

/// The error where no machine is.
pub(crate) fn absent() -> OpenError {
    OpenError {
        place: "bench".to_owned(),
        reason: Reason::Absent,
        why: "there is none".to_owned(),
        remedy: "plug it in".to_owned(),
    }
}
