"""Starts far from the slow manifold of what is light and strongly damped: m q'' = 1 - 50 q - 5 v, against its solution.

A start whose acceleration is M^-1 Q throws such a coordinate by h^2 Q/m, any multiple of F/k. m and the numbers of the
steppers are data, so one program serves them all.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from compiled_c import Library, needs_compiler, numbers
from zoo import as_data

import hhtjax
from hhtjax.scenes import double_pendulum
from hhtjax.steppers.collocation import collocation

K, C, H = 50.0, 5.0, 1e-3
MASSES = np.array([1, 1e-1, 1e-2, 3e-3, 1e-3, 1e-4, 1e-6, 1e-9, 1e-12])
STIFF = MASSES <= 1e-6
FAMILY = {
    "trapezoidal": hhtjax.newmark(),
    "hht(-.05)": hhtjax.hht(),
    "hht(-1/3)": hhtjax.hht(-1 / 3),
    "bossak(-.1)": hhtjax.bossak(),
    "bossak(-1)": hhtjax.bossak(-1.0),
    "generalized_alpha(.8)": hhtjax.generalized_alpha(0.8),
    "generalized_alpha(.2)": hhtjax.generalized_alpha(0.2),
    "generalized_alpha(0)": hhtjax.generalized_alpha(0.0),
}


def damped(q, v, t, params):
    return params.get("load", 1.0) - K * q - C * v


NODE = hhtjax.System(lambda q, params: jnp.reshape(params["m"], (1,)), damped)


def exact(m, t, v0=0.0):
    """q of the node from q = 0."""
    d = np.sqrt(complex(C**2 - 4 * m * K))
    fast = -(C + d) / (2 * m)
    slow = K / (m * fast)
    b = -(v0 + slow / K) / (slow - fast)
    return np.where(
        t < 0, 0, (1 / K - (1 / K + b) * np.exp(slow * np.maximum(t, 0)) + b * np.exp(fast * t.clip(0))).real
    )


def errors(run, h, reference=exact, duration=0.2):
    """Largest error over F/k, for each mass; run: m, h, number of steps -> q (N + 1,) and the failure."""
    num_steps = round(duration / h)
    q, failed = jax.jit(jax.vmap(lambda m: run(m, h, num_steps)))(jnp.asarray(MASSES))
    assert not np.any(failed)
    times = h * np.arange(num_steps + 1)
    return np.array([K * np.max(np.abs(x - reference(m, times))) for x, m in zip(q, MASSES, strict=True)])


def errors_of_two(run, h, reference=exact, duration=0.2):
    """The same with steps of h, and of h/2: one program, for the run with long steps goes on."""
    num_steps = round(2 * duration / h)
    some = jax.jit(lambda h: jax.vmap(lambda m: run(m, h, num_steps))(jnp.asarray(MASSES)))
    for k in (1, 2):
        q, failed = some(jnp.asarray(h / k))
        assert not np.any(failed)
        times = h / k * np.arange(k * num_steps // 2 + 1)
        pairs = zip(np.asarray(q)[:, : times.size], MASSES, strict=True)
        yield np.array([K * np.max(np.abs(x - reference(m, times))) for x, m in pairs])


def of_node(stepper, m, h, num_steps, **more):
    params = {"m": m, **more.pop("params", {})}
    run = hhtjax.simulate(NODE, stepper, jnp.zeros(1), jnp.zeros(1), params, dt=h, num_steps=num_steps, **more)
    return run.q[:, 0], run.failure.step


@partial(jax.jit, static_argnames="num_steps")
def runs_of_family(steppers, h, num_steps):
    return jax.vmap(lambda one: jax.vmap(lambda m: of_node(one, m, h, num_steps)[0])(jnp.asarray(MASSES)))(steppers)


def errors_of_family(h, num_steps=200):
    """Until 0.2 s, of longer runs where h is longer: one program."""
    steppers = jax.tree.map(lambda *x: jnp.stack(x), *(as_data(x) for x in FAMILY.values()))
    times = h * np.arange(round(0.2 / h) + 1)
    q = np.asarray(runs_of_family(steppers, h, num_steps))[..., : times.size]
    reference = np.stack([exact(m, times) for m in MASSES])
    return K * np.max(np.abs(q - reference), axis=-1)


@pytest.mark.slow
def test_no_mass_is_thrown_by_any_of_the_family():
    """Below 2e-3 of F/k with every mass, at once and ever after, and of order 2 where damping is stiff."""
    coarse, fine = errors_of_family(2 * H), errors_of_family(H)
    assert np.all(fine < 2e-3), dict(zip(FAMILY, fine, strict=True))
    assert np.all(fine[:3] < 5e-4)
    order = np.log2(coarse / fine)[:, STIFF]
    assert np.all((order > 1.9) & (order < 2.2)), order
    thrown = errors(partial(of_node, as_data(hhtjax.hht(start="simple"))), H)
    assert thrown[-2] > 50  # so that this test can fail
    assert np.all(fine[1] <= 1.01 * thrown)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "limit"),
    [
        (lambda: hhtjax.hht(iterations=None), 2e-3),
        (lambda: hhtjax.hht(start="corrected"), 2e-3),
        (lambda: hhtjax.hht(-1 / 3, linearize="state"), 2e-3),
        (lambda: hhtjax.hht(linearize="predictor", solve=hhtjax.banded(1)), 2e-3),
        (lambda: hhtjax.operator_splitting(), 2e-3),
        (hhtjax.wilson, 1e-3),
        (lambda: collocation(0.18, 1.287301), 1e-3),
        (hhtjax.houbolt, 4e-3),
        (hhtjax.park, 2e-3),
        (hhtjax.rosenbrock, 2e-3),
        (hhtjax.rowda, 2e-3),
        (hhtjax.implicit_euler, 4e-3),
    ],
)
def test_no_mass_is_thrown_by_other_methods(make, limit):
    assert np.max(errors(partial(of_node, make()), H)) < limit


def test_what_is_saved_at_t0_is_what_was_given():
    run = hhtjax.simulate(NODE, hhtjax.hht(), jnp.ones(1), jnp.ones(1), {"m": 1e-6}, dt=H, num_steps=2)
    assert run.v[0, 0] == 1
    np.testing.assert_allclose(run.acceleration[0, 0], (1 - K - C) / 1e-6, rtol=1e-14)
    assert abs(run.v[1, 0]) < 11


def test_nothing_damped_nothing_changed():
    """Without a damper the start is M^-1 Q to the bit; with one that is resolved it is O(h^5) away."""
    spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -9.0 * q - params * v)
    free = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -9.0 * q)
    for system, params in ((free, None), (spring, 0.0)):  # where the force does not know v, and where its damper is 0
        state = hhtjax.hht(-0.3).init(system, jnp.ones(1), jnp.ones(1), params, dt=0.1)
        assert state.v[0] == 1
        assert state.w[0] == state.a[0] == -9

    def away(h):
        state = hhtjax.hht(start="smooth").init(spring, jnp.ones(1), jnp.ones(1), 2.0, dt=h)
        return np.array([abs(state.v[0] - 1), abs(state.w[0] + 11)])

    order = np.log2(away(0.02) / away(0.01))
    assert np.all(order > 4.5), order


def quadratic(m, h, num_steps):
    """5 v |v| in the place of 5 v: no damping at the start itself."""
    system = hhtjax.System(lambda q, p: p * jnp.ones(1), lambda q, v, t, p: 1 - K * q - C * v * jnp.abs(v))
    run = hhtjax.simulate(system, hhtjax.hht(), jnp.zeros(1), jnp.zeros(1), m, dt=h, num_steps=num_steps)
    return run.q[:, 0], run.failure.step


def test_quadratic_damping():
    """Without mass sqrt(1 - 50 q) = 1 - 25 t/sqrt(5)."""

    def without_mass(m, t):
        return (1 - (1 - 25 * t / np.sqrt(5)).clip(0) ** 2) / K

    coarse, fine = (x[-2:] for x in errors_of_two(quadratic, 2 * H, without_mass, 0.08))
    assert np.all(fine < 2e-4)
    assert np.all(np.log2(coarse / fine) > 1.9)


def mass_of_rod(q, m):
    return jnp.stack([jnp.ones(()), jnp.ones(()), m])


def force_on_rod(q, v, t, m):
    return jnp.stack([0 * t, -9.81 + 0 * t, 1 - K * q[2] - C * v[2]])


# A pendulum in x, y, and the light node.
ROD = hhtjax.System(mass_of_rod, force_on_rod, constraint=lambda q, t, m: (q[:1] ** 2 + q[1:2] ** 2 - 1) / 2)


@pytest.mark.slow
@pytest.mark.parametrize("formulation", ["ggl", "index3"])
def test_beside_a_constraint(formulation):
    """With the default start of constraints."""
    stepper = hhtjax.hht(-1 / 3, formulation=formulation)

    def run(m, h, num_steps):
        q0 = jnp.array([1.0, 0.0, 0.0])
        found = hhtjax.simulate(ROD, stepper, q0, jnp.zeros(3), m, dt=h, num_steps=num_steps)
        return found.q[:, 2], found.failure.step

    assert np.all(errors(run, H) < 2e-3)


@pytest.mark.slow
def test_behind_an_event():
    """The load is switched on within a step, of which next to nothing may be left; the time is data."""
    on = hhtjax.Event(
        guard=lambda q, v, t, p: jnp.where(p["load"] > 0, 1.0, p["at"] - t),
        switch=lambda p: p | {"load": p["load"] + 1.0},
    )

    @jax.jit
    def runs(fractions):
        def run(fraction, m):
            params = {"load": 0.0, "at": (7 + fraction) * H}
            return of_node(hhtjax.hht(-1 / 3), m, H, 100, params=params, events=[on])

        return jax.vmap(lambda x: jax.vmap(partial(run, x))(jnp.asarray(MASSES)))(fractions)

    fractions = np.array([0.02, 0.5, 0.99, 1 - 1e-8])
    found, failed = runs(jnp.asarray(fractions))
    assert not np.any(failed)
    times = H * np.arange(101)
    for q, fraction in zip(found, fractions, strict=True):
        expected = np.stack([exact(m, times - (7 + fraction) * H) for m in MASSES])
        assert K * np.max(np.abs(q - expected)) < 2e-3


@pytest.mark.slow
def test_where_held_inputs_jump():
    load = np.array([0.0, 1.0, 1.0, 0.5, 1.5])
    held = hhtjax.sampled(jnp.asarray(load), dt=0.01, order=0)
    system = hhtjax.System(lambda q, p: p["m"] * jnp.ones(1), lambda q, v, t, p: p["load"](t) - K * q - C * v)

    def run(m, h, num_steps):
        params = {"m": m, "load": held}
        found = hhtjax.simulate(
            system, hhtjax.hht(-1 / 3), jnp.zeros(1), jnp.zeros(1), params, dt=h, num_steps=num_steps
        )
        return found.q[:, 0], found.failure.step

    def reference(m, t):
        return sum(x * exact(m, t - 0.01 * i) for i, x in enumerate(np.diff(load, prepend=0.0)))

    coarse, fine = errors_of_two(run, H, reference, 0.05)
    assert np.all(coarse < 2e-3)
    assert np.all(np.log2(coarse / fine)[STIFF] > 1.9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "limit"),
    [(hhtjax.wilson, 1e-3), (hhtjax.houbolt, 4e-3), (hhtjax.park, 1e-3), (hhtjax.operator_splitting, 1e-3)],
)
def test_where_held_inputs_jump_other_methods_begin_anew(make, limit):
    """As well as at a start; and of order 2 where all is resolved, m = 1, which is the first."""
    held = hhtjax.sampled(jnp.array([0.0, 1.0, 1.0]), dt=0.01, order=0)
    system = hhtjax.System(lambda q, p: p["m"] * jnp.ones(1), lambda q, v, t, p: p["load"](t) - K * q - C * v)

    def run(m, h, num_steps):
        params = {"m": m, "load": held}
        found = hhtjax.simulate(system, make(), jnp.zeros(1), jnp.zeros(1), params, dt=h, num_steps=num_steps)
        return found.q[:, 0], found.failure.step

    def reference(m, t):
        return exact(m, t - 0.01)

    coarse, fine = errors_of_two(run, 2 * H, reference, 0.2)
    assert np.all(fine < limit)
    assert np.log2(coarse / fine)[0] > 1.7


@pytest.mark.slow
def test_short_steps_before_long_ones():
    """They leave a velocity, and an acceleration, that the long ones cannot follow."""
    sizes = np.full((3, 60), H)
    sizes[0, 0], sizes[1, :3], sizes[2, 0] = 1e-3 * H, 1e-6 * H, 0.1 * H

    @jax.jit
    def runs(sizes):
        def run(dt, m):
            params = {"m": m}
            return hhtjax.simulate(NODE, hhtjax.hht(-1 / 3), jnp.zeros(1), jnp.zeros(1), params, dt=dt).q[:, 0]

        return jax.vmap(lambda dt: jax.vmap(partial(run, dt))(jnp.asarray(MASSES)))(sizes)

    for q, dt in zip(runs(jnp.asarray(sizes)), sizes, strict=True):
        times = np.append(0.0, np.cumsum(dt))
        assert K * np.max(np.abs(q - np.stack([exact(m, times) for m in MASSES]))) < 1e-3


@pytest.mark.slow
def test_beside_internal_states():
    """A Maxwell branch on the light node: what it gives to z is no damping that gives energy to a motion."""
    k1, tau = 30.0, 0.05
    system = hhtjax.System(
        lambda q, m: m * jnp.ones(1),
        lambda q, v, z, t, m: 1 - K * q - C * v - z,
        internal=lambda q, v, z, t, m: k1 * v - z / tau,
    )

    def run(m, h, num_steps):
        zero = jnp.zeros(1)
        found = hhtjax.simulate(system, hhtjax.hht(-1 / 3), zero, zero, m, z0=zero, dt=h, num_steps=num_steps)
        return found.q[:, 0], found.failure.step

    def reference(m, t):
        m = max(m, 1e-7)  # below it no more changes, but for rounding
        A = np.array([[0, 1, 0, 0], [-K / m, -C / m, -1 / m, 1 / m], [0, k1, -1 / tau, 0], [0, 0, 0, 0]])
        step, y = scipy.linalg.expm(A * t[1]), [np.array([0.0, 0, 0, 1])]
        for _ in t[1:]:
            y.append(step @ y[-1])
        return np.array(y)[:, 0]

    assert np.all(errors(run, H, reference, 0.1) < 5e-4)


@pytest.mark.slow
def test_a_light_body_on_a_viscous_joint():
    """Its angle is the coordinate of the node, about one axis."""
    axis = jnp.array([0.0, 0.0, 1.0])

    def moment(R, v, t, m):
        return (1 - K * jnp.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])) * axis - C * v

    system = hhtjax.System(lambda R, m: m * jnp.ones(3), moment)

    def run(m, h, num_steps):
        found = hhtjax.simulate(system, hhtjax.hht(-1 / 3), jnp.eye(3), jnp.zeros(3), m, dt=h, num_steps=num_steps)
        return jnp.arctan2(found.q[:, 1, 0], found.q[:, 0, 0]), found.failure.step

    assert np.all(errors(run, H, duration=0.1) < 5e-4)


@pytest.mark.slow
def test_where_held_inputs_jump_with_dry_friction():
    held = hhtjax.sampled(jnp.array([0.0, 1.0, 1.0]), dt=0.01, order=0)
    system = hhtjax.System(
        lambda q, p: jnp.stack([p["m"], jnp.ones(())]),
        lambda q, v, t, p: jnp.stack([p["load"](t) - K * q[0] - C * v[0], -4 * q[1]]),
        friction=lambda q, v, t, p: jnp.array([0.2]),
        sliding=lambda q, v, t, p: v[:1],
    )

    def run(m, h, num_steps):
        start, params = (jnp.array([0.0, 0.1]), jnp.zeros(2)), {"m": m, "load": held}
        found = hhtjax.simulate(system, hhtjax.hht(-1 / 3), *start, params, dt=h, num_steps=num_steps)
        return found.q[:, 0], found.failure.step

    assert np.all(errors(run, H, lambda m, t: 0.8 * exact(m, t - 0.01), 0.1) < 2e-3)


# 0.2 N against the motion of the light node. A second coordinate is there to be smooth.
RUBBED = hhtjax.System(
    lambda q, m: jnp.stack([m, jnp.ones(())]),
    lambda q, v, t, m: jnp.stack([1 - K * q[0] - C * v[0], -4 * q[1]]),
    friction=lambda q, v, t, m: jnp.array([0.2]),
    sliding=lambda q, v, t, m: v[:1],
)


@pytest.mark.slow
@pytest.mark.parametrize("v0", [0.0, pytest.param(0.1, marks=pytest.mark.slow)])
def test_with_dry_friction(v0):
    """0.8 of the load is left."""

    def run(m, h, num_steps):
        start = jnp.array([0.0, 0.1]), jnp.array([v0, 0.0])
        found = hhtjax.simulate(RUBBED, hhtjax.hht(-1 / 3), *start, m, dt=h, num_steps=num_steps)
        return found.q[:, 0], found.failure.step

    assert np.all(errors(run, H, lambda m, t: 0.8 * exact(m, t, v0 / 0.8), 0.1) < 2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "start", "node", "part"),
    [(ROD, [1.0, 0.0, 0.0], 2, 1.0), (RUBBED, [0.0, 0.1], 0, 0.8)],
    ids=["constraint", "friction"],
)
def test_short_steps_before_long_ones_elsewhere(system, start, node, part):
    """Beside a constraint, and with dry friction; forward, reverse and differences in the load's place, too."""
    sizes = np.full(60, H)
    sizes[:3] = 1e-6 * H
    q0, times = jnp.array(start), np.append(0.0, np.cumsum(sizes))

    def path(x):
        m, step, place = x
        dt = jnp.asarray(sizes).at[40].mul(step)
        at = q0.at[node].add(place)
        return hhtjax.simulate(system, hhtjax.hht(-1 / 3), at, 0 * q0, m, dt=dt).q[:, node]

    along = jax.jit(lambda x, dx: jax.jvp(path, (x,), (dx,)))  # the values, too: one program
    reverse, unit = jax.jit(jax.grad(lambda x: path(x)[-1])), np.eye(3)
    for m in (1e-2, 1e-6, 1e-12):
        found, _ = along(np.array([m, 1.0, 0.0]), unit[0])
        assert K * np.max(np.abs(found - part * exact(m, times))) < 2e-3, m

    for m in (1e-2, 1e-6):
        x = np.array([m, 1.0, 0.001])
        found = np.array([along(x, dx)[1][-1] for dx in unit])
        np.testing.assert_allclose(reverse(x), found, rtol=1e-8, atol=1e-12)
        for i, h in enumerate(np.array([1e-4 * m, 1e-5, 1e-6])):
            (after, _), (before, _) = (along(x + step * unit[i], unit[i]) for step in (h, -h))
            np.testing.assert_allclose((after - before)[-1] / (2 * h), found[i], rtol=1e-4, atol=1e-7)


def two_nodes(x, num_steps=4):
    """The end of a run of a light node on a heavy one, with cubic damping too, as a function of all numbers in it."""
    m, k, c, alpha, *start = x

    def force(q, v, t, params):
        pull = k * (q[0] - q[1]) + c * (v[0] - v[1])
        return jnp.stack([1.0 - pull - v[0] ** 3, pull - 10.0 * q[1]])

    system = hhtjax.System(lambda q, params: jnp.stack([m, jnp.ones_like(m)]), force)
    run = hhtjax.simulate(system, hhtjax.hht(alpha), jnp.stack(start), jnp.zeros(2), dt=H, num_steps=num_steps)
    return run.q[-1] @ jnp.array([1.0, 0.3]) + 1e-3 * run.v[-1, 0]


@pytest.mark.slow
def test_derivatives_pass_through_the_start():
    """Where damping is resolved, half so, and stiff; forward, reverse and differences."""
    reverse, along = jax.jit(jax.grad(two_nodes)), jax.jit(lambda x, dx: jax.jvp(two_nodes, (x,), (dx,)))
    for m in (1e-1, 1e-3, 1e-5):
        x = jnp.array([m, 50.0, 5.0, -0.1, 0.1, 0.2])
        found = np.array([along(x, dx)[1] for dx in np.eye(6)])
        np.testing.assert_allclose(reverse(x), found, rtol=1e-10)
        for i, h in enumerate(1e-5 * np.abs(x)):
            (after, _), (before, _) = (along(x.at[i].add(step), x) for step in (h, -h))
            change = (after - before) / (2 * h)
            np.testing.assert_allclose(change, found[i], rtol=2e-5)


@pytest.mark.slow
def test_sparse_matrices_begin_as_dense_ones():
    """A chain whose first node is light, with Rayleigh damping; and as functions, with a band."""
    scipy = pytest.importorskip("scipy.sparse")
    n = 320
    A = scipy.diags([-np.ones(n - 1), 2 * np.ones(n), -np.ones(n - 1)], [-1, 0, 1]).tocsc()
    M, start = np.append(1e-6, np.ones(n - 1)), (jnp.linspace(0.1, 0.0, n), jnp.zeros(n))

    def springs(q, v, t, params):
        return jnp.diff(100.0 * q + 2.0 * v, 2, prepend=0.0, append=0.0)

    sparse = hhtjax.LinearSystem(M, 2.0 * A, 100.0 * A)
    dense = hhtjax.LinearSystem(M, 2.0 * A.toarray(), 100.0 * A.toarray())
    banded = hhtjax.System(M, springs)
    ways = ((sparse, hhtjax.hht()), (dense, hhtjax.hht()), (banded, hhtjax.hht(solve=hhtjax.banded(1))))
    first, *others = (stepper.init(system, *start, None, dt=H) for system, stepper in ways)
    assert abs(first.v[0] + 2.5) < 0.1  # what its springs ask of its dampers, and not 0
    for other in others:
        np.testing.assert_allclose(other.v, first.v, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(other.w, first.w, rtol=1e-7, atol=1e-7)


@pytest.mark.filterwarnings("ignore::hhtjax.PrecisionWarning")
def test_single_precision():
    zero, params = np.zeros(1, np.float32), {"m": np.float32(1e-6)}
    run = hhtjax.simulate(NODE, hhtjax.hht(), zero, zero, params, dt=H, num_steps=100)
    assert run.q.dtype == np.float32
    assert K * np.max(np.abs(np.asarray(run.q[:, 0]) - exact(1e-6, H * np.arange(101)))) < 1e-3


@needs_compiler
def test_exported(tmp_path):
    """In C the start is that of Python, and no more is thrown."""
    zero, params = jnp.zeros(1), {"m": 1e-6}
    library = Library(hhtjax.export_c(NODE, hhtjax.hht(), zero, zero, params, name="node"), tmp_path)
    state, flags = library.begin(np.zeros(1), np.zeros(1), dt=H)
    expected = hhtjax.hht().init(NODE, zero, zero, params, dt=H)
    assert flags == 0
    np.testing.assert_allclose(numbers(state, "v"), expected.v, rtol=1e-12)
    for _ in range(100):
        assert library.step(state, dt=H) == 0
    assert abs(numbers(state, "q")[0] - exact(1e-6, np.array([0.1]))[0]) * K < 1e-3


@pytest.mark.slow
def test_a_feedback_without_reaction_moves_no_velocity():
    """Joint 2 of Kim's double pendulum, as printed, acts on one link alone: its C gives energy, and P would grow."""
    scene = double_pendulum.stiff(as_printed=True)
    runs = [
        hhtjax.simulate(
            scene.system, hhtjax.hht(0.0, start=start), scene.q0, scene.v0, scene.params, dt=0.05, num_steps=20
        )
        for start in ("smooth", "simple")
    ]
    smooth, simple = (np.asarray(run.q) for run in runs)
    assert np.max(np.abs(smooth - simple)) < 0.02 * np.max(np.abs(simple))  # without the question: 1e3
