"""First calls, which compile: compiled programs are kept on disk, and a message explains a long wait."""

from __future__ import annotations

import atexit
import hashlib
import logging
import multiprocessing
import os
import platform
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import jax
from jax.experimental.compilation_cache import compilation_cache

from hhtjax.checks import require_integer
from hhtjax.description import PyTree
from hhtjax.description.presentation import is_terminal, overwrite

# ----------------------------------------------------------------------------
# Compiled programs that outlive their process: JAX's cache on disk, with a bound on its size.

SETTINGS = {  # settings of JAX, besides the folder
    "jax_enable_compilation_cache": True,
    "jax_persistent_cache_min_compile_time_secs": 0.0,  # small programs, too: loading takes a third of compiling
    "jax_persistent_cache_min_entry_size_bytes": -1,
    "jax_compilation_cache_max_size": -1,  # JAX's own bound needs a package that we do not depend on
}
WRITTEN = "/jax/compilation_cache/cache_misses"  # the event of JAX before a program is written
EVERY = 50  # number of written programs after which the size of the folder is checked


class _Kept(NamedTuple):
    """Where programs are kept, the limit on their size, and the previous settings of JAX."""

    folder: Path
    max_bytes: int
    before: dict[str, Any]


_kept: _Kept | None = None
_written: int | None = None  # number of programs written so far; None before the listener is registered


def keep_programs(folder: str | os.PathLike[str] | None, max_bytes: int = 1_000_000_000) -> Path | None:
    """Keeps compiled programs in a folder, from which other processes load them. This halves the time of first calls.

    Call it before the first run, in every process. Without this call no programs are kept. A kept program is found by
    its operations, the versions of JAX and XLA, and the compiler options. So code that has changed is compiled again.
    Tracing, in Python, is still needed.

    This is a setting of JAX for the whole process. It also keeps the programs of other libraries. It is the same as
    JAX's own setting `jax_compilation_cache_dir`, with a limit on the size.

    If the programs take more than `max_bytes`, those that have not been read for the longest time are deleted. This
    happens in this call, after every 50 programs that are written, and when the process ends. Other files in the folder
    are not touched. Each type of processor has its own subfolder, because programs may use instructions that other
    processors lack.

    Security: anybody who can write to the folder can run code in your process. Do not share it with people whom you do
    not trust.

    Args:
        folder: path of the folder, which is created if necessary; "~" is your home. None restores the settings of JAX
            from before the first call.
        max_bytes: limit on the size of all programs together, on disk.

    Returns:
        The folder with the programs for this type of processor; None if `folder` is None.

    Raises:
        TypeError: `folder` is not a path.
        ValueError: `max_bytes` is not a positive integer.
        OSError: the folder cannot be created, or cannot be written to.

    References:
        https://docs.jax.dev/en/latest/persistent_compilation_cache.html

    >>> import tempfile, jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, params: -9.0 * q)
    >>> with tempfile.TemporaryDirectory() as folder:            # of your own, say "~/.cache/hhtjax"
    ...     where = hhtjax.keep_programs(folder, max_bytes=200_000_000)
    ...     run = hhtjax.simulate(spring, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), dt=0.01, num_steps=3)
    ...     number = len(list(where.iterdir()))
    ...     hhtjax.keep_programs(None)                           # here alone: the folder is deleted
    >>> number > 0
    True
    """
    global _kept
    max_bytes = require_integer("keep_programs", "max_bytes", max_bytes)
    before = {name: getattr(jax.config, name) for name in ("jax_compilation_cache_dir", *SETTINGS)}
    if _kept is not None:
        before = _kept.before
    if folder is None:
        if _kept is not None:
            _set(before)
        _kept = None
        return None
    where = _made(folder)
    _kept = _Kept(where, max_bytes, before)
    _set({"jax_compilation_cache_dir": str(where), **SETTINGS})
    _look_through()
    _listen()
    return where


def _made(folder) -> Path:
    """Makes the subfolder for this type of processor, and checks that it can be written to."""
    if not isinstance(folder, (str, os.PathLike)) or isinstance(os.fspath(folder), bytes) or not os.fspath(folder):
        raise TypeError(f"keep_programs: `folder` must be the path of a folder, or None; received {folder!r}.")
    where = Path(folder).expanduser().absolute() / f"programs-{_processor()}"
    try:
        where.mkdir(parents=True, exist_ok=True)
        probe = where / f"probe-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise OSError(
            f"keep_programs: `folder` must be one that can be written to; received {os.fspath(folder)!r} ({error})."
        ) from error
    return where


def _processor() -> str:
    """A name for the processor and its instruction sets, for which programs are compiled."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    except OSError:
        flags = platform.processor()
    return hashlib.sha256(f"{platform.machine()} {flags}".encode()).hexdigest()[:12]


def _set(settings: dict[str, Any]):
    for name, value in settings.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()  # otherwise JAX keeps using the folder that it has opened


def _listen():
    """Counts the programs that JAX writes, from the first call on."""
    global _written
    if _written is None:
        _written = 0
        jax.monitoring.register_event_listener(_count)
        atexit.register(_look_through)


def _count(event: str, **_):
    global _written
    if event == WRITTEN and _written is not None and _kept is not None:
        _written += 1
        if _written % EVERY == 0:
            _look_through()


def _look_through():
    """Deletes the programs that have not been read for the longest time, until the rest is within the limit."""
    if _kept is None:
        return
    found = []
    for path in _kept.folder.glob("*-cache"):
        try:  # another process may have deleted it
            x = path.stat()
        except OSError:
            continue
        found.append((max(x.st_atime, x.st_mtime), x.st_size, path))
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= _kept.max_bytes:
            break
        try:
            path.unlink(missing_ok=True)
        except OSError:
            continue
        total -= size


# ----------------------------------------------------------------------------
# A message if JAX traces or compiles a program of this library for more than two seconds: in a terminal a line with the
# time so far, elsewhere one message by `logging`.

PATIENCE = 2.0  # s
LATER = 20.0  # s, after the first message by `logging`: a script may compile ten programs that take a few seconds each
PERIOD = 0.25  # s between two checks whether the program is done; the line counts in seconds
GOODBYE = 1.0  # s that the end of a call waits at most for the line to be closed
COMPILED = "/jax/core/compile/backend_compile_duration"  # the event of JAX after a program was compiled, or loaded
LOG = logging.getLogger("hhtjax")  # without configuration it writes to stderr

_clocks: dict[int, _Clock] = {}  # by thread
_hinted: list[bool] = []
_logged: list[bool] = []
_watching: list[bool] = []


class _Clock:
    """Measures the time from the start of tracing until a program is compiled, in a thread of its own.

    Only this thread writes. The thread that compiles waits for it at most `GOODBYE` and takes no lock, so neither can
    block the other.
    """

    def __init__(self, thread: int):
        self.thread = thread
        self.frame: FrameType | None = None  # while it is on the stack of the thread, the program is not compiled
        self.begun = time.monotonic()
        self.is_compiled = self.is_shown = False
        self.over = threading.Event()
        self.writer = threading.Thread(target=self.run, name="hhtjax-first-call", daemon=True)
        self.writer.start()

    def run(self):
        """Runs until the program is compiled, or tracing or compilation has ended with an error."""
        patience = PATIENCE if _is_rewritable() or not _logged else LATER
        if not self.over.wait(patience) and self.is_needed():
            self.tell(patience)
        self.frame = None
        if _clocks.get(self.thread) is self:
            del _clocks[self.thread]

    def is_needed(self) -> bool:
        """Whether the thread still waits for the program."""
        waited_for = self.frame
        return waited_for is not None and any(x is waited_for for x in _stack(sys._current_frames().get(self.thread)))

    def tell(self, patience: float):
        """Shows the message, after so many seconds."""
        if not _is_rewritable():
            LOG.warning(_words(patience))
            _logged.append(True)
            while not self.over.wait(PERIOD) and self.is_needed():
                pass  # one message is enough
            return
        self.is_shown = True
        with suppress(OSError, ValueError):  # the terminal is gone
            second = -1
            while not self.over.is_set() and self.is_needed():
                if self.seconds() >= second + 1:
                    second = int(self.seconds())
                    overwrite(f"hhtjax: compiling ... ({second} s)", last=False)
                self.over.wait(PERIOD)
            if self.is_compiled:
                overwrite(f"hhtjax: compiled in {self.seconds():.1f} s" + _hint(". "), last=True)
            else:
                overwrite("", last=False)

    def seconds(self) -> float:
        """The time so far."""
        return time.monotonic() - self.begun

    def stop(self, is_compiled: bool = False, is_final: bool = False):
        """Ends the message: the program is compiled, or has failed. Later output begins on a new line."""
        self.is_compiled = is_compiled
        self.over.set()
        if self.is_shown or is_final:
            self.writer.join(GOODBYE)


def tell_if_long():
    """Starts the clock of this thread. It stops when JAX has compiled a program in this thread, or when the call of JAX
    that led here has ended."""
    here = sys._getframe(1)
    thread = threading.get_ident()
    clock = _clocks.get(thread)
    if clock is None:
        _watch()
        clock = _clocks[thread] = _Clock(thread)
    of_jax = [x for x in _stack(here) if x.f_globals.get("__name__", "").startswith("jax.")]
    clock.frame = of_jax[-1] if of_jax else here


def telling_if_long(f: Callable) -> Callable:
    """The function f with a clock around it. JAX calls it only to trace it, not if the program is already compiled."""

    @wraps(f)
    def traced(*args: PyTree, **keywords: PyTree) -> PyTree:
        tell_if_long()
        try:
            return f(*args, **keywords)
        except BaseException:
            _stop()
            raise

    return traced


def _stack(frame: FrameType | None):
    """Yields the frame and its callers."""
    while frame is not None:
        yield frame
        frame = frame.f_back


def _is_rewritable() -> bool:
    """Whether a line that counts seconds may be used: in a terminal, if no other process or thread writes such a line,
    and if `logging` is not configured to send the message elsewhere or to suppress it."""
    alone = multiprocessing.parent_process() is None and not any(x.is_shown for x in list(_clocks.values()))
    return alone and is_terminal() and LOG.isEnabledFor(logging.WARNING) and not LOG.hasHandlers()


def _words(patience: float) -> str:
    """The message for `logging`."""
    words = f"hhtjax: tracing or compiling a program for {patience:.3g} s by now; only its first call takes so long."
    return words + _hint(" ")


def _hint(before: str) -> str:
    """Advice on how to wait less, after the text `before`; only once in a process, otherwise empty."""
    if getattr(jax.config, "jax_compilation_cache_dir") or _hinted:  # noqa: B009
        return ""
    _hinted.append(True)
    return f"{before}Other processes can load it: hhtjax.keep_programs(folder)."


def _stop(is_compiled: bool = False):
    """Stops the clock of this thread, if there is one."""
    if (clock := _clocks.pop(threading.get_ident(), None)) is not None:
        clock.stop(is_compiled)


def _listener(event: str, duration_secs: float, **_: Any):
    if event == COMPILED:
        _stop(is_compiled=True)


def _stop_all():
    """Stops all clocks when the interpreter ends, because no thread may write then."""
    for clock in list(_clocks.values()):
        clock.stop(is_final=True)


def _watch():
    """Registers the listeners, once in a process."""
    if not _watching:
        _watching.append(True)
        jax.monitoring.register_event_duration_secs_listener(_listener)
        atexit.register(_stop_all)
