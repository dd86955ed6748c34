//! Executes requests: the only place where the protocol's messages meet the state machine.

use crate::{
    control::flash::Totals,
    machine::{Actions, Capsule, Event},
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

pub struct Context<'a> {
    pub recording: &'a Recording,
    pub totals: &'a Totals,
    /// The motor has stood still for long enough.
    pub rests: bool,
    pub now_us: u64,
    /// Source of the answers to the requests that both devices share.
    pub about: About<'a>,
}

/// Carries out one request. A query causes no actions.
pub fn execute(
    request: &Request,
    capsule: &mut Capsule,
    context: &Context<'_>,
) -> Executed<Option<Actions>, Settings> {
    use ActuationKind::{Calibrate, CheckFolded, Fold, FoldTo, Reference, Unfold};
    let mut target = Thread(0);
    let (kind, response): (_, fn(_) -> _) = match request {
        Request::Reference(_) => (Reference, Response::Reference),
        Request::Calibrate(_) => (Calibrate, Response::Calibrate),
        Request::CheckFolded(_) => (CheckFolded, Response::CheckFolded),
        Request::Fold(_) => (Fold, Response::Fold),
        Request::Unfold(_) => (Unfold, Response::Unfold),
        Request::FoldTo(to) => {
            target = Thread(to.thread_um);
            (FoldTo, Response::FoldTo)
        }
        Request::Acknowledge(_) => {
            let actions = capsule.step(context.now_us, Event::Acknowledge);
            let answer = (Response::Acknowledge(Done), Effect::Acknowledged);
            return Executed::new(actions.refusal.map_or(Ok(answer), Err), Some(actions));
        }
        query => return Executed::new(respond(query, capsule, context), None),
    };
    let actions = capsule.step(context.now_us, Event::Begin(kind, target));
    let accepted = response(ActuationAccepted {
        actuation: capsule.actuation(),
        timeout_ms: capsule.settings.timeout_ms(kind),
    });
    let answer = actions.refusal.map_or(Ok((accepted, Effect::None)), Err);
    Executed::new(answer, Some(actions))
}

#[inline(never)]
fn respond(
    query: &Request,
    capsule: &Capsule,
    context: &Context<'_>,
) -> Result<(Response, Effect<Settings>), Refusal> {
    // The chip executes nothing while it writes its flash. A motion may have been accepted since the last reading, and
    // stopped, so motion and bridge are checked, too.
    let may_change = || match capsule.rests() && context.rests {
        true => Ok(()),
        false => Err(Refusal::CapsuleBusy(capsule.state())),
    };
    if let Some(answer) = (context.about).answer(query, may_change, Settings::new)? {
        return Ok(answer);
    }
    let response = match query {
        Request::GetCapsuleStatus(_) => Response::GetCapsuleStatus(status(capsule, context.now_us)),
        Request::GetActuationRecord(_) => Response::GetActuationRecord(capsule.record()),
        Request::GetTrace(get) => Response::GetTrace(context.recording.part(get, &capsule.known)),
        Request::GetCapsuleTotals(_) => Response::GetCapsuleTotals(totals(capsule, context.totals)),
        // Only the rig's requests are left: the others are handled above, and a Hello by the session.
        _ => return Err(Refusal::WrongDevice),
    };
    Ok((response, Effect::None))
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
        uncertainty_um: known.uncertainty.map(|more| more.0.unsigned_abs()),
        remaining_um: known.remaining.0.unsigned_abs(),
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
        drive_mv: capsule.drive.millivolts().unwrap_or(0),
    }
}
