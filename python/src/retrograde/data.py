"""Reads the records of Retrograde: the folder of a campaign, or a folder of trials.

Needs Python 3.9 and nothing else; `Table.pandas()` and `Campaign.xarray()` need pandas and xarray.

    campaign = retrograde.data.Campaign("paper")
    for trial in campaign.trials: print(trial["trial"], trial["status"], trial["displacement_mm"])
    rows = campaign.telemetry(17)                 # rows of the run's CSV file, numbers as numbers
    frame = campaign.table().pandas()

Every row has an `origin`: `board` is a measurement, `virtual` a simulation. Do not mix them.
"""

import csv
import hashlib
import json
import os
import pathlib
import re
from typing import Any, Dict, List, Optional, Union

Path = Union[str, "os.PathLike[str]"]
Cell = Union[None, bool, int, float, str]
# A row of a CSV file by column name.
Row = Dict[str, Any]

# Columns of text, in which digits are not a number.
WORDS = {"camera_file", "condition", "excluded", "indentation", "name", "note", "reason", "text"}
# Numbers as the tool writes them. Python would also accept `01`, `1_0` and `nan`.
NUMBER = re.compile(r"-?(0|[1-9][0-9]*)(?P<part>\.[0-9]+)?(?P<exponent>[eE][-+]?[0-9]+)?")


def value(text: Optional[str], column: Optional[str] = None) -> Cell:
    """A cell as int, float, bool or text; None if it is empty. Cells of text columns stay text."""
    if not text:
        return None
    if column in WORDS:
        return text
    if text in ("true", "false"):
        return text == "true"
    number = NUMBER.fullmatch(text)
    if number is None:
        return text
    return int(text) if number["part"] is None and number["exponent"] is None else float(text)


def read_csv(path: Path) -> "Table":
    """The rows of a CSV file as dictionaries. Skips an incomplete last line, whose writing was cut off."""
    with open(path, newline="", encoding="utf-8-sig") as file:
        whole = (line for line in file if line.endswith("\n"))
        rows = csv.DictReader(whole)
        if any(sign in name for name in rows.fieldnames or [] for sign in ";\t"):
            raise ValueError(f"{path}: its columns are separated by `;` or tabs: a spreadsheet has saved it")
        return Table({name: value(cell, name) for name, cell in row.items()} for row in rows)


class Table(List[Row]):
    """Rows as dictionaries."""

    def pandas(self) -> Any:
        """As a pandas.DataFrame."""
        import pandas

        return pandas.DataFrame(list(self))


class Trial:
    """A sidecar and the telemetry beside it."""

    def __init__(self, sidecar: Path) -> None:
        self.path = pathlib.Path(sidecar)
        self.sidecar: Dict[str, Any] = json.loads(self.path.read_text(encoding="utf-8-sig"))
        if "action" not in self.sidecar or "telemetry" not in self.sidecar:
            raise ValueError(f"{sidecar} is not the record of a trial")

    @property
    def kind(self) -> str:
        """`run` or `actuation`."""
        return str(self.sidecar["action"]["kind"])

    @property
    def origin(self) -> str:
        """`board`, `virtual` or `unknown`. The UID of a simulated chip outweighs the written origin."""
        device = self.sidecar["device"]
        if device["uid"].lower().startswith(b"virtual".hex()):
            return "virtual"
        return str(device.get("origin", "unknown"))

    @property
    def whole(self) -> bool:
        """Whether it has an end and all its rows, as in `retrograde verify`. The motion may have ended as planned without."""
        cut = "the telemetry was not recorded whole" in (self.sidecar["error"] or "")
        return self.sidecar["status"] != "running" and not cut

    @property
    def telemetry(self) -> Table:
        """The rows of the CSV file."""
        return read_csv(self.path.with_name(self.sidecar["telemetry"]))


def trials_in(folder: Path) -> List[Trial]:
    """All trials in a folder and below it, in the order of their start. A refused action is not a trial."""
    found = []
    for path in sorted(pathlib.Path(folder).rglob("*.json")):
        try:
            trial = Trial(path)
        except (ValueError, KeyError):
            continue
        if trial.sidecar.get("status") != "refused":
            found.append(trial)
    return sorted(found, key=lambda trial: trial.sidecar["started_utc"])


class Campaign:
    """The folder of a campaign."""

    def __init__(self, folder: Path) -> None:
        self.folder = pathlib.Path(folder)
        self.order = read_csv(self.folder / "order.csv")
        self.rows = read_csv(self.folder / "trials.csv")
        self.readings = read_csv(self.folder / "readings.csv")
        self.trials = [self._replay(planned) for planned in self.order]

    @property
    def origin(self) -> str:
        """Origin of all rows: a campaign is measured or simulated, never both."""
        origins = {row["origin"] for row in [*self.rows, *self.readings]}
        return origins.pop() if len(origins) == 1 else "unknown"

    def _replay(self, planned: Row) -> Row:
        """Attempts and state of a trial, from its rows of the ledger."""
        attempts: List[Row] = []
        skipped: Optional[str] = None
        excluded: Optional[str] = None
        for row in self.rows:
            if row["trial"] != planned["trial"]:
                continue
            event = row["event"]
            if event == "began":
                empty = dict(outcome=None, displacement_mm=None, source=None, given_up=None)
                attempts.append(dict(row, **empty))
            elif event == "ended":
                attempts[-1].update(outcome=row["outcome"], ended_text=row["text"])
            elif event == "displacement":
                attempts[-1].update(displacement_mm=row["displacement_mm"], source=row["source"])
            elif event == "undone":
                attempts[-1].update(displacement_mm=None, source=None)
            elif event == "repeated":
                attempts[-1]["given_up"] = row["text"] or ""
                excluded = None
            elif event == "skipped":
                skipped = row["text"] or ""
            elif event == "excluded":
                excluded = row["text"] or ""
            elif event == "included":
                # Clear both; a trial is either skipped or excluded.
                if skipped is not None:
                    skipped = None
                else:
                    excluded = None
        last = attempts[-1] if attempts else None
        counting = last if last and last["outcome"] == "complete" and last["given_up"] is None else None
        if skipped is not None:
            status = "skipped"
        elif last is not None and last["outcome"] is None:
            status = "under_way"
        elif counting is None:
            status = "open"
        elif excluded is not None:
            status = "excluded"
        elif counting["displacement_mm"] is None:
            status = "unmeasured"
        else:
            status = "done"
        return dict(
            planned,
            status=status,
            attempts=attempts,
            attempt=counting["attempt"] if counting else None,
            indentation_mm=counting["indentation_mm"] if counting else None,
            displacement_mm=counting["displacement_mm"] if counting else None,
            source=counting["source"] if counting else None,
            reason=skipped or excluded,
            origin=self.origin,
        )

    def attempt_folder(self, trial: int) -> Optional[pathlib.Path]:
        """The folder of the attempt that counts; None if none does."""
        attempt = self.trials[trial - 1]["attempt"]
        return None if attempt is None else self.folder / "trials" / f"{trial:03}-{attempt}"

    def whole(self, trial: int) -> bool:
        """Whether the records of the attempt that counts are complete, except for unfolding the capsule after it."""
        return all(record.whole for record in self.records(trial) if not record.path.name.startswith("unfold-"))

    def records(self, trial: int) -> List[Trial]:
        """The records of the attempt that counts: the capsule's in the order of its own clock, the run last."""
        folder = self.attempt_folder(trial)
        records = [] if folder is None else trials_in(folder)

        def key(record: Trial) -> Any:
            return record.kind == "run", [event["time_us"] for event in record.sidecar["events"]]

        return sorted(records, key=key)

    def run(self, trial: int) -> Optional[Trial]:
        """The run of the attempt that counts; None without one."""
        return next((record for record in self.records(trial) if record.kind == "run"), None)

    def telemetry(self, trial: int) -> Table:
        """The rows of the run's CSV file."""
        run = self.run(trial)
        if run is None:
            raise ValueError(f"no attempt at trial {trial} counts: it has no run")
        return run.telemetry

    def changed(self) -> List[str]:
        """Files that differ from SHA256SUMS, relative to the folder. `retrograde verify` finds more."""
        changed = []
        for line in (self.folder / "SHA256SUMS").read_text(encoding="utf-8").splitlines():
            listed, name = line.split(maxsplit=1)
            path = self.folder / name.lstrip("*")
            if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != listed:
                changed.append(name.lstrip("*"))
        return changed

    def changed_trials(self) -> Dict[int, List[str]]:
        """Changed, removed or added files of the attempts that count, by number of the trial."""
        lines = (self.folder / "SHA256SUMS").read_text(encoding="utf-8").splitlines()
        listed = {line.split(maxsplit=1)[1].lstrip("*") for line in lines}
        changed = self.changed()
        found: Dict[int, List[str]] = {}
        for trial in self.trials:
            folder = self.attempt_folder(trial["trial"])
            if folder is None:
                continue
            inside = folder.relative_to(self.folder).as_posix() + "/"
            there = [path.relative_to(self.folder).as_posix() for path in folder.rglob("*") if path.is_file()]
            names = {name for name in changed if name.startswith(inside)} | {name for name in there if name not in listed}
            if names:
                found[trial["trial"]] = sorted(names)
        return found

    def counted(self) -> Table:
        """The trials that count, as rows: done, with complete and unchanged files."""
        changed = self.changed_trials()
        done = [trial for trial in self.trials if trial["status"] == "done" and trial["trial"] not in changed]
        return Table(trial for trial in done if self.whole(trial["trial"]))

    def table(self) -> Table:
        """All trials as rows, without their attempts."""
        return Table({name: cell for name, cell in trial.items() if name != "attempts"} for trial in self.trials)

    def xarray(self) -> Any:
        """Displacements of the series as an xarray.DataArray over walls, indentation and repeat."""
        series = [trial for trial in self.counted() if trial["purpose"] == "series"]
        frame = Table(series).pandas().set_index(["lubrication", "indentation", "repeat"])
        array = frame["displacement_mm"].to_xarray()
        array.attrs.update(units="mm", origin=self.origin)
        return array
