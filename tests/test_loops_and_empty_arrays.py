"""Batched loops, branches and empty arrays in what a user writes: as on plain JAX, or how they are counted and cut."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linked_pendulums import on_cpu, paths

import hhtjax
from hhtjax import primitives
from hhtjax.xla import fit_for_kernel


def counted(q, v, t, params):
    """Each coordinate halved as often as it says."""
    return -params * jax.vmap(lambda x: jax.lax.fori_loop(0, jnp.where(x > 0.5, 3, 2), lambda i, c: c / 2, x))(q)


def until(q, v, t, params):
    """Each coordinate halved until it is small."""
    return -params * jax.vmap(lambda x: jax.lax.while_loop(lambda c: jnp.abs(c) > 0.3, lambda c: c / 2, x))(q)


def nothing(q, v, t, params):
    """Empty arrays made, taken apart, joined, summed and multiplied."""
    empty = q[:0]
    return -params * (q + jnp.sum(jnp.sin(empty)) + jnp.concatenate([empty, q]) + jnp.zeros((3, 0)) @ empty)


@pytest.mark.slow
@pytest.mark.parametrize("force", [until, *(pytest.param(f, marks=pytest.mark.slow) for f in (counted, nothing))])
def test_they_give_what_plain_jax_gives(force):
    system = hhtjax.System(jnp.ones(3), force)
    q0 = jnp.array([0.1, 0.5, 1.0])

    def end(params):
        return hhtjax.simulate(system, hhtjax.rk4(), q0, 0 * q0, params, dt=0.01, num_steps=5).q[-1]

    def all_of(params):
        return end(params), jax.jvp(end, (params,), (params,)), jax.vmap(end)(jnp.stack([params, 2 * params]))

    found = jax.jit(all_of)(1.5)
    with hhtjax.plain():
        expected = jax.jit(all_of)(1.5)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert np.allclose(x, y, rtol=1e-12, atol=0)


@pytest.mark.slow
def test_a_leaf_of_no_coordinates():
    """In a long run, in its gradient, and in a sweep; alone it would be no system. And rotations of no body."""
    system = hhtjax.System(jnp.ones(2), lambda q, v, t, params: v | {"a": -params * q["a"]})
    q0 = {"a": jnp.array([1.0, 2.0]), "none": jnp.zeros(0), "turns": jnp.zeros((0, 3, 3))}
    v0 = {"a": jnp.zeros(2), "none": jnp.zeros(0), "turns": jnp.zeros((0, 3))}

    def run(params):
        return hhtjax.simulate(system, hhtjax.hht(), q0, v0, params, dt=0.01, num_steps=80)

    assert run(1.0).q["none"].shape == (81, 0)
    assert jnp.isfinite(jax.grad(lambda params: jnp.sum(run(params).q["a"]))(1.0))
    sweep = hhtjax.sweep(system, hhtjax.hht(), q0, v0, 1.0, dts=jnp.array([0.01, 0.02]), duration=0.8, num_samples=40)
    assert sweep.q["none"].shape == (2, 41, 0)
    assert hhtjax.interpolate(run(1.0), jnp.array([0.123])).q["turns"].shape == (1, 0, 3, 3)
    assert np.allclose(sweep.q["a"][0], run(1.0).q["a"][::2], rtol=1e-12)


@on_cpu
def test_branches_are_counted_by_themselves(monkeypatch):
    """As many operations as a kernel may have: in a branch, but not beside it, and not in all branches together."""

    def waves(x):
        for _ in range(30):
            x = jnp.sin(x) + 1.0
        return x

    def loop(f):
        return lambda x: primitives.one_kernel(lambda x: jax.lax.fori_loop(0, 3, lambda i, x: f(x), x), x)

    def seldom(x):
        return jax.lax.cond(x > 1, waves, lambda x: waves(x * 2), x)

    def told(f):
        return paths(loop(f), jnp.float32(0.5))[0]

    monkeypatch.setattr(fit_for_kernel, "MOST_OPERATIONS", 100)
    assert "more than 100 operations" in told(lambda x: waves(waves(x)))
    assert told(seldom) == "one kernel"
    monkeypatch.setattr(fit_for_kernel, "MOST_IN_BRANCHES", 100)
    assert "more than 100 operations in branches" in told(seldom)


@pytest.mark.slow
@on_cpu
def test_a_run_with_dry_friction_and_an_end_stop_is_one_kernel():
    """Ten times as fast as without, and its passage of events has four times the operations of all the rest."""
    system = hhtjax.System(
        lambda q, p: jnp.array([[3.0, jnp.cos(q[1])], [jnp.cos(q[1]), 2.0]]),
        lambda q, v, t, p: jnp.array([p + v[1] ** 2 * jnp.sin(q[1]), -jnp.sin(q[1])]),
        friction=lambda q, v, t, p: jnp.array([0.5, 0.0]),
    )
    stop = hhtjax.Event(lambda q, v, t, p: 1 - q[0], reset=hhtjax.impact(0.5))
    q0 = jnp.array([0.0, 0.1])
    found = paths(
        lambda p: hhtjax.simulate(system, hhtjax.hht(), q0, 0 * q0, p, dt=0.01, num_steps=99, events=[stop]).q, 2.0
    )
    assert found == ("one kernel",)
