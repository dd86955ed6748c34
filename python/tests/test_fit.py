"""The fit of the model's body to displacements that the model itself has made, and to some that are wrong."""

import contextlib
import hashlib
import importlib.util
import io
import json
import os
import pathlib
import tempfile
import unittest
from typing import Any, List, Tuple

import bench

PROGRAM = str(bench.programs() / "retrograde")
FULL = os.environ.get("RETROGRADE_CAMPAIGN") == "full"
MISSING = [name for name in ("arviz_stats", "corner", "emcee", "h5netcdf", "h5py") if importlib.util.find_spec(name) is None]
if not MISSING:
    import numpy as np
    from retrograde import fit

Rows = List[Tuple[float, str, Tuple[int, float, float]]]
# Coupling, friction ratio and preload of the body `one`.
ONE = (0.15, 40.0, 0.0007)


def campaign(folder: pathlib.Path, rows: Rows) -> None:
    """Writes what the reader of records needs of a campaign with these trials."""
    order, sums = ["trial,purpose,lubrication,indentation,shape"], []
    ledger = ["trial,attempt,event,outcome,displacement_mm,indentation_mm,source,text,origin"]
    for number, (mm, name, (cycles, stroke_mm, depth)) in enumerate(rows, 1):
        wall, notch = name.split(", ")
        order.append(f"{number},series,{wall},a {notch},unfolded")
        ledger += [f"{number},1,began,,,{depth},,,virtual", f"{number},1,ended,complete,,,,,virtual"]
        ledger.append(f"{number},1,displacement,,{mm:.2f},,model,,virtual")
        sidecar = folder / "trials" / f"{number:03}-1" / "run.json"
        sidecar.parent.mkdir(parents=True)
        action = {"kind": "run", "requested": {"cycles": cycles, "stroke_um": round(1000 * stroke_mm)}}
        ended: Any = {"status": "complete", "error": None, "started_utc": "", "events": [], "telemetry": "run.csv"}
        sidecar.write_text(json.dumps({"action": action, **ended}), encoding="utf-8")
        sums.append(f"{hashlib.sha256(sidecar.read_bytes()).hexdigest()}  {sidecar.relative_to(folder).as_posix()}")
    files = {"order.csv": order, "trials.csv": ledger, "readings.csv": ["origin"], "SHA256SUMS": sums}
    for file, lines in files.items():
        (folder / file).write_text("\n".join([*lines, ""]), encoding="utf-8")


@unittest.skipIf(bool(MISSING), f"no {' '.join(MISSING)}: pip install './python[fit]'")
@unittest.skipUnless(pathlib.Path(PROGRAM).exists(), f"no {PROGRAM}")
class Fits(unittest.TestCase):
    """With `RETROGRADE_CAMPAIGN=full` 100 bodies and the table of a real fit, otherwise 5 and a coarse one."""

    tables: pathlib.Path
    depths = (1.0, 2.0, 3.0, 4.0, 5.05) if FULL else (1.0, 3.0, 5.05)

    @classmethod
    def setUpClass(cls) -> None:
        place = tempfile.TemporaryDirectory()
        cls.addClassCleanup(place.cleanup)
        cls.tables = pathlib.Path(os.environ.get("RETROGRADE_FIT_TABLES", place.name))
        if not FULL:
            fit.NODES, fit.STEP_MM, fit.MOST_RHAT, fit.LEAST_ESS = (20, 16, 10), 0.25, 1.1, 300.0

    def rows(self, random: Any, body: Any, other: Any, spread_mm: float = 0.3, tau_mm: float = 0.02) -> Rows:
        """The paper's plan with a body on the dry wall and one on the lubricated wall."""
        rows: Rows = []
        for depth in self.depths:
            case = (5, 130.0, depth)
            for wall, parts in (("dry", body), ("lubricated", other)):
                exact = fit.simulate(PROGRAM, case, np.reshape(parts, (3, 1))).item()
                shared = exact + np.sqrt(2) * case[0] * tau_mm * random.standard_normal()
                rows += [(mm, f"{wall}, {depth} mm", case) for mm in shared + spread_mm * random.standard_normal(10)]
        return rows

    def test_intervals_hold_the_truth(self) -> None:
        seeds, held = range(100) if FULL else range(5, 10), np.zeros(len(fit.NAMES), int)
        for seed in seeds:
            random = np.random.default_rng([2022, seed])
            logs = np.append(random.uniform(fit.LOW, fit.HIGH), np.log(fit.TAU_MM) + random.standard_normal())
            truth = np.exp(logs).round(6)
            trials = fit.Trials(self.rows(random, truth[:3], truth[:3], truth[3], truth[4]), "model")
            target = fit.Target(trials, fit.Table(PROGRAM, trials.cases, self.tables))
            low, high = np.exp(np.quantile(fit.sample(target, seed), [0.05, 0.95], axis=(0, 1)))
            held += (low <= truth) & (truth <= high)
            if FULL:
                print(f"{seed + 1} of 100:", dict(zip(fit.NAMES, held.tolist())), flush=True)
        # 22.5 of 25 are expected; a fit that is right has fewer than 18 once in 300 times.
        self.assertTrue(((held >= 85) & (held <= 95)).all() if FULL else held.sum() >= 18, held)

    def test_wrong_displacements_are_refused_or_doubted(self) -> None:
        for factor, why in ((-1.0, "turn the signs"), (0.001, "in metres")):
            rows = [(factor * mm, name, case) for mm, name, case in self.rows(np.random.default_rng(1), ONE, ONE)]
            with self.assertRaisesRegex(fit.Refused, why):
                fit.fit(fit.Trials(rows, "model"), PROGRAM, self.tables)
        unlike = self.rows(np.random.default_rng(1), ONE, (0.15, 15.0, 0.0007))
        _, _, _, doubts = fit.fit(fit.Trials(unlike, "model"), PROGRAM, self.tables)
        self.assertTrue(any("without tau the nearest body misses" in doubt for doubt in doubts), doubts)

    def test_a_campaign_is_fitted_once(self) -> None:
        said, why = io.StringIO(), io.StringIO()
        with tempfile.TemporaryDirectory() as place, contextlib.redirect_stdout(said), contextlib.redirect_stderr(why):
            folder, out = pathlib.Path(place, "study"), pathlib.Path(place, "fit")
            campaign(folder, self.rows(np.random.default_rng(1), ONE, ONE))
            self.assertEqual(fit.main([str(folder), str(folder), "--program", PROGRAM, "--out", str(out)]), 1)
            self.assertEqual(fit.main([place, "--program", PROGRAM]), 1)
            self.assertEqual(fit.main([str(folder), "--program", PROGRAM, "--out", str(out)]), 0)
            files = {path.name for path in out.iterdir()}
        self.assertRegex(why.getvalue(), r"have the same displacements.*\n.*order.csv")
        self.assertRegex(said.getvalue(), r"60 displacements, 6 conditions, origin virtual\n.*R-hat +bulk ESS")
        self.assertLessEqual({"fit.nc", "corner.png", "data.png", "left-out.png"}, files)
