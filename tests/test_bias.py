"""What the step size does to stiffness and damping: predicted, measured on exact data, and taken back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.identification.refinement import Refined, StepSizeWarning, needed_levels
from hhtjax.runs.extrapolate import richardson

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
def test_predicted_bias_is_measured_and_taken_back(capfd):
    """Data without noise, w h = 0.35, alpha = -0.05: bias to 3 % of itself, a named warning, then next to none.

    Numerical damping adds an error of h^3: so there are three fits, of which two alone would not take it out.
    """
    stepper = hhtjax.hht(alpha=-0.05, linearize="predictor")
    with pytest.warns(StepSizeWarning, match=r"steps of 0.35 shift c \(.*k \(\+\d.* standard errors"):
        refined = hhtjax.refine(through, {"k": 1.2, "c": 0.1}, stepper, 0.35, progress=True)
    shown = capfd.readouterr().err
    assert [shown.count(x) for x in ("refine: fit 3 of 3, with steps of 0.0875 s", "converged")] == [1, 3]
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
    assert refined.standard_errors == refined.fits[-1].standard_errors
    title, header, *rows = refined.summary().splitlines()
    assert "extrapolated to dt = 0" in title
    assert "in standard errors" in header
    for name, row in zip(("c", "k"), rows, strict=True):
        shown = row.split()
        assert shown[0] == name
        expected = refined.params[name], refined.standard_errors[name], refined.shift[name]
        assert [float(x) for x in shown[1:]] == pytest.approx([float(x) for x in expected], rel=0.05)
    again = Refined.from_json(refined.to_json())
    assert again.stepper == stepper
    assert again.params == refined.params
    assert again.interval()[0]["k"] == refined.interval()[0]["k"]
    for other in (
        hhtjax.rk4(),
        hhtjax.dopri5(),
        hhtjax.rowda(),
        hhtjax.rosenbrock(),
    ):  # whose tableaus are named tuples
        assert Refined.from_json(refined._replace(stepper=other).to_json()).stepper == other


@pytest.mark.slow
def test_only_numerical_damping_needs_a_third_level():
    undamped = hhtjax.hht(alpha=0.0), hhtjax.generalized_alpha(rho_inf=1.0), hhtjax.kim_hht(alpha=0.0)
    damped = hhtjax.hht(alpha=-0.01), hhtjax.rk4(), hhtjax.kim_implicit_euler()
    assert [needed_levels(stepper) for stepper in (*undamped, *damped)] == [2, 2, 2, 3, 3, 3]


@pytest.mark.slow
def test_the_response_to_forces_is_corrected_too():
    """m, c, k of a driven oscillator at w h = 0.35: the closed forms, of k and c relative to m, and of the gain 1/m.

    A function in params stays as it is.
    """
    driven = hhtjax.System(
        lambda q, p: p["m"] * jnp.ones(1), lambda q, v, t, p: -p["k"] * q - p["c"] * v - p["cubic"] * p["law"](q)
    )
    fitted = {"m": 2.0, "c": 0.01, "k": 3.0, "cubic": 5.0, "law": lambda q: q**3}
    bias = hhtjax.step_size_bias(driven, hhtjax.hht(alpha=0.0), fitted, 0.3, q=jnp.zeros(1), correct=True)
    x = float(bias.wh[0]) / 2
    gain = np.tan(x) / x / np.cos(x) ** 2
    assert float(bias.params["m"]) == pytest.approx(2.0 * gain, rel=1e-4)
    assert float(bias.params["k"] / bias.params["m"]) == pytest.approx(1.5 * (x / np.tan(x)) ** 2, rel=1e-5)
    assert float(bias.params["c"] / bias.params["m"]) == pytest.approx(0.005 * np.cos(x) ** 2, rel=1e-4)
    assert (bias.params["cubic"], bias.params["law"]) == (5.0, fitted["law"])
    held = hhtjax.step_size_bias(
        driven, hhtjax.hht(alpha=0.0), fitted, 0.3, jnp.zeros(1), correct=dict.fromkeys(fitted, True) | {"m": False}
    )
    assert held.params["m"] == 2.0
    assert float(held.params["k"]) == pytest.approx(3.0 * (x / np.tan(x)) ** 2, rel=1e-4)


@pytest.mark.slow
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


ENTRIES = {"M": jnp.array([1.0, 0.0, 1.0]), "C": jnp.array([1.0, -0.4, 0.4]), "K": jnp.array([250.0, -150.0, 150.0])}
TRAPEZOIDAL = hhtjax.hht(alpha=0.0, linearize="predictor")
CHAIN = {"k1": 100.0, "k2": 150.0, "c1": 0.6, "c2": 0.4}


def symmetric(x):
    return jnp.stack([x[:2], x[1:]])


def driven_pair(entries_of):
    """A system of 2 coordinates, the second driven; entries_of: params -> those of M, C, K."""

    def force(q, v, t, p):
        u = p["u"](t)
        return jnp.stack([0 * u, u]) - symmetric(entries_of(p)["K"]) @ q - symmetric(entries_of(p)["C"]) @ v

    return hhtjax.System(lambda q, p: symmetric(entries_of(p)["M"]), force)


def fitted_through_steps(system, true, dt, exact=20):
    """Params as fitted to a record of steps of dt/exact, through steps of dt; input of many sines past both modes."""
    stepper, rest, count = TRAPEZOIDAL, jnp.zeros(2), 1000
    rate, phase = np.linspace(2.0, 28.0, 60)[:, None], np.random.default_rng(0).uniform(0, 2 * np.pi, (60, 1))
    u = jnp.asarray(np.sin(rate * dt / exact * np.arange((count + 2) * exact) + phase).sum(axis=0))
    fine = true | {"u": hhtjax.sampled(u, dt / exact)}
    run = hhtjax.simulate(system, stepper, rest, rest, fine, dt=dt / exact, num_steps=count * exact, save_every=exact)
    u = hhtjax.sampled(u[::exact], dt)

    def residuals(p):
        return hhtjax.simulate(system, stepper, rest, rest, p | {"u": u}, dt=dt, num_steps=count).q - run.q

    scale = jax.tree.map(lambda x: jnp.full_like(x, jnp.max(jnp.abs(x))), true)
    found = hhtjax.fit(residuals, jax.tree.map(jnp.asarray, true), scale=scale, covariance=False)
    assert found.converged
    return found.params | {"u": u}


@pytest.mark.slow
def test_two_driven_modes_with_free_masses_lose_their_bias():
    """w h = 0.15 and 0.43. All entries of M, C, K, which can follow whatever the steps do."""
    pair, dt = driven_pair(lambda p: p), 0.0227
    fitted = fitted_through_steps(pair, ENTRIES, dt)
    correct = dict.fromkeys(ENTRIES, True) | {"u": False}
    found = hhtjax.step_size_bias(pair, TRAPEZOIDAL, fitted, dt, jnp.zeros(2), correct=correct)
    for name, true in ENTRIES.items():
        before, after = (np.linalg.norm(x[name] - true) / np.linalg.norm(true) for x in (fitted, found.params))
        assert before > 0.01
        assert after < 0.15 * before


@pytest.mark.slow
def test_two_driven_modes_with_known_masses_have_their_stiffness_corrected():
    """The gain of the steps is in no parameter: damping makes up for some of it, by how much no eigenvalue knows."""

    def entries_of(p):
        k1, k2, c1, c2 = (p[name] for name in CHAIN)
        return {"M": ENTRIES["M"], "C": jnp.stack([c1 + c2, -c2, c2]), "K": jnp.stack([k1 + k2, -k2, k2])}

    chain, dt = driven_pair(entries_of), 0.0227
    fitted = fitted_through_steps(chain, CHAIN, dt)
    correct = dict.fromkeys(CHAIN, True) | {"u": False}
    with pytest.warns(StepSizeWarning, match="damping .* is not corrected. Use `refine` to correct it"):
        found = hhtjax.step_size_bias(chain, TRAPEZOIDAL, fitted, dt, jnp.zeros(2), correct=correct)
    before, after = (
        {name: abs(float(p[name]) / true - 1) for name, true in CHAIN.items()} for p in (fitted, found.params)
    )
    assert before["k2"] > 0.03
    assert after["k1"] < 0.2 * before["k1"]
    assert after["k2"] < 0.1 * before["k2"]
    assert after["c1"] == pytest.approx(before["c1"], rel=0.05)
    assert after["c2"] == pytest.approx(before["c2"], abs=1e-3)
    damping_only = dict.fromkeys(CHAIN, False) | {"c1": True, "c2": True, "u": False}
    with pytest.warns(StepSizeWarning):
        found = hhtjax.step_size_bias(chain, TRAPEZOIDAL, fitted, dt, jnp.zeros(2), correct=damping_only)
    for name in CHAIN:
        assert float(found.params[name]) == pytest.approx(float(fitted[name]), rel=1e-9)


TURNING = hhtjax.System(jnp.ones(3), lambda q, v, t, params: -v)
HANGING = {"g": 9.81, "c": 0.3}
hanging = hhtjax.System(
    jnp.full(2, 2.0),
    lambda q, v, t, p: jnp.stack([0.0 * p["g"], -2.0 * p["g"]]) - p["c"] * v,
    constraint=lambda q, t, p: jnp.sum(q**2)[None] - 0.25,
)


twice = hhtjax.System(hanging.mass, hanging.force, lambda q, t, p: jnp.tile(hanging.constraint(q, t, p), 2))


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


@pytest.mark.slow
def test_modes_are_told_apart_where_steps_move_them_onto_each_other():
    """alpha = 0 turns a mode of w h into one of 2 arctan(w h/2): exp(2.2i) is nearest to what becomes of 3. Wilson's
    method leaves no oscillation of the last."""
    apart = hhtjax.System(jnp.ones(4), lambda q, v, t, params: -params * q)
    wh = np.array([1.0, 1.02, 2.2, 3.0])
    found = hhtjax.step_size_bias(apart, hhtjax.hht(alpha=0.0), jnp.asarray(wh**2), 1.0, q=jnp.zeros(4))
    np.testing.assert_allclose(found.stiffness_bias, (wh / (2 * np.arctan(wh / 2))) ** 2 - 1, rtol=1e-9)
    stiff = jnp.asarray([0.01, 1.0, 4.0, 2500.0])
    np.testing.assert_array_equal(
        np.isnan(hhtjax.step_size_bias(apart, hhtjax.wilson(), stiff, 1.0, q=jnp.zeros(4)).frequency), [0, 0, 0, 1]
    )
    with pytest.raises(
        ValueError, match=r"`dt` must let every mode oscillate, to use `correct`; .* with which 1 of 4 do"
    ):
        hhtjax.step_size_bias(apart, hhtjax.wilson(), stiff, 1.0, q=jnp.zeros(4), correct=True)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: hhtjax.refine(3, 1.0, None, 0.1), TypeError, r"refine: `residuals_at` must be a function"),
        (
            lambda: hhtjax.refine(lambda p: p, 1.0, None, 0.1),
            TypeError,
            r"refine: `residuals_at` is called as .* argument \(p\)",
        ),
        (
            lambda: hhtjax.refine(through, 1.0, hhtjax.hht(), -0.1),
            ValueError,
            "refine: `dt` must be positive; received -0.1",
        ),
        (
            lambda: hhtjax.refine(through, 1.0, hhtjax.hht(), 0.1, covariance=False),
            ValueError,
            "refine: `covariance` must be True",
        ),
        (
            lambda: hhtjax.step_size_bias(spring, "hht", None, 0.1, q=jnp.zeros(1)),
            TypeError,
            "step_size_bias: `stepper` must be a stepper such as .* received 'hht'",
        ),
        (
            lambda: hhtjax.step_size_bias(spring, hhtjax.hht(), {"k": 1.0, "c": 0.1}, 0.1, jnp.zeros(1), correct="k"),
            TypeError,
            "step_size_bias: `correct` must be True, False or a pytree of them; received 'k'",
        ),
        (
            lambda: hhtjax.step_size_bias(hhtjax.FirstOrderSystem(lambda y, t, p: -y), hhtjax.hht(), None, 0.1, 1.0),
            TypeError,
            "step_size_bias: `system` must be a System or LinearSystem; received First",
        ),
        (
            lambda: hhtjax.step_size_bias(TURNING, hhtjax.hht(), None, 0.1, q=jnp.eye(3)),
            NotImplementedError,
            "step_size_bias: `q` has rotations",
        ),
        (
            lambda: hhtjax.step_size_bias(spring, hhtjax.hht(), {"k": 1.0, "c": 9.0}, 0.1, jnp.zeros(1), correct=True),
            ValueError,
            "step_size_bias: `params` must let a mode oscillate",
        ),
        (
            lambda: hhtjax.step_size_bias(spring, hhtjax.hht(), {"k": 1.0, "c": 0.1}, 0.1, q=jnp.zeros(2)),
            ValueError,
            r"step_size_bias: `q` must have as many numbers as the mass, 1; received shape \(2,\)",
        ),
        (
            lambda: hhtjax.step_size_bias(spring, hhtjax.hht(), {"k": 1.0, "c": 0.1}, 0.1, q=None),
            ValueError,
            "step_size_bias: `q` must hold at least one number; received None",
        ),
        (
            lambda: hhtjax.step_size_bias(spring, hhtjax.hht(), {"k": 1.0, "c": 0.1}, 0.1, jnp.zeros(1), jnp.zeros(2)),
            ValueError,
            r"step_size_bias: `v` must have the shapes of q, shape \(1,\) float64; received shape \(2,\)",
        ),
        (
            lambda: hhtjax.step_size_bias(hanging, hhtjax.hht(), HANGING, 0.1, q=jnp.array([0.0, -0.6])),
            ValueError,
            r"step_size_bias: `q` violates the constraint: max\|Phi\| = 0.11, 0.0917 away",
        ),
        (
            lambda: hhtjax.step_size_bias(twice, hhtjax.hht(), HANGING, 0.1, q=jnp.array([0.0, -0.5])),
            ValueError,
            r"step_size_bias: `constraint` rows \[0, 1\] depend on each other",
        ),
    ],
)
def test_bad_input_is_named(call, error, message):
    with pytest.raises(error, match=message):
        call()
