"""Identification of robots from records of encoders and torques.

    physical_inertia        any ten numbers -> mass, centre of mass and inertia that are physically possible
    base_parameters         the combinations of inertial parameters that a motion can identify
    excitation              a periodic motion with a well conditioned regressor, found by gradients

First fit with `equation_error`, which needs no simulation. Then fit through the simulation, starting at this estimate.
An example, from a model file to a friction parameter with its confidence interval, is in `hhtjax.bodies`.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.bodies import Mechanism, regressor
from hhtjax.bodies.equations import second_moment
from hhtjax.checks import require_integer, require_number
from hhtjax.description import Array, Real, is_concrete
from hhtjax.description.presentation import shown

RANK = 1e-8  # of the largest singular value, below which a combination of parameters has no effect
NAMES = "m", "m cx", "m cy", "m cz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz"


def physical_inertia(theta: Array) -> dict[str, Array]:
    """Maps any ten numbers to a physically possible mass, centre of mass and inertia (log-Cholesky map).

        U = exp(alpha) [[exp(d1), s12, s13, t1], [0, exp(d2), s23, t2], [0, 0, exp(d3), t3], [0, 0, 0, 1]]
        U U^T = [[Sigma, m c], [m c^T, m]],    I = tr(Sigma_c) 1 - Sigma_c

    So m = exp(2 alpha) and c = t. With the upper triangular matrix A of the d and s, Sigma_c = m A A^T.

    Args:
        theta: (..., 10): alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3.

    Returns:
        A dict: mass (...,), kg; com (..., 3), m; inertia (..., 3, 3), about the centre of mass, kg m^2. These are
        entries of `Mechanism.params`.

    Raises: ValueError: theta of another shape.

    C. Rucker, P. Wensing, IEEE Robot. Autom. Lett. 7(2), 2022, 2684-2691.

    >>> import jax.numpy as jnp, hhtjax
    >>> body = hhtjax.identification.physical_inertia(jnp.zeros(10))
    >>> float(body["mass"]), body["inertia"].diagonal().tolist()
    (1.0, [2.0, 2.0, 2.0])
    """
    theta = jnp.asarray(theta)
    if theta.ndim == 0 or theta.shape[-1] != 10:
        raise ValueError(f"physical_inertia: `theta` must have shape (..., 10); received {theta.shape}.")
    alpha, d1, d2, d3, s12, s23, s13 = jnp.moveaxis(theta[..., :7], -1, 0)
    zero = jnp.zeros_like(d1)
    rows = [[jnp.exp(d1), s12, s13], [zero, jnp.exp(d2), s23], [zero, zero, jnp.exp(d3)]]
    A = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    m = jnp.exp(2 * alpha)
    Sigma = m[..., None, None] * jnp.sum(A[..., :, None, :] * A[..., None, :, :], axis=-1)
    trace = jnp.trace(Sigma, axis1=-2, axis2=-1)[..., None, None]
    return {
        "mass": m,
        "com": theta[..., 7:],
        "inertia": trace * np.broadcast_to(np.eye(3, dtype=m.dtype), Sigma.shape) - Sigma,
    }


def inertia_coordinates(mass: Real, com: Array, inertia: Array) -> Array:
    """The inverse of `physical_inertia`: theta (..., 10), for the initial guess of a fit.

    Args: mass: (...,), kg, > 0. com: (..., 3), m. inertia: (..., 3, 3), about the centre of mass, kg m^2.

    Returns:
        theta, (..., 10).

    Raises:
        ValueError: the mass is not positive, or the inertia is impossible for a body with an extent in all directions:
            one principal moment is as large as the sum of the others.

    >>> import jax.numpy as jnp, hhtjax
    >>> moments = jnp.diag(jnp.array([1.0, 2.0, 2.5]))
    >>> theta = hhtjax.identification.inertia_coordinates(2.0, jnp.array([0.1, 0.0, 0.0]), moments)
    >>> body = hhtjax.identification.physical_inertia(theta)
    >>> round(float(body["mass"]), 6), body["inertia"].diagonal().round(6).tolist()
    (2.0, [1.0, 2.0, 2.5])
    """
    m, com, inertia = (jnp.asarray(x, jnp.result_type(float)) for x in (mass, com, inertia))
    trace = jnp.trace(inertia, axis1=-2, axis2=-1)[..., None, None]
    Sigma = second_moment(inertia)
    if is_concrete(m) and is_concrete(Sigma):
        least = np.linalg.eigvalsh(np.asarray(Sigma))[..., 0]
        if np.any(np.asarray(m) <= 0) or np.any(least <= 1e-12 * np.asarray(trace)[..., 0, 0]):
            raise ValueError(
                "inertia_coordinates: `mass` must be positive, and each principal moment of `inertia` smaller than the "
                f"sum of the others; received mass {mass} and inertia {inertia}."
            )
    # an upper triangle: the lower one of the axes in reverse order
    A = jnp.linalg.cholesky((Sigma / m[..., None, None])[..., ::-1, ::-1])[..., ::-1, ::-1]
    d = jnp.log(jnp.diagonal(A, axis1=-2, axis2=-1))
    s = jnp.stack([A[..., 0, 1], A[..., 1, 2], A[..., 0, 2]], axis=-1)
    return jnp.concatenate([jnp.log(m)[..., None] / 2, d, s, com], axis=-1)


@shown
class BaseParameters(NamedTuple):
    """Result of `base_parameters`: the combinations of inertial parameters of a robot that motions can identify.

    Attributes:
        count: r, the number of independent combinations.
        independent: (r,), indices of r independent parameters among the 10 nb inertial parameters of nb bodies.
        names: names of these, such as "link2 m cx".
        combination: (r, 10 nb). The identifiable numbers are beta = combination theta. The columns of `independent`
            form an identity matrix.
        unseen: names of the parameters that have no effect on any motion.
        condition: condition number of the regressor of `independent`, with columns scaled to length 1.
    """

    count: int
    independent: np.ndarray
    names: tuple[str, ...]
    combination: np.ndarray
    unseen: tuple[str, ...]
    condition: float


def base_parameters(robot: Mechanism, *, samples: int = 200, motion: Any = None, seed: int = 0) -> BaseParameters:
    """Finds the combinations of inertial parameters that motions can identify, by the rank of the regressor.

    Args:
        robot: a `Mechanism`.
        samples: number of random states, used if no motion is given.
        motion: q, v, w, each with a leading axis of samples. The result is then for this motion instead of all motions.
        seed: seed of the random states.

    Returns:
        A `BaseParameters`.

    Raises: TypeError, ValueError: an argument of a wrong kind or value.

    M. Gautier, Numerical calculation of the base inertial parameters of robots, J. Robot. Syst. 8(4), 1991.

    >>> from hhtjax.bodies import Body, Joint, tree
    >>> import hhtjax
    >>> rod = tree([Body("rod", joints=Joint(axis=[0, 1, 0]), mass=3.0, com=[0.5, 0, 0], inertia=[0.1, 0.25, 0.25])])
    >>> hhtjax.identification.base_parameters(rod).names
    ('rod m cx', 'rod m cz', 'rod Iyy')
    """
    _require_robot("base_parameters", robot)
    require_integer("base_parameters", "samples", samples)
    q, v, w = _random_states(robot, samples, seed) if motion is None else motion
    Y = np.asarray(jax.jit(jax.vmap(lambda q, v, w: regressor(robot, q, v, w)))(q, v, w))
    Y = Y.reshape(-1, Y.shape[-1])
    names = [f"{body} {name}" for body in robot.bodies for name in NAMES]
    rank_tolerance = max(RANK, 100 * float(np.finfo(Y.dtype).eps))
    size = np.linalg.norm(Y, axis=0)
    seen = np.flatnonzero(size > rank_tolerance * size.max())
    order = seen[::-1]  # of equal ones, those of the tip
    linalg: Any = import_module("scipy.linalg")  # when it is asked for: `import hhtjax` does without
    R, pivots = linalg.qr(Y[:, order] / size[order], mode="r", pivoting=True)
    rank = int(np.sum(np.abs(np.diag(R)) > rank_tolerance * abs(R[0, 0])))
    independent = np.sort(order[pivots[:rank]])
    rest = np.setdiff1d(seen, independent)
    combination = np.zeros((rank, Y.shape[1]))
    combination[np.arange(rank), independent] = 1
    if rest.size:
        share = np.linalg.lstsq(Y[:, independent], Y[:, rest], rcond=None)[0]
        combination[:, rest] = np.where(np.abs(share) < 1e-9 * max(1.0, np.abs(share).max()), 0, share)
    condition = float(np.linalg.cond(Y[:, independent] / size[independent]))
    unseen = tuple(names[i] for i in np.setdiff1d(np.arange(Y.shape[1]), seen))
    return BaseParameters(rank, independent, tuple(names[i] for i in independent), combination, unseen, condition)


def _require_robot(caller: str, robot):
    if not isinstance(robot, Mechanism):
        raise TypeError(f"{caller}: `robot` must be a Mechanism, of bodies.tree or bodies.load; received {robot!r}.")
    if robot.model.loops:
        raise NotImplementedError(f"{caller}: `robot` has loops, so its joints cannot move independently.")


def _random_states(robot: Mechanism, samples: int, seed: int):
    """Random states: positions up to pi rad or m from q0, rates up to 2, accelerations up to 5, in SI units."""
    rng = np.random.default_rng(seed)
    tree = robot.model.tree
    if tree.balls:
        raise NotImplementedError("base_parameters: `motion` must be given for robots with ball or free joints.")
    q, v, w = rng.uniform(-1, 1, (3, samples, tree.rates))
    return np.asarray(robot.q0) + np.pi * q, 2 * v, 5 * w


class Fourier(NamedTuple):
    """A periodic motion, q(t) = centre + sum over k of (a_k sin(k w t) - b_k cos(k w t))/(k w), w = 2 pi/period.

    It is a pytree and can be put into params, as the set point of a controller. Call it with t.

    Attributes:
        centre: (n,). a, b: (K, n), rad/s or m/s. period: s.
    """

    centre: Array
    a: Array
    b: Array
    period: Array

    def __call__(self, t: Real) -> Array:
        """q(t), (n,)."""
        return self.motion(t)[0]

    def motion(self, t: Real):
        """q, v, w at t, (n,) each."""
        k = jnp.arange(1, len(self.a) + 1, dtype=self.a.dtype)[:, None] * (2 * jnp.pi / self.period)
        s, c = jnp.sin(k * t), jnp.cos(k * t)
        q = self.centre + jnp.sum((self.a * s - self.b * c) / k, axis=0)
        return q, jnp.sum(self.a * c + self.b * s, axis=0), jnp.sum(k * (self.b * c - self.a * s), axis=0)


@shown
class Excitation(NamedTuple):
    """Result of `excitation`: a motion for the identification of a robot.

    Attributes:
        trajectory: a `Fourier`; `trajectory(t)` is q.
        condition: condition number of the regressor of the identifiable parameters along it, with columns scaled to
            length 1.
        start: condition number for the random motion at which the search began.
        base: the `BaseParameters` of the robot.
    """

    trajectory: Fourier
    condition: float
    start: float
    base: BaseParameters


def excitation(
    robot: Mechanism,
    *,
    period: Real = 10.0,
    harmonics: int = 5,
    amplitude: Any = 1.0,
    speed: Any = 2.0,
    acceleration: Any = np.inf,
    centre: Any = None,
    samples: int = 100,
    iterations: int = 200,
    seed: int = 0,
) -> Excitation:
    """Finds a periodic motion of all joints whose regressor is large and well conditioned, by gradients (L-BFGS).

    The regressor Y along the motion maps parameters to torques. It has p columns y_j. The search minimises

        log cond(Y with columns scaled to one length) - (1/p) sum_j log |y_j|,

    plus a penalty for leaving the ranges. The first term makes the parameters distinguishable. The second makes their
    torques large compared with the noise; without it the motion would be slow and small.

    Args:
        robot: a `Mechanism` of hinges and slides.
        period: s. harmonics: K, number of harmonics of each joint.
        amplitude: largest distance from `centre`, rad or m; speed, acceleration: largest values; numbers or (n,).
        centre: (n,), None for q0.
        samples: number of samples of a period at which the regressor is evaluated.
        iterations: largest number of iterations of the search. seed: seed of its random start.

    Returns:
        An `Excitation`.

    Raises: TypeError, ValueError, NotImplementedError: an argument of a wrong kind or value; balls or free joints.

    J. Swevers, C. Ganseman, D. Tukel, J. De Schutter, H. Van Brussel, IEEE Trans. Robot. Autom. 13(5), 1997, 730-740.

    >>> from hhtjax.bodies import Body, Joint, tree
    >>> import hhtjax
    >>> rod = tree([Body("rod", joints=Joint(axis=[0, 1, 0]), mass=3.0, com=[0.5, 0, 0], inertia=[0.1, 0.25, 0.25])])
    >>> found = hhtjax.identification.excitation(rod, period=4.0, harmonics=3, iterations=20)
    >>> found.condition < found.start, found.trajectory(0.5).shape
    (True, (1,))
    """
    _require_robot("excitation", robot)
    for name, value in (("harmonics", harmonics), ("samples", samples), ("iterations", iterations)):
        require_integer("excitation", name, value)
    require_number("excitation", "period", period, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    base = base_parameters(robot)
    n = robot.model.tree.rates
    centre = jnp.asarray(robot.q0 if centre is None else centre, float)
    limits = [np.broadcast_to(np.asarray(x, float), (n,)) for x in (amplitude, speed, acceleration)]
    if not all(np.all(x > 0) for x in limits):
        raise ValueError("excitation: `amplitude`, `speed` and `acceleration` must be positive.")
    t = np.arange(samples) * (float(period) / samples)

    def trajectory(x: Real) -> Fourier:
        a, b = x.reshape(2, harmonics, n)
        return Fourier(centre, a, b, jnp.asarray(float(period)))

    def values(x: Real):
        """Singular values of the scaled regressor, mean log of its column lengths, and how far ranges are exceeded."""
        q, v, w = jax.vmap(trajectory(x).motion)(t)
        Y = jax.vmap(lambda q, v, w: regressor(robot, q, v, w))(q, v, w)[..., base.independent]
        Y = Y.reshape(-1, base.count)
        size = jnp.sqrt(jnp.sum(Y**2, axis=0))
        sigma = jnp.linalg.svd(Y / size[None, :], compute_uv=False)
        parts = [y / limit[None, :] for y, limit in zip((q - centre[None, :], v, w), limits, strict=True)]
        beyond = sum(jnp.mean(jnp.maximum(jnp.abs(y) - 0.97, 0) ** 2) for y in parts)
        return sigma, jnp.mean(jnp.log(size)), beyond

    def cost(x: Real):
        sigma, size, beyond = values(x)
        return jnp.log(sigma[0] / sigma[-1]) - size + 1e4 * beyond

    rng = np.random.default_rng(seed)
    x0 = rng.normal(size=2 * harmonics * n)

    def largest(x: np.ndarray) -> float:
        """Largest part of a range that the motion uses, at four times as many samples. It is linear in x."""
        q, v, w = jax.vmap(trajectory(x).motion)(np.arange(4 * samples) * (float(period) / samples / 4))
        moves = zip((q - centre[None, :], v, w), limits, strict=True)
        return max(float(np.max(np.abs(y) / limit[None, :])) for y, limit in moves)

    x0 = x0 / largest(x0) * 0.97  # inside all ranges
    value_and_grad = jax.jit(jax.value_and_grad(cost))
    optimize: Any = import_module("scipy.optimize")
    found = optimize.minimize(
        lambda x: tuple(np.asarray(y, float) for y in value_and_grad(x)), x0, jac=True, method="L-BFGS-B",
        options={"maxiter": iterations},
    )  # fmt: skip
    x = found.x / max(1.0, largest(found.x))
    start, end = (np.asarray(jax.jit(values)(x)[0]) for x in (x0, x))
    return Excitation(trajectory(jnp.asarray(x)), float(end[0] / end[-1]), float(start[0] / start[-1]), base)
