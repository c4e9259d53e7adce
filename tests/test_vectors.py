"""Programs with wide vectors: which take them, and where others take their place."""

import jax
import pytest

from hhtjax.runs.sweep_inputs import LANES, NUMBERS, VECTORS, lanes_for, least_lanes
from hhtjax.xla import Programs, gate, plain


def twice(x):
    if isinstance(x, str):
        raise ValueError(x)
    return 2 * x


def test_few_unknowns_take_the_wide_one_and_no_jit_of_a_user_does():
    programs = Programs(twice, static_argnums=())
    wide = programs.wide if gate.is_on() and jax.default_backend() == "cpu" else programs.usual
    assert (programs.of(2), programs.of(12)) == (wide, programs.usual)
    with plain():
        assert programs.of(2) is programs.usual
    assert programs(2, 3.0) == 6
    assert wide._cache_size() == programs.number() == 1
    assert jax.jit(lambda x: programs(2, x))(3.0) == 6
    assert jax.vmap(lambda x: programs(2, x))(jax.numpy.ones(2))[0] == 2


def test_errors_of_the_function_are_its_own():
    programs = Programs(twice, static_argnames="x")
    with pytest.raises(ValueError, match="mine"):
        programs(2, x="mine")


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
