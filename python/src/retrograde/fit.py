"""Fits the body of the model to the displacements of campaigns: a posterior for ArviZ, and the reasons to doubt it.

    python -m retrograde.fit FOLDER [FOLDER ...] --out fit

Needs `pip install './python[fit]'` and the program `retrograde`, whose model it tabulates once. docs/fit.md says what
is assumed, and what no fit can see.
"""

from __future__ import annotations

import argparse
import csv
import os
import pathlib
import subprocess
import sys
import tempfile
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

# The matrices are small: threads of the linear algebra cost more than they save.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import arviz_base
import arviz_stats
import emcee
import numpy as np
from scipy import stats

from .data import Campaign

Array = Any  # of numpy; floats unless it is named as an index
Case = Tuple[int, float, float]  # what a displacement depends on: cycles, stroke and indentation, mm
Band = Tuple[float, float, float, float]  # 5, 50 and 95 %, and a probability
# Bounds of the priors that are even in the logarithm. The first three are parameters of the body; the fourth is the
# standard deviation of the repeats, and nobody reads the tail to less than 0.05 mm.
BOUNDS = {"coupling": (0.03, 1.0), "friction_ratio": (1.2, 200.0), "preload_mm": (1e-4, 0.2), "spread_mm": (0.05, 10.0)}
BODY, SPREAD, TAU = slice(0, 3), 3, 4
NAMES = [*BOUNDS, "tau_mm"]
LOW, HIGH = np.log([list(ends) for ends in BOUNDS.values()]).T
# The model's error in one pass of the rollers: its logarithm is normal with this median and a deviation of 1.
TAU_MM, TAU_95_MM = 0.1, 0.1 * np.exp(stats.norm.ppf(0.95))
# Nodes of the table along each parameter of the body, and the step of the rollers in it.
NODES, STEP_MM = (48, 40, 24), 0.05
WALKERS, DRAWS, STEPS = 64, 100, 2000
# The walkers have mixed from these on; until then the steps are doubled, up to three times.
MOST_RHAT, LEAST_ESS = 1.02, 1000.0
DOUBT = 0.05  # probability by chance below which a check is a reason to doubt


class Refused(Exception):
    """Data that cannot be fitted; the text says why and what to do."""


class Trials:
    """Displacements, mm, + headward. The repeats in a notch on a wall are a condition, and share the model's error."""

    def __init__(self, rows: Sequence[Tuple[float, str, Case]], origin: str) -> None:
        mm, names, cases = zip(*rows)  # displacement, condition and case of each trial
        self.mm, self.names, self.origin = np.array(mm, float), np.array(names), origin
        self.depths = np.array([depth for _, _, depth in cases])
        self.conditions, self.cases = list(dict.fromkeys(names)), list(dict.fromkeys(cases))
        self.condition = np.array([self.conditions.index(name) for name in names])
        self.case = np.array([self.cases.index(case) for case in cases])
        self.of = np.eye(len(self.conditions))[self.condition]
        self.repeats = self.of.sum(0)
        self.means = self.mm @ self.of / self.repeats
        self.cycles = np.array([cycles for cycles, _, _ in cases]) @ self.of / self.repeats
        self.degrees = len(mm) - len(self.conditions)
        scatter = np.linalg.norm(self.mm - self.means[self.condition]) / np.sqrt(max(self.degrees, 1))
        self.spread_mm = max(float(scatter), BOUNDS["spread_mm"][0])


def read(folders: Sequence[pathlib.Path]) -> Trials:
    """The trials of the unfolded body that count for `retrograde report`."""
    rows: List[Tuple[float, str, Case]] = []
    seen: Dict[Tuple[float, ...], pathlib.Path] = {}
    origins = set()
    for folder in folders:
        campaign = Campaign(folder)
        origins.add(campaign.origin)
        for number, names in campaign.changed_trials().items():
            print(f"{folder}: trial {number} is left out, its files were changed: {', '.join(names)}")
        trials = [row for row in campaign.counted() if row["shape"] == "unfolded" and row["indentation_mm"] is not None]
        copy = seen.setdefault(tuple(row["displacement_mm"] for row in trials), folder)
        if copy is not folder:
            raise Refused(f"{folder} and {copy} have the same displacements: name each campaign once")
        for row in trials:
            asked = campaign.records(row["trial"])[-1].sidecar["action"]["requested"]  # the run is the last
            case = asked["cycles"], asked["stroke_um"] / 1000, float(row["indentation_mm"])
            name = f"{row['lubrication']}, {row['indentation']}, {case[0]} cycles"
            rows.append((float(row["displacement_mm"]), name, case))
    if not rows or len(origins) > 1:
        raise Refused(f"{len(rows)} displacements, origin {' and '.join(sorted(origins))}: it takes some of one origin")
    return Trials(rows, origins.pop())


def tool(*line: str) -> str:
    """What the program `retrograde` says."""
    try:
        return subprocess.run(line, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError) as why:
        raise Refused(f"{line[0]} (--program): {getattr(why, 'stderr', why)}") from why


def simulate(program: str, case: Case, axes: Any) -> Array:
    """The model's displacements, mm, of every combination of coupling, friction ratio and preload."""
    with tempfile.TemporaryDirectory() as folder:
        line = [program, "simulate", "--out", folder, "sweep", "--indentations-mm", f"{case[2]:.6f}"]
        for key, number in zip(("cycles", "stroke_mm", "step_mm"), (*case[:2], STEP_MM)):
            line += ["--set", f"rig.{key}={number:g}"]
        line += [f"--vary=body.{name}=" + ",".join(f"{one:.6f}" for one in values) for name, values in zip(NAMES, axes)]
        tool(*line)
        rows = csv.DictReader(pathlib.Path(folder, "sweep-roller.csv").read_text(encoding="utf-8").splitlines())
    return np.array([float(row["displacement_mm"]) for row in rows]).reshape([len(values) for values in axes])


class Table:
    """Caches the model at the nodes of a grid over the prior, in files named by what they depend on; linear between."""

    def __init__(self, program: str, cases: Sequence[Case], folder: pathlib.Path) -> None:
        axes = [np.geomspace(*ends, count).round(6) for ends, count in zip(BOUNDS.values(), NODES)]
        self.logs = [np.log(axis) for axis in axes]
        version = tool(program, "--version").split()[-1]
        folder.mkdir(parents=True, exist_ok=True)
        files = [folder / "-".join(map(str, ("model", version, *case, *NODES, f"{STEP_MM}.npy"))) for case in cases]
        for case, path in zip(cases, files):
            if not path.exists():
                print(f"table of the model at {case[2]:g} mm ...", flush=True)
                np.save(path, simulate(program, case, axes))
        mm = np.stack([np.load(path) for path in files], -1)
        # Between two nodes that the model jumps or bends over, the table is wrong by a fifth of its second difference.
        ends = [[(int(axis == other),) * 2 for other in range(4)] for axis in range(3)]
        square = sum(np.pad(np.diff(mm, 2, axis=axis) / 5, ends[axis], "edge") ** 2 for axis in range(3))
        self.values = np.concatenate([mm, square], -1).reshape(-1, 2 * len(cases))

    def __call__(self, logs: Array) -> Tuple[Array, Array]:
        """Of each body, for each case: displacement, mm, and the variance of the table's error."""
        places, weights = np.zeros((1, len(logs)), int), np.ones((1, len(logs)))
        for axis, at in zip(self.logs, logs.T):
            cell = np.clip(np.searchsorted(axis, at) - 1, 0, len(axis) - 2)
            share = (at - axis[cell]) / (axis[cell + 1] - axis[cell])
            places = np.concatenate([places * len(axis) + cell, places * len(axis) + cell + 1])
            weights = np.concatenate([weights * (1 - share), weights * share])
        mm, square = np.split(np.einsum("cb,cbk->bk", weights, self.values[places]), 2, axis=1)
        return mm, square


class Target(NamedTuple):
    """Prior times likelihood of trials, at logarithms of the unknowns."""

    trials: Trials
    table: Table

    def draw(self, count: int, random: np.random.Generator) -> Array:
        """Draws of the prior."""
        tau = np.log(TAU_MM) + random.standard_normal((count, 1))
        return np.hstack([random.uniform(LOW, HIGH, (count, TAU)), tau])

    def errors(self, logs: Array) -> Tuple[Array, Array, Array, Array]:
        """Of each condition: mean of its displacements less the model's; their squared scatter; variances of a repeat,
        and of what its repeats share: the model's errors there and back, and the table's."""
        trials = self.trials
        mm, square = self.table(logs[:, BODY])
        every = trials.mm - mm[:, trials.case]
        off = every @ trials.of / trials.repeats
        scatter = (every - off[:, trials.condition]) ** 2 @ trials.of
        shared = 2 * (trials.cycles * np.exp(logs[:, TAU:])) ** 2 + square[:, trials.case] @ trials.of / trials.repeats
        return off, scatter, np.exp(2 * logs[:, [SPREAD]]), shared

    def log_likelihood(self, logs: Array) -> Array:
        """Log-likelihood of each condition, one row per body."""
        off, scatter, own, shared = self.errors(logs)
        repeats = self.trials.repeats
        mean = own / repeats + shared
        within = (repeats - 1) * np.log(2 * np.pi * own) + scatter / own + np.log(repeats)
        return -0.5 * (within + np.log(2 * np.pi * mean) + off**2 / mean)

    def __call__(self, logs: Array) -> Array:
        inside = ((logs[:, :TAU] >= LOW) & (logs[:, :TAU] <= HIGH)).all(1)
        logs = np.where(inside[:, None], logs, [*LOW, 0.0])  # the table ends with the prior
        found = self.log_likelihood(logs).sum(1) - 0.5 * (logs[:, TAU] - np.log(TAU_MM)) ** 2
        return np.where(inside, found, -np.inf)

    def refuse(self) -> None:
        """Raises Refused if no body makes such displacements, but one does after a change of sign or unit."""
        trials = self.trials
        if np.median(trials.means) < 0:
            raise Refused("most displacements are negative: + is headward, where every body goes; turn the signs")
        logs = self.draw(20000, np.random.default_rng(0))
        logs[:, SPREAD], logs[:, TAU] = np.log(trials.spread_mm), np.log(TAU_MM)
        off, _, own, shared = self.errors(logs)
        # As they are written without tau: it hides a unit that makes all displacements small.
        misfit = (off**2 / (own / trials.repeats + shared - 2 * (trials.cycles * TAU_MM) ** 2)).mean(1).min()
        for unit, factor in (("centimetres", 10.0), ("metres", 1000.0)):
            corrected = (off + (factor - 1) * trials.means) ** 2 / (factor**2 * own / trials.repeats + shared)
            if corrected.mean(1).min() < min(2, misfit / 20):
                raise Refused(f"no body makes these displacements, but one would in {unit}: write millimetres")


def mixing(data: Any) -> Tuple[Array, bool]:
    """R-hat and bulk effective sample size of each unknown, by ArviZ, with walkers as chains; whether they suffice."""
    both = arviz_stats.rhat(data), arviz_stats.ess(data, method="bulk")
    found = np.array([[float(of[name]) for of in both] for name in NAMES])
    return found, bool(found[:, 0].max() <= MOST_RHAT and found[:, 1].min() >= LEAST_ESS)


def sample(target: Target, seed: int) -> Array:
    """Draws of the posterior, logarithms, by walker and step. The same seed makes the same draws."""
    start = target.draw(400 * WALKERS, np.random.default_rng(seed))
    start = start[np.argsort(target(start))[-WALKERS:]]
    moves = [(emcee.moves.DEMove(), 0.4), (emcee.moves.DESnookerMove(), 0.1), (emcee.moves.KDEMove(), 0.5)]
    sampler = emcee.EnsembleSampler(WALKERS, len(NAMES), target, vectorize=True, moves=moves)
    state = emcee.State(start, random_state=np.random.RandomState(seed).get_state())
    for more in (1, 1, 2, 4):
        state = sampler.run_mcmc(state, more * STEPS, skip_initial_state_check=True)
        half = sampler.iteration // 2  # the first half is spent on finding the posterior
        draws = np.swapaxes(sampler.get_chain(discard=half, thin=half // DRAWS), 0, 1)
        found = {name: draws[..., axis] for axis, name in enumerate(NAMES)}
        if mixing(arviz_base.from_dict({"posterior": found}))[1]:
            break
    return draws


def inference_data(target: Target, draws: Array, seed: int) -> Any:
    """Posterior, prior, predictions, likelihood of each condition and the data, as ArviZ reads them."""
    trials, random = target.trials, np.random.default_rng(seed)
    flat, before = draws.reshape(-1, len(NAMES)), target.draw(4000, random)[None]
    _, _, own, shared = target.errors(flat)
    common = np.sqrt(shared) * random.standard_normal(shared.shape)
    every = target.table(flat[:, BODY])[0][:, trials.case] + common[:, trials.condition]
    every = every + np.sqrt(own) * random.standard_normal(every.shape)
    made = {"displacement_mm": every, "mean_mm": every @ trials.of / trials.repeats}
    groups = {
        "posterior": {name: np.exp(draws[..., axis]) for axis, name in enumerate(NAMES)},
        "prior": {name: np.exp(before[..., axis]) for axis, name in enumerate(NAMES)},
        "posterior_predictive": {name: values.reshape(*draws.shape[:2], -1) for name, values in made.items()},
        "log_likelihood": {"mean_mm": target.log_likelihood(flat).reshape(*draws.shape[:2], -1)},
        "observed_data": {"displacement_mm": trials.mm, "mean_mm": trials.means},
        "constant_data": {"indentation_mm": trials.depths, "condition_of_trial": trials.names},
    }
    dims = {name: ["trial"] for name in ("displacement_mm", "indentation_mm", "condition_of_trial")}
    dims["mean_mm"], coords = ["condition"], {"condition": trials.conditions}
    return arviz_base.from_dict(groups, coords=coords, dims=dims, attrs={"/": {"origin": trials.origin, "seed": seed}})


def left_out(data: Any) -> List[Band]:
    """Predicts each condition from the others: 5, 50 and 95 % of its mean, mm, and the chance to be as far off."""
    loo, found = arviz_stats.loo(data, pointwise=True, var_name="mean_mm"), []
    for name, mean in zip(data.observed_data["condition"].values, data.observed_data["mean_mm"].values):
        made = data.posterior_predictive["mean_mm"].sel(condition=name).values.reshape(-1)
        order = np.argsort(made)
        ranks = np.cumsum(np.exp(loo.log_weights.sel(condition=name).values.reshape(-1))[order])
        ends = np.interp([0.05, 0.5, 0.95], ranks / ranks[-1], made[order])
        below = np.interp(mean, made[order], ranks / ranks[-1], left=0.0, right=1.0)
        found.append((*ends.tolist(), 2 * float(min(below, 1 - below))))
    return found


def reasons(target: Target, data: Any, beside: Sequence[Band]) -> List[str]:
    """The reasons to doubt a fit, each a sentence. docs/fit.md says what none of them sees."""
    found, trials = [], target.trials
    logs = np.log(data.posterior.dataset[NAMES].to_array().values.reshape(len(NAMES), -1).T)
    if not mixing(data)[1]:
        found.append(f"the walkers have not mixed: R-hat above {MOST_RHAT}, or bulk ESS below {LEAST_ESS:.0f}")
    if (tau := float(np.exp(np.median(logs[:, TAU])))) > TAU_95_MM:
        found.append(f"tau is {tau:.2f} mm, beyond 95 % of its prior, {TAU_95_MM:.2f} mm: the model is wrong")
    places = (logs[:, :TAU] - LOW) / (HIGH - LOW)
    for name, *shares in zip(BOUNDS, (places < 0.05).mean(0), (places > 0.95).mean(0)):
        if max(shares) > 0.2:
            found.append(f"{name} has {max(shares):.0%} of its draws at one end of its prior: the prior decides")
    logs[:, SPREAD], logs[:, TAU] = np.log(trials.spread_mm), -99
    off, _, own, shared = target.errors(logs)
    least, degrees = float((off**2 / (own / trials.repeats + shared)).sum(1).min()), len(trials.conditions) - 3
    if min(degrees, trials.degrees) < 1:
        found.append("nothing checks it: that takes repeats, and more than three conditions")
    elif (p := float(stats.f.sf(least / degrees, degrees, trials.degrees))) < DOUBT:
        found.append(f"without tau the nearest body misses by chi-square {least:.0f} at {degrees} degrees, p {p:.1g}")
    p, name = min((band[-1] * len(beside), name) for band, name in zip(beside, trials.conditions))
    if p < DOUBT:
        found.append(f"the others do not predict `{name}`, p {p:.1g}: its displacements are wrong, or the model is")
    return found


def fit(trials: Trials, program: str, tables: pathlib.Path, seed: int = 1) -> Tuple[Target, Any, List[Band], List[str]]:
    """Target, data for ArviZ, what each condition should be by the others, and the reasons to doubt the fit."""
    target = Target(trials, Table(program, trials.cases, tables))
    target.refuse()
    data = inference_data(target, sample(target, seed), seed)
    beside = left_out(data)
    return target, data, beside, reasons(target, data, beside)


def figures(target: Target, data: Any, beside: Sequence[Band], out: pathlib.Path) -> None:
    """The corner plot, the data with the posterior's bands, and each condition beside what the others predict."""
    import corner
    from matplotlib import pyplot

    pyplot.switch_backend("agg")
    trials, order = target.trials, np.argsort(target.trials.depths, kind="stable")
    logs = np.log(data.posterior.dataset[NAMES].to_array().values.reshape(len(NAMES), -1).T)
    style: Any = {"range": [0.995] * len(NAMES), "quantiles": [0.05, 0.5, 0.95], "plot_datapoints": False}
    corner.corner(logs / np.log(10), labels=[f"log10 {name}" for name in NAMES], **style)
    pyplot.savefig(out / "corner.png", dpi=80)
    made = data.posterior_predictive["displacement_mm"].values.reshape(len(logs), -1)[:, order]
    body = target.table(logs[:, BODY])[0][:, trials.case[order]]
    _, panels = pyplot.subplots(1, 2, figsize=(10, 4.5))
    for axes, base, label in zip(panels, (0, np.median(body, 0)), ("displacement, mm", "less the median body, mm")):
        for values, colour, name in ((made, "#d5e2f2", "a trial, tau and spread"), (body, "#7fa3cf", "the body")):
            low, high = np.quantile(values, [0.05, 0.95], axis=0) - base
            axes.fill_between(trials.depths[order], low, high, color=colour, label=f"5 to 95 %: {name}", linewidth=0)
        for wall, marker in (("dry", "o"), ("lubricated", "x")):
            off = np.where(np.char.startswith(trials.names, wall)[order], trials.mm[order] - base, np.nan)
            axes.plot(trials.depths[order], off, marker, markersize=4, label=wall)
        axes.set(xlabel="indentation a, mm", ylabel=label, title=f"origin of the trials: {trials.origin}")
    panels[0].legend(loc="upper left", fontsize="x-small")
    pyplot.savefig(out / "data.png", dpi=80, bbox_inches="tight")
    _, axes = pyplot.subplots(figsize=(7, 1 + 0.3 * len(beside)))
    low, middle, high, _ = np.array(beside).T
    axes.hlines(trials.conditions, low - middle, high - middle, "#7fa3cf", linewidth=7, label="5 to 95 % by the others")
    axes.plot(trials.means - middle, trials.conditions, "o", color="#c06a10", label="measured")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncols=2)
    axes.set(xlabel="mean of the condition less what the others predict, mm")
    pyplot.savefig(out / "left-out.png", dpi=80, bbox_inches="tight")


def main(arguments: Optional[Sequence[str]] = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m retrograde.fit", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folders", nargs="+", type=pathlib.Path, metavar="FOLDER", help="a campaign; all of one body")
    parser.add_argument("--out", type=pathlib.Path, default="fit", help="folder of the results and the tables")
    parser.add_argument("--seed", type=int, default=1, help="the same seed makes the same draws")
    parser.add_argument("--program", default="retrograde", help="where `retrograde` is, if it is not on the path")
    given = parser.parse_args(arguments)
    try:
        target, data, beside, doubts = fit(read(given.folders), given.program, given.out / "tables", given.seed)
    except (OSError, ValueError, Refused) as why:
        print(f"refused: {why}", file=sys.stderr)
        return 1
    data.to_netcdf(given.out / "fit.nc")
    figures(target, data, beside, given.out)
    print(f"{len(target.trials.mm)} displacements, {len(beside)} conditions, origin {target.trials.origin}")
    print(f"{'':16}{'5 %':>10}{'50 %':>10}{'95 %':>10}{'R-hat':>8}{'bulk ESS':>10}")
    for name, (rhat, ess) in zip(NAMES, mixing(data)[0]):
        parts = [f"{part:10.4g}" for part in np.quantile(data.posterior[name], [0.05, 0.5, 0.95])]
        print(f"{name:16}", *parts, f"{rhat:8.3f}{ess:10.0f}", sep="")
    print("\n".join(f"DOUBT: {one}" for one in doubts) or "no reason to doubt it; docs/fit.md says what no fit can see")
    return 0


if __name__ == "__main__":
    sys.exit(main())
