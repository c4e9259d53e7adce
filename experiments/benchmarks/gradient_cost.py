"""Time and memory of reverse mode: the gradient of a long run against the run itself.

Double pendulum with stiff joints, loss over stiffness and damping (4 numbers), 1e3 to 1e5 steps. Temporary
memory is XLA's own count of the compiled program. Times are the best of several calls in one process.
"""

import os
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.report import COLOURS, MARKERS, Report
from hhtjax.plot import legend, subplots
from hhtjax.scenes import double_pendulum

DT = 1e-4


def loss(stiffness_and_damping, num_steps, save_every):
    """Mean square of the saved angles."""
    scene = double_pendulum.stiff()
    k, c = stiffness_and_damping
    solution = hhtjax.simulate(
        scene.system,
        hhtjax.hht(alpha=-0.05, linearize="predictor"),
        scene.q0,
        scene.v0,
        {**scene.params, "k": k, "c": c},
        dt=DT,
        num_steps=num_steps,
        save_every=save_every,
    )
    return jnp.mean(solution.q**2)


def measure(num_steps, save_every, repeats):
    """Times in s and temporary memory in bytes, of the loss and of its value and gradient."""
    x = ((400.0, 300.0), (15.0, 10000.0))
    row = {"steps": num_steps, "saved": "path" if save_every == 1 else "end"}
    for name, function in {"forward": loss, "gradient": jax.value_and_grad(loss)}.items():
        start = time.perf_counter()
        compiled = jax.jit(function, static_argnums=(1, 2)).lower(x, num_steps, save_every).compile()
        row[f"{name}_compile_s"] = time.perf_counter() - start
        memory: Any = compiled.memory_analysis()
        row[f"{name}_temporary_bytes"] = memory.temp_size_in_bytes
        times = []
        for _ in range(repeats):
            start = time.perf_counter()
            jax.block_until_ready(compiled(x))
            times.append(time.perf_counter() - start)
        row[f"{name}_s"] = min(times)
    row["gradient_over_forward"] = row["gradient_s"] / row["forward_s"]
    return row


def run(report: Report, fast: bool):
    """Measures, prints ratios and draws time and memory against the number of steps."""
    rows = []
    for num_steps in (1000, 4000) if fast else (1000, 10_000, 100_000):
        for save_every in (1, num_steps):
            rows.append(measure(num_steps, save_every, 3 if fast else 7))
            report.progress(f"{num_steps} steps, {rows[-1]['saved']} saved: {rows[-1]['gradient_over_forward']:.2f}")
    report.table(
        ["steps", "saved", "forward ns/step", "gradient ns/step", "ratio", "temporaries MB", "compile s"],
        [
            [
                f"{row['steps']}",
                row["saved"],
                1e9 * row["forward_s"] / row["steps"],
                1e9 * row["gradient_s"] / row["steps"],
                row["gradient_over_forward"],
                row["gradient_temporary_bytes"] / 1e6,
                row["gradient_compile_s"],
            ]
            for row in rows
        ],
    )
    growth = {saved: slope([row for row in rows if row["saved"] == saved]) for saved in ("path", "end")}
    print(f"Temporaries grow as steps^{growth['end']:.2f} (end saved) and steps^{growth['path']:.2f} (path saved).")
    plot(report, rows)
    report.numbers(
        {
            "rows": rows,
            "memory_exponent": growth,
            "jax": jax.__version__,
            "device": str(jax.devices()[0]),
            "cores": os.cpu_count(),
        }
    )


def slope(rows):
    """Exponent of the growth of temporary memory."""
    steps, bytes_ = (np.log([row[x] for row in rows]) for x in ("steps", "gradient_temporary_bytes"))
    return float(np.polyfit(steps, bytes_, 1)[0])


def plot(report: Report, rows):
    """Time ratio and temporary memory."""
    figure, (left, right) = subplots(1, 2, width=175, height=80)
    for i, saved in enumerate(("path", "end")):
        mine = [row for row in rows if row["saved"] == saved]
        steps = np.array([row["steps"] for row in mine])
        style = {"color": COLOURS[i], "marker": MARKERS[i], "label": f"{saved} saved"}
        left.semilogx(steps, [row["gradient_over_forward"] for row in mine], **style)
        right.loglog(steps, [row["gradient_temporary_bytes"] / 1e6 for row in mine], **style)
    right.loglog(steps, 1e-3 * np.sqrt(steps), color="black", ls=":", label="slope 1/2")
    left.set_ylim(bottom=0)
    left.set_ylabel("time of value and gradient / time of value")
    right.set_ylabel("temporary memory of the gradient (MB)")
    for axis in (left, right):
        axis.set_xlabel("number of steps")
        legend(axis)
    report.figure("gradient_cost", figure)
