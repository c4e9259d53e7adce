"""Initial values nearest to a guess that is far off: chains and loops of links, against SciPy's optimisers."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient
from scipy.optimize import minimize

import hhtjax

CHAIN = np.array([1.2, -1.05, -1.05])  # angles between links of 1 m
BARS = np.array([2.0, 4.0, 3.0, 4.0])  # crank, coupler, rocker, ground


def end_is_held(q, t, params):
    """A chain of links, its end at a place; q are the angles between them."""
    angles = jnp.cumsum(q)
    return jnp.stack([jnp.sum(jnp.cos(angles)), jnp.sum(jnp.sin(angles))]) - params


def is_closed(q, t, params):
    crank, coupler, rocker, ground = params
    across = crank * jnp.cos(q[0]) + coupler * jnp.cos(q[1]) - rocker * jnp.cos(q[2]) - ground
    return jnp.stack([across, crank * jnp.sin(q[0]) + coupler * jnp.sin(q[1]) - rocker * jnp.sin(q[2])])


@cache
def system(constraint, size=3):
    return hhtjax.System(jnp.ones(size), lambda q, v, t, params: 0 * v, constraint)


def close(guess, params):
    """A position of the four bars: crank as guessed, the rest from the triangle."""
    crank, coupler, rocker, ground = params
    a = crank * np.array([np.cos(guess), np.sin(guess)])
    across = np.array([ground, 0.0]) - a
    far = np.linalg.norm(across)
    turn = np.arccos((coupler**2 + far**2 - rocker**2) / (2 * coupler * far))
    angle = np.arctan2(across[1], across[0]) + turn
    b = a + coupler * np.array([np.cos(angle), np.sin(angle)]) - np.array([ground, 0.0])
    return np.array([guess, angle, np.arctan2(b[1], b[0])])


def nearest_by_scipy(constraint, guess, params, rng, starts=5):
    """The smallest distance that SLSQP finds from several starts."""
    found = [np.inf]
    for i in range(starts):
        start = guess + (i > 0) * rng.uniform(-1.5, 1.5, len(guess))
        phi = {"type": "eq", "fun": lambda q: np.asarray(constraint(q, params))}
        run = minimize(lambda q: np.sum((q - guess) ** 2) / 2, start, method="SLSQP", constraints=phi)
        if run.success and np.abs(constraint(run.x, params)).max() < 1e-6:
            found.append(float(np.linalg.norm(run.x - guess)))
    return min(found)


@partial(jax.jit, static_argnums=0)
def starts(made, guesses, params):
    """All of them, in one program; params are those of each."""
    return jax.vmap(lambda q, params: hhtjax.consistent_initial(made, q, 0 * q, params))(guesses, params)


def check_against_scipy(constraint, found, guesses, params, count):
    compiled = jax.jit(lambda q, params: constraint(q, 0.0, params))
    assert np.all(found.converged)
    left = jax.vmap(lambda q: compiled(q, params))(found.q)
    assert np.max(np.abs(left)) < 1e-10
    away, rng = np.linalg.norm(found.q - guesses, axis=1), np.random.default_rng(7)
    for i in range(count):
        assert away[i] < 1.05 * nearest_by_scipy(compiled, guesses[i], params, rng), i
    np.testing.assert_allclose(found.moved, np.max(np.abs(found.q - guesses), axis=1), rtol=1e-12)
    return away


@pytest.mark.slow
def test_three_links_that_are_guessed_badly():
    """300 guesses within 1.2 rad: Newton alone found 65 that are not the nearest, one 1155 rad away."""
    angles = np.cumsum(CHAIN)
    place = jnp.array([np.cos(angles).sum(), np.sin(angles).sum()])
    guesses = CHAIN + np.random.default_rng(0).uniform(-1.2, 1.2, (300, 3))
    found = starts(system(end_is_held), guesses, np.tile(place, (300, 1)))
    away = check_against_scipy(end_is_held, found, guesses, place, 12)
    assert np.all(away <= np.linalg.norm(guesses - CHAIN, axis=1) + 1e-9)  # CHAIN is a point on the constraint


@pytest.mark.slow
def test_four_bars_guessed_to_34_degrees():
    """200 guesses: Newton alone missed the nearest in 11."""
    truth = close(1.0, BARS)
    guesses = truth + np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3))
    found = starts(system(is_closed), guesses, np.tile(BARS, (200, 1)))
    away = check_against_scipy(is_closed, found, guesses, jnp.asarray(BARS), 12)
    assert np.all(away <= np.linalg.norm(guesses - truth, axis=1) + 1e-9)


def test_a_circle_from_inside():
    """Newton's iteration from near the centre went to the far side, or anywhere; the nearest is along the radius."""
    rod = system(lambda q, t, params: jnp.array([q @ q - params**2]), 2)
    for guess in ([0.05, 0.02], [-0.4, 0.3], [7.0, -3.0]):
        guess = np.array(guess)
        found = hhtjax.consistent_initial(rod, jnp.asarray(guess), jnp.zeros(2), 1.5)
        np.testing.assert_allclose(found.q, 1.5 * guess / np.linalg.norm(guess), rtol=1e-9)
        assert found.moved == pytest.approx(np.max(np.abs(found.q - guess)))


@pytest.mark.slow
def test_links_that_are_too_short_are_not_converged():
    """Under jit, too: a search that runs away leaves a part of Phi that is small beside q, but not small."""
    places = np.array([[4.0, 1.0], [3.1, 0.0], [-2.0, 6.0]])
    assert not np.any(starts(system(end_is_held), np.tile(CHAIN, (3, 1)), places).converged)
    for place in jnp.asarray(places):
        with pytest.raises(ValueError, match=r"no q with Phi\(q, t\) = 0 found near `q0`: .* is left of it"):
            hhtjax.consistent_initial(system(end_is_held), CHAIN, 0 * CHAIN, place)


@pytest.mark.slow
def test_derivatives_far_from_the_guess():
    """Of the nearest point, in the lengths: those of the conditions for a minimum."""
    four, guess = system(is_closed), jnp.asarray(close(1.0, BARS)) + jnp.array([0.5, -0.4, 0.3])

    def loss(bars):
        return jnp.sum(jnp.array([1.0, 2.0, -1.0]) * hhtjax.consistent_initial(four, guess, jnp.ones(3), bars).q)

    check_gradient(loss, jnp.asarray(BARS))
