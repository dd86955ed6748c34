"""The package knows what docs/openapi.json lists, and the server answers as it says."""

import json
import re
import unittest
from typing import Any, Callable, Dict, List, Optional, Set, Tuple

import retrograde
from retrograde import client, types

from bench import DOCUMENT

# Paths that only browsers and generators ask for.
OTHERS = {("GET", "/"), ("GET", "/openapi.json")}


class Noted(retrograde.Lab):
    """Notes what is asked for, and answers so that each method goes on."""

    def __init__(self) -> None:
        super().__init__("http://127.0.0.1:1/")
        self.asked: Set[Tuple[str, str]] = set()

    def _once(
        self, method: str, path: str, body: Optional[Dict[str, object]], more: Dict[str, str], timeout_s: float
    ) -> Tuple[int, bytes]:
        self.asked.add((method, path.split("?")[0]))
        done = {"id": "1", "machine": "rig", "kind": "x", "state": "complete", "result": {}}
        answer: Dict[str, Any] = {"ok": True, "instance": "i", "machines": {"rig": {}, "capsule": {}}, "action": done}
        answer["time_utc"] = "2026-11-23T03:00:00Z"
        answer.update({name: [] for name in ("actions", "records", "settings")})
        answer.update({name: {} for name in ("plan", "health")})
        return 200, json.dumps(answer).encode()


class OpenApiTest(unittest.TestCase):
    schemas = DOCUMENT["components"]["schemas"]

    def fields(self, name: str) -> Set[str]:
        """Fields of a schema, with those that it takes over."""
        schema = self.schemas[name]
        found = set(schema.get("properties", {}))
        for part in schema.get("allOf", []):
            reference = part.get("$ref", "").rpartition("/")[2]
            found |= self.fields(reference) if reference else set(part.get("properties", {}))
        return found

    def test_each_request_has_a_method(self) -> None:
        lab = Noted()
        rig, capsule = lab.rig, lab.capsule
        calls: List[Callable[[], object]] = [lab.state, lab.actions, lab.records, lab.plan, lab.stop, lab.estop]
        calls += [lambda: lab.action("ID"), lambda: lab.record("NAME"), lambda: rig.move(1), lambda: rig.jog("away").__enter__()]
        calls += [rig.health, rig.settings, capsule.settings, rig.home, rig.run, rig.hold, rig.resume, rig.acknowledge]
        calls += [capsule.acknowledge, capsule.reference, capsule.calibrate, capsule.check, capsule.fold, capsule.unfold]
        for call in calls:
            call()
        # These two are asked for in another way.
        lab.asked |= {("GET", "/api/v1/stream"), ("POST", "/api/v1/rig/jog/renew")}
        listed = {(method.upper(), path) for path, methods in DOCUMENT["paths"].items() for method in methods}
        concrete = {(method, re.sub(r"\{(\w+)\}", lambda name: name.group(1).upper(), path)) for method, path in listed - OTHERS}
        self.assertEqual(concrete - lab.asked, set(), "the package has no method for these")
        self.assertEqual(lab.asked - concrete, set(), "the server has no such requests")

    def test_each_field_is_known(self) -> None:
        for name, kind in {
            "Action": types.ActionData,
            "Record": types.RecordEntry,
            "Setting": types.Setting,
            "State": types.State,
            "Rig": types.RigState,
            "Capsule": types.CapsuleState,
        }.items():
            known: Set[str] = set()
            for base in (kind, *getattr(kind, "__orig_bases__", ())):
                known |= set(getattr(base, "__annotations__", {}))
            with self.subTest(name):
                self.assertEqual(self.fields(name) - known, set(), f"add these to types.{kind.__name__}")
        self.assertEqual(self.fields("Run"), set(client.RUN_NUMBERS) | set(client.RUN_TEXTS))
        self.assertEqual(self.fields("Run"), set(types.RunOptions.__annotations__))
        samples = [self.schemas[name]["properties"]["samples"]["items"] for name in ("RigSamples", "CapsuleSamples")]
        fields = {field for sample in samples for field in sample.get("properties", {})}
        self.assertEqual(fields - set(types.Sample.__annotations__), set(), "add these to types.Sample")

    def test_each_end_of_an_action_is_known(self) -> None:
        states = set(self.schemas["Action"]["properties"]["state"].get("enum", []))
        self.assertEqual(states, set(client.OVER) | {"starting", "under_way"})


if __name__ == "__main__":
    unittest.main()
