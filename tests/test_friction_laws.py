"""Dry friction of several joints, on their velocities and forces alone: random instances, against what is exact."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hhtjax.steppers.friction_switching import run_events, switch
from hhtjax.systems.friction import at_rest


def balanced(K, load, f):
    """sig and tau of joints at rest by trial: of all choices of who slides, and where to, the one nothing speaks
    against."""
    N, m = f.shape
    sig, tau, least = np.zeros((N, m)), np.zeros((N, m)), np.full(N, np.inf)
    for trial in product((0.0, 1.0, -1.0), repeat=m):
        d = np.array(trial)
        held, slid = d == 0, d * f
        block = np.where(held[:, None] & held, K, np.eye(m))
        rest = np.where(held, load - (K @ slid[..., None])[..., 0], 0)
        force = slid + np.linalg.solve(block, rest[..., None])[..., 0]
        rate = load - (K @ force[..., None])[..., 0]
        over = np.max(np.where(held, np.abs(force) - f, -d * rate), axis=1)
        better = over < least
        least = np.where(better, over, least)
        sig[better], tau[better] = d, force[better]
    assert np.all(least < 1e-12)
    return sig, tau


def test_joints_at_rest_are_balanced():
    """However nearly they depend on each other; some of several, and one alone. Sweeps over joints need thousands."""
    rng, N = np.random.default_rng(11), 1500
    for m in (1, 4):
        B = rng.normal(size=(N, m, m + 1))
        K = B @ B.transpose(0, 2, 1)
        f, load = 10 ** rng.uniform(-1, 1, (N, m)), rng.normal(size=(N, m)) * 10 ** rng.uniform(-1, 2, (N, 1))
        rests = (rng.random((N, m)) < 0.9) | (m == 1)
        sig, tau = jax.jit(jax.vmap(at_rest))(*map(jnp.asarray, (K, rests, load, f)))
        alone = np.where(rests[:, None] & rests[..., None], K, np.eye(m))
        exact = balanced(alone, np.where(rests, load, 0), f)
        np.testing.assert_array_equal(sig, exact[0])
        np.testing.assert_allclose(tau, exact[1], rtol=0, atol=1e-11)
        assert {-1, 0, 1} == set(np.unique(sig))


@pytest.mark.slow
def test_joints_that_do_not_jerk_each_other_switch_each_by_itself():
    """Also where all of them reverse within a step; with the same derivatives, those of a batch."""
    rng, m = np.random.default_rng(0), 3
    s, sf, f, W = np.abs(rng.normal(size=(4, 200, m)))
    sig = rng.choice([-1.0, 1.0], size=s.shape)
    s, sf, sig, tau, f, W, Wh = map(jnp.asarray, (sig * s, -sig * (sf + 1), sig, sig * f, f, W, W / 3))

    def alone(s, sf, sig, tau, f, W, Wh):
        return switch(sf, s, sig, tau, f, W, Wh), 0.0

    def coupled(s, sf, sig, tau, f, W, Wh):
        return run_events(sf, s, sig, tau, f, jnp.diag(W), jnp.diag(Wh))

    def by(law, *given):
        def force(*given):
            end, left = jax.vmap(law)(*given)
            return jnp.sum(end.tau @ jnp.arange(1.0, 1 + m)), (end, left)

        return jax.jit(jax.grad(force, argnums=(0, 1), has_aux=True))(*given)

    given = s, sf, sig, tau, f, W, Wh
    (expected, (exact, _)), (found, (end, left)) = by(alone, *given), by(coupled, *given)
    values, more = jax.jit(jax.vmap(coupled))(*given)
    assert not np.any(left)
    assert not np.any(more)
    np.testing.assert_array_equal(values.sig, end.sig)
    reverses = exact.sig == -sig
    assert np.any(np.all(reverses, axis=1))
    assert not np.all(reverses)
    for name in ("sig", "tau", "slid"):
        np.testing.assert_allclose(getattr(end, name), getattr(exact, name), atol=1e-12)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_loads_at_their_limits_end_the_step():
    """Many instances, as only roundings say whether such a joint breaks away."""
    rng, m, N = np.random.default_rng(7), 4, 4000
    B = rng.normal(size=(N, m, m + 1))
    K = B @ B.transpose(0, 2, 1) + 0.01 * np.eye(m)
    f, s = 10 ** rng.uniform(-1, 1, (N, m)), rng.normal(size=(N, m))
    sig = np.where(rng.random((N, m)) < 0.3, 0.0, np.sign(s))
    s = np.abs(sig) * s
    load = rng.choice([-1.0, 1.0], size=(N, m)) * f * rng.choice([1.0, 1.0, 1.5], size=(N, m))
    tau = np.where(sig == 0, np.sign(load) * f * rng.choice([1.0, 0.5], size=(N, m)), sig * f)
    sf = s + (K @ (load - sig * f)[..., None])[..., 0]
    _, left = jax.jit(jax.vmap(run_events))(*map(jnp.asarray, (sf, s, sig, tau, f, 0.6 * K, K)))
    assert not np.any(left)


@pytest.mark.slow
def test_derivatives_reach_the_end_of_violent_steps():
    """In 1 of 100 of these, two joints need more than two pieces each. Against central differences."""
    rng, m, N, short = np.random.default_rng(5), 2, 4000, 1e-7
    B = rng.normal(size=(N, m, m + 1))
    K = B @ B.transpose(0, 2, 1) + 0.01 * np.eye(m)
    f, s = 10 ** rng.uniform(-1, 1, (N, m)), rng.normal(size=(N, m)) * 10 ** rng.uniform(-1.5, 1, (N, 1))
    sig = np.where(rng.random((N, m)) < 0.3, 0.0, np.sign(s))
    s, tau = np.abs(sig) * s, np.where(sig == 0, rng.uniform(-1, 1, (N, m)) * f, sig * f)
    load = rng.normal(size=(N, m)) * 10 ** rng.uniform(-0.5, 1, (N, 1))
    sf = s + (K @ (load - sig * f)[..., None])[..., 0]
    given = tuple(map(jnp.asarray, (sf, s, sig, tau, f, 0.6 * K, K)))
    dots = jnp.asarray(rng.normal(size=(2, N, m)))

    def moved(x):
        end, left = jax.vmap(run_events)(given[0] + x * dots[0], *given[1:4], given[4] + x * dots[1], *given[5:])
        return end.tau, (end.sig, left)

    tau, slope, (sig, left) = jax.jit(lambda: jax.jvp(moved, (0.0,), (1.0,), has_aux=True))()
    moved = jax.jit(moved)
    exact, (same, _) = moved(0.0)
    assert not np.any(left)
    np.testing.assert_array_equal(sig, same)
    np.testing.assert_allclose(tau, exact, atol=1e-10)
    difference = (moved(short)[0] - moved(-short)[0]) / (2 * short)
    away = np.max(np.abs(slope - difference), axis=1) / (1 + np.max(np.abs(difference), axis=1))
    assert np.max(away) < 1e-5
