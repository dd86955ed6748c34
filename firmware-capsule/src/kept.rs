//! Data that a capsule keeps in flash beside settings and name: its calibration, and totals with the end of the last
//! motion. In the log they use the numbers of the rig's first two settings.
//!
//! A record takes 24 bytes with its head. One is written after each motion, once the motor stands, and one before a
//! motion that leaves the folded end. Three sectors of 16 KiB with 10,000 erasures each (data sheet) last for 20
//! million records.

use crate::calibration::Calibration;
use crate::mechanics::{FOUND_BY_RISE, Thread};
use device::settings::{Record, Records};
use protocol::{settings::SettingKey, system::DeviceKind};

/// Number of the calibration's record in the log.
pub const CALIBRATION: u8 = 0;
/// Number of the totals' record in the log.
pub const TOTALS: u8 = 1;
/// These numbers must not belong to settings of a capsule.
const _: () = assert!(
    !SettingKey::ALL[CALIBRATION as usize].is_of(DeviceKind::Capsule)
        && !SettingKey::ALL[TOTALS as usize].is_of(DeviceKind::Capsule)
);

/// Totals over the life of the capsule.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Totals {
    /// Number of motions.
    pub actuations: u32,
    /// Energy drawn by the motor, mJ.
    pub energy_mj: u64,
    /// The last motion ended folded, perhaps at an end that had wandered, and none has begun since: how much shorter
    /// than calibrated the thread is believed there.
    pub folded: Option<Thread>,
}

/// Length of the record: version and fields, little-endian.
const TOTALS_RECORD: usize = 14;
const VERSION: u8 = 1;
/// Unit of the margin at the folded end, um; 0 stands for "not folded".
const MARGIN_UM: i32 = 10;
/// A byte holds every margin that a motion leaves.
const _: () = assert!(FOUND_BY_RISE.0 <= MARGIN_UM * u8::MAX as i32);

impl Totals {
    fn record(&self) -> [u8; TOTALS_RECORD] {
        let mut record = [VERSION; TOTALS_RECORD];
        record[1..5].copy_from_slice(&self.actuations.to_le_bytes());
        record[5..13].copy_from_slice(&self.energy_mj.to_le_bytes());
        record[13] = self.folded.map_or(0, |Thread(margin_um)| {
            // Rounded up, to one unit at least: an unfolding ends by the margin before zero.
            ((margin_um + MARGIN_UM - 1) / MARGIN_UM).clamp(1, 255) as u8
        });
        record
    }

    fn from_record(record: &[u8]) -> Option<Self> {
        let &[VERSION, a, b, c, d, e, f, g, h, i, j, k, l, folded] = record else {
            return None;
        };
        Some(Self {
            actuations: u32::from_le_bytes([a, b, c, d]),
            energy_mj: u64::from_le_bytes([e, f, g, h, i, j, k, l]),
            folded: (folded > 0).then_some(Thread(i32::from(folded) * MARGIN_UM)),
        })
    }
}

/// Calibration and totals.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Kept {
    /// `None` before the first one.
    pub calibration: Option<Calibration>,
    /// All 0 in a new capsule.
    pub totals: Totals,
}

impl Records for Kept {
    const KIND: DeviceKind = DeviceKind::Capsule;
    const NUMBERS: &'static [u8] = &[CALIBRATION, TOTALS];

    fn load(&mut self, number: u8, record: &[u8]) {
        match number {
            CALIBRATION => self.calibration = Calibration::from_record(record),
            TOTALS => self.totals = Totals::from_record(record).unwrap_or(self.totals),
            _ => {}
        }
    }

    fn record(&self, number: u8) -> Option<Record> {
        match number {
            CALIBRATION => Some(self.calibration?.record().into_iter().collect()),
            TOTALS => Some(self.totals.record().into_iter().collect()),
            _ => None,
        }
    }
}
