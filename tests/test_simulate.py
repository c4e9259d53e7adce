"""The run: what it saves, dense output, the progress bar, Lagrangian systems."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from zoo import PROBLEMS, STEPPERS, run

import hhtjax
from hhtjax.numerics.checkpointed_scan import checkpointed_scan
from hhtjax.scenes import double_pendulum
from hhtjax.systems.system import mass_at

DUFFING = PROBLEMS["forced Duffing"]


@pytest.mark.slow
@pytest.mark.parametrize("save_every", [1, 2, 7, 70, 210])
@pytest.mark.parametrize("name", ["hht auto", "hht converged"])
def test_saving_less_saves_a_part_of_the_same_path(name, save_every):
    every = run(DUFFING, STEPPERS[name], 210)
    some = run(DUFFING, STEPPERS[name], 210, save_every=save_every)
    assert some.q.shape == (210 // save_every + 1, 1)
    for field in ("t", "q", "v", "acceleration"):
        np.testing.assert_allclose(getattr(some, field), getattr(every, field)[::save_every], rtol=1e-12)
    if name == "hht converged":
        np.testing.assert_array_equal(some.info.iterations, every.info.iterations.reshape(-1, save_every).sum(axis=1))
        np.testing.assert_allclose(some.info.residual, every.info.residual.reshape(-1, save_every).max(axis=1))
        assert some.info.converged.all()
    else:
        assert some.info.residual is None


def test_the_start_is_the_first_saved_time():
    path = run(DUFFING, hhtjax.hht(), 10, t0=3.0)
    np.testing.assert_allclose(path.t, 3.0 + 0.2 * np.arange(11), rtol=1e-15)
    np.testing.assert_array_equal(path.q[0], DUFFING.q0)
    np.testing.assert_array_equal(path.v[0], DUFFING.v0)
    np.testing.assert_allclose(path.acceleration[0], DUFFING.system.force(DUFFING.q0, DUFFING.v0, 3.0, DUFFING.params))


def test_acceleration_obeys_the_equation_of_motion():
    path = run(DUFFING, hhtjax.hht(alpha=-0.3, iterations=None), 100)
    force = jax.jit(jax.vmap(lambda q, v, t: DUFFING.system.force(q, v, t, DUFFING.params)))(path.q, path.v, path.t)
    np.testing.assert_allclose(path.acceleration, force, atol=1e-9)


def test_times_do_not_drift_in_float32():
    q0 = jnp.zeros(1, jnp.float32)
    with pytest.warns(hhtjax.PrecisionWarning):
        path = hhtjax.simulate(
            DUFFING.system, hhtjax.hht(), q0, q0, DUFFING.params, dt=1e-3, num_steps=100_000, save_every=10_000
        )
    np.testing.assert_allclose(path.t, np.linspace(0, 100, 11), rtol=2e-7)


@pytest.mark.parametrize("length", [1, 2, 31, 32, 33, 101, 499, 500, 1009])
def test_nested_scan_equals_a_plain_one(length):
    def body(x, _):
        return x * 1.01 + 1.0, jnp.stack([x, 2 * x])

    @jax.jit
    def both(start):
        return checkpointed_scan(body, start, length), jax.lax.scan(body, start, None, length)

    for a, b in zip(*both(0.5), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14)


@pytest.mark.slow
def test_a_member_of_a_batch_keeps_fewer_states():
    """And computes more of them again: what many keep takes longer to fill."""

    def loss(q):
        return jnp.sum(
            hhtjax.simulate(DUFFING.system, hhtjax.hht(), q, 0 * q, DUFFING.params, dt=0.01, num_steps=2048).q
        )

    def computed_again(f, q):
        return str(jax.make_jaxpr(f)(q)).count("remat")

    alone, q = computed_again(jax.grad(loss), jnp.ones(1)), jnp.ones((2, 1))
    for batch in (jax.vmap(jax.grad(loss)), jax.grad(lambda q: jnp.sum(jax.vmap(loss)(q)))):
        assert computed_again(batch, q) > alone
        assert computed_again(jax.jit(batch), q) > alone


def test_dense_output_is_of_order_four():
    """Between samples of an exact run: x = cos 2t."""
    spring = hhtjax.System(jnp.array([1.0]), lambda q, v, t, params: -4.0 * q)
    times = np.linspace(0.0, 1.0, 201)

    def error(intervals):
        path = hhtjax.simulate(
            spring,
            hhtjax.rk4(),
            jnp.array([1.0]),
            jnp.array([0.0]),
            dt=1e-3,
            num_steps=1000,
            save_every=1000 // intervals,
        )
        q, v = (np.asarray(x)[:, 0] for x in hhtjax.interpolate(path, times)[:2])
        return np.array([np.max(np.abs(q - np.cos(2 * times))), np.max(np.abs(v + 2 * np.sin(2 * times)))])

    np.testing.assert_allclose(np.log2(error(10) / error(20)), 4, atol=0.15)


@pytest.mark.slow
def test_dense_output_meets_the_saved_states_and_keeps_trees():
    q0 = {"b": jnp.asarray(0.2), "a": jnp.array([[0.5, 0.1]])}
    v0 = jax.tree.map(jnp.zeros_like, q0)
    system = hhtjax.System(jnp.ones(3), lambda q, v, t, params: jax.tree.map(lambda x: -x, q))
    path = hhtjax.simulate(system, hhtjax.hht(), q0, v0, dt=0.1, num_steps=20, save_every=2)
    at_nodes = hhtjax.interpolate(path, path.t)
    for ours, saved in ((at_nodes.q, path.q), (at_nodes.v, path.v)):
        assert jax.tree.structure(ours) == jax.tree.structure(q0)
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-14), ours, saved)
    rows = np.array([0, 1, 4, 5, 10])
    picked = path._replace(**{
        name: jax.tree.map(lambda x: x[rows], getattr(path, name)) for name in ("t", "q", "v", "acceleration")
    })  # fmt: skip
    np.testing.assert_allclose(hhtjax.interpolate(picked, path.t[4]).q["b"], path.q["b"][4], rtol=1e-12)
    for times, shape in ((0.33, (1, 2)), (jnp.zeros((3, 4)), (3, 4, 1, 2))):
        assert jax.eval_shape(partial(hhtjax.interpolate, path), times).q["a"].shape == shape


@pytest.mark.slow
def test_dense_output_is_differentiable():
    """In the times, where the derivative of q is close to v, and in a parameter."""
    path = run(DUFFING, hhtjax.hht(), 2000)
    times = jnp.array([0.123, 0.777])
    slopes = jax.jit(jax.jacfwd(lambda t: hhtjax.interpolate(path, t).q[:, 0]))(times)
    np.testing.assert_allclose(np.diag(slopes), hhtjax.interpolate(path, times).v[:, 0], atol=1e-6)

    def late(k):
        problem = DUFFING._replace(params={**DUFFING.params, "k": k})
        return hhtjax.interpolate(run(problem, hhtjax.hht(linearize="predictor"), 200), 0.777).q[0]

    with_forward = jax.jit(lambda k: jax.jvp(late, (k,), (1.0,)))
    central = (with_forward(1.0 + 1e-5)[0] - with_forward(1.0 - 1e-5)[0]) / 2e-5
    for derivative in (jax.jit(jax.grad(late))(1.0), with_forward(1.0)[1]):
        assert float(derivative) == pytest.approx(float(central), rel=1e-7)


def test_dense_output_outside_a_traced_run_is_nan():
    path = run(DUFFING, hhtjax.hht(), 20)
    values = jax.jit(lambda t: hhtjax.interpolate(path, t).q[:, 0])(jnp.array([-0.1, 1.0, 2.1]))
    np.testing.assert_array_equal(np.isnan(values), [True, False, True])


def test_dense_output_far_from_zero():
    """In float32 the times of a run from t0 = 1000 are rounded to 6e-5: a part of dt that must not pile up."""
    since = np.linspace(0.0, 1.0, 1001, dtype=np.float32)[:, None]
    t, q = since[:, 0] + np.float32(1000), np.cos(5 * since)
    path = hhtjax.Solution(
        *map(jnp.asarray, (t, q, -5 * np.sin(5 * since), -25 * q)), None, jnp.asarray(1e-3), *2 * [None]
    )
    times = np.linspace(1000.01, 1000.99, 99, dtype=np.float32)
    np.testing.assert_allclose(hhtjax.interpolate(path, times).q[:, 0], np.cos(5 * (times - 1000)), atol=1e-3)


@pytest.mark.parametrize("program", [lambda f: f, jax.jit, jax.vmap])
def test_dense_output_of_rows_that_were_picked_out(program):
    """At distances that differ by a fifth of their mean, known before the program runs or not; of a batch with equal
    ones, too."""
    t = jnp.stack([jnp.array([0.0, 0.18, 0.42, 0.6, 0.78, 1.02, 1.2]), jnp.linspace(0.0, 1.2, 7)])[..., None]
    times = jnp.linspace(0.0, 1.2, 37)

    def position(t):
        path = hhtjax.Solution(t[:, 0], jnp.cos(t), -jnp.sin(t), -jnp.cos(t), None, jnp.asarray(0.2), *2 * [None])
        return hhtjax.interpolate(path, times).q[:, 0]

    found = program(position)(t) if program is jax.vmap else [program(position)(x) for x in t]
    for q in found:
        np.testing.assert_allclose(q, np.cos(times), atol=2e-5)


@pytest.mark.slow
def test_progress_changes_neither_result_nor_gradient(capfd, monkeypatch):
    monkeypatch.setattr("hhtjax.runs.progress.LEAST", 30)  # steps of one unknown between two drawings

    @partial(jax.jit, static_argnums=1)
    def loss(k, progress):
        problem = DUFFING._replace(params={**DUFFING.params, "k": k})
        stepper = hhtjax.hht(linearize="predictor")
        return jnp.sum(run(problem, stepper, 300, progress=progress).q ** 2)

    @partial(jax.jit, static_argnums=1)
    @partial(jax.vmap, in_axes=(0, None))
    def batch(k, progress):
        return jax.jvp(lambda k: loss(k, progress), (k,), (1.0,))

    same = partial(np.testing.assert_allclose, rtol=1e-13)  # a callback keeps the run from being a kernel: rounding
    alone = loss(1.0, True)
    jax.effects_barrier()
    shown = capfd.readouterr().err
    assert "step 300 of 300" in shown
    assert "compiling ..." in shown
    assert "step 30 of 300" in shown
    assert len(shown.split("\r")) == 12  # once for compiling, and ten times
    assert shown.count("\n") == 1  # one line stays
    loss(2.0, True)
    jax.effects_barrier()
    assert "compiling" not in capfd.readouterr().err  # it is compiled already
    same(jax.grad(loss)(1.0, True), jax.grad(loss)(1.0, False))
    plain = batch(jnp.array([1.0, 2.0]), False)
    same(alone, plain[0][0])
    for x, y in zip(batch(jnp.array([1.0, 2.0]), True), plain, strict=True):
        same(x, y)


@pytest.mark.slow
@pytest.mark.parametrize(("num_steps", "save_every"), [(283, 1), (300, 150), (289, 17)])
def test_progress_is_drawn_between_blocks_of_any_length(num_steps, save_every, capfd, monkeypatch):
    """A prime number of steps, blocks within intervals, and blocks of several intervals."""
    monkeypatch.setattr("hhtjax.runs.progress.LEAST", 40)
    with_bar, plain = (
        run(DUFFING, hhtjax.hht(), num_steps, save_every=save_every, progress=progress) for progress in (True, False)
    )
    jax.effects_barrier()
    shown = capfd.readouterr().err
    assert f"step {num_steps} of {num_steps}" in shown
    assert 3 <= shown.count("step") <= 9
    for x, y in zip(jax.tree.leaves(with_bar), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12)


@pytest.mark.slow
def test_progress_of_error_control(capfd, monkeypatch):
    monkeypatch.setattr("hhtjax.runs.progress.LEAST", 20)
    system, params, q0, v0, _ = DUFFING
    control = {"dt": hhtjax.adaptive(1e-6, 1e-9), "times": jnp.array([0.5, 1.0])}
    with_bar, plain = (
        hhtjax.simulate(system, hhtjax.hht(), q0, v0, params, progress=progress, **control)
        for progress in (True, False)
    )
    jax.effects_barrier()
    shown = capfd.readouterr().err
    assert "compiling ..." in shown
    assert "100 % of the time" in shown
    assert shown.count("%") > 2
    np.testing.assert_allclose(with_bar.q, plain.q, rtol=1e-13)


def pendulum_lagrangian(q, v, t, params):
    """The double pendulum of `scenes.double_pendulum` from its energies."""
    (m1, m2), (l1, l2), g = params["m"], params["l"], params["g"]
    velocity1 = l1 * v[0] * jnp.stack([-jnp.sin(q[0]), jnp.cos(q[0])])
    velocity2 = velocity1 + l2 * v[1] * jnp.stack([-jnp.sin(q[1]), jnp.cos(q[1])])
    height1 = l1 * jnp.sin(q[0])
    kinetic = m1 * jnp.sum(velocity1**2) / 2 + m2 * jnp.sum(velocity2**2) / 2
    springs = params["k"][0] * q[0] ** 2 / 2 + params["k"][1] * (q[1] - q[0]) ** 2 / 2
    return kinetic - m1 * g * height1 - m2 * g * (height1 + l2 * jnp.sin(q[1])) - springs


def dampers(q, v, t, params):
    first, second = double_pendulum.joint_torques(0 * q, v, params)
    return jnp.stack([first - second, second])


@pytest.mark.slow
def test_lagrangian_system_equals_the_one_by_hand():
    problem = PROBLEMS["forced double pendulum"]
    derived = hhtjax.System.from_lagrangian(pendulum_lagrangian, dampers)
    by_hand = hhtjax.System(double_pendulum.mass, double_pendulum.force)
    q, v = jnp.array([0.4, -0.7]), jnp.array([1.2, -0.5])

    @jax.jit
    def both(t):
        systems = derived, by_hand
        return [mass_at(x, q, t, problem.params) for x in systems], [x.force(q, v, t, problem.params) for x in systems]

    for t in (0.0, 2.0):
        masses, forces = both(t)
        np.testing.assert_allclose(*masses, rtol=1e-14)
        np.testing.assert_allclose(*forces, rtol=1e-13)


@pytest.mark.slow
def test_lagrangian_system_on_a_dict_with_explicit_time():
    """A mass on a spring whose end is moved: L = m x'^2/2 - k (x - u(t))^2/2, and a charged term x' t."""

    def lagrangian(q, v, t, params):
        return params["m"] * v["x"] ** 2 / 2 - params["k"] * (q["x"] - jnp.sin(t)) ** 2 / 2 + v["x"] * t**2 * q["x"]

    params = {"m": 2.0, "k": 3.0}
    derived = hhtjax.System.from_lagrangian(lagrangian)
    # d/dt (m x' + t^2 x) - (-k (x - sin t) + x' t^2) = m x'' + 2 t x + k (x - sin t)
    by_hand = hhtjax.System(
        jnp.array([2.0]), lambda q, v, t, p: {"x": -2 * t * q["x"] - p["k"] * (q["x"] - jnp.sin(t))}
    )
    ends = [
        hhtjax.simulate(system, hhtjax.hht(), {"x": 0.1}, {"x": 1.0}, params, dt=0.02, num_steps=50).q["x"]
        for system in (derived, by_hand)
    ]
    np.testing.assert_allclose(*ends, rtol=1e-12)
