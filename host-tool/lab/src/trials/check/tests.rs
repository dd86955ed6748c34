//! The bounds of what a record may lack, and the contradictions in it.

use super::*;
use crate::trials::experiment::PAPER_RUN;
use crate::trials::trial::{Recording, Screw};
use jiff::Timestamp;
use protocol::capsule::{ActuationAccepted, ActuationKind, ActuationOutcome, ActuationRecord};
use protocol::rig::{RunOutcome, Stroke};
use protocol::system::Event;

/// A step is 2.5 um.
const SCREW: Screw = Screw {
    lead_um: 4_000,
    steps_per_rev: 1_600,
    stroke_um: 20_000,
};

fn all<T: Sample>(trial: &TrialRecord, samples: &[T]) -> Seen {
    let mut seen = Seen::default();
    samples.iter().for_each(|sample| seen.take(trial, sample));
    seen
}

fn trial(action: Action) -> TrialRecord {
    let recording = Recording {
        folder: "x".into(),
        stem: "run".to_owned(),
        now: Timestamp::UNIX_EPOCH,
        note: None,
        telemetry_ms: 20,
    };
    let mut trial = TrialRecord::new(
        action,
        crate::trials::trial::tests::device(),
        Default::default(),
        &recording,
    );
    trial.status = Status::Complete;
    trial
}

fn rig_sample(time_us: u64, steps: i32) -> RigSample {
    RigSample {
        time_us,
        state: "running".to_owned(),
        position_mm: decimal::write_signed(SCREW.nm(steps.into()), 6),
        speed_mm_s: "0.000".to_owned(),
        stroke: 0,
        position_steps: steps,
        commanded_steps: steps,
        residual_steps: 0,
        home_flag_open: false,
        far_limit_open: false,
        estop_loop_open: false,
        missed: 0,
        origin: Origin::Virtual,
    }
}

fn event(index: u32, time_us: u64, event: RigEvent) -> Event {
    Event {
        index,
        time_us,
        what: What::Rig(event),
    }
}

const STROKE: Stroke = Stroke {
    steps: 4_000,
    duration_ticks: 100_000_000,
    ramp_ticks: 10_000_000,
    peak_um_s: 11_000,
    accel_um_s2: 100_000,
};

/// One cycle of 10 mm, 1 s each way, sampled each 20 ms.
fn run_record() -> (TrialRecord, Vec<RigSample>) {
    let plan_hash = "0123456789abcdef".to_owned();
    let achieved = Achieved {
        run: 1,
        forward: STROKE,
        back: STROKE,
        total_ticks: 200_000_000,
        edges: 8_000,
        plan_hash: plan_hash.clone(),
    };
    let executed = Executed {
        outcome: RunOutcome::Complete,
        strokes: 2,
        commanded_edges: 8_000,
        counted_edges: 8_000,
        ticks: 200_000_000,
        plan_hash,
        min_steps: 0,
        max_steps: 4_000,
        worst_residual_steps: 0,
        min_queue: None,
        glitches: 0,
        holds: 0,
        image_hash: String::new(),
        prepared_edges: 8_000,
        edges_timed: 0,
        worst_interval_error_ticks: 0,
    };
    let mut trial = trial(Action::Run {
        screw: SCREW,
        requested: Run {
            cycles: 1,
            stroke_um: 10_000,
            ..PAPER_RUN
        },
        achieved: Some(achieved),
        executed: Some(executed),
    });
    let samples: Vec<_> = (0..=100_u64)
        .map(|index| {
            let steps = 80 * (50 - 50_i32.abs_diff(index as i32) as i32);
            rig_sample(1_000_000 + 20_000 * index, steps)
        })
        .collect();
    trial.samples = samples.len() as u64;
    (trial, samples)
}

fn executed(trial: &mut TrialRecord) -> &mut Executed {
    match &mut trial.action {
        Action::Run {
            executed: Some(executed),
            ..
        } => executed,
        other => panic!("{other:?}"),
    }
}

/// The single defect of a record, in parts.
fn only(defects: &Defects) -> &str {
    match (&defects.contradictions[..], &defects.gaps[..]) {
        ([one], []) | ([], [one]) => one,
        _ => panic!("{defects:?}"),
    }
}

/// The record of a run with a change, and whether it is a defect.
fn changed(change: impl FnOnce(&mut TrialRecord, &mut Vec<RigSample>)) -> Defects {
    let (mut trial, mut samples) = run_record();
    for stroke in 0..2 {
        let at_us = 2_000_000 + 1_000_000 * u64::from(stroke);
        let done = RigEvent::StrokeDone {
            stroke,
            residual_steps: 0,
        };
        trial.events.push(event(stroke, at_us, done));
    }
    change(&mut trial, &mut samples);
    run(&trial, &all(&trial, &samples))
}

#[test]
fn a_whole_record_has_no_defect() {
    assert_eq!(changed(|_, _| {}), Defects::default());
}

/// A sample may be 90 % of an interval late, or 10 ms if that is more.
#[test]
fn a_late_sample_is_no_gap() {
    for (interval_us, missed, longest) in [
        (20_000, 0, 38_000),
        (20_000, 1, 58_000),
        (5_000, 0, 15_000),
        (5_000, 3, 30_000),
        (1_000, 0, 11_000),
        (100_000, 0, 190_000),
    ] {
        assert_eq!(longest_us(interval_us, missed), longest, "{interval_us}");
    }
    for (late_us, gaps) in [(18_000, 0), (18_001, 1)] {
        let found = changed(|_, samples| {
            for sample in &mut samples[50..] {
                sample.time_us += late_us;
            }
        });
        assert_eq!(found.gaps.len(), gaps, "{found:?}");
        assert_eq!(found.contradictions.len(), 0);
    }
}

/// The median of those without a loss between them.
#[test]
fn lost_samples_do_not_change_the_interval() {
    let (trial, _) = run_record();
    let interval_us = |samples: &[RigSample]| all(&trial, samples).interval_us();
    let mut samples: Vec<_> = [0, 20_000, 40_000, 100_000, 160_000, 180_000]
        .map(|time_us| rig_sample(time_us, 0))
        .into();
    assert_eq!(interval_us(&samples), Some(20_000));
    samples[3].missed = 2;
    samples[4].missed = 2;
    assert_eq!(interval_us(&samples), Some(20_000));
    assert_eq!(interval_us(&samples[2..5]), None);
    assert_eq!(interval_us(&samples[..1]), None);
}

/// The run begins at its event. One interval more may pass before the first sample; two samples may be lost unnoticed
/// behind the last.
#[test]
fn the_telemetry_begins_and_ends_with_the_motion() {
    let begun = |trial: &mut TrialRecord, at_us: u64| {
        let started = RigEvent::RunStarted { run: 1 };
        trial.events.clear();
        trial.events.push(event(7, at_us, started));
        trial.lost_events = 1;
    };
    for (early_us, gap) in [(58_000, false), (58_001, true)] {
        let found = changed(|trial, _| begun(trial, 1_000_000 - early_us));
        assert_eq!(found.gaps.len(), usize::from(gap), "{found:?}");
        assert!(!gap || only(&found).contains("begins"), "{found:?}");
    }
    // 60 ms and 18 ms after the last sample.
    for (late_us, gap) in [(78_000, false), (78_001, true)] {
        let found = changed(|trial, _| begun(trial, 1_000_000 + late_us));
        assert_eq!(found.gaps.len(), usize::from(gap), "{found:?}");
        assert!(!gap || only(&found).contains("ends"), "{found:?}");
    }
    let found = changed(|trial, samples| {
        samples.clear();
        trial.samples = 0;
    });
    assert!(only(&found).contains("is empty"));
}

/// A fault that was latched behind the end of a motion is in the sidecar only, and is told there.
#[test]
fn only_a_fault_behind_the_end_may_differ_from_the_machines_record() {
    for (outcome, status, error, differs) in [
        (RunOutcome::Stopped, Status::Faulted, true, false),
        (RunOutcome::Stopped, Status::Faulted, false, true),
        (RunOutcome::Complete, Status::Faulted, true, false),
        (RunOutcome::LinkLost, Status::Faulted, true, false),
        (RunOutcome::Complete, Status::Faulted, false, true),
        (RunOutcome::Stopped, Status::Complete, true, true),
        (RunOutcome::Complete, Status::Stopped, true, true),
    ] {
        let found = changed(|trial, _| {
            executed(trial).outcome = outcome;
            trial.status = status;
            trial.error = error.then(|| "an emergency stop".to_owned());
        });
        assert_eq!(
            found.contradictions.len(),
            usize::from(differs),
            "{found:?}"
        );
    }
}

#[test]
fn what_was_executed_is_what_was_planned() {
    let one = |change: &dyn Fn(&mut Executed)| changed(|trial, _| change(executed(trial)));
    let found = one(&|executed| executed.plan_hash.push('0'));
    assert!(only(&found).contains("fingerprint"));
    let found = one(&|executed| executed.commanded_edges -= 1);
    assert_eq!(found.contradictions.len(), 2, "{found:?}");
    let found = one(&|executed| executed.strokes = 1);
    assert!(only(&found).contains("1 of 2 strokes"));
    let found = one(&|executed| executed.ticks += 1);
    assert!(only(&found).contains("it took"));
    let held = one(&|executed| (executed.ticks, executed.holds) = (200_000_001, 1));
    assert_eq!(held, Defects::default());
    let found = one(&|executed| executed.outcome = RunOutcome::Stopped);
    assert!(only(&found).contains("differ"));
}

#[test]
fn rows_agree_with_the_sidecar() {
    let found = changed(|trial, _| trial.samples += 1);
    assert!(only(&found).contains("101 rows, 102 were recorded"));
    let found = changed(|trial, _| trial.missed_samples = 2);
    assert!(only(&found).contains("0 samples were lost, by the sidecar 2"));
    let lost = changed(|trial, samples| (trial.missed_samples, samples[4].missed) = (2, 2));
    assert_eq!(lost, Defects::default());
    let found = changed(|_, samples| samples[5].origin = Origin::Board);
    assert!(only(&found).contains("origin"));
    let unknown = changed(|_, samples| samples[5].origin = Origin::Unknown);
    assert_eq!(unknown, Defects::default());
    let found = changed(|_, samples| samples[6].time_us = samples[5].time_us);
    assert!(only(&found).contains("between rows 6 and 7"));
    // While a trial runs, the final numbers are not known.
    let running = changed(|trial, samples| {
        trial.status = Status::Running;
        let Action::Run { executed, .. } = &mut trial.action else {
            panic!("a run");
        };
        *executed = None;
        (trial.samples, samples[4].missed) = (0, 1);
    });
    assert_eq!(running.contradictions, [""; 0]);
    assert!(
        running.gaps[0].contains("no end is recorded"),
        "{running:?}"
    );
}

/// 78 ms may pass behind the last sample.
#[test]
fn an_actuation_is_that_which_was_accepted_and_its_telemetry_covers_it() {
    let record = ActuationRecord {
        actuation: 4,
        kind: ActuationKind::Fold,
        outcome: ActuationOutcome::Complete,
        duration_ms: 478,
        thread_um: 21_000,
        end_current_ma: 150,
        peak_current_ma: 150,
        engaged_um: 1_000,
        energy_mj: 240,
        min_battery_mv: 3_600,
    };
    let unfold = ActuationRecord {
        kind: ActuationKind::Unfold,
        ..record
    };
    let longer = ActuationRecord {
        duration_ms: 479,
        ..record
    };
    for (record, number, wanted) in [
        (record, 4, ""),
        (longer, 4, "before the motion"),
        (record, 5, "another actuation"),
        (unfold, 4, "another kind"),
    ] {
        let mut trial = trial(Action::Actuation {
            actuation: ActuationKind::Fold,
            accepted: Some(ActuationAccepted {
                actuation: number,
                timeout_ms: 6_000,
            }),
            record: Some(record),
        });
        let samples: Vec<_> = (0..=20)
            .map(|index| CapsuleSample {
                time_us: 1_000_000 + 20_000 * index,
                state: "folding".to_owned(),
                thread_um: 21_000,
                current_ma: 30,
                battery_mv: 3_700,
                drive_mv: 2_000,
                missed: 0,
                origin: Origin::Virtual,
            })
            .collect();
        trial.samples = samples.len() as u64;
        let found = actuation(&trial, &all(&trial, &samples));
        match wanted {
            "" => assert_eq!(found, Defects::default()),
            wanted => assert!(only(&found).contains(wanted), "{found:?}"),
        }
    }
}

/// The tool was killed while it wrote the last row of a running trial; anywhere else a row that cannot be read is a
/// defect.
#[test]
fn only_a_running_trial_may_end_within_a_row() {
    let folder = tempfile::tempdir().expect("a folder");
    let sidecar = folder.path().join("fold.json");
    let header = "time_us,state,thread_um,current_ma,battery_mv,drive_mv,missed,origin\n";
    let row = "20000,Folding,1,2,3,4,0,virtual\n";
    for (status, rows, found, defects) in [
        (Status::Running, [row, "4000"], 1, 0),
        (Status::Complete, [row, "4000"], 1, 1),
        (Status::Running, ["4000\n", row], 0, 1),
    ] {
        let mut trial = trial(Action::Actuation {
            actuation: ActuationKind::Fold,
            accepted: None,
            record: None,
        });
        (trial.status, trial.telemetry) = (status, "fold.csv".to_owned());
        let text = [header, &rows.concat()].concat();
        std::fs::write(folder.path().join("fold.csv"), text).expect("written");
        let mut count = 0;
        let wrong = read(&sidecar, &trial, |_: CapsuleSample| count += 1);
        assert_eq!(
            (count, usize::from(wrong.is_some())),
            (found, defects),
            "{wrong:?}"
        );
    }
}

#[test]
fn a_status_that_the_record_does_not_bear_out_is_told() {
    let found = changed(|trial, _| {
        let Action::Run { achieved, .. } = &mut trial.action else {
            panic!("a run");
        };
        *achieved = None;
    });
    assert!(only(&found).contains("without what was planned or executed"));
    let bare = trial(Action::Actuation {
        actuation: ActuationKind::Fold,
        accepted: None,
        record: None,
    });
    let found = actuation(&bare, &Seen::default());
    assert!(only(&found).contains("without the capsule's record"));
}
