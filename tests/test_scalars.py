"""Functions of small arrays, evaluated on scalars: the same values and derivatives, and fewer operations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zoo
from jax import lax

import hhtjax
from hhtjax.jaxpr import scalars
from hhtjax.jaxpr.scalars import Scalars, by_scalars, join, pays, split
from hhtjax.primitives import compat, staged, structural
from hhtjax.scenes import double_pendulum, slider_crank

old = pytest.mark.skipif(not compat.is_on(), reason="plain arrays with this version of JAX")
M = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.1], [0.0, 0.1, 3.0]])


@jax.custom_jvp
def twice_as_steep(x):
    return jnp.sin(x)


@twice_as_steep.defjvp
def _(x, dx):
    return twice_as_steep(*x), 2 * jnp.cos(x[0]) * dx[0]


def newton_root(x):
    return lax.while_loop(lambda y: jnp.any(jnp.abs(y * y - x) > 1e-3), lambda y: (y + x / y) / 2, x)


FUNCTIONS = {
    "arithmetic": lambda x: jnp.where(x > 0, x * 2 + 1, -x) ** 3 / (1 + jnp.exp(-x)) - jnp.hypot(x, 0.5),
    "products": lambda x: (
        (M.astype(x.dtype) @ x) @ (x[:, None] * x[None, :]) + jnp.einsum("i,jk,k->j", x, jnp.outer(x, x), x)
    ),
    "parts": lambda x: jnp.concatenate(
        [
            lax.slice(x, (0,), (3,), (2,)),
            jnp.zeros(3, x.dtype) - x,
            x[1:],
            x[:1],
            x[::-1],
            jnp.append(jnp.diff(x, prepend=0), x.sum()),
        ]
    ),
    "indices": lambda x: x[jnp.array([2, 0])] * x.at[1].set(3.0)[1:] + jnp.pad(x, 1)[:2] + jnp.diag(x)[1, :2],
    "sums": lambda x: jnp.stack(
        [x.sum(), x.prod(), x.max(), jnp.linalg.norm(x), jnp.mean(x**2), jnp.trace(jnp.outer(x, x))]
    ),
    "shapes": lambda x: jnp.swapaxes(jnp.stack([x, x * x]).reshape(3, 2), 0, 1) + jnp.arange(3, dtype=x.dtype)[None],
    "whole arrays": lambda x: jnp.cumsum(jnp.sort(x)) + jnp.linalg.solve(M.astype(x.dtype), x),
    "branches": lambda x: lax.cond(x[0] > 0, lambda x: x * x, lambda x: -x, x),
    "loop": lambda x: newton_root(1 + x * x),
    "own rule": lambda x: twice_as_steep(x) * x,
    "own rule of one": lambda x: twice_as_steep(x[0]) * x,
    "polynomial sines": lambda x: hhtjax.trigonometry.sin(x) * hhtjax.trigonometry.cos(2 * x[1]),
    "solve": lambda x: hhtjax.numerics.linear_solve.solve(M.astype(x.dtype) * (1 + x[0] ** 2), x),
    "conjugate gradients": lambda x: jax.scipy.sparse.linalg.cg(lambda y: M.astype(x.dtype) @ y * (1 + x[0] ** 2), x)[
        0
    ],
    "one way only": lambda x: lax.custom_linear_solve(lambda y: 2 * y, x * x, lambda f, b: b / 2),
    "large array": lambda x: jnp.interp(
        x, jnp.linspace(-3, 3, 100, dtype=x.dtype), jnp.linspace(0, 1, 100, dtype=x.dtype) ** 2
    ),
    "a stage": lambda x: sum(staged(lambda x, y: (x, x * y, y))(x, x[::-1] ** 2)),
    "integers": lambda x: x * (jnp.arange(3) % 2).astype(x.dtype) + jnp.argmax(x).astype(x.dtype),
}


def through_scalars(f):
    return lambda x: join(by_scalars(f)(split(x)))


@pytest.mark.slow
@old
@pytest.mark.parametrize("name", FUNCTIONS)
def test_same_values_and_derivatives(name):
    f, x = FUNCTIONS[name], jnp.array([0.7, -1.3, 0.4])
    g = through_scalars(f)

    def everything(f):
        def all_of(x, dx):
            y, dy = jax.jvp(f, (x,), (dx,))
            if name in ("loop", "one way only"):  # reverse mode does not pass
                return y, dy
            return y, dy, jax.vjp(f, x)[1](jnp.cos(y)), jax.jvp(jax.jacfwd(f), (x,), (dx,))

        return jax.jit(jax.vmap(all_of))

    xs = jnp.stack([x, -x, 2 * x])
    for a, b in zip(*(jax.tree.leaves(everything(h)(xs, xs + 1)) for h in (f, g)), strict=True):
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    for dtype in (jnp.float32, jnp.float64):
        assert jax.eval_shape(g, x.astype(dtype)).dtype == dtype


@old
def test_a_rule_for_derivatives_is_kept():
    x = jnp.array([0.7, -1.3, 0.4])
    np.testing.assert_allclose(jnp.diag(jax.jacrev(through_scalars(twice_as_steep))(x)), 2 * jnp.cos(x), rtol=1e-15)


def operations(f, *args):
    return [eqn.primitive.name for eqn in jax.make_jaxpr(f)(*args).jaxpr.eqns]


@old
def test_what_is_known_costs_nothing():
    x = split(jnp.array([0.7, -1.3, 0.4]))
    assert operations(by_scalars(lambda x: 1 * x / 1 - 0.0 + -0.0), x) == []
    assert operations(by_scalars(lambda x: structural(np.eye(3)) @ x + structural(np.zeros(3))), x) == []
    assert operations(by_scalars(lambda x: -structural(np.zeros(3)) * x / 2 + x), x) == []
    assert operations(by_scalars(lambda x: jnp.concatenate([x, x])[jnp.array([4, 0])].reshape(2, 1)), x) == []
    assert operations(by_scalars(lambda x: structural(np.array([[0.0, 2.0, 0.0]])) @ x), x) == ["mul"]
    assert operations(by_scalars(lambda x: jnp.array([[0.0, 2.0]]) @ x[:2]), x) == ["mul", "mul", "add"]


@old
def test_what_nobody_asks_for_needs_no_derivative():
    def f(x):
        ones = lax.integer_pow(x, 0)
        ones.at[jnp.array([0])].apply(jnp.negative)  # JAX knows no derivative of it
        return ones

    assert jax.jacfwd(through_scalars(f))(jnp.ones(3)).tolist() == np.zeros((3, 3)).tolist()


SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan])
IEEE = {
    "0 * x": lambda x: np.zeros(7) * x,
    "x * 0": lambda x: x * np.zeros(7),
    "x * 1": lambda x: x * 1.0,
    "0 / x": lambda x: np.zeros(7) / x,
    "x / 1": lambda x: x / np.ones(7),
    "0 - x": lambda x: np.zeros(7) - x,
    "-0 - x": lambda x: -np.zeros(7) - x,
    "x - 0": lambda x: x - 0.0,
    "x - -0": lambda x: x - -0.0,
    "x + -0": lambda x: x + -0.0,
    "power 0": lambda x: x**0 + x**0.0,
    "largest": lambda x: jnp.maximum(x, -0.0),
    "chosen": lambda x: jnp.where(np.arange(7) % 2 == 0, x, 0.0) * np.zeros(7),
}


@old
@pytest.mark.parametrize("name", IEEE)
def test_elementwise_operations_are_ieee(name):
    """Signs of zeros, NaN and infinities are those of the same program on arrays, compiled alike."""
    found, expected = (np.asarray(jax.jit(f)(SPECIAL)) for f in (through_scalars(IEEE[name]), IEEE[name]))
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(np.signbit(found) & ~np.isnan(found), np.signbit(expected) & ~np.isnan(found))


@old
def test_structure_and_saved_axes():
    tree = {"a": jnp.arange(6.0).reshape(2, 3), "b": jnp.float32(2), "c": None, "large": jnp.ones(100)}
    cut = split(tree)
    assert cut["a"].shape == (2, 3)
    assert len(cut["a"].elements) == 6
    assert cut["large"].shape == (100,)
    jax.tree.map(np.testing.assert_array_equal, join(cut), tree)
    stacked = jax.tree.map(lambda x: jnp.stack([x, 2 * x]), cut["a"])
    assert isinstance(stacked, Scalars)
    np.testing.assert_array_equal(join(stacked)[1], 2 * tree["a"])


@old
def test_when_it_pays(monkeypatch):
    two, one = jnp.ones(2), jnp.ones(1)
    assert pays(jnp.sin, two)
    assert not pays(jnp.sin, one)  # is a scalar already
    assert not pays(jnp.sort, two)  # keeps XLA from making a kernel
    assert not pays(lambda x: lax.cond(x[0] > 0, jnp.sort, jnp.sin, x), two)
    assert not pays(lambda x: jnp.linalg.inv(jnp.eye(12) * x[0]), two)
    monkeypatch.setattr(scalars, "MOST_OPERATIONS", 1)
    assert not pays(jnp.sin, two)


@old
def test_more_pays_without_derivatives(monkeypatch):
    monkeypatch.setattr(scalars, "MOST_OPERATIONS", 1)
    two = jnp.ones(2)
    assert not scalars.on_scalars(jnp.sin, two).is_split
    assert scalars.on_scalars(jnp.sin, two, derivatives=False).is_split
    monkeypatch.setattr(scalars, "MOST_IN_VALUES", 1)
    assert not scalars.on_scalars(jnp.sin, two, derivatives=False).is_split


def value_and_gradient(scene, stepper):
    """Of a run, and all of it; traced anew."""
    system = hhtjax.System(lambda *args: scene.system.mass(*args), lambda *args: scene.system.force(*args))

    def loss(k):
        params = {**scene.params, "k": k}
        solution = hhtjax.simulate(system, stepper, scene.q0, scene.v0, params, dt=1e-3, num_steps=20, save_every=2)
        return (solution.q**2).sum() + solution.acceleration[-1].sum(), solution

    return jax.jit(jax.value_and_grad(loss, has_aux=True))(scene.params["k"])


@pytest.mark.slow
@old
@pytest.mark.parametrize(
    "stepper",
    [pytest.param(hhtjax.hht(), id="auto"), pytest.param(hhtjax.hht(iterations=None), id="newton", marks=zoo.EVERY)],
)
def test_runs_are_the_same(stepper, monkeypatch):
    """The double pendulum on arrays is the witness."""
    scene = double_pendulum.stiff(trigonometry=hhtjax.trigonometry)
    found = value_and_gradient(scene, stepper)
    with monkeypatch.context() as changed:
        changed.setattr(scalars, "MOST_OPERATIONS", 0)
        exact = value_and_gradient(scene, stepper)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(exact), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)


@pytest.mark.slow
@old
def test_simulate_takes_scalars_where_they_pay():
    """In the loop of the double pendulum there is no small array; in that of the slider-crank there are."""

    stepper = hhtjax.hht(start="simple")  # the smooth start has loops of its own

    def shapes(scene):
        jaxpr = jax.make_jaxpr(
            lambda q: hhtjax.simulate(scene.system, stepper, q, scene.v0, scene.params, dt=1e-3, num_steps=50)
        )(scene.q0)
        scans = [x for x in zoo.everywhere(jaxpr.jaxpr) if x.primitive.name == "scan"]
        return {v.aval.shape for x in scans for v in x.params["jaxpr"].jaxpr.invars}

    assert shapes(double_pendulum.free()) == {()}
    assert (3,) in shapes(slider_crank.free())
