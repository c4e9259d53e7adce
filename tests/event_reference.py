"""Motions with events by SciPy: solved from one event to the next."""

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

TOLERANCES: dict = {"rtol": 2.3e-14, "atol": 1e-14, "max_step": 0.01}


def motion_with_events(rate, guards, outcome, y0, times, mode=()):
    """y' = rate(t, y, mode); where one of guards(t, y, mode) falls through zero, y, mode = outcome(i, t, y, mode).

    Returns:
        y at the times, by DOP853, and the times of all events.
    """
    t, y, end = times[0], np.array(y0, float), times[-1]
    path, found = np.tile(y, (len(times), 1)), []
    events = []
    for i in range(len(guards(t, y, mode))):
        event: Any = lambda t, y, mode, i=i: guards(t, y, mode)[i]  # noqa: E731
        event.terminal, event.direction = True, -1
        events.append(event)
    while t < end:
        leap: Any = solve_ivp(rate, (t, end), y, "DOP853", events=events, dense_output=True, args=(mode,), **TOLERANCES)
        here = (times >= t) & (times <= leap.t[-1])
        path[here] = leap.sol(times[here]).T
        t, y = leap.t[-1], leap.y[:, -1]
        if leap.status == 1:
            found.append(t)
            (i,) = (i for i, x in enumerate(leap.t_events) if len(x))
            y, mode = outcome(i, t, y, mode)
    return path, found
