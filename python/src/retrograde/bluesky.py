"""Devices for bluesky's RunEngine. bluesky is not imported: the RunEngine needs only the methods.

    from bluesky import RunEngine
    from bluesky.plans import fly
    from bluesky.preprocessors import stage_wrapper
    import retrograde
    from retrograde.bluesky import Rig

    rig = Rig(retrograde.connect())
    RE = RunEngine()
    RE(stage_wrapper(fly([rig]), [rig]))      # homes if necessary, then the paper's run

`Rig` can be read (position, speed, state, the last run), moved (`bps.mv(rig, 60)`, mm) and flown (a run; its telemetry is collected).
`bps.prepare(rig, {...})` sets the options of the run: those of the package's `Rig.run`. RE's pause holds a run, its resume continues it.
Its stop and abort stop it, if the device was staged, as above. While `stage` homes or references, the RunEngine waits and does none of
these: call the device's `stop()` in another thread, or use the page or `retrograde stop`.

`Capsule` can be read and set to "folded" or "unfolded".
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any, Callable, Dict, Iterator, List, Mapping, Optional, Tuple, TypeVar

from .client import Action, Lab, _number, _run_body, _wall
from .errors import RetrogradeError, Stopped
from .types import RunOptions

# Longest wait until a requested run has begun or was refused: that of the client.
START_S = 90.0

if TYPE_CHECKING:
    from typing_extensions import Unpack

# Value and time stamp, as bluesky describes them.
Reading = Any
# None: nothing has to be moved.
Ordered = TypeVar("Ordered", bound=Optional[Action[Any]])
# Description of a value: dtype, unit.
Key = Tuple[str, str]
# Shapes that the capsule can be set to, each with its command.
SHAPES = {"folded": "fold", "unfolded": "unfold"}


class Status:
    """bluesky's `Status`: whether an operation has ended, and how."""

    def __init__(self, work: Callable[[], Any]) -> None:
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._callbacks: List[Callable[["Status"], None]] = []
        self._exception: Optional[BaseException] = None
        self.value: Any = None
        """Result of the operation; none until it has succeeded."""
        threading.Thread(target=self._run, args=(work,), daemon=True).start()

    def __repr__(self) -> str:
        if not self.done:
            return "<Status: under way>"
        return "<Status: done>" if self._exception is None else f"<Status: failed: {self._exception}>"

    def _run(self, work: Callable[[], Any]) -> None:
        try:
            self.value = work()
        except BaseException as why:  # noqa: B902 - reported to the RunEngine
            self._exception = why
        with self._lock:
            self._ended.set()
            callbacks = list(self._callbacks)
        for callback in callbacks:
            callback(self)

    def add_callback(self, callback: Callable[["Status"], None]) -> None:
        """Calls `callback` on completion, immediately if already done."""
        with self._lock:
            if not self._ended.is_set():
                self._callbacks.append(callback)
                return
        callback(self)

    def exception(self, timeout: Optional[float] = 0.0) -> Optional[BaseException]:
        """Waits for the end. Returns the error, if any."""
        if not self._ended.wait(timeout):
            raise TimeoutError("it has not ended")
        return self._exception

    def wait(self, timeout: Optional[float] = None) -> None:
        """Waits for the end. Raises the error, if any."""
        why = self.exception(timeout)
        if why is not None:
            raise why

    @property
    def done(self) -> bool:
        """Whether it has ended."""
        return self._ended.is_set()

    @property
    def success(self) -> bool:
        """Whether it has ended as planned."""
        return self.done and self._exception is None


class _Motion:
    """The last motion that a device requested, for `stop` and `unstage` in another thread."""

    def __init__(self) -> None:
        self._is_ordered = False
        self._action: Optional[Action[Any]] = None

    def begin(self, order: Callable[[], Ordered]) -> Ordered:
        """Requests the motion."""
        # Set before sending: the response may take seconds.
        self._is_ordered = True
        try:
            action = order()
            # If nothing has to be moved, an earlier motion may still be in progress.
            self._action = action or self._action
            return action
        finally:
            self._is_ordered = False

    @property
    def is_under_way(self) -> bool:
        """Whether it is being requested, or is not known to have ended."""
        return self._is_ordered or self._action is not None and not self._action.is_over


def _described(source: str, keys: Mapping[str, Key]) -> Dict[str, Any]:
    described: Dict[str, Any] = {}
    for name, (dtype, units) in keys.items():
        described[name] = {"source": source, "dtype": dtype, "shape": []}
        if units:
            described[name]["units"] = units
    return described


def _read(values: Mapping[str, Any]) -> Dict[str, Reading]:
    now = time.time()
    return {name: {"value": value, "timestamp": now} for name, value in values.items()}


class Rig:
    """The rig as a readable, movable and flyable device."""

    parent = None

    def __init__(self, lab: Lab, name: str = "rig", **run: Unpack[RunOptions]) -> None:
        """`run` has the options of the flown run, as in `retrograde.Rig.run`; by default the paper's run."""
        self.name = name
        self._lab = lab
        self._rig = lab.rig
        self._run: Dict[str, Any] = {**run}
        self._flown: Optional[Action[Any]] = None
        self._flight: Optional[Status] = None
        self._starting: Optional[Status] = None
        self._motion = _Motion()
        self._repeats = False
        self._target_mm: Optional[float] = None
        self._held = False
        self._resumed = False
        self._record: Dict[str, Any] = {}

    @property
    def hints(self) -> Dict[str, Any]:
        """The fields to plot."""
        return {"fields": [self.name]}

    # Readable: the position has the name of the device.

    def _keys(self) -> Dict[str, Key]:
        name = self.name
        return {
            name: ("number", "mm"),
            f"{name}_speed": ("number", "mm/s"),
            f"{name}_state": ("string", ""),
            f"{name}_run": ("integer", ""),
            f"{name}_run_outcome": ("string", ""),
            f"{name}_run_steps_counted": ("integer", "steps"),
            f"{name}_run_duration": ("number", "s"),
        }

    def describe(self) -> Dict[str, Any]:
        """Types and units of the values that `read` gives."""
        return _described(self._lab.url, self._keys())

    def read(self) -> Dict[str, Reading]:
        """Present position and speed, and the last run flown by this device."""
        sample = self._rig.sample()
        record = self._record
        values = (
            sample["position_um"] / 1e3,
            sample["speed_um_s"] / 1e3,
            sample["state"],
            record.get("run", 0),
            record.get("outcome", "none"),
            record.get("counted_edges", 0),
            record.get("ticks", 0) / 1e8,
        )
        return _read(dict(zip(self._keys(), values)))

    def describe_configuration(self) -> Dict[str, Any]:
        """Types and units of the values that `read_configuration` gives."""
        keys: Dict[str, Key] = {f"{self.name}_{key}": ("string", "") for key in ("uid", "firmware", "origin")}
        keys.update({f"{self.name}_{it['name']}": ("integer", it.get("unit", "")) for it in self._rig.settings()})
        return _described(self._lab.url, keys)

    def read_configuration(self) -> Dict[str, Reading]:
        """Identity of the rig, whether it is real (`origin`), and its settings."""
        state = self._rig.state()
        identity = state.get("identity") or {}
        values: Dict[str, Any] = {
            f"{self.name}_uid": identity.get("uid", ""),
            f"{self.name}_firmware": identity.get("revision", ""),
            f"{self.name}_origin": state.get("origin", "unknown"),
        }
        values.update({f"{self.name}_{it['name']}": it["value"] for it in self._rig.settings()})
        return _read(values)

    # Stageable.

    def stage(self) -> List[Any]:
        """Homes the rig unless it is homed and at 0."""
        homing = self._motion.begin(self._start_home)
        if homing is not None:
            homing.wait()
        return [self]

    def _start_home(self) -> Optional[Action[Any]]:
        # Note it before reading the state: a later stop also applies to the homing.
        last_stop = self._rig._last_stop()
        if self._rig.state().get("homed") and not self.position:
            return None
        self._repeats = False
        return self._rig._start("home", last_stop=last_stop)

    def unstage(self) -> List[Any]:
        """Stops a run or a homing in progress, after a plan that ended early. (The RunEngine itself stops only what was `set`.)"""
        self._resumed = False
        if self._motion.is_under_way:
            self._rig.stop()
        if self._is_starting():
            self._rig.stop()
            self._wait_for_start()
        flown = self._flown
        if flown is not None and not flown.is_over:
            self._rig.stop()
            flown.refresh(10)
        return [self]

    # Movable.

    @property
    def position(self) -> float:
        """Position of the carriage, mm."""
        return self._rig.sample()["position_um"] / 1e3

    def check_value(self, position_mm: float) -> None:
        """Refuses a position outside the stroke, in mm. bluesky's `check_limits` calls this for each step before a plan begins."""
        position_mm = float(_number("position_mm", position_mm))
        stroke_um = self._rig.state().get("stroke_length_um")
        # Without contact the stroke is unknown; the rig itself refuses.
        stroke_mm = None if stroke_um is None else stroke_um / 1e3
        if stroke_mm is not None and not 0 <= position_mm <= stroke_mm:
            raise RetrogradeError(f"the position is {position_mm} mm, allowed is 0 to {stroke_mm} mm", "correct the plan; nothing moved")

    def set(self, position_mm: float) -> Status:
        """Moves to a position, mm."""
        self._target_mm = target_mm = float(_number("position_mm", position_mm))
        self._repeats = False
        moving = self._motion.begin(lambda: self._rig.start_move(target_mm))

        def end() -> None:
            try:
                moving.wait()
            except Stopped:
                # The RunEngine stopped it: at a pause, after which it repeats the move, or at the end of the plan.
                if not self._repeats:
                    raise

        return Status(end)

    def locate(self) -> Dict[str, float]:
        """Target and present position, mm."""
        position = self.position
        return {"setpoint": position if self._target_mm is None else self._target_mm, "readback": position}

    def stop(self, *, success: bool = False) -> None:
        """The RunEngine calls this with `success` at each pause and at each end, also after a failure: stops a move, and leaves
        a run to `pause` or `unstage`. Without `success`, stops the rig unconditionally."""
        flies = self._is_starting() or self._flown is not None and not self._flown.is_over
        if not success or self._motion.is_under_way:
            self._repeats = success
            self._rig.stop()
        if flies and not success:
            # The stop may have arrived before the command.
            self._wait_for_start()
            if self._flown is not None and not self._flown.is_over:
                self._rig.stop()

    def _is_starting(self) -> bool:
        return self._starting is not None and not self._starting.done

    def _wait_for_start(self) -> None:
        """Waits until the requested run has begun or failed to begin."""
        if self._starting is not None:
            self._starting.exception(START_S)

    # Flyable: a run.

    def prepare(self, run: Mapping[str, Any]) -> Status:
        """Sets the options of later runs."""

        def prepare() -> None:
            wanted = dict(run)
            # Plan it before anything moves, to refuse what no rig can do.
            self._lab.plan(**wanted)
            self._run = wanted

        return Status(prepare)

    def kickoff(self) -> Status:
        """Starts the run. The status is done when the rig has accepted it."""
        # After a pause the RunEngine repeats everything since the last checkpoint; the held run has already been resumed.
        goes_on, self._resumed = self._resumed, False
        # Note it now: another thread sends the command later.
        last_stop = self._rig._last_stop()

        def start() -> None:
            if not (goes_on and self._flown is not None and not self._flown.is_over):
                self._flown = self._rig._start("run", _run_body(**self._run), last_stop)

        self._starting = Status(start)
        return self._starting

    def complete(self) -> Status:
        """The status is done at the end of the run, and fails if the run was stopped or ended by a fault."""
        flown = self._flown
        if flown is None:
            raise RetrogradeError("no run was started", "kickoff comes first")

        def end() -> None:
            record = flown.wait()
            # The record has the result, the plan has the number of the run.
            self._record = {"run": (flown.data.get("accepted") or {}).get("run", 0), **record}

        self._flight = Status(end)
        return self._flight

    def pause(self) -> None:
        """Called when the RunEngine pauses: holds the run. A run that ends before the hold is complete."""
        self._held = False
        self._wait_for_start()
        if self._flown is not None and not self._flown.is_over:
            try:
                self._rig.hold()
                self._held = True
            except Stopped:
                raise
            except RetrogradeError:
                if not self._flown.refresh()["state"] == "complete":
                    raise

    def resume(self) -> None:
        """Called when the RunEngine resumes: resumes the held run."""
        if self._held:
            self._held = False
            self._rig.resume()
            self._resumed = True

    def _flight_keys(self) -> Dict[str, Key]:
        name = self.name
        return {
            f"{name}_telemetry_device_time": ("number", "s"),
            f"{name}_telemetry_position": ("number", "mm"),
            f"{name}_telemetry_speed": ("number", "mm/s"),
            f"{name}_telemetry_stroke": ("integer", ""),
            f"{name}_telemetry_missed": ("integer", ""),
        }

    def describe_collect(self) -> Dict[str, Dict[str, Any]]:
        """One stream: the telemetry of the run."""
        return {f"{self.name}_telemetry": _described(self._lab.url, self._flight_keys())}

    def collect(self) -> Iterator[Dict[str, Any]]:
        """The telemetry of the run as recorded by the server. Wall-clock times are accurate to some 10 ms, device times to 1 us."""
        flown = self._flown
        if flown is None:
            raise RetrogradeError("there is no run to collect", "kickoff and complete come first")
        if not flown.is_over or "csv" not in flown.files:
            # The RunEngine also collects when a plan fails or is aborted.
            return
        rows = self._lab.rows(flown.files["csv"])
        began = _wall(flown.data["started_utc"])
        first_us = rows[0]["time_us"] if rows else 0
        for row in rows:
            at = began + (row["time_us"] - first_us) / 1e6
            values = (row["time_us"] / 1e6, float(row["position_mm"]), float(row["speed_mm_s"]), row["stroke"], row["missed"])
            data = dict(zip(self._flight_keys(), values))
            yield {"time": at, "data": data, "timestamps": {key: at for key in data}}


class Capsule:
    """The capsule as a readable and movable device: "folded", "unfolded"."""

    parent = None

    def __init__(self, lab: Lab, name: str = "capsule") -> None:
        self.name = name
        self._lab = lab
        self._capsule = lab.capsule
        self._motion = _Motion()
        self._shape = ""

    @property
    def hints(self) -> Dict[str, Any]:
        """The fields to plot."""
        return {"fields": [f"{self.name}_thread"]}

    def _keys(self) -> Dict[str, Key]:
        name = self.name
        return {
            name: ("string", ""),
            f"{name}_thread": ("number", "mm"),
            f"{name}_battery": ("number", "V"),
        }

    def describe(self) -> Dict[str, Any]:
        """Types and units of the values that `read` gives."""
        return _described(self._lab.url, self._keys())

    def read(self) -> Dict[str, Reading]:
        """State, thread wound up, battery."""
        sample = self._capsule.sample()
        values = (sample["state"], sample["thread_um"] / 1e3, sample["battery_mv"] / 1e3)
        return _read(dict(zip(self._keys(), values)))

    def stage(self) -> List[Any]:
        """References the capsule if it is not referenced, which leaves it unfolded."""
        referencing = self._motion.begin(self._start_reference)
        if referencing is not None:
            referencing.wait()
        return [self]

    def _start_reference(self) -> Optional[Action[Any]]:
        # Note it before reading the state: a later stop also applies to the reference.
        last_stop = self._capsule._last_stop()
        if self._capsule.state().get("referenced"):
            return None
        return self._capsule._start("reference", last_stop=last_stop)

    def unstage(self) -> List[Any]:
        """Stops a motion in progress, after a plan that ended early."""
        if self._motion.is_under_way:
            self._capsule.stop()
        return [self]

    def check_value(self, shape: str) -> None:
        """Refuses a value other than "folded" and "unfolded"."""
        if shape not in SHAPES:
            raise RetrogradeError(f"the capsule cannot be {shape!r}", "it can be 'folded' or 'unfolded'")

    def set(self, shape: str) -> Status:
        """Folds or unfolds."""
        self.check_value(shape)
        self._shape = shape
        moving = self._motion.begin(lambda: self._capsule.start(SHAPES[shape]))
        return Status(moving.wait)

    def locate(self) -> Dict[str, str]:
        """The last shape set, and the state."""
        state = self._capsule.sample()["state"]
        return {"setpoint": self._shape or state, "readback": state}

    def stop(self, *, success: bool = False) -> None:
        """Stops the motion requested by this device. Without `success`, stops the capsule unconditionally."""
        if not success or self._motion.is_under_way:
            self._capsule.stop()
