//! The limits that control uses, derived from the settings in flash.

use crate::mechanics::Thread;
use device::settings::Values;
use protocol::settings::{SettingKey as Key, SettingRule};

/// Limits derived from all values that a person can change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Current above the no-load current at the end force, mA: 5.6 N with the assumed friction of the worm, 4.6 to
    /// 7.3 N over the range of friction. The last 1.6 mm before it take 37 % of the nominal fold's energy.
    pub force_ma: u16,
    /// The same at half of the end force, where the rise begins that tells an origami from an obstacle.
    pub rise_start_ma: u16,
    /// Near the end force: current at which that begins, and at which it ends (hysteresis, so that the speed does not
    /// oscillate).
    pub near_ma: (u16, u16),
    /// Current above the no-load current from which a slow motor that meets something hard is at the end force, mA.
    pub met_ma: u16,
    /// Current above the no-load current from which a fold goes slowly, mA. The stiffest origami with the most
    /// friction takes 115 mA where the fold slows down anyway.
    pub resisted_ma: u16,
    /// Winding speed over the long part, counts/s.
    pub fold_cps: i32,
    /// Winding speed where force ends the leg, counts/s.
    pub slow_cps: i32,
    /// Winding speed near the end force, counts/s. A soft origami meets its hard end there.
    pub near_cps: i32,
    /// Largest speed of paying out, counts/s; the battery may give less.
    pub pay_out_cps: i32,
    /// Minimum battery voltage for starting a motion, mV.
    pub least_battery_mv: u16,
    /// Battery voltage under load below which the cell is empty, mV.
    pub loaded_battery_mv: u16,
    /// Resistance of the motor's circuit, mohm: winding 5.4 ohm, both switches of the bridge 0.6, cell 0.5.
    pub loop_milliohm: u32,
    /// Back-EMF, uV per count per second: 0.221 mV/rpm over 64 counts.
    pub back_emf_uv_per_cps: u32,
    /// No-load current until it is measured, mA: the data sheet's.
    pub no_load_ma: u16,
    /// Proportional gain of the speed loop, uA per count/s. The motor has 4.2 counts/s2 per uA, so 15 is a bandwidth
    /// of 60 rad/s; the speed is 4 ms old.
    pub proportional_ua: i32,
    /// Shortest and longest way from the unfolded end to the end force that a calibration accepts. Shortest: 16.7 mm
    /// of travel with four times the stiffness and much friction. Longest: 23.4 mm of travel. Plus the slack.
    pub folded_range: (Thread, Thread),
    /// An end force this close before the calibrated end is still the folded origami's.
    pub end_tolerance: Thread,
    /// Allowed overrun past the calibrated end while no end force comes.
    pub end_overrun: Thread,
    /// Allowed wandering of the folded end.
    pub drift: Thread,
    /// Time limit of a fold, ms: the model motor takes 2 s, 2.9 s if its end is felt, and 4.4 s if something
    /// resists on the way.
    pub fold_timeout_ms: u32,
    /// Time limit of an unfolding, ms: the model motor takes 1.3 s, twice that with an almost empty battery.
    pub unfold_timeout_ms: u32,
    /// Silence of the host that ends a motion, us.
    pub link_timeout_us: u32,
}

/// Largest end force, mA above the no-load current; the speed loop gives 200 mA.
const MOST_FORCE_MA: u16 = 185;

/// Scales a limit with the end force: `of_135` belongs to an end force of 135 mA.
const fn share(force_ma: u32, of_135: u32) -> u16 {
    (force_ma * of_135 / 135) as u16
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

    /// Longest search for the folded end from an unknown position: the longest calibration, or the one in force if that is
    /// longer, plus a thread left past zero.
    pub fn seek_limit(&self, calibrated: Thread) -> Thread {
        Thread(self.folded_range.1.max(calibrated).0 + 1_000)
    }

    /// These settings with the end force scaled by this many thousandths. The speed loop bounds the current
    /// accordingly.
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

/// Counts for a length of thread in um, or counts/s for a speed in um/s.
const fn counts_of(um: u32) -> i32 {
    Thread(um as i32).counts().0
}
