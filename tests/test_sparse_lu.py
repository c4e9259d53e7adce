"""Sparse solves of systems that are one function: the pattern from the program or given, and what they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from element_scenes import by_lapack, distance, motion

import hhtjax
from hhtjax import System

N = 24


def springs(q, v, t, params):
    """A chain of hardening springs and dampers, held at one end."""
    drift = jnp.diff(q, prepend=0.0)
    tension = params["k"] * drift + 100.0 * drift**3 + 0.1 * jnp.diff(v, prepend=0.0)
    return jnp.diff(tension, append=0.0)


def coupled(q, params):
    """A mass that changes, and is not diagonal."""
    return jnp.diag(2.0 + q**2) + 0.5 * jnp.eye(N, k=1) + 0.5 * jnp.eye(N, k=-1)


def far(q, v, t, params):
    """A ring of springs, one across it: unknowns in no row."""
    pull = params["k"] * (jnp.roll(q, 1) + jnp.roll(q, -1) - 2 * q) - q**3
    return pull.at[0].add(q[N // 2] - q[0]).at[N // 2].add(q[0] - q[N // 2])


def leaky(q, v, z, t, params):
    return springs(q, v, t, params) - z


def following(q, v, z, t, params):
    return 10.0 * (jnp.diff(v, prepend=0.0) - z)


def rods(q, t, params):
    """Pendulums, each on the next."""
    return jnp.sum(jnp.diff(q, prepend=0.0, axis=0) ** 2, axis=1) - 1.0


def hanging(q, v, t, params):
    return jnp.zeros_like(v).at[:, 1].set(-params["k"])


HANGING = System(jnp.ones(20), hanging, rods), jnp.stack([jnp.arange(1.0, 11.0), jnp.zeros(10)], axis=1)
LINE = jnp.linspace(0.0, 1.0, N) ** 2
SCENES = {
    "springs": (System(jnp.ones(N), springs), LINE),
    "mass": (System(coupled, springs), LINE),
    "ring": (System(jnp.ones(N), far), LINE),
    "pendulums": HANGING,
}


def run(scene, solve, params=None, num_steps=5, **more):
    system, q0 = scene
    stepper = hhtjax.hht(linearize="predictor", start="simple", solve=solve)
    v0 = jax.tree.map(jnp.zeros_like, q0)
    params = {"k": 30.0, "g": 9.81} | (params or {})
    return hhtjax.simulate(system, stepper, q0, v0, params, dt=0.02, num_steps=num_steps, **more)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_steps_are_those_of_the_dense_solve(name):
    sparse, dense = (run(SCENES[name], solve) for solve in (hhtjax.sparse_lu(), by_lapack))
    sparse.check()
    size = max(1.0, float(jnp.max(jnp.abs(jax.tree.leaves(dense.acceleration)[0]))))
    assert distance(motion(sparse)[:2], motion(dense)[:2]) < 1e-13
    assert distance(motion(sparse)[2:], motion(dense)[2:]) < 1e-12 * size
    assert np.max(sparse.info.solve_residual) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("mass", ["diagonal", "full"])
def test_internal_states(mass):
    M = jnp.ones(N) if mass == "diagonal" else coupled(jnp.zeros(N), None)
    scene = System(M, leaky, internal=following), LINE
    sparse, dense = (run(scene, solve, z0=jnp.zeros(N)) for solve in (hhtjax.sparse_lu(), by_lapack))
    assert distance((motion(sparse), sparse.z), (motion(dense), dense.z)) < 1e-11


@pytest.mark.slow
def test_a_given_pattern_is_what_is_read():
    """Of M w - Q; an array, or a matrix of SciPy."""
    from scipy.sparse import diags_array

    band = np.abs(np.subtract.outer(np.arange(N), np.arange(N))) <= 1
    read = run(SCENES["springs"], hhtjax.sparse_lu())
    for pattern in (band, diags_array([np.ones(N - 1), np.ones(N), np.ones(N - 1)], offsets=[-1, 0, 1])):
        assert distance(motion(run(SCENES["springs"], hhtjax.sparse_lu(pattern))), motion(read)) < 1e-12


@pytest.mark.slow
def test_a_pattern_that_leaves_something_out_fails_by_name():
    found = run(SCENES["springs"], hhtjax.sparse_lu(np.eye(N)), num_steps=1)
    with pytest.raises(hhtjax.SimulationError, match=r"residual of .* a complete pattern of sparse_lu\(\)"):
        found.check()
    run(SCENES["springs"], hhtjax.sparse_lu(np.eye(N), tolerance=10.0), num_steps=1).check()


@pytest.mark.slow
def test_derivatives_of_a_constrained_run():
    """Reverse, forward, and central differences, beside the dense solve."""

    def end(k, solve):
        return jnp.sum(run(HANGING, solve, {"k": k}).q[-1] ** 2)

    def slopes(k, solve):
        f = lambda k: end(k, solve)  # noqa: E731
        return jnp.stack([jax.grad(f)(k), jax.jvp(f, (k,), (1.0,))[1]])

    solves = hhtjax.sparse_lu(), by_lapack
    sparse, dense = (jax.jit(lambda k, solve=solve: slopes(k, solve))(10.0) for solve in solves)
    np.testing.assert_allclose(sparse, dense, rtol=1e-9)
    f = jax.jit(lambda k: end(k, hhtjax.sparse_lu()))
    np.testing.assert_allclose(sparse, (f(10.001) - f(9.999)) / 0.002, rtol=1e-6)


def test_what_is_wrong_is_named():
    with pytest.raises(ValueError, match=r"`pattern` must be \"auto\", or a matrix \(n, n\); received 'all'"):
        hhtjax.sparse_lu("all")
    with pytest.raises(ValueError, match=r"sparse_lu: `pattern` must have shape \(n, n\); received shape \(3, 4\)"):
        hhtjax.sparse_lu(np.ones((3, 4)))
    with pytest.raises(ValueError, match=r"sparse_lu: `tolerance` must be positive; received -1"):
        hhtjax.sparse_lu(tolerance=-1.0)
    with pytest.raises(ValueError, match=rf"sparse_lu: `pattern` must have shape \({N}, {N}\), for the numbers in v"):
        run(SCENES["springs"], hhtjax.sparse_lu(np.eye(3)))


@pytest.mark.parametrize("kind", ["friction", "linear", "redundant"])
def test_what_it_does_not_solve_is_refused(kind):
    rubbing = System(jnp.ones(4), lambda q, v, t, p: -q, friction=lambda q, v, t, p: 1.0 + 0 * q)
    linear = hhtjax.LinearSystem(jnp.ones(4), None, jnp.eye(4))
    if kind == "redundant":
        with pytest.raises(ValueError, match="`redundant` brings its own solver"):
            hhtjax.hht(redundant="least_squares", solve=hhtjax.sparse_lu())
        return
    with pytest.raises(NotImplementedError, match="hht: leave out `solve` with dry friction, contact, a LinearSystem"):
        run(({"friction": rubbing, "linear": linear}[kind], jnp.ones(4)), hhtjax.sparse_lu())
