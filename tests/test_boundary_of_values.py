"""What the library says to arguments of the right kind that mean nothing: masses, orders of arguments, params."""

import re
from contextlib import nullcontext
from functools import partial, wraps

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax import LinearSystem, System


def pull(q, v, t, params):
    return -4.0 * q


def run(system, n=2, params=None, dt=0.1, t0=0.0):
    return hhtjax.simulate(system, hhtjax.hht(), jnp.ones(n), jnp.zeros(n), params, dt=dt, num_steps=2, t0=t0)


NO_MASS = [
    (-np.ones(2), "must be positive definite; received one that is not"),
    (np.array([1.0, 0.0]), "must be positive definite; received one that is singular"),
    (np.ones((2, 2)), "must be positive definite; received one that is singular"),
    (np.array([[1.0, 2.0], [2.0, 1.0]]), "must be positive definite; received one that is not"),
    (np.array([[0.0, 1.0], [1.0, 0.0]]), "must be positive definite; received one that is"),
    (np.array([[1.0, 0.5], [0.0, 1.0]]), "must be symmetric; received one that differs from its transpose"),
]


@pytest.mark.parametrize(("mass", "message"), NO_MASS)
def test_a_constant_mass_is_symmetric_and_positive_definite(mass, message):
    with pytest.raises(ValueError, match=f"System: `mass` {message}"):
        System(mass, pull)
    with pytest.raises(ValueError, match=f"LinearSystem: `M` {message}"):
        LinearSystem(mass)


def test_masses_of_any_units_pass_and_with_constraints_massless_ones():
    mixed = np.array([1e9, 1e-9])
    System(np.diag(mixed) + 0.3 * (np.ones((2, 2)) - np.eye(2)), pull)
    System(np.array([1.0, 0.0]), pull, lambda q, t, params: q[1:] - 1)
    sums = jax.vmap(lambda m: System(m, pull).mass.sum())(-jnp.ones((3, 2)))  # of a tracer, which is not looked at
    np.testing.assert_array_equal(sums, -2.0)


@pytest.mark.slow
def test_a_mass_that_is_a_function_is_looked_at_where_the_run_starts():
    masses = np.array([[[2, 0.5], [0.5, 2]], np.ones((2, 2)), -np.eye(2), [[1, 0.5], [0, 1]], np.full((2, 2), np.nan)])
    found = jax.vmap(lambda M: run(System(lambda q, params: M, pull)))(masses)
    messages = [None, *2 * ["`mass` must be positive definite"], "`mass` must be symmetric", "not finite at the start"]
    for i, message in enumerate(messages):
        one = jax.tree.map(lambda x, i=i: x[i], found)
        with pytest.raises(hhtjax.SimulationError, match=message) if message else nullcontext():
            one.check()
    assert "mass is not symmetric" in repr(jax.tree.map(lambda x: x[3], found.failure))
    slider = System(lambda q, params: jnp.array([1.0, 0.0]), pull, lambda q, t, params: q[1:] - 1)
    run(slider).check()  # with constraints it may be singular
    with pytest.raises(hhtjax.SimulationError, match="member 1 "):
        found.check()


SWAPPED = [
    (lambda t, q, v, params: -q, "(t, q, v, params)"),
    (lambda v, q, t, p: -q, "(v, q, t, p)"),
    (lambda q, v, params, time: -q, "(q, v, params, time)"),
]


@pytest.mark.parametrize(("force", "received"), SWAPPED)
def test_arguments_in_another_order_are_named(force, received):
    message = f"System: `force` must be a function force(q, v, t, params); received one with the arguments {received}."
    with pytest.raises(TypeError, match=re.escape(message)):
        System(np.ones(2), force)


def test_so_are_those_of_other_functions_and_any_other_names_pass():
    with pytest.raises(
        TypeError, match=re.escape("constraint(q, t, params); received one with the arguments (t, q, p)")
    ):
        System(np.ones(2), pull, lambda t, q, p: q[:1])
    with pytest.raises(TypeError, match=r"arguments \(q, v, t, p\)\. For a velocity constraint, .* use `sliding` with"):
        System(np.ones(2), pull, lambda q, v, t, p: v[:1])
    with pytest.raises(TypeError, match=re.escape("rate(y, t, params); received one with the arguments (t, y, p)")):
        hhtjax.FirstOrderSystem(lambda t, y, p: y)
    for force in (lambda x, xdot, s, p: -x, lambda *args: -args[0], lambda a, b, t, c=1: -a, partial(pull)):
        System(np.ones(2), force)


Q, Z, RUN = np.ones(2), np.zeros(2), {"dt": 0.1, "num_steps": 2}
BALL = System(np.ones(2), pull)


def fit_records(residuals):
    """Of two records."""
    return hhtjax.fit(residuals, 1.0, records=np.ones((2, 3)), starts=np.ones(2))


def meet(**event):
    """A run with an event."""
    return hhtjax.simulate(BALL, hhtjax.hht(), Q, Z, **RUN, events=[hhtjax.Event(**event)])


def height(q, v, t, params):
    """A guard."""
    return q[0] + 2


WRONG = {  # what is called, how, and one that takes a function, with one that takes an argument less
    "System: `force`": ("force(q, v, t, params)", lambda f: System(Q, f), lambda q, v, p: -q, "3", "(q, v, p)"),
    "System: `mass`": ("mass(q, params)", lambda f: System(f, pull), lambda p: p, "1", "(p)"),
    "System: `constraint`": ("constraint(q, t, params)", lambda f: System(Q, pull, f), lambda q, p: q, "2", "(q, p)"),
    "System: `inertia`": ("inertia(q, w, params)", lambda f: System(Q, pull, inertia=f), lambda q, w: w, "2", "(q, w)"),
    "System: `friction`": ("friction(q, v, t, params)", lambda f: System(Q, pull, friction=f), lambda: 1, "0", "()"),
    "System.from_lagrangian: `lagrangian`": (
        "lagrangian(q, v, t, params)", System.from_lagrangian, jax.jit(lambda q, v, p: 0.0), "3", "(q, v, p)"),
    "LinearSystem: `K`": ("K(params)", lambda f: hhtjax.LinearSystem(Q, K=f), lambda q, p: 1, "2", "(q, p)"),
    "LinearSystem: `force`": ("force(t, params)", lambda f: hhtjax.LinearSystem(Q, force=f), lambda t: 1, "1", "(t)"),
    "FirstOrderSystem: `rate`": ("rate(y, t, params)", hhtjax.FirstOrderSystem, lambda y, p: y, "2", "(y, p)"),
    "Event: `switch`": (
        "switch(params) or switch(q, v, t, params)", lambda f: meet(guard=height, switch=f), lambda: 0, "0", "()"),
    "simulate: events[0]: `guard`": (
        "guard(q, v, t, params)", lambda f: meet(guard=f), lambda q, v: q[0], "2", "(q, v)"),
    "simulate: events[0]: `reset`": (
        "reset(q, v, t, params)", lambda f: meet(guard=height, reset=f), lambda v: -v, "1", "(v)"),
    "impact: `restitution`": ("restitution(params)", hhtjax.impact, lambda p, v: 0.5, "2", "(p, v)"),
    "fit: `residuals`": ("residuals(params)", lambda f: hhtjax.fit(f, 1.0), lambda p, record: p, "2", "(p, record)"),
    "fit: `residuals` of records": ("residuals(params, start, record)", fit_records, lambda p, r: p, "2", "(p, r)"),
    "fit: `loss`": ("loss(z)", lambda f: hhtjax.fit(abs, 1.0, loss=f), lambda z, c: z, "2", "(z, c)"),
    "multistart: `residuals`": (
        "residuals(params)", lambda f: hhtjax.multistart(f, np.ones(2)), lambda p, q: p, "2", "(p, q)"),
    "hht: `solve`": ("solve(A, b)", lambda f: hhtjax.hht(solve=f), lambda A: A, "1", "(A)"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_a_function_of_the_wrong_number_of_arguments_is_refused_where_it_is_given(name):
    called, give, function, count, names = WRONG[name]
    plural = "" if count == "1" else "s"
    message = f"{name.removesuffix(' of records')} is called as {called}; received a function of {count} positional "
    with pytest.raises(TypeError, match=re.escape(f"{message}argument{plural} {names}.")):
        give(function)


def test_arguments_that_are_given_by_name_are_no_positional_ones():
    with pytest.raises(TypeError, match=re.escape("of 4 positional arguments (q, v, t, params) and the keyword c.")):
        System(Q, lambda q, v, t, params, *, c: -c * v)
    with pytest.raises(TypeError, match=re.escape("of 3 positional arguments (q, v, t) and the keyword params.")):
        System(Q, partial(pull, params=None))


def test_a_function_that_can_be_called_so_or_does_not_tell_is_none_of_these():
    @wraps(pull)
    def filled(q, v, t):
        return pull(q, v, t, None)

    @wraps(filled)
    def any_number(*args):
        return filled(*args[:3])

    for force in (any_number, jax.vmap(pull), jax.jit(pull), jax.tree_util.Partial(pull), np.frompyfunc(max, 4, 1)):
        System(Q, force)
    for solve in (hhtjax.banded(1), hhtjax.conjugate_gradients(2)):
        hhtjax.hht(solve=solve)
    with pytest.raises(TypeError, match=re.escape("of 3 positional arguments (q, v, t).")):
        System(Q, filled)


NO_DATA = [("steel", "'steel'"), (np.array(["a"]), "an array of <U1"), (np.array([None]), "an array of object")]


class Unhashable:
    """A function that cannot be part of a program."""

    __hash__ = None
    __call__ = __repr__ = lambda *_: "Unhashable()"


WORDS = "an array, a number or a function"
ENDS = {"Unhashable()": "Make it a pytree", "Column()": "Write `x.to_numpy()`"}


class Column:
    """Like a column of pandas."""

    def to_numpy(self):
        return np.ones(2)

    def __repr__(self):
        return "Column()"


@pytest.mark.parametrize(
    ("value", "received", "what"),
    [
        *((*x, WORDS) for x in NO_DATA),
        (Column(), "Column()", WORDS),
        (Unhashable(), "Unhashable()", "hashable, because a function is static under jit"),
    ],
)
def test_params_are_numbers_or_functions(value, received, what):
    end = ENDS.get(received, "Put other values into")
    message = f"`params['k'][1]` must be {what}; received {received}. {end}"
    for call in (
        lambda params: run(System(np.ones(2), pull), params=params),
        lambda params: hhtjax.sweep(
            System(np.ones(2), pull),
            hhtjax.hht(),
            np.ones(2),
            np.zeros(2),
            params,
            dts=np.array([0.1]),
            duration=1.0,
            num_samples=1,
        ),
    ):
        with pytest.raises(TypeError, match=re.escape(message)):
            call({"k": [1.0, value]})


def test_a_negative_step_under_jit_is_told_by_check():
    found = jax.jit(lambda dt: run(System(np.ones(2), pull), dt=dt))(-0.1)
    with pytest.raises(hhtjax.SimulationError, match=r"simulate: `dt` must be positive and finite; it was -0.1"):
        found.check()


def test_arrays_are_shown_by_their_shape():
    message = r"must be a real number; received an array of shape \(1000,\)\.(\n-|$)"
    with pytest.raises(TypeError, match=f"sampled: `dt` {message}"):
        hhtjax.sampled(np.ones(9), np.linspace(0, 1, 1000))
    with pytest.raises(TypeError, match=f"simulate: `t0` {message}"):
        jax.jit(lambda t0: run(System(np.ones(2), pull), t0=t0).q)(jnp.ones(1000))
    with pytest.raises(ValueError, match=r"simulate: `num_steps` must be the length of dt, 1000.*received 2\.(\n-|$)"):
        jax.jit(lambda dt: run(System(np.ones(2), pull), dt=dt).q)(jnp.ones(1000))


def test_matrices_of_a_linear_system_fit():
    message = "LinearSystem: `C` must have shape (2, 2), or (2,) for a diagonal, to fit `M`; received shape (3, 3)."
    with pytest.raises(ValueError, match=re.escape(message)):
        LinearSystem(np.ones(2), np.eye(3), np.eye(2))


def test_a_gradient_that_is_rounding_is_none():
    def constraint(q, t, params):
        """The second row is always 1."""
        return jnp.stack([q[0] - 1, jnp.sin(0.3 * q[1]) ** 2 + jnp.cos(0.3 * q[1]) ** 2 - 1 + 1e-16 * (q[0] - 1)])

    with pytest.raises(
        ValueError, match=r"`constraint` rows \[1\] have no gradient in q at the start \(only rounding\)"
    ):
        run(System(np.ones(2), pull, constraint))


def test_what_a_function_reads_is_seen_when_it_changes():
    """Also in a new System of the same function; more in test_stale.py."""
    stiffness = [1.0]

    def force(q, v, t, params):
        return -stiffness[0] * q

    before = run(System(np.ones(2), force)).q
    stiffness[0] = 2.0
    assert (run(System(np.ones(2), force)).q[-1] < before[-1]).all()
    stiffness[0] = 1.0
    np.testing.assert_array_equal(run(System(np.ones(2), force)).q, before)
