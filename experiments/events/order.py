"""Error against the step in five scenes with events, beside the same with events that are not located.

One program for all steps of a scene and method: so many steps as the finest run has, of which the coarser ones, whose
steps are longer, are looked at up to the end of the scene.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.events.reference import SCENES, reference
from experiments.report import COLOURS, MARKERS
from hhtjax.plot import subplots
from hhtjax.scenes import bump_stop

METHODS = {"hht": hhtjax.hht(), "rowda": hhtjax.rowda()}
COARSEST = {
    "ball": 50, "double pendulum": 100, "pendulum": 50, "bump stop": 100, "bump stop without damper": 100,
}  # fmt: skip
NOT_LOCATED = "ball", "bump stop"
DOUBLINGS = 6
QUANTITIES = {"q": "q (m, rad)", "v": "v (m/s, rad/s)", "multipliers": "the multiplier (N/m)"}
LINES = {"hht": "-", "rowda": "--"}


def by_position(q, v, t, params):
    """The bump stop with its mode decided by q: no event."""
    return bump_stop.with_upper(q, v, t, params | {"upper": jnp.where(q > params["gap"], 1.0, 0.0)})


def bounced_after(scene, stepper, dt, num_steps):
    """q and v of the ball, turned back at the end of the step in which it got below the floor."""

    def step(state, _):
        state, _ = stepper.step(scene.system, state, scene.params, dt)
        turned = stepper.init(scene.system, state.q, -scene.params["e"] * state.v, scene.params, dt)
        hit = (state.q[0] < 0) & (state.v[0] < 0)
        state = jax.tree.map(lambda x, y: jnp.where(hit, x, y), turned._replace(t=state.t), state)
        return state, (state.q, state.v)

    start = stepper.init(scene.system, scene.q0, scene.v0, scene.params, dt)
    return jax.lax.scan(step, start, length=num_steps)[1]


@cache
def located(name, method, num_steps):
    """A function of dt: t, q, v, multipliers and the number of events in the scene's time."""
    scene = SCENES[name]
    params = scene.params | ({"C": 0.0} if "without" in name else {})

    def run(dt):
        found = hhtjax.simulate(
            scene.system, METHODS[method], scene.q0, scene.v0, params, dt=dt, num_steps=num_steps, events=scene.events
        )
        paths = {"q": found.q, "v": found.v}
        if found.multipliers is not None:
            paths["multipliers"] = found.multipliers
        return paths, jnp.sum(found.events.t <= scene.duration)

    return jax.jit(run)


@cache
def not_located(name, method, num_steps):
    """The same with the mode by position, or with the ball turned back at the end of a step."""
    scene, stepper = SCENES[name], METHODS[method]
    system = hhtjax.System(bump_stop.mass, by_position)

    def run(dt):
        if name == "ball":
            q, v = bounced_after(scene, stepper, dt, num_steps)
            q, v = (jnp.concatenate([x[None], y]) for x, y in ((scene.q0, q), (scene.v0, v)))
        else:
            found = hhtjax.simulate(system, stepper, scene.q0, scene.v0, scene.params, dt=dt, num_steps=num_steps)
            q, v = found.q, found.v
        return {"q": q, "v": v}, 0

    return jax.jit(run)


def exact(name, times):
    """Paths by quantity, and the times of events."""
    changed = {"C": 0.0} if "without" in name else {}
    q, v, found = reference(name, times, **changed)
    paths = {"q": q, "v": v}
    if name == "pendulum":
        p = SCENES[name].params
        paths["multipliers"] = (p["m"] * (p["g"] * q[:, 1:] - np.sum(v**2, axis=1, keepdims=True))) / p["l"] ** 2
    return paths, found


def errors(paths, wanted, times, events):
    """The largest by quantity, at times farther than a step from all events, where v jumps."""
    away = np.min(np.abs(times[:, None] - np.array(events)), axis=1) > times[1]
    return {key: float(np.max(np.abs(np.asarray(paths[key])[: len(times)] - x)[away])) for key, x in wanted.items()}


def measure(name, method, way, sizes, paths, events):
    """A row: errors by quantity for each of the numbers of steps, and their slopes."""
    march = (located if way == "located" else not_located)(name, method, sizes[-1])
    h, counts, each = [SCENES[name].duration / size for size in sizes], [], []
    times = np.linspace(0, SCENES[name].duration, sizes[-1] + 1)
    for size, dt in zip(sizes, h, strict=True):
        every = sizes[-1] // size
        found, count = march(dt)
        counts.append(int(count))
        each.append(errors(found, {key: x[::every] for key, x in paths.items()}, times[::every], events))
    by_quantity = {key: [error[key] for error in each] for key in each[0]}
    return {
        "scene": name, "method": method, "way": way, "h_s": h, "errors": by_quantity, "events": len(events),
        "right_number_of_events": way != "located" or counts == [len(events)] * len(sizes),
        "slopes": {key: slope(h, x) for key, x in by_quantity.items()},
    }  # fmt: skip


def run(report, fast):
    """All scenes and methods, and a figure; the smoke run has two scenes."""
    rows = []
    for name, fewest in COARSEST.items():
        if fast and name not in NOT_LOCATED:
            continue
        sizes = [fewest * 2**i for i in range(3 if fast else DOUBLINGS)]
        paths, events = exact(name, np.linspace(0, SCENES[name].duration, sizes[-1] + 1))
        for way in ("located", "not located") if name in NOT_LOCATED else ("located",):
            both = not (fast and way == "not located") and name != "pendulum"  # rowda takes no constraints
            for method in METHODS if both else list(METHODS)[:1]:
                rows.append(measure(name, method, way, sizes, paths, events))
                report.progress(f"{name}, {method}, {way}: {rows[-1]['slopes']}")
    figure(report, rows)
    return rows


def slope(h, error):
    """Of the line through the logarithms."""
    return float(np.polyfit(np.log(h), np.log(error), 1)[0])


def figure(report, rows):
    """A panel for each quantity, and one for what is not located."""
    drawn, axes = subplots(2, 2, width=180, height=150)
    names = list(COARSEST)

    def draw(panel, row, key, label, **more):
        i = names.index(row["scene"])
        style = {"color": COLOURS[i], "marker": MARKERS[i], "ms": 3.5, "lw": 1, "ls": LINES[row["method"]]}
        panel.loglog(row["h_s"], row["errors"][key], label=label, **(style | more))

    for panel, (key, unit) in zip(axes.flat, QUANTITIES.items(), strict=False):
        for row in rows:
            if key in row["errors"] and row["way"] == "located":
                draw(panel, row, key, row["scene"] if row["method"] == "hht" else None)
        panel.set_ylabel(f"error of {unit}")
    for row in rows:
        if row["scene"] in NOT_LOCATED:
            found = row["way"] == "located"
            draw(axes[1, 1], row, "q", None, **({} if found else {"mfc": "white", "alpha": 0.7}))
    axes[1, 1].set_ylabel("error of q (m), hollow: not located")
    for panel in axes.flat:
        panel.set_xlabel("step (s)")
    lines = [axes[0, 0].plot([], [], color="black", ls=line, lw=1, label=method)[0] for method, line in LINES.items()]
    handles = [line for line in axes[0, 0].lines if line not in lines and line.get_label()[0] != "_"]
    drawn.legend(handles=[*handles, *lines], loc="outside lower center", ncols=4)
    report.figure("events_order", drawn)
