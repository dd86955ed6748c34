//! Headers of the chip's pins on a NUCLEO-F411RE, and their labels on a CNC shield V3.

use crate::Pin;

/// The places of a pin on the headers of the board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// The pin.
    pub pin: Pin,
    /// Its name at the Arduino sockets, which the shield covers; empty if it is not on them.
    pub arduino: &'static str,
    /// Connector and number of the morpho pins beside them, UM1724 table 29 [as others quote it].
    pub morpho: &'static str,
}

/// Headers of the pins in use.
pub const HEADERS: [Header; 18] = [
    header('A', 0, "A0", "CN7-28"),
    header('A', 1, "A1", "CN7-30"),
    // Not connected as delivered: SB62 and SB63 are open, and both pins lead to the ST-LINK only (UM1724 section 6.8).
    header('A', 2, "D1", "CN10-35"),
    header('A', 3, "D0", "CN10-37"),
    header('A', 4, "A2", "CN7-32"),
    header('A', 5, "D13", "CN10-11"),
    header('A', 6, "D12", "CN10-13"),
    header('A', 8, "D7", "CN10-23"),
    header('A', 9, "D8", "CN10-21"),
    header('A', 10, "D2", "CN10-33"),
    header('B', 0, "A3", "CN7-34"),
    header('B', 1, "", "CN10-24"),
    header('B', 4, "D5", "CN10-27"),
    header('B', 5, "D4", "CN10-29"),
    header('B', 6, "D10", "CN10-17"),
    header('B', 10, "D6", "CN10-25"),
    header('C', 7, "D9", "CN10-19"),
    header('C', 13, "", "CN7-23"),
];

/// Label that a CNC shield V3.0 prints beside an Arduino pin.
pub const SHIELD: [(&str, &str); 16] = [
    ("D2", "X.STEP"),
    ("D3", "Y.STEP"),
    ("D4", "Z.STEP"),
    ("D5", "X.DIR"),
    ("D6", "Y.DIR"),
    ("D7", "Z.DIR"),
    ("D8", "EN"),
    ("D9", "X limit"),
    ("D10", "Y limit"),
    ("D11", "Z limit"),
    ("D12", "SpnEn"),
    ("D13", "SpnDir"),
    ("A0", "Abort"),
    ("A1", "Hold"),
    ("A2", "Resume"),
    ("A3", "CoolEn"),
];

/// Finds a pin on the headers; none for an unused pin.
#[must_use]
pub fn header_of(pin: Pin) -> Option<Header> {
    HEADERS.into_iter().find(|header| header.pin == pin)
}

/// The shield's label beside an Arduino pin; empty where it has none.
#[must_use]
pub fn shield_label(arduino: &str) -> &'static str {
    let found = SHIELD.into_iter().find(|(pin, _)| *pin == arduino);
    found.map_or("", |(_, label)| label)
}

const fn header(port: char, number: usize, arduino: &'static str, morpho: &'static str) -> Header {
    Header {
        pin: Pin::new(port, number),
        arduino,
        morpho,
    }
}
