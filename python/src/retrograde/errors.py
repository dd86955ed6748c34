"""Errors of this package. Every text says what to do; `help` has the advice alone."""

from __future__ import annotations

from typing import Dict, Optional, Type


class RetrogradeError(Exception):
    """Something went wrong. The classes below say what is certain about the machine.

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
    """The server could not understand the request, or there is no such thing; nothing was done."""


class Denied(WrongRequest):
    """No token, a wrong one, or a name of the computer that the server does not know; nothing was done."""


class NoMachine(RetrogradeError):
    """The server has no connection to this machine, or too much to do at once; nothing was begun."""


class Mismatch(RetrogradeError):
    """Firmware and tool were built from different protocols: flash the board."""


class Refused(RetrogradeError):
    """The machine, or the server, refused; nothing moved. The text says why."""


class Faulted(RetrogradeError):
    """A fault ended it, and is latched: remove the cause, then `acknowledge()`."""


class Stopped(RetrogradeError):
    """Somebody stopped it: this program, the page, another command, a person."""


class LinkLost(RetrogradeError):
    """The machine no longer heard its host and stopped."""


class OutcomeUnknown(RetrogradeError):
    """It is unknown whether it was done, or how it ended: look at the machine."""


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
    """The error that an answer of the server tells."""
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
