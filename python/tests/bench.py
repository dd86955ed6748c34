"""`retrograde serve` at the virtual bench, for tests: both firmware images in an emulator, in real time."""

import json
import os
import pathlib
import re
import subprocess
import tempfile
import time
import unittest
from typing import IO, Any, Callable, List, Optional, Tuple

import retrograde

try:
    import jsonschema  # comes with bluesky
except ImportError:
    jsonschema = None

DOCUMENT = json.loads((pathlib.Path(__file__).parents[2] / "docs" / "openapi.json").read_text(encoding="utf-8"))

# Longest wait for the machines, s: more than a busy computer needs.
SOON_S = 120.0


def until(is_so: Callable[[], bool]) -> None:
    """Waits for something of the machines: how soon it comes is a matter of the computer."""
    end = time.monotonic() + SOON_S
    while not is_so():
        if time.monotonic() > end:
            raise AssertionError("it does not come so far")
        time.sleep(0.02)


def conforms(schema: Any, value: object) -> None:
    """Raises unless a value is as a schema of docs/openapi.json says."""
    if jsonschema is not None:
        jsonschema.Draft202012Validator({**schema, "components": DOCUMENT["components"]}).validate(value)


def checked(once: Callable[..., Tuple[int, bytes]]) -> Callable[..., Tuple[int, bytes]]:
    """Asks the server, and holds status and body of its answer against docs/openapi.json."""

    def asked(method: str, path: str, *more: object) -> Tuple[int, bytes]:
        status, content = once(method, path, *more)
        name = path.split("?")[0]
        [methods] = [of for known, of in DOCUMENT["paths"].items() if re.fullmatch(re.sub(r"{\w+}", "[^/]+", known), name)]
        response = methods[method.lower()]["responses"][str(status)]
        response = DOCUMENT["components"]["responses"].get(response.get("$ref", "").rpartition("/")[2], response)
        schema = response.get("content", {}).get("application/json", {}).get("schema")
        if schema and content.startswith(b"{"):
            conforms(schema, json.loads(content))
        return status, content

    return asked


def programs() -> pathlib.Path:
    """Folder of `retrograde` and `virtual-bench`."""
    given = os.environ.get("RETROGRADE_PROGRAMS")
    return pathlib.Path(given) if given else pathlib.Path(__file__).parents[2] / "target" / "debug"


def missing() -> Optional[str]:
    """Why there is no bench here."""
    folder = programs()
    for name in ("retrograde", "virtual-bench"):
        if not (folder / name).exists():
            return f"no {name} in {folder}: `cargo build --workspace --ignore-rust-version`, or RETROGRADE_PROGRAMS=FOLDER"
    helps = subprocess.run([folder / "retrograde", "serve", "--help"], capture_output=True, check=False)
    return None if helps.returncode == 0 else f"{folder / 'retrograde'} has no `serve`: build it again"


class Bench:
    """Both machines and the server. Ends everything that it has started."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self._started: List["subprocess.Popen[str]"] = []
        self._said: List[IO[str]] = []
        folder = self._folder.name
        # Its output goes to a file: a pipe that nobody reads would fill up.
        bench = self._start("bench", [programs() / "virtual-bench", "serve", "--rig", "0", "--capsule", "0"])
        places = [self._find(bench, rf"--{machine} (tcp:\S+)") for machine in ("rig", "capsule")]
        command = [programs() / "retrograde", "serve", "--rig", places[0], "--capsule", places[1]]
        command += ["--listen", "127.0.0.1:0", "--out", f"{folder}/data"]
        server = self._start("serve", command)
        address = self._find(server, r"(http://\S+#token=\S+)")
        self.lab = retrograde.connect(address)
        setattr(self.lab, "_once", checked(self.lab._once))
        until = time.monotonic() + SOON_S
        while True:
            machines = self.lab.state()["machines"]
            if all(machine.get("contact") == "owned" for machine in (machines["rig"], machines["capsule"])):
                break
            if time.monotonic() > until:
                raise AssertionError(f"no contact: {json.dumps(machines)}")
            time.sleep(0.2)

    def _start(self, name: str, command: List[object]) -> IO[str]:
        said = open(os.path.join(self._folder.name, name), "w+", encoding="utf-8")
        environment = dict(os.environ, RETROGRADE_RUNTIME_DIR=self._folder.name)
        process = subprocess.Popen(
            [str(word) for word in command], stdin=subprocess.DEVNULL, stdout=said, stderr=subprocess.STDOUT, env=environment, text=True
        )
        self._started.append(process)
        self._said.append(said)
        return said

    def _find(self, said: IO[str], pattern: str) -> str:
        until = time.monotonic() + SOON_S
        while time.monotonic() < until:
            said.seek(0)
            text = said.read()
            found = re.search(pattern, text)
            if found:
                return found.group(1)
            if self._started[-1].poll() is not None:
                break
            time.sleep(0.1)
        raise AssertionError(f"{self._started[-1].args!r} says: {text}")

    def close(self) -> None:
        """Ends the server, then the bench."""
        for process in reversed(self._started):
            process.kill()
            process.wait()
        for said in self._said:
            said.close()
        self._folder.cleanup()


class BenchTest(unittest.TestCase):
    """Tests that share a bench."""

    bench: Bench

    @classmethod
    def setUpClass(cls) -> None:
        why = missing()
        if why and "RETROGRADE_PROGRAMS" in os.environ:
            raise AssertionError(why)
        if why:
            raise unittest.SkipTest(why)
        cls.bench = Bench()
        cls.addClassCleanup(cls.bench.close)
        cls.lab = cls.bench.lab

    lab: retrograde.Lab
