"""Houbolt, Park, Wilson and collocation against their textbook formulas, by autodiff of the library's own steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slope

import hhtjax
from hhtjax.steppers.collocation import collocation

M, C, K, H = 2.0, 0.6, 50.0, 0.3


def oscillator(k=K, c=C):
    return hhtjax.LinearSystem(jnp.array([M]), jnp.array([c]), jnp.array([k]))


def collocation_matrix(beta, theta, m, c, k, h):
    """The step as a matrix on (q, v, w), gamma = 1/2: first w1 from the collocated equation, then q1, v1."""

    def positions(h, weight):
        """q and v at t + h as rows on (q, v, w, w1), the acceleration there being (1 - weight) w + weight w1."""
        q = [1, h, h**2 * (0.5 - beta * weight), h**2 * beta * weight]
        return np.array([q, [0, 1, h * (1 - weight / 2), h * weight / 2]])

    q, v = positions(theta * h, theta)
    row = m * np.array([0, 0, 1 - theta, theta]) + c * v + k * q
    w1 = -row[:3] / row[3]
    return np.vstack([positions(h, 1.0) @ np.vstack([np.eye(3), w1]), w1])


COLLOCATION = {"wilson": hhtjax.wilson(), "collocation": collocation(0.18, 1.287301)}


def collocation_step(method, system, h):
    def step(x):
        state = method.init(system, x[:1], x[1:2], None, h)._replace(v=x[1:2], w=x[2:])
        state, _ = method.step(system, state, None, h)
        return jnp.concatenate([state.q, state.v, state.w])

    return jax.jit(step)


@pytest.mark.parametrize("name", COLLOCATION)
def test_collocation_has_the_closed_form_amplification_matrix(name):
    method = COLLOCATION[name]
    ours = jax.jacfwd(collocation_step(method, oscillator(), H))(jnp.array([0.3, -0.2, 0.1]))
    exact = collocation_matrix(method.beta, method.theta, M, C, K, H)
    np.testing.assert_allclose(ours, exact, rtol=1e-11)


@pytest.mark.parametrize(("theta", "stable"), [(1.36, False), (1.37, True)])
def test_wilson_is_unconditionally_stable_from_theta_1_366(theta, stable):
    def radius(frequency):
        return np.abs(np.linalg.eigvals(collocation_matrix(1 / 6, theta, 1.0, 0.0, frequency**2, 1.0))).max()

    radii = [radius(x) for x in np.logspace(-2, 5, 200)]
    assert (max(radii) <= 1 + 1e-12) == stable


def test_wilson_overshoots_and_newmark_does_not():
    """From q = 1 at rest with a step of ten periods, and w = M^-1 Q."""
    frequency_h = 20 * np.pi
    k = M * frequency_h**2 / H**2
    system = oscillator(k=k, c=0.0)

    def first(method):
        state = method.init(system, jnp.ones(1), jnp.zeros(1), None, H)
        state, _ = method.step(system, state._replace(w=jnp.array([-k / M])), None, H)
        return float(state.q[0])

    assert first(hhtjax.wilson(1.4)) == pytest.approx(1 - frequency_h**2 * (1 - 1 / 1.4) / 2, rel=1e-2)
    assert abs(first(hhtjax.newmark())) <= 1


HOUBOLT = np.array([2, -5, 4, -1]), np.array([11, -18, 9, -2]) / 6  # of h^2 w and of h v, on q1, q, ...
PARK = np.array([10, -15, 6, -1]) / 6  # of h v on q1, q, ..., and of h w on v1, v, ...
CHARACTERISTIC = {  # on the powers of z, from the highest: the history of a motion q_k = z^k
    "houbolt": lambda m, c, k, h: m / h**2 * HOUBOLT[0] + c / h * HOUBOLT[1] + [k, 0, 0, 0],
    "park": lambda m, c, k, h: np.polyadd(
        m / h**2 * np.polymul(PARK, PARK), np.polymul(c / h * PARK + [k, 0, 0, 0], [1, 0, 0, 0])
    ),
}


@pytest.mark.parametrize("name", CHARACTERISTIC)
def test_backward_differences_have_their_characteristic_roots(name):
    method = getattr(hhtjax, name)()

    @jax.jit
    def step(x, k):
        system = hhtjax.LinearSystem(jnp.array([M]), jnp.array([C]), lambda params: jnp.array([params]))
        state = method.init(system, x[:1], x[1:2], k, H)
        past = state.memory._replace(q=x[2:4, None], v=x[4:, None], count=jnp.asarray(2))
        state, _ = method.step(system, state._replace(memory=past), k, H)
        return jnp.concatenate([state.q, state.v, state.memory.q[:, 0], state.memory.v[:, 0]])

    def radii(k):
        return np.sort(np.abs(np.linalg.eigvals(jax.jacfwd(step)(jnp.linspace(0.1, 0.6, 6), k))))

    exact = np.sort(np.abs(np.roots(CHARACTERISTIC[name](M, C, K, H))))
    np.testing.assert_allclose(radii(K)[-len(exact) :], exact, rtol=1e-5)  # of the others, which are zero, two join
    assert radii(1e20)[-1] < 1e-2
    assert 0.99 < radii(1e-3)[-1] < 1


@pytest.mark.slow
@pytest.mark.parametrize("name", CHARACTERISTIC)
def test_the_analyses_are_of_backward_differences_and_not_of_their_starter(name):
    """Oscillators with w h = 0.1, where a spurious root of Park's oscillates faster, and 1; y' = z y by BDF3."""
    method = getattr(hhtjax, name)()
    for W, damping in ((0.1, 0.0), (1.0, 0.02)):
        roots = np.roots(CHARACTERISTIC[name](1.0, 2 * damping * W, W**2, 1.0))
        rate = np.log(min(roots, key=lambda x: abs(x - np.exp(1j * W))))
        assert hhtjax.analysis.spectral_radius(method, W, damping) == pytest.approx(max(abs(roots)), rel=1e-9)
        assert hhtjax.analysis.damping_ratio(method, W, damping) == pytest.approx(-rate.real / abs(rate), rel=1e-6)
        assert hhtjax.analysis.period_elongation(method, W, damping) == pytest.approx(W / abs(rate) - 1, rel=1e-6)
    if name == "houbolt":
        z = 0.2 + 1j
        exact = np.abs(np.roots(HOUBOLT[1] - [z, 0, 0, 0])).max()
        assert hhtjax.analysis.stability_region(method, np.array([z]))[0] == pytest.approx(exact, rel=1e-9)


@pytest.mark.slow
def test_order_with_a_mass_that_changes():
    assert slope("forced double pendulum", hhtjax.park()) == pytest.approx(2, abs=0.15)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: hhtjax.wilson(0.9), "wilson: `theta` must be 1 or more; received 0.9."),
        (lambda: collocation(0.3, 1.0), "collocation: `beta` must lie in"),
        (lambda: hhtjax.houbolt(tolerance=0), "houbolt: `tolerance` must be positive"),
        (lambda: hhtjax.park(max_iterations=0), "park: `max_iterations` must be a positive integer"),
    ],
)
def test_wrong_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()
