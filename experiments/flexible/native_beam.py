"""The beam's step in C, compiled on the spot and called by ctypes."""

import ctypes
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from experiments.benchmarks.native import VARIANTS, compiler, doubles
from experiments.flexible.beam import Beam, hub_angle, masses, straight

SOURCES = {name: Path(__file__).with_name(f"{name}.c") for name in ("beam", "plain_beam")}
PLAIN, FAST = "-O3 -march=native", "-O3 -march=native -ffast-math"
HELD = 1e30  # the mass of what is held


@cache
def library(variant: str = FAST, source: str = "beam"):
    """A C source, compiled with the flags of a variant; None where that does not work."""
    name = compiler()
    if name is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path, part = (Path(folder) / f"beam.{kind}" for kind in ("so", "o"))
        # linked on its own: with -ffast-math there, gcc would let the whole process flush small numbers to zero
        for command in (
            [name, *VARIANTS[variant], "-c", "-fPIC", "-o", part, SOURCES[source]],
            [name, "-shared", "-o", path, part, "-lm"],
        ):
            if subprocess.run(command, capture_output=True, check=False).returncode:
                return None
        found = ctypes.CDLL(str(path))
    number, count, nothing = ctypes.c_double, ctypes.c_long, ctypes.c_void_p
    found.begin.argtypes = [doubles, doubles, doubles, count, doubles]
    found.run.argtypes = [doubles, doubles, doubles, nothing, count, number, number, count, doubles]
    found.begin.restype = found.run.restype = None
    return found


class Run:
    """A run of the C source that can be repeated: `Run(...)()` returns q and v at the end, each (nodes, 3).

    Raises:
        ValueError: the number of elements is odd.
    """

    def __init__(self, found, beam: Beam, dt: float, num_steps: int, alpha: float = -0.05):
        if beam.elements % 2:
            raise ValueError(f"Run: `beam` must have an even number of elements; received {beam.elements}.")
        self.found, self.nodes = found, beam.elements + 1
        self.options, self.num_steps = (float(dt), float(alpha)), num_steps
        self.numbers = np.array([beam.length / beam.elements, beam.EA, beam.GA, beam.EI])
        mass = masses(beam)
        load = -beam.gravity * mass * np.array([0.0, 1.0, 0.0])
        mass[0, : beam.held], load[0, : beam.held] = HELD, 0.0
        self.mass, self.load = (np.ascontiguousarray(x.T) for x in (mass, load))
        times = dt * np.arange(1, num_steps + 1)
        self.hub = hub_angle(beam, times, np) if beam.hub else None
        self.start = np.zeros((4, 3, self.nodes))
        self.start[0] = straight(beam).T
        found.begin(self.numbers, self.mass, self.load, self.nodes, self.start)

    def __call__(self):
        state = self.start.copy()
        self._steps(state, 0, self.num_steps)
        return state[0].T, state[1].T

    def tip(self, every: int):
        """x, y and theta of the last node after each `every` steps, (samples, 3)."""
        state, samples = self.start.copy(), []
        for first in range(0, self.num_steps - every + 1, every):
            self._steps(state, first, every)
            samples.append(state[0, :, -1].copy())
        return np.array(samples)

    def _steps(self, state, first: int, count: int):
        hub = None if self.hub is None else self.hub[first:].ctypes.data
        self.found.run(self.numbers, self.mass, self.load, hub, self.nodes, *self.options, count, state)
