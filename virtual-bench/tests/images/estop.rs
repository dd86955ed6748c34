//! The E-stop at many instants of short runs: afterwards the read-back must match the carriage.

use client::Unobserved;
use jiff::Timestamp;
use lab::trials::trial::{Recording, RigSample, Status};
use lab::trials::{check, experiment};

use crate::common::{Dice, faulted, paper, quick, quickly_homed};
use protocol::rig::{RigFault, RigState};
use protocol::system::Urgent;
use virtual_bench::plants::{
    contact::TO_PIN_NS,
    rig::{Action, Switch},
};

const SEED: u64 = 0x5EED_E570;
const TRIALS: u64 = 200;

#[test]
fn the_position_after_an_estop_at_any_edge_is_known_to_the_step() {
    let mut dice = Dice(SEED);
    let mut rig = quickly_homed();
    let mut places = std::collections::BTreeSet::new();
    let mut short = 0;
    for trial in 0..TRIALS {
        let stroke_um = dice.roll(1_500..9_000) as u32;
        let speed_um_s = dice.roll(3_000..45_000) as u32;
        let accel_um_s2 = dice.roll(300_000..2_000_000) as u32;
        let run = quick(1, stroke_um, speed_um_s, accel_um_s2);
        let steps = u64::from(stroke_um) * 4 / 5;
        // Put every tenth trial at an end of a stroke, where the direction turns.
        let within = match trial % 10 {
            0 => steps,
            5 => steps + 1,
            _ => dice.roll(1..2 * steps),
        };
        // The loop opens anywhere within the period that follows; every fifth time close to the next edge.
        let period_ns = 1_250_000_000 / u64::from(speed_um_s);
        let after_ns = match trial % 5 {
            3 => period_ns - TO_PIN_NS + dice.roll(0..1_000) - 200,
            _ => dice.roll(0..period_ns),
        };
        let what =
            format!("seed {SEED:#x}, trial {trial}: {after_ns} ns after edge {within} of {run:?}");
        let first = rig.edge_count() as u64;
        rig.plan_at(
            within,
            Action::Later(after_ns, Box::new(Action::EStop(true))),
        );
        let record = faulted(&mut rig, run, RigFault::EStopLoop, &what);
        let number = rig.edge_count() as u64;
        let sent = number - first;
        let opened_ns = rig.with(|rig| rig.loop_opened_ns()).expect(&what);
        let last_ns = opened_ns.checked_sub(rig.last_edge_ns()).expect(&what);
        assert!((within..=within + 1).contains(&sent), "{what}: {sent} left");
        let carriage = rig.carriage();
        let place = |edges: u64| edges.min(2 * steps - edges) as i64;
        assert_eq!(carriage, place(sent), "{what}");
        // The read-back's filter: a pulse that is cut so short is none.
        let counted = record.counted_edges;
        match last_ns {
            0..280 => assert_eq!(counted, sent - 1, "{what}, {last_ns} ns"),
            280..=320 => assert!((sent - 1..=sent).contains(&counted), "{what}, {last_ns} ns"),
            _ => assert_eq!(counted, sent, "{what}, {last_ns} ns"),
        }
        short += u64::from(counted < sent);
        let status = rig.device.rig_status().expect(&what);
        let reported = (i64::from(status.position_steps), status.homed);
        assert_eq!(reported, (place(counted), false), "{what}, {last_ns} ns");
        // Steps prepared beyond the cut are reported separately.
        assert_eq!(record.commanded_edges, counted, "{what}, {last_ns} ns");
        assert!(record.prepared_edges >= sent, "{what}");
        places.insert(carriage);
        rig.act(Action::EStop(false));
        rig.bench.advance_us(30_000).expect(&what);
        rig.device.acknowledge().expect(&what);
        rig.bench.advance_us(30_000).expect(&what);
        assert_eq!(rig.edge_count() as u64, number, "{what}: it moved");
        rig.home();
    }
    assert!(places.len() > 150, "{} places", places.len());
    assert!(short > 0, "no pulse was cut within the filter");
    eprintln!("{short} pulses cut within the filter");
    rig.check_clean_after(0, TRIALS as usize);
}

/// A sample just before the cut is ahead of the record by the steps that never left: nothing calls that damage.
#[test]
fn the_recording_of_a_run_that_is_cut_is_whole() {
    let mut rig = quickly_homed();
    let folder = tempfile::tempdir().expect("a folder");
    let mut ahead = 0;
    for within in [2_111, 4_777, 7_003, 9_500, 12_345] {
        rig.plan_at(within, Action::EStop(true));
        let recording = Recording {
            folder: folder.path().to_owned(),
            stem: format!("run-{within}"),
            now: Timestamp::UNIX_EPOCH,
            note: None,
            telemetry_ms: 5,
        };
        let request = quick(1, 30_000, 35_000, 500_000);
        let run = experiment::run(&mut rig.device, request, &recording, &mut Unobserved)
            .expect("recorded");
        assert_eq!(run.trial.status, Status::Faulted, "{within}");
        let mut most = None;
        let defects = check::seen(&run.sidecar, &run.trial, |sample: &RigSample| {
            most = most.max(Some(sample.commanded_steps));
        });
        assert_eq!(defects.all(), [""; 0], "{within}");
        ahead += u32::from(most > Some(run.record.max_steps));
        rig.act(Action::EStop(false));
        rig.pass(30_000);
        rig.recover("the cause is gone");
    }
    assert!(ahead > 0, "no sample was ahead of its record");
}

/// An unacknowledged E-stop stays latched over a reset, whether the button is released or not.
#[test]
fn an_estop_outlives_a_reset() {
    let mut rig = quickly_homed();
    let number = rig.plan_at(3_000, Action::EStop(true));
    let fault = RigFault::EStopLoop;
    faulted(&mut rig, quick(1, 8_000, 20_000, 500_000), fault, "pressed");
    rig.act(Action::EStop(false));
    rig.reset(2);
    let status = rig.status();
    assert_eq!(
        (status.state, status.fault),
        (RigState::Faulted, Some(fault))
    );
    assert!(rig.device.home().is_err(), "it has to be acknowledged");
    assert_eq!(rig.edge_count() as u64, number, "it moved");
    rig.recover("the cause is gone");
    rig.check_clean(1);
}

/// The other fault keeps its name until the reset, and the emergency stop outlives it: by a frame, or by the loop, which
/// is closed again by then.
#[test]
fn an_estop_in_another_fault_outlives_a_reset() {
    for by_frame in [true, false] {
        let what = format!("by frame: {by_frame}");
        let mut rig = quickly_homed();
        rig.plan_at(3_000, Action::Stick(Switch::Far, Some(true)));
        faulted(&mut rig, paper(1), RigFault::FarLimit, &what);
        rig.act(Action::Stick(Switch::Far, None));
        let fault = if by_frame {
            rig.device.urgent(Urgent::EStop).expect(&what);
            RigFault::EStopFrame
        } else {
            rig.act(Action::EStop(true));
            rig.pass(100_000);
            rig.act(Action::EStop(false));
            rig.pass(100_000);
            RigFault::EStopLoop
        };
        assert_eq!(rig.status().fault, Some(RigFault::FarLimit), "{what}");
        rig.reset(2);
        assert_eq!(rig.status().fault, Some(fault), "{what}");
        assert!(rig.device.home().is_err(), "it has to be acknowledged");
        rig.recover(&what);
        rig.check_clean(1);
    }
}
