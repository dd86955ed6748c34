//! The calibration of one capsule: measured once, when a person says "this is unfolded", and kept in flash.

use crate::mechanics::{POSSIBLE_FOLD, Thread};

/// Results of a calibration: lengths, and currents to compare later ones with. It needs no temperature.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Calibration {
    /// Thread from the unfolded end to the end force.
    pub folded: Thread,
    /// Current of the motor with a slack thread.
    pub no_load_ma: u16,
    /// Thread from half of the end force to the end force.
    pub rise: Thread,
    /// Thread from a quarter of the end force to the end force.
    pub long_rise: Thread,
    /// Current while winding at the folded end, less the current while paying out the last 0.3 mm of the slow part of
    /// an unfolding. Friction cancels, so this is twice the pull.
    pub tension_ma: u16,
    /// Back-EMF of the motor at the calibration, uV per count per second; 0 in records of an earlier layout.
    pub back_emf_uv_cps: u16,
}

/// Length of the record: version and fields, little-endian.
pub const RECORD: usize = 15;
const VERSION: u8 = 3;
/// Version and length of the previous layout, which has no back-EMF.
const SHORTER: (u8, usize) = (2, 13);

impl Calibration {
    /// Encodes the record for the flash.
    pub fn record(&self) -> [u8; RECORD] {
        let mut record = [VERSION; RECORD];
        record[1..5].copy_from_slice(&self.folded.0.to_le_bytes());
        record[5..7].copy_from_slice(&self.no_load_ma.to_le_bytes());
        // At most 28,500 um, so 16 bits hold it.
        record[7..9].copy_from_slice(&(self.rise.0 as u16).to_le_bytes());
        record[9..11].copy_from_slice(&self.tension_ma.to_le_bytes());
        record[11..13].copy_from_slice(&(self.long_rise.0 as u16).to_le_bytes());
        record[13..15].copy_from_slice(&self.back_emf_uv_cps.to_le_bytes());
        record
    }

    /// Decodes a record from flash; `None` if its layout is unknown or its values fit no capsule.
    pub fn from_record(record: &[u8]) -> Option<Self> {
        let (fields, back_emf_uv_cps) = match *record {
            [VERSION, ref fields @ .., m, n] => (fields, u16::from_le_bytes([m, n])),
            [version, ref fields @ ..] if (version, record.len()) == SHORTER => (fields, 0),
            _ => return None,
        };
        let &[a, b, c, d, e, f, g, h, i, j, k, l] = fields else {
            return None;
        };
        let folded = Thread(i32::from_le_bytes([a, b, c, d]));
        let (shortest, longest) = POSSIBLE_FOLD;
        (shortest..=longest).contains(&folded).then(|| Self {
            folded,
            no_load_ma: u16::from_le_bytes([e, f]),
            rise: Thread(i32::from(u16::from_le_bytes([g, h]))),
            tension_ma: u16::from_le_bytes([i, j]),
            long_rise: Thread(i32::from(u16::from_le_bytes([k, l]))),
            back_emf_uv_cps,
        })
    }
}
