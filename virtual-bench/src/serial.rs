//! The serial line between the machine and the host, in virtual time.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rigless::chip::Timeline;
use rigless::chip::uart::Peer;
use rigless::snapshot::Store;
use rigless::time::VirtualNanos;

/// A fault of one byte on the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ByteFault {
    /// It never arrives.
    Lost,
    /// It arrives with these bits flipped.
    Flipped(u8),
    /// It arrives twice.
    Doubled,
}

/// Both directions of the line.
#[derive(Debug, Default)]
pub struct Serial {
    /// Bytes from the host that the machine has not taken yet.
    to_machine: VecDeque<u8>,
    /// Bytes from the machine that the host has not taken yet, with the end of their stop bit, ns.
    from_machine: Vec<(u64, u8)>,
    /// Whether the machine's pins carry its serial output and input.
    pub(crate) sends: bool,
    pub(crate) hears: bool,
    /// TX and RX are shorted: the machine receives the bytes it sends.
    pub echo: bool,
    sent: u64,
    taken: u64,
    /// When the machine began to receive the host's last byte, ns.
    last_taken_ns: u64,
    /// Faults by the byte's number in its direction, from 0.
    faults_to_machine: Vec<(u64, ByteFault)>,
    faults_from_machine: Vec<(u64, ByteFault)>,
}

impl Serial {
    /// Puts bytes from the host on the line.
    pub(crate) fn put(&mut self, bytes: &[u8]) {
        self.to_machine.extend(bytes);
    }

    /// Takes the bytes that the machine has sent, in order.
    pub(crate) fn take(&mut self) -> Vec<(u64, u8)> {
        std::mem::take(&mut self.from_machine)
    }

    /// Whether the bytes sent by the machine and not yet taken include the end of a frame.
    pub(crate) fn has_sent_frame(&self) -> bool {
        self.from_machine.iter().any(|(_, byte)| *byte == 0)
    }

    /// Corrupts the host's byte `number`, counted from 0 since the start of the bench.
    pub fn corrupt_to_machine(&mut self, number: u64, fault: ByteFault) {
        self.faults_to_machine.push((number, fault));
    }

    /// Corrupts the machine's byte `number`, counted from 0 since the start of the bench.
    pub fn corrupt_from_machine(&mut self, number: u64, fault: ByteFault) {
        self.faults_from_machine.push((number, fault));
    }

    /// Forgets all faults of bytes that are still to come.
    pub fn forget_faults(&mut self) {
        self.faults_to_machine.clear();
        self.faults_from_machine.clear();
    }

    /// Numbers of bytes that the machine has taken and sent so far.
    #[must_use]
    pub fn counts(&self) -> (u64, u64) {
        (self.taken, self.sent)
    }

    /// When the start bit of the host's last byte reached the machine, ns.
    #[must_use]
    pub fn last_taken_ns(&self) -> u64 {
        self.last_taken_ns
    }

    fn give(&mut self, now_ns: u64) -> Option<u8> {
        while let Some(byte) = self.to_machine.pop_front() {
            let number = self.taken;
            self.taken += 1;
            self.last_taken_ns = now_ns;
            if !self.hears {
                continue;
            }
            match fault(&self.faults_to_machine, number) {
                None => return Some(byte),
                Some(ByteFault::Flipped(bits)) => return Some(byte ^ bits),
                Some(ByteFault::Doubled) => {
                    self.to_machine.push_front(byte);
                    return Some(byte);
                }
                Some(ByteFault::Lost) => {}
            }
        }
        None
    }

    fn receive(&mut self, byte: u8, at_ns: u64) {
        let number = self.sent;
        self.sent += 1;
        if !self.sends {
            return;
        }
        if self.echo {
            self.to_machine.push_back(byte);
        }
        match fault(&self.faults_from_machine, number) {
            None => self.from_machine.push((at_ns, byte)),
            Some(ByteFault::Flipped(bits)) => self.from_machine.push((at_ns, byte ^ bits)),
            Some(ByteFault::Doubled) => self.from_machine.extend([(at_ns, byte); 2]),
            Some(ByteFault::Lost) => {}
        }
    }
}

fn fault(faults: &[(u64, ByteFault)], number: u64) -> Option<ByteFault> {
    let found = faults.iter().find(|(corrupted, _)| *corrupted == number);
    found.map(|(_, fault)| *fault)
}

/// The machine's end of the line.
#[derive(Debug)]
pub(crate) struct Wire {
    serial: Arc<Mutex<Serial>>,
    epoch_ns: u64,
}

impl Wire {
    pub(crate) fn new(serial: Arc<Mutex<Serial>>, epoch_ns: u64) -> Self {
        Self { serial, epoch_ns }
    }

    fn line(&self) -> MutexGuard<'_, Serial> {
        self.serial.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Store for Wire {}

impl Peer for Wire {
    fn receive(&mut self, word: u16, context: &mut Timeline<'_, '_>) {
        let at_ns = self.epoch_ns + context.now().0;
        self.line().receive((word & 0xFF) as u8, at_ns);
    }

    fn transmit(&mut self, now: VirtualNanos) -> Option<u16> {
        self.line().give(self.epoch_ns + now.0).map(u16::from)
    }
}
