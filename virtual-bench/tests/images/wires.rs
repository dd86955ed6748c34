//! A cut loop, bouncing contacts, and the start button.

use crate::common::{RigRun, execute, home_quickly, quick, quickly_homed, refusal, rig};
use protocol::{
    error::Refusal,
    rig::{RigFault, RigState, RunOutcome, RunRecord},
    settings::SettingKey,
};
use virtual_bench::plants::{
    contact::Bounce,
    rig::{Action, Switch},
};

/// Steps of a stroke of the run below: 20 mm.
const STROKE: u64 = 16_000;

/// Makes two cycles of 20 mm, with `action` at edge `within`. Returns the record, and the number of edges after the
/// action.
fn run_with(rig: &mut RigRun, within: u64, action: Action) -> (RunRecord, u64) {
    let number = rig.plan_at(within, action);
    let (_, record) = execute(rig, quick(2, 20_000, 40_000, 500_000));
    rig.idle(200_000);
    (record, rig.edge_count() as u64 - number)
}

/// Checks that the rig is at rest with the fault latched, then repairs the loop.
fn fixed(rig: &mut RigRun) {
    let edges = rig.edge_count();
    rig.idle(100_000);
    rig.act(Action::Stick(Switch::EStop, None));
    rig.idle(100_000);
    let status = rig.status();
    assert_eq!((status.state, status.homed), (RigState::Faulted, false));
    assert_eq!(i64::from(status.position_steps), rig.carriage());
    assert_eq!(rig.edge_count(), edges, "it moved by itself");
    rig.recover("the cause is gone");
    // The loop cuts the pulse in progress.
    rig.check_clean_after(0, 1);
}

#[test]
fn a_cut_wire_of_the_loop_stops_everything_also_at_rest() {
    let mut rig = quickly_homed();
    let cut = Action::Stick(Switch::EStop, Some(true));
    let (record, after) = run_with(&mut rig, STROKE + 100, cut.clone());
    let fault = RigFault::EStopLoop;
    let ended = (record.outcome, after);
    assert_eq!(ended, (RunOutcome::Faulted(fault), 0), "{}", rig.log());
    fixed(&mut rig);
    rig.act(cut);
    rig.idle(50_000);
    assert_eq!(rig.status().fault, Some(fault));
    let refused = refusal(rig.device.acknowledge());
    assert_eq!(refused, Refusal::CauseStillPresent);
    fixed(&mut rig);
}

/// Contacts that bounce for 60 us, and plain microswitches that bounce for 5 ms, in which the carriage makes 160 steps.
#[test]
fn bouncing_contacts_are_believed_once() {
    for (times, apart_ns) in [(5, 6_000), (25, 100_000)] {
        let rig = quickly_homed();
        for switch in [Switch::Home, Switch::Far, Switch::EStop] {
            rig.act(Action::Bounce(switch, Some(Bounce { times, apart_ns })));
        }
        are_believed_once(rig);
    }
}

fn are_believed_once(mut rig: RigRun) {
    rig.home();
    let (_, record) = execute(&mut rig, quick(3, 20_000, 40_000, 500_000));
    assert_eq!(record.outcome, RunOutcome::Complete, "{}", rig.log());
    assert_eq!((record.counted_edges, rig.carriage()), (6 * STROKE, 0));
    // The first edge gives the position; 60 us at 40 mm/s are two steps.
    assert!(record.worst_residual_steps.abs() <= 3, "{record:?}");
    let (record, after) = run_with(&mut rig, 5_000, Action::EStop(true));
    let expected = RunOutcome::Faulted(RigFault::EStopLoop);
    assert_eq!((record.outcome, after), (expected, 0), "{}", rig.log());
    let events = rig.device.take_events().expect("events");
    assert!(events.len() <= 1, "one fault, one event: {events:?}");
    rig.act(Action::EStop(false));
    rig.idle(50_000);
    rig.recover("the cause is gone");
    rig.check_clean_after(0, 1);
}

/// The start button, used as an operator does.
#[test]
fn the_button_homes_and_runs_and_a_stuck_one_does_nothing_more() {
    let mut rig = rig();
    home_quickly(&mut rig);
    for (key, value) in [
        (SettingKey::ButtonCycles, 2),
        (SettingKey::ButtonStrokeUm, 5_000),
        (SettingKey::ButtonTotalMs, 2_000),
        (SettingKey::ButtonAccelUmS2, 500_000),
    ] {
        rig.set(key, value);
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
    while rig.status().state != RigState::Ready {
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
