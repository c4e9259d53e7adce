"""Options for the compiler: which programs take them, and where those without take their place."""

import jax
import jax.numpy as jnp
import pytest

import hhtjax
from hhtjax.primitives import compat, plain
from hhtjax.runs.sweep_inputs import LANES, NUMBERS, VECTORS, lanes_for, least_lanes
from hhtjax.xla import Programs

ARE_TAKEN = compat.is_on() and jax.default_backend() == "cpu"


def of_twice(**static):
    """Programs of a function of their own: jits of the same one share what they have compiled."""

    def twice(x):
        if isinstance(x, str):
            raise ValueError(x)
        return 2 * x

    return Programs(twice, **static)


def test_few_unknowns_take_options_and_no_jit_of_a_user_has_them():
    programs = of_twice()
    quick, wide = (programs.quick, programs.wide) if ARE_TAKEN else (programs.usual, programs.usual)
    found = programs.of(2, 2), programs.of(3, 9), programs.of(2), programs.of()
    assert found == (wide, quick, quick, quick)
    assert programs.of(33) is programs.of(33, 4) is programs.usual
    with plain():
        assert programs.of(2) is programs.usual
    assert programs(3.0, rates=2, numbers=2) == 6
    assert wide._cache_size() == programs.number() == 1
    assert jax.jit(lambda x: programs(x, rates=2, numbers=2))(3.0) == 6
    assert jax.vmap(lambda x: programs(x, rates=2, numbers=2))(jnp.ones(2))[0] == 2
    assert jax.grad(programs)(3.0) == 2


@pytest.mark.parametrize("change", [jax.jit, jax.grad, jax.checkpoint, lambda f: jax.vmap(jax.grad(f))])
def test_no_program_with_options_is_made_where_jax_would_refuse_it(change):
    """In reverse mode only after the forward part has been compiled, and run, for nothing."""
    programs = of_twice()
    programs.quick = programs.wide = None
    x = 1.0 if change in (jax.jit, jax.grad, jax.checkpoint) else jnp.ones(2)
    assert jnp.all(change(lambda x: programs(x, rates=2, numbers=2))(x) == 2)


@pytest.mark.skipif(not ARE_TAKEN, reason="no options here")
@pytest.mark.parametrize("numbers", [None, 2])
def test_an_option_that_xla_does_not_know_is_tried_once(numbers, monkeypatch):
    monkeypatch.setattr("hhtjax.xla.lowering.QUICK", {"xla_cpu_of_another_time": True})
    monkeypatch.setattr(Programs, "are_refused", False)
    programs = of_twice()
    with pytest.raises(jax.errors.JaxRuntimeError, match="xla_cpu_of_another_time"):  # so it reaches the compiler
        programs.of(2, numbers)(3.0)
    assert programs(3.0, rates=2, numbers=numbers) == 6
    assert programs.of(2, numbers) is programs.usual
    monkeypatch.setattr(Programs, "are_refused", False)
    assert jax.value_and_grad(lambda x: programs(x, rates=2, numbers=numbers))(3.0) == (6, 2)


@pytest.mark.slow
def test_programs_of_the_library_are_chosen_by_their_unknowns(monkeypatch):
    """A run, a sweep, a fit, and steps that are chosen."""
    chosen = []
    monkeypatch.setattr(Programs, "of", lambda self, *kind: chosen.append(kind) or self.usual)
    spring = hhtjax.System(jnp.ones(3), lambda q, v, t, k: -k * q)
    start = spring, hhtjax.hht(), jnp.ones(3), jnp.zeros(3), 1.0
    hhtjax.simulate(*start, dt=0.1, num_steps=2)
    hhtjax.sweep(*start, dts=jnp.array([0.1, 0.2]), duration=0.4, num_samples=2)
    hhtjax.choose_steps(*start, times=jnp.array([0.1]), rtol=1e-2, atol=1e-2)
    assert chosen == [(3, 3), (3, None), (3, None)]
    chosen.clear()
    result = hhtjax.fit(lambda k: k - jnp.ones(2), 2.0)
    assert chosen == [(0, None)] * (int(result.iterations) + 1)  # a call for each trial


def test_errors_of_the_function_are_its_own():
    programs = of_twice(static_argnames="x")
    with pytest.raises(ValueError, match="mine"):
        programs(x="mine")


@pytest.mark.parametrize("unknowns", [1, 2, 3, 6, 8, 12, 1000])
def test_members_that_are_alike_share_blocks_as_large_as_kernels_allow(unknowns):
    for size in (64, 100, 256, 5000):
        lanes = least_lanes(size, unknowns)
        assert lanes & (lanes - 1) == 0
        assert VECTORS <= lanes <= LANES
        assert -(-size // lanes) * lanes == -(-size // VECTORS) * VECTORS  # none fills up more
        assert lanes == VECTORS or lanes * unknowns**2 <= NUMBERS
        assert lanes_for(size, lanes) >= lanes
    assert [least_lanes(256, 2), least_lanes(256, 2, hands=8), least_lanes(60, 2)] == [LANES, VECTORS, 1]
    assert [least_lanes(size, 2) for size in (65, 97, 130, 190)] == [32, 128, 32, 64]  # none fills up more
