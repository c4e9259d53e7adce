"""Silverbox: the measured record with its official split, or a generated one of the same shape.

T. Wigren, J. Schoukens, "Three free data sets for development and benchmarking in nonlinear system
identification", ECC 2013, pp. 2933-2938. The data are public but not ours to redistribute.
"""

import hashlib
import importlib
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from hhtjax.scenes import duffing

SAMPLING_RATE = 1e7 / 2**14  # Hz
FINER = 8  # points of the reconstructed input for each sample
WASHOUT = 50  # samples at the start of each set that serve to find the initial state and are not scored
SHA256 = "ae62d5a91230c10f76e6dd02c8a4fac3c9d4d8a95fbf50e87cb0c4885003e0f1"
PACKAGE = "nonlinear_benchmarks"  # which downloads the benchmarks of nonlinearbenchmark.org
GENERATED = {"m": 5.4e-6, "c": 2.2e-4, "k": 1.0, "k2": -0.03, "k3": 4.0, "offset": -5e-3}
NOISE = 3e-4  # V, standard deviation

LINEAR = ("m", "c", "k", "k2", "k3", "offset")
# a linear oscillator with the resonance at 68 Hz and 2 % of damping, seen in the spectrum
RESONANCE = 68.0  # Hz
START = {"m": (2 * np.pi * RESONANCE) ** -2.0, "c": 0.04 / (2 * np.pi * RESONANCE), "k": 1.0}
SCALE = {"m": 5e-6, "c": 1e-4, "k": 1.0, "k2": 1.0, "k3": 1.0, "offset": 0.01}
SCALE |= {"c2": 1e-3, "d": 1e-5, "e": 1e-5, "delay": 1e-4}
SCALE_OF_LINEAR = {name: SCALE[name] for name in LINEAR}
STATE_SCALE = {"y": 0.01, "v": 5.0}


def how_to_get(files: str, folder: str) -> str:
    """Two ways to a benchmark's records, in words: by the package that downloads them, or by hand."""
    return (
        f"install what downloads it, `pip install -e '.[data]'`; or download {files} from nonlinearbenchmark.org into "
        f"a folder {folder}/ and set the environment variable HHTJAX_DATA to the folder that holds {folder}/"
    )


HOW_TO_GET_IT = how_to_get("SNLS80mV.csv of the Silverbox benchmark", "silverbox")


class Record(NamedTuple):
    """Uniform samples of input u and output y; of Silverbox in V."""

    u: Any
    y: Any


class Silverbox(NamedTuple):
    """Training and test records; measured says where they come from."""

    train: Record
    tests: dict[str, Record]
    measured: bool


def load(fast: bool) -> Silverbox:
    """The measured record where it is found or can be downloaded, else a generated one; fast: a part of each set."""
    path = data_folder() / "silverbox" / "SNLS80mV.csv"
    measured = True
    if path.is_file():
        u, y = read(path)
    elif files := downloaded("Silverbox"):
        u, y = columns(next(file for file in files if "SNLS80mV" in file), "V1", "V2")
    else:
        measured, (u, y) = False, generate()
    train_end = 40650 + int(0.75 * (127400 - 40650))
    tests = {"arrow_full": (100, 40575), "arrow_no_extrapolation": (100, 32100), "multisine": (train_end, 127400)}

    def cut(start, end):
        end = min(end, start + 4000) if fast else end
        return Record(u[start:end], y[start:end])

    return Silverbox(cut(40650, train_end), {name: cut(*ends) for name, ends in tests.items()}, measured)


def data_folder() -> Path:
    """HHTJAX_DATA, or shared/data beside the checkout."""
    beside = Path(__file__).resolve().parents[3] / "shared" / "data"
    return Path(os.environ.get("HHTJAX_DATA") or beside)


def downloaded(benchmark: str) -> list[str]:
    """Files of a benchmark (EMPS, Silverbox, Cascaded_Tanks, BoucWen), which the package `nonlinear_benchmarks`
    downloads the first time; none where it is not installed, or cannot, and then it says so."""
    try:
        package = importlib.import_module(PACKAGE)
    except ImportError:
        return []
    home = package if hasattr(package, benchmark) else importlib.import_module(f"{PACKAGE}.not_splitted_benchmarks")
    try:
        files = getattr(home, benchmark)(data_file_locations=True)
    except Exception as error:  # of the network, of the server, of a file that is not what it should be
        print(f"{PACKAGE} could not download {benchmark}: {type(error).__name__}: {error}")
        return []
    files = [files] if isinstance(files, str) else list(files)
    return [str(path) for file in files for path in (sorted(Path(file).iterdir()) if Path(file).is_dir() else [file])]


def columns(file: str, *names: str):
    """Arrays of a MATLAB file, flat, one by one."""
    from scipy.io import loadmat

    content = loadmat(file)
    if missing := [name for name in names if name not in content]:
        raise ValueError(f"{file} does not hold {', '.join(missing)}.")
    return [np.ravel(np.asarray(content[name], float)) for name in names]


def read(path: Path):
    """Both columns of the file, checked against its published hash."""
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != SHA256:
        raise ValueError(f"{path} is not the Silverbox record (its SHA-256 differs): {HOW_TO_GET_IT}.")
    table = np.genfromtxt(content.decode().splitlines(), delimiter=",", skip_header=1, usecols=(0, 1))
    return table.T


def generate():
    """A record of the same length: an arrow of growing noise, then bursts of it, through a known oscillator.

    Simulated with 32 steps per sample, four times finer than the fit.
    """
    rng = np.random.default_rng(0)
    size, cutoff = 127400, 200.0
    spectrum = np.fft.rfft(rng.normal(size=size))
    spectrum[np.fft.rfftfreq(size, 1 / SAMPLING_RATE) > cutoff] = 0
    u = np.fft.irfft(spectrum, size)
    amplitude = np.full(size, 0.055)
    amplitude[:40650] = np.linspace(0.0, 0.09, 40650)
    u = amplitude * u / u.std()
    y = np.asarray(simulate(GENERATED, {"y": 0.0, "v": 0.0}, reconstruct(u), size, substeps=32, alpha=0.0))
    return u, y + NOISE * rng.normal(size=size)


def force(q, v, t, params):
    """Duffing's oscillator under a sampled input, with those of the further terms that params names."""
    own, u = params
    if "delay" in own:
        t = t - own["delay"]
    damping = 0.0
    if "c2" in own:
        damping = damping + own["c2"] * q**2
    if "d" in own:
        damping = damping + own["d"] * jnp.abs(v)
    if "e" in own:
        damping = damping + own["e"] * q * v
    return duffing.restoring(q, v, own) - damping * v + u(t) + own["offset"]


SYSTEM = hhtjax.System(duffing.sampled_mass, force)


@jax.jit
def reconstruct(u):
    """The input between its samples, band-limited; as one program, which compiles faster than its many small ones."""
    return hhtjax.band_limited(u, 1 / SAMPLING_RATE, factor=FINER)


def beginning(u, samples):
    """The same input over its first samples: what needs no more compiles once for records of all lengths."""
    return replace(u, polynomials=u.polynomials[: FINER * samples])


def simulate(params, start, u, samples, substeps, alpha, t0=0.0):
    """Output at `samples` samples of the reconstructed input u, from time t0 on, in V, by the non-iterative step."""
    solution = hhtjax.simulate(
        SYSTEM,
        hhtjax.hht(alpha, linearize="predictor"),  # smooth in the parameters
        jnp.reshape(start["y"], (1,)),
        jnp.reshape(start["v"], (1,)),
        (params, u),
        dt=1 / SAMPLING_RATE / substeps,
        num_steps=(samples - 1) * substeps,
        save_every=substeps,
        t0=t0,
    )
    return solution.q[:, 0]


def first_state(record: Record):
    """Position and velocity of the first sample, by differences: a start for the fit of the initial state."""
    return {"y": float(record.y[0]), "v": float(record.y[1] - record.y[0]) * SAMPLING_RATE}


def training_residuals(record: Record, substeps: int, alpha: float):
    """The residual of (parameters, initial state) over a record, in V."""
    u, y = reconstruct(record.u), jnp.asarray(record.y)

    def residuals(unknown):
        params, start = unknown
        return simulate(params, start, u, len(y), substeps, alpha) - y

    return residuals


def windows_problem(record: Record, samples: int, substeps: int, alpha: float):
    """Arguments of `fit` for windows of `samples` sampling periods, one after the other, each with its own start."""
    u, y = reconstruct(record.u), np.asarray(record.y)
    first = np.arange(0, len(y) - samples, samples)
    windows = {"t0": jnp.asarray(first / SAMPLING_RATE), "y": jnp.asarray(y[first[:, None] + np.arange(samples + 1)])}
    starts = {"y": jnp.asarray(y[first]), "v": jnp.asarray((y[first + 1] - y[first]) * SAMPLING_RATE)}

    def residuals(params, start, window):
        return simulate(params, start, u, samples + 1, substeps, alpha, window["t0"]) - window["y"]

    return {"residuals": residuals, "records": windows, "starts": starts}
