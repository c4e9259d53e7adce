"""The switch: plain JAX, by a context, by the environment, or for a JAX that is not known."""

import re
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linked_pendulums import N, end, links, loss, on_cpu, paths

import hhtjax
from hhtjax import primitives
from hhtjax.primitives import compat
from hhtjax.xla import fit_for_kernel

GIVEN_AWAY = "xla_cpu_small_call", "inlineable", "hhtjax_staged"


def of_all_kinds(params):
    """A run by a function that was jitted outside, with a choice, stages, scalars and a matrix of a linear map."""
    return jax.value_and_grad(
        jax.jit(lambda p: jax.jit(loss)(p * primitives.choose(jnp.sign, jnp.sign, jax.lax.stop_gradient(p))))
    )(params)


@pytest.mark.slow
@on_cpu
def test_plain_leaves_nothing_of_the_machinery():
    fast = jax.jit(of_all_kinds)
    first = fast(2.0)
    assert "xla_cpu_small_call" in fast.lower(2.0).as_text()
    with hhtjax.plain():
        assert not [x for x in GIVEN_AWAY if x in fast.lower(2.0).as_text()]
        assert paths(of_all_kinds, 2.0) == ("plain: inside hhtjax.plain()",)
        assert np.allclose(fast(2.0), first, rtol=1e-12, atol=0)
    assert fast(2.0) == first
    assert "xla_cpu_small_call" in fast.lower(2.0).as_text()


@on_cpu
def test_plain_holds_for_its_own_thread():
    def is_on_in_plain():
        with hhtjax.plain():
            return compat.is_on(), paths(lambda params: end(params), 2.0)

    with ThreadPoolExecutor(1) as other:
        with hhtjax.plain():
            assert other.submit(compat.is_on).result()
            assert not compat.is_on()
        assert other.submit(is_on_in_plain).result() == (False, ("plain: inside hhtjax.plain()",))
        assert other.submit(compat.is_on).result()


@pytest.mark.slow
@on_cpu
def test_a_sweep_gives_the_same_without_the_machinery():
    system = hhtjax.System(jnp.arange(1.0, N + 1), links)
    q0, dts = jnp.linspace(0.1, 1.0, N), jnp.array([0.01, 0.02, 0.05])

    def sweep():
        return hhtjax.sweep(system, hhtjax.hht(), q0, 0 * q0, 2.0, dts=dts, duration=1.0, num_samples=4).q

    fast = sweep()
    with hhtjax.plain():
        assert np.allclose(sweep(), fast, rtol=1e-12, atol=1e-14)


@on_cpu
@pytest.mark.parametrize(
    ("version", "wish", "why"),
    [
        ((99, 0, 0), "", "plain: JAX .* is newer than 0.10.2, the last one tested; HHTJAX_PLAIN=0 tries it"),
        ((99, 0, 0), "0", "one kernel"),
        ((0, 7, 1), "", "plain: JAX .* is older than 0.7.2"),
        (jax.__version_info__, "1", "plain: HHTJAX_PLAIN=1"),
        (jax.__version_info__, "0", "one kernel"),
    ],
)
def test_the_environment_and_the_version_of_jax(version, wish, why, monkeypatch):
    monkeypatch.setattr(jax, "__version_info__", version)
    monkeypatch.setenv(compat.VARIABLE, wish)
    (path,) = paths(lambda params: end(params), 2.0)  # new for JAX
    assert re.match(why, path)


def test_a_wish_that_is_none(monkeypatch):
    monkeypatch.setenv(compat.VARIABLE, "yes")
    with pytest.raises(ValueError, match="HHTJAX_PLAIN must be 0 or 1; received 'yes'"):
        end(2.0)


@on_cpu
def test_a_program_that_xla_refuses_runs_on_plain_jax(monkeypatch):
    """As when a new XLA refuses a kernel of which all operations were known to compile."""
    monkeypatch.setattr(fit_for_kernel, "KNOWN", fit_for_kernel.KNOWN | {"sort"})
    system = hhtjax.System(mass=jnp.ones(3), force=lambda q, v, t, k: -k * jnp.sort(q) * q)

    def final(q0):
        return hhtjax.simulate(system, hhtjax.rk4(), q0, jnp.zeros(3), 2.0, dt=0.1, num_steps=3).q[-1]

    q0 = jnp.array([0.3, 0.1, 0.2])
    with pytest.warns(RuntimeWarning, match="XLA refused the fast program"):
        found = final(q0)
    with hhtjax.plain():
        assert np.allclose(found, final(q0), rtol=1e-14)
    with pytest.raises(jax.errors.JaxRuntimeError):  # XLA sees the user's program after he has left it
        jax.jit(final)(q0)


def test_an_error_of_the_users_own_stays():
    def fails(x):
        raise ValueError("mine")

    system = hhtjax.System(
        mass=jnp.ones(1),
        force=lambda q, v, t, k: jax.pure_callback(fails, q, q),
    )
    with pytest.raises(jax.errors.JaxRuntimeError, match="mine"):
        hhtjax.simulate(system, hhtjax.rk4(), jnp.ones(1), jnp.zeros(1), dt=0.1, num_steps=3)
