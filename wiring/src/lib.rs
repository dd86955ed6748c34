//! Assigns the signals to the chip's pins, and lists the pins' connectors on NUCLEO-F411RE and CNC shield.
//!
//! The images take their pins from here, and a test compares the diagrams of the manual.
#![no_std]
#![forbid(unsafe_code)]

pub mod board;
pub mod capsule;
pub mod rig;

/// A pin of the chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pin {
    /// `'A'` to `'C'`.
    pub port: char,
    /// 0 to 15.
    pub number: usize,
}

impl Pin {
    /// Pin `number` of `port`.
    #[must_use]
    pub const fn new(port: char, number: usize) -> Self {
        assert!(
            matches!(port, 'A'..='C') && number < 16,
            "ports A to C have 16 pins"
        );
        Self { port, number }
    }

    /// Whether this is pin `number` of `port`; for checks at compile time.
    #[must_use]
    pub const fn is(self, port: char, number: usize) -> bool {
        self.port == port && self.number == number
    }
}

impl core::fmt::Display for Pin {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "P{}{}", self.port, self.number)
    }
}

/// A signal of a machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Signal {
    /// Name, as in the manual.
    pub name: &'static str,
    /// Pin of the chip.
    pub pin: Pin,
}

const fn signal(name: &'static str, pin: Pin) -> Signal {
    Signal { name, pin }
}
