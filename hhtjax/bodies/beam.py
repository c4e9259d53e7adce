"""Flexible links: a uniform beam as rigid pieces with springs between them, as bodies for `tree`."""

from __future__ import annotations

from typing import Any

import numpy as np

from hhtjax.bodies.description import WORLD, Body, Joint, vector
from hhtjax.checks import require_integer, require_number
from hhtjax.description import Real

DIRECTIONS = ("z", (0.0, 0.0, 1.0)), ("y", (0.0, 1.0, 0.0)), ("x", (1.0, 0.0, 0.0))


def beam(
    name: str,
    *,
    length: Real,
    elements: int,
    EI: Any,
    rhoA: Real,
    GJ: Real | None = None,
    rhoI: Any = 0.0,
    damping: Real = 0.0,
    parent: str = WORLD,
    joints: Any = (),
    position: Any = (0.0, 0.0, 0.0),
    rotation: Any = (1.0, 0.0, 0.0, 0.0),
) -> list[Body]:
    """A flexible link along x: a uniform beam, divided into rigid pieces joined by springs.

    Each element, of length h = length/elements, consists of two rigid halves with springs in the middle. Adjacent
    halves of neighbouring elements form one piece. Springs bend about y and z, and twist about x:

        moment = k (angle + damping d(angle)/dt),    k = EI/h or GJ/h

    Errors fall as 1/elements^2. A tip force F bends the clamped beam by F L^3/(3 EI) (1 - 1/(4 elements^2)).
    Frequencies are too high: the first by 1.5 % with 4 elements and by 0.36 % with 8, the second by 5.2 % and 1.3 %.
    The total rotation may be large; the angle of each spring must be small. Shear and extension are neglected.

    Args:
        name: name of the beam. Its pieces are NAME1, ..., NAME(elements + 1); the frame of each is at its beginning.
            NAME_tip is a frame at the end, to which further bodies can be attached. The joints between them are
            NAME2_z, NAME2_y, NAME2_x, ...
        length: m. elements: their number, 1 or more.
        EI: bending stiffness, N m^2: one number, or (about y, about z), with None for a direction that does not bend.
        rhoA: mass per length, kg/m.
        GJ: torsional stiffness, N m^2; None for a beam that does not twist.
        rhoI: moment of inertia of the cross-section per length, kg m: one number, or (about y, about z). Their sum is
            the moment about x, which must be positive for a beam that twists.
        damping: of the material, s: the ratio of viscous to elastic modulus. A mode of frequency f has the damping
            ratio pi f damping.
        parent, position, rotation: where the beam begins, as in `Body`. joints: of the first piece, as in `Body`.

    Returns:
        elements + 2 bodies, for `tree`. Their params "stiffness" and "damping" hold k and k damping of each spring.

    Raises: TypeError, ValueError: an argument of a wrong kind or value.

    References:
        R. Huston, Multi-body dynamics including the effects of flexibility and compliance, Comput. Struct. 14, 1981,
        443-451; E. Wittbrodt, I. Adamiec-Wojcik, S. Wojciech, Dynamics of Flexible Multibody Systems, 2006, Ch. 3.

    Example: a steel bar (1 m, 20 mm by 5 mm), clamped at one end. Its tip sags by rhoA g L^4/(8 EI). The tip of the
    model sags by 1 - 1/(2 elements^2) times this.

    >>> import hhtjax
    >>> from hhtjax import bodies
    >>> bar = bodies.beam("bar", length=1.0, elements=4, EI=(43.75, None), rhoA=0.785, damping=0.1)
    >>> robot = bodies.tree(bar)
    >>> run = hhtjax.simulate(robot.system, hhtjax.hht(), robot.q0, robot.v0, robot.params, dt=5e-3, num_steps=300)
    >>> sag = -robot.frames(run.q[-1])["bar_tip"].x[2]
    >>> f"{float(sag) * 1e3:.1f} mm, {float(sag) / (0.785 * 9.80665 / (8 * 43.75)):.3f}"
    '21.3 mm, 0.968'
    """
    h, bending, (of_y, of_z) = _checked(name, length, elements, EI, rhoA, GJ, rhoI, damping)
    stiffness = {"z": bending[1], "y": bending[0], "x": GJ}
    springs = [(axis, way, float(k) / h) for axis, way in DIRECTIONS if (k := stiffness[axis]) is not None]
    found: list[Body] = []
    for i in range(elements + 1):
        own = h if 0 < i < elements else h / 2
        m = float(rhoA) * own
        if i:
            joints = [
                Joint("revolute", way, name=f"{name}{i + 1}_{axis}", stiffness=k, damping=float(damping) * k)
                for axis, way, k in springs
            ]
            parent, position, rotation = found[-1].name, (h if i > 1 else h / 2, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
        rod = m * own**2 / 12
        inertia = own * (of_y + of_z), rod + own * of_y, rod + own * of_z
        found.append(Body(f"{name}{i + 1}", parent, joints, m, (own / 2, 0.0, 0.0), inertia, position, rotation))
    return [*found, Body(f"{name}_tip", found[-1].name, position=(h / 2, 0.0, 0.0))]


def _checked(name: str, length: Real, elements: int, EI: Any, rhoA: Real, GJ: Any, rhoI: Any, damping: Real):
    """The length of an element, and the pairs of EI and rhoI; raises errors for wrong values."""
    if not isinstance(name, str) or not name:
        raise TypeError(f"beam: `name` must be a string; received {name!r}.")
    require_integer("beam", "elements", elements)
    for label, value in (("length", length), ("rhoA", rhoA), ("GJ", GJ)):
        if value is not None or label != "GJ":
            require_number("beam", label, value, lambda x: 0 < x < np.inf, "be positive")
    require_number("beam", "damping", damping, lambda x: 0 <= x < np.inf, "be 0 or more")
    bending = _pair("EI", EI)
    if bending == (None, None) and GJ is None:
        raise ValueError(f"beam: give `EI` or `GJ`, so that the beam is flexible; received {EI!r} and {GJ!r}.")
    for value in bending:
        if value is not None:
            require_number("beam", "EI", value, lambda x: 0 < x < np.inf, "be positive")
    sections = vector("beam", "rhoI", _pair("rhoI", rhoI), (2,))
    if min(sections) < 0 or (GJ is not None and sum(sections) == 0):
        raise ValueError(f"beam: `rhoI` must be 0 or more, and positive for a beam that twists; received {rhoI!r}.")
    return float(length) / elements, bending, sections


def _pair(name: str, value: Any) -> tuple:
    """(about y, about z), from one number or two."""
    if not isinstance(value, (tuple, list, np.ndarray)):
        return value, value
    if len(value) != 2:
        raise ValueError(f"beam: `{name}` must be one number, or (about y, about z); received {value!r}.")
    return tuple(value)
