//! One exemplar of every message; no field has its default value.

pub mod frames;

use heapless::Vec;
use protocol::{capsule::*, error::*, rig::*, settings::*, system::*, table::*};

/// Requests of every kind.
#[must_use]
pub fn requests() -> std::vec::Vec<Request> {
    let run = |timing| Run {
        cycles: 5,
        stroke_um: 130_000,
        timing,
        far_dwell_us: 250_000,
        home_dwell_us: 125_000,
        start_delay_us: 1_000_000,
        link_loss: LinkLossPolicy::Finish,
    };
    vec![
        Request::Hello(Hello {
            protocol: Version { major: 1, minor: 2 },
            schema_key: 0x0123_4567_89ab_cdef,
            nonce: 77,
        }),
        Request::KeepAlive(KeepAlive),
        Request::GetLastWords(GetLastWords),
        Request::SetTelemetry(SetTelemetry { period_ms: 10 }),
        Request::GetEvents(GetEvents { from: 300 }),
        Request::Acknowledge(Acknowledge),
        Request::GetRigStatus(GetRigStatus),
        Request::Home(Home),
        Request::Run(run(RunTiming::Total {
            total_us: 40_000_000,
            accel_um_s2: 100_000,
        })),
        Request::Run(run(RunTiming::Speeds {
            forward_um_s: 10_000,
            return_um_s: 30_000,
            accel_um_s2: 100_000,
        })),
        Request::GetRunRecord(GetRunRecord),
        Request::GetCapsuleStatus(GetCapsuleStatus),
        Request::Reference(Reference),
        Request::Fold(Fold),
        Request::Unfold(Unfold),
        Request::GetActuationRecord(GetActuationRecord),
        Request::Hold(Hold),
        Request::Resume(Resume),
        Request::Jog(Jog {
            direction: Direction::Home,
            speed_um_s: 5_000,
        }),
        Request::MoveTo(MoveTo {
            position_um: 65_000,
            speed_um_s: 20_000,
        }),
        Request::GetSetting(GetSetting {
            key: SettingKey::ButtonAccelUmS2,
        }),
        Request::SetSetting(SETTING),
        Request::FactoryReset(FactoryReset),
        Request::GetName(GetName),
        Request::SetName(lab_name()),
        Request::GetRigHealth(GetRigHealth),
        Request::GetChip(GetChip),
        Request::Calibrate(Calibrate),
        Request::CheckFolded(CheckFolded),
        Request::GetTrace(GetTrace { from: 1_300 }),
        Request::GetCapsuleTotals(GetCapsuleTotals),
        Request::FoldTo(FoldTo { thread_um: 12_345 }),
        Request::GetRigHardware(GetRigHardware),
    ]
}

/// Values with the longest encoding.
const TRACE_POINT: TracePoint = TracePoint {
    thread_um: -21_000_000,
    current_ma: u16::MAX,
    battery_mv: 4_550,
    drive_mv: -5_120,
};

const SETTING: Setting = Setting {
    key: SettingKey::SwitchFilterUs,
    value: 18,
};

fn lab_name() -> Name {
    Name {
        name: "rig 2, room B.17".try_into().unwrap(),
    }
}

const INPUTS: RigInputs = RigInputs {
    home_flag: true,
    far_limit: false,
    estop_loop: true,
};

/// Events of every kind.
#[must_use]
pub fn events() -> std::vec::Vec<Event> {
    let rig = [
        RigEvent::Homed {
            repeat_steps: -1,
            shift_steps: 2,
        },
        RigEvent::RunStarted { run: 3 },
        RigEvent::StrokeDone {
            stroke: 9,
            residual_steps: -2,
        },
        RigEvent::RunEnded {
            run: 3,
            outcome: RunOutcome::Complete,
        },
        RigEvent::Stopped {
            position_steps: 52_000,
        },
        RigEvent::Faulted(RigFault::LostSteps { residual_steps: 64 }),
        RigEvent::Held {
            position_steps: 40_000,
        },
        RigEvent::Resumed,
        RigEvent::Moved {
            position_steps: 52_000,
        },
        RigEvent::SettingChanged(SettingKey::SwitchFilterUs),
        RigEvent::SettingsReset,
        RigEvent::SettingsUnusable,
        RigEvent::ButtonIgnored,
        RigEvent::Faulted(RigFault::HomingTimeout(HomingPhase::Seek)),
    ];
    let capsule = [
        CapsuleEvent::Started {
            actuation: 4,
            kind: ActuationKind::Unfold,
        },
        CapsuleEvent::Ended {
            actuation: 4,
            outcome: ActuationOutcome::Stopped,
        },
        CapsuleEvent::Faulted(CapsuleFault::Jam { thread_um: 12_000 }),
        CapsuleEvent::StorageFailed,
        CapsuleEvent::SettingChanged(SettingKey::EndForceMa),
        CapsuleEvent::SettingsReset,
        CapsuleEvent::SettingsUnusable,
    ];
    let both = [
        What::Booted(ResetCause::Watchdog),
        What::Acknowledged,
        What::LinkLost,
    ];
    (both.into_iter().chain(rig.map(What::Rig)))
        .chain(capsule.map(What::Capsule))
        .map(|what| Event {
            index: 301,
            time_us: 12_345_678,
            what,
        })
        .collect()
}

const STROKE: Stroke = Stroke {
    steps: u32::MAX,
    duration_ticks: u64::MAX,
    ramp_ticks: u64::MAX,
    peak_um_s: u32::MAX,
    accel_um_s2: u32::MAX,
};

const IDENTITY: Identity = Identity {
    device: DeviceKind::Capsule,
    protocol: Version { major: 1, minor: 2 },
    schema_key: 0x0123_4567_89ab_cdef,
    uid: [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12],
    revision: Revision {
        commit: 0xdead_beef,
        dirty: true,
    },
    profile: BuildProfile::Firmware,
    boot_id: 17,
    reset_cause: ResetCause::Pin,
    session: 18,
};

const RIG_STATUS: RigStatus = RigStatus {
    time_us: 12_345_678,
    state: RigState::Faulted,
    fault: Some(RigFault::ReadBack {
        commanded: -104_000,
        counted: 7,
    }),
    homed: true,
    position_steps: 104_000,
    position_um: 130_000,
    stroke_um: 130_000,
    steps_per_rev: 3_200,
    lead_um: 4_000,
    inputs: INPUTS,
    run: 3,
    stroke: 9,
    strokes: 10,
    elapsed_us: 39_999_999,
    needs_acknowledge: true,
};

const RUN_RECORD: RunRecord = RunRecord {
    run: 3,
    outcome: RunOutcome::Faulted(RigFault::FlagNotFound(HomingPhase::Locate)),
    strokes: 10,
    commanded_edges: 1_040_000,
    counted_edges: 1_039_999,
    ticks: 4_000_000_000,
    plan_hash: u64::MAX,
    min_steps: -1,
    max_steps: 104_000,
    worst_residual_steps: -3,
    min_queue: Some(101),
    glitches: 5,
    holds: 1,
    image_hash: 0x811c_9dc5,
    prepared_edges: 1_040_185,
    edges_timed: 1_039_998,
    worst_interval_error_ticks: 2,
};

const CAPSULE_STATUS: CapsuleStatus = CapsuleStatus {
    time_us: 12_345_678,
    state: CapsuleState::Faulted,
    fault: Some(CapsuleFault::OverCurrent { current_ma: 900 }),
    referenced: true,
    thread_um: 21_000,
    uncertainty_um: Some(2_300),
    remaining_um: 400,
    current_ma: 160,
    battery_mv: 3_700,
    actuation: 4,
    needs_acknowledge: true,
};

const ACTUATION_RECORD: ActuationRecord = ActuationRecord {
    actuation: 3,
    kind: ActuationKind::Fold,
    outcome: ActuationOutcome::Complete,
    duration_ms: 1_550,
    thread_um: 21_200,
    end_current_ma: 160,
    peak_current_ma: 300,
    engaged_um: 1_000,
    energy_mj: 180,
    min_battery_mv: 3_600,
};

const RIG_HEALTH: RigHealth = RigHealth {
    home_flag: Glitches {
        count: 300,
        last_us: 12_345_678,
        masked: 7,
    },
    far_limit: Glitches {
        count: 2,
        last_us: 11_222_333,
        masked: 8,
    },
    uart_errors: 3,
    bad_frames: 4,
    unsent_frames: 5,
    underruns: 1,
    stack_used: 4_000,
    stack_size: 118_000,
    control_late_us: 900,
    image_hash: 0x811c_9dc5,
};

const CAPSULE_TOTALS: CapsuleTotals = CapsuleTotals {
    actuations: 1_003,
    energy_mj: 185_000,
    calibration: Some(CapsuleCalibration {
        folded_um: 21_700,
        no_load_ma: 16,
        pull_ma: 62,
    }),
};

const RIG_HARDWARE: RigHardware = RigHardware {
    intervals_exact: 190_000,
    intervals_1_tick: 1_500,
    intervals_2_ticks: 300,
    intervals_more: 4,
    lost_captures: 5,
    dma_errors: 6,
    timer_resets: 7,
    enable_high_at_start: true,
};

fn run_accepted() -> RunAccepted {
    let Request::Run(requested) = requests()[9] else {
        unreachable!()
    };
    RunAccepted {
        run: u32::MAX,
        requested: Run {
            timing: RunTiming::Total {
                total_us: u64::MAX,
                accel_um_s2: u32::MAX,
            },
            ..requested
        },
        forward: STROKE,
        back: STROKE,
        total_ticks: u64::MAX,
        edges: u64::MAX,
        plan_hash: u64::MAX,
    }
}

/// Responses of every kind.
#[must_use]
pub fn responses() -> std::vec::Vec<Response> {
    let accepted = |actuation, timeout_ms| ActuationAccepted {
        actuation,
        timeout_ms,
    };
    vec![
        Response::Hello(IDENTITY),
        Response::KeepAlive(Done),
        Response::GetLastWords(LastWords {
            text: "x".repeat(120).as_str().try_into().unwrap(),
        }),
        Response::SetTelemetry(SetTelemetry { period_ms: 10 }),
        Response::GetEvents(Events {
            oldest: 290,
            next: 303,
            events: Vec::from_slice(&events()[3..6]).unwrap(),
        }),
        Response::Acknowledge(Done),
        Response::GetRigStatus(RIG_STATUS),
        Response::Home(HomeAccepted {
            seek_um_s: 20_000,
            locate_um_s: 2_000,
            max_travel_um: 140_000,
        }),
        Response::Run(run_accepted()),
        Response::GetRunRecord(RUN_RECORD),
        Response::GetCapsuleStatus(CAPSULE_STATUS),
        Response::Reference(accepted(2, 20_000)),
        Response::Fold(accepted(3, 5_000)),
        Response::Unfold(accepted(4, 5_000)),
        Response::GetActuationRecord(ACTUATION_RECORD),
        Response::Hold(Done),
        Response::Resume(Done),
        Response::Jog(Done),
        Response::MoveTo(MoveAccepted {
            from_steps: 104_000,
            to_steps: 52_000,
            stroke: STROKE,
        }),
        Response::GetSetting(SETTING),
        Response::SetSetting(SETTING),
        Response::FactoryReset(Done),
        Response::GetName(lab_name()),
        Response::SetName(lab_name()),
        Response::GetRigHealth(RIG_HEALTH),
        Response::GetChip(Chip {
            clock: Clock::Internal,
            brown_out: BrownOut::Level3,
            supply_low: true,
            option_bytes: 0x00ff_aaed,
        }),
        Response::Calibrate(accepted(5, 16_000)),
        Response::CheckFolded(accepted(6, 16_000)),
        Response::GetTrace(Trace {
            actuation: 3,
            total: 1_790,
            points: (0..MAX_TRACE_POINTS).map(|_| TRACE_POINT).collect(),
        }),
        Response::GetCapsuleTotals(CAPSULE_TOTALS),
        Response::FoldTo(accepted(7, 8_000)),
        Response::GetRigHardware(RIG_HARDWARE),
    ]
}

/// Replies of every kind.
#[must_use]
pub fn replies() -> std::vec::Vec<Reply> {
    let refusals = [
        Refusal::WrongDevice,
        Refusal::Incompatible,
        Refusal::RigFaulted(RigFault::EStopLoop),
        Refusal::CapsuleFaulted(CapsuleFault::LowBattery { battery_mv: 2_600 }),
        Refusal::CauseStillPresent,
        Refusal::NothingToAcknowledge,
        Refusal::AcknowledgeFirst,
        Refusal::NotHomed,
        Refusal::NotReferenced,
        Refusal::RigBusy(RigState::Stopping),
        Refusal::CapsuleBusy(CapsuleState::Unfolding),
        Refusal::OutOfRange {
            field: Field::StrokeUm,
            requested: 131_000,
            min: 1,
            max: 130_000,
        },
        Refusal::TooFast {
            requested_us: 10_000_000,
            min_us: 25_000_000,
            min_accel_um_s2: 520_000,
        },
        Refusal::SpeedLimit {
            needed_um_s: 65_000,
            max_um_s: 49_000,
        },
        Refusal::StepRateLimit {
            needed_hz: 833_000,
            max_hz: 250_000,
        },
        Refusal::TooSlow,
        Refusal::NotAtHome { position_um: -5 },
        Refusal::BatteryLow {
            battery_mv: 2_900,
            min_mv: 3_000,
        },
        Refusal::AlreadyThere,
        Refusal::SettingRange {
            key: SettingKey::LeadUm,
            requested: 499,
        },
        Refusal::SettingRule {
            key: SettingKey::StepPulseNs,
            rule: SettingRule::PulseWithinStep,
        },
        Refusal::StorageFailed,
        Refusal::NothingToHold,
        Refusal::NothingToResume,
        Refusal::LoopOpen,
        Refusal::BothSwitchesOpen,
        Refusal::FarLimitOpen,
        Refusal::SupplyLow,
        Refusal::NameNotPrintable,
        Refusal::NotCalibrated,
        Refusal::UnfoldByHand,
    ];
    let wire = [
        WireError::NoSession,
        WireError::Malformed,
        WireError::SequenceReused,
        WireError::Stale,
    ];
    (responses().into_iter().map(Reply::Accepted))
        .chain(refusals.map(Reply::Refused))
        .chain(wire.map(Reply::Wire))
        .chain([Urgent::Stop, Urgent::EStop].map(Reply::Urgent))
        .collect()
}

/// Samples of every kind.
#[must_use]
pub fn telemetry() -> std::vec::Vec<Telemetry> {
    vec![
        Telemetry::Rig(RigTelemetry {
            time_us: 12_345_678,
            state: RigState::Running,
            position_steps: 52_000,
            commanded_steps: 52_120,
            speed_um_s: -35_680,
            stroke: 9,
            residual_steps: -1,
            inputs: INPUTS,
        }),
        Telemetry::Capsule(CapsuleTelemetry {
            time_us: 12_345_678,
            state: CapsuleState::Folding,
            thread_um: 18_000,
            current_ma: 87,
            battery_mv: 3_700,
            drive_mv: -1_500,
        }),
    ]
}
