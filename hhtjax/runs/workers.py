"""The part that runs on the workers of an executor: it compiles each program once, and runs it on the arrays it
receives.

A program is sent in the form that `jax.export` produces. No code of the user needs to be importable on a worker, which
needs hhtjax and the same version of JAX.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import VERSION

MOST = 16  # programs that a worker keeps
IMPORTED_BY = os.getpid()  # another one's in a process that was forked afterwards, in which JAX would wait for ever

_kept: OrderedDict[str, Callable] = OrderedDict()
_lock = threading.Lock()


class Unfit(RuntimeError):
    """A worker cannot run what it receives; trying again would not help."""


class Packed(NamedTuple):
    """A program to be sent. key: its hash, by which a worker identifies it; shared: arrays that it uses for all
    chunks."""

    key: str
    content: bytes
    shared: list


class _Content(NamedTuple):
    program: bytes  # of jax.export
    options: dict  # of the compiler
    x64: bool
    platform: str
    versions: dict


def versions() -> dict[str, str]:
    """The versions that must be the same on both sides."""
    return {"hhtjax": VERSION, "jax": version("jax")}


def packed(exported: jax.export.Exported, shared: list, options: dict) -> Packed:
    """The program of a function of lists, (shared, own) -> leaves, together with `shared`."""
    x64, platform = jnp.result_type(float) == np.float64, exported.platforms[0]
    content = _Content(bytes(exported.serialize()), options, x64, platform, versions())
    data = zlib.compress(pickle.dumps(tuple(content)))
    return Packed(hashlib.sha256(data).hexdigest(), data, [np.asarray(x, jnp.result_type(x)) for x in shared])


def results(program: Packed, own: list, ticket: Any) -> list[np.ndarray]:
    """Runs on a worker: the results of the program for the arrays of a chunk. ticket: makes tasks different from each
    other, because Dask runs equal tasks only once."""
    return _here(program)(program.shared, own)


def written(program: Packed, own: list, ticket: Any, write: Callable[[list], None]):
    """As `run`, with the results passed to a function that writes them on the worker."""
    write(results(program, own, ticket))


def _here(program: Packed) -> Callable:
    """The program, compiled in this process; if several threads need it, one compiles and the others wait."""
    if os.getpid() != IMPORTED_BY:
        raise Unfit(
            "a worker process was forked from one that had loaded JAX, which does not work: make the executor with "
            'ProcessPoolExecutor(..., mp_context=multiprocessing.get_context("spawn")).'
        )
    with _lock:
        if program.key not in _kept:
            _kept[program.key] = _compiled(_Content(*pickle.loads(zlib.decompress(program.content))))
            while len(_kept) > MOST:
                _kept.popitem(last=False)
        _kept.move_to_end(program.key)
        return _kept[program.key]


def _compiled(content: _Content) -> Callable:
    """The function (shared arrays, arrays of a chunk) -> results."""
    if content.versions != versions():
        raise Unfit(f"a worker must have the caller's versions, {content.versions}; it has {versions()}.")
    if (platform := jax.export.default_export_platform()) != content.platform:
        raise Unfit(
            f"a worker must compute on the caller's platform, {content.platform!r}; its JAX takes {platform!r}: set "
            "JAX_PLATFORMS there."
        )
    exported = jax.export.deserialize(bytearray(content.program))
    with _bits(content.x64):
        like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in exported.in_avals]
        arguments, _ = jax.tree.unflatten(exported.in_tree, like)
        call = jax.jit(exported.call, compiler_options=content.options).lower(*arguments).compile()

    def run(shared: list, own: list) -> list[np.ndarray]:
        with _bits(content.x64):
            return [np.asarray(x) for x in call(shared, own)]

    return run


def _bits(x64: bool):
    """A context in which JAX has 64 bits, or not, under the name that this version of JAX uses."""
    if hasattr(jax, "enable_x64"):
        return jax.enable_x64(x64)
    from jax.experimental import enable_x64  # type: ignore[attr-defined]

    return enable_x64(x64)
