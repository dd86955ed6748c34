//! The image of `cargo xtask board` on the bench: its measurements come, and a fault shows in the right ones.

use measurements::{END, Measurement as M, parse};
use virtual_bench::{
    bench::{Bench, BenchOptions, images},
    boards::rig::RigBoard,
    emulator::{BurstTiming, Streams},
    faults::When,
    plants::{
        rig::{Action, Rig, RigOptions, Switch},
        wire::Fault,
    },
};

/// A step within the cruise at 28.5 kHz: 287 are made before.
const IN_CRUISE: u64 = 2_000;

/// With DMA streams that are hard to please: nothing of that shows.
fn image() -> BenchOptions {
    let mut options = BenchOptions::new(images().join("firmware-board"));
    options.chip.streams = Streams {
        keeps_count: true,
        keeps_address: true,
        fifo_errors: true,
    };
    options
}

/// Runs the image to its end. Returns its values, and the flash as it leaves it.
fn measured(rig: Rig, options: BenchOptions) -> (Vec<(M, u32)>, Vec<u8>) {
    let bench = Bench::start(RigBoard::new(rig), options).expect("the image starts");
    for _ in 0..60 {
        bench.advance_us(100_000).expect("it runs");
        let log = bench.log().expect("a log");
        let lines = log.lines();
        if lines.iter().any(|line| line.text.contains(END)) {
            let resets = bench.bus().expect("it runs").resets;
            assert!(resets.is_empty(), "{resets:?}");
            let enabled = bench.visit(|visit| visit.board().rig.is_enabled());
            assert!(!enabled.expect("it runs"), "the driver is on");
            let values = lines.iter().filter_map(|line| parse(&line.text)).collect();
            return (values, bench.visit(|visit| visit.flash()).expect("it runs"));
        }
    }
    panic!("no end:\n{}", bench.log().expect("a log"));
}

fn of(values: &[(M, u32)], one: M) -> Option<u32> {
    values
        .iter()
        .find(|(name, _)| *name == one)
        .map(|(_, value)| *value)
}

fn unexpected(values: &[(M, u32)]) -> Vec<M> {
    let wrong = values
        .iter()
        .filter(|(one, value)| !one.expected().holds(*value));
    wrong.map(|(one, _)| *one).collect()
}

#[test]
fn every_measurement_comes_also_without_the_far_limit() {
    let mut rig = Rig::new(RigOptions::WITH_BOTH_JUMPERS);
    // The wires that are asked for leave it out, so it reads open.
    rig.act(Action::Stick(Switch::Far, Some(true)), 0);
    let (values, mut flash) = measured(rig, image());
    for one in M::ALL {
        // The emulator leads no LSI to TIM5, and its bursts take no time, so that none is cut.
        let comes = !matches!(one, M::WatchdogClock | M::CutBurstShift);
        assert_eq!(of(&values, one).is_some(), comes, "{}", one.name());
    }
    assert_eq!(unexpected(&values), [], "{values:?}");
    // The supply may fail between an erase and what would put settings back: a sector that has some is left alone.
    flash[0xFFFC..0x1_0000].copy_from_slice(&[0x00, 0xFF, 0xFF, 0xFF]);
    let options = BenchOptions {
        flash: Some(flash.clone()),
        ..image()
    };
    let (values, after) = measured(Rig::new(RigOptions::REFERENCE), options);
    assert_eq!(
        (of(&values, M::EraseTime), of(&values, M::WordTime)),
        (None, None)
    );
    assert!(after == flash, "the flash has changed");
    // Without the jumpers.
    let exact = [M::RepeatExact, M::CruiseExact, M::RampExact, M::FastExact];
    assert_eq!(unexpected(&values), exact, "{values:?}");
}

#[test]
fn a_fault_shows_in_the_measurement_that_is_made_for_it() {
    // A slow burst can be cut, and the emulator's timer keeps its place.
    let mut options = image();
    options.chip.burst = Some(BurstTiming {
        first_ns: 100,
        apart_ns: 600,
    });
    options.chip.erase_ns = 600_000_000;
    let mut rig = Rig::new(RigOptions::WITH_BOTH_JUMPERS);
    rig.plan(When::Edge(IN_CRUISE), Action::Capture(Fault::Jitter(20)));
    let (values, _) = measured(rig, options);
    let bad = unexpected(&values);
    for one in [M::BurstLast, M::EraseTime, M::CruiseOff2, M::FastOff2] {
        assert!(bad.contains(&one), "{one:?}: {values:?}");
    }
    assert!(!bad.contains(&M::BurstFirst), "{values:?}");
    assert!(of(&values, M::CutBursts) > Some(50), "{values:?}");
    assert!(of(&values, M::CutBurstShift) >= Some(1), "{values:?}");
    let mut rig = Rig::new(RigOptions::WITH_BOTH_JUMPERS);
    rig.plan(When::Edge(IN_CRUISE), Action::Capture(Fault::Lose));
    assert_eq!(unexpected(&measured(rig, image()).0), [M::CruiseLost]);
}

/// Without the clock and with the loop open nothing hangs, and what could not be measured is missing.
#[test]
fn a_board_without_clock_and_with_an_open_loop_says_so() {
    let mut options = image();
    options.chip.hse_after_ns = None;
    let mut rig = Rig::new(RigOptions::WITH_BOTH_JUMPERS);
    rig.act(Action::EStop(true), 0);
    let (values, _) = measured(rig, options);
    assert_eq!(unexpected(&values), [M::ExternalClockStart], "{values:?}");
    for one in [M::MoeReads, M::RepeatEdges, M::StepAtEnd, M::FastMissing] {
        assert_eq!(of(&values, one), None, "{values:?}");
    }
    assert!(of(&values, M::EraseTime).is_some(), "{values:?}");
}
