"""A word to who waits: one line, where JAX traces or compiles a program of ours for more than two seconds."""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Callable
from functools import wraps
from types import FrameType
from typing import Any

import jax

from hhtjax.description import PyTree

PATIENCE = 2.0  # s
COMPILED = "/jax/core/compile/backend_compile_duration"  # the event of JAX after a program was compiled, or loaded
LOG = logging.getLogger("hhtjax")  # what is not configured writes to stderr

_clocks: dict[int, _Clock] = {}  # by thread
_hinted: list[bool] = []
_listening: list[bool] = []


class _Clock:
    """Runs from the first sign of a program that is not compiled yet, in a thread of its own."""

    def __init__(self, thread: int):
        self.thread = thread
        self.frame: FrameType | None = None  # while it is there, the program is not done
        self.timer = threading.Timer(PATIENCE, self.ring)
        self.timer.daemon = True
        self.timer.start()

    def ring(self):
        """Two seconds are over."""
        if _clocks.pop(self.thread, None) is not self:
            return
        waited_for, self.frame = self.frame, None
        if waited_for is not None and any(x is waited_for for x in _stack(sys._current_frames().get(self.thread))):
            LOG.warning(_words())


def tell_if_long():
    """From here on, until JAX has compiled a program in this thread, or the call of JAX that leads here has ended."""
    here = sys._getframe(1)
    thread = threading.get_ident()
    clock = _clocks.get(thread)
    if clock is None:
        _listen()
        clock = _clocks[thread] = _Clock(thread)
    of_jax = [x for x in _stack(here) if x.f_globals.get("__name__", "").startswith("jax.")]
    clock.frame = of_jax[-1] if of_jax else here


def telling_if_long(f: Callable) -> Callable:
    """The function f, which JAX calls in order to trace it: never for a program that is compiled."""

    @wraps(f)
    def traced(*args: PyTree, **keywords: PyTree) -> PyTree:
        tell_if_long()
        return f(*args, **keywords)

    return traced


def _stack(frame: FrameType | None):
    """The frame and those that called it."""
    while frame is not None:
        yield frame
        frame = frame.f_back


def _words() -> str:
    """The line; how to wait less is said once in a process."""
    words = f"hhtjax: tracing or compiling a program for {PATIENCE:.3g} s by now; only its first call takes so long."
    if getattr(jax.config, "jax_compilation_cache_dir") or _hinted:  # noqa: B009
        return words
    _hinted.append(True)
    return f"{words} Other processes can load it: hhtjax.keep_programs(folder)."


def _stop(event: str, duration_secs: float, **_: Any):
    if event == COMPILED and (clock := _clocks.pop(threading.get_ident(), None)) is not None:
        clock.frame = None
        clock.timer.cancel()


def _listen():
    """Once in a process."""
    if not _listening:
        _listening.append(True)
        jax.monitoring.register_event_duration_secs_listener(_stop)
