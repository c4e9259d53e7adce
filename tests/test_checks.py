"""Checks that every floor shares."""

import jax.numpy as jnp
import numpy as np
import pytest

from hhtjax.checks import require_integer


def test_an_integer_of_any_kind_becomes_pythons():
    for value in (3, np.int32(3), np.int64(3)):
        found = require_integer("f", "n", value)
        assert found == 3
        assert type(found) is int
    assert require_integer("f", "n", 0, least=0) == 0


@pytest.mark.parametrize("value", [0, -1, 2.0, "3", True, None, np.float64(3), jnp.array(3), np.array([3])])
def test_anything_else_is_named(value):
    with pytest.raises(ValueError, match=r"f: `n` must be a positive integer; received "):
        require_integer("f", "n", value)


@pytest.mark.parametrize(("least", "words"), [(0, "an integer, 0 or more"), (2, "an integer, 2 or more")])
def test_the_least_is_said(least, words):
    with pytest.raises(ValueError, match=f"f: `n` must be {words}; received {least - 1}."):
        require_integer("f", "n", least - 1, least)
