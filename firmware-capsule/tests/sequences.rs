//! Random sequences of requests, stops, readings, resets and mishaps: checks what must never happen, in any order.

use std::ops::Range;

use device::{
    common::Surroundings,
    service::{Answers, Inbound},
    settings::SettingsStore,
};
use firmware_capsule::{
    calibration::Calibration,
    control::Control,
    fold::Drive,
    kept::{CALIBRATION, Kept, TOTALS, Totals},
    mechanics::Thread,
};
use protocol::{
    capsule::{
        ActuationAccepted, ActuationKind, ActuationOutcome, Calibrate, CapsuleCalibration,
        CapsuleEvent, CapsuleFault, CapsuleState, CapsuleStatus, CheckFolded, Fold,
        GetActuationRecord, GetCapsuleStatus, GetCapsuleTotals, Reference, Unfold,
    },
    error::Refusal,
    settings::{FactoryReset, GetName, GetSetting, Setting, SettingKey},
    system::{Acknowledge, DeviceKind, ResetCause, Urgent, What},
    table::{Reply, Request, Response},
};
use simulated_machines::{chip::Flash, dice::Dice};

use inputs::{Input, input};
use judge::{Judge, Snapshot, driven};
use world::{Board, World};

mod inputs;
mod judge;
mod world;

/// Inputs of a sequence.
const INPUTS: u32 = 30;

fn is_at_rest(state: CapsuleState) -> bool {
    !matches!(
        state,
        CapsuleState::Referencing
            | CapsuleState::Checking
            | CapsuleState::Folding
            | CapsuleState::Unfolding
    )
}

/// Number of times that a series has met each state, motion, fault and request.
#[derive(Default)]
struct Met {
    states: [u64; 10],
    /// Motions that began, and those that were complete.
    kinds: [u64; 6],
    complete: [u64; 6],
    faults: [u64; 16],
    /// How often each request of the table was accepted and refused.
    requests: [(u64, u64); Request::NAMES.len()],
    stopped: u64,
    lost: u64,
    drifted: u64,
    /// Cells that were taken for too weak until a reset.
    flat: u64,
}

fn place_of(fault: CapsuleFault) -> usize {
    match fault {
        CapsuleFault::Jam { .. } => 0,
        CapsuleFault::ThreadBroken => 1,
        CapsuleFault::EncoderLost => 2,
        CapsuleFault::OverCurrent { .. } => 3,
        CapsuleFault::LowBattery { .. } => 4,
        CapsuleFault::Timeout => 5,
        CapsuleFault::DriverFault => 6,
        CapsuleFault::EStopFrame => 7,
        CapsuleFault::Watchdog => 8,
        CapsuleFault::Panic => 9,
        CapsuleFault::SpoolSlip => 10,
        CapsuleFault::SlipOrBreak => 11,
        CapsuleFault::BridgeSilent => 12,
        CapsuleFault::SenseLost => 13,
        CapsuleFault::NotUnfolded { .. } => 14,
        CapsuleFault::SenseOrEncoder => 15,
    }
}

fn place_in_table(request: &Request) -> usize {
    let place = Request::NAMES
        .iter()
        .position(|name| *name == request.name());
    place.expect("every request is in the table")
}

fn accepted_motion(response: &Response) -> Option<(ActuationKind, ActuationAccepted)> {
    Some(match response {
        Response::Reference(accepted) => (ActuationKind::Reference, *accepted),
        Response::Calibrate(accepted) => (ActuationKind::Calibrate, *accepted),
        Response::CheckFolded(accepted) => (ActuationKind::CheckFolded, *accepted),
        Response::Fold(accepted) => (ActuationKind::Fold, *accepted),
        Response::Unfold(accepted) => (ActuationKind::Unfold, *accepted),
        Response::FoldTo(accepted) => (ActuationKind::FoldTo, *accepted),
        _ => return None,
    })
}

/// A capsule and its judge.
struct Watch<'a> {
    control: Control<Board, Flash>,
    flash: Flash,
    world: World,
    judge: Judge,
    is_silent: bool,
    kind: ActuationKind,
    met: &'a mut Met,
}

const CALIBRATED: Calibration = Calibration {
    folded: Thread(21_700),
    no_load_ma: 16,
    rise: Thread(1_500),
    long_rise: Thread(3_300),
    tension_ma: 100,
    back_emf_uv_cps: 0,
};

/// Least setting of the end's wandering.
const DRIFT_UM: u32 = 100;

/// A flash that holds this.
fn flash(calibration: Option<Calibration>, folded: bool) -> Vec<u8> {
    let flash = Flash::blank();
    let (mut store, _) = SettingsStore::<Flash, Kept>::load_with(flash.clone(), |_| true);
    let totals = Totals {
        folded: folded.then_some(Thread(0)),
        ..Totals::default()
    };
    let kept = Kept {
        calibration,
        totals,
    };
    if calibration.is_some() {
        store.keep(CALIBRATION, kept).unwrap();
    }
    store.keep(TOTALS, kept).unwrap();
    // Tight enough for folded ends that wander to be met.
    store.set(SettingKey::DriftUm, DRIFT_UM).unwrap();
    flash.bytes()
}

impl<'a> Watch<'a> {
    fn new(bytes: &[u8], folded: bool, count: i32, met: &'a mut Met) -> Self {
        let flash = Flash::holding(bytes.to_vec());
        let board = Board::default();
        let left = board.retained(false);
        let control = Control::new(board, flash.clone(), left, ResetCause::PowerOn);
        let mut watch = Self {
            control,
            flash,
            world: World::new(count, 21_700),
            judge: Judge::new(None, folded),
            is_silent: false,
            kind: ActuationKind::Reference,
            met,
        };
        watch.control.capsule().told.clear();
        watch.judge = Judge::new(watch.calibration(), folded);
        let values = watch.judge.values.with(SettingKey::DriftUm, DRIFT_UM);
        watch.judge.values = values.unwrap();
        if folded {
            watch.world.fold();
        }
        watch.reading(&mut Dice(0));
        watch
    }

    fn ask(&mut self, request: Request) -> Reply {
        self.control.answer(Inbound::Request(request))
    }

    fn status(&mut self) -> CapsuleStatus {
        match self.ask(Request::GetCapsuleStatus(GetCapsuleStatus)) {
            Reply::Accepted(Response::GetCapsuleStatus(status)) => status,
            other => panic!("{other:?}"),
        }
    }

    fn calibration(&mut self) -> Option<CapsuleCalibration> {
        match self.ask(Request::GetCapsuleTotals(GetCapsuleTotals)) {
            Reply::Accepted(Response::GetCapsuleTotals(totals)) => totals.calibration,
            other => panic!("{other:?}"),
        }
    }

    fn now_us(&mut self) -> u64 {
        self.control.capsule().now_us
    }

    fn state(&mut self) -> CapsuleState {
        self.status().state
    }

    /// Goes on by this time; a host that is not silent is heard.
    fn pass(&mut self, elapsed_us: u64) {
        let is_silent = self.is_silent;
        let board = self.control.capsule();
        board.now_us += elapsed_us;
        if !is_silent {
            board.heard_us = board.now_us;
        }
    }

    fn reading(&mut self, dice: &mut Dice) {
        let before = self.control.capsule().drive;
        let (elapsed_us, sample) = self.world.turn(dice, before);
        self.pass(elapsed_us);
        // A reading may have waited for an answer.
        let late_us = if dice.one_in(4) { dice.below(500) } else { 0 };
        let at_us = self.now_us().saturating_sub(late_us);
        let written = self.flash.operations().len();
        self.judge.take(sample, elapsed_us);
        self.control.read(at_us, sample);
        assert!(
            self.flash.operations().len() == written
                || driven(before).is_none() && self.control.capsule().drive == Drive::Off,
            "the flash was written while the bridge was awake"
        );
        let status = self.status();
        self.judge.place(&status);
        let now_us = self.now_us();
        let silence_us = Surroundings::silence_us(self.control.capsule());
        self.hear(silence_us);
        self.judge.reading(now_us, silence_us, before);
        let drive = self.control.capsule().drive;
        self.judge.look(at_us, drive, true);
        assert_eq!(
            self.judge.moves(),
            !is_at_rest(status.state),
            "{:?}",
            status.state
        );
        self.met.states[status.state as usize] += 1;
    }

    /// Passes the events since the last input to the judge.
    fn hear(&mut self, silence_us: u32) {
        let wound_um = self.judge.wound_um();
        let board = self.control.capsule();
        let (now_us, told) = (board.now_us, std::mem::take(&mut board.told));
        if told.is_empty() {
            return;
        }
        let link_timeout_us = self.judge.values.get(SettingKey::LinkTimeoutMs) * 1_000;
        self.judge.hear(now_us, &told, silence_us > link_timeout_us);
        let calibration = self.calibration();
        self.judge.calibrated(calibration, wound_um);
        for what in told {
            match what {
                What::Capsule(CapsuleEvent::Faulted(fault)) => {
                    self.met.faults[place_of(fault)] += 1;
                }
                What::Capsule(CapsuleEvent::Ended { outcome, .. }) => match outcome {
                    ActuationOutcome::Complete => self.met.complete[self.kind as usize] += 1,
                    ActuationOutcome::Stopped => self.met.stopped += 1,
                    ActuationOutcome::LinkLost => self.met.lost += 1,
                    _ => {}
                },
                What::Capsule(CapsuleEvent::Drifted { .. }) => self.met.drifted += 1,
                _ => {}
            }
        }
    }

    fn snapshot(&mut self) -> Snapshot {
        let mut status = self.status();
        status.time_us = 0;
        Snapshot {
            status,
            answers: [
                self.ask(Request::GetActuationRecord(GetActuationRecord)),
                self.ask(Request::GetCapsuleTotals(GetCapsuleTotals)),
                self.ask(Request::GetName(GetName)),
            ],
            flash: self.flash.operations(),
            latched: self.control.capsule().latched,
            telemetry_ms: self.control.capsule().telemetry_ms,
        }
    }

    /// Makes a request, and returns why it was refused.
    fn request(&mut self, request: Request) -> Option<Refusal> {
        let place = place_in_table(&request);
        let before = self.snapshot();
        let drive = self.control.capsule().drive;
        let now_us = self.now_us();
        let reply = self.ask(request.clone());
        let after = self.control.capsule().drive;
        let refused = match reply {
            Reply::Accepted(response) => {
                self.met.requests[place].0 += 1;
                assert!(
                    before.flash.len() == self.flash.operations().len() || driven(drive).is_none(),
                    "the flash was written while the motor was driven"
                );
                self.carried_out(&request, &response);
                None
            }
            Reply::Refused(refusal) => {
                self.met.requests[place].1 += 1;
                self.refused(&request, &refusal, &before);
                // It may have been time for a brake to end.
                let same = after == drive || (drive == Drive::Brake && driven(after).is_none());
                assert!(same, "{request:?} was refused: {drive:?} to {after:?}");
                Some(refusal)
            }
            other => panic!("{other:?}"),
        };
        self.hear(0);
        self.judge.look(now_us, after, false);
        refused
    }

    fn carried_out(&mut self, request: &Request, response: &Response) {
        let now_us = self.now_us();
        if let Some((kind, accepted)) = accepted_motion(response) {
            self.met.kinds[kind as usize] += 1;
            self.kind = kind;
            self.judge.accepted(now_us, kind, accepted.timeout_ms);
        }
        match request {
            Request::Acknowledge(_) => self.judge.acknowledged(),
            Request::SetSetting(setting) => {
                let values = self.judge.values.with(setting.key, setting.value);
                self.judge.values = values.expect("accepted out of its range");
                assert!(!self.judge.moves(), "a setting changes in a motion");
            }
            Request::FactoryReset(_) => self.judge.values = device::settings::Values::DEFAULT,
            _ => {}
        }
    }

    fn refused(&mut self, request: &Request, refusal: &Refusal, before: &Snapshot) {
        let mut after = self.snapshot();
        if let Request::Acknowledge(_) = request {
            self.judge.not_acknowledged(before.status.fault, refusal);
        }
        // A current at rest, seen before a motion, is a fault.
        let seen = matches!(refusal, Refusal::CapsuleFaulted(_))
            && before.status.fault.is_none()
            && self.judge.sample.offset_ma.unsigned_abs() > 20;
        if seen {
            assert_eq!(after.status.state, CapsuleState::Faulted);
            after.status = before.status;
        } else {
            assert_eq!(self.control.capsule().told, [], "{request:?}");
        }
        assert_eq!(after, *before, "{request:?} was refused: {refusal:?}");
        if let Request::SetSetting(Setting { key, .. }) = request {
            self.check_setting(*key);
        }
    }

    fn check_setting(&mut self, key: SettingKey) {
        let value = self.judge.values.get(key);
        if key.is_of(DeviceKind::Capsule) {
            let kept = self.ask(Request::GetSetting(GetSetting { key }));
            let setting = Response::GetSetting(Setting { key, value });
            assert_eq!(kept, Reply::Accepted(setting));
        }
    }

    fn urgent(&mut self, urgent: Urgent) {
        let reply = self.control.answer(Inbound::Urgent(urgent));
        assert_eq!(reply, Reply::Urgent(urgent));
        self.hear(0);
        let now_us = self.now_us();
        self.judge.urgent(now_us, urgent);
        let status = self.status();
        self.judge.place(&status);
        let drive = self.control.capsule().drive;
        self.judge.look(now_us, drive, false);
        let state = self.state();
        assert!(is_at_rest(state), "{state:?} after {urgent:?}");
        assert!(urgent == Urgent::Stop || state == CapsuleState::Faulted);
    }

    fn reset(&mut self, cause: ResetCause, clock_failed: bool) {
        let forgotten = cause == ResetCause::PowerOn;
        let mut board = std::mem::take(self.control.capsule());
        if forgotten {
            board.latched = None;
        }
        let left = board.retained(clock_failed);
        let board = Board {
            latched: board.latched,
            supply_low: board.supply_low,
            ..Board::default()
        };
        self.control = Control::new(board, self.flash.clone(), left, cause);
        assert_eq!(self.control.capsule().told, [What::Booted(cause)]);
        self.control.capsule().told.clear();
        let crashed = matches!(cause, ResetCause::Panic | ResetCause::Watchdog);
        self.judge.reset(forgotten, crashed);
        let (status, calibration) = (self.status(), self.calibration());
        self.judge.restarted(&status, calibration);
        if let Some(fault) = status.fault {
            self.met.faults[place_of(fault)] += 1;
        }
        for key in SettingKey::of(DeviceKind::Capsule) {
            self.check_setting(key);
        }
    }

    fn take(&mut self, dice: &mut Dice, input: Input) {
        // Between two readings.
        if dice.one_in(2) {
            self.pass(dice.below(1_000));
        }
        match input {
            Input::Readings(most) => {
                for _ in 0..most {
                    self.reading(dice);
                    let drive = self.control.capsule().drive;
                    let rests = !self.judge.moves() && drive == Drive::Off;
                    if rests || drive == Drive::Brake && dice.one_in(4) {
                        break;
                    }
                }
            }
            Input::Pause(elapsed_us) => {
                for _ in 0..2 {
                    self.pass(elapsed_us);
                    self.reading(dice);
                }
            }
            Input::Request(request) => {
                self.request(request);
            }
            Input::Urgent(urgent) => self.urgent(urgent),
            Input::Silence(silent) => self.is_silent = silent,
            Input::Supply(low) => self.control.capsule().supply_low = low,
            Input::Mishap(mishap) => self.world.mishap = mishap,
            Input::Battery(battery_mv) => self.world.battery_mv = battery_mv,
            Input::Offset(offset_ma) => self.world.offset_ma = offset_ma,
            Input::Fold => self.world.fold(),
            Input::Unfold => self.world.unfold(),
            Input::Creep(by_um) => self.world.creep(by_um),
            Input::Reset(cause, clock_failed) => self.reset(cause, clock_failed),
        }
    }
}

/// From any state a documented command leads on, once everything is in order; see docs/capsule.md, "The way out".
fn way_out(watch: &mut Watch<'_>, dice: &mut Dice) {
    watch.world.repair();
    (watch.is_silent, watch.control.capsule().supply_low) = (false, false);
    watch.urgent(Urgent::Stop);
    for _ in 0..3 {
        watch.pass(700_000);
        watch.reading(dice);
    }
    // An amplifier whose zero has moved back is another fault.
    for _ in 0..2 {
        if watch.state() == CapsuleState::Faulted {
            assert_eq!(watch.request(Request::Acknowledge(Acknowledge)), None);
            watch.reading(dice);
        }
    }
    if let Some(refusal) = lead_on(watch) {
        // A cell whose resistance was measured too high is measured again after a reset.
        let flat = matches!(refusal, Refusal::BatteryLow { .. });
        assert!(flat, "{refusal:?} in {:?}", watch.state());
        watch.met.flat += 1;
        watch.reset(ResetCause::PowerOn, false);
        watch.reading(dice);
        assert_eq!(lead_on(watch), None);
    }
    watch.urgent(Urgent::Stop);
}

fn lead_on(watch: &mut Watch<'_>) -> Option<Refusal> {
    let calibrated = watch.calibration().is_some();
    let state = watch.state();
    watch.request(match state {
        CapsuleState::Unreferenced if calibrated => Request::Reference(Reference),
        CapsuleState::WasFolded if calibrated => Request::CheckFolded(CheckFolded),
        CapsuleState::Unreferenced | CapsuleState::WasFolded => Request::Calibrate(Calibrate),
        CapsuleState::Folded | CapsuleState::Stopped => Request::Unfold(Unfold),
        CapsuleState::Unfolded if calibrated => Request::Fold(Fold),
        CapsuleState::Unfolded => Request::Calibrate(Calibrate),
        other => panic!("{other:?} at rest and without a fault"),
    })
}

/// Whatever has happened, a capsule in order that was unfolded by hand works.
fn works(watch: &mut Watch<'_>, dice: &mut Dice) {
    watch.reset(ResetCause::PowerOn, false);
    for _ in 0..3 {
        watch.pass(700_000);
        watch.reading(dice);
    }
    watch.world.unfold();
    // The current that an earlier calibration took for that of a slack thread may be wrong.
    watch.world.slack_um = 900;
    for (request, state) in [
        (Request::FactoryReset(FactoryReset), None),
        (Request::Calibrate(Calibrate), Some(CapsuleState::Unfolded)),
        (Request::Fold(Fold), Some(CapsuleState::Folded)),
        (Request::Unfold(Unfold), Some(CapsuleState::Unfolded)),
    ] {
        assert_eq!(watch.request(request.clone()), None, "{request:?}");
        while watch.judge.moves() {
            watch.reading(dice);
        }
        let reached = watch.status();
        assert!(
            state.is_none_or(|state| state == reached.state),
            "{request:?} ends in {reached:?}"
        );
    }
}

/// Tells which sequence has failed.
struct Seed(u64);

impl Drop for Seed {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("in sequence {}", self.0);
        }
    }
}

fn sequence(seed: u64, images: &[(Vec<u8>, bool); 3], met: &mut Met) {
    let _told = Seed(seed);
    let mut dice = Dice(seed);
    let (bytes, folded) = &images[dice.pick(&[0, 1, 1, 2])];
    let count = dice.pick(&[0, 0, i32::MAX - 100, i32::MIN + 10_000]);
    let mut watch = Watch::new(bytes, *folded, count, met);
    for _ in 0..INPUTS {
        let state = watch.state();
        let input = input(&mut dice, state);
        watch.take(&mut dice, input);
    }
    way_out(&mut watch, &mut dice);
    if seed.is_multiple_of(8) {
        works(&mut watch, &mut dice);
    }
}

impl Met {
    /// A series that does not reach all of this proves nothing.
    fn check(&self, sequences: u64) {
        let often = |count: u64| count * 2_000 >= sequences;
        let all = |counts: &[u64]| counts.iter().all(|count| often(*count));
        assert!(all(&self.states), "states: {:?}", self.states);
        assert!(all(&self.kinds), "motions that began: {:?}", self.kinds);
        assert!(all(&self.complete), "complete: {:?}", self.complete);
        assert!(all(&self.faults), "faults: {:?}", self.faults);
        let rest = [self.stopped, self.lost, self.drifted, self.flat];
        assert!(all(&rest), "stopped, link lost, drifted, flat: {rest:?}");
        for (name, (accepted, refused)) in Request::NAMES.iter().zip(&self.requests) {
            // The test itself sends the requests that only tell something.
            let (accepts, refuses) = match *name {
                "Reference" | "Calibrate" | "CheckFolded" | "Fold" | "Unfold" | "FoldTo"
                | "Acknowledge" | "SetSetting" | "FactoryReset" | "SetName" | "SetTelemetry" => {
                    (true, true)
                }
                "KeepAlive" | "GetEvents" | "GetTrace" => (true, false),
                "Home" => (false, true),
                _ => continue,
            };
            assert!(often(*accepted) == accepts, "{name} accepted: {accepted}");
            assert!(often(*refused) == refuses, "{name} refused: {refused}");
        }
    }
}

fn check(seeds: Range<u64>) {
    let sequences = seeds.end - seeds.start;
    let images = [
        (flash(None, false), false),
        (flash(Some(CALIBRATED), false), false),
        (flash(Some(CALIBRATED), true), true),
    ];
    let mut met = Met::default();
    for seed in seeds {
        sequence(seed, &images, &mut met);
    }
    met.check(sequences);
}

/// End of a series of seeds: `usual`, or a million where RETROGRADE_CAMPAIGN is set, or the number that it gives.
fn end_of_series(usual: u64) -> u64 {
    match std::env::var("RETROGRADE_CAMPAIGN") {
        Ok(campaign) => campaign.parse().unwrap_or(1_000_000),
        Err(_) => usual,
    }
}

#[test]
fn hold_in_random_sequences() {
    check(0..end_of_series(50_000));
}
