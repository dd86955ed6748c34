//! The protocol's requests on the machine: every row in every state, every refusal, every number of a reply.

use device::{
    common::{About, Change, Effect, Executed},
    settings::Values,
};
use firmware_rig::{
    commands::{Context, execute},
    machine::{Command, Machine},
    settings::Settings,
};
use motion::axis::Direction;
use proptest::prelude::*;
use protocol::{
    capsule,
    error::{Field, Refusal},
    events::EventRing,
    rig::{
        self, Glitches, HomeAccepted, LinkLossPolicy, MoveAccepted, RigFault, RigHardware,
        RigHealth, RigState, RigStatus, Run, RunAccepted, RunOutcome, RunTiming, Stroke,
    },
    settings::{FactoryReset, GetName, GetSetting, Name, Setting, SettingKey, SettingRule},
    system::{self, DeviceKind, Done, Hello, LastWords, ResetCause, SetTelemetry, What},
    table::{Impact, Reply, Request, Response},
};
use simulated_machines::carriage::{Rig, now, run, settings};

const SETTINGS: Settings = Settings::REFERENCE;

const PAPER: Run = Run {
    cycles: 5,
    stroke_um: 130_000,
    timing: RunTiming::Total {
        total_us: 40_000_000,
        accel_um_s2: 100_000,
    },
    far_dwell_us: 0,
    home_dwell_us: 0,
    start_delay_us: 0,
    link_loss: LinkLossPolicy::Stop,
};

pub(crate) const HEALTH: RigHealth = RigHealth {
    home_flag: Glitches {
        count: 1,
        last_us: 2,
        masked: 0,
    },
    far_limit: Glitches {
        count: 3,
        last_us: 4,
        masked: 0,
    },
    uart_errors: 5,
    bad_frames: 6,
    unsent_frames: 7,
    underruns: 8,
    stack_used: 9,
    stack_size: 10,
    control_late_us: 11,
    image_hash: 12,
};

pub(crate) const HARDWARE: RigHardware = RigHardware {
    intervals_exact: 1,
    intervals_1_tick: 2,
    intervals_2_ticks: 3,
    intervals_more: 4,
    lost_captures: 5,
    dma_errors: 6,
    timer_resets: 7,
    enable_high_at_start: true,
};

/// Sends a request: the reply, what the caller has to do, and how many actions there are.
fn send(rig: &mut Rig, request: Request) -> (Reply, Effect<Settings>, usize) {
    let mut events = EventRing::new();
    events.record(7, What::Booted(ResetCause::PowerOn));
    let context = Context {
        now: now(1_234, rig.ring.counted, rig.inputs()),
        stroke: 3,
        about: About {
            kind: DeviceKind::Rig,
            events: &events,
            last_words: "tasks/link.rs:1: oh",
            chip: system::Chip {
                clock: system::Clock::Internal,
                brown_out: system::BrownOut::Level2,
                supply_low: true,
                option_bytes: 0x00FF_AAE5,
            },
            values: &Values::DEFAULT,
            name: "left bench",
        },
        health: matches!(request, Request::GetRigHealth(_)).then_some(HEALTH),
        hardware: matches!(request, Request::GetRigHardware(_)).then_some(HARDWARE),
    };
    let Executed {
        reply,
        actions,
        effect,
    } = execute(request, &mut rig.machine, &context);
    // The host gets the machine's refusal unchanged.
    if let Some(refusal) = actions.refusal {
        assert_eq!(reply, Reply::Refused(refusal));
    }
    (reply, effect, actions.list.len())
}

fn refusal(rig: &mut Rig, request: Request) -> Refusal {
    let before = (rig.machine.state(), *rig.machine.record());
    let text = format!("{request:?}");
    match send(rig, request) {
        (Reply::Refused(refusal), Effect::None, 0) => {
            assert_eq!((rig.machine.state(), *rig.machine.record()), before);
            assert!(!refusal.to_string().is_empty());
            refusal
        }
        other => panic!("{text} was not refused: {other:?}"),
    }
}

fn accepted(rig: &mut Rig, request: Run) -> RunAccepted {
    match send(rig, Request::Run(request)) {
        (Reply::Accepted(Response::Run(accepted)), Effect::None, 2) => accepted,
        other => panic!("{request:?}: {other:?}"),
    }
}

fn refused_run(request: Run) -> Refusal {
    refusal(&mut Rig::homed(SETTINGS), Request::Run(request))
}

/// The rig in a state that it reached by commands.
fn rig_in(state: RigState) -> Rig {
    let mut rig = Rig::homed(SETTINGS);
    let start = run(&SETTINGS, 1, 10_000, LinkLossPolicy::Stop);
    match state {
        RigState::Unhomed => rig = Rig::new(SETTINGS, 5_000),
        RigState::Homing => rig.command(Command::Home).unwrap(),
        RigState::Ready => {}
        RigState::Running => rig.command(start).unwrap(),
        RigState::Stopping => {
            rig.command(start).unwrap();
            rig.pulses(100);
            rig.command(Command::Stop).unwrap();
        }
        RigState::Faulted => {
            rig.press();
            rig.pressed = false;
        }
        RigState::Held => {
            rig.command(start).unwrap();
            rig.pulses(100);
            rig.command(Command::Hold).unwrap();
            rig.finish();
        }
        RigState::Moving => {
            let speed = SETTINGS.speed(1_000).unwrap();
            let direction = Direction::Away;
            rig.command(Command::Jog { direction, speed }).unwrap();
        }
    }
    assert_eq!(rig.machine.state(), state);
    rig
}

pub(crate) const STATES: [RigState; 8] = [
    RigState::Unhomed,
    RigState::Homing,
    RigState::Ready,
    RigState::Running,
    RigState::Held,
    RigState::Moving,
    RigState::Stopping,
    RigState::Faulted,
];

const JOG: rig::Jog = rig::Jog {
    sense: rig::Direction::Away,
    speed_um_s: 1_000,
};

const MOVE: rig::MoveTo = rig::MoveTo {
    position_um: 10_000,
    speed_um_s: 10_000,
};

const SETTING: Setting = Setting {
    key: SettingKey::FlagUm,
    value: 900,
};

fn name(text: &str) -> Name {
    Name {
        name: text.try_into().unwrap(),
    }
}

/// One request per row, in the table's order.
fn requests() -> Vec<Request> {
    let requests = vec![
        Request::Hello(Hello {
            protocol: protocol::VERSION,
            schema_key: 0,
            nonce: 1,
        }),
        Request::KeepAlive(system::KeepAlive),
        Request::GetLastWords(system::GetLastWords),
        Request::SetTelemetry(SetTelemetry { period_ms: 10 }),
        Request::GetEvents(system::GetEvents { from: 0 }),
        Request::Acknowledge(system::Acknowledge),
        Request::GetRigStatus(rig::GetRigStatus),
        Request::Home(rig::Home),
        Request::Run(PAPER),
        Request::GetRunRecord(rig::GetRunRecord),
        Request::GetCapsuleStatus(capsule::GetCapsuleStatus),
        Request::Reference(capsule::Reference),
        Request::Fold(capsule::Fold),
        Request::Unfold(capsule::Unfold),
        Request::GetActuationRecord(capsule::GetActuationRecord),
        Request::Hold(rig::Hold),
        Request::Resume(rig::Resume),
        Request::Jog(JOG),
        Request::MoveTo(MOVE),
        Request::GetSetting(GetSetting {
            key: SettingKey::FlagUm,
        }),
        Request::SetSetting(SETTING),
        Request::FactoryReset(FactoryReset),
        Request::GetName(GetName),
        Request::SetName(name("right bench")),
        Request::GetRigHealth(rig::GetRigHealth),
        Request::GetChip(system::GetChip),
        Request::Calibrate(capsule::Calibrate),
        Request::CheckFolded(capsule::CheckFolded),
        Request::GetTrace(capsule::GetTrace { from: 0 }),
        Request::GetCapsuleTotals(capsule::GetCapsuleTotals),
        Request::FoldTo(capsule::FoldTo { thread_um: 9_000 }),
        Request::GetRigHardware(rig::GetRigHardware),
    ];
    let names: Vec<_> = requests.iter().map(|request| request.name()).collect();
    assert_eq!(names, Request::NAMES);
    requests
}

fn is_for_the_capsule(request: &Request) -> bool {
    matches!(
        request,
        Request::GetCapsuleStatus(_)
            | Request::Reference(_)
            | Request::Fold(_)
            | Request::Unfold(_)
            | Request::GetActuationRecord(_)
            | Request::Calibrate(_)
            | Request::CheckFolded(_)
            | Request::GetTrace(_)
            | Request::GetCapsuleTotals(_)
            | Request::FoldTo(_)
    )
}

/// By the protocol's table.
fn moves(request: &Request) -> bool {
    matches!(request.impact(), Impact::Motion | Impact::Pace)
}

/// The refusal that a request gets in a state, if any.
fn refused_in(request: &Request, state: RigState) -> Option<Refusal> {
    let at_rest = matches!(state, RigState::Unhomed | RigState::Ready);
    let faulted = state == RigState::Faulted;
    match request {
        // The session answers it, and never passes it on.
        Request::Hello(_) => Some(Refusal::WrongDevice),
        _ if is_for_the_capsule(request) => Some(Refusal::WrongDevice),
        Request::Acknowledge(_) => (!faulted).then_some(Refusal::NothingToAcknowledge),
        _ if faulted && moves(request) => Some(Refusal::RigFaulted(RigFault::EStopLoop)),
        Request::Hold(_) => (state != RigState::Running).then_some(Refusal::NothingToHold),
        Request::Resume(_) => (state != RigState::Held).then_some(Refusal::NothingToResume),
        // Accepted: it renews the jog in progress.
        Request::Jog(_) if state == RigState::Moving => None,
        Request::Home(_) | Request::Run(_) | Request::Jog(_) | Request::MoveTo(_) if !at_rest => {
            Some(Refusal::RigBusy(state))
        }
        Request::Run(_) | Request::Jog(_) | Request::MoveTo(_) => {
            (state == RigState::Unhomed).then_some(Refusal::NotHomed)
        }
        Request::SetSetting(_) | Request::FactoryReset(_) | Request::SetName(_) => {
            (!at_rest && !faulted).then_some(Refusal::RigBusy(state))
        }
        _ => None,
    }
}

fn expected_effect(request: &Request) -> Effect<Settings> {
    match request {
        Request::SetTelemetry(_) => Effect::Telemetry { period_ms: 10 },
        Request::Acknowledge(_) => Effect::Acknowledged,
        Request::SetSetting(setting) => Effect::Store(Change::Value {
            setting: *setting,
            settings: settings(&[(setting.key, setting.value)]),
        }),
        Request::SetName(name) => Effect::Store(Change::Name(name.name.clone())),
        Request::FactoryReset(_) => Effect::Store(Change::Reset),
        _ => Effect::None,
    }
}

#[test]
fn every_row_in_every_state() {
    for request in requests() {
        for state in STATES {
            let mut rig = rig_in(state);
            if let Some(expected) = refused_in(&request, state) {
                assert_eq!(refusal(&mut rig, request.clone()), expected, "{state:?}");
                assert!(
                    state != RigState::Faulted
                        || moves(&request)
                        || request.name() == "Hello"
                        || is_for_the_capsule(&request)
                );
                continue;
            }
            let (reply, effect, actions) = send(&mut rig, request.clone());
            let Reply::Accepted(response) = reply else {
                panic!("{request:?} in {state:?}: {reply:?}")
            };
            // The response of the same row.
            let name = format!("{response:?}");
            assert!(name.starts_with(request.name()), "{name}");
            assert!(state != RigState::Faulted || !moves(&request));
            let renewed = state == RigState::Moving && matches!(request, Request::Jog(_));
            assert_eq!(actions > 0, moves(&request) && !renewed);
            assert_eq!(effect, expected_effect(&request));
            // Its impact by the protocol's table.
            let in_a_run = matches!(state, RigState::Running | RigState::Held);
            let impact = match effect {
                Effect::Acknowledged => Impact::Fault,
                Effect::Store(_) => Impact::Flash,
                _ if actions > 0 && in_a_run => Impact::Pace,
                _ if actions > 0 || renewed => Impact::Motion,
                _ => Impact::None,
            };
            assert_eq!(request.impact(), impact);
        }
    }
}

#[test]
fn a_move_says_how_it_will_be() {
    let mut rig = Rig::homed(SETTINGS);
    // 10.001 mm are 8,000.8 steps: rounded towards home.
    let request = Request::MoveTo(rig::MoveTo {
        position_um: 10_001,
        ..MOVE
    });
    let (reply, effect, actions) = send(&mut rig, request);
    // 8 M ticks per 10 mm/s and step less a ramp of 10 mm/s / 200 mm/s2 = 50 ms.
    let expected = MoveAccepted {
        from_steps: 0,
        to_steps: 8_000,
        stroke: Stroke {
            steps: 8_000,
            duration_ticks: 105_000_000,
            ramp_ticks: 5_000_000,
            peak_um_s: 10_000,
            accel_um_s2: 200_000,
        },
    };
    assert_eq!(reply, Reply::Accepted(Response::MoveTo(expected)));
    assert_eq!((effect, actions), (Effect::None, 1));
    assert_eq!(rig.machine.state(), RigState::Moving);
}

#[test]
fn moves_and_jogs_out_of_range() {
    let mut rig = Rig::homed(SETTINGS);
    let to = |position_um, speed_um_s| {
        Request::MoveTo(rig::MoveTo {
            position_um,
            speed_um_s,
        })
    };
    for position_um in [130_001, u32::MAX] {
        assert_eq!(
            refusal(&mut rig, to(position_um, 1_000)),
            out_of_range(Field::PositionUm, position_um.into(), 0, 130_000)
        );
    }
    for speed_um_s in [0, 49_001, u32::MAX] {
        let expected = out_of_range(Field::SpeedUmS, speed_um_s.into(), 1, 49_000);
        assert_eq!(refusal(&mut rig, to(10_000, speed_um_s)), expected);
        for sense in [rig::Direction::Away, rig::Direction::Home] {
            let jog = Request::Jog(rig::Jog { sense, speed_um_s });
            assert_eq!(refusal(&mut rig, jog), expected);
        }
    }
    // The target is less than a step away.
    assert_eq!(refusal(&mut rig, to(0, 1_000)), Refusal::AlreadyThere);
    assert_eq!(refusal(&mut rig, to(1, 1_000)), Refusal::AlreadyThere);
    let home = Request::Jog(rig::Jog {
        sense: rig::Direction::Home,
        ..JOG
    });
    assert_eq!(refusal(&mut rig, home), Refusal::AlreadyThere);
    let mut rig = Rig::homed(fine());
    assert!(matches!(
        refusal(&mut rig, to(10_000, 25_000)),
        Refusal::StepRateLimit {
            max_hz: 250_000,
            ..
        }
    ));
}

/// 32 kHz are 40 mm/s at 800 steps per mm, exactly.
#[test]
fn a_move_may_be_as_fast_as_the_driver() {
    let mut rig = Rig::homed(settings(&[(SettingKey::MaxStepHz, 32_000)]));
    let to = |speed_um_s| {
        Request::MoveTo(rig::MoveTo {
            position_um: 50_000,
            speed_um_s,
        })
    };
    let max_hz = 32_000;
    for (speed_um_s, interval) in [(40_001, 3_124_u64), (49_000, 2_551)] {
        let needed_hz = u64::div_ceil(100_000_000, interval);
        let refused = Refusal::StepRateLimit { needed_hz, max_hz };
        assert_eq!(refusal(&mut rig, to(speed_um_s)), refused);
    }
    assert!(matches!(send(&mut rig, to(40_000)).0, Reply::Accepted(_)));
}

/// Without a known position no target is "already there".
#[test]
fn a_move_to_where_the_counter_stands_needs_a_position() {
    let request = || {
        Request::MoveTo(rig::MoveTo {
            position_um: 0,
            ..MOVE
        })
    };
    for (state, expected) in [
        (RigState::Unhomed, Refusal::NotHomed),
        (RigState::Faulted, Refusal::RigFaulted(RigFault::EStopLoop)),
    ] {
        let mut rig = rig_in(state);
        rig.ring.counted = 0;
        assert_eq!(refusal(&mut rig, request()), expected);
    }
}

#[test]
fn the_capsules_settings_are_not_the_rigs() {
    let mut rig = Rig::homed(SETTINGS);
    let others = SettingKey::ALL
        .into_iter()
        .filter(|key| !key.is_of(DeviceKind::Rig));
    for key in others {
        let value = key.range().default;
        let requests = [
            Request::GetSetting(GetSetting { key }),
            Request::SetSetting(Setting { key, value }),
        ];
        for request in requests {
            assert_eq!(refusal(&mut rig, request), Refusal::WrongDevice, "{key:?}");
        }
    }
}

#[test]
fn settings_are_read_and_checked() {
    let mut rig = Rig::homed(SETTINGS);
    for key in SettingKey::of(DeviceKind::Rig) {
        let (reply, effect, _) = send(&mut rig, Request::GetSetting(GetSetting { key }));
        let value = key.range().default;
        let expected = Reply::Accepted(Response::GetSetting(Setting { key, value }));
        assert_eq!((reply, effect), (expected, Effect::None));
    }
    let mut set = |key, value| refusal(&mut rig, Request::SetSetting(Setting { key, value }));
    let (key, requested) = (SettingKey::StrokeUm, 130_001);
    let refused = set(key, requested);
    assert_eq!(refused, Refusal::SettingRange { key, requested });
    assert_eq!(
        refused.to_string(),
        "stroke_um is 130001, allowed is 1 to 130000"
    );
    let (key, rule) = (SettingKey::Microsteps, SettingRule::Microsteps);
    assert_eq!(set(key, 12), Refusal::SettingRule { key, rule });
    // The machine has its old settings until the new ones are in flash.
    let request = Request::SetSetting(SETTING);
    assert!(matches!(send(&mut rig, request).1, Effect::Store(_)));
    assert_eq!(*rig.machine.settings(), SETTINGS);
    assert!(rig.machine.homed());
}

#[test]
fn name_and_health_are_reported() {
    for state in STATES {
        let mut rig = rig_in(state);
        let (reply, ..) = send(&mut rig, Request::GetName(GetName));
        assert_eq!(
            reply,
            Reply::Accepted(Response::GetName(name("left bench")))
        );
        let (reply, ..) = send(&mut rig, Request::GetRigHealth(rig::GetRigHealth));
        assert_eq!(reply, Reply::Accepted(Response::GetRigHealth(HEALTH)));
        let (reply, ..) = send(&mut rig, Request::GetRigHardware(rig::GetRigHardware));
        assert_eq!(reply, Reply::Accepted(Response::GetRigHardware(HARDWARE)));
    }
}

/// While the run is held the status shows the stroke that it will go on with.
#[test]
fn status_of_a_held_run() {
    let mut rig = rig_in(RigState::Held);
    let shown = status(&mut rig);
    assert_eq!((shown.state, shown.homed), (RigState::Held, true));
    assert_eq!((shown.run, shown.stroke, shown.strokes), (1, 0, 2));
    assert!(shown.position_steps > 100);
}

#[test]
fn the_papers_run_in_exact_integers() {
    let mut rig = Rig::homed(SETTINGS);
    // The shortest ramp r with r (T - r) >= n (100 MHz)^2 / (100 mm/s2 at 800 steps/mm) = 1.3e16.
    let stroke = Stroke {
        steps: 104_000,
        duration_ticks: 400_000_000,
        ramp_ticks: 35_683_233,
        peak_um_s: 35_683,
        accel_um_s2: 100_000,
    };
    let accepted = accepted(&mut rig, PAPER);
    assert_eq!(
        accepted,
        RunAccepted {
            run: 1,
            requested: PAPER,
            forward: stroke,
            back: stroke,
            total_ticks: 4_000_000_000,
            edges: 1_040_000,
            plan_hash: rig.machine.record().plan_hash,
        }
    );
    assert_eq!(rig.machine.state(), RigState::Running);
    assert_eq!(rig.machine.strokes(), 10);
}

#[test]
fn homing_says_how_far_it_may_go() {
    let (reply, _, actions) = send(&mut rig_in(RigState::Unhomed), Request::Home(rig::Home));
    let expected = HomeAccepted {
        seek_um_s: 20_000,
        locate_um_s: 2_000,
        max_travel_um: 140_000,
    };
    assert_eq!(reply, Reply::Accepted(Response::Home(expected)));
    assert_eq!(actions, 1);
}

fn out_of_range(field: Field, requested: u64, min: u64, max: u64) -> Refusal {
    Refusal::OutOfRange {
        field,
        requested,
        min,
        max,
    }
}

#[test]
fn strokes_and_cycles_out_of_range() {
    // 131 mm, and nothing at all; one step is 1.25 um.
    for stroke_um in [131_000, 130_001, u32::MAX, 0, 1] {
        let refusal = refused_run(Run { stroke_um, ..PAPER });
        assert_eq!(
            refusal,
            out_of_range(Field::StrokeUm, stroke_um.into(), 2, 130_000)
        );
        let text = refusal.to_string();
        assert!(
            text.contains("stroke (um)") && text.contains("2 to 130000"),
            "{text}"
        );
    }
    for cycles in [0, 10_001, u16::MAX] {
        assert_eq!(
            refused_run(Run { cycles, ..PAPER }),
            out_of_range(Field::Cycles, cycles.into(), 1, 10_000)
        );
    }
}

/// 1/256: 12,800 steps per mm.
fn fine() -> Settings {
    settings(&[(SettingKey::SeekUmS, 19_000), (SettingKey::Microsteps, 256)])
}

#[test]
fn the_step_rate_is_limited() {
    let mut rig = Rig::homed(fine());
    let request = |speed_um_s| Run {
        timing: RunTiming::Speeds {
            forward_um_s: speed_um_s,
            return_um_s: speed_um_s,
            accel_um_s2: 100_000,
        },
        ..PAPER
    };
    let refusal = refusal(&mut rig, Request::Run(request(25_000)));
    let Refusal::StepRateLimit { needed_hz, max_hz } = refusal else {
        panic!("{refusal:?}")
    };
    assert_eq!(max_hz, 250_000);
    // 25 mm/s are 320 kHz, in whole ticks.
    assert!((320_000..322_000).contains(&needed_hz), "{needed_hz}");
    // 250 kHz are 19.5 mm/s.
    accepted(&mut rig, request(19_531));
}

#[test]
fn telemetry_between_1_and_200_hz_or_off() {
    let mut rig = rig_in(RigState::Running);
    for period_ms in [1, 4, 1_001, u16::MAX] {
        let request = Request::SetTelemetry(SetTelemetry { period_ms });
        assert_eq!(
            refusal(&mut rig, request),
            out_of_range(Field::PeriodMs, period_ms.into(), 5, 1_000)
        );
    }
    for period_ms in [0, 5, 1_000] {
        let set = SetTelemetry { period_ms };
        let (reply, effect, _) = send(&mut rig, Request::SetTelemetry(set));
        assert_eq!(reply, Reply::Accepted(Response::SetTelemetry(set)));
        assert_eq!(effect, Effect::Telemetry { period_ms });
    }
}

#[test]
fn a_latched_fault_is_named_with_its_remedy() {
    let mut rig = rig_in(RigState::Faulted);
    for request in [Request::Home(rig::Home), Request::Run(PAPER)] {
        let text = refusal(&mut rig, request).to_string();
        assert!(
            text.contains("release the button") && text.contains("acknowledge"),
            "{text}"
        );
    }
    rig.pressed = true;
    let acknowledge = Request::Acknowledge(system::Acknowledge);
    assert_eq!(
        refusal(&mut rig, acknowledge.clone()),
        Refusal::CauseStillPresent
    );
    rig.pressed = false;
    let (reply, effect, actions) = send(&mut rig, acknowledge);
    assert_eq!(reply, Reply::Accepted(Response::Acknowledge(Done)));
    assert_eq!((effect, actions), (Effect::Acknowledged, 0));
    assert_eq!(refusal(&mut rig, Request::Run(PAPER)), Refusal::NotHomed);
}

#[test]
fn a_run_starts_at_home_only() {
    let mut rig = rig_in(RigState::Stopping);
    rig.finish();
    let position_um = rig.ring.counted * 5 / 4;
    assert!(position_um > 0);
    let Refusal::NotAtHome { position_um: um } = refusal(&mut rig, Request::Run(PAPER)) else {
        panic!("not refused for its position")
    };
    assert!((um - position_um).abs() <= 1);
}

fn status(rig: &mut Rig) -> RigStatus {
    match send(rig, Request::GetRigStatus(rig::GetRigStatus)) {
        (Reply::Accepted(Response::GetRigStatus(status)), Effect::None, 0) => status,
        other => panic!("{other:?}"),
    }
}

#[test]
fn status_shows_the_machine() {
    let mut rig = Rig::homed(SETTINGS);
    rig.ring.counted = -801;
    assert_eq!(
        status(&mut rig),
        RigStatus {
            time_us: 1_234,
            state: RigState::Ready,
            fault: None,
            homed: true,
            position_steps: -801,
            position_um: -1_001,
            stroke_um: 130_000,
            steps_per_rev: 3_200,
            lead_um: 4_000,
            inputs: rig.inputs(),
            run: 0,
            stroke: 0,
            strokes: 0,
            elapsed_us: 0,
            needs_acknowledge: false,
        }
    );
    let running = &mut Rig::homed(SETTINGS);
    accepted(running, PAPER);
    let shown = status(running);
    assert_eq!((shown.run, shown.stroke, shown.strokes), (1, 3, 10));
    let faulted = status(&mut rig_in(RigState::Faulted));
    assert_eq!(faulted.fault, Some(RigFault::EStopLoop));
    assert!(!faulted.homed && !faulted.needs_acknowledge);
}

#[test]
fn records_last_words_and_events_are_reported() {
    let mut rig = rig_in(RigState::Running);
    let (reply, ..) = send(&mut rig, Request::GetRunRecord(rig::GetRunRecord));
    let Reply::Accepted(Response::GetRunRecord(record)) = reply else {
        panic!("{reply:?}")
    };
    assert_eq!((record.run, record.outcome), (1, RunOutcome::Running));
    let (reply, ..) = send(&mut rig, Request::GetLastWords(system::GetLastWords));
    let words = LastWords {
        text: "tasks/link.rs:1: oh".try_into().unwrap(),
    };
    assert_eq!(reply, Reply::Accepted(Response::GetLastWords(words)));
    let (reply, ..) = send(&mut rig, Request::GetEvents(system::GetEvents { from: 0 }));
    let Reply::Accepted(Response::GetEvents(events)) = reply else {
        panic!("{reply:?}")
    };
    assert_eq!((events.oldest, events.next, events.events.len()), (0, 1, 1));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    /// Any run is either refused without effect or stays within every limit.
    #[test]
    fn any_run_is_refused_or_within_the_limits(
        cycles in prop_oneof![1..20_u16, any::<u16>()],
        stroke_um in prop_oneof![1..=130_000_u32, any::<u32>()],
        total in any::<bool>(),
        times in prop_oneof![
            (1_000_000..100_000_000_u64, 1..60_000_u32, 1..60_000_u32),
            any::<(u64, u32, u32)>(),
        ],
        accel_um_s2 in prop_oneof![1_000..3_000_000_u32, any::<u32>()],
        dwells in prop_oneof![Just([0; 3]), any::<[u32; 3]>()],
    ) {
        let timing = if total {
            RunTiming::Total { total_us: times.0, accel_um_s2 }
        } else {
            RunTiming::Speeds { forward_um_s: times.1, return_um_s: times.2, accel_um_s2 }
        };
        let [far_dwell_us, home_dwell_us, start_delay_us] = dwells;
        let link_loss = LinkLossPolicy::Stop;
        let request = Run {
            cycles, stroke_um, timing, far_dwell_us, home_dwell_us, start_delay_us, link_loss,
        };
        let mut rig = ready();
        match send(&mut rig, Request::Run(request)) {
            (Reply::Accepted(Response::Run(accepted)), _, 2) => {
                prop_assert_eq!(accepted.requested, request);
                for stroke in [accepted.forward, accepted.back] {
                    prop_assert!((1..=104_000).contains(&stroke.steps));
                    prop_assert!(stroke.peak_um_s <= 49_000);
                    prop_assert!(stroke.accel_um_s2 <= 2_000_000);
                }
                if total {
                    prop_assert_eq!(accepted.total_ticks, times.0 * 100);
                }
            }
            (Reply::Refused(_), Effect::None, 0) => {
                prop_assert_eq!(rig.machine.state(), RigState::Ready);
                prop_assert_eq!(rig.machine.record().run, 0);
            }
            other => prop_assert!(false, "{:?}", other),
        }
    }
}

thread_local! {
    /// A ready machine, shared by the cases because homing takes long.
    static READY: Machine = Rig::homed(SETTINGS).machine;
}

fn ready() -> Rig {
    let mut rig = Rig::new(SETTINGS, 0);
    rig.machine = READY.with(Machine::clone);
    rig
}
