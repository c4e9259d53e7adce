"""A ball that comes to rest: right until the step that is flagged, with any step and any room for events."""

import numpy as np

import hhtjax
from experiments.report import COLOURS
from hhtjax.plot import legend, subplots
from hhtjax.scenes import balls

RESTITUTION = 0.5
STEPS = (100, 1000)  # in the time to rest
ROOM = (1, 2, 4)  # max_events


def impacts(scene, number):
    """Times of the first impacts, and that of rest, by the formula."""
    e, whole = RESTITUTION, np.sqrt(8 * float(scene.q0[0]) / balls.GRAVITY)
    return whole * (0.5 + np.cumsum(np.append(0.0, e ** np.arange(1, number)))), whole * (0.5 + e / (1 - e))


def height(scene, t):
    """q by the formula."""
    times, _ = impacts(scene, 60)
    k = np.searchsorted(times, t, side="right")
    speed = np.sqrt(2 * balls.GRAVITY * float(scene.q0[0])) * RESTITUTION**k
    since = t - times[np.maximum(k - 1, 0)]
    return (
        np.where(k > 0, speed * since, float(scene.q0[0]) + 0 * t) - balls.GRAVITY * np.where(k > 0, since, t) ** 2 / 2
    )


def run(report, fast):
    """How long, how many impacts, how exact."""
    scene, rows = balls.bouncing(RESTITUTION, drag=0.0), []
    rest = impacts(scene, 1)[1]
    drawn, (left, right) = subplots(1, 2, width=170, height=70)
    for i, steps in enumerate(STEPS[:1] if fast else STEPS):
        for room in ROOM[1:2] if fast else ROOM:
            found = hhtjax.simulate(
                scene.system, hhtjax.hht(), scene.q0, scene.v0, scene.params, dt=rest / steps, num_steps=steps + 2,
                events=scene.events, max_events=room,
            )  # fmt: skip
            t, q, count = np.asarray(found.t), np.asarray(found.q[:, 0]), int(found.events.count)
            finite, error = np.isfinite(q), np.abs(q - height(scene, t))
            times = np.asarray(found.events.t[:count])
            rows.append(
                {
                    "steps_to_rest": steps, "max_events": room, "impacts": count,
                    "finite_until_over_rest": float(t[finite][-1] / rest),
                    "flagged_step": int(found.failure.step), "first_nan": int(np.argmin(finite)),
                    "lowest_q_m": float(np.min(q[finite])), "error_m": float(np.max(error[finite])),
                    "impact_time_error_s": float(np.max(np.abs(times - impacts(scene, count)[0]))),
                }
            )  # fmt: skip
            report.progress(str(rows[-1]))
            if room == 2:
                style = {"color": COLOURS[i], "label": f"{steps} steps"}
                left.plot(t, q, lw=1, marker="." if steps == 100 else None, ms=3, **style)
                right.semilogy(t, np.maximum(error, 1e-17), lw=1, **style)
    for axes, label in ((left, "height (m)"), (right, "error of the height (m)")):
        axes.axvline(rest, color="black", lw=0.8, ls=":")
        axes.set(xlabel="time (s)", ylabel=label)
    left.text(rest, 0.9, "rest ", ha="right")
    legend(left)
    report.figure("events_zeno", drawn)
    return {"restitution": RESTITUTION, "rest_at_s": float(rest), "rows": rows}
