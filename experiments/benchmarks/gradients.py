"""Gradients of a run: reverse mode with its memory, forward mode, second derivatives, batches."""

from functools import partial

import jax
import jax.numpy as jnp

from experiments.benchmarks import gradient_cost
from experiments.benchmarks.measure import compiled, least_seconds, temporary_bytes

STIFFNESS_AND_DAMPING = (400.0, 300.0), (15.0, 10000.0)
MEMBERS = 64


def flat_loss(x, num_steps, save_every=1):
    """`gradient_cost.loss` of one vector (4,)."""
    return gradient_cost.loss(((x[0], x[1]), (x[2], x[3])), num_steps, save_every)


def kinds(num_steps):
    """{name: function of (4,)}; the first is the primal."""
    loss = partial(flat_loss, num_steps=num_steps)

    def along_the_first(x):
        return jax.jvp(loss, (x,), (jnp.zeros(4).at[0].set(1.0),))

    def many(derivative):
        return lambda x: jax.lax.map(derivative, x + jnp.linspace(0.0, 1.0, MEMBERS)[:, None], batch_size=MEMBERS)

    return {
        "primal": loss,
        "value and gradient, reverse": jax.value_and_grad(loss),
        "forward, 1 direction": along_the_first,
        "forward, all 4": jax.jacfwd(loss),
        "Hessian, 4 x 4": jax.hessian(loss),
        f"primal, batch of {MEMBERS}": many(loss),
        f"value and gradient, batch of {MEMBERS}": many(jax.value_and_grad(loss)),
    }


def run(report, fast):
    """The long run, and all kinds of derivatives of a shorter one."""
    sizes = (1000,) if fast else (10_000, 100_000)
    long = [gradient_cost.measure(n, saved, 2 if fast else 5) for n in sizes for saved in ((1,) if fast else (1, n))]
    report.progress("value and gradient")
    num_steps, x = 200 if fast else 10_000, jnp.array(jax.tree.leaves(STIFFNESS_AND_DAMPING))
    programs, rows = {}, []
    for name, function in kinds(num_steps).items():
        if fast and name not in ("primal", "forward, 1 direction"):
            continue
        program, seconds = compiled(function, x)
        programs[name] = partial(program, x)
        rows.append({"derivative": name, "temporary_bytes": temporary_bytes(program), "compile_s": seconds})
    times = least_seconds(programs, 2 if fast else 5)
    for row in rows:
        name = row["derivative"]
        base = times[f"primal, batch of {MEMBERS}"] if "batch" in name else times["primal"]
        row |= {"us_per_step": 1e6 * times[name] / num_steps, "over_primal": times[name] / base}
    keys = "steps", "saved", "gradient_over_forward", "gradient_temporary_bytes", "forward_s", "gradient_s"
    report.table(keys, [[row[key] for key in keys] for row in long])
    report.table(list(rows[0]), [list(row.values()) for row in rows])
    return {"long": long, "num_steps": num_steps, "rows": rows}
