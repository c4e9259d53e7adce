"""Compiled runs, and their times."""

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax import hht

STARTS = "consistent", "zero"  # initial accelerations and multipliers


def constrained_hht(alpha, formulation, iterations: int | None = 1, tolerance=1e-10):
    """HHT with arrays for its numbers: those that differ in numbers alone share one compilation."""
    options: dict[str, Any] = {"formulation": formulation, "iterations": iterations, "tolerance": np.array(tolerance)}
    return hht(np.array(alpha), **options)


@partial(jax.jit, static_argnames="num_steps")
def trace(scene, stepper, h, num_steps, zero):
    """All states of a run, the start included; zero: it starts with w = a = L = 0, consistent or not."""
    start = stepper.init(scene.system, scene.q0, scene.v0, scene.params, h)
    w, a, L = jax.tree.map(lambda x: jnp.where(zero, 0.0, x), (start.w, start.a, start.L))
    start = start._replace(w=w, a=a, L=L)

    def step(state, _):
        state, _ = stepper.step(scene.system, state, scene.params, h)
        return state, state

    _, path = jax.lax.scan(step, start, length=num_steps)
    return jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), start, path)


@jax.jit
def end(scene, stepper, num_steps):
    """State at the end of a run, and the number of its linear solves; num_steps is traced, so compiled once."""
    h = scene.duration / num_steps

    def step(_, carry):
        state, solves = carry
        state, info = stepper.step(scene.system, state, scene.params, h)
        return state, solves + (1 if info.iterations is None else info.iterations)

    start = stepper.init(scene.system, scene.q0, scene.v0, scene.params, h)
    return jax.lax.fori_loop(0, num_steps, step, (start, 0))


def least_seconds(functions, repeats):
    """The least CPU time of each, in turns, after a call to compile: what else the machine does hardly matters."""
    times = [float("inf")] * len(functions)
    for function in functions:
        jax.block_until_ready(function())
    for _ in range(repeats):
        for i, function in enumerate(functions):
            start = time.process_time()
            jax.block_until_ready(function())
            times[i] = min(times[i], time.process_time() - start)
    return times
