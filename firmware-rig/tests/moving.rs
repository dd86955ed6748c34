//! Jog, move, start button, time-outs, and changes of settings while the rig is in use.

use device::settings::Values;
use firmware_rig::{
    commands::press_button,
    machine::{Command, Event},
    settings::Settings,
};
use motion::{
    axis::Direction,
    run::{RunPlan, RunRequest, Timing},
    units::{Micrometres, Steps},
};
use protocol::system::DeviceKind;
use protocol::{
    error::Refusal,
    rig::{HomingPhase, LinkLossPolicy, RigEvent, RigFault, RigState, RunOutcome},
    settings::SettingKey,
};
use simulated_machines::carriage::{Rig, run, settings, values};

const SETTINGS: Settings = Settings::REFERENCE;

fn jog(direction: Direction, um_s: u32) -> Command {
    let speed = SETTINGS.speed(um_s).unwrap();
    Command::Jog { direction, speed }
}

fn move_to(steps: u32, um_s: u32) -> Command {
    Command::MoveTo {
        target: SETTINGS.axis.position(Steps(steps)).unwrap(),
        speed: SETTINGS.speed(um_s).unwrap(),
    }
}

/// At rest somewhere in the stroke.
fn rig_at(steps: u32) -> Rig {
    let mut rig = Rig::homed(SETTINGS);
    if steps > 0 {
        rig.command(move_to(steps, 40_000)).unwrap();
        rig.finish();
    }
    assert_eq!((rig.place, rig.ring.counted), (steps as i32, steps as i32));
    rig.events.clear();
    rig.windows.clear();
    rig
}

/// Device time, 10 ns each.
const MS: u64 = 100_000;

/// Executes for this long.
fn run_for(rig: &mut Rig, ticks: u64) {
    let until = rig.now + ticks;
    while rig.now < until && rig.moving() {
        rig.step();
    }
}

mod jogging {
    use super::*;

    /// A jog renewed every 250 ms goes on; 300 ms after the last renewal it brakes.
    #[test]
    fn goes_on_while_it_is_renewed() {
        let mut rig = rig_at(40_000);
        for _ in 0..8 {
            rig.command(jog(Direction::Away, 10_000)).unwrap();
            run_for(&mut rig, 250 * MS);
            assert_eq!(rig.machine.state(), RigState::Moving);
        }
        assert_eq!(rig.windows, [(40_000, 104_000)], "one path");
        let (last, place) = (rig.now - 250 * MS, rig.place);
        rig.finish();
        assert_eq!(rig.machine.state(), RigState::Ready);
        let position_steps = rig.ring.counted;
        assert_eq!(rig.events, [RigEvent::Stopped { position_steps }]);
        // Noticed within control's 10 ms; 10 mm/s and 1,000 mm/s2 take 10 ms and 40 steps to rest.
        let end = rig.last_pulse - last;
        assert!((300 * MS..=321 * MS).contains(&end), "{end}");
        let way = rig.place - place;
        assert!((400 + 40..=400 + 80 + 41).contains(&way), "{way}");
    }

    #[test]
    fn ends_at_the_ends_of_the_stroke() {
        for (from, direction, end) in [
            (103_000, Direction::Away, 104_000),
            (1_000, Direction::Home, 0),
        ] {
            let mut rig = rig_at(from);
            while rig.place != end {
                rig.command(jog(direction, 49_000)).unwrap();
                run_for(&mut rig, 50 * MS);
            }
            rig.finish();
            assert_eq!((rig.place, rig.fault()), (end, None));
            let position_steps = end;
            assert_eq!(rig.events, [RigEvent::Moved { position_steps }]);
            assert_eq!(
                rig.command(jog(direction, 1_000)),
                Err(Refusal::AlreadyThere)
            );
        }
    }

    /// A renewal that was under way when the jog was stopped does not restart it. Only one after the jog's own
    /// deadline does.
    #[test]
    fn a_stopped_jog_is_not_started_again_by_its_renewal() {
        for (stop, until_ms) in [(Command::Stop, 300), (Command::Button(None), 800)] {
            let mut rig = rig_at(40_000);
            rig.command(jog(Direction::Away, 10_000)).unwrap();
            run_for(&mut rig, 100 * MS);
            let renewed = rig.now;
            rig.command(jog(Direction::Away, 10_000)).unwrap();
            rig.command(stop).unwrap();
            rig.finish();
            assert_eq!(rig.machine.state(), RigState::Ready);
            let (place, busy) = (rig.place, Err(Refusal::RigBusy(RigState::Stopping)));
            assert!(rig.now < renewed + 299 * MS);
            for direction in [Direction::Away, Direction::Home] {
                assert_eq!(rig.command(jog(direction, 10_000)), busy);
            }
            rig.now = renewed + (until_ms - 1) * MS;
            assert_eq!(rig.command(jog(Direction::Away, 10_000)), busy);
            assert_eq!(rig.place, place);
            rig.now = renewed + until_ms * MS;
            rig.command(jog(Direction::Away, 10_000)).unwrap();
            run_for(&mut rig, 100 * MS);
            assert!(rig.place > place);
        }
    }

    /// The line was cut for a moment, and then the host repeats its renewal, though nobody may hold the button any more.
    #[test]
    fn a_jog_that_its_dead_man_has_ended_is_not_started_again_by_a_repetition() {
        let mut rig = rig_at(40_000);
        rig.command(jog(Direction::Away, 10_000)).unwrap();
        let renewed = rig.now;
        rig.finish();
        let place = rig.place;
        assert!(rig.now < renewed + 400 * MS);
        // The last of eight repetitions.
        rig.now = renewed + 1_000 * MS;
        let busy = Err(Refusal::RigBusy(RigState::Stopping));
        assert_eq!(rig.command(jog(Direction::Away, 10_000)), busy);
        assert_eq!((rig.place, rig.machine.state()), (place, RigState::Ready));
        rig.now = renewed + 1_150 * MS;
        rig.command(jog(Direction::Away, 10_000)).unwrap();
    }

    /// A change of direction or speed needs a rest first: release, then jog again.
    #[test]
    fn another_jog_is_refused_while_it_moves() {
        let mut rig = rig_at(40_000);
        rig.command(jog(Direction::Away, 10_000)).unwrap();
        run_for(&mut rig, 100 * MS);
        let busy = Err(Refusal::RigBusy(RigState::Moving));
        for other in [
            jog(Direction::Home, 10_000),
            jog(Direction::Away, 10_001),
            move_to(0, 10_000),
            Command::Home,
        ] {
            assert_eq!(rig.command(other), busy);
        }
        // Refused jogs do not renew it.
        run_for(&mut rig, 190 * MS);
        assert_eq!(rig.command(jog(Direction::Home, 10_000)), busy);
        rig.finish();
        assert!(rig.place < 40_000 + 10 * 800 * 330 / 1_000);
        rig.now += 800 * MS;
        rig.command(jog(Direction::Home, 10_000)).unwrap();
        run_for(&mut rig, 100 * MS);
        assert_eq!(rig.machine.state(), RigState::Moving);
    }
}

mod moves {
    use super::*;

    #[test]
    fn reach_their_target_exactly() {
        let mut rig = rig_at(0);
        let mut from = 0_i32;
        for to in [1, 0, 104_000, 2, 800, 799, 50_000, 0] {
            for speed in [500, 49_000] {
                if rig.ring.counted == to {
                    continue;
                }
                if from.abs_diff(to) > 10_000 && speed == 500 {
                    continue; // minutes
                }
                rig.command(move_to(to as u32, speed)).unwrap();
                assert_eq!(rig.machine.state(), RigState::Moving);
                rig.finish();
                assert_eq!((rig.place, rig.ring.counted), (to, to));
                let position_steps = to;
                assert_eq!(rig.events.pop(), Some(RigEvent::Moved { position_steps }));
                assert_eq!(rig.windows.pop(), Some((from.min(to), from.max(to))));
                from = to;
            }
        }
        assert_eq!((rig.machine.state(), rig.fault()), (RigState::Ready, None));
        // A run starts from there as usual.
        rig.command(run(&SETTINGS, 1, 1_000, LinkLossPolicy::Stop))
            .unwrap();
    }

    /// A silent host stops a move, whatever the last run's policy was.
    #[test]
    fn stop_when_the_host_falls_silent_or_says_so() {
        for stop in [
            (|rig| rig.event(Event::LinkSilent)) as fn(&mut Rig),
            |rig| rig.command(Command::Stop).unwrap(),
            |rig| rig.command(Command::Button(None)).unwrap(),
        ] {
            for command in [move_to(50_000, 10_000), jog(Direction::Away, 10_000)] {
                let mut rig = rig_at(0);
                rig.command(command).unwrap();
                rig.pulses(1_000);
                let queued = 1 + rig.queued() as i32;
                stop(&mut rig);
                assert_eq!(rig.machine.state(), RigState::Stopping);
                rig.finish();
                assert_eq!(rig.machine.state(), RigState::Ready);
                assert!(rig.machine.homed());
                assert_eq!(rig.place, 1_000 + queued + 40, "and what was queued");
                let position_steps = rig.ring.counted;
                assert_eq!(rig.events, [RigEvent::Stopped { position_steps }]);
                // No run, no record.
                assert_eq!(rig.machine.record().outcome, RunOutcome::None);
            }
        }
    }

    #[test]
    fn end_in_a_fault_without_the_jumper() {
        let mut rig = rig_at(1_000);
        rig.jumper_cut = true;
        rig.command(move_to(3_000, 10_000)).unwrap();
        rig.finish();
        // The missing edge of the first step brakes it.
        let (commanded, counted) = (rig.place, 1_000);
        assert!((1_001..1_010).contains(&commanded), "{commanded}");
        let fault = RigFault::ReadBack { commanded, counted };
        assert_eq!(rig.fault(), Some(fault));
    }

    /// Regression: noise on the read-back at rest moved the counter, and each motion after it went as much too far.
    #[test]
    fn begin_only_where_the_last_one_ended() {
        let commands = [move_to(3_000, 10_000), jog(Direction::Away, 1_000)];
        for (at, off) in [(1_000, 1), (1_000, -1), (0, -9)] {
            for command in
                commands
                    .into_iter()
                    .chain([run(&SETTINGS, 1, 1_000, LinkLossPolicy::Stop)])
            {
                let mut rig = rig_at(at);
                rig.ring.counted += off;
                let (commanded, counted) = (at as i32, at as i32 + off);
                let fault = RigFault::ReadBack { commanded, counted };
                assert_eq!(rig.command(command), Err(Refusal::RigFaulted(fault)));
                assert_eq!(rig.fault(), Some(fault));
                assert!(!rig.machine.homed() && !rig.moving());
            }
            // Homing finds the place again, and says by how much the count was off.
            let mut rig = rig_at(at);
            rig.ring.counted += off;
            rig.command(Command::Home).unwrap();
            rig.finish();
            assert_eq!((rig.place, rig.ring.counted, rig.fault()), (0, 0, None));
        }
    }

    /// With an open far limit, the only way is home.
    #[test]
    fn away_are_refused_with_an_open_far_limit() {
        let mut rig = rig_at(5_000);
        rig.far_wire_cut = true;
        let limit = Err(Refusal::FarLimitOpen);
        assert_eq!(rig.command(move_to(5_001, 1_000)), limit);
        assert_eq!(rig.command(jog(Direction::Away, 1_000)), limit);
        assert_eq!(rig.fault(), None);
        rig.command(move_to(4_999, 1_000)).unwrap();
        rig.finish();
        assert_eq!((rig.place, rig.fault()), (4_999, None));
    }
}

mod homing {
    use super::*;

    #[test]
    fn that_takes_too_long_is_a_fault() {
        let settings = settings(&[(SettingKey::HomingTimeoutS, 5)]);
        // 100 mm at 20 mm/s take longer, 90 mm with all phases do not.
        let mut rig = Rig::new(settings, 80_800);
        rig.command(Command::Home).unwrap();
        rig.finish();
        let fault = RigFault::HomingTimeout(HomingPhase::Seek);
        assert_eq!((rig.fault(), rig.machine.homed()), (Some(fault), false));
        assert!((5_000 * MS..=5_010 * MS).contains(&rig.now));
        let mut rig = Rig::new(settings, 20_000);
        rig.command(Command::Home).unwrap();
        rig.finish();
        assert_eq!((rig.fault(), rig.place), (None, 0));
        // The time-out restarts with each homing.
        rig.wait(100_000 * MS);
        rig.command(Command::Home).unwrap();
        rig.finish();
        assert_eq!((rig.fault(), rig.place), (None, 0));
    }

    /// The cable is pulled while the carriage looks for the flag: both switches open at once.
    #[test]
    fn with_both_switches_open_is_a_fault() {
        for phase in 1..=5 {
            let mut rig = Rig::new(SETTINGS, 0);
            rig.command(Command::Home).unwrap();
            while rig.windows.len() < phase {
                rig.step();
            }
            rig.pulses(3);
            (rig.stuck_flag, rig.far_wire_cut) = (Some(true), true);
            rig.finish();
            // The second pass does not take the cable's edge for the flag's.
            assert_eq!(rig.fault(), Some(RigFault::BothSwitchesOpen), "{phase}");
            assert!(!rig.machine.homed());
            for command in [Command::Home, Command::Button(None)] {
                assert!(rig.command(command).is_err());
            }
            let present = Err(Refusal::CauseStillPresent);
            assert_eq!(rig.command(Command::Acknowledge), present);
            assert!(!rig.moving());
        }
    }
}

/// At 0 the flag is open. A flag that is closed there says that the carriage is elsewhere.
mod a_closed_flag_at_0 {
    use super::*;

    const LOST: RigFault = RigFault::LostSteps {
        residual_steps: -800,
    };

    /// At "0", 30 mm away from it: that much was lost on the way back.
    fn lost() -> Rig {
        let mut rig = rig_at(48_000);
        rig.command(move_to(0, 20_000)).unwrap();
        rig.pulses(10_000);
        rig.slipping = 24_000;
        rig.finish();
        assert_eq!((rig.place, rig.ring.counted), (24_000, 0));
        rig
    }

    #[test]
    fn starts_nothing_but_homing() {
        let run = run(&SETTINGS, 2, 60_000, LinkLossPolicy::Stop);
        let orders = [run, move_to(8_000, 10_000), jog(Direction::Away, 10_000)];
        for order in orders {
            let mut rig = lost();
            assert_eq!(rig.command(order), Err(Refusal::RigFaulted(LOST)));
            assert_eq!((rig.fault(), rig.moving()), (Some(LOST), false));
            assert!(!rig.machine.homed());
            rig.command(Command::Acknowledge).unwrap();
            rig.command(Command::Home).unwrap();
            rig.finish();
            assert_eq!((rig.place, rig.ring.counted), (0, 0));
            rig.command(order).unwrap();
        }
        // The button, too.
        let mut rig = lost();
        let now = rig.observe();
        let actions = press_button(&mut rig.machine, &Values::DEFAULT, &now);
        assert_eq!(actions.refusal, Some(Refusal::RigFaulted(LOST)));
        assert_eq!(rig.fault(), Some(LOST));
    }

    /// Where the step-loss check tolerates position 0, the flag may be open or closed there.
    #[test]
    fn says_nothing_where_the_flag_lies_within_the_tolerance() {
        for (limit, starts) in [(4, true), (3, false)] {
            // 4 steps per mm, the flag at 1 mm.
            let settings = settings(&[
                (SettingKey::LeadUm, 50_000),
                (SettingKey::Microsteps, 1),
                (SettingKey::MaxResidualSteps, limit),
            ]);
            let mut rig = Rig::homed(settings);
            rig.stuck_flag = Some(false);
            let run = run(&settings, 1, 20_000, LinkLossPolicy::Stop);
            assert_eq!(rig.command(run).is_ok(), starts, "{limit}");
        }
    }
}

/// Steps of seconds: the next one does not come any more.
mod slow_steps {
    use super::*;
    use simulated_machines::carriage::ring::Ahead;

    /// Rest comes within this time of the order: 9.2 ms of prepared steps, and control's round of 10 ms.
    const SOON: u64 = 25 * MS;

    /// 50 mm a turn and whole steps: 0.25 mm each, at 25 um/s every 10 s.
    fn coarse() -> Settings {
        settings(&[(SettingKey::LeadUm, 50_000), (SettingKey::Microsteps, 1)])
    }

    fn moving(settings: &Settings, um_s: u32) -> Rig {
        let mut rig = Rig::homed_with(*settings, Ahead::Slots);
        let target = settings.axis.position_um(Micrometres(2_000)).unwrap();
        let speed = settings.speed(um_s).unwrap();
        rig.command(Command::MoveTo { target, speed }).unwrap();
        rig.pulses(3);
        rig
    }

    #[test]
    fn a_stop_and_a_silent_host_end_a_slow_move_at_once() {
        let orders: [fn(&mut Rig); 2] = [
            |rig| rig.command(Command::Stop).unwrap(),
            |rig| rig.event(Event::LinkSilent),
        ];
        for (settings, um_s) in [(SETTINGS, 1), (SETTINGS, 10), (coarse(), 25)] {
            for order in orders {
                for wait in [0, 100 * MS] {
                    let mut rig = moving(&settings, um_s);
                    run_for(&mut rig, wait);
                    let (now, place) = (rig.now, rig.place);
                    order(&mut rig);
                    rig.finish();
                    let took = rig.now - now;
                    assert!(took <= SOON, "{took} at {um_s} um/s");
                    assert_eq!((rig.place, rig.ring.counted), (place, place));
                    assert_eq!(rig.machine.state(), RigState::Ready);
                    // The position is exact: it goes on from there, and back to 0.
                    let home = settings.axis.position(Steps(0)).unwrap();
                    let speed = settings.speed(1_000).unwrap();
                    let back = Command::MoveTo {
                        target: home,
                        speed,
                    };
                    rig.command(back).unwrap();
                    rig.finish();
                    assert_eq!((rig.fault(), rig.place, rig.ring.counted), (None, 0, 0));
                }
            }
        }
    }

    #[test]
    fn a_slow_jog_ends_with_its_dead_man() {
        for (settings, um_s) in [(SETTINGS, 1), (coarse(), 25)] {
            let mut rig = Rig::homed_with(settings, Ahead::Slots);
            let direction = Direction::Away;
            // From near the far end, because a slow jog over the whole stroke would be too slow.
            let far = settings.axis.far();
            let near = Steps(settings.axis.stroke_steps().0 - 8);
            let target = settings.axis.position(near).unwrap();
            let speed = settings.speed(40_000).unwrap();
            rig.command(Command::MoveTo { target, speed }).unwrap();
            rig.finish();
            let speed = settings.speed(um_s).unwrap();
            while rig.place < far.signed().0 - 5 {
                rig.command(Command::Jog { direction, speed }).unwrap();
                run_for(&mut rig, 200 * MS);
            }
            let (renewed, place) = (rig.now, rig.place);
            rig.command(Command::Jog { direction, speed }).unwrap();
            rig.finish();
            let took = rig.now - renewed;
            assert!(took <= 300 * MS + SOON, "{took} at {um_s} um/s");
            assert_eq!((rig.place, rig.ring.counted), (place, place));
            assert_eq!(rig.machine.state(), RigState::Ready);
        }
    }

    /// Held between two slow steps and resumed: each step once, and the record has all of them.
    #[test]
    fn a_slow_run_is_held_at_once_and_goes_on() {
        let settings = coarse();
        let request = RunRequest {
            cycles: 1,
            stroke_um: 2_000,
            timing: Timing::Speeds {
                forward_um_s: 100,
                return_um_s: 100,
                accel_um_s2: 1_000_000,
            },
            far_dwell_us: 0,
            home_dwell_us: 0,
            start_delay_us: 0,
        };
        let plan = RunPlan::solve(&settings.axis, &settings.limits, &request).unwrap();
        for pulses in 1..16 {
            let mut rig = Rig::homed_with(settings, Ahead::Slots);
            let link_loss = LinkLossPolicy::Stop;
            rig.command(Command::Run { plan, link_loss }).unwrap();
            rig.pulses(pulses);
            run_for(&mut rig, 300 * MS);
            let now = rig.now;
            rig.command(Command::Hold).unwrap();
            rig.finish();
            assert!(rig.now - now <= SOON, "{} at {pulses}", rig.now - now);
            assert_eq!((rig.pulses, rig.machine.state()), (pulses, RigState::Held));
            rig.command(Command::Resume).unwrap();
            rig.finish();
            let record = rig.machine.record();
            assert_eq!((rig.fault(), rig.place, rig.pulses), (None, 0, 16));
            assert_eq!((record.outcome, record.holds), (RunOutcome::Complete, 1));
            assert_eq!((record.commanded_edges, record.counted_edges), (16, 16));
            assert_eq!((record.edges_timed, record.strokes), (16, 2));
            assert_eq!(record.worst_interval_error_ticks, 0);
        }
    }
}

/// 130 mm in 20 s need more than 49 mm/s: the start button does not run, but it homes.
#[test]
fn a_button_runs_nothing_impossible() {
    let values = values(&[(SettingKey::ButtonTotalMs, 20_000)]);
    let mut rig = Rig::homed(SETTINGS);
    let press = |rig: &mut Rig| {
        let actions = press_button(&mut rig.machine, &values, &rig.carriage.observe());
        let refusal = actions.refusal;
        rig.perform(actions);
        refusal
    };
    assert_eq!(press(&mut rig), Some(Refusal::TooSlow));
    assert!(!rig.moving());
    rig.command(move_to(10, 1_000)).unwrap();
    rig.finish();
    assert_eq!(press(&mut rig), None);
    assert_eq!(rig.machine.state(), RigState::Homing);
}

mod settings {
    use super::*;

    /// A setting that changes the meaning of positions makes the position unknown; no other setting does.
    #[test]
    fn unhome_where_positions_change_their_meaning() {
        for key in SettingKey::of(DeviceKind::Rig) {
            let value = match key {
                SettingKey::FullSteps => 400,
                SettingKey::Microsteps => 8,
                SettingKey::TelemetryMs => 10,
                SettingKey::StepPulseNs => 1_500,
                SettingKey::MaxStepHz => 200_000,
                SettingKey::SwitchFilterUs => 20,
                _ if key.range().default == key.range().min => key.range().min + 1,
                _ => key.range().default - 1,
            };
            let settings = settings(&[(key, value)]);
            let unhomes = matches!(
                key,
                SettingKey::LeadUm
                    | SettingKey::FullSteps
                    | SettingKey::Microsteps
                    | SettingKey::StrokeUm
                    | SettingKey::FlagUm
            );
            let mut rig = Rig::homed(SETTINGS);
            rig.machine.set_settings(settings);
            assert_eq!(rig.machine.homed(), !unhomes, "{}", key.name());
            let state = if unhomes {
                RigState::Unhomed
            } else {
                RigState::Ready
            };
            assert_eq!(rig.machine.state(), state);
            assert_eq!(*rig.machine.settings(), settings);
            // A latched fault stays, whatever setting changes.
            let mut rig = Rig::homed(SETTINGS);
            rig.press();
            rig.machine.set_settings(settings);
            assert_eq!(rig.fault(), Some(RigFault::EStopLoop));
        }
    }
}
