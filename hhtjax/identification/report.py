"""The text of `FitResult.summary`, and fits as JSON."""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, Real, freeze, thaw
from hhtjax.description.presentation import Table, all_known, brief, known, leaf_rows
from hhtjax.identification import transforms as tf
from hhtjax.identification.evidence import (
    count,
    effective_observations,
    fades,
    residuals_of,
    rms,
    used_by_starts,
    whiteness,
)
from hhtjax.identification.identifiability import parameter_names, parameter_values, why_undetermined
from hhtjax.identification.least_squares import CONVERGED, REASONS

if TYPE_CHECKING:
    from hhtjax.identification.result import FitResult
    from hhtjax.identification.sandwich import Uncertainty

CLOSE = 0.95  # correlation of two estimates from which on it is reported
MOST_PAIRS = 3
AT_BOUND = 0.01  # standard errors
ADVICE = (
    "the residual is not white, and is smaller at the end of the record: if the motion decays, as with friction, this "
    "may be a false minimum; try other initial guesses (multistart), or cut the record into windows (windows)"
)


def summary(result: FitResult) -> str:
    """The text of `FitResult.summary`."""
    cost = f"cost {float(result.cost):.6g}, {float(result.history.cost[0]):.6g} at the start"
    chosen = "" if result.choices is None else f"; steps of the runs chosen {int(result.choices)} times"
    lines = [f"{result.reason}; {int(result.iterations)} iterations, {cost}{chosen}"]
    names, values = parameter_names(result.params), parameter_values(result.params)
    rows = [["parameter", "estimate"]]
    columns = []
    if result.uncertainty is not None:
        rows[0] += ["standard error", "95 % interval", "error / naive"]
        *found, R = _believed(type(result), result.transforms, freeze(result.params), result.uncertainty, result.code)
        columns = [_columns(*row) for row in zip(result.free, *map(parameter_values, found), strict=True)]
    for i, (name, value) in enumerate(zip(names, values, strict=True)):
        rows.append([name, f"{value:.6g}", *(columns[i] if columns else [])])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines += ["  ".join(x.ljust(w) for x, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    lines += _about_residuals(result)
    if result.uncertainty is not None:
        lines += _about_estimates(result, np.asarray(names), parameter_values(found[0]), np.asarray(R))
    return "\n".join(lines)


@partial(jax.jit, static_argnames=("kind", "transforms"))
def _believed(kind: type, transforms: tuple, params: PyTree, uncertainty: Uncertainty, code: Array):
    """Standard errors, interval, naive errors (all frozen), and correlations: one program instead of some fifty."""
    result = kind(thaw(params), None, None, None, None, code, transforms, uncertainty, 0)
    found = result.standard_errors, *result.interval(), result.errors(uncertainty.naive)
    return *map(freeze, found), result.correlation


def table(result) -> Table:
    """Title and table of estimates with standard errors. For a batch or tracers: only what is known of their arrays."""
    numbers = all_known((result.code, result.iterations, result.cost, result.params))
    if len(numbers) <= 3 or numbers[0].ndim:
        title = f"cost {brief(result.cost)}"
        if len(numbers) > 3:
            title = f"{np.isin(numbers[0], CONVERGED).sum()} of {numbers[0].size} fits converged"
        return Table(f"FitResult: {title}", [["parameter", "shape", "dtype"], *leaf_rows(params=result.params)])
    code, iterations, cost, *leaves = numbers
    rows = [["parameter", "estimate"]]
    rows += [
        [name, f"{x:.6g}"] for name, x in zip(parameter_names(result.params), parameter_values(leaves), strict=True)
    ]
    covariance = None if result.uncertainty is None else known(result.uncertainty.covariance)
    if covariance is not None and covariance.shape == (np.sum(result.free),) * 2:
        errors = np.zeros(len(rows) - 1)
        errors[result.free] = np.sqrt(np.maximum(np.diagonal(covariance), 0))
        words = (_columns(free, error, 0, 0, 0)[0] for free, error in zip(result.free, errors, strict=True))
        rows = [[*row, word] for row, word in zip(rows, ["standard error", *words], strict=True)]
    return Table(f"FitResult: {REASONS.get(code.item())}; {iterations} iterations, cost {cost:.6g}", rows)


def _columns(free: Real, error: Real, lower: Real, upper: Real, naive: Real):
    """Standard error, interval, and the ratio to the naive error, in words."""
    if not free:
        return ["fixed", "", ""]
    if np.isinf(error):
        return ["undetermined", "", ""]
    return [f"{error:.3g}", f"{lower:.6g} .. {upper:.6g}", f"{error / naive:.2f}" if naive else ""]


def _about_residuals(result: FitResult):
    """Lines on the residuals: their number and effective number, size, whiteness; and on the fitted starts."""
    residuals = residuals_of(result)
    n = count(residuals)
    missing = sum(x.size for x in residuals.plain) - n
    words = [f"observations: {n}{f' and {missing} missing' if missing else ''}"]
    if result.uncertainty is not None:
        words.append(f"as informative as {effective_observations(n, result.uncertainty):.0f} independent ones")
    lines = [", ".join(words)]
    leaves = zip(residuals.names, residuals.plain, residuals.present, strict=True)
    words = ["residual: rms " + ", ".join(f"{name} {rms(r, here):.4g}".strip() for name, r, here in leaves)]
    starts = jax.tree.leaves(result.starts)
    unknowns = int(np.sum(result.free)) + used_by_starts(result)
    if any(np.asarray(w).dtype != bool for w in jax.tree.leaves(result.weights)) and n > unknowns:
        square = sum(np.sum(r**2) for r in residuals.weighted)
        words.append(f"weighted sum of squares {square / (n - unknowns):.3g} per degree of freedom")
    found = whiteness(residuals) if result.uncertainty is not None else None  # a design has no noise
    if found:
        rho, p, lags = found
        words.append(f"correlation at lag 1 {rho:+.2f}")
        words.append(f"{'' if p > 0.05 else 'not '}white (Ljung-Box, {lags} lags: p = {p:.2g})")
    lines.append("; ".join(words))
    if found and found[1] <= 0.05 and fades(residuals):
        lines.append(ADVICE)
    if starts:
        each = sum(map(np.size, starts)) // len(starts[0])
        lines.append(f"starts: fitted for {len(starts[0])} records, {each} unknowns each")
    return lines


def _about_estimates(result, names, errors: np.ndarray, R: np.ndarray):
    """Lines on the origin of the standard errors, on undetermined parameters, and on correlations."""
    believed = result.uncertainty
    segments = f"the scatter between {result.segments} segments of the record (cluster sandwich)"
    kind = f"from {segments}" if believed.cluster is not None else "from the autocorrelation of the residuals"
    remarks = [f"standard errors: {kind}"]
    if believed.degrees is not None:
        worth, own = 1 + np.asarray(believed.degrees), names[result.free]
        few = [i for i in np.argsort(worth)[:MOST_PAIRS] if worth[i] < result.segments / 2]
        told = ", ".join(f"{worth[i]:.0f} for {own[i]}" for i in few)
        remarks[0] += f"; effective number of segments: {told}" if few else ""
    unknown, why = why_undetermined(result)
    if unknown:
        remarks.append(f"undetermined: {', '.join(unknown)}: {why}")
    if bound := names[_at_bound(result, errors)].tolist():
        remarks.append(f"at a bound: {', '.join(bound)}; standard errors ignore the bound")
    if np.sum(result.free) - len(unknown) > 1:
        rows, columns = np.triu_indices(len(R), 1)
        size = np.abs(R[rows, columns])
        pairs = np.argsort(-size)[: max(1, min(MOST_PAIRS, int(np.sum(size > CLOSE))))]
        together = zip(rows[pairs], columns[pairs], strict=True)
        found = [f"{R[i, j]:+.3f} between {names[i]} and {names[j]}" for i, j in together]
        remarks.append(f"largest correlation{'s' * (len(found) > 1)}: {', '.join(found)}")
    s = np.asarray(believed.singular_values)
    condition = s[0] / s[-1] if s[-1] > 0 else np.inf
    remarks.append(f"condition number of the scaled Jacobian: {condition:.3g}")
    return remarks


def _at_bound(result: FitResult, errors: np.ndarray) -> np.ndarray:
    """Flags of the parameters that are closer to a bound than a hundredth of their standard error, if it is finite."""
    leaves = zip(result.transforms, jax.tree.leaves(freeze(result.params)), strict=True)
    distance = np.concatenate([np.ravel(T.distance(p)) for T, p in leaves])
    return result.free & np.isfinite(errors) & (distance < AT_BOUND * errors)


TRANSFORMS = {"scaled": tf.scaled, "positive": tf.positive, "fixed": tf.fixed}


def encode(x: Any) -> Any:
    """Converts a pytree of named tuples, dicts, lists, tuples, arrays, transforms and steppers to JSON values."""
    if x is None or isinstance(x, (int, float, str)):
        return x
    if isinstance(x, tf.Bounded):
        return {"bounded": [x.lower, x.upper]}
    if isinstance(x, tf.Transform):
        return {"transform": next(name for name, T in TRANSFORMS.items() if T is x)}
    if isinstance(x, dict):
        if not all(isinstance(name, str) for name in x):
            return {"items": [[encode(name), encode(y)] for name, y in x.items()]}
        return {"dict": {name: encode(y) for name, y in x.items()}}
    if (is_dataclass(x) or hasattr(x, "_fields")) and not type(x).__module__.startswith("hhtjax."):
        raise TypeError(f"to_json: `params` must be of dicts, lists, tuples and arrays; received a {type(x).__name__}.")
    if is_dataclass(x):
        return {type(x).__name__: {field.name: encode(getattr(x, field.name)) for field in fields(x)}}
    if names := getattr(x, "_fields", None):
        return {type(x).__name__: {name: encode(y) for name, y in zip(names, x, strict=True)}}
    if isinstance(x, (list, tuple)):
        return {type(x).__name__: [encode(y) for y in x]}
    return {"array": np.asarray(x).tolist(), "dtype": str(np.asarray(x).dtype)}


def read(text: str, kind: type, named: dict) -> Any:
    """Reads the text that the to_json of a class wrote. named: as for `decode`."""
    try:
        found = decode(json.loads(text), named)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"from_json: `text` must be what to_json wrote; a part of it is not: {error}.") from None
    if not isinstance(found, kind):
        raise ValueError(
            f"from_json: `text` must be what to_json of a {kind.__name__} wrote; received a {type(found).__name__}."
        )
    return found


def decode(x: PyTree, named: dict) -> Any:
    """The inverse of `encode`. named: the classes of named tuples and steppers, by name."""
    if not isinstance(x, dict):
        return x
    kind: Any
    content: Any
    kind, content = next(iter(x.items()), (None, None))
    if kind == "array":
        return jnp.asarray(np.asarray(content, x["dtype"]))
    if kind == "bounded":
        return tf.bounded(*content)
    if kind == "transform":
        return TRANSFORMS[content]
    if kind == "items":
        return {decode(name, named): decode(y, named) for name, y in content}
    if kind in ("list", "tuple"):
        return (list if kind == "list" else tuple)(decode(y, named) for y in content)
    if kind != "dict" and kind not in named:
        raise ValueError(f"from_json: `text` must be what to_json wrote; received a part {kind!r}.")
    values = {name: decode(y, named) for name, y in content.items()}
    return values if kind == "dict" else named[kind](**values)
