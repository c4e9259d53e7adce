"""Each constrained scene against what is known of it: reference solutions, closed forms, singular positions."""

import json
from functools import cache, partial
from pathlib import Path

import jax
import numpy as np
import pytest
from index_1 import SCENES, UPRIGHT, flat, index_1, path, times
from scipy.integrate import solve_ivp

from hhtjax.scenes import four_bars, pendulum, squeezer


@cache
def read(name):
    """Reference states, a dict of arrays over time; and the whole file."""
    data = json.loads((Path(__file__).parent / "data" / f"{name}.json").read_text())
    return {key: np.array([state[key] for state in data["states"]]) for key in data["states"][0]}, data


def test_squeezer_accelerations_and_multipliers():
    """At all reference states, the start included. Their multipliers have the opposite sign."""
    states, _ = read("squeezer")
    scene = SCENES["squeezer"]
    solve = jax.jit(jax.vmap(partial(index_1, scene), (None, 0, 0)))
    w, L = solve(scene.params, states["q"], states["v"])
    for x, exact in (w, states["a"]), (L, -states["lambda"]):
        error = np.max(np.abs(x - exact), axis=1) / np.max(np.abs(exact), axis=1)
        assert np.max(error) < 1e-12

    # it starts in a dead centre, where the moment meets the inertia of crank and coupler alone
    doubled, _ = solve(squeezer.squeezer(moment=0.066).params, states["q"], states["v"])
    np.testing.assert_allclose(doubled[0], 2 * w[0], atol=1e-8)


def test_squeezer_reaches_the_reference():
    states, data = read("squeezer")
    every = slice(None, None, 4)
    q, v = (x[every] for x in path("squeezer", times("squeezer")))
    np.testing.assert_allclose(times("squeezer")[every], states["t"], rtol=1e-15)
    assert np.all(states["q"][0] == SCENES["squeezer"].q0)
    assert np.max(np.abs(q - states["q"])) < 1e-9
    assert np.max(np.abs(v - states["v"])) < 1e-6
    assert np.max(np.abs(q[-1] - data["published"]["q"])) < 1e-8


def test_pendulum_accelerations_and_multiplier():
    states, _ = read("constrained_pendulum")
    scene = SCENES["pendulum"]
    w, L = jax.jit(jax.vmap(partial(index_1, scene, scene.params)))(states["q"], states["v"])
    np.testing.assert_allclose(w, states["a"], atol=1e-13)
    np.testing.assert_allclose(L[:, 0], states["multiplier"], rtol=1e-13)


def test_pendulum_in_two_coordinates_and_in_one():
    states, _ = read("constrained_pendulum")
    until = states["t"] <= 2
    states = {key: x[until] for key, x in states.items()}
    q, v = path("pendulum", tuple(states["t"]))
    angle, rate = path("minimal pendulum", tuple(states["t"]))
    for x, exact in (q, "q"), (v, "v"), (angle[:, 0], "theta"), (rate[:, 0], "omega"):
        assert np.max(np.abs(x - states[exact])) < 1e-9


def test_elastic_pendulum_follows_the_rod_and_hardly_vibrates():
    """Its distance from the rod's motion falls with 1/k, and its spring carries the tension of the motion it makes."""
    name, g = "elastic pendulum", pendulum.GRAVITY
    rod, _ = path("pendulum", times(name))
    q, v = path(name, times(name))
    r = np.hypot(*q.T)
    tension = (-g * q[:, 1] + v[:, 0] ** 2 + v[:, 1] ** 2) / r
    stretch = r - SCENES[name].params["l"]
    assert 1e-3 < np.max(np.abs(q - rod)) < 1e-2
    assert np.max(stretch) > 2e-3
    assert np.max(np.abs(stretch - tension / SCENES[name].params["k"])) < 0.01 * np.max(stretch)

    _, _, _, q0, v0 = flat(pendulum.elastic(1e9))
    assert np.max(np.abs(q0 - SCENES["pendulum"].q0)) < 1e-7
    assert np.all(v0 == SCENES["pendulum"].v0)


@pytest.mark.parametrize("name", ["free slider-crank", "driven slider-crank"])
def test_slider_crank_closes_over_full_turns(name):
    l1, l2 = SCENES[name].params["l"]
    q, v = path(name, times(name))
    angle = q[:, 0]
    assert angle[-1] - angle[0] > 2 * np.pi
    root = np.sqrt(l2**2 - (l1 * np.sin(angle)) ** 2)
    slope = -l1 * np.sin(angle) * (1 + l1 * np.cos(angle) / root)
    assert np.max(np.abs(q[:, 2] - (l1 * np.cos(angle) + root))) < 1e-10
    assert np.max(np.abs(v[:, 2] - slope * v[:, 0])) < 1e-8


def parallel(loops, angle, rate):
    """Four bars with all cranks at one angle, flat q and v."""
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    pivots = np.stack([np.arange(loops + 1.0), np.zeros(loops + 1)], axis=1)
    return (pivots + along).ravel(), np.tile(rate * across, loops + 1)


def angular_acceleration(loops, angle):
    """((N + 1)/3 + N) l a'' = -((N + 1)/2 + N) g cos a."""
    return -((loops + 1) / 2 + loops) / ((loops + 1) / 3 + loops) * four_bars.GRAVITY * np.cos(angle)


@pytest.mark.parametrize(("name", "loops"), [("one four-bar", 1), ("four bars", 2), ("five four-bars", 5)])
def test_four_bars_have_one_degree_of_freedom(name, loops):
    """Angular acceleration of the cranks all around, and their motion from the start."""
    scene = SCENES[name]
    solve = jax.jit(partial(index_1, scene, scene.params))
    for angle in np.linspace(0.1, 6.1, 9):
        q, v = parallel(loops, angle, rate=-2.0)
        along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        w = angular_acceleration(loops, angle) * across - 4.0 * along
        assert np.max(np.abs(solve(q, v)[0] - np.tile(w, loops + 1))) < 1e-10

    def rate(t, y):
        return y[1], angular_acceleration(loops, y[0])

    angle = solve_ivp(rate, (0, UPRIGHT), (np.pi / 2, -1.0), "DOP853", times(name), rtol=1e-12, atol=1e-13).y[0]
    exact = np.array([parallel(loops, a, 0.0)[0] for a in angle])
    assert 0 < angle[-1] < 0.5
    assert np.max(np.abs(path(name, times(name))[0] - exact)) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize(("name", "loops"), [("one four-bar", 1), ("four bars", 2), ("five four-bars", 5)])
def test_four_bars_lose_rank_where_all_bars_align(name, loops):
    """From 2 N + 1 to N + 1."""
    scene = SCENES[name]
    constraint = flat(scene)[2]
    jacobian = jax.jit(jax.jacfwd(lambda q: constraint(q, 0.0, scene.params)))
    for angle, rank in (np.pi / 2, 2 * loops + 1), (0.3, 2 * loops + 1), (0.0, loops + 1), (np.pi, loops + 1):
        q, _ = parallel(loops, angle, 0.0)
        assert np.max(np.abs(constraint(q, 0.0, scene.params))) < 1e-15
        assert np.linalg.matrix_rank(jacobian(q), tol=1e-12) == rank
