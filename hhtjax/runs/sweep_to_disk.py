"""Sweeps that are written to disk as they go, and taken up again where they stopped."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import zipfile
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hhtjax.checks import require_integer
from hhtjax.description import VERSION, PyTree, Real, all_concrete
from hhtjax.runs.adaptive import Adaptive
from hhtjax.runs.output import require_output
from hhtjax.runs.sweep import run_sweep
from hhtjax.runs.sweep_inputs import Inputs
from hhtjax.steppers.stepper import Stepper
from hhtjax.systems.events import Event
from hhtjax.systems.system import AnySystem


def sweep_to_disk(
    folder: str | Path,
    system: AnySystem,
    stepper: Stepper,
    q0: PyTree,
    v0: PyTree = None,
    params: PyTree = None,
    *,
    z0: PyTree = None,
    dts: Real,
    duration: Real = None,
    num_samples: int | None = None,
    times: Real | None = None,
    t0: Real = 0.0,
    in_axes: PyTree = None,
    chunk: int = 4096,
    progress: bool = False,
    events: Sequence[Event] | None = None,
    max_events: int = 2,
    keep_events: int = 100,
    output: Callable | None = None,
) -> Path:
    """The same as `sweep`, `chunk` members at a time, each chunk written to a file of its own in `folder`.

    chunk-00000.npz, ... hold the leaves of the `Solution` by name ("q", "dt", "failure.step", ...), members first;
    manifest.json the numbers of members and chunks, versions, and a hash of the inputs: of all values, and of the
    program that XLA is given, so that a changed force is noticed too. A file appears with its whole content or not at
    all. A sweep that was interrupted, at whatever moment, is continued by the same call, and ends with the same files.
    One process at a time may write to a folder.

    Args:
        folder: made if it does not exist.
        chunk: members in a file, which bounds the memory.
        progress: one line on stderr for each file.
        system, stepper, q0, v0, params, z0, dts, duration, num_samples, times, t0, in_axes, events, max_events,
            keep_events, output: those of `sweep`.

    Returns:
        The folder, to be read by `load_sweep`, or by `numpy.load` file by file.

    Raises:
        ValueError: the folder holds a sweep of other inputs or versions.
        OSError: a file cannot be written, such as on a full disk; those before it stay, and the same call goes on.
        TypeError, ValueError, NotImplementedError: as `sweep`; also for tracers, and for `adaptive`.

    >>> import tempfile, jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, params: -4.0 * q)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     where = hhtjax.sweep_to_disk(
    ...         folder, spring, hhtjax.hht(), jnp.ones(1), jnp.zeros(1),
    ...         dts=jnp.array([0.1, 0.05, 0.01]), duration=1.0, num_samples=5, chunk=2)
    ...     found = hhtjax.load_sweep(where)
    >>> found["q"].shape                                                             # members, samples, coordinates
    (3, 6, 1)
    """
    chunk = require_integer("sweep_to_disk", "chunk", chunk)
    if isinstance(dts, Adaptive):
        raise NotImplementedError("sweep_to_disk: `dts` must be step sizes; adaptive(...) is for `sweep`.")
    grid = {"duration": duration, "num_samples": num_samples, "times": times, "t0": t0}
    inputs = Inputs.checked(system, stepper, q0, v0, params, z0=z0, dts=dts, in_axes=in_axes, **grid)
    inputs = inputs.with_events(events, max_events, keep_events)._replace(
        output=require_output("sweep_to_disk", output)
    )
    if not all_concrete(inputs):
        raise TypeError("sweep_to_disk: all arguments must be known: call it outside jit, vmap and grad.")
    folder, size = Path(folder), inputs.dts.size
    places = np.minimum(np.arange(-(-size // chunk) * chunk), size - 1).reshape(-1, chunk)  # the last one fills up
    arguments, keywords = inputs.chunk(places[0]).call()
    lowered = run_sweep.lower(*arguments, **keywords)
    _claim(folder, _manifest(inputs, lowered, chunk, len(places)))
    for number, members in enumerate(places):
        path = folder / f"chunk-{number:05d}.npz"
        if not _is_whole(path):
            runs = run_sweep(*inputs.chunk(members).call()[0], **keywords)
            kept = min(chunk, size - number * chunk)
            _write(path, lambda file, runs=runs, kept=kept: np.savez(file, **_named(runs, kept)))
        if progress:
            print(f"[chunk {number + 1} of {len(places)}] {path}", file=sys.stderr, flush=True)
    return folder


def load_sweep(folder: str | Path) -> dict[str, np.ndarray]:
    """What `sweep_to_disk` wrote: the leaves of the `Solution` by name, members first.

    Args:
        folder: where `sweep_to_disk` wrote to.

    Returns:
        Arrays by name: "t", "q", "v", "dt", "failure.step", ...; their first axis is that of the members.

    Raises:
        FileNotFoundError: the folder holds no sweep, or a chunk is missing, because the sweep is not finished.
        ValueError: a file is damaged.

    >>> import hhtjax
    >>> hhtjax.load_sweep("no such folder")  # doctest: +IGNORE_EXCEPTION_DETAIL
    Traceback (most recent call last):
    FileNotFoundError: ...
    """
    folder = Path(folder)
    manifest = folder / "manifest.json"
    if not manifest.is_file():
        raise FileNotFoundError(f"load_sweep: `folder` must hold a sweep; received {folder}, without a manifest.json.")
    chunks = _read(manifest).get("chunks")
    if not isinstance(chunks, int):
        raise ValueError(f"load_sweep: {manifest} is damaged: make the sweep anew in another folder.")
    paths = [folder / f"chunk-{number:05d}.npz" for number in range(chunks)]
    missing = [path.name for path in paths if not path.exists()]
    if missing:
        raise FileNotFoundError(
            f"load_sweep: {len(missing)} of {chunks} chunks are missing in {folder}, the first is {missing[0]}: "
            "repeat the call of sweep_to_disk, which goes on where it stopped."
        )
    parts = []
    for path in paths:
        try:
            with open(path, "rb") as file, np.load(file) as part:
                parts.append(dict(part))
        except (ValueError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(
                f"load_sweep: {path} is damaged ({error}): repeat the call of sweep_to_disk, which makes it anew."
            ) from error
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _named(runs, kept) -> dict[str, Any]:
    """The first members' leaves as NumPy arrays."""
    leaves = jax.tree_util.tree_leaves_with_path(runs)
    return {jax.tree_util.keystr(path, simple=True, separator="."): np.asarray(x)[:kept] for path, x in leaves}


def _manifest(inputs, lowered, chunk, chunks):
    digest = hashlib.sha256(lowered.as_text().encode())
    for x in jax.tree.leaves(inputs):
        x = np.asarray(x)
        digest.update(f"{x.shape} {x.dtype}".encode() + x.tobytes())
    return {
        "inputs": digest.hexdigest(),
        "members": int(inputs.dts.size),
        "chunk": chunk,
        "chunks": chunks,
        "versions": {"hhtjax": VERSION, "jax": version("jax"), "numpy": np.__version__},
    }


def _claim(folder, manifest):
    """Writes the manifest, or compares it with the one that is there."""
    path = folder / "manifest.json"
    if not path.exists():
        if stray := sorted(folder.glob("chunk-*.npz")):
            raise ValueError(
                f"sweep_to_disk: `folder` {folder} holds {stray[0].name}, but no manifest.json that tells of which "
                "sweep: nothing was changed there; choose another folder, or empty it."
            )
        folder.mkdir(parents=True, exist_ok=True)
        _write(path, lambda file: file.write(json.dumps(manifest, indent=1).encode() + b"\n"))
        return
    found = _read(path)
    differ = [key for key in manifest if found.get(key) != manifest[key]]
    if differ:
        raise ValueError(
            f"sweep_to_disk: `folder` {folder} holds another sweep, whose {', '.join(differ)} differ: nothing was "
            "changed there; choose another folder, or the inputs that it was begun with."
        )


def _read(path):
    """A manifest; nothing of one that is damaged."""
    try:
        found = json.loads(path.read_text())
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _is_whole(path):
    """Whether a chunk is there and can be read, by the checksums inside it."""
    try:
        with zipfile.ZipFile(path) as file:
            return file.testzip() is None
    except (OSError, zipfile.BadZipFile):
        return False


def _write(path, fill):
    """A file that is there with its whole content, also after a power cut, or not at all."""
    temporary = path.with_name(f".{path.name}.part")
    try:
        with open(temporary, "wb") as file:
            fill(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        if os.name == "posix":
            descriptor = os.open(path.parent, os.O_RDONLY)
            os.fsync(descriptor)
            os.close(descriptor)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OSError(
            error.errno,
            f"sweep_to_disk: {path} could not be written ({error.strerror}); the files before it are whole: "
            "make room, and repeat the call, which goes on where it stopped",
        ) from error
