"""What the steps do to linear motions, against closed forms that share no code with them."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import CLOSED_FORMS
from jax.flatten_util import ravel_pytree
from zoo import EVERY, as_data

import hhtjax
from hhtjax import analysis
from hhtjax.scenes import pendulum, squeezer, top

FREQUENCIES = np.geomspace(1e-3, 1e6, 46)


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_spectral_radius_equals_the_closed_form(name):
    stepper, roots = CLOSED_FORMS[name]
    for zeta in (0.0, 0.1):
        exact = np.array([abs(roots(W, zeta)).max() for W in FREQUENCIES], float)
        difference = abs(np.asarray(analysis.spectral_radius(stepper, FREQUENCIES, zeta)) - exact) / np.maximum(
            1, exact
        )
        threefold = name == "generalized_alpha(.8)"  # three roots meet, and double precision cannot tell them apart
        assert max(difference[(FREQUENCIES < 1e4) | (not threefold)]) < 1e-10
        assert max(difference) < 1e-8


@pytest.mark.parametrize("name", ["hht(-.05)", "hht(-.3)"])
def test_damping_ratio_and_period_equal_the_closed_form(name):
    stepper, roots = CLOSED_FORMS[name]
    for W, zeta in ((0.1, 0.0), (1.0, 0.05)):
        rate = np.log(max(roots(W, zeta), key=lambda root: root.imag))
        assert analysis.damping_ratio(stepper, W, zeta) == pytest.approx(float(-rate.real / abs(rate)), abs=1e-13)
        assert analysis.period_elongation(stepper, W, zeta) == pytest.approx(float(W / abs(rate) - 1), abs=1e-13)


@pytest.mark.parametrize(
    ("name", "W", "damping", "shift"),
    [
        ("hht(-.05)", 0.1, "5.6e-06", "-0.09"),
        ("hht(-.05)", 0.5, "6.3e-04", "-2.3"),
        ("hht(-.3)", 0.1, "1.8e-05", "-0.12"),
        ("hht(-.3)", 1.0, "1.2e-02", "-9.9"),
    ],
)
def test_bias_of_an_undamped_oscillator(name, W, damping, shift):
    """The known values; shift is that of the frequency, in per cent."""
    stepper, _ = CLOSED_FORMS[name]
    assert f"{analysis.damping_ratio(stepper, W):.1e}" == damping
    decimals = len(shift.partition(".")[2])
    assert f"{100 / (1 + analysis.period_elongation(stepper, W)) - 100:.{decimals}f}" == shift


def structure(matrix):
    """{eigenvalue to ten digits: sizes of its blocks}."""
    return {round(x.value.real, 10) + 0.0: x.blocks for x in analysis.jordan_structure(matrix)}


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.0, -0.05, -0.3])
def test_hht_has_one_jordan_block_at_infinity_and_ggl_has_none(alpha):
    double, weight = round(-(1 + alpha) / (1 - alpha), 10), round(alpha / (1 + alpha), 10)
    stepper = as_data(hhtjax.hht(alpha, formulation="index3"))
    found = structure(analysis.oscillator_matrix(stepper, jnp.inf))
    assert found == ({double: (2,), 0.0: (1, 1)} if alpha == 0 else {double: (2,), weight: (1,), 0.0: (1,)})
    found = structure(analysis.constraint_matrix(stepper))
    assert found[double] == (2,)
    assert set(found) == {double, weight, 0.0}
    found = structure(analysis.constraint_matrix(as_data(hhtjax.hht(alpha))))
    assert set(found) == {round(-(0.5 + alpha) / (0.5 - alpha), 10), weight, 0.0}
    assert all(set(blocks) == {1} for blocks in found.values())


def test_generalized_alpha_has_a_block_of_three_at_infinity():
    stepper, _ = CLOSED_FORMS["generalized_alpha(.8)"]
    assert structure(analysis.oscillator_matrix(stepper, jnp.inf)) == {-0.8: (3,), 0.0: (1,)}


@pytest.mark.parametrize(("alpha", "peak"), [(-0.05, 10), (-0.1, 5), (-0.3, 2)])
def test_transient_of_hht_at_infinity_peaks_where_its_jordan_block_says(alpha, peak):
    n, root = np.arange(41), (1 + alpha) / (1 - alpha)
    for matrix in (
        analysis.constraint_matrix(as_data(hhtjax.hht(alpha, formulation="index3"))),
        analysis.oscillator_matrix(as_data(hhtjax.hht(alpha)), jnp.inf),
    ):
        growth = analysis.transient_growth(matrix, 40)
        assert growth.argmax() == peak
        np.testing.assert_allclose(growth, n * root ** (n - 1.0), rtol=1e-9)
    assert not analysis.transient_growth(analysis.constraint_matrix(as_data(hhtjax.hht(alpha))), 40).any()


def test_powers_of_the_trapezoidal_rule_at_infinity():
    A = np.asarray(analysis.oscillator_matrix(as_data(hhtjax.hht(0.0)), np.inf))[np.ix_([0, 1, 3], [0, 1, 3])]
    for n in (1, 2, 7):
        row = np.linalg.matrix_power(A, n)[2]
        np.testing.assert_allclose(row, (-1) ** n * np.array([8 * n - 4, 4 * n, 1]), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "formulation"),
    [
        (pendulum.cartesian(), "index3"),
        (pendulum.cartesian(), "ggl"),
        pytest.param(squeezer.squeezer(), "index3", marks=EVERY),
    ],
    ids=("pendulum, index3", "pendulum, ggl", "squeezer, index3"),
)
def test_each_constraint_of_a_mechanism_has_the_spectrum_at_infinity(scene, formulation):
    alpha, dt = -0.1, 1e-6
    stepper = hhtjax.hht(alpha, formulation=formulation)
    state = jax.jit(stepper.init)(scene.system, scene.q0, scene.v0, scene.params, dt)
    m = state.L.size
    A = analysis.amplification_matrix(scene.system, stepper, state, scene.params, dt=dt)
    found = {round(x.value.real, 6) + 0.0: x.blocks for x in analysis.jordan_structure(A)}
    assert found[round(alpha / (1 + alpha), 6)] == m * (1,)
    if formulation == "index3":
        assert found[round(-(1 + alpha) / (1 - alpha), 6)] == m * (2,)
    else:
        assert found[round(-(0.5 + alpha) / (0.5 - alpha), 6)] == m * (1,)
    assert len(found) == 4  # with 1 of the free motion, and 0


def perturbed(state, dt, x):
    """The state moved by the scaled increments x of q, v, w and a."""
    v, unravel = ravel_pytree(state.v)
    dq, dv, dw, da = map(unravel, x.reshape(4, v.size) / jnp.array([[1], [dt], [dt**2], [dt**2]]))

    def move(q, psi):
        return q @ hhtjax.rotation.exp(psi) if q.shape != psi.shape else q + psi

    rates = {key: jax.tree.map(jnp.add, getattr(state, key), d) for key, d in (("v", dv), ("w", dw), ("a", da))}
    return state._replace(q=jax.tree.map(move, state.q, dq), **rates)


def increments(state, other, dt):
    """The scaled increments that lead from one state to the other."""

    def apart(q0, q1, v):
        return hhtjax.rotation.log(q0.T @ q1) if q0.shape != v.shape else q1 - q0

    dq = jax.tree.map(apart, state.q, other.q, state.v)
    rest = [jax.tree.map(jnp.subtract, getattr(other, x), getattr(state, x)) for x in ("v", "w", "a")]
    return jnp.concatenate([ravel_pytree(x)[0] * dt**k for x, k in zip((dq, *rest), (0, 1, 2, 2), strict=True)])


SPRING = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -q)


def cranes(q, v, t, params):
    """Two masses with nonlinear springs, one of them to the rail; of a dict, so that its order counts."""
    pull = jnp.sin(q["load"] - q["cart"])
    return {"load": -9.0 * pull - v["load"] ** 3, "cart": 9.0 * pull - 4.0 * q["cart"] ** 3 + params * t}


CRANE = hhtjax.System(lambda q, params: jnp.array([2.0 + q["load"] ** 2, 1.0]), cranes)
TOP = top.minimal()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "q0", "v0", "params"),
    [
        (CRANE, {"load": 0.5, "cart": -0.3}, {"load": 1.0, "cart": 2.0}, 1.5),
        pytest.param(TOP.system, TOP.q0, TOP.v0, TOP.params, marks=pytest.mark.slow),
    ],
    ids=("crane", "top"),
)
def test_tangent_of_a_step_predicts_what_becomes_of_a_perturbation(system, q0, v0, params):
    dt, stepper = 0.01, hhtjax.hht(-0.1, linearize="predictor", kinematics="lie")
    state = jax.jit(stepper.init)(system, q0, v0, params, dt)
    A = np.asarray(analysis.amplification_matrix(system, stepper, state, params, dt=dt))

    @jax.jit
    def central_difference(x):
        ahead, back = (stepper.step(system, perturbed(state, dt, y), params, dt)[0] for y in (x, -x))
        return increments(back, ahead, dt) / 2

    x = 1e-5 * np.random.default_rng(3).normal(size=len(A))
    np.testing.assert_allclose(central_difference(x), A @ x, atol=1e-8 * np.linalg.norm(x))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "v0"),
    [
        (hhtjax.System(jnp.ones(1), lambda q, v, t, rate: -rate * (0.1 * v + rate * q)), jnp.zeros(1)),
        (hhtjax.FirstOrderSystem(lambda y, t, rate: -rate * y), None),
    ],
    ids=("second order", "first order"),
)
def test_scaled_tangent_depends_on_rate_times_dt_only(system, v0):
    stepper, matrices = hhtjax.hht(-0.1), []
    for rate, dt in ((0.6, 1.0), (60.0, 0.01)):
        state = jax.jit(stepper.init)(system, jnp.zeros(1), v0, rate, dt)
        matrices.append(analysis.amplification_matrix(system, stepper, state, rate, dt=dt))
    np.testing.assert_allclose(*matrices, atol=1e-13)
    if v0 is not None:
        np.testing.assert_allclose(matrices[0], analysis.oscillator_matrix(stepper, 0.6, 0.05), atol=1e-13)


@pytest.mark.parametrize("alpha", [0.0, -0.3])
def test_stability_region_of_kims_step(alpha):
    z = np.array([[-1.0, 3.0 + 1j], [-30j, 1e3]])
    theta = (0.5 - alpha) * (1 + alpha)
    for given in (z, z.real, z.real.astype(int)):
        exact = abs(1 + given / (1 - theta * given))
        np.testing.assert_allclose(analysis.stability_region(hhtjax.kim_hht(alpha), given), exact, rtol=1e-12)


@pytest.mark.parametrize(("stepper", "order"), [(hhtjax.hht(-0.05), 2), (hhtjax.kim_hht(-0.1), 1)])
def test_observed_order(stepper, order, capsys):
    run = partial(analysis.observed_order, SPRING, stepper, jnp.ones(1), jnp.zeros(1), duration=2.0)
    against, alone = run(num_steps=(400, 600, 1600), reference=np.cos([2.0])), run(num_steps=(400, 800, 1600))
    np.testing.assert_allclose(against.slope, order, atol=0.03)
    np.testing.assert_allclose(alone.slope, order, atol=0.03)
    np.testing.assert_allclose(against.dt, [2 / 400, 2 / 600, 2 / 1600])
    assert alone.error.shape == (2,)
    assert not capsys.readouterr().err
    found = run(num_steps=(400, 600), reference=np.cos([2.0]), progress=True)
    assert "] observed_order: step size 2 of 2, 600 steps" in capsys.readouterr().err
    assert found.slope == pytest.approx([order], abs=0.03)
    assert alone.error[0] + alone.error[1] == pytest.approx(against.error[0] - against.error[2], rel=1e-6)


@pytest.mark.slow
def test_overshoot_of_the_first_step():
    """None of the trapezoidal rule. Of HHT in velocity, W (1 - gamma/(2 beta)), and 1.9 % more than that at W = 100."""
    W = np.array([0.1, 10.0, 1e4])
    np.testing.assert_allclose(analysis.overshoot(as_data(hhtjax.hht(0.0)), W), 1.0, rtol=1e-10)
    found = analysis.overshoot(as_data(hhtjax.hht(-0.3)), W)
    assert found[2] == pytest.approx(1e4 * (1 - 0.8 / (2 * 1.3**2 / 4)), rel=1e-3)


@pytest.mark.slow
def test_transformations_and_single_precision():
    def damping(alpha, W):
        return analysis.damping_ratio(hhtjax.hht(alpha), W, 0.02)

    value = jax.jit(damping)
    by_alpha, by_W = jax.jit(jax.grad(damping, argnums=(0, 1)))(-0.1, 0.7)
    assert float(by_alpha) == pytest.approx(float(value(-0.0999, 0.7) - value(-0.1001, 0.7)) / 2e-4, rel=1e-6)
    assert float(by_W) == pytest.approx(float(value(-0.1, 0.7001) - value(-0.1, 0.6999)) / 2e-4, rel=1e-6)
    alphas = jnp.array([-0.3, -0.1])
    together = jax.vmap(lambda alpha: analysis.oscillator_matrix(hhtjax.hht(alpha), 0.7))(alphas)
    for alpha, A in zip(alphas, together, strict=True):
        np.testing.assert_allclose(A, analysis.oscillator_matrix(as_data(hhtjax.hht(alpha)), 0.7), rtol=1e-12)
    assert analysis.spectral_radius(hhtjax.rk4(), jnp.float32(0.7)).dtype == jnp.float32  # no run, and no warning


FREE = hhtjax.System(jnp.ones(1), lambda q, v, t, params: 0 * q)
ORDER = partial(analysis.observed_order, SPRING, hhtjax.hht(), jnp.ones(1), jnp.zeros(1))
SUGGEST = partial(analysis.suggest_step_size, SPRING, hhtjax.hht(), jnp.ones(1), jnp.zeros(1))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: analysis.spectral_radius("hht", 1.0), TypeError, "`stepper` must be a stepper"),
        (lambda: analysis.spectral_radius(hhtjax.hht(), [1.0, -2.0]), ValueError, "`frequency` must be positive"),
        (lambda: analysis.oscillator_matrix(hhtjax.hht(), "fast"), TypeError, "`frequency` must be real"),
        (lambda: analysis.overshoot(hhtjax.hht(), 1.0, np.inf), ValueError, "`damping` must be finite"),
        (
            lambda: analysis.constraint_matrix(hhtjax.rk4()),
            NotImplementedError,
            "constraint_matrix: RK4 cannot solve the `constraint`",
        ),
        (
            lambda: analysis.amplification_matrix(SPRING, hhtjax.hht(), None, dt=0.1),
            TypeError,
            "`state` must be a State",
        ),
        (lambda: analysis.stability_region(hhtjax.hht(), np.nan), ValueError, "`z` must be finite"),
        (lambda: analysis.jordan_structure(np.ones((2, 3))), ValueError, "`matrix` must be square"),
        (lambda: analysis.jordan_structure(np.diag([1.0, 1.0005])), ValueError, "take a smaller tolerance"),
        (lambda: analysis.transient_growth(np.eye(2), 0), ValueError, "`num_steps` must be a positive integer"),
        (lambda: ORDER(duration=0.0, num_steps=(1, 2, 4)), ValueError, "`duration` must be positive"),
        (lambda: ORDER(duration=1.0, num_steps=(1, 2)), ValueError, "`num_steps` must be increasing"),
        (lambda: ORDER(duration=1.0, num_steps=(2, 4, 5)), ValueError, "`num_steps` must be a geometric sequence"),
        (lambda: SUGGEST(tolerance=0.0), ValueError, r"`tolerance` must lie in \(0, 1\)"),
        (lambda: SUGGEST(tolerance=1e-15), ValueError, "no step keeps the mode at 1 rad/s"),
        (lambda: SUGGEST(duration=0.0), ValueError, "`duration` must be positive"),
        (lambda: SUGGEST(duration=1.0, highest=2.0), ValueError, "`highest` must be left out"),
        (lambda: SUGGEST(highest=0.5), ValueError, "`highest` must reach the slowest mode, 1 rad/s"),
        (
            lambda: analysis.suggest_step_size(FREE, hhtjax.hht(), jnp.ones(1), jnp.zeros(1)),
            ValueError,
            "has no time scale of its own",
        ),
    ],
)
def test_bad_input(call, error, message):
    with pytest.raises(error, match=message):
        call()
