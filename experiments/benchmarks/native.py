"""The double pendulum's step in C, compiled on the spot and called by ctypes.

All flags in VARIANTS that compile are tried: the fastest is as good as C gets here.
"""

import ctypes
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import jax
import numpy as np

from hhtjax.scenes import double_pendulum

SOURCE = Path(__file__).with_name("double_pendulum.c")
EXACT = ("-O3", "-march=native")
VARIANTS = {
    "-O3 -march=native": EXACT,
    "-O3 -march=native -ffast-math": (*EXACT, "-ffast-math"),
    "-O3 -march=native -ffast-math, 512 bits": (*EXACT, "-ffast-math", "-mprefer-vector-width=512"),
}
KEYS = "m", "l", "k", "c", "g"
doubles = np.ctypeslib.ndpointer(float, flags="C_CONTIGUOUS")


def numbers_of(scene):
    """p of the C source, from a scene of `hhtjax.scenes.double_pendulum`."""
    values = jax.tree.leaves([scene.params[key] for key in KEYS])
    force = getattr(scene.system.force, "func", scene.system.force)
    return np.array([*values, force is not double_pendulum.force_as_printed], float)


def compiler():
    """The compiler's name, or None."""
    return next((name for name in ("cc", "gcc", "clang") if shutil.which(name)), None)


@cache
def compiler_version():
    """Its first line about itself."""
    name = compiler()
    if name is None:
        return None
    return subprocess.run([name, "--version"], capture_output=True, text=True, check=True).stdout.splitlines()[0]


@cache
def library(variant="-O3 -march=native"):
    """The C source, compiled with the flags of a variant; None where that does not work."""
    name = compiler()
    if name is None:
        return None
    folder = tempfile.TemporaryDirectory()
    path = Path(folder.name) / "double_pendulum.so"
    command = [name, *VARIANTS[variant], "-shared", "-fPIC", "-o", str(path), str(SOURCE), "-lm"]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        return None
    found = ctypes.CDLL(str(path))
    folder.cleanup()  # loaded, it is no longer needed
    number, count, nothing = ctypes.c_double, ctypes.c_long, ctypes.c_void_p
    found.rate.argtypes = [doubles, doubles, doubles]
    found.begin.argtypes = [doubles, doubles, count]
    found.run.argtypes = [doubles, number, number, count, doubles, nothing]
    found.run_batch.argtypes = [doubles, number, number, count, doubles, count]
    for function in (found.rate, found.begin, found.run, found.run_batch):
        function.restype = None
    return found


def libraries():
    """{variant: library} of those that compile."""
    return {variant: found for variant in VARIANTS if (found := library(variant)) is not None}


class Run:
    """A run of the C source that can be repeated: `Run(...)()` returns the last state, (8,) or (8, members).

    q0: (2,), or (2, members) for a batch, which starts at rest like one. save: keep all of q and v in `path`.
    """

    def __init__(self, found, scene, q0, dt, num_steps, alpha, save=False):
        self.found, self.p, self.save = found, numbers_of(scene), save
        self.options = float(dt), float(alpha), int(num_steps)
        q0 = np.asarray(q0, float)
        self.start = np.zeros((8, *q0.shape[1:]))
        self.start[:2] = q0
        self.path = np.zeros((num_steps, 4)) if save else None
        found.begin(self.p, self.start, self.start[0].size)

    def __call__(self):
        state = self.start.copy()
        if state.ndim == 1:
            self.found.run(self.p, *self.options, state, None if self.path is None else self.path.ctypes.data)
        else:
            self.found.run_batch(self.p, *self.options, state, state[0].size)
        return state
