"""How times are taken: in turns within one process, the least of several, compilation apart."""

import os
import platform
import time
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax

from experiments.benchmarks import native


def least_seconds(functions, repeats):
    """{name: least wall time of one call}, the calls in turns, after one call each that compiles.

    functions: {name: a function without arguments}. What else the machine does hits all of them alike.
    """
    times = dict.fromkeys(functions, float("inf"))
    for function in functions.values():
        jax.block_until_ready(function())
    for _ in range(repeats):
        for name, function in functions.items():
            start = time.perf_counter()
            jax.block_until_ready(function())
            times[name] = min(times[name], time.perf_counter() - start)
    return times


def compiled(function, *args, options=None):
    """The compiled function, and the wall time in s of tracing and compiling it, with every cache empty.

    options: of XLA.
    """
    jax.clear_caches()
    start = time.perf_counter()
    program = jax.jit(function).lower(*args).compile(options)
    return program, time.perf_counter() - start


def temporary_bytes(program):
    """XLA's own count of the temporary memory of a compiled program."""
    memory: Any = program.memory_analysis()
    return memory.temp_size_in_bytes


@contextmanager
def one_core():
    """All threads of this process on its first core, where the system can do that."""
    tasks = Path("/proc/self/task")
    if not (hasattr(os, "sched_setaffinity") and tasks.is_dir()):
        yield
        return
    before = os.sched_getaffinity(0)
    try:
        for task in tasks.iterdir():
            os.sched_setaffinity(int(task.name), {min(before)})
        yield
    finally:
        for task in tasks.iterdir():
            os.sched_setaffinity(int(task.name), before)


def processor():
    """Its name, where the system tells."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def machine():
    """Hardware, load and versions."""
    return {
        "processor": processor(),
        "cores": os.cpu_count(),
        "load_at_start": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "jax": jax.__version__,
        "compiler": native.compiler_version(),
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", ""),
    }


def dashed(values):
    """For tables: a dash for what there is no number of."""
    return ["-" if x is None else x for x in values]
