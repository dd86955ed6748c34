//! A process that was suspended while something moved: the machine stopped or went on, and somebody pressed its button.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use client::error::{ClientError, Missing};
use client::link::{Link, LinkError};
use client::{Device, Observer, Progress, Unobserved};
use lab::trials::experiment::PAPER_RUN;
use protocol::rig::{LinkLossPolicy, MoveTo, Run, RunOutcome, RunTiming};
use protocol::settings::SettingKey;
use protocol::system::DeviceKind;
use protocol::table::Telemetry;
use simulated_machines::machine::{World, button, link};

use crate::support::tool::{Memory, ready};

const RUN: Run = Run {
    cycles: 1,
    stroke_um: 20_000,
    timing: RunTiming::Total {
        total_us: 4_000_000,
        accel_um_s2: 100_000,
    },
    ..PAPER_RUN
};

/// A homed rig whose button begins the same run, and is pressed at these times.
fn rig(presses_us: &[u64]) -> Device {
    let mut script = ready(DeviceKind::Rig);
    script.settings = vec![
        (SettingKey::ButtonCycles, 1),
        (SettingKey::ButtonStrokeUm, 20_000),
        (SettingKey::ButtonTotalMs, 4_000),
    ];
    script.world = presses_us.iter().flat_map(|us| button(*us)).collect();
    let (link, _) = link(script);
    Device::connect(link, DeviceKind::Rig, 1).expect("a rig")
}

/// The button's run has the same plan, and would pass for it.
#[test]
fn a_run_has_no_outcome_once_another_one_has_begun() {
    for (link_loss, presses_us, silent_us) in [
        // It has stopped; the first press homes, the second one begins the other run, which has ended or goes on.
        (
            LinkLossPolicy::Stop,
            &[8_000_000, 60_000_000][..],
            80_000_000,
        ),
        (LinkLossPolicy::Stop, &[8_000_000, 60_000_000], 62_000_000),
        (LinkLossPolicy::Finish, &[9_000_000], 20_000_000),
    ] {
        let mut rig = rig(presses_us);
        let accepted = rig.run(Run { link_loss, ..RUN }).expect("accepted");
        rig.fall_silent(silent_us).expect("the line is there");
        let ended = rig.wait_run(&accepted, &mut Unobserved);
        let Err(ClientError::Unanswered {
            missing: Missing::Record { run: 1, last: 2 },
            ..
        }) = ended
        else {
            panic!("{link_loss:?}, {silent_us} us: {ended:?}");
        };
    }
}

/// Homing ends where the move was to end.
#[test]
fn a_move_that_lost_its_host_has_not_arrived_by_a_homing() {
    let mut rig = rig(&[20_000_000]);
    let to = |position_um| MoveTo {
        position_um,
        speed_um_s: 20_000,
    };
    let accepted = rig.call(to(60_000)).expect("accepted");
    let there = rig.wait_move(&accepted, &mut Unobserved).expect("it ends");
    assert_eq!(there.0, RunOutcome::Complete);
    let accepted = rig.call(to(0)).expect("accepted");
    rig.fall_silent(40_000_000).expect("the line is there");
    let (outcome, status) = rig.wait_move(&accepted, &mut Unobserved).expect("it ends");
    assert_eq!((outcome, status.position_steps), (RunOutcome::LinkLost, 0));
}

/// The rig's step timer stands: it is stopped, and the command ends.
#[test]
fn a_move_without_an_end_is_overdue() {
    let mut script = ready(DeviceKind::Rig);
    script.world = vec![(1_500_000, World::TimerStands)];
    let memory = Memory::with(vec![script]);
    let (code, _, err) = memory.run(&["--rig", "0", "move", "60", "--speed-mm-s", "20"]);
    assert_eq!(code, 6, "{err}");
    assert!(err.contains("did not end within"), "{err}");
}

/// A line on which time passes while nobody reads.
struct Unread {
    line: Box<dyn Link>,
    passed_us: Arc<AtomicU64>,
    bytes: VecDeque<u8>,
}

impl Unread {
    fn catch_up(&mut self) -> Result<(), LinkError> {
        let until_us = self.line.now_us() + self.passed_us.swap(0, Ordering::Relaxed);
        let mut buffer = [0; 512];
        while self.line.now_us() < until_us {
            let count = self.line.receive(&mut buffer, until_us)?;
            self.bytes.extend(&buffer[..count]);
        }
        Ok(())
    }
}

impl Link for Unread {
    fn place(&self) -> String {
        self.line.place()
    }
    fn now_us(&self) -> u64 {
        self.line.now_us() + self.passed_us.load(Ordering::Relaxed)
    }
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.catch_up()?;
        self.line.send(bytes)
    }
    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        self.catch_up()?;
        if self.bytes.is_empty() {
            return self.line.receive(buffer, deadline_us);
        }
        let count = buffer.len().min(self.bytes.len());
        for (slot, byte) in buffer.iter_mut().zip(self.bytes.drain(..count)) {
            *slot = byte;
        }
        Ok(count)
    }
}

/// Lets a minute pass when it is first told of progress, and counts samples, and those that are missing.
struct Paused {
    passed_us: Arc<AtomicU64>,
    pause_us: u64,
    samples: u64,
    times_us: (u64, u64),
}

impl Observer for Paused {
    fn progress(&mut self, _: &Progress) {
        let pause_us = std::mem::take(&mut self.pause_us);
        self.passed_us.fetch_add(pause_us, Ordering::Relaxed);
    }
    fn telemetry(&mut self, sample: &Telemetry, missed: u16) {
        let Telemetry::Rig(rig) = sample else { return };
        if self.samples == 0 {
            self.times_us.0 = rig.time_us;
        }
        self.samples += u64::from(missed) + 1;
        self.times_us.1 = rig.time_us;
    }
}

/// The status is older than the pause, so it does not show that the run is overdue.
#[test]
fn a_run_whose_host_stood_still_keeps_its_record_and_counts_what_it_has_not_read() {
    let (line, _) = link(ready(DeviceKind::Rig));
    let passed_us = Arc::<AtomicU64>::default();
    let line = Unread {
        line,
        passed_us: Arc::clone(&passed_us),
        bytes: VecDeque::new(),
    };
    let mut rig = Device::connect(Box::new(line), DeviceKind::Rig, 1).expect("a rig");
    rig.set_telemetry(10).expect("set");
    let accepted = rig.run(RUN).expect("accepted");
    let mut paused = Paused {
        passed_us,
        pause_us: 60_000_000,
        samples: 0,
        times_us: (0, 0),
    };
    let record = rig.wait_run(&accepted, &mut paused).expect("a record");
    assert_eq!(record.outcome, RunOutcome::LinkLost);
    let (first_us, last_us) = paused.times_us;
    assert!(last_us - first_us > 60_000_000, "{last_us} us");
    assert_eq!(paused.samples, (last_us - first_us) / 10_000 + 1);
}
