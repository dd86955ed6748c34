//! A bench that opens its lines by a function, and a line on which something happens after certain requests.

use std::sync::{Arc, Mutex};

use client::address::Address;
use client::link::{Link, LinkError, OpenError};
use jiff::Timestamp;
use lab::operations::connector::{Connector, LinkPurpose};
use protocol::system::{DeviceKind, Urgent};
use simulated_machines::machine::{Log, Script, link};

/// Opens a line to a machine of each kind by its function. The time stands still.
pub struct Opened<F>(pub F);

impl<F: Fn(DeviceKind) -> Box<dyn Link> + Sync> Connector for Opened<F> {
    fn open(
        &self,
        kind: DeviceKind,
        _: &Address,
        _: u32,
        _: LinkPurpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        Ok((self.0)(kind))
    }

    fn nonce(&self) -> u32 {
        1
    }

    fn now(&self) -> Timestamp {
        Timestamp::UNIX_EPOCH
    }
}

#[derive(Clone, Copy)]
pub enum Mishap {
    Unplugged,
    Stopped,
}

/// The line of a machine to which something happens, once, when it has heard these requests in this order.
pub struct FaultyLine {
    link: Box<dyn Link>,
    log: Arc<Mutex<Log>>,
    after: Vec<&'static str>,
    mishap: Option<Mishap>,
}

impl FaultyLine {
    pub fn new(
        script: Script,
        mishap: Mishap,
        after: Vec<&'static str>,
    ) -> (Box<Self>, Arc<Mutex<Log>>) {
        let (link, log) = link(script);
        let line = Self {
            link,
            log: Arc::clone(&log),
            after,
            mishap: Some(mishap),
        };
        (Box::new(line), log)
    }

    fn is_over(&self) -> bool {
        let log = self.log.lock().expect("free");
        let mut heard = log.heard.iter();
        let hears = |after: &&str| heard.any(|heard| heard == after);
        self.after.iter().all(hears)
    }

    fn in_order(&self) -> Result<(), LinkError> {
        match self.mishap {
            Some(Mishap::Unplugged) if self.is_over() => Err(LinkError::Lost {
                place: self.link.place(),
                why: "it was unplugged".to_owned(),
            }),
            _ => Ok(()),
        }
    }
}

impl Link for FaultyLine {
    fn place(&self) -> String {
        self.link.place()
    }
    fn now_us(&self) -> u64 {
        self.link.now_us()
    }
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.in_order()?;
        self.link.send(bytes)
    }
    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        self.in_order()?;
        self.link.receive(buffer, deadline_us)
    }
    fn stopped(&mut self) -> Option<Urgent> {
        let stopped = matches!(self.mishap, Some(Mishap::Stopped)) && self.is_over();
        stopped.then_some(Urgent::Stop)
    }
    fn forget_stop(&mut self) {
        self.mishap = None;
    }
}
