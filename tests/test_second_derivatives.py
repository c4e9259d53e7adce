"""Second derivatives of runs that search for roots, forward and reverse over reverse."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.xla import QUICK

DT = 0.02
X = jnp.array([1.2, 10.0, 0.3])
SECOND = {"forward": lambda f: jax.jacfwd(jax.grad(f)), "reverse": lambda f: jax.jacrev(jax.grad(f))}


def pendulum(x):
    """So many steps that they are checkpointed."""
    system = hhtjax.System(np.ones(1), lambda q, v, t, p: -p[1] * jnp.sin(q) - p[2] * v)
    stepper = hhtjax.hht(iterations=None)
    return jnp.sum(hhtjax.simulate(system, stepper, x[:1], jnp.zeros(1), x, dt=DT, num_steps=40).q[-1])


def on_a_circle(x):
    """The same pendulum in x and y, stabilised on both levels."""

    def force(q, v, t, p):
        return jnp.array([0.0, -p[1]]) - p[2] * v

    system = hhtjax.System(np.ones(2), force, constraint=lambda q, t, p: (q @ q - 1.0)[None])
    q0 = jnp.stack([jnp.sin(x[0]), -jnp.cos(x[0])])
    run = hhtjax.simulate(system, hhtjax.hht(iterations=None), q0, jnp.zeros(2), x, dt=DT, num_steps=20)
    return jnp.arctan2(run.q[-1, 0], -run.q[-1, 1])


def guessed(x):
    """The nearest point of an ellipse."""
    system = hhtjax.System(
        np.ones(2), lambda q, v, t, p: -q, constraint=lambda q, t, p: jnp.stack([q[0] ** 2 + p[2] * q[1] ** 2 - 1])
    )
    q, *_ = hhtjax.consistent_initial(system, jnp.stack([x[0], x[1] / 10]), jnp.zeros(2), x)
    return jnp.sin(q[0]) + q[1] ** 2


def in_a_loop(f):
    """Of x that is carried through a scan, in which JAX forgets the rules of its own `custom_root`."""

    def loop(x):
        return jax.lax.scan(lambda x, _: (x + 0.1 * f(x), None), x, None, 2)[0].sum()

    return loop


CASES = [(pendulum, "forward"), (pendulum, "reverse"), (on_a_circle, "reverse")]
CASES += [(f, mode) for f in [in_a_loop(guessed)] for mode in SECOND]


@cache
def by_differences(f):
    """Of the first derivatives, of fourth order; both modes compare with them."""
    slope = jax.jit(jax.grad(f), compiler_options=QUICK)
    steps = 1e-4 * np.diag(X)

    def difference(scale):
        return np.stack([(slope(X + scale * e) - slope(X - scale * e)) / (2 * scale * np.sum(e)) for e in steps])

    return (4 * difference(1) - difference(2)) / 3


@pytest.mark.slow
@pytest.mark.parametrize(("f", "mode"), CASES, ids=lambda x: getattr(x, "__name__", x))
def test_second_derivatives_are_differences_of_the_first(f, mode):
    expected = by_differences(f)
    H = jax.jit(SECOND[mode](f), compiler_options=QUICK)(X)
    np.testing.assert_allclose(H, expected, rtol=0, atol=2e-10 * np.max(np.abs(expected)))


@pytest.mark.slow
def test_the_gradient_of_two_unknowns_evaluated_on_scalars():
    """Reverse mode against forward mode; what the search tells besides the root is no integer there."""
    system = hhtjax.System(np.ones(2), lambda q, v, t, p: -p * jnp.sin(q + q[::-1]) - 0.1 * v)

    def end(p):
        start = jnp.array([1.0, 0.5]), jnp.zeros(2), p
        return hhtjax.simulate(system, hhtjax.hht(iterations=None), *start, dt=DT, num_steps=10).q[-1]

    forward, reverse = jax.jit(lambda p: (jax.jacfwd(end)(p), jax.jacrev(end)(p)), compiler_options=QUICK)(9.0)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)
