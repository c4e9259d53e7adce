"""Every operation with a rule, with its options: the same with the machinery as without, in every column and mode."""

import re
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from by_numpy import Numbers, is_close, signs
from columns import RTOL, Case, differences, everywhere, traced, value
from jax import lax
from operations_table import ARGUMENTS, TABLE
from program_writer import HEADER, usual_promotion
from zoo import each

from hhtjax.jaxpr import linear_maps, scalar_rules, scalars
from hhtjax.numerics.dense_lu import matvec
from hhtjax.primitives import Linear, compat, in_turn, largest_in_batch, staged, structural
from hhtjax.primitives.consistent import held
from hhtjax.rotation import cross, stumpff

pytestmark = [
    pytest.mark.skipif(not compat.is_on(), reason="plain arrays with this version of JAX"),
    pytest.mark.filterwarnings("ignore"),  # NumPy's, about NaN, overflow, and division by zero
]
NAMES = re.compile(r"(?<![\w.'])[a-zA-Z](?![\w('])")
# XLA takes z + 0 for z in a compiled program, and JAX one fill value for the other, since they compare as equal
SIGNS_OF_XLA = ("z + 0.0", "0.0 + z", "z - -0.0", "fill_value=-0.0")
UNDEFINED = ("lax.div(m, m)",)  # where m is 0: the XLA of JAX 0.12 takes x / x for 1 in a compiled program


PICKED = Linear(  # rows 2, 0, 2 of three
    lambda x: x[..., np.array([2, 0, 2]), :],
    lambda y: jnp.stack([y[..., 1, :], jnp.zeros_like(y[..., 0, :]), y[..., 0, :] + y[..., 2, :]], axis=-2),
)


def scope():
    known = {"lax": lax, "jnp": jnp, "np": np, "jax": jax, "staged": staged, "structural": structural}
    known |= {
        "largest_in_batch": largest_in_batch,
        "held": held,
        "in_turn": in_turn,
        "stumpff": stumpff,
        "cross": cross,
        "matvec": matvec,
        "picked": PICKED,
    }
    exec(HEADER, known)
    return known


SCOPE = scope()


def expression(text):
    """The function of an expression, and its arguments: those of the table that it names."""
    found = NAMES.findall(text)
    names = [n for n in ARGUMENTS if n in found]
    return eval(f"lambda {', '.join(names)}: {text}", SCOPE), [ARGUMENTS[n] for n in names]


@cache
def of_plain_jax(text):
    """What plain JAX makes of an expression."""
    with usual_promotion(), np.errstate(all="ignore"):
        return Case(*expression(text))


IN_TURN = (  # from one expression to the next
    {"derivatives": ["whole"], "vmap": [], "matrix": ["alone"]},
    {"derivatives": ["on scalars"], "vmap": ["whole"], "matrix": []},
    {"derivatives": ["in stages"], "vmap": [], "matrix": ["whole"]},
    {"derivatives": ["whole"], "vmap": ["whole"], "matrix": []},
    {"derivatives": ["on scalars"], "vmap": [], "matrix": ["whole"]},
    {"derivatives": ["in stages"], "vmap": ["whole"], "matrix": []},
)


@pytest.mark.slow
@pytest.mark.parametrize("turn", each(range(len(IN_TURN)), quick=[0], rest=range(1, len(IN_TURN))))
@pytest.mark.parametrize("group", TABLE)
def test_same_numbers(group, turn):
    with usual_promotion():
        failures = [
            f"{text}: {x.mode} {x.column}\n found {x.found}\n expected {x.expected}"
            for i, text in enumerate(TABLE[group], turn)
            for x in differences(of_plain_jax(text), IN_TURN[i % len(IN_TURN)])
        ]
    assert not failures, f"{len(failures)}:\n" + "\n".join(failures)


@pytest.mark.slow
def test_every_rule_has_its_rows():
    """Every operation that some rule is for occurs in the table or its derivatives, so a new rule comes with rows."""
    rules = {*scalar_rules.RULES, *scalar_rules.NUMPY, *scalar_rules.SHORT, *scalars.CALLS, *linear_maps.RULES}
    programs = [of_plain_jax(text).plain.jaxpr for texts in TABLE.values() for text in texts]
    assert rules | set(scalar_rules.UNDERSTOOD) <= {eqn.primitive.name for x in programs for eqn in everywhere(x)}


@pytest.mark.slow
@pytest.mark.parametrize("group", TABLE)
def test_the_witness_evaluates_as_xla_does(group):
    """Values by NumPy, on which the table rests, are those of plain JAX, compiled."""
    known = [of_plain_jax(text) for text in TABLE[group]]
    results = jax.jit(lambda args: [jax.tree.leaves(case.f(*x)) for case, x in zip(known, args, strict=True)])
    expected = results([case.args for case in known])
    for text, case, ys in zip(TABLE[group], known, expected, strict=True):
        xs = Numbers()(traced(value(case.f), case.args)[0], *case.args)
        for x, y in zip(xs, map(np.asarray, ys), strict=True):
            if text in UNDEFINED:
                x, y = x[case.args[0] != 0], y[case.args[0] != 0]
            assert is_close(x, y, RTOL if case.rtol == RTOL else 1e-5), f"{text}: {x}, not {y}"
            if not any(part in text for part in SIGNS_OF_XLA):
                np.testing.assert_array_equal(signs(x), signs(y), text)
