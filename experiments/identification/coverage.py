"""What the experiments with many noisy records share: fits of logarithms, and how many intervals hold the truth."""

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax


def fit_logarithms(residuals, x, guess, **options):
    """The fit of residuals(params) for x, the logarithms of the parameters over their guess; both dicts of numbers."""

    def of_logarithms(x):
        return residuals({name: value * jnp.exp(x[name]) for name, value in guess.items()})

    return hhtjax.fit(of_logarithms, x, scale=dict.fromkeys(x, 1.0), **options)


@jax.vmap
def interval(result, x):
    """The result's 95 % interval about x."""
    return result._replace(params=x).interval()


def judge(coarse, fine, off):
    """Results of `fit_logarithms` under vmap, with steps h and h/2, and Richardson's value of order 2, as numbers.

    off: the logarithm of guess over truth, for each parameter and record. covered: how many intervals hold the truth,
    by kind of estimate; over_truth_with_interval: Richardson's value, lower and upper end, by parameter.
    """
    estimates = {
        "h": (coarse, coarse.params),
        "h/2": (fine, fine.params),
        "Richardson": (fine, jax.tree.map(lambda a, b: b + (b - a) / 3, coarse.params, fine.params)),
    }
    covered, entries = {}, {}
    for kind, (result, x) in estimates.items():
        lower, upper = ({name: np.asarray(end[name] + off[name]) for name in off} for end in interval(result, x))
        covered[kind] = {n: int(np.sum((lower[n] <= 0) & (upper[n] >= 0))) for n in off}
        entries = {n: [np.exp(np.asarray(y)).tolist() for y in (x[n] + off[n], lower[n], upper[n])] for n in off}
    return {
        "records": int(np.size(fine.code)),
        "converged": int(np.sum(fine.converged)),
        "covered": covered,
        "over_truth_with_interval": entries,
    }


def tell(report, found):
    """Prints how many intervals hold the truth, and the median half-width."""
    names = list(found["over_truth_with_interval"])
    rows = [
        [f"truth inside, of {found['records']}, {kind}", *map(str, by.values())]
        for kind, by in found["covered"].items()
    ]
    widths = {n: np.median(np.diff(np.log(x[1:]), axis=0)) / 2 for n, x in found["over_truth_with_interval"].items()}
    rows.append(["median half-width, %", *(f"{100 * w:.2g}" for w in widths.values())])
    report.table(["95 % intervals", *names], rows)
    print(f"{found['converged']} of {found['records']} converged.\n")
