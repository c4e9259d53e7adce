"""Sweeps on disk: killed at any moment and resumed they end with the same files; nothing else is continued."""

import errno
import hashlib
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.runs import storage

DTS = np.logspace(-4, -2, 22)
ONE, ZERO = np.ones(1), np.zeros(1)


def force(q, v, t, params):
    """A spring."""
    return -params["k"] * jnp.sin(q)


def softer(q, v, t, params):
    """Another spring."""
    return -params["k"] * jnp.tanh(q)


def write(folder, law=force, k=4.0, **changed):
    """22 members in 8 files."""
    system = hhtjax.System(ONE, law)
    options = {"dts": DTS, "duration": 1.0, "num_samples": 2, "chunk": 3} | changed
    return hhtjax.sweep_to_disk(folder, system, hhtjax.rk4(), ONE, ZERO, {"k": k}, **options)


def contents(folder):
    """{file: hash}."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(Path(folder).iterdir())}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A sweep that nothing disturbed."""
    return write(tmp_path_factory.mktemp("whole") / "sweep")


@pytest.mark.slow
def test_what_is_read_is_what_sweep_returns(whole):
    system = hhtjax.System(ONE, force)
    runs = hhtjax.sweep(system, hhtjax.rk4(), ONE, ZERO, {"k": 4.0}, dts=DTS, duration=1.0, num_samples=2)
    read = hhtjax.load_sweep(whole)
    assert sorted(contents(whole)) == [*(f"chunk-{i:05d}.npz" for i in range(8)), "manifest.json"]
    assert {"t", "q", "v", "acceleration", "dt", "failure.step"} <= set(read)
    assert len(read["dt"]) == 22
    np.testing.assert_array_equal(read["dt"], runs.dt)
    np.testing.assert_allclose(read["q"], runs.q, atol=1e-14)


def main(folder):
    """What the process that is killed runs: slowly, and it says what it has done."""
    written = storage.write_whole

    def slowly(caller, path, fill):
        time.sleep(0.05)
        written(caller, path, fill)
        print(path.name, flush=True)

    storage.write_whole = slowly
    write(folder)


@pytest.mark.slow
def test_killed_three_times_and_resumed_it_ends_with_the_same_files(whole, tmp_path):
    folder = tmp_path / "killed"
    rng = np.random.default_rng()
    environment = os.environ | {"JAX_ENABLE_X64": "1"}
    for _ in range(3):
        command = [sys.executable, "-c", f"import test_storage; test_storage.main({str(folder)!r})"]
        with subprocess.Popen(command, cwd=Path(__file__).parent, env=environment, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(rng.uniform(0, 0.15))
            process.send_signal(signal.SIGKILL)
        assert (folder / "manifest.json").exists()
        assert len(contents(folder)) < 10
    before = {path: path.stat().st_mtime_ns for path in folder.glob("chunk*")}
    assert 0 < len(before) < 8
    write(folder)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert contents(folder) == contents(whole)


CHANGED = {
    "a value": {"k": 4.5},
    "a step size": {"dts": DTS * 0.999},
    "the law": {"law": softer},
    "the start": {"t0": 1.0},
    "the chunks": {"chunk": 4},
}


@pytest.mark.parametrize("name", CHANGED)
def test_a_changed_input_refuses_to_resume(whole, name):
    before = contents(whole)
    with pytest.raises(ValueError, match=r"sweep_to_disk: `folder` .* holds another sweep, whose inputs"):
        write(whole, **CHANGED[name])
    assert contents(whole) == before


def test_a_damaged_chunk_is_written_again(whole):
    before = contents(whole)
    path = whole / "chunk-00003.npz"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(
        ValueError, match=r"load_sweep: .*chunk-00003\.npz is damaged .*: repeat the call that wrote it"
    ):
        hhtjax.load_sweep(whole)
    write(whole)
    assert contents(whole) == before
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"load_sweep: 1 of 8 chunks are missing .* chunk-00003"):
        hhtjax.load_sweep(whole)
    write(whole)
    assert contents(whole) == before


def test_files_without_a_manifest_are_of_nobody_knows_which_sweep(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "copy")
    (folder / "manifest.json").write_text("{")
    with pytest.raises(ValueError, match=r"load_sweep: .*manifest\.json is damaged"):
        hhtjax.load_sweep(folder)
    (folder / "manifest.json").unlink()
    with pytest.raises(ValueError, match=r"sweep_to_disk: `folder` .* holds chunk-00000\.npz, but no manifest\.json"):
        write(folder, k=4.5)
    with pytest.raises(FileNotFoundError, match="load_sweep: `folder` must hold a sweep"):
        hhtjax.load_sweep(folder)


def test_a_full_disk_is_an_error_and_loses_nothing(whole, tmp_path):
    folder = tmp_path / "full"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    previous = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))  # the manifest fits, a chunk does not
    try:
        with pytest.raises(OSError, match=r"chunk-00000\.npz could not be written .*; earlier files are") as raised:
            write(folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, previous)
    assert raised.value.errno == errno.EFBIG
    assert list(contents(folder)) == ["manifest.json"]
    write(folder)
    assert contents(folder) == contents(whole)
