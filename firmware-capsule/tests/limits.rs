//! Whatever it is fed, the machine never drives past zero or the soft maximum, nor at rest or in a fault.

use firmware_capsule::{
    detect::Sample,
    fold::{Capsule, Command, Drive, Event},
    leg::FAST_MV,
    mechanics::{BACK_OFF, Counts, SEEK_LIMIT, SOFT_MAXIMUM, Thread},
};
use proptest::prelude::*;
use protocol::capsule::{CapsuleFault, CapsuleState};

#[derive(Clone, Debug)]
enum Input {
    /// Some milliseconds, each with this many counts in the drive's direction.
    Turn {
        ms: u16,
        counts_per_ms: i32,
        current_ma: u16,
        battery_mv: u16,
    },
    /// The encoder says anything.
    Leap(i32),
    Command(Command),
    Silence,
    DriverFault,
}

fn command() -> impl Strategy<Value = Command> {
    prop_oneof![
        3 => Just(Command::Reference),
        4 => Just(Command::Fold),
        4 => Just(Command::Unfold),
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

struct Judge {
    capsule: Capsule,
    now_us: u64,
    sample: Sample,
    seek_from: Counts,
    /// Where the motor last stopped winding.
    top: Counts,
    reached: [bool; 8],
}

impl Judge {
    fn give(&mut self, event: Event) -> Result<(), TestCaseError> {
        let before = self.capsule.state();
        let wound = matches!(self.capsule.drive(), Drive::Millivolts(1..));
        let actions = self.capsule.step(self.now_us, event);
        let state = self.capsule.state();
        self.reached[state as usize] = true;
        if before != CapsuleState::Referencing && state == CapsuleState::Referencing {
            self.seek_from = self.sample.counts;
        }
        prop_assert_eq!(actions.drive, self.capsule.drive());
        if wound && !matches!(actions.drive, Drive::Millivolts(1..)) {
            self.top = self.sample.counts;
        }
        let Drive::Millivolts(millivolts) = actions.drive else {
            return Ok(());
        };
        prop_assert!(self.capsule.is_moving(), "drives in {:?}", state);
        prop_assert!(millivolts.unsigned_abs() <= FAST_MV.min(self.sample.battery_mv));
        let thread = self.capsule.thread();
        if self.capsule.referenced() && millivolts > 0 {
            prop_assert!(thread < SOFT_MAXIMUM, "winds at {:?}", thread);
        }
        if self.capsule.referenced() && millivolts < 0 {
            prop_assert!(thread > Thread(0), "pays out at {:?}", thread);
        }
        if !self.capsule.referenced() {
            prop_assert_eq!(state, CapsuleState::Referencing);
            let way = self.sample.counts.since(self.seek_from).thread();
            prop_assert!(millivolts < 0 || way < SEEK_LIMIT, "seeks at {:?}", way);
            let out = self.top.since(self.sample.counts).thread();
            prop_assert!(millivolts > 0 || out < BACK_OFF, "backs off by {:?}", out);
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
                (self.sample.current_ma, self.sample.battery_mv) = (current_ma, battery_mv);
                for _ in 0..ms {
                    let step = match self.capsule.drive() {
                        Drive::Millivolts(millivolts) if millivolts > 0 => counts_per_ms,
                        Drive::Millivolts(_) => -counts_per_ms,
                        Drive::Brake | Drive::Off => 0,
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

fn judge(fault: Option<CapsuleFault>, start: i32) -> Judge {
    let sample = Sample {
        counts: Counts(start),
        current_ma: 0,
        battery_mv: 3_900,
        driver_fault: false,
    };
    Judge {
        capsule: Capsule::new(fault),
        now_us: 0,
        sample,
        seek_from: Counts(start),
        top: Counts(start),
        reached: [false; 8],
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
        inputs in prop::collection::vec(input(), 1..60),
    ) {
        let mut judge = judge(panicked.then_some(CapsuleFault::Panic), start);
        judge.give(Event::Sample(judge.sample))?;
        for input in inputs {
            judge.take(input)?;
        }
    }
}

/// The property above would be empty if the sequences never got anywhere.
#[test]
fn the_judge_sees_every_state() {
    let mut judge = judge(None, 0);
    let turn = |ms, current_ma| Input::Turn {
        ms,
        counts_per_ms: 20,
        current_ma,
        battery_mv: 3_900,
    };
    let script = [
        turn(1, 0),
        Input::Command(Command::Reference),
        turn(800, 20),
        turn(100, 100),
        turn(10, 170),
        turn(950, 20),
        Input::Command(Command::Fold),
        turn(800, 20),
        turn(80, 100),
        turn(40, 170),
        Input::Command(Command::Unfold),
        turn(300, 20),
        Input::Command(Command::Stop),
        Input::Command(Command::EStop),
    ];
    for input in script {
        judge.take(input).expect("the limits hold");
    }
    assert_eq!(judge.reached, [true; 8]);
}
