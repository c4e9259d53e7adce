"""What contacts cost: the rod on the floor, both ends closed, beside the same system without; all of them in turn.

The rod slides for longer than the run, a little pushed and turned: nothing switches. Times are the least of many, since
others use the machine.
"""

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.contact.scenes import SCENES, STEPPER, run_of

STEPS, DERIVATIVE_STEPS, MEMBERS, MEMBER_STEPS, PAIRS = 4000, 1000, 64, 500, 40
DT = 1e-5


def last_of(contact, steps):
    """The rod's last q, of mu and its speed."""
    scene = SCENES["rod"]

    def force(q, v, t, params):
        return scene.force(q, v, t, params) + jnp.stack([0.3 * jnp.sin(5 * t), 0 * t, 0.02 * jnp.sin(3 * t)])

    system = hhtjax.System(scene.mass, force, contact=scene.system.contact if contact else None)

    def last(mu, v0):
        start = jnp.zeros(3), jnp.stack([v0, 0 * v0, 0 * v0])
        return hhtjax.simulate(system, STEPPER, *start, {"mu": mu}, dt=DT, num_steps=steps, save_every=steps).q[-1]

    return last


def forward(last):
    """The value and its derivative in the speed; the value too, since without contact that derivative is constant."""

    def twice(mu, v0):
        q = last(mu, v0)
        return q, q

    return jax.jacfwd(twice, 1, has_aux=True)


def reverse(last):
    """A sum and its gradient in the same."""
    return jax.value_and_grad(lambda mu, v0: jnp.sum(last(mu, v0)), 1)


def seconds(function):
    """Of a call."""
    begun = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - begun


def least(functions, pairs):
    """The least time of each, all of them in turn."""
    for function in functions:
        function()
    return np.min([[seconds(function) for function in functions] for _ in range(pairs)], axis=0)


def compiled(function, *arguments):
    """It, and the seconds of this process to trace and to compile it."""
    begun = time.process_time(), time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    return program, (time.process_time() - begun[0], time.perf_counter() - begun[1])


def programs(contact):
    """{what: program} and {what: (CPU s, s)} to compile."""
    x, y = jnp.asarray(0.1), jnp.asarray(2.0)
    several = jnp.linspace(0.1, 0.2, MEMBERS), jnp.linspace(1.0, 2.0, MEMBERS)
    plan = {
        "step": (last_of(contact, STEPS), (x, y)),
        "forward": (forward(last_of(contact, DERIVATIVE_STEPS)), (x, y)),
        "reverse": (reverse(last_of(contact, DERIVATIVE_STEPS)), (x, y)),
        "batch": (jax.vmap(last_of(contact, MEMBER_STEPS)), several),
    }
    made, taken = {}, {}
    for what, (function, arguments) in plan.items():
        program, taken[what] = compiled(function, *arguments)
        made[what] = partial(program, *arguments)
    return made, taken


def run(report, fast):
    """Ratios; none in the smoke run, whose times are void."""
    if fast:
        return {}
    (plain, plain_compiling), (touching, compiling) = (programs(x) for x in (False, True))
    found = {}
    for what in plain:
        a, b = least((plain[what], touching[what]), PAIRS)
        found[what] = {
            "plain_time_s": float(a), "contact_time_s": float(b), "ratio_of_times": float(b / a),
            "compile_time_plain_s": plain_compiling[what], "compile_time_s": compiling[what],
        }  # fmt: skip
        report.progress(f"{what}: {found[what]}")
    found["switches_time"] = switching(report)
    return {
        "steps": STEPS,
        "derivative_steps": DERIVATIVE_STEPS,
        "members": MEMBERS,
        "member_steps": MEMBER_STEPS,
        "rows": found,
    }


def switching(report):
    """Microseconds of a step of the ball, of all its steps, at two sizes: what impacts add."""
    scene, found = SCENES["ball"], {}
    for steps in (640, 5120):
        program = jax.jit(lambda mu, steps=steps: run_of(scene, steps, steps, mu=mu).q[-1])
        found[f"{steps}"] = float(1e6 * least((partial(program, 0.1),), PAIRS)[0] / steps)
    report.progress(f"ball, us per step: {found}")
    return found
