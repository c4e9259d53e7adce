"""Functions of scalars in stages: the same values and derivatives, every sine once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zoo
from jax import lax

import hhtjax
from hhtjax.jaxpr import scalars
from hhtjax.jaxpr.scalars import by_scalars, split
from hhtjax.primitives import compat, kernels
from hhtjax.scenes import double_pendulum

pytestmark = pytest.mark.skipif(not compat.is_on(), reason="plain arrays with this version of JAX")


def bounce(x, y):
    """Loop, branches and a function within the function, on a sine and before one."""
    z = lax.cond(x > y, lambda z: z * z, lambda z: -z, jnp.sin(x))
    z = lax.fori_loop(0, 3, lambda _, z: z + jnp.cos(y * z), z)
    return [jnp.sin(z), jax.jit(lambda z: z * x)(z) + z, z]


FUNCTIONS = {
    "sines": lambda x, y: [jnp.sin(x - y) * jnp.cos(x - y) + jnp.sin(y), jnp.sin(x - y) ** 2],
    "sines of sines": lambda x, y: [jnp.sin(jnp.exp(x) * y) + jnp.log(2 + jnp.sin(jnp.exp(x))), jnp.tanh(x + y)],
    "two operands": lambda x, y: [jnp.arctan2(y, x + y) ** 1.7 + (2 + x * y) ** y, jnp.arctan2(1.0, x)],
    "arithmetic": lambda x, y: [x * y + (x * y) / (x - y)],
    "nothing": lambda x, y: [y, x, y, jnp.asarray(2.0), jnp.sin(x), jnp.sin(x)],
    "a constant": lambda x, y: [jnp.sin(x + np.array(3.0)) + jnp.cos(3.0 + x)],
    "calls": bounce,
    "polynomial sines": lambda x, y: [hhtjax.trigonometry.sin(x - y) + jnp.exp(hhtjax.trigonometry.cos(x - y))],
}


def in_stages(f):
    return lambda *args: scalars.in_stages(kernels.STAGED, f, *args)


def names(jaxpr):
    """Of the operations, those within others included."""
    return [eqn.primitive.name for eqn in zoo.everywhere(jaxpr)]


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_same_values_and_derivatives(name):
    f, point = FUNCTIONS[name], (0.7, 0.4)
    g = in_stages(f)
    np.testing.assert_allclose(g(*point), f(*point), rtol=1e-15)
    np.testing.assert_allclose(jax.jit(g)(*point), f(*point), rtol=1e-14)
    many = np.array([0.3, 1.1]), np.array([0.2, 0.9])
    for x, y in zip(jax.vmap(g)(*many), zip(*(f(*p) for p in zip(*many, strict=True)), strict=True), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-14)
    expected = jax.jacfwd(f, (0, 1))(*point)
    np.testing.assert_allclose(jax.jacfwd(g, (0, 1))(*point), expected, rtol=1e-13)
    if name != "calls":  # a loop
        np.testing.assert_allclose(jax.jacrev(g, (0, 1))(*point), expected, rtol=1e-13)


def test_what_nobody_asks_for_is_left_out():
    done = names(jax.make_jaxpr(in_stages(lambda x, y: [x * jnp.sin(y), jnp.cos(x)][:1]))(1.0, 2.0).jaxpr)
    assert done.count("cos") == 0


def test_what_is_the_same_is_done_once():
    def f(x, y):
        return [jnp.sin(x - y) + jnp.cos(x - y), jnp.sin(x - y), jnp.sin(y - x), x**2 + lax.integer_pow(x, 3)]

    done = names(jax.make_jaxpr(in_stages(f))(1.0, 2.0).jaxpr)
    counts = [done.count(name) for name in ("sub", "sin", "cos", "integer_pow")]
    assert counts == [2, 2, 1, 2]


def test_functions_and_calls_that_lead_to_others_are_done_once():
    def f(x, y):
        sine, loop = jnp.sin(x), lax.fori_loop(0, 3, lambda _, z: z * y, x)
        return [jnp.sin(2 * sine) + sine, jnp.sin(loop + 1) + loop]

    done = names(jax.make_jaxpr(in_stages(f))(1.0, 2.0).jaxpr)
    assert [done.count("sin"), done.count("scan") + done.count("while")] == [3, 1]


def test_the_stages():
    calls = jax.make_jaxpr(in_stages(lambda x, y: [x * jnp.sin(x - y) * jnp.cos(x - y)]))(1.0, 2.0).jaxpr.eqns
    assert [names(call.params["jaxpr"].jaxpr) for call in calls] == [["sub"], ["sin", "cos"], ["mul", "mul"]]


def test_zeros_of_either_sign_are_not_the_same():
    signs = in_stages(lambda x: [1 / (x * 0.0), 1 / (x * -0.0)])(1.0)
    assert signs == [np.inf, -np.inf]


@pytest.mark.compiled
def test_the_program_has_each_sine_once():
    def f(x, y):
        sine, cosine = jnp.sin(x - y), jnp.cos(x - y)
        return [x * sine - y * cosine, y * sine + x * cosine, sine * cosine + x, jnp.sin(x) - cosine]

    program = jax.jit(lambda *x: kernels.one_kernel(in_stages(f), *x)).lower(1.0, 2.0).compile().as_text()
    assert [program.count(f" {name}(") for name in ("sine", "cosine")] == [2, 1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stepper", "sines", "cosines"),
    [
        (hhtjax.hht(linearize="predictor"), 3, 3),  # r with its derivative: of two angles and of their difference
        (hhtjax.rowda(), 3 + 2, 3 + 2 * 3),  # and two of r
        (hhtjax.rk4(), 4, 4 * 3),
    ],
    ids=["hht", "rowda", "rk4"],
)
def test_work_of_a_step_of_the_double_pendulum(stepper, sines, cosines):
    scene, dt = double_pendulum.free(), jnp.asarray(1e-3)
    state = split(stepper.init(scene.system, scene.q0, scene.v0, scene.params, dt))
    step = by_scalars(lambda state: stepper.step(scene.system, state, scene.params, dt)[0])
    done = names(jax.make_jaxpr(step)(state).jaxpr)
    assert (done.count("sin"), done.count("cos")) == (sines, cosines)
