"""Problems that people reported, a function each, as their users would write it. What is right stands in cases.py."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax

ONE, NONE = jnp.ones(1), jnp.zeros(1)
TIMES = jnp.linspace(0.0, 2.0, 101)
measured: Any = None
gravity = 9.81


# 0. data that a function reads, and runs that fail


def second_record():
    """A loop over records that the residuals read from a global."""
    global measured

    def residuals(k):
        return jnp.exp(-k * TIMES) - measured

    for k in (1.0, 3.0):
        measured = np.exp(-k * np.asarray(TIMES))
        result = hhtjax.fit(residuals, 2.0)
    return result.params


def second_gravity():
    """A global that the force reads, changed between two runs."""
    global gravity
    system = hhtjax.System(ONE, lambda q, v, t, params: -gravity * ONE)
    for g in (9.81, 1.62):
        gravity = g
        run = hhtjax.simulate(system, hhtjax.hht(), NONE, NONE, dt=0.01, num_steps=100)
    gravity = 9.81
    return run.v[-1, 0]


def array_changed_in_place():
    """A measured array filled with the next record."""
    record = np.exp(-np.asarray(TIMES))

    def residuals(k):
        return jnp.exp(-k * TIMES) - record

    hhtjax.fit(residuals, 2.0)
    record[:] = np.exp(-3 * np.asarray(TIMES))
    return hhtjax.fit(residuals, 2.0).params


def forgotten_check():
    """A cubic repulsion, which reaches infinity, and a user who does not call check()."""
    system = hhtjax.System(ONE, lambda q, v, t, params: q**3)
    run = hhtjax.simulate(system, hhtjax.hht(iterations=None), 5 * ONE, NONE, dt=0.01, num_steps=200)
    return f"q = {run.q[-1, 0]:.6g}"


# 2. Lagrangians


def growing_mass():
    """A mass that grows with time."""
    system = hhtjax.System.from_lagrangian(lambda q, v, t, params: 0.5 * (1 + t) * v[0] ** 2 - 5 * q[0] ** 2)
    return hhtjax.simulate(system, hhtjax.hht(), ONE, NONE, dt=1e-3, num_steps=1000).q[-1, 0]


def hoisted_load():
    """A load on a rope that is shortened: length 2 - t/2."""

    def lagrangian(q, v, t, params):
        length = 2.0 - 0.5 * t
        return 0.5 * (length * v[0]) ** 2 + 9.81 * length * jnp.cos(q[0])

    system = hhtjax.System.from_lagrangian(lagrangian)
    return hhtjax.simulate(system, hhtjax.hht(), 0.3 * ONE, NONE, dt=1e-3, num_steps=2000).q[-1, 0]


def massless_coordinate():
    """A coordinate without mass."""
    system = hhtjax.System.from_lagrangian(lambda q, v, t, params: 0.5 * v[0] ** 2 - q[0] ** 2 - q[1] ** 2)
    hhtjax.simulate(system, hhtjax.hht(), jnp.ones(2), jnp.zeros(2), dt=1e-2, num_steps=10).check()
    return "silent"


# 3. assembly


def links(q, t, params):
    """Three links of 1 m, whose end is held at (1.5, 0.5)."""
    angles = jnp.cumsum(q)
    return jnp.stack([jnp.sum(jnp.cos(angles)) - 1.5, jnp.sum(jnp.sin(angles)) - 0.5])


def nearest_assembly(guesses=300):
    """How many of the guesses within 1.2 rad of a position lead to one that is not the nearest, without a word."""
    system = hhtjax.System(jnp.ones(3), lambda q, v, t, params: -q, constraint=links)
    rng = np.random.default_rng(0)
    base = np.asarray(hhtjax.consistent_initial(system, jnp.array([0.9, -0.8, -0.6]), jnp.zeros(3)).q)
    wrong = 0
    for guess in base + rng.uniform(-1.2, 1.2, (guesses, 3)):
        try:
            found = hhtjax.consistent_initial(system, jnp.asarray(guess), jnp.zeros(3))
        except ValueError:  # none found, and said so
            continue
        moved = np.linalg.norm(np.asarray(found.q) - guess)
        wrong += bool(found.converged) and moved > 1.05 * nearest_distance(guess)
    return wrong


def nearest_distance(guess):
    """The least of six starts of SciPy's SLSQP."""
    from scipy.optimize import minimize

    rng = np.random.default_rng(1)
    phi = jax.jit(lambda q: links(q, 0.0, None))
    B = jax.jit(jax.jacfwd(lambda q: links(q, 0.0, None)))
    best = np.inf
    for start in (guess, *(guess + rng.normal(0, 0.6, (5, 3)))):
        found = minimize(
            lambda q: 0.5 * np.sum((q - guess) ** 2), start, jac=lambda q: q - guess, method="SLSQP",
            constraints={"type": "eq", "fun": lambda q: np.asarray(phi(q)), "jac": lambda q: np.asarray(B(q))},
            options={"ftol": 1e-12, "maxiter": 200},
        )  # fmt: skip
        if found.success and np.max(np.abs(phi(found.x))) < 1e-8:
            best = min(best, np.linalg.norm(found.x - guess))
    return best


# 4. dry friction


def gear_that_rubs_on_both_sides():
    """A gear of ratio 2, both shafts rub: 0.3 N m on the first, 0.5 on the second, driven by 2 N m at the first."""
    system = hhtjax.System(
        jnp.array([1.0, 2.0]),
        lambda q, v, t, params: jnp.array([2.0, 0.0]),
        constraint=lambda q, t, params: q[:1] - 2 * q[1:],
        friction=lambda q, v, L, t, params: jnp.array([0.3, 0.5]),
    )
    run = hhtjax.simulate(system, hhtjax.hht(), jnp.zeros(2), jnp.zeros(2), dt=0.01, num_steps=100)
    return run.q[-1, 0]


def driven_crank_that_rubs():
    """The torque of a drive that turns a crank at 1 rad/s against dry friction of 0.4 N m."""
    system = hhtjax.System(
        ONE,
        lambda q, v, t, params: NONE,
        constraint=lambda q, t, params: q - t,
        friction=lambda q, v, L, t, params: 0.4 * ONE,
    )
    run = hhtjax.simulate(system, hhtjax.hht(), NONE, ONE, dt=0.01, num_steps=10)
    return run.multipliers[-1, 0]


def joint_without_friction():
    """One of two joints has a limit of 0."""
    system = hhtjax.System(
        jnp.ones(2),
        lambda q, v, t, params: jnp.ones(2),
        friction=lambda q, v, t, params: jnp.array([0.3, 0.0]),
    )
    return hhtjax.simulate(system, hhtjax.hht(), jnp.zeros(2), jnp.zeros(2), dt=0.01, num_steps=100).q[-1, 0]


# 5. guards


def pulled_off_its_stop():
    """A body at rest at its stop, and a force that pulls it off."""
    system = hhtjax.System(ONE, lambda q, v, t, params: 2.0 * ONE)
    stop = hhtjax.Event(lambda q, v, t, params: q[0], reset=hhtjax.impact(0.5))
    run = hhtjax.simulate(system, hhtjax.hht(), NONE, NONE, dt=0.01, num_steps=100, events=[stop])
    return run.q[-1, 0]


def rounding_at_its_stop():
    """The same with a velocity that is rounding."""
    system = hhtjax.System(ONE, lambda q, v, t, params: 2.0 * ONE)
    stop = hhtjax.Event(lambda q, v, t, params: q[0], reset=hhtjax.impact(0.5))
    run = hhtjax.simulate(system, hhtjax.hht(), NONE, -1e-17 * ONE, dt=0.01, num_steps=100, events=[stop])
    return run.q[-1, 0]


def constraint_switched_off():
    """A constraint that params switch off."""
    system = hhtjax.System(ONE, lambda q, v, t, params: -ONE, constraint=lambda q, t, params: params["on"] * (q - 1.0))
    hhtjax.simulate(system, hhtjax.hht(), ONE, NONE, {"on": 0.0}, dt=0.01, num_steps=10).check()
    return "silent"


def load_at_a_known_time():
    """A load of 3 N that begins at t = 0.62."""
    system = hhtjax.System(ONE, lambda q, v, t, params: params["load"] * ONE)
    on = hhtjax.Event(at=0.62, switch=lambda params: params | {"load": 3.0})
    run = hhtjax.simulate(system, hhtjax.hht(), NONE, NONE, {"load": 0.0}, dt=0.1, num_steps=10, events=[on])
    return run.q[-1, 0]


# 6. fits and sensors


def outputs_alone():
    """A long run of which the force in a spring is kept, and nothing else: MB."""
    system = hhtjax.System(jnp.ones(20), lambda q, v, t, params: -q)
    run = hhtjax.simulate(
        system, hhtjax.hht(), jnp.ones(20), jnp.zeros(20), dt=0.01, num_steps=10_000, output=lambda q: q[0]
    )
    return sum(x.nbytes for x in jax.tree.leaves(run)) / 1e6


def sum_of_two_parameters():
    """Two parameters of which the record shows the sum alone."""
    y = 3 * TIMES + 0.01 * jnp.sin(99 * TIMES)
    return hhtjax.fit(lambda p: (p["a"] + p["b"]) * TIMES - y, {"a": 1.0, "b": 2.5}).summary().replace("\n", " ")


def rank_promotion():
    """`run.q - y`, (101, 1) and (101,): 101 x 101 residuals."""
    system = hhtjax.System(ONE, lambda q, v, t, params: -params * q)
    y = jnp.cos(jnp.sqrt(40.0) * TIMES)

    def residuals(k):
        return hhtjax.simulate(system, hhtjax.hht(), ONE, NONE, k, dt=0.02, num_steps=100).q - y

    return f"k = {float(hhtjax.fit(residuals, 30.0).params):.6g}"


def transforms_of_some():
    """Transforms for one of two parameters."""
    y = 2 * jnp.exp(-3 * TIMES)
    result = hhtjax.fit(
        lambda p: p["a"] * jnp.exp(-p["c"] * TIMES) - y, {"a": 1.0, "c": 1.0}, transforms={"c": hhtjax.positive}
    )
    return result.params["c"]


def nan_residuals():
    """A record with a sample that is missing."""
    y = (2 * jnp.exp(-3 * TIMES)).at[17].set(jnp.nan)
    return f"{hhtjax.fit(lambda p: {'mast': p * jnp.exp(-3 * TIMES) - y}, 1.0).params}"


def rosenbrock_valley():
    """Iterations of `fit` in Rosenbrock's valley, from (-12, 10)."""
    result = hhtjax.fit(lambda p: jnp.stack([10 * (p[1] - p[0] ** 2), 1 - p[0]]), jnp.array([-12.0, 10.0]))
    return float(result.iterations) if float(jnp.max(jnp.abs(result.params - 1))) < 1e-4 else float("nan")


# 7. the compiler, and 8. second derivatives


def drag_by_the_largest():
    """Drag by the largest velocity, on a circle."""

    def force(q, v, t, params):
        return -3.0 * v * jnp.max(jnp.abs(v)) + jnp.array([0.0, -5.0])

    system = hhtjax.System(jnp.ones(2), force, constraint=lambda q, t, params: (q @ q - 1.0)[None])
    start = jnp.array([0.6, 0.8]), jnp.array([-0.4, 0.3])
    return hhtjax.simulate(system, hhtjax.hht(), *start, dt=1e-2, num_steps=20).q[-1, 0]


def conversion_out_of_range():
    """A constant converted to an integer that cannot hold it."""

    def force(q, v, t, params):
        return 1e-9 * jnp.asarray([3e9, 1.0, 2.0]).astype(jnp.int32).astype(q.dtype) + 0 * q

    system, stepper = hhtjax.System(np.ones(3), force), hhtjax.hht(linearize="predictor")
    run = hhtjax.simulate(system, stepper, jnp.zeros(3), jnp.zeros(3), dt=1e-2, num_steps=1)
    return run.acceleration[-1, 0]


def hessian_with_newton():
    """The Hessian of a run with the converged method, beside differences of its gradient."""
    system = hhtjax.System(ONE, lambda q, v, t, params: -params * jnp.sin(q))

    def end(k):
        run = hhtjax.simulate(system, hhtjax.hht(iterations=None), ONE, NONE, k, dt=0.05, num_steps=40)
        return run.q[-1, 0]

    h = 1e-4
    slope = jax.grad(end)
    return abs(float(jax.hessian(end)(4.0) - (slope(4.0 + h) - slope(4.0 - h)) / (2 * h)))


# 9. the rest


def diagonal_system():
    """CPU time of a step of a diagonal system of 1000 over that of rk4, whose step does nothing but evaluate it."""
    import time

    n = 1000
    k = np.linspace(1.0, 100.0, n)
    system = hhtjax.LinearSystem(np.ones(n), 0.01 * k, k)
    seconds = []
    for stepper in (hhtjax.hht(), hhtjax.rk4()):
        times = []
        for i in range(4):
            start = time.process_time()
            hhtjax.simulate(
                system, stepper, jnp.ones(n), jnp.zeros(n), dt=0.01 * (1 + 1e-6 * i), num_steps=200, save_every=200
            ).q.block_until_ready()
            times.append(time.process_time() - start)
        seconds.append(min(times[1:]))
    return seconds[0] / seconds[1]


def progress_of_a_small_run():
    """Time of a run with a bar over that without."""
    import contextlib
    import io
    import time

    system = hhtjax.System(ONE, lambda q, v, t, params: -params * jnp.sin(q))
    seconds = []
    for progress in (True, False):
        times = []
        for i in range(6):
            start = time.perf_counter()
            with contextlib.redirect_stderr(io.StringIO()):
                hhtjax.simulate(
                    system, hhtjax.hht(), ONE, NONE, 4.0 + 1e-6 * i, dt=0.01, num_steps=1000, progress=progress
                ).q.block_until_ready()
                jax.effects_barrier()
            times.append(time.perf_counter() - start)
        seconds.append(min(times[1:]))
    return seconds[0] / seconds[1]


def jump_within_a_step():
    """A held input that jumps within a step."""
    system = hhtjax.System(ONE, lambda q, v, t, params: params(t)[None])
    u = hhtjax.sampled(jnp.arange(4.0), dt=0.1, order=0)
    hhtjax.simulate(system, hhtjax.hht(), NONE, NONE, u, dt=0.04, num_steps=5).check()
    return "silent"


def list_for_q0():
    """A list in the place of an array."""
    system = hhtjax.System(ONE, lambda q, v, t, params: -4.0 * q)
    try:
        hhtjax.simulate(system, hhtjax.hht(), [1.0], [0.0], dt=0.1, num_steps=2)
    except Exception as error:
        return " ".join([str(error), *error.__notes__])


def missing_axes():
    """A parameter for each member of a sweep, and no in_axes."""
    system = hhtjax.System(ONE, lambda q, v, t, params: -params["k"] * q)
    params = {"k": jnp.array([1.0, 2.0, 3.0])}
    hhtjax.sweep(system, hhtjax.hht(), ONE, NONE, params, dts=[0.1] * 3, duration=1.0, num_samples=5)
    return "silent"


def boolean_product():
    """A product of Booleans in a force."""

    def force(q, v, t, params):
        return -1.0 * (jnp.ones((3, 3), bool) @ (q > 0)) * q

    run = hhtjax.simulate(
        hhtjax.System(jnp.ones(3), force), hhtjax.hht(), jnp.ones(3), jnp.zeros(3), dt=1e-2, num_steps=1
    )
    return run.acceleration[0, 0]
