//! Random sequences of commands and events: what must never happen, whatever comes in.

mod carriage;

use carriage::{CLOSED, Rig, plan};
use firmware_rig::{
    machine::{Action, Actions, Command, Event, Machine, PathEnd, PathReport},
    settings::Settings,
};
use motion::{
    axis::{Axis, Direction},
    run::RunPlan,
};
use protocol::rig::{LinkLossPolicy, RigEvent, RigFault, RigInputs, RigState};

/// A rig with few steps, 4 per mm: 80 in its stroke of 20 mm, the flag at the fourth.
fn small() -> Settings {
    Settings {
        axis: Axis::new(50_000, 200, 1, 20_000).unwrap(),
        ledger_limit_steps: 1,
        ..Settings::REFERENCE
    }
}

/// SplitMix64 (Steele, Lea, Flood 2014).
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: u64) -> u64 {
        self.next() % n
    }

    fn one_in(&mut self, n: u64) -> bool {
        self.below(n) == 0
    }

    fn pick<T: Copy>(&mut self, items: &[T]) -> T {
        items[self.below(items.len() as u64) as usize]
    }
}

fn link_loss(random: &mut Random) -> LinkLossPolicy {
    random.pick(&[LinkLossPolicy::Stop, LinkLossPolicy::Finish])
}

/// Anything at all, in any order; mostly what makes sense, so that every state is reached.
mod anything {
    use super::*;

    enum Input {
        Event(Event),
        Command(Command, i32),
    }

    fn position(random: &mut Random) -> i32 {
        match random.below(4) {
            0 => random.below(400) as i32 - 200,
            1 => random.below(400_000) as i32 - 200_000,
            _ => 0,
        }
    }

    /// What a rig without mishaps would bring next.
    fn expected(random: &mut Random, plan: RunPlan, state: RigState) -> Input {
        let report = PathReport::default();
        let flag = Input::Event(Event::FlagEdge {
            opening: random.one_in(2),
            count: 4,
        });
        let done = Input::Event(Event::StrokeDone {
            stroke: random.below(4) as u32,
            commanded: 0,
            counted: 0,
        });
        let ended = |end| Input::Event(Event::PathEnded(end, report));
        match state {
            RigState::Unhomed => Input::Command(Command::Home, 0),
            RigState::Homing if random.one_in(3) => ended(PathEnd::Stopped),
            RigState::Homing => flag,
            RigState::Ready => {
                let link_loss = link_loss(random);
                Input::Command(Command::Run { plan, link_loss }, 0)
            }
            RigState::Running => match random.below(3) {
                0 => flag,
                1 => done,
                _ => ended(PathEnd::Complete),
            },
            RigState::Held | RigState::Stopping => ended(PathEnd::Stopped),
            RigState::Faulted if random.one_in(2) => ended(PathEnd::Cut),
            RigState::Faulted => Input::Command(Command::Acknowledge, 0),
        }
    }

    fn input(random: &mut Random, plan: RunPlan, state: RigState) -> Input {
        if !random.one_in(3) {
            return expected(random, plan, state);
        }
        let position_now = position(random);
        let other = if random.one_in(8) {
            position(random)
        } else {
            position_now
        };
        let report = PathReport {
            commanded: position_now,
            counted: other,
            last_tick: random.next(),
            min_queue: random.next() as u16,
        };
        match random.below(40) {
            0..6 => Input::Command(Command::Home, position_now),
            6..12 => {
                let link_loss = link_loss(random);
                Input::Command(Command::Run { plan, link_loss }, position_now)
            }
            12 => Input::Command(Command::Stop, position_now),
            13 => Input::Command(Command::EStop, position_now),
            14..17 => Input::Command(Command::Acknowledge, position_now),
            17 => Input::Event(Event::FarLimit),
            18 => Input::Event(Event::LoopOpened),
            19 => Input::Event(Event::LinkSilent),
            20..28 => Input::Event(Event::FlagEdge {
                opening: random.one_in(2),
                count: if random.one_in(2) { 4 } else { other },
            }),
            28..30 => Input::Event(Event::StrokeDone {
                stroke: random.below(4) as u32,
                commanded: position_now,
                counted: other,
            }),
            _ => {
                let end = match random.below(24) {
                    0 => PathEnd::Cut,
                    1 => PathEnd::Underrun,
                    2 => PathEnd::Guard,
                    3..12 => PathEnd::Stopped,
                    _ => PathEnd::Complete,
                };
                Input::Event(Event::PathEnded(end, report))
            }
        }
    }

    /// What the machine said, watched from outside.
    struct Watch {
        machine: Machine,
        /// A path was ordered and its end not reported.
        path: bool,
        /// Since the last fault (or the start): acknowledged, reference found.
        acknowledged: bool,
        found: bool,
    }

    impl Watch {
        fn take(&mut self, input: Input, inputs: RigInputs) {
            let (before, homed, fault) = (
                self.machine.state(),
                self.machine.homed(),
                self.machine.fault(),
            );
            let mut actions = Actions::new();
            let mut command = None;
            match input {
                Input::Event(event) => {
                    if let Event::PathEnded(..) = event {
                        self.path = false;
                    }
                    actions = self.machine.event(event, inputs);
                }
                Input::Command(asked, position) => {
                    let result = self
                        .machine
                        .command(1, asked, position, inputs, &mut actions);
                    if result.is_err() {
                        assert!(actions.is_empty());
                        assert_eq!(self.machine.state(), before);
                        assert_eq!(self.machine.homed(), homed);
                        assert_eq!(self.machine.fault(), fault);
                        return;
                    }
                    command = Some(asked);
                }
            }
            assert!(!actions.is_full(), "no room to spare: {actions:?}");
            let after = self.machine.state();
            if let Some(fault) = fault {
                if command == Some(Command::Acknowledge) {
                    assert_eq!(after, RigState::Unhomed);
                    self.acknowledged = true;
                } else {
                    assert_eq!(self.machine.fault(), Some(fault), "latched");
                }
            }
            for action in &actions {
                match action {
                    Action::Start { window, .. } => {
                        assert!(!self.path, "one path at a time");
                        assert!(!inputs.estop_loop || command.is_none());
                        self.path = true;
                        self.check_start(before, command, *window);
                    }
                    Action::Emit(RigEvent::Homed { .. }) => self.found = true,
                    Action::Emit(RigEvent::Faulted(fault)) => {
                        assert_eq!(self.machine.fault(), Some(*fault));
                        (self.acknowledged, self.found) = (false, false);
                    }
                    Action::SetPosition(_) => {
                        assert!(!self.path && before == RigState::Homing);
                    }
                    Action::StopPath => assert!(self.path),
                    Action::Cut => assert_eq!(after, RigState::Faulted),
                    Action::Emit(_) => {}
                }
            }
            let moves = matches!(
                after,
                RigState::Homing | RigState::Running | RigState::Stopping
            );
            assert!(!moves || self.path, "{after:?} without a path");
            if self.machine.homed() {
                assert!(self.found && self.machine.fault().is_none());
                assert!(homed || before == RigState::Homing);
            }
        }

        fn check_start(&self, before: RigState, command: Option<Command>, window: (i32, i32)) {
            assert!(self.acknowledged);
            match command {
                Some(Command::Home) => {
                    assert!(matches!(before, RigState::Unhomed | RigState::Ready));
                    assert!(!self.machine.homed());
                }
                Some(Command::Run { .. }) => {
                    assert_eq!(before, RigState::Ready);
                    assert!(self.found && self.machine.homed());
                    assert_eq!(window, (0, 80));
                }
                Some(other) => panic!("{other:?} started something"),
                None => {
                    assert_eq!(before, RigState::Homing, "only homing goes on by itself");
                    assert!(!self.machine.homed());
                }
            }
            // Finite, and no longer than a search over stroke and overtravel.
            assert!(window.1.abs_diff(window.0) <= 400_500, "{window:?}");
        }
    }

    fn check(sequences: u64) {
        let settings = small();
        let plan = plan(&settings, 2, 15_000, 40_000);
        let mut reached = [0_u64; 7];
        for seed in 0..sequences {
            let mut random = Random(seed);
            let fault = random.one_in(8).then_some(RigFault::Watchdog);
            let mut watch = Watch {
                machine: Machine::new(settings, fault),
                path: false,
                acknowledged: fault.is_none(),
                found: false,
            };
            for _ in 0..40 {
                let inputs = RigInputs {
                    home_flag: random.one_in(3),
                    far_limit: random.one_in(16),
                    estop_loop: random.one_in(16),
                };
                let input = input(&mut random, plan, watch.machine.state());
                watch.take(input, inputs);
                reached[watch.machine.state() as usize] += 1;
            }
        }
        for state in [
            RigState::Unhomed,
            RigState::Homing,
            RigState::Ready,
            RigState::Running,
            RigState::Stopping,
            RigState::Faulted,
        ] {
            let share = reached[state as usize] as f64 / (40 * sequences) as f64;
            assert!(share > 0.01, "{state:?} hardly ever reached: {share}");
        }
    }

    #[test]
    fn holds_in_100_000_sequences() {
        check(100_000);
    }

    /// `cargo test --release -p firmware-rig --test sequences -- --ignored`
    #[test]
    #[ignore = "for a release build"]
    fn holds_in_1_000_000_sequences() {
        check(1_000_000);
    }
}

/// Operator, host and mishaps at random around a carriage that really executes every period.
mod executed {
    use super::*;

    /// What the carriage itself checks at every pulse: no pulse outside a moving state, none outside the stroke
    /// while the position is trusted, one path at a time. Here: what needs more than one look.
    fn sequence(random: &mut Random, settings: Settings) -> Option<RigState> {
        let mut rig = Rig::new(settings, random.below(81) as i32);
        let mut complete = None;
        for _ in 0..24 {
            let (pulses, fault) = (rig.pulses, rig.fault());
            match random.below(24) {
                0..5 => {
                    let _ = rig.command(Command::Home);
                }
                5..10 => {
                    let stroke_um = 250 + random.below(19_751) as u32;
                    let plan = plan(&settings, 1 + random.below(2) as u16, stroke_um, 40_000);
                    let link_loss = link_loss(random);
                    let _ = rig.command(Command::Run { plan, link_loss });
                }
                10 => rig.command(Command::Stop).unwrap(),
                11 => {
                    if random.one_in(2) {
                        rig.command(Command::EStop).unwrap();
                    } else {
                        rig.press();
                    }
                    assert!(!rig.moving());
                }
                12 => rig.pressed = false,
                13 => {
                    let _ = rig.command(Command::Acknowledge);
                }
                14 => rig.event(Event::LinkSilent),
                15 if random.one_in(4) => rig.slipping = random.below(30) as u32,
                16 if random.one_in(4) => {
                    rig.stuck_flag = random.pick(&[None, Some(true), Some(false)]);
                }
                17 if random.one_in(8) => rig.jumper_cut = !rig.jumper_cut,
                18 => rig.bounces = random.below(3) as u32,
                // By hand, where hands can move it.
                19 if !rig.moving() && random.one_in(4) => rig.place = random.below(81) as i32,
                _ => {
                    rig.pulses(random.below(200));
                    if fault.is_some() {
                        assert_eq!(rig.pulses, pulses, "faulted");
                    }
                    continue;
                }
            }
            assert_eq!(
                rig.pulses, pulses,
                "nothing moves before the generator does"
            );
            if let Some(RigEvent::RunEnded { .. }) = rig.events.last() {
                complete = Some(rig.machine.state());
            }
        }
        complete
    }

    fn check(sequences: u64) {
        let settings = small();
        let ends = (0..sequences)
            .filter_map(|seed| sequence(&mut Random(seed), settings))
            .count() as u64;
        assert!(ends * 50 > sequences, "too few runs: {ends}");
    }

    #[test]
    fn holds_in_3_000_sequences() {
        check(3_000);
    }

    /// `cargo test --release -p firmware-rig --test sequences -- --ignored`
    #[test]
    #[ignore = "for a release build"]
    fn holds_in_1_000_000_sequences() {
        check(1_000_000);
    }
}

/// The two limits between which a run's steps stay are those of the configured axis, whatever its size.
#[test]
fn the_window_of_a_run_is_the_stroke() {
    for stroke_um in [4_250, 20_000, 130_000] {
        let settings = Settings {
            axis: Axis::new(50_000, 200, 1, stroke_um).unwrap(),
            ..Settings::REFERENCE
        };
        let mut rig = Rig::homed(settings);
        let plan = plan(&settings, 1, stroke_um, 40_000);
        assert_eq!(plan.direction(0), Some(Direction::Away));
        let link_loss = LinkLossPolicy::Stop;
        rig.command(Command::Run { plan, link_loss }).unwrap();
        assert_eq!(rig.windows, [(0, stroke_um as i32 / 250)]);
        rig.finish();
        assert_eq!((rig.place, rig.inputs().estop_loop), (0, false));
        assert_ne!(rig.inputs(), CLOSED);
    }
}
