//! Requests to replies: the only place where the protocol's messages meet the state machine.

use crate::fold::{Actions, Capsule, Command, Drive, Event};
use device::common::{About, asked_telemetry_ms};
use protocol::{
    capsule::{ActuationAccepted, ActuationKind, CapsuleFault, CapsuleStatus, CapsuleTelemetry},
    error::Refusal,
    system::{Done, Urgent},
    table::{Reply, Request, Response},
};

/// What a request may need to know.
pub struct Context<'a> {
    /// Device time.
    pub now_us: u64,
    /// What common requests are answered from.
    pub about: About<'a>,
}

/// What the caller has to do besides the machine's actions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effect {
    /// Nothing.
    None,
    /// Change the interval of telemetry.
    Telemetry {
        /// In ms; 0 = none.
        period_ms: u16,
    },
    /// Record that a fault was acknowledged.
    Acknowledged,
}

/// Outcome of a request.
#[derive(Clone, Debug, PartialEq)]
pub struct Executed {
    /// Answer for the host.
    pub reply: Reply,
    /// What the machine wants done; `None` after a query.
    pub actions: Option<Actions>,
    /// What else the caller has to do.
    pub effect: Effect,
}

/// Carries out one request.
pub fn execute(request: Request, capsule: &mut Capsule, context: &Context<'_>) -> Executed {
    let command = match request {
        Request::Reference(_) => Command::Reference,
        Request::Fold(_) => Command::Fold,
        Request::Unfold(_) => Command::Unfold,
        Request::Acknowledge(_) => Command::Acknowledge,
        query => return answer(query, capsule, context),
    };
    let actions = capsule.step(context.now_us, Event::Command(command));
    let accepted = |kind| ActuationAccepted {
        actuation: capsule.record().actuation,
        timeout_ms: Capsule::timeout_ms(kind),
    };
    let reply = match (actions.refusal, command) {
        (Some(refusal), _) => Reply::Refused(refusal),
        (None, Command::Reference) => {
            Reply::Accepted(Response::Reference(accepted(ActuationKind::Reference)))
        }
        (None, Command::Fold) => Reply::Accepted(Response::Fold(accepted(ActuationKind::Fold))),
        (None, Command::Unfold) => {
            Reply::Accepted(Response::Unfold(accepted(ActuationKind::Unfold)))
        }
        (None, _) => Reply::Accepted(Response::Acknowledge(Done)),
    };
    let effect = match command {
        Command::Acknowledge if actions.refusal.is_none() => Effect::Acknowledged,
        _ => Effect::None,
    };
    Executed {
        reply,
        actions: Some(actions),
        effect,
    }
}

fn answer(query: Request, capsule: &Capsule, context: &Context<'_>) -> Executed {
    let (reply, effect) = match respond(query, capsule, context) {
        Ok((response, effect)) => (Reply::Accepted(response), effect),
        Err(refusal) => (Reply::Refused(refusal), Effect::None),
    };
    Executed {
        reply,
        actions: None,
        effect,
    }
}

#[inline(never)]
fn respond(
    query: Request,
    capsule: &Capsule,
    context: &Context<'_>,
) -> Result<(Response, Effect), Refusal> {
    if let Some(response) = context.about.answer(&query)? {
        let effect = asked_telemetry_ms(&response)
            .map_or(Effect::None, |period_ms| Effect::Telemetry { period_ms });
        return Ok((response, effect));
    }
    let response = match query {
        Request::GetCapsuleStatus(_) => Response::GetCapsuleStatus(status(capsule, context.now_us)),
        Request::GetActuationRecord(_) => Response::GetActuationRecord(*capsule.record()),
        // The rig's; the others have been answered above, and a Hello by the session.
        _ => return Err(Refusal::WrongDevice),
    };
    Ok((response, Effect::None))
}

/// Carries out an urgent stop.
pub fn urgent(urgent: Urgent, capsule: &mut Capsule, now_us: u64) -> Actions {
    let command = match urgent {
        Urgent::Stop => Command::Stop,
        Urgent::EStop => Command::EStop,
    };
    capsule.step(now_us, Event::Command(command))
}

fn status(capsule: &Capsule, time_us: u64) -> CapsuleStatus {
    CapsuleStatus {
        time_us,
        state: capsule.state(),
        fault: capsule.fault(),
        referenced: capsule.referenced(),
        thread_um: capsule.thread().0,
        current_ma: capsule.sample().current_ma,
        battery_mv: capsule.sample().battery_mv,
        actuation: capsule.record().actuation,
        needs_acknowledge: matches!(
            capsule.fault(),
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
        current_ma: capsule.sample().current_ma,
        battery_mv: capsule.sample().battery_mv,
        drive_mv: match capsule.drive() {
            Drive::Millivolts(millivolts) => millivolts,
            Drive::Off | Drive::Brake => 0,
        },
    }
}
