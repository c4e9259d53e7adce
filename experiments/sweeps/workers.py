"""Members handed to the workers of executors: processes of this machine, Dask's, MPI's; workers and callers that die.

Each case runs in a process of its own, `python -m experiments.sweeps.workers CASE ...`, and prints what it found. The
oscillators are Duffing's; all cases have to give the same bits.
"""

import hashlib
import importlib.util
import json
import multiprocessing
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
MEMBERS, CHUNK, STEPS = 240_000, 20_000, 5000
FAST_MEMBERS, FAST_CHUNK, FAST_STEPS = 40, 10, 20
KILLS, KILLED_MEMBERS, PARTS = 20, 2_000_000, 400
MANY, SMALL = 1_000_000, 20_000  # members, few steps each: what the caller's memory holds
TASKS = 1000  # without work


@cache
def oscillator():
    """System, q0, v0."""
    import jax.numpy as jnp
    import numpy as np

    import hhtjax

    def force(q, v, t, params):
        return -params["k"] * q - q**3 - 0.1 * v + jnp.cos(t)

    return hhtjax.System(np.ones(1), force), np.ones(1), np.zeros(1)


def stiffnesses(members):
    """Of each."""
    import numpy as np

    return np.linspace(1.0, 10.0, members)


def swept(folder, members, chunk, steps, executor=None, samples=4):
    """A sweep on disk."""
    import numpy as np

    import hhtjax

    system, q0, v0 = oscillator()
    return hhtjax.sweep_to_disk(
        folder, system, hhtjax.hht(), q0, v0, {"k": stiffnesses(members)}, in_axes=(None, None, None, {"k": 0}),
        dts=np.full(members, 0.01), duration=0.01 * steps, num_samples=samples, chunk=chunk, executor=executor,
    )  # fmt: skip


def digest(folder):
    """Of all files that hold members."""
    found = hashlib.sha256()
    for path in sorted(Path(folder).glob("chunk-*.npz")):
        found.update(path.read_bytes())
    return found.hexdigest()


compilations: list[float] = []


def count_compilations():
    """In a worker, before all else: one thread of XLA each, and a list of what is compiled."""
    import jax

    flags = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()

    def listen(event, duration_secs, **_):
        if event.endswith("backend_compile_duration"):
            compilations.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)


def told(_):
    """The process, and what it has compiled, after a moment in which the others are asked, too."""
    time.sleep(0.3)
    return os.getpid(), len(compilations)


@contextmanager
def processes(number):
    """A pool of the standard library."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(number, mp_context=spawn, initializer=count_compilations) as pool:
        yield pool


@contextmanager
def dask(number):
    """A cluster of this machine; who dies is replaced."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=number, threads_per_worker=1, dashboard_address=":0") as cluster,
        Client(cluster) as client,
    ):
        client.run(count_compilations)
        yield client.get_executor()


POOLS = {"processes": processes, "Dask": dask}


def is_there(kind):
    """Whether a kind of pool can be made."""
    return kind != "Dask" or importlib.util.find_spec("distributed") is not None


def timed(kind, number, members, chunk, steps):
    """Seconds of a sweep by a pool that has compiled it, of tasks without work, and a hash of its bits."""
    with tempfile.TemporaryDirectory() as folder:
        if kind == "none":
            swept(Path(folder) / "first", chunk, chunk, steps)
            start = time.perf_counter()
            where = swept(Path(folder) / "all", members, chunk, steps)
            return {"seconds": time.perf_counter() - start, "hash": digest(where)}
        with POOLS[kind](number) as pool:
            list(pool.map(int, range(number)))
            start = time.perf_counter()
            swept(Path(folder) / "first", number * chunk, chunk, steps, pool)
            first = time.perf_counter() - start
            start = time.perf_counter()
            where = swept(Path(folder) / "all", members, chunk, steps, pool)
            seconds = time.perf_counter() - start
            futures = [pool.submit(told, i) for i in range(4 * number)]
            compiled = dict(future.result() for future in futures)
            start = time.perf_counter()
            for future in [pool.submit(int, i) for i in range(TASKS)]:
                future.result()
            a_task = (time.perf_counter() - start) / TASKS
            found = digest(where)
    return {
        "seconds": seconds, "first_s": first, "compiled_by_each": list(compiled.values()), "task_s": a_task,
        "hash": found,
    }  # fmt: skip


def killed(kind, number, members, chunk, steps, kills):
    """A sweep whose workers are killed, each at a random moment; how many chunks were run more than once at most."""
    with tempfile.TemporaryDirectory() as folder:
        where, count = Path(folder) / "killed", 0
        with POOLS[kind](number) as pool:
            ended = threading.Event()

            def kill():
                nonlocal count
                while not ended.wait(random.uniform(0.3, 1.5)) and count < kills:
                    with suppress(Exception):  # while a worker starts anew it does not answer
                        os.kill(random.choice(list(pool._client.run(os.getpid).values())), signal.SIGKILL)
                        count += 1

            killer = threading.Thread(target=kill, daemon=True)
            killer.start()
            while True:
                try:
                    swept(where, members, chunk, steps, pool)
                    break
                except RuntimeError as error:
                    print(f"begun again: {error}", file=sys.stderr)
            ended.set()
            killer.join()
        return {"kills": count, "hash": digest(where)}


def caller_killed(members, chunk, steps, kills):
    """A caller that is killed at random moments and begun again, until it ends; and the hash."""
    with tempfile.TemporaryDirectory() as folder:
        where, count, ended = Path(folder) / "killed", 0, False
        command = [sys.executable, "-m", "experiments.sweeps.workers", "called", where, members, chunk, steps]
        while not ended:
            process = subprocess.Popen(
                list(map(str, command)), cwd=ROOT, stdout=subprocess.DEVNULL, start_new_session=True
            )
            try:
                if count < kills:
                    process.wait(timeout=random.uniform(3.5, 6))
                else:
                    process.wait()
                ended = process.returncode == 0
                if not ended:
                    raise RuntimeError(f"the caller ended with {process.returncode}")
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                count += 1
        return {"kills": count, "hash": digest(where)}


def called(where, members, chunk, steps):
    """A sweep by two processes, until somebody kills the caller."""
    with processes(2) as pool:
        swept(where, members, chunk, steps, pool)


def memory(members, chunk):
    """MB at the largest of a caller of so many members, and of a tenth of them."""
    found = {}
    for number in (members // 10, members):
        with tempfile.TemporaryDirectory() as folder, processes(2) as pool:
            swept(folder, number, chunk, 10, pool, samples=1)
            found[str(number)] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return found


def records(count, samples, steps, chunk):
    """Seconds of a fit of so many records alone and by two processes, both compiled, how far apart the estimates are in
    standard errors, and the bytes that come back in an evaluation, of triangles and of rows."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    import hhtjax

    pendulum = hhtjax.System(np.ones(1), lambda q, v, t, params: -params["k"] * jnp.sin(q) - params["c"] * v)

    def motion(params, start):
        run = hhtjax.simulate(
            pendulum, hhtjax.hht(), start[None], jnp.zeros(1), params, dt=0.01, num_steps=steps,
            save_every=steps // samples,
        )  # fmt: skip
        return run.q[1:, 0]

    def residuals(params, start, record):
        return motion(params, start) - record

    rng = np.random.default_rng(0)
    starts = rng.uniform(0.3, 1.2, count)
    measured = np.asarray(jax.vmap(lambda start: motion({"k": 4.0, "c": 0.3}, start))(starts))
    measured = measured + 0.01 * rng.normal(size=measured.shape)

    def fitted(**way):
        start = time.perf_counter()
        guess = {"k": 3.0, "c": 0.1}
        found = hhtjax.fit(residuals, guess, records=measured, starts=0 * starts + 0.7, weights=100.0, **way)
        return time.perf_counter() - start, found

    fitted()
    alone, known = fitted()
    with processes(2) as pool:
        fitted(executor=pool, chunk=chunk)
        shared, found = fitted(executor=pool, chunk=chunk)
    apart = {k: abs(float(x - known.params[k])) / float(known.standard_errors[k]) for k, x in found.params.items()}
    unknowns = len(apart) + 1
    return {
        "records": count,
        "samples": samples,
        "alone_s": alone,
        "two_workers_s": shared,
        "iterations": int(known.iterations),
        "iterations_shared": int(found.iterations),
        "apart_in_standard_errors": max(apart.values()),
        "bytes_of_triangles": 8 * count * (unknowns + 1) ** 2,
        "bytes_of_rows": 8 * count * samples * (unknowns + 1),
    }


CASES = {
    "records": records,
    "timed": timed,
    "killed": killed,
    "caller_killed": caller_killed,
    "called": called,
    "memory": memory,
}


def case(name, *arguments):
    """What a process of its own prints."""
    command = [sys.executable, "-m", "experiments.sweeps.workers", name, *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}  # of workers too
    done = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def blob_bytes():
    """Of the program of a sweep, as it crosses."""
    import numpy as np

    import hhtjax
    from hhtjax.runs import sweep_to_disk as disk

    system, q0, v0 = oscillator()
    inputs = disk.Inputs.checked(
        system, hhtjax.hht(), q0, v0, {"k": stiffnesses(100)}, dts=np.full(100, 0.01), duration=1.0, num_samples=4,
        in_axes=(None, None, None, {"k": 0}), t0=0.0,
    )  # fmt: skip
    return len(disk._work(inputs, 100).packed("workers").content)


def run(report, fast):
    """One and two workers of each kind, and none; then those that are killed."""
    members, chunk, steps = (FAST_MEMBERS, FAST_CHUNK, FAST_STEPS) if fast else (MEMBERS, CHUNK, STEPS)
    found = {"none": case("timed", "none", 0, members, chunk, steps)}
    kinds = [kind for kind in POOLS if is_there(kind) and not (fast and kind == "Dask")]
    for kind in kinds:
        for number in (2,) if fast else (1, 2):
            found[f"{kind}, {number}"] = case("timed", kind, number, members, chunk, steps)
            report.progress(f"workers: {kind}, {number}: {found[f'{kind}, {number}']}")
    equal = len({x["hash"] for x in found.values()}) == 1
    numbers = {"members": members, "chunk": chunk, "steps": steps, "bitwise_equal": equal, "bytes": blob_bytes()}
    numbers["rows"] = {name: {k: v for k, v in x.items() if k != "hash"} for name, x in found.items()}
    numbers["fit"] = case("records", *((8, 10, 20, 4) if fast else (1000, 500, 2000, 125)))
    report.progress(f"workers: a fit of records: {numbers['fit']}")
    print(f"workers: bitwise equal: {equal}\n")
    report.table(["", "s"], [[name, x["seconds"]] for name, x in found.items()])
    if fast:
        return numbers
    known = case("timed", "none", 0, KILLED_MEMBERS, KILLED_MEMBERS // PARTS, steps)["hash"]
    lost = {}
    if is_there("Dask"):
        lost["workers of Dask"] = case("killed", "Dask", 2, KILLED_MEMBERS, KILLED_MEMBERS // PARTS, steps, KILLS)
    lost["callers"] = case("caller_killed", KILLED_MEMBERS, KILLED_MEMBERS // PARTS, steps, KILLS)
    numbers["killed"] = {name: {"kills": x["kills"], "equal": x["hash"] == known} for name, x in lost.items()}
    numbers["memory_MB"] = case("memory", MANY, SMALL)
    report.progress(f"workers: {numbers['killed']}, {numbers['memory_MB']}")
    return numbers


def main(arguments):
    """One case."""
    import jax

    jax.config.update("jax_enable_x64", True)
    name, *rest = arguments
    values = [int(x) if x.isdigit() else x for x in rest]
    print(json.dumps(CASES[name](*values)))


if __name__ == "__main__":
    from experiments.sweeps import workers  # what is sent from __main__ would cross by value

    workers.main(sys.argv[1:])
