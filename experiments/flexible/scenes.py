"""Scenes with known answers: how close runs come, and what they take.

Answers are published ones, closed forms, other programs', or finer runs where nothing else is there.
"""

from __future__ import annotations

import time
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.flexible import animation, beam, figures, four_bar, models, statics
from experiments.flexible.native_beam import PLAIN, Run, library
from experiments.flexible.scaling import dense
from hhtjax.scenes.flexible_slider_crank import flexible_slider_crank

CRANK_END = {"phi2_rad": -0.331173498825626, "x3_m": 0.169737332842786}  # Mazzia, Magherini (2008), at .1 s
ROPE = beam.Beam(1000, EA=1e5, EI=0.1, rhoA=1.0, gravity=9.81, hub=None)  # 10 m long
STEPPER = hhtjax.hht(linearize="predictor")


def checked(scene: str, quantity: str, found: float, known: float, at_most: float, source: str, **more: Any) -> dict:
    """A row: the difference from what is known, relative where at_most is less than .1 and `relative` says so."""
    relative = more.pop("relative", True)
    difference = abs(found - known) / (abs(known) if relative else 1.0)
    row = {"scene": scene, "quantity": quantity, "found": found, "known": known, "source": source}
    return row | {"difference": difference, "relative": relative, "aim": at_most, "met": difference <= at_most} | more


def march(model: models.Model, dt: float, steps: int, every: int, stepper: Any = STEPPER) -> tuple[Any, float]:
    """A run, and the seconds of a second call of it, with parameters that differ in the ninth digit."""
    seconds = 0.0
    for factor in (1 + 1e-9, 1.0):
        params = jax.tree.map(lambda x, factor=factor: factor * x, model.params)
        begun = time.perf_counter()
        found = hhtjax.simulate(
            model.system, stepper, model.q0, model.v0, params, dt=dt, num_steps=steps, save_every=every
        )
        jax.block_until_ready(found.q)
        seconds = time.perf_counter() - begun
    found.check()
    return found, seconds


def spin_up(fast: bool) -> tuple[list[dict], dict]:
    """The spun beam: its largest lag, and its stretch once it turns evenly."""
    described = beam.Beam(8 if fast else 64)
    dt, seconds = 1e-3, 1.0 if fast else 20.0
    run, took = march(models.beam(described), dt, round(seconds / dt), 50)
    tip, times = np.asarray(run.q["r"][1:, -1]), np.asarray(run.t[1:])
    lag, stretch = beam.in_hub(described, tip, times)
    path = {"t_s": times, "lag_m": lag, "stretch_m": stretch, "seconds": took, "unknowns": described.unknowns}
    if fast:
        return [], path
    steady = float(stretch[times > beam.SECONDS].mean())
    lowest = float(lag.min())
    rows = [
        checked("spin-up", "stretch (m)", steady, beam.STRETCH, 1e-3, "closed form, Simo and Vu-Quoc (1986)"),
        checked("spin-up", "largest lag (m)", lowest, beam.LARGEST_LAG[0], 1e-3, "the C source, 64 elements"),
    ]
    return rows, path


def falling(fast: bool) -> list[dict]:
    """The falling beam after 1 s: the same beam in C with steps of 1e-5 s."""
    found = library(PLAIN, "plain_beam")
    if found is None or fast:
        return []
    rows = []
    for elements in (16, 64):
        described = beam.pendulum(elements)
        run, _ = march(models.beam(described), 1e-4, 10_000, 10_000)
        exact = Run(found, described, 1e-5, 100_000)()[0][-1, :2]
        tip = np.asarray(run.q["r"][-1, -1])
        for name, here, there in zip("xy", tip, exact, strict=True):
            quantity = f"tip {name} after 1 s (m), {elements} elements"
            rows.append(checked("falling beam", quantity, float(here), float(there), 1e-5, "the C source, h = 1e-5 s"))
    return rows


def at_rest(fast: bool) -> tuple[list[dict], dict]:
    """The two cantilevers, by damped runs."""
    thin, shape = statics.elastica(fast)
    if fast:
        return [], {"cantilever": thin, "princeton": [], "shape": shape}
    space = statics.bent_in_space()
    rows = []
    for i, name in enumerate("xy"):
        quantity = f"tip's way along {name} (m), {thin[-1]['elements']} elements"
        found, known = thin[-1]["tip_m"][i], statics.ELASTICA[i]
        rows.append(checked("cantilever", quantity, found, known, 1e-9, "Euler's elastica", relative=False))
    for i, name in enumerate("yz"):
        quantity = f"tip's way along {name} (m), {space[-1]['elements']} elements"
        found, known = space[-1]["tip_m"][i], statics.PRINCETON[i]
        rows.append(checked("Princeton beam", quantity, found, known, 0.01, "ANSYS, Obrezkov et al. (2022)"))
    return rows, {"cantilever": thin, "princeton": space, "shape": shape}


def slider_crank(fast: bool) -> tuple[list[dict], list[dict]]:
    """Simeon's mechanism up to .1 s, in several ways: the error of its end against time."""
    if fast:
        return [], []
    scene = flexible_slider_crank()
    ways: dict[str, tuple[Any, int, range]] = {
        "hht": (hhtjax.hht(linearize="predictor"), 1, range(5)),
        "hht, extrapolate=2": (hhtjax.hht(linearize="predictor"), 2, range(4)),
        "extrapolated(5)": (hhtjax.extrapolated(levels=5), 1, range(3)),
    }
    points = []
    for way, (stepper, extrapolate, powers) in ways.items():
        for power in powers:
            steps = 500 * 4**power
            options = {
                "dt": scene.duration / steps,
                "num_steps": steps,
                "save_every": steps,
                "extrapolate": extrapolate,
            }
            for factor in (1 + 1e-12, 1.0):
                params = scene.params | {"EI": factor * scene.params["EI"]}
                begun = time.perf_counter()
                run = hhtjax.simulate(scene.system, stepper, scene.q0, scene.v0, params, **options)
                q = np.asarray(run.q[-1])
                seconds = time.perf_counter() - begun
            errors = abs(q[1] - CRANK_END["phi2_rad"]), abs(q[2] - CRANK_END["x3_m"])
            points.append({"way": way, "steps": steps, "seconds": seconds, "error": float(max(errors))})
            points[-1] |= {"phi2_rad": float(q[1]), "x3_m": float(q[2])}
    best = min(points, key=lambda row: row["error"])
    rows = []
    for name, words in (("phi2_rad", "angle of the rod (rad)"), ("x3_m", "place of the slider (m)")):
        quantity = f"{words}, {best['way']}, {best['steps']} steps"
        source = "Test Set for IVP Solvers (2008)"
        rows.append(checked("slider-crank", quantity, best[name], CRANK_END[name], 1e-6, source, relative=False))
    return rows, points


def flexible_four_bar(fast: bool) -> tuple[list[dict], dict]:
    """Sparse against dense, coarse against fine, and the energy that the crank gives against that in the links."""
    number, dt = (2, 1e-2) if fast else (8, 1e-3)
    run = four_bar.run(number, dt, *((0.1,) if fast else ()), solve=dense if fast else None)
    r = np.asarray(run.q["r"])
    path = {"number": number, "t_s": np.asarray(run.t), "r_m": r}
    path["deflections_m"] = [four_bar.deflection(r, link, number) for link in range(3)]
    if fast:
        return [], path
    short = four_bar.run(number, dt, 0.2, solve=dense)
    pairs = zip(*map(jax.tree.leaves, (run.q, short.q)), strict=True)
    difference = float(max(np.max(np.abs(a[: len(b)] - b)) for a, b in pairs))
    finer = np.asarray(four_bar.run(number, dt / 2).q["r"])
    meshed = np.asarray(four_bar.run(2 * number, dt / 2).q["r"])
    middle = [four_bar.deflection(x, 1, n) for x, n in ((r, number), (finer, number), (meshed, 2 * number))]
    largest = float(np.max(np.abs(middle[2])))
    rows = [
        checked("four-bar", "sparse less dense up to .2 s (m or rad)", difference, 0.0, 1e-10, "dense", relative=False),
        checked("four-bar", "largest bend of the coupler (m)", float(np.max(np.abs(middle[0]))), largest, 0.05,
                "16 elements a link, h/2"),
    ]  # fmt: skip
    path["by_step_m"] = float(np.max(np.abs(middle[0] - middle[1])))
    path["by_mesh_m"] = float(np.max(np.abs(middle[1] - middle[2])))
    path["largest_m"] = largest
    path["violation_m"] = float(jnp.max(run.info.constraint))
    return rows, path


def rope(fast: bool) -> tuple[list[dict], dict]:
    """A cable of 1000 ANCF elements that swings down from the horizontal until after its end has cracked like a whip.

    Against half as many elements, half the step, and Newton's iteration. At the crack a node turns by .2 rad a step,
    and a solve about the predictor alone throws it away: how far is measured.
    """
    described = ROPE._replace(elements=10) if fast else ROPE
    dt, seconds, early, every = 1e-3, 0.05 if fast else 2.0, 1.0, 0.05
    model, stepper = models.cable(described), hhtjax.hht()
    run, took = march(model, dt, round(seconds / dt), round(every / dt), stepper)
    run.check(reach=2 * described.length)
    path = {"t_s": np.asarray(run.t), "r_m": np.asarray(run.q["r"]), "seconds": took, "unknowns": model.unknowns}
    if fast:
        return [], path

    def apart(words: str, other: models.Model, step: float, t: float, stepper: Any, at_most: float) -> dict:
        again, _ = march(other, step, round(t / step), round(t / step), stepper)
        far = float(np.linalg.norm(path["r_m"][round(t / every), -1] - np.asarray(again.q["r"][-1, -1])))
        quantity = f"tip after {t:g} s: distance (m) from {words}"
        return checked("cable", quantity, far, 0.0, at_most, words, relative=False)

    halved = models.cable(described._replace(elements=500))
    rows = [
        apart("500 elements", halved, dt, early, stepper, 1e-3),
        apart("half the step", model, dt / 2, early, stepper, 1e-3),
        apart("Newton's iteration", model, dt, seconds, hhtjax.hht(iterations=None), 0.05),
    ]
    with warnings.catch_warnings(action="ignore", category=hhtjax.FailedRunWarning):  # it fails, and is to
        alone = hhtjax.simulate(
            model.system, STEPPER, model.q0, model.v0, model.params, dt=dt, num_steps=round(seconds / dt), save_every=50
        )
    path["farthest_m"] = float(np.max(np.abs(alone.q["r"])))
    return rows, path


def struck(fast: bool) -> tuple[list[dict], dict]:
    """A lattice of 71 x 71 nodes, one corner of which starts at 20 m/s: momentum, and how fast the front runs."""
    side, dt, steps = (8, 1e-3, 10) if fast else (71, 1e-3, 400)
    model = models.lattice(side)
    run = hhtjax.simulate(
        model.system, STEPPER, model.q0, model.v0, model.params, dt=dt, num_steps=steps, save_every=steps // 10
    )
    run.check()
    v = np.asarray(run.v["r"])
    path = {"t_s": np.asarray(run.t), "v_m_per_s": v, "q_m": np.asarray(run.q["r"]), "side": side}
    lost = float(np.max(np.abs(v.sum(axis=1) - v[0].sum(axis=0))))
    rows = [checked("lattice", "change of momentum (kg m/s)", lost, 0.0, 1e-9, "is kept", relative=False)]
    if fast:
        return [], path
    # along the edge nothing is faster than long waves inside: c = sqrt(2 k/m) times 1 m
    c, (early, late) = float(np.sqrt(2 * model.params["k"])), (4, 8)
    places = [front(v[i], side) for i in (early, late)]
    speed = (places[1] - places[0]) / (path["t_s"][late] - path["t_s"][early])
    rows.append(checked("lattice", "speed of the front (m/s)", float(speed), c, 0.1, "sqrt(2 k/m) x 1 m, long waves"))
    return rows, path


def front(v: np.ndarray, side: int) -> float:
    """How far along the diagonal something moves, m."""
    along = np.linalg.norm(v.reshape(side, side, 2)[np.arange(side), np.arange(side)], axis=1)
    reached = np.flatnonzero(along > 0.02 * along.max())
    return float(np.sqrt(2) * reached.max())


def run(report: Any, fast: bool) -> dict:
    """All of them, their charts and an animation."""
    rows, drawn = [], {}
    for scene in (spin_up, rope, struck, at_rest, slider_crank, flexible_four_bar):
        found, drawn[scene.__name__] = scene(fast)
        rows += found
        report.progress(scene.__name__)
    rows += falling(fast)
    report.table(
        ["scene", "quantity", "found", "known", "difference", "wanted"],
        [[row["scene"], row["quantity"], row["found"], row["known"], row["difference"], row["aim"]] for row in rows],
    )
    numbers = {"rows": rows, "slider_crank": drawn["slider_crank"]}
    numbers |= {name: drawn["at_rest"][name] for name in ("cantilever", "princeton")}
    numbers["four_bar"] = {name: x for name, x in drawn["flexible_four_bar"].items() if isinstance(x, float)}
    numbers["costs"] = [
        {"scene": name, "unknowns": drawn[name]["unknowns"], "seconds": drawn[name]["seconds"]}
        for name in ("spin_up", "rope")
    ]
    numbers["farthest_by_predictor_m"] = drawn["rope"].get("farthest_m")
    figures.scenes(report, drawn)
    if not fast:
        figures.slider_crank(report, drawn["slider_crank"])
        animation.four_bar(report, drawn["flexible_four_bar"])
    return numbers
