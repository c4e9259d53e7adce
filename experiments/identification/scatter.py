"""Are the standard errors of Silverbox right? They are compared with the scatter of fits to parts of the record."""

import jax
import numpy as np

import hhtjax
from experiments.identification import data
from experiments.identification.data import SCALE, STATE_SCALE, Record
from experiments.report import Report
from hhtjax.identification.sandwich import SEGMENTS


def over_scatter(report: Report, record: Record, result, substeps: int):
    """Standard errors, cluster and naive, over those seen: the scatter of fits to each of SEGMENTS parts of the record.

    Each part has a free initial state. The mean of as many independent estimates scatters by their deviation over the
    root of their number, which itself is known to 13 %.
    """
    params = result.params[0]
    problem = data.windows_problem(record, len(record.y) // SEGMENTS - 1, substeps, 0.0)
    scale = {name: SCALE[name] for name in params}, STATE_SCALE

    @jax.jit
    @jax.vmap
    def of_part(start, part):
        fitted = hhtjax.fit(lambda x: problem["residuals"](*x, part), (params, start), scale=scale, covariance=False)
        return fitted.params[0], fitted.converged

    found, converged = of_part(problem["starts"], problem["records"])
    count = len(converged)
    seen = {name: float(np.std(found[name], ddof=1) / np.sqrt(count)) for name in params}
    naive = result.errors(result.uncertainty.naive)[0]
    ratios = {
        n: {"cluster": float(result.standard_errors[0][n]) / e, "naive": float(naive[n]) / e} for n, e in seen.items()
    }
    report.progress(f"{int(np.sum(converged))} of {count} parts of the record converged")
    report.table(
        ["standard error over scatter", *ratios], [[k, *(r[k] for r in ratios.values())] for k in ("cluster", "naive")]
    )
    return ratios | {"parts": count, "converged": int(np.sum(converged))}
