"""What the step size does to stiffness and damping: predicted, measured on exact data, and taken back."""

import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.identification.refinement import Refined, needed_levels
from hhtjax.numerics.richardson import richardson

t = jnp.arange(0.0, 30.0, 0.35)
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


@pytest.mark.slow
def test_predicted_bias_is_measured_and_taken_back():
    """Data without noise, w h = 0.35, alpha = -0.05: bias to 3 % of itself, a named warning, then next to none.

    Numerical damping adds an error of h^3: so there are three fits, of which two alone would not take it out.
    """
    stepper = hhtjax.hht(alpha=-0.05, linearize="predictor")
    with pytest.warns(hhtjax.StepSizeWarning, match=r"steps of 0.35 shift c \(.*k \(\+\d.* standard errors"):
        refined = hhtjax.refine(through, {"k": 1.2, "c": 0.1}, stepper, 0.35)
    assert (refined.stepper, refined.dt) == (stepper, 0.35)
    found, fine, finest = refined.fits
    bias = hhtjax.step_size_bias(spring, stepper, found.params, 0.35, q=jnp.zeros(1), correct=True)
    assert bias.stiffness_bias[0] == pytest.approx(float(found.params["k"]) / K - 1, rel=0.03)
    assert bias.damping_bias[0] == pytest.approx(float(found.params["c"]) / C - 1, rel=0.03)
    assert bias.params["k"] == pytest.approx(K, abs=0.03 * float(found.params["k"] - K))
    assert bias.params["c"] == pytest.approx(C, abs=0.03 * float(found.params["c"] - C))
    assert bias.frequency[0] ** 2 == pytest.approx(K, rel=1e-3)  # free of the bias
    assert float(fine.params["k"] - K) == pytest.approx(float(found.params["k"] - K) / 4, rel=0.05)
    assert refined.fits[0].params["k"] - K > 0.02
    assert float(refined.params["k"]) == pytest.approx(K, abs=2e-4)
    assert float(refined.params["c"]) == pytest.approx(C, rel=1e-3)
    by_two = richardson([fine.params, finest.params], 2)
    assert abs(by_two["c"] - C) > 5 * abs(refined.params["c"] - C)
    again = Refined.from_json(refined.to_json())
    assert again.stepper == stepper
    assert again.params == refined.params
    assert again.interval()[0]["k"] == refined.interval()[0]["k"]


def test_only_numerical_damping_needs_a_third_level():
    undamped = hhtjax.hht(alpha=0.0), hhtjax.generalized_alpha(rho_inf=1.0), hhtjax.kim_hht(alpha=0.0)
    damped = hhtjax.hht(alpha=-0.01), hhtjax.rk4(), hhtjax.kim_implicit_euler()
    assert [needed_levels(stepper) for stepper in (*undamped, *damped)] == [2, 2, 2, 3, 3, 3]


def test_the_response_to_forces_is_corrected_too():
    """m, c, k of a driven oscillator at w h = 0.35: the closed forms, of k and c relative to m, and of the gain 1/m."""
    driven = hhtjax.System(
        lambda q, p: p["m"] * jnp.ones(1), lambda q, v, t, p: -p["k"] * q - p["c"] * v - p["cubic"] * q**3
    )
    fitted = {"m": 2.0, "c": 0.01, "k": 3.0, "cubic": 5.0}
    bias = hhtjax.step_size_bias(driven, hhtjax.hht(alpha=0.0), fitted, 0.3, q=jnp.zeros(1), correct=True)
    x = float(bias.wh[0]) / 2
    gain = np.tan(x) / x / np.cos(x) ** 2
    assert float(bias.params["m"]) == pytest.approx(2.0 * gain, rel=1e-4)
    assert float(bias.params["k"] / bias.params["m"]) == pytest.approx(1.5 * (x / np.tan(x)) ** 2, rel=1e-5)
    assert float(bias.params["c"] / bias.params["m"]) == pytest.approx(0.005 * np.cos(x) ** 2, rel=1e-4)
    assert bias.params["cubic"] == 5.0
    held = hhtjax.step_size_bias(
        driven, hhtjax.hht(alpha=0.0), fitted, 0.3, jnp.zeros(1), correct=dict.fromkeys(fitted, True) | {"m": False}
    )
    assert held.params["m"] == 2.0
    assert float(held.params["k"]) == pytest.approx(3.0 * (x / np.tan(x)) ** 2, rel=1e-4)


def test_the_bias_of_the_trapezoidal_rule_in_every_mode():
    """Two masses, w = 1 and w = sqrt(3): (tan x/x)^2 and, for damping proportional to K, 1/cos(x)^2."""
    K = jnp.array([[2.0, -1.0], [-1.0, 2.0]])
    pair = hhtjax.System(jnp.ones(2), lambda q, v, t, params: -K @ q - 1e-3 * K @ v)
    bias = hhtjax.step_size_bias(pair, hhtjax.hht(alpha=0.0), None, 0.5, q=jnp.zeros(2))
    x = bias.wh / 2
    np.testing.assert_allclose(bias.stiffness_bias, (np.tan(x) / x) ** 2 - 1, rtol=1e-3)
    np.testing.assert_allclose(bias.damping_bias, 1 / np.cos(x) ** 2 - 1, rtol=1e-3)
    fitted = bias.frequency * np.sqrt(1 + bias.stiffness_bias)
    np.testing.assert_allclose(fitted, [1.0, np.sqrt(3.0)], rtol=1e-12)


HANGING = {"g": 9.81, "c": 0.3}
hanging = hhtjax.System(
    jnp.full(2, 2.0),
    lambda q, v, t, p: jnp.stack([0.0 * p["g"], -2.0 * p["g"]]) - p["c"] * v,
    constraint=lambda q, t, p: jnp.sum(q**2)[None] - 0.25,
)


@pytest.mark.slow
def test_a_constraint_leaves_the_bias_of_the_minimal_form():
    """A point mass on a circle of 0.5 m: the multiplier's stiffness is all it has. s is in its real step, too."""
    stepper, dt, bottom = hhtjax.hht(alpha=-0.1), 0.07, jnp.array([0.0, -0.5])
    bias = hhtjax.step_size_bias(hanging, stepper, HANGING, dt, q=bottom, correct=True)
    w, zeta = float(bias.frequency[0]), float(bias.damping[0])
    s = w * (-zeta + 1j * np.sqrt(1 - zeta**2))
    assert w**2 * (1 + bias.stiffness_bias[0]) == pytest.approx(HANGING["g"] / 0.5, rel=1e-9)
    assert 2 * zeta * w * (1 + bias.damping_bias[0]) == pytest.approx(HANGING["c"] / 2.0, rel=1e-9)
    assert bias.stiffness_bias[0] > 0.01
    assert float(bias.params["g"]) == pytest.approx(0.5 * w**2, rel=1e-6)
    assert float(bias.params["c"]) == pytest.approx(2.0 * 2 * zeta * w, rel=1e-6)
    state = stepper.init(hanging, bottom, jnp.zeros(2), HANGING, dt)
    mu = np.linalg.eigvals(hhtjax.analysis.amplification_matrix(hanging, stepper, state, HANGING, dt=dt))
    assert np.min(np.abs(mu - np.exp(s * dt))) < 1e-9


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: hhtjax.refine(3, 1.0, None, 0.1), TypeError, r"refine: `residuals_at` must be a function"),
        (
            lambda: hhtjax.refine(through, 1.0, hhtjax.hht(), -0.1),
            ValueError,
            "refine: `dt` must be positive; received -0.1",
        ),
        (
            lambda: hhtjax.step_size_bias(spring, "hht", None, 0.1, q=jnp.zeros(1)),
            TypeError,
            "step_size_bias: `stepper` must be a stepper such as .* received 'hht'",
        ),
        (
            lambda: hhtjax.step_size_bias(hanging, hhtjax.hht(), HANGING, 0.1, q=jnp.array([0.0, -0.6])),
            ValueError,
            "step_size_bias: `q` must meet the constraint; received one that is 0.11 away",
        ),
    ],
)
def test_bad_input_is_named(call, error, message):
    with pytest.raises(error, match=message):
        call()
