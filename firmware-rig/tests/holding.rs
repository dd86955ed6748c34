//! Feed hold: wherever a hold comes, the resumed run makes exactly the planned steps, each of them once.

use firmware_rig::{
    machine::{Command, Event},
    settings::Settings,
};
use motion::{
    run::{RunPlan, RunRequest, Timing},
    units::Micrometres,
};
use protocol::{
    error::Refusal,
    rig::{LinkLossPolicy, RigEvent, RigFault, RigState, RunOutcome},
    settings::SettingKey,
};
use simulated_machines::carriage::{Rig, flag_edge, plan, settings};

const SETTINGS: Settings = Settings::REFERENCE;

/// Steps of a stroke of 5 mm.
const STROKE: u64 = 4_000;

/// Two cycles of 5 mm at 20 mm/s with 1,000 mm/s2, 5 ms of dwell at each end: 4 strokes of 4,000 steps.
fn slow() -> RunPlan {
    plan(&SETTINGS, 2, 5_000, 20_000)
}

fn started(plan: RunPlan) -> Rig {
    let mut rig = Rig::homed(SETTINGS);
    let link_loss = LinkLossPolicy::Stop;
    rig.command(Command::Run { plan, link_loss }).unwrap();
    rig
}

/// Holds now and comes to rest.
fn hold(rig: &mut Rig) {
    rig.command(Command::Hold).unwrap();
    assert_eq!(rig.machine.state(), RigState::Stopping);
    rig.finish();
}

/// Waits at rest for a while: nothing moves, and a silent host does not matter.
fn stand(rig: &mut Rig) {
    let pulses = rig.pulses;
    rig.wait(100_000_000_000);
    rig.event(Event::LinkSilent);
    rig.finish();
    assert_eq!((rig.pulses, rig.machine.state()), (pulses, RigState::Held));
    assert!(rig.machine.homed());
}

/// Checks that the run went as planned, apart from the holds.
fn assert_complete(rig: &Rig, plan: &RunPlan, holds: u32) {
    assert_eq!(rig.machine.record().holds, holds);
    assert_complete_and_resumed(rig, plan, holds);
}

/// The same, where a last hold may have come too late to be resumed.
fn assert_complete_and_resumed(rig: &Rig, plan: &RunPlan, resumed: u32) {
    assert_eq!(rig.fault(), None);
    assert_eq!(rig.machine.state(), RigState::Ready);
    assert_eq!((rig.place, rig.ring.counted), (0, 0));
    assert_eq!(rig.pulses, plan.edges());
    let record = rig.machine.record();
    assert_eq!(record.outcome, RunOutcome::Complete);
    assert_eq!(record.strokes, plan.strokes());
    assert_eq!(record.commanded_edges, plan.edges());
    assert_eq!(record.counted_edges, plan.edges());
    assert_eq!((record.min_steps, record.worst_residual_steps), (0, 0));
    assert_eq!(record.max_steps as u32, plan.forward().steps().0);
    assert!((resumed..=resumed + 1).contains(&record.holds));
    assert_eq!(record.plan_hash, plan.hash());
    let strokes: Vec<_> = rig
        .events
        .iter()
        .filter_map(|event| match event {
            RigEvent::StrokeDone {
                stroke,
                residual_steps,
            } => Some((*stroke, *residual_steps)),
            _ => None,
        })
        .collect();
    let all: Vec<_> = (0..plan.strokes()).map(|stroke| (stroke, 0)).collect();
    assert_eq!(strokes, all, "each stroke is reported once");
    let count = |wanted: RigEvent| rig.events.iter().filter(|event| **event == wanted).count();
    assert_eq!(count(RigEvent::Resumed), resumed as usize);
    let (run, outcome) = (1, RunOutcome::Complete);
    assert_eq!(count(RigEvent::RunEnded { run, outcome }), 1);
}

/// In the ramps, in cruise, at the first and last steps of strokes, around the flag (step 800) in both directions.
#[test]
fn a_run_held_anywhere_completes_as_planned() {
    let plan = slow();
    let mut held_at_an_end = 0;
    for stroke in 0..4 {
        let flag = STROKE - 800;
        for step in [
            0,
            1,
            2,
            3,
            50,
            400,
            795,
            800,
            801,
            2_000,
            3_000,
            flag - 170,
            flag - 161,
            flag - 160,
            flag - 8,
            flag - 1,
            flag,
            flag + 1,
            flag + 9,
            3_800,
            3_998,
            3_999,
        ] {
            let mut rig = started(plan);
            rig.pulses(stroke * STROKE + step);
            hold(&mut rig);
            let last_stroke = stroke == 3 && rig.pulses == plan.edges();
            if last_stroke {
                // It came to rest at the run's end: there is nothing to resume.
                assert_complete(&rig, &plan, 0);
                assert_eq!(rig.command(Command::Resume), Err(Refusal::NothingToResume));
                continue;
            }
            let position_steps = rig.ring.counted;
            assert_eq!(rig.events.last(), Some(&RigEvent::Held { position_steps }));
            assert_eq!(rig.place, rig.ring.counted);
            assert_eq!(u64::from(rig.machine.record().strokes), rig.pulses / STROKE);
            held_at_an_end += u32::from(rig.pulses.is_multiple_of(STROKE));
            stand(&mut rig);
            rig.command(Command::Resume).unwrap();
            rig.finish();
            assert_complete(&rig, &plan, 1);
            assert!(rig.windows.iter().all(|window| *window == (0, 104_000)));
        }
    }
    // Between the strokes, and where a ramp ended there by itself.
    assert!(held_at_an_end >= 10, "{held_at_an_end}");
}

/// A hold that comes too late to stop before the run's end counts if it changed the times, and only then. With and
/// without a hold before it.
#[test]
fn a_late_hold_counts_if_it_changed_the_times() {
    let gentle = settings(&[(SettingKey::StopAccelUmS2, 100_000)]);
    let mut seen = [0; 2];
    for early in [1, 10, 100, 159, 165, 200, 500, 1_000, 1_500] {
        for before in [false, true] {
            let plan = plan(&gentle, 1, 5_000, 20_000);
            let mut rig = Rig::homed(gentle);
            let link_loss = LinkLossPolicy::Stop;
            rig.command(Command::Run { plan, link_loss }).unwrap();
            let mut ticks = plan.total().0;
            if before {
                rig.pulses(1_000);
                hold(&mut rig);
                rig.command(Command::Resume).unwrap();
                // The same without the late one.
                let mut other = Rig::homed(gentle);
                other.command(Command::Run { plan, link_loss }).unwrap();
                other.pulses(1_000);
                hold(&mut other);
                other.command(Command::Resume).unwrap();
                other.finish();
                ticks = other.machine.record().ticks;
            }
            rig.pulses(plan.edges() - early - rig.pulses);
            hold(&mut rig);
            let record = rig.machine.record();
            let changed = record.ticks != ticks;
            seen[usize::from(changed)] += 1;
            assert_eq!(
                (record.outcome, rig.pulses),
                (RunOutcome::Complete, plan.edges())
            );
            let holds = u32::from(before) + u32::from(changed);
            assert_eq!(record.holds, holds, "{early} steps before the end");
        }
    }
    assert!(seen.iter().all(|times| *times >= 4), "{seen:?}");
}

/// In the start delay, and in every piece of a dwell: before the turn and after it.
#[test]
fn a_run_held_at_rest_completes_as_planned() {
    let request = RunRequest {
        cycles: 2,
        stroke_um: 5_000,
        timing: Timing::Speeds {
            forward_um_s: 20_000,
            return_um_s: 40_000,
            accel_um_s2: 1_000_000,
        },
        far_dwell_us: 20_000,
        home_dwell_us: 30_000,
        start_delay_us: 50_000,
    };
    let plan = RunPlan::solve(&SETTINGS.axis, &SETTINGS.limits, &request).unwrap();
    for strokes in 0..4 {
        let mut pieces = 0;
        loop {
            let mut rig = started(plan);
            rig.pulses(strokes * STROKE);
            for _ in 0..pieces {
                rig.step();
            }
            if rig.pulses > strokes * STROKE {
                break;
            }
            hold(&mut rig);
            assert_eq!(rig.pulses, strokes * STROKE);
            assert_eq!(rig.machine.record().strokes as u64, strokes);
            stand(&mut rig);
            rig.command(Command::Resume).unwrap();
            let (from, first) = (rig.now, rig.pulses + 1);
            rig.pulses(1);
            assert_eq!(rig.pulses, first);
            // It starts at once with the stroke's first step; a delay or dwell is not repeated.
            let next = plan.stroke(strokes as u32).unwrap();
            assert_eq!(rig.last_pulse - from, next.first_interval().0);
            rig.finish();
            assert_complete(&rig, &plan, 1);
            pieces += 1;
        }
        assert!(pieces >= 4, "{pieces}");
    }
}

#[test]
fn a_run_held_again_and_again_completes_as_planned() {
    let plan = slow();
    for every in [1, 7, 130, 801, 1_999, 3_997] {
        let mut rig = started(plan);
        let mut holds = 0;
        loop {
            rig.pulses(every);
            if !rig.moving() {
                break;
            }
            hold(&mut rig);
            if rig.machine.state() == RigState::Ready {
                break;
            }
            holds += 1;
            rig.command(Command::Resume).unwrap();
        }
        assert!(holds >= 3, "{every}: {holds}");
        assert_complete_and_resumed(&rig, &plan, holds);
    }
}

/// The record's ticks are those of the generator: longer than planned by the ramps of the hold, no more.
#[test]
fn the_pause_is_not_in_the_record() {
    let plan = slow();
    let mut rig = started(plan);
    rig.pulses(2_000);
    hold(&mut rig);
    stand(&mut rig);
    rig.command(Command::Resume).unwrap();
    rig.finish();
    // Down from 20 mm/s in 20 ms and up again in 20 ms over 0.2 mm each, which take 10 ms each at that speed.
    let longer = rig.machine.record().ticks - plan.total().0;
    assert!((1_990_000..=2_020_000).contains(&longer), "{longer}");
}

#[test]
fn the_button_resumes_and_the_policy_of_the_run_stays() {
    let mut rig = started(slow());
    rig.pulses(5_000);
    hold(&mut rig);
    rig.command(Command::Button(None)).unwrap();
    assert_eq!(rig.machine.state(), RigState::Running);
    rig.pulses(100);
    rig.event(Event::LinkSilent);
    rig.finish();
    assert_eq!(rig.machine.record().outcome, RunOutcome::LinkLost);
    assert_eq!(rig.machine.state(), RigState::Ready);
}

/// A stop while the hold is still braking: one ramp, then the run is over.
#[test]
fn a_stop_during_a_hold_wins() {
    let mut rig = started(slow());
    rig.pulses(2_000);
    let begun = rig.pulses + rig.queued();
    rig.command(Command::Hold).unwrap();
    rig.pulses(20);
    rig.command(Command::Stop).unwrap();
    rig.finish();
    assert_eq!(rig.machine.state(), RigState::Ready);
    assert_eq!(rig.machine.record().outcome, RunOutcome::Stopped);
    assert_eq!(rig.machine.record().holds, 0);
    let braking = rig.pulses - begun;
    assert_eq!(braking, 161, "0.2 mm of braking, as without the stop");
}

/// A resume reads the switches; a refused one can be repeated.
#[test]
fn a_resume_with_an_open_switch_is_refused() {
    let mut rig = started(slow());
    rig.pulses(2_000);
    hold(&mut rig);
    (rig.pressed, rig.far_wire_cut) = (true, true);
    for command in [Command::Resume, Command::Button(None)] {
        assert_eq!(rig.command(command), Err(Refusal::LoopOpen));
    }
    rig.pressed = false;
    assert_eq!(rig.command(Command::Resume), Err(Refusal::FarLimitOpen));
    rig.far_wire_cut = false;
    assert_eq!(rig.machine.state(), RigState::Held);
    rig.command(Command::Resume).unwrap();
    rig.finish();
    assert_complete(&rig, &slow(), 1);
}

/// Steps lost before, in and after a hold; the hold before, across and behind the flag (step 800 of the way home,
/// which at this speed takes 160 steps of braking).
#[test]
fn lost_steps_are_found_across_a_hold() {
    for at in [100, 2_000, 3_100, 3_199, 3_300, 3_500] {
        for slipping in [9, 64, 2_000] {
            for lost_at in [1_000, STROKE + 10, STROKE + at] {
                let mut rig = started(slow());
                rig.pulses(lost_at.min(STROKE + at));
                rig.slipping = slipping;
                rig.pulses(STROKE + at - lost_at);
                if rig.machine.state() != RigState::Running {
                    continue; // found before the hold
                }
                let _ = rig.command(Command::Hold);
                rig.finish();
                if rig.machine.state() == RigState::Held {
                    rig.command(Command::Resume).unwrap();
                    rig.finish();
                }
                let context = format!("held at {at}, {slipping} lost at {lost_at}");
                assert!(
                    matches!(rig.fault(), Some(RigFault::LostSteps { .. })),
                    "{context}: {:?}",
                    rig.machine.record()
                );
                assert!(!rig.machine.homed());
            }
        }
    }
}

/// The carriage rests at the edge of the flag, where the step-loss check tolerates the flag open or closed. If the
/// carriage stalls from there on, it never meets the flag.
#[test]
fn a_flag_that_is_not_met_after_a_hold_is_lost_steps() {
    let flag = SETTINGS.flag.0;
    let mut seen = std::collections::BTreeSet::new();
    // Equal periods are queued together and no stop begins within them. So a single stroke does not come to rest at
    // every step; several do.
    for (stroke_um, early) in (5_000..5_040).flat_map(|um| [(um, 160), (um, 170), (um, 180)]) {
        let mut rig = started(plan(&SETTINGS, 1, stroke_um, 20_000));
        let steps = SETTINGS.axis.steps_within(Micrometres(stroke_um));
        let stroke = u64::from(steps.unwrap().0);
        rig.pulses(2 * stroke - 800 - early);
        hold(&mut rig);
        let held_at = rig.ring.counted;
        let opened = held_at <= flag;
        seen.insert(held_at);
        rig.command(Command::Resume).unwrap();
        rig.slipping = u32::MAX;
        rig.finish();
        let lost = matches!(rig.fault(), Some(RigFault::LostSteps { .. }));
        assert_eq!(lost, !opened, "held at {held_at}");
    }
    for place in flag - 11..=flag + 13 {
        assert!(seen.contains(&place), "never held at {place}: {seen:?}");
    }
}

/// The flag opens at the carriage's place, a moment after it came to rest: that counts. An opening farther away means
/// that someone moved the carriage: that does not count.
#[test]
fn a_flag_that_opens_at_rest_is_met() {
    for (count, outcome) in [
        (805, RunOutcome::Complete),
        (
            809,
            RunOutcome::Faulted(RigFault::LostSteps {
                residual_steps: -800,
            }),
        ),
    ] {
        let mut rig = started(plan(&SETTINGS, 1, 5_000, 20_000));
        rig.pulses(STROKE + 3_000);
        hold(&mut rig);
        assert!(rig.ring.counted > 805);
        rig.event(flag_edge(true, count));
        assert_eq!(rig.machine.state(), RigState::Held);
        rig.command(Command::Resume).unwrap();
        rig.stuck_flag = Some(false); // no further edge
        rig.finish();
        assert_eq!(rig.machine.record().outcome, outcome);
    }
}
