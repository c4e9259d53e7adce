"""Bodies that touch: they rest, stick, slide, let go, and land."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contact_problems import GRAVITY, Scene, ball, block, disc, stack, table

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
def test_a_stack_at_rest_does_not_move():
    found = run(stack(0.0), 100)
    found.check()
    assert jnp.max(jnp.abs(found.q - found.q[:1])) <= 1e-15
    weights = GRAVITY * jnp.array([2.2, 1.2, 0.5])
    assert jnp.max(jnp.abs(found.contact.normal - weights[None])) < 1e-12
    assert bool(found.contact.sticking.all())


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

    def gap(q, t, params):
        return q[0]

    floor = hhtjax.Event(guard=lambda q, v, t, params: q[0], reset=hhtjax.impact(restitution=0.7))
    by_contact = hhtjax.System(jnp.ones(1), force, contact=hhtjax.Contact(gap, restitution=0.7))
    by_event = hhtjax.System(jnp.ones(1), force)
    how = {"dt": 0.01, "num_steps": 150}
    start = PREDICTOR, jnp.ones(1), jnp.zeros(1)
    a, b = hhtjax.simulate(by_contact, *start, **how), hhtjax.simulate(by_event, *start, events=[floor], **how)
    a.check()
    assert int(a.contact.impacts[-1, 0]) == int(b.events.count) > 1
    assert jnp.max(jnp.abs(a.q - b.q)) < 1e-11
    assert jnp.max(jnp.abs(a.v - b.v)) < 1e-10


# ----------------------------------------------------------------------------
# Order, and derivatives.


def slope(errors: list, steps: list) -> float:
    return -float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


@pytest.mark.slow
@pytest.mark.parametrize(("make", "alpha"), [(ball, -0.05), (ball, 0.0), (table, -0.05), (table, -0.3)])
def test_the_order_through_impacts_and_switches_is_two(make, alpha):
    scene, steps, most = make(), [320, 640, 1280, 2560], 20480
    stepper = hhtjax.hht(alpha=alpha, linearize="predictor")
    exact = run(scene, most, PREDICTOR, most // 40)
    errors = []
    for n in steps:
        found = run(scene, n, stepper, n // 40)
        found.check()
        errors.append([float(jnp.max(jnp.abs(x - y))) for x, y in ((found.q, exact.q), (found.v, exact.v))])
    q, v = zip(*errors, strict=True)
    assert 1.85 < slope(q, steps)
    assert 1.7 < slope(v, steps)


@pytest.mark.slow
@pytest.mark.parametrize(("make", "name", "steps"), [(ball, "e", 40), (ball, "mu", 160), (table, "mu", 160)])
def test_derivatives_are_those_of_the_run(make, name, steps):
    scene, h = make(), 1e-6

    def end(x):
        return run(scene, steps, every=steps, **{name: x}).q[-1]

    x = scene.params[name]
    forward, reverse = (f(end)(x) for f in (jax.jacfwd, jax.jacrev))
    central = (end(x + h) - end(x - h)) / (2 * h)
    assert jnp.allclose(forward, reverse, rtol=1e-12, atol=1e-12)
    assert jnp.allclose(forward, central, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_a_block_rocks_until_it_stands():
    """With each impact of a corner it keeps 1 - 3/2 sin^2 of its turning, by the angular momentum about that corner
    (Housner, Bull. Seismol. Soc. Am. 53, 1963, 403-417); in the end both corners stay down."""
    scene = block()
    found = run(scene, 600)
    found.check()
    assert int(found.contact.impacts[-1].sum()) > 10
    one = found.contact.closed.sum(axis=1) == 1
    falls = jnp.abs(found.v[:, 2])
    assert bool(found.contact.closed[-1].all())
    assert jnp.allclose(found.q[-1], jnp.array([found.q[-1, 0], 1.0, 0.0]), atol=1e-14)
    assert not jnp.any(found.v[-1])
    assert jnp.allclose(found.contact.normal[-1], GRAVITY / 2, atol=1e-12)


# ----------------------------------------------------------------------------
# What is refused, and what is told.


def at_rest(contact, q=0.0, v=0.0, stepper=PREDICTOR):
    system = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -GRAVITY + 0 * q, contact=contact)
    return hhtjax.simulate(system, stepper, jnp.full(1, q), jnp.full(1, v), {"e": 0.5}, dt=0.01, num_steps=3)


def gap(q, t, params):
    return q[0]


def test_bad_contacts_are_named():
    with pytest.raises(TypeError, match="`gap` must be a function"):
        hhtjax.Contact(3.0)
    with pytest.raises(ValueError, match="`friction` needs `sliding`"):
        hhtjax.Contact(gap, friction=0.3)
    with pytest.raises(ValueError, match="`restitution` must lie in \\[0, 1\\]; received 1.2"):
        hhtjax.Contact(gap, restitution=1.2)
    with pytest.raises(ValueError, match="`friction` must not be negative; received -0.1"):
        hhtjax.Contact(gap, lambda q, v, t, params: v[0], friction=-0.1)
    with pytest.raises(ValueError, match="1 <= m <= 4; received shape"):
        at_rest(hhtjax.Contact(lambda q, t, params: jnp.arange(5.0) + q[0]))
    with pytest.raises(ValueError, match="one velocity for each gap"):
        at_rest(hhtjax.Contact(gap, lambda q, v, t, params: jnp.stack([v[0], v[0]])))
    with pytest.raises(ValueError, match="the name 'elastic', which params do not have"):
        at_rest(hhtjax.Contact(gap, restitution="elastic"))
    with pytest.raises(NotImplementedError, match="cannot solve `contact`"):
        at_rest(hhtjax.Contact(gap), stepper=hhtjax.rk4())
    with pytest.raises(TypeError, match="`contact` must be a Contact"):
        hhtjax.System(jnp.ones(1), lambda q, v, t, params: -q, contact=gap)
