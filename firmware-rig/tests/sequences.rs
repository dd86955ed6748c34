//! Random sequences of commands and events: checks what must never happen, in any order.

use std::ops::Range;

use firmware_rig::{
    machine::{Action, Command, Event, Machine, PathEnd, PathReport},
    settings::Settings,
};
use motion::{
    axis::Direction,
    run::RunPlan,
    units::{StepPosition, Steps, Window},
};
use protocol::{
    rig::{LinkLossPolicy, RigEvent, RigFault, RigInputs, RigState, RunOutcome},
    settings::SettingKey,
};
use simulated_machines::carriage::{
    CLOSED, Rig, SMALL, flag_edge, now, path_ended, plan, settings, small, stroke_done,
};
use simulated_machines::dice::Dice;

fn link_loss(dice: &mut Dice) -> LinkLossPolicy {
    dice.pick(&[LinkLossPolicy::Stop, LinkLossPolicy::Finish])
}

fn jog(dice: &mut Dice, settings: &Settings) -> Command {
    Command::Jog {
        direction: dice.pick(&[Direction::Away, Direction::Home]),
        speed: settings.speed(dice.pick(&[5_000, 40_000])).unwrap(),
    }
}

fn move_to(dice: &mut Dice, settings: &Settings) -> Command {
    let to = Steps(dice.below(81) as u32);
    Command::MoveTo {
        target: settings.axis.position(to).unwrap(),
        speed: settings.speed(40_000).unwrap(),
    }
}

/// End of a series of seeds: `usual`, or a million where RETROGRADE_CAMPAIGN is set, or the number that it gives.
fn end_of_series(usual: u64) -> u64 {
    match std::env::var("RETROGRADE_CAMPAIGN") {
        Ok(campaign) => campaign.parse().unwrap_or(1_000_000),
        Err(_) => usual,
    }
}

/// Anything in any order, but mostly sensible inputs, so that every state is reached.
mod anything {
    use super::*;

    enum Input {
        /// At this time, us.
        Event(u64, Event<'static>),
        /// At this position.
        Command(Command, i32),
        /// Moves the flag to this distance from 0, um.
        Flag(u32),
    }

    /// At no special time.
    fn event(event: Event<'static>) -> Input {
        Input::Event(1, event)
    }

    fn position(dice: &mut Dice) -> i32 {
        match dice.below(4) {
            0 => dice.below(400) as i32 - 200,
            1 => dice.below(400_000) as i32 - 200_000,
            _ => 0,
        }
    }

    /// The next input when nothing goes wrong. At rest the counter stays at `rest`.
    fn expected(dice: &mut Dice, plan: RunPlan, state: RigState, rest: i32) -> Input {
        let at = if dice.one_in(4) { 20 } else { 0 };
        let flag = event(flag_edge(dice.one_in(2), 4));
        let done = event(stroke_done(dice.below(4) as u32, 0, 0));
        let ended = |end| event(path_ended(end, at, at));
        match state {
            RigState::Unhomed if dice.one_in(4) => Input::Command(Command::Button(None), 0),
            RigState::Unhomed => Input::Command(Command::Home, 0),
            RigState::Homing if dice.one_in(3) => ended(PathEnd::Stopped),
            RigState::Homing => flag,
            RigState::Ready if dice.one_in(3) => Input::Command(jog(dice, &small()), rest),
            RigState::Ready if dice.one_in(3) => Input::Command(move_to(dice, &small()), rest),
            RigState::Ready => {
                let link_loss = link_loss(dice);
                Input::Command(Command::Run { plan, link_loss }, rest)
            }
            RigState::Running => match dice.below(6) {
                0 | 1 => flag,
                2 => done,
                3 | 4 => Input::Command(Command::Hold, 0),
                _ => ended(PathEnd::Complete),
            },
            RigState::Held => {
                let command = dice.pick(&[Command::Resume, Command::Button(None)]);
                Input::Command(command, at)
            }
            RigState::Moving if dice.one_in(2) => Input::Command(jog(dice, &small()), at),
            RigState::Moving => ended(PathEnd::Complete),
            RigState::Stopping => ended(PathEnd::Stopped),
            RigState::Faulted if dice.one_in(2) => ended(PathEnd::Cut),
            RigState::Faulted => Input::Command(Command::Acknowledge, 0),
        }
    }

    fn input(dice: &mut Dice, plan: RunPlan, state: RigState, rest: i32) -> Input {
        if !dice.one_in(3) {
            return expected(dice, plan, state, rest);
        }
        let position_now = position(dice);
        let other = if dice.one_in(8) {
            position(dice)
        } else {
            position_now
        };
        let report = PathReport {
            commanded: StepPosition(position_now),
            counted: StepPosition(other),
            last_tick: dice.below(1 << 40),
            min_queue: (!dice.one_in(4)).then_some(dice.bits() as u16),
            ..PathReport::default()
        };
        match dice.below(56) {
            40 => Input::Command(Command::Hold, position_now),
            41..44 => Input::Command(Command::Resume, position_now),
            44..46 => Input::Command(jog(dice, &small()), position_now),
            46..48 => Input::Command(move_to(dice, &small()), position_now),
            48..50 => {
                let plan = dice.pick(&[Some(plan), None]);
                Input::Command(Command::Button(plan), position_now)
            }
            50..54 => {
                let time_us = dice.pick(&[1, 300_001, 300_002, 60_000_001, 60_000_002]);
                Input::Event(time_us, Event::Tick)
            }
            54 => Input::Flag(dice.pick(&[1_000, 1_250])),
            0..6 => Input::Command(Command::Home, position_now),
            6..12 => {
                let link_loss = link_loss(dice);
                Input::Command(Command::Run { plan, link_loss }, position_now)
            }
            12 => Input::Command(Command::Stop, position_now),
            13 => Input::Command(Command::EStop, position_now),
            14..17 => Input::Command(Command::Acknowledge, position_now),
            17 => event(Event::FarLimit),
            18 => event(Event::LoopOpened),
            19 => event(Event::LinkSilent),
            20..28 => {
                let count = if dice.one_in(2) { 4 } else { other };
                event(flag_edge(dice.one_in(2), count))
            }
            28..30 => event(stroke_done(dice.below(4) as u32, position_now, other)),
            _ => {
                let end = match dice.below(24) {
                    0 => PathEnd::Cut,
                    1 => PathEnd::Underrun,
                    2 => PathEnd::Guard,
                    3..12 => PathEnd::Stopped,
                    _ => PathEnd::Complete,
                };
                event(Event::PathEnded(end, report))
            }
        }
    }

    /// A machine and its output.
    struct Watch {
        machine: Machine,
        /// A path was ordered and its end not reported.
        path: bool,
        /// Since the last fault (or the start): acknowledged, reference found.
        acknowledged: bool,
        found: bool,
        /// Where the counter was at the end of the last path, or of a homing.
        rest: i32,
    }

    impl Watch {
        fn take(&mut self, input: Input, inputs: RigInputs) {
            let (before, homed, fault) = (
                self.machine.state(),
                self.machine.homed(),
                self.machine.fault(),
            );
            let actions;
            let mut command = None;
            match input {
                Input::Event(time_us, event) => {
                    if let Event::PathEnded(_, report) = &event {
                        if self.path {
                            self.rest = report.counted.0;
                        }
                        self.path = false;
                    }
                    actions = self.machine.step(&now(time_us, 0, inputs), event);
                    assert_eq!(actions.refusal, None);
                }
                Input::Command(asked, position) => {
                    let now = now(1, position, inputs);
                    actions = self.machine.step(&now, Event::Command(&asked));
                    let found_elsewhere =
                        match before {
                            RigState::Held => matches!(asked, Command::Resume | Command::Button(_)),
                            RigState::Ready => {
                                position != self.rest
                                    && !matches!(asked, Command::Home | Command::Stop)
                            }
                            _ => false,
                        } && matches!(self.machine.fault(), Some(RigFault::ReadBack { .. }));
                    let lost_at_0 = before == RigState::Ready
                        && (position, inputs.home_flag) == (0, false)
                        && matches!(self.machine.fault(), Some(RigFault::LostSteps { .. }));
                    if actions.refusal.is_some() && !found_elsewhere && !lost_at_0 {
                        assert!(actions.list.is_empty());
                        assert_eq!(self.machine.state(), before);
                        assert_eq!(self.machine.homed(), homed);
                        assert_eq!(self.machine.fault(), fault);
                        return;
                    }
                    command = Some((asked, position));
                }
                Input::Flag(flag_um) => {
                    let may = self.machine.may_change_settings();
                    assert_eq!(
                        may.is_ok(),
                        !self.path && before != RigState::Held,
                        "{before:?}"
                    );
                    if may.is_ok() {
                        let other = flag_um != self.machine.settings().flag_um;
                        let flag = (SettingKey::FlagUm, flag_um);
                        self.machine
                            .set_settings(settings(&[&SMALL[..], &[flag]].concat()));
                        self.found &= !other;
                        assert_eq!(self.machine.homed(), homed && !other);
                        assert_eq!(self.machine.fault(), fault);
                    }
                    return;
                }
            }
            assert!(!actions.list.is_full(), "no room to spare: {actions:?}");
            let after = self.machine.state();
            if let Some(fault) = fault {
                if let Some((Command::Acknowledge, _)) = command {
                    assert_eq!(after, RigState::Unhomed);
                    self.acknowledged = true;
                } else {
                    assert_eq!(self.machine.fault(), Some(fault), "latched");
                }
            }
            for action in &actions.list {
                match action {
                    Action::Start { window, .. } => {
                        assert!(!self.path, "one path at a time");
                        assert!(!inputs.estop_loop || command.is_none());
                        self.path = true;
                        let is_homing = self.machine.state() == RigState::Homing;
                        if let (RigState::Ready, Some((_, at)), false) =
                            (before, command, is_homing)
                        {
                            assert_eq!(at, self.rest, "the counter was moved by something else");
                        }
                        self.check_start(before, command, *window);
                    }
                    Action::Emit(RigEvent::Homed { .. }) => (self.found, self.rest) = (true, 0),
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
                RigState::Homing | RigState::Running | RigState::Moving | RigState::Stopping
            );
            assert!(!moves || self.path, "{after:?} without a path");
            let rests = matches!(after, RigState::Unhomed | RigState::Ready | RigState::Held);
            assert!(!rests || !self.path, "{after:?} with a path");
            if self.machine.homed() {
                assert!(self.found && self.machine.fault().is_none());
                assert!(homed || before == RigState::Homing);
            }
        }

        fn check_start(&self, before: RigState, command: Option<(Command, i32)>, window: Window) {
            let (first, last) = (window.first.0, window.last.0);
            assert!(self.acknowledged);
            match (self.machine.state(), command) {
                (RigState::Homing, None) => {
                    assert_eq!(before, RigState::Homing, "only homing goes on by itself");
                    assert!(!self.machine.homed());
                }
                (RigState::Homing, Some((Command::Home | Command::Button(_), _))) => {
                    assert!(matches!(before, RigState::Unhomed | RigState::Ready));
                    assert!(!self.machine.homed());
                }
                (RigState::Running, Some((asked, _))) => {
                    let from = match asked {
                        Command::Run { .. } | Command::Button(Some(_)) => {
                            matches!(before, RigState::Ready | RigState::Held)
                        }
                        Command::Resume | Command::Button(None) => before == RigState::Held,
                        _ => false,
                    };
                    assert!(from, "{asked:?} in {before:?}");
                    assert!(self.found && self.machine.homed());
                    assert_eq!((first, last), (0, 80));
                }
                (RigState::Moving, Some((Command::Jog { .. } | Command::MoveTo { .. }, from))) => {
                    assert_eq!(before, RigState::Ready);
                    assert!(self.found && self.machine.homed());
                    // From where it stands to somewhere in the stroke.
                    let to = if first == from { last } else { first };
                    assert!(first == from || last == from);
                    assert!((0..=80).contains(&to));
                }
                (state, other) => panic!("{other:?} started something, {state:?}"),
            }
            // The path is finite, and no longer than a search over stroke and overtravel.
            assert!(last.abs_diff(first) <= 400_500, "{window:?}");
        }
    }

    fn check(seeds: Range<u64>) {
        let sequences = seeds.end - seeds.start;
        let settings = small();
        let plan = plan(&settings, 2, 15_000, 40_000);
        let ready = Rig::homed(settings).machine;
        let mut reached = [0_u64; 8];
        for seed in seeds {
            let mut dice = Dice(seed);
            // From the start, after a bad end, or homed already.
            let homed = !dice.one_in(4);
            let fault = dice.one_in(8).then_some(RigFault::Watchdog);
            let fault = fault.filter(|_| !homed);
            let mut watch = Watch {
                machine: if homed {
                    ready.clone()
                } else {
                    Machine::new(settings, fault, 0)
                },
                path: false,
                acknowledged: fault.is_none(),
                found: homed,
                rest: 0,
            };
            for _ in 0..40 {
                // Mostly open at 0, where motions begin.
                let is_ready = watch.machine.state() == RigState::Ready;
                let inputs = RigInputs {
                    home_flag: dice.one_in(if is_ready { 8 } else { 3 }) != is_ready,
                    far_limit: dice.one_in(16),
                    estop_loop: dice.one_in(16),
                };
                let input = input(&mut dice, plan, watch.machine.state(), watch.rest);
                watch.take(input, inputs);
                reached[watch.machine.state() as usize] += 1;
            }
        }
        for state in crate::commands::STATES {
            let fraction = reached[state as usize] as f64 / (40 * sequences) as f64;
            assert!(fraction > 0.01, "{state:?} hardly ever reached: {fraction}");
        }
    }

    #[test]
    fn holds_in_random_sequences() {
        check(0..end_of_series(200_000));
    }
}

/// Operator, host and mishaps at random, with a carriage that executes every period.
mod executed {
    use super::*;

    /// Counts of what was reached.
    #[derive(Default)]
    struct Ends {
        runs: u64,
        complete: u64,
        held: u64,
        moves: u64,
    }

    /// The rig itself checks at every pulse: no pulse outside a moving state, none outside the stroke while the
    /// position is trusted, one path at a time. Here: what takes more than one pulse to see.
    fn sequence(dice: &mut Dice, settings: Settings, ends: &mut Ends) {
        let mut rig = Rig::new(settings, dice.below(81) as i32);
        let (mut edges, mut sound) = (0, true);
        for _ in 0..30 {
            let (pulses, before, events) = (rig.pulses, rig.machine.state(), rig.events.len());
            match dice.below(32) {
                0..4 => {
                    let _ = rig.command(Command::Home);
                }
                4..9 => {
                    let stroke_um = 250 + dice.below(19_751) as u32;
                    let plan = plan(&settings, 1 + dice.below(2) as u16, stroke_um, 40_000);
                    let link_loss = link_loss(dice);
                    let command = if dice.one_in(4) {
                        Command::Button(Some(plan))
                    } else {
                        Command::Run { plan, link_loss }
                    };
                    if rig.command(command).is_ok()
                        && before == RigState::Ready
                        && rig.machine.state() == RigState::Running
                    {
                        edges = plan.edges();
                    }
                }
                9 => rig.command(Command::Stop).unwrap(),
                10 => {
                    if dice.one_in(2) {
                        rig.command(Command::EStop).unwrap();
                    } else {
                        rig.press();
                    }
                    assert!(!rig.moving());
                }
                11 => rig.pressed = false,
                12 => {
                    let _ = rig.command(Command::Acknowledge);
                }
                13 => rig.event(Event::LinkSilent),
                14 if dice.one_in(4) => {
                    rig.slipping = dice.below(30) as u32;
                }
                15 if dice.one_in(4) => {
                    rig.stuck_flag = dice.pick(&[None, Some(true), Some(false)]);
                }
                16 if dice.one_in(8) => rig.jumper_cut = !rig.jumper_cut,
                17 => rig.bounces = dice.below(3) as u32,
                // Someone moves the carriage; the motor holds it while it moves.
                18 if !rig.moving() && dice.one_in(4) => {
                    rig.place = dice.below(81) as i32;
                    sound = false;
                }
                19 | 20 => {
                    let _ = rig.command(Command::Hold);
                }
                21 | 22 => {
                    let _ = rig.command(Command::Resume);
                }
                23 => {
                    let _ = rig.command(jog(dice, &settings));
                }
                24 => {
                    let _ = rig.command(move_to(dice, &settings));
                }
                25 if !rig.moving() => rig.wait(dice.below(1_000_000_000)),
                _ => {
                    rig.pulses(dice.below(200));
                    if matches!(
                        before,
                        RigState::Unhomed | RigState::Ready | RigState::Held | RigState::Faulted
                    ) {
                        assert_eq!(rig.pulses, pulses, "{before:?}");
                    }
                }
            }
            if before == rig.machine.state() && !rig.moving() {
                assert_eq!(rig.pulses, pulses, "nothing moves at rest");
            }
            for event in &rig.events[events..] {
                match event {
                    RigEvent::RunEnded { outcome, .. } => {
                        ends.runs += 1;
                        let record = rig.machine.record();
                        if *outcome == RunOutcome::Complete {
                            ends.complete += 1;
                            ends.held += u64::from(record.holds > 0);
                            assert_eq!(record.commanded_edges, edges, "held or not");
                            assert_eq!(record.counted_edges, edges);
                            assert_eq!(rig.ring.counted, 0);
                        }
                    }
                    RigEvent::Moved { .. } => ends.moves += 1,
                    _ => {}
                }
            }
            // No mishap since homing began: the carriage is where the counter says.
            let mishap = rig.slipping > 0 || rig.jumper_cut || rig.stuck_flag.is_some();
            let begun = before != RigState::Homing && rig.machine.state() == RigState::Homing;
            sound = (sound || begun) && !mishap;
            if rig.machine.homed() && sound {
                assert_eq!(rig.place, rig.ring.counted);
                assert!((0..=80).contains(&rig.place));
            }
        }
    }

    fn check(seeds: Range<u64>) {
        let sequences = seeds.end - seeds.start;
        // Seeds are independent: run even and odd ones on a core each.
        let half = |odd: u64| {
            let mut ends = Ends::default();
            for seed in (seeds.start + odd..seeds.end).step_by(2) {
                sequence(&mut Dice(seed), small(), &mut ends);
            }
            ends
        };
        let (even, odd) = std::thread::scope(|scope| {
            let odd = scope.spawn(|| half(1));
            (half(0), odd.join().expect("no sequence of odd seed failed"))
        });
        let runs = even.runs + odd.runs;
        let complete = even.complete + odd.complete;
        let held = even.held + odd.held;
        let moves = even.moves + odd.moves;
        assert!(runs * 20 > sequences, "too few runs: {runs}");
        assert!(complete * 50 > sequences, "too few complete: {complete}");
        assert!(held * 500 > sequences, "too few held and complete: {held}");
        assert!(moves * 50 > sequences, "too few moves: {moves}");
    }

    #[test]
    fn holds_in_random_sequences() {
        check(0..end_of_series(30_000));
    }
}

/// The window of a run is the configured stroke, whatever its length.
#[test]
fn the_window_of_a_run_is_the_stroke() {
    for stroke_um in [4_250, 20_000, 130_000] {
        let settings = settings(&[
            (SettingKey::LeadUm, 50_000),
            (SettingKey::Microsteps, 1),
            (SettingKey::StrokeUm, stroke_um),
        ]);
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
