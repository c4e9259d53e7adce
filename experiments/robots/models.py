"""The mechanisms of the comparison, for both programs: bodies of ours, and the same as MJCF text."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
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
    """A mechanism in both forms, a start, a length, and what it is.

    springs: the coordinates of elastic joints, whose torques are compared; stiffness: theirs, N m/rad.
    """

    words: str
    robot: Mechanism
    text: str
    q0: np.ndarray
    v0: np.ndarray
    duration: float
    springs: tuple = ()
    stiffness: float = 0.0

    @property
    def is_driven(self) -> bool:
        """Whether set points move."""
        return callable(self.robot.params.get("ctrl"))


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
    """Both forms, at rest; ctrl: set points, constant."""
    robot = tree(bodies, motors=motors, loops=loops, gravity=GRAVITY)
    if ctrl is not None:
        robot.params["ctrl"] = np.asarray(ctrl, float)
    start = np.asarray(robot.q0) + np.asarray(q0, float)  # those with loops have been closed
    return Case(words, robot, mjcf(bodies, motors, loops), start, np.zeros_like(start), duration)


def ur5(smooth: bool = False) -> Case:
    """The arm on position servos, sent from one pose to another: at once, or, smooth, along set points in 1 s."""
    inertia = [cylinder(m, *size, axis) for m, size, axis in zip(MASSES, SIZES, ALONG, strict=True)]
    bodies = denavit_hartenberg(UR5, mass=MASSES, com=CENTRES, inertia=inertia, armature=[0.5, 0.5, 0.5, 0.1, 0.1, 0.1])
    kp = np.array([2000.0, 2000.0, 2000.0, 500.0, 500.0, 500.0])
    motors = [Motor(f"joint{i + 1}", "position", kp=k, kv=0.1 * k) for i, k in enumerate(kp)]
    q0, there = np.array([0.0, -1.2, 1.4, -0.4, 0.5, 0.2]), np.array([0.6, -0.9, 1.0, 0.1, 0.0, -0.3])
    words = f"UR5 on servos, set points that {'move smoothly' if smooth else 'jump'}"
    case = made(words, bodies, q0, 2.0, motors, ctrl=there)
    if smooth:
        zero = jnp.zeros(len(q0))
        held = case.robot.system.dynamics(jnp.asarray(q0), zero, zero, 0.0, case.robot.params)
        here = there + held / kp  # at rest there
        case.robot.params["ctrl"] = jax.tree_util.Partial(along, here, jnp.asarray(there), jnp.asarray(1.0))
    return case


def along(here, there, duration, t):
    """From one place to another, with rates and accelerations that begin and end with zero."""
    s = jnp.clip(t / duration, 0.0, 1.0)
    return here + (there - here) * s**3 * (10 - 15 * s + 6 * s**2)


def flexible(stiffness: float, start: str) -> Case:
    """Two links on flexible joints: hinges of motors with armature, springs behind them, servos on the motors.

    start: "at rest", in equilibrium, set points move smoothly within 0.5 s; "ringing", the same from springs that carry
    nothing; "jump", set points jump, from springs that are bent by about what that loads them with.
    """
    bodies = []
    for i, name in enumerate(("upper", "fore")):
        motor = Joint("revolute", (0, 1, 0), name=f"{name} motor", armature=1.0, damping=5.0)
        spring = Joint("revolute", (0, 1, 0), name=f"{name} spring", stiffness=stiffness, damping=1e-4 * stiffness)
        link = {"mass": 4.0 - i, "com": (0.2, 0, 0), "inertia": (0.01, 0.08, 0.08)}
        bodies.append(Body(name, "upper" if i else "world", (motor, spring), position=(0.4 * i, 0, 0), **link))
    kp, there = 2000.0, np.array([0.6, -0.3])
    motors = [Motor(f"{name} motor", "position", kp=kp, kv=200.0) for name in ("upper", "fore")]
    words = f"flexible joints, k = 1e{int(np.log10(stiffness))} N m/rad, "
    words += {"at rest": "from rest", "ringing": "ringing", "jump": "set points that jump"}[start]
    case = made(words, bodies, [0.1, 0.0, 0.2, 0.0], 0.6, motors, ctrl=there)
    case = case._replace(springs=(1, 3), stiffness=stiffness)
    return loaded(case) if start == "jump" else moved(case, there, kp, start == "ringing")


def moved(case: Case, there: np.ndarray, kp: float, ringing: bool) -> Case:
    """Set points that begin where the motors hold still, and springs in equilibrium, or without a load."""
    robot, springs = case.robot, np.array(case.springs)
    motors = np.setdiff1d(np.arange(len(case.q0)), springs)
    zero = jnp.zeros(len(case.q0))

    def missing(x):
        return robot.system.dynamics(jnp.asarray(case.q0).at[springs].set(x), zero, zero, 0.0, robot.params)

    x = jnp.zeros(len(springs))
    for _ in range(5):  # Newton's iteration
        x = x - jnp.linalg.solve(jax.jacfwd(missing)(x)[springs], missing(x)[springs])
    here = there + missing(x)[motors] / kp
    robot.params["ctrl"] = jax.tree_util.Partial(along, here, jnp.asarray(there), jnp.asarray(0.5))
    q0 = np.array(case.q0)
    q0[springs] = 0.0 if ringing else np.asarray(x)
    return case._replace(q0=q0)


def loaded(case: Case) -> Case:
    """The start whose springs neither ring nor creep: their own accelerations are zero, and so are the rates of these.

    Springs x and their rates for the motors' q and v: acceleration(x, rate) = 0, and rate = dx/dt along the motion that
    this makes of the motors. Of second order in the time of a spring over that of the motion.
    """
    robot, springs = case.robot, np.array(case.springs)

    @jax.jit
    def acceleration(q, v):
        M = robot.system.mass(q, robot.params)
        return jnp.linalg.solve(M, -robot.system.dynamics(q, v, jnp.zeros_like(v), 0.0, robot.params))

    def own(x, q, v):
        return acceleration(q.at[springs].set(x), v)[springs]

    def bent(q, v):
        for _ in range(20):  # Newton's iteration
            x = q[springs]
            q = q.at[springs].set(x - jnp.linalg.solve(jax.jacfwd(own)(x, q, v), own(x, q, v)))
        return q

    q, v, step = jnp.asarray(case.q0), jnp.asarray(case.v0), 1e-5
    others = np.setdiff1d(np.arange(len(q)), springs)
    for _ in range(5):
        q = bent(q, v)
        w = acceleration(q, v)
        later = bent(q.at[others].add(step * v[others]), v.at[others].add(step * w[others]))
        v = v.at[springs].set((later[springs] - q[springs]) / step)
    return case._replace(q0=np.asarray(q), v0=np.asarray(v))


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


def four_bars(loops: int) -> Case:
    """A row of four-bar loops, benchmark A02 of multibody codes (`hhtjax.scenes.four_bars`), by bodies in space.

    Cranks of 1 m and 1 kg on pivots 1 m apart; from the end of each a coupler, whose other end is that of the next.
    Each end closes three rows, of which the one across the plane says nothing.
    """
    upright, lying = (1 / 12, 1 / 12, 1e-3), (1e-3, 1 / 12, 1 / 12)
    cranks = [
        Body(f"crank{i}", "world", Joint("revolute", (0, 1, 0)), 1.0, (0, 0, 0.5), upright, (float(i), 0, 0))
        for i in range(loops + 1)
    ]
    couplers = [
        Body(f"coupler{i}", f"crank{i}", Joint("revolute", (0, 1, 0)), 1.0, (0.5, 0, 0), lying, (0, 0, 1))
        for i in range(loops)
    ]
    ends = [Connect(f"coupler{i}", f"crank{i + 1}", (1, 0, 0), (0, 0, 1)) for i in range(loops)]
    case = made(f"row of {loops} four-bars", [*cranks, *couplers], np.zeros(2 * loops + 1), 0.6, loops=ends)
    v0 = np.full(2 * loops + 1, -1.0)
    v0[np.array([case.robot.index(f"crank{i}") for i in range(loops + 1)])] = (
        1.0  # ends of cranks at 1 m/s; couplers stay level
    )
    return case._replace(v0=v0)
