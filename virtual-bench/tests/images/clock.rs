//! The 8 MHz clock from the ST-LINK comes late, never, or stops: a rig on an external supply meets this at every
//! power-on.

use crate::common::{RigRun, connected, exact, execute, paper, refusal, rig_with_chip, with_chip};
use protocol::{
    error::Refusal,
    rig::{RigFault, RigState},
    system::{BrownOut, Clock, GetChip, ResetCause},
};
use virtual_bench::{
    bench::Bench,
    boards::rig::RigBoard,
    plants::rig::{Action, Rig, RigOptions},
};

const S_NS: u64 = 1_000_000_000;

/// A rig that is switched on without a host.
fn alone(hse_after_ns: Option<u64>) -> Bench<RigBoard> {
    let board = RigBoard::new(Rig::new(RigOptions::default()));
    let options = with_chip(|chip| chip.hse_after_ns = hse_after_ns);
    Bench::start(board, options).expect("the image boots")
}

fn steps_and_driver(bench: &Bench<RigBoard>) -> (usize, bool) {
    bench
        .visit(|visit| {
            let rig = &visit.board().rig;
            (rig.edges().len(), rig.is_enabled())
        })
        .expect("the bench runs")
}

/// Presses the start button for 60 ms.
fn press(bench: &Bench<RigBoard>) {
    for down in [true, false] {
        let now_ns = bench.now_ns();
        bench
            .visit(move |visit| visit.board().rig.act(Action::Button(down), now_ns))
            .expect("the bench runs");
        bench.advance_us(60_000).expect("the bench runs");
    }
}

/// A rig on its external clock, in `state`, with a power-on as the cause of its start.
fn as_after_power_on(bench: Bench<RigBoard>, state: RigState, what: &str) -> RigRun {
    let mut rig = connected(bench);
    let status = rig.status();
    let found = (status.state, status.fault);
    assert_eq!(found, (state, None), "{what}\n{}", rig.log());
    let chip = rig.device.call(GetChip).expect("it answers");
    let clock = (chip.clock, chip.brown_out);
    assert_eq!(clock, (Clock::External, BrownOut::Off), "{what}");
    let cause = rig.device.hello(2).expect("it answers").reset_cause;
    assert_eq!(cause, ResetCause::PowerOn, "{what}");
    rig
}

/// Powered on without a host: whenever the clock comes, the start button homes the rig and a run is exact. Before that
/// nothing moves, the watchdog is fed, and the reset cause is reported as power-on.
#[test]
fn a_rig_whose_clock_comes_late_homes() {
    for after_ms in [0, 500, 2_000, 10_000] {
        let what = format!("after {after_ms} ms");
        let bench = alone(Some(after_ms * S_NS / 1_000));
        bench
            .advance_us(after_ms * 1_000 + 600_000)
            .expect("the bench runs");
        assert_eq!(steps_and_driver(&bench), (0, false), "{what}");
        press(&bench);
        bench.advance_us(12_000_000).expect("the bench runs");
        let mut rig = as_after_power_on(bench, RigState::Ready, &what);
        assert_eq!(rig.carriage(), 0, "{what}");
        let first = rig.edge_count();
        execute(&mut rig, paper(1));
        rig.is_exact(&exact(1), first);
        // It restarts once, when the clock comes.
        rig.check_clean(usize::from(after_ms > 300));
    }
}

/// The clock comes and pauses for 50 ms, once in every phase of the start. The rig ends up as after a power-on.
#[test]
fn a_clock_that_pauses_in_the_start_needs_no_hand() {
    for phase in 0..56 {
        let at_us = match phase {
            0..50 => phase * 60,
            _ => (phase - 49) * 20_000,
        };
        let what = format!("pause after {at_us} us");
        let bench = alone(Some(0));
        bench.advance_us(at_us).expect("the bench runs");
        bench
            .visit(|visit| visit.fail_hse(Some(50_000_000)))
            .expect("the bench runs");
        bench.advance_us(1_000_000).expect("the bench runs");
        let mut rig = as_after_power_on(bench, RigState::Unhomed, &what);
        rig.home();
        let resets = rig.bench.bus().expect("the bench runs").resets.len();
        eprintln!("{what}: {resets} resets");
        rig.check_clean(resets.min(1));
    }
}

/// Without the clock the rig reports its absence all the time, and recovers by itself when the clock appears.
#[test]
fn a_rig_without_its_clock_says_so_and_looks_for_it() {
    let mut rig = rig_with_chip(|chip| chip.hse_after_ns = Some(30 * S_NS));
    assert!(rig.bench.now_ns() < S_NS, "it answers within a second");
    let fault = RigFault::ClockMissing;
    for _ in 0..4 {
        let status = rig.status();
        let faulted = (RigState::Faulted, Some(fault));
        assert_eq!((status.state, status.fault), faulted);
        let chip = rig.device.call(GetChip).expect("it answers");
        assert_eq!(chip.clock, Clock::Internal);
        assert_eq!(refusal(rig.device.home()), Refusal::RigFaulted(fault));
        assert!(rig.device.acknowledge().is_err());
        // A press is ignored and not remembered.
        press(&rig.bench);
        rig.idle(7_000_000);
        assert_eq!(steps_and_driver(&rig.bench), (0, false));
    }
    rig.check_clean(0);
    rig.pass(5_000_000);
    rig.device.hello(2).expect("it answers again");
    let status = rig.status();
    let found = (status.state, status.fault);
    assert_eq!(found, (RigState::Unhomed, None), "{}", rig.log());
    let moved = steps_and_driver(&rig.bench);
    assert_eq!(moved, (0, false), "it moved by itself");
    rig.home();
    rig.check_clean(1);
}
