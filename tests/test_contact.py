"""Bodies that touch: they rest, stick, slide, let go, and land."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contact_problems import (
    GRAVITY,
    Scene,
    ball,
    block,
    bowl,
    disc,
    hopper,
    rod,
    slope,
    stack,
    standing,
    table,
)

import hhtjax
from hhtjax.numerics.complementarity import complement
from hhtjax.numerics.coulomb import impulses

PREDICTOR = hhtjax.hht(linearize="predictor")


def run(scene: Scene, steps: int, stepper=PREDICTOR, every: int = 1, **params):
    return hhtjax.simulate(
        scene.system,
        stepper,
        scene.q0,
        scene.v0,
        scene.params | params,
        dt=scene.T / steps,
        num_steps=steps,
        save_every=every,
    )


# ----------------------------------------------------------------------------
# The problems of a few contacts.


@pytest.mark.parametrize("n", [2, 5, 16])
def test_a_complement_is_one(n):
    """Of 1000 random matrices that are positive semidefinite, some of low rank."""
    rng = np.random.default_rng(0)
    J = rng.normal(size=(1000, n, n + 1))
    J[::2, :, n // 2 + 1 :] = 0
    M = J @ np.swapaxes(J, 1, 2)
    M /= np.max(np.abs(M), axis=(1, 2))[:, None, None]
    q = np.einsum("kij,kj->ki", J, rng.normal(size=(1000, n + 1)))  # so that there is a solution
    q /= np.max(np.abs(q), axis=1)[:, None]
    z, basic, found = jax.jit(jax.vmap(complement))(M, q)
    y = np.einsum("kij,kj->ki", M, z) + q
    size = 1 + np.max(z, axis=1)[:, None]
    assert found.all()
    assert np.min(z) >= 0
    assert np.min(y / size) >= -1e-8
    assert np.max(np.abs(y * z) / size**2) < 1e-8
    assert not np.any(z[~basic])


def random_impacts(m: int, number: int = 1000):
    rng = np.random.default_rng(m)
    J = rng.normal(size=(number, 2 * m, 2 * m + 1))
    J[::2, :, m + 1 :] = 0  # rows that depend on each other
    v = rng.normal(size=(number, 2 * m + 1)) * 10 ** rng.uniform(-2, 2, size=(number, 1))
    return J, v, rng.uniform(0, 1.5, size=(number, m)), rng.uniform(0, 1, size=(number, m))


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_impacts_make_no_energy_and_obey_their_laws(m):
    J, v, mu, e = random_impacts(m)
    K, y = J @ np.swapaxes(J, 1, 2), np.einsum("kij,kj->ki", J, v)
    of_each = jax.jit(jax.vmap(lambda K, y, mu, e: impulses(K, y, mu, e, mu >= 0)))
    f = np.asarray(of_each(K, y, mu, e))
    after = v + np.einsum("kij,ki->kj", J, f)
    size = np.max(np.abs(y), axis=1)[:, None]
    energy = [np.sum(x**2, axis=1) for x in (v, after)]
    assert np.all(energy[1] <= energy[0] * (1 + 1e-9))
    end = np.einsum("kij,kj->ki", J, after)
    scale = np.max(np.abs(f), axis=1)[:, None] + 1e-9 * size
    assert np.min(end[:, :m] / size) > -1e-7  # nobody goes on into each other
    assert np.min(f[:, :m] / scale) > -1e-9
    assert np.max((np.abs(f[:, m:]) - mu * f[:, :m]) / scale) < 1e-7


def test_one_impact_is_that_of_poisson():
    """Without friction Newton's law; with much of it the foot of a rod does not slide off."""
    K, y = jnp.array([[2.0, 0.5], [0.5, 3.0]]), jnp.array([-1.0, 0.4])
    f = impulses(K, y, jnp.zeros(1), jnp.full(1, 0.7), jnp.array([True]))
    assert np.allclose(f, [1.7 / 2, 0], atol=1e-15)
    stuck = impulses(K, y, jnp.full(1, 50.0), jnp.zeros(1), jnp.array([True]))
    assert np.allclose(K @ stuck, -y, atol=1e-14)


# ----------------------------------------------------------------------------
# Closed forms.


@pytest.mark.slow
@pytest.mark.parametrize(("inertia", "left"), [(0.5, 2 / 3), (0.4, 5 / 7)])
def test_a_body_slides_until_it_rolls(inertia, left):
    """Whatever friction is: a disc keeps 2/3 of its speed, a sphere 5/7."""
    scene = disc(inertia)
    found = run(scene, 40)
    found.check()
    assert abs(found.v[-1, 0] - 2 * left) < 1e-10
    stop = 2 * (1 - left) / (0.2 * GRAVITY)
    assert abs(found.q[-1, 0] - (2 * stop - 0.1 * GRAVITY * stop**2 + 2 * left * (1 - stop))) < 1e-10
    assert bool(found.contact.sticking[-1, 0])
    assert not bool(found.contact.sticking[1, 0])


@pytest.mark.slow
def test_a_block_on_a_slope():
    """It stays where friction holds it, without creep, and slides with g (sin - mu cos) elsewhere."""
    for mu in (0.2, 0.4):
        found = run(slope(), 40, mu=mu)
        found.check()
        rate = GRAVITY * max(0.0, np.sin(0.3) - mu * np.cos(0.3))
        assert jnp.allclose(found.q[:, 0], rate * found.t**2 / 2, atol=1e-13)
        assert bool(found.contact.sticking.all()) == (mu == 0.4)
        assert jnp.allclose(found.contact.normal, GRAVITY * np.cos(0.3), atol=1e-13)


@pytest.mark.slow
def test_a_stack_at_rest_does_not_move():
    found = run(stack(0.0), 100)
    found.check()
    assert jnp.max(jnp.abs(found.q - found.q[:1])) <= 1e-15
    weights = GRAVITY * jnp.array([2.2, 1.2, 0.5])
    assert jnp.max(jnp.abs(found.contact.normal - weights[None])) < 1e-12
    assert bool(found.contact.sticking.all())
    assert bool((found.contact.rests_since == -jnp.inf).all())


@pytest.mark.slow
def test_a_stack_on_a_shaken_floor():
    """At .65 of what friction holds it goes with the floor; at 2.4 its parts slide, and gaps stay closed."""
    with_it, beyond = (x * 0.5 * GRAVITY / 8**2 for x in (0.65, 2.4))
    found = run(stack(with_it), 200)
    found.check()
    assert bool(found.contact.sticking.all())
    assert jnp.max(jnp.abs(found.q[:, :3] - with_it * jnp.sin(8 * found.t)[:, None])) < 2e-5
    found = run(stack(beyond), 200)
    found.check()
    assert not bool(found.contact.sticking.all())
    assert jnp.max(jnp.abs(jnp.diff(found.q[:, 3:], axis=1, prepend=0.0) - jnp.array([[0.0, 1.0, 1.0]]))) < 1e-12


@pytest.mark.slow
def test_a_ball_without_friction_bounces_as_by_an_event():
    def force(q, v, t, params):
        return -GRAVITY - 0.3 * v

    floor = hhtjax.Event(guard=lambda q, v, t, params: q[0], reset=hhtjax.impact(restitution=0.7))
    by_contact = hhtjax.System(jnp.ones(1), force, contact=hhtjax.Contact(gap, restitution=0.7))
    by_event = hhtjax.System(jnp.ones(1), force)
    how = {"dt": 0.01, "num_steps": 150}
    start = PREDICTOR, jnp.ones(1), jnp.zeros(1)
    a, b = hhtjax.simulate(by_contact, *start, **how), hhtjax.simulate(by_event, *start, events=[floor], **how)
    a.check()
    assert int(a.contact.impacts[-1, 0]) == int(b.events.count) > 1
    assert jnp.max(jnp.abs(a.q - b.q)) < 2e-6  # when they land is found to O(h^4) here, to rounding there


@pytest.mark.slow
def test_a_ball_rests_from_the_time_on_at_which_its_bounces_end():
    """Without drag t = sqrt(2 H/g) (1 + e)/(1 - e), of infinitely many."""
    found = run(ball(), 300, c=0.0, e=0.5)
    found.check()
    assert bool(found.contact.closed[-1, 0])
    assert abs(found.contact.rests_since[-1, 0] - 3 * np.sqrt(2 / GRAVITY)) < 1e-6
    assert found.contact.rests_since[0, 0] == jnp.inf


@pytest.mark.slow
def test_bodies_that_do_not_touch_bounce_by_themselves():
    def system():
        contact = hhtjax.Contact(lambda q, t, params: q, restitution=0.7)
        return hhtjax.System(jnp.ones(2), lambda q, v, t, params: -GRAVITY + 0 * q, contact=contact)

    start = jnp.stack([jnp.ones(2), jnp.array([1.0, 0.0]), jnp.array([0.8, 1.0])])
    runs = jax.vmap(lambda q0: hhtjax.simulate(system(), PREDICTOR, q0, jnp.zeros(2), dt=0.01, num_steps=150))(start)
    runs.check()
    assert jnp.max(jnp.abs(runs.q[:1, :, 0] - runs.q[:2, :, 0])) == 0  # together, and beside one that rests
    assert jnp.max(jnp.abs(runs.q[0, :, 0] - runs.q[2, :, 1])) < 1e-12
    assert not jnp.any(runs.q[1, :, 1])


@pytest.mark.slow
def test_a_block_rocks_until_it_stands():
    """With each impact of a corner it keeps 1 - 3/2 sin^2 of its turning, by the angular momentum about that corner
    (Housner, Bull. Seismol. Soc. Am. 53, 1963, 403-417); in the end both corners stay down."""
    scene = block()
    found = run(scene, 600)
    found.check()
    impacts = np.asarray(found.contact.impacts.sum(axis=1))
    speed = np.abs(np.asarray(found.v[:, 2]))
    struck = np.flatnonzero(np.diff(impacts))[:3]
    energy = 2 * speed**2 / 3 * 1.25 + GRAVITY * np.asarray(found.q[:, 1])  # about a corner: (I + 1.25 m) omega^2/2
    kept = (energy[struck + 1] - GRAVITY) / (energy[struck] - GRAVITY)
    assert np.allclose(kept, (1 - 1.5 * 0.5**2 / (0.5**2 + 1.0**2)) ** 2, atol=2e-5)
    assert impacts[-1] > 10
    assert bool(found.contact.closed[-1].all())
    assert jnp.allclose(found.q[-1], jnp.array([found.q[-1, 0], 1.0, 0.0]), atol=1e-14)
    assert jnp.max(jnp.abs(found.v[-1])) < 1e-15
    assert jnp.allclose(found.contact.normal[-1], GRAVITY / 2, atol=1e-12)


# ----------------------------------------------------------------------------
# Order, gaps, derivatives.


def slope_of(errors: list, steps: list) -> float:
    return -float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "T"), [(ball, 3.0), (rod, 1.0), (table, 2.0), (block, 1.2), (hopper, 0.8), (bowl, 2.0)]
)
def test_the_order_through_impacts_and_switches_is_two(make, T):
    """In q, v and the forces, for alpha = 0, -0.05 and -0.3, and gaps are closed to rounding."""
    scene, steps = make(), [320, 640, 1280, 2560]
    gap_of = jax.vmap(jax.vmap(lambda q: jnp.atleast_1d(scene.system.contact.gap(q, 0.0, scene.params))))
    for alpha in (0.0, -0.05, -0.3):
        stepper, dts = hhtjax.hht(alpha=alpha, linearize="predictor"), T / jnp.asarray([*steps, 20480.0])
        found = hhtjax.sweep(
            scene.system, stepper, scene.q0, scene.v0, scene.params, dts=dts, duration=T, num_samples=40
        )
        found.check()
        assert float(jnp.min(gap_of(found.q))) > -1e-12
        for x, least in ((found.q, 1.85), (found.v, 1.85), (found.contact.normal, 1.8), (found.contact.friction, 1.8)):
            errors = jnp.max(jnp.abs(x[:-1] - x[-1:]), axis=(1, 2))
            assert jnp.max(errors) < 1e-12 or slope_of(errors, steps) > least


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "name", "steps"), [(ball, "e", 40), (table, "mu", 40), (block, "mu", 100), (hopper, "e", 40)]
)
def test_derivatives_are_those_of_the_run(make, name, steps):
    scene, h = make(), 1e-4

    def end(x):
        return run(scene._replace(T=min(scene.T, 1.5)), steps, every=steps, **{name: x}).q[-1]

    x = jnp.asarray(scene.params[name] + (0.3 if make is hopper else 0.0))
    forward = jax.jvp(end, (x,), (jnp.ones_like(x),))[1]
    f = [end(x + k * h) for k in (-2, -1, 1, 2)]
    central = (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * h)
    if make in (ball, hopper):
        assert jnp.allclose(forward, jax.jacrev(end)(x), rtol=1e-12, atol=1e-12)
    assert jnp.allclose(forward, central, rtol=1e-8, atol=1e-8)
    assert make is block or jnp.max(jnp.abs(forward)) > 1e-3


# ----------------------------------------------------------------------------
# With what else a system may have.


@pytest.mark.slow
def test_with_constraints():
    """A pendulum that meets a wall: its mass on a massless link is the pendulum of one angle."""
    wall = {"restitution": 0.5}
    link = hhtjax.System(
        jnp.ones(2),
        lambda q, v, t, params: jnp.array([0.0, -GRAVITY]),
        constraint=lambda q, t, params: (jnp.sum(q**2) - 1)[None] / 2,
        contact=hhtjax.Contact(lambda q, t, params: q[0] + 0.2, **wall),
    )
    angle = hhtjax.System(
        jnp.ones(1),
        lambda q, v, t, params: -GRAVITY * jnp.sin(q),
        contact=hhtjax.Contact(lambda q, t, params: jnp.sin(q[0]) + 0.2, **wall),
    )
    how = {"dt": 2 / 400, "num_steps": 400}
    a = hhtjax.simulate(link, PREDICTOR, jnp.array([jnp.sin(1.0), -jnp.cos(1.0)]), jnp.zeros(2), **how)
    b = hhtjax.simulate(angle, PREDICTOR, jnp.ones(1), jnp.zeros(1), **how)
    a.check()
    b.check()
    assert a.contact.impacts[-1, 0] == b.contact.impacts[-1, 0] == 2
    assert jnp.max(jnp.abs(a.q[:, 0] - jnp.sin(b.q[:, 0]))) < 1e-4
    assert jnp.max(jnp.abs(jnp.sum(a.q**2, axis=1) - 1)) < 1e-10


@pytest.mark.slow
def test_with_rotations():
    """A disc in space, that turns about one axis: it slides until it rolls."""

    def sliding(q, v, t, params):
        return v["x"][0] + (q["R"] @ v["R"])[2]

    floor = hhtjax.Contact(lambda q, t, params: q["x"][1] - 1, sliding, "mu")

    def force(q, v, t, params):
        return {"R": jnp.zeros(3), "x": jnp.array([0.0, -GRAVITY, 0.0])}

    system = hhtjax.System(jnp.array([1.0, 1.0, 0.5, 1.0, 1.0, 1.0]), force, contact=floor)
    q0 = {"R": jnp.eye(3), "x": jnp.array([0.0, 1.0, 0.0])}
    v0 = {"R": jnp.zeros(3), "x": jnp.array([2.0, 0.0, 0.0])}
    found = hhtjax.simulate(system, PREDICTOR, q0, v0, {"mu": 0.2}, dt=0.025, num_steps=40)
    found.check()
    assert jnp.allclose(found.v["x"][-1], jnp.array([4 / 3, 0.0, 0.0]), atol=1e-10)
    assert jnp.allclose(found.v["R"][-1], jnp.array([0.0, 0.0, -4 / 3]), atol=1e-10)


@pytest.mark.slow
def test_with_internal_states():
    """A ball whose drag lags: of order 2."""
    system = hhtjax.System(
        jnp.ones(1),
        lambda q, v, z, t, params: -GRAVITY - z,
        internal=lambda q, v, z, t, params: (3.0 * v - z) / 0.1,
        contact=hhtjax.Contact(gap, restitution=0.5),
    )
    found = hhtjax.sweep(
        system, PREDICTOR, jnp.ones(1), jnp.zeros(1), z0=jnp.zeros(1),
        dts=jnp.array([2 / 100, 2 / 400, 2 / 12800]), duration=2.0, num_samples=20,
    )  # fmt: skip
    found.check()
    coarse, fine = (float(jnp.max(jnp.abs(x - found.q[2]))) for x in found.q[:2])
    assert np.log(coarse / fine) / np.log(4) > 1.85


@pytest.mark.slow
def test_with_inputs_that_jump():
    """A pushed mass on a floor moves as one with dry friction."""
    push = hhtjax.sampled(jnp.array([0.0, 3.0, -4.0, 6.0, 0.0, 2.0, -6.0, 5.0, 0.0, 1.0]), 0.1, order=0)
    on = hhtjax.Contact(lambda q, t, params: q[1], lambda q, v, t, params: v[0], 0.3)
    a = hhtjax.System(jnp.ones(2), lambda q, v, t, u: jnp.stack([u(t), -GRAVITY + 0 * t]), contact=on)
    b = hhtjax.System(
        jnp.ones(1),
        lambda q, v, t, u: u(t)[None],
        friction=lambda q, v, t, u: jnp.full(1, 0.3 * GRAVITY),
        sliding=lambda q, v, t, u: v,
    )
    how = {"dt": 0.02, "num_steps": 50}
    a, b = (hhtjax.simulate(x, PREDICTOR, jnp.zeros(n), jnp.zeros(n), push, **how) for x, n in ((a, 2), (b, 1)))
    a.check()
    assert jnp.max(jnp.abs(a.q[-1, 0] - b.q[-1, 0])) < 1e-12
    assert jnp.max(jnp.abs(b.q)) > 1e-3


@pytest.mark.slow
def test_other_ways_to_run_it():
    """Uneven steps, Newton, times between steps, float32, and events beside it give the same motion."""
    scene, h = ball(), np.random.default_rng(0).uniform(0.3, 1.7, 600)
    start = scene.q0, scene.v0, scene.params
    exact = run(scene, 9600, every=9600).q[-1]
    times = jnp.array([0.3, 0.4534, 1.01, 3.0])
    fine = run(scene, 30000).q[jnp.array([3000, 4534, 10100, 30000])]
    runs = [
        hhtjax.simulate(scene.system, PREDICTOR, *start, dt=jnp.asarray(h * 3 / h.sum()), save_every=600),
        run(scene, 600, hhtjax.hht(iterations=None), every=600),
        hhtjax.simulate(scene.system, PREDICTOR, *start, dt=0.005, times=times),
    ]
    for found in runs:
        found.check()
        assert jnp.max(jnp.abs(found.q[-1] - exact)) < 5e-6
    assert jnp.max(jnp.abs(runs[2].q[1:] - fine)) < 5e-5
    half = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), start)
    with pytest.warns(hhtjax.PrecisionWarning):
        found = hhtjax.simulate(scene.system, PREDICTOR, *half, dt=0.01, num_steps=300)
    found.check()
    assert found.q.dtype == found.contact.normal.dtype == jnp.float32
    assert jnp.max(jnp.abs(found.q[-1].astype(jnp.float64) - run(scene, 300).q[-1])) < 1e-5


@pytest.mark.slow
def test_contacts_that_depend_on_each_other_in_float32():
    """A rod that falls flat, and lies there: friction at both ends is known in its sum alone."""
    scene = rod()
    half = [jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), x) for x in (scene.q0, scene.v0, scene.params)]
    with pytest.warns(hhtjax.PrecisionWarning):
        found = hhtjax.simulate(scene.system, PREDICTOR, *half, dt=0.01, num_steps=100)
    found.check()
    assert found.q.dtype == jnp.float32
    assert bool(found.contact.closed[-1].all())
    assert jnp.max(jnp.abs(found.q[-1].astype(jnp.float64) - run(scene, 100).q[-1])) < 1e-4


@pytest.mark.slow
def test_events_and_contact():
    scene = ball()
    low = hhtjax.Event(guard=lambda q, v, t, params: q[1] - 0.3)
    found = hhtjax.simulate(
        scene.system, PREDICTOR, scene.q0, scene.v0, scene.params, dt=0.01, num_steps=300, events=[low],
        output=lambda q, contact: {"y": q[1], "pushes": contact.closed},
    )  # fmt: skip
    found.check()
    assert int(found.events.count) == 2
    assert jnp.allclose(found.output["y"], run(scene, 300).q[:, 1], atol=1e-12)
    assert bool(found.output["pushes"][-1, 0])


@pytest.mark.slow
def test_sensors_see_contact():
    scene = slope()
    found = run(scene, 20)
    shown = hhtjax.measure(
        found, found.t[:-1] + 0.02, output=lambda q, contact: {"place": q[0], "push": contact.normal[0]}
    )
    rate = GRAVITY * (np.sin(0.3) - 0.2 * np.cos(0.3))
    assert jnp.allclose(shown["place"], rate * (found.t[:-1] + 0.02) ** 2 / 2, atol=1e-12)
    assert jnp.allclose(shown["push"], GRAVITY * np.cos(0.3), atol=1e-12)


@pytest.mark.slow
def test_what_is_known_of_contacts_survives_an_event():
    """One that changes nothing, while the ball rests and slides."""
    scene = ball()
    same = hhtjax.Event(at=2.505, reset=lambda q, v, t, params: v)
    a, b = (
        hhtjax.simulate(
            scene.system, PREDICTOR, scene.q0, jnp.array([6.0, 0.0]), scene.params, dt=0.01, num_steps=300, **how
        )
        for how in ({}, {"events": [same]})
    )
    b.check()
    assert int(a.contact.impacts[-1, 0]) == int(b.contact.impacts[-1, 0]) > 5
    assert a.contact.rests_since[-1, 0] == b.contact.rests_since[-1, 0] > 1
    assert jnp.max(jnp.abs(a.q - b.q)) < 1e-5


@pytest.mark.slow
def test_gaps_of_curved_floors_are_closed():
    """Where two corrections of a step do not close them."""

    def height(x):
        return jnp.sin(3 * x) / 2

    wavy = hhtjax.Contact(lambda q, t, params: q[1] - height(q[0]))
    system = hhtjax.System(jnp.ones(2), lambda q, v, t, params: jnp.array([0.0, -GRAVITY]), contact=wavy)
    start = jnp.array([-0.9, height(-0.9)]), jnp.array([0.5, 0.75 * jnp.cos(-2.7)])
    found = hhtjax.simulate(system, PREDICTOR, *start, dt=0.05, num_steps=40)
    found.check()
    assert bool(found.contact.closed.all())
    assert not bool(found.contact.sticking.any())
    assert jnp.max(jnp.abs(found.q[:, 1] - height(found.q[:, 0]))) < 1e-12


@pytest.mark.slow
def test_a_guide_without_clearance():
    """Two contacts that face each other: one of them is closed, the other lets go, and the body stays where it is."""
    guide = hhtjax.Contact(lambda q, t, params: jnp.stack([q[0], -q[0]]), restitution=0.5)
    system = hhtjax.System(jnp.ones(1), lambda q, v, t, params: 3 * jnp.sin(3 * t) + 0 * q, contact=guide)
    found = hhtjax.simulate(system, PREDICTOR, jnp.zeros(1), jnp.zeros(1), dt=0.004, num_steps=1000)
    found.check()
    assert jnp.max(jnp.abs(found.q)) < 1e-15
    push = found.contact.normal[:, 1] - found.contact.normal[:, 0]
    assert jnp.max(jnp.abs(push - 3 * jnp.sin(3 * found.t))) < 1e-10


# ----------------------------------------------------------------------------
# What is refused, and what is told.


def at_rest(contact, q=0.0, v=0.0, stepper=PREDICTOR, **how):
    system = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -GRAVITY + 0 * q, contact=contact)
    how = how or {"dt": 0.01, "num_steps": 3}
    return hhtjax.simulate(system, stepper, jnp.full(1, q), jnp.full(1, v), {"e": 0.5}, **how)


def gap(q, t, params):
    return q[0]


def test_bad_contacts_are_named():
    with pytest.raises(TypeError, match="`gap` must be a function"):
        hhtjax.Contact(3.0)
    with pytest.raises(ValueError, match="`friction` needs `sliding`"):
        hhtjax.Contact(gap, friction=0.3)
    with pytest.raises(ValueError, match=r"`restitution` must lie in \[0, 1\]; received 1.2"):
        hhtjax.Contact(gap, restitution=1.2)
    with pytest.raises(ValueError, match=r"`friction` must not be negative; received -0.1"):
        hhtjax.Contact(gap, lambda q, v, t, params: v[0], friction=-0.1)
    with pytest.raises(ValueError, match="1 <= m <= 4; received shape"):
        at_rest(hhtjax.Contact(lambda q, t, params: jnp.arange(5.0) + q[0]))
    with pytest.raises(ValueError, match="one velocity for each gap"):
        at_rest(hhtjax.Contact(gap, lambda q, v, t, params: jnp.stack([v[0], v[0]])))
    with pytest.raises(ValueError, match="must be a name in params; received 'elastic'"):
        at_rest(hhtjax.Contact(gap, restitution="elastic"))
    with pytest.raises(TypeError, match="`contact` must be a Contact"):
        hhtjax.System(jnp.ones(1), lambda q, v, t, params: -q, contact=gap)
    with pytest.raises(NotImplementedError, match="give either `contact` or `friction`"):
        hhtjax.System(
            jnp.ones(1), lambda q, v, t, params: -q, friction=lambda q, v, t, params: 1.0, contact=hhtjax.Contact(gap)
        )


def test_a_system_that_is_there_gets_contact():
    contact = hhtjax.Contact(gap)
    of_dynamics = hhtjax.System(dynamics=lambda q, v, w, t, params: w + GRAVITY)
    assert dataclasses.replace(of_dynamics, contact=contact).contact is contact
    falling = hhtjax.System.from_lagrangian(lambda q, v, t, params: jnp.sum(v**2) / 2 - GRAVITY * q[0], contact=contact)
    assert falling.contact is contact
    with pytest.raises(TypeError, match="give either `dynamics` or `force`"):
        hhtjax.System(force=lambda q, v, t, params: -q, dynamics=lambda q, v, w, t, params: w)


def test_what_does_not_know_contact_says_so():
    contact = hhtjax.Contact(gap)
    system = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -q, contact=contact)
    start = jnp.ones(1), jnp.zeros(1)
    for stepper in (hhtjax.rk4(), hhtjax.rodas5p(), hhtjax.extrapolated(), hhtjax.kim_hht()):
        with pytest.raises(NotImplementedError, match="cannot solve `contact`; use hht"):
            at_rest(contact, stepper=stepper)
    with pytest.raises(NotImplementedError, match="error control does not support `contact`"):
        at_rest(contact, dt=hhtjax.adaptive(1e-6, 1e-8), times=[0.1])
    with pytest.raises(NotImplementedError, match="leave `extrapolate` out with contact"):
        at_rest(contact, dt=0.01, num_steps=4, extrapolate=2)
    with pytest.raises(NotImplementedError, match="has contact, whose forces are not functions of q and v"):
        hhtjax.interop.scipy_rhs(system, *start)(0.0, jnp.ones(2))
    with pytest.raises(NotImplementedError, match="has contact, whose forces are not measured"):
        hhtjax.equation_error(system, jnp.ones((99, 1)), 0.01, cutoff=5.0)
    with pytest.raises(NotImplementedError, match="has contact: take hht"):
        hhtjax.analysis.choose_stepper(system, *start, duration=1.0)


@pytest.mark.slow
def test_bad_starts_are_named():
    contact = hhtjax.Contact(gap)
    with pytest.raises(ValueError, match=r"`q0` must keep bodies apart: the gap of contact 0 is -0.1; expected 0"):
        at_rest(contact, q=-0.1)
    with pytest.raises(ValueError, match="`v0` must not press bodies together that touch: the gap of contact 0 is 0"):
        at_rest(contact, v=-1.0)
    for *start, flaw in ((-0.1, 0.0, "bodies overlap"), (0.0, -1.0, "bodies touch and move into each other")):
        with pytest.raises(hhtjax.SimulationError, match=f"failed: at the start {flaw}"):
            jax.jit(lambda q, v: at_rest(contact, q=q, v=v))(*start).check()


@pytest.mark.slow
def test_coefficients_out_of_range_are_named():
    """Those that are in params, too; negative friction would drive what slides."""
    contact = hhtjax.Contact(lambda q, t, params: q[1], lambda q, v, t, params: v[0], "mu", "e")
    system = hhtjax.System(jnp.ones(2), lambda q, v, t, params: jnp.array([0.0, -GRAVITY]), contact=contact)

    def slides(mu, e):
        return run(Scene(system, jnp.zeros(2), jnp.array([1.0, 0.0]), {"mu": mu, "e": e}, 0.1), 2)

    for mu in (-0.2, jnp.nan, jnp.inf):
        with pytest.raises(ValueError, match="`friction` of the contacts must be finite numbers, 0 or more; received"):
            slides(mu, 0.5)
    with pytest.raises(
        ValueError, match=r"`restitution` of the contacts must be numbers in \[0, 1\]; received \[1.5\]"
    ):
        slides(0.2, 1.5)
    for mu, e in ((-0.2, 0.5), (jnp.nan, 0.5), (0.2, 1.5)):
        with pytest.raises(
            hhtjax.SimulationError,
            match="a contact must be a finite number, 0 or more, and its `restitution`",
        ):
            jax.jit(slides)(mu, e).check()


@pytest.mark.slow
def test_failures_are_named(monkeypatch):
    def failure(scene: Scene, steps: int, **params):
        with pytest.warns(hhtjax.FailedRunWarning):
            found = run(scene, steps, **params)
        with pytest.raises(hhtjax.SimulationError) as told:
            found.check()
        return str(told.value)

    jams = rod(1.05, 1.5)  # pushed like chalk: 1 + 3 cos^2 < 3 mu sin cos
    assert "step 1 (to t = 0.025) failed: a contact jams" in failure(jams._replace(v0=-jams.v0), 40)
    flat = jnp.array([0.0, 0.5, 0.0]), jnp.zeros(3), {"mu": 0.4}, 1.0, 0.5
    assert "collide at the same time" in failure(standing([(-0.5, 0.0), (0.5, 0.0)], 1 / 12, *flat), 100)
    monkeypatch.setattr("hhtjax.steppers.contact.SWITCHES", (0, 0))
    assert "separate, stick and slide too often within the step" in failure(disc(0.3), 40)


@pytest.mark.slow
def test_a_spring_in_place_of_contact_that_makes_energy_is_named():
    """It stays finite, and only its energy tells."""

    def force(q, v, t, params):
        return jnp.where(q < 0, -1e7 * q, 0 * q) - GRAVITY

    system = hhtjax.System(jnp.ones(1), force)
    found = hhtjax.simulate(system, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), dt=1 / 200, num_steps=200)
    found.check()
    balance = hhtjax.analysis.energy_balance(system, found)
    with pytest.raises(hhtjax.SimulationError, match=r"by t = 0.455 the method has made 37.3 J"):
        balance.check()
    balance.check(part=1e3)
    with pytest.raises(ValueError, match="`part` must be positive"):
        balance.check(part=-1.0)
