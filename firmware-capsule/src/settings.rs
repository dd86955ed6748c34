//! The limits that control uses, derived from the settings in flash.

use crate::units::Thread;
use device::settings::Values;
use protocol::capsule::ActuationKind;
use protocol::settings::{SettingKey as Key, SettingRule};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Current above the no-load current at which a calibration finds the folded end, mA: 5.6 N with the assumed
    /// friction of the worm, 4.6 to 7.3 N over the range of friction.
    pub end_force_ma: u16,
    /// Speed of winding over the long part of a fold, counts/s.
    pub fold_cps: i32,
    /// Speed of paying out, counts/s; the battery may give less.
    pub unfold_cps: i32,
    /// Minimum battery voltage for starting a motion, mV.
    pub least_battery_mv: u16,
    /// Battery voltage under load below which the cell is empty, mV.
    pub loaded_battery_mv: u16,
    /// Minimum battery voltage for starting an unfolding, mV: a nearly empty cell loses 100 mV over a motion.
    pub least_unfolding_mv: u16,
    /// Resistance of the motor's circuit, mohm: winding 5.4 ohm, both switches of the bridge 0.6, cell 0.5.
    pub loop_milliohm: i32,
    /// Back-EMF, uV per count per second: 0.221 mV/rpm over 64 counts.
    pub back_emf_uv_per_cps: i32,
    /// Shortest and longest way from the unfolded end to the folded one that a calibration accepts. Shortest: 16.7 mm
    /// of travel with four times the stiffness and much friction. Longest: 23.4 mm of travel. Plus the slack.
    pub folded_range: (Thread, Thread),
    /// Time limit of a fold, ms: the model motor takes 3.8 s.
    pub fold_timeout_ms: u32,
    /// Time limit of an unfolding, ms: the model motor takes 2.8 s, and 1.2 s more if the thread is felt first.
    pub unfold_timeout_ms: u32,
    /// Silence of the host that ends a motion, us.
    pub link_timeout_us: u32,
}

impl Default for Settings {
    fn default() -> Self {
        Self::REFERENCE
    }
}

impl Settings {
    /// The settings of a new capsule.
    pub const REFERENCE: Self = match Self::new(&Values::DEFAULT) {
        Ok(settings) => settings,
        Err(_) => panic!("the defaults keep the rules"),
    };

    /// Derives the limits. Each of the `values` is within its range.
    ///
    /// # Errors
    /// The rule that the values break together.
    pub const fn new(values: &Values) -> Result<Self, SettingRule> {
        // The ranges of the settings fit the smaller types.
        let get = Values::get;
        let (shortest, longest) = (
            Thread(get(values, Key::ShortestFoldUm) as i32),
            Thread(get(values, Key::LongestFoldUm) as i32),
        );
        if shortest.0 + 1_000 > longest.0 {
            return Err(SettingRule::FoldHasARange);
        }
        let (least_mv, loaded_mv) = (
            get(values, Key::LeastBatteryMv) as u16,
            get(values, Key::LoadedBatteryMv) as u16,
        );
        if loaded_mv + 200 > least_mv {
            return Err(SettingRule::LoadedBelowRest);
        }
        if matches!(get(values, Key::TelemetryMs), 1..=4) {
            return Err(SettingRule::TelemetryInterval);
        }
        Ok(Self {
            end_force_ma: get(values, Key::EndForceMa) as u16,
            fold_cps: Thread(get(values, Key::FoldUmS) as i32).counts().0,
            unfold_cps: Thread(get(values, Key::UnfoldUmS) as i32).counts().0,
            least_battery_mv: least_mv,
            loaded_battery_mv: loaded_mv,
            least_unfolding_mv: loaded_mv + 100,
            loop_milliohm: get(values, Key::MotorMohm) as i32,
            back_emf_uv_per_cps: get(values, Key::BackEmfUvCps) as i32,
            folded_range: (shortest, longest),
            fold_timeout_ms: get(values, Key::FoldTimeoutMs),
            unfold_timeout_ms: get(values, Key::UnfoldTimeoutMs),
            // At most a minute.
            link_timeout_us: get(values, Key::LinkTimeoutMs) * 1_000,
        })
    }

    /// Longest time that an actuation of this kind may take.
    pub fn timeout_ms(&self, kind: ActuationKind) -> u32 {
        match kind {
            // A reference feels up to 20 times.
            ActuationKind::Reference | ActuationKind::Calibrate => 5 * self.fold_timeout_ms,
            ActuationKind::Unfold => self.unfold_timeout_ms,
            _ => self.fold_timeout_ms,
        }
    }
}
