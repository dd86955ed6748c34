//! Control as the board runs it: requests, button, clock and notices in; orders, replies and events out. The carriage
//! executes what it orders; settings lie in a flash in memory.

use crate::commands::{HARDWARE, HEALTH};
use device::{
    common::Surroundings,
    last_words::LastWords,
    retained::{EStop, Retained},
    service::{Answers, Inbound},
    settings::SettingsStore,
};
use firmware_rig::{
    control::{self, Control, ROUND_US},
    execution::Order,
    machine::{Command, Event, Now, PathEnd},
    settings::Settings,
};
use motion::{axis::Axis, units::StepPosition};
use protocol::{
    error::Refusal,
    rig::{
        self, GetRigHardware, GetRigHealth, GetRigStatus, GetRunRecord, LinkLossPolicy, RigEvent,
        RigFault, RigHardware, RigHealth, RigState, RigStatus, Run, RunOutcome, RunRecord,
        RunTiming,
    },
    settings::{FactoryReset, GetName, GetSetting, Name, Setting, SettingKey},
    system::{
        self, Acknowledge, DeviceKind, Done, GetEvents, GetLastWords, ResetCause, SetTelemetry,
        Urgent, What,
    },
    table::{Endpoint, Reply, Request, Response},
};
use simulated_machines::carriage::{CONTROL_ROUND, Carriage, IMAGE_HASH, ring::Ahead};
use simulated_machines::chip::Flash;

const SETTINGS: Settings = Settings::REFERENCE;

/// The board's counters.
const COUNTED: RigHealth = RigHealth {
    underruns: 0,
    control_late_us: 0,
    image_hash: 0,
    ..HEALTH
};

/// A healthy chip.
const CHIP: system::Chip = system::Chip {
    clock: system::Clock::External,
    brown_out: system::BrownOut::Off,
    supply_low: false,
    option_bytes: 0x00FF_AAED,
};

/// The board: a carriage, and a record of all calls from control.
struct Board {
    carriage: Carriage,
    button: bool,
    supply_low: bool,
    clock: system::Clock,
    rearmed: u32,
    silence_us: u32,
    sent: Vec<system::Event>,
    telemetry_ms: Vec<u16>,
    filters_us: Vec<u32>,
    latched: Vec<Option<EStop>>,
    cuts: u32,
    clock_has_come: bool,
    restarts: Vec<(Retained, ResetCause)>,
}

impl Surroundings for Board {
    fn now_us(&self) -> u64 {
        self.carriage.observe().time_us
    }

    fn chip(&self) -> system::Chip {
        system::Chip {
            clock: self.clock,
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
        self.sent.push(*event);
    }
}

impl control::Rig for Board {
    fn now(&self) -> Now {
        self.carriage.observe()
    }

    fn button_is_down(&self) -> bool {
        self.button
    }

    fn stroke(&self) -> u32 {
        self.carriage.mail.stroke
    }

    fn health(&self) -> RigHealth {
        COUNTED
    }

    fn hardware(&self) -> RigHardware {
        HARDWARE
    }

    fn start(&mut self, order: Order) {
        self.carriage.order(order);
    }

    fn rearm_loop(&mut self) {
        self.rearmed += 1;
    }

    fn stop_path(&mut self) {
        self.carriage.stop();
    }

    fn cut(&mut self) {
        self.cuts += 1;
        self.carriage.cut();
    }

    fn set_position(&mut self, position: StepPosition) {
        self.carriage.set_position(position);
    }

    fn set_switch_filter(&mut self, filter_us: u32) {
        self.filters_us.push(filter_us);
    }

    fn clock_has_come(&self) -> bool {
        self.clock_has_come
    }

    fn restart(&mut self, previous: &Retained, cause: ResetCause) {
        self.restarts.push((previous.clone(), cause));
    }
}

/// The rig, from its start on.
struct Bench {
    control: Control<Board, Flash>,
    flash: Flash,
    next_tick: u64,
}

const FRESH: Retained = Retained {
    boot_id: 1,
    last_words: None,
    latched: None,
    clock_failed: false,
    cause: None,
};

impl Bench {
    fn start(flash: Flash, previous: Retained, cause: ResetCause) -> Self {
        Self::start_with(flash, previous, cause, |_| ())
    }

    fn start_with(
        flash: Flash,
        previous: Retained,
        cause: ResetCause,
        prepare: impl FnOnce(&mut Board),
    ) -> Self {
        let mut carriage = Carriage::new(SETTINGS, 2_000);
        carriage.ring.ahead = Ahead::Slots;
        let mut board = Board {
            carriage,
            button: false,
            supply_low: false,
            clock: system::Clock::External,
            rearmed: 0,
            silence_us: 0,
            sent: Vec::new(),
            telemetry_ms: Vec::new(),
            filters_us: Vec::new(),
            latched: Vec::new(),
            cuts: 0,
            clock_has_come: false,
            restarts: Vec::new(),
        };
        // Control starts when the chip has been running for a while.
        board.carriage.now = 123_456;
        prepare(&mut board);
        let next_tick = board.carriage.now + CONTROL_ROUND;
        Self {
            control: Control::new(board, flash.clone(), previous, cause, IMAGE_HASH),
            flash,
            next_tick,
        }
    }

    fn new() -> Self {
        Self::start(Flash::blank(), FRESH, ResetCause::PowerOn)
    }

    /// A homed rig, with its events so far dropped.
    fn homed() -> Self {
        let mut bench = Self::new();
        bench.accepted(Request::Home(rig::Home));
        bench.finish();
        assert_eq!(bench.state(), RigState::Ready);
        bench.sent();
        bench
    }

    fn board(&mut self) -> &mut Board {
        self.control.rig()
    }

    fn carriage(&mut self) -> &mut Carriage {
        &mut self.control.rig().carriage
    }

    fn state(&self) -> RigState {
        self.control.snapshot().state
    }

    /// Events told since the last call.
    fn sent(&mut self) -> Vec<What> {
        let sent = std::mem::take(&mut self.board().sent);
        sent.into_iter().map(|event| event.what).collect()
    }

    /// Advances to the next round of control and runs it.
    fn tick(&mut self) {
        let next_tick = self.next_tick;
        while self.next_tick == next_tick {
            self.step();
        }
    }

    fn ticks(&mut self, ticks: u32) {
        (0..ticks).for_each(|_| self.tick());
    }

    /// Runs whatever comes next: a step of the carriage, or a round of control.
    fn step(&mut self) {
        let next_tick = self.next_tick;
        let carriage = self.carriage();
        if carriage.moving() && carriage.now < next_tick {
            for event in carriage.step() {
                self.control.event(event);
            }
        } else {
            carriage.now = carriage.now.max(next_tick);
            self.next_tick += CONTROL_ROUND;
            self.control.tick();
        }
    }

    fn steps_until(&mut self, pulses: u64) {
        let until = self.carriage().pulses + pulses;
        while self.carriage().pulses < until && self.carriage().moving() {
            self.step();
        }
    }

    fn finish(&mut self) {
        while self.carriage().moving() {
            self.step();
        }
    }

    fn ask(&mut self, request: Request) -> Reply {
        self.control.answer(Inbound::Request(request))
    }

    fn accepted(&mut self, request: Request) -> Response {
        match self.ask(request.clone()) {
            Reply::Accepted(response) => response,
            other => panic!("{request:?}: {other:?}"),
        }
    }

    fn refused(&mut self, request: Request) -> Refusal {
        match self.ask(request.clone()) {
            Reply::Refused(refusal) => refusal,
            other => panic!("{request:?}: {other:?}"),
        }
    }

    /// The response to a request that is accepted.
    fn get<E: Endpoint>(&mut self, request: E) -> E::Response {
        let response = self.accepted(request.into_request());
        E::from_response(response).expect("the response of the same row")
    }

    fn status(&mut self) -> RigStatus {
        self.get(GetRigStatus)
    }

    fn record(&mut self) -> RunRecord {
        self.get(GetRunRecord)
    }

    fn health(&mut self) -> RigHealth {
        self.get(GetRigHealth)
    }

    fn value(&mut self, key: SettingKey) -> u32 {
        self.get(GetSetting { key }).value
    }

    fn name(&mut self) -> String {
        self.get(GetName).name.as_str().to_owned()
    }

    /// The E-stop is pressed while pulses are armed: the hardware cuts them and interrupts.
    fn press(&mut self) {
        self.carriage().pressed = true;
        self.carriage().cut();
        self.control.event(Event::LoopOpened);
    }
}

fn set(key: SettingKey, value: u32) -> Request {
    Request::SetSetting(Setting { key, value })
}

fn name(text: &str) -> Request {
    Request::SetName(Name {
        name: text.try_into().unwrap(),
    })
}

/// 5 mm, two cycles.
fn run(link_loss: LinkLossPolicy) -> Request {
    Request::Run(Run {
        cycles: 2,
        stroke_um: 5_000,
        timing: RunTiming::Speeds {
            forward_um_s: 40_000,
            return_um_s: 40_000,
            accel_um_s2: 1_000_000,
        },
        far_dwell_us: 5_000,
        home_dwell_us: 5_000,
        start_delay_us: 0,
        link_loss,
    })
}

fn rig_event(event: RigEvent) -> What {
    What::Rig(event)
}

mod start {
    use super::*;

    const CAUSES: [ResetCause; 5] = [
        ResetCause::PowerOn,
        ResetCause::Pin,
        ResetCause::Panic,
        ResetCause::Watchdog,
        ResetCause::Software,
    ];

    #[test]
    fn latches_what_ended_the_one_before() {
        for cause in CAUSES {
            for latched in [None, Some(EStop::Loop), Some(EStop::Frame)] {
                let fault = match (cause, latched) {
                    (ResetCause::Panic, _) => Some(RigFault::Panic),
                    (ResetCause::Watchdog, _) => Some(RigFault::Watchdog),
                    (_, Some(EStop::Loop)) => Some(RigFault::EStopLoop),
                    (_, Some(EStop::Frame)) => Some(RigFault::EStopFrame),
                    (_, None) => None,
                };
                let previous = Retained { latched, ..FRESH };
                let mut bench = Bench::start(Flash::blank(), previous, cause);
                assert_eq!(bench.sent(), [What::Booted(cause)]);
                let status = bench.status();
                assert_eq!((status.fault, status.homed), (fault, false));
                let state = if fault.is_some() {
                    RigState::Faulted
                } else {
                    RigState::Unhomed
                };
                assert_eq!((status.state, bench.state()), (state, state));
                // A fault latched over a reset stays until it is acknowledged.
                assert_eq!(bench.board().latched, []);
                assert!(!bench.carriage().moving());
                let restarted = matches!(fault, Some(RigFault::Panic | RigFault::Watchdog));
                assert_eq!(status.needs_acknowledge, restarted);
                if restarted {
                    let refusal = bench.refused(Request::Home(rig::Home));
                    assert_eq!(refusal, Refusal::AcknowledgeFirst);
                }
                if fault.is_some() {
                    bench.accepted(Request::Acknowledge(Acknowledge));
                    assert_eq!(bench.sent(), [What::Acknowledged]);
                    assert_eq!(bench.board().latched, [None]);
                    assert_eq!(bench.state(), RigState::Unhomed);
                }
            }
        }
    }

    #[test]
    fn tells_the_last_words_of_the_one_before() {
        for text in [None, Some("tasks/link.rs:1: oh")] {
            let last_words = text.map(|text| LastWords::try_from(text).unwrap());
            let previous = Retained {
                last_words,
                ..FRESH
            };
            let mut bench = Bench::start(Flash::blank(), previous, ResetCause::Panic);
            let words = bench.get(GetLastWords).text;
            assert_eq!(words.as_str(), text.unwrap_or_default());
        }
    }

    #[test]
    fn hands_the_settings_in_flash_to_whom_they_concern() {
        let flash = Flash::blank();
        let (mut store, _) = SettingsStore::load(flash.clone(), |_| true);
        for (key, value) in [
            (SettingKey::TelemetryMs, 250),
            (SettingKey::SwitchFilterUs, 11),
            (SettingKey::StrokeUm, 100_000),
        ] {
            store.set(key, value).unwrap();
        }
        store.set_name("left bench".try_into().unwrap()).unwrap();
        let mut bench = Bench::start(flash, FRESH, ResetCause::Pin);
        assert_eq!(bench.sent(), [What::Booted(ResetCause::Pin)]);
        assert_eq!(bench.board().telemetry_ms, [250]);
        assert_eq!(bench.board().filters_us, [11]);
        assert_eq!(bench.status().stroke_um, 100_000);
        assert_eq!(bench.value(SettingKey::TelemetryMs), 250);
        assert_eq!(bench.name(), "left bench");
        let axis = bench.control.snapshot().axis;
        assert_eq!(axis, Axis::new(4_000, 200, 16, 100_000).unwrap());
    }

    /// No log at all, or values within their ranges that break a rule together.
    #[test]
    fn with_unusable_settings_runs_on_the_defaults_and_says_so() {
        let no_log = Flash::holding(vec![0; Flash::blank().bytes().len()]);
        let no_rule = Flash::blank();
        let (mut store, _) = SettingsStore::load(no_rule.clone(), |_| true);
        store.set(SettingKey::Microsteps, 12).unwrap();
        store.set(SettingKey::TelemetryMs, 250).unwrap();
        for flash in [no_log, no_rule] {
            let mut bench = Bench::start(flash.clone(), FRESH, ResetCause::PowerOn);
            let unusable = rig_event(RigEvent::SettingsUnusable);
            assert_eq!(bench.sent(), [What::Booted(ResetCause::PowerOn), unusable]);
            assert_eq!(bench.board().telemetry_ms, [0]);
            assert_eq!(bench.status().steps_per_rev, 3_200);
            for key in SettingKey::of(DeviceKind::Rig) {
                assert_eq!(bench.value(key), key.range().default);
            }
            // A reset to the defaults makes the flash usable again.
            bench.accepted(Request::FactoryReset(FactoryReset));
            assert_eq!(bench.sent(), [rig_event(RigEvent::SettingsReset)]);
            let mut bench = Bench::start(flash, FRESH, ResetCause::PowerOn);
            assert_eq!(bench.sent(), [What::Booted(ResetCause::PowerOn)]);
        }
    }
}

mod settings {
    use super::*;

    #[test]
    fn are_in_force_at_once_and_after_the_next_start() {
        let mut bench = Bench::homed();
        for (key, value) in [
            (SettingKey::DeadManMs, 200),
            (SettingKey::SwitchFilterUs, 11),
            (SettingKey::TelemetryMs, 250),
        ] {
            let setting = Setting { key, value };
            let response = bench.accepted(set(key, value));
            assert_eq!(response, Response::SetSetting(setting));
            let changed = rig_event(RigEvent::SettingChanged(key));
            assert_eq!(bench.sent(), [changed]);
            assert_eq!(bench.value(key), value);
        }
        // Each change passes the filter on; telemetry has its own request.
        assert_eq!(bench.board().filters_us, [21, 21, 11, 11]);
        assert_eq!(bench.board().telemetry_ms, [0]);
        assert_eq!(bench.state(), RigState::Ready, "positions mean the same");
        let response = bench.accepted(name("left bench"));
        assert!(matches!(response, Response::SetName(_)));
        assert_eq!(bench.sent(), []);
        let flash = bench.flash.clone();
        let mut bench = Bench::start(flash, FRESH, ResetCause::Pin);
        assert_eq!(bench.value(SettingKey::DeadManMs), 200);
        assert_eq!(bench.board().telemetry_ms, [250]);
        assert_eq!(bench.name(), "left bench");
    }

    #[test]
    fn that_give_positions_another_meaning_unhome_the_rig() {
        let mut bench = Bench::homed();
        bench.accepted(set(SettingKey::FlagUm, 1_100));
        assert_eq!(bench.state(), RigState::Unhomed);
        assert!(!bench.status().homed);
        let mut bench = Bench::homed();
        bench.accepted(set(SettingKey::StrokeUm, 100_000));
        assert_eq!(bench.control.snapshot().axis.stroke().0, 100_000);
        // The reset that takes the change back unhomes the rig, too.
        bench.accepted(Request::Home(rig::Home));
        bench.finish();
        assert_eq!(bench.state(), RigState::Ready);
        bench.accepted(Request::FactoryReset(FactoryReset));
        assert_eq!(bench.state(), RigState::Unhomed);
        assert_eq!(bench.control.snapshot().axis, Axis::REFERENCE);
        assert_eq!(bench.value(SettingKey::StrokeUm), 130_000);
    }

    /// Below 2.7 V the flash must not be written: nothing is, and the old value stands.
    #[test]
    fn are_not_written_while_the_supply_is_too_low() {
        let mut bench = Bench::new();
        bench.board().supply_low = true;
        let operations = bench.flash.operations();
        for request in [
            set(SettingKey::LeadUm, 2_000),
            name("right bench"),
            Request::FactoryReset(FactoryReset),
        ] {
            assert_eq!(bench.refused(request), Refusal::SupplyLow);
        }
        assert_eq!(bench.flash.operations(), operations);
        assert_eq!(bench.value(SettingKey::LeadUm), 4_000);
        bench.board().supply_low = false;
        bench.accepted(set(SettingKey::LeadUm, 2_000));
    }

    /// The reply reports what happened, not what was wanted.
    #[test]
    fn that_the_flash_does_not_take_are_not_in_force() {
        let mut bench = Bench::homed();
        bench.accepted(set(SettingKey::DeadManMs, 200));
        bench.accepted(name("left bench"));
        bench.sent();
        let filters = bench.board().filters_us.clone();
        bench.flash.wear();
        for request in [
            set(SettingKey::StrokeUm, 100_000),
            name("right bench"),
            Request::FactoryReset(FactoryReset),
        ] {
            assert_eq!(bench.refused(request), Refusal::StorageFailed);
        }
        assert_eq!(bench.sent(), []);
        assert_eq!(bench.board().filters_us, filters);
        assert_eq!(bench.value(SettingKey::StrokeUm), 130_000);
        assert_eq!(bench.value(SettingKey::DeadManMs), 200);
        assert_eq!(bench.name(), "left bench");
        assert_eq!(bench.state(), RigState::Ready);
    }
}

/// Below 2.7 V a reset may come at any moment: it would cut a motion and lose the position.
mod supply {
    use super::*;

    #[test]
    fn that_is_too_low_begins_no_motion_and_refuses_no_stop() {
        let mut bench = Bench::homed();
        let start = run(LinkLossPolicy::Stop);
        bench.accepted(start.clone());
        bench.steps_until(100);
        bench.board().supply_low = true;
        // A stop, and a hold, are never refused for it.
        bench.accepted(Request::Hold(rig::Hold));
        bench.finish();
        assert_eq!(bench.state(), RigState::Held);
        assert_eq!(
            bench.refused(Request::Resume(rig::Resume)),
            Refusal::SupplyLow
        );
        bench.control.stop(Urgent::Stop);
        assert_eq!(bench.state(), RigState::Ready);
        let moves = [
            Request::Home(rig::Home),
            start,
            Request::Jog(rig::Jog {
                direction: rig::Direction::Away,
                speed_um_s: 1_000,
            }),
            Request::MoveTo(rig::MoveTo {
                position_um: 0,
                speed_um_s: 1_000,
            }),
        ];
        for request in &moves {
            assert_eq!(bench.refused(request.clone()), Refusal::SupplyLow);
        }
        bench.sent();
        bench.board().button = true;
        bench.ticks(3);
        bench.board().button = false;
        assert_eq!(bench.sent(), [rig_event(RigEvent::ButtonIgnored)]);
        assert_eq!(bench.state(), RigState::Ready);
        bench.board().supply_low = false;
        bench.accepted(moves[0].clone());
        // The button still stops.
        bench.board().supply_low = true;
        bench.tick();
        bench.board().button = true;
        bench.ticks(3);
        assert_eq!(bench.state(), RigState::Stopping);
    }
}

mod button {
    use super::*;

    fn hold_down(bench: &mut Bench, rounds: u32) {
        bench.board().button = true;
        bench.ticks(rounds);
        bench.board().button = false;
    }

    #[test]
    fn counts_when_it_is_down_for_three_rounds() {
        let mut bench = Bench::new();
        for _ in 0..5 {
            hold_down(&mut bench, 2);
            bench.tick();
            assert_eq!(bench.state(), RigState::Unhomed);
        }
        hold_down(&mut bench, 3);
        assert_eq!(bench.state(), RigState::Homing);
    }

    /// While flash is erased no round comes; those that were missed come at once after it.
    #[test]
    fn does_not_count_in_rounds_that_come_at_once() {
        let mut bench = Bench::new();
        bench.tick();
        bench.board().button = true;
        (0..100).for_each(|_| bench.control.tick());
        bench.board().button = false;
        bench.tick();
        assert_eq!(bench.state(), RigState::Unhomed);
    }

    /// Whoever wants to stop a run may be late.
    #[test]
    fn that_was_meant_to_stop_starts_nothing() {
        let mut bench = Bench::homed();
        bench.tick();
        hold_down(&mut bench, 3);
        assert_eq!(bench.sent(), [rig_event(RigEvent::ButtonIgnored)]);
        assert_eq!(bench.state(), RigState::Ready);
        bench.ticks(100);
        hold_down(&mut bench, 3);
        assert_eq!(bench.state(), RigState::Running);
        bench.ticks(100);
        bench.accepted(Request::Hold(rig::Hold));
        bench.finish();
        assert_eq!(bench.state(), RigState::Held);
        bench.sent();
        hold_down(&mut bench, 3);
        assert_eq!(bench.sent(), [rig_event(RigEvent::ButtonIgnored)]);
        assert_eq!(bench.state(), RigState::Held);
        bench.ticks(100);
        hold_down(&mut bench, 3);
        assert_eq!(bench.state(), RigState::Running);
    }

    /// From a second after the last round in which the rig moved, it starts again.
    #[test]
    fn is_meant_to_stop_for_less_than_a_second() {
        for (after_us, is_ignored, state) in [
            (990_000, true, RigState::Ready),
            (1_000_000, false, RigState::Running),
        ] {
            let mut bench = Bench::new();
            bench.accepted(Request::Home(rig::Home));
            let mut moved_us = 0;
            while bench.carriage().moving() {
                let (round, moves) = (bench.next_tick, bench.state() == RigState::Homing);
                bench.step();
                if bench.next_tick != round && moves {
                    moved_us = bench.carriage().now / 100;
                }
            }
            assert_eq!(bench.state(), RigState::Ready);
            // The third of these rounds presses.
            bench.next_tick = (moved_us + after_us) * 100 - 2 * CONTROL_ROUND;
            bench.sent();
            hold_down(&mut bench, 3);
            assert_eq!(bench.carriage().now / 100, moved_us + after_us);
            let ignored = rig_event(RigEvent::ButtonIgnored);
            assert_eq!(bench.sent().contains(&ignored), is_ignored);
            assert_eq!(bench.state(), state);
        }
    }

    #[test]
    fn counts_once_however_long_it_is_down() {
        let mut bench = Bench::new();
        bench.tick();
        bench.board().button = true;
        bench.ticks(3);
        assert_eq!(bench.state(), RigState::Homing);
        bench.finish();
        // The button has been down all the time: neither a stop nor a run follows.
        assert_eq!(bench.state(), RigState::Ready);
        bench.ticks(300);
        assert_eq!(bench.state(), RigState::Ready);
        bench.board().button = false;
        bench.tick();
        hold_down(&mut bench, 3);
        assert_eq!(bench.state(), RigState::Running);
        assert_eq!(bench.record().strokes, 0);
        assert_eq!(bench.status().strokes, 10, "the paper's run");
        bench.tick();
        hold_down(&mut bench, 3);
        assert_eq!(bench.state(), RigState::Stopping);
        bench.finish();
        assert_eq!(bench.record().outcome, RunOutcome::Stopped);
    }

    /// A button that sticks, or an operator who leans on it.
    #[test]
    fn that_is_down_at_the_start_has_to_be_released_first() {
        let down = |board: &mut Board| board.button = true;
        let flash = Flash::blank();
        let mut bench = Bench::start_with(flash, FRESH, ResetCause::PowerOn, down);
        bench.ticks(100);
        assert_eq!(bench.state(), RigState::Unhomed);
        bench.board().button = false;
        bench.tick();
        hold_down(&mut bench, 3);
        assert_eq!(bench.state(), RigState::Homing);
    }

    #[test]
    fn that_is_ignored_says_so() {
        let previous = Retained {
            latched: Some(EStop::Loop),
            ..FRESH
        };
        let mut bench = Bench::start(Flash::blank(), previous, ResetCause::Pin);
        bench.tick();
        bench.sent();
        hold_down(&mut bench, 3);
        assert_eq!(bench.sent(), [rig_event(RigEvent::ButtonIgnored)]);
        assert_eq!(bench.state(), RigState::Faulted);
        assert!(!bench.carriage().moving());
        // An accepted command does not.
        let mut bench = Bench::new();
        bench.tick();
        bench.sent();
        hold_down(&mut bench, 3);
        assert_eq!((bench.sent(), bench.state()), (vec![], RigState::Homing));
    }

    #[test]
    fn runs_what_the_settings_say() {
        let mut bench = Bench::homed();
        for (key, value) in [
            (SettingKey::ButtonCycles, 1),
            (SettingKey::ButtonStrokeUm, 5_000),
            (SettingKey::ButtonTotalMs, 1_000),
            (SettingKey::ButtonAccelUmS2, 200_000),
        ] {
            bench.accepted(set(key, value));
        }
        // A press sooner after the homing was meant to stop it.
        bench.ticks(100);
        hold_down(&mut bench, 3);
        // The host is silent; the run still goes on to its end.
        bench.board().silence_us = u32::MAX;
        bench.finish();
        let record = bench.record();
        assert_eq!(record.outcome, RunOutcome::Complete);
        assert_eq!((record.strokes, record.counted_edges), (2, 8_000));
        assert_eq!(record.ticks, 100_000_000);
    }
}

mod link {
    use super::*;

    const TIMEOUT_US: u32 = 200_000;

    #[test]
    fn that_is_silent_for_too_long_stops_what_moves() {
        for request in [
            run(LinkLossPolicy::Stop),
            Request::MoveTo(rig::MoveTo {
                position_um: 100_000,
                speed_um_s: 40_000,
            }),
            Request::Home(rig::Home),
        ] {
            let mut bench = Bench::homed();
            bench.accepted(set(SettingKey::LinkTimeoutMs, TIMEOUT_US / 1_000));
            bench.accepted(request);
            bench.sent();
            bench.board().silence_us = TIMEOUT_US;
            bench.ticks(2);
            assert_ne!(bench.state(), RigState::Stopping, "in time");
            assert_eq!(bench.sent(), []);
            bench.board().silence_us = TIMEOUT_US + 1;
            bench.tick();
            assert_eq!(bench.state(), RigState::Stopping);
            assert_eq!(bench.sent(), [What::LinkLost]);
            bench.finish();
            bench.ticks(10);
            let sent = bench.sent();
            assert!(!sent.contains(&What::LinkLost), "once: {sent:?}");
        }
    }

    #[test]
    fn that_is_silent_does_not_matter_at_rest_or_to_a_run_that_shall_finish() {
        let mut bench = Bench::homed();
        bench.board().silence_us = u32::MAX;
        bench.ticks(10);
        assert_eq!((bench.state(), bench.sent()), (RigState::Ready, vec![]));
        bench.accepted(run(LinkLossPolicy::Finish));
        bench.finish();
        assert_eq!(bench.record().outcome, RunOutcome::Complete);
        assert!(!bench.sent().contains(&What::LinkLost));
    }
}

mod emergency_stop {
    use super::*;

    fn faulted(fault: RigFault) -> What {
        rig_event(RigEvent::Faulted(fault))
    }

    /// The interrupt is enabled only while pulses are armed. At rest, control polls the input.
    #[test]
    fn by_the_loop_at_rest_is_latched() {
        let mut bench = Bench::homed();
        bench.carriage().pressed = true;
        bench.ticks(5);
        assert_eq!(bench.state(), RigState::Faulted);
        let fault = RigFault::EStopLoop;
        assert_eq!(bench.sent(), [faulted(fault)], "once");
        assert_eq!(bench.board().latched, [Some(EStop::Loop)]);
        assert_eq!(bench.board().cuts, 1);
        let acknowledge = || Request::Acknowledge(Acknowledge);
        assert_eq!(bench.refused(acknowledge()), Refusal::CauseStillPresent);
        assert_eq!(bench.board().latched, [Some(EStop::Loop)]);
        assert_eq!(bench.sent(), []);
        bench.carriage().pressed = false;
        assert_eq!(bench.accepted(acknowledge()), Response::Acknowledge(Done));
        assert_eq!(bench.board().latched, [Some(EStop::Loop), None]);
        assert_eq!(bench.sent(), [What::Acknowledged]);
        bench.ticks(5);
        assert_eq!(bench.state(), RigState::Unhomed);
    }

    #[test]
    fn by_the_loop_in_a_run_is_latched_once() {
        let mut bench = Bench::homed();
        bench.accepted(run(LinkLossPolicy::Stop));
        bench.steps_until(1_000);
        bench.sent();
        let pulses = bench.carriage().pulses;
        bench.press();
        bench.finish();
        bench.ticks(5);
        let fault = RigFault::EStopLoop;
        let (run, outcome) = (1, RunOutcome::Faulted(fault));
        let ended = rig_event(RigEvent::RunEnded { run, outcome });
        assert_eq!(bench.sent(), [ended, faulted(fault)]);
        assert_eq!(bench.board().latched, [Some(EStop::Loop)]);
        assert_eq!(bench.carriage().pulses, pulses);
        assert_eq!(bench.record().counted_edges, 1_000);
    }

    #[test]
    fn by_frame_is_latched_and_answered() {
        let mut bench = Bench::homed();
        bench.accepted(run(LinkLossPolicy::Stop));
        bench.steps_until(1_000);
        bench.sent();
        let pulses = bench.carriage().pulses;
        let reply = bench.control.answer(Inbound::Urgent(Urgent::EStop));
        assert_eq!(reply, Reply::Urgent(Urgent::EStop));
        bench.finish();
        assert_eq!(bench.carriage().pulses, pulses);
        assert_eq!(bench.status().fault, Some(RigFault::EStopFrame));
        assert_eq!(bench.board().latched, [Some(EStop::Frame)]);
        assert!(bench.sent().contains(&faulted(RigFault::EStopFrame)));
        // Each copy of the frame cuts again, but tells nothing new.
        let cuts = bench.board().cuts;
        let reply = bench.control.answer(Inbound::Urgent(Urgent::EStop));
        assert_eq!(reply, Reply::Urgent(Urgent::EStop));
        assert_eq!(bench.board().cuts, cuts + 1);
        assert_eq!(bench.sent(), []);
    }

    /// The other fault keeps its name, but only an acknowledgement undoes the stop.
    #[test]
    fn in_another_fault_is_kept_over_a_reset() {
        for (event, estop) in [
            (Event::Command(&Command::EStop), EStop::Frame),
            (Event::LoopOpened, EStop::Loop),
        ] {
            let mut bench = Bench::homed();
            bench.control.event(Event::FarLimit);
            bench.control.event(event);
            assert_eq!(bench.status().fault, Some(RigFault::FarLimit));
            assert_eq!(bench.board().latched, [None, Some(estop)]);
            bench.accepted(Request::Acknowledge(Acknowledge));
            assert_eq!(bench.board().latched, [None, Some(estop), None]);
        }
    }

    /// Pressed and released at rest, while another fault is latched.
    #[test]
    fn by_the_loop_at_rest_in_another_fault_is_kept_over_a_reset() {
        let mut bench = Bench::homed();
        bench.control.event(Event::FarLimit);
        bench.carriage().pressed = true;
        bench.ticks(5);
        assert_eq!(bench.status().fault, Some(RigFault::FarLimit));
        assert_eq!(bench.board().latched, [None, Some(EStop::Loop)], "once");
        bench.carriage().pressed = false;
        bench.ticks(5);
        assert_eq!(bench.board().latched, [None, Some(EStop::Loop)]);
    }

    /// The restart with the clock takes what the first start had left.
    #[test]
    fn without_a_clock_is_kept_over_the_restart() {
        let mut bench = Bench::start_with(Flash::blank(), FRESH, ResetCause::PowerOn, |board| {
            board.clock = system::Clock::Internal;
        });
        bench.control.answer(Inbound::Urgent(Urgent::EStop));
        assert_eq!(bench.status().fault, Some(RigFault::ClockMissing));
        bench.board().clock_has_come = true;
        bench.control.tick();
        let (previous, _) = &bench.board().restarts[0];
        assert_eq!(previous.latched, Some(EStop::Frame));
    }
}

mod requests {
    use super::*;

    #[test]
    fn carry_a_run_from_home_to_its_record() {
        let mut bench = Bench::new();
        bench.get(rig::Home);
        bench.finish();
        let started_us = bench.carriage().now / 100;
        bench.accepted(run(LinkLossPolicy::Stop));
        bench.steps_until(5_000);
        let status = bench.status();
        assert_eq!((status.stroke, status.strokes), (1, 4));
        assert_eq!(status.time_us, bench.carriage().now / 100);
        assert_eq!(status.time_us - status.elapsed_us, started_us);
        bench.get(rig::Hold);
        bench.finish();
        let status = bench.status();
        assert_eq!((status.state, status.stroke), (RigState::Held, 1));
        assert_eq!(status.time_us - status.elapsed_us, started_us);
        bench.get(rig::Resume);
        bench.finish();
        assert_eq!(bench.status().elapsed_us, 0);
        insta::assert_debug_snapshot!("events_of_a_run", bench.sent());
        insta::assert_debug_snapshot!("record_of_a_run", bench.record());
    }

    #[test]
    fn set_the_interval_of_telemetry() {
        let mut bench = Bench::new();
        bench.get(SetTelemetry { period_ms: 10 });
        assert_eq!(bench.board().telemetry_ms, [0, 10]);
        assert_eq!(bench.value(SettingKey::TelemetryMs), 0, "not in flash");
    }

    #[test]
    fn that_find_the_carriage_elsewhere_have_their_actions_carried_out() {
        let mut bench = Bench::homed();
        bench.accepted(run(LinkLossPolicy::Stop));
        bench.steps_until(1_000);
        bench.accepted(Request::Hold(rig::Hold));
        bench.finish();
        bench.sent();
        bench.carriage().ring.counted += 1;
        let commanded = bench.carriage().place;
        let counted = commanded + 1;
        let fault = RigFault::ReadBack { commanded, counted };
        let refusal = bench.refused(Request::Resume(rig::Resume));
        assert_eq!(refusal, Refusal::RigFaulted(fault));
        assert_eq!(bench.state(), RigState::Faulted);
        assert_eq!(bench.sent().len(), 2, "the end of the run, and the fault");
    }

    /// Every event is numbered, timed, told at once and kept.
    #[test]
    fn fetch_the_events_that_were_told() {
        let mut bench = Bench::new();
        bench.accepted(Request::Home(rig::Home));
        bench.finish();
        bench.carriage().pressed = true;
        bench.tick();
        let sent = bench.board().sent.clone();
        let indices: Vec<_> = sent.iter().map(|event| event.index).collect();
        assert_eq!(indices, [0, 1, 2]);
        let now_us = bench.carriage().now / 100;
        assert_eq!((sent[0].time_us, sent[2].time_us), (1_234, now_us));
        let events = bench.get(GetEvents { from: 0 });
        assert_eq!((events.oldest, events.next), (0, 3));
        assert_eq!(events.events.as_slice(), sent);
    }
}

mod health {
    use super::*;

    #[test]
    fn counts_underruns() {
        let mut bench = Bench::homed();
        bench.accepted(run(LinkLossPolicy::Stop));
        bench.steps_until(1_000);
        // Motion does not run for 20 ms.
        let until = bench.carriage().now + 2 * CONTROL_ROUND;
        while bench.carriage().now < until && bench.carriage().moving() {
            bench.carriage().next_round = until;
            bench.step();
        }
        bench.finish();
        assert_eq!(bench.status().fault, Some(RigFault::Underrun));
        assert_eq!(bench.health().underruns, 1);
        assert_eq!(bench.board().latched, [None]);
        // Other ends of a path do not count as underruns.
        let mut bench = Bench::homed();
        bench
            .control
            .event(simulated_machines::carriage::path_ended(
                PathEnd::Guard,
                0,
                0,
            ));
        assert_eq!(bench.health().underruns, 0);
    }

    #[test]
    fn is_the_boards_and_what_control_counts() {
        let mut bench = Bench::new();
        let expected = RigHealth {
            image_hash: IMAGE_HASH,
            ..COUNTED
        };
        assert_eq!(bench.health(), expected);
        assert_eq!(bench.get(GetRigHardware), HARDWARE);
    }

    /// The worst round since the start, from the clock of the start on.
    #[test]
    fn tells_how_late_control_was() {
        let mut bench = Bench::new();
        bench.ticks(10);
        assert_eq!(bench.health().control_late_us, 0);
        for (late_us, worst_us) in [(300, 300), (4_000, 4_000), (299, 4_000)] {
            let next_tick = bench.next_tick;
            bench.carriage().now = next_tick + late_us * 100;
            bench.tick();
            assert_eq!(bench.health().control_late_us, worst_us);
        }
        assert_eq!(CONTROL_ROUND, ROUND_US * 100);
    }
}

/// Without its clock the rig moves nothing, whatever was latched before. The link and the settings work.
#[test]
fn a_missing_clock_is_a_fault_that_nothing_clears() {
    let previous = Retained {
        latched: Some(EStop::Loop),
        ..FRESH
    };
    for cause in [ResetCause::PowerOn, ResetCause::Watchdog, ResetCause::Panic] {
        let mut bench = Bench::start_with(Flash::blank(), previous.clone(), cause, |board| {
            board.clock = system::Clock::Internal;
        });
        let fault = RigFault::ClockMissing;
        assert_eq!(bench.status().fault, Some(fault));
        assert_eq!(
            bench.refused(Request::Home(rig::Home)),
            Refusal::RigFaulted(fault)
        );
        assert_eq!(
            bench.refused(Request::Acknowledge(Acknowledge)),
            Refusal::CauseStillPresent
        );
        bench.accepted(Request::SetTelemetry(SetTelemetry { period_ms: 5 }));
    }
}

/// The missing clock comes: the rig resets once, and passes on everything that this start was left. The state of
/// another clock causes no reset.
#[test]
fn a_clock_that_comes_starts_the_rig_again() {
    let previous = Retained {
        clock_failed: true,
        ..FRESH
    };
    for (clock, fault) in [
        (system::Clock::Internal, RigFault::ClockMissing),
        (system::Clock::External, RigFault::ClockFailed),
    ] {
        let cause = ResetCause::Software;
        let mut bench = Bench::start_with(Flash::blank(), previous.clone(), cause, |board| {
            board.clock = clock;
        });
        bench.control.tick();
        assert_eq!(bench.status().fault, Some(fault));
        assert_eq!(bench.board().restarts, []);
        bench.board().clock_has_come = true;
        bench.control.tick();
        let again = match clock {
            system::Clock::Internal => vec![(previous.clone(), cause)],
            system::Clock::External => vec![],
        };
        assert_eq!(bench.board().restarts, again);
    }
}

/// After the restart, a stopped clock is reported, unless a worse fault is. Then the rig works again.
#[test]
fn a_clock_that_failed_is_acknowledged() {
    let previous = Retained {
        clock_failed: true,
        ..FRESH
    };
    let mut bench = Bench::start(Flash::blank(), previous.clone(), ResetCause::Software);
    assert_eq!(bench.status().fault, Some(RigFault::ClockFailed));
    bench.accepted(Request::Acknowledge(Acknowledge));
    assert_eq!(bench.state(), RigState::Unhomed);
    let previous = Retained {
        latched: Some(EStop::Frame),
        ..previous
    };
    let mut bench = Bench::start(Flash::blank(), previous, ResetCause::Software);
    assert_eq!(bench.status().fault, Some(RigFault::EStopFrame));
}
