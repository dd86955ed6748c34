//! The rig's limit switches: a real opening stops the rig, a disturbance does not.

use client::Unobserved;
use client::error::ClientError;

use crate::common::{
    Dice, LIMIT_NS, exact, execute, faulted, home_quickly, paper, quick, quickly_homed, rig_with,
    trials,
};
use protocol::{
    error::Refusal,
    rig::{Direction, GetRigHealth, HomingPhase, Jog, MoveTo, RigFault, RigState, RunOutcome},
    settings::{Setting, SettingKey},
};
use virtual_bench::{
    faults::When,
    plants::rig::{Action, RigOptions, Switch},
    verdicts::Verdict,
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

/// A step of the second pass of a quick homing from 8,000 steps: that pass begins 1 mm before the flag, after the 7,200
/// steps of the first one, its brake, and the way back.
const IN_THE_LOCATING_PASS: u64 = 10_200;

/// A pulse that outlasts the filter, in either pass; over when the carriage stands, or later.
#[test]
fn a_false_flag_is_no_reference() {
    for (pass, edge, for_ns) in [
        (HomingPhase::Seek, 4_000, 60_000),
        (HomingPhase::Locate, IN_THE_LOCATING_PASS, 60_000),
        (HomingPhase::Locate, IN_THE_LOCATING_PASS, 40_000_000),
    ] {
        let mut rig = rig_with(RigOptions {
            carriage: 8_000,
            ..RigOptions::default()
        });
        home_quickly(&mut rig);
        rig.look(move |rig| {
            rig.plan(When::Edge(edge), Action::Disturb(Switch::Home, for_ns));
        });
        let accepted = rig.device.home().expect("accepted");
        let ended = rig.device.wait_homing(&accepted, &mut Unobserved);
        let status = rig.device.rig_status().expect("it answers");
        let fault = Some(RigFault::FlagNotFound(pass));
        assert_eq!(status.fault, fault, "{ended:?}");
        assert!(!status.homed);
        rig.check_clean(0);
    }
}

/// A switch that closes late stays open over a stroke of 2 mm, which is 1 mm beyond its edge. A longer one has to meet it.
#[test]
fn a_stroke_that_turns_before_the_flag_closes_loses_no_steps() {
    let mut rig = quickly_homed();
    rig.act(Action::Stick(Switch::Home, Some(true)));
    let (_, record) = execute(&mut rig, quick(1, 2_000, 10_000, 500_000));
    assert_eq!(record.outcome, RunOutcome::Complete);
    let lost = RigFault::LostSteps {
        residual_steps: -800,
    };
    faulted(&mut rig, quick(1, 2_100, 10_000, 500_000), lost, "2.1 mm");
    rig.check_clean(0);
}

/// The step times of the seek do not fit the exact arithmetic of so fine an axis.
#[test]
fn a_homing_that_is_too_slow_is_refused_before_it_moves() {
    let mut rig = crate::common::rig();
    for (key, value) in [
        (SettingKey::SeekUmS, 100),
        (SettingKey::LocateUmS, 100),
        (SettingKey::LeadUm, 500),
        (SettingKey::FullSteps, 400),
        (SettingKey::Microsteps, 256),
    ] {
        rig.device.call(Setting { key, value }).expect("accepted");
    }
    match rig.device.home() {
        Err(ClientError::Refused { refusal, .. }) => assert_eq!(refusal, Refusal::TooSlow),
        other => panic!("{other:?}"),
    }
    let status = rig.device.rig_status().expect("a status");
    assert_eq!((status.state, status.fault), (RigState::Unhomed, None));
    assert_eq!(rig.edge_count(), 0);
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

/// A noisy flag is found on the way and is closed again when the carriage stands. From there a homing goes away from home.
#[test]
fn a_homing_does_not_go_toward_a_far_limit_that_opened_in_it() {
    for (pass, edge) in [("seek", 4_000), ("locate", IN_THE_LOCATING_PASS)] {
        let mut rig = rig_with(RigOptions {
            carriage: 8_000,
            ..RigOptions::default()
        });
        home_quickly(&mut rig);
        rig.look(move |rig| {
            rig.plan(When::Edge(edge), Action::Disturb(Switch::Home, 60_000));
            rig.plan(When::Edge(edge), Action::Stick(Switch::Far, Some(true)));
        });
        let accepted = rig.device.home().expect("accepted");
        let ended = rig.device.wait_homing(&accepted, &mut Unobserved);
        let fault = rig.device.rig_status().expect("it answers").fault;
        assert_eq!(fault, Some(RigFault::FarLimit), "{pass}: {ended:?}");
        let away = rig
            .edges(edge as usize)
            .iter()
            .filter(|edge| edge.away)
            .count();
        assert_eq!(away, 0, "{pass}: it went away from home");
        rig.check_clean(0);
    }
}

/// With an open far limit the only way is home. That is a refusal and no fault: nothing has happened.
#[test]
fn nothing_moves_toward_an_open_far_limit() {
    let mut rig = quickly_homed();
    let to = |position_um| MoveTo {
        position_um,
        speed_um_s: 10_000,
    };
    rig.device.call(to(5_000)).expect("accepted");
    rig.idle(1_500_000);
    let edges = rig.edge_count();
    rig.act(Action::Stick(Switch::Far, Some(true)));
    rig.idle(100_000);
    let jog = Jog {
        sense: Direction::Away,
        speed_um_s: 10_000,
    };
    for refused in [
        rig.device.call(to(6_000)).map(drop),
        rig.device.call(jog).map(drop),
    ] {
        match refused {
            Err(ClientError::Refused { refusal, .. }) => {
                assert_eq!(refusal, Refusal::FarLimitOpen);
            }
            other => panic!("{other:?}\n{}", rig.log()),
        }
    }
    assert_eq!(rig.edge_count(), edges, "it moved");
    assert_eq!(rig.device.rig_status().expect("a status").fault, None);
    rig.device.call(to(4_000)).expect("away from it");
    rig.idle(1_500_000);
    assert_eq!(rig.edge_count(), edges + 800);
    rig.check_clean(0);
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
    let record = rig
        .device
        .wait_run(&accepted, &mut Unobserved)
        .expect("the run ends");
    assert_eq!(record.outcome, RunOutcome::Complete, "{}", rig.log());
    Verdict::of(&exact(cycles), &rig.edges(first))
        .check(LIMIT_NS)
        .unwrap_or_else(|why| panic!("{why}"));
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

#[test]
fn both_switches_open_is_an_unplugged_cable() {
    let mut rig = crate::common::rig();
    let now_ns = rig.bench.now_ns();
    rig.look(move |rig| {
        rig.act(Action::Stick(Switch::Far, Some(true)), now_ns);
        rig.act(Action::Stick(Switch::Home, Some(true)), now_ns);
    });
    rig.idle(10_000);
    match rig.device.home() {
        Err(ClientError::Refused { refusal, .. }) => {
            assert_eq!(refusal, Refusal::BothSwitchesOpen);
        }
        other => panic!("{other:?}"),
    }
    assert_eq!(rig.edge_count(), 0);
}
