"""One line for who waits: where a first call takes long, and nowhere else; how far a call is, and how long it takes."""

import io
import logging
import threading
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

import hhtjax
from hhtjax.primitives import one_kernel
from hhtjax.runs.progress import stages
from hhtjax.xla import Programs, first_call


@pytest.fixture(autouse=True)
def _little_patience(monkeypatch):
    monkeypatch.setattr(first_call, "PATIENCE", 0.15)
    monkeypatch.setattr(first_call, "LATER", 0.15)


def told(caplog):
    time.sleep(0.3)  # for a clock that should have been stopped
    lines = [x.getMessage() for x in caplog.records if x.name == "hhtjax"]
    caplog.clear()
    return lines


def slow_to_trace(seconds):
    """A function of an array that takes long the first time."""

    def f(x):
        time.sleep(seconds)
        return 2 * x

    return f


@pytest.fixture
def slow_compiler(monkeypatch):
    """All that is lowered takes long from there on, in the same call of JAX."""
    verdict = hhtjax.xla.lowering._as_kernel

    def late(closed):
        time.sleep(0.4)
        return verdict(closed)

    monkeypatch.setattr(hhtjax.xla.lowering, "_as_kernel", late)


@pytest.mark.slow
def test_a_first_call_that_takes_long_is_told_of_once_and_a_second_call_starts_no_clock(caplog, monkeypatch):
    program = Programs(slow_to_trace(0.4))
    program(jnp.ones(2))
    (line,) = told(caplog)
    assert line.startswith("hhtjax: tracing or compiling a program for 0.15 s by now")
    started = []
    monkeypatch.setattr(threading.Thread, "start", lambda self: started.append(self))
    program(jnp.zeros(2))
    assert not started
    assert not told(caplog)


@pytest.mark.slow
def test_a_quick_first_call_says_nothing_though_more_is_done_in_the_same_call_of_jax(caplog):
    program = Programs(lambda x: 2 * x)

    def f(x):
        y = program(x)
        time.sleep(0.4)
        return y

    assert jax.jvp(f, (2.0,), (1.0,)) == (4.0, 2.0)
    assert not told(caplog)


@pytest.mark.slow
def test_a_jit_of_the_users_and_its_gradient_are_told_of(caplog, slow_compiler):
    def f(x):
        return one_kernel(lambda x: jnp.sin(x) * 2, x)

    jax.jit(f)(1.0)
    assert len(told(caplog)) == 1
    jax.grad(jax.jit(f))(1.0)
    assert len(told(caplog)) >= 1


def test_what_is_lowered_and_not_compiled_is_not_told_of(caplog):
    def f(x):
        return one_kernel(lambda x: jnp.cos(x) * 2, x)

    lowered = jax.jit(f).lower(1.0)
    assert first_call._clocks
    assert not told(caplog)
    lowered.compile()
    assert not first_call._clocks


def test_an_error_ends_the_wait(caplog):
    def refuse(x):
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        Programs(refuse)(1.0)
    assert not told(caplog)


@pytest.mark.slow
def test_explain_waits_too(caplog, monkeypatch):
    stage = type(jax.jit(lambda x: x).lower(1.0))
    compile_ = stage.compile
    monkeypatch.setattr(stage, "compile", lambda self: time.sleep(0.4) or compile_(self))
    hhtjax.explain(lambda x: one_kernel(lambda x: jnp.exp(x) * 2, x), 1.0)
    assert len(told(caplog)) == 1


class Terminal(io.StringIO):
    """Knows what has been written to it."""

    def isatty(self):
        return True

    def lines(self):
        """Each that took the place of the one before."""
        return [x.rstrip() for x in self.getvalue().split("\r")]


@pytest.fixture
def terminal(monkeypatch):
    """stderr, with a logging that nobody has configured."""
    stderr = Terminal()
    monkeypatch.setattr("hhtjax.description.presentation.sys", SimpleNamespace(stderr=stderr))  # pytest sets its own
    monkeypatch.setattr(first_call, "LOG", logging.Logger("hhtjax"))
    monkeypatch.setattr(first_call, "_hinted", [True])
    return stderr


@pytest.mark.slow
def test_in_a_terminal_the_line_counts_up_and_is_closed(terminal):
    Programs(slow_to_trace(1.2))(jnp.ones(4))
    at_once = terminal.lines()
    assert at_once[:-1] == ["", "hhtjax: compiling ... (0 s)", "hhtjax: compiling ... (1 s)"]
    assert 1.2 <= float(at_once[-1].removeprefix("hhtjax: compiled in ").removesuffix(" s")) < 60
    assert not [x for x in threading.enumerate() if x.name == "hhtjax-first-call"]


@pytest.mark.slow
@pytest.mark.parametrize("level", [logging.WARNING, logging.ERROR])
def test_in_a_terminal_an_error_wipes_the_line_out_and_logging_keeps_it_quiet(terminal, level):
    def refuse(x):
        time.sleep(0.4)
        raise ValueError("no")

    first_call.LOG.setLevel(level)
    with pytest.raises(ValueError, match="no"):
        Programs(refuse)(1.0)
    shown = ["", "hhtjax: compiling ... (0 s)", "", ""]
    assert terminal.lines() == (shown if level == logging.WARNING else [""])


@pytest.mark.slow
def test_after_the_first_message_only_much_longer_calls_are_told_of(caplog, monkeypatch):
    monkeypatch.setattr(first_call, "_logged", [])
    monkeypatch.setattr(first_call, "LATER", 20.0)
    Programs(slow_to_trace(0.4))(jnp.ones(2))
    assert len(told(caplog)) == 1
    Programs(slow_to_trace(0.4))(jnp.ones(2))
    assert not told(caplog)
    monkeypatch.setattr(first_call, "LATER", 0.2)
    Programs(slow_to_trace(0.4))(jnp.ones(2))
    (line,) = told(caplog)
    assert "for 0.2 s by now" in line


@pytest.mark.slow
def test_logging_keeps_quiet(caplog):
    with caplog.at_level(logging.ERROR, logger="hhtjax"):
        Programs(slow_to_trace(0.4))(jnp.ones(3))
        assert not told(caplog)


def test_how_to_wait_less_is_said_once_and_where_nothing_is_kept(monkeypatch):
    monkeypatch.setattr(first_call, "_hinted", [])
    folder = jax.config.jax_compilation_cache_dir
    try:
        jax.config.update("jax_compilation_cache_dir", "somewhere")
        assert "keep_programs" not in first_call._words(2.0)
        jax.config.update("jax_compilation_cache_dir", None)
        assert ["keep_programs" in first_call._words(2.0) for _ in range(3)] == [True, False, False]
    finally:
        jax.config.update("jax_compilation_cache_dir", folder)


@pytest.fixture
def clock(monkeypatch):
    """A list whose only entry is the time."""
    now = [0.0]
    monkeypatch.setattr("hhtjax.runs.progress.time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


def four_things(clock):
    """The first, which compiles, takes 10 s, the others 4 s each, and the last one fails."""
    with stages("f", True, total=4) as tell:
        for number, seconds in enumerate((10, 4, 4, 4), 1):
            tell(f"thing {number}")
            clock[0] += seconds
        raise ArithmeticError


def test_what_is_left_is_told_by_what_the_later_things_took(clock, capsys):
    with pytest.raises(ArithmeticError):
        four_things(clock)
    shown = [x.partition("] ")[2].rstrip() for x in capsys.readouterr().err.split("\r")[1:]]
    assert shown == [
        "f: thing 1",
        "f: thing 2, 10 s",
        "f: thing 3, 14 s, 8 s left",
        "f: thing 4, 18 s, 4 s left",
        "f: thing 4, 22 s",
    ]


def test_a_bar_of_tqdm_where_it_is_installed(clock, capsys, monkeypatch):
    made = []

    class Bar:
        def __init__(self, total, initial, desc, bar_format):
            made.append([(total, initial, desc)])

        def set_description_str(self, text):
            made[-1].append((self.n, text))

        def close(self):
            made[-1].append("closed")

    monkeypatch.setattr("hhtjax.runs.progress._tqdm", lambda: Bar)
    with pytest.raises(ArithmeticError):
        four_things(clock)
    (told,) = made
    assert told[0] == (4, 0, "f: thing 1")
    assert told[3:] == [
        (2, "f: thing 3, 14 s, 8 s left"),
        (3, "f: thing 4, 18 s, 4 s left"),
        (3, "f: thing 4, 22 s"),
        "closed",
    ]
    assert not capsys.readouterr().err
