"""The same mechanisms in MuJoCo: whole runs in compiled code (`mujoco.rollout`), by each of its integrators."""

from __future__ import annotations

import importlib
import time
from typing import Any

import jax
import numpy as np

from experiments.robots.models import Case

INTEGRATORS = "RK4", "implicitfast", "implicit", "discrete"
STIFFEST = "implicitfast, stiffest loop"  # impedance 0.9999, a time constant of two steps


def integrators() -> list[str]:
    """Those that the MuJoCo at hand has: `discrete` came with 3.13."""
    kinds = importlib.import_module("mujoco").mjtIntegrator
    return [name for name in INTEGRATORS if hasattr(kinds, f"mjINT_{name.upper()}")]


def as_model(text: str, integrator: str, dt: float) -> Any:
    """An MjModel."""
    mujoco = importlib.import_module("mujoco")
    mujoco.set_mju_user_warning(lambda text: None)  # of runs that fail, which are shown as such
    if integrator == STIFFEST:
        hard = f'solimp="0.9999 0.9999 0.001" solref="{2 * dt:.17g} 1"'
        text, integrator = text.replace("<connect ", f"<connect {hard} "), "implicitfast"
    model = mujoco.MjModel.from_xml_string(text)
    return with_options(model, integrator, dt)


def with_options(model: Any, integrator: str, dt: float) -> Any:
    """The model, to be integrated so."""
    kinds = importlib.import_module("mujoco").mjtIntegrator
    model.opt.integrator = getattr(kinds, f"mjINT_{integrator.upper()}")
    model.opt.timestep = dt
    return model


def order(case: Case, model: Any) -> np.ndarray:
    """Which of our coordinates each of its own is: it goes from branch to branch."""
    return np.array([case.robot.index(model.joint(i).name) for i in range(model.njnt)])


def rolled(model: Any, q0: np.ndarray, v0: np.ndarray, control: np.ndarray, steps: int):
    """States (steps, .) after each step, in one call, and its seconds of the clock and of the processor."""
    mujoco, rollout = importlib.import_module("mujoco"), importlib.import_module("mujoco.rollout")
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q0, v0
    whole = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros(mujoco.mj_stateSize(model, whole))
    mujoco.mj_getState(model, data, state, whole)
    held = np.broadcast_to(control, (1, steps, model.nu)) if model.nu else None
    start = time.perf_counter(), time.process_time()
    path, _ = rollout.rollout(model, data, state[None], held, nstep=steps)
    return path[0], time.perf_counter() - start[0], time.process_time() - start[1]


def control(case: Case, steps: int) -> np.ndarray:
    """Its set points in the middle of each step, during which they are held here: constant, or (steps, .)."""
    found = case.robot.params.get("ctrl", np.zeros(0))
    if not case.is_driven:
        return np.asarray(found)
    return np.asarray(jax.vmap(found)((np.arange(steps) + 0.5) * case.duration / steps))


def path(case: Case, integrator: str, samples: int, steps: int):
    """q at the samples, None where it failed, and the seconds of the run; steps: between two samples."""
    model = as_model(case.text, integrator, case.duration / (samples * steps))
    found, seconds, _ = rolled(model, case.q0, case.v0, control(case, samples * steps), samples * steps)
    q = found[steps - 1 :: steps, 1 : 1 + model.nq]
    goes_on = np.all(np.diff(found[:, 0]) > 0)  # a run that diverges is begun anew by MuJoCo, at the time 0
    return (q if goes_on and np.all(np.isfinite(q)) and np.max(np.abs(q)) < 1e6 else None), seconds


def accelerations(case: Case, v0: np.ndarray) -> np.ndarray:
    """At the start."""
    mujoco = importlib.import_module("mujoco")
    model = as_model(case.text, "RK4", 1e-3)
    data = mujoco.MjData(model)
    held = case.robot.params["ctrl"](0.0) if case.is_driven else control(case, 1)
    data.qpos[:], data.qvel[:], data.ctrl[:] = case.q0, v0, held
    mujoco.mj_forward(model, data)
    return np.array(data.qacc_smooth)  # before loops, which are soft
