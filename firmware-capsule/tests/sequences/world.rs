//! The surroundings of control in a random sequence: a board without hardware, and readings that no model of a motor
//! made. They are far apart, to be quick: a fold is some 20 readings, spread over its two seconds.

use device::{
    common::Surroundings,
    retained::{EStop, Retained},
};
use firmware_capsule::{control, fold::Drive, mechanics::Counts, sample::Sample};
use protocol::{
    capsule::CapsuleTelemetry,
    system::{self, What},
};
use simulated_machines::dice::Dice;

use crate::control::CHIP;

/// The rest of the capsule, as control sees it.
#[derive(Default)]
pub struct Board {
    pub now_us: u64,
    /// When the host was last heard.
    pub heard_us: u64,
    pub supply_low: bool,
    /// The present drive of the bridge.
    pub drive: Drive,
    pub shown: Option<CapsuleTelemetry>,
    /// Events that the judge has not seen yet.
    pub told: Vec<What>,
    pub telemetry_ms: u16,
    /// Emergency stop in the memory that outlives a reset.
    pub latched: Option<EStop>,
}

impl Board {
    /// Contents of the memory that outlives a reset, for the next start.
    pub fn retained(&self, clock_failed: bool) -> Retained {
        Retained {
            boot_id: 1,
            last_words: None,
            latched: self.latched,
            clock_failed,
            cause: None,
        }
    }
}

impl control::Capsule for Board {
    fn drive(&mut self, drive: Drive) {
        self.drive = drive;
    }

    fn show(&mut self, telemetry: CapsuleTelemetry) {
        self.shown = Some(telemetry);
    }
}

impl Surroundings for Board {
    fn now_us(&self) -> u64 {
        self.now_us
    }

    fn chip(&self) -> system::Chip {
        system::Chip {
            supply_low: self.supply_low,
            ..CHIP
        }
    }

    fn silence_us(&self) -> u32 {
        u32::try_from(self.now_us - self.heard_us).unwrap_or(u32::MAX)
    }

    fn set_telemetry(&mut self, period_ms: u16) {
        self.telemetry_ms = period_ms;
    }

    fn keep_latched(&mut self, estop: Option<EStop>) {
        self.latched = estop;
    }

    fn tell(&mut self, event: &system::Event) {
        self.told.push(event.what);
    }
}

/// Thread for a number of encoder counts, um: 2 pi x 1.5 mm in 7,680 counts.
pub fn um(counts: i32) -> i32 {
    (f64::from(counts) * 1.227_185).round() as i32
}

/// Encoder counts for a length of thread.
pub fn counts(um: i32) -> i32 {
    (f64::from(um) / 1.227_185).round() as i32
}

/// A defect of the capsule.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mishap {
    None,
    /// Something hard lies this much before the folded end, um.
    Jam(i32),
    /// No force at all, some of it, or as much while paying out as while winding.
    Broken,
    Weak,
    Slipped,
    /// The motor stands.
    Stuck,
    /// The motor turns and the encoder does not count, or counts down.
    Uncounted,
    WrongWay,
    /// No current is read, from a motor that turns, that stands, or that stands and loads the cell.
    Silent,
    SilentStuck,
    SilentLoaded,
    /// A short circuit.
    Short,
    /// Twice the current is read.
    Gain,
    /// The cell gives this much under load, mV.
    Sag(u16),
    /// The motor hardly turns.
    Crawl,
    Driver,
    /// Any bits.
    Nonsense,
}

/// Way of a leg that pays out in which it is read closely, um: that of one that feels the thread, or makes room for it.
const CLOSELY_UM: i32 = 2_200;
/// Readings kept for the mean of the current.
const AVERAGED: usize = 8;
/// Current of a slack thread, mA.
const NO_LOAD_MA: i32 = 16;

/// Makes the readings.
pub struct World {
    pub mishap: Mishap,
    pub battery_mv: u16,
    pub offset_ma: i16,
    /// Where the thread is, and where the folded end is.
    pub counts: i32,
    pub end: i32,
    /// Thread from the unfolded to the folded end, um.
    pub folded_um: i32,
    /// Way of a winding leg in which it is read closely, um: the current of a slack thread is measured from 800 on.
    pub slack_um: i32,
    /// Direction of the present leg, 0 before the first; where it began; readings since then; how finely it is read.
    along: i32,
    from: i32,
    readings: usize,
    fineness: i32,
    /// Currents above the no-load current, and the mean that they are to have.
    excess_ma: [i32; AVERAGED],
    mean_ma: i32,
}

impl World {
    pub fn new(counts: i32, folded_um: i32) -> Self {
        Self {
            mishap: Mishap::None,
            battery_mv: 3_900,
            offset_ma: 0,
            counts,
            end: counts.wrapping_add(self::counts(folded_um)),
            folded_um,
            slack_um: 400,
            along: 0,
            from: counts,
            readings: 0,
            fineness: 1,
            excess_ma: [0; AVERAGED],
            mean_ma: 0,
        }
    }

    /// Puts everything in order.
    pub fn repair(&mut self) {
        (self.mishap, self.battery_mv, self.offset_ma) = (Mishap::None, 4_100, 0);
    }

    /// A person unfolds the origami.
    pub fn unfold(&mut self) {
        self.end = self.counts.wrapping_add(counts(self.folded_um));
    }

    /// A person, or a thread that slips, leaves it folded.
    pub fn fold(&mut self) {
        self.end = self.counts;
    }

    /// The folded end moves by this, um.
    pub fn creep(&mut self, by_um: i32) {
        self.end = self.end.wrapping_add(counts(by_um));
    }

    /// Distance to the folded end, um.
    fn left_um(&self) -> i32 {
        um(self.end.wrapping_sub(self.counts))
    }

    /// Current above the no-load current, mA, this far from the end.
    fn force_ma(&self, left_um: i32) -> i32 {
        let force_ma = match left_um {
            7_000.. => 0,
            3_300.. => (7_000 - left_um) * 33 / 3_700,
            1_500.. => 33 + (3_300 - left_um) * 33 / 1_800,
            _ => 66 + (1_500 - left_um.max(-2_500)) * 66 / 1_500,
        };
        match self.mishap {
            Mishap::Broken => 0,
            Mishap::Weak => force_ma.min(60),
            Mishap::Jam(at_um) if left_um < at_um => 150,
            _ => force_ma,
        }
    }

    /// Length and speed of the way to the next reading, um and counts/s.
    fn way(&self, dice: &mut Dice) -> (i32, i32) {
        let left_um = self.left_um();
        let leg_um = um(self.counts.wrapping_sub(self.from)).saturating_abs();
        let done_um = self.folded_um.saturating_sub(left_um);
        let (way_um, cps) = match (self.along, left_um) {
            // The current tells nothing in the first 30 ms.
            (_, ..1_000) if self.readings == 0 => (20, 400),
            _ if self.readings == 0 => (100, 2_000),
            // The leg may be one that feels the thread, or makes room for that.
            (1, 4_500..) if leg_um < self.slack_um => (100, 4_000),
            (-1, _) if leg_um < CLOSELY_UM => (60, 3_000),
            (1, 4_500..) => ((left_um - 4_000) / dice.pick(&[1, 1, 1, 3]), 4_400),
            (1, 3_000..) => (300 / self.fineness, 3_500),
            (1, 1_500..) => (300 / self.fineness, 2_000),
            (1, 0..) => (300 / self.fineness, 700),
            (1, _) => (20, 300),
            (_, ..2_000) => (60, 3_000),
            _ if done_um > 2_500 => ((done_um - 1_500) / dice.pick(&[1, 1, 1, 3]), 12_000),
            _ => (200, 1_800),
        };
        match self.mishap {
            Mishap::Crawl => (15, 24),
            // The causes are told from readings 1 ms apart.
            Mishap::Silent => (3, 2_000),
            Mishap::Stuck | Mishap::SilentStuck | Mishap::SilentLoaded => (3, 1_200),
            Mishap::Jam(at_um) if self.along > 0 && left_um < at_um + 300 => (10, 300),
            _ => (way_um.max(1), cps),
        }
    }

    /// Goes on to the next reading; returns the time that it takes, us.
    pub fn turn(&mut self, dice: &mut Dice, drive: Drive) -> (u64, Sample) {
        let along = match drive {
            Drive::Millivolts(millivolts) => i32::from(millivolts.signum()),
            Drive::Brake | Drive::Off => 0,
        };
        let mut sample = Sample {
            counts: Counts(self.counts),
            current_ua: 0,
            offset_ma: self.offset_ma,
            battery_mv: self.battery_mv,
            driver_fault: self.mishap == Mishap::Driver,
        };
        if along == 0 {
            let elapsed_us = match drive {
                Drive::Off => 100_000,
                _ => dice.pick(&[1_000, 20_000, 39_500, 41_000, 41_000]),
            };
            self.along = 0;
            return (elapsed_us, self.senseless(dice, sample));
        }
        if along != self.along {
            (self.along, self.from, self.readings) = (along, self.counts, 0);
            self.fineness = dice.pick(&[1, 1, 1, 2, 8]);
            self.mean_ma = self.force_ma(self.left_um());
            self.excess_ma = [self.mean_ma; AVERAGED];
        }
        let (way_um, cps) = self.way(dice);
        let way = counts(way_um).max(1);
        let elapsed_us = (i64::from(way) * 1_000_000 / i64::from(cps)) as u64;
        let way = match self.mishap {
            Mishap::Stuck | Mishap::Uncounted | Mishap::SilentStuck | Mishap::SilentLoaded => 0,
            Mishap::WrongWay => -way,
            _ => way,
        };
        self.counts = self.counts.wrapping_add(along * way);
        sample.counts = Counts(self.counts);
        let current_ma = self.current_ma() + dice.below(3) as i32;
        sample.current_ua = along * current_ma * 1_000;
        if let Mishap::Sag(millivolts) = self.mishap {
            sample.battery_mv = millivolts;
        }
        if self.mishap == Mishap::SilentLoaded {
            sample.battery_mv = self.battery_mv.saturating_sub(100);
        }
        self.readings += 1;
        (elapsed_us, self.senseless(dice, sample))
    }

    fn current_ma(&mut self) -> i32 {
        let force_ma = self.force_ma(self.left_um());
        // The firmware judges a mean, which would lag behind by half of its readings.
        let oldest = &mut self.excess_ma[self.readings % AVERAGED];
        *oldest = (*oldest + (force_ma - self.mean_ma) * AVERAGED as i32).clamp(0, 420);
        let winding_ma = NO_LOAD_MA + *oldest;
        self.mean_ma = force_ma;
        let current_ma = match self.mishap {
            _ if self.along > 0 => winding_ma,
            Mishap::Slipped => NO_LOAD_MA + force_ma,
            // The worm holds the thread.
            _ => NO_LOAD_MA + force_ma / 5,
        };
        match self.mishap {
            Mishap::Stuck => 200,
            Mishap::Silent | Mishap::SilentStuck | Mishap::SilentLoaded => -1,
            Mishap::Short => 700,
            Mishap::Gain => 2 * current_ma,
            _ => current_ma,
        }
    }

    fn senseless(&mut self, dice: &mut Dice, sample: Sample) -> Sample {
        if self.mishap != Mishap::Nonsense {
            return sample;
        }
        let any = dice.bits();
        // Beyond what the converter can read.
        let current_ua = any as i32 % 4_000_000;
        let changed = dice.below(6);
        let counts = match changed {
            0 => self.counts.wrapping_add(any as i32 % 4_000_000),
            1 | 5 => self.counts.wrapping_add(any as i32 % 20_000),
            _ => self.counts,
        };
        if any >> 63 == 0 {
            self.counts = counts;
        }
        Sample {
            counts: Counts(counts),
            current_ua: if changed == 2 {
                current_ua
            } else {
                sample.current_ua
            },
            battery_mv: if changed == 3 {
                any as u16
            } else {
                sample.battery_mv
            },
            offset_ma: if changed == 4 {
                any as i16
            } else {
                sample.offset_ma
            },
            driver_fault: any >> 60 == 0,
        }
    }
}
