"""Exported models, compiled and called: a run in C as arrays."""

import ctypes
import itertools
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

STRICT = "-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror"
SANITIZERS = "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"
COUNT = itertools.count()  # a file that is loaded must not be written over
COMPILER = next((name for name in ("cc", "gcc", "clang") if shutil.which(name)), None)
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler on this machine")


def compiled(paths, output, *flags):
    """Compiles and links C files; every warning is an error."""
    command = [COMPILER, *STRICT, *flags, *map(str, paths), "-o", str(output), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return output


def printed(program):
    """What a program prints, if it ends well."""
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


class Library:
    """A model as a shared library, its state as a structure of ctypes."""

    def __init__(self, model, folder, *flags):
        self.model = model
        paths = model.write(Path(folder))
        path = compiled(paths[:1], Path(folder) / f"{model.name}{next(COUNT)}.so", "-fPIC", "-shared", *flags)
        self.real = ctypes.c_float if "typedef float" in model.header else ctypes.c_double
        num_inputs = sum(field.size for field in model.inputs)
        members = [("t", self.real), *map(self._member, model.state), ("flags", ctypes.c_int)]
        members += [("u", self.real * num_inputs)] * bool(num_inputs)
        members += [("t0", self.real), ("dt", self.real), ("steps", ctypes.c_int64)]
        kinds = {f"{model.name}_real": self.real, "int32_t": ctypes.c_int32}
        for kind, field, size in re.findall(r"(\w+) (factors_\w+)\[(\d+)\];", model.header):
            members.append((field, kinds[kind] * int(size)))
        self.State = type("State", (ctypes.Structure,), {"_fields_": members})
        params = [self._member(field) for field in model.params] or [("none", ctypes.c_int)]
        self.Params = type("Params", (ctypes.Structure,), {"_fields_": params})
        library = ctypes.CDLL(str(path))
        self._init, self._step = (getattr(library, f"{model.name}_{name}") for name in ("init", "step"))
        self.defaults = self.Params.in_dll(library, f"{model.name}_defaults")

    def _member(self, field):
        return field.name, self.real * field.size if field.shape else self.real

    def array(self, x):
        """Numbers as C takes them."""
        numbers = np.ravel(np.asarray(x, float))
        return (self.real * numbers.size)(*numbers)

    def begin(self, *starts, t0=0.0, dt, params=None):
        """The state from q0, v0, z0 and inputs before, those that are there, and flags."""
        state = self.State()
        arrays = [self.array(x) for x in starts]
        params = self.defaults if params is None else params
        flags = self._init(ctypes.byref(state), ctypes.byref(params), *arrays, self.real(t0), self.real(dt))
        return state, flags

    def step(self, state, u=None, *, dt, params=None):
        """One step in place: flags."""
        params = self.defaults if params is None else params
        u = None if u is None else self.array(u)
        return self._step(ctypes.byref(state), ctypes.byref(params), u, self.real(dt))

    def run(self, state, num_steps, dt, inputs=None):
        """That many steps: flags."""
        for k in range(num_steps):
            self.step(state, None if inputs is None else inputs[k], dt=dt)
        return state.flags


def numbers(state, name):
    """A field of a state, flat."""
    return np.ravel(np.array(getattr(state, name)))
