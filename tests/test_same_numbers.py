"""Programs that once gave other numbers than plain JAX, without a word: whole runs with the machinery and without."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax

COUPLING = np.random.default_rng(0).standard_normal((9, 9))


def turned_table(q, v, t, params):
    """A table read by columns: the order of a reshape."""
    table = q.reshape(9, 9)
    return -table.ravel(order="F") - 0.1 * (COUPLING @ table).T.ravel()


def small_turned_table(q, v, t, params):
    return -jnp.array([1.0, 2.0, 3.0, 4.0]) * q.reshape(2, 2).ravel(order="F")


def chain_with_a_fixed_end(q, v, t, params):
    """The neighbour of the last is the fill value of a gather."""
    neighbour = q.at[jnp.arange(3) + 1].get(mode="fill", fill_value=0.0)
    return neighbour - 2 * q + jnp.concatenate([jnp.zeros(1), q[:-1]])


def one_through_a_sine(q, v, t, params):
    """A scatter that computes."""
    return -q.at[1].apply(jnp.sin)


def bearing(q, v, t, params):
    """The sign of a zero decides on half a turn."""
    to_origin = jnp.array([0.0, 0.0]) - jnp.array([1.0, 0.0]) * q
    return jnp.array([jnp.arctan2(to_origin[1], to_origin[0]), 0.0])


def masked_root(q, v, t, params):
    """A zero of the user's does not hide what is not a number."""
    return jnp.array([1.0, 0.0, 1.0]) * jnp.sqrt(q - 0.5) - q


PROGRAMS = {
    "order of a reshape, arrays": (turned_table, jnp.linspace(0.0, 1.0, 81), hhtjax.hht()),
    "order of a reshape, scalars": (small_turned_table, jnp.array([0.1, 0.7, -0.3, 0.5]), hhtjax.hht()),
    "fill value of a gather": (chain_with_a_fixed_end, jnp.array([0.1, 0.2, 0.3]), hhtjax.rk4()),
    "scatter that computes": (one_through_a_sine, jnp.array([0.7, -1.3, 0.4]), hhtjax.rk4()),
    "sign of a zero": (bearing, jnp.array([0.0, 0.3]), hhtjax.rk4()),
    "zero times NaN": (masked_root, jnp.array([1.0, 0.505, 1.0]), hhtjax.rk4()),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
@pytest.mark.compiled
def test_a_run_is_the_same_with_and_without(name):
    force, q0, stepper = PROGRAMS[name]
    system = hhtjax.System(np.ones(q0.size), force)

    def run(q0):
        return hhtjax.simulate(system, stepper, q0, 0.1 * q0, dt=0.1, num_steps=6)

    fast = run(q0)
    with hhtjax.plain():
        plain = run(q0)
    for x, y in zip(jax.tree.leaves(fast), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-14)
        zeros = np.asarray(x) == 0
        np.testing.assert_array_equal(np.signbit(x)[zeros], np.signbit(y)[zeros])


@pytest.mark.compiled
def test_zero_times_nan_is_told():
    force, q0, stepper = PROGRAMS["zero times NaN"]
    run = hhtjax.simulate(hhtjax.System(np.ones(3), force), stepper, q0, 0.1 * q0, dt=0.1, num_steps=6)
    with pytest.raises(hhtjax.SimulationError, match="not finite"):
        run.check()
