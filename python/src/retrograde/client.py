"""The client: one method per request of docs/openapi.json.

Every command carries a key, so that the server executes it once even if it is sent again; this client repeats a command whose response is
lost. Interrupting the wait for a motion, by Ctrl-C or by an exception in `on_progress`, stops the machine.
"""

from __future__ import annotations

import csv
import datetime
import errno
import html
import io
import json
import math
import os
import pathlib
import re
import sys
import tempfile
import threading
import time
import urllib.parse
import uuid
from decimal import Decimal
from numbers import Integral, Real
from http.client import HTTPConnection, HTTPException
from typing import TYPE_CHECKING, Any, Callable, Dict, Generic, Iterator, List, Optional, Tuple, TypeVar, Union, cast

from . import errors
from .errors import NoMachine, NoServer, NotStopped, OutcomeUnknown, RetrogradeError, Stopped, WrongRequest
from .stream import Stream
from .types import (
    ActionData,
    ActuationRecord,
    CapsuleState,
    Homed,
    Moved,
    Number,
    RecordEntry,
    RigState,
    RunOptions,
    RunRecord,
    Sample,
    Setting,
    State,
)

if TYPE_CHECKING:
    from typing_extensions import Unpack

Result = TypeVar("Result")
Progress = Callable[[ActionData], None]

# Timeout of a response, s: a machine that is writing its flash takes up to 3.
ANSWER_S = 30.0
# Timeout of one stop request, s; the server itself gives up after 10.
STOP_S = 11.0
# Timeout of a stop with all its repetitions, s.
STOPS_S = 20.0
# Time without a confirmation after which the operator is told to press the button, s. Repetitions continue.
WARN_S = 2.0
# Total retry time for a command's response, s.
PATIENCE_S = 20.0
# Timeout of a sample, s; the slowest telemetry has an interval of 1 s.
SAMPLE_S = 5.0
# Server-side long-poll timeout for the end of an action, s.
TURN_S = 1

MACHINES = ("rig", "capsule")
OVER = ("complete", "stopped", "link_lost", "faulted", "refused", "failed", "unknown")
DO_NOW = "press the emergency stop button or cut the motor supply NOW"
NO_SERVER = "start `retrograde serve`, or say where it is: connect('http://127.0.0.1:7080', token='...')"


def runtime_folder() -> pathlib.Path:
    """File in which `retrograde serve` publishes its address to programs of the same user."""
    given = os.environ.get("RETROGRADE_RUNTIME_DIR")
    if given:
        return pathlib.Path(given)
    if sys.platform == "win32":
        return pathlib.Path(os.environ.get("LOCALAPPDATA", tempfile.gettempdir())) / "retrograde"
    return pathlib.Path(f"/tmp/retrograde-{os.geteuid()}")


def connect(url: Optional[str] = None, token: Optional[str] = None) -> "Lab":
    """Finds the server and checks that it answers. Moves nothing.

    Without `url`, connects to the server that this user has started on this computer. For another server, pass the address that
    `retrograde serve` prints, which contains the token, or the address and the token separately.
    """
    if url is None:
        url, found = _found()
        token = token or found
    lab = Lab(url, token)
    lab.state()
    return lab


def _found() -> Tuple[str, str]:
    file = runtime_folder() / "serve.json"
    try:
        found = json.loads(_read_own(file))
        return str(found["url"]), str(found["token"])
    except (OSError, ValueError, KeyError, TypeError) as why:
        raise NoServer(f"no server of this user was found: {why}", NO_SERVER) from None


def _read_own(file: pathlib.Path) -> str:
    """Reads a file that belongs to this user, in a folder that only this user can access, as `retrograde serve` creates it."""
    if sys.platform == "win32":
        return file.read_text(encoding="utf-8")
    folder = _open_own(file.parent, "folder", os.O_DIRECTORY)
    try:
        if os.fstat(folder).st_mode & 0o077:
            raise NoServer(f"other users have access to {file.parent}", f"`chmod 700 {file.parent}`, then start `retrograde serve` again")
        opened = _open_own(file, "file", within=folder)
    finally:
        os.close(folder)
    with open(opened, encoding="utf-8") as text:
        return text.read()


def _open_own(path: pathlib.Path, kind: str, flags: int = 0, within: Optional[int] = None) -> int:
    """Opens a file or folder of this user. Follows no link: anybody may create one in /tmp."""
    try:
        opened = os.open(path if within is None else path.name, os.O_RDONLY | os.O_NOFOLLOW | flags, dir_fd=within)
    except OSError as why:
        if why.errno in (errno.ELOOP, errno.ENOTDIR):
            raise NoServer(f"{path} is a link, or no {kind}", "remove it, then start `retrograde serve` again") from None
        raise
    # Check the open file: its name may be replaced at any moment.
    if os.fstat(opened).st_uid != os.geteuid():
        os.close(opened)
        raise NoServer(f"{path} belongs to another user", "set RETROGRADE_RUNTIME_DIR to a folder of your own, for `retrograde serve`, too")
    return opened


def _number(name: str, value: Number) -> Union[int, float, str]:
    """A number in the server's notation. Text and Decimal are sent exactly; a binary fraction such as 1.7000000000000002 is rounded to
    the resolution of its field: 1 us for a time, otherwise a thousandth. Whole numbers are not rounded: 5.5 cycles are refused."""
    if isinstance(value, str):
        return value
    if isinstance(value, Decimal):
        return format(value, "f")
    # Convert a numpy scalar, or an array with one element, to a Python number.
    plain = value.item() if getattr(value, "size", None) == 1 and hasattr(value, "item") else value
    if isinstance(plain, bool) or not isinstance(plain, Real) or not math.isfinite(plain):
        raise WrongRequest(f"{name} is {value!r}", "give a number, or its decimal text")
    if isinstance(plain, Integral):
        return int(plain)
    if name in WHOLE_NUMBERS:
        return int(float(plain)) if float(plain).is_integer() else float(plain)
    # Drop the sign of a zero, which the server would read as a negative number.
    rounded = round(float(plain), 6 if name.endswith("_s") and not name.endswith("mm_s") else 3) + 0.0
    return rounded if "e" not in repr(rounded) else format(Decimal(repr(rounded)), "f")


def _body(numbers: Dict[str, Optional[Number]], **others: Optional[object]) -> Dict[str, object]:
    """The fields that are not None."""
    body: Dict[str, object] = {name: _number(name, value) for name, value in numbers.items() if value is not None}
    body.update({name: value for name, value in others.items() if value is not None})
    return body


class Lab:
    """Both machines behind one server. Methods may be called from several threads."""

    def __init__(self, url: str, token: Optional[str] = None) -> None:
        parts = urllib.parse.urlsplit(url if "//" in url else f"http://{url}")
        if parts.scheme != "http" or not parts.hostname:
            raise WrongRequest(f"{url} is no address of a server", NO_SERVER)
        in_address = urllib.parse.parse_qs(parts.fragment).get("token", [None])[0]
        self._host = parts.hostname
        self._port = parts.port or 80
        self._token = token or in_address
        # Each stop stores a new mark here. Commands given before it are not sent after it.
        self._last_stop: Dict[str, object] = {machine: object() for machine in MACHINES}
        self.rig = Rig(self)
        self.capsule = Capsule(self)

    def __repr__(self) -> str:
        return f"Lab({self.url!r})"

    def __enter__(self) -> "Lab":
        return self

    def __exit__(self, *_: object) -> None:
        """Closes nothing and stops nothing: motions continue."""

    @property
    def url(self) -> str:
        """Address of the server, without the token."""
        return f"http://{self._host}:{self._port}/"

    # Reading.

    def state(self) -> State:
        """The whole state: machines, run, faults, campaign."""
        return cast(State, self._get("/api/v1/state"))

    def stream(self) -> Stream:
        """States, telemetry, events and actions as they occur."""
        connection = self._connection(2 * ANSWER_S)
        try:
            self._send(connection, "GET", "/api/v1/stream", None, {})
            return Stream(connection)
        except (OSError, HTTPException) as why:
            raise self._no_server(why) from None

    def actions(self) -> List[ActionData]:
        """The latest actions, the oldest first."""
        return cast(List[ActionData], self._get("/api/v1/actions")["actions"])

    def action(self, id: str, wait_s: int = 0) -> ActionData:
        """One action; the server waits for its end for at most `wait_s`, 0 to 60."""
        quoted = urllib.parse.quote(id, safe="")
        return cast(ActionData, self._get(f"/api/v1/actions/{quoted}?wait_s={wait_s}", ANSWER_S + wait_s)["action"])

    def records(self) -> List[RecordEntry]:
        """The records in the server's folder."""
        return cast(List[RecordEntry], self._get("/api/v1/records")["records"])

    def record(self, name: str) -> bytes:
        """Contents of a record's file: `...csv` or `...json`."""
        status, content = self._asked("GET", f"/api/v1/records/{urllib.parse.quote(name, safe='')}", None, ANSWER_S)
        if status != 200:
            raise errors.of_answer(status, _decoded(content))
        return content

    def rows(self, name: str) -> List[Dict[str, Any]]:
        """The rows of a record's CSV file, with numbers converted. A name such as `01` stays text."""
        text = io.StringIO(self.record(name).decode("utf-8"), newline="")
        return [{key: _value(key, cell) for key, cell in row.items()} for row in csv.DictReader(text)]

    def plan(self, **run: Unpack[RunOptions]) -> Dict[str, Any]:
        """The plan of a run on a rig with default settings: durations, speeds. Takes the options of `Rig.run`; contacts no machine."""
        status, content = self._asked("POST", "/api/v1/plan", _run_body(**run), ANSWER_S)
        answer = _decoded(content)
        if status != 200:
            raise errors.of_answer(status, answer)
        return cast(Dict[str, Any], answer["plan"])

    # Stopping.

    def stop(self, machine: Optional[str] = None) -> None:
        """Stops both machines, or `rig` or `capsule`; the position is kept. Needs no token on this computer.

        Raises `NotStopped` unless every machine confirms within about 20 s. After 2 s a message on standard error says what to do.
        """
        self._stop("/api/v1/stop", machine)

    def estop(self, machine: Optional[str] = None) -> None:
        """Emergency stop: cuts pulses and motor current at once. It is latched: `acknowledge()`, then home or reference."""
        self._stop("/api/v1/estop", machine)

    def _stop(self, path: str, machine: Optional[str]) -> None:
        for each in MACHINES if machine is None else (machine,):
            self._last_stop[each] = object()
        body: Dict[str, object] = {} if machine is None else {"machine": machine}
        warning = threading.Timer(WARN_S, _warn)
        warning.daemon = True
        try:
            warning.start()
        except RuntimeError:
            # An interpreter that is shutting down starts no threads. The stop is sent nevertheless.
            pass
        try:
            self._try_to_stop(path, body)
        except KeyboardInterrupt:
            _warn()
            raise
        finally:
            warning.cancel()

    def _try_to_stop(self, path: str, body: Dict[str, object]) -> None:
        why = "no answer"
        until = time.monotonic() + STOPS_S
        # Each request is a separate stop: repeating it does no harm.
        for _ in range(3):
            remaining_s = until - time.monotonic()
            if remaining_s <= 0:
                break
            try:
                status, answer = self._post(path, body, {}, min(STOP_S, remaining_s))
            except (OSError, HTTPException, RetrogradeError) as problem:
                why = str(problem)
                continue
            machines = answer.get("machines")
            if status == 200 and answer.get("ok") is True:
                return
            why = f"status {status}"
            if isinstance(machines, list):
                whys = [f"{it.get('machine')}: {it.get('outcome')} {it.get('why') or ''}".strip() for it in machines]
                why = "; ".join(whys) or why
            elif isinstance(answer.get("error"), dict):
                why = str(errors.of_answer(status, answer))
            if status in (401, 403, 404):
                break
        raise NotStopped(f"NOT STOPPED: {why}", "press the button, or cut the motor supply")

    # Requests.

    def _connection(self, timeout_s: float) -> HTTPConnection:
        return HTTPConnection(self._host, self._port, timeout=timeout_s)

    def _send(
        self, connection: HTTPConnection, method: str, path: str, body: Optional[Dict[str, object]], more: Dict[str, str]
    ) -> None:
        headers = {**more}
        if self._token:
            headers["Authorization"] = f"Bearer {self._token}"
        content = None
        if body is not None:
            headers["Content-Type"] = "application/json"
            content = json.dumps(body).encode()
        connection.request(method, path, content, headers)

    def _once(
        self, method: str, path: str, body: Optional[Dict[str, object]], more: Dict[str, str], timeout_s: float
    ) -> Tuple[int, bytes]:
        """Sends one request, with `more` headers."""
        connection = self._connection(timeout_s)
        try:
            self._send(connection, method, path, body, more)
            response = connection.getresponse()
            return response.status, response.read()
        finally:
            connection.close()

    def _post(
        self, path: str, body: Dict[str, object], more: Dict[str, str], timeout_s: float
    ) -> Tuple[int, Dict[str, object]]:
        status, content = self._once("POST", path, body, more, timeout_s)
        return status, _decoded(content)

    def _asked(
        self, method: str, path: str, body: Optional[Dict[str, object]], timeout_s: float
    ) -> Tuple[int, bytes]:
        """Sends a request that changes nothing."""
        try:
            return self._once(method, path, body, {}, timeout_s)
        except (OSError, HTTPException) as why:
            raise self._no_server(why) from None

    def _get(self, path: str, timeout_s: float = ANSWER_S) -> Dict[str, Any]:
        status, content = self._asked("GET", path, None, timeout_s)
        answer = _decoded(content)
        if status != 200:
            raise errors.of_answer(status, answer)
        return answer

    def _no_server(self, why: Exception) -> NoServer:
        return NoServer(f"{self.url} does not answer: {why}", NO_SERVER)

    def _command(self, machine: str, name: str, body: Dict[str, object], last_stop: Optional[object] = None) -> ActionData:
        """Repeats a command until the server responds; the server executes it once. Ctrl-C during the call stops the machine.

        It is not sent if the machine was stopped after `last_stop`, by default the last stop before this call.
        """
        # Note it before the first request, which may take long.
        last_stop = last_stop or self._last_stop[machine]
        state = self.state()
        more = {
            # The key is valid for the present server instance only, so that a restarted server refuses it.
            "Idempotency-Key": f"{state['instance']}-{uuid.uuid4().hex}",
            # By the server's clock, because this computer's may be wrong. The server refuses an order that is older than 5 s, after a
            # broken connection or a suspended computer.
            "Retrograde-Sent": str(round(1e3 * _wall(state["time_utc"]))),
        }
        try:
            action = self._sent(machine, name, body, more, last_stop)
            if self._last_stop[machine] is not last_stop and action["state"] not in OVER:
                # The stop may have reached the server before this command.
                self.stop(machine)
            return action
        except Exception:
            raise
        except BaseException:
            # The server carries out the command even if nobody waits for its response.
            self.stop(machine)
            raise

    def _sent(self, machine: str, name: str, body: Dict[str, object], more: Dict[str, str], last_stop: object) -> ActionData:
        until = _now() + PATIENCE_S
        unsure: Optional[str] = None
        while True:
            if self._last_stop[machine] is not last_stop:
                # Another thread stopped the machine. A command sent or repeated now must not undo that.
                if unsure is None:
                    raise Stopped(f"{machine}: {name} was not sent, because the {machine} was stopped first", "nothing was begun; order it again if it is still wanted")
                raise OutcomeUnknown(f"{machine}: {name} was sent and not answered, and then stopped: {unsure}", "look at the machine")
            if unsure is not None and _now() > until:
                raise OutcomeUnknown(f"{machine}: {name} was sent and not answered: {unsure}", "look at the machine")
            try:
                status, answer = self._post(f"/api/v1/{machine}/{name}", body, more, ANSWER_S)
            except ConnectionRefusedError as why:
                if unsure is None:
                    raise self._no_server(why) from None
                unsure = str(why)
            except (OSError, HTTPException) as why:
                unsure = str(why) or type(why).__name__
            else:
                if status in (200, 202):
                    return cast(ActionData, answer["action"])
                error = errors.of_answer(status, answer)
                if status == 428 and unsure is not None:
                    # The server that received the first request has exited.
                    raise OutcomeUnknown(f"{machine}: {name} was sent, and then the server was started again", "look at the machine")
                if unsure is None or status not in (408, 503) or "action" in answer:
                    raise error
                # The state of the first request is unknown: the server may be carrying it out.
                unsure = str(error)
            time.sleep(0.2)


def _warn() -> None:
    """Prints to standard error what to do about an unconfirmed stop."""
    print(f"retrograde: the stop is NOT YET CONFIRMED: {DO_NOW}", file=sys.stderr, flush=True)


def _now() -> float:
    """Time in seconds, by a clock that on Linux also counts suspend."""
    if sys.platform == "linux":
        return time.clock_gettime(time.CLOCK_BOOTTIME)
    return time.monotonic()


def _wall(utc: str) -> float:
    """Seconds since 1970 of a timestamp from the server."""
    whole, _, rest = utc.rstrip("Z").partition(".")
    moment = datetime.datetime.strptime(whole, "%Y-%m-%dT%H:%M:%S").replace(tzinfo=datetime.timezone.utc)
    return moment.timestamp() + (float(f"0.{rest}") if rest else 0.0)


def _decoded(content: bytes) -> Dict[str, Any]:
    try:
        answer = json.loads(content)
    except ValueError:
        answer = None
    if not isinstance(answer, dict):
        raise RetrogradeError("the server's answer is no JSON object", "is that `retrograde serve`?")
    return answer


# Columns of text, in which digits are not a number.
_WORDS = {"camera_file", "condition", "excluded", "indentation", "name", "note", "reason", "text"}
# Numbers as the tool writes them. Python would also accept `01`, `1_0` and `nan`.
_NUMBER = re.compile(r"-?(0|[1-9][0-9]*)(?P<part>\.[0-9]+)?(?P<exponent>[eE][-+]?[0-9]+)?")


def _value(column: str, cell: Optional[str]) -> Any:
    """A CSV cell as int, float, bool or text; None if it is empty."""
    if not cell:
        return None
    if column in _WORDS:
        return cell
    if cell in ("true", "false"):
        return cell == "true"
    number = _NUMBER.fullmatch(cell)
    if number is None:
        return cell
    return int(cell) if number["part"] is None and number["exponent"] is None else float(cell)


class Action(Generic[Result]):
    """A command in progress or completed."""

    def __init__(self, lab: Lab, data: ActionData) -> None:
        self._lab = lab
        self.data = data
        """Latest data from the server."""

    def __repr__(self) -> str:
        return f"<Action {self.id}: {', '.join(self._told().values())}>"

    def _repr_html_(self) -> str:
        result = self.data.get("result")
        cells = {**self._told(), **(result if isinstance(result, dict) else {}), **self.files}
        rows = (f"<tr><th>{html.escape(name)}</th><td>{html.escape(str(cell))}</td></tr>" for name, cell in cells.items())
        return f"<table>{''.join(rows)}</table>"

    def _told(self) -> Dict[str, str]:
        error = self.data.get("error") or {}
        summary = {"action": f"{self.data.get('machine')} {self.data.get('kind')}", "state": self.state, "error": error.get("message", "")}
        return {name: value for name, value in summary.items() if value}

    @property
    def id(self) -> str:
        """Its name for `Lab.action`."""
        return self.data["id"]

    @property
    def state(self) -> str:
        """`starting` or `under_way`; at the end one of `OVER`."""
        return self.data["state"]

    @property
    def is_over(self) -> bool:
        """Whether it has ended, as planned or not."""
        return self.state in OVER

    @property
    def files(self) -> Dict[str, str]:
        """Names of the record's `csv` and `sidecar`, if there is one."""
        return cast(Dict[str, str], self.data.get("files") or {})

    def refresh(self, wait_s: int = 0) -> ActionData:
        """Updates the data. The server responds after the end, or after `wait_s`."""
        self.data = self._lab.action(self.id, wait_s)
        return self.data

    def stop(self) -> None:
        """Stops the machine."""
        self._lab.stop(self.data["machine"])

    def wait(self, on_progress: Optional[Progress] = None) -> Result:
        """Waits for the end. Returns the result, or raises the error that describes the end.

        Calls `on_progress` with the action about once a second. Ctrl-C, and an exception in `on_progress`, stop the machine. If the
        server does not answer for 20 s, raises `OutcomeUnknown`; the machine may continue.
        """
        silent_since: Optional[float] = None
        try:
            while not self.is_over:
                try:
                    self.refresh(TURN_S)
                    silent_since = None
                except NoServer as why:
                    silent_since = silent_since or time.monotonic()
                    if time.monotonic() - silent_since > PATIENCE_S:
                        raise OutcomeUnknown(f"{self.data['kind']} was under way: {why.message}", "look at the machine") from None
                    time.sleep(0.2)
                    continue
                if on_progress is not None:
                    on_progress(self.data)
        except OutcomeUnknown:
            raise
        except BaseException:
            self.stop()
            raise
        return self.result()

    def result(self) -> Result:
        """Returns the result, or raises an error if it did not end as planned. Call it only after the end."""
        if self.state == "complete":
            return cast(Result, self.data.get("result") or {})
        kind = errors.BY_STATE.get(self.state, RetrogradeError)
        raise errors.of_error(kind, self.data.get("error"), f"{self.data['kind']} ended: {self.state}")


class _Machine:
    """Commands and state that both machines have."""

    name = ""

    def __init__(self, lab: Lab) -> None:
        self._lab = lab

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self._lab!r}>"

    def _last_stop(self) -> object:
        """The last stop at this moment, for `_start`."""
        return self._lab._last_stop[self.name]

    def _start(self, command: str, body: Optional[Dict[str, object]] = None, last_stop: Optional[object] = None) -> Action[Any]:
        return Action(self._lab, self._lab._command(self.name, command, body or {}, last_stop))

    def _state(self) -> Dict[str, Any]:
        machines = cast(Dict[str, Dict[str, Any]], self._lab.state()["machines"])
        if self.name not in machines:
            raise NoMachine(f"this server has no {self.name}", f"start it with `retrograde serve --{self.name} WHERE`")
        return machines[self.name]

    def sample(self) -> Sample:
        """A telemetry sample taken after this call. (`state` shows the latest known one, some 50 ms old.)"""
        until = time.monotonic() + SAMPLE_S
        with self._lab.stream() as stream:
            portions = 0
            for message in stream:
                if message.event == self.name and message.data.get("samples"):
                    portions += 1
                    # The first batch may contain samples from before the call.
                    if portions == 2:
                        return cast(Sample, message.data["samples"][-1])
                # The state arrives at least once a second.
                if time.monotonic() > until:
                    break
        why = self._state().get("contact_text") or "it sends no telemetry"
        raise NoMachine(f"no sample of the {self.name}: {why}", "look at the machine and its line")

    def stop(self) -> None:
        """Stops the machine; the position is kept."""
        self._lab.stop(self.name)

    def estop(self) -> None:
        """Latched emergency stop."""
        self._lab.estop(self.name)

    def acknowledge(self) -> None:
        """Clears a latched fault after its cause was removed."""
        self._start("ack").wait()


class Rig(_Machine):
    """The roller rig."""

    name = "rig"

    def state(self) -> RigState:
        """State of the rig."""
        return cast(RigState, self._state())

    def health(self) -> Dict[str, Any]:
        """Counters since its start."""
        return cast(Dict[str, Any], self._lab._get("/api/v1/rig/health")["health"])

    def settings(self) -> List[Setting]:
        """Its settings with units and ranges."""
        return cast(List[Setting], self._lab._get("/api/v1/rig/settings")["settings"])

    def start_home(self) -> Action[Homed]:
        """Starts homing."""
        return self._start("home")

    def home(self, on_progress: Optional[Progress] = None) -> Homed:
        """Finds the reference and goes to 0."""
        return self.start_home().wait(on_progress)

    def start_run(self, **run: Unpack[RunOptions]) -> Action[RunRecord]:
        """Starts a run with the options of `run`. `data["accepted"]` has the plan."""
        return self._start("run", _run_body(**run))

    def run(self, on_progress: Optional[Progress] = None, **run: Unpack[RunOptions]) -> RunRecord:
        """Executes and records a run from position 0; by default the paper's, 5 cycles of 130 mm in 40 s.

        `cycles`, `stroke_mm`; one of `duration_s`, `speed_mm_s` (with `return_speed_mm_s`), `waves_per_minute`, `preset` (`paper`, `wave`);
        `accel_mm_s2`, `far_dwell_s`, `home_dwell_s`, `start_delay_s`, `on_link_loss` (`stop`, `finish`), `telemetry_ms`, `note`.
        """
        return self.start_run(**run).wait(on_progress)

    def start_move(self, position_mm: Number, speed_mm_s: Optional[Number] = None) -> Action[Moved]:
        """Starts a move to a position."""
        return self._start("move", _body({"position_mm": position_mm, "speed_mm_s": speed_mm_s}))

    def move(self, position_mm: Number, speed_mm_s: Optional[Number] = None) -> Moved:
        """Moves to a position within the stroke."""
        return self.start_move(position_mm, speed_mm_s).wait()

    def jog(self, direction: str, speed_mm_s: Optional[Number] = None) -> "Jog":
        """Context manager that moves `away` or `home`, and stops on exit."""
        return Jog(self, _body({"speed_mm_s": speed_mm_s}, direction=direction))

    def hold(self) -> Moved:
        """Holds the run, which can be resumed. Returns the position of the carriage."""
        held: Action[Moved] = self._start("hold")
        return held.wait()

    def resume(self) -> Moved:
        """Resumes the held run."""
        resumed: Action[Moved] = self._start("resume")
        return resumed.wait()


RUN_NUMBERS = (
    "cycles",
    "stroke_mm",
    "duration_s",
    "speed_mm_s",
    "return_speed_mm_s",
    "waves_per_minute",
    "accel_mm_s2",
    "far_dwell_s",
    "home_dwell_s",
    "start_delay_s",
    "telemetry_ms",
)
RUN_TEXTS = ("preset", "on_link_loss", "note")
WHOLE_NUMBERS = ("cycles", "telemetry_ms")


def _run_body(**run: Any) -> Dict[str, object]:
    unknown = sorted(set(run) - set(RUN_NUMBERS) - set(RUN_TEXTS))
    if unknown:
        raise WrongRequest(f"a run has no {', '.join(unknown)}", f"it has {', '.join(RUN_NUMBERS + RUN_TEXTS)}")
    return _body({name: run.get(name) for name in RUN_NUMBERS}, **{name: run.get(name) for name in RUN_TEXTS})


class Jog:
    """A jog. It continues while this program renews it, four times within the rig's dead-man time, and ends if the program hangs or exits."""

    def __init__(self, rig: Rig, body: Dict[str, object]) -> None:
        self._rig = rig
        self._body = body
        self._ends = threading.Event()
        self._thread: Optional[threading.Thread] = None
        self._action: Optional[Action[Moved]] = None
        self.why: Optional[str] = None
        """Why it ended by itself, if it did: a renewal was refused, or came too late."""

    def __enter__(self) -> "Jog":
        self._action = action = self._rig._start("jog", self._body)
        if action.is_over:
            action.result()
            return self
        within_s = float(action.data["accepted"]["renew_within_ms"]) / 1e3
        self._thread = threading.Thread(target=self._renew, args=(action.id, within_s), daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ends.set()
        if self._thread is None or self._action is None:
            return
        self._rig.stop()
        self._thread.join(2)
        # Wait until it has braked: the next command would be refused.
        until = time.monotonic() + STOP_S
        while not self._action.is_over and time.monotonic() < until:
            self._action.refresh(TURN_S)

    def _renew(self, id: str, within_s: float) -> None:
        for number in _count():
            if self._ends.wait(within_s / 4):
                return
            try:
                body: Dict[str, object] = {"action": id, "n": number}
                status, answer = self._rig._lab._post("/api/v1/rig/jog/renew", body, {}, within_s)
            except (OSError, HTTPException, RetrogradeError) as why:
                # The next renewal may arrive in time.
                self.why = str(why)
                continue
            if status != 200:
                self.why = str(errors.of_answer(status, answer))
                return


def _count() -> Iterator[int]:
    number = 0
    while True:
        number += 1
        yield number


class Capsule(_Machine):
    """The folding capsule."""

    name = "capsule"

    def state(self) -> CapsuleState:
        """State of the capsule."""
        return cast(CapsuleState, self._state())

    def start(
        self,
        command: str,
        telemetry_ms: Optional[Number] = None,
        note: Optional[str] = None,
        thread_mm: Optional[Number] = None,
    ) -> Action[ActuationRecord]:
        """Starts `reference`, `calibrate`, `check`, `fold` or `unfold`, recorded. Only `fold` takes `thread_mm`."""
        if command not in ("reference", "calibrate", "check", "fold", "unfold"):
            raise WrongRequest(f"the capsule has no command {command!r}", "it has reference, calibrate, check, fold, unfold")
        return self._start(command, _body({"telemetry_ms": telemetry_ms, "thread_mm": thread_mm}, note=note))

    def settings(self) -> List[Setting]:
        """Its settings with units and ranges."""
        return cast(List[Setting], self._lab._get("/api/v1/capsule/settings")["settings"])

    def reference(self, note: Optional[str] = None) -> ActuationRecord:
        """References the thread; the capsule is unfolded afterwards. Without a calibration it calibrates."""
        return self.start("reference", note=note).wait()

    def calibrate(self, note: Optional[str] = None) -> ActuationRecord:
        """Measures the thread from the unfolded state to the end force. Begin unfolded."""
        return self.start("calibrate", note=note).wait()

    def check(self, note: Optional[str] = None) -> ActuationRecord:
        """Checks that the thread pulls, and stays folded."""
        return self.start("check", note=note).wait()

    def fold(self, note: Optional[str] = None, thread_mm: Optional[Number] = None) -> ActuationRecord:
        """Folds; with `thread_mm`, winds or pays out to this length of thread from the unfolded end."""
        return self.start("fold", note=note, thread_mm=thread_mm).wait()

    def unfold(self, note: Optional[str] = None) -> ActuationRecord:
        """Unfolds."""
        return self.start("unfold", note=note).wait()
