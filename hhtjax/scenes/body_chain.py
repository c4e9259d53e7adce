"""A chain of rods in space on ball joints, the first at the origin. SI units.

q = {"ball": (N, 3, 3)}: the rotation of each rod relative to the previous rod, from material components. v = {"ball":
(N, 3)}: material angular velocities relative to the previous rod. These coordinates are minimal: no constraints.
"""

from __future__ import annotations

import numpy as np

from hhtjax.bodies import Body, Joint, Mechanism, tree
from hhtjax.checks import require_integer, require_number
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import Scene, array

MASS, LENGTH, GYRATION, GRAVITY = 1.0, 0.5, 0.05, 9.81  # kg, m, radius of gyration about the axis in m, m/s^2
TILT = np.pi / 3  # from the vertical


def mechanism(bodies: int) -> Mechanism:
    """The chain of rods. The upper end of each, on its axis 3, hangs on the lower end of the previous one."""
    across = MASS * (LENGTH**2 / 12 + GYRATION**2 / 2)
    rod = {"mass": MASS, "com": (0, 0, -LENGTH / 2), "inertia": (across, across, MASS * GYRATION**2)}
    first = Body("rod1", "world", Joint("ball"), **rod)
    others = [
        Body(f"rod{i}", f"rod{i - 1}", Joint("ball"), position=(0, 0, -LENGTH), **rod) for i in range(2, bodies + 1)
    ]
    return tree([first, *others], gravity=(0.0, 0.0, -GRAVITY))


def body_chain(bodies=3, spin=5.0) -> Scene:
    """Rods of 1 kg and 0.5 m, which start in a line at 60 degrees from the vertical, and spin about this line.

    Args:
        bodies: N, number of rods. spin: angular velocity about the line, in rad/s.

    Raises:
        TypeError, ValueError: bodies is not a positive integer, or spin is not a finite number.

    >>> (mechanism(2).frames(body_chain(bodies=2).q0)["rod2"].x.round(3) + 0.0).tolist()
    [0.433, 0.0, -0.25]
    """
    require_number("body_chain", "spin", spin, np.isfinite, "be finite")
    chain = mechanism(require_integer("body_chain", "bodies", bodies))
    c, s = np.cos(TILT), np.sin(TILT)
    R = np.tile(np.eye(3), (bodies, 1, 1))
    R[0] = [[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]
    spins = np.zeros((bodies, 3))
    spins[0, 2] = spin  # relative spins: the other rods turn with the first
    start = {"ball": array(R)}, {"ball": array(spins)}
    return Scene(chain.system, chain.params, *start, 2.0, drawings.of_mechanism(chain))
