"""The equations of motion of a mechanism, as the functions of a `System`: dynamics, mass, friction, loops, stops.

    r(q, v, w, t) = ID(q, v, w) + armature w + damping v + stiffness (q - springref)
                    - motors - torque - wrenches - stops

and zdot of the motors that have an activation z.

Each is a frozen object that holds the model, so that equal mechanisms share compiled programs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax import rotation
from hhtjax.bodies.arguments import require_params, require_position, require_rates, require_shape
from hhtjax.bodies.model import Model, Row, Stop
from hhtjax.bodies.newton_euler import (
    Inertia,
    Placed,
    Position,
    apply,
    axial,
    cross,
    inverse_dynamics,
    mass_matrix,
    outer,
    place,
    product,
    total,
    trace,
)
from hhtjax.bodies.tree import Tree
from hhtjax.description import Array, PyTree, Real

DRAWN_BACK = 1e-3  # s, the time constant by which an activation beyond its range comes back


class Frame(NamedTuple):
    """A frame in the world.

    Attributes:
        R: (3, 3), from its components to those of the world.
        x: (3,), its origin, m.
    """

    R: Array
    x: Array


# ----------------------------------------------------------------------------
# Coordinates: an array of hinges and slides, or a dict of "ball", "free" and "joint". Rates in the order of
# `jax.flatten_util.ravel_pytree`: balls, rotations of free joints, their places, hinges and slides.


def position(tree: Tree, q: PyTree) -> Position:
    """The coordinates of a tree, by kind."""
    if not tree.balls:
        dtype = q.dtype
        return Position(q, jnp.zeros((0, 3, 3), dtype), jnp.zeros((0, 3), dtype))
    some = jax.tree.leaves(q)[0]
    free = q.get("free", {"R": some[:0].reshape(0, 3, 3), "x": some[:0].reshape(0, 3)})
    balls = [q["ball"]] if "ball" in q else []
    R = jnp.concatenate([*balls, free["R"]]) if balls and tree.frees else (balls or [free["R"]])[0]
    return Position(q.get("joint", jnp.zeros(0, some.dtype)), R, free["x"])


def rates(tree: Tree, v: PyTree) -> Array:
    """v as a vector (nv,)."""
    if not tree.balls:
        return v
    parts = [v[name] for name in ("ball",) if name in v]
    parts += [v["free"][name] for name in ("R", "x")] if "free" in v else []
    return jnp.concatenate([x.ravel() for x in [*parts, *([v["joint"]] if "joint" in v else [])]])


def as_rates(tree: Tree, x: Array) -> PyTree:
    """A vector (nv,) as a pytree structured like v."""
    if not tree.balls:
        return x
    n, f = tree.balls - tree.frees, tree.frees
    found, at = {}, 3 * n
    if n:
        found["ball"] = x[:at].reshape(n, 3)
    if f:
        found["free"] = {"R": x[at : at + 3 * f].reshape(f, 3), "x": x[at + 3 * f : at + 6 * f].reshape(f, 3)}
    if tree.scalars:
        found["joint"] = x[at + 6 * f :]
    return found


# ----------------------------------------------------------------------------
# What params say


def inertia_of(model: Model, params: PyTree) -> Inertia:
    """Mass, first and second moment of each link about its frame, from mass, com and inertia of the bodies on it."""
    m, c = params["mass"], params["com"]
    h = m[:, None] * c
    return of_links(model, Inertia(m, h, second_moment(params["inertia"]) + outer(h, c)), params)


def second_moment(inertia: Array) -> Array:
    """Sigma = tr(I)/2 1 - I, for tensors of inertia I (..., 3, 3).

    It uses the symmetric part of I, so the derivatives in I_ij and I_ji are equal, and a fit keeps I symmetric.
    """
    inertia = (inertia + jnp.swapaxes(inertia, -1, -2)) / 2
    return trace(inertia)[..., None] / 2 * np.broadcast_to(np.eye(3, dtype=inertia.dtype), inertia.shape) - inertia


def of_links(model: Model, bodies: Inertia, params: PyTree) -> Inertia:
    """The moments of the links about their frames, which are linear in those of the bodies they carry."""
    m, h, Sigma = bodies
    dtype = h.dtype
    R, x = (np.stack(both).astype(dtype) for both in zip(*((b.R, b.point) for b in model.bodies), strict=True))
    if np.any(np.eye(3, dtype=dtype)[None] != R):
        h, Sigma = apply(R, h), product(product(R, Sigma), np.swapaxes(R, 1, 2))
    points = places_of(model, params)
    if points is not None:
        x = jnp.stack([points[i] for i in _numbers_of_bodies(model)])
    if points is not None or np.any(x):
        moved = h + m[:, None] * x
        Sigma, h = Sigma + outer(x, h) + outer(moved, x), moved
    nodes = [b.node for b in model.bodies]
    if nodes == list(model.tree.links):
        return Inertia(m, h, Sigma)
    on = np.array([[node == link for node in nodes] for link in model.tree.links])
    return Inertia(*(total(on, y.reshape(len(y), -1)).reshape(-1, *y.shape[1:]) for y in (m, h, Sigma)))


def _numbers_of_bodies(model: Model):
    names = [place.name for place in model.places]
    return [names.index(body.name) for body in model.bodies]


def offsets_of(model: Model, params: PyTree):
    """Positions of the nodes, (K, 3), if positions are free; else None."""
    if model.offsets is None:
        return None
    return _affine(model.offsets[0], params["position"])


def places_of(model: Model, params: PyTree):
    """Origins of bodies and markers in their nodes, if positions are free; else None."""
    return None if model.offsets is None else _affine(model.offsets[1], params["position"])


def _affine(known: tuple, x: Array) -> Array:
    constant, slope = (np.asarray(y, x.dtype) for y in known)
    return jnp.asarray(constant) + (slope.reshape(-1, x.size) @ x.ravel()).reshape(-1, 3)


# ----------------------------------------------------------------------------
# Places


def frames_of(model: Model, q: PyTree, params: PyTree) -> list[Frame]:
    """The frames of all bodies and markers, in the world."""
    p = position(model.tree, q)
    placed, dtype = place(model.tree, p, offsets_of(model, params)), jax.tree.leaves(q)[0].dtype
    points = places_of(model, params)
    return [
        _in_world(
            model, placed, p.y, one.node, one.R, np.asarray(one.point, dtype) if points is None else points[i], dtype
        )
        for i, one in enumerate(model.places)
    ]


def _in_world(model: Model, placed: Placed, y: Array, node: int, R: np.ndarray, x, dtype) -> Frame:
    R = R.astype(dtype)
    if node < 0:
        return Frame(jnp.asarray(R), jnp.asarray(x))
    above, origin, root = placed.R[node], placed.y[node], model.roots[node]
    origin = origin if root < 0 else origin + y[root]
    return Frame(product(above, R), origin + apply(above, x))


# ----------------------------------------------------------------------------
# Functions of the system


@dataclass(frozen=True)
class Dynamics:
    """r(q, v, w, t, params), structured like v."""

    model: Model
    is_affine = True  # in w

    def __call__(self, q: PyTree, v: PyTree, w: PyTree, t: Real, params: PyTree) -> PyTree:
        return residual(self.model, q, v, w, None, t, params)


@dataclass(frozen=True)
class ActivatedDynamics:
    """r(q, v, w, z, t, params), structured like v, if motors have an activation z."""

    model: Model
    is_affine = True

    def __call__(self, q: PyTree, v: PyTree, w: PyTree, z: Array, t: Real, params: PyTree) -> PyTree:
        return residual(self.model, q, v, w, z, t, params)


def residual(model: Model, q: PyTree, v: PyTree, w: PyTree, z: Array | None, t: Real, params: PyTree) -> PyTree:
    """The residual r of `Dynamics` and `ActivatedDynamics`."""
    tree = model.tree
    require_params(model, params)
    require_position(tree, q)
    for name, x in (("v", v), ("w", w)):
        require_rates(tree, name, x)
    dv, dw = rates(tree, v), rates(tree, w)
    p = position(tree, q)
    r = inverse_dynamics(tree, p, dv, dw, inertia_of(model, params), params["gravity"], offsets_of(model, params))
    r = r + params["armature"] * dw
    return as_rates(tree, r - applied(model, q, p, dv, z, t, params))


@dataclass(frozen=True)
class Activation:
    """zdot, (nz,)."""

    model: Model

    def __call__(self, q: PyTree, v: PyTree, z: Array, t: Real, params: PyTree) -> Array:
        numbers = np.array(self.model.activated)
        drives = [self.model.drives[i] for i in numbers]
        u = inputs(self.model, z.dtype, t, params)[numbers]
        filters = np.array([drive.activation == "filter" for drive in drives])
        rate = u
        if filters.any():
            rate = jnp.where(filters, (u - z) / params["timeconst"][numbers], u)
        return rate - (z - _clipped(z, [drive.actrange for drive in drives])) / DRAWN_BACK


@dataclass(frozen=True)
class Mass:
    """M(q), (nv, nv), with the armature."""

    model: Model

    def __call__(self, q: PyTree, params: PyTree) -> Array:
        tree = self.model.tree
        require_params(self.model, params)
        require_position(tree, q)
        M = mass_matrix(tree, position(tree, q), inertia_of(self.model, params), offsets_of(self.model, params))
        return M + params["armature"][:, None] * np.eye(tree.rates, dtype=M.dtype)


@dataclass(frozen=True)
class Friction:
    """The limits of dry friction: structured like v if all rates have friction, else (k,), for those that do."""

    model: Model

    def __call__(self, q: PyTree, v: PyTree, *others: PyTree) -> PyTree:
        limits = others[-1]["frictionloss"]
        return as_rates(self.model.tree, limits) if all_rub(self.model) else limits


def all_rub(model: Model) -> bool:
    """Whether every rate has friction, in the order of the rates."""
    return list(model.rubbing) == list(range(model.tree.rates))


@dataclass(frozen=True)
class Sliding:
    """The rates with friction, (k,)."""

    model: Model

    def __call__(self, q: PyTree, v: PyTree, *others: PyTree) -> Array:
        return rates(self.model.tree, v)[np.asarray(self.model.rubbing)]


def applied(model: Model, q: PyTree, p: Position, v: Array, z: Array | None, t: Real, params: PyTree) -> Array:
    """Generalised forces of springs, dampers, motors, stops and external loads: (nv,)."""
    tree, n = model.tree, model.tree.rates - model.tree.scalars
    force = -params["damping"] * v
    x, rate = p.x, v[n:]
    along = -params["stiffness"] * (x - params["springref"])
    if model.drives:
        along = along + driven(model, x, rate, z, t, params)
    for k, stop in enumerate(model.stops):
        along = along.at[stop.slot].add(stopped(stop, x, rate, params["stop_stiffness"][k], params["stop_damping"][k]))
    force = force + (jnp.concatenate([jnp.zeros(n, v.dtype), along]) if n else along)
    for k, spring in enumerate(model.springs):
        force = sprung(model, spring, params["spring_stiffness"][k], p, force)
    if "torque" in params:
        torque = at_time(params["torque"], t)
        require_rates(tree, 'params["torque"]', torque)
        force = force + rates(tree, torque)
    if "wrench" in params:
        force = force + wrenches(model, q, t, params)
    return force


def at_time(x: PyTree, t: Real) -> PyTree:
    """The value of an input that is a function of time, or constant."""
    return x(t) if callable(x) else x


def inputs(model: Model, dtype: np.dtype, t: Real, params: PyTree) -> Array:
    """u of each motor, within its range: (na,)."""
    u = jnp.asarray(at_time(params["ctrl"], t), dtype)
    require_shape('params["ctrl"]', u, (len(model.drives),))  # what is no function has been looked at
    return _clipped(u, [drive.ctrlrange for drive in model.drives])


def driven(model: Model, x: Array, rate: Array, z: Array | None, t: Real, params: PyTree) -> Array:
    """The forces of all motors on hinges and slides: (ns,)."""
    F, slots = of_motors(model, x, rate, z, t, params), np.array([drive.slot for drive in model.drives])
    if slots.tolist() == list(range(len(x))):  # one on each
        return F
    return total(slots[None, :] == np.arange(len(x))[:, None], F[:, None])[:, 0]


def of_motors(model: Model, x: Array, rate: Array, z: Array | None, t: Real, params: PyTree) -> Array:
    """gear F of each motor: (na,)."""
    u = inputs(model, x.dtype, t, params)
    if z is not None:
        numbers = np.array(model.activated)
        within = _clipped(z, [model.drives[i].actrange for i in numbers])
        u = within if len(numbers) == len(u) else u.at[numbers].set(within)
    slots, gear = np.array([drive.slot for drive in model.drives]), params["gear"]
    one_each = slots.tolist() == list(range(len(x)))
    s, sdot = (gear * (y if one_each else y[slots]) for y in (x, rate))
    kinds = np.array([drive.kind for drive in model.drives])
    known = {name: (kinds == name).astype(x.dtype) for name in ("torque", "position", "velocity")}
    F = params["kp"] * (known["position"] * u - s) + params["kv"] * (known["velocity"] * u - sdot) + params["offset"]
    F = F + known["torque"] * params["gain"] * u
    return gear * _clipped(F, [drive.forcerange for drive in model.drives])


def _clipped(x: Array, ranges: list) -> Array:
    """x, clipped to the ranges that exist."""
    if not any(ranges):
        return x
    low, high = np.array([r or (-np.inf, np.inf) for r in ranges], x.dtype).T
    return jnp.clip(x, low, high)


def stopped(stop: Stop, x: Array, rate: Array, k: Real, d: Real) -> Array:
    """The force of a stop, k p (1 + d pdot) with the penetration p; it never pulls (Hunt, Crossley 1975)."""
    p = jnp.maximum(stop.side * (x[stop.slot] - stop.at), 0)
    return -stop.side * k * p * jnp.maximum(1 + d * stop.side * rate[stop.slot], 0)


def sprung(model: Model, spring, k: Real, p: Position, force: Array) -> Array:
    """Adds the spring of a ball or a free joint, against its rotation and translation from rest."""
    R = np.reshape(spring.R, (3, 3)).astype(force.dtype)
    turn = rotation.log(product(R.T, p.R[spring.ball]))
    first = 3 * spring.ball
    force = force.at[first : first + 3].add(-k * turn)
    if spring.translation is None:
        return force
    first = 3 * (model.tree.balls + spring.translation)
    return force.at[first : first + 3].add(-k * (p.y[spring.translation] - np.asarray(spring.x, force.dtype)))


def wrenches(model: Model, q: PyTree, t: Real, params: PyTree) -> Array:
    """The generalised force of moments and forces on bodies: {name: (6,), or a function of t}, in world axes."""
    p = position(model.tree, q)
    placed, points = place(model.tree, p, offsets_of(model, params)), places_of(model, params)
    force = jnp.zeros(model.tree.rates, placed.S.dtype)
    names = [one.name for one in model.places]
    for name, wrench in params["wrench"].items():
        if name not in names:
            raise ValueError(f'params["wrench"] must be on bodies or markers, {", ".join(names)}; received {name!r}.')
        i = names.index(name)
        one, wrench = model.places[i], jnp.asarray(at_time(wrench, t), force.dtype)
        require_shape(f'params["wrench"]["{name}"]', wrench, (6,))
        if one.node < 0:
            continue
        x = placed.y[one.node] + apply(
            placed.R[one.node], np.asarray(one.point, force.dtype) if points is None else points[i]
        )
        about_root = jnp.concatenate([wrench[:3] + cross(x, wrench[3:]), wrench[3:]])
        below = model.tree.carries[one.node].astype(force.dtype)
        force = force + below * jnp.sum(placed.S * about_root[None, :], axis=-1)
    return force


# ----------------------------------------------------------------------------
# Loops


@dataclass(frozen=True)
class Loops:
    """Phi(q, t, params), (m,)."""

    model: Model

    def __call__(self, q: PyTree, t: Real, params: PyTree) -> Array:
        frames = frames_of(self.model, q, params)
        x = position(self.model.tree, q).x
        Phi = jnp.concatenate([_gap(row, frames, x) for row in self.model.loops])
        return Phi if self.model.rows is None else Phi[np.asarray(self.model.rows)]

    def turns(self, q: PyTree, params: PyTree) -> Array:
        """For each weld, the trace of the rotation that is left to close it: 3 if it is closed, -1 half a turn away."""
        frames = frames_of(self.model, q, params)
        return jnp.stack([jnp.trace(_turn(row, frames)) for row in self.model.loops if row.kind == "weld"])


def _gap(row: Row, frames: list[Frame], x: Array) -> Array:
    """The closing error of a loop."""
    if row.kind == "couple":
        (r1, r2), coefficients = row.constants
        y = 0.0 * x[row.first] if row.second is None else x[row.second] - r2
        wanted = sum(c * y**k for k, c in enumerate(coefficients))
        return (x[row.first] - r1 - wanted)[None]
    a, b = (np.asarray(c, x.dtype) for c in row.constants[:2])
    first, second = (frames[i] for i in (row.first, row.second))
    apart = first.x + apply(first.R, a) - second.x - apply(second.R, b)
    if row.kind == "connect":
        return apart
    return jnp.concatenate([apart, axial(_turn(row, frames)) / 2])


def _turn(row: Row, frames: list[Frame]) -> Array:
    """The rotation that is left to close a weld, (3, 3)."""
    first, second = (frames[i].R for i in (row.first, row.second))
    between = np.reshape(row.constants[2], (3, 3)).astype(first.dtype)
    return product(jnp.swapaxes(product(first, between), 0, 1), second)


# ----------------------------------------------------------------------------
# Ends of ranges as events


@dataclass(frozen=True)
class Reaches:
    """The guard that falls to zero when a joint reaches an end of its range."""

    model: Model
    stop: Stop

    def __call__(self, q: PyTree, v: PyTree, *others: PyTree) -> Array:
        return self.stop.side * (self.stop.at - position(self.model.tree, q).x[self.stop.slot])
