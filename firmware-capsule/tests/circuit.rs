//! The comparison of voltage, current and speed: what it tolerates, and what it measures.
//!
//! The numbers follow from the settings of a new capsule: 6.5 ohm of winding, bridge and cell, of which the cell is
//! 0.5, and 207 uV of back-EMF per count per second.

use firmware_capsule::{
    circuit::{Circuit, Reading},
    mechanics::Counts,
    settings::Settings,
};

const SETTINGS: Settings = Settings::REFERENCE;

/// Readings of one comparison; the first of all only marks its start.
const COMPARISON: u32 = 48;

/// A motor at steady speed.
#[derive(Clone, Copy)]
struct Motor {
    cps: i32,
    drive_mv: i16,
    current_ma: i32,
    battery_mv: u16,
    sag_mv: u16,
}

/// 10,000 counts/s are 2,070 mV of back-EMF; 20 mA are 120 mV more.
const STEADY: Motor = Motor {
    cps: 10_000,
    drive_mv: 2_190,
    current_ma: 20,
    battery_mv: 3_700,
    sag_mv: 0,
};

/// The comparison, one reading per millisecond.
struct Bench {
    circuit: Circuit,
    now_us: u64,
    along: i32,
}

impl Bench {
    fn new() -> Self {
        let mut bench = Self {
            circuit: Circuit::default(),
            now_us: 1_000,
            along: 0,
        };
        assert!(!bench.read(STEADY, 1), "the start of the first comparison");
        bench
    }

    /// Takes readings; whether the last one found that the comparisons disagree.
    fn read(&mut self, motor: Motor, count: u32) -> bool {
        let mut disagrees = false;
        for _ in 0..count {
            self.now_us += 1_000;
            self.along += motor.cps / 1_000;
            let reading = Reading {
                drive_mv: motor.drive_mv,
                current_ua: motor.current_ma * 1_000,
                along: Counts(self.along),
                battery_mv: motor.battery_mv,
                sag_mv: motor.sag_mv,
                at_us: self.now_us,
            };
            disagrees = self.circuit.take(Some(reading), 0, &SETTINGS);
        }
        disagrees
    }

    fn disagrees_now(&self) -> bool {
        self.circuit.disagrees_now(0, &SETTINGS)
    }
}

fn with_current(current_ma: i32) -> Motor {
    Motor {
        current_ma,
        ..STEADY
    }
}

/// Whether two comparisons in a row disagree.
fn disagrees(motor: Motor) -> bool {
    let mut bench = Bench::new();
    assert!(!bench.read(motor, COMPARISON), "one is not enough");
    bench.read(motor, COMPARISON)
}

/// 4 mA of noise; 12 % of the larger current for the resistance; of the 345 mA that the back-EMF alone would drive,
/// 3 % upward for a warmer magnet and 1 % downward.
#[test]
fn a_current_within_the_tolerances_agrees() {
    for (agrees, does_not) in [(38, 39), (11, 10)] {
        assert!(!disagrees(with_current(agrees)), "{agrees} mA");
        assert!(disagrees(with_current(does_not)), "{does_not} mA");
    }
}

/// In the pulses the battery sags by 40 mV below the mean: less current is expected, 13 mA, and 6 mA more tolerated.
#[test]
fn a_sagging_battery_lowers_what_is_expected() {
    let sagging = |current_ma| Motor {
        sag_mv: 200,
        ..with_current(current_ma)
    };
    for (agrees, does_not) in [(37, 38), (-1, -2)] {
        assert!(!disagrees(sagging(agrees)), "{agrees} mA");
        assert!(disagrees(sagging(does_not)), "{does_not} mA");
    }
}

/// Nor is one that turns backwards.
#[test]
fn a_slow_motor_is_not_compared() {
    let slow = |cps| Motor {
        cps,
        ..with_current(200)
    };
    assert!(!disagrees(slow(1_000)));
    assert!(!disagrees(slow(-10_000)));
    assert!(disagrees(slow(2_000)));
}

/// Three counts in 2 ms are 1,500 counts/s.
#[test]
fn a_motor_that_is_just_fast_enough_is_compared() {
    for (counts, compared) in [(3, true), (2, false)] {
        let mut circuit = Circuit::default();
        let mut disagrees = false;
        for reading in 0..=2 * COMPARISON {
            let reading = Reading {
                drive_mv: 500,
                current_ua: 200_000,
                along: Counts(reading as i32 * counts),
                battery_mv: 3_700,
                sag_mv: 0,
                at_us: 1_000 + u64::from(reading) * 2_000,
            };
            disagrees = circuit.take(Some(reading), 0, &SETTINGS);
        }
        assert_eq!(disagrees, compared, "{counts}");
    }
}

#[test]
fn only_comparisons_in_a_row_and_of_one_sign_count() {
    let mut bench = Bench::new();
    for motor in [
        with_current(60),
        STEADY,
        with_current(60),
        with_current(-20),
        with_current(60),
    ] {
        assert!(!bench.read(motor, COMPARISON));
    }
    assert!(bench.read(with_current(60), COMPARISON));
    assert!(bench.read(with_current(60), COMPARISON), "it stays so");
    // The first of another sign is the first of two.
    let mut bench = Bench::new();
    for (current_ma, disagrees) in [(60, false), (-20, false), (-20, true)] {
        let found = bench.read(with_current(current_ma), COMPARISON);
        assert_eq!(found, disagrees, "{current_ma} mA");
    }
}

/// At the end of a motion a third of a comparison is enough; a shorter one says what the one before said.
#[test]
fn the_end_of_a_motion_judges_what_there_is() {
    for (before, count, now, expected) in [
        (STEADY, 15, with_current(60), false),
        (STEADY, 16, with_current(60), true),
        (with_current(60), 15, STEADY, true),
        (with_current(60), 16, STEADY, false),
    ] {
        let mut bench = Bench::new();
        bench.read(before, COMPARISON);
        bench.read(now, count);
        assert_eq!(bench.disagrees_now(), expected, "{count}");
    }
}

/// A brake begins the comparison anew.
#[test]
fn readings_from_before_a_brake_do_not_count() {
    let mut bench = Bench::new();
    bench.read(with_current(60), COMPARISON - 1);
    assert!(!bench.circuit.take(None, 0, &SETTINGS));
    bench.read(STEADY, 1 + COMPARISON);
    bench.read(STEADY, 16);
    assert!(!bench.disagrees_now());
    assert_eq!(bench.circuit.constant_uv_cps(), 207);
}

/// Only with little current, where the resistance matters little, and only where there is a back-EMF.
#[test]
fn the_motor_constant_is_the_mean_of_comparisons_with_little_current() {
    let constant = |motors: &[Motor]| {
        let mut bench = Bench::new();
        for motor in motors {
            bench.read(*motor, COMPARISON);
        }
        bench.circuit.constant_uv_cps()
    };
    assert_eq!(constant(&[]), 0);
    assert_eq!(constant(&[STEADY]), 207);
    // 20 mV more at 10,000 counts/s are 2 uV per count/s more; the mean is 1 more.
    let stronger = Motor {
        drive_mv: 2_210,
        ..STEADY
    };
    assert_eq!(constant(&[stronger]), 209);
    assert_eq!(constant(&[STEADY, stronger]), 208);
    // In the pulses the battery sags by 40 mV below the mean.
    let sagging = Motor {
        sag_mv: 200,
        ..STEADY
    };
    assert_eq!(constant(&[sagging]), 203);
    assert_eq!(constant(&[with_current(45)]), 192);
    let none = [
        with_current(46),
        with_current(-1),
        // All of the voltage drops at the resistance.
        Motor {
            drive_mv: 120,
            ..STEADY
        },
        Motor {
            cps: 1_000,
            ..STEADY
        },
    ];
    for motor in none {
        assert_eq!(constant(&[motor]), 0);
        assert_eq!(constant(&[STEADY, motor]), 207, "it is not in the mean");
    }
}

/// A constant known from a calibration takes the place of the setting.
#[test]
fn a_known_constant_is_what_the_comparison_expects() {
    let mut circuit = Circuit::default();
    let mut disagreed = false;
    for reading in 0..=2 * COMPARISON {
        let reading = Reading {
            drive_mv: 2_190,
            current_ua: 20_000,
            along: Counts(reading as i32 * 10),
            battery_mv: 3_700,
            sag_mv: 0,
            at_us: 1_000 + u64::from(reading) * 1_000,
        };
        // 10 % less back-EMF: 34 mA more would flow.
        disagreed = circuit.take(Some(reading), 186, &SETTINGS);
    }
    assert!(disagreed);
    assert!(circuit.disagrees_now(186, &SETTINGS));
}

/// 20 % of 207 uV.
#[test]
fn a_constant_far_from_the_setting_is_not_possible() {
    for (constant, possible) in [
        (0, true),
        (1, false),
        (165, false),
        (166, true),
        (248, true),
        (249, false),
        (u16::MAX, false),
    ] {
        let is = Circuit::is_possible(constant, &SETTINGS);
        assert_eq!(is, possible, "{constant}");
    }
}
