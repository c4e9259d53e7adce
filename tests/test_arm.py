"""The arm: two formulations of one model, closed forms of short chains, energy, order and gradients."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient
from mechanisms import random_inertia
from scipy.integrate import solve_ivp
from zoo import EVERY

import hhtjax
from hhtjax.bodies import Body, Joint, tree
from hhtjax.scenes import Scene, double_pendulum
from hhtjax.scenes.arm import Lagrangian, joint_torques, lagrange, swing
from hhtjax.systems.system import mass_at

DOWNWARD = [0.0, 1.0, 0.0]  # a positive angle about it lowers a link that points along x


def chain(axis, offset, mass, com, inertia, k, c, rest, gravity=(0.0, 0.0, -9.80665)):
    """An open chain in both formulations, and its params."""
    links = zip(axis, offset, mass, com, inertia, k, c, rest, strict=True)
    bodies = []
    for i, (a, x, m, centre, moments, stiffness, damping, angle) in enumerate(links):
        joint = Joint("revolute", a, name=f"{i}", stiffness=stiffness, damping=damping, rest=angle)
        bodies.append(Body(f"link{i}", f"link{i - 1}" if i else "world", joint, m, centre, moments, x))
    robot = tree(bodies, gravity=gravity)
    axes, offsets = (tuple(map(tuple, np.asarray(x, float).tolist())) for x in (axis, offset))
    by_autodiff = hhtjax.System.from_lagrangian(Lagrangian(axes, offsets), joint_torques)
    return {"newton_euler": robot.system, "lagrange": by_autodiff}, robot.params


def random_chain(n, seed):
    """Skew axes, eccentric links, full inertia tensors, springs, dampers, and oblique gravity."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(n, 3))
    return chain(
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        offset=rng.normal(size=(n, 3)),
        mass=rng.uniform(0.5, 2.0, n),
        com=rng.normal(size=(n, 3)),
        inertia=[random_inertia(rng) for _ in range(n)],
        k=rng.uniform(1.0, 5.0, n),
        c=rng.uniform(0.1, 0.5, n),
        rest=rng.normal(size=n),
        gravity=rng.normal(size=3),
    )


def states(n, number, seed=0):
    """Random q and v, (number, n)."""
    return jnp.asarray(np.random.default_rng(seed).normal(size=(2, number, n)))


def point_masses(m, lengths, **joints):
    """A planar chain of point masses m at the ends of massless links along x, in the x-z plane."""
    n, zeros = len(m), np.zeros(len(m))
    ends = np.stack([np.asarray(lengths), zeros, zeros], axis=1)
    return chain(
        axis=[joints.pop("axis")] * n,
        offset=np.concatenate([np.zeros((1, 3)), ends[:-1]]),
        mass=m,
        com=ends,
        inertia=np.zeros((n, 3, 3)),
        **({"k": zeros, "c": zeros, "rest": zeros} | joints),
    )


@partial(jax.jit, static_argnums=0)
def evaluate(system, q, v, params):
    return mass_at(system, q, 0.0, params), system.force(q, v, 0.0, params)


def kinetic_energy(systems, q, v, params):
    return v @ systems["newton_euler"].mass(q, params) @ v / 2


def potential_energy(systems, q, params):
    """Of gravity and of the springs."""
    gravity = -systems["lagrange"].mass.lagrangian(q, jnp.zeros_like(q), 0.0, params)
    return gravity + params["stiffness"] @ (q - params["springref"]) ** 2 / 2


def assert_equal_to_rounding(x, y):
    assert np.max(np.abs(x - y)) <= 1e-13 * np.max(np.abs(y))


@pytest.mark.slow
def test_formulations_agree():
    systems, params = random_chain(6, 1)
    q, v = states(6, 20)
    (M, Q), (M_by_autodiff, Q_by_autodiff) = (
        jax.vmap(partial(evaluate, system, params=params))(q, v) for system in systems.values()
    )
    assert_equal_to_rounding(M, M_by_autodiff)
    assert_equal_to_rounding(Q, Q_by_autodiff)


@pytest.mark.slow
def test_formulations_have_the_same_gradients():
    """In all params, and in the symmetric part of the inertias."""
    systems, params = random_chain(2, 2)
    names = ("mass", "com", "inertia", "gravity", "damping", "stiffness", "springref")
    (q, v), weight = states(2, 1)[:, 0], states(2, 2, seed=1)[0]

    def measure(system, some):
        own = {**params, **some}
        return jnp.sum(weight * mass_at(system, q, 0.0, own)) + weight[0] @ system.force(q, v, 0.0, own)

    some = {name: params[name] for name in names}
    by_hand, by_autodiff = (jax.jit(jax.grad(lambda p, s=s: measure(s, p)))(some) for s in systems.values())
    for name in names:
        x, y = by_hand[name], by_autodiff[name]
        if name == "inertia":
            x, y = (z + jnp.swapaxes(z, 1, 2) for z in (x, y))
        assert np.max(np.abs(y)) > 0.01
        assert_equal_to_rounding(x, y)


@pytest.mark.parametrize("name", ["newton_euler", "lagrange"])
def test_one_joint_is_the_physical_pendulum(name):
    """M = I + m r^2, Q = m g r cos q - k (q - rest) - c v."""
    m, r, inertia, k, c, rest, g = 2.0, 0.7, 0.3, 5.0, 0.4, 0.2, double_pendulum.GRAVITY
    systems, params = chain(
        [DOWNWARD], [[0.3, 0.2, 0.1]], [m], [[r, 0, 0]], [np.diag([0.1, inertia, 0.4])], [k], [c], [rest]
    )
    q, v = jnp.array([0.6]), jnp.array([-1.5])
    M, Q = evaluate(systems[name], q, v, params)
    assert float(M[0, 0]) == pytest.approx(inertia + m * r**2, rel=1e-14)
    assert float(Q[0]) == pytest.approx(m * g * r * np.cos(0.6) - k * 0.4 + c * 1.5, rel=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["newton_euler", "lagrange"])
def test_two_planar_joints_are_the_double_pendulum(name):
    """With relative angles: its own are those from the horizontal, (q1, q1 + q2)."""
    pendulum = {"m": (2.0, 1.0), "l": (1.0, 1.5), "k": (7.0, 3.0), "c": (0.4, 0.2), "g": double_pendulum.GRAVITY}
    upward = [0.0, -1.0, 0.0]
    systems, params = point_masses(pendulum["m"], pendulum["l"], k=pendulum["k"], c=pendulum["c"], axis=upward)
    q, v = jnp.array([0.4, -1.1]), jnp.array([1.3, 0.8])
    T = jnp.array([[1.0, 0.0], [1.0, 1.0]])
    M, Q = evaluate(systems[name], q, v, params)
    assert_equal_to_rounding(M, T.T @ double_pendulum.mass(T @ q, pendulum) @ T)
    assert_equal_to_rounding(Q, T.T @ double_pendulum.force(T @ q, T @ v, 0.0, pendulum))


def test_mass_is_symmetric_and_positive_definite():
    scene = swing()
    M = np.asarray(jax.jit(jax.vmap(scene.system.mass, (0, None)))(states(6, 20)[0], scene.params))
    np.testing.assert_array_equal(M, np.swapaxes(M, 1, 2))
    assert np.min(np.linalg.eigvalsh(M)) > 1e-3


def test_power_balance():
    """v.(Q + (dM/dt) v/2) is what gravity, springs and dampers do: the inertia forces themselves do no work."""
    systems, params = random_chain(5, 3)

    @jax.vmap
    def powers(q, v):
        _, rate = jax.jvp(lambda q: kinetic_energy(systems, q, v, params), (q,), (v,))
        _, potential = jax.jvp(lambda q: potential_energy(systems, q, params), (q,), (v,))
        return v @ systems["newton_euler"].force(q, v, 0.0, params) + rate, -potential - v @ (params["damping"] * v)

    assert_equal_to_rounding(*jax.jit(powers)(*states(5, 20)))


def end_of_run(scene, stepper):
    """The function num_steps -> state at the end, compiled once for all numbers of steps."""
    system, params, q0, v0, duration = scene

    @jax.jit
    def run(num_steps):
        dt = duration / num_steps
        start = stepper.init(system, q0, v0, params, dt)
        return jax.lax.fori_loop(0, num_steps, lambda _, state: stepper.step(system, state, params, dt)[0], start)

    return run


@pytest.mark.slow
def test_energy_is_conserved_without_dampers():
    """The drift of a fourth-order method, at two steps."""
    systems, params = random_chain(2, 4)
    params |= {"damping": jnp.zeros(2)}
    q0, v0 = states(2, 1)[:, 0]
    run = end_of_run(Scene(systems["newton_euler"], params, q0, v0, 2.0), hhtjax.rk4())

    def energy(q, v):
        return float(kinetic_energy(systems, q, v, params) + potential_energy(systems, q, params))

    coarse, fine = (abs(energy(end.q, end.v) / energy(q0, v0) - 1) for end in (run(200), run(400)))
    assert coarse < 1e-5
    assert fine < coarse / 2**3.7


@cache
def reference():
    """q of `swing(3)` at the end by SciPy, from the Lagrangian."""
    scene, by_autodiff = swing(3), lagrange(3)

    @jax.jit
    def rate(t, y):
        q, v = y[:3], y[3:]
        M, Q = by_autodiff.mass(q, t, scene.params), by_autodiff.force(q, v, t, scene.params)
        return jnp.concatenate([v, jnp.linalg.solve(M, Q)])

    y0 = np.concatenate([scene.q0, scene.v0])
    run = solve_ivp(lambda t, y: np.asarray(rate(t, y)), (0.0, scene.duration), y0, "DOP853", rtol=1e-11, atol=1e-12)
    return run.y[:3, -1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stepper", "order"),
    [
        (hhtjax.hht(alpha=-0.05), 2),
        pytest.param(hhtjax.hht(alpha=-0.05, iterations=None), 2, marks=EVERY),
        pytest.param(hhtjax.kim_hht(alpha=-0.3), 1, marks=EVERY),
    ],
    ids=["hht", "hht converged", "kim_hht"],
)
def test_order_of_the_trajectory(stepper, order):
    run = end_of_run(swing(3), stepper)
    coarse, fine = (np.linalg.norm(run(num_steps).q - reference()) for num_steps in (400, 800))
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.15)
    assert fine < 1e-2


@pytest.mark.slow
def test_gradients_in_the_joint_stiffness():
    scene = swing(2)

    def loss(k):
        path = hhtjax.simulate(
            scene.system,
            hhtjax.hht(linearize="predictor"),
            scene.q0,
            scene.v0,
            scene.params | {"stiffness": k},
            dt=0.025,
            num_steps=32,  # as many as are not checkpointed
        )
        return jnp.sum(path.q**2) + 0.1 * jnp.sum(path.v**2)

    check_gradient(loss, scene.params["stiffness"])


@pytest.mark.slow
def test_single_precision_is_kept():
    scene = swing(2)
    params, q = jax.tree.map(lambda x: x.astype(jnp.float32), (scene.params, scene.q0))
    for system in (scene.system, lagrange(2)):
        assert jax.eval_shape(partial(mass_at, system), q, jnp.float32(0), params).dtype == jnp.float32
        assert jax.eval_shape(system.force, q, q, jnp.float32(0), params).dtype == jnp.float32


@pytest.mark.parametrize("joints", [0, 7, 2.5])
def test_bad_number_of_joints(joints):
    with pytest.raises(ValueError, match=r"swing: `joints` must be 1, 2, ... 6; received"):
        swing(joints)
