"""Dry friction in exported C: its flag, an input that pushes, derivatives through switches."""

import jax.numpy as jnp
import numpy as np
import pytest
from compiled_c import Library, needs_compiler, numbers
from friction_problems import CASES as RUBBING
from helpers import forward
from zoo import EVERY

import hhtjax
from hhtjax import export_c, hht
from hhtjax.export.model import FLAGS

pytestmark = needs_compiler


@pytest.mark.slow
def test_dry_friction_with_an_input_and_its_flag(tmp_path):
    """Two coupled joints that an input pushes, from sample to sample; a negative limit."""
    case = RUBBING["M(q), two joints"]

    def force(q, v, t, params):
        return case.system.force(q, v, t, params) + params["push"](t)

    samples = 12 * np.random.default_rng(0).standard_normal((60, 2))
    params = {"F": 8.0, "push": hhtjax.sampled(samples, dt=0.02, order=0)}
    arguments = hht(-0.1), case.q0, case.v0, params
    system = hhtjax.System(case.system.mass, force, friction=case.system.friction)
    library = Library(export_c(system, *arguments, name="rubbing"), tmp_path)
    state, flags = library.begin(case.q0, case.v0, samples[0], dt=0.02)
    assert flags == 0
    sticking, flags = [], []
    for u in samples[:-1]:
        flags.append(library.step(state, u, dt=0.02))
        sticking.append(numbers(state, "friction_sig") == 0)
    with hhtjax.plain():
        run = hhtjax.simulate(system, *arguments, dt=0.02, num_steps=59)
    assert np.array_equal(sticking, run.sticking[1:])
    assert np.sum(run.sticking[1:] != run.sticking[:-1]) > 10
    assert numbers(state, "q") == pytest.approx(np.asarray(run.q[-1]), rel=1e-12)
    assert numbers(state, "friction_tau") == pytest.approx(np.asarray(run.friction[-1]), rel=1e-12)

    rubbing = 1 << list(FLAGS).index("FRICTION")
    assert f"RUBBING_FRICTION = {rubbing} " in library.model.header
    assert not any(flags)  # also where both joints reverse in one step
    run.check()
    wrong = type(library.defaults).from_buffer_copy(library.defaults)
    wrong.F = -1.0
    state, _ = library.begin(case.q0, case.v0, samples[0], dt=0.02)
    assert library.step(state, samples[0], dt=0.02, params=wrong) == rubbing


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameter"),
    [
        ("two masses on a belt", "u"),
        pytest.param("a constraint, H(q), a load", "F", marks=EVERY),  # other equations, the same branches
    ],
)
def test_sensitivities_go_through_switches(name, parameter, tmp_path):
    case, steps = RUBBING[name], 1000
    dt, stepper = case.duration / steps, hht(-0.1)
    model = export_c(case.system, stepper, case.q0, case.v0, case.params, sensitivities=(parameter,))
    library = Library(model, tmp_path)
    state, _ = library.begin(case.q0, case.v0, dt=dt)
    assert library.run(state, steps, dt) == 0

    def end(x):
        params = case.params | {parameter: x}
        run = hhtjax.simulate(case.system, stepper, case.q0, case.v0, params, dt=dt, num_steps=steps, save_every=steps)
        return run.v[-1], run.friction[-1]

    expected = forward(end, jnp.asarray(case.params[parameter]))
    for field, values in zip(("v", "friction_tau"), expected, strict=True):
        ours = numbers(state, f"d{field}_d{parameter}")
        assert np.max(abs(values)) > 1e-2
        assert np.max(abs(ours - values)) < 1e-9 * np.max(abs(values)), field
