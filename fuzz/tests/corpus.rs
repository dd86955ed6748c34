//! The checked-in corpus is made of these scripts: short inputs that reach the states worth varying. `BLESS=1 cargo test -p fuzz --test corpus`
//! writes it again after a change of a step or of a message.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use fuzz::TARGETS;
use fuzz::{bodies, host, records, sidedoor, stream};
use protocol::capsule::{Calibrate, CheckFolded, FoldTo, GetTrace, Reference};
use protocol::rig::{GetRigStatus, Hold, Home, Jog, MoveTo, Resume, RigEvent};
use protocol::settings::{FactoryReset, Name, Setting, SettingKey};
use protocol::system::{Acknowledge, GetEvents, KeepAlive, LastWords, SetTelemetry, Urgent, What};
use protocol::table::Reply::Accepted;
use protocol::table::{Endpoint, Request, Response};
use serde::Serialize;

#[path = "corpus/files.rs"]
mod files;
#[path = "corpus/served.rs"]
mod served;

/// Target, name, bytes.
type Example = (&'static str, &'static str, Vec<u8>);

fn script<S: Serialize>(start: &[u8], steps: &[S]) -> Vec<u8> {
    let mut bytes = start.to_vec();
    for step in steps {
        bytes.extend(postcard::to_stdvec(step).expect("short"));
    }
    bytes
}

fn bytes(value: &impl Serialize) -> Vec<u8> {
    postcard::to_stdvec(value).expect("short")
}

fn of_stream() -> Vec<Example> {
    use stream::Step::{Again, Frame, Hello, Noise, Request as Ask, Urgent as Stop};
    let set = SetTelemetry { period_ms: 10 }.into_request();
    let example = |name, steps: &[stream::Step]| ("stream", name, script(&[], steps));
    vec![
        example(
            "session",
            &[
                Hello(1),
                Ask(1, set.clone()),
                Again(255, 0),
                Ask(2, set.clone()),
            ],
        ),
        example(
            "damaged",
            &[Hello(1), Ask(1, set.clone()), Again(3, 64), Again(0, 1)],
        ),
        example(
            "old-number",
            &[
                Hello(1),
                Ask(9, set.clone()),
                Ask(0xFFFF, set.clone()),
                Ask(0x8001, set.clone()),
            ],
        ),
        example(
            "two-hosts",
            &[
                Hello(1),
                Ask(1, set.clone()),
                Hello(2),
                Again(255, 0),
                Ask(0, set),
            ],
        ),
        example(
            "stop-without-session",
            &[Stop(3, Urgent::EStop), Again(255, 0), Stop(3, Urgent::Stop)],
        ),
        example(
            "any-frame",
            &[
                Hello(1),
                Frame(1, 2, 9, vec![6]),
                Frame(2, 2, 9, vec![0; 20]),
                Frame(9, 0, 0, vec![]),
            ],
        ),
        example("too-long", &[Noise(vec![1; 200]), Noise(vec![0]), Hello(1)]),
    ]
}

fn of_bodies() -> Vec<Example> {
    use bodies::Sensible::{Jog as Jogging, Move, Run, Set};
    use bodies::Start::{Capsule, Folded, Homed, Rig};
    use bodies::Step::{
        Again, Body, Button, Hello, Loop, Request as Ask, Reset, Sensible, Urgent as Stop, Wait,
    };
    let ask = |request: Request| Ask(1, request);
    let example =
        |name, start, steps: &[bodies::Step]| ("bodies", name, script(&bytes(&start), steps));
    vec![
        example(
            "rig-home",
            Rig,
            &[
                ask(Home.into_request()),
                Wait(3_000),
                ask(GetRigStatus.into_request()),
            ],
        ),
        example(
            "rig-run",
            Homed,
            &[Sensible(Run(2, 80, 40)), Again, Wait(4_000)],
        ),
        example(
            "rig-hold-resume",
            Homed,
            &[
                Sensible(Run(1, 80, 40)),
                Wait(200),
                ask(Hold.into_request()),
                Wait(300),
                ask(Resume.into_request()),
                Wait(2_000),
            ],
        ),
        example(
            "rig-move-jog",
            Homed,
            &[
                Sensible(Move(40)),
                Wait(500),
                Sensible(Jogging(true)),
                Wait(100),
                Sensible(Jogging(false)),
                Wait(400),
            ],
        ),
        example(
            "rig-stop",
            Homed,
            &[
                Sensible(Run(1, 80, 40)),
                Wait(100),
                Stop(Urgent::Stop),
                Wait(200),
                Stop(Urgent::EStop),
                ask(Acknowledge.into_request()),
            ],
        ),
        example(
            "rig-loop",
            Homed,
            &[
                Sensible(Run(1, 80, 40)),
                Wait(100),
                Loop(true),
                Wait(20),
                Loop(false),
                ask(Acknowledge.into_request()),
            ],
        ),
        example(
            "rig-button",
            Homed,
            &[Button(true), Wait(100), Button(false), Wait(100)],
        ),
        example(
            "rig-settings",
            Homed,
            &[
                Sensible(Set(3, 9)),
                ask(Setting {
                    key: SettingKey::StrokeUm,
                    value: 10_000,
                }
                .into_request()),
                ask(FactoryReset.into_request()),
                ask(Home.into_request()),
            ],
        ),
        example(
            "rig-far-end",
            Homed,
            &[
                Sensible(Move(80)),
                Wait(2_000),
                Sensible(Jogging(true)),
                Wait(400),
                Sensible(Move(0)),
                Wait(2_000),
            ],
        ),
        example(
            "rig-old-number",
            Rig,
            &[
                Ask(9, KeepAlive.into_request()),
                Ask(0xFFFF, KeepAlive.into_request()),
                Ask(0xFFFC, KeepAlive.into_request()),
                Ask(0x8001, KeepAlive.into_request()),
                Again,
            ],
        ),
        example(
            "rig-wrong-machine",
            Rig,
            &[
                ask(Reference.into_request()),
                ask(GetTrace { from: 9 }.into_request()),
            ],
        ),
        example(
            "rig-reset",
            Homed,
            &[
                Sensible(Run(1, 80, 40)),
                Wait(100),
                Reset,
                Hello(2),
                ask(Home.into_request()),
                ask(Acknowledge.into_request()),
            ],
        ),
        example(
            "rig-any-body",
            Rig,
            &[
                Body(true, 1, vec![8, 255, 255, 3]),
                Body(false, 1, vec![7]),
                Body(true, 1, vec![200]),
            ],
        ),
        example(
            "rig-limits",
            Homed,
            &[
                ask(Jog {
                    sense: protocol::rig::Direction::Away,
                    speed_um_s: u32::MAX,
                }
                .into_request()),
                ask(MoveTo {
                    position_um: 20_001,
                    speed_um_s: 1,
                }
                .into_request()),
                ask(GetEvents { from: u32::MAX }.into_request()),
            ],
        ),
        example(
            "capsule-reference",
            Capsule,
            &[
                ask(Reference.into_request()),
                Wait(20),
                Stop(Urgent::Stop),
                Wait(20),
            ],
        ),
        example(
            "capsule-refused",
            Capsule,
            &[
                ask(FoldTo { thread_um: 5_000 }.into_request()),
                ask(Calibrate.into_request()),
                ask(Home.into_request()),
            ],
        ),
        example(
            "capsule-telemetry",
            Capsule,
            &[
                ask(SetTelemetry { period_ms: 5 }.into_request()),
                Wait(50),
                ask(Reference.into_request()),
                Wait(20),
            ],
        ),
        example(
            "folded-check",
            Folded,
            &[
                ask(CheckFolded.into_request()),
                Wait(30),
                Stop(Urgent::EStop),
                ask(Acknowledge.into_request()),
            ],
        ),
        example(
            "folded-unfold",
            Folded,
            &[
                ask(protocol::capsule::Unfold.into_request()),
                Wait(30),
                Reset,
                Hello(2),
                ask(Acknowledge.into_request()),
            ],
        ),
        example(
            "folded-settings",
            Folded,
            &[
                Sensible(Set(30, 100)),
                Wait(600),
                ask(FactoryReset.into_request()),
                ask(KeepAlive.into_request()),
            ],
        ),
    ]
}

fn of_host() -> Vec<Example> {
    use host::Act::{
        Actuate, Events, Home as Homing, Idle, Observe, Rest, Run, Setting, Status, Trace,
        Urgent as Stop, Words,
    };
    use host::Step::{Event, Good, Next, Noise, Reply, Silence, Telemetry};
    use host::{Plan, Wants};
    use protocol::rig::{RigState, RigTelemetry};
    use protocol::system::Event as Told;
    let rig = |acts: &[host::Act]| {
        bytes(&Plan {
            capsule: false,
            good: 3,
            wants: Wants::Client(acts.to_vec()),
        })
    };
    let capsule = |acts: &[host::Act]| {
        bytes(&Plan {
            capsule: true,
            good: 3,
            wants: Wants::Client(acts.to_vec()),
        })
    };
    let served = |number| {
        bytes(&Plan {
            capsule: false,
            good: 9,
            wants: Wants::Server(number),
        })
    };
    let shown = |number, good| {
        bytes(&Plan {
            capsule: false,
            good,
            wants: Wants::Command(number, false),
        })
    };
    let started = |good, acts: &[host::Act]| {
        bytes(&Plan {
            capsule: false,
            good,
            wants: Wants::Client(acts.to_vec()),
        })
    };
    let (held, resumed) = (
        What::Rig(RigEvent::Held { position_steps: 1 }),
        What::Rig(RigEvent::Resumed),
    );
    let example =
        |name, start: Vec<u8>, steps: &[host::Step]| ("host", name, script(&start, steps));
    let sample = |position_steps| {
        Telemetry(
            0,
            protocol::table::Telemetry::Rig(RigTelemetry {
                time_us: 1_000,
                state: RigState::Running,
                position_steps,
                commanded_steps: 1,
                speed_um_s: 5,
                stroke: 1,
                residual_steps: 0,
                inputs: protocol::rig::RigInputs {
                    home_flag: false,
                    far_limit: false,
                    estop_loop: false,
                },
            }),
        )
    };
    let good = || vec![Good; 6];
    let homed = What::Rig(RigEvent::Homed {
        repeat_steps: 1,
        shift_steps: 0,
    });
    vec![
        example(
            "home",
            rig(&[Homing, Status]),
            &[&good()[..], &[Next(homed)], &good()].concat(),
        ),
        example(
            "run",
            rig(&[Run]),
            &[&good()[..], &[sample(9), Next(What::LinkLost)], &good()].concat(),
        ),
        example(
            "events",
            rig(&[Events, Observe(20), Idle(9)]),
            &[
                &good()[..],
                &[Event(Told {
                    index: 303,
                    time_us: 1,
                    what: What::Acknowledged,
                })],
                &good(),
            ]
            .concat(),
        ),
        example(
            "stop",
            rig(&[
                Stop(Urgent::EStop),
                Rest,
                Words,
                Setting(SettingKey::LeadUm),
            ]),
            &[&[Silence(300_000)], &good()[..]].concat(),
        ),
        example(
            "noise",
            rig(&[Status]),
            &[
                Noise(b"HTTP/1.1 400 Bad Request\r\n".to_vec()),
                Noise(vec![0, 1, 2]),
                Good,
            ],
        ),
        example(
            "fold",
            capsule(&[Actuate(true), Trace]),
            &[good(), good()].concat(),
        ),
        example(
            "wrong-answer",
            rig(&[Status]),
            &[
                Reply(protocol::table::Reply::Urgent(Urgent::Stop)),
                Reply(protocol::table::Reply::Wire(
                    protocol::error::WireError::Stale,
                )),
            ],
        ),
        example(
            "found-last-event",
            started(1, &[Observe(9)]),
            &[
                Reply(Accepted(Response::GetEvents(protocol::system::Events {
                    oldest: 0,
                    next: u32::MAX,
                    events: heapless::Vec::new(),
                }))),
                Good,
                Event(Told {
                    index: u32::MAX,
                    time_us: 1,
                    what: What::Acknowledged,
                }),
                Good,
            ],
        ),
        example(
            "found-far-clock",
            rig(&[Status]),
            &[Reply(Accepted(Response::GetRigStatus(far_away())))],
        ),
        example(
            "found-long-hold",
            rig(&[Run]),
            &[
                Good,
                Event(Told {
                    index: 303,
                    time_us: 0,
                    what: held,
                }),
                Event(Told {
                    index: 304,
                    time_us: u64::MAX,
                    what: resumed,
                }),
                Event(Told {
                    index: 305,
                    time_us: 0,
                    what: held,
                }),
                Event(Told {
                    index: 306,
                    time_us: u64::MAX,
                    what: resumed,
                }),
                Good,
            ],
        ),
        example(
            "found-last-stroke",
            served(0),
            &[
                Event(Told {
                    index: 303,
                    time_us: 1,
                    what: What::Rig(RigEvent::StrokeDone {
                        stroke: u32::MAX,
                        residual_steps: 0,
                    }),
                }),
                Good,
                Good,
            ],
        ),
        example(
            "served-home",
            served(0),
            &[&good()[..], &[sample(3), Next(homed)], &good(), &good()].concat(),
        ),
        example("fetch", started(200, &[host::Act::Fetch]), &[]),
        example("fetched", shown(4, 200), &[]),
        example(
            "last-words",
            shown(0, 3),
            &[
                &[Reply(Accepted(Response::GetLastWords(LastWords {
                    text: "\u{1b}[2J\u{202e}".try_into().expect("short"),
                })))],
                &good()[..],
            ]
            .concat(),
        ),
        example(
            "name",
            shown(3, 3),
            &[Reply(Accepted(Response::GetName(Name {
                name: "\u{9b}2J".try_into().expect("short"),
            })))],
        ),
        example(
            "served-move",
            served(1),
            &[&good()[..], &[sample(3)], &good(), &good()].concat(),
        ),
    ]
}

/// A status of half of all time later.
fn far_away() -> protocol::rig::RigStatus {
    protocol::rig::RigStatus {
        time_us: 1 << 63,
        state: protocol::rig::RigState::Ready,
        fault: None,
        homed: true,
        position_steps: 0,
        position_um: 0,
        stroke_um: 1,
        steps_per_rev: 1,
        lead_um: 1,
        inputs: protocol::rig::RigInputs {
            home_flag: false,
            far_limit: false,
            estop_loop: false,
        },
        run: 0,
        stroke: u32::MAX,
        strokes: 0,
        elapsed_us: 0,
        needs_acknowledge: false,
    }
}

fn of_sidedoor() -> Vec<Example> {
    use sidedoor::Step::{
        Again, Answer, Come, Confirm, Crowd, Frame, Greeting, Hello, Leave, Machine, Noise, Notice,
        Order, Request as Ask, Tell, Thin, Urgent as Stop, Wait,
    };
    let status = || Ask(0, 1, GetRigStatus.into_request());
    let example = |name, steps: &[sidedoor::Step]| ("sidedoor", name, script(&[], steps));
    vec![
        example(
            "full",
            &[
                Crowd,
                Come(false),
                Hello(0, 1),
                status(),
                Stop(0, 3, Urgent::Stop),
                Confirm(0x8000, Urgent::Stop),
                Thin(31),
                Come(true),
                Hello(1, 2),
                Ask(1, 1, GetRigStatus.into_request()),
                Answer(true),
            ],
        ),
        example(
            "look",
            &[
                Come(false),
                Hello(0, 1),
                status(),
                Answer(true),
                Tell(40),
                Tell(90),
            ],
        ),
        example(
            "stop",
            &[
                Come(false),
                Stop(0, 7, Urgent::Stop),
                Order,
                Confirm(0x8000, Urgent::Stop),
                Notice,
                Order,
                Stop(0, 7, Urgent::EStop),
            ],
        ),
        example(
            "move",
            &[
                Come(false),
                Hello(0, 1),
                Ask(0, 1, Home.into_request()),
                Ask(0, 1, KeepAlive.into_request()),
                Answer(true),
            ],
        ),
        example(
            "resume",
            &[
                Come(true),
                Hello(0, 1),
                Ask(0, 1, Resume.into_request()),
                Again(0),
                Answer(true),
                Again(0),
                Answer(true),
            ],
        ),
        example(
            "two-guests",
            &[
                Come(false),
                Come(false),
                Hello(0, 1),
                Hello(1, 1),
                status(),
                Ask(1, 1, GetRigStatus.into_request()),
                Answer(true),
                Leave(0),
                Leave(0),
            ],
        ),
        example(
            "unanswered",
            &[
                Come(false),
                Hello(0, 1),
                status(),
                Answer(false),
                Again(0),
                Wait(700),
                status(),
                Wait(700),
                Answer(true),
            ],
        ),
        example(
            "wrong-token",
            &[
                Greeting(b"{\"retrograde_window\":1,\"token\":\"x\"}\n".to_vec()),
                Greeting(
                    b"{\"retrograde_window\":1,\"token\":\"secret\",\"more\":[1]}\n\x00\x01"
                        .to_vec(),
                ),
            ],
        ),
        example(
            "any-frame",
            &[
                Come(false),
                Hello(0, 1),
                Frame(0, 2, 1, 2, vec![1]),
                Frame(0, 1, 1, 2, vec![200]),
                Noise(0, vec![0, 5, 0]),
                Machine(vec![0, 3, 1, 1, 0]),
            ],
        ),
    ]
}

fn of_records() -> Vec<Example> {
    use records::Step::{Cut, Manifest, Number, Replace, Twice};
    let example = |name, steps: &[records::Step]| ("records", name, script(&[], steps));
    vec![
        example("as-written", &[]),
        example(
            "replaced",
            &[
                Replace(0, 300, 3, b"null".to_vec()),
                Replace(1, 500, 1, vec![b'9']),
            ],
        ),
        example(
            "large-numbers",
            &[Number(0, 400, 7), Number(1, 300, 6), Number(1, 800, 3)],
        ),
        example("cut", &[Cut(1, 700)]),
        example("twice", &[Twice(1, 500)]),
        example("manifest", &[Manifest(b"00  x\n".to_vec())]),
        (
            "records",
            "manifest-alone",
            format!("{}  run.csv\n", "0f".repeat(32)).into(),
        ),
    ]
}

#[test]
fn the_corpus_is_that_of_the_scripts() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
    let bless = std::env::var_os("BLESS").is_some();
    let all = [
        of_stream(),
        of_bodies(),
        of_host(),
        of_sidedoor(),
        served::of_http(),
        of_records(),
        files::of_documents(),
        files::of_folders(),
        served::of_together(),
    ]
    .concat();
    for (target, name, bytes) in &all {
        let file = root.join(target).join(name);
        if bless {
            fs::create_dir_all(root.join(target)).expect("a folder");
            fs::write(&file, bytes).expect("written");
        }
        let there = fs::read(&file).unwrap_or_default();
        assert!(
            there == *bytes,
            "{} is another one: BLESS=1 writes it",
            file.display()
        );
    }
    // Most findings are files of their own, which no script has.
    let targets: BTreeSet<_> = all.iter().map(|(target, ..)| *target).collect();
    assert_eq!(targets, TARGETS.into_iter().collect());
}
