//! Requests to replies: the only place where the protocol's messages meet the state machine.

use crate::fold::{Actions, Capsule, Command, Drive, Event};
use protocol::{
    capsule::{ActuationAccepted, ActuationKind, CapsuleFault, CapsuleStatus, CapsuleTelemetry},
    error::{Field, Refusal},
    events::EventRing,
    system::{Done, LastWords, SetTelemetry, Urgent},
    table::{Reply, Request, Response},
};

/// Shortest and longest telemetry interval, ms.
pub const TELEMETRY_MS: (u16, u16) = (5, 1_000);

/// What a request may read besides the machine.
pub struct Context<'a> {
    /// Device time.
    pub now_us: u64,
    /// Recorded events.
    pub ring: &'a EventRing,
    /// Text of the last panic or processor fault.
    pub last_words: &'a str,
}

/// What the caller has to do besides the machine's actions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effect {
    /// Nothing.
    None,
    /// Change the telemetry interval; 0 = off.
    Telemetry {
        /// In ms.
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
    let effect = if command == Command::Acknowledge && actions.refusal.is_none() {
        Effect::Acknowledged
    } else {
        Effect::None
    };
    Executed {
        reply,
        actions: Some(actions),
        effect,
    }
}

fn answer(query: Request, capsule: &Capsule, context: &Context<'_>) -> Executed {
    let mut effect = Effect::None;
    let response = match query {
        Request::KeepAlive(_) => Ok(Response::KeepAlive(Done)),
        Request::GetLastWords(_) => Ok(Response::GetLastWords(LastWords {
            text: context.last_words.try_into().unwrap_or_default(),
        })),
        Request::SetTelemetry(SetTelemetry { period_ms }) => {
            telemetry_interval(period_ms).map(|()| {
                effect = Effect::Telemetry { period_ms };
                Response::SetTelemetry(SetTelemetry { period_ms })
            })
        }
        Request::GetEvents(get) => Ok(Response::GetEvents(context.ring.since(get.from))),
        Request::GetCapsuleStatus(_) => {
            Ok(Response::GetCapsuleStatus(status(capsule, context.now_us)))
        }
        Request::GetActuationRecord(_) => Ok(Response::GetActuationRecord(*capsule.record())),
        // The session answers a Hello.
        Request::Hello(_)
        | Request::GetRigStatus(_)
        | Request::Home(_)
        | Request::Run(_)
        | Request::GetRunRecord(_)
        | Request::Hold(_)
        | Request::Resume(_)
        | Request::Jog(_)
        | Request::MoveTo(_)
        | Request::GetSetting(_)
        | Request::SetSetting(_)
        | Request::FactoryReset(_)
        | Request::GetName(_)
        | Request::SetName(_)
        | Request::GetRigHealth(_)
        | Request::Reference(_)
        | Request::Fold(_)
        | Request::Unfold(_)
        | Request::Acknowledge(_) => Err(Refusal::WrongDevice),
    };
    Executed {
        reply: response.map_or_else(Reply::Refused, Reply::Accepted),
        actions: None,
        effect,
    }
}

fn telemetry_interval(period_ms: u16) -> Result<(), Refusal> {
    let (min, max) = TELEMETRY_MS;
    if period_ms == 0 || (min..=max).contains(&period_ms) {
        return Ok(());
    }
    Err(Refusal::OutOfRange {
        field: Field::PeriodMs,
        requested: u64::from(period_ms),
        min: u64::from(min),
        max: u64::from(max),
    })
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
