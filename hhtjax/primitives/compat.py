"""Whether kernels are made: only with tested versions of JAX, and not if the user asks for plain JAX."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import jax

VARIABLE = "HHTJAX_PLAIN"  # 1: off; 0: on, also with a JAX newer than those tested
NEWEST = 0, 12  # the last JAX with which the conformance tests have passed, its corrections 0.12.x included
BETWEEN = {"hhtjax", "jax", "contextlib", "functools"}

_plain: ContextVar = ContextVar("hhtjax_plain", default=False)
_told: list = []  # that this JAX is not known, where a warning has said so
_refused: set = set()  # by what they are known by: XLA would take as long to refuse them again
# part of the key under which JAX keeps a compiled function, so that both forms of it can be there
_key: Any = jax.make_user_context(default_value=False)


@contextmanager
def plain():
    """A context in which everything runs on plain JAX. Use it to check a result, or to find the cause of a problem.

    A jitted function gives the plain result inside and the fast one outside: both programs are kept apart. With several
    threads the context applies to the thread that has entered it.

    The environment variable HHTJAX_PLAIN=1, set before the first run, does the same for a whole process. With a JAX
    newer than the tested ones everything runs on plain JAX too, with a warning, unless HHTJAX_PLAIN=0 is set. `explain`
    shows whether a run is plain, and why.

    >>> import jax.numpy as jnp, hhtjax
    >>> ball = hhtjax.System(mass=jnp.array([1.0, 2.0]), force=lambda q, v, t, c: -9.81 - c * v)
    >>> def fall():
    ...     return hhtjax.simulate(ball, hhtjax.hht(), jnp.ones(2), jnp.zeros(2), 0.1, dt=0.01, num_steps=50).q[-1]
    >>> with hhtjax.plain():
    ...     expected = fall()
    >>> bool(jnp.allclose(fall(), expected, rtol=1e-12))
    True
    """
    token = _plain.set(True)
    try:
        with _key(True):
            yield
    finally:
        _plain.reset(token)


def or_plain(run: Callable, known_by: Callable | None = None):
    """run(), and if XLA refuses to compile it, run() on plain JAX, with a warning.

    It cannot help inside a user's jit, because XLA compiles only after that jit has been traced. `hhtjax.xla.Programs`
    use it automatically.

    Args:
        run: a function without arguments.
        known_by: a function without arguments that returns a key for run. A run whose key has been refused once is not
            tried again. known_by is called only after a refusal.

    Returns:
        The result of run.

    Raises:
        jax.errors.JaxRuntimeError: XLA refuses the plain program too, or kernels are off. And whatever run raises.

    >>> import jax.numpy as jnp, hhtjax
    >>> float(hhtjax.primitives.or_plain(lambda: jnp.sum(jnp.ones(3))))
    3.0
    """
    if _refused and known_by is not None and known_by() in _refused:
        with plain():
            return run()
    try:
        return run()
    except jax.errors.JaxRuntimeError as error:
        if not is_on():
            raise
        refusal = error
    with plain():
        result = run()  # where this fails too, the cause is another, and its error the one to see
    if known_by is not None:
        _refused.add(known_by())
    words = (str(refusal).splitlines() or [""])[0][:200]
    _warn(
        f"XLA refused the fast program ({words}), so it was run on plain JAX. To avoid the attempt, use "
        "`with hhtjax.plain():`."
    )
    return result


def _warn(words: str):
    """Warns at the innermost line outside this library and outside the packages in BETWEEN."""
    frame, level = sys._getframe(), 1
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in BETWEEN:
        frame, level = frame.f_back, level + 1
    warnings.warn(words, RuntimeWarning, stacklevel=level)


def why_off():
    """Why kernels are off, in words; None if they are on."""
    if _plain.get():
        return "inside hhtjax.plain()"
    wish = os.environ.get(VARIABLE, "")
    if wish not in ("", "0", "1"):
        raise ValueError(f"hhtjax: the environment variable {VARIABLE} must be 0 or 1; received {wish!r}.")
    if wish == "1":
        return f"{VARIABLE}=1"
    if jax.__version_info__[:2] > NEWEST and wish != "0":
        return _too_new()
    return None


def _too_new() -> str:
    """The reason in words. It is also given as a warning, once in a process."""
    newest = ".".join(map(str, NEWEST))
    why = f"JAX {jax.__version__} is newer than {newest}, the last one tested; {VARIABLE}=0 tries it nevertheless"
    if not _told and jax.default_backend() == "cpu":  # elsewhere plain JAX is what runs in any case
        _told.append(why)
        _warn(
            f"hhtjax runs on plain JAX: the same numbers, several times slower. {why} (an environment variable). "
            f"Install a newer hhtjax that supports this JAX, or 'jax<{NEWEST[0]}.{NEWEST[1] + 1}'. Set {VARIABLE}=1 to "
            "use plain JAX without this warning."
        )
    return why


def is_on() -> bool:
    """Whether kernels are on, so that programs may be changed."""
    return why_off() is None
