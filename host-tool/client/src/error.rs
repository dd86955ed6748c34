//! Errors of requests to a machine: of the link, of the wire, or the device's own refusal.

use miette::Diagnostic;
use protocol::VERSION;
use protocol::error::{Refusal, WireError};
use protocol::rig::RigFault;
use protocol::system::{DeviceKind, Identity};
use protocol::table::{Impact, SCHEMA_KEY};

use crate::diagnosis::Sign;
use crate::identity;
use crate::last_seen::{self, LastSeen};
use crate::link::LinkError;
use crate::link::owner::Owner;
use crate::wording;

/// The reason why a request failed.
#[derive(Debug, thiserror::Error, Diagnostic)]
pub enum ClientError {
    /// The link failed.
    #[error(transparent)]
    #[diagnostic(
        code(retrograde::link_lost),
        help("{}", .0.remedy())
    )]
    Link(#[from] LinkError),

    /// The link failed while something moved, or after an order to move was sent.
    #[error("{link}{}", last_seen::or_moving(seen.as_ref()))]
    #[diagnostic(
        code(retrograde::link_lost),
        help(
            "press the emergency stop button or cut the motor supply if it moves; then check cable and supply"
        )
    )]
    Cut {
        /// The link's own error.
        link: LinkError,
        /// Where the carriage was last seen; none for a capsule.
        seen: Option<LastSeen>,
    },

    /// Nothing answered Hello.
    #[error("no answer from {place}: {sign}")]
    #[diagnostic(code(retrograde::no_answer), help("{}", sign.remedy()))]
    NoAnswer {
        /// The machine's place, as the user named it.
        place: String,
        /// The presumed kind of the other end.
        sign: Sign,
    },

    /// The machine at this place is not the wanted one.
    #[error("{place} is a {found}, not a {wanted}; nothing was moved", found = identity::kind_name(found.device), wanted = identity::kind_name(*wanted))]
    #[diagnostic(
        code(retrograde::wrong_device),
        help(
            "there is: {}\nexchange `--rig` and `--capsule`, or choose from `retrograde devices`",
            identity::line(found)
        )
    )]
    WrongDevice {
        /// The machine's place, as the user named it.
        place: String,
        /// The wanted machine.
        wanted: DeviceKind,
        /// The machine that answered.
        found: Box<Identity>,
    },

    /// Both ends were built from different protocols: only identity, last words and stops work.
    #[error("{}", mismatch_text(place, found))]
    #[diagnostic(
        code(retrograde::mismatch),
        help("until then `info`, `stop` and `estop` work, and nothing else is sent")
    )]
    Mismatch {
        /// The machine's place, as the user named it.
        place: String,
        /// The machine that answered.
        found: Box<Identity>,
    },

    /// The device understood the request and refused it; nothing moved, nothing changed.
    #[error("{place} refused {request}: {}", wording::refusal(refusal))]
    #[diagnostic(code(retrograde::refused), help("{}", unharmed(*impact)))]
    Refused {
        /// The machine's place, as the user named it.
        place: String,
        /// Name of the request.
        request: &'static str,
        /// The effect that the request would have had.
        impact: Impact,
        /// The device's reason.
        refusal: Refusal,
    },

    /// The device could not use the request; nothing moved.
    #[error("{place} could not use {request}: {error}")]
    #[diagnostic(code(retrograde::rejected), help("nothing was moved by this request"))]
    Rejected {
        /// The machine's place, as the user named it.
        place: String,
        /// Name of the request.
        request: &'static str,
        /// The device's reason.
        error: WireError,
    },

    /// The device no longer accepts the session.
    #[error(
        "{place} no longer knows this session: it was reset, or another program took it over{}",
        last_seen::after(seen.as_ref())
    )]
    #[diagnostic(
        code(retrograde::session_lost),
        help(
            "a reset stops every motion and nothing starts again by itself; `retrograde info` shows the cause of the last start"
        )
    )]
    SessionLost {
        /// The machine's place, as the user named it.
        place: String,
        /// Where the carriage was last; none if nothing moved.
        seen: Option<LastSeen>,
    },

    /// Another process owns the line, and this request is for the owner alone.
    #[error("{request} was not sent: {place} belongs to {owner}")]
    #[diagnostic(
        code(retrograde::owned),
        help(
            "wait until it is done (`serve` and `watch` then give the line up), or end it with Ctrl-C in its terminal; meanwhile `watch`, `info`, `health`, `settings list`, `hold`, `resume`, `ack`, `stop` and `estop` work from here"
        )
    )]
    Owned {
        /// The machine's place, as the user named it.
        place: String,
        /// Name of the request.
        request: &'static str,
        /// The process.
        owner: Box<Owner>,
    },

    /// The owner of the line did not pass a question on.
    #[error("{place} belongs to {owner}, which has not passed {request} on")]
    #[diagnostic(
        code(retrograde::owner_busy),
        help(
            "it is busy, or waits for somebody at its terminal: try again. `stop` and `estop` do not wait for it"
        )
    )]
    OwnerBusy {
        /// The machine's place, as the user named it.
        place: String,
        /// Name of the request.
        request: &'static str,
        /// The process.
        owner: String,
    },

    /// A request that changes nothing was not answered.
    #[error("{place} did not answer a question ({request}); asking moves nothing")]
    #[diagnostic(
        code(retrograde::no_reply),
        help("look whether the machine stands; check cable and supply, then try again")
    )]
    NoReply {
        /// The machine's place, as the user named it.
        place: String,
        /// Name of the request.
        request: &'static str,
        /// Where the carriage was last seen, for callers that know that something may be moving.
        seen: Option<LastSeen>,
    },

    /// The link fell silent while something moved.
    #[error(
        "{place} has fallen silent during {action}: it MAY BE MOVING{}",
        last_seen::after(seen.as_ref())
    )]
    #[diagnostic(
        code(retrograde::silent),
        help(
            "press the emergency stop button or cut the motor supply if it moves; then check cable and supply, and look at `retrograde info`. A rig that has lost its host stops by itself within its `link_timeout_ms` (1 s), unless the run was started with `--on-link-loss finish`"
        )
    )]
    Silent {
        /// The machine's place, as the user named it.
        place: String,
        /// Name of the action.
        action: &'static str,
        /// Where the carriage was last; none for a capsule.
        seen: Option<LastSeen>,
    },

    /// A command was not answered: it may or may not have been carried out.
    #[error(
        "outcome unknown: {place} did not answer {request}, which may or may not have been carried out{}",
        last_seen::after(seen.as_ref())
    )]
    #[diagnostic(
        code(retrograde::outcome_unknown),
        help(
            "look at the machine and at `retrograde info` before trying again; use the emergency stop if it moves"
        )
    )]
    OutcomeUnknown {
        /// The machine's place, as the user named it.
        place: String,
        /// Name of the request.
        request: &'static str,
        /// Where the carriage was last; none if nothing can have moved.
        seen: Option<LastSeen>,
    },

    /// An urgent stop was not answered.
    #[error("{place} did not confirm the stop{}", last_seen::after(seen.as_ref()))]
    #[diagnostic(
        code(retrograde::stop_unconfirmed),
        help(
            "press the emergency stop button or cut the motor supply NOW; then check cable and supply"
        )
    )]
    StopUnconfirmed {
        /// The machine's place, as the user named it.
        place: String,
        /// Where the carriage was last; none if nothing moved.
        seen: Option<LastSeen>,
    },

    /// The operator stopped the machine before or while a command was sent.
    #[error("stopped by the operator; {request} was not sent, or not repeated")]
    #[diagnostic(
        code(retrograde::interrupted),
        help(
            "nothing moves once the stop is confirmed; `retrograde info` shows where the machine is"
        )
    )]
    Interrupted {
        /// Name of the request.
        request: &'static str,
    },

    /// The device answered with another request's response.
    #[error("{place} answered {request} with another request's response")]
    #[diagnostic(
        code(retrograde::wrong_response),
        help("host tool and firmware differ although their schema keys agree: report this")
    )]
    WrongResponse {
        /// The machine's place, as the user named it.
        place: String,
        /// Name of the request.
        request: &'static str,
    },

    /// An action did not end in time and was stopped.
    #[error(
        "{action} on {place} did not end within {limit_ms} ms; a stop was sent{}",
        last_seen::after(seen.as_ref())
    )]
    #[diagnostic(
        code(retrograde::overdue),
        help("look at the machine and at `retrograde info`")
    )]
    Overdue {
        /// The machine's place, as the user named it.
        place: String,
        /// Name of the action.
        action: &'static str,
        /// Time limit from its acceptance, ms.
        limit_ms: u64,
        /// Where the carriage was last; none for a capsule.
        seen: Option<LastSeen>,
    },

    /// The machine has begun another run since, so it no longer has the record of this one.
    #[error(
        "{place} has the record of run {last}: that of run {run} is gone, and so is its outcome"
    )]
    #[diagnostic(
        code(retrograde::record_gone),
        help(
            "somebody has pressed the start button since: this program was suspended, or the link was lost; `retrograde info` shows what the rig does now"
        )
    )]
    RecordGone {
        /// The machine's place, as the user named it.
        place: String,
        /// The run that was waited for.
        run: u32,
        /// The run of the record that the machine has.
        last: u32,
    },

    /// Homing ended without a position.
    #[error("homing did not find the position: {}", homing_failure(*fault, *link_lost))]
    #[diagnostic(
        code(retrograde::not_homed),
        help(
            "look at the rig; once the cause is gone `retrograde ack rig`, then `retrograde home`; docs/rig.md has each fault"
        )
    )]
    NotHomed {
        /// The latched fault; none if homing was stopped.
        fault: Option<RigFault>,
        /// The rig stopped because it had not heard from this tool.
        link_lost: bool,
    },
}

impl ClientError {
    /// Whether the request was not carried out, with certainty.
    #[must_use]
    pub const fn is_refusal(&self) -> bool {
        matches!(
            self,
            Self::Refused { .. } | Self::Rejected { .. } | Self::Owned { .. }
        )
    }

    /// The error in words for a record that is read later: without statements that hold at that moment only, and
    /// without advice.
    #[must_use]
    pub fn in_record(&self) -> String {
        let seen = match self {
            Self::Cut { seen, .. }
            | Self::SessionLost { seen, .. }
            | Self::NoReply { seen, .. }
            | Self::Silent { seen, .. }
            | Self::OutcomeUnknown { seen, .. }
            | Self::StopUnconfirmed { seen, .. }
            | Self::Overdue { seen, .. } => seen.as_ref(),
            _ => None,
        };
        let text = self.to_string().replace(last_seen::MAY_MOVE, "");
        match seen {
            Some(seen) => text.replace(&seen.to_string(), &seen.place()),
            None => text,
        }
    }

    /// The machine may be moving: it has not confirmed a stop, or is no longer heard in a motion.
    #[must_use]
    pub const fn may_move(&self) -> bool {
        matches!(
            self,
            Self::StopUnconfirmed { .. } | Self::Silent { .. } | Self::Cut { .. }
        )
    }
}

fn mismatch_text(place: &str, found: &Identity) -> String {
    let name = identity::kind_name(found.device);
    let remedy = if found.protocol.major > VERSION.major {
        "use the host tool that was built with this firmware".to_owned()
    } else {
        format!("flash the matching firmware (`cargo {name}` in this tool's workspace)")
    };
    format!(
        "{remedy}: the {name} at {place} (firmware {}) speaks protocol {}.{} with schema {:016x}, this host tool {}.{} with schema {SCHEMA_KEY:016x}",
        identity::revision(&found.revision),
        found.protocol.major,
        found.protocol.minor,
        found.schema_key,
        VERSION.major,
        VERSION.minor,
    )
}

/// The phrase for what a refused request has left unchanged.
fn unharmed(impact: Impact) -> &'static str {
    match impact {
        Impact::Flash => "nothing was changed",
        // Other requests of the same command may have moved something.
        _ => "nothing was moved by this request",
    }
}

fn homing_failure(fault: Option<RigFault>, link_lost: bool) -> String {
    match (fault, link_lost) {
        (Some(fault), _) => fault.to_string(),
        (None, true) => "the rig had not heard from this tool for too long; home again".to_owned(),
        (None, false) => "it was stopped; home again".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::last_seen::Since;

    /// Regression: a ledger said for ever that the carriage may still be moving.
    #[test]
    fn a_record_keeps_the_place_and_not_the_alarm() {
        let (at, since) = (Some((43_210, 0)), Since::Brakes { after_ms: 1_000 });
        let silent = |seen| ClientError::Silent {
            place: "the rig".to_owned(),
            action: "the run",
            seen,
        };
        let error = silent(Some(LastSeen { at, since }));
        assert!(
            error
                .to_string()
                .contains("it MAY BE MOVING; the carriage was at 43.210 mm")
        );
        assert_eq!(
            error.in_record(),
            "the rig has fallen silent during the run; the carriage was at 43.210 mm when the rig last answered"
        );
        let alone = "the rig has fallen silent during the run";
        assert_eq!(silent(None).in_record(), alone);
        let error = ClientError::StopUnconfirmed {
            place: "the rig".to_owned(),
            seen: Some(LastSeen {
                at: None,
                since: Since::Stopped,
            }),
        };
        assert_eq!(
            error.in_record(),
            "the rig did not confirm the stop; where the carriage is was not known, because the rig was not homed"
        );
        let error = ClientError::Interrupted { request: "Home" };
        assert_eq!(error.in_record(), error.to_string());
    }
}
