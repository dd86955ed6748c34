"""Types of the server's answers; docs/openapi.json has them for other languages.

Units are in the names. A server may send further fields, and omits unknown values.
"""

from __future__ import annotations

from typing import Any, Dict, List, Optional, TypedDict, Union
from decimal import Decimal

# A number for a command. A float, also of numpy, is rounded to the resolution of its field; text and Decimal are sent exactly.
Number = Union[int, float, str, Decimal]


class RunOptions(TypedDict, total=False):
    """Options of a run; docs/openapi.json has the defaults."""

    cycles: Optional[Number]
    stroke_mm: Optional[Number]
    duration_s: Optional[Number]
    speed_mm_s: Optional[Number]
    return_speed_mm_s: Optional[Number]
    waves_per_minute: Optional[Number]
    preset: Optional[str]
    accel_mm_s2: Optional[Number]
    far_dwell_s: Optional[Number]
    home_dwell_s: Optional[Number]
    start_delay_s: Optional[Number]
    on_link_loss: Optional[str]
    telemetry_ms: Optional[Number]
    note: Optional[str]


class Fault(TypedDict, total=False):
    """The fault and its remedy."""

    text: str


class LinkQuality(TypedDict, total=False):
    """Quality of the link to the machine."""

    samples_per_s: int
    missed_samples: int
    bad_frames: int
    losses: int
    answer_ms: Optional[int]


class RunProgress(TypedDict, total=False):
    """Progress of a run."""

    number: int
    stroke: int
    strokes: int
    elapsed_us: int
    thousandths: int
    remaining_s: Optional[int]


class ActionData(TypedDict, total=False):
    """An action as the server reports it."""

    id: str
    machine: str
    kind: str
    state: str
    requested: Any
    accepted: Any
    progress: Any
    result: Any
    error: Any
    files: Any
    started_utc: str
    ended_utc: Optional[str]


class MachineState(TypedDict, total=False):
    """State of either machine."""

    place: str
    contact: str
    contact_text: str
    identity: Optional[Dict[str, Any]]
    origin: str
    state: Optional[str]
    fault: Optional[Fault]
    needs_acknowledge: bool
    link: LinkQuality
    notice: Optional[Dict[str, Any]]
    events: List[Dict[str, Any]]
    status: Optional[Dict[str, Any]]
    action: Optional[ActionData]


class RigState(MachineState, total=False):
    """State of the rig."""

    position_um: int
    speed_um_s: int
    stroke_length_um: int
    homed: bool
    home_flag_open: bool
    far_limit_open: bool
    estop_loop_open: bool
    run: Optional[RunProgress]


class CapsuleState(MachineState, total=False):
    """State of the capsule."""

    referenced: bool
    thread_um: int
    current_ma: int
    battery_mv: int


class Sample(TypedDict, total=False):
    """A telemetry sample of either machine."""

    time_us: int
    state: str
    missed: int
    position_um: int
    position_steps: int
    commanded_steps: int
    speed_um_s: int
    stroke: int
    residual_steps: int
    home_flag_open: bool
    far_limit_open: bool
    estop_loop_open: bool
    thread_um: int
    current_ma: int
    battery_mv: int
    drive_mv: int


class Machines(TypedDict, total=False):
    """The machines of the server."""

    rig: RigState
    capsule: CapsuleState


class State(TypedDict, total=False):
    """State of the whole server."""

    instance: str
    version: str
    time_utc: str
    machines: Machines
    campaign: Optional[Dict[str, Any]]


class Homed(TypedDict, total=False):
    """Result of homing."""

    repeat_steps: int
    shift_steps: int
    duration_us: int


class RunRecord(TypedDict, total=False):
    """The rig's own record of a run."""

    run: int
    outcome: str
    strokes: int
    commanded_edges: int
    counted_edges: int
    ticks: int
    min_steps: int
    max_steps: int
    worst_residual_steps: int
    holds: int


class Moved(TypedDict, total=False):
    """Position of the carriage."""

    position_um: int
    position_steps: int
    already: bool


class ActuationRecord(TypedDict, total=False):
    """The capsule's own record of a motion."""

    actuation: int
    outcome: str
    duration_ms: int
    thread_um: int
    end_current_ma: int
    peak_current_ma: int
    engaged_um: int
    energy_mj: int
    min_battery_mv: int
    already: bool


class Setting(TypedDict, total=False):
    """A setting of the rig."""

    name: str
    value: int
    unit: str
    min: int
    max: int
    default: int
    purpose: str


class RecordEntry(TypedDict, total=False):
    """A record in the server's folder."""

    name: str
    kind: str
    started_utc: str
    what: str
    note: Optional[str]
    outcome: str
    whole: bool
    origin: str
    csv: Optional[str]
