"""Systems in other packages: the same motion by diffrax and SciPy as by the library's own steppers."""

import builtins
from functools import cache

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

import hhtjax
from hhtjax import interop
from hhtjax.scenes import double_pendulum, motor_joint, pendulum, top


def by_scipy(system, q0, v0, params, duration, method="DOP853", **options):
    """q and v at the end."""
    rhs = interop.scipy_rhs(system, q0, v0, params)
    run = solve_ivp(rhs.fun, (0.0, duration), rhs.y0, method, rtol=1e-10, atol=1e-12, **options)
    return rhs.unravel(run.y[:, -1])


def by_us(system, q0, v0, params, duration, num_steps=400):
    """The same, of order 4."""
    run = hhtjax.simulate(
        system, hhtjax.hht(alpha=0.0, linearize="predictor"), q0, v0, params,
        dt=duration / num_steps, num_steps=num_steps, save_every=num_steps, extrapolate=2,
    )  # fmt: skip
    return jax.tree.map(lambda x: x[-1], (run.q, run.v))


def assert_near(ours, theirs, tolerance):
    np.testing.assert_allclose(ravel_pytree(ours)[0], ravel_pytree(theirs)[0], rtol=tolerance, atol=tolerance)


def as_dict(scene):
    """A double pendulum with M(q) as a dict whose keys sort otherwise."""

    def forces(q, v, t, params):
        x, u = (jnp.stack([y["upper"], y["fore"]]) for y in (q, v))
        Q = double_pendulum.force(x, u, t, params)
        return {"upper": Q[0], "fore": Q[1]}

    def mass(q, params):
        return double_pendulum.mass(jnp.stack([q["upper"], q["fore"]]), params)[::-1, ::-1]

    return hhtjax.System(mass, forces)


SCENE = double_pendulum.free()
ARM = as_dict(SCENE)
ARM_START = {"upper": 0.5, "fore": 0.2}, {"upper": 0.0, "fore": 1.0}
TRACES = []


def driven(q, v, t, params):
    TRACES.append(None)
    return params["net"](jnp.concatenate([q, v])) + jnp.sin(t)


CHAIN = hhtjax.LinearSystem(
    np.eye(3) + 0.1,
    0.2 * np.eye(3),
    lambda p: p["k"] * jnp.array([1.0, 4.0, 9.0]),
    lambda t, p: p["u"](t) * jnp.ones(3),
)
CASES = {
    "M(q), dicts": (ARM, *ARM_START, SCENE.params, 1.0),
    "linear, input": (
        CHAIN, jnp.ones(3), jnp.zeros(3), {"k": 2.0, "u": hhtjax.sampled(np.arange(5.0) ** 2, 0.5)}, 1.5
    ),
    "first order": (
        hhtjax.FirstOrderSystem(lambda y, t, p: {"a": -p * y["a"] + jnp.sin(t)}), {"a": jnp.ones(2)}, None, 3.0, 1.0
    ),
    "constraint": (*pendulum.cartesian()[:1], *pendulum.cartesian()[2:4], pendulum.cartesian().params, 0.5),
    "rotation": (*top.minimal()[:1], *top.minimal()[2:4], top.minimal().params, 0.1),
}  # fmt: skip


@cache
def exact(name):
    """By SciPy; both tests compare with it."""
    return by_scipy(*CASES[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_scipy_has_the_motion_of_our_steppers(name):
    system, q0, v0, params, duration = CASES[name]
    q, v = by_us(system, q0, v0, params, duration)
    assert_near((q,) if v0 is None else (q, v), exact(name), 2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_diffrax_has_the_motion_of_scipy(name):
    system, q0, v0, params, duration = CASES[name]

    @eqx.filter_jit
    def solve(term, y0, params):
        return diffrax.diffeqsolve(
            term, diffrax.Tsit5(), 0.0, duration, None, y0, params,
            stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-11),
        ).ys  # fmt: skip

    y0 = jax.tree.map(jnp.asarray, q0 if v0 is None else (q0, v0))
    found = jax.tree.map(lambda x: x[-1], solve(interop.diffrax_term(system), y0, params))
    assert_near(found, exact(name), 1e-7)


def test_implicit_solvers_of_scipy_take_the_jacobian():
    """A stiff scene, in which a Jacobian that is wrong would cost many more evaluations."""
    scene = double_pendulum.stiff()
    rhs = interop.scipy_rhs(scene.system, scene.q0, scene.v0, scene.params)
    h = 1e-6 * np.eye(4)
    y = rhs.y0 + np.array([0.1, -0.2, 0.5, 0.3])
    numerical = np.stack([(rhs.fun(0.1, y + d) - rhs.fun(0.1, y - d)) / 2e-6 for d in h], axis=1)
    np.testing.assert_allclose(rhs.jac(0.1, y), numerical, rtol=1e-6, atol=1e-4)
    run = solve_ivp(rhs.fun, (0.0, 0.2), rhs.y0, "Radau", jac=rhs.jac, rtol=1e-8, atol=1e-10)
    q, v = rhs.unravel(run.y)
    assert q.shape == v.shape == (run.t.size, 2)
    np.testing.assert_array_equal(rhs.unravel(run.y[:, 3])[0], q[3])
    assert run.nfev < 2000


@pytest.mark.slow
def test_internal_states_go_along():
    system, params, q0, v0, _, z0 = motor_joint.tracking()
    rhs = interop.scipy_rhs(system, q0, v0, params, z0=z0)
    run = solve_ivp(rhs.fun, (0.0, 0.2), rhs.y0, "Radau", jac=rhs.jac, rtol=1e-8, atol=1e-10)
    ours = hhtjax.simulate(
        system, hhtjax.hht(linearize="predictor"), q0, v0, params, z0=z0,
        dt=1e-3, num_steps=200, save_every=200, extrapolate=2,
    )  # fmt: skip
    ends = jax.tree.map(lambda x: x[-1], (ours.q, ours.v, ours.z))
    assert_near(rhs.unravel(run.y[:, -1]), ends, 1e-5)
    rates = rhs.unravel(rhs.fun(0.2, run.y[:, -1]))
    assert_near(rates, interop.diffrax_term(system).vf(0.2, rhs.unravel(run.y[:, -1]), params), 1e-12)
    assert_near(rates, jax.tree.map(lambda x: x[-1], (ours.v, ours.acceleration, ours.zdot)), 1e-2)


@pytest.mark.slow
def test_internal_states_beside_a_constraint():
    """A point on a circle, pulled by z: w is what the constraint leaves, and z moves as it says."""
    system = hhtjax.System(
        jnp.ones(2),
        lambda q, v, z, t, params: z,
        lambda q, t, params: jnp.sum(q**2, keepdims=True) / 2 - 0.5,
        internal=lambda q, v, z, t, params: -z + v,
    )
    y = jnp.array([1.0, 0.0]), jnp.array([0.0, 2.0]), jnp.array([3.0, 5.0])
    v, w, zdot = interop.ode(system)(0.0, y, None)
    np.testing.assert_allclose(w, [-4.0, 5.0])  # v^2/r inwards, z along
    np.testing.assert_array_equal(v, y[1])
    np.testing.assert_array_equal(zdot, y[1] - y[2])


def test_new_params_and_another_module_cost_no_compilation():
    system = hhtjax.System(np.ones(1), driven)
    nets = [eqx.nn.MLP(2, 1, 3, 1, key=jax.random.key(i)) for i in range(2)]
    first, second = (interop.scipy_rhs(system, jnp.ones(1), jnp.zeros(1), {"net": net}) for net in nets)
    a = first.fun(0.1, first.y0)
    traced = len(TRACES)
    b, c = second.fun(0.2, second.y0), second.fun(1, second.y0)
    equal = interop.scipy_rhs(hhtjax.System(np.ones(1), driven), jnp.ones(1), jnp.ones(1), {"net": nets[0]})
    np.testing.assert_allclose(equal.fun(0.1, first.y0), a, rtol=1e-14)
    shapes = 4  # of what each makes of its arguments when it is made: mass and force are looked at without compiling
    assert len(TRACES) - traced <= shapes
    np.testing.assert_allclose(a[1], nets[0](jnp.array([1.0, 0.0]))[0] + np.sin(0.1), rtol=1e-12)
    np.testing.assert_allclose(b[1] - c[1], np.sin(0.2) - np.sin(1.0), rtol=1e-10)


def test_the_field_of_equal_systems_is_equal():
    """So that jit finds the program of the first."""
    one, two = (interop.ode(hhtjax.System(np.ones(2), driven)) for _ in range(2))
    assert jax.tree.structure(one) == jax.tree.structure(two)
    a, b = (interop.flat_ode(hhtjax.System(np.ones(2), driven), np.ones(2), np.ones(2)).rate for _ in range(2))
    assert a == b
    assert hash(a) == hash(b)


def test_integers_are_numbers_as_others():
    """Rates are not cut to integers, where y is a state of these."""
    system = hhtjax.System(np.ones(1), lambda q, v, t, params: -0.5 * q + jnp.sin(t))
    first = hhtjax.FirstOrderSystem(lambda y, t, params: -0.5 * y + jnp.sin(t))
    expected = -1.5 + np.sin(0.3)
    for three in (3, np.array([3])):
        q = np.atleast_1d(three)
        np.testing.assert_allclose(interop.ode(system)(0.3, (q, 0 * q), None)[1], expected, rtol=1e-15)
        np.testing.assert_allclose(interop.ode(first)(0.3, three, None), np.full(np.shape(three), expected))


@pytest.mark.slow
def test_derivatives_through_diffrax():
    """Of the end in a parameter, against central differences through SciPy."""
    system = hhtjax.System(np.ones(1), lambda q, v, t, k: -k * jnp.sin(q))

    def end(k):
        found = diffrax.diffeqsolve(
            interop.diffrax_term(system), diffrax.Tsit5(), 0.0, 1.0, None, (jnp.ones(1), jnp.zeros(1)), k,
            stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-11), max_steps=256,
        )  # fmt: skip
        return found.ys[0][-1, 0]

    ends = [by_scipy(system, jnp.ones(1), jnp.zeros(1), 3.0 + d, 1.0)[0][0] for d in (1e-4, -1e-4)]
    np.testing.assert_allclose(jax.jit(jax.grad(end))(3.0), (ends[0] - ends[1]) / 2e-4, rtol=1e-6)


def test_a_missing_package_is_named_with_its_extra(monkeypatch):
    find = builtins.__import__

    def missing(name, *args, **keywords):
        if name.split(".")[0] == "diffrax":
            raise ImportError(name)
        return find(name, *args, **keywords)

    def import_module(name):
        return missing(name)

    monkeypatch.setattr("importlib.import_module", import_module)
    with pytest.raises(ImportError, match=r'diffrax_term: needs diffrax: pip install "hhtjax\[interop\]"'):
        interop.diffrax_term(ARM)


ONE = np.ones(1)
BEAD = pendulum.cartesian()
MOTOR = motor_joint.tracking()


@pytest.mark.parametrize(
    ("error", "message", "call"),
    [
        (TypeError, r"ode: `system` must be a System", lambda: interop.ode(None)),
        (TypeError, r"diffrax_term: `system` must be a System", lambda: interop.diffrax_term(len)),
        (TypeError, r"scipy_rhs: `system` must be a System", lambda: interop.scipy_rhs(1.0, 1.0)),
        (TypeError, r"ode: `y` must be \(q, v\), two pytrees", lambda: interop.ode(ARM)(0.0, jnp.ones(4), None)),
        (
            TypeError,
            r"ode: `y` must be \(q, v, z\), three pytrees",
            lambda: interop.ode(MOTOR.system)(0.0, MOTOR[2:4], MOTOR.params),
        ),
        (ValueError, r"flat_ode: `z0` must be given", lambda: interop.flat_ode(MOTOR.system, *MOTOR[2:4])),
        (ValueError, r"scipy_rhs: leave `z0` out", lambda: interop.scipy_rhs(ARM, *ARM_START, z0=1.0)),
        (ValueError, r"flat_ode: `v0` must have the shapes", lambda: interop.flat_ode(ARM, jnp.ones(2), jnp.ones(3))),
        (TypeError, r"scipy_rhs: `params` must be", lambda: interop.scipy_rhs(ARM, *ARM_START, "steel")),
        (ValueError, r"scipy_rhs: `t0` must be finite", lambda: interop.scipy_rhs(ARM, *ARM_START, None, np.nan)),
        (
            ValueError,
            r"scipy_rhs: `q0` violates the constraint",
            lambda: interop.scipy_rhs(BEAD.system, 2 * BEAD.q0, BEAD.v0, BEAD.params),
        ),
        (
            ValueError,
            r"scipy_rhs: `constraint` must return an array \(m,\)",
            lambda: interop.scipy_rhs(hhtjax.System(np.ones(1), lambda q, v, t, p: -q, lambda q, t, p: 0.0), ONE, ONE),
        ),
        (
            NotImplementedError,
            r"scipy_rhs: `system` has dry friction",
            lambda: interop.scipy_rhs(
                hhtjax.System(ONE, lambda q, v, t, p: -q, friction=lambda q, v, t, p: 1 + 0 * q), ONE, ONE
            ),
        ),
        (
            ValueError,
            r"scipy_rhs: `force` must return a pytree like v0",
            lambda: interop.scipy_rhs(
                hhtjax.System(np.ones(1), lambda q, v, t, p: jnp.ones(2)), np.ones(1), np.ones(1)
            ),
        ),
    ],
)
def test_arguments_are_checked(error, message, call):
    with pytest.raises(error, match=message):
        call()


@pytest.mark.filterwarnings("ignore::hhtjax.PrecisionWarning")
def test_single_precision_is_refused():
    single = np.ones(1, np.float32)
    with pytest.raises(ValueError, match="SciPy computes in double precision"):
        interop.scipy_rhs(hhtjax.System(np.ones(1), lambda q, v, t, p: -q), single, single)


@pytest.mark.filterwarnings("ignore:simulate. in float32")
def test_a_run_is_a_table(tmp_path):
    system = hhtjax.System(
        np.ones(4, np.float32),
        lambda q, v, t, p: {"R": -v["R"], "x": -q["x"]},
        constraint=lambda q, t, p: q["x"] - 1,
    )
    start = {"R": np.eye(3, dtype=np.float32), "x": np.ones(1, np.float32)}
    rates = {"R": np.full(3, 0.1, np.float32), "x": np.zeros(1, np.float32)}
    run = hhtjax.simulate(system, hhtjax.hht(), start, rates, dt=0.1, num_steps=3)
    table = interop.columns(run)
    assert [*table][:3] == ["t", "q.R[0,0]", "q.R[0,1]"]
    assert [*table][10:14] == ["q.x[0]", "v.R[0]", "v.R[1]", "v.R[2]"]
    assert [*table][-1] == "multipliers[0]"
    assert len(table) == 1 + 10 + 4 + 4 + 1
    np.testing.assert_array_equal(table["q.R[1,2]"], run.q["R"][:, 1, 2])

    interop.write_csv(tmp_path / "run.csv", run)
    read = np.loadtxt(tmp_path / "run.csv", np.float32, delimiter=",", skiprows=1)
    np.testing.assert_array_equal(read, np.stack([*table.values()], axis=1))  # to the last bit

    batch = jax.tree.map(lambda x: np.stack([x, x[::-1] if np.ndim(x) else x]), run)
    with pytest.raises(ValueError, match=r"received a batch of \(2,\) runs. Take a member first"):
        interop.columns(batch)
    member = interop.columns(jax.tree.map(lambda x: x[1], batch))
    np.testing.assert_array_equal(member["q.R[1,2]"], table["q.R[1,2]"][::-1])
    with pytest.raises(TypeError, match="write_csv: `solution` must be a Solution; received 3"):
        interop.write_csv(tmp_path / "three.csv", 3)

    pandas = pytest.importorskip("pandas")
    frame, read = pandas.DataFrame(table), pandas.read_csv(tmp_path / "run.csv")
    assert list(frame) == list(read) == list(table)
    np.testing.assert_allclose(read, frame, rtol=1e-7)
