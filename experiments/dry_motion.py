"""The exact motion of a mass with set-valued dry friction, solved from one switch to the next."""

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

TOLERANCES: dict = {"rtol": 1e-12, "atol": 1e-13, "max_step": 0.02}
PAST = 1e-7  # s: so far past the start of a slip it goes on, so that this switch is not found again


def dry_motion(load, limit, start, times, mass=1.0, belt=0.0):
    """m w = load(t, y) - F(s) sign(s) with y = (q, v) and s = v - belt; where s = 0, any force up to F(0).

    Args:
        load: of t and y; limit: F, of s, smooth; start: y at times[0].
        times: where q is wanted; belt: the constant velocity of what it rubs on.

    Returns:
        q at the times, and the times of all switches, by DOP853.
    """
    q, t, y, found = np.zeros(len(times)), times[0], np.array(start, float), []
    pull, end = load(t, y), times[-1]
    sig = float(np.sign(y[1] - belt)) or float(np.sign(pull) * (abs(pull) > limit(0.0)))

    def rate(t, y, sig):
        return [y[1], (load(t, y) - sig * limit(y[1] - belt)) / mass if sig else 0.0]

    def event(t, y, sig):
        return sig * (y[1] - belt) if sig else limit(0.0) - abs(load(t, y))

    event.terminal, event.direction = True, -1
    while t < end:
        leap: Any = solve_ivp(rate, (t, end), y, "DOP853", events=event, dense_output=True, args=(sig,), **TOLERANCES)
        here = (times >= t) & (times <= leap.t[-1])
        if here.any():
            q[here] = leap.sol(times[here])[0]
        t, y = leap.t[-1], leap.y[:, -1]
        if t < end:
            found.append(t)
            y = np.array([y[0], belt]) if sig else y
            pull = load(t, y)
            sig = 0.0 if sig and abs(pull) <= limit(0.0) else float(np.sign(pull))
            if sig:
                w = (pull - sig * limit(0.0)) / mass
                jerk = (load(t + PAST, y + PAST * np.array([belt, 0.0])) - pull) / PAST / mass
                y = np.array([y[0] + PAST * belt, y[1] + PAST * w + PAST**2 * jerk / 2])
                t += PAST
    return q, found
