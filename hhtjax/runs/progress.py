"""Progress on stderr: a bar of tqdm if it is installed, otherwise one line that is overwritten.

The bar of a run is drawn between blocks of steps, so that the steps of a block stay one kernel.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array
from hhtjax.description.presentation import overwrite

MOST = 100  # times that a bar is drawn in a run, about
LEAST = 30_000  # steps between two drawings, with one unknown: they take 1.5 ms, a drawing 0.15 ms
WIDTH, SHORTEST, LONGEST = 76, 10, 30  # characters: of the line without brackets, and limits of the bar in it
FORMAT = "{percentage:3.0f} %|{bar}| {desc}"  # format of a tqdm bar

# ----------------------------------------------------------------------------
# The line. A process has only one, because it has one terminal.


class _Line:
    """The line of one call. done: the work done when it is first drawn; total: None if it is unknown."""

    def __init__(self, done: int, total: int | None):
        self.first = self.done = done
        self.total, self.begun = total, time.monotonic()
        self.paced: tuple[float, int] | None = None  # time and work done from which the pace is measured
        self.bar: Any = None

    def goes_on(self, done: int, total: int | None) -> bool:
        """Whether this drawing belongs to the same call. A call that was interrupted leaves its line behind."""
        return total == self.total and not done <= self.first < self.done

    def draw(self, text: str, done: int, last: bool):
        """Draws the line: a text, the elapsed time and the remaining time."""
        text += self.times(done, last)
        if self.bar is None and (tqdm := _tqdm()) is not None:
            self.bar = tqdm(total=self.total, initial=done, desc=text, bar_format=FORMAT if self.total else "{desc}")
        self.done = done
        if self.bar is None:
            overwrite(self.in_characters(text), last)
            return
        self.bar.n = done
        self.bar.set_description_str(text)  # this draws the bar
        if last:
            self.bar.close()

    def times(self, done: int, last: bool) -> str:
        """The elapsed and the remaining time, in words. The first part of the work is left out of the pace, because it
        may include compilation."""
        now = time.monotonic()
        words = f", {_in_words(now - self.begun)}" if now - self.begun >= 1 else ""
        if self.paced is None:
            self.paced = (now, done) if done > self.first else None
        elif words and self.total is not None and done > self.paced[1] and not last:
            left = (now - self.paced[0]) * (self.total - done) / (done - self.paced[1])
            words += f", {_in_words(left)} left"
        return words

    def in_characters(self, text: str) -> str:
        """The bar in characters, and a text."""
        if self.total is None:
            return text
        length = min(LONGEST, max(SHORTEST, WIDTH - len(text)))
        return f"[{'#' * (self.done * length // self.total):<{length}}] {text}"

    def drop(self):
        """Removes the line, because another one takes its place."""
        if self.bar is not None:
            self.bar.leave = False
            self.bar.close()


_line: _Line | None = None
_lock = threading.RLock()  # callbacks run in threads of JAX


def rewrite(text: str, last: bool, done: int = 0, total: int | None = None):
    """Rewrites the line: a text, and how much of the total is done. With `last` the line stays."""
    global _line
    with _lock:
        if _line is not None and not _line.goes_on(done, total):
            _line.drop()
            _line = None
        _line = _line or _Line(done, total)
        _line.draw(text, done, last)
        if last:
            _line = None


def _tqdm() -> Any:
    """The class of tqdm bars for a terminal or a notebook; None without tqdm."""
    try:
        from tqdm.auto import tqdm
    except ImportError:
        return None
    return tqdm


def _in_words(seconds: float) -> str:
    """A time in words, to about two digits."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


# ----------------------------------------------------------------------------
# Progress of calls that do one part after the other, in Python.


def bar(count: int, total: int, what: str):
    """Draws that `count` of `total` are done."""
    rewrite(f"{what} {count} of {total}", count == total, count, total)


def counted(chunks: Sequence[int], progress: bool) -> Iterator[int]:
    """Yields the chunks one after the other, and draws a bar of those that are done."""
    for done, k in enumerate(chunks):
        if progress:
            bar(done, len(chunks), "chunk")
        yield k
    if progress and chunks:
        bar(len(chunks), len(chunks), "chunk")


@contextmanager
def stages(caller: str, progress: bool, total: int | None = None) -> Iterator[Callable[..., None]]:
    """A context with a function tell(what, work) that shows what the call does next. Without `progress` it shows
    nothing.

    The last line stays, also if an error ends the call. total: the sum of all work; None if it is unknown.
    """
    done, ahead, text = 0, 0, ""

    def tell(what: str, work: int = 1):
        nonlocal done, ahead, text
        done, ahead, text = done + ahead, work, f"{caller}: {what}"
        if progress:
            rewrite(text, False, done, total)

    try:
        yield tell
        done += ahead
    finally:
        if progress and text:
            rewrite(text, True, done, total)


# ----------------------------------------------------------------------------
# Progress of compiled programs, drawn from within them.


def announce():
    """Shows on the line of the bar that a program is being compiled. Call it during tracing: then it is shown only if
    the program is compiled."""
    rewrite("compiling ...", last=False)


def show_progress(count: Array, total: int, what: str):
    """Draws a bar about a hundred times in a run."""
    every = max(1, total // MOST)
    lax.cond((count % every == 0) | (count == total), lambda: draw(count, total, what), lambda: None)


def draw(count: Array, total: int, what: str):
    """Draws the bar by a callback."""

    jax.debug.callback(lambda count: bar(int(count), total, what), count)


def steps_between(total: int, unknowns: int) -> int:
    """Number of steps between two drawings, so that drawing takes little time. The time of a step of n unknowns is
    assumed to be proportional to n^2."""
    return min(total, max(total // MOST, LEAST // unknowns**2, 1))


def in_blocks(scan: Callable, carry: tuple, length: int, least: int, show: Callable):
    """As scan(carry, length), in blocks of at least `least` iterations, with show(number of iterations) after each.

    scan: carry, number of iterations -> carry, the stacked results of the iterations.
    """
    size = next((n for n in range(least, min(4 * least, length) + 1) if length % n == 0), least)
    blocks, rest = divmod(length, size)

    def block(carry: tuple, number: Array):
        carry, ys = scan(carry, size)
        show((number + 1) * size)
        return carry, ys

    carry, ys = lax.scan(block, carry, jnp.arange(blocks, dtype=jnp.int32))
    ys = jax.tree.map(lambda y: y.reshape(blocks * size, *y.shape[2:]), ys)
    if not rest:
        return carry, ys
    carry, tail = scan(carry, rest)
    show(jnp.asarray(length, jnp.int32))
    return carry, jax.tree.map(lambda y, z: jnp.concatenate([y, z]), ys, tail)
