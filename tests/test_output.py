"""What runs save in place of their path, `output=`: the function of the same run with its path."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient, check_message

import hhtjax
from hhtjax.scenes import dry_oscillator, top

TIMES = np.array([0.013, 0.0133, 0.05, 0.07777, 0.16])
SPRING = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -params["k"] * q)
START = jnp.ones(1), jnp.zeros(1), {"k": 4.0}


def everything(q, v, w, L, z, zdot, friction, sticking, t):
    return {"motion": (q, v, w), "rest": (L, z, zdot, friction), "sticking": sticking, "t": t}


def everything_of(run):
    rest = run.multipliers, run.z, run.zdot, run.friction
    return {"motion": (run.q, run.v, run.acceleration), "rest": rest, "sticking": run.sticking, "t": run.t}


def body():
    """A top held by constraints, with a rotation."""
    scene = top.constrained(spin=20.0)
    return scene.system, hhtjax.hht(-0.05, linearize="predictor"), scene.q0, scene.v0, scene.params


def rubbing():
    scene = dry_oscillator.free()
    return scene.system, hhtjax.hht(), scene.q0, scene.v0, scene.params


def motor():
    system = hhtjax.System(
        jnp.full(1, 0.1), lambda q, v, z, t, p: p * z - 0.1 * v, internal=lambda q, v, z, t, p: 5.0 - 9 * z - p * v
    )
    return system, hhtjax.rk4(), jnp.zeros(1), jnp.zeros(1), 0.5


def decay():
    return hhtjax.FirstOrderSystem(lambda y, t, p: -p * y), hhtjax.rk4(), jnp.ones(2), None, 3.0


KINDS = {"rotation, constraint": body, "friction": rubbing, "internal": motor, "first order": decay}
WAYS = {
    "equal": {"dt": 0.01, "num_steps": 16, "save_every": 4},
    "uneven": {"dt": np.array([0.01, 0.02, 0.005, 0.01])},
    "extrapolated": {"dt": 0.02, "num_steps": 4, "extrapolate": 2},
    "times": {"dt": 0.01, "times": TIMES},
    "adaptive": {"dt": hhtjax.adaptive(1e-4, 1e-6), "times": TIMES},
}
CASES = [(kind, "times") for kind in KINDS] + [("rotation, constraint", way) for way in WAYS if way != "times"]
CASES += [("friction", "adaptive"), ("friction", "equal"), ("internal", "uneven")]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "way"), CASES)
def test_an_output_is_that_of_the_path(kind, way):
    system, stepper, q0, v0, params = KINDS[kind]()
    rtol = 1e-4 if way == "extrapolated" else 1e-11  # extrapolated entries of a rotation are close to one
    start = {"params": params} | ({"z0": jnp.zeros(1)} if kind == "internal" else {})
    path = hhtjax.simulate(system, stepper, q0, v0, **start, **WAYS[way])
    run = hhtjax.simulate(system, stepper, q0, v0, **start, **WAYS[way], output=everything)
    run.check()
    assert run.q is run.v is run.acceleration is run.multipliers is run.z is run.friction is None
    expected = everything_of(path)
    assert jax.tree.structure(run.output) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(run.output), jax.tree.leaves(expected), strict=True):
        assert x.dtype == y.dtype
        assert np.all(np.isfinite(x))
        np.testing.assert_allclose(x, y, rtol=rtol, atol=rtol * np.max(np.abs(y)))


def sizes_in(jaxpr):
    """How many numbers each array in a program holds."""
    for eqn in jaxpr.eqns:
        yield from (x.aval.size for x in eqn.outvars)
        for inner in jax.tree.leaves(list(eqn.params.values()), is_leaf=lambda x: hasattr(x, "eqns")):
            if hasattr(inner, "eqns"):
                yield from sizes_in(inner.jaxpr if hasattr(inner, "jaxpr") else inner)


@pytest.mark.parametrize("way", [{"num_steps": 5000}, {"times": 0.05 * np.arange(1, 5001)}], ids=["steps", "times"])
def test_a_long_run_holds_its_output_and_no_path(way):
    """Of 5000 samples of 40 coordinates no array in the program holds more than those of a number."""
    n = 40
    chain = hhtjax.System(jnp.ones(n), lambda q, v, t, params: -q)

    def run(q0, output):
        return hhtjax.simulate(chain, hhtjax.rk4(), q0, jnp.zeros(n), dt=0.05, output=output, **way)

    def largest(output):
        return max(sizes_in(jax.make_jaxpr(lambda q0: run(q0, output))(jnp.ones(n)).jaxpr))

    assert largest(None) >= 5000 * n
    assert largest(lambda q, v: q[0] + v[-1]) <= 3 * 5001
    kept = jax.eval_shape(lambda q0: run(q0, lambda q, v: q[0] + v[-1]), jnp.ones(n))
    assert sum(x.size for x in jax.tree.leaves(kept) if x.size >= 5000) == 2 * 5001  # t and the output


@pytest.mark.slow
def test_derivatives_of_outputs():
    def loss(x):
        k, dt, q0 = x
        run = hhtjax.simulate(
            SPRING, hhtjax.hht(), q0, jnp.zeros(1), {"k": k}, dt=dt, num_steps=40, save_every=4,
            output=lambda q, w, params: (w[0] + params["k"] * jnp.sin(q[0])) ** 2)  # fmt: skip
        return jnp.sum(run.output * jnp.arange(11.0))

    def loss_between(x):
        k, dt, late = x
        run = hhtjax.simulate(
            SPRING, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), {"k": k}, dt=dt, times=TIMES + late,
            output=lambda q, w, v: v[0] * w[0] + q[0])  # fmt: skip
        return jnp.sum(run.output * jnp.arange(6.0))

    check_gradient(loss, (4.0, 0.03, np.ones(1)))
    check_gradient(loss_between, (4.0, 0.0301, 0.001))


FALL = hhtjax.System(jnp.ones(1), lambda q, v, t, p: p["force"] + 0 * q)
SWITCH = hhtjax.Event(guard=lambda q, v, t, p: (0.5 - q[0]) * (2 * p["force"] - 1), switch=lambda p: p | {"force": 0.0})


@pytest.mark.slow
@pytest.mark.parametrize("way", ["equal", "times", "adaptive"])
def test_params_are_those_of_the_moment(way):
    """A force that an event at t = 1 switches off: q = t^2/2 until then; samples lie beside it."""
    times = np.array([0.5, 0.97, 0.999, 1.001, 1.05, 2.0])
    grid = {
        "equal": {"dt": 0.1, "num_steps": 20},
        "times": {"dt": 0.3, "times": times},
        "adaptive": {"dt": hhtjax.adaptive(1e-3, 1e-4, dt_max=0.5), "times": times},
    }[way]
    run = hhtjax.simulate(
        FALL, hhtjax.rosenbrock(), jnp.zeros(1), jnp.zeros(1), {"force": 1.0}, events=[SWITCH], **grid,
        output=lambda q, v, w, t, params: {"force": params["force"], "w": w, "q": q, "v": v})  # fmt: skip
    run.check()
    assert run.events.t[0] == pytest.approx(1.0, abs=1e-9)
    t, found = np.asarray(run.t), run.output
    clear = ~np.isclose(t, 1.0)
    np.testing.assert_allclose(found["force"][clear], (t < 1)[clear])
    np.testing.assert_allclose(found["w"][clear, 0], (t < 1)[clear], atol=1e-9)
    np.testing.assert_allclose(found["q"][:, 0], np.where(t < 1, t**2 / 2, t - 0.5), atol=1e-9)


@pytest.mark.slow
def test_held_inputs_are_those_of_the_step_that_ends():
    """w = u in all samples, though some of them are where u jumps."""
    u = hhtjax.sampled(np.array([1.0, -2.0, 3.0, 0.5]), 0.1, order=0)
    system = hhtjax.System(jnp.ones(1), lambda q, v, t, p: p(t)[None] + 0 * q)

    def felt(w, t, params):
        return w[0] - params(t)

    for stepper in (hhtjax.rk4(), hhtjax.hht()):
        run = hhtjax.simulate(
            system, stepper, jnp.zeros(1), jnp.zeros(1), u, dt=0.05, num_steps=8, output=felt)  # fmt: skip
        np.testing.assert_allclose(run.output, 0, atol=1e-12)
        run = hhtjax.simulate(
            system, stepper, jnp.zeros(1), jnp.zeros(1), u, dt=0.05, times=[0.1, 0.12, 0.2, 0.33, 0.4], output=felt
        )
        np.testing.assert_allclose(run.output, 0, atol=1e-12)
    runs = hhtjax.sweep(
        system, hhtjax.rk4(), jnp.zeros(1), jnp.zeros(1), u, dts=np.array([0.1, 0.05]), times=[0.1, 0.2, 0.3, 0.4],
        output=felt)  # fmt: skip
    np.testing.assert_allclose(runs.output, 0, atol=1e-12)


@pytest.mark.slow
def test_sweeps_save_outputs(tmp_path):
    """On equal samples, at times, under error control, and on disk; a member that fails is named."""

    def energy(q, v, params):
        return {"energy": v[0] ** 2 / 2 + params["k"] * q[0] ** 2 / 2}

    k = np.array([1.0, 4.0, 9.0])
    ways = (
        {"dts": np.array([0.1, 0.02, 0.05]), "duration": 1.0, "num_samples": 5},
        {"dts": np.array([0.1, 0.02, 0.05]), "times": [0.3, 0.34, 1.0]},
        {"dts": hhtjax.adaptive(np.array([1e-3, 1e-4, 1e-3]), 1e-6, verify=True), "times": [0.3, 0.34, 1.0]},
    )
    start = SPRING, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), {"k": k}
    for way in ways:
        way = way | {"in_axes": (None, None, None, 0)}
        path, runs = hhtjax.sweep(*start, **way), hhtjax.sweep(*start, **way, output=energy)
        runs.check()
        assert runs.q is None
        expected = path.v[..., 0] ** 2 / 2 + k[:, None] * path.q[..., 0] ** 2 / 2
        np.testing.assert_allclose(runs.output["energy"], expected, rtol=1e-12)
        assert (runs.error is None) == (path.error is None)
    where = hhtjax.sweep_to_disk(tmp_path, *start, **ways[0], in_axes=(None, None, None, 0), output=energy, chunk=2)
    found = hhtjax.load_sweep(where)
    assert "q" not in found
    assert found["output.energy"].shape == (3, 6)
    bad = hhtjax.sweep(*start[:4], {"k": np.array([1.0, np.nan, 9.0])}, **ways[0], in_axes=(None, None, None, 0),
                       output=energy)  # fmt: skip
    check_message(hhtjax.SimulationError, "member 1 (1 of 3 failed), step 1 (to t = 0.02) failed", bad.check)


@pytest.fixture(scope="module")
def short():
    def output(q, t, v):
        return {"q": q, "even": q[0] > 0.9}

    return hhtjax.simulate(SPRING, hhtjax.rk4(), *START, dt=0.1, num_steps=4, output=output)


def test_lines_join_outputs(short):
    found = hhtjax.interpolate(short, jnp.array([0.125, 0.3]))
    assert found.q is None
    q = short.output["q"]
    np.testing.assert_allclose(found.output["q"], [0.75 * q[1] + 0.25 * q[2], q[3]], rtol=1e-12)
    assert found.output["even"].tolist() == [True, False]
    np.testing.assert_allclose(hhtjax.measure(short, 0.125, delay=0.1, gain=2.0)["q"],
                               2 * (0.75 * q[0] + 0.25 * q[1]), rtol=1e-12)  # fmt: skip


def test_a_run_without_its_path_is_refused_by_name(short):
    with pytest.raises(ValueError, match="check: leave `reach` out: the run saved `output` only, and no q"):
        short.check(reach=1.0)
    with pytest.raises(ValueError, match="energy_balance: `solution` must have q and v; received a run with output="):
        hhtjax.analysis.energy_balance(SPRING, short, START[2])
    with pytest.raises(ValueError, match="measure: `output` must be left out: the run was made with output="):
        hhtjax.measure(short, 0.1, output=lambda q: q)
    with pytest.raises(
        NotImplementedError, match="interpolate: the output of a run with events is unknown at its events"
    ):
        hhtjax.interpolate(short._replace(events=short.t), 0.1)
    assert "output.q" in str(short)


WRONG = {
    "names": (lambda y: y, TypeError, "of some of q, v, w, L, z, zdot, friction, sticking, contact, t and p"),
    "order": (lambda q, /: q, TypeError, "received one of (q)"),
    "no function": (3, TypeError, "simulate: `output` must be a function output(...); received 3"),
    "nothing": (lambda q: None, TypeError, "`output` must return a pytree of arrays, one or more; received nothing"),
    "text": (lambda q: {"q": "q"}, TypeError, "`output` must return a pytree of arrays"),
    "dtype": (lambda q: q.astype("float32"), TypeError, "simulate: `output` returned float32 for a state of float64"),
}


@pytest.mark.parametrize("name", WRONG)
def test_bad_outputs_are_named(name):
    function, error, message = WRONG[name]

    def call():
        hhtjax.simulate(SPRING, hhtjax.rk4(), *START, dt=0.1, num_steps=4, output=function)

    check_message(error, message, call)


def test_what_a_system_does_not_have_is_told():
    with pytest.raises(TypeError) as told:
        hhtjax.simulate(SPRING, hhtjax.rk4(), *START, dt=0.1, num_steps=4, output=lambda q, L: q + L)
    assert any("L is None, because the system has none" in note for note in told.value.__notes__)
