"""Whole runs, compiled, three ways: `simulate`, the same under `plain()`, and step by step; with derivatives and vmap.

Systems are those of random programs. A difference counts above 1e-9 of the largest number, and above a hundred times
what the plain run changes by when its initial values are changed by single roundings.
"""

import random
import traceback
from collections import Counter
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from program_writer import function, program
from zoo import STEPPERS

import hhtjax

DT, NUM_STEPS, RTOL = 0.02, 6, 1e-9
MODES = ("value", "forward", "reverse", "vmap")


def random_run(seed):
    """Text, system, stepper, q0, v0, params of a seed."""
    rng = random.Random(seed)
    n = rng.choice([1, 2, 2, 3, 4, 6])
    x = np.array([rng.uniform(-1, 1) for _ in range(n)])
    text, (_, _, k) = program(rng, rng.randint(3, 10), args=[x, 0.5 * x[::-1]])
    f, kind, stepper = function(text), rng.randrange(4), rng.choice([x for x in STEPPERS if x != "taylor"])

    def numbers(q, v, params):
        """What the program gives, cut or repeated to one number for each unknown."""
        found = [jnp.ravel(y).astype(float) for y in jax.tree.leaves(f(q, v, params["k"]))]
        return jnp.resize(jnp.concatenate([*found, jnp.ones(1)]), n)

    def force(q, v, t, params):
        return -q - 0.1 * v + params["c"] * jnp.tanh(numbers(q, v, params)) + 0.1 * jnp.sin(t)

    def mass(q, params):
        if kind == 1:
            return 2 + jnp.tanh(numbers(q, q, params))
        return 3 * jnp.eye(n) + 0.3 * jnp.outer(jnp.sin(q), jnp.sin(q)) * (kind - 1)

    system = hhtjax.System(np.ones(n) if kind == 0 else mass, force)
    return f"{text}\n# {stepper}, mass {kind}", system, STEPPERS[stepper], x, 0.5 * x[::-1], {"c": 0.3, "k": k}


def simulated(system, stepper, q0, v0, params, num_steps=NUM_STEPS):
    solution = hhtjax.simulate(system, stepper, q0, v0, params, dt=DT, num_steps=num_steps)
    return solution.q, solution.v


def step_by_step(system, stepper, q0, v0, params, num_steps=NUM_STEPS):
    """The same by the two functions of a stepper, in a scan."""
    params = jax.lax.optimization_barrier(params)  # XLA itself dies when it folds a constant 0 % 0
    step = jax.jit(partial(stepper.step, system, params=params, dt=DT))
    state = stepper.init(system, q0, v0, params, DT)
    path = [state]
    for _ in range(num_steps):
        path.append(step(path[-1])[0])
    return tuple(jnp.stack(list(x)) for x in zip(*[(state.q, state.v) for state in path], strict=True))


def in_mode(run, mode):
    """(q0, v0, c) -> list of arrays, of run: (q0, v0, c) -> (q, v)."""

    def scalar(q0, v0, c):
        q, v = run(q0, v0, c)
        return (jnp.cos(q) + 0.1 * v).sum()

    if mode in ("forward", "both"):
        part = slice(mode == "forward", None)
        return lambda *x: jax.jvp(run, x, tuple(jnp.cos(3.0 * jnp.asarray(y)) for y in x))[part]
    if mode == "reverse":
        return jax.grad(scalar, (0, 1, 2))
    if mode == "vmap":
        return lambda *x: jax.vmap(run)(*(jnp.stack([y, 0.9 * y]) for y in map(jnp.asarray, x)))
    return run


def compare(system, stepper, q0, v0, params, modes=MODES, count=None):
    """(way, mode, found, expected) of each difference."""
    count = Counter() if count is None else count

    def of(way):
        return lambda q0, v0, c: way(system, stepper, q0, v0, {**params, "c": c})

    at = [jnp.asarray(x) for x in (q0, v0, params["c"])]
    for mode in modes:
        plain = jax.jit(in_mode(of(simulated), mode))
        try:
            with hhtjax.plain():
                expected = jax.tree.leaves(plain(*at))
                changed = [jax.tree.leaves(plain(*(x * (1 + s * 2.0**-52) for x in at))) for s in (-3, -1, 1, 2, 4)]
        except (ValueError, TypeError, NotImplementedError) as error:  # reverse mode of a loop
            count[f"{mode} is not for plain JAX: {str(error)[:40]}"] += 1
            continue
        if not all(np.isfinite(x).all() for x in expected):
            count["not finite"] += 1
        for way in (simulated, step_by_step) if mode == "value" else (simulated,):
            try:
                found = jax.tree.leaves(jax.jit(in_mode(of(way), mode))(*at))
            except Exception as error:
                yield way.__name__, mode, "".join(traceback.format_exception(error)[-4:]), None
                continue
            verdict = _judge(found, expected, changed)
            count[verdict] += 1
            if verdict == "different":
                yield way.__name__, mode, found, expected


def _judge(found, expected, changed):
    verdict = "same"
    for i, (a, b) in enumerate(zip(found, expected, strict=True)):
        finite = np.isfinite(b)
        if not np.array_equal(np.isfinite(a), finite):
            if all(np.array_equal(np.isfinite(x[i]), finite) for x in changed):
                return "different"
            verdict = "badly conditioned"
            continue
        a, b, others = np.where(finite, a, 0), np.where(finite, b, 0), [np.where(finite, x[i], 0) for x in changed]
        difference = np.abs(a - b).max(initial=0.0)
        if difference > RTOL * np.abs(b).max(initial=0.0):
            if difference > 100 * max(np.abs(x - b).max(initial=0.0) for x in others):
                return "different"
            verdict = "badly conditioned"
    return verdict


def main(number, seed):
    """Prints each difference, and a summary."""
    count, different, done = Counter(), 0, 0
    while done < number:
        text, *run = random_run(seed)
        seed += 1
        done += 1
        for way, mode, found, expected in compare(*run, modes=("value", MODES[1 + seed % 3]), count=count):
            different += 1
            print(
                f"# {'-' * 20} run of seed {seed - 1}: {way}, {mode}\n{text}\n# found {found}\n# expected {expected}",
                flush=True,
            )
        if done % 20 == 0:
            jax.clear_caches()
    print(f"{number} whole runs, {different} differences;", dict(count))
