"""Runs the members of a batch in chunks, by any executor with the interface of the standard library.

A task is a chunk of members: their arrays, and the program, which a worker compiles once (workers.py). A limited number
of tasks is submitted ahead. A failed task is tried again. Tasks that have not started are cancelled when the caller is
interrupted.
"""

from __future__ import annotations

import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterable
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import dataclass
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import jax
import numpy as np

from hhtjax.checks import require_integer
from hhtjax.description import PyTree, is_array
from hhtjax.runs.progress import bar, counted
from hhtjax.runs.workers import Packed, Unfit, packed, results
from hhtjax.xla import Programs

IN_FLIGHT, RETRIES = 1000, 2
PATIENCE = 0.5  # s, after which a caller that waits looks whether it has been interrupted


@partial(Programs, static_argnums=0)
def _run(f: Callable, shared: list, own: list) -> PyTree:
    return f(shared, own)


@partial(Programs, static_argnums=0)
def _leaves(f: Callable, shared: list, own: list) -> list:
    return jax.tree.leaves(_run.usual(f, shared, own))


class Chunks(NamedTuple):
    """The division of members 0, 1, ... size - 1 into chunks. The last chunk is padded with the last member."""

    size: int
    length: int

    @classmethod
    def of(cls, size: int, most: int) -> Chunks:
        """The smallest number of chunks with `most` members at most, of about equal lengths."""
        return cls(size, -(-size // -(-size // most)))

    @property
    def number(self) -> int:
        """The number of chunks."""
        return -(-self.size // self.length)

    def members(self, k: int) -> np.ndarray:
        """The members of a chunk, (length,)."""
        return np.minimum(np.arange(k * self.length, (k + 1) * self.length), self.size - 1)

    def kept(self, k: int) -> int:
        """How many members of a chunk are not padding."""
        return min(self.length, self.size - k * self.length)

    def named(self, k: int) -> str:
        """The members of a chunk in words, for messages."""
        first, last = k * self.length, k * self.length + self.kept(k) - 1
        return f"member {first}" if first == last else f"members {first} to {last}"


class Work(NamedTuple):
    """A function f(shared, own) of lists of arrays, hashable, and its arguments for each chunk.

    shared: arrays, and Python numbers, which are weakly typed; own: indices of members -> their arrays; fitting: the
    property of the system by which `Programs` choose; alone: the same function for this process, if it has its own
    programs for it."""

    f: Callable
    shared: list
    own: Callable[[np.ndarray], list]
    chunks: Chunks
    fitting: dict[str, Any]
    alone: Callable | None = None

    def arrays(self, k: int) -> list:
        """The arguments for a chunk."""
        return self.own(self.chunks.members(k))

    def like(self) -> PyTree:
        """Shapes and dtypes of the result."""
        return jax.eval_shape(partial(_run.usual, self.f), self.shared, self.arrays(0))

    def here(self, k: int) -> list[np.ndarray]:
        """The leaves of the result for a chunk, computed by this process."""
        given = self.shared, self.arrays(k)
        if self.alone is not None:
            return [np.asarray(x) for x in jax.tree.leaves(self.alone(*given))]
        return [np.asarray(x) for x in _leaves(self.f, *given, **self.fitting)]

    def text(self) -> str:
        """The program given to XLA, which identifies it."""
        return _leaves.lower(self.f, self.shared, self.arrays(0), **self.fitting).as_text()

    def packed(self, caller: str) -> Packed:
        """The program in the form that workers receive."""
        try:
            exported, options = _leaves.exported(self.f, self.shared, self.arrays(0), **self.fitting)
            return packed(exported, self.shared, options)
        except (NotImplementedError, ValueError) as error:
            if "callback" not in str(error):
                raise
            raise NotImplementedError(
                f"{caller}: with an `executor`, no function may call back to Python, which workers cannot do: "
                "leave out progress=True, and sparse systems, whose equations SciPy solves; or leave out `executor`."
            ) from error


@dataclass(frozen=True)
class Hands:
    """An executor and how tasks are given to it; made by `require_executor`."""

    caller: str
    executor: Executor
    in_flight: int
    retries: int
    progress: bool

    def work(self, task: Callable, chunks: Chunks, these: Iterable[int], arguments: Callable, take: Callable):
        """Runs task(*arguments(k, ticket)) for each of these chunks k, and calls take(k, result) for each result.
        ticket: a different one for each try."""
        waiting, flying, tries = deque(these), {}, Counter()
        ended: SimpleQueue[Future] = SimpleQueue()
        call, total, done = uuid.uuid4().hex, len(waiting), 0
        if self.progress:
            bar(done, total, "chunk")
        try:
            while waiting or flying:
                while waiting and len(flying) < self.in_flight:
                    k = waiting.popleft()
                    future = self._submitted(chunks.named(k), task, *arguments(k, (call, k, tries[k])))
                    flying[future] = k
                    future.add_done_callback(ended.put)
                future = _next(ended)
                k = flying.pop(future)
                try:
                    found = future.result()
                except Exception as error:
                    tries[k] += 1
                    self._require_another(chunks.named(k), error, tries[k])
                    waiting.append(k)
                    continue
                take(k, found)
                done += 1
                if self.progress:
                    bar(done, total, "chunk")
        finally:
            for future in flying:
                future.cancel()

    def _submitted(self, members: str, task: Callable, *arguments: Any) -> Future:
        try:
            future = self.executor.submit(task, *arguments)
        except BrokenExecutor as error:
            raise self._died(members) from error
        except RuntimeError as error:
            raise RuntimeError(f"{self.caller}: `executor` takes no tasks: {error}.") from error
        if not callable(getattr(future, "add_done_callback", None)):
            raise TypeError(
                f"{self.caller}: `executor.submit` must return a concurrent.futures.Future; received {future!r}."
            )
        return future

    def _require_another(self, members: str, error: Exception, tries: int):
        """Raises an error unless a failed task may be tried again."""
        if isinstance(error, BrokenExecutor):
            raise self._died(members) from error
        if isinstance(error, Unfit):
            raise RuntimeError(f"{self.caller}: {error}") from error
        if tries > self.retries:
            words = f"{self.caller}: {members} failed {tries} times, at last by {type(error).__name__}: {error}"
            if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
                words += "; a smaller `chunk` takes less"
            if isinstance(error, OSError) and error.errno:
                raise OSError(error.errno, words) from error
            raise RuntimeError(words) from error

    def _died(self, members: str) -> RuntimeError:
        return RuntimeError(
            f"{self.caller}: a worker died at {members}, or at members next to them. It was killed, often because "
            "memory ran out (a smaller `chunk` takes less), or it could not start: the call must stand under `if "
            "__name__ == '__main__':` in a script. This executor is broken: make another one, and repeat the call."
        )


def _next(ended: SimpleQueue) -> Future:
    """The next finished task; interruptions pass through."""
    while True:
        try:
            return ended.get(timeout=PATIENCE)
        except Empty:
            continue


def require_executor(
    caller: str, executor: Any, in_flight: int = IN_FLIGHT, retries: int = RETRIES, progress: bool = False
) -> Hands | None:
    """The `Hands` for an executor; None without one."""
    in_flight = require_integer(caller, "in_flight", in_flight)
    retries = require_integer(caller, "retries", retries, least=0)
    if executor is None:
        return None
    if not callable(getattr(executor, "submit", None)):
        raise TypeError(
            f"{caller}: `executor` must be a concurrent.futures.Executor, such as ProcessPoolExecutor(...), Dask's "
            f"client.get_executor() or MPIPoolExecutor(); received {executor!r}."
        )
    return Hands(caller, executor, in_flight, retries, progress)


def collected(work: Work, hands: Hands | None, progress: bool = False, program: Packed | None = None) -> PyTree:
    """The results of all members, as arrays of NumPy, by the workers or by this process. program: for the workers."""
    leaves, structure = jax.tree.flatten(work.like())
    chunks = work.chunks
    found = [np.empty((chunks.size, *x.shape[1:]), x.dtype) for x in leaves]

    def take(k: int, arrays: list):
        start, kept = k * chunks.length, chunks.kept(k)
        for x, y in zip(found, arrays, strict=True):
            x[start : start + kept] = y[:kept]

    if hands is not None:
        program = program or work.packed(hands.caller)
        hands.work(results, chunks, range(chunks.number), lambda k, ticket: (program, work.arrays(k), ticket), take)
    else:
        for k in counted(range(chunks.number), progress):
            take(k, work.here(k))
    return jax.tree.unflatten(structure, found)


def sent(x: Any) -> Any:
    """A leaf as an array of NumPy; weakly typed leaves, such as Python numbers, are unchanged."""
    return x if not is_array(x) or getattr(x, "weak_type", False) else np.asarray(x)
