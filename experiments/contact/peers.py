"""MuJoCo's soft contacts (rocking block, creep on a slope) and exudyn's (a disc that comes to roll), if installed."""

import importlib
import importlib.util
import time
from typing import Any

import numpy as np

from experiments.contact import by_exudyn
from experiments.contact.scenes import GRAVITY, SCENES, disc, run_of

SAMPLES = 40
SIZES = (160, 640, 2560, 10240, 40960, 163840)  # of MuJoCo
SETTINGS = {"default": None, "stiffest": 0.9999}
ANGLE, CREEP = 0.37, 10.0  # rad, s
DISC = (100, 300, 1000, 3000, 10000)


def model_of(body, dt, impedance, gravity, mu):
    """A model with a plane and a body of its own in the plane y = 0. impedance: of the stiffest that it takes."""
    mujoco: Any = importlib.import_module("mujoco")  # of an extra of its own
    hard = "" if impedance is None else f'solref="{2 * dt:.17g} 1" solimp="{impedance} {impedance} 0.001"'
    contact = f'friction="{mu} 0 0" {hard}'
    text = (
        f'<mujoco><option gravity="{gravity[0]:.17g} 0 {gravity[1]:.17g}" timestep="{dt:.17g}" cone="elliptic" '
        f'integrator="implicitfast" tolerance="1e-12"/><worldbody><geom type="plane" size="50 50 1" {contact}/>'
        f"{body.format(contact=contact)}</worldbody></mujoco>"
    )
    return mujoco.MjModel.from_xml_string(text)


BLOCK = (
    '<body pos="0 0 0"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
    '<joint type="hinge" axis="0 -1 0"/><inertial pos="0 0 0" mass="1" diaginertia="1 {inertia:.17g} 1"/>'
    '<geom type="box" size="0.25 0.2 1" {{contact}}/></body>'
)
POINT = (
    '<body pos="0 0 0"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
    '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><geom type="box" size="0.1 0.1 0.1" {contact}/></body>'
)


def rocked(steps, impedance):
    """q at the samples of the rocking block, and the seconds."""
    mujoco: Any = importlib.import_module("mujoco")
    scene = SCENES["rock"]
    body = BLOCK.format(inertia=float(scene.mass[2]))
    model = model_of(body, scene.T / steps, impedance, (0.0, -GRAVITY), scene.params["mu"])
    data = mujoco.MjData(model)
    data.qpos[:] = np.asarray(scene.start(scene.params)[0])
    path, begun = [data.qpos.copy()], time.perf_counter()
    for _ in range(SAMPLES):
        mujoco.mj_step(model, data, nstep=steps // SAMPLES)
        path.append(data.qpos.copy())
    return np.array(path), time.perf_counter() - begun


def crept(impedance, dt=0.002):
    """The mean speed, m/s, of a block that the slope holds, behind a second."""
    mujoco: Any = importlib.import_module("mujoco")
    model = model_of(POINT, dt, impedance, (GRAVITY * np.sin(ANGLE), -GRAVITY * np.cos(ANGLE)), 0.4)
    data, places = mujoco.MjData(model), []
    data.qpos[:] = [0.0, 0.1]
    for seconds in (1.0, CREEP):
        mujoco.mj_step(model, data, nstep=round(seconds / dt))
        places.append(data.qpos[0])
    return (places[1] - places[0]) / CREEP


def in_mujoco(report, exact, sizes):
    """Errors of the block in q, times, and creep, for both settings."""
    found = {"rock": [], "creep_m_s": {}}
    for name, impedance in SETTINGS.items():
        for steps in sizes:
            path, seconds = rocked(steps, impedance)
            error = float(np.max(np.abs(path - exact)))
            found["rock"].append({"setting": name, "steps": steps, "error_q": error, "time_s": seconds})
            report.progress(f"MuJoCo: {found['rock'][-1]}")
        found["creep_m_s"][name] = float(crept(impedance))
    report.progress(f"MuJoCo: creep {found['creep_m_s']}")
    return found


def in_exudyn(sizes):
    """Errors of the speed with which a disc rolls; None where exudyn's solver ends."""
    p, rows = disc().params, []
    for n in sizes:
        try:
            error = abs(by_exudyn.rolled(p["mu"], p["v0"], 0.5, 1.0, n) - 4 / 3)
        except Exception as problem:  # exudyn's own kind of it
            if type(problem).__name__ != "SolverError":
                raise
            error = None
        rows.append({"steps": n, "error_v": error})
    return rows


def run(report, fast):
    """Each that is installed; the smoke run has few steps, and nothing that errors could be told by."""
    most = 20480
    exact = np.zeros((SAMPLES + 1, 3)) if fast else np.asarray(run_of(SCENES["rock"], most, most // SAMPLES).q)
    found = {}
    if importlib.util.find_spec("mujoco"):
        found["mujoco"] = in_mujoco(report, exact, SIZES[:1] if fast else SIZES)
    if importlib.util.find_spec("exudyn"):
        found["exudyn"] = {"disc": in_exudyn(DISC[:1] if fast else DISC)}
        report.progress(f"exudyn: {found['exudyn']}")
    missing = [name for name in ("mujoco", "exudyn") if name not in found]
    if missing:
        report.progress(f"not installed: {', '.join(missing)}")
    return found
