"""Messages on parameters, and combinations of parameters, that the residuals do not determine."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import jax
import numpy as np

from hhtjax.description import Array, PyTree, freeze
from hhtjax.identification.evidence import count, residuals_of, used_by_starts

if TYPE_CHECKING:
    from hhtjax.identification.result import FitResult

BEYOND = "most residuals are so large that the robust loss is flat there (`weights` should be one over the noise)"


class IdentifiabilityWarning(UserWarning):
    """The residuals do not determine every parameter."""


def parameter_names(params: PyTree):
    """A name for each entry, in the order of `ravel_pytree(params)`: a, decay[0], decay[1]."""
    names = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(freeze(params)):
        name = jax.tree_util.keystr(path, simple=True, separator=".") or "params"
        names += [f"{name}{list(map(int, i)) or ''}" for i in np.ndindex(np.shape(leaf))]
    return names


def parameter_values(params: PyTree) -> np.ndarray:
    """The value of each entry, in the order of `parameter_names`: (p,)."""
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(freeze(params))])


def undetermined_combinations(
    names: np.ndarray, values: np.ndarray, singular_values: Array, directions: Array, num_residuals: int
):
    """A phrase for each combination of parameters that has no effect on the residuals.

    Args:
        names, values: names and values of the p parameters. singular_values, directions: those of `Uncertainty`.
        num_residuals: number of rows of the Jacobian.

    >>> import numpy as np
    >>> undetermined_combinations(["k1", "k2"], [2.0, 3.0], [1.4, 0.0], np.array([[2, -3], [2, 3]]), 9)
    ['k1, k2 only through their ratio']
    """
    s, values = np.asarray(singular_values), np.asarray(values)
    null = np.asarray(directions)[s <= 10 * num_residuals * np.finfo(s.dtype).eps * s[0]]
    relative = null / np.where(values == 0, 1, values)[None, :]
    basis = sorted(_sparse_basis(relative), key=lambda row: tuple(np.abs(row) < 1e-4))
    return [_phrase(names, row, values) for row in basis]


def _sparse_basis(rows: np.ndarray) -> np.ndarray:
    """A basis of the same row space with many zeros, by elimination with pivoting; largest entry of a row: one."""
    rows = rows / np.maximum(np.abs(rows).max(axis=1, keepdims=True, initial=0), 1e-300)
    free = list(range(len(rows)))
    for _ in range(len(rows)):
        i, j = max(((i, j) for i in free for j in range(rows.shape[1])), key=lambda ij: abs(rows[ij]))
        rows[i] /= rows[i, j]
        free.remove(i)
        for other in range(len(rows)):
            if other != i:
                rows[other] -= rows[other, j] * rows[i]
    return rows / np.maximum(np.abs(rows).max(axis=1, keepdims=True, initial=0), 1e-300)


def _phrase(names, direction, values: np.ndarray) -> str:
    """The phrase for a direction: relative changes of the parameters that together have no effect."""
    at = np.flatnonzero(np.abs(direction) > 1e-4)
    names, direction = [names[i] for i in at], direction[at] / direction[at[0]]
    if len(names) == 1:
        return f"{names[0]} not at all"
    joined = ", ".join(names)
    values = values[at]
    absolute = direction * np.where(values == 0, 1, values)
    through = []
    if len(names) == 2:
        for name, sign in (("sum", -1), ("difference", 1)):
            through += [name] if np.allclose(absolute / absolute[0], [1, sign], atol=1e-3) else []
    if np.all(values != 0):
        through += ["product"] if len(names) == 2 and np.allclose(direction, [1, -1], atol=1e-3) else []
        through += [f"ratio{'s' * (len(names) > 2)}"] if np.allclose(direction, 1, atol=1e-3) else []
    if through:
        return f"{joined} only through their {' or '.join(through)}"
    unit = ["d{0}/{0}" if value != 0 else "d{0}" for value in values]
    terms = " ".join(f"{x:+.3g} {u.format(n)}" for x, u, n in zip(direction, unit, names, strict=True))
    return f"{joined} not along {terms}"


def why_undetermined(result):
    """Names of the parameters without a standard error, and the reason in words; empty if all have one.

    Example of a reason: "the residuals determine a, b only through their product".
    """
    believed, free = result.uncertainty, result.free
    flags = np.asarray(believed.undetermined)
    if not flags.any():
        return [], ""
    names, residuals = np.asarray(parameter_names(result.params))[free], residuals_of(result)
    s, directions, size = believed.singular_values, believed.directions, sum(r.size for r in residuals.plain)
    combinations = undetermined_combinations(names, parameter_values(result.params)[free], s, directions, size)
    why = BEYOND
    if combinations:
        why = f"the residuals determine {'; '.join(combinations)}"
    elif count(residuals) - used_by_starts(result) <= len(names):
        why = "there are as many residuals as parameters, so their variance cannot be estimated"
    return names[flags].tolist(), why


def warn_undetermined(caller: str, result: FitResult, stacklevel: int):
    """Warns with `IdentifiabilityWarning`, naming parameters and combinations, unless all are determined."""
    names, why = why_undetermined(result)
    if names:
        message = f"{caller}: no standard error for {', '.join(names)}: {why}."
        warnings.warn(message, IdentifiabilityWarning, stacklevel=stacklevel)
