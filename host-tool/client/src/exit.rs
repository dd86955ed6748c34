//! Exit codes of the program; the table for users is in `docs/records.md`.

/// Success.
pub const DONE: u8 = 0;
/// A file could not be used, or this program failed.
pub const FAILED: u8 = 1;
/// The command line cannot be understood.
pub const USAGE: u8 = 2;
/// Refused by the check or by the device; nothing moved.
pub const REFUSED: u8 = 3;
/// No device, the wrong one or several, or the link was lost.
pub const NO_DEVICE: u8 = 4;
/// Firmware and host tool do not match.
pub const MISMATCH: u8 = 5;
/// The device latched a fault, or ended the action by itself.
pub const FAULT: u8 = 6;
/// Unknown whether the command was carried out: check the machine.
pub const UNKNOWN: u8 = 7;
/// A stop did not reach a machine.
pub const NOT_DELIVERED: u8 = 8;
/// The operator stopped the command.
pub const STOPPED: u8 = 130;
