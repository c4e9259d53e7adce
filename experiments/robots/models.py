"""The mechanisms of the comparison, for both programs: bodies of ours, and the same as MJCF text."""

from typing import NamedTuple

import numpy as np

from hhtjax.bodies import Body, Connect, Joint, Mechanism, Motor, denavit_hartenberg, tree

GRAVITY = (0.0, 0.0, -9.81)
# The maker's table of the UR5: a, alpha, d, theta0 of each joint, masses and centres of mass in the frames of the
# table. It gives no inertias: those of cylinders of about the size of the links stand for them.
UR5 = (
    (0.0, np.pi / 2, 0.089159, 0.0), (-0.425, 0.0, 0.0, 0.0), (-0.39225, 0.0, 0.0, 0.0),
    (0.0, np.pi / 2, 0.10915, 0.0), (0.0, -np.pi / 2, 0.09465, 0.0), (0.0, 0.0, 0.0823, 0.0),
)  # fmt: skip
MASSES = 3.7, 8.393, 2.275, 1.219, 1.219, 0.1879
CENTRES = (
    (0, -0.02561, 0.00193), (0.2125, 0, 0.11336), (0.11993, 0, 0.0265), (0, -0.0018, 0.01634), (0, 0.0018, 0.01634),
    (0, 0, -0.001159),
)  # fmt: skip
SIZES = (0.06, 0.15), (0.055, 0.45), (0.045, 0.4), (0.04, 0.1), (0.04, 0.1), (0.035, 0.04)  # radius, length, m
ALONG = 1, 0, 0, 1, 1, 2  # axis of each cylinder in its frame


class Case(NamedTuple):
    """A mechanism in both forms, a start, a length, and what it is."""

    words: str
    robot: Mechanism
    text: str
    q0: np.ndarray
    duration: float


def cylinder(mass, radius, length, axis):
    """Principal moments, kg m^2."""
    across = mass * (3 * radius**2 + length**2) / 12
    moments = [across] * 3
    moments[axis] = mass * radius**2 / 2
    return moments


def numbers(values) -> str:
    """Of MJCF."""
    return " ".join(f"{float(x):.17g}" for x in np.ravel(values))


def mjcf(bodies, motors=(), loops=(), controls=(), gravity=GRAVITY) -> str:
    """Bodies with hinges, position servos and point-to-point loops as MJCF, without shapes."""
    kinds = {"revolute": "hinge", "prismatic": "slide"}

    def element(body: Body) -> str:
        joints = "".join(
            f'<joint name="{j.name or body.name}" type="{kinds[j.kind]}" axis="{numbers(j.axis)}" '
            f'pos="{numbers(j.anchor)}" stiffness="{j.stiffness:.17g}" damping="{j.damping:.17g}" '
            f'armature="{j.armature:.17g}" '
            f'frictionloss="{j.friction:.17g}"/>'
            for j in body.joints
        )
        R = np.reshape(body.rotation, (3, 3))
        inertia = np.reshape(body.inertia, (3, 3))
        upper = [inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
        inertial = f'<inertial mass="{body.mass:.17g}" pos="{numbers(body.com)}" fullinertia="{numbers(upper)}"/>' * (
            body.mass > 0
        )
        inside = "".join(element(other) for other in bodies if other.parent == body.name)
        axes = numbers([*R[:, 0], *R[:, 1]])
        return (
            f'<body name="{body.name}" pos="{numbers(body.position)}" xyaxes="{axes}">{joints}{inertial}{inside}</body>'
        )

    world = "".join(element(body) for body in bodies if body.parent == "world")
    servos = "".join(
        f'<position joint="{m.joint}" kp="{m.kp:.17g}" kv="{m.kv:.17g}" gear="{m.gear:.17g}"/>' for m in motors
    )
    ties = "".join(f'<connect body1="{x.first}" body2="{x.second}" anchor="{numbers(x.anchor1)}"/>' for x in loops)
    return (
        f'<mujoco><compiler angle="radian" balanceinertia="false"/><option gravity="{numbers(gravity)}"/>'
        f"<worldbody>{world}</worldbody><actuator>{servos}</actuator><equality>{ties}</equality></mujoco>"
    )


def made(words, bodies, q0, duration, motors=(), loops=(), ctrl=None) -> Case:
    """Both forms; ctrl: set points, constant."""
    robot = tree(bodies, motors=motors, loops=loops, gravity=GRAVITY)
    if ctrl is not None:
        robot.params["ctrl"] = np.asarray(ctrl, float)
    return Case(words, robot, mjcf(bodies, motors, loops), np.asarray(q0, float), duration)


def ur5() -> Case:
    """The arm on position servos, sent from one pose to another."""
    inertia = [cylinder(m, *size, axis) for m, size, axis in zip(MASSES, SIZES, ALONG, strict=True)]
    bodies = denavit_hartenberg(UR5, mass=MASSES, com=CENTRES, inertia=inertia, armature=[0.5, 0.5, 0.5, 0.1, 0.1, 0.1])
    kp = np.array([2000.0, 2000.0, 2000.0, 500.0, 500.0, 500.0])
    motors = [Motor(f"joint{i + 1}", "position", kp=k, kv=0.1 * k) for i, k in enumerate(kp)]
    return made(
        "UR5 on servos, 6 joints",
        bodies,
        [0.0, -1.2, 1.4, -0.4, 0.5, 0.2],
        2.0,
        motors,
        ctrl=[0.6, -0.9, 1.0, 0.1, 0.0, -0.3],
    )


def flexible(stiffness: float, ringing: bool) -> Case:
    """Two links on flexible joints: hinges of motors with armature, springs behind them; from rest, or let go bent."""
    bodies = []
    for i, name in enumerate(("upper", "fore")):
        motor = Joint("revolute", (0, 1, 0), name=f"{name} motor", armature=1.0, damping=5.0)
        spring = Joint("revolute", (0, 1, 0), name=f"{name} spring", stiffness=stiffness, damping=1e-4 * stiffness)
        link = {"mass": 4.0 - i, "com": (0.2, 0, 0), "inertia": (0.01, 0.08, 0.08)}
        bodies.append(Body(name, "upper" if i else "world", (motor, spring), position=(0.4 * i, 0, 0), **link))
    motors = [Motor(f"{name} motor", "position", kp=2000.0, kv=200.0) for name in ("upper", "fore")]
    bent = 20.0 / stiffness if ringing else 0.0  # by 20 N m
    words = f"flexible joints, k = {stiffness:.0e}, {'let go bent' if ringing else 'from rest'}"
    return made(words, bodies, [0.1, bent, 0.2, -bent], 0.5, motors, ctrl=[0.6, -0.3])


def four_bar() -> Case:
    """A crank, a coupler and a rocker, closed by a pin."""
    about_y, bar = {"kind": "revolute", "axis": (0, 1, 0)}, {"mass": 1.0, "inertia": (0.01, 0.02, 0.015)}
    x, z = 0.9, -0.4
    end = np.array([x, 0.0, 0.0]) + np.array([-0.3, 0.0, z])
    apart = end - [0.3, 0, 0]
    angle = np.arctan2(-apart[2], apart[0])
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    along = (end - [x, 0, 0]) / 0.5
    S = np.column_stack([along, [0, 1, 0], np.cross(along, [0, 1, 0])])
    bodies = [
        Body("crank", joints=Joint(**about_y, name="crank"), com=(0.15, 0, 0), **bar),
        Body(
            "coupler",
            "crank",
            Joint(**about_y, name="coupler"),
            com=(0.2, 0, 0),
            position=(0.3, 0, 0),
            rotation=R,
            **bar,
        ),
        Body("rocker", joints=Joint(**about_y, name="rocker"), com=(0.25, 0, 0), position=(x, 0, 0), rotation=S, **bar),
    ]
    loop = Connect("coupler", "rocker", (float(np.linalg.norm(apart)), 0, 0), (0.5, 0, 0))
    return made("four-bar, closed by a pin", bodies, np.zeros(3), 2.0, loops=[loop])


def chain(n: int) -> Case:
    """n links in space on hinges with springs and dampers."""
    bodies = []
    for i in range(n):
        joint = Joint("revolute", np.roll([0, 1, 0], i), name=f"joint{i}", stiffness=50.0, damping=0.5, armature=0.01)
        parent = f"link{i - 1}" if i else "world"
        bodies.append(
            Body(
                f"link{i}",
                parent,
                joint,
                1.0,
                (0.1, 0.01, 0.02),
                (0.01, 0.012, 0.008),
                (0.2 * (i > 0), 0, 0.02 * (i > 0)),
            )
        )
    return made(f"chain of {n} links", bodies, 0.1 * np.ones(n), 0.5)
