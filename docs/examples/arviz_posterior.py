"""Makes an ArviZ InferenceData of what `retrograde fit` wrote, and prints R-hat and effective sample sizes.

    python3 docs/examples/arviz_posterior.py FOLDER FILE.nc

Needs Python 3.10 or newer and `pip install arviz h5netcdf h5py`. docs/arviz.md says what the groups hold.
"""

import pathlib
import sys

import arviz as az
import numpy as np
import pandas as pd
import scipy.stats
import xarray as xr


def read(folder):
    """The groups, as xarray.DataTree: the file of it is an InferenceData to ArviZ before and since 1.0."""
    folder = pathlib.Path(folder)
    draws = pd.read_csv(folder / "draws.csv")
    predictions = pd.read_csv(folder / "predictions.csv")
    conditions = pd.read_csv(folder / "conditions.csv", index_col="condition")
    origin = conditions.pop("origin").iloc[0]

    def drawn(group):
        """The unknowns: chain, draw."""
        rows = draws[draws.group == group].drop(columns=["group", "origin"])
        table = rows.set_index(["chain", "draw"]).to_xarray()
        return table.assign_coords(ensemble=table.ensemble[:, 0].drop_vars("draw"))

    def predicted(group, columns):
        """Columns of the predictions: chain, draw, condition. The conditions stay in the fit's order."""
        rows = predictions[predictions.group == group].set_index(["chain", "draw", "condition"])
        return rows[list(columns)].rename(columns=columns).to_xarray().sel(condition=conditions.index.to_numpy())

    means = {"replicated_mm": "displacement_mm", "model_mm": "model_mm"}
    given = conditions.to_xarray()
    groups = {
        "posterior": drawn("posterior"),
        "posterior_predictive": predicted("posterior", means),
        "log_likelihood": predicted("posterior", {"log_density": "displacement_mm"}),
        "prior": drawn("prior"),
        "prior_predictive": predicted("prior", means),
        "observed_data": given[["displacement_mm"]],
        "constant_data": given.drop_vars("displacement_mm"),
    }
    tree = xr.DataTree.from_dict(groups)
    tree.attrs = {"inference_library": "retrograde fit", "origin": origin}
    return tree


def variance(chains):
    """var+ of Vehtari et al. (2021) over the halves of chains: chain, draw."""
    halves = chains.reshape(2 * len(chains), -1)
    length = halves.shape[1]
    return halves.var(axis=1, ddof=1).mean() * (length - 1) / length + halves.mean(axis=1).var(ddof=1)


def effective(draws):
    """Effective sample size of a mean over ensemble, step, walker: that of the walkers' means, times what each is worth."""
    means = draws.mean(axis=2)
    return float(az.ess(means, method="mean")) * variance(draws.reshape(len(draws), -1)) / variance(means)


def mixing(posterior):
    """R-hat, bulk and tail effective sample size of each unknown, from ArviZ with the chains of `retrograde fit`."""
    ensembles = len(np.unique(posterior["ensemble"]))
    found = {}
    for name, variable in posterior.data_vars.items():
        walkers = variable.transpose("chain", "draw").to_numpy()
        draws = walkers.reshape(ensembles, -1, walkers.shape[1]).swapaxes(1, 2)
        ranks = scipy.stats.rankdata(draws).reshape(draws.shape)
        scores = scipy.stats.norm.ppf((ranks - 0.375) / (draws.size + 0.25))
        tails = [draws <= np.quantile(draws, part) for part in (0.05, 0.95)]
        r_hat = float(az.rhat(draws.reshape(ensembles, -1), method="rank"))
        found[name] = (r_hat, effective(scores), min(map(effective, tails)))
    return found


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    tree = read(sys.argv[1])
    tree.to_netcdf(sys.argv[2], engine="h5netcdf")
    print(f"{'parameter':<20} {'R-hat':>7} {'ESS':>7} {'tail':>7}")
    for name, (r_hat, bulk, tail) in mixing(tree["posterior"]).items():
        print(f"{name:<20} {r_hat:7.4f} {bulk:7.0f} {tail:7.0f}")


if __name__ == "__main__":
    main()
