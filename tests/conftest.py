"""For every test and doctest: double precision, no silent promotion of ranks or dtypes, programs compiled quickly."""

import ctypes
import gc
import importlib.util
import mmap
import os
import sys
import threading
from pathlib import Path

import jax
import pytest

# Most of the time goes into compiling small programs, which need not run fast. `XLA_FLAGS=` of one's own comes first.
QUICK = {
    "xla_backend_optimization_level": "0",
    "xla_cpu_use_fusion_emitters": "false",
    "xla_cpu_parallel_codegen_split_count": "1",  # two processes leave no core for more
    "xla_llvm_enable_alias_scope_metadata": "false",  # which buffers are not one: a tenth of the time, to optimise by
    "xla_llvm_enable_noalias_metadata": "false",
    "xla_llvm_enable_invariant_load_metadata": "false",
}
KEPT = 1_000_000_000  # bytes of compiled programs, kept from one run to the next
LARGE = 1_700_000_000  # bytes of a test process, above which it forgets its compiled programs


def is_known(flag):
    """Whether this XLA knows a flag: it ends the process over one that it does not."""
    libraries = Path(importlib.util.find_spec("jaxlib").origin).parent.glob("*.so")
    for library in libraries:
        with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            if content.find(flag.encode() + b"\0") >= 0:  # a text of C; messages name flags that are gone
                return True
    return False


def set_flags():
    """Before JAX starts; processes that tests start inherit them. Of these, one that is given has the last word, where
    this XLA has it."""
    given = {flag.lstrip("-").partition("=")[0]: flag for flag in os.environ.get("XLA_FLAGS", "").split()}
    flags = {name: f"--{name}={value}" for name, value in QUICK.items()} | given
    os.environ["XLA_FLAGS"] = " ".join(flag for name, flag in flags.items() if name not in QUICK or is_known(name))


def keep_programs():
    """What one process has compiled the others load, and those of the next run, from a folder that git ignores. Of the
    key are the program and the flags, so that changed code is compiled. One's own folder comes first."""
    if not {"PYTEST_XDIST_WORKER", "JAX_COMPILATION_CACHE_DIR"}.isdisjoint(os.environ):
        return  # workers inherit what is set here
    if jax.__version_info__ < (0, 10):
        return  # this has not been tried with old ones
    import hhtjax
    from hhtjax.xla.first_call import SETTINGS

    try:
        hhtjax.keep_programs(Path(__file__).parents[1] / ".pytest_cache", KEPT)
    except OSError:  # nothing can be written there
        return
    for name in ("jax_compilation_cache_dir", *SETTINGS):  # for processes that are started here
        os.environ[name.upper()] = str(getattr(jax.config, name))


class Contexts(threading.local):
    """Of MLIR, one for many programs. JAX makes one for each, which takes longer than all else about a small program
    that is loaded. What is compiled while another program is lowered has its own, as JAX counts on; and all are renewed
    now and then, for they keep the constants of their programs."""

    left = 0

    def __init__(self, make, current):
        self.make, self.current = make, current

    def __call__(self):
        if self.current() is not None:
            return self.make()
        if not self.left:
            self.context, self.left = self.make(), 100
        self.left -= 1
        return self.context


def share_contexts():
    """As above, where this has been tried."""
    if jax.__version_info__[:2] == (0, 10):
        from jax._src.interpreters import mlir
        from jaxlib.mlir import ir

        mlir.make_ir_context = Contexts(mlir.make_ir_context, lambda: ir.Context.current)


set_flags()
keep_programs()
share_contexts()
os.environ.setdefault("MPLBACKEND", "Agg")  # charts of doctests need no display
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture(autouse=True)
def _without_tqdm(monkeypatch):
    """Bars are the same here, whatever else is installed."""
    monkeypatch.setattr("hhtjax.runs.progress._tqdm", lambda: None)


def pytest_collection_finish(session):
    """Tracing makes many objects and hardly a circle; to look for these took a twentieth of the time. They are looked
    for where programs are forgotten."""
    gc.freeze()
    gc.disable()


def memory():
    """Bytes that this process holds; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


class Forgetting:
    """Between two files, if need be, the programs compiled so far are forgotten."""

    @pytest.hookimpl(trylast=True)
    def pytest_runtest_teardown(self, item, nextitem):
        if nextitem is not None and nextitem.path != item.path and memory() > LARGE:
            jax.clear_caches()
            gc.collect()
            if sys.platform == "linux":  # what is free goes back to the system
                getattr(ctypes.CDLL(None), "malloc_trim", int)(0)


def pytest_configure(config):
    """As a plugin it sees the doctests too: a hook of this file would only see what lies beside it.

    Many tests look at runs that fail, by `check` or `failed`; that such runs warn has a test of its own.
    """
    config.addinivalue_line("filterwarnings", "ignore::hhtjax.FailedRunWarning")
    config.pluginmanager.register(Forgetting())
