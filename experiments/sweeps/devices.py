"""The members of a sweep over devices: forced devices of one process, and two processes of jax.distributed.

Each case runs in processes of its own: `python -m experiments.sweeps.devices MEMBERS DEVICES [PROCESS PORT]`. All have
to give the same bits. Strong scaling: the same members; weak: twice as many on two.
"""

import hashlib
import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
MEMBERS, FAST_MEMBERS = 131_072, 300
REPEATS = 5


def main(arguments):
    """One case: prints what it found."""
    members, devices, *process = map(int, arguments)
    if not process:
        given = os.environ.get("XLA_FLAGS", "")  # the same as of one device: other ones round differently
        os.environ["XLA_FLAGS"] = f"{given} --xla_force_host_platform_device_count={devices}".strip()
    import jax

    jax.config.update("jax_enable_x64", True)
    if process:
        number, port = process
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"127.0.0.1:{port}", num_processes=devices, process_id=number)
    print(json.dumps(swept(members, devices)))


def swept(members, devices):
    """The least time of a sweep in s, and a hash of its bits and of those of one over `times`."""
    import jax
    import numpy as np

    import hhtjax
    from hhtjax import trigonometry
    from hhtjax.scenes import double_pendulum

    system, params, q0, v0, _ = double_pendulum.free(trigonometry)
    q0, v0 = np.asarray(q0), np.asarray(v0)
    mesh = None if devices == 1 else jax.make_mesh((jax.device_count(),), ("members",))
    dts = np.random.default_rng(0).uniform(1e-3, 1e-2, members)

    def run():
        start = time.perf_counter()
        runs = hhtjax.sweep(
            system, hhtjax.hht(-0.05, linearize="predictor"), q0, v0, params, dts=dts, duration=1.0, num_samples=2,
            mesh=mesh,
        )  # fmt: skip
        jax.block_until_ready(runs)
        return time.perf_counter() - start, runs

    run()
    repeated = [run() for _ in range(REPEATS)]
    springs, start = hhtjax.System(np.ones(2), lambda q, v, t, params: -q), np.array([1.0, 0.0])  # one at rest: a = -0
    uneven = hhtjax.sweep(springs, hhtjax.rk4(), start, start, dts=10 * dts[:100], times=[0.1, 0.11, 0.4], mesh=mesh)
    digest = hashlib.sha256()
    for runs in (repeated[-1][1], uneven):
        runs.check()
        digest.update(b"".join(np.asarray(x).tobytes() for x in (runs.q, runs.v, runs.acceleration, runs.dt)))
    return {"seconds": min(seconds for seconds, _ in repeated), "hash": digest.hexdigest()}


def case(members, devices, processes=False):
    """What such processes print; that of the first, once all agree."""
    port = free_port()
    first, *others = at_once(
        [(members, devices, i, port) for i in range(devices)] if processes else [(members, devices)]
    )
    assert all(other["hash"] == first["hash"] for other in others)
    return first


def at_once(cases):
    """What the processes of these cases print, running side by side."""
    commands = [[sys.executable, "-m", "experiments.sweeps.devices", *map(str, case)] for case in cases]
    running = [subprocess.Popen(c, cwd=ROOT, stdout=subprocess.PIPE, text=True) for c in commands]
    printed = [process.communicate()[0] for process in running]
    if any(process.returncode for process in running):
        raise RuntimeError(f"{commands} failed")
    return [json.loads(text.splitlines()[-1]) for text in printed]


def free_port():
    """A port that is free now."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def run(report, fast):
    """One, two devices, two processes; the same members, and twice as many."""
    n = FAST_MEMBERS if fast else MEMBERS
    cases: dict[str, tuple] = {"one": (n, 1)}
    if not fast:
        cases |= {
            "two processes": (n, 2, True),
            "two devices": (n, 2),
            "two devices, twice the members": (2 * n, 2),
            "one, twice": (2 * n, 1),
        }
        cases |= {"two processes, twice the members": (2 * n, 2, True), "three devices": (n, 3)}
    found = {}
    for name, arguments in cases.items():
        found[name] = case(*arguments)
        report.progress(f"devices: {name}, {found[name]['seconds']:.2f} s")
    if not fast:  # what the machine gives to two processes that know nothing of each other
        seconds = max(x["seconds"] for x in at_once([(n // 2, 1)] * 2))
        found["two processes apart, half the members each"] = {"seconds": seconds}
    same = {name for name, (members, *_) in cases.items() if members == n}
    equal = len({found[name]["hash"] for name in same}) == 1
    one = found["one"]["seconds"]
    print(f"{n} members over devices: bitwise equal: {equal}\n")
    report.table(["", "s", "over one device"], [[k, x["seconds"], x["seconds"] / one] for k, x in found.items()])
    return {
        "members": n,
        "bitwise_equal": equal,
        "seconds": {name: x["seconds"] for name, x in found.items()},
        "over_one": {name: x["seconds"] / one for name, x in found.items()},
        "load": os.getloadavg()[0],
    }


if __name__ == "__main__":
    main(sys.argv[1:])
