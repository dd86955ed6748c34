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
    error::Refusal,
    events::EventRing,
    rig::{
        self, Glitches, HomeAccepted, LinkLossPolicy, MoveAccepted, RigHardware, RigHealth,
        RigState, Run, RunTiming, Stroke,
    },
    settings::{GetSetting, SettingKey},
    system::{self, DeviceKind, ResetCause, What},
    table::{Impact, Reply, Request, Response},
};
use simulated_machines::carriage::{Rig, now, run, settings};

const SETTINGS: Settings = Settings::REFERENCE;

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

/// A request of every kind that all states but some take, and one for the other machine's setting.
fn requests() -> Vec<Request> {
    let requests = exemplars::requests().into_iter();
    let mut requests: Vec<_> = requests
        .map(|request| match request {
            // The jog that is going on while the rig moves.
            Request::Jog(_) => Request::Jog(rig::Jog {
                direction: rig::Direction::Away,
                speed_um_s: 1_000,
            }),
            request => request,
        })
        .collect();
    let key = SettingKey::MotorMohm;
    requests.push(Request::GetSetting(GetSetting { key }));
    requests
}

/// The reply without its numbers, the number of actions and what is left to do.
fn outcome(request: &Request, state: RigState) -> String {
    let mut rig = rig_in(state);
    let before = (rig.machine.state(), *rig.machine.record());
    let (reply, effect, actions) = send(&mut rig, request.clone());
    let Reply::Accepted(response) = reply else {
        assert_eq!((actions, &effect), (0, &Effect::None), "{request:?}");
        assert_eq!((rig.machine.state(), *rig.machine.record()), before);
        return format!("{reply:?}");
    };
    assert_eq!(response_name(&response), request.name(), "the same row");
    // Its impact by the protocol's table.
    let renewed = state == RigState::Moving && matches!(request, Request::Jog(_));
    let in_a_run = matches!(state, RigState::Running | RigState::Held);
    let impact = match effect {
        Effect::Acknowledged => Impact::Fault,
        Effect::Store(_) => Impact::Flash,
        _ if actions > 0 && in_a_run => Impact::Pace,
        _ if actions > 0 || renewed => Impact::Motion,
        _ => Impact::None,
    };
    assert_eq!(request.impact(), impact, "{request:?} in {state:?}");
    let effect = match effect {
        Effect::Store(Change::Value { setting, .. }) => format!("store {setting:?}"),
        effect => format!("{effect:?}"),
    };
    format!("accepted, {actions} actions, {effect}")
}

fn response_name(response: &Response) -> String {
    let text = format!("{response:?}");
    text.split('(').next().unwrap_or_default().to_owned()
}

#[test]
fn every_row_in_every_state() {
    let mut table = String::new();
    for request in requests() {
        table += &format!("{request:?}\n");
        let mut outcomes: Vec<(String, Vec<RigState>)> = Vec::new();
        for state in STATES {
            let outcome = outcome(&request, state);
            match outcomes.iter_mut().find(|(seen, _)| *seen == outcome) {
                Some((_, states)) => states.push(state),
                None => outcomes.push((outcome, vec![state])),
            }
        }
        for (outcome, states) in outcomes {
            table += &format!("    {outcome} <- {states:?}\n");
        }
    }
    insta::assert_snapshot!("requests_in_states", table);
}

#[test]
fn status_shows_the_machine() {
    let statuses = STATES.map(|state| {
        let mut rig = rig_in(state);
        match send(&mut rig, Request::GetRigStatus(rig::GetRigStatus)).0 {
            Reply::Accepted(Response::GetRigStatus(status)) => status,
            other => panic!("{other:?}"),
        }
    });
    insta::assert_debug_snapshot!("status_in_states", statuses);
}

#[test]
fn a_move_says_how_it_will_be() {
    let mut rig = Rig::homed(SETTINGS);
    // 10.001 mm are 8,000.8 steps: rounded towards home.
    let request = Request::MoveTo(rig::MoveTo {
        position_um: 10_001,
        speed_um_s: 10_000,
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
    let mut refusals = String::new();
    let to = |position_um, speed_um_s| {
        Request::MoveTo(rig::MoveTo {
            position_um,
            speed_um_s,
        })
    };
    let jog = |direction, speed_um_s| {
        Request::Jog(rig::Jog {
            direction,
            speed_um_s,
        })
    };
    for request in [
        to(130_001, 1_000),
        to(u32::MAX, 1_000),
        to(10_000, 0),
        to(10_000, 49_001),
        // Less than a step away.
        to(1, 1_000),
        jog(rig::Direction::Away, 0),
        jog(rig::Direction::Home, 49_001),
        jog(rig::Direction::Home, 1_000),
    ] {
        let (reply, ..) = send(&mut rig, request.clone());
        refusals += &format!("{request:?}: {reply:?}\n");
    }
    assert_eq!(rig.machine.state(), RigState::Ready);
    insta::assert_snapshot!("moves_out_of_range", refusals);
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
        assert_eq!(send(&mut rig, to(speed_um_s)).0, Reply::Refused(refused));
    }
    assert!(matches!(send(&mut rig, to(40_000)).0, Reply::Accepted(_)));
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
