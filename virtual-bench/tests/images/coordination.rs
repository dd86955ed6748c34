//! Both images together: a fold at a place in a run, from the rig's STEP pin to the capsule's bridge.

use client::{Clock, Observer, Unobserved};
use jiff::Timestamp;
use lab::trials::check;
use lab::trials::coordination::{self, Coordinated, Recordings, Shaping};
use lab::trials::cue::Cue;
use lab::trials::experiment::PAPER_RUN;
use lab::trials::trial::{Recording, Status};
use protocol::rig::{Run, RunTiming};
use virtual_bench::bench::Bench;
use virtual_bench::boards::capsule::CapsuleBoard;
use virtual_bench::boards::rig::RigBoard;

use crate::capsule::CapsuleRun;
use crate::common::{quickly_homed, trials};

/// Three cycles of 20 mm, 2 s each.
const RUN: Run = Run {
    cycles: 3,
    stroke_um: 20_000,
    timing: RunTiming::Total {
        total_us: 6_000_000,
        accel_um_s2: 100_000,
    },
    ..PAPER_RUN
};
const STEPS: usize = 16_000;
/// Longest delay from the carriage to the motor.
const MOST_MS: f64 = 20.0;

/// Measures the capsule's clock relative to the rig's while both links are served. The capsule's may lag, but
/// never lead.
struct Clocks {
    rig: Bench<RigBoard>,
    capsule: Bench<CapsuleBoard>,
    ahead_ns: i64,
}

impl Observer for Clocks {
    fn turn(&mut self, _: u64, _: Option<Clock>) {
        let ahead_ns = self.capsule.now_ns().cast_signed() - self.rig.now_ns().cast_signed();
        self.ahead_ns = self.ahead_ns.max(ahead_ns);
    }
}

#[test]
fn a_fold_at_a_place_of_a_run_begins_within_20_ms() {
    let mut rig = quickly_homed();
    let CapsuleRun {
        bench,
        device: mut capsule,
    } = crate::capsule::referenced();
    let folder = tempfile::tempdir().expect("a folder");
    let recording = |stem: &str| Recording {
        folder: folder.path().to_owned(),
        stem: stem.to_owned(),
        now: Timestamp::UNIX_EPOCH,
        note: None,
        telemetry_ms: 10,
    };
    for (number, (cycle, at_um, wait_us)) in [
        (2, None, 0),
        (1, Some(5_000), 1_111),
        (3, Some(20_000), 3_333),
        (1, None, 5_555),
        (3, None, 6_666),
        (2, Some(10_000), 7_777),
    ]
    .into_iter()
    .take(trials(2, 6))
    .enumerate()
    {
        let what = format!("cycle {cycle}, {at_um:?} um");
        // Start at another phase of the telemetry and of the capsule's control period.
        capsule.idle(wait_us, &mut Unobserved).expect("there");
        let before = rig.with(|rig| rig.edges().len());
        let forget = bench.visit(|visit| visit.board().capsule.forget_drive());
        forget.expect("the bench runs");
        let mut clocks = Clocks {
            rig: rig.bench.clone(),
            capsule: bench.clone(),
            ahead_ns: i64::MIN,
        };
        let recordings = Recordings {
            run: &recording("run"),
            actuation: &recording("fold"),
        };
        let cue = Cue { cycle, at_um };
        let Coordinated {
            run,
            actuation,
            coordination,
        } = coordination::run(
            (&mut rig.device, &mut capsule),
            RUN,
            (Shaping::Fold, cue),
            &recordings,
            &mut clocks,
        )
        .expect("the run is recorded");
        assert_eq!(run.trial.status, Status::Complete, "{what}");
        assert!(actuation.is_ok(), "{what}: {:?}", actuation.err());
        let fold = actuation.expect("it is recorded");
        let defects = check::record(&fold.sidecar, &fold.trial).all();
        assert!(defects.is_empty(), "{what}: {defects:?}");
        let edges = rig.with(move |rig| rig.edges().since(before));
        assert_eq!(edges.len(), 6 * STEPS, "{what}");
        let cycles = 2 * STEPS * (usize::from(cycle) - 1);
        let place = cycles + at_um.map_or(0, |at_um| at_um as usize * 8 / 10);
        // The first stroke begins with its first step; everything else ends with its last one.
        let there_ns = edges
            .iter()
            .nth(place.saturating_sub(1))
            .expect("counted")
            .at_ns;
        let driven = bench.visit(|visit| visit.board().capsule.driven_ns());
        let driven_ns = driven.expect("the bench runs").expect("it has folded");
        let took_ns = driven_ns.cast_signed() - clocks.ahead_ns - there_ns.cast_signed();
        let took_ms = took_ns as f64 * 1e-6;
        #[allow(clippy::print_stdout)] // with `--nocapture`: the figures of docs/host-tool.md
        {
            println!("{what}: {took_ms:.1} ms, recorded {coordination:?}");
        }
        assert!((0.0..MOST_MS).contains(&took_ms), "{what}: {took_ms:.1} ms");
        let (least, most) = coordination.latency_us.expect("both clocks are known");
        // The event marks the start of the actuation, and the bridge follows. A place is reported to the nearest step.
        let reported = (least - 1_000) as f64 * 1e-3..(most + 2_000) as f64 * 1e-3;
        assert!(
            reported.contains(&took_ms),
            "{what}: {took_ms:.1} ms, reported {reported:?}"
        );
        if number + 1 < trials(2, 6) {
            let accepted = capsule.unfold().expect("it is folded");
            capsule
                .wait_actuation(&accepted, &mut Unobserved)
                .expect("it unfolds");
        }
    }
}
