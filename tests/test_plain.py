"""The switch: plain JAX, by a context, by the environment, or for a JAX that is not known."""

import re
import warnings
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linked_pendulums import N, end, links, loss, on_cpu, paths

import hhtjax
from hhtjax import primitives
from hhtjax.primitives import compat

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


@pytest.mark.slow
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


@pytest.mark.slow
@on_cpu
@pytest.mark.parametrize(
    ("version", "wish", "why"),
    [
        ((99, 0, 0), "", "plain: JAX .* is newer than 0.12, the last one tested; HHTJAX_PLAIN=0 tries it"),
        ((99, 0, 0), "0", "one kernel"),
        ((*compat.NEWEST, 7), "", "one kernel"),  # a correction of what is known
        (jax.__version_info__, "1", "plain: HHTJAX_PLAIN=1"),
        (jax.__version_info__, "0", "one kernel"),
    ],
)
def test_the_environment_and_the_version_of_jax(version, wish, why, monkeypatch):
    monkeypatch.setattr(jax, "__version_info__", version)
    monkeypatch.setattr(compat, "_told", ["a warning of its own"])
    monkeypatch.setenv(compat.VARIABLE, wish)
    (path,) = paths(lambda params: end(params), 2.0)  # new for JAX
    assert re.match(why, path)


@pytest.mark.slow
def test_a_jax_that_is_not_known_is_told_of_once(monkeypatch):
    """Where a user's program calls the library first; who says what he wants is not told."""
    monkeypatch.setattr(jax, "__version_info__", (99, 0, 0))
    monkeypatch.setattr(compat, "_told", [])
    for wish in "01":
        monkeypatch.setenv(compat.VARIABLE, wish)
        end(2.0)  # warnings are errors here
    monkeypatch.delenv(compat.VARIABLE)
    run = hhtjax.System(jnp.ones(1), lambda q, v, t, k: -k * q), hhtjax.rk4(), jnp.ones(1), jnp.zeros(1), 2.0
    with pytest.warns(RuntimeWarning, match=r"several times slower.* newer than 0.12, .* Install a newer") as warned:
        hhtjax.simulate(*run, dt=0.1, num_steps=1)
    assert [w.filename for w in warned] == [__file__]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hhtjax.simulate(*run, dt=0.1, num_steps=2)
        jax.jit(end)(3.0)


def test_a_wish_that_is_none(monkeypatch):
    monkeypatch.setenv(compat.VARIABLE, "yes")
    with pytest.raises(ValueError, match="HHTJAX_PLAIN must be 0 or 1; received 'yes'"):
        end(2.0)


@pytest.fixture
def refused(monkeypatch):
    """A system whose kernels XLA refuses, as a new one may refuse operations that were known to compile."""

    def unknown(form):
        like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in form.out_avals]
        return jax.ffi.ffi_call("hhtjax_of_no_library", like)

    monkeypatch.setattr("hhtjax.xla.lowering.kernel", unknown)
    return hhtjax.System(jnp.ones(3), lambda q, v, t, k: -k * q**3)


Q0 = jnp.array([0.3, 0.1, 0.2])


@on_cpu
def test_a_program_that_xla_refuses_runs_on_plain_jax(refused):
    def final(q0):
        return hhtjax.simulate(refused, hhtjax.rk4(), q0, jnp.zeros(3), 2.0, dt=0.1, num_steps=3).q[-1]

    with pytest.warns(RuntimeWarning, match="XLA refused the fast program") as warned:
        found = final(Q0)
    assert [w.filename for w in warned] == [__file__]  # the line that calls the library
    with hhtjax.plain():
        assert np.allclose(found, final(Q0), rtol=1e-14)
    with pytest.raises(jax.errors.JaxRuntimeError):  # XLA sees the user's program after he has left it
        jax.jit(final)(Q0)


@pytest.mark.slow
@on_cpu
def test_what_xla_has_refused_it_is_not_asked_again(refused, caplog, tmp_path):
    """One program of several: the others are as fast as ever."""
    start = refused, hhtjax.rk4(), Q0, jnp.zeros(3), 2.0
    kinds = {
        "_simulate": lambda: hhtjax.simulate(*start, dt=0.1, num_steps=5),
        "run_sweep": lambda: hhtjax.sweep(*start, dts=jnp.array([0.1, 0.2]), duration=0.4, num_samples=2),
    }
    for name, call in kinds.items():
        with jax.log_compiles():
            with pytest.warns(RuntimeWarning, match="XLA refused the fast program"):
                first = call()
            assert caplog.text.count(f"Compiling jit({name})") == 2
            caplog.clear()
            again = call()  # warnings are errors here
            assert "Compiling" not in caplog.text
        assert jax.tree.all(jax.tree.map(np.array_equal, first, again))
    with pytest.warns(RuntimeWarning, match="XLA refused the fast program"):
        hhtjax.simulate(*start, dt=0.1, num_steps=4)  # another program
    chunks = [
        hhtjax.sweep_to_disk(
            tmp_path, *start, dts=jnp.array([0.1, 0.2]), duration=0.4, num_samples=2, chunk=2
        )  # that of the sweep; begun again, it is the same one
        for _ in range(2)
    ]
    assert np.array_equal(hhtjax.load_sweep(chunks[0])["q"], kinds["run_sweep"]().q)


def test_an_error_of_the_users_own_stays():
    def fails(x):
        raise ValueError("mine")

    system = hhtjax.System(
        mass=jnp.ones(1),
        force=lambda q, v, t, k: jax.pure_callback(fails, q, q),
    )
    with pytest.raises(jax.errors.JaxRuntimeError, match="mine"):
        hhtjax.simulate(system, hhtjax.rk4(), jnp.ones(1), jnp.zeros(1), dt=0.1, num_steps=3)
