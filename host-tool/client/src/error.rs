//! Errors of requests to a machine: of the link, of the wire, or the device's own refusal.

use std::fmt;

use miette::Diagnostic;
use protocol::VERSION;
use protocol::error::{Refusal, WireError};
use protocol::rig::RigFault;
use protocol::system::{DeviceKind, Identity};
use protocol::table::{Impact, SCHEMA_KEY};

use crate::diagnosis::Sign;
use crate::exit::{FAULT, MISMATCH, NO_DEVICE, REFUSED, STOPPED, UNKNOWN};
use crate::identity::{self, kind_name};
use crate::link::LinkError;
use crate::link::owner::Owner;
use crate::wording;

/// The reason why a request failed. `place` is the machine's place, as the user named it.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    Link(#[from] LinkError),
    /// No machine answered Hello.
    NoAnswer {
        place: String,
        sign: Sign,
    },
    /// The machine is of another kind, or uses another protocol; only identity, last words and stops work then.
    WrongMachine {
        place: String,
        wanted: DeviceKind,
        found: Box<Identity>,
    },
    /// The device understood the request and refused it; nothing moved, nothing changed.
    Refused {
        place: String,
        request: &'static str,
        /// The effect that the request would have had.
        impact: Impact,
        refusal: Refusal,
    },
    /// The device could not use the request, so nothing moved; or, without `error`, this tool could not use the
    /// response.
    NotUnderstood {
        place: String,
        request: &'static str,
        error: Option<WireError>,
    },
    /// The device no longer accepts the session.
    SessionLost {
        place: String,
    },
    /// Another process owns the line: the request is for the owner alone or, if `busy`, the owner has not passed it on.
    Owned {
        place: String,
        request: &'static str,
        owner: Box<Owner>,
        busy: bool,
    },
    Unanswered {
        place: String,
        /// The request, or the action that was waited for.
        request: &'static str,
        missing: Missing,
    },
    /// The operator stopped the machine before or while a command was sent.
    Interrupted {
        request: &'static str,
    },
    /// An action did not end within this time from its acceptance, and was stopped.
    Overdue {
        place: String,
        action: &'static str,
        limit_ms: u64,
    },
    /// Homing ended without a position: by a fault, because the rig did not hear this tool, or by a stop.
    NotHomed {
        fault: Option<RigFault>,
        link_lost: bool,
    },
}

/// Consequence of a missing answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Missing {
    /// The unanswered request changes nothing.
    Reply,
    /// Something was moving when the link fell silent.
    End,
    /// A command may or may not have been carried out.
    Outcome,
    /// An urgent stop may not have arrived.
    Stop,
    /// The machine has since begun run `last`, so it no longer has the record of `run`.
    Record { run: u32, last: u32 },
}

/// Warning when the state of the machine is unknown.
const MAY_MOVE: &str = ": it MAY BE MOVING";

/// One row of the table of errors.
struct Row {
    code: &'static str,
    exit: u8,
    text: String,
    help: String,
}

impl ClientError {
    /// The table of errors: code for programs, exit code, text and remedy.
    fn row(&self) -> Row {
        let (code, exit, text, help) = match self {
            Self::Link(link) => ("link_lost", NO_DEVICE, link.to_string(), link.remedy()),
            Self::NoAnswer { place, sign } => (
                "no_answer",
                NO_DEVICE,
                format!("no answer from {place}: {sign}"),
                sign.remedy(),
            ),
            Self::WrongMachine {
                place,
                wanted,
                found,
            } => return wrong_machine(place, *wanted, found),
            Self::Refused {
                place,
                request,
                impact,
                refusal,
            } => (
                "refused",
                REFUSED,
                format!("{place} refused {request}: {}", wording::refusal(refusal)),
                match impact {
                    Impact::Flash => "nothing was changed",
                    // Other requests of the same command may have moved something.
                    _ => "nothing was moved by this request",
                },
            ),
            Self::NotUnderstood {
                place,
                request,
                error: Some(error),
            } => (
                "rejected",
                REFUSED,
                format!("{place} could not use {request}: {error}"),
                "nothing was moved by this request",
            ),
            Self::NotUnderstood { place, request, .. } => (
                "wrong_response",
                UNKNOWN,
                format!("{place} answered {request} with another request's response"),
                "host tool and firmware differ although their schema keys agree: report this",
            ),
            Self::SessionLost { place } => (
                "session_lost",
                NO_DEVICE,
                format!(
                    "{place} no longer knows this session: it was reset, or another program took it over"
                ),
                "a reset stops every motion and nothing starts again by itself; `retrograde info` shows the cause of the last start",
            ),
            Self::Owned {
                place,
                request,
                owner,
                busy: false,
            } => (
                "owned",
                REFUSED,
                format!("{request} was not sent: {place} belongs to {owner}"),
                "wait until it is done (`serve` and `watch` then give the line up), or end it with Ctrl-C in its terminal; meanwhile `watch`, `info`, `health`, `settings list`, `hold`, `resume`, `ack`, `stop` and `estop` work from here",
            ),
            Self::Owned {
                place,
                request,
                owner,
                ..
            } => (
                "owner_busy",
                NO_DEVICE,
                format!("{place} belongs to {owner}, which has not passed {request} on"),
                "it is busy, or waits for an answer at its terminal: try again. `stop` and `estop` do not wait for it",
            ),
            Self::Unanswered {
                place,
                request,
                missing,
            } => return unanswered(place, request, *missing),
            Self::Interrupted { request } => (
                "interrupted",
                STOPPED,
                format!("stopped by the operator; {request} was not sent, or not repeated"),
                "nothing moves once the stop is confirmed; `retrograde info` shows where the machine is",
            ),
            Self::Overdue {
                place,
                action,
                limit_ms,
            } => (
                "overdue",
                FAULT,
                format!("{action} on {place} did not end within {limit_ms} ms; a stop was sent"),
                "look at the machine and at `retrograde info`",
            ),
            Self::NotHomed { fault, link_lost } => {
                let (exit, why) = match (fault, link_lost) {
                    (Some(fault), _) => (FAULT, fault.to_string()),
                    (None, true) => (
                        FAULT,
                        "the rig had not heard from this tool for too long; home again".to_owned(),
                    ),
                    (None, false) => (STOPPED, "it was stopped; home again".to_owned()),
                };
                (
                    "not_homed",
                    exit,
                    format!("homing did not find the position: {why}"),
                    "look at the rig; once the cause is removed `retrograde ack rig`, then `retrograde home`; docs/rig.md has each fault",
                )
            }
        };
        Row {
            code,
            exit,
            text,
            help: help.to_owned(),
        }
    }

    /// The exit code of a command that fails like this.
    #[must_use]
    pub fn exit_code(&self) -> u8 {
        self.row().exit
    }

    /// Whether the request was not carried out, with certainty.
    #[must_use]
    pub const fn is_refusal(&self) -> bool {
        matches!(
            self,
            Self::Refused { .. }
                | Self::NotUnderstood { error: Some(_), .. }
                | Self::Owned { busy: false, .. }
        )
    }

    /// The error in words for a record that is read later, when the machine no longer moves.
    #[must_use]
    pub fn in_record(&self) -> String {
        self.to_string().replace(MAY_MOVE, "")
    }

    /// Whether the machine may be moving: it has not confirmed a stop, or fell silent during a motion.
    #[must_use]
    pub const fn may_move(&self) -> bool {
        matches!(
            self,
            Self::Unanswered {
                missing: Missing::Stop | Missing::End,
                ..
            } | Self::Link(LinkError::Cut { .. })
        )
    }

    /// Whether the owner of the line has ended or given it up, so that the line is free.
    #[must_use]
    pub const fn is_owner_gone(&self) -> bool {
        matches!(self, Self::Link(LinkError::OwnerGone { .. }))
    }
}

impl fmt::Display for ClientError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.row().text)
    }
}

impl Diagnostic for ClientError {
    fn code<'a>(&'a self) -> Option<Box<dyn fmt::Display + 'a>> {
        Some(Box::new(format!("retrograde::{}", self.row().code)))
    }

    fn help<'a>(&'a self) -> Option<Box<dyn fmt::Display + 'a>> {
        Some(Box::new(self.row().help))
    }
}

fn wrong_machine(place: &str, wanted: DeviceKind, found: &Identity) -> Row {
    let name = kind_name(found.device);
    if found.device != wanted {
        return Row {
            code: "wrong_device",
            exit: NO_DEVICE,
            text: format!(
                "{place} is a {name}, not a {}; nothing was moved",
                kind_name(wanted)
            ),
            help: format!(
                "there is: {}\nexchange `--rig` and `--capsule`, or choose from `retrograde doctor`",
                identity::line(found)
            ),
        };
    }
    let remedy = if found.protocol.major > VERSION.major {
        "use the host tool that was built with this firmware".to_owned()
    } else {
        format!(
            "flash the matching firmware (`cargo {name}` in this tool's workspace, or `firmware-{name}.elf` of its release)"
        )
    };
    Row {
        code: "mismatch",
        exit: MISMATCH,
        text: format!(
            "{remedy}: the {name} at {place} (firmware {}) speaks protocol {}.{} with schema {:016x}, this host tool {}.{} with schema {SCHEMA_KEY:016x}",
            identity::revision(&found.revision),
            found.protocol.major,
            found.protocol.minor,
            found.schema_key,
            VERSION.major,
            VERSION.minor,
        ),
        help: "until then `info`, `stop` and `estop` work, and nothing else is sent".to_owned(),
    }
}

fn unanswered(place: &str, request: &str, missing: Missing) -> Row {
    let (code, exit, text, help) = match missing {
        Missing::Reply => (
            "no_reply",
            NO_DEVICE,
            format!("{place} did not answer a question ({request}); asking moves nothing"),
            "check that the machine has stopped; check cable and supply, then try again",
        ),
        Missing::End => (
            "silent",
            UNKNOWN,
            format!("{place} has fallen silent during {request}{MAY_MOVE}"),
            "press the emergency stop button or cut the motor supply if it moves; then check cable and supply, and look at `retrograde info`. A rig that has lost its host stops by itself within its `link_timeout_ms` (1 s), unless the run was started with `--on-link-loss finish`",
        ),
        Missing::Outcome => (
            "outcome_unknown",
            UNKNOWN,
            format!(
                "outcome unknown: {place} did not answer {request}, which may or may not have been carried out"
            ),
            "look at the machine and at `retrograde info` before trying again; use the emergency stop if it moves",
        ),
        Missing::Stop => (
            "stop_unconfirmed",
            UNKNOWN,
            format!("{place} did not confirm the stop"),
            "press the emergency stop button or cut the motor supply NOW; then check cable and supply",
        ),
        Missing::Record { run, last } => (
            "record_gone",
            UNKNOWN,
            format!(
                "{place} has the record of run {last}: the record and outcome of run {run} are lost"
            ),
            "somebody has pressed the start button since: this program was suspended, or the link was lost; `retrograde info` shows what the rig does now",
        ),
    };
    Row {
        code,
        exit,
        text,
        help: help.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression: a ledger said for ever that the carriage may still be moving.
    #[test]
    fn a_record_does_not_keep_the_alarm() {
        let error = ClientError::Unanswered {
            place: "the rig".to_owned(),
            request: "the run",
            missing: Missing::End,
        };
        assert!(error.may_move() && error.to_string().ends_with("the run: it MAY BE MOVING"));
        let kept = "the rig has fallen silent during the run";
        assert_eq!(error.in_record(), kept);
    }
}
