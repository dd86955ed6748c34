//! Warm-up before a machine is served in real time: executes the usual requests on another machine, whose translated
//! code the next one with the same image takes over.
//!
//! The emulator translates code when it is first executed: in the first homing for 0.6 s of processor time. On a busy
//! computer that is longer than a client waits for an answer, and a machine loses the time that it cannot catch up.

use client::{Device, Unobserved};
use lab::trials::experiment::{DEFAULT_TELEMETRY_MS, PAPER_RUN};
use protocol::rig::{GetRigHardware, GetRigHealth, Hold, Jog, MoveTo, Resume, Run, RunTiming};
use protocol::settings::{Setting, SettingKey};
use protocol::system::{DeviceKind, Urgent};

use crate::bench::BenchError;
use crate::boards;
use crate::link::VirtualLink;
use crate::plants::capsule::Parameters;
use crate::plants::rig::RigOptions;

/// 10 mm there and back.
const SHORT: Run = Run {
    cycles: 1,
    stroke_um: 10_000,
    timing: RunTiming::Total {
        total_us: 1_000_000,
        accel_um_s2: 400_000,
    },
    ..PAPER_RUN
};

/// Homes a rig, runs, holds, resumes, moves and stops it.
///
/// # Errors
/// As those of the machine that is served after it.
pub fn rig() -> Result<(), BenchError> {
    let bench = boards::rig::start(RigOptions::WITH_BOTH_JUMPERS)?;
    let link = Box::new(VirtualLink::new(&bench, "warming up"));
    let mut device = Device::connect(link, DeviceKind::Rig, 1)?;
    device.call(Setting {
        key: SettingKey::PullOffUm,
        value: 1_000,
    })?;
    let accepted = device.home()?;
    device.wait_homing(&accepted, &mut Unobserved)?;
    device.set_telemetry(DEFAULT_TELEMETRY_MS)?;
    let accepted = device.run(SHORT)?;
    device.idle(200_000, &mut Unobserved)?;
    device.call(Hold)?;
    device.idle(200_000, &mut Unobserved)?;
    device.call(Resume)?;
    device.wait_run(&accepted, &mut Unobserved)?;
    let speed_um_s = 10_000;
    let accepted = device.call(MoveTo {
        position_um: 5_000,
        speed_um_s,
    })?;
    device.wait_move(&accepted, &mut Unobserved)?;
    device.call(Jog {
        direction: protocol::rig::Direction::Away,
        speed_um_s,
    })?;
    device.idle(100_000, &mut Unobserved)?;
    device.urgent(Urgent::Stop)?;
    device.wait_rest(&mut Unobserved)?;
    device.call(GetRigHealth)?;
    device.call(GetRigHardware)?;
    device.kept_events()?;
    device.urgent(Urgent::EStop)?;
    device.acknowledge()?;
    Ok(())
}

/// Starts a capsule's search for its reference, and stops it: the rest takes seconds of virtual time.
///
/// # Errors
/// As those of the machine that is served after it.
pub fn capsule() -> Result<(), BenchError> {
    let bench = boards::capsule::start(Parameters::nominal())?;
    let link = Box::new(VirtualLink::new(&bench, "warming up"));
    let mut device = Device::connect(link, DeviceKind::Capsule, 1)?;
    device.set_telemetry(DEFAULT_TELEMETRY_MS)?;
    device.reference()?;
    device.idle(300_000, &mut Unobserved)?;
    device.urgent(Urgent::Stop)?;
    device.idle(100_000, &mut Unobserved)?;
    device.actuation_record()?;
    device.trace()?;
    device.kept_events()?;
    device.urgent(Urgent::EStop)?;
    device.acknowledge()?;
    Ok(())
}
