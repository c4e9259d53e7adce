"""What the library says to functions of a system that return the wrong thing, and to what `init` and `step` get."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EYE, ONE, SINGLE, SPRING, ZERO, check_message, pull, run
from zoo import STEPPERS

from hhtjax import Event, LinearSystem, PrecisionWarning, System, hht, impact, sweep

MASS_SHAPE = "`mass` must give an array of shape (1, 1), or (1,) for a diagonal; received"
FORCE_LIKE = "`force` must return a pytree like v0, shape (1,) float64; received"
RESULTS = [
    (ValueError, f"{MASS_SHAPE} shape (3,) float64.", System(np.ones(3), pull)),
    (ValueError, f"{MASS_SHAPE} shape (2, 2) float64.", System(EYE, pull)),
    (ValueError, f"{MASS_SHAPE} shape (3,) float64.", System(lambda q, params: jnp.ones(3), pull)),
    (ValueError, f"{MASS_SHAPE} [0]: shape () float64.", System(lambda q, params: [1.0], pull)),
    (ValueError, f"{MASS_SHAPE} ['m']: shape (1,) float64.", System(lambda q, params: {"m": jnp.ones(1)}, pull)),
    (ValueError, f"{MASS_SHAPE} nothing.", System(lambda q, params: None, pull)),
    (ValueError, f"{FORCE_LIKE} shape (2,) float64.", System(ONE, lambda q, v, t, params: jnp.ones(2))),
    (ValueError, f"{FORCE_LIKE} shape () float64.", System(ONE, lambda q, v, t, params: -q[0])),
    (ValueError, f"{FORCE_LIKE} ['x']: shape (1,) float64.", System(ONE, lambda q, v, t, params: {"x": q})),
    (ValueError, f"{FORCE_LIKE} [0]: shape (1,) float64.", System(ONE, lambda q, v, t, params: (q,))),
    (ValueError, f"{FORCE_LIKE} nothing.", System(ONE, lambda q, v, t, params: None)),
]


@pytest.mark.parametrize(("error", "message", "system"), RESULTS)
def test_shapes_of_mass_and_force_are_checked(error, message, system):
    check_message(error, f"simulate: {message}", lambda: run(system))
    check_message(error, f"init: {message}", lambda: STEPPERS["hht auto"].init(system, ONE, ZERO, None, dt=0.1))


@pytest.mark.parametrize("dtype", ["float32", "complex128", "bool"])
@pytest.mark.parametrize("name", ["mass", "force"])
def test_dtypes_of_mass_and_force_are_checked(name, dtype):
    def mass(q, params):
        return jnp.ones(1, dtype if name == "mass" else q.dtype)

    def force(q, v, t, params):
        return jnp.ones(1, dtype if name == "force" else q.dtype)

    message = f"simulate: `{name}` returned {dtype} for a state of float64. Give params, and arrays made inside"
    check_message(TypeError, message, lambda: run(System(mass, force)))


def test_a_complex_number_as_mass_is_named():
    """Python numbers take the dtype of the state, but only real ones."""
    with pytest.raises(TypeError, match="simulate: `mass` returned complex128 for a state of float64"):
        run(System(lambda q, params: 1.0 + 1.0j, pull))


@pytest.mark.parametrize("name", ["mass", "force"])
def test_a_double_result_for_a_single_state_is_named(name):
    def mass(q, params):
        return jnp.ones(1, params["mass"].dtype)

    def force(q, v, t, params):
        return -params["force"] * q.astype(params["force"].dtype)

    params = {"mass": SINGLE, "force": SINGLE, name: ONE}
    message = f"simulate: `{name}` returned float64 for a state of float32. Give params"
    with pytest.warns(PrecisionWarning), pytest.raises(TypeError, match=re.escape(message)):
        run(System(mass, force), q0=SINGLE, v0=0 * SINGLE, params=params)


@pytest.mark.parametrize("name", ["M", "C", "K"])
@pytest.mark.parametrize("matrix", [np.eye(3), np.ones(3), lambda params: jnp.eye(3), lambda params: {"a": 1.0}])
def test_matrices_of_a_linear_system_must_fit_its_size(name, matrix):
    with pytest.raises((TypeError, ValueError), match=rf"`{name}` must .*\(2, 2\), or \(2,\).*; received"):
        run(LinearSystem(**{"M": EYE, name: matrix}), q0=np.ones(2), v0=np.zeros(2))


@pytest.mark.parametrize(
    ("load", "received"),
    [
        (lambda t, params: {"a": jnp.ones(2)}, "['a']: shape (2,) float64"),
        (lambda t, params: (jnp.ones(1), jnp.ones(1)), "[0]: shape (1,) float64, [1]: shape (1,) float64"),
        (lambda t, params: jnp.ones(3), "shape (3,) float64"),
        (lambda t, params: jnp.ones((2, 1)), "shape (2, 1) float64"),
        (lambda t, params: 1.0, "shape () float64"),
    ],
)
def test_the_load_of_a_linear_system_must_be_like_v0(load, received):
    message = f"`force` must return a pytree like v0, shape (2,) float64; received {received}"
    check_message(ValueError, message, lambda: run(LinearSystem(EYE, force=load), q0=np.ones(2), v0=np.zeros(2)))


@pytest.mark.parametrize("name", ["mass", "force"])
def test_an_error_inside_mass_or_force_keeps_its_kind_and_says_where(name):
    def fail(q, *args):
        return args[-1]["k"] * q

    system = System(fail, pull) if name == "mass" else System(ONE, fail)
    with pytest.raises(KeyError, match="k") as caught:
        run(system, params={"stiffness": 1.0})
    notes = " ".join(caught.value.__notes__)
    assert f"simulate: raised while tracing `{name}` with {2 if name == 'mass' else 4} arguments: shape (1,)" in notes
    assert "['stiffness']: shape () float64" in notes
    assert "simulate: the keys of `params` are 'stiffness'; a function of the system asked for 'k'." in notes


@pytest.mark.parametrize(
    ("arguments", "note"),
    [
        ({"q0": [1.0], "v0": [0.0]}, "`q0` is a list of numbers. JAX treats it as a container of 1"),
        ({"q0": [1.0, 2.0], "v0": [0.0, 0.0]}, "`v0` is a list of numbers. JAX treats it as a container"),
        (
            {"params": {"k": (1.0, 2.0)}},
            "`params['k']` is a tuple of numbers. JAX treats it as a container",
        ),
        ({"params": None}, "`params` was left out, so the functions of the system received None."),
    ],
)
def test_lists_of_numbers_and_missing_params_are_named(arguments, note):
    system = System(ONE, lambda q, v, t, params: -params["k"] * q)
    with pytest.raises((TypeError, ValueError)) as caught:
        run(system, **({"params": {"k": 1.0}} | arguments))
    assert f"simulate: {note}" in " ".join(caught.value.__notes__)


def test_a_constraint_is_refused_where_it_would_be_ignored():
    system = System(ONE, pull, constraint=lambda q, t, params: q)
    message = "RK4 cannot solve the `constraint`; use extrapolated(), hht()"
    check_message(NotImplementedError, f"init: {message}", lambda: STEPPERS["rk4"].init(system, ONE, ZERO, None, 0.1))


@pytest.mark.parametrize(("q0", "v0"), [(ONE, np.zeros(2)), ({"a": 1.0}, {"b": 1.0})])
def test_init_checks_that_v0_is_like_q0(q0, v0):
    with pytest.raises(ValueError, match=r"init: `v0` must .* q0.*; received"):
        STEPPERS["hht auto"].init(SPRING, q0, v0, None, dt=0.1)


def test_init_takes_integers_as_simulate_does():
    state = STEPPERS["hht auto"].init(SPRING, np.array([1]), np.array([0]), None, dt=0.1)
    assert state.q.dtype == state.v.dtype == state.w.dtype == jnp.float64
    assert state.w[0] == -4.0


def test_step_names_itself():
    state = STEPPERS["hht auto"].init(SPRING, ONE, ZERO, None, dt=0.1)
    wrong = System(ONE, lambda q, v, t, params: (q,))
    check_message(ValueError, f"step: {FORCE_LIKE} [0]", lambda: STEPPERS["hht auto"].step(wrong, state, None, dt=0.1))


def hung(x):
    return System(np.ones(2), lambda q, v, t, p: 0 * q, lambda q, t, p: (q @ q - x)[None])


def rubs(x):
    return System(
        np.ones(2), lambda q, v, t, p: 0 * q, friction=lambda q, v, t, p: ONE, sliding=lambda q, v, t, p: x * v[:1]
    )


def stops(x):
    return [Event(lambda q, v, t, p: q[0] - x / 2, impact(0.5))]


def swept(system, q0, v0, **options):
    grid = {"dts": [0.1, 0.1], "duration": 0.4, "num_samples": 1, "in_axes": (None, 0, None, None)}
    return sweep(system, hht(), q0, v0, **grid, **options)


# arrays of JAX, which stay known while a function is being traced
ALONE, BATCH = (jnp.ones(1), jnp.zeros(1)), (jnp.ones((2, 1)), jnp.zeros(1))
PAIR, PAIRS = (jnp.eye(2)[0], jnp.zeros(2)), (jnp.eye(2), jnp.zeros(2))
CLOSED = {
    "guard": lambda x: run(SPRING, hht(), *ALONE, events=stops(x)),
    "constraint": lambda x: run(hung(x), hht(), *PAIR),
    "sliding": lambda x: run(rubs(x), hht(), *PAIR),
}


@pytest.mark.parametrize("name", CLOSED)
def test_functions_may_close_over_a_tracer(name):
    """What is not known while a function is being traced passes unchecked, as it does in params."""
    jax.eval_shape(CLOSED[name], 1.0)


SWEPT = {
    "guard": lambda x: swept(SPRING, *BATCH, events=stops(x)).q,
    "constraint": lambda x: swept(hung(x), *PAIRS).q,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SWEPT)
def test_functions_of_a_sweep_may_close_over_what_is_differentiated(name):
    found, slope = jax.jvp(SWEPT[name], (1.0,), (1.0,))
    assert np.all(np.isfinite(found))
    assert np.all(np.isfinite(slope))
