//! The rig's limit switches: a real opening stops the rig, a disturbance does not.

use crate::common::{Dice, exact, faulted, paper, quick, quickly_homed, trials};
use protocol::rig::{GetRigHealth, RigFault, RunOutcome};
use virtual_bench::{
    faults::When,
    plants::rig::{Action, Switch},
};

/// 50 us from the contact, plus the step in progress (at most 35 us at the paper's speed).
const STOP_LIMIT_NS: u64 = 50_000 + 35_100;

#[test]
fn the_far_limit_ends_the_pulses_within_50_us() {
    let mut dice = Dice(0x5EED_0004);
    let mut rig = quickly_homed();
    for trial in 0..10 {
        let number = rig.edge_count() as u64 + dice.roll(1_000..103_000);
        rig.look(move |rig| rig.plan(When::Edge(number), Action::Stick(Switch::Far, Some(true))));
        let what = format!("trial {trial}");
        faulted(&mut rig, paper(1), RigFault::FarLimit, &what);
        let edges = rig.edges(number as usize - 1);
        let opened = edges.iter().next().expect("the edge of the fault").at_ns;
        let last = edges.iter().next_back().expect("the last edge").at_ns;
        assert!(
            last - opened <= STOP_LIMIT_NS,
            "trial {trial}: {} ns",
            last - opened
        );
        // The read-back counter knows where it stopped, to the step.
        rig.position_is_right_but_not_trusted(&what);
        rig.act(Action::Stick(Switch::Far, None));
        rig.device.acknowledge().expect("it can be acknowledged");
        rig.home();
    }
    rig.check_clean(0);
}

/// Nothing is wrong with an open far limit while the carriage goes home: it comes from there. Where it turns it is.
#[test]
fn a_far_limit_that_opens_on_the_way_home_ends_the_run_at_the_turn() {
    let mut rig = quickly_homed();
    let first = rig.edge_count() as u64;
    let edge = When::Edge(first + 12_000);
    rig.look(move |rig| rig.plan(edge, Action::Stick(Switch::Far, Some(true))));
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
        let number = rig.edge_count() as u64 + dice.roll(20_000..80_000);
        rig.look(move |rig| {
            for noise in 0..6 {
                let edge = When::Edge(number + noise * 2);
                rig.plan(edge, Action::Disturb(Switch::Far, 5_000));
            }
            rig.plan(
                When::Edge(number + 12),
                Action::Stick(Switch::Far, Some(true)),
            );
        });
        faulted(
            &mut rig,
            paper(1),
            RigFault::FarLimit,
            &format!("trial {trial}"),
        );
        let edges = rig.edges(number as usize + 11);
        let opened = edges.iter().next().expect("the edge of the fault").at_ns;
        let last = edges.iter().next_back().expect("the last edge").at_ns;
        longest_ns = longest_ns.max(last - opened);
        rig.act(Action::Stick(Switch::Far, None));
        rig.device.acknowledge().expect("it can be acknowledged");
        rig.home();
    }
    assert!(
        longest_ns > STOP_LIMIT_NS,
        "it was never masked: {longest_ns}"
    );
    assert!(longest_ns < 2_000_000, "{longest_ns} ns");
}

/// Disturbances of 19 us on both switches, a thousand per second each, for the paper's whole run. Their phase to the
/// firmware's millisecond drifts, so other interrupts fall into every part of them.
#[test]
fn disturbances_of_19_us_never_stop_a_run_and_are_all_counted() {
    let cycles: u16 = trials(2, 5);
    let each = u64::from(cycles) * 7_900;
    let mut rig = quickly_homed();
    let first = rig.edge_count();
    let start_ns = rig.bench.now_ns() + 100_000_000;
    rig.look(move |rig| {
        for number in 0..each {
            let at = start_ns + number * 1_000_370;
            rig.plan(When::At(at), Action::Disturb(Switch::Far, 19_000));
            rig.plan(
                When::At(at + 500_000),
                Action::Disturb(Switch::Home, 19_000),
            );
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
