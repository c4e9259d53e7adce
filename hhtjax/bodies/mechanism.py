"""Mechanisms: a tree of bodies, its motors and its loops, as a `System` with parameters and a start."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.bodies.description import WORLD, Body, Connect, Couple, Marker, Motor, Weld, of_quaternion, vector
from hhtjax.bodies.equations import (
    ActivatedDynamics,
    Activation,
    Dynamics,
    Frame,
    Friction,
    Loops,
    Mass,
    Reaches,
    Sliding,
    all_rub,
    as_rates,
    frames_of,
)
from hhtjax.bodies.model import Drive, Model, Place, Row, Spring, Stop, Structure, numpy_mass_matrix, structure
from hhtjax.bodies.tree import Tree
from hhtjax.checks import require_one_of
from hhtjax.description import Array, PyTree, is_tracing
from hhtjax.primitives import plain
from hhtjax.systems import kinematics
from hhtjax.systems.events import Event, impact
from hhtjax.systems.system import System

GRAVITY = (0.0, 0.0, -9.80665)
INDEPENDENT = 1e-6  # sine of the angle to the rows before, below which a row of a loop says nothing new
STOP_TIME = 0.005  # s, half a period of what hits a stiff stop
RESTITUTION = 0.3
FAR = 0.5  # rad or m; joints that are moved farther to close loops deserve a warning
SINGULAR = 1e-12  # eigenvalue of the mass matrix, its diagonal scaled to 1, that is rounding


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A mechanism: its system, parameters and start; made by `tree` and `load`.

    Attributes:
        system: a `System` in minimal coordinates.
        params: dict of arrays in SI units. For each body in `bodies`: mass (nb,), com (nb, 3), inertia (nb, 3, 3),
            about the centre of mass in the frame of the body. For each rate: damping, armature (nv,). For each hinge or
            slide: stiffness, springref (ns,). gravity (3,). With motors: gear, gain, kp, kv, offset, ctrl (na,), where
            ctrl may be a function of t; and timeconst (na,) if some are filters. With dry friction: frictionloss (k,),
            for the rates in `rubbing`. Depending on the arguments of `tree`: position (number of all bodies, 3), first
            of the bodies in `bodies`, in their order, then of the bodies without a mass that moves, in the order of the
            description; spring_stiffness, stop_stiffness, stop_damping, restitution. You may add "torque", a
            generalised force structured like v, and "wrench", {body: (moment, force) (6,)} in world axes, at the origin
            of the body or marker. Both may be constants or functions of t.
        q0, v0: the described position, moved to close the loops if they were open, and zero velocity. q is (ns,) if
            there are only hinges and slides, else a dict: "ball" (., 3, 3), "free" {"R": (., 3, 3), "x": (., 3)}, and
            "joint" (ns,). v is structured like q, with material angular velocities (., 3) instead of rotations.
        z0: activations of motors (nz,), each 0 or the nearest end of its range, for `simulate(z0=)`; None if there are
            none.
        events: events at the ends of ranges, for `simulate(events=)`; None unless limits="event".
        joints, bodies, motors: names, in the order of coordinates and params.
        activations: names of the motors that have an activation, in the order of z.
        markers: names of all frames: the world, bodies, markers.
        rubbing: indices of the rates with dry friction.
        unsupported: the features of a file that `load` was told to ignore.
    """

    system: System
    params: dict
    q0: Any
    v0: Any
    z0: Any
    events: tuple[Event, ...] | None
    joints: tuple[str, ...]
    bodies: tuple[str, ...]
    motors: tuple[str, ...]
    activations: tuple[str, ...]
    markers: tuple[str, ...]
    rubbing: tuple[int, ...]
    unsupported: tuple[str, ...]
    model: Model
    rates_of: dict

    def __repr__(self):
        tree = self.model.tree
        loops = f", {_rows(self.model)} rows of loops" if self.model.loops else ""
        return f"Mechanism({len(self.bodies)} bodies, {tree.rates} rates{loops}, {len(self.motors)} motors)"

    def index(self, joint: str) -> int | tuple[int, ...]:
        """Index of the rates of a joint in the vector of rates, and in damping and armature: a number, or several.

        If all joints are hinges and slides, it is the index in q too.

        Raises: KeyError: there is no joint of that name.
        """
        if joint not in self.rates_of:
            raise KeyError(f"index: no joint is named {joint!r}; there are {', '.join(self.joints)}.")
        found = self.rates_of[joint]
        return found[0] if len(found) == 1 else found

    def body_index(self, body: str) -> int:
        """Index of a body in mass, com and inertia.

        Raises: KeyError: there is no body with a mass of that name.
        """
        if body not in self.bodies:
            raise KeyError(f"body_index: no body with a mass is named {body!r}; there are {', '.join(self.bodies)}.")
        return self.bodies.index(body)

    def frames(self, q: PyTree, params: PyTree = None) -> dict[str, Frame]:
        """The frame of each body and marker in the world, {name: Frame(R, x)}; params: None for `self.params`."""
        params = self.params if params is None else params
        return dict(zip(self.markers, frames_of(self.model, q, params), strict=True))

    def bars(self, params: PyTree = None) -> Bars:
        """For drawing: a function of q that returns polylines, for `hhtjax.plot.animation`; params: None for
        `self.params`.

        Each body is a line from its origin to the origins of the bodies and markers on it. If there are none, the line
        ends at twice its centre of mass, the other end of a uniform rod.
        """
        return Bars(self, self.params if params is None else params)


@dataclass(frozen=True, eq=False)
class Bars:
    """The polylines of a mechanism, (2, 3) each; made by `Mechanism.bars`."""

    robot: Mechanism
    params: dict

    def __call__(self, q: PyTree) -> list[np.ndarray]:
        places, model = _placed(self.robot.model, q, self.params), self.robot.model
        lines = []
        for i, (place, parent) in enumerate(zip(model.places, model.parents, strict=True)):
            if place.name == WORLD:
                continue
            if parent > 0:
                lines.append(np.stack([places[parent].x, places[i].x]))
            if i not in model.parents and place.name in self.robot.bodies:
                centre = np.asarray(self.params["com"][self.robot.bodies.index(place.name)])
                end = np.asarray(places[i].x) + 2 * np.asarray(places[i].R) @ centre
                lines.append(np.stack([places[i].x, end]))
        return lines


@partial(jax.jit, static_argnums=0)
def _placed(model: Model, q: PyTree, params: dict) -> list[Frame]:
    """`frames_of`, compiled once per mechanism."""
    return frames_of(model, q, {name: params[name] for name in ("position",) if name in params})


def tree(
    bodies: Sequence[Body],
    *,
    motors: Sequence[Motor] = (),
    loops: Sequence[Connect | Weld | Couple] = (),
    markers: Sequence[Marker] = (),
    gravity: Any = GRAVITY,
    friction: str = "dry",
    limits: str | None = None,
    free: Sequence[str] = (),
) -> Mechanism:
    """A mechanism of bodies, each attached to its parent, in minimal coordinates.

    Args:
        bodies: each a `Body`, after its parent. Bodies without a mass are frames only.
        motors: each a `Motor`. loops: `Connect`, `Weld` and `Couple`, constraints of the `System`. Redundant rows, such
            as the third row of a pin joint in a plane, are detected here and removed.
        markers: each a `Marker`, an additional frame.
        gravity: (3,), m/s^2; default: standard gravity, 9.80665 downwards. (A file read by `load` has 9.81.)
        friction: "dry": the set-valued friction of the joints (`System(friction=)`); or "ignore".
        limits: what happens at the ends of a `range`. "ignore": nothing; "stop": stiff springs with damping, with
            stop_stiffness and stop_damping in params; "event": impacts (`Mechanism.events`). None is allowed only if no
            joint has a range.
        free: ("position",) puts the positions of bodies into params. Otherwise they are part of the program, which is
            faster because it knows their zeros.

    Returns:
        A `Mechanism`.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; names that are unknown, or used twice; loops that
            cannot be closed; without loops, joints that can move without moving a mass.

    Example: a crane with a trolley (2 kg) and a rod (1 kg, 1 m).

    >>> import numpy as np, hhtjax
    >>> from hhtjax.bodies import Body, Joint, tree
    >>> crane = tree([
    ...     Body("trolley", joints=Joint("prismatic", axis=[1, 0, 0], damping=0.1), mass=2.0),
    ...     Body("rod", "trolley", Joint("revolute", axis=[0, 1, 0]), mass=1.0, com=[0, 0, -0.5],
    ...          inertia=[1 / 12, 1 / 12, 0])])
    >>> run = hhtjax.simulate(
    ...     crane.system, hhtjax.hht(), np.array([0.0, 0.5]), crane.v0, crane.params, dt=1e-2, num_steps=100)
    >>> run.q.shape, crane.frames(run.q[-1])["rod"].x.shape
    ((101, 2), (3,))
    """
    return assembled("tree", bodies, motors, loops, markers, gravity, friction, limits, free)


def assembled(*parts: Any) -> Mechanism:
    """The mechanism of `_assembled`, from concrete numbers, also while a caller is being traced."""
    with jax.ensure_compile_time_eval() if is_tracing() else nullcontext():
        return _assembled(*parts)


def _assembled(caller, bodies, motors, loops, markers, gravity, friction, limits, free, unsupported=()) -> Mechanism:
    """The mechanism; `caller` is the public function, for errors."""
    bodies = _all_of(caller, "bodies", bodies, Body)
    motors, markers = _all_of(caller, "motors", motors, Motor), _all_of(caller, "markers", markers, Marker)
    loops = _all_of(caller, "loops", loops, (Connect, Weld, Couple))
    require_one_of(caller, "friction", friction, ("dry", "ignore"))
    require_one_of(caller, "limits", limits, (None, "ignore", "stop", "event"))
    if set(free) - {"position"}:
        raise ValueError(f'{caller}: `free` may hold "position"; received {free!r}.')
    parts = structure(caller, bodies)
    if not parts.nodes:
        raise ValueError(f"{caller}: `bodies` must have at least one joint; received {len(bodies)} bodies without.")
    massive = [body for body in bodies if body.mass > 0 and parts.node_of[body.name] >= 0]
    massive.sort(key=lambda body: parts.node_of[body.name])
    if not massive:
        raise ValueError(f"{caller}: at least one of the moving `bodies` must have a mass; none has.")
    links = sorted({parts.node_of[body.name] for body in massive})
    own = Tree(tuple(parts.nodes), tuple(links))
    places = _places(caller, parts, bodies, markers)
    by_name = {place.name: place for place in places}
    rubs = friction == "dry"
    rubbing = tuple(i for made in parts.joints.values() if rubs and made.joint.friction for i in made.rates)
    ordered = massive + [body for body in bodies if body.mass == 0 or parts.node_of[body.name] < 0]
    springs = _springs(parts)
    stops = _stops(parts)
    if stops and limits is None:
        raise ValueError(f'{caller}: joints have a `range`: give limits="stop", "event" or "ignore"; received None.')
    stops = () if limits == "ignore" else stops
    model = Model(
        own,
        tuple(by_name[body.name] for body in massive),
        tuple(places),
        tuple(_drive(caller, parts, motor) for motor in motors),
        tuple(springs),
        rubbing,
        stops if limits == "stop" else (),
        tuple(_row(caller, parts, list(by_name), loop) for loop in loops),
        None,
        _roots(parts.nodes),
        _affine_maps(caller, bodies, markers, ordered) if free else None,
        tuple([-1] + [list(by_name).index(x.parent if isinstance(x, Body) else x.body) for x in [*bodies, *markers]]),
    )
    params = _params(caller, model, parts, bodies, motors, gravity, rubbing)
    params |= {"spring_stiffness": _array(list(springs.values()))} if springs else {}
    params |= {"position": _array([body.position for body in ordered])} if free else {}
    q0 = _at_rest(model, parts, bodies)
    v0 = as_rates(own, jnp.zeros(own.rates, params["mass"].dtype))
    if model.stops:
        M = numpy_mass_matrix(model, jax.tree.map(np.asarray, q0), params)
        diagonal = np.diag(M)[own.rates - own.scalars :]
        at = np.array([stop.slot for stop in model.stops])
        params["stop_stiffness"] = _array(diagonal[at] * (np.pi / STOP_TIME) ** 2)
        params["stop_damping"] = _array(np.ones(len(at)))
    if limits == "event" and stops:
        params["restitution"] = _array(RESTITUTION)
    if model.loops:
        model, q0 = _closed(caller, model, q0, v0, params)
        _require_inertia_of_friction(caller, model, parts, q0, params)
    else:
        _require_inertia(caller, model, parts, q0, params)
    if free and model.rows is not None:
        raise NotImplementedError(
            f'{caller}: free=("position",) is not supported for loops with redundant rows, because other positions may '
            "make these rows independent."
        )
    ends = tuple(Event(Reaches(model, stop), impact("restitution")) for stop in stops) if limits == "event" else ()
    names = tuple(motor.name or motor.joint for motor in motors)
    return Mechanism(
        _system(model), params, q0, v0, _activations(model), ends or None,
        tuple(parts.joints), tuple(place.name for place in model.bodies),
        names, tuple(names[i] for i in model.activated), tuple(by_name), rubbing, tuple(unsupported), model,
        {name: made.rates for name, made in parts.joints.items()},
    )  # fmt: skip


def _system(model: Model) -> System:
    """The system; without loops it has no constraint, and without dry friction no friction."""
    more: dict = {"constraint": Loops(model)} if model.loops else {}
    if model.rubbing:
        more["friction"] = Friction(model)
        if not all_rub(model):
            more["sliding"] = Sliding(model)
    if model.activated:
        return System(Mass(model), dynamics=ActivatedDynamics(model), internal=Activation(model), **more)
    return System(Mass(model), dynamics=Dynamics(model), **more)


def _activations(model: Model) -> Array | None:
    """z0: 0, or the nearest end of the range."""
    ranges = [model.drives[i].actrange or (-np.inf, np.inf) for i in model.activated]
    return _array([min(max(0.0, low), high) for low, high in ranges]) if ranges else None


def _array(x) -> Array:
    return jnp.asarray(np.asarray(x, float), jnp.result_type(float))


def _all_of(caller: str, name: str, values: Any, kind: Any) -> list:
    if not isinstance(values, (list, tuple)) or not all(isinstance(x, kind) for x in values):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        words = " or ".join(k.__name__ for k in kinds)
        raise TypeError(f"{caller}: `{name}` must be a sequence of {words}; received {values!r}.")
    return list(values)


def _places(caller: str, parts: Structure, bodies: list[Body], markers: list[Marker]) -> list[Place]:
    """Frames of bodies and markers, relative to their nodes."""
    found = [Place(WORLD, -1, tuple(np.eye(3).ravel().tolist()), (0.0, 0.0, 0.0))]
    for body in bodies:
        R, x = parts.frame_of[body.name]
        found.append(Place(body.name, parts.node_of[body.name], tuple(R.ravel().tolist()), tuple(x.tolist())))
    for marker in markers:
        if marker.name in [place.name for place in found]:
            raise ValueError(f"{caller}: two frames are named {marker.name!r}.")
        _known(caller, "markers", marker.body, parts.node_of)
        R, x = parts.frame_of[marker.body]
        E, d = R @ np.reshape(marker.rotation, (3, 3)), x + R @ np.asarray(marker.position)
        found.append(Place(marker.name, parts.node_of[marker.body], tuple(E.ravel().tolist()), tuple(d.tolist())))
    return found


def _known(caller: str, name: str, value: str, known):
    if value not in known:
        raise ValueError(f"{caller}: `{name}` names {value!r}, which is unknown; there are {', '.join(known)}.")


def _roots(nodes) -> tuple:
    """For each node, the slot of the translation at the root of its tree, or -1."""
    found: list[int] = []
    for node in nodes:
        found.append(node.slot if node.kind == "translation" else found[node.parent] if node.parent >= 0 else -1)
    return tuple(found)


def _drive(caller: str, parts: Structure, motor: Motor) -> Drive:
    _known(caller, "motors", motor.joint, parts.slots)
    return Drive(
        parts.slots[motor.joint], motor.kind, motor.ctrlrange, motor.forcerange, motor.activation, motor.actrange
    )


def _stops(parts: Structure) -> tuple:
    return tuple(
        Stop(parts.slots[name], side, end)
        for name, made in parts.joints.items()
        if made.joint.range is not None
        for side, end in zip((-1, 1), made.joint.range, strict=True)
    )


def _springs(parts: Structure) -> dict[Spring, float]:
    """The springs of balls and free joints, and their stiffness."""
    found = {}
    for joint, body, (ball, *ways) in parts.joints.values():
        if joint.kind in ("ball", "free") and joint.stiffness:
            R = body.rotation if joint.kind == "free" else tuple(np.eye(3).ravel().tolist())
            found[Spring(ball.slot, ways[0].slot if ways else None, R, body.position)] = joint.stiffness
    return found


def _row(caller: str, parts: Structure, names: list, loop) -> Row:
    """A loop with names replaced by indices."""
    if isinstance(loop, Couple):
        for name in (loop.first, loop.second):
            if name is not None:
                _known(caller, "loops", name, parts.slots)
        second = None if loop.second is None else parts.slots[loop.second]
        return Row("couple", parts.slots[loop.first], second, (loop.origins, loop.coefficients))
    for name in (loop.first, loop.second):
        _known(caller, "loops", name, names)
    first, second = (names.index(name) for name in (loop.first, loop.second))
    if isinstance(loop, Weld):
        return Row("weld", first, second, (loop.anchor1, loop.anchor2, loop.rotation))
    return Row("connect", first, second, (loop.anchor1, loop.anchor2))


def _params(caller: str, model: Model, parts: Structure, bodies, motors, gravity, rubbing: tuple) -> dict:
    """The params of a mechanism, from its description."""
    by_name = {body.name: body for body in bodies}
    own = [by_name[place.name] for place in model.bodies]
    tree = model.tree
    of_rates = {name: np.zeros(tree.rates) for name in ("damping", "armature", "friction", "stiffness", "rest")}
    for made in parts.joints.values():
        for name, values in of_rates.items():
            values[list(made.rates)] = getattr(made.joint, name)
    first = tree.rates - tree.scalars
    params = {
        "mass": _array([body.mass for body in own]),
        "com": _array([body.com for body in own]),
        "inertia": _array(np.reshape([body.inertia for body in own], (-1, 3, 3))),
        "gravity": _array(vector(caller, "gravity", gravity)),
        "damping": _array(of_rates["damping"]),
        "armature": _array(of_rates["armature"]),
        "stiffness": _array(of_rates["stiffness"][first:]),
        "springref": _array(of_rates["rest"][first:]),
    }
    if motors:
        for name in ("gear", "gain", "kp", "kv", "offset"):
            params[name] = _array([getattr(motor, name) for motor in motors])
        params["ctrl"] = _array(np.zeros(len(motors)))
    if any(motor.activation == "filter" for motor in motors):
        params["timeconst"] = _array([1.0 if motor.timeconst is None else motor.timeconst for motor in motors])
    if rubbing:
        params["frictionloss"] = _array(of_rates["friction"][list(rubbing)])
    return params


def _at_rest(model: Model, parts: Structure, bodies) -> PyTree:
    """The described position."""
    tree = model.tree
    joint = np.zeros(tree.scalars)
    for name, slot in parts.slots.items():
        joint[slot] = parts.joints[name].joint.reference
    if not tree.balls:
        return _array(joint)
    free = [body for body in bodies if any(joint.kind == "free" for joint in body.joints)]
    found = {}
    if tree.balls > tree.frees:
        found["ball"] = _array(np.tile(np.eye(3), (tree.balls - tree.frees, 1, 1)))
    if free:
        R = np.reshape([body.rotation for body in free], (-1, 3, 3))
        found["free"] = {"R": _array(R), "x": _array([body.position for body in free])}
    if tree.scalars:
        found["joint"] = _array(joint)
    return found


def _require_inertia(caller: str, model: Model, parts: Structure, q0: PyTree, params: dict):
    """Raises an error that names joints that can move without moving a mass, at the start and elsewhere."""
    rng = np.random.default_rng(0)
    start = jax.tree.map(np.asarray, q0)
    elsewhere = jax.tree.map(lambda x: _turned(x, rng) if x.ndim == 3 else x + rng.normal(size=x.shape), start)
    if not _massless(numpy_mass_matrix(model, elsewhere, params)).any():
        return
    weak = _massless(numpy_mass_matrix(model, start, params))
    if weak.any():
        raise ValueError(
            f"{caller}: {_joints_of(parts, weak)} of `bodies` can move without moving a "
            "mass, so the mass matrix is singular: give the attached bodies mass and inertia, or the joint an "
            "`armature`."
        )


def _require_inertia_of_friction(caller: str, model: Model, parts: Structure, q0: PyTree, params: dict):
    """Raises an error that names joints with friction that move no mass. In a loop a joint may carry a body without
    mass; but friction stops a joint by its inertia."""
    weak = np.diagonal(numpy_mass_matrix(model, jax.tree.map(np.asarray, q0), params)) <= 0
    weak = weak & np.isin(np.arange(weak.size), model.rubbing)
    if weak.any():
        raise ValueError(
            f"{caller}: {_joints_of(parts, weak)} of `bodies` must move some inertia, since friction acts there; what "
            "it carries has neither mass nor inertia. Give the joint a small `armature`, such as 1e-5 kg m^2."
        )


def _joints_of(parts: Structure, rates: np.ndarray) -> str:
    """The joints with one of these rates, (nv,), by name."""
    names = [repr(name) for name, made in parts.joints.items() if rates[list(made.rates)].any()]
    return f"the joint{'s' * (len(names) > 1)} {', '.join(names)}"


def _massless(M: np.ndarray) -> np.ndarray:
    """Which rates take part in a motion that moves no mass: (nv,)."""
    scale = np.sqrt(np.diagonal(M))
    if not np.all(scale > 0):
        return scale == 0
    moments, ways = np.linalg.eigh(M / np.outer(scale, scale))
    return (np.abs(ways[:, 0]) > 0.1) & (moments[0] < SINGULAR)


def _turned(R: np.ndarray, rng) -> np.ndarray:
    """Random other rotations (n, 3, 3)."""
    return R @ np.reshape([of_quaternion(x) for x in rng.normal(size=(len(R), 4))], R.shape)


def _affine_maps(caller: str, bodies: list[Body], markers: list[Marker], ordered: list[Body]) -> tuple:
    """Positions of nodes, and of frames in them, as affine functions of the positions of all bodies, in the given
    order."""
    numbers = [ordered.index(body) for body in bodies]

    def at(positions: np.ndarray):
        moved = [body.placed_at(x) for body, x in zip(bodies, positions[numbers], strict=True)]
        parts = structure(caller, moved)
        places = _places(caller, parts, moved, markers)
        return np.array([n.offset for n in parts.nodes]), np.array([place.point for place in places])

    bases = at(np.zeros((len(bodies), 3)))
    moved = zip(*map(at, np.eye(3 * len(bodies)).reshape(-1, len(bodies), 3)), strict=True)
    slopes = [np.stack(x, axis=-1) - base[..., None] for x, base in zip(moved, bases, strict=True)]
    return tuple((_nested(b), _nested(s)) for b, s in zip(bases, slopes, strict=True))


def _nested(x: np.ndarray):
    return tuple(_nested(y) for y in x) if x.ndim else float(x)


# ----------------------------------------------------------------------------
# Loops


def _rows(model: Model) -> int:
    sizes = {"connect": 3, "weld": 6, "couple": 1}
    return sum(sizes[row.kind] for row in model.loops) if model.rows is None else len(model.rows)


def _closed(caller: str, model: Model, q0: PyTree, v0: PyTree, params: dict):
    """The model with only the independent rows of its loops near the start, and a position that closes the loops."""
    blocks, (q, unravel) = kinematics.layout(q0, v0), ravel_pytree(q0)
    loops = Loops(model)

    @jax.jit
    def linearized(q: Array):
        """Phi and B."""
        zero = jnp.zeros(model.tree.rates, q.dtype)

        def Phi(x: Array) -> Array:
            return loops(unravel(kinematics.move(blocks, q, x)), 0.0, params)

        return Phi(zero), jax.jacfwd(Phi)(zero)

    move = jax.jit(partial(kinematics.move, blocks))
    welded = jax.jit(lambda q: loops.turns(unravel(q), params))

    def turned_over(q: Array) -> bool:
        return bool(np.any(np.asarray(welded(q)) < 1)) if any(row.kind == "weld" for row in model.loops) else False

    with plain():  # small programs, compiled once
        drawn = q
        q, B = _onto_loops(caller, q, linearized, move, turned_over)
        if (moved := float(jnp.max(jnp.abs(q - drawn)))) > FAR:
            gap = float(jnp.max(jnp.abs(linearized(drawn)[0])))
            warnings.warn(
                f"{caller}: the described bodies leave the loops open by {gap:.2g} m or rad. To close them, joints "
                f"were moved by up to {moved:.2g} rad or m. If that is not intended, check `anchor1` and `anchor2`, "
                "and describe a position that is nearer.",
                stacklevel=5,
            )
        near = [B]
        for seed in (1, 2):  # at a special position more rows may depend on each other than elsewhere
            x = np.random.default_rng(seed).normal(size=B.shape[1])
            x = x - np.linalg.pinv(B, rcond=1e-9) @ (B @ x)  # along the loops
            size = np.linalg.norm(x)
            if size > 1e-9:
                near.append(
                    _onto_loops(caller, move(q, jnp.asarray(0.05 * x / size)), linearized, move, turned_over)[1]
                )
    rows = np.concatenate(near, axis=1)
    size = np.linalg.norm(rows, axis=1)
    able = np.flatnonzero(size > INDEPENDENT * size.max(initial=1e-300))
    if not able.size:
        raise ValueError(f"{caller}: `loops` constrain nothing that moves.")
    linalg: Any = import_module("scipy.linalg")  # when it is asked for: `import hhtjax` does without
    R, order = linalg.qr((rows[able] / size[able, None]).T, mode="r", pivoting=True)
    rank = int(np.sum(np.abs(np.diag(R)) > INDEPENDENT))
    kept = tuple(sorted(able[order[:rank]].tolist()))
    return model._replace(rows=None if len(kept) == len(rows) else kept), unravel(q)


def _onto_loops(caller: str, q: Array, linearized, move, turned_over):
    """The position nearest to q that closes the loops, and B there, by Gauss-Newton."""
    for _ in range(50):
        Phi, B = map(np.asarray, linearized(q))
        if np.max(np.abs(Phi)) <= 1e-12:
            break
        q = move(q, jnp.asarray(-np.linalg.pinv(B, rcond=1e-9) @ Phi, q.dtype))
    if turned_over(q):
        raise ValueError(
            f"{caller}: a weld of `loops` would close with an error of half a turn: describe a position that is nearer."
        )
    if not np.max(np.abs(Phi)) <= 1e-6:
        raise ValueError(
            f"{caller}: the loops cannot be closed from the described position: {np.max(np.abs(Phi)):.3g} m or "
            "rad is left. Describe a position that is nearer, by `position` and `rotation` of the bodies. Bars that "
            "lie in one line cannot leave it."
        )
    return q, B
