"""What charts take out of a run: entries of its pytrees, by name."""

import jax
import numpy as np

from hhtjax.description import all_concrete
from hhtjax.runs.output import require_path
from hhtjax.runs.solution import Solution

SYMBOLS = {"q": "q", "v": "v", "acceleration": "w", "multipliers": "L", "z": "z"}


def require_run(caller, solution):
    """An error unless it is the solution of one run, with numbers."""
    if not isinstance(solution, Solution):
        raise TypeError(f"{caller}: `solution` must be a Solution, as of simulate; received {type(solution).__name__}.")
    require_path(caller, solution)
    if not all_concrete(solution):
        raise TypeError(f"{caller}: `solution` is a tracer: draw outside jit, vmap and grad.")
    if np.ndim(solution.t) != 1:
        raise ValueError(
            f"{caller}: `solution` must be of one run; received a batch, t of shape {np.shape(solution.t)}. "
            "Its member i is jax.tree.map(lambda x: x[i], solution)."
        )


def named_entries(tree):
    """{name: (leaf name, values (K + 1,))} of each number: "[0]" of an array, "x[0]" and "phi" of a dict."""
    found = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        leaf = np.asarray(leaf)
        for i in np.ndindex(leaf.shape[1:]):
            found[f"{name}{list(map(int, i)) or ''}"] = name, leaf[(slice(None), *i)]
    return found


def chosen_entries(caller, solution, quantity, entries):
    """{name: (leaf name, values)} of one of a solution's quantities, all or those asked for, by entry or leaf."""
    tree = getattr(solution, quantity)
    if tree is None:
        raise ValueError(f"{caller}: the solution has no {quantity}: received a run without.")
    found = named_entries(tree)
    if entries is None:
        return found
    entries = (entries,) if isinstance(entries, str) else tuple(entries)
    symbol = SYMBOLS[quantity]
    chosen = {}
    for wanted in entries:
        alike = {n: x for n, x in found.items() if wanted in (n, x[0] or None, f"{symbol}{n}")}
        if not alike:
            raise ValueError(f"{caller}: `entries` must be among {', '.join(found)}; received {wanted!r}.")
        chosen |= alike
    return chosen


def shown_name(quantity, name):
    """q[0] for the entry [0] of an array; of a dict the entry's own name."""
    return f"{SYMBOLS[quantity]}{name}" if name == "" or name.startswith("[") else name


def unit_of(units, name, leaf):
    """The unit of one entry; units: a word, or words by entry or leaf, or None."""
    return units.get(name, units.get(leaf)) if isinstance(units, dict) else units


def prefixed(label, name):
    """`label: name`."""
    return name if label is None else f"{label}: {name}" if name else label
