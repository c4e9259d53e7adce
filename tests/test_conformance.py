"""Every operation with a rule, with its options: the same with the machinery as without, in every column and mode."""

import re

import by_numpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from columns import COLUMNS, compare
from jax import lax
from operations_table import ARGUMENTS, TABLE
from program_writer import HEADER

from hhtjax.xla import gate, linear_maps, parameters, pieces, scalar_calls, scalar_rules, structural
from hhtjax.xla.kernels import staged

pytestmark = [
    pytest.mark.skipif(not gate.is_on(), reason="plain arrays with this version of JAX"),
    pytest.mark.filterwarnings("ignore"),  # NumPy's about NaN, overflow, division by zero
]
NAMES = re.compile(r"(?<![\w.])[a-zA-Z](?![\w(])")


def scope():
    known = {"lax": lax, "jnp": jnp, "np": np, "jax": jax, "staged": staged, "structural": structural}
    exec(HEADER.replace('jax.config.update("jax_enable_x64", True)', ""), known)
    return known


SCOPE = scope()


def expression(text):
    """The function of an expression, and its arguments: those of the table that it names."""
    names = [n for n in ARGUMENTS if n in NAMES.findall(text)]
    return eval(f"lambda {', '.join(names)}: {text}", SCOPE), [ARGUMENTS[n] for n in names]


@pytest.mark.parametrize("group", TABLE)
def test_same_numbers(group):
    jax.config.update("jax_numpy_rank_promotion", "allow")
    jax.config.update("jax_numpy_dtype_promotion", "standard")
    failures = [
        f"{text}: {d.mode} {d.column}\n found {d.found}\n expected {d.expected}"
        for text in TABLE[group]
        for d in compare(*expression(text))
    ]
    assert not failures, f"{len(failures)}:\n" + "\n".join(failures)
