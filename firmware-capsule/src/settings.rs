//! The limits of the capsule as its control uses them, worked out of the settings in flash.

use crate::mechanics::Thread;
use device::settings::Values;
use protocol::settings::{SettingKey as Key, SettingRule};

/// Of all the values that a person can change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Current above the no-load current at the end force: 5.6 N with the assumed friction of the worm, 4.6 to 7.2 N over the
    /// friction's range. Of the nominal fold's energy the last 1.6 mm before it take 37 %.
    pub force_ma: u16,
    /// The same at half of the end force: start of the rise that tells an origami from an obstacle.
    pub rise_start_ma: u16,
    /// Near the end force; and where it is no longer, so that the speed does not go to and fro.
    pub near_ma: (u16, u16),
    /// With this current above the no-load current, a slow motor that meets something hard is at the end force.
    pub met_ma: u16,
    /// Above the no-load current, from here on a fold is slow: the stiffest origami with the most friction takes 115 mA where it
    /// becomes slow by itself.
    pub resisted_ma: u16,
    /// Winding over the long way, counts/s.
    pub fold_cps: i32,
    /// Winding where force ends it, counts/s.
    pub slow_cps: i32,
    /// Winding near the end force, counts/s. A soft origami meets its hard end just there.
    pub near_cps: i32,
    /// Paying out, counts/s, or what the battery gives.
    pub pay_out_cps: i32,
    /// Below this battery voltage a motion is refused.
    pub least_battery_mv: u16,
    /// A battery that sags below this under load is empty.
    pub loaded_battery_mv: u16,
    /// Winding 5.4 ohm, both switches of the bridge 0.6, cell 0.5.
    pub loop_milliohm: u32,
    /// Back-EMF, uV per count per second: 0.221 mV/rpm over 64 counts.
    pub back_emf_uv_per_cps: u32,
    /// No-load current until it is measured: the data sheet's.
    pub no_load_ma: u16,
    /// Proportional part of the speed loop, uA per count/s: with the motor's 4.2 counts/s2 per uA, 15 is a bandwidth of 60 rad/s.
    /// The speed is 4 ms old.
    pub proportional_ua: i32,
    /// Shortest and longest way from the unfolded end to the end force that a calibration accepts: 16.7 mm of travel with four
    /// times the stiffness and much friction, 23.4 mm of longest travel, and the slack.
    pub folded_range: (Thread, Thread),
    /// So much before the calibrated end is an end force still that of the folded origami.
    pub end_tolerance: Thread,
    /// So far beyond the calibrated end is the thread wound if no end force comes.
    pub end_overrun: Thread,
    /// So far may the folded end wander.
    pub drift: Thread,
    /// Longest time of a fold: the model motor takes 1.8 s, and 4.4 s if something resisted on the way.
    pub fold_timeout_ms: u32,
    /// Longest time of an unfolding: the model motor takes 1.3 s, with an almost empty battery twice as long.
    pub unfold_timeout_ms: u32,
    /// Silence of the host that ends a motion.
    pub link_timeout_us: u32,
}

/// Above the no-load current; the speed loop gives 200 mA.
const MOST_FORCE_MA: u16 = 185;

/// Shares of the end force, as they were at 135 mA.
const fn share(force_ma: u32, of_135: u32) -> u16 {
    (force_ma * of_135 / 135) as u16
}

impl Settings {
    /// Those of a new capsule.
    pub const REFERENCE: Self = match Self::new(&Values::DEFAULT) {
        Ok(settings) => settings,
        Err(_) => panic!("the defaults keep the rules"),
    };

    /// Works out the limits; `Values` are within their ranges.
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
        let force_ma = get(values, Key::EndForceMa);
        let slow_cps = counts_of(get(values, Key::SlowUmS));
        Ok(Self {
            force_ma: force_ma as u16,
            rise_start_ma: share(force_ma, 67),
            near_ma: (share(force_ma, 105), share(force_ma, 75)),
            met_ma: share(force_ma, 100),
            resisted_ma: share(force_ma, 133),
            fold_cps: counts_of(get(values, Key::FoldUmS)),
            slow_cps,
            near_cps: slow_cps * 40 / 57,
            pay_out_cps: counts_of(get(values, Key::UnfoldUmS)),
            least_battery_mv: least_mv,
            loaded_battery_mv: loaded_mv,
            loop_milliohm: get(values, Key::MotorMohm),
            back_emf_uv_per_cps: get(values, Key::BackEmfUvCps),
            no_load_ma: get(values, Key::NoLoadMa) as u16,
            proportional_ua: get(values, Key::SpeedGainUaCps) as i32,
            folded_range: (shortest, longest),
            end_tolerance: Thread(get(values, Key::EndToleranceUm) as i32),
            end_overrun: Thread(get(values, Key::EndOverrunUm) as i32),
            drift: Thread(get(values, Key::DriftUm) as i32),
            fold_timeout_ms: get(values, Key::FoldTimeoutMs),
            unfold_timeout_ms: get(values, Key::UnfoldTimeoutMs),
            // At most a minute.
            link_timeout_us: get(values, Key::LinkTimeoutMs) * 1_000,
        })
    }

    /// Longest way to the folded end from an unknown position: the longest calibration, and a thread that was left past zero.
    pub fn seek_limit(&self) -> Thread {
        Thread(self.folded_range.1.0 + 1_000)
    }

    /// These with so many thousandths of the end force. The speed loop bounds the current to what it is for.
    pub fn with_force(&self, thousandths: i32) -> Self {
        let scaled = |ma: u16| {
            let ma = i32::from(ma) * thousandths / 1_000;
            ma.clamp(0, MOST_FORCE_MA.into()) as u16
        };
        Self {
            force_ma: scaled(self.force_ma),
            met_ma: scaled(self.met_ma),
            resisted_ma: scaled(self.resisted_ma),
            near_ma: (scaled(self.near_ma.0), scaled(self.near_ma.1)),
            ..*self
        }
    }
}

/// Counts of a length of thread; per second, of a speed.
const fn counts_of(um: u32) -> i32 {
    Thread(um as i32).counts().0
}
