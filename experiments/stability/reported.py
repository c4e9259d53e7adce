"""Every blow-up of the gallery run again by `simulate`: what `solution.check` says of it, step and quantity.

On its own it sees what is not finite, and where Newton fails. Told how far q may get, it sees the rest.
"""

import re
from functools import partial

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


def reports(case, method, blown_up, sizes, reach):
    """What `check` says of each cell, alone and told the reach."""
    cells = [(sizes[i], ALPHAS[j]) for i, j in np.argwhere(blown_up)]
    found: list = [(None, None)] * len(cells)
    for num_steps in (STEPS, max(sizes)):
        open_cells = [i for i, x in enumerate(found) if x[1] is None and (num_steps > STEPS or cells[i][0])]
        if not open_cells:
            break
        counts, alphas = np.transpose([cells[i] for i in open_cells])
        steps = min(num_steps, int(max(counts)))
        solution = jax.device_get(run_again(case.scene, jnp.array(counts), jnp.array(alphas), method, steps))
        for k, i in enumerate(open_cells):
            found[i] = tuple(message(solution, k, limit, counts[k]) for limit in (None, reach))
    return found


def run(report, fast):
    """Counts by what was said."""
    outcomes, sizes, references = results(report, fast)
    scenes = {case.name: case for case in all_cases()}
    cells = {"all": 0, "named_by_check": 0, "named_by_check_given_reach": 0}
    quantities, silent = {}, []
    for name, by_method in outcomes.items():
        for method, outcome in by_method.items():
            blown_up = outcome.grade == BLOWN_UP
            if not blown_up.any():
                continue
            reach = FARTHEST * references[name].reach
            found = reports(scenes[name], method, blown_up, sizes[name], reach)
            cells["all"] += len(found)
            cells["named_by_check"] += sum(alone is not None for alone, _ in found)
            cells["named_by_check_given_reach"] += sum(told is not None for _, told in found)
            silent += [f"{name}: {plain(method)}" for _, told in found if told is None]
            for _, told in found:
                quantities[told] = quantities.get(told, 0) + 1
        report.progress(f"reported: {name}")
    print("Blow-ups, and how many `solution.check` names, alone and told how far q may get\n")
    report.table(list(cells), [list(cells.values())])
    report.table(["what is named", "cells"], [[str(x), n] for x, n in quantities.items()])
    return {"cells": cells, "named": {str(x): n for x, n in quantities.items()}, "silent": silent}
