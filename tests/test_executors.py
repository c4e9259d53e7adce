"""Members handed to executors: the same bits, whoever works; what fails is named, and nothing is lost."""

import errno
import importlib.util
import multiprocessing
import os
import pickle
import re
import resource
import shutil
import signal
import subprocess
import sys
import zlib
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import friction_problems
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.runs import executors, storage, workers

SPRING = hhtjax.System(np.ones(1), lambda q, v, t, params: -params["k"] * jnp.sin(q))
K = np.linspace(1.0, 4.0, 7)
AXES = None, None, None, {"k": 0}
SWEEP = {"dts": np.linspace(0.05, 0.1, 7), "duration": 1.0, "num_samples": 2, "in_axes": AXES}
START = SPRING, hhtjax.hht(), np.ones(1), np.zeros(1), {"k": K}


def end(k, v0):
    """Of a run of the spring."""
    run = hhtjax.simulate(SPRING, hhtjax.hht(), jnp.ones(1), v0[None], {"k": k}, dt=0.05, num_steps=20)
    return {"q": run.q[-1, 0], "v": run.v[-1]}


def written(folder, **changed):
    """A sweep on disk."""
    return hhtjax.sweep_to_disk(folder, *START, **(SWEEP | {"chunk": 3} | changed))


def contents(folder):
    """{file: its bytes}."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def same(a, b):
    """Whether two pytrees hold the same bits."""
    return jax.tree.all(jax.tree.map(lambda x, y: np.asarray(x).tobytes() == np.asarray(y).tobytes(), a, b))


@pytest.fixture(scope="module")
def threads():
    """Of this process: what crosses does so in the same way."""
    with ThreadPoolExecutor(2) as executor:
        yield executor


compiled = []


def count_programs():
    """In a worker, before all else."""
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: compiled.append(event) if event.endswith("backend_compile_duration") else None
    )


def number_of_programs():
    """Compiled in this process so far."""
    return len(compiled)


def die():
    """As a worker whose memory runs out."""
    os.kill(os.getpid(), signal.SIGKILL)


def spawned(**options):
    """A worker of the standard library."""
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"), **options)


@pytest.mark.slow
def test_a_process_gives_the_same_bits_compiles_once_and_may_die(tmp_path):
    known = hhtjax.parallel_map(end, K, 0.1, chunk=3, in_axes=(0, None))
    np.testing.assert_allclose(known["q"], jax.jit(jax.vmap(end, (0, None)))(K, 0.1)["q"], rtol=1e-13)
    one = written(tmp_path / "one")
    with spawned(initializer=count_programs) as executor:
        numbers = []
        for k in (K, K + 1):
            found = hhtjax.parallel_map(end, k, 0.1, executor=executor, chunk=3, in_axes=(0, None))
            numbers.append(executor.submit(number_of_programs).result())
            assert same(found, known) == (k is K)
        assert numbers[0] == numbers[1] > 0
        assert contents(written(tmp_path / "other", executor=executor)) == contents(one)
        with pytest.raises(BrokenProcessPool):
            executor.submit(die).result()
        (tmp_path / "other" / "chunk-00001.npz").unlink()
        with pytest.raises(RuntimeError, match=r"sweep_to_disk: a worker died at members 3 to 5, .* make another one"):
            written(tmp_path / "other", executor=executor)
    with ThreadPoolExecutor(1) as executor:
        assert contents(written(tmp_path / "other", executor=executor)) == contents(one)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="distributed is not installed")
def test_dask_gives_the_same_bits(tmp_path):
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as cluster,
        Client(cluster) as client,
    ):
        found = hhtjax.parallel_map(end, K, 0.1, executor=client.get_executor(), chunk=3, in_axes=(0, None))
        assert same(found, hhtjax.parallel_map(end, K, 0.1, chunk=3, in_axes=(0, None)))
        other = written(tmp_path / "other", executor=client.get_executor())
    assert contents(other) == contents(written(tmp_path / "one"))


@pytest.mark.slow
def test_mpi_gives_the_same_bits(tmp_path):
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    mpiexec = shutil.which("mpiexec", path=path)
    tried = mpiexec and subprocess.run(
        [mpiexec, "-n", "1", sys.executable, "-c", "from mpi4py import MPI"], check=False
    )
    if not tried or tried.returncode:
        pytest.skip("MPI, or mpi4py, is not installed")
    script = tmp_path / "script.py"
    script.write_text(
        "import jax; jax.config.update('jax_enable_x64', True)\n"
        "import numpy as np\nfrom mpi4py.futures import MPIPoolExecutor\nimport hhtjax, test_executors as t\n"
        "if __name__ == '__main__':\n"
        "    with MPIPoolExecutor() as executor:\n"
        "        found = hhtjax.parallel_map(t.end, t.K, 0.1, executor=executor, chunk=3, in_axes=(0, None))\n"
        "    assert t.same(found, hhtjax.parallel_map(t.end, t.K, 0.1, chunk=3, in_axes=(0, None)))\n"
        "    print('the same')\n"
    )
    path = os.pathsep.join([os.path.dirname(__file__), os.environ.get("PYTHONPATH", "")])
    command = [mpiexec, "-n", "2", sys.executable, "-m", "mpi4py.futures", script]
    environment = os.environ | {"PYTHONPATH": path}
    done = subprocess.run(command, check=True, env=environment, stdout=subprocess.PIPE, text=True, timeout=300)
    assert done.stdout.endswith("the same\n")


@pytest.mark.slow
def test_the_how_to_runs_as_a_script(tmp_path):
    text = (Path(__file__).parents[1] / "docs" / "howto" / "many_machines.md").read_text()
    script = text.split("```python\n")[1].split("```")[0].replace("10_000", "6").replace("chunk=1000", "chunk=3")
    (tmp_path / "script.py").write_text(script)
    done = subprocess.run(
        [sys.executable, tmp_path / "script.py"], check=True, capture_output=True, text=True, timeout=300
    )
    assert re.fullmatch(r"\[ *\d+\.\d+ +\d+\.\d+ +\d+\.\d+\]", done.stdout.strip()), done.stdout
    assert "chunk 2 of 2" in done.stderr


def slope(k):
    """A gradient through a run."""
    return jax.grad(lambda k: end(k, jnp.asarray(0.1))["q"])(k)


@pytest.mark.slow
def test_gradients_cross(threads):
    alone = hhtjax.parallel_map(slope, K, chunk=4)
    assert same(hhtjax.parallel_map(slope, K, chunk=4, executor=threads), alone)
    h = 1e-5
    ends = [hhtjax.parallel_map(end, K + dk, 0.1, chunk=7, in_axes=(0, None))["q"] for dk in (h, -h)]
    np.testing.assert_allclose(alone, (ends[0] - ends[1]) / (2 * h), rtol=1e-6)


def test_keys_trees_and_dtypes_cross(threads):
    def draw(key, scale):
        return scale["a"] * jax.random.normal(key, (2,), np.float32), jnp.int8(3)

    keys, scale = jax.random.split(jax.random.key(0), 5), {"a": np.arange(5, dtype=np.float32), "b": np.ones(3)}
    expected = jax.vmap(lambda k, a: draw(k, {"a": a})[0])(keys, scale["a"])
    for executor in (None, threads):
        found, small = hhtjax.parallel_map(
            draw, keys, scale, chunk=2, in_axes=(0, {"a": 0, "b": None}), executor=executor
        )
        np.testing.assert_allclose(found, expected, rtol=1e-6)
        assert (found.dtype, small.dtype, small.shape) == (np.float32, np.int8, (5,))


def test_numbers_stay_weak_and_none_is_no_argument(threads):
    x = np.arange(3, dtype=np.float32)
    for executor in (None, threads):
        found = hhtjax.parallel_map(
            lambda x, scale, none: scale["a"] * x if none is None else x, x, {"a": 2.0, "b": None}, None,
            in_axes=(0, None, None), chunk=2, executor=executor,
        )  # fmt: skip
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, 2 * x)


@pytest.mark.filterwarnings("ignore:sweep. in float32")
def test_sweeps_of_float32_cross(threads, tmp_path):
    start = SPRING, hhtjax.hht(), np.ones(1, np.float32), np.zeros(1, np.float32), {"k": 4.0}
    sweep = {"dts": np.full(3, 0.1), "duration": 1.0, "num_samples": 1, "chunk": 2}
    one = hhtjax.sweep_to_disk(tmp_path / "one", *start, **sweep)
    other = hhtjax.sweep_to_disk(tmp_path / "other", *start, **sweep, executor=threads)
    assert contents(one) == contents(other)
    assert hhtjax.load_sweep(one)["q"].dtype == np.float32


def test_what_files_cannot_hold_is_refused(tmp_path):
    for f, error, words in (
        (lambda x: {"a": {"b": x}, "a.b": x}, ValueError, "must have unique names"),
        (lambda x: {"file": x}, ValueError, "received 'file'"),
        (lambda x: {"a/b": x}, ValueError, "received 'a/b'"),
        (lambda x: x.astype(jnp.bfloat16), TypeError, "must be of a dtype of NumPy; received bfloat16"),
    ):
        with pytest.raises(error, match=words):
            hhtjax.map_to_disk(tmp_path / "map", f, K, chunk=3)


def test_an_executor_that_is_gone_is_named():
    with ThreadPoolExecutor(1) as executor:
        pass
    with pytest.raises(RuntimeError, match="parallel_map: `executor` takes no tasks: cannot schedule new futures"):
        hhtjax.parallel_map(jnp.sin, K, chunk=3, executor=executor)


def test_workers_that_write_elsewhere_are_noticed(threads, tmp_path, monkeypatch):
    monkeypatch.setattr(storage.Npz, "write", lambda *_: None)
    with pytest.raises(RuntimeError, match="map_to_disk: workers wrote 3 chunks that are not in"):
        hhtjax.map_to_disk(tmp_path / "map", jnp.sin, K, chunk=3, executor=threads)


def test_what_cannot_be_mapped_is_refused():
    def refused(words, *arguments, error=ValueError, **options):
        with pytest.raises(error, match=words):
            hhtjax.parallel_map(*arguments, **({"chunk": 2} | options))

    refused("`f` must be a function of one member's arguments; received 3", 3, K, error=TypeError)
    refused("give `arguments` after `f`", jnp.sin, error=TypeError)
    refused("must be pytrees of arrays and numbers; received 'a'", jnp.sin, "a", error=TypeError)
    refused("leading axes of one length, not 0, where `in_axes` is 0", jnp.add, K, K[:3])
    refused("leading axes of one length, not 0", jnp.sin, 1.0)
    refused("`in_axes` must be 0 or None for each argument", jnp.sin, K, in_axes=1)
    refused("`chunk` must be a positive integer; received 0", jnp.sin, K, chunk=0)
    refused("`executor` must be a concurrent.futures.Executor", jnp.sin, K, executor=4, error=TypeError)
    refused("must return arrays of numbers; received keys", jax.random.key, np.arange(3), error=TypeError)
    refused("must be pytrees of arrays and numbers", jnp.sin, np.array([None, 1]), error=TypeError)
    refused("`f` must be hashable; received Unhashable", Unhashable(), K, error=TypeError)
    with pytest.raises(TypeError, match="must not be tracers: call it outside jit"):
        jax.jit(lambda x: hhtjax.parallel_map(jnp.sin, x, chunk=2))(K)


def test_callbacks_cannot_cross(threads):
    def asked(x):
        return jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), x.dtype), x, vmap_method="sequential")

    with pytest.raises(NotImplementedError, match="parallel_map: with an `executor`, no function may call back"):
        hhtjax.parallel_map(asked, K, chunk=3, executor=threads)
    np.testing.assert_allclose(hhtjax.parallel_map(asked, K, chunk=3), np.sin(K))


class Unhashable:
    """A function with data."""

    __hash__ = None

    def __call__(self, x):
        return x


class Failing(Executor):
    """Runs what it is given at once; the first times it fails instead."""

    def __init__(self, times, error):
        self.times, self.error = times, error

    def submit(self, fn, /, *args, **kwargs):
        """As any executor."""
        future = Future()
        self.times -= 1
        try:
            if self.times >= 0:
                raise self.error
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def test_what_fails_is_tried_again_and_then_named():
    known, no_room = hhtjax.parallel_map(jnp.sin, K, chunk=3), MemoryError("no room")
    assert same(hhtjax.parallel_map(jnp.sin, K, chunk=3, executor=Failing(2, no_room)), known)
    with pytest.raises(
        RuntimeError, match=r"member.* failed 3 times, .* MemoryError: no room; a smaller `chunk`"
    ) as raised:
        hhtjax.parallel_map(jnp.sin, K, chunk=3, executor=Failing(9, no_room))
    assert raised.value.__cause__ is no_room
    with pytest.raises(RuntimeError, match="members 0 to 2 failed 1 times"):
        hhtjax.parallel_map(jnp.sin, K, chunk=3, executor=Failing(1, no_room), retries=0)
    with pytest.raises(RuntimeError, match="a worker died at members 0 to 2, or at members next to them"):
        hhtjax.parallel_map(jnp.sin, K, chunk=3, executor=Failing(1, BrokenProcessPool("gone")))


class Interrupted(Executor):
    """Takes tasks and does none of them; the third is an interruption."""

    def __init__(self):
        self.futures = []

    def submit(self, fn, /, *args, **kwargs):
        """As any executor."""
        if len(self.futures) == 2:
            raise KeyboardInterrupt
        self.futures.append(Future())
        return self.futures[-1]


def test_what_has_not_begun_is_taken_back_when_interrupted():
    executor = Interrupted()
    with pytest.raises(KeyboardInterrupt):
        hhtjax.parallel_map(jnp.sin, K, chunk=2, executor=executor)
    assert all(future.cancelled() for future in executor.futures)


def test_no_more_tasks_are_handed_out_than_asked_for(threads):
    class Counting(Executor):
        most = flying = 0

        def submit(self, fn, /, *args, **kwargs):
            self.flying += 1
            self.most = max(self.most, self.flying)
            future = threads.submit(fn, *args, **kwargs)
            future.add_done_callback(self.landed)
            return future

        def landed(self, _):
            self.flying -= 1

    executor = Counting()
    hhtjax.parallel_map(jnp.sin, np.arange(40.0), chunk=1, executor=executor, in_flight=3)
    assert executor.most == 3


def test_a_worker_that_does_not_fit_says_why(threads, monkeypatch):
    def mapped(f):
        return hhtjax.parallel_map(f, K, chunk=3, executor=threads)

    with monkeypatch.context() as patch:
        patch.setattr(workers, "IMPORTED_BY", -1)
        with pytest.raises(RuntimeError, match=r'parallel_map: a worker process was forked .*get_context\("spawn"\)'):
            mapped(jnp.cos)
    real = workers.packed
    for changed, words in (
        ({"versions": {"jax": "0"}}, r"must have the caller's versions, {'jax': '0'}"),
        ({"platform": "cuda"}, r"on the caller's platform, 'cuda'; its JAX takes 'cpu'"),
    ):

        def other(*arguments, changed=changed):
            program = real(*arguments)
            content = workers._Content(*pickle.loads(zlib.decompress(program.content)))
            content = zlib.compress(pickle.dumps(tuple(content._replace(**changed))))
            return program._replace(key="another", content=content)

        with monkeypatch.context() as patch:
            patch.setattr(executors, "packed", other)
            with pytest.raises(RuntimeError, match=words):
                mapped(jnp.cos)


def test_a_map_on_disk_is_continued_and_read_piece_by_piece(threads, tmp_path):
    def f(x):
        return {"a": {"b": x**2}, "c": jnp.stack([x, -x])}

    x = np.arange(10.0)
    folder = hhtjax.map_to_disk(tmp_path / "map", f, x, chunk=4, executor=threads)
    before = contents(folder)
    (folder / "chunk-00001.npz").unlink()
    (folder / ".chunk-00001.npz.abc.part").write_bytes(b"of a worker that died")
    with pytest.raises(FileNotFoundError, match="1 of 3 chunks are missing"):
        hhtjax.load_sweep(folder)
    hhtjax.map_to_disk(folder, f, x, chunk=4)
    assert contents(folder) == before
    found, lazy = hhtjax.load_sweep(folder), hhtjax.load_sweep(folder, lazy=True)
    np.testing.assert_array_equal(found["a.b"], x**2)
    c = lazy["c"]
    assert (c.shape, c.ndim, len(c), c.dtype) == ((10, 2), 2, 10, np.float64)
    assert "'c' on disk" in repr(c)
    indices = 3, -1, slice(2, 9, 3), slice(3, 7), np.array([9, 0, 4]), (slice(None), 1), (5, 1), (slice(2, 5), 0)
    indices += ..., (), ([0, 1], [0, 1]), np.array([[0, 1], [2, 3]]), (..., 0), np.arange(10) > 4
    for index in indices:
        np.testing.assert_array_equal(c[index], found["c"][index])
    np.testing.assert_array_equal(np.asarray(c), found["c"])
    np.testing.assert_array_equal(list(c), found["c"])
    alone = hhtjax.map_to_disk(tmp_path / "alone", jnp.sin, x, chunk=4)
    np.testing.assert_allclose(hhtjax.load_sweep(alone)["result"], np.sin(x), rtol=1e-14)


def test_two_callers_may_write_to_one_folder(threads, tmp_path):
    folder, x = tmp_path / "map", np.arange(40.0)
    with ThreadPoolExecutor(2) as callers:
        calls = [
            callers.submit(hhtjax.map_to_disk, folder, jnp.sin, x, chunk=1, executor=executor)
            for executor in (threads, None)
        ]
        assert [call.result() for call in calls] == [folder, folder]
    np.testing.assert_allclose(hhtjax.load_sweep(folder)["result"], np.sin(x), rtol=1e-14)
    assert len(list(folder.iterdir())) == 41


def test_another_chunk_in_a_chunks_place_is_noticed(tmp_path):
    folder = written(tmp_path / "sweep")
    before = contents(folder)
    shutil.copy(folder / "chunk-00000.npz", folder / "chunk-00001.npz")
    with pytest.raises(
        ValueError, match=r"chunk-00001\.npz is damaged \(it belongs to another chunk or another sweep\)"
    ):
        hhtjax.load_sweep(folder)
    written(folder)
    assert contents(folder) == before
    other = written(tmp_path / "other", t0=1.0)
    shutil.copy(other / "chunk-00001.npz", folder / "chunk-00001.npz")
    with pytest.raises(ValueError, match="another chunk or another sweep"):
        hhtjax.load_sweep(folder)


def test_a_writer_whose_file_was_tidied_away_is_content(tmp_path):
    path = tmp_path / "chunk-00000.npz"
    path.write_bytes(b"by another")

    def tidied(file):
        for part in tmp_path.glob(".*.part"):
            part.unlink()

    storage.write_whole("sweep_to_disk", path, tidied)
    assert path.read_bytes() == b"by another"
    path.unlink()
    with pytest.raises(FileNotFoundError):
        storage.write_whole("sweep_to_disk", path, tidied)


def test_a_full_disk_of_a_worker_is_named(threads, tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    previous = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))  # the manifest fits, a chunk does not
    try:
        with pytest.raises(OSError, match=r"member.* failed 3 times, .* could not be written") as raised:
            written(tmp_path / "full", executor=threads)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, previous)
    assert raised.value.errno == errno.EFBIG
    written(tmp_path / "full", executor=threads)
    hhtjax.load_sweep(tmp_path / "full")


TERMINAL = hhtjax.Event(lambda q, v, t, params: q[0] - 0.5, terminal=True)
KINDS = {
    "error control": (START, SWEEP | {"dts": hhtjax.adaptive(rtol=np.logspace(-3, -6, 7), atol=1e-6, max_steps=500)}),
    "events": (START, SWEEP | {"events": [TERMINAL]}),
    "output": (START, SWEEP | {"output": lambda q, v: q + v}),
} | {
    name: (
        (case.system, hhtjax.hht(), case.q0, case.v0, case.params),
        {"z0": case.z0, "dts": np.linspace(0.01, 0.02, 5), "duration": 0.1, "num_samples": 2},
    )
    for name in ("an internal state", "a constraint, H(q), a load", "a rotation, H(q)")
    for case in (friction_problems.CASES[name],)
}


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_all_kinds_of_sweeps_cross(threads, tmp_path, name):
    start, sweep = KINDS[name]
    alone = hhtjax.load_sweep(hhtjax.sweep_to_disk(tmp_path / "alone", *start, **sweep, chunk=3))
    found = hhtjax.load_sweep(hhtjax.sweep_to_disk(tmp_path / "threads", *start, **sweep, chunk=3, executor=threads))
    assert same(alone, found)
    runs = hhtjax.sweep(*start, **sweep)
    expected = {
        jax.tree_util.keystr(path, simple=True, separator="."): x
        for path, x in jax.tree_util.tree_leaves_with_path(runs)
    }
    assert expected.keys() == alone.keys()
    for key, x in expected.items():
        np.testing.assert_allclose(alone[key], x, rtol=1e-12, err_msg=key)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("xarray") is None, reason="zarr and xarray are not installed")
@pytest.mark.parametrize("name", ["error control", "output"])
def test_a_zarr_store_holds_the_same_and_xarray_opens_it(threads, tmp_path, name):
    import xarray

    start, sweep = KINDS[name]
    files = hhtjax.load_sweep(hhtjax.sweep_to_disk(tmp_path / "files", *start, **sweep, chunk=3))
    options = {"chunk": 3, "executor": threads, "format": "zarr"}
    where = hhtjax.sweep_to_disk(tmp_path / "store", *start, **sweep, **options)
    arrays, lazy = hhtjax.load_sweep(where), hhtjax.load_sweep(where, lazy=True)
    for key, x in files.items():
        there = arrays[key][tuple(slice(n) for n in x.shape)]  # steps are as many as max_steps there
        np.testing.assert_array_equal(there, x, err_msg=key)
        np.testing.assert_array_equal(lazy[key][2:5], arrays[key][2:5])
    with xarray.open_zarr(where) as found:
        variable = found["output" if name == "output" else "q"]
        assert variable.dims[:2] == ("member", "sample")
        assert found["t"].attrs["units"] == "s"
        assert "t" in found.coords
        np.testing.assert_array_equal(variable.isel(member=slice(2, 4)).values, arrays[variable.name][2:4])
    with pytest.raises(ValueError, match=r"holds another sweep, whose inputs differ"):
        hhtjax.sweep_to_disk(where, *start, **(sweep | {"duration": 1.1}), **options)


@pytest.mark.skipif(importlib.util.find_spec("zarr") is None, reason="zarr is not installed")
def test_a_zarr_store_is_continued(threads, tmp_path):
    import zarr

    x = np.arange(10.0)
    where = hhtjax.map_to_disk(tmp_path / "store", jnp.sin, x, chunk=4, format="zarr")
    group = zarr.open_group(where, mode="r+")
    group["result"][4:8], group["chunk_written"][1] = 0, False
    with pytest.raises(FileNotFoundError, match=r"1 of 3 chunks are missing in .*, the first is number 1"):
        hhtjax.load_sweep(where)
    hhtjax.map_to_disk(where, jnp.sin, x, chunk=4, format="zarr", executor=threads)
    np.testing.assert_allclose(hhtjax.load_sweep(where)["result"], np.sin(x), rtol=1e-14)
    with pytest.raises(ValueError, match="must be empty, or hold this sweep as a Zarr store"):
        hhtjax.map_to_disk(tmp_path, jnp.sin, x, chunk=4, format="zarr")
    with pytest.raises(ValueError, match="`format` must be one of 'npz', 'zarr'; received 'csv'"):
        hhtjax.map_to_disk(tmp_path / "csv", jnp.sin, x, chunk=4, format="csv")


def test_a_zarr_store_needs_its_package(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ImportError, match=r"map_to_disk: a Zarr store needs the package zarr: pip install"):
        hhtjax.map_to_disk(tmp_path / "store", jnp.sin, K, chunk=4, format="zarr")
