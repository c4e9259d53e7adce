"""Functions among the params: modules of neural networks, whose activations are part of the program."""

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import hhtjax

TRACES = []
START = jnp.array([1.0]), jnp.array([0.0])
TWO = jnp.ones(2), jnp.zeros(2)  # unknowns, of which a step has stages


def network(seed):
    """A force of q and v."""
    return eqx.nn.MLP(2, 1, 3, 1, activation=jax.nn.tanh, key=jax.random.key(seed))


def force(q, v, t, params):
    TRACES.append(None)
    return params["net"](jnp.concatenate([q, v])) - params["k"] * q


def by_hand(q, v, t, params):
    """The same without a module."""
    (A, a), (B, b) = params["layers"]
    return B @ jnp.tanh(A @ jnp.concatenate([q, v]) + a) + b - params["k"] * q


def numbers(net):
    return [(layer.weight, layer.bias) for layer in net.layers]


SYSTEM, PLAIN = hhtjax.System(np.ones(1), force), hhtjax.System(np.ones(1), by_hand)
STEPPER = hhtjax.hht(linearize="predictor")


def run(net, k=2.0):
    return hhtjax.simulate(SYSTEM, STEPPER, *START, {"net": net, "k": k}, dt=0.05, num_steps=20).q


def run_by_hand(layers, k=2.0):
    return hhtjax.simulate(PLAIN, STEPPER, *START, {"layers": layers, "k": k}, dt=0.05, num_steps=20).q


@pytest.mark.slow
def test_a_run_with_a_module_and_another_of_its_structure_without_tracing_again():
    first, second = network(0), network(1)
    np.testing.assert_allclose(run(first), run_by_hand(numbers(first)), rtol=1e-12)
    count = len(TRACES)
    np.testing.assert_allclose(run(second), run_by_hand(numbers(second)), rtol=1e-12)
    assert len(TRACES) == count
    relu = eqx.tree_at(lambda net: net.activation, first, jax.nn.relu)
    assert np.max(np.abs(run(relu) - run(first))) > 1e-3  # another activation is another program
    assert len(TRACES) > count


@pytest.mark.slow
def test_derivatives_in_a_module():
    net = network(0)
    found = eqx.filter_jit(eqx.filter_grad(lambda net: jnp.sum(run(net) ** 2)))(net)
    expected = jax.jit(jax.grad(lambda layers: jnp.sum(run_by_hand(layers) ** 2)))(numbers(net))
    for ours, theirs in zip(jax.tree.leaves(numbers(found)), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_a_module_is_fitted():
    """To a curve, so that nothing is compiled but the fit; weights are held by a weak prior."""
    net, x = network(2), jnp.linspace(-1.0, 1.0, 40)
    inputs = jnp.stack([x, x**2], axis=1)

    def residuals(params):
        return jax.vmap(params["net"])(inputs)[:, 0] - jnp.sin(2 * x)

    result = hhtjax.fit(residuals, {"net": net}, prior=hhtjax.Gaussian(0.0, 100.0), weights=1e3)
    assert result.cost < 1e-3 * result.history.cost[0]
    assert result.free.shape == (13,)
    np.testing.assert_allclose(residuals(result.params), result.residual, rtol=1e-9, atol=1e-12)
    lower, upper = (ends["net"] for ends in result.interval())
    middle = result.params["net"]
    for low, p, high in zip(*(jax.tree.leaves(numbers(x)) for x in (lower, middle, upper)), strict=True):
        assert np.all(low < p)
        assert np.all(p < high)
    assert middle.activation is jax.nn.tanh
    assert "net.layers.0.weight[2, 1]" in result.summary()
    ax = hhtjax.plot.estimates(result)
    labels = [label.get_text() for label in ax.get_yticklabels()]
    assert len(labels) == 13
    assert labels[0].startswith("net.layers.0.weight[0, 0] = ")
    plt.close(ax.figure)


@pytest.mark.slow
def test_sweeps_initial_values_and_analyses_know_modules():
    """With a constraint, so that `consistent_initial` and the checks of `simulate` are asked too."""
    bead = hhtjax.System(
        np.ones(2),
        lambda q, v, t, params: params["wind"](v),
        lambda q, t, params: jnp.array([params["height"](q[0]) - q[1]]),
    )
    params = {"wind": jax.tree_util.Partial(jnp.multiply, -0.5), "height": jnp.square}
    start = hhtjax.consistent_initial(bead, jnp.array([0.5, 0.2]), jnp.array([1.0, 1.0]), params)
    one = hhtjax.simulate(bead, STEPPER, start.q, start.v, params, dt=0.1, num_steps=3)
    dts = jnp.array([0.1, 0.05])
    both = hhtjax.sweep(bead, STEPPER, start.q, start.v, params, dts=dts, duration=0.3, num_samples=3)
    np.testing.assert_allclose(both.q[0], one.q, rtol=1e-12)
    np.testing.assert_allclose(one.q[:, 1], one.q[:, 0] ** 2, atol=1e-5)  # O(h^6)
    assert (
        hhtjax.analysis.energy_balance(bead, one, params).kinetic[0]
        > hhtjax.analysis.energy_balance(bead, one, params).kinetic[-1]
    )
    orders = hhtjax.analysis.observed_order(bead, STEPPER, start.q, start.v, params, duration=0.3, num_steps=(3, 6, 12))
    assert abs(orders.slope[0] - 2) < 0.3
    state = STEPPER.init(bead, start.q, start.v, params, 0.1)
    A = hhtjax.analysis.amplification_matrix(bead, STEPPER, state, params, dt=0.1)
    assert np.max(np.abs(np.linalg.eigvals(A))) < 1.1


def test_a_new_function_of_the_same_code_is_another():
    def end(function):
        return hhtjax.simulate(
            hhtjax.System(np.ones(2), lambda q, v, t, params: params["f"](t) - q), hhtjax.rk4(), *TWO,
            {"f": function}, dt=0.1, num_steps=2,
        ).q[-1, 0]  # fmt: skip

    assert abs(end(lambda t: 1.0 + 0 * t) - end(lambda t: 2.0 + 0 * t)) > 1e-3
    with pytest.raises(TypeError, match=r"simulate: `params\['f'\]` must be an array, a number or a function"):
        end("sine")


@pytest.mark.slow
@pytest.mark.parametrize("grid", [{"dt": 0.05, "num_steps": 20}, {"dt": hhtjax.adaptive(1e-3, 1e-5), "times": [1.0]}])
def test_with_events(grid):
    """Guard, reset and switch see the function: down to .1 at t = .9, up with half the velocity, then with a force."""
    system = hhtjax.System(np.ones(2), lambda q, v, t, p: p["on"] + p["f"](0 * q))
    stop = hhtjax.Event(
        lambda q, v, t, p: p["f"](q[0]) - 0.1,
        lambda q, v, t, p: p["f"](-0.5 * v),
        switch=lambda p: p | {"on": p["f"](1.0)},
    )
    params = {"on": 0.0, "f": jnp.positive}
    found = hhtjax.simulate(system, hhtjax.dopri5(), TWO[0], -TWO[0], params, events=[stop], **grid)
    found.check()
    np.testing.assert_allclose(found.q[-1], 0.1 + 0.5 * 0.1 + 0.1**2 / 2, rtol=1e-12)
