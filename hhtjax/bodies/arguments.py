"""Checks of the arguments of a mechanism's functions: the shapes of positions, rates and params.

Shapes are known while a program is traced, so the checks cost nothing at run time. Without them an array of a wrong
shape would be broadcast, and the result silently wrong.
"""

from __future__ import annotations

from difflib import get_close_matches

import jax.numpy as jnp
import numpy as np

from hhtjax.bodies.model import Model
from hhtjax.bodies.tree import Tree
from hhtjax.checks import describe
from hhtjax.description import PyTree

SIMILAR = 0.8  # from which on a name is a misspelling of another


def require_position(tree: Tree, q: PyTree):
    """Raises an error for q of another shape."""
    _require("q", q, _shapes(tree, (3, 3)))


def require_rates(tree: Tree, name: str, v: PyTree):
    """Raises an error for v, w or a torque of another shape; name: of the argument."""
    _require(name, v, _shapes(tree, (3,)))


def require_activations(model: Model, z: PyTree):
    """Raises an error for z of another shape."""
    number = len(model.activated)
    if number:
        _require("z", z, (number,))
    elif z is not None:
        raise ValueError(f"z must be None: no motor of the mechanism has an activation; received {np.shape(z)}.")


def require_params(model: Model, params: PyTree):
    """Raises an error for entries of another shape, for entries that would be ignored, and for names that look
    misspelt.

    Other names pass, because the user's own forces may read them.
    """
    if not isinstance(params, dict):
        raise TypeError(f"params must be a dict, as `Mechanism.params`; received {type(params).__name__}.")
    known = entries(model)
    for name, value in params.items():
        if name in known:
            if known[name] is None:
                raise ValueError(f'params["{name}"] is not read: {UNREAD[name]}')
            if not callable(value):
                _require(f'params["{name}"]', value, known[name])
        elif name not in OTHERS:
            near = get_close_matches(str(name), [*known, *OTHERS], 1, SIMILAR)
            if near:
                raise ValueError(
                    f'params["{name}"] is not read; did you mean "{near[0]}"? Parameters of your own need other names.'
                )


OTHERS = "torque", "wrench", "restitution"  # which are looked at where they are read
UNREAD = {
    "position": 'make the mechanism with free=("position",).',
    "ctrl": "the mechanism has no motors.",
    "timeconst": "no motor of the mechanism is a filter.",
    "frictionloss": 'no joint has friction: give a joint `friction` > 0, and the mechanism friction="dry".',
    "stop_stiffness": 'make the mechanism with limits="stop", and joints with a `range`.',
    "stop_damping": 'make the mechanism with limits="stop", and joints with a `range`.',
    "spring_stiffness": "no ball and no free joint has a `stiffness`.",
    **dict.fromkeys(("gear", "gain", "kp", "kv", "offset"), "the mechanism has no motors."),
}


def entries(model: Model) -> dict[str, tuple | None]:
    """The shape of each entry of params; None for an entry that is not read."""
    tree, bodies, motors = model.tree, len(model.bodies), len(model.drives)
    filters = any(drive.activation == "filter" for drive in model.drives)

    def some(number: int | bool, shape: tuple):
        return shape if number else None

    return {
        "mass": (bodies,),
        "com": (bodies, 3),
        "inertia": (bodies, 3, 3),
        "gravity": (3,),
        "damping": (tree.rates,),
        "armature": (tree.rates,),
        "stiffness": (tree.scalars,),
        "springref": (tree.scalars,),
        **{name: some(motors, (motors,)) for name in ("gear", "gain", "kp", "kv", "offset", "ctrl")},
        "timeconst": some(filters, (motors,)),
        "frictionloss": some(len(model.rubbing), (len(model.rubbing),)),
        "position": some(model.offsets is not None, (_positions(model), 3)),
        "spring_stiffness": some(len(model.springs), (len(model.springs),)),
        "stop_stiffness": some(len(model.stops), (len(model.stops),)),
        "stop_damping": some(len(model.stops), (len(model.stops),)),
    }


def _positions(model: Model) -> int:
    if model.offsets is None:
        return 0
    constant, slope = (np.asarray(x) for x in model.offsets[0])
    return slope.size // constant.size // 3


def _shapes(tree: Tree, of_rotation: tuple) -> PyTree:
    if not tree.balls:
        return (tree.scalars,)
    n, f = tree.balls - tree.frees, tree.frees
    shapes: dict = {"ball": (n, *of_rotation)} if n else {}
    if f:
        shapes["free"] = {"R": (f, *of_rotation), "x": (f, 3)}
    if tree.scalars:
        shapes["joint"] = (tree.scalars,)
    return shapes


def _require(name: str, value: PyTree, expected: PyTree):
    """Raises an error for a value that does not have these shapes."""
    if isinstance(expected, dict):
        if not isinstance(value, dict) or set(value) != set(expected):
            words = ", ".join(repr(key) for key in expected)
            received = sorted(value) if isinstance(value, dict) else type(value).__name__
            raise ValueError(f"{name} must be a dict with {words}; received {received}.")
        for key, inside in expected.items():
            _require(f'{name}["{key}"]', value[key], inside)
        return
    require_shape(name, value, expected)


def require_shape(name: str, value: PyTree, expected: tuple):
    """Raises an error unless it is an array of this shape."""
    try:
        shape = jnp.shape(value)
    except TypeError:
        shape = None
    if shape != expected:
        raise ValueError(f"{name} must be an array of shape {expected}; received {describe(value)}.")
