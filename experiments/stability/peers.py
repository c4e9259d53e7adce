"""How other packages fail where `hht` does not: stiff springs in MuJoCo, explicit diffrax, SciPy on index 3.

MuJoCo     a mass on a spring; its steps are implicit in velocity only, so omega h must stay below 2. Where it is not
           installed: such a step in four lines, ours, and labelled so
diffrax    Tsit5 with step-size control on the stiff double pendulum: steps taken by the duration's end
SciPy      has no constraints: the pendulum on a rod as accelerations alone (index 1), whose rod grows or shrinks
"""

import importlib
import importlib.util
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import hhtjax
from experiments import diffrax_run
from experiments.linearization.scenes import unit_mass
from experiments.report import COLOURS, MARKERS
from hhtjax.plot import legend, subplots
from hhtjax.scenes import double_pendulum, pendulum

FREQUENCY = 100.0  # rad/s, of the mass on a spring
OMEGA_H = np.sort(np.append(np.geomspace(0.1, 100.0, 19), (1.9, 1.99, 2.01)))
SPRING_STEPS = 200
DAMPERS = 10.0 ** np.arange(1, 6)  # N m s/rad, of the second joint
MAX_STEPS = 100_000
TURNS = 200.0  # s
XML = """<mujoco><option timestep="{h}" integrator="{integrator}" gravity="0 0 0"/><worldbody><body>
<joint name="x" type="slide" axis="1 0 0" stiffness="{k}"/><geom type="sphere" size="0.1" mass="1" contype="0"/>
</body></worldbody></mujoco>"""


def installed(name):
    """Whether a package is there."""
    return importlib.util.find_spec(name) is not None


def mujoco_amplitude(integrator, omega_h):
    """Largest |q| over the last half of the steps, from q = 1 at rest."""
    mujoco = importlib.import_module("mujoco")
    mujoco.set_mju_user_warning(lambda text: None)  # of what is no news here
    text = XML.format(h=omega_h / FREQUENCY, integrator=integrator, k=FREQUENCY**2)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos[0] = 1.0
    amplitude = 0.0
    for i in range(SPRING_STEPS):
        mujoco.mj_step(model, data)
        if not np.isfinite(data.qpos[0]) or abs(data.qpos[0]) > 1e12 or data.warning.number.any():
            return np.inf
        amplitude = max(amplitude, abs(data.qpos[0]) if i >= SPRING_STEPS // 2 else 0.0)
    return amplitude


def velocity_implicit_amplitude(omega_h):
    """The same with our own step: (M + h C) v1 = M v + h Q(q), q1 = q + h v1; without damping, C = 0."""
    q, v, amplitude = 1.0, 0.0, 0.0
    for i in range(SPRING_STEPS):
        v -= omega_h * q  # in units of omega
        q += omega_h * v
        if abs(q) > 1e12:
            return np.inf
        amplitude = max(amplitude, abs(q) if i >= SPRING_STEPS // 2 else 0.0)
    return amplitude


@jax.jit
def hht_amplitude(omega_h):
    """The same with `hht`."""
    scene = unit_mass(lambda q, v, t, k: -k * q, FREQUENCY**2, [1.0], [0.0], omega_h / FREQUENCY)
    path = hhtjax.simulate(
        scene.system, hhtjax.hht(), scene.q0, scene.v0, scene.params, dt=scene.duration, num_steps=SPRING_STEPS
    )
    return jnp.max(jnp.abs(path.q[SPRING_STEPS // 2 :]))


def springs():
    """Amplitude by omega h, for each method."""
    found = {"hht": [float(hht_amplitude(x)) for x in OMEGA_H]}
    if installed("mujoco"):
        for integrator in ("Euler", "implicit", "implicitfast", "RK4"):
            found[f"MuJoCo {integrator}"] = [mujoco_amplitude(integrator, x) for x in OMEGA_H]
    else:
        found["velocity-implicit, ours"] = [velocity_implicit_amplitude(x) for x in OMEGA_H]
    return found


def largest_stable(amplitudes):
    """The last omega h up to which none exceeds 20 times the start; at 1.99 it beats 10 times as far, yet is stable."""
    bad = np.flatnonzero(~(np.array(amplitudes) < 20.0))
    return float(OMEGA_H[bad[0] - 1]) if len(bad) else None


@partial(jax.jit, static_argnames="stepper")
def hht_angles(params, stepper):
    """The stiff double pendulum after 1 s in 1000 steps."""
    scene = double_pendulum.stiff()
    return hhtjax.simulate(
        scene.system, stepper, scene.q0, scene.v0, params, dt=1e-3, num_steps=1000, save_every=1000
    ).q[-1]


def diffrax_steps(params):
    """Steps that Tsit5 takes for 1 s at a relative tolerance of 1e-6, and its angles; None where MAX_STEPS end it."""
    found = diffrax_run.solve(double_pendulum.stiff(), "Tsit5", params, 1.0, max_steps=MAX_STEPS, throw=False)
    done = bool(found.result == importlib.import_module("diffrax").RESULTS.successful)
    return int(found.stats["num_steps"]) if done else None, np.asarray(found.ys[0][-1])


def dampers():
    """By damping of the second joint: steps of Tsit5, and the difference of `hht` with 1000 steps from `rowda`'s."""
    scene, rows = double_pendulum.stiff(), []
    for c in DAMPERS:
        params = {**scene.params, "c": (scene.params["c"][0], float(c))}
        ours, finer = (hht_angles(params, stepper) for stepper in (hhtjax.hht(), hhtjax.rowda()))
        row = {"c_N_m_s": float(c), "hht_steps": 1000, "hht_minus_rowda_rad": float(jnp.max(jnp.abs(ours - finer)))}
        if installed("diffrax"):
            row["tsit5_steps"], q = diffrax_steps(params)
            row["tsit5_minus_rowda_rad"] = float(np.max(np.abs(q - finer))) if row["tsit5_steps"] else None
        rows.append(row)
    return rows


def rods(duration):
    """By method: times, and the relative error of the rod's length."""
    system, params, q0, v0, _ = pendulum.cartesian()
    rhs = hhtjax.interop.scipy_rhs(system, q0, v0, params)
    times = np.linspace(0.0, duration, 101)
    found = {}
    for solver in ("RK45", "LSODA", "Radau"):
        run = solve_ivp(rhs.fun, times[[0, -1]], rhs.y0, solver, times, rtol=1e-6)
        found[f"SciPy {solver}, rtol 1e-6"] = np.abs(np.linalg.norm(run.y[:2], axis=0) / params["l"] - 1)[1:].tolist()
    num_steps = 100 * round(duration / 0.5)
    path = hhtjax.simulate(
        system, hhtjax.hht(), q0, v0, params, dt=duration / num_steps, num_steps=num_steps, save_every=num_steps // 100
    )
    found[f"hht, h = {1e3 * duration / num_steps:g} ms"] = np.abs(np.linalg.norm(path.q, axis=1) / params["l"] - 1)[
        1:
    ].tolist()
    return {"times_s": times[1:].tolist(), "errors": found}


def run(report, fast):
    """All three."""
    missing = [name for name in ("mujoco", "diffrax") if not installed(name)]
    if missing:
        print(f"Not installed: {', '.join(missing)}.", flush=True)
    amplitudes = springs()
    damped = [] if fast else dampers()
    lengths = rods(5.0 if fast else TURNS)
    stable = {name: largest_stable(x) for name, x in amplitudes.items()}
    print(f"Largest omega h that {SPRING_STEPS} steps survive, of {OMEGA_H[-1]:g}\n")
    report.table(["method", "omega h"], [[name, "all" if x is None else x] for name, x in stable.items()])
    if not fast:
        report.table(list(damped[0]), [["-" if x is None else x for x in row.values()] for row in damped])
        report.figure("stability_peers", figure(amplitudes, damped, lengths))
    last = {name: x[-1] for name, x in lengths["errors"].items()}
    return {
        "not_installed": missing,
        "omega_h": OMEGA_H.tolist(),
        "amplitude": amplitudes,
        "largest_stable_omega_h": stable,
        "dampers": damped,
        "rod": {"duration_s": lengths["times_s"][-1], "error_at_end": last},
    }


def figure(amplitudes, damped, lengths):
    """Three panels."""
    drawn, (springs_axes, dampers_axes, rods_axes) = subplots(1, 3, width=175, height=95)
    styles = [{"color": c, "marker": m, "ms": 4, "lw": 1} for c, m in zip(COLOURS, MARKERS, strict=True)]
    for style, (name, x) in zip(styles, amplitudes.items(), strict=False):
        springs_axes.loglog(OMEGA_H, np.clip(x, 1e-3, 1e6), **style, label=name)
    springs_axes.axvline(2.0, color="#999999", lw=0.8, ls=":")
    springs_axes.set(xlabel="$\\omega h$", ylabel="largest |q|/q(0), steps 101 to 200")
    c = [row["c_N_m_s"] for row in damped]
    dampers_axes.loglog(c, [row["hht_steps"] for row in damped], **styles[0], label="hht")
    if "tsit5_steps" in damped[0]:
        steps = [row["tsit5_steps"] or MAX_STEPS for row in damped]
        dampers_axes.loglog(c, steps, **styles[1], label="diffrax Tsit5, rtol 1e-6")
        dampers_axes.axhline(MAX_STEPS, color="#999999", lw=0.8, ls=":")
    dampers_axes.set(xlabel="damping, joint 2 (N m s/rad)", ylabel="steps for 1 s")
    for i, (name, x) in enumerate(lengths["errors"].items()):
        style = styles[(i + 1) % len(lengths["errors"])]
        rods_axes.loglog(lengths["times_s"], np.maximum(x, 1e-16), **style | {"marker": None}, label=name)
    rods_axes.set(xlabel="time (s)", ylabel="relative error of the rod's length")
    for axes in (springs_axes, dampers_axes, rods_axes):
        legend(axes)
    return drawn
