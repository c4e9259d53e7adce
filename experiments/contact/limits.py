"""How far bodies go into each other at any saved step of any scene, and whether free motions gain energy."""

from functools import partial

import jax
import jax.numpy as jnp

from experiments.contact.scenes import SCENES, ball, disc, energy, rock, rod, shaken, simulate, slope, stack

STEPS = 40, 160, 640, 2560


ALL = SCENES | {
    "disc": disc(), "slope": slope(0.5, -2.0), "stack": stack(0.0),
    **{f"stack, {part:g} mu g": shaken(part) for part in (0.65, 2.4)},
}  # fmt: skip
FREE = {"ball without drag": ball(0.0), "rod": rod(), "rock": rock(), "disc": disc(), "slope, stays": slope(0.3, -2.0)}


@partial(jax.jit, static_argnames=("name", "longest"))
def gaps_and_energy(name, dt, longest):
    """Of one program for all step sizes, whose further steps are unused; and the step that failed."""
    scene = (ALL | FREE)[name]
    run = simulate(scene, dt, longest)
    gap = jax.vmap(lambda q, t: jnp.min(scene.contact.gap(q, t, scene.params)))(run.q, run.t)
    return gap, None if scene.potential is None else energy(scene, run), run.failure.step


def run(report, fast):
    """For each scene and number of steps; none in the smoke run, as each scene is a program to compile."""
    if fast:
        return {}
    gaps, rises = [], []
    for name, scene in (ALL | FREE).items():
        for n in STEPS:
            gap, e, failed = gaps_and_energy(name, scene.T / n, STEPS[-1])
            named = int(failed) if int(failed) <= n else 0
            row = {"scene": name, "steps": n}
            gaps.append(row | {"lowest_gap_m": float(jnp.min(gap[: n + 1])), "failed_step": named})
            if name in FREE:
                e = e[: n + 1]
                numbers = {
                    "lost_J": e[0] - e[-1],
                    "largest_rise_J": jnp.max(jnp.diff(e)),
                    "above_start_J": jnp.max(e) - e[0],
                }
                rises.append(row | {key: float(x) for key, x in numbers.items()})
        report.progress(f"{gaps[-1]} {rises[-1] if rises and rises[-1]['scene'] == name else ''}")
    return {"gaps": gaps, "energy": rises}
