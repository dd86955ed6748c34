//! A process that was suspended while something moved: the machine stopped or went on, and somebody pressed its button.

use client::error::{ClientError, Missing};
use client::{Device, Unobserved};
use lab::trials::experiment::PAPER_RUN;
use protocol::rig::{LinkLossPolicy, MoveTo, Run, RunOutcome, RunTiming};
use protocol::settings::SettingKey;
use protocol::system::DeviceKind;
use simulated_machines::machine::{World, button, link};

use crate::support::tool::{Memory, ready};

const RUN: Run = Run {
    cycles: 1,
    stroke_um: 20_000,
    timing: RunTiming::Total {
        total_us: 4_000_000,
        accel_um_s2: 100_000,
    },
    ..PAPER_RUN
};

/// A homed rig whose button begins the same run, and is pressed at these times.
fn rig(presses_us: &[u64]) -> Device {
    let mut script = ready(DeviceKind::Rig);
    script.settings = vec![
        (SettingKey::ButtonCycles, 1),
        (SettingKey::ButtonStrokeUm, 20_000),
        (SettingKey::ButtonTotalMs, 4_000),
    ];
    script.world = presses_us.iter().flat_map(|us| button(*us)).collect();
    let (link, _) = link(script);
    Device::connect(link, DeviceKind::Rig, 1).expect("a rig")
}

/// The button's run has the same plan, and would pass for it.
#[test]
fn a_run_has_no_outcome_once_another_one_has_begun() {
    for (link_loss, presses_us, silent_us) in [
        // It has stopped; the first press homes, the second one begins the other run, which has ended or goes on.
        (
            LinkLossPolicy::Stop,
            &[8_000_000, 60_000_000][..],
            80_000_000,
        ),
        (LinkLossPolicy::Stop, &[8_000_000, 60_000_000], 62_000_000),
        (LinkLossPolicy::Finish, &[9_000_000], 20_000_000),
    ] {
        let mut rig = rig(presses_us);
        let accepted = rig.run(Run { link_loss, ..RUN }).expect("accepted");
        rig.fall_silent(silent_us).expect("the line is there");
        let ended = rig.wait_run(&accepted, &mut Unobserved);
        let Err(ClientError::Unanswered {
            missing: Missing::Record { run: 1, last: 2 },
            ..
        }) = ended
        else {
            panic!("{link_loss:?}, {silent_us} us: {ended:?}");
        };
    }
}

/// Homing ends where the move was to end.
#[test]
fn a_move_that_lost_its_host_has_not_arrived_by_a_homing() {
    let mut rig = rig(&[20_000_000]);
    let to = |position_um| MoveTo {
        position_um,
        speed_um_s: 20_000,
    };
    let accepted = rig.call(to(60_000)).expect("accepted");
    let there = rig.wait_move(&accepted, &mut Unobserved).expect("it ends");
    assert_eq!(there.0, RunOutcome::Complete);
    let accepted = rig.call(to(0)).expect("accepted");
    rig.fall_silent(40_000_000).expect("the line is there");
    let (outcome, status) = rig.wait_move(&accepted, &mut Unobserved).expect("it ends");
    assert_eq!((outcome, status.position_steps), (RunOutcome::LinkLost, 0));
}

/// The rig's step timer stands: it is stopped, and the command ends.
#[test]
fn a_move_without_an_end_is_overdue() {
    let mut script = ready(DeviceKind::Rig);
    script.world = vec![(1_500_000, World::TimerStands)];
    let memory = Memory::with(vec![script]);
    let (code, _, err) = memory.run(&["--rig", "0", "move", "60", "--speed-mm-s", "20"]);
    assert_eq!(code, 6, "{err}");
    assert!(err.contains("did not end within"), "{err}");
}
