"""What is shown of progress on stderr: a bar of tqdm where it is installed, else a line that is rewritten.

A run is drawn between blocks of steps, so that the steps of a block stay one kernel.
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

MOST = 100  # times that a bar is drawn in a run
LEAST = 30_000  # steps between two, of one unknown: 1.5 ms, where to draw takes .15 ms
WIDTH, SHORTEST, LONGEST = 76, 10, 30  # characters of a line without brackets, and of its bar
FORMAT = "{percentage:3.0f} %|{bar}| {desc}"  # of a bar of tqdm

# ----------------------------------------------------------------------------
# The line, one in a process, as there is one terminal.


class _Line:
    """The line of one call, from what is done when it is first drawn. total: None where nobody knows it."""

    def __init__(self, done: int, total: int | None):
        self.first = self.done = done
        self.total, self.begun = total, time.monotonic()
        self.paced: tuple[float, int] | None = None  # when, and how much was done, from where on the pace counts
        self.bar: Any = None

    def goes_on(self, done: int, total: int | None) -> bool:
        """Whether this comes of the same call: one that was interrupted has left its line."""
        return total == self.total and not done <= self.first < self.done

    def draw(self, text: str, done: int, last: bool):
        """The line with a text, and the times that have passed and are left."""
        text += self.times(done, last)
        if self.bar is None and (tqdm := _tqdm()) is not None:
            self.bar = tqdm(total=self.total, initial=done, desc=text, bar_format=FORMAT if self.total else "{desc}")
        self.done = done
        if self.bar is None:
            overwrite(self.in_characters(text), last)
            return
        self.bar.n = done
        self.bar.set_description_str(text)  # which draws
        if last:
            self.bar.close()

    def times(self, done: int, last: bool) -> str:
        """In words. What comes first may be compiled, and tells nothing of how long the rest takes."""
        now = time.monotonic()
        words = f", {_in_words(now - self.begun)}" if now - self.begun >= 1 else ""
        if self.paced is None:
            self.paced = (now, done) if done > self.first else None
        elif words and self.total is not None and done > self.paced[1] and not last:
            left = (now - self.paced[0]) * (self.total - done) / (done - self.paced[1])
            words += f", {_in_words(left)} left"
        return words

    def in_characters(self, text: str) -> str:
        """The bar and a text."""
        if self.total is None:
            return text
        length = min(LONGEST, max(SHORTEST, WIDTH - len(text)))
        return f"[{'#' * (self.done * length // self.total):<{length}}] {text}"

    def drop(self):
        """Without a trace, where another one takes its place."""
        if self.bar is not None:
            self.bar.leave = False
            self.bar.close()


_line: _Line | None = None
_lock = threading.RLock()  # callbacks come from threads of JAX


def rewrite(text: str, last: bool, done: int = 0, total: int | None = None):
    """The line with a text, and so much of a total done; the last one stays."""
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
    """The class of bars for where we are, or None."""
    try:
        from tqdm.auto import tqdm
    except ImportError:
        return None
    return tqdm


def _in_words(seconds: float) -> str:
    """A time to two digits or so."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


# ----------------------------------------------------------------------------
# What is shown of calls that go from one thing to the next, in Python.


def bar(count: int, total: int, what: str):
    """So many of all are done."""
    rewrite(f"{what} {count} of {total}", count == total, count, total)


def counted(chunks: Sequence[int], progress: bool) -> Iterator[int]:
    """The chunks, one after the other, with a bar of those that are done."""
    for done, k in enumerate(chunks):
        if progress:
            bar(done, len(chunks), "chunk")
        yield k
    if progress and chunks:
        bar(len(chunks), len(chunks), "chunk")


@contextmanager
def stages(caller: str, progress: bool, total: int | None = None) -> Iterator[Callable[..., None]]:
    """tell(what, work), which says what the call does next; without `progress` it says nothing.

    The last one stays, also where an error ends the call. total: of all work, None where nobody knows how long it is.
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
# What is shown of programs, from within them.


def announce():
    """Says on the line of the bar that a program is being compiled: called while it is traced, so only then."""
    rewrite("compiling ...", last=False)


def show_progress(count: Array, total: int, what: str):
    """A bar, drawn about a hundred times in a run."""
    every = max(1, total // MOST)
    lax.cond((count % every == 0) | (count == total), lambda: draw(count, total, what), lambda: None)


def draw(count: Array, total: int, what: str):
    """The bar itself."""

    jax.debug.callback(lambda count: bar(int(count), total, what), count)


def steps_between(total: int, unknowns: int) -> int:
    """How many steps lie between two drawings, so that these take little: a step of n takes n^2 at least."""
    return min(total, max(total // MOST, LEAST // unknowns**2, 1))


def in_blocks(scan: Callable, carry: tuple, length: int, least: int, show: Callable):
    """scan(carry, length), in blocks of `least` iterations or some more, with show(number of iterations) after each.

    scan: carry, number of iterations -> carry, what they return, stacked.
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
