//! Whatever the inputs, the machine never drives past zero or the soft maximum, at rest or in a fault. Every motion
//! ends in time, and is reported once when it starts and once when it ends.

use firmware_capsule::calibration::Calibration;
use firmware_capsule::fold::{Actions, BRAKE_US, Capsule, Command, Drive, Event};
use firmware_capsule::mechanics::{BACK_OFF, BACK_OFFS, Counts, Thread};
use firmware_capsule::sample::Sample;
use firmware_capsule::settings::Settings;
use proptest::prelude::*;
use protocol::capsule::{
    ActuationKind, ActuationOutcome, CapsuleEvent, CapsuleFault, CapsuleState,
};

#[derive(Clone, Debug)]
enum Input {
    /// Some milliseconds, each with this many counts in the drive's direction.
    Turn {
        ms: u16,
        counts_per_ms: i32,
        current_ma: u16,
        battery_mv: u16,
    },
    /// The encoder jumps by this.
    Leap(i32),
    Command(Command),
    Silence,
    DriverFault,
}

fn command() -> impl Strategy<Value = Command> {
    prop_oneof![
        3 => Just(Command::Reference),
        1 => Just(Command::Calibrate),
        1 => Just(Command::CheckFolded),
        4 => Just(Command::Fold),
        4 => Just(Command::Unfold),
        4 => (-100..25_000).prop_map(|um| Command::FoldTo(Thread(um))),
        1 => Just(Command::Stop),
        1 => Just(Command::EStop),
        2 => Just(Command::Acknowledge),
    ]
}

fn input() -> impl Strategy<Value = Input> {
    let current_ma = prop_oneof![6 => 10_u16..60, 3 => 80_u16..300, 1 => any::<u16>()];
    let battery_mv = prop_oneof![9 => 3_000_u16..4_300, 1 => any::<u16>()];
    prop_oneof![
        8 => (1_u16..900, -3_i32..25, current_ma, battery_mv).prop_map(
            |(ms, counts_per_ms, current_ma, battery_mv)| Input::Turn { ms, counts_per_ms, current_ma, battery_mv }
        ),
        1 => any::<i32>().prop_map(Input::Leap),
        1 => (-20_000_i32..20_000).prop_map(Input::Leap),
        6 => command().prop_map(Input::Command),
        1 => Just(Input::Silence),
        1 => Just(Input::DriverFault),
    ]
}

/// Counts per ms of a motor whose speed follows from its voltage and current.
const BY_VOLTAGE: i32 = i32::MAX;

struct Monitor {
    capsule: Capsule,
    now_us: u64,
    sample: Sample,
    seek_from: Counts,
    /// Position at which the motor last began to pay out.
    top: Counts,
    reached: [bool; 10],
    /// Back-EMF times 1 ms left over from the last whole count, mV.
    turned_mv: i32,
    /// Motions reported as started so far.
    actuations: u32,
    /// Kind of the motion reported as started and not yet as ended, and its start.
    running: Option<(ActuationKind, u64)>,
}

impl Monitor {
    fn give(&mut self, event: Event) -> Result<(), TestCaseError> {
        let actions = self.step(event)?;
        self.check_reports(&actions)?;
        self.check_drive(actions.drive)
    }

    fn step(&mut self, event: Event) -> Result<Actions, TestCaseError> {
        let before = self.capsule.state();
        let paid_out = matches!(self.capsule.drive(), Drive::Millivolts(..0));
        let actions = self.capsule.step(self.now_us, event);
        let state = self.capsule.state();
        self.reached[state as usize] = true;
        let seeks = |state| matches!(state, CapsuleState::Referencing | CapsuleState::Checking);
        if !seeks(before) && seeks(state) {
            self.seek_from = self.sample.counts;
        }
        prop_assert_eq!(actions.drive, self.capsule.drive());
        if !paid_out {
            self.top = self.sample.counts;
        }
        if actions.refusal.is_some() {
            prop_assert_eq!(state, before, "a refusal changes nothing");
            prop_assert!(actions.events.is_empty());
        }
        Ok(actions)
    }

    fn check_reports(&mut self, actions: &Actions) -> Result<(), TestCaseError> {
        for event in &actions.events {
            match *event {
                CapsuleEvent::Started { actuation, kind } => {
                    prop_assert_eq!(self.running, None);
                    self.actuations += 1;
                    prop_assert_eq!(actuation, self.actuations);
                    self.running = Some((kind, self.now_us));
                }
                CapsuleEvent::Ended { actuation, outcome } => {
                    prop_assert!(self.running.take().is_some(), "ended twice");
                    prop_assert_eq!(actuation, self.actuations);
                    prop_assert_eq!(outcome, self.capsule.record().outcome);
                    prop_assert!(outcome != ActuationOutcome::Running);
                }
                CapsuleEvent::NotKept
                | CapsuleEvent::SettingChanged(_)
                | CapsuleEvent::SettingsReset
                | CapsuleEvent::SettingsUnusable => {
                    prop_assert!(false, "the machine writes nothing");
                }
                CapsuleEvent::Drifted { .. } => {
                    prop_assert_eq!(self.capsule.state(), CapsuleState::WasFolded);
                    prop_assert!(!self.capsule.referenced());
                }
                CapsuleEvent::Faulted(fault) => {
                    prop_assert_eq!(self.capsule.fault(), Some(fault));
                }
            }
        }
        prop_assert_eq!(self.running.is_some(), self.capsule.is_moving());
        if let Some((kind, since_us)) = self.running {
            // The deadline counts from the end of the brake before the motion. It is not checked while a reversal
            // brakes.
            let limit_us = u64::from(self.capsule.timeout_ms(kind)) * 1_000 + 2 * BRAKE_US;
            let record = self.capsule.record();
            prop_assert_eq!((record.kind, record.actuation), (kind, self.actuations));
            prop_assert!(self.now_us - since_us < limit_us, "{:?} for too long", kind);
        }
        Ok(())
    }

    fn check_drive(&mut self, drive: Drive) -> Result<(), TestCaseError> {
        let state = self.capsule.state();
        let Drive::Millivolts(millivolts) = drive else {
            return Ok(());
        };
        prop_assert!(self.capsule.is_moving(), "drives in {:?}", state);
        prop_assert!(millivolts.unsigned_abs() <= self.sample.battery_mv);
        let thread = self.capsule.thread();
        if self.capsule.referenced() && millivolts > 0 {
            let end = self.capsule.calibration().expect("referenced").folded;
            prop_assert!(
                thread.0 < end.0 + self.capsule.settings().end_overrun.0,
                "winds at {:?}",
                thread
            );
        }
        if self.capsule.referenced() && millivolts < 0 {
            prop_assert!(thread > Thread(0), "pays out at {:?}", thread);
        }
        if !self.capsule.referenced() {
            let seeks = matches!(state, CapsuleState::Referencing | CapsuleState::Checking);
            prop_assert!(seeks, "drives in {:?}", state);
            let way = self.sample.counts.since(self.seek_from).thread();
            prop_assert!(
                millivolts < 0 || way < self.capsule.settings().seek_limit(CALIBRATION.folded),
                "seeks at {:?}",
                way
            );
            let out = self.top.since(self.sample.counts).thread();
            // A calibration pays out what it wound; it counts as referenced once the tension is known.
            let most = Thread(BACK_OFF.0 * (i32::from(BACK_OFFS) + 1));
            prop_assert!(millivolts > 0 || out < most, "backs off by {:?}", out);
        }
        Ok(())
    }

    fn take(&mut self, input: Input) -> Result<(), TestCaseError> {
        match input {
            Input::Turn {
                ms,
                counts_per_ms,
                current_ma,
                battery_mv,
            } => {
                let current_ua = i32::from(current_ma) * 1_000;
                self.sample.battery_mv = battery_mv;
                for _ in 0..ms {
                    let step = match self.capsule.drive() {
                        Drive::Millivolts(drive_mv) if counts_per_ms == BY_VOLTAGE => {
                            // 6 ohm, and 0.207 mV for each count/s.
                            let back_mv = i32::from(drive_mv).abs() - i32::from(current_ma) * 6;
                            self.turned_mv += back_mv.max(0);
                            let counts = self.turned_mv / 207;
                            self.turned_mv %= 207;
                            counts * i32::from(drive_mv).signum()
                        }
                        Drive::Millivolts(millivolts) if millivolts > 0 => counts_per_ms,
                        Drive::Millivolts(_) => -counts_per_ms,
                        Drive::Brake | Drive::Off => 0,
                    };
                    self.sample.current_ua = match self.capsule.drive() {
                        Drive::Millivolts(millivolts) if millivolts < 0 => -current_ua,
                        _ => current_ua,
                    };
                    self.sample.counts = Counts(self.sample.counts.0.wrapping_add(step));
                    self.now_us += 1_000;
                    self.give(Event::Sample(self.sample))?;
                }
                Ok(())
            }
            Input::Leap(counts) => {
                self.sample.counts = Counts(self.sample.counts.0.wrapping_add(counts));
                self.now_us += 1_000;
                self.give(Event::Sample(self.sample))
            }
            Input::Command(command) => self.give(Event::Command(command)),
            Input::Silence => self.give(Event::LinkSilent),
            Input::DriverFault => {
                for _ in 0..5 {
                    self.now_us += 1_000;
                    let sample = Sample {
                        driver_fault: true,
                        ..self.sample
                    };
                    self.give(Event::Sample(sample))?;
                }
                Ok(())
            }
        }
    }
}

/// The result that a calibration would find.
const CALIBRATION: Calibration = Calibration {
    folded: Thread(21_700),
    no_load_ma: 16,
    rise: Thread(1_500),
    long_rise: Thread(3_300),
    tension_ma: 50,
    back_emf_uv_cps: 207,
};

fn monitor(fault: Option<CapsuleFault>, start: i32, known: bool) -> Monitor {
    let sample = Sample {
        counts: Counts(start),
        current_ua: 0,
        offset_ma: 0,
        battery_mv: 3_900,
        driver_fault: false,
    };
    Monitor {
        capsule: Capsule::new(
            fault,
            known.then_some(CALIBRATION),
            known.then_some(Thread(0)),
            Settings::REFERENCE,
        ),
        now_us: 0,
        sample,
        seek_from: Counts(start),
        top: Counts(start),
        reached: [false; 10],
        turned_mv: 0,
        actuations: 0,
        running: None,
    }
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 2_000,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    #[test]
    fn the_limits_hold_for_any_sequence(
        start in prop_oneof![Just(0), Just(i32::MAX - 100), any::<i32>()],
        panicked in any::<bool>(),
        known in any::<bool>(),
        inputs in prop::collection::vec(input(), 1..60),
    ) {
        let mut monitor = monitor(panicked.then_some(CapsuleFault::Panic), start, known);
        monitor.give(Event::Sample(monitor.sample))?;
        for input in inputs {
            monitor.take(input)?;
        }
    }
}

/// The property above proves nothing unless the sequences reach the interesting states.
#[test]
fn the_judge_sees_every_state() {
    let mut monitor = monitor(None, 0, true);
    let turn = |ms, counts_per_ms, current_ma| Input::Turn {
        ms,
        counts_per_ms,
        current_ma,
        battery_mv: 3_900,
    };
    let motor = |ms, current_ma| turn(ms, BY_VOLTAGE, current_ma);
    let folded = [
        motor(100, 20),
        motor(295, 60),
        motor(200, 100),
        motor(45, 175),
    ];
    let felt = [motor(50, 90)];
    let taut = [motor(100, 40), motor(300, 20)];
    let script = [
        &[turn(1, 0, 0), Input::Command(Command::CheckFolded)][..],
        &folded,
        &[turn(60, 0, 0), Input::Command(Command::Unfold)],
        &felt,
        &taut,
        &[Input::Command(Command::Stop), turn(60, 0, 0)],
        &[Input::Command(Command::Fold), motor(100, 20)],
        &[Input::Command(Command::Stop), turn(60, 0, 0)],
        &[Input::Command(Command::Reference)],
        &folded,
        &taut,
        // 7 mm/s until the last half millimetre.
        &[motor(3_000, 20), motor(3_000, 20)],
        &[
            Input::Command(Command::EStop),
            Input::Command(Command::Acknowledge),
        ],
    ];
    for input in script.into_iter().flatten() {
        monitor.take(input.clone()).expect("the limits hold");
    }
    assert_eq!(monitor.reached, [true; 10]);
}
