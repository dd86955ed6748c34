//! The real client against the real device session in memory: bad lines, lost events, resets, stops.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use client::error::{ClientError, Missing};
use client::{Begun, Device, Observer, Pace, Pacer, Progress, Unobserved};
use lab::trials::experiment::PAPER_RUN;
use protocol::capsule::ActuationOutcome;
use protocol::error::Refusal;
use protocol::rig::{MoveTo, RigEvent, RigFault, RigState, Run, RunOutcome};
use protocol::settings::{Setting, SettingKey};
use protocol::system::{DeviceKind, Event, ResetCause, Urgent, What};
use protocol::table::Telemetry;
use simulated_machines::link::{Memory, Peer};
use simulated_machines::machine::capsule::FOLDED_UM;
use simulated_machines::machine::{Script, SimulatedMachine, World, link};

use crate::support::plan::SHORT_RUN;

#[derive(Default)]
struct Seen {
    begun: u32,
    events: Vec<Event>,
    telemetry: u32,
    missed: u32,
    progress: Vec<Progress>,
    refused: Vec<(Pace, Refusal)>,
}

impl Observer for Seen {
    fn begun(&mut self, _: &Begun) {
        self.begun += 1;
    }
    fn telemetry(&mut self, _: &Telemetry, missed: u16) {
        self.telemetry += 1;
        self.missed += u32::from(missed);
    }
    fn event(&mut self, event: &Event) {
        self.events.push(*event);
    }
    fn progress(&mut self, progress: &Progress) {
        self.progress.push(*progress);
    }
    fn refused(&mut self, pace: Pace, refusal: &Refusal) {
        self.refused.push((pace, *refusal));
    }
}

fn homed_rig(
    script: Script,
) -> (
    Device,
    Arc<std::sync::Mutex<simulated_machines::machine::Log>>,
) {
    let (link, log) = link(script);
    let mut rig = Device::connect(link, DeviceKind::Rig, 11).expect("a rig");
    let accepted = rig.home().expect("accepted");
    rig.wait_homing(&accepted, &mut Unobserved).expect("homed");
    (rig, log)
}

fn count(names: &[&str], name: &str) -> usize {
    names.iter().filter(|heard| **heard == name).count()
}

#[test]
fn a_run_is_seen_from_its_start_to_its_end() {
    let (mut rig, log) = homed_rig(Script::new(DeviceKind::Rig));
    rig.set_telemetry(20).expect("set");
    let mut seen = Seen::default();
    let accepted = rig.run(PAPER_RUN).expect("accepted");
    let record = rig.wait_run(&accepted, &mut seen).expect("ends");
    assert_eq!(record.outcome, RunOutcome::Complete);
    assert_eq!(record.counted_edges, 1_040_000);
    assert_eq!(seen.begun, 1);
    assert!(seen.telemetry.abs_diff(2_000) <= 2, "{}", seen.telemetry);
    assert_eq!(seen.missed, 0);
    let strokes = seen
        .events
        .iter()
        .filter(|event| matches!(event.what, What::Rig(RigEvent::StrokeDone { .. })));
    assert_eq!(strokes.count(), 10);
    // 40 s at four reports a second. The machine would have stopped the run after 1 s of silence.
    assert!(
        seen.progress.len().abs_diff(160) <= 10,
        "{}",
        seen.progress.len()
    );
    assert_eq!(count(&log.lock().expect("log").executed, "Run"), 1);
}

#[test]
fn the_capsule_is_referenced_folded_and_unfolded() {
    let (link, _) = link(Script::new(DeviceKind::Capsule));
    let mut capsule = Device::connect(link, DeviceKind::Capsule, 1).expect("a capsule");
    assert!(matches!(
        capsule.fold(),
        Err(ClientError::Refused {
            refusal: Refusal::NotCalibrated,
            ..
        })
    ));
    // Unfolded means at zero or up to half a tenth before it. Folded means at the folded end by count,
    // within 0.15 mm of the estimate.
    let unfolded = 0..=60;
    let folded = FOLDED_UM - 150..=FOLDED_UM + 150;
    for (begin, thread_um) in [
        (Device::reference as fn(&mut Device) -> _, unfolded.clone()),
        (Device::fold, folded),
        (Device::unfold, unfolded),
    ] {
        let accepted = begin(&mut capsule).expect("accepted");
        let record = capsule
            .wait_actuation(&accepted, &mut Unobserved)
            .expect("ends");
        assert_eq!(record.outcome, ActuationOutcome::Complete);
        assert_eq!(record.actuation, accepted.actuation);
        assert!(thread_um.contains(&record.thread_um), "{record:?}");
        // The status is that of the motor at rest.
        capsule.idle(500_000, &mut Unobserved).expect("there");
        let status = capsule.capsule_status().expect("status");
        assert_eq!(record.thread_um, status.thread_um);
        assert_eq!(record, capsule.actuation_record().expect("record"));
    }
}

#[test]
fn on_a_bad_line_nothing_is_executed_twice_and_nothing_is_missed() {
    let mut retried = 0;
    for seed in 1..=12 {
        let mut script = Script::new(DeviceKind::Rig);
        script.flip_one_in = 3_000;
        script.seed = seed * 7_919;
        let (mut rig, log) = homed_rig(script);
        rig.set_telemetry(50).expect("set");
        let mut seen = Seen::default();
        let accepted = rig.run(SHORT_RUN).expect("accepted");
        let record = rig.wait_run(&accepted, &mut seen).expect("ends");
        assert_eq!(record.outcome, RunOutcome::Complete, "seed {seed}");
        let indices: Vec<_> = seen.events.iter().map(|event| event.index).collect();
        assert!(
            indices.windows(2).all(|pair| pair[1] == pair[0] + 1),
            "seed {seed}: {indices:?}"
        );
        assert_eq!(
            indices.len(),
            6,
            "seed {seed}: start, four strokes, end: {indices:?}"
        );
        let log = log.lock().expect("log");
        for command in ["Home", "Run"] {
            assert_eq!(count(&log.executed, command), 1, "seed {seed}: {command}");
        }
        retried += log.heard.len() - log.executed.len();
    }
    assert!(
        retried > 12,
        "the line was too good to show anything: {retried}"
    );
}

#[test]
fn lost_events_are_fetched_again_in_order() {
    let mut script = Script::new(DeviceKind::Rig);
    // Events: Booted 0, Homed 1, RunStarted 2, strokes 3..=6, RunEnded 7.
    script.silent_events = vec![3, 4, 6];
    let (mut rig, _) = homed_rig(script);
    let mut seen = Seen::default();
    let accepted = rig.run(SHORT_RUN).expect("accepted");
    rig.wait_run(&accepted, &mut seen).expect("ends");
    let indices: Vec<_> = seen.events.iter().map(|event| event.index).collect();
    assert_eq!(indices, [2, 3, 4, 5, 6, 7]);
    assert_eq!(rig.take_lost_events(), 0);
}

#[test]
fn an_end_whose_event_was_lost_is_found_by_the_status() {
    let mut script = Script::new(DeviceKind::Rig);
    script.silent_events = vec![1, 7];
    let (mut rig, _) = homed_rig(script);
    let mut seen = Seen::default();
    let accepted = rig.run(SHORT_RUN).expect("accepted");
    let begin_us = rig.now_us();
    let record = rig.wait_run(&accepted, &mut seen).expect("ends");
    assert_eq!(record.outcome, RunOutcome::Complete);
    assert!(rig.now_us() - begin_us < 4_600_000);
    assert!(matches!(
        seen.events.last().map(|event| event.what),
        Some(What::Rig(RigEvent::RunEnded { .. }))
    ));
}

#[test]
fn the_wrong_machine_is_named_and_left_alone() {
    let (link, log) = link(Script::new(DeviceKind::Capsule));
    let error = Device::connect(link, DeviceKind::Rig, 1)
        .err()
        .expect("it is a capsule");
    assert!(
        matches!(error, ClientError::WrongMachine { .. }),
        "{error:?}"
    );
    assert_eq!(
        error.to_string(),
        "test capsule is a capsule, not a rig; nothing was moved"
    );
    let help = miette::Diagnostic::help(&error).expect("help").to_string();
    assert!(help.contains("UID abababababababababababab"), "{help}");
    let heard = log.lock().expect("log").heard.clone();
    assert!(
        heard
            .iter()
            .all(|name| ["Hello", "GetEvents", "GetSetting"].contains(name)),
        "{heard:?}"
    );
}

#[test]
fn another_protocol_is_refused_with_the_remedy_and_can_still_be_stopped() {
    for (major, schema_key) in [
        (protocol::VERSION.major, 42),
        (0, protocol::table::SCHEMA_KEY),
    ] {
        let mut script = Script::new(DeviceKind::Rig);
        script.schema_key = schema_key;
        script.major = major;
        let (link, log) = link(script);
        let mut rig = Device::new(link, 3);
        rig.hello(3).expect("Hello works with everyone");
        let error = rig.require(DeviceKind::Rig).expect_err("they differ");
        let text = error.to_string();
        assert!(
            text.starts_with("flash the matching firmware (`cargo rig` "),
            "{text}"
        );
        assert!(
            text.contains(&format!("protocol {major}.{}", protocol::VERSION.minor)),
            "{text}"
        );
        assert!(text.contains(&format!("{schema_key:016x}")), "{text}");
        assert!(
            text.contains(&format!("{:016x}", protocol::table::SCHEMA_KEY)),
            "{text}"
        );
        assert_eq!(log.lock().expect("log").heard, ["Hello"]);
        rig.urgent(Urgent::EStop).expect("stops work with everyone");
        assert_eq!(log.lock().expect("log").urgent.len(), 1);
    }
}

#[test]
fn a_reset_under_way_ends_the_session_and_starts_nothing_again() {
    let mut script = Script::new(DeviceKind::Rig);
    script.world = vec![(5_000_000, World::Reset)];
    let (mut rig, log) = homed_rig(script);
    let accepted = rig.run(SHORT_RUN).expect("accepted");
    let error = rig
        .wait_run(&accepted, &mut Unobserved)
        .expect_err("it was reset");
    assert!(
        matches!(error, ClientError::SessionLost { .. }),
        "{error:?}"
    );
    assert!(matches!(
        rig.run(SHORT_RUN),
        Err(ClientError::SessionLost { .. })
    ));
    assert_eq!(count(&log.lock().expect("log").executed, "Run"), 1);
    // A new Hello finds the restarted machine at rest, in its second start. Nothing moves before a person has looked.
    let identity = rig.hello(12).expect("there");
    assert_eq!(
        (identity.boot_id, identity.reset_cause),
        (2, ResetCause::Watchdog)
    );
    let status = rig.rig_status().expect("status");
    assert_eq!(
        (status.state, status.fault, status.needs_acknowledge),
        (RigState::Faulted, Some(RigFault::Watchdog), true)
    );
    assert!(matches!(
        rig.home(),
        Err(ClientError::Refused {
            refusal: Refusal::AcknowledgeFirst,
            ..
        })
    ));
    rig.acknowledge().expect("looked");
    rig.home().expect("home again");
}

#[test]
fn the_operators_stop_reaches_the_machine_at_once() {
    let (mut rig, log) = homed_rig(Script::new(DeviceKind::Rig));
    let accepted = rig.run(PAPER_RUN).expect("accepted");
    let wish_us = rig.now_us() + 7_123_456;
    let clock = Arc::clone(&log);
    rig.set_interrupt(Arc::new(move || {
        (clock.lock().expect("log").now_us >= wish_us).then_some(Urgent::Stop)
    }));
    let record = rig.wait_run(&accepted, &mut Unobserved).expect("ends");
    assert_eq!(record.outcome, RunOutcome::Stopped);
    let urgent = log.lock().expect("log").urgent.clone();
    assert_eq!(urgent.len(), 1, "asked for once: {urgent:?}");
    let late_us = urgent[0].1 - wish_us;
    assert!(late_us <= 20_000, "{late_us} us late");
    assert_eq!(rig.interrupted(), Some(Urgent::Stop));
}

#[test]
fn a_second_wish_is_the_emergency_stop() {
    let mut script = Script::new(DeviceKind::Rig);
    script.deaf_to = vec![("Urgent", 2)];
    let (mut rig, log) = homed_rig(script);
    let accepted = rig.run(PAPER_RUN).expect("accepted");
    let asked = AtomicU64::new(0);
    rig.set_interrupt(Arc::new(move || {
        match asked.fetch_add(1, Ordering::Relaxed) {
            0..=9 => None,
            10..=12 => Some(Urgent::Stop),
            _ => Some(Urgent::EStop),
        }
    }));
    rig.wait_run(&accepted, &mut Unobserved).expect("ends");
    let urgent = log.lock().expect("log").urgent.clone();
    assert_eq!(urgent.last().map(|urgent| urgent.0), Some(Urgent::EStop));
    assert_eq!(rig.rig_status().expect("status").state, RigState::Faulted);
}

#[test]
fn a_stop_overtakes_a_pending_command_which_is_not_sent_again() {
    let mut script = Script::new(DeviceKind::Rig);
    script.deaf_to = vec![("Run", 1)];
    let (mut rig, log) = homed_rig(script);
    let wish_us = rig.now_us() + 50_000;
    let clock = Arc::clone(&log);
    rig.set_interrupt(Arc::new(move || {
        (clock.lock().expect("log").now_us >= wish_us).then_some(Urgent::Stop)
    }));
    let error = rig.run(SHORT_RUN).expect_err("stopped");
    assert!(
        matches!(error, ClientError::Interrupted { request: "Run" }),
        "{error:?}"
    );
    {
        let log = log.lock().expect("log");
        assert_eq!(log.urgent.len(), 1);
        assert_eq!(
            count(&log.heard, "Run"),
            0,
            "the lost frame was repeated after the stop"
        );
    }
    // The session goes on: somebody wants to know what became of the motion.
    assert_eq!(rig.rig_status().expect("answered").state, RigState::Ready);
    // After the wish to stop, nothing that moves may begin either.
    rig.hello(99).expect("a new session");
    assert!(matches!(
        rig.home(),
        Err(ClientError::Interrupted { request: "Home" })
    ));
    assert_eq!(
        rig.rig_status().expect("questions work").state,
        RigState::Ready
    );
}

/// As at the end of a jog, which sends a stop of its own.
#[test]
fn a_stop_does_not_replace_an_emergency_stop_that_was_not_confirmed() {
    let mut script = Script::new(DeviceKind::Rig);
    script.deaf_to = vec![("Urgent", 1)];
    let (mut rig, log) = homed_rig(script);
    rig.set_interrupt(Arc::new(|| Some(Urgent::EStop)));
    rig.observe(10_000, &mut Unobserved)
        .expect("sent, and lost");
    assert_eq!(log.lock().expect("log").urgent, []);
    rig.urgent(Urgent::Stop).expect("confirmed");
    let urgent = log.lock().expect("log").urgent.clone();
    assert_eq!(urgent.last().map(|urgent| urgent.0), Some(Urgent::EStop));
    assert_eq!(rig.rig_status().expect("status").state, RigState::Faulted);
}

/// An event that comes between the two first answers of a connection is reported by none of the later ones, and asked for
/// by none.
#[test]
fn an_event_while_connecting_is_not_asked_for_again_and_again() {
    // Ten strokes in 40 s: the first one ends while the host connects.
    let stroke_us = 4_000_000;
    for before_us in (0..20_000).step_by(500) {
        let mut script = Script::new(DeviceKind::Rig);
        script.running = Some((PAPER_RUN, stroke_us - before_us));
        let (link, log) = link(script);
        let mut rig = Device::connect(link, DeviceKind::Rig, 1).expect("a rig");
        rig.observe(1_000_000, &mut Unobserved).expect("it runs");
        let asked = count(&log.lock().expect("log").heard, "GetEvents");
        assert!(asked <= 4, "{before_us}: {asked} times");
    }
}

#[test]
fn a_stop_overtakes_a_question_that_is_not_answered() {
    let mut script = Script::new(DeviceKind::Rig);
    script.deaf_to = vec![("GetRigStatus", 4)];
    let (link, log) = link(script);
    let mut rig = Device::connect(link, DeviceKind::Rig, 1).expect("a rig");
    let clock = Arc::clone(&log);
    rig.set_interrupt(Arc::new(move || {
        (clock.lock().expect("log").now_us >= 150_000).then_some(Urgent::Stop)
    }));
    rig.rig_status().expect("answered in the end");
    let log = log.lock().expect("log");
    let place = |name: &str| log.heard.iter().position(|heard| *heard == name);
    assert!(place("Urgent") < place("GetRigStatus"), "{:?}", log.heard);
}

#[test]
fn silence_is_reported_as_what_it_means() {
    let dead = || {
        let mut script = Script::new(DeviceKind::Rig);
        script.dead = true;
        link(script).0
    };
    assert!(matches!(
        Device::connect(dead(), DeviceKind::Rig, 1),
        Err(ClientError::NoAnswer { .. })
    ));
    assert!(matches!(
        Device::new(dead(), 1).urgent(Urgent::Stop),
        Err(ClientError::Unanswered {
            missing: Missing::Stop,
            ..
        })
    ));

    let mut script = Script::new(DeviceKind::Rig);
    script.deaf_to = vec![("Run", 99), ("GetRunRecord", 99)];
    let (mut rig, _) = homed_rig(script);
    let error = rig.run(SHORT_RUN).expect_err("not heard");
    assert!(
        matches!(
            error,
            ClientError::Unanswered {
                request: "Run",
                missing: Missing::Outcome,
                ..
            }
        ),
        "{error:?}"
    );
    let error = rig.run_record().expect_err("not heard");
    assert!(
        matches!(
            error,
            ClientError::Unanswered {
                request: "GetRunRecord",
                missing: Missing::Reply,
                ..
            }
        ),
        "{error:?}"
    );
    rig.rig_status().expect("everything else still works");
}

/// An unanswered request reports the state of the motion. It once said only "SetTelemetry changes nothing, so nothing
/// was done", with the carriage moving.
#[test]
fn a_request_that_is_not_answered_says_what_is_known_of_the_motion() {
    let mut script = Script::new(DeviceKind::Rig);
    script.deaf_to = vec![("SetTelemetry", 99)];
    let (mut rig, _) = homed_rig(script);
    let error = rig.set_telemetry(20).expect_err("not heard");
    assert!(
        error.to_string().ends_with("asking moves nothing"),
        "{error}"
    );
    rig.run(SHORT_RUN).expect("accepted");
    let error = rig.set_telemetry(20).expect_err("not heard");
    assert!(error.to_string().contains("MAY BE MOVING"), "{error}");
}

#[test]
fn silence_while_something_moves_says_that_it_may_be_moving() {
    let mut script = Script::new(DeviceKind::Rig);
    script.ready = true;
    script.deaf_to = vec![("GetRigStatus", 99)];
    let mut rig = Device::connect(link(script).0, DeviceKind::Rig, 1).expect("a rig");
    let accepted = rig.run(SHORT_RUN).expect("accepted");
    let error = rig.wait_run(&accepted, &mut Unobserved);
    let error = error.expect_err("silent");
    let text = error.to_string();
    assert!(error.may_move(), "{error:?}");
    assert!(
        text.contains("the run") && text.contains("MAY BE MOVING"),
        "{text}"
    );
    assert!(!text.contains("nothing was done"), "{text}");
}

/// The operator's wishes, each at its time on the machine's clock.
fn wishes(
    log: &Arc<std::sync::Mutex<simulated_machines::machine::Log>>,
    wishes: Vec<(u64, Pace)>,
) -> Pacer {
    let clock = Arc::clone(log);
    let mut wishes = wishes.into_iter().peekable();
    Box::new(move || {
        let now_us = clock.lock().expect("log").now_us;
        wishes
            .next_if(|(time_us, _)| *time_us <= now_us)
            .map(|(_, pace)| pace)
    })
}

#[test]
fn a_run_is_held_and_resumed_by_the_one_who_waits_for_it() {
    let (mut rig, log) = homed_rig(Script::new(DeviceKind::Rig));
    let accepted = rig.run(SHORT_RUN).expect("accepted");
    let begin_us = rig.now_us();
    let hold_us = begin_us + 1_500_000;
    // Hold for much longer than the run may be late: a held run is not overdue, and the rig still hears the host.
    let resume_us = hold_us + 600_000_000;
    rig.set_pacer(wishes(
        &log,
        vec![(hold_us, Pace::Hold), (resume_us, Pace::Resume)],
    ));
    let mut seen = Seen::default();
    let record = rig.wait_run(&accepted, &mut seen).expect("ends");
    assert_eq!((record.outcome, record.holds), (RunOutcome::Complete, 1));
    assert!(seen.refused.is_empty());
    let (mut last_us, mut held) = (0, vec![]);
    for progress in &seen.progress {
        let Progress::Run {
            elapsed_us,
            total_us,
            held: stands,
            position_um,
            ..
        } = *progress
        else {
            panic!("{progress:?}");
        };
        assert!(
            (last_us..=total_us).contains(&elapsed_us),
            "the pause is not the run's time: {last_us}, {elapsed_us}"
        );
        last_us = elapsed_us;
        if stands {
            held.push((elapsed_us, position_um));
        }
    }
    assert!(last_us > 3_500_000, "{last_us}");
    assert!(held.len() > 2_000, "{}", held.len());
    assert!(held.iter().all(|at| *at == held[0]), "{:?}", held[0]);
    assert!(held[0].1 > 0);
    let log = log.lock().expect("log");
    assert_eq!(
        (count(&log.executed, "Hold"), count(&log.executed, "Resume")),
        (1, 1)
    );
    assert!(log.urgent.is_empty());
}

#[test]
fn a_resumed_run_that_does_not_end_is_stopped_all_the_same() {
    let mut script = Script::new(DeviceKind::Rig);
    // Homing takes 2.2 s; the timer fails 1 s into the run.
    script.world = vec![(3_500_000, World::TimerStands)];
    let (mut rig, log) = homed_rig(script);
    let accepted = rig.run(SHORT_RUN).expect("accepted");
    let begin_us = rig.now_us();
    rig.set_pacer(wishes(
        &log,
        vec![
            (begin_us + 1_000_000, Pace::Hold),
            (begin_us + 61_000_000, Pace::Resume),
        ],
    ));
    let error = rig
        .wait_run(&accepted, &mut Unobserved)
        .expect_err("overdue");
    assert!(matches!(error, ClientError::Overdue { .. }), "{error:?}");
    let late_us = rig.now_us() - begin_us;
    assert!((66_500_000..70_000_000).contains(&late_us), "{late_us}");
    assert_eq!(rig.run_record().expect("record").holds, 1);
}

#[test]
fn a_hold_that_is_refused_ends_no_wait() {
    let (mut rig, log) = homed_rig(Script::new(DeviceKind::Rig));
    let accepted = rig.run(SHORT_RUN).expect("accepted");
    let begin_us = rig.now_us();
    rig.set_pacer(wishes(&log, vec![(begin_us + 500_000, Pace::Resume)]));
    let mut seen = Seen::default();
    let record = rig.wait_run(&accepted, &mut seen).expect("ends");
    assert_eq!(record.outcome, RunOutcome::Complete);
    assert_eq!(seen.refused, [(Pace::Resume, Refusal::NothingToResume)]);
}

#[test]
fn a_stop_overtakes_a_hold_and_the_run_is_recorded_as_stopped() {
    // The hold is not heard. The stop comes while the host still waits for the hold.
    let mut script = Script::new(DeviceKind::Rig);
    script.deaf_to = vec![("Hold", 2)];
    let (mut rig, log) = homed_rig(script);
    let accepted = rig.run(SHORT_RUN).expect("accepted");
    let wish_us = rig.now_us() + 1_000_000;
    rig.set_pacer(wishes(&log, vec![(wish_us, Pace::Hold)]));
    let clock = Arc::clone(&log);
    rig.set_interrupt(Arc::new(move || {
        (clock.lock().expect("log").now_us >= wish_us + 50_000).then_some(Urgent::Stop)
    }));
    let mut seen = Seen::default();
    let record = rig.wait_run(&accepted, &mut seen).expect("ends");
    assert_eq!(record.outcome, RunOutcome::Stopped);
    let urgent = log.lock().expect("log").urgent.clone();
    assert_eq!(urgent.len(), 1);
    let late_us = urgent[0].1 - wish_us - 50_000;
    assert!(late_us <= 20_000, "{late_us} us late");
}

#[test]
fn a_held_run_is_stopped_by_the_operator() {
    let (mut rig, log) = homed_rig(Script::new(DeviceKind::Rig));
    let accepted = rig.run(SHORT_RUN).expect("accepted");
    let begin_us = rig.now_us();
    rig.set_pacer(wishes(&log, vec![(begin_us + 1_000_000, Pace::Hold)]));
    let clock = Arc::clone(&log);
    rig.set_interrupt(Arc::new(move || {
        (clock.lock().expect("log").now_us >= begin_us + 20_000_000).then_some(Urgent::Stop)
    }));
    let record = rig.wait_run(&accepted, &mut Unobserved).expect("ends");
    assert_eq!(record.outcome, RunOutcome::Stopped);
    assert!(rig.now_us() - begin_us < 20_500_000);
}

/// A machine whose clock is slower than the link's by a factor, like an emulator on a busy computer.
struct Slowed<P>(P, u64);

impl<P: Peer> Peer for Slowed<P> {
    fn take(&mut self, bytes: &[u8], now_us: u64) {
        self.0.take(bytes, now_us / self.1);
    }
    fn give(&mut self, now_us: u64) -> Vec<u8> {
        self.0.give(now_us / self.1)
    }
    fn next_us(&self) -> u64 {
        self.0.next_us().saturating_mul(self.1)
    }
}

#[test]
fn a_run_is_overdue_by_the_clock_of_the_machine() {
    let of = |factor, world| {
        let mut script = Script::new(DeviceKind::Rig);
        script.world = world;
        let (machine, log) = SimulatedMachine::new(script);
        let link = Memory::new("memory", Slowed(machine, factor));
        let mut rig = Device::connect(Box::new(link), DeviceKind::Rig, 11).expect("a rig");
        let accepted = rig.home().expect("accepted");
        rig.wait_homing(&accepted, &mut Unobserved).expect("homed");
        let accepted = rig.run(SHORT_RUN).expect("accepted");
        let ended = rig.wait_run(&accepted, &mut Unobserved);
        let urgent = log.lock().expect("log").urgent.len();
        (ended, urgent)
    };
    let (ended, urgent) = of(8, vec![]);
    assert_eq!(ended.expect("ends").outcome, RunOutcome::Complete);
    assert_eq!(urgent, 0);
    // Slow, and with a motion that never ends.
    let (ended, urgent) = of(8, vec![(3_500_000, World::TimerStands)]);
    let error = ended.expect_err("overdue");
    assert!(matches!(error, ClientError::Overdue { .. }), "{error:?}");
    assert_eq!(urgent, 1);
}

#[test]
fn idling_keeps_the_session_and_collects_events() {
    let (mut rig, _) = homed_rig(Script::new(DeviceKind::Rig));
    rig.run(SHORT_RUN).expect("accepted");
    let mut seen = Seen::default();
    rig.idle(6_000_000, &mut seen).expect("idle");
    assert_eq!(seen.events.len(), 6);
    assert_eq!(
        rig.run_record().expect("record").outcome,
        RunOutcome::Complete
    );
}

/// A rig that brakes slowly for a hold loses more time by it than the ramps of its run.
#[test]
fn a_run_whose_rig_brakes_slowly_for_a_hold_is_not_overdue() {
    let (mut rig, log) = homed_rig(Script::new(DeviceKind::Rig));
    let key = SettingKey::StopAccelUmS2;
    let value = key.range().min;
    rig.call(Setting { key, value }).expect("at rest");
    let run = Run {
        cycles: 3,
        ..PAPER_RUN
    };
    let accepted = rig.run(run).expect("accepted");
    let begin_us = rig.now_us();
    let wish = |at_s: u64, pace| (begin_us + at_s * 1_000_000, pace);
    let holds = (0..4).flat_map(|hold| {
        [
            wish(4 + 9 * hold, Pace::Hold),
            wish(9 + 9 * hold, Pace::Resume),
        ]
    });
    rig.set_pacer(wishes(&log, holds.collect()));
    let record = rig.wait_run(&accepted, &mut Unobserved).expect("ends");
    assert_eq!((record.outcome, record.holds), (RunOutcome::Complete, 4));
}

#[test]
fn a_homing_that_the_rig_has_stopped_in_silence_says_so() {
    let script = Script {
        settings: vec![(SettingKey::LinkTimeoutMs, 500)],
        deaf_to: vec![("GetRigStatus", 6)],
        ..Script::new(DeviceKind::Rig)
    };
    let mut rig = Device::connect(link(script).0, DeviceKind::Rig, 11).expect("a rig");
    let accepted = rig.home().expect("accepted");
    let ended = rig.wait_homing(&accepted, &mut Unobserved);
    assert!(
        matches!(
            ended,
            Err(ClientError::NotHomed {
                fault: None,
                link_lost: true
            })
        ),
        "{ended:?}"
    );
}

/// The host keeps to the rig's own link time-out, which is a setting.
#[test]
fn a_rig_with_the_shortest_link_timeout_hears_the_host_often_enough() {
    let mut script = Script::new(DeviceKind::Rig);
    let shortest_ms = SettingKey::LinkTimeoutMs.range().min;
    script.settings = vec![(SettingKey::LinkTimeoutMs, shortest_ms)];
    let (mut rig, _) = homed_rig(script);
    let accepted = rig.run(SHORT_RUN).expect("accepted");
    let mut seen = Seen::default();
    let record = rig.wait_run(&accepted, &mut seen).expect("ends");
    assert_eq!(record.outcome, RunOutcome::Complete);
    rig.run(SHORT_RUN).expect("accepted");
    rig.idle(5_000_000, &mut seen).expect("there");
    let record = rig.run_record().expect("record");
    assert_eq!(record.outcome, RunOutcome::Complete);
    let lost = seen.events.iter().any(|event| event.what == What::LinkLost);
    assert!(!lost, "{:?}", seen.events);
}

#[test]
fn a_run_that_the_rig_has_stopped_in_silence_is_recorded_as_that() {
    let mut script = Script::new(DeviceKind::Rig);
    script.settings = vec![(SettingKey::LinkTimeoutMs, 500)];
    // The host asks after a third of the time-out, and again every 0.1 s.
    script.deaf_to = vec![("GetRigStatus", 6)];
    script.ready = true;
    let (link, log) = link(script);
    let mut rig = Device::connect(link, DeviceKind::Rig, 11).expect("a rig");
    let accepted = rig.run(SHORT_RUN).expect("accepted");
    let begin_us = rig.now_us();
    let mut seen = Seen::default();
    let record = rig.wait_run(&accepted, &mut seen).expect("ends");
    assert_eq!(record.outcome, RunOutcome::LinkLost);
    assert_eq!(record.counted_edges, record.commanded_edges);
    assert!(rig.now_us() - begin_us < 800_000);
    let what: Vec<_> = seen.events.iter().map(|event| event.what).collect();
    let run = accepted.run;
    let stopped = match what[..] {
        [
            What::Rig(RigEvent::RunStarted { .. }),
            What::LinkLost,
            What::Rig(ended),
            What::Rig(RigEvent::Stopped { position_steps }),
        ] if ended
            == (RigEvent::RunEnded {
                run,
                outcome: RunOutcome::LinkLost,
            }) =>
        {
            position_steps
        }
        _ => panic!("{what:?}"),
    };
    let status = rig.rig_status().expect("status");
    assert_eq!(
        (status.state, status.position_steps),
        (RigState::Ready, stopped)
    );
    assert!(stopped > 0);
    assert!(log.lock().expect("log").urgent.is_empty());
}

#[test]
fn a_move_that_the_rig_has_stopped_in_silence_says_so() {
    let script = Script {
        settings: vec![(SettingKey::LinkTimeoutMs, 500)],
        deaf_to: vec![("GetRigStatus", 6)],
        ready: true,
        ..Script::new(DeviceKind::Rig)
    };
    let mut rig = Device::connect(link(script).0, DeviceKind::Rig, 11).expect("a rig");
    let to = MoveTo {
        position_um: 100_000,
        speed_um_s: 10_000,
    };
    let accepted = rig.call(to).expect("accepted");
    let (outcome, status) = rig.wait_move(&accepted, &mut Unobserved).expect("ends");
    assert_eq!(outcome, RunOutcome::LinkLost);
    assert_ne!(status.position_steps, accepted.to_steps);
}
