"""Many unknowns: dense systems beside SciPy's lu_solve, with idle and with busy cores; sparse ones beside SuperLU."""

import time
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context

import jax.numpy as jnp
import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import splu

import hhtjax
from experiments.benchmarks.measure import least_seconds
from experiments.report import COLOURS, MARKERS
from hhtjax.plot import legend, subplots

ALPHA, DT = -0.05, 1e-3
STEPPER = hhtjax.hht(ALPHA, linearize="predictor")
C = STEPPER.coefficients
BUSY = 3  # processes that do nothing but take time
ITERATIONS = 40


def full_matrices(n):
    """M, C, K without a zero."""
    rng = np.random.default_rng(0)
    B = rng.normal(size=(n, n)) / np.sqrt(n)
    K = 40 * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)) + B @ B.T
    return np.diag(rng.uniform(1, 2, n)) + 0.1 * B @ B.T, 0.01 * K, K


def step_matrix(M, D, K):
    """Of the step."""
    return M + (1 - C.alpha_f) * (C.gamma * DT * D + C.beta * DT**2 * K)


def by_hand(n, num_steps):
    """The same steps as a loop over `scipy.linalg.lu_solve`; the factors are made before."""
    M, D, K = full_matrices(n)
    factors, f = linalg.lu_factor(step_matrix(M, D, K)), 1 - C.alpha_f
    start = np.linspace(0, 1, n)
    w0 = np.linalg.solve(M, -K @ start)

    def run():
        q, v, w, a = start, 0 * start, w0, w0
        for _ in range(num_steps):
            x, u = q + DT * v + DT**2 * (0.5 - C.beta) * a, v + DT * (1 - C.gamma) * a
            p = f * w + C.alpha_f * w  # predicted: constant acceleration
            r = M @ w + D @ (u + C.gamma * DT * p) + K @ (x + C.beta * DT**2 * p)
            new = w - linalg.lu_solve(factors, r, check_finite=False)
            a = f * new + C.alpha_f * w
            q, v, w = x + C.beta * DT**2 * a, u + C.gamma * DT * a, new
        return q

    return run


@contextmanager
def busy(number):
    """That many processes that take what time they can get."""
    processes = [get_context("spawn").Process(target=spin, daemon=True) for _ in range(number)]
    for process in processes:
        process.start()
    try:
        time.sleep(1.0 if number else 0.0)
        yield
    finally:
        for process in processes:
            process.terminate()
            process.join()


def spin():
    """For ever."""
    while True:
        pass


def end(system, stepper, num_steps, q0):
    """The last position."""
    run = hhtjax.simulate(system, stepper, q0, 0 * q0, dt=DT, num_steps=num_steps, save_every=num_steps)
    return run.q[-1]


def dense(sizes, num_steps, repeats):
    """us per step of both, with idle and with busy cores: the least and the median of calls in turns."""
    rows = []
    for n in sizes:
        system, start, hand = hhtjax.LinearSystem(*full_matrices(n)), jnp.linspace(0, 1, n), by_hand(n, num_steps)
        ours = partial(end, system, STEPPER, num_steps, start)
        difference = float(np.abs(np.asarray(ours()) - hand()).max())
        for number in (0, BUSY):
            with busy(number):
                times = seconds({"ours": ours, "hand": hand}, repeats)
            row = {"n": n, "busy_processes": number, "difference": difference}
            for name, x in times.items():
                row |= {f"{name}_us_per_step": 1e6 * min(x) / num_steps,
                        f"{name}_median_us_per_step": 1e6 * float(np.median(x)) / num_steps}  # fmt: skip
            row["over_hand"] = min(times["ours"]) / min(times["hand"])
            row["median_over_hand"] = float(np.median(times["ours"]) / np.median(times["hand"]))
            rows.append(row)
    return rows


def seconds(functions, repeats):
    """{name: wall times of its calls}, in turns."""
    times = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            start = time.perf_counter()
            np.asarray(function())
            times[name].append(time.perf_counter() - start)
    return times


def beam(n):
    """M and K of n/2 Hermite elements of a clamped beam, 0.1 m each, with unit density and stiffness; two a node."""
    m, L = n // 2, 0.1
    k = np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]]) / L**3
    mass = np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]]) * L / 420
    places = 2 * np.arange(m)[:, None] + np.arange(4)  # rotations are in units of 1/L
    rows, columns = np.repeat(places, 4, axis=1).ravel(), np.tile(places, (1, 4)).ravel()
    shape = 2 * m + 2, 2 * m + 2
    return [sparse.coo_array((np.tile(A.ravel(), m), (rows, columns)), shape=shape).tocsr()[2:, 2:] for A in (mass, k)]


def membrane(n):
    """M and K of a square of bilinear elements, 0.1 m each, held at its edge, unit density and tension."""
    m, h = int(n**0.5), 0.1
    k, mass = (
        sparse.dia_array((np.outer([a, b, a], np.ones(m)), [-1, 0, 1]), shape=(m, m))
        for a, b in ((-1 / h, 2 / h), (h / 6, 4 * h / 6))
    )
    return sparse.kron(mass, mass).tocsr(), (sparse.kron(k, mass) + sparse.kron(mass, k)).tocsr()


MESHES = {"beam": (beam, 3), "membrane": (membrane, None)}  # and the half-bandwidth, where it is small
LARGEST = {"dense": 1000, "banded": 10**5}  # unknowns


def ways(mesh, n, num_steps):
    """{way: function without arguments} for a mesh of about n unknowns, and what to compare with."""
    make, p = MESHES[mesh]
    M, K = make(n)
    n = M.shape[0]
    q0 = jnp.sin(jnp.linspace(0.0, 20.0, n))
    system = hhtjax.LinearSystem(hhtjax.sparse(M), hhtjax.sparse(1e-4 * K), hhtjax.sparse(K))
    found = {"sparse": (system, STEPPER)}
    if n <= LARGEST["dense"]:
        found["dense"] = hhtjax.LinearSystem(M.toarray(), 1e-4 * K.toarray(), K.toarray()), STEPPER
    if p and n <= LARGEST["banded"]:
        found["banded"] = system, hhtjax.hht(ALPHA, linearize="predictor", solve=hhtjax.banded(p))
    solve = hhtjax.conjugate_gradients(ITERATIONS)
    found["conjugate gradients"] = system, hhtjax.hht(ALPHA, linearize="predictor", solve=solve)
    functions = {name: partial(end, *both, num_steps, q0) for name, both in found.items()}
    options = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.001, "options": {"SymmetricMode": True}}
    factors, b = splu(step_matrix(M, 1e-4 * K, K).tocsc(), **options), np.asarray(q0)

    def solves():
        for _ in range(num_steps):
            x = factors.solve(b)
        return x

    return n, functions | {"SuperLU's solve alone": solves}


def sparse_meshes(sizes, repeats):
    """ms per step in every way."""
    rows = []
    for mesh in MESHES:
        for n, num_steps in sizes:
            n, functions = ways(mesh, n, num_steps)
            times = least_seconds(functions, repeats)
            left = float(np.abs(np.asarray(functions["sparse"]()) - functions["conjugate gradients"]()).max())
            ms = {name: 1e3 * x / num_steps for name, x in times.items()}
            ratio = ms["sparse"] / ms["SuperLU's solve alone"]
            rows.append({"mesh": mesh, "n": n, "ms_per_step": ms, "over_superlu": ratio, "difference_to_cg": left})
    return rows


def run(report, fast):
    """Both."""
    if fast:
        found: dict = {"num_steps": 50, "dense": dense([20], 50, 1), "sparse": sparse_meshes([(400, 5)], 1)}
    else:
        found = {"num_steps": 1000, "dense": dense([20, 50, 100, 200], 1000, 5)}
        report.progress("dense")
        found["sparse"] = sparse_meshes([(1000, 100), (10_000, 40), (100_000, 20)], 5)
    report.table(list(found["dense"][0]), [list(row.values()) for row in found["dense"]])
    names = list(dict.fromkeys(name for row in found["sparse"] for name in row["ms_per_step"]))
    report.table(
        ["mesh", "n", *(f"{name}, ms" for name in names), "sparse over SuperLU"],
        [[row["mesh"], row["n"], *(row["ms_per_step"].get(name, "-") for name in names), row["over_superlu"]]
         for row in found["sparse"]],
    )  # fmt: skip
    if not fast:
        report.figure("benchmarks_many_unknowns", figure(found["sparse"], names))
    return found


def figure(rows, names):
    """Time per step against the number of unknowns, a panel for each mesh."""
    drawn, panels = subplots(1, len(MESHES), width=160, height=75, sharey=True)
    for axes, mesh in zip(panels, MESHES, strict=True):
        for i, name in enumerate(names):
            mine = [row for row in rows if row["mesh"] == mesh and name in row["ms_per_step"]]
            style = {"color": COLOURS[i], "marker": MARKERS[i], "ms": 4, "lw": 1}
            axes.loglog([row["n"] for row in mine], [row["ms_per_step"][name] for row in mine], **style, label=name)
        axes.set(xlabel="unknowns")
        axes.set_title(mesh, loc="right")  # the legend is on the left
    panels[0].set(ylabel="time per step (ms)")
    legend(panels[0])
    return drawn
