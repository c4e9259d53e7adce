"""Large systems: a shear building, a bar and a beam of 1e2 to 1e5 unknowns, banded and matrix-free. SI units.

    building   n storeys of 1e5 kg on columns of 1e8 N/m that harden, shaken at the ground
    bar        n elements, c = 5000 m/s, hardening, struck at the free end; steps of 4 elements' travel
    beam       n/2 Hermite elements on a hardening foundation, 10 m, EI = 1e6 N m^2, 50 kg/m, clamped, struck at the tip

Each is timed for a number of steps that is the same for all n, forward, and with the gradient in its stiffness. The
cost of a step must grow with n, not with n^2 or n^3.
"""

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.benchmarks.measure import least_seconds, temporary_bytes
from experiments.report import COLOURS, MARKERS
from hhtjax.plot import legend, subplots

SIZES, FAST_SIZES = (100, 1000, 10_000, 100_000), (40,)
STEPS = 20
ITERATIONS = 30
LENGTH, EI, DENSITY = 10.0, 1e6, 50.0  # of the beam
SPEED, COURANT = 5000.0, 4.0  # of the bar


def storeys(q, v, t, params):
    """Shear between neighbours, by drift; the ground moves."""
    drift = jnp.diff(q, prepend=0.1 * jnp.sin(10.0 * t)[None])
    shear = params["k"] * (1e8 * drift + 1e10 * drift**3) + 1e6 * jnp.diff(v, prepend=0.0)
    return jnp.diff(shear, append=0.0)


def building(n):
    """System, q0, v0, step size."""
    return hhtjax.System(jnp.full(n, 1e5), storeys), jnp.zeros(n), jnp.zeros(n), 1e-2


def bar(n):
    """Elements of 1 m/n and masses of 1 kg/n, so that the stiffness of an element is n c^2."""

    def force(q, v, t, params):
        strain = n * jnp.diff(q, prepend=0.0)
        tension = params["k"] * SPEED**2 * (strain + 1e3 * strain**3)
        return jnp.diff(tension, append=0.0)

    v0 = jnp.exp(-(((jnp.linspace(0.0, 1.0, n) - 1) / 0.1) ** 2))
    return hhtjax.System(jnp.full(n, 1.0 / n), force), jnp.zeros(n), v0, COURANT / (n * SPEED)


def beam(n):
    """Unknowns (w, rotation h) of each node, whose numbers are of one size; the step follows the first period."""
    elements = n // 2
    h = LENGTH / elements
    K = np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]]) * EI / h**3
    rows = [[float(x) for x in row] for row in K]

    def force(q, v, t, params):
        w, turn = q.reshape(-1, 2).T
        ends = *(jnp.concatenate([jnp.zeros(1), x[:-1]]) for x in (w, turn)), w, turn
        F = [params["k"] * sum(k * x for k, x in zip(row, ends, strict=True)) for row in rows]
        w_force, moment = (F[i + 2] + jnp.append(F[i][1:], 0.0) for i in range(2))
        return -jnp.stack([w_force + h * (1e3 * w + 1e7 * w**3), moment], axis=1).reshape(-1)

    tip = np.where(np.arange(1, elements + 1) == elements, 0.5, 1.0)
    mass = DENSITY * h * np.stack([tip, tip / 39], axis=1).reshape(-1)
    shape = (np.arange(1, elements + 1) / elements) ** 2
    v0 = jnp.asarray(np.stack([shape, 2 * shape / np.arange(1, elements + 1)], axis=1).reshape(-1))
    return hhtjax.System(jnp.asarray(mass), force), jnp.zeros(n), v0, 1e-2


CASES = {
    "building, banded": (building, hhtjax.banded(1)),
    "bar, banded": (bar, hhtjax.banded(1)),
    "bar, conjugate gradients": (bar, hhtjax.conjugate_gradients(ITERATIONS)),
    "beam, banded": (beam, hhtjax.banded(3)),
}


def end_of(make, n, solve, steps=STEPS):
    """The function k -> q at the end."""
    system, q0, v0, dt = make(n)
    stepper = hhtjax.hht(-0.05, linearize="predictor", solve=solve)

    def end(k):
        return hhtjax.simulate(
            system, stepper, q0, v0, {"k": k}, dt=dt, num_steps=steps, save_every=steps, t0=dt * 0
        ).q[-1]

    return end


def measure(name, n, repeats):
    """Times per step and temporary memory, forward and with the gradient."""
    make, solve = CASES[name]
    end = end_of(make, n, solve)

    def loss(k):
        return jnp.mean(end(k) ** 2)

    programs = {"forward": jax.jit(loss), "gradient": jax.jit(jax.value_and_grad(loss))}
    programs = {form: program.lower(1.0).compile() for form, program in programs.items()}
    times = least_seconds({form: lambda f=f: f(1.0) for form, f in programs.items()}, repeats)
    found = {f"{form}_us_per_step": 1e6 * x / STEPS for form, x in times.items()}
    found |= {f"{form}_bytes": temporary_bytes(program) for form, program in programs.items()}
    value, slope = programs["gradient"](1.0)
    assert np.isfinite(slope)
    return {"case": name, "unknowns": n, **found, "loss": float(value)}


def exponents(rows):
    """Least-squares slopes in the logarithms, over the whole range and from the one before the last size."""
    found = {}
    for name in CASES:
        mine = [row for row in rows if row["case"] == name]
        n = np.log([row["unknowns"] for row in mine])
        found[name] = {
            key: float(np.polyfit(n, np.log([row[key] for row in mine]), 1)[0])
            for key in ("forward_us_per_step", "gradient_us_per_step", "forward_bytes", "gradient_bytes")
        }
    return found


def left_by_iterations(n, counts, steps):
    """Largest difference of the bar's end from the banded solve, relative to its largest displacement."""
    exact = end_of(bar, n, hhtjax.banded(1), steps)(1.0)
    rows = []
    for count in counts:
        end = end_of(bar, n, hhtjax.conjugate_gradients(count), steps)(1.0)
        rows.append({"iterations": count, "error": float(jnp.max(abs(end - exact)) / jnp.max(abs(exact)))})
    return rows


def run(report, fast):
    """Times, exponents, and what a fixed number of iterations leaves."""
    rows = []
    for name in list(CASES)[2:3] if fast else CASES:
        for n in FAST_SIZES if fast else SIZES:
            rows.append(measure(name, n, 1 if fast else 3))
            report.progress(f"large: {name}, {n}: {rows[-1]['forward_us_per_step']:.0f} us a step")
    print("Microseconds per step and temporary memory\n")
    report.table(
        ["case", "unknowns", "forward", "gradient", "ratio", "forward kB", "gradient kB"],
        [
            [
                r["case"],
                str(r["unknowns"]),
                r["forward_us_per_step"],
                r["gradient_us_per_step"],
                r["gradient_us_per_step"] / r["forward_us_per_step"],
                r["forward_bytes"] / 1e3,
                r["gradient_bytes"] / 1e3,
            ]
            for r in rows
        ],
    )
    if fast:
        return {"steps": STEPS, "iterations": ITERATIONS, "rows": rows}
    left = {str(n): left_by_iterations(n, (3, 4, 5, 6, 8, 10, 15, 20, 30, 40), 200) for n in (1000, 10_000)}
    slopes = exponents(rows)
    report.figure("sweeps_large", figure(rows, left))
    return {"steps": STEPS, "iterations": ITERATIONS, "rows": rows, "exponents": slopes, "left": left}


def figure(rows, left):
    """Time against size; error against iterations."""
    drawn, (times, errors) = subplots(1, 2, width=175, height=95)
    for i, name in enumerate(CASES):
        mine = [row for row in rows if row["case"] == name]
        n = [row["unknowns"] for row in mine]
        for form, line in (("forward", "-"), ("gradient", "--")):
            y = [row[f"{form}_us_per_step"] for row in mine]
            times.loglog(n, y, line, color=COLOURS[i], marker=MARKERS[i], ms=4, label=f"{name}, {form}")
    times.loglog(n, 0.05 * np.array(n), color="black", lw=1, ls=":", label="slope 1")
    times.set(xlabel="number of unknowns", ylabel="time of a step (µs)")
    drawn.legend(*times.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    for i, (n, found) in enumerate(left.items()):
        x = [row["iterations"] for row in found]
        errors.semilogy(x, [row["error"] for row in found], color=COLOURS[i], marker=MARKERS[i], label=f"n = {n}")
    errors.set(
        xlabel="iterations of conjugate gradients in each step",
        ylabel="relative error of q after 200 steps",
        ylim=(1e-16, 10),
    )
    legend(errors)
    return drawn
