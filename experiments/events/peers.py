"""The ball beside others: MuJoCo's soft limit and exudyn's contact, and diffrax, whose run is begun anew by hand."""

import importlib.util
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.events import by_exudyn
from hhtjax.scenes import balls

DURATION, BOUNCES = 1.4, 2
FAST = 0.9, 1  # the same of the smoke run: a third less to compile
STEPS = tuple(50 * 2**i for i in range(9))
E = 0.8
CONTACT = 0.3  # sqrt(k) dt of a soft contact: ten steps long
STIFFNESSES = 1e5, 1e6, 1e7, 1e8  # N/m, of contacts in which steps are shortened


def by_formula(x, duration, bounces):
    """q at the end of x = (q0, v0, e, g) without drag."""
    q0, v0, e, g = x
    speed = jnp.sqrt(v0**2 + 2 * g * q0)
    left = duration - (v0 + speed) / g
    for _ in range(bounces - 1):
        speed = e * speed
        left = left - 2 * speed / g
    speed = e * speed
    return speed * left - g * left**2 / 2


def ours(x, steps, duration):
    """The same by a run."""
    scene = balls.bouncing(drag=0.0)
    params = scene.params | {"e": x[2], "g": x[3]}
    run = hhtjax.simulate(
        scene.system, hhtjax.hht(), x[:1], x[1:2], params, dt=duration / steps, num_steps=steps, events=scene.events
    )
    return run.q[-1, 0]


def by_mujoco(steps, duration):
    """A slide joint with a limit at zero: a stiff spring and the damper that gives e, as stiff as the step allows."""
    mujoco: Any = importlib.import_module("mujoco")  # of an extra of its own

    dt = duration / steps
    k, ratio = (CONTACT / dt) ** 2, -np.log(E) / np.hypot(np.pi, np.log(E))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler autolimits="false"/><option gravity="0 0 -{balls.GRAVITY}" timestep="{dt:.17g}" '
        'integrator="implicitfast" tolerance="1e-12"/><worldbody><body><joint type="slide" axis="0 0 1" limited="true" '
        f'range="0 10" solreflimit="{-k:.17g} {-2 * ratio * np.sqrt(k):.17g}" solimplimit="0.9999 0.9999 0.001"/>'
        '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    data.qpos[0] = 1.0
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return float(data.qpos[0])


def by_diffrax(x, tolerance, duration, bounces):
    """Runs by Tsit5, each from the event of the one before, that the caller turns back and counts."""
    import diffrax
    import optimistix

    def rate(t, y, args):
        return jnp.stack([y[1], -args])

    event = diffrax.Event(lambda t, y, args, **_: y[0], optimistix.Newton(1e-13, 1e-13), direction=False)
    y, t = x[:2], jnp.zeros(())
    for flight in range(bounces + 1):
        solution: Any = diffrax.diffeqsolve(
            diffrax.ODETerm(rate), diffrax.Tsit5(), t, duration, 1e-2, y, args=x[3],
            event=event if flight < bounces else None, stepsize_controller=diffrax.PIDController(tolerance, tolerance),
            adjoint=diffrax.RecursiveCheckpointAdjoint(),
        )  # fmt: skip
        t, y = solution.ts[-1], solution.ys[-1]
        if flight < bounces:
            y = jnp.stack([jnp.zeros(()), -x[2] * y[1]])
    return y[0]


def run(report, fast):
    """Errors of q, and of its derivatives in the start, the restitution and gravity."""
    x = jnp.array([1.0, 0.0, E, balls.GRAVITY])
    duration, bounces = FAST if fast else (DURATION, BOUNCES)
    wanted, slopes = jax.value_and_grad(by_formula)(x, duration, bounces)
    found = {"wanted_q_m": float(wanted), "rows": {}}
    value, gradient = jax.jit(jax.value_and_grad(lambda x: ours(x, STEPS[0], duration)))(x)
    found["hhtjax"] = told(value - wanted, gradient - slopes) | {"steps": STEPS[0]}
    if importlib.util.find_spec("diffrax"):
        value, gradient = jax.jit(jax.value_and_grad(lambda x: by_diffrax(x, 1e-9, duration, bounces)))(x)
        found["diffrax, begun anew by hand"] = told(value - wanted, gradient - slopes)
    if importlib.util.find_spec("mujoco"):
        sizes = STEPS[:3] if fast else STEPS
        found["rows"]["MuJoCo, soft limit"] = {
            "steps": list(sizes), "error_m": [abs(by_mujoco(steps, duration) - float(wanted)) for steps in sizes]
        }  # fmt: skip
    if importlib.util.find_spec("exudyn"):
        found["rows"] |= in_exudyn(float(wanted), STEPS[:3] if fast else STEPS, duration)
    report.progress(str(found))
    return found


def in_exudyn(wanted, sizes, duration):
    """Rows by way: with the steps of all, and with those that it shortens where the contact begins and ends."""
    start, rows = (balls.GRAVITY, E, duration), {}
    for law in by_exudyn.LAWS:
        ends = [by_exudyn.fallen(law, *start, n, (CONTACT * n / duration) ** 2)[0] for n in sizes]
        rows[f"exudyn, {law}"] = {"steps": list(sizes), "error_m": [abs(q - wanted) for q in ends]}
    ends, steps = zip(
        *(by_exudyn.fallen("restitution", *start, 200, k, shortened=True) for k in STIFFNESSES), strict=True
    )
    rows["exudyn, restitution, steps shortened at contacts"] = {
        "steps": steps, "error_m": [abs(q - wanted) for q in ends], "stiffness_N_m": STIFFNESSES
    }  # fmt: skip
    return rows


def told(error, errors):
    """Of q, and the largest of its derivatives."""
    return {"error_m": abs(float(error)), "derivative_difference": float(jnp.max(jnp.abs(errors)))}
