//! The rig's limit switches: a real opening stops the rig, a disturbance does not.

use crate::common::{Dice, RigRun, exact, faulted, paper, quick, quickly_homed, trials};
use protocol::rig::{GetRigHealth, RigFault, RunOutcome};
use virtual_bench::{
    faults::When,
    plants::rig::{Action, Switch},
};

/// 50 us from the contact, plus the step in progress (at most 35 us at the paper's speed).
const STOP_LIMIT_NS: u64 = 50_000 + 35_100;

const OPENS: Action = Action::Stick(Switch::Far, Some(true));

#[test]
fn the_far_limit_ends_the_pulses_within_50_us() {
    let mut dice = Dice(0x5EED_0004);
    let mut rig = quickly_homed();
    for trial in 0..10 {
        let number = rig.plan_at(dice.roll(1_000..103_000), OPENS);
        let what = format!("trial {trial}");
        let took_ns = runs_on_ns(&mut rig, number, &what);
        assert!(took_ns <= STOP_LIMIT_NS, "{what}: {took_ns} ns");
        // The read-back counter knows where it stopped, to the step.
        rig.position_is_right_but_not_trusted(&what);
        rig.act(Action::Stick(Switch::Far, None));
        rig.recover(&what);
    }
    rig.check_clean(0);
}

/// A run in which the far limit opens at this edge: the time from there to its last step, ns.
fn runs_on_ns(rig: &mut RigRun, number: u64, what: &str) -> u64 {
    faulted(rig, paper(1), RigFault::FarLimit, what);
    let edges = rig.edges(number as usize - 1);
    let opened = edges.iter().next().expect("the edge of the fault");
    rig.last_edge_ns() - opened.at_ns
}

/// Nothing is wrong with an open far limit while the carriage goes home: it comes from there. Where it turns it is.
#[test]
fn a_far_limit_that_opens_on_the_way_home_ends_the_run_at_the_turn() {
    let mut rig = quickly_homed();
    let first = rig.edge_count() as u64;
    rig.plan_at(12_000, OPENS);
    let run = quick(2, 10_000, 20_000, 500_000);
    faulted(&mut rig, run, RigFault::FarLimit, "at the turn");
    assert_eq!(rig.edge_count() as u64, first + 16_000, "it went on");
    rig.check_clean(0);
}

/// Noise has masked the line, and then the limit really opens.
#[test]
fn a_masked_far_limit_ends_the_pulses_within_2_ms() {
    let mut dice = Dice(0x5EED_0005);
    let mut rig = quickly_homed();
    let mut longest_ns = 0;
    for trial in 0..10 {
        // In the cruise, where motion has the least to do.
        let within = dice.roll(20_000..80_000);
        for noise in 0..6 {
            rig.plan_at(within + noise * 2, Action::Disturb(Switch::Far, 5_000));
        }
        let number = rig.plan_at(within + 12, OPENS);
        let what = format!("trial {trial}");
        longest_ns = longest_ns.max(runs_on_ns(&mut rig, number, &what));
        rig.act(Action::Stick(Switch::Far, None));
        rig.recover(&what);
    }
    assert!(longest_ns > STOP_LIMIT_NS, "never masked: {longest_ns} ns");
    assert!(longest_ns < 2_000_000, "{longest_ns} ns");
}

/// Disturbances of 19 us on both switches, a thousand per second each, for the paper's whole run. Their phase to the
/// firmware's millisecond drifts, so other interrupts fall into every part of them.
#[test]
fn disturbances_of_19_us_never_stop_a_run_and_are_all_counted() {
    let cycles: u16 = trials(1, 5);
    let each = u64::from(cycles) * 7_900;
    let mut rig = quickly_homed();
    let first = rig.edge_count();
    let start_ns = rig.bench.now_ns() + 100_000_000;
    rig.with(move |rig| {
        for number in 0..each {
            let at = start_ns + number * 1_000_370;
            let [far, home] = [Switch::Far, Switch::Home].map(|at| Action::Disturb(at, 19_000));
            rig.plan(When::At(at), far);
            rig.plan(When::At(at + 500_000), home);
        }
    });
    let accepted = rig.device.run(paper(cycles)).expect("the run is accepted");
    let record = rig.ended(&accepted);
    assert_eq!(record.outcome, RunOutcome::Complete, "{}", rig.log());
    rig.is_exact(&exact(cycles), first);
    assert_eq!(u64::from(record.glitches), 2 * each);
    rig.check_clean(0);
}

/// A switch that is pressed and released for good is no disturbance.
#[test]
fn a_far_limit_that_is_pressed_by_hand_is_no_false_pulse() {
    let mut rig = quickly_homed();
    let before = rig.device.call(GetRigHealth).expect("it answers").far_limit;
    for open in [true, false, true, false, true, false] {
        rig.act(Action::Stick(Switch::Far, Some(open)));
        rig.idle(20_000);
    }
    let after = rig.device.call(GetRigHealth).expect("it answers").far_limit;
    assert_eq!((after.count, after.masked), (before.count, before.masked));
    rig.check_clean(0);
}
