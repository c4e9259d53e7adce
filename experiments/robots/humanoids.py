"""Humanoids of the package dm_control, where it is installed, in the air: no contact, motors, dry friction, ranges."""

from __future__ import annotations

import importlib
import importlib.util
import os
from importlib.metadata import version
from typing import Any

import jax
import numpy as np

import hhtjax
from experiments.report import Report
from experiments.robots import by_mujoco
from experiments.robots.costs import clocks
from hhtjax import bodies


def run(report: Report, fast: bool) -> dict:
    """Times of steps and of first calls; why not, where they are skipped."""
    spec = importlib.util.find_spec("dm_control")
    if fast or spec is None or importlib.util.find_spec("mujoco") is None:
        why = "in a smoke run they are left out" if fast else "they need the packages dm_control and mujoco"
        report.progress(f"SKIPPED: the humanoids; {why}")
        return {"skipped": why}
    found: dict[str, Any] = {"dm_control": version("dm_control"), "mujoco": version("mujoco"), "models": {}}
    folder = os.path.join(os.path.dirname(spec.origin or ""), "suite")
    for name in ("humanoid", "humanoid_CMU"):
        found["models"][name] = in_the_air(os.path.join(folder, f"{name}.xml"))
        report.progress(f"{name}: {found['models'][name]}")
    return found


def in_the_air(path: str, num_steps: int = 100, dt: float = 2e-3) -> dict:
    """A model of a file, falling: first call, and times of a step beside MuJoCo's in turns."""
    mujoco = importlib.import_module("mujoco")
    made: list = []
    _, made_s = clocks(
        lambda: made.append(bodies.load(path, ignore=("contact", "actuator"), limits="ignore", friction="ignore"))
    )
    robot = made[0]

    def simulated(shift: float = 0.0):
        found = hhtjax.simulate(
            robot.system, hhtjax.hht(), robot.q0, robot.v0, robot.params,
            dt=dt * (1 + shift), num_steps=num_steps, save_every=num_steps,
        )  # fmt: skip
        return jax.block_until_ready(found)

    first_s, first_cpu_s = clocks(simulated)
    model = by_mujoco.with_options(mujoco.MjModel.from_xml_path(path), "implicitfast", dt)
    kinds = mujoco.mjtDisableBit
    for kind in ("CONTACT", "LIMIT", "FRICTIONLOSS", "ACTUATION"):
        model.opt.disableflags |= int(getattr(kinds, f"mjDSBL_{kind}"))
    own, theirs = [], []
    for turn in range(3):
        own.append(clocks(lambda turn=turn: simulated(1e-9 * (1 + turn))))
        theirs.append(by_mujoco.rolled(model, model.qpos0, np.zeros(model.nv), np.zeros(model.nu), 10 * num_steps)[1:])
    solution = simulated()
    clock, processor = (min(x) / num_steps * 1e6 for x in zip(*own, strict=True))
    peer = min(x[0] for x in theirs) / (10 * num_steps) * 1e6
    return {
        "rates": robot.model.tree.rates, "made_cpu_s": made_s, "first_s": first_s, "first_cpu_s": first_cpu_s,
        "us_a_step": clock, "cpu_us_a_step": processor, "mujoco_us_a_step": peer,
        "finite": all(bool(np.isfinite(x).all()) for x in jax.tree.leaves(solution.v)),
    }  # fmt: skip
