"""The client against a server that answers as docs/serve.md says, and as it must not."""

import contextlib
import io
import json
import os
import pathlib
import signal
import socket
import stat
import sys
import tempfile
import threading
import time
import unittest
from decimal import Decimal
from fractions import Fraction
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Callable, Dict, List, Optional, Tuple
from unittest import mock

import retrograde
from bench import until
from retrograde import bluesky, client

Answer = Tuple[int, Dict[str, Any]]
INSTANCE = "abc123"


class Call:
    """A request that the server has got."""

    def __init__(self, method: str, path: str, body: Any, headers: Dict[str, str]) -> None:
        self.method, self.path, self.body, self.headers = method, path, body, headers


class Server(ThreadingHTTPServer):
    """Answers with what a test has put in: `answer(call)`; None closes the connection instead."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.calls: List[Call] = []
        self.answer: Callable[[Call], Optional[Answer]] = lambda call: (404, failure(2, "nothing"))
        self.stream = b""

    def handle_error(self, request: Any, client_address: Any) -> None:
        pass


class Handler(BaseHTTPRequestHandler):
    """One request."""

    def log_message(self, format: str, *args: Any) -> None:
        pass

    def do_GET(self) -> None:
        self.handle_it("GET")

    def do_POST(self) -> None:
        self.handle_it("POST")

    def handle_it(self, method: str) -> None:
        server = self.server
        assert isinstance(server, Server)
        content = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        call = Call(method, self.path, json.loads(content) if content else None, dict(self.headers.items()))
        server.calls.append(call)
        if self.path == "/api/v1/stream":
            self.send_response(200)
            self.end_headers()
            self.wfile.write(server.stream)
            return
        answer = server.answer(call)
        if answer is None:
            self.close_connection = True
            self.connection.close()
            return
        status, value = answer
        coded = json.dumps(value).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(coded)))
        self.end_headers()
        self.wfile.write(coded)


def failure(exit_code: int, message: str, help: str = "do this") -> Dict[str, Any]:
    return {"ok": False, "exit_code": exit_code, "error": {"code": "retrograde::x", "message": message, "help": help}}


def action(state: str, **more: Any) -> Dict[str, Any]:
    return {"ok": True, "action": {"id": "abc123-1", "machine": "rig", "kind": "home", "state": state, **more}}


# The server's clock is not this computer's.
TIME_UTC, TIME_MS = "2026-01-02T03:04:05.678901234Z", "1767323045679"
STATE: Answer = (200, {"ok": True, "instance": INSTANCE, "time_utc": TIME_UTC, "machines": {"rig": {"state": "ready"}}})


class ServerTest(unittest.TestCase):
    """A client and its server."""

    def setUp(self) -> None:
        self.server = Server()
        thread = threading.Thread(target=self.server.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        self.addCleanup(self.server.server_close)
        self.addCleanup(self.server.shutdown)
        self.url = f"http://127.0.0.1:{self.server.server_port}/"
        self.lab = retrograde.Lab(f"{self.url}#token=secret-token")

    def answers(self, table: Dict[str, Any]) -> None:
        """Sets the answer to each path: one answer, or a list of them, one for each call."""

        def answer(call: Call) -> Optional[Answer]:
            found = table.get(call.path.split("?")[0], STATE if call.path == "/api/v1/state" else None)
            return found.pop(0) if isinstance(found, list) else found

        self.server.answer = answer

    def posts(self) -> List[Call]:
        return [call for call in self.server.calls if call.method == "POST"]

    def renewals(self) -> List[Call]:
        return [post for post in self.posts() if post.path.endswith("renew")]


class ClientTest(ServerTest):
    def test_a_command_is_sent_with_key_and_token_and_waited_for(self) -> None:
        done = action("complete", result={"repeat_steps": 1, "shift_steps": 0, "duration_us": 5})
        self.answers(
            {"/api/v1/rig/home": (202, action("under_way")), "/api/v1/actions/abc123-1": [(200, action("under_way")), (200, done)]}
        )
        seen: List[str] = []
        homed = self.lab.rig.home(lambda data: seen.append(data["state"]))
        self.assertEqual(homed["repeat_steps"], 1)
        self.assertEqual(seen, ["under_way", "complete"])
        (post,) = self.posts()
        self.assertEqual(post.headers["Authorization"], "Bearer secret-token")
        self.assertRegex(post.headers["Idempotency-Key"], rf"^{INSTANCE}-[0-9a-f]{{32}}$")

    def test_a_lost_answer_is_asked_for_again_with_the_same_key(self) -> None:
        done = action("complete", result={})
        self.answers({"/api/v1/rig/run": [None, None, (200, done)]})
        self.lab.rig.run(cycles=1)
        keys = {post.headers["Idempotency-Key"] for post in self.posts()}
        self.assertEqual((len(self.posts()), len(keys)), (3, 1))

    def test_an_order_says_when_it_was_given_each_time_it_is_sent(self) -> None:
        later: Answer = (200, {**STATE[1], "time_utc": "2026-01-02T03:05:00Z"})
        stopped: Answer = (200, {"ok": True, "machines": []})
        self.answers({"/api/v1/state": [STATE, later], "/api/v1/rig/home": [None, (200, action("complete"))], "/api/v1/stop": stopped})
        self.lab.rig.home()
        # A stop is never late.
        self.lab.stop()
        self.assertEqual([post.headers.get("Retrograde-Sent") for post in self.posts()], [TIME_MS, TIME_MS, None])

    @unittest.skipUnless(sys.platform == "linux", "no clock here is known to go on while the computer sleeps")
    def test_an_order_is_not_sent_again_after_the_computer_has_slept(self) -> None:
        clock = mock.Mock(return_value=0.0)

        def answer(call: Call) -> Optional[Answer]:
            if call.method == "GET":
                return STATE
            clock.return_value += 3600
            return None

        self.server.answer = answer
        with mock.patch("time.clock_gettime", clock), mock.patch.object(client, "PATIENCE_S", 1), self.assertRaises(retrograde.OutcomeUnknown):
            self.lab.rig.home()
        self.assertEqual(len(self.posts()), 1)

    def test_two_commands_have_two_keys(self) -> None:
        self.answers({"/api/v1/rig/home": [(200, action("complete"))] * 2})
        self.lab.rig.home()
        self.lab.rig.home()
        self.assertEqual(len({post.headers["Idempotency-Key"] for post in self.posts()}), 2)

    def test_a_server_that_was_started_again_leaves_the_outcome_unknown(self) -> None:
        self.answers({"/api/v1/rig/run": [None, (428, failure(2, "the key is not of this server"))]})
        with self.assertRaises(retrograde.OutcomeUnknown):
            self.lab.rig.run()
        # Where nothing was sent before, nothing was done.
        self.answers({"/api/v1/rig/run": [(428, failure(2, "the key is not of this server"))]})
        with self.assertRaises(retrograde.WrongRequest):
            self.lab.rig.run()

    def test_no_answer_at_all_is_an_unknown_outcome(self) -> None:
        self.answers({"/api/v1/rig/run": None})
        with mock.patch.object(client, "PATIENCE_S", 0.5), self.assertRaises(retrograde.OutcomeUnknown):
            self.lab.rig.run()
        self.assertEqual(len({post.headers["Idempotency-Key"] for post in self.posts()}), 1)

    def test_where_nobody_listens_nothing_was_sent(self) -> None:
        self.server.shutdown()
        self.server.server_close()
        with self.assertRaises(retrograde.NoServer) as raised:
            self.lab.rig.home()
        self.assertIn("retrograde serve", str(raised.exception))

    def test_each_failure_has_its_class_and_the_text_of_the_server(self) -> None:
        for status, code, kind in [
            (400, 2, retrograde.WrongRequest),
            (401, 2, retrograde.Denied),
            (403, 2, retrograde.Denied),
            (409, 3, retrograde.Refused),
            (409, 6, retrograde.Faulted),
            (409, 130, retrograde.Stopped),
            (502, 5, retrograde.Mismatch),
            (503, 4, retrograde.NoMachine),
            (504, 7, retrograde.OutcomeUnknown),
            (500, 1, retrograde.RetrogradeError),
        ]:
            self.answers({"/api/v1/rig/home": (status, failure(code, "why it failed"))})
            with self.subTest(status=status, code=code), self.assertRaises(retrograde.RetrogradeError) as raised:
                self.lab.rig.home()
            self.assertIs(type(raised.exception), kind)
            self.assertEqual(str(raised.exception), "why it failed (do this)")

    def test_each_end_of_an_action_has_its_class(self) -> None:
        for state, kind in [
            ("stopped", retrograde.Stopped),
            ("link_lost", retrograde.LinkLost),
            ("faulted", retrograde.Faulted),
            ("refused", retrograde.Refused),
            ("unknown", retrograde.OutcomeUnknown),
            ("failed", retrograde.RetrogradeError),
        ]:
            error = {"code": "x", "message": "it ended", "help": "home"}
            ended = action(state, error=error)
            self.answers({"/api/v1/rig/home": (202, action("under_way")), "/api/v1/actions/abc123-1": (200, ended)})
            with self.subTest(state=state), self.assertRaises(retrograde.RetrogradeError) as raised:
                self.lab.rig.home()
            self.assertIs(type(raised.exception), kind)
            self.assertIn("it ended", str(raised.exception))

    def test_ctrl_c_while_waiting_stops_the_machine(self) -> None:
        self.answers(
            {
                "/api/v1/rig/home": (202, action("under_way")),
                "/api/v1/actions/abc123-1": (200, action("under_way")),
                "/api/v1/stop": (200, {"ok": True, "machines": []}),
            }
        )

        def press(_: Any) -> None:
            raise KeyboardInterrupt

        with self.assertRaises(KeyboardInterrupt):
            self.lab.rig.home(press)
        self.assertEqual((self.posts()[-1].path, self.posts()[-1].body), ("/api/v1/stop", {"machine": "rig"}))

    def test_ctrl_c_before_the_answer_stops_the_machine(self) -> None:
        # A shell starts what runs in its background with this signal ignored.
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        self.addCleanup(signal.signal, signal.SIGINT, before)
        home, stopped = threading.Event(), threading.Event()

        def answer(call: Call) -> Answer:
            if call.path == "/api/v1/rig/home":
                home.set()
                stopped.wait()
                return (202, action("under_way"))
            if call.path == "/api/v1/stop":
                stopped.set()
            return STATE if call.method == "GET" else (200, {"ok": True, "machines": []})

        def press() -> None:
            home.wait()
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

        self.server.answer = answer
        threading.Thread(target=press).start()
        with self.assertRaises(KeyboardInterrupt):
            self.lab.rig.home()
        last = self.server.calls[-1]
        self.assertEqual((last.path, last.body), ("/api/v1/stop", {"machine": "rig"}))

    def test_a_command_is_not_sent_again_after_a_stop(self) -> None:
        def answer(call: Call) -> Optional[Answer]:
            if call.path != "/api/v1/rig/home":
                return STATE if call.method == "GET" else (200, {"ok": True, "machines": []})
            # The connection ends without an answer. Meanwhile another thread stops the machine.
            stop = threading.Thread(target=self.lab.stop)
            stop.start()
            stop.join()
            return None

        self.server.answer = answer
        with self.assertRaises(retrograde.OutcomeUnknown):
            self.lab.rig.home()
        self.assertEqual([call.path for call in self.posts()], ["/api/v1/rig/home", "/api/v1/stop"])

    def stop_meanwhile(self, at: str, then: Optional[Answer], machine: Optional[str] = None) -> None:
        """Another thread stops while the server has the first request for this path, which gets this answer only then."""

        def answer(call: Call) -> Optional[Answer]:
            if call.path == at and not any(post.path == "/api/v1/stop" for post in self.posts()):
                stop = threading.Thread(target=self.lab.stop, args=(machine,))
                stop.start()
                stop.join()
                return then
            if call.path == "/api/v1/stop":
                return (200, {"ok": True, "machines": []})
            if "/actions/" in call.path:
                return (200, action("stopped"))
            return STATE if call.method == "GET" else (200, action("complete"))

        self.server.answer = answer
        self.server.calls.clear()

    def test_an_order_is_not_sent_after_a_stop_that_came_since_it_was_given(self) -> None:
        rig, capsule = self.lab.rig, self.lab.capsule
        orders: List[Callable[[], Any]] = [rig.home, rig.start_run, rig.resume, rig.acknowledge, capsule.fold]
        for order in orders:
            self.stop_meanwhile("/api/v1/state", STATE)
            with self.subTest(order=order), self.assertRaisesRegex(retrograde.Stopped, "was not sent"):
                order()
            self.assertEqual([post.path for post in self.posts()], ["/api/v1/stop"])

    def test_a_stop_of_the_other_machine_holds_no_order_back(self) -> None:
        for at, then in [("/api/v1/state", STATE), ("/api/v1/rig/home", None)]:
            self.stop_meanwhile(at, then, "capsule")
            with self.subTest(at=at):
                self.lab.rig.home()
                self.assertEqual(self.posts()[-1].path, "/api/v1/rig/home")

    def test_an_order_that_begins_although_a_stop_has_met_it_is_stopped_again(self) -> None:
        # The stop may have overtaken it on the way to the server.
        self.stop_meanwhile("/api/v1/rig/home", (202, action("under_way")))
        with self.assertRaises(retrograde.Stopped):
            self.lab.rig.home()
        posts = [(post.path, post.body) for post in self.posts()]
        self.assertEqual(posts, [("/api/v1/rig/home", {}), ("/api/v1/stop", {}), ("/api/v1/stop", {"machine": "rig"})])

    def test_a_busy_server_leaves_a_command_that_was_sent_unsure(self) -> None:
        answers: List[Optional[Answer]] = [None, (503, failure(4, "too many connections")), (202, action("complete"))]
        self.server.answer = lambda call: STATE if call.method == "GET" else answers.pop(0)
        self.lab.rig.home()
        self.assertEqual(answers, [])

    def test_a_stop_without_confirmation_is_told(self) -> None:
        machines = [{"machine": "rig", "outcome": "not_confirmed", "why": "no answer"}]
        answer = {"ok": False, "machines": machines, **failure(8, "x")}
        self.answers({"/api/v1/stop": (504, answer), "/api/v1/estop": None})
        for stop in (self.lab.stop, self.lab.estop):
            self.server.calls.clear()
            with self.subTest(stop=stop), self.assertRaises(retrograde.NotStopped) as raised:
                stop()
            self.assertIn("NOT STOPPED", str(raised.exception))
            self.assertEqual(len(self.posts()), 3)

    def test_a_stop_is_tried_again(self) -> None:
        self.answers({"/api/v1/stop": [None, (200, {"ok": True, "machines": []})]})
        self.lab.stop()

    def test_a_server_that_hangs_is_no_reason_to_say_nothing(self) -> None:
        told, warned = io.StringIO(), threading.Event()
        hung = socket.create_server(("127.0.0.1", 0))
        self.addCleanup(hung.close)

        def hang_until_told() -> None:
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = hung.accept()
                    with connection:
                        warned.wait()

        def warn() -> None:
            client_warn()
            warned.set()

        client_warn = client._warn
        threading.Thread(target=hang_until_told, daemon=True).start()
        lab = retrograde.Lab(f"http://127.0.0.1:{hung.getsockname()[1]}/")
        # The stop is not given up before somebody is told: without the words this would take its whole 20 s.
        with mock.patch.multiple(client, WARN_S=0.1, _warn=warn), contextlib.redirect_stderr(told):
            with self.assertRaises(retrograde.NotStopped):
                lab.estop()
        self.assertTrue(warned.is_set())
        self.assertIn("cut the motor supply NOW", told.getvalue())
        self.assertEqual(told.getvalue().count("NOW"), 1)

    def test_a_stop_is_given_up_in_time_for_the_button(self) -> None:
        clock = mock.Mock(monotonic=mock.Mock(return_value=0.0))
        tries: List[float] = []

        def post(_: str, __: object, ___: object, timeout_s: float) -> None:
            tries.append(timeout_s)
            clock.monotonic.return_value += timeout_s
            raise OSError("no answer")

        with mock.patch.object(client, "time", clock), mock.patch.object(self.lab, "_post", post):
            with self.assertRaises(retrograde.NotStopped):
                self.lab.stop()
        self.assertEqual((tries, client.WARN_S), ([client.STOP_S, client.STOPS_S - client.STOP_S], 2))
        self.assertEqual(sum(tries), 20)

    def test_a_stop_that_is_confirmed_says_nothing(self) -> None:
        self.answers({"/api/v1/stop": (200, {"ok": True, "machines": []})})
        with mock.patch("threading.Timer") as timer:
            self.lab.stop()
        timer.assert_called_once_with(client.WARN_S, client._warn)
        names = [call[0] for call in timer.return_value.method_calls]
        self.assertEqual(names, ["start", "cancel"])

    def test_numbers_go_as_they_are_and_unknown_fields_nowhere(self) -> None:
        self.answers({"/api/v1/rig/run": (200, action("complete"))})
        self.lab.rig.run(cycles=3, stroke_mm=Decimal("0.1"), duration_s="40.5", note="dry", home_dwell_s=None)
        self.assertEqual(self.posts()[-1].body, {"cycles": 3, "stroke_mm": "0.1", "duration_s": "40.5", "note": "dry"})
        sent = len(self.posts())
        wrong: List[Dict[str, Any]] = [{"cycle": 3}, {"cycles": True}, {"cycles": [3]}]
        for run in wrong:
            with self.subTest(run=run), self.assertRaises(retrograde.WrongRequest):
                self.lab.rig.run(**run)
        self.assertEqual(len(self.posts()), sent)

    def test_each_float_of_a_linspace_is_a_position_and_a_boolean_is_none(self) -> None:
        for points in range(2, 60):
            for end in (2.0, 0.3, 130.0):
                for step in range(points):
                    number = client._number("position_mm", 0.1 + step * (end - 0.1) / (points - 1))
                    self.assertLessEqual(len(repr(number).partition(".")[2]), 3, number)
        cases: Tuple[Tuple[Any, Any], ...] = ((1.7000000000000002, 1.7), (-1e-9, 0.0), (Fraction(1, 3), 0.333), (Decimal("1.7000"), "1.7000"), ("1e3", "1e3"), (7, 7))
        for given, sent in cases:
            self.assertEqual(repr(client._number("position_mm", given)), repr(sent))
        self.assertEqual(client._number("far_dwell_s", 4e-6), "0.000004")
        # Whole numbers are not rounded: the server says what is wrong.
        self.assertEqual((client._number("cycles", 5.0), client._number("cycles", 5.5)), (5, 5.5))
        wrong: Tuple[Any, ...] = (True, float("nan"), float("inf"), 1j, None, [1.0])
        for value in wrong:
            with self.subTest(value=value), self.assertRaises(retrograde.WrongRequest):
                client._number("position_mm", value)

    def test_what_a_notebook_shows_says_what_it_is_and_keeps_the_token(self) -> None:
        self.assertEqual(repr(self.lab), f"Lab({self.url!r})")
        self.assertEqual(repr(self.lab.rig), f"<Rig of Lab({self.url!r})>")
        error = {"code": "x", "message": "a <fault>", "help": "home"}
        data = action("faulted", result={"strokes": 3}, files={"csv": "run.csv"}, error=error)["action"]
        shown: retrograde.Action[Any] = retrograde.Action(self.lab, data)
        self.assertEqual(repr(shown), "<Action abc123-1: rig home, faulted, a <fault>>")
        page = shown._repr_html_()
        for row in ("<th>state</th><td>faulted</td>", "a &lt;fault&gt;", "<th>strokes</th><td>3</td>", "<th>csv</th><td>run.csv</td>"):
            self.assertIn(row, page)
        self.assertEqual(self.server.calls, [])

    def test_a_machine_that_the_server_does_not_have(self) -> None:
        self.answers({})
        with self.assertRaises(retrograde.NoMachine):
            self.lab.capsule.state()
        with self.assertRaises(retrograde.WrongRequest):
            self.lab.capsule.start("stretch")

    def test_a_jog_is_renewed_while_it_lasts_and_then_stopped(self) -> None:
        accepted = {"renew_within_ms": 400}
        self.answers(
            {
                "/api/v1/rig/jog": (202, action("under_way", accepted=accepted)),
                "/api/v1/rig/jog/renew": (200, {"ok": True}),
                "/api/v1/stop": (200, {"ok": True, "machines": []}),
                "/api/v1/actions/abc123-1": (200, action("stopped")),
            }
        )
        with self.lab.rig.jog("away", speed_mm_s=5) as jog:
            until(lambda: len(self.renewals()) >= 2)
        self.assertIsNone(jog.why)
        numbers = [post.body["n"] for post in self.renewals()]
        self.assertEqual(numbers, list(range(1, len(numbers) + 1)))
        self.assertEqual(self.posts()[-1].path, "/api/v1/stop")
        sent = len(self.posts())
        time.sleep(0.3)
        self.assertEqual(len(self.posts()), sent)

    def test_a_renewal_that_is_refused_ends_the_renewing(self) -> None:
        self.answers(
            {
                "/api/v1/rig/jog": (202, action("under_way", accepted={"renew_within_ms": 400})),
                "/api/v1/rig/jog/renew": (409, failure(3, "it has ended")),
                "/api/v1/stop": (200, {"ok": True, "machines": []}),
                "/api/v1/actions/abc123-1": (200, action("complete")),
            }
        )
        with self.lab.rig.jog("home") as jog:
            until(lambda: jog.why is not None)
        self.assertIn("it has ended", str(jog.why))
        self.assertEqual(len(self.renewals()), 1)

    def test_the_stream_gives_events_and_passes_over_signs_of_life(self) -> None:
        self.server.stream = b': alive\n\nevent: state\ndata: {"a": 1}\n\n:\nevent: rig\ndata: {"first": 2}\n\nevent: cut'
        with self.lab.stream() as stream:
            self.assertEqual([(it.event, it.data) for it in stream], [("state", {"a": 1}), ("rig", {"first": 2})])

    def test_a_sample_is_one_that_was_taken_after_the_call(self) -> None:
        portions = [f'event: rig\ndata: {{"samples": [{{"position_um": {um}}}]}}\n\n' for um in (1, 2, 3)]
        self.server.stream = ("event: state\ndata: {}\n\n" + "".join(portions)).encode()
        self.assertEqual(self.lab.rig.sample()["position_um"], 2)
        self.server.stream = b"event: state\ndata: {}\n\n"
        self.answers({})
        with self.assertRaises(retrograde.NoMachine):
            self.lab.rig.sample()

    def test_an_answer_that_is_no_json(self) -> None:
        class Other(Handler):
            def handle_it(self, method: str) -> None:
                self.send_response(200)
                self.end_headers()
                self.wfile.write(b"<html>")

        self.server.RequestHandlerClass = Other
        with self.assertRaises(retrograde.RetrogradeError) as raised:
            self.lab.state()
        self.assertIn("retrograde serve", str(raised.exception))

    def test_the_server_of_this_user_is_found(self) -> None:
        self.answers({})
        with tempfile.TemporaryDirectory() as folder, mock.patch.dict(os.environ, {"RETROGRADE_RUNTIME_DIR": folder}):
            with self.assertRaises(retrograde.NoServer):
                retrograde.connect()
            file = pathlib.Path(folder, "serve.json")
            for content in ["", "[]", "{}", "no"]:
                file.write_text(content)
                with self.subTest(content=content), self.assertRaises(retrograde.NoServer):
                    retrograde.connect()
            file.write_text(json.dumps({"url": self.url, "token": "t" * 32, "instance": INSTANCE, "pid": 1}))
            lab = retrograde.connect()
        self.assertEqual(lab.url, self.url)
        self.assertEqual(self.server.calls[-1].headers["Authorization"], "Bearer " + "t" * 32)

    @unittest.skipIf(sys.platform == "win32", "other users have no access to this folder there")
    def test_a_server_is_found_only_in_what_is_this_users_alone(self) -> None:
        self.answers({})
        with tempfile.TemporaryDirectory() as parent:
            folder = pathlib.Path(parent, "retrograde")
            file = folder / "serve.json"
            folder.mkdir(mode=0o700)
            file.write_text(json.dumps({"url": self.url, "token": "t" * 32}))
            linked, with_link = pathlib.Path(parent, "linked"), pathlib.Path(parent, "with-link")
            linked.symlink_to(folder)
            with_link.mkdir(mode=0o700)
            (with_link / "serve.json").symlink_to(file)

            def refused(where: pathlib.Path) -> str:
                with mock.patch.dict(os.environ, {"RETROGRADE_RUNTIME_DIR": str(where)}):
                    with self.assertRaises(retrograde.NoServer) as raised:
                        retrograde.connect()
                return str(raised.exception)

            for where, what in [(linked, linked), (file, file), (with_link, with_link / "serve.json")]:
                with self.subTest(where=where):
                    self.assertRegex(refused(where), f"{what} is a link, or no (folder|file) .*remove it")
            with self.subTest("of another user"), mock.patch("os.geteuid", return_value=os.geteuid() + 1):
                self.assertRegex(refused(folder), f"{folder} belongs to another user .*RETROGRADE_RUNTIME_DIR")
            for mode in (0o710, 0o701, 0o770, 0o755):
                folder.chmod(mode)
                with self.subTest(mode=oct(mode)):
                    self.assertRegex(refused(folder), f"other users have access to {folder} .*chmod 700 {folder}")
            # The token was sent nowhere.
            self.assertEqual(self.server.calls, [])
            folder.chmod(0o700)
            with mock.patch.dict(os.environ, {"RETROGRADE_RUNTIME_DIR": str(folder)}):
                self.assertEqual(retrograde.connect().url, self.url)

    @unittest.skipIf(sys.platform == "win32", "other users have no access to this folder there")
    def test_what_is_read_is_what_was_looked_at(self) -> None:
        self.answers({})
        with tempfile.TemporaryDirectory() as folder, mock.patch.dict(os.environ, {"RETROGRADE_RUNTIME_DIR": folder}):
            file = pathlib.Path(folder, "serve.json")
            file.write_text(json.dumps({"url": self.url, "token": "mine"}))
            other = pathlib.Path(folder, "other")
            other.write_text(json.dumps({"url": "http://127.0.0.1:1/", "token": "theirs"}))

            def replaced(look: Callable[..., Any]) -> Callable[..., Any]:
                def looked(*arguments: Any, **options: Any) -> Any:
                    found = look(*arguments, **options)
                    if not os.path.islink(file) and stat.S_ISREG(found.st_mode):
                        file.unlink()
                        file.symlink_to(other)
                    return found

                return looked

            with mock.patch("os.stat", replaced(os.stat)), mock.patch("os.fstat", replaced(os.fstat)):
                self.assertEqual(retrograde.connect().url, self.url)
            self.assertTrue(file.is_symlink())

    def test_wrong_addresses_are_refused(self) -> None:
        for url in ["https://127.0.0.1:1/", "ftp://x", "http://", ""]:
            with self.subTest(url=url), self.assertRaises(retrograde.WrongRequest):
                retrograde.Lab(url)

    def test_the_rows_of_a_record(self) -> None:
        class Record(Handler):
            def handle_it(self, method: str) -> None:
                self.send_response(200)
                self.end_headers()
                self.wfile.write(b"time_us,position_mm,far_limit_open,state,note\n5,1.250,false,running,\n")

        self.server.RequestHandlerClass = Record
        row = {"time_us": 5, "position_mm": 1.25, "far_limit_open": False, "state": "running", "note": None}
        self.assertEqual(self.lab.rows("run-1.csv"), [row])

    def test_a_name_of_digits_is_no_number(self) -> None:
        class Record(Handler):
            def handle_it(self, method: str) -> None:
                self.send_response(200)
                self.end_headers()
                self.wfile.write(b"trial,indentation,text,a,b,c,d,e\n7,5,12,01,1_0,nan,-0.50,1e-05\n")

        self.server.RequestHandlerClass = Record
        row = {"trial": 7, "indentation": "5", "text": "12", "a": "01", "b": "1_0", "c": "nan", "d": -0.5, "e": 1e-05}
        self.assertEqual(self.lab.rows("run-1.csv"), [row])


class StoppingTest(ServerTest):
    """bluesky's devices need no bluesky to be staged, set and stopped."""

    def stop_meanwhile(self, at: str, begin: Callable[[], Any], stop: Callable[[], Any]) -> List[str]:
        """Begins something in a thread, as the RunEngine does, and stops it while the server has a request for `at`, or after that.

        Gives the names of the exceptions that the beginning ends in.
        """
        stopped = threading.Event()
        ended: List[str] = []

        def answer(call: Call) -> Answer:
            if call.path == "/api/v1/stop":
                stopped.set()
                return (200, {"ok": True, "machines": []})
            if call.path.endswith(at):
                stopped.wait()
            if call.path == "/api/v1/state":
                known: Dict[str, Any] = {"rig": {"homed": False}, "capsule": {"referenced": False}}
                return (200, {**STATE[1], "machines": known})
            if call.method == "POST" and stopped.is_set():
                return (409, failure(130, "it was stopped"))
            state = action("stopped" if stopped.is_set() else "under_way")
            state["action"]["machine"] = "capsule" if "capsule" in call.path else "rig"
            return (202 if call.method == "POST" else 200, state)

        def begun() -> None:
            try:
                status = begin()
                if isinstance(status, bluesky.Status):
                    status.wait(30)
            except retrograde.RetrogradeError as why:
                ended.append(type(why).__name__)

        self.server.answer = answer
        self.server.calls.clear()
        thread = threading.Thread(target=begun)
        thread.start()
        until(lambda: any(at in call.path for call in list(self.server.calls)))
        stop()
        # Without a stop it would go on for ever.
        sent = stopped.is_set()
        stopped.set()
        thread.join(30)
        self.assertTrue(sent, "no stop was sent")
        return ended

    def test_what_stage_moves_is_stopped(self) -> None:
        for device in (bluesky.Rig(self.lab), bluesky.Capsule(self.lab)):
            ends: List[Callable[[], Any]] = [device.stop, lambda: device.stop(success=True), device.unstage]
            for end in ends:
                self.assertEqual(self.stop_meanwhile("/actions/", device.stage, end), ["Stopped"])
                stops = [post.body for post in self.posts() if post.path == "/api/v1/stop"]
                self.assertEqual(stops, [{"machine": device.name}])

    def test_an_order_on_its_way_is_stopped(self) -> None:
        rig, capsule = bluesky.Rig(self.lab), bluesky.Capsule(self.lab)
        orders: List[Tuple[str, Any, Callable[[], Any]]] = [
            ("/rig/home", rig, rig.stage),
            ("/rig/move", rig, lambda: rig.set(5)),
            ("/capsule/reference", capsule, capsule.stage),
            ("/capsule/fold", capsule, lambda: capsule.set("folded")),
        ]
        for order, device, begin in orders:
            ends: List[Callable[[], Any]] = [device.stop, lambda: device.stop(success=True), device.unstage]
            for end in ends:
                with self.subTest(order=order, end=ends.index(end)):
                    self.assertEqual(self.stop_meanwhile(order, begin, end), ["Stopped"])
                    posts = [(post.path, post.body) for post in self.posts()]
                    self.assertEqual(posts, [(f"/api/v1{order}", mock.ANY), ("/api/v1/stop", {"machine": device.name})])

    def test_a_stop_while_stage_looks_at_the_machine_keeps_it_from_moving(self) -> None:
        for device in (bluesky.Rig(self.lab), bluesky.Capsule(self.lab)):
            ends: List[Callable[[], Any]] = [device.stop, device.unstage]
            for end in ends:
                with self.subTest(device=device, end=ends.index(end)):
                    self.assertEqual(self.stop_meanwhile("/state", device.stage, end), ["Stopped"])
                    self.assertEqual([post.path for post in self.posts()], ["/api/v1/stop"])

    def test_stage_that_moves_nothing_forgets_no_motion(self) -> None:
        folds = action("under_way")
        folds["action"]["machine"] = "capsule"
        known: Answer = (200, {**STATE[1], "machines": {"capsule": {"referenced": True}}})
        self.answers(
            {
                "/api/v1/state": known,
                "/api/v1/capsule/fold": (202, folds),
                "/api/v1/actions/abc123-1": (200, folds),
                "/api/v1/stop": (200, {"ok": True, "machines": []}),
            }
        )
        capsule = bluesky.Capsule(self.lab)
        capsule.set("folded")
        capsule.stage()
        capsule.stop(success=True)
        self.assertEqual([post.path for post in self.posts()], ["/api/v1/capsule/fold", "/api/v1/stop"])
        folds["action"]["state"] = "stopped"

    def test_a_run_whose_order_was_not_sent_before_the_stop_does_not_begin(self) -> None:
        class Later:
            """A status whose thread comes to run only when somebody waits for it."""

            done = False

            def __init__(self, work: Callable[[], Any]) -> None:
                self.work = work

            def exception(self, timeout: float) -> Optional[BaseException]:
                self.done = True
                try:
                    self.work()
                except retrograde.Stopped as why:
                    return why
                return None

        self.answers({"/api/v1/stop": (200, {"ok": True, "machines": []}), "/api/v1/rig/run": (202, action("under_way"))})
        rig = bluesky.Rig(self.lab)
        with mock.patch.object(bluesky, "Status", Later):
            rig.kickoff()
            rig.stop()
        self.assertEqual([post.path for post in self.posts()], ["/api/v1/stop"])

    def test_a_device_that_moves_nothing_is_stopped_unless_a_plan_has_only_ended(self) -> None:
        self.answers({"/api/v1/stop": (200, {"ok": True, "machines": []})})
        for device in (bluesky.Rig(self.lab), bluesky.Capsule(self.lab)):
            self.server.calls.clear()
            # The page may have moved it.
            device.stop()
            self.assertEqual([(post.path, post.body) for post in self.posts()], [("/api/v1/stop", {"machine": device.name})])
            self.server.calls.clear()
            device.stop(success=True)
            device.unstage()
            self.assertEqual(self.server.calls, [])


if __name__ == "__main__":
    unittest.main()
