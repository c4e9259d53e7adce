"""A million steps without damping or forcing: energy, momentum, constraints, orthogonality, for every method.

    dumbbell    two masses on a stiff spring, free in the plane: energy, momentum, angular momentum
    free body   three moments of inertia, no torque: energy, angular momentum in space, R' R
    pendulum    a point on a rod, constrained: energy, length

Errors are relative to the value at the start (of momentum and angular momentum: to its length), at the ends of windows.
"""

import numpy as np
from jax import numpy as jnp

import hhtjax
from experiments.linearization.scenes import unit_mass
from experiments.report import COLOURS, MARKERS
from experiments.stability.gallery import METHODS
from experiments.stability.grades import plain
from hhtjax.plot import legend, subplots
from hhtjax.rotation import cross
from hhtjax.scenes import Scene, pendulum

WINDOWS = 40
NUM_STEPS, FAST_STEPS = 1_000_000, 4_000
ALPHA = -0.05


def dumbbell() -> Scene:
    """Two masses of 1 kg on a spring of 1000 N/m and 1 m: it rings at 45 rad/s, turns at 1 and moves at 0.5 m/s."""

    def force(q, v, t, params):
        arm = q[2:] - q[:2]
        length = jnp.sqrt(jnp.sum(arm**2))
        pull = params["k"] * (length - 1.0) * arm / length
        return jnp.concatenate([pull, -pull])

    return unit_mass(force, {"k": 1e3}, [0.0, 0.0, 1.02, 0.0], [0.5, -0.5, 0.5, 0.5], 5e-3)


def free_body() -> Scene:
    """diag(1, 2, 3) kg m^2, turning at 2 rad/s about the middle axis, which is unstable: it tumbles."""

    def moment(q, v, t, params):
        return -cross(v, params * v)

    system = hhtjax.System(lambda q, params: params, moment)
    return Scene(system, jnp.array([1.0, 2.0, 3.0]), jnp.eye(3), jnp.array([0.05, 2.0, 0.0]), 1e-2)


def dumbbell_values(q, v, params):
    """Energy, momentum, angular momentum."""
    stretch = np.linalg.norm(q[:, 2:] - q[:, :2], axis=1) - 1.0
    energy = (v**2).sum(axis=1) / 2 + params["k"] * stretch**2 / 2
    spin = sum(q[:, i] * v[:, i + 1] - q[:, i + 1] * v[:, i] for i in (0, 2))
    return {"energy": energy, "momentum": v[:, :2] + v[:, 2:], "angular momentum": spin}


def body_values(R, Om, J):
    """Energy, angular momentum in space, and by how much R' R is not 1."""
    spin = np.einsum("nij,nj->ni", R, J * Om)
    off = np.abs(np.einsum("nij,nik->njk", R, R) - np.eye(3)).max(axis=(1, 2))
    return {"energy": (J * Om**2).sum(axis=1) / 2, "angular momentum": spin, "orthogonality": 1 + off}


def pendulum_values(q, v, params):
    """Energy above the lowest point, and length."""
    height = q[:, 1] + params["l"]
    energy = params["m"] * ((v**2).sum(axis=1) / 2 + params["g"] * height)
    return {"energy": energy, "length": np.linalg.norm(q, axis=1)}


def errors(values):
    """Of each quantity at the end of each window, relative to its size at the start."""
    return {
        name: np.abs(x - x[0]).reshape(len(x), -1).max(axis=1)[1:] / np.linalg.norm(x[0]) for name, x in values.items()
    }


ROTATING = {
    "HHT auto, chart": hhtjax.hht(ALPHA),
    "HHT converged, chart": hhtjax.hht(ALPHA, iterations=None),
    "trapezoidal, chart": hhtjax.newmark(),
    "HHT auto, Lie": hhtjax.hht(ALPHA, kinematics="lie"),
}
CONSTRAINED = {
    "GGL one solve": hhtjax.hht(ALPHA),
    "GGL Newton": hhtjax.hht(ALPHA, iterations=None),
    "index 3 one solve": hhtjax.hht(ALPHA, formulation="index3"),
    "trapezoidal GGL": hhtjax.newmark(),
}


def plane_methods():
    """Those of the gallery with alpha = -0.05, and the trapezoidal rule."""
    methods = {plain(name): method.make(ALPHA) for name, method in METHODS.items()}
    return {"trapezoidal": hhtjax.newmark(iterations=None), **methods}


def studies():
    """By name: scene, its duration the step; quantities; methods."""
    rod = pendulum.cartesian()._replace(duration=5e-3)
    return {
        "dumbbell": (dumbbell(), dumbbell_values, plane_methods()),
        "free body": (free_body(), body_values, ROTATING),
        "pendulum": (rod, pendulum_values, CONSTRAINED),
    }


def run(report, fast):
    """All of them."""
    num_steps = FAST_STEPS if fast else NUM_STEPS
    entries = []
    for name, (scene, values, methods) in list(studies().items())[: 1 if fast else None]:
        for method in list(methods)[:1] if fast else methods:
            system, params, q0, v0, h = scene
            path = hhtjax.simulate(
                system, methods[method], q0, v0, params, dt=h, num_steps=num_steps, save_every=num_steps // WINDOWS
            )
            found = errors(values(np.asarray(path.q), np.asarray(path.v), params))
            last = {key: float(x[-1]) for key, x in found.items()}
            path = {key: [float(f"{y:.3g}") for y in x] for key, x in found.items()}
            entries.append({"scene": name, "method": method, "h_s": h, "last": last, "path": path})
            report.progress(f"drift: {name}, {method}")
    print(f"Relative errors after {num_steps} steps\n")
    rows = [[f"{e['scene']}, {e['method']}", key, x] for e in entries for key, x in e["last"].items()]
    report.table(["scene, method", "quantity", "error"], rows)
    if not fast:
        report.figure("stability_drift", figure(entries, num_steps))
    kept = [{key: x for key, x in e.items() if key != "path"} for e in entries]
    return {"alpha": ALPHA, "num_steps": num_steps, "entries": kept}


def figure(entries, num_steps):
    """Energy of each scene, and what else each keeps or loses."""
    panels = ("dumbbell", "energy"), ("dumbbell", "angular momentum"), ("free body", "energy"), ("pendulum", "energy")
    drawn, grid = subplots(2, 2, width=175, height=185, sharex=True)
    steps = num_steps / WINDOWS * np.arange(1, WINDOWS + 1)
    for axes, (scene, quantity) in zip(grid.ravel(), panels, strict=True):
        for i, e in enumerate(e for e in entries if e["scene"] == scene):
            marker = {"marker": MARKERS[(i + i // 8) % 8], "ms": 4, "markevery": (i, 9)}
            x = np.maximum(e["path"][quantity], 1e-16)
            axes.loglog(steps, x, color=COLOURS[i % 8], lw=1, ls=("-", "--")[i // 8], label=e["method"], **marker)
        title = f"{scene}, h = {1e3 * next(e['h_s'] for e in entries if e['scene'] == scene):g} ms"
        axes.set_ylabel(f"relative error of {quantity}")
        if scene == "dumbbell":
            axes.set_title(title)
        else:
            legend(axes, title=title, alignment="left")
    drawn.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4, title="dumbbell")
    for axes in grid[1]:
        axes.set_xlabel("number of steps")
    return drawn
