"""Records are as docs/records.schema.json says: `python3 test_records.py FOLDER` holds those of a folder against it."""

import importlib
import json
import pathlib
import subprocess
import sys
import tempfile
import unittest

from bench import missing, programs

from retrograde.data import trials_in

SOURCES = pathlib.Path(__file__).parents[2]
# The plan of the paper, shortened to two trials of one short cycle.
SHORTER = {
    "cycles = 5": "cycles = 1",
    "duration_s = 40": "duration_s = 8",
    'lubrication = ["dry", "lubricated"]': 'lubrication = ["dry"]',
    'indentation = ["a1", "a2", "a3", "a4", "a5"]': 'indentation = ["a5"]',
    "repeats = 10": "repeats = 1",
}


def hold(folder: pathlib.Path) -> int:
    """Raises an error unless every sidecar and every row of telemetry fits the schema. Returns how many trials there are."""
    validator = importlib.import_module("jsonschema").Draft202012Validator
    schema = json.loads((SOURCES / "docs/records.schema.json").read_text(encoding="utf-8"))
    rows = {kind: validator({"$defs": schema["$defs"], "$ref": f"#/$defs/{name}"}) for kind, name in
            (("run", "RigSample"), ("actuation", "CapsuleSample"))}
    trials = trials_in(folder)
    for trial in trials:
        validator(schema).validate(trial.sidecar)
        for row in trial.telemetry:
            rows[trial.kind].validate(row)
    return len(trials)


class RecordsTest(unittest.TestCase):
    def test_a_campaign_fits_the_schema(self) -> None:
        try:
            importlib.import_module("jsonschema")
        except ImportError as why:
            raise unittest.SkipTest(str(why)) from why
        why = missing()
        if why:
            raise unittest.SkipTest(why)
        plan = (SOURCES / "examples/paper.toml").read_text(encoding="utf-8")
        for long, short in SHORTER.items():
            self.assertIn(long, plan)
            plan = plan.replace(long, short)
        plan = plan.replace("[metadata]", '[metadata]\nextra.room = "3.14"')
        with tempfile.TemporaryDirectory() as name:
            folder = pathlib.Path(name)
            (folder / "plan.toml").write_text(plan, encoding="utf-8")
            command = [programs() / "retrograde", "--rig", "virtual", "--capsule", "virtual", "campaign", "run"]
            subprocess.run([*command, folder / "plan.toml", "--out", folder / "data", "--yes"], check=True, capture_output=True)
            self.assertGreaterEqual(hold(folder / "data"), 4)
            for conditions in (folder / "data").rglob("conditions.json"):
                known = json.loads(conditions.read_text(encoding="utf-8"))
                self.assertEqual(known["metadata"]["extra"], {"room": "3.14"})


if __name__ == "__main__":
    if not (len(sys.argv) == 2 and hold(pathlib.Path(sys.argv[1]))):
        sys.exit("which folder of records? python3 test_records.py FOLDER")
