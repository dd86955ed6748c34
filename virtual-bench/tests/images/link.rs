//! A bad line and a line that falls silent, in every state of the rig.

use client::error::ClientError;
use client::link::Link;
use client::{Device, Unobserved};

use crate::capsule::CapsuleRun;
use crate::common::{
    Dice, LIMIT_NS, Recorder, RigRun, exact, home_quickly, paper, quick, quickly_homed, rig, trials,
};
use protocol::{
    error::Refusal,
    frame::{Header, Kind, encode},
    rig::{
        Direction, GetRigHealth, Hold, Jog, LinkLossPolicy, MoveTo, Resume, RigFault, RigState,
        Run, RunOutcome, RunRecord,
    },
    system::{Acknowledge, DeviceKind, KeepAlive, Urgent},
    table::Request,
};
use virtual_bench::{
    bench::Bench, emulator::Wiring, link::VirtualLink, serial::ByteFault, verdicts::Verdict,
};

/// An error stops the port's DMA, which then begins anew at the start of its ring: what the last round left there must
/// not be read again. An emergency stop needs no session, and would latch a second time.
#[test]
fn a_framing_error_brings_no_old_frame_back() {
    let mut rig = rig();
    err(&rig.bench, &mut rig.device, |device| {
        device.rig_status().map(|status| status.fault.is_some())
    });
    let health = rig.device.call(GetRigHealth).expect("an answer");
    assert!(health.uart_errors > 20, "{}", health.uart_errors);
    let CapsuleRun { bench, mut device } = crate::capsule::start();
    err(&bench, &mut device, |device| {
        device.capsule_status().map(|status| status.fault.is_some())
    });
}

/// Errors behind an emergency stop that was acknowledged, from a few to nothing but errors.
fn err<W: Wiring + 'static>(
    bench: &Bench<W>,
    device: &mut Device,
    is_faulted: fn(&mut Device) -> Result<bool, ClientError>,
) {
    let garble = |per_million| {
        bench
            .visit(move |visit| visit.set_framing_errors(per_million))
            .expect("the bench runs");
    };
    for round in 0..20 {
        device.urgent(Urgent::EStop).expect("confirmed");
        device.forget_stop();
        device.call(Acknowledge).expect("acknowledged");
        garble(if round % 4 == 3 { 1_000_000 } else { 200_000 });
        // May be answered or not.
        let _ = is_faulted(device);
        garble(0);
        let is_faulted = is_faulted(device).expect("a status");
        assert!(!is_faulted, "round {round}");
    }
}

/// Changes one byte in a thousand and drops half of those, in both directions, for a whole run with telemetry.
#[test]
fn a_byte_in_a_thousand_is_garbled_and_the_run_is_executed_once() {
    let seed = 0x5EED_6A2B;
    let mut dice = Dice(seed);
    let mut rig = crate::common::homed();
    rig.device.set_telemetry(20).expect("telemetry");
    let mut faults = Vec::new();
    for number in 0..60_000_u64 {
        for to_machine in [false, true] {
            if dice.roll(0..1_000) == 0 {
                let fault = match dice.roll(0..2) {
                    0 => ByteFault::Lost,
                    _ => ByteFault::Flipped(dice.roll(1..256) as u8),
                };
                faults.push((to_machine, number, fault));
            }
        }
    }
    rig.bench
        .visit(move |visit| {
            let mut serial = visit.serial();
            let (taken, sent) = serial.counts();
            for (to_machine, number, fault) in faults {
                if to_machine {
                    serial.corrupt_to_machine(taken + number, fault);
                } else {
                    serial.corrupt_from_machine(sent + number, fault);
                }
            }
        })
        .expect("the bench runs");
    let first = rig.edge_count();
    let mut recorder = Recorder::default();
    let accepted = rig.device.run(paper(2)).expect("the run is accepted");
    let record = rig
        .device
        .wait_run(&accepted, &mut recorder)
        .unwrap_or_else(|error| panic!("seed {seed:#x}: {error}\n{}", rig.log()));
    assert_eq!(
        (accepted.run, record.run, record.outcome),
        (1, 1, RunOutcome::Complete),
        "seed {seed:#x}"
    );
    Verdict::of(&exact(2), &rig.edges(first))
        .check(LIMIT_NS)
        .unwrap_or_else(|why| panic!("seed {seed:#x}: {why}"));
    assert!(rig.device.rejected_frames() > 5, "the faults were not met");
    assert!(
        recorder.samples.len() > 600,
        "{} samples",
        recorder.samples.len()
    );
    rig.check_clean(0);
}

/// The state in which the silence begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Before {
    Unhomed,
    Homing,
    Ready,
    RunningToStop,
    RunningToFinish,
    Stopping,
    Held,
    MovingTo,
    Jogging,
    Faulted,
}

impl Before {
    /// Each state, with the state and fault after three seconds of silence.
    const ALL: [(Self, RigState, Option<RigFault>); 10] = [
        (Self::Unhomed, RigState::Unhomed, None),
        (Self::Homing, RigState::Unhomed, None),
        (Self::Ready, RigState::Ready, None),
        (Self::RunningToStop, RigState::Ready, None),
        (Self::RunningToFinish, RigState::Ready, None),
        (Self::Stopping, RigState::Ready, None),
        (Self::Held, RigState::Held, None),
        (Self::MovingTo, RigState::Ready, None),
        (Self::Jogging, RigState::Ready, None),
        (Self::Faulted, RigState::Faulted, Some(RigFault::EStopFrame)),
    ];

    /// Brings a rig into this state, then falls silent.
    fn reach(self) -> RigRun {
        let mut rig = rig();
        if self == Self::Unhomed {
            return rig;
        }
        if self == Self::Homing {
            // Slow enough to be still moving when the silence is noticed.
            rig.device
                .call(protocol::settings::Setting {
                    key: protocol::settings::SettingKey::SeekUmS,
                    value: 5_000,
                })
                .expect("accepted");
            rig.device.home().expect("homing is accepted");
            return rig;
        }
        home_quickly(&mut rig);
        rig.home();
        match self {
            Self::Unhomed | Self::Homing | Self::Ready => {}
            Self::MovingTo => {
                let there = MoveTo {
                    position_um: 100_000,
                    speed_um_s: 20_000,
                };
                rig.device.call(there).expect("the move is accepted");
            }
            Self::Jogging => {
                let jog = Jog {
                    sense: Direction::Away,
                    speed_um_s: 20_000,
                };
                rig.device.call(jog).expect("the jog is accepted");
            }
            Self::RunningToStop
            | Self::RunningToFinish
            | Self::Stopping
            | Self::Held
            | Self::Faulted => {
                let link_loss = if self == Self::RunningToFinish {
                    LinkLossPolicy::Finish
                } else {
                    LinkLossPolicy::Stop
                };
                rig.device
                    .run(Run {
                        link_loss,
                        ..quick(1, 40_000, 30_000, 300_000)
                    })
                    .expect("the run is accepted");
                rig.device
                    .idle(600_000, &mut Unobserved)
                    .expect("the link stays");
            }
        }
        match self {
            Self::Stopping => rig.device.urgent(Urgent::Stop).expect("an answer"),
            Self::Faulted => rig.device.urgent(Urgent::EStop).expect("an answer"),
            Self::Held => {
                rig.device.call(Hold).expect("it holds");
                let state = (0..20).map(|_| {
                    rig.device
                        .idle(50_000, &mut Unobserved)
                        .expect("the link stays");
                    rig.device.rig_status().expect("a status").state
                });
                assert!(state.into_iter().any(|state| state == RigState::Held));
            }
            _ => {}
        }
        rig
    }

    fn outcome(self) -> Option<RunOutcome> {
        match self {
            Self::RunningToStop => Some(RunOutcome::LinkLost),
            Self::RunningToFinish => Some(RunOutcome::Complete),
            Self::Stopping => Some(RunOutcome::Stopped),
            Self::Faulted => Some(RunOutcome::Faulted(RigFault::EStopFrame)),
            Self::Held => Some(RunOutcome::Running),
            _ => None,
        }
    }
}

/// Silence ends as documented. Opening the port again and sending Hello moves nothing.
#[test]
fn silence_in_every_state_ends_as_documented_and_reconnecting_moves_nothing() {
    for (before, state, fault) in Before::ALL {
        let mut rig = before.reach();
        let silent = rig.edge_count();
        rig.bench.advance_us(3_500_000).expect("the bench runs");
        let edges = rig.edge_count();
        let moved = edges > silent;
        let may_move = matches!(
            before,
            Before::Homing
                | Before::RunningToStop
                | Before::RunningToFinish
                | Before::MovingTo
                | Before::Jogging
        );
        if before != Before::Stopping {
            assert_eq!(moved, may_move, "{before:?}: {silent} to {edges} edges");
        }
        let link = Box::new(VirtualLink::new(&rig.bench, "virtual rig"));
        rig.device = Device::connect(link, DeviceKind::Rig, 77).expect("it answers");
        rig.device
            .idle(500_000, &mut Unobserved)
            .expect("the link stays");
        assert_eq!(rig.edge_count(), edges, "{before:?}: it moved");
        let status = rig.device.rig_status().expect("a status");
        assert_eq!(
            (status.state, status.fault),
            (state, fault),
            "{before:?}\n{}",
            rig.log()
        );
        if status.homed {
            assert_eq!(
                i64::from(status.position_steps),
                rig.carriage(),
                "{before:?}"
            );
        }
        if let Some(expected) = before.outcome() {
            let record = rig.device.run_record().expect("a record");
            assert_eq!(record.outcome, expected, "{before:?}");
        }
        if before == Before::Jogging {
            // 300 ms of dead-man time, and braking.
            assert!(
                (1..=8_000).contains(&rig.carriage()),
                "{} steps",
                rig.carriage()
            );
        }
        if before == Before::Held {
            resumed(&mut rig);
        }
        // A stop by frame is immediate, so it sometimes cuts a pulse.
        let cuts = usize::from(fault == Some(RigFault::EStopFrame));
        rig.check_clean_after(0, cuts);
    }
}

fn resumed(rig: &mut RigRun) {
    rig.device.call(Resume).expect("it goes on");
    let ended: Result<RunRecord, ClientError> = loop {
        rig.device
            .idle(200_000, &mut Unobserved)
            .expect("the link stays");
        let record = rig.device.run_record();
        if !matches!(&record, Ok(record) if record.outcome == RunOutcome::Running) {
            break record;
        }
    };
    let record = ended.expect("a record");
    assert_eq!(
        (record.outcome, record.counted_edges, rig.carriage()),
        (RunOutcome::Complete, 64_000, 0)
    );
}

/// Bytes that reach a rig whose host is gone.
#[derive(Clone, Copy, Debug)]
enum Heard {
    /// Its own telemetry, on a line with TX and RX shorted.
    Echo,
    /// A host whose session was replaced by a newer one.
    OldSession,
    /// Frames with a valid checksum whose content is no request.
    Nonsense,
    /// Replies, as another device would send them.
    Replies,
}

/// Only a request of the session, or a stop, shows that the host is there.
#[test]
fn what_is_no_host_does_not_keep_a_run_going() {
    for heard in [
        Heard::Echo,
        Heard::OldSession,
        Heard::Nonsense,
        Heard::Replies,
    ] {
        let mut rig = rig();
        home_quickly(&mut rig);
        rig.home();
        let session = rig.device.identity().expect("connected").session;
        let (kind, session) = match heard {
            Heard::Echo | Heard::Nonsense => (Kind::Request, session),
            Heard::OldSession => (Kind::Request, session.wrapping_sub(1)),
            Heard::Replies => (Kind::Reply, session),
        };
        rig.device.set_telemetry(5).expect("telemetry");
        let run = Run {
            link_loss: LinkLossPolicy::Stop,
            ..quick(200, 20_000, 40_000, 500_000)
        };
        rig.device.run(run).expect("accepted");
        let echo = matches!(heard, Heard::Echo);
        rig.bench
            .visit(move |visit| visit.serial().echo = echo)
            .expect("the bench runs");
        let mut line = VirtualLink::new(&rig.bench, "somebody else");
        // The time-out is 1 s.
        for seq in 0..15 {
            if !echo {
                let header = Header {
                    kind,
                    session,
                    seq: 1_000 + seq,
                };
                let frame = match heard {
                    Heard::OldSession => encode(header, &Request::KeepAlive(KeepAlive)),
                    _ => encode(header, &[0xFF_u8; 3]),
                };
                line.send(&frame.expect("fits")).expect("sent");
            }
            rig.bench.advance_us(100_000).expect("the bench runs");
        }
        let edges = rig.edge_count();
        rig.bench
            .visit(|visit| visit.serial().echo = false)
            .expect("the bench runs");
        rig.bench.advance_us(200_000).expect("the bench runs");
        assert_eq!(
            rig.edge_count(),
            edges,
            "{heard:?}: it goes on without its host"
        );
        rig.device.hello(77).expect("it answers");
        let record = rig.device.run_record().expect("a record");
        assert_eq!(record.outcome, RunOutcome::LinkLost, "{heard:?}");
        rig.check_clean(0);
    }
}

/// Intervals at which the next client polls the rig: `watch`, `serve`, and a `watch` with five windows at its door.
const LOOKS_US: [u64; 3] = [250_000, 100_000, 20_000];

/// A run whose host disappears after `for_us`, and the rig's next client, which only polls it.
fn orphaned(run: Run, for_us: u64) -> (RigRun, Device, u64) {
    let mut rig = quickly_homed();
    rig.device.run(run).expect("accepted");
    rig.device.idle(for_us, &mut Unobserved).expect("there");
    let link = Box::new(VirtualLink::new(&rig.bench, "virtual rig"));
    let gone_us = link.now_us();
    let mut other = Device::connect(link, DeviceKind::Rig, 77).expect("it answers");
    other.set_telemetry(50).expect("telemetry");
    (rig, other, gone_us)
}

/// Polls every `look_us` for `for_us` after `gone_us`. Returns the time from `gone_us` to the last edge.
fn look_on(rig: &RigRun, other: &mut Device, gone_us: u64, look_us: u64, for_us: u64) -> u64 {
    let (mut last_us, mut edges) = (gone_us, rig.edge_count());
    let mut look = gone_us;
    while other.now_us() < gone_us + for_us {
        other.observe(5_000, &mut Unobserved).expect("there");
        if other.now_us() >= look {
            other.rig_status().expect("an answer");
            look += look_us;
        }
        let count = rig.edge_count();
        if count > edges {
            (last_us, edges) = (other.now_us(), count);
        }
    }
    last_us - gone_us
}

/// A run depends on the host that began it: requests of another client do not keep it going.
#[test]
fn a_bystander_does_not_keep_a_run_going_whose_host_is_gone() {
    for look_us in LOOKS_US {
        for trial in 0..trials(2, 20) {
            let mut dice = Dice(0x5107 + trial);
            let run = Run {
                link_loss: LinkLossPolicy::Stop,
                ..quick(200, 20_000, 40_000, 500_000)
            };
            let (mut rig, mut other, gone_us) = orphaned(run, dice.roll(100_000..3_000_000));
            let after_ms = look_on(&rig, &mut other, gone_us, look_us, 2_500_000) / 1_000;
            eprintln!("looks every {look_us} us, trial {trial}: the last edge after {after_ms} ms");
            assert!((900..=1_100).contains(&after_ms), "{after_ms} ms");
            let record = other.run_record().expect("a record");
            assert_eq!(record.outcome, RunOutcome::LinkLost);
            rig.device = other;
            rig.check_clean(0);
        }
    }
}

#[test]
fn a_run_that_was_to_finish_finishes_whoever_looks_on() {
    for look_us in LOOKS_US {
        for trial in 0..trials(1, 20) {
            let mut dice = Dice(0xf171 + trial);
            let run = Run {
                link_loss: LinkLossPolicy::Finish,
                ..quick(3, 20_000, 40_000, 500_000)
            };
            let (mut rig, mut other, gone_us) = orphaned(run, dice.roll(100_000..500_000));
            let after_ms = look_on(&rig, &mut other, gone_us, look_us, 4_500_000) / 1_000;
            assert!((2_500..=4_000).contains(&after_ms), "{after_ms} ms");
            let record = other.run_record().expect("a record");
            assert_eq!(record.outcome, RunOutcome::Complete);
            rig.device = other;
            rig.check_clean(0);
        }
    }
}
