//! The image of `cargo xtask board` on the bench: that each of its measurements comes, that a fault shows in the right
//! one, and that what the bench only assumes is not called shown.

use std::fmt;

use measurements::{END, Expected, Measurement as M, Place, Verdict, parse};
use virtual_bench::{
    bench::{Bench, BenchOptions, images},
    boards::rig::RigBoard,
    emulator::{Beats, ChipOptions},
    faults::When,
    plants::{
        rig::{Action, Rig, RigOptions, Switch},
        wire::Fault,
    },
};

/// Values that the image has told.
struct Told(Vec<(M, u32)>);

impl fmt::Display for Told {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut lines = self.0.iter();
        lines.try_for_each(|(one, value)| writeln!(f, "{} {value}", one.name()))
    }
}

impl Told {
    fn of(&self, one: M) -> Option<u32> {
        let found = self.0.iter().find(|(name, _)| *name == one);
        found.map(|(_, value)| *value)
    }

    fn verdict(&self, one: M, place: Place) -> Verdict {
        one.judge(self.of(one), place)
    }

    /// Measurements that would not be as expected on a board with these values.
    fn unexpected(&self) -> Vec<M> {
        M::ALL
            .into_iter()
            .filter(|one| self.verdict(*one, Place::Board) == Verdict::Unexpected)
            .collect()
    }
}

/// A step within the cruise at 28.5 kHz: 287 are made before.
const IN_CRUISE: u64 = 2_000;

/// Runs the image to its end, after this was done to the rig.
fn measured(
    rig: RigOptions,
    chip: impl FnOnce(&mut ChipOptions),
    prepare: impl FnOnce(&mut Rig),
) -> Told {
    let mut options = image();
    chip(&mut options.chip);
    let mut rig = Rig::new(rig);
    prepare(&mut rig);
    ended(rig, options).0
}

fn image() -> BenchOptions {
    BenchOptions::new(images().join("firmware-board"))
}

/// All that the image has told, and the flash as it leaves it.
fn ended(rig: Rig, options: BenchOptions) -> (Told, Vec<u8>) {
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
            let told = Told(lines.iter().filter_map(|line| parse(&line.text)).collect());
            return (told, bench.visit(|visit| visit.flash()).expect("it runs"));
        }
    }
    panic!("no end:\n{}", bench.log().expect("a log"));
}

#[test]
fn every_measurement_comes_and_no_assumption_passes_for_shown() {
    let told = measured(RigOptions::WITH_BOTH_JUMPERS, |_| (), |_| ());
    for one in M::ALL {
        // The emulator leads no LSI to TIM5, and its bursts take no time, so that none is cut.
        let comes = !matches!(one, M::WatchdogClock | M::CutBurstShift);
        assert_eq!(told.of(one).is_some(), comes, "{}", one.name());
        let verdict = told.verdict(one, Place::Bench);
        if one.bench_shows() {
            assert_eq!(verdict, Verdict::AsExpected, "{}", one.name());
            assert!(matches!(one.expected(), Expected::Within(..)));
        } else {
            assert_eq!(verdict, Verdict::NotShownHere, "{}", one.name());
        }
    }
    assert_eq!(told.unexpected(), [], "{told}");
    assert_eq!(told.of(M::CutBursts), Some(0));
}

/// The supply may fail between an erase and what would put the settings back.
#[test]
fn a_sector_with_settings_is_not_measured() {
    let rig = || Rig::new(RigOptions::WITH_BOTH_JUMPERS);
    let (told, mut flash) = ended(rig(), image());
    assert!(told.of(M::EraseTime).is_some());
    // The last word of sectors 1 to 3.
    flash[0xFFFC..0x1_0000].copy_from_slice(&[0x00, 0xFF, 0xFF, 0xFF]);
    let options = BenchOptions {
        flash: Some(flash.clone()),
        ..image()
    };
    let (told, left) = ended(rig(), options);
    assert_eq!((told.of(M::EraseTime), told.of(M::WordTime)), (None, None));
    assert!(left == flash, "the flash has changed");
}

#[test]
fn a_fault_shows_in_the_measurement_that_is_made_for_it() {
    // A slow burst can be cut, and the emulator's timer keeps its place.
    let slow = |chip: &mut ChipOptions| {
        chip.burst = Some(Beats {
            first_ns: 100,
            apart_ns: 600,
        });
        chip.erase_ns = 600_000_000;
    };
    let late = |rig: &mut Rig| {
        let jitter = Action::Capture(Fault::Jitter(20));
        rig.plan(When::Edge(IN_CRUISE), jitter);
    };
    let told = measured(RigOptions::WITH_BOTH_JUMPERS, slow, late);
    let bad = told.unexpected();
    for one in [M::BurstLast, M::EraseTime, M::CruiseOff2, M::FastOff2] {
        assert!(bad.contains(&one), "{one:?}: {told}");
    }
    assert!(!bad.contains(&M::BurstFirst), "{told}");
    assert!(told.of(M::CutBursts) > Some(50), "{told}");
    assert!(told.of(M::CutBurstShift) >= Some(1), "{told}");
}

#[test]
fn a_lost_capture_is_named_and_a_missing_jumper_is_no_pass() {
    let lose = |rig: &mut Rig| rig.plan(When::Edge(IN_CRUISE), Action::Capture(Fault::Lose));
    let told = measured(RigOptions::WITH_BOTH_JUMPERS, |_| (), lose);
    assert_eq!(told.unexpected(), [M::CruiseLost], "{told}");
    let told = measured(RigOptions::REFERENCE, |_| (), |_| ());
    let exact = [M::RepeatExact, M::CruiseExact, M::RampExact, M::FastExact];
    assert_eq!(told.unexpected(), exact, "{told}");
}

/// The wires that are asked for leave the far limit out, so it reads open.
#[test]
fn a_far_limit_that_is_not_connected_disturbs_no_measurement() {
    let open = |rig: &mut Rig| rig.act(Action::Stick(Switch::Far, Some(true)), 0);
    let told = measured(RigOptions::WITH_BOTH_JUMPERS, |_| (), open);
    assert_eq!(told.unexpected(), [], "{told}");
}

/// Without the clock and with the loop open nothing hangs, and what could not be measured is called that.
#[test]
fn a_board_without_clock_and_with_an_open_loop_says_so() {
    let told = measured(
        RigOptions::WITH_BOTH_JUMPERS,
        |chip| chip.hse_after_ns = None,
        |rig| rig.act(Action::EStop(true), 0),
    );
    assert_eq!(told.unexpected(), [M::ExternalClockStart], "{told}");
    for one in [M::MoeReads, M::RepeatEdges, M::StepAtEnd, M::FastMissing] {
        let verdict = told.verdict(one, Place::Board);
        assert_eq!(verdict, Verdict::NotMeasured, "{told}");
    }
    assert!(told.of(M::EraseTime).is_some(), "{told}");
}
