"""The package with the machines: through `retrograde serve`, at the firmware images on the virtual bench."""

import threading
import time
import unittest
from typing import Any, Dict
from unittest import mock

import retrograde

from bench import BenchTest, conforms, until

# One cycle of 20 mm, 800 steps per mm.
SHORT: Dict[str, Any] = {"cycles": 1, "stroke_mm": 20, "duration_s": 2, "accel_mm_s2": 400}
STEPS = 32_000


class MachinesTest(BenchTest):
    def position_um(self) -> int:
        return self.lab.rig.sample()["position_um"]

    def test_1_the_rig_homes_runs_moves_and_stops(self) -> None:
        rig = self.lab.rig
        with self.assertRaises(retrograde.Refused) as refused:
            rig.run(**SHORT)
        self.assertIn("home", str(refused.exception))
        self.assertEqual(abs(rig.home()["repeat_steps"]), 0)
        self.assertEqual(rig.sample()["position_um"], 0)

        action = rig.start_run(**SHORT)
        record = action.wait()
        self.assertEqual((record["commanded_edges"], record["counted_edges"], record["outcome"]), (STEPS, STEPS, "complete"))
        self.assertEqual(record["ticks"], 200_000_000)
        rows = self.lab.rows(action.files["csv"])
        self.assertGreater(len(rows), 150)
        self.assertEqual({row["origin"] for row in rows}, {"virtual"})
        self.assertTrue(all(-0.01 <= row["position_mm"] <= 20.01 for row in rows))

        self.assertEqual(rig.move("12.5")["position_um"], 12_500)
        self.assertTrue(rig.move(12.5).get("already"))
        # It would take 6 s of the rig's time to 0.
        with rig.jog("home", speed_mm_s=2):
            until(lambda: self.position_um() < 12_400)
        at = self.position_um()
        self.assertTrue(0 < at < 12_400, at)
        self.assertEqual(self.position_um(), at)

    def test_2_a_run_is_held_resumed_and_stopped(self) -> None:
        rig = self.lab.rig
        rig.home()
        action = rig.start_run(**{**SHORT, "duration_s": 5})
        until(lambda: self.position_um() > 500)
        rig.hold()
        self.assertEqual(rig.sample()["state"], "held")
        rig.resume()
        record = action.wait()
        self.assertEqual((record["counted_edges"], record["holds"]), (STEPS, 1))

        action = rig.start_run(**{**SHORT, "duration_s": 20})

        def stop_it() -> None:
            until(lambda: self.position_um() > 500)
            self.lab.stop()

        stopper = threading.Thread(target=stop_it)
        stopper.start()
        with self.assertRaises(retrograde.Stopped):
            action.wait()
        stopper.join()
        at = self.position_um()
        self.assertTrue(0 < at < 20_000, at)
        time.sleep(0.5)
        self.assertEqual(rig.sample()["position_um"], at)

    def test_3_an_emergency_stop_is_latched_until_it_is_acknowledged(self) -> None:
        rig = self.lab.rig
        rig.home()
        action = rig.start_run(**{**SHORT, "duration_s": 20})
        until(lambda: self.position_um() > 500)
        rig.estop()
        with self.assertRaises(retrograde.RetrogradeError):
            action.wait()
        self.assertEqual(rig.sample()["state"], "faulted")
        with self.assertRaises(retrograde.RetrogradeError):
            rig.home()
        rig.acknowledge()
        rig.home()

    def test_4_the_capsule_references_folds_and_unfolds(self) -> None:
        capsule = self.lab.capsule
        with self.assertRaises(retrograde.Refused):
            capsule.fold()
        self.assertEqual(capsule.reference()["outcome"], "complete")
        folded = capsule.fold(note="from Python")
        self.assertEqual(folded["outcome"], "complete")
        self.assertTrue(20_000 < folded["thread_um"] < 23_000)
        self.assertTrue(capsule.fold().get("already"))
        partly = capsule.fold(thread_mm=8)
        self.assertAlmostEqual(partly["thread_um"], 8_000, delta=150)
        self.assertEqual(capsule.unfold()["outcome"], "complete")
        self.assertIn("end_force_ma", [setting["name"] for setting in capsule.settings()])

    def test_5_an_order_that_was_given_long_ago_is_refused(self) -> None:
        # As if it had waited since then in a dead link.
        given = {**self.lab.state(), "time_utc": "2026-01-02T03:04:05Z"}
        with mock.patch.object(self.lab, "state", return_value=given):
            with self.assertRaisesRegex(retrograde.Refused, "late"):
                self.lab.rig.acknowledge()

    def test_5_the_stream_tells_the_rigs_samples(self) -> None:
        with self.lab.stream() as stream:
            for message in stream:
                if message.event == "rig":
                    self.assertIn("position_um", message.data["samples"][0])
                    conforms({"$ref": "#/components/schemas/RigSamples"}, message.data)
                    break

    def test_6_without_the_token_nothing_moves(self) -> None:
        stranger = retrograde.Lab(self.lab.url)
        for command in (stranger.rig.home, stranger.capsule.fold, stranger.rig.acknowledge):
            with self.assertRaises(retrograde.Denied):
                command()
        stranger.stop()


if __name__ == "__main__":
    unittest.main()
