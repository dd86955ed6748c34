//! The rig's settings: from single values, as stored and as on the wire, to what the firmware works with.

use motion::{
    axis::{Axis, AxisError, Speed},
    run::Limits,
    trapezoid::StrokeProfile,
    units::{Micrometres, Steps, TICK_HZ},
};
use protocol::{
    error::{Field, Refusal},
    settings::{SettingKey, SettingRule},
};

/// Ticks of 10 ns per microsecond.
const TICKS_PER_US: u32 = (TICK_HZ / 1_000_000) as u32;
/// Layout of a record in flash; others are not read.
const RECORD_VERSION: u8 = 1;
/// Number of the name's record; settings have those from 0.
pub const NAME_RECORD: u8 = 0xF0;

/// One value per key, each within its range.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Values([u32; SettingKey::ALL.len()]);

impl Values {
    /// Those of a new rig.
    pub const DEFAULT: Self = {
        let mut values = [0; SettingKey::ALL.len()];
        let mut index = 0;
        while index < values.len() {
            values[index] = SettingKey::ALL[index].range().default;
            index += 1;
        }
        Self(values)
    };

    /// The value of a setting, in its unit.
    pub const fn get(&self, key: SettingKey) -> u32 {
        self.0[key as usize]
    }

    /// These values with one changed, and the settings that they give.
    ///
    /// # Errors
    /// Outside its range, or against a rule that settings keep together.
    pub fn with(&self, key: SettingKey, value: u32) -> Result<(Self, Settings), Refusal> {
        let range = key.range();
        if !(range.min..=range.max).contains(&value) {
            return Err(Refusal::SettingRange {
                key,
                requested: value,
            });
        }
        let mut values = *self;
        values.0[key as usize] = value;
        match Settings::new(&values) {
            Ok(settings) => Ok((values, settings)),
            Err(rule) => Err(Refusal::SettingRule { key, rule }),
        }
    }

    /// Takes over a record as read from flash. One that is unknown, of another layout or out of range is left
    /// out: an older or newer firmware wrote it.
    pub fn load(&mut self, number: u8, record: &[u8]) {
        let (Some(key), [RECORD_VERSION, a, b, c, d]) = (SettingKey::from_number(number), record)
        else {
            return;
        };
        let value = u32::from_le_bytes([*a, *b, *c, *d]);
        let range = key.range();
        if (range.min..=range.max).contains(&value) {
            self.0[key as usize] = value;
        }
    }

    /// A value as it is written to flash.
    pub fn record(value: u32) -> [u8; 5] {
        let [a, b, c, d] = value.to_le_bytes();
        [RECORD_VERSION, a, b, c, d]
    }
}

/// How many records ago each number was written last.
///
/// The log drops its oldest sector when it needs room. What is younger than a sector's worth of records is never
/// in there, so whatever becomes older than [`Ages::OLDEST`] is written again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ages {
    records: u32,
    /// The count of records at the last one of each number; 0 is never.
    last: [u32; Self::NUMBERS],
}

impl Ages {
    /// Settings and the name.
    pub const NUMBERS: usize = SettingKey::ALL.len() + 1;
    /// The age at which a record is written again.
    pub const OLDEST: u32 = 256;

    /// Those of an empty log.
    pub const fn new() -> Self {
        Self {
            records: 0,
            last: [0; Self::NUMBERS],
        }
    }

    /// Counts a record. A number that this firmware does not know ages and is lost.
    pub fn wrote(&mut self, number: u8) {
        self.records += 1;
        let slot = match number {
            NAME_RECORD => Self::NUMBERS - 1,
            number => usize::from(number),
        };
        if let Some(last) = self.last.get_mut(slot) {
            *last = self.records;
        }
    }

    /// A number whose last record is too old.
    pub fn overdue(&self) -> Option<u8> {
        let too_old = |last: &u32| *last != 0 && self.records - last > Self::OLDEST;
        let slot = self.last.iter().position(too_old)?;
        Some(
            SettingKey::ALL
                .get(slot)
                .map_or(NAME_RECORD, |key| *key as u8),
        )
    }
}

impl Default for Ages {
    fn default() -> Self {
        Self::new()
    }
}

/// Settings of a rig. Lengths in um, speeds in um/s, accelerations in um/s2.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Screw, motor, microsteps, stroke.
    pub axis: Axis,
    /// What no plan may exceed.
    pub limits: Limits,
    /// Width of a step pulse.
    pub pulse_ticks: u16,
    /// Speed of the first homing pass.
    pub seek_um_s: u32,
    /// Speed of the second, measuring pass.
    pub locate_um_s: u32,
    /// Acceleration of homing, jog and move.
    pub homing_accel_um_s2: u32,
    /// Deceleration of a category-1 stop and of a hold.
    pub stop_accel_um_s2: u32,
    /// How far the first pass may travel beyond the stroke before the flag counts as missing.
    pub overtravel_um: u32,
    /// Distance between the two passes.
    pub pull_off_um: u32,
    /// Where the home flag's edge lies, measured from position 0.
    pub flag_um: u32,
    /// Longest time of homing.
    pub homing_timeout_us: u64,
    /// Largest residual of the position ledger that a run tolerates, in steps.
    pub ledger_limit_steps: u32,
    /// Silence of the host that counts as a lost link while the machine moves.
    pub link_timeout_us: u64,
    /// A jog that is not renewed within this time stops.
    pub dead_man_us: u64,
}

impl Settings {
    /// The paper's rig, the default: SFU1204 screw, 1/16 microsteps, 130 mm.
    pub const REFERENCE: Self = match Self::new(&Values::DEFAULT) {
        Ok(settings) => settings,
        Err(_) => panic!("the defaults keep the rules"),
    };

    /// The settings of these values.
    ///
    /// # Errors
    /// The first rule that they do not keep together.
    pub const fn new(values: &Values) -> Result<Self, SettingRule> {
        use SettingKey as Key;
        let get = Values::get;
        let axis = match Axis::new(
            get(values, Key::LeadUm),
            get(values, Key::FullSteps) as u16,
            get(values, Key::Microsteps) as u16,
            get(values, Key::StrokeUm),
        ) {
            Ok(axis) => axis,
            Err(AxisError::FullSteps { .. }) => return Err(SettingRule::FullSteps),
            Err(AxisError::Microsteps { .. }) => return Err(SettingRule::Microsteps),
            Err(_) => return Err(SettingRule::StrokeHoldsAStep),
        };
        let pull_off_um = get(values, Key::PullOffUm);
        if !matches!(axis.steps_within(Micrometres(pull_off_um)), Some(steps) if steps.0 > 0) {
            return Err(SettingRule::PullOffHoldsAStep);
        }
        let flag_um = get(values, Key::FlagUm);
        if flag_um + pull_off_um > axis.stroke().0 {
            return Err(SettingRule::FlagWithinStroke);
        }
        let min_interval_ticks = (TICK_HZ as u32).div_ceil(get(values, Key::MaxStepHz));
        let pulse_ticks = get(values, Key::StepPulseNs).div_ceil(10);
        if 2 * pulse_ticks > min_interval_ticks {
            return Err(SettingRule::PulseWithinStep);
        }
        let (seek_um_s, locate_um_s) = (get(values, Key::SeekUmS), get(values, Key::LocateUmS));
        let fastest = if seek_um_s > 2 * locate_um_s {
            seek_um_s
        } else {
            2 * locate_um_s
        };
        let steps_per_rev = axis.steps_per_rev() as u64;
        if fastest as u64 * steps_per_rev * min_interval_ticks as u64
            > TICK_HZ * axis.lead().0 as u64
        {
            return Err(SettingRule::HomingWithinStepRate);
        }
        if matches!(get(values, Key::TelemetryMs), 1..=4) {
            return Err(SettingRule::TelemetryInterval);
        }
        Ok(Self {
            axis,
            limits: Limits {
                max_speed_um_s: get(values, Key::MaxSpeedUmS),
                max_accel_um_s2: get(values, Key::MaxAccelUmS2),
                min_interval_ticks,
                min_turnaround_ticks: get(values, Key::TurnaroundUs) * TICKS_PER_US,
            },
            pulse_ticks: pulse_ticks as u16,
            seek_um_s,
            locate_um_s,
            homing_accel_um_s2: get(values, Key::HomingAccelUmS2),
            stop_accel_um_s2: get(values, Key::StopAccelUmS2),
            overtravel_um: get(values, Key::OvertravelUm),
            pull_off_um,
            flag_um,
            homing_timeout_us: get(values, Key::HomingTimeoutS) as u64 * 1_000_000,
            ledger_limit_steps: get(values, Key::LedgerLimitSteps),
            link_timeout_us: get(values, Key::LinkTimeoutMs) as u64 * 1_000,
            dead_man_us: get(values, Key::DeadManMs) as u64 * 1_000,
        })
    }

    /// The home flag's edge in steps from position 0.
    pub fn flag_steps(&self) -> i32 {
        self.steps(self.flag_um)
    }

    /// A position in um, to the nearest.
    pub fn um(&self, position: i32) -> i32 {
        let um = self.axis.length_of(Steps(position.unsigned_abs())).to_um();
        let um = i32::try_from(um).unwrap_or(i32::MAX);
        if position < 0 { -um } else { um }
    }

    /// A speed of a jog or a move.
    ///
    /// # Errors
    /// Zero, or above the limit.
    pub fn speed(&self, um_s: u32) -> Result<Speed, Refusal> {
        let max = self.limits.max_speed_um_s;
        let out_of_range = Refusal::OutOfRange {
            field: Field::SpeedUmS,
            requested: um_s.into(),
            min: 1,
            max: max.into(),
        };
        match self.axis.speed(um_s) {
            Ok(speed) if um_s <= max => Ok(speed),
            _ => Err(out_of_range),
        }
    }

    /// The profile of a jog or a move over a distance in steps.
    ///
    /// # Errors
    /// Steps faster than the driver takes, or too slow for exact step times.
    pub fn move_profile(&self, distance: i32, speed: Speed) -> Result<StrokeProfile, Refusal> {
        let accel = self.axis.acceleration(self.homing_accel_um_s2);
        let profile = accel.ok().and_then(|accel| {
            StrokeProfile::from_speed(Steps(distance.unsigned_abs()), speed, accel).ok()
        });
        let profile = profile.ok_or(Refusal::TooSlow)?;
        let (interval, least) = (profile.min_interval().0, self.limits.min_interval_ticks);
        if interval < u64::from(least) {
            return Err(Refusal::StepRateLimit {
                needed_hz: TICK_HZ / interval.max(1),
                max_hz: TICK_HZ / u64::from(least),
            });
        }
        Ok(profile)
    }

    /// A length in whole steps.
    pub fn steps(&self, um: u32) -> i32 {
        let steps = self.axis.steps_within(Micrometres(um));
        steps
            .and_then(|steps| i32::try_from(steps.0).ok())
            .unwrap_or(i32::MAX)
    }
}
