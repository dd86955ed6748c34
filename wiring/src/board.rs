//! Connector places of the chip's pins on a NUCLEO-F411RE, and their labels on a CNC shield V3.

use crate::Pin;

/// A pin's places on the board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Place {
    /// The pin.
    pub pin: Pin,
    /// Its name at the Arduino sockets, which the shield covers; empty if it is not on them.
    pub arduino: &'static str,
    /// Connector and number of the morpho pins beside them, UM1724 table 29 [as others quote it].
    pub morpho: &'static str,
}

/// Places of the pins in use.
pub const PLACES: [Place; 18] = [
    place('A', 0, "A0", "CN7-28"),
    place('A', 1, "A1", "CN7-30"),
    // Not connected as delivered: SB62 and SB63 are open, and both pins lead to the ST-LINK alone (UM1724 section 6.8).
    place('A', 2, "D1", "CN10-35"),
    place('A', 3, "D0", "CN10-37"),
    place('A', 4, "A2", "CN7-32"),
    place('A', 5, "D13", "CN10-11"),
    place('A', 6, "D12", "CN10-13"),
    place('A', 8, "D7", "CN10-23"),
    place('A', 9, "D8", "CN10-21"),
    place('A', 10, "D2", "CN10-33"),
    place('B', 0, "A3", "CN7-34"),
    place('B', 1, "", "CN10-24"),
    place('B', 4, "D5", "CN10-27"),
    place('B', 5, "D4", "CN10-29"),
    place('B', 6, "D10", "CN10-17"),
    place('B', 10, "D6", "CN10-25"),
    place('C', 7, "D9", "CN10-19"),
    place('C', 13, "", "CN7-23"),
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

/// Finds where a pin is brought out; none for an unused pin.
#[must_use]
pub fn place_of(pin: Pin) -> Option<Place> {
    PLACES.into_iter().find(|place| place.pin == pin)
}

/// The shield's label beside an Arduino pin; empty where it has none.
#[must_use]
pub fn shield_label(arduino: &str) -> &'static str {
    let found = SHIELD.into_iter().find(|(pin, _)| *pin == arduino);
    found.map_or("", |(_, label)| label)
}

const fn place(port: char, number: usize, arduino: &'static str, morpho: &'static str) -> Place {
    Place {
        pin: Pin::new(port, number),
        arduino,
        morpho,
    }
}
