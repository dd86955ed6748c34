//! Executes requests: the only place where the protocol's messages meet the state machine.

use crate::{
    control::flash::Totals,
    machine::{Actions, Capsule, Command, Drive, Event},
    record::trace::Recording,
    settings::Settings,
    units::Thread,
};
use device::common::{About, Effect, Executed};
use protocol::{
    capsule::{
        ActuationAccepted, ActuationKind, CapsuleCalibration, CapsuleFault, CapsuleStatus,
        CapsuleTelemetry, CapsuleTotals,
    },
    error::Refusal,
    system::Done,
    table::{Request, Response},
};

/// The data that a request may need.
pub struct Context<'a> {
    /// Recording of the present or last motion.
    pub recording: &'a Recording,
    /// Totals kept in flash.
    pub totals: &'a Totals,
    /// The motor has stood still for long enough.
    pub rests: bool,
    /// Device time.
    pub now_us: u64,
    /// Source of the answers to the requests that both devices share.
    pub about: About<'a>,
}

/// Carries out one request. A query causes no actions.
pub fn execute(
    request: Request,
    capsule: &mut Capsule,
    context: &Context<'_>,
) -> Executed<Option<Actions>, Settings> {
    let command = match request {
        Request::Reference(_) => Command::Reference,
        Request::Calibrate(_) => Command::Calibrate,
        Request::CheckFolded(_) => Command::CheckFolded,
        Request::Fold(_) => Command::Fold,
        Request::Unfold(_) => Command::Unfold,
        Request::FoldTo(to) => Command::FoldTo(Thread(to.thread_um)),
        Request::Acknowledge(_) => Command::Acknowledge,
        query => return Executed::new(respond(query, capsule, context), None),
    };
    let actions = capsule.step(context.now_us, Event::Command(command));
    let accepted = |kind| ActuationAccepted {
        actuation: capsule.actuation(),
        timeout_ms: capsule.timeout_ms(kind),
    };
    let response = match command {
        Command::Reference => Response::Reference(accepted(ActuationKind::Reference)),
        Command::Calibrate => Response::Calibrate(accepted(ActuationKind::Calibrate)),
        Command::CheckFolded => Response::CheckFolded(accepted(ActuationKind::CheckFolded)),
        Command::Fold => Response::Fold(accepted(ActuationKind::Fold)),
        Command::Unfold => Response::Unfold(accepted(ActuationKind::Unfold)),
        Command::FoldTo(_) => Response::FoldTo(accepted(ActuationKind::FoldTo)),
        _ => Response::Acknowledge(Done),
    };
    let effect = match command {
        Command::Acknowledge => Effect::Acknowledged,
        _ => Effect::None,
    };
    let answer = actions.refusal.map_or(Ok((response, effect)), Err);
    Executed::new(answer, Some(actions))
}

#[inline(never)]
fn respond(
    query: Request,
    capsule: &Capsule,
    context: &Context<'_>,
) -> Result<(Response, Effect<Settings>), Refusal> {
    let may_change = || may_write(capsule, context);
    if let Some(answer) = (context.about).answer(&query, may_change, Settings::new)? {
        return Ok(answer);
    }
    let response = match query {
        Request::GetCapsuleStatus(_) => Response::GetCapsuleStatus(status(capsule, context.now_us)),
        Request::GetActuationRecord(_) => Response::GetActuationRecord(capsule.record()),
        Request::GetTrace(get) => Response::GetTrace(context.recording.part(&get, capsule.zero())),
        Request::GetCapsuleTotals(_) => Response::GetCapsuleTotals(totals(capsule, context.totals)),
        // Only the rig's requests are left: the others are handled above, and a Hello by the session.
        _ => return Err(Refusal::WrongDevice),
    };
    Ok((response, Effect::None))
}

/// Refuses unless the motor is at rest: the chip executes nothing while it writes its flash.
fn may_write(capsule: &Capsule, context: &Context<'_>) -> Result<(), Refusal> {
    // Check motion and bridge too: a motion may have been accepted since the last reading, and stopped.
    if capsule.is_moving() || capsule.drive != Drive::Off || !context.rests {
        return Err(Refusal::CapsuleBusy(capsule.state()));
    }
    Ok(())
}

fn totals(capsule: &Capsule, totals: &Totals) -> CapsuleTotals {
    CapsuleTotals {
        actuations: totals.actuations,
        energy_mj: totals.energy_mj,
        calibration: (capsule.known.calibration).map(|calibration| CapsuleCalibration {
            folded_um: calibration.folded.0,
            no_load_ma: calibration.no_load_ma,
            pull_ma: calibration.pull_ma,
        }),
    }
}

fn status(capsule: &Capsule, time_us: u64) -> CapsuleStatus {
    let known = &capsule.known;
    CapsuleStatus {
        time_us,
        state: capsule.state(),
        fault: capsule.fault,
        referenced: known.is_certain(),
        thread_um: capsule.thread().0,
        uncertainty_um: known.doubt.map(|doubt| doubt.0.unsigned_abs()),
        remaining_um: known.left.0.unsigned_abs(),
        current_ma: capsule.sample.magnitude_ma(),
        battery_mv: capsule.sample.battery_mv,
        actuation: capsule.actuation(),
        needs_acknowledge: matches!(
            capsule.fault,
            Some(CapsuleFault::Watchdog | CapsuleFault::Panic)
        ),
    }
}

/// A telemetry sample; `time_us` is the time of the last reading.
pub fn telemetry(capsule: &Capsule, time_us: u64) -> CapsuleTelemetry {
    CapsuleTelemetry {
        time_us,
        state: capsule.state(),
        thread_um: capsule.thread().0,
        current_ma: capsule.sample.magnitude_ma(),
        battery_mv: capsule.sample.battery_mv,
        drive_mv: match capsule.drive {
            Drive::Millivolts(millivolts) => millivolts,
            Drive::Off | Drive::Brake => 0,
        },
    }
}
