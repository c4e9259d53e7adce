"""Time of an exported step against C written by hand, and against the kernel that XLA makes, scene by scene."""

import os
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.benchmarks import native
from experiments.benchmarks.measure import least_seconds
from experiments.export.native_model import Run
from hhtjax.scenes import (
    Scene,
    belt,
    bouc_wen,
    double_pendulum,
    dry_oscillator,
    duffing,
    four_bars,
    lugre,
    maxwell,
    motor_joint,
    pendulum,
    slider_crank,
    squeezer,
    top,
)

ALPHA, DT = -0.05, 1e-4
START = 0.3, -0.2  # rad
PREDICTOR, AUTO, NEWTON = (
    hhtjax.hht(ALPHA, linearize="predictor"),
    hhtjax.hht(ALPHA),
    hhtjax.hht(ALPHA, iterations=None),
)


def chain(count):
    """A linear one: masses between springs, a load on all of them (SI units)."""
    K = 1e3 * (2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1))

    def load(t, params):
        return params["load"] * jnp.sin(t) * jnp.ones(count)

    system = hhtjax.LinearSystem(np.ones(count), 1e-3 * K, K, load)
    return Scene(system, {"load": 3.0}, jnp.zeros(count), jnp.ones(count), 1.0)


SCENES = {  # scene, stepper, step size in s
    "double pendulum, predictor": (double_pendulum.stiff, PREDICTOR, 1e-3),
    "double pendulum, auto": (double_pendulum.stiff, AUTO, 1e-3),
    "double pendulum, converged": (double_pendulum.stiff, NEWTON, 1e-3),
    "double pendulum, rk4": (double_pendulum.free, hhtjax.rk4(), 1e-3),
    "double pendulum, rowda": (double_pendulum.stiff, hhtjax.rowda(), 1e-3),
    "Duffing": (duffing.driven, AUTO, 1e-3),
    "Bouc-Wen hysteresis": (bouc_wen.benchmark, AUTO, 1e-4),
    "LuGre friction": (lugre.stick_slip, AUTO, 1e-4),
    "motor": (motor_joint.tracking, AUTO, 1e-4),
    "rubber mount": (maxwell.vibration, AUTO, 1e-4),
    "rod": (pendulum.cartesian, AUTO, 1e-3),
    "slider-crank": (slider_crank.driven, AUTO, 1e-3),
    "four bars": (four_bars.four_bars, AUTO, 1e-3),
    "squeezer": (squeezer.squeezer, AUTO, 1e-5),
    "top": (top.minimal, AUTO, 1e-4),
    "top with constraints": (top.constrained, AUTO, 1e-4),
    "dry friction": (dry_oscillator.driven, AUTO, 1e-3),
    "dry friction of two joints": (belt.two_masses, AUTO, 1e-3),
    "linear chain of 30": (partial(chain, 30), AUTO, 1e-3),
    "linear chain of 100": (partial(chain, 100), AUTO, 1e-3),
}


def in_python(scene, stepper, dt, num_steps):
    """The same run by XLA."""

    def end(q0):
        return hhtjax.simulate(
            scene.system, stepper, q0, scene.v0, scene.params, z0=getattr(scene, "z0", None), dt=dt,
            num_steps=num_steps, save_every=num_steps,
        ).q  # fmt: skip

    return partial(jax.jit(end).lower(scene.q0).compile(), scene.q0)


def by_hand(num_steps, repeats):
    """The double pendulum with plain sines: ns per step of the C written by hand, exported, and of XLA."""
    scene = double_pendulum.free()._replace(q0=np.array(START))
    forms = {
        "by hand": native.Run(native.library(), scene, START, DT, num_steps, ALPHA),
        "exported": Run(scene, PREDICTOR, DT, num_steps),
        "XLA": in_python(scene, PREDICTOR, DT, num_steps),
    }
    return {name: 1e9 * x / num_steps for name, x in least_seconds(forms, repeats).items()}


def run(report, fast):
    """Both comparisons, with the same flags of the compiler."""
    if native.compiler() is None:
        print("No C compiler: no times.", flush=True)
        return {}
    load = os.getloadavg()[0]
    hand = by_hand(2000 if fast else 50_000, 3 if fast else 40)
    ratio = hand["exported"] / hand["by hand"]
    report.table(["double pendulum, plain sines", "ns per step"], list(hand.items()))
    rows = []
    for name, (make, stepper, dt) in list(SCENES.items())[: 1 if fast else None]:
        num_steps = 500 if fast else 5000
        ours = Run(make(), stepper, dt, num_steps)
        python = in_python(make(), stepper, dt, num_steps)
        times = least_seconds({"C": ours, "XLA": python}, 3 if fast else 15)
        ours(path=True)
        expected = float(np.ravel(jax.tree.leaves(python())[0][-1])[0])
        difference = abs(float(ours.path[-1]) - expected) / float(np.max(abs(ours.path)))
        c, xla = (1e9 * times[form] / num_steps for form in ("C", "XLA"))
        rows.append(
            {
                "scene": name, "operations": ours.model.operations, "functions": ours.model.functions,
                "c_ns": c, "xla_ns": xla, "c_time_over_xla": c / xla, "relative_difference": difference,
            }
        )  # fmt: skip
        report.progress(f"{name}: {c:.0f} ns, XLA {xla:.0f} ns")
    header = ["scene", "operations", "sines and the like", "C (ns)", "XLA (ns)", "ratio", "difference"]
    report.table(header, [list(row.values()) for row in rows])
    return {
        "load_at_start": load,
        "by_hand_ns": hand,
        "time_over_by_hand": ratio,
        "scenes": rows,
        "flags": " ".join(("-O3", "-march=native")),
    }
