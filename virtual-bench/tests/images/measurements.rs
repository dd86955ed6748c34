//! The image of `cargo xtask board` on the bench: that each of its measurements comes, that a fault shows in the right
//! one, and that what the bench only assumes is not called shown.

use measurements::{END, Expected, Measurement as M, Place, Verdict, parse};
use virtual_bench::{
    bench::{Bench, BenchOptions, images},
    boards::rig::RigBoard,
    emulator::{Beats, ChipOptions},
    plants::{
        rig::{Action, Rig, RigOptions, Switch},
        wire::Fault,
    },
};

/// What the image has told.
struct Told(Vec<(M, u32)>);

impl Told {
    fn of(&self, one: M) -> Option<u32> {
        let found = self.0.iter().find(|(name, _)| *name == one);
        found.map(|(_, value)| *value)
    }

    fn verdict(&self, one: M, place: Place) -> Verdict {
        one.judge(self.of(one), place)
    }

    /// What a board with these values would be reproached with.
    fn unexpected(&self) -> Vec<M> {
        M::ALL
            .into_iter()
            .filter(|one| self.verdict(*one, Place::Board) == Verdict::Unexpected)
            .collect()
    }
}

/// Runs the image to its end.
fn measured(rig: RigOptions, chip: impl FnOnce(&mut ChipOptions), prepare: &[Action]) -> Told {
    let mut options = BenchOptions::new(images().join("firmware-board"));
    chip(&mut options.chip);
    let bench = Bench::start(RigBoard::new(Rig::new(rig)), options).expect("the image starts");
    for action in prepare.iter().copied() {
        bench
            .visit(move |visit| {
                let now = visit.now_ns();
                visit.board().rig.act(action, now);
            })
            .expect("it runs");
    }
    for _ in 0..50 {
        bench.advance_us(100_000).expect("it runs");
        let lines = bench.log().expect("a log").lines();
        if lines.iter().any(|line| line.text.contains(END)) {
            let resets = bench.bus().expect("it runs").resets;
            assert!(resets.is_empty(), "{resets:?}");
            let enabled = bench.visit(|visit| visit.board().rig.is_enabled());
            assert!(!enabled.expect("it runs"), "the driver is on");
            return Told(lines.iter().filter_map(|line| parse(&line.text)).collect());
        }
    }
    panic!("no end:\n{}", bench.log().expect("a log"));
}

#[test]
fn every_measurement_comes_and_no_assumption_passes_for_shown() {
    let told = measured(RigOptions::WITH_BOTH_JUMPERS, |_| (), &[]);
    for one in M::ALL {
        println!("{} {:?}", one.name(), told.of(one));
    }
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
    assert_eq!(told.unexpected(), []);
    assert_eq!(told.of(M::CutBursts), Some(0));
}
