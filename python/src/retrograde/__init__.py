"""The rig and the capsule from Python, over `retrograde serve`.

    import retrograde

    with retrograde.connect() as lab:
        lab.rig.home()
        record = lab.rig.run(cycles=5, stroke_mm=130, duration_s=40)
        print(record["counted_edges"], "steps")
        lab.capsule.fold()

Needs Python 3.9 and nothing else. `retrograde.bluesky` has devices for bluesky's RunEngine.

This is not a safety function: a hard-wired switch in the motor supply is required.
"""

from .client import Action, Capsule, Jog, Lab, Rig, connect
from .errors import (
    Denied,
    Faulted,
    LinkLost,
    Mismatch,
    NoMachine,
    NoServer,
    NotStopped,
    OutcomeUnknown,
    Refused,
    RetrogradeError,
    Stopped,
    WrongRequest,
)
from .stream import Message, Stream

__all__ = [
    "Action",
    "Capsule",
    "Denied",
    "Faulted",
    "Jog",
    "Lab",
    "LinkLost",
    "Message",
    "Mismatch",
    "NoMachine",
    "NoServer",
    "NotStopped",
    "OutcomeUnknown",
    "Refused",
    "RetrogradeError",
    "Rig",
    "Stopped",
    "Stream",
    "WrongRequest",
    "connect",
]
