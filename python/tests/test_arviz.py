"""ArviZ reads the draws of `retrograde fit`, and finds the numbers that it prints."""

import importlib
import importlib.util
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import unittest
import warnings
from typing import Any, Dict

from bench import programs

EXAMPLES = pathlib.Path(__file__).parents[2] / "docs" / "examples"
UNKNOWNS = {"body.coupling", "body.friction_ratio", "body.preload_mm", "fit.discrepancy_mm"}
# Of the default body, roughly. A run's strokes and net displacement share the model's errors.
TRIALS = """kind,cycles,stroke,indentation_mm,lubrication,displacement_mm,uncertainty_mm,origin
antegrade_pass,,,2,dry,4.9,0.2,virtual
returning_pass,,,2,dry,-0.6,0.2,virtual
antegrade_pass,,,5.05,dry,9.2,0.2,virtual
returning_pass,,,5.05,dry,0.1,0.2,virtual
stroke,,1,3,dry,6.5,0.2,virtual
stroke,,2,3,dry,-0.4,0.2,virtual
net,1,,3,dry,6.2,0.2,virtual
"""
# How often the model's error in an antegrade and in a returning pass enters a displacement.
ERRORS = {
    "antegrade pass": [1, 0],
    "returning pass": [0, 1],
    "stroke 1": [1, 0],
    "stroke 2": [0, 1],
    "net of 1 cycle": [1, 1],
}


@unittest.skipIf(importlib.util.find_spec("arviz") is None, "ArviZ is not installed: `pip install arviz h5netcdf h5py`")
class ArvizTest(unittest.TestCase):
    az: Any
    np: Any
    example: Any
    idata: Any
    fit: Dict[str, Any]

    @classmethod
    def setUpClass(cls) -> None:
        if not (programs() / "retrograde").exists() and "RETROGRADE_PROGRAMS" not in os.environ:
            raise unittest.SkipTest(f"no retrograde in {programs()}: `cargo build --package host-tool`")
        cls.az, cls.np = importlib.import_module("arviz"), importlib.import_module("numpy")
        sys.path.insert(0, str(EXAMPLES))
        cls.example = importlib.import_module("arviz_posterior")
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        out = pathlib.Path(folder.name)
        (out / "trials.csv").write_text(TRIALS, encoding="utf-8")
        command = [str(programs() / "retrograde"), "fit", f"{out}/trials.csv", "--out", str(out), "--json"]
        cls.fit = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
        subprocess.run([sys.executable, EXAMPLES / "arviz_posterior.py", out, out / "fit.nc"], capture_output=True, check=True)
        cls.idata = cls.az.from_netcdf(out / "fit.nc")

    def test_r_hat_and_effective_sizes_are_those_that_fit_prints(self) -> None:
        found = self.example.mixing(self.idata["posterior"])
        self.assertEqual({row["parameter"] for row in self.fit["unknowns"]}, set(found))
        for row in self.fit["unknowns"]:
            for ours, arviz in zip((row["r_hat"], row["ess"], row["tail_ess"]), found[row["parameter"]]):
                self.assertLess(abs(arviz / ours - 1), 1e-6, row["parameter"])

    def test_the_groups_have_their_shapes(self) -> None:
        groups = {
            "posterior": (UNKNOWNS, {"chain", "draw"}),
            "posterior_predictive": ({"displacement_mm", "model_mm"}, {"chain", "draw", "condition"}),
            "log_likelihood": ({"displacement_mm"}, {"chain", "draw", "condition"}),
            "prior": (UNKNOWNS, {"chain", "draw"}),
            "prior_predictive": ({"displacement_mm", "model_mm"}, {"chain", "draw", "condition"}),
            "observed_data": ({"displacement_mm"}, {"condition"}),
        }
        for name, (variables, dims) in groups.items():
            group = self.idata[name]
            self.assertEqual((set(group.data_vars), set(group.sizes)), (variables, dims), name)
            for variable in group.data_vars.values():
                self.assertTrue(self.np.isfinite(variable).all(), name)
        posterior, prior = self.idata["posterior"].sizes, self.idata["prior"].sizes
        self.assertEqual(posterior["chain"] * posterior["draw"], self.fit["draws"])
        self.assertEqual((posterior["chain"], prior["chain"], prior["draw"]), (96, 1, 1000))
        self.assertEqual(list(self.np.bincount(self.idata["posterior"]["ensemble"])), [24] * 4)
        means = [row["mean_mm"] for row in self.fit["conditions"]]
        self.np.testing.assert_allclose(self.idata["observed_data"]["displacement_mm"], means, rtol=1e-12)

    def test_the_draws_are_those_of_the_prior_and_of_the_posterior(self) -> None:
        for row in self.fit["unknowns"]:
            for group, low, high in (("posterior", "posterior_5", "posterior_95"), ("prior", "prior_5", "prior_95")):
                values = self.idata[group][row["parameter"]]
                for bound, part in ((low, 0.05), (high, 0.95)):
                    self.assertAlmostEqual(float((values < row[bound]).mean()), part, delta=0.025)

    def test_likelihood_and_replicates_have_the_covariance_of_the_shared_errors(self) -> None:
        np = self.np
        given = self.idata["constant_data"]
        errors = np.array([ERRORS[kind] for kind in given["kind"].to_numpy()])
        family = given["family"].to_numpy()
        shared = (errors @ errors.T) * (family[:, None] == family)
        own = np.diag(given["uncertainty_mm"].to_numpy() ** 2 + given["table_error_mm"].to_numpy() ** 2)
        predicted = self.idata["posterior_predictive"]

        def by_sample(variable: Any) -> Any:
            return variable.stack(sample=("chain", "draw")).transpose("sample", ...).to_numpy()

        model = by_sample(predicted["model_mm"])
        tau = by_sample(self.idata["posterior"]["fit.discrepancy_mm"].sel(draw=predicted["draw"]))
        covariance = own + tau[:, None, None] ** 2 * shared
        # Given all others, a mean is normal with precision P_ii, off by (P r)_i / P_ii.
        precision = np.linalg.inv(covariance)
        off = self.idata["observed_data"]["displacement_mm"].to_numpy() - model
        pulled = (precision @ off[:, :, None])[:, :, 0]
        diagonal = np.diagonal(precision, axis1=1, axis2=2)
        wanted = 0.5 * (np.log(diagonal / (2 * np.pi)) - pulled**2 / diagonal)
        found = by_sample(self.idata["log_likelihood"]["displacement_mm"])
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-8)
        # Replicates less the model, made independent, each of variance 1.
        away = by_sample(predicted["displacement_mm"]) - model
        white = np.linalg.solve(np.linalg.cholesky(covariance), away[:, :, None])[:, :, 0]
        np.testing.assert_allclose(white.T @ white / len(white), np.eye(len(family)), atol=0.1)

    def test_loo_runs(self) -> None:
        # Seven conditions are few: leaving one out changes the posterior much, of which ArviZ warns.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            loo = self.az.loo(self.idata, pointwise=True)
        elpd = float(loo.elpd_loo if hasattr(loo, "elpd_loo") else loo.elpd)
        # A condition has taken part in the posterior: without weights it is predicted too well.
        log = self.idata["log_likelihood"]["displacement_mm"]
        lpd = float(self.np.log(self.np.exp(log).mean(("chain", "draw"))).sum())
        self.assertTrue(lpd - 20 < elpd < lpd, (elpd, lpd))
        self.assertEqual(loo.pareto_k.shape, (log.sizes["condition"],))


if __name__ == "__main__":
    unittest.main()
