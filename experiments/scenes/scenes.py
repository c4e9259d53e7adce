"""A picture of each scene of `hhtjax.scenes`, for the gallery and the reference."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

import hhtjax
from experiments.report import COLOURS
from hhtjax import scenes
from hhtjax.plot import configuration, subplots

STEPS = 2000  # of a run
FAST = "double_pendulum", "duffing"  # drawn by a smoke run


class Picture(NamedTuple):
    """How a scene is shown: at some times, or, of what moves along a line, at one time above its course.

    scene: a function that makes it. text: what one sees, a sentence. times: s. course: {label: entry of q}, None
    without. labels: {number of a shape, and of a point of it or None for its middle: text}, at the last time.
    """

    scene: Any
    text: str
    times: tuple[float, ...]
    course: dict[str, Any] | None = None
    labels: dict[Any, str] | None = None


MASS = {(0, None): "m", (1, None): "k"}
DRIVEN = {(0, None): "m", (1, 1): "force", (2, None): "k"}
ONE = {"q (m)": 0}
PICTURES = {
    "double_pendulum": Picture(
        scenes.double_pendulum.free,
        "Two links that fall from the horizontal.",
        (0.0, 0.2, 0.4, 0.6),
        labels={(0, 1): "$m_1$", (0, 2): "$m_2$"},
    ),
    "pendulum": Picture(
        scenes.pendulum.walled,
        "A mass on a rod swings against a wall and comes back more slowly.",
        (0.0, 0.05, 0.1, 0.15, 0.3),
        labels={(0, 1): "m"},
    ),
    "duffing": Picture(
        scenes.duffing.driven,
        "A mass on a hardening spring, driven by a harmonic force near its resonance.",
        (0.6,),
        ONE,
        DRIVEN,
    ),
    "top": Picture(
        scenes.top.minimal,
        "A spinning disk on a rod that turns freely about the origin; the rod starts level and falls as it turns.",
        (0.0, 0.1, 0.2),
    ),
    "four_bars": Picture(
        scenes.four_bars.four_bars,
        "A row of two four-bar loops falls to its right; when all bars lie on one line, the loops could fold.",
        (0.0, 0.3, 0.5),
    ),
    "slider_crank": Picture(
        scenes.slider_crank.driven,
        "A moment turns the crank, the rod pushes the slider, and a spring and a damper hold it back.",
        (0.0, 0.15),
        labels={(1, 2): "slider"},
    ),
    "flexible_slider_crank": Picture(
        scenes.flexible_slider_crank.flexible_slider_crank,
        "A crank at constant speed bends the elastic rod of a slider by a few millimetres.",
        (0.0, 0.008, 0.014),
        labels={(1, 6): "elastic rod"},
    ),
    "squeezer": Picture(
        scenes.squeezer.squeezer,
        "Seven bodies in three loops: a moment turns the small crank at the origin, and a spring pulls at one branch.",
        (0.0, 0.015),
        labels={(1, 0): "B", (2, 0): "A", (0, 2): "P", (4, -1): "C"},
    ),
    "arm": Picture(
        scenes.arm.swing,
        "An arm with six joints, each with a spring and a damper, let go from a bent pose.",
        (0.0, 0.15, 0.4),
    ),
    "body_chain": Picture(
        scenes.body_chain.body_chain,
        "Three rods on ball joints, held out in a line and let go while they spin about their own axes.",
        (0.0, 0.3, 0.5),
    ),
    "vehicle": Picture(
        scenes.vehicle.ride,
        "A car body on four wheels rides over a rough road with a bump, which its front wheels have just met.",
        (2.1,),
        {"heave (m)": 0, "front left wheel (m)": 3},
    ),
    "bouc_wen": Picture(
        scenes.bouc_wen.benchmark,
        "A mass on a spring with hysteresis, driven below its resonance.",
        (0.01,),
        ONE,
        DRIVEN,
    ),
    "lugre": Picture(
        scenes.lugre.stick_slip,
        "A spring drags a mass over a surface: it sticks until the spring is strong enough, then slips.",
        (6.0,),
        ONE,
        MASS,
    ),
    "maxwell": Picture(
        scenes.maxwell.vibration,
        "A mass on a rubber mount, a spring beside material that relaxes, driven near its resonance.",
        (0.29,),
        ONE,
        {(0, None): "m", (1, None): "rubber", (2, None): "k", (3, 1): "force"},
    ),
    "motor_joint": Picture(
        scenes.motor_joint.tracking,
        "A geared motor turns a link; its controller follows a sine, which is the dashed line.",
        (0.15, 0.45),
        labels={(2, 1): "wanted"},
    ),
    "dry_oscillator": Picture(
        scenes.dry_oscillator.free,
        "A mass on a spring and a dry surface reverses five times, then sticks.",
        (0.0,),
        ONE,
        MASS,
    ),
    "belt": Picture(
        scenes.belt.two_masses,
        "Two masses on a moving belt, held by springs: they stick to it and slip.",
        (0.0,),
        {"$q_1$ (m)": 0, "$q_2$ (m)": 1},
        {(0, None): "$m_1$", (1, None): "$m_2$"},
    ),
    "balls": Picture(
        scenes.balls.bouncing,
        "A ball falls on a floor and bounces, each time less high.",
        (0.0,),
        {"height (m)": 0},
    ),
    "bump_stop": Picture(
        scenes.bump_stop.bump_stop,
        "A mass on a spring runs into a stop with a spring and a damper of its own.",
        (0.12,),
        ONE,
        {(0, None): "m", (1, None): "k", (4, None): "stop"},
    ),
    "shaken_table": Picture(
        scenes.shaken_table.shaken_table,
        "A body rides on a table that shakes, is thrown off, flies, and lands.",
        (0.3,),
        {"height (m)": 0},
    ),
    "impact_oscillator": Picture(
        scenes.impact_oscillator.driven,
        "A driven mass on a spring runs into a rigid stop where the spring is at rest.",
        (0.5,),
        ONE,
        DRIVEN | {(5, 1): "stop"},
    ),
}


def of(scene, num_steps: int = STEPS):
    """Its run, with the default stepper."""
    more: dict[str, Any] = {"events": scene.events} if isinstance(scene, scenes.EventScene) else {}
    more |= {"z0": scene.z0} if isinstance(scene, scenes.InternalScene) else {}
    start = scene.q0, scene.v0, scene.params
    dt = scene.duration / num_steps
    return hhtjax.simulate(scene.system, hhtjax.hht(), *start, dt=dt, num_steps=num_steps, **more, throw=True)


def label(panel, picture: Picture, q, t: float, scene):
    """Names beside shapes."""
    shapes = scene.drawing(q, t, scene.params)
    for (number, point), text in (picture.labels or {}).items():
        points = shapes[number].points
        ends = (points.max(axis=0) + points.min(axis=0)) / 2
        at, offset = (ends, (0, -3)) if point is None else (points[point], (3, 3))
        if shapes[number].kind == "spring" and point is None:
            at, offset = (ends[0], points[:, 1].max()), (0, 2)
        panel.annotate(text, at, offset, textcoords="offset points", ha="center" if point is None else "left")


def draw(picture: Picture, scene, run):
    """The still picture."""
    times = list(picture.times)
    q = hhtjax.interpolate(run, np.array(times[-1])).q
    spatial = np.shape(scene.drawing(q, times[-1], scene.params)[0].points)[1] == 3
    if picture.course is None:
        panel = configuration(run, scene, times)
        figure = panel.figure
    else:
        figure = subplots(width=85, height=85 if spatial else 75)[0]
        figure.clear()
        above, below = figure.subfigures(2, 1, height_ratios=(3, 2))
        panel = above.add_subplot(**({"projection": "3d"} if spatial else {}))
        configuration(run, scene, times, ax=panel)
        panel.get_legend().remove()
        panel.set_title(f"t = {times[0]:g} s")
        course = below.add_subplot()
        for i, (name, k) in enumerate(picture.course.items()):
            course.plot(run.t, run.q[:, k], color=COLOURS[i], label=name.partition(" (")[0], lw=1)
            course.plot(times[0], q[k], "o", color=COLOURS[i], ms=4)
        several = len(picture.course) > 1
        course.set(xlabel="t (s)", ylabel="q (m)" if several else next(iter(picture.course)))
        if several:
            hhtjax.plot.legend(course)
    if not spatial:
        label(panel, picture, q, times[-1], scene)
    return figure


def run(report, fast):
    """All pictures; those of FAST in a smoke run."""
    chosen = {name: x for name, x in PICTURES.items() if name in FAST or not fast}
    made = [picture.scene() for picture in chosen.values()]
    with ThreadPoolExecutor(2) as pool:  # the next ones compile while one is drawn
        runs = pool.map(lambda scene: of(scene, 500 if fast else STEPS), made)
        for (name, picture), scene, found in zip(chosen.items(), made, runs, strict=True):
            report.figure(f"scenes_{name}", draw(picture, scene, found))
