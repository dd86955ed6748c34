//! A fold or an unfolding at a certain place of a run: its start, and the fate of the run if it fails.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::support::asked::Asked;
use crate::support::plan::recording;
use crate::support::tool::{Memory, ready};
use client::error::{ClientError, Missing};
use client::link::owner::Question;
use client::{Clock, Device, Observer, Unobserved};
use lab::trials::coordination::{self, Coordinated, Recordings, Shaping};
use lab::trials::cue::Cue;
use lab::trials::experiment::{ExperimentError, PAPER_RUN};
use lab::trials::trial::{RigSample, Status, TrialRecord};
use protocol::capsule::{ActuationOutcome, CapsuleEvent, CapsuleState, GetActuationRecord};
use protocol::rig::{RigEvent, RigState, Run, RunTiming};
use protocol::settings::SettingKey;
use protocol::system::{DeviceKind, Event, Urgent, What};
use protocol::table::Endpoint as _;
use simulated_machines::machine::{Script, World, estop, link};

/// Three cycles of 10 mm, 2 s each.
const RUN: Run = Run {
    cycles: 3,
    stroke_um: 10_000,
    timing: RunTiming::Total {
        total_us: 6_000_000,
        accel_um_s2: 100_000,
    },
    ..PAPER_RUN
};

fn connected(
    script: Script,
) -> (
    Device,
    Arc<std::sync::Mutex<simulated_machines::machine::Log>>,
) {
    let kind = script.kind;
    let (link, log) = link(script);
    (Device::connect(link, kind, 5).expect("there"), log)
}

fn tied(
    (rig, capsule): (&mut Device, &mut Device),
    run: Run,
    what: (Shaping, Cue),
    observer: &mut dyn Observer,
) -> Coordinated {
    let folder = tempfile::tempdir().expect("a folder");
    let recordings = Recordings {
        run: &recording(folder.path(), "run", 10),
        actuation: &recording(folder.path(), "fold", 10),
    };
    let done = coordination::run((rig, capsule), run, what, &recordings, observer)
        .expect("the run is recorded");
    if let Ok(actuation) = &done.actuation {
        let read = TrialRecord::read(&actuation.sidecar).expect("a sidecar");
        assert_eq!(read, actuation.trial);
        assert_eq!(read.coordination.as_ref(), Some(&done.coordination));
        let run = folder.path().join(&done.coordination.run);
        assert_eq!(TrialRecord::read(&run).expect("the run's"), done.run.trial);
        if let (cue, Some(at_um)) = (what.1, what.1.at_um) {
            let rows = done.run.trial.samples::<RigSample>(&run).expect("rows");
            let cue_us = done.coordination.cue_time_us.expect("passed");
            assert_between_samples(&rows, 2 * u32::from(cue.cycle - 1), at_um, cue_us);
        }
    }
    done
}

/// The carriage was there between the samples of the stroke before and behind the place, in proportion to its way.
fn assert_between_samples(rows: &[RigSample], stroke: u32, at_um: u32, cue_us: u64) {
    let nm = |row: &RigSample| row.position_mm.parse::<f64>().expect("mm") * 1e6;
    let at_nm = f64::from(at_um) * 1e3;
    let pair = rows.windows(2).find(|pair| {
        pair.iter().all(|row| row.stroke == stroke) && nm(&pair[0]) < at_nm && nm(&pair[1]) >= at_nm
    });
    // The turning point may lie behind the last sample of the stroke.
    let Some([before, behind]) = pair else {
        assert!(at_um + 1 >= RUN.stroke_um, "{at_um} um");
        return;
    };
    let share = (at_nm - nm(before)) / (nm(behind) - nm(before));
    let took_us = (behind.time_us - before.time_us) as f64;
    let expected_us = before.time_us as f64 + share * took_us;
    assert!(
        (cue_us as f64 - expected_us).abs() <= 1.0,
        "{cue_us} for {expected_us}"
    );
}

fn at(cycle: u16, at_um: Option<u32>) -> (Shaping, Cue) {
    (Shaping::Fold, Cue { cycle, at_um })
}

fn time_of(events: &[Event], wanted: impl Fn(&What) -> bool) -> u64 {
    let found = events.iter().find(|event| wanted(&event.what));
    found.expect("it happened").time_us
}

#[test]
fn it_begins_within_20_ms_of_its_place() {
    let dwelling = Run {
        home_dwell_us: 300_000,
        timing: RunTiming::Total {
            total_us: 7_000_000,
            accel_um_s2: 100_000,
        },
        ..RUN
    };
    let delayed = Run {
        start_delay_us: 2_000_000,
        ..RUN
    };
    for (run, cycle, at_um) in [
        (RUN, 1, None),
        (delayed, 1, None),
        (delayed, 2, None),
        (RUN, 2, None),
        (RUN, 3, None),
        (dwelling, 1, None),
        (dwelling, 3, None),
        (RUN, 1, Some(2_000)),
        (RUN, 2, Some(7_000)),
        (RUN, 2, Some(9_999)),
        (RUN, 3, Some(10_000)),
    ] {
        let what = format!(
            "cycle {cycle}, {at_um:?} um, dwell {}, delay {}",
            run.home_dwell_us, run.start_delay_us
        );
        let (mut rig, _) = connected(ready(DeviceKind::Rig));
        let (mut capsule, _) = connected(ready(DeviceKind::Capsule));
        // Let the two devices' clocks differ.
        rig.idle(1_234_567, &mut Unobserved).expect("there");
        let both = (&mut rig, &mut capsule);
        let done = tied(both, run, at(cycle, at_um), &mut Unobserved);
        assert_eq!(done.run.trial.status, Status::Complete, "{what}");
        assert_eq!(done.run.record.counted_edges, 48_000, "{what}");
        let actuation = done.actuation.unwrap_or_else(|why| panic!("{what}: {why}"));
        assert_eq!(actuation.record.outcome, ActuationOutcome::Complete);
        let began_us = time_of(&actuation.trial.events, |what| {
            matches!(what, What::Capsule(CapsuleEvent::Started { .. }))
        });
        let place_us = match (cycle, at_um) {
            (_, Some(_)) => None,
            (1, None) => Some(
                u64::from(run.start_delay_us)
                    + time_of(&done.run.trial.events, |what| {
                        matches!(what, What::Rig(RigEvent::RunStarted { .. }))
                    }),
            ),
            (_, None) => Some(
                u64::from(run.home_dwell_us)
                    + time_of(&done.run.trial.events, |what| {
                        let last = 2 * u32::from(cycle) - 3;
                        matches!(what, What::Rig(RigEvent::StrokeDone { stroke, .. }) if *stroke == last)
                    }),
            ),
        };
        let told = &done.coordination;
        assert_eq!(told.began_time_us, Some(began_us), "{what}");
        if place_us.is_some() {
            assert_eq!(told.cue_time_us, place_us, "{what}");
        }
        let (least, most) = told.latency_us.expect("both clocks are known");
        assert!(least <= most && most - least < 20_000, "{what}: {told:?}");
        assert!(
            most > 0 && least < 20_000 && most < 30_000,
            "{what}: {told:?}"
        );
        assert_eq!(
            capsule.capsule_status().expect("there").state,
            CapsuleState::Folded
        );
    }
}

#[test]
fn a_folded_capsule_is_unfolded() {
    let (mut rig, _) = connected(ready(DeviceKind::Rig));
    let (mut capsule, _) = connected(ready(DeviceKind::Capsule));
    let accepted = capsule.fold().expect("ready");
    capsule
        .wait_actuation(&accepted, &mut Unobserved)
        .expect("there");
    let cue = Cue {
        cycle: 2,
        at_um: None,
    };
    let both = (&mut rig, &mut capsule);
    let done = tied(both, RUN, (Shaping::Unfold, cue), &mut Unobserved);
    assert!(done.actuation.is_ok());
    assert_eq!(
        capsule.capsule_status().expect("there").state,
        CapsuleState::Unfolded
    );
}

/// The run is the experiment: it continues if the capsule does not answer, refuses or stops.
#[test]
fn the_run_goes_on_whatever_becomes_of_the_capsule() {
    let deaf = |to: &[&'static str]| Script {
        deaf_to: to.iter().map(|name| (*name, 1_000)).collect(),
        ..ready(DeviceKind::Capsule)
    };
    let low = Script {
        world: vec![(1_000_000, World::Battery { mv: 2_600 })],
        ..ready(DeviceKind::Capsule)
    };
    let reset = Script {
        world: vec![(1_000_000, World::Reset)],
        ..ready(DeviceKind::Capsule)
    };
    for (name, script, says) in [
        ("deaf to Fold", deaf(&["Fold"]), "Fold"),
        (
            "deaf to all",
            deaf(&["Fold", "GetCapsuleStatus"]),
            "GetCapsuleStatus",
        ),
        ("an empty cell", low, ""),
        ("reset", reset, "session"),
    ] {
        let (mut rig, _) = connected(ready(DeviceKind::Rig));
        let (mut capsule, _) = connected(script);
        let both = (&mut rig, &mut capsule);
        let done = tied(both, RUN, at(2, None), &mut Unobserved);
        assert_eq!(done.run.trial.status, Status::Complete, "{name}");
        assert_eq!(done.run.record.counted_edges, 48_000, "{name}");
        let Err(ExperimentError::Incomplete {
            reason: Some(reason),
            sidecar,
            ..
        }) = done.actuation
        else {
            panic!("{name}: it cannot have been folded");
        };
        assert!(reason.contains(says), "{name}: {reason}");
        assert!(!sidecar.as_os_str().is_empty());
        assert_eq!(done.coordination.began_time_us, None, "{name}");
    }
}

/// Meanwhile the rig would hear nothing, not even a stop.
#[test]
fn the_host_does_not_wait_for_the_answer_to_a_client() {
    for dead in [true, false] {
        let (link, _) = link(Script {
            deaf_to: vec![("GetActuationRecord", if dead { 1_000 } else { 0 })],
            ..ready(DeviceKind::Capsule)
        });
        let (answers, answered) = std::sync::mpsc::channel();
        let question = Question::new(GetActuationRecord.into_request(), move |reply| {
            answers.send(reply).expect("heard");
        });
        let link = Box::new(Asked::at(1_000_000, link, question));
        let mut capsule = Device::connect(link, DeviceKind::Capsule, 5).expect("there");
        let mut longest_us = 0;
        while capsule.now_us() < 3_000_000 {
            let began_us = capsule.now_us();
            let answer = capsule.attend(began_us + 5_000, &mut Unobserved);
            assert_eq!(answer.expect("there"), None, "it is the client's");
            longest_us = longest_us.max(capsule.now_us() - began_us);
        }
        assert!(longest_us <= 5_000, "{longest_us} us");
        let reply = answered.try_recv().expect("the client is told");
        assert_eq!(reply.is_none(), dead, "{reply:?}");
    }
}

/// The run ends in the dwell before the fold, and a client's question keeps the capsule's line busy beyond that.
#[test]
fn nothing_is_folded_after_the_run() {
    let (link, log) = link(Script {
        deaf_to: vec![("GetActuationRecord", 1_000)],
        ..ready(DeviceKind::Capsule)
    });
    let question = Question::new(GetActuationRecord.into_request(), |_| {});
    let link = Box::new(Asked::at(1_400_000, link, question));
    let mut capsule = Device::connect(link, DeviceKind::Capsule, 5).expect("there");
    let (mut rig, _) = connected(Script {
        world: vec![(1_500_000, World::StopFrame)],
        ..ready(DeviceKind::Rig)
    });
    let delayed = Run {
        start_delay_us: 2_000_000,
        ..RUN
    };
    let both = (&mut rig, &mut capsule);
    let done = tied(both, delayed, at(1, None), &mut Unobserved);
    assert_eq!(done.run.trial.status, Status::Stopped);
    let why = done.actuation.expect_err("not begun").to_string();
    assert!(why.contains("in the dwell"), "{why}");
    assert!(!log.lock().expect("a log").executed.contains(&"Fold"));
}

/// A capsule that is lost before the run begins: nothing moves, and its record does not run for ever.
#[test]
fn a_capsule_that_is_lost_before_the_run_leaves_a_record_that_has_ended() {
    let (mut rig, rig_log) = connected(ready(DeviceKind::Rig));
    let (mut capsule, _) = connected(Script {
        deaf_to: vec![("SetTelemetry", 1_000)],
        ..ready(DeviceKind::Capsule)
    });
    let folder = tempfile::tempdir().expect("a folder");
    let recordings = Recordings {
        run: &recording(folder.path(), "run", 10),
        actuation: &recording(folder.path(), "fold", 10),
    };
    let both = (&mut rig, &mut capsule);
    let (what, observer) = (at(1, None), &mut Unobserved);
    let ran = coordination::run(both, RUN, what, &recordings, observer);
    assert!(ran.is_err(), "nothing to record");
    assert!(!rig_log.lock().expect("log").executed.contains(&"Run"));
    let files = std::fs::read_dir(folder.path()).expect("there").flatten();
    let mut sidecars = files.map(|file| file.path());
    let sidecar = sidecars.find(|path| path.extension().is_some_and(|end| end == "json"));
    let trial = TrialRecord::read(&sidecar.expect("the fold's")).expect("a record");
    assert_eq!(trial.status, Status::Unknown, "{trial:?}");
}

#[test]
fn a_run_that_ends_before_its_place_folds_nothing() {
    let (mut rig, _) = connected(Script {
        world: vec![(1_500_000, World::StopFrame)],
        ..ready(DeviceKind::Rig)
    });
    let (mut capsule, log) = connected(ready(DeviceKind::Capsule));
    let both = (&mut rig, &mut capsule);
    let done = tied(both, RUN, at(3, None), &mut Unobserved);
    assert_eq!(done.run.trial.status, Status::Stopped);
    let why = done.actuation.expect_err("not begun").to_string();
    assert!(why.contains("before cycle 3"), "{why}");
    assert_eq!(done.coordination.cue_time_us, None);
    assert!(!log.lock().expect("a log").executed.contains(&"Fold"));
}

/// Whatever ends the run early, such as the rig's own button, ends the fold, too.
#[test]
fn what_stops_the_rig_stops_the_fold() {
    for world in [estop(2_600_000), vec![(2_600_000, World::StopFrame)]] {
        let (mut rig, _) = connected(Script {
            world: world.clone(),
            ..ready(DeviceKind::Rig)
        });
        let (mut capsule, log) = connected(ready(DeviceKind::Capsule));
        let both = (&mut rig, &mut capsule);
        let done = tied(both, RUN, at(2, None), &mut Unobserved);
        assert_ne!(done.run.trial.status, Status::Complete);
        let fold = done.actuation.expect("it has begun");
        assert_eq!(fold.record.outcome, ActuationOutcome::Stopped, "{world:?}");
        assert_eq!(log.lock().expect("a log").urgent.len(), 1, "{world:?}");
    }
}

/// A capsule that does not confirm the stop may be moving: its error is not hidden behind that of the run.
#[test]
fn a_capsule_that_confirms_no_stop_is_told() {
    let (mut rig, _) = connected(Script {
        world: vec![(2_600_000, World::StopFrame)],
        ..ready(DeviceKind::Rig)
    });
    let (mut capsule, _) = connected(Script {
        deaf_to: vec![("Urgent", 1_000)],
        ..ready(DeviceKind::Capsule)
    });
    let both = (&mut rig, &mut capsule);
    let done = tied(both, RUN, at(2, None), &mut Unobserved);
    let why = done.actuation.expect_err("not confirmed");
    assert!(
        matches!(
            why,
            ExperimentError::Client(ClientError::Unanswered {
                missing: Missing::Stop,
                ..
            })
        ),
        "{why}"
    );
}

/// Both were lost with their hub: each is told, not the rig alone.
#[test]
fn a_capsule_that_is_lost_with_its_rig_is_told_too() {
    let deaf = |kind| Script {
        deaf_to: vec![("Urgent", 1_000)],
        ..ready(kind)
    };
    let (mut rig, _) = connected(deaf(DeviceKind::Rig));
    let (mut capsule, _) = connected(deaf(DeviceKind::Capsule));
    let mut operator = Operator::of([&mut rig, &mut capsule], Urgent::Stop, 2_600_000);
    let folder = tempfile::tempdir().expect("a folder");
    let recordings = Recordings {
        run: &recording(folder.path(), "run", 10),
        actuation: &recording(folder.path(), "fold", 10),
    };
    let both = (&mut rig, &mut capsule);
    let ended = coordination::run(both, RUN, at(2, None), &recordings, &mut operator);
    let told = ended.map(|_| ()).expect_err("both are lost").to_string();
    assert_eq!(
        told.matches("did not confirm the stop").count(),
        2,
        "{told}"
    );
}

/// Regression: a capsule that may be moving was hidden behind its record, whose folder was gone.
#[test]
fn a_capsule_that_is_lost_is_told_although_its_record_cannot_be_written() {
    /// Removes the folder once the operator wants a stop.
    struct Remover<'a>(Operator, Option<&'a Path>);
    impl Observer for Remover<'_> {
        fn turn(&mut self, now_us: u64, clock: Option<Clock>) {
            self.0.turn(now_us, clock);
            if self.0.wants.load(Ordering::Relaxed) > 0
                && let Some(folder) = self.1.take()
            {
                std::fs::remove_dir_all(folder).expect("removed");
            }
        }
    }
    let (mut rig, _) = connected(ready(DeviceKind::Rig));
    let (mut capsule, _) = connected(Script {
        deaf_to: vec![("Urgent", 1_000)],
        ..ready(DeviceKind::Capsule)
    });
    let operator = Operator::of([&mut rig, &mut capsule], Urgent::Stop, 2_600_000);
    let folder = tempfile::tempdir().expect("a folder");
    let of_fold = folder.path().join("usb-stick");
    let recordings = Recordings {
        run: &recording(folder.path(), "run", 10),
        actuation: &recording(&of_fold, "fold", 10),
    };
    let mut remover = Remover(operator, Some(&of_fold));
    let both = (&mut rig, &mut capsule);
    let ended = coordination::run(both, RUN, at(2, None), &recordings, &mut remover);
    let told = match ended {
        Ok(done) => done.actuation.map(|_| ()).expect_err("lost").to_string(),
        Err(error) => error.to_string(),
    };
    assert!(told.contains("did not confirm the stop"), "{told}");
}

#[test]
fn a_capsule_with_the_shortest_link_timeout_hears_the_host_often_enough() {
    let (mut rig, _) = connected(ready(DeviceKind::Rig));
    let shortest_ms = SettingKey::LinkTimeoutMs.range().min;
    let (mut capsule, _) = connected(Script {
        settings: vec![(SettingKey::LinkTimeoutMs, shortest_ms)],
        ..ready(DeviceKind::Capsule)
    });
    let both = (&mut rig, &mut capsule);
    let done = tied(both, RUN, at(2, None), &mut Unobserved);
    let fold = done.actuation.expect("it ends");
    assert_eq!(fold.record.outcome, ActuationOutcome::Complete);
}

/// An operator who wants a stop this long after the run has begun.
struct Operator {
    began_us: Option<u64>,
    after_us: u64,
    wants: Arc<AtomicU64>,
}

impl Operator {
    fn of(devices: [&mut Device; 2], wanted: Urgent, after_us: u64) -> Self {
        let wants = Arc::new(AtomicU64::new(0));
        for device in devices {
            let wants = Arc::clone(&wants);
            device.set_interrupt(Arc::new(move || {
                (wants.load(Ordering::Relaxed) > 0).then_some(wanted)
            }));
        }
        Self {
            began_us: None,
            after_us,
            wants,
        }
    }
}

impl Observer for Operator {
    fn turn(&mut self, now_us: u64, _: Option<Clock>) {
        let began_us = *self.began_us.get_or_insert(now_us);
        if now_us > began_us + self.after_us {
            self.wants.store(1, Ordering::Relaxed);
        }
    }
}

#[test]
fn the_operators_stop_goes_to_both() {
    // The fold begins 2 s after the run. Stop before it, in it, and almost at once with its command.
    for after_us in [1_000_000, 1_995_000, 2_003_000, 2_008_000, 2_600_000] {
        let (mut rig, _) = connected(ready(DeviceKind::Rig));
        let (mut capsule, log) = connected(ready(DeviceKind::Capsule));
        let mut operator = Operator::of([&mut rig, &mut capsule], Urgent::Stop, after_us);
        let both = (&mut rig, &mut capsule);
        let done = tied(both, RUN, at(2, None), &mut operator);
        assert_eq!(done.run.trial.status, Status::Stopped, "{after_us}");
        assert_eq!(rig.rig_status().expect("there").state, RigState::Ready);
        if let Ok(actuation) = &done.actuation {
            assert_eq!(actuation.trial.status, Status::Stopped, "{after_us}");
        }
        // The fold must not continue, whatever the host knows of it.
        drop(capsule);
        let log = log.lock().expect("a log");
        let folds = log.executed.iter().filter(|name| **name == "Fold").count();
        assert!(folds <= 1, "{after_us}: {:?}", log.executed);
        assert!(folds == 0 || !log.urgent.is_empty(), "{after_us}");
        assert_eq!(done.actuation.is_ok(), after_us == 2_600_000 || folds == 1);
    }
}

/// The stop comes while the fold is unanswered, and its first frame is lost.
#[test]
fn a_stop_that_meets_an_unanswered_fold_is_repeated_until_it_is_confirmed() {
    let (mut rig, _) = connected(ready(DeviceKind::Rig));
    let (mut capsule, log) = connected(Script {
        deaf_to: vec![("Fold", 1_000), ("Urgent", 1)],
        ..ready(DeviceKind::Capsule)
    });
    let mut operator = Operator::of([&mut rig, &mut capsule], Urgent::EStop, 2_010_000);
    let done = tied((&mut rig, &mut capsule), RUN, at(2, None), &mut operator);
    assert!(done.actuation.is_err());
    let urgent = log.lock().expect("a log").urgent.clone();
    assert_eq!(urgent.first().map(|urgent| urgent.0), Some(Urgent::EStop));
}

#[test]
fn the_command_line_says_what_is_wrong_before_anything_moves() {
    let run = [
        "run",
        "--stroke-mm",
        "10",
        "--cycles",
        "3",
        "--duration-s",
        "6",
    ];
    let (fresh, ready_one) = (Script::new(DeviceKind::Capsule), ready(DeviceKind::Capsule));
    for (args, capsule, code, says) in [
        (
            &["--fold-at-cycle", "4"][..],
            &ready_one,
            2,
            "the run has 3",
        ),
        (&["--at-mm", "5"], &ready_one, 2, "--fold-at-cycle"),
        (&["--fold-at-cycle", "2"], &fresh, 3, "capsule reference"),
        (
            &["--unfold-at-cycle", "2"],
            &ready_one,
            3,
            "`retrograde fold`",
        ),
    ] {
        let memory = Memory::with(vec![ready(DeviceKind::Rig), capsule.clone()]);
        let args = [&["--rig", "0", "--capsule", "1"], &run[..], args].concat();
        let (got, out, err) = memory.run(&args);
        assert_eq!(got, code, "{args:?}: {out}{err}");
        assert!(err.contains(says), "{args:?}: {err}");
        for moves in ["Run", "Fold", "Unfold"] {
            assert!(!memory.heard().contains(&moves), "{args:?} sent {moves}");
        }
    }
    let folder = tempfile::tempdir().expect("a folder");
    let out_folder = folder.path().to_str().expect("a name");
    let memory = Memory::with(vec![ready(DeviceKind::Rig), ready_one]);
    let args = [
        &["--rig", "0", "--capsule", "1"],
        &run[..],
        &["--fold-at-cycle", "2", "--at-mm", "5", "--out", out_folder],
    ]
    .concat();
    let (code, out, err) = memory.run(&args);
    assert_eq!(code, 0, "{out}{err}");
    assert!(
        out.contains("after the carriage passed 5 mm in cycle 2"),
        "{out}"
    );
    // If both fail, the run's failure is reported last and gives the exit code.
    let stopped = Script {
        world: vec![(1_500_000, World::StopFrame)],
        ..ready(DeviceKind::Rig)
    };
    let memory = Memory::with(vec![stopped, ready(DeviceKind::Capsule)]);
    let args = [
        &["--rig", "0", "--capsule", "1"],
        &run[..],
        &["--fold-at-cycle", "3", "--out", out_folder],
    ]
    .concat();
    let (code, out, err) = memory.run(&args);
    assert_eq!(code, 130, "{out}{err}");
    assert!(out.contains("before cycle 3"), "{out}");
    assert!(err.contains("the run"), "{err}");
}
