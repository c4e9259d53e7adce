"""Compiled programs on disk: other processes load them, the folder stays within its bound, JAX's settings come back."""

import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.xla import first_call

ROOT = Path(__file__).parents[1]
NAMES = ("jax_compilation_cache_dir", *first_call.SETTINGS)
PROCESS = """
import sys, jax, jax.numpy as jnp, hhtjax

read = []
jax.monitoring.register_event_listener(lambda event, **_: read.append(event) if event.endswith("cache_hits") else None)
hhtjax.keep_programs(sys.argv[1], int(sys.argv[2]))
spring = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, params: -9.0 * q)
run = hhtjax.simulate(spring, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), dt=0.01, num_steps=3)
end = float(run.q[-1, 0])
print(len(read), end.hex())
"""


@pytest.fixture(autouse=True)
def _as_before():
    yield
    hhtjax.keep_programs(None)


def settings():
    return {name: getattr(jax.config, name) for name in NAMES}


def compiled(number, x):
    """Of a program that no other test has, compiled anew, or loaded, in every call."""
    return jax.jit(lambda x: x + float(number) / 3)(x)


def fill(folder, sizes):
    """Files as JAX writes them, the first one read longest ago."""
    for age, size in enumerate(sizes):
        path = folder / f"jit_{age}-cache"
        path.write_bytes(bytes(size))
        os.utime(path, (1e9 + age, 1e9 + age))


def names(folder):
    return {path.name for path in folder.iterdir()}


def in_a_process(folder, max_bytes):
    """Programs that were read, and the result."""
    command = [sys.executable, "-c", PROCESS, str(folder), str(max_bytes)]
    keep = {name: x for name, x in os.environ.items() if not name.startswith(("JAX_COMPILATION", "JAX_PERSISTENT"))}
    done = subprocess.run(command, env=keep, cwd=ROOT, check=True, capture_output=True, text=True)
    read, end = done.stdout.split()
    return int(read), float.fromhex(end)


@pytest.mark.slow
def test_a_second_process_loads_what_the_first_has_compiled(tmp_path):
    once, end = in_a_process(tmp_path, 10**8)
    (folder,) = tmp_path.iterdir()
    written = names(folder)
    again, same = in_a_process(tmp_path, 10**8)
    assert once == 0 < again == len(written)
    assert same == end
    assert names(folder) == written
    in_a_process(tmp_path, 1)  # less than any program takes, when the process ends
    assert not names(folder)


def test_programs_are_written_and_read(tmp_path):
    read = []
    folder = hhtjax.keep_programs(tmp_path)
    assert folder.parent == tmp_path
    x = jnp.ones(3)
    first = compiled(1, x)
    written = names(folder)
    assert any(name.startswith("jit__lambda") for name in written)
    jax.monitoring.register_event_listener(lambda event, **_: read.append(event))
    np.testing.assert_array_equal(compiled(1, x), first)
    assert "/jax/compilation_cache/cache_hits" in read
    assert names(folder) == written


def test_what_was_not_read_for_longest_is_deleted_and_other_files_are_not(tmp_path):
    folder = hhtjax.keep_programs(tmp_path)
    fill(folder, [300, 200, 400])
    (tmp_path / "mine-cache").write_bytes(bytes(1000))
    (folder / "notes.txt").write_bytes(bytes(1000))
    hhtjax.keep_programs(tmp_path, max_bytes=900)
    assert names(folder) == {"jit_0-cache", "jit_1-cache", "jit_2-cache", "notes.txt"}
    os.utime(folder / "jit_0-cache", (2e9, 1e9))  # read once more
    hhtjax.keep_programs(tmp_path, max_bytes=700)
    assert names(folder) == {"jit_0-cache", "jit_2-cache", "notes.txt"}
    hhtjax.keep_programs(tmp_path, max_bytes=1)
    assert names(folder) == {"notes.txt"}
    assert names(tmp_path) == {folder.name, "mine-cache"}


def test_the_bound_holds_while_a_process_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(first_call, "EVERY", 1)
    folder = hhtjax.keep_programs(tmp_path)
    x = jnp.ones(3)
    compiled(2, x)
    size = sum(path.stat().st_size for path in folder.iterdir())
    hhtjax.keep_programs(tmp_path, max_bytes=3 * size)
    for number in range(3, 9):
        compiled(number, x)
        assert sum(path.stat().st_size for path in folder.iterdir()) <= 4.1 * size  # with the one just written


def test_none_gives_the_settings_from_before_the_first_call(tmp_path):
    before = settings()
    hhtjax.keep_programs(tmp_path / "a")
    folder = hhtjax.keep_programs(tmp_path / "b", max_bytes=10)
    assert settings() == first_call.SETTINGS | {"jax_compilation_cache_dir": str(folder)}
    assert hhtjax.keep_programs(None) is None
    assert settings() == before
    compiled(9, jnp.ones(3))
    assert not names(folder)
    hhtjax.keep_programs(None)
    assert settings() == before


@pytest.mark.parametrize(
    ("folder", "max_bytes", "error", "words"),
    [
        (3, 1, TypeError, "keep_programs: `folder` must be the path of a folder, or None; received 3."),
        ("", 1, TypeError, "keep_programs: `folder` must be the path of a folder, or None; received ''."),
        ("there", 0, ValueError, "keep_programs: `max_bytes` must be a positive integer; received 0."),
        ("there", 1e9, ValueError, "keep_programs: `max_bytes` must be a positive integer; received 1000000000.0."),
        ("file", 1, OSError, "keep_programs: `folder` must be one that can be written to; received 'file'"),
    ],
)
def test_arguments_are_checked_before_anything_is_set(folder, max_bytes, error, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    before = settings()
    with pytest.raises(error, match=re.escape(words)):
        hhtjax.keep_programs(folder, max_bytes)
    assert settings() == before
    assert names(tmp_path) == {"file"}
