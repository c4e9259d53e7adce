"""On an accelerator: `vmap` of a run, of double pendulums up to a million and of Lorenz systems, beside diffrax's.

    python -m experiments benchmarks --gpu

Without an accelerator that JAX finds it says so; with --fast it takes a few members and steps, wherever JAX runs.
"""

import sys
import warnings
from functools import partial
from importlib.util import find_spec as is_installed

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.benchmarks.against_c import DT, ours
from experiments.benchmarks.measure import least_seconds, temporary_bytes
from experiments.work_precision.diffrax_peers import make_solver
from hhtjax.scenes import double_pendulum

NUM_STEPS = 1000
MEMBERS = 1_000, 10_000, 100_000, 1_000_000
LORENZ_MEMBERS, LORENZ_DT = 2**23, 1e-3  # as published for MPGOS and DiffEqGPU: 1000 steps of RK4 in single precision
PUBLISHED_MS = {"MPGOS, V100": 94, "DiffEqGPU, V100": 145}


def end_by_diffrax(num_steps, q0):
    """The last position of one member by an implicit method of order 3, with as many equal steps."""
    import diffrax  # pyright: ignore[reportMissingImports]  # of an extra of its own

    scene = double_pendulum.free()
    found = diffrax.diffeqsolve(
        hhtjax.interop.diffrax_term(scene.system), make_solver("Kvaerno3", True), 0.0, DT * num_steps, DT,
        (q0, scene.v0), scene.params, stepsize_controller=diffrax.ConstantStepSize(), saveat=diffrax.SaveAt(t1=True),
        max_steps=num_steps + 1,
    )  # fmt: skip
    assert found.ys is not None
    return found.ys[0][-1]


def lorenz(y, t, rho):
    """Lorenz's equations with sigma = 10, beta = 8/3."""
    x, y, z = y
    return jnp.stack([10 * (y - x), x * (rho - z) - y, x * y - jnp.asarray(8 / 3, z.dtype) * z])


def lorenz_end(num_steps, rho):
    """The last state of one member, in the precision of rho."""
    start = jnp.array([1.0, 0.0, 0.0], rho.dtype)
    system, dt = hhtjax.FirstOrderSystem(lorenz), jnp.asarray(LORENZ_DT, rho.dtype)
    run = hhtjax.simulate(system, hhtjax.rk4(), start, params=rho, dt=dt, num_steps=num_steps, save_every=num_steps)
    return run.q[-1]


def pendulums(report, sizes, num_steps, repeats):
    """ns per step and member, of ours and of diffrax, and how far their ends lie apart."""
    steppers = {"hht": hhtjax.hht(), "hht, predictor": hhtjax.hht(linearize="predictor")}
    scene = double_pendulum.free()
    ways = {name: partial(ours, scene, stepper, num_steps, num_steps) for name, stepper in steppers.items()}
    if is_installed("diffrax"):
        ways["diffrax Kvaerno3"] = partial(end_by_diffrax, num_steps)
    rows = []
    for members in sizes:
        q0 = jnp.asarray(np.random.default_rng(0).normal(size=(members, 2)))
        programs = {name: jax.jit(jax.vmap(end)).lower(q0).compile() for name, end in ways.items()}
        ends = {name: np.asarray(program(q0)) for name, program in programs.items()}
        assert all(np.all(np.isfinite(x)) for x in ends.values())
        times = least_seconds({name: partial(program, q0) for name, program in programs.items()}, repeats)
        rows.append({
            "members": members, "num_steps": num_steps,
            "ns_per_step_and_member": {name: 1e9 * x / num_steps / members for name, x in times.items()},
            "temporary_bytes": {name: temporary_bytes(program) for name, program in programs.items()},
            "median_difference_rad": {name: float(np.median(np.abs(x - ends["hht"]))) for name, x in ends.items()},
        })  # fmt: skip
        report.progress(str(rows[-1]))
    return rows


def run(report, fast):
    """Pendulums in double, Lorenz systems in single precision."""
    device = jax.devices()[0]
    if not fast and device.platform == "cpu":
        sys.exit(f"benchmarks --gpu: JAX finds no accelerator, only {device}; --fast tries the program here.")
    sizes, members, num_steps, repeats = ((8,), 8, 20, 1) if fast else (MEMBERS, LORENZ_MEMBERS, NUM_STEPS, 5)
    rows = pendulums(report, sizes, num_steps, repeats)
    rho = jnp.linspace(0.0, 21.0, members, dtype=jnp.float32)
    program = jax.jit(jax.vmap(partial(lorenz_end, num_steps)))
    with warnings.catch_warnings(action="ignore"):  # that single precision is short: it is what was published
        end = np.asarray(program(rho))
    assert end.dtype == np.float32
    assert np.all(np.isfinite(end))
    (seconds,) = least_seconds({"rk4": partial(program, rho)}, repeats).values()
    report.progress(f"Lorenz: {1e3 * seconds:.4g} ms")
    return {
        "device": device.device_kind, "jax": jax.__version__, "pendulums": rows,
        "lorenz": {"members": members, "num_steps": num_steps, "time_ms": 1e3 * seconds, "published_ms": PUBLISHED_MS},
    }  # fmt: skip
