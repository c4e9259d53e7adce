"""Functions of a mechanism, for use without a run: joint torques, M, frames, forces, the regressor."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.bodies.arguments import require_activations, require_params, require_position, require_rates
from hhtjax.bodies.equations import (
    Frame,
    Mass,
    as_rates,
    inertia_of,
    of_links,
    of_motors,
    offsets_of,
    position,
    rates,
    second_moment,
)
from hhtjax.bodies.equations import applied as applied_forces
from hhtjax.bodies.mechanism import Mechanism
from hhtjax.bodies.newton_euler import Inertia, outer, plain_inverse_dynamics
from hhtjax.bodies.newton_euler import inverse_dynamics as of_tree
from hhtjax.description import Array, PyTree, Real

UPPER = (0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)  # entries of a tensor, as in theta


def _known(caller: str, robot: Mechanism, params: PyTree, q: PyTree, **rates_given: PyTree):
    """The model and the params, after checking all arguments."""
    if not isinstance(robot, Mechanism):
        raise TypeError(f"{caller}: `robot` must be a Mechanism, by `tree` or `load`; received {type(robot).__name__}.")
    params = robot.params if params is None else params
    require_params(robot.model, params)
    require_position(robot.model.tree, q)
    for name, value in rates_given.items():
        require_rates(robot.model.tree, name, value)
    return robot.model, params


def inverse_dynamics(robot: Mechanism, q: PyTree, v: PyTree, w: PyTree, params: PyTree = None) -> PyTree:
    """The joint torques needed for the accelerations w: M(q) w + bias(q, v).

    They include armature and gravity, and no other forces.

    Args: robot: a `Mechanism`. q, v, w: as in its system. params: None for `robot.params`.
    Returns: structured like v, N m and N.
    Raises: KeyError: params without an entry. TypeError, ValueError: not a mechanism; an array of another shape.

    >>> from hhtjax.bodies import Body, Joint, inverse_dynamics, tree
    >>> rod = tree([Body("rod", joints=Joint(axis=[0, 1, 0]), mass=3.0, com=[0.5, 0, 0], inertia=[0, 0.25, 0.25])])
    >>> inverse_dynamics(rod, jnp.zeros(1), jnp.zeros(1), jnp.ones(1)).round(4).tolist()            # m l^2/3 - m g l/2
    [-13.71]
    """
    model, params = _known("inverse_dynamics", robot, params, q, v=v, w=w)
    tree, dw = model.tree, rates(robot.model.tree, w)
    r = of_tree(
        tree,
        position(tree, q),
        rates(tree, v),
        dw,
        inertia_of(model, params),
        params["gravity"],
        offsets_of(model, params),
    )
    return as_rates(tree, r + params["armature"] * dw)


def mass_matrix(robot: Mechanism, q: PyTree, params: PyTree = None) -> Array:
    """M(q), (nv, nv), with the armature; rows in the order of `jax.flatten_util.ravel_pytree(v)`.

    Args: robot: a `Mechanism`. q: as in its system. params: None for `robot.params`.
    Returns: (nv, nv).
    Raises: KeyError: params without an entry. TypeError, ValueError: not a mechanism; an array of another shape.

    >>> from hhtjax.bodies import Body, Joint, mass_matrix, tree
    >>> rod = tree([Body("rod", joints=Joint(axis=[0, 1, 0]), mass=3.0, com=[0.5, 0, 0], inertia=[0, 0.25, 0.25])])
    >>> mass_matrix(rod, jnp.zeros(1)).round(6).tolist()                                                     # m l^2/3
    [[1.0]]
    """
    model, params = _known("mass_matrix", robot, params, q)
    return Mass(model)(q, params)


def frames(robot: Mechanism, q: PyTree, params: PyTree = None) -> dict[str, Frame]:
    """The frame of each body and marker in the world: `Mechanism.frames`.

    Args: robot: a `Mechanism`. q: as in its system. params: None for `robot.params`.
    Returns: a dict, {name: Frame(R, x)}.
    Raises: KeyError: params without an entry. TypeError, ValueError: not a mechanism; an array of another shape.

    >>> from hhtjax.bodies import Body, Joint, frames, tree
    >>> rod = Body("rod", joints=Joint(axis=[0, 1, 0]), mass=3.0, com=[0.5, 0, 0], position=[0, 0, 2])
    >>> frames(tree([rod]), jnp.zeros(1))["rod"].x.tolist()
    [0.0, 0.0, 2.0]
    """
    _known("frames", robot, params, q)
    return robot.frames(q, params)


def forces(
    robot: Mechanism, q: PyTree, v: PyTree, t: Real = 0.0, params: PyTree = None, z: Array | None = None
) -> PyTree:
    """Generalised forces of springs, dampers, motors, stops and external loads, without gravity and friction.

    Args: robot: a `Mechanism`. q, v: as in its system. t: s. params: None for `robot.params`. z: activations, None for
    z0.
    Returns: structured like v.
    Raises: KeyError: params without an entry. TypeError, ValueError: not a mechanism; an array of another shape; a
    wrench on an unknown body.

    >>> from hhtjax.bodies import Body, Joint, forces, tree
    >>> rod = tree([Body("rod", joints=Joint(axis=[0, 1, 0], damping=0.2), mass=3.0, com=[0.5, 0, 0])])
    >>> forces(rod, jnp.zeros(1), jnp.ones(1)).tolist()
    [-0.2]
    """
    model, params = _known("forces", robot, params, q, v=v)
    z = robot.z0 if z is None else z
    require_activations(model, z)
    p = position(model.tree, q)
    return as_rates(model.tree, applied_forces(model, q, p, rates(model.tree, v), z, t, params))


def motor_forces(
    robot: Mechanism, q: PyTree, v: PyTree, t: Real = 0.0, params: PyTree = None, z: Array | None = None
) -> Array:
    """The torque, N m, or force, N, of each motor on its joint: gear F, with F of `Motor`, within its `forcerange`.

    Along a run: `jax.vmap(lambda q, v, t: motor_forces(robot, q, v, t, params))(run.q, run.v, run.t)`.

    Args: robot: a `Mechanism`. q, v: as in its system. t: s. params: None for `robot.params`. z: activations, None for
    z0.
    Returns: (na,), in the order of `Mechanism.motors`.
    Raises: KeyError: params without an entry. TypeError, ValueError: not a mechanism; an array of another shape.

    >>> from hhtjax.bodies import Body, Joint, Motor, motor_forces, tree
    >>> rod = Body("rod", joints=Joint(axis=[0, 1, 0]), mass=3.0, com=[0.5, 0, 0])
    >>> robot = tree([rod], motors=[Motor("rod", "position", kp=100.0, kv=5.0)])
    >>> params = robot.params | {"ctrl": jnp.array([0.3])}
    >>> motor_forces(robot, jnp.array([0.2]), jnp.ones(1), params=params).round(3).tolist()
    [5.0]
    """
    model, params = _known("motor_forces", robot, params, q, v=v)
    z = robot.z0 if z is None else z
    require_activations(model, z)
    if not model.drives:
        return jnp.zeros(0, params["mass"].dtype)
    rate = rates(model.tree, v)
    return of_motors(model, position(model.tree, q).x, rate[model.tree.rates - model.tree.scalars :], z, t, params)


def regressor(robot: Mechanism, q: PyTree, v: PyTree, w: PyTree, params: PyTree = None) -> Array:
    """Y (nv, 10 nb) with inverse_dynamics - armature w = Y theta, linear in theta (10 nb,). theta has ten numbers per
    body,

        m, m c (3), and Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the origin of the frame of the body

    (Atkeson, An, Hollerbach, Int. J. Robot. Res. 5(3), 1986). `inertial_parameters` returns theta.

    Args: robot: a `Mechanism`. q, v, w: as in its system. params: for gravity and free positions, None for
    `robot.params`.
    Returns: (nv, 10 nb), bodies in the order of `Mechanism.bodies`.
    Raises: KeyError: params without an entry. TypeError, ValueError: not a mechanism; an array of another shape.

    >>> from hhtjax.bodies import Body, Joint, inertial_parameters, regressor, tree
    >>> rod = tree([Body("rod", joints=Joint(axis=[0, 1, 0]), mass=3.0, com=[0.5, 0, 0], inertia=[0, 0.25, 0.25])])
    >>> Y = regressor(rod, jnp.zeros(1), jnp.zeros(1), jnp.ones(1))
    >>> Y.shape, (Y @ inertial_parameters(rod.params)).round(2).tolist()                    # m l^2/3 - m g l/2
    ((1, 10), [-13.71])
    """
    model, params = _known("regressor", robot, params, q, v=v, w=w)
    tree, nb = model.tree, len(model.bodies)
    dv, dw, p = rates(tree, v), rates(tree, w), position(tree, q)

    def torque(theta: Array) -> Array:
        links = of_links(model, _moments(theta), params)
        return plain_inverse_dynamics(tree, p, dv, dw, links, params["gravity"], offsets_of(model, params))

    return jax.jacfwd(torque)(jnp.zeros(10 * nb, dv.dtype))


def inertial_parameters(params: PyTree) -> Array:
    """theta (10 nb,) of `regressor`, from mass, com and inertia.

    Args: params: those of a `Mechanism`.
    Returns: (10 nb,).
    Raises: KeyError: params without an entry. TypeError, ValueError: not a mechanism; an array of another shape.

    >>> import jax.numpy as jnp
    >>> params = {"mass": jnp.array([2.0]), "com": jnp.array([[0.1, 0, 0]]), "inertia": jnp.eye(3)[None]}
    >>> inertial_parameters(params).round(3).tolist()
    [2.0, 0.2, 0.0, 0.0, 1.0, 1.02, 1.02, 0.0, 0.0, 0.0]
    """
    m, c, inertia = params["mass"], params["com"], params["inertia"]
    h = m[:, None] * c
    squares = jnp.sum(c**2, axis=-1)[:, None, None] * np.eye(3, dtype=m.dtype)[None]
    about = inertia + m[:, None, None] * (squares - outer(c, c))
    upper = jnp.stack([about[:, i, j] for i, j in UPPER], axis=-1)
    return jnp.concatenate([m[:, None], h, upper], axis=-1).ravel()


def _moments(theta: Array) -> Inertia:
    """Mass, first and second moments of bodies about the origins of their frames, from theta."""
    m, h, upper = jnp.split(theta.reshape(-1, 10), [1, 4], axis=-1)
    places = np.zeros((6, 3, 3), theta.dtype)
    for k, (i, j) in enumerate(UPPER):
        places[k, i, j] = places[k, j, i] = 1
    return Inertia(m[:, 0], h, second_moment(jnp.sum(upper[:, :, None, None] * places[None], axis=1)))
