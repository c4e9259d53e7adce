"""The step of the double pendulum against hand-written C: one trajectory, saving, a batch of 256, Newton."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.benchmarks import native, numba_step
from experiments.benchmarks.measure import compiled, dashed, least_seconds
from hhtjax.scenes import double_pendulum

ALPHA = -0.05
DT = 1e-4
START = 0.3, -0.2  # rad
TRIGONOMETRY = {"jnp": jnp, "polynomial": hhtjax.trigonometry}
MEMBERS = 256
STEPPERS = {  # the first is the arithmetic of the C source
    "non-iterative, predictor": hhtjax.hht(ALPHA, linearize="predictor"),
    "non-iterative, auto": hhtjax.hht(ALPHA),
    "converged": hhtjax.hht(ALPHA, iterations=None),
}

BATCHES = [(name, "jnp") for name in list(STEPPERS)[:2]] + [(next(iter(STEPPERS)), "polynomial")]
VECTORS = {256: None, 512: hhtjax.xla.WIDE}  # bits, and the options of a jit


def ours(scene, stepper, num_steps, save_every, q0):
    """The last position."""
    run = hhtjax.simulate(
        scene.system, stepper, q0, scene.v0, scene.params, dt=DT, num_steps=num_steps, save_every=save_every
    )
    return run.q if save_every == 1 else run.q[-1]


def c_runs(scene, q0, num_steps):
    """{variant: run} in C; without a compiler one trajectory by numba, if that is there."""
    if not native.libraries() and numba_step.installed() and np.ndim(q0) == 1:
        return {"numba": numba_step.Run(scene, q0, DT, num_steps, ALPHA)}
    return {
        f"C {variant}": native.Run(found, scene, q0, DT, num_steps, ALPHA)
        for variant, found in native.libraries().items()
    }


def single(num_steps, repeats, names):
    """One trajectory: ns per step of every form, and how far from C it ends."""
    scene = double_pendulum.free()
    q0 = jnp.array(START)
    functions, compile_s = {}, {}
    for trigonometry, module in TRIGONOMETRY.items():
        for name in names:
            for saved, every in (("end", num_steps), ("path", 1)):
                if saved == "path" and name != names[0]:
                    continue
                case = double_pendulum.free(module)
                program, compile_s[name, trigonometry, saved] = compiled(
                    partial(ours, case, STEPPERS[name], num_steps, every), q0
                )
                functions[name, trigonometry, saved] = partial(program, q0)
    rivals = c_runs(scene, START, num_steps)
    times = least_seconds(functions | rivals, repeats)
    fastest = min((times[name] for name in rivals), default=None)
    exact = next(iter(rivals.values()))()[:2] if rivals else None
    rows = []
    for key, function in functions.items():
        name, trigonometry, saved = key
        end = np.asarray(function())
        end = end if saved == "end" else end[-1]
        rows.append(
            {
                "method": name,
                "trigonometry": trigonometry,
                "saved": saved,
                "ns_per_step": 1e9 * times[key] / num_steps,
                "over_c": times[key] / fastest if fastest else None,
                "compile_s": compile_s[key],
                "q_minus_c_rad": None if exact is None else float(np.abs(end - exact).max()),
            }
        )
    return rows, {name: 1e9 * times[name] / num_steps for name in rivals}


def newton(num_steps, repeats):
    """Stiff joints: ns per step of all three steppers in one run."""
    scene = double_pendulum.stiff()
    functions = {name: partial(ours_jit, scene, s, num_steps, num_steps, scene.q0) for name, s in STEPPERS.items()}
    times = least_seconds(functions, repeats)
    return {name: 1e9 * seconds / num_steps for name, seconds in times.items()}


ours_jit = jax.jit(ours, static_argnums=(1, 2, 3))


def batch(num_steps, repeats):
    """A batch from random angles: ns per step and trajectory, with the vectors of a user's jit, and with wide ones."""
    angles = np.random.default_rng(0).normal(size=(MEMBERS, 2))
    functions, compile_s = {}, {}
    for method, trigonometry in BATCHES:
        scene = double_pendulum.free(TRIGONOMETRY[trigonometry])
        runs = jax.vmap(partial(ours, scene, STEPPERS[method], num_steps, num_steps))
        for bits, options in VECTORS.items():
            key = method, trigonometry, bits
            program, compile_s[key] = compiled(runs, jnp.asarray(angles), options=options)
            functions[key] = partial(program, jnp.asarray(angles))
    rivals = c_runs(double_pendulum.free(), angles.T, num_steps)
    times = least_seconds(functions | rivals, repeats)
    fastest = min((times[name] for name in rivals), default=None)
    rows = [
        {
            **dict(zip(("method", "trigonometry", "vectors_bits"), key, strict=True)),
            "ns_per_step_and_member": 1e9 * times[key] / num_steps / MEMBERS,
            "over_c": times[key] / fastest if fastest else None,
            "compile_s": compile_s[key],
        }
        for key in functions
    ]
    return rows, {name: 1e9 * times[name] / num_steps / MEMBERS for name in rivals}


def run(report, fast):
    """All four comparisons."""
    if not native.libraries():
        instead = "numba stands in for one trajectory" if numba_step.installed() else "there are no ratios to C"
        print(f"No C compiler: {instead}.", flush=True)
    names = list(STEPPERS)[:1] if fast else list(STEPPERS)
    num_steps = 2000 if fast else 50_000
    rows, c = single(num_steps, 3 if fast else 25, names)
    header = ["method", "trigonometry", "saved", "ns per step", "over the best C", "compile (s)", "|q - C| (rad)"]
    report.table(header, [dashed(row.values()) for row in rows])
    report.table(["C, one trajectory", "ns per step"], list(c.items()))
    batch_rows, batch_c = ([], {}) if fast else batch(2000, 9)
    if batch_rows:
        header = [f"batch of {MEMBERS}", "sines", "bits", "ns per step and member", "over the best C", "compile (s)"]
        report.table(header, [dashed(row.values()) for row in batch_rows])
        report.table(["C, batch", "ns per step and member"], list(batch_c.items()))
    stiff = {} if fast else newton(20_000, 9)
    report.table(["stiff joints", "ns per step"], list(stiff.items()))
    return {
        "num_steps": num_steps,
        "members": MEMBERS,
        "single": rows,
        "c_ns_per_step": c,
        "batch": batch_rows,
        "c_batch_ns": batch_c,
        "stiff_ns_per_step": stiff,
    }
