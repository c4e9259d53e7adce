"""Rotations in a step: orders, and the equations of the step, against references."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from zoo import EVERY, each

import hhtjax
from hhtjax.rotation import cross, exp, hat, tangent, vee
from hhtjax.systems import kinematics

E1, E3 = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
ARM, TIP = np.array([0.1, -0.05, 0.3]), np.array([0.05, 0.2, 0.6])
J = np.array([[0.4, 0.05, -0.03], [0.05, 0.7, 0.08], [-0.03, 0.08, 0.9]])
PARAMS = {"m": jnp.array(2.0), "cart": jnp.array(1.5), "k": jnp.array(30.0), "c": jnp.array(0.4)}
PARAMS |= {"J": jnp.asarray(J), "tip": jnp.asarray(TIP)}
R0 = Rotation.from_rotvec([0.4, -0.3, 0.8]).as_matrix()
OM0 = np.array([1.0, 2.0, -1.5])
DURATION = 1.0


def mass(q, params):
    """A cart on a rail along x that carries a body on a ball joint, with its centre of mass at ARM."""
    m, arm = params["m"], jnp.asarray(ARM)
    about_joint = params["J"] - m * hat(arm) @ hat(arm)
    coupling = m * jnp.cross(arm, q["R"][0])  # of the body's rate with the cart's: -m (R hat(arm))^T e1
    return jnp.block([[about_joint, coupling[:, None]], [coupling[None, :], (m + params["cart"])[None, None]]])


def force(q, v, t, params):
    (R, s), (Om, rate), m, arm = (q["R"], q["s"]), (v["R"], v["s"]), params["m"], jnp.asarray(ARM)
    centripetal = m * cross(Om, cross(Om, arm))
    moment = cross(arm, R.T @ jnp.array([0.0, 0.0, -9.81 * m]) - centripetal) - cross(Om, params["J"] @ Om)
    drive = jnp.array([0.5, -1.0, 0.3]) * jnp.cos(3 * t) - 0.1 * Om
    along = -jnp.sum(R[0] * centripetal) - params["k"] * s - params["c"] * rate + 2 * jnp.sin(4 * t)
    return {"R": moment + drive, "s": along}


def constraint(q, t, params):
    """The height of the tip is a given motion, which the cart shifts."""
    height = jnp.sum(q["R"][2] * params["tip"])
    return height[None] + 0.2 * q["s"] ** 2 - 0.55 - 0.05 * jnp.sin(2 * t)


FREE, HELD = hhtjax.System(mass, force), hhtjax.System(mass, force, constraint)


@cache
def start(constrained):
    q0, v0 = {"R": jnp.asarray(R0), "s": jnp.array([0.1])}, {"R": jnp.asarray(OM0), "s": jnp.array([0.5])}
    if not constrained:
        return q0, v0
    return hhtjax.consistent_initial(HELD, q0, v0, PARAMS)[:2]


def numpy_terms(R, s, Om, rate, t):
    """M, Q, B of one row, and what of the second derivative of Phi is without accelerations; once more, on arrays."""
    m, cart, k, c = (float(PARAMS[x]) for x in ("m", "cart", "k", "c"))
    a = np.cross(ARM, -np.eye(3))
    row = -m * (R @ a)[0]
    M = np.block([[J - m * a @ a, row[:, None]], [row, m + cart]])
    centripetal = np.cross(Om, np.cross(Om, ARM))
    moment = np.cross(ARM, R.T @ [0, 0, -9.81 * m]) - m * np.cross(ARM, centripetal) - np.cross(Om, J @ Om)
    moment += np.array([0.5, -1.0, 0.3]) * np.cos(3 * t) - 0.1 * Om
    Q = np.append(moment, -m * E1 @ R @ centripetal - k * s - c * rate + 2 * np.sin(4 * t))
    B = np.append(np.cross(TIP, R.T @ E3), 0.4 * s)
    return M, Q, B, E3 @ R @ np.cross(Om, np.cross(Om, TIP)) + 0.4 * rate**2 + 0.2 * np.sin(2 * t)


def numpy_acceleration(R, s, Om, rate, t, constrained):
    """A, the cart's acceleration, and L."""
    M, Q, B, gamma = numpy_terms(R, s, Om, rate, t)
    if not constrained:
        return np.linalg.solve(M, Q), np.zeros(0)
    wL = np.linalg.solve(np.block([[M, -B[:, None]], [B, 0.0]]), np.append(Q, -gamma))
    return wL[:4], wL[4:]


@cache
def reference(constrained):
    """(R, s), (Om, rate), w and L at the end, by SciPy on R and Om as they are."""
    (q0, v0) = start(constrained)

    def unpack(y):
        return y[:9].reshape(3, 3), y[9], y[10:13], y[13]

    def derivative(t, y):
        R, _, Om, rate = unpack(y)
        w, _ = numpy_acceleration(*unpack(y), t, constrained)
        return np.concatenate([(R @ np.cross(Om, -np.eye(3))).ravel(), [rate], w])

    y0 = np.concatenate([np.ravel(q0["R"]), q0["s"], v0["R"], v0["s"]])
    y = solve_ivp(derivative, (0.0, DURATION), y0, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return y[:10], y[10:], *numpy_acceleration(*unpack(y), DURATION, constrained)


def check_order(make, constrained, alpha, expected, quantities=4):
    """The slopes of the errors in q, v, w and L, or in the first of these; `make` builds the stepper from alpha."""
    end, errors = final_state(make, constrained), []
    for num_steps in (400, 800):
        s = end(alpha, num_steps)
        values = [np.concatenate([np.ravel(x["R"]), x["s"]]) for x in (s.q, s.v, s.w)] + [s.L] * constrained
        errors.append([np.max(np.abs(x - y)) for x, y in zip(values, reference(constrained), strict=False)])
        np.testing.assert_allclose(s.q["R"].T @ s.q["R"], np.eye(3), atol=1e-14)
    slopes = np.log2(np.array(errors[0]) / np.array(errors[1]))
    np.testing.assert_allclose(slopes[:quantities], expected, atol=0.15)


@cache
def final_state(make, constrained):
    """State at the end, as a function of alpha, the number of steps and the time they take, compiled once."""
    system, (q0, v0) = (HELD if constrained else FREE), start(constrained)

    @jax.jit
    def end(alpha, num_steps, duration=DURATION):
        stepper, dt = make(alpha), duration / num_steps
        begin = stepper.init(system, q0, v0, PARAMS, dt)
        return jax.lax.fori_loop(0, num_steps, lambda _, s: stepper.step(system, s, PARAMS, dt)[0], begin)

    return end


FREE_FORMS = {
    "chart": partial(hhtjax.hht, linearize="predictor", start="corrected"),
    "lie": partial(hhtjax.hht, linearize="predictor", kinematics="lie"),
    "auto": hhtjax.hht,
    "state": partial(hhtjax.hht, linearize="state"),
    "converged": partial(hhtjax.hht, iterations=None, tolerance=1e-12),
    "bossak": partial(hhtjax.bossak, linearize="held"),
}
HELD_FORMS = {
    "ggl": hhtjax.hht,
    "ggl, lie": partial(hhtjax.hht, kinematics="lie"),
    "index 3": partial(hhtjax.hht, formulation="index3"),
    "converged": partial(hhtjax.hht, iterations=None, tolerance=1e-12),
}


@pytest.mark.parametrize("form", each(FREE_FORMS, quick=(), rest=("chart", "converged")))
def test_order(form):
    """2 in position, velocity and acceleration, for a full inertia, M(q) and explicit time."""
    for alpha in (0.0, -0.05, -0.3):
        check_order(FREE_FORMS[form], False, jnp.asarray(alpha), 2)


@pytest.mark.parametrize("form", each(HELD_FORMS, quick=(), rest=("ggl, lie",)))
def test_order_with_a_moving_constraint(form):
    """2, in the multiplier too."""
    for alpha in (-0.05, -0.3):
        check_order(HELD_FORMS[form], True, jnp.asarray(alpha), 2)


@pytest.mark.parametrize("constrained", [pytest.param(False, marks=EVERY), pytest.param(True, marks=pytest.mark.slow)])
def test_literal_step_is_as_printed_and_of_first_order(constrained):
    """Cardona and Geradin's projection of forces by T^T: of order 1 but for alpha = 0, where w and L oscillate."""
    literal = partial(hhtjax.conventional_hht, fictive_time=False, tolerance=1e-12)
    check_order(literal, constrained, jnp.asarray(0.0), 2, quantities=2 if constrained else 3)
    check_order(literal, constrained, jnp.asarray(-0.3), 1)
    alpha, dt = -0.3, 0.02
    end = final_state(literal, constrained)(jnp.asarray(alpha), 1, dt)
    (R0, *before), (R1, *after) = (
        (np.asarray(q["R"]), q["s"][0], np.asarray(v["R"]), v["s"][0]) for q, v in (start(constrained), (end.q, end.v))
    )
    (_, Q0, B0, _), (M1, Q1, B1, _) = numpy_terms(R0, *before, 0.0), numpy_terms(R1, *after, dt)
    if constrained:
        Q0, Q1 = Q0 + B0 * numpy_acceleration(R0, *before, 0.0, True)[1], Q1 + B1 * end.L
    now = M1 @ np.append(end.w["R"], end.w["s"]) - (1 + alpha) * Q1
    psi = Rotation.from_matrix(R0.T @ R1).as_rotvec()
    P, angle = np.cross(psi, -np.eye(3)), np.linalg.norm(psi)
    T = np.eye(3) - (1 - np.cos(angle)) / angle**2 * P + (angle - np.sin(angle)) / angle**3 * P @ P
    np.testing.assert_allclose(np.append(T.T @ now[:3], now[3]), -alpha * Q0, atol=1e-9)


@pytest.mark.slow
def test_end_of_chart_is_the_motion_of_the_rotation():
    """Om = vee(R^T dR/dt) and A = dOm/dt of R(t) = R0 exp(x + v t + w t^2/2), beside plain coordinates."""
    x, v, w, a = np.random.default_rng(0).normal(size=(4, 4))  # three of a rotation, and one more
    q0 = {"R": jnp.asarray(R0), "s": jnp.zeros(1)}
    blocks = kinematics.layout(q0, {"R": jnp.zeros(3), "s": jnp.zeros(1)})

    def Om(t, w):
        def R(t):
            return jnp.asarray(R0) @ exp(x[:3] + v[:3] * t + w[:3] * t**2 / 2)

        return vee(R(t).T @ jax.jvp(R, (t,), (1.0,))[1])

    def accelerate(w):
        return jnp.append(jax.jvp(partial(Om, w=w), (0.0,), (1.0,))[1], w[3])

    expected = jax.jit(lambda: (jnp.append(Om(0.0, w), v[3]), accelerate(w), accelerate(a)))()
    for found, exact in zip(jax.jit(partial(kinematics.end_of_chart, blocks))(x, v, w, a), expected, strict=True):
        np.testing.assert_allclose(found, exact, rtol=1e-13)


def test_chart_jerk_is_the_third_rate_of_the_displacement():
    """Om'' of R(t) = R0 exp(v t + w t^2/2 + j t^3/6) at t = 0 leads back to j."""
    v, w, jerk = np.random.default_rng(1).normal(size=(3, 3))
    blocks = kinematics.layout(jnp.eye(3), jnp.zeros(3))

    def Om(t):
        return tangent(v * t + w * t**2 / 2 + jerk * t**3 / 6) @ (v + w * t + jerk * t**2 / 2)

    found = jax.jit(lambda: kinematics.chart_jerk(blocks, v, w, jax.jacfwd(jax.jacfwd(Om))(0.0)))()
    np.testing.assert_allclose(found, jerk, rtol=1e-13)
