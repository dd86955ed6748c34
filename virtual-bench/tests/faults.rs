//! What goes wrong around the rig: resets, cut supplies, lost steps, bad switches, a noisy line.

mod common;

use common::{execute, homed, paper, rig_with};
use host_tool::{client::Unobserved, error::ClientError};
use protocol::{
    rig::{RigFault, RigState, Run, RunTiming},
    system::ResetCause,
};
use virtual_bench::faults::When;
use virtual_bench::plants::contact::Bounce;
use virtual_bench::plants::rig::{Action, RigOptions, Switch};
use virtual_bench::serial::ByteFault;

/// 10 mm there and back.
fn short(cycles: u16) -> Run {
    Run {
        stroke_um: 10_000,
        timing: RunTiming::Total {
            total_us: u64::from(cycles) * 1_500_000,
            accel_um_s2: 100_000,
        },
        ..paper(cycles)
    }
}

/// Interrupts a run with `interrupt`; afterwards the rig stands, knows that it does not know where, and can be homed.
fn restarted(cause: ResetCause, resets: usize, interrupt: impl FnOnce(&common::RigRun)) {
    let mut rig = homed();
    rig.device.run(short(1)).expect("the run is accepted");
    rig.device
        .idle(500_000, &mut Unobserved)
        .expect("the link stays");
    assert!(rig.carriage() > 1_000, "it is on its way");
    interrupt(&rig);
    let edges = rig.edge_count();
    rig.bench.advance_us(300_000).expect("the bench runs");
    assert_eq!(rig.edge_count(), edges, "it moved by itself\n{}", rig.log());
    let identity = rig.device.hello(2).expect("it answers again");
    assert_eq!(identity.reset_cause, cause);
    let status = rig.device.rig_status().expect("a status");
    assert_eq!((status.state, status.homed), (RigState::Unhomed, false));
    rig.home();
    rig.check_clean(resets);
}

#[test]
fn a_reset_moves_nothing_and_forgets_the_position() {
    restarted(ResetCause::Pin, 1, |rig| {
        rig.bench.reset().expect("the bench runs");
    });
}

#[test]
fn a_power_cut_moves_nothing_and_forgets_the_position() {
    restarted(ResetCause::PowerOn, 0, |rig| {
        let before_ns = rig.bench.now_ns();
        rig.bench.power_cycle(2_000_000).expect("the bench runs");
        assert_eq!(rig.bench.now_ns(), before_ns + 2_000_000_000);
    });
}

#[test]
fn lost_steps_end_the_run_at_the_flag() {
    let mut rig = homed();
    rig.look(|rig| {
        let edge = rig.edges().len() as u64 + 5_000;
        rig.plan(When::Edge(edge), Action::LoseSteps(16));
    });
    let accepted = rig.device.run(short(2)).expect("the run is accepted");
    let ended = rig.device.wait_run(&accepted, &mut Unobserved);
    let status = rig.device.rig_status().expect("a status");
    let Some(RigFault::LostSteps { residual_steps }) = status.fault else {
        panic!("{ended:?} {status:?}")
    };
    assert_eq!(residual_steps.abs(), 16);
    assert_eq!(rig.look(|rig| rig.lost()), 16);
}

#[test]
fn a_cut_jumper_is_found_by_the_read_back() {
    let mut rig = homed();
    rig.look(|rig| rig.act(Action::Jumper(false), 0));
    let accepted = rig.device.run(short(1)).expect("the run is accepted");
    let ended = rig.device.wait_run(&accepted, &mut Unobserved);
    let status = rig.device.rig_status().expect("a status");
    assert!(
        matches!(status.fault, Some(RigFault::ReadBack { counted: 0, .. })),
        "{ended:?} {status:?}"
    );
}

#[test]
fn a_bouncing_flag_is_homed_on_and_a_dead_one_is_not() {
    let options = RigOptions {
        carriage: 2_000,
        ..RigOptions::default()
    };
    let mut rig = rig_with(options);
    let bounce = Bounce {
        times: 3,
        apart_ns: 4_000,
    };
    rig.look(move |rig| rig.act(Action::Bounce(Switch::Home, Some(bounce)), 0));
    rig.home();
    rig.look(|rig| rig.act(Action::Stick(Switch::Home, Some(false)), 0));
    let accepted = rig.device.home().expect("homing is accepted");
    let ended = rig.device.wait_homing(&accepted, &mut Unobserved);
    let fault = rig.device.rig_status().expect("a status").fault;
    assert!(
        ended.is_err() && matches!(fault, Some(RigFault::FlagNotFound(_))),
        "{ended:?} {fault:?}"
    );
    rig.bench
        .bus()
        .expect("the bench runs")
        .check(0)
        .expect("nothing odd was touched");
}

#[test]
fn a_noisy_line_delays_and_changes_nothing() {
    let mut rig = homed();
    let spoilt = rig.bench.visit(|visit| {
        let mut serial = visit.serial();
        let (taken, sent) = serial.counts();
        for n in 0..40 {
            serial.spoil_to_machine(taken + 7 + 61 * n, ByteFault::Flipped(1 << (n % 8)));
            serial.spoil_from_machine(sent + 11 + 97 * n, ByteFault::Lost);
        }
    });
    spoilt.expect("the bench runs");
    let edges = rig.edge_count();
    let (accepted, record) = execute(&mut rig, short(3));
    assert_eq!(record.commanded_edges, accepted.edges);
    assert_eq!(rig.edge_count() - edges, 48_000);
    assert!(rig.device.rejected_frames() > 0, "the faults were not met");
    rig.check_clean(0);
}

#[test]
fn a_wrong_kind_of_machine_is_not_driven() {
    let rig = rig_with(RigOptions::default());
    let link = Box::new(virtual_bench::link::VirtualLink::new(
        &rig.bench,
        "virtual rig",
    ));
    let wanted = protocol::system::DeviceKind::Capsule;
    let refused = host_tool::client::Device::connect(link, wanted, 7).err();
    assert!(
        matches!(refused, Some(ClientError::WrongDevice { .. })),
        "{refused:?}"
    );
    assert_eq!(rig.edge_count(), 0);
}
