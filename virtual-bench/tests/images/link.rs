//! A bad line and a line that falls silent, in every state of the rig.

use client::error::ClientError;
use client::link::Link;
use client::{Device, Unobserved};

use crate::capsule::CapsuleRun;
use crate::common::{
    Any, Dice, Recorder, exact, paper, quick, quickly_homed, rig, rig_with_chip, ways_to_go_on,
};
use protocol::{
    frame::{Header, Kind, encode},
    rig::{Direction, GetRigHealth, Home, Jog, LinkLossPolicy, RigState, Run, RunOutcome},
    settings::SettingKey,
    system::{Acknowledge, DeviceKind, KeepAlive, Urgent},
    table::Request,
};
use virtual_bench::{bench::Bench, emulator::Wiring, link::VirtualLink, serial::ByteFault};

/// An error stops the port's DMA, and what the last round left in its ring must not be read again: an emergency stop
/// needs no session, and would latch a second time. Wherever the stream would go on by itself, the link stays.
#[test]
fn a_framing_error_brings_no_old_frame_back() {
    for streams in ways_to_go_on() {
        eprintln!("{streams:?}");
        let mut rig = rig_with_chip(|chip| chip.streams = streams);
        err(&rig.bench, &mut rig.device, |device| {
            device.rig_status().map(|status| status.fault.is_some())
        });
        let health = rig.device.call(GetRigHealth).expect("an answer");
        assert!(health.uart_errors > 20, "{}", health.uart_errors);
        rig.check_clean(0);
    }
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
    rig.visit(move |visit| {
        let mut serial = visit.serial();
        let (taken, sent) = serial.counts();
        for (to_machine, number, fault) in faults {
            if to_machine {
                serial.corrupt_to_machine(taken + number, fault);
            } else {
                serial.corrupt_from_machine(sent + number, fault);
            }
        }
    });
    let first = rig.edge_count();
    let mut recorder = Recorder::default();
    let accepted = rig.device.run(paper(2)).expect("the run is accepted");
    let record = rig
        .device
        .wait_run(&accepted, &mut recorder)
        .unwrap_or_else(|error| panic!("seed {seed:#x}: {error}\n{}", rig.log()));
    assert_eq!((accepted.run, record.run), (1, 1), "seed {seed:#x}");
    assert_eq!(record.outcome, RunOutcome::Complete, "seed {seed:#x}");
    rig.is_exact(&exact(2), first);
    assert!(rig.device.rejected_frames() > 5, "the faults were not met");
    assert!(recorder.samples.len() > 600, "{}", recorder.samples.len());
    rig.check_clean(0);
}

/// Silence ends each motion as documented, and opening the port again moves nothing. The library's tests have the other
/// states.
#[test]
fn silence_ends_a_motion_and_reconnecting_moves_nothing() {
    let run = |link_loss| Run {
        link_loss,
        ..quick(1, 40_000, 30_000, 300_000)
    };
    let [stop, finish] = [LinkLossPolicy::Stop, LinkLossPolicy::Finish].map(run);
    let jog = Jog {
        direction: Direction::Away,
        speed_um_s: 20_000,
    };
    for (request, outcome) in [
        (Request::Home(Home), None),
        (Request::Run(stop), Some(RunOutcome::LinkLost)),
        (Request::Run(finish), Some(RunOutcome::Complete)),
        (Request::Jog(jog), None),
    ] {
        let homes = matches!(request, Request::Home(_));
        let mut rig = if homes { rig() } else { quickly_homed() };
        if homes {
            // Slow enough to be still moving when the silence is noticed.
            rig.set(SettingKey::SeekUmS, 5_000);
        }
        rig.device.call(Any(request.clone())).expect("accepted");
        let silent = rig.edge_count();
        rig.pass(4_500_000);
        let edges = rig.edge_count();
        assert!(edges > silent, "{request:?}: it did not move");
        let link = Box::new(VirtualLink::new(&rig.bench, "virtual rig"));
        rig.device = Device::connect(link, DeviceKind::Rig, 77).expect("it answers");
        rig.idle(500_000);
        assert_eq!(rig.edge_count(), edges, "{request:?}: it moved");
        let status = rig.status();
        let expected = [RigState::Ready, RigState::Unhomed][usize::from(homes)];
        let found = (status.state, status.fault);
        assert_eq!(found, (expected, None), "{request:?}");
        if status.homed {
            let position = i64::from(status.position_steps);
            assert_eq!(position, rig.carriage(), "{request:?}");
        }
        if let Some(outcome) = outcome {
            let record = rig.device.run_record().expect("a record");
            assert_eq!(record.outcome, outcome);
        }
        if let Request::Jog(_) = request {
            // 300 ms of dead-man time, and braking.
            let place = rig.carriage();
            assert!((1..=8_000).contains(&place), "{place} steps");
        }
        rig.check_clean(0);
    }
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
    use Heard::{Echo, Nonsense, OldSession, Replies};
    for heard in [Echo, OldSession, Nonsense, Replies] {
        let mut rig = quickly_homed();
        let session = rig.device.identity().expect("connected").session;
        let (kind, session) = match heard {
            Echo | Nonsense => (Kind::Request, session),
            OldSession => (Kind::Request, session.wrapping_sub(1)),
            Replies => (Kind::Reply, session),
        };
        rig.device.set_telemetry(5).expect("telemetry");
        let run = Run {
            link_loss: LinkLossPolicy::Stop,
            ..quick(200, 20_000, 40_000, 500_000)
        };
        rig.device.run(run).expect("accepted");
        let echo = matches!(heard, Echo);
        rig.visit(move |visit| visit.serial().echo = echo);
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
                    OldSession => encode(header, &Request::KeepAlive(KeepAlive)),
                    _ => encode(header, &[0xFF_u8; 3]),
                };
                line.send(&frame.expect("fits")).expect("sent");
            }
            rig.pass(100_000);
        }
        let edges = rig.edge_count();
        rig.visit(|visit| visit.serial().echo = false);
        rig.pass(200_000);
        assert_eq!(rig.edge_count(), edges, "{heard:?}: it goes on");
        rig.device.hello(77).expect("it answers");
        let record = rig.device.run_record().expect("a record");
        assert_eq!(record.outcome, RunOutcome::LinkLost, "{heard:?}");
        rig.check_clean(0);
    }
}

/// A run depends on the host that began it: requests of another client do not keep it going.
#[test]
fn a_bystander_does_not_keep_a_run_going_whose_host_is_gone() {
    let mut rig = quickly_homed();
    let run = quick(200, 20_000, 40_000, 500_000);
    rig.device.run(run).expect("accepted");
    rig.idle(700_000);
    let link = Box::new(VirtualLink::new(&rig.bench, "virtual rig"));
    let gone_ns = rig.bench.now_ns();
    rig.device = Device::connect(link, DeviceKind::Rig, 77).expect("it answers");
    rig.device.set_telemetry(50).expect("telemetry");
    while rig.bench.now_ns() < gone_ns + 2_500_000_000 {
        rig.device.observe(20_000, &mut Unobserved).expect("there");
        rig.device.rig_status().expect("an answer");
    }
    let after_ms = (rig.last_edge_ns() - gone_ns) / 1_000_000;
    assert!((900..=1_100).contains(&after_ms), "{after_ms} ms");
    let record = rig.device.run_record().expect("a record");
    assert_eq!(record.outcome, RunOutcome::LinkLost);
    rig.check_clean(0);
}
