"""What numbers were made by: command, versions, hardware. Every JSON of an experiment ends with it."""

import os
import platform
import sys
import time
from importlib.metadata import version

import hhtjax
from experiments.benchmarks.measure import processor

PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "diffrax", "optimistix", "mujoco", "exudyn", "scipy_dae", "numba")


def provenance(command: str, mode: str, seconds: float) -> dict:
    """Of the packages, those that the run has imported. mode: full, fast or part."""
    return {
        "command": command,
        "mode": mode,
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "run_time_s": float(f"{seconds:.3g}"),
        "hhtjax": hhtjax.__version__,
        "python": platform.python_version(),
        **{name: version(name.replace("_", "-")) for name in PACKAGES if name in sys.modules},
        "system": f"{platform.system()} {platform.machine()}",
        "processor": processor(),
        "cores": os.cpu_count(),
        "load_at_end": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", ""),
    }
