//! Every state with every event: what happens next, and that nothing else does.

#[allow(dead_code)] // the scenarios use all of it
mod plant;

use firmware_capsule::{
    commands::{self, Context, Effect},
    fold::{Capsule, Command, Drive, Event},
};
use plant::{Bench, Plant};
use protocol::{
    capsule::{
        CapsuleFault, CapsuleState, Fold, GetActuationRecord, GetCapsuleStatus, Reference, Unfold,
    },
    error::{Field, Refusal},
    events::EventRing,
    rig, settings,
    system::{Acknowledge, GetEvents, GetLastWords, KeepAlive, SetTelemetry},
    table::{Impact, Reply, Request, Response},
};

const STATES: [CapsuleState; 8] = [
    CapsuleState::Unreferenced,
    CapsuleState::Referencing,
    CapsuleState::Unfolded,
    CapsuleState::Folding,
    CapsuleState::Folded,
    CapsuleState::Unfolding,
    CapsuleState::Stopped,
    CapsuleState::Faulted,
];

fn bench_in(state: CapsuleState) -> Bench {
    let mut bench = match state {
        CapsuleState::Unreferenced | CapsuleState::Referencing => Bench::new(Plant::at(0.4)),
        _ => Bench::referenced(),
    };
    match state {
        CapsuleState::Unreferenced | CapsuleState::Unfolded => {}
        CapsuleState::Referencing => bench.run_past(Command::Reference, 10.0),
        CapsuleState::Folding => bench.run_past(Command::Fold, 10.0),
        CapsuleState::Folded => bench.run(Command::Fold),
        CapsuleState::Unfolding => {
            bench.run(Command::Fold);
            bench.run_past(Command::Unfold, 10.0);
        }
        CapsuleState::Stopped => {
            bench.run_past(Command::Fold, 10.0);
            bench.order(Command::Stop);
            bench.settle();
        }
        CapsuleState::Faulted => {
            bench.order(Command::EStop);
            bench.tick();
        }
    }
    assert_eq!(bench.capsule.state(), state);
    bench
}

/// The state after the event, or the refusal.
fn expected(state: CapsuleState, event: Event) -> Result<CapsuleState, Refusal> {
    use CapsuleState::{
        Faulted, Folded, Folding, Referencing, Stopped, Unfolded, Unfolding, Unreferenced,
    };
    let moving = matches!(state, Referencing | Folding | Unfolding);
    let stopped = match state {
        Referencing => Unreferenced,
        Folding | Unfolding => Stopped,
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
        Event::Command(Command::Reference) => Ok(Referencing),
        Event::Command(_) if state == Unreferenced => Err(Refusal::NotReferenced),
        Event::Command(Command::Fold) if state == Folded => Err(Refusal::AlreadyThere),
        Event::Command(Command::Fold) => Ok(Folding),
        Event::Command(Command::Unfold) if state == Unfolded => Err(Refusal::AlreadyThere),
        Event::Command(Command::Unfold) => Ok(Unfolding),
    }
}

#[test]
fn every_state_with_every_event() {
    for state in STATES {
        let bench = bench_in(state);
        let events = [
            Event::Sample(*bench.capsule.sample()),
            Event::LinkSilent,
            Event::Command(Command::Reference),
            Event::Command(Command::Fold),
            Event::Command(Command::Unfold),
            Event::Command(Command::Stop),
            Event::Command(Command::EStop),
            Event::Command(Command::Acknowledge),
        ];
        for event in events {
            let mut capsule = bench.capsule.clone();
            let actions = capsule.step(bench.now_us, event);
            match expected(state, event) {
                Ok(next) => {
                    assert_eq!(actions.refusal, None, "{state:?} {event:?}");
                    assert_eq!(capsule.state(), next, "{state:?} {event:?}");
                }
                Err(refusal) => {
                    assert_eq!(actions.refusal, Some(refusal), "{state:?} {event:?}");
                    assert_eq!(capsule.state(), state, "a refusal changes nothing");
                    assert!(actions.events.is_empty(), "{state:?} {event:?}");
                }
            }
            let drives = matches!(actions.drive, Drive::Millivolts(_));
            assert_eq!(drives, capsule.is_moving(), "{state:?} {event:?}");
        }
    }
}

#[test]
fn after_a_failed_start_nothing_moves_until_acknowledged() {
    for fault in [CapsuleFault::Watchdog, CapsuleFault::Panic] {
        let mut bench = Bench::new(Plant::at(0.4));
        bench.capsule = Capsule::new(Some(fault));
        bench.tick();
        for command in [Command::Reference, Command::Fold, Command::Unfold] {
            let refusal = bench.give(Event::Command(command)).refusal;
            assert_eq!(refusal, Some(Refusal::AcknowledgeFirst));
        }
        bench.order(Command::EStop);
        assert_eq!(
            bench.capsule.fault(),
            Some(fault),
            "the first cause is kept"
        );
        bench.order(Command::Acknowledge);
        bench.run(Command::Reference);
        assert_eq!(bench.capsule.state(), CapsuleState::Unfolded);
    }
}

#[test]
fn nothing_starts_before_the_battery_was_measured() {
    let mut capsule = Capsule::new(None);
    let actions = capsule.step(0, Event::Command(Command::Reference));
    assert!(matches!(
        actions.refusal,
        Some(Refusal::BatteryLow { battery_mv: 0, .. })
    ));
}

fn reply(bench: &mut Bench, request: Request) -> (Reply, Effect) {
    let ring = EventRing::new();
    let context = Context {
        now_us: bench.now_us,
        ring: &ring,
        last_words: "it ended badly",
    };
    let executed = commands::execute(request, &mut bench.capsule, &context);
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
            | Request::FactoryReset(_)
            | Request::GetName(_)
            | Request::SetName(_)
            | Request::GetRigHealth(_)
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
    ];
    // Hello belongs to the session; Run differs from the other rig rows in its body only.
    assert_eq!(requests.len() + 2, Request::NAMES.len());
    for state in STATES {
        let mut bench = bench_in(state);
        let before = bench.capsule.clone();
        for request in requests.clone() {
            bench.capsule = before.clone();
            let name = request.name();
            let (answer, effect) = reply(&mut bench, request.clone());
            match answer {
                Reply::Accepted(response) => {
                    let named = format!("{response:?}");
                    assert!(named.starts_with(name), "{name} got {named}");
                    assert!(!is_for_the_rig(&request));
                    let starts = bench.capsule.is_moving() && !before.is_moving();
                    assert!(state != CapsuleState::Faulted || !starts);
                    let impact = match effect {
                        Effect::Acknowledged => Impact::Fault,
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
fn the_answers_say_what_they_should() {
    let mut bench = bench_in(CapsuleState::Folding);
    let Reply::Accepted(Response::GetCapsuleStatus(status)) =
        reply(&mut bench, Request::GetCapsuleStatus(GetCapsuleStatus)).0
    else {
        panic!("no status")
    };
    assert_eq!(
        (status.state, status.referenced, status.actuation),
        (CapsuleState::Folding, true, 2)
    );
    assert!((9_500..10_200).contains(&status.thread_um), "{status:?}");
    let telemetry = commands::telemetry(&bench.capsule, 77);
    assert_eq!((telemetry.time_us, telemetry.drive_mv), (77, 3_700));

    let (words, _) = reply(&mut bench, Request::GetLastWords(GetLastWords));
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
        let (reply, effect) = reply(&mut bench, request);
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
