//! Control as the board runs it: readings and questions in; drive, replies and events out.

use capsule_plant::Parameters;
use device::{
    common::Surroundings,
    last_words::LastWords,
    retained::{EStop, Retained},
    service::{Answers, Inbound},
    settings::SettingsStore,
};
use firmware_capsule::control;
use firmware_capsule::control::Control;
use firmware_capsule::fold::Drive;
use firmware_capsule::kept::{Kept, TOTALS, Totals};
use firmware_capsule::mechanics::Counts;
use firmware_capsule::sample::Sample;
use protocol::{
    capsule::{
        ActuationKind, ActuationOutcome, Calibrate, CapsuleEvent, CapsuleFault, CapsuleState,
        CapsuleTelemetry, CapsuleTotals, Fold, GetActuationRecord, GetCapsuleStatus,
        GetCapsuleTotals, GetTrace, KEPT_TRACE_POINTS, Reference,
    },
    error::Refusal,
    rig,
    settings::{GetSetting, Setting, SettingKey, SettingRule},
    system::{
        self, Acknowledge, Done, GetEvents, GetLastWords, ResetCause, SetTelemetry, Urgent, What,
    },
    table::{Reply, Request, Response},
};
use simulated_machines::chip::Flash;
use simulated_machines::plant::{self, board::PERIODS_PER_MS};

/// A motor without a load, and a record of everything that control says.
#[derive(Default)]
struct Board {
    now_us: u64,
    /// A flash whose operations take 0.4 s each.
    slow: Option<Flash>,
    silence_us: u32,
    drives: Vec<Drive>,
    shown: Option<CapsuleTelemetry>,
    told: Vec<system::Event>,
    telemetry_ms: Vec<u16>,
    latched: Vec<Option<EStop>>,
}

/// A healthy chip.
pub const CHIP: system::Chip = system::Chip {
    clock: system::Clock::External,
    brown_out: system::BrownOut::Off,
    supply_low: false,
    option_bytes: 0x00FF_AAED,
};

impl control::Capsule for Board {
    fn drive(&mut self, drive: Drive) {
        self.drives.push(drive);
    }

    fn show(&mut self, telemetry: CapsuleTelemetry) {
        self.shown = Some(telemetry);
    }
}

impl Surroundings for Board {
    fn now_us(&self) -> u64 {
        let operations = self.slow.as_ref().map(|flash| flash.operations().len());
        self.now_us + operations.unwrap_or(0) as u64 * 400_000
    }

    fn chip(&self) -> system::Chip {
        CHIP
    }

    fn silence_us(&self) -> u32 {
        self.silence_us
    }

    fn set_telemetry(&mut self, period_ms: u16) {
        self.telemetry_ms.push(period_ms);
    }

    fn keep_latched(&mut self, estop: Option<EStop>) {
        self.latched.push(estop);
    }

    fn tell(&mut self, event: &system::Event) {
        self.told.push(*event);
    }
}

const FRESH: Retained = Retained {
    boot_id: 1,
    last_words: None,
    latched: None,
    clock_failed: false,
    cause: None,
};

struct Device {
    control: Control<Board, Flash>,
    flash: Flash,
    counts: i32,
    /// Back-EMF times 1 ms left over from the last whole count, mV.
    turned_mv: i32,
}

impl Device {
    fn start(left: Retained, cause: ResetCause) -> Self {
        Self::start_on(Flash::blank(), left, cause)
    }

    fn start_on(flash: Flash, left: Retained, cause: ResetCause) -> Self {
        let board = Board {
            now_us: 1_000,
            ..Board::default()
        };
        Self {
            control: Control::new(board, flash.clone(), left, cause),
            flash,
            counts: 0,
            turned_mv: 0,
        }
    }

    /// A started capsule with a reading of a full battery, its events so far dropped.
    fn ready() -> Self {
        let mut device = Self::start(FRESH, ResetCause::PowerOn);
        device.read();
        device.told();
        device
    }

    fn board(&mut self) -> &mut Board {
        self.control.capsule()
    }

    /// A millisecond later: the motor has turned if it is driven.
    fn read(&mut self) {
        self.board().now_us += 1_000;
        if let Some(Drive::Millivolts(millivolts)) = self.board().drives.last().copied() {
            // Speed from voltage and current: 16 mA in 6 ohm, 0.207 mV for each count/s.
            self.turned_mv += (i32::from(millivolts).abs() - 96).max(0);
            self.counts += i32::from(millivolts.signum()) * (self.turned_mv / 207);
            self.turned_mv %= 207;
        }
        let sample = Sample {
            counts: Counts(self.counts),
            current_ua: 16_000,
            offset_ma: 0,
            battery_mv: 3_900,
            driver_fault: false,
        };
        let at_us = self.board().now_us();
        self.control.read(at_us, sample);
    }

    fn ask(&mut self, request: Request) -> Reply {
        self.control.answer(Inbound::Request(request))
    }

    fn accepted(&mut self, request: Request) -> Response {
        match self.ask(request) {
            Reply::Accepted(response) => response,
            other => panic!("{other:?}"),
        }
    }

    fn state(&mut self) -> (CapsuleState, Option<CapsuleFault>) {
        match self.accepted(Request::GetCapsuleStatus(GetCapsuleStatus)) {
            Response::GetCapsuleStatus(status) => (status.state, status.fault),
            other => panic!("{other:?}"),
        }
    }

    /// Referencing, with the motor driven.
    fn referencing() -> Self {
        let mut device = Self::ready();
        device.accepted(Request::Reference(Reference));
        for _ in 0..50 {
            device.read();
        }
        assert_eq!(device.state().0, CapsuleState::Referencing);
        assert!(matches!(device.drive(), Drive::Millivolts(1..)));
        device.told();
        device
    }

    fn drive(&mut self) -> Drive {
        *self.board().drives.last().expect("control has driven")
    }

    fn told(&mut self) -> Vec<What> {
        let told = std::mem::take(&mut self.board().told);
        told.into_iter().map(|event| event.what).collect()
    }
}

fn ended(outcome: ActuationOutcome) -> What {
    What::Capsule(CapsuleEvent::Ended {
        actuation: 1,
        outcome,
    })
}

#[test]
fn a_start_latches_what_the_last_one_left() {
    let frame = Some(EStop::Frame);
    for (cause, latched, fault) in [
        (ResetCause::PowerOn, None, None),
        (ResetCause::Pin, None, None),
        (ResetCause::Pin, frame, Some(CapsuleFault::EStopFrame)),
        (ResetCause::Software, frame, Some(CapsuleFault::EStopFrame)),
        (ResetCause::Watchdog, None, Some(CapsuleFault::Watchdog)),
        (ResetCause::Watchdog, frame, Some(CapsuleFault::Watchdog)),
        (ResetCause::Panic, None, Some(CapsuleFault::Panic)),
        (ResetCause::Panic, frame, Some(CapsuleFault::Panic)),
    ] {
        let left = Retained { latched, ..FRESH };
        let mut device = Device::start(left, cause);
        assert_eq!(device.told(), [What::Booted(cause)]);
        assert_eq!(device.state().1, fault, "{cause:?} {latched:?}");
        assert!(device.board().latched.is_empty(), "nothing is forgotten");
    }
}

#[test]
fn last_words_are_told_on_request() {
    for text in ["", "panic, called from 0x8010100"] {
        let last_words = (!text.is_empty()).then(|| LastWords::try_from(text).unwrap());
        let left = Retained {
            last_words,
            ..FRESH
        };
        let mut device = Device::start(left, ResetCause::Pin);
        let text = text.try_into().unwrap();
        assert_eq!(
            device.accepted(Request::GetLastWords(GetLastWords)),
            Response::GetLastWords(system::LastWords { text })
        );
    }
}

#[test]
fn every_reading_confirms_the_drive_and_is_shown() {
    let mut device = Device::ready();
    assert_eq!(device.drive(), Drive::Off);
    device.accepted(Request::Reference(Reference));
    let started = CapsuleEvent::Started {
        actuation: 1,
        kind: ActuationKind::Reference,
    };
    assert_eq!(device.told(), [What::Capsule(started)]);
    assert!(matches!(device.drive(), Drive::Millivolts(1..)));
    let before = device.board().drives.len();
    for _ in 0..10 {
        device.read();
    }
    assert_eq!(device.board().drives.len(), before + 10);
    let (now_us, Drive::Millivolts(drive_mv)) = (device.board().now_us, device.drive()) else {
        panic!("still driven");
    };
    let shown = device.board().shown.expect("a sample");
    assert_eq!(
        (shown.time_us, shown.state, shown.battery_mv, shown.drive_mv),
        (now_us, CapsuleState::Referencing, 3_900, drive_mv)
    );
}

#[test]
fn a_silent_host_stops_the_motor_after_a_second() {
    let mut device = Device::referencing();
    device.board().silence_us = 1_000_000;
    device.read();
    assert_eq!(
        (device.told(), device.state().0),
        (vec![], CapsuleState::Referencing)
    );
    device.board().silence_us = 1_000_001;
    device.read();
    assert_eq!(
        device.told(),
        [What::LinkLost, ended(ActuationOutcome::LinkLost)]
    );
    assert_eq!(device.drive(), Drive::Brake);
    assert_eq!(device.state().0, CapsuleState::Unreferenced);
    // At rest the host may be silent.
    for _ in 0..100 {
        device.read();
    }
    assert_eq!((device.told(), device.drive()), (vec![], Drive::Off));
}

#[test]
fn a_stop_ends_the_motion_and_nothing_is_latched() {
    let mut device = Device::referencing();
    let reply = device.control.answer(Inbound::Urgent(Urgent::Stop));
    assert_eq!(reply, Reply::Urgent(Urgent::Stop));
    assert_eq!(device.told(), [ended(ActuationOutcome::Stopped)]);
    assert_eq!(device.drive(), Drive::Brake);
    assert_eq!(device.state(), (CapsuleState::Unreferenced, None));
    assert!(device.board().latched.is_empty());
}

#[test]
fn an_estop_is_kept_over_a_reset_until_it_is_acknowledged() {
    let mut device = Device::referencing();
    let fault = CapsuleFault::EStopFrame;
    let reply = device.control.answer(Inbound::Urgent(Urgent::EStop));
    assert_eq!(reply, Reply::Urgent(Urgent::EStop));
    assert_eq!(
        device.told(),
        [
            ended(ActuationOutcome::Faulted(fault)),
            What::Capsule(CapsuleEvent::Faulted(fault))
        ]
    );
    assert_eq!(device.board().latched, [Some(EStop::Frame)]);
    assert_eq!(
        device.ask(Request::Fold(Fold)),
        Reply::Refused(Refusal::CapsuleFaulted(fault))
    );
    assert_eq!(device.board().latched, [Some(EStop::Frame)]);
    let done = Response::Acknowledge(Done);
    assert_eq!(device.accepted(Request::Acknowledge(Acknowledge)), done);
    assert_eq!(device.board().latched, [Some(EStop::Frame), None]);
    assert_eq!(device.told(), [What::Acknowledged]);
    assert_eq!(device.state(), (CapsuleState::Unreferenced, None));
}

/// The crash keeps its name as the fault, but only an acknowledgement undoes the stop.
#[test]
fn an_estop_after_a_crash_is_kept_over_a_reset() {
    for cause in [ResetCause::Watchdog, ResetCause::Panic] {
        let mut device = Device::start(FRESH, cause);
        device.read();
        let fault = device.state().1;
        device.control.answer(Inbound::Urgent(Urgent::EStop));
        assert_eq!(device.state().1, fault);
        let latched = device.board().latched.last().copied().flatten();
        let left = Retained { latched, ..FRESH };
        let mut device = Device::start(left, ResetCause::Pin);
        assert_eq!(device.state().1, Some(CapsuleFault::EStopFrame));
        device.accepted(Request::Acknowledge(Acknowledge));
        assert_eq!(device.board().latched, [None]);
    }
}

#[test]
fn other_faults_are_not_kept_over_a_reset() {
    let mut device = Device::referencing();
    // The encoder does not count although the motor is driven.
    let counts = device.counts;
    for _ in 0..200 {
        device.counts = counts;
        device.board().drives.push(Drive::Off);
        device.read();
    }
    let (state, fault) = device.state();
    assert_eq!(state, CapsuleState::Faulted);
    assert_ne!(fault, Some(CapsuleFault::EStopFrame));
    assert_eq!(device.board().latched, [None]);
}

#[test]
fn the_host_sets_the_interval_of_telemetry() {
    let mut device = Device::ready();
    for period_ms in [10, 0] {
        let set = SetTelemetry { period_ms };
        let response = device.accepted(Request::SetTelemetry(set));
        assert_eq!(response, Response::SetTelemetry(set));
    }
    // The first interval comes from the setting, at the start.
    assert_eq!(device.board().telemetry_ms, [0, 10, 0]);
    let refused = device.ask(Request::SetTelemetry(SetTelemetry { period_ms: 4 }));
    assert!(matches!(
        refused,
        Reply::Refused(Refusal::OutOfRange { .. })
    ));
    assert_eq!(device.board().telemetry_ms, [0, 10, 0]);
}

#[test]
fn events_are_numbered_timed_and_told_again() {
    let mut device = Device::referencing();
    device.control.answer(Inbound::Urgent(Urgent::Stop));
    let stopped_us = device.board().now_us;
    match device.accepted(Request::GetEvents(GetEvents { from: 0 })) {
        Response::GetEvents(events) => {
            assert_eq!((events.oldest, events.next), (0, 3));
            assert_eq!(events.events[0].what, What::Booted(ResetCause::PowerOn));
            assert_eq!(events.events[0].time_us, 1_000);
            assert_eq!(events.events[2].what, ended(ActuationOutcome::Stopped));
            assert_eq!(events.events[2].time_us, stopped_us);
        }
        other => panic!("{other:?}"),
    }
}

/// A second at rest, at the board's pace.
fn rest(device: &mut Device) {
    for _ in 0..10 {
        device.board().now_us += 99_000;
        device.read();
    }
}

fn totals(device: &mut Device) -> CapsuleTotals {
    match device.accepted(Request::GetCapsuleTotals(GetCapsuleTotals)) {
        Response::GetCapsuleTotals(totals) => totals,
        other => panic!("{other:?}"),
    }
}

#[test]
fn motions_are_counted_in_flash_once_the_motor_stands() {
    let mut device = Device::referencing();
    device.control.answer(Inbound::Urgent(Urgent::Stop));
    for _ in 0..60 {
        device.read();
    }
    // The bridge sleeps, but a motor without a brake would still turn.
    for counts in [1, 5] {
        for _ in 0..600 {
            device.counts += counts;
            device.read();
        }
    }
    assert_eq!(device.flash.operations(), []);
    rest(&mut device);
    assert!(!device.flash.operations().is_empty());
    let written = totals(&mut device);
    assert_eq!(written.actuations, 1);
    assert!(written.energy_mj > 0, "{written:?}");
    let operations = device.flash.operations().len();
    rest(&mut device);
    assert_eq!(device.flash.operations().len(), operations, "once");
    let mut later = Device::start_on(device.flash.clone(), FRESH, ResetCause::PowerOn);
    assert_eq!(totals(&mut later), written);
}

/// 40 ms of brake, then half a second in which a motor without a brake would run out.
#[test]
fn the_flash_is_written_half_a_second_after_the_bridge_fell_asleep() {
    let mut device = Device::referencing();
    device.control.answer(Inbound::Urgent(Urgent::Stop));
    let written_ms = (1..1_000).find(|_| {
        device.read();
        !device.flash.operations().is_empty()
    });
    assert_eq!(written_ms, Some(539));
}

#[test]
fn totals_that_flash_does_not_take_are_told() {
    let mut device = Device::referencing();
    device.flash.fail(0..2);
    device.control.answer(Inbound::Urgent(Urgent::Stop));
    for _ in 0..600 {
        device.read();
    }
    let not_kept = What::Capsule(CapsuleEvent::NotKept);
    assert_eq!(device.told(), [ended(ActuationOutcome::Stopped), not_kept]);
}

/// A cell that is too low for the flash may recover. Else a capsule that has unfolded would be "folded" after its next start.
#[test]
fn what_flash_did_not_take_is_tried_again_and_told_once() {
    let mut device = Device::referencing();
    device.flash.fail(0..3);
    device.control.answer(Inbound::Urgent(Urgent::Stop));
    for _ in 0..45_000 {
        device.read();
    }
    let not_kept = What::Capsule(CapsuleEvent::NotKept);
    assert_eq!(device.told(), [ended(ActuationOutcome::Stopped), not_kept]);
    let tried = device.flash.operations().len();
    assert!(tried > 0, "it has recovered");
    let mut later = Device::start_on(device.flash.clone(), FRESH, ResetCause::PowerOn);
    assert_eq!(totals(&mut later).actuations, 1);
}

/// A refused write is repeated 10 s later, not one reading before or after.
#[test]
fn what_flash_did_not_take_is_tried_again_after_ten_seconds() {
    let mut device = Device::referencing();
    device.flash.fail(0..1);
    device.control.answer(Inbound::Urgent(Urgent::Stop));
    let not_kept = What::Capsule(CapsuleEvent::NotKept);
    while !device.told().contains(&not_kept) {
        device.read();
    }
    let failed_us = device.board().now_us;
    assert!(device.flash.operations().is_empty());
    while device.flash.operations().is_empty() {
        device.read();
    }
    assert_eq!(device.board().now_us - failed_us, 10_000_000);
}

/// A reading of a capsule of the model, a millisecond later.
fn read_from(model: &mut plant::board::Board, device: &mut Device) {
    read_with_offset(0, model, device);
}

/// The same, with a zero of the amplifier that is so much higher.
fn read_with_offset(wrong_ma: i16, model: &mut plant::board::Board, device: &mut Device) {
    let drive = device.board().drives.last().copied().unwrap_or_default();
    device.board().now_us += 1_000;
    let now_us = device.board().now_us;
    model.run(drive, PERIODS_PER_MS);
    let mut sample = model.sample(now_us, drive != Drive::Off);
    sample.offset_ma += wrong_ma;
    device.control.read(now_us, sample);
}

/// Calibrates a capsule of the model on this flash, and rests; the events.
fn calibrated_on(flash: &Flash) -> Vec<What> {
    let mut device = Device::start_on(flash.clone(), FRESH, ResetCause::PowerOn);
    let mut model = plant::Simulation::nominal().board;
    read_from(&mut model, &mut device);
    device.accepted(Request::Calibrate(Calibrate));
    while device.state().0 == CapsuleState::Referencing {
        read_from(&mut model, &mut device);
    }
    assert_eq!(device.state(), (CapsuleState::Unfolded, None));
    for _ in 0..700 {
        read_from(&mut model, &mut device);
    }
    assert!(totals(&mut device).calibration.is_some());
    device.told()
}

/// It is pressed before the end of the fold is in flash.
#[test]
fn an_emergency_stop_just_after_a_fold_does_not_unfold_it() {
    let flash = Flash::blank();
    calibrated_on(&flash);
    let mut device = Device::start_on(flash.clone(), FRESH, ResetCause::PowerOn);
    let mut model = plant::Simulation::nominal().board;
    let rest = |model: &mut plant::board::Board, device: &mut Device, ms: u32| {
        (0..ms).for_each(|_| read_from(model, device));
    };
    rest(&mut model, &mut device, 1);
    device.accepted(Request::Reference(Reference));
    while device.state().0 == CapsuleState::Referencing {
        read_from(&mut model, &mut device);
    }
    rest(&mut model, &mut device, 700);
    device.accepted(Request::Fold(Fold));
    while device.state().0 == CapsuleState::Folding {
        read_from(&mut model, &mut device);
    }
    assert_eq!(device.state(), (CapsuleState::Folded, None));
    rest(&mut model, &mut device, 300);
    device.control.answer(Inbound::Urgent(Urgent::EStop));
    rest(&mut model, &mut device, 700);
    device.accepted(Request::Acknowledge(Acknowledge));
    assert_eq!(device.state().0, CapsuleState::WasFolded);
    let bytes = Flash::holding(flash.bytes());
    let mut later = Device::start_on(bytes, FRESH, ResetCause::PowerOn);
    assert_eq!(later.state().0, CapsuleState::WasFolded);
}

/// The totals show a calibration from where it is in force; the next start has to find that one.
#[test]
fn a_calibration_that_is_stopped_once_it_is_in_force_is_in_flash() {
    let flash = Flash::blank();
    calibrated_on(&flash);
    let shorter = Parameters {
        slack_mm: 0.5,
        ..Parameters::nominal()
    };
    // None: the host falls silent.
    for urgent in [Some(Urgent::Stop), Some(Urgent::EStop), None] {
        let flash = Flash::holding(flash.bytes());
        let mut device = Device::start_on(flash, FRESH, ResetCause::PowerOn);
        let mut model = plant::Simulation::new(shorter, 0).board;
        read_from(&mut model, &mut device);
        let before = totals(&mut device).calibration;
        device.accepted(Request::Calibrate(Calibrate));
        while totals(&mut device).calibration == before {
            read_from(&mut model, &mut device);
        }
        assert_eq!(device.state().0, CapsuleState::Referencing);
        match urgent {
            Some(urgent) => {
                device.control.answer(Inbound::Urgent(urgent));
            }
            None => device.board().silence_us = 1_000_001,
        }
        for _ in 0..700 {
            read_from(&mut model, &mut device);
        }
        let in_force = totals(&mut device).calibration;
        let flash = Flash::holding(device.flash.bytes());
        let mut later = Device::start_on(flash, FRESH, ResetCause::PowerOn);
        assert_eq!(totals(&mut later).calibration, in_force, "{urgent:?}");
    }
}

/// A fold that follows at once would be judged, after a power cut in it, by the calibration before.
#[test]
fn a_calibration_is_in_flash_before_the_next_motion_begins() {
    let flash = Flash::blank();
    let mut device = Device::start_on(flash.clone(), FRESH, ResetCause::PowerOn);
    let mut model = plant::Simulation::nominal().board;
    read_from(&mut model, &mut device);
    device.accepted(Request::Calibrate(Calibrate));
    while device.state().0 == CapsuleState::Referencing {
        read_from(&mut model, &mut device);
    }
    assert_eq!(flash.operations(), []);
    let in_force = totals(&mut device).calibration;
    assert!(in_force.is_some());
    device.accepted(Request::Fold(Fold));
    let flash = Flash::holding(flash.bytes());
    let mut later = Device::start_on(flash, FRESH, ResetCause::PowerOn);
    assert_eq!(totals(&mut later).calibration, in_force);
}

/// The currents that judged the fold were wrong; nor does a reset make them right.
#[test]
fn a_fold_that_a_fault_at_rest_has_withdrawn_is_not_believed_after_a_reset() {
    let flash = Flash::blank();
    calibrated_on(&flash);
    let mut device = Device::start_on(flash.clone(), FRESH, ResetCause::PowerOn);
    let mut model = plant::Simulation::nominal().board;
    read_from(&mut model, &mut device);
    for (order, moving) in [
        (Request::Reference(Reference), CapsuleState::Referencing),
        (Request::Fold(Fold), CapsuleState::Folding),
    ] {
        device.accepted(order);
        while device.state().0 == moving {
            read_from(&mut model, &mut device);
        }
    }
    let state_after_a_reset = || {
        let flash = Flash::holding(flash.bytes());
        Device::start_on(flash, FRESH, ResetCause::PowerOn).state()
    };
    for (wrong_ma, state, after) in [
        (0, CapsuleState::Folded, CapsuleState::WasFolded),
        (15, CapsuleState::Faulted, CapsuleState::Unreferenced),
    ] {
        for _ in 0..700 {
            read_with_offset(wrong_ma, &mut model, &mut device);
        }
        assert_eq!(device.state().0, state);
        assert_eq!(state_after_a_reset(), (after, None), "{wrong_ma} mA");
    }
}

/// The host has to know that the next start will not find the calibration.
#[test]
fn a_calibration_that_flash_does_not_take_is_told() {
    for (failing, kept) in [(0..0, true), (0..1, false)] {
        let flash = Flash::blank();
        flash.fail(failing);
        let told = calibrated_on(&flash);
        let not_kept = told.contains(&What::Capsule(CapsuleEvent::NotKept));
        assert_eq!(not_kept, !kept, "{told:?}");
        let flash = Flash::holding(flash.bytes());
        let mut later = Device::start_on(flash, FRESH, ResetCause::PowerOn);
        assert_eq!(totals(&mut later).calibration.is_some(), kept);
    }
}

/// The flash of a capsule that was folded when its power failed.
fn folded_before() -> Flash {
    let flash = Flash::blank();
    let mut store = SettingsStore::<_, Kept>::load_with(flash.clone(), |_| true).0;
    let kept = Kept {
        calibration: None,
        totals: Totals {
            folded: Some(firmware_capsule::mechanics::Thread(0)),
            ..Totals::default()
        },
    };
    store.keep(TOTALS, kept).expect("kept");
    flash
}

/// An erasure is part of what is written at times. No host is heard meanwhile, and the motor stands.
#[test]
fn a_motion_begins_behind_what_is_written_before_it() {
    let flash = folded_before();
    let mut device = Device::start_on(flash.clone(), FRESH, ResetCause::PowerOn);
    device.board().slow = Some(flash);
    device.read();
    let ordered_us = device.board().now_us();
    device.accepted(Request::Reference(Reference));
    let waited_us = device.board().now_us() - ordered_us;
    assert!(waited_us > 1_000_000, "{waited_us}");
    device.told();
    // The order was its last sign of life.
    device.board().silence_us = u32::try_from(waited_us).unwrap();
    for _ in 0..29 {
        device.board().silence_us += 1_000;
        device.read();
    }
    assert_eq!(device.told(), []);
    let Response::GetActuationRecord(record) =
        device.accepted(Request::GetActuationRecord(GetActuationRecord))
    else {
        panic!("no record");
    };
    assert_eq!(record.duration_ms, 29);
    // The current of a motor that starts is no force.
    assert_eq!(record.peak_current_ma, 0);
    // The same host, silent for a second.
    for _ in 0..971 {
        device.board().silence_us += 1_000;
        device.read();
    }
    assert_eq!(device.told(), []);
    device.read();
    assert_eq!(device.told()[0], What::LinkLost);
}

/// A power cut during a motion must not leave a capsule that takes itself for folded.
#[test]
fn a_capsule_that_leaves_its_folded_end_forgets_it_before_it_turns() {
    let flash = folded_before();
    let state_after = |flash: &Flash| {
        let flash = Flash::holding(flash.bytes());
        Device::start_on(flash, FRESH, ResetCause::PowerOn)
            .state()
            .0
    };
    assert_eq!(state_after(&flash), CapsuleState::WasFolded);
    let mut device = Device::start_on(flash.clone(), FRESH, ResetCause::PowerOn);
    device.read();
    let refused = device.ask(Request::Fold(Fold));
    assert!(matches!(refused, Reply::Refused(_)), "{refused:?}");
    assert_eq!(
        state_after(&flash),
        CapsuleState::WasFolded,
        "nothing moved"
    );
    device.accepted(Request::Calibrate(Calibrate));
    assert_eq!(state_after(&flash), CapsuleState::Unreferenced);
    let operations = flash.operations().len();
    device.control.answer(Inbound::Urgent(Urgent::Stop));
    device.accepted(Request::Calibrate(Calibrate));
    assert_eq!(flash.operations().len(), operations, "once");
}

#[test]
fn a_flash_without_a_log_is_taken_into_use() {
    let noise = vec![0x5A; device::store::SECTORS.end as usize];
    let flash = Flash::holding(noise);
    let mut device = Device::start_on(flash, FRESH, ResetCause::PowerOn);
    device.read();
    assert_eq!(totals(&mut device).calibration, None);
    device.accepted(Request::Reference(Reference));
    for _ in 0..50 {
        device.read();
    }
    device.control.answer(Inbound::Urgent(Urgent::Stop));
    for _ in 0..60 {
        device.read();
    }
    rest(&mut device);
    let told = device.told();
    assert!(
        !told.contains(&What::Capsule(CapsuleEvent::NotKept)),
        "{told:?}"
    );
    let mut later = Device::start_on(device.flash.clone(), FRESH, ResetCause::PowerOn);
    assert_eq!(totals(&mut later).actuations, 1);
}

#[test]
fn a_motion_is_recorded_reading_by_reading() {
    let mut device = Device::referencing();
    let mut points = Vec::new();
    loop {
        let from = points.len() as u32;
        let trace = match device.accepted(Request::GetTrace(GetTrace { from })) {
            Response::GetTrace(trace) => trace,
            other => panic!("{other:?}"),
        };
        assert_eq!((trace.actuation, trace.total), (1, 50));
        if trace.points.is_empty() {
            break;
        }
        points.extend(trace.points);
    }
    assert_eq!(points.len(), 50);
    let last = points.last().expect("50");
    assert_eq!((last.current_ma, last.battery_mv), (16, 3_900));
    assert!(last.drive_mv > 0 && last.thread_um > 200, "{last:?}");
    assert!(points.is_sorted_by_key(|point| point.thread_um));
    // The brake after a motion belongs to it.
    let mut stopped = Device::referencing();
    stopped.control.answer(Inbound::Urgent(Urgent::Stop));
    for _ in 0..60 {
        stopped.read();
    }
    match stopped.accepted(Request::GetTrace(GetTrace { from: 0 })) {
        Response::GetTrace(trace) => assert_eq!(trace.total, 50 + 40),
        other => panic!("{other:?}"),
    }
    // The trace keeps the end of a long motion.
    for _ in 0..KEPT_TRACE_POINTS + 500 {
        device.read();
    }
    match device.accepted(Request::GetTrace(GetTrace { from: 0 })) {
        Response::GetTrace(trace) => assert_eq!(usize::from(trace.total), KEPT_TRACE_POINTS),
        other => panic!("{other:?}"),
    }
}

#[test]
fn what_is_the_rigs_is_refused() {
    let mut device = Device::ready();
    let before = device.board().drives.len();
    assert_eq!(
        device.ask(Request::Home(rig::Home)),
        Reply::Refused(Refusal::WrongDevice)
    );
    assert_eq!(device.board().drives.len(), before, "nothing was ordered");
}

fn set(key: SettingKey, value: u32) -> Request {
    Request::SetSetting(Setting { key, value })
}

/// No reading has shown yet that the motor was driven.
#[test]
fn nothing_is_written_right_after_a_motion_that_was_stopped_at_once() {
    let mut device = Device::ready();
    rest(&mut device);
    device.accepted(Request::Calibrate(Calibrate));
    device.control.answer(Inbound::Urgent(Urgent::Stop));
    assert_eq!(device.drive(), Drive::Brake);
    let refused = device.ask(set(SettingKey::EndForceMa, 120));
    assert!(matches!(refused, Reply::Refused(Refusal::CapsuleBusy(_))));
    assert_eq!(device.flash.operations(), []);
}

/// A setting is in force only once it is in flash, and nothing is written while the motor may turn. An encoder line at
/// rest on its edge once blocked all writes for ever.
#[test]
fn a_count_that_flickers_is_no_motion() {
    let mut device = Device::ready();
    for round in 0..1_000 {
        device.counts += if round % 2 == 0 { 2 } else { -2 };
        device.read();
    }
    let (key, value) = (SettingKey::EndForceMa, 120);
    let set_to = Response::SetSetting(Setting { key, value });
    assert_eq!(device.accepted(set(key, value)), set_to);
    // A motor that keeps turning is in motion.
    for _ in 0..1_000 {
        device.counts += 1;
        device.read();
    }
    let refused = device.ask(set(key, 121));
    assert!(matches!(refused, Reply::Refused(Refusal::CapsuleBusy(_))));
}

#[test]
fn settings_are_kept_at_rest_and_refused_in_motion() {
    let mut device = Device::ready();
    let (key, value) = (SettingKey::EndForceMa, 120);
    for _ in 0..1_000 {
        device.read();
    }
    let set_to = Response::SetSetting(Setting { key, value });
    assert_eq!(device.accepted(set(key, value)), set_to);
    let get = Request::GetSetting(GetSetting { key });
    let got = Response::GetSetting(Setting { key, value });
    assert_eq!(device.accepted(get), got);
    let too_much = device.ask(set(key, 161));
    let range = Refusal::SettingRange {
        key,
        requested: 161,
    };
    assert_eq!(too_much, Reply::Refused(range));
    let (key, rule) = (SettingKey::LoadedBatteryMv, SettingRule::LoadedBelowRest);
    let broken = Reply::Refused(Refusal::SettingRule { key, rule });
    assert_eq!(device.ask(set(key, 2_900)), broken);
    let rigs = device.ask(set(SettingKey::StrokeUm, 1_000));
    assert_eq!(rigs, Reply::Refused(Refusal::WrongDevice));
    device.accepted(Request::Calibrate(Calibrate));
    device.read();
    let moving = device.ask(set(SettingKey::EndForceMa, 130));
    assert!(matches!(
        moving,
        Reply::Refused(Refusal::CapsuleBusy(CapsuleState::Referencing))
    ));
}

/// Values within their ranges that break a rule together. What is set then is in force at the next start, too, and the
/// old values of other settings do not come back.
#[test]
fn a_setting_after_a_conflict_is_in_force_at_the_next_start() {
    let flash = Flash::blank();
    let (mut store, _) = SettingsStore::<_, Kept>::load_with(flash.clone(), |_| true);
    store.set(SettingKey::LoadedBatteryMv, 3_400).unwrap();
    store.set(SettingKey::EndForceMa, 120).unwrap();
    let mut device = Device::start_on(flash.clone(), FRESH, ResetCause::PowerOn);
    let unusable = What::Capsule(CapsuleEvent::SettingsUnusable);
    assert!(device.told().contains(&unusable));
    rest(&mut device);
    device.accepted(set(SettingKey::LinkTimeoutMs, 3_000));
    let mut later = Device::start_on(flash, FRESH, ResetCause::PowerOn);
    assert_eq!(later.told(), [What::Booted(ResetCause::PowerOn)]);
    for (key, value) in [
        (SettingKey::LinkTimeoutMs, 3_000),
        (SettingKey::LoadedBatteryMv, 2_700),
        (SettingKey::EndForceMa, 132),
    ] {
        let get = Request::GetSetting(GetSetting { key });
        let got = Response::GetSetting(Setting { key, value });
        assert_eq!(later.accepted(get), got);
    }
}
