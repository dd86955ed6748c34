//! Every state with every event: the next state, and no other effect.

use capsule_plant::{Defect, Parameters};
use device::common::{About, Effect};
use device::settings::Values;
use firmware_capsule::{
    commands::{self, Context},
    fold::{Capsule, Command, Drive, Event},
    mechanics::{Counts, Thread},
    sample::Sample,
    settings::Settings,
};
use firmware_capsule::{kept::Totals, trace::Recording};
use protocol::{
    capsule::{
        ActuationOutcome, Calibrate, CapsuleEvent, CapsuleFault, CapsuleState, CapsuleStatus,
        CheckFolded, Fold, FoldTo, GetActuationRecord, GetCapsuleStatus, GetCapsuleTotals,
        GetTrace, Reference, Unfold,
    },
    error::{Field, Refusal},
    events::EventRing,
    rig, settings,
    system::{self, Acknowledge, GetEvents, GetLastWords, KeepAlive, SetTelemetry},
    table::{Impact, Reply, Request, Response},
};
use simulated_machines::plant::Simulation;

const STATES: [CapsuleState; 10] = [
    CapsuleState::Unreferenced,
    CapsuleState::Referencing,
    CapsuleState::Unfolded,
    CapsuleState::Folding,
    CapsuleState::Folded,
    CapsuleState::Unfolding,
    CapsuleState::Stopped,
    CapsuleState::Faulted,
    CapsuleState::WasFolded,
    CapsuleState::Checking,
];

fn sim_in(state: CapsuleState) -> Simulation {
    let mut sim = match state {
        CapsuleState::Unreferenced | CapsuleState::Referencing => Simulation::nominal(),
        _ => Simulation::calibrated(Parameters::nominal(), 0),
    };
    match state {
        CapsuleState::Unreferenced | CapsuleState::Unfolded => {}
        CapsuleState::Referencing => sim.run_past(Command::Reference, 10.0),
        CapsuleState::Folding => sim.run_past(Command::Fold, 10.0),
        CapsuleState::Folded => sim.run(Command::Fold),
        CapsuleState::Unfolding => {
            sim.run(Command::Fold);
            sim.run_past(Command::Unfold, 10.0);
        }
        CapsuleState::Stopped => {
            sim.run_past(Command::Fold, 10.0);
            sim.order(Command::Stop);
            sim.settle();
        }
        CapsuleState::Faulted => {
            sim.order(Command::EStop);
            sim.tick();
        }
        CapsuleState::WasFolded | CapsuleState::Checking => {
            sim.run(Command::Fold);
            sim.reset(true);
            if state == CapsuleState::Checking {
                sim.order(Command::CheckFolded);
            }
        }
    }
    assert_eq!(sim.capsule.state(), state);
    sim
}

/// The state after the event, or the refusal.
fn expected(sim: &Simulation, event: Event) -> Result<CapsuleState, Refusal> {
    use CapsuleState::{
        Checking, Faulted, Folded, Folding, Referencing, Stopped, Unfolded, Unfolding,
        Unreferenced, WasFolded,
    };
    let state = sim.capsule.state();
    let moving = matches!(state, Referencing | Checking | Folding | Unfolding);
    let calibrated = !matches!(state, Unreferenced | Referencing);
    let stopped = match state {
        Checking => Unreferenced,
        // The first reference run is a calibration, and its beginning is the zero.
        Referencing | Folding | Unfolding => Stopped,
        resting => resting,
    };
    match event {
        Event::Sample(_) => Ok(state),
        Event::LinkSilent | Event::Command(Command::Stop) => Ok(stopped),
        Event::Command(Command::EStop) => Ok(Faulted),
        Event::Command(Command::Acknowledge) if state == Faulted => Ok(Unreferenced),
        Event::Command(Command::Acknowledge) => Err(Refusal::NothingToAcknowledge),
        Event::Command(_) if state == Faulted => {
            Err(Refusal::CapsuleFaulted(CapsuleFault::EStopFrame))
        }
        Event::Command(_) if moving => Err(Refusal::CapsuleBusy(state)),
        Event::Command(Command::Calibrate) if matches!(state, Folded | Stopped) => {
            Err(Refusal::OutOfRange {
                field: Field::ThreadUm,
                requested: sim.capsule.thread().0 as u64,
                min: 0,
                max: 1_000,
            })
        }
        Event::Command(Command::Reference | Command::Calibrate) => Ok(Referencing),
        Event::Command(Command::CheckFolded) if !calibrated => Err(Refusal::NotCalibrated),
        Event::Command(Command::CheckFolded) => Ok(Checking),
        Event::Command(_) if matches!(state, Unreferenced | WasFolded) => {
            Err(Refusal::NotReferenced)
        }
        // Half way up: above Stopped and below Folded.
        Event::Command(Command::FoldTo(_)) if state == Folded => Ok(Unfolding),
        Event::Command(Command::FoldTo(_)) => Ok(Folding),
        Event::Command(Command::Fold) if state == Folded => Err(Refusal::AlreadyThere),
        Event::Command(Command::Fold) => Ok(Folding),
        Event::Command(Command::Unfold) if state == Unfolded => Err(Refusal::AlreadyThere),
        Event::Command(Command::Unfold) => Ok(Unfolding),
    }
}

#[test]
fn every_state_with_every_event() {
    for state in STATES {
        let sim = sim_in(state);
        let events = [
            Event::Sample(*sim.capsule.sample()),
            Event::LinkSilent,
            Event::Command(Command::Reference),
            Event::Command(Command::Calibrate),
            Event::Command(Command::CheckFolded),
            Event::Command(Command::Fold),
            Event::Command(Command::Unfold),
            Event::Command(Command::FoldTo(Thread(18_000))),
            Event::Command(Command::Stop),
            Event::Command(Command::EStop),
            Event::Command(Command::Acknowledge),
        ];
        for event in events {
            let mut capsule = sim.capsule.clone();
            let actions = capsule.step(sim.now_us, event);
            match expected(&sim, event) {
                Ok(next) => {
                    assert_eq!(actions.refusal, None, "{state:?} {event:?}");
                    assert_eq!(capsule.state(), next, "{state:?} {event:?}");
                }
                Err(refusal) => {
                    assert_eq!(actions.refusal, Some(refusal), "{state:?} {event:?}");
                    assert_eq!(
                        format!("{capsule:?}"),
                        format!("{:?}", sim.capsule),
                        "{state:?} {event:?}: a refusal changes nothing"
                    );
                    assert!(actions.events.is_empty(), "{state:?} {event:?}");
                }
            }
            // While moving, the speed loop may brake; at rest nothing drives.
            let drives = matches!(actions.drive, Drive::Millivolts(_));
            assert!(!drives || capsule.is_moving(), "{state:?} {event:?}");
            assert!(!capsule.is_moving() || actions.drive != Drive::Off);
        }
    }
}

#[test]
fn a_stop_acts_at_once_in_every_state() {
    for state in STATES {
        let sim = sim_in(state);
        let moving = sim.capsule.is_moving();
        for command in [Command::Stop, Command::EStop] {
            let mut capsule = sim.capsule.clone();
            let actions = capsule.step(sim.now_us, Event::Command(command));
            let next = expected(&sim, Event::Command(command)).expect("never refused");
            assert_eq!(actions.refusal, None);
            assert_eq!(capsule.state(), next, "{state:?} {command:?}");
            let drive = if moving { Drive::Brake } else { Drive::Off };
            assert_eq!(actions.drive, drive, "{state:?} {command:?}");
            let ended = CapsuleEvent::Ended {
                actuation: capsule.record().actuation,
                outcome: capsule.record().outcome,
            };
            assert_eq!(actions.events.contains(&ended), moving);
            let fault = (command == Command::EStop).then_some(CapsuleFault::EStopFrame);
            if let Some(fault) = fault {
                assert_eq!(capsule.fault(), Some(fault));
                let outcome = ActuationOutcome::Faulted(fault);
                assert!(!moving || capsule.record().outcome == outcome);
            } else if moving {
                assert_eq!(capsule.record().outcome, ActuationOutcome::Stopped);
            }
            assert!(fault.is_none() || !capsule.referenced());
        }
    }
}

/// The refusal of a calibration, and of a reference run that is one.
fn thread_that_is_left(sim: &mut Simulation, command: Command) -> u64 {
    match sim.give(Event::Command(command)).refusal {
        Some(Refusal::OutOfRange {
            field: Field::ThreadUm,
            requested,
            min: 0,
            max: 1_000,
        }) => requested,
        other => panic!("{command:?}: {other:?}"),
    }
}

/// The ways to end a calibration that has wound 4 mm.
fn cut_short(sim: &mut Simulation, how: usize) {
    sim.run_past(Command::Calibrate, 4.0);
    match how {
        0 => sim.order(Command::Stop),
        1 => {
            sim.give(Event::LinkSilent);
        }
        2 => sim.plant.suffer(Defect::Jam(3.2)),
        _ => sim.plant.suffer(Defect::Battery(2_500.0)),
    }
    sim.settle();
    sim.plant.suffer(Defect::Jam(100.0));
    sim.plant.suffer(Defect::Battery(3_700.0));
    sim.settle();
    if sim.capsule.fault().is_some() {
        sim.order(Command::Acknowledge);
    }
}

/// Thread that a calibration had wound before it was stopped became part of the unfolded end of the next one, and
/// `Unfolded` was not true any more.
#[test]
fn a_calibration_that_is_cut_short_leaves_no_thread_behind() {
    let new = Simulation::nominal();
    let known = sim_in(CapsuleState::Unfolded);
    for (sim, how) in [new, known]
        .iter()
        .flat_map(|sim| (0..4).map(move |how| (sim, how)))
    {
        let mut sim = sim.clone();
        let first = sim.kept;
        let begins_mm = sim.plant.wound_mm();
        cut_short(&mut sim, how);
        let case = format!("{how}, {first:?}");
        assert_eq!(sim.capsule.state(), CapsuleState::Stopped, "{case}");
        let left_um = thread_that_is_left(&mut sim, Command::Calibrate);
        assert!((3_900..4_500).contains(&left_um), "{case}: {left_um} um");
        if first.is_none() {
            let left_too_um = thread_that_is_left(&mut sim, Command::Reference);
            assert_eq!(left_too_um, left_um, "{case}");
            let refused = sim.give(Event::Command(Command::Fold)).refusal;
            assert_eq!(refused, Some(Refusal::NotCalibrated), "{case}");
        }
        sim.run(Command::Unfold);
        assert_eq!(sim.capsule.state(), CapsuleState::Unfolded, "{case}");
        let off_mm = sim.plant.wound_mm() - begins_mm;
        assert!((-0.05..0.1).contains(&off_mm), "{case}: {off_mm} mm");
        assert!(sim.plant.extremes_mm().0 >= 0.0, "{case}");
        sim.run(Command::Calibrate);
        let found = sim.capsule.calibration().expect("calibrated").folded.0;
        assert!(found.abs_diff(21_500) < 200, "{case}: {found} um");
    }
}

/// It has found the end, and has not measured the tension: the calibration is not in force, and its zero is known.
#[test]
fn a_calibration_that_is_stopped_after_its_end_is_unfolded_before_the_next() {
    for mut sim in [Simulation::nominal(), sim_in(CapsuleState::Unfolded)] {
        let kept = sim.kept;
        sim.order(Command::Calibrate);
        while !matches!(sim.capsule.drive(), Drive::Millivolts(..0)) {
            assert!(sim.capsule.is_moving());
            sim.tick();
        }
        sim.order(Command::Stop);
        sim.settle();
        assert_eq!(sim.kept, kept, "in force");
        assert_eq!(sim.capsule.state(), CapsuleState::Stopped, "{kept:?}");
        let left_um = thread_that_is_left(&mut sim, Command::Calibrate);
        assert!((20_500..22_000).contains(&left_um), "{left_um} um");
        sim.run(Command::Unfold);
        assert_eq!(sim.capsule.state(), CapsuleState::Unfolded, "{kept:?}");
        assert!(sim.plant.extremes_mm().0 >= 0.0, "{kept:?}");
    }
}

/// Where it began may not have been unfolded: a person has said so, and a reference run finds out.
#[test]
fn a_calibration_from_an_unknown_place_that_is_cut_short_is_referenced_first() {
    for how in 0..4 {
        let mut sim = sim_in(CapsuleState::Unfolded);
        sim.reset(false);
        cut_short(&mut sim, how);
        assert_eq!(sim.capsule.state(), CapsuleState::Unreferenced, "{how}");
        let left_um = thread_that_is_left(&mut sim, Command::Calibrate);
        assert!((3_900..4_500).contains(&left_um), "{how}: {left_um} um");
        let mut restarted = sim.clone();
        restarted.reset(false);
        restarted.order(Command::Calibrate);
        sim.run(Command::Reference);
        assert_eq!(sim.capsule.state(), CapsuleState::Unfolded, "{how}");
        assert!(sim.plant.extremes_mm().0 >= 0.0, "{how}");
        sim.order(Command::Calibrate);
    }
}

/// Thread that lay on the spool when a motion was broken off became part of the unfolded end of the next calibration.
#[test]
fn thread_that_is_wound_where_the_place_is_lost_is_not_taken_for_unfolded() {
    type Loss = fn(&mut Simulation);
    let losses: [(&str, Loss); 5] = [
        ("emergency stop in a fold", |sim| {
            sim.run_past(Command::Fold, 4.0);
            sim.order(Command::EStop);
        }),
        ("emergency stop between the ends", |sim| {
            sim.run(Command::FoldTo(Thread(4_000)));
            sim.order(Command::EStop);
        }),
        ("stop of a reference run", |sim| {
            sim.run(Command::FoldTo(Thread(4_000)));
            sim.run_past(Command::Reference, 5.0);
            sim.order(Command::Stop);
        }),
        ("emergency stop of a reference run", |sim| {
            sim.run(Command::FoldTo(Thread(4_000)));
            sim.run_past(Command::Reference, 5.0);
            sim.order(Command::EStop);
        }),
        ("stop of a reference run after an emergency stop", |sim| {
            sim.run_past(Command::Fold, 4.0);
            sim.order(Command::EStop);
            sim.settle();
            sim.order(Command::Acknowledge);
            sim.run_past(Command::Reference, 5.0);
            sim.order(Command::Stop);
        }),
    ];
    for (name, lose) in losses {
        let mut sim = sim_in(CapsuleState::Unfolded);
        lose(&mut sim);
        sim.settle();
        if sim.capsule.fault().is_some() {
            sim.order(Command::Acknowledge);
        }
        assert_eq!(sim.capsule.state(), CapsuleState::Unreferenced, "{name}");
        let left_um = thread_that_is_left(&mut sim, Command::Calibrate);
        assert!((3_900..5_700).contains(&left_um), "{name}: {left_um} um");
        sim.run(Command::Reference);
        assert_eq!(sim.capsule.state(), CapsuleState::Unfolded, "{name}");
        sim.run(Command::Calibrate);
        let found = sim.capsule.calibration().expect("calibrated").folded.0;
        assert!(found.abs_diff(21_500) < 300, "{name}: {found} um");
    }
}

/// A thread that was exchanged has another place: what a defect has left does not stand in the way of a calibration.
#[test]
fn a_defect_forgets_where_the_thread_was_unfolded() {
    let mut sim = sim_in(CapsuleState::Unfolded);
    sim.run_past(Command::Fold, 4.0);
    sim.order(Command::EStop);
    sim.settle();
    sim.order(Command::Acknowledge);
    sim.plant.suffer(Defect::Encoder);
    sim.run(Command::Reference);
    assert_eq!(sim.capsule.fault(), Some(CapsuleFault::EncoderLost));
    sim.order(Command::Acknowledge);
    sim.order(Command::Calibrate);
}

/// A capsule that a person has taken for unfolded is folded: nothing was wound, so nothing is known.
#[test]
fn a_calibration_that_has_hardly_wound_anything_tells_no_place() {
    for kept in [None, sim_in(CapsuleState::Unfolded).kept] {
        let mut sim = Simulation::nominal();
        sim.kept = kept;
        sim.reset(false);
        sim.run_past(Command::Calibrate, 0.5);
        sim.run(Command::Stop);
        assert_eq!(sim.capsule.state(), CapsuleState::Unreferenced);
        sim.order(Command::Calibrate);
    }
}

#[test]
fn after_a_failed_start_nothing_moves_until_acknowledged() {
    for fault in [CapsuleFault::Watchdog, CapsuleFault::Panic] {
        let mut sim = Simulation::nominal();
        sim.capsule = Capsule::new(Some(fault), None, None, Settings::REFERENCE);
        sim.tick();
        for command in [Command::Reference, Command::Fold, Command::Unfold] {
            let refusal = sim.give(Event::Command(command)).refusal;
            assert_eq!(refusal, Some(Refusal::AcknowledgeFirst));
        }
        sim.order(Command::EStop);
        assert_eq!(sim.capsule.fault(), Some(fault), "the first cause is kept");
        sim.order(Command::Acknowledge);
        sim.run(Command::Reference);
        assert_eq!(sim.capsule.state(), CapsuleState::Unfolded);
    }
}

/// A motion that turns round brakes, and the next reading drives it on. An order in between must not: the effort of the
/// leg before would be in force for it.
#[test]
fn a_refused_order_drives_nothing_between_two_legs() {
    let mut sim = sim_in(CapsuleState::Folded);
    sim.order(Command::Unfold);
    while sim.capsule.drive() != Drive::Brake {
        sim.tick();
    }
    assert_eq!(sim.capsule.state(), CapsuleState::Unfolding);
    for after_us in [39_999, 40_000, 40_999] {
        let mut capsule = sim.capsule.clone();
        let actions = capsule.step(sim.now_us + after_us, Event::Command(Command::Fold));
        let busy = Refusal::CapsuleBusy(CapsuleState::Unfolding);
        assert_eq!(actions.refusal, Some(busy));
        assert_eq!(actions.drive, Drive::Brake, "{after_us} us later");
    }
}

/// The reading that follows, with the count this much further.
fn leap(sim: &mut Simulation, counts: i32) {
    let mut sample = *sim.capsule.sample();
    sample.counts = Counts(sample.counts.0 + counts);
    sim.now_us += 1_000;
    sim.give(Event::Sample(sample));
}

/// Millimetres of thread within a millisecond: whatever the encoder says ends in a fault, and in no overflow.
#[test]
fn a_count_that_leaps_is_a_fault() {
    for counts in [-4_000_000, 4_000_000] {
        let mut sim = sim_in(CapsuleState::Unfolded);
        sim.run_past(Command::Fold, 10.0);
        leap(&mut sim, counts);
        assert_eq!(sim.capsule.state(), CapsuleState::Faulted, "{counts}");
    }
}

/// A calibration that is at its zero before it has measured the tension has calibrated nothing.
#[test]
fn a_leap_to_zero_does_not_complete_a_calibration() {
    let mut sim = Simulation::nominal();
    sim.order(Command::Calibrate);
    while !matches!(sim.capsule.drive(), Drive::Millivolts(..0)) {
        sim.tick();
    }
    leap(&mut sim, -20_000);
    assert_eq!(sim.capsule.fault(), Some(CapsuleFault::SlipOrBreak));
    assert!(!sim.capsule.referenced());
    assert_eq!((sim.capsule.calibration(), sim.kept), (None, None));
}

#[test]
fn nothing_starts_before_the_battery_was_measured() {
    let mut capsule = Capsule::new(None, None, None, Settings::REFERENCE);
    let actions = capsule.step(0, Event::Command(Command::Reference));
    assert!(matches!(
        actions.refusal,
        Some(Refusal::BatteryLow { battery_mv: 0, .. })
    ));
}

fn reply(sim: &mut Simulation, request: Request) -> (Reply, Effect<Settings>) {
    let ring = EventRing::new();
    let (recording, totals) = (Recording::new(), Totals::default());
    let context = Context {
        recording: &recording,
        totals: &totals,
        rests: !sim.capsule.is_moving(),
        now_us: sim.now_us,
        about: About {
            kind: system::DeviceKind::Capsule,
            events: &ring,
            last_words: "it ended badly",
            chip: system::Chip {
                clock: system::Clock::Internal,
                brown_out: system::BrownOut::Level2,
                supply_low: true,
                option_bytes: 0x00FF_AAE5,
            },
            values: &Values::DEFAULT,
            name: "c-1",
        },
    };
    let executed = commands::execute(request, &mut sim.capsule, &context);
    (executed.reply, executed.effect)
}

fn is_for_the_rig(request: &Request) -> bool {
    matches!(
        request,
        Request::GetRigStatus(_)
            | Request::Home(_)
            | Request::Run(_)
            | Request::GetRunRecord(_)
            | Request::Hold(_)
            | Request::Resume(_)
            | Request::Jog(_)
            | Request::MoveTo(_)
            | Request::GetSetting(_)
            | Request::SetSetting(_)
            | Request::GetRigHealth(_)
            | Request::GetRigHardware(_)
    )
}

#[test]
fn every_row_of_the_table_is_answered_by_its_response_or_refused() {
    let requests = [
        Request::KeepAlive(KeepAlive),
        Request::GetLastWords(GetLastWords),
        Request::SetTelemetry(SetTelemetry { period_ms: 20 }),
        Request::GetEvents(GetEvents { from: 0 }),
        Request::Acknowledge(Acknowledge),
        Request::GetRigStatus(rig::GetRigStatus),
        Request::Home(rig::Home),
        Request::GetRunRecord(rig::GetRunRecord),
        Request::GetCapsuleStatus(GetCapsuleStatus),
        Request::Reference(Reference),
        Request::Fold(Fold),
        Request::Unfold(Unfold),
        Request::GetActuationRecord(GetActuationRecord),
        Request::Hold(rig::Hold),
        Request::Resume(rig::Resume),
        Request::MoveTo(rig::MoveTo {
            position_um: 1,
            speed_um_s: 1,
        }),
        Request::Jog(rig::Jog {
            sense: rig::Direction::Away,
            speed_um_s: 1,
        }),
        Request::GetSetting(settings::GetSetting {
            key: settings::SettingKey::LeadUm,
        }),
        Request::SetSetting(settings::Setting {
            key: settings::SettingKey::LeadUm,
            value: 4_000,
        }),
        Request::FactoryReset(settings::FactoryReset),
        Request::GetName(settings::GetName),
        Request::SetName(settings::Name {
            name: "capsule".try_into().unwrap(),
        }),
        Request::GetRigHealth(rig::GetRigHealth),
        Request::GetRigHardware(rig::GetRigHardware),
        Request::GetChip(system::GetChip),
        Request::Calibrate(Calibrate),
        Request::CheckFolded(CheckFolded),
        Request::GetTrace(GetTrace { from: 0 }),
        Request::GetCapsuleTotals(GetCapsuleTotals),
        Request::FoldTo(FoldTo { thread_um: 12_000 }),
    ];
    // Hello belongs to the session; Run differs from the other rig rows in its body only.
    assert_eq!(requests.len() + 2, Request::NAMES.len());
    for state in STATES {
        let mut sim = sim_in(state);
        let before = sim.capsule.clone();
        for request in requests.clone() {
            sim.capsule = before.clone();
            let name = request.name();
            let (answer, effect) = reply(&mut sim, request.clone());
            match answer {
                Reply::Accepted(response) => {
                    let named = format!("{response:?}");
                    assert!(named.starts_with(name), "{name} got {named}");
                    assert!(!is_for_the_rig(&request));
                    let starts = sim.capsule.is_moving() && !before.is_moving();
                    assert!(state != CapsuleState::Faulted || !starts);
                    let impact = match effect {
                        Effect::Acknowledged => Impact::Fault,
                        Effect::Store(_) => Impact::Flash,
                        _ if starts => Impact::Motion,
                        _ => Impact::None,
                    };
                    assert_eq!(request.impact(), impact, "{name}");
                }
                Reply::Refused(refusal) => {
                    assert_eq!(
                        refusal == Refusal::WrongDevice,
                        is_for_the_rig(&request),
                        "{name}"
                    );
                    let query = request.impact() == Impact::None && !is_for_the_rig(&request);
                    assert!(!query, "{name} refused in {state:?}");
                }
                other => panic!("{other:?}"),
            }
        }
    }
}

#[test]
fn only_an_accepted_acknowledge_is_recorded_as_such() {
    for state in STATES {
        let sim = sim_in(state);
        let requests = [
            Request::Reference(Reference),
            Request::Fold(Fold),
            Request::Unfold(Unfold),
            Request::Acknowledge(Acknowledge),
            Request::KeepAlive(KeepAlive),
        ];
        for request in requests {
            let mut sim = sim.clone();
            let acknowledged =
                state == CapsuleState::Faulted && matches!(request, Request::Acknowledge(_));
            let effect = if acknowledged {
                Effect::Acknowledged
            } else {
                Effect::None
            };
            assert_eq!(reply(&mut sim, request.clone()).1, effect, "{request:?}");
        }
    }
}

#[test]
fn an_accepted_motion_tells_its_number_and_its_timeout() {
    let cases = [
        (CapsuleState::Unreferenced, Request::Reference(Reference), 1),
        (CapsuleState::Unfolded, Request::Fold(Fold), 2),
        (CapsuleState::Folded, Request::Unfold(Unfold), 3),
    ];
    for (state, request, number) in cases {
        let mut sim = sim_in(state);
        let (accepted, timeout_ms) = match reply(&mut sim, request).0 {
            Reply::Accepted(Response::Reference(accepted)) => (accepted, 16_000),
            Reply::Accepted(Response::Fold(accepted)) => (accepted, 8_000),
            Reply::Accepted(Response::Unfold(accepted)) => (accepted, 4_000),
            other => panic!("{other:?}"),
        };
        assert_eq!(
            (accepted.actuation, accepted.timeout_ms),
            (number, timeout_ms)
        );
        assert!(sim.capsule.is_moving());
    }
}

fn status(sim: &mut Simulation) -> CapsuleStatus {
    match reply(sim, Request::GetCapsuleStatus(GetCapsuleStatus)).0 {
        Reply::Accepted(Response::GetCapsuleStatus(status)) => status,
        other => panic!("{other:?}"),
    }
}

#[test]
fn the_status_asks_for_an_acknowledge_after_a_watchdog_reset_or_a_panic_only() {
    let cases = [
        (Some(CapsuleFault::Watchdog), true),
        (Some(CapsuleFault::Panic), true),
        (Some(CapsuleFault::Timeout), false),
        (Some(CapsuleFault::EStopFrame), false),
        (None, false),
    ];
    for (fault, needs_acknowledge) in cases {
        let mut sim = Simulation::nominal();
        sim.capsule = Capsule::new(fault, None, None, Settings::REFERENCE);
        let status = status(&mut sim);
        assert_eq!(status.fault, fault);
        assert_eq!(status.needs_acknowledge, needs_acknowledge, "{fault:?}");
    }
}

#[test]
fn the_answers_say_what_they_should() {
    let mut sim = sim_in(CapsuleState::Folding);
    let status = status(&mut sim);
    assert_eq!(
        (status.state, status.referenced, status.actuation),
        (CapsuleState::Folding, true, 2)
    );
    assert!((9_900..10_200).contains(&status.thread_um), "{status:?}");
    let sample = *sim.capsule.sample();
    assert_eq!(status.time_us, sim.now_us);
    assert_eq!(
        (status.current_ma, status.battery_mv),
        (sample.magnitude_ma(), sample.battery_mv)
    );
    let telemetry = commands::telemetry(&sim.capsule, 77);
    assert_eq!(telemetry.time_us, 77);
    assert!((100..3_700).contains(&telemetry.drive_mv), "{telemetry:?}");
    assert_eq!(telemetry.state, CapsuleState::Folding);
    assert_eq!(telemetry.thread_um, status.thread_um);
    assert_eq!(
        (telemetry.current_ma, telemetry.battery_mv),
        (sample.magnitude_ma(), sample.battery_mv)
    );
    let mut paying_out = sim_in(CapsuleState::Unfolding);
    let drive_mv = |sim: &Simulation| commands::telemetry(&sim.capsule, 0).drive_mv;
    assert!((-3_700..-100).contains(&drive_mv(&paying_out)));
    paying_out.order(Command::Stop);
    assert_eq!(drive_mv(&paying_out), 0, "braked");
    paying_out.settle();
    assert_eq!(drive_mv(&paying_out), 0, "asleep");

    let (record, _) = reply(&mut sim, Request::GetActuationRecord(GetActuationRecord));
    assert_eq!(
        record,
        Reply::Accepted(Response::GetActuationRecord(sim.capsule.record()))
    );

    let (words, _) = reply(&mut sim, Request::GetLastWords(GetLastWords));
    assert!(
        matches!(words, Reply::Accepted(Response::GetLastWords(words)) if words.text == "it ended badly")
    );
    for (period_ms, accepted) in [
        (0, true),
        (4, false),
        (5, true),
        (1_000, true),
        (1_001, false),
    ] {
        let request = Request::SetTelemetry(SetTelemetry { period_ms });
        let (reply, effect) = reply(&mut sim, request);
        if accepted {
            assert_eq!(effect, Effect::Telemetry { period_ms });
        } else {
            let requested = u64::from(period_ms);
            let refusal = Refusal::OutOfRange {
                field: Field::PeriodMs,
                requested,
                min: 5,
                max: 1_000,
            };
            assert_eq!((reply, effect), (Reply::Refused(refusal), Effect::None));
        }
    }
}

/// A reading without a supply has no zero of the amplifier either. One of them is no fault.
#[test]
fn a_reading_without_a_supply_casts_no_doubt_on_a_fold() {
    let mut sim = Simulation::new(
        Parameters {
            sense_offset_mv: 12.0,
            ..Parameters::nominal()
        },
        0,
    );
    sim.run(Command::Calibrate);
    sim.run(Command::Fold);
    let usual = *sim.capsule.sample();
    assert!((10..15).contains(&usual.offset_ma), "{usual:?}");
    sim.give(Event::Sample(Sample {
        current_ua: 0,
        offset_ma: 0,
        battery_mv: 0,
        ..usual
    }));
    sim.settle();
    assert_eq!(sim.capsule.fault(), None);
    assert_eq!(sim.capsule.state(), CapsuleState::Folded);
}
