#!/usr/bin/env python3
"""Talks to both machines over the line: identifies, homes, runs, follows telemetry, stops, folds.

    python3 serial_client.py --rig tcp:127.0.0.1:7001 --capsule tcp:127.0.0.1:7002
    python3 serial_client.py --rig /dev/ttyACM0 --capsule /dev/ttyACM1

Needs Python 3.9 and nothing else. It was written from docs/protocol.md alone, and is meant to be read: take from it what your own
program needs. It ends with code 0 if everything was as expected, with 1 and the reason if not. Whatever goes wrong, and at Ctrl-C,
it stops both machines first. That is no safety function: keep a hand on the switch of the motor supply.
"""

import argparse
import json
import os
import random
import select
import signal
import socket
import sys
import time
from itertools import islice
from types import SimpleNamespace

VERSION = (3, 3)
SCHEMA_KEY = 0x2E817CE341FCAA55

RETRY_AFTER_S = 0.1
KEEP_ALIVE_S = 0.25


class Failed(Exception):
    """Something is not as it has to be; the text says what, and what to do."""


class Refused(Failed):
    """The machine has understood and refused."""


def expect(what, found, wanted):
    if found != wanted:
        raise Failed(f"{what} is {found}, expected {wanted}")


# ---- Values: a type is a function that takes its value from the bytes of a body ----


def boolean(data):
    return next(data) == 1


def u8(data):
    return next(data)


def uint(data):
    number = shift = 0
    while True:
        byte = next(data)
        number |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return number


def sint(data):
    number = uint(data)
    return number >> 1 ^ -(number & 1)


def text(data):
    return bytes(islice(data, uint(data))).decode()


def bytes_of(count):
    return lambda data: bytes(islice(data, count))


def optional(item):
    return lambda data: item(data) if boolean(data) else None


def list_of(item):
    return lambda data: [item(data) for _ in range(uint(data))]


def struct(**fields):
    return lambda data: SimpleNamespace(**{name: field(data) for name, field in fields.items()})


class Variant(SimpleNamespace):
    """A variant with content."""

    def __str__(self):
        content = self.content
        if isinstance(content, SimpleNamespace) and not isinstance(content, Variant):
            content = ", ".join(f"{name} {value}" for name, value in vars(content).items())
        return f"{self.name} ({content})"

    __repr__ = __str__


def enum(names, **contents):
    """Variants in the order of their numbers; `contents` has the types of those that carry something."""
    names = names.split()

    def take(data):
        number = uint(data)
        if number >= len(names):
            raise Failed(f"variant {number} of {', '.join(names)} is unknown: is this program up to date with docs/protocol.md?")
        name = names[number]
        return Variant(name=name, content=contents[name](data)) if name in contents else name

    return take


def name_of(value):
    return value.name if isinstance(value, Variant) else value


def encode_uint(number):
    coded = bytearray()
    while number >= 0x80:
        coded.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes(coded) + bytes([number])


# ---- Messages, as docs/protocol.md has them under "Types" ----

RIG_STATE = enum("Unhomed Homing Ready Running Held Stopping Faulted Moving")
CAPSULE_STATE = enum("Unreferenced Referencing Unfolded Folding Folded Unfolding Stopped Faulted WasFolded Checking")
CAPSULE_MOVES = ("Referencing", "Folding", "Unfolding", "Checking")
HOMING_PHASE = enum("Clear Seek PullOff Locate ToZero")
RESET_CAUSE = enum("PowerOn Pin Panic Watchdog Software")
SETTING_KEY = enum(
    "LeadUm FullSteps Microsteps StrokeUm MaxSpeedUmS MaxAccelUmS2 MaxStepHz StepPulseNs TurnaroundUs SeekUmS LocateUmS HomingAccelUmS2"
    " StopAccelUmS2 OvertravelUm PullOffUm FlagUm HomingTimeoutS LedgerLimitSteps LinkTimeoutMs DeadManMs SwitchFilterUs TelemetryMs"
    " ButtonCycles ButtonStrokeUm ButtonTotalMs ButtonAccelUmS2 EndForceMa FoldUmS UnfoldUmS SlowUmS LeastBatteryMv LoadedBatteryMv"
    " MotorMohm BackEmfUvCps NoLoadMa SpeedGainUaCps ShortestFoldUm LongestFoldUm EndToleranceUm EndOverrunUm DriftUm FoldTimeoutMs"
    " UnfoldTimeoutMs"
)
RIG_FAULT = enum(
    "EStopLoop EStopFrame FarLimit FlagNotFound FlagStuck BothSwitchesOpen LostSteps ReadBack Underrun WindowGuard Watchdog Panic"
    " HomingTimeout ClockMissing ClockFailed SwitchNoise",
    FlagNotFound=HOMING_PHASE,
    LostSteps=struct(residual_steps=sint),
    ReadBack=struct(commanded=sint, counted=sint),
    HomingTimeout=HOMING_PHASE,
    SwitchNoise=enum("HomeFlag FarLimit"),
)
CAPSULE_FAULT = enum(
    "Jam ThreadBroken EncoderLost OverCurrent LowBattery Timeout DriverFault EStopFrame Watchdog Panic SpoolSlip SlipOrBreak BridgeSilent"
    " SenseLost NotUnfolded SenseOrEncoder",
    Jam=struct(thread_um=sint),
    OverCurrent=struct(current_ma=uint),
    LowBattery=struct(battery_mv=uint),
    NotUnfolded=struct(wound_um=sint),
)
FIELD = enum("Cycles StrokeUm TotalUs AccelUmS2 ForwardUmS ReturnUmS FarDwellUs HomeDwellUs StartDelayUs PeriodMs PositionUm SpeedUmS ThreadUm")
REFUSAL = enum(
    "WrongDevice Incompatible RigFaulted CapsuleFaulted CauseStillPresent NothingToAcknowledge AcknowledgeFirst NotHomed NotReferenced"
    " RigBusy CapsuleBusy OutOfRange TooFast SpeedLimit StepRateLimit TooSlow NotAtHome BatteryLow AlreadyThere SettingRange SettingRule"
    " StorageFailed NothingToHold NothingToResume LoopOpen BothSwitchesOpen FarLimitOpen SupplyLow NameNotPrintable NotCalibrated",
    RigFaulted=RIG_FAULT,
    CapsuleFaulted=CAPSULE_FAULT,
    RigBusy=RIG_STATE,
    CapsuleBusy=CAPSULE_STATE,
    OutOfRange=struct(field=FIELD, requested=uint, min=uint, max=uint),
    TooFast=struct(requested_us=uint, min_us=uint, min_accel_um_s2=uint),
    SpeedLimit=struct(needed_um_s=uint, max_um_s=uint),
    StepRateLimit=struct(needed_hz=uint, max_hz=uint),
    NotAtHome=struct(position_um=sint),
    BatteryLow=struct(battery_mv=uint, min_mv=uint),
    SettingRange=struct(key=SETTING_KEY, requested=uint),
    SettingRule=struct(key=SETTING_KEY, rule=uint),
)
WIRE_ERROR = enum("NoSession Malformed SequenceReused Stale")
RUN_OUTCOME = enum("None Running Complete Stopped LinkLost Faulted", Faulted=RIG_FAULT)
ACTUATION_KIND = enum("Reference Fold Unfold Calibrate CheckFolded FoldTo")
ACTUATION_OUTCOME = enum("None Running Complete Stopped LinkLost Faulted", Faulted=CAPSULE_FAULT)

RIG_EVENT = enum(
    "Homed RunStarted StrokeDone RunEnded Stopped Faulted Held Resumed Moved SettingChanged SettingsReset SettingsUnusable ButtonIgnored",
    Homed=struct(repeat_steps=sint, shift_steps=sint),
    RunStarted=struct(run=uint),
    StrokeDone=struct(stroke=uint, residual_steps=sint),
    RunEnded=struct(run=uint, outcome=RUN_OUTCOME),
    Stopped=struct(position_steps=sint),
    Faulted=RIG_FAULT,
    Held=struct(position_steps=sint),
    Moved=struct(position_steps=sint),
    SettingChanged=SETTING_KEY,
)
CAPSULE_EVENT = enum(
    "Started Ended Faulted NotKept Drifted SettingChanged SettingsReset SettingsUnusable",
    Started=struct(actuation=uint, kind=ACTUATION_KIND),
    Ended=struct(actuation=uint, outcome=ACTUATION_OUTCOME),
    Faulted=CAPSULE_FAULT,
    Drifted=struct(by_um=sint),
    SettingChanged=SETTING_KEY,
)
WHAT = enum("Booted Acknowledged LinkLost Rig Capsule", Booted=RESET_CAUSE, Rig=RIG_EVENT, Capsule=CAPSULE_EVENT)
EVENT = struct(index=uint, time_us=uint, what=WHAT)

RIG_INPUTS = struct(home_flag=boolean, far_limit=boolean, estop_loop=boolean)
RIG_TELEMETRY = struct(
    time_us=uint, state=RIG_STATE, position_steps=sint, commanded_steps=sint, speed_um_s=sint, stroke=uint, residual_steps=sint, inputs=RIG_INPUTS
)
CAPSULE_TELEMETRY = struct(time_us=uint, state=CAPSULE_STATE, thread_um=sint, current_ma=uint, battery_mv=uint, drive_mv=sint)
TELEMETRY = enum("Rig Capsule", Rig=RIG_TELEMETRY, Capsule=CAPSULE_TELEMETRY)

TIMING = enum(
    "Total Speeds",
    Total=struct(total_us=uint, accel_um_s2=uint),
    Speeds=struct(forward_um_s=uint, return_um_s=uint, accel_um_s2=uint),
)
RUN = struct(
    cycles=uint, stroke_um=uint, timing=TIMING, far_dwell_us=uint, home_dwell_us=uint, start_delay_us=uint, link_loss=enum("Stop Finish")
)
STROKE = struct(steps=uint, duration_ticks=uint, ramp_ticks=uint, peak_um_s=uint, accel_um_s2=uint)
RUN_ACCEPTED = struct(run=uint, requested=RUN, forward=STROKE, back=STROKE, total_ticks=uint, edges=uint, plan_hash=uint)
# fmt: off
IDENTITY = struct(
    device=enum("Rig Capsule"), protocol=struct(major=u8, minor=u8), schema_key=uint, uid=bytes_of(12),
    revision=struct(commit=uint, dirty=boolean), profile=enum("Debug Firmware"), boot_id=uint, reset_cause=RESET_CAUSE, session=u8,
)
RIG_STATUS = struct(
    time_us=uint, state=RIG_STATE, fault=optional(RIG_FAULT), homed=boolean, position_steps=sint, position_um=sint, stroke_um=uint,
    steps_per_rev=uint, lead_um=uint, inputs=RIG_INPUTS, run=uint, stroke=uint, strokes=uint, elapsed_us=uint, needs_acknowledge=boolean,
)
RUN_RECORD = struct(
    run=uint, outcome=RUN_OUTCOME, strokes=uint, commanded_edges=uint, counted_edges=uint, ticks=uint, plan_hash=uint, min_steps=sint,
    max_steps=sint, worst_residual_steps=sint, min_queue=optional(uint), glitches=uint, holds=uint, image_hash=uint, prepared_edges=uint,
    edges_timed=uint, worst_interval_error_ticks=uint,
)
CAPSULE_STATUS = struct(
    time_us=uint, state=CAPSULE_STATE, fault=optional(CAPSULE_FAULT), referenced=boolean, thread_um=sint, current_ma=uint, battery_mv=uint,
    actuation=uint, needs_acknowledge=boolean,
)
ACTUATION_RECORD = struct(
    actuation=uint, kind=ACTUATION_KIND, outcome=ACTUATION_OUTCOME, duration_ms=uint, thread_um=sint, end_current_ma=uint,
    peak_current_ma=uint, engaged_um=sint, energy_mj=uint, min_battery_mv=uint,
)
# fmt: on
DONE = struct()
ACTUATION_ACCEPTED = struct(actuation=uint, timeout_ms=uint)

# Requests that this program sends: number, and type of the response.
REQUESTS = {
    "Hello": (0, IDENTITY),
    "KeepAlive": (1, DONE),
    "SetTelemetry": (3, struct(period_ms=uint)),
    "GetEvents": (4, struct(oldest=uint, next=uint, events=list_of(EVENT))),
    "GetRigStatus": (6, RIG_STATUS),
    "Home": (7, struct(seek_um_s=uint, locate_um_s=uint, max_travel_um=uint)),
    "Run": (8, RUN_ACCEPTED),
    "GetRunRecord": (9, RUN_RECORD),
    "GetCapsuleStatus": (10, CAPSULE_STATUS),
    "Reference": (11, ACTUATION_ACCEPTED),
    "Fold": (12, ACTUATION_ACCEPTED),
    "GetActuationRecord": (14, ACTUATION_RECORD),
}


# ---- Frames ----

REQUEST, REPLY, URGENT, TELEMETRY_KIND, EVENT_KIND = 1, 2, 3, 4, 5


def crc32c(data):
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def cobs_encode(data):
    # A frame has at most 168 bytes: no piece is so long that COBS would have to split it.
    return b"".join(bytes([len(piece) + 1]) + piece for piece in bytes(data).split(b"\0"))


def cobs_decode(coded):
    """The bytes, or None if this is no COBS."""
    pieces, at = [], 0
    while at < len(coded):
        end = at + coded[at]
        if end > len(coded):
            return None
        pieces.append(coded[at + 1 : end])
        at = end
    return b"\0".join(pieces)


def frame_of(kind, session, sequence, body):
    content = bytes([kind, session]) + sequence.to_bytes(2, "little") + body
    return b"\0" + cobs_encode(content + crc32c(content).to_bytes(4, "little")) + b"\0"


def content_of(piece):
    """Kind, session, sequence and body of what stood between two zeros; None if it is no good frame."""
    raw = cobs_decode(piece)
    if raw is None or len(raw) < 8 or crc32c(raw[:-4]) != int.from_bytes(raw[-4:], "little"):
        return None
    return raw[0], raw[1], int.from_bytes(raw[2:4], "little"), raw[4:-4]


def value_of(kind, body):
    """Exactly one value of a type."""
    data = iter(body)
    try:
        value = kind(data)
    except (StopIteration, RuntimeError):
        raise Failed(f"a message ends too early: {body.hex()}") from None
    if next(data, None) is not None:
        raise Failed(f"a message has bytes left over: {body.hex()}")
    return value


# ---- The line ----


class Line:
    """A TCP server, or a serial port at 115200 baud, 8N1."""

    def __init__(self, where):
        self.where = where
        try:
            self._open(where)
        except (OSError, ValueError) as why:
            raise Failed(f"cannot open {where}: {why}; wanted is tcp:HOST:PORT or a serial port") from None

    def _open(self, where):
        if where.startswith("tcp:"):
            host, port = where[4:].rsplit(":", 1)
            connection = socket.create_connection((host, int(port)), timeout=5)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._waits_on, self._read, self._write = connection, connection.recv, connection.sendall
            return
        try:
            import fcntl
            import termios
            import tty
        except ImportError:
            raise Failed("serial ports need Linux or macOS here; elsewhere use tcp:HOST:PORT") from None
        # Without waiting for a carrier, and for nobody else meanwhile.
        port = os.open(where, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        os.set_blocking(port, True)
        fcntl.ioctl(port, termios.TIOCEXCL)
        tty.setraw(port)
        flags = termios.tcgetattr(port)
        flags[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
        flags[4] = flags[5] = termios.B115200
        termios.tcsetattr(port, termios.TCSANOW, flags)
        self._waits_on, self._read, self._write = port, lambda most: os.read(port, most), lambda data: os.write(port, data)

    def read(self, wait_s):
        """The bytes that have come; none if nothing comes within `wait_s`."""
        if not select.select([self._waits_on], [], [], max(wait_s, 0))[0]:
            return b""
        data = self._read(4096)
        if not data:
            raise Failed(f"{self.where} has closed the line: is the machine still there?")
        return data

    def write(self, data):
        self._write(data)


# ---- A machine ----


class Machine:
    """The host's end of a session with one machine."""

    def __init__(self, where, kind, attempts):
        self.line, self.attempts = Line(where), attempts
        # Any first sequence will do. A random one: what an earlier program was answered too late is not for us.
        self.session, self.sequence, self.received = 0, random.getrandbits(16), b""
        self.samples, self.missed, self.next_sample = [], 0, None
        self.events, self.next_event = [], None
        self.only_stops = False
        body = bytes(VERSION) + encode_uint(SCHEMA_KEY) + encode_uint(random.getrandbits(32))
        self.identity = identity = self.ask("Hello", body)
        self.session = identity.session
        version = (identity.protocol.major, identity.protocol.minor)
        expect(f"the machine at {where}", identity.device, kind)
        if (version, identity.schema_key) != (VERSION, SCHEMA_KEY):
            raise Failed(
                f"the machine speaks protocol {version[0]}.{version[1]} with key {identity.schema_key:016x}, this program"
                f" {VERSION[0]}.{VERSION[1]} with {SCHEMA_KEY:016x}: bring it up to date with docs/protocol.md, or flash the machine"
            )
        # Skips the events from before: they are not this program's.
        self.next_event = self.ask("GetEvents", encode_uint(0xFFFFFFFF)).next

    def ask(self, name, body=b""):
        """Sends a request until it is answered; the response."""
        number, response = REQUESTS[name]
        answer = self._exchange(REQUEST, encode_uint(number) + body, name)
        reply = enum(
            "Accepted Refused Wire Urgent",
            Accepted=lambda data: (expect("the response's number", uint(data), number), response(data))[1],
            Refused=REFUSAL,
            Wire=WIRE_ERROR,
        )
        reply = value_of(reply, answer)
        if reply.name == "Refused":
            raise Refused(f"{name} was refused: {reply.content}")
        if reply.name != "Accepted":
            raise Failed(f"{name} was answered with {reply}: another program, or a reset?")
        return reply.content

    def stop(self, emergency=False):
        """Stops, whatever the state. Nothing else that comes may keep it from that."""
        self.only_stops = True
        urgent = bytes([1 if emergency else 0])
        expect("the answer to a stop", self._exchange(URGENT, urgent, "a stop"), b"\x03" + urgent)
        self.only_stops = False

    def attend(self, seconds):
        """Takes what comes for a while, and gives a sign of life now and then."""
        until, next_sign = time.monotonic() + seconds, time.monotonic() + KEEP_ALIVE_S
        while (now := time.monotonic()) < until:
            if now >= next_sign:
                self.ask("KeepAlive")
                next_sign = time.monotonic() + KEEP_ALIVE_S
            else:
                self._receive(min(until, next_sign) - now)

    def _exchange(self, kind, body, name):
        """The body of the reply to this frame, which is sent until it comes."""
        sequence = self.sequence
        self.sequence = (sequence + 1) % 0x10000
        frame = frame_of(kind, self.session, sequence, body)
        for _ in range(self.attempts):
            self.line.write(frame)
            until = time.monotonic() + RETRY_AFTER_S
            while (left := until - time.monotonic()) > 0:
                for reply_to, answer in self._receive(left):
                    # Of a stop and a request, the variant of the reply tells which is answered.
                    if reply_to == sequence and (answer[:1] == b"\x03") == (kind == URGENT):
                        return answer
        raise Failed(f"{self.line.where} did not answer {name}; whether it was carried out is unknown. Powered? The right port?")

    def _receive(self, wait_s):
        """Sorts what comes; gives the replies: sequence, body."""
        pieces = (self.received + self.line.read(wait_s)).split(b"\0")
        self.received = pieces.pop()[-512:]
        replies = []
        for kind, _, sequence, body in filter(None, map(content_of, filter(None, pieces))):
            if kind == REPLY:
                replies.append((sequence, body))
            elif self.only_stops:
                continue
            elif kind == EVENT_KIND and self.next_event is not None:
                self._note(value_of(EVENT, body))
            elif kind == TELEMETRY_KIND:
                if self.next_sample is not None:
                    self.missed += (sequence - self.next_sample) % 0x10000
                self.next_sample = (sequence + 1) % 0x10000
                self.samples.append(value_of(TELEMETRY, body).content)
        return replies

    def _note(self, event):
        # An event may be dropped on a busy line. Nothing is lost: `fetch_events` gets it.
        if event.index == self.next_event:
            self.events.append(event)
            self.next_event += 1

    def fetch_events(self):
        """Gets the events that did not come by themselves, and gives all that were not given before."""
        while True:
            answer = self.ask("GetEvents", encode_uint(self.next_event))
            if not answer.events:
                events, self.events = self.events, []
                # Some events come wrapped in `Rig` or `Capsule`: unwraps them.
                return [event.what.content if name_of(event.what) in ("Rig", "Capsule") else event.what for event in events]
            self.next_event = max(self.next_event, answer.oldest)
            for event in answer.events:
                self._note(event)


# ---- What is done with them ----


def say(words):
    print(words, flush=True)


def identify(machine):
    it = machine.identity
    dirty = ", built from changed sources" if it.revision.dirty else ""
    say(
        f"{it.device} {it.uid.hex()} at {machine.line.where}: protocol {it.protocol.major}.{it.protocol.minor}, key {it.schema_key:016x},"
        f" commit {it.revision.commit:08x}{dirty}, start {it.boot_id} ({it.reset_cause})"
    )


def rig_at_rest(rig, seconds):
    """Waits until nothing moves; the status then."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        status = rig.ask("GetRigStatus")
        if status.state == "Faulted":
            raise Failed(f"the rig has latched a fault: {status.fault}")
        if status.state in ("Unhomed", "Ready"):
            return status
        rig.attend(0.05)
    raise Failed(f"the rig is still {status.state} after {seconds:.0f} s")


def home(rig):
    accepted = rig.ask("Home")
    status = rig_at_rest(rig, 30 + 5 * accepted.max_travel_um / accepted.seek_um_s)
    expect("state, homed and position after homing", (status.state, status.homed, status.position_steps), ("Ready", True, 0))
    homed = [event.content for event in rig.fetch_events() if name_of(event) == "Homed"]
    expect("the number of events Homed", len(homed), 1)
    say(f"homed; the two passes differ by {homed[0].repeat_steps} steps")
    return status


def start_run(rig, status, cycles, stroke_um, total_us):
    """Orders a run and makes sure that the plan is what was asked for."""
    body = [cycles, stroke_um, 0, total_us, 400_000, 0, 0, 0, 0]
    accepted = rig.ask("Run", b"".join(map(encode_uint, body)))
    steps = stroke_um * status.steps_per_rev // status.lead_um
    expect("steps of a stroke", accepted.forward.steps, steps)
    expect("steps of the run", accepted.edges, 2 * cycles * steps)
    expect("duration of the run, ticks of 10 ns", accepted.total_ticks, 100 * total_us)
    say(f"run {accepted.run}: {accepted.edges} steps in {total_us / 1e6} s, at most {accepted.forward.peak_um_s / 1e3} mm/s")
    return accepted


def follow_run(rig, accepted, total_us):
    """Waits for the end of a run, with its telemetry; the record."""
    rig.samples.clear()
    until = time.monotonic() + 10 * total_us / 1e6 + 10
    while (record := rig.ask("GetRunRecord")).outcome == "Running":
        if time.monotonic() > until:
            raise Failed(f"run {accepted.run} does not end")
        rig.attend(0.2)
        last = rig.samples[-1] if rig.samples else None
        if last:
            say(f"  {last.state}, stroke {last.stroke}, {last.position_steps} steps, {last.speed_um_s / 1e3:+.1f} mm/s")
    expect("the record's run", record.run, accepted.run)
    return record


def run(rig, status, cycles, stroke_um, total_us):
    """A run from its beginning to its end."""
    rig.ask("SetTelemetry", encode_uint(20))
    accepted = start_run(rig, status, cycles, stroke_um, total_us)
    record = follow_run(rig, accepted, total_us)
    rig.ask("SetTelemetry", encode_uint(0))
    expect("the run's outcome", record.outcome, "Complete")
    expect("steps commanded and counted", (record.commanded_edges, record.counted_edges), (accepted.edges, accepted.edges))
    expect("the run's duration, ticks of 10 ns", record.ticks, accepted.total_ticks)
    expect("the run's least and greatest position", (record.min_steps, record.max_steps), (0, accepted.forward.steps))
    expect("the plan", record.plan_hash, accepted.plan_hash)
    events = [name_of(event) for event in rig.fetch_events()]
    expect("the run's events", events, ["RunStarted"] + 2 * cycles * ["StrokeDone"] + ["RunEnded"])
    expect("samples of telemetry that are missing", rig.missed, 0)
    expect("samples of telemetry while it ran, at least one", any(sample.state == "Running" for sample in rig.samples), True)
    expect("a position in telemetry outside of the stroke", [s.position_steps for s in rig.samples if not 0 <= s.position_steps <= record.max_steps], [])
    say(f"complete: {record.counted_edges} of {accepted.edges} steps counted, {len(rig.samples)} samples, none missing")
    return record


def stop_within_a_run(rig, status, stroke_um, total_us):
    """Begins a run, stops it in its first stroke."""
    accepted = start_run(rig, status, 1, stroke_um, total_us)
    rig.attend(total_us / 1e6 / 4)
    rig.stop()
    after = rig_at_rest(rig, 30)
    record = rig.ask("GetRunRecord")
    expect("outcome of the stopped run", record.outcome, "Stopped")
    expect("state and homed after the stop", (after.state, after.homed), ("Ready", True))
    expect("position after the stop, by the steps counted", after.position_steps, record.counted_edges)
    expect("steps commanded, of those counted", record.commanded_edges, record.counted_edges)
    expect("the stop came within the first stroke", 0 < record.counted_edges < accepted.forward.steps, True)
    rig.attend(0.2)
    expect("position a while later", rig.ask("GetRigStatus").position_steps, after.position_steps)
    say(f"stopped at {after.position_um / 1e3} mm, the position is kept")
    return record


def actuate(capsule, name, state):
    """One motion of the capsule; its record."""
    accepted = capsule.ask(name)
    until = time.monotonic() + 10 * accepted.timeout_ms / 1e3
    while (status := capsule.ask("GetCapsuleStatus")).state in CAPSULE_MOVES:
        if time.monotonic() > until:
            raise Failed(f"{name} does not end")
        capsule.attend(0.1)
    if status.fault:
        raise Failed(f"{name}: the capsule has latched a fault: {status.fault}")
    # Its last numbers settle while the motor is braked.
    before, record = None, capsule.ask("GetActuationRecord")
    while record != before:
        capsule.attend(0.05)
        before, record = record, capsule.ask("GetActuationRecord")
    expect(f"{name}: outcome and state", (record.actuation, record.outcome, status.state), (accepted.actuation, "Complete", state))
    say(f"{name}: {record.thread_um / 1e3} mm of thread, {record.duration_ms} ms, {record.energy_mj} mJ, at most {record.peak_current_ma} mA")
    return record


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rig", required=True, metavar="WHERE", help="tcp:HOST:PORT or a serial port")
    parser.add_argument("--capsule", metavar="WHERE", help="the same; without it nothing is folded")
    parser.add_argument("--cycles", type=int, default=1)
    parser.add_argument("--stroke-mm", type=int, default=20)
    parser.add_argument("--duration-s", type=int, default=2)
    parser.add_argument("--attempts", type=int, default=8, help="how often a request is sent; more for an emulator on a busy computer")
    chosen = parser.parse_args()
    stroke_um, total_us = 1_000 * chosen.stroke_mm, 1_000_000 * chosen.duration_s

    # A shell that starts it in the background has Ctrl-C ignored; here it has to stop the machines.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    machines = []
    try:
        rig = Machine(chosen.rig, "Rig", chosen.attempts)
        machines.append(rig)
        identify(rig)
        if chosen.capsule:
            capsule = Machine(chosen.capsule, "Capsule", chosen.attempts)
            machines.append(capsule)
            identify(capsule)

        status = home(rig)
        whole = run(rig, status, chosen.cycles, stroke_um, total_us)
        stopped = stop_within_a_run(rig, status, stroke_um, total_us)
        done = {"run": vars(whole), "stopped": vars(stopped)}
        if chosen.capsule:
            if not capsule.ask("GetCapsuleStatus").referenced:
                actuate(capsule, "Reference", "Unfolded")
            done["fold"] = vars(actuate(capsule, "Fold", "Folded"))
    except BaseException as why:
        for machine in machines:
            try:
                machine.stop()
            # Another Ctrl-C, too, leaves the other machine its stop.
            except (Failed, OSError, KeyboardInterrupt) as silence:
                print(f"NOT STOPPED: {silence} Use the switch of the motor supply.", file=sys.stderr)
        if not isinstance(why, (Failed, OSError, KeyboardInterrupt)):
            raise
        print(f"failed: {str(why) or 'interrupted'}", file=sys.stderr)
        return 1
    say(json.dumps(done, default=str))
    return 0


if __name__ == "__main__":
    sys.exit(main())
