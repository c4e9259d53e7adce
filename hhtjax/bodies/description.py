"""The parts of a mechanism as the user describes it: bodies, joints, motors, loops, markers. SI units.

Frames: a body is attached to its parent at `position` and `rotation`, both in the frame of the parent. Its joints
follow in their order: each joint moves the frame in which the next one is fixed. The frame after the last joint is the
frame of the body. Its centre of mass, its inertia, and the bodies attached to it are given in this frame.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from hhtjax.checks import require_number

KINDS = {"revolute": 1, "prismatic": 1, "planar": 3, "ball": 3, "free": 6}  # and their rates
SCALARS = "revolute", "prismatic"
WORLD = "world"
UNIT = 1e-6  # by which an axis, or a rotation, may miss length 1


def vector(caller: str, name: str, value: Any, shape: tuple = (3,)) -> tuple:
    """Finite numbers of the given shape, as a tuple of Python floats."""
    try:
        x = np.asarray(value, float)
    except (TypeError, ValueError):
        raise TypeError(f"{caller}: `{name}` must be {shape} real numbers; received {value!r}.") from None
    if x.shape != shape or not np.all(np.isfinite(x)):
        raise ValueError(f"{caller}: `{name}` must be finite numbers of shape {shape}; received {value!r}.")
    return tuple(x.ravel().tolist())


def _direction(caller: str, name: str, value: Any) -> tuple:
    """A vector that is not zero, normalised."""
    x = np.array(vector(caller, name, value))
    size = np.linalg.norm(x)
    if size == 0:
        raise ValueError(f"{caller}: `{name}` must be a direction, not zero; received {value!r}.")
    return tuple((x if abs(size - 1) < 1e-15 else x / size).tolist())


def _rotation(caller: str, name: str, value: Any) -> tuple:
    """A rotation as 9 numbers, from a matrix (3, 3) or a quaternion (4,) of any length with its real part first."""
    if np.shape(value) not in ((4,), (3, 3)):
        raise ValueError(f"{caller}: `{name}` must be a matrix (3, 3) or a quaternion (4,); received {value!r}.")
    x = np.reshape(vector(caller, name, value, np.shape(value)), np.shape(value))
    if x.shape == (4,) and not np.any(x):
        raise ValueError(f"{caller}: `{name}` must be a quaternion that is not zero; received {value!r}.")
    R = of_quaternion(x) if x.shape == (4,) else x
    error = np.max(np.abs(R @ R.T - np.eye(3)))
    if error > UNIT or np.linalg.det(R) < 0:
        raise ValueError(
            f"{caller}: `{name}` must be a rotation, with R R^T = 1 to {UNIT:g} and det R = 1; received {value!r}, "
            f"which is off by {error:.3g} and has det R = {np.linalg.det(R):.3g}."
        )
    return tuple(tidy(R).ravel().tolist())


def of_quaternion(quaternion) -> np.ndarray:
    """R (3, 3) of a quaternion (w, x, y, z) of any length; NaN for zero."""
    w, x, y, z = np.asarray(quaternion, float) / np.linalg.norm(quaternion)
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


def tidy(x: np.ndarray) -> np.ndarray:
    """x with entries that are zero up to rounding set to zero, which makes the program cheaper."""
    return np.where(np.abs(x) < 1e-15, 0.0, x)


def _name(caller: str, name: str, value: Any) -> str:
    if not isinstance(value, str) or not value:
        raise TypeError(f"{caller}: `{name}` must be a string; received {value!r}.")
    return value


def _set(self, **values):
    for name, value in values.items():
        object.__setattr__(self, name, value)


@dataclass(frozen=True)
class Joint:
    """A joint between a body and its parent.

    Args:
        kind: "revolute" (rad) or "prismatic" (m) about or along `axis`; "planar": along two directions normal to `axis`
            (m) and about it (rad); "ball"; "free", for a body on the world.
        axis: in the frame of the body; it is normalised. The two directions of "planar" are the images of x and y under
            the shortest rotation from z to `axis`.
        anchor: a point of the axis, or the centre of a ball, in the frame of the body, m.
        name: of the joint; None for the name of its body. Further unnamed joints of a body are named BODY_2, ... An
            unnamed spring on the axis of the previous joint, as made by `flexible`, is named JOINT_spring.
        stiffness, rest: of a spring, N m/rad or N/m, and the coordinate at which it is relaxed. Balls and free joints
            are relaxed in the described position; `rest` must then be 0. For joints with several rates, one number
            applies to all.
        damping: N m s/rad or N s/m. armature: inertia of a rotor, reflected to the joint, kg m^2 or kg.
        friction: limit of dry friction, N m or N, >= 0.
        range: (lowest, highest), only for joints with one rate; None for no limits.
        reference: the value of the coordinate in the described position, only for joints with one rate, rad or m; q0
            starts there.

    Raises: TypeError, ValueError: an argument of a wrong kind or value.
    """

    kind: str = "revolute"
    axis: Any = (0.0, 0.0, 1.0)
    anchor: Any = (0.0, 0.0, 0.0)
    name: str | None = None
    stiffness: float = 0.0
    rest: float = 0.0
    damping: float = 0.0
    armature: float = 0.0
    friction: float = 0.0
    range: Any = None
    reference: float = 0.0

    def __post_init__(self):
        if self.kind not in KINDS:
            raise ValueError(f"Joint: `kind` must be one of {', '.join(KINDS)}; received {self.kind!r}.")
        _set(self, axis=_direction("Joint", "axis", self.axis), anchor=vector("Joint", "anchor", self.anchor))
        for name in ("stiffness", "damping", "armature", "friction"):
            value = require_number("Joint", name, getattr(self, name), lambda x: 0 <= x < np.inf, "be 0 or more")
            _set(self, **{name: float(value)})
        for name in ("rest", "reference"):
            value = float(require_number("Joint", name, getattr(self, name), np.isfinite, "be finite"))
            if self.kind not in SCALARS and value:
                raise ValueError(f"Joint: `{name}` belongs to revolute and prismatic joints; received {value!r}.")
            _set(self, **{name: value})
        if self.kind == "free" and any(self.anchor):
            raise ValueError(
                f"Joint: a free joint turns about the origin of its body: leave out `anchor`; received {self.anchor!r}."
            )
        if self.range is not None:
            if self.kind not in SCALARS:
                raise ValueError(f"Joint: `range` belongs to revolute and prismatic joints; this is {self.kind}.")
            low, high = vector("Joint", "range", self.range, (2,))
            if not low < high:
                raise ValueError(f"Joint: `range` must be (lowest, highest); received {self.range!r}.")
            _set(self, range=(low, high))


@dataclass(frozen=True)
class Body:
    """A rigid body, and how it is attached to its parent.

    Args:
        name: its own name; "world" is reserved.
        parent: name of the body to which it is attached, which must come before it, or "world".
        joints: a `Joint`; or several, in their order from the parent; or none for a body that is fixed to its parent.
        mass: kg. com: centre of mass, (3,), m. inertia: about the centre of mass, (3, 3), its diagonal (3,), or Ixx,
            Iyy, Izz, Ixy, Ixz, Iyz (6,), kg m^2. All in the frame of the body.
        position, rotation: of the frame of the body in the frame of its parent, when its joints are at zero: (3,) in m,
            and a matrix (3, 3) or a quaternion (w, x, y, z) of any length.

    Raises: TypeError, ValueError: an argument of a wrong kind or value; a mass or an inertia that is physically
    impossible.
    """

    name: str
    parent: str = WORLD
    joints: Any = ()
    mass: float = 0.0
    com: Any = (0.0, 0.0, 0.0)
    inertia: Any = (0.0, 0.0, 0.0)
    position: Any = (0.0, 0.0, 0.0)
    rotation: Any = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self):
        if _name("Body", "name", self.name) == WORLD:
            raise ValueError('Body: `name` must not be "world", which is the frame to which all bodies are attached.')
        _name("Body", "parent", self.parent)
        joints = (self.joints,) if isinstance(self.joints, Joint) else self.joints
        if not isinstance(joints, (list, tuple)) or not all(isinstance(joint, Joint) for joint in joints):
            raise TypeError(f"Body: `joints` must be a Joint or a sequence of them; received {self.joints!r}.")
        if any(joint.kind == "free" for joint in joints) and (self.parent != WORLD or len(joints) > 1):
            raise ValueError(
                f"Body: a free joint must be the only joint of a body on the world; {self.name!r} has others."
            )
        _set(self, joints=tuple(joints))
        mass = require_number("Body", "mass", self.mass, lambda m: 0 <= m < np.inf, "be 0 or more")
        _set(self, mass=float(mass), com=vector("Body", "com", self.com))
        _set(self, position=vector("Body", "position", self.position))
        _set(self, rotation=_rotation("Body", "rotation", self.rotation))
        _set(self, inertia=_inertia(self.name, self.inertia, self.mass))

    def with_joints(self, joints) -> Body:
        """The body with other joints."""
        return self._changed(joints=tuple(joints))

    def placed_at(self, position) -> Body:
        """The body at another position."""
        return self._changed(position=tuple(position))

    def _changed(self, **values) -> Body:
        """The body with other fields."""
        R, inertia = (np.reshape(x, (3, 3)) for x in (self.rotation, self.inertia))
        return replace(self, **{"rotation": R, "inertia": inertia, **values})


def _inertia(name: str, inertia: Any, mass: float) -> tuple:
    """The tensor as 9 numbers; raises an error if no body can have it."""
    shape = np.shape(inertia)
    if shape not in ((3,), (6,), (3, 3)):
        raise ValueError(f"Body: `inertia` of {name!r} must have shape (3, 3), (3,) or (6,); received {inertia!r}.")
    x = np.reshape(vector("Body", "inertia", inertia, shape), shape)
    if shape == (3,):
        x = np.diag(x)
    elif shape == (6,):
        x = np.array([[x[0], x[3], x[4]], [x[3], x[1], x[5]], [x[4], x[5], x[2]]])
    if not np.allclose(x, x.T, rtol=1e-6, atol=0):
        raise ValueError(f"Body: `inertia` of {name!r} must be symmetric; received {inertia!r}.")
    x = (x + x.T) / 2
    moments = np.linalg.eigvalsh(x)
    if np.any(x) and mass == 0:
        raise ValueError(
            f"Body: {name!r} has inertia but no mass. Give `mass`. If only the inertia about the axis of its joint is "
            "known, leave `inertia` out and give `armature` of the joint instead."
        )
    above = moments[2] - moments[1] - moments[0]
    if moments[0] < -1e-12 * moments[2] or above > 1e-6 * moments[2]:
        rounded = [float(f"{moment:.6g}") for moment in moments]
        why = "the first is negative" if moments[0] < 0 else f"the last exceeds the sum of the others by {above:.3g}"
        raise ValueError(
            f"Body: `inertia` of {name!r} must be possible: principal moments >= 0, none larger than the "
            f"sum of the others. The principal moments of {inertia!r} are {rounded}: {why}."
        )
    return tuple(x.ravel().tolist())


@dataclass(frozen=True)
class Motor:
    """A motor at a joint: the torque gear * F, at the motor's angle s = gear * q, for the input u (params["ctrl"]).

        "torque"      F = gain u - kp s - kv sdot + offset
        "position"    F = kp (u - s) - kv sdot + offset
        "velocity"    F = kv (u - sdot) - kp s + offset

    With an activation z, an internal state of the system, z replaces u:

        "integrator"  zdot = u
        "filter"      zdot = (u - z)/timeconst

    Args:
        joint: name of a revolute or prismatic joint. kind: "torque", "position" or "velocity", see above.
        gear: transmission ratio. gain, kp, kv: see the formulas. name: None for the name of the joint.
        offset: a constant force, added to F.
        ctrlrange, forcerange: (lowest, highest) of u and of F, which are clipped; None for no limits.
        activation: "integrator" or "filter"; None for none.
        timeconst: time constant of a filter, s, > 0.
        actrange: (lowest, highest) of z, for a motor with an activation; None for no limits. F uses z clipped to this
            range. Outside the range z is drawn back with a time constant of 1 ms, so that it does not wind up.

    Raises: TypeError, ValueError: an argument of a wrong kind or value.

    >>> import jax.numpy as jnp, hhtjax
    >>> from hhtjax.bodies import Body, Joint, Motor, tree
    >>> rod = Body("rod", joints=Joint(axis=[0, 0, 1], damping=0.5), mass=2.0, com=[0.3, 0, 0], inertia=[0, 0.1, 0.1])
    >>> arm = tree([rod], motors=[Motor("rod", activation="filter", timeconst=0.1)])
    >>> run = hhtjax.simulate(
    ...     arm.system, hhtjax.hht(), arm.q0, arm.v0, arm.params | {"ctrl": jnp.ones(1)}, z0=arm.z0, dt=1e-2,
    ...     num_steps=500)
    >>> round(float(run.z[10, 0]), 3), round(float(run.v[-1, 0]), 2)                    # 1 - 1/e, u/damping
    (0.632, 2.0)
    """

    joint: str
    kind: str = "torque"
    gear: float = 1.0
    gain: float = 1.0
    kp: float = 0.0
    kv: float = 0.0
    offset: float = 0.0
    ctrlrange: Any = None
    forcerange: Any = None
    name: str | None = None
    activation: str | None = None
    timeconst: float | None = None
    actrange: Any = None

    def __post_init__(self):
        _name("Motor", "joint", self.joint)
        self._check_activation()
        if self.kind not in ("torque", "position", "velocity"):
            raise ValueError(f"Motor: `kind` must be torque, position or velocity; received {self.kind!r}.")
        for name in ("gear", "gain", "kp", "kv", "offset"):
            value = require_number("Motor", name, getattr(self, name), np.isfinite, "be finite")
            _set(self, **{name: float(value)})
        if self.kind != "torque" and self.gain != 1:
            raise ValueError(f"Motor: `gain` belongs to torque motors; a servo has kp and kv; received {self.gain!r}.")
        for name in ("ctrlrange", "forcerange", "actrange"):
            if getattr(self, name) is not None:
                low, high = vector("Motor", name, getattr(self, name), (2,))
                if not low < high:
                    raise ValueError(f"Motor: `{name}` must be (lowest, highest); received {getattr(self, name)!r}.")
                _set(self, **{name: (low, high)})

    def _check_activation(self):
        """Raises an error for an unknown activation, and for options that the activation does not have."""
        if self.activation not in (None, "integrator", "filter"):
            raise ValueError(f"Motor: `activation` must be integrator, filter or None; received {self.activation!r}.")
        if (self.activation == "filter") != (self.timeconst is not None):
            raise ValueError(
                f'Motor: `timeconst` belongs to a motor with activation="filter", which needs it; received '
                f"{self.timeconst!r} with the activation {self.activation!r}."
            )
        if self.timeconst is not None:
            value = require_number("Motor", "timeconst", self.timeconst, lambda x: 0 < x < np.inf, "be positive")
            _set(self, timeconst=float(value))
        if self.actrange is not None and self.activation is None:
            raise ValueError(f"Motor: `actrange` belongs to motors with an activation; received {self.actrange!r}.")


@dataclass(frozen=True)
class Connect:
    """Keeps a point of one body at a point of another, like a ball joint: three constraints.

    Args:
        first, second: names of bodies, or "world". anchor1, anchor2: the points, in their frames, m.

    Raises: TypeError, ValueError: an argument of a wrong kind or value.
    """

    first: str
    second: str
    anchor1: Any = (0.0, 0.0, 0.0)
    anchor2: Any = (0.0, 0.0, 0.0)

    def __post_init__(self):
        caller = type(self).__name__
        _name(caller, "first", self.first)
        _name(caller, "second", self.second)
        _set(self, anchor1=vector(caller, "anchor1", self.anchor1), anchor2=vector(caller, "anchor2", self.anchor2))


@dataclass(frozen=True)
class Weld(Connect):
    """Keeps a frame of one body at a frame of another, in position and orientation: six constraints.

    Args:
        first, second: names of bodies, or "world". anchor1, anchor2: the points that coincide, in their frames, m.
        rotation: of the second body in the frame of the first, a matrix (3, 3) or a quaternion (w, x, y, z).

    Raises: TypeError, ValueError: an argument of a wrong kind or value.
    """

    rotation: Any = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self):
        super().__post_init__()
        _set(self, rotation=_rotation("Weld", "rotation", self.rotation))


@dataclass(frozen=True)
class Couple:
    """Couples a joint to another, as by gears or a linkage: q1 - r1 = c0 + c1 (q2 - r2) + c2 (q2 - r2)^2 + ...

    Args:
        first, second: names of revolute or prismatic joints; if second is None, the first is fixed at r1 + c0.
        coefficients: c0, c1, ... origins: (r1, r2).

    Raises: TypeError, ValueError: an argument of a wrong kind or value.
    """

    first: str
    second: str | None = None
    coefficients: Any = (0.0, 1.0)
    origins: Any = (0.0, 0.0)

    def __post_init__(self):
        _name("Couple", "first", self.first)
        if self.second is not None:
            _name("Couple", "second", self.second)
        _set(self, coefficients=vector("Couple", "coefficients", self.coefficients, np.shape(self.coefficients)))
        _set(self, origins=vector("Couple", "origins", self.origins, (2,)))


@dataclass(frozen=True)
class Marker:
    """A named frame on a body, such as that of a tool.

    Args:
        name: its name in the results of `frames`. body: name of a body, or "world". position: (3,), in the frame of the
            body, m. rotation: as in `Body`.

    Raises: TypeError, ValueError: an argument of a wrong kind or value.
    """

    name: str
    body: str
    position: Any = (0.0, 0.0, 0.0)
    rotation: Any = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self):
        _name("Marker", "name", self.name)
        _name("Marker", "body", self.body)
        _set(self, position=vector("Marker", "position", self.position))
        _set(self, rotation=_rotation("Marker", "rotation", self.rotation))


def flexible(joint: Joint, stiffness: float, damping: float = 0.0) -> tuple[Joint, Joint]:
    """A joint with a flexible gear: the joint of the motor, with the armature, followed by a spring to the link.

    Args:
        joint: that of the motor; its name, armature, friction and damping stay on the motor's side of the spring.
        stiffness: N m/rad (N/m). damping: N m s/rad (N s/m), across the spring.

    Returns:
        Two joints, for `Body(joints=)`; the second, whose coordinate is the deflection, is named JOINT_spring.

    Raises: TypeError, ValueError: an argument of a wrong kind or value; a joint without armature (the motor would have
    no inertia), or with more than one rate.

    >>> [x.stiffness for x in flexible(Joint("revolute", armature=0.5), 1e4)]
    [0.0, 10000.0]
    """
    if not isinstance(joint, Joint) or joint.kind not in SCALARS or joint.armature == 0:
        raise ValueError(f"flexible: `joint` must be revolute or prismatic, with an armature; received {joint!r}.")
    name = None if joint.name is None else f"{joint.name}_spring"
    return joint, Joint(joint.kind, joint.axis, joint.anchor, name, stiffness, 0.0, damping)


def denavit_hartenberg(rows: Any, *, modified: bool = False, **of_links: Any) -> list[Body]:
    """Bodies of a serial arm from its Denavit-Hartenberg table: theta about z, d along z, a along x, alpha about x.

    Args:
        rows: (N, 4): a (m), alpha (rad), d (m), theta0 (rad) of each joint; all are revolute, with q added to theta0.
        modified: the convention of Craig, where a and alpha come before theta and d.
        of_links: fields of `Body` and `Joint`, each with one entry per link: mass, com, inertia, damping, armature, ...
            They are given in the frames of the table; each frame is fixed to its link and is the frame of its body.

    Returns:
        Bodies link1, link2, ..., with joints joint1, joint2, ..., for `tree`.

    Raises: TypeError, ValueError: an argument of a wrong kind, shape or value.

    >>> arm = denavit_hartenberg([[1.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0]], mass=[2.0, 1.0])
    >>> [body.name for body in arm], arm[1].position, arm[1].joints[0].anchor
    (['link1', 'link2'], (0.5, 0.0, 0.0), (-0.5, 0.0, 0.0))
    """
    caller = "denavit_hartenberg"
    rows = np.asarray(rows, float)
    if rows.ndim != 2 or rows.shape[1:] != (4,) or not len(rows) or not np.all(np.isfinite(rows)):
        raise ValueError(f"{caller}: `rows` must be finite numbers (N, 4); received shape {rows.shape}.")
    own, known = {f.name for f in fields(Body)}, {f.name for f in fields(Joint)}
    for name, values in of_links.items():
        if name not in (own | known) - {"name", "parent", "joints", "position", "rotation", "kind", "axis", "anchor"}:
            raise TypeError(f"{caller}: `{name}` is not a field of a link or its joint.")
        if len(values) != len(rows):
            raise ValueError(
                f"{caller}: `{name}` must have {len(rows)} entries, one per joint; received {len(values)}."
            )
    bodies = []
    for i, (a, alpha, d, theta) in enumerate(rows):
        turn, link = _screw(2, theta, d), _screw(0, alpha, a)
        T = link @ turn if modified else turn @ link
        axis, anchor = T[:3, :3].T @ [0.0, 0.0, 1.0], -T[:3, :3].T @ T[:3, 3]  # of the frame before, seen from its own
        if modified:
            axis, anchor = np.array([0.0, 0.0, 1.0]), np.zeros(3)
        values = {name: values[i] for name, values in of_links.items()}
        of_joint = {name: value for name, value in values.items() if name in known}
        joint = Joint("revolute", tidy(axis), tidy(anchor), f"joint{i + 1}", **of_joint)
        of_body = {name: value for name, value in values.items() if name in own}
        parent = f"link{i}" if i else WORLD
        bodies.append(Body(f"link{i + 1}", parent, joint, position=T[:3, 3], rotation=tidy(T[:3, :3]), **of_body))
    return bodies


def _screw(axis: int, angle: float, distance: float) -> np.ndarray:
    """The homogeneous matrix (4, 4) of a rotation about an axis and a translation along it."""
    T, (i, j) = np.eye(4), [(1, 2), (2, 0), (0, 1)][axis]
    c, s = np.cos(angle), np.sin(angle)
    T[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    T[axis, 3] = distance
    return tidy(T)
