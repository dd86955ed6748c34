//! The state machine: homing, runs, and the table of every pair of state and input.

use firmware_rig::{
    machine::{Action, Actions, Command, Event, Machine, PathEnd, PathReport},
    settings::Settings,
};
use motion::{
    axis::Direction,
    edge_timing::Timed,
    units::{StepPosition, Steps, Window},
};
use protocol::{
    error::Refusal,
    rig::{
        HomingPhase, LinkLossPolicy, RigEvent, RigFault, RigInputs, RigState, RunOutcome,
        RunRecord, Switch,
    },
    settings::SettingKey,
};
use simulated_machines::carriage::ring::Ahead;
use simulated_machines::carriage::{
    CLOSED, IMAGE_HASH, Pulse, Rig, flag_edge, now, path_ended, plan, run, settings, small,
    stroke_done,
};

const SETTINGS: Settings = Settings::REFERENCE;

mod homing {
    use super::*;

    fn home_from(place: i32, fault: impl FnOnce(&mut Rig)) -> Rig {
        let mut rig = Rig::new(SETTINGS, place);
        fault(&mut rig);
        rig.command(Command::Home).unwrap();
        rig.finish();
        rig
    }

    /// A pulse that outlasts the filter, from noise or from a hand, is not the flag: the carriage has braked into the
    /// flag if it was. It became the zero.
    #[test]
    fn a_flag_that_closes_again_is_not_found() {
        let mut machine = Machine::new(SETTINGS, None, IMAGE_HASH);
        machine.step(&now(1, 0, CLOSED), Event::Command(&Command::Home));
        machine.step(&now(2, 0, CLOSED), flag_edge(true, -50));
        machine.step(&now(3, 0, CLOSED), flag_edge(false, -55));
        let at_rest = now(4, -60, CLOSED);
        machine.step(&at_rest, path_ended(PathEnd::Stopped, -60, -60));
        let not_found = |phase| Some(RigFault::FlagNotFound(phase));
        assert_eq!(machine.fault(), not_found(HomingPhase::Seek));
        assert!(!machine.homed());
        // In the measuring pass.
        let mut rig = Rig::new(SETTINGS, 2_000);
        rig.command(Command::Home).unwrap();
        while rig.windows.len() < 3 {
            rig.step();
        }
        let place = rig.ring.counted - 10;
        let machine = &mut rig.machine;
        machine.step(&now(2, place, CLOSED), flag_edge(true, place));
        machine.step(&now(3, place, CLOSED), flag_edge(false, place));
        let at_rest = now(4, place, CLOSED);
        machine.step(&at_rest, path_ended(PathEnd::Stopped, place, place));
        assert_eq!(machine.fault(), not_found(HomingPhase::Locate));
    }

    /// A pulse in the measuring pass that lasts until the carriage stands.
    #[test]
    fn passes_that_meet_the_flag_at_two_places_have_not_found_it() {
        for (off, fault) in [
            (80, None),
            (-80, None),
            (81, Some(RigFault::FlagNotFound(HomingPhase::Locate))),
            (-81, Some(RigFault::FlagNotFound(HomingPhase::Locate))),
        ] {
            let mut rig = Rig::new(SETTINGS, 2_000);
            rig.command(Command::Home).unwrap();
            while rig.windows.len() < 3 {
                rig.step();
            }
            // The simulated counter began at 0, at 2,000 steps from home; the flag's edge is at 800.
            let place = -1_200 + off;
            let machine = &mut rig.machine;
            machine.step(&now(2, place, CLOSED), flag_edge(true, place));
            let rest = place - 5;
            machine.step(
                &now(3, rest, CLOSED),
                path_ended(PathEnd::Stopped, rest, rest),
            );
            assert_eq!(machine.fault(), fault, "{off}");
        }
    }

    #[test]
    fn nothing_is_acknowledged_while_the_loop_is_open() {
        let mut machine = Machine::new(SETTINGS, Some(RigFault::Underrun), IMAGE_HASH);
        let open = RigInputs {
            estop_loop: true,
            ..CLOSED
        };
        let acknowledge = Event::Command(&Command::Acknowledge);
        let actions = machine.step(&now(1, 0, open), acknowledge);
        assert_eq!(actions.refusal, Some(Refusal::CauseStillPresent));
        let actions = machine.step(&now(2, 0, CLOSED), acknowledge);
        assert_eq!((actions.refusal, machine.fault()), (None, None));
    }

    /// It failed half way, as a flag that is not found.
    #[test]
    fn is_refused_on_an_axis_that_is_too_fine_for_its_speed() {
        let fine = settings(&[
            (SettingKey::LeadUm, 500),
            (SettingKey::FullSteps, 400),
            (SettingKey::Microsteps, 256),
            (SettingKey::SeekUmS, 100),
            (SettingKey::LocateUmS, 100),
        ]);
        let mut machine = Machine::new(fine, None, IMAGE_HASH);
        let actions = machine.step(&now(1, 0, CLOSED), Event::Command(&Command::Home));
        assert_eq!(actions.refusal, Some(Refusal::TooSlow));
        assert!(actions.list.is_empty());
        assert_eq!(machine.state(), RigState::Unhomed);
    }

    /// The longest way off the flag, at twice the slowest speed; from an open flag it comes first.
    #[test]
    fn is_begun_on_the_finest_axis_at_the_slowest_measuring_speed() {
        let fine = settings(&[
            (SettingKey::LeadUm, 500),
            (SettingKey::FullSteps, 400),
            (SettingKey::Microsteps, 256),
            (SettingKey::StrokeUm, 40_000),
            (SettingKey::FlagUm, 20_000),
            (SettingKey::PullOffUm, 20_000),
            (SettingKey::OvertravelUm, 20_000),
            (SettingKey::SeekUmS, 300),
            (SettingKey::LocateUmS, 100),
        ]);
        let open = RigInputs {
            home_flag: true,
            ..CLOSED
        };
        for (inputs, phase) in [(CLOSED, HomingPhase::Seek), (open, HomingPhase::Clear)] {
            let mut machine = Machine::new(fine, None, IMAGE_HASH);
            let actions = machine.step(&now(1, 0, inputs), Event::Command(&Command::Home));
            assert_eq!(actions.refusal, None, "{phase:?}");
            assert_eq!(machine.state(), RigState::Homing);
        }
    }

    /// A noisy flag may be found and closed again; with an open far limit there is no way away from it.
    #[test]
    fn does_not_leave_the_flag_toward_an_open_far_limit() {
        let mut machine = Machine::new(SETTINGS, None, IMAGE_HASH);
        machine.step(&now(1, 0, CLOSED), Event::Command(&Command::Home));
        machine.step(&now(2, 0, CLOSED), flag_edge(true, -50));
        machine.step(&now(3, 0, CLOSED), flag_edge(false, -55));
        let far_open = RigInputs {
            far_limit: true,
            ..CLOSED
        };
        let at_rest = now(4, -60, far_open);
        machine.step(&at_rest, path_ended(PathEnd::Stopped, -60, -60));
        assert_eq!(machine.fault(), Some(RigFault::FarLimit));
    }

    #[test]
    fn finds_zero_from_everywhere() {
        for (place, ahead) in [-1_000, 0, 799, 800, 801, 2_000, 50_000, 104_000]
            .into_iter()
            .flat_map(|place| [Ahead::Nothing, Ahead::Slots].map(|ahead| (place, ahead)))
        {
            let rig = home_from(place, |rig| (rig.ring.ahead, rig.bounces) = (ahead, 3));
            assert_eq!(rig.machine.state(), RigState::Ready, "{place}");
            assert!(rig.machine.homed());
            assert_eq!((rig.place, rig.ring.counted), (0, 0), "{place}");
            let homed = RigEvent::Homed {
                repeat_steps: 0,
                shift_steps: 0,
            };
            assert_eq!(rig.events, [homed]);
            // Starting on the flag takes one move more: off it first.
            assert_eq!(rig.windows.len(), if place <= 800 { 5 } else { 4 });
        }
    }

    #[test]
    fn reports_how_far_the_reference_has_moved() {
        let mut rig = Rig::homed(SETTINGS);
        rig.place += 3; // pushed by hand
        rig.command(Command::Home).unwrap();
        assert!(!rig.machine.homed(), "not while it is being found again");
        rig.finish();
        let homed = RigEvent::Homed {
            repeat_steps: 0,
            shift_steps: -3,
        };
        assert_eq!(rig.events, [homed]);
        assert_eq!((rig.place, rig.ring.counted), (0, 0));
    }

    #[test]
    fn a_flag_that_never_opens_is_not_found() {
        // The end-of-travel loop comes first where the carriage reaches it.
        let rig = home_from(104_000, |rig| rig.stuck_flag = Some(false));
        assert_eq!(rig.fault(), Some(RigFault::EStopLoop));
        // A carriage that does not move at all.
        let rig = home_from(50_000, |rig| rig.slipping = u32::MAX);
        assert_eq!(rig.fault(), Some(RigFault::FlagNotFound(HomingPhase::Seek)));
        // 130 mm and 10 mm of overtravel.
        assert_eq!(rig.pulses, 112_000);
    }

    #[test]
    fn a_flag_that_is_lost_between_the_passes_is_not_found() {
        let mut rig = Rig::new(SETTINGS, 2_000);
        rig.command(Command::Home).unwrap();
        while rig.windows.len() < 3 {
            rig.step();
        }
        rig.stuck_flag = Some(false);
        rig.finish();
        assert_eq!(
            rig.fault(),
            Some(RigFault::FlagNotFound(HomingPhase::Locate))
        );
        // It was looked for over twice the 3 mm between the passes.
        let (first, last) = rig.windows[2];
        assert_eq!(last - first, 4_800);
    }

    #[test]
    fn leaves_the_flag_at_twice_the_speed_of_the_measuring_pass() {
        let mut rig = Rig::new(SETTINGS, 0);
        rig.trace = Some(Vec::new());
        rig.command(Command::Home).unwrap();
        rig.finish();
        let trace = rig.trace.as_ref().unwrap();
        let moves: Vec<_> = trace.chunk_by(|_, next| !next.sync).collect();
        let fastest = |pulses: &[Pulse]| {
            let intervals = pulses.windows(2).map(|pair| pair[1].at - pair[0].at);
            intervals.min().unwrap()
        };
        // Off the flag at 4 mm/s; towards it, back, towards it at 2 mm/s, to zero.
        assert_eq!(moves.len(), 5);
        assert_eq!((fastest(moves[0]), fastest(moves[3])), (31_250, 62_500));
    }

    #[test]
    fn a_flag_that_never_closes_is_stuck() {
        let rig = home_from(0, |rig| rig.stuck_flag = Some(true));
        assert_eq!(rig.fault(), Some(RigFault::FlagStuck));
        // The longest possible flag: 1 mm and the overtravel of 10 mm.
        assert_eq!(rig.place, 8_800);
        // The flag sticks after the first pass has met it.
        let mut rig = Rig::new(SETTINGS, 2_000);
        rig.command(Command::Home).unwrap();
        while rig.windows.len() < 2 {
            rig.step();
        }
        rig.stuck_flag = Some(true);
        rig.finish();
        assert_eq!(rig.fault(), Some(RigFault::FlagStuck));
    }

    /// The flag closes and opens again at once, while the carriage leaves it: a pass towards home would never
    /// see it open and would end in the end-of-travel loop.
    #[test]
    fn a_flag_that_opens_again_behind_the_carriage_is_stuck() {
        let mut rig = Rig::new(SETTINGS, 0);
        rig.command(Command::Home).unwrap();
        while rig.inputs().home_flag {
            rig.step();
        }
        let count = rig.ring.counted;
        rig.event(flag_edge(true, count));
        rig.finish();
        assert_eq!(rig.fault(), Some(RigFault::FlagStuck));
    }

    #[test]
    fn an_unplugged_cable_is_refused() {
        let mut rig = Rig::new(SETTINGS, 2_000);
        (rig.stuck_flag, rig.far_wire_cut) = (Some(true), true);
        assert_eq!(rig.command(Command::Home), Err(Refusal::BothSwitchesOpen));
        rig.pressed = true;
        assert_eq!(rig.command(Command::Home), Err(Refusal::LoopOpen));
        assert_eq!((rig.machine.state(), rig.pulses), (RigState::Unhomed, 0));
    }

    /// Homes from on the flag, acts in each of the five phases, then lets the carriage come to rest.
    fn in_each_phase(mut act: impl FnMut(&mut Rig)) -> Vec<Rig> {
        (1..=5)
            .map(|phase| {
                let mut rig = Rig::new(SETTINGS, 0);
                rig.command(Command::Home).unwrap();
                while rig.windows.len() < phase {
                    rig.step();
                }
                rig.pulses(3);
                let before = rig.windows.len();
                assert_eq!(before, phase);
                act(&mut rig);
                rig.finish();
                assert_eq!(rig.windows.len(), before, "no further move");
                assert!(!rig.machine.homed());
                rig
            })
            .collect()
    }

    #[test]
    fn a_stop_and_a_silent_host_in_each_phase_leave_it_unhomed() {
        let stops: [fn(&mut Rig); 2] = [
            |rig| rig.command(Command::Stop).unwrap(),
            |rig| rig.event(Event::LinkSilent),
        ];
        for rig in stops.into_iter().flat_map(in_each_phase) {
            assert_eq!(rig.machine.state(), RigState::Unhomed);
            let position_steps = rig.ring.counted;
            assert_eq!(rig.events, [RigEvent::Stopped { position_steps }]);
        }
    }

    #[test]
    fn an_emergency_stop_in_each_phase_is_final() {
        let mut pulses = 0;
        for mut rig in in_each_phase(|rig| {
            pulses = rig.pulses;
            rig.press();
        }) {
            assert_eq!(rig.fault(), Some(RigFault::EStopLoop));
            assert_eq!(rig.events, [RigEvent::Faulted(RigFault::EStopLoop)]);
            assert_eq!(
                rig.command(Command::Acknowledge),
                Err(Refusal::CauseStillPresent)
            );
            rig.pressed = false;
            assert!(rig.command(Command::Home).is_err());
            rig.command(Command::Acknowledge).unwrap();
            assert_eq!(rig.machine.state(), RigState::Unhomed);
            assert!(!rig.moving());
            rig.command(Command::Home).unwrap();
            rig.finish();
            assert_eq!((rig.machine.state(), rig.place), (RigState::Ready, 0));
        }
        for rig in in_each_phase(|rig| rig.command(Command::EStop).unwrap()) {
            assert_eq!(rig.fault(), Some(RigFault::EStopFrame));
        }
    }

    #[test]
    fn a_missing_jumper_is_found_by_the_first_move() {
        let rig = home_from(2_000, |rig| rig.jumper_cut = true);
        assert!(matches!(
            rig.fault(),
            Some(RigFault::ReadBack { counted: 0, .. })
        ));
        assert_eq!(rig.windows.len(), 1);
    }
}

mod running {
    use super::*;

    /// 10 mm, two cycles: 4 strokes of 8,000 steps.
    fn started(link_loss: LinkLossPolicy) -> Rig {
        let mut rig = Rig::homed(SETTINGS);
        rig.command(run(&SETTINGS, 2, 10_000, link_loss)).unwrap();
        assert_eq!(rig.windows, [(0, 104_000)]);
        assert_eq!(rig.events, [RigEvent::RunStarted { run: 1 }]);
        rig.events.clear();
        rig
    }

    fn stroke(stroke: u32) -> RigEvent {
        RigEvent::StrokeDone {
            stroke,
            residual_steps: 0,
        }
    }

    fn ended(outcome: RunOutcome) -> RigEvent {
        RigEvent::RunEnded { run: 1, outcome }
    }

    /// The record has the pulses that were prepared and those that left the pin, however the run ended.
    fn assert_record(rig: &Rig, outcome: RunOutcome, strokes: u32) {
        let record = rig.machine.record();
        assert_eq!(record.outcome, outcome);
        assert_eq!(record.prepared_edges, rig.pulses + rig.ring.cut);
        assert_eq!(record.commanded_edges, rig.pulses);
        assert_eq!(record.counted_edges, rig.pulses);
        assert_eq!(record.strokes, strokes);
        assert_eq!(record.min_queue, Some(100));
        assert_eq!(record.plan_hash, plan(&SETTINGS, 2, 10_000, 40_000).hash());
    }

    #[test]
    fn completes() {
        let mut rig = Rig::homed(SETTINGS);
        rig.glitches = 5;
        rig.command(run(&SETTINGS, 2, 10_000, LinkLossPolicy::Stop))
            .unwrap();
        rig.events.clear();
        let from = rig.now;
        rig.glitches = 8;
        rig.finish();
        assert_eq!(
            rig.events,
            [
                stroke(0),
                stroke(1),
                stroke(2),
                stroke(3),
                ended(RunOutcome::Complete)
            ]
        );
        let plan = plan(&SETTINGS, 2, 10_000, 40_000);
        assert_eq!(
            *rig.machine.record(),
            RunRecord {
                run: 1,
                outcome: RunOutcome::Complete,
                strokes: 4,
                commanded_edges: 32_000,
                counted_edges: 32_000,
                ticks: plan.total().0,
                plan_hash: plan.hash(),
                min_steps: 0,
                max_steps: 8_000,
                worst_residual_steps: 0,
                min_queue: Some(100),
                glitches: 3,
                holds: 0,
                image_hash: IMAGE_HASH,
                prepared_edges: 32_000,
                edges_timed: 32_000,
                worst_interval_error_ticks: 0,
            }
        );
        // 10 us for the last pulse and 10 us without one follow.
        assert_eq!(rig.now - from, plan.total().0 + 2_000);
        assert_eq!((rig.machine.state(), rig.place), (RigState::Ready, 0));
        let record = *rig.machine.record();
        rig.command(Command::Home).unwrap();
        rig.glitches += 4;
        rig.finish();
        assert_eq!(*rig.machine.record(), record, "homing leaves it alone");
        // The next run is number 2, with a record of its own.
        rig.command(run(&SETTINGS, 1, 1_000, LinkLossPolicy::Stop))
            .unwrap();
        assert_eq!(rig.machine.record().run, 2);
        assert_eq!(rig.machine.record().commanded_edges, 0);
        rig.finish();
        assert_eq!(rig.machine.record().strokes, 2);
    }

    #[test]
    fn a_stop_anywhere_keeps_the_position() {
        for pulses in [
            0, 1, 2, 3_999, 7_999, 8_000, 8_001, 12_345, 16_000, 31_999, 32_000,
        ] {
            let mut rig = started(LinkLossPolicy::Stop);
            rig.pulses(pulses);
            rig.command(Command::Stop).unwrap();
            assert_eq!(rig.machine.state(), RigState::Stopping);
            rig.finish();
            assert_eq!(rig.machine.state(), RigState::Ready);
            assert!(rig.machine.homed());
            assert_eq!(rig.place, rig.ring.counted);
            let position_steps = rig.ring.counted;
            assert_eq!(rig.events.pop(), Some(RigEvent::Stopped { position_steps }));
            assert_eq!(rig.events.pop(), Some(ended(RunOutcome::Stopped)));
            assert_record(&rig, RunOutcome::Stopped, rig.events.len() as u32);
            // The next run starts at 0 only.
            let next = rig.command(run(&SETTINGS, 1, 1_000, LinkLossPolicy::Stop));
            if position_steps == 0 {
                assert_eq!(next, Ok(()));
            } else {
                assert!(matches!(next, Err(Refusal::NotAtHome { .. })));
                rig.command(Command::Home).unwrap();
                rig.finish();
                assert_eq!((rig.machine.state(), rig.place), (RigState::Ready, 0));
            }
        }
    }

    /// The stroke's end and the stop cross: the report of the stroke comes after the command.
    #[test]
    fn a_stroke_that_ends_during_a_stop_is_counted() {
        let mut rig = started(LinkLossPolicy::Stop);
        rig.pulses(7_990);
        let counted = rig.ring.counted;
        let stop = Event::Command(&Command::Stop);
        let actions = rig.machine.step(&now(0, counted, CLOSED), stop);
        assert_eq!((kinds(&actions), actions.refusal), (vec!["StopPath"], None));
        // Execution has not received the stop yet.
        rig.pulses(20);
        let ended = path_ended(PathEnd::Stopped, 7_990, 7_990);
        let actions = rig.machine.step(&now(0, 7_990, CLOSED), ended);
        assert_eq!(kinds(&actions), ["RunEnded", "Stopped"]);
        assert_record(&rig, RunOutcome::Stopped, 1);
        assert_eq!(rig.events, [stroke(0)]);
    }

    /// A stop in the ramp of a stroke's end comes to rest with its last step: the stroke is complete.
    #[test]
    fn a_stop_that_ends_with_a_stroke_counts_it() {
        type Stop = fn(&mut Rig);
        let stops: [(Stop, RunOutcome); 2] = [
            (
                |rig| rig.command(Command::Stop).unwrap(),
                RunOutcome::Stopped,
            ),
            (|rig| rig.event(Event::LinkSilent), RunOutcome::LinkLost),
        ];
        for (stop, outcome) in stops {
            for strokes in 1..=4 {
                let mut rig = started(LinkLossPolicy::Stop);
                let pulses = u64::from(strokes) * 8_000;
                rig.pulses(pulses - 10);
                stop(&mut rig);
                rig.finish();
                assert_eq!(rig.pulses, pulses);
                assert_record(&rig, outcome, strokes);
                let mut events: Vec<_> = (0..strokes).map(stroke).collect();
                let position_steps = rig.ring.counted;
                events.extend([ended(outcome), RigEvent::Stopped { position_steps }]);
                assert_eq!(rig.events, events);
            }
        }
    }

    #[test]
    fn a_silent_host_stops_or_not_as_declared() {
        let mut rig = started(LinkLossPolicy::Stop);
        rig.pulses(10_000);
        rig.event(Event::LinkSilent);
        rig.finish();
        assert_eq!(rig.machine.state(), RigState::Ready);
        assert_eq!(rig.place, rig.ring.counted);
        assert_record(&rig, RunOutcome::LinkLost, 1);

        let mut rig = started(LinkLossPolicy::Finish);
        rig.pulses(10_000);
        rig.event(Event::LinkSilent);
        rig.finish();
        assert_record(&rig, RunOutcome::Complete, 4);
    }

    /// A fault is latched, the position is untrusted, and nothing moves until acknowledged and homed.
    fn assert_latched(mut rig: Rig, fault: RigFault) {
        let pulses = rig.pulses;
        assert_eq!(rig.fault(), Some(fault));
        assert!(!rig.machine.homed() && !rig.moving());
        assert_eq!(rig.events.pop(), Some(RigEvent::Faulted(fault)));
        assert_eq!(rig.events.pop(), Some(ended(RunOutcome::Faulted(fault))));
        let again = run(&SETTINGS, 1, 1_000, LinkLossPolicy::Stop);
        assert_eq!(rig.command(again), Err(Refusal::RigFaulted(fault)));
        assert_eq!(rig.command(Command::Home), Err(Refusal::RigFaulted(fault)));
        (rig.pressed, rig.far_wire_cut, rig.jumper_cut) = (false, false, false);
        rig.slipping = 0;
        rig.command(Command::Acknowledge).unwrap();
        assert_eq!(rig.command(again), Err(Refusal::NotHomed));
        assert_eq!(rig.pulses, pulses);
        rig.command(Command::Home).unwrap();
        rig.finish();
        assert_eq!((rig.machine.state(), rig.place), (RigState::Ready, 0));
        rig.command(again).unwrap();
        rig.finish();
        assert_eq!(rig.machine.record().outcome, RunOutcome::Complete);
    }

    #[test]
    fn an_emergency_stop_keeps_the_true_count() {
        for pulses in [1, 4_000, 8_000, 8_001, 20_000, 31_999] {
            let mut rig = started(LinkLossPolicy::Finish);
            rig.pulses(pulses);
            let strokes = rig.events.len() as u32;
            rig.press();
            assert_eq!((rig.pulses, rig.place), (pulses, rig.ring.counted));
            assert_record(&rig, RunOutcome::Faulted(RigFault::EStopLoop), strokes);
            assert_latched(rig, RigFault::EStopLoop);

            let mut rig = started(LinkLossPolicy::Finish);
            rig.pulses(pulses);
            rig.command(Command::EStop).unwrap();
            assert_record(&rig, RunOutcome::Faulted(RigFault::EStopFrame), strokes);
            assert_latched(rig, RigFault::EStopFrame);
        }
    }

    /// The pulses are cut before the machine hears why: the report of the path's end may come first.
    #[test]
    fn pulses_that_were_cut_by_anybody_are_a_fault() {
        for (loop_open, fault) in [(true, RigFault::EStopLoop), (false, RigFault::EStopFrame)] {
            let mut rig = started(LinkLossPolicy::Stop);
            rig.pulses(5_000);
            let inputs = RigInputs {
                estop_loop: loop_open,
                ..CLOSED
            };
            let now = now(0, 5_000, inputs);
            let cut = path_ended(PathEnd::Cut, 5_000, 5_000);
            rig.machine.step(&now, cut);
            assert_eq!(rig.fault(), Some(fault));
            assert_record(&rig, RunOutcome::Faulted(fault), 0);
            // The cause is reported after the path's end: no second fault.
            let estop = Event::Command(&Command::EStop);
            let actions = rig.machine.step(&now, estop);
            assert_eq!((kinds(&actions), actions.refusal), (vec!["Cut"], None));
            assert_eq!(rig.fault(), Some(fault));
        }
    }

    #[test]
    fn the_far_limit_ends_a_run() {
        // The carriage is pushed 5 mm away from home by hand.
        let mut rig = Rig::homed(SETTINGS);
        rig.command(run(&SETTINGS, 1, 130_000, LinkLossPolicy::Stop))
            .unwrap();
        rig.place += 4_000;
        rig.events.clear();
        rig.finish();
        assert_eq!(rig.place, 104_801);
        assert_latched(rig, RigFault::FarLimit);
        // Open before the start.
        let mut rig = Rig::homed(SETTINGS);
        rig.far_wire_cut = true;
        rig.stuck_flag = Some(false);
        assert_eq!(
            rig.command(run(&SETTINGS, 1, 1_000, LinkLossPolicy::Stop)),
            Err(Refusal::FarLimitOpen)
        );
    }

    #[test]
    fn lost_steps_are_found_at_the_flag() {
        for slipping in [1, 8, 9, 64, 500] {
            let mut rig = started(LinkLossPolicy::Stop);
            rig.pulses(2_000);
            rig.slipping = slipping;
            rig.finish();
            // Steps lost on the way out: the flag comes that much too early on the way back.
            let residual_steps = slipping as i32;
            assert_eq!(rig.machine.residual(), residual_steps);
            if slipping <= SETTINGS.max_residual_steps {
                assert_eq!(rig.machine.state(), RigState::Ready);
                let record = rig.machine.record();
                assert_eq!(record.worst_residual_steps, residual_steps);
            } else {
                assert_eq!(rig.machine.record().worst_residual_steps, residual_steps);
                assert_eq!(rig.machine.record().strokes, 1);
                // It brakes with a ramp: 40 mm/s at 1,000 mm/s2 take 0.8 mm.
                assert!(rig.place < 800 && rig.place > 100, "{}", rig.place);
                assert_latched(rig, RigFault::LostSteps { residual_steps });
            }
        }
        // Steps lost on the way back: the flag comes too late.
        let mut rig = started(LinkLossPolicy::Stop);
        rig.pulses(10_000);
        rig.slipping = 64;
        rig.finish();
        assert_eq!(
            rig.fault(),
            Some(RigFault::LostSteps {
                residual_steps: -64
            })
        );
    }

    /// A carriage that stalls on its way back never meets the flag; without this check the last stroke would
    /// end "at home".
    #[test]
    fn a_flag_that_is_not_met_is_lost_steps() {
        for stall_at in [10_000, 26_000] {
            let mut rig = started(LinkLossPolicy::Stop);
            rig.pulses(stall_at);
            rig.slipping = 6_000;
            rig.finish();
            let residual_steps = -SETTINGS.flag.0;
            assert_latched(rig, RigFault::LostSteps { residual_steps });
        }
    }

    /// Regression: a stop or a silent host on the way home threw the evidence away, and the rig was "ready".
    #[test]
    fn a_stop_forgives_no_lost_steps() {
        let stops: [fn(&mut Rig); 2] = [
            |rig| rig.command(Command::Stop).unwrap(),
            |rig| rig.event(Event::LinkSilent),
        ];
        for stop in stops {
            // Lost on the way out: while the rig brakes, the flag opens too early.
            let mut rig = started(LinkLossPolicy::Stop);
            rig.pulses(2_000);
            rig.slipping = 64;
            rig.pulses(12_900);
            stop(&mut rig);
            rig.finish();
            assert_latched(rig, RigFault::LostSteps { residual_steps: 64 });
            // Stalled on the way back: at rest, the flag has not opened.
            let mut rig = started(LinkLossPolicy::Stop);
            rig.pulses(10_000);
            rig.slipping = 6_000;
            rig.pulses(5_900);
            stop(&mut rig);
            rig.finish();
            let residual_steps = rig.ring.counted - SETTINGS.flag.0;
            assert!(residual_steps < -700, "{residual_steps}");
            assert_latched(rig, RigFault::LostSteps { residual_steps });
        }
    }

    /// The first of two equal residuals stays the worst, whatever its sign; a greater one takes its place.
    #[test]
    fn the_worst_residual_is_the_first_of_its_size() {
        let mut rig = Rig::homed(SETTINGS);
        rig.command(run(&SETTINGS, 4, 10_000, LinkLossPolicy::Stop))
            .unwrap();
        let mut back = |stroke, count| {
            rig.event(stroke_done(stroke, 8_000, 8_000));
            rig.event(flag_edge(true, count));
            rig.event(stroke_done(stroke + 1, 0, 0));
            (
                rig.machine.residual(),
                rig.machine.record().worst_residual_steps,
            )
        };
        assert_eq!(back(0, 803), (3, 3));
        assert_eq!(back(2, 797), (-3, 3));
        assert_eq!(back(4, 796), (-4, -4));
        assert_eq!(back(6, 801), (1, -4));
    }

    /// A switch closes up to a millimetre beyond the place where it opens: a stroke that turns before it has closed meets
    /// no edge.
    #[test]
    fn a_stroke_has_to_meet_the_flag_if_it_reaches_well_beyond_it() {
        // 1 mm, 1 mm of hysteresis and 8 steps; one step more.
        for (stroke_um, steps, complete) in [(2_010, 1_608, true), (2_012, 1_609, false)] {
            let mut rig = Rig::homed(SETTINGS);
            rig.command(run(&SETTINGS, 1, stroke_um, LinkLossPolicy::Stop))
                .unwrap();
            rig.stuck_flag = Some(true);
            rig.finish();
            assert_eq!(rig.machine.record().max_steps, steps);
            let residual_steps = -800;
            let fault = (!complete).then_some(RigFault::LostSteps { residual_steps });
            assert_eq!(rig.fault(), fault, "{steps}");
        }
    }

    /// Shortest queue over all paths of the run. A path that was queued as a whole does not count.
    #[test]
    fn queue_and_timing_are_those_of_all_paths() {
        let mut rig = started(LinkLossPolicy::Stop);
        for (queue, shortest) in [(Some(50), 50), (Some(70), 50), (Some(30), 30), (None, 30)] {
            let now = now(0, 100, CLOSED);
            let hold = rig.machine.step(&now, Event::Command(&Command::Hold));
            assert_eq!(hold.refusal, None);
            let report = PathReport {
                min_queue: queue,
                timed: Timed {
                    edges: 10,
                    worst_error_ticks: queue.map_or(0, u32::from),
                },
                ..rest_at(100)
            };
            let ended = Event::PathEnded(PathEnd::Stopped, report);
            assert_eq!(kinds(&rig.machine.step(&now, ended)), ["Held"]);
            assert_eq!(rig.machine.record().min_queue, Some(shortest));
            let resume = rig.machine.step(&now, Event::Command(&Command::Resume));
            assert_eq!(resume.refusal, None);
        }
        // The sum of all edges, and the worst error.
        let record = rig.machine.record();
        assert_eq!(record.edges_timed, 40);
        assert_eq!(record.worst_interval_error_ticks, 70);
        let mut rig = started(LinkLossPolicy::Stop);
        let report = PathReport {
            min_queue: None,
            ..rest_at(100)
        };
        let ended = Event::PathEnded(PathEnd::Stopped, report);
        rig.machine.step(&now(0, 100, CLOSED), ended);
        assert_eq!(rig.machine.record().min_queue, None);
    }

    fn rest_at(position: i32) -> PathReport {
        PathReport {
            commanded: StepPosition(position),
            counted: StepPosition(position),
            last_tick: 1,
            ..PathReport::default()
        }
    }

    #[test]
    fn a_missing_jumper_is_found_at_once() {
        // In the first stroke, in the last one, and in the last steps of all.
        for pulses in [100, 24_100, 31_990] {
            let mut rig = started(LinkLossPolicy::Stop);
            rig.pulses(pulses);
            rig.jumper_cut = true;
            let counted = rig.ring.counted;
            rig.finish();
            // One pulse is missed, one already has its time; braking takes as many as accelerating did.
            let further = (rig.pulses - pulses) as i32;
            assert!((10..=104).contains(&further), "{further}");
            let commanded = if pulses < 8_000 {
                counted + further
            } else {
                counted - further
            };
            assert_eq!(rig.machine.record().counted_edges, pulses);
            assert_eq!(rig.machine.record().commanded_edges, rig.pulses);
            assert_latched(rig, RigFault::ReadBack { commanded, counted });
        }
    }

    #[test]
    fn a_hundred_runs_do_not_drift() {
        let mut rig = Rig::homed(small());
        for _ in 0..100 {
            rig.bounces = 2;
            rig.command(run(&small(), 5, 20_000, LinkLossPolicy::Stop))
                .unwrap();
            rig.finish();
            assert_eq!((rig.place, rig.ring.counted), (0, 0));
            assert_eq!(rig.machine.record().worst_residual_steps, 0);
        }
        assert_eq!(rig.machine.record().run, 100);
    }
}

/// Names of actions.
fn kinds(actions: &Actions) -> Vec<&'static str> {
    actions
        .list
        .iter()
        .map(|action| match action {
            Action::Start { .. } => "Start",
            Action::StopPath => "StopPath",
            Action::Cut => "Cut",
            Action::SetPosition(_) => "SetPosition",
            Action::Emit(RigEvent::Homed { .. }) => "Homed",
            Action::Emit(RigEvent::RunStarted { .. }) => "RunStarted",
            Action::Emit(RigEvent::StrokeDone { .. }) => "StrokeDone",
            Action::Emit(RigEvent::RunEnded { .. }) => "RunEnded",
            Action::Emit(RigEvent::Stopped { .. }) => "Stopped",
            Action::Emit(RigEvent::Faulted(_)) => "Faulted",
            Action::Emit(RigEvent::Held { .. }) => "Held",
            Action::Emit(RigEvent::Resumed) => "Resumed",
            Action::Emit(RigEvent::Moved { .. }) => "Moved",
            Action::Emit(
                other @ (RigEvent::SettingChanged(_)
                | RigEvent::SettingsReset
                | RigEvent::SettingsUnusable
                | RigEvent::ButtonIgnored),
            ) => panic!("{other:?} is not the machine's"),
        })
        .collect()
}

mod table {
    use super::*;
    use Input::*;
    use Start::*;

    /// An enum, and the list of all its variants: none can be missing from it.
    macro_rules! listed {
        ($(#[$doc:meta])* enum $name:ident in $all:ident { $($variant:ident,)* }) => {
            $(#[$doc])*
            #[derive(Clone, Copy, Debug, PartialEq)]
            enum $name { $($variant,)* }

            const $all: &[$name] = &[$($variant,)*];
        };
    }

    listed! {
        /// Every state that the machine tells apart, each reached through commands and events alone.
        enum Start in STARTS {
            Unhomed,
            Clear,
            Seek,
            SeekFound,
            PullOff,
            Locate,
            LocateFound,
            ToZero,
            Ready,
            Away,
            Back,
            BackMet,
            Finish,
            HomingByButton,
            ReadyOut,
            StopHoldOut,
            StopHoldBack,
            StopHoldMet,
            HeldFirst,
            HeldOut,
            HeldBack,
            HeldMet,
            Moving,
            Jogging,
            StopHoming,
            StopRun,
            StopBack,
            StopMet,
            StopLost,
            StopMove,
            Faulted,
            FaultedMoving,
            FaultedHeld,
            Panicked,
        }
    }

    listed! {
        /// Every event and command, with the contents that matter.
        enum Input in INPUTS {
            FlagOpens,
            FlagOpensLate,
            FlagCloses,
            FlagClosesLate,
            FarLimit,
            SwitchNoise,
            LoopOpened,
            StrokeDone,
            StrokeMismatch,
            Complete,
            Stopped,
            StoppedFar,
            StoppedNear,
            StoppedAtLimit,
            StoppedBehind,
            Cut,
            Underrun,
            Guard,
            EndMismatch,
            LinkSilent,
            TickInTime,
            TickAtDeadline,
            TickLate,
            Home,
            Run,
            RunOffFlag,
            Hold,
            Resume,
            ResumeElsewhere,
            JogSame,
            JogOther,
            MoveTo,
            MoveOffFlag,
            Button,
            ButtonNoPlan,
            Stop,
            StopElsewhere,
            EStop,
            Acknowledge,
        }
    }

    /// The time of the input, us, and the input.
    fn sample(input: Input) -> (u64, Event<'static>) {
        let time_us = match input {
            TickInTime => 300_000,
            TickAtDeadline => 60_000_000,
            TickLate => 60_000_001,
            _ => 0,
        };
        let event = match input {
            FlagOpens => flag_edge(true, 800),
            FlagOpensLate => flag_edge(true, 700),
            FlagCloses => flag_edge(false, 800),
            FlagClosesLate => flag_edge(false, 700),
            FarLimit => Event::FarLimit,
            SwitchNoise => Event::SwitchNoise(Switch::HomeFlag),
            LoopOpened => Event::LoopOpened,
            StrokeDone => stroke_done(1, 0, 0),
            StrokeMismatch => stroke_done(1, 0, 1),
            Complete => path_ended(PathEnd::Complete, 0, 0),
            Stopped => path_ended(PathEnd::Stopped, 0, 0),
            StoppedFar => path_ended(PathEnd::Stopped, 4_000, 4_000),
            StoppedNear => path_ended(PathEnd::Stopped, 500, 500),
            // The step-loss check tolerates 8 steps.
            StoppedAtLimit => path_ended(PathEnd::Stopped, 792, 792),
            StoppedBehind => path_ended(PathEnd::Stopped, 791, 791),
            Cut => path_ended(PathEnd::Cut, 0, 0),
            Underrun => path_ended(PathEnd::Underrun, 0, 0),
            Guard => path_ended(PathEnd::Guard, 0, 0),
            EndMismatch => path_ended(PathEnd::Complete, 0, 1),
            LinkSilent => Event::LinkSilent,
            TickInTime | TickAtDeadline | TickLate => Event::Tick,
            _ => Event::Command(Box::leak(Box::new(command(input)))),
        };
        (time_us, event)
    }

    fn command(input: Input) -> Command {
        match input {
            Home => Command::Home,
            Run | RunOffFlag => run(&SETTINGS, 1, 10_000, LinkLossPolicy::Stop),
            Hold => Command::Hold,
            Resume | ResumeElsewhere => Command::Resume,
            JogSame => jog(Direction::Away),
            JogOther => jog(Direction::Home),
            MoveTo | MoveOffFlag => move_to(2_000),
            Button => Command::Button(Some(plan(&SETTINGS, 1, 10_000, 40_000))),
            ButtonNoPlan => Command::Button(None),
            Stop | StopElsewhere => Command::Stop,
            EStop => Command::EStop,
            Acknowledge => Command::Acknowledge,
            event => panic!("{event:?} is no command"),
        }
    }

    fn jog(direction: Direction) -> Command {
        let speed = SETTINGS.speed(10_000).unwrap();
        Command::Jog { direction, speed }
    }

    fn move_to(steps: u32) -> Command {
        Command::MoveTo {
            target: SETTINGS.axis.position(Steps(steps)).unwrap(),
            speed: SETTINGS.speed(10_000).unwrap(),
        }
    }

    const ON_FLAG: RigInputs = RigInputs {
        home_flag: true,
        ..CLOSED
    };

    /// A starting state, and the inputs that lead to it from the one before.
    type Phase = (Start, fn(&mut Setup));

    /// Brings a machine into a state.
    struct Setup(Machine);

    impl Setup {
        fn command(&mut self, command: Command, inputs: RigInputs) {
            let now = now(0, 0, inputs);
            let actions = self.0.step(&now, Event::Command(&command));
            assert_eq!(actions.refusal, None);
        }

        fn event(&mut self, event: Event) {
            self.0.step(&now(0, 0, CLOSED), event);
        }

        fn ended(&mut self, position: i32) {
            self.event(path_ended(PathEnd::Stopped, position, position));
        }

        fn flag(&mut self, opening: bool, count: i32) {
            self.event(flag_edge(opening, count));
        }

        /// Homes from on the flag up to the beginning of a phase, to its edge, or to the end.
        fn home(&mut self, start: Start) {
            let phases: [Phase; 8] = [
                (Clear, |setup| setup.command(Command::Home, ON_FLAG)),
                (Seek, |setup| setup.off_the_flag(20)),
                (SeekFound, |setup| setup.flag(true, 10)),
                (PullOff, |setup| setup.ended(0)),
                (Locate, |setup| setup.off_the_flag(2_410)),
                (LocateFound, |setup| setup.flag(true, 10)),
                (ToZero, |setup| setup.ended(5)),
                (Ready, |setup| setup.ended(0)),
            ];
            for (phase, begin) in phases {
                begin(self);
                if phase == start {
                    return;
                }
            }
        }

        fn off_the_flag(&mut self, position: i32) {
            self.flag(false, 10);
            self.ended(position);
        }

        fn first_stroke(&mut self) {
            self.event(stroke_done(0, 8_000, 8_000));
        }

        fn hold(&mut self, at: i32) {
            self.command(Command::Hold, CLOSED);
            self.ended(at);
        }
    }

    fn reach(start: Start) -> Machine {
        let panic = (start == Panicked).then_some(RigFault::Panic);
        let mut setup = Setup(Machine::new(SETTINGS, panic, 0));
        let policy = if start == Finish {
            LinkLossPolicy::Finish
        } else {
            LinkLossPolicy::Stop
        };
        let run = run(&SETTINGS, 1, 10_000, policy);
        match start {
            Unhomed | Panicked => {}
            Faulted => setup.event(Event::FarLimit),
            HomingByButton => setup.command(Command::Button(None), CLOSED),
            FaultedMoving => {
                setup.home(Seek);
                setup.event(Event::FarLimit);
            }
            StopHoming => {
                setup.home(Seek);
                setup.command(Command::Stop, CLOSED);
            }
            Clear | Seek | SeekFound | PullOff | Locate | LocateFound | ToZero | Ready => {
                setup.home(start);
            }
            ReadyOut | Moving | Jogging | StopMove => {
                setup.home(Ready);
                if start == Jogging {
                    setup.command(jog(Direction::Away), ON_FLAG);
                } else {
                    setup.command(move_to(4_000), ON_FLAG);
                }
                match start {
                    ReadyOut => setup.ended(4_000),
                    StopMove => setup.command(Command::Stop, CLOSED),
                    _ => {}
                }
            }
            Away | Finish | StopRun | StopHoldOut | HeldFirst | HeldOut | FaultedHeld => {
                setup.home(Ready);
                setup.command(run, ON_FLAG);
                match start {
                    StopRun => setup.command(Command::Stop, ON_FLAG),
                    StopHoldOut => setup.command(Command::Hold, ON_FLAG),
                    HeldFirst => setup.hold(0),
                    HeldOut | FaultedHeld => setup.hold(4_000),
                    _ => {}
                }
                if start == FaultedHeld {
                    setup.event(Event::FarLimit);
                }
            }
            Back | BackMet | StopBack | StopMet | StopLost | StopHoldBack | StopHoldMet
            | HeldBack | HeldMet => {
                setup.home(Ready);
                setup.command(run, ON_FLAG);
                setup.first_stroke();
                match start {
                    BackMet | StopMet | StopHoldMet | HeldMet => setup.flag(true, 800),
                    StopLost => setup.flag(true, 700),
                    _ => {}
                }
                match start {
                    StopBack | StopMet => setup.command(Command::Stop, CLOSED),
                    StopHoldBack | StopHoldMet => setup.command(Command::Hold, CLOSED),
                    HeldBack => setup.hold(4_000),
                    HeldMet => setup.hold(500),
                    _ => {}
                }
            }
        }
        setup.0
    }

    /// Where the carriage stands, where that matters.
    fn position(start: Start, input: Input) -> i32 {
        let position = match start {
            ReadyOut | HeldOut | HeldBack => 4_000,
            HeldMet => 500,
            _ => 0,
        };
        position + i32::from(matches!(input, ResumeElsewhere | StopElsewhere))
    }

    /// The flag is open at 0, where that matters.
    fn inputs(start: Start, input: Input) -> RigInputs {
        match input {
            Run | JogSame | JogOther | MoveTo | Button if start == Ready => ON_FLAG,
            _ => CLOSED,
        }
    }

    /// The next state and the actions, or the refusal.
    fn outcome(start: Start, input: Input) -> String {
        let mut machine = reach(start);
        let before = machine.fault();
        let (time_us, event) = sample(input);
        let now = now(time_us, position(start, input), inputs(start, input));
        let actions = machine.step(&now, event);
        let after = match machine.fault() {
            Some(fault) if before.is_none() => format!("{fault:?}"),
            _ => format!("{:?}", machine.state()),
        };
        if let Some(refusal) = actions.refusal {
            return format!("{after}: {refusal:?}");
        }
        let starts = actions.list.iter().find_map(|action| match action {
            Action::Start { window, .. } => Some(window),
            _ => None,
        });
        let mut text = [&[after.as_str()][..], &kinds(&actions)].concat().join(" ");
        if let Some(Window { first, last }) = starts {
            text += &format!(" {}..{}", first.0, last.0);
        }
        text
    }
    const READY: &[Start] = &[Ready, ReadyOut];
    const HELD: &[Start] = &[HeldFirst, HeldOut, HeldBack, HeldMet];
    /// Homing on request of the host.
    const BY_HOST: &[Start] = &[Clear, Seek, SeekFound, PullOff, Locate, LocateFound, ToZero];
    const FINE_ENDS: &[Input] = &[
        Complete,
        Stopped,
        StoppedFar,
        StoppedNear,
        StoppedAtLimit,
        StoppedBehind,
    ];
    /// Only a command starts something, only where the rig is at rest and not faulted, and without a reference only
    /// homing. Only homing continues by itself.
    fn may_start(start: Start, input: Input) -> bool {
        match input {
            Home | Button | ButtonNoPlan if start == Unhomed => true,
            Home | Run | JogSame | JogOther | MoveTo => READY.contains(&start),
            MoveOffFlag => start == ReadyOut,
            Button | ButtonNoPlan => READY.contains(&start) || HELD.contains(&start),
            Resume => HELD.contains(&start),
            _ => BY_HOST.contains(&start) && FINE_ENDS.contains(&input),
        }
    }

    /// No arm for "everything else": a new command or event has to be added here, and then to the inputs.
    const fn is_among_the_inputs(event: &Event) -> bool {
        match event {
            Event::Command(
                Command::Home
                | Command::Run { .. }
                | Command::Hold
                | Command::Resume
                | Command::Jog { .. }
                | Command::MoveTo { .. }
                | Command::Button(_)
                | Command::Stop
                | Command::EStop
                | Command::Acknowledge,
            )
            | Event::FlagEdge { .. }
            | Event::FarLimit
            | Event::SwitchNoise(_)
            | Event::LoopOpened
            | Event::StrokeDone { .. }
            | Event::PathEnded(
                PathEnd::Complete
                | PathEnd::Stopped
                | PathEnd::Cut
                | PathEnd::Underrun
                | PathEnd::Guard,
                _,
            )
            | Event::LinkSilent
            | Event::Tick => true,
        }
    }

    /// Each state with its outcomes: the next state, or the new fault, with the actions or the refusal.
    #[test]
    fn every_pair_of_state_and_input_has_its_outcome() {
        let mut table = String::new();
        for &start in STARTS {
            table += &format!("{start:?} ({:?})\n", reach(start).state());
            let mut outcomes: Vec<(String, Vec<Input>)> = Vec::new();
            for &input in INPUTS {
                assert!(is_among_the_inputs(&sample(input).1));
                let outcome = outcome(start, input);
                if outcome.contains(" Start ") {
                    assert!(may_start(start, input), "{start:?} {input:?}");
                }
                match outcomes.iter_mut().find(|(seen, _)| *seen == outcome) {
                    Some((_, inputs)) => inputs.push(input),
                    None => outcomes.push((outcome, vec![input])),
                }
            }
            for (outcome, inputs) in outcomes {
                table += &format!("    {outcome} <- {inputs:?}\n");
            }
        }
        insta::assert_snapshot!("states_and_inputs", table);
    }
}
