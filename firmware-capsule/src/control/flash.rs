//! Records that a capsule keeps in flash beside settings and name: what is [known](crate::known) of its thread, and
//! totals. In the log they have the numbers of the rig's first two settings.
//!
//! A record takes 32 bytes with its head. One of what is known is written before a phase of a motion, one each
//! millimetre within it, and one of each kind once it has ended: 50 in a fold and an unfolding. Three sectors of 16
//! KiB with 10,000 erasures each (data sheet) last for 300,000 folds.

use crate::known::Known;
use device::settings::{Record, Records};
use protocol::{settings::SettingKey, system::DeviceKind};
use serde::{Deserialize, Serialize, de::DeserializeOwned};

/// Number in the log of the record of what is known.
pub const KNOWN: u8 = 0;
/// Number in the log of the totals' record.
pub const TOTALS: u8 = 1;
/// These numbers must not belong to settings of a capsule.
const _: () = assert!(
    !SettingKey::ALL[KNOWN as usize].is_of(DeviceKind::Capsule)
        && !SettingKey::ALL[TOTALS as usize].is_of(DeviceKind::Capsule)
);

/// Totals over the life of the capsule.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Totals {
    /// Number of motions.
    pub actuations: u32,
    /// Energy drawn by the motor, mJ.
    pub energy_mj: u64,
}

/// Layout of the records: this number, then the type's fields as `postcard` writes them.
const VERSION: u8 = 4;

/// The calibration, if there is one, is a fold that some settings allow.
fn is_possible(known: &Known) -> bool {
    let (shortest, longest) = (SettingKey::ShortestFoldUm, SettingKey::LongestFoldUm);
    let possible_um = shortest.range().min as i32..=longest.range().max as i32;
    (known.calibration).is_none_or(|found| possible_um.contains(&found.folded.0))
}

fn write(of: impl Serialize) -> Option<Record> {
    let mut record = Record::new();
    let longest = record.capacity();
    record.resize_default(longest).ok()?;
    let length = postcard::to_slice(&(VERSION, of), &mut record).ok()?.len();
    record.truncate(length);
    Some(record)
}

fn read<T: DeserializeOwned>(record: &[u8]) -> Option<T> {
    let (version, of): (u8, T) = postcard::from_bytes(record).ok()?;
    (version == VERSION).then_some(of)
}

/// Records in flash.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Kept {
    /// Nothing in a new capsule.
    pub known: Known,
    /// All 0 in a new capsule.
    pub totals: Totals,
}

impl Records for Kept {
    const KIND: DeviceKind = DeviceKind::Capsule;
    const NUMBERS: &'static [u8] = &[KNOWN, TOTALS];

    fn load(&mut self, number: u8, record: &[u8]) {
        match number {
            // A record that cannot be read must not leave an older one in force: the thread has moved since.
            KNOWN => self.known = read(record).filter(is_possible).unwrap_or_default(),
            TOTALS => self.totals = read(record).unwrap_or(self.totals),
            _ => {}
        }
    }

    fn record(&self, number: u8) -> Option<Record> {
        match number {
            KNOWN => write(self.known),
            TOTALS => write(self.totals),
            _ => None,
        }
    }
}
