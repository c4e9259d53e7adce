"""The mass of a system at a position and a time: a function of (q, params), or of (q, t, params).

Equations with M(q, t) ask for nothing new of a stepper: w is the acceleration that M(q, t) w = Q(q, v, t) gives at a
time, so a residual at (q1, v1, t1) takes M there, and derivatives in t pass through it. The rate of M is part of the
momentum's, d/dt (M v) = M w + Mdot v, and belongs into Q: there `from_lagrangian` puts it.
"""

from collections.abc import Callable

from hhtjax.checks import positional_names, require_function, takes

TIMES = "t", "time"  # names that an argument for the time may have


def takes_time(function: Callable, before: int) -> bool:
    """Whether a function takes t behind so many arguments, and before params: it tells by the name."""
    names = positional_names(function)
    named = len(names) > before + 1 and names[before].lstrip("_") in TIMES
    return named and takes(function, before + 2)  # a decorator may have filled it in


def require_inertial(caller: str, name: str, function: Callable, before: tuple[str, ...]) -> None:
    """An error for what is no function of these and params, nor one of these, t and params."""
    more = ("t",) if callable(function) and takes_time(function, len(before)) else ()
    require_function(caller, name, function, f"{name}({', '.join((*before, *more, 'params'))})")


def timed(function: Callable, before: int, t) -> tuple:
    """(t,) for a function that takes the time behind so many arguments, () for one that does not."""
    return (t,) if takes_time(function, before) else ()


def mass_at(system, q, t, params):
    """M of a system with pytrees, as its user gave it: a function's value, or the constant array."""
    return system.mass(q, *timed(system.mass, 1, t), params) if callable(system.mass) else system.mass


def product_at(system, q, w, t, params):
    """M w by the system's own `inertia`, a pytree."""
    return system.inertia(q, w, *timed(system.inertia, 2, t), params)
