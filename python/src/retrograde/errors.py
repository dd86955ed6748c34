"""Errors of this package. Every text includes the remedy; `help` has the remedy alone."""

from __future__ import annotations

from typing import Dict, Optional, Type


class RetrogradeError(Exception):
    """Base of all errors. The subclasses distinguish what is certain about the machine.

    `code` is the code of the command line's errors, such as `retrograde::refused`; `message` and `help` are its text.
    """

    def __init__(self, message: str, help: str = "", code: str = "") -> None:
        super().__init__(f"{message} ({help})" if help else message)
        self.message = message
        self.help = help
        self.code = code


class NoServer(RetrogradeError):
    """No `retrograde serve` answers; nothing was sent."""


class WrongRequest(RetrogradeError):
    """The request was invalid or its target does not exist; nothing was done."""


class Denied(WrongRequest):
    """The token is missing or wrong, or the server does not know the host name; nothing was done."""


class NoMachine(RetrogradeError):
    """The server has no connection to this machine, or is overloaded; nothing was begun."""


class Mismatch(RetrogradeError):
    """Firmware and tool use different protocols: flash the board."""


class Refused(RetrogradeError):
    """The machine or the server refused; nothing moved. The text has the reason."""


class Faulted(RetrogradeError):
    """A fault ended the action and is latched: remove the cause, then `acknowledge()`."""


class Stopped(RetrogradeError):
    """The action was stopped: by this program, the page, another command or the operator."""


class LinkLost(RetrogradeError):
    """The machine no longer heard its host and stopped."""


class OutcomeUnknown(RetrogradeError):
    """The outcome of the command is unknown: check the machine."""


class NotStopped(RetrogradeError):
    """A STOP WAS NOT CONFIRMED. Press the button, or cut the motor supply."""


# The command line's exit codes.
BY_EXIT_CODE: Dict[int, Type[RetrogradeError]] = {
    2: WrongRequest,
    3: Refused,
    4: NoMachine,
    5: Mismatch,
    6: Faulted,
    7: OutcomeUnknown,
    8: NotStopped,
    130: Stopped,
}

# States in which an action may end, other than `complete`.
BY_STATE: Dict[str, Type[RetrogradeError]] = {
    "stopped": Stopped,
    "link_lost": LinkLost,
    "faulted": Faulted,
    "refused": Refused,
    "unknown": OutcomeUnknown,
}


def of_answer(status: int, answer: Dict[str, object]) -> RetrogradeError:
    """The error in a response of the server."""
    kind: Optional[Type[RetrogradeError]] = None
    exit_code = answer.get("exit_code")
    if status in (401, 403):
        kind = Denied
    elif isinstance(exit_code, int):
        kind = BY_EXIT_CODE.get(exit_code)
    return of_error(kind or RetrogradeError, answer.get("error"), f"the server answered with status {status}")


def of_error(kind: Type[RetrogradeError], error: object, otherwise: str) -> RetrogradeError:
    """An error with the server's text."""
    if not isinstance(error, dict):
        return kind(otherwise)
    help = error.get("help")
    return kind(str(error.get("message") or otherwise), str(help) if help else "", str(error.get("code") or ""))
