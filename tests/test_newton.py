"""Newton's iteration: converged means that each row of the residual is small beside the terms of that row."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax

KINDS = {
    "hht": lambda: hhtjax.hht(iterations=None),
    "conventional_hht": hhtjax.conventional_hht,
    "wilson": hhtjax.wilson,
    "houbolt": hhtjax.houbolt,
}


def far_and_near(q, v, t, params):
    """A body 1e9 m away on a soft spring, and one that vibrates by 1e-7 m on a stiff, nonlinear one."""
    return jnp.stack([-1e-3 * q[0], -1e4 * jnp.sinh(q[1] / 1e-7)])


def tiny(q, v, t, params):
    """A resonator of micrometres: forces of 1e-12 N, far below the tolerance."""
    return -1e-6 * q - 1e6 * q**3


def drifting(q, v, t, params):
    """A soft spring whose end is far away, and a damper."""
    return -1e-3 * jnp.sin(q - 1e9) - v**3


CASES = {  # mass, force, q0, v0, dt, largest residual relative to M w
    "far and near": (np.ones(2), far_and_near, [1e9, 3e-7], [0.0, 0.0], 1e-6, 1e-12),
    "tiny": (1e-12 * np.ones(1), tiny, [1e-6], [0.0], 1e-4, 2e-6),
    "drifting": (np.ones(1), drifting, [1e9 + 0.5], [1.0], 1e-2, 1e-10),
}


@pytest.mark.parametrize("name", CASES)
def test_each_row_is_solved_in_its_own_units(name):
    mass, force, q0, v0, dt, bound = CASES[name]
    run = hhtjax.simulate(hhtjax.System(mass, force), KINDS["hht"](), jnp.array(q0), jnp.array(v0), dt=dt, num_steps=20)
    run.check()
    Q = jax.vmap(lambda q, v, t: force(q, v, t, None))(run.q, run.v, run.t)[1:]
    Mw = mass * np.asarray(run.acceleration)[1:]
    np.testing.assert_array_less(np.abs(Mw - Q), bound * np.abs(Mw) + 1e-300)
    assert run.info.iterations.max() < 7


@pytest.mark.slow
@pytest.mark.parametrize("name", list(KINDS)[1:])
def test_so_do_all_that_iterate(name):
    mass, force, q0, v0, dt, _ = CASES["far and near"]
    run = hhtjax.simulate(hhtjax.System(mass, force), KINDS[name](), jnp.array(q0), jnp.array(v0), dt=dt, num_steps=5)
    run.check()
    near = hhtjax.System(np.ones(1), lambda q, v, t, params: -1e4 * jnp.sinh(q / 1e-7))
    alone = hhtjax.simulate(near, KINDS[name](), jnp.array(q0[1:]), jnp.array(v0[1:]), dt=dt, num_steps=5)
    np.testing.assert_allclose(run.q[:, 1:], alone.q, rtol=1e-9, atol=0)


@pytest.mark.slow
def test_noise_of_terms_that_cancel_is_no_failure():
    """Loads of 1e9 N that nearly cancel, far beyond what an absolute tolerance can see, and a row of zeros."""

    def force(q, v, t, params):
        return jnp.stack([1e9 * (jnp.cos(q[0]) - jnp.cos(q[1])) - q[0], 1e9 * jnp.sin(q[0] - q[1]), 0.0 * q[2]])

    start = jnp.array([1.0, 1.0 + 1e-6, 0.0]), jnp.array([0.3, 0.3, 0.0])
    run = hhtjax.simulate(hhtjax.System(np.ones(3), force), KINDS["hht"](), *start, dt=1e-3, num_steps=100)
    run.check()
    assert run.info.residual.max() > 1e-10
    assert run.info.iterations.mean() < 4


@pytest.mark.slow
def test_a_batch_takes_the_steps_of_its_members():
    mass, force, q0, v0, dt, _ = CASES["far and near"]
    system = hhtjax.System(mass, force)

    def end(scale):
        return hhtjax.simulate(system, KINDS["hht"](), jnp.array(q0) * scale, jnp.array(v0), dt=dt, num_steps=5)

    scales = jnp.array([1.0, 0.5, 1e-3])
    batch = jax.vmap(end)(scales)
    batch.check()
    for i, scale in enumerate(scales):
        np.testing.assert_allclose(batch.q[i], end(scale).q, rtol=1e-9)
