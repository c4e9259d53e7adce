"""Mechanisms for tests: small ones of all kinds of joints, and a random tree of them."""

import numpy as np

from hhtjax.bodies import Body, Connect, Joint, Motor, tree


def random_inertia(rng):
    """Of a body with an extent in all directions."""
    A = rng.normal(size=(3, 3))
    Sigma = A @ A.T + 0.3 * np.eye(3)
    return 0.1 * (np.trace(Sigma) * np.eye(3) - Sigma)


def random_rotation(rng):
    """A unit quaternion."""
    x = rng.normal(size=4)
    return x / np.linalg.norm(x)


def random_tree(kinds, seed=0, parents=None, **options):
    """Bodies with joints of these kinds, skew axes, eccentric centres; each on the one before, or on `parents`."""
    rng = np.random.default_rng(seed)
    bodies = []
    for i, kind in enumerate(kinds):
        parent = (i - 1 if parents is None else parents[i]) if kind != "free" else -1
        anchor = (0, 0, 0) if kind == "free" else 0.3 * rng.normal(size=3)
        joint = Joint(
            kind, rng.normal(size=3), anchor, damping=rng.uniform(0.1, 0.5), armature=0.05 * rng.uniform(),
            stiffness=rng.uniform(1.0, 5.0), rest=0.1 if kind in ("revolute", "prismatic") else 0.0,
            reference=0.2 if kind in ("revolute", "prismatic") else 0.0,
        )  # fmt: skip
        bodies.append(
            Body(
                f"body{i}", f"body{parent}" if parent >= 0 else "world", joint, rng.uniform(0.5, 2.0),
                0.2 * rng.normal(size=3),
                random_inertia(rng), 0.5 * rng.normal(size=3), random_rotation(rng),
            )
        )  # fmt: skip
    return tree(bodies, gravity=(0.5, -1.0, -9.0), **options)


def four_bar(**options):
    """A crank, a coupler and a rocker in the x-z plane, closed by a pin: one freedom, and a row too many."""
    about_y = {"kind": "revolute", "axis": (0, 1, 0)}
    bar = {"mass": 1.0, "inertia": (0.01, 0.02, 0.015)}
    return tree(
        [
            Body("crank", joints=Joint(**about_y, damping=0.01), com=(0.15, 0, 0), **bar),
            Body("coupler", "crank", Joint(**about_y), com=(0.4, 0, 0), position=(0.3, 0, 0), **bar),
            Body(
                "rocker", joints=Joint(**about_y), com=(0.25, 0, 0), position=(0.9, 0, 0), rotation=(0.8, 0, -0.6, 0),
                **bar,
            ),
        ],
        loops=[Connect("coupler", "rocker", (0.8, 0, 0), (0.5, 0, 0))],
        **options,
    )  # fmt: skip


def servo_arm(**options):
    """Two links on servo motors with dry friction."""
    joint = {"kind": "revolute", "axis": (0, 1, 0), "armature": 0.1, "damping": 0.5, "friction": 1.0}
    link = {"mass": 2.0, "com": (0.2, 0, 0), "inertia": (0.01, 0.05, 0.05)}
    return tree(
        [
            Body("upper", joints=Joint(**joint), **link),
            Body("fore", "upper", Joint(**joint), position=(0.4, 0, 0), **link),
        ],
        motors=[Motor("upper", "position", kp=500.0, kv=20.0), Motor("fore", "position", kp=500.0, kv=20.0)],
        **options,
    )
