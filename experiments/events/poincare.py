"""The impact oscillator: its bifurcations over the frequency of the drive, and the first period doubling, by theory.

The Poincare map takes q and v over a period of the drive. Newton's method finds its fixed point, by the map's Jacobian
through the impact; the first doubling is at the frequency at which this has the eigenvalue -1.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm
from scipy.optimize import root_scalar

import hhtjax
from experiments.events.impact_orbit import doubling, orbits
from experiments.report import COLOURS, MARKERS
from hhtjax.plot import legend, subplots
from hhtjax.scenes import impact_oscillator

SCENE = impact_oscillator.driven()
METHODS = {"hht": hhtjax.hht(), "rowda": hhtjax.rowda()}
BETWEEN = 2.4, 2.8  # where the first doubling is
STEPS = 25, 50, 100, 200, 400  # of a period
FREQUENCIES, FROM, TO = 600, 2.3, 3.4
KEPT, REPEATS, STEPS_OF_DIAGRAM = 50, 5, 50  # periods that are kept, how many times over, steps of a period


def over_periods(stepper, x, W, dt, num_steps, keep_events):
    """A run from x = (q, v)."""
    return hhtjax.simulate(
        SCENE.system, stepper, x[:1], x[1:], SCENE.params | {"W": W}, dt=dt, num_steps=num_steps, events=SCENE.events,
        max_events=4, keep_events=keep_events,
    )  # fmt: skip


@partial(jax.jit, static_argnames="method")
def mapped(method, x, W, steps):
    """The Poincare map of x by so many steps, and its Jacobian; one program, whose further steps are unused."""

    def step(x):
        run = over_periods(METHODS[method], x, W, 2 * jnp.pi / W / steps, STEPS[-1], 1)
        return jnp.append(run.q[steps], run.v[steps])

    return step(x), jax.jacfwd(step)(x)


def fixed_point(method, x, W, steps):
    """Of the map, by Newton, and the Jacobian there."""
    for _ in range(20):
        image, J = map(np.asarray, mapped(method, x, W, steps))
        change = np.linalg.solve(J - np.eye(2), image - x)
        x = x - change
        if np.max(np.abs(change)) < 1e-13:
            return x, J
    raise RuntimeError(f"{method}: no fixed point at {W} rad/s with {steps} steps of a period.")


def doubled(method, x, steps):
    """The frequency at which the eigenvalue is -1, and the eigenvalues there."""

    def condition(W):
        _, J = fixed_point(method, x, W, steps)
        return 1 + np.trace(J) + np.linalg.det(J)

    W = float(root_scalar(condition, bracket=BETWEEN, xtol=1e-14).root)
    return W, np.linalg.eigvals(fixed_point(method, x, W, steps)[1])


@jax.jit
def long_run(x, W):
    """The end of a run from x, speeds before the impacts in each of its parts, NaN beyond."""
    dt = 2 * jnp.pi / W / STEPS_OF_DIAGRAM

    def periods(x, _):
        run = over_periods(METHODS["hht"], x, W, dt, KEPT * STEPS_OF_DIAGRAM, 8 * KEPT)
        return jnp.append(run.q[-1], run.v[-1]), run.events.before[:, 0]

    return jax.lax.scan(periods, x, length=REPEATS)


def run(report, fast):
    """The doubling by both ways, the diagram, and their figure."""
    p = {key: float(value) for key, value in SCENE.params.items()}
    W = doubling(p, *BETWEEN)
    (orbit,) = orbits(p, W)
    report.progress(f"doubling by the closed form: {W:.12f}")
    rows, x = [], start_of(orbit, p, W)
    for method in list(METHODS)[:1] if fast else METHODS:
        sizes = STEPS[:2] if fast else STEPS
        found = [doubled(method, x, steps) for steps in sizes]
        error = [abs(w - W) for w, _ in found]
        slope = -np.polyfit(np.log(sizes), np.log(error), 1)[0]
        eigenvalues = sorted(found[-1][1].real.tolist())
        rows.append(
            {"method": method, "steps_per_period": list(sizes), "frequency_error": error, "slope": float(slope)}
        )
        rows[-1]["eigenvalues"] = eigenvalues
        report.progress(f"{method}: {rows[-1]}")
    diagram = bifurcations(report, 12 if fast else FREQUENCIES)
    figure(report, p, W, rows, diagram)
    eigenvalues = sorted(orbit.eigenvalues.real.tolist())
    return {
        "closed_form": {
            "doubling_rad_s": W,
            "speed_m_s": orbit.speed,
            "phase": orbit.phase,
            "eigenvalues": eigenvalues,
        },
        "rows": rows,
        "diagram": {key: diagram[key] for key in ("frequencies", "failed")},
        "speed_error_m_s": speed_error(p, W, diagram),
    }


def start_of(orbit, p, W):
    """q and v where the drive is at its maximum, by the closed form: from the impact on, in free flight."""
    d, left = p["c"] / 2, (2 * np.pi - orbit.phase) / W
    response = p["A"] / complex(p["k"] - W**2, p["c"] * W)
    at = np.array([response.real, -W * response.imag])  # where the drive is at its maximum
    turned = response * np.exp(1j * orbit.phase)
    free = np.array([p["wall"] - turned.real, -p["e"] * orbit.speed + W * turned.imag])
    A = np.array([[0, 1], [-p["k"], -2 * d]])
    return at + expm(A * left) @ free


def bifurcations(report, number):
    """Speeds of impacts for each frequency, started from where the one before ended; of failed runs the last ones."""
    frequencies, points, failed = np.linspace(FROM, TO, number), [], 0
    x = start = jnp.array([-0.3, 0.3])
    for W in frequencies:
        x, speeds = long_run(x, W)
        if not np.all(np.isfinite(x)):
            x, failed = start, failed + 1
        met = [part[np.isfinite(part)] for part in np.asarray(speeds)]
        points.append([part for part in met if len(part)][-1])
    report.progress(f"{number} frequencies, {failed} failed")
    return {"frequencies": number, "failed": failed, "W": frequencies, "speeds": points}


def speed_error(p, W, diagram):
    """The largest difference from the closed form where the period has not doubled yet, a little apart from it."""
    pairs = zip(diagram["W"], diagram["speeds"], strict=True)
    return max(float(np.max(np.abs(x - orbits(p, w)[0].speed))) for w, x in pairs if w < W - 0.05)


def figure(report, p, W, rows, diagram):
    """The diagram with the orbit of the closed form, and the error of the doubling."""
    drawn, (left, right) = subplots(1, 2, width=180, height=90, width_ratios=(2, 1))
    w = np.repeat(diagram["W"], [len(x) for x in diagram["speeds"]])
    left.plot(w, np.concatenate(diagram["speeds"]), ".", ms=0.8, color="black", label="runs", rasterized=True)
    grid = np.linspace(FROM, TO, 200)
    speeds = np.array([orbits(p, x)[0].speed for x in grid])
    left.plot(
        grid[grid < W], speeds[grid < W], color=COLOURS[0], lw=1.5, alpha=0.7, label="one impact a period, closed form"
    )
    left.plot(grid[grid > W], speeds[grid > W], color=COLOURS[0], lw=1, ls="--", label="the same, unstable")
    left.axvline(W, color=COLOURS[1], lw=0.8)
    left.set(xlabel="frequency of the drive (rad/s)", ylabel="speed before an impact (m/s)", ylim=(0, None))
    for i, row in enumerate(rows):
        style = {"color": COLOURS[i], "marker": MARKERS[i], "ms": 4, "lw": 1}
        right.loglog(row["steps_per_period"], row["frequency_error"], label=row["method"], **style)
    right.set(xlabel="steps of a period", ylabel="error of the frequency\nof the first doubling (rad/s)")
    legend(left)
    legend(right)
    report.figure("events_poincare", drawn)
