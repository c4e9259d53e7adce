"""Every blow-up of the gallery run again by `simulate`: what `solution.check` says of it, step and quantity.

On its own it sees what is not finite, and where Newton fails. Told how far q may get, it sees the rest.

Chaotic runs depend on the last digit, and so on how a program is compiled: not all blow up again. What counts is those
that do, by a look at their paths.
"""

import re
from collections import Counter
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.cells import FARTHEST
from experiments.stability.gallery import ALPHAS, METHODS, results
from experiments.stability.grades import BLOWN_UP, plain
from experiments.stability.scenes import all_cases

STEPS = 128  # most blow-ups show within as many, so that one compilation serves all step sizes
NAMED = re.compile(r"step (\d+) \(to t = .*?\) failed: (the position q is farther|Newton|.*? is not finite)")


@partial(jax.jit, static_argnames=("method", "num_steps"))
def run_again(scene, counts, alphas, method, num_steps):
    """A batch of runs with steps of duration/count."""

    def single(count, alpha):
        system, params, q0, v0, duration = scene
        stepper = METHODS[method].make(alpha)
        return hhtjax.simulate(system, stepper, q0, v0, params, dt=duration / count, num_steps=num_steps)

    return jax.vmap(single)(counts, alphas)


def message(solution, member, reach, count):
    """Step and quantity that `check` names for one run; None where it is silent, or names a step after the end."""
    one = jax.tree.map(lambda x: x[member], solution)
    try:
        one.check(reach)
    except hhtjax.SimulationError as error:
        named = NAMED.search(str(error))
        return named[2] if named and int(named[1]) <= count else None
    return None


def blew_up(solution, member, reach, count):
    """Whether a run is beyond the reach, or not finite, after any of its steps."""
    q = solution.q[member, : count + 1]
    return not np.all(np.abs(q - q[0]) <= reach)


class Found(NamedTuple):
    """Whether a cell blew up again, and what `check` says, alone and told the reach."""

    again: bool
    alone: str | None
    told: str | None


def reports(case, method, blown_up, sizes, reach) -> list[Found]:
    """Of each cell that blew up."""
    cells = [(sizes[i], ALPHAS[j]) for i, j in np.argwhere(blown_up)]
    found = [Found(False, None, None)] * len(cells)
    for num_steps in (STEPS, max(sizes)):
        pending = [i for i, x in enumerate(found) if x.told is None]
        if not pending:
            break
        counts, alphas = np.array([cells[i][0] for i in pending]), np.array([cells[i][1] for i in pending])
        steps = min(num_steps, int(counts.max()))
        solution = jax.device_get(run_again(case.scene, jnp.array(counts), jnp.array(alphas), method, steps))
        for k, i in enumerate(pending):
            said = (message(solution, k, limit, counts[k]) for limit in (None, reach))
            found[i] = Found(blew_up(solution, k, reach, counts[k]), *said)
    return found


def run(report, fast):
    """Counts by what was said."""
    outcomes, sizes, references = results(report, fast)
    scenes = {case.name: case for case in all_cases()}
    everything, silent = [], []
    for name, by_method in outcomes.items():
        for method, outcome in by_method.items():
            blown_up = outcome.grade == BLOWN_UP
            if blown_up.any():
                found = reports(scenes[name], method, blown_up, sizes[name], FARTHEST * references[name].reach)
                everything += found
                silent += [f"{name}: {plain(method)}" for x in found if x.again and x.told is None]
        report.progress(f"reported: {name}")
    again = [x for x in everything if x.again]
    cells = {
        "blown_up": len(everything),
        "again": len(again),
        "named_by_check": sum(x.alone is not None for x in again),
        "named_by_check_given_reach": sum(x.told is not None for x in again),
    }
    quantities = Counter(str(x.told) for x in again)
    print("Blow-ups, and how many `solution.check` names, alone and told how far q may get\n")
    report.table(list(cells), [list(cells.values())])
    report.table(["what is named", "cells"], list(quantities.items()))
    return {"cells": cells, "named": dict(quantities), "silent": silent}
