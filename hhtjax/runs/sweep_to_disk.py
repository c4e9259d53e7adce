"""Sweeps, and functions of many members, that are written to disk in chunks and can be continued after an
interruption."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_integer, require_one_of
from hhtjax.description import PyTree, Real, all_concrete
from hhtjax.runs.adaptive import Adaptive
from hhtjax.runs.executors import IN_FLIGHT, RETRIES, Chunks, Work, require_executor, sent
from hhtjax.runs.output import require_output
from hhtjax.runs.parallel_map import work_of
from hhtjax.runs.progress import counted
from hhtjax.runs.storage import INPUTS, NUMBER, Names, Npz
from hhtjax.runs.sweep import run_sweep
from hhtjax.runs.sweep_controlled import sweep_chosen
from hhtjax.runs.sweep_inputs import Inputs
from hhtjax.runs.workers import versions, written
from hhtjax.runs.zarr_store import WRITTEN, Zarr
from hhtjax.steppers.stepper import Stepper
from hhtjax.systems.events import Event
from hhtjax.systems.system import AnySystem

if TYPE_CHECKING:
    from hhtjax.runs.executors import Hands
    from hhtjax.runs.solution import Solution

FORMATS = "npz", "zarr"
# of `Inputs`, as `run_sweep` takes them
ARRAYS = "system", "data", "dts", "duration", "t0", "times", "events", "output"

RESERVED = "file", "allow_pickle", NUMBER, INPUTS, WRITTEN


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
    executor: Executor | None = None,
    in_flight: int = IN_FLIGHT,
    retries: int = RETRIES,
    format: str = "npz",
) -> Path:
    """A `sweep` that processes `chunk` members at a time, and writes each chunk to its own file in `folder`.

    The files chunk-00000.npz, ... hold the leaves of the `Solution` by name ("q", "dt", "failure.step", ...), with
    members first. manifest.json holds the numbers of members and chunks, versions, and a hash of the inputs. The hash
    covers all values and the program given to XLA, so a changed force is noticed too. A file appears complete or not at
    all. If a sweep is interrupted, at any moment, repeat the call: it continues, and ends with the same files.

    With an executor, its workers run the chunks and write the files, in any order. They need access to the folder,
    hhtjax and the same version of JAX. Each worker compiles once. The values are the same as without an executor, bit
    by bit on processors of one kind. Several calls with the same inputs may write to one folder at the same time.

    Args:
        folder: created if it does not exist.
        chunk: largest number of members in a file, which limits the memory.
        progress: one line on stderr, rewritten with each file.
        executor: any `concurrent.futures.Executor`, as for `parallel_map`. None: this process.
        in_flight, retries: as for `parallel_map`.
        format: "npz", or "zarr": `folder` is then one Zarr store with the dimensions member, sample, ..., for
            `xarray.open_zarr`. It needs the packages of hhtjax[cluster].
        system, stepper, q0, v0, params, z0, dts, duration, num_samples, times, t0, in_axes, events, max_events,
            keep_events, output: those of `sweep`; `dts` also `adaptive(...)`.

    Returns:
        The folder. Read it by `load_sweep`, or file by file by `numpy.load`.

    Raises:
        ValueError: the folder holds a sweep with other inputs or versions.
        OSError: a file cannot be written, for example because the disk is full. Earlier files stay, and the same call
            continues.
        RuntimeError: with an executor: members failed, or a worker died. Files stay, and the same call continues.
        TypeError, ValueError, NotImplementedError: as `sweep` and `parallel_map`; also for tracers.

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
    caller = "sweep_to_disk"
    chunk = require_integer(caller, "chunk", chunk)
    grid = {"duration": duration, "num_samples": num_samples, "times": times, "t0": t0}
    inputs = Inputs.checked(system, stepper, q0, v0, params, z0=z0, dts=dts, in_axes=in_axes, **grid)
    inputs = inputs.with_events(events, max_events, keep_events)._replace(output=require_output(caller, output))
    if not all_concrete(inputs):
        raise TypeError("sweep_to_disk: arguments must not be tracers: call it outside jit, vmap and grad.")
    hands = require_executor(caller, executor, in_flight, retries, progress)
    require_one_of(caller, "format", format, FORMATS)
    by_errors = isinstance(inputs.dts, Adaptive)
    shortened = ("dt", "steps.dt") if by_errors else ()
    folder = Path(folder).absolute()  # of the caller, wherever workers run
    return _store(
        caller, folder, format, _work(inputs, chunk), hands, progress, shortened, "sample", inputs.num_samples + 1
    )


def map_to_disk(
    folder: str | Path,
    f: Callable[..., Any],
    *arguments: PyTree,
    executor: Executor | None = None,
    chunk: int,
    in_axes: Any = 0,
    in_flight: int = IN_FLIGHT,
    retries: int = RETRIES,
    progress: bool = False,
    format: str = "npz",
) -> Path:
    """`parallel_map` that writes each chunk to its own file in `folder`, for long work or results larger than memory.

    If it is interrupted, at any moment, repeat the call: it continues. Files are like those of `sweep_to_disk`, with
    the names of the leaves that f returns: "a.b" for {"a": {"b": ...}}, "result" for a single array.

    Args:
        folder: created if it does not exist.
        format: as for `sweep_to_disk`.
        f, arguments, executor, chunk, in_axes, in_flight, retries, progress: those of `parallel_map`.

    Returns:
        The folder, for `load_sweep`.

    Raises:
        ValueError: the folder holds results of other inputs or versions.
        OSError: a file cannot be written. Earlier files stay, and the same call continues.
        TypeError, ValueError, NotImplementedError, RuntimeError: as `parallel_map`.

    >>> import tempfile, jax.numpy as jnp, hhtjax
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     where = hhtjax.map_to_disk(folder, lambda x: {"square": x**2}, jnp.arange(5.0), chunk=2)
    ...     print(hhtjax.load_sweep(where)["square"])
    [ 0.  1.  4.  9. 16.]
    """
    caller = "map_to_disk"
    work = work_of(caller, f, arguments, in_axes, chunk)
    hands = require_executor(caller, executor, in_flight, retries, progress)
    require_one_of(caller, "format", format, FORMATS)
    return _store(caller, Path(folder).absolute(), format, work, hands, progress)


def _store(
    caller: str,
    folder: Path,
    format: str,
    work: Work,
    hands: Hands | None,
    progress: bool,
    shortened: tuple = (),
    axis: str | None = None,
    length: int = 0,
) -> Path:
    """Writes the chunks that are missing. shortened: names of arrays whose last axis is cut to the largest number of
    steps in a chunk; axis: the name of second axes of this length."""
    chunks, paths = work.chunks, jax.tree_util.tree_leaves_with_path(work.like())
    names = Names(tuple(jax.tree_util.keystr(path, simple=True, separator=".") or "result" for path, _ in paths))
    like = [x for _, x in paths]
    _require_names(caller, names.all, like)
    inputs = _hash(work)
    manifest = {"inputs": inputs, "members": chunks.size, "chunk": chunks.length, "chunks": chunks.number}
    manifest["versions"] = versions() | {"numpy": np.__version__}
    if format == "zarr":
        dims = tuple(_dims(name, x.shape, axis, length) for name, x in zip(names.all, like, strict=True))
        store = Zarr(caller, folder, inputs, names, dims, chunks.length)
        store.begin(manifest, like)
    else:
        if shortened:
            names = names._replace(shortened=tuple(x for x in shortened if x in names.all), by="steps.accepted")
            manifest["shortened"] = list(names.shortened)
        store = Npz(caller, folder, inputs, names)
        store.begin(manifest)
    left = store.left(chunks.number)
    if hands is None:
        for k in counted(left, progress):
            store.write(k, chunks.kept(k), work.here(k))
    elif left:
        program = work.packed(caller)

        def arguments(k: int, ticket: tuple):
            return program, work.arrays(k), ticket, partial(store.write, k, chunks.kept(k))

        hands.work(written, chunks, left, arguments, lambda k, result: None)
        if lost := store.missing(left):
            raise RuntimeError(
                f"{caller}: workers wrote {len(lost)} chunks that are not in {folder}: all must have access to the "
                "same folder."
            )
    store.end()
    return folder


def _require_names(caller: str, names: tuple[str, ...], like: list):
    """Raises an error for results that files cannot hold under their names, or at all."""
    for name, x in zip(names, like, strict=True):
        if names.count(name) > 1 or name in RESERVED or "/" in name:
            raise ValueError(
                f"{caller}: results must have unique names, without '/', and not {', '.join(RESERVED)}; received "
                f"{name!r}."
            )
        if x.dtype.kind not in "biufc":
            raise TypeError(f"{caller}: results must be of a dtype of NumPy; received {x.dtype} for {name!r}.")


def _dims(name: str, shape: tuple, axis: str | None, length: int) -> tuple[str, ...]:
    """Names of the axes after the axis of members."""
    names = [f"{name}_{i}" for i in range(1, len(shape))]
    is_sampled = shape[1:2] == (length,) and not name.startswith(("dt", "steps", "events", "failure"))
    return (axis, *names[1:]) if axis and is_sampled else tuple(names)


def _hash(work: Work) -> str:
    """The hash of the program and all its arguments."""
    digest = hashlib.sha256(work.text().encode())
    for x in [*work.shared, *work.own(np.arange(work.chunks.size))]:
        x = np.ascontiguousarray(x)
        digest.update(f"{x.shape} {x.dtype}".encode())
        digest.update(x.data if x.size else b"")
    digest.update(f"{work.chunks.length}".encode())
    return digest.hexdigest()


# ----------------------------------------------------------------------------
# A sweep as a function of lists of arrays.


def _work(inputs: Inputs, chunk: int) -> Work:
    """The `Work` of a sweep."""
    chunks = Chunks.of(inputs.size, chunk)
    by_errors = isinstance(inputs.dts, Adaptive)
    if by_errors:
        static, fitting = {}, {"rates": inputs.sizes()[1]}
    else:
        _, static = inputs.chunk(chunks.members(0)).call()
        fitting = {name: static.pop(name) for name in ("rates", "numbers")}
    tree = tuple(getattr(inputs, name) for name in ARRAYS)
    leaves, structure = jax.tree.flatten(tree)
    of_dts = [jnp.ndim(x) > 0 for x in jax.tree.leaves(inputs.dts)]
    behind = jax.tree.leaves(tree[3:])
    mapped = [False] * len(jax.tree.leaves(inputs.system)) + [*inputs.mapped, *of_dts] + [False] * len(behind)
    shared = [sent(x) for x, flag in zip(leaves, mapped, strict=True) if not flag]
    of_members = [np.asarray(x) for x, flag in zip(leaves, mapped, strict=True) if flag]
    rest = inputs._replace(size=chunks.length, **dict.fromkeys(ARRAYS))
    f = _Swept(structure, tuple(mapped), tuple(rest), tuple(sorted(static.items())), by_errors)
    alone = partial(f, program=partial(run_sweep, **fitting))  # that of `sweep`
    return Work(f, shared, lambda members: [x[members] for x in of_members], chunks, fitting, alone)


@dataclass(frozen=True)
class _Swept:
    """The `Solution` of a chunk. rest: the parts of `Inputs` that are not arrays; static: keywords of `run_sweep`."""

    structure: Any
    mapped: tuple
    rest: tuple
    static: tuple
    by_errors: bool

    def __call__(self, shared: list, own: list, program: Callable = run_sweep.usual) -> Solution:
        parts = iter(shared), iter(own)
        tree = jax.tree.unflatten(self.structure, [next(parts[flag]) for flag in self.mapped])
        if not self.by_errors:
            return program(*tree, **dict(self.static))
        return sweep_chosen(Inputs(*self.rest)._replace(**dict(zip(ARRAYS, tree, strict=True))), False)
