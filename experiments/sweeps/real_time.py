"""One step at a time, at 1 kHz from Python: latency, deadlines, hardware in the loop, a constant amount of work.

The step is compiled ahead of time, with the state as one vector, so that a call hands over two arrays; it is one kernel
(hhtjax/primitives/kernels.py) where XLA can. The same program exported, written to bytes and read again. Latencies of
calls back to back, and of calls started at each millisecond; a deadline is missed if the answer is not there a
millisecond later.
"""

import queue
import re
import threading
import time
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.flatten_util import ravel_pytree

import hhtjax
from experiments.report import COLOURS
from hhtjax.plot import legend, subplots
from hhtjax.primitives import one_kernel
from hhtjax.scenes import double_pendulum, squeezer, vehicle

PERIOD = 1e-3  # s
CALLS, FAST_CALLS = 100_000, 300
STEPPER = hhtjax.hht(-0.05)
NEWTON = hhtjax.hht(-0.05, iterations=None)


def scenes():
    """{name: (scene, step size in s)}; the squeezer turns too fast for a whole millisecond."""
    return {
        "double pendulum": (double_pendulum.stiff(), PERIOD),
        "vehicle": (vehicle.ride(duration=1.0), PERIOD),
        "squeezer": (squeezer.squeezer(), 1e-4),
    }


def step_of(scene, h, stepper=STEPPER):
    """A function (state, command) -> state of vectors, and the first state; the command adds to Q."""
    system, params, q0, v0, _ = scene

    def driven(q, v, t, params):
        params, command = params
        return system.force(q, v, t, params) + command

    driven_system = hhtjax.System(system.mass, driven, system.constraint)
    if callable(system.mass):
        driven_system = hhtjax.System(lambda q, p: system.mass(q, p[0]), driven, with_params(system.constraint))
    command = jnp.zeros_like(v0)
    first, unravel = ravel_pytree(stepper.init(driven_system, q0, v0, (params, command), h))

    def step(state, command):
        state, _ = stepper.step(driven_system, unravel(state), (params, command), h)
        return ravel_pytree(state)[0]

    return lambda state, command: one_kernel(step, state, command), first, command


def with_params(constraint):
    """The constraint of the driven system, whose params are (params, command)."""
    return None if constraint is None else lambda q, t, p: constraint(q, t, p[0])


def operations(program):
    """Counts of operations in a compiled program, and how often it loops."""
    found = Counter(re.findall(r"= .*? ([a-z][a-z\-]*)\(", program.as_text()))
    cost = program.cost_analysis()
    return {"flops": cost.get("flops"), "instructions": sum(found.values()), "while_loops": found["while"]}


def latencies(step, state, command, calls):
    """Seconds of each call, back to back, the state handed on."""
    taken = np.empty(calls)
    for i in range(calls):
        start = time.perf_counter()
        state = step(state, command)
        state.block_until_ready()
        taken[i] = time.perf_counter() - start
    return taken


def paced(step, state, command, calls):
    """The same, a call at each millisecond, waiting busily in between; and how late the end of each came."""
    taken, due = np.empty(calls), time.perf_counter() + PERIOD
    missed = 0
    for i in range(calls):
        while time.perf_counter() < due:
            pass
        start = time.perf_counter()
        state = step(state, command)
        state.block_until_ready()
        end = time.perf_counter()
        taken[i] = end - start
        missed += end > due + PERIOD
        due += PERIOD
    return taken, missed


def summary(taken):
    """Median, 99.9th percentile, worst, in microseconds, and how many were longer than the period."""
    values = dict(zip(("median_us", "p999_us", "worst_us"), 1e6 * np.quantile(taken, [0.5, 0.999, 1.0]), strict=True))
    return {key: float(x) for key, x in values.items()} | {"over_1_ms": int((taken > PERIOD).sum())}


def hardware_in_the_loop(step, state, command, seconds):
    """A controller in a thread of its own holds the first link of the pendulum up while the plant runs at 1 kHz.

    The plant does not wait: it takes the newest command there is. Late steps of the plant, and samples that the
    controller did not answer in time, are counted.
    """
    measured, commands = queue.SimpleQueue(), queue.SimpleQueue()

    def control():
        integral, target = 0.0, 0.5
        while (sample := measured.get()) is not None:
            number, q, v = sample
            integral += 400.0 * PERIOD * (target - q[0])
            commands.put((number, np.array([1500.0 * (target - q[0]) + integral - 200.0 * v[0], 0.0])))

    controller = threading.Thread(target=control)
    controller.start()
    late = stale = 0
    path, answered = [], -1
    due = time.perf_counter()
    for number in range(round(seconds / PERIOD)):
        due += PERIOD
        stale += number > 0 and answered < number - 1
        state = step(state, command)
        now = np.asarray(state)  # t, q1, q2, v1, v2, ...
        measured.put((number, now[1:3], now[3:5]))
        path.append(float(now[1]))
        late += time.perf_counter() > due
        while (rest := due - time.perf_counter()) > 0:
            if rest > 3e-4:
                time.sleep(1e-4)
        while not commands.empty():
            answered, command = commands.get()
    measured.put(None)
    controller.join()
    return {"steps": len(path), "late": late, "stale_commands": stale, "end_rad": path[-1], "target_rad": 0.5}, path


def run(report, fast):
    """Everything, the empty call of the same arrays in the same run."""
    calls = FAST_CALLS if fast else CALLS
    rows, samples = [], {}
    for name, (scene, h) in list(scenes().items())[: 1 if fast else None]:
        step, first, command = step_of(scene, h)
        program = jax.jit(step).lower(first, command).compile()
        empty = jax.jit(lambda state, command: state + 0).lower(first, command).compile()
        kept = export.deserialize(bytearray(export.export(jax.jit(step))(first, command).serialize()))
        again = jax.jit(kept.call).lower(first, command).compile()
        forms = {"empty call": empty, "compiled": program, "exported and reloaded": again}
        for form in forms.values():
            latencies(form, first, command, 100)
        taken = {form: [] for form in forms}
        for _ in range(10):  # in turns
            for form, function in forms.items():
                taken[form].append(latencies(function, first, command, calls // 10))
        for form in forms:
            samples[name, form] = np.concatenate(taken[form])
            rows.append({"scene": name, "h_s": h, "form": form} | summary(samples[name, form]))
        mine = next(r for r in rows if r["scene"] == name and r["form"] == "compiled")
        mine |= {"exported_is_bitwise_equal": bool(np.array_equal(program(first, command), again(first, command)))}
        newton = jax.jit(step_of(scene, h, NEWTON)[0]).lower(first, command).compile()
        mine |= operations(program) | {"newton": operations(newton)}
        report.progress(f"real time: {name}, median {mine['median_us']:.1f} us")
        if name == "double pendulum":
            rounds = {"at 1 kHz": program, "empty call at 1 kHz": empty}
            turns = [{form: paced(f, first, command, calls // 10) for form, f in rounds.items()} for _ in range(10)]
            for form in rounds:
                wait = samples[name, form] = np.concatenate([turn[form][0] for turn in turns])
                missed = sum(turn[form][1] for turn in turns)
                rows.append({"scene": name, "h_s": h, "form": form, "deadlines_missed": missed} | summary(wait))
            loop, path = hardware_in_the_loop(program, first, command, 0.3 if fast else 10.0)
            report.progress(f"hardware in the loop: {loop}")
    ratio = rows[1]["median_us"] / rows[0]["median_us"]
    print(f"Latency of {calls} calls, microseconds; the double pendulum's step takes {ratio:.2f} empty calls\n")
    report.table(
        ["scene, form", "median", "99.9 %", "worst", "> 1 ms"],
        [[f"{r['scene']}, {r['form']}", r["median_us"], r["p999_us"], r["worst_us"], r["over_1_ms"]] for r in rows],
    )
    if not fast:
        report.figure("sweeps_real_time", figure(samples, path))
    return {"calls": calls, "rows": rows, "median_over_empty_call": ratio, "hardware_in_the_loop": loop}


def figure(samples, path):
    """How many calls took longer than that; the controlled angle."""
    drawn, (left, right) = subplots(1, 2, width=175, height=90)
    shown = [key for key in samples if key[1] in ("empty call", "compiled", "at 1 kHz", "empty call at 1 kHz")]
    shown = [key for key in shown if key[0] == "double pendulum" or key[1] == "compiled"]
    for i, key in enumerate(shown):
        x = np.sort(samples[key])
        share = 1 - np.arange(x.size) / x.size
        left.loglog(1e6 * x, share, color=COLOURS[i], ls=("-", "--", ":")[i % 3], label=", ".join(key))
    left.axvline(1e6 * PERIOD, color="black", lw=1)
    left.set(xlabel="latency (µs)", ylabel="share of calls that took longer", ylim=(0.5 / x.size, 1.2))
    legend(left)
    right.plot(PERIOD * np.arange(len(path)), path, label="first link")
    right.axhline(0.5, color="black", ls=":", label="target")
    right.set(xlabel="time (s)", ylabel="angle (rad)")
    legend(right)
    return drawn
