"""What the step size does to stiffness and damping: predicted, measured on exact data, and taken back."""

import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax

t = jnp.arange(0.0, 60.0, 0.35)
K, C = 1.0, 0.04
DECAY, FREQUENCY = C / 2, np.sqrt(K - C**2 / 4)
EXACT = jnp.exp(-DECAY * t) * (jnp.cos(FREQUENCY * t) + DECAY / FREQUENCY * jnp.sin(FREQUENCY * t))
spring = hhtjax.System(jnp.array([1.0]), lambda q, v, t, params: -params["k"] * q - params["c"] * v)


def through(stepper, dt):
    """The residual of a free vibration, sampled every 0.35."""
    each = round(0.35 / dt)

    def residuals(params):
        one, zero = jnp.ones(1), jnp.zeros(1)
        steps = (len(t) - 1) * each
        run = hhtjax.simulate(spring, stepper, one, zero, params, dt=dt, num_steps=steps, save_every=each)
        return run.q[:, 0] - EXACT

    return residuals


def test_predicted_bias_is_measured_and_richardson_takes_it_back():
    """Data without noise, w h = 0.35, alpha = -0.05: bias to 3 % of itself, a named warning, k to 1e-4."""
    stepper = hhtjax.hht(alpha=-0.05, linearize="predictor")
    with pytest.warns(hhtjax.StepSizeWarning, match=r"steps of 0.35 shift c \(.*k \(\+\d.* standard errors"):
        refined = hhtjax.refine(through, {"k": 1.2, "c": 0.1}, stepper, 0.35)
    assert (refined.stepper, refined.dt) == (stepper, 0.35)
    for fit, dt in ((refined.coarse, 0.35), (refined.fine, 0.175)):
        bias = hhtjax.step_size_bias(spring, stepper, fit.params, dt, q=jnp.zeros(1))
        assert bias.stiffness_bias[0] == pytest.approx(float(fit.params["k"]) / K - 1, rel=0.03)
        assert bias.damping_bias[0] == pytest.approx(float(fit.params["c"]) / C - 1, rel=0.03)
        assert bias.frequency[0] ** 2 == pytest.approx(K, rel=1e-3)  # free of the bias
    assert abs(refined.coarse.params["k"] - K) > 0.02
    assert float(refined.params["k"]) == pytest.approx(K, abs=2e-4)
    assert float(refined.params["c"]) == pytest.approx(C, rel=3e-3)


@pytest.mark.parametrize("wh", [0.1, 0.7])
def test_the_bias_of_the_trapezoidal_rule_in_every_mode(wh):
    """Two masses, w = 1 and w = sqrt(3): (tan x/x)^2 and, for damping proportional to K, 1/cos(x)^2."""
    K = jnp.array([[2.0, -1.0], [-1.0, 2.0]])
    pair = hhtjax.System(jnp.ones(2), lambda q, v, t, params: -K @ q - 1e-3 * K @ v)
    bias = hhtjax.step_size_bias(pair, hhtjax.hht(alpha=0.0), None, wh, q=jnp.zeros(2))
    x = bias.wh / 2
    np.testing.assert_allclose(bias.stiffness_bias, (np.tan(x) / x) ** 2 - 1, rtol=1e-3)
    np.testing.assert_allclose(bias.damping_bias, 1 / np.cos(x) ** 2 - 1, rtol=1e-3)
    fitted = bias.frequency * np.sqrt(1 + bias.stiffness_bias)
    np.testing.assert_allclose(fitted, [1.0, np.sqrt(3.0)], rtol=1e-12)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: hhtjax.refine(3, 1.0, None, 0.1), TypeError, r"refine: `residuals_at` must be a function"),
        (lambda: hhtjax.refine(through, 1.0, None, -0.1), ValueError, "refine: `dt` must be positive; received -0.1"),
        (
            lambda: hhtjax.step_size_bias(spring, "hht", None, 0.1, q=jnp.zeros(1)),
            TypeError,
            "step_size_bias: `stepper` must be a stepper such as .* received 'hht'",
        ),
        (
            lambda: hhtjax.step_size_bias(hhtjax.scenes.pendulum.cartesian().system, hhtjax.hht(), None, 0.1, q=t),
            NotImplementedError,
            "step_size_bias: `system` has a constraint",
        ),
    ],
)
def test_bad_input_is_named(call, error, message):
    with pytest.raises(error, match=message):
        call()
