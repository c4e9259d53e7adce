"""Explicit baseline: the classical Runge-Kutta method."""

from dataclasses import dataclass

from hhtjax.steppers.stepper import Info, State, Stepper
from hhtjax.xla import staged


@dataclass(frozen=True, eq=False)
class RK4(Stepper):
    """Classical Runge-Kutta; made by `rk4`."""

    order: int = 4

    solves_internal = True
    meets_events = True
    keeps_sparse = True

    def begin(self, system, q, v, t, params, dt):
        """w0 = M^-1 Q, the first stage of the first step."""
        return State(t, q, v, system.acceleration(q, v, t, params))

    def bind(self, system, params, dt):
        """Four stages; the first is the acceleration that the step before ended with."""
        acceleration = staged(lambda q, v, t: system.acceleration(q, v, t, params), system.size)

        def step(s):
            def stage(t, dq, dv):
                v = s.v + dv
                return v, acceleration(s.q + system.located(dq), v, t)

            v1, w1 = s.v, s.w
            v2, w2 = stage(s.t + dt / 2, dt / 2 * v1, dt / 2 * w1)
            v3, w3 = stage(s.t + dt / 2, dt / 2 * v2, dt / 2 * w2)
            v4, w4 = stage(s.t + dt, dt * v3, dt * w3)
            q = s.q + system.located(dt / 6 * (v1 + 2 * v2 + 2 * v3 + v4))
            v = s.v + dt / 6 * (w1 + 2 * w2 + 2 * w3 + w4)
            return State(s.t + dt, q, v, acceleration(q, v, s.t + dt)), Info()

        return step


def rk4() -> RK4:
    """The classical Runge-Kutta method, for the first-order form (q, v)' = (v, M^-1 Q).

    Order 4, explicit: four solves with M per step, and unstable once w h > 2.83 for any natural
    frequency w of the system, resolved or not. The method of choice where nothing is stiff.

    >>> import hhtjax
    >>> hhtjax.rk4().order
    4
    """
    return RK4()
