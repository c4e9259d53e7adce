"""Exported models, compiled on the spot with the loop of loop.c around them."""

import ctypes
import subprocess
import tempfile
from pathlib import Path

import jax
import numpy as np

import hhtjax
from experiments.benchmarks import native

LOOP = Path(__file__).with_name("loop.c")
FLAGS = "-O3", "-march=native"  # those of the hand-written C
NAME = "model"


def exported(scene, stepper):
    """The scene as C, under one name."""
    z0 = getattr(scene, "z0", None)
    return hhtjax.export_c(scene.system, stepper, scene.q0, scene.v0, scene.params, z0=z0, name=NAME)


def flat(tree):
    """Its numbers."""
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)]).astype(float)


def compile_loop(model, folder, output, *options):
    """loop.c with the model in it."""
    model.write(folder)
    command = [native.compiler(), *FLAGS, f"-DMODEL={NAME}", f'-DSOURCE="{NAME}.c"', f"-D{NAME}_API=static inline"]
    subprocess.run([*command, *options, f"-I{folder}", LOOP, "-o", folder / output, "-lm"], check=True)
    return folder / output


class Run:
    """A run that can be repeated, from the start: `Run(...)()` returns the flags; `path` keeps the first angle."""

    def __init__(self, scene, stepper, dt, num_steps):
        self.model, self.dt, self.num_steps = exported(scene, stepper), dt, num_steps
        self.path = np.zeros(num_steps)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            loop = ctypes.CDLL(str(compile_loop(self.model, folder, "loop.so", "-fPIC", "-shared")))
            plain = folder / "plain.so"
            command = [native.compiler(), *FLAGS, "-fPIC", "-shared", folder / f"{NAME}.c", "-o", plain, "-lm"]
            subprocess.run(command, check=True)
            functions = ctypes.CDLL(str(plain))
        loop.export_sizes.restype = ctypes.c_ulong
        self.start = ctypes.create_string_buffer(loop.export_sizes())
        self.params = ctypes.byref(ctypes.c_char.in_dll(functions, f"{NAME}_defaults"))
        trees = [scene.q0, scene.v0, getattr(scene, "z0", None)]
        arrays = [flat(x).ctypes.data_as(ctypes.c_void_p) for x in trees if x is not None]
        begin, zero = getattr(functions, f"{NAME}_init"), ctypes.c_double(0)
        assert begin(self.start, self.params, *arrays, zero, ctypes.c_double(dt)) == 0
        self.loop = loop.export_run

    def __call__(self, path=False):
        state = ctypes.create_string_buffer(self.start.raw)
        where = ctypes.c_void_p(self.path.ctypes.data if path else None)
        return self.loop(state, self.params, ctypes.c_long(self.num_steps), ctypes.c_double(self.dt), where)
