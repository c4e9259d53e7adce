"""What the library says to wrong arguments."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import COMPLEX, INF, NAN, ONE, SINGLE, ZERO, Unhashable, check_message, lagrangian, pull, run

import hhtjax
from hhtjax import LinearSystem, System, interpolate

# ---------------------------------------------------------------------------------------------- systems

NOT_A_MATRIX = [
    (TypeError, "must be a function or an array; received 'steel'", "steel"),
    (
        TypeError,
        "must be a function or an array; received {'a': 1}. Its rows and columns follow the sorted keys of q.",
        {"a": 1},
    ),
    (TypeError, "must be a function or an array; received [[1, 2], [3]]", [[1, 2], [3]]),
    (TypeError, "must be real; received an array of complex128", COMPLEX),
    (TypeError, "must be real; received an array of bool", np.array([True])),
    (TypeError, "must be real; received an array of <U1", np.array(["a"])),
    (ValueError, "must have shape (n, n), or (n,) for a diagonal; received shape (2, 3)", np.ones((2, 3))),
    (ValueError, "must have shape (n, n), or (n,) for a diagonal; received shape (0,)", np.ones(0)),
    (ValueError, "must have shape (n, n), or (n,) for a diagonal; received shape (2, 2, 2)", np.ones((2, 2, 2))),
    (ValueError, "must be finite; received array([nan])", np.array([NAN])),
    (ValueError, "must be finite; received array([inf])", np.array([INF])),
    (TypeError, "must be hashable, because it is static under jit; received Unhashable()", Unhashable()),
]


@pytest.mark.parametrize(("error", "message", "value"), NOT_A_MATRIX)
def test_constant_matrices_are_checked(error, message, value):
    check_message(error, f"System: `mass` {message}", lambda: System(value, pull))
    for name in "MCK":
        check_message(
            error, f"LinearSystem: `{name}` {message}", lambda name=name: LinearSystem(**{"M": ONE, name: value})
        )


@pytest.mark.parametrize("value", [["1", "2"], [True, False], [1j, 2.0]])
def test_lists_of_other_things_than_real_numbers_are_no_matrix(value):
    for name, make in (("mass", lambda: System(value, pull)), ("K", lambda: LinearSystem(ONE, K=value))):
        with pytest.raises(TypeError, match=f"`{name}` must be"):
            make()


def test_a_missing_mass_is_named():
    check_message(TypeError, "System: `mass` must be a function or an array; received None", lambda: System(None, pull))
    check_message(
        TypeError, "LinearSystem: `M` must be a function or an array; received None", lambda: LinearSystem(None)
    )


NOT_A_FUNCTION = [
    ("System", "force", "force(q, v, t, params)", lambda x: System(ONE, x)),
    ("System", "constraint", "constraint(q, t, params)", lambda x: System(ONE, pull, x)),
    ("LinearSystem", "force", "force(t, params)", lambda x: LinearSystem(ONE, force=x)),
    ("System.from_lagrangian", "lagrangian", "lagrangian(q, v, t, params)", lambda x: System.from_lagrangian(x)),
    ("System.from_lagrangian", "force", "force(q, v, t, params)", lambda x: System.from_lagrangian(lagrangian, x)),
]


@pytest.mark.parametrize("value", [3, "pull", np.ones(2)], ids=repr)
@pytest.mark.parametrize(("caller", "name", "signature", "call"), NOT_A_FUNCTION)
def test_functions_of_a_system_are_checked(caller, name, signature, call, value):
    message = f"{caller}: `{name}` must be a function {signature}; received {value!r}."
    check_message(TypeError, message, lambda: call(value))


@pytest.mark.parametrize(("caller", "name", "signature", "call"), NOT_A_FUNCTION)
def test_functions_of_a_system_must_be_hashable(caller, name, signature, call):
    message = f"{caller}: `{name}` must be hashable, because it is static under jit; received Unhashable()."
    check_message(TypeError, message, lambda: call(Unhashable()))


@pytest.mark.parametrize("call", [lambda: System(ONE, None), lambda: System.from_lagrangian(None)])
def test_none_is_no_force_and_no_lagrangian(call):
    with pytest.raises(TypeError, match=r"`(force|lagrangian)` must be a function .*; received None"):
        call()


# ---------------------------------------------------------------------------------------------- steppers

COEFFICIENTS = [
    (hhtjax.hht, "alpha", "lie in [-1/3, 0]", (-0.34, 0.1)),
    (hhtjax.bossak, "alpha", "lie in [-1, 0]", (-1.1, 0.1)),
    (hhtjax.generalized_alpha, "rho_inf", "lie in [0, 1]", (-0.1, 1.1)),
    (hhtjax.newmark, "beta", "lie in (0, 1]", (0, 1.1)),
    (hhtjax.newmark, "gamma", "lie in [1/2, 1]", (0.4, 1.1)),
    (hhtjax.kim_hht, "alpha", "lie in [-1/3, 0]", (-0.34, 0.1)),
]
TOLERANCES = [
    (hhtjax.hht, "tolerance", "be positive", (0, -1e-10)),
    (hhtjax.implicit_euler, "tolerance", "be positive", (0, -1e-10)),
]


@pytest.mark.parametrize(("make", "name", "expectation", "outside"), COEFFICIENTS + TOLERANCES)
def test_coefficients_out_of_range(make, name, expectation, outside):
    for value in (*outside, NAN, -INF):
        message = f"{make.__name__}: `{name}` must {expectation}; received {value}."
        check_message(ValueError, message, lambda value=value: make(**{name: value}))
    check_message(ValueError, f"must {expectation}; received {-INF}.", lambda: make(**{name: jnp.array(-INF)}))


@pytest.mark.parametrize("value", ["a", None, True, 1j, [0.0], np.zeros(1), np.array(True), np.array(1j)], ids=repr)
@pytest.mark.parametrize(("make", "name", "expectation", "outside"), COEFFICIENTS + TOLERANCES)
def test_coefficients_that_are_no_real_number(make, name, expectation, outside, value):
    message = f"{make.__name__}: `{name}` must be a real number; received {value!r}."
    check_message(TypeError, message, lambda: make(**{name: value}))


def test_a_coefficient_that_is_an_array_of_text():
    with pytest.raises(TypeError, match="hht: `alpha` must be a real number; received"):
        hhtjax.hht(alpha=np.array("a"))


@pytest.mark.parametrize(
    ("make", "ends"),
    [
        (lambda x: hhtjax.hht(alpha=x), (-1 / 3, 0)),
        (lambda x: hhtjax.bossak(alpha=x), (-1, 0)),
        (lambda x: hhtjax.generalized_alpha(rho_inf=x), (0, 1)),
        (lambda x: hhtjax.newmark(beta=x), (1e-3, 1)),
        (lambda x: hhtjax.newmark(gamma=x), (0.5, 1)),
        (lambda x: hhtjax.kim_hht(alpha=x), (-1 / 3, 0)),
    ],
)
def test_the_ends_of_the_ranges_belong_to_them(make, ends):
    for value in (*ends, np.float64(ends[0]), jnp.array(ends[1], jnp.float64)):
        assert make(value).order in (1, 2)


OPTIONS = [
    ("iterations", ValueError, "must be a positive integer", (0, -1, 1.0, True, "1")),
    ("linearize", ValueError, 'must be "predictor", "held", "state" or "auto"', ("tangent", 3, ["auto"])),
    ("max_iterations", ValueError, "must be a positive integer", (0, -1, 1.5, True, None)),
    ("start", ValueError, 'must be "smooth", "corrected" or "simple"', ("exact", 3)),
    ("solve", TypeError, "must be a function solve(A, b)", (3, "lu")),
]
MAKERS = [hhtjax.hht, hhtjax.newmark, hhtjax.bossak, hhtjax.generalized_alpha, hhtjax.implicit_euler]


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize(("name", "error", "expectation", "values"), OPTIONS)
def test_options_are_checked(make, name, error, expectation, values):
    if make is hhtjax.implicit_euler and name not in inspect.signature(make).parameters:
        with pytest.raises(TypeError, match=f"implicit_euler.* unexpected keyword argument '{name}'"):
            make(**{name: values[0]})
        return
    for value in values:
        message = f"{make.__name__}: `{name}` {expectation}; received {value!r}."
        check_message(error, message, lambda value=value: make(**{name: value}))


@pytest.mark.parametrize("where", ["held", "state", "auto"])
def test_newton_until_tolerance_starts_from_the_predictor(where):
    message = f"hht: with iterations=None, Newton starts from the predictor: leave `linearize` out; received {where!r}."
    check_message(ValueError, message, lambda: hhtjax.hht(iterations=None, linearize=where))
    assert hhtjax.hht(iterations=None, linearize="predictor") == hhtjax.hht(iterations=None)
    assert hhtjax.hht(iterations=2, linearize=where).options.linearize == where


@pytest.mark.parametrize("make", MAKERS)
def test_an_unknown_option_is_named_with_its_constructor(make):
    with pytest.raises(TypeError, match=f"{make.__name__}.*'alpah'"):
        make(alpah=-0.1)


def test_a_solve_must_be_hashable():
    with pytest.raises(TypeError, match=r"hht: `solve` must be hashable.*; received Unhashable\(\)"):
        hhtjax.hht(solve=Unhashable())


# ---------------------------------------------------------------------------------------------- simulate

REAL = "must be a real number; received"
INTEGER = "must be a positive integer; received"
ARGUMENTS = [
    (TypeError, "`system` must be a System, LinearSystem or FirstOrderSystem; received 3.", {"system": 3}),
    (TypeError, "`system` must be a System, LinearSystem or FirstOrderSystem; received <class", {"system": System}),
    (TypeError, "`stepper` must be a stepper such as hht(); received 3.", {"stepper": 3}),
    (TypeError, "`stepper` must be a stepper such as hht(); received <function hht", {"stepper": hhtjax.hht}),
    *((ValueError, f"`dt` must be positive and finite; received {x}.", {"dt": x}) for x in (0, 0.0, -1, -0.1, NAN)),
    *((ValueError, f"`dt` must be positive and finite; received {x}.", {"dt": x}) for x in (INF, -INF)),
    (ValueError, "`dt` must be positive and finite; received -0.5.", {"dt": jnp.array(-0.5)}),
    *((TypeError, f"`dt` {REAL} {x!r}.", {"dt": x}) for x in ("fast", None, True, 1j)),
    (ValueError, "`num_steps` must be less than 2147483648, because", {"num_steps": 2**31}),
    (ValueError, "`num_steps` must be less than 268435456, because", {"num_steps": 2**28, "extrapolate": 4}),
    (ValueError, "`num_steps` must be the length of dt, 1, or left out; received 4.", {"dt": np.array([0.1])}),
    *((ValueError, f"`t0` must be finite; received {x}.", {"t0": x}) for x in (NAN, INF, -INF)),
    *((TypeError, f"`t0` {REAL} {x!r}.", {"t0": x}) for x in ("now", None, True, 1j, np.array([0.1]))),
    *(
        (ValueError, f"`num_steps` {INTEGER} {x!r}.", {"num_steps": x})
        for x in (0, -1, 4.0, True, None, "4", np.array(4))
    ),
    *((ValueError, f"`save_every` {INTEGER} {x!r}.", {"save_every": x}) for x in (0, -1, 2.0, True, None)),
    *((ValueError, f"`save_every` must divide num_steps=4; received {x}.", {"save_every": x}) for x in (3, 8)),
]


@pytest.mark.parametrize(("error", "message", "arguments"), ARGUMENTS)
def test_arguments_of_simulate_are_checked(error, message, arguments):
    check_message(error, f"simulate: {message}", lambda: run(**arguments))


A, B = jax.tree.structure({"a": 0.0}), jax.tree.structure({"b": 0.0})
LEAF, LIST = jax.tree.structure(0.0), jax.tree.structure([0.0])
INITIAL_VALUES = [
    (ValueError, f"`v0` must be a pytree structured like q0, {A}; received {B}.", {"a": 1.0}, {"b": 1.0}),
    (ValueError, f"`v0` must be a pytree structured like q0, {LEAF}; received {LIST}.", 1.0, [1.0]),
    (ValueError, "`v0` must be a pytree structured like q0", ONE, None),
    (ValueError, "`q0` must hold at least one number; received {}.", {}, {}),
    (ValueError, "`q0` must hold at least one number; received None.", None, None),
    (ValueError, "`q0` must hold at least one number; received ().", (), ()),
    (ValueError, "`v0` must have the shapes of q0, shape (1,) float64; received shape (2,) float64.", ONE, np.ones(2)),
    (ValueError, "`v0` must have the shapes of q0, shape (1,) float64; received shape () float64.", ONE, 0.0),
    (
        ValueError,
        "`v0` must have the shapes of q0, shape (1,) float64; received shape (1, 1) float64. Is q0 short of an axis? "
        "For one coordinate write q0[:, None].",
        ONE,
        np.ones((1, 1)),
    ),
    (
        ValueError,
        "`v0` must have the shapes of q0, ['a']: shape (1,) float64; received ['a']: shape (2,) float64.",
        {"a": ONE},
        {"a": np.ones(2)},
    ),
    (TypeError, "`q0` must be float32 or float64; received complex128.", COMPLEX, ZERO),
    (TypeError, "`v0` must be float32 or float64; received complex128.", ONE, COMPLEX),
    (TypeError, "`q0` must be float32 or float64; received complex128.", 1j, 0.0),
    (TypeError, "`q0` must be an array or a number; received True.", True, 0.0),
    (TypeError, "`q0` must be float32 or float64; received bool.", np.array([True]), ZERO),
    (TypeError, "`q0` must be float32 or float64; received float16.", ONE.astype(np.float16), ZERO.astype(np.float16)),
    (TypeError, "`q0` must be float32 or float64; received bfloat16.", jnp.ones(1, jnp.bfloat16), ZERO),
    (TypeError, "`q0` must be an array or a number; received 'left'.", "left", 0.0),
    (TypeError, "`v0['a'][1]` must be an array or a number; received 'slow'.", {"a": [1.0, 1.0]}, {"a": [0.0, "slow"]}),
    (ValueError, "`q0` must be finite; received array([nan]).", np.array([NAN]), ZERO),
    (ValueError, "`v0` must be finite; received -inf.", 0.0, -INF),
    (ValueError, "`q0['a']['b']` must be finite; received nan.", {"a": {"b": NAN}}, {"a": {"b": 0.0}}),
    (
        TypeError,
        "`q0` and `v0` must share one dtype; received shape (1,) float32 and shape (1,) float64.",
        SINGLE,
        ZERO,
    ),
    (
        TypeError,
        "`q0` and `v0` must share one dtype; received ['a']: shape (1,) float32, ['b']: shape (1,) float64",
        {"a": SINGLE, "b": ONE},
        {"a": SINGLE, "b": ONE},
    ),
]


@pytest.mark.parametrize(("error", "message", "q0", "v0"), INITIAL_VALUES)
def test_initial_values_are_checked(error, message, q0, v0):
    check_message(error, f"simulate: {message}", lambda: run(q0=q0, v0=v0))


@pytest.mark.parametrize("q0", [np.zeros(0), {"a": np.zeros((0, 3))}], ids=repr)
def test_arrays_without_entries_are_no_initial_values(q0):
    with pytest.raises(ValueError, match="simulate: `q0` must hold at least one number; received"):
        run(q0=q0, v0=q0)


@pytest.mark.parametrize("q0", [np.array(["a"]), np.array([1.0], object)], ids=repr)
def test_arrays_of_no_numbers_are_no_initial_values(q0):
    with pytest.raises(TypeError, match=r"simulate: `q0` must be .*; received"):
        run(q0=q0, v0=ZERO)


# ---------------------------------------------------------------------------------------------- interpolate


@pytest.mark.parametrize(
    ("times", "received"),
    [(1.9, "1.9"), (2.41, "2.41"), ([2.1, 2.5, 3.0], "2.5"), (NAN, "nan"), (INF, "inf"), (-3, "-3")],
)
def test_interpolate_refuses_times_outside_the_run(times, received):
    solution = run(t0=2.0)
    message = f"interpolate: `times` must lie in [2, 2.4]; received {received}."
    check_message(ValueError, message, lambda: interpolate(solution, times))


def test_interpolate_takes_the_ends_up_to_rounding_and_gives_nan_for_tracers_outside():
    solution = run(t0=2.0)
    ends = np.array([2.0 - 4e-16, 2.4 + 9e-16])
    assert np.allclose(interpolate(solution, ends).q, np.asarray(solution.q)[[0, -1]], rtol=1e-14)
    printed = 3e-7  # beyond the end, as times of six digits may be
    beyond = np.asarray(solution.q[-1] + printed * solution.v[-1])
    assert np.allclose(interpolate(solution, 2.4 + printed).q, beyond, rtol=1e-11)
    q = jax.jit(lambda times: interpolate(solution, times).q)(np.array([1.9, 2.1, 2.5]))
    assert np.isnan(q[:, 0]).tolist() == [True, False, True]


@pytest.mark.parametrize("times", ["noon", None, 1j], ids=repr)
def test_interpolate_names_times_that_are_no_numbers(times):
    with pytest.raises((TypeError, ValueError), match=r"interpolate: `times` must .*; received"):
        interpolate(run(), times)


def test_interpolate_refuses_a_batch_of_runs():
    batch = jax.vmap(lambda q0: run(q0=q0))(jnp.ones((3, 1)))
    with pytest.raises(ValueError, match=r"interpolate: `solution` must .*; received"):
        interpolate(batch, 0.1)
