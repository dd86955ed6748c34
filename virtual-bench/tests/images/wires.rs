//! Cut wires, welded and bouncing contacts, each on an otherwise working rig.

use client::Unobserved;
use client::error::ClientError;

use crate::common::{RigRun, execute, home_quickly, quick, quickly_homed, rig};
use protocol::{
    error::Refusal,
    rig::{HomingPhase, RigFault, RigState, RunOutcome, RunRecord},
};
use virtual_bench::{
    faults::When,
    plants::{
        contact::Bounce,
        rig::{Action, Switch},
    },
};

/// Steps of a stroke of the run below: 20 mm.
const STROKE: u64 = 16_000;

fn refused<T: std::fmt::Debug>(answer: Result<T, ClientError>, expected: Refusal) {
    match answer {
        Err(ClientError::Refused { refusal, .. }) => assert_eq!(refusal, expected),
        other => panic!("{other:?}"),
    }
}

/// Makes two cycles of 20 mm, with `action` at edge `within`. Returns the record, and the number of edges after the
/// action.
fn run_with(rig: &mut RigRun, within: u64, action: Action) -> (RunRecord, u64) {
    let edges = rig.edge_count() as u64;
    rig.look(move |rig| rig.plan(When::Edge(edges + within), action));
    let (_, record) = execute(rig, quick(2, 20_000, 40_000, 500_000));
    rig.idle(200_000);
    (record, rig.edge_count() as u64 - edges - within)
}

/// Checks that homing ends with `expected`, that nothing moves afterwards, and that the rig can be homed once the
/// contact is fixed.
fn homing_ends_with(rig: &mut RigRun, switch: Switch, expected: RigFault) {
    let accepted = rig.device.home().expect("homing is accepted");
    let ended = rig.device.wait_homing(&accepted, &mut Unobserved);
    match ended {
        Err(ClientError::NotHomed { fault, .. }) => assert_eq!(fault, Some(expected)),
        other => panic!("{other:?}\n{}", rig.log()),
    }
    fixed(rig, switch);
}

/// Checks that the rig is at rest with the fault latched, then repairs the contact.
fn fixed(rig: &mut RigRun, switch: Switch) {
    let edges = rig.edge_count();
    rig.idle(100_000);
    rig.act(Action::Stick(switch, None));
    rig.idle(100_000);
    let status = rig.device.rig_status().expect("a status");
    assert_eq!((status.state, status.homed), (RigState::Faulted, false));
    assert_eq!(i64::from(status.position_steps), rig.carriage());
    assert_eq!(rig.edge_count(), edges, "it moved by itself");
    rig.device.acknowledge().expect("the cause is gone");
    rig.home();
    // The loop cuts the pulse in progress.
    rig.check_clean_after(0, usize::from(switch == Switch::EStop));
}

#[test]
fn a_cut_wire_of_the_home_flag_ends_the_homing() {
    let mut rig = quickly_homed();
    let (_, record) = execute(&mut rig, quick(1, 5_000, 40_000, 500_000));
    assert_eq!(record.outcome, RunOutcome::Complete);
    rig.act(Action::Stick(Switch::Home, Some(true)));
    homing_ends_with(&mut rig, Switch::Home, RigFault::FlagStuck);
}

#[test]
fn a_welded_home_flag_ends_the_homing() {
    let mut rig = quickly_homed();
    rig.act(Action::Stick(Switch::Home, Some(false)));
    let accepted = rig.device.home().expect("homing is accepted");
    let ended = rig.device.wait_homing(&accepted, &mut Unobserved);
    let fault = rig.device.rig_status().expect("a status").fault;
    let expected = Some(RigFault::FlagNotFound(HomingPhase::Seek));
    assert!(ended.is_err() && fault == expected, "{ended:?} {fault:?}");
    // The carriage ran into the end of travel, as on a rig without an end switch in its loop. It loses steps there, but
    // does no other harm.
    assert!(rig.look(|rig| rig.violations().stalled) > 0);
}

/// The ledger expects the flag on every return stroke.
#[test]
fn a_flag_that_is_cut_or_welded_within_a_run_is_missed_by_the_ledger() {
    for (open, within) in [
        (false, 8_000),
        (true, 8_000),
        (true, STROKE + 5_000),
        (false, STROKE + 5_000),
    ] {
        let mut rig = quickly_homed();
        let action = Action::Stick(Switch::Home, Some(open));
        let (record, after) = run_with(&mut rig, within, action);
        assert!(
            matches!(
                record.outcome,
                RunOutcome::Faulted(RigFault::LostSteps { residual_steps })
                    if residual_steps != 0
            ),
            "open {open} at edge {within}: {record:?}\n{}",
            rig.log()
        );
        assert!(
            after <= 2 * STROKE - within,
            "open {open} at edge {within}: it went on for {after} steps"
        );
        fixed(&mut rig, Switch::Home);
    }
}

#[test]
fn a_cut_wire_of_the_far_limit_stops_what_moves_away() {
    let mut rig = quickly_homed();
    let (record, after) = run_with(&mut rig, 8_000, Action::Stick(Switch::Far, Some(true)));
    let expected = RunOutcome::Faulted(RigFault::FarLimit);
    assert_eq!(record.outcome, expected);
    assert!(after <= 4, "{after} steps after the limit");
    // Homing meets the flag while the limit is open, but a carriage cannot be at both ends.
    rig.device.acknowledge().expect("at rest it is no cause");
    homing_ends_with(&mut rig, Switch::Far, RigFault::BothSwitchesOpen);
    rig.act(Action::Stick(Switch::Far, Some(true)));
    rig.idle(50_000);
    let edges = rig.edge_count();
    refused(
        rig.device.run(quick(1, 5_000, 40_000, 500_000)),
        Refusal::BothSwitchesOpen,
    );
    rig.idle(100_000);
    assert_eq!(rig.edge_count(), edges, "a refused run moved the carriage");
    rig.act(Action::Stick(Switch::Far, None));
    let (_, record) = execute(&mut rig, quick(1, 5_000, 40_000, 500_000));
    assert_eq!(record.outcome, RunOutcome::Complete);
    rig.check_clean(0);
}

#[test]
fn a_cut_wire_of_the_loop_stops_everything_also_at_rest() {
    let mut rig = quickly_homed();
    let cut = Action::Stick(Switch::EStop, Some(true));
    let (record, after) = run_with(&mut rig, STROKE + 100, cut.clone());
    let fault = RigFault::EStopLoop;
    assert_eq!(
        (record.outcome, after),
        (RunOutcome::Faulted(fault), 0),
        "{}",
        rig.log()
    );
    fixed(&mut rig, Switch::EStop);
    rig.act(cut);
    rig.idle(50_000);
    assert_eq!(
        rig.device.rig_status().expect("a status").fault,
        Some(fault)
    );
    refused(rig.device.acknowledge(), Refusal::CauseStillPresent);
    fixed(&mut rig, Switch::EStop);
}

/// Pulls the cable of both switches during a run, on the way out and on the way back.
#[test]
fn an_unplugged_cable_ends_a_run() {
    for (within, at_most) in [(8_000, 4), (STROKE + 5_000, 1_200)] {
        let mut rig = quickly_homed();
        let edges = rig.edge_count() as u64;
        rig.look(move |rig| {
            let edge = When::Edge(edges + within);
            rig.plan(edge, Action::Stick(Switch::Home, Some(true)));
            rig.plan(edge, Action::Stick(Switch::Far, Some(true)));
        });
        let (_, record) = execute(&mut rig, quick(2, 20_000, 40_000, 500_000));
        // On the way out the far limit counts. On the way back it is the flag, and the rig brakes.
        let RunOutcome::Faulted(fault) = record.outcome else {
            panic!("edge {within}: {record:?}")
        };
        let expected = match fault {
            RigFault::FarLimit => within < STROKE,
            RigFault::LostSteps { .. } => within > STROKE,
            _ => false,
        };
        assert!(expected, "edge {within}: {fault:?}");
        let after = rig.edge_count() as u64 - edges - within;
        assert!(after <= at_most, "edge {within}: {after} steps more");
        // Nothing can be started until the cable is plugged in.
        refused(rig.device.acknowledge(), Refusal::CauseStillPresent);
        refused(rig.device.home(), Refusal::RigFaulted(fault));
        for switch in [Switch::Home, Switch::Far] {
            rig.act(Action::Stick(switch, None));
        }
        rig.idle(50_000);
        rig.device.acknowledge().expect("it is plugged in");
        rig.home();
        rig.check_clean(0);
    }
}

/// Contacts that bounce for 60 us.
#[test]
fn bouncing_contacts_are_believed_once() {
    let bounce = Some(Bounce {
        times: 5,
        apart_ns: 6_000,
    });
    let mut rig = quickly_homed();
    for switch in [Switch::Home, Switch::Far, Switch::EStop] {
        rig.act(Action::Bounce(switch, bounce));
    }
    let (_, record) = execute(&mut rig, quick(3, 20_000, 40_000, 500_000));
    assert_eq!(
        (record.outcome, record.counted_edges, rig.carriage()),
        (RunOutcome::Complete, 6 * STROKE, 0),
        "{}",
        rig.log()
    );
    // 60 us of bouncing at 40 mm/s span two steps.
    assert!(
        record.worst_residual_steps.abs() <= 3,
        "{} steps",
        record.worst_residual_steps
    );
    let (record, after) = run_with(&mut rig, 5_000, Action::EStop(true));
    let expected = RunOutcome::Faulted(RigFault::EStopLoop);
    assert_eq!((record.outcome, after), (expected, 0), "{}", rig.log());
    let events = rig.device.take_events().expect("events");
    assert!(
        events.len() <= 1,
        "one fault, one event at most is left: {events:?}"
    );
    rig.act(Action::EStop(false));
    rig.idle(50_000);
    rig.device.acknowledge().expect("the cause is gone");
    rig.home();
    rig.check_clean_after(0, 1);
}

/// The start button, used as an operator does.
#[test]
fn the_button_homes_and_runs_and_a_stuck_one_does_nothing_more() {
    let mut rig = rig();
    home_quickly(&mut rig);
    for (key, value) in [
        (protocol::settings::SettingKey::ButtonCycles, 2),
        (protocol::settings::SettingKey::ButtonStrokeUm, 5_000),
        (protocol::settings::SettingKey::ButtonTotalMs, 2_000),
        (protocol::settings::SettingKey::ButtonAccelUmS2, 500_000),
    ] {
        let setting = protocol::settings::Setting { key, value };
        rig.device.call(setting).expect("accepted");
    }
    let press = |rig: &mut RigRun, us| {
        rig.act(Action::Button(true));
        rig.idle(us);
        rig.act(Action::Button(false));
    };
    press(&mut rig, 5_000);
    rig.idle(100_000);
    assert_eq!(rig.edge_count(), 0, "a touch of 5 ms is no press");
    press(&mut rig, 60_000);
    while rig.device.rig_status().expect("a status").state != RigState::Ready {
        rig.idle(10_000);
    }
    assert_eq!(rig.carriage(), 0);
    let edges = rig.edge_count();
    press(&mut rig, 60_000);
    rig.idle(1_000_000);
    assert_eq!(rig.edge_count(), edges, "it was meant to stop the homing");
    // It stays down: one run, not a second one.
    rig.act(Action::Button(true));
    rig.idle(5_000_000);
    assert_eq!(rig.edge_count() - edges, 16_000);
    let record = rig.device.run_record().expect("a record");
    assert_eq!(record.outcome, RunOutcome::Complete);
    rig.check_clean(0);
}

/// Nothing starts by itself: a button that is down at power-on does not count as pressed.
#[test]
fn a_button_that_is_stuck_at_power_up_moves_nothing() {
    let mut rig = rig();
    rig.act(Action::Button(true));
    rig.bench.power_cycle(1_000_000).expect("the bench runs");
    rig.bench.advance_us(2_000_000).expect("the bench runs");
    assert_eq!(rig.edge_count(), 0, "{}", rig.log());
    rig.device.hello(3).expect("it answers again");
    let status = rig.device.rig_status().expect("a status");
    assert_eq!(status.state, RigState::Unhomed);
}
