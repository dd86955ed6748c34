//! Control as the board runs it: readings and questions in; drive, replies and events out.

use device::{
    common::Surroundings,
    last_words::LastWords,
    retained::{EStop, Retained},
    service::{Answers, Inbound},
    settings::SettingsStore,
};
use firmware_capsule::control;
use firmware_capsule::control::Control;
use firmware_capsule::control::flash::{KNOWN, Kept};
use firmware_capsule::known::Known;
use firmware_capsule::sense::{Counts, Sample};
use firmware_capsule::speed::Drive;
use protocol::{
    capsule::{
        ActuationKind, ActuationOutcome, Calibrate, CapsuleEvent, CapsuleFault, CapsuleState,
        CapsuleTelemetry, CapsuleTotals, Fold, GetActuationRecord, GetCapsuleStatus,
        GetCapsuleTotals, GetTrace, KEPT_TRACE_POINTS, Reference, Unfold,
    },
    error::Refusal,
    rig,
    settings::{GetSetting, Setting, SettingKey, SettingRule},
    system::{
        self, Acknowledge, Done, GetEvents, GetLastWords, ResetCause, SetTelemetry, Urgent, What,
    },
    table::{Reply, Request, Response},
};
use simulated_machines::chip::{Flash, Operation};
use simulated_machines::plant::{self, board::PERIODS_PER_MS};

/// A motor without a load, and a record of everything that control says.
#[derive(Default)]
struct Board {
    now_us: u64,
    /// A flash whose operations take 0.4 s each.
    slow: Option<Flash>,
    silence_us: u32,
    supply_low: bool,
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
        system::Chip {
            supply_low: self.supply_low,
            ..CHIP
        }
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

    fn send_event(&mut self, event: &system::Event) {
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
    // The bridge wakes up, and the drive follows from the next reading.
    assert_eq!(device.drive(), Drive::Brake);
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
    for _ in 0..1_000 {
        device.read();
    }
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
    let operations = device.flash.operations().len();
    // The bridge sleeps, but a motor without a brake would still turn.
    for counts in [1, 5] {
        for _ in 0..600 {
            device.counts += counts;
            device.read();
        }
    }
    assert_eq!(device.flash.operations().len(), operations);
    rest(&mut device);
    let written = totals(&mut device);
    assert_eq!(written.actuations, 1);
    assert!(written.energy_mj > 0, "{written:?}");
    let operations = device.flash.operations().len();
    rest(&mut device);
    assert_eq!(device.flash.operations().len(), operations, "once");
    let mut later = Device::start_on(device.flash.clone(), FRESH, ResetCause::PowerOn);
    assert_eq!(totals(&mut later), written);
}

/// A cell that is too low for the flash may recover. It is tried again 10 s later, and told once.
#[test]
fn what_flash_did_not_take_is_tried_again_and_told_once() {
    let mut device = Device::referencing();
    device.flash.fail(0..3);
    device.control.answer(Inbound::Urgent(Urgent::Stop));
    for _ in 0..45_000 {
        device.read();
    }
    let not_kept = What::Capsule(CapsuleEvent::StorageFailed);
    assert_eq!(device.told(), [ended(ActuationOutcome::Stopped), not_kept]);
    let mut later = Device::start_on(device.flash.clone(), FRESH, ResetCause::PowerOn);
    assert_eq!(totals(&mut later).actuations, 1);
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

/// Thread in the record of this flash, and state and doubt after a start with it.
fn after_a_start(flash: &Flash) -> (CapsuleState, i32, Option<u32>) {
    let flash = Flash::holding(flash.bytes());
    let mut device = Device::start_on(flash, FRESH, ResetCause::PowerOn);
    device.read();
    match device.accepted(Request::GetCapsuleStatus(GetCapsuleStatus)) {
        Response::GetCapsuleStatus(now) => (now.state, now.thread_um, now.uncertainty_um),
        other => panic!("{other:?}"),
    }
}

/// Folds a calibrated capsule of the model on this flash; 0.3 s after its end.
fn folded_on(flash: &Flash) -> (plant::board::Board, Device) {
    let mut device = Device::start_on(flash.clone(), FRESH, ResetCause::PowerOn);
    let mut model = plant::Simulation::nominal().board;
    read_from(&mut model, &mut device);
    for (order, moving) in [
        (Request::Calibrate(Calibrate), CapsuleState::Referencing),
        (Request::Fold(Fold), CapsuleState::Folding),
    ] {
        device.accepted(order);
        while device.state().0 == moving {
            read_from(&mut model, &mut device);
        }
    }
    assert_eq!(device.state(), (CapsuleState::Folded, None));
    for _ in 0..300 {
        read_from(&mut model, &mut device);
    }
    (model, device)
}

/// What a start finds at any instant is where the thread is, and nothing is erased on the way.
#[test]
fn the_flash_knows_the_place_before_within_and_after_a_motion() {
    let flash = Flash::blank();
    let (mut model, mut device) = folded_on(&flash);
    // The fold has ended, and is not in flash yet.
    let (state, thread_um, uncertainty_um) = after_a_start(&flash);
    let wound_um = (model.plant.wound_mm() * 1e3) as i32;
    let uncertainty_um = uncertainty_um.expect("a doubt") as i32;
    assert_eq!(state, CapsuleState::Unreferenced);
    assert!((thread_um..=thread_um + uncertainty_um).contains(&wound_um));
    for _ in 0..300 {
        read_from(&mut model, &mut device);
    }
    let (state, thread_um, uncertainty_um) = after_a_start(&flash);
    assert_eq!((state, uncertainty_um), (CapsuleState::Folded, Some(0)));
    assert!(thread_um.abs_diff(wound_um) < 150, "{thread_um} {wound_um}");
    device.accepted(Request::Unfold(Unfold));
    let mut readings = 0;
    while device.state().0 == CapsuleState::Unfolding {
        if readings % 100 == 0 {
            let (state, thread_um, uncertainty_um) = after_a_start(&flash);
            let wound_um = (model.plant.wound_mm() * 1e3) as i32;
            let uncertainty_um = uncertainty_um.expect("a doubt") as i32;
            assert_eq!(state, CapsuleState::Unreferenced);
            assert!(
                thread_um <= wound_um + 10 && wound_um <= thread_um + uncertainty_um + 60,
                "{thread_um} {uncertainty_um} {wound_um}"
            );
        }
        read_from(&mut model, &mut device);
        readings += 1;
    }
    for _ in 0..600 {
        read_from(&mut model, &mut device);
    }
    assert_eq!(after_a_start(&flash).0, CapsuleState::Unfolded);
}

/// The currents that judged the fold were wrong; nor does a reset make them right. An emergency stop casts no doubt.
#[test]
fn a_fold_that_a_fault_at_rest_has_withdrawn_is_not_believed_after_a_reset() {
    for (wrong_ma, after) in [(0, CapsuleState::Folded), (15, CapsuleState::Stopped)] {
        let flash = Flash::blank();
        let (mut model, mut device) = folded_on(&flash);
        if wrong_ma == 0 {
            device.control.answer(Inbound::Urgent(Urgent::EStop));
        }
        for _ in 0..700 {
            read_with_offset(wrong_ma, &mut model, &mut device);
        }
        assert_eq!(device.state().0, CapsuleState::Faulted);
        assert_eq!(after_a_start(&flash).0, after, "{wrong_ma} mA");
    }
}

/// Without the record a cut of the power would leave a place in flash where the thread is not.
#[test]
fn a_motion_whose_place_flash_does_not_take_does_not_begin() {
    let mut device = Device::ready();
    device.flash.fail(0..20);
    let refused = device.ask(Request::Calibrate(Calibrate));
    assert_eq!(refused, Reply::Refused(Refusal::StorageFailed));
    assert_eq!((device.drive(), device.told()), (Drive::Off, vec![]));
    assert_eq!(device.state().0, CapsuleState::Unreferenced);
}

/// The same while it goes on.
#[test]
fn a_motion_whose_place_flash_does_not_take_ends() {
    let mut device = Device::referencing();
    device.flash.fail(0..20);
    while device.state().0 == CapsuleState::Referencing {
        device.read();
    }
    let not_kept = What::Capsule(CapsuleEvent::StorageFailed);
    assert_eq!(device.told(), [not_kept, ended(ActuationOutcome::Stopped)]);
    assert_eq!(device.drive(), Drive::Brake);
}

/// The supply falls with the cell.
#[test]
fn a_cell_too_low_to_keep_the_place_is_named() {
    let mut device = Device::referencing();
    device.flash.fail(0..20);
    device.board().supply_low = true;
    while device.state().0 == CapsuleState::Referencing {
        device.read();
    }
    let fault = device.state().1;
    assert!(
        matches!(fault, Some(CapsuleFault::LowBattery { .. })),
        "{fault:?}"
    );
}

/// An erasure is part of what is written before a motion at times. No host is heard meanwhile, and the motor stands.
#[test]
fn a_motion_begins_behind_what_is_written_before_it() {
    let flash = Flash::blank();
    let mut device = Device::start_on(flash.clone(), FRESH, ResetCause::PowerOn);
    device.board().slow = Some(flash);
    device.read();
    let ordered_us = device.board().now_us();
    device.accepted(Request::Reference(Reference));
    let waited_us = device.board().now_us() - ordered_us;
    assert!(waited_us > 400_000, "{waited_us}");
    device.board().slow = None;
    device.board().now_us += waited_us;
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
    assert_eq!((record.duration_ms, record.peak_current_ma), (29, 0));
}

/// Nothing is erased while the motor turns: a motion begins with room for all that it may write.
#[test]
fn a_sector_that_is_nearly_full_is_left_before_a_motion() {
    let flash = Flash::blank();
    let mut store = SettingsStore::<_, Kept>::load_with(flash.clone(), |_| true).0;
    let mut counts = 0;
    for records in [300, 380, 440] {
        while counts < records {
            counts += 1;
            let mut known = Known::default();
            known.unfolded_here(Counts(counts));
            let kept = Kept {
                known,
                ..Kept::default()
            };
            store.keep(KNOWN, kept).expect("kept");
        }
        store.make_room(120).expect("made");
        let erasures = || {
            let erases = |operation: &&Operation| matches!(operation, Operation::Erase { .. });
            flash.operations().iter().filter(erases).count()
        };
        let erased = erasures();
        for _ in 0..120 {
            counts += 1;
            store.keep_moving(KNOWN, *store.records()).expect("kept");
        }
        assert_eq!(erasures(), erased, "{records}");
    }
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
        !told.contains(&What::Capsule(CapsuleEvent::StorageFailed)),
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
    assert!(last.drive_mv > 0 && last.thread_um > 100, "{last:?}");
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
