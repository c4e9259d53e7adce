"""What a step costs, against the number of unknowns, and what derivatives cost.

All of a scene's ways are timed in turns, the least of several runs counts, and the parameters of each run differ from
those of the one before: factors of a matrix that was seen are kept (hhtjax.numerics.superlu), and are not to be found.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import csc_array, csr_array, eye_array
from scipy.sparse.linalg import splu

import hhtjax
from experiments.benchmarks.measure import temporary_bytes
from experiments.flexible import figures, models
from experiments.flexible.aims import judged
from experiments.flexible.beam import pendulum
from experiments.flexible.beam import scene as plain_scene
from experiments.flexible.native_beam import FAST, PLAIN, Run, library
from hhtjax.numerics.sparsity import dissected

DT = 1e-3
WORK = 3e5  # unknowns times steps of a run of one unit of work
C_WAYS = {"C, two-sided, vectorised": (FAST, "beam"), "C, plain": (PLAIN, "plain_beam")}


class Way(NamedTuple):
    """One way of taking steps. call: a number near 1, by which parameters are multiplied -> what may be waited for."""

    call: Callable
    steps: int


def dense(A: Any, b: Any) -> jax.Array:
    """A^-1 b, as if A were full."""
    return jnp.linalg.solve(A, b)


def stepper(**options: Any) -> Any:
    """One solve a step, as of the C source."""
    return hhtjax.hht(linearize="predictor", start="simple", **options)


def ours(model: models.Model, steps: int, **options: Any) -> Way:
    """A run of so many steps; options: of `hht`."""
    way = stepper(**options)

    @jax.jit
    def call(factor):
        params = jax.tree.map(lambda x: factor * x, model.params)
        run = hhtjax.simulate(model.system, way, model.q0, model.v0, params, dt=DT, num_steps=steps, save_every=steps)
        return run.q, run.failure.step

    return Way(call, steps)


def rows_of(scene: str, unknowns: int, ways: dict[str, Way], repeats: int) -> list[dict]:
    """A row for each way."""
    rows = []
    for name, way in ways.items():
        begun = time.process_time()
        first = jax.block_until_ready(way.call(1.0))
        row = {"scene": scene, "way": name, "unknowns": unknowns, "steps": way.steps}
        rows.append(row | {"first_call_cpu_s": time.process_time() - begun, "failed": failed(first)})
    least = dict.fromkeys(ways, np.inf)
    for i in range(repeats):
        for name, way in ways.items():
            begun = time.perf_counter()
            jax.block_until_ready(way.call(1 + 1e-3 * (i + 1)))
            least[name] = min(least[name], time.perf_counter() - begun)
    for row in rows:
        seconds = least[row["way"]] / row["steps"]
        row |= {"us_per_step": 1e6 * seconds, "ns_per_step_and_unknown": 1e9 * seconds / unknowns}
    return rows


def failed(first: Any) -> bool:
    """Whether a run of ours failed."""
    return isinstance(first, tuple) and bool(np.any(np.asarray(first[1])))


def steps_for(unknowns: int, fast: bool, least: int = 10) -> int:
    """So many that a run takes about as long for all sizes."""
    return 10 if fast else max(least, round(WORK / unknowns))


def of_beam(elements: int, fast: bool) -> tuple[int, dict[str, Way]]:
    """The falling beam."""
    described = pendulum(elements)
    n = described.unknowns
    steps = steps_for(n, fast, 200)  # in which it turns and bends: modified Newton factorises anew now and then
    by_function = models.Model(*plain_scene(described), {"EI": described.EI}, n)
    ways = {
        "elements": ours(models.beam(described), steps),
        "banded": ours(by_function, steps, solve=hhtjax.banded(5)),
    }
    if n <= 301 and not fast:
        ways["dense"] = ours(by_function, max(200, steps // 20))
    for name, flags in C_WAYS.items():
        if (found := library(*flags)) is not None:
            ways[name] = Way(in_c(Run(found, described, DT, steps)), steps)
    if importlib.util.find_spec("exudyn"):
        ways |= by_exudyn(described, n, steps)
    return n, ways


def in_c(run: Run) -> Callable:
    """C keeps nothing from run to run: nothing has to change."""
    return lambda factor: run()[0]


def by_exudyn(described: Any, unknowns: int, steps: int) -> dict[str, Way]:
    """exudyn with full and with modified Newton, each with the tightest tolerance that it comes to its end with."""
    from experiments.flexible import by_exudyn as exudyn

    model, ways = exudyn.built(described), {}
    steps = min(steps, 1000)
    for modified in (False, True):
        tolerance = exudyn.tightest(model, DT, steps, modified)
        if tolerance is None:
            continue

        def call(factor: float, modified: bool = modified, tolerance: float = tolerance) -> float:
            ran = exudyn.run(model, DT, steps, modified, tolerance)
            return np.inf if ran is None else ran.seconds

        ways[f"exudyn, {'modified' if modified else 'full'} Newton"] = Way(call, steps)
    return ways


def of_chain(n: int, fast: bool) -> tuple[int, dict[str, Way]]:
    """Masses and hardening springs in line."""
    steps, plain = steps_for(n, fast), models.plain_chain(n)
    ways = {
        "elements": ours(models.spring_chain(n), steps),
        "banded": ours(plain, steps, solve=hhtjax.banded(1)),
    }
    if n <= 100 and not fast:
        ways["dense"] = ours(plain, max(10, steps // 20))
    return n, ways


def of_lattice(side: int, fast: bool) -> tuple[int, dict[str, Way]]:
    """The square of nodes, and the factorisations and solves that its steps cannot do without."""
    model, n = models.lattice(side), 2 * side * side
    steps = 3 if fast else max(10, 10_000 // n)
    ways = {"elements": ours(model, steps)}
    A = step_matrix(model, side)
    order = dissected(csr_array(A != 0), n)  # the order in which the library eliminates
    b = np.ones(n)
    ways["factor and solve, SciPy's order"] = Way(factor_and_solve(A, b, "MMD_AT_PLUS_A", steps), steps)
    ways["factor and solve, our order"] = Way(factor_and_solve(A[order][:, order], b, "NATURAL", steps), steps)
    return n, ways


def step_matrix(model: models.Model, side: int) -> Any:
    """M - (1 + alpha) beta h^2 dQ/dq of the lattice at its start, a SciPy array put together from its springs."""
    pairs, r, C = models.grid_pairs(side), np.asarray(model.q0["r"]), stepper().coefficients
    d = r[pairs[:, 1]] - r[pairs[:, 0]]
    along = d / np.linalg.norm(d, axis=1)[:, None]
    own = model.params["k"] * along[:, :, None] * along[:, None, :]  # of springs at their length at rest
    blocks = np.block([[own, -own], [-own, own]])
    places = (2 * pairs[:, :, None] + np.arange(2)).reshape(-1, 4)
    rows, columns = np.repeat(places, 4, axis=1).ravel(), np.tile(places, (1, 4)).ravel()
    K = csc_array((blocks.ravel(), (rows, columns)), shape=(2 * side * side,) * 2)
    return csc_array(eye_array(2 * side * side) + (1 - C.alpha_f) * C.beta * DT**2 * K)


def factor_and_solve(A: Any, b: np.ndarray, order: str, times: int) -> Callable:
    """So many of them, of a matrix in an order that `splu` finds ("MMD_AT_PLUS_A") or keeps ("NATURAL")."""
    options = {"permc_spec": order, "diag_pivot_thresh": 0.001, "options": {"SymmetricMode": True}}

    def call(factor: float) -> np.ndarray:
        x = b
        for _ in range(times):
            x = splu(factor * A, **options).solve(b)
        return x

    return call


def of_links(number: int, fast: bool) -> tuple[int, dict[str, Way]]:
    """Rods and pins in the plane."""
    model = models.links(number)
    steps = 10 if fast else max(20, 20_000 // number)
    ways = {"elements": ours(model, steps)}
    if number <= 100 and not fast:
        ways["dense"] = ours(model, 10 if number > 10 else 500, solve=dense)
    return model.unknowns, ways


def of_rods(number: int, fast: bool) -> tuple[int, dict[str, Way]]:
    """Rods and ball joints in space."""
    model = models.rods_in_space(number)
    steps = 10 if fast else max(20, 5000 // number)
    ways = {"elements": ours(model, steps)}
    if number <= 30 and not fast:
        ways["dense"] = ours(model, 10 if number > 10 else 200, solve=dense)
    return model.unknowns, ways


SCENES: dict[str, tuple[Callable, tuple[int, ...], tuple[int, ...]]] = {  # name: (ways, sizes, those of a fast run)
    "beam": (of_beam, (10, 100, 1000, 3334), (10,)),
    "spring chain": (of_chain, (100, 1000, 10_000, 100_000), (20,)),
    "lattice": (of_lattice, (22, 71), (6,)),
    "links": (of_links, (10, 100, 500), ()),
    "rods in space": (of_rods, (10, 30, 100), ()),
}


def gradients(elements: int = 333, steps: int = 300, repeats: int = 7) -> dict:
    """Of the tip of a beam in EI: the value, a directional derivative and a gradient; times, and temporary memory."""
    model, way = models.beam(pendulum(elements)), stepper()

    def tip(EI):
        params = model.params | {"EI": EI}
        run = hhtjax.simulate(model.system, way, model.q0, model.v0, params, dt=DT, num_steps=steps, save_every=steps)
        return run.q["r"][-1, -1, 1]

    functions = {"value": tip, "forward": lambda EI: jax.jvp(tip, (EI,), (1.0,)), "reverse": jax.value_and_grad(tip)}
    programs, cpu = {}, {}
    for name, function in functions.items():
        begun = time.process_time()
        programs[name] = jax.jit(function).lower(1.4e4).compile()
        cpu[name] = time.process_time() - begun
    least = dict.fromkeys(functions, np.inf)
    for i in range(repeats):
        for name, program in programs.items():
            begun = time.perf_counter()
            jax.block_until_ready(program(1.4e4 * (1 + 1e-3 * i)))
            least[name] = min(least[name], time.perf_counter() - begun)
    slopes = [float(programs[name](1.4e4)[1]) for name in ("forward", "reverse")]
    found: dict = {"unknowns": model.unknowns, "num_steps": steps, "slope_difference": relative(*slopes)}
    for name in functions:
        found[name] = {
            "us_per_step": 1e6 * least[name] / steps,
            "over_value": least[name] / least["value"],
            "temporary_MB": temporary_bytes(programs[name]) / 1e6,
            "compile_cpu_s": cpu[name],
        }
    return found


def relative(x: float, y: float) -> float:
    """The distance of two numbers over their size."""
    return abs(x - y) / max(abs(x), abs(y))


def exponents(rows: list[dict]) -> dict:
    """{scene: {way: slope of log time over log unknowns}}, by least squares over all sizes; at least two."""
    found: dict = {}
    for row in rows:
        found.setdefault(row["scene"], {}).setdefault(row["way"], []).append((row["unknowns"], row["us_per_step"]))
    return {
        scene: {way: slope(np.log(np.array(x))) for way, x in ways.items() if len(x) > 1}
        for scene, ways in found.items()
    }


def slope(points: np.ndarray) -> float:
    """Of the line through points (k, 2), by least squares."""
    x, y = (points - points.mean(axis=0)).T
    return float(x @ y / (x @ x))


def run(report, fast: bool) -> dict:
    """All scenes and sizes, the derivatives, and how far the aims are met."""
    rows = []
    for scene, (ways, sizes, few) in SCENES.items():
        for size in few if fast else sizes:
            rows += rows_of(scene, *ways(size, fast), 1 if fast else 5)
            report.progress(f"{scene}, {rows[-1]['unknowns']} unknowns")
    report.table(
        ["scene", "unknowns", "way", "us/step", "ns/step/unknown", "first call, CPU s"],
        [[row["scene"], str(row["unknowns"]), row["way"], row["us_per_step"], row["ns_per_step_and_unknown"],
          row["first_call_cpu_s"]] for row in rows],
    )  # fmt: skip
    found = {"rows": rows, "exponents": exponents(rows), "gradients": {} if fast else gradients()}
    found["aims"] = [] if fast else judged(found)
    report.table(["aim", "wanted", "found"], [[x["aim"], x["at_most"], x["found"]] for x in found["aims"]])
    figures.scaling(report, rows)
    return found
