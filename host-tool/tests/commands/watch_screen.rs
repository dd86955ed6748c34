//! The screen of `watch` in two sizes.

use std::time::{Duration, Instant};

use host_tool::cli::watch::draw::{Look, draw};
use lab::operations::panel::{Contact, Notice, Panel};
use protocol::capsule::{CapsuleFault, CapsuleState, CapsuleStatus, CapsuleTelemetry};
use protocol::rig::{RigEvent, RigFault, RigInputs, RigState, RigStatus, RigTelemetry};
use protocol::system::{DeviceKind, Event, What};
use protocol::table::Telemetry;
use ratatui_core::backend::TestBackend;
use ratatui_core::style::Color;
use ratatui_core::terminal::Terminal;

const LOOK: Look = Look {
    colours: true,
    unicode: true,
};

const INPUTS: RigInputs = RigInputs {
    home_flag: false,
    far_limit: false,
    estop_loop: false,
};

fn rig_status() -> RigStatus {
    RigStatus {
        time_us: 60_000_000,
        state: RigState::Running,
        fault: None,
        homed: true,
        position_steps: 104_000,
        position_um: 130_000,
        stroke_um: 130_000,
        steps_per_rev: 3_200,
        lead_um: 4_000,
        inputs: INPUTS,
        run: 7,
        stroke: 3,
        strokes: 10,
        elapsed_us: 14_600_000,
        needs_acknowledge: false,
    }
}

fn rig_sample(time_us: u64, state: RigState, mm: i32, speed_um_s: i32) -> Telemetry {
    Telemetry::Rig(RigTelemetry {
        time_us,
        state,
        position_steps: mm * 800,
        commanded_steps: mm * 800,
        speed_um_s,
        stroke: 3,
        residual_steps: 0,
        inputs: INPUTS,
    })
}

fn capsule_status() -> CapsuleStatus {
    CapsuleStatus {
        time_us: 12_345_678,
        state: CapsuleState::Folding,
        fault: None,
        referenced: true,
        thread_um: 9_000,
        current_ma: 90,
        battery_mv: 3_702,
        actuation: 2,
        needs_acknowledge: false,
    }
}

/// A rig in another process's run, with samples every 50 ms up to now.
fn running(now: Instant) -> Panel {
    let mut rig = Panel::new(DeviceKind::Rig, "tcp:127.0.0.1:7001".to_owned());
    let owner =
        "process 4711 (`retrograde run --cycles 5 --duration-s 40`), since 2026-11-22T09:20:33Z";
    rig.contact = Contact::Window(owner.to_owned());
    rig.rig_status(&rig_status(), now);
    rig.quality.round_trip = Some(Duration::from_millis(13));
    for sample in (0_u32..40).rev() {
        let at = now - sample * Duration::from_millis(50);
        let mm = 78 + sample as i32;
        let time_us = 61_000_000 - u64::from(sample) * 50_000;
        rig.sample(&rig_sample(time_us, RigState::Running, mm, -32_500), 0, at);
    }
    for stroke in 0..3 {
        rig.event(&Event {
            index: 4 + stroke,
            time_us: 50_000_000 + u64::from(stroke) * 4_000_000,
            what: What::Rig(RigEvent::StrokeDone {
                stroke,
                residual_steps: 0,
            }),
        });
    }
    rig
}

/// As the rig itself rounds it: samples and answers must not differ by 1 um.
#[test]
fn a_sample_gives_the_position_that_the_status_gives() {
    let now = Instant::now();
    let mut rig = Panel::new(DeviceKind::Rig, "tcp:127.0.0.1:7001".to_owned());
    rig.rig_status(&rig_status(), now);
    for (steps, um) in [
        (0, 0),
        (1, 1),
        (2, 3),
        (3, 4),
        (-2, -3),
        (-3, -4),
        (104_000, 130_000),
    ] {
        let Telemetry::Rig(sample) = rig_sample(61_000_000, RigState::Running, 0, 0) else {
            unreachable!("it is a rig's");
        };
        let sample = RigTelemetry {
            position_steps: steps,
            ..sample
        };
        rig.sample(&Telemetry::Rig(sample), 0, now);
        assert_eq!(
            rig.rig.map(|status| status.position_um),
            Some(um),
            "{steps}"
        );
    }
}

fn folding(now: Instant) -> Panel {
    let mut capsule = Panel::new(DeviceKind::Capsule, "/dev/ttyACM1".to_owned());
    capsule.contact = Contact::Owned;
    capsule.capsule_status(&capsule_status(), now);
    let sample = CapsuleTelemetry {
        time_us: 12_400_000,
        state: CapsuleState::Folding,
        thread_um: 12_345,
        current_ma: 123,
        battery_mv: 3_690,
        drive_mv: 1_200,
    };
    capsule.sample(&Telemetry::Capsule(sample), 2, now);
    capsule
}

fn faulted(now: Instant) -> [Panel; 2] {
    let (mut rig, mut capsule) = (running(now), folding(now));
    rig.rig_status(
        &RigStatus {
            state: RigState::Faulted,
            fault: Some(RigFault::ReadBack {
                commanded: 104_000,
                counted: 103_990,
            }),
            ..rig_status()
        },
        now,
    );
    capsule.capsule_status(
        &CapsuleStatus {
            state: CapsuleState::Faulted,
            fault: Some(CapsuleFault::NotUnfolded { wound_um: 4_321 }),
            ..capsule_status()
        },
        now,
    );
    rig.notice = Some(Notice::Done("EMERGENCY STOP latched".to_owned()));
    capsule.notice = Some(Notice::Bad(
        "EMERGENCY STOP NOT CONFIRMED: /dev/ttyACM1 did not confirm the stop. press the emergency stop button".to_owned(),
    ));
    [rig, capsule]
}

fn screen(panels: &[Panel], look: Look, size: (u16, u16), at: Instant) -> Terminal<TestBackend> {
    let mut terminal = Terminal::new(TestBackend::new(size.0, size.1)).expect("infallible");
    terminal
        .draw(|frame| draw(panels, look, at, frame.buffer_mut()))
        .expect("infallible");
    terminal
}

/// The screen as text, without spaces at the ends of lines.
fn text(terminal: &Terminal<TestBackend>) -> String {
    let buffer = terminal.backend().buffer();
    let width = usize::from(buffer.area.width);
    let rows = buffer.content.chunks(width).map(|cells| {
        let row: String = cells
            .iter()
            .map(ratatui_core::buffer::Cell::symbol)
            .collect();
        row.trim_end().to_owned()
    });
    rows.collect::<Vec<_>>().join("\n")
}

#[test]
fn both_machines_at_work() {
    let now = Instant::now();
    let panels = [running(now), folding(now)];
    insta::assert_snapshot!("work-80x24", text(&screen(&panels, LOOK, (80, 24), now)));
    insta::assert_snapshot!("work-200x60", text(&screen(&panels, LOOK, (200, 60), now)));
}

#[test]
fn faults_and_stops_that_may_not_stand() {
    let now = Instant::now();
    let panels = faulted(now);
    insta::assert_snapshot!("faults-80x24", text(&screen(&panels, LOOK, (80, 24), now)));
    insta::assert_snapshot!(
        "faults-200x60",
        text(&screen(&panels, LOOK, (200, 60), now))
    );
}

#[test]
fn a_machine_that_is_gone_and_one_that_is_silent() {
    let now = Instant::now();
    let mut rig = running(now);
    rig.contact = Contact::Lost(
        "the link to tcp:127.0.0.1:7001 was lost: the other end closed it; check cable and supply"
            .to_owned(),
    );
    let panels = [rig, folding(now)];
    let later = now + Duration::from_secs(4);
    insta::assert_snapshot!("gone-80x24", text(&screen(&panels, LOOK, (80, 24), later)));
}

#[test]
fn every_fault_is_shown_whole_with_its_remedy() {
    let now = Instant::now();
    let faults = [
        RigFault::EStopLoop,
        RigFault::LostSteps {
            residual_steps: -123_456,
        },
        RigFault::ReadBack {
            commanded: -1_234_567,
            counted: 1_234_567,
        },
        RigFault::Watchdog,
        RigFault::ClockMissing,
        RigFault::ClockFailed,
        RigFault::BothSwitchesOpen,
        RigFault::SwitchNoise(protocol::rig::Switch::FarLimit),
    ];
    for fault in faults {
        let mut rig = running(now);
        rig.rig_status(
            &RigStatus {
                fault: Some(fault),
                ..rig_status()
            },
            now,
        );
        let shown = text(&screen(&[rig], LOOK, (80, 24), now));
        assert!(
            squeezed(&shown).contains(&squeezed(&fault.to_string())),
            "{shown}"
        );
    }
    let faults = [
        CapsuleFault::SpoolSlip,
        CapsuleFault::NotUnfolded { wound_um: -12_345 },
        CapsuleFault::EncoderLost,
        CapsuleFault::SlipOrBreak,
        CapsuleFault::BridgeSilent,
        CapsuleFault::SenseLost,
        CapsuleFault::Jam { thread_um: -12_345 },
        CapsuleFault::ThreadBroken,
    ];
    for fault in faults {
        let mut capsule = folding(now);
        capsule.capsule_status(
            &CapsuleStatus {
                fault: Some(fault),
                ..capsule_status()
            },
            now,
        );
        let shown = text(&screen(&[capsule], LOOK, (80, 24), now));
        assert!(
            squeezed(&shown).contains(&squeezed(&fault.to_string())),
            "{shown}"
        );
    }
}

/// Regression: the advice lay over the words on the position, and their end showed behind it.
#[test]
fn a_faulted_machine_has_one_text_beside_its_state() {
    let now = Instant::now();
    let mut rig = running(now);
    let fault = RigStatus {
        state: RigState::Faulted,
        fault: Some(RigFault::EStopFrame),
        homed: false,
        ..rig_status()
    };
    let mut capsule = folding(now);
    let torn = CapsuleStatus {
        state: CapsuleState::Faulted,
        fault: Some(CapsuleFault::ThreadBroken),
        needs_acknowledge: true,
        ..capsule_status()
    };
    rig.rig_status(&fault, now);
    capsule.capsule_status(&torn, now);
    let shown = text(&screen(&[rig, capsule], LOOK, (80, 24), now));
    let states: Vec<_> = shown
        .lines()
        .filter(|line| line.contains("FAULTED"))
        .collect();
    let states: Vec<_> = states.iter().map(|line| squeezed(line)).collect();
    assert_eq!(
        states,
        [
            squeezed("FAULTED not homed; acknowledge with `retrograde ack`"),
            squeezed("FAULTED acknowledge with `retrograde ack` battery 3.702 V"),
        ]
    );
}

/// Regression: the keys ended in "...", though nothing of them was left out.
#[test]
fn a_terminal_that_is_too_small_shows_the_keys_whole() {
    let now = Instant::now();
    let shown = |size| text(&screen(&[running(now)], LOOK, size, now));
    let keys = "h hold r resume s STOP e EMERGENCY STOP q leave";
    for width in [47, 49, 60] {
        let shown = shown((width, 20));
        assert!(shown.lines().any(|row| row == keys), "{width}: {shown}");
    }
    // Less than the text needs: its last row says that there is more.
    let shown = shown((20, 2));
    assert!(shown.ends_with("..."), "{shown}");
}

/// The text without line breaks and frames.
fn squeezed(text: &str) -> String {
    text.chars()
        .filter(|c| !c.is_whitespace() && *c != '│')
        .collect()
}

#[test]
fn without_colours_and_in_ascii() {
    let now = Instant::now();
    let panels = faulted(now);
    let look = Look {
        colours: false,
        unicode: false,
    };
    let terminal = screen(&panels, look, (80, 24), now);
    assert!(text(&terminal).is_ascii(), "{}", text(&terminal));
    let colours = |terminal: &Terminal<TestBackend>| {
        let cells = &terminal.backend().buffer().content;
        cells.iter().filter(|cell| cell.fg != Color::Reset).count()
    };
    assert_eq!(colours(&terminal), 0);
    assert!(colours(&screen(&panels, LOOK, (80, 24), now)) > 0);
}

#[test]
fn no_size_and_no_number_breaks_the_screen() {
    let now = Instant::now();
    let mut rig = running(now);
    for (position_um, stroke_um) in [(i32::MIN, 1), (i32::MAX, 0), (-5, u32::MAX), (0, 0)] {
        let status = RigStatus {
            position_um,
            stroke_um,
            ..rig_status()
        };
        rig.rig_status(&status, now);
        for size in [
            (1, 1),
            (3, 30),
            (79, 24),
            (80, 23),
            (80, 24),
            (81, 25),
            (500, 200),
        ] {
            let shown = text(&screen(&[rig.clone(), folding(now)], LOOK, size, now));
            if size.0 < 80 || size.1 < 24 {
                assert!(!shown.contains('┌'), "{shown}");
            }
        }
    }
}
