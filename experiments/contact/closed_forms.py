"""Against formulas, with 40 steps: a block on a slope, a disc and a sphere that come to roll, a stack of boxes."""

import jax
import jax.numpy as jnp
import numpy as np

from experiments.contact.scenes import GRAVITY, disc, run_of, shaken, slope, stack

STEPS = 40
SLOPES = {  # angle, speed at the start, down the slope; mu = 0.4 holds up to 0.3805
    "rests below the angle of friction": (0.37, 0.0),
    "slides above it": (0.5, 0.0),
    "thrown up, slides back": (0.5, -2.0),
    "thrown up, stays": (0.3, -2.0),
}
BODIES = {"disc": 0.5, "sphere": 0.4}
REST = 10.0  # s


def on_slope(angle, v0, mu, t):
    """The way down the slope, of one that starts upwards, downwards, or not at all."""
    g, pull, rub = GRAVITY, jnp.sin(angle), mu * jnp.cos(angle)
    stop = -v0 / (g * (pull + rub)) if v0 < 0 else 0.0
    up = v0 * stop / 2
    return up + jnp.where(pull > rub, g * (pull - rub) * (t - stop) ** 2 / 2, 0.0)


def rolled(inertia, params, t):
    """Position at t, and the speed, of what has come to roll: x'' = -mu g until v = w, angular momentum kept."""
    kept = 1 / (1 + inertia)
    stop = params["v0"] * (1 - kept) / (params["mu"] * GRAVITY)
    rolling = kept * params["v0"]
    return params["v0"] * stop - params["mu"] * GRAVITY * stop**2 / 2 + rolling * (t - stop), rolling


def slopes(report):
    """Errors of the end, and of its derivative in mu."""
    rows = []
    for name, (angle, v0) in SLOPES.items():
        scene = slope(angle, v0)
        down = jnp.array([jnp.cos(angle), -jnp.sin(angle)])

        def end(mu, scene=scene, down=down):
            return run_of(scene, STEPS, STEPS, mu=mu).q[-1] @ down

        mu = scene.params["mu"]
        found, formula = end(mu), on_slope(angle, v0, mu, scene.T)
        slope_of = jax.jacfwd(end)(mu), jax.jacfwd(lambda mu, a=angle, v=v0: on_slope(a, v, mu, 1.0))(mu)
        rows.append(
            {
                "what": name, "way_m": float(formula), "error_m": float(jnp.abs(found - formula)),
                "derivative_error": float(jnp.abs(slope_of[0] - slope_of[1])),
            }
        )  # fmt: skip
        report.progress(f"{rows[-1]}")
    return rows


def rolling(report):
    """Errors of position and speed, and of their derivatives in mu and the speed at the start."""
    rows = []
    for name, inertia in BODIES.items():
        scene = disc(inertia)

        def end(params, scene=scene):
            run = run_of(scene, STEPS, STEPS, **params)
            return jnp.stack([run.q[-1, 0], run.v[-1, 0]])

        def formula(params, inertia=inertia):
            return jnp.stack(rolled(inertia, params, 1.0))

        found, exact = end(scene.params), formula(scene.params)
        of_run, known = jax.jacfwd(end)(scene.params), jax.jacfwd(formula)(scene.params)
        rows.append(
            {
                "what": name, "lost": float(1 - found[1] / scene.params["v0"]), "formula": inertia / (1 + inertia),
                "error_m": float(jnp.max(jnp.abs(found - exact))),
                "derivative_error": float(max(jnp.max(jnp.abs(of_run[k] - known[k])) for k in known)),
            }
        )  # fmt: skip
        report.progress(f"{rows[-1]}")
    return rows


def stacks(report):
    """At rest for some time; on a floor whose acceleration is a part of mu g, stuck, and slipping."""
    scene = stack(0.0)._replace(T=REST)
    run = run_of(scene, 200)
    weights = GRAVITY * np.array([2.2, 1.2, 0.5])
    found = {
        "rest_s": REST,
        "moved_m": float(jnp.max(jnp.abs(run.q - run.q[:1]))),
        "force_error_N": float(jnp.max(jnp.abs(run.contact.normal - weights))),
    }
    for steps in (200, 1000):
        amplitude = 0.65 * 0.5 * GRAVITY / 64
        run = run_of(shaken(0.65), steps)
        wanted = amplitude * jnp.sin(8 * run.t)[:, None]
        found[f"stuck_error_m_{steps}"] = float(jnp.max(jnp.abs(run.q[:, :3] - wanted)))
        found[f"stuck_all_the_time_{steps}"] = bool(run.contact.sticking.all())
    run = run_of(shaken(2.4), 200)
    found["slipping_gap_m"] = float(
        jnp.max(jnp.abs(jnp.diff(run.q[:, 3:], axis=1, prepend=0.0) - jnp.array([0, 1, 1])))
    )
    found["slipping_named_step"] = int(run.failure.step)
    report.progress(f"stacks: {found}")
    return found


def run(report, fast):
    """All of them; none in the smoke run, as each scene is a program to compile."""
    if fast:
        return {}
    return {"steps": STEPS, "rolling": rolling(report), "slopes": slopes(report), "stack": stacks(report)}
